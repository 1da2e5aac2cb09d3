"""Critical values, margins, sensitivities, sweeps and many analyses as text, plain data and tables.

Takes: results of `vary` and `sweeps`. Gives: their texts, documents and tables.
Guarantees: a number is shown to the digits that its error leaves known.
Does not: compute, but for the root locus that a picture of a critical value is.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from apc.compiler.words import counted, in_hertz, known_digits, measured, with_unit, wrapped
from apc.optional import need
from apc.present.forms import MEANT, document, note

if TYPE_CHECKING:
    import pandas

    from apc.sweeps.sweep import Sweep
    from apc.vary.critical import Critical
    from apc.vary.many import Analyses
    from apc.vary.margins import Margins
    from apc.vary.sensitivity import Sensitivities, Sensitivity

SHOWN = 6  # rows of the table of what moves the radius most
DIGITS = 3  # of a change

NONE_TOLD = "what moves the radius most: no change of it can be told from rounding"


def critical_text(found: Critical) -> str:
    """Return where a scene's verdict changes with a parameter."""
    low, high = (with_unit(f"{one:.6g}", found.unit) for one in found.scanned)
    present = with_unit(f"{found.present:.6g}", found.unit)
    lines = [f"{found.topology}: {found.parameter} is {present}"]
    if found.groups:
        own = [
            f"{'several values' if value is None else with_unit(f'{value:.6g}', found.unit)} at {group}"
            for group, value in found.groups
        ]
        whom = "groups" if len(found.groups) > 1 else "its peers"
        lines = [f"{found.topology}: {found.parameter}, one value for all {whom}"]
        lines += note(f"now {', '.join(own)}")
    if found.criterion in MEANT:
        lines += note(MEANT[found.criterion])
    for text in found.left_out:
        lines += note(text)
    lines.append("")
    if found.value is None:
        verdict = (
            found.verdict.replace("value scanned", "number looked at") if found.counted else found.verdict
        )
        lines += wrapped(verdict, "  ", "  ")
    if not found.enters:
        return "\n".join(lines)
    if found.counted:
        return "\n".join([*lines, *_count_lines(found)])
    for one in found.crossings:
        mark = "→" if one.value == found.value else " "
        exact = f"{with_unit(f'{one.value:.15g}', found.unit)}, exact"
        value = measured(one.value, one.error, found.unit) if one.error else exact
        lines.append(f"{mark} {value}")
        kind = "jump, " if one.kind == "jump" else ""
        turns = f", {in_hertz(one.frequency_hz)}" if one.frequency_hz == one.frequency_hz else ""
        lines.append(f"    {kind}stable {one.stable_side} it{turns}, {one.proof}")
    lines += ["", f"  scanned from {low} to {high}"]
    lines.append(f"  {counted(found.looked, 'value')} looked at: two crossings near to each other could hide")
    if found.left_open:
        parts = [" to ".join(with_unit(f"{end:.6g}", found.unit) for end in one) for one in found.left_open]
        rest = f" and {len(parts) - SHOWN} more" if len(parts) > SHOWN else ""
        lines += wrapped(f"the verdict is left open from {', '.join(parts[:SHOWN])}{rest}", "  ", "  ")
    if not found.whole:
        lines.append("  an eigenvalue keeps near to the boundary: more crossings could hide")
    return "\n".join(lines)


def _count_lines(found: Critical) -> list[str]:
    """Return which numbers of peers are stable, and how many were looked at."""
    first, last = (int(one) for one in found.scanned)
    ends = [math.floor(one.boundary) for one in found.crossings]
    stretches = list(zip([first, *(one + 1 for one in ends)], [*ends, last], strict=True))
    stable = found.crossings[0].stable_side == "below" if found.crossings else False
    names = [f"{one:,d}" if one == other else f"{one:,d} to {other:,d}" for one, other in stretches]
    width = max(map(len, names))
    lines = []
    if not found.crossings:
        names, stretches = [], []
    for name, stretch in zip(names, stretches, strict=True):
        mark = "→" if stable and found.value in stretch else " "
        lines.append(f"{mark} {name:<{width}}  {'stable' if stable else 'unstable'}")
        stable = not stable
    lines.append("")
    if found.looked == last - first + 1:
        return [*lines, f"  every number from {first:,d} to {last:,d} was looked at"]
    looked = f"{found.looked} numbers from {first:,d} to {last:,d} were looked at, those on either side of a "
    return [
        *lines,
        *wrapped(f"{looked}change among them; a change and back between two could hide", "  ", "  "),
    ]


def critical_picture(found: Critical, ax: Any) -> Any:
    """Draw where the eigenvalues go; return the matplotlib Axes."""
    from apc.present.eigenvalues import locus_picture
    from apc.vary.locus import root_locus

    return locus_picture(root_locus(found.system, found), ax)


def critical_document(found: Critical) -> dict[str, Any]:
    """Return where a scene's verdict changes with a parameter as plain data."""
    told: dict[str, Any] = document(found, {"groups": dict(found.groups)})
    return told


def margins_text(found: Margins) -> str:
    """Return the table of the margins, of at most 80 columns."""
    if not found.rows:
        return "\n".join(note(f"margins {found.note}"))
    width = max(len(one.parameter) for one in found.rows)
    lines = [f"  {'may grow':<{width}}  from           to               times  at"]
    for one in found.rows:
        name, unit = f"  {one.parameter:<{width}}  ", one.unit
        start = with_unit(f"{one.present:.5g}", unit)
        if one.note:
            lines.append(f"{name}{start:<14} not looked for: {one.note}")
            continue
        if one.value is None:
            lines.append(f"{name}{start:<14} none found up to {with_unit(f'{one.scanned:.5g}', unit)}")
            continue
        end = with_unit(known_digits(one.value, one.error or 0.0, 7), unit)
        times = f"{one.factor:.4g}" if one.factor is not None else "–"
        jump = ", jump" if one.kind == "jump" else ""
        at = "–" if one.frequency_hz is None else in_hertz(one.frequency_hz)
        lines.append(f"{name}{start:<14} {end:<16} {times:>5}  {at}{jump}")
    if found.note:
        lines += note(found.note)
    return "\n".join(lines)


def margins_document(found: Margins) -> dict[str, Any]:
    """Return the margins as plain data."""
    return {"margins": document(found.rows), "note": found.note}


def sensitivities_text(found: Sensitivities) -> str:
    """Return the table "what moves it most", of at most 80 columns."""
    # Eigenvalues that share the radius often change alike, and then one row tells it.
    alike: dict[tuple[str, str], list[Sensitivity]] = {}
    for row in found.rows:
        if abs(row.derivative) > row.error and row.relative:  # else it can't be told from 0
            change = _change(row.relative / 100, row.error * abs(row.value) / 100)
            alike.setdefault((row.parameter, change), []).append(row)
    shown = list(alike.items())[:SHOWN]
    if not shown:
        told = found.note if len(found.active) < 2 else ""
        return "\n".join(note(told or NONE_TOLD))
    width = max(len(name) for (name, _), _ in shown)
    lines = ["  what moves it most" + " " * max(width - 16, 2) + "value            per percent"]
    for (name, change), rows in shown:
        some = ", ".join(str(row.mode + 1) for row in rows) if len(rows) < len(found.active) else ""
        value = with_unit(f"{rows[0].value:.6g}", rows[0].unit)
        lines.append(f"  {name:<{width}}  {value:<16} {change}{f'  mode {some}' if some else ''}")
    if found.note:
        lines += note(found.note)
    return "\n".join(lines)


def _change(value: float, error: float) -> str:
    """Return a change to three digits, fewer where its error leaves them open."""
    known = math.floor(math.log10(abs(value) / error)) if error else DIGITS
    return f"{value:+.{min(max(known, 1), DIGITS) - 1}e}"


def sensitivities_document(found: Sensitivities) -> dict[str, Any]:
    """Return the derivatives as plain data."""
    return {
        "spectral_radius": found.radius,
        "active": [{"eigenvalue": document(value), "system": name} for value, name in found.active],
        "derivatives": document(found.rows),
        "note": found.note,
    }


def analyses_text(found: Analyses) -> str:
    """Return many analyses in a few lines: what varied, the verdicts."""
    lines = [f"{found.topology}: {found.verdict.size:,} points"]
    for text in found.left_out:
        lines += note(text)
    for name, values in zip(found.parameters, found.values, strict=True):
        lines.append(f"  {name}: {values.min():g} … {values.max():g}")
    counts = (Counter(one.ravel().tolist()) for one in (found.verdict, found.message))
    return "\n".join([*lines, *_verdict_lines(*counts)])


def analyses_document(found: Analyses) -> dict[str, Any]:
    """Return many analyses as plain data, a list a column."""
    columns = {heading: column.tolist() for heading, column in _analyses_columns(found).items()}
    return {"topology": found.topology, "left_out": list(found.left_out), **document(columns)}


def analyses_table(found: Analyses) -> pandas.DataFrame:
    """Return many analyses as a pandas table, a row a point."""
    return need("pandas", "data").DataFrame(_analyses_columns(found))


def _analyses_columns(found: Analyses) -> dict[str, NDArray[Any]]:
    columns = {
        "verdict": found.verdict,
        "spectral_radius": found.spectral_radius,
        "spectral_radius_error": found.spectral_radius_error,
        "rigid_modes": found.rigid_modes,
        "frequency [Hz]": found.frequency_hz,
        "damping_ratio": found.damping_ratio,
        "message": found.message,
    }
    every = {**dict(zip(found.parameters, found.values, strict=True)), **columns}
    return {heading: column.ravel() for heading, column in every.items()}


def _verdict_lines(verdicts: Counter[str], messages: Counter[str]) -> list[str]:
    """Return how many points have each verdict, and what most of those at fault say."""
    counts = sorted(verdicts.items(), key=lambda item: (-item[1], item[0]))
    lines = [f"  {count:>10,} × {verdict}" for verdict, count in counts]
    said = Counter({text: count for text, count in messages.items() if text})
    for text, count in said.most_common(1):
        lines += note(f"at {count:,} of them: {text}")
    return lines


def sweep_text(found: Sweep) -> str:
    """Return a sweep in a few lines: where the rows are, what was swept, the verdicts."""
    where = f" → {found.out}" if found.out else ""
    lines = [f"{found.topology}: {found.points:,} points{where}"]
    for text in found.made_of["left_out"]:
        lines += note(text)
    for axis in found.grid.axes:
        ends = f"{float(axis.values[0]):g} … {float(axis.values[-1]):g}"
        lines.append(
            f"  {axis.free.label}: {with_unit(ends, axis.unit)}, {counted(len(axis.values), 'value')}"
        )
    lines += _verdict_lines(found.counts, found.messages)
    return "\n".join([*lines, *(f"  note: {one}" for one in found.notes)])


def sweep_document(found: Sweep) -> dict[str, Any]:
    """Return what a sweep is and how it came out, without its rows, as plain data."""
    return {
        **found.made_of,
        "columns": list(found.headings),
        "verdicts": dict(found.verdicts),
        "out": str(found.out) if found.out else None,
        "notes": list(found.notes),
    }


def sweep_table(found: Sweep) -> pandas.DataFrame:
    """Return a sweep as a pandas table, with the headings as its columns."""
    return need("pandas", "data").DataFrame(dict(zip(found.headings, found.columns, strict=True)))
