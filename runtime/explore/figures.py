"""The figures of the page, and the words beside them.

Takes: what `sections` tell.
Gives: `Words`; `RegionFigure`, `RootsFigure`.
Guarantees: what a figure shows stands beside it in words, for whoever does not see it; nothing is told by
colour alone.
Does not: compute, or know sliders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Div, InlineStyleSheet, Range1d
from bokeh.plotting import figure

# Colours that are distinct in print and for colour-blind eyes: Okabe and Ito, 2008.
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#595959"
HEIGHT = 330
# Room around the unit circle, and around eigenvalues beyond it.
ROUND, BEYOND = 1.12, 1.05
CIRCLE = np.exp(1j * np.linspace(0, 2 * np.pi, 241))

STYLE = InlineStyleSheet(
    css="""
    :host { font: 14px/1.45 system-ui, sans-serif; color: #1a1a1a; }
    p { margin: 0 0 6px; } pre { font-size: 12px; overflow-x: auto; margin: 6px 0; }
    strong.unstable { color: #A03C00; } strong.stable { color: #00587A; }
    .old { opacity: .55; } .why { color: #5a2a00; }
    summary { cursor: pointer; } summary:focus-visible { outline: 2px solid #0072B2; }
    """
)


def _plot(**settings: Any) -> Any:
    """Return a figure as all are: as wide as its place, with few tools."""
    plot = figure(
        height=HEIGHT,
        sizing_mode="stretch_width",
        tools="pan,wheel_zoom,box_zoom,reset,save",
        active_scroll=None,
        **settings,
    )
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_color = plot.axis.major_label_text_color = "#1a1a1a"
    return plot


class Words:
    """A text of the page, which is read aloud when it changes."""

    def __init__(self, name: str) -> None:
        self.model = Div(text="<p>Computing …</p>", name=name, stylesheets=[STYLE], sizing_mode="stretch_width")

    def say(self, *lines: str) -> None:
        """Show lines, as they are."""
        self.model.text = "".join(f"<p>{escape(line)}</p>" for line in lines)

    def verdict(self, found: Mapping[str, Any]) -> None:
        """Show a verdict, what limits it, and behind a lid all that `apc analyze` prints."""
        kind = {True: "stable", False: "unstable"}.get(found["stable"], "")
        self.model.text = (
            f"<p><strong class='{kind}'>{escape(found['verdict'])}</strong>, spectral radius "
            f"{found['radius']:.9g} per frame</p><p>{escape(found['limits'])}</p>"
            f"<details><summary>All modes</summary><pre tabindex='0'>{escape(found['text'])}</pre></details>"
        )

    def table(self, text: str) -> None:
        """Show a text whose columns stand below each other."""
        self.model.text = f"<pre tabindex='0'>{escape(text)}</pre>"

    def nothing(self, why: str) -> None:
        """Say why there is nothing to show."""
        self.model.text = f"<p class='why'>{escape(why)}</p>"


class RegionFigure:
    """The stable region of two parameters, and where in it the scene is."""

    def __init__(self) -> None:
        self.plot = _plot(x_range=Range1d(0, 1), y_range=Range1d(0, 1), name="region")
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
            legend_label="the sliders",
        )
        self.plot.legend.background_fill_alpha = 0.8
        self.words = Words("region-words")

    def show(self, found: Mapping[str, Any]) -> None:
        """Draw a region."""
        outlines = [np.asarray(one) for one in found["outlines"]]
        rings = {axis: [[[one[:, n] for one in outlines]]] if outlines else [] for n, axis in enumerate(("xs", "ys"))}
        self.inside.data = rings
        self.boundary.data = {
            "xs": [one[:, 0] for one in found["curves"]],
            "ys": [one[:, 1] for one in found["curves"]],
        }
        for axis, span, which in (
            (self.plot.xaxis, self.plot.x_range, found["x"]),
            (self.plot.yaxis, self.plot.y_range, found["y"]),
        ):
            label, unit, low, high = which
            axis.axis_label = label if unit == "1" else f"{label} [{unit.replace('*', '·')}]"
            span.update(start=low, end=high)
        steps = ("Between the edges of its cells the boundary is drawn straight.",) if found["stepped"] else ()
        self.words.say(f"Stable in {100 * found['share']:.4g} % of what is shown.", *steps, *found["notes"])

    def clear(self, why: str) -> None:
        """Show no region, and why."""
        self.inside.data = self.boundary.data = {"xs": [], "ys": []}
        self.words.nothing(why)

    def mark(self, x: float, y: float) -> None:
        """Mark where the scene is."""
        self.point.data = {"x": [x], "y": [y]}


class RootsFigure:
    """Eigenvalues over the unit circle, and the way they take as a slider moves."""

    def __init__(self) -> None:
        self.plot = _plot(
            x_range=Range1d(-ROUND, ROUND),
            y_range=Range1d(-ROUND, ROUND),
            x_axis_label="real part",
            y_axis_label="imaginary part",
            match_aspect=True,
            name="roots",
            tooltips=[("mode", "@name"), ("eigenvalue", "@x + @y i")],
        )
        self.now = ColumnDataSource({"x": [], "y": [], "name": []})
        self.way = ColumnDataSource({"x": [], "y": [], "name": [], "share": []})
        self.plot.line(CIRCLE.real, CIRCLE.imag, line_color=GREY, line_width=1.5)
        self.plot.scatter(
            "x", "y", source=self.way, size=3, fill_color=BLUE, line_color=None, legend_label="as it moves"
        )
        self.plot.scatter(
            "x", "y", source=self.now, size=10, marker="x", line_color=ORANGE, line_width=2, legend_label="now"
        )
        self.words = Words("roots-words")

    def show(self, found: Mapping[str, Any]) -> None:
        """Draw the eigenvalues of an analysis."""
        self.now.data = {"x": found["real"], "y": found["imag"], "name": found["names"]}
        size = BEYOND * float(np.hypot(found["real"], found["imag"]).max(initial=0.0))
        reach = max(ROUND, size)
        self.plot.x_range.update(start=-reach, end=reach)
        self.plot.y_range.update(start=-reach, end=reach)
        outside = int((np.hypot(found["real"], found["imag"]) > 1).sum())
        self.words.say(f"{len(found['real'])} eigenvalues, {outside} of them outside the unit circle.")


def columns(names: Sequence[str]) -> dict[str, list[Any]]:
    """Return empty columns."""
    return {name: [] for name in names}
