"""Parameter paths: a model along one of its parameters, with eigenvalues at many values and analyses.

Takes: a `NumericModel` and the parameter that varies.
Gives: `MatrixPath`, `AnalyzedPath`, `DelayPath`, `PeerCountPath`; `spread`, `SPAN`; `pointwise`, `analyzed`,
`verdict_of`, `OPEN`; `matrix_sample`, `delay_reach`.
Guarantees: `verdict_at` is the model's own analysis; `sample_at` its matrices in floats.
Does not: search (see `crossing`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze, lifted_classes
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef
from apc.spectrum.eigenpairs import eigenvalues
from apc.spectrum.modes import split
from apc.spectrum.rigid_modes import rigid_modes_of
from apc.studies.crossing import ESTIMATE, UNSURE, Crossing, SingleSegment, SmoothSegment, Verdict
from apc.studies.delay_segments import INSIDE, DelaySegment, borders, delay_segments
from apc.studies.dominant_eigenvalue import DrivingPart, dominant_at, parts_of
from apc.studies.frame_matrices import BatchEvaluator
from apc.studies.timing_values import delay_now, model_with_time
from apc.support.lazy import LazyTuple
from apc.verdict import NO_PROOF, ProofMethod, StabilityProof, StabilityVerdict

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LOCATION = SourceLocation("critical value")

# Default range: values from SPAN times smaller to SPAN times larger than the scale. The scale is the present
# value, or for 0 the change that would move an eigenvalue by 1 to first order.
SPAN = 1e3

# First samples per factor of 10; the minimum number of samples in a range; the number in a delay segment.
SAMPLES, FEWEST, PIECE_SAMPLES = 6, 17, 3

# The distance inside a delay segment, relative to its length, at which it is analysed instead of at its end,
# where the order of coincident events matters.
ALONGSIDE = Fraction(1, 10**6)

# The proofs of a jump, of a jump within undecided segments, and of a change between two counts.
EVENTS = StabilityProof(ProofMethod.COINCIDENT_EVENTS)
BETWEEN = StabilityProof(ProofMethod.OPEN_BETWEEN)
ANALYZED = StabilityProof(ProofMethod.BOTH_COUNTS)

# A spectral radius in floats closer to 1 than this, the error of a double eigenvalue, is replaced by that of
# an analysis.
NEAR = 1e-6

# The number of smallest counts that are all sampled; the ratio of consecutive larger samples.
EVERY, FURTHER = 32, 1.25

# The verdict where an analysis is impossible.
OPEN = Verdict(None, math.nan, math.inf, (), NO_PROOF)


def analyzed(numeric: NumericModel, changed: Model) -> Verdict:
    """Return the verdict with the values of a changed model, undecided if an analysis is impossible.

    A drift counts as stable: it exists on both sides of a crossing.
    """
    try:
        return verdict_of(analyze(numeric.at(changed)), drifting=True)
    except ApcError:
        return OPEN


def verdict_of(result: Analysis, *, drifting: bool | None = None) -> Verdict:
    """Return the verdict of an analysis; for a drift, `drifting` states whether it counts as stable."""
    stable = drifting if result.verdict is StabilityVerdict.DRIFTS else result.stable
    frequencies = LazyTuple(lambda: tuple(mode.frequency_hz for mode in result.modes[:1]))
    return Verdict(stable, result.spectral_radius, result.spectral_radius_error, frequencies, result.proof)


def classified(stable: bool | None) -> Verdict:
    """Return a verdict with a known side only, without a spectral radius."""
    return Verdict(stable, 0.5 if stable else 2.0, 0.0, (), NO_PROOF)


def spread(bottom: float, top: float, scale: float) -> Floats:
    """Return values from `bottom` to `top`, in equal ratios on each side of 0.

    `scale` limits the smallest.
    """

    def ratios(low: float, high: float) -> Floats:
        """Return values from low to high in equal ratios."""
        least = max(low, min(scale, high) / SPAN)
        count = max(FEWEST, math.ceil(SAMPLES * math.log10(high / least)) + 1) if high > least else 1
        return np.geomspace(least, high, count)

    parts = [np.array([bottom, top])]
    if bottom < 0:
        parts.append(-ratios(max(-top, 0.0), -bottom))
    if bottom < 0 < top:
        parts.append(np.zeros(1))
    if top > 0:
        parts.append(ratios(max(bottom, 0.0), top))
    return np.unique(np.concatenate(parts))


@dataclass(frozen=True, eq=False)
class MatrixPath(SingleSegment):
    """A path along one of an evaluator's free parameters, the others at `base` (m,), as one segment.

    `numeric` has the evaluator's model. `bottom` and `top` are the ends, None for those of `SPAN`.
    """

    evaluator: BatchEvaluator
    numeric: NumericModel
    base: Floats
    column: int
    bottom: float | None = None
    top: float | None = None

    @property
    def label(self) -> str:
        """The name of the parameter that varies."""
        return self.evaluator.free[self.column].label

    def point(self, value: float) -> Floats:
        """Return the point (m,) with this value of the parameter."""
        values = self.base.copy()
        values[self.column] = value
        return values

    def sample_at(self, values: Floats) -> tuple[Complexes, Complexes]:
        """Return the eigenvalues of all systems (k, n) and their slopes at values (k,)."""
        return matrix_sample(self.evaluator, np.array([self.point(value) for value in values]), self.column)

    def verdict_at(self, value: Fraction) -> Verdict:
        """Return the verdict of an analysis at a value."""
        change = Override(self.evaluator.free[self.column], value)
        return analyzed(self.numeric, apply(self.evaluator.model, [change]))

    @cached_property
    def _parts(self) -> tuple[tuple[DrivingPart, ...], tuple[NDArray[np.bool_], ...]]:
        """The strongly connected parts of the systems, and the possible nonzeros of each matrix."""
        return parts_of(self.evaluator)

    def decided_at(self, values: Sequence[Fraction]) -> list[Verdict | None]:
        """Return the verdicts at values that their matrices decide in one evaluation, None for the others."""
        result: list[Verdict | None] = [None] * len(values)
        free = self.evaluator.free[self.column]
        try:
            models = [
                self.numeric.at(apply(self.evaluator.model, [Override(free, value)])) for value in values
            ]
        except ApcError:  # an analysis at each value finds the cause
            return result
        valid, pairs = dominant_at(
            self.evaluator,
            *self._parts,
            lambda peer_class: np.array([model.vector(peer_class.peers.first) for model in models]),
            np.ones(len(values), dtype=np.bool_),
        )
        for row in np.flatnonzero(pairs.certain).tolist():
            radius, error = float(pairs.radius[row]), float(pairs.error[row])
            frequencies = (float(pairs.frequency_hz[row]),)
            result[valid[row]] = Verdict(radius < 1, radius, error, frequencies, NO_PROOF)
        return result

    @cached_property
    def scale(self) -> float:
        """The magnitude of the present value; for 0, the change that would move some eigenvalue by 1."""
        present = abs(float(self.base[self.column]))
        if present:
            return present
        fastest = float(np.nanmax(np.abs(self.sample_at(np.zeros(1))[1]), initial=0.0))
        return 1 / fastest if fastest > 0 else 1.0

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the one segment of the path."""
        bottom = self.bottom
        if bottom is None:
            bottom = -SPAN * self.scale if self.base[self.column] < 0 else 0.0
        top = self.top if self.top is not None else max(SPAN * self.scale, bottom + self.scale)
        points = spread(bottom, top, self.scale)
        yield SmoothSegment(
            Fraction(bottom),
            Fraction(top),
            points,
            self.scale / SPAN,
            self.sample_at,
            self.verdict_at,
            decided_at=self.decided_at,
        )


def matrix_sample(evaluator: BatchEvaluator, points: Floats, column: int) -> tuple[Complexes, Complexes]:
    """Return the eigenvalues of all systems at points (k, m), and their slopes along one parameter.

    Returns
    -------
    Eigenvalues and slopes (k, n), NaN at points without a matrix.
    """
    along = np.zeros_like(points)
    along[:, column] = 1.0
    result = [np.empty((2, len(points), 0), np.complex128)]
    for matrix, slope in evaluator.slopes(points, along):
        finite = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(slope).all(axis=(1, 2))
        pair = np.full((2, len(points), matrix.shape[1]), np.nan, np.complex128)
        pair[:, finite] = eigenvalues(matrix[finite], slope[finite])
        result.append(pair)
    values, slopes = np.concatenate(result, axis=2)
    return values, slopes


def pointwise(verdict_at: Callable[[Fraction], Verdict], values: Floats) -> tuple[Complexes, Complexes]:
    """Return the radius at each value (k, 1) in the form of an eigenvalue, and NaN as its slope.

    A radius closer to 1 than the error of floats is moved to the proved side, if a side is proved.
    """
    radii = []
    for verdict in (verdict_at(Fraction(value)) for value in values.tolist()):
        near_circle = abs(verdict.radius - 1) <= 2 * UNSURE and verdict.stable is not None
        radii.append(1 + (-2 if verdict.stable else 2) * UNSURE if near_circle else verdict.radius)
    result = np.array(radii, dtype=np.complex128)[:, None]
    return result, np.full(result.shape, np.nan, np.complex128)


@dataclass(frozen=True, eq=False)
class AnalyzedPath:
    """The base of a path with a separate analysis at each value, cached in `known`."""

    free: ParameterRef
    known: dict[Fraction, Verdict] = field(default_factory=dict, kw_only=True)

    @property
    def label(self) -> str:
        """The name of the parameter that varies."""
        return self.free.label

    def verdict_at(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, computed once."""
        if value not in self.known:
            self.known[value] = self._verdict(value)
        return self.known[value]

    def _verdict(self, value: Fraction) -> Verdict:
        """Return the verdict of an analysis at a value."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class DelayPath(AnalyzedPath):
    """A path along a delay from `low` to `high`, with a segment between any two coincidences of events.

    The value `low` is a separate segment: events may coincide there. `progress` receives the end of each
    segment. `rigid` are the numbers of rigid modes of each closed system, by the number of systems: delays do
    not change them.
    """

    numeric: NumericModel
    low: Fraction
    high: Fraction
    progress: Callable[[Fraction], None] | None = None
    rigid: dict[int, list[int]] = field(default_factory=dict)

    def _verdict(self, value: Fraction) -> Verdict:
        """Return the verdict of an analysis at a delay; undecided if it is impossible."""
        changed = model_with_time(self.numeric.model, self.free, value)
        try:
            return verdict_of(analyze(self.numeric.at(changed)))
        except ApcError:
            return OPEN

    def _verdict_within(self, value: Fraction) -> Verdict:
        """Return the verdict at a delay inside a segment whose events depend on the delay."""
        return analyzed(self.numeric, model_with_time(self.numeric.model, self.free, value))

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the start of the path, then the segments from one coincidence of events to the next."""
        yield self._constant_segment(self.low, self.low, self.low)
        for segment in delay_segments(self.numeric, self.free, self.low, location=LOCATION, high=self.high):
            self._report_progress(segment.high)
            if segment.evaluator is None:
                inside = segment.low + INSIDE * (segment.high - segment.low)
                yield self._constant_segment(segment.low, segment.high, inside, segment.inside)
            else:
                yield self._varying_segment(segment, segment.evaluator)

    def _report_progress(self, high: Fraction) -> None:
        """Report the end of the segment that begins."""
        if self.progress:
            self.progress(min(high, self.high))

    def _constant_segment(
        self, low: Fraction, high: Fraction, inside: Fraction, inside_model: Model | None = None
    ) -> SmoothSegment:
        """Return a segment of constant eigenvalues, represented by the model at one value.

        Parameters
        ----------
        low, high
            The ends of the segment, in seconds.
        inside, inside_model
            The representative delay, and the model at this delay, if already computed.
        """
        inside_model = inside_model or model_with_time(self.numeric.model, self.free, inside)
        point, high = np.array([float(low)]), min(high, self.high)

        def verdict_at(_: Fraction) -> Verdict:
            """Return the verdict at the representative value."""
            return self.verdict_at(inside)

        def sample_at(_: Floats) -> tuple[Complexes, Complexes]:
            """Return the spectral radius at the representative value, without a slope."""
            analyzed_before = self.known.get(inside)
            radius = analyzed_before.radius if analyzed_before else self._radius(inside_model)
            if abs(radius - 1) <= NEAR:
                return pointwise(verdict_at, point)
            return np.array([[radius]], np.complex128), np.full((1, 1), np.nan, np.complex128)

        return SmoothSegment(low, high, point, float(high - low), sample_at, verdict_at)

    def _radius(self, inside_model: Model) -> float:
        """Return the spectral radius of the model at a delay in floats, 1 if it has no matrix.

        The rigid modes are left out: the same number of eigenvalues nearest to 1.
        """
        try:
            systems = split(*lifted_classes(self.numeric.at(inside_model)))
        except ApcError:  # an analysis avoids a matrix that is too large
            return 1.0
        if len(systems) not in self.rigid:
            self.rigid[len(systems)] = [len(rigid_modes_of(closed_loop).names) for closed_loop in systems]
        largest = 0.0
        for closed_loop, count in zip(systems, self.rigid[len(systems)], strict=True):
            values = np.linalg.eigvals(closed_loop.matrix)
            moving = np.argsort(np.abs(values - 1))[count:]
            largest = max(largest, float(np.abs(values[moving]).max(initial=0.0)))
        return largest

    def _varying_segment(self, delay_segment: DelaySegment, evaluator: BatchEvaluator) -> SmoothSegment:
        """Return a delay segment in which the time between events, and so the frame map, depends on the
        delay.

        `evaluator` returns the frame maps at delays of the segment.
        """
        high = min(delay_segment.high, self.high)
        points = np.linspace(float(delay_segment.low), float(high), PIECE_SAMPLES)

        def sample_at(values: Floats) -> tuple[Complexes, Complexes]:
            """Return the eigenvalues and their slopes at delays (k,)."""
            return matrix_sample(evaluator, values[:, None], 0)

        return SmoothSegment(
            delay_segment.low, high, points, float(high - delay_segment.low), sample_at, self._verdict_within
        )

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the jump between two segments, exact if analyses just inside both segments bracket it.

        If segments between the two are undecided, its error covers them.
        """
        value, error = (before.high + after.low) / 2, (after.low - before.high) / 2
        below = self.verdict_at(before.high - ALONGSIDE * (before.high - before.low))
        above = self.verdict_at(after.low + ALONGSIDE * (after.high - after.low))
        proof = BETWEEN if error else EVENTS
        if not (below.stable is stable_below and above.stable is (not stable_below)):
            error, proof = max(error, after.high - after.low), ESTIMATE
        unstable_verdict = above if stable_below else below
        side = "below" if stable_below else "above"
        stable_at = None if error else self.verdict_at(value).stable
        return Crossing(
            float(value), float(error), side, unstable_verdict.frequency_hz, "jump", proof, stable_at
        )


def delay_reach(
    model: Model, parameter_ref: ParameterRef, low: Fraction, *, pieces: int, further: float
) -> tuple[Fraction, int]:
    """Return the default end of a delay search, and its number of segments.

    Parameters
    ----------
    model, parameter_ref
        The compiled model, and the parameter that varies.
    low
        The start of the search.
    pieces, further
        The minimum number of segments, and the maximum multiple of the present value.
    """
    next_border = borders(model, parameter_ref, location=LOCATION)
    least_end = Fraction(further) * delay_now(model, parameter_ref)
    border, count = low, 0
    while count < pieces or border < least_end:
        border, count = next_border(border), count + 1
    return border, count


@dataclass(frozen=True, eq=False)
class PeerCountPath(AnalyzedPath):
    """A path over numbers of peers from `first` to `last`, a segment each.

    Larger numbers are sampled sparsely.
    """

    model: Model
    verdict_of: Callable[[Model], bool | None]
    first: int
    last: int

    def _verdict(self, value: Fraction) -> Verdict:
        """Return the verdict of the model with this number of peers."""
        return classified(self.verdict_of(apply(self.model, [Override(self.free, value)])))

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the first sampled counts in order, a segment each."""
        sample_at = partial(pointwise, self.verdict_at)
        count = self.first
        while True:
            value = Fraction(count)
            yield SmoothSegment(
                value, value, np.array([float(count)]), 0.0, sample_at, self.verdict_at, slow=True
            )
            if count >= self.last:
                return
            step = math.floor(count * FURTHER) if count >= self.first + EVERY else 0
            count = max(count + 1, min(self.last, step))

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the change between two neighbouring counts, located by bisection."""
        below, above = int(before.high), int(after.low)
        while above - below > 1:
            middle = (below + above) // 2
            stable = self.verdict_at(Fraction(middle)).stable
            if stable is None:
                break
            below, above = (middle, above) if stable == stable_below else (below, middle)
        side, value = ("below", below) if stable_below else ("above", above)
        undecided = above - below - 1
        proof = StabilityProof(ProofMethod.SOME_COUNTS, undecided=undecided) if undecided else ANALYZED
        return Crossing(float(value), 0.0, side, math.nan, "count", proof)
