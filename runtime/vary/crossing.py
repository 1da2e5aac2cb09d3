"""Where the verdict of a scene changes as one of its numbers varies, held between two verdicts.

Takes: a `ParameterPath`, a scene along one of its numbers.
Gives: `Verdict`, `Crossing`, `SmoothSegment`, `ParameterPath`, `SingleSegment`, `CrossingReport`; `search`;
`shortest_decimal`.
Guarantees: on either side of a crossing, by its error, the scene's own analysis gives another verdict; where
it gives none, the crossing is called an estimate. A jump is at an exact value.
Does not: prove that there are no others between two values that were looked at.

A line comes in stretches, on each of which the eigenvalues follow the value continuously: of a stiffness one,
of a delay one from each coincidence of events to the next, of a number of peers one each. Within a stretch a
crossing lies between two values of different sides; between two stretches it is a jump.

Between two samples an eigenvalue follows the cubic through its values and slopes at both; half of what the
tangents of the two ends miss each other by half-way stands for what the cubic doesn't know.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from operator import itemgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError
from apc.compiler.words import counted
from apc.eigen.spectrum import Mode
from apc.threads import load_pool
from apc.verdict import ProofMethod, StabilityProof

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Is told, in words, how far a search is.
Progress = Callable[[str], None]

# A magnitude nearer to 1 than this tells no side: far above the rounding of a few dozen states.
UNSURE = 1e-11

# Cells narrower than this, relative to the value, are divided no further; where the points to begin with are
# nearer to one another, not those narrower than this share of what is between them.
CELL, SHARE = 1e-3, 1 / 16

# A cell is divided into so many parts; cells at a time and levels: what follows the circle would be sampled
# for ever.
PARTS, MOST_OPEN, MOST_LEVELS = 8, 64, 12

# Places at which a cubic is looked at.
PLACES = 9

# Half the bracket first tried, relative to the value; how much wider the next is where it decides nothing.
HALF, WIDER, TRIES = 1e-13, 4.0, 24

# The same where no more is wanted than where stability is first lost: floats mostly hold it.
FIRST_HALF = 1e-10

# Steps of Newton's method, of Brent's, and of a bisection by verdicts.
NEWTON, BRENT, HALVINGS = 12, 200, 60

# How far inside a stretch its ends are sampled where the verdict changes in the next cell, relative to
# the value or the least size.
INWARDS = 1e-9

# The radius is discontinuous in a bracket narrower than this, relative to the value, in which it changes by
# more, whatever its errors.
JUMP = 1e-6

# A bracket this wide, relative to the value, with one verdict on both sides has no crossing.
NOWHERE = 1e-6

# A bracket wider than this on each side of the value, relative to it, is narrowed by so many verdicts.
WIDE, NARROWINGS = 1e-7, 24

# An error above this, relative to the value, remains only where no verdict at that distance decides.
RESOLUTION = 9.9e-7

# After so many values at which nothing changes, nothing depends on a number whose every value takes long.
STILL = 4

# A crossing between two periods of a clock.
PERIOD = "period"

# The proof of a crossing that no bounds hold.
ESTIMATE = StabilityProof(ProofMethod.ESTIMATED)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict at one value: `stable` is None where it is open; `error` bounds the radius's."""

    stable: bool | None
    radius: float
    error: float
    modes: Sequence[Mode]
    proof: StabilityProof

    @property
    def frequency_hz(self) -> float:
        """The frequency of the largest mode, NaN where there is none."""
        return self.modes[0].frequency_hz if len(self.modes) else math.nan


@dataclass(frozen=True, slots=True)
class Crossing:
    """A value at which the spectral radius crosses 1, right to `error`, both in SI.

    `stable_side` is "below" or "above"; `frequency_hz` is that of the motion that grows beside it; `kind` is
    "crossing", or "jump" where the radius is discontinuous: a packet comes a tick later, events change
    places or a contact closes; or "count" where it is the number of peers on the stable side of a change from
    one number to the next; or "period" between two periods of a clock, where no period in the middle makes a
    short enough frame. `proof` says how the value is known. `stable_at` is the verdict at a jump's own value,
    None of any other crossing, or if undecided.
    """

    value: float
    error: float
    stable_side: str
    frequency_hz: float
    kind: str
    proof: StabilityProof
    stable_at: bool | None = None

    @property
    def boundary(self) -> float:
        """Where the verdict changes: of a number of peers, between it and the next."""
        if self.kind != "count":
            return self.value
        return self.value + (0.5 if self.stable_side == "below" else -0.5)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothSegment:
    """Values from `low` to `high` along which the eigenvalues are continuous, to the ends from within.

    `points` (k,) are those to begin with, cells are measured against `least` where the value is smaller.
    `look` gives eigenvalues (k, n) and their slopes (k, n) at values (k,), NaN where there are none; `judge`
    the analysis at a value. With `slow` each value takes long.
    """

    low: Fraction
    high: Fraction
    points: Floats
    least: float
    look: Callable[[Floats], tuple[Complexes, Complexes]]
    judge: Callable[[Fraction], Verdict]
    slow: bool = False


class ParameterPath(Protocol):
    """A scene along one of its numbers, named by `label`."""

    @property
    def label(self) -> str:
        """The number that varies."""

    def stretches(self) -> Iterator[SmoothSegment]:
        """Yield the stretches in order."""

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the crossing between two stretches, the first stable or the second."""


class SingleSegment:
    """A line of one stretch."""

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """There is one stretch."""
        raise AssertionError("a line of one stretch has no jump")


@dataclass(frozen=True, slots=True)
class CrossingReport:
    """All crossings of one parameter in an interval, with what lies between them.

    `edges` are the crossings in order, and `stable` says of each stretch between them, one more than there
    are crossings, whether it is stable; it is empty when no sample has a side. `looked` values were looked
    at; `whole` is False where an eigenvalue kept so near to the circle that not every cell could be cleared;
    `enters` says whether any eigenvalue changed; `sided` whether each value to begin with, but those next to
    0, lies on a side; `left_open` are the stretches that no analysis decides; `why` says why the search
    ended before its end. `alone` are ends of a stretch at which the verdict differs from that at all
    neighbouring values: as where a stiffness of 0 takes a force away that every other value leaves.
    """

    edges: tuple[Crossing, ...]
    stable: tuple[bool, ...]
    scanned: tuple[float, float]
    whole: bool
    looked: int
    enters: bool
    sided: bool
    left_open: tuple[tuple[float, float], ...] = ()
    why: str = ""
    alone: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Points in order (k,) with the eigenvalues there (k, n) and their slopes (k, n)."""

    points: Floats
    values: Complexes
    slopes: Complexes

    @property
    def growth(self) -> Floats:
        """The logarithm of the spectral radius (k,)."""
        return np.asarray(np.log(np.abs(self.values).max(axis=1, initial=1e-300)))

    def chosen(self, which: NDArray[np.bool_]) -> _Samples:
        return _Samples(self.points[which], self.values[which], self.slopes[which])

    def merged(self, other: _Samples) -> _Samples:
        """Return both together; rows of fewer states are filled up with zeros, which decide nothing."""
        wide = max(self.values.shape[1], other.values.shape[1])

        def both(values: Complexes, more: Complexes) -> Complexes:
            rows = [np.pad(part, ((0, 0), (0, wide - part.shape[1]))) for part in (values, more)]
            return np.concatenate(rows)

        points = np.concatenate([self.points, other.points])
        order = np.argsort(points, kind="stable")
        values, slopes = both(self.values, other.values), both(self.slopes, other.slopes)
        return _Samples(points[order], values[order], slopes[order])


def stable_in_all(searches: Sequence[CrossingReport]) -> CrossingReport:
    """Return the search for the values at which all of several models are stable.

    Parameters
    ----------
    searches
        One for each model, along the same parameter; those in which nothing moves restrict nothing.
    """
    if len(searches) == 1:
        return searches[0]
    for one in searches:
        if not one.stable and (one.left_open or not one.whole):
            return one  # undecided at every value
    decided = [one for one in searches if one.stable]
    listed = sorted(
        ((edge.value, n, edge) for n, one in enumerate(decided) for edge in one.edges), key=itemgetter(0, 1)
    )
    now = [0] * len(decided)
    edges: list[Crossing] = []
    stable = [all(one.stable[0] for one in decided)] if decided else []
    for _, n, edge in listed:
        now[n] += 1
        together = all(one.stable[place] for one, place in zip(decided, now, strict=True))
        if together is not stable[-1]:
            edges.append(edge)
            stable.append(together)
    return CrossingReport(
        edges=tuple(edges),
        stable=tuple(stable),
        scanned=(max(one.scanned[0] for one in searches), min(one.scanned[1] for one in searches)),
        whole=all(one.whole for one in searches),
        looked=sum(one.looked for one in searches),
        enters=any(one.enters for one in searches),
        sided=all(one.sided for one in searches),
        left_open=tuple(dict.fromkeys(gap for one in searches for gap in one.left_open)),
        why=next((one.why for one in searches if one.why), ""),
        alone=tuple(dict.fromkeys(value for one in searches for value in one.alone)),
    )


def search(line: ParameterPath, *, first: bool = False, progress: Progress | None = None) -> CrossingReport:
    """Find the crossings of a line.

    Parameters
    ----------
    line
        The scene along one of its numbers.
    first
        Go no further than where stability is first lost; a value that can't be judged ends the search
        then.
    progress
        Is told how far the search is.
    """
    edges: list[Crossing] = []
    stable: list[bool] = []
    left_open: list[tuple[float, float]] = []
    ends: list[float] = []
    alone: list[float] = []
    looked, whole, enters, sided, why = 0, True, False, True, ""
    before: SmoothSegment | None = None
    for number, stretch in enumerate(line.stretches()):
        samples, cleared, why = _scanned(stretch, first=first)
        looked, whole = looked + len(samples.points), whole and cleared
        if progress:
            progress(f"looking at {counted(looked, 'value')} of {line.label}")
        if len(stretch.points) > 1 and len(samples.points):
            ends += samples.points[[0, -1]].tolist()
        else:
            ends += [float(stretch.low), float(stretch.high)]
        enters |= number > 0 or bool(
            np.nan_to_num(samples.slopes).any() or (samples.values != samples.values[:1]).any()
        )
        missing = ~np.isin(stretch.points, samples.points) & (np.abs(stretch.points) > stretch.least)
        sided &= not missing[1:-1].any()
        if not len(samples.points):
            if stretch.high > stretch.low:
                whole = False
                left_open.append((float(stretch.low), float(stretch.high)))
            continue
        samples, own = _with_ends_beside(stretch, samples)
        alone += own
        side = (samples.growth < 0).tolist()
        if stable and stable[-1] != side[0]:
            assert before is not None, "a side comes of a stretch"
            edges.append(line.change(before, stretch, stable_below=stable[-1]))
        if not stable or stable[-1] != side[0]:
            stable.append(side[0])
        for place in range(len(side) - 1):
            if side[place] != side[place + 1]:
                around = samples.points[max(place - 1, 0) : place + 3].tolist()
                crossing = _crossing(
                    stretch,
                    samples.points[place : place + 2].tolist(),
                    (around[0], around[-1]),
                    samples.growth[place : place + 2].tolist(),
                    rising=side[place],
                    half=FIRST_HALF if first else HALF,
                )
                if crossing is not None:
                    edges.append(crossing)
                    stable.append(side[place + 1])
        before = stretch
        if why or (first and any(edge.stable_side == "below" for edge in edges)):
            break
    scanned = (ends[0], ends[-1]) if ends else (math.nan, math.nan)
    return CrossingReport(
        edges=tuple(edges),
        stable=tuple(stable),
        scanned=scanned,
        whole=whole,
        looked=looked,
        enters=enters,
        sided=sided,
        left_open=tuple(left_open),
        why=why,
        alone=tuple(alone),
    )


def _scanned(stretch: SmoothSegment, *, first: bool) -> tuple[_Samples, bool, str]:
    """Return the samples of a stretch that have a side, those cells divided in which a crossing might hide.

    Also, whether every cell was cleared, and why the stretch was left before its end.
    """
    samples, why = _begun(stretch, first=first)
    samples = _sided(samples)
    new = np.ones(len(samples.points), dtype=bool)
    spacing = np.diff(stretch.points, append=np.inf)
    for _ in range(MOST_LEVELS):
        low, high = samples.points[:-1], samples.points[1:]
        place = np.searchsorted(stretch.points[:-1], low, side="right") - 1
        size = np.maximum(np.maximum(np.abs(low), np.abs(high)), stretch.least)
        cells = (new[:-1] | new[1:]) & (high - low > np.minimum(CELL * size, SHARE * spacing[place]))
        if first:
            rising = np.flatnonzero((samples.growth[:-1] < 0) & (samples.growth[1:] > 0))
            cells[rising[0] + 1 if len(rising) else len(cells) :] = False
        cells[cells] = _may_hide(samples, np.flatnonzero(cells))
        if not cells.any():
            return samples, True, why
        if cells.sum() > MOST_OPEN:
            break
        share = np.arange(1, PARTS) / PARTS
        between = (low[cells, None] + (high - low)[cells, None] * share).ravel()
        more = _sided(_sampled(stretch, between), ends=False)
        samples = samples.merged(more)
        new = np.isin(samples.points, more.points)
    return samples, False, why


def _begun(stretch: SmoothSegment, *, first: bool) -> tuple[_Samples, str]:
    """Return the samples at the points to begin with, as far as is wanted, and why no further."""
    if not (first and stretch.slow):
        return _sampled(stretch, stretch.points), ""
    samples = _sampled(stretch, stretch.points[:1])
    for point in stretch.points[1:]:
        try:
            samples = samples.merged(_sampled(stretch, np.array([point])))
        except ApcError as error:
            return samples, error.mistakes[0].what
        growth = samples.growth
        if growth[-1] >= 0 > growth[0] or (len(growth) == STILL and np.ptp(growth) == 0):
            break
    return samples, ""


def _sampled(stretch: SmoothSegment, points: Floats) -> _Samples:
    """Return the samples at points that have eigenvalues."""
    values, slopes = stretch.look(points)
    known = np.isfinite(values).all(axis=1)
    return _Samples(points[known], values[known], slopes[known])


def _sided(samples: _Samples, *, ends: bool = True) -> _Samples:
    """Return the samples that lie on a side of the circle; the first and last, too, as they are beside it.

    There an eigenvalue on the circle is moved as it goes just inside the line: as where a stiffness
    vanishes, and sets free what it holds.
    """
    values = samples.values
    sure = np.abs(np.abs(values).max(axis=1, initial=0.0) - 1) > UNSURE
    if ends and len(sure) > 1 and not sure[[0, -1]].all():
        values = values.copy()
        for place, way in ((0, 1), (-1, -1)):
            if sure[place]:
                continue
            on = np.abs(np.abs(values[place]) - 1) <= UNSURE
            leaving = way * np.sign((values[place].conj() * samples.slopes[place]).real)
            if leaving[on].all() and np.isfinite(leaving[on]).all():
                values[place][on] *= 1 + 2 * UNSURE * leaving[on]
                sure[place] = True
    return _Samples(samples.points, values, samples.slopes).chosen(sure)


def _may_hide(samples: _Samples, cells: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Say of the cells that begin at these samples whether another crossing than the ends show may hide."""
    shares = np.linspace(0, 1, PLACES)[:, None]
    values = np.zeros(len(cells), dtype=bool)
    if not samples.values.shape[1]:  # nothing moves: of devices that are held fast, say
        return values
    for number, place in enumerate(cells):
        width = samples.points[place + 1] - samples.points[place]
        (value, end), (slope, end_slope) = (
            samples.values[place : place + 2],
            samples.slopes[place : place + 2],
        )
        slope, end_slope = slope * width, end_slope * width
        if not (np.isfinite(slope).all() and np.isfinite(end_slope).all()):
            continue
        miss = np.abs((value + slope / 2)[:, None] - (end - end_slope / 2))
        partner, doubt = miss.argmin(axis=1), miss.min(axis=1) / 2
        path = _cubic(shares, value, end[partner], slope, end_slope[partner])
        size = np.abs(path)
        most, least = size.max(axis=0) + doubt, size.min(axis=0) - doubt
        if (most < 1).all() or (least > 1).any():
            continue
        changes = np.abs(np.diff((size > 1).astype(np.int8), axis=0)).sum(axis=0)
        through = (changes == 1) & (doubt < np.abs(size[-1] - size[0]))
        touches = (most >= 1) & (least <= 1) & ~through
        values[number] = touches.any() or (through & (value.imag >= 0)).sum() > 1
    return values


def _cubic(t: Floats, start: Complexes, end: Complexes, slope: Complexes, end_slope: Complexes) -> Complexes:
    """Return the cubics with these values and slopes at 0 and 1 (n,) at shares (k, 1)."""
    straight = (1 + 2 * t) * (1 - t) ** 2 * start + t**2 * (3 - 2 * t) * end
    return np.asarray(straight + t * (1 - t) ** 2 * slope + t**2 * (t - 1) * end_slope)


def _with_ends_beside(stretch: SmoothSegment, samples: _Samples) -> tuple[_Samples, list[float]]:
    """Return the samples with an end replaced by a point just inside, where the verdict changes next to it.

    Also, the ends at which the verdict differs from that just inside.
    """
    alone = []
    for place, next_place, way in ((0, 1, 1), (-1, -2, -1)):
        stable = samples.growth < 0
        if len(stable) < 2 or stable[place] == stable[next_place]:
            continue
        end = float(samples.points[place])
        near_end = end + way * INWARDS * max(abs(end), stretch.least)
        inside = _sided(_sampled(stretch, np.array([near_end])), ends=False)
        if len(inside.points) and (inside.growth[0] < 0) == stable[next_place]:
            at_end = replace(inside, points=np.array([end]))
            others = samples.points != end
            samples = samples.chosen(others).merged(at_end)
            alone.append(end)
    return samples, alone


def _crossing(
    stretch: SmoothSegment,
    ends: Sequence[float],
    limits: tuple[float, float],
    growth: Sequence[float],
    *,
    rising: bool,
    half: float,
) -> Crossing | None:
    """Close in on the crossing between two values, and hold it; None where both sides are judged alike.

    `growth` are the logarithms of the spectral radius at the ends, `limits` the samples before and behind
    these, between which the bracket stays: a crossing may lie on an end. `half` is that of the bracket first
    tried, relative to the value.
    """
    value = _root(stretch, ends, growth, half)
    side = "below" if rising else "above"
    width = half * (abs(value) or ends[1] - ends[0])
    low, high = limits
    for _ in range(TRIES):
        left, right = max(value - width, low), min(value + width, high)
        grows = stretch.judge(Fraction(right if rising else left))
        # Where the one side is left open the other decides nothing, and its proof takes as long.
        dies = grows if grows.stable is None else stretch.judge(Fraction(left if rising else right))
        below, above = (dies, grows) if rising else (grows, dies)
        if below.stable is rising and above.stable is (not rising):
            return _held(stretch, *_narrowed(stretch, left, right, (below, above), rising=rising), side)
        if None not in (below.stable, above.stable) and width > NOWHERE * abs(value):
            return _bisected(stretch, ends, rising=rising, half=half)
        if (left, right) == (low, high):
            break
        if below.stable == above.stable is not None:
            # What floats saw is off by more than the bracket; what is bounded says where to look.
            moved = above.radius - below.radius
            sure = abs(moved) > below.error + above.error
            nearer = left + (right - left) * (1 - below.radius) / moved if sure else math.nan
            if low < nearer < high:
                value = nearer
                continue
        width *= WIDER
    return Crossing(value, min(width, high - low), side, grows.frequency_hz, "crossing", ESTIMATE)


def _bisected(stretch: SmoothSegment, ends: Sequence[float], *, rising: bool, half: float) -> Crossing | None:
    """Hold a crossing by bisection with verdicts, None where both ends have one verdict or are undecided."""
    left, right = ends
    below, above = (stretch.judge(Fraction(end)) for end in ends)
    if not (below.stable is rising and above.stable is (not rising)):
        return None
    for _ in range(HALVINGS):
        middle = (left + right) / 2
        if right - left <= 2 * half * abs(middle):
            break
        at = stretch.judge(Fraction(middle))
        if at.stable is None:
            break
        if at.stable is rising:
            left, below = middle, at
        else:
            right, above = middle, at
    narrowed = _narrowed(stretch, left, right, (below, above), rising=rising)
    return _held(stretch, *narrowed, "below" if rising else "above")


def _narrowed(
    stretch: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], *, rising: bool
) -> tuple[float, float, tuple[Verdict, Verdict]]:
    """Return a bracket narrowed from both ends to what verdicts decide, with the verdicts at its ends.

    Parameters
    ----------
    stretch
        The interval that contains the bracket.
    left, right, verdicts
        The bracket, and the verdicts at its ends.
    rising
        Whether the left end is the stable one.
    """
    below, above = verdicts
    undecided: tuple[float, float] | None = None
    for _ in range(NARROWINGS):
        first, last = undecided or (right, left)
        if right - left <= WIDE * abs(left + right) or max(first - left, right - last) <= (last - first) / 4:
            break
        from_left = undecided is None or first - left >= right - last
        at_left = from_left and undecided is not None
        middle = (left + first) / 2 if from_left else (last + right) / 2
        verdict = stretch.judge(Fraction(middle))
        if verdict.stable is None:
            undecided = (min(middle, first), max(middle, last)) if undecided else (middle, middle)
        elif verdict.stable is rising and (at_left or undecided is None):
            left, below = middle, verdict
        elif verdict.stable is not rising and not at_left:
            right, above = middle, verdict
        else:  # another crossing
            break
    return _within_resolution(stretch, left, right, (below, above), rising=rising)


def _within_resolution(
    stretch: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], *, rising: bool
) -> tuple[float, float, tuple[Verdict, Verdict]]:
    """Return a bracket of half at most RESOLUTION of its middle, where verdicts at that distance decide.

    Parameters
    ----------
    stretch, left, right, verdicts, rising
        As for `_narrowed`.
    """
    below, above = verdicts
    for _ in range(NARROWINGS):
        middle = (left + right) / 2
        reach = RESOLUTION * abs(middle)
        if right - left <= 2 * reach:
            break
        lower, upper = stretch.judge(Fraction(middle - reach)), stretch.judge(Fraction(middle + reach))
        from_left = lower.stable is rising
        from_right = upper.stable is (not rising)
        if from_left:
            left, below = middle - reach, lower
        if from_right:
            right, above = middle + reach, upper
        if from_left is from_right:  # narrowed from both sides, or undecided on both
            break
    return left, right, (below, above)


def _held(
    stretch: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], side: str
) -> Crossing:
    """Return the crossing between two values of these verdicts, the stable one on a side."""
    dies, grows = verdicts if side == "below" else verdicts[::-1]
    bits = next((verdict.proof.bits for verdict in verdicts if verdict.proof.bits), 0)
    bounded = grows.proof or StabilityProof(ProofMethod.BOUNDED)
    proof = StabilityProof(ProofMethod.BALLS, bits) if bits else bounded
    middle, kind, at = (left + right) / 2, "crossing", None
    change = grows.radius - dies.radius - grows.error - dies.error
    if right - left < JUMP * abs(middle) and change > JUMP:
        # A discontinuity of the radius, as where a contact closes: at a value that somebody wrote.
        exact = shortest_decimal(left, right)
        middle, kind, at = float(exact), "jump", stretch.judge(exact).stable
    error = max(right - middle, middle - left)
    return Crossing(middle, error, side, grows.frequency_hz, kind, proof, at)


def shortest_decimal(low: float, high: float) -> Fraction:
    """Return the decimal number of the fewest digits after the point in [low, high], low ≤ high."""
    least, most, digits = Fraction(low), Fraction(high), 0
    while (number := math.ceil(least * 10**digits)) > most * 10**digits:
        digits += 1
    return Fraction(number, 10**digits)


def _root(stretch: SmoothSegment, ends: Sequence[float], growth: Sequence[float], off: float) -> float:
    """Return where floats see the largest magnitude pass 1 between ends on two sides, off by so much of it.

    By Newton's method and, where that leaves the ends or there are no slopes, Brent's.
    """
    known = {end: (height, math.nan) for end, height in zip(ends, growth, strict=True)}

    def at(value: float) -> tuple[float, float]:
        if value not in known:
            result = _sampled(stretch, np.array([value]))
            if len(result.points):
                largest = np.argmax(np.abs(result.values[0]))
                rate = result.slopes[0, largest] / result.values[0, largest]
                known[value] = float(result.growth[0]), float(rate.real)
            else:  # no matrix: what is beside it is judged
                known[value] = 0.0, math.nan
        return known[value]

    (low, high), (at_low, at_high) = ends, growth
    value = low + (high - low) * at_low / (at_low - at_high)
    for _ in range(NEWTON):
        height, rate = at(value)
        new = value - height / rate if rate else math.nan
        if not low <= new <= high:
            break
        if abs(new - value) <= off * abs(new):
            return new
        value = new
    # Imported where Newton's method fails: it takes as long as an analysis.
    brentq = load_pool("scipy.optimize").brentq
    nearest = off / 100
    # Where it ends before, as between values next to each other, verdicts hold what there is.
    return float(
        brentq(
            lambda value: at(value)[0],
            low,
            high,
            xtol=nearest * stretch.least or math.ulp(0.0),
            rtol=max(nearest, 4 * np.finfo(float).eps),
            maxiter=BRENT,
            disp=False,
        )
    )
