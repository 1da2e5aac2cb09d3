"""The words of messages and reports: numbers with their nouns and units, and lines that fit a terminal.

Takes: numbers and texts. Gives: `WIDTH`, `cut`, `counted`, `with_unit`, `in_hertz`, `wrapped`.
Guarantees: a line is at most `WIDTH` columns wide, but for a word that has no place to break it at.
Does not: know what is told, or print.
"""

from __future__ import annotations

import re

WIDTH = 80  # columns of a terminal as it opens

_PIECE = re.compile(r"[^*/(,]+[*/(,]*|[*/(,]+")  # of a word, broken behind an operator


def cut(text: str) -> str:
    """Return a text short enough for a message."""
    return text if len(text) <= 40 else text[:37] + "…"


def counted(number: int, noun: str, form: str = "d") -> str:
    """Return a number and its noun; `form` is Python's format of the number: `,` groups its digits."""
    return f"{number:{form}} {noun}" + ("" if number == 1 else "s")


def with_unit(number: str, unit: str) -> str:
    """Return a number with its unit, alone where that is "1"."""
    return number if unit == "1" else f"{number} {unit}"


def in_hertz(frequency: float) -> str:
    """Return a frequency to four digits with its unit, `–` for one that can't be told (NaN)."""
    return f"{frequency:.4g} Hz" if frequency == frequency else "–"


def wrapped(text: str, first: str = "", later: str = "") -> list[str]:
    """Return a text as lines of at most `WIDTH` columns, broken at spaces, at need behind an operator.

    Parameters
    ----------
    text
        What is told; how its words are spaced doesn't matter.
    first, later
        What the first line begins with, and what the others do.
    """
    lines: list[str] = []
    line, between = first, ""
    for word in text.split():
        whole = len(later) + len(word) <= WIDTH
        for piece in [word] if whole else _PIECE.findall(word):
            if line.strip() and len(line) + len(between) + len(piece) > WIDTH:
                lines.append(line)
                line, between = later, ""
            line += between + piece
            between = ""
        between = " "
    return [*lines, line] if line.strip() else lines
