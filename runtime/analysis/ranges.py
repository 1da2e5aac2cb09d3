"""A parameter and its range: what a box leaves open, and what an axis of a region runs over.

Takes: nothing. Gives: `Range`.
Guarantees: the limits are exact, in SI.
Does not: read text (see `box`, `region.axes`), or look at a scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from apc.compiler.words import with_unit


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

    def __str__(self) -> str:
        low, high = (with_unit(f"{float(one):.9g}", self.unit) for one in (self.low, self.high))
        return f"{self.label} from {low} to {high}"

    def to_dict(self) -> dict[str, Any]:
        """Return the range as plain data, ready for JSON."""
        return {"parameter": self.label, "unit": self.unit, "range": [float(self.low), float(self.high)]}
