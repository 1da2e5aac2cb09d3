"""Stability margins and sensitivities as text and plain data.

Takes: a `Margins`, a `Sensitivities`.
Gives: the text and document of each; `margins_lines` and `sensitivities_lines`, tables with a
title; `margins_table`.
Guarantees: numbers have the digits that their errors permit.
Does not: compute.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from apc.compiler.wording import in_hertz
from apc.output.formatting import (
    JUMP,
    Lines,
    Plain,
    document,
    headed,
    notes,
    quantity,
    table,
    with_error,
    without_dashes,
)
from apc.parameter_values.display_units import as_shown

if TYPE_CHECKING:
    from apc.studies.margins import Margins
    from apc.studies.sensitivity import Sensitivities

MOST_SENSITIVITIES = 6  # rows of the table

# A relative change of the radius below this, for a relative change of 1 in a parameter, is indistinguishable
# from rounding.
LEAST_CHANGE = 1e-9

NONE_REPORTED = "no parameter changes the radius by more than rounding"


def margins_text(margins: Margins) -> Lines:
    """Yield the table of the margins with its title."""
    return itertools.islice(margins_lines(margins), 1, None)


def margins_lines(margins: Margins) -> Lines:
    """Yield the table of the margins below its title and an empty line."""
    return headed("Stability margins (one parameter at a time, the others unchanged)", margins_table(margins))


def margins_table(margins: Margins) -> Lines:
    """Yield the table of the margins, a row for each parameter, and the reasons for those not searched."""
    rows = [("parameter", "value", "stable up to", "ratio", "f [Hz]")]
    skipped: dict[str, list[str]] = {}
    for row in margins.rows:
        if row.note:
            skipped.setdefault(row.note, []).append(row.parameter)
            continue
        value, error = row.value or 0.0, row.error or 0.0
        by, shown = as_shown(value, row.unit)
        limit, ratio, frequency = with_error(value * by, error * by, shown), "–", "–"
        if row.gain_margin is not None:
            ratio = f"{row.gain_margin:.4g}"
        if row.frequency_hz is not None:
            frequency = in_hertz(row.frequency_hz).removesuffix(" Hz")
        if row.kind == "jump":
            limit += " (jump)"
        if row.value is None:
            limit, ratio, frequency = f"no limit up to {quantity(row.searched_to, row.unit, 5)}", "", ""
        rows.append((row.parameter, quantity(row.current, row.unit, 5), limit, ratio, frequency))
    if len(rows) > 1:
        yield from table(*without_dashes(rows, "<<<>>"))
        yield from notes(JUMP if any(row.kind == "jump" for row in margins.rows) else "")
    reasons = (f"not searched: {', '.join(names)}: {why}" for why, names in skipped.items())
    yield from notes(*reasons, *margins.note.splitlines())


def margins_document(margins: Margins) -> Plain:
    """Return the margins as plain data."""
    return {"margins": document(margins.rows), "note": margins.note}


def sensitivities_text(sensitivities: Sensitivities) -> Lines:
    """Yield the table of sensitivities with its title."""
    return itertools.islice(sensitivities_lines(sensitivities), 1, None)


def sensitivities_lines(sensitivities: Sensitivities, radius: str = "spectral radius") -> Lines:
    """Yield the table of sensitivities of a radius below its title and an empty line."""
    title = f"Sensitivity of the {radius} (change for +1 %; negative stabilizes)"
    return headed(title, _sensitivity_table(sensitivities))


def _sensitivity_table(sensitivities: Sensitivities) -> Lines:
    """Yield the table of the sensitivities that exceed rounding, and the note."""
    # Eigenvalues that share the radius often have equal sensitivities; then one row is sufficient.
    same: dict[tuple[str, str, str], list[str]] = {}
    for row in sensitivities.rows:
        if abs(row.relative) > LEAST_CHANGE * sensitivities.radius:
            key = (row.parameter, quantity(row.value, row.unit), f"{row.relative / 100:+.2e}")
            same.setdefault(key, []).append(str(row.mode + 1))
    if not same:
        text = sensitivities.note if len(sensitivities.active) < 2 else ""
        yield from notes(text or NONE_REPORTED)
        return
    several = any(len(modes) < len(sensitivities.active) for modes in same.values())
    rows: list[tuple[str, ...]] = [("parameter", "value", "change", *["mode"][:several])]
    for cells, modes in list(same.items())[:MOST_SENSITIVITIES]:
        which = ", ".join(modes) if len(modes) < len(sensitivities.active) else "all"
        rows.append((*cells, *[which][:several]))
    yield from table(rows, "<<>" + "<" * several)
    yield from notes(sensitivities.note)


def sensitivities_document(sensitivities: Sensitivities) -> Plain:
    """Return the derivatives as plain data."""
    return {
        "spectral_radius": sensitivities.radius,
        "active": [{"eigenvalue": document(value), "system": name} for value, name in sensitivities.active],
        "derivatives": document(sensitivities.rows),
        "note": sensitivities.note,
    }
