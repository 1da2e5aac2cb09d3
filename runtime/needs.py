"""What a scene needs: the states, delays and packets its analysis keeps, and nothing else.

Takes: a `CompiledSystem`. Gives: `Needs`.
Guarantees: the counts are those of the systems that are analysed.
Does not: analyse.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.runtime.analysis import Prepared, lifted_groups, prepare
from apc.runtime.linearize import edge_name
from apc.runtime.modes import split
from apc.runtime.trouble import finite_equations


@dataclass(frozen=True, slots=True)
class SiteNeeds:
    """What one peer of a kind keeps from frame to frame."""

    name: str
    motion: int
    remembered: int
    packets: int

    @property
    def states(self) -> int:
        """All of it together."""
        return self.motion + self.remembered + self.packets

    def __str__(self) -> str:
        """Return it in words."""
        parts = [f"{self.motion} motion"]
        if self.remembered:
            parts.append(f"{self.remembered} delayed force")
        if self.packets:
            parts.append(f"{self.packets} network")
        return f"{self.states} states a peer ({', '.join(parts)})"


@dataclass(frozen=True, slots=True)
class Needs:
    """What a scene keeps: `sites` one a kind, `ticks` of each clock in a frame, `systems` as (count, size).

    `refused` says why there are no systems, where there are none; `pairs` names the receives that are
    evaluated once a pair of peers.
    """

    peers: int
    frame: Fraction  # s
    sites: tuple[SiteNeeds, ...]
    ticks: tuple[tuple[str, int], ...]
    systems: tuple[tuple[int, int], ...]
    refused: str
    pairs: tuple[str, ...]

    def __str__(self) -> str:
        """Return it in one sentence."""
        sites = "; ".join(f"{site.name}: {site}" if len(self.sites) > 1 else str(site) for site in self.sites)
        whole = self.peers > 1 and sum(count for count, _ in self.systems) == 1
        noun = "system" if whole else "mode"
        systems = " and ".join(
            f"{count} {noun}{'' if count == 1 else 's'} of {size}" for count, size in self.systems
        )
        analysed = f"not analysed: {self.refused}" if self.refused else f"analysed as {systems}"
        pairs = "".join(f"; costs N²: {name} is evaluated once a pair of peers" for name in self.pairs)
        return f"{sites}, {self.peers} peer{'' if self.peers == 1 else 's'}; {analysed}{pairs}"


def needs(system: CompiledSystem) -> Needs:
    """Count what a scene keeps from frame to frame."""
    with finite_equations(system.name):
        return _needs(system)


def _needs(system: CompiledSystem) -> Needs:
    prepared = prepare(system)
    schedule_of = {
        group.kind: schedule
        for group, schedule in reversed(list(zip(system.groups, prepared.schedules, strict=True)))
    }
    sites = tuple(
        SiteNeeds(
            kind.name, len(kind.states), len(schedule_of[place].carried), sum(schedule_of[place].depths)
        )
        for place, kind in enumerate(system.kinds)
    )
    try:
        systems, refused = _systems(system, prepared), ""
    except ApcError as error:  # a scene that can't be analysed may still be run
        systems, refused = (), error.mistakes[0].sentence
    frame = prepared.schedules[0].frame_s
    return Needs(
        system.peers,
        frame,
        sites,
        tuple((clock.name, int(frame / prepared.timings[clock.period])) for clock in system.clocks),
        systems,
        refused,
        tuple(
            dict.fromkeys(
                receive.name
                for kind in system.kinds
                for partition in kind.clocks
                for receive in partition.receives
                if edge_name(partition, receive) and receive.operator != "count"
            )
        ),
    )


def _systems(system: CompiledSystem, prepared: Prepared) -> tuple[tuple[int, int], ...]:
    """Return how many systems of which size are analysed."""
    found: dict[int, int] = {}
    with np.errstate(over="ignore", invalid="ignore"):  # the sizes count here, not the numbers
        systems = split(*lifted_groups(system, prepared=prepared)).systems
    for closed in systems:
        size = len(closed.names)
        found[size] = found.get(size, 0) + 1
    return tuple((count, size) for size, count in found.items())
