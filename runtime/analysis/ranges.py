"""A parameter and its range: what a box leaves open, and what an axis of a region runs over.

Takes: nothing. Gives: `Range`.
Guarantees: the limits are exact, in SI.
Does not: read text (see `box`, `region.axes`), or look at a scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True, slots=True)
class Range:
    """A parameter, of one group or of all (`group` None), from `low` to `high` (SI)."""

    name: str
    group: str | None
    unit: str
    low: Fraction
    high: Fraction

    @property
    def label(self) -> str:
        """The parameter as a person writes it, its group before it."""
        return self.name if self.group is None else f"{self.group}.{self.name}"
