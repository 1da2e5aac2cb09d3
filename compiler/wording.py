"""Wording of messages and reports: numbers with nouns and units, and wrapped lines.

Takes: numbers and texts.
Gives: `WIDTH`, `cut`, `enumerated`, `counted`, `measured`, `known_digits`, `no_more`, `with_unit`,
`choices_text`, `choice_fixes`, `in_hertz`, `time_text`, `wrapped`, `side_by_side`.
Guarantees: digits are limited by the error of a number; a line has at most `WIDTH` columns, except for a
longer word.
Does not: define messages, or print.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Sequence
from decimal import ROUND_FLOOR, ROUND_UP, Context, Decimal
from fractions import Fraction

WIDTH = 80  # columns of a terminal by default

# Decimal digits that identify a float, and one more.
_DIGITS = 18

# More digits than the exact difference of two floats.
_WIDE = Context(prec=1500)
_UP = Context(prec=1, rounding=ROUND_UP)

_WORD = re.compile(r"\S*\(-?[\d.]+ [^\s()]+\)\S*|\S+")  # a quantity in parentheses is not broken: sent(-8 ms)
_PIECE = re.compile(r"[^*/(,]+[*/(,]*|[*/(,]+")  # a part of a word, which ends after an operator


def cut(text: str) -> str:
    """Return a text shortened to at most 40 characters, for a message."""
    return text if len(text) <= 40 else text[:37] + "…"


def enumerated(names: Sequence[str]) -> str:
    """Return names as an enumeration in a sentence: `a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def counted(number: int, noun: str, form: str = "d") -> str:
    """Return a number with its noun in singular or plural; `form` is Python's format of the number."""
    return f"{number:{form}} {noun}" + ("" if number == 1 else "s")


def measured(value: float, error: float, unit: str = "1") -> str:
    """Return a number with its error, rounded to the digit of the error, such as "0.25 ± 3e-02 m".

    The error is rounded up, and includes the rounding of the number; both are interpreted as their shortest
    decimals.
    """
    if not (math.isfinite(value) and math.isfinite(error)):
        return f"{with_unit(f'{value:.6g}', unit)} ± {error:.0e}"
    exact, exact_error = Decimal(repr(value)), Decimal(repr(error))
    least = exact.adjusted() - _DIGITS
    for index in itertools.count(max(exact_error.adjusted(), least) if error else least):
        shown = exact.quantize(Decimal((0, (1,), index)), context=_WIDE)
        whole = _UP.plus(_WIDE.add(abs(_WIDE.subtract(shown, exact)), exact_error))
        if whole.adjusted() <= index or not whole:
            break
    fixed_point = -5 < exact.adjusted() < _DIGITS and (shown or error >= 10.0**-_DIGITS)
    text = f"{shown:f}" if fixed_point else _scientific(shown, exact.adjusted() - index) if shown else "0"
    return f"{with_unit(text, unit)} ± {f'{float(whole):.0e}' if value or error else '0'}"


def _scientific(number: Decimal, digits: int) -> str:
    """Return a decimal in scientific notation with `digits` digits after the point."""
    mantissa, _, exponent = f"{number:.{max(digits, 0)}e}".partition("e")
    return f"{mantissa}e{int(exponent):+03d}"


def known_digits(value: float, error: float, most: int) -> str:
    """Return a number with at most `most` significant digits, fewer if its error is larger."""
    if not (value and math.isfinite(value) and math.isfinite(error)):
        return f"{value:.{most}g}"
    digits = Decimal(value).adjusted() - Decimal(error).adjusted() if error else most
    return f"{value:.{min(max(digits, 1), most)}g}"


def no_more(value: float | Fraction, digits: int = 6) -> str:
    """Return the text of a number rounded down, so that a proposed value is within a limit."""
    down = Context(prec=digits, rounding=ROUND_FLOOR)
    return f"{float(down.divide(*map(Decimal, Fraction(value).as_integer_ratio()))):.{digits}g}"


def time_text(seconds: float) -> str:
    """Return a time in whole seconds, minutes or hours, rounded up; at least 2 min, or 2 h."""
    for name, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{math.ceil(seconds / size):,} {name}"
    return f"{math.ceil(seconds)} s"


def with_unit(number: str, unit: str) -> str:
    """Return a number with its unit; the number alone for the unit "1"."""
    return number if unit == "1" else f"{number} {unit}"


def choices_text(values: Iterable[tuple[str, Fraction | float]], unit: str = "1", scale: float = 1) -> str:
    """Return names with their values: `left (1) or right (-1)`; `scale` is the size of `unit` in SI units."""
    return " or ".join(f"{name} ({with_unit(f'{float(value) / scale:g}', unit)})" for name, value in values)


def choice_fixes(values: Iterable[tuple[str, Fraction | float]], before: str) -> str:
    """Return a fix for each named value, with the text before it: `side: left, or side: right`."""
    return ", or ".join(f"{before}{name}" for name, _ in values)


def in_hertz(frequency: float) -> str:
    """Return a frequency with four digits and its unit; `–` if it is unknown (NaN)."""
    return "–" if math.isnan(frequency) else f"{frequency:.4g} Hz"


def wrapped(text: str, first: str = "", later: str = "") -> list[str]:
    """Return a text as lines of at most `WIDTH` columns, broken at spaces or, if necessary, after operators.

    Parameters
    ----------
    text
        The text; sequences of spaces count as one space.
    first, later
        The prefix of the first line, and of the following lines.
    """
    lines: list[str] = []
    line, between = first, ""
    for word in _WORD.findall(text):
        fits = len(later) + len(word) <= WIDTH
        for piece in [word] if fits else _PIECE.findall(word):
            if line.strip() and len(line) + len(between) + len(piece) > WIDTH:
                lines.append(line)
                line, between = later, ""
            line += between + piece
            between = ""
        between = " "
    return [*lines, line] if line.strip() else lines


def side_by_side(row: str, text: str) -> list[str]:
    """Return a row of a table with its description: on the same line if it fits, else below."""
    if len(row) + 2 + len(text) <= WIDTH:
        return [f"{row}  {text}".rstrip()]
    return [row.rstrip(), *wrapped(text, " " * 6, " " * 6)]
