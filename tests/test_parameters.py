"""Claims about `apc.frame.parameters`."""

from __future__ import annotations

from fractions import Fraction

from apc.frame.parameters import resolve
from tests.sites import NAMES, paper


def test_without_overrides_the_numbers_are_the_compiled_ones() -> None:
    numbers = resolve(paper(kt=123.0))
    assert numbers.parameters[0][0, NAMES.index("coordination.stiffness")] == 123.0
    assert numbers.timings["lan.delay"] == Fraction(1, 125)
