"""What can be recorded of one site: its states, what its clocks compute, what its holds put out.

Takes: a `Kind` and its `Schedule`.
Gives: `LocalSignal`, `local_signals`; `sent_states`, `ticking_partitions`.
Guarantees: a value that acts later than it is computed is two signals, any other is one.
Does not: know other peers (see `signals`).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi

from apc.compiler.compiled import Kind
from apc.frame.schedule import Act, Propagate, Schedule, Tick


@dataclass(frozen=True, slots=True)
class LocalSignal:
    """Something of a site that can be recorded: "state", "output" (as newly computed) or "hold" (acting).

    `place` is the state, the (clock partition, output), or the hold.
    """

    name: str
    unit: str
    role: str
    place: tuple[int, ...]


def local_signals(kind: Kind, schedule: Schedule) -> tuple[LocalSignal, ...]:
    """Return what can be recorded of a site.

    A value that a hold puts out as soon as it is computed is one signal; one that acts later is two:
    `contact.f` as newly computed, and `contact.f acting`.
    """
    found = [
        LocalSignal(state.name, state.unit, "state", (place,)) for place, state in enumerate(kind.states)
    ]
    ticking = ticking_partitions(schedule)
    for p in ticking:
        partition = kind.clocks[p]
        found += [
            LocalSignal(name, unit, "output", (p, o))
            for o, (name, unit) in enumerate(zip(partition.outputs, partition.units, strict=True))
        ]
    numbers = {partition.clock: p for p, partition in enumerate(kind.clocks)}
    late = _late_holds(schedule)
    for h, hold in enumerate(kind.holds):
        p = numbers[hold.clock]
        if h in late:
            unit = kind.clocks[p].units[hold.output]
            found.append(LocalSignal(f"{hold.name} acting", unit, "hold", (h,)))
    return tuple(found)


def sent_states(kind: Kind) -> tuple[int, ...]:
    """Return the states, by their places, that a site sends to others as they are."""
    found = []
    for sending in kind.sends:
        if sending.send.is_a("SXFunction"):
            inputs = sending.send.sx_in()
            channels = sending.send(*inputs)
            found += [
                place
                for row in range(channels.numel())
                for place in range(len(kind.states))
                if casadi.is_equal(channels[row], inputs[0][place])
            ]
    return tuple(dict.fromkeys(found))


def ticking_partitions(schedule: Schedule) -> list[int]:
    """Return the clock partitions that tick in a frame."""
    return sorted({event.partition for event in schedule.events if isinstance(event, Tick)})


def _late_holds(schedule: Schedule) -> set[int]:
    """Return the holds that put out a value later than it is computed."""
    computed: set[tuple[int, int]] = set()
    late = set()
    for event in schedule.events:
        if isinstance(event, Propagate):
            computed = set()
        elif isinstance(event, Tick):
            computed.add((event.partition, event.index))
        elif isinstance(event, Act) and (event.value.partition, event.value.index) not in computed:
            late.add(event.hold)
    return late
