"""The peers that are present at each instant of a simulation.

Takes: the first and the last instant of each peer; a model.
Gives: `Presence`, `first_peers`, `always_present`, `stored_names`; `refuse_joins_and_leaves`, `location_of`.
Guarantees: a peer is present from its join until just before its leave.
Does not: read or check the instants (see the extension `changing_counts`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerTime, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.simulation.signals import Signal

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Presence:
    """The instants in quanta from which (`joins`) and until which (`leaves`) each peer is present, (N,).

    `first_peers` is the index of the first peer of each group.
    """

    joins: Integers
    leaves: Integers
    first_peers: dict[str, int]

    def at(self, instants: Integers) -> Flags:
        """Return which peers are present at some instants (n, N)."""
        return (self.joins <= instants[:, None]) & (instants[:, None] < self.leaves)

    def changes(self, last: int) -> Integers:
        """Return the instants after time 0 and until `last` at which peers join or leave, in rising order."""
        instants = np.unique(np.concatenate([self.joins, self.leaves]))
        return instants[(instants > 0) & (instants <= last)]

    def of(self, signals: Sequence[Signal], instants: Integers) -> Flags:
        """Return whether the peers of some signals are present at some instants (n, signals)."""
        peers = [self.first_peers[signal.group] + signal.peer - 1 for signal in signals]
        return (self.joins[peers] <= instants[:, None]) & (instants[:, None] < self.leaves[peers])


def first_peers(model: Model) -> dict[str, int]:
    """Return the index of the first peer of each group."""
    starts = np.cumsum([0, *(group.count for group in model.groups)]).tolist()
    return {group.name: start for group, start in zip(model.groups, starts, strict=False)}


def always_present(model: Model) -> Model:
    """Return a model without joins and leaves: all its peers are always present."""
    return replace(model, experiment=replace(model.experiment, joins=(), leaves=()))


def stored_names(peer_type: PeerType) -> list[str]:
    """Return the names of the states, the held outputs and the stored values of a peer."""
    names = [state.name for state in peer_type.states]
    for partition in peer_type.clocks:
        held = (hold.output for hold in peer_type.holds if hold.clock == partition.clock)
        names += [partition.outputs[output] for output in (*partition.memories, *held)]
    return names


def location_of(model: Model, key: str, item: PeerTime) -> SourceLocation:
    """Return the location of a join or leave (`key`): in the topology, or the option."""
    if item.line:
        return SourceLocation(model.origin.topology, item.line, item.column)
    return SourceLocation(f"--{key}")


def refuse_joins_and_leaves(model: Model, command: str) -> None:
    """Raise E914 if the experiment of a model has joins or leaves, which a command does not support."""
    for key, items in (("joins", model.experiment.joins), ("leaves", model.experiment.leaves)):
        if items:
            location = location_of(model, key, items[0])
            message = f"{key} are not available in {command}"
            raise ApcError(Diagnostic("E914", location, message, advice=f"remove {key}, or use apc simulate"))
