"""Write a site's frame: the schedule's events written out with the kind's own functions.

Takes: a kind's `Rates`, its `Flow` if it has one, its `Schedule`, the signals to record.
Gives: `build_program`.
Guarantees: the tick functions themselves are evaluated, not their slopes; a value acts and is heard exactly
when the schedule says; what was never computed acts as zero.
Does not: know other peers: what is heard comes in, what is sent goes out (see `population`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import casadi
import numpy as np

from apc.frame.jacobians import edge_name
from apc.frame.schedule import (
    Act,
    Event,
    Propagate,
    Schedule,
    Selected,
    Send,
    Tick,
    Value,
    remembered,
    shifted,
)
from apc.simulation.flow import Flow
from apc.simulation.pairs import Pairwise, pair_function
from apc.simulation.program import Layout, Program, Segment, seconds_at
from apc.simulation.propagate import Rates
from apc.simulation.signals import LocalSignal, ticking_partitions


def build_program(
    rates: Rates,
    schedule: Schedule,
    recorded: Sequence[LocalSignal],
    cuts: Sequence[int],
    flow: Flow | None = None,
) -> Program:
    """Write a site's frame.

    Parameters
    ----------
    rates
        The kind's continuous equations.
    schedule
        What happens in a frame.
    recorded
        The signals to record at every mark of the schedule.
    cuts
        The instants, in quanta, after whose sends packets are exchanged within the frame, and those at which
        peers look at each other pair by pair.
    flow
        What moves the states that have no exact transition.
    """
    writer = _Writer(rates, schedule, tuple(recorded), flow)
    segments = tuple(writer.segment(events, last) for events, last in _cut(schedule.events, cuts))
    return Program(
        kind=rates.kind,
        schedule=schedule,
        rates=rates,
        layout=writer.layout,
        segments=segments,
        recorded=tuple(recorded),
        durations=writer.durations,
        intervals=tuple(writer.intervals),
        moves=tuple(writer.moves),
    )


def _cut(events: Sequence[Event], cuts: Sequence[int]) -> Iterator[tuple[list[tuple[int, Event]], bool]]:
    """Yield the events of each segment with their instants, and whether it is the last."""
    now, timed = 0, []
    for event in events:
        timed.append((now, event))
        now += event.duration if isinstance(event, Propagate) else 0
    begin = 0
    for cut in sorted(cuts):
        # Sends come first of what happens at an instant, whatever the group.
        end = next(
            (
                i
                for i, (at, event) in enumerate(timed)
                if at > cut or (at == cut and not isinstance(event, Send))
            ),
            len(timed),
        )
        yield timed[begin:end], False
        begin = end
    yield timed[begin:], True


class _Writer:
    """Writes one segment after the other; what is known at the end of one is the carry into the next."""

    def __init__(
        self, rates: Rates, schedule: Schedule, recorded: tuple[LocalSignal, ...], flow: Flow | None
    ) -> None:
        self.rates, self.schedule, self.recorded, self.flow = rates, schedule, recorded, flow
        self.kind = kind = rates.kind
        self.functions = [
            kind.derivative,
            *(one.tick for one in kind.clocks),
            *(one.send for one in kind.sends),
            *([kind.ports.port] if kind.ports else []),
        ]
        lengths = [event.duration for event in schedule.events if isinstance(event, Propagate)]
        self.durations = tuple(sorted(set(lengths)))
        self.moves = [flow.over(length * schedule.quantum) for length in self.durations] if flow else []
        plain = all(function.is_a("SXFunction") for function in (*self.functions, *self.moves))
        self.type_: Any = casadi.SX if plain else casadi.MX
        self.intervals: list[tuple[int, int]] = []
        outputs = tuple(
            (p, o) for p in ticking_partitions(schedule) for o in range(len(kind.clocks[p].outputs))
        )
        parts = tuple(dict.fromkeys(kind.ports.parts)) if kind.ports else ()
        # What holds put out in this frame; `_between` and `_after` pass on what is of earlier ones.
        read = [one for one in schedule.acting if one is not None]
        read += [event.value for event in schedule.events if isinstance(event, Act)]
        self.layout = Layout(len(kind.states), outputs, remembered(read, schedule.ticks), parts)
        # Keys of the carry: of a segment's first, in its order; of the next, what the last one left.
        self.keys: list[Any] = [
            *(("x", i) for i in range(len(kind.states))),
            *(("newest", one) for one in outputs),
            *self.layout.later,
            *(("work", part) for part in parts),
        ]
        self.pair_functions: dict[tuple[int, int], tuple[Any, tuple[int, ...]]] = {}
        self.rest: list[Event] = list(schedule.events)
        self.begun = -1  # the instant of the event before
        self.marks = self.impulses = 0  # written so far

    def segment(self, events: Sequence[tuple[int, Event]], last: bool) -> Segment:
        """Write the events of one segment."""
        type_, layout = self.type_, self.layout
        carry = type_.sym("carry", len(self.keys))
        constants = type_.sym("constants", self._constant_rows())
        frame = type_.sym("frame")
        ticks = [(now, event) for now, event in events if isinstance(event, Tick)]
        pairs = {key: one for now, tick in ticks for key, one in self._pairs(now, tick).items()}
        assert all(one.now == events[0][0] for one in pairs.values()), "peers look before anything happens"
        apart = {row for one in pairs.values() for row in one.heard}
        heard_rows = sorted({row for _, tick in ticks for rows in tick.heard for row in rows} - apart)
        heard = type_.sym("heard", len(heard_rows) + len(pairs))
        lengths = sum(isinstance(event, Propagate) for _, event in events)
        impulses = type_.sym("impulses", len(self.rates.pushed) * lengths if self.rates.timed else 0)
        self.known: dict[Any, Any] = {key: carry[i] for i, key in enumerate(self.keys)}
        if ("u", 0) not in self.known:  # the first segment
            for h, value in enumerate(self.schedule.acting):
                self.known["u", h] = type_(0) if value is None else self.known[value]
        self.inputs = (
            constants,
            frame,
            dict(zip([*heard_rows, *pairs], casadi.vertsplit(heard), strict=True)),
            impulses,
        )
        self.sent: dict[int, Any] = {}
        self.rows: list[Any] = []
        self.taken = 0
        for now, event in events:
            if now in self.schedule.marks and self._is_first_at(now, event):
                self.rows += [self._signal(one, now) for one in self.recorded]
            self._step(now, event)
            self.rest.pop(0)
        keys = self._after() if last else self._between()
        result = [self.known[source] for source, _ in keys]
        self.keys = [key for _, key in keys]
        kernel = casadi.Function(
            "segment",
            [carry, heard, constants, impulses, frame],
            [
                _column(type_, result),
                _column(type_, [self.sent[row] for row in sorted(self.sent)]),
                _column(type_, self.rows),
            ],
            ["carry", "heard", "constants", "impulses", "frame"],
            ["carry_after", "sent", "rows"],
        )
        assert not last or len(self.keys) == layout.size
        puts_out = [self.schedule.acting[h] if last else ("u", h) for h in range(len(self.kind.holds))]
        held = tuple(-1 if one is None else self.keys.index(one) for one in puts_out)
        first = self.marks, self.impulses
        self.marks += len(self.rows) // max(len(self.recorded), 1)
        self.impulses += impulses.numel()
        return Segment(
            kernel, tuple(heard_rows), tuple(pairs.values()), tuple(sorted(self.sent)), held, *first
        )

    def _pairs(self, now: int, tick: Tick) -> dict[Any, Pairwise]:
        """Return what a tick hears pair by pair, by (tick, receive): what matters of x, u, m and p."""
        computing, found = self.kind.clocks[tick.partition], {}
        inside = [
            *(("x", i) for i in range(self.layout.states)),
            *(("u", h) for h in range(len(self.kind.holds))),
            *(("newest", (tick.partition, o)) for o in computing.memories),
        ]
        for place, (receive, rows) in enumerate(zip(computing.receives, tick.heard, strict=True)):
            if not rows or not edge_name(computing, receive):
                continue
            key = (tick.partition, place)
            if key not in self.pair_functions:
                self.pair_functions[key] = pair_function(self.kind, *key)
            function, own = self.pair_functions[key]
            found[tick, place] = Pairwise(
                function,
                tuple(self.keys.index(inside[row]) for row in own if row < len(inside)),
                tuple(row - len(inside) for row in own if row >= len(inside)),
                rows,
                now,
            )
        return found

    def _is_first_at(self, now: int, event: Event) -> bool:
        """Say whether an event is the first at its instant, which is then over."""
        first, self.begun = now > self.begun, now
        return first

    def _constant_rows(self) -> int:
        return len(self.kind.parameters) + int(self.rates.pattern.sum()) * len(self.durations)

    def _x(self) -> Any:
        return _column(self.type_, [self.known["x", i] for i in range(self.layout.states)])

    def _u(self) -> Any:
        return _column(self.type_, [self.known["u", h] for h in range(len(self.kind.holds))])

    def _p(self) -> Any:
        return self.inputs[0][: len(self.kind.parameters)]

    def _time(self, now: int) -> Any:
        return seconds_at(self.schedule, self.inputs[1], now)

    def _signal(self, signal: LocalSignal, now: int) -> Any:
        match signal.role:
            case "state":
                return self.known["x", signal.place[0]]
            case "output":
                return self.known["newest", signal.place]
            case "limited":
                limited: Any = self.kind.limits[signal.place[0]].value
                return limited(self._x(), self._u(), self._p(), self._time(now))
            case _:
                return self.known["u", signal.place[0]]

    def _step(self, now: int, event: Event) -> None:
        match event:
            case Propagate(duration):
                self._propagate(now, self.durations.index(duration))
            case Act(hold, value):
                # What was never computed acts as zero: so the carry begins.
                self.known["u", hold] = self.known[value]
            case Send(partition, rows):
                sending = self.kind.sends[partition]
                everything = sending.send(self._x(), self._u(), self._p(), self._time(now))
                self.sent |= {row: everything[channel] for channel, row in rows}
            case Tick(partition, index, heard):
                computing = self.kind.clocks[partition]
                m = _column(self.type_, [self.known["newest", (partition, o)] for o in computing.memories])
                values = self.inputs[2]
                r = _column(
                    self.type_,
                    [
                        values[event, place] if (event, place) in values else self._sum(now, rows)
                        for place, rows in enumerate(heard)
                    ],
                )
                outputs = computing.tick(self._x(), self._u(), m, r, self._p(), self._time(now))
                for o in range(len(computing.outputs)):
                    self.known["newest", (partition, o)] = outputs[o]
                    self.known[Value(partition, o, index)] = outputs[o]

    def _sum(self, now: int, rows: Sequence[int]) -> Any:
        total = self.type_(0)
        for row in rows:
            heard = self.schedule.received[row]
            # What a site would itself send at this moment stands in for what it misses.
            weight = self._own(now, heard) if isinstance(heard, Selected) and heard.gap else 1
            total = total + weight * self.inputs[2][row]
        return total

    def _own(self, now: int, heard: Selected) -> Any:
        sending = next(one for one in self.kind.sends if one.link == heard.way.link)
        everything = sending.send(self._x(), self._u(), self._p(), self._time(now))
        return everything[sending.channels.index(heard.channel)]

    def _propagate(self, now: int, place: int) -> None:
        """Move x over one interval, and add up the work that held values do meanwhile."""
        pattern, type_ = self.rates.pattern, self.type_
        constants, _, _, impulses = self.inputs
        before, u, size = self._x(), self._u(), int(pattern.sum())
        begin = len(self.kind.parameters) + place * size
        rows, columns = np.nonzero(pattern.T)[::-1]
        sparsity = casadi.Sparsity.triplet(*pattern.shape, rows.tolist(), columns.tolist())
        step = type_(sparsity, constants[begin : begin + size])
        after = casadi.vertsplit(casadi.densify(step @ casadi.vertcat(before, u, 1)))
        for row in self.rates.pushed if self.rates.timed else ():
            after[row] = after[row] + impulses[self.taken]
            self.taken += 1
        if self.flow is not None:
            moved = self.moves[place](before[list(self.flow.rows)], u, self._p(), self._time(now))
            for i, row in enumerate(self.flow.rows):
                after[row] = moved[i]
        self.intervals.append((now, place))
        ports = self.kind.ports
        if ports:
            n = len(ports.parts)
            old = ports.port(before, u, self._p(), self._time(now))
            new = ports.port(_column(type_, after), u, self._p(), self._time(now))
            for i, part in enumerate(ports.parts):
                self.known["work", part] = self.known["work", part] - old[n + i] * (new[i] - old[i])
        for i, one in enumerate(after):
            self.known["x", i] = one

    def _between(self) -> list[tuple[Any, Any]]:
        """Return what the rest of the frame still needs, as (key, key)."""
        needed = {event.value for event in self.rest if isinstance(event, Act)}
        for one in self.layout.later:
            needed.add(shifted(one, self.schedule.ticks))
            needed.add(one)
        return [(key, key) for key in self.known if not isinstance(key, Value) or key in needed]

    def _after(self) -> list[tuple[Any, Any]]:
        """Return the carry into the next frame, as (key here, key there)."""
        return [
            *((("x", i), ("x", i)) for i in range(self.layout.states)),
            *((("newest", one), ("newest", one)) for one in self.layout.outputs),
            *((shifted(one, self.schedule.ticks), one) for one in self.layout.later),
            *((("work", part), ("work", part)) for part in self.layout.parts),
        ]


def _column(type_: Any, values: Sequence[Any]) -> Any:
    return casadi.densify(casadi.vertcat(*values)) if values else type_(0, 1)
