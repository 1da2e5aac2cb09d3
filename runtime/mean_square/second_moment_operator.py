"""The second-moment map of a frame under random channel noise, with proved bounds of its spectral radius.

Takes: state matrices, noise input matrices, and the linear forms that generate the noise.
Gives: `MomentBlock`, `Operator`; `GrowthBounds`, `enclose_growth`, `growth_near_one`, `growth_with_slope`,
`proves_decay`, `stationary_moments`; `stein`; `weighted_sum`, `rounded_number`; `congruence`.
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

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import (
    FLOATS,
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Arithmetic,
    error_radius,
    spread_of,
    value_of,
    with_error_radius,
)
from apc.lifting.taylor_models import arithmetic_of, corners, entrywise, over_as_many
from apc.spectrum.eigenpairs import largest_magnitudes
from apc.spectrum.enclosure import enclose_eigenvalues
from apc.spectrum.kyp_bounds import is_positive
from apc.spectrum.matrix_norms import balance

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# The relative remainder of a sum by doubling: far below rounding.
LEFT = 1e-24

# Doublings after which a sum counts as divergent, 2^60 frames, and the size of a power that does.
DOUBLINGS, ENDLESS = 60, 1e100

# The gain is evaluated at this relative distance above the growth of the means, where it has its pole. The
# distance is multiplied by this factor until its largest eigenvalue is below 1. The last constant is the
# tolerance for no growth.
NEAR, WIDER, NOTHING = 1e-9, 4.0, 1e-9

# The inverse of the gain where it has no bound; the limits of the steps to its root, in number, far above
# those needed, and in length.
TINY, MOST_STEPS, FARTHEST = 1e-300, 100, 40.0

# The relative step of central differences: their truncation is below 1e-7, their rounding below 1e-8.
DIFFERENCE = 1e-4

# The relative accuracy of the radius.
CLOSE = 1e-13

# The initial relative distance of the enclosure of the radius, its growth factor, and its largest value.
FIRST_WIDTH, WIDER_BOUNDS, LAST_WIDTH = 2e-12, 2.0, 1e-3

# Fractions of the interval from 1 to the growth of the means at which a Y is tried for an entire cell.
SHARES = (0.7, 0.3, 0.05, 0.0)

# An upper bound on the relative error of eigenvalues of a symmetric matrix.
UNCERTAINTY = 1e-12

# Roundings of a weight: those of a probability, and of the number of peers that it is multiplied by.
WEIGHT_ROUNDINGS = 18


@dataclass(frozen=True, slots=True, eq=False)
class MomentBlock:
    """A block of states with its noise: all matrices with their error radii, or over a cell.

    Attributes
    ----------
    matrix
        M (2, n, n).
    noise_inputs
        B (e, 2, n, p), the input matrices of the noise vectors that drive the block.
    noises
        The indices (e,) of these noise vectors.
    noise_forms
        L (k, 2, p, n), the linear forms that generate the noise.
    shares
        w, one row per noise vector and k columns.
    same_frame
        The contribution of `noises` to these forms in the same frame (k, e, 2, p, p); None without any.
    """

    matrix: Matrix
    noise_inputs: Matrix
    noises: tuple[int, ...]
    noise_forms: Matrix
    shares: Floats
    same_frame: Matrix | None = None


@dataclass(frozen=True, eq=False)
class Operator:
    """The map T: its blocks, and the noise covariances S, (2, p, p) per noise vector."""

    blocks: tuple[MomentBlock, ...]
    noise_covariance: Matrix

    @cached_property
    def floats(self) -> Operator:
        """The operator in floats, without radii."""
        blocks = [
            MomentBlock(
                value_of(block.matrix),
                value_of(block.noise_inputs),
                block.noises,
                value_of(block.noise_forms),
                block.shares,
                None if block.same_frame is None else value_of(block.same_frame),
            )
            for block in self.blocks
        ]
        return Operator(tuple(blocks), value_of(self.noise_covariance))

    @cached_property
    def scales(self) -> list[Floats]:
        """The scaling of each block's states (n,), powers of two, that balances its matrices."""
        result = []
        for block in self.blocks:
            size = np.abs(value_of(block.matrix)) + spread_of(block.matrix)
            if len(block.noise_inputs) and len(block.noise_forms):
                noise_inputs, noise_forms = (
                    np.abs(value_of(block.noise_inputs)),
                    np.abs(value_of(block.noise_forms)),
                )
                size = size + noise_inputs.sum(axis=0) @ noise_forms.max(axis=0)
            result.append(balance(size))
        return result

    @property
    def balanced(self) -> Operator:
        """The operator over states scaled by `scales`."""
        blocks = [
            replace(
                block,
                matrix=block.matrix / scale[:, None] * scale,
                noise_inputs=block.noise_inputs / scale[:, None],
                noise_forms=block.noise_forms * scale,
            )
            for block, scale in zip(self.blocks, self.scales, strict=True)
        ]
        return Operator(tuple(blocks), self.noise_covariance)

    @property
    def sizes(self) -> list[int]:
        """The number of states of each block."""
        return [block.matrix.shape[-1] for block in self.blocks]

    def generated_noise(
        self, moments: Sequence[Matrix | None], noise_now: Matrix, numbers: Arithmetic
    ) -> Matrix:
        """Return the covariances V generated by the moments, and by noise of the same frame; shape as V.

        In floats, for stacks of moments (…, n, n) and of V.
        """
        result = noise_now * 0.0
        for block, moment in zip(self.blocks, moments, strict=True):
            if moment is None or not len(block.noise_forms):
                continue
            forms = congruence(block.noise_forms, _with_batch_axis(moment, numbers), numbers)
            for e, noise_index in enumerate(block.noises if block.same_frame is not None else ()):
                assert block.same_frame is not None
                direct = congruence(
                    block.same_frame[:, e],
                    _with_batch_axis(_matrix_at(noise_now, noise_index, numbers), numbers),
                    numbers,
                )
                forms = numbers.add(forms, direct)
            result = numbers.add(result, _weighted(block.shares, forms, numbers))
        return (
            np.multiply(result, self.noise_covariance)
            if numbers is FLOATS
            else entrywise(result, self.noise_covariance)
        )

    def driven_moments(self, noise: Matrix, numbers: Arithmetic) -> list[Matrix]:
        """Return the contribution of the noise covariances V to the moments of each block (2, n, n)."""
        result = []
        for block in self.blocks:
            total = numbers.exact(np.zeros(block.matrix.shape[-2:]))
            for noise_input, number in zip(block.noise_inputs, block.noises, strict=True):
                total = numbers.add(
                    total, congruence(noise_input, _matrix_at(noise, number, numbers), numbers)
                )
            result.append(total)
        return result

    def next_moments(self, moments: Sequence[Matrix], numbers: Arithmetic) -> list[Matrix]:
        """Return the moments (2, n, n) of each block one frame later."""
        noise = self.generated_noise(moments, self.noise_covariance * 0.0, numbers)
        for _ in self.noise_covariance if any(block.same_frame is not None for block in self.blocks) else ():
            noise = self.generated_noise(moments, noise, numbers)
        pairs = zip(self.blocks, moments, strict=True)
        after = [congruence(block.matrix, moment, numbers) for block, moment in pairs]
        return list(map(numbers.add, after, self.driven_moments(noise, numbers)))

    @cached_property
    def means(self) -> float:
        """The growth factor of squared means per frame, in floats."""
        loops = [value_of(block.matrix) for block in self.blocks]
        return max(float(largest_magnitudes(loop)) ** 2 for loop in loops)

    def solution(self, inputs: Sequence[Floats], growth: float) -> list[Floats] | None:
        """Return the X of μ X − T(X) = W in floats; None if the means grow by μ or more per frame.

        The steps are: moments from W without noise, the noise generated by these moments and by itself, and
        X.
        """
        operator = self.floats
        without_noise = [
            stein(block.matrix, item, growth) for block, item in zip(operator.blocks, inputs, strict=True)
        ]
        gain = self.gain(growth)
        if gain is None or any(item is None for item in without_noise):
            return None
        no_noise, upper = (
            np.zeros(operator.noise_covariance.shape),
            np.triu_indices(operator.noise_covariance.shape[-1]),
        )
        direct_noise = operator.generated_noise(without_noise, no_noise, FLOATS)[..., *upper]
        noise = np.zeros(operator.noise_covariance.shape)
        try:
            noise[..., *upper] = np.linalg.solve(np.eye(len(gain)) - gain, direct_noise.ravel()).reshape(
                direct_noise.shape
            )
        except np.linalg.LinAlgError:
            return None
        noise += np.swapaxes(np.triu(noise, 1), -1, -2)
        result = [
            stein(block.matrix, item + noise_part, growth)
            for block, item, noise_part in zip(
                operator.blocks, inputs, operator.driven_moments(noise, FLOATS), strict=True
            )
        ]
        return [item for item in result if item is not None]

    def gain(self, growth: float) -> Floats | None:
        """Return the gain matrix from noise that grows by μ per frame to generated noise, entry by entry, in
        floats.
        """
        operator, columns = self.floats, list[Floats]()
        count, p = operator.noise_covariance.shape[0], operator.noise_covariance.shape[-1]
        rows, indices = np.triu_indices(p)
        units = np.zeros((len(rows), p, p))
        units[np.arange(len(rows)), rows, indices] = units[np.arange(len(rows)), indices, rows] = 1.0
        for noise in range(count):
            noise_now = np.zeros((len(rows), count, p, p))
            noise_now[:, noise] = units
            moments = list[Floats | None]()
            for block in operator.blocks:
                moment = None
                if noise in block.noises:
                    source = congruence(block.noise_inputs[block.noises.index(noise)], units, FLOATS)
                    if (moment := stein(block.matrix, source, growth)) is None:
                        return None
                moments.append(moment)
            columns.append(
                operator.generated_noise(moments, noise_now, FLOATS)[..., rows, indices].reshape(
                    len(rows), -1
                )
            )
        return np.concatenate(columns).T if columns else np.zeros((0, 0))


@dataclass(frozen=True, slots=True)
class GrowthBounds:
    """The growth factor of second moments per frame, and bounds on it; `high` is infinite without a bound."""

    radius: float
    low: float
    high: float


def enclose_growth(operator: Operator, *, bounded: bool = True) -> GrowthBounds:
    """Return the growth factor of second moments per frame for all start states, with bounds.

    Parameters
    ----------
    operator
        The second-moment map.
    bounded
        Whether bounds are computed; otherwise both are the radius itself.
    """
    operator = operator.balanced
    if not np.isfinite(operator.means):
        return GrowthBounds(np.nan, 0.0, np.inf)
    root = _growth_by_noise(operator)
    radius = max(operator.means, root or 0.0)
    if not bounded:
        return GrowthBounds(radius, radius, radius)
    low, high, width = None, None, FIRST_WIDTH
    if root is None:  # noise does not increase the growth of the means
        loops = (
            enclose_eigenvalues(value_of(block.matrix), error_radius(block.matrix))[1]
            for block in operator.blocks
        )
        low = max(loop.low for loop in loops) ** 2 * (1 - 2 * UNIT_ROUNDOFF)
    while width <= LAST_WIDTH and (low is None or high is None):
        if high is None and _is_below(operator, upper := max(radius, NOTHING) * (1 + width)):
            high = upper
        if low is None and _is_below(operator, lower := radius * (1 - width)) is False:
            low = lower
        width *= WIDER_BOUNDS
    return GrowthBounds(radius, low or 0.0, np.inf if high is None else high)


def growth_near_one(operator: Operator) -> float:
    """Return an estimate of the growth factor of second moments that is on the same side of 1; in floats.

    Notes
    -----
    Above the growth factor m of the means, 1/ρ − 1 is nearly a straight line (see `_growth_by_noise`). The
    line through its pole at m and its value at 1 is 0 at m + (1 − m) ρ(1): one gain instead of a dozen.
    """
    operator = operator.balanced
    deviation = _deviation(operator, 1.0) if operator.means < 1 else -1.0
    if deviation == -1.0:
        return enclose_growth(operator, bounded=False).radius
    return float(operator.means + (1 - operator.means) / (1 + deviation))


def growth_with_slope(operator: Operator) -> tuple[float, float]:
    """Return the growth factor μ of an operator over a cell of one parameter, and dμ/dε, in floats.

    Matrices are (3, n, n'): value, radius, and change with the parameter ε.

    Notes
    -----
    With the growth factor of the means m(ε), the deviation f is a smooth function of the distance μ − m, also
    near its pole at μ = m. Along f = 0, d(μ − m)/dε = −f_ε/f_(μ−m); all by central differences.
    """
    operator = operator.balanced
    if not np.isfinite(operator.means):
        return np.nan, np.nan
    below, above = (_moved(operator, step) for step in (-DIFFERENCE, DIFFERENCE))
    means_slope, root = (above.means - below.means) / (2 * DIFFERENCE), _growth_by_noise(operator)
    if root is None:
        return operator.means, means_slope
    distance = root - operator.means
    rise = _deviation(above, above.means + distance) - _deviation(below, below.means + distance)
    near, far = (_deviation(operator, operator.means + distance * (1 + s)) for s in (-DIFFERENCE, DIFFERENCE))
    return root, means_slope - distance * rise / (far - near)


def _moved(operator: Operator, step: float) -> Operator:
    """Return the operator of float matrices at a place of its cell, −1 to 1."""

    def at_step(block: Matrix) -> Matrix:
        """Return a matrix at the place, without a radius."""
        value = block[..., 0, :, :] + step * block[..., 2, :, :]
        return np.stack([value, np.zeros_like(value)], axis=-3)

    blocks = [
        replace(
            block,
            matrix=at_step(block.matrix),
            noise_inputs=at_step(block.noise_inputs),
            noise_forms=at_step(block.noise_forms),
            same_frame=None if block.same_frame is None else at_step(block.same_frame),
        )
        for block in operator.blocks
    ]
    return Operator(tuple(blocks), operator.noise_covariance)


def _deviation(operator: Operator, growth: float) -> float:
    """Return 1/ρ − 1 for the largest eigenvalue ρ of the gain at a growth per frame; −1 at its pole."""
    gain = operator.gain(growth)
    if gain is None or not np.isfinite(gain).all():
        return -1.0
    return 1 / max(float(largest_magnitudes(gain)), NOTHING) - 1


def _growth_by_noise(operator: Operator) -> float | None:
    """Return the μ above the growth factor of means where the gain's largest eigenvalue ρ is 1.

    The result is None if ρ is below 1 for all such μ. With the distance d = μ − m from the growth factor of
    the means, where the gain has its pole, log ρ is nearly a straight line over log d: the secant method
    needs some five gains.
    """
    least = max(operator.means, NOTHING)

    def log_gain(place: float) -> float:
        """Return log ρ at a distance e^place from the growth factor of the means."""
        return -math.log(max(1 + _deviation(operator, least + math.exp(place)), TINY))

    place = math.log(NEAR * least)
    value, growth = log_gain(place), least
    if value <= 0:
        return None
    low, high, next_place = place, math.inf, place + value
    for _ in range(MOST_STEPS):
        before, value_before, place = place, value, next_place
        value = log_gain(place)
        low, high = (max(low, place), high) if value > 0 else (low, min(high, place))
        slope = (value - value_before) / (place - before)
        next_place = place - value / slope if slope else place
        if not low < next_place < min(high, place + FARTHEST):
            next_place = (low + high) / 2 if math.isfinite(high) else low + math.log(WIDER)
        growth = least + math.exp(next_place)
        if abs(growth - least - math.exp(place)) <= CLOSE * growth or high - low <= CLOSE:
            break
    return growth


def _is_below(operator: Operator, growth: float) -> bool | None:
    """Return True if the spectral radius is proved below μ, False if proved not below, None if undecided."""
    moments = operator.solution([np.eye(n) for n in operator.sizes], growth)
    if moments is None:
        return None
    exact = [MIDPOINT_RADIUS.exact(moment) for moment in moments]
    for moment, after in zip(exact, operator.next_moments(exact, MIDPOINT_RADIUS), strict=True):
        if not is_positive(MIDPOINT_RADIUS.subtract(entrywise(moment, rounded_number(growth)), after)):
            return None
    if all(map(is_positive, exact)):
        return True
    least = [np.linalg.eigvalsh(moment) / np.abs(moment).max(initial=0.0) / len(moment) for moment in moments]
    return False if any(values.size and values[0] < -UNCERTAINTY for values in least) else None


def proves_decay(operator: Operator) -> tuple[bool, bool]:
    """Return whether decay of the moments is proved, for all matrices within their radii or over a cell.

    The second value is whether the moments decay at the centre, in floats.
    """
    operator, decays_at_centre = operator.balanced, False
    if not operator.means < 1:
        return False, False
    numbers = arithmetic_of(operator.blocks[0].matrix)
    for share in SHARES:
        moments = operator.solution([np.eye(n) for n in operator.sizes], 1 - share * (1 - operator.means))
        if moments is None or not all(is_positive(MIDPOINT_RADIUS.exact(moment)) for moment in moments):
            continue
        decays_at_centre = True
        exact = [numbers.exact(moment) for moment in moments]
        decrease = map(numbers.subtract, exact, operator.next_moments(exact, numbers))
        if all(is_positive(corner) for matrix in decrease for corner in corners(matrix)):
            return True, True
    return False, decays_at_centre


def stationary_moments(operator: Operator, inputs: Sequence[Floats]) -> list[Floats]:
    """Return the stationary moments (n, n) of each block, for an input added at the start of each frame."""
    scales, operator = operator.scales, operator.balanced
    start = [moment / np.outer(d, d) for moment, d in zip(inputs, scales, strict=True)]
    result = operator.solution(start, 1.0)
    assert result is not None, "means grow although second moments decay"
    return [moment * np.outer(d, d) for moment, d in zip(result, scales, strict=True)]


def stein(matrix: Floats, source: Floats, growth: float = 1.0) -> Floats | None:
    """Return the X of μ X − M X Mᵀ = B, of M (n, n) and symmetric B (…, n, n); None if ρ(M)² ≥ μ.

    Parameters
    ----------
    matrix, source, growth
        M, B and μ.

    Notes
    -----
    X = Σ_k M^k B M^kᵀ/μ^{k+1}, doubled (Smith, 1968): of 2j terms, the second half is M^j times the first.
    """
    total, power = source / growth, matrix / growth**0.5
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


def _with_batch_axis(matrix: Matrix, numbers: Arithmetic) -> Matrix:
    """Return matrices with an axis of length 1 for products with several matrices."""
    return np.expand_dims(matrix, -3 if numbers is FLOATS else -4)


def _matrix_at(matrices: Matrix, index: int, numbers: Arithmetic) -> Matrix:
    """Return the matrix of an index in a stack."""
    return np.asarray(np.take(matrices, index, axis=-3 if numbers is FLOATS else -4))


def _weighted(weights: Floats, blocks: Matrix, numbers: Arithmetic) -> Matrix:
    """Return Σ_k w_lk X_k (l, …) of matrices X (k, …), with the rounding of the weights w (l, k)."""
    stack, rows = blocks if numbers is FLOATS else np.moveaxis(blocks, -4, -3), weights
    *batch_shape, count, n, m = stack.shape
    flat = stack.reshape(*batch_shape, count, n * m)
    if numbers is not FLOATS:
        rows = over_as_many(
            with_error_radius(weights, WEIGHT_ROUNDINGS * UNIT_ROUNDOFF * np.abs(weights)), flat
        )
    result = numbers.multiply(rows, flat).reshape(*batch_shape, len(weights), n, m)
    return np.asarray(result if numbers is FLOATS else np.moveaxis(result, -3, -4))


def weighted_sum(weights: Floats, blocks: Matrix) -> Matrix:
    """Return Σ_k w_k X_k of matrices X (k, 2, n, m), with the rounding of the weights w (k,)."""
    return np.asarray(_weighted(weights[None], blocks, MIDPOINT_RADIUS)[0])


def rounded_number(value: float) -> Matrix:
    """Return a number with the radius of a few roundings, as a matrix (2, 1, 1)."""
    return np.array([value, 4 * UNIT_ROUNDOFF * abs(value)]).reshape(2, 1, 1)
