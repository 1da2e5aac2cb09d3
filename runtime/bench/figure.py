"""The picture of `apc bench`: error against time, a panel a task.

Takes: a `Bench`. Gives: `draw_bench`, `save_bench`.
Guarantees: every point is named; the Pareto front is a line of steps, the default a filled mark.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from apc.runtime.bench.bench import SAME, Bench, Comparison
from apc.runtime.simulate.figures import write_figure
from apc.runtime.simulate.trajectory import need

WIDTH, HEIGHT = 4.6, 3.6  # inches, of a panel
LEAST = 1e-17  # where an error of zero is drawn
FRONT, OTHER, CHOSEN = "#0072B2", "#555555", "#D55E00"  # distinct for colour-blind eyes (Okabe and Ito, 2008)
ROOM = 0.12  # of an axis: kept free at its ends for names
NEAR = 0.2  # of the axis: names of points nearer than this could touch
SIDE = 0.6  # of the axis: points right of it have their names on the left


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
        ax.text(0.5, 0.5, "no reference", transform=ax.transAxes, ha="center")
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
    _name_points(ax, found)


def _name_points(ax: Any, found: Comparison) -> None:
    """Write each point's name beside it, over no other name: the lower of two near ones goes down."""
    taken: list[tuple[float, float]] = []
    ax.figure.draw_without_rendering()
    for one in found.measured:
        if one.error is None:
            continue
        x, y = ax.transAxes.inverted().transform(ax.transData.transform((one.seconds, max(one.error, LEAST))))
        left = x > SIDE
        shift = 4.0
        while any(abs(y + shift / 200 - other) < 0.05 and abs(x - at) < NEAR for at, other in taken):
            shift -= 9.0
        taken.append((x, y + shift / 200))
        ax.annotate(
            one.name + (" (default)" if one.chosen else ""),
            (one.seconds, max(one.error, LEAST)),
            xytext=(-6 if left else 6, shift),
            textcoords="offset points",
            ha="right" if left else "left",
            fontsize=7,
        )
