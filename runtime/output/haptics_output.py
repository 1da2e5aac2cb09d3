"""Passivity and transparency results as text, plain data, a picture and a table.

Takes: an `AbsoluteStability` or a `Transparency`. Gives: for each its text and document;
`transparency_picture`, `transparency_rows`.
Guarantees: limitations come first; digits are limited by the error bound.
Does not: compute.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.wording import known_digits, wrapped
from apc.output.formatting import (
    Lines,
    Plain,
    document,
    headed,
    labelled,
    notes,
    point_text,
    radius_text,
    record,
    sentences,
    table,
    with_error,
)
from apc.output.pictures import COLOURS, legend_below, new_figure, short_legend
from apc.support.extension_table import require_extension
from apc.support.tables import TableColumn, Tabled

if TYPE_CHECKING:
    from apc.haptics.absolute_stability import AbsoluteStability, PassiveMode
    from apc.haptics.frequency_response import QuasiStaticImpedance, Transparency

Floats = NDArray[np.float64]

# Lines of a table of frequencies in a terminal.
SHOWN = 12

# Points of a Nyquist curve for each frequency; the turn of its chords in rad up to which it is smoothed.
FINER, TURN = 8, 0.5

# Digits of a table's numbers, at most.
DIGITS = 6


MODE_HEADINGS = ("mode", "damping", "required", "reserve", "frequency", "stiffness", "port")
NONE = "–"
PORT_LEGEND = (
    "damping: of each device; required: smallest damping for a passive port",
    "frequency: of the largest extractable energy; stiffness: static, of the port",
)

# The instants of the root mean squares of a `H2Gains`.
NOISE_RMS = "at clock ticks (motion between ticks is not included)"


def passive_text(absolute_stability: AbsoluteStability) -> Lines:
    """Yield whether a model is stable with any passive hands, in words and numbers."""
    point = point_text(absolute_stability.linearized, absolute_stability.at_equilibrium)
    yield from wrapped(
        f"{absolute_stability.topology}: {absolute_stability.verdict}{point}",
        "",
        "  ",
    )
    yield from notes(*absolute_stability.limitations)
    yield ""
    if absolute_stability.why:
        yield from sentences(f"{absolute_stability.why}.")
    elif absolute_stability.worst_mode is not None:
        yield from sentences(_worst_lines(absolute_stability, absolute_stability.worst_mode))
    if absolute_stability.why and not absolute_stability.modes:
        yield from sentences(
            "Use a backward difference of samples as the velocity, as VirtualWall does, or no damping."
        )
    yield ""
    clamped = radius_text(absolute_stability.clamped_radius, absolute_stability.clamped_error)
    moves = (
        f"spectral radius {clamped}"
        if absolute_stability.clamped_radius or absolute_stability.clamped_error
        else "no free motion"
    )
    yield from labelled(("clamped devices", moves), ("proof", str(absolute_stability.proof)))
    if absolute_stability.modes:
        rows = [MODE_HEADINGS, *map(_mode, absolute_stability.modes)]
        yield from headed(
            "Port modes (damping in N*s/m, frequency in Hz, stiffness in N/m)", table(rows, "<>>>>><")
        )
        yield from notes(*PORT_LEGEND)


def _worst_lines(absolute_stability: AbsoluteStability, worst: PassiveMode) -> str:
    """Return the text on the modes with the most energy output or required damping."""
    mode = "the common mode" if worst.name in ("common", "single") else f"the {worst.name} mode"
    if worst.more is None:
        return f"In {mode}, the topology is unstable with clamped devices, whatever their damping."
    at = f"{worst.frequency_hz:.4g} Hz"
    enough = f"It becomes passive with {worst.more:.4g} N*s/m of additional damping per device."
    if absolute_stability.stable:
        operators = "passive operator" if absolute_stability.joined else "independent passive operators"
        return (
            f"Absolutely stable with any {operators}. The devices have {-worst.more:.4g} N*s/m of damping in "
            f"reserve; the reserve is smallest in {mode} at {at}."
        )
    if absolute_stability.clamped_stable is False:
        return "A clamped device is a passive operator; with it the topology is unstable."
    if absolute_stability.stable is False:
        return f"The port is not passive: in {mode} it is active at {at}. {enough}"
    if worst.passive is False:
        return (
            f"In {mode} the port is active at {at} for operators that are coupled to each other. The "
            f"coupling between devices is not symmetric, so independent passive operators are undecided. "
            f"{enough}"
        )
    return f"Undecided: rounding errors exceed the margin of passivity in {mode} at {at}."


def _mode(passive_mode: PassiveMode) -> tuple[str, ...]:
    """Return the cells of a mode's row, in the order of `MODE_HEADINGS`."""
    name = passive_mode.name + (f" × {passive_mode.multiplicity:,}" if passive_mode.multiplicity > 1 else "")
    verdict = {True: "passive", False: "not passive", None: "undecided"}[passive_mode.passive]
    needed = reserve = NONE
    if passive_mode.more is None:
        verdict = "not passive"
    else:
        reserve = f"{-passive_mode.more:+.4g}"
        if passive_mode.needed is not None and passive_mode.needed <= 0:
            needed = "0"
        elif passive_mode.needed is not None:
            error = math.inf if passive_mode.error is None else passive_mode.error
            sure = math.isfinite(error)
            needed = (
                known_digits(passive_mode.needed, error, DIGITS) if sure else f"{passive_mode.needed:.2g}"
            )
    damping = NONE if passive_mode.damping is None else f"{passive_mode.damping:.6g}"
    at = NONE if passive_mode.frequency_hz is None else f"{passive_mode.frequency_hz:.5g}"
    size = abs(passive_mode.stiffness or 0.0)
    stiffness = NONE if passive_mode.stiffness is None else f"{size if size > 1e-6 else 0:.5g}"
    return name, damping, needed, reserve, at, stiffness, verdict


def passive_document(absolute_stability: AbsoluteStability) -> Plain:
    """Return the same as plain data."""
    modes = [{**document(mode), "damping_needed": document(mode.needed)} for mode in absolute_stability.modes]
    return {"hands": "passive", **record(absolute_stability, {"modes": modes})}


def transparency_text(transparency: Transparency) -> Lines:
    """Yield the impedance at a device, transmitted velocity, coordination error and norms."""
    title = (
        f"impedance at {transparency.at}{point_text(transparency.linearized, transparency.at_equilibrium)}"
    )
    yield from wrapped(f"{transparency.topology}: {title}", "", "  ")
    yield from notes(*transparency.limitations)
    slow = transparency.low_frequency
    if slow is not None:
        yield from headed("Low-frequency impedance", _low_frequency_lines(transparency, slow))
    headings = ("frequency", "impedance", "phase", "transmitted", "coord. error", "alias")
    units = ("Hz", "N*s/m", "deg", "mm/s/N", "mm/N", "")
    rows = [headings, units, *_rows_shown(transparency)]
    yield from headed("Frequency response", table(rows, ">>>>>>"))
    extension = require_extension("system_norms") if transparency.hinf or transparency.h2 else None
    norms = (
        [extension.norm_row(gains) for gains in transparency.hinf]
        if extension and transparency.stable is not False
        else []
    )
    if norms:
        rows = [("mode", "output", "H∞ norm", "frequency"), *norms]
        yield from headed("Largest gain over frequency, from forces of the hands", table(rows, "<<<>"))
    noise = [row for gains in transparency.h2 for row in extension.noise_rows(gains)] if extension else []
    if noise:
        rows = [("white noise input", "output", "rms"), *noise]
        yield from headed(f"Response to white noise, {NOISE_RMS}", table(rows))
    legend = []
    if transparency.between:
        legend.append(f"transmitted: velocity at {transparency.between} per unit force")
    if transparency.object:
        legend.append(f"coord. error: deviation of {transparency.object} from the mean of the other peers")
    legend.append("alias: largest aliased component of the motion, relative to the fundamental")
    yield ""
    yield from notes(*legend, *transparency.notes)


def _low_frequency_lines(transparency: Transparency, slow: QuasiStaticImpedance) -> Lines:
    """Yield mass, damping and stiffness of slow motions, the other hands as in the topology."""
    network = transparency.network_damping
    parts = zip(("mass", "damping", "stiffness"), ("kg", "N*s/m", "N/m"), slow.errors, strict=True)
    for name, unit, error in parts:
        text = with_error(getattr(slow, name), error, unit)
        if name == "damping" and network is not None:
            text += f" ({with_error(network.network, network.error, 'N*s/m')} from the network)"
        if name == "mass" and slow.mass < 0:
            text += " (delay acts as negative inertia)"
        yield from labelled((name, text))


def _curves(transparency: Transparency) -> list[tuple[NDArray[np.complex128], Floats, float, bool, str]]:
    """Return a response (k,), its relative bounds (k,), a factor, and its name, if present."""
    separation = bool(transparency.object)
    return [
        (transparency.impedance, transparency.bound, 1.0, True, "impedance [N·s/m]"),
        (
            *(
                transparency.transmitted_admittance,
                transparency.transmitted_bound,
                1e3,
                bool(transparency.between),
            ),
            f"velocity at {transparency.between} [mm/s/N]",
        ),
        (
            transparency.coordination_error,
            transparency.error_bound,
            1e3,
            separation,
            f"coordination error of {transparency.object} [mm/N]",
        ),
    ]


def _rows_shown(transparency: Transparency) -> Iterator[tuple[str, ...]]:
    """Yield some lines of the table, the first and the last among them."""
    count = len(transparency.frequency_hz)
    for index in sorted({round(value) for value in np.linspace(0, count - 1, min(SHOWN, count))}):
        sizes = [
            (float(abs(values[index]) * scale), bound[index])
            for values, bound, scale, *_ in _curves(transparency)
        ]
        size, arrives, separation = (
            known_digits(value, value * float(bound), DIGITS) for value, bound in sizes
        )
        phase = f"{np.degrees(np.angle(transparency.impedance[index])):.2f}"
        others = (arrives if transparency.between else "", separation if transparency.object else "")
        yield (
            f"{transparency.frequency_hz[index]:.5g}",
            size,
            phase,
            *others,
            f"{transparency.aliased_fraction[index]:.1e}",
        )


def transparency_document(transparency: Transparency) -> Plain:
    """Return the same as plain data, in SI; complex numbers as pairs."""
    instead = {
        "hinf": {
            f"{extremes.mode} {extremes.of}": record(extremes, {"gains": extremes.gains})
            for extremes in transparency.hinf
        },
        "h2": {noise.source: noise for noise in transparency.h2},
        "h2_rms": NOISE_RMS,
    }
    return record(transparency, instead)


def transparency_picture(transparency: Transparency, kind: str = "bode", ax: Any = None) -> Any:
    """Draw the impedance and the transmitted motion as a Bode or Nyquist plot; return the Figure.

    Into a given `ax` only the magnitudes of the Bode plot are drawn.
    """
    nyquist, axes = kind == "nyquist", [ax]
    if ax is None:
        figure = new_figure((4.2, 4.0) if nyquist else (5.2, 5.6))
        axes = figure.subplots(1 if nyquist else 2, 1, sharex=True, squeeze=False)[:, 0].tolist()
    size, *phases = axes
    size.set_title(f"{transparency.topology}: impedance at {transparency.at}", fontsize=9)
    if nyquist:
        curve = _smooth(np.log(transparency.frequency_hz), transparency.impedance)
        size.plot(curve.real, curve.imag, color=COLOURS[0])
        for line in (size.axvline, size.axhline):
            line(0.0, color="#999999", linewidth=0.6)
        size.set_aspect("equal", adjustable="datalim")
        size.set(xlabel="real part of the impedance [N·s/m]", ylabel="imaginary part [N·s/m]")
        for index, mark in ((0, "o"), (-1, "s")):
            at, label = transparency.impedance[index], f"{transparency.frequency_hz[index]:.3g} Hz"
            size.plot(at.real, at.imag, mark, color=COLOURS[0], markersize=5, label=label)
    else:
        for index, (values, _, scale, known, label) in enumerate(_curves(transparency)):
            if known and np.any(values):
                style = {"color": COLOURS[index], "linestyle": ("-", "--", "-.")[index], "label": label}
                size.loglog(transparency.frequency_hz, scale * np.abs(values), **style)
        size.set_ylabel("magnitude")
        axes[-1].set_xlabel("frequency [Hz]")
    for phase in phases:
        degrees = np.degrees(np.angle(transparency.impedance))
        phase.semilogx(transparency.frequency_hz, degrees, color=COLOURS[0])
        phase.set_ylabel("phase of the impedance [°]")
        if np.abs(degrees).max() <= 90:
            phase.set_yticks(range(-90, 91, 45))
    if ax is None:
        beneath: Plain = {
            "loc": "outside lower center",
            "fontsize": 8,
            "frameon": False,
            "ncols": 1 + nyquist,
        }
        size.figure.legend(*short_legend(*size.get_legend_handles_labels()), **beneath)
    else:
        legend_below(ax, -0.2, ncols=1 + nyquist)
    return size.figure


def _smooth(at: Floats, values: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return a curve (k,) with `FINER` times as many points, if its chords turn by less than `TURN`."""
    turns = np.angle(np.diff(values)[1:] / np.where(np.diff(values)[:-1] == 0, 1, np.diff(values)[:-1]))
    if len(values) < 4 or not np.all(np.abs(turns) < TURN):  # a spline could add loops
        return values
    from scipy.interpolate import CubicSpline

    steps = np.linspace(0, len(at) - 1, FINER * (len(at) - 1) + 1)
    finer: NDArray[np.complex128] = CubicSpline(at, values)(np.interp(steps, np.arange(len(at)), at))
    return finer


def transparency_rows(transparency: Transparency) -> Tabled:
    """Return the columns of a table of responses, one row per frequency, and its title."""
    responses = (("impedance", "N*s/m"), ("transmitted admittance", "m/s/N"), ("error per force", "m/N"))
    headings = [TableColumn("frequency", "Hz")]
    headings += [
        TableColumn(f"{name} {which}", unit) for name, unit in responses for which in ("real", "imaginary")
    ]
    headings += [TableColumn(name) for name in ("alias", "bound", "transmitted bound", "error bound")]
    curves = _curves(transparency)
    parts = [part for values, *_ in curves for part in (values.real, values.imag)]
    columns = [
        transparency.frequency_hz,
        *parts,
        transparency.aliased_fraction,
        *(bound for _, bound, *_ in curves),
    ]
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return headings, rows, {"at": transparency.at, "limitations": list(transparency.limitations)}
