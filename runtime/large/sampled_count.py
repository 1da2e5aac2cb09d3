"""How many eigenvalues of a sparse frame map are beyond a circle, from samples of a determinant.

Takes: a `SparseSystem`, its crowds, and the eigenvalues that are known.
Gives: `Argument`, `argument_of`, `count_beyond`.
Guarantees: none beyond what samples can tell; where two rules for the argument's change differ, more samples
are taken, or nothing is said.
Does not: bound the determinant between samples (see `counting`, for small ones).

The count goes around

    g(ζ) = det(I − R/ζ) / Π_k (1 − p_k/ζ),

R the whole and p_k the eigenvalues of peers by themselves, hearing nothing, and those of R that are known: it
goes to 1 as ζ goes to infinity, and its argument moves far less than that of the determinant.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from apc.large.crowds import Crowd
from apc.large.sparse_system import SparseSystem, small_matrix
from apc.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# The argument of a function of ζ.
Argument = Callable[[complex], float]

# Arcs of the half circle to begin with; eigenvalues this near to the circle, relatively, are not divided by,
# but looked at, so many of them.
ARCS, NEAR_CIRCLE, LOOKED_AT = 16, 0.02, 9

# A peer's own eigenvalue this near to a known one, relatively, takes its place.
SAME = 1e-9

# The argument's rate of change is measured over this angle; an arc is settled when two rules for its integral
# differ by less than that (radians); no arc is narrower, and after so many factorizations it is given up.
ANGLE, SETTLED, NARROWEST, MOST_FACTORS = 1e-8, 0.5, 1e-12, 1200


def count_beyond(argument: Argument, alone: tuple[Complexes, Floats], known: Complexes, radius: float) -> int:
    """Return how many eigenvalues are larger than a radius, −1 if it can't be told.

    Parameters
    ----------
    argument
        That of det(I − R/ζ), see `argument_of`.
    alone
        The eigenvalues of the peers by themselves and how often each is there.
    known
        Eigenvalues of R, conjugates left out.
    radius
        The circle's.

    Notes
    -----
    g is taken with what is far from the circle only, and with the eigenvalues that are known: what is near to
    the circle turns it in an angle too small to be seen between samples. Its argument is followed around the
    upper half; the change along an arc is known up to whole turns from its ends, and its rate tells the
    turns: Simpson's rule, as far as the trapezoidal rule on half the arc agrees.
    """
    values, counts = alone
    pairs = np.concatenate([known, known[known.imag != 0].conj()])
    near = np.abs(np.abs(values) - radius) <= NEAR_CIRCLE * radius
    # Of many equal peers that all hear one other, most move by themselves: these eigenvalues are divided by.
    for value in np.unique(pairs[np.abs(np.abs(pairs) - radius) <= NEAR_CIRCLE * radius]).tolist():
        alike = np.abs(values - value) <= SAME * radius
        if alike.any():
            near &= ~alike
            pairs = pairs[pairs != value]
    divided = np.concatenate([values[~near], pairs]), np.concatenate([counts[~near], np.ones(len(pairs))])
    samples: dict[float, tuple[float, float]] = {}

    def sample(angle: float) -> tuple[float, float]:
        if angle not in samples:
            points = [radius * np.exp(1j * one) for one in (angle, angle + ANGLE)]
            here, there = (
                _wrapped(argument(point) - float(divided[1] @ np.angle(1 - divided[0] / point)))
                for point in points
            )
            samples[angle] = here, _wrapped(there - here) / ANGLE
        return samples[angle]

    # The eigenvalues that were missed are most likely near those of peers by themselves.
    there = np.angle(values[near & (values.imag >= 0)])
    likely = np.quantile(there, np.linspace(0, 1, LOOKED_AT)) if len(there) else there
    edges = np.unique(
        np.concatenate([np.linspace(0.0, np.pi, ARCS + 1), likely, np.angle(known[known.imag > 0])])
    )
    pending = list(itertools.pairwise(edges.tolist()))
    turned = 0.0
    while pending:
        if 2 * len(samples) > MOST_FACTORS:
            return -1
        a, b = pending.pop()
        middle = (a + b) / 2
        (at_a, rate_a), (_, rate_m), (at_b, rate_b) = sample(a), sample(middle), sample(b)
        simpson = (b - a) / 6 * (rate_a + 4 * rate_m + rate_b)
        halves = (b - a) / 4 * (rate_a + 2 * rate_m + rate_b)
        exact = simpson + _wrapped(at_b - at_a - simpson)
        if abs(simpson - halves) < SETTLED and abs(exact - simpson) < SETTLED:
            turned += exact
        elif b - a < NARROWEST:
            return -1
        else:
            pending += [(a, middle), (middle, b)]
    outside = float(divided[1][np.abs(divided[0]) > radius].sum())
    turns = 2 * turned / (2 * np.pi)  # the lower half mirrors the upper
    return round(outside - turns) if abs(turns - round(turns)) < 0.1 else -1


def argument_of(system: SparseSystem, listed: Sequence[Crowd]) -> Argument:
    """Return the argument of det(I − R/ζ), from a small matrix: see `sparse_system.small_matrix`."""
    linalg = load_pool("scipy.sparse.linalg")
    small = small_matrix(system, listed)

    def argument(point: complex) -> float:
        factors = linalg.splu(small(point))
        total = float(np.angle(factors.U.diagonal()).sum())
        total += np.pi * (_odd(factors.perm_r) ^ _odd(factors.perm_c))
        for crowd in listed:
            p = crowd.lifted.p
            sign, _ = np.linalg.slogdet(np.eye(p.shape[-1]) - p / point)
            total += float(crowd.counts @ np.angle(sign))
        return _wrapped(total)

    return argument


def _odd(permutation: NDArray[np.int32]) -> bool:
    """Say whether a permutation is odd: n less its cycles."""
    import scipy.sparse

    n = len(permutation)
    graph = scipy.sparse.csr_matrix((np.ones(n), (np.arange(n), permutation)), shape=(n, n))
    cycles = scipy.sparse.csgraph.connected_components(graph, directed=False)[0]
    return bool((n - cycles) % 2)


def _wrapped(angle: float) -> float:
    """Return an angle in (−π, π]."""
    return float(np.pi - (np.pi - angle) % (2 * np.pi))
