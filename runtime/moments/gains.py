"""The spectral radius of second moments, from how luck drives itself.

Takes: the mean loops of a scene and what the luck of its channels does to them.
Gives: `Luck`, `Part`, `Moments`; `gain`, `mean_square_radius`, `Enclosed`, `Gain`; `stein`, `around`,
`scaled`, `of_kind`, `number_of`, `units_of`, `too_much`.
Guarantees: a radius between `low` and `high` for every loop within the radii of its matrices.
Does not: know where the loops come from (see `crowd`).

Let V hold the covariances of the luck of one channel of each kind, growing by λ a frame. The means answer to
it, once for each channel of a kind, with moments Σ_f λ^−f A^(f−1) B V Bᵀ A^(f−1)ᵀ, a Stein equation; of these
follows how far packets are from what is heard, and of that, by the law of chance, V again: V = G(λ) V. G maps
covariances to covariances and falls as λ rises, so second moments grow by the λ > ρ(A)² at which the largest
eigenvalue of G is 1, or by ρ(A)² where it is smaller than 1 all the way down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.enclosure import enclose_eigenvalues
from apc.frame.discretize import UNIT
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of, value_of, with_radius
from apc.moments.mean_loops import Channel, MeanLoop, Route

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# G(λ) in numbers of a kind, None where the means grow faster.
Gain = Callable[[float, Arithmetic], Matrix | None]

# What is left of a sum that is doubled, relative to the whole: far below any rounding.
NOTHING = 1e-24

# Doublings until a sum counts as endless, 2^60 frames; or where what is doubled has grown to this.
DOUBLINGS, ENDLESS = 60, 1e100

# Steps towards the radius; secants need some ten. The first is so near above the means' own growth.
STEPS, NEAR = 60, 1e-9

# How far above the means' own growth, or this, G is first looked for to be small, and how much farther each
# time.
LEAST, FIRST_GAP, WIDER = 1e-3, 1e-3, 30

# How near 1 is near enough; and as far from it, slopes are not rounding.
CLOSE, ROUGH = 1e-13, 1e-6

# How near it is enclosed at first, relatively, and how much farther at last.
FIRST_WIDTH, LAST_WIDTH = 1e-11, 1e-3


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


@dataclass(frozen=True, slots=True)
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
    """All loops and all kinds of luck of a scene; `means` are bounds on the means' spectral radius."""

    parts: tuple[Part, ...]
    luck: tuple[Luck, ...]
    means: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Enclosed:
    """The spectral radius of second moments a frame, and bounds on it; infinite where there is none."""

    radius: float
    low: float
    high: float


def scaled(matrix: Matrix, by: Matrix, numbers: Arithmetic) -> Matrix:
    """Return matrices entry by entry times others, or times numbers."""
    if numbers is FLOATS:
        return np.asarray(matrix * by)
    value, factor, off = value_of(matrix), value_of(by), radius_of(by)
    product = value * factor
    radius = radius_of(matrix) * (np.abs(factor) + off) + np.abs(value) * off + UNIT * np.abs(product)
    return with_radius(product, radius * (1 + 8 * UNIT))


def stein(matrix: Matrix, driven: Matrix, numbers: Arithmetic) -> Matrix | None:
    """Return Σ_k M^k B M^kᵀ of a matrix M (n, n) and matrices B (b, n, n), None where it does not end.

    Notes
    -----
    Doubled (Smith, 1968): of 2j terms, the second half is M^j times the first. What is left out after the
    last doubling is M^j Y M^jᵀ, at most ‖M^j‖² / (1 − ‖M^j‖²) of the largest entry of what is there.
    """
    total, power = driven, matrix
    for _ in range(DOUBLINGS):
        total = numbers.add(total, around(power, total, numbers))
        power = numbers.multiply(power, power)
        sums = np.abs(power).sum(axis=-1)
        size = float((sums if numbers is FLOATS else sums.sum(axis=0)).max(initial=0.0))
        if not size < ENDLESS:
            return None
        if size**2 < NOTHING:
            if numbers is not FLOATS:
                most = (np.abs(value_of(total)) + radius_of(total)).max(axis=(-2, -1), keepdims=True)
                radius_of(total)[...] += 2 * size**2 * most
            return total
    return None


def around(left: Matrix, inner: Matrix, numbers: Arithmetic, right: Matrix | None = None) -> Matrix:
    """Return L X Rᵀ, R being L unless given."""
    other = left if right is None else right
    return numbers.multiply(numbers.multiply(left, inner), np.swapaxes(other, -1, -2))


def gain(of: Moments, growth: float, numbers: Arithmetic = FLOATS) -> Matrix | None:
    """Return G(λ) over the entries of all covariances of luck, None where the means grow faster.

    Parameters
    ----------
    of
        The loops and their luck.
    growth
        λ, what second moments grow by in a frame.
    numbers
        Floats, or floats with their radii.
    """
    firsts = np.cumsum([0] + [sum(map(len, one.entries)) for one in of.luck]).tolist()
    found = of_kind(np.zeros((2, firsts[-1], firsts[-1])), numbers)
    shrink, root = number_of(1 / growth, numbers), number_of(growth**-0.5, numbers)
    for part in of.parts:
        for d, channel in part.channels.items():
            kind = of.luck[d]
            covariances = of_kind(RADII.exact(units_of(kind)), numbers)
            driven = scaled(around(of_kind(channel.driven, numbers), covariances, numbers), shrink, numbers)
            moments = stein(scaled(of_kind(channel.matrix, numbers), root, numbers), driven, numbers)
            if moments is None:
                return None
            answer = _Answer(channel.matrix.shape[-1], moments, covariances, numbers)
            # One channel drives the mean of all receivers by 1/n, and them apart by 1 − 1/n or −1/n.
            alone = 1 / kind.receivers
            share = kind.heard * (alone if part.apart is None else 1 - alone)
            for (site, route, slot), rows in channel.misses.items():
                miss = of_kind(rows, numbers)
                same = scaled(answer.of(miss, miss), number_of(share, numbers), numbers)
                for c, other in enumerate(of.luck):
                    if (other.route, other.sender) != (route, part.classes[site]):
                        continue
                    moved = same
                    if c == d:
                        own = of_kind(channel.own[slot], numbers)
                        both = answer.of(miss, own)
                        both = numbers.add(both, np.swapaxes(both, -1, -2))
                        factor = number_of(alone if part.apart is None else -alone, numbers)
                        moved = numbers.add(moved, scaled(both, factor, numbers))
                        if part.apart is None:
                            moved = numbers.add(moved, answer.of(own, own))
                    moved = scaled(moved, of_kind(other.spreads[slot], numbers), numbers)
                    listed = np.array(other.entries[slot], np.intp).reshape(-1, 2).T
                    block = np.moveaxis(moved[..., listed[0], listed[1]], 0, -1)
                    first = firsts[c] + sum(map(len, other.entries[:slot]))
                    place = np.s_[..., first : first + listed.shape[1], firsts[d] : firsts[d + 1]]
                    found[place] = numbers.add(found[place], block)
    return found


@dataclass(frozen=True, slots=True)
class _Answer:
    """How states of a part and of a channel answer to each unit of its luck's covariance."""

    states: int
    moments: Matrix
    covariances: Matrix
    numbers: Arithmetic

    def of(self, left: Matrix, right: Matrix) -> Matrix:
        """Return the moments E[l rᵀ] of linear forms of states and luck."""
        n, numbers = self.states, self.numbers
        late = around(left[..., :n], self.moments, numbers, right[..., :n])
        return numbers.add(late, around(left[..., n:], self.covariances, numbers, right[..., n:]))


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


def mean_square_radius(means: tuple[float, float], of: Gain | None, *, bounded: bool = True) -> Enclosed:
    """Enclose what second moments grow by in a frame, for all start states.

    Parameters
    ----------
    means
        Bounds on the spectral radius of the means.
    of
        G(λ), None where nothing is left to chance.
    bounded
        Whether bounds are asked for; without them, they are the radius itself.
    """
    low, high = means
    if not np.isfinite(high):
        return Enclosed(np.nan, 0.0, np.inf)
    square = (low**2 * (1 - 2 * UNIT), high**2 * (1 + 2 * UNIT))
    if of is None:
        return Enclosed(low * high, *square)
    least = max(high**2, np.finfo(np.float64).tiny)
    found, steep = _radius(of, least)
    radius = low * high if found is None else found
    if not bounded:
        return Enclosed(radius, radius, radius)
    above, wide = np.inf, None
    start, width = (least, NEAR) if found is None else (found, FIRST_WIDTH)
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
    return Enclosed(radius, min(below, radius), max(above, square[1], radius))


def _bounds(of: Gain, growth: float) -> tuple[float, float] | None:
    """Return bounds on the largest eigenvalue of G(λ), None where there are none.

    Of G, terms fall as 1/λ or faster: where it is ρ at λ, it is 1 between λ min(ρ, 1) and λ max(ρ, 1).
    """
    matrix = of(growth, RADII)
    if matrix is None or not np.isfinite(matrix).all():
        return None
    _, found = enclose_eigenvalues(value_of(matrix), radius_of(matrix))
    return found.low, found.high


def _largest(of: Gain, growth: float) -> float:
    """Return the largest eigenvalue of G(λ) in floats, infinite where there is none."""
    with np.errstate(all="ignore"):
        matrix = of(growth, FLOATS)
    if matrix is None or not np.isfinite(matrix).all():
        return np.inf
    return float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0))


def _radius(of: Gain, least: float) -> tuple[float | None, float]:
    """Return the λ above `least` at which the largest eigenvalue of G is 1 in floats, None if there is none.

    Beside it, how steeply G falls there: d log ρ/d log λ, 1 or more. 1/G is followed, which is nearly
    straight where G has its pole: by secants between a point on either side, one that stays twice counting
    half (the Illinois rule).
    """

    def over(growth: float) -> float:
        return 1 / max(_largest(of, growth), np.finfo(np.float64).tiny) - 1

    low, gap = least * (1 + NEAR), max(least, LEAST) * FIRST_GAP
    at_low = over(low)
    if at_low > 0:
        return None, 1.0
    high = low + gap
    at_high = over(high)
    while at_high < 0:
        low, at_low, gap = high, at_high, WIDER * gap
        high = low + gap
        at_high = over(high)
    best, off = (low, -at_low) if -at_low < at_high else (high, at_high)
    steep, stayed = max(1.0, best * (at_high - at_low) / (high - low)), 0
    for _ in range(STEPS):
        middle = low - at_low * (high - low) / (at_high - at_low)
        if off <= max(CLOSE, UNIT * steep) or not low < middle < high:
            break
        found = over(middle)
        if found < 0:
            slope = (found - at_low) / (middle - low)
            low, at_low = middle, found
            at_high, stayed = (at_high / 2, 1) if stayed == 1 else (at_high, 1)
        else:
            slope = (at_high - found) / (high - middle)
            high, at_high = middle, found
            at_low, stayed = (at_low / 2, -1) if stayed == -1 else (at_low, -1)
        if off > ROUGH:
            steep = max(1.0, middle * slope)
        if abs(found) < off:
            best, off = middle, abs(found)
    return best, steep
