"""What of a kind matters: what can reach the motion or the network, and what that reads.

Takes: the structural pattern of a kind.
Gives: `live_outputs`, `live_holds`, `live_receives`.
Guarantees: structure alone decides; no number makes anything live or dead.
Does not: know other peers, or when anything happens.
"""

from __future__ import annotations

from apc.frame.site import LinearSite


def live_outputs(pattern: LinearSite) -> frozenset[tuple[int, int]]:
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


def live_holds(pattern: LinearSite, live: frozenset[tuple[int, int]]) -> tuple[bool, ...]:
    """Say of each hold whether anybody reads it."""
    return tuple(
        bool(
            pattern.b[:, h].any()
            or any(send.u[:, h].any() for send in pattern.sends)
            or any(pattern.ticks[partition].u[output, h] for partition, output in live)
        )
        for h in range(len(pattern.kind.holds))
    )


def live_receives(pattern: LinearSite, live: frozenset[tuple[int, int]]) -> frozenset[tuple[int, int]]:
    """Return the (partition, receive) pairs that a live output reads."""
    return frozenset(
        (partition, int(row))
        for partition, output in live
        for row in pattern.ticks[partition].r[output].nonzero()[0]
    )
