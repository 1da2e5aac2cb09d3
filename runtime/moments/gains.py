"""The spectral radius of second moments, from how luck drives itself.

Takes: the mean loops of a scene and what the luck of its channels does to them.
Gives: `Luck`, `Part`, `Moments`; `gain_of`, `mean_square_radius`, `Enclosed`, `Gain`; `below_1`; `stein`,
`around`, `of_kind`, `number_of`, `units_of`, `too_much`.
Guarantees: a radius between `low` and `high` for every loop within the radii of its matrices.
Does not: know where the loops come from (see `crowd`).

Let V hold the covariances of the luck of one channel of each kind, growing by λ a frame. The means answer to
it, once for each channel of a kind, with moments Σ_f λ^−f A^(f−1) B V Bᵀ A^(f−1)ᵀ, a Stein equation; of these
follows how far packets are from what is heard, and of that, by the law of chance, V again: V = G(λ) V. G maps
covariances to covariances and falls as λ rises, so second moments grow by the λ > ρ(A)² at which the largest
eigenvalue of G is 1, or by ρ(A)² where it is smaller than 1 all the way down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.dissipation import is_positive
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.pseudospectrum import balance
from apc.frame.discretize import UNIT
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of, value_of, with_radius
from apc.frame.taylor import arithmetic_of, corners, hull
from apc.moments.mean_loops import Channel, MeanLoop, Route, scaled

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# G(λ) in numbers of a kind, None where the means grow faster.
Gain = Callable[[float, Arithmetic], Matrix | None]

# What is left of a sum that is doubled, relative to the whole: far below any rounding.
NOTHING = 1e-24

# Doublings until a sum counts as endless, 2^60 frames; or where what is doubled has grown to this.
DOUBLINGS, ENDLESS = 60, 1e100

# Where φ is not small, these are tried at the corners of a cell of at most so many parameters.
LARGE, SHARES, MOST_SIDES = 0.5, (0.1, 0.5, 0.9), 6

TINY = float(np.finfo(np.float64).tiny)

# Steps towards the radius; secants need some five. After so many without a λ at which G is large, it is
# looked at so near above the means' own growth.
STEPS, BLIND, NEAR = 60, 4, 1e-9

# G is first looked at where it decides the verdict, at 1, if the means decay by more than this; else so far
# above their own growth, and at most so many times farther each time.
NEAR_ONE, FIRST_GAP, WIDER = 0.99999, 0.1, 30

# How near the radius is near enough, relatively; and as far from 1, the slopes of G are not rounding.
CLOSE, ROUGH = 1e-14, 1e-6

# How near it is enclosed at first, relatively, and how much farther at last.
FIRST_WIDTH, LAST_WIDTH = 1e-12, 1e-3

# Covariances of luck times cubes of the means' states: as much takes some ten seconds.
MOST_WORK = 20_000_000


def too_much(entries: int, states: int) -> str:
    """Return why so many covariances of luck that drive loops of so many states are not followed, or ""."""
    if entries * states**3 <= MOST_WORK:
        return ""
    return (
        f"{entries:,} covariances of luck that drive loops of {states} states would take minutes: fewer "
        "ticks at which a packet may arrive, a shorter delay, or fewer peers that differ"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Luck:
    """The luck of equal channels, on `route` from each of `senders` peers of class `sender` to each of some.

    Each of the `receivers` peers of class `receiver` hears `heard` of them. `spreads` are the covariances of
    whether what is uncertain of each slot's packet is replaced, number by number (k_slot, k_slot).
    """

    route: Route
    sender: int
    receiver: int
    receivers: int
    heard: int
    spreads: tuple[Matrix, ...]

    @property
    def entries(self) -> list[list[tuple[int, int]]]:
        """The entries (a, b) of each slot's covariance, a ≤ b."""
        return [
            [(a, b) for a in range(spread.shape[-1]) for b in range(a, spread.shape[-1])]
            for spread in self.spreads
        ]


@dataclass(frozen=True, slots=True)
class Part:
    """A loop of means: all peers of each class alike (`apart` is None), or those of class `apart` apart.

    `classes` are the peers' classes of its sites; `channels` the kinds of luck, by number, that drive it.
    """

    loop: MeanLoop
    apart: int | None
    classes: tuple[int, ...]
    channels: Mapping[int, Channel]


@dataclass(frozen=True, slots=True)
class Moments:
    """All loops and all kinds of luck of a scene."""

    parts: tuple[Part, ...]
    luck: tuple[Luck, ...]

    @property
    def means(self) -> tuple[list[Matrix], list[Matrix]]:
        """The matrices of the loops, those that luck drives first."""
        own = [part.loop.matrix for part in self.parts if part.channels]
        return own, [part.loop.matrix for part in self.parts if not part.channels]


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
    found = _doubled(value_of(matrix), value_of(driven))
    if found is None or not n:
        return None if found is None else driven
    found = (found + np.swapaxes(found, -1, -2)) / 2
    guessed = numbers.exact(found)
    guessed[..., 2:, :, :] = _slopes(matrix, driven, found)
    weights = _weights(found, value_of(matrix))
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


def _slopes(matrix: Matrix, driven: Matrix, found: Floats) -> Matrix:
    """Return how Σ_k M^k B M^kᵀ (b, n, n) changes with each parameter of a cell (b, m, n, n), in floats."""
    moved = matrix[2:] @ found[:, None] @ value_of(matrix).T
    moved = driven[:, 2:] + moved + np.swapaxes(moved, -1, -2)
    if not moved.size:
        return moved
    total = _doubled(value_of(matrix), moved.reshape(-1, *found.shape[1:]))
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
        found = _doubled(value / decay, inner[None])
        if found is None:
            return None
        found = (found + np.swapaxes(found, -1, -2)) / 2
        guessed = numbers.exact(found)
        left = numbers.subtract(guessed, around(matrix, guessed, numbers))
        for share in SHARES:
            spared = numbers.subtract(left, numbers.exact((1 - share) * seed))
            if all(is_positive(one) for one in corners(spared[0])):
                return found[0], share
    return None


def _weights(found: Matrix, matrix: Matrix) -> Floats:
    """Return how large states are where moments (b, n, n) are found; those that rest, beside the others."""
    weights = np.sqrt(np.abs(np.diagonal(found, axis1=-2, axis2=-1)).sum(axis=0))
    if not weights.all():
        alike = balance(np.abs(matrix))
        least = (weights[weights > 0] / alike[weights > 0]).min(initial=np.inf)
        weights = np.where(weights > 0, weights, alike * (least if np.isfinite(least) else 1.0))
    return np.asarray(weights)


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


def gain_of(of: Moments) -> Gain:
    """Return G(λ) over the entries of all covariances of luck, None where the means grow faster.

    What does not depend on λ is worked out once.

    Parameters
    ----------
    of
        The loops and their luck.
    """
    firsts = np.cumsum([0] + [sum(map(len, one.entries)) for one in of.luck]).tolist()
    known: dict[bool, list[_Driven]] = {}

    def at(growth: float, numbers: Arithmetic) -> Matrix | None:
        exact = numbers is FLOATS
        if exact not in known:
            known[exact] = [_driven(of, part, d, firsts, numbers) for part in of.parts for d in part.channels]
        found = numbers.exact(np.zeros((firsts[-1], firsts[-1])))
        shrink, root = number_of(1 / growth, numbers), number_of(growth**-0.5, numbers)
        for one in known[exact]:
            matrix, driven = scaled(one.matrix, root, numbers), scaled(one.driven, shrink, numbers)
            moments = stein(matrix, driven, numbers)
            if moments is None:
                return None
            for answer in one.answers:
                same = answer.miss.of(moments, numbers)
                for place, entries, spread, own in answer.heard:
                    moved = same if own is None else numbers.add(same, own.of(moments, numbers))
                    moved = scaled(moved, spread, numbers)
                    block = np.moveaxis(moved[..., entries[0], entries[1]], 0, -1)
                    found[place] = numbers.add(found[place], block)
        return found

    return at


@dataclass(frozen=True, slots=True, eq=False)
class _Form:
    """The moments E[l rᵀ] + E[r lᵀ] of forms of states times `by`, each unit of luck by itself, and `own`."""

    left: Matrix
    right: Matrix
    by: Matrix
    own: Matrix

    def of(self, moments: Matrix, numbers: Arithmetic) -> Matrix:
        """Return them for the moments of states (b, n, n)."""
        found = around(self.left, moments, numbers, self.right)
        found = numbers.add(found, np.swapaxes(found, -1, -2))
        return numbers.add(scaled(found, self.by, numbers), self.own)


@dataclass(frozen=True, slots=True, eq=False)
class _Answers:
    """How far packets are from what is heard, `miss`, and what luck that is to channels.

    `heard`: where each stands in G, its entries, whether it is lucky, and what the channel itself adds.
    """

    miss: _Form
    heard: tuple[tuple[Any, NDArray[np.intp], Matrix, _Form | None], ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Driven:
    """A part driven by the luck of a channel: states by `matrix` and, for each unit, `driven` (b, n, n)."""

    matrix: Matrix
    driven: Matrix
    answers: tuple[_Answers, ...]


def _driven(of: Moments, part: Part, d: int, firsts: Sequence[int], numbers: Arithmetic) -> _Driven:
    """Return how a part answers to the luck of channels of kind d."""
    kind, channel = of.luck[d], part.channels[d]
    n = channel.matrix.shape[-1]
    covariances, full = numbers.exact(units_of(kind)), arithmetic_of(channel.matrix)

    def form(left: Matrix, right: Matrix, by: float) -> _Form:
        left, right, factor = of_kind(left, numbers), of_kind(right, numbers), number_of(by / 2, numbers)
        own = around(left[..., n:], covariances, numbers, right[..., n:])
        own = scaled(numbers.add(own, np.swapaxes(own, -1, -2)), factor, numbers)
        return _Form(left[..., :n], right[..., :n], factor, own)

    # One channel drives the mean of all receivers by 1/n, and them apart by 1 − 1/n or −1/n.
    alone = 1 / kind.receivers
    share = kind.heard * (alone if part.apart is None else 1 - alone)
    answers = []
    for (site, route, slot), miss in channel.misses.items():
        heard = []
        for c, other in enumerate(of.luck):
            if (other.route, other.sender) != (route, part.classes[site]):
                continue
            own = None
            if c == d and part.apart is None:
                # o oᵀ + (m oᵀ + o mᵀ)/n, of which the form has both halves
                mixed = full.add(scaled(miss, number_of(2 * alone, full), full), channel.own[slot])
                own = form(mixed, channel.own[slot], 1.0)
            elif c == d:
                own = form(miss, channel.own[slot], -2 * alone)
            entries = np.array(other.entries[slot], np.intp).reshape(-1, 2).T
            first = firsts[c] + sum(map(len, other.entries[:slot]))
            place = np.s_[..., first : first + entries.shape[1], firsts[d] : firsts[d + 1]]
            heard.append((place, entries, of_kind(other.spreads[slot], numbers), own))
        answers.append(_Answers(form(miss, miss, share), tuple(heard)))
    driven = around(of_kind(channel.driven, numbers), covariances, numbers)
    return _Driven(of_kind(channel.matrix, numbers), driven, tuple(answers))


def units_of(kind: Luck) -> Floats:
    """Return a unit of each entry of its covariances, over the luck of all slots (b, k, k)."""
    sizes = [spread.shape[-1] for spread in kind.spreads]
    starts = np.cumsum([0, *sizes])
    found = np.zeros((sum(map(len, kind.entries)), starts[-1], starts[-1]))
    listed = [(starts[slot] + a, starts[slot] + b) for slot, own in enumerate(kind.entries) for a, b in own]
    for number, (a, b) in enumerate(listed):
        found[number, a, b] = found[number, b, a] = 1.0
    return found


def of_kind(matrix: Matrix, numbers: Arithmetic) -> Matrix:
    """Return a matrix with its radius as it is, or without it."""
    return value_of(matrix) if numbers is FLOATS else matrix


def number_of(value: float, numbers: Arithmetic) -> Matrix:
    """Return a number that was rounded a few times, to scale by."""
    if numbers is FLOATS:
        return np.array(value)
    return np.array([value, 4 * UNIT * abs(value)]).reshape(2, 1, 1)


def mean_square_radius(
    driven: Sequence[Matrix], alone: Sequence[Matrix], of: Gain, *, bounded: bool = True
) -> Enclosed:
    """Enclose what second moments grow by in a frame, for all start states.

    Parameters
    ----------
    driven, alone
        The loops of means (2, n, n), each with its radius: those that luck drives, and those that it doesn't.
    of
        G(λ).
    bounded
        Whether bounds are asked for; without them, they are the radius itself.
    """
    own, others = _growth(driven), _growth(alone)
    if not np.isfinite(own + others):
        return Enclosed(np.nan, 0.0, np.inf)
    found, steep = _radius(of, max(own, TINY)) if driven else (None, 1.0)
    radius = max(others, own if found is None else found)
    if not bounded:
        return Enclosed(radius, radius, radius)
    if not driven:
        return Enclosed(radius, *_square(alone))
    # Bounds on G at λ prove that the means it comes from grow by less.
    square = _square([*driven, *alone] if found is None else alone)
    above, wide = np.inf, None
    start, width = (max(square[1], TINY), NEAR) if found is None else (found, FIRST_WIDTH)
    while width <= LAST_WIDTH and above > start * (1 + width):
        bounds = _bounds(of, start * (1 + width))
        if bounds is not None:
            above = min(above, start * (1 + width) * max(bounds[1], 1.0) * (1 + 2 * UNIT))
            wide = (bounds[1] - bounds[0]) / steep if wide is None else wide
        # What bounds say near a pole says little of farther on.
        width = min(max(8 * width, 0.0 if wide is None else wide), 64 * width)
    below, width = square[0], FIRST_WIDTH if wide is None else max(wide, FIRST_WIDTH / 8)
    while found is not None and width <= LAST_WIDTH and below < found * (1 - width):
        bounds = _bounds(of, found * (1 - width))
        if bounds is not None:
            below = max(below, found * (1 - width) * min(bounds[0], 1.0) * (1 - 2 * UNIT))
        width *= 8
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
    gain = gain_of(of)
    bounds = _bounds(gain, 1.0, arithmetic_of(driven[0]))
    proved = bounds is not None and bounds[1] < 1
    return proved, proved or _largest(gain, 1.0) < 1


def _growth(loops: Sequence[Matrix]) -> float:
    """Return what squares of the means grow by in floats."""
    return max((_size(np.linalg.eigvals(value_of(one))) ** 2 for one in loops), default=0.0)


def _square(loops: Sequence[Matrix]) -> tuple[float, float]:
    """Return bounds on what squares of the means grow by."""
    found = [enclose_eigenvalues(value_of(one), radius_of(one))[1] for one in loops]
    low, high = max((one.low for one in found), default=0.0), max((one.high for one in found), default=0.0)
    return low**2 * (1 - 2 * UNIT), high**2 * (1 + 2 * UNIT)


def _size(values: NDArray[Any]) -> float:
    return float(np.abs(values).max(initial=0.0))


def _bounds(of: Gain, growth: float, numbers: Arithmetic = RADII) -> tuple[float, float] | None:
    """Return bounds on the largest eigenvalue of G(λ), None where there are none.

    Of G, terms fall as 1/λ or faster: where it is ρ at λ, it is 1 between λ min(ρ, 1) and λ max(ρ, 1).
    """
    matrix = of(growth, numbers)
    if matrix is None or not np.isfinite(matrix).all():
        return None
    matrix = hull(matrix)
    if matrix.shape[-1] == 1:
        value, off = abs(float(matrix[0, 0, 0])), float(matrix[1, 0, 0])
        return (value - off) * (1 - 4 * UNIT), (value + off) * (1 + 4 * UNIT)  # 1 + UNIT is 1 in floats
    _, found = enclose_eigenvalues(value_of(matrix), radius_of(matrix))
    return found.low, found.high


def _largest(of: Gain, growth: float) -> float:
    """Return the largest eigenvalue of G(λ) in floats, infinite where there is none."""
    with np.errstate(all="ignore"):
        matrix = of(growth, FLOATS)
    if matrix is None or not np.isfinite(matrix).all():
        return np.inf
    return _size(matrix if len(matrix) == 1 else np.linalg.eigvals(matrix))


def _radius(of: Gain, least: float) -> tuple[float | None, float]:
    """Return the λ above `least` at which the largest eigenvalue of G is 1 in floats, None if there is none.

    Beside it, how steeply G falls there: d log ρ/d log λ, 1 or more. 1/G − 1 is followed, which is nearly
    straight from −1 at the means' own growth, where G has its pole: by secants between a point on either
    side, one that stays twice counting as much less as the other moved (Anderson and Björck, 1973).
    """

    def over(growth: float) -> float:
        return 1 / max(_largest(of, growth), TINY) - 1

    low, at_low, known = least, -1.0, False  # of the pole, nothing is known: luck may not reach it
    high = 1.0 if least < NEAR_ONE else least * (1 + FIRST_GAP)
    at_high = over(high)
    while at_high < 0:
        low, at_low, known = high, at_high, True
        ahead = (high - least) / max(1 + at_high, 1 / WIDER)
        high = least + max(ahead, (high - least) * (1 + FIRST_GAP))
        at_high = over(high)
    best, off, steep, stayed = high, at_high, 1.0, 0
    for step in range(STEPS):
        if step >= BLIND and not known and off > ROUGH:
            low = least * (1 + NEAR)
            at_low = over(low)
            if at_low > 0:
                return None, 1.0
            known = True
        middle = low - at_low * (high - low) / (at_high - at_low)
        if off <= CLOSE * steep or not low < middle < high:
            break
        found = over(middle)
        if found < 0:
            slope = (found - at_high) / (middle - high)
            shrink = 1 - found / at_low
            at_high *= (shrink if shrink > 0 else 0.5) if stayed == 1 else 1.0
            low, at_low, known, stayed = middle, found, True, 1
        else:
            slope = (found - at_low) / (middle - low)
            shrink = 1 - found / at_high
            at_low *= (shrink if shrink > 0 else 0.5) if stayed == -1 else 1.0
            high, at_high, stayed = middle, found, -1
        if off > ROUGH:
            steep = max(1.0, middle * slope)
        if abs(found) < off:
            best, off = middle, abs(found)
    return (best, steep) if known or off <= ROUGH else (None, 1.0)
