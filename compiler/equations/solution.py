"""Equations as residuals, and their solution: assignments, and loops solved by iteration.

Takes: nothing (data types).
Gives: `Residual`, `Problem`; `Assignment`, `ImplicitBlock`, their union `Step`, `Definition`; `listed`,
equations or unknowns as text.
Guarantees: plain frozen data.
Does not: solve anything (see `blt_solver`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from apc.compiler.equations.divisor_test import Divisors
from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.terms import NoDerivativeError, Symbol, Term, symbol
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation, location_in
from apc.compiler.language.constants import undefined_constant

Assignment = tuple[str, Term]  # an unknown, and the expression of its value
MOST_LISTED = 8  # equations or unknowns in one message


@dataclass(frozen=True, slots=True)
class Residual:
    """An equation as `expression = 0`, with its origin for messages."""

    expression: Term
    equation: FlatEquation

    @property
    def shown(self) -> str:
        """The equation as text in the user's spelling, with its origin."""
        return f"`{self.equation.text}` ({self.equation.origin})"


@dataclass(frozen=True, slots=True)
class Problem:
    """The context of a solution: the test of divisors, and the collector of errors.

    `where` is the name of the equations in messages; `location` is the location of errors without an
    equation; `cancelled` has the unknowns that cancel in an equation, with this equation.
    """

    where: str
    location: SourceLocation
    divisors: Divisors
    mistakes: Mistakes
    cancelled: Mapping[str, FlatEquation] = field(default_factory=dict)

    def fault(self, code: str, residuals: Sequence[Residual], message: str, advice: str = "") -> ApcError:
        """Return an error located at the first of some equations.

        Parameters
        ----------
        code, message, advice
            The code, message and fix of the diagnostic.
        residuals
            The equations; if there is none, the error is located at the part.
        """
        location = residuals[0].equation.location if residuals else self.location
        return ApcError(Diagnostic(code, location, message, advice=advice))

    def no_number(self, residuals: Sequence[Residual]) -> ApcError:
        """Return the error E512: equations with a constant that is not a number.

        The message names the constant, or the equations if the constant results from substitution.
        """
        for written in filter(None, (residual.equation.written for residual in residuals)):
            for side in (written.left, written.right):
                if found := undefined_constant(side, written.text):
                    location = location_in(written.location, written.text, found[0].start)
                    return ApcError(Diagnostic("E512", location, found[1]))
        holds = f"{listed(residuals)} {'has' if len(residuals) == 1 else 'have'}"
        return self.fault("E512", residuals, f"{holds} an undefined or too large constant")

    def no_derivative(self, residual: Residual, missing: NoDerivativeError) -> ApcError:
        """Return the error E508: the derivative of an equation is required, but a term has none."""
        message = f"{residual.shown} needs the derivative of {missing}"
        return self.fault(
            "E508", [residual], f"{message}; connect such a force to a position only through a mass"
        )


@dataclass(frozen=True, slots=True)
class ImplicitBlock:
    """A nonlinear loop: its solution is the `tearing` unknowns for which every residual is zero.

    `inner` computes the other unknowns, in this order, from the tearing unknowns. `unknowns` has all unknowns
    in the order of the model.
    """

    unknowns: tuple[str, ...]
    tearing: tuple[str, ...]
    inner: tuple[Assignment, ...]
    residuals: tuple[Term, ...]  # as many as tearing unknowns

    @property
    def expressions(self) -> tuple[Term, ...]:
        """The expressions of the block: residuals and inner assignments."""
        return (*self.residuals, *(value for _, value in self.inner))

    @property
    def free_symbols(self) -> set[Symbol]:
        """The symbols that the solution of the block depends on."""
        result = {s for expression in self.expressions for s in expression.free_symbols}
        return result - {symbol(name) for name in self.unknowns}

    @property
    def chain(self) -> str:
        """The loop as text: `a → b → a`."""
        return " → ".join((*self.unknowns, self.unknowns[0]))


Step = Assignment | ImplicitBlock
Definition = Term | ImplicitBlock  # defines the value of an unknown


def listed(texts: Sequence[str | Residual]) -> str:
    """Return the text of the first few texts or equations, with the number of the others."""
    shown = [text.shown if isinstance(text, Residual) else text for text in texts[:MOST_LISTED]]
    more = len(texts) - MOST_LISTED
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
