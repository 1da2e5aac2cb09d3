"""All peers' frames one by one: CasADi's virtual machine moves the peers, NumPy what they hear.

Takes: a `HeterogeneousGroup`, the packets of its unreliable links.
Gives: `InterpretedEngine`.
Guarantees: any kernel can be played, solvers too; a frame that can't be is told, and those before are kept.
Does not: run fast: where there is a compiler and every kernel is straight code, see `machine`.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.network.timetable import DeliveredPackets
from apc.simulation.hearing import (
    Arrived,
    CompleteGraphSum,
    Deliver,
    Operation,
    PairwiseReduction,
    Source,
    WeightedSum,
)
from apc.simulation.population import DeliverySource, FrameRows, Population, PopulationState
from apc.simulation.program import GroupProgram, Segment, seconds_at

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

JOINS = {"max": np.fmax, "min": np.fmin}


class InterpretedEngine(PopulationState):
    """What moves all peers in their memory, one run at a time."""

    def __init__(
        self,
        population: Population,
        timetable: Callable[[int], DeliverySource] | None,
        moving: Sequence[int] | None = None,
    ) -> None:
        """Make it ready.

        Parameters
        ----------
        population, timetable
            As of `PopulationState`.
        moving
            The members that are moved, all if not given: those who play the others bring their packets.
        """
        super().__init__(population, timetable)
        self.moving = tuple(range(len(population.members)) if moving is None else moving)
        self.segments = [[_Moving(m, segment) for segment in m.program.segments] for m in population.members]
        # Of each member the rows of its carry that are the work done, and which parts these are.
        layouts = [m.program.layout for m in population.members]
        self.work = [
            (layout.work, np.array([population.parts.index(part) for part in layout.parts], np.int64))
            for layout in layouts
        ]

    def play(self, first: int, count: int, pushes: Sequence[Floats | None]) -> FrameRows:
        """Play the frames from number `first` on (see `FrameEngine`)."""
        population, marks = self.population, self.population.marks
        rows = np.full((count * marks, population.width), np.nan)
        work = np.zeros((count, len(population.parts)))
        routes = population.hearing.routes
        taken = self.seen_until(first + count)
        # Where a solver gives up CasADi prints its arguments, and then the ones that it was called from.
        with contextlib.redirect_stderr(io.StringIO()), np.errstate(all="ignore"):
            for n in range(count):
                for carry, (done, places) in zip(self.carries, self.work, strict=True):
                    np.add.at(work[n], places, np.add.reduce(carry[done], axis=1))
                now = [None if push is None else push[n] for push in pushes]
                of_frame = rows[n * marks : (n + 1) * marks]
                ticks = [slice(n * route.ticks, (n + 1) * route.ticks) for route in routes if taken]
                seen = tuple(
                    DeliveredPackets(packets.packets[at], packets.missing[at])
                    for packets, at in zip(taken, ticks, strict=True)
                )
                try:
                    for index in range(len(population.hearing.segments)):
                        self._segment(first + n, index, seen, of_frame, now)
                except RuntimeError:
                    return FrameRows(rows, work, n)
        return FrameRows(rows, work, count)

    def _segment(
        self,
        number: int,
        index: int,
        seen: tuple[DeliveredPackets, ...],
        rows: Floats,
        pushes: Sequence[Floats | None],
    ) -> None:
        """Play a segment of a frame."""
        population, hearing = self.population, self.population.hearing
        packets = self.packets[number % hearing.ring]
        heard = [
            np.empty((moving[index].heard, member.count))
            for moving, member in zip(self.segments, population.members, strict=True)
        ]
        for operation in hearing.segments[index]:
            if isinstance(operation, Deliver) or operation.member in self.moving:
                self._hear(operation, number, heard, seen)
        for g in self.moving:
            member, moving, push = population.members[g], self.segments[g][index], pushes[g]
            segment, recorded = member.program.segments[index], len(member.program.recorded)
            impulses = np.empty((0, member.count))
            if push is not None:
                impulses = push[segment.first_impulse :][: moving.impulses, member.rows]
            self.carries[g][:], sent, signals = moving.move(self.carries[g], heard[g], impulses, number)
            columns = slice(int(hearing.first[g]), int(hearing.first[g + 1]))
            for row, values in zip(segment.sent, sent, strict=True):
                packets[hearing.sent[g][row], columns] = values
            if recorded:
                height, first = len(signals) // recorded, segment.first_mark
                to = slice(population.columns[g], population.columns[g] + recorded * member.count)
                rows[first : first + height, to] = signals.reshape(height, to.stop - to.start)

    def _row(self, source: Source, number: int) -> Floats:
        """Return what an operation reads in a frame, a number a peer or a way."""
        if isinstance(source, Arrived):
            return np.asarray(self.held[source.route][source.row])
        return np.asarray(self.packets[(number - source.lag) % self.population.hearing.ring, source.key])

    def _hear(
        self, operation: Operation, number: int, heard: Sequence[Floats], seen: tuple[DeliveredPackets, ...]
    ) -> None:
        match operation:
            case CompleteGraphSum(g, place, packet, ranges, own, divisor):
                row, first = self._row(packet, number), self.population.hearing.first
                total = sum(np.add.reduce(row[begin:end]) for begin, end in ranges)
                heard[g][place] = (total - (row[first[g] : first[g + 1]] if own else 0.0)) / divisor
            case WeightedSum(g, place, source, weights):
                heard[g][place] = weights @ self._row(source, number)
            case Deliver(route, tick):
                self._deliver(route, *self._sees(route, tick, seen))
            case PairwiseReduction():
                self._look(operation, number, heard[operation.member][operation.row])

    def _sees(self, place: int, tick: int, seen: tuple[DeliveredPackets, ...]) -> tuple[Integers, Flags]:
        """Return the packets that a tick sees on a route, and which are missing."""
        return seen[place].packets[tick], seen[place].missing[tick]

    def _deliver(self, place: int, packets: Integers, missing: Flags) -> None:
        """Bring in effect what a tick sees on a route."""
        hearing, route, held = (
            self.population.hearing,
            self.population.hearing.routes[place],
            self.held[place],
        )
        new = np.flatnonzero(packets != self.effective[place])
        self.effective[place] = packets
        numbers = packets[new]
        keys = hearing.channels[place][:, numbers % route.slots]
        columns = hearing.column_of[route.pairs[new, 0]]
        held[:-1, new] = self.packets[numbers // route.slots % hearing.ring, keys, columns]
        if route.zero:
            held[:-1, missing], held[-1] = 0.0, missing

    def _look(self, look: PairwiseReduction, number: int, result: Floats) -> None:
        """Join what a member makes of each pair to `result` (peers,)."""
        member, count = self.population.members[look.member], len(look.senders)
        joined = JOINS.get(look.operator)
        if look.first:
            result[:] = 0.0 if joined is None else np.nan
        if not count:
            return
        sent = np.array([self._row(source, number)[look.senders] for source in look.sources])
        missing = self._row(look.missing, number)[look.senders] if look.missing else np.zeros(count)
        own = np.concatenate([
            self.carries[look.member][list(look.pairwise.carry)],
            member.each(member.constants[:, list(look.pairwise.constants)]).T,
        ])  # fmt: skip
        function: Any = self.population.hearing.functions[look.function]
        t = seconds_at(member.program.schedule, float(number), look.pairwise.now)
        pairs = function.map(count)(own[:, look.receivers], sent.reshape(-1, count), missing[None], t)
        values = np.asarray(pairs)[0]
        if joined is None:
            np.add.at(result, look.receivers, look.weights * values)
        else:
            joined.at(result, look.receivers, values)


class _Moving:
    """A segment of a member's program, mapped over its peers, with the memory that CasADi works in."""

    def __init__(self, member: GroupProgram, segment: Segment) -> None:
        kernel, count = segment.kernel, member.count
        self.impulses = kernel.numel_in("impulses")
        self.heard = len(segment.heard) + len(segment.pairs)
        self._function = kernel.map(count)  # the buffer looks at it
        self._buffer, self._call = self._function.buffer()
        self._in = [np.zeros(self._function.size_in(i), order="F") for i in range(5)]
        self._out = [np.zeros(self._function.size_out(i), order="F") for i in range(3)]
        for give, arrays in ((self._buffer.set_arg, self._in), (self._buffer.set_res, self._out)):
            for i, array in enumerate(arrays):
                give(i, memoryview(array.reshape(-1, order="F").data))
        self._in[2][:] = member.each(member.constants).T

    def move(
        self, carry: Floats, heard: Floats, impulses: Floats, number: int
    ) -> tuple[Floats, Floats, Floats]:
        """Return the carry after the segment, what is sent, and the rows: a column a peer."""
        self._in[0][:], self._in[1][:], self._in[3][:], self._in[4][:] = carry, heard, impulses, number
        self._call()
        if self._buffer.ret():
            raise RuntimeError("a solver gave up")
        after, sent, rows = self._out
        return after, sent, rows
