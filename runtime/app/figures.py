"""The figures of the page and their descriptions in words.

Takes: the results of `sections`.
Gives: `LiveText`; `RegionFigure`, `RootsFigure`, `MotionFigure`, `TransparencyFigure`; `FOCUS`.
Guarantees: each figure has a text alternative; no information is by color alone.
Does not: compute, or handle sliders.
"""

from __future__ import annotations

import math
from html import escape
from typing import Any

import numpy as np
from bokeh.models import (
    BasicTickFormatter,
    ColumnDataSource,
    CustomJS,
    CustomJSTickFormatter,
    Div,
    FixedTicker,
    HoverTool,
    Range1d,
    Slider,
    Toggle,
)
from bokeh.plotting import figure

from apc.app.motion import MM, ROWS, AnimationFrames
from apc.compiler.wording import counted
from apc.output.formatting import Plain, axis_label, capitalized
from apc.output.still_picture import THICKNESS

# Colors that are distinct in print and for color-blind readers: Okabe and Ito, 2008; the lightest two are
# darkened to the contrast of WCAG 2.1, 1.4.11, on white.
BLUE, ORANGE, GREY, INK = "#0072B2", "#D55E00", "#595959", "#1a1a1a"
COLOURS = (BLUE, ORANGE, "#009E73", "#CC79A7", "#000000", "#6A86E8", "#A87300", "#7F3C8D")
DASHES, DASH_WORDS = (
    ("solid", "dashed", "dotted", "dotdash"),
    ("solid", "dashed", "dotted", "dash-dotted"),
)
HEIGHT = 330
# Relative margins around the unit circle, around eigenvalues outside it, and around the motion of bodies.
ROUND, BEYOND, ROOM = 1.12, 1.05, 0.1
CIRCLE = np.exp(1j * np.linspace(0, 2 * np.pi, 241))

# The ratio of the ends of a logarithmic axis below which 2 and 5 of each decade are labelled, too.
DECADES = 100
# The vertical distance of the bodies of a peer, relative to the distance between two peers.
STAGGER = 0.3
# Height of a line of names, and length of an orientation bar, in pixels.
LINE, BAR = 13, 48
# Duration of the animation of a motion, in seconds.
SECONDS = 10
INSTANT = """
const time = frames.data.time
return time.length ? time[Math.min(Math.round(tick), time.length - 1)].toFixed(3) + ' s' : ''
"""
# The data are changed in place: the displayed instant belongs to this tab, and is not sent to the server.
SHOWING = """
const {time, x, y, angle} = frames.data // by time, then by body, one row behind the other
if (time.length) {
  const k = Math.min(Math.round(slider.value), time.length - 1)
  const count = x.length / time.length
  for (let body = 0; body < count; body++) {
    bodies.data.x[body] = x[k * count + body]
    bodies.data.y[body] = y[k * count + body]
    bodies.data.angle[body] = angle[k * count + body]
  }
  const c = contacts.data // from a body to the grasp point of another
  for (let i = 0; i < c.holder.length; i++) {
    const [a, b] = [c.holder[i], c.held[i]]
    const [cos, sin] = [Math.cos(bodies.data.angle[b]), Math.sin(bodies.data.angle[b])]
    c.x0[i] = bodies.data.x[a]
    c.y0[i] = bodies.data.y[a]
    c.x1[i] = bodies.data.x[b] + cos * c.arm_x[i] - sin * c.arm_y[i]
    c.y1[i] = bodies.data.y[b] + sin * c.arm_x[i] + cos * c.arm_y[i]
  }
  contacts.change.emit()
  instant.data.x[0] = time[k]
  bodies.change.emit()
  instant.change.emit()
  slider.properties.title.change.emit() // which shows the time
}
"""
PLAYING = f"""
clearInterval(window.apc_playing)
cb_obj.label = cb_obj.active ? 'Pause' : 'Play'
if (cb_obj.active) {{
  window.apc_playing = setInterval(() => {{
    const count = frames.data.time.length
    if (count) slider.value = (Math.round(slider.value) + 1) % count
  }}, {1000 * SECONDS} / {ROWS})
}}
"""
FOCUS = """
    :host { font: 13px/1.4 system-ui, sans-serif; color: #1a1a1a; }
    .noUi-handle:focus-visible, button:focus-visible, select:focus-visible
      { outline: 3px solid #0072B2; outline-offset: 1px; }
    .bk-btn { padding: 6px 2px; } /* three of them fit into a narrow window */
    .noUi-target { border-color: #767676; margin: 0 8px; }
    .noUi-handle { border-color: #595959; }
    """
STYLE = """
    :host { font: 14px/1.45 system-ui, sans-serif; color: #1a1a1a; }
    .bk-clearfix { display: block; min-width: 0; } /* a wide table scrolls, the page does not */
    p { margin: 0 0 6px; } pre { font-size: 12px; overflow-x: auto; margin: 6px 0; }
    @media (max-width: 1000px) { pre { font-size: 10.5px; } } /* 80 columns at 800 pixels */
    strong.unstable { color: #A03C00; } strong.stable { color: #00587A; }
    .old { opacity: .55; } .why { color: #5a2a00; }
    summary { cursor: pointer; } summary:focus-visible { outline: 2px solid #0072B2; }
    """


def _plot(name: str, **settings: Any) -> Any:
    """Return an empty figure with the common settings of all figures."""
    plot = figure(
        name=f"{name}-plot",
        height=HEIGHT,
        sizing_mode="stretch_width",
        tools="pan,wheel_zoom,box_zoom,reset,save",
        active_scroll=None,
        **settings,
    )
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_color = plot.axis.major_label_text_color = INK
    return plot


def _move_legend_out(plot: Any) -> None:
    """Move the legend outside of the plotting area."""
    legend = plot.legend[0]
    legend.update(orientation="horizontal", border_line_color=None, padding=0, label_text_color=INK)
    plot.center.remove(legend)
    plot.add_layout(legend, "above")


class LiveText:
    """A text of the page that screen readers read aloud when it changes."""

    def __init__(self, name: str) -> None:
        """Create the text with its name in the page."""
        self.model = Div(
            text="<p>Computing …</p>", name=name, stylesheets=[STYLE], sizing_mode="stretch_width"
        )

    def show_text(self, *lines: str) -> None:
        """Show lines of plain text."""
        self.model.text = "".join(f"<p>{escape(capitalized(line))}</p>" for line in lines)

    def verdict(self, result: Plain) -> None:
        """Show a verdict, the dominant mode, limitations and, collapsed, the output of `apc analyze`."""
        kind = {True: "stable", False: "unstable"}.get(result["stable"], "")
        self.model.text = (
            f"<p><strong class='{kind}'>{escape(result['verdict'])}</strong>, {result['measure']} "
            f"{result['radius']:.9g} per frame</p><p>{escape(result['limits'])}</p>"
            + "".join(f"<p>{escape(capitalized(item))}</p>" for item in result["notes"])
            + "<details><summary>All modes</summary>"
            f"<pre tabindex='0'>{escape(result['text'])}</pre></details>"
        )

    def table(self, text: str) -> None:
        """Show a text with aligned columns."""
        self.model.text = f"<pre tabindex='0'>{escape(text)}</pre>"

    def nothing(self, why: str) -> None:
        """Show the reason for a missing result."""
        self.model.text = f"<p class='why'>{escape(capitalized(why))}</p>"


class RegionFigure:
    """The stable region of two parameters, with a mark at the present values."""

    def __init__(self) -> None:
        self.plot = _plot("region", x_range=Range1d(0, 1), y_range=Range1d(0, 1))
        self.inside = ColumnDataSource({"xs": [], "ys": []})
        self.boundary = ColumnDataSource({"xs": [], "ys": []})
        self.point = ColumnDataSource({"x": [], "y": []})
        self.plot.multi_polygons(
            "xs",
            "ys",
            source=self.inside,
            fill_color=BLUE,
            fill_alpha=0.14,
            hatch_pattern="/",
            hatch_color=BLUE,
            hatch_alpha=0.25,
            hatch_scale=10,
            hatch_weight=0.7,
            line_width=0,
            legend_label="stable",
        )
        self.plot.multi_line("xs", "ys", source=self.boundary, line_color=BLUE, line_width=2)
        self.plot.scatter(
            "x",
            "y",
            source=self.point,
            size=13,
            marker="circle_cross",
            line_color="#000000",
            fill_color="#ffffff",
            line_width=2,
            legend_label="present values",
        )
        _move_legend_out(self.plot)
        self.plot.visible = False
        self.words = LiveText("region-words")

    def show(self, result: Plain) -> None:
        """Draw a region."""
        self.plot.visible = True
        outlines = [np.asarray(item) for item in result["outlines"]]
        rings = {
            axis: [[[outline[:, n] for outline in outlines]]] if outlines else []
            for n, axis in enumerate(("xs", "ys"))
        }
        self.inside.data = rings
        self.boundary.data = {
            "xs": [item[:, 0] for item in result["curves"]],
            "ys": [item[:, 1] for item in result["curves"]],
        }
        for axis, span, which in (
            (self.plot.xaxis, self.plot.x_range, result["x"]),
            (self.plot.yaxis, self.plot.y_range, result["y"]),
        ):
            label, unit, low, high = which
            axis.axis_label = axis_label(label, unit)
            span.update(start=low, end=high)
        steps = (
            ("The boundary is interpolated linearly between the edges of its cells.",)
            if result["stepped"]
            else ()
        )
        self.words.show_text(
            f"Stable in {100 * result['share']:.3g} % of the rectangle.", *steps, *result["notes"]
        )

    def clear(self, why: str) -> None:
        """Hide the region, and show the reason."""
        self.plot.visible = False
        self.inside.data = self.boundary.data = {"xs": [], "ys": []}
        self.words.nothing(why)

    def mark(self, x: float, y: float) -> None:
        """Mark the present values of the parameters."""
        if self.point.data != (data := {"x": [x], "y": [y]}):
            self.point.data = data


class RootsFigure:
    """Eigenvalues and the unit circle, with the root locus over the range of a slider."""

    def __init__(self) -> None:
        self.plot = _plot(
            "roots",
            x_range=Range1d(-ROUND, ROUND),
            y_range=Range1d(-ROUND, ROUND),
            x_axis_label="real part",
            y_axis_label="imaginary part",
            tooltips=[("mode", "@name"), ("eigenvalue", "@x + @y i")],
        )
        self.now = ColumnDataSource({"x": [], "y": [], "name": []})
        self.path = ColumnDataSource({"x": [], "y": [], "name": []})
        self.plot.line(CIRCLE.real, CIRCLE.imag, line_color=GREY, line_width=1.5)
        self.plot.scatter(
            "x", "y", source=self.path, size=3, fill_color=BLUE, line_color=None, legend_label="root locus"
        )
        self.plot.scatter(
            "x",
            "y",
            source=self.now,
            size=10,
            marker="x",
            line_color=ORANGE,
            line_width=2,
            legend_label="present values",
        )
        # Equal width and height, so that the circle is round.
        self.plot.update(sizing_mode="fixed", width=HEIGHT + 30, height=HEIGHT + 30)
        _move_legend_out(self.plot)
        self.plot.visible = False
        self.words, self.path_text = LiveText("roots-words"), LiveText("locus-words")
        self.path_text.show_text("Move a slider to draw the root locus over its range.")

    def show(self, result: Plain) -> None:
        """Draw the eigenvalues of an analysis."""
        self.plot.visible = True
        self.now.data = {"x": result["real"], "y": result["imag"], "name": result["names"]}
        size = BEYOND * float(np.hypot(result["real"], result["imag"]).max(initial=0.0))
        reach = max(ROUND, size)
        self.plot.x_range.update(start=-reach, end=reach)
        self.plot.y_range.update(start=-reach, end=reach)
        outside = int((np.hypot(result["real"], result["imag"]) > 1).sum())
        self.words.show_text(
            f"{counted(len(result['real']), 'eigenvalue')}, {outside} outside the unit circle."
        )

    def path_of(self, result: Plain) -> None:
        """Draw the root locus: the eigenvalues over the range of a slider."""
        self.path.data = {"x": result["real"], "y": result["imag"], "name": result["name"]}
        self.path_text.show_text(
            f"Dots: root locus for {result['slider']} from {result['from']} to {result['to']}."
        )


class MotionFigure:
    """The response over time, and an animation of the moving bodies."""

    def __init__(self) -> None:
        self.lines = ColumnDataSource(columns("xs", "ys", "colour", "dash", "name"))
        self.instant = ColumnDataSource({"x": [0.0]})
        self.frames = ColumnDataSource(columns("time", "x", "y", "angle"))
        self.bodies = ColumnDataSource(
            columns("x", "y", "angle", "width", "height", "bar", "name", "above", "colour")
        )
        self.contacts = ColumnDataSource(columns("x0", "y0", "x1", "y1", "holder", "held", "arm_x", "arm_y"))
        self.walls = ColumnDataSource(columns("x", "top", "bottom"))
        self.discs = ColumnDataSource(columns("x", "y", "radius"))
        self.plot = _plot(
            "response",
            x_axis_label="time [s]",
            y_axis_label="position [mm]",
            x_range=Range1d(0, 1),
            y_range=Range1d(0, 1),
        )
        self.plot.multi_line(
            "xs", "ys", source=self.lines, line_color="colour", line_dash="dash", line_width=2
        )
        self.plot.vspan("x", source=self.instant, line_color="#000000", line_dash="dotted")
        self.plot.add_tools(HoverTool(tooltips=[("", "@name")]))
        self.stage = _plot(
            "stage", x_axis_label="position [mm]", x_range=Range1d(0, 1), y_range=Range1d(0, 1)
        )
        self.rows = FixedTicker()
        self.stage.vbar("x", 0.0, "top", "bottom", source=self.walls, line_color="#404040", line_width=4)
        self.stage.circle(
            "x", "y", radius="radius", source=self.discs, fill_color="#d0d0d0", line_color="#404040"
        )
        self.stage.rect(
            "x",
            "y",
            "width",
            "height",
            angle="angle",
            source=self.bodies,
            fill_color="colour",
            fill_alpha=0.3,
            line_color="#000000",
        )
        bar = {"marker": "dash", "size": "bar", "angle": "angle", "line_color": "colour", "line_width": 3}
        self.stage.scatter("x", "y", source=self.bodies, **bar)  # the orientation of rotating bodies
        self.stage.segment("x0", "y0", "x1", "y1", source=self.contacts, line_color=INK, line_width=1.5)
        self.stage.scatter("x", "y", source=self.bodies, size=9, fill_color="colour", line_color="#000000")
        self.stage.text(
            "x",
            "y",
            "name",
            source=self.bodies,
            y_offset="above",
            text_align="left",
            text_baseline="bottom",
            x_offset=8,
            text_font_size="11px",
            text_color=INK,
        )
        self.time = Slider(
            start=0,
            end=ROWS - 1,
            step=1,
            value=0,
            title="time",
            name="time",
            tooltips=False,
            sizing_mode="stretch_width",
            stylesheets=[FOCUS],
            format=CustomJSTickFormatter(args={"frames": self.frames}, code=INSTANT),
        )
        showing = CustomJS(
            args={
                "slider": self.time,
                "frames": self.frames,
                "bodies": self.bodies,
                "contacts": self.contacts,
                "instant": self.instant,
            },
            code=SHOWING,
        )
        self.time.js_on_change("value", showing)
        self.frames.js_on_change("data", showing)
        self.simulation = Toggle(label="Play", width=90, stylesheets=[FOCUS])
        self.simulation.js_on_change(
            "active", CustomJS(args={"slider": self.time, "frames": self.frames}, code=PLAYING)
        )
        self._visible(False)
        self.words = LiveText("motion-words")

    def show(self, motion: AnimationFrames) -> None:
        """Draw a motion, and the bodies at the displayed time."""
        self._visible(True)
        peers, names = (
            list(dict.fromkeys(item))
            for item in zip(*((peer, body.name) for peer, body in motion.bodies), strict=True)
        )
        colours = [COLOURS[peers.index(peer) % len(COLOURS)] for peer, _ in motion.bodies]
        labels = [f"{peer}.{body.name}" for peer, body in motion.bodies]
        x, y = motion.x, motion.y
        self.lines.data = {
            "xs": [motion.time for _ in labels],
            "ys": [*x.T],
            "colour": colours,
            "dash": [DASHES[names.index(body.name) % len(DASHES)] for _, body in motion.bodies],
            "name": labels,
        }
        planar = y is not None
        if y is None:
            rows = [peers.index(peer) + STAGGER * names.index(body.name) for peer, body in motion.bodies]
            y = np.tile(rows, (len(x), 1))
        sizes = [MM * body.radius for _, body in motion.bodies]
        boxes = {held: np.abs(arm) for _, held, arm in motion.contacts if motion.bodies[held][1].turning}
        boxes = {held: np.maximum(arm, THICKNESS * arm.max()) for held, arm in boxes.items() if arm.any()}
        half = [boxes.get(index, (size, size)) for index, size in enumerate(sizes)]
        self.bodies.data = {
            "x": x[0],
            "y": y[0],
            "angle": motion.angle[0],
            "bar": [
                BAR if body.turning and index not in boxes else 0
                for index, (_, body) in enumerate(motion.bodies)
            ],
            "width": [2 * width for width, _ in half],
            "height": [2 * height if planar else 0.5 * (height > 0) for _, height in half],
            "name": labels if planar else [body.name for _, body in motion.bodies],
            # In a plane bodies may coincide; their names are shown on separate lines.
            "above": [-8 - LINE * index if planar else 7 for index in range(len(labels))],
            "colour": colours,
        }
        fixed = [position for _, position in motion.walls]
        self.walls.data = {
            "x": fixed,
            "top": [row + 0.45 for row, _ in motion.walls],
            "bottom": [row - 0.45 for row, _ in motion.walls],
        }
        self.discs.data = {
            name: [disc[n] for disc in motion.discs] for n, name in enumerate(("x", "y", "radius"))
        }
        holders, held, arms = zip(*motion.contacts, strict=True) if motion.contacts else ((), (), ())
        ends = {name: np.zeros(len(held)) for name in ("x0", "y0", "x1", "y1")}
        arm_x, arm_y = np.reshape(arms, (-1, 2)).T
        self.contacts.data = ends | {
            "holder": np.array(holders, dtype=np.int32),
            "held": np.array(held, dtype=np.int32),
            "arm_x": arm_x,
            "arm_y": arm_y,
        }
        self.frames.data = {"time": motion.time, "x": x, "y": y, "angle": motion.angle}
        reach = max([*sizes, *(float(np.hypot(*box)) for box in boxes.values())])
        low, high = min([x.min() - reach, *fixed]), max([x.max() + reach, *fixed])
        margin = ROOM * (high - low) or 1.0
        self.plot.x_range.update(start=0.0, end=float(motion.time[-1]))
        self.plot.y_range.update(start=float(x.min()) - margin, end=float(x.max()) + margin)
        self.stage.x_range.update(start=low - margin, end=high + margin)
        if planar:
            self.stage.y_range.update(
                start=float(y.min()) - reach - margin, end=float(y.max()) + reach + margin
            )
            self.stage.yaxis.axis_label = "position [mm]"
        else:
            self.stage.y_range.update(start=len(peers) - 0.3, end=-0.5)
            if (
                self.stage.yaxis[0].ticker is not self.rows
            ):  # a new ticker would cause a traversal of all models
                self.stage.yaxis.ticker = self.rows
            self.rows.ticks = list(range(len(peers)))
            self.stage.yaxis.major_label_overrides = dict(enumerate(peers))
        slower = SECONDS / float(motion.time[-1])
        legend = "; ".join(f"{name} {word}" for name, word in zip(names, DASH_WORDS, strict=False))
        times = f"{max(slower, 1 / slower):.2g}"
        pace = "in real time"
        if times != "1":
            pace = f"{times} times {'slower' if slower > 1 else 'faster'} than real time"
        self.words.show_text(
            *motion.remarks,
            f"Colors: peers. Lines: {legend}. Animation {pace}.",
            *([f"{motion.others} more peers are not shown."] if motion.others else []),
        )

    def clear(self, why: str) -> None:
        """Hide the motion, and show the reason."""
        self._visible(False)
        self.words.nothing(why)

    def _visible(self, visible: bool) -> None:
        """Show or hide all parts of the figure."""
        for item in (self.stage, self.simulation, self.time, self.plot):
            item.visible = visible


class TransparencyFigure:
    """The impedance at a hand's device, force divided by velocity, over frequency."""

    def __init__(self) -> None:
        self.source = ColumnDataSource(columns("frequency", "magnitude", "phase"))
        self.plot = _plot(
            "transparency",
            x_axis_type="log",
            y_axis_type="log",
            y_axis_label="impedance [N·s/m]",
            x_range=Range1d(0.1, 60),
            y_range=Range1d(1, 100),
        )
        self.phase = _plot(
            "phase",
            x_axis_type="log",
            x_axis_label="frequency [Hz]",
            y_axis_label="phase [°]",
            x_range=self.plot.x_range,
            y_range=Range1d(-180, 180),
        )
        self.plot.height, self.phase.height = 2 * HEIGHT // 3, HEIGHT // 2
        for plot, column in ((self.plot, "magnitude"), (self.phase, "phase")):
            plot.line("frequency", column, source=self.source, line_color=BLUE, line_width=2)
            plot.add_tools(HoverTool(tooltips=[("Hz", "@frequency"), (column, f"@{column}")], mode="vline"))
        self.phase.yaxis.ticker = [-180, -90, 0, 90, 180]
        self.plot.visible = self.phase.visible = False
        self.frequencies, self.magnitudes = FixedTicker(), FixedTicker()
        self.plot.yaxis.ticker = self.magnitudes
        self.plot.xaxis.ticker = self.phase.xaxis.ticker = self.frequencies
        for axis in (*self.plot.axis, *self.phase.xaxis):
            axis.formatter = BasicTickFormatter(use_scientific=False)
        self.words = LiveText("transparency-words")

    def show(self, result: Plain) -> None:
        """Draw the impedance: magnitude and phase."""
        self.plot.visible = self.phase.visible = True
        self.source.data = {name: result[name] for name in ("frequency", "magnitude", "phase")}
        f, size = result["frequency"], result["magnitude"]
        self.plot.x_range.update(start=f[0], end=f[-1])
        smallest, largest = size[size > 0].min(initial=size.max()) or 1.0, size.max() or 1.0
        margin = max((largest / smallest) ** ROOM, 1 + ROOM)  # on a logarithmic axis
        self.plot.y_range.update(start=smallest / margin, end=largest * margin)
        self.frequencies.ticks = decade_ticks(f[0], f[-1])
        self.magnitudes.ticks = decade_ticks(smallest / margin, largest * margin)
        self.words.show_text(
            f"At {result['at']}: {size[0]:.4g} N·s/m at {f[0]:.3g} Hz,"
            f" {size[-1]:.4g} N·s/m at {f[-1]:.3g} Hz.",
            *result["notes"],
        )

    def clear(self, why: str) -> None:
        """Hide the impedance, and show the reason."""
        self.plot.visible = self.phase.visible = False
        self.source.data = columns("frequency", "magnitude", "phase")
        self.words.nothing(why)


def decade_ticks(low: float, high: float) -> list[float]:
    """Return the labelled values of a logarithmic axis: 1, 2 and 5 of each decade, 1 of more than two."""
    mantissas = (1, 2, 5) if high < DECADES * low else (1,)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [float(f"{mantissa}e{power}") for power in powers for mantissa in mantissas]
    return [tick for tick in ticks if low <= tick <= high]


def columns(*names: str) -> dict[str, list[Any]]:
    """Return empty columns of a data source."""
    return {name: [] for name in names}
