"""The forms that all results share: plain data, JSON, notes, labelled lines and tables.

Takes: frozen values, texts.
Gives: `Plain`, `document`, `record`, `picked`, `reached`, `json_text`; `full_digits`, `radius_text`,
`quantity`, `with_error`, `rounds_to`, `uncertain`, `span`, `axis_label`, `listed`, `point_text`,
`capitalized`; `Lines`, `notes`, `sentences`, `labelled`, `headed`, `table`, `without_dashes`; `MEANT`,
`JUMP`.
Guarantees: a document is made of what JSON has words for; the same value gives the same text; a line is at
most 80 columns wide where its words allow it.
Does not: know a result.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any

from apc.compiler.wording import WIDTH, measured, with_unit, wrapped
from apc.parameter_values.display_units import as_shown
from apc.result import Result
from apc.support.lazy import LazyTuple
from apc.verdict import Note, Sentence, Term

# The stability criterion by a criterion, where it is not that motions die out.
MEANT = {
    "mean-square": "criterion: mean-square stability over the lossy network",
    "passive": "criterion: absolute stability with any passive operator at every device",
}

# The legend of a limit marked as a jump.
JUMP = "jump: the spectral radius is discontinuous at this value"

# Plain data, ready for JSON.
Plain = dict[str, Any]

# A text as its result has it: line by line, each at most 80 columns wide.
Lines = Iterator[str]

# A number nearer to 1 is printed by its distance from 1, with this number of digits at most.
NEAR, REPORTED = 1e-6, 1e-4

NO_TEXT = "–"  # in the cell of a table

LINEARIZED = ", linearized at the {}"

# Significant digits of a number in text, and the largest number before a prefix of its unit.
DIGITS = 6
MOST = 10_000

_NAME = re.compile(r"\w+[._\[]\w")  # at the start of a text

_FULL: ContextVar[bool] = ContextVar("full_digits", default=False)


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
        Replacements of fields, or additional ones; `...` omits a field.
    """
    shown = [field.name for field in fields(value) if field.repr]  # there are as many modes as states
    other = instead or {}
    stored = {name: other[name] if name in other else getattr(value, name) for name in [*shown, *other]}
    plain: Plain = document(stored)
    return plain


def picked(value: Any, *names: str) -> Plain:
    """Return some fields and properties of a value as plain data."""
    return {name: document(getattr(value, name)) for name in names}


def reached(value: Any, path: str) -> Any:
    """Return the value at a path of attributes and indices, such as "a.b.0"; None beyond a None."""
    for name in path.split("."):
        if value is None:
            return None
        value = value[int(name)] if name.isdigit() else getattr(value, name)
    return value


def json_text(result: Any, *, indent: int | None = 2) -> str:
    """Return plain data as one JSON document, on one line if `indent` is None.

    JSON has no non-finite numbers; null replaces them, as in `document`.
    """
    return json.dumps(document(result), ensure_ascii=False, allow_nan=False, indent=indent)


def radius_text(radius: float, error: float, radius_excess: tuple[float, float] | None = None) -> str:
    """Return a spectral radius with its error: near 1 by how far it is from it, "1 − 3.2e-15 ± 9e-16".

    Parameters
    ----------
    radius, error
        The radius and its error.
    radius_excess
        Its difference from 1, lower and upper bound, if known more accurately.
    """
    low, high = radius_excess or (radius - 1 - error, radius - 1 + error)
    away, off = (low + high) / 2, (high - low) / 2
    if not off < abs(away):
        return measured(radius, error)
    if abs(away) >= NEAR:
        return measured(1 + away, off) if abs(radius - 1) <= error else measured(radius, error)
    return f"1 {'−' if away < 0 else '+'} {measured(abs(away), max(off, abs(away) * REPORTED))}"


def quantity(value: float, unit: str, digits: int = 6) -> str:
    """Return an SI number with `digits` digits in its display unit."""
    by, shown = _prefixed(value, unit)
    return with_unit(f"{float(value * by):.{digits}g}", shown)


def _prefixed(value: float, unit: str) -> tuple[Fraction, str]:
    """Return the factor from SI to the display unit of a number, in kN above `MOST`, and that unit."""
    by, shown = as_shown(value, unit)
    if shown.startswith("N") and MOST < abs(value * by) < math.inf:
        return by / 1000, f"k{shown}"
    return by, shown


@contextlib.contextmanager
def full_digits() -> Iterator[None]:
    """Print numbers with all digits that their errors permit, and with the errors."""
    token = _FULL.set(True)
    try:
        yield
    finally:
        _FULL.reset(token)


def with_error(value: float, error: float, unit: str = "1") -> str:
    """Return a number to `DIGITS` digits; with its error where that is larger, or all digits are requested.

    Parameters
    ----------
    value, error, unit
        The number and the bound of its error, both in `unit`.
    """
    shown = f"{value:.{DIGITS}g}"
    if _FULL.get() or not rounds_to(value, error):
        return measured(value, error, unit)
    return with_unit(shown, unit)


def rounds_to(value: float, error: float) -> bool:
    """Return whether the error of a number is within half a unit of its last printed digit."""
    return bool(math.isfinite(value) and value and error <= _half_digit(f"{value:.{DIGITS}g}"))


def _half_digit(shown: str) -> float:
    """Return half a unit of the last of `DIGITS` significant digits of a number other than 0."""
    return 0.5 * 10.0 ** (Decimal(shown).adjusted() - DIGITS + 1)


def uncertain(value: float, error: float, unit: str) -> str:
    """Return an SI number in its display unit, as `with_error` does; an exact number is marked as such."""
    by, shown = as_shown(value, unit)
    return with_error(value * by, error * by, shown) if error else f"{quantity(value, unit, 15)}, exact"


def span(low: float, high: float, unit: str) -> str:
    """Return a range between two numbers in SI, with one unit; format as in `quantity`."""
    by, shown = _prefixed(max(abs(low), abs(high)), unit)
    return with_unit(f"{float(low * by):.6g} to {float(high * by):.6g}", shown)


def axis_label(name: str, unit: str) -> str:
    """Return the label of an axis: quantity and unit."""
    return name if unit == "1" else f"{name} [{unit.replace('*', '·')}]"


def point_text(linearized: bool, at_equilibrium: bool) -> str:
    """Return the words for the point of linearization of a result, "" for a linear model."""
    return LINEARIZED.format("equilibrium" if at_equilibrium else "initial state") if linearized else ""


def listed(names: Sequence[str], most: int = 6) -> str:
    """Return the first names of several, and "…" for the others; "none" where there are none."""
    return ", ".join([*names[:most], *["…"][: max(len(names) - most, 0)]]) or "none"


def capitalized(text: str) -> str:
    """Return a text with a capital letter; a name such as device.mass stays as it is."""
    return text if _NAME.match(text) else text[:1].upper() + text[1:]


def notes(*texts: Note) -> Lines:
    """Yield texts as indented lines; nothing for an empty text."""
    for text in texts:
        yield from wrapped(str(text), "  ", "    ")


def sentences(*texts: str) -> Lines:
    """Yield texts as lines with equal indentation."""
    for text in texts:
        yield from wrapped(text, "  ", "  ")


def headed(title: str, lines: Lines) -> Lines:
    """Yield an empty line, a title, an empty line and the lines; nothing without lines."""
    for number, line in enumerate(lines):
        if not number:
            yield ""
            yield from wrapped(title)
            yield ""
        yield line


def labelled(*rows: tuple[str, str], width: int = 20) -> Lines:
    """Yield texts next to their labels, in a column of fixed width; nothing for an empty text."""
    for label, text in rows:
        if text:
            yield from wrapped(text, f"  {label:<{width}}", " " * (width + 2))


def without_dashes(rows: Sequence[Sequence[str]], sides: str) -> tuple[list[tuple[str, ...]], str]:
    """Return rows of cells and their alignment without the columns that have no text in any row.

    Parameters
    ----------
    rows
        The cells; the headings are the first row.
    sides
        The alignment `<` or `>` of each column.
    """
    kept = [not set(cells) <= {NO_TEXT, ""} for _, *cells in zip(*rows, strict=True)]
    kept = kept if len(rows) > 1 else [True] * len(kept)
    return (
        [tuple(itertools.compress(row, kept)) for row in rows],
        "".join(itertools.compress(sides, kept)),
    )


def table(rows: Sequence[Sequence[str]], sides: str = "", *, later: int | None = None) -> Lines:
    """Yield rows of cells as lines, each column as wide as its widest cell.

    Parameters
    ----------
    rows
        The cells, as many in each row; the headings are the first row.
    sides
        The alignment `<` or `>` of each column; by default all are left-aligned.
    later
        The column at which the last cell continues in a second line; by default below its beginning.
    """
    if not rows:
        return
    sides = sides or "<" * len(rows[0])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if sides[-1] == "<":
        widths[-1] = 0
    gap = "  " if sum(widths) + 2 * len(widths) <= WIDTH else " "
    for row in rows:
        cells = [f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)]
        first = "  " + "".join(f"{cell}{gap}" for cell in cells[:-1])
        first += " " * (len(cells[-1]) - len(row[-1]))
        for line in wrapped(row[-1], first, " " * (len(first) if later is None else later)) or [""]:
            yield line.rstrip()
