"""What a scene needs: the states, delays and packets its analysis keeps, and nothing else.

Takes: a `CompiledSystem`. Gives: `Needs`.
Guarantees: the counts are those of the systems that are analysed.
Does not: analyse.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.compiled import CompiledSystem
from apc.runtime.analysis import prepare


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
    """What a scene keeps: `sites` one a kind, `ticks` a clock and frame, `systems` as (count, size)."""

    peers: int
    frame: Fraction  # s
    sites: tuple[SiteNeeds, ...]
    ticks: tuple[tuple[str, int], ...]
    systems: tuple[tuple[int, int], ...]

    def __str__(self) -> str:
        """Return it in one sentence."""
        sites = "; ".join(f"{site.name}: {site}" if len(self.sites) > 1 else str(site) for site in self.sites)
        systems = " and ".join(
            f"{count} mode{'' if count == 1 else 's'} of {size}" for count, size in self.systems
        )
        return f"{sites}, {self.peers} peer{'' if self.peers == 1 else 's'}; analysed as {systems}"


def needs(system: CompiledSystem) -> Needs:
    """Count what a scene keeps from frame to frame."""
    prepared = prepare(system)
    sites = tuple(
        SiteNeeds(kind.name, len(kind.states), len(schedule.carried), sum(schedule.depths))
        for kind, schedule in zip(system.kinds, prepared.schedules, strict=True)
    )
    sizes = [sites[group.kind].states for group in system.groups]
    systems: dict[int, int] = {sum(sizes): 1}
    for group, size in zip(system.groups, sizes, strict=True):
        if group.count > 1:
            systems[size] = systems.get(size, 0) + 1
    frame = prepared.schedules[0].frame_s
    return Needs(
        system.peers,
        frame,
        sites,
        tuple((clock.name, int(frame / prepared.timings[clock.period])) for clock in system.clocks),
        tuple((count, size) for size, count in systems.items()),
    )
