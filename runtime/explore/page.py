"""The page: sliders to the left, and beside them what follows, redrawn as they move.

Takes: a compiled model; a Bokeh document, one a tab.
Gives: `Scene`, `scene_of`, `open_page`.
Guarantees: whatever a slider says is what is computed; nothing is computed on the thread that serves the
page; the link holds the values of the sliders that were moved, and a link with values opens with them.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from bokeh.document import Document
from bokeh.events import Tap
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, CustomJS, CustomJSTickFormatter, Div, Select
from bokeh.models import Slider as Handle

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.frozen import dataclass
from apc.explore.desk import Desk
from apc.explore.figures import FOCUS, FeelFigure, MotionFigure, RegionFigure, RootsFigure, Words
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
from apc.frame.overrides import Override
from apc.processes import model_bytes
from apc.vary.growth import MEAN_SQUARE, NOMINAL

# Who computes what, first things first: what is redrawn while a slider moves waits for nothing else.
DESKS = (("verdict", "roots"), ("region",), ("motion", "feel", "margins", "network", "numbers"))
X, Y = "x", "y"  # arguments of the link: the sliders on the axes of the region
STRUCK, BEGINS = "the first peer's device is struck", "as the scene begins"
LIVE, SLOW = "every packet is on time", "packets as they are lost and late (takes long)"

# Handles get their sliders' names, and say values as the page shows them.
NAMED = """
for (const slider of sliders) {
  const handle = Bokeh.index.get_one(slider).shadow_el.querySelector('.noUi-handle')
  handle.setAttribute('aria-label', slider.title)
  const tell = () => {
    const text = slider.format.compute(slider.value)
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
        self.verdict, self.margins, self.network = Words("verdict"), Words("margins"), Words("network")
        self.region, self.roots = RegionFigure(), RootsFigure()
        self.motion, self.feel = MotionFigure(), FeelFigure()
        self.moving, self.last = False, self.chosen[0] if self.chosen else 0
        self.link = ColumnDataSource({"query": [""]})
        self.link.js_on_change("data", CustomJS(args={"link": self.link}, code=LINKED))
        self.desks = [Desk(scene.model, order, self._later, self._deliver) for order in DESKS]
        self._lay_out()
        document.on_session_destroyed(lambda session_context: self._close())
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
        duration = self.system.experiment.duration
        self.begins = Select(
            title="What is played",
            options=[STRUCK, BEGINS],
            value=BEGINS if duration else STRUCK,
            stylesheets=[FOCUS],
        )
        self.begins.on_change("value", lambda attr, old, new: self._moved())
        self.meant = Select(title="Stable, where", options=[LIVE, SLOW], value=LIVE, stylesheets=[FOCUS])
        self.meant.on_change("value", lambda attr, old, new: self._moved())
        controls: list[Any] = [self.message.model, *self.selects]
        if any(link.channel is not None for link in self.system.links):
            controls.append(self.meant)
        for kind in dict.fromkeys(one.kind for one in self.sliders):
            heading = Div(text=f"<h2 style='font-size:15px;margin:10px 0 0'>{kind.capitalize()}</h2>")
            own = [handle for handle, one in zip(self.handles, self.sliders, strict=True) if one.kind == kind]
            controls += [heading, *own]
        region, roots, motion, feel = self.region, self.roots, self.motion, self.feel
        roots_of_page: dict[str, Any] = {
            "controls": _below(*controls, tags=[self.link]),
            "verdict": self.verdict.model,
            "margins": self.margins.model,
            "region": _below(region.plot, region.words.model),
            "roots": _below(roots.plot, roots.words.model, roots.way_words.model),
            "motion": _below(
                self.begins,
                motion.stage,
                row(motion.play, motion.time, sizing_mode="stretch_width"),
                motion.plot,
                motion.words.model,
            ),
            "feel": _below(feel.plot, feel.phase, feel.words.model),
            "network": self.network.model,
        }
        for name, root in roots_of_page.items():
            root.name = name
            self.document.add_root(root)
        self.document.js_on_event(
            "document_ready", CustomJS(args={"sliders": [*self.handles, self.motion.time]}, code=NAMED)
        )
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
            self.places[number], self.last = place, number
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
        moved = self.sliders[self.last]
        others = tuple(one for one in overrides if one.free != moved.free)
        self._ask("verdict", overrides)
        self._ask("roots", others, (moved.free, moved.values))
        self._ask_region(overrides)
        self._ask("motion", overrides, self.begins.value == STRUCK)
        for section in ("feel", "margins", "network"):
            self._ask(section, overrides)
        self.link.data = {"query": [self._query()]}

    def _ask_region(self, overrides: tuple[Override, ...]) -> None:
        """Ask for the region, if there are two axes: nobody waits for it where it takes long."""
        region = self.desks[1]
        if len(set(self.chosen)) < 2:
            region.forget("region")
            self.region.clear("A region has two different parameters: choose another one for an axis.")
            return
        axes = axes_of(self.sliders, self.places, (self.chosen[0], self.chosen[1]))
        # What stands on an axis has all its values there.
        others = tuple(one for one in overrides if one.free not in (axes[0].free, axes[1].free))
        criterion = NOMINAL if self.meant.value == LIVE else MEAN_SQUARE
        region.ask(Task("region", others, (*axes, criterion)))
        self.region.mark(*(float(self.sliders[one].values[self.places[one]]) for one in self.chosen))

    def _ask(self, section: str, overrides: tuple[Override, ...], asked: Any = None) -> None:
        desk = next(desk for desk in self.desks if section in desk.order)
        desk.ask(Task(section, overrides, asked))

    def _close(self) -> None:
        """End those who compute for this tab."""
        for desk in self.desks:
            desk.close()

    def _query(self) -> str:
        """Return the part of the link that holds values and axes."""
        pairs = [
            (one.label, one.texts[place])
            for one, place in zip(self.sliders, self.places, strict=True)
            if place != one.start
        ]
        pairs += [
            (name, self.sliders[number].label) for name, number in zip((X, Y), self.chosen, strict=True)
        ]
        return "".join(f"&{quote(name)}={quote(text, safe='')}" for name, text in pairs)

    def _later(self, call: Any) -> None:
        """Call on the thread of the page; a page that is closed by then is told nothing more."""
        self.document.add_next_tick_callback(call)

    def _deliver(self, section: str, told: Told) -> None:
        """Show what a section tells."""
        found = told.found
        match section:
            case "verdict" if found is not None:
                self.verdict.verdict(found)
                self.roots.show(found)
            case "roots" if found is not None:
                self.roots.way_of(found)
            case "region" if found is not None:
                self.region.show(found)
            case "motion" if found is not None:
                self.motion.show(found["motion"])
            case "feel" if found is not None:
                self.feel.show(found)
            case "margins" | "network" if found is not None:
                self._words(section).table(found["text"])
            case "region":
                self.region.clear(told.why)
            case "feel":
                self.feel.clear(told.why)
            case _:
                self._words(section).nothing(told.why)

    def _words(self, section: str) -> Words:
        words = {"verdict": self.verdict, "roots": self.roots.way_words, "motion": self.motion.words}
        return (words | {"margins": self.margins, "network": self.network}).get(section, self.message)


def _below(*models: Any, tags: Sequence[Any] = ()) -> Any:
    """Return models below each other, as wide as their place."""
    return column(*models, sizing_mode="stretch_width", tags=list(tags))
