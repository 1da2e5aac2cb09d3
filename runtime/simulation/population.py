"""All peers of a scene over one frame: each one's program, and what they hear of each other.

Takes: a `Model`, who hears whom, and the members, with their programs.
Gives: `Population`, `build_population`; `FrameRows`, `FrameEngine`; `PopulationState`, `DeliverySource`;
`exchanges_within`, `instants_within`, `refuse_unheard_of`.
Guarantees: what many peers have in common is kept once.
Does not: play it (see `stepwise`, `machine`).

A member is a group of the scene, or those of its peers that are recorded, or those that are not.
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
from apc.frame.exchange import CommunicationGraph
from apc.frame.schedule import Propagate, Schedule, Tick
from apc.network.timetable import START, DeliveredPackets, Route
from apc.simulation.hearing import ExchangeProgram, hearing_of
from apc.simulation.program import GroupProgram, timed_events

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """All peers. A frame is so many quanta long and has so many rows, at `marks`, of `width` numbers.

    A row holds, member by member from `columns` on, each signal of all its peers. `parts` are those whose
    work is added up.
    """

    members: tuple[GroupProgram, ...]
    hearing: ExchangeProgram
    quantum: Fraction
    frame: int
    marks: int
    width: int
    columns: tuple[int, ...]
    parts: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FrameRows:
    """Some frames: `rows` (frames · marks, width), `work` (frames, parts) in J until each begins.

    Only the first `frames` could be played.
    """

    rows: Floats
    work: Floats
    frames: int


class DeliverySource(Protocol):
    """What says which packets the ticks of each route see, as a `Timetable` does; time only goes forward."""

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return what each route's ticks see, from where the last call ended to before `until`, in quanta."""


class FrameEngine(Protocol):
    """Plays a population, frame after frame; the runs of one seed differ in their packets."""

    def begin(self, run: int) -> None:
        """Go back to time 0 of the run of a number."""

    def play(self, first: int, count: int, pushes: Sequence[Floats | None]) -> FrameRows:
        """Play the frames from number `first` on; of the members with impulses `pushes` are these.

        They are (frames, rows, sites). What is returned may be written over by the next call.
        """

    def in_range(self) -> bool:
        """Say whether all that moves, recorded or not, is still a number; its work may not be."""


class PopulationState:
    """What all peers remember from frame to frame, in arrays that stay where they are.

    `packets` (ring, keys, peers) are those of the last frames; `carries` are of each member (rows, peers);
    `held` and `effective` are of each route, as of `ExchangeProgram`, and the number of the packet in effect.
    """

    def __init__(self, population: Population, timetable: Callable[[int], DeliverySource] | None) -> None:
        """Make it, at time 0 of the first run; `timetable` gives the packets of a run, None without any."""
        hearing, self.population, self.timetable = population.hearing, population, timetable
        self.packets = np.empty((hearing.ring, *hearing.start.shape))
        self.carries = [np.empty((member.carry.shape[1], member.count)) for member in population.members]
        self.held = [np.empty(start.shape) for start in hearing.held]
        self.effective = [np.empty(len(route.pairs), np.int64) for route in hearing.routes]
        self.begin(0)

    def begin(self, run: int) -> None:
        """Go back to time 0 (see `FrameEngine`)."""
        hearing, members = self.population.hearing, self.population.members
        self.table = None if self.timetable is None else self.timetable(run)
        self.packets[:] = hearing.start
        for array, start in zip(self.held, hearing.held, strict=True):
            array[:] = start
        for numbers in self.effective:
            numbers[:] = START
        for carry, member in zip(self.carries, members, strict=True):
            carry[:] = member.each(member.carry).T

    def seen_until(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return what the ticks see in the frames before number `until`, from the last that was asked for."""
        return self.table.take(until * self.population.frame) if self.table else ()

    def in_range(self) -> bool:
        """Say whether all that moves is still a number (see `FrameEngine`)."""
        members = zip(self.carries, self.population.members, strict=True)
        moving = (carry[: member.program.layout.work.start] for carry, member in members)
        return all(bool(np.isfinite(array).all()) for array in (self.packets, *moving))


def exchanges_within(schedules: Sequence[Schedule]) -> tuple[int, ...]:
    """Return the instants, in quanta, at which peers meet within the frame.

    Something is sent that is heard in the same frame, or a tick looks at each sender by itself.
    """
    slots = {heard.sent for schedule in schedules for heard in schedule.heard if heard.lag == 0}
    # Over an unreliable link anything may be heard as soon as it is sent.
    any_time = {selected.way.link for schedule in schedules for selected in schedule.selected}
    numbers = {
        at
        for schedule in schedules
        for sent, at in zip(schedule.sent, schedule.sent_times, strict=True)
        if sent in slots or sent.link in any_time
    }
    for schedule in schedules:
        for now, event in timed_events(schedule):
            heard = (row for rows in event.heard for row in rows) if isinstance(event, Tick) else ()
            if any(schedule.received[row].way.edge for row in heard):
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
    """Refuse a peer that has nothing of its own to stand in for what an unreliable link loses."""
    zero = {link.name for link in system.links if link.channel and link.channel.on_loss == "zero"}
    for kind in system.kinds:
        for partition in kind.clocks:
            for receive in partition.receives:
                if receive.link in zero and not any(send.link == receive.link for send in kind.sends):
                    what = (
                        f"{receive.name} hears {receive.link}, over which its peer sends nothing: it has no "
                        "value of its own to stand in for a missing one"
                    )
                    raise ApcError(
                        Diagnostic("E893", SourceLocation(system.origin.topology), what, hint="on_loss: hold")
                    )
                if receive.link in zero and receive.before:
                    what = f"{receive.name}: what stood in for a missing value at the tick before is not kept"
                    raise ApcError(
                        Diagnostic("E893", SourceLocation(system.origin.topology), what, hint="on_loss: hold")
                    )


def build_population(
    exchange: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route] = ()
) -> Population:
    """Join the programs of all groups by the packets between them.

    Parameters
    ----------
    exchange
        Who hears whom.
    members
        What each group brings, in the scene's order.
    routes
        The unreliable links.

    Raises
    ------
    ApcError
        E801 a mean over nobody, E802 a mean whose weights add up to 0.
    """
    schedule = members[0].program.schedule
    columns = np.cumsum([0, *(len(member.program.recorded) * member.count for member in members)]).tolist()
    parts = (part for member in members for part in member.program.layout.parts)
    return Population(
        members=tuple(members),
        hearing=hearing_of(exchange, members, routes),
        quantum=schedule.quantum,
        frame=schedule.frame,
        marks=len(schedule.marks) - 1,
        width=columns[-1],
        columns=tuple(columns[:-1]),
        parts=tuple(dict.fromkeys(parts)),
    )
