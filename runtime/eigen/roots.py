"""The roots of a polynomial whose coefficients are balls: approached, then enclosed.

Takes: a real polynomial of python-flint, and guesses.
Gives: `approach_roots`, `root_discs`.
Guarantees: discs hold every root of every polynomial in the balls, whatever the points they are made about;
only their size depends on how near these are.
Does not: say where roots lie relative to the unit circle without their being known (see `certify`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Guesses that are one are pushed apart by this, relatively: Aberth's corrections divide by their
# differences. Float eigenvalues are no nearer to the roots than that.
PUSH = 2.0**-44

# Rounds of Aberth's iteration at most: a fourfold root gains 70 bits, a simple one is done in five.
ROUNDS = 100

# Points are far from each other whose difference, relatively, is more than that, and is in this range.
FAR, LARGE = 2.0**-26, 1e150

# A number of magnitude one with as many digits as a float has.
BESIDE = complex(np.exp(1j))


def approach_roots(polynomial: Any, guesses: Complexes, bits: int) -> list[Any]:
    """Return the roots of a polynomial, approximately, as exact `flint.acb`.

    Parameters
    ----------
    polynomial
        A `flint.arb_poly` of degree n, its leading coefficient 1.
    guesses
        What the roots may be (n,).
    bits
        How many bits the coefficients were computed with, the present precision.

    Notes
    -----
    Aberth's iteration (Iteration methods for finding all zeros of a polynomial simultaneously, Mathematics of
    Computation 27, 1973),

        w_i = p(z_i) / (p'(z_i) − p(z_i) Σ_{j≠i} 1/(z_i − z_j)),   z_i ← z_i − w_i,

    each point until w_i is half the bits below it. It triples the digits of a simple root, and comes nearer
    to an m-fold one by (m − 1)/(m + 1) each time. Coefficients from the lowest on
    that may be zero are taken for roots zero.
    """
    coefficients = polynomial.coeffs()
    n = len(coefficients) - 1
    zeros = 0
    while zeros < n and coefficients[zeros].contains(0):
        zeros += 1
    function = flint.acb_poly([flint.acb(one.mid()) for one in coefficients[zeros:]])
    slope = function.derivative()
    points = _starts([one.mid() for one in coefficients[zeros:]], guesses)
    small = flint.arb(2) ** (-bits // 2)
    moving = list(range(len(points)))
    floats = np.array([complex(point) for point in points], dtype=np.complex128)
    for _ in range(ROUNDS):
        still = []
        for i in moving:
            point = points[i]
            value = function(point)
            move = (value / (slope(point) - value * _away(points, floats, i))).mid()
            if not move.is_finite():
                continue
            points[i] = (point - move).mid()
            floats[i] = complex(points[i])
            if not abs(move) <= small * abs(points[i]):
                still.append(i)
        moving = still
        if not moving:
            break
    return [*points, *[flint.acb(0)] * zeros]


def _away(points: Sequence[Any], floats: Complexes, i: int) -> Any:
    """Return Σ_{j≠i} 1/(z_i − z_j): of points far from each other the digits of a float do.

    Half of them are lost to a point so near, and all of them out of the range of floats.
    """
    apart = floats[i] - floats
    size = np.abs(apart)
    far = (size > FAR * np.abs(floats[i])) & (size > 1 / LARGE) & (size < LARGE)
    total = complex((1 / apart[far]).sum())
    near = (1 / (points[i] - points[j]) for j in np.flatnonzero(~far).tolist() if j != i)
    return sum(near, flint.acb(total.real, total.imag))


def _starts(coefficients: Sequence[Any], guesses: Complexes) -> list[Any]:
    """Return the largest guesses, no two the same, those that can't be right replaced.

    The k-th largest root lies within 2n times, or the 2n-th part of, the k-th radius of the Newton polygon
    (Bini, Numerical computation of polynomial zeros by means of Aberth's method, Numerical Algorithms 13,
    1996): floats don't know what is small beside the largest.
    """
    radii = _polygon([float(abs(one).log()) if one else -np.inf for one in coefficients])
    count = len(radii)
    known = guesses[np.isfinite(guesses)]
    known = known[np.argsort(-np.abs(known), kind="stable")][:count]
    known = np.concatenate([known, np.zeros(count - len(known))])
    turns = np.exp(1j * np.arange(1, count + 1))
    points = []
    for guess, radius, turn in zip(known.tolist(), radii, turns.tolist(), strict=True):
        size = flint.arb(radius).exp()
        point = flint.acb(guess.real, guess.imag) + flint.acb(turn.real, turn.imag) * (PUSH * abs(guess))
        if not size < abs(point) * 2 * count or not abs(point) < size * 2 * count:
            point = flint.acb(turn.real, turn.imag) * size
        points.append(point.mid())
    return points


def _polygon(logs: Sequence[float]) -> list[float]:
    """Return the logarithms of the radii of a Newton polygon, the largest first.

    They are the slopes of the least concave line above the points (i, log|a_i|), each as often as it is long.
    """
    hull: list[int] = []
    for i, log in enumerate(logs):
        if log == -np.inf:
            continue
        while len(hull) > 1 and (log - logs[hull[-1]]) * (hull[-1] - hull[-2]) >= (
            logs[hull[-1]] - logs[hull[-2]]
        ) * (i - hull[-1]):
            hull.pop()
        hull.append(i)
    slopes = [((logs[i] - logs[j]) / (j - i), j - i) for i, j in itertools.pairwise(hull)]
    return [slope for slope, length in reversed(slopes) for _ in range(length)]


def root_discs(polynomial: Any, roots: Sequence[Any], bits: int) -> tuple[Complexes, Floats]:
    """Enclose the roots of a polynomial in discs about approximate ones.

    Parameters
    ----------
    polynomial
        A `flint.arb_poly`, monic, degree n.
    roots
        Its roots (n,), approximately, as `flint.acb`.
    bits
        How many bits the roots were computed with.

    Returns
    -------
    Centres and radii (n,), the rounding of the centres to floats included. All roots are in the discs; k
    discs that hang together hold k of them.

    Notes
    -----
    |z − z_i| ≤ n |p(z_i)| / Π_{j≠i} |z_i − z_j| (Smith, Error bounds for zeros of a polynomial based upon
    Gerschgorin's theorems, J. ACM 17, 1970), for any n different z_i.
    """
    exact = flint.acb_poly(polynomial)
    points = _spread(exact, [root.mid() for root in roots], bits)
    n = len(points)
    centres = np.array([complex(point) for point in points], dtype=np.complex128)
    radii = np.empty(n)
    for i, point in enumerate(points):
        apart = flint.acb(1)
        for j, other in enumerate(points):
            if j != i:
                apart *= point - other
        radius = abs(exact(point) / apart) * n
        radii[i] = float(radius.upper()) * (1 + 4 * UNIT) if radius.is_finite() else np.inf
    return centres, radii + 4 * UNIT * np.abs(centres)


def _spread(polynomial: Any, points: Sequence[Any], bits: int) -> list[Any]:
    """Move roots that are one within the precision apart, as far as Smith's discs become the smallest.

    With m roots on a circle of radius r about c, and a = Π |c − z_j| over all others, a disc's radius is
    n/m (r + |p(c)|/(a r^(m−1))): the least at r^m = (m − 1) |p(c)|/a, where |p(c)| is what of p is not known
    to vanish. It is asked a little beside c, as p can be known too well at a number with few digits.
    """
    near = flint.arb(2) ** (-bits // 4)
    least = flint.arb(2) ** (-bits // 2)
    moved = list(points)
    left = list(range(len(points)))
    while left:
        centre = points[left[0]]
        cluster = [i for i in left if i == left[0] or not abs(points[i] - centre) > near]
        left = [i for i in left if i not in cluster]
        count = len(cluster)
        if count == 1:
            continue
        away = flint.arb(1)
        for j, other in enumerate(points):
            if j not in cluster:
                away *= abs(centre - other)
        beside = (centre + flint.acb(BESIDE.real, BESIDE.imag) * least).mid()
        unknown = abs(polynomial(beside)).upper() * (count - 1) / away
        radius = max(unknown.upper().root(count).mid(), least) if unknown > 0 else least
        for turn, i in enumerate(cluster):
            moved[i] = (centre + radius * flint.acb(flint.fmpq(2 * turn, count)).exp_pi_i()).mid()
    return moved
