"""Exact time: the common quantum of all times, and the hyperperiod of the clocks, called the frame.

Takes: a `Model`, its timings as exact rationals, the live parts of its peer types.
Gives: `Times`, `ClockGrid`, `times_in_use`.
Guarantees: every period, phase and delay in use is an integer number of quanta; unused clocks and delays have
no effect.
Does not: list the events at an instant (see `scheduling`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.compiled import Clock, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.multiples import common_divisor, common_multiple
from apc.compiler.wording import enumerated
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.timing.liveness import ReceptionPattern, live_holds

NEAREST = Fraction(1, 100)  # relative change of a period that is proposed: larger ones are other designs
MOST_TICKS = 20_000  # in a frame: each is a step of the lifting


@dataclass(frozen=True, slots=True)
class ClockGrid:
    """A clock in quanta: ticks at phase + k*period for every integer k, 0 <= phase < period."""

    phase: int
    period: int

    def at(self, index: int) -> int:
        """Return the instant of a tick."""
        return self.phase + index * self.period

    def newest(self, limit: int, *, strictly: bool = False) -> int:
        """Return the index of the last tick at or (strictly) before `limit`."""
        index = (limit - self.phase) // self.period
        return index - 1 if strictly and self.at(index) == limit else index


@dataclass(frozen=True, slots=True)
class Times:
    """All times of a model in quanta: the frame, each clock's grid and each delay."""

    quantum: Fraction
    frame: int
    clocks: Mapping[str, ClockGrid]
    delays: Mapping[str, int]


def times_in_use(
    model: Model,
    timings: Mapping[str, Fraction],
    patterns: Sequence[LinearSubsystem],
    live: Sequence[frozenset[tuple[int, int]]],
    reception: Sequence[ReceptionPattern],
) -> Times:
    """Return the quantum that divides every period, phase and delay in use, and the frame.

    Parameters
    ----------
    model, timings
        The compiled model, and seconds by the name of the timing.
    patterns, live
        The structural pattern of each peer type, and its live outputs (see `liveness`).
    reception
        The coupling terms of each group's receives.

    Raises
    ------
    ApcError
        E805 too many ticks in a frame, E809 a delay below zero.
    """
    clock_of = {clock.name: clock for clock in model.clocks}
    link_of = {link.name: link for link in model.links}
    clocks: dict[str, Clock] = {}
    delays: dict[str, Fraction] = {}
    for pattern, outputs in zip(patterns, live, strict=True):
        for partition, _ in outputs:
            name = pattern.peer_type.clocks[partition].clock
            clocks[name] = clock_of[name]
        for hold, used in zip(pattern.peer_type.holds, live_holds(pattern, outputs), strict=True):
            if used:
                delays[hold.delay] = timings[hold.delay]
    for coupling_term, _ in (
        pair for group in reception for partition in group for receive in partition for pair in receive
    ):
        clock = coupling_term.clock or link_of[coupling_term.link].clock
        clocks[clock] = clock_of[clock]
        delays[coupling_term.delay] = timings[coupling_term.delay]
    for name, delay in delays.items():
        if delay < 0:
            formulas = (timing.formula for timing in model.timings if timing.name == name)
            formula, got = next(formulas, None), f"{1000 * float(delay):g} ms"
            shown = f"delay {formula.text} of a hold" if formula and name.startswith("delay of ") else name
            raise ApcError(
                Diagnostic("E809", SourceLocation(model.origin.topology), shown, "0 ms or more", got)
            )
    if not clocks:  # nothing is sampled: any frame will do
        clocks = dict(clock_of) or {"": Clock("", "", "")}
    period = {name: timings[clock.period] if name else Fraction(1) for name, clock in clocks.items()}
    phase = {
        name: timings[clock.phase] % period[name] if name else Fraction(0) for name, clock in clocks.items()
    }
    quantum = common_divisor([*period.values(), *phase.values(), *delays.values()])
    period_quanta = {name: int(value / quantum) for name, value in period.items()}
    frame = int(common_multiple(period.values()) / quantum)
    _check_frame_length(model, period, period_quanta, frame, quantum)
    return Times(
        quantum=quantum,
        frame=frame,
        clocks={name: ClockGrid(int(phase[name] / quantum), period_quanta[name]) for name in clocks},
        delays={name: int(value / quantum) for name, value in delays.items()},
    )


def _check_frame_length(
    model: Model,
    period: Mapping[str, Fraction],
    period_quanta: Mapping[str, int],
    frame: int,
    quantum: Fraction,
) -> None:
    """Raise ApcError E805 for clocks whose hyperperiod has too many ticks.

    Parameters
    ----------
    model
        The compiled model.
    period, period_quanta
        The period of each clock in seconds, and in quanta.
    frame, quantum
        The frame in quanta, and the quantum in seconds.
    """
    ticks = sum(frame // quanta for quanta in period_quanta.values())
    if ticks > MOST_TICKS:
        clocks = [f"{name} {float(value) * 1e3:.9g} ms" for name, value in period.items() if name]
        message = (
            f"the frame (common period of {enumerated(clocks)}) is {float(frame * quantum):.6g} s with "
            f"{ticks:,} ticks; the limit is {MOST_TICKS:,}"
        )
        fix, advice = "", "use periods that are simple multiples of each other"
        odd = max(model.clocks, key=lambda clock: period.get(clock.name, Fraction(0)).denominator)
        if frame == max(period_quanta.values()) and (fits := _fastest_that_fits(period_quanta, frame)):
            fastest = min(period_quanta, key=lambda name: period_quanta[name])
            odd = next(clock for clock in model.clocks if clock.name == fastest)
            periods = (1000 * frame * quantum / ticks for ticks in fits)
            short = (f"{float(ms):g} ms" for ms in periods if Fraction(f"{float(ms):.3g}") == ms)
            fix = f"{fastest}: {next(short, f'{frame * quantum / fits[0]} s')}"
            advice = ""
        elif period.get(odd.name) and (ms := _rounded(period, odd.name)):
            fix, advice = f"{odd.name}: {ms} ms", ""
        location = SourceLocation(model.origin.topology, odd.line, odd.column)
        raise ApcError(Diagnostic("E805", location, message, fix=fix, advice=advice))


def _rounded(periods: Mapping[str, Fraction], name: str) -> str:
    """Return a period in ms, rounded to as many digits as the limit of ticks in a frame permits.

    The result is empty if the period would change by more than `NEAREST`.

    Parameters
    ----------
    periods
        The period of each clock, in seconds.
    name
        The clock whose period is rounded.
    """
    given = periods[name]
    for digits in (3, 2, 1):
        text = f"{float(1000 * given):.{digits}g}"
        rounded = Fraction(text) / 1000
        changed = [*(period for other, period in periods.items() if other != name), rounded]
        frame = common_multiple(changed)
        if (
            abs(rounded - given) <= NEAREST * given
            and sum(frame / period for period in changed) <= MOST_TICKS
        ):
            return f"{float(text):g}"
    return ""


def _fastest_that_fits(period_quanta: Mapping[str, int], frame: int) -> range:
    """Return the possible tick counts of the fastest clock in a frame of the other clocks, largest first.

    `period_quanta` is the period of each clock in quanta; `frame` is the frame in quanta.
    """
    other_ticks = [frame // quanta for quanta in sorted(period_quanta.values())[1:]]
    step = math.lcm(*other_ticks)
    return range((MOST_TICKS - sum(other_ticks)) // step * step, 0, -step)
