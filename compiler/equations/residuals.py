"""Equations as residuals, and the messages for those that don't determine their unknowns.

Takes: equations and the names of their unknowns. Gives: `Residual`, `report_singular`, `listed`.
Guarantees: a message names the equations as the user wrote them, and the unknowns, a few of each.
Does not: solve anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.matching import alternating
from apc.compiler.equations.terms import NoDerivativeError, Term
from apc.compiler.errors import Mistakes, Place
from apc.compiler.words import counted

SCENE = Place("topology")
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


def report_no_number(residuals: Sequence[Residual], mistakes: Mistakes) -> None:
    """Add the mistake E512: equations in which a constant is none, maybe after others are put in."""
    texts = listed([residual.shown for residual in residuals])
    what = f"{texts} hold{'s' if len(residuals) == 1 else ''} a constant that is no number"
    mistakes.add("E512", residuals[0].equation.place, f"{what}, such as 1/0 or sqrt(-1)")


def report_no_derivative(residual: Residual, missing: NoDerivativeError, mistakes: Mistakes) -> None:
    """Add the mistake E508: an equation's derivative is needed, and what it holds has none."""
    what = f"{residual.shown} needs the derivative of {missing}"
    why = "a position follows such a force only through a mass"
    mistakes.add("E508", residual.equation.place, f"{what}; {why}")


def report_singular(
    residuals: Sequence[Residual],
    unknowns: Sequence[str],
    incidence: Sequence[Sequence[int]],
    match: Sequence[int | None],
    where: str,
    mistakes: Mistakes,
    place: Place = SCENE,
) -> None:
    """Add the mistake E502: which equations and which unknowns are too many.

    Parameters
    ----------
    residuals, unknowns
        The equations, and the names of what they are to give.
    incidence
        For each equation the places of its unknowns.
    match
        For each unknown the equation that gives it, None where there is none.
    where
        Which partition that is, for the message.
    mistakes
        Takes the mistake.
    place
        Where to point when there is no equation.
    """
    rows = {column: row for column, row in enumerate(match) if row is not None}
    columns = {row: column for column, row in rows.items()}
    holders: list[list[int]] = [[] for _ in unknowns]
    for i, held in enumerate(incidence):
        for j in held:
            holders[j].append(i)
    unmatched = [i for i in range(len(residuals)) if i not in columns]
    over, over_columns = alternating(unmatched, incidence, rows)
    under_columns, under = alternating([j for j in range(len(unknowns)) if j not in rows], holders, columns)
    parts = []
    place = residuals[0].equation.place if residuals else place
    if over:
        place = residuals[unmatched[0]].equation.place
        named = [unknowns[j] for j in over_columns]
        holding = (
            f"hold only {counted(len(named), 'unknown')} ({listed(named)})" if named else "hold no unknown"
        )
        shown = listed([residuals[i].shown for i in over])
        parts.append(f"{counted(len(over), 'equation')} {holding}: {shown}")
    if under_columns:
        named = [unknowns[j] for j in under_columns]
        texts = [residuals[i].shown for i in under]
        by = f"only {counted(len(texts), 'equation')}, {listed(texts)}" if texts else "no equation"
        has = "has" if len(named) == 1 else "have"
        parts.append(f"{counted(len(named), 'unknown')} ({listed(named)}) {has} {by}")
    mistakes.add("E502", place, f"{where} can't be solved: {'; and '.join(parts)}")


def listed(texts: Sequence[str]) -> str:
    """Join the first few texts and say how many more there are."""
    more = len(texts) - MOST_LISTED
    return ", ".join(texts[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
