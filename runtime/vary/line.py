"""A scene along one of its numbers: its eigenvalues at many values, and its analysis at any.

Takes: a `Model`, what was prepared of it, and the number that varies.
Gives: `MatrixPath`, `JudgedLine`, `DelayPath`, `PeerCountPath`; `spread`, `SPAN`; `one_by_one`, `judged`,
`verdict_of`, `OPEN`.
Guarantees: `judge` is the scene's own analysis; `look` its matrices in floats.
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
from apc.eigen.rigid import rigid_modes_of
from apc.frame.instance import Prepared
from apc.frame.names import ParameterRef
from apc.frame.overrides import Override, apply
from apc.vary.batch import BatchEvaluator
from apc.vary.crossing import ESTIMATE, UNSURE, Crossing, SingleSegment, SmoothSegment, Verdict
from apc.vary.delays import INSIDE, DelaySegment, borders, delay_pieces
from apc.vary.timing_values import delay_now, system_with_delay
from apc.verdict import NO_PROOF, ProofMethod, StabilityProof, StabilityVerdict

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

PLACE = SourceLocation("critical value")

# Without limits given, values from SPAN times smaller to SPAN times larger than the scale are looked at: the
# present value or, where that is 0, the change that would move an eigenvalue by 1 if it went on as it starts.
SPAN = 1e3

# Values in each factor of 10 to begin with: neighbours differ by half; at least so many in a range, so that a
# narrow one is looked at closely. Of a piece of a delay.
SAMPLES, FEWEST, PIECE_SAMPLES = 6, 17, 3

# How far inside a piece of a delay, relative to its length, it is analysed in the place of its end, but for
# the order of events that coincide there.
BESIDE = Fraction(1, 10**6)

# What is said of a jump, and of one among stretches that were left open; of a change between two counts.
EVENTS = StabilityProof(ProofMethod.COINCIDENT_EVENTS)
BETWEEN = StabilityProof(ProofMethod.OPEN_BETWEEN)
JUDGED = StabilityProof(ProofMethod.BOTH_COUNTS)

# A spectral radius nearer to 1 than this in floats, in which a double eigenvalue is off by the root of their
# rounding, is looked at again by an analysis.
NEAR = 1e-6

# Counts from the lowest on are each looked at, so many of them; then each is so many times the one before.
EVERY, FURTHER = 32, 1.25

# Where there is no analysis.
OPEN = Verdict(None, math.nan, math.inf, (), NO_PROOF)


def judged(system: Model, prepared: Prepared) -> Verdict:
    """Return the verdict of a topology, open if there is no analysis.

    A drift occurs on both sides of a crossing, so that it does not decide.
    """
    try:
        return verdict_of(analyze(system, prepared=prepared), drifting=True)
    except ApcError:
        return OPEN


def verdict_of(result: Analysis, *, drifting: bool | None = None) -> Verdict:
    """Return the verdict of an analysis; where the scene drifts, as is said."""
    stable = drifting if result.verdict is StabilityVerdict.DRIFTS else result.stable
    return Verdict(stable, result.spectral_radius, result.spectral_radius_error, result.modes, result.proof)


def sided(stable: bool | None) -> Verdict:
    """Return a verdict of which only the side is known."""
    return Verdict(stable, 0.5 if stable else 2.0, 0.0, (), NO_PROOF)


def spread(bottom: float, top: float, scale: float) -> Floats:
    """Return values from bottom to top, in even ratios on either side of 0."""

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
    """One of an evaluator's free parameters varies, the others stay at `base` (m,): a line of one stretch.

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
        """The number that varies."""
        return self.family.free[self.column].label

    def point(self, value: float) -> Floats:
        """Return the point (m,) of a value."""
        values = self.base.copy()
        values[self.column] = value
        return values

    def look(self, values: Floats) -> tuple[Complexes, Complexes]:
        """Return the eigenvalues of all systems (k, n) and their slopes at values (k,)."""
        return matrix_look(self.family, np.array([self.point(value) for value in values]), self.column)

    def judge(self, value: Fraction) -> Verdict:
        """Return the verdict at a value."""
        change = Override(self.family.free[self.column], value)
        return judged(apply(self.family.system, [change]), self.prepared)

    @cached_property
    def scale(self) -> float:
        """The present value or, where it is 0, the change that would move some eigenvalue by 1."""
        present = abs(float(self.base[self.column]))
        if present:
            return present
        fastest = float(np.nanmax(np.abs(self.look(np.zeros(1))[1]), initial=0.0))
        return 1 / fastest if fastest > 0 else 1.0

    def stretches(self) -> Iterator[SmoothSegment]:
        """Yield the one stretch."""
        bottom = self.bottom
        if bottom is None:
            bottom = -SPAN * self.scale if self.base[self.column] < 0 else 0.0
        top = self.top if self.top is not None else max(SPAN * self.scale, bottom + self.scale)
        points = spread(bottom, top, self.scale)
        yield SmoothSegment(Fraction(bottom), Fraction(top), points, self.scale / SPAN, self.look, self.judge)


def matrix_look(family: BatchEvaluator, points: Floats, column: int) -> tuple[Complexes, Complexes]:
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


def one_by_one(judge: Callable[[Fraction], Verdict], values: Floats) -> tuple[Complexes, Complexes]:
    """Return the radius at each value (k, 1) as if it were an eigenvalue, without a slope.

    One nearer to the circle than floats can tell has the side that was proved, where it was.
    """
    radii = []
    for verdict in (judge(Fraction(value)) for value in values.tolist()):
        beside = abs(verdict.radius - 1) <= 2 * UNSURE and verdict.stable is not None
        radii.append(1 + (-2 if verdict.stable else 2) * UNSURE if beside else verdict.radius)
    result = np.array(radii, dtype=np.complex128)[:, None]
    return result, np.full(result.shape, np.nan, np.complex128)


@dataclass(frozen=True, eq=False)
class JudgedLine:
    """A line of which each value is analysed by itself, once."""

    system: Model
    free: ParameterRef
    known: dict[Fraction, Verdict] = field(default_factory=dict, kw_only=True)

    @property
    def label(self) -> str:
        """The number that varies."""
        return self.free.label

    def judge(self, value: Fraction) -> Verdict:
        """Return the verdict at a value."""
        if value not in self.known:
            self.known[value] = self._verdict(value)
        return self.known[value]

    def _verdict(self, value: Fraction) -> Verdict:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class DelayPath(JudgedLine):
    """A delay from `low` to `high`: between two coincidences of events what decides is continuous.

    What happens exactly at `low` is a stretch of its own: events may coincide there. `rigid` are the numbers
    of rigid motions of each closed system, which no delay changes, by how many systems there are.
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

    def _judge_within(self, value: Fraction) -> Verdict:
        """Return the verdict at a delay that moves events."""
        return judged(system_with_delay(self.system, self.free, value), self.prepared)

    def stretches(self) -> Iterator[SmoothSegment]:
        """Yield the value at which the line begins, then the stretches from one coincidence to the next."""
        yield self._constant(self.low, self.low, self.low)
        for piece in delay_pieces(
            self.system, self.free, self.low, self.prepared, place=PLACE, high=self.high
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
        """Return a stretch within which nothing depends on the delay: the scene at a value stands for all."""
        there = there or system_with_delay(self.system, self.free, inside)
        point, high = np.array([float(low)]), min(high, self.high)

        def judge(_: Fraction) -> Verdict:
            return self.judge(inside)

        def look(_: Floats) -> tuple[Complexes, Complexes]:
            radius = self._radius(there)
            if abs(radius - 1) <= NEAR:
                return one_by_one(judge, point)
            return np.array([[radius]], np.complex128), np.full((1, 1), np.nan, np.complex128)

        return SmoothSegment(low, high, point, float(high - low), look, judge)

    def _radius(self, there: Model) -> float:
        """Return the spectral radius of the scene at a delay in floats, 1 where there is no matrix.

        As many eigenvalues as are rigid, those nearest to 1, are left out.
        """
        try:
            systems = split(*lifted_groups(there, prepared=self.prepared))
        except ApcError:  # an analysis spares a matrix that is too large
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
        """Return a stretch in which events move with the delay."""
        high = min(piece.high, self.high)
        points = np.linspace(float(piece.low), float(high), PIECE_SAMPLES)

        def look(values: Floats) -> tuple[Complexes, Complexes]:
            return matrix_look(family, values[:, None], 0)

        return SmoothSegment(piece.low, high, points, float(high - piece.low), look, self._judge_within)

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return a jump, exact where analyses just inside both stretches hold it there.

        Where stretches between the two were left open, it lies anywhere in these.
        """
        value, error = (before.high + after.low) / 2, (after.low - before.high) / 2
        below = self.judge(before.high - BESIDE * (before.high - before.low))
        above = self.judge(after.low + BESIDE * (after.high - after.low))
        proof = BETWEEN if error else EVENTS
        if not (below.stable is stable_below and above.stable is (not stable_below)):
            error, proof = max(error, after.high - after.low), ESTIMATE
        grows = above if stable_below else below
        side = "below" if stable_below else "above"
        at = None if error else self.judge(value).stable
        return Crossing(float(value), float(error), side, grows.frequency_hz, "jump", proof, at)


def delay_reach(
    system: Model, free: ParameterRef, low: Fraction, *, pieces: int, further: float
) -> tuple[Fraction, int]:
    """Return how far a delay is looked at where nobody says, and over how many pieces that is.

    Parameters
    ----------
    system, free
        The compiled scene, and what varies.
    low
        From which value.
    pieces, further
        Over so many pieces at least, and up to so many times the present value.
    """
    following = borders(system, free, place=PLACE)
    most = Fraction(further) * delay_now(system, free)
    at, count = low, 0
    while count < pieces or at < most:
        at, count = following(at), count + 1
    return at, count


@dataclass(frozen=True, eq=False)
class PeerCountPath(JudgedLine):
    """A number of peers from `first` to `last`: a stretch each, the larger ones looked at less densely."""

    verdict_of: Callable[[Model], bool | None]
    first: int
    last: int

    def _verdict(self, value: Fraction) -> Verdict:
        return sided(self.verdict_of(apply(self.system, [Override(self.free, value)])))

    def stretches(self) -> Iterator[SmoothSegment]:
        """Yield the counts that are looked at to begin with, in order."""
        look = partial(one_by_one, self.judge)
        count = self.first
        while True:
            at = Fraction(count)
            yield SmoothSegment(at, at, np.array([float(count)]), 0.0, look, self.judge, slow=True)
            if count >= self.last:
                return
            step = math.floor(count * FURTHER) if count >= self.first + EVERY else 0
            count = max(count + 1, min(self.last, step))

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the two neighbouring counts between which the verdict changes, by halving."""
        below, above = int(before.high), int(after.low)
        while above - below > 1:
            middle = (below + above) // 2
            stable = self.judge(Fraction(middle)).stable
            if stable is None:
                break
            below, above = (middle, above) if stable == stable_below else (below, middle)
        side, value = ("below", below) if stable_below else ("above", above)
        left_open = above - below - 1
        proof = StabilityProof(ProofMethod.SOME_COUNTS, left_open=left_open) if left_open else JUDGED
        return Crossing(float(value), 0.0, side, math.nan, "count", proof)
