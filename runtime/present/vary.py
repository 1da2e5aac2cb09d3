"""Critical values, margins, sensitivities, sweeps and many analyses as text, plain data and tables.

Takes: results of `vary` and `sweeps`. Gives: their texts, documents and tables.
Guarantees: a number is shown to the digits that its error leaves known.
Does not: compute, but for the root locus that a picture of a critical value is.
"""

from __future__ import annotations

import math
from collections import Counter
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from apc.compiler.words import counted, in_hertz, known_digits, measured, with_unit, wrapped
from apc.optional import need
from apc.present.forms import MEANT, as_shown, document, note, notes, quantity, record, table

if TYPE_CHECKING:
    import pandas

    from apc.sweeps.sweep import Sweep
    from apc.vary.critical import Critical
    from apc.vary.crossing import Crossing
    from apc.vary.many import Analyses
    from apc.vary.margins import Margins
    from apc.vary.sensitivity import Sensitivities

SHOWN = 6  # rows of the table of what moves the radius most; digits of a value in a sentence

# A change of the radius by less than this share of it, for a change of a number by its own size, can't be
# told from rounding.
LEAST_CHANGE = 1e-9

NONE_TOLD = "what moves the radius most: no change of it can be told from rounding"


def critical_text(found: Critical) -> str:
    """Return where a scene's verdict changes with a parameter."""
    unit = found.unit
    now = quantity(found.present, unit)
    if found.groups:
        values = ["several values" if value is None else quantity(value, unit) for _, value in found.groups]
        now = ", ".join(f"{value} at {group}" for value, (group, _) in zip(values, found.groups, strict=True))
        now += f", to be one value for all {'groups' if len(found.groups) > 1 else 'its peers'}"
    said = _stable_ranges(found)
    if not said:
        wording = ("value scanned", "number looked at") if found.counted else ("", "")
        said = found.verdict.replace(*wording)
    meant = [MEANT[found.criterion]] if found.criterion in MEANT else []
    lines = wrapped(f"{found.topology}: {said}")
    lines += [*notes([*meant, *found.left_out, f"{found.parameter} is now {now}"]), ""]
    if not found.enters:
        return "\n".join(lines)
    if found.counted:
        return "\n".join([*lines, *_count_lines(found)])
    for one in found.crossings:
        exact = f"{quantity(one.value, unit, 15)}, exact"
        by, shown = as_shown(one.value, unit)
        value = measured(one.value * by, one.error * by, shown) if one.error else exact
        lines.append(f"  {value}")
        kind = "jump, " if one.kind == "jump" else ""
        turns = "" if math.isnan(one.frequency_hz) else f", {in_hertz(one.frequency_hz)}"
        lines.append(f"    {kind}stable {one.stable_side} it{turns}, {one.proof}")
    lines += [*[""] * bool(found.crossings), f"  scanned {_span(found.scanned, unit)}"]
    lines.append(f"  {counted(found.looked, 'value')} looked at: two crossings near to each other could hide")
    if found.left_open:
        parts = ", ".join(_span(one, unit) for one in found.left_open[:SHOWN])
        rest = f" and {len(found.left_open) - SHOWN} more" if len(found.left_open) > SHOWN else ""
        lines += wrapped(f"the verdict is left open {parts}{rest}", "  ", "  ")
    if not found.whole:
        lines.append("  an eigenvalue keeps near to the boundary: more crossings could hide")
    return "\n".join(lines)


def _stable_ranges(found: Critical) -> str:
    """Return where a scene is stable in a sentence; nothing where no crossing was found."""
    ranges, begin = [], ""
    for one in found.crossings:
        if found.counted:
            value = f"{math.floor(one.boundary) + (one.stable_side == 'above'):,d}"
        else:
            value = quantity(_on_stable_side(one), found.unit)
        if one.stable_side == "above":
            begin = value
            continue
        most = f"up to {value}" if found.counted else f"below {value}"
        ranges.append(f"from {begin} {most}" if begin else most)
        begin = ""
    ranges += [f"from {begin} on" if found.counted else f"above {begin}"] if begin else []
    return f"stable with {found.parameter} {', and '.join(ranges)}" if ranges else ""


def _on_stable_side(crossing: Crossing) -> float:
    """Return a crossing as far inside as its error, to no digit that the error hides."""
    inward = -crossing.error if crossing.stable_side == "below" else crossing.error
    if not math.isfinite(inward):
        return crossing.value
    known = Decimal(crossing.value).adjusted() - Decimal(crossing.error).adjusted() if inward else SHOWN
    rounding = ROUND_FLOOR if crossing.stable_side == "below" else ROUND_CEILING
    context = Context(min(max(known, 1), SHOWN), rounding)
    return float(context.create_decimal_from_float(crossing.value + inward))


def _span(ends: tuple[float, float], unit: str) -> str:
    return f"from {quantity(ends[0], unit)} to {quantity(ends[1], unit)}"


def _count_lines(found: Critical) -> list[str]:
    """Return which numbers of peers are stable, and how many were looked at."""
    first, last = map(int, found.scanned)
    rows, begin = [], first
    for crossing in found.crossings:
        end = math.floor(crossing.boundary)
        rows.append((begin, end, crossing.stable_side == "below"))
        begin = end + 1
    if rows:
        rows.append((begin, last, not rows[-1][-1]))
    lines = []
    for low, high, stable in rows:
        name = f"{low:,d}" if low == high else f"{low:,d} to {high:,d}"
        lines.append((name, "stable" if stable else "unstable"))
    looked = (
        f"every number from {first:,d} to {last:,d} was looked at"
        if found.looked == last - first + 1
        else f"{found.looked} numbers from {first:,d} to {last:,d} were looked at, those on either side of a "
        "change among them; a change and back between two could hide"
    )
    listed = [*table(lines), ""] if lines else []
    return [*listed, *wrapped(looked, "  ", "  ")]


def critical_picture(found: Critical, ax: Any) -> Any:
    """Draw where the eigenvalues go; return the matplotlib Axes."""
    from apc.present.eigenvalues import locus_picture
    from apc.vary.locus import root_locus

    return locus_picture(root_locus(found.system, found), ax)


def critical_document(found: Critical) -> dict[str, Any]:
    """Return where a scene's verdict changes with a parameter as plain data."""
    return record(found, {"groups": dict(found.groups)})


def margins_text(found: Margins) -> str:
    """Return the table of the margins, of at most 80 columns."""
    if not found.rows:
        return "\n".join(note(f"margins {found.note}"))
    width = max(len(one.parameter) for one in found.rows)
    ends = []
    for one in found.rows:
        value, error = one.value or 0.0, one.error or 0.0
        by, shown = as_shown(value, one.unit)
        ends.append("" if one.value is None else with_unit(known_digits(value * by, error * by, 7), shown))
    wide = max(16, *map(len, ends))
    lines = [f"  {'may grow':<{width}}  from           {'to':<{wide}} times  at"]
    for one, end in zip(found.rows, ends, strict=True):
        start = f"  {one.parameter:<{width}}  {quantity(one.present, one.unit, 5):<14}"
        if one.note:
            lines.append(f"{start} not looked for: {one.note}")
        elif one.value is None:
            lines.append(f"{start} none found up to {quantity(one.scanned, one.unit, 5)}")
        else:
            times = "–" if one.factor is None else f"{one.factor:.4g}"
            at = in_hertz(math.nan if one.frequency_hz is None else one.frequency_hz)
            jump = ", jump" if one.kind == "jump" else ""
            lines.append(f"{start} {end:<{wide}} {times:>5}  {at}{jump}")
    return "\n".join([*lines, *note(found.note)])


def margins_document(found: Margins) -> dict[str, Any]:
    """Return the margins as plain data."""
    return {"margins": document(found.rows), "note": found.note}


def sensitivities_text(found: Sensitivities) -> str:
    """Return the table "what moves it most", of at most 80 columns."""
    # Eigenvalues that share the radius often change alike, and then one row tells it.
    same: dict[tuple[str, str, str], list[str]] = {}
    for row in found.rows:
        if abs(row.relative) > LEAST_CHANGE * found.radius:
            key = (row.parameter, f"{quantity(row.value, row.unit):<15}", f"{row.relative / 100:+.2e}")
            same.setdefault(key, []).append(str(row.mode + 1))
    if not same:
        told = found.note if len(found.active) < 2 else ""
        return "\n".join(note(told or NONE_TOLD))
    rows: list[tuple[str, ...]] = [("what moves it most", f"{'value':<15}", "per percent")]
    for (*cells, change), modes in list(same.items())[:SHOWN]:
        which = f"  mode {', '.join(modes)}" if len(modes) < len(found.active) else ""
        rows.append((*cells, change + which))
    return "\n".join([*table(rows), *note(found.note)])


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
    lines += notes(found.left_out)
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
    lines += notes(found.made_of["left_out"])
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
