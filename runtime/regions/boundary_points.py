"""Newton's method onto the boundary, for many points at once.

Takes: an `Eigenvalues`, and guesses of points and eigenvalues.
Gives: `cross`, `newton_refine`, `extrapolated`, `is_outermost`; `SHORT`.
Guarantees: a point is on the curve log|λ| = 0 of its eigenvalue to rounding, or NaN; at a point of `cross`
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

# After a step this short, in unit coordinates, the error is its square.
SHORT = 1e-8

# The number of steps within which Newton's method converges from a start near a solution.
MOST_STEPS = 8

# The largest number of bracket reductions, each by half or more; Newton's method is tried on the first few.
# It does not converge at discontinuities of the spectral radius.
MOST_BRACKETS, MOST_TRIES = 50, 8

# The length of a bracket, in unit coordinates, at which bisection ends.
CLOSED = 1e-12

# The limit of log|λ| of other eigenvalues at a point on the boundary.
OUTSIDE = 1e-9


def cross(
    evaluator: Eigenvalues, stable: Floats, unstable: Floats, growth: Floats, *, tries: int = MOST_TRIES
) -> tuple[Floats, Pairs]:
    """Return the boundary points between stable and unstable points, and the critical eigenvalues.

    Parameters
    ----------
    evaluator
        The evaluator.
    stable, unstable
        The ends of the brackets (k, 2).
    growth
        The log of the spectral radius at both ends (k, 2).
    tries
        The number of trials of Newton's method.

    Notes
    -----
    The largest eigenvalue at the unstable end is followed to the unit circle. If another eigenvalue is still
    outside there, this point is the new unstable end; if Newton's method fails, the middle becomes an end.
    At a jump of the radius, the unstable end of the last bracket is returned.
    """
    count = len(stable)
    low, high = np.zeros(count), np.ones(count)
    direction = unstable - stable
    points = unstable.copy()
    pairs = evaluator.dominant(unstable)
    guess = _quadratic_root(growth, (pairs.gradient * direction).sum(axis=1))
    open_brackets = np.arange(count)
    for bracket in range(MOST_BRACKETS):
        middle = (low[open_brackets] + high[open_brackets]) / 2
        evaluated_at, converged = middle, np.zeros(len(open_brackets), dtype=bool)
        if bracket < tries:
            start = stable[open_brackets] + guess[open_brackets, None] * direction[open_brackets]
            newton_points, result = newton_refine(
                evaluator,
                start,
                extrapolated(pairs.at(open_brackets), start - points[open_brackets]),
                direction[open_brackets],
            )
            length = np.square(direction[open_brackets]).sum(axis=1)
            position = ((newton_points - stable[open_brackets]) * direction[open_brackets]).sum(
                axis=1
            ) / length
            converged = (
                np.isfinite(position) & (position >= low[open_brackets]) & (position <= high[open_brackets])
            )
            evaluated_at = np.where(converged, position, middle)
        trial_points = stable[open_brackets] + evaluated_at[:, None] * direction[open_brackets]
        log_radius = evaluator.growth(trial_points)
        on_boundary = converged.copy()
        if converged.any():
            on_boundary[converged] = log_radius[converged] <= log_radius_tolerance(
                trial_points[converged], result.gradient[converged]
            )
            points[open_brackets[on_boundary]] = newton_points[on_boundary]
            _assign(pairs, open_brackets[on_boundary], result.at(on_boundary))
        is_unstable = ~on_boundary & (log_radius > 0)
        low[open_brackets[~on_boundary & ~is_unstable]] = evaluated_at[~on_boundary & ~is_unstable]
        high[open_brackets[is_unstable]] = evaluated_at[is_unstable]
        to_restart = open_brackets[is_unstable]
        if len(to_restart) and bracket < tries - 1:
            points[to_restart] = trial_points[is_unstable]
            _assign(pairs, to_restart, evaluator.dominant(points[to_restart]))
        open_brackets = open_brackets[~on_boundary]
        guess[open_brackets] = (low[open_brackets] + high[open_brackets]) / 2
        if (np.hypot(*direction[open_brackets].T) * (high - low)[open_brackets] <= CLOSED).all():
            break
    if not len(open_brackets):
        return points, pairs
    points[open_brackets] = stable[open_brackets] + high[open_brackets, None] * direction[open_brackets]
    _assign(pairs, open_brackets, evaluator.dominant(points[open_brackets]))
    return points, pairs


def _quadratic_root(growth: Floats, slope: Floats) -> Floats:
    """Return the zero in (0, 1) of a quadratic with values (k, 2) at 0 and 1 and slope (k,) at 1.

    If the slope does not match, as another mode is critical at the other end, the root of the secant.
    """
    low, high = growth.T
    bend = slope - (high - low)  # g = high + slope (t − 1) + bend (t − 1)²
    root = np.sqrt(np.maximum(slope**2 - 4 * bend * high, 0.0))
    # The root next to t = 1, in the form that cancels nothing.
    result = 1 - 2 * high / np.where(slope + root > 0, slope + root, np.inf)
    is_valid = (result > 0) & (result < 1) & (slope > 0)
    guess: Floats = np.where(is_valid, result, low / (low - high))
    return guess


def _assign(pairs: Pairs, indices: Integers, new: Pairs) -> None:
    """Write eigenpairs into some rows of others, in place."""
    for name in Pairs.__slots__:
        getattr(pairs, name)[indices] = getattr(new, name)


def log_radius_tolerance(points: Floats, gradient: Floats) -> Floats:
    """Return the tolerance of log|λ| at boundary points (k,), evaluated just inside the rectangle."""
    shift = np.abs(just_inside(points) - points)
    limit: Floats = OUTSIDE + 2 * (shift * np.abs(gradient)).sum(axis=1)
    return limit


def is_outermost(evaluator: Eigenvalues, points: Floats, pairs: Pairs) -> NDArray[np.bool_]:
    """Return for each boundary point whether no other eigenvalue is outside the unit circle."""
    outermost: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    if outermost.any():
        outermost[outermost] = evaluator.growth(points[outermost]) <= log_radius_tolerance(
            points[outermost], pairs.gradient[outermost]
        )
    return outermost


def extrapolated(pairs: Pairs, displacements: Floats) -> Pairs:
    """Return a first-order guess of the eigenpairs at displaced points.

    `displacements` (k, 2) are those of the points.
    """
    return replace(pairs, value=pairs.value + (pairs.slope * displacements).sum(axis=1))


def newton_refine(
    evaluator: Eigenvalues, points: Floats, guess: Pairs, along: Floats | None = None
) -> tuple[Floats, Pairs]:
    """Return points moved onto the curve log|λ| = 0 of the guessed eigenvalues by Newton's method.

    Parameters
    ----------
    evaluator
        The evaluator of eigenvalues and their slopes.
    points
        The start points (k, 2).
    guess
        The eigenpairs to follow.
    along
        Fixed directions of the steps (k, 2); by default the gradient at each point.

    Returns
    -------
    Floats, Pairs
        The points (k, 2), NaN without convergence, and the eigenpair at the end of each point's last step.
    """
    # `active` are the indices of the points that still move; the other arrays have a row for each of these.
    converged_points, active = np.full(points.shape, np.nan), np.arange(len(points))
    all_pairs = guess
    for _ in range(MOST_STEPS):
        guess = evaluator.refine(points, guess)
        direction = guess.gradient if along is None else along
        slope = (guess.gradient * direction).sum(axis=1)
        step = -(guess.log_radius / np.where(slope == 0, np.nan, slope))[:, None] * direction
        step_lengths = np.hypot(*step.T)
        points, guess = points + step, extrapolated(guess, step)
        converged = step_lengths <= SHORT
        converged_points[active[converged]] = points[converged]
        if len(active) == len(converged_points):
            all_pairs = guess
        else:
            _assign(all_pairs, active, guess)
        continuing = ~converged & (step_lengths <= 1)
        if not continuing.any():
            break
        active, points, guess = active[continuing], points[continuing], guess.at(continuing)
        along = along if along is None else along[continuing]
    return converged_points, all_pairs
