"""Critical values of a clock period: the periods that are analysed, and the changes of the verdict.

Takes: a `Model` and a timing, or a parameter on which a clock's period depends.
Gives: `period_segments`, `PeriodPath`, `NominalPeriodPath`.
Guarantees: every verdict is an analysis at an exact rational period.
Does not: give a verdict for periods whose frame with the other clocks is longer than
`timing_values.MOST_FRAME_TICKS`; decide by exact arithmetic beyond EXACT_WORK.

A period changes the frame, the least common multiple of all periods. If all clocks scale with the number, for
example a single clock, every value has the same number of ticks in a frame: the axis is continuous. With a
clock of another period only commensurate values are analysed: at p/q times the common multiple F of the other
periods, a frame is p F long. The verdict at a period in a simple ratio to the others may differ
from that of all periods near it: near each value the simplest ratio and one of a long frame are analyzed.
Between two periods of different verdicts, a period of the middle third follows, as long as its frame is
short. The remaining gap is the error of the critical value.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze_worst_side
from apc.analysis.one_sided_slopes import Side, sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.lifting.numeric_model import NumericModel
from apc.linearization.linearize import reaches_start
from apc.parameter_values.parameter_names import Range
from apc.studies.crossing import ESTIMATE, PERIOD, Crossing, SmoothSegment, Verdict
from apc.studies.delay_segments import DelaySegment
from apc.studies.parameter_path import OPEN, AnalyzedPath, pointwise, spread, verdict_of
from apc.studies.timing_values import (
    base_value,
    delay_now,
    is_scaled,
    long_period_between,
    model_with_time,
    period_between,
    periods_near,
)
from apc.verdict import ProofMethod, StabilityProof

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# The default range: from the present period divided by this factor to the period multiplied by it.
PERIOD_SPAN = 32

# States times events of a frame up to which exact arithmetic decides a period that floats leave undecided:
# less than a second. A search has dozens of periods.
EXACT_WORK = 100_000

# The number of analysed periods along an axis of a region.
STRIPS = 32


def period_segments(model: Model, axis: Range, location: SourceLocation) -> Iterator[DelaySegment]:
    """Yield a segment for each of some periods of a range, with ends halfway to the neighbouring periods.

    Raises
    ------
    ApcError
        As for `periods_near`.
    """
    step = (axis.high - axis.low) / STRIPS
    values = periods_near(model, axis.free, [axis.low + step * k for k in range(STRIPS + 1)], location)
    middles = [(before + after) / 2 for before, after in itertools.pairwise(values)]
    for value, low, high in zip(values, [axis.low, *middles], [*middles, axis.high], strict=True):
        yield DelaySegment(low, high, None, model_with_time(model, axis.free, value))


@dataclass(frozen=True, eq=False)
class _AnyPeriodPath(AnalyzedPath):
    """The base of a path along a number on which clock periods depend, from `low` to `high`.

    An end that is None is relative to the present value.
    """

    model: Model
    low: Fraction | None
    high: Fraction | None
    location: SourceLocation

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield one segment if all clocks scale with the number, otherwise one for each period."""
        now = delay_now(self.model, self.free)
        low = self.low or min(now, self.high or now) / PERIOD_SPAN
        high = self.high or max(now, low) * PERIOD_SPAN
        points = spread(float(low), float(high), float(now))
        sample_at = partial(pointwise, self.verdict_at)
        if is_scaled(self.model, self.free):
            yield SmoothSegment(low, high, points, float(low), sample_at, self.verdict_at, slow=True)
            return
        targets = sorted({low, *map(Fraction, points[1:-1].tolist()), high})
        included = [now] if low < now < high else []
        for period in periods_near(self.model, self.free, targets, self.location, included=included):
            yield SmoothSegment(
                period,
                period,
                np.array([float(period)]),
                0.0,
                partial(self._sample, period),
                self.verdict_at,
                slow=True,
            )

    def _sample(self, value: Fraction, _: Floats) -> tuple[Complexes, Complexes]:
        """Return the radius at a period in the form of an eigenvalue, without a slope; NaN if undecided."""
        if self.verdict_at(value).stable is None:
            return pointwise(lambda _: OPEN, np.array([float(value)]))
        return pointwise(lambda _: self.verdict_at(value), np.array([float(value)]))

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the change between two periods, with a gap as small as the length of frames permits."""
        low, high = before.low, after.low
        unit = base_value(self.model, self.free)
        verdicts = [self.verdict_at(low), self.verdict_at(high)]
        while True:
            third = (high - low) / 3
            arguments = self.model, self.free, unit, low + third, high - third
            value = long_period_between(*arguments) or period_between(*arguments)
            middle_verdict = None if value is None else self.verdict_at(value)
            if value is None or middle_verdict is None or middle_verdict.stable is None:
                break
            if middle_verdict.stable is stable_below:
                low, verdicts[0] = value, middle_verdict
            else:
                high, verdicts[1] = value, middle_verdict
        decided = [verdict.stable for verdict in verdicts] == [stable_below, not stable_below]
        unstable_verdict = verdicts[1 if stable_below else 0]
        proof = StabilityProof(ProofMethod.ANALYSED_BESIDE) if decided else ESTIMATE
        side = "below" if stable_below else "above"
        return Crossing(
            float((low + high) / 2),
            float((high - low) / 2),
            side,
            unstable_verdict.frequency_hz,
            PERIOD,
            proof,
        )


@dataclass(frozen=True, eq=False)
class PeriodPath(_AnyPeriodPath):
    """A path along a clock period by a scalar criterion; `decide` returns the verdict of a model."""

    decide: Callable[[Model], Verdict]

    def _verdict(self, value: Fraction) -> Verdict:
        """Return the verdict of the model with this value."""
        return self.decide(model_with_time(self.model, self.free, value))


@dataclass(frozen=True, eq=False)
class NominalPeriodPath(_AnyPeriodPath):
    """A path along a clock period by analyses; `numeric` is the model at its present values."""

    numeric: NumericModel

    @cached_property
    def sides(self) -> list[Side]:
        """The sides of the kinks at the start, the side of the latest result first."""
        return list(sides(self.numeric))

    def _verdict(self, value: Fraction) -> Verdict:
        """Return the verdict of the model with this value, undecided if an analysis is impossible.

        A drift counts as stable: it exists on both sides of a crossing. Exact arithmetic is
        limited to `EXACT_WORK`.
        """
        changed = model_with_time(self.model, self.free, value)
        try:
            if reaches_start(self.model, self.free):  # the kinks at the start depend on the period
                analysis, _ = analyze_worst_side(sides(self.numeric.at(changed)), exact_work=EXACT_WORK)
            else:
                ordered = self.sides
                changed_sides = [
                    replace(side, numeric=numeric.at(model_with_time(numeric.model, self.free, value)))
                    for side in ordered
                    for numeric in [side.numeric]
                ]
                analysis, worst = analyze_worst_side(
                    changed_sides, exact_work=EXACT_WORK, first_unstable=True
                )
                ordered.insert(0, ordered.pop(changed_sides.index(worst)))
        except ApcError:
            return OPEN
        return verdict_of(analysis, drifting=True)
