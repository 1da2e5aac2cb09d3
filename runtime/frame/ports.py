"""A peer with ways in and out: values that come from outside in a frame, and what is read of it there.

Takes: a `LinearSubsystem` whose last holds are the ways in, and its `Schedule`.
Gives: `FrameInputs`, `with_holds`, `with_ports`; `with_cuts`, `OUTSIDE`.
Guarantees: the peer moves as before; what comes in and what is read are entries of z, so that every step of
the kernel takes them along.
Does not: say what comes in, or lift.

Each value is drawn as the frame begins, acts from its instant to the next, and is gone when the frame ends: a
value of a clock of its own, as `schedule` has them. What is read stays until the frame ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ClockPartition, Hold, PeerType
from apc.frame.schedule import (
    ClockedValue,
    CouplingTerm,
    Event,
    HoldUpdate,
    Propagate,
    ReceivedSample,
    Schedule,
    SentSample,
    Tick,
)
from apc.frame.site import LinearSubsystem, LinearTick

Matrix = NDArray[Any]
Places = NDArray[np.intp]

# The clocks of what comes in and of what is read, which no scene can name so.
INPUTS, READINGS = "what comes in", "what is read"

# What comes from outside stands where packets do, and is of no link.
OUTSIDE = ReceivedSample(CouplingTerm("", "", ""), SentSample("", "", 0), 0)


@dataclass(frozen=True, slots=True, eq=False)
class FrameInputs:
    """Where in z the ways in and out are: `drawn` (instants, inputs) and `read` (instants, readings).

    `added` are all entries of z that the peer has not by itself.
    """

    drawn: Places
    read: Places
    added: range


def with_holds(site: LinearSubsystem, columns: Matrix) -> LinearSubsystem:
    """Return a site with more holds, whose values nothing reads and that move states as the columns say.

    Parameters
    ----------
    site
        The site, of floats or of rationals, or many (k, …).
    columns
        (n_x, inputs), of the same numbers, of as many.
    """
    inputs = columns.shape[-1]

    def widened(matrix: Matrix) -> Matrix:
        zero = np.zeros((*matrix.shape[:-1], inputs), dtype=matrix.dtype)
        return np.concatenate([matrix, zero], axis=-1)

    holds = tuple(Hold(f"input {number + 1}", INPUTS, number, "") for number in range(inputs))
    return replace(
        site,
        kind=replace(site.kind, holds=(*site.kind.holds, *holds)),
        b=np.concatenate([site.b, columns], axis=-1),
        ticks=tuple(replace(tick, u=widened(tick.u)) for tick in site.ticks),
        sends=tuple(replace(send, u=widened(send.u)) for send in site.sends),
    )


def with_cuts(
    site: LinearSubsystem, schedule: Schedule, cuts: Sequence[tuple[int, int]]
) -> tuple[LinearSubsystem, Schedule]:
    """Return a site some of whose computed values come from outside, and its schedule.

    What a tick would compute of such a value is one more output of its partition. Cut by cut and tick by
    tick, that is the last that is carried, and what comes in the last that is heard.

    Parameters
    ----------
    site
        The site, of floats or of rationals.
    schedule
        What happens in a frame.
    cuts
        The partition and output of each value.
    """
    ticks, clocks = list(site.ticks), list(site.kind.clocks)
    carried, heard = list(schedule.carried), list(schedule.heard)
    rows: dict[int, list[int]] = {}
    for partition, output in cuts:
        tick, clock, count = ticks[partition], clocks[partition], schedule.ticks[partition]
        outputs = len(clock.outputs)
        # A tick may have several variants of its rows, one below the other; cuts before this one added some.
        variants = len(tick.x) // outputs
        into = np.zeros((len(tick.r), 1), dtype=tick.r.dtype)
        blocks = []
        for block in (tick.x, tick.u, tick.m, np.concatenate([tick.r, into], axis=1)):
            values = block.reshape(variants, outputs, block.shape[1])
            values = np.concatenate([values, values[:, output : output + 1]], axis=1)
            values[:, output] = 0
            blocks.append(values.reshape(variants * (outputs + 1), block.shape[1]))
        x, u, m, r = blocks
        r[output :: outputs + 1, -1] = 1
        ticks[partition] = replace(tick, x=x, u=u, m=m, r=r)
        clocks[partition] = replace(
            clock, outputs=(*clock.outputs, f"followed {outputs}"), units=(*clock.units, "1")
        )
        rows.setdefault(partition, []).append(len(heard))
        carried += [ClockedValue(partition, outputs, index - count) for index in range(count)]
        heard += [OUTSIDE] * count
    events = tuple(
        replace(event, heard=(*event.heard, *((row + event.index,) for row in rows.get(event.partition, ()))))
        if isinstance(event, Tick)
        else event
        for event in schedule.events
    )
    kind = replace(site.kind, clocks=tuple(clocks))
    cut = replace(schedule, events=events, carried=tuple(carried), heard=tuple(heard), repeats=None)
    return replace(site, kind=kind, ticks=tuple(ticks)), cut


def with_ports(
    sites: Sequence[LinearSubsystem],
    schedule: Schedule,
    inputs: int,
    drawn_at: Sequence[int],
    readings: Sequence[Matrix],
    read_at: Sequence[int],
) -> tuple[list[LinearSubsystem], Schedule, FrameInputs]:
    """Return a site, in one kind of number or several, with ways in and out, and where these are.

    Parameters
    ----------
    sites
        The site, its last holds the ways in; their clock is `INPUTS`.
    schedule
        What happens in a frame.
    inputs
        How many ways in there are.
    drawn_at
        At which instants of a frame, in quanta, new values begin to act, before all else happens there.
    readings
        What is read, over states and holds (readings, n_x + n_u), in the kinds of number of the sites.
    read_at
        At which instants, after all else has happened there.
    """
    kind = sites[0].kind
    clock, first = len(kind.clocks), len(kind.holds) - inputs
    outputs = readings[0].shape[-2]
    of_inputs = tuple(f"{word} {number + 1}" for word in ("drawn", "acting") for number in range(inputs))
    of_readings = tuple(f"reading {number + 1}" for number in range(outputs))
    kind = replace(
        kind,
        clocks=(
            *kind.clocks,
            ClockPartition(INPUTS, of_inputs, ("1",) * (2 * inputs), (), (), (), casadi.Function()),
            ClockPartition(READINGS, of_readings, ("1",) * outputs, (), (), (), casadi.Function()),
        ),
    )
    count, taken = len(drawn_at), len(read_at)
    carries = bool(count and drawn_at[0] > 0)  # the last value of a frame acts on in the next
    drawn = [ClockedValue(clock, index, number - count) for number in range(count) for index in range(inputs)]
    before = [ClockedValue(clock, inputs + index, -1) for index in range(inputs)] if carries else []
    read = [
        ClockedValue(clock + 1, index, number - taken) for number in range(taken) for index in range(outputs)
    ]
    acts: dict[int, list[Event]] = {
        instant: [HoldUpdate(first + index, drawn[number * inputs + index]) for index in range(inputs)]
        for number, instant in enumerate(drawn_at)
    }
    taking = {instant: Tick(clock + 1, number, ()) for number, instant in enumerate(read_at)}
    events: list[Event] = []
    begun = -1
    for now, event in _stopping(schedule, {*drawn_at, *read_at}):
        if now > begun:
            events += acts.get(now, [])
            begun = now
        if isinstance(event, Propagate) and now in taking:
            events.append(taking[now])
        events.append(event)
    events += [Tick(clock, number, ()) for number in range(count)]
    start = len(kind.states) + len(schedule.carried)
    names = [
        f"{word} at {at}"
        for word, values in (("in", drawn), ("before", before), ("out", read))
        for at in range(len(values))
    ]
    full = replace(
        schedule,
        events=tuple(events),
        acting=(*schedule.acting, *(before if carries else (None,) * inputs)),
        carried=(*schedule.carried, *drawn, *before, *read),
        ticks=(*schedule.ticks, count, taken),
        value_names=(*schedule.value_names, *names),
        repeats=None,
    )
    behind = start + len(drawn) + len(before)
    ports = FrameInputs(
        drawn=np.arange(start, start + len(drawn)).reshape(count, inputs),
        read=np.arange(behind, behind + len(read)).reshape(taken, outputs),
        added=range(start, behind + len(read)),
    )
    made = [_with_clocks(site, kind, inputs, rows) for site, rows in zip(sites, readings, strict=True)]
    return made, full, ports


def _with_clocks(site: LinearSubsystem, kind: PeerType, inputs: int, readings: Matrix) -> LinearSubsystem:
    """Return a site with the clocks of ways in and out."""
    *many, n_x, n_u = site.b.shape
    number = site.b.dtype

    def nothing(rows: int, columns: int) -> Matrix:
        return np.zeros((*many, rows, columns), dtype=number)

    acting = nothing(2 * inputs, n_u)
    acting[..., inputs:, n_u - inputs :] += np.eye(inputs, dtype=np.int64)
    rows = readings.shape[-2]
    ticks = (
        LinearTick(
            INPUTS, nothing(2 * inputs, n_x), acting, nothing(2 * inputs, 0), nothing(2 * inputs, 0), ()
        ),
        LinearTick(
            READINGS, readings[..., :n_x], readings[..., n_x:], nothing(rows, 0), nothing(rows, 0), ()
        ),
    )
    return replace(site, kind=kind, ticks=(*site.ticks, *ticks))


def _stopping(schedule: Schedule, at: set[int]) -> list[tuple[int, Event]]:
    """Return a frame's events, each with its instant in quanta, so that propagation stops at some."""
    pairs: list[tuple[int, Event]] = []
    now = 0
    for event in schedule.events:
        if not isinstance(event, Propagate):
            pairs.append((now, event))
            continue
        end = now + event.duration
        for stop in sorted({number for number in at if now < number < end} | {end}):
            pairs.append((now, Propagate(stop - now)))
            now = stop
    return pairs
