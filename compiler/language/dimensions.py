"""Physical dimensions: products of powers of SI base units.

Takes: nothing (a data type). Gives: `Dimension` and its arithmetic; `DIMENSIONLESS`, `SECOND`.
Guarantees: equal dimensions compare equal, independent of their computation; exponents are exact.
Does not: handle units, which also have a scale (see `units`), or their text (see `unit_text`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction


@dataclass(frozen=True, slots=True)
class Dimension:
    """A product of powers of SI base units, sorted by name and without zeros; the radian is the number 1.

    `turning` is the angle unit of a quantity, cycles ("Hz") or radians ("rad"), if its unit determines it. It
    is ignored in comparisons, and computed values do not have it.
    """

    exponents: tuple[tuple[str, Fraction | int], ...]
    turning: str = field(default="", compare=False)

    def clashes(self, other: Dimension) -> bool:
        """Return whether one dimension counts cycles and the other radians."""
        return {self.turning, other.turning} == {"Hz", "rad"}

    def multiply(self, other: Dimension, times: Fraction | int = 1) -> Dimension:
        """Return the dimension of the product with a power of another dimension."""
        total: dict[str, Fraction | int] = dict(self.exponents)
        for base, power in other.exponents:
            total[base] = total.get(base, 0) + power * times
        return Dimension(tuple(sorted((base, power) for base, power in total.items() if power)))

    def divide(self, other: Dimension) -> Dimension:
        """Return the dimension of a quotient."""
        return self.multiply(other, -1)

    def power(self, exponent: Fraction | int) -> Dimension:
        """Return the dimension of a power."""
        return DIMENSIONLESS.multiply(self, exponent)


DIMENSIONLESS = Dimension(())
SECOND = Dimension((("s", 1),))
