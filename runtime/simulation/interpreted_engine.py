"""The interpreted engine: CasADi's virtual machine integrates the peers, NumPy exchanges packets.

Takes: a `HeterogeneousGroup`, the packets of its unreliable links.
Gives: `InterpretedEngine`.
Guarantees: every kernel can be executed, including solvers. A frame that fails is reported, and earlier ones
are kept.
Does not: run fast: with a compiler and kernels without solvers, see `compiled_engine`.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.network.packet_schedule import DeliveredPackets
from apc.simulation.exchange_program import (
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
    """The integrators of all peers with their memory, for one run at a time."""

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

    def advance(self, first: int, count: int, pushes: Sequence[Floats | None]) -> FrameRows:
        """Simulate the frames from number `first` on (see `population.FrameEngine`)."""
        population, sample_times = self.population, self.population.sample_count
        rows = np.full((count * sample_times, population.width), np.nan)
        work = np.zeros((count, len(population.parts)))
        routes = population.exchange_program.routes
        used = self.delivered_until(first + count)
        # Where a solver gives up CasADi prints its arguments, and then the ones that it was called from.
        with contextlib.redirect_stderr(io.StringIO()), np.errstate(all="ignore"):
            for n in range(count):
                for carry, (done, indices) in zip(self.carries, self.work, strict=True):
                    np.add.at(work[n], indices, np.add.reduce(carry[done], axis=1))
                now = [None if push is None else push[n] for push in pushes]
                of_frame = rows[n * sample_times : (n + 1) * sample_times]
                ticks = [slice(n * route.ticks, (n + 1) * route.ticks) for route in routes if used]
                observed = tuple(
                    DeliveredPackets(packets.packets[at], packets.missing[at])
                    for packets, at in zip(used, ticks, strict=True)
                )
                try:
                    for index in range(len(population.exchange_program.segments)):
                        self._segment(first + n, index, observed, of_frame, now)
                except RuntimeError:
                    return FrameRows(rows, work, n)
        return FrameRows(rows, work, count)

    def _segment(
        self,
        number: int,
        index: int,
        observed: tuple[DeliveredPackets, ...],
        rows: Floats,
        pushes: Sequence[Floats | None],
    ) -> None:
        """Simulate a segment of a frame."""
        population, exchange_program = self.population, self.population.exchange_program
        packets = self.packets[number % exchange_program.ring]
        received = [
            np.empty((moving[index].received, member.count))
            for moving, member in zip(self.segments, population.members, strict=True)
        ]
        for operation in exchange_program.segments[index]:
            if isinstance(operation, Deliver) or operation.member in self.moving:
                self._receive(operation, number, received, observed)
        for g in self.moving:
            member, moving, push = population.members[g], self.segments[g][index], pushes[g]
            segment, recorded = member.program.segments[index], len(member.program.recorded)
            impulses = np.empty((0, member.count))
            if push is not None:
                impulses = push[segment.first_impulse :][: moving.impulses, member.rows]
            self.carries[g][:], sent, signals = moving.move(self.carries[g], received[g], impulses, number)
            columns = slice(int(exchange_program.first[g]), int(exchange_program.first[g + 1]))
            for row, values in zip(segment.sent, sent, strict=True):
                packets[exchange_program.sent[g][row], columns] = values
            if recorded:
                height, first = len(signals) // recorded, segment.first_mark
                to = slice(population.columns[g], population.columns[g] + recorded * member.count)
                rows[first : first + height, to] = signals.reshape(height, to.stop - to.start)

    def _row(self, source: Source, number: int) -> Floats:
        """Return the operands of an operation in a frame, one number per peer or directed link."""
        if isinstance(source, Arrived):
            return np.asarray(self.held[source.route][source.row])
        return np.asarray(
            self.packets[(number - source.lag) % self.population.exchange_program.ring, source.key]
        )

    def _receive(
        self,
        operation: Operation,
        number: int,
        received: Sequence[Floats],
        observed: tuple[DeliveredPackets, ...],
    ) -> None:
        match operation:
            case CompleteGraphSum(g, index, packet, ranges, local, divisor):
                row, first = self._row(packet, number), self.population.exchange_program.first
                total = sum(np.add.reduce(row[begin:end]) for begin, end in ranges)
                received[g][index] = (total - (row[first[g] : first[g + 1]] if local else 0.0)) / divisor
            case WeightedSum(g, index, source, weights):
                received[g][index] = weights @ self._row(source, number)
            case Deliver(route, tick):
                self._deliver(route, *self._sees(route, tick, observed))
            case PairwiseReduction():
                self._read(operation, number, received[operation.member][operation.row])

    def _sees(self, index: int, tick: int, observed: tuple[DeliveredPackets, ...]) -> tuple[Integers, Flags]:
        """Return the packets that a tick sees on a route, and which are missing."""
        return observed[index].packets[tick], observed[index].missing[tick]

    def _deliver(self, index: int, packets: Integers, missing: Flags) -> None:
        """Update the values in effect on a route at a tick."""
        exchange_program, route, held = (
            self.population.exchange_program,
            self.population.exchange_program.routes[index],
            self.held[index],
        )
        new = np.flatnonzero(packets != self.effective[index])
        self.effective[index] = packets
        numbers = packets[new]
        keys = exchange_program.channels[index][:, numbers % route.slots]
        columns = exchange_program.column_of[route.pairs[new, 0]]
        held[:-1, new] = self.packets[numbers // route.slots % exchange_program.ring, keys, columns]
        if route.zero:
            held[:-1, missing], held[-1] = 0.0, missing

    def _read(self, reduction: PairwiseReduction, number: int, result: Floats) -> None:
        """Combine a member's pairwise values into `result` (peers,)."""
        member, count = self.population.members[reduction.member], len(reduction.senders)
        joined = JOINS.get(reduction.operator)
        if reduction.first:
            result[:] = 0.0 if joined is None else np.nan
        if not count:
            return
        sent = np.array([self._row(source, number)[reduction.senders] for source in reduction.sources])
        missing = (
            self._row(reduction.missing, number)[reduction.senders] if reduction.missing else np.zeros(count)
        )
        local = np.concatenate([
            self.carries[reduction.member][list(reduction.pairwise.carry)],
            member.each(member.constants[:, list(reduction.pairwise.constants)]).T,
        ])  # fmt: skip
        function: Any = self.population.exchange_program.functions[reduction.function]
        t = seconds_at(member.program.schedule, float(number), reduction.pairwise.now)
        pairs = function.map(count)(local[:, reduction.receivers], sent.reshape(-1, count), missing[None], t)
        values = np.asarray(pairs)[0]
        if joined is None:
            np.add.at(result, reduction.receivers, reduction.weights * values)
        else:
            joined.at(result, reduction.receivers, values)


class _Moving:
    """A segment of a member's program, mapped over its peers, with the memory that CasADi works in."""

    def __init__(self, member: GroupProgram, segment: Segment) -> None:
        kernel, count = segment.kernel, member.count
        self.impulses = kernel.numel_in("impulses")
        self.received = len(segment.received) + len(segment.pairs)
        self._function = kernel.map(count)  # the buffer looks at it
        self._buffer, self._call = self._function.buffer()
        self._in = [np.zeros(self._function.size_in(i), order="F") for i in range(5)]
        self._out = [np.zeros(self._function.size_out(i), order="F") for i in range(3)]
        for give, arrays in ((self._buffer.set_arg, self._in), (self._buffer.set_res, self._out)):
            for i, array in enumerate(arrays):
                give(i, memoryview(array.reshape(-1, order="F").data))
        self._in[2][:] = member.each(member.constants).T

    def move(
        self, carry: Floats, received: Floats, impulses: Floats, number: int
    ) -> tuple[Floats, Floats, Floats]:
        """Return the carry after the segment, the sent values, and the rows: one column per peer."""
        self._in[0][:], self._in[1][:], self._in[3][:], self._in[4][:] = carry, received, impulses, number
        self._call()
        if self._buffer.ret():
            raise RuntimeError("a solver gave up")
        after, sent, rows = self._out
        return after, sent, rows
