"""The spectral radius of second moments, from how luck drives itself.

Takes: loops of means, and the covariances of luck that drive them.
Gives: `Answer`, `Drive`, `Part`, `Moments`; `gain`, `mean_square_radius`, `Enclosed`, `below_1`; `stein`,
`around`, `weighted`, `number_of`.
Guarantees: a radius between `low` and `high` for every loop within the radii of its matrices.
Does not: know where the loops come from (see `crowd` and `stand_in`).

Let V hold the covariances of luck, growing by λ a frame. The means answer to it with moments
X = Σ_f λ^−f A^f B(V) A^fᵀ, a Stein equation; of these follows, by the law of chance, V again: V = G(λ) V. G
maps covariances to covariances and falls as λ rises, so second moments grow by the λ > ρ(A)² at which the
largest eigenvalue of G is 1, or by ρ(A)² where it is smaller than 1 all the way down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.dissipation import is_positive
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.matrix_norms import balance
from apc.eigen.relative import Relative
from apc.frame.radius import FLOATS, RADII, UNIT, Arithmetic, radius_of, value_of, with_radius
from apc.frame.taylor import arithmetic_of, corners, entrywise, hull, over_as_many
from apc.moments.unserved import UnservedError
from apc.threads import load_pool

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# What is left of a sum that is doubled, relative to the whole: far below any rounding.
NOTHING = 1e-24

# Doublings until a sum counts as endless, 2^60 frames; or where what is doubled has grown to this.
DOUBLINGS, ENDLESS = 60, 1e100

# Where φ is not small, these are tried at the corners of a cell of at most so many parameters.
LARGE, SHARES, MOST_SIDES = 0.5, (0.1, 0.5, 0.9), 6

# How much smaller than others a state moves, in units in which all are alike, to count as at rest.
RESTS = 1e-6

TINY = float(np.finfo(np.float64).tiny)

# G is looked at so near above the means' own growth, where it has its pole; and so many times farther from it
# each time until its largest eigenvalue is below 1.
NEAR, WIDER = 1e-9, 4.0

# How near the radius is near enough, relatively.
CLOSE = 1e-14

# How near the radius is enclosed at first, relatively, how much farther each time and how far at last.
FIRST_WIDTH, WIDER_BOUNDS, LAST_WIDTH = 1e-12, 8.0, 1e-3

# Covariances of luck times cubes of the means' states: as much takes some ten seconds.
MOST_WORK = 20_000_000

# Roundings of a weight and of a symmetric part.
WEIGHT_ROUNDINGS = 18


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Covariances that moments X of a loop make: `spread` ∘ Σ_k w_k L_k X R_kᵀ, of which some entries count.

    Of a product that is not symmetric its symmetric part is meant.

    Attributes
    ----------
    place
        The rows of G that they stand in.
    left, right
        L and R (k, 2, p, n), each with its radius or over a cell.
    weights
        w (k,).
    entries
        The rows and columns (2, entries) that count.
    spread
        The covariance (2, p, p) of what is left to chance, None where it is 1 throughout.
    """

    place: slice
    left: Matrix
    right: Matrix
    weights: Floats
    entries: NDArray[np.intp]
    spread: Matrix | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A loop of means driven by luck of one kind.

    Attributes
    ----------
    matrix
        The loop (2, n, n) with its radius or over a cell.
    into
        How luck, which is drawn as a frame begins, enters its states (2, n, k).
    units
        The covariances (b, k, k) of luck that G has a column for each.
    place
        Which columns these are.
    answers
        The covariances that follow; their forms are over states (n,), or over these and luck (n + k,).
    part
        Which loop of means this is, its own states first.
    share
        How many times as much all luck of this kind moves that loop.
    """

    matrix: Matrix
    into: Matrix
    units: Floats
    place: slice
    answers: tuple[Answer, ...]
    part: int
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A loop of means: of all classes of peers, or of what peers of the class `only` differ by.

    Attributes
    ----------
    matrix
        The loop (2, n, n) with its radius or over a cell.
    only
        The class, None for the loop of all.
    at
        Its coordinates, relative to motions that nothing holds back.
    offsets
        Where each site's states begin.
    answers
        The covariances of luck that follow from its moments.
    """

    matrix: Matrix
    only: int | None
    at: Relative
    offsets: tuple[int, ...]
    answers: tuple[Answer, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """What second moments of a scene follow from: its loops, the luck that drives them, and how many
    covariances of luck there are.
    """

    parts: tuple[Part, ...]
    drives: tuple[Drive, ...]
    entries: int

    @property
    def means(self) -> tuple[list[Matrix], list[Matrix]]:
        """The loops of means (2, n, n): those that luck drives, and those that it does not."""
        driven = {drive.part for drive in self.drives}
        return (
            [part.matrix for number, part in enumerate(self.parts) if number in driven],
            [part.matrix for number, part in enumerate(self.parts) if number not in driven],
        )

    @property
    def states(self) -> int:
        """The states of the largest loop that luck drives."""
        return max((drive.matrix.shape[-1] for drive in self.drives), default=0)


@dataclass(frozen=True, slots=True)
class Enclosed:
    """The spectral radius of second moments a frame, and bounds on it; infinite where there is none."""

    radius: float
    low: float
    high: float


def stein(matrix: Matrix, driven: Matrix, numbers: Arithmetic) -> Matrix | None:
    """Return Σ_k M^k B M^kᵀ of a matrix M (n, n) and symmetric B (b, n, n), None where it does not end.

    With radii, or over a cell, that it ends for every M within them is proved.

    Notes
    -----
    Let X̂ be what floats say, and E = B + M X̂ Mᵀ − X̂ what they leave, −θ D² ≤ E ≤ θ D² in the order of
    symmetric matrices for some diagonal D. For a P ≥ 0 with P − M P Mᵀ ≥ (1 − φ) D², φ < 1, the powers of M
    die out (Lyapunov), and X − X̂ = Σ_k M^k E M^kᵀ lies between −θ/(1 − φ) P and θ/(1 − φ) P. D² is as X̂ on
    its diagonal, P as floats have Σ_k M^k D² M^kᵀ; θ and φ are the largest sums of rows, over D (Gershgorin).
    Over a cell X̂ follows the parameters to first order, and E is of the second.
    """
    if numbers is FLOATS:
        return _doubled(matrix, driven)
    n = matrix.shape[-1]
    result = _doubled(value_of(matrix), value_of(driven))
    if result is None or not n:
        return None if result is None else driven
    result = (result + np.swapaxes(result, -1, -2)) / 2
    guessed = numbers.exact(result)
    guessed[..., 2:, :, :] = _slopes(matrix, driven, result)
    weights = _weights(result, value_of(matrix))
    seed = np.diag(weights**2)
    still = _doubled(value_of(matrix), seed[None])
    if still is None:
        return None
    still = (still + np.swapaxes(still, -1, -2)) / 2
    guessed = np.concatenate([guessed, numbers.exact(still)])
    added = np.concatenate([driven, numbers.exact(seed[None])])
    left = numbers.subtract(numbers.add(around(matrix, guessed, numbers), added), guessed)
    scale, within = np.outer(weights, weights), hull(left)
    size = (np.abs(value_of(within)) + radius_of(within)) / scale
    *thetas, phi = size.sum(axis=-1).max(axis=-1) * (1 + (n + 8) * UNIT)
    held = still[0], phi
    if not phi < LARGE:
        held = _held_at_corners(matrix, seed, numbers) or held
    shape = held[0] / scale
    if not (held[1] < 1 and is_positive(with_radius(shape, 2 * UNIT * np.abs(shape)))):
        return None
    wide = np.sqrt(np.diagonal(held[0]))
    reach = np.array(thetas)[:, None, None] / (1 - held[1]) * np.outer(wide, wide)
    guessed = guessed[:-1]
    radius_of(guessed)[...] = reach * (1 + 16 * UNIT)
    return guessed


def _slopes(matrix: Matrix, driven: Matrix, values: Floats) -> Matrix:
    """Return how Σ_k M^k B M^kᵀ (b, n, n) changes with each parameter of a cell (b, m, n, n), in floats."""
    moved = matrix[2:] @ values[:, None] @ value_of(matrix).T
    moved = driven[:, 2:] + moved + np.swapaxes(moved, -1, -2)
    if not moved.size:
        return moved
    total = _doubled(value_of(matrix), moved.reshape(-1, *values.shape[1:]))
    assert total is not None, "sums of one matrix end for all that drives it, or for nothing"
    return (total + np.swapaxes(total, -1, -2)).reshape(moved.shape) / 2


def _held_at_corners(matrix: Matrix, seed: Floats, numbers: Arithmetic) -> tuple[Floats, float] | None:
    """Return a P (n, n) and a φ < 1 with P − M P Mᵀ ≥ (1 − φ) D² all over a cell, None where there are none.

    Notes
    -----
    Of M/γ in place of M, γ between the spectral radius and 1, P has some of itself to spare, (1 − γ²) P;
    where D is small beside what moves, units of that take its place. What is left is straight over the cell
    but for its radius: it is positive if it is so at each corner.
    """
    value = value_of(matrix)
    if len(matrix) - 2 > MOST_SIDES:
        return None
    decay = (1 + float(np.abs(np.linalg.eigvals(value)).max(initial=0.0))) / 2
    units = balance(np.abs(value) + np.abs(matrix[2:]).sum(axis=0)) ** 2
    for inner in (seed, np.diag(units * (np.diagonal(seed) / units).max())):
        result = _doubled(value / decay, inner[None])
        if result is None:
            return None
        result = (result + np.swapaxes(result, -1, -2)) / 2
        guessed = numbers.exact(result)
        left = numbers.subtract(guessed, around(matrix, guessed, numbers))
        for share in SHARES:
            spared = numbers.subtract(left, numbers.exact((1 - share) * seed))
            if all(is_positive(matrix) for matrix in corners(spared[0])):
                return result[0], share
    return None


def _weights(result: Matrix, matrix: Matrix) -> Floats:
    """Return how large states are where moments (b, n, n) are found; those that rest, beside the others."""
    weights = np.sqrt(np.abs(np.diagonal(result, axis1=-2, axis2=-1)).sum(axis=0))
    alike = balance(np.abs(matrix))
    shares = weights / alike
    moves = shares > RESTS * shares.max(initial=0.0)  # what is less is what rounding leaves of none
    return np.asarray(
        np.where(moves, weights, alike * shares[moves].min(initial=np.inf)) if moves.any() else alike
    )


def _doubled(matrix: Matrix, driven: Matrix) -> Matrix | None:
    """Return Σ_k M^k B M^kᵀ in floats, None where it does not end.

    Doubled (Smith, 1968): of 2j terms, the second half is M^j times the first.
    """
    total, power = driven, matrix
    for _ in range(DOUBLINGS):
        total = total + power @ total @ power.T
        power = power @ power
        size = float(np.abs(power).sum(axis=-1).max(initial=0.0))
        if not size < ENDLESS:
            return None
        if size**2 < NOTHING:
            return np.asarray(total)
    return None


def around(left: Matrix, inner: Matrix, numbers: Arithmetic, right: Matrix | None = None) -> Matrix:
    """Return L X Rᵀ, R being L unless given."""
    other = left if right is None else right
    return numbers.multiply(numbers.multiply(left, inner), np.swapaxes(other, -1, -2))


def gain(
    drives: Sequence[Drive], shape: tuple[int, int], growth: float, numbers: Arithmetic
) -> Matrix | None:
    """Return G(λ) over covariances of luck, None where the means grow faster.

    Parameters
    ----------
    drives
        The loops and the luck that drives them.
    shape
        How many rows and columns G has.
    growth
        λ, what second moments grow by in a frame.
    numbers
        What G is of: floats, floats with their radii, or those over cells.
    """
    result = numbers.exact(np.zeros(shape))
    shrink, root = number_of(1 / growth, numbers), number_of(growth**-0.5, numbers)
    scaled = np.multiply if numbers is FLOATS else entrywise
    for drive in drives:
        units = numbers.exact(drive.units)
        driven = scaled(around(of_kind(drive.into, numbers), units, numbers), shrink)
        moments = stein(scaled(of_kind(drive.matrix, numbers), root), driven, numbers)
        if moments is None:
            return None
        n = moments.shape[-1]
        for answer in drive.answers:
            size = answer.left.shape[-1]
            over = np.zeros((*moments.shape[:-2], size, size))
            over[..., :n, :n] = moments
            if size > n:
                over[..., n:, n:] = units
            left, right = of_kind(answer.left, numbers), of_kind(answer.right, numbers)
            total = weighted(around(left, over[:, None], numbers, right), answer.weights, numbers)
            total = (total + np.swapaxes(total, -1, -2)) / 2
            if answer.spread is not None:
                total = scaled(total, of_kind(answer.spread, numbers))
            block = np.moveaxis(total[..., answer.entries[0], answer.entries[1]], 0, -1)
            place = np.s_[..., answer.place, drive.place]
            result[place] = numbers.add(result[place], block)
    return result


def weighted(blocks: Matrix, weights: Floats, numbers: Arithmetic) -> Matrix:
    """Return Σ_k w_k X_k of matrices X (b, k, …), the weights w (k,) rounded.

    Parameters
    ----------
    blocks, weights
        X and w.
    numbers
        What X are of.
    """
    rows = weights[None]
    *many, count, n, m = np.moveaxis(blocks, 1, -3).shape
    flat = np.moveaxis(blocks, 1, -3).reshape(*many, count, n * m)
    if numbers is not FLOATS:
        rows = over_as_many(with_radius(rows, WEIGHT_ROUNDINGS * UNIT * np.abs(rows)), flat)
    return numbers.multiply(rows, flat).reshape(*many, n, m)


def of_kind(matrix: Matrix, numbers: Arithmetic) -> Matrix:
    """Return a matrix with its radius as it is, or without it."""
    return value_of(matrix) if numbers is FLOATS else matrix


def number_of(value: float, numbers: Arithmetic) -> Matrix:
    """Return a number that was rounded a few times, to scale by."""
    if numbers is FLOATS:
        return np.array(value)
    return np.array([value, 4 * UNIT * abs(value)]).reshape(2, 1, 1)


def mean_square_radius(of: Moments, *, bounded: bool = True) -> Enclosed:
    """Enclose what second moments grow by in a frame, for all start states.

    Parameters
    ----------
    of
        The loops and their luck.
    bounded
        Whether bounds are asked for; without them, they are the radius itself.

    Raises
    ------
    UnservedError
        There are too many covariances of luck.
    """
    if of.entries * of.states**3 > MOST_WORK:
        raise UnservedError(
            f"{of.entries:,} covariances of random losses and delays that drive loops of {of.states} states "
            "would take minutes: fewer ticks at which a packet may arrive, a shorter delay, or fewer peers "
            "that differ"
        )
    driven, undriven = of.means
    largest_driven, largest_undriven = _growth(driven), _growth(undriven)
    if not np.isfinite(largest_driven + largest_undriven):
        return Enclosed(np.nan, 0.0, np.inf)
    root = _radius(of, max(largest_driven, TINY)) if driven else None
    radius = max(largest_undriven, largest_driven if root is None else root)
    if not bounded:
        return Enclosed(radius, radius, radius)
    if not driven:
        return Enclosed(radius, *_square(undriven))
    # Bounds on G at λ prove that the means it comes from grow by less.
    square = _square([*driven, *undriven] if root is None else undriven)
    start, least = (max(square[1], TINY), NEAR) if root is None else (root, FIRST_WIDTH)
    above, width = np.inf, least
    while width <= LAST_WIDTH and above > start * (1 + width):
        if bounds := _bounds(of, start * (1 + width)):
            above = min(above, start * (1 + width) * max(bounds[1], 1.0) * (1 + 2 * UNIT))
        width *= WIDER_BOUNDS
    below, width = square[0], FIRST_WIDTH
    while root is not None and width <= LAST_WIDTH and below < root * (1 - width):
        if bounds := _bounds(of, root * (1 - width)):
            below = max(below, root * (1 - width) * min(bounds[0], 1.0) * (1 - 2 * UNIT))
        width *= WIDER_BOUNDS
    if not below:  # so near the growth of the means, G has no bounds
        below = _square(driven)[0]
    return Enclosed(radius, min(below, radius), max(above, square[1], radius))


def below_1(of: Moments) -> tuple[bool, bool]:
    """Say whether it is proved that what luck drives dies out, for all matrices within their radii or a cell.

    And whether, in floats, it does so in the middle.
    """
    driven, _ = of.means
    if not driven:
        return True, True
    bounds = _bounds(of, 1.0, arithmetic_of(driven[0]))
    proved = bounds is not None and bounds[1] < 1
    return proved, proved or _largest(of, 1.0) < 1


def _growth(loops: Sequence[Matrix]) -> float:
    """Return what squares of the means grow by in floats."""
    return max((_size(np.linalg.eigvals(value_of(loop))) ** 2 for loop in loops), default=0.0)


def _square(loops: Sequence[Matrix]) -> tuple[float, float]:
    """Return bounds on what squares of the means grow by."""
    bounds = [enclose_eigenvalues(value_of(loop), radius_of(loop))[1] for loop in loops]
    low, high = (
        max((enclosure.low for enclosure in bounds), default=0.0),
        max((enclosure.high for enclosure in bounds), default=0.0),
    )
    return low**2 * (1 - 2 * UNIT), high**2 * (1 + 2 * UNIT)


def _size(values: NDArray[Any]) -> float:
    return float(np.abs(values).max(initial=0.0))


def _bounds(of: Moments, growth: float, numbers: Arithmetic = RADII) -> tuple[float, float] | None:
    """Return bounds on the largest eigenvalue of G(λ), None where there are none.

    Of G, terms fall as 1/λ or faster: where it is ρ at λ, it is 1 between λ min(ρ, 1) and λ max(ρ, 1).
    """
    matrix = gain(of.drives, (of.entries,) * 2, growth, numbers)
    if matrix is None or not np.isfinite(matrix).all():
        return None
    matrix = hull(matrix)
    if matrix.shape[-1] == 1:
        value, off = abs(float(matrix[0, 0, 0])), float(matrix[1, 0, 0])
        return (value - off) * (1 - 4 * UNIT), (value + off) * (1 + 4 * UNIT)  # 1 + UNIT is 1 in floats
    _, bounds = enclose_eigenvalues(value_of(matrix), radius_of(matrix))
    return bounds.low, bounds.high


def _largest(of: Moments, growth: float) -> float:
    """Return the largest eigenvalue of G(λ) in floats, infinite where there is none."""
    with np.errstate(all="ignore"):
        matrix = gain(of.drives, (of.entries,) * 2, growth, FLOATS)
    if matrix is None or not np.isfinite(matrix).all():
        return np.inf
    return _size(matrix if len(matrix) == 1 else np.linalg.eigvals(matrix))


def _radius(of: Moments, least: float) -> float | None:
    """Return the λ above `least` at which the largest eigenvalue of G is 1 in floats, None if there is none.

    The root is that of 1/ρ − 1, which is nearly straight from −1 at the means' own growth, where G has its
    pole.
    """

    def over(growth: float) -> float:
        return 1 / max(_largest(of, growth), TINY) - 1

    low, gap = least * (1 + NEAR), max(1 - least, 0.1 * least)
    if over(low) > 0:
        return None
    while over(high := least + gap) < 0:
        low, gap = high, WIDER * gap
    return float(load_pool("scipy.optimize").brentq(over, low, high, xtol=1e-300, rtol=CLOSE))
