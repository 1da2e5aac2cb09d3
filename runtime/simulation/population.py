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
from apc.network.packet_schedule import START, DeliveredPackets, Route
from apc.simulation.exchange_program import ExchangeProgram, exchange_program_of
from apc.simulation.program import GroupProgram, timed_events
from apc.timing.communication_graph import CommunicationGraph
from apc.timing.schedule import Propagate, Schedule, SendEvent, Tick

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """All peers of a simulation, with the lengths of a frame and of its recorded rows.

    `frame` is the length in quanta; a frame has `sample_count` rows of `width` numbers. A row contains,
    member by member, each recorded signal of all the member's peers; `columns` are the members' first
    columns. `parts` are the parts whose work is summed.
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
    """The results of some frames: `rows` (frames · samples, width), `work` (frames, parts) in J until
    each frame.

    Only the first `frames` frames could be simulated.
    """

    rows: Floats
    work: Floats
    frames: int


class DeliverySource(Protocol):
    """A source of the packets in effect at each route's ticks, such as `Timetable`.

    Requests advance in time.
    """

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return the packets in effect at each route's ticks, from the last request until `until` in
        quanta.
        """


class FrameEngine(Protocol):
    """The protocol of an engine that simulates a population frame by frame.

    Runs of one seed differ in packets.
    """

    def begin(self, run: int) -> None:
        """Reset all peers to time 0, with the packets of this run."""

    def advance(self, first: int, count: int, pushes: Sequence[Floats | None]) -> FrameRows:
        """Return the rows of `count` frames from number `first` on, simulated under these impulses.

        `pushes` are (frames, rows, subsystems) for each member, None without forces. The next call may
        overwrite the returned arrays.
        """

    def in_range(self) -> bool:
        """Return whether all states are finite, recorded or not; the work may not be finite."""


class PopulationState:
    """The stored values of all peers from frame to frame, in arrays with fixed addresses.

    `packets` (ring, keys, peers) are those of the last frames; `carries` are those of each member (rows,
    peers). For each route, `held` are the values in effect, and `effective` the numbers of the packets in
    effect.
    """

    def __init__(self, population: Population, timetable: Callable[[int], DeliverySource] | None) -> None:
        """Set up the arrays at time 0 of the first run.

        `timetable` gives the packets of a run, None without any.
        """
        exchange_program, self.population, self.timetable = population.exchange_program, population, timetable
        self.packets = np.empty((exchange_program.ring, *exchange_program.start.shape))
        self.carries = [np.empty((member.carry.shape[1], member.count)) for member in population.members]
        self.held = [np.empty(start.shape) for start in exchange_program.held]
        self.effective = [np.empty(len(route.pairs), np.int64) for route in exchange_program.routes]
        self.begin(0)

    def begin(self, run: int) -> None:
        """Reset all arrays to time 0 of a run (see `FrameEngine`)."""
        exchange_program, members = self.population.exchange_program, self.population.members
        self.table = None if self.timetable is None else self.timetable(run)
        self.packets[:] = exchange_program.start
        for array, start in zip(self.held, exchange_program.held, strict=True):
            array[:] = start
        for packet_numbers in self.effective:
            packet_numbers[:] = START
        for carry, member in zip(self.carries, members, strict=True):
            carry[:] = member.each(member.carry).T

    def delivered_until(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return the packets in effect at the ticks before frame `until`, from the last request on."""
        return self.table.take(until * self.population.frame) if self.table else ()

    def in_range(self) -> bool:
        """Return whether all states are finite (see `FrameEngine`)."""
        members = zip(self.carries, self.population.members, strict=True)
        state_rows = (carry[: member.program.layout.work.start] for carry, member in members)
        return all(bool(np.isfinite(array).all()) for array in (self.packets, *state_rows))


def exchanges_within(schedules: Sequence[Schedule]) -> tuple[int, ...]:
    """Return the instants, in quanta, at which packets are exchanged within the frame.

    A packet is sent and received within the frame at these instants, or a tick has a pairwise reduction.
    """
    slots = {received.sent for schedule in schedules for received in schedule.received if received.lag == 0}
    # Over an unreliable link a packet may be received as soon as it is sent.
    any_time = {selected.coupling_term.link for schedule in schedules for selected in schedule.selected}
    instants = set()
    for schedule in schedules:
        for now, event in timed_events(schedule):
            match event:
                case SendEvent(_, rows, after):
                    sent = [schedule.sent[row] for _, row in rows]
                    if any(item in slots or item.link in any_time for item in sent):
                        instants.add(now + after)  # all events of the instant precede
                case Tick(_, _, input_rows):
                    received = (schedule.all_received[row] for rows in input_rows for row in rows)
                    if any(item.coupling_term.edge for item in received):
                        instants.add(now)
    return tuple(sorted(instants - {schedules[0].frame}))


def instants_within(schedules: Sequence[Schedule]) -> tuple[int, ...]:
    """Return the instants, in quanta, of computations and sends within the frame."""
    instants = {
        now
        for schedule in schedules
        for now, event in timed_events(schedule)
        if not isinstance(event, Propagate)
    }
    return tuple(sorted(instants))


def refuse_unheard_of(model: Model) -> None:
    """Raise E893 if a link replaces lost packets by zero and a receiving peer has no own value to send."""
    zero = {link.name for link in model.links for channel in link.channels if channel.on_loss == "zero"}
    for peer_type in model.peer_types:
        for partition in peer_type.clocks:
            for receive in partition.receives:
                if receive.link in zero and not any(send.link == receive.link for send in peer_type.sends):
                    message = (
                        f"{receive.name} has no value to substitute for a lost packet, because its peer does "
                        f"not send over {receive.link}"
                    )
                    raise ApcError(
                        Diagnostic(
                            "E893", SourceLocation(model.origin.topology), message, fix="on_loss: hold"
                        )
                    )
                if receive.link in zero and receive.before:
                    message = (
                        f"{receive.name}: the substitute for a lost packet of the previous tick is not stored"
                    )
                    raise ApcError(
                        Diagnostic(
                            "E893", SourceLocation(model.origin.topology), message, fix="on_loss: hold"
                        )
                    )


def build_population(
    comm_graph: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route] = ()
) -> Population:
    """Return the population of all members, with their programs joined by the packets between them.

    Parameters
    ----------
    comm_graph
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
        exchange_program=exchange_program_of(comm_graph, members, routes),
        quantum=schedule.quantum,
        frame=schedule.frame,
        sample_count=len(schedule.sample_times) - 1,
        width=columns[-1],
        columns=tuple(columns[:-1]),
        parts=tuple(dict.fromkeys(parts)),
    )
