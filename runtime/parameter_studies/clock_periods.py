"""Critical values of a clock period: the periods that are analysed, and the changes of the verdict.

Takes: a `Model` and a timing, or a parameter on which a clock's period depends.
Gives: `period_segments`, `PeriodPath`.
Guarantees: every verdict is an analysis at an exact rational period.
Does not: give a verdict for periods whose frame with the other clocks is longer than
`timing_values.MOST_FRAME_TICKS`.

A period changes the frame, the least common multiple of all periods. Where all clocks scale with the number,
as where there is one, every value has as many ticks in a frame: the axis is continuous. With a clock of
another period only commensurate values are analysed: of p/q times the common divisor of the other periods, a
frame has about as many ticks as p and q together. A period in a simple ratio to the others may have another
verdict than all periods near it: near each value the simplest ratio and one of a long frame are analyzed.
Between two of different verdicts one of the middle third comes next, as long as its frame is short. The
remaining gap is the error of the answer.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import SourceLocation
from apc.frame.parameter_names import Range
from apc.parameter_studies.crossing import ESTIMATE, PERIOD, Crossing, SmoothSegment, Verdict
from apc.parameter_studies.delay_segments import DelaySegment
from apc.parameter_studies.parameter_path import AnalyzedPath, pointwise, spread
from apc.parameter_studies.timing_values import (
    common_period,
    delay_now,
    is_scaled,
    long_period_between,
    period_between,
    periods_near,
    system_with_delay,
)
from apc.verdict import ProofMethod, StabilityProof

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# The default range: from the present period divided by this factor to that multiplied by it.
PERIOD_SPAN = 32

# The number of analysed periods along an axis of a region.
STRIPS = 32


def period_segments(system: Model, axis: Range, location: SourceLocation) -> Iterator[DelaySegment]:
    """Yield a segment for each of some periods of a range, with ends halfway to its neighbours.

    Raises
    ------
    ApcError
        As `periods_near`.
    """
    step = (axis.high - axis.low) / STRIPS
    values = periods_near(system, axis.free, [axis.low + step * k for k in range(STRIPS + 1)], location)
    middles = [(before + after) / 2 for before, after in itertools.pairwise(values)]
    for value, low, high in zip(values, [axis.low, *middles], [*middles, axis.high], strict=True):
        yield DelaySegment(low, high, None, system_with_delay(system, axis.free, value))


@dataclass(frozen=True, eq=False)
class PeriodPath(AnalyzedPath):
    """A number on which clock periods depend, from `low` to `high` or, where None, from the present value.

    `decide` gives the verdict of a topology.
    """

    decide: Callable[[Model], Verdict]
    low: Fraction | None
    high: Fraction | None
    location: SourceLocation

    def _verdict(self, value: Fraction) -> Verdict:
        return self.decide(system_with_delay(self.system, self.free, value))

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield one segment where all clocks scale with the number, else one for each period."""
        now = delay_now(self.system, self.free)
        low = self.low or min(now, self.high or now) / PERIOD_SPAN
        high = self.high or max(now, low) * PERIOD_SPAN
        points = spread(float(low), float(high), float(now))
        sample_at = partial(pointwise, self.verdict_at)
        if is_scaled(self.system, self.free):
            yield SmoothSegment(low, high, points, float(low), sample_at, self.verdict_at, slow=True)
            return
        targets = sorted({low, *map(Fraction, points[1:-1].tolist()), high})
        for at in periods_near(self.system, self.free, targets, self.location):
            yield SmoothSegment(
                at, at, np.array([float(at)]), 0.0, partial(self._sample, at), self.verdict_at, slow=True
            )

    def _sample(self, value: Fraction, _: Floats) -> tuple[Complexes, Complexes]:
        return pointwise(lambda _: self.verdict_at(value), np.array([float(value)]))

    def change(self, before: SmoothSegment, after: SmoothSegment, *, stable_below: bool) -> Crossing:
        """Return the change between two periods, as near as the frames allow."""
        low, high = before.low, after.low
        unit = common_period(self.system, self.free)
        verdicts = [self.verdict_at(low), self.verdict_at(high)]
        while True:
            third = (high - low) / 3
            between = self.system, self.free, unit, low + third, high - third
            value = long_period_between(*between) or period_between(*between)
            at = None if value is None else self.verdict_at(value)
            if value is None or at is None or at.stable is None:
                break
            if at.stable is stable_below:
                low, verdicts[0] = value, at
            else:
                high, verdicts[1] = value, at
        decided = [verdict.stable for verdict in verdicts] == [stable_below, not stable_below]
        grows = verdicts[1 if stable_below else 0]
        proof = StabilityProof(ProofMethod.ANALYSED_BESIDE) if decided else ESTIMATE
        side = "below" if stable_below else "above"
        return Crossing(
            float((low + high) / 2), float((high - low) / 2), side, grows.frequency_hz, PERIOD, proof
        )
