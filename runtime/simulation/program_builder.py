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
from apc.frame.jacobians import edge_name
from apc.frame.schedule import (
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
from apc.simulation.flow import Flow
from apc.simulation.pairwise import Pairwise, pair_function
from apc.simulation.program import Layout, Program, Segment, seconds_at, timed_events
from apc.simulation.propagate import Rates
from apc.simulation.signals import LocalSignal, ticking_partitions

Timed = Sequence[tuple[int, Event]]  # events, each with its instant in quanta


def build_program(
    rates: Rates,
    schedule: Schedule,
    recorded: Sequence[LocalSignal],
    cuts: Sequence[int],
    flow: Flow | None = None,
) -> Program:
    """Write a subsystem's frame.

    Parameters
    ----------
    rates
        The peer type's continuous equations.
    schedule
        The schedule of a frame.
    recorded
        The signals to record at every mark of the schedule.
    cuts
        The instants, in quanta, after whose sends packets are exchanged within the frame, and those at which
        peers look at each other pair by pair.
    flow
        The integrator of the states without exact transition.
    """
    segments = _cut(timed_events(schedule), cuts)
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


def _cut(events: Timed, cuts: Sequence[int]) -> list[Timed]:
    """Return the events of each segment."""
    # Sends come first of what happens at an instant, whatever the group.
    ends = [
        sum(now < cut or (now == cut and isinstance(event, SendEvent)) for now, event in events)
        for cut in sorted(cuts)
    ]
    return [events[begin:end] for begin, end in zip([0, *ends], [*ends, len(events)], strict=True)]


def _layout(
    peer_type: PeerType, schedule: Schedule, segments: Sequence[Timed], recorded: Sequence[LocalSignal]
) -> Layout:
    """Return the rows of the carry; it is the same between any two segments."""
    observed = {signal.index for signal in recorded if signal.role == "output"}
    before = discrete_states_of(
        [event.value for event in schedule.events if isinstance(event, HoldUpdate)], schedule.ticks
    )
    passed = set(before)  # and what is computed in another segment than it is needed in
    for events in segments:
        needed = {event.value for _, event in events if isinstance(event, HoldUpdate)}
        if events is segments[-1]:
            needed |= {shifted(value, schedule.ticks) for value in before}
        computed = {(event.partition, event.index) for _, event in events if isinstance(event, Tick)}
        passed |= {
            value for value in needed if value.index >= 0 and (value.partition, value.index) not in computed
        }
    return Layout(
        states=len(peer_type.states),
        outputs=tuple(
            (p, o)
            for p in ticking_partitions(schedule)
            for o in range(len(peer_type.clocks[p].outputs))
            if o in peer_type.clocks[p].memories or (p, o) in observed
        ),
        holds=len(peer_type.holds),
        later_values=tuple(sorted(passed)),
        parts=tuple(dict.fromkeys(peer_type.ports.parts)) if peer_type.ports else (),
    )


class _SegmentWriter:
    """Writes one segment after the other; the carry at the end of one is the input of the next."""

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
        self.begun = -1  # the instant of the event before
        self.sample_times = self.impulses = 0  # written so far

    def segment(self, events: Timed, *, last: bool) -> Segment:
        """Write the events of one segment."""
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
        moved = sum(isinstance(event, Propagate) for _, event in events)
        sizes = {
            "carry": layout.ends[-1],
            "received": len(received_rows) + len(pairs),
            "constants": len(peer_type.parameters) + int(self.rates.pattern.sum()) * len(self.durations),
            "impulses": len(self.rates.forced) * moved if self.rates.timed else 0,
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
            self._step(now, event)
        passed = [
            self.values[shifted(value, self.schedule.ticks) if last and value.index < 0 else value]
            for value in layout.later_values
        ]
        newest = [self.newest[key] for key in layout.outputs]
        after = (self.x, *newest, self.u, *passed, self.work)
        kernel = casadi.Function(
            "segment",
            list(arguments.values()),
            [
                _column(type_, after),
                _column(type_, [self.sent[row] for row in sorted(self.sent)]),
                _column(type_, rows),
            ],
            list(arguments),
            ["carry_after", "sent", "rows"],
        )
        begin = self.sample_times, self.impulses
        self.sample_times += len(rows) // max(len(self.recorded), 1)
        self.impulses += sizes["impulses"]
        return Segment(kernel, tuple(received_rows), tuple(pairs.values()), tuple(sorted(self.sent)), *begin)

    def _pairs(self, now: int, tick: Tick) -> dict[Any, Pairwise]:
        """Return pairwise-reduction results by (tick, receive), from the relevant rows of x, u, m and p."""
        computing, pairs, layout = self.peer_type.clocks[tick.partition], {}, self.layout
        x, outputs, u, *_ = (range(*ends) for ends in zip(layout.ends, layout.ends[1:], strict=False))
        memories = [outputs[layout.outputs.index((tick.partition, o))] for o in computing.memories]
        inside = [*x, *u, *memories]
        for index, (receive, rows) in enumerate(zip(computing.receives, tick.input_rows, strict=True)):
            if rows and edge_name(computing, receive):
                function, matter = pair_function(self.peer_type, tick.partition, index)
                carry = tuple(inside[row] for row in matter if row < len(inside))
                constants = tuple(row - len(inside) for row in matter if row >= len(inside))
                pairs[tick, index] = Pairwise(function, carry, constants, rows, now)
        return pairs

    def _p(self) -> Any:
        return self.constants[: len(self.peer_type.parameters)]

    def _of_subsystem(self, function: Any, now: int) -> Any:
        """Return a function of (x, u, p, t) at an instant."""
        return function(self.x, self.u, self._p(), self._time(now))

    def _time(self, now: int) -> Any:
        return seconds_at(self.schedule, self.frame, now)

    def _signal(self, signal: LocalSignal, now: int) -> Any:
        match signal.role:
            case "state":
                return self.x[signal.index[0]]
            case "output":
                return self.newest[signal.index[0], signal.index[1]]
            case "limited":
                return self._of_subsystem(self.peer_type.limits[signal.index[0]].value, now)
            case _:
                return self.u[signal.index[0]]

    def _step(self, now: int, event: Event) -> None:
        match event:
            case Propagate(duration):
                self._propagate(now, self.durations.index(duration))
            case HoldUpdate(hold, value):
                # Values not yet computed are zero: the initial carry.
                u = casadi.vertsplit(self.u)
                u[hold] = self.values[value]
                self.u = _column(self.type_, u)
            case SendEvent(partition, rows):
                everything = self._of_subsystem(self.peer_type.sends[partition].send, now)
                self.sent |= {row: everything[channel] for channel, row in rows}
            case Tick(partition, index, received):
                computing = self.peer_type.clocks[partition]
                m = _column(self.type_, [self.newest[partition, o] for o in computing.memories])
                input_rows = [
                    self.received[event, position]
                    if (event, position) in self.received
                    else self._sum(now, rows)
                    for position, rows in enumerate(received)
                ]
                r = _column(self.type_, input_rows)
                outputs = computing.tick(self.x, self.u, m, r, self._p(), self._time(now))
                for o in range(len(computing.outputs)):
                    self.newest[partition, o] = self.values[ClockedValue(partition, o, index)] = outputs[o]

    def _sum(self, now: int, rows: Sequence[int]) -> Any:
        total = self.type_(0)
        for row in rows:
            received = self.schedule.all_received[row]
            weight: Any = 1
            if isinstance(received, UncertainSample) and received.gap:
                # A subsystem's own packet of this moment is the substitute for missing ones.
                sending = next(
                    send for send in self.peer_type.sends if send.link == received.coupling_term.link
                )
                weight = self._of_subsystem(sending.send, now)[sending.channels.index(received.channel)]
            total = total + weight * self.received[row]
        return total

    def _propagate(self, now: int, index: int) -> None:
        """Move x over one interval, and add up the work that held values do meanwhile."""
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
            flowing = before[list(self.flow.rows)]
            moved = self.moves[index](flowing, self.u, self._p(), self._time(now))
            for i, row in enumerate(self.flow.rows):
                after[row] = moved[i]
        self.intervals.append((now, index))
        old: Any = self._of_subsystem(ports.port, now) if ports else None
        self.x = _column(self.type_, after)
        if ports:
            n, new = len(ports.parts), self._of_subsystem(ports.port, now)
            work = casadi.vertsplit(self.work)
            for i, part in enumerate(ports.parts):
                at = self.layout.parts.index(part)
                work[at] = work[at] - old[n + i] * (new[i] - old[i])
            self.work = _column(self.type_, work)


def _column(type_: Any, values: Sequence[Any]) -> Any:
    return casadi.densify(casadi.vertcat(type_(0, 1), *values))
