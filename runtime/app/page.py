"""The page: sliders on the left, and the results, redrawn when sliders move.

Takes: a compiled model; a Bokeh document per tab.
Gives: `SharedState`, `topology_of`, `open_page`.
Guarantees: results correspond to the slider values, and an invalid value changes nothing. The server thread
does not compute. The link contains the values of moved sliders, and a link with values restores them.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from bokeh.document import Document
from bokeh.events import Tap
from bokeh.layouts import column, row
from bokeh.models import Button, ColumnDataSource, CustomJS, CustomJSTickFormatter, Div, Select
from bokeh.models import Slider as Handle

from apc.app.figures import FOCUS, LiveText, MotionFigure, RegionFigure, RootsFigure, TransparencyFigure
from apc.app.sections import SectionAnswer, Task
from apc.app.server import TOKEN
from apc.app.sliders import (
    PEOPLE,
    Slider,
    axes_of,
    is_member_of,
    is_number,
    is_position,
    overrides_of,
    position_of,
    set_to,
    sliders_of,
    with_value,
)
from apc.app.worker_process import Desk
from apc.app.yaml_edit import with_values
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.distribution import program_version
from apc.frame.linearize import reaches_start
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import Range
from apc.output.formatting import Plain, json_text
from apc.parameter_studies.evaluator import reaches_count, reaches_time
from apc.parameter_studies.stability_criteria import MEAN_SQUARE, NOMINAL
from apc.processes import model_bytes

# Who computes what, first things first: what is redrawn while a slider moves waits for nothing else. A region
# whose points are analysed one by one takes many seconds, and comes last.
VERDICT, REGION, LATER, TUNED = 0, 1, 2, 3
DESKS = (
    ("verdict",),
    ("region",),
    ("numbers", "roots", "motion", "transparency", "margins", "network", "region"),
    ("tune",),
)
# Seconds, a few frames of a browser, after which eigenvalues are drawn next to an existing region.
FRAMES = 0.05
# Arguments of the link: the sliders on the axes of the region. No name of a model has a hyphen.
X, Y = "x-axis", "y-axis"
STRUCK, BEGINS = "the first peer is struck", "as the topology begins"
SAME_AXES = "A region has two different parameters: choose another one for an axis."
TUNES = (
    "The button looks for the largest {} with which the topology is stable, {} chosen with it, and proves it."
)
STUDIED = "The button looks for the gains that the topology's studies: tune: asks for, and proves them."
NO_AXES = "A region has two parameters, and this topology has fewer that are numbers of a range."
LIVE, SLOW = "every packet is on time", "packets as they are lost and late (takes long)"

# Handles have their sliders' names, with values as displayed.
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


# What is downloaded is handed to the page as a text, and from there to a file.
SAVED = """
const [name, text] = [out.data.name[0], out.data.text[0]]
const link = document.createElement('a')
link.href = URL.createObjectURL(new Blob([text]))
link.download = name
link.click()
setTimeout(() => URL.revokeObjectURL(link.href), 1000)
"""
# The figures as they are seen, below each other.
PICTURED = """
const parts = plots.map(plot => Bokeh.index.get_one(plot).export('auto', true).canvas)
const whole = document.createElement('canvas')
whole.width = Math.max(...parts.map(one => one.width))
whole.height = parts.reduce((sum, one) => sum + one.height, 0)
const pen = whole.getContext('2d')
pen.fillStyle = '#ffffff'
pen.fillRect(0, 0, whole.width, whole.height)
let top = 0
for (const one of parts) { pen.drawImage(one, 0, top); top += one.height }
whole.toBlob(blob => {
  const link = document.createElement('a')
  link.href = URL.createObjectURL(blob)
  link.download = name
  link.click()
  setTimeout(() => URL.revokeObjectURL(link.href), 1000)
})
"""


@dataclass(frozen=True, slots=True, eq=False)
class SharedState:
    """Data common to all tabs: the model, its bytes for the workers, its sliders and their values.

    `text` is the topology, None where there is only a compiled model.
    """

    system: Model
    model: bytes
    sliders: tuple[Slider, ...]
    settings: tuple[str, ...]
    text: str | None


def topology_of(system: Model, settings: Sequence[str], text: str | None) -> SharedState:
    """Return the data common to the tabs of a model.

    Parameters
    ----------
    system
        The model.
    settings
        Numbers that are set at first, each `NAME=QUANTITY`.
    text
        The topology.

    Raises
    ------
    ApcError
        E980 a number without a slider; those of `overrides.parse_override` and `overrides.apply`.
    """
    sliders = sliders_of(system)
    pairs = [set_to(system, sliders, setting) for setting in settings]
    apply(system, [Override(sliders[index].free, value) for index, value in pairs])
    return SharedState(system, model_bytes(system), sliders, tuple(settings), text)


def open_page(topology: SharedState, document: Document) -> None:
    """Fill the document of a new tab."""
    TopologyTab(topology, document)


class TopologyTab:
    """One tab: its sliders and where they are, its figures, and who computes for it."""

    def __init__(self, topology: SharedState, document: Document) -> None:
        self.topology, self.system, self.document = topology, topology.system, document
        self.sliders, self.positions = list(topology.sliders), [slider.start for slider in topology.sliders]
        self.chosen = self._axes_at_first()
        self.message = LiveText("message")
        self.message.model.text = ""
        for setting in topology.settings:
            self._start_at(setting)
        self._take_link(document.session_context.request.arguments)
        self.verdict, self.margins, self.network = (
            LiveText("verdict"),
            LiveText("margins"),
            LiveText("network"),
        )
        self.tuned = LiveText("tuned")
        self.region, self.roots = RegionFigure(), RootsFigure()
        self.motion, self.transparency = MotionFigure(), TransparencyFigure()
        self.modes: Plain | None = None  # of the newest verdict
        # Whether the model is linear, and batches of points are possible: known from the first verdict.
        self.linear: bool | None = None
        self.at_once = False
        self.moving, self.last = False, self.chosen[0] if self.chosen else 0
        self.link = ColumnDataSource({"query": [""]})
        self.link.js_on_change("data", CustomJS(args={"link": self.link}, code=LINKED))
        self.desks = [Desk(topology.model, order, self._next_tick, self._deliver) for order in DESKS]
        for first in (VERDICT, REGION):
            self.desks[first].put_before(self.desks[LATER])
        self._lay_out()
        document.on_session_destroyed(lambda session_context: self._close())
        self._moved()

    def _axes_at_first(self) -> list[int]:
        """Return the sliders on the axes of the region, those the model studies first; none without two."""
        numbers = [index for index, slider in enumerate(self.sliders) if slider.span is not None]
        return numbers[:2] if len(numbers) > 1 else []

    def _take_link(self, arguments: Mapping[str, list[bytes]]) -> None:
        """Set the sliders from the link."""
        wrong = []
        for name, values in arguments.items():
            text = values[-1].decode("utf-8", "replace")
            if name in (X, Y):
                axes = [
                    index for index, slider in enumerate(self.sliders) if slider.span and slider.label == text
                ]
                if axes and self.chosen:
                    self.chosen[(X, Y).index(name)] = axes[0]
                else:
                    wrong.append(f"{text} can be no axis of the region")
            elif name != "bokeh-session-id" and (name != TOKEN or len(values) > 1):  # a number may be a token
                try:
                    self._start_at(f"{name}={text}")
                except ApcError as error:
                    wrong += [mistake.sentence for mistake in error.mistakes]
        if wrong:
            self.message.show_text("The link says what can't be:", *wrong)

    def _start_at(self, setting: str) -> None:
        """Set a slider before the page is shown; its value need be none that the slider had."""
        index, value = set_to(self.system, self.sliders, setting)
        apply(self.system, [Override(self.sliders[index].free, value)])
        self.sliders[index], self.positions[index] = with_value(self.sliders[index], value)

    def _lay_out(self) -> None:
        self.handles = [self._handle(index) for index in range(len(self.sliders))]
        names = [slider.label for slider in self.sliders if slider.span is not None]
        self.selects = [
            Select(title=f"Region: {axis} axis", value=self.sliders[index].label, options=names, width=250)
            for axis, index in zip(("horizontal", "vertical"), self.chosen, strict=False)
        ]
        for number, select in enumerate(self.selects):
            self._receive(select, partial(is_member_of, names), partial(self._choose, number))
        self.region.plot.on_event(Tap, self._tapped)
        duration = self.system.experiment.duration
        self.begins = Select(
            title="What is played",
            options=[STRUCK, BEGINS],
            value=BEGINS if duration else STRUCK,
            stylesheets=[FOCUS],
        )
        self._receive(self.begins, partial(is_member_of, (STRUCK, BEGINS)), lambda _: self._moved())
        self.meant = Select(title="Stable, where", options=[LIVE, SLOW], value=LIVE, stylesheets=[FOCUS])
        self._receive(self.meant, partial(is_member_of, (LIVE, SLOW)), lambda _: self._moved())
        self.at = Select(title="The hand holds", visible=False, stylesheets=[FOCUS])
        self.held: list[str] = []
        self._receive(
            self.at, lambda name: is_member_of(self.held, name), lambda _: self._request_transparency()
        )
        controls: list[Any] = [self.message.model, *self.selects]
        if any(link.channel is not None for link in self.system.links):
            controls.append(self.meant)
        controls.append(row(*self._buttons(), sizing_mode="stretch_width"))
        kinds = dict.fromkeys(slider.kind for slider in self.sliders)
        for kind in sorted(kinds, key=lambda kind: kind != PEOPLE):  # how many there are comes first
            heading = Div(text=f"<h2 style='font-size:15px;margin:10px 0 0'>{kind.capitalize()}</h2>")
            local = [
                handle
                for handle, slider in zip(self.handles, self.sliders, strict=True)
                if slider.kind == kind
            ]
            controls += [heading, *local]
        self.tune = Button(label="Tune", stylesheets=[FOCUS], name="tune", width=120)
        self.tune.on_click(self._ask_tune)
        motion, transparency = self.motion, self.transparency
        simulated = row(motion.simulation, motion.time, sizing_mode="stretch_width")
        # Words stand by themselves: in one layout with a figure, they have it drawn again when they change.
        for part in (
            _below("controls", *controls, tags=[self.link, self.out]),
            self.region.plot,
            self.roots.plot,
            self.tune,
            self.tuned.model,
            _below("motion", self.begins, motion.stage, simulated, motion.plot),
            _below("transparency", self.at, transparency.plot, transparency.phase),
            *(words.model for words in (self.verdict, self.margins, self.region.words, self.network)),
            *(
                words.model
                for words in (self.roots.words, self.roots.path_text, motion.words, transparency.words)
            ),
        ):
            self.document.add_root(part)
        self.document.js_on_event(
            "document_ready", CustomJS(args={"sliders": [*self.handles, self.motion.time]}, code=NAMED)
        )
        self.document.title = f"{self.system.name} · apc"
        self.document.template = files("apc.app").joinpath("page.html").read_text(encoding="utf-8")
        self.document.template_variables["description"] = self.system.description

    def _buttons(self) -> list[Button]:
        """Return the buttons that download the topology, the picture and the numbers."""
        self.out = ColumnDataSource({"name": [""], "text": [""]})
        self.out.js_on_change("data", CustomJS(args={"out": self.out}, code=SAVED))
        topology, picture, numbers = (
            Button(
                label=label, stylesheets=[FOCUS], name=f"save-{label.lower()}", sizing_mode="stretch_width"
            )
            for label in ("Topology", "Picture", "Numbers")
        )
        topology.on_click(self._save_topology)
        plots = [
            self.region.plot,
            self.roots.plot,
            self.motion.plot,
            self.transparency.plot,
            self.transparency.phase,
        ]
        name = f"{self.system.name}.png"
        picture.js_on_event("button_click", CustomJS(args={"plots": plots, "name": name}, code=PICTURED))
        numbers.on_click(self._ask_numbers)
        return [topology, picture, numbers]

    def _save_topology(self) -> None:
        """Hand over the topology with the values of the sliders."""
        if self.topology.text is None:
            self.message.show_text(
                "There is no topology beside this compiled model, whose text could be given."
            )
            return
        values = {
            slider.free: slider.texts[index] for slider, index in self._pairs() if index != slider.start
        }
        try:
            text = with_values(self.topology.text, self.system, values)
        except ApcError as error:  # the number is in a table of peers
            self.message.show_text(
                "The topology can't be written:", *(item.sentence for item in error.mistakes)
            )
            return
        self.out.data = {"name": [f"{self.system.name}.yaml"], "text": [text]}

    def _ask_numbers(self) -> None:
        """Have the numbers computed that are downloaded."""
        self.desks[LATER].forget("numbers")  # who asks twice wants two files
        self._ask("numbers", self._overrides, self._request_region())

    def _request_tuning(self) -> tuple[tuple[str, ...], str] | None:
        """Return the gains on the axes and the one to maximize; none if a study specifies them."""
        if self.system.tune:
            return (), ""
        if (axes := self._request_region()) is None:
            return None
        spans = (
            f"{axis.free.label}={float(axis.low)!r} {axis.unit}:{float(axis.high)!r} {axis.unit}"
            for axis in axes[:2]
        )
        return tuple(spans), axes[1].free.label

    def _ask_tune(self) -> None:
        """Start the gain optimization from the present values of all other sliders."""
        if (requested := self._request_tuning()) is not None:
            self.desks[TUNED].forget("tune")  # who asks twice wants it twice
            self.tuned.show_text("Computing …")
            self._ask("tune", self._overrides, requested)

    def _untuned(self) -> None:
        """Show the objective on the button, instead of the gains for other slider values."""
        self.desks[TUNED].forget("tune")
        requested = self._request_tuning()
        names = [self.sliders[number].label for number in self.chosen]
        self.tune.disabled = requested is None
        self.tuned.show_text(
            NO_AXES if requested is None else TUNES.format(*reversed(names)) if requested[0] else STUDIED
        )

    def _save_numbers(self, result: Plain) -> None:
        values = {slider.label: slider.texts[index] for slider, index in self._pairs()}
        answer = {"topology": self.system.name, "apc": program_version(), "set": values, **result}
        self.out.data = {"name": [f"{self.system.name}.json"], "text": [json_text(answer)]}

    @property
    def _overrides(self) -> tuple[Override, ...]:
        """The settings of the moved sliders."""
        return tuple(overrides_of(self.sliders, self.positions))

    def _pairs(self) -> list[tuple[Slider, int]]:
        return list(zip(self.sliders, self.positions, strict=True))

    def _handle(self, index: int) -> Handle:
        """Return the slider of a number, which counts its values."""
        slider = self.sliders[index]
        texts = [text.replace("*", "·") for text in slider.texts]
        handle = Handle(
            start=0,
            end=max(len(texts) - 1, 1),
            step=1,
            value=self.positions[index],
            title=slider.label,
            format=CustomJSTickFormatter(args={"texts": texts}, code="return texts[Math.round(tick)]"),
            tooltips=False,
            sizing_mode="stretch_width",
            stylesheets=[FOCUS],
            disabled=len(texts) == 1,
        )
        self._receive(handle, partial(is_position, slider), lambda value: self._set({index: round(value)}))
        return handle

    def _receive(self, model: Any, may: Callable[[Any], bool], then: Callable[[Any], None]) -> None:
        """Handle a change of a model's value in the browser; an invalid value is reset.

        Parameters
        ----------
        model
            A slider or a choice: it has a title and a value.
        may
            Whether a value, of whatever type, is one that the model may have.
        then
            Called with the value.
        """

        def changed(attr: str, old: Any, new: Any) -> None:
            if self.moving:
                return
            if may(new):
                then(new)
                return
            self._put({model: old})
            self.message.show_text(f"{model.title} can't be {new!r:.40}, and stays as it was.")

        model.on_change("value", changed)

    def _put(self, values: Mapping[Any, Any]) -> None:
        """Give models their values, which is no wish of somebody's."""
        self.moving = True
        for model, value in values.items():
            model.value = value
        self.moving = False

    def _set(self, indices: Mapping[int, int]) -> None:
        """Take the values of sliders that were moved, and move those that were not moved by hand."""
        for number, location in indices.items():
            self.positions[number], self.last = location, number
        self._put({self.handles[number]: location for number, location in indices.items()})
        self._moved()

    def _tapped(self, event: Any) -> None:
        """Set the sliders of both axes to where the region was clicked, if that is somewhere."""
        if not (is_number(event.x) and is_number(event.y)):
            return
        pairs = zip(self.chosen, (event.x, event.y), strict=False)
        self._set({number: position_of(self.sliders[number], at) for number, at in pairs})

    def _choose(self, axis: int, label: str) -> None:
        """Take another axis for the region."""
        self.chosen[axis] = [slider.label for slider in self.sliders].index(label)
        self._moved()

    def _moved(self) -> None:
        """Ask for everything anew."""
        overrides = self._overrides
        self._ask("verdict", overrides)
        if self.sliders:
            moved = self.sliders[self.last]
            others = tuple(override for override in overrides if override.free != moved.free)
            self._ask("roots", others, (moved.free, moved.values))
        self._ask_region(overrides)
        self._ask("motion", overrides, self.begins.value == STRUCK)
        self._request_transparency()
        self._untuned()
        for section in ("margins", "network"):
            self._ask(section, overrides)
        self.link.data = {"query": [self._query()]}

    def _request_transparency(self) -> None:
        """Request the transparency at the selected hand."""
        self._ask("transparency", self._overrides, self.at.value)

    def _ask_region(self, overrides: tuple[Override, ...]) -> None:
        """Ask for the region, if there are two axes: nobody waits for it where it takes long."""
        requested = self._request_region()
        if requested is None:
            for desk in self.desks:
                desk.forget("region")
            self.region.clear(SAME_AXES if self.chosen else NO_AXES)
            return
        if self.linear is None:
            return
        # A parameter on an axis covers its entire range there.
        others = tuple(
            override for override in overrides if override.free not in (requested[0].free, requested[1].free)
        )
        slow = self._slow(requested)
        self.desks[REGION if slow else LATER].forget("region")
        if self.desks[LATER if slow else REGION].ask(Task("region", others, requested)) and slow:
            self.region.clear(f"Computing, after all else: {slow}, which takes a while.")
        self.region.mark(
            *(float(self.sliders[number].values[self.positions[number]]) for number in self.chosen)
        )

    def _slow(self, requested: tuple[Range, Range, str]) -> str:
        """Return the reason why a region cannot be redrawn live; empty if it can."""
        x, y, criterion = requested
        if criterion == MEAN_SQUARE:
            return "it looks at packets as they are lost and late"
        if not self.at_once or (
            not self.linear and any(reaches_start(self.system, interval.free) for interval in (x, y))
        ):
            return "the topology is not linear, and is linearized at its start for each point by itself"
        if any(reaches_time(self.system, interval.free) for interval in (x, y)):
            return "as a time varies, each point has a schedule of its own"
        if any(reaches_count(self.system, interval.free) for interval in (x, y)):
            return "each number of peers is analysed by itself"
        return ""

    def _request_region(self) -> tuple[Range, Range, str] | None:
        """Return the axes of the region, and its stability criterion; None without two axes."""
        if len(set(self.chosen)) < 2:
            return None
        axes = axes_of(self.sliders, self.positions, (self.chosen[0], self.chosen[1]))
        return (*axes, NOMINAL if self.meant.value == LIVE else MEAN_SQUARE)

    def _ask(self, section: str, overrides: tuple[Override, ...], requested: Any = None) -> None:
        desk = next(desk for desk in self.desks if section in desk.order)
        desk.ask(Task(section, overrides, requested))

    def _close(self) -> None:
        """End those who compute for this tab."""
        for desk in self.desks:
            desk.close()

    def _query(self) -> str:
        """Return the part of the link that holds values and axes."""
        pairs = [
            (slider.label, slider.texts[index]) for slider, index in self._pairs() if index != slider.start
        ]
        pairs += [
            (name, self.sliders[number].label) for name, number in zip((X, Y), self.chosen, strict=False)
        ]
        return "".join(f"&{quote(name)}={quote(text, safe='')}" for name, text in pairs)

    def _next_tick(self, call: Any, seconds: float) -> None:
        """Call on the thread of the page, if the page is not closed by then."""
        with suppress(AttributeError):  # a document that Bokeh has destroyed has no list of callbacks
            if seconds:
                self.document.add_timeout_callback(call, round(1000 * seconds))
            else:
                self.document.add_next_tick_callback(call)

    def _deliver(self, section: str, answer: SectionAnswer) -> None:
        """Show the result of a section."""
        result = answer.result
        if section == "verdict" and self.linear is None:
            self.linear = result is not None and result["linear"]
            self.at_once = result is not None and result["at_once"]
            self._ask_region(self._overrides)
        if section == "region" and self.modes is not None:
            self._next_tick(lambda: self.roots.show(self.modes), FRAMES)
        if result is None:
            clearing = {
                "region": self.region.clear,
                "transparency": self.transparency.clear,
                "motion": self.motion.clear,
            }
            clearing.get(section, self._words(section).nothing)(answer.why)
            return
        match section:
            case "verdict":
                self.verdict.verdict(result)
                self.modes = result
                if self.desks[REGION].busy is None:
                    self.roots.show(result)
            case "roots":
                self.roots.path_of(result)
            case "region":
                self.region.show(result)
            case "motion":
                self.motion.show(result["motion"])
            case "transparency":
                self.transparency.show(result)
                self.held = result["names"]
                if len(self.held) > 1:
                    self.at.update(options=self.held, value=result["at"], visible=True)
            case "numbers":
                self._save_numbers(result)
            case _:
                self._words(section).table(result["text"])

    def _words(self, section: str) -> LiveText:
        words = {"verdict": self.verdict, "roots": self.roots.path_text}
        words |= {"margins": self.margins, "network": self.network, "tune": self.tuned}
        return words.get(section, self.message)


def _below(name: str, *models: Any, tags: Sequence[Any] = ()) -> Any:
    """Return models below each other, as wide as their place."""
    return column(*models, name=name, sizing_mode="stretch_width", tags=list(tags))
