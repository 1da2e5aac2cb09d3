"""Newton's method onto the boundary, for many points at once.

Takes: an `Eigenvalues`, and guesses of points and eigenvalues.
Gives: `cross`, `newton_refine`, `moved`, `clear`; `SHORT`.
Guarantees: a point is on the curve log|λ| = 0 of its eigenvalue to rounding, or NaN; one of `cross` is where
the spectral radius is 1.
Does not: connect points (see `boundary`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apc.regions.adaptive_grid import just_inside
from apc.regions.dominant_pairs import Eigenvalues, Pairs

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# A step this short, in unit coordinates, leaves an error of its square.
SHORT = 1e-8

# Newton's method converges within this number of steps or the start is not near a solution.
MOST_STEPS = 8

# The largest number of bracket reductions, each by half or more; Newton's method is tried on the first few.
# It does not converge at discontinuities of the spectral radius.
MOST_BRACKETS, MOST_TRIES = 50, 8

# A bracket this short, in unit coordinates, is one point.
CLOSED = 1e-12

# log|λ| of another eigenvalue at a point of the boundary above this means that the point isn't on it.
OUTSIDE = 1e-9


def cross(
    deciding: Eigenvalues, stable: Floats, unstable: Floats, growth: Floats, *, tries: int = MOST_TRIES
) -> tuple[Floats, Pairs]:
    """Return the boundary points between stable and unstable points, and the critical eigenvalues.

    Parameters
    ----------
    deciding
        The evaluator.
    stable, unstable
        The ends of the stretches (k, 2).
    growth
        The log of the spectral radius at both ends (k, 2).
    tries
        The number of trials of Newton's method.

    Notes
    -----
    The eigenvalue that is largest at the unstable end is followed to where it enters the unit circle. If
    another one is still outside there, that point is the new unstable end; if Newton's method went nowhere,
    the middle becomes an end. Where the radius jumps, the unstable end of the last bracket is what is found.
    """
    count = len(stable)
    low, high = np.zeros(count), np.ones(count)
    along = unstable - stable
    points = unstable.copy()
    pairs = deciding.dominant(unstable)
    guess = _quadratic_root(growth, (pairs.gradient * along).sum(axis=1))
    rest = np.arange(count)
    for bracket in range(MOST_BRACKETS):
        middle = (low[rest] + high[rest]) / 2
        evaluated_at, arrived = middle, np.zeros(len(rest), dtype=bool)
        if bracket < tries:
            start = stable[rest] + guess[rest, None] * along[rest]
            index, result = newton_refine(
                deciding, start, moved(pairs.at(rest), start - points[rest]), along[rest]
            )
            length = np.square(along[rest]).sum(axis=1)
            reached = ((index - stable[rest]) * along[rest]).sum(axis=1) / length
            arrived = np.isfinite(reached) & (reached >= low[rest]) & (reached <= high[rest])
            evaluated_at = np.where(arrived, reached, middle)
        spots = stable[rest] + evaluated_at[:, None] * along[rest]
        top = deciding.growth(spots)
        good = arrived.copy()
        if arrived.any():
            good[arrived] = top[arrived] <= rounded_log_radius(spots[arrived], result.gradient[arrived])
            points[rest[good]] = index[good]
            _put(pairs, rest[good], result.at(good))
        out = ~good & (top > 0)
        low[rest[~good & ~out]] = evaluated_at[~good & ~out]
        high[rest[out]] = evaluated_at[out]
        repeated = rest[out]
        if len(repeated) and bracket < tries - 1:
            points[repeated] = spots[out]
            _put(pairs, repeated, deciding.dominant(points[repeated]))
        rest = rest[~good]
        guess[rest] = (low[rest] + high[rest]) / 2
        if (np.hypot(*along[rest].T) * (high - low)[rest] <= CLOSED).all():
            break
    if not len(rest):
        return points, pairs
    points[rest] = stable[rest] + high[rest, None] * along[rest]
    _put(pairs, rest, deciding.dominant(points[rest]))
    return points, pairs


def _quadratic_root(growth: Floats, slope: Floats) -> Floats:
    """Return the zero in (0, 1) of a quadratic with values (k, 2) at 0 and 1 and slope (k,) at 1.

    Where the slope doesn't fit, by another mode at the other end, the secant's root.
    """
    low, high = growth.T
    bend = slope - (high - low)  # g = high + slope (t − 1) + bend (t − 1)²
    root = np.sqrt(np.maximum(slope**2 - 4 * bend * high, 0.0))
    # The root next to t = 1, in the form that cancels nothing.
    result = 1 - 2 * high / np.where(slope + root > 0, slope + root, np.inf)
    fits = (result > 0) & (result < 1) & (slope > 0)
    guess: Floats = np.where(fits, result, low / (low - high))
    return guess


def _put(pairs: Pairs, indices: Integers, new: Pairs) -> None:
    """Write pairs into others, in place."""
    for name in Pairs.__slots__:
        getattr(pairs, name)[indices] = getattr(new, name)


def rounded_log_radius(points: Floats, gradient: Floats) -> Floats:
    """Return the tolerance for zero log|λ| at boundary points, evaluated just inside the rectangle."""
    shift = np.abs(just_inside(points) - points)
    limit: Floats = OUTSIDE + 2 * (shift * np.abs(gradient)).sum(axis=1)
    return limit


def clear(deciding: Eigenvalues, points: Floats, pairs: Pairs) -> NDArray[np.bool_]:
    """Return for each boundary point whether no other eigenvalue is outside the unit circle."""
    alone: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    if alone.any():
        alone[alone] = deciding.growth(points[alone]) <= rounded_log_radius(
            points[alone], pairs.gradient[alone]
        )
    return alone


def moved(pairs: Pairs, by: Floats) -> Pairs:
    """Return a guess of the pairs at points moved by (k, 2), to first order."""
    return replace(pairs, value=pairs.value + (pairs.slope * by).sum(axis=1))


def newton_refine(
    deciding: Eigenvalues, points: Floats, guess: Pairs, along: Floats | None = None
) -> tuple[Floats, Pairs]:
    """Move points onto the curve log|λ| = 0 of the eigenvalues guessed; NaN where that leads nowhere.

    Parameters
    ----------
    deciding
        The evaluator.
    points
        The start points (k, 2).
    guess
        The eigenvalues to follow.
    along
        Directions to stay on (k, 2); left out, each point moves down its gradient.
    """
    values, rest = np.full(points.shape, np.nan), np.arange(len(points))
    whole = guess
    for _ in range(MOST_STEPS):
        guess = deciding.follow(points, guess)
        direction = guess.gradient if along is None else along
        rise = (guess.gradient * direction).sum(axis=1)
        step = -(guess.log_radius / np.where(rise == 0, np.nan, rise))[:, None] * direction
        size = np.hypot(*step.T)
        points, guess = points + step, moved(guess, step)
        done = size <= SHORT
        values[rest[done]] = points[done]
        if len(rest) == len(values):
            whole = guess
        else:
            _put(whole, rest, guess)
        left = ~done & (size <= 1)
        if not left.any():
            break
        rest, points, guess = rest[left], points[left], guess.at(left)
        along = along if along is None else along[left]
    return values, whole
