"""The lines that a report's page shows, compared with those of the page rendered again.

Takes: the HTML of two pages without their embedded data. Gives: `line_differences`; `LineDifference`.
Guarantees: every character of a page counts, and every one of its embedded figures. Where arithmetic may
differ, numbers may differ by roundings, and a figure's identifiers by their hashes.
Does not: read, render or compute a page.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

SAME = 1e-6  # relative, of numbers in text
ERROR_FACTOR = 10.0  # of an error behind ±, which rounding alone may decide
FIGURE_UNIT = 0.01  # points, of coordinates in figures
SIGNIFICANT = 6  # digits, from which on the last one may differ by rounding
WIDEST = 60  # characters of a line that are reported
_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d{1,3})?", re.ASCII)
_FIGURE = re.compile(r'(?<=src=")data:image/svg\+xml;base64,([A-Za-z0-9+/=]*)(?=")')
_HASHED = re.compile(r'(?<=["#])[a-z]+[0-9a-f]{10}(?=[")])')


@dataclass(frozen=True, slots=True)
class LineDifference:
    """A line of a file, from 1, with what it shows and what it should show."""

    line: int
    shown: str
    expected: str


@dataclass(frozen=True, slots=True)
class _Line:
    number: int
    text: str
    figure: bool


def line_differences(shown: str, expected: str, *, exact: bool) -> Iterator[LineDifference]:
    """Yield the lines of a page that differ from an expected page; a line and its figures once.

    Parameters
    ----------
    shown
        The page of a file.
    expected
        The page rendered from recomputed results.
    exact
        Whether no rounding may differ, as where all results are the same to the last bit.
    """
    left, right = _lines(shown, exact), _lines(expected, exact)
    pairs = list(zip(left, right, strict=False))
    if len(left) != len(right):
        # Lines are missing or inserted: what precedes and follows them is paired from both ends.
        start = next((k for k, pair in enumerate(pairs) if not _equal_lines(*pair, exact)), len(pairs))
        behind = zip(reversed(left[start:]), reversed(right[start:]), strict=False)
        rest = min(len(left), len(right)) - start
        end = next((k for k, pair in enumerate(behind) if not _equal_lines(*pair, exact)), rest)
        some, others = left[start : len(left) - end], right[start : len(right) - end]
        last = _Line(left[min(start, len(left) - 1)].number if left else 1, "", False)
        count = max(len(some), len(others))
        pairs = [
            (some[k] if k < len(some) else last, others[k] if k < len(others) else last) for k in range(count)
        ]
    last_number = 0
    for item, other in pairs:
        if item.number != last_number and not _equal_lines(item, other, exact):
            last_number = item.number
            yield LineDifference(item.number, *_excerpts(item.text, other.text))


def _lines(page: str, exact: bool) -> list[_Line]:
    """Return the lines of a page, those of each figure behind the line that holds it."""
    lines = []
    for number, text in enumerate(page.splitlines(), start=1):
        figures: list[str] = []
        lines.append(_Line(number, _FIGURE.sub(partial(_decoded, figures), text), False))
        for figure in figures:
            plotted = figure if exact else _renumbered(figure)
            lines += [_Line(number, row, True) for row in plotted.splitlines()]
    return lines


def _decoded(figures: list[str], result: re.Match[str]) -> str:
    """Append the text of a figure to `figures`; return its replacement in the line."""
    try:
        figures.append(base64.b64decode(result[1], validate=True).decode("utf-8"))
    except (binascii.Error, ValueError):
        return result[0]
    return "figure"


def _renumbered(figure: str) -> str:
    """Return a figure whose hashed identifiers are numbered in their order."""
    numbers: dict[str, int] = {}
    return _HASHED.sub(lambda result: f"id{numbers.setdefault(result[0], len(numbers))}", figure)


def _equal_lines(item: _Line, other: _Line, exact: bool) -> bool:
    """Return whether two lines show the same."""
    if item.text == other.text or exact:
        return item.text == other.text and item.figure == other.figure
    words, expected = (
        [" ".join(word.split()) for word in _NUMBER.split(each.text)] for each in (item, other)
    )
    numbers = zip(_NUMBER.findall(item.text), _NUMBER.findall(other.text), strict=False)
    return words == expected and all(
        _near(*pair, figure=item.figure, error=before.endswith("±"))
        for before, pair in zip(words, numbers, strict=False)
    )


def _near(item: str, other: str, *, figure: bool, error: bool) -> bool:
    """Return whether two numbers are the same but for roundings."""
    a, b = (float(text.replace(",", "")) for text in (item, other))
    largest = max(a, b)
    if error:
        return largest <= ERROR_FACTOR * min(a, b)
    return abs(a - b) <= max(SAME * largest, 1.5 * _last_digit(other), FIGURE_UNIT if figure else 0.0)


def _last_digit(text: str) -> float:
    """Return the unit of a number's last digit, 0 of one with few digits."""
    mantissa, _, power = text.replace(",", "").partition("e")
    _, _, decimals = mantissa.partition(".")
    if "." not in mantissa or len(mantissa.replace(".", "").lstrip("0")) < SIGNIFICANT:
        return 0.0
    return float(f"1e{int(power or 0) - len(decimals)}")


def _excerpts(shown: str, expected: str) -> tuple[str, str]:
    """Return two lines from shortly before the place where they differ."""
    least = min(len(shown), len(expected))
    index = next((k for k in range(least) if shown[k] != expected[k]), least)
    begin = max(0, index - WIDEST // 3)
    return _excerpt(shown, begin), _excerpt(expected, begin)


def _excerpt(text: str, begin: int) -> str:
    part: Sequence[str] = [
        "…" if begin else "",
        text[begin : begin + WIDEST],
        "…" * (len(text) > begin + WIDEST),
    ]
    return "".join(part).strip() or "nothing"
