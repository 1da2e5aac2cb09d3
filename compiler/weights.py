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
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Weights that are whole multiples of this, and add up to less than 2^40, add up exactly in doubles.
BINARY = 2.0**-12
MOST_BINARY = 2.0**40


def exact_weight(weight: float) -> Fraction:
    """Return the shortest decimal that means a float."""
    return Fraction(repr(float(weight)))


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What each peer hears in all: `floats` (N,) are the nearest to it, `rounded` the exact sums they round.

    A sum that is a float is not among the `rounded`.
    """

    floats: Floats
    rounded: Mapping[int, Fraction]

    def of(self, peer: int) -> Fraction:
        """Return the exact sum of a peer."""
        return self.rounded[peer] if peer in self.rounded else Fraction(float(self.floats[peer]))

    def alike(self, start: int, end: int) -> bool:
        """Say whether all peers from one up to another hear as much."""
        first = self.of(start)
        if np.any(self.floats[start:end] != self.floats[start]):
            return False
        return not self.rounded or all(self.of(peer) == first for peer in range(start, end))


def sum_weights(receivers: Integers, weights: Floats, peers: int) -> Sums:
    """Add up what each of so many peers hears.

    Parameters
    ----------
    receivers, weights
        Who hears (M,), from 0, and the weight (M,) of each it hears.
    peers
        How many there are.
    """
    sums = np.bincount(receivers, weights, minlength=peers).astype(np.float64)
    sizes = np.bincount(receivers, np.abs(weights), minlength=peers)
    scaled = weights / BINARY
    if np.all(scaled == np.rint(scaled)) and sizes.max(initial=0.0) < MOST_BINARY:
        return Sums(sums, {})
    different, place = np.unique(weights, return_inverse=True)
    exact = [exact_weight(weight) for weight in different.tolist()]
    denominator = math.lcm(*(weight.denominator for weight in exact))
    numerators = [weight.numerator * (denominator // weight.denominator) for weight in exact]
    totals = [0] * peers
    for receiver, number in zip(receivers.tolist(), place.tolist(), strict=True):
        totals[receiver] += numerators[number]
    rounded = {}
    for peer, total in enumerate(totals):
        found = Fraction(total, denominator)
        sums[peer] = float(found)
        if Fraction(float(sums[peer])) != found:
            rounded[peer] = found
    return Sums(sums, rounded)
