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
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from apc.present.forms import reached
from apc.present.pictures import COLOURS, new_figure

if TYPE_CHECKING:
    from apc.comparison.comparison import Comparison, Scheme
    from apc.vary.critical import Critical

# How bars are hatched: as 7 colours and 8 hatches have no common divisor, the first 56 schemes all differ.
HATCHES = ("", "////", "\\\\\\\\", "||||", "xxxx", "----", "....", "oooo")
COLUMNS = 3  # panels beside each other
PANEL, BAR = 2.4, 0.28  # inches: the width of a panel, the height of a bar
FURTHER = 4.0  # times the longest bar that ends, to which one that does not is drawn at most
LABEL = 24  # letters of a scheme's name in a line

LETTERS: dict[str, Any] = {
    "textcoords": "offset points",
    "va": "center",
    "fontsize": 8,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1, "alpha": 0.85},
}
NONE = "–"
BOUNDARY = 1.0  # the spectral radius from which on a motion grows

# The panels: title, where in a scheme the number is, in how many of its units it is drawn.
NUMBERS = (
    ("spectral radius a frame", "analysis.spectral_radius", 1.0),
    ("settles within 2 % in (s)", "analysis.settling_s", 1.0),
    ("felt at 1 Hz (N·s/m)", "feel.impedance.0", 1.0),
    ("felt at 10 Hz (N·s/m)", "feel.impedance.1", 1.0),
    ("operations a tick", "effort.operations", 1.0),
    ("numbers sent a second", "effort.sent", 1.0),
)
REACHES = (
    ("largest stable stiffness (N/m)", "stiffness", 1.0),
    ("delay that breaks it (ms)", "delay", 1e3),
    ("loss that breaks it (%)", "loss", 1e2),
)


@dataclass(frozen=True, slots=True)
class _Bar:
    """A bar with a text at its end; `further` says that it goes on beyond what was looked at."""

    length: float
    text: str
    further: bool = False


def comparison_picture(found: Comparison) -> Any:
    """Draw all schemes beside each other; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    schemes = found.schemes
    panels = [(title, [_number(one, path, scale) for one in schemes]) for title, path, scale in NUMBERS]
    reaches = [
        (title, [_reach(getattr(one, key), scale) for one in schemes]) for title, key, scale in REACHES
    ]
    panels[2:2] = reaches
    rows = -(-len(panels) // COLUMNS)
    names = [
        "\n".join(textwrap.wrap(f"{place}  {one.topology}", LABEL)) for place, one in enumerate(schemes, 1)
    ]
    size = (PANEL * COLUMNS + 1.4, (0.9 + BAR * 1.25 * len(names)) * rows + 0.5)
    figure = new_figure(size)
    axes = figure.subplots(rows, COLUMNS, squeeze=False, sharey=True).ravel()
    for ax, (title, bars) in zip(axes, panels, strict=True):
        _draw(ax, title, bars)
    axes[0].set_yticks(range(len(names)), names, fontsize=8)
    axes[0].invert_yaxis()
    axes[0].axvline(BOUNDARY, color="0.4", linewidth=0.8, linestyle=(0, (3, 2)))
    for place, one in enumerate(schemes):
        axes[0].annotate(_judged(one), (0, place), (4, 0), **LETTERS)
    lines = [line for text in (*found.left_out, *found.notes) for line in textwrap.wrap(text, 110)]
    figure.suptitle("\n".join(lines), fontsize=8.5)
    return figure


def _number(one: Scheme, path: str, scale: float) -> _Bar:
    value = reached(one, path)
    return _Bar(0.0, NONE) if value is None else _Bar(scale * abs(value), f"{scale * abs(value):.4g}")


def _reach(found: Critical | None, scale: float) -> _Bar:
    """Return how far a scheme is stable: up to a crossing, or beyond all that was looked at."""
    if found is not None and found.value is not None and found.stable_side == "below":
        return _Bar(scale * found.value, f"{scale * found.value:.4g}")
    if found is not None and found.value is None and found.verdict.startswith("stable"):
        return _Bar(scale * found.scanned[1], f"> {scale * found.scanned[1]:.4g}", further=True)
    return _Bar(0.0, "unstable" if found is not None and found.verdict.startswith("unstable") else NONE)


def _draw(ax: Any, title: str, bars: Sequence[_Bar]) -> None:
    """Draw one quantity of all schemes."""
    ax.set_title(title, fontsize=8.5)
    ax.tick_params(labelsize=8)
    ax.tick_params(axis="y", length=0)
    ax.spines[["top", "right"]].set_visible(False)
    # What ends nowhere may be looked at a thousand times as far, and would leave no room for the others.
    most = FURTHER * max((bar.length for bar in bars if not bar.further), default=0.0)
    lengths = [min(bar.length, most or bar.length) if bar.further else bar.length for bar in bars]
    edges = [COLOURS[place % len(COLOURS)] for place in range(len(bars))]
    hatches = [HATCHES[place % len(HATCHES)] for place in range(len(bars))]
    faces = ["white" if hatch else edge for hatch, edge in zip(hatches, edges, strict=True)]
    look = {"color": faces, "edgecolor": edges, "hatch": hatches, "linewidth": 0.8}
    drawn = ax.barh(range(len(bars)), lengths, height=0.6, **look)
    ax.bar_label(drawn, [bar.text for bar in bars], padding=4, fontsize=8, bbox=LETTERS["bbox"])
    ax.set(xlim=(0, 1.3 * max(lengths) or 1.0), ylim=(-0.6, len(bars) - 0.4))
    ax.locator_params(axis="x", nbins=4)


def _judged(one: Scheme) -> str:
    """Say of a scheme that it is not stable, and what one does that isn't linear."""
    if one.analysis is None:
        return one.verdict
    said = [] if one.stable else ["unstable" if one.stable is False else "undecided"]
    said += [] if one.played is None else [f"{one.played.summary.verdict} in time"]
    return ", ".join(said)
