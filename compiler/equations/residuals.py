"""Equations as residuals, and the messages for those that don't determine their unknowns.

Takes: equations and the names of their unknowns. Gives: `Residual`, `report_singular`, `listed`.
Guarantees: a message names the equations as the user wrote them, and the unknowns, a few of each.
Does not: solve anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.matching import leftovers
from apc.compiler.equations.terms import Term
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


def report_no_number(texts: Sequence[str], place: Place, mistakes: Mistakes) -> None:
    """Add the mistake E512: equations in which a constant is none, maybe after others are put in."""
    what = f"{listed(texts)} hold{'s' if len(texts) == 1 else ''} a constant that is no number"
    mistakes.add("E512", place, f"{what}, such as 1/0 or sqrt(-1)")


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
    found = leftovers(incidence, match)
    parts = []
    place = residuals[0].equation.place if residuals else place
    if found.over_rows:
        place = next(r for i, r in enumerate(residuals) if i not in match).equation.place
        count = counted(len(found.over_columns), "unknown")
        named = [unknowns[j] for j in found.over_columns]
        held = f"hold only {count} ({listed(named)})" if named else "hold no unknown"
        parts.append(
            f"{counted(len(found.over_rows), 'equation')} {held}: "
            f"{listed([residuals[i].shown for i in found.over_rows])}"
        )
    if found.under_columns:
        count = counted(len(found.under_columns), "unknown")
        shown = [residuals[i].shown for i in found.under_rows]
        by = f"only {counted(len(shown), 'equation')}, {listed(shown)}" if shown else "no equation"
        parts.append(
            f"{count} ({listed([unknowns[j] for j in found.under_columns])}) "
            f"{'has' if len(found.under_columns) == 1 else 'have'} {by}"
        )
    mistakes.add("E502", place, f"{where} can't be solved: {'; and '.join(parts)}")


def listed(texts: Sequence[str]) -> str:
    """Join the first few texts and say how many more there are."""
    more = len(texts) - MOST_LISTED
    return ", ".join(texts[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
