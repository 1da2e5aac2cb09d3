"""The second-moment map of a frame under random channel noise: its spectral radius, enclosed and proved.

Takes: state matrices, noise input matrices, and the linear forms that generate the noise.
Gives: `MomentBlock`, `Operator`; `Enclosed`, `enclosed`, `dies_out`, `settled`; `stein`; `mean_of`,
`number_of`; `congruence`.
Guarantees: a radius between `low` and `high` for every operator within the radii of its matrices.
Does not: build the matrices (see `class_moments` and `self_substitution`).

The second moments X_b of block b and the noise covariances V_l satisfy

    X_b⁺ = M_b X_b M_bᵀ + Σ_l B_bl V_l B_blᵀ        V_l = S_l ∘ Σ_b Σ_k w_lk L_bk X_b L_bkᵀ        X⁺ = T(X)

with w ≥ 0 and S ⪰ 0, so that T maps the cone of X ⪰ 0 into itself. Let μ Y − T(Y) = Z ≻ 0. If Y ≻ 0, T has a
spectral radius below μ. If Y ⪰ 0 does not hold, the spectral radius is μ or more, as otherwise Y = Σ_k
T^k(Z)/μ^{k+1} would be a sum of matrices of the cone. Y is computed in floats for Z = I, in scaled
coordinates.

Let V grow by the factor μ per frame. The moments follow from Stein equations, and determine V again: V = G(μ)
V. G decreases with μ. The growth factor is therefore the μ > ρ(M)² at which the largest eigenvalue of G is 1,
or ρ(M)² if that eigenvalue is below 1 for all such μ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.kyp_bounds import is_positive
from apc.eigen.matrix_norms import balance
from apc.frame.interval_arithmetic import (
    FLOATS,
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Arithmetic,
    error_radius,
    spread_of,
    value_of,
    with_error_radius,
)
from apc.frame.taylor_models import arithmetic_of, corners, entrywise, over_as_many
from apc.threads import load_pool

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# The relative remainder of a sum by doubling: far below rounding.
LEFT = 1e-24

# Doublings until a sum counts as endless, 2^60 frames; or where what is doubled has grown to this.
DOUBLINGS, ENDLESS = 60, 1e100

# The gain is evaluated at this relative distance above the growth of the means, where it has its pole. The
# distance is multiplied by this factor until its largest eigenvalue is below 1. The last constant is the
# tolerance for no growth.
NEAR, WIDER, NOTHING = 1e-9, 4.0, 1e-9

# The relative accuracy of the radius.
CLOSE = 1e-13

# The initial relative distance of the enclosure of the radius, its growth factor, and its largest value.
FIRST_WIDTH, WIDER_BOUNDS, LAST_WIDTH = 2e-12, 2.0, 1e-3

# Fractions of the interval from 1 to the growth of the means at which a Y is tried for an entire cell.
SHARES = (0.7, 0.3, 0.05, 0.0)

# An upper bound on the relative error of eigenvalues of a symmetric matrix.
UNCERTAINTY = 1e-12

# Roundings of a weight: those of a probability, and of how many peers it counts for.
WEIGHT_ROUNDINGS = 18


@dataclass(frozen=True, slots=True, eq=False)
class MomentBlock:
    """A block of states with its noise: all matrices with their error radii, or over a cell.

    Attributes
    ----------
    matrix
        M (2, n, n).
    into
        B (e, 2, n, p) of the noise vectors `by` (e,) that enter.
    by
        The indices of these noise vectors.
    seen
        L (k, 2, p, n), the linear forms that generate the noise.
    shares
        w, one row per noise vector and k columns.
    at_once
        The contribution of the noise `by` to these forms in the same frame (k, e, 2, p, p); None for none.
    """

    matrix: Matrix
    into: Matrix
    by: tuple[int, ...]
    observed: Matrix
    shares: Floats
    at_once: Matrix | None = None


@dataclass(frozen=True, eq=False)
class Operator:
    """T: its blocks, and S, (2, p, p) per noise vector."""

    blocks: tuple[MomentBlock, ...]
    noise_covariance: Matrix

    @cached_property
    def floats(self) -> Operator:
        """The same in floats, without radii."""
        blocks = [
            MomentBlock(
                value_of(block.matrix),
                value_of(block.into),
                block.by,
                value_of(block.observed),
                block.shares,
                None if block.at_once is None else value_of(block.at_once),
            )
            for block in self.blocks
        ]
        return Operator(tuple(blocks), value_of(self.noise_covariance))

    @cached_property
    def scales(self) -> list[Floats]:
        """By which states (n,) of each block are of one size, powers of two."""
        result = []
        for block in self.blocks:
            size = np.abs(value_of(block.matrix)) + spread_of(block.matrix)
            if len(block.into) and len(block.observed):
                into, observed = np.abs(value_of(block.into)), np.abs(value_of(block.observed))
                size = size + into.sum(axis=0) @ observed.max(axis=0)
            result.append(balance(size))
        return result

    @property
    def balanced(self) -> Operator:
        """The same over states of one size."""
        blocks = [
            replace(
                block,
                matrix=block.matrix / scale[:, None] * scale,
                into=block.into / scale[:, None],
                observed=block.observed * scale,
            )
            for block, scale in zip(self.blocks, self.scales, strict=True)
        ]
        return Operator(tuple(blocks), self.noise_covariance)

    @property
    def sizes(self) -> list[int]:
        """The number of states of each block."""
        return [block.matrix.shape[-1] for block in self.blocks]

    def followed(self, moments: Sequence[Matrix | None], input_slots: Matrix, numbers: Arithmetic) -> Matrix:
        """Return the part of V generated by moments, and by noise of the same frame; shape as V.

        In floats, for stacks of moments (…, n, n) and of V.
        """
        result = input_slots * 0.0
        for block, moment in zip(self.blocks, moments, strict=True):
            if moment is None or not len(block.observed):
                continue
            formed = congruence(block.observed, _each(moment, numbers), numbers)
            for e, noise in enumerate(block.by if block.at_once is not None else ()):
                assert block.at_once is not None
                at_once = congruence(
                    block.at_once[:, e], _each(_single(input_slots, noise, numbers), numbers), numbers
                )
                formed = numbers.add(formed, at_once)
            result = numbers.add(result, _weighted(block.shares, formed, numbers))
        return (
            np.multiply(result, self.noise_covariance)
            if numbers is FLOATS
            else entrywise(result, self.noise_covariance)
        )

    def driven(self, noise: Matrix, numbers: Arithmetic) -> list[Matrix]:
        """Return the contribution of the noise covariances V to each block (2, n, n)."""
        result = []
        for block in self.blocks:
            added = numbers.exact(np.zeros(block.matrix.shape[-2:]))
            for into, number in zip(block.into, block.by, strict=True):
                added = numbers.add(added, congruence(into, _single(noise, number, numbers), numbers))
            result.append(added)
        return result

    def moved(self, moments: Sequence[Matrix], numbers: Arithmetic) -> list[Matrix]:
        """Return moments (2, n, n) of each block a frame later."""
        noise = self.followed(moments, self.noise_covariance * 0.0, numbers)
        for _ in self.noise_covariance if any(block.at_once is not None for block in self.blocks) else ():
            noise = self.followed(moments, noise, numbers)
        pairs = zip(self.blocks, moments, strict=True)
        after = [congruence(block.matrix, moment, numbers) for block, moment in pairs]
        return list(map(numbers.add, after, self.driven(noise, numbers)))

    @cached_property
    def means(self) -> float:
        """The growth factor of squared means, in floats."""
        loops = [value_of(block.matrix) for block in self.blocks]
        return max(float(np.abs(np.linalg.eigvals(loop)).max(initial=0.0)) ** 2 for loop in loops)

    def solution(self, added: Sequence[Floats], growth: float) -> list[Floats] | None:
        """Return the X of μ X − T(X) = W in floats, None if the means grow by μ or more.

        The steps are: moments from W without noise, the noise generated by them and itself, and X.
        """
        of = self.floats
        alone = [stein(block.matrix, item, growth) for block, item in zip(of.blocks, added, strict=True)]
        gain = self.gain(growth)
        if gain is None or any(item is None for item in alone):
            return None
        nothing, upper = np.zeros(of.noise_covariance.shape), np.triu_indices(of.noise_covariance.shape[-1])
        first = of.followed(alone, nothing, FLOATS)[..., *upper]
        noise = np.zeros(of.noise_covariance.shape)
        try:
            noise[..., *upper] = np.linalg.solve(np.eye(len(gain)) - gain, first.ravel()).reshape(first.shape)
        except np.linalg.LinAlgError:
            return None
        noise += np.swapaxes(np.triu(noise, 1), -1, -2)
        result = [
            stein(block.matrix, item + more, growth)
            for block, item, more in zip(of.blocks, added, of.driven(noise, FLOATS), strict=True)
        ]
        return [item for item in result if item is not None]

    def gain(self, growth: float) -> Floats | None:
        """Return the gain matrix from noise of growth μ to generated noise, entry by entry, in floats."""
        of, columns = self.floats, list[Floats]()
        count, p = of.noise_covariance.shape[0], of.noise_covariance.shape[-1]
        rows, indices = np.triu_indices(p)
        units = np.zeros((len(rows), p, p))
        units[np.arange(len(rows)), rows, indices] = units[np.arange(len(rows)), indices, rows] = 1.0
        for noise in range(count):
            input_slots = np.zeros((len(rows), count, p, p))
            input_slots[:, noise] = units
            moments = list[Floats | None]()
            for block in of.blocks:
                item = None
                if noise in block.by:
                    driven = congruence(block.into[block.by.index(noise)], units, FLOATS)
                    if (item := stein(block.matrix, driven, growth)) is None:
                        return None
                moments.append(item)
            columns.append(
                of.followed(moments, input_slots, FLOATS)[..., rows, indices].reshape(len(rows), -1)
            )
        return np.concatenate(columns).T if columns else np.zeros((0, 0))


@dataclass(frozen=True, slots=True)
class Enclosed:
    """The spectral radius of second moments a frame, and bounds on it; infinite where there is none."""

    radius: float
    low: float
    high: float


def enclosed(of: Operator, *, bounded: bool = True) -> Enclosed:
    """Enclose the growth factor of second moments per frame, for all start states.

    Parameters
    ----------
    of
        Their dynamics.
    bounded
        Whether bounds are asked for; without them, they are the radius itself.
    """
    of = of.balanced
    if not np.isfinite(of.means):
        return Enclosed(np.nan, 0.0, np.inf)
    root = _root(of)
    radius = max(of.means, root or 0.0)
    if not bounded:
        return Enclosed(radius, radius, radius)
    low, high, width = None, None, FIRST_WIDTH
    if root is None:  # noise does not increase the growth of the means
        loops = (
            enclose_eigenvalues(value_of(block.matrix), error_radius(block.matrix))[1] for block in of.blocks
        )
        low = max(loop.low for loop in loops) ** 2 * (1 - 2 * UNIT_ROUNDOFF)
    while width <= LAST_WIDTH and (low is None or high is None):
        if high is None and _is_below(of, above := max(radius, NOTHING) * (1 + width)):
            high = above
        if low is None and _is_below(of, below := radius * (1 - width)) is False:
            low = below
        width *= WIDER_BOUNDS
    return Enclosed(radius, low or 0.0, np.inf if high is None else high)


def _root(of: Operator) -> float | None:
    """Return the μ above the growth factor of means where the gain's largest eigenvalue is 1, or None.

    The root is that of 1/ρ − 1, which is nearly straight from −1 at the means' own growth, where the gain has
    its pole.
    """
    least = max(of.means, NOTHING)

    def over(growth: float) -> float:
        gain = of.gain(growth)
        if gain is None or not np.isfinite(gain).all():
            return -1.0
        return 1 / max(float(np.abs(np.linalg.eigvals(gain)).max(initial=0.0)), NOTHING) - 1

    low, gap = least * (1 + NEAR), max(1 - least, 0.1 * least)
    if over(low) > 0:
        return None
    while over(high := least + gap) < 0:
        low, gap = high, WIDER * gap
    return float(load_pool("scipy.optimize").brentq(over, low, high, xtol=1e-300, rtol=CLOSE))


def _is_below(of: Operator, growth: float) -> bool | None:
    """Return True if the spectral radius is proved to be below μ, False if proved not to be."""
    moments = of.solution([np.eye(n) for n in of.sizes], growth)
    if moments is None:
        return None
    exact = [MIDPOINT_RADIUS.exact(moment) for moment in moments]
    for moment, after in zip(exact, of.moved(exact, MIDPOINT_RADIUS), strict=True):
        if not is_positive(MIDPOINT_RADIUS.subtract(entrywise(moment, number_of(growth)), after)):
            return None
    if all(map(is_positive, exact)):
        return True
    least = [np.linalg.eigvalsh(moment) / np.abs(moment).max(initial=0.0) / len(moment) for moment in moments]
    return False if any(values.size and values[0] < -UNCERTAINTY for values in least) else None


def dies_out(of: Operator) -> tuple[bool, bool]:
    """Return whether decay of moments is proved, for all matrices within their radii or a cell.

    The second value is whether they decay at the center, in floats.
    """
    of, inside = of.balanced, False
    if not of.means < 1:
        return False, False
    numbers = arithmetic_of(of.blocks[0].matrix)
    for share in SHARES:
        moments = of.solution([np.eye(n) for n in of.sizes], 1 - share * (1 - of.means))
        if moments is None or not all(is_positive(MIDPOINT_RADIUS.exact(moment)) for moment in moments):
            continue
        inside = True
        exact = [numbers.exact(moment) for moment in moments]
        left = map(numbers.subtract, exact, of.moved(exact, numbers))
        if all(is_positive(corner) for matrix in left for corner in corners(matrix)):
            return True, True
    return False, inside


def settled(of: Operator, added: Sequence[Floats]) -> list[Floats]:
    """Return the stationary moments for an input added to each block at the start of a frame (n, n)."""
    scales, of = of.scales, of.balanced
    start = [moment / np.outer(d, d) for moment, d in zip(added, scales, strict=True)]
    result = of.solution(start, 1.0)
    assert result is not None, "means grow, and second moments were to die out"
    return [moment * np.outer(d, d) for moment, d in zip(result, scales, strict=True)]


def stein(matrix: Floats, driven: Floats, growth: float = 1.0) -> Floats | None:
    """Return the X of μ X − M X Mᵀ = B, of M (n, n) and symmetric B (…, n, n); None if M grows faster.

    Notes
    -----
    X = Σ_k M^k B M^kᵀ/μ^{k+1}, doubled (Smith, 1968): of 2j terms, the second half is M^j times the first.
    """
    total, power = driven / growth, matrix / growth**0.5
    for _ in range(DOUBLINGS):
        total = total + power @ total @ power.T
        power = power @ power
        size = float(np.abs(power).sum(axis=-1).max(initial=0.0))
        if not size < ENDLESS:
            return None
        if size**2 < LEFT:
            return np.asarray(total)
    return None


def congruence(left: Matrix, inner: Matrix, numbers: Arithmetic) -> Matrix:
    """Return L X Lᵀ."""
    return numbers.multiply(numbers.multiply(left, inner), np.swapaxes(left, -1, -2))


def _each(matrix: Matrix, numbers: Arithmetic) -> Matrix:
    """Return a matrix, or many, to be multiplied by each of several."""
    return np.expand_dims(matrix, -3 if numbers is FLOATS else -4)


def _single(matrices: Matrix, index: int, numbers: Arithmetic) -> Matrix:
    """Return one of several matrices."""
    return np.asarray(np.take(matrices, index, axis=-3 if numbers is FLOATS else -4))


def _weighted(weights: Floats, blocks: Matrix, numbers: Arithmetic) -> Matrix:
    """Return Σ_k w_lk X_k (l, …) of matrices X (k, …), the weights w (l, k) rounded."""
    turned, rows = blocks if numbers is FLOATS else np.moveaxis(blocks, -4, -3), weights
    *many, count, n, m = turned.shape
    flat = turned.reshape(*many, count, n * m)
    if numbers is not FLOATS:
        rows = over_as_many(
            with_error_radius(weights, WEIGHT_ROUNDINGS * UNIT_ROUNDOFF * np.abs(weights)), flat
        )
    result = numbers.multiply(rows, flat).reshape(*many, len(weights), n, m)
    return np.asarray(result if numbers is FLOATS else np.moveaxis(result, -3, -4))


def mean_of(weights: Floats, blocks: Matrix) -> Matrix:
    """Return Σ_k w_k X_k of matrices X (k, 2, n, m), the weights w (k,) rounded."""
    return np.asarray(_weighted(weights[None], blocks, MIDPOINT_RADIUS)[0])


def number_of(value: float) -> Matrix:
    """Return a number that was rounded a few times, with its radius, to scale by."""
    return np.array([value, 4 * UNIT_ROUNDOFF * abs(value)]).reshape(2, 1, 1)
