"""What of a scene matters: what can reach the motion or the network, what that reads, and whom it hears.

Takes: the structural patterns of a `Model`'s kinds, the exchange.
Gives: `live_outputs`, `live_holds`, `live_receives`; `ReceptionPattern`, `hearing_of`.
Guarantees: structure alone decides; no number makes anything live or dead. A way for each delay among the
senders; nobody who doesn't send is on one.
Does not: know when anything happens, is sent or heard.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.frame.exchange import CommunicationGraph, check_mean
from apc.frame.jacobians import edge_name
from apc.frame.schedule import CouplingTerm
from apc.frame.site import LinearSubsystem


def live_outputs(pattern: LinearSubsystem) -> frozenset[tuple[int, int]]:
    """Return the (partition, output) pairs that can reach the motion or the network."""
    kind = pattern.kind
    clocks = {partition.clock: index for index, partition in enumerate(kind.clocks)}
    live: set[tuple[int, int]] = set()
    holds = {h for h in range(len(kind.holds)) if pattern.b[:, h].any()}
    holds |= {h for send in pattern.sends for h in range(len(kind.holds)) if send.u[:, h].any()}
    size = -1
    while size != len(live) + len(holds):
        size = len(live) + len(holds)
        live |= {(clocks[kind.holds[h].clock], kind.holds[h].output) for h in holds}
        for partition, output in tuple(live):
            tick = pattern.ticks[partition]
            memories = kind.clocks[partition].memories
            live |= {(partition, memories[m]) for m in tick.m[output].nonzero()[0]}
            holds |= set(tick.u[output].nonzero()[0].tolist())
    return frozenset(live)


def live_holds(pattern: LinearSubsystem, live: frozenset[tuple[int, int]]) -> tuple[bool, ...]:
    """Say of each hold whether anybody reads it."""
    return tuple(
        bool(
            pattern.b[:, h].any()
            or any(send.u[:, h].any() for send in pattern.sends)
            or any(pattern.ticks[partition].u[output, h] for partition, output in live)
        )
        for h in range(len(pattern.kind.holds))
    )


def live_receives(pattern: LinearSubsystem, live: frozenset[tuple[int, int]]) -> frozenset[tuple[int, int]]:
    """Return the (partition, receive) pairs that a live output reads."""
    return frozenset(
        (partition, int(row))
        for partition, output in live
        for row in pattern.ticks[partition].r[output].nonzero()[0]
    )


# For each clock partition and receive: the ways it hears, and the channel of the link on each.
ReceptionPattern = tuple[tuple[tuple[tuple[CouplingTerm, str], ...], ...], ...]


def hearing_of(
    system: Model,
    patterns: Sequence[LinearSubsystem],
    exchange: CommunicationGraph,
    group: int,
    read: Sequence[frozenset[tuple[int, int]]],
) -> ReceptionPattern:
    """Return what the receives of a group hear.

    Parameters
    ----------
    system, exchange
        The compiled scene, and who hears whom.
    patterns, read
        The structural pattern of each kind, and its receives that matter (see `liveness`).
    group
        The group's place in the scene.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over nobody.
    """
    pattern = patterns[system.groups[group].kind]
    everybody: list[tuple[tuple[tuple[CouplingTerm, str], ...], ...]] = []
    for p, (partition, tick) in enumerate(zip(pattern.kind.clocks, pattern.ticks, strict=True)):
        own: list[tuple[tuple[CouplingTerm, str], ...]] = []
        for place, (receive, channels) in enumerate(zip(partition.receives, tick.channels, strict=True)):
            if (p, place) not in read[system.groups[group].kind] or not channels:
                own.append(())
                continue
            names = _channels(system, group, receive.link)
            sending = [
                any(send.link == receive.link for send in system.kinds[group.kind].sends)
                for group in system.groups
            ]
            senders = exchange.hears(receive.link, group, sending)
            if not senders and receive.operator != "sum":
                peer = int(exchange.starts[group])
                check_mean(exchange, peer, receive.link, receive.operator, False, Fraction(0))
            delays = dict.fromkeys(exchange.delay(receive.link, sender, group) for sender in senders)
            edge = edge_name(partition, receive)
            own.append(
                tuple(
                    (
                        CouplingTerm(
                            *(receive.operator, receive.link, delay, edge, names[c] if edge else ""),
                            before=receive.before,
                        ),
                        names[c],
                    )
                    for delay in delays
                    for c in channels
                )
            )
        everybody.append(tuple(own))
    return tuple(everybody)


def _channels(system: Model, group: int, link: str) -> tuple[str, ...]:
    """Return the names of a link's channels, as the group's own kind sends them, or else some other kind."""
    own = system.groups[group].kind
    kinds = [system.kinds[own], *system.kinds]
    return next(send.channels for kind in kinds for send in kind.sends if send.link == link)
