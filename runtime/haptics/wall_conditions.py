"""Published conditions on the stiffness of a virtual wall: passivity, Z-width, approximate stability.

Takes: the physical quantities of a condition as arrays, in SI.
Gives: `PublishedCondition`, `CONDITIONS`.
Guarantees: each condition carries its source and its assumptions.
Does not: read models (see `overlay`), or check the assumptions of a condition.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# The symbols of the conditions: unit and meaning.
UNITS = {"K": "N/m", "B": "N*s/m", "b": "N*s/m", "T": "ms", "t_d": "ms", "c": "N", "D": "m"}
MEANINGS = {
    "K": "stiffness of the virtual wall",
    "B": "damping of the virtual wall, on the backward difference of positions",
    "b": "physical damping of the device",
    "T": "sampling period",
    "t_d": "delay of the loop beyond the sample and hold",
    "c": "Coulomb friction of the device",
    "D": "resolution of the position sensor",
}


@dataclass(frozen=True, slots=True)
class PublishedCondition:
    """A condition from the literature.

    `margin` is a function of all `symbols` in their order (numbers or arrays in SI): continuous, and positive
    where the condition holds. `formula` is the condition as published.
    """

    name: str
    title: str
    formula: str
    condition: str
    source: str
    assumptions: tuple[str, ...]
    symbols: tuple[str, ...]
    margin: Callable[..., Floats]

    def __str__(self) -> str:
        """Return the condition with its meaning, assumptions and source."""
        assumed = "; ".join(self.assumptions)
        return (
            f"{self.title}: {self.formula} ({self.condition})\n  assumes {assumed}\n  source: {self.source}"
        )


CONDITIONS: Mapping[str, PublishedCondition] = {
    condition.name: condition
    for condition in (
        PublishedCondition(
            name="colgate",
            title="Colgate and Schenkel",
            formula="b > K T/2 + |B|",
            condition="the wall is passive",
            source="J. E. Colgate and G. G. Schenkel, J. Robotic Systems 14(1) (1997) 37",
            assumptions=(
                "a device of one degree of freedom: mass and viscous damping",
                "wall velocity by backward difference, zero-order hold of the force",
                "no further delay",
                "any passive user",
            ),
            symbols=("K", "b", "B", "T"),
            margin=lambda K, b, B, T: b - K * T / 2 - np.abs(B),
        ),
        PublishedCondition(
            name="gil",
            title="Gil et al.",
            formula="K < (b + B)/(T/2 + t_d)",
            condition="contact with the wall is stable, approximately",
            source="J. J. Gil, E. Sánchez, T. Hulin, C. Preusche and G. Hirzinger, "
            "J. Computing and Information Science in Engineering 9(1) (2009) 011005",
            assumptions=(
                "linear system, permanent contact",
                "short delays and fast sampling",
                "little physical and virtual damping for the mass",
                "no user at the device",
            ),
            symbols=("K", "b", "B", "T", "t_d"),
            margin=lambda K, b, B, T, t_d: b + B - K * (T / 2 + t_d),
        ),
        PublishedCondition(
            name="diolaiti",
            title="Diolaiti et al.",
            formula="b/(K T) ≥ 1/2 + t_d/T",
            condition="viscous damping compensates sampling and delay",
            source="N. Diolaiti, G. Niemeyer, F. Barbagli and J. K. Salisbury, "
            "IEEE Trans. Robotics 22(2) (2006) 256",
            assumptions=(
                "a device of one degree of freedom: mass and viscous damping",
                "a wall without damping, with zero-order hold of its force",
                "the resolution of the sensor is neglected",
            ),
            symbols=("K", "b", "T", "t_d"),
            margin=lambda K, b, T, t_d: b - K * (T / 2 + t_d),
        ),
        PublishedCondition(
            name="abbott",
            title="Abbott and Okamura",
            formula="K ≤ min(2 b/T, 2 c/D)",
            condition="the wall is passive with a quantized position",
            source="J. J. Abbott and A. M. Okamura, IEEE Trans. Robotics 21(5) (2005) 952",
            assumptions=(
                "a device of one degree of freedom: mass, viscous damping and Coulomb friction",
                "a wall without damping, with zero-order hold of its force",
                "no further delay",
            ),
            symbols=("K", "b", "T", "c", "D"),
            margin=lambda K, b, T, c, D: np.minimum(b - K * T / 2, c - K * D / 2),
        ),
    )
}
