"""Parameter paths: a model along one of its parameters, with eigenvalues at many values and analyses.

Takes: a `Model`, its prepared data, and the parameter that varies.
Gives: `MatrixPath`, `AnalyzedPath`, `DelayPath`, `PeerCountPath`; `spread`, `SPAN`; `pointwise`, `analyzed`,
`verdict_of`, `OPEN`; `matrix_sample`, `delay_reach`.
Guarantees: `verdict_at` is the model's own analysis; `sample_at` its matrices in floats.
Does not: search (see `crossing`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze, lifted_groups
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.eigen.eigenpairs import eigenvalues
from apc.eigen.modes import split
from apc.eigen.rigid_modes import rigid_modes_of
from apc.frame.numeric_model import Prepared
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef
from apc.parameter_studies.crossing import ESTIMATE, UNSURE, Crossing, SingleSegment, SmoothSegment, Verdict
from apc.parameter_studies.delay_segments import INSIDE, DelaySegment, borders, delay_segments
from apc.parameter_studies.frame_matrices import BatchEvaluator
from apc.parameter_studies.timing_values import delay_now, system_with_delay
from apc.verdict import NO_PROOF, ProofMethod, StabilityProof, StabilityVerdict

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LOCATION = SourceLocation("critical value")

# Default range: values from SPAN times smaller to SPAN times larger than the scale, which is the present
# value or, where that is 0, the change that would move an eigenvalue by 1 to first order.
SPAN = 1e3

# First samples per factor of 10: neighbours differ by half; the minimum in a range, so that a narrow one has
# enough. The same for a delay segment.
SAMPLES, FEWEST, PIECE_SAMPLES = 6, 17, 3

# The distance inside a delay segment, relative to its length, at which it is analysed instead of at its end,
# where the order of coincident events matters.
ALONGSIDE = Fraction(1, 10**6)

# What is said of a jump, and of one among stretches that were left open; of a change between two counts.
EVENTS = StabilityProof(ProofMethod.COINCIDENT_EVENTS)
BETWEEN = StabilityProof(ProofMethod.OPEN_BETWEEN)
ANALYZED = StabilityProof(ProofMethod.BOTH_COUNTS)

# A spectral radius in floats nearer to 1 than this, the error of a double eigenvalue, is computed again by an
# analysis.
NEAR = 1e-6

# The number of smallest counts that are all sampled; then the ratio of each to the one before.
EVERY, FURTHER = 32, 1.25

# Where there is no analysis.
OPEN = Verdict(None, math.nan, math.inf, (), NO_PROOF)


def analyzed(system: Model, prepared: Prepared) -> Verdict:
    """Return the verdict of a topology, undecided if there is no analysis.

    A drift occurs on both sides of a crossing, so that it does not decide.
    """
    try:
        return verdict_of(analyze(system, prepared=prepared), drifting=True)
    except ApcError:
        return OPEN


def verdict_of(result: Analysis, *, drifting: bool | None = None) -> Verdict:
    """Return the verdict of an analysis; a drift has the verdict `drifting`."""
    stable = drifting if result.verdict is StabilityVerdict.DRIFTS else result.stable
    return Verdict(stable, result.spectral_radius, result.spectral_radius_error, result.modes, result.proof)


def classified(stable: bool | None) -> Verdict:
    """Return a verdict of which only the side is known."""
    return Verdict(stable, 0.5 if stable else 2.0, 0.0, (), NO_PROOF)


def spread(bottom: float, top: float, scale: float) -> Floats:
    """Return values from bottom to top, in equal ratios on each side of 0."""

    def ratios(low: float, high: float) -> Floats:
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
    """A path of one of an evaluator's free parameters, with the others at `base` (m,): one segment.

    `prepared` is that of the evaluator's topology. `bottom` and `top` are the ends, None for those of `SPAN`.
    """

    family: BatchEvaluator
    prepared: Prepared
    base: Floats
    column: int
    bottom: float | None = None
    top: float | None = None

    @property
    def label(self) -> str:
        """The parameter that varies."""
        return self.family.free[self.column].label

    def point(self, value: float) -> Floats:
        """Return the point (m,) of a value."""
        values = self.base.copy()
        values[self.column] = value
        return values

    def sample_at(self, values: Floats) -> tuple[Complexes, Complexes]:
        """Return the eigenvalues of all systems (k, n) and their slopes at values (k,)."""
        return matrix_sample(self.family, np.array([self.point(value) for value in values]), self.column)

    def verdict_at(self, value: Fraction) -> Verdict:
        """Return the verdict at a value."""
        change = Override(self.family.free[self.column], value)
        return analyzed(apply(self.family.system, [change]), self.prepared)

    @cached_property
    def scale(self) -> float:
        """The present value or, where it is 0, the change that would move some eigenvalue by 1."""
        present = abs(float(self.base[self.column]))
        if present:
            return present
        fastest = float(np.nanmax(np.abs(self.sample_at(np.zeros(1))[1]), initial=0.0))
        return 1 / fastest if fastest > 0 else 1.0

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the one segment."""
        bottom = self.bottom
        if bottom is None:
            bottom = -SPAN * self.scale if self.base[self.column] < 0 else 0.0
        top = self.top if self.top is not None else max(SPAN * self.scale, bottom + self.scale)
        points = spread(bottom, top, self.scale)
        yield SmoothSegment(
            Fraction(bottom), Fraction(top), points, self.scale / SPAN, self.sample_at, self.verdict_at
        )


def matrix_sample(family: BatchEvaluator, points: Floats, column: int) -> tuple[Complexes, Complexes]:
    """Return the eigenvalues of all systems at points (k, m), and their slopes along one of the numbers.

    Returns
    -------
    Both (k, n), NaN where a point has no matrix.
    """
    along = np.zeros_like(points)
    along[:, column] = 1.0
    result = [np.empty((2, len(points), 0), np.complex128)]
    for matrix, slope in family.slopes(points, along):
        known = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(slope).all(axis=(1, 2))
        both = np.full((2, len(points), matrix.shape[1]), np.nan, np.complex128)
        both[:, known] = eigenvalues(matrix[known], slope[known])
        result.append(both)
    values, slopes = np.concatenate(result, axis=2)
    return values, slopes


def pointwise(verdict_at: Callable[[Fraction], Verdict], values: Floats) -> tuple[Complexes, Complexes]:
    """Return the radius at each value (k, 1) in the place of an eigenvalue, without a slope.

    A radius nearer to the circle than the error of floats has the proved side, if there is one.
    """
    radii = []
    for verdict in (verdict_at(Fraction(value)) for value in values.tolist()):
        alongside = abs(verdict.radius - 1) <= 2 * UNSURE and verdict.stable is not None
        radii.append(1 + (-2 if verdict.stable else 2) * UNSURE if alongside else verdict.radius)
    result = np.array(radii, dtype=np.complex128)[:, None]
    return result, np.full(result.shape, np.nan, np.complex128)


@dataclass(frozen=True, eq=False)
class AnalyzedPath:
    """A path of which each value is analysed separately, once."""

    system: Model
    free: ParameterRef
    known: dict[Fraction, Verdict] = field(default_factory=dict, kw_only=True)

    @property
    def label(self) -> str:
        """The parameter that varies."""
        return self.free.label

    def verdict_at(self, value: Fraction) -> Verdict:
        """Return the verdict at a value."""
        if value not in self.known:
            self.known[value] = self._verdict(value)
        return self.known[value]

    def _verdict(self, value: Fraction) -> Verdict:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class DelayPath(AnalyzedPath):
    """A delay from `low` to `high`: between two coincidences of events the deciding quantity is continuous.

    The value `low` itself is a segment of its own: events may coincide there. `rigid` are the numbers of
    rigid modes of each closed system, which no delay changes, by the number of systems.
    """

    prepared: Prepared
    low: Fraction
    high: Fraction
    progress: Callable[[Fraction], None] | None = None
    rigid: dict[int, list[int]] = field(default_factory=dict)

    def _verdict(self, value: Fraction) -> Verdict:
        changed = system_with_delay(self.system, self.free, value)
        try:
            return verdict_of(analyze(changed, prepared=self.prepared))
        except ApcError:
            return OPEN

    def _verdict_within(self, value: Fraction) -> Verdict:
        """Return the verdict at a delay that moves events."""
        return analyzed(system_with_delay(self.system, self.free, value), self.prepared)

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the value at which the path begins, then the segments from one coincidence to the next."""
        yield self._constant(self.low, self.low, self.low)
        for piece in delay_segments(
            self.system, self.free, self.low, self.prepared, location=LOCATION, high=self.high
        ):
            self._tell(piece.high)
            if piece.evaluator is None:
                inside = piece.low + INSIDE * (piece.high - piece.low)
                yield self._constant(piece.low, piece.high, inside, piece.inside)
            else:
                yield self._moving(piece, piece.evaluator)

    def _tell(self, high: Fraction) -> None:
        if self.progress:
            self.progress(min(high, self.high))

    def _constant(
        self, low: Fraction, high: Fraction, inside: Fraction, there: Model | None = None
    ) -> SmoothSegment:
        """Return a segment with constant eigenvalues: the model at one value represents all."""
        there = there or system_with_delay(self.system, self.free, inside)
        point, high = np.array([float(low)]), min(high, self.high)

        def verdict_at(_: Fraction) -> Verdict:
            return self.verdict_at(inside)

        def sample_at(_: Floats) -> tuple[Complexes, Complexes]:
            radius = self._radius(there)
            if abs(radius - 1) <= NEAR:
                return pointwise(verdict_at, point)
            return np.array([[radius]], np.complex128), np.full((1, 1), np.nan, np.complex128)

        return SmoothSegment(low, high, point, float(high - low), sample_at, verdict_at)

    def _radius(self, there: Model) -> float:
        """Return the spectral radius of the model at a delay in floats, 1 where there is no matrix.

        The rigid modes, that many eigenvalues nearest to 1, are left out.
        """
        try:
            systems = split(*lifted_groups(there, prepared=self.prepared))
        except ApcError:  # an analysis avoids a matrix that is too large
            return 1.0
        if len(systems) not in self.rigid:
            self.rigid[len(systems)] = [len(rigid_modes_of(system).names) for system in systems]
        largest = 0.0
        for system, count in zip(systems, self.rigid[len(systems)], strict=True):
            values = np.linalg.eigvals(system.matrix)
            moving = np.argsort(np.abs(values - 1))[count:]
            largest = max(largest, float(np.abs(values[moving]).max(initial=0.0)))
        return largest

    def _moving(self, piece: DelaySegment, family: BatchEvaluator) -> SmoothSegment:
        """Return a segment in which events move with the delay."""
        high = min(piece.high, self.high)
        points = np.linspace(float(piece.low), float(high), PIECE_SAMPLES)

        def sample_at(values: Floats) -> tuple[Complexes, Complexes]:
            return matrix_sample(family, values[:, None], 0)

        return SmoothSegment(
            piece.low, high, points, float(high - piece.low), sample_at, self._verdict_within
        )

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return a jump, exact where analyses just inside both segments bracket it there.

        Where segments between the two were undecided, it lies anywhere in these.
        """
        value, error = (before.high + after.low) / 2, (after.low - before.high) / 2
        below = self.verdict_at(before.high - ALONGSIDE * (before.high - before.low))
        above = self.verdict_at(after.low + ALONGSIDE * (after.high - after.low))
        proof = BETWEEN if error else EVENTS
        if not (below.stable is stable_below and above.stable is (not stable_below)):
            error, proof = max(error, after.high - after.low), ESTIMATE
        grows = above if stable_below else below
        side = "below" if stable_below else "above"
        at = None if error else self.verdict_at(value).stable
        return Crossing(float(value), float(error), side, grows.frequency_hz, "jump", proof, at)


def delay_reach(
    system: Model, free: ParameterRef, low: Fraction, *, pieces: int, further: float
) -> tuple[Fraction, int]:
    """Return the default end of a delay search, and its number of segments.

    Parameters
    ----------
    system, free
        The compiled model, and the parameter that varies.
    low
        The start of the search.
    pieces, further
        The minimum number of segments, and the maximum multiple of the present value.
    """
    following = borders(system, free, location=LOCATION)
    most = Fraction(further) * delay_now(system, free)
    at, count = low, 0
    while count < pieces or at < most:
        at, count = following(at), count + 1
    return at, count


@dataclass(frozen=True, eq=False)
class PeerCountPath(AnalyzedPath):
    """A number of peers from `first` to `last`: a segment each, with fewer samples of larger numbers."""

    verdict_of: Callable[[Model], bool | None]
    first: int
    last: int

    def _verdict(self, value: Fraction) -> Verdict:
        return classified(self.verdict_of(apply(self.system, [Override(self.free, value)])))

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the counts that are sampled first, in order."""
        sample_at = partial(pointwise, self.verdict_at)
        count = self.first
        while True:
            at = Fraction(count)
            yield SmoothSegment(at, at, np.array([float(count)]), 0.0, sample_at, self.verdict_at, slow=True)
            if count >= self.last:
                return
            step = math.floor(count * FURTHER) if count >= self.first + EVERY else 0
            count = max(count + 1, min(self.last, step))

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the two neighbouring counts between which the verdict changes, by halving."""
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
