"""The picture of `apc bench`: error against time, a panel a task.

Takes: a `Bench`. Gives: `draw_bench`, `save_bench`.
Guarantees: every point is named; the Pareto front is a line of steps, the default a filled mark.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from apc.benchmark.bench import SAME, Bench, Comparison
from apc.optional import need
from apc.simulation.figures import write_figure

Box = tuple[float, ...]  # left, bottom, right, top, in pixels

WIDTH, HEIGHT = 4.6, 3.6  # inches, of a panel
LEAST = 1e-17  # where an error of zero is drawn
FRONT, OTHER, CHOSEN = "#0072B2", "#555555", "#D55E00"  # distinct for colour-blind eyes (Okabe and Ito, 2008)
ROOM = 0.12  # of an axis: kept free at its ends for names
# Where a name may stand beside its point, the first that is free: (right, up) in points, and what of the name
# is there.
PLACES = tuple(
    (right * (6 if right else 0), up, {1: "left", -1: "right", 0: "center"}[right])
    for up in (3, -7, 9, -13, 15, -19, 21, -25)
    for right in (1, -1, 0)
    if right or abs(up) > 3
)
SPAN = 12.0  # from end to end of an axis at the least: one power of ten is named on it
CLEAR = 3.0  # points: about a mark, where no name may stand


def draw_bench(found: Bench) -> Any:
    """Draw every task that has errors; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    figure = figures.Figure(figsize=(WIDTH * len(found.comparisons), HEIGHT), layout="constrained")
    axes = figure.subplots(1, len(found.comparisons), squeeze=False)[0]
    for ax, one in zip(axes, found.comparisons, strict=True):
        _panel(ax, one)
    figure.suptitle(f"{found.topology}: error against time", fontsize=11)
    figure.draw_without_rendering()  # names are placed where the panels will be
    for ax, one in zip(axes, found.comparisons, strict=True):
        _name_points(ax, one)
    return figure


def save_bench(found: Bench, path: Path) -> None:
    """Draw to a file whose suffix says the format. Raises ApcError if it can't be written."""
    write_figure(draw_bench(found), path)


def _panel(ax: Any, found: Comparison) -> None:
    ax.set_title(f"apc {found.task}", fontsize=10)
    ax.set_xlabel("median time [s]")
    ax.set_ylabel(f"error of the {found.quantity}", fontsize=9)
    points = [one for one in found.measured if one.error is not None]
    if not points:
        why = "no reference" if found.measured else found.reference
        ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center")
        return
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.grid(True, which="major", linewidth=0.4, alpha=0.6)
    front = [one for one in points if one.front]
    ax.step(
        [one.seconds for one in front],
        [max(one.error or 0.0, LEAST) for one in front],
        where="post",
        color=FRONT,
        linewidth=1,
        zorder=1,
    )
    for one in points:
        size = max(one.error or 0.0, LEAST)
        colour = CHOSEN if one.chosen else FRONT if one.front else OTHER
        ax.errorbar(
            one.seconds, size, xerr=min(one.spread, 0.9 * one.seconds), color=colour, linewidth=0.8, zorder=2
        )
        ax.plot(
            one.seconds,
            size,
            "o",
            color=colour,
            markerfacecolor=colour if one.chosen else "white",
            markersize=5,
        )
    if max(one.error or 0.0 for one in points) < SAME:
        ax.axhline(SAME, color=OTHER, linewidth=0.8, linestyle=":")
        ax.text(
            0.02,
            0.97,
            "errors below the dotted line are roundings",
            transform=ax.transAxes,
            va="top",
            fontsize=7,
        )
    ax.margins(ROOM)
    for low, high, set_limits in ((*ax.get_xlim(), ax.set_xlim), (*ax.get_ylim(), ax.set_ylim)):
        more = max(SPAN * low / high, 1.0) ** 0.5
        set_limits(low / more, high * more)
    ax.xaxis.set_minor_formatter("")
    ax.yaxis.set_minor_formatter("")


def _name_points(ax: Any, found: Comparison) -> None:
    """Write each point's name beside it, over no mark and no other name, within the axes."""
    points = [one for one in found.measured if one.error is not None]
    marks = [ax.transData.transform((one.seconds, max(one.error or 0.0, LEAST))) for one in points]
    clear = CLEAR * ax.figure.dpi / 72
    taken = [(x - clear, y - clear, x + clear, y + clear) for x, y in marks]
    taken += [tuple(text.get_window_extent().extents) for text in ax.texts]
    frame = tuple(ax.get_window_extent().extents)
    for one in points:
        name = ax.annotate(
            one.name + (" (default)" if one.chosen else ""),
            (one.seconds, max(one.error or 0.0, LEAST)),
            xytext=(0, 0),
            textcoords="offset points",
            fontsize=7,
        )
        for right, up, side in PLACES:
            name.set_position((right, up))
            name.set_horizontalalignment(side)
            box = tuple(name.get_window_extent().extents)
            if _within(box, frame) and not any(_overlap(box, other) for other in taken):
                break
        taken.append(tuple(name.get_window_extent().extents))


def _within(box: Box, frame: Box) -> bool:
    return frame[0] < box[0] and frame[1] < box[1] and box[2] < frame[2] and box[3] < frame[3]


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
