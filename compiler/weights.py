"""What peers weigh one another by, exactly: the decimals of the file, and what each peer hears in all.

Takes: weights as floats, each standing for the shortest decimal that means it.
Gives: `exact_weight`, `sum_weights`.
Guarantees: sums are exact, so that 0.1 and 0.2 are 0.3, and 0.1, 0.2 and −0.3 are nothing.
Does not: know a graph (see `scene.graphs`).

A peer that weighs others by 0.1 and 0.2 and itself by what doubles make of their sum would be held to the
ground by a rounding: whether peers can move together is decided by equality.
"""

from __future__ import annotations

import functools
import math
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray


def exact_weight(weight: float) -> Fraction:
    """Return the shortest decimal that means a float."""
    return Fraction(repr(float(weight)))


def sum_weights(receivers: NDArray[np.int64], weights: NDArray[np.float64], peers: int) -> NDArray[Any]:
    """Return what each of so many peers hears in all (N,), each a `Fraction`.

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
    whole = np.array([int(weight * denominator) for weight in exact], dtype=object)
    totals = np.zeros(peers, dtype=object)
    np.add.at(totals, receivers, whole[place])
    rational = functools.cache(lambda total: Fraction(total, denominator))
    return np.array([rational(total) for total in totals], dtype=object)
