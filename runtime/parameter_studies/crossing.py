"""Values of a parameter at which the verdict changes, bracketed between two verdicts.

Takes: a `ParameterPath`, a model along one of its parameters.
Gives: `Verdict`, `Crossing`, `SmoothSegment`, `ParameterPath`, `SingleSegment`, `CrossingReport`; `search`;
`shortest_decimal`; `stable_in_all`.
Guarantees: on both sides of a crossing, at its error, the model's own analysis gives different verdicts;
otherwise the crossing is marked as an estimate. A jump is at an exact value.
Does not: prove that there are no other crossings between two samples.

A path consists of segments on which the eigenvalues are continuous: one for a stiffness, one for a delay
between two coincidences of events, one for each number of peers. Within a segment a crossing lies between two
values on different sides; between two segments it is a jump.

Between two samples an eigenvalue is approximated by the cubic through its values and slopes at both; half the
distance between the tangents of both ends at the midpoint estimates the error of the cubic.
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
from apc.compiler.wording import counted
from apc.eigen.spectrum import Mode
from apc.threads import load_pool
from apc.verdict import ProofMethod, StabilityProof

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Receives the progress of a search, as text.
Progress = Callable[[str], None]

# The distance of a magnitude from 1 below which its side is unknown: far above the rounding of a few dozen
# states.
UNSURE = 1e-11

# The smallest cell width, relative to the value; where the first samples are closer to each other, relative
# to their distance.
CELL, SHARE = 1e-3, 1 / 16

# The number of parts of a divided cell; the limits of cells at a time and of levels, as an eigenvalue along
# the circle would need endless samples.
PARTS, MOST_OPEN, MOST_LEVELS = 8, 64, 12

# The sample points of a cubic.
LOCATIONS = 9

# Half the width of the first bracket, relative to the value; the growth of the next if it decides nothing.
HALF, WIDER, TRIES = 1e-13, 4.0, 24

# The same if only the first loss of stability is wanted: floats mostly bracket it.
FIRST_HALF = 1e-10

# Limits of steps of Newton's method, of Brent's, and of a bisection by verdicts.
NEWTON, BRENT, HALVINGS = 12, 200, 60

# The distance inside a segment at which its ends are sampled if the verdict changes in the next cell,
# relative to the value or the smallest size.
INWARDS = 1e-9

# The radius is discontinuous in a bracket narrower than this, relative to the value, if it changes by more
# than this, beyond its errors.
JUMP = 1e-6

# A bracket this wide, relative to the value, with one verdict on both sides has no crossing.
NOWHERE = 1e-6

# A bracket wider than this on each side of the value, relative to it, is narrowed by this number of verdicts.
WIDE, NARROWINGS = 1e-7, 24

# An error above this, relative to the value, remains only where no verdict at that distance decides.
RESOLUTION = 9.9e-7

# The number of equal results after which an expensive parameter is taken to have no effect.
STILL = 4

# The note on a crossing between two periods of a clock.
PERIOD = "period"

# The proof of a crossing that no bounds hold.
ESTIMATE = StabilityProof(ProofMethod.ESTIMATED)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict at one value: `stable` is None if undecided; `error` bounds the error of the radius."""

    stable: bool | None
    radius: float
    error: float
    modes: Sequence[Mode]
    proof: StabilityProof

    @property
    def frequency_hz(self) -> float:
        """The frequency of the largest mode, NaN if there is none."""
        return self.modes[0].frequency_hz if len(self.modes) else math.nan


@dataclass(frozen=True, slots=True)
class Crossing:
    """A value at which the spectral radius crosses 1, with `error`, both in SI.

    `stable_side` is "below" or "above"; `frequency_hz` is that of the unstable mode; `kind` is "crossing", or
    "jump" where the radius is discontinuous: a packet arrives a tick later, events change their order or a
    contact closes; or "count" where it is the number of peers on the stable side of a change from one number
    to the next; or "period" between two periods of a clock, where no period between makes a short enough
    frame. `proof` is the method by which the value is known. `stable_at` is the verdict at a jump's own
    value, None for any other crossing, or if undecided.
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
        """The location of a change of verdict: for a number of peers, between it and the next."""
        if self.kind != "count":
            return self.value
        return self.value + (0.5 if self.stable_side == "below" else -0.5)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothSegment:
    """Values from `low` to `high` with continuous eigenvalues; the ends are one-sided limits.

    `points` (k,) are the first samples, cell widths are relative to at least `least`. `sample_at` gives
    eigenvalues (k, n) and their slopes (k, n) at values (k,), NaN if undefined; `verdict_at` the analysis at
    a value. With `slow` each value is expensive.
    """

    low: Fraction
    high: Fraction
    points: Floats
    least: float
    sample_at: Callable[[Floats], tuple[Complexes, Complexes]]
    verdict_at: Callable[[Fraction], Verdict]
    slow: bool = False


class ParameterPath(Protocol):
    """A model along one of its parameters, named by `label`."""

    @property
    def label(self) -> str:
        """The parameter that varies."""

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the segments in order."""

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the crossing between two segments, the first stable or the second."""


class SingleSegment:
    """A path of one segment."""

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """A path of one segment has no crossing between segments."""
        raise AssertionError("a line of one stretch has no jump")


@dataclass(frozen=True, slots=True)
class CrossingReport:
    """All crossings of one parameter in an interval, with the verdicts between them.

    `edges` are the crossings in order, and `stable` the verdicts of the segments between them, one more than
    there are crossings; it is empty when no sample has a side. `evaluations` is the number of evaluations;
    `complete` is False where an eigenvalue so near to the circle was found that not every cell could be
    resolved; `has_effect` states whether any eigenvalue changed; `classified` whether each first sample,
    except those next to 0, lies on a side; `undecided` are the undecided segments; `why` is the reason if the
    search ended early. `isolated` are ends of a segment at which the verdict differs from that at all
    neighbouring values: for example a stiffness of 0, without the force of every other value.
    """

    edges: tuple[Crossing, ...]
    stable: tuple[bool, ...]
    searched_to: tuple[float, float]
    complete: bool
    evaluations: int
    has_effect: bool
    classified: bool
    undecided: tuple[tuple[float, float], ...] = ()
    why: str = ""
    isolated: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Points in order (k,) with the eigenvalues there (k, n) and their slopes (k, n)."""

    points: Floats
    values: Complexes
    slopes: Complexes

    @property
    def log_radius(self) -> Floats:
        """The logarithm of the spectral radius (k,)."""
        return np.asarray(np.log(np.abs(self.values).max(axis=1, initial=1e-300)))

    def chosen(self, which: NDArray[np.bool_]) -> _Samples:
        return _Samples(self.points[which], self.values[which], self.slopes[which])

    def merged(self, other: _Samples) -> _Samples:
        """Return both together; rows of fewer states are padded with zeros, without effect on the radius."""
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
        One for each model, along the same parameter; a model without motion restricts nothing.
    """
    if len(searches) == 1:
        return searches[0]
    for item in searches:
        if not item.stable and (item.undecided or not item.complete):
            return item  # undecided at every value
    decided = [item for item in searches if item.stable]
    listed = sorted(
        ((edge.value, n, edge) for n, item in enumerate(decided) for edge in item.edges), key=itemgetter(0, 1)
    )
    now = [0] * len(decided)
    edges: list[Crossing] = []
    stable = [all(item.stable[0] for item in decided)] if decided else []
    for _, n, edge in listed:
        now[n] += 1
        together = all(item.stable[index] for item, index in zip(decided, now, strict=True))
        if together is not stable[-1]:
            edges.append(edge)
            stable.append(together)
    return CrossingReport(
        edges=tuple(edges),
        stable=tuple(stable),
        searched_to=(
            max(item.searched_to[0] for item in searches),
            min(item.searched_to[1] for item in searches),
        ),
        complete=all(item.complete for item in searches),
        evaluations=sum(item.evaluations for item in searches),
        has_effect=any(item.has_effect for item in searches),
        classified=all(item.classified for item in searches),
        undecided=tuple(dict.fromkeys(gap for item in searches for gap in item.undecided)),
        why=next((item.why for item in searches if item.why), ""),
        isolated=tuple(dict.fromkeys(value for item in searches for value in item.isolated)),
    )


def search(line: ParameterPath, *, first: bool = False, progress: Progress | None = None) -> CrossingReport:
    """Return the crossings along a path.

    Parameters
    ----------
    line
        The model along one of its parameters.
    first
        Stop at the first loss of stability; a value without a verdict then ends the search.
    progress
        Receives the progress of the search.
    """
    edges: list[Crossing] = []
    stable: list[bool] = []
    undecided: list[tuple[float, float]] = []
    ends: list[float] = []
    alone: list[float] = []
    evaluations, whole, enters, sided, why = 0, True, False, True, ""
    before: SmoothSegment | None = None
    for number, segment in enumerate(line.smooth_segments()):
        samples, cleared, why = _scanned(segment, first=first)
        evaluations, whole = evaluations + len(samples.points), whole and cleared
        if progress:
            progress(f"looking at {counted(evaluations, 'value')} of {line.label}")
        if len(segment.points) > 1 and len(samples.points):
            ends += samples.points[[0, -1]].tolist()
        else:
            ends += [float(segment.low), float(segment.high)]
        enters |= number > 0 or bool(
            np.nan_to_num(samples.slopes).any() or (samples.values != samples.values[:1]).any()
        )
        missing = ~np.isin(segment.points, samples.points) & (np.abs(segment.points) > segment.least)
        sided &= not missing[1:-1].any()
        if not len(samples.points):
            if segment.high > segment.low:
                whole = False
                undecided.append((float(segment.low), float(segment.high)))
            continue
        samples, local = _with_ends_beside(segment, samples)
        alone += local
        side = (samples.log_radius < 0).tolist()
        if stable and stable[-1] != side[0]:
            assert before is not None, "a side comes of a stretch"
            edges.append(line.change(before, segment, stable_below=stable[-1]))
        if not stable or stable[-1] != side[0]:
            stable.append(side[0])
        for index in range(len(side) - 1):
            if side[index] != side[index + 1]:
                around = samples.points[max(index - 1, 0) : index + 3].tolist()
                crossing = _crossing(
                    segment,
                    samples.points[index : index + 2].tolist(),
                    (around[0], around[-1]),
                    samples.log_radius[index : index + 2].tolist(),
                    rising=side[index],
                    half=FIRST_HALF if first else HALF,
                )
                if crossing is not None:
                    edges.append(crossing)
                    stable.append(side[index + 1])
        before = segment
        if why or (first and any(edge.stable_side == "below" for edge in edges)):
            break
    scanned = (ends[0], ends[-1]) if ends else (math.nan, math.nan)
    return CrossingReport(
        edges=tuple(edges),
        stable=tuple(stable),
        searched_to=scanned,
        complete=whole,
        evaluations=evaluations,
        has_effect=enters,
        classified=sided,
        undecided=tuple(undecided),
        why=why,
        isolated=tuple(alone),
    )


def _scanned(segment: SmoothSegment, *, first: bool) -> tuple[_Samples, bool, str]:
    """Return the samples of a segment that have a side, after division of cells with possible crossings.

    Also, whether every cell was resolved, and why the search of the segment ended early.
    """
    samples, why = _begun(segment, first=first)
    samples = _classified(samples)
    new = np.ones(len(samples.points), dtype=bool)
    spacing = np.diff(segment.points, append=np.inf)
    for _ in range(MOST_LEVELS):
        low, high = samples.points[:-1], samples.points[1:]
        index = np.searchsorted(segment.points[:-1], low, side="right") - 1
        size = np.maximum(np.maximum(np.abs(low), np.abs(high)), segment.least)
        cells = (new[:-1] | new[1:]) & (high - low > np.minimum(CELL * size, SHARE * spacing[index]))
        if first:
            rising = np.flatnonzero((samples.log_radius[:-1] < 0) & (samples.log_radius[1:] > 0))
            cells[rising[0] + 1 if len(rising) else len(cells) :] = False
        cells[cells] = _may_hide(samples, np.flatnonzero(cells))
        if not cells.any():
            return samples, True, why
        if cells.sum() > MOST_OPEN:
            break
        share = np.arange(1, PARTS) / PARTS
        between = (low[cells, None] + (high - low)[cells, None] * share).ravel()
        more = _classified(_sampled(segment, between), ends=False)
        samples = samples.merged(more)
        new = np.isin(samples.points, more.points)
    return samples, False, why


def _begun(segment: SmoothSegment, *, first: bool) -> tuple[_Samples, str]:
    """Return the samples at the first points, as far as required, and the reason of an early end."""
    if not (first and segment.slow):
        return _sampled(segment, segment.points), ""
    samples = _sampled(segment, segment.points[:1])
    for point in segment.points[1:]:
        try:
            samples = samples.merged(_sampled(segment, np.array([point])))
        except ApcError as error:
            return samples, error.mistakes[0].message
        growth = samples.log_radius
        if growth[-1] >= 0 > growth[0] or (len(growth) == STILL and np.ptp(growth) == 0):
            break
    return samples, ""


def _sampled(segment: SmoothSegment, points: Floats) -> _Samples:
    """Return the samples at points that have eigenvalues."""
    values, slopes = segment.sample_at(points)
    known = np.isfinite(values).all(axis=1)
    return _Samples(points[known], values[known], slopes[known])


def _classified(samples: _Samples, *, ends: bool = True) -> _Samples:
    """Return the samples on one side of the circle; the first and last also by their neighbourhood.

    There an eigenvalue on the circle is moved in the direction of its slope inside the segment: for example
    where a stiffness vanishes, and a motion has no restoring force.
    """
    values = samples.values
    sure = np.abs(np.abs(values).max(axis=1, initial=0.0) - 1) > UNSURE
    if ends and len(sure) > 1 and not sure[[0, -1]].all():
        values = values.copy()
        for index, direction in ((0, 1), (-1, -1)):
            if sure[index]:
                continue
            on = np.abs(np.abs(values[index]) - 1) <= UNSURE
            leaving = direction * np.sign((values[index].conj() * samples.slopes[index]).real)
            if leaving[on].all() and np.isfinite(leaving[on]).all():
                values[index][on] *= 1 + 2 * UNSURE * leaving[on]
                sure[index] = True
    return _Samples(samples.points, values, samples.slopes).chosen(sure)


def _may_hide(samples: _Samples, cells: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return for the cells that begin at these samples whether they may contain another crossing."""
    shares = np.linspace(0, 1, LOCATIONS)[:, None]
    values = np.zeros(len(cells), dtype=bool)
    if not samples.values.shape[1]:  # nothing moves: clamped devices, for example
        return values
    for number, index in enumerate(cells):
        width = samples.points[index + 1] - samples.points[index]
        (value, end), (slope, end_slope) = (
            samples.values[index : index + 2],
            samples.slopes[index : index + 2],
        )
        slope, end_slope = slope * width, end_slope * width
        if not (np.isfinite(slope).all() and np.isfinite(end_slope).all()):
            continue
        miss = np.abs((value + slope / 2)[:, None] - (end - end_slope / 2))
        partner, uncertainty = miss.argmin(axis=1), miss.min(axis=1) / 2
        path = _cubic(shares, value, end[partner], slope, end_slope[partner])
        size = np.abs(path)
        most, least = size.max(axis=0) + uncertainty, size.min(axis=0) - uncertainty
        if (most < 1).all() or (least > 1).any():
            continue
        changes = np.abs(np.diff((size > 1).astype(np.int8), axis=0)).sum(axis=0)
        through = (changes == 1) & (uncertainty < np.abs(size[-1] - size[0]))
        touches = (most >= 1) & (least <= 1) & ~through
        values[number] = touches.any() or (through & (value.imag >= 0)).sum() > 1
    return values


def _cubic(t: Floats, start: Complexes, end: Complexes, slope: Complexes, end_slope: Complexes) -> Complexes:
    """Return the cubics with these values and slopes at 0 and 1 (n,) at shares (k, 1)."""
    straight = (1 + 2 * t) * (1 - t) ** 2 * start + t**2 * (3 - 2 * t) * end
    return np.asarray(straight + t * (1 - t) ** 2 * slope + t**2 * (t - 1) * end_slope)


def _with_ends_beside(segment: SmoothSegment, samples: _Samples) -> tuple[_Samples, list[float]]:
    """Return the samples with an end replaced by a point just inside, where the verdict changes next to it.

    Also, the ends at which the verdict differs from that just inside.
    """
    alone = []
    for index, next_index, direction in ((0, 1, 1), (-1, -2, -1)):
        stable = samples.log_radius < 0
        if len(stable) < 2 or stable[index] == stable[next_index]:
            continue
        end = float(samples.points[index])
        near_end = end + direction * INWARDS * max(abs(end), segment.least)
        inside = _classified(_sampled(segment, np.array([near_end])), ends=False)
        if len(inside.points) and (inside.log_radius[0] < 0) == stable[next_index]:
            at_end = replace(inside, points=np.array([end]))
            others = samples.points != end
            samples = samples.chosen(others).merged(at_end)
            alone.append(end)
    return samples, alone


def _crossing(
    segment: SmoothSegment,
    ends: Sequence[float],
    limits: tuple[float, float],
    growth: Sequence[float],
    *,
    rising: bool,
    half: float,
) -> Crossing | None:
    """Return the crossing between two values with its bracket; None where both sides have one verdict.

    `growth` are the logarithms of the spectral radius at the ends, `limits` the samples before and behind
    these, which limit the bracket: a crossing may lie on an end. `half` is half the width of the first
    bracket, relative to the value.
    """
    value = _root(segment, ends, growth, half)
    side = "below" if rising else "above"
    width = half * (abs(value) or ends[1] - ends[0])
    low, high = limits
    for _ in range(TRIES):
        left, right = max(value - width, low), min(value + width, high)
        grows = segment.verdict_at(Fraction(right if rising else left))
        # Where one side is undecided the other decides nothing, and its proof takes as long.
        dies = grows if grows.stable is None else segment.verdict_at(Fraction(left if rising else right))
        below, above = (dies, grows) if rising else (grows, dies)
        if below.stable is rising and above.stable is (not rising):
            return _bracketed(segment, *_narrowed(segment, left, right, (below, above), rising=rising), side)
        if None not in (below.stable, above.stable) and width > NOWHERE * abs(value):
            return _bisected(segment, ends, rising=rising, half=half)
        if (left, right) == (low, high):
            break
        if below.stable == above.stable is not None:
            # The error in floats exceeds the bracket; the bounded values give a better one.
            moved = above.radius - below.radius
            sure = abs(moved) > below.error + above.error
            nearer = left + (right - left) * (1 - below.radius) / moved if sure else math.nan
            if low < nearer < high:
                value = nearer
                continue
        width *= WIDER
    return Crossing(value, min(width, high - low), side, grows.frequency_hz, "crossing", ESTIMATE)


def _bisected(segment: SmoothSegment, ends: Sequence[float], *, rising: bool, half: float) -> Crossing | None:
    """Return a crossing by bisection with verdicts, None where both ends have one verdict or none."""
    left, right = ends
    below, above = (segment.verdict_at(Fraction(end)) for end in ends)
    if not (below.stable is rising and above.stable is (not rising)):
        return None
    for _ in range(HALVINGS):
        middle = (left + right) / 2
        if right - left <= 2 * half * abs(middle):
            break
        at = segment.verdict_at(Fraction(middle))
        if at.stable is None:
            break
        if at.stable is rising:
            left, below = middle, at
        else:
            right, above = middle, at
    narrowed = _narrowed(segment, left, right, (below, above), rising=rising)
    return _bracketed(segment, *narrowed, "below" if rising else "above")


def _narrowed(
    segment: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], *, rising: bool
) -> tuple[float, float, tuple[Verdict, Verdict]]:
    """Return a bracket narrowed from both ends as far as verdicts decide, with the verdicts at its ends.

    Parameters
    ----------
    segment
        The segment that contains the bracket.
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
        verdict = segment.verdict_at(Fraction(middle))
        if verdict.stable is None:
            undecided = (min(middle, first), max(middle, last)) if undecided else (middle, middle)
        elif verdict.stable is rising and (at_left or undecided is None):
            left, below = middle, verdict
        elif verdict.stable is not rising and not at_left:
            right, above = middle, verdict
        else:  # another crossing
            break
    return _within_resolution(segment, left, right, (below, above), rising=rising)


def _within_resolution(
    segment: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], *, rising: bool
) -> tuple[float, float, tuple[Verdict, Verdict]]:
    """Return a bracket of half width at most RESOLUTION of its middle, if verdicts at that distance decide.

    Parameters
    ----------
    segment, left, right, verdicts, rising
        As for `_narrowed`.
    """
    below, above = verdicts
    for _ in range(NARROWINGS):
        middle = (left + right) / 2
        reach = RESOLUTION * abs(middle)
        if right - left <= 2 * reach:
            break
        lower, upper = (
            segment.verdict_at(Fraction(middle - reach)),
            segment.verdict_at(Fraction(middle + reach)),
        )
        from_left = lower.stable is rising
        from_right = upper.stable is (not rising)
        if from_left:
            left, below = middle - reach, lower
        if from_right:
            right, above = middle + reach, upper
        if from_left is from_right:  # narrowed from both sides, or undecided on both
            break
    return left, right, (below, above)


def _bracketed(
    segment: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], side: str
) -> Crossing:
    """Return the crossing between two values of these verdicts, the stable one on a side."""
    dies, grows = verdicts if side == "below" else verdicts[::-1]
    bits = next((verdict.proof.bits for verdict in verdicts if verdict.proof.bits), 0)
    bounded = grows.proof or StabilityProof(ProofMethod.BOUNDED)
    proof = StabilityProof(ProofMethod.BALLS, bits) if bits else bounded
    middle, kind, at = (left + right) / 2, "crossing", None
    change = grows.radius - dies.radius - grows.error - dies.error
    if right - left < JUMP * abs(middle) and change > JUMP:
        # A discontinuity of the radius, for example where a contact closes, at a value of few digits.
        exact = shortest_decimal(left, right)
        middle, kind, at = float(exact), "jump", segment.verdict_at(exact).stable
    error = max(right - middle, middle - left)
    return Crossing(middle, error, side, grows.frequency_hz, kind, proof, at)


def shortest_decimal(low: float, high: float) -> Fraction:
    """Return the decimal number of the fewest digits after the point in [low, high], low ≤ high."""
    least, most, digits = Fraction(low), Fraction(high), 0
    while (number := math.ceil(least * 10**digits)) > most * 10**digits:
        digits += 1
    return Fraction(number, 10**digits)


def _root(
    segment: SmoothSegment, ends: Sequence[float], growth: Sequence[float], error_bound: float
) -> float:
    """Return the value at which the largest magnitude in floats passes 1 between two ends, and its error.

    By Newton's method or, where that leaves the ends or there are no slopes, Brent's.
    """
    known = {end: (height, math.nan) for end, height in zip(ends, growth, strict=True)}

    def at(value: float) -> tuple[float, float]:
        if value not in known:
            result = _sampled(segment, np.array([value]))
            if len(result.points):
                largest = np.argmax(np.abs(result.values[0]))
                rate = result.slopes[0, largest] / result.values[0, largest]
                known[value] = float(result.log_radius[0]), float(rate.real)
            else:  # no matrix: its neighbours are analysed
                known[value] = 0.0, math.nan
        return known[value]

    (low, high), (at_low, at_high) = ends, growth
    value = low + (high - low) * at_low / (at_low - at_high)
    for _ in range(NEWTON):
        height, rate = at(value)
        new = value - height / rate if rate else math.nan
        if not low <= new <= high:
            break
        if abs(new - value) <= error_bound * abs(new):
            return new
        value = new
    # Imported where Newton's method fails: the import takes as long as an analysis.
    brentq = load_pool("scipy.optimize").brentq
    nearest = error_bound / 100
    # Where it ends early, as between adjacent floats, verdicts use the last bracket.
    return float(
        brentq(
            lambda value: at(value)[0],
            low,
            high,
            xtol=nearest * segment.least or math.ulp(0.0),
            rtol=max(nearest, 4 * np.finfo(float).eps),
            maxiter=BRENT,
            disp=False,
        )
    )
