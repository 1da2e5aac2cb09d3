"""The page: sliders to the left, and beside them what follows, redrawn as they move.

Takes: a compiled model; a Bokeh document, one a tab.
Gives: `Scene`, `scene_of`, `open_page`.
Guarantees: whatever a slider says is what is computed; nothing is computed on the thread that serves the
page; the link holds the values of the sliders that were moved, and a link with values opens with them.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from bokeh.document import Document
from bokeh.events import Tap
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, CustomJS, CustomJSTickFormatter, Div, InlineStyleSheet, Select
from bokeh.models import Slider as Handle

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.frozen import dataclass
from apc.explore.desk import Desk
from apc.explore.figures import RegionFigure, RootsFigure, Words
from apc.explore.sections import Task, Told
from apc.explore.sliders import (
    Slider,
    axes_of,
    overrides_of,
    place_of,
    set_to,
    sliders_of,
    with_value,
)
from apc.processes import model_bytes
from apc.vary.growth import NOMINAL

# What is redrawn while a slider moves, first things first.
QUICK = ("verdict", "region")
X, Y = "x", "y"  # arguments of the link: the sliders on the axes of the region

FOCUS = InlineStyleSheet(
    css="""
    :host { font: 13px/1.4 system-ui, sans-serif; color: #1a1a1a; }
    .noUi-handle:focus-visible { outline: 3px solid #0072B2; outline-offset: 1px; }
    .noUi-target { border-color: #767676; }
    .noUi-handle { border-color: #595959; }
    """
)
# Handles get their sliders' names, and say values as the page shows them.
NAMED = """
for (const slider of sliders) {
  const handle = Bokeh.index.get_one(slider).shadow_el.querySelector('.noUi-handle')
  handle.setAttribute('aria-label', slider.title)
  const tell = () => {
    const text = slider.format.args.texts[Math.round(slider.value)]
    if (handle.getAttribute('aria-valuetext') !== text) handle.setAttribute('aria-valuetext', text)
  }
  new MutationObserver(tell).observe(handle, {attributeFilter: ['aria-valuetext']})
  tell()
}
document.documentElement.dataset.ready = 'yes'
"""
# Browsers refuse more than a few changes of the link a second.
LINKED = """
clearTimeout(window.apc_link)
window.apc_link = setTimeout(() => {
  const token = new URLSearchParams(location.search).get('token')
  history.replaceState(null, '', '?token=' + encodeURIComponent(token) + link.data.query[0])
}, 250)
"""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What all tabs share: the scene, its bytes for those who compute, its sliders, and who may be an axis."""

    system: CompiledSystem
    model: bytes
    sliders: tuple[Slider, ...]


def scene_of(system: CompiledSystem) -> Scene:
    """Return what the tabs of a scene share."""
    return Scene(system, model_bytes(system), sliders_of(system))


def open_page(scene: Scene, document: Document) -> None:
    """Fill the document of a new tab."""
    Page(scene, document)


class Page:
    """One tab: its sliders and where they are, its figures, and who computes for it."""

    def __init__(self, scene: Scene, document: Document) -> None:
        self.system, self.document = scene.system, document
        self.sliders, self.places = list(scene.sliders), [one.start for one in scene.sliders]
        self.chosen = self._axes_at_first()
        self.message = Words("message")
        self.message.model.text = ""
        self._take_link(document.session_context.request.arguments)
        self.verdict, self.region, self.roots = Words("verdict"), RegionFigure(), RootsFigure()
        self.moving = False
        self.link = ColumnDataSource({"query": [""]})
        self.link.js_on_change("data", CustomJS(args={"link": self.link}, code=LINKED))
        self.quick = Desk(scene.model, QUICK, self._later, self._deliver)
        self._lay_out()
        document.on_session_destroyed(lambda _: self.quick.close())
        self._moved()

    def _axes_at_first(self) -> list[int]:
        """Return the sliders on the axes of the region: those the scene studies come first."""
        return [place for place, one in enumerate(self.sliders) if one.span is not None][:2]

    def _take_link(self, arguments: Mapping[str, list[bytes]]) -> None:
        """Set the sliders as the link says."""
        wrong = []
        for name, values in arguments.items():
            text = values[-1].decode("utf-8", "replace")
            if name in (X, Y):
                axes = [place for place, one in enumerate(self.sliders) if one.span and one.label == text]
                self.chosen["xy".index(name)] = (axes or self.chosen)[0]
            elif name not in ("token", "bokeh-session-id"):
                try:
                    place, value = set_to(self.system, self.sliders, f"{name}={text}")
                except ApcError as error:
                    wrong += [one.sentence for one in error.mistakes]
                    continue
                self.sliders[place] = with_value(self.sliders[place], value)
                self.places[place] = self.sliders[place].values.index(value)
        if wrong:
            self.message.say("The link says what can't be:", *wrong)

    def _lay_out(self) -> None:
        self.handles = [self._handle(place) for place in range(len(self.sliders))]
        names = [one.label for one in self.sliders if one.span is not None]
        self.selects = [
            Select(title=f"Region: {way} axis", value=self.sliders[place].label, options=names, width=250)
            for way, place in zip(("horizontal", "vertical"), self.chosen, strict=True)
        ]
        for select in self.selects:
            select.on_change("value", lambda attr, old, new: self._choose())
        self.region.plot.on_event(Tap, self._tapped)
        controls: list[Any] = [self.message.model, *self.selects]
        for kind in dict.fromkeys(one.kind for one in self.sliders):
            heading = Div(text=f"<h2 style='font-size:15px;margin:10px 0 0'>{kind.capitalize()}</h2>")
            own = [handle for handle, one in zip(self.handles, self.sliders, strict=True) if one.kind == kind]
            controls += [heading, *own]
        roots = {
            "controls": column(controls, sizing_mode="stretch_width", tags=[self.link]),
            "verdict": self.verdict.model,
            "region": column(self.region.plot, self.region.words.model, sizing_mode="stretch_width"),
            "roots": column(self.roots.plot, self.roots.words.model, sizing_mode="stretch_width"),
        }
        for name, root in roots.items():
            root.name = name
            self.document.add_root(root)
        self.document.js_on_event("document_ready", CustomJS(args={"sliders": self.handles}, code=NAMED))
        self.document.title = f"{self.system.name} · apc"
        self.document.template = files("apc.explore").joinpath("page.html").read_text(encoding="utf-8")
        self.document.template_variables["about"] = self.system.about

    def _handle(self, place: int) -> Handle:
        """Return the slider of a number, which counts its values."""
        one = self.sliders[place]
        texts = [text.replace("*", "·") for text in one.texts]
        handle = Handle(
            start=0,
            end=max(len(texts) - 1, 1),
            step=1,
            value=self.places[place],
            title=one.label,
            format=CustomJSTickFormatter(args={"texts": texts}, code="return texts[Math.round(tick)]"),
            tooltips=False,
            sizing_mode="stretch_width",
            stylesheets=[FOCUS],
            disabled=len(texts) == 1,
        )
        handle.on_change("value", lambda attr, old, new: self._set({place: round(new)}))
        return handle

    def _set(self, places: Mapping[int, int]) -> None:
        """Take the values of sliders that were moved, and move those that were not moved by hand."""
        if self.moving:
            return
        for number, place in places.items():
            self.places[number] = place
        self.moving = True
        for number, place in places.items():
            self.handles[number].value = place
        self.moving = False
        self._moved()

    def _tapped(self, event: Any) -> None:
        """Set the sliders of both axes to where the region was clicked."""
        pairs = zip(self.chosen, (event.x, event.y), strict=True)
        self._set({number: place_of(self.sliders[number], at) for number, at in pairs})

    def _choose(self) -> None:
        """Take other axes for the region."""
        labels = [one.label for one in self.sliders]
        self.chosen = [labels.index(select.value) for select in self.selects]
        self._moved()

    def _moved(self) -> None:
        """Ask for everything anew."""
        overrides = tuple(overrides_of(self.sliders, self.places))
        self.quick.ask(Task("verdict", overrides))
        first, second = self.chosen
        if first == second:
            self.quick.forget("region")
            self.region.clear("A region has two different parameters: choose another one for an axis.")
        else:
            axes = axes_of(self.sliders, self.places, (first, second))
            # What stands on an axis has all its values there.
            others = tuple(one for one in overrides if one.free not in (axes[0].free, axes[1].free))
            self.quick.ask(Task("region", others, (*axes, NOMINAL)))
        x, y = (float(self.sliders[number].values[self.places[number]]) for number in self.chosen)
        self.region.mark(x, y)
        self.link.data = {"query": [self._query()]}

    def _query(self) -> str:
        """Return the part of the link that holds values and axes."""
        pairs = [
            (one.label, one.texts[place])
            for one, place in zip(self.sliders, self.places, strict=True)
            if place != one.start
        ]
        pairs += [(name, self.sliders[number].label) for name, number in zip((X, Y), self.chosen, strict=True)]
        return "".join(f"&{quote(name)}={quote(text, safe='')}" for name, text in pairs)

    def _later(self, call: Any) -> None:
        """Call on the thread of the page; a page that is closed by then is told nothing more."""
        self.document.add_next_tick_callback(call)

    def _deliver(self, section: str, told: Told) -> None:
        """Show what a section tells."""
        found = told.found
        if section == "verdict":
            if found is None:
                self.verdict.nothing(told.why)
            else:
                self.verdict.verdict(found)
                self.roots.show(found)
        elif section == "region":
            if found is None:
                self.region.clear(told.why)
            else:
                self.region.show(found)
