"""What hands do and feel, as text, plain data, a picture and a table.

Takes: a `PassiveHands` or a `Feel`. Gives: of each its text and document; `feel_picture`, `write_feel`.
Guarantees: what the answer leaves out stands first; no digit beyond its bound.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.files import write_text
from apc.compiler.words import known_digits, measured, wrapped
from apc.distribution import program_version
from apc.optional import need
from apc.present.forms import document, json_text, note
from apc.present.pictures import FORMATS, check_result_path, write_figure
from apc.tables import SUFFIXES, Column, Row, blocks_of, write_table

if TYPE_CHECKING:
    from apc.hands.feel import Extremes, Feel
    from apc.hands.passivity import PassiveHands, PassiveMode

# Lines of a table of frequencies in a terminal.
SHOWN = 12

# Digits of a table's numbers, at most.
DIGITS = 6

LINEARIZED = ", linearized at its start"


def passive_text(found: PassiveHands) -> str:
    """Return whether a scene is stable with any passive hands, in words and numbers."""
    lines = wrapped(f"{found.topology}: {found.verdict}{LINEARIZED if found.linearized else ''}", "", "  ")
    for text in found.left_out:
        lines += note(text)
    lines.append("")
    if found.why:
        lines += wrapped(f"{found.why}.", "  ", "  ")
    if found.why and not found.modes:
        hint = (
            "Take the velocity by a backward difference of samples, as VirtualWall does, or none (damping 0)."
        )
        lines += wrapped(hint, "  ", "  ")
    worst = found.worst
    if worst is not None and not found.why:
        lines += wrapped(_worst(found, worst), "  ", "  ")
    lines += ["", f"  devices clamped  spectral radius {measured(found.clamped_radius, found.clamped_error)}"]
    if found.proof:
        lines += wrapped(found.proof, "  proof            ", " " * 19)
    if found.modes:
        rows = [("  mode", "damping", "needed", "at", "at rest", ""), *map(_mode, found.modes)]
        widths = [max(len(row[column]) for row in rows) for column in range(6)]
        lines.append("")
        lines += [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
    return "\n".join(lines)


def _worst(found: PassiveHands, worst: PassiveMode) -> str:
    """Say how the devices move that take most energy out, or need most damping."""
    moved = "all alike" if worst.name in ("common", "single") else f"in the mode {worst.name}"
    if worst.more is None:
        held = "with its devices clamped the scene is unstable, and no damping of theirs helps"
        return f"Devices that move {moved}: {held}."
    alone = "" if found.joined else ", each by itself"
    enough = f"With {worst.more:.4g} N*s/m more damping at each device they can't"
    if found.stable:
        return (
            f"Whatever gives back no more energy than it was given may hold the devices{alone}. Of their "
            f"damping {-worst.more:.4g} N*s/m could be spared, with the least left as they move {moved} at "
            f"{worst.frequency_hz:.4g} Hz."
        )
    if found.stable is False:
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


def _mode(one: PassiveMode) -> tuple[str, ...]:
    name = f"  {one.name}" + (f" × {one.multiplicity:,}" if one.multiplicity > 1 else "")
    damping = "they differ" if one.damping is None else f"{one.damping:.6g} N*s/m"
    if one.more is None:
        needed = "none is enough"
    elif one.needed is None:
        needed = f"{one.more:+.6g} N*s/m"
    elif one.error is None or not np.isfinite(one.error):
        needed = f"about {one.needed:.2g} N*s/m"
    else:
        needed = f"{known_digits(one.needed, one.error, DIGITS)} N*s/m"
    at = "" if one.frequency_hz is None else f"{one.frequency_hz:.5g} Hz"
    stiffness = (
        "" if one.stiffness is None else f"{abs(one.stiffness) if abs(one.stiffness) > 1e-6 else 0:.5g} N/m"
    )
    verdict = {True: "passive", False: "not passive", None: "undecided"}[one.passive]
    return name, damping, needed, at, stiffness, "not passive" if one.more is None else verdict


def passive_document(found: PassiveHands) -> dict[str, Any]:
    """Return the same as plain data."""
    modes = [{**document(one), "damping_needed": document(one.needed)} for one in found.modes]
    whole: dict[str, Any] = {"hands": "passive", **document(found, {"modes": modes})}
    return whole


def feel_text(found: Feel) -> str:
    """Return what is felt at a device, in words and numbers."""
    whole = f"{found.topology}: what a hand feels at {found.at}{LINEARIZED if found.linearized else ''}"
    lines = wrapped(whole, "", "  ")
    for text in (*found.notes, *found.left_out):
        lines += note(text)
    lines.append("")
    slow = found.low_frequency
    if slow is not None:
        lines += [
            "  Of slow motions, the other hands as the scene has them:",
            f"  mass             {measured(slow.mass, slow.errors[0], 'kg')}",
            f"  damping          {measured(slow.damping, slow.errors[1], 'N*s/m')}",
            f"  stiffness        {measured(slow.stiffness, slow.errors[2], 'N/m')}",
        ]
        if (network := found.network_viscosity) is not None:
            share = f"  of the network   {measured(network.network, network.error, 'N*s/m')}"
            by = "" if network.formula is None else f"; K ((T_n − T_c)/2 + T_d): {network.formula:.5g}"
            lines.append(share + by)
        lines.append("")
    rows = [("frequency", "impedance", "phase", "arrives", "copies apart", "alias"), *_rows_shown(found)]
    rows.insert(1, ("Hz", "N*s/m", "degrees", "mm/s/N", "mm/N", ""))
    widths = [max(len(row[column]) for row in rows) for column in range(6)]
    lines += ["  " + "  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    told = [
        f"arrives: at {found.between}" if found.between else "",
        f"copies: of {found.copy}" if found.copy else "",
    ]
    if any(told):
        lines += ["", *wrapped("; ".join(one for one in told if one), "  ", "  ")]
    if found.hinf:
        lines += ["", "  Largest gain at any frequency (H∞), forces of any course:"]
        lines += [_extreme(one) for one in found.hinf]
    for one in found.h2:
        values = [
            f"{what} {measured(value * 1e3, off * 1e3, unit)}"
            for what, value, off, unit in (
                ("copies apart", one.error_m, one.errors[0], "mm"),
                ("velocity", one.velocity_m_s, one.errors[1], "mm/s"),
            )
            if value is not None and off is not None
        ]
        what = "1 N rms of every hand" if one.source == "hands" else "1 m rms of every device's samples"
        words = f"{', '.join(values) or 'it drifts'} (rms) for {what}, new at each tick"
        lines += ["", *wrapped(words, "  ", "    ")]
    return "\n".join(lines)


def _rows_shown(found: Feel) -> Iterator[tuple[str, ...]]:
    """Yield some lines of the table, the first and the last among them."""
    count = len(found.frequency_hz)
    for place in sorted({round(one) for one in np.linspace(0, count - 1, min(SHOWN, count))}):
        numbers = (
            (abs(found.impedance[place]), found.bound),
            (abs(found.transmitted_admittance[place]) * 1e3, found.transmitted_bound),
            (abs(found.error_per_force[place]) * 1e3, found.error_bound),
        )
        size, arrives, apart = (
            known_digits(float(one), float(one * off[place]), DIGITS) for one, off in numbers
        )
        phase = f"{np.degrees(np.angle(found.impedance[place])):.2f}"
        yield (
            f"{found.frequency_hz[place]:.5g}",
            size,
            phase,
            arrives if found.between else "",
            apart if found.copy else "",
            f"{found.alias[place]:.1e}",
        )


def _extreme(one: Extremes) -> str:
    """Return a line of a norm."""
    peak = one.sampled_data
    unit = "m/s/N" if one.of == "velocity" else "m/N"
    what = f"{one.mode}, {'velocity' if one.of == 'velocity' else 'copies apart'}"
    if not np.isfinite(peak.norm):
        return f"  {what:<26}  without end: it drifts"
    size = measured(peak.norm, peak.error + 1e-11 * peak.norm, unit)
    return f"  {what:<26}  {size} at {peak.frequency_hz:.5g} Hz"


def feel_document(found: Feel) -> dict[str, Any]:
    """Return the same as plain data, in SI; complex numbers as pairs."""
    slow = found.low_frequency
    fields: dict[str, Any] = {
        "low_frequency": None if slow is None else document(slow),
        "hinf": {f"{one.mode} {one.of}": document(one) for one in found.hinf},
        "h2": {one.source: document(one) for one in found.h2},
    }
    for name in ("impedance", "transmitted_admittance", "error_per_force"):
        fields[name] = [document(complex(one)) for one in getattr(found, name).tolist()]
    whole: dict[str, Any] = document(found, fields)
    return whole


def feel_picture(found: Feel, kind: str = "bode", ax: Any = None) -> Any:
    """Draw the impedance, and what arrives elsewhere, as Bode's plot or Nyquist's; return the Figure.

    Into an `ax` of somebody's, of Bode's plot the magnitudes alone are drawn.
    """
    figures = need("matplotlib.figure", "plot")
    if kind == "nyquist":
        ax = ax or figures.Figure(figsize=(4.2, 4.0), layout="constrained").subplots()
        ax.plot(found.impedance.real, found.impedance.imag, color="#000000")
        ax.axvline(0.0, color="#999999", linewidth=0.6)
        ax.axhline(0.0, color="#999999", linewidth=0.6)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("real part of the impedance (N·s/m)")
        ax.set_ylabel("imaginary part (N·s/m)")
        for place, mark in ((0, "o"), (len(found.frequency_hz) - 1, "s")):
            at, label = found.impedance[place], f"{found.frequency_hz[place]:.3g} Hz"
            ax.plot(at.real, at.imag, mark, color="#000000", markersize=5, label=label)
        _legend(ax, below=0.16, columns=2)
        ax.set_title(f"{found.topology}: felt at {found.at}", fontsize=9)
        return ax.figure
    size, phase = ax, None
    if ax is None:
        size, phase = figures.Figure(figsize=(5.2, 5.6), layout="constrained").subplots(2, 1, sharex=True)
    size.loglog(found.frequency_hz, np.abs(found.impedance), color="#000000", label="impedance (N·s/m)")
    if found.between:
        size.loglog(
            *(found.frequency_hz, 1e3 * np.abs(found.transmitted_admittance)),
            color="#0072B2",
            linestyle="--",
            label=f"velocity at {found.between} (mm/s/N)",
        )
    if found.copy and np.any(found.error_per_force):
        size.loglog(
            *(found.frequency_hz, 1e3 * np.abs(found.error_per_force)),
            color="#D55E00",
            linestyle="-.",
            label=f"copies of {found.copy} apart (mm/N)",
        )
    size.set_ylabel("magnitude")
    size.set_title(f"{found.topology}: felt at {found.at}", fontsize=9)
    last = size if phase is None else phase
    last.set_xlabel("frequency (Hz)")
    handles, labels = size.get_legend_handles_labels()
    _legend(last, below=0.2, columns=1, handles=handles, labels=labels)
    if phase is None:
        return size.figure
    phase.semilogx(found.frequency_hz, np.degrees(np.angle(found.impedance)), color="#000000")
    phase.set_ylabel("phase of the impedance (°)")
    if np.abs(np.angle(found.impedance)).max() <= np.pi / 2:
        phase.set_yticks(range(-90, 91, 45))
    return size.figure


def _legend(ax: Any, *, below: float, columns: int, **named: Any) -> None:
    """Name curves below an Axes, so many of its heights, over nothing."""
    look = {"fontsize": 8, "frameon": False, "ncols": columns}
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -below), **look, **named)


def write_feel(path: Path, found: Feel, *, nyquist: bool = False) -> None:
    """Write responses to a picture, a table or JSON, by the suffix."""
    suffix = check_result_path(path)
    if suffix in FORMATS:
        write_figure(feel_picture(found, "nyquist" if nyquist else "bode"), path)
    elif suffix in SUFFIXES:
        made = {"apc": program_version(), "at": found.at, "left_out": list(found.left_out)}
        write_table(path, _columns(), blocks_of(_rows(found)), made)
    else:
        write_text(path, json_text(found.to_dict()))


def _columns() -> list[Column]:
    """Return the columns of a table of responses."""
    names = (
        ("frequency", "Hz"),
        ("impedance real", "N*s/m"),
        ("impedance imaginary", "N*s/m"),
        ("transmitted admittance real", "m/s/N"),
        ("transmitted admittance imaginary", "m/s/N"),
        ("error per force real", "m/N"),
        ("error per force imaginary", "m/N"),
        ("alias", ""),
        ("bound", ""),
        ("transmitted bound", ""),
        ("error bound", ""),
    )
    return [Column(name, unit) for name, unit in names]


def _rows(found: Feel) -> Iterator[Row]:
    """Yield a row a frequency."""
    for place, frequency in enumerate(found.frequency_hz.tolist()):
        numbers = (found.impedance[place], found.transmitted_admittance[place], found.error_per_force[place])
        parts = [float(part) for one in numbers for part in (one.real, one.imag)]
        bounds = (float(one[place]) for one in (found.bound, found.transmitted_bound, found.error_bound))
        yield (frequency, *parts, float(found.alias[place]), *bounds)
