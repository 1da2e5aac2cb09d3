"""The characteristic function of a population: small, whatever the number of peers and the length of delays.

Takes: the `Transfer`s of all sites, and how what they send comes back to them; circles.
Gives: `Characteristic`, `characteristic_ball`, `refine`, `null_vectors`, `weights_at`; `Ball`, `Bounded`,
`wind`, `count_around`.
Guarantees: its value in a disc comes with a bound; an eigenvalue of the whole system is a zero of it, or a
pole of a site that the zero would have to cancel. A count is right: no zero is missed between samples; None
says that no cover was found, as when a zero lies on the circle.
Does not: know who the sites are (see `determinant`), or where zeros may be (see `zeros`).

    f(ζ) = det(I − T(ζ) W(ζ)),   W(ζ) = Σ_l W_l ζ^(−l)

The sites answer what they hear, s = T r, and hear what was sent l frames ago, r = W s. f has a zero where
that holds without any cause, goes to 1 as ζ goes to infinity, and has the sites' poles: all zeros less all
poles of the sites outside of a circle are the negative of how often f goes around 0 along it.

How often that is, a cover of discs tells (`wind`). Each arc of the circle lies in a disc about its middle,
and within the disc the function differs from its value at the middle, f₀, by less than |f₀|: it has no zero
there, and its argument keeps within ±π/2 of that of f₀. Neighbouring arcs share a point, so their middles'
arguments differ by less than π: the sum of these differences is the change of the argument along the circle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.pseudospectrum import PRODUCT_ROUNDINGS
from apc.frame.discretize import UNIT
from apc.large.transfer import Transfer, differentiate, respond

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Ball:
    """A function at points: `direction` f₀/|f₀| (z,) and `change` (z,), a bound on |f/f₀ − 1| in discs."""

    direction: Complexes
    change: Floats


# A function of points (z,) and the radii of discs about them (z,).
Bounded = Callable[[Complexes, Floats], Ball]

# Arcs to begin with, all around.
FIRST_ARCS = 32

# Evaluations after which a cover is given up, beside those an arc: where rounding leaves f open along a
# stretch of the circle, cutting the arcs there would never end. Zeros however near to the circle cost some
# hundred.
MOST_POINTS, POINTS_AN_ARC = 3000, 4

# Arcs beside a zero grow by this factor from one to the next: each keeps clear of the zero by its own length.
GRADING = 2.4

# An arc narrower than this many radians has a zero as good as on it: given up.
NARROWEST = 1e-14


def _graded(edges: Floats, close: Complexes) -> Floats:
    """Add edges about the angles of points near the unit circle, as dense as the points are near."""
    whole = [edges]
    for angle, size in zip(np.angle(close).tolist(), np.abs(close).tolist(), strict=True):
        first, widest = max(abs(size - 1), NARROWEST * GRADING) / 2, float(edges[1])
        steps = max(0, int(np.log(widest / first) / np.log(GRADING)) + 1)
        aside = first * GRADING ** np.arange(steps)
        whole.append(angle % (2 * np.pi) + np.concatenate([-aside, aside]))
    found = np.unique(np.concatenate(whole))
    return np.asarray(found[(found >= edges[0]) & (found <= edges[-1])])


def wind(
    function: Bounded,
    centre: float | complex,
    radius: float,
    *,
    arcs: int = FIRST_ARCS,
    most: int | None = None,
    close: Complexes | None = None,
) -> int | None:
    """Return how often a function goes around 0 along a circle, counter-clockwise; None if it can't be told.

    Parameters
    ----------
    function
        Bounded in discs. It is real on the real axis: about a real centre, half the circle tells all.
    centre, radius
        The circle.
    arcs
        How many arcs to begin with.
    most
        Evaluations after which to give up, or as many as serve.
    close
        Zeros (z,) that the circle passes closely: there arcs begin as short as they have to be.
    """
    half = not complex(centre).imag
    most = MOST_POINTS + POINTS_AN_ARC * arcs if most is None else most
    edges = np.linspace(0.0, np.pi if half else 2 * np.pi, (arcs // 2 if half else arcs) + 1)
    if close is not None and len(close):
        edges = _graded(edges, (close - centre) / radius)
    starts, ends = edges[:-1], edges[1:]
    settled: list[tuple[Floats, Complexes]] = []
    spent = 0
    while len(starts):
        spent += len(starts)
        if spent > most:
            return None
        middles = (starts + ends) / 2
        # The far end of an arc is a chord away from its middle; the point itself is rounded.
        reach = radius * (2 * np.sin((ends - starts) / 4) + 1e-15) + 4e-16 * abs(centre)
        ball = function(centre + radius * np.exp(1j * middles), reach)
        good = ball.change < 1
        settled.append((middles[good], ball.direction[good]))
        left, right = starts[~good], ends[~good]
        if np.any(right - left < NARROWEST):
            return None
        cut = (left + right) / 2
        starts, ends = np.concatenate([left, cut]), np.concatenate([cut, right])
    order = np.argsort(np.concatenate([angles for angles, _ in settled]))
    direction = np.concatenate([values for _, values in settled])[order]
    turned = float(np.angle(direction[1:] / direction[:-1]).sum())
    if half:  # the other half mirrors it; where they meet, the function is real
        turned = 2 * turned + float(np.angle(direction[0] ** 2)) + float(np.angle(direction[-1].conj() ** 2))
    else:
        turned += float(np.angle(direction[0] / direction[-1]))
    return round(turned / (2 * np.pi))


# Steps of the power method for a scaling, and the least ratio of its entries.
POWER_STEPS, FLOOR, TINY = 4, 1e-12, 1e-300

# Steps of Newton's method, none longer than this share of |ζ|; the relative step at which it has arrived, and
# that from which on rounding alone moves it. Nobody looks for a zero so many times beyond the largest pole.
STEPS, LONGEST, ARRIVED, NEAR, FARTHEST = 40, 0.1, 1e-15, 1e-6, 1e6


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class _Matrices:
    """I − T W at ζ + h: `value` + h · `slope`, but for what `doubt` bounds in the disc (z, n, n)."""

    value: Complexes
    slope: Complexes
    doubt: Floats


def _weight_slopes(function: Characteristic, points: Complexes) -> Complexes:
    """Return dW/dζ (z, n_r, n_s)."""
    lags = np.array(function.lags)
    return np.asarray(np.einsum("zl,lrs->zrs", -lags * points[:, None] ** (-lags - 1), function.weights))


def _bounded(function: Characteristic, points: Complexes, reach: Floats) -> _Matrices:
    """Return I − T W at the centres of discs, its slope there, and a bound on the rest in each."""
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
    return _Matrices(np.eye(n_s) - answer.value @ weight, slope, total)


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
        found = _bounded(function, points, reach)
    return determinant_ball(found.value, found.slope, found.doubt, reach)


def determinant_ball(matrix: Complexes, slope: Complexes, doubt: Floats, reach: Floats) -> Ball:
    """Return a determinant at the centres of discs, and how much it changes at most within them.

    Parameters
    ----------
    matrix, slope, doubt
        A and A₁ (z, n, n), and a bound V on what A + h A₁ differs by from the matrix anywhere in the disc.
    reach
        The discs' radii (z,).

    Notes
    -----
    With A + h A₁ + E in the disc, |E| ≤ V entry by entry, and F the Frobenius norm of
    D⁻¹ (ρ |A⁻¹ A₁| + |A⁻¹| V) D, for any scaling D > 0, det(A + h A₁ + E)/det A = Π (1 + λ_i) with
    Σ |λ_i|² ≤ F² (Schur), so it differs from 1 by at most (1 + F/√n)^n − 1.
    """
    with np.errstate(all="ignore"):
        n = matrix.shape[-1]
        fine = np.asarray(np.isfinite(doubt).all(axis=(1, 2)) & np.isfinite(matrix).all(axis=(1, 2)))
        matrix = np.where(fine[:, None, None], matrix, np.eye(n))
        sign, logarithm = np.linalg.slogdet(matrix)
        fine &= np.isfinite(logarithm)
        matrix = np.where(fine[:, None, None], matrix, np.eye(n))
        inverse, size, wrong = _inverse(matrix)
        fine &= wrong < 0.5
        doubt, slope = (np.where(fine[:, None, None], part, 0.0) for part in (doubt, slope))
        doubt += PRODUCT_ROUNDINGS * (n + 2) * UNIT * reach[:, None, None] * np.abs(slope)
        turned = np.abs(inverse @ slope)
        turned += 2 * wrong[:, None, None] * turned.max(axis=1, keepdims=True, initial=0.0)
        share = _scaled_norm(reach[:, None, None] * turned + size @ doubt)
        change = np.where(fine, np.expm1(n * np.log1p(share / np.sqrt(max(n, 1)))) * (1 + 1e-9), np.inf)
    return Ball(sign, change)


def _inverse(matrix: Complexes) -> tuple[Complexes, Floats, Floats]:
    """Return Y ≈ A⁻¹ and a bound on |A⁻¹| (z, n, n), good while F = I − Y A has ‖F‖ (z,) < 1/2.

    A⁻¹ = (I − F)⁻¹ Y, and |(I − F)⁻¹| is at most I + 2‖F‖ in every entry.
    """
    n = matrix.shape[-1]
    inverse = np.linalg.inv(matrix)
    size = np.abs(inverse)
    off = np.abs(np.eye(n) - inverse @ matrix)
    off += PRODUCT_ROUNDINGS * (n + 2) * UNIT * (size @ np.abs(matrix))
    wrong = off.sum(axis=2).max(axis=1, initial=0.0)
    largest = size.max(axis=1, keepdims=True, initial=0.0)
    return inverse.astype(np.complex128), size + 2 * wrong[:, None, None] * largest, np.asarray(wrong)


def _scaled_norm(matrices: Floats) -> Floats:
    """Return Frobenius norms of matrices without negative entries (z, n, n), scaled to be small.

    Between the vectors of Perron of either side a matrix of rank one is symmetric; a few steps of the power
    method come near them, and any scaling will do.
    """
    right, left = np.ones(matrices.shape[:2]), np.ones(matrices.shape[:2])
    for _ in range(POWER_STEPS):
        right = (matrices @ right[..., None])[..., 0]
        left = (left[:, None, :] @ matrices)[:, 0]
        right = np.maximum(right / np.maximum(right.max(axis=1, keepdims=True, initial=0.0), TINY), FLOOR)
        left = np.maximum(left / np.maximum(left.max(axis=1, keepdims=True, initial=0.0), TINY), FLOOR)
    scale = np.sqrt(right / left)
    scaled = matrices / scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.norm(scaled, axis=(1, 2)))


def count_around(
    function: Characteristic,
    centre: float | complex,
    radius: float,
    *,
    arcs: int,
    most: int | None = None,
    close: Complexes | None = None,
) -> int | None:
    """Return zeros less poles of f within a circle, None if that can't be told.

    Parameters
    ----------
    function
        f.
    centre, radius, arcs, most, close
        As `counting.wind` has them.
    """
    return wind(
        lambda points, reach: characteristic_ball(function, points, reach),
        centre,
        radius,
        arcs=arcs,
        most=most,
        close=close,
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
