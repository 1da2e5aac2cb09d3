"""A scene's graph as PNG or PDF: what `apc show` writes as SVG, drawn by matplotlib.

Takes: a topology's path. Gives: `graph_picture`, `save_graph`.
Guarantees: the marks stand where they stand in the SVG, a unit of the page being 1/96 inch.
Does not: place anything (see `compiler.view.picture`).

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from apc.compiler.view.listing import show_page
from apc.compiler.view.svg import Box, Dot, Line, Mark, Picture, Text
from apc.optional import need
from apc.present.pictures import check_format, write_figure

INCH, POINT = 96.0, 96.0 / 72.0  # units of the page
DASHES = (0, (5 / POINT, 3 / POINT))
HEAD = (7.0, 3.5)  # of an arrow: length, half of its width


def save_graph(topology: Path, path: Path) -> None:
    """Draw the graph of a topology into a file, its format chosen by the suffix.

    Raises
    ------
    ApcError
        The topology is at fault; E878 no such format, E601 it can't be written, E875 matplotlib is missing.
    """
    check_format(path, "--out")
    write_figure(graph_picture(show_page(topology)), path)


def graph_picture(page: Picture) -> Any:
    """Draw a page of marks; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    figure = figures.Figure(figsize=(page.width / INCH, page.height / INCH))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    ax.set_xlim(0, page.width)
    ax.set_ylim(page.height, 0)
    for order, mark in enumerate(page.marks):
        _draw(ax, mark, order)
    return figure


def _draw(ax: Any, mark: Mark, order: int) -> None:
    """Draw a mark over those before it."""
    patches = need("matplotlib.patches", "plot")
    paths = need("matplotlib.path", "plot")
    match mark:
        case Text():
            side, weight = "center" if mark.middle else "left", "bold" if mark.bold else "normal"
            look = {
                "fontsize": mark.size / POINT,
                "color": mark.colour,
                "fontweight": weight,
                "zorder": order,
            }
            ax.text(mark.x, mark.y, mark.text, ha=side, va="baseline", parse_math=False, **look)
        case Box():
            round_ = min(mark.round, mark.width / 2, mark.height / 2)
            style = patches.BoxStyle("Round", pad=0, rounding_size=round_)
            dash = DASHES if mark.dashed else "-"
            look = {
                "facecolor": mark.fill,
                "edgecolor": mark.stroke,
                "linewidth": 1.3 / POINT,
                "zorder": order,
            }
            corner = (mark.x, mark.y)
            box = patches.FancyBboxPatch(
                corner, mark.width, mark.height, boxstyle=style, linestyle=dash, **look
            )
            ax.add_patch(box)
        case Dot():
            look = {
                "facecolor": mark.fill,
                "edgecolor": mark.stroke,
                "linewidth": 0.8 / POINT,
                "zorder": order,
            }
            ax.add_patch(patches.Circle((mark.x, mark.y), mark.radius, **look))
        case Line():
            path = paths.Path(mark.points)
            (x0, y0), (x1, y1) = mark.points[0], mark.points[-1]
            if mark.curved:
                half = (x1 - x0) / 2
                codes = [paths.Path.MOVETO, *[paths.Path.CURVE4] * 3]
                path = paths.Path([(x0, y0), (x0 + half, y0), (x1 - half, y1), (x1, y1)], codes)
            dash = DASHES if mark.dashed else "-"
            look = {
                "edgecolor": mark.colour,
                "linewidth": mark.width / POINT,
                "linestyle": dash,
                "zorder": order,
            }
            ax.add_patch(patches.PathPatch(path, facecolor="none", **look))
            for x, y, way in ((x0, y0, 1), (x1, y1, -1)) if mark.arrows else ():
                tip = [(x, y), (x + HEAD[0] * way, y - HEAD[1]), (x + HEAD[0] * way, y + HEAD[1])]
                ax.add_patch(patches.Polygon(tip, facecolor=mark.colour, edgecolor="none", zorder=order))
