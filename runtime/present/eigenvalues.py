"""Eigenvalues as a picture: those of a scene over the unit circle, and where they go as a number grows.

Takes: an `Analysis`, a `Locus`. Gives: `eigenvalues_picture`, `locus_picture`.
Guarantees: what decides is in sight, and so are the unit circle and every eigenvalue; nothing is written over
a mark, what marks mean stands beside the circle.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.words import in_hertz
from apc.optional import need
from apc.present.forms import axis_label, quantity
from apc.present.pictures import COLOURS, legend_below, new_figure

if TYPE_CHECKING:
    from apc.analysis.analysis import Analysis
    from apc.vary.locus import Locus

SIZE = (5.6, 4.6)  # inches
MOST_NAMED = 5  # modes
MARKS = "os^Dv"
LETTERS = 75  # of a line of a title


def eigenvalues_picture(found: Analysis, ax: Any = None) -> Any:
    """Draw the eigenvalues of a frame over the unit circle; return the matplotlib Axes.

    Parameters
    ----------
    found
        The analysis whose modes are drawn, rigid ones left out.
    ax
        The matplotlib Axes to draw into; one of a figure of its own if not given.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    ax = _circle(ax)
    modes = [mode for mode in found.modes if mode.eigenvalue.imag >= 0]  # of a pair one
    rest = [mode.eigenvalue for mode in modes[MOST_NAMED:]]
    for place, mode in enumerate(modes[:MOST_NAMED]):
        times = f" × {mode.multiplicity}" if mode.multiplicity > 1 else ""
        label = f"{mode.magnitude:.4f}{times}, {in_hertz(mode.frequency_hz)}, {mode.shape}"
        _mark(ax, mode.eigenvalue, MARKS[place % len(MARKS)], COLOURS[1 + place], label)
    _mark(ax, rest, ".", "0.4", f"{len(rest)} that die out faster")
    seconds = found.settling_s
    settles = "" if seconds is None else f"; settles within 2 % in {seconds:.3g} s"
    radius = f"spectral radius {found.spectral_radius:.6g} per frame of {1e3 * found.frame_s:g} ms{settles}"
    _entitle(ax, [f"{found.topology}: {found.verdict}", radius])
    return ax


def locus_picture(found: Locus, ax: Any = None) -> Any:
    """Draw where eigenvalues go as a parameter grows; return the matplotlib Axes.

    Parameters
    ----------
    found
        The eigenvalues by value.
    ax
        The matplotlib Axes to draw into; one of a figure of its own if not given.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    ax = _circle(ax)
    of = found.critical
    points = np.concatenate(found.eigenvalues)  # conjugates are among them
    colours = np.repeat(found.values, [len(one) for one in found.eigenvalues])
    drawn = ax.scatter(points.real, points.imag, c=colours, s=5, linewidths=0, cmap="viridis", zorder=3)
    ax.figure.colorbar(drawn, ax=ax, label=axis_label(of.parameter, of.unit))
    _mark(ax, found.now, "x", COLOURS[2], f"now, {quantity(of.present, of.unit)}")
    for place, one in enumerate(of.crossings[:MOST_NAMED]):
        if not found.values.size or not found.values[0] <= one.value <= found.values[-1]:
            continue
        nearest = found.eigenvalues[int(np.abs(found.values - one.value).argmin())]
        at = nearest[np.abs(np.abs(nearest) - 1).argmin()]
        told = "" if np.isnan(one.frequency_hz) else f", {in_hertz(one.frequency_hz)}"
        label = f"changes at {quantity(one.value, of.unit)}{told}"
        _mark(ax, at / abs(at), MARKS[place], "none", label)
    _entitle(ax, [f"{of.topology}: eigenvalues of a frame of {1e3 * found.frame_s:g} ms, packets on time"])
    return ax


def _circle(ax: Any) -> Any:
    """Return an Axes with the unit circle in it, to scale."""
    patches = need("matplotlib.patches", "plot")
    if ax is None:
        ax = new_figure(SIZE).subplots()
    ax.add_patch(patches.Circle((0, 0), 1, facecolor="none", edgecolor="0.4", linewidth=0.9))
    for line in (ax.axhline, ax.axvline):
        line(0, color="0.8", linewidth=0.6, zorder=0)
    ax.set_aspect("equal", adjustable="datalim")
    ax.update_datalim([(-1.05, -1.05), (1.05, 1.05)])
    ax.set_xlabel("real part")
    ax.set_ylabel("imaginary part")
    return ax


def _mark(ax: Any, values: Any, mark: str, colour: str, label: str) -> None:
    """Draw eigenvalues (k,) and their conjugates."""
    points = np.append(values, np.conj(values))
    if not points.size:
        return
    look = {"markerfacecolor": colour, "markeredgecolor": "0.1" if colour == "none" else colour}
    size = {".": 4, "x": 7}.get(mark, 9 if colour == "none" else 6)
    ax.plot(points.real, points.imag, mark, markersize=size, label=label, zorder=4, **look)


def _entitle(ax: Any, lines: Sequence[str]) -> None:
    ax.autoscale_view()
    ax.set_title("\n".join(one for line in lines for one in textwrap.wrap(line, LETTERS)), fontsize=9)
    legend_below(ax)
