"""Pictures of trajectories: a panel a quantity over time.

Takes: a `Trajectory`. Gives: `draw`, `save`, `write_figure`, `FORMATS`.
Guarantees: every curve is named, a colour a peer and a dash a part; labels stand beside the panels, over
nothing; a long run is drawn by the extremes of its rows, so that no swing is lost.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.files import write_file
from apc.optional import need
from apc.simulation.signals import Signal
from apc.simulation.trajectory import Trajectory
from apc.suffixes import check_suffix

Floats = NDArray[np.float64]

FORMATS = (".png", ".svg", ".pdf")
# Unit: what the panel is called, the unit it is drawn in, and how many of them make one of SI.
QUANTITIES = {
    "m": ("position", "mm", 1e3),
    "m/s": ("velocity", "m/s", 1.0),
    "N": ("force", "N", 1.0),
    "rad": ("angle", "rad", 1.0),
    "rad/s": ("angular velocity", "rad/s", 1.0),
    "N*m": ("torque", "N·m", 1.0),
}
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (7, 2)), (0, (3, 1, 1, 1, 1, 1)))
MOST_CURVES = 24  # in a panel: more can't be told apart
MOST_POINTS = 2000  # of a curve: about one a pixel and a half of a wide picture
WIDTH, HEIGHT, DPI = 9.0, 2.4, 150  # inches: of the figure, of a panel


def draw(trajectory: Trajectory, ax: Any = None) -> Any:
    """Draw a trajectory, a panel a quantity, or everything into one Axes; return the matplotlib Figure.

    Parameters
    ----------
    trajectory
        What to draw.
    ax
        The matplotlib Axes to draw into; the signals must then share one unit.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    panels = _panels(trajectory.signals)
    if ax is not None:
        assert len(panels) == 1, f"one Axes can't show signals in {', '.join(panels)}"
        [(unit, places)] = panels.items()
        _panel(ax, trajectory, unit, places)
        ax.set_xlabel("time [s]")
        return ax.figure
    figure = figures.Figure(figsize=(WIDTH, HEIGHT * len(panels) + 0.6), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for one, (unit, places) in zip(axes, panels.items(), strict=True):
        _panel(one, trajectory, unit, places)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(f"{trajectory.topology}: {trajectory.summary.verdict}", fontsize=11)
    return figure


def save(trajectory: Trajectory, path: Path) -> None:
    """Draw a trajectory into a file, its format chosen by the suffix.

    Raises
    ------
    ApcError
        E878 no such format, E601 it can't be written, E875 matplotlib is not installed.
    """
    check_format(path)
    write_figure(draw(trajectory), path)


def write_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib Figure, its format chosen by the suffix; the same figure gives the same bytes."""
    # No date in the file, and the same names inside it.
    matplotlib = need("matplotlib", "plot")
    dates: dict[str, dict[str, None]] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    suffix = check_suffix(path, FORMATS, "--plot")

    def write(temporary: Path) -> None:
        with matplotlib.rc_context({"svg.hashsalt": "apc"}):
            figure.savefig(temporary, format=suffix[1:], dpi=DPI, metadata=dates.get(suffix))

    write_file(path, write)


def check_format(path: Path, option: str = "--plot") -> None:
    """Refuse a picture that can't be drawn: E878 no such format, E875 matplotlib is not installed."""
    check_suffix(path, FORMATS, option)
    need("matplotlib", "plot")


def _panels(signals: Sequence[Signal]) -> dict[str, list[int]]:
    """Return the signals' places by unit: first the known quantities, then the others as they come."""
    found: dict[str, list[int]] = {}
    for place, one in enumerate(signals):
        found.setdefault(one.unit, []).append(place)
    known = [unit for unit in QUANTITIES if unit in found]
    return {unit: found[unit] for unit in [*known, *(unit for unit in found if unit not in known)]}


def _panel(ax: Any, trajectory: Trajectory, unit: str, places: Sequence[int]) -> None:
    title, shown, scale = QUANTITIES.get(unit, ("", unit, 1.0))
    signals = trajectory.signals
    peers = list(dict.fromkeys((one.group, one.peer) for one in signals))
    locals_ = list(dict.fromkeys(signals[place].local for place in places))
    drawn = places[:MOST_CURVES]
    for place in drawn:
        one = signals[place]
        time, values = thinned(trajectory.time, trajectory.values[:, place])
        ax.plot(
            time,
            scale * values,
            color=f"C{peers.index((one.group, one.peer)) % 10}",
            linestyle=DASHES[locals_.index(one.local) % len(DASHES)],
            linewidth=1.0,
            label=one.name,
        )
    left = len(places) - len(drawn)
    ax.set_ylabel(f"{title} [{shown}]" if title else f"[{shown}]")
    ax.margins(x=0)
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)
    ax.legend(
        loc="center left",
        bbox_to_anchor=(1.01, 0.5),
        fontsize=6.5 if len(drawn) > 10 else 8,
        ncols=1 if len(drawn) <= 14 else 2,
        frameon=False,
        handlelength=2.6,
        title=f"and {left} more" if left else None,
        title_fontsize=7,
    )


def thinned(time: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return a curve in at most some `MOST_POINTS` points: the least and the largest of each stretch."""
    if len(time) <= MOST_POINTS:
        return time, values
    width = -(-2 * len(time) // MOST_POINTS)
    whole = len(time) // width * width
    stretches = values[:whole].reshape(-1, width)
    first = np.arange(0, whole, width)
    both = np.stack([first + stretches.argmin(axis=1), first + stretches.argmax(axis=1)], axis=1)
    kept = np.unique(np.concatenate([[0], np.sort(both, axis=1).reshape(-1), [len(time) - 1]]))
    return time[kept], values[kept]
