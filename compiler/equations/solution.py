"""Equations as residuals and what solving them gives: assignments, and loops that an iteration has to solve.

Takes: nothing (data types). Gives: `Residual`, `Problem`; `Assignment`, `ImplicitBlock`, their union `Step`,
`Definition`.
Guarantees: plain frozen data.
Does not: solve anything (see `blocks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.terms import NoDerivativeError, Symbol, Term, symbol
from apc.compiler.equations.zero_test import Divisors
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation

Assignment = tuple[str, Term]  # an unknown, and the expression that gives it
MOST_LISTED = 8  # equations or unknowns in one message


@dataclass(frozen=True, slots=True)
class Residual:
    """An equation as `expression = 0`, with its origin for messages."""

    expression: Term
    equation: FlatEquation

    @property
    def shown(self) -> str:
        """The equation as the user wrote it, and where it comes from."""
        return f"`{self.equation.text}` ({self.equation.origin})"


@dataclass(frozen=True, slots=True)
class Problem:
    """What equations are solved with: what may be divided by, and where mistakes go.

    `where` is what a message calls the equations; `place` is where it points when there are none.
    """

    where: str
    place: SourceLocation
    divisors: Divisors
    mistakes: Mistakes

    def fault(self, code: str, residuals: Sequence[Residual], what: str, hint: str = "") -> ApcError:
        """Return a mistake where the first of some equations stands."""
        place = residuals[0].equation.place if residuals else self.place
        return ApcError(Diagnostic(code, place, what, hint=hint))

    def no_number(self, residuals: Sequence[Residual]) -> ApcError:
        """Return the mistake E512: equations in which a constant is none, maybe after others are put in."""
        holds = f"{listed(residuals)} hold{'s' if len(residuals) == 1 else ''}"
        return self.fault("E512", residuals, f"{holds} a constant that is no number, such as 1/0 or sqrt(-1)")

    def no_derivative(self, residual: Residual, missing: NoDerivativeError) -> ApcError:
        """Return the mistake E508: an equation's derivative is needed, and what it holds has none."""
        what = f"{residual.shown} needs the derivative of {missing}"
        return self.fault("E508", [residual], f"{what}; a position follows such a force only through a mass")


@dataclass(frozen=True, slots=True)
class ImplicitBlock:
    """A nonlinear loop: find the `tearing` unknowns that make every residual zero.

    `inner` computes the other unknowns, in this order, from the tearing unknowns. Unknowns keep the order of
    the model's.
    """

    unknowns: tuple[str, ...]
    tearing: tuple[str, ...]
    inner: tuple[Assignment, ...]
    residuals: tuple[Term, ...]  # as many as tearing unknowns

    @property
    def expressions(self) -> tuple[Term, ...]:
        """The expressions it consists of."""
        return (*self.residuals, *(value for _, value in self.inner))

    @property
    def free_symbols(self) -> set[Symbol]:
        """The symbols the block's solution depends on."""
        result = {s for expression in self.expressions for s in expression.free_symbols}
        return result - {symbol(name) for name in self.unknowns}

    @property
    def chain(self) -> str:
        """The loop as text: `a → b → a`."""
        return " → ".join((*self.unknowns, self.unknowns[0]))


Step = Assignment | ImplicitBlock
Definition = Term | ImplicitBlock  # what gives an unknown its value


def listed(texts: Sequence[str | Residual]) -> str:
    """Join the first few texts, or equations, and say how many more there are."""
    shown = [text.shown if isinstance(text, Residual) else text for text in texts[:MOST_LISTED]]
    more = len(texts) - MOST_LISTED
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
