"""What solving equations gives: assignments, and loops that an iteration has to solve.

Takes: nothing (data types). Gives: `Assignment`, `ImplicitBlock`, their union `Step`; `assigned`,
`expressions` of one.
Guarantees: plain frozen data.
Does not: solve anything (see `blocks`).
"""

from __future__ import annotations

from dataclasses import dataclass

from apc.compiler.equations.terms import Symbol, Term, symbol

Assignment = tuple[str, Term]  # an unknown, and the expression that gives it


@dataclass(frozen=True, slots=True)
class ImplicitBlock:
    """A nonlinear loop: find the `tearing` unknowns that make every residual zero.

    `inner` computes the other unknowns, in this order, from the tearing unknowns. Unknowns keep the order of
    the model's; `equations` are the loop's, as text.
    """

    unknowns: tuple[str, ...]
    tearing: tuple[str, ...]
    inner: tuple[Assignment, ...]
    residuals: tuple[Term, ...]  # as many as tearing unknowns
    equations: tuple[str, ...]

    @property
    def free_symbols(self) -> set[Symbol]:
        """The symbols the block's solution depends on."""
        found = {s for expression in expressions(self) for s in expression.free_symbols}
        return found - {symbol(name) for name in self.unknowns}

    @property
    def chain(self) -> str:
        """The loop as text: `a → b → a`."""
        return " → ".join((*self.unknowns, self.unknowns[0]))


Step = Assignment | ImplicitBlock


def assigned(step: Step) -> tuple[str, ...]:
    """Return the names a step gives a value."""
    return step.unknowns if isinstance(step, ImplicitBlock) else (step[0],)


def expressions(step: Step) -> tuple[Term, ...]:
    """Return the expressions a step consists of."""
    if isinstance(step, ImplicitBlock):
        return (*step.residuals, *(value for _, value in step.inner))
    return (step[1],)
