"""One frame of one site as compiled steps.

Takes: a site's parameters, what each interval does to it (`Transitions`), its start values.
Gives: `Program`, `Segment`, `Layout`; `seconds_at`.
Guarantees: the carry at time 0 is what was never computed, as zero, and the states where they start.
Does not: write the steps (see `writing`).

A segment is what happens between two moments at which packets are exchanged within the frame, or peers look
at each other pair by pair:

    (carry, heard, constants, impulses, frame) -> (carry⁺, sent, rows)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Kind
from apc.frame.schedule import Schedule, Value
from apc.simulation.local_signals import LocalSignal
from apc.simulation.pairs import Pairwise
from apc.simulation.propagate import Rates, Transitions

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Layout:
    """The rows of the carry at the start of a frame: x, newest outputs, values to act later, work.

    `outputs` are the (clock partition, output) pairs that are computed; `later` are values of earlier frames
    that a hold puts out in this one or after; `parts` are those whose work is added up.
    """

    states: int
    outputs: tuple[tuple[int, int], ...]
    later: tuple[Value, ...]
    parts: tuple[str, ...]

    @property
    def size(self) -> int:
        """The number of rows."""
        return self.states + len(self.outputs) + len(self.later) + len(self.parts)

    @property
    def work(self) -> slice:
        """The rows that hold the work done so far, in J."""
        return slice(self.size - len(self.parts), self.size)


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of the frame: `kernel` is the function above; `heard`, `sent` are rows of the schedule.

    After those rows the kernel hears what comes of each of `pairs`.
    """

    kernel: Any  # casadi.Function
    heard: tuple[int, ...]
    pairs: tuple[Pairwise, ...]
    sent: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Program:
    """A site's frame. `recorded` are the signals of each row; `timed` says that the frame's number matters.

    `durations` are the intervals' lengths in quanta, in the order of a site's constants; `intervals` are
    (start, place in `durations`) of each interval, for the impulses of forces that change with time.
    """

    kind: Kind
    schedule: Schedule
    rates: Rates
    layout: Layout
    segments: tuple[Segment, ...]
    recorded: tuple[LocalSignal, ...]
    durations: tuple[int, ...]
    intervals: tuple[tuple[int, int], ...]

    @property
    def impulse_rows(self) -> int:
        """How many numbers the impulses of one frame are."""
        return int(self.rates.g.sum()) * len(self.intervals) if self.rates.timed else 0

    def constants(self, parameters: Floats, transitions: Transitions) -> Floats:
        """Return a site's constants: its parameters, then E, F and c of every duration."""
        rates, n_x = self.rates, self.layout.states
        parts = [parameters]
        for matrix in transitions.matrices:
            e, f, c = np.split(matrix, [n_x, matrix.shape[1] - 1], axis=1)
            parts += [e[rates.e], f[rates.f], c[rates.g, 0]]
        return np.concatenate(parts)

    def start(self, x: Sequence[float], remembered: Sequence[Sequence[float]]) -> Floats:
        """Return the carry at time 0, when nothing is computed yet.

        Parameters
        ----------
        x
            The states' start values (n_x,).
        remembered
            Those of the remembered outputs of every clock partition.
        """
        newest = dict.fromkeys(self.layout.outputs, 0.0)
        for p, (partition, values) in enumerate(zip(self.kind.clocks, remembered, strict=True)):
            newest |= {(p, o): one for o, one in zip(partition.memories, values, strict=True)}
        head = [*x, *(newest[one] for one in self.layout.outputs)]
        return np.concatenate([head, np.zeros(self.layout.size - len(head))])


def seconds_at(schedule: Schedule, frame: Any, now: int) -> Any:
    """Return the time of an instant of a frame, rounded once: counted in quanta, which are whole numbers."""
    quanta = frame * schedule.frame + now
    return quanta * schedule.quantum.numerator / schedule.quantum.denominator
