"""The values of a time, and the clock periods that make short frames with the other clocks.

Takes: a `Model` and a timing, or a parameter that a timing depends on.
Gives: `system_with_delay`, `delay_now`, `timing_slopes`; `reaches_period`, `refuse_phase`, `is_scaled`;
`nearest_period`, `periods_near`, `period_between`, `common_period`; `MOST_FRAME_TICKS`;
`long_period_between`.
Guarantees: exact rationals of a second.
Does not: analyze.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import lru_cache

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.multiples import common_divisor, common_multiple
from apc.compiler.wording import with_unit
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef
from apc.frame.parameters import resolve, scope_of

# Ticks of all clocks in the longest frame that is analyzed: some tenths of a second each.
MOST_FRAME_TICKS = 400
# The distance of two values of a parameter for computing the slope of each timing.
STEP = Fraction(1, 1009)
# Denominator of the first ratio that is tried where a long frame is searched for.
TRIAL = 101
# Shares of the distance to the next value within which one is searched for.
SHARES = (Fraction(1, 32), Fraction(1, 4), Fraction(1))
# Digits to which a period is met, the most that serve; periods that are kept for the next question.
DIGITS, CACHE_SIZE = 9, 256


def system_with_delay(system: Model, free: ParameterRef, value: Fraction) -> Model:
    """Return the model with another value of the parameter that affects its delays."""
    return apply(system, [Override(free, value)])


def delay_now(system: Model, free: ParameterRef) -> Fraction:
    """Return the present value of a timing, or of a parameter that affects one, exactly."""
    for timing in system.timings:
        if timing.name == free.name:
            return timing.value
    return next(parameter.number for parameter in system.parameters if parameter.name == free.name)


@lru_cache(maxsize=CACHE_SIZE)
def timing_slopes(system: Model, free: ParameterRef) -> Mapping[str, Fraction]:
    """Return the slope of each timing with respect to a parameter or timing, by its name."""
    now = delay_now(system, free)
    here, there = (resolve(system_with_delay(system, free, value)).timings for value in (now, now + STEP))
    return {name: (there[name] - here[name]) / STEP for name in here}


def _clock_times(system: Model, *, phases: bool) -> set[str]:
    return {clock.phase if phases else clock.period for clock in system.clocks}


def reaches_period(system: Model, free: ParameterRef) -> bool:
    """Return whether the period of some clock is, or depends on, this parameter."""
    return _reaches(system, free, _clock_times(system, phases=False))


def _reaches(system: Model, free: ParameterRef, times: set[str]) -> bool:
    return free.name in times or free.name in scope_of(system).needed(sorted(times))


def refuse_phase(system: Model, free: ParameterRef, location: SourceLocation, *, code: str = "E844") -> None:
    """Raise ApcError E844, or another code, for a number that affects the phase of a clock, but no period."""
    if _reaches(system, free, _clock_times(system, phases=True)) and not reaches_period(system, free):
        message = f"{free.name} sets the phase of a clock: it can't be varied continuously"
        raise ApcError(
            Diagnostic(code, location, message, hint="apc analyze with --set, one value at a time")
        )


def is_scaled(system: Model, free: ParameterRef, *, delays: bool = False) -> bool:
    """Return whether all periods and phases are proportional to a number; `delays`: all times are."""
    now, timings = delay_now(system, free), resolve(system).timings
    names = _clock_times(system, phases=False) | _clock_times(system, phases=True)
    doubled = resolve(system_with_delay(system, free, 2 * now)).timings
    slopes = timing_slopes(system, free)
    return all(
        timings[name] == slopes[name] * now and doubled[name] == 2 * timings[name]
        for name in (timings if delays else names)
    )


def _ticks(system: Model, free: ParameterRef, value: Fraction) -> float:
    """Return the number of ticks of all clocks in a frame at a value, infinite where there is no frame."""
    try:
        timings = resolve(system_with_delay(system, free, value)).timings
    except ApcError:  # beyond the bounds of the number
        return math.inf
    used = {partition.clock for peer_type in system.peer_types for partition in peer_type.clocks}
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


def common_period(system: Model, free: ParameterRef) -> Fraction:
    """Return the common divisor of the periods that stay, in seconds: periods are fractions of it."""
    slopes, timings = timing_slopes(system, free), resolve(system).timings
    fixed = [timings[name] for name in _clock_times(system, phases=False) if not slopes[name]]
    return common_divisor(fixed) if fixed else delay_now(system, free)


def period_between(
    system: Model, free: ParameterRef, unit: Fraction, low: Fraction, high: Fraction
) -> Fraction | None:
    """Return the simplest value strictly between two whose frame is short enough, None if there is none.

    Parameters
    ----------
    system, free
        The compiled model and the number that varies.
    unit
        From `common_period`, in seconds.
    low, high
        The two values, in seconds.
    """
    value = unit * _simplest(low / unit, high / unit)
    return value if _ticks(system, free, value) <= MOST_FRAME_TICKS else None


def long_period_between(
    system: Model, free: ParameterRef, unit: Fraction, low: Fraction, high: Fraction
) -> Fraction | None:
    """Return a value strictly between two whose frame is about as long as allowed, None if there is none.

    A period in a simple ratio to the others samples few of the instants at which packets can arrive: its
    verdict may differ from that of all periods near it.

    Parameters
    ----------
    system, free, unit, low, high
        As for `period_between`.
    """
    middle = (low + high) / 2
    trial = unit * Fraction(round(TRIAL * middle / unit) or 1, TRIAL)
    most = TRIAL * MOST_FRAME_TICKS / _ticks(system, free, trial)
    if not math.isfinite(most):
        return None
    for denominator in range(int(most), max(int(most / 2), 1), -1):
        numerator = round(denominator * middle / unit)
        value = unit * Fraction(numerator, denominator)
        if math.gcd(numerator, denominator) == 1 and low < value < high:
            return value if _ticks(system, free, value) <= MOST_FRAME_TICKS else None
    return None


@lru_cache(maxsize=CACHE_SIZE)
def nearest_period(system: Model, free: ParameterRef, value: Fraction) -> Fraction:
    """Return a period near a value, by powers of ten, whose frame is short; any other time as it is."""
    if value <= 0 or not reaches_period(system, free) or is_scaled(system, free):
        return value
    if _ticks(system, free, value) <= MOST_FRAME_TICKS:
        return value
    unit = common_period(system, free)
    for digits in range(DIGITS, 0, -1):
        error_bound = value / 10**digits
        near = period_between(system, free, unit, value - error_bound, value + error_bound)
        if near is not None:
            return near
    return value


def periods_near(
    system: Model, free: ParameterRef, targets: Sequence[Fraction], location: SourceLocation
) -> list[Fraction]:
    """Return the simplest period near each of some values, and one of a long frame on either side of it.

    Parameters
    ----------
    system, free
        The compiled model and the number that varies.
    targets
        Values in rising order, in seconds; the first and last are taken as they are where they can be.
    location
        Where the number was given, for messages.

    Raises
    ------
    ApcError
        E844 fewer than two have a frame of at most `MOST_FRAME_TICKS` ticks.
    """
    unit = common_period(system, free)
    result = {value for value in (targets[0], targets[-1]) if _ticks(system, free, value) <= MOST_FRAME_TICKS}
    for before, value, after in zip(targets, targets[1:], targets[2:], strict=False):
        low, high = value - (value - before) / 3, value + (after - value) / 3
        near = period_between(system, free, unit, low, high)
        if near is None:
            continue
        result.add(near)
        for end in (low, high):  # on both sides of it, as near as there is one
            for share in SHARES:
                ends = sorted((near, near + (end - near) * share))
                long_period = long_period_between(system, free, unit, *ends)
                if long_period is not None:
                    result.add(long_period)
                    break
    if len(result) < 2:
        span = " to ".join(with_unit(f"{float(end):g}", "s") for end in (targets[0], targets[-1]))
        message = (
            f"periods of {free.label} from {span} make frames of more than {MOST_FRAME_TICKS:,} ticks "
            "with the other clocks"
        )
        hint = f"a range about a multiple of {with_unit(f'{float(unit):g}', 's')}"
        raise ApcError(Diagnostic("E844", location, message, hint=hint))
    return sorted(result)
