"""Parameters, critical values, margins, sensitivities, sweeps, batches: as text, data and tables.

Takes: results of `parameter_studies` and `sweeps`, `Parameters`. Gives: their texts, documents and tables.
Guarantees: numbers have the digits that their errors permit; parameters are in a unit valid for `--set`.
Does not: compute, except for the root locus in a picture of a critical value.
"""

from __future__ import annotations

import math
from collections import Counter
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.wording import counted, in_hertz, with_unit, wrapped
from apc.output.formatting import (
    JUMP,
    MEANT,
    Lines,
    Plain,
    document,
    notes,
    quantity,
    record,
    rounds_to,
    sentences,
    span,
    table,
    uncertain,
    without_dashes,
)
from apc.parameter_values.display_units import as_shown
from apc.studies.crossing import PERIOD
from apc.support.optional import need

if TYPE_CHECKING:
    import pandas

    from apc.parameter_values.parameter_listing import Parameters, Settable
    from apc.studies.batch_analysis import Analyses
    from apc.studies.critical_values import Critical
    from apc.studies.crossing import Crossing
    from apc.studies.resumable_sweep import Sweep

ROUGH = 1e-2  # of a value: its error is then said to be no slip
SHOWN = 6  # rows of the table of sensitivities; digits of a value in a sentence


HOW = 'Set a parameter with --set NAME="VALUE UNIT". Options, such as types, are set in the file.'


def critical_text(critical: Critical) -> Lines:
    """Yield the critical values of a parameter: the stable range, a table, the search."""
    unit = critical.unit
    text = _stable_ranges(critical)
    if not text:
        text = str(critical.verdict or "")
        if critical.counted and critical.verdict and critical.has_effect:
            text = f"{critical.verdict.word} at every evaluated number"
    yield from wrapped(f"{critical.topology}: {text}", "", "  ")
    yield from notes(MEANT.get(critical.criterion, ""), *critical.limitations)
    yield ""
    if critical.counted and critical.has_effect:
        yield from _count_lines(critical)
    elif critical.crossings:
        rows = [("critical value", "stable side", "frequency", "proof")]
        for crossing in critical.crossings:
            value = uncertain(crossing.value, crossing.error, unit)
            rows.append((value, _sides(crossing), in_hertz(crossing.frequency_hz), str(crossing.proof)))
        yield from table(*without_dashes(rows, "<<><"))
        if any(crossing.kind == "jump" for crossing in critical.crossings):
            yield from sentences(JUMP)
        yield ""
    yield from sentences(f"current value: {_present_value(critical)}")
    if not critical.has_effect or critical.counted:
        return
    searched = f"searched: {_span(critical.searched_to, unit)}, {counted(critical.evaluations, 'value')}"
    yield from sentences(f"{searched}; two close crossings could be missed")
    if any(crossing.kind == PERIOD for crossing in critical.crossings):
        yield from sentences(
            "periods inside the range lead to a frame of too many ticks with the other clocks"
        )
    if any(
        crossing.kind != PERIOD and crossing.error > ROUGH * abs(crossing.value)
        for crossing in critical.crossings
    ):
        yield from sentences(
            "no narrower bound: within its error the growth bounds do not decide the verdict"
        )
    if critical.isolated:
        ends = " and ".join(quantity(value, unit) for value in critical.isolated)
        yield from sentences(f"at {ends} the verdict differs from all neighbouring values")
    if critical.undecided:
        parts = ", ".join(_span(pair, unit) for pair in critical.undecided[:SHOWN])
        rest = (
            f" and {len(critical.undecided) - SHOWN} more ranges" if len(critical.undecided) > SHOWN else ""
        )
        yield from sentences(f"undecided: {parts}{rest}")
    if not critical.complete:
        yield from sentences("an eigenvalue stays close to the unit circle; more crossings could be missed")


def _present_value(critical: Critical) -> str:
    """Return the present value of a parameter; of a parameter with values by group, each of them."""
    if not critical.groups:
        return quantity(critical.current, critical.unit)
    values = ", ".join(
        f"{'several values' if value is None else quantity(value, critical.unit)} at {group}"
        for group, value in critical.groups
    )
    return f"{values}; varied as one value for all {'groups' if len(critical.groups) > 1 else 'peers'}"


def _stable_ranges(critical: Critical) -> str:
    """Return the stable range of a model in a sentence; empty without a crossing."""
    ranges, begin, included, after, least = [], "", None, "from", -math.inf
    for crossing in critical.crossings:
        if critical.counted:
            value = f"{math.floor(crossing.boundary) + (crossing.stable_side == 'above'):,d}"
        else:
            by, shown = as_shown(crossing.value, critical.unit)
            error = 0.0 if crossing.stable_at else float(crossing.error * by)
            number = float(crossing.value * by)
            if not rounds_to(number, error):  # otherwise the same digits as in the table
                number = _on_stable_side(number, error, crossing.stable_side)
            value = with_unit(f"{number:.{SHOWN}g}", shown)
        if crossing.stable_side == "above":
            begin, included = value, critical.counted or crossing.stable_at
            after = "above" if crossing.kind == "jump" and crossing.stable_at is False else "from"
            least = crossing.value + crossing.error
            continue
        if begin and not critical.counted and crossing.value - crossing.error <= least + 1e-9 * abs(least):
            begin = ""  # stable at a single value
            continue
        most = f"up to {value}" if critical.counted or crossing.stable_at else f"below {value}"
        ranges.append(f"{after} {begin} {most}" if begin else most)
        begin = ""
    ranges += [f"from {begin} on" if included else f"above {begin}"] if begin else []
    return f"stable with {critical.parameter} {', and '.join(ranges)}" if ranges else ""


def _sides(crossing: Crossing) -> str:
    """Return the stable side of a crossing; of a jump, whether its value is stable."""
    if crossing.kind != "jump":
        return crossing.stable_side
    included = {True: " (jump, inclusive)", False: " (jump, exclusive)", None: " (jump)"}
    return f"{crossing.stable_side}{included[crossing.stable_at]}"


def _on_stable_side(value: float, error: float, side: str) -> float:
    """Return a crossing as far inside as its error, to the digits that the error leaves and one more."""
    inward = -error if side == "below" else error
    if not math.isfinite(inward):
        return value
    known = Decimal(value).adjusted() - Decimal(error).adjusted() + 1 if inward else SHOWN
    context = Context(min(max(known, 1), SHOWN), ROUND_FLOOR if side == "below" else ROUND_CEILING)
    return float(context.create_decimal_from_float(value + inward))


def _span(ends: tuple[float, float], unit: str) -> str:
    """Return the text of a range, or of its only value."""
    if ends[0] == ends[1]:
        return quantity(ends[0], unit)
    return f"{quantity(ends[0], unit)} to {quantity(ends[1], unit)}"


def _count_lines(critical: Critical) -> Lines:
    """Yield the stable numbers of peers, and the number analyzed."""
    first, last = map(int, critical.searched_to)
    sides = [crossing.stable_side for crossing in critical.crossings]
    ends = [math.floor(crossing.boundary) for crossing in critical.crossings]
    lines = [
        (f"{low:,d}" if low == high else f"{low:,d} to {high:,d}", "stable" if stable else "unstable")
        for low, high, stable in zip(
            [first, *(end + 1 for end in ends)],
            [*ends, last],
            [*(side == "below" for side in sides), sides[-1:] == ["above"]],
            strict=True,
        )
        if sides
    ]
    if lines:
        yield from table(lines)
        yield ""
    evaluations = f"every number from {first:,d} to {last:,d} was evaluated"
    if critical.evaluations != last - first + 1:
        evaluations = (
            f"{critical.evaluations} numbers from {first:,d} to {last:,d} were evaluated, including those on "
            "both sides of each change; a change and its reverse between two of them could be missed"
        )
    yield from sentences(evaluations)


def critical_picture(critical: Critical, ax: Any) -> Any:
    """Draw where the eigenvalues go; return the matplotlib Axes."""
    from apc.output.analysis_output import locus_picture
    from apc.studies.root_locus import root_locus

    return locus_picture(root_locus(critical.model, critical), ax)


def critical_document(critical: Critical) -> Plain:
    """Return the critical values of a parameter as plain data."""
    return record(critical, {"verdict": critical.verdict or "", "groups": dict(critical.groups)})


def analyses_text(analyses: Analyses) -> Lines:
    """Yield many analyses in a few lines: the varied parameters, the verdicts."""
    yield f"{analyses.topology}: {analyses.verdict.size:,} points"
    yield from notes(*analyses.limitations)
    for name, values in zip(analyses.parameters, analyses.values, strict=True):
        yield f"  {name}: {values.min():g} … {values.max():g}"
    yield from _verdict_lines(
        *(Counter(values.ravel().tolist()) for values in (analyses.verdict, analyses.message))
    )


def analyses_document(analyses: Analyses) -> Plain:
    """Return many analyses as plain data, a list a column."""
    columns = {heading: column.tolist() for heading, column in _analyses_columns(analyses).items()}
    return {"topology": analyses.topology, "limitations": list(analyses.limitations), **document(columns)}


def analyses_table(analyses: Analyses) -> pandas.DataFrame:
    """Return many analyses as a pandas table, a row a point."""
    return need("pandas", "data").DataFrame(_analyses_columns(analyses))


def _analyses_columns(analyses: Analyses) -> dict[str, NDArray[Any]]:
    """Return the columns of a table of analyses by heading: the parameters, then the results."""
    columns = {
        "verdict": analyses.verdict,
        "spectral_radius": analyses.spectral_radius,
        "spectral_radius_error": analyses.spectral_radius_error,
        "rigid_modes": analyses.rigid_modes,
        "frequency [Hz]": analyses.frequency_hz,
        "damping_ratio": analyses.damping_ratio,
        "message": analyses.message,
    }
    every = {**dict(zip(analyses.parameters, analyses.values, strict=True)), **columns}
    return {heading: column.ravel() for heading, column in every.items()}


def _verdict_lines(verdicts: Counter[str], messages: Counter[str]) -> Lines:
    """Yield the number of points with each verdict, and the most frequent error."""
    ordered = sorted(verdicts.items(), key=lambda item: (-item[1], item[0]))
    yield ""
    yield from table([("points", "verdict"), *((f"{count:,}", verdict) for verdict, count in ordered)], "><")
    counter = Counter({text: count for text, count in messages.items() if text})
    for text, count in counter.most_common(1):
        yield from notes(f"at {count:,} of them: {text}")


def sweep_text(sweep: Sweep) -> Lines:
    """Yield a sweep in a few lines: the file, the swept parameters, the verdicts."""
    where = f" → {sweep.out}" if sweep.out else ""
    yield f"{sweep.topology}: {sweep.points:,} points{where}"
    yield from notes(*sweep.made_of["limitations"])
    for axis in sweep.grid.axes:
        ends = span(float(axis.values[0]), float(axis.values[-1]), axis.unit)
        yield f"  {axis.free.label}: {ends}, {counted(len(axis.values), 'value')}"
    yield from _result_range(sweep)
    yield from _verdict_lines(sweep.counts, sweep.messages)
    yield from (f"  note: {note}" for note in sweep.notes)


def _result_range(sweep: Sweep) -> Lines:
    """Yield the smallest and largest result of a sweep, after its verdict the first column of numbers."""
    heading = sweep.headings[len(sweep.grid.axes) + 1]
    if sweep.held is None and (sweep.out is None or not sweep.out.is_file()):
        return  # written to a pipe
    values = sweep.column(heading)
    known = values[np.isfinite(values)] if values.dtype == np.float64 else values[:0]
    if known.size:
        yield f"  {heading}: {known.min():.6g} to {known.max():.6g}"


def sweep_document(sweep: Sweep) -> Plain:
    """Return the description and result counts of a sweep, without its rows, as plain data."""
    return {
        **sweep.made_of,
        "columns": list(sweep.headings),
        "verdicts": dict(sweep.verdicts),
        "out": str(sweep.out) if sweep.out else None,
        "notes": list(sweep.notes),
    }


def sweep_table(sweep: Sweep) -> pandas.DataFrame:
    """Return a sweep as a pandas table, with the headings as its columns."""
    return need("pandas", "data").DataFrame(dict(zip(sweep.headings, sweep.columns, strict=True)))


def parameters_text(parameters: Parameters) -> Lines:
    """Yield a line per parameter: name, value, limits, and description."""
    yield f"{parameters.topology}: parameters\n"
    rows = [(row.name, _value(row), _limits(row), _crossing_rows(row)) for row in parameters.rows]
    yield from table([("name", "value", "limits", "description"), *rows])
    yield ""
    yield from sentences(HOW)


def _value(settable: Settable) -> str:
    if settable.low == settable.high:
        return quantity(settable.low, settable.unit, 9)
    return span(settable.low, settable.high, settable.unit)


def _limits(settable: Settable) -> str:
    """Return the bounds of a parameter in its unit for display: "> 0, ≤ 5"."""
    by, _ = as_shown(max(abs(settable.low), abs(settable.high)), settable.unit)
    low = (
        ""
        if settable.minimum is None
        else f"{'>' if settable.exclusive_minimum else '≥'} {settable.minimum * by:.9g}"
    )
    high = "" if settable.maximum is None else f"≤ {settable.maximum * by:.9g}"
    return ", ".join(limit for limit in (low, high) if limit)


def _crossing_rows(settable: Settable) -> str:
    fixed = f"fixed: {settable.fixed}" if settable.fixed else ""
    follows = f"follows: {settable.follows}" if settable.follows else ""
    return "; ".join(part for part in (settable.description, follows, fixed) if part)
