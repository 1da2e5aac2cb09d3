"""A clock period as the number that varies: which values are analysed, and where the verdict changes.

Takes: a `CompiledSystem` and a timing, or a parameter, that a clock's period depends on.
Gives: `reaches_period`, `refuse_phase`, `is_scaled`; `nearest_period`, `periods_near`, `period_pieces`;
`PeriodLine`, `MOST_FRAME_TICKS`.
Guarantees: every verdict is an analysis at an exact rational period.
Does not: give a verdict for periods whose frame with the other clocks is longer than `MOST_FRAME_TICKS`.

A period changes the frame, the least common multiple of all periods. Where all clocks scale with the number,
as where there is one, every value has as many ticks in a frame: the axis is continuous. Beside a clock of
another period only commensurate values are analysed: of p/q times the common divisor of the other periods, a
frame has about as many ticks as p and q together. Between two of these of different verdicts the simplest
fraction comes next, as long as there is one. What is left is the resolution, and the error of the answer.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.multiples import common_divisor, common_multiple
from apc.compiler.words import with_unit
from apc.frame.names import Free, Range
from apc.frame.parameters import resolve, scope_of
from apc.vary.crossing import ESTIMATE, PERIOD, Crossing, Stretch, Verdict
from apc.vary.delays import Piece, delay_now, system_with_delay, timing_slopes
from apc.vary.line import JudgedLine, one_by_one, spread

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Ticks of all clocks in the longest frame that is analysed: some tenths of a second each.
MOST_FRAME_TICKS = 400

# Without limits given, periods from so many times shorter to so many times longer than the present one.
PERIOD_SPAN = 32

# Digits to which a period is met, the most that serve; periods that are kept for the next question.
DIGITS, KEPT = 9, 256

# Periods along an axis of a region, of those that are analysed.
STRIPS = 32


def _clock_times(system: CompiledSystem, *, phases: bool) -> set[str]:
    return {clock.phase if phases else clock.period for clock in system.clocks}


def reaches_period(system: CompiledSystem, free: Free) -> bool:
    """Say whether the period of some clock is, or depends on, this parameter."""
    return _reaches(system, free, _clock_times(system, phases=False))


def _reaches(system: CompiledSystem, free: Free, times: set[str]) -> bool:
    return free.name in times or free.name in scope_of(system).needed(sorted(times))


def refuse_phase(system: CompiledSystem, free: Free, place: Place, *, code: str = "E844") -> None:
    """Raise ApcError E844, or another code, for what the phase of a clock depends on, and no period."""
    if _reaches(system, free, _clock_times(system, phases=True)) and not reaches_period(system, free):
        what = f"{free.name} sets the phase of a clock: it can't be varied continuously"
        raise ApcError(Mistake(code, place, what, hint="apc analyze with --set, one value at a time"))


def is_scaled(system: CompiledSystem, free: Free, *, delays: bool = False) -> bool:
    """Say whether all periods and phases are proportional to a number, with `delays` all other times, too."""
    now, timings = delay_now(system, free), resolve(system).timings
    names = _clock_times(system, phases=False) | _clock_times(system, phases=True)
    doubled = resolve(system_with_delay(system, free, 2 * now)).timings
    slopes = timing_slopes(system, free)
    return all(
        timings[name] == slopes[name] * now and doubled[name] == 2 * timings[name]
        for name in (timings if delays else names)
    )


def _ticks(system: CompiledSystem, free: Free, value: Fraction) -> float:
    """Return how many ticks all clocks have in a frame at a value, infinite where there is no frame."""
    try:
        timings = resolve(system_with_delay(system, free, value)).timings
    except ApcError:  # beyond what the number may be
        return math.inf
    used = {partition.clock for kind in system.kinds for partition in kind.clocks}
    used |= {link.clock for link in system.links}
    periods = [timings[clock.period] for clock in system.clocks if clock.name in used]
    if not all(period > 0 for period in periods):
        return math.inf
    frame = common_multiple(periods)
    return float(sum(frame / period for period in periods))


def _simplest(low: Fraction, high: Fraction) -> Fraction:
    """Return the fraction of the least denominator strictly between two, 0 ≤ low < high."""
    whole = math.floor(low)
    if whole + 1 < high:
        return Fraction(whole + 1)
    if low == whole:
        return whole + Fraction(1, math.floor(1 / (high - whole)) + 1)
    return whole + 1 / _simplest(1 / (high - whole), 1 / (low - whole))


def _unit(system: CompiledSystem, free: Free) -> Fraction:
    """Return the common divisor of the periods that stay, in seconds: periods are fractions of it."""
    slopes, timings = timing_slopes(system, free), resolve(system).timings
    fixed = [timings[name] for name in _clock_times(system, phases=False) if not slopes[name]]
    return common_divisor(fixed) if fixed else delay_now(system, free)


def _between(
    system: CompiledSystem, free: Free, unit: Fraction, low: Fraction, high: Fraction
) -> Fraction | None:
    """Return the simplest value strictly between two whose frame is short enough, None if there is none."""
    value = unit * _simplest(low / unit, high / unit)
    return value if _ticks(system, free, value) <= MOST_FRAME_TICKS else None


@lru_cache(maxsize=KEPT)
def nearest_period(system: CompiledSystem, free: Free, value: Fraction) -> Fraction:
    """Return a period near a value, by powers of ten, whose frame is short; any other time as it is."""
    if value <= 0 or not reaches_period(system, free) or is_scaled(system, free):
        return value
    if _ticks(system, free, value) <= MOST_FRAME_TICKS:
        return value
    unit = _unit(system, free)
    for digits in range(DIGITS, 0, -1):
        off = value / 10**digits
        near = _between(system, free, unit, value - off, value + off)
        if near is not None:
            return near
    return value


def periods_near(
    system: CompiledSystem, free: Free, targets: Sequence[Fraction], place: Place
) -> list[Fraction]:
    """Return the simplest periods near some values, those of too long a frame left out.

    Parameters
    ----------
    system, free
        The compiled topology and the number that varies.
    targets
        Values in rising order, in seconds; the first and last are taken as they are where they can be.
    place
        Where the number was given, for messages.

    Raises
    ------
    ApcError
        E844 fewer than two have a frame of at most `MOST_FRAME_TICKS` ticks.
    """
    unit = _unit(system, free)
    found = {value for value in (targets[0], targets[-1]) if _ticks(system, free, value) <= MOST_FRAME_TICKS}
    for before, value, after in zip(targets, targets[1:], targets[2:], strict=False):
        low, high = value - (value - before) / 3, value + (after - value) / 3
        near = _between(system, free, unit, low, high)
        if near is not None:
            found.add(near)
    if len(found) < 2:
        span = " to ".join(with_unit(f"{float(end):g}", "s") for end in (targets[0], targets[-1]))
        what = (
            f"periods of {free.label} from {span} make frames of more than {MOST_FRAME_TICKS:,} ticks "
            "with the other clocks"
        )
        hint = f"a range about a multiple of {with_unit(f'{float(unit):g}', 's')}"
        raise ApcError(Mistake("E844", place, what, hint=hint))
    return sorted(found)


def period_pieces(system: CompiledSystem, axis: Range, place: Place) -> Iterator[Piece]:
    """Yield a piece for each of some periods of a range, with ends halfway to those beside it.

    Raises
    ------
    ApcError
        As `periods_near`.
    """
    step = (axis.high - axis.low) / STRIPS
    values = periods_near(system, axis.free, [axis.low + step * k for k in range(STRIPS + 1)], place)
    middles = [(before + after) / 2 for before, after in itertools.pairwise(values)]
    for value, low, high in zip(values, [axis.low, *middles], [*middles, axis.high], strict=True):
        yield Piece(low, high, None, system_with_delay(system, axis.free, value))


@dataclass(frozen=True, eq=False)
class PeriodLine(JudgedLine):
    """A number that clock periods depend on, from `low` to `high` or, where None, from the present value.

    `decide` gives the verdict of a topology.
    """

    decide: Callable[[CompiledSystem], Verdict]
    low: Fraction | None
    high: Fraction | None
    place: Place

    def _verdict(self, value: Fraction) -> Verdict:
        return self.decide(system_with_delay(self.system, self.free, value))

    def stretches(self) -> Iterator[Stretch]:
        """Yield one stretch where all clocks scale with the number, else one for each period."""
        now = delay_now(self.system, self.free)
        low = self.low or now / PERIOD_SPAN
        high = self.high or max(now, low) * PERIOD_SPAN
        points = spread(float(low), float(high), float(now))
        look = partial(one_by_one, self.judge)
        if is_scaled(self.system, self.free):
            yield Stretch(low, high, points, float(low), look, self.judge, slow=True)
            return
        targets = sorted({low, *map(Fraction, points[1:-1].tolist()), high})
        for at in periods_near(self.system, self.free, targets, self.place):
            yield Stretch(at, at, np.array([float(at)]), 0.0, partial(self._look, at), self.judge, slow=True)

    def _look(self, value: Fraction, _: Floats) -> tuple[Complexes, Complexes]:
        return one_by_one(lambda _: self.judge(value), np.array([float(value)]))

    def change(self, before: Stretch, after: Stretch, *, stable_below: bool) -> Crossing:
        """Return the change between two periods, as near as the frames allow."""
        low, high = before.low, after.low
        unit = _unit(self.system, self.free)
        verdicts = [self.judge(low), self.judge(high)]
        while True:
            third = (high - low) / 3
            value = _between(self.system, self.free, unit, low + third, high - third)
            value = value or _between(self.system, self.free, unit, low, high)
            at = None if value is None else self.judge(value)
            if value is None or at is None or at.stable is None:
                break
            if at.stable is stable_below:
                low, verdicts[0] = value, at
            else:
                high, verdicts[1] = value, at
        decided = [verdict.stable for verdict in verdicts] == [stable_below, not stable_below]
        grows = verdicts[1 if stable_below else 0]
        proof = "analysed on either side" if decided else ESTIMATE
        side = "below" if stable_below else "above"
        return Crossing(
            float((low + high) / 2), float((high - low) / 2), side, grows.frequency_hz, PERIOD, proof
        )
