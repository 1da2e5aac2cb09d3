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
from apc.linearization.jacobians import SubsystemJacobians, jacobians
from apc.timing.communication_graph import CommunicationGraph, build_comm_graph
from apc.timing.schedule import ORDER

# Cached peer types with the ages of given timings.
CACHE_SIZE = 64

STAMP = "time"  # the channel with the time of sending

_Ages = tuple[tuple[str, Fraction], ...]  # of one tick, by link


def aged(model: Model) -> bool:
    """Return whether an equation of a model contains the age of a received value."""
    return any(map(_receives_ages, model.peer_types))


def _receives_ages(peer_type: PeerType) -> bool:
    """Return whether an equation of a peer type contains the age of a received value."""
    return any(receive.age for partition in peer_type.clocks for receive in partition.receives)


# ---- every packet arrives after its link's delay ----


def linear_subsystems(
    model: Model, timings: Mapping[str, Fraction] | None = None, order: Sequence[str] = ORDER
) -> tuple[SubsystemJacobians, ...]:
    """Return the Jacobians of each peer type of `nominal`, by default with the model's own timings."""
    return tuple(jacobians(peer_type) for peer_type in nominal(model, timings, order).peer_types)


def of_single_delay(model: Model) -> Model:
    """Return a model in which all pairs have the delay of their link, so that each tick has one age."""
    return replace(model, links=tuple(replace(link, pairs=()) for link in model.links))


def at_timings(
    model: Model,
    subsystems: tuple[SubsystemJacobians, ...],
    timings: Mapping[str, Fraction],
    order: Sequence[str],
) -> tuple[SubsystemJacobians, ...]:
    """Return the Jacobians of each peer type at other timings.

    A model without ages keeps the given Jacobians, as only ages depend on timings.

    Parameters
    ----------
    model, subsystems
        The compiled model, and its Jacobians at its own timings.
    timings, order
        Seconds by the name of the timing, and the order of coincident events.
    """
    return linear_subsystems(model, timings, order) if aged(model) else subsystems


def nominal(
    model: Model, timings: Mapping[str, Fraction] | None = None, order: Sequence[str] = ORDER
) -> Model:
    """Return the peer types of a linear analysis, with the ages of each tick on a nominal network.

    On a nominal network every packet arrives after its link's delay.

    Parameters
    ----------
    model
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
    model = replace(model, peer_types=tuple(peer_type.linear or peer_type for peer_type in model.peer_types))
    if not aged(model):
        return model
    if timings is None:
        timings = {timing.name: timing.value for timing in model.timings}
    comm_graph = build_comm_graph(model, timings)
    peer_types = []
    for number, peer_type in enumerate(model.peer_types):
        partitions = [
            _ages_of_ticks(model, comm_graph, timings, number, clock, order) for clock in peer_type.clocks
        ]
        peer_types.append(
            _with_known_ages(peer_type, tuple(partitions)) if _receives_ages(peer_type) else peer_type
        )
    return replace(model, peer_types=tuple(peer_types))


def _ages_of_ticks(
    model: Model,
    comm_graph: CommunicationGraph,
    timings: Mapping[str, Fraction],
    peer_type_index: int,
    partition: ClockPartition,
    order: Sequence[str],
) -> tuple[_Ages, ...]:
    """Return the ages at the ticks of a peer type's clock on each link, over one period of the pattern.

    Parameters
    ----------
    model, comm_graph, timings
        The compiled model, its communication graph, and seconds by the name of the timing.
    peer_type_index, partition
        The index of the peer type, and its clock partition.
    order
        The order of coincident events.
    """
    links = list(dict.fromkeys(receive.link for receive in partition.receives if receive.age))
    if not links:
        return ()
    clock_of = {clock.name: clock for clock in model.clocks}
    delay_by_link, clock_by_link = dict[str, Fraction](), dict[str, str]()
    for link in links:
        delay_name = _single_delay(model, comm_graph, timings, peer_type_index, link)
        delay_by_link[link] = timings[delay_name]
        clock_by_link[link] = comm_graph.links[link].clock_at(delay_name)
    names = [partition.clock, *clock_by_link.values()]
    period = {name: timings[clock_of[name].period] for name in names}
    phase = {name: timings[clock_of[name].phase] % period[name] for name in names}
    tick_period = period[partition.clock]
    result = []
    for tick in range(int(common_multiple(period.values()) / tick_period)):
        time = phase[partition.clock] + tick * tick_period
        ages = []
        for link in links:
            clock, rank = clock_by_link[link], order.index
            missed = period[clock] if delay_by_link[link] == 0 and rank("deliver") < rank("send") else 0
            waited = (time - delay_by_link[link] - phase[clock]) % period[
                clock
            ]  # since the newest available packet
            is_after = comm_graph.links[link].after and delay_by_link[link] == 0
            if not waited and (is_after or rank("tick") < rank("deliver")):
                waited = period[clock]
            ages.append((link, delay_by_link[link] + waited + missed))
        result.append(tuple(ages))
    return tuple(result)


def _single_delay(
    model: Model,
    comm_graph: CommunicationGraph,
    timings: Mapping[str, Fraction],
    peer_type_index: int,
    link: str,
) -> str:
    """Return the timing of the delay with which all peers of a type receive from all others over a link.

    Raises
    ------
    ApcError
        E811 several delays, or packets at several clocks.
    """
    receivers = [index for index, group in enumerate(model.groups) if group.peer_type == peer_type_index]
    delay_names = {
        comm_graph.delay(link, sender, receiver)
        for receiver in receivers
        for sender in range(len(model.groups))
        if sender != receiver or model.groups[sender].count > 1
    }
    delay_names = delay_names or {comm_graph.default_delay[link]}
    if len({(timings[name], comm_graph.links[link].clock_at(name)) for name in delay_names}) > 1:
        names = ", ".join(sorted(delay_names))
        message = (
            f"the age of samples received by {model.peer_types[peer_type_index].name} over {link} differs "
            f"between senders ({names}); different ages can be simulated but not analyzed"
        )
        raise ApcError(Diagnostic("E811", SourceLocation(model.origin.topology), message, fix="apc simulate"))
    return min(delay_names)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _with_known_ages(peer_type: PeerType, partitions: tuple[tuple[_Ages, ...], ...]) -> PeerType:
    """Return a peer type with the ages of each clock's ticks inserted."""
    clocks = [
        _with_ages(partition, ages) if ages else partition
        for partition, ages in zip(peer_type.clocks, partitions, strict=True)
    ]
    return replace(peer_type, clocks=tuple(clocks))


def _with_ages(partition: ClockPartition, ages: Sequence[_Ages]) -> ClockPartition:
    """Return a clock partition with a column (variant) for each tick with different ages."""
    distinct_ages = list(dict.fromkeys(ages))
    x, u, m, _, p, t = _symbols(partition.tick)
    receives: list[Receive] = []
    rows: list[list[_Row]] = [[] for _ in distinct_ages]  # by variant
    for receive in partition.receives:
        indices: dict[Fraction, int] = {}
        for variant_rows, tick_ages in zip(rows, distinct_ages, strict=True):
            age = dict(tick_ages).get(receive.link, Fraction(0))
            constant = float(age) if receive.age == "alone" else None
            if receive.age == "edge":
                constant = _own_edge_value(receive, age, x, u, m, p, t)
            if constant is not None:
                variant_rows.append((constant, ()))
                continue
            key = age if receive.age == "edge" else Fraction(0)
            if key not in indices:
                indices[key] = len(receives)
                receives.append(_receive_at_age(receive, age))
            variant_rows.append((0, ((indices[key], float(age) if receive.age == "factor" else 1),)))
    r = type(x).sym("r", len(receives))
    values = [partition.tick(x, u, m, _tick_inputs(row, r), p, t) for row in rows]
    variant_of = {tick_ages: index for index, tick_ages in enumerate(distinct_ages)}
    return replace(
        partition,
        receives=tuple(receives),
        tick=_like_function(partition.tick, [x, u, m, r, p, t], casadi.vertcat(*values)),
        variants=tuple(variant_of[tick_ages] for tick_ages in ages) if len(distinct_ages) > 1 else (),
    )


# The replacement of a receive: a value, and rows of r with their factors.
_Row = tuple[Any, tuple[tuple[int, Any], ...]]


def _tick_inputs(rows: Sequence[_Row], r: Any) -> Any:
    """Return the inputs of a tick: each a value plus rows of r times their factors."""
    return casadi.vertcat(*(sum((weight * r[k] for k, weight in terms), start) for start, terms in rows))


def _own_edge_value(receive: Receive, age: Fraction, *arguments: Any) -> Any | None:
    """Return the value of an edge function that depends on the receiving peer alone, at an age; else None.

    The value is the same for all senders: its mean, maximum or minimum is the function itself. A sum is
    compiled as a mean.
    """
    edge: Any = receive.edge
    x, u, m, s, p, t = _symbols(edge)
    sent = casadi.vertcat(s[: s.numel() - 1], float(age))
    if casadi.depends_on(edge(x, u, m, sent, p, t), s):
        return None
    return edge(*arguments[:3], casadi.vertcat(casadi.DM.zeros(s.numel() - 1), float(age)), *arguments[3:])


def _receive_at_age(receive: Receive, age: Fraction) -> Receive:
    """Return a receive step for packets of one age, in seconds.

    An edge function that has the age as an input gets this constant; otherwise the use of the age is removed.
    """
    if receive.age != "edge":
        return replace(receive, age="")
    edge: Any = receive.edge
    symbols = _symbols(edge)
    sent = casadi.SX.sym("s", symbols[3].numel() - 1)
    value = edge(*symbols[:3], casadi.vertcat(sent, float(age)), *symbols[4:])
    edge_at_age = _like_function(edge, [*symbols[:3], sent, *symbols[4:]], value)
    return replace(receive, name=f"{receive.name} at {float(age):.9g} s", edge=edge_at_age, age="")


# ---- every packet contains its time of sending ----


def stamped(model: Model) -> Model:
    """Return a model whose packets contain time stamps, from which its ages are computed.

    For each channel that is weighted by its age, a second channel sends the product with the time of sending.
    """
    if not aged(model):
        return model
    channels_by_link: dict[str, dict[str, None]] = {}
    for peer_type in model.peer_types:
        channels = {sending.link: sending.channels for sending in peer_type.sends}
        for receive in (
            receive for partition in peer_type.clocks for receive in partition.receives if receive.age
        ):
            channel = channels[receive.link][receive.channel] if receive.age == "factor" else ""
            channels_by_link.setdefault(receive.link, {})[channel] = None
    stamped_channels = tuple((link, tuple(names)) for link, names in channels_by_link.items())
    return replace(
        model,
        peer_types=tuple(_stamped_peer_type(peer_type, stamped_channels) for peer_type in model.peer_types),
    )


@functools.lru_cache(maxsize=CACHE_SIZE)
def _stamped_peer_type(
    peer_type: PeerType, stamped_channels: tuple[tuple[str, tuple[str, ...]], ...]
) -> PeerType:
    """Return a peer type whose packets contain stamps, and given channels times their time of sending."""
    channels_by_link = dict(stamped_channels)
    sends = tuple(
        _with_stamp_channels(send, channels_by_link[send.link]) if send.link in channels_by_link else send
        for send in peer_type.sends
    )
    channels = {send.link: send.channels for send in sends}
    return replace(
        peer_type,
        sends=sends,
        clocks=tuple(
            _with_ages_from_stamps(clock, channels)
            if any(receive.age for receive in clock.receives)
            else clock
            for clock in peer_type.clocks
        ),
    )


def _stamp_name(channel: str) -> str:
    """Return the name of the channel that sends the time of sending, or its product with a channel."""
    return f"{STAMP}*{channel}" if channel else STAMP


def _with_stamp_channels(sending: SendPartition, stamped_channels: Sequence[str]) -> SendPartition:
    """Return a send with additional channels for stamps."""
    x, u, p, t = _symbols(sending.send)
    sent = sending.send(x, u, p, t)
    stamps = [t * sent[sending.channels.index(text)] if text else t for text in stamped_channels]
    return replace(
        sending,
        channels=(*sending.channels, *map(_stamp_name, stamped_channels)),
        units=(*sending.units, *("s" for _ in stamped_channels)),
        send=_like_function(sending.send, [x, u, p, t], casadi.vertcat(sent, *stamps)),
    )


def _with_ages_from_stamps(
    partition: ClockPartition, channels: Mapping[str, tuple[str, ...]]
) -> ClockPartition:
    """Return a clock partition that computes ages from received stamps.

    `channels` are the names of each link's channels, stamps included.
    """
    x, u, m, _, p, t = _symbols(partition.tick)
    receives: list[Receive] = []
    rows: list[_Row] = []
    for receive in partition.receives:
        channel_names = channels[receive.link]
        without_age = replace(receive, age="")
        if receive.age == "factor":
            stamped_too = replace(
                without_age, channel=channel_names.index(_stamp_name(channel_names[receive.channel]))
            )
            row: _Row = (0, ((len(receives), t), (len(receives) + 1, -1)))
            receives += [without_age, replace(stamped_too, name=f"{STAMP} of {receive.name}")]
        elif receive.age == "alone":
            row = (t, ((len(receives), -1),))
            receives.append(replace(without_age, channel=channel_names.index(STAMP)))
        else:
            row = (0, ((len(receives), 1),))
            edge = _edge_from_stamp(receive.edge, channel_names.index(STAMP)) if receive.age else receive.edge
            receives.append(replace(without_age, edge=edge))
        rows.append(row)
    r = type(x).sym("r", len(receives))
    tick = _like_function(
        partition.tick, [x, u, m, r, p, t], partition.tick(x, u, m, _tick_inputs(rows, r), p, t)
    )
    return replace(partition, receives=tuple(receives), tick=tick)


def _edge_from_stamp(edge: Any, stamp: int) -> Any:
    """Return an edge function that computes the age from a stamp in the packet."""
    x, u, m, s, p, t = _symbols(edge)
    sent = casadi.SX.sym("s", stamp + 1)
    value = edge(x, u, m, casadi.vertcat(sent[: s.numel() - 1], t - sent[stamp]), p, t)
    return _like_function(edge, [x, u, m, sent, p, t], value)


def _symbols(function: Any) -> list[Any]:
    """Return symbols for a function's arguments: SX, or MX for a function that contains a solver."""
    symbol_type = casadi.SX if function.is_a("SXFunction") else casadi.MX
    return [symbol_type.sym(name, function.numel_in(index)) for index, name in enumerate(function.name_in())]


def _like_function(original: Any, symbols: Sequence[Any], value: Any) -> Any:
    """Return a function of the given symbols and value, with the argument names of another function."""
    return casadi.Function(
        original.name(), list(symbols), [casadi.densify(value)], original.name_in(), original.name_out()
    )
