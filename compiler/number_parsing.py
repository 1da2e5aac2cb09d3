"""Parsing of plain numbers: ASCII digits, a sign, a point, an exponent, and nothing else.

Takes: texts. Gives: `plain_float`, `plain_int`.
Guarantees: other forms accepted by Python are refused: `1_0`, digits of other scripts, `nan`.
Does not: handle units (see `language.units`), or locations.
"""

from __future__ import annotations

import math


def plain_float(text: str) -> float:
    """Return the number in a text, with or without surrounding spaces. Raises ValueError otherwise."""
    if not text.isascii() or "_" in text:
        raise ValueError("not a plain number")
    number = float(text)
    if not math.isfinite(number):
        raise ValueError("not a finite number")
    return number


def plain_int(text: str) -> int:
    """Return the integer in a text, with or without surrounding spaces. Raises ValueError otherwise."""
    if not text.isascii() or "_" in text:
        raise ValueError("not a plain number")
    return int(text)
