"""One frame of one site as one linear map.

Takes: a `LinearSubsystem` and its `Schedule`; or the matrices of many sites at once, with a leading axis (k).
Gives: `FrameMap`, `compose`; `lift`, `with_roundings`; `follow`, event by event, `followed`.
Guarantees: `compose` and `follow` take numbers of any kind. `lift` propagates the continuous part by its
exact exponential; every matrix comes with a bound on its rounding error, entry by entry.
Does not: know who the others are (see `modes`).

    z⁺ = P z + Q r        z: continuous states, then the remembered values (`Schedule.carried`)
    s  = S z + D r        r: what the site hears (`Schedule.heard`), s: what it sends (`Schedule.sent`)

D is what is sent after something was heard in the same frame: nilpotent, as nothing is heard before it is
sent.
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
from apc.frame.radius import FLOATS, RADII, Arithmetic, common_shape, rounded
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
from apc.frame.site import LinearSubsystem, every_matrix, matrices_of

Matrix = NDArray[Any]

# What is shown each step: its duration in quanta, what moves as it begins, and all computed until then.
StepObserver = Callable[[int, Matrix, Mapping[ClockedValue, Matrix]], None]

# Packets that a peer sends or hears in a frame, each a row or column of the frame's map and of the loop's.
MOST_PACKETS = 1000


@dataclass(frozen=True, slots=True, eq=False)
class FrameMap:
    """The map of one frame, z⁺ = P z + Q r and s = S z + D r; of many with a leading axis (k)."""

    p: Matrix  # (n_z, n_z)
    q: Matrix  # (n_z, n_r)
    s: Matrix  # (n_s, n_z)
    d: Matrix  # (n_s, n_r)

    @property
    def blocks(self) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """P, Q, S and D."""
        return self.p, self.q, self.s, self.d

    def mapped(self, change: Callable[..., Matrix], *others: FrameMap) -> FrameMap:
        """Return the map whose blocks are made of these and of those of others."""
        return FrameMap(*map(change, self.blocks, *(other.blocks for other in others)))


def lift(
    site: LinearSubsystem,
    schedule: Schedule,
    *,
    exact: LinearSubsystem | None = None,
) -> FrameMap:
    """Compose the events of a site, or of many, over one frame, with radii of what may be off.

    Parameters
    ----------
    site
        The site's matrices, in floats; or those of many sites of one kind (k, …).
    schedule
        What happens in a frame.
    exact
        The site's matrices in rationals, whose exponentials are taken; without it, those of `site` count as
        exact.

    Notes
    -----
    Each coefficient carries its own roundings as a radius, and each event adds its own to these (see
    `radius`). The bound holds whatever the scaling of the states; of many sites it is wider, as their
    exponentials are taken in floats.
    """
    check_packets(schedule)
    durations = step_durations(schedule)
    exact = site if exact is None else exact
    steps = discretize(exact.a, exact.b, [duration * schedule.quantum for duration in durations])
    return compose(with_roundings(site), schedule, dict(zip(durations, steps, strict=True)), numbers=RADII)


def check_packets(schedule: Schedule) -> None:
    """Refuse a frame in which a site sends or hears too many packets: ApcError E805."""
    most = max(len(schedule.sent), len(schedule.heard))
    if most > MOST_PACKETS:
        what = f"{most:,} packets of one peer in a frame, and {MOST_PACKETS} are the most that are analysed"
        hint = "periods of clocks that are simple multiples of one another"
        raise ApcError(Diagnostic("E805", SourceLocation("the scene"), what, hint=hint))


def step_durations(schedule: Schedule) -> list[int]:
    """Return the durations of a frame's steps, in quanta."""
    return sorted({event.duration for event in schedule.events if isinstance(event, Propagate)})


def with_roundings(site: LinearSubsystem) -> LinearSubsystem:
    """Return a site's matrices with their radii, those of what CasADi rounds."""
    return every_matrix(site, lambda matrix: rounded(matrix, COEFFICIENT_ROUNDINGS))


def compose(
    site: LinearSubsystem,
    schedule: Schedule,
    steps: Mapping[int, Matrix],
    *,
    numbers: Arithmetic = FLOATS,
) -> FrameMap:
    """Follow z and r through one frame.

    Parameters
    ----------
    site
        The matrices of one site, or of many (k, …), in any kind of number.
    schedule
        What happens in a frame.
    steps
        [F G] (n_x, n_x + n_u) by duration in quanta, or of many (k, …).
    numbers
        What these matrices are of.
    """
    n_z = len(site.kind.states) + len(schedule.carried)
    unit = numbers.exact(np.eye(n_z + len(schedule.heard)))
    many = common_shape(*(matrix.shape[:-2] for matrix in (unit, *matrices_of(site), *steps.values())))
    start = np.broadcast_to(unit[..., :n_z, :], (*many, n_z, unit.shape[-1]))
    z, sent = followed(
        follow(site, schedule, steps, start, lambda row: unit[..., n_z + row, :], numbers=numbers)
    )
    s = _over(z[..., :0, :], [sent[row] for row in range(len(schedule.sent))])
    return FrameMap(z[..., :n_z], z[..., n_z:], s[..., :n_z], s[..., n_z:])


def followed(course: Generator[tuple[int, Matrix], None, Matrix]) -> tuple[Matrix, dict[int, Matrix]]:
    """Return z⁺ and the rows of s that a site sends, of a course (see `follow`) that never waits."""
    sent: dict[int, Matrix] = {}
    while True:
        try:
            row, value = next(course)
        except StopIteration as end:
            return end.value, sent
        sent[row] = value


def _play_again(
    playing: _Playing,
    schedule: Schedule,
    again: RepeatedEvents,
    at: _Moment,
    numbers: Arithmetic,
    received: Matrix,
) -> None:
    """Play events that come again and again: once, over what they need, and that as often as they come.

    Parameters
    ----------
    playing, schedule, again
        The site, what happens in its frame, and what of that comes again.
    at
        The instant before, which becomes that after.
    numbers
        What all is of.
    received
        What is heard (n_r, columns).

    Notes
    -----
    Of y, the continuous states and the values that enter, and r, the values that stay and what is heard, one
    time makes T y + R r; two times (T² y + (T R + R) r), and so on, squared.
    """
    n_x, n_r = playing.states, len(schedule.heard)
    needed = (*again.entering, *again.staying)
    n, n_y = n_x + len(needed), n_x + len(again.entering)
    before = [0] * len(again.ticks)
    for event in schedule.events[: again.first]:
        if isinstance(event, Tick):
            before[event.partition] += 1

    def row_of(moment: _Moment, value: ClockedValue, later: int) -> Matrix:
        """Return a value that enters once so many times are over."""
        if value.partition == HELD:
            return moment.moving[..., n_x + value.output, :]
        return moment.value.get(named_at(value, later), moment.nothing)

    def named_at(value: ClockedValue, later: int) -> ClockedValue:
        index = value.index + before[value.partition] + later * again.ticks[value.partition]
        return ClockedValue(value.partition, value.output, index)

    unit = numbers.exact(np.eye(n + n_r))
    once = playing.at_rest(unit[..., :n_x, :])
    for place, value in enumerate(needed, n_x):
        if value.partition == HELD:
            once.moving[..., n_x + value.output, :] = unit[..., place, :]
        else:
            once.value[named_at(value, 0)] = unit[..., place, :]
    body = schedule.events[again.first : again.first + again.length]
    dict(playing.play(body, once, lambda row: unit[..., n + row, :]))
    step = _over(once.moving[..., :n_x, :], [row_of(once, value, 1) for value in again.entering])

    def after(later: Matrix, earlier: Matrix) -> Matrix:
        """Return (T, R) of one number of times after another."""
        values = numbers.multiply(later[..., :n_y], earlier)
        values[..., n_y:] = numbers.add(values[..., n_y:], later[..., n_y:])
        return values

    y = _over(at.moving[..., :n_x, :], [row_of(at, value, 0) for value in needed])
    whole = _often(step, again.count, after)
    values = numbers.add(numbers.multiply(whole[..., :n], y), numbers.multiply(whole[..., n:], received))
    at.moving[..., :n_x, :] = values[..., :n_x, :]
    for place, value in enumerate(again.entering, n_x):
        if value.partition == HELD:
            at.moving[..., n_x + value.output, :] = values[..., place, :]
        else:
            at.value[named_at(value, again.count)] = values[..., place, :]


def _often(step: Matrix, count: int, after: Callable[[Matrix, Matrix], Matrix]) -> Matrix:
    """Return the map of so many times, given that of one, and what makes one after another of two."""
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
    site: LinearSubsystem,
    schedule: Schedule,
    steps: Mapping[int, Matrix],
    start: Matrix,
    hear: Callable[[int], Matrix | None],
    *,
    numbers: Arithmetic = FLOATS,
    watch: StepObserver | None = None,
) -> Generator[tuple[int, Matrix], None, Matrix]:
    """Follow a site, or many, through one frame, event by event, over numbers of any kind.

    Every quantity is a row over columns of the caller's choice; of many, with a leading axis (k).

    Parameters
    ----------
    site
        The site's matrices, in the kind of number wanted.
    schedule
        What happens in a frame.
    steps
        [F G] (n_x, n_x + n_u) by duration in quanta.
    start
        The state z (n_z, columns) at the start of the frame. Rows have a leading axis where it has one.
    hear
        Gives the row (columns,) of an entry of r, or None while it isn't sent yet: it is asked again.
    numbers
        What all is of.
    watch
        Is shown each step before it is made: its duration in quanta, the continuous states above what the
        holds put out (n_x + n_u, columns), and a table that what is computed is added to. Without it, what
        comes again and again is played once.

    Yields
    ------
    The row of s and its value (columns,) as soon as it is sent; (−1, nothing) while waiting to hear.

    Returns
    -------
    z⁺ (n_z, columns).
    """
    sends = [_beside(send.x, send.u) for send in site.sends]
    ticks = [_beside(tick.x, tick.u, tick.m, tick.r) for tick in site.ticks]
    number = np.result_type(start.dtype, site.a, *steps.values(), *sends, *ticks)
    holds, many = site.b.shape[-1], start.shape[:-2]
    playing = _Playing(site.kind, sends, ticks, steps, holds, many, number, numbers.multiply, watch)
    at = playing.begin(schedule, start)
    again = schedule.repeats if watch is None else None
    if again is None:
        yield from playing.play(schedule.events, at, hear)
        return playing.end(schedule, at)
    yield from playing.play(schedule.events[: again.first], at, hear)
    received = np.zeros((*start.shape[:-2], len(schedule.heard), start.shape[-1]), dtype=start.dtype)
    body = schedule.events[again.first : again.first + again.length]
    for row in {row for event in body if isinstance(event, Tick) for own in event.heard for row in own}:
        while (packet := hear(row)) is None:
            yield -1, at.nothing
        received[..., row, :] = packet
    _play_again(playing, schedule, again, at, numbers, received)
    yield from playing.play(schedule.events[again.end :], at, hear)
    return playing.end(schedule, at)


@dataclass(frozen=True, slots=True, eq=False)
class _Moment:
    """What there is at an instant of a frame, written over as time goes on.

    `moving` are the continuous states above what the holds put out; `value` is what was computed.
    """

    moving: Matrix
    value: dict[ClockedValue, Matrix]
    nothing: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class _Playing:
    """A site, or many, ready to be played: `sends` and `ticks` are its matrices side by side."""

    kind: PeerType
    sends: Sequence[Matrix]
    ticks: Sequence[Matrix]
    steps: Mapping[int, Matrix]
    holds: int
    many: tuple[int, ...]  # of how many sites
    number: Any
    multiply: Callable[[Matrix, Matrix], Matrix]
    watch: StepObserver | None

    @property
    def states(self) -> int:
        """The number of continuous states."""
        return len(self.kind.states)

    def begin(self, schedule: Schedule, start: Matrix) -> _Moment:
        """Return the start of a frame, from z (n_z, columns)."""
        at = self.at_rest(start[..., : self.states, :])
        for row, value in enumerate(schedule.carried, self.states):
            at.value[value] = start[..., row, :]
        for hold, acting in enumerate(schedule.acting, self.states):
            if acting is not None:
                at.moving[..., hold, :] = at.value.get(acting, at.nothing)
        return at

    def at_rest(self, x: Matrix) -> _Moment:
        """Return an instant at which nothing acts and nothing was computed, from states (n_x, columns)."""
        many = common_shape(self.many, x.shape[:-2])
        moving = np.zeros((*many, self.states + self.holds, x.shape[-1]), dtype=self.number)
        moving[..., : self.states, :] = x
        return _Moment(moving, {}, np.zeros((*x.shape[:-2], x.shape[-1]), dtype=x.dtype))

    def end(self, schedule: Schedule, at: _Moment) -> Matrix:
        """Return z⁺ (n_z, columns) at the end of a frame."""
        later = [shifted(value, schedule.ticks) for value in schedule.carried]
        return _over(at.moving[..., : self.states, :], [at.value[value] for value in later])

    def play(
        self, events: Sequence[Event], at: _Moment, hear: Callable[[int], Matrix | None]
    ) -> Generator[tuple[int, Matrix], None, None]:
        """Let events happen; yields as `follow`."""
        n_x, moving, value = self.states, at.moving, at.value
        for event in events:
            match event:
                case Propagate(duration):
                    if self.watch is not None:
                        self.watch(duration, moving, value)
                    moving[..., :n_x, :] = self.multiply(self.steps[duration][..., :n_x, :], moving)
                case HoldUpdate(hold, one):
                    moving[..., n_x + hold, :] = value.get(one, at.nothing)
                case SendEvent(partition, rows):
                    everything = self.multiply(self.sends[partition], moving)
                    for channel, row in rows:
                        yield row, everything[..., channel, :]
                case Tick(partition, index, rows_heard):
                    clock = self.kind.clocks[partition]
                    memories = clock.memories
                    before = [value.get(ClockedValue(partition, o, index - 1), at.nothing) for o in memories]
                    received = yield from _received(rows_heard, hear, at.nothing)
                    slopes = self.ticks[partition][..., event.rows(len(clock.outputs)), :]
                    computed = self.multiply(slopes, _over(moving, [*before, *received]))
                    for output in range(computed.shape[-2]):
                        value[ClockedValue(partition, output, index)] = computed[..., output, :]


def _beside(*blocks: Matrix) -> Matrix:
    """Return blocks side by side; one without columns would spoil the order in memory that they share."""
    return np.concatenate([block for block in blocks if block.shape[-1]] or blocks[:1], axis=-1)


def _over(block: Matrix, rows: Sequence[Matrix]) -> Matrix:
    """Return a block (…, n, columns) over rows (columns,) or (k, columns)."""
    *many, height, columns = block.shape
    values = np.empty((*many, height + len(rows), columns), dtype=block.dtype)
    values[..., :height, :] = block
    for place, row in enumerate(rows, height):
        values[..., place, :] = row
    return values


def _received(
    rows_heard: Sequence[Sequence[int]], hear: Callable[[int], Matrix | None], nothing: Matrix
) -> Generator[tuple[int, Matrix], None, list[Matrix]]:
    """Add up what each receive hears; yield (−1, nothing) while something isn't sent yet."""
    received = []
    for places in rows_heard:
        total = nothing
        for place in places:
            while (packet := hear(place)) is None:
                yield -1, nothing
            total = total + packet
        received.append(total)
    return received
