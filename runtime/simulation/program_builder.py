"""Builds a subsystem's frame program: the schedule's events with the functions of the peer type.

Takes: a peer type's `Rates`, its `Flow` if any, its `Schedule`, the signals to record.
Gives: `build_program`.
Guarantees: tick functions are evaluated themselves, not linearized. A value takes effect and is received
exactly at its scheduled time. A value not yet computed is zero.
Does not: handle other peers: received and sent values are inputs and outputs (see `population`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi
import numpy as np

from apc.compiler.compiled import PeerType
from apc.linearization.jacobians import edge_name
from apc.simulation.flow import Flow
from apc.simulation.pairwise import Pairwise, pair_function
from apc.simulation.program import Layout, Program, Segment, seconds_at, timed_events
from apc.simulation.propagate import Rates
from apc.simulation.signals import LocalSignal, ticking_partitions
from apc.timing.schedule import (
    ClockedValue,
    Event,
    HoldUpdate,
    Propagate,
    Schedule,
    SendEvent,
    Tick,
    UncertainSample,
    discrete_states_of,
    shifted,
)

Timed = Sequence[tuple[int, Event]]  # events, each with its instant in quanta


def build_program(
    rates: Rates,
    schedule: Schedule,
    recorded: Sequence[LocalSignal],
    cuts: Sequence[int],
    flow: Flow | None = None,
) -> Program:
    """Return the frame program of a subsystem: one compiled function per segment of the frame.

    Parameters
    ----------
    rates
        The peer type's continuous equations.
    schedule
        The schedule of a frame.
    recorded
        The signals to record at every sample time of the schedule.
    cuts
        The ends of segments in quanta: instants at which packets are exchanged within the frame, and
        instants of pairwise reductions.
    flow
        The integrator of the states without exact transition.
    """
    segments = _split_events(timed_events(schedule), cuts)
    writer = _SegmentWriter(rates, schedule, recorded, flow, segments)
    return Program(
        peer_type=rates.peer_type,
        schedule=schedule,
        rates=rates,
        layout=writer.layout,
        segments=tuple(writer.segment(events, last=events is segments[-1]) for events in segments),
        recorded=tuple(recorded),
        durations=writer.durations,
        intervals=tuple(writer.intervals),
        moves=tuple(writer.moves),
    )


def _split_events(events: Timed, cuts: Sequence[int]) -> list[Timed]:
    """Return the events of each segment of the frame."""
    # The sends of an instant precede its other events in every group, except those after its ticks.
    ends = [
        sum(
            now < cut or (now == cut and isinstance(event, SendEvent) and not event.after)
            for now, event in events
        )
        for cut in sorted(cuts)
    ]
    return [events[begin:end] for begin, end in zip([0, *ends], [*ends, len(events)], strict=True)]


def _layout(
    peer_type: PeerType, schedule: Schedule, segments: Sequence[Timed], recorded: Sequence[LocalSignal]
) -> Layout:
    """Return the rows of the carry, the stored values between segments; all segments have the same rows."""
    recorded_outputs = {signal.index for signal in recorded if signal.role == "output"}
    from_earlier_frame = discrete_states_of(
        [event.value for event in schedule.events if isinstance(event, HoldUpdate)], schedule.ticks
    )
    stored_values = set(from_earlier_frame)  # and values that are computed in one segment and used in another
    for events in segments:
        needed = {event.value for _, event in events if isinstance(event, HoldUpdate)}
        if events is segments[-1]:
            needed |= {shifted(value, schedule.ticks) for value in from_earlier_frame}
        computed = {(event.partition, event.index) for _, event in events if isinstance(event, Tick)}
        stored_values |= {
            value for value in needed if value.index >= 0 and (value.partition, value.index) not in computed
        }
    return Layout(
        states=len(peer_type.states),
        outputs=tuple(
            (p, o)
            for p in ticking_partitions(schedule)
            for o in range(len(peer_type.clocks[p].outputs))
            if o in peer_type.clocks[p].memories or (p, o) in recorded_outputs
        ),
        holds=len(peer_type.holds),
        later_values=tuple(sorted(stored_values)),
        parts=tuple(dict.fromkeys(peer_type.ports.parts)) if peer_type.ports else (),
    )


class _SegmentWriter:
    """Builds the functions of the segments in order; the carry at the end of one is the input of the next."""

    def __init__(
        self,
        rates: Rates,
        schedule: Schedule,
        recorded: Sequence[LocalSignal],
        flow: Flow | None,
        segments: Sequence[Timed],
    ) -> None:
        self.rates, self.schedule, self.recorded, self.flow = rates, schedule, recorded, flow
        self.peer_type = peer_type = rates.peer_type
        lengths = {event.duration for event in schedule.events if isinstance(event, Propagate)}
        self.durations = tuple(sorted(lengths))
        self.moves = [flow.over(length * schedule.quantum) for length in self.durations] if flow else []
        functions = [
            peer_type.derivative,
            *(clock.tick for clock in peer_type.clocks),
            *(send.send for send in peer_type.sends),
        ]
        functions += [*self.moves, *([peer_type.ports.port] if peer_type.ports else [])]
        plain = all(function.is_a("SXFunction") for function in functions)
        self.type_: Any = casadi.SX if plain else casadi.MX
        self.intervals: list[tuple[int, int]] = []
        self.layout = _layout(peer_type, schedule, segments, recorded)
        self.begun = -1  # the instant of the previous event
        self.sample_times = self.impulses = 0  # written so far

    def segment(self, events: Timed, *, last: bool) -> Segment:
        """Return the function of a segment's events, with its received, sent and recorded rows."""
        type_, layout, peer_type = self.type_, self.layout, self.peer_type
        pairs = {
            key: pair
            for now, event in events
            if isinstance(event, Tick)
            for key, pair in self._pairs(now, event).items()
        }
        assert all(pair.now == events[0][0] for pair in pairs.values()), "peers look before anything happens"
        received = {
            row for _, event in events if isinstance(event, Tick) for rows in event.input_rows for row in rows
        }
        received_rows = sorted(received - {row for pair in pairs.values() for row in pair.received})
        propagations = sum(isinstance(event, Propagate) for _, event in events)
        sizes = {
            "carry": layout.ends[-1],
            "received": len(received_rows) + len(pairs),
            "constants": len(peer_type.parameters) + int(self.rates.pattern.sum()) * len(self.durations),
            "impulses": len(self.rates.forced) * propagations if self.rates.timed else 0,
            "frame": 1,
        }
        arguments = {name: type_.sym(name, size) for name, size in sizes.items()}
        self.x, newest, self.u, later, self.work = casadi.vertsplit(arguments["carry"], layout.ends)
        self.newest = dict(zip(layout.outputs, casadi.vertsplit(newest), strict=True))
        self.values = dict(zip(layout.later_values, casadi.vertsplit(later), strict=True))
        self.received = dict(
            zip([*received_rows, *pairs], casadi.vertsplit(arguments["received"]), strict=True)
        )
        self.constants, self.frame = arguments["constants"], arguments["frame"]
        self.pushes = iter(casadi.vertsplit(arguments["impulses"]))
        self.sent: dict[int, Any] = {}
        rows: list[Any] = []
        for now, event in events:
            first, self.begun = now > self.begun, now
            if (
                first and now in self.schedule.sample_times
            ):  # the first event at an instant, which is then over
                rows += [self._signal(signal, now) for signal in self.recorded]
            self._apply_event(now, event)
        later_values = [
            self.values[shifted(value, self.schedule.ticks) if last and value.index < 0 else value]
            for value in layout.later_values
        ]
        newest = [self.newest[key] for key in layout.outputs]
        carry_after = (self.x, *newest, self.u, *later_values, self.work)
        kernel = casadi.Function(
            "segment",
            list(arguments.values()),
            [
                _column(type_, carry_after),
                _column(type_, [self.sent[row] for row in sorted(self.sent)]),
                _column(type_, rows),
            ],
            list(arguments),
            ["carry_after", "sent", "rows"],
        )
        first_rows = self.sample_times, self.impulses
        self.sample_times += len(rows) // max(len(self.recorded), 1)
        self.impulses += sizes["impulses"]
        return Segment(
            kernel, tuple(received_rows), tuple(pairs.values()), tuple(sorted(self.sent)), *first_rows
        )

    def _pairs(self, now: int, tick: Tick) -> dict[Any, Pairwise]:
        """Return the pairwise functions of a tick by (tick, receive), with the rows of the carry that
        they read.
        """
        partition, pairs, layout = self.peer_type.clocks[tick.partition], {}, self.layout
        x, outputs, u, *_ = (range(*ends) for ends in zip(layout.ends, layout.ends[1:], strict=False))
        memories = [outputs[layout.outputs.index((tick.partition, o))] for o in partition.memories]
        available_rows = [*x, *u, *memories]
        for index, (receive, rows) in enumerate(zip(partition.receives, tick.input_rows, strict=True)):
            if rows and edge_name(partition, receive):
                function, used_rows = pair_function(self.peer_type, tick.partition, index)
                carry = tuple(available_rows[row] for row in used_rows if row < len(available_rows))
                constants = tuple(
                    row - len(available_rows) for row in used_rows if row >= len(available_rows)
                )
                pairs[tick, index] = Pairwise(function, carry, constants, rows, now)
        return pairs

    def _parameter_values(self) -> Any:
        """Return the parameters p, the first rows of the constants."""
        return self.constants[: len(self.peer_type.parameters)]

    def _evaluate(self, function: Any, now: int) -> Any:
        """Return the value of a function (x, u, p, t) at an instant of the frame."""
        return function(self.x, self.u, self._parameter_values(), self._seconds(now))

    def _seconds(self, now: int) -> Any:
        """Return the time in seconds of an instant of the frame."""
        return seconds_at(self.schedule, self.frame, now)

    def _signal(self, signal: LocalSignal, now: int) -> Any:
        """Return the value of a recorded signal at an instant of the frame."""
        match signal.role:
            case "state":
                return self.x[signal.index[0]]
            case "output":
                return self.newest[signal.index[0], signal.index[1]]
            case "limited":
                return self._evaluate(self.peer_type.limits[signal.index[0]].value, now)
            case _:
                return self.u[signal.index[0]]

    def _apply_event(self, now: int, event: Event) -> None:
        """Apply one event of the schedule to the symbolic values of the subsystem."""
        match event:
            case Propagate(duration):
                self._propagate(now, self.durations.index(duration))
            case HoldUpdate(hold, value):
                # Values not yet computed are zero: the initial carry.
                u = casadi.vertsplit(self.u)
                u[hold] = self.values[value]
                self.u = _column(self.type_, u)
            case SendEvent(partition, rows, _):
                channels = self._evaluate(self.peer_type.sends[partition].send, now)
                self.sent |= {row: channels[channel] for channel, row in rows}
            case Tick(partition, index, received):
                clock_partition = self.peer_type.clocks[partition]
                m = _column(self.type_, [self.newest[partition, o] for o in clock_partition.memories])
                input_rows = [
                    self.received[event, position]
                    if (event, position) in self.received
                    else self._received_sum(now, rows)
                    for position, rows in enumerate(received)
                ]
                r = _column(self.type_, input_rows)
                outputs = clock_partition.tick(
                    self.x, self.u, m, r, self._parameter_values(), self._seconds(now)
                )
                for o in range(len(clock_partition.outputs)):
                    self.newest[partition, o] = self.values[ClockedValue(partition, o, index)] = outputs[o]

    def _received_sum(self, now: int, rows: Sequence[int]) -> Any:
        """Return the sum of received rows.

        The row of missing packets is weighted by the subsystem's own packet.
        """
        total = self.type_(0)
        for row in rows:
            received = self.schedule.all_received[row]
            weight: Any = 1
            if isinstance(received, UncertainSample) and received.gap:
                # A subsystem's own packet of this moment is the substitute for missing ones.
                sending = next(
                    send for send in self.peer_type.sends if send.link == received.coupling_term.link
                )
                weight = self._evaluate(sending.send, now)[sending.channels.index(received.channel)]
            total = total + weight * self.received[row]
        return total

    def _propagate(self, now: int, index: int) -> None:
        """Propagate x over one interval, and add the work of the held forces to the parts' work."""
        pattern, ports = self.rates.pattern, self.peer_type.ports
        size, before = int(pattern.sum()), self.x
        begin = len(self.peer_type.parameters) + index * size
        columns, rows = np.nonzero(pattern.T)
        shape = pattern.shape[0], pattern.shape[1]
        sparsity = casadi.Sparsity.triplet(*shape, rows.tolist(), columns.tolist())
        step = self.type_(sparsity, self.constants[begin : begin + size])
        after = casadi.vertsplit(casadi.densify(step @ casadi.vertcat(before, self.u, 1)))
        for row in self.rates.forced if self.rates.timed else ():
            after[row] = after[row] + next(self.pushes)
        if self.flow is not None:
            integrated = before[list(self.flow.rows)]
            integrated_after = self.moves[index](
                integrated, self.u, self._parameter_values(), self._seconds(now)
            )
            for i, row in enumerate(self.flow.rows):
                after[row] = integrated_after[i]
        self.intervals.append((now, index))
        port_before: Any = self._evaluate(ports.port, now) if ports else None
        self.x = _column(self.type_, after)
        if ports:
            n, port_after = len(ports.parts), self._evaluate(ports.port, now)
            work = casadi.vertsplit(self.work)
            for i, part in enumerate(ports.parts):
                row_of_part = self.layout.parts.index(part)
                work[row_of_part] = work[row_of_part] - port_before[n + i] * (port_after[i] - port_before[i])
            self.work = _column(self.type_, work)


def _column(type_: Any, values: Sequence[Any]) -> Any:
    """Return values as one dense column vector."""
    return casadi.densify(casadi.vertcat(type_(0, 1), *values))
