"""Quotients of polynomials in a few parameters, as a number type.

Takes: the symbolic parameters. Gives: `Ratio`, `Ratios`, `NotRational`; `parametric_subsystem`.
Guarantees: exact; two quotients are equal when they are as functions.
Does not: compare values that depend on the parameters, or take their roots.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint

from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.linearization.linearize import subsystem_of_entries
from apc.parameter_values.exact_arithmetic import evaluate_exact

# The limit of terms in a numerator or denominator: products of many parameters grow without end.
MOST_TERMS = 2000


class NotRational(ValueError):
    """The result is no quotient of polynomials in the symbolic parameters."""


def _fraction(value: Any) -> Any:
    """Return a number exactly as a rational of python-flint."""
    exact = Fraction(value)
    return flint.fmpq(exact.numerator, exact.denominator)


@dataclass(frozen=True, slots=True)
class Ratios:
    """The field of quotients in a number of symbolic parameters."""

    context: Any  # flint.fmpq_mpoly_ctx

    @classmethod
    def of(cls, count: int) -> Ratios:
        """Return the field in `count` parameters."""
        names = [f"p{index}" for index in range(count)]
        return cls(flint.fmpq_mpoly_ctx.get(names, flint.Ordering.lex))

    def parameter(self, index: int) -> Ratio:
        """Return the symbolic parameter with an index as a quotient."""
        return Ratio(self, self.context.gens()[index], self.constant(1))

    def constant(self, value: Any) -> Any:
        """Return a rational number as a constant polynomial."""
        return self.context.constant(_fraction(value))


@functools.total_ordering
@dataclass(frozen=True, slots=True, eq=False)
class Ratio:
    """`top`/`bottom`, polynomials over the rationals; computes with whole numbers, fractions and floats."""

    field: Ratios
    top: Any  # flint.fmpq_mpoly
    bottom: Any

    def _as_ratio(self, value: Any) -> Ratio:
        """Return a number as a quotient in the same field."""
        if isinstance(value, Ratio):
            return value
        return Ratio(self.field, self.field.constant(value), self.field.constant(1))

    def _reduced(self, top: Any, bottom: Any) -> Ratio:
        """Return top/bottom without common factors.

        Raises
        ------
        NotRational
            A polynomial has more than MOST_TERMS terms.
        """
        if not bottom.is_constant():
            common = top.gcd(bottom)
            top, bottom = top / common, bottom / common
        if max(len(top.to_dict()), len(bottom.to_dict())) > MOST_TERMS:
            raise NotRational("expands to too many terms")
        return Ratio(self.field, top, bottom)

    def __add__(self, value: Any) -> Ratio:
        other = self._as_ratio(value)
        if self.bottom == other.bottom:
            return self._reduced(self.top + other.top, self.bottom)
        return self._reduced(self.top * other.bottom + other.top * self.bottom, self.bottom * other.bottom)

    def __mul__(self, value: Any) -> Ratio:
        other = self._as_ratio(value)
        return self._reduced(self.top * other.top, self.bottom * other.bottom)

    def __truediv__(self, value: Any) -> Ratio:
        other = self._as_ratio(value)
        if not other:
            raise ZeroDivisionError
        return self._reduced(self.top * other.bottom, self.bottom * other.top)

    def __neg__(self) -> Ratio:
        return Ratio(self.field, -self.top, self.bottom)

    def __sub__(self, value: Any) -> Ratio:
        return self + -self._as_ratio(value)

    def __rsub__(self, value: Any) -> Ratio:
        return self._as_ratio(value) - self

    def __rtruediv__(self, value: Any) -> Ratio:
        return self._as_ratio(value) / self

    def __pow__(self, exponent: int) -> Ratio:
        if exponent < 0:
            return self._as_ratio(1) / self**-exponent
        return self._reduced(self.top**exponent, self.bottom**exponent)

    __radd__ = __add__
    __rmul__ = __mul__

    def __bool__(self) -> bool:
        """Return whether it is not identically zero."""
        return bool(self.top != 0)

    def constant(self) -> Fraction:
        """Return the value of a constant quotient.

        Raises
        ------
        NotRational
            The quotient depends on the parameters.
        """
        if not (self.top.is_constant() and self.bottom.is_constant()):
            raise NotRational("has a condition on a parameter in the box")
        value = flint.fmpq(self.top.leading_coefficient() if self else 0) / self.bottom.leading_coefficient()
        return Fraction(int(value.p), int(value.q))

    __hash__ = None  # type: ignore[assignment] # equal to numbers, as they are not hashed alike

    def __eq__(self, value: object) -> bool:
        return bool((self - value).constant() == 0)

    def __lt__(self, value: Any) -> bool:
        return bool((self - value).constant() < 0)

    def __abs__(self) -> Fraction:
        return abs(self.constant())

    def __int__(self) -> int:
        return int(self.constant())

    def __float__(self) -> float:
        return float(self.constant())


def parametric_subsystem(jacobians: SubsystemJacobians, vector: Sequence[Any]) -> LinearSubsystem:
    """Return the matrices of a subsystem from its parameters (n_p,), some of them symbolic.

    Raises
    ------
    NotRational
        An entry is no quotient of polynomials in the symbolic parameters.
    """
    zeros = [[Fraction(0)] * jacobians.function.numel_in(argument) for argument in range(4)]

    def refuse(name: str, *_: Any) -> Any:
        """Raise NotRational for a transcendental function."""
        raise NotRational(f"has {name}(), which is not a rational function")

    flat = evaluate_exact(jacobians.function, [*zeros, list(vector), [Fraction(0)]], rounded=refuse)[0]
    return subsystem_of_entries(jacobians, flat, Fraction(0))
