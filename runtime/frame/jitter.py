"""How much later than others a packet arrives: the distributions of a link's jitter.

Takes: random numbers from 0 to less than 1. Gives: `deviates`, `LATEST`.
Guarantees: the same with every version of NumPy: nothing is drawn here.
Does not: know a link (see `channel_law`) or draw numbers (see `packets`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# netem's Pareto table (iproute2, netem/pareto.c): shape 3, its mean 3/2 taken off, times 4/3, and no more
# than 4, the largest number that the table can hold (32767/8192).
PARETO_SHAPE = 3

PARETO_MOST = 4.0

# The largest numbers that `deviates` gives: of 53 random bits, a normal is never beyond √(2·53·ln 2) = 8.57.
LATEST = {"uniform": 1.0, "normal": math.sqrt(2 * 53 * math.log(2)), "pareto": PARETO_MOST}


def deviates(distribution: str, one: Floats, two: Floats) -> Floats:
    """Return what a jitter of 1 adds to a delay, drawn from a distribution.

    Parameters
    ----------
    distribution
        "uniform": evenly from −1 to 1; "normal": of mean 0 and standard deviation 1; "pareto": netem's, from
        −2/3 to 4, many a little early and few very late, of mean −0.033 and standard deviation 0.84.
    one, two
        Independent numbers (n,) from 0 to less than 1.
    """
    match distribution:
        case "uniform":
            return 2 * one - 1
        case "normal":  # Box and Muller (1958)
            normal = np.sqrt(-2 * np.log1p(-one)) * np.cos(2 * np.pi * two)
            return np.asarray(normal, dtype=np.float64)
    assert distribution == "pareto", f"no such distribution: {distribution}"
    tail = (1 - one) ** (-1 / PARETO_SHAPE)
    late = (tail - PARETO_SHAPE / (PARETO_SHAPE - 1)) * 4 / 3
    return np.asarray(np.minimum(late, PARETO_MOST), dtype=np.float64)
