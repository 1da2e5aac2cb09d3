"""Packet ages in the equations: known at each tick on a nominal network, or from time stamps.

Takes: a `Model`, its timings.
Gives: `aged`, `nominal`, `linear_subsystems`, `at_timings`, `stamped`; `of_single_delay`.
Guarantees: a model without ages is returned unchanged. In `nominal`, where every packet arrives after its
link's delay, an age is a number of each tick, the same in each frame: products with it stay linear. In
`stamped`, every packet contains its time of sending, as in a real network: its age is correct under loss and
jitter.
Does not: linearize or simulate.

The age of a packet is the time from its sending to the tick that receives it; start values, which are
received before any packet, are sent at time 0.
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
from apc.frame.communication_graph import CommunicationGraph, build_exchange
from apc.frame.jacobians import SubsystemJacobians, jacobians
from apc.frame.schedule import ORDER

# Cached peer types with the ages of given timings.
CACHE_SIZE = 64

STAMP = "time"  # the channel with the time of sending

_Ages = tuple[tuple[str, Fraction], ...]  # of one tick, by link


def aged(system: Model) -> bool:
    """Return whether an equation of a model contains the age of a received value."""
    return any(map(_receives_ages, system.peer_types))


def _receives_ages(peer_type: PeerType) -> bool:
    return any(receive.age for partition in peer_type.clocks for receive in partition.receives)


# ---- every packet arrives after its link's delay ----


def linear_subsystems(
    system: Model, timings: Mapping[str, Fraction] | None = None, order: Sequence[str] = ORDER
) -> tuple[SubsystemJacobians, ...]:
    """Return the Jacobians of each peer type of `nominal`, by default with the model's own timings."""
    return tuple(jacobians(peer_type) for peer_type in nominal(system, timings, order).peer_types)


def of_single_delay(system: Model) -> Model:
    """Return a model in which all pairs have the delay of their link, so that each tick has one age."""
    return replace(system, links=tuple(replace(link, delays=()) for link in system.links))


def at_timings(
    system: Model,
    subsystems: tuple[SubsystemJacobians, ...],
    timings: Mapping[str, Fraction],
    order: Sequence[str],
) -> tuple[SubsystemJacobians, ...]:
    """Return the Jacobians of each peer type, those given unless ages depend on timings and order."""
    return linear_subsystems(system, timings, order) if aged(system) else subsystems


def nominal(
    system: Model, timings: Mapping[str, Fraction] | None = None, order: Sequence[str] = ORDER
) -> Model:
    """Return the peer types of a linear analysis, with the ages of each tick on a nominal network.

    On a nominal network every packet arrives after its link's delay.

    Parameters
    ----------
    system
        The compiled model.
    timings
        Seconds by the name of the timing; by default the model's own.
    order
        The order of coincident events, see `schedule.ORDER`.

    Raises
    ------
    ApcError
        E811 peers of one type that receive packets of several ages at one tick.
    """
    system = replace(
        system, peer_types=tuple(peer_type.linear or peer_type for peer_type in system.peer_types)
    )
    if not aged(system):
        return system
    if timings is None:
        timings = {timing.name: timing.value for timing in system.timings}
    exchange = build_exchange(system, timings)
    peer_types = []
    for number, peer_type in enumerate(system.peer_types):
        partitions = [_ages(system, exchange, timings, number, clock, order) for clock in peer_type.clocks]
        peer_types.append(_nominal(peer_type, tuple(partitions)) if _receives_ages(peer_type) else peer_type)
    return replace(system, peer_types=tuple(peer_types))


def _ages(
    system: Model,
    exchange: CommunicationGraph,
    timings: Mapping[str, Fraction],
    number: int,
    partition: ClockPartition,
    order: Sequence[str],
) -> tuple[_Ages, ...]:
    """Return the ages at the ticks of a peer type's clock on each link, over one period of the pattern."""
    links = list(dict.fromkeys(receive.link for receive in partition.receives if receive.age))
    if not links:
        return ()
    clock_of = {clock.name: clock for clock in system.clocks}
    names = [partition.clock, *(exchange.links[link].clock for link in links)]
    period = {name: timings[clock_of[name].period] for name in names}
    phase = {name: timings[clock_of[name].phase] % period[name] for name in names}
    local = period[partition.clock]
    late = {link: timings[_only_delay(system, exchange, number, link)] for link in links}
    result = []
    for tick in range(int(common_multiple(period.values()) / local)):
        now = phase[partition.clock] + tick * local
        ages = []
        for link in links:
            clock, rank = exchange.links[link].clock, order.index
            missed = period[clock] if late[link] == 0 and rank("deliver") < rank("send") else 0
            waited = (now - late[link] - phase[clock]) % period[clock]  # since the newest available packet
            if not waited and rank("tick") < rank("deliver"):
                waited = period[clock]
            ages.append((link, late[link] + waited + missed))
        result.append(tuple(ages))
    return tuple(result)


def _only_delay(system: Model, exchange: CommunicationGraph, number: int, link: str) -> str:
    """Return the timing of the delay with which all peers of a type receive from all others."""
    receivers = [index for index, group in enumerate(system.groups) if group.peer_type == number]
    delays = {
        exchange.delay(link, sender, receiver)
        for receiver in receivers
        for sender in range(len(system.groups))
        if sender != receiver or system.groups[sender].count > 1
    }
    if len(delays) > 1:
        names = ", ".join(sorted(delays))
        message = (
            f"the age of what peers of {system.peer_types[number].name} hear over {link} differs from "
            "sender to "
            f"sender ({names}): that is not analysed; a simulation plays it"
        )
        raise ApcError(
            Diagnostic("E811", SourceLocation(system.origin.topology), message, hint="apc simulate")
        )
    return delays.pop() if delays else exchange.default_delay[link]


@functools.lru_cache(maxsize=CACHE_SIZE)
def _nominal(peer_type: PeerType, partitions: tuple[tuple[_Ages, ...], ...]) -> PeerType:
    """Return a peer type with the ages of each clock's ticks inserted."""
    clocks = [
        _with_ages(partition, ages) if ages else partition
        for partition, ages in zip(peer_type.clocks, partitions, strict=True)
    ]
    return replace(peer_type, clocks=tuple(clocks))


def _with_ages(partition: ClockPartition, ages: Sequence[_Ages]) -> ClockPartition:
    """Return a clock partition that computes one column for each tick of different ages."""
    different = list(dict.fromkeys(ages))
    x, u, m, _, p, t = _symbols(partition.tick)
    receives: list[Receive] = []
    rows: list[list[_Row]] = [[] for _ in different]  # by variant
    for receive in partition.receives:
        indices: dict[Fraction, int] = {}
        for local, pairs in zip(rows, different, strict=True):
            age = dict(pairs).get(receive.link, Fraction(0))
            alone = float(age) if receive.age == "alone" else None
            if receive.age == "edge":
                alone = _of_itself(receive, age, x, u, m, p, t)
            if alone is not None:
                local.append((alone, ()))
                continue
            key = age if receive.age == "edge" else Fraction(0)
            if key not in indices:
                indices[key] = len(receives)
                receives.append(_at_age(receive, age))
            local.append((0, ((indices[key], float(age) if receive.age == "factor" else 1),)))
    r = type(x).sym("r", len(receives))
    values = [partition.tick(x, u, m, _column(row, r), p, t) for row in rows]
    number = {pairs: index for index, pairs in enumerate(different)}
    return replace(
        partition,
        receives=tuple(receives),
        tick=_function(partition.tick, [x, u, m, r, p, t], casadi.vertcat(*values)),
        variants=tuple(number[age] for age in ages) if len(different) > 1 else (),
    )


# The replacement of a receive: a value, and rows of r with their factors.
_Row = tuple[Any, tuple[tuple[int, Any], ...]]


def _column(rows: Sequence[_Row], r: Any) -> Any:
    return casadi.vertcat(*(sum((weight * r[k] for k, weight in terms), start) for start, terms in rows))


def _of_itself(receive: Receive, age: Fraction, *local: Any) -> Any | None:
    """Return an edge function that depends on the receiving peer alone, at an age; None if it has senders.

    It is the same for all senders: its mean, maximum or minimum is the function itself. A sum is compiled as
    a mean.
    """
    edge: Any = receive.edge
    x, u, m, s, p, t = _symbols(edge)
    sent = casadi.vertcat(s[: s.numel() - 1], float(age))
    if casadi.depends_on(edge(x, u, m, sent, p, t), s):
        return None
    return edge(*local[:3], casadi.vertcat(casadi.DM.zeros(s.numel() - 1), float(age)), *local[3:])


def _at_age(receive: Receive, age: Fraction) -> Receive:
    """Return the received value without its age, or its edge function at that age."""
    if receive.age != "edge":
        return replace(receive, age="")
    edge: Any = receive.edge
    symbols = _symbols(edge)
    sent = casadi.SX.sym("s", symbols[3].numel() - 1)
    value = edge(*symbols[:3], casadi.vertcat(sent, float(age)), *symbols[4:])
    known = _function(edge, [*symbols[:3], sent, *symbols[4:]], value)
    return replace(receive, name=f"{receive.name} at {float(age):.9g} s", edge=known, age="")


# ---- every packet contains its time of sending ----


def stamped(system: Model) -> Model:
    """Return a model whose packets contain time stamps, from which its ages are computed.

    For each channel that is weighted by its age, a second channel sends the product with the time of sending.
    """
    if not aged(system):
        return system
    queried: dict[str, dict[str, None]] = {}
    for peer_type in system.peer_types:
        channels = {sending.link: sending.channels for sending in peer_type.sends}
        for receive in (
            receive for partition in peer_type.clocks for receive in partition.receives if receive.age
        ):
            of = channels[receive.link][receive.channel] if receive.age == "factor" else ""
            queried.setdefault(receive.link, {})[of] = None
    requested = tuple((link, tuple(names)) for link, names in queried.items())
    return replace(
        system, peer_types=tuple(_stamped(peer_type, requested) for peer_type in system.peer_types)
    )


@functools.lru_cache(maxsize=CACHE_SIZE)
def _stamped(peer_type: PeerType, requested: tuple[tuple[str, tuple[str, ...]], ...]) -> PeerType:
    """Return a peer type that stamps its packets: by link, also the channels times their time of sending."""
    queried = dict(requested)
    sends = tuple(
        _stamping(send, queried[send.link]) if send.link in queried else send for send in peer_type.sends
    )
    channels = {send.link: send.channels for send in sends}
    return replace(
        peer_type,
        sends=sends,
        clocks=tuple(
            _by_stamps(clock, channels) if any(receive.age for receive in clock.receives) else clock
            for clock in peer_type.clocks
        ),
    )


def _stamp(channel: str) -> str:
    return f"{STAMP}*{channel}" if channel else STAMP


def _stamping(sending: SendPartition, queried: Sequence[str]) -> SendPartition:
    x, u, p, t = _symbols(sending.send)
    sent = sending.send(x, u, p, t)
    more = [t * sent[sending.channels.index(text)] if text else t for text in queried]
    return replace(
        sending,
        channels=(*sending.channels, *map(_stamp, queried)),
        units=(*sending.units, *("s" for _ in queried)),
        send=_function(sending.send, [x, u, p, t], casadi.vertcat(sent, *more)),
    )


def _by_stamps(partition: ClockPartition, channels: Mapping[str, tuple[str, ...]]) -> ClockPartition:
    x, u, m, _, p, t = _symbols(partition.tick)
    receives: list[Receive] = []
    rows: list[_Row] = []
    for receive in partition.receives:
        indices = channels[receive.link]
        plain = replace(receive, age="")
        if receive.age == "factor":
            stamped_too = replace(plain, channel=indices.index(_stamp(indices[receive.channel])))
            pair: _Row = (0, ((len(receives), t), (len(receives) + 1, -1)))
            receives += [plain, replace(stamped_too, name=f"{STAMP} of {receive.name}")]
        elif receive.age == "alone":
            pair = (t, ((len(receives), -1),))
            receives.append(replace(plain, channel=indices.index(STAMP)))
        else:
            pair = (0, ((len(receives), 1),))
            edge = _looking(receive.edge, indices.index(STAMP)) if receive.age else receive.edge
            receives.append(replace(plain, edge=edge))
        rows.append(pair)
    r = type(x).sym("r", len(receives))
    tick = _function(partition.tick, [x, u, m, r, p, t], partition.tick(x, u, m, _column(rows, r), p, t))
    return replace(partition, receives=tuple(receives), tick=tick)


def _looking(edge: Any, stamp: int) -> Any:
    """Return an edge function whose packets contain a stamp instead of their age."""
    x, u, m, s, p, t = _symbols(edge)
    sent = casadi.SX.sym("s", stamp + 1)
    value = edge(x, u, m, casadi.vertcat(sent[: s.numel() - 1], t - sent[stamp]), p, t)
    return _function(edge, [x, u, m, sent, p, t], value)


def _symbols(function: Any) -> list[Any]:
    """Return a function's arguments; a function with a solver inside takes matrices unsplit."""
    peer_type = casadi.SX if function.is_a("SXFunction") else casadi.MX
    return [peer_type.sym(name, function.numel_in(index)) for index, name in enumerate(function.name_in())]


def _function(like: Any, symbols: Sequence[Any], value: Any) -> Any:
    """Return a function of other symbols, with the names of a given one."""
    return casadi.Function(
        like.name(), list(symbols), [casadi.densify(value)], like.name_in(), like.name_out()
    )
