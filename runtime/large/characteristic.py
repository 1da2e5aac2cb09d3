"""The characteristic function of a population: small, whatever the number of peers and the length of delays.

Takes: the `Transfer`s of all sites, and how what they send comes back to them; circles.
Gives: `Characteristic`, `Matrices`, `matrices_at`, `characteristic_ball`, `refine`, `null_vectors`,
`weights_at`; `count_around`.
Guarantees: its value in a disc comes with a bound; an eigenvalue of the whole system is a zero of it, or a
pole of a site that the zero would have to cancel. A count is right, None says that it can't be told.
Does not: know who the sites are (see `determinant`), or where zeros may be (see `zeros`).

    f(ζ) = det(I − T(ζ) W(ζ)),   W(ζ) = Σ_l W_l ζ^(−l)

The sites answer what they hear, s = T r, and hear what was sent l frames ago, r = W s. f has a zero where
that holds without any cause, goes to 1 as ζ goes to infinity, and has the sites' poles: all zeros less all
poles of the sites outside of a circle are the negative of how often f goes around 0 along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.norms import PRODUCT_ROUNDINGS
from apc.eigen.winding import Ball, determinant_ball, wind
from apc.frame.discretize import UNIT
from apc.large.transfer import Transfer, differentiate, respond

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


# Steps of Newton's method, none longer than this share of |ζ|; the relative step at which it has arrived, and
# that from which on rounding alone moves it. Nobody looks for a zero so many times beyond the largest pole.
STEPS, LONGEST, ARRIVED, NEAR, FARTHEST = 40, 0.1, 1e-15, 1e-6, 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Characteristic:
    """f(ζ) = det(I − T W); `weights` (l, n_r, n_s) are W_l, `lags` the l.

    The weights are right to `weight_errors`.
    """

    transfers: tuple[Transfer, ...]
    lags: tuple[int, ...]
    weights: Floats
    weight_errors: Floats

    @property
    def innermost(self) -> float:
        """The least |ζ| at which it can be evaluated."""
        return 2 * max(one.inner for one in self.transfers)


def weights_at(function: Characteristic, points: Complexes) -> Complexes:
    """Return W (z, n_r, n_s)."""
    powers = points[:, None] ** -np.array(function.lags)
    return np.asarray(np.einsum("zl,lrs->zrs", powers, function.weights))


@dataclass(frozen=True, slots=True, eq=False)
class Matrices:
    """I − T W at ζ + h: `value` + h · `slope`, but for what `doubt` bounds in the disc (z, n, n).

    `weight` (z, n_r, n_s) is W at ζ, `weight_doubt` what it may be off by anywhere in the disc.
    """

    value: Complexes
    slope: Complexes
    doubt: Floats
    weight: Complexes
    weight_doubt: Floats


def _weight_slopes(function: Characteristic, points: Complexes) -> Complexes:
    """Return dW/dζ (z, n_r, n_s)."""
    lags = np.array(function.lags)
    return np.asarray(np.einsum("zl,lrs->zrs", -lags * points[:, None] ** (-lags - 1), function.weights))


def matrices_at(function: Characteristic, points: Complexes, reach: Floats) -> Matrices:
    """Return I − T W at the centres of discs, its slope there, and a bound on the rest in each.

    Parameters
    ----------
    function
        f.
    points, reach
        The discs (z,).
    """
    lags = np.array(function.lags)
    answer = respond(function.transfers, points, reach)
    weight, weight_slope = weights_at(function, points), _weight_slopes(function, points)
    # Taylor's remainder of ζ^−l; a power by way of logarithms loses a rounding a turn.
    near = np.maximum(np.abs(points) - reach, np.finfo(np.float64).tiny)[:, None]
    share = reach[:, None] / near
    largest = near**-lags
    wander = largest * (share**2 * lags * (lags + 1) / 2 + (1 + lags * share) * (16 + 8 * lags) * UNIT)
    weight_doubt = np.einsum("zl,lrs->zrs", wander, np.abs(function.weights))
    weight_doubt += np.einsum("zl,lrs->zrs", largest, function.weight_errors)
    size = np.einsum("zl,lrs->zrs", np.abs(points[:, None]) ** -lags, np.abs(function.weights))
    n_s, n_r = answer.value.shape[1:]
    moved = reach[:, None, None]
    value_size, slope_size = np.abs(answer.value), moved * np.abs(answer.slope)
    weight_moved = moved * np.abs(weight_slope)
    total = (value_size + slope_size) @ weight_doubt + slope_size @ weight_moved
    total += answer.doubt @ (size + weight_moved + weight_doubt)
    rounded = value_size @ (size + weight_moved) + slope_size @ size + np.eye(n_s)
    total += PRODUCT_ROUNDINGS * (n_s + n_r + 2) * UNIT * rounded
    slope = -(answer.slope @ weight + answer.value @ weight_slope)
    return Matrices(np.eye(n_s) - answer.value @ weight, slope, total, weight, weight_doubt + weight_moved)


def characteristic_ball(function: Characteristic, points: Complexes, reach: Floats) -> Ball:
    """Return f at points, and how much it changes at most in discs about them.

    Parameters
    ----------
    function
        f.
    points, reach
        The discs (z,).
    """
    with np.errstate(all="ignore"):
        found = matrices_at(function, points, reach)
    return determinant_ball(found.value, found.slope, found.doubt, reach)


def count_around(
    function: Characteristic,
    centre: float | complex,
    radius: float,
    *,
    arcs: int,
    most: int | None = None,
) -> int | None:
    """Return zeros less poles of f within a circle, None if that can't be told.

    Parameters
    ----------
    function
        f.
    centre, radius, arcs, most
        As `winding.wind` has them.
    """
    return wind(
        lambda points, reach: characteristic_ball(function, points, reach),
        centre,
        radius,
        arcs=arcs,
        most=most,
    )


def refine(
    function: Characteristic,
    starts: Sequence[complex] | Complexes,
    *,
    poles: Complexes,
    found: Complexes | None = None,
) -> Complexes:
    """Return zeros of f by Newton's method from many starts; where it does not arrive, NaN.

    Parameters
    ----------
    function
        f.
    starts
        Where to begin (z,).
    poles
        Poles of f to take out (m,), with their conjugates: Newton's method on Π (ζ − p) f, which they no
        longer turn away.
    found
        Zeros that are known, taken out with their conjugates (Maehly), so that others are found.
    """
    points = np.array(starts, dtype=np.complex128)
    steps = np.full(len(points), np.inf)
    active = np.flatnonzero(np.isfinite(points))
    farthest = FARTHEST * float(np.abs(poles).max(initial=1.0))
    out, known = (_whole(np.zeros(0, np.complex128) if one is None else one) for one in (poles, found))
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            if not len(active):
                break
            now = points[active]
            rate = _log_rate(function, now)
            rate = rate + (1 / (now[:, None] - out)).sum(axis=1) - (1 / (now[:, None] - known)).sum(axis=1)
            step = -1 / rate
            longest = LONGEST * np.abs(now)
            step = np.where(np.abs(step) > longest, step / np.abs(step) * longest, step)
            moved = now + step
            size = np.abs(moved)
            lost = ~np.isfinite(size) | (size <= function.innermost) | (size > farthest)
            before, steps[active] = steps[active], np.abs(step) / size
            points[active] = np.where(lost, np.nan, moved)
            # Far below what is `NEAR`, steps that no longer shrink are rounding.
            arrived = (steps[active] <= ARRIVED) | (
                (steps[active] < NEAR**1.5) & (steps[active] > before / 2)
            )
            active = active[~lost & ~arrived]
        # Rounding may keep it from standing still; who has found a zero is told by the bounds.
        return np.where(steps < NEAR, points, np.nan)


def _whole(upper: Complexes) -> Complexes:
    """Return points of the upper half plane with their conjugates."""
    return np.concatenate([upper, upper[upper.imag != 0].conj()])


def _log_rate(function: Characteristic, points: Complexes) -> Complexes:
    """Return f′/f = tr((I − T W)⁻¹ (I − T W)′), infinite at a zero."""
    value, slope = differentiate(function.transfers, points)
    weight = weights_at(function, points)
    weight_slope = _weight_slopes(function, points)
    matrix = np.eye(value.shape[1]) - value @ weight
    change = -(slope @ weight + value @ weight_slope)
    sign, _ = np.linalg.slogdet(matrix)
    fine = np.abs(sign) > 0.5
    # A zero to the last digit is arrived at; on a pole nothing is known.
    rate = np.where(np.isfinite(matrix).all(axis=(1, 2)), complex(np.inf), complex(np.nan))
    rate[fine] = np.trace(np.linalg.solve(matrix[fine], change[fine]), axis1=1, axis2=2)
    return rate


def null_vectors(function: Characteristic, point: complex) -> tuple[Complexes, Complexes]:
    """Return s and χ with (I − T W) s ≈ 0 and χ (I − T W) ≈ 0, of norm 1, at a zero of f.

    s is what is sent in the mode, χ what weighs it.
    """
    at = np.array([point])
    value, weight = differentiate(function.transfers, at)[0][0], weights_at(function, at)[0]
    left, _, right = np.linalg.svd(np.eye(len(value)) - value @ weight)
    return right[-1].conj(), left[:, -1].conj()
