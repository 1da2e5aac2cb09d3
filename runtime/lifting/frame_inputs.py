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
from apc.linearization.linear_subsystem import LinearSubsystem, LinearTick
from apc.timing.schedule import (
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
    """The indices in z of inputs and readings.

    `input_slots` (instants, inputs) are those of inputs, `read` (instants, readings) those of readings;
    `added` are all of them.
    """

    input_slots: Indices
    read: Indices
    added: range


def with_holds(subsystem: LinearSubsystem, columns: Matrix) -> LinearSubsystem:
    """Return a subsystem with additional holds, whose values are unused and act on the states by given
    columns.

    Parameters
    ----------
    subsystem
        The subsystem, of floats or of rationals, or many (k, …).
    columns
        Columns (n_x, inputs), in the same number type and batch size.
    """
    inputs = columns.shape[-1]

    def widened(matrix: Matrix) -> Matrix:
        """Return a matrix with a column of zeros for each added hold."""
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
    """Return a subsystem with some computed values replaced by external inputs, and its schedule.

    The replaced value is an additional output of its partition at each tick. Sorted by cut and tick, these
    outputs are the last discrete states, and the inputs are the last received values.

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
        input_column = np.zeros((len(tick.r), 1), dtype=tick.r.dtype)
        blocks = []
        for block in (tick.x, tick.u, tick.m, np.concatenate([tick.r, input_column], axis=1)):
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
    cut_schedule = replace(
        schedule,
        events=events,
        discrete_states=tuple(discrete_states),
        received=tuple(received),
        repeats=None,
    )
    return replace(subsystem, peer_type=peer_type, ticks=tuple(ticks)), cut_schedule


def with_ports(
    subsystems: Sequence[LinearSubsystem],
    schedule: Schedule,
    inputs: int,
    input_slots_at: Sequence[int],
    readings: Sequence[Matrix],
    read_at: Sequence[int],
) -> tuple[list[LinearSubsystem], Schedule, FrameInputs]:
    """Return a subsystem with inputs and readings, in each number type, its schedule, and their indices in z.

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
    input_names = tuple(f"{word} {number + 1}" for word in ("drawn", "acting") for number in range(inputs))
    reading_names = tuple(f"reading {number + 1}" for number in range(outputs))
    peer_type = replace(
        peer_type,
        clocks=(
            *peer_type.clocks,
            ClockPartition(INPUTS, input_names, ("1",) * (2 * inputs), (), (), (), casadi.Function()),
            ClockPartition(READINGS, reading_names, ("1",) * outputs, (), (), (), casadi.Function()),
        ),
    )
    count, reading_count = len(input_slots_at), len(read_at)
    carries = bool(count and input_slots_at[0] > 0)  # the last value of a frame stays active in the next
    input_slots = [
        ClockedValue(clock, index, number - count) for number in range(count) for index in range(inputs)
    ]
    before = [ClockedValue(clock, inputs + index, -1) for index in range(inputs)] if carries else []
    read = [
        ClockedValue(clock + 1, index, number - reading_count)
        for number in range(reading_count)
        for index in range(outputs)
    ]
    hold_updates: dict[int, list[Event]] = {
        instant: [HoldUpdate(first + index, input_slots[number * inputs + index]) for index in range(inputs)]
        for number, instant in enumerate(input_slots_at)
    }
    reading_ticks = {instant: Tick(clock + 1, number, ()) for number, instant in enumerate(read_at)}
    events: list[Event] = []
    last_instant = -1
    for time, event in _split_events(schedule, {*input_slots_at, *read_at}):
        if time > last_instant:
            events += hold_updates.get(time, [])
            last_instant = time
        if isinstance(event, Propagate) and time in reading_ticks:
            events.append(reading_ticks[time])
        events.append(event)
    events += [Tick(clock, number, ()) for number in range(count)]
    start = len(peer_type.states) + len(schedule.discrete_states)
    names = [
        f"{word} at {at}"
        for word, values in (("in", input_slots), ("before", before), ("out", read))
        for at in range(len(values))
    ]
    extended_schedule = replace(
        schedule,
        events=tuple(events),
        active_at_start=(*schedule.active_at_start, *(before if carries else (None,) * inputs)),
        discrete_states=(*schedule.discrete_states, *input_slots, *before, *read),
        ticks=(*schedule.ticks, count, reading_count),
        value_names=(*schedule.value_names, *names),
        repeats=None,
    )
    first_reading = start + len(input_slots) + len(before)
    ports = FrameInputs(
        input_slots=np.arange(start, start + len(input_slots)).reshape(count, inputs),
        read=np.arange(first_reading, first_reading + len(read)).reshape(reading_count, outputs),
        added=range(start, first_reading + len(read)),
    )
    extended = [
        _with_clocks(subsystem, peer_type, inputs, rows)
        for subsystem, rows in zip(subsystems, readings, strict=True)
    ]
    return extended, extended_schedule, ports


def _with_clocks(
    subsystem: LinearSubsystem, peer_type: PeerType, inputs: int, readings: Matrix
) -> LinearSubsystem:
    """Return a subsystem with two more clock partitions: one updates the inputs, one computes the readings.

    Parameters
    ----------
    subsystem, peer_type
        The subsystem with the inputs as its last holds, and its peer type with the two partitions.
    inputs
        The number of inputs.
    readings
        The rows of the readings over states and holds.
    """
    *batch_shape, n_x, n_u = subsystem.b.shape
    dtype = subsystem.b.dtype

    def zeros(rows: int, columns: int) -> Matrix:
        """Return matrices of zeros, in the number type of the subsystem."""
        return np.zeros((*batch_shape, rows, columns), dtype=dtype)

    input_holds = zeros(2 * inputs, n_u)
    input_holds[..., inputs:, n_u - inputs :] += np.eye(inputs, dtype=np.int64)
    rows = readings.shape[-2]
    ticks = (
        LinearTick(
            INPUTS,
            zeros(2 * inputs, n_x),
            input_holds,
            zeros(2 * inputs, 0),
            zeros(2 * inputs, 0),
            (),
        ),
        LinearTick(READINGS, readings[..., :n_x], readings[..., n_x:], zeros(rows, 0), zeros(rows, 0), ()),
    )
    return replace(subsystem, peer_type=peer_type, ticks=(*subsystem.ticks, *ticks))


def _split_events(schedule: Schedule, instants: set[int]) -> list[tuple[int, Event]]:
    """Return a frame's events, each with its instant in quanta; propagation is split at given instants."""
    pairs: list[tuple[int, Event]] = []
    time = 0
    for event in schedule.events:
        if not isinstance(event, Propagate):
            pairs.append((time, event))
            continue
        end = time + event.duration
        for stop in sorted({number for number in instants if time < number < end} | {end}):
            pairs.append((time, Propagate(stop - time)))
            time = stop
    return pairs
