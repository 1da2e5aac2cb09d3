"""How old what is heard is, put into the equations: known at each tick, or told by stamps.

Takes: a `Model`, its timings.
Gives: `aged`, `nominal`, `linear_sites`, `at_timings`, `stamped`.
Guarantees: a scene that asks for no age is returned as it is. In `nominal`, where every packet arrives after
its link's delay, an age is a number of each tick, the same in each frame: what multiplies it stays linear. In
`stamped`, every packet says when it was sent, as in a real network: its age is right whatever happens to it.
Does not: linearize or play anything.

Age is counted from when a packet was sent to the tick that hears it; that of the start values, which are
heard before any packet, from time 0.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi

from apc.compiler.compiled import ClockPartition, Model, PeerType, Receive, SendPartition
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.multiples import common_multiple
from apc.frame.exchange import CommunicationGraph, build_exchange
from apc.frame.jacobians import SubsystemJacobians, jacobians
from apc.frame.schedule import ORDER

# Kinds that are remembered with the ages of some timings.
KEPT = 64

STAMP = "time"  # the channel that tells when a packet was sent

_Ages = tuple[tuple[str, Fraction], ...]  # of one tick, by link


def aged(system: Model) -> bool:
    """Say whether an equation of a scene asks how old what is heard is."""
    return any(map(_hears_ages, system.kinds))


def _hears_ages(kind: PeerType) -> bool:
    return any(receive.age for partition in kind.clocks for receive in partition.receives)


# ---- every packet arrives after its link's delay ----


def linear_sites(
    system: Model, timings: Mapping[str, Fraction] | None = None, order: Sequence[str] = ORDER
) -> tuple[SubsystemJacobians, ...]:
    """Return the Jacobians of each kind of `nominal`, with the system's own timings if none are given."""
    return tuple(jacobians(kind) for kind in nominal(system, timings, order).kinds)


def of_one_delay(system: Model) -> Model:
    """Return a system in which all pairs have the delay of their link, so that each tick has one age."""
    return replace(system, links=tuple(replace(link, delays=()) for link in system.links))


def at_timings(
    system: Model,
    sites: tuple[SubsystemJacobians, ...],
    timings: Mapping[str, Fraction],
    order: Sequence[str],
) -> tuple[SubsystemJacobians, ...]:
    """Return the Jacobians of each kind, those at hand unless ages follow from timings and order."""
    return linear_sites(system, timings, order) if aged(system) else sites


def nominal(
    system: Model, timings: Mapping[str, Fraction] | None = None, order: Sequence[str] = ORDER
) -> Model:
    """Return the kinds of a linear analysis, with the ages that each tick finds on a nominal network.

    There every packet arrives after its link's delay.

    Parameters
    ----------
    system
        The compiled scene.
    timings
        Seconds by the name of the timing; the system's own if they are left out.
    order
        The order of coincident events, see `schedule.ORDER`.

    Raises
    ------
    ApcError
        E811 peers of one kind that hear packets of several ages at one tick.
    """
    system = replace(system, kinds=tuple(kind.linear or kind for kind in system.kinds))
    if not aged(system):
        return system
    if timings is None:
        timings = {timing.name: timing.value for timing in system.timings}
    exchange = build_exchange(system, timings)
    kinds = []
    for number, kind in enumerate(system.kinds):
        partitions = [_ages(system, exchange, timings, number, clock, order) for clock in kind.clocks]
        kinds.append(_nominal(kind, tuple(partitions)) if _hears_ages(kind) else kind)
    return replace(system, kinds=tuple(kinds))


def _ages(
    system: Model,
    exchange: CommunicationGraph,
    timings: Mapping[str, Fraction],
    number: int,
    partition: ClockPartition,
    order: Sequence[str],
) -> tuple[_Ages, ...]:
    """Return the ages that the ticks of a kind's clock find on each link, until they come again."""
    links = list(dict.fromkeys(receive.link for receive in partition.receives if receive.age))
    if not links:
        return ()
    clock_of = {clock.name: clock for clock in system.clocks}
    names = [partition.clock, *(exchange.links[link].clock for link in links)]
    period = {name: timings[clock_of[name].period] for name in names}
    phase = {name: timings[clock_of[name].phase] % period[name] for name in names}
    own = period[partition.clock]
    late = {link: timings[_only_delay(system, exchange, number, link)] for link in links}
    result = []
    for tick in range(int(common_multiple(period.values()) / own)):
        now = phase[partition.clock] + tick * own
        ages = []
        for link in links:
            clock, rank = exchange.links[link].clock, order.index
            missed = period[clock] if late[link] == 0 and rank("deliver") < rank("send") else 0
            waited = (now - late[link] - phase[clock]) % period[clock]  # since the newest that is there
            if not waited and rank("tick") < rank("deliver"):
                waited = period[clock]
            ages.append((link, late[link] + waited + missed))
        result.append(tuple(ages))
    return tuple(result)


def _only_delay(system: Model, exchange: CommunicationGraph, number: int, link: str) -> str:
    """Return the timing of the delay with which all peers of a kind hear all others."""
    receivers = [place for place, group in enumerate(system.groups) if group.kind == number]
    delays = {
        exchange.delay(link, sender, receiver)
        for receiver in receivers
        for sender in range(len(system.groups))
        if sender != receiver or system.groups[sender].count > 1
    }
    if len(delays) > 1:
        names = ", ".join(sorted(delays))
        what = (
            f"the age of what peers of {system.kinds[number].name} hear over {link} differs from sender to "
            f"sender ({names}): that is not analysed; a simulation plays it"
        )
        raise ApcError(Diagnostic("E811", SourceLocation(system.origin.topology), what, hint="apc simulate"))
    return delays.pop() if delays else exchange.usual[link]


@functools.lru_cache(maxsize=KEPT)
def _nominal(kind: PeerType, partitions: tuple[tuple[_Ages, ...], ...]) -> PeerType:
    """Return a kind with the ages of each clock's ticks put in."""
    clocks = [
        _with_ages(partition, ages) if ages else partition
        for partition, ages in zip(kind.clocks, partitions, strict=True)
    ]
    return replace(kind, clocks=tuple(clocks))


def _with_ages(partition: ClockPartition, ages: Sequence[_Ages]) -> ClockPartition:
    """Return a clock's partition that computes a column for each tick of different ages."""
    different = list(dict.fromkeys(ages))
    x, u, m, _, p, t = _symbols(partition.tick)
    receives: list[Receive] = []
    rows: list[list[_Row]] = [[] for _ in different]  # by variant
    for receive in partition.receives:
        places: dict[Fraction, int] = {}
        for own, pairs in zip(rows, different, strict=True):
            age = dict(pairs).get(receive.link, Fraction(0))
            alone = float(age) if receive.age == "alone" else None
            if receive.age == "edge":
                alone = _of_itself(receive, age, x, u, m, p, t)
            if alone is not None:
                own.append((alone, ()))
                continue
            key = age if receive.age == "edge" else Fraction(0)
            if key not in places:
                places[key] = len(receives)
                receives.append(_at_age(receive, age))
            own.append((0, ((places[key], float(age) if receive.age == "factor" else 1),)))
    r = type(x).sym("r", len(receives))
    values = [partition.tick(x, u, m, _column(row, r), p, t) for row in rows]
    number = {pairs: place for place, pairs in enumerate(different)}
    return replace(
        partition,
        receives=tuple(receives),
        tick=_function(partition.tick, [x, u, m, r, p, t], casadi.vertcat(*values)),
        variants=tuple(number[age] for age in ages) if len(different) > 1 else (),
    )


# What takes the place of a receive: a value, and places of r with what they are multiplied by.
_Row = tuple[Any, tuple[tuple[int, Any], ...]]


def _column(rows: Sequence[_Row], r: Any) -> Any:
    return casadi.vertcat(*(sum((weight * r[k] for k, weight in terms), start) for start, terms in rows))


def _of_itself(receive: Receive, age: Fraction, *own: Any) -> Any | None:
    """Return what an edge is of the hearing peer alone, at an age; None if senders matter as well.

    It is the same for all senders: a mean, maximum or minimum of it is itself. A sum is compiled as a mean.
    """
    edge: Any = receive.edge
    x, u, m, s, p, t = _symbols(edge)
    sent = casadi.vertcat(s[: s.numel() - 1], float(age))
    if casadi.depends_on(edge(x, u, m, sent, p, t), s):
        return None
    return edge(*own[:3], casadi.vertcat(casadi.DM.zeros(s.numel() - 1), float(age)), *own[3:])


def _at_age(receive: Receive, age: Fraction) -> Receive:
    """Return what is heard without its age, or its edge at that age."""
    if receive.age != "edge":
        return replace(receive, age="")
    edge: Any = receive.edge
    symbols = _symbols(edge)
    sent = casadi.SX.sym("s", symbols[3].numel() - 1)
    value = edge(*symbols[:3], casadi.vertcat(sent, float(age)), *symbols[4:])
    known = _function(edge, [*symbols[:3], sent, *symbols[4:]], value)
    return replace(receive, name=f"{receive.name} at {float(age):.9g} s", edge=known, age="")


# ---- every packet says when it was sent ----


def stamped(system: Model) -> Model:
    """Return a scene whose packets say when they were sent, where its ages follow from that.

    Beside a channel that is weighed by its age travels the same times the moment of sending.
    """
    if not aged(system):
        return system
    asked: dict[str, dict[str, None]] = {}
    for kind in system.kinds:
        channels = {sending.link: sending.channels for sending in kind.sends}
        for receive in (
            receive for partition in kind.clocks for receive in partition.receives if receive.age
        ):
            of = channels[receive.link][receive.channel] if receive.age == "factor" else ""
            asked.setdefault(receive.link, {})[of] = None
    wanted = tuple((link, tuple(names)) for link, names in asked.items())
    return replace(system, kinds=tuple(_stamped(kind, wanted) for kind in system.kinds))


@functools.lru_cache(maxsize=KEPT)
def _stamped(kind: PeerType, wanted: tuple[tuple[str, tuple[str, ...]], ...]) -> PeerType:
    """Return a kind that stamps its packets: by link, the channels that are sent times their moment too."""
    asked = dict(wanted)
    sends = tuple(_stamping(send, asked[send.link]) if send.link in asked else send for send in kind.sends)
    channels = {send.link: send.channels for send in sends}
    return replace(
        kind,
        sends=sends,
        clocks=tuple(
            _by_stamps(clock, channels) if any(receive.age for receive in clock.receives) else clock
            for clock in kind.clocks
        ),
    )


def _stamp(channel: str) -> str:
    return f"{STAMP}*{channel}" if channel else STAMP


def _stamping(sending: SendPartition, asked: Sequence[str]) -> SendPartition:
    x, u, p, t = _symbols(sending.send)
    sent = sending.send(x, u, p, t)
    more = [t * sent[sending.channels.index(text)] if text else t for text in asked]
    return replace(
        sending,
        channels=(*sending.channels, *map(_stamp, asked)),
        units=(*sending.units, *("s" for _ in asked)),
        send=_function(sending.send, [x, u, p, t], casadi.vertcat(sent, *more)),
    )


def _by_stamps(partition: ClockPartition, channels: Mapping[str, tuple[str, ...]]) -> ClockPartition:
    x, u, m, _, p, t = _symbols(partition.tick)
    receives: list[Receive] = []
    rows: list[_Row] = []
    for receive in partition.receives:
        places = channels[receive.link]
        plain = replace(receive, age="")
        if receive.age == "factor":
            stamped_too = replace(plain, channel=places.index(_stamp(places[receive.channel])))
            pair: _Row = (0, ((len(receives), t), (len(receives) + 1, -1)))
            receives += [plain, replace(stamped_too, name=f"{STAMP} of {receive.name}")]
        elif receive.age == "alone":
            pair = (t, ((len(receives), -1),))
            receives.append(replace(plain, channel=places.index(STAMP)))
        else:
            pair = (0, ((len(receives), 1),))
            edge = _looking(receive.edge, places.index(STAMP)) if receive.age else receive.edge
            receives.append(replace(plain, edge=edge))
        rows.append(pair)
    r = type(x).sym("r", len(receives))
    tick = _function(partition.tick, [x, u, m, r, p, t], partition.tick(x, u, m, _column(rows, r), p, t))
    return replace(partition, receives=tuple(receives), tick=tick)


def _looking(edge: Any, stamp: int) -> Any:
    """Return an edge function whose packets hold a stamp instead of their age."""
    x, u, m, s, p, t = _symbols(edge)
    sent = casadi.SX.sym("s", stamp + 1)
    value = edge(x, u, m, casadi.vertcat(sent[: s.numel() - 1], t - sent[stamp]), p, t)
    return _function(edge, [x, u, m, sent, p, t], value)


def _symbols(function: Any) -> list[Any]:
    """Return a function's arguments; one with a solver inside takes matrices as they are."""
    kind = casadi.SX if function.is_a("SXFunction") else casadi.MX
    return [kind.sym(name, function.numel_in(place)) for place, name in enumerate(function.name_in())]


def _function(like: Any, symbols: Sequence[Any], value: Any) -> Any:
    """Return a function of other symbols, named as one is."""
    return casadi.Function(
        like.name(), list(symbols), [casadi.densify(value)], like.name_in(), like.name_out()
    )
