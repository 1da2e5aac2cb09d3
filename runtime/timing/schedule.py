"""Data types of one frame of a peer: its events in their order, and the values stored between frames.

Takes: the results of `scheduling`.
Gives: `Schedule` and its events, `Event`: `Tick`, `SendEvent`, `Propagate`, `HoldUpdate`, `RepeatedEvents`,
`HELD`; the values that they name: `ClockedValue`, `SentSample`, `CouplingTerm`, `ReceivedSample`,
`UncertainSample`; `shifted`, `discrete_states_of`; `with_per_tick_inputs`; `ORDER`.
Guarantees: exact time (integers of one quantum).
Does not: compute the instants of events (see `scheduling`).

Every value that a clock computes is one symbol, `ClockedValue(partition, output, index)`: output `output` at
the tick `index`, counted from the frame's first tick of that clock; a negative index is an earlier frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

# The order of coincident events. Continuous variables are continuous, so sampling has no rank in it.
ORDER = ("send", "deliver", "tick", "act")


@dataclass(frozen=True, slots=True, order=True)
class ClockedValue:
    """Output `output` of clock partition `partition`, computed at tick `index` of the frame."""

    partition: int
    output: int
    index: int


def shifted(value: ClockedValue, ticks: Sequence[int]) -> ClockedValue:
    """Return the value's symbol one frame later; `ticks` counts the ticks of a frame by clock partition."""
    return ClockedValue(value.partition, value.output, value.index + ticks[value.partition])


def discrete_states_of(values: Iterable[ClockedValue], ticks: Sequence[int]) -> tuple[ClockedValue, ...]:
    """Return the outputs of earlier frames that must be stored as discrete states, sorted.

    A value read at index −j was computed at index n − j of the previous frame, with n ticks per frame. While
    that index is negative, the value is stored for one more frame and included too.
    """
    result: set[ClockedValue] = set()
    for value in values:
        while value.index < 0:
            result.add(value)
            value = shifted(value, ticks)
    return tuple(sorted(result))


@dataclass(frozen=True, slots=True, order=True)
class SentSample:
    """A channel of a link as sent at tick `slot` of a frame, of `clock`; if empty, of the link's clock."""

    link: str
    channel: str
    slot: int
    clock: str = ""


@dataclass(frozen=True, slots=True, order=True)
class CouplingTerm:
    """One coupling term: `operator` over a link with delay `delay`, with a weight for each pair of peers.

    It contains only the pairs of peers whose delay is the timing `delay`. A receive that weights each sender
    separately, by the slope of its edge function, has one coupling term per channel: `edge` and `channel`
    name it, and are empty for a plain sum or mean. With `before`, a tick receives the values of the tick
    before. `clock` is the pairs' own clock, whose ticks send the packets; empty for the link's.
    """

    operator: str
    link: str
    delay: str
    edge: str = ""
    channel: str = ""
    before: bool = False
    clock: str = ""

    def sample(self, channel: str, slot: int) -> SentSample:
        """Return the sample of a channel that a slot sends to this coupling term."""
        return SentSample(self.link, channel, slot, self.clock)


@dataclass(frozen=True, slots=True, order=True)
class ReceivedSample:
    """The received sum over `coupling_term` of the other peers' `sent` values, of `lag` frames ago (0: this
    frame).
    """

    coupling_term: CouplingTerm
    sent: SentSample
    lag: int


@dataclass(frozen=True, slots=True, order=True)
class UncertainSample:
    """The value that tick `tick` of `clock` selects among the stored packets of an unreliable channel.

    With `gap` it is the total weight of the missing values.
    """

    coupling_term: CouplingTerm
    channel: str
    clock: str
    tick: int
    gap: bool = False


@dataclass(frozen=True, slots=True)
class Propagate:
    """Propagation over `duration` quanta without events."""

    duration: int


@dataclass(frozen=True, slots=True)
class SendEvent:
    """Send partition `partition` of the subsystem sends; `rows` are (channel, row of s) pairs.

    With `after`, the values are those after the other events at the instant.
    """

    partition: int
    rows: tuple[tuple[int, int], ...]
    after: bool = False


@dataclass(frozen=True, slots=True)
class Tick:
    """Clock partition `partition` computes tick `index`; `input_rows` are the rows of r of each receive.

    `variant` is the column of the partition that it computes (see `compiled.ClockPartition.variants`).
    """

    partition: int
    index: int
    input_rows: tuple[tuple[int, ...], ...]
    variant: int | None = None

    def rows(self, outputs: int) -> slice:
        """Return the slice of this tick's rows among those of all variants, with `outputs` rows each."""
        if self.variant is None:
            return slice(None)
        return slice(self.variant * outputs, (self.variant + 1) * outputs)


@dataclass(frozen=True, slots=True)
class HoldUpdate:
    """Hold `hold` switches to `value`."""

    hold: int
    value: ClockedValue


Event = Propagate | SendEvent | Tick | HoldUpdate


# The partition number of a hold's present output as a value: `ClockedValue(HELD, hold, −1)`.
HELD = -1


@dataclass(frozen=True, slots=True)
class RepeatedEvents:
    """Repeated events: `count` times a sequence of `length` events, from event `first` on.

    `ticks` counts the ticks of one repetition, by clock partition. `entering` are the values that one
    repetition needs of earlier ones, or that are needed at the end, with indices counted from its own first
    tick; `staying` are those that no repetition changes. See `HELD`.
    """

    first: int
    length: int
    count: int
    ticks: tuple[int, ...]
    entering: tuple[ClockedValue, ...]
    staying: tuple[ClockedValue, ...]

    @property
    def end(self) -> int:
        """The index of the first event after the repetitions."""
        return self.first + self.length * self.count


@dataclass(frozen=True, slots=True)
class Schedule:
    """The schedule of one frame for the peers of one group.

    `active_at_start` is the value of each hold as the frame begins (None for an unused hold);
    `discrete_states` are the values of earlier frames that this frame needs, the discrete part of z after the
    continuous states; `received` names r, and `selected` extends it where packets are lost or late; `sent`
    names s, and `depths` gives the number of frames for which each row of s is stored; `ticks` counts the
    ticks of each clock partition; `sample_times` are the instants, in quanta, of the fastest clock's ticks
    and the end; `repeats` are repeated events, if any.
    """

    quantum: Fraction
    frame: int
    events: tuple[Event, ...]
    active_at_start: tuple[ClockedValue | None, ...]
    discrete_states: tuple[ClockedValue, ...]
    received: tuple[ReceivedSample, ...]
    sent: tuple[SentSample, ...]
    depths: tuple[int, ...]
    ticks: tuple[int, ...]
    sample_times: tuple[int, ...]
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
    def all_received(self) -> tuple[ReceivedSample | UncertainSample, ...]:
        """All rows of r: the received and the selected values."""
        return self.received + self.selected

    def coupling_terms(self, partition: int, receive: int) -> tuple[tuple[CouplingTerm, str], ...]:
        """Return the coupling terms and channels of a receive of a clock partition, over all ticks."""
        ticks = [event for event in self.events if isinstance(event, Tick) and event.partition == partition]
        received = [self.received[row] for tick in ticks for row in tick.input_rows[receive]]
        return tuple(dict.fromkeys((item.coupling_term, item.sent.channel) for item in received))


def with_per_tick_inputs(schedule: Schedule) -> Schedule:
    """Return a schedule that receives each selected value as if it were the first packet of a frame.

    The rows of r are those of `schedule.selected`, in order.
    """
    received = tuple(
        ReceivedSample(row.coupling_term, row.coupling_term.sample(row.channel, 0), 0)
        for row in schedule.selected
    )
    return replace(schedule, received=received, selected=())
