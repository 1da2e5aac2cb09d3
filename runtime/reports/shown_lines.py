"""Comparison of the lines of a report's page with the page rendered again.

Takes: the HTML of two pages without their embedded data. Gives: `line_differences`; `LineDifference`.
Guarantees: every character of a page and of its embedded figures is compared. Unless the comparison is exact,
numbers may differ by rounding, and the identifiers in figures by their hashes.
Does not: read, render or compute a page.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

SAME = 1e-6  # relative tolerance of numbers in text
ERROR_FACTOR = 10.0  # largest ratio of two errors after ±, which may be due to rounding only
FIGURE_UNIT = 0.01  # tolerance of coordinates in figures, in points
SIGNIFICANT = 6  # digits of a number whose last digit may differ by rounding
WIDEST = 60  # characters of a line in the result
_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d{1,3})?", re.ASCII)
_FIGURE = re.compile(r'(?<=src=")data:image/svg\+xml;base64,([A-Za-z0-9+/=]*)(?=")')
_HASHED = re.compile(r'(?<=["#])[a-z]+[0-9a-f]{10}(?=[")])')


@dataclass(frozen=True, slots=True)
class LineDifference:
    """A differing line of a file: its number from 1, the text shown, and the expected text."""

    line: int
    shown: str
    expected: str


@dataclass(frozen=True, slots=True)
class _Line:
    number: int
    text: str
    figure: bool


def line_differences(shown: str, expected: str, *, exact: bool) -> Iterator[LineDifference]:
    """Yield the lines of a page that differ from the expected page; a line with its figures once.

    Parameters
    ----------
    shown
        The page in a file.
    expected
        The page rendered from recomputed results.
    exact
        Whether no rounding differences are allowed, for results that are equal to the last bit.
    """
    shown_lines, expected_lines = _lines(shown, exact), _lines(expected, exact)
    pairs = list(zip(shown_lines, expected_lines, strict=False))
    if len(shown_lines) != len(expected_lines):
        # Lines are missing or inserted: the equal lines before and after them are removed from both ends.
        start = next((k for k, pair in enumerate(pairs) if not _equal_lines(*pair, exact)), len(pairs))
        reversed_pairs = zip(reversed(shown_lines[start:]), reversed(expected_lines[start:]), strict=False)
        remaining = min(len(shown_lines), len(expected_lines)) - start
        end = next((k for k, pair in enumerate(reversed_pairs) if not _equal_lines(*pair, exact)), remaining)
        extra_shown, extra_expected = (
            shown_lines[start : len(shown_lines) - end],
            expected_lines[start : len(expected_lines) - end],
        )
        end_line = _Line(
            shown_lines[min(start, len(shown_lines) - 1)].number if shown_lines else 1, "", False
        )
        count = max(len(extra_shown), len(extra_expected))
        pairs = [
            (
                extra_shown[k] if k < len(extra_shown) else end_line,
                extra_expected[k] if k < len(extra_expected) else end_line,
            )
            for k in range(count)
        ]
    last_number = 0
    for item, other in pairs:
        if item.number != last_number and not _equal_lines(item, other, exact):
            last_number = item.number
            yield LineDifference(item.number, *_excerpts(item.text, other.text))


def _lines(page: str, exact: bool) -> list[_Line]:
    """Return the lines of a page; the lines of a figure follow the line that contains the figure."""
    lines = []
    for number, text in enumerate(page.splitlines(), start=1):
        figures: list[str] = []
        lines.append(_Line(number, _FIGURE.sub(partial(_decoded, figures), text), False))
        for figure in figures:
            figure_text = figure if exact else _renumbered(figure)
            lines += [_Line(number, row, True) for row in figure_text.splitlines()]
    return lines


def _decoded(figures: list[str], result: re.Match[str]) -> str:
    """Append the text of a figure to `figures`; return the replacement in the line."""
    try:
        figures.append(base64.b64decode(result[1], validate=True).decode("utf-8"))
    except (binascii.Error, ValueError):
        return result[0]
    return "figure"


def _renumbered(figure: str) -> str:
    """Return a figure whose hashed identifiers are replaced by numbers in order of appearance."""
    numbers: dict[str, int] = {}
    return _HASHED.sub(lambda result: f"id{numbers.setdefault(result[0], len(numbers))}", figure)


def _equal_lines(item: _Line, other: _Line, exact: bool) -> bool:
    """Return whether two lines are equal, apart from rounding unless `exact`."""
    if item.text == other.text or exact:
        return item.text == other.text and item.figure == other.figure
    words, expected = (
        [" ".join(word.split()) for word in _NUMBER.split(line.text)] for line in (item, other)
    )
    numbers = zip(_NUMBER.findall(item.text), _NUMBER.findall(other.text), strict=False)
    return words == expected and all(
        _near(*pair, figure=item.figure, error=before.endswith("±"))
        for before, pair in zip(words, numbers, strict=False)
    )


def _near(item: str, other: str, *, figure: bool, error: bool) -> bool:
    """Return whether two numbers are equal apart from rounding; `figure` and `error` select the tolerance."""
    a, b = (float(text.replace(",", "")) for text in (item, other))
    largest = max(a, b)
    if error:
        return largest <= ERROR_FACTOR * min(a, b)
    return abs(a - b) <= max(SAME * largest, 1.5 * _last_digit(other), FIGURE_UNIT if figure else 0.0)


def _last_digit(text: str) -> float:
    """Return the unit of the last digit of a number, 0 for a number with few digits."""
    mantissa, _, power = text.replace(",", "").partition("e")
    _, _, decimals = mantissa.partition(".")
    if "." not in mantissa or len(mantissa.replace(".", "").lstrip("0")) < SIGNIFICANT:
        return 0.0
    return float(f"1e{int(power or 0) - len(decimals)}")


def _excerpts(shown: str, expected: str) -> tuple[str, str]:
    """Return excerpts of two lines that begin shortly before the first difference."""
    shorter = min(len(shown), len(expected))
    index = next((k for k in range(shorter) if shown[k] != expected[k]), shorter)
    begin = max(0, index - WIDEST // 3)
    return _excerpt(shown, begin), _excerpt(expected, begin)


def _excerpt(text: str, begin: int) -> str:
    """Return at most `WIDEST` characters of a line from an index, with marks for omitted text."""
    part: Sequence[str] = [
        "…" if begin else "",
        text[begin : begin + WIDEST],
        "…" * (len(text) > begin + WIDEST),
    ]
    return "".join(part).strip() or "nothing"
