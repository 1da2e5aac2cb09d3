"""All peers of a model over one frame: their programs and their exchange of packets.

Takes: a `Model`, the communication graph, and the members with their programs.
Gives: `Population`, `build_population`; `FrameRows`, `FrameEngine`; `PopulationState`, `DeliverySource`;
`exchanges_within`, `instants_within`, `refuse_unheard_of`.
Guarantees: data common to several peers is stored once.
Does not: execute it (see `interpreted_engine`, `compiled_engine`).

A member is a group of the model, or its recorded peers, or its other peers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.schedule import Propagate, Schedule, Tick
from apc.network.packet_schedule import START, DeliveredPackets, Route
from apc.simulation.exchange_program import ExchangeProgram, exchange_program_of
from apc.simulation.program import GroupProgram, timed_events

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """All peers. A frame has a length in quanta, and rows at `sample_count`, each of `width` numbers.

    A row holds, member by member from `columns` on, each signal of all its peers. `parts` are the parts whose
    work is summed.
    """

    members: tuple[GroupProgram, ...]
    exchange_program: ExchangeProgram
    quantum: Fraction
    frame: int
    sample_count: int
    width: int
    columns: tuple[int, ...]
    parts: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FrameRows:
    """Some frames: `rows` (frames · marks, width), `work` (frames, parts) in J until each begins.

    Only the first `frames` could be simulated.
    """

    rows: Floats
    work: Floats
    frames: int


class DeliverySource(Protocol):
    """A source of the packets in effect at each route's ticks, such as `Timetable`; time only advances."""

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return the packets in effect at each route's ticks, from the last call until `until` in quanta."""


class FrameEngine(Protocol):
    """Simulates a population, frame after frame; the runs of one seed differ in their packets."""

    def begin(self, run: int) -> None:
        """Go back to time 0 of the run of a number."""

    def advance(self, first: int, count: int, pushes: Sequence[Floats | None]) -> FrameRows:
        """Simulate the frames from number `first` on; `pushes` are the impulses on members.

        They are (frames, rows, subsystems). What is returned may be written over by the next call.
        """

    def in_range(self) -> bool:
        """Return whether all states, recorded or not, are finite; the work may not be."""


class PopulationState:
    """The stored values of all peers from frame to frame, in arrays with fixed addresses.

    `packets` (ring, keys, peers) are those of the last frames; `carries` are of each member (rows, peers);
    `held` and `effective` are of each route, as of `ExchangeProgram`, and the number of the packet in effect.
    """

    def __init__(self, population: Population, timetable: Callable[[int], DeliverySource] | None) -> None:
        """Make it, at time 0 of the first run; `timetable` gives the packets of a run, None without any."""
        exchange_program, self.population, self.timetable = population.exchange_program, population, timetable
        self.packets = np.empty((exchange_program.ring, *exchange_program.start.shape))
        self.carries = [np.empty((member.carry.shape[1], member.count)) for member in population.members]
        self.held = [np.empty(start.shape) for start in exchange_program.held]
        self.effective = [np.empty(len(route.pairs), np.int64) for route in exchange_program.routes]
        self.begin(0)

    def begin(self, run: int) -> None:
        """Go back to time 0 (see `FrameEngine`)."""
        exchange_program, members = self.population.exchange_program, self.population.members
        self.table = None if self.timetable is None else self.timetable(run)
        self.packets[:] = exchange_program.start
        for array, start in zip(self.held, exchange_program.held, strict=True):
            array[:] = start
        for numbers in self.effective:
            numbers[:] = START
        for carry, member in zip(self.carries, members, strict=True):
            carry[:] = member.each(member.carry).T

    def delivered_until(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return the packets in effect at the ticks before frame `until`, from the last request on."""
        return self.table.take(until * self.population.frame) if self.table else ()

    def in_range(self) -> bool:
        """Return whether all states are finite (see `FrameEngine`)."""
        members = zip(self.carries, self.population.members, strict=True)
        moving = (carry[: member.program.layout.work.start] for carry, member in members)
        return all(bool(np.isfinite(array).all()) for array in (self.packets, *moving))


def exchanges_within(schedules: Sequence[Schedule]) -> tuple[int, ...]:
    """Return the instants, in quanta, of exchanges within the frame.

    At these a packet is sent and received within the frame, or a tick has a pairwise reduction.
    """
    slots = {received.sent for schedule in schedules for received in schedule.received if received.lag == 0}
    # Over an unreliable link a packet may be received as soon as it is sent.
    any_time = {selected.coupling_term.link for schedule in schedules for selected in schedule.selected}
    numbers = {
        at
        for schedule in schedules
        for sent, at in zip(schedule.sent, schedule.sent_times, strict=True)
        if sent in slots or sent.link in any_time
    }
    for schedule in schedules:
        for now, event in timed_events(schedule):
            received = (row for rows in event.input_rows for row in rows) if isinstance(event, Tick) else ()
            if any(schedule.all_received[row].coupling_term.edge for row in received):
                numbers.add(now)
    return tuple(sorted(numbers))


def instants_within(schedules: Sequence[Schedule]) -> tuple[int, ...]:
    """Return the instants, in quanta, at which anything is computed or sent within the frame."""
    numbers = {
        now
        for schedule in schedules
        for now, event in timed_events(schedule)
        if not isinstance(event, Propagate)
    }
    return tuple(sorted(numbers))


def refuse_unheard_of(system: Model) -> None:
    """Refuse a peer without an own value as the substitute for a lost packet."""
    zero = {link.name for link in system.links if link.channel and link.channel.on_loss == "zero"}
    for peer_type in system.peer_types:
        for partition in peer_type.clocks:
            for receive in partition.receives:
                if receive.link in zero and not any(send.link == receive.link for send in peer_type.sends):
                    message = (
                        f"{receive.name} hears {receive.link}, over which its peer sends nothing: it has no "
                        "value of its own to stand in for a missing one"
                    )
                    raise ApcError(
                        Diagnostic(
                            "E893", SourceLocation(system.origin.topology), message, hint="on_loss: hold"
                        )
                    )
                if receive.link in zero and receive.before:
                    message = (
                        f"{receive.name}: what stood in for a missing value at the tick before is not kept"
                    )
                    raise ApcError(
                        Diagnostic(
                            "E893", SourceLocation(system.origin.topology), message, hint="on_loss: hold"
                        )
                    )


def build_population(
    exchange: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route] = ()
) -> Population:
    """Join the programs of all groups by the packets between them.

    Parameters
    ----------
    exchange
        The communication graph.
    members
        The members of each group, in the model's order.
    routes
        The unreliable links.

    Raises
    ------
    ApcError
        E801 a mean over no peers, E802 a mean whose weights add up to 0.
    """
    schedule = members[0].program.schedule
    columns = np.cumsum([0, *(len(member.program.recorded) * member.count for member in members)]).tolist()
    parts = (part for member in members for part in member.program.layout.parts)
    return Population(
        members=tuple(members),
        exchange_program=exchange_program_of(exchange, members, routes),
        quantum=schedule.quantum,
        frame=schedule.frame,
        sample_count=len(schedule.sample_times) - 1,
        width=columns[-1],
        columns=tuple(columns[:-1]),
        parts=tuple(dict.fromkeys(parts)),
    )
