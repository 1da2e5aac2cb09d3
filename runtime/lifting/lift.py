"""Lifting: one frame of one subsystem as one linear map.

Takes: a `LinearSubsystem` and its `Schedule`; or the matrices of many subsystems, with a leading axis (k).
Gives: `FrameMap`, `compose`; `lift`, `with_roundings`; `follow`, event by event, `run_frame`;
`check_packets`, `step_durations`.
Guarantees: `compose` and `follow` take any number type. `lift` propagates the continuous part by its exact
exponential; every matrix comes with an entrywise bound on its rounding error.
Does not: connect peers (see `modes`).

    z⁺ = P z + Q r        z: continuous states, then discrete states (`Schedule.discrete_states`)
    s  = S z + D r        r: received values (`Schedule.received`), s: sent values (`Schedule.sent`)

In the notation of state space models (A, B, C, D) = (P, Q, S, D). D is the part of s that depends on values
received in the same frame. With the weights W of these values D W is nilpotent: no value is received before
it is sent.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.discretize import COEFFICIENT_ROUNDINGS, discretize
from apc.lifting.interval_arithmetic import FLOATS, MIDPOINT_RADIUS, Arithmetic, common_shape, rounded
from apc.linearization.linear_subsystem import LinearSubsystem, every_matrix, matrices_of
from apc.timing.schedule import (
    HELD,
    ClockedValue,
    Event,
    HoldUpdate,
    Propagate,
    RepeatedEvents,
    Schedule,
    SendEvent,
    Tick,
    shifted,
)

Matrix = NDArray[Any]

# Arguments of the observer of each step: its duration in quanta, the states as it begins, and all values
# computed so far.
StepObserver = Callable[[int, Matrix, Mapping[ClockedValue, Matrix]], None]

# The limit of packets that a peer sends or receives in a frame, each a row or column of the frame map.
MOST_PACKETS = 1000


@dataclass(frozen=True, slots=True, eq=False)
class FrameMap:
    """The map of one frame, z⁺ = P z + Q r and s = S z + D r; of many subsystems with a leading axis (k)."""

    p: Matrix  # (n_z, n_z)
    q: Matrix  # (n_z, n_r)
    s: Matrix  # (n_s, n_z)
    d: Matrix  # (n_s, n_r)

    @property
    def blocks(self) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """The matrices P, Q, S and D."""
        return self.p, self.q, self.s, self.d

    def mapped(self, change: Callable[..., Matrix], *others: FrameMap) -> FrameMap:
        """Return the map whose blocks are a function of the blocks of this map and of other maps."""
        return FrameMap(*map(change, self.blocks, *(other.blocks for other in others)))


def lift(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    *,
    exact: LinearSubsystem | None = None,
) -> FrameMap:
    """Return the frame map of one subsystem, or of many, with the error radii of its matrices.

    Parameters
    ----------
    subsystem
        The subsystem's matrices, in floats; or those of many subsystems of one type (k, …).
    schedule
        The events of a frame.
    exact
        The subsystem's matrices in rationals, for the exponentials; by default those of `subsystem` count as
        exact.

    Notes
    -----
    Each coefficient has a radius for its own roundings, and each event adds the radius of its roundings (see
    `interval_arithmetic`). The bound is independent of the scaling of the states; for many subsystems it is
    wider, as their exponentials are computed in floats.
    """
    check_packets(schedule)
    durations = step_durations(schedule)
    exact = subsystem if exact is None else exact
    steps = discretize(exact.a, exact.b, [duration * schedule.quantum for duration in durations])
    return compose(
        with_roundings(subsystem), schedule, dict(zip(durations, steps, strict=True)), numbers=MIDPOINT_RADIUS
    )


def check_packets(schedule: Schedule) -> None:
    """Raise ApcError E805 for a frame in which a subsystem sends or receives too many packets."""
    most = max(len(schedule.sent), len(schedule.received))
    if most > MOST_PACKETS:
        message = f"{most:,} packets of one peer in a frame; the limit is {MOST_PACKETS}"
        advice = "use clock periods that are simple multiples of each other"
        raise ApcError(Diagnostic("E805", SourceLocation("the topology"), message, advice=advice))


def step_durations(schedule: Schedule) -> list[int]:
    """Return the durations of a frame's steps, in quanta."""
    return sorted({event.duration for event in schedule.events if isinstance(event, Propagate)})


def with_roundings(subsystem: LinearSubsystem) -> LinearSubsystem:
    """Return a subsystem's matrices with error radii for the roundings of CasADi."""
    return every_matrix(subsystem, lambda matrix: rounded(matrix, COEFFICIENT_ROUNDINGS))


def compose(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    steps: Mapping[int, Matrix],
    *,
    numbers: Arithmetic = FLOATS,
) -> FrameMap:
    """Return the frame map from z and r propagated through one frame.

    Parameters
    ----------
    subsystem
        The matrices of one subsystem, or of many (k, …), in any number type.
    schedule
        The events of a frame.
    steps
        [F G] (n_x, n_x + n_u) by duration in quanta, or of many (k, …).
    numbers
        The number type of these matrices.
    """
    n_z = len(subsystem.peer_type.states) + len(schedule.discrete_states)
    unit = numbers.exact(np.eye(n_z + len(schedule.received)))
    batch_shape = common_shape(
        *(matrix.shape[:-2] for matrix in (unit, *matrices_of(subsystem), *steps.values()))
    )
    start = np.broadcast_to(unit[..., :n_z, :], (*batch_shape, n_z, unit.shape[-1]))
    z, sent = run_frame(
        follow(subsystem, schedule, steps, start, lambda row: unit[..., n_z + row, :], numbers=numbers)
    )
    s = _stack_rows(z[..., :0, :], [sent[row] for row in range(len(schedule.sent))])
    return FrameMap(z[..., :n_z], z[..., n_z:], s[..., :n_z], s[..., n_z:])


def run_frame(iteration: Generator[tuple[int, Matrix], None, Matrix]) -> tuple[Matrix, dict[int, Matrix]]:
    """Return z⁺ and the rows of s by index, from an iteration of `follow` in which every value is
    available.
    """
    sent: dict[int, Matrix] = {}
    while True:
        try:
            row, value = next(iteration)
        except StopIteration as end:
            return end.value, sent
        sent[row] = value


def _apply_repeats(
    propagation: _FramePropagation,
    schedule: Schedule,
    repeated: RepeatedEvents,
    present: _FrameValues,
    numbers: Arithmetic,
    received: Matrix,
) -> None:
    """Apply repeated events to the present values: the map of one repetition, raised to the number of
    repetitions.

    Parameters
    ----------
    propagation, schedule, repeated
        The subsystem, the events of its frame, and the repeated events.
    present
        The values before the repeated events, overwritten by those after.
    numbers
        The number type.
    received
        The received values (n_r, columns).

    Notes
    -----
    With y the continuous states and the entering values, and r the staying and received values, one
    repetition gives T y + R r; two give T² y + (T R + R) r, and so on by squaring.
    """
    n_x, n_r = propagation.states, len(schedule.received)
    needed = (*repeated.entering, *repeated.staying)
    n, n_y = n_x + len(needed), n_x + len(repeated.entering)
    ticks_before = [0] * len(repeated.ticks)
    for event in schedule.events[: repeated.first]:
        if isinstance(event, Tick):
            ticks_before[event.partition] += 1

    def row_of(moment: _FrameValues, value: ClockedValue, repetitions: int) -> Matrix:
        """Return an entering value after the given number of repetitions."""
        if value.partition == HELD:
            return moment.moving[..., n_x + value.output, :]
        return moment.value.get(named_at(value, repetitions), moment.nothing)

    def named_at(value: ClockedValue, repetitions: int) -> ClockedValue:
        """Return the symbol of a value after the given number of repetitions."""
        index = value.index + ticks_before[value.partition] + repetitions * repeated.ticks[value.partition]
        return ClockedValue(value.partition, value.output, index)

    unit = numbers.exact(np.eye(n + n_r))
    single = propagation.without_holds(unit[..., :n_x, :])
    for position, value in enumerate(needed, n_x):
        if value.partition == HELD:
            single.moving[..., n_x + value.output, :] = unit[..., position, :]
        else:
            single.value[named_at(value, 0)] = unit[..., position, :]
    body = schedule.events[repeated.first : repeated.first + repeated.length]
    dict(propagation.advance(body, single, lambda row: unit[..., n + row, :]))
    step = _stack_rows(single.moving[..., :n_x, :], [row_of(single, value, 1) for value in repeated.entering])

    def composed(later: Matrix, earlier: Matrix) -> Matrix:
        """Return the map (T, R) of the repetitions of `earlier`, followed by those of `later`."""
        values = numbers.multiply(later[..., :n_y], earlier)
        values[..., n_y:] = numbers.add(values[..., n_y:], later[..., n_y:])
        return values

    y = _stack_rows(present.moving[..., :n_x, :], [row_of(present, value, 0) for value in needed])
    power = _repeated_map(step, repeated.count, composed)
    values = numbers.add(numbers.multiply(power[..., :n], y), numbers.multiply(power[..., n:], received))
    present.moving[..., :n_x, :] = values[..., :n_x, :]
    for position, value in enumerate(repeated.entering, n_x):
        if value.partition == HELD:
            present.moving[..., n_x + value.output, :] = values[..., position, :]
        else:
            present.value[named_at(value, repeated.count)] = values[..., position, :]


def _repeated_map(step: Matrix, count: int, composed: Callable[[Matrix, Matrix], Matrix]) -> Matrix:
    """Return the map of `count` repetitions from the map of one repetition and the composition of
    two maps.
    """
    result = None
    while True:
        if count % 2:
            result = step if result is None else composed(step, result)
        count //= 2
        if not count:
            break
        step = composed(step, step)
    assert result is not None
    return result


def follow(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    steps: Mapping[int, Matrix],
    start: Matrix,
    receive: Callable[[int], Matrix | None],
    *,
    numbers: Arithmetic = FLOATS,
    watch: StepObserver | None = None,
) -> Generator[tuple[int, Matrix], None, Matrix]:
    """Propagate one subsystem, or many, through one frame, event by event, in any number type.

    Every quantity is a row over columns of the caller; rows of many subsystems have a leading axis (k).

    Parameters
    ----------
    subsystem
        The subsystem's matrices, in the number type.
    schedule
        The events of a frame.
    steps
        [F G] (n_x, n_x + n_u) by duration in quanta.
    start
        The state z (n_z, columns) at the start of the frame. All rows have a leading axis if z has one.
    receive
        Returns the row (columns,) of an entry of r, or None if the entry is not sent yet; it is then called
        again.
    numbers
        The number type.
    watch
        Is called before each step with the duration in quanta, the continuous states above the outputs of
        holds (n_x + n_u, columns), and a live view of the computed values. Without `watch`,
        repeated events are composed once.

    Yields
    ------
    The index of a row of s and its value (columns,) when it is sent; (−1, zeros) while a value of r is not
    sent yet.

    Returns
    -------
    z⁺ (n_z, columns).
    """
    sends = [_stack_columns(send.x, send.u) for send in subsystem.sends]
    ticks = [_stack_columns(tick.x, tick.u, tick.m, tick.r) for tick in subsystem.ticks]
    dtype = np.result_type(start.dtype, subsystem.a, *steps.values(), *sends, *ticks)
    holds, batch_shape = subsystem.b.shape[-1], start.shape[:-2]
    propagation = _FramePropagation(
        subsystem.peer_type, sends, ticks, steps, holds, batch_shape, dtype, numbers.multiply, watch
    )
    present = propagation.begin(schedule, start)
    repeated = schedule.repeats if watch is None else None
    if repeated is None:
        yield from propagation.advance(schedule.events, present, receive)
        return propagation.end(schedule, present)
    yield from propagation.advance(schedule.events[: repeated.first], present, receive)
    received = np.zeros((*start.shape[:-2], len(schedule.received), start.shape[-1]), dtype=start.dtype)
    body = schedule.events[repeated.first : repeated.first + repeated.length]
    for row in {
        row for event in body if isinstance(event, Tick) for rows in event.input_rows for row in rows
    }:
        while (packet := receive(row)) is None:
            yield -1, present.nothing
        received[..., row, :] = packet
    _apply_repeats(propagation, schedule, repeated, present, numbers, received)
    yield from propagation.advance(schedule.events[repeated.end :], present, receive)
    return propagation.end(schedule, present)


@dataclass(frozen=True, slots=True, eq=False)
class _FrameValues:
    """The values of a subsystem at an instant of a frame, overwritten as time advances.

    `moving` are the continuous states above the outputs of holds; `value` are the computed values; `nothing`
    is a row of zeros.
    """

    moving: Matrix
    value: dict[ClockedValue, Matrix]
    nothing: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class _FramePropagation:
    """The propagation of one subsystem, or of many, through a frame.

    `sends` and `ticks` are the matrices of each, side by side; `steps` are [F G] by duration in quanta;
    `holds` is the number of holds; `dtype` and `multiply` are those of the number type; `watch` is called
    before each step.
    """

    peer_type: PeerType
    sends: Sequence[Matrix]
    ticks: Sequence[Matrix]
    steps: Mapping[int, Matrix]
    holds: int
    many: tuple[int, ...]  # number of subsystems
    dtype: Any
    multiply: Callable[[Matrix, Matrix], Matrix]
    watch: StepObserver | None

    @property
    def states(self) -> int:
        """The number of continuous states."""
        return len(self.peer_type.states)

    def begin(self, schedule: Schedule, start: Matrix) -> _FrameValues:
        """Return the values at the start of a frame, from z (n_z, columns)."""
        present = self.without_holds(start[..., : self.states, :])
        for row, value in enumerate(schedule.discrete_states, self.states):
            present.value[value] = start[..., row, :]
        for hold, active_at_start in enumerate(schedule.active_at_start, self.states):
            if active_at_start is not None:
                present.moving[..., hold, :] = present.value.get(active_at_start, present.nothing)
        return present

    def without_holds(self, x: Matrix) -> _FrameValues:
        """Return the values for states (n_x, columns), with holds at 0 and no computed values."""
        batch_shape = common_shape(self.many, x.shape[:-2])
        moving = np.zeros((*batch_shape, self.states + self.holds, x.shape[-1]), dtype=self.dtype)
        moving[..., : self.states, :] = x
        return _FrameValues(moving, {}, np.zeros((*x.shape[:-2], x.shape[-1]), dtype=x.dtype))

    def end(self, schedule: Schedule, present: _FrameValues) -> Matrix:
        """Return z⁺ (n_z, columns) at the end of a frame."""
        later = [shifted(value, schedule.ticks) for value in schedule.discrete_states]
        return _stack_rows(present.moving[..., : self.states, :], [present.value[value] for value in later])

    def advance(
        self, events: Sequence[Event], present: _FrameValues, receive: Callable[[int], Matrix | None]
    ) -> Generator[tuple[int, Matrix], None, None]:
        """Apply events in their order to the values `present`; yields as `follow`."""
        n_x, moving, value = self.states, present.moving, present.value
        for event in events:
            match event:
                case Propagate(duration):
                    if self.watch is not None:
                        self.watch(duration, moving, value)
                    moving[..., :n_x, :] = self.multiply(self.steps[duration][..., :n_x, :], moving)
                case HoldUpdate(hold, item):
                    moving[..., n_x + hold, :] = value.get(item, present.nothing)
                case SendEvent(partition, rows):
                    channels = self.multiply(self.sends[partition], moving)
                    for channel, row in rows:
                        yield row, channels[..., channel, :]
                case Tick(partition, index, rows_received):
                    clock = self.peer_type.clocks[partition]
                    memories = clock.memories
                    before = [
                        value.get(ClockedValue(partition, o, index - 1), present.nothing) for o in memories
                    ]
                    received = yield from _received(rows_received, receive, present.nothing)
                    slopes = self.ticks[partition][..., event.rows(len(clock.outputs)), :]
                    computed = self.multiply(slopes, _stack_rows(moving, [*before, *received]))
                    for output in range(computed.shape[-2]):
                        value[ClockedValue(partition, output, index)] = computed[..., output, :]


def _stack_columns(*blocks: Matrix) -> Matrix:
    """Return blocks side by side.

    Blocks without columns are left out, as they would change the memory order.
    """
    return np.concatenate([block for block in blocks if block.shape[-1]] or blocks[:1], axis=-1)


def _stack_rows(block: Matrix, rows: Sequence[Matrix]) -> Matrix:
    """Return a block (…, n, columns) extended by rows (columns,) or (k, columns) at its end."""
    *batch_shape, height, columns = block.shape
    values = np.empty((*batch_shape, height + len(rows), columns), dtype=block.dtype)
    values[..., :height, :] = block
    for index, row in enumerate(rows, height):
        values[..., index, :] = row
    return values


def _received(
    rows_received: Sequence[Sequence[int]], receive: Callable[[int], Matrix | None], nothing: Matrix
) -> Generator[tuple[int, Matrix], None, list[Matrix]]:
    """Return the sum of the received values of each receive.

    Yields (−1, nothing) while a value is not sent yet.
    """
    received = []
    for indices in rows_received:
        total = nothing
        for index in indices:
            while (packet := receive(index)) is None:
                yield -1, nothing
            total = total + packet
        received.append(total)
    return received
