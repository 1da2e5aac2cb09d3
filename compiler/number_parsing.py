"""Parsing of plain numbers: only ASCII digits, a sign, a point and an exponent.

Takes: texts. Gives: `plain_float`, `plain_int`.
Guarantees: other number formats of Python raise ValueError: `1_0`, digits of other scripts, `nan`.
Does not: handle units (see `language.units`), or locations.
"""

from __future__ import annotations

import math


def plain_float(text: str) -> float:
    """Return the finite number in a text, with or without surrounding spaces.

    Raises ValueError for other texts.
    """
    if not text.isascii() or "_" in text:
        raise ValueError("not a plain number")
    number = float(text)
    if not math.isfinite(number):
        raise ValueError("not a finite number")
    return number


def plain_int(text: str) -> int:
    """Return the integer in a text, with or without surrounding spaces. Raises ValueError for other texts."""
    if not text.isascii() or "_" in text:
        raise ValueError("not a plain number")
    return int(text)
