"""One frame of one site as compiled steps, and the peers that take them.

Takes: sites' parameters, what each interval does to them, their start values; which of a
group's different sites each peer is.
Gives: `Program`, `Segment`, `Layout`; `GroupProgram`, `build_member`; `timed_events`, `seconds_at`.
Guarantees: the carry at time 0 is what was never computed, as zero, and the states where they start; what
many peers have in common is kept once.
Does not: write the steps (see `writing`), or know the other members (see `frame_packets`, `population`).

A segment is what happens between two moments at which packets are exchanged within the frame, or peers look
at each other pair by pair:

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
from apc.simulation.pairs import Pairwise
from apc.simulation.propagate import Rates
from apc.simulation.signals import LocalSignal

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Layout:
    """The rows of the carry: x, newest outputs, what holds put out, values to act later, work.

    `outputs` are the (clock partition, output) pairs that are remembered or recorded; `later` are values of
    earlier frames, or of earlier segments, that a hold puts out after; `parts` are those whose work is added
    up.
    """

    states: int
    outputs: tuple[tuple[int, int], ...]
    holds: int
    later: tuple[ClockedValue, ...]
    parts: tuple[str, ...]

    @property
    def ends(self) -> tuple[int, ...]:
        """Where each of these begins, and the last ends."""
        sizes = (self.states, len(self.outputs), self.holds, len(self.later), len(self.parts))
        return tuple(accumulate(sizes, initial=0))

    @property
    def held(self) -> slice:
        """The rows that hold what holds put out."""
        return slice(*self.ends[2:4])

    @property
    def work(self) -> slice:
        """The rows that hold the work done so far, in J."""
        return slice(*self.ends[4:])


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of the frame: `kernel` is the function above; `heard`, `sent` are rows of the schedule.

    After those rows the kernel hears what comes of each of `pairs`. Of a frame's rows and impulses its first
    are `first_mark` and `first_impulse`.
    """

    kernel: Any  # casadi.Function
    heard: tuple[int, ...]
    pairs: tuple[Pairwise, ...]
    sent: tuple[int, ...]
    first_mark: int
    first_impulse: int


@dataclass(frozen=True, slots=True)
class Program:
    """A site's frame. `recorded` are the signals of each row; `timed` says that the frame's number matters.

    `durations` are the intervals' lengths in quanta, in the order of a site's constants; `intervals` are
    (start, place in `durations`) of each interval, for the impulses of forces that change with time; `moves`
    are what segments integrate by, which has to outlive them.
    """

    kind: PeerType
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
        """How many numbers the impulses of one frame are."""
        return len(self.rates.pushed) * len(self.intervals) if self.rates.timed else 0

    def constants(self, parameters: Floats, transitions: Sequence[Floats]) -> Floats:
        """Return sites' constants (sites, rows): parameters, then each duration's [E F c], columns first."""
        columns = self.rates.pattern.T
        return np.concatenate(
            [parameters, *(transition.swapaxes(1, 2)[:, columns] for transition in transitions)], axis=1
        )


def timed_events(schedule: Schedule) -> list[tuple[int, Event]]:
    """Return what happens in a frame, each with its instant in quanta."""
    lengths = [event.duration if isinstance(event, Propagate) else 0 for event in schedule.events]
    return list(zip(accumulate(lengths, initial=0), schedule.events, strict=False))


def seconds_at(schedule: Schedule, frame: Any, now: int) -> Any:
    """Return the time of an instant of a frame, rounded once: counted in quanta, which are whole numbers."""
    quanta = frame * schedule.frame + now
    return quanta * schedule.quantum.numerator / schedule.quantum.denominator


@dataclass(frozen=True, slots=True, eq=False)
class GroupProgram:
    """Peers of one group of the scene in a population.

    `peers` (count,) are their numbers in the scene. `rows` (count,) says which of the different sites each
    is; `parameters` (sites, n_p) are those sites' vectors, `constants` (sites, rows) what their programs
    take; `sends` is what they send at the start (sites, channels), by link.
    """

    group: int
    peers: NDArray[np.int64]
    program: Program
    rows: NDArray[np.int64]
    parameters: Floats
    constants: Floats
    sends: Mapping[str, Floats]
    carry: Floats  # (sites, rows of the carry)

    @property
    def count(self) -> int:
        """The number of peers."""
        return len(self.rows)

    def each(self, values: Floats) -> Floats:
        """Return one row a peer of what is one row a site."""
        return np.ascontiguousarray(values[self.rows])


def build_member(
    group: int,
    peers: NDArray[np.int64],
    site: SubsystemJacobians,
    rows: NDArray[np.int64],
    vectors: Floats,
    program: Program,
    transitions: Sequence[Floats],
) -> GroupProgram:
    """Collect what some peers of a group bring to a population.

    Parameters
    ----------
    group
        The group's place in the scene.
    peers
        The peers' numbers in the scene (count,).
    site
        The group's kind.
    rows, vectors, transitions
        Which of the group's different sites each peer is (count,), their parameters (sites, n_p), and what
        they do over the program's intervals.
    program
        What each peer does in a frame.
    """
    used, own = np.unique(rows, return_inverse=True)
    vector, kind, layout = vectors[used], site.kind, program.layout
    x, _, remembered = start_values(site, list(vector.T))
    carry = np.zeros((len(vector), layout.ends[-1]))
    for row, value in enumerate(x):
        carry[:, row] = value
    for p, (partition, values) in enumerate(zip(kind.clocks, remembered, strict=True)):
        for output, value in zip(partition.memories, values, strict=True):
            if (p, output) in layout.outputs:  # else its clock never ticks
                carry[:, layout.states + layout.outputs.index((p, output))] = value
    states, still = carry[:, : layout.states].T, np.zeros((layout.holds, len(vector)))
    return GroupProgram(
        group=group,
        peers=peers,
        program=program,
        rows=own,
        parameters=vector,
        constants=program.constants(vector, [transition[used] for transition in transitions]),
        sends={
            send.link: np.asarray(send.send.map(len(vector))(states, still, vector.T, 0.0), np.float64).T
            for send in kind.sends
        },
        carry=carry,
    )
