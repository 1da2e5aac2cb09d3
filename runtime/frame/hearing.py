"""Whom the receives of a group hear: over which ways, and which channel on each.

Takes: a `CompiledSystem`, the patterns of its kinds, the exchange, the receives that matter.
Gives: `Hearing`, `hearing_of`.
Guarantees: a way for each delay among the senders; nobody who doesn't send is on one.
Does not: know when anything is sent or heard.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from apc.compiler.compiled import CompiledSystem
from apc.frame.exchange import Exchange, check_mean
from apc.frame.jacobians import edge_name
from apc.frame.schedule import Way
from apc.frame.site import LinearSite

# For each clock partition and receive: the ways it hears, and the channel of the link on each.
Hearing = tuple[tuple[tuple[tuple[Way, str], ...], ...], ...]


def hearing_of(
    system: CompiledSystem,
    patterns: Sequence[LinearSite],
    exchange: Exchange,
    group: int,
    read: Sequence[frozenset[tuple[int, int]]],
) -> Hearing:
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
    everybody: list[tuple[tuple[tuple[Way, str], ...], ...]] = []
    for p, (partition, tick) in enumerate(zip(pattern.kind.clocks, pattern.ticks, strict=True)):
        own: list[tuple[tuple[Way, str], ...]] = []
        for place, (receive, channels) in enumerate(zip(partition.receives, tick.channels, strict=True)):
            if (p, place) not in read[system.groups[group].kind] or not channels:
                own.append(())
                continue
            names = _channels(system, group, receive.link)
            sending = [
                any(send.link == receive.link for send in system.kinds[one.kind].sends)
                for one in system.groups
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
                        Way(receive.operator, receive.link, delay, edge, names[c] if edge else ""),
                        names[c],
                    )
                    for delay in delays
                    for c in channels
                )
            )
        everybody.append(tuple(own))
    return tuple(everybody)


def _channels(system: CompiledSystem, group: int, link: str) -> tuple[str, ...]:
    """Return the names of a link's channels, as the group's own kind sends them, or else some other kind."""
    own = system.groups[group].kind
    kinds = [system.kinds[own], *system.kinds]
    return next(send.channels for kind in kinds for send in kind.sends if send.link == link)
