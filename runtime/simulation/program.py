"""The program of one frame of a subsystem, and the peers that execute it.

Takes: parameter vectors, the transitions over each interval, start values; the subsystem of each peer of a
group.
Gives: `Program`, `Segment`, `Layout`; `GroupProgram`, `build_member`; `timed_events`, `seconds_at`.
Guarantees: the carry at time 0 has start states, and zeros for values not yet computed, or those of an
equilibrium. Data common to several peers is stored once.
Does not: build the functions (see `program_builder`), or handle other members (see `exchange_program`,
`population`).

A segment lies between two instants of packet exchange or pairwise reduction within the frame:

    (carry, received, constants, impulses, frame) -> (carry⁺, sent, rows)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PeerType
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linearize import start_values
from apc.simulation.pairwise import Pairwise
from apc.simulation.propagate import Rates
from apc.simulation.signals import LocalSignal
from apc.timing.schedule import ClockedValue, Event, Propagate, Schedule

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Layout:
    """The rows of the carry: x, newest outputs, outputs of holds, values for later use, work.

    `outputs` are the (clock partition, output) pairs that are memories or recorded; `later_values` are values
    of earlier frames or segments that a hold outputs later; `parts` are the parts whose work is added up.
    """

    states: int
    outputs: tuple[tuple[int, int], ...]
    holds: int
    later_values: tuple[ClockedValue, ...]
    parts: tuple[str, ...]

    @property
    def ends(self) -> tuple[int, ...]:
        """The first row of each part of the carry, and the end of the last part."""
        sizes = (self.states, len(self.outputs), self.holds, len(self.later_values), len(self.parts))
        return tuple(accumulate(sizes, initial=0))

    @property
    def held(self) -> slice:
        """The rows of the outputs of holds."""
        return slice(*self.ends[2:4])

    @property
    def work(self) -> slice:
        """The rows of the accumulated work, in J."""
        return slice(*self.ends[4:])


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment of the frame: `kernel` is the function above; `received`, `sent` are rows of the schedule.

    The received values are followed by the results of the `pairs`. `first_mark` and `first_impulse` are the
    first of the frame's recorded rows and impulses that belong to the segment.
    """

    kernel: Any  # casadi.Function
    received: tuple[int, ...]
    pairs: tuple[Pairwise, ...]
    sent: tuple[int, ...]
    first_mark: int
    first_impulse: int


@dataclass(frozen=True, slots=True)
class Program:
    """The program of a subsystem's frame; `recorded` are the signals of each row.

    `durations` are the intervals' lengths in quanta, in the order of a subsystem's constants; `intervals` are
    (start, index in `durations`) of each interval, for the impulses of time-varying forces; `moves` are the
    integrators, referenced here as long as the segments call them.
    """

    peer_type: PeerType
    schedule: Schedule
    rates: Rates
    layout: Layout
    segments: tuple[Segment, ...]
    recorded: tuple[LocalSignal, ...]
    durations: tuple[int, ...]
    intervals: tuple[tuple[int, int], ...]
    moves: tuple[Any, ...]

    @property
    def seconds(self) -> tuple[Fraction, ...]:
        """The lengths of the intervals in seconds."""
        return tuple(length * self.schedule.quantum for length in self.durations)

    @property
    def impulse_rows(self) -> int:
        """The number of impulse values of one frame."""
        return len(self.rates.forced) * len(self.intervals) if self.rates.timed else 0

    def constants(self, parameters: Floats, transitions: Sequence[Floats]) -> Floats:
        """Return the constants (subsystems, rows): parameters, then [E F c] of each duration, column by
        column.
        """
        columns = self.rates.pattern.T
        return np.concatenate(
            [parameters, *(transition.swapaxes(1, 2)[:, columns] for transition in transitions)], axis=1
        )


def timed_events(schedule: Schedule) -> list[tuple[int, Event]]:
    """Return the events of a frame, each with its instant in quanta."""
    lengths = [event.duration if isinstance(event, Propagate) else 0 for event in schedule.events]
    return list(zip(accumulate(lengths, initial=0), schedule.events, strict=False))


def seconds_at(schedule: Schedule, frame: Any, now: int) -> Any:
    """Return the time in s of an instant of a frame, counted in integer quanta and rounded once."""
    quanta = frame * schedule.frame + now
    return quanta * schedule.quantum.numerator / schedule.quantum.denominator


@dataclass(frozen=True, slots=True, eq=False)
class GroupProgram:
    """A member of a population: peers of one group of the model, with their program.

    `peers` (count,) are their indices in the model. `rows` (count,) is the subsystem index of each peer;
    `parameters` (subsystems, n_p) are the parameter vectors of the subsystems, `constants` (subsystems, rows)
    their program constants; `sends` are the values sent at the start (subsystems, channels), by link.
    """

    group: int
    peers: NDArray[np.int64]
    program: Program
    rows: NDArray[np.int64]
    parameters: Floats
    constants: Floats
    sends: Mapping[str, Floats]
    carry: Floats  # (subsystems, rows of the carry)

    @property
    def count(self) -> int:
        """The number of peers."""
        return len(self.rows)

    def each(self, values: Floats) -> Floats:
        """Return one row per peer from one row per subsystem."""
        return np.ascontiguousarray(values[self.rows])


def build_member(
    group: int,
    peers: NDArray[np.int64],
    subsystem: SubsystemJacobians,
    rows: NDArray[np.int64],
    vectors: Floats,
    program: Program,
    transitions: Sequence[Floats],
) -> GroupProgram:
    """Return a member of a population: some peers of a group, with their program and start values.

    Parameters
    ----------
    group
        The group's index in the model.
    peers
        The peers' indices in the model (count,).
    subsystem
        The Jacobians of the group's peer type.
    rows, vectors, transitions
        The index of each peer among the group's different subsystems (count,), the parameters of these
        (subsystems, n_p), and their transitions over the program's intervals.
    program
        The frame program of each peer.
    """
    used, subsystem_of_peer = np.unique(rows, return_inverse=True)
    used_vectors, peer_type, layout = vectors[used], subsystem.peer_type, program.layout
    x, u, memories = start_values(subsystem, list(used_vectors.T))
    carry = np.zeros((len(used_vectors), layout.ends[-1]))
    for row, value in enumerate(x):
        carry[:, row] = value
    for p, (partition, values) in enumerate(zip(peer_type.clocks, memories, strict=True)):
        for output, value in zip(partition.memories, values, strict=True):
            if (p, output) in layout.outputs:  # otherwise its clock never ticks
                carry[:, layout.states + layout.outputs.index((p, output))] = value
    for row, (hold, value) in enumerate(zip(peer_type.holds, u, strict=True), layout.held.start):
        carry[:, row] = value
        # Values of earlier ticks that act later: those of the hold at an equilibrium, zero otherwise.
        for later, source in enumerate(layout.later_values, layout.held.stop):
            clock = peer_type.clocks[source.partition].clock
            if hold.start and (clock, source.output) == (hold.clock, hold.output):
                carry[:, later] = value
    states, holds = carry[:, : layout.states].T, carry[:, layout.held].T
    return GroupProgram(
        group=group,
        peers=peers,
        program=program,
        rows=subsystem_of_peer,
        parameters=used_vectors,
        constants=program.constants(used_vectors, [transition[used] for transition in transitions]),
        sends={
            send.link: np.asarray(
                send.send.map(len(used_vectors))(states, holds, used_vectors.T, 0.0), np.float64
            ).T
            for send in peer_type.sends
        },
        carry=carry,
    )
