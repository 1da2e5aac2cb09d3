"""Frame matrices over a rectangle of two parameters, as Chebyshev series.

Takes: an `Evaluator` of two free parameters and their ranges.
Gives: `ChebyshevFamily`, `DirectFamily`, `resolve_family`; `Rectangle`, `rectangle_of`.
Guarantees: a series stands for the matrices only when it has converged to rounding in both directions, as
seen from its last coefficients; how far it may be off is told.
Does not: resolve what jumps or bends in the rectangle (see `DirectFamily`, which computes every point anew).

The matrices of a frame are polynomials of stiffnesses and dampings, of as high a degree as there are ticks in
a frame, and analytic functions of masses: M(x, y) = Σ_ij C_ij T_i(x) T_j(y), summed for all points by one
product of matrices, derivatives as well. Interpolation at Chebyshev points converges geometrically and
loses a digit at most (Trefethen, Approximation Theory and Approximation Practice, 2013, chapters 8 and 15).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.polynomial.chebyshev import chebder, chebvander
from numpy.typing import NDArray

from apc.compiler.frozen import dataclass
from apc.eigen.eigenpairs import components
from apc.eigen.pseudospectrum import balance
from apc.frame.discretize import UNIT
from apc.frame.names import Range
from apc.regions.eigenpairs import Family
from apc.vary.batch import Evaluator, MatrixSource

Floats = NDArray[np.float64]

# Bounds on the errors of each system's matrices (k, n, n) at values (k, 2).
Errors = Callable[[Floats], tuple[Floats, ...]]

# Nodes along each axis to begin with: a frame of eight ticks is of degree eight. Where that is not enough
# they are doubled, until there are too many points.
NODES = 12
MOST_POINTS = 2500

# The last coefficients along each axis must have come down to this share of the largest: some roundings of
# the values they come from.
CONVERGED = 64 * UNIT

# Coefficients below this share of the largest are left out.
DROPPED = 4 * UNIT

# So many last coefficients along each axis are looked at: even and odd ones may vanish in turn.
LAST = 2


@dataclass(frozen=True, slots=True, eq=False)
class Rectangle:
    """Two ranges in SI: `low` and `width` (2,)."""

    low: Floats
    width: Floats

    def values(self, points: Floats) -> Floats:
        """Return parameter values (k, 2) at points of the unit square."""
        return self.low + points * self.width

    def points(self, values: Floats) -> Floats:
        """Return the points of the unit square (k, 2) of parameter values."""
        return (values - self.low) / self.width

    @property
    def offset(self) -> Floats:
        """What to add to points to have them count from a parameter's zero (2,)."""
        return self.low / self.width


def rectangle_of(x: Range, y: Range) -> Rectangle:
    """Return the rectangle of two ranges."""
    low = np.array([float(x.low), float(y.low)])
    return Rectangle(low, np.array([float(axis.high - axis.low) for axis in (x, y)]))


@dataclass(frozen=True, slots=True, eq=False)
class DirectFamily:
    """A `Family` that asks the evaluator for every point."""

    evaluator: MatrixSource
    rectangle: Rectangle
    sizes: tuple[int, ...]
    errors: tuple[Floats, ...]

    def matrices(self, points: Floats) -> tuple[Floats, ...]:
        """Return each system's matrices (k, n, n) at points (k, 2)."""
        return self.evaluator.matrices(self.rectangle.values(points))

    def slopes(self, system: int, points: Floats) -> tuple[Floats, Floats]:
        """Return one system's matrices (k, n, n) and their derivatives (2, k, n, n) over x and y."""
        count = len(points)
        values = np.concatenate([self.rectangle.values(points)] * 2)
        along = np.zeros_like(values)
        along[:count, 0], along[count:, 1] = self.rectangle.width
        matrix, slope = (
            _sized(one, self.sizes[system]) for one in self.evaluator.slopes(values, along)[system]
        )
        return matrix[:count], slope.reshape(2, count, *slope.shape[1:])


def _sized(matrices: Floats, size: int) -> Floats:
    """Return matrices (k, n, n) as (k, size, size): zeros are put on or left off, which moves nothing.

    All of a matrix is NaN where there is none, or one with more states than that.
    """
    n = matrices.shape[1]
    if n == size:
        return matrices
    found = np.zeros((len(matrices), size, size))
    both = min(n, size)
    found[:, :both, :both] = matrices[:, :both, :both]
    lost = matrices[:, both:].any(axis=(1, 2)) | matrices[:, :, both:].any(axis=(1, 2))
    found[lost | ~np.isfinite(matrices).all(axis=(1, 2))] = np.nan
    return found


@dataclass(frozen=True, slots=True, eq=False)
class ChebyshevFamily:
    """A `Family` that sums series: `terms` (m, 2) are the degrees (i, j) of all that some system needs.

    `coefficients` (m, 3 n²), one a system, are those of its matrices and of their derivatives over x and y.
    """

    terms: NDArray[np.int64]
    coefficients: tuple[Floats, ...]
    sizes: tuple[int, ...]
    errors: tuple[Floats, ...]

    def matrices(self, points: Floats) -> tuple[Floats, ...]:
        """Return each system's matrices (k, n, n) at points (k, 2)."""
        polynomials = self._polynomials(points)
        return tuple(
            (polynomials @ coefficients[:, : n * n]).reshape(-1, n, n)
            for coefficients, n in zip(self.coefficients, self.sizes, strict=True)
        )

    def slopes(self, system: int, points: Floats) -> tuple[Floats, Floats]:
        """Return one system's matrices (k, n, n) and their derivatives (2, k, n, n) over x and y."""
        n = self.sizes[system]
        summed = (self._polynomials(points) @ self.coefficients[system]).reshape(-1, 3, n, n)
        return summed[:, 0], summed[:, 1:].swapaxes(0, 1)

    def _polynomials(self, points: Floats) -> Floats:
        """Return T_i(x) T_j(y) of every term (k, m) at points (k, 2)."""
        x, y = chebvander(2 * points.T - 1, int(self.terms.max(initial=0)))
        found: Floats = x[:, self.terms[:, 0]] * y[:, self.terms[:, 1]]
        return found


def resolve_family(evaluator: Evaluator, rectangle: Rectangle, errors: Errors) -> Family:
    """Return the matrices over a rectangle as series where these converge, else as the evaluator has them.

    Parameters
    ----------
    evaluator
        Of two free parameters.
    rectangle
        Their ranges.
    errors
        Bounds (k, n, n) on the errors of each system's matrices at values (k, 2), entry by entry.
    """
    corners = rectangle.values(np.array([[0.1, 0.1], [0.1, 0.9], [0.9, 0.1], [0.9, 0.9]]))
    wrong = [one.max(axis=0) for one in errors(corners)]
    counts = (NODES, NODES)
    while counts[0] * counts[1] <= MOST_POINTS:
        sampled, series = _sample(evaluator, rectangle, counts)
        if series is None:
            break
        # Other units of the states, which no eigenvalue feels, so that no entry is rounded like a larger.
        scales = [balance(np.abs(one).max(axis=0)) for one in sampled]
        series = [
            one * (scale[None, :] / scale[:, None]).ravel() for one, scale in zip(series, scales, strict=True)
        ]
        doubts = [one * scale / scale[:, None] for one, scale in zip(wrong, scales, strict=True)]
        series, doubts = _without_queues(series, doubts)
        largest = [float(np.abs(one).max(initial=0.0)) for one in series]
        x_done, y_done = (
            all(
                float(np.abs(np.moveaxis(one, axis, 0)[-LAST:]).max(initial=0.0)) <= CONVERGED * most
                for one, most in zip(series, largest, strict=True)
            )
            for axis in (0, 1)
        )
        if x_done and y_done:
            left_out = sum(counts) * CONVERGED + counts[0] * counts[1] * DROPPED
            terms, coefficients = _with_slopes(series, [DROPPED * most for most in largest])
            return ChebyshevFamily(
                terms=terms,
                coefficients=coefficients,
                sizes=tuple(map(len, doubts)),
                errors=tuple(one + left_out * most for one, most in zip(doubts, largest, strict=True)),
            )
        counts = (counts[0] * (1 if x_done else 2), counts[1] * (1 if y_done else 2))
    return DirectFamily(evaluator, rectangle, tuple(map(len, wrong)), tuple(wrong))


def _sample(
    evaluator: Evaluator, rectangle: Rectangle, counts: tuple[int, int]
) -> tuple[tuple[Floats, ...], list[Floats] | None]:
    """Return each system's matrices (k, n, n) at Chebyshev points, and their coefficients (n_x, n_y, n²).

    None in their place where some matrix is not finite.
    """
    nodes = [(1 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2 for count in counts]
    points = np.stack([np.repeat(nodes[0], counts[1]), np.tile(nodes[1], counts[0])], axis=1)
    sampled = evaluator.matrices(rectangle.values(points))
    if not all(np.isfinite(one).all() for one in sampled):
        return sampled, None
    x, y = (_to_coefficients(one) for one in nodes)
    series = []
    for one in sampled:
        values = one.reshape(counts[0], -1)
        by_y = (x @ values).reshape(counts[0], counts[1], -1)
        series.append(y @ by_y)
    return sampled, series


def _without_queues(series: list[Floats], errors: list[Floats]) -> tuple[list[Floats], list[Floats]]:
    """Return each system's series (n_x, n_y, n²) and errors (n, n) over states that drive one another.

    All others, as packets that are only passed on, have the eigenvalue 0 wherever the entries are.
    """
    kept, doubts = [], []
    for one, error in zip(series, errors, strict=True):
        size = np.abs(one).max(axis=(0, 1)).reshape(error.shape) + error
        parts = [states for states in components(size != 0) if size[np.ix_(states, states)].any()]
        places = np.sort(np.concatenate(parts)) if parts else np.arange(len(size))
        kept.append(one[:, :, (places[:, None] * len(size) + places).ravel()])
        doubts.append(error[np.ix_(places, places)])
    return kept, doubts


def _with_slopes(series: list[Floats], dropped: list[float]) -> tuple[NDArray[np.int64], tuple[Floats, ...]]:
    """Return the terms (m, 2) some system's series has beyond what is dropped, or its slopes have of them.

    With them the coefficients (m, 3 n²), one a system, of the series (n_x, n_y, n²) and of both slopes.
    """
    found = []
    for one, least in zip(series, dropped, strict=True):
        kept = np.where(np.abs(one).max(axis=2, keepdims=True, initial=0.0) > least, one, 0.0)
        x, y = map(_derivative, kept.shape[:2])
        over_x = (x @ kept.reshape(len(x), -1)).reshape(kept.shape)
        found.append(np.stack([kept, over_x, y @ kept], axis=2))
    terms = np.argwhere(sum((one != 0).any(axis=(2, 3)) for one in found))
    picked = (one[terms[:, 0], terms[:, 1]].reshape(len(terms), -1) for one in found)
    return terms, tuple(picked)


@lru_cache(maxsize=8)
def _derivative(count: int) -> Floats:
    """Return what turns so many coefficients into those of the derivative over the unit interval."""
    found: Floats = np.vstack([chebder(np.eye(count), scl=2), np.zeros((1, count))])
    found.flags.writeable = False  # it is kept
    return found


def _to_coefficients(nodes: Floats) -> Floats:
    """Return what turns values at Chebyshev points into coefficients: row i is cos(i θ) at their angles."""
    count = len(nodes)
    transform: Floats = np.cos(np.outer(np.arange(count), np.arccos(2 * nodes - 1))) * (2 / count)
    transform[0] /= 2
    return transform
