"""The page: sliders and results, which are updated when sliders move.

Takes: a compiled model; a Bokeh document per tab.
Gives: `SharedState`, `topology_of`, `open_page`.
Guarantees: results correspond to the slider values, and an invalid value changes nothing. The server thread
does not compute. The link contains the values of moved sliders, and opening the link restores these values.
Does not: compute results (see `sections`).
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
    PEER_COUNTS,
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
from apc.app.worker_process import SectionWorker
from apc.app.yaml_edit import with_values
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.linearization.linearize import reaches_start
from apc.network.nominal_criterion import unreliable
from apc.output.formatting import Plain, json_text
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import Range
from apc.studies.evaluator import reaches_count, reaches_time
from apc.studies.stability_criteria import MEAN_SQUARE, NOMINAL
from apc.support.distribution import program_version
from apc.support.processes import model_bytes

# The worker processes and their sections, by priority: sections that are redrawn while a slider moves wait
# for no other section. A region whose points are analyzed one by one takes many seconds, and comes last.
VERDICT, REGION, LATER, TUNED = 0, 1, 2, 3
WORKER_SECTIONS = (
    ("verdict",),
    ("region",),
    ("numbers", "roots", "motion", "transparency", "margins", "network", "region"),
    ("tune",),
)
# Seconds (a few frames of a browser) after which eigenvalues are drawn if a region was drawn.
FRAMES = 0.05
# Arguments of the link: the parameters on the axes of the region. Names in a model have no hyphen.
X, Y = "x-axis", "y-axis"
STRUCK, BEGINS = "impulse on the first device", "initial state of the topology"
SAME_AXES = "A region has two different parameters: choose another one for an axis."
TUNES = "Determines the largest stable {} with {} free, and proves stability."
STUDIED = "Determines the gains of the study tune: of the topology, and proves stability."
NO_AXES = "A region has two parameters, and this topology has fewer with a range."
LIVE, SLOW = "nominal (every packet on time)", "mean-square (lossy network, slower)"

# The handles have the names and displayed values of their sliders, for screen readers.
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
# Browsers refuse more than a few changes of the link per second.
LINKED = """
clearTimeout(window.apc_link)
window.apc_link = setTimeout(() => {
  const token = new URLSearchParams(location.search).get('token')
  history.replaceState(null, '', '?token=' + encodeURIComponent(token) + link.data.query[0])
}, 250)
"""


# A download is sent to the page as a text, and saved by the page to a file.
SAVED = """
const [name, text] = [out.data.name[0], out.data.text[0]]
const link = document.createElement('a')
link.href = URL.createObjectURL(new Blob([text]))
link.download = name
link.click()
setTimeout(() => URL.revokeObjectURL(link.href), 1000)
"""
# A picture with the visible figures, one below the other.
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
    """Data common to all tabs: the model, also serialized, the sliders and the initial settings.

    `text` is the topology, None if there is only a compiled model.
    """

    model: Model
    serialized: bytes
    sliders: tuple[Slider, ...]
    settings: tuple[str, ...]
    text: str | None


def topology_of(model: Model, settings: Sequence[str], text: str | None) -> SharedState:
    """Return the data common to the tabs of a model.

    Parameters
    ----------
    model
        The model.
    settings
        Initial settings of sliders, each `NAME=QUANTITY`.
    text
        The text of the topology, None if there is only a compiled model.

    Raises
    ------
    ApcError
        E980 a parameter without a slider; and the errors of `overrides.parse_override` and `overrides.apply`.
    """
    sliders = sliders_of(model)
    pairs = [set_to(model, sliders, setting) for setting in settings]
    apply(model, [Override(sliders[index].free, value) for index, value in pairs])
    return SharedState(model, model_bytes(model), sliders, tuple(settings), text)


def open_page(topology: SharedState, document: Document) -> None:
    """Fill the document of a new tab."""
    TopologyTab(topology, document)


class TopologyTab:
    """One tab: its sliders and their positions, its figures, and its worker processes."""

    def __init__(self, topology: SharedState, document: Document) -> None:
        """Create the sliders, figures and workers of a tab, and request all results."""
        self.topology, self.model, self.document = topology, topology.model, document
        self.sliders, self.positions = list(topology.sliders), [slider.start for slider in topology.sliders]
        self.chosen = self._initial_axes()
        self.message = LiveText("message")
        self.message.model.text = ""
        for setting in topology.settings:
            self._set_initially(setting)
        self._read_link(document.session_context.request.arguments)
        self.verdict, self.margins, self.network = (
            LiveText("verdict"),
            LiveText("margins"),
            LiveText("network"),
        )
        self.tuned = LiveText("tuned")
        self.region, self.roots = RegionFigure(), RootsFigure()
        self.motion, self.transparency = MotionFigure(), TransparencyFigure()
        self.modes: Plain | None = None  # the eigenvalues of the newest verdict
        # Whether the model is linear, and batches of points can be analyzed: known from the first verdict.
        self.linear: bool | None = None
        self.at_once = False
        self.moving, self.last = False, self.chosen[0] if self.chosen else 0
        self.link = ColumnDataSource({"query": [""]})
        self.link.js_on_change("data", CustomJS(args={"link": self.link}, code=LINKED))
        self.workers = [
            SectionWorker(topology.serialized, order, self._next_tick, self._deliver)
            for order in WORKER_SECTIONS
        ]
        for first in (VERDICT, REGION):
            self.workers[first].precede(self.workers[LATER])
        self._lay_out()
        document.on_session_destroyed(lambda session_context: self._close())
        self._update_all()

    def _initial_axes(self) -> list[int]:
        """Return the initial sliders on the axes of the region; empty if fewer than two are possible."""
        numbers = [index for index, slider in enumerate(self.sliders) if slider.span is not None]
        return numbers[:2] if len(numbers) > 1 else []

    def _read_link(self, arguments: Mapping[str, list[bytes]]) -> None:
        """Set sliders and axes from the arguments of the link; invalid arguments are shown as a message."""
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
                    wrong.append(f"{text} cannot be an axis of the region")
            elif name != "bokeh-session-id" and (
                name != TOKEN or len(values) > 1
            ):  # a model parameter may have the name `token`
                try:
                    self._set_initially(f"{name}={text}")
                except ApcError as error:
                    wrong += [mistake.sentence for mistake in error.mistakes]
        if wrong:
            self.message.show_text("Invalid arguments of the link:", *wrong)

    def _set_initially(self, setting: str) -> None:
        """Set a slider before the page is shown; the value is added to the values of the slider."""
        index, value = set_to(self.model, self.sliders, setting)
        apply(self.model, [Override(self.sliders[index].free, value)])
        self.sliders[index], self.positions[index] = with_value(self.sliders[index], value)

    def _lay_out(self) -> None:
        """Create the controls, and add them with the figures to the document."""
        self.handles = [self._handle(index) for index in range(len(self.sliders))]
        names = [slider.label for slider in self.sliders if slider.span is not None]
        self.selects = [
            Select(title=f"Region: {axis} axis", value=self.sliders[index].label, options=names, width=250)
            for axis, index in zip(("horizontal", "vertical"), self.chosen, strict=False)
        ]
        for number, select in enumerate(self.selects):
            self._on_change(select, partial(is_member_of, names), partial(self._choose, number))
        self.region.plot.on_event(Tap, self._on_tap)
        duration = self.model.experiment.duration
        self.start_select = Select(
            title="Excitation",
            options=[STRUCK, BEGINS],
            value=BEGINS if duration else STRUCK,
            stylesheets=[FOCUS],
        )
        self._on_change(
            self.start_select, partial(is_member_of, (STRUCK, BEGINS)), lambda _: self._update_all()
        )
        self.criterion_select = Select(
            title="Stability criterion",
            options=[LIVE, SLOW],
            value=SLOW if unreliable(self.model) else LIVE,
            stylesheets=[FOCUS],
        )
        self._on_change(
            self.criterion_select, partial(is_member_of, (LIVE, SLOW)), lambda _: self._update_all()
        )
        self.device_select = Select(title="Device", visible=False, stylesheets=[FOCUS])
        self.held: list[str] = []
        self._on_change(
            self.device_select,
            lambda name: is_member_of(self.held, name),
            lambda _: self._request_transparency(),
        )
        controls: list[Any] = [self.message.model, *self.selects]
        if any(link.channel is not None for link in self.model.links):
            controls.append(self.criterion_select)
        controls.append(row(*self._buttons(), sizing_mode="stretch_width"))
        kinds = dict.fromkeys(slider.kind for slider in self.sliders)
        for kind in sorted(kinds, key=lambda kind: kind != PEER_COUNTS):  # numbers of peers come first
            heading = Div(text=f"<h2 style='font-size:15px;margin:10px 0 0'>{kind.capitalize()}</h2>")
            kind_handles = [
                handle
                for handle, slider in zip(self.handles, self.sliders, strict=True)
                if slider.kind == kind
            ]
            controls += [heading, *kind_handles]
        self.tune = Button(label="Tune", stylesheets=[FOCUS], name="tune", width=320)
        self.tune.on_click(self._start_tuning)
        motion, transparency = self.motion, self.transparency
        simulated = row(motion.simulation, motion.time, sizing_mode="stretch_width")
        # Texts are separate roots: a changed text in the same layout would redraw a figure.
        for part in (
            _column("controls", *controls, tags=[self.link, self.out]),
            self.region.plot,
            self.roots.plot,
            self.tune,
            self.tuned.model,
            _column("motion", self.start_select, motion.stage, simulated, motion.plot),
            _column("transparency", self.device_select, transparency.plot, transparency.phase),
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
        self.document.title = f"{self.model.name} · apc"
        self.document.template = files("apc.app").joinpath("page.html").read_text(encoding="utf-8")
        self.document.template_variables["description"] = self.model.description

    def _buttons(self) -> list[Button]:
        """Return the buttons for the download of the topology, the picture and the numbers."""
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
        name = f"{self.model.name}.png"
        picture.js_on_event("button_click", CustomJS(args={"plots": plots, "name": name}, code=PICTURED))
        numbers.on_click(self._request_numbers)
        return [topology, picture, numbers]

    def _save_topology(self) -> None:
        """Download the topology with the values of the sliders."""
        if self.topology.text is None:
            self.message.show_text("The topology of this compiled model is not available.")
            return
        values = {
            slider.free: slider.texts[index] for slider, index in self._pairs() if index != slider.start
        }
        try:
            text = with_values(self.topology.text, self.model, values)
        except ApcError as error:  # the number is in a table of peer values
            self.message.show_text(
                "The topology cannot be written:", *(item.sentence for item in error.mistakes)
            )
            return
        self.out.data = {"name": [f"{self.model.name}.yaml"], "text": [text]}

    def _request_numbers(self) -> None:
        """Request the numbers for download."""
        self.workers[LATER].cancel("numbers")  # a repeated request gives a second file
        self._request("numbers", self._overrides, self._region_request())

    def _tuning_request(self) -> tuple[tuple[str, ...], str] | None:
        """Return the ranges of the gains on the axes and the gain to maximize.

        The ranges are empty if a study specifies the gains; the result is None without axes.
        """
        if self.model.tune:
            return (), ""
        if (axes := self._region_request()) is None:
            return None
        spans = (
            f"{axis.free.label}={float(axis.low)!r} {axis.unit}:{float(axis.high)!r} {axis.unit}"
            for axis in axes[:2]
        )
        return tuple(spans), axes[0].free.label

    def _start_tuning(self) -> None:
        """Request the optimal gains for the present values of all other sliders."""
        if (request := self._tuning_request()) is not None:
            self.workers[TUNED].cancel("tune")  # a repeated request is computed again
            self.tuned.show_text("Computing …")
            self._request("tune", self._overrides, request)

    def _reset_tuning(self) -> None:
        """Replace the gains, which belong to other slider values, by the text of the objective."""
        self.workers[TUNED].cancel("tune")
        request = self._tuning_request()
        names = [self.sliders[number].label for number in self.chosen]
        self.tune.disabled = request is None
        self.tuned.show_text(NO_AXES if request is None else TUNES.format(*names) if request[0] else STUDIED)
        self.tune.label = f"Maximize {request[1]}" if request and request[1] else "Tune"

    def _save_numbers(self, result: Plain) -> None:
        """Download the results as JSON, with the slider values."""
        values = {slider.label: slider.texts[index] for slider, index in self._pairs()}
        answer = {"topology": self.model.name, "apc": program_version(), "set": values, **result}
        self.out.data = {"name": [f"{self.model.name}.json"], "text": [json_text(answer)]}

    @property
    def _overrides(self) -> tuple[Override, ...]:
        """The settings of the moved sliders."""
        return tuple(overrides_of(self.sliders, self.positions))

    def _pairs(self) -> list[tuple[Slider, int]]:
        """Return the sliders with their positions."""
        return list(zip(self.sliders, self.positions, strict=True))

    def _handle(self, index: int) -> Handle:
        """Return the browser slider of a parameter; its value is the index of the parameter value."""
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
        self._on_change(handle, partial(is_position, slider), lambda value: self._set({index: round(value)}))
        return handle

    def _on_change(
        self, model: Any, is_valid: Callable[[Any], bool], on_value: Callable[[Any], None]
    ) -> None:
        """Call a function for each change of a control's value in the browser; an invalid value is reset.

        Parameters
        ----------
        model
            The control, a slider or a selection, with a title and a value.
        is_valid
            The function that returns whether a value of any type is valid.
        on_value
            The function called with a valid value.
        """

        def on_change(attr: str, old: Any, new: Any) -> None:
            """Handle a change by the browser; changes by the page itself are ignored."""
            if self.moving:
                return
            if is_valid(new):
                on_value(new)
                return
            self._set_values({model: old})
            self.message.show_text(f"{model.title}: {new!r:.40} is invalid; the value is unchanged.")

        model.on_change("value", on_change)

    def _set_values(self, values: Mapping[Any, Any]) -> None:
        """Set the values of controls, without handling the changes as input."""
        self.moving = True
        for model, value in values.items():
            model.value = value
        self.moving = False

    def _set(self, positions: Mapping[int, int]) -> None:
        """Set the positions of sliders, by index, and update all sections."""
        for number, position in positions.items():
            self.positions[number], self.last = position, number
        self._set_values({self.handles[number]: position for number, position in positions.items()})
        self._update_all()

    def _on_tap(self, event: Any) -> None:
        """Set the sliders of both axes to the values at a click in the region."""
        if not (is_number(event.x) and is_number(event.y)):
            return
        pairs = zip(self.chosen, (event.x, event.y), strict=False)
        self._set({number: position_of(self.sliders[number], value) for number, value in pairs})

    def _choose(self, axis: int, label: str) -> None:
        """Set the parameter on an axis of the region, and update all sections."""
        self.chosen[axis] = [slider.label for slider in self.sliders].index(label)
        self._update_all()

    def _update_all(self) -> None:
        """Request the results of all sections for the present slider values."""
        overrides = self._overrides
        self._request("verdict", overrides, self._criterion)
        if self.sliders:
            slider = self.sliders[self.last]
            others = tuple(override for override in overrides if override.free != slider.free)
            self._request("roots", others, (slider.free, slider.values))
        self._update_region(overrides)
        self._request("motion", overrides, self.start_select.value == STRUCK)
        self._request_transparency()
        self._reset_tuning()
        for section in ("margins", "network"):
            self._request(section, overrides)
        self.link.data = {"query": [self._query()]}

    def _request_transparency(self) -> None:
        """Request the transparency at the selected hand."""
        self._request("transparency", self._overrides, self.device_select.value)

    def _update_region(self, overrides: tuple[Override, ...]) -> None:
        """Request the region for the present slider values if there are two axes."""
        request = self._region_request()
        if request is None:
            for worker in self.workers:
                worker.cancel("region")
            self.region.clear(SAME_AXES if self.chosen else NO_AXES)
            return
        if self.linear is None:
            return
        # A parameter on an axis covers its entire range there.
        others = tuple(
            override for override in overrides if override.free not in (request[0].free, request[1].free)
        )
        slow = self._reason_not_live(request)
        self.workers[REGION if slow else LATER].cancel("region")
        if self.workers[LATER if slow else REGION].submit(Task("region", others, request)) and slow:
            self.region.clear(f"Computing … ({slow}; after all other sections)")
        self.region.mark(
            *(float(self.sliders[number].values[self.positions[number]]) for number in self.chosen)
        )

    def _reason_not_live(self, request: tuple[Range, Range, str]) -> str:
        """Return the reason why a region cannot be updated while a slider moves; empty if it can."""
        x, y, criterion = request
        if criterion == MEAN_SQUARE:
            return "mean-square stability"
        if not self.at_once or (
            not self.linear and any(reaches_start(self.model, interval.free) for interval in (x, y))
        ):
            return "a nonlinear topology, linearized at the start for each point"
        if any(reaches_time(self.model, interval.free) for interval in (x, y)):
            return "a varied time, with one schedule per point"
        if any(reaches_count(self.model, interval.free) for interval in (x, y)):
            return "a varied number of peers, with one analysis per point"
        return ""

    def _region_request(self) -> tuple[Range, Range, str] | None:
        """Return the axes of the region and its stability criterion; None without two axes."""
        if len(set(self.chosen)) < 2:
            return None
        axes = axes_of(self.sliders, self.positions, (self.chosen[0], self.chosen[1]))
        return (*axes, self._criterion)

    @property
    def _criterion(self) -> str:
        """The selected stability criterion."""
        return NOMINAL if self.criterion_select.value == LIVE else MEAN_SQUARE

    def _request(self, section: str, overrides: tuple[Override, ...], request: Any = None) -> None:
        """Submit the task of a section to its worker."""
        worker = next(worker for worker in self.workers if section in worker.order)
        worker.submit(Task(section, overrides, request))

    def _close(self) -> None:
        """End the workers of this tab."""
        for worker in self.workers:
            worker.close()

    def _query(self) -> str:
        """Return the arguments of the link for the moved sliders and the axes."""
        pairs = [
            (slider.label, slider.texts[index]) for slider, index in self._pairs() if index != slider.start
        ]
        pairs += [
            (name, self.sliders[number].label) for name, number in zip((X, Y), self.chosen, strict=False)
        ]
        return "".join(f"&{quote(name)}={quote(text, safe='')}" for name, text in pairs)

    def _next_tick(self, call: Any, seconds: float) -> None:
        """Schedule a call in the server thread, unless the page is closed by then."""
        with suppress(AttributeError):  # a destroyed document of Bokeh has no list of callbacks
            if seconds:
                self.document.add_timeout_callback(call, round(1000 * seconds))
            else:
                self.document.add_next_tick_callback(call)

    def _deliver(self, section: str, answer: SectionAnswer) -> None:
        """Show the result of a section, or the reason if there is none."""
        result = answer.result
        if section == "verdict" and self.linear is None:
            self.linear = result is not None and result["linear"]
            self.at_once = result is not None and result["at_once"]
            self._update_region(self._overrides)
        if section == "region" and self.modes is not None:
            self._next_tick(lambda: self.roots.show(self.modes), FRAMES)
        if result is None:
            clearing = {
                "region": self.region.clear,
                "transparency": self.transparency.clear,
                "motion": self.motion.clear,
            }
            clearing.get(section, self._text_of(section).nothing)(answer.why)
            return
        match section:
            case "verdict":
                self.verdict.verdict(result)
                self.modes = result
                if self.workers[REGION].busy is None:
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
                    self.device_select.update(options=self.held, value=result["at"], visible=True)
            case "numbers":
                self._save_numbers(result)
            case _:
                self._text_of(section).table(result["text"])

    def _text_of(self, section: str) -> LiveText:
        """Return the text of the page that shows a section."""
        words = {"verdict": self.verdict, "roots": self.roots.path_text}
        words |= {"margins": self.margins, "network": self.network, "tune": self.tuned}
        return words.get(section, self.message)


def _column(name: str, *models: Any, tags: Sequence[Any] = ()) -> Any:
    """Return models as a column of the layout, with the full width."""
    return column(*models, name=name, sizing_mode="stretch_width", tags=list(tags))
