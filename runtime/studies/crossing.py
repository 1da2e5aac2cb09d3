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
from apc.support.threads import load_pool
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

# Half the width of the first bracket, relative to the value; the growth of the next one if it is undecided.
HALF, WIDER, TRIES = 1e-13, 4.0, 24

# The same if only the first loss of stability is searched: verdicts in floats mostly bracket it.
FIRST_HALF = 1e-10

# Limits of steps of Newton's method, of Brent's, and of a bisection by verdicts.
NEWTON, BRENT, HALVINGS = 12, 200, 60

# The distance inside a segment at which its ends are sampled if the verdict changes in the next cell,
# relative to the value or the smallest size.
INWARDS = 1e-9

# The logarithm of a spectral radius that is clearly off the circle: an analysis decides it without matrices.
# The multiple of its error from the crossing at which verdicts are decided: at 1.03 the errors of both ends,
# which differ by some percent, leave one undecided.
AWAY, CLEARLY = 1e-9, 1.1

# The radius is discontinuous in a bracket narrower than this, relative to the value, if it changes by more
# than this, beyond its errors.
JUMP = 1e-6

# A bracket of this width, relative to the value, with equal verdicts on both sides has no crossing.
NOWHERE = 1e-6

# A bracket wider than this, relative to the value, is narrowed by at most this number of verdicts.
WIDE, NARROWINGS = 1e-7, 24

# An error above this, relative to the value, remains only if verdicts at this distance are undecided.
RESOLUTION = 9.9e-7

# The note on a crossing between two periods of a clock.
PERIOD = "period"

# The proof outcome of a crossing without bounds.
ESTIMATE = StabilityProof(ProofMethod.ESTIMATED)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict at one value: `stable` is None if undecided.

    `radius` is the spectral radius, with the bound `error` on its error, NaN without a bound; `frequencies`
    contains the frequency of the dominant mode in Hz, and is empty without modes; `proof` is the method of
    the proof.
    """

    stable: bool | None
    radius: float
    error: float
    frequencies: Sequence[float]
    proof: StabilityProof

    @property
    def frequency_hz(self) -> float:
        """The frequency of the dominant mode, NaN without modes."""
        return self.frequencies[0] if len(self.frequencies) else math.nan


@dataclass(frozen=True, slots=True)
class Crossing:
    """A value at which the spectral radius crosses 1, with `error`, both in SI.

    `stable_side` is "below" or "above"; `frequency_hz` is that of the unstable mode. `kind` is "crossing";
    "jump" where the radius is discontinuous (a packet arrives a tick later, events change their order, or a
    contact closes); "count" for a number of peers, the last one on the stable side; or "period" between two
    clock periods, where no period between them has a short enough frame. `proof` is the method by which the
    value is known. `stable_at` is the verdict at the value of a jump, None for other kinds or if undecided.
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
        """The value at which the verdict changes; for a count, halfway to the next count."""
        if self.kind != "count":
            return self.value
        return self.value + (0.5 if self.stable_side == "below" else -0.5)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothSegment:
    """Values from `low` to `high` with continuous eigenvalues; the ends are one-sided limits.

    `points` (k,) are the first samples; cell widths are relative to the value, or to `least` for smaller
    values. `sample_at` returns the eigenvalues (k, n) and their slopes (k, n) at values (k,), NaN if
    undefined; `verdict_at` the verdict of an analysis at a value. `slow`: each value is expensive.
    `decided_at` returns the verdicts at several values that one evaluation decides, None for the others.
    `quick_at` returns a verdict without error bounds, for segments whose samples have no slopes.
    """

    low: Fraction
    high: Fraction
    points: Floats
    least: float
    sample_at: Callable[[Floats], tuple[Complexes, Complexes]]
    verdict_at: Callable[[Fraction], Verdict]
    slow: bool = False
    decided_at: Callable[[Sequence[Fraction]], Sequence[Verdict | None]] | None = None
    quick_at: Callable[[Fraction], Verdict] | None = None

    def verdicts_at(self, first: Fraction, second: Fraction) -> tuple[Verdict, Verdict]:
        """Return the verdicts at two values; the second one is undecided if the first one is.

        Where the common evaluation does not decide, the values are analyzed separately.
        """
        known = self.decided_at((first, second)) if self.decided_at else (None, None)
        first_verdict = known[0] or self.verdict_at(first)
        if first_verdict.stable is None:  # a proof of the second verdict would take as long
            return first_verdict, first_verdict
        return first_verdict, known[1] or self.verdict_at(second)


class ParameterPath(Protocol):
    """The protocol of a model along one of its parameters, named by `label`."""

    @property
    def label(self) -> str:
        """The name of the parameter that varies."""

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the segments of the path in order."""

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the crossing between two segments with different verdicts.

        With `stable_below` the first segment is stable.
        """


class SingleSegment:
    """The base of a path with one segment."""

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Raise an assertion error: a path of one segment has no crossing between segments."""
        raise AssertionError("a path of one segment has no jump")


@dataclass(frozen=True, slots=True)
class CrossingReport:
    """All crossings along one parameter in an interval, with the verdicts between them.

    `crossings` are in order, and `stable` holds the verdicts of the intervals between them, one more than
    there are crossings; empty if no sample has a verdict. `evaluations` is the number of evaluations;
    `complete` is False if an eigenvalue is so near to the circle that some cell could not be resolved;
    `has_effect` states whether an eigenvalue changed, or the path has several segments; `classified` whether
    each first sample, except samples next to 0, has a verdict; `undecided` are the undecided intervals; `why`
    is the reason if the search ended early. `isolated` are ends of a segment at which the verdict differs
    from that at all neighbouring values: for example a stiffness of 0.
    """

    crossings: tuple[Crossing, ...]
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
    """Samples of a segment: values in order (k,), the eigenvalues there (k, n) and their slopes (k, n)."""

    points: Floats
    values: Complexes
    slopes: Complexes

    @property
    def log_radius(self) -> Floats:
        """The logarithm of the spectral radius (k,)."""
        return np.asarray(np.log(np.abs(self.values).max(axis=1, initial=1e-300)))

    def chosen(self, mask: NDArray[np.bool_]) -> _Samples:
        """Return the samples selected by a mask (k,)."""
        return _Samples(self.points[mask], self.values[mask], self.slopes[mask])

    def merged(self, further_samples: _Samples) -> _Samples:
        """Return the union of two sets of samples; rows with fewer states are padded with zeros."""
        width = max(self.values.shape[1], further_samples.values.shape[1])

        def padded_rows(values: Complexes, further: Complexes) -> Complexes:
            """Return the rows of two arrays, padded to a common width."""
            rows = [np.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in (values, further)]
            return np.concatenate(rows)

        points = np.concatenate([self.points, further_samples.points])
        order = np.argsort(points, kind="stable")
        values, slopes = (
            padded_rows(self.values, further_samples.values),
            padded_rows(self.slopes, further_samples.slopes),
        )
        return _Samples(points[order], values[order], slopes[order])


def stable_in_all(searches: Sequence[CrossingReport]) -> CrossingReport:
    """Return the report on the values at which all of several models are stable.

    Parameters
    ----------
    searches
        The report of each model along the same parameter; a model without motion has no effect.
    """
    if len(searches) == 1:
        return searches[0]
    for report in searches:
        if not report.stable and (report.undecided or not report.complete):
            return report  # undecided at every value
    decided = [report for report in searches if report.stable]
    ordered_crossings = sorted(
        ((crossing.value, n, crossing) for n, report in enumerate(decided) for crossing in report.crossings),
        key=itemgetter(0, 1),
    )
    interval_of = [0] * len(decided)
    crossings: list[Crossing] = []
    stable = [all(report.stable[0] for report in decided)] if decided else []
    for _, n, crossing in ordered_crossings:
        interval_of[n] += 1
        all_stable = all(report.stable[index] for report, index in zip(decided, interval_of, strict=True))
        if all_stable is not stable[-1]:
            crossings.append(crossing)
            stable.append(all_stable)
    return CrossingReport(
        crossings=tuple(crossings),
        stable=tuple(stable),
        searched_to=(
            max(report.searched_to[0] for report in searches),
            min(report.searched_to[1] for report in searches),
        ),
        complete=all(report.complete for report in searches),
        evaluations=sum(report.evaluations for report in searches),
        has_effect=any(report.has_effect for report in searches),
        classified=all(report.classified for report in searches),
        undecided=tuple(dict.fromkeys(gap for report in searches for gap in report.undecided)),
        why=next((report.why for report in searches if report.why), ""),
        isolated=tuple(dict.fromkeys(value for report in searches for value in report.isolated)),
    )


def search(path: ParameterPath, *, first: bool = False, progress: Progress | None = None) -> CrossingReport:
    """Return the crossings along a path, with the verdicts between them.

    Parameters
    ----------
    path
        The model along one of its parameters.
    first
        Whether to stop at the first loss of stability, or at the first value without a verdict.
    progress
        Receives the progress of the search.
    """
    crossings: list[Crossing] = []
    stable: list[bool] = []
    undecided: list[tuple[float, float]] = []
    ends: list[float] = []
    isolated: list[float] = []
    evaluations, complete, has_effect, classified, why = 0, True, False, True, ""
    previous: SmoothSegment | None = None
    for number, segment in enumerate(path.smooth_segments()):
        samples, segment_complete, why = _scan_segment(segment, first=first)
        evaluations, complete = evaluations + len(samples.points), complete and segment_complete
        if progress:
            progress(f"{counted(evaluations, 'value')} of {path.label} evaluated")
        if len(segment.points) > 1 and len(samples.points):
            ends += samples.points[[0, -1]].tolist()
        else:
            ends += [float(segment.low), float(segment.high)]
        has_effect |= number > 0 or bool(
            np.nan_to_num(samples.slopes).any() or (samples.values != samples.values[:1]).any()
        )
        missing = ~np.isin(segment.points, samples.points) & (np.abs(segment.points) > segment.least)
        classified &= not missing[1:-1].any()
        if not len(samples.points):
            complete = complete and segment.high == segment.low
            undecided.append((float(segment.low), float(segment.high)))
            continue
        beyond = segment.points[segment.points > samples.points[-1]]
        if segment.slow and not first and len(beyond):
            undecided.append((float(samples.points[-1]), float(beyond[-1])))
        samples, isolated_ends = _with_inner_ends(segment, samples)
        isolated += isolated_ends
        stable_at = (samples.log_radius < 0).tolist()
        if stable and stable[-1] != stable_at[0]:
            assert previous is not None, "a verdict comes from a segment"
            crossings.append(path.change(previous, segment, stable_below=stable[-1]))
        if not stable or stable[-1] != stable_at[0]:
            stable.append(stable_at[0])
        for index in range(len(stable_at) - 1):
            if stable_at[index] != stable_at[index + 1]:
                neighbours = samples.points[max(index - 1, 0) : index + 3].tolist()
                crossing = _crossing_between(
                    segment,
                    samples.points[index : index + 2].tolist(),
                    (neighbours[0], neighbours[-1]),
                    samples.log_radius[index : index + 2].tolist(),
                    rising=stable_at[index],
                    half_width=FIRST_HALF if first else HALF,
                )
                if crossing is not None:
                    crossings.append(crossing)
                    stable.append(stable_at[index + 1])
                    if first and crossing.stable_side == "below":
                        break
        previous = segment
        if why or (first and any(item.stable_side == "below" for item in crossings)):
            break
    searched_to = (ends[0], ends[-1]) if ends else (math.nan, math.nan)
    return CrossingReport(
        crossings=tuple(crossings),
        stable=tuple(stable),
        searched_to=searched_to,
        complete=complete,
        evaluations=evaluations,
        has_effect=has_effect,
        classified=classified,
        undecided=tuple(undecided),
        why=why,
        isolated=tuple(isolated),
    )


def _scan_segment(segment: SmoothSegment, *, first: bool) -> tuple[_Samples, bool, str]:
    """Return the samples of a segment, with cells divided that may contain crossings.

    `first` limits the division to values up to the first loss of stability.

    Returns
    -------
    _Samples
        The samples that have a verdict.
    bool
        Whether every cell was resolved.
    str
        The reason if the search of the segment ended early, else empty.
    """
    samples, why = _first_samples(segment, first=first)
    samples = _with_verdict(samples)
    is_new = np.ones(len(samples.points), dtype=bool)
    spacing = np.diff(segment.points, append=np.inf)
    for _ in range(MOST_LEVELS):
        low, high = samples.points[:-1], samples.points[1:]
        cell_of_segment = np.searchsorted(segment.points[:-1], low, side="right") - 1
        size = np.maximum(np.maximum(np.abs(low), np.abs(high)), segment.least)
        cells = (is_new[:-1] | is_new[1:]) & (
            high - low > np.minimum(CELL * size, SHARE * spacing[cell_of_segment])
        )
        if first:
            rising = np.flatnonzero((samples.log_radius[:-1] < 0) & (samples.log_radius[1:] > 0))
            cells[rising[0] + 1 if len(rising) else len(cells) :] = False
        cells[cells] = _may_contain_crossings(samples, np.flatnonzero(cells))
        if not cells.any():
            return samples, True, why
        if cells.sum() > MOST_OPEN:
            break
        positions = np.arange(1, PARTS) / PARTS
        inner_points = (low[cells, None] + (high - low)[cells, None] * positions).ravel()
        further = _with_verdict(_samples_at(segment, inner_points), ends=False)
        samples = samples.merged(further)
        is_new = np.isin(samples.points, further.points)
    return samples, False, why


def _first_samples(segment: SmoothSegment, *, first: bool) -> tuple[_Samples, str]:
    """Return the samples at a segment's points, and the message of an error that ended them.

    For the first crossing of a slow segment, `first`, points are sampled up to the first bracket only.
    """
    if not (first and segment.slow):
        return _samples_at(segment, segment.points), ""
    samples = _samples_at(segment, segment.points[:1])
    for point in segment.points[1:]:
        try:
            samples = samples.merged(_samples_at(segment, np.array([point])))
        except ApcError as error:
            return samples, error.mistakes[0].message
        # A sample next to the circle, as at a limit that is known already, is no end of a bracket.
        if samples.log_radius[-1] > AWAY and samples.log_radius[0] < 0:
            break
    return samples, ""


def _samples_at(segment: SmoothSegment, points: Floats) -> _Samples:
    """Return the samples at the points that have finite eigenvalues."""
    values, slopes = segment.sample_at(points)
    known = np.isfinite(values).all(axis=1)
    return _Samples(points[known], values[known], slopes[known])


def _with_verdict(samples: _Samples, *, ends: bool = True) -> _Samples:
    """Return the samples with a magnitude clearly above or below 1.

    At the first and last sample, eigenvalues on the circle are moved in the direction of their slopes inside
    the segment: for example at a stiffness of 0, where a motion has no restoring force.
    """
    values = samples.values
    decided = np.abs(np.abs(values).max(axis=1, initial=0.0) - 1) > UNSURE
    if ends and len(decided) > 1 and not decided[[0, -1]].all():
        values = values.copy()
        for index, direction in ((0, 1), (-1, -1)):
            if decided[index]:
                continue
            on_circle = np.abs(np.abs(values[index]) - 1) <= UNSURE
            outward = direction * np.sign((values[index].conj() * samples.slopes[index]).real)
            if outward[on_circle].all() and np.isfinite(outward[on_circle]).all():
                values[index][on_circle] *= 1 + 2 * UNSURE * outward[on_circle]
                decided[index] = True
    return _Samples(samples.points, values, samples.slopes).chosen(decided)


def _may_contain_crossings(samples: _Samples, cells: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return for the cells that begin at these samples whether they may contain further crossings."""
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
        mismatch = np.abs((value + slope / 2)[:, None] - (end - end_slope / 2))
        partner, uncertainty = mismatch.argmin(axis=1), mismatch.min(axis=1) / 2
        path = _cubic(shares, value, end[partner], slope, end_slope[partner])
        magnitudes = np.abs(path)
        upper, lower = magnitudes.max(axis=0) + uncertainty, magnitudes.min(axis=0) - uncertainty
        if (upper < 1).all() or (lower > 1).any():
            continue
        changes = np.abs(np.diff((magnitudes > 1).astype(np.int8), axis=0)).sum(axis=0)
        crosses_once = (changes == 1) & (uncertainty < np.abs(magnitudes[-1] - magnitudes[0]))
        touches = (upper >= 1) & (lower <= 1) & ~crosses_once
        values[number] = touches.any() or (crosses_once & (value.imag >= 0)).sum() > 1
    return values


def _cubic(t: Floats, start: Complexes, end: Complexes, slope: Complexes, end_slope: Complexes) -> Complexes:
    """Return the cubics (k, n) with these values and slopes at 0 and 1 (n,), at positions t (k, 1)."""
    of_values = (1 + 2 * t) * (1 - t) ** 2 * start + t**2 * (3 - 2 * t) * end
    return np.asarray(of_values + t * (1 - t) ** 2 * slope + t**2 * (t - 1) * end_slope)


def _with_inner_ends(segment: SmoothSegment, samples: _Samples) -> tuple[_Samples, list[float]]:
    """Return the samples with isolated ends replaced by a point just inside, and these ends.

    An end is isolated if its verdict differs from the verdict just inside the segment.
    """
    isolated = []
    for index, next_index, direction in ((0, 1, 1), (-1, -2, -1)):
        stable = samples.log_radius < 0
        if len(stable) < 2 or stable[index] == stable[next_index]:
            continue
        end = float(samples.points[index])
        near_end = end + direction * INWARDS * max(abs(end), segment.least)
        inner = _with_verdict(_samples_at(segment, np.array([near_end])), ends=False)
        if len(inner.points) and (inner.log_radius[0] < 0) == stable[next_index]:
            at_end = replace(inner, points=np.array([end]))
            not_end = samples.points != end
            samples = samples.chosen(not_end).merged(at_end)
            isolated.append(end)
    return samples, isolated


def _crossing_between(
    segment: SmoothSegment,
    ends: Sequence[float],
    limits: tuple[float, float],
    log_radii: Sequence[float],
    *,
    rising: bool,
    half_width: float,
) -> Crossing | None:
    """Return the crossing between two values; None if both sides have the same verdict.

    Parameters
    ----------
    segment
        The segment.
    ends
        The two values.
    limits
        The neighbouring samples, which limit the bracket: a crossing may lie on an end.
    log_radii
        The logarithms of the spectral radius at the ends.
    rising
        Whether the spectral radius increases through 1.
    half_width
        Half the width of the first bracket, relative to the value.
    """
    value, uncertainty = _crossing_in_floats(segment, ends, log_radii, half_width)
    side = "below" if rising else "above"
    width = max(half_width * (abs(value) or ends[1] - ends[0]), uncertainty)
    low, high = limits
    for _ in range(TRIES):
        left, right = max(value - width, low), min(value + width, high)
        sides = Fraction(left), Fraction(right)
        unstable_verdict, stable_verdict = segment.verdicts_at(*(sides[::-1] if rising else sides))
        below, above = (stable_verdict, unstable_verdict) if rising else (unstable_verdict, stable_verdict)
        if below.stable is rising and above.stable is (not rising):
            return _crossing_of_bracket(
                segment, *_narrow_bracket(segment, left, right, (below, above), rising=rising), side
            )
        if None not in (below.stable, above.stable) and width > NOWHERE * abs(value):
            return _crossing_by_bisection(segment, ends, rising=rising, half_width=half_width)
        if (left, right) == (low, high):
            break
        if below.stable == above.stable is not None:
            # The error in floats exceeds the bracket; the bounded values give a better one.
            difference = above.radius - below.radius
            clear_change = abs(difference) > below.error + above.error
            interpolated = (
                left + (right - left) * (1 - below.radius) / difference if clear_change else math.nan
            )
            if low < interpolated < high:
                value = interpolated
                continue
        width *= WIDER
    return Crossing(value, min(width, high - low), side, unstable_verdict.frequency_hz, "crossing", ESTIMATE)


def _crossing_by_bisection(
    segment: SmoothSegment, ends: Sequence[float], *, rising: bool, half_width: float
) -> Crossing | None:
    """Return a crossing by bisection with verdicts, None unless both ends have the expected verdicts.

    Parameters
    ----------
    segment, ends
        The segment, and two values with a crossing between them.
    rising
        Whether the spectral radius increases through 1.
    half_width
        Half the width of the bracket at which the bisection ends, relative to the value.
    """
    left, right = ends
    below, above = (segment.verdict_at(Fraction(end)) for end in ends)
    if not (below.stable is rising and above.stable is (not rising)):
        return None
    for _ in range(HALVINGS):
        middle = (left + right) / 2
        if right - left <= 2 * half_width * abs(middle):
            break
        middle_verdict = segment.verdict_at(Fraction(middle))
        if middle_verdict.stable is None:
            break
        if middle_verdict.stable is rising:
            left, below = middle, middle_verdict
        else:
            right, above = middle, middle_verdict
    narrowed = _narrow_bracket(segment, left, right, (below, above), rising=rising)
    return _crossing_of_bracket(segment, *narrowed, "below" if rising else "above")


def _narrow_bracket(
    segment: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], *, rising: bool
) -> tuple[float, float, tuple[Verdict, Verdict]]:
    """Return a bracket narrowed from both ends by verdicts, with the verdicts at its ends.

    Parameters
    ----------
    segment
        The segment that contains the bracket.
    left, right, verdicts
        The bracket, and the verdicts at its ends.
    rising
        Whether the left end is stable.
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
    return _narrow_to_resolution(segment, left, right, (below, above), rising=rising)


def _narrow_to_resolution(
    segment: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], *, rising: bool
) -> tuple[float, float, tuple[Verdict, Verdict]]:
    """Return a bracket of half width at most RESOLUTION of its middle, if the verdicts there are decided.

    Parameters
    ----------
    segment, left, right, verdicts, rising
        As for `_narrow_bracket`.
    """
    below, above = verdicts
    for _ in range(NARROWINGS):
        middle = (left + right) / 2
        half_width = RESOLUTION * abs(middle)
        if right - left <= 2 * half_width:
            break
        lower, upper = (
            segment.verdict_at(Fraction(middle - half_width)),
            segment.verdict_at(Fraction(middle + half_width)),
        )
        from_left = lower.stable is rising
        from_right = upper.stable is (not rising)
        if from_left:
            left, below = middle - half_width, lower
        if from_right:
            right, above = middle + half_width, upper
        if from_left is from_right:  # narrowed from both sides, or undecided on both
            break
    return left, right, (below, above)


def _crossing_of_bracket(
    segment: SmoothSegment, left: float, right: float, verdicts: tuple[Verdict, Verdict], side: str
) -> Crossing:
    """Return the crossing in a bracket with a stable and an unstable end.

    Parameters
    ----------
    segment, left, right
        The segment, and the ends of the bracket.
    verdicts
        The verdicts at both ends.
    side
        The side of the crossing on which the model is stable: "below" or "above".
    """
    stable_verdict, unstable_verdict = verdicts if side == "below" else verdicts[::-1]
    bits = next((verdict.proof.bits for verdict in verdicts if verdict.proof.bits), 0)
    unstable_proof = unstable_verdict.proof or StabilityProof(ProofMethod.BOUNDED)
    proof = StabilityProof(ProofMethod.BALLS, bits) if bits else unstable_proof
    middle, kind, stable_at = (left + right) / 2, "crossing", None
    change = unstable_verdict.radius - stable_verdict.radius - unstable_verdict.error - stable_verdict.error
    if right - left < JUMP * abs(middle) and change > JUMP:
        # A discontinuity of the radius, for example where a contact closes, at a value of few digits.
        exact = shortest_decimal(left, right)
        middle, kind, stable_at = float(exact), "jump", segment.verdict_at(exact).stable
    error = max(right - middle, middle - left)
    return Crossing(middle, error, side, unstable_verdict.frequency_hz, kind, proof, stable_at)


def shortest_decimal(low: float, high: float) -> Fraction:
    """Return the decimal number with the fewest digits after the point in [low, high], low ≤ high."""
    least, most, digits = Fraction(low), Fraction(high), 0
    while (number := math.ceil(least * 10**digits)) > most * 10**digits:
        digits += 1
    return Fraction(number, 10**digits)


def _crossing_in_floats(
    segment: SmoothSegment, ends: Sequence[float], log_radii: Sequence[float], tolerance: float
) -> tuple[float, float]:
    """Return the value between two ends at which the spectral radius in floats crosses 1, and how far it may
    be off because verdicts near it are undecided.

    By Newton's method, with the slope of a secant where there is none, or by Brent's method if it does not
    converge.

    Parameters
    ----------
    segment, ends
        The segment, and two values of it.
    log_radii
        The logarithms of the spectral radius at the ends, of different signs.
    tolerance
        The largest relative change of the value at which Newton's method ends.
    """
    cached = {end: (log_radius, math.nan) for end, log_radius in zip(ends, log_radii, strict=True)}

    def log_radius_at(value: float) -> tuple[float, float]:
        """Return the logarithm of the spectral radius at a value, and its slope."""
        if value not in cached and segment.quick_at is not None:
            verdict = segment.quick_at(Fraction(value))
            undecided = verdict.stable is None or not verdict.radius > 0
            cached[value] = 0.0 if undecided else math.log(verdict.radius), math.nan
        elif value not in cached:
            result = _samples_at(segment, np.array([value]))
            if len(result.points):
                largest = np.argmax(np.abs(result.values[0]))
                slope = result.slopes[0, largest] / result.values[0, largest]
                cached[value] = float(result.log_radius[0]), float(slope.real)
            else:  # without a matrix at this value, neighbouring values are analysed
                cached[value] = 0.0, math.nan
        return cached[value]

    root = _newton_root(log_radius_at, ends, log_radii, tolerance)
    if root is None:
        # Imported where Newton's method fails: the import takes as long as an analysis.
        brentq = load_pool("scipy.optimize").brentq
        root_tolerance = tolerance / 100
        # If the method ends early, for example between adjacent floats, verdicts use the last bracket.
        root = float(
            brentq(
                lambda value: log_radius_at(value)[0],
                *ends,
                xtol=root_tolerance * segment.least or math.ulp(0.0),
                rtol=max(root_tolerance, 4 * np.finfo(float).eps),
                maxiter=BRENT,
                disp=False,
            )
        )
    if segment.quick_at is None:
        return root, 0.0
    at_root, error = log_radius_at(root)[0], segment.quick_at(Fraction(root)).error
    if at_root and not math.isnan(error):
        return root, 0.0
    # By the slope to the nearest decided value, a stable one if there is one: a verdict of instability may
    # have only a wide bound.
    away = AWAY if math.isnan(error) else 0.0
    decided = [point for point, (log_radius, _) in cached.items() if abs(log_radius) > away]
    nearest = min(decided, key=lambda point: (cached[point][0] > 0, abs(point - root)))
    if math.isnan(error):  # a radius without a bound: that of the analysis there
        error = CLEARLY * segment.verdict_at(Fraction(nearest)).error
    return root, error * abs((nearest - root) / (cached[nearest][0] - at_root))


def _newton_root(
    function: Callable[[float], tuple[float, float]],
    ends: Sequence[float],
    values_at_ends: Sequence[float],
    tolerance: float,
) -> float | None:
    """Return the root of a function between two ends by Newton's method; None if it does not converge.

    A step that leaves the ends is replaced by the middle.

    Parameters
    ----------
    function
        The function, with its slope; NaN where there is none, and that of the last secant is used.
    ends, values_at_ends
        Two values with function values of different signs.
    tolerance
        The largest relative change of the value at which the method ends.
    """
    (low, high), (at_low, at_high) = ends, values_at_ends
    last, at_last = (low, at_low) if abs(at_low) < abs(at_high) else (high, at_high)
    value = low + (high - low) * at_low / (at_low - at_high)
    for _ in range(NEWTON):
        at_value, slope = function(value)
        if math.isnan(slope):
            slope = (at_value - at_last) / (value - last) if value != last else 0.0
        low, high = (value, high) if (at_value < 0) is (at_low < 0) else (low, value)
        last, at_last = value, at_value
        value = value - at_value / slope if slope else math.nan
        if not low <= value <= high:
            value = (low + high) / 2
        if abs(value - last) <= tolerance * abs(value):
            return value
    return None
