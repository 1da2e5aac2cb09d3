"""Lifting: one frame of one subsystem as one linear map.

Takes: a `LinearSubsystem` and its `Schedule`; or the matrices of many subsystems, with a leading axis (k).
Gives: `FrameMap`, `compose`; `lift`, `with_roundings`; `follow`, event by event, `followed`; `check_packets`,
`step_durations`.
Guarantees: `compose` and `follow` take any number type. `lift` propagates the continuous part by its exact
exponential; every matrix comes with an entrywise bound on its rounding error.
Does not: connect peers (see `modes`).

    z⁺ = P z + Q r        z: continuous states, then discrete states (`Schedule.discrete_states`)
    s  = S z + D r        r: received values (`Schedule.received`), s: sent values (`Schedule.sent`)

D is the part of s that depends on values received in the same frame: nilpotent, as no value is received
before it is sent.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.discretize import COEFFICIENT_ROUNDINGS, discretize
from apc.frame.interval_arithmetic import FLOATS, MIDPOINT_RADIUS, Arithmetic, common_shape, rounded
from apc.frame.linear_subsystem import LinearSubsystem, every_matrix, matrices_of
from apc.frame.schedule import (
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
        """Return the map whose blocks are computed from these blocks and those of other maps."""
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
        message = (
            f"{most:,} packets of one peer in a frame, and {MOST_PACKETS} are the most that are analysed"
        )
        hint = "periods of clocks that are simple multiples of one another"
        raise ApcError(Diagnostic("E805", SourceLocation("the topology"), message, hint=hint))


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
    many = common_shape(*(matrix.shape[:-2] for matrix in (unit, *matrices_of(subsystem), *steps.values())))
    start = np.broadcast_to(unit[..., :n_z, :], (*many, n_z, unit.shape[-1]))
    z, sent = followed(
        follow(subsystem, schedule, steps, start, lambda row: unit[..., n_z + row, :], numbers=numbers)
    )
    s = _over(z[..., :0, :], [sent[row] for row in range(len(schedule.sent))])
    return FrameMap(z[..., :n_z], z[..., n_z:], s[..., :n_z], s[..., n_z:])


def followed(mode_path: Generator[tuple[int, Matrix], None, Matrix]) -> tuple[Matrix, dict[int, Matrix]]:
    """Return z⁺ and the rows of s, for an iteration (see `follow`) that never waits."""
    sent: dict[int, Matrix] = {}
    while True:
        try:
            row, value = next(mode_path)
        except StopIteration as end:
            return end.value, sent
        sent[row] = value


def _replay(
    playing: _Playing,
    schedule: Schedule,
    repeated: RepeatedEvents,
    at: _Moment,
    numbers: Arithmetic,
    received: Matrix,
) -> None:
    """Apply repeated events: one repetition as a map of the values that it needs, raised to their count.

    Parameters
    ----------
    playing, schedule, repeated
        The subsystem, the events of its frame, and the repetition.
    at
        The instant before, changed to that after.
    numbers
        The number type.
    received
        The received values (n_r, columns).

    Notes
    -----
    With y the continuous states and the entering values, and r the staying and received values, one
    repetition gives T y + R r; two give T² y + (T R + R) r, and so on by squaring.
    """
    n_x, n_r = playing.states, len(schedule.received)
    needed = (*repeated.entering, *repeated.staying)
    n, n_y = n_x + len(needed), n_x + len(repeated.entering)
    before = [0] * len(repeated.ticks)
    for event in schedule.events[: repeated.first]:
        if isinstance(event, Tick):
            before[event.partition] += 1

    def row_of(moment: _Moment, value: ClockedValue, later: int) -> Matrix:
        """Return an entering value after the given number of repetitions."""
        if value.partition == HELD:
            return moment.moving[..., n_x + value.output, :]
        return moment.value.get(named_at(value, later), moment.nothing)

    def named_at(value: ClockedValue, later: int) -> ClockedValue:
        index = value.index + before[value.partition] + later * repeated.ticks[value.partition]
        return ClockedValue(value.partition, value.output, index)

    unit = numbers.exact(np.eye(n + n_r))
    once = playing.at_rest(unit[..., :n_x, :])
    for position, value in enumerate(needed, n_x):
        if value.partition == HELD:
            once.moving[..., n_x + value.output, :] = unit[..., position, :]
        else:
            once.value[named_at(value, 0)] = unit[..., position, :]
    body = schedule.events[repeated.first : repeated.first + repeated.length]
    dict(playing.advance(body, once, lambda row: unit[..., n + row, :]))
    step = _over(once.moving[..., :n_x, :], [row_of(once, value, 1) for value in repeated.entering])

    def after(later: Matrix, earlier: Matrix) -> Matrix:
        """Return (T, R) of one number of repetitions followed by another."""
        values = numbers.multiply(later[..., :n_y], earlier)
        values[..., n_y:] = numbers.add(values[..., n_y:], later[..., n_y:])
        return values

    y = _over(at.moving[..., :n_x, :], [row_of(at, value, 0) for value in needed])
    whole = _often(step, repeated.count, after)
    values = numbers.add(numbers.multiply(whole[..., :n], y), numbers.multiply(whole[..., n:], received))
    at.moving[..., :n_x, :] = values[..., :n_x, :]
    for position, value in enumerate(repeated.entering, n_x):
        if value.partition == HELD:
            at.moving[..., n_x + value.output, :] = values[..., position, :]
        else:
            at.value[named_at(value, repeated.count)] = values[..., position, :]


def _often(step: Matrix, count: int, after: Callable[[Matrix, Matrix], Matrix]) -> Matrix:
    """Return the map of n repetitions, from that of one and the composition of two maps."""
    whole = None
    while True:
        if count % 2:
            whole = step if whole is None else after(step, whole)
        count //= 2
        if not count:
            break
        step = after(step, step)
    assert whole is not None
    return whole


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

    Every quantity is a row over columns chosen by the caller; of many subsystems, with a leading axis (k).

    Parameters
    ----------
    subsystem
        The subsystem's matrices, in the number type.
    schedule
        The events of a frame.
    steps
        [F G] (n_x, n_x + n_u) by duration in quanta.
    start
        The state z (n_z, columns) at the start of the frame. Rows have a leading axis where it has one.
    receive
        Gives the row (columns,) of an entry of r, or None if it is not sent yet: it is then requested again.
    numbers
        The number type.
    watch
        Is called before each step, with its duration in quanta, the continuous states above the outputs of
        holds (n_x + n_u, columns), and a table of computed values that it may extend. Without it, repeated
        events are composed once.

    Yields
    ------
    The row of s and its value (columns,) when it is sent; (−1, nothing) while waiting for a value.

    Returns
    -------
    z⁺ (n_z, columns).
    """
    sends = [_stack_columns(send.x, send.u) for send in subsystem.sends]
    ticks = [_stack_columns(tick.x, tick.u, tick.m, tick.r) for tick in subsystem.ticks]
    number = np.result_type(start.dtype, subsystem.a, *steps.values(), *sends, *ticks)
    holds, many = subsystem.b.shape[-1], start.shape[:-2]
    playing = _Playing(subsystem.peer_type, sends, ticks, steps, holds, many, number, numbers.multiply, watch)
    at = playing.begin(schedule, start)
    repeated = schedule.repeats if watch is None else None
    if repeated is None:
        yield from playing.advance(schedule.events, at, receive)
        return playing.end(schedule, at)
    yield from playing.advance(schedule.events[: repeated.first], at, receive)
    received = np.zeros((*start.shape[:-2], len(schedule.received), start.shape[-1]), dtype=start.dtype)
    body = schedule.events[repeated.first : repeated.first + repeated.length]
    for row in {
        row for event in body if isinstance(event, Tick) for local in event.input_rows for row in local
    }:
        while (packet := receive(row)) is None:
            yield -1, at.nothing
        received[..., row, :] = packet
    _replay(playing, schedule, repeated, at, numbers, received)
    yield from playing.advance(schedule.events[repeated.end :], at, receive)
    return playing.end(schedule, at)


@dataclass(frozen=True, slots=True, eq=False)
class _Moment:
    """The values at an instant of a frame, overwritten as time advances.

    `moving` are the continuous states above the outputs of holds; `value` are the computed values.
    """

    moving: Matrix
    value: dict[ClockedValue, Matrix]
    nothing: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class _Playing:
    """One subsystem, or many, ready for propagation: `sends` and `ticks` are its matrices side by side."""

    peer_type: PeerType
    sends: Sequence[Matrix]
    ticks: Sequence[Matrix]
    steps: Mapping[int, Matrix]
    holds: int
    many: tuple[int, ...]  # number of subsystems
    number: Any
    multiply: Callable[[Matrix, Matrix], Matrix]
    watch: StepObserver | None

    @property
    def states(self) -> int:
        """The number of continuous states."""
        return len(self.peer_type.states)

    def begin(self, schedule: Schedule, start: Matrix) -> _Moment:
        """Return the values at the start of a frame, from z (n_z, columns)."""
        at = self.at_rest(start[..., : self.states, :])
        for row, value in enumerate(schedule.discrete_states, self.states):
            at.value[value] = start[..., row, :]
        for hold, active_at_start in enumerate(schedule.active_at_start, self.states):
            if active_at_start is not None:
                at.moving[..., hold, :] = at.value.get(active_at_start, at.nothing)
        return at

    def at_rest(self, x: Matrix) -> _Moment:
        """Return an instant without active holds and computed values, from states (n_x, columns)."""
        many = common_shape(self.many, x.shape[:-2])
        moving = np.zeros((*many, self.states + self.holds, x.shape[-1]), dtype=self.number)
        moving[..., : self.states, :] = x
        return _Moment(moving, {}, np.zeros((*x.shape[:-2], x.shape[-1]), dtype=x.dtype))

    def end(self, schedule: Schedule, at: _Moment) -> Matrix:
        """Return z⁺ (n_z, columns) at the end of a frame."""
        later = [shifted(value, schedule.ticks) for value in schedule.discrete_states]
        return _over(at.moving[..., : self.states, :], [at.value[value] for value in later])

    def advance(
        self, events: Sequence[Event], at: _Moment, receive: Callable[[int], Matrix | None]
    ) -> Generator[tuple[int, Matrix], None, None]:
        """Apply events in order; yields as `follow`."""
        n_x, moving, value = self.states, at.moving, at.value
        for event in events:
            match event:
                case Propagate(duration):
                    if self.watch is not None:
                        self.watch(duration, moving, value)
                    moving[..., :n_x, :] = self.multiply(self.steps[duration][..., :n_x, :], moving)
                case HoldUpdate(hold, item):
                    moving[..., n_x + hold, :] = value.get(item, at.nothing)
                case SendEvent(partition, rows):
                    everything = self.multiply(self.sends[partition], moving)
                    for channel, row in rows:
                        yield row, everything[..., channel, :]
                case Tick(partition, index, rows_received):
                    clock = self.peer_type.clocks[partition]
                    memories = clock.memories
                    before = [value.get(ClockedValue(partition, o, index - 1), at.nothing) for o in memories]
                    received = yield from _received(rows_received, receive, at.nothing)
                    slopes = self.ticks[partition][..., event.rows(len(clock.outputs)), :]
                    computed = self.multiply(slopes, _over(moving, [*before, *received]))
                    for output in range(computed.shape[-2]):
                        value[ClockedValue(partition, output, index)] = computed[..., output, :]


def _stack_columns(*blocks: Matrix) -> Matrix:
    """Return blocks side by side; one without columns is left out, as it would change the memory order."""
    return np.concatenate([block for block in blocks if block.shape[-1]] or blocks[:1], axis=-1)


def _over(block: Matrix, rows: Sequence[Matrix]) -> Matrix:
    """Return a block (…, n, columns) times rows (columns,) or (k, columns)."""
    *many, height, columns = block.shape
    values = np.empty((*many, height + len(rows), columns), dtype=block.dtype)
    values[..., :height, :] = block
    for index, row in enumerate(rows, height):
        values[..., index, :] = row
    return values


def _received(
    rows_received: Sequence[Sequence[int]], receive: Callable[[int], Matrix | None], nothing: Matrix
) -> Generator[tuple[int, Matrix], None, list[Matrix]]:
    """Add the terms of each receive; yield (−1, nothing) while one is not sent yet."""
    received = []
    for indices in rows_received:
        total = nothing
        for index in indices:
            while (packet := receive(index)) is None:
                yield -1, nothing
            total = total + packet
        received.append(total)
    return received
