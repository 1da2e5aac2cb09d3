"""Several peers in one C text with the packets between them; or one peer with external packets.

Takes: the frame plan of all peers. Gives: `CTopology`, `c_topology`, `single_peer`; `shared`; `CVariable`.
Guarantees: time is an integer number of quanta. Simultaneous events are ordered as in all engines: sends,
receptions, ticks. Values are read just before an instant's ticks, as in a row of `simulate`. The random
losses and delays are those of `simulate` for the experiment's seed, and so is the packet in effect at every
tick.
Does not: define the simulator interface (see `fmu`).

The state is one struct, `model`, without pointers, so it can be copied. A packet with a random delay is
stored until its arrival. It takes effect if it was sent (or, by the link's setting, arrived) after the
present one. A lost packet counts as missing from its nominal arrival. The fixed text is in the templates
`topology.c`, `subsystem.c`, `link.c`, `delay.c`, `channel_draw.c` and `arc.h` in this folder.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from apc.exports.c_text import memory, parameter_units
from apc.exports.external_force import FORCE_ON
from apc.exports.identifiers import identifier, prefixed
from apc.exports.peer_step import (
    MOST_RECEIVED,
    ExportedPeer,
    first_packet,
    lines_of,
    peer_of,
    refused,
    subsystems_of,
)
from apc.network.channel import ChannelLaw, channel_law, stream_key
from apc.network.packet_schedule import ArrivalProcess, arrival_process_of
from apc.simulation.settings import Method
from apc.simulation.simulation import SimulationPlan

MOST_ARCS = 20_000  # from peer to peer in one text: each is a number of a table


@dataclass(frozen=True, slots=True)
class CVariable:
    """A readable variable: its name as in `simulate`, unit, and the member of `model` that stores it.

    Its `role` is "input" or "flag" (0 or 1) for external values, equal to `start` until set; "state" or
    "parameter" for values equal to `start` at time 0 unless set before; else "output".
    """

    name: str
    unit: str
    member: str
    role: str = "output"
    start: float = 0.0

    @property
    def given(self) -> bool:
        """Whether the value is set from outside."""
        return self.role in ("input", "flag")


@dataclass(frozen=True, slots=True)
class CLink:
    """A link of the model with its C name `name`, its period, its phase and the channels of its packets.

    `ring` packets of each peer are stored; `start` (peers, channels) are the values used before the first
    packet arrives. `arcs` are (sender, receiver), grouped by receiver in order of reception; `delays` are the
    delays of these, in s. `arrival_process` is None for a reliable link; otherwise `laws` are its channel
    laws and `law_of` the index of each pair's law, `key` is its random-stream key, and up to `stored` packets
    per pair are stored.
    """

    link: str
    name: str
    period: int
    phase: int
    channels: tuple[str, ...]
    ring: int
    start: tuple[tuple[float, ...], ...]
    arcs: tuple[tuple[int, int], ...]
    delays: tuple[Fraction, ...]
    arrival_process: ArrivalProcess | None
    laws: tuple[ChannelLaw, ...]
    law_of: tuple[int, ...]
    key: tuple[int, int]
    stored: int


@dataclass(frozen=True, slots=True, eq=False)
class CTopology:
    """A model in C.

    `peers` are, for each peer, the index of its code in `codes` and its index within that code.

    Without `links` received values are external inputs.
    """

    name: str
    quantum: Fraction
    codes: tuple[ExportedPeer, ...]
    peers: tuple[tuple[int, int], ...]
    links: tuple[CLink, ...]
    variables: tuple[CVariable, ...]


def single_peer(plan: SimulationPlan, number: int, method: Method) -> CTopology:
    """Return one peer in C, with its device and external packets as inputs. Raises ApcError as `peer_of`."""
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
    variables += _variables_of(peer, "peer0[0]", "")
    variables.sort(key=lambda variable: not variable.given)
    return CTopology(peer.identifier, peer.schedule.quantum, (peer,), ((0, 0),), (), tuple(variables))


def _variables_of(peer: ExportedPeer, member: str, prefix: str) -> list[CVariable]:
    """Return the variables of a peer: signals, settable parameters and external forces."""
    variables = []
    for signal in peer.signals:
        role_and_start = ("state", peer.start[signal.index[0]]) if signal.role == "state" else ()
        c_member = f"{member}.{memory(peer, signal)}"
        if not signal.name.startswith(FORCE_ON):
            variables.append(CVariable(prefix + signal.name, signal.unit, c_member, *role_and_start))
    units = parameter_units(peer)
    for k, index in enumerate(peer.settable):
        name, start, c_member = (
            peer.peer_type.parameters[index],
            float(peer.parameters[index]),
            f"{member}.p[{k}]",
        )
        if name.startswith(FORCE_ON):
            name = f"{FORCE_ON}{prefix}{name.removeprefix(FORCE_ON)}"
            variables.append(CVariable(name, "N", c_member, "input", start))
        else:
            variables.append(CVariable(prefix + name, units[name], c_member, "parameter", start))
    return variables


def c_topology(plan: SimulationPlan, method: Method) -> CTopology:
    """Return a complete model in C.

    Raises
    ------
    ApcError
        E960 too many directed peer pairs; and as `peer_of`, `arrival_process_of`.
    """
    model, comm_graph = plan.model, plan.comm_graph
    total = (
        comm_graph.peers * (comm_graph.peers - 1) if any(map(comm_graph.is_complete, comm_graph.links)) else 0
    )
    if max(total, comm_graph.peers) > MOST_ARCS:
        message = (
            f"{comm_graph.peers:,} peers have {total:,} directed connections; the limit of the C export "
            f"is {MOST_ARCS:,}"
        )
        alone = f'--peer "{comm_graph.peer_name(0)}"' if comm_graph.peers <= MOST_RECEIVED else ""
        raise refused(model, message, alone)
    first = subsystems_of(plan)
    subsystems = [*dict.fromkeys(first)]
    # The index of a subsystem keeps `a[1]` and `A[1]` distinct, and `a_1_link_b` of a link and a peer.
    names = [
        f"site{k}_{identifier(comm_graph.peer_name(subsystem))}" for k, subsystem in enumerate(subsystems)
    ]
    codes = tuple(
        peer_of(plan, subsystem, method, name=name) for subsystem, name in zip(subsystems, names, strict=True)
    )
    counts: Counter[int] = Counter()
    peers = []
    for number in map(subsystems.index, first):
        peers.append((number, counts[number]))
        counts[number] += 1
    quantum = codes[0].schedule.quantum
    variables = [
        variable
        for k, (subsystem, index) in enumerate(peers)
        for variable in _variables_of(
            codes[subsystem], f"peer{subsystem}[{index}]", f"{comm_graph.peer_name(k)}."
        )
    ]
    variables.sort(key=lambda variable: not variable.given)
    links = _links(plan, quantum)
    return CTopology(identifier(model.name), quantum, codes, tuple(peers), links, tuple(variables))


def _links(plan: SimulationPlan, quantum: Fraction) -> tuple[CLink, ...]:
    """Return the links of a model in C, with times in quanta and delays in seconds."""
    comm_graph, timings = plan.comm_graph, plan.numbers.timings
    used: dict[str, dict[str, None]] = {}
    arcs: dict[str, list[tuple[int, int]]] = {}
    for peer in range(comm_graph.peers):
        for line in lines_of(plan, peer)[0]:
            used.setdefault(line.link, {}).update(dict.fromkeys(line.channels))
            arcs.setdefault(line.link, []).extend((sender.peer, peer) for sender in line.senders)
    clocks = {clock.name: clock for clock in plan.model.clocks}
    links = []
    for name, (link, channels) in zip(prefixed("link", used), used.items(), strict=True):
        names = [comm_graph.delay(link, *map(comm_graph.group_of, arc)) for arc in arcs[link]]
        delays, distinct = [timings[name] for name in names], [*dict.fromkeys(names)]
        declared = comm_graph.links[link]
        clock = clocks[declared.clock]
        period, phase = (int(timings[text] / quantum) for text in (clock.period, clock.phase))
        arrival_processes = [
            (arrival_process_of(plan.model, timings, comm_graph, route, quantum), route)
            for route in plan.routes
            if route.link == link
        ]
        stored = max(
            (arrival_process.stored(route) for arrival_process, route in arrival_processes), default=0
        )
        latest = int(max(delays, default=Fraction(0)) / quantum)
        links.append(
            CLink(
                link=link,
                name=f"sent_{name}",
                period=period,
                phase=phase,
                channels=tuple(channels),
                ring=max(latest // period + 2, stored + 1),
                start=tuple(first_packet(plan, link, peer, [*channels]) for peer in range(comm_graph.peers)),
                arcs=tuple(arcs[link]),
                delays=tuple(delays),
                arrival_process=arrival_processes[0][0] if arrival_processes else None,
                laws=tuple(channel_law(plan.model, declared, name) for name in distinct)
                if arrival_processes
                else (),
                law_of=tuple(map(distinct.index, names)),
                key=stream_key(link, plan.model.experiment.seed, 0),
                stored=stored,
            )
        )
    return tuple(links)


def shared(topology: CTopology) -> dict[str, Any]:
    """Return the data of the template `topology.c`, which executes a model together with the peers' texts.

    The template has `static void begin(model *m)` and `static void run(model *m, long long until)`, which
    executes up to and including the sends of an instant.

    For each subsystem the data are its code, its peers' indices, and its links, each with its `PeerLink` and
    the channel index of each packet entry.
    """
    subsystems = []
    for s, code in enumerate(topology.codes):
        lines = {line.link: line for line in code.lines}
        linked = [
            (
                link,
                lines[link.link],
                [(link.channels.index(entry.name), entry.member) for entry in lines[link.link].packet],
            )
            for link in topology.links
            if link.link in lines
        ]
        subsystems.append(
            (code, [peer for peer, (subsystem, _) in enumerate(topology.peers) if subsystem == s], linked)
        )
    return {
        "topology": topology,
        "subsystems": subsystems,
        "unreliable": [link for link in topology.links if link.arrival_process],
        "quanta": lambda link: [int(delay / topology.quantum) for delay in link.delays],
        "first": lambda link, numbers: map([item for _, item in link.arcs].index, numbers),
    }
