"""A scene played in time: blocks of rows.

Takes: a `Simulation`. Gives: `Block`, `blocks`.
Guarantees: a row for time 0 and for every tick of the fastest clock until the end, values before the tick;
the memory used does not grow with the duration; no number that is not finite is given out.
Does not: keep, write or judge what comes out (see `trajectory`, `recording`, `summary`).
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.exchange import build_exchange
from apc.frame.parameters import resolve
from apc.network.timetable import Timetable
from apc.simulation.forcing import impulses
from apc.simulation.selection import Arrivals
from apc.simulation.simulation import Simulation

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_NAMED = 6  # states in a message


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Some rows: `time` (rows,) in seconds, `values` (rows, signals) in SI.

    `work` (parts,) is what the parts have done until the last frame that begins by then, over all peers, in
    J.
    `stopped` is the name of what left the range of floats after the last row, at `stopped_at` seconds; empty
    if nothing did.
    """

    time: Floats
    values: Floats
    work: Floats
    stopped: str = ""
    stopped_at: float = 0.0


def blocks(simulation: Simulation, *, run: int = 0) -> Iterator[Block]:
    """Play a scene from time 0 and yield its rows, block by block.

    Parameters
    ----------
    simulation
        What to play.
    run
        Which of many runs with one seed: each has packets of its own.

    Raises
    ------
    ApcError
        E872 an equation has no solution at some instant, E871 a motion can't be integrated any further; what
        was before is yielded first.
    """
    last = int(simulation.settings.duration / simulation.quantum)  # rounds down
    runner = _Runner(simulation, run)
    for first in range(0, last // simulation.frame + 1, simulation.length):
        block = runner.run(first, last)
        yield block
        if block.stopped:
            return
        if runner.failed is not None:
            raise _unsolved(simulation, runner.failed)


def _unsolved(simulation: Simulation, frame: int) -> ApcError:
    """Return the mistake of a frame that could not be played."""
    place = Place(simulation.system.name)
    at = f"after {float(frame * simulation.frame * simulation.quantum):g} s"
    if not simulation.tolerances:
        what = f"an equation has no solution, or a loop none that Newton's method finds, {at}"
        return ApcError(Mistake("E872", place, what))
    states = ", ".join(one.state for one in simulation.tolerances[:MOST_NAMED])
    what = (
        f"the motion of {states} can't be integrated {at}: it grows without measure, an equation there has "
        "no value, or a force jumps to and fro without end"
    )
    hint = "dry friction by tanh in the place of sign; --method semi-implicit:0.1ms shows what happens"
    return ApcError(Mistake("E871", place, what, hint=hint))


def _arrivals(simulation: Simulation, run: int) -> Arrivals | None:
    """Return what chance says of the packets of a run; None if all links are reliable."""
    if not simulation.routes:
        return None
    system, seed = simulation.system, simulation.seed
    timings = resolve(system).timings
    exchange = build_exchange(system, timings)
    routes, quantum = simulation.routes, simulation.quantum
    table = Timetable(system, timings, exchange, routes, quantum, seed=seed, run=run)
    return Arrivals(table, simulation.population.members, simulation.frame)


class _Runner:
    """The chunked function with the memory it reads and writes."""

    def __init__(self, simulation: Simulation, run: int) -> None:
        self.simulation, self.length = simulation, simulation.length
        self.arrivals = _arrivals(simulation, run)
        self.state = [one.copy() for one in simulation.population.start]
        self.done = np.zeros(len(simulation.parts))
        self.failed: int | None = None  # the frame that could not be played
        function = simulation.chunk
        self.buffer, self.call = function.buffer()
        inputs = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self.inputs = [*self.state, *inputs[len(self.state) :]]
        self.outputs = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, one in enumerate(self.inputs):
            self.buffer.set_arg(i, memoryview(one.reshape(-1).data))
        for i, one in enumerate(self.outputs):
            self.buffer.set_res(i, memoryview(one.data))

    def run(self, first: int, last: int) -> Block:
        """Run the frames from `first` on; rows after the quantum `last` are left out."""
        simulation, length = self.simulation, self.length
        self._push(first)
        instants, kept = self._instants(first, last)
        # Where a solver gives up CasADi prints its arguments, and then the ones that it was called from.
        with contextlib.redirect_stderr(io.StringIO()):
            try:
                self.call()
                failed = bool(self.buffer.ret())
            except RuntimeError:
                failed = True
            played = self._salvage() if failed else length
        if failed:
            self.failed = first + played
            kept &= np.arange(len(kept)) < played * len(simulation.marks)
        values = self._values()[kept]
        time = instants[kept] * simulation.quantum.numerator / simulation.quantum.denominator
        finite = np.isfinite(values)
        rows: NDArray[np.bool_] = np.all(finite, axis=1)
        stop = len(rows) if rows.all() else int(np.argmin(rows))
        if stop:  # to the last frame that begins by the last row
            work = self._work(int(np.flatnonzero(kept)[stop - 1]) // len(simulation.marks))
            if np.isfinite(work).all():  # a product of forces and speeds overflows long before they do
                self.done = work
        for place, one in enumerate(self.state):
            one.reshape(-1)[:] = self.outputs[place].reshape(length, -1)[-1]
        if stop < len(rows):
            name = simulation.signals[int(np.argmin(finite[stop]))].name
            return Block(time[:stop], values[:stop], self.done, name, float(time[stop]))
        if self.failed is None and instants[-1] <= last and not self._in_range():
            return Block(time, values, self.done, "what is not recorded", float(time[-1]))
        return Block(time, values, self.done)

    def _salvage(self) -> int:
        """Play the frames of a chunk that failed one by one; return how many could be played."""
        states, width = list(self.state), len(self.state)
        shapes = [self.simulation.population.frame.sparsity_in(i) for i in range(len(self.inputs))]
        given = [one.reshape(self.length, -1) for one in self.inputs[width:]]
        for number in range(self.length):
            now = [casadi.DM(shape, one.reshape(-1)) for shape, one in zip(shapes, states, strict=False)]
            now += [casadi.DM(s, one[number]) for s, one in zip(shapes[width:], given, strict=True)]
            try:
                found = [np.asarray(one.nonzeros()) for one in self.simulation.population.frame.call(now)]
            except RuntimeError:
                return number
            for whole, one in zip(self.outputs, found, strict=True):
                whole.reshape(self.length, -1)[number] = one
            states = found[:width]
        return self.length

    def _push(self, first: int) -> None:
        """Set the impulses of the frames to come, and their numbers."""
        simulation, length = self.simulation, self.length
        members = simulation.population.members
        numbers = first + np.arange(length)
        for g, (member, forces) in enumerate(zip(members, simulation.forces, strict=True)):
            if not forces:
                continue
            program = member.program
            begin = np.array([at for at, _ in program.intervals], dtype=np.int64)
            which = np.tile(np.array([place for _, place in program.intervals], dtype=np.int64), length)
            quanta = (numbers[:, None] * simulation.frame + begin).reshape(-1)
            starts = quanta * simulation.quantum.numerator / simulation.quantum.denominator
            found = np.array([impulses(one, starts, which)[:, program.rates.g] for one in forces])
            rows = found.reshape(len(forces), length, -1).transpose(1, 0, 2)
            self.inputs[len(self.state) + g][:] = rows.reshape(-1)
        if self.arrivals is not None:
            first_route = len(self.state) + len(members)
            for place, rows in enumerate(self.arrivals.take(length), first_route):
                self.inputs[place][:] = rows
        self.inputs[-1][:] = numbers

    def _instants(self, first: int, last: int) -> tuple[Integers, NDArray[np.bool_]]:
        """Return every row's instant in quanta, and which rows are kept."""
        simulation = self.simulation
        marks = np.array(simulation.marks, dtype=np.int64)
        is_tick = np.array([mark in simulation.ticks for mark in simulation.marks])
        instants = ((first + np.arange(self.length))[:, None] * simulation.frame + marks).reshape(-1)
        kept = (np.tile(is_tick, self.length) | (instants == 0)) & (instants <= last)
        return instants, kept

    def _values(self) -> Floats:
        """Return the rows of all signals side by side, in their order."""
        simulation, length = self.simulation, self.length
        height = length * len(simulation.marks)
        values = np.empty((height, len(simulation.signals)))
        first = np.cumsum([0] + [int(choice.wanted.sum()) for choice in simulation.choices])
        starts = np.cumsum([0] + [group.count for group in simulation.system.groups])
        for g, member in enumerate(simulation.population.members):
            recorded = member.program.recorded
            if not recorded:
                continue
            flat = self.outputs[len(self.state) + g]
            rows = flat.reshape(length, member.count, len(simulation.marks), len(recorded))
            side = rows.transpose(0, 2, 1, 3).reshape(height, -1)
            wanted = simulation.choices[member.group].wanted
            own = member.peers - starts[member.group]
            column = first[member.group] + np.cumsum(wanted).reshape(wanted.shape) - 1
            values[:, column[own][wanted[own]]] = side[:, wanted[own].reshape(-1)]
        return values

    def _in_range(self) -> bool:
        """Say whether all that moves, recorded or not, is still a number; the work done may not be."""
        for g, one in enumerate(self.state):
            if g < len(self.simulation.population.members):
                layout = self.simulation.population.members[g].program.layout
                one = np.delete(one, layout.work, axis=1) if layout.parts else one
            if not np.isfinite(one).all():
                return False
        return True

    def _work(self, frame: int) -> Floats:
        """Return the work of each part, over all peers, until a frame of this chunk begins."""
        simulation = self.simulation
        total = np.zeros(len(simulation.parts))
        for g, member in enumerate(simulation.population.members):
            layout = member.program.layout
            if not layout.parts:
                continue
            carry = self.state[g]
            if frame:
                carry = self.outputs[g].reshape(self.length, *carry.shape)[frame - 1]
            for part, done in zip(layout.parts, carry[:, layout.work].sum(axis=0), strict=True):
                total[simulation.parts.index(part)] += done
        return total
