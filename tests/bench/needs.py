"""What each scene of models/ keeps and drops, with the reason: `python -m tests.bench.needs`.

Of a peer of each kind: the equations written, those left out (the same as another, or read by nobody), the
states of its motion, what it remembers of its ticks and of its packets, and what it does without.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from apc.analysis.analysis import prepare
from apc.compiler.compiled import CompiledSystem
from apc.compiler.equations.structure import SortedSystem
from apc.compiler.functions.reached import reached_together
from apc.compiler.pipeline import each_stage
from apc.frame.parameters import resolve
from apc.frame.schedule import Schedule
from tests.topologies import SCENES

Reasons = tuple[tuple[str, str], ...]  # names, each with the reason


@dataclass(frozen=True, slots=True)
class Account:
    """A peer of one kind: how many equations were `written` and are `computed`, and the rest by name."""

    kind: str
    written: int
    computed: int
    same: tuple[tuple[str, str], ...]  # each with what it is the same as
    unread: tuple[str, ...]
    motion: tuple[str, ...]
    remembered: Reasons
    packets: Reasons
    without: Reasons


def accounts(path: Path) -> tuple[Account, ...]:
    """Return the account of each kind of a scene."""
    stages = dict(each_stage(path))
    ordered, system = stages["sorted"], stages["compiled"]
    assert isinstance(ordered, SortedSystem)
    assert isinstance(system, CompiledSystem)
    schedules = prepare(system).schedules
    schedule_of = {group.kind: one for group, one in zip(system.groups, schedules, strict=True)}
    found = []
    for place, reached in enumerate(reached_together(ordered.kinds)):
        kind = reached.kind
        steps = [name.name for part in kind.partitions for name in part.definitions]
        read = {one.name for one in reached.symbols}
        unread = tuple(name for name in steps if name not in read)
        found.append(
            Account(
                kind=kind.clocked.flat.name,
                written=len(kind.clocked.flat.equations),
                computed=len(steps) - len(unread),
                same=tuple((name, str(value)) for name, value in kind.aliases),
                unread=unread,
                motion=kind.states,
                remembered=_remembered(system, place, schedule_of[place]),
                packets=_packets(system, schedule_of[place]),
                without=_without(system, place, schedule_of[place]),
            )
        )
    return tuple(found)


def _remembered(system: CompiledSystem, place: int, schedule: Schedule) -> Reasons:
    """Return what a peer remembers of the ticks of earlier frames."""
    kind, seconds = system.kinds[place], resolve(system).timings
    found = []
    for value, name in zip(schedule.carried, schedule.value_names, strict=True):
        clock = kind.clocks[value.partition]
        held = [h for h in kind.holds if (h.clock, h.output) == (clock.clock, value.output)]
        late = [f"acts {_time(seconds[hold.delay])} after its tick" for hold in held if seconds[hold.delay]]
        again = ["is looked at again at the next tick"] if value.output in clock.memories else []
        found.append((name, " and ".join(dict.fromkeys(late + again)) or "acts on until the next tick"))
    return tuple(found)


def _packets(system: CompiledSystem, schedule: Schedule) -> Reasons:
    """Return what is on its way to others, or newest there, as a frame begins."""
    found = []
    for sent, depth, name in zip(schedule.sent, schedule.depths, schedule.sent_names, strict=True):
        if depth:
            times = "" if depth == 1 else f" of {depth} frames"
            found.append((name + times, f"{sent.link} is {_time(_late(system, sent.link))} late"))
    return tuple(found)


def _without(system: CompiledSystem, place: int, schedule: Schedule) -> Reasons:
    """Return what has no memory, and what was left out of the whole scene."""
    kind, seconds = system.kinds[place], resolve(system).timings
    outputs = {clock.clock: clock.outputs for clock in kind.clocks}
    holds = [hold for hold in kind.holds if not seconds[hold.delay]]
    found = [(outputs[hold.clock][hold.output], "acts at once: nothing to remember") for hold in holds]
    found += [
        (name, f"{sent.link} is not late: no buffer")
        for sent, depth, name in zip(schedule.sent, schedule.depths, schedule.sent_names, strict=True)
        if not depth
    ]
    return (*dict.fromkeys(found), *system.dropped)


def _late(system: CompiledSystem, name: str) -> Fraction:
    link = next(one for one in system.links if one.name == name)
    seconds = resolve(system).timings
    return max(seconds[one] for one in (link.delay, *(pair.delay for pair in link.delays)))


def _time(value: Fraction) -> str:
    return f"{float(1000 * value):g} ms"


def _lines(account: Account) -> Iterator[str]:
    """Return an account as a person reads it."""
    yield f"{account.written} equations written: {account.computed} computed"
    for name, listed in (
        ("the same as another", [f"{one} = {other}" for one, other in account.same]),
        ("read by nobody", account.unread),
        ("motion", account.motion),
    ):
        if listed:
            yield f"{len(listed)} {name}: {', '.join(listed)}"
    for what, reasons in (
        ("remembered", account.remembered),
        ("on the way", account.packets),
        ("without memory", account.without),
    ):
        yield from (f"{what}: {name} ({reason})" for name, reason in reasons)


def main() -> None:
    """Print what each scene keeps and drops."""
    for path in sorted(SCENES.glob("*.yaml")):
        print(path.stem)
        found = accounts(path)
        for account in found:
            if len(found) > 1:
                print(f"  {account.kind}")
            for line in _lines(account):
                print(textwrap.fill(line, 80, initial_indent="  ", subsequent_indent="      "))
        print()


if __name__ == "__main__":
    main()
