"""Some sites that hear one another, before their matrix is built; and how its state is laid out.

Takes: groups of equal peers, and what each weighs the packets of each other by.
Gives: `Loop`, `Coupling`; `Packet`, `StateLayout`, `lay_out`, `packet_places`.
Guarantees: the state holds, site by site, z and then the packets on their way, in order of row and age.
Does not: build a matrix (see `closing`); know where the weights come from (see `coupling`, `graph_loops`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from apc.eigen.graph_modes import Surd
from apc.eigen.peer_group import PeerGroup, states_of
from apc.frame.schedule import Way

# What site g hears of site h on a way: the weight on h's packet.
Coupling = Mapping[Way, tuple[tuple[Fraction, ...], ...]]


@dataclass(frozen=True, slots=True)
class Loop:
    """Some sites and what each hears of each, `coupling`: a closed system before its matrix is built.

    The whole holds it `multiplicity` times. `doubts` and `surds` as in `ClosedSystem`.
    """

    name: str
    multiplicity: int
    sites: tuple[PeerGroup, ...]
    coupling: Coupling
    doubts: Mapping[Way, float] = field(default_factory=dict)
    surds: Mapping[Way, Surd] = field(default_factory=dict)

    @property
    def packets(self) -> tuple[Packet, ...]:
        """The packets on their way, in order of state."""
        return tuple(
            Packet(h, row, lag)
            for h, group in enumerate(self.sites)
            for row, depth in enumerate(group.schedule.depths)
            for lag in range(1, depth + 1)
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the state."""
        return lay_out(self).names

    @property
    def states(self) -> int:
        """How many states there are."""
        return sum(states_of(group.schedule, group.jacobians) for group in self.sites)


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet that is still to be heard: row of s of site `site`, sent `lag` frames ago (1 or more)."""

    site: int
    row: int
    lag: int


@dataclass(frozen=True, slots=True)
class StateLayout:
    """The state of a closed system: where each site's part starts, its names, and where each packet is."""

    offsets: tuple[int, ...]
    names: tuple[str, ...]
    packets: tuple[Packet, ...]
    places: Mapping[Packet, int]


def lay_out(loop: Loop) -> StateLayout:
    """Lay out the state of a loop: site by site what it is made of, then its packets."""
    packets = loop.packets
    offsets: list[int] = []
    names: list[str] = []
    for h, group in enumerate(loop.sites):
        offsets.append(len(names))
        schedule = group.schedule
        own = list(group.lifted.z_names)
        for packet in packets:
            if packet.site == h:
                quanta = schedule.sent_times[packet.row] - packet.lag * schedule.frame
                when = float(quanta * schedule.quantum * 1000)
                own.append(f"{schedule.sent_names[packet.row]}({when:.6g} ms)")
        names += own if len(loop.sites) == 1 else [f"{group.name}.{name}" for name in own]
    places = packet_places(loop.sites, packets, offsets)
    return StateLayout(tuple(offsets), tuple(names), packets, places)


def packet_places(
    sites: Sequence[PeerGroup], packets: Sequence[Packet], offsets: Sequence[int]
) -> dict[Packet, int]:
    """Return where in the state each packet is."""
    following = [offset + len(group.lifted.z_names) for group, offset in zip(sites, offsets, strict=True)]
    places = {}
    for packet in packets:
        places[packet] = following[packet.site]
        following[packet.site] += 1
    return places
