"""What one frame of a peer is made of: its events in their order, and what is remembered between frames.

Takes: what `scheduling` found out.
Gives: `Schedule` and its events, `Event`; `RepeatedEvents`, `HELD`; the names of what is computed, sent and
heard; `shifted`, `remembered`; `tick_by_tick`; `ORDER`.
Guarantees: exact time (integers of one quantum).
Does not: find out what happens when (see `scheduling`).

Every value a clock computes is one symbol, `ClockedValue(partition, output, index)`: what output `output` was
at the tick `index`, counted from the frame's first tick of that clock; a negative index is an earlier frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

# The order of coincident events. Continuous variables are continuous, so sampling needs no place in it.
ORDER = ("send", "deliver", "tick", "act")


@dataclass(frozen=True, slots=True, order=True)
class ClockedValue:
    """Output `output` of clock partition `partition` as computed at tick `index` of the frame."""

    partition: int
    output: int
    index: int


def shifted(value: ClockedValue, ticks: Sequence[int]) -> ClockedValue:
    """Return the value that is called `value` one frame on; `ticks` are of a frame, by clock partition."""
    return ClockedValue(value.partition, value.output, value.index + ticks[value.partition])


def remembered(values: Iterable[ClockedValue], ticks: Sequence[int]) -> tuple[ClockedValue, ...]:
    """Return those of some values that are of earlier frames, and what they were called until they came.

    A value read at index −j is, one frame before, the value of index n − j; if that is negative too, it is
    remembered as well.
    """
    result: set[ClockedValue] = set()
    for value in values:
        while value.index < 0:
            result.add(value)
            value = shifted(value, ticks)
    return tuple(sorted(result))


@dataclass(frozen=True, slots=True, order=True)
class SentSample:
    """A channel of a link as sent at the link clock's tick `slot` of a frame."""

    link: str
    channel: str
    slot: int


@dataclass(frozen=True, slots=True, order=True)
class CouplingTerm:
    """A way from peer to peer, one weight for each pair of peers: `operator` over a link, delayed `delay`.

    Only those pairs of peers are on it whose delay is the timing `delay`. A receive that weighs every sender
    apart, by the slope of its edge function, has a way of its own for each channel: `edge` and `channel` name
    it, and are empty for a plain sum or mean. With `before`, a tick hears on it what the tick before heard.
    """

    operator: str
    link: str
    delay: str
    edge: str = ""
    channel: str = ""
    before: bool = False


@dataclass(frozen=True, slots=True, order=True)
class ReceivedSample:
    """What a site hears on `way`: the other peers' `sent`, of `lag` frames ago (0: this frame)."""

    way: CouplingTerm
    sent: SentSample
    lag: int


@dataclass(frozen=True, slots=True, order=True)
class UncertainSample:
    """What tick `tick` of `clock` hears of a channel on a way that loses or delays packets: one that is kept.

    With `gap` it is not what is heard but the weight of what is missed.
    """

    way: CouplingTerm
    channel: str
    clock: str
    tick: int
    gap: bool = False


@dataclass(frozen=True, slots=True)
class Propagate:
    """Nothing happens for `duration` quanta."""

    duration: int


@dataclass(frozen=True, slots=True)
class SendEvent:
    """The site's send partition `partition` sends; `rows` are (channel, row of s) pairs."""

    partition: int
    rows: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Tick:
    """Clock partition `partition` computes, tick `index`; `heard` are each receive's rows of r, to add.

    `variant` is which of the partition's columns it computes (see `ClockPartition.variants`), None of one.
    """

    partition: int
    index: int
    heard: tuple[tuple[int, ...], ...]
    variant: int | None = None

    def rows(self, outputs: int) -> slice:
        """Return its own rows, of a partition's that has so many outputs: all where it has one column."""
        if self.variant is None:
            return slice(None)
        return slice(self.variant * outputs, (self.variant + 1) * outputs)


@dataclass(frozen=True, slots=True)
class HoldUpdate:
    """Hold `hold` switches to `value`."""

    hold: int
    value: ClockedValue


Event = Propagate | SendEvent | Tick | HoldUpdate


# The partition of what a hold puts out, where that is named like a value: `ClockedValue(HELD, hold, −1)`.
HELD = -1


@dataclass(frozen=True, slots=True)
class RepeatedEvents:
    """Events that come again and again: `count` times `length` of them, from event `first` on.

    `ticks` are of one time, by clock partition. `entering` is what one time needs of those before, or what is
    needed when all are over, indices counted from its own first tick; `staying` the same, of what none of
    them changes. See `HELD`.
    """

    first: int
    length: int
    count: int
    ticks: tuple[int, ...]
    entering: tuple[ClockedValue, ...]
    staying: tuple[ClockedValue, ...]

    @property
    def end(self) -> int:
        """The first event after them."""
        return self.first + self.length * self.count


@dataclass(frozen=True, slots=True)
class Schedule:
    """One frame of the peers of one group.

    `acting` is what each hold puts out as the frame begins (None for a hold nobody reads); `carried` are the
    values of earlier frames that this one needs, the remembered part of z after the continuous states;
    `heard` names r, and `selected` goes on where packets get lost or come late; `sent` names s and `depths`
    says how many frames each row of s must be kept; `ticks` counts a clock partition's ticks in a frame;
    `marks` are the instants, in quanta, of the fastest clock's ticks and the end; `repeats` are events that
    come again and again, if there are such.
    """

    quantum: Fraction
    frame: int
    events: tuple[Event, ...]
    acting: tuple[ClockedValue | None, ...]
    carried: tuple[ClockedValue, ...]
    heard: tuple[ReceivedSample, ...]
    sent: tuple[SentSample, ...]
    depths: tuple[int, ...]
    ticks: tuple[int, ...]
    marks: tuple[int, ...]
    value_names: tuple[str, ...]
    sent_names: tuple[str, ...]
    sent_times: tuple[int, ...]  # in quanta from the frame's start
    selected: tuple[UncertainSample, ...] = ()
    repeats: RepeatedEvents | None = None

    @property
    def frame_s(self) -> Fraction:
        """The length of the frame in seconds."""
        return self.frame * self.quantum

    @property
    def received(self) -> tuple[ReceivedSample | UncertainSample, ...]:
        """All that is received, by the rows of r."""
        return self.heard + self.selected

    def ways(self, partition: int, receive: int) -> tuple[tuple[CouplingTerm, str], ...]:
        """Return the ways and channels a receive of a clock partition hears, whatever the tick."""
        ticks = [event for event in self.events if isinstance(event, Tick) and event.partition == partition]
        heard = [self.heard[row] for tick in ticks for row in tick.heard[receive]]
        return tuple(dict.fromkeys((item.way, item.sent.channel) for item in heard))


def tick_by_tick(schedule: Schedule) -> Schedule:
    """Return a schedule that hears what is selected, as if that were the first packet of a frame.

    Its rows of r are those of `schedule.selected`, in order.
    """
    heard = tuple(
        ReceivedSample(row.way, SentSample(row.way.link, row.channel, 0), 0) for row in schedule.selected
    )
    return replace(schedule, heard=heard, selected=())
