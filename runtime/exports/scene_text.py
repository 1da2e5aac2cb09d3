"""Several peers in one C text, and the packets between them; or one peer that hears from outside.

Takes: what the peers of a scene do in a frame. Gives: `CScene`, `c_scene`, `one_peer`; `shared`;
`CVariable`.
Guarantees: time counts in whole quanta; of what happens at once all sends come first, then what is heard,
then ticks, as everywhere; a value is looked at as it is just before an instant's ticks, as in a row of
`simulate`. The luck of each packet is the one that `simulate` draws, from the scene's seed, and so is the
packet in effect at every tick.
Does not: know how a simulator calls it (see `fmu`).

What a scene remembers is one struct, `model`, that can be copied: no pointer is in it. What goes on a way by
chance is kept until it has come: then it is in effect if it was sent after what is (or came after it, as the
link says), and what got lost is missed from when it should have come. What stands in every text is in
the templates `scene.c`, `site.c`, `link.c`, `delay.c`, `chance.c` and `way.h` beside this module.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from apc.exports.c_text import memory, parameter_units
from apc.exports.identifiers import identifier, prefixed
from apc.exports.peer_step import (
    MOST_HEARD,
    ExportedPeer,
    first_packet,
    lines_of,
    peer_of,
    refused,
    sites_of,
)
from apc.exports.pushed import FORCE_ON
from apc.network.channel import luck_key
from apc.network.timetable import ArrivalProcess, luck_of
from apc.simulation.settings import Method
from apc.simulation.simulation import SimulationPlan

MOST_WAYS = 20_000  # from peer to peer in one text: each is a number of a table


@dataclass(frozen=True, slots=True)
class CVariable:
    """What can be looked at: its name as `simulate` has it, unit, and the member of `model` that holds it.

    Its `role` is "input" or "flag" (0 or 1) of what comes from outside, and is `start` until something does;
    "state" or "parameter" of what is `start` as the scene begins if nothing else is set until then; "output".
    """

    name: str
    unit: str
    member: str
    role: str = "output"
    start: float = 0.0

    @property
    def given(self) -> bool:
        """Whether it comes from outside."""
        return self.role in ("input", "flag")


@dataclass(frozen=True, slots=True)
class CLink:
    """A link in a scene, called `name` in C: its period, phase and the channels of its packets.

    `ring` packets of each peer are kept; `start` (peers, channels) is what is heard before the first arrives.
    `ways` are (sender, receiver), those of a receiver in the order in which it hears them; `delays` are
    theirs, in s. `luck` is None where every packet takes its delay; otherwise `key` is that of its numbers,
    and up to `kept` packets of each way are.
    """

    link: str
    name: str
    period: int
    phase: int
    channels: tuple[str, ...]
    ring: int
    start: tuple[tuple[float, ...], ...]
    ways: tuple[tuple[int, int], ...]
    delays: tuple[Fraction, ...]
    luck: ArrivalProcess | None
    key: tuple[int, int]
    kept: int


@dataclass(frozen=True, slots=True, eq=False)
class CScene:
    """A scene in C. Of each of `peers`, `site` is its place among `codes`, `place` among those of its site.

    Without `links` what is heard comes from outside.
    """

    name: str
    quantum: Fraction
    codes: tuple[ExportedPeer, ...]
    peers: tuple[tuple[int, int], ...]
    links: tuple[CLink, ...]
    variables: tuple[CVariable, ...]


def one_peer(plan: SimulationPlan, number: int, method: Method) -> CScene:
    """Return one peer, its device with it, that hears from outside. Raises ApcError as `peer_of`."""
    peer = peer_of(plan, number, method)
    variables = []
    for line in peer.lines:
        for k, sender in enumerate(line.senders):
            label, member = f"{line.link}.{sender.name}", f"in0[0].{line.name}[{k}]"
            variables += [
                CVariable(f"{label}.{entry.name}", entry.unit, f"{member}.{entry.member}", "input", start)
                for entry, start in zip(line.packet, sender.start, strict=True)
            ]
            if line.missing:
                flag = CVariable(f"{label}.missing", "1", f"{member}.missing", "flag")
                variables.append(flag)
    variables += [
        CVariable(f"{line.link}.{entry.name}", entry.unit, f"out0[0].{line.name}.{entry.member}")
        for line in peer.sending
        for entry in line.packet
    ]
    variables += _looked_at(peer, "peer0[0]", "")
    variables.sort(key=lambda variable: not variable.given)
    return CScene(peer.identifier, peer.schedule.quantum, (peer,), ((0, 0),), (), tuple(variables))


def _looked_at(peer: ExportedPeer, member: str, prefix: str) -> list[CVariable]:
    """Return what can be looked at of a peer that a member of `model` is."""
    variables = []
    for signal in peer.signals:
        began = ("state", peer.start[signal.place[0]]) if signal.role == "state" else ()
        own = f"{member}.{memory(peer, signal)}"
        if not signal.name.startswith(FORCE_ON):
            variables.append(CVariable(prefix + signal.name, signal.unit, own, *began))
    units = parameter_units(peer)
    for k, place in enumerate(peer.settable):
        name, start, own = peer.kind.parameters[place], float(peer.parameters[place]), f"{member}.p[{k}]"
        if name.startswith(FORCE_ON):
            name = f"{FORCE_ON}{prefix}{name.removeprefix(FORCE_ON)}"
            variables.append(CVariable(name, "N", own, "input", start))
        else:
            variables.append(CVariable(prefix + name, units[name], own, "parameter", start))
    return variables


def c_scene(plan: SimulationPlan, method: Method) -> CScene:
    """Return a whole scene.

    Raises
    ------
    ApcError
        E960 it has more ways than fit a text; and as `peer_of`, `luck_of`.
    """
    system, exchange = plan.system, plan.exchange
    total = exchange.peers * (exchange.peers - 1) if any(map(exchange.is_complete, exchange.links)) else 0
    if max(total, exchange.peers) > MOST_WAYS:
        what = f"{exchange.peers:,} peers hear each other on {total:,} ways; {MOST_WAYS:,} fit a text of C"
        alone = f'--peer "{exchange.peer_name(0)}"' if exchange.peers <= MOST_HEARD else "fewer peers"
        raise refused(system, what, alone)
    first = sites_of(plan)
    sites = [*dict.fromkeys(first)]
    # The place of a site keeps `a[1]` and `A[1]` distinct, and `a_1_link_b` of a link from that of a peer.
    names = [f"site{k}_{identifier(exchange.peer_name(site))}" for k, site in enumerate(sites)]
    codes = tuple(peer_of(plan, site, method, name=name) for site, name in zip(sites, names, strict=True))
    placed: Counter[int] = Counter()
    peers = []
    for number in map(sites.index, first):
        peers.append((number, placed[number]))
        placed[number] += 1
    quantum = codes[0].schedule.quantum
    variables = [
        variable
        for k, (site, place) in enumerate(peers)
        for variable in _looked_at(codes[site], f"peer{site}[{place}]", f"{exchange.peer_name(k)}.")
    ]
    variables.sort(key=lambda variable: not variable.given)
    links = _links(plan, quantum)
    return CScene(identifier(system.name), quantum, codes, tuple(peers), links, tuple(variables))


def _links(plan: SimulationPlan, quantum: Fraction) -> tuple[CLink, ...]:
    """Return the links of a scene; times count in quanta, in s."""
    exchange, timings = plan.exchange, plan.numbers.timings
    used: dict[str, dict[str, None]] = {}
    ways: dict[str, list[tuple[int, int]]] = {}
    for peer in range(exchange.peers):
        for line in lines_of(plan, peer)[0]:
            used.setdefault(line.link, {}).update(dict.fromkeys(line.channels))
            ways.setdefault(line.link, []).extend((sender.peer, peer) for sender in line.senders)
    clocks = {clock.name: clock for clock in plan.system.clocks}
    links = []
    for name, (link, channels) in zip(prefixed("link", used), used.items(), strict=True):
        clock = clocks[exchange.links[link].clock]
        period, phase = (int(timings[text] / quantum) for text in (clock.period, clock.phase))
        delays = [
            timings[exchange.delay(link, *(exchange.group_of(number) for number in way))]
            for way in ways[link]
        ]
        lucks = [
            (luck_of(plan.system, timings, exchange, route, quantum), route)
            for route in plan.routes
            if route.link == link
        ]
        kept = max((luck.kept(route) for luck, route in lucks), default=0)
        latest = int(max(delays, default=Fraction(0)) / quantum)
        links.append(
            CLink(
                link=link,
                name=f"sent_{name}",
                period=period,
                phase=phase,
                channels=tuple(channels),
                ring=max(latest // period + 2, kept + 1),
                start=tuple(first_packet(plan, link, peer, [*channels]) for peer in range(exchange.peers)),
                ways=tuple(ways[link]),
                delays=tuple(delays),
                luck=lucks[0][0] if lucks else None,
                key=luck_key(link, plan.system.experiment.seed, 0),
                kept=kept,
            )
        )
    return tuple(links)


def shared(scene: CScene) -> dict[str, Any]:
    """Return what the template `scene.c` is of, the text that plays a scene beside the peers' own texts.

    It has `static void begin(model *m)` and `static void run(model *m, long long until)`, which goes until an
    instant has come and what is sent at it has gone out.

    Of each site there are its code, its peers' numbers, and the links that it has, with its line and where
    each entry of its packets is among the link's channels.
    """
    sites = []
    for s, code in enumerate(scene.codes):
        lines = {line.link: line for line in code.lines}
        linked = [
            (
                link,
                lines[link.link],
                [(link.channels.index(entry.name), entry.member) for entry in lines[link.link].packet],
            )
            for link in scene.links
            if link.link in lines
        ]
        sites.append((code, [peer for peer, (site, _) in enumerate(scene.peers) if site == s], linked))
    return {
        "scene": scene,
        "sites": sites,
        "lucky": [link for link in scene.links if link.luck],
        "quanta": lambda link: [int(delay / scene.quantum) for delay in link.delays],
        "first": lambda link, numbers: map([item for _, item in link.ways].index, numbers),
    }
