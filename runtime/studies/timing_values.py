"""The values of a time, and the clock periods with short frames.

Takes: a `Model` and a timing, or a parameter that a timing depends on.
Gives: `model_with_time`, `delay_now`, `timing_slopes`; `reaches_period`, `refuse_phase`, `is_scaled`;
`nearest_period`, `periods_near`, `period_between`, `base_value`; `MOST_FRAME_TICKS`;
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
from apc.compiler.peer_counts import clocks_in_use
from apc.compiler.wording import with_unit
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, unit_of
from apc.parameter_values.parameters import resolve, scope_of

# Ticks of all clocks in the longest frame that is analyzed: some tenths of a second each.
MOST_FRAME_TICKS = 400
# The distance of two values of a parameter for computing the slope of each timing.
STEP = Fraction(1, 1009)
# Denominator of the first ratio in the search for a long frame.
TRIAL = 101
# Shares of the distance between a period and the end of its interval, within which a long frame is searched.
SHARES = (Fraction(1, 32), Fraction(1, 4), Fraction(1))
# The units of rates.
RATES = ("Hz", "1/s")
# The largest number of matching digits of a replaced period; the number of cached periods.
DIGITS, CACHE_SIZE = 9, 256


def model_with_time(model: Model, parameter_ref: ParameterRef, value: Fraction) -> Model:
    """Return the model with another value of the timing or of the parameter that affects timings."""
    return apply(model, [Override(parameter_ref, value)])


def delay_now(model: Model, parameter_ref: ParameterRef) -> Fraction:
    """Return the present value of a timing, or of a parameter that affects timings, exactly."""
    for timing in model.timings:
        if timing.name == parameter_ref.name:
            return timing.value
    return next(parameter.number for parameter in model.parameters if parameter.name == parameter_ref.name)


@lru_cache(maxsize=CACHE_SIZE)
def timing_slopes(model: Model, parameter_ref: ParameterRef) -> Mapping[str, Fraction]:
    """Return the slope of each timing with respect to a parameter or timing, by its name."""
    now = delay_now(model, parameter_ref)
    now_timings, shifted_timings = (
        resolve(model_with_time(model, parameter_ref, value)).timings for value in (now, now + STEP)
    )
    return {name: (shifted_timings[name] - now_timings[name]) / STEP for name in now_timings}


def _clock_times(model: Model, *, phases: bool) -> set[str]:
    """Return the names of the phases, or of the periods, of all clocks."""
    return {clock.phase if phases else clock.period for clock in model.clocks}


def reaches_period(model: Model, parameter_ref: ParameterRef) -> bool:
    """Return whether the period of some clock is, or depends on, this parameter."""
    return _affects_times(model, parameter_ref, _clock_times(model, phases=False))


def _affects_times(model: Model, parameter_ref: ParameterRef, times: set[str]) -> bool:
    """Return whether a parameter is one of these times, or affects one."""
    return parameter_ref.name in times or parameter_ref.name in scope_of(model).needed(sorted(times))


def refuse_phase(
    model: Model, parameter_ref: ParameterRef, location: SourceLocation, *, code: str = "E844"
) -> None:
    """Raise an error E844, or another code, for a number that affects the phase of a clock but no period."""
    if _affects_times(model, parameter_ref, _clock_times(model, phases=True)) and not reaches_period(
        model, parameter_ref
    ):
        message = f"{parameter_ref.name} sets the phase of a clock: it can't be varied continuously"
        raise ApcError(
            Diagnostic(code, location, message, advice="analyze single values with apc analyze --set")
        )


def is_scaled(model: Model, parameter_ref: ParameterRef, *, delays: bool = False) -> bool:
    """Return whether the ratios of all periods and phases are the same at every value of a number.

    With `delays`, those of the delays, too.
    """
    now, timings = delay_now(model, parameter_ref), resolve(model).timings
    names = _clock_times(model, phases=False) | _clock_times(model, phases=True)
    first = model.clocks[0].period
    for value in (2 * now, now + STEP):
        changed = resolve(model_with_time(model, parameter_ref, value)).timings
        factor = changed[first] / timings[first]
        if any(changed[name] != factor * timings[name] for name in (timings if delays else names)):
            return False
    return True


def _frame_ticks(model: Model, parameter_ref: ParameterRef, value: Fraction) -> float:
    """Return the number of ticks of all clocks in a frame at a value, infinite without a frame."""
    try:
        timings = resolve(model_with_time(model, parameter_ref, value)).timings
    except ApcError:  # beyond the bounds of the number
        return math.inf
    used = clocks_in_use(model)
    periods = [timings[clock.period] for clock in model.clocks if clock.name in used]
    if not all(period > 0 for period in periods):
        return math.inf
    frame = common_multiple(periods)
    return float(sum(frame / period for period in periods))


def _simplest_fraction(low: Fraction, high: Fraction) -> Fraction:
    """Return the fraction of the least denominator strictly between two, 0 ≤ low < high."""
    whole = math.floor(low)
    if whole + 1 < high:
        return Fraction(whole + 1)
    if low == whole:
        return whole + Fraction(1, math.floor(1 / (high - whole)) + 1)
    return whole + 1 / _simplest_fraction(1 / (high - whole), 1 / (low - whole))


def base_value(model: Model, parameter_ref: ParameterRef) -> Fraction:
    """Return the value in SI whose multiples by simple fractions lead to short frames.

    It is the common multiple F of the constant periods for a time, its inverse for a rate, 1 for another
    number, and the present value if there is no constant period. With a period a/b F in lowest terms a frame
    is a F long.
    """
    return _base_values(model, parameter_ref)[0]


def _base_values(model: Model, parameter_ref: ParameterRef) -> tuple[Fraction, ...]:
    """Return the value of `base_value`, and the same of the common divisor of the constant periods."""
    slopes, timings = timing_slopes(model, parameter_ref), resolve(model).timings
    fixed = [timings[name] for name in _clock_times(model, phases=False) if not slopes[name]]
    if not fixed:
        return (delay_now(model, parameter_ref),)
    unit, times = unit_of(model, parameter_ref.name), (common_multiple(fixed), common_divisor(fixed))
    return times if unit == "s" else tuple(1 / time for time in times) if unit in RATES else (Fraction(1),)


def period_between(
    model: Model, parameter_ref: ParameterRef, unit: Fraction, low: Fraction, high: Fraction
) -> Fraction | None:
    """Return the simplest value strictly between two, None if its frame is too long.

    Parameters
    ----------
    model, parameter_ref
        The compiled model and the number that varies.
    unit
        The value from `base_value`.
    low, high
        The two values in SI.
    """
    value = unit * _simplest_fraction(low / unit, high / unit)
    return value if _frame_ticks(model, parameter_ref, value) <= MOST_FRAME_TICKS else None


def long_period_between(
    model: Model,
    parameter_ref: ParameterRef,
    unit: Fraction,
    low: Fraction,
    high: Fraction,
) -> Fraction | None:
    """Return a value strictly between two with nearly `MOST_FRAME_TICKS` ticks in a frame, None if none is.

    A period in a simple ratio to the others samples few of the instants at which packets can arrive: its
    verdict may differ from that of all periods near it.

    Parameters
    ----------
    model, parameter_ref, unit, low, high
        As for `period_between`.
    """
    middle = (low + high) / 2
    trial = unit * Fraction(round(TRIAL * middle / unit) or 1, TRIAL)
    largest_denominator = TRIAL * MOST_FRAME_TICKS / _frame_ticks(model, parameter_ref, trial)
    if not math.isfinite(largest_denominator):
        return None
    for denominator in range(int(largest_denominator), max(int(largest_denominator / 2), 1), -1):
        numerator = round(denominator * middle / unit)
        value = unit * Fraction(numerator, denominator)
        if math.gcd(numerator, denominator) == 1 and low < value < high:
            return value if _frame_ticks(model, parameter_ref, value) <= MOST_FRAME_TICKS else None
    return None


@lru_cache(maxsize=CACHE_SIZE)
def nearest_period(model: Model, parameter_ref: ParameterRef, value: Fraction) -> Fraction:
    """Return the nearest period with a short frame, to as many digits as possible; other times unchanged."""
    if value <= 0 or not reaches_period(model, parameter_ref) or is_scaled(model, parameter_ref):
        return value
    if _frame_ticks(model, parameter_ref, value) <= MOST_FRAME_TICKS:
        return value
    unit = base_value(model, parameter_ref)
    for digits in range(DIGITS, 0, -1):
        error_bound = value / 10**digits
        near = period_between(model, parameter_ref, unit, value - error_bound, value + error_bound)
        if near is not None:
            return near
    return value


def periods_near(
    model: Model,
    parameter_ref: ParameterRef,
    targets: Sequence[Fraction],
    location: SourceLocation,
    *,
    included: Sequence[Fraction] = (),
) -> list[Fraction]:
    """Return values of a period or rate near some values, ascending, each with a frame of allowed length.

    They are, near each value between the first and the last, those in the simplest ratio to the common
    multiple and divisor of the constant periods, and on either side of each one in a ratio so complex that
    its frame has nearly `MOST_FRAME_TICKS` ticks (see `long_period_between`). The first and the last value,
    and those of `included`, are included unchanged if their frames are short.

    Parameters
    ----------
    model, parameter_ref
        The compiled model and the number that varies.
    targets
        The values in ascending order, in SI.
    location
        The location of the number, for messages.
    included
        Further values in SI.

    Raises
    ------
    ApcError
        E844 fewer than two periods have a frame of at most `MOST_FRAME_TICKS` ticks.
    """
    unit, *others = _base_values(model, parameter_ref)
    periods = {
        value
        for value in (targets[0], *included, targets[-1])
        if _frame_ticks(model, parameter_ref, value) <= MOST_FRAME_TICKS
    }
    for before, value, after in zip(targets, targets[1:], targets[2:], strict=False):
        low, high = value - (value - before) / 3, value + (after - value) / 3
        simplest = {period_between(model, parameter_ref, base, low, high) for base in (unit, *others)} - {
            None
        }
        for near in filter(None, simplest):
            periods.add(near)
            for end in (low, high):  # on both sides of it, as near as possible
                for share in SHARES:
                    ends = sorted((near, near + (end - near) * share))
                    long_period = long_period_between(model, parameter_ref, unit, *ends)
                    if long_period is not None:
                        periods.add(long_period)
                        break
    if len(periods) < 2:
        si_unit = str(unit_of(model, parameter_ref.name))
        span = " to ".join(with_unit(f"{float(end):g}", si_unit) for end in (targets[0], targets[-1]))
        message = (
            f"values of {parameter_ref.label} from {span} lead to frames of more than "
            f"{MOST_FRAME_TICKS:,} ticks with the other clocks"
        )
        advice = f"use a range around a simple fraction of {with_unit(f'{float(unit):g}', si_unit)}"
        raise ApcError(Diagnostic("E844", location, message, advice=advice))
    return sorted(periods)
