"""The characteristic function of a population, of a size independent of the number of peers and of delays.

Takes: the `Transfer` of all subsystems, and the feedback from sent to received values; discs and circles.
Gives: `Characteristic`, `characteristic_of`, `parts_in`, `matrices_in`, `characteristic_ball`, `refine`.
Guarantees: its value in a disc comes with a bound; an eigenvalue of the whole system is a zero of it, or a
pole of a subsystem that the zero would have to cancel. A count is correct; None is an undetermined count.
Does not: build subsystems (see `determinant`), or search zeros (see `zeros`).

    f(ζ) = det(I − T(ζ) W(ζ)),   W(ζ) = Σ_l W_l ζ^(−l)

The subsystems have the transfer s = T r, and receive values sent l frames ago, r = W s. f has a zero where
both hold with nonzero s, tends to 1 as ζ tends to infinity, and has the poles of the subsystems. The number
of zeros minus poles outside a circle is the negative winding number of f around 0 along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, Matrix
from apc.spectrum.transfer import Transfer, add_fractions, powers
from apc.spectrum.winding_number import Ball, determinant_ball

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]


# Newton steps, each at most this share of |ζ|; the relative step of convergence, and that at which rounding
# dominates. Zeros beyond this multiple of the largest pole are not searched.
STEPS, LONGEST, ARRIVED, NEAR, FARTHEST = 40, 0.1, 1e-15, 1e-6, 1e6

# The radius of a disc about a single point.
POINT = 1e-30


@dataclass(frozen=True, slots=True, eq=False)
class Characteristic:
    """The function f(ζ) = det(I − T W); `lags` (l,) and `weights` (l, n_r, n_s) are those of W.

    `smooth` (3, terms + l, 2 n_s · n_r), with its radii, are the coefficients of the powers of 1/ζ (0, 1, …
    and the lags) in T's series and in W.
    """

    transfer: Transfer
    lags: Integers
    weights: Floats
    smooth: Matrix

    @property
    def innermost(self) -> float:
        """The least |ζ| at which f can be evaluated."""
        return self.transfer.innermost

    @property
    def longest(self) -> int:
        """The longest delay, in frames."""
        return int(self.lags.max(initial=0))


def characteristic_of(
    transfer: Transfer, lags: Sequence[int], weights: Floats, errors: Floats
) -> Characteristic:
    """Return f of subsystems with coupling weights (l, n_r, n_s) and their error bounds."""
    terms, size = transfer.series.shape[1:]
    smooth = np.zeros((3, terms + len(lags), 2 * size))
    smooth[:2, :terms, :size] = transfer.series
    smooth[:2, terms:, size:] = np.stack([weights, errors]).reshape(2, len(lags), size)
    return Characteristic(transfer, np.array(lags, np.int64), weights, smooth)


def parts_in(
    function: Characteristic, points: Complexes, reach: Floats, *, bounded: bool = True
) -> tuple[Matrix, Matrix]:
    """Return T (z, 3, n_s, n_r) and W (z, 3, n_r, n_s) in discs: value, radius and slope (see `transfer`).

    Parameters
    ----------
    function
        f.
    points, reach
        The discs (z,).
    bounded
        Whether T's radii are computed; otherwise they are meaningless.
    """
    shape = function.transfer.shape
    exponents = np.concatenate([np.arange(function.smooth.shape[1] - len(function.lags)), function.lags])
    values = MIDPOINT_RADIUS.multiply(powers(points, reach, exponents), function.smooth).swapaxes(0, 1)
    series, receiving = np.split(values.astype(np.complex128), 2, axis=-1)
    transfer_values = series.reshape(len(points), 3, *shape)
    add_fractions(function.transfer, transfer_values, points, reach, bounded=bounded)
    return transfer_values, receiving.reshape(len(points), 3, *shape[::-1])


def matrices_in(
    function: Characteristic, points: Complexes, reach: Floats, *, bounded: bool = True
) -> Matrix:
    """Return I − T W in discs (z, 3, n_s, n_s): value, radius and slope (see `transfer`).

    Parameters
    ----------
    function
        f.
    points, reach, bounded
        As for `parts_in`.
    """
    loop_gain = MIDPOINT_RADIUS.multiply(*parts_in(function, points, reach, bounded=bounded))
    unit = np.zeros(loop_gain.shape[1:])
    unit[0] = np.eye(len(unit[0]))
    return MIDPOINT_RADIUS.subtract(unit, loop_gain)


def characteristic_ball(function: Characteristic, points: Complexes, reach: Floats) -> Ball:
    """Return f at the centres of discs, with a bound on its relative change within them.

    Parameters
    ----------
    function
        f.
    points, reach
        The discs (z,).
    """
    with np.errstate(all="ignore"):
        matrix = matrices_in(function, points, reach)
    return determinant_ball(matrix[:, 0], matrix[:, 2], matrix[:, 1].real, np.ones(len(points)))


def refine(
    function: Characteristic,
    starts: Sequence[complex] | Complexes,
    *,
    poles: Complexes,
    zeros: Complexes | None = None,
) -> Complexes:
    """Return zeros of f by Newton's method from many starts; NaN where it does not converge.

    Parameters
    ----------
    function
        f.
    starts
        The start values (z,).
    poles
        Poles p of f (m,), removed with their conjugates: Newton's method is applied to Π (ζ − p) f.
    zeros
        Known zeros, removed with their conjugates (Maehly), so that other zeros are found.
    """
    points = np.array(starts, dtype=np.complex128)
    steps = np.full(len(points), np.inf)
    active = np.flatnonzero(np.isfinite(points))
    farthest = FARTHEST * float(np.abs(poles).max(initial=1.0))
    removed_poles, removed_zeros = (
        _with_conjugates(np.zeros(0, np.complex128) if values is None else values)
        for values in (poles, zeros)
    )
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            if not len(active):
                break
            active_points = points[active]
            rate = _logarithmic_derivative(function, active_points)
            rate = (
                rate
                + (1 / (active_points[:, None] - removed_poles)).sum(axis=1)
                - (1 / (active_points[:, None] - removed_zeros)).sum(axis=1)
            )
            step = -1 / rate
            longest = LONGEST * np.abs(active_points)
            step = np.where(np.abs(step) > longest, step / np.abs(step) * longest, step)
            next_points = active_points + step
            size = np.abs(next_points)
            diverged = ~np.isfinite(size) | (size <= function.innermost) | (size > farthest)
            last_steps, steps[active] = steps[active], np.abs(step) / size
            points[active] = np.where(diverged, np.nan, next_points)
            # Far below `NEAR`, steps that no longer decrease are rounding.
            converged = (steps[active] <= ARRIVED) | (
                (steps[active] < NEAR**1.5) & (steps[active] > last_steps / 2)
            )
            active = active[~diverged & ~converged]
        # Rounding may prevent exact convergence; a zero is confirmed by the bounds.
        return np.where(steps < NEAR, points, np.nan)


def _with_conjugates(upper: Complexes) -> Complexes:
    """Return points of the upper half plane, followed by their conjugates."""
    return np.concatenate([upper, upper[upper.imag != 0].conj()])


def _logarithmic_derivative(function: Characteristic, points: Complexes) -> Complexes:
    """Return f′/f = tr((I − T W)⁻¹ (I − T W)′); infinite at a zero, NaN at a pole."""
    result = matrices_in(function, points, np.full(len(points), POINT), bounded=False)
    matrix, change = result[:, 0], result[:, 2] / POINT
    sign, _ = np.linalg.slogdet(matrix)
    regular = np.abs(sign) > 0.5
    # At a zero, up to rounding, the derivative is infinite; at a pole it is NaN.
    rate = np.where(np.isfinite(matrix).all(axis=(1, 2)), complex(np.inf), complex(np.nan))
    rate[regular] = np.trace(np.linalg.solve(matrix[regular], change[regular]), axis1=1, axis2=2)
    return rate
