"""Liveness: the outputs, holds and receives that can affect the motion or the network.

Takes: the structural patterns of a `Model`'s peer types, the communication graph.
Gives: `live_outputs`, `live_holds`, `live_receives`; `ReceptionPattern`, `reception_of`.
Guarantees: structure alone decides, never a parameter value. There is one coupling term for each delay among
the senders, without peers that do not send.
Does not: know the instants of events.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.linearization.jacobians import edge_name
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.timing.communication_graph import CommunicationGraph, check_mean
from apc.timing.schedule import CouplingTerm


def live_outputs(pattern: LinearSubsystem) -> frozenset[tuple[int, int]]:
    """Return the (partition, output) pairs that can affect the motion or the network."""
    peer_type = pattern.peer_type
    clocks = {partition.clock: index for index, partition in enumerate(peer_type.clocks)}
    live: set[tuple[int, int]] = set()
    holds = {h for h in range(len(peer_type.holds)) if pattern.b[:, h].any()}
    holds |= {h for send in pattern.sends for h in range(len(peer_type.holds)) if send.u[:, h].any()}
    size = -1
    while size != len(live) + len(holds):
        size = len(live) + len(holds)
        live |= {(clocks[peer_type.holds[h].clock], peer_type.holds[h].output) for h in holds}
        for partition, output in tuple(live):
            tick = pattern.ticks[partition]
            memories = peer_type.clocks[partition].memories
            live |= {(partition, memories[m]) for m in tick.m[output].nonzero()[0]}
            holds |= set(tick.u[output].nonzero()[0].tolist())
    return frozenset(live)


def live_holds(pattern: LinearSubsystem, live: frozenset[tuple[int, int]]) -> tuple[bool, ...]:
    """Return whether each hold is used."""
    return tuple(
        bool(
            pattern.b[:, h].any()
            or any(send.u[:, h].any() for send in pattern.sends)
            or any(pattern.ticks[partition].u[output, h] for partition, output in live)
        )
        for h in range(len(pattern.peer_type.holds))
    )


def live_receives(pattern: LinearSubsystem, live: frozenset[tuple[int, int]]) -> frozenset[tuple[int, int]]:
    """Return the (partition, receive) pairs that a live output reads."""
    return frozenset(
        (partition, int(row))
        for partition, output in live
        for row in pattern.ticks[partition].r[output].nonzero()[0]
    )


# For each clock partition and receive: its coupling terms, and the channel of the link on each.
ReceptionPattern = tuple[tuple[tuple[tuple[CouplingTerm, str], ...], ...], ...]


def reception_of(
    model: Model,
    patterns: Sequence[LinearSubsystem],
    comm_graph: CommunicationGraph,
    group: int,
    read: Sequence[frozenset[tuple[int, int]]],
) -> ReceptionPattern:
    """Return the coupling terms and channels of each receive of a group.

    A receive that is not live has none.

    Parameters
    ----------
    model, comm_graph
        The compiled model and its communication graph.
    patterns, read
        The structural pattern of each peer type, and its live receives (see `liveness`).
    group
        The index of the group.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over no peers.
    """
    pattern = patterns[model.groups[group].peer_type]
    partitions: list[tuple[tuple[tuple[CouplingTerm, str], ...], ...]] = []
    for p, (partition, tick) in enumerate(zip(pattern.peer_type.clocks, pattern.ticks, strict=True)):
        receives: list[tuple[tuple[CouplingTerm, str], ...]] = []
        for index, (receive, channels) in enumerate(zip(partition.receives, tick.channels, strict=True)):
            if (p, index) not in read[model.groups[group].peer_type] or not channels:
                receives.append(())
                continue
            names = _channels(model, group, receive.link)
            is_sending = [
                any(send.link == receive.link for send in model.peer_types[sender.peer_type].sends)
                for sender in model.groups
            ]
            senders = comm_graph.receives(receive.link, group, is_sending)
            if not senders and receive.operator != "sum":
                peer = int(comm_graph.starts[group])
                check_mean(comm_graph, peer, receive.link, receive.operator, False, Fraction(0))
            delays = dict.fromkeys(comm_graph.delay(receive.link, sender, group) for sender in senders)
            edge = edge_name(partition, receive)
            clocks = {delay: comm_graph.links[receive.link].own_clock(delay) for delay in delays}
            receives.append(
                tuple(
                    (
                        CouplingTerm(
                            *(receive.operator, receive.link, delay, edge, names[c] if edge else ""),
                            before=receive.before,
                            clock=clocks[delay],
                        ),
                        names[c],
                    )
                    for delay in delays
                    for c in channels
                )
            )
        partitions.append(tuple(receives))
    return tuple(partitions)


def _channels(model: Model, group: int, link: str) -> tuple[str, ...]:
    """Return the names of a link's channels as the group's peer type sends them, else as the first type
    that sends.
    """
    own_type = model.groups[group].peer_type
    peer_types = [model.peer_types[own_type], *model.peer_types]
    return next(send.channels for peer_type in peer_types for send in peer_type.sends if send.link == link)
