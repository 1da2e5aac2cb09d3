"""What hands do and feel, as text, plain data, a picture and a table.

Takes: a `AbsoluteStability` or a `Transparency`. Gives: of each its text and document; `feel_picture`,
`feel_rows`.
Guarantees: what the answer leaves out stands first; no digit beyond its bound.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.words import known_digits, measured, wrapped
from apc.present.forms import (
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
from apc.present.pictures import COLOURS, legend_below, new_figure
from apc.tables import TableColumn, Tabled

if TYPE_CHECKING:
    from apc.hands.frequency_response import HinfGains, Transparency
    from apc.hands.passivity import AbsoluteStability, PassiveMode

Floats = NDArray[np.float64]

# Lines of a table of frequencies in a terminal.
SHOWN = 12

# Digits of a table's numbers, at most.
DIGITS = 6

# Where the root mean squares of a `H2Gains` are taken.
NOISE_RMS = "at the ticks, motion between ticks not included"


def passive_text(passive_hands: AbsoluteStability) -> Lines:
    """Yield whether a scene is stable with any passive hands, in words and numbers."""
    yield from wrapped(
        f"{passive_hands.topology}: {passive_hands.verdict}{LINEARIZED if passive_hands.linearized else ''}",
        "",
        "  ",
    )
    yield from notes(*passive_hands.left_out)
    yield ""
    if passive_hands.why:
        yield from sentences(f"{passive_hands.why}.")
    elif passive_hands.worst is not None:
        yield from sentences(_worst(passive_hands, passive_hands.worst))
    if passive_hands.why and not passive_hands.modes:
        yield from sentences(
            "Take the velocity by a backward difference of samples, as VirtualWall does, or none (damping 0)."
        )
    yield ""
    clamped = radius_text(passive_hands.clamped_radius, passive_hands.clamped_error)
    moves = (
        f"spectral radius {clamped}"
        if passive_hands.clamped_radius or passive_hands.clamped_error
        else "nothing moves"
    )
    yield from labelled(("devices clamped", moves), ("proof", str(passive_hands.proof)))
    if passive_hands.modes:
        yield ""
        yield from table(
            [("mode", "damping", "needed", "at", "at rest", ""), *map(_mode, passive_hands.modes)]
        )


def _worst(passive_hands: AbsoluteStability, worst: PassiveMode) -> str:
    """Say how the devices move that take most energy out, or need most damping."""
    moved = "all alike" if worst.name in ("common", "single") else f"in a {worst.name} mode"
    if worst.more is None:
        held = "with its devices clamped the scene is unstable, and no damping of theirs helps"
        return f"Devices that move {moved}: {held}."
    alone = "" if passive_hands.joined else ", each by itself"
    enough = f"With {worst.more:.4g} N*s/m more damping at each device they can't"
    if passive_hands.stable:
        return (
            f"Whatever gives back no more energy than it was given may hold the devices{alone}. Of their "
            f"damping {-worst.more:.4g} N*s/m could be spared, with the least left as they move {moved} at "
            f"{worst.frequency_hz:.4g} Hz."
        )
    if passive_hands.clamped_stable is False:
        return "Hands that hold the devices still are passive, and with these the scene is not stable."
    if passive_hands.stable is False:
        return (
            f"Hands that move the devices {moved} at {worst.frequency_hz:.4g} Hz get energy out of the scene "
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
    damping = "they differ" if passive_mode.damping is None else f"{passive_mode.damping:.6g} N*s/m"
    verdict = {True: "passive", False: "not passive", None: "undecided"}[passive_mode.passive]
    if passive_mode.more is None:
        needed, verdict = "none is enough", "not passive"
    elif passive_mode.needed is None:
        needed = f"{passive_mode.more:+.6g} N*s/m"
    elif passive_mode.error is None or not np.isfinite(passive_mode.error):
        needed = f"about {passive_mode.needed:.2g} N*s/m"
    else:
        needed = f"{known_digits(passive_mode.needed, passive_mode.error, DIGITS)} N*s/m"
    at = "" if passive_mode.frequency_hz is None else f"{passive_mode.frequency_hz:.5g} Hz"
    size = abs(passive_mode.stiffness or 0.0)
    stiffness = "" if passive_mode.stiffness is None else f"{size if size > 1e-6 else 0:.5g} N/m"
    return name, damping, needed, at, stiffness, verdict


def passive_document(passive_hands: AbsoluteStability) -> Plain:
    """Return the same as plain data."""
    modes = [{**document(mode), "damping_needed": document(mode.needed)} for mode in passive_hands.modes]
    return {"hands": "passive", **record(passive_hands, {"modes": modes})}


def feel_text(feel: Transparency) -> Lines:
    """Yield what is felt at a device, in words and numbers."""
    title = f"{feel.topology}: what a hand feels at {feel.at}{LINEARIZED if feel.linearized else ''}"
    yield from wrapped(title, "", "  ")
    yield from notes(*feel.notes, *feel.left_out)
    yield ""
    slow = feel.low_frequency
    if slow is not None:
        yield "  Of slow motions, the other hands as the scene has them:"
        parts = zip(("mass", "damping", "stiffness"), ("kg", "N*s/m", "N/m"), slow.errors, strict=True)
        for name, unit, error in parts:
            yield from labelled((name, measured(getattr(slow, name), error, unit)))
        if (network := feel.network_viscosity) is not None:
            share = measured(network.network, network.error, "N*s/m")
            yield from labelled(("of that", f"{share}, which the network adds"))
        if slow.mass < 0:
            yield from notes("a mass below 0: late forces act as negative inertia, for slow motions")
        yield ""
    headings = ("frequency", "impedance", "phase", "arrives", "copies apart", "alias")
    units = ("Hz", "N*s/m", "degrees", "mm/s/N", "mm/N", "")
    yield from table([headings, units, *_rows_shown(feel)], ">>>>>>")
    legend = [f"arrives: at {feel.between}"] if feel.between else []
    legend += [f"copies: of {feel.copy}, from the mean of the others'"] if feel.copy else []
    legend += ["alias: the largest part that sampling moves to another frequency, beside that at this one"]
    yield ""
    yield from sentences("; ".join(legend))
    if feel.hinf and feel.stable is not False:
        yield "\n  Largest gain at any frequency (H∞), forces of any course:"
        yield from table([_extreme(extremes) for extremes in feel.hinf])
    for noise in feel.h2:  # of a sample that is off by a mm, a µm is what a mm is of 1 N
        what, small = "1 N rms at every hand", "m"
        if noise.source != "hands":
            what, small = "1 mm rms on every device's samples", "µ"
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
        yield from notes(f"{spread}: rms {NOISE_RMS}, for {what}, white from tick to tick")


def _curves(feel: Transparency) -> list[tuple[NDArray[np.complex128], Floats, float, bool, str]]:
    """Return what is felt: responses (k,), their relative bounds (k,), a factor, if it is there, its name."""
    apart = bool(feel.copy)
    return [
        (feel.impedance, feel.bound, 1.0, True, "impedance (N·s/m)"),
        (
            *(feel.transmitted_admittance, feel.transmitted_bound, 1e3, bool(feel.between)),
            f"velocity at {feel.between} (mm/s/N)",
        ),
        (feel.error_per_force, feel.error_bound, 1e3, apart, f"copies of {feel.copy} apart (mm/N)"),
    ]


def _rows_shown(feel: Transparency) -> Iterator[tuple[str, ...]]:
    """Yield some lines of the table, the first and the last among them."""
    count = len(feel.frequency_hz)
    for place in sorted({round(value) for value in np.linspace(0, count - 1, min(SHOWN, count))}):
        sizes = [
            (float(abs(values[place]) * scale), bound[place]) for values, bound, scale, *_ in _curves(feel)
        ]
        size, arrives, apart = (known_digits(value, value * float(bound), DIGITS) for value, bound in sizes)
        phase = f"{np.degrees(np.angle(feel.impedance[place])):.2f}"
        others = (arrives if feel.between else "", apart if feel.copy else "")
        yield (f"{feel.frequency_hz[place]:.5g}", size, phase, *others, f"{feel.alias[place]:.1e}")


def _extreme(extremes: HinfGains) -> tuple[str, str]:
    """Return a norm and what it is of."""
    peak = extremes.sampled_data
    what, unit = ("velocity", "m/s/N") if extremes.of == "velocity" else ("copies apart", "m/N")
    size = "not known: beyond floats" if np.isnan(peak.norm) else "without end: it drifts"
    if np.isfinite(peak.norm):
        norm = measured(peak.norm, peak.error + 1e-11 * peak.norm, unit)
        size = f"{norm} at {peak.frequency_hz:.5g} Hz"
    return f"{extremes.mode}, {what}", size


def feel_document(feel: Transparency) -> Plain:
    """Return the same as plain data, in SI; complex numbers as pairs."""
    instead = {
        "hinf": {f"{extremes.mode} {extremes.of}": extremes for extremes in feel.hinf},
        "h2": {noise.source: noise for noise in feel.h2},
        "h2_rms": NOISE_RMS,
    }
    return record(feel, instead)


def feel_picture(feel: Transparency, kind: str = "bode", ax: Any = None) -> Any:
    """Draw the impedance, and what arrives elsewhere, as Bode's plot or Nyquist's; return the Figure.

    Into an `ax` of somebody's, of Bode's plot the magnitudes alone are drawn.
    """
    nyquist, axes = kind == "nyquist", [ax]
    if ax is None:
        figure = new_figure((4.2, 4.0) if nyquist else (5.2, 5.6))
        axes = figure.subplots(1 if nyquist else 2, 1, sharex=True, squeeze=False)[:, 0].tolist()
    size, *phases = axes
    size.set_title(f"{feel.topology}: felt at {feel.at}", fontsize=9)
    if nyquist:
        size.plot(feel.impedance.real, feel.impedance.imag, color=COLOURS[0])
        for line in (size.axvline, size.axhline):
            line(0.0, color="#999999", linewidth=0.6)
        size.set_aspect("equal", adjustable="datalim")
        size.set(xlabel="real part of the impedance (N·s/m)", ylabel="imaginary part (N·s/m)")
        for place, mark in ((0, "o"), (-1, "s")):
            at, label = feel.impedance[place], f"{feel.frequency_hz[place]:.3g} Hz"
            size.plot(at.real, at.imag, mark, color=COLOURS[0], markersize=5, label=label)
    else:
        for place, (values, _, scale, known, label) in enumerate(_curves(feel)):
            if known and np.any(values):
                look = {"color": COLOURS[place], "linestyle": ("-", "--", "-.")[place], "label": label}
                size.loglog(feel.frequency_hz, scale * np.abs(values), **look)
        size.set_ylabel("magnitude")
        axes[-1].set_xlabel("frequency (Hz)")
    for phase in phases:
        degrees = np.degrees(np.angle(feel.impedance))
        phase.semilogx(feel.frequency_hz, degrees, color=COLOURS[0])
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


def feel_rows(feel: Transparency) -> Tabled:
    """Return the columns of a table of responses, a row a frequency, and what it is of."""
    responses = (("impedance", "N*s/m"), ("transmitted admittance", "m/s/N"), ("error per force", "m/N"))
    headings = [TableColumn("frequency", "Hz")]
    headings += [
        TableColumn(f"{name} {which}", unit) for name, unit in responses for which in ("real", "imaginary")
    ]
    headings += [TableColumn(name) for name in ("alias", "bound", "transmitted bound", "error bound")]
    curves = _curves(feel)
    parts = [part for values, *_ in curves for part in (values.real, values.imag)]
    columns = [feel.frequency_hz, *parts, feel.alias, *(bound for _, bound, *_ in curves)]
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return headings, rows, {"at": feel.at, "left_out": list(feel.left_out)}
