"""The picture of schemes side by side: a panel a quantity, a bar a scheme.

Takes: a `Comparison`. Gives: `comparison_picture`.
Guarantees: bars of one scheme have one colour and hatch in every panel, so that they can be told apart
without colour; a bar that ends nowhere within what was looked at says so by ">"; what can't be had is a dash.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from apc.optional import need
from apc.present.pictures import COLOURS

if TYPE_CHECKING:
    from apc.comparison.comparison import Comparison, Scheme
    from apc.vary.critical import Critical

# How bars are hatched: as 7 colours and 8 hatches have no common divisor, the first 56 schemes all differ.
HATCHES = ("", "////", "\\\\\\\\", "||||", "xxxx", "----", "....", "oooo")
COLUMNS = 3  # panels beside each other
PANEL, BAR = 2.4, 0.28  # inches: the width of a panel, the height of a bar
FURTHER = 4.0  # times the longest bar that ends, to which one that does not is drawn at most
LABEL = 24  # letters of a scheme's name in a line

# A bar: its length, and whether it goes on beyond that; or a word where there is none.
_Bar = tuple[float, bool] | str
NONE = "–"
BOUNDARY = 1.0  # the spectral radius from which on a motion grows


def comparison_picture(found: Comparison) -> Any:
    """Draw all schemes beside each other; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    panels: list[tuple[str, list[_Bar]]] = [
        ("spectral radius a frame", [_radius(one) for one in found.schemes]),
        ("settles within 2 % in (s)", [_settles(one) for one in found.schemes]),
        ("largest stable stiffness (N/m)", [_reach(one.stiffness, 1.0) for one in found.schemes]),
        ("delay that breaks it (ms)", [_reach(one.delay, 1e3) for one in found.schemes]),
        ("loss that breaks it (%)", [_reach(one.loss, 1e2) for one in found.schemes]),
        ("felt at 1 Hz (N·s/m)", [_felt(one, 0) for one in found.schemes]),
        ("felt at 10 Hz (N·s/m)", [_felt(one, 1) for one in found.schemes]),
        ("operations a tick", [(float(one.effort.operations), False) for one in found.schemes]),
        ("numbers sent a second", [(one.effort.sent, False) for one in found.schemes]),
    ]
    rows = -(-len(panels) // COLUMNS)
    named = [f"{place + 1}  {one.topology}" for place, one in enumerate(found.schemes)]
    names = ["\n".join(textwrap.wrap(one, LABEL)) for one in named]
    tall = 0.9 + BAR * 1.25 * len(names)
    size = (PANEL * COLUMNS + 1.4, tall * rows + 0.5)
    figure = figures.Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, COLUMNS, squeeze=False, sharey=True).ravel()
    for place, (ax, (title, bars)) in enumerate(zip(axes, panels, strict=True)):
        _draw(ax, title, bars, BOUNDARY if place == 0 else 0.0)
    axes[0].set_yticks(range(len(names)), names, fontsize=8)
    axes[0].invert_yaxis()
    axes[0].axvline(BOUNDARY, color="0.4", linewidth=0.8, linestyle=(0, (3, 2)))
    for place, one in enumerate(found.schemes):
        if said := _judged(one):
            _write(axes[0], said, 0.0, place)
    lines = [line for text in (*found.left_out, *found.notes) for line in textwrap.wrap(text, 110)]
    if lines:
        figure.suptitle("\n".join(lines), fontsize=8.5)
    return figure


def _settles(one: Scheme) -> _Bar:
    seconds = None if one.analysis is None else one.analysis.settling_s
    return NONE if seconds is None else (seconds, False)


def _reach(found: Critical | None, scale: float) -> _Bar:
    """Return how far a scheme is stable: up to a crossing, or beyond all that was looked at."""
    if found is None:
        return NONE
    if found.value is not None and found.stable_side == "below":
        return found.value * scale, False
    if found.value is None and found.verdict.startswith("stable"):
        return found.scanned[1] * scale, True
    return "unstable" if found.verdict.startswith("unstable") else NONE


def _radius(one: Scheme) -> _Bar:
    return one.verdict if one.analysis is None else (one.analysis.spectral_radius, False)


def _felt(one: Scheme, place: int) -> _Bar:
    return NONE if one.feel is None else (float(abs(one.feel.impedance[place])), False)


def _draw(ax: Any, title: str, bars: Sequence[_Bar], beyond: float) -> None:
    """Draw one quantity of all schemes, the numbers behind the bars and behind what is `beyond`."""
    ax.set_title(title, fontsize=8.5)
    ax.tick_params(labelsize=8)
    ax.tick_params(axis="y", length=0)
    ax.spines[["top", "right"]].set_visible(False)
    ended = max((bar[0] for bar in bars if not isinstance(bar, str) and not bar[1]), default=0.0)
    longest = beyond
    for place, bar in enumerate(bars):
        colour, hatch = COLOURS[place % len(COLOURS)], HATCHES[place % len(HATCHES)]
        if isinstance(bar, str):
            _write(ax, bar, 0.0, place)
            continue
        # What ends nowhere may be looked at a thousand times as far, and would leave no room for the others.
        drawn = min(bar[0], FURTHER * ended or bar[0]) if bar[1] else bar[0]
        longest = max(longest, drawn)
        look = {"facecolor": "white" if hatch else colour, "edgecolor": colour, "hatch": hatch}
        ax.barh(place, drawn, height=0.6, linewidth=0.8, **look)
        _write(ax, f"{'> ' if bar[1] else ''}{bar[0]:.4g}", max(drawn, beyond), place)
    ax.set(xlim=(0, 1.3 * longest or 1.0), ylim=(-0.6, len(bars) - 0.4))
    ax.locator_params(axis="x", nbins=4)


def _write(ax: Any, text: str, x: float, y: int) -> None:
    """Write a word beside where a bar ends, over whatever stands there."""
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1, "alpha": 0.85}
    ax.annotate(text, (x, y), (4, 0), textcoords="offset points", va="center", fontsize=8, bbox=box)


def _judged(one: Scheme) -> str:
    """Say of a scheme that it is not stable, and what one does that isn't linear."""
    said = [] if one.stable or one.refused else ["unstable" if one.stable is False else "undecided"]
    said += [] if one.played is None else [f"{one.played.summary.verdict} in time"]
    return ", ".join(said)
