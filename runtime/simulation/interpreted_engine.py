"""The interpreted engine: CasADi's virtual machine evaluates the peers, NumPy exchanges packets.

Takes: a `Population`, the packets of its unreliable links.
Gives: `InterpretedEngine`.
Guarantees: every kernel can be executed, including solvers. A frame that fails is reported, and earlier ones
are kept.
Does not: run fast; with a C compiler and kernels without solvers, see `compiled_engine`.
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
    """An engine that simulates all peers by CasADi's virtual machine, with their stored values."""

    def __init__(
        self,
        population: Population,
        timetable: Callable[[int], DeliverySource] | None,
        moving: Sequence[int] | None = None,
    ) -> None:
        """Set up the memory of every segment.

        Parameters
        ----------
        population, timetable
            As for `PopulationState`.
        moving
            The indices of the members to simulate, by default all; other processes provide the packets of
            the others.
        """
        super().__init__(population, timetable)
        self.moving = tuple(range(len(population.members)) if moving is None else moving)
        self.segments = [
            [_SegmentRunner(m, segment) for segment in m.program.segments] for m in population.members
        ]
        # For each member, the rows of its carry with the work, and the indices of the parts.
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
        # CasADi prints the arguments of a failed solver and of its callers.
        with contextlib.redirect_stderr(io.StringIO()), np.errstate(all="ignore"):
            for n in range(count):
                for carry, (work_rows, indices) in zip(self.carries, self.work, strict=True):
                    np.add.at(work[n], indices, np.add.reduce(carry[work_rows], axis=1))
                pushes_of_frame = [None if push is None else push[n] for push in pushes]
                frame_rows = rows[n * sample_times : (n + 1) * sample_times]
                ticks = [slice(n * route.ticks, (n + 1) * route.ticks) for route in routes if used]
                in_effect = tuple(
                    DeliveredPackets(packets.packets[slice_of_route], packets.missing[slice_of_route])
                    for packets, slice_of_route in zip(used, ticks, strict=True)
                )
                try:
                    for index in range(len(population.exchange_program.segments)):
                        self._segment(first + n, index, in_effect, frame_rows, pushes_of_frame)
                except RuntimeError:
                    return FrameRows(rows, work, n)
        return FrameRows(rows, work, count)

    def _segment(
        self,
        number: int,
        index: int,
        in_effect: tuple[DeliveredPackets, ...],
        rows: Floats,
        pushes: Sequence[Floats | None],
    ) -> None:
        """Simulate one segment of a frame: its packet exchange, then the program of each member."""
        population, exchange_program = self.population, self.population.exchange_program
        packets = self.packets[number % exchange_program.ring]
        received = [
            np.empty((runner[index].received, member.count))
            for runner, member in zip(self.segments, population.members, strict=True)
        ]
        for operation in exchange_program.segments[index]:
            if isinstance(operation, Deliver) or operation.member in self.moving:
                self._execute(operation, number, received, in_effect)
        for index_of_member in self.moving:
            member, runner, push = (
                population.members[index_of_member],
                self.segments[index_of_member][index],
                pushes[index_of_member],
            )
            segment, recorded = member.program.segments[index], len(member.program.recorded)
            impulses = np.empty((0, member.count))
            if push is not None:
                impulses = push[segment.first_impulse :][: runner.impulses, member.rows]
            self.carries[index_of_member][:], sent, signals = runner.move(
                self.carries[index_of_member], received[index_of_member], impulses, number
            )
            columns = slice(
                int(exchange_program.first[index_of_member]), int(exchange_program.first[index_of_member + 1])
            )
            for row, values in zip(segment.sent, sent, strict=True):
                packets[exchange_program.sent[index_of_member][row], columns] = values
            if recorded:
                row_count, first = len(signals) // recorded, segment.first_mark
                target = slice(
                    population.columns[index_of_member],
                    population.columns[index_of_member] + recorded * member.count,
                )
                rows[first : first + row_count, target] = signals.reshape(
                    row_count, target.stop - target.start
                )

    def _source_values(self, source: Source, frame_number: int) -> Floats:
        """Return the values of a source in a frame, one per peer or directed link.

        They are the held values of a route, or those sent `source.lag` frames before.
        """
        if isinstance(source, Arrived):
            return np.asarray(self.held[source.route][source.row])
        return np.asarray(
            self.packets[(frame_number - source.lag) % self.population.exchange_program.ring, source.key]
        )

    def _execute(
        self,
        operation: Operation,
        number: int,
        received: Sequence[Floats],
        observed: tuple[DeliveredPackets, ...],
    ) -> None:
        """Execute one operation of the packet exchange, writing the received values of a member."""
        match operation:
            case CompleteGraphSum(g, index, packet, ranges, local, divisor):
                row, first = self._source_values(packet, number), self.population.exchange_program.first
                total = sum(np.add.reduce(row[begin:end]) for begin, end in ranges)
                received[g][index] = (total - (row[first[g] : first[g + 1]] if local else 0.0)) / divisor
            case WeightedSum(g, index, source, weights):
                received[g][index] = weights @ self._source_values(source, number)
            case Deliver(route, tick):
                self._deliver(route, *self._packets_at_tick(route, tick, observed))
            case PairwiseReduction():
                self._reduce_pairs(operation, number, received[operation.member][operation.row])

    def _packets_at_tick(
        self, index: int, tick: int, observed: tuple[DeliveredPackets, ...]
    ) -> tuple[Integers, Flags]:
        """Return the numbers of the packets in effect on a route at a tick, and flags of missing packets."""
        return observed[index].packets[tick], observed[index].missing[tick]

    def _deliver(self, index: int, packet_numbers: Integers, missing: Flags) -> None:
        """Copy the values of newly arrived packets into the held values of a route.

        Parameters
        ----------
        index
            The index of the route.
        packet_numbers
            For each directed link the packet in effect: its frame times the slots of the route, plus its
            slot.
        missing
            The mask of directed links without a packet. Where the route sets lost values to zero, their held
            values become 0 and the last row of `held` has the mask.
        """
        exchange_program, route, held = (
            self.population.exchange_program,
            self.population.exchange_program.routes[index],
            self.held[index],
        )
        new = np.flatnonzero(packet_numbers != self.effective[index])
        self.effective[index] = packet_numbers
        frames, slots = np.divmod(packet_numbers[new], route.slots)
        keys = exchange_program.channels[index][:, slots]
        columns = exchange_program.column_of[route.pairs[new, 0]]
        held[:-1, new] = self.packets[frames % exchange_program.ring, keys, columns]
        if route.zero:
            held[:-1, missing], held[-1] = 0.0, missing

    def _reduce_pairs(self, reduction: PairwiseReduction, number: int, result: Floats) -> None:
        """Write a member's pairwise reduction into `result` (peers,)."""
        member, count = self.population.members[reduction.member], len(reduction.senders)
        reduce = JOINS.get(reduction.operator)
        if reduction.first:
            result[:] = 0.0 if reduce is None else np.nan
        if not count:
            return
        sent = np.array(
            [self._source_values(source, number)[reduction.senders] for source in reduction.sources]
        )
        missing = (
            self._source_values(reduction.missing, number)[reduction.senders]
            if reduction.missing
            else np.zeros(count)
        )
        own_values = np.concatenate([
            self.carries[reduction.member][list(reduction.pairwise.carry)],
            member.each(member.constants[:, list(reduction.pairwise.constants)]).T,
        ])  # fmt: skip
        function: Any = self.population.exchange_program.functions[reduction.function]
        t = seconds_at(member.program.schedule, float(number), reduction.pairwise.now)
        pairs = function.map(count)(
            own_values[:, reduction.receivers], sent.reshape(-1, count), missing[None], t
        )
        values = np.asarray(pairs)[0]
        if reduce is None:
            np.add.at(result, reduction.receivers, reduction.weights * values)
        else:
            reduce.at(result, reduction.receivers, values)


class _SegmentRunner:
    """A segment of a member's program, mapped over its peers, with CasADi's working memory."""

    def __init__(self, member: GroupProgram, segment: Segment) -> None:
        kernel, count = segment.kernel, member.count
        self.impulses = kernel.numel_in("impulses")
        self.received = len(segment.received) + len(segment.pairs)
        self._function = kernel.map(count)  # referenced here, as the buffer reads it
        self._buffer, self._call = self._function.buffer()
        self._in = [np.zeros(self._function.size_in(i), order="F") for i in range(5)]
        self._out = [np.zeros(self._function.size_out(i), order="F") for i in range(3)]
        for set_buffer, arrays in ((self._buffer.set_arg, self._in), (self._buffer.set_res, self._out)):
            for i, array in enumerate(arrays):
                set_buffer(i, memoryview(array.reshape(-1, order="F").data))
        self._in[2][:] = member.each(member.constants).T

    def move(
        self, carry: Floats, received: Floats, impulses: Floats, number: int
    ) -> tuple[Floats, Floats, Floats]:
        """Return the carry after the segment, the sent values, and the recorded rows: one column per peer."""
        self._in[0][:], self._in[1][:], self._in[3][:], self._in[4][:] = carry, received, impulses, number
        self._call()
        if self._buffer.ret():
            raise RuntimeError("a solver gave up")
        after, sent, rows = self._out
        return after, sent, rows
