"""One frame of one site as compiled steps, and the peers that execute them.

Takes: sites' parameters, the maps of each interval, start values; the site of each peer of a group.
Gives: `Program`, `Segment`, `Layout`; `GroupProgram`, `build_member`; `timed_events`, `seconds_at`.
Guarantees: the carry at time 0 has start states, and zeros for values not yet computed. Data common to
several peers is stored once.
Does not: write the steps (see `program_builder`), or handle other members (see `exchange_program`,
`population`).

A segment lies between two instants of packet exchange or pairwise reduction within the frame:

    (carry, heard, constants, impulses, frame) -> (carry⁺, sent, rows)
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
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.linearize import start_values
from apc.frame.schedule import ClockedValue, Event, Propagate, Schedule
from apc.simulation.pairwise import Pairwise
from apc.simulation.propagate import Rates
from apc.simulation.signals import LocalSignal

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Layout:
    """The rows of the carry: x, newest outputs, outputs of holds, values to act later, work.

    `outputs` are the (clock partition, output) pairs that are remembered or recorded; `later_values` are
    values of earlier frames, or of earlier segments, that a hold puts out after; `parts` are those whose work
    is added up.
    """

    states: int
    outputs: tuple[tuple[int, int], ...]
    holds: int
    later_values: tuple[ClockedValue, ...]
    parts: tuple[str, ...]

    @property
    def ends(self) -> tuple[int, ...]:
        """The first index of each part, and the end of the last."""
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
    """A stretch of the frame: `kernel` is the function above; `received`, `sent` are rows of the schedule.

    After those rows the kernel hears what comes of each of `pairwise`. Of a frame's rows and impulses its
    first are `first_mark` and `first_impulse`.
    """

    kernel: Any  # casadi.Function
    received: tuple[int, ...]
    pairs: tuple[Pairwise, ...]
    sent: tuple[int, ...]
    first_mark: int
    first_impulse: int


@dataclass(frozen=True, slots=True)
class Program:
    """A subsystem's frame. `recorded` are the signals of each row; `timed`: it depends on the frame number.

    `durations` are the intervals' lengths in quanta, in the order of a subsystem's constants; `intervals` are
    (start, place in `durations`) of each interval, for the impulses of forces that change with time; `moves`
    are the integrators of the segments, kept alive with them.
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
        """The intervals' lengths in seconds."""
        return tuple(length * self.schedule.quantum for length in self.durations)

    @property
    def impulse_rows(self) -> int:
        """The number of impulse values of one frame."""
        return len(self.rates.forced) * len(self.intervals) if self.rates.timed else 0

    def constants(self, parameters: Floats, transitions: Sequence[Floats]) -> Floats:
        """Return constants (subsystems, rows): parameters, then [E F c] of each duration, columns first."""
        columns = self.rates.pattern.T
        return np.concatenate(
            [parameters, *(transition.swapaxes(1, 2)[:, columns] for transition in transitions)], axis=1
        )


def timed_events(schedule: Schedule) -> list[tuple[int, Event]]:
    """Return the events of a frame, each with its instant in quanta."""
    lengths = [event.duration if isinstance(event, Propagate) else 0 for event in schedule.events]
    return list(zip(accumulate(lengths, initial=0), schedule.events, strict=False))


def seconds_at(schedule: Schedule, frame: Any, now: int) -> Any:
    """Return the time of an instant of a frame, rounded once: counted in quanta, which are whole numbers."""
    quanta = frame * schedule.frame + now
    return quanta * schedule.quantum.numerator / schedule.quantum.denominator


@dataclass(frozen=True, slots=True, eq=False)
class GroupProgram:
    """Peers of one group of the model in a population.

    `peers` (count,) are their numbers in the model. `rows` (count,) is the subsystem index of each;
    `parameters` (subsystems, n_p) are those subsystems' vectors, `constants` (subsystems, rows) their program
    constants; `sends` are the values sent at the start (subsystems, channels), by link.
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
    """Collect the contributions of some peers of a group to a population.

    Parameters
    ----------
    group
        The group's place in the model.
    peers
        The peers' numbers in the model (count,).
    subsystem
        The group's peer type.
    rows, vectors, transitions
        Which of the group's different subsystems each peer is (count,), their parameters (subsystems, n_p),
        and what they do over the program's intervals.
    program
        The frame program of each peer.
    """
    used, local = np.unique(rows, return_inverse=True)
    vector, peer_type, layout = vectors[used], subsystem.peer_type, program.layout
    x, _, stored = start_values(subsystem, list(vector.T))
    carry = np.zeros((len(vector), layout.ends[-1]))
    for row, value in enumerate(x):
        carry[:, row] = value
    for p, (partition, values) in enumerate(zip(peer_type.clocks, stored, strict=True)):
        for output, value in zip(partition.memories, values, strict=True):
            if (p, output) in layout.outputs:  # else its clock never ticks
                carry[:, layout.states + layout.outputs.index((p, output))] = value
    states, still = carry[:, : layout.states].T, np.zeros((layout.holds, len(vector)))
    return GroupProgram(
        group=group,
        peers=peers,
        program=program,
        rows=local,
        parameters=vector,
        constants=program.constants(vector, [transition[used] for transition in transitions]),
        sends={
            send.link: np.asarray(send.send.map(len(vector))(states, still, vector.T, 0.0), np.float64).T
            for send in peer_type.sends
        },
        carry=carry,
    )
