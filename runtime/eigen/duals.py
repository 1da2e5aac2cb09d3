"""Balls with a slope: numbers that carry their derivative by one parameter.

Takes: balls. Gives: `Dual`, `value_of`, `slope_of`, `step_duals`.
Guarantees: where the parameter is a ball, value and slope hold those of every parameter in it.
Does not: divide, or compare.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import step_balls

Balls = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Dual:
    """`value` and its derivative `slope`; adds and multiplies with whole numbers and balls, too."""

    value: Any
    slope: Any

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.slope + other.slope)
        return Dual(self.value + other, self.slope)

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value * other.value, self.value * other.slope + self.slope * other.value)
        return Dual(self.value * other, self.slope * other)

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    __radd__ = __add__
    __rmul__ = __mul__


def value_of(entry: Any) -> Any:
    """Return the value of a number with or without a slope."""
    return entry.value if isinstance(entry, Dual) else entry


def slope_of(entry: Any) -> Any:
    """Return the slope of a number, 0 for one that has none."""
    return entry.slope if isinstance(entry, Dual) else 0


def mapped(change: Any, numbers: Balls) -> Balls:
    """Return an array of changed numbers."""
    entries = np.empty(numbers.size, dtype=object)
    entries[:] = [change(entry) for entry in numbers.ravel()]
    return entries.reshape(numbers.shape)


def step_duals(a: Balls, b: Balls, duration: Fraction) -> Balls:
    """Return [F G] (n_x, n_x + n_u) of one duration with its slope; see `discretize.step_balls`.

    Notes
    -----
    y = ∂x/∂p moves by dy/dt = A y + A′ x + B′ u beside dx/dt = A x + B u, so that the rows of y in the step
    of both are the slope.
    """
    steady_a, steady_b, slope_a, slope_b = (
        mapped(part, matrix) for part in (value_of, slope_of) for matrix in (a, b)
    )
    n = len(a)
    if all(isinstance(entry, int) for entry in (*slope_a.ravel(), *slope_b.ravel())):
        return step_balls(steady_a, steady_b, duration)
    nothing = np.zeros((n, n), dtype=object)
    both = step_balls(
        np.block([[steady_a, slope_a], [nothing, steady_a]]), np.vstack([slope_b, steady_b]), duration
    )
    values, slopes = both[n:, n:], both[:n, n:]
    entries = np.empty(values.size, dtype=object)
    entries[:] = [Dual(value, slope) for value, slope in zip(values.ravel(), slopes.ravel(), strict=True)]
    return entries.reshape(values.shape)
