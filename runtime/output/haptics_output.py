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

from apc.compiler.wording import known_digits, measured, wrapped
from apc.output.formatting import (
    LINEARIZED,
    Lines,
    Plain,
    document,
    labelled,
    notes,
    radius_text,
    record,
    sentences,
    table,
)
from apc.output.pictures import COLOURS, legend_below, new_figure
from apc.tables import TableColumn, Tabled

if TYPE_CHECKING:
    from apc.haptics.absolute_stability import AbsoluteStability, PassiveMode
    from apc.haptics.frequency_response import HinfGains, Transparency

Floats = NDArray[np.float64]

# Lines of a table of frequencies in a terminal.
SHOWN = 12

# Digits of a table's numbers, at most.
DIGITS = 6

MODE_HEADINGS = ("mode", "damping", "required", "reserve", "frequency", "stiffness", "")
NONE = "–"

# The instants of the root mean squares of a `H2Gains`.
NOISE_RMS = "at the ticks, motion between ticks not included"


def passive_text(absolute_stability: AbsoluteStability) -> Lines:
    """Yield whether a model is stable with any passive hands, in words and numbers."""
    yield from wrapped(
        f"{absolute_stability.topology}: "
        f"{absolute_stability.verdict}{LINEARIZED if absolute_stability.linearized else ''}",
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
            "Take the velocity by a backward difference of samples, as VirtualWall does, or none (damping 0)."
        )
    yield ""
    clamped = radius_text(absolute_stability.clamped_radius, absolute_stability.clamped_error)
    moves = (
        f"spectral radius {clamped}"
        if absolute_stability.clamped_radius or absolute_stability.clamped_error
        else "nothing moves"
    )
    yield from labelled(("devices clamped", moves), ("proof", str(absolute_stability.proof)))
    if absolute_stability.modes:
        yield ""
        yield "  damping in N*s/m, frequency in Hz, stiffness in N/m"
        yield from table([MODE_HEADINGS, *map(_mode, absolute_stability.modes)], "<>>>>><")


def _worst_lines(absolute_stability: AbsoluteStability, worst: PassiveMode) -> str:
    """Return the text on the modes with the most energy output or required damping."""
    moved = "all alike" if worst.name in ("common", "single") else f"in a {worst.name} mode"
    if worst.more is None:
        held = "with its devices clamped the topology is unstable, and no damping of theirs helps"
        return f"Devices that move {moved}: {held}."
    alone = "" if absolute_stability.joined else ", each by itself"
    enough = f"With {worst.more:.4g} N*s/m more damping at each device they can't"
    if absolute_stability.stable:
        return (
            f"Whatever gives back no more energy than it was given may hold the devices{alone}. Of their "
            f"damping {-worst.more:.4g} N*s/m could be spared, with the least left as they move {moved} at "
            f"{worst.frequency_hz:.4g} Hz."
        )
    if absolute_stability.clamped_stable is False:
        return "Hands that hold the devices still are passive, and with these the topology is not stable."
    if absolute_stability.stable is False:
        return (
            f"Hands that move the devices {moved} at {worst.frequency_hz:.4g} Hz get energy out of the "
            "topology "
            f"for ever, and can make it shake. {enough}."
        )
    if worst.passive is False:
        return (
            f"Hands that move the devices {moved} at {worst.frequency_hz:.4g} Hz get energy out if they are "
            "joined to each other; as some devices feel others more than those feel them, what hands do each "
            f"by itself is left open. {enough}."
        )
    return (
        f"Rounding leaves open whether hands get energy out, moving {moved} at {worst.frequency_hz:.4g} Hz."
    )


def _mode(passive_mode: PassiveMode) -> tuple[str, ...]:
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
    """Yield the transparency at a device, in words and numbers."""
    title = (
        f"{transparency.topology}: what a hand feels at "
        f"{transparency.at}{LINEARIZED if transparency.linearized else ''}"
    )
    yield from wrapped(title, "", "  ")
    yield from notes(*transparency.notes, *transparency.limitations)
    yield ""
    slow = transparency.low_frequency
    if slow is not None:
        yield "  Of slow motions, the other hands as the topology has them:"
        parts = zip(("mass", "damping", "stiffness"), ("kg", "N*s/m", "N/m"), slow.errors, strict=True)
        for name, unit, error in parts:
            yield from labelled((name, measured(getattr(slow, name), error, unit)))
        if (network := transparency.network_damping) is not None:
            share = measured(network.network, network.error, "N*s/m")
            yield from labelled(("of that", f"{share}, which the network adds"))
        if slow.mass < 0:
            yield from notes("a mass below 0: late forces act as negative inertia, for slow motions")
        yield ""
    headings = ("frequency", "impedance", "phase", "arrives", "copies apart", "alias")
    units = ("Hz", "N*s/m", "degrees", "mm/s/N", "mm/N", "")
    yield from table([headings, units, *_rows_shown(transparency)], ">>>>>>")
    legend = [f"arrives: at {transparency.between}"] if transparency.between else []
    legend += (
        [f"copies: of {transparency.object}, from the mean of the others'"] if transparency.object else []
    )
    legend += ["alias: the largest part that sampling moves to another frequency, beside that at this one"]
    yield ""
    yield from sentences("; ".join(legend))
    if transparency.hinf and transparency.stable is not False:
        yield "\n  Largest gain at any frequency (H∞), forces of any course:"
        yield from table([_extreme(extremes) for extremes in transparency.hinf])
    for noise in transparency.h2:  # of a sample that is off by a mm, a µm is what a mm is of 1 N
        subject, small = "1 N rms at every hand", "m"
        if noise.source != "hands":
            subject, small = "1 mm rms on every device's samples", "µ"
        values = [
            f"{quantity} {measured(value * 1e3, off * 1e3, unit)}"
            for quantity, value, off, unit in (
                ("copies apart", noise.error_m, noise.errors[0], f"{small}m"),
                ("velocity", noise.velocity_m_s, noise.errors[1], f"{small}m/s"),
            )
            if value is not None and off is not None
        ]
        yield ""
        spread = ", ".join(values) or "it drifts, or rounding hides that it does not"
        yield from notes(f"{spread}: rms {NOISE_RMS}, for {subject}, white from tick to tick")


def _curves(transparency: Transparency) -> list[tuple[NDArray[np.complex128], Floats, float, bool, str]]:
    """Return a response (k,), its relative bounds (k,), a factor, and its name, if present."""
    separation = bool(transparency.object)
    return [
        (transparency.impedance, transparency.bound, 1.0, True, "impedance (N·s/m)"),
        (
            *(
                transparency.transmitted_admittance,
                transparency.transmitted_bound,
                1e3,
                bool(transparency.between),
            ),
            f"velocity at {transparency.between} (mm/s/N)",
        ),
        (
            transparency.coordination_error,
            transparency.error_bound,
            1e3,
            separation,
            f"copies of {transparency.object} apart (mm/N)",
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


def _extreme(extremes: HinfGains) -> tuple[str, str]:
    """Return a norm and its name."""
    peak = extremes.sampled_data
    subject, unit = ("velocity", "m/s/N") if extremes.of == "velocity" else ("copies apart", "m/N")
    size = "not known: beyond floats" if np.isnan(peak.norm) else "without end: it drifts"
    if np.isfinite(peak.norm):
        norm = measured(peak.norm, peak.error + 1e-11 * peak.norm, unit)
        size = f"{norm} at {peak.frequency_hz:.5g} Hz"
    return f"{extremes.mode}, {subject}", size


def transparency_document(transparency: Transparency) -> Plain:
    """Return the same as plain data, in SI; complex numbers as pairs."""
    instead = {
        "hinf": {f"{extremes.mode} {extremes.of}": extremes for extremes in transparency.hinf},
        "h2": {noise.source: noise for noise in transparency.h2},
        "h2_rms": NOISE_RMS,
    }
    return record(transparency, instead)


def transparency_picture(transparency: Transparency, kind: str = "bode", ax: Any = None) -> Any:
    """Draw the impedance, and the transmitted motion, as Bode's plot or Nyquist's; return the Figure.

    Into an `ax` of somebody's, of Bode's plot the magnitudes alone are drawn.
    """
    nyquist, axes = kind == "nyquist", [ax]
    if ax is None:
        figure = new_figure((4.2, 4.0) if nyquist else (5.2, 5.6))
        axes = figure.subplots(1 if nyquist else 2, 1, sharex=True, squeeze=False)[:, 0].tolist()
    size, *phases = axes
    size.set_title(f"{transparency.topology}: felt at {transparency.at}", fontsize=9)
    if nyquist:
        size.plot(transparency.impedance.real, transparency.impedance.imag, color=COLOURS[0])
        for line in (size.axvline, size.axhline):
            line(0.0, color="#999999", linewidth=0.6)
        size.set_aspect("equal", adjustable="datalim")
        size.set(xlabel="real part of the impedance (N·s/m)", ylabel="imaginary part (N·s/m)")
        for index, mark in ((0, "o"), (-1, "s")):
            at, label = transparency.impedance[index], f"{transparency.frequency_hz[index]:.3g} Hz"
            size.plot(at.real, at.imag, mark, color=COLOURS[0], markersize=5, label=label)
    else:
        for index, (values, _, scale, known, label) in enumerate(_curves(transparency)):
            if known and np.any(values):
                style = {"color": COLOURS[index], "linestyle": ("-", "--", "-.")[index], "label": label}
                size.loglog(transparency.frequency_hz, scale * np.abs(values), **style)
        size.set_ylabel("magnitude")
        axes[-1].set_xlabel("frequency (Hz)")
    for phase in phases:
        degrees = np.degrees(np.angle(transparency.impedance))
        phase.semilogx(transparency.frequency_hz, degrees, color=COLOURS[0])
        phase.set_ylabel("phase of the impedance (°)")
        if np.abs(degrees).max() <= 90:
            phase.set_yticks(range(-90, 91, 45))
    if ax is None:
        beneath: Plain = {
            "loc": "outside lower center",
            "fontsize": 8,
            "frameon": False,
            "ncols": 1 + nyquist,
        }
        size.figure.legend(*size.get_legend_handles_labels(), **beneath)
    else:
        legend_below(ax, -0.2, ncols=1 + nyquist)
    return size.figure


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
