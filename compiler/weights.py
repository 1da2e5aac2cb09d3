"""What peers weigh one another by, exactly: the decimals of the file, and what each peer hears in all.

Takes: weights as floats, each standing for the shortest decimal that means it.
Gives: `exact_weight`, `Sums`, `sum_weights`.
Guarantees: sums are exact, so that 0.1 and 0.2 are 0.3, and 0.1, 0.2 and −0.3 are nothing.
Does not: know a graph (see `scene.graphs`).

A peer that weighs others by 0.1 and 0.2 and itself by what doubles make of their sum would be held to the
ground by a rounding: whether peers can move together is decided by equality.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

EXACT_DOUBLES = 2**53  # whole numbers below it add up exactly in doubles


def exact_weight(weight: float) -> Fraction:
    """Return the shortest decimal that means a float."""
    return Fraction(repr(float(weight)))


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What each peer hears in all: `totals` (N,), whole numbers of any size, over a common `denominator`."""

    totals: NDArray[Any]
    denominator: int

    @property
    def floats(self) -> Floats:
        """The floats (N,) nearest to the sums."""
        return np.asarray(self.totals / self.denominator, dtype=np.float64)

    def of(self, peer: int) -> Fraction:
        """Return the exact sum of a peer."""
        return Fraction(int(self.totals[peer]), self.denominator)

    @property
    def values(self) -> set[Fraction]:
        """The different sums there are, exact."""
        return {Fraction(total, self.denominator) for total in set(self.totals.tolist())}

    def alike(self, start: int, end: int) -> bool:
        """Say whether all peers from one up to another hear as much."""
        return bool(np.all(self.totals[start:end] == self.totals[start]))


def sum_weights(receivers: Integers, weights: Floats, peers: int) -> Sums:
    """Add up what each of so many peers hears.

    Parameters
    ----------
    receivers, weights
        Who hears (M,), from 0, and the weight (M,) of each it hears.
    peers
        How many there are.
    """
    different, place = np.unique(weights, return_inverse=True)
    exact = [exact_weight(weight) for weight in different.tolist()]
    denominator = math.lcm(*(weight.denominator for weight in exact))
    numerators = [int(weight * denominator) for weight in exact]
    if max(map(abs, numerators), default=0) * len(weights) < EXACT_DOUBLES:
        sums = np.bincount(receivers, np.array(numerators, np.float64)[place], minlength=peers)
        return Sums(sums.astype(np.int64), denominator)
    totals = np.zeros(peers, dtype=object)
    np.add.at(totals, receivers, np.array(numerators, dtype=object)[place])
    return Sums(totals, denominator)
