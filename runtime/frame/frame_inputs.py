"""External inputs and outputs of a peer: values set from outside within a frame, and readings of it.

Takes: a `LinearSubsystem` whose last holds are the inputs, and its `Schedule`.
Gives: `FrameInputs`, `with_holds`, `with_ports`; `with_cuts`, `OUTSIDE`.
Guarantees: the motion of the peer is unchanged; inputs and readings are entries of z, so that every step of
the kernel includes them.
Does not: choose inputs, or lift.

Each input value is set as the frame begins, acts from its instant to the next, and is cleared when the frame
ends: a value of an extra clock, in the notation of `schedule`. A reading is stored until the frame ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ClockPartition, Hold, PeerType
from apc.frame.linear_subsystem import LinearSubsystem, LinearTick
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

Matrix = NDArray[Any]
Indices = NDArray[np.intp]

# The clocks of inputs and of readings; no clock of a topology can have these names.
INPUTS, READINGS = "what comes in", "what is read"

# The operator of an external input among received packets; it belongs to no link.
OUTSIDE = ReceivedSample(CouplingTerm("", "", ""), SentSample("", "", 0), 0)


@dataclass(frozen=True, slots=True, eq=False)
class FrameInputs:
    """The indices in z of inputs and readings: `input_slots` (instants, inputs) and `read` (instants,
    readings).

    `added` are all entries of z that the peer alone does not have.
    """

    input_slots: Indices
    read: Indices
    added: range


def with_holds(subsystem: LinearSubsystem, columns: Matrix) -> LinearSubsystem:
    """Return a subsystem with additional holds whose values are unused and that move states by given columns.

    Parameters
    ----------
    subsystem
        The subsystem, of floats or of rationals, or many (k, …).
    columns
        Columns (n_x, inputs), in the same number type and batch size.
    """
    inputs = columns.shape[-1]

    def widened(matrix: Matrix) -> Matrix:
        zero = np.zeros((*matrix.shape[:-1], inputs), dtype=matrix.dtype)
        return np.concatenate([matrix, zero], axis=-1)

    holds = tuple(Hold(f"input {number + 1}", INPUTS, number, "") for number in range(inputs))
    return replace(
        subsystem,
        peer_type=replace(subsystem.peer_type, holds=(*subsystem.peer_type.holds, *holds)),
        b=np.concatenate([subsystem.b, columns], axis=-1),
        ticks=tuple(replace(tick, u=widened(tick.u)) for tick in subsystem.ticks),
        sends=tuple(replace(send, u=widened(send.u)) for send in subsystem.sends),
    )


def with_cuts(
    subsystem: LinearSubsystem, schedule: Schedule, cuts: Sequence[tuple[int, int]]
) -> tuple[LinearSubsystem, Schedule]:
    """Return a subsystem some of whose computed values are replaced by external inputs, and its schedule.

    The replaced value is an additional output of its partition at each tick. Sorted by cut and tick, these
    outputs are the last carried values, and the inputs are the last received values.

    Parameters
    ----------
    subsystem
        The subsystem, of floats or of rationals.
    schedule
        The events of a frame.
    cuts
        The partition and output of each replaced value.
    """
    ticks, clocks = list(subsystem.ticks), list(subsystem.peer_type.clocks)
    discrete_states, received = list(schedule.discrete_states), list(schedule.received)
    rows: dict[int, list[int]] = {}
    for partition, output in cuts:
        tick, clock, count = ticks[partition], clocks[partition], schedule.ticks[partition]
        outputs = len(clock.outputs)
        # A tick may have several variants of its rows, stacked; cuts before this one added some.
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
        rows.setdefault(partition, []).append(len(received))
        discrete_states += [ClockedValue(partition, outputs, index - count) for index in range(count)]
        received += [OUTSIDE] * count
    events = tuple(
        replace(
            event,
            input_rows=(*event.input_rows, *((row + event.index,) for row in rows.get(event.partition, ()))),
        )
        if isinstance(event, Tick)
        else event
        for event in schedule.events
    )
    peer_type = replace(subsystem.peer_type, clocks=tuple(clocks))
    cut = replace(
        schedule,
        events=events,
        discrete_states=tuple(discrete_states),
        received=tuple(received),
        repeats=None,
    )
    return replace(subsystem, peer_type=peer_type, ticks=tuple(ticks)), cut


def with_ports(
    subsystems: Sequence[LinearSubsystem],
    schedule: Schedule,
    inputs: int,
    input_slots_at: Sequence[int],
    readings: Sequence[Matrix],
    read_at: Sequence[int],
) -> tuple[list[LinearSubsystem], Schedule, FrameInputs]:
    """Return a subsystem with inputs and readings, in each number type, and their indices.

    Parameters
    ----------
    subsystems
        The subsystem in one or more number types; its last holds are the inputs, of clock `INPUTS`.
    schedule
        The events of a frame.
    inputs
        The number of inputs.
    input_slots_at
        The instants of a frame, in quanta, at which new values begin to act, before all other events there.
    readings
        The readings over states and holds (readings, n_x + n_u), in each number type.
    read_at
        The instants of the readings, after all other events there.
    """
    peer_type = subsystems[0].peer_type
    clock, first = len(peer_type.clocks), len(peer_type.holds) - inputs
    outputs = readings[0].shape[-2]
    of_inputs = tuple(f"{word} {number + 1}" for word in ("drawn", "acting") for number in range(inputs))
    of_readings = tuple(f"reading {number + 1}" for number in range(outputs))
    peer_type = replace(
        peer_type,
        clocks=(
            *peer_type.clocks,
            ClockPartition(INPUTS, of_inputs, ("1",) * (2 * inputs), (), (), (), casadi.Function()),
            ClockPartition(READINGS, of_readings, ("1",) * outputs, (), (), (), casadi.Function()),
        ),
    )
    count, used = len(input_slots_at), len(read_at)
    carries = bool(count and input_slots_at[0] > 0)  # the last value of a frame stays active in the next
    input_slots = [
        ClockedValue(clock, index, number - count) for number in range(count) for index in range(inputs)
    ]
    before = [ClockedValue(clock, inputs + index, -1) for index in range(inputs)] if carries else []
    read = [
        ClockedValue(clock + 1, index, number - used) for number in range(used) for index in range(outputs)
    ]
    acts: dict[int, list[Event]] = {
        instant: [HoldUpdate(first + index, input_slots[number * inputs + index]) for index in range(inputs)]
        for number, instant in enumerate(input_slots_at)
    }
    taking = {instant: Tick(clock + 1, number, ()) for number, instant in enumerate(read_at)}
    events: list[Event] = []
    begun = -1
    for now, event in _stopping(schedule, {*input_slots_at, *read_at}):
        if now > begun:
            events += acts.get(now, [])
            begun = now
        if isinstance(event, Propagate) and now in taking:
            events.append(taking[now])
        events.append(event)
    events += [Tick(clock, number, ()) for number in range(count)]
    start = len(peer_type.states) + len(schedule.discrete_states)
    names = [
        f"{word} at {at}"
        for word, values in (("in", input_slots), ("before", before), ("out", read))
        for at in range(len(values))
    ]
    full = replace(
        schedule,
        events=tuple(events),
        active_at_start=(*schedule.active_at_start, *(before if carries else (None,) * inputs)),
        discrete_states=(*schedule.discrete_states, *input_slots, *before, *read),
        ticks=(*schedule.ticks, count, used),
        value_names=(*schedule.value_names, *names),
        repeats=None,
    )
    behind = start + len(input_slots) + len(before)
    ports = FrameInputs(
        input_slots=np.arange(start, start + len(input_slots)).reshape(count, inputs),
        read=np.arange(behind, behind + len(read)).reshape(used, outputs),
        added=range(start, behind + len(read)),
    )
    made = [
        _with_clocks(subsystem, peer_type, inputs, rows)
        for subsystem, rows in zip(subsystems, readings, strict=True)
    ]
    return made, full, ports


def _with_clocks(
    subsystem: LinearSubsystem, peer_type: PeerType, inputs: int, readings: Matrix
) -> LinearSubsystem:
    """Return a subsystem with the clocks of inputs and readings."""
    *many, n_x, n_u = subsystem.b.shape
    number = subsystem.b.dtype

    def nothing(rows: int, columns: int) -> Matrix:
        return np.zeros((*many, rows, columns), dtype=number)

    active_at_start = nothing(2 * inputs, n_u)
    active_at_start[..., inputs:, n_u - inputs :] += np.eye(inputs, dtype=np.int64)
    rows = readings.shape[-2]
    ticks = (
        LinearTick(
            INPUTS,
            nothing(2 * inputs, n_x),
            active_at_start,
            nothing(2 * inputs, 0),
            nothing(2 * inputs, 0),
            (),
        ),
        LinearTick(
            READINGS, readings[..., :n_x], readings[..., n_x:], nothing(rows, 0), nothing(rows, 0), ()
        ),
    )
    return replace(subsystem, peer_type=peer_type, ticks=(*subsystem.ticks, *ticks))


def _stopping(schedule: Schedule, at: set[int]) -> list[tuple[int, Event]]:
    """Return a frame's events, each with its instant in quanta; propagation stops at given instants."""
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
