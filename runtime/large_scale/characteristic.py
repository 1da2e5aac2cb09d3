"""The characteristic function of a population: its size is independent of the number of peers and of delays.

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

from apc.eigen.winding_number import Ball, determinant_ball
from apc.frame.interval_arithmetic import MIDPOINT_RADIUS, Matrix
from apc.large_scale.transfer import Transfer, add_fractions, powers

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
    """f(ζ) = det(I − T W); `lags` (l,) and `weights` (l, n_r, n_s) are W's.

    `smooth` (3, terms + l, 2 n_s · n_r), with its radii, is what powers of 1/ζ, 0, 1, … and the lags, make of
    T's series and of W.
    """

    transfer: Transfer
    lags: Integers
    weights: Floats
    smooth: Matrix

    @property
    def innermost(self) -> float:
        """The least |ζ| at which it can be evaluated."""
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
    """Return T (z, 3, n_s, n_r) and W (z, 3, n_r, n_s) in discs, see `transfer`.

    Parameters
    ----------
    function
        f.
    points, reach
        The discs (z,).
    bounded
        Whether T's radii are asked for; without them it is as good as any.
    """
    shape = function.transfer.shape
    exponents = np.concatenate([np.arange(function.smooth.shape[1] - len(function.lags)), function.lags])
    values = MIDPOINT_RADIUS.multiply(powers(points, reach, exponents), function.smooth).swapaxes(0, 1)
    series, receiving = np.split(values.astype(np.complex128), 2, axis=-1)
    answer = series.reshape(len(points), 3, *shape)
    add_fractions(function.transfer, answer, points, reach, bounded=bounded)
    return answer, receiving.reshape(len(points), 3, *shape[::-1])


def matrices_in(
    function: Characteristic, points: Complexes, reach: Floats, *, bounded: bool = True
) -> Matrix:
    """Return I − T W in discs (z, 3, n_s, n_s), see `transfer`.

    Parameters
    ----------
    function
        f.
    points, reach, bounded
        As `parts_in` has them.
    """
    around = MIDPOINT_RADIUS.multiply(*parts_in(function, points, reach, bounded=bounded))
    unit = np.zeros(around.shape[1:])
    unit[0] = np.eye(len(unit[0]))
    return MIDPOINT_RADIUS.subtract(unit, around)


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
        matrix = matrices_in(function, points, reach)
    return determinant_ball(matrix[:, 0], matrix[:, 2], matrix[:, 1].real, np.ones(len(points)))


def refine(
    function: Characteristic,
    starts: Sequence[complex] | Complexes,
    *,
    poles: Complexes,
    zeros: Complexes | None = None,
) -> Complexes:
    """Return zeros of f by Newton's method from many starts; where it does not arrive, NaN.

    Parameters
    ----------
    function
        f.
    starts
        The start values (z,).
    poles
        Poles of f to take out (m,), with their conjugates: Newton's method on Π (ζ − p) f, which they no
        longer turn away.
    zeros
        Zeros that are known, taken out with their conjugates (Maehly), so that others are found.
    """
    points = np.array(starts, dtype=np.complex128)
    steps = np.full(len(points), np.inf)
    active = np.flatnonzero(np.isfinite(points))
    farthest = FARTHEST * float(np.abs(poles).max(initial=1.0))
    out, known = (
        _whole(np.zeros(0, np.complex128) if values is None else values) for values in (poles, zeros)
    )
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
        # Rounding may prevent exact convergence; a zero is confirmed by the bounds.
        return np.where(steps < NEAR, points, np.nan)


def _whole(upper: Complexes) -> Complexes:
    """Return points of the upper half plane with their conjugates."""
    return np.concatenate([upper, upper[upper.imag != 0].conj()])


def _log_rate(function: Characteristic, points: Complexes) -> Complexes:
    """Return f′/f = tr((I − T W)⁻¹ (I − T W)′), infinite at a zero."""
    result = matrices_in(function, points, np.full(len(points), POINT), bounded=False)
    matrix, change = result[:, 0], result[:, 2] / POINT
    sign, _ = np.linalg.slogdet(matrix)
    fine = np.abs(sign) > 0.5
    # A zero to the last digit is arrived at; on a pole nothing is known.
    rate = np.where(np.isfinite(matrix).all(axis=(1, 2)), complex(np.inf), complex(np.nan))
    rate[fine] = np.trace(np.linalg.solve(matrix[fine], change[fine]), axis1=1, axis2=2)
    return rate
