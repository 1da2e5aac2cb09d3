"""Numbers as a person writes them to a program: ASCII digits, a sign, a point, an exponent, and nothing else.

Takes: texts. Gives: `plain_float`, `plain_int`.
Guarantees: what Python's own functions also read is refused: `1_0`, digits of other scripts, `nan`.
Does not: know units (see `language.units`), or say where the text stood.
"""

from __future__ import annotations

import math


def plain_float(text: str) -> float:
    """Return the number a text says, spaces around it or not. Raises ValueError if it says none."""
    if not text.isascii() or "_" in text:
        raise ValueError("not a plain number")
    number = float(text)
    if not math.isfinite(number):
        raise ValueError("not a finite number")
    return number


def plain_int(text: str) -> int:
    """Return the whole number a text says, spaces around it or not. Raises ValueError if it says none."""
    if not text.isascii() or "_" in text:
        raise ValueError("not a plain number")
    return int(text)
