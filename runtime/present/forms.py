"""The forms that all results share: plain data, JSON, notes, labelled lines and tables.

Takes: frozen values, texts.
Gives: `Plain`, `document`, `record`, `picked`, `reached`, `json_text`; `radius_text`, `quantity`,
`uncertain`, `span`, `axis_label`, `listed`; `Lines`, `notes`, `sentences`, `labelled`, `table`; `MEANT`.
Guarantees: a document is made of what JSON has words for; the same value gives the same text; a line is at
most 80 columns wide where its words allow it.
Does not: know a result.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from fractions import Fraction
from typing import Any

from apc.compiler.words import measured, with_unit, wrapped
from apc.frame.display_units import as_shown
from apc.later import LazyTuple
from apc.result import Result
from apc.verdict import Note, Sentence, Term

# What stable means by a criterion, where it is not that motions die out.
MEANT = {
    "mean-square": "judged in mean square, over the network as it is",
    "passive": "judged with every passive hand at every device",
}

# Plain data, ready for JSON.
Plain = dict[str, Any]

# A text as its result has it: line by line, each at most 80 columns wide.
Lines = Iterator[str]

# What is nearer to 1 is told by its distance, to so many digits at most.
NEAR, TOLD = 1e-6, 1e-4

LINEARIZED = ", linearized at its start"


def document(value: Any) -> Any:
    """Return a value as plain data: a result by its own document, a complex number as a pair, no NaN.

    Parameters
    ----------
    value
        Dataclasses, mappings, sequences and arrays of numbers, texts and None.
    """
    if isinstance(value, Term | Sentence):
        return str(value)
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, complex):
        return document((value.real, value.imag))
    if isinstance(value, Fraction):
        return float(value)
    if isinstance(value, Result):
        return value.to_dict()
    if is_dataclass(value):
        return record(value)
    if isinstance(value, Mapping):
        return {key: document(item) for key, item in value.items() if item is not ...}
    if isinstance(value, tuple | list | LazyTuple):
        return [document(item) for item in value]
    return document(value.tolist())  # of an array


def record(value: Any, instead: Mapping[str, Any] | None = None) -> Plain:
    """Return a dataclass as plain data, by its shown fields.

    Parameters
    ----------
    value
        The dataclass.
    instead
        What is taken in the place of fields, or after them; `...` leaves a field out.
    """
    shown = [field.name for field in fields(value) if field.repr]  # there are as many modes as states
    other = instead or {}
    kept = {name: other[name] if name in other else getattr(value, name) for name in [*shown, *other]}
    plain: Plain = document(kept)
    return plain


def picked(value: Any, *names: str) -> Plain:
    """Return some fields and properties of a value as plain data."""
    return {name: document(getattr(value, name)) for name in names}


def reached(value: Any, path: str) -> Any:
    """Return what is at a path of attributes and places, such as "a.b.0"; None beyond a None."""
    for name in path.split("."):
        if value is None:
            return None
        value = value[int(name)] if name.isdigit() else getattr(value, name)
    return value


def json_text(result: Any, *, indent: int | None = 2) -> str:
    """Return plain data as one JSON document, on one line if `indent` is None.

    JSON has no word for what is no finite number: null stands in its place, as in `document`.
    """
    return json.dumps(document(result), ensure_ascii=False, allow_nan=False, indent=indent)


def radius_text(radius: float, error: float, beyond: tuple[float, float] | None = None) -> str:
    """Return a spectral radius with its error: near 1 by how far it is from it, "1 − 3.2e-15 ± 9e-16".

    Parameters
    ----------
    radius, error
        The radius and its error.
    beyond
        How much larger than 1 it is, at least and at most, where that is better known.
    """
    low, high = beyond or (radius - 1 - error, radius - 1 + error)
    away, off = (low + high) / 2, (high - low) / 2
    if not off < abs(away):
        return measured(radius, error)
    if abs(away) >= NEAR:
        return measured(1 + away, off) if abs(radius - 1) <= error else measured(radius, error)
    return f"1 {'−' if away < 0 else '+'} {measured(abs(away), max(off, abs(away) * TOLD))}"


def quantity(value: float, unit: str, digits: int = 6) -> str:
    """Return a number in SI to so many digits with the unit in which people are shown it."""
    by, shown = as_shown(value, unit)
    return with_unit(f"{value * by:.{digits}g}", shown)


def uncertain(value: float, error: float, unit: str) -> str:
    """Return a number in SI with its error, in the unit in which people are shown it."""
    by, shown = as_shown(value, unit)
    return measured(value * by, error * by, shown) if error else f"{quantity(value, unit, 15)}, exact"


def span(low: float, high: float, unit: str) -> str:
    """Return what lies between two numbers in SI, with their unit behind both; as `quantity` does."""
    by, shown = as_shown(max(abs(low), abs(high)), unit)
    return with_unit(f"{low * by:.6g} to {high * by:.6g}", shown)


def axis_label(name: str, unit: str) -> str:
    """Return what stands beside an axis: what it is of, and its unit."""
    return name if unit == "1" else f"{name} [{unit.replace('*', '·')}]"


def listed(names: Sequence[str], most: int = 6) -> str:
    """Return the first names of several, and "…" for the others; "none" where there are none."""
    return ", ".join([*names[:most], *["…"][: max(len(names) - most, 0)]]) or "none"


def notes(*texts: Note) -> Lines:
    """Yield texts beneath one another as lines that stand a little to the right; nothing of an empty one."""
    for text in texts:
        yield from wrapped(str(text), "  ", "    ")


def sentences(*texts: str) -> Lines:
    """Yield texts beneath one another, whose lines all stand equally far to the right."""
    for text in texts:
        yield from wrapped(text, "  ", "  ")


def labelled(*rows: tuple[str, str], width: int = 17) -> Lines:
    """Yield texts beside their labels, which take so many columns; nothing of an empty text."""
    for label, text in rows:
        if text:
            yield from wrapped(text, f"  {label:<{width}}", " " * (width + 2))


def table(rows: Sequence[Sequence[str]], sides: str = "", *, later: int | None = None) -> Lines:
    """Yield rows of cells as lines, each column as wide as its widest cell.

    Parameters
    ----------
    rows
        The cells, as many in each row; the headings are the first row.
    sides
        `<` or `>` for each column, where its cells stand; all to the left if not given.
    later
        The column at which the last cell goes on in a second line; beneath its beginning if not given.
    """
    if not rows:
        return
    sides = sides or "<" * len(rows[0])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if sides[-1] == "<":
        widths[-1] = 0
    for row in rows:
        cells = [f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)]
        first = "  " + "".join(f"{cell}  " for cell in cells[:-1])
        first += " " * (len(cells[-1]) - len(row[-1]))
        for line in wrapped(row[-1], first, " " * (len(first) if later is None else later)) or [""]:
            yield line.rstrip()
