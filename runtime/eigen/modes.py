"""Close the loop between peers, as few small systems instead of one large one.

Takes: the groups of equal peers of a scene, and the exchange between them.
Gives: `Loop`, `arrange`, `complete_loops`, `dense_loop`, `graph_loop`; `ClosedSystem`, `close_loop`;
`Split`, `split`, `modes`, `dense`.
Guarantees: the systems of a split, each as often as its multiplicity says, have together the spectrum of
`dense`, whatever the number of peers.
Does not: compute eigenvalues (see `spectrum`).

On a complete graph a peer of group g hears r = c_g (Σ_j s_j − s_own), with c_g = 1/(others) for a mean and 1
for a sum. K groups of n_1 … n_K equal peers then split exactly:

    common        all peers of a group alike: r_g = c_g Σ_h (n_h − δ_gh) s_h        once
    difference g  peers of group g apart, their sum zero, all else at rest: r_g = −c_g s_g        n_g − 1
    times

Equal peers on any other graph, r = W s: one system an eigenvalue λ of W, r = λ s, as often as W holds it. A
complex pair λ = α ± iβ is one real system of two sites, r = [α −β; β α] s. Different peers on such a graph
are one whole system.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.runtime.eigen.peers import MOST_STATES, PeerGroup, states_of, too_large, used_ways
from apc.runtime.frame.discretize import UNIT
from apc.runtime.frame.exchange import Exchange, GraphMode, Surd, check_mean, graph_modes
from apc.runtime.frame.schedule import Way

Floats = NDArray[np.float64]

# What site g hears of site h on a way: the weight on h's packet.
Coupling = Mapping[Way, tuple[tuple[Fraction, ...], ...]]


@dataclass(frozen=True, slots=True)
class Split:
    """A whole system as independent ones; `method` is "modes" or "dense", `notes` say why."""

    method: str
    systems: tuple[ClosedSystem, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Arrangement:
    """A whole system as independent loops; `method` and `notes` as in `Split`."""

    method: str
    loops: tuple[Loop, ...]
    notes: tuple[str, ...]


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
        return _layout(self).names

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
class ClosedSystem:
    """One autonomous system: state⁺ = `matrix` · state, once a frame.

    The state holds, site by site, z and then the packets on their way; `names` names it, `offsets` says
    where each site's part starts, `packets` lists the packets in order of state (site by site). `error`
    bounds the rounding error of the matrix entry by entry. `inside` holds all continuous states (site by
    site) at the ticks of the fastest clock as rows over the state; `motion` says where these are in the
    state. `doubts` say by how much each weight of a way may be off; `surds`, of a system of one site, what
    its weights are in closed form.
    """

    name: str
    multiplicity: int
    sites: tuple[PeerGroup, ...]
    coupling: Coupling
    frame_s: float
    names: tuple[str, ...]
    offsets: tuple[int, ...]
    packets: tuple[Packet, ...]
    matrix: Floats  # (n, n)
    error: Floats  # (n, n)
    inside: Floats  # (marks, n_x of all sites, n)
    motion: tuple[int, ...]
    doubts: Mapping[Way, float] = field(default_factory=dict)
    surds: Mapping[Way, Surd] = field(default_factory=dict)


def split(groups: Sequence[PeerGroup], exchange: Exchange) -> Split:
    """Split the whole system into as few and small closed systems as its graphs and groups allow.

    Parameters
    ----------
    groups
        All peers, see `peers.peer_groups`.
    exchange
        The links.

    Raises
    ------
    ApcError
        E801, E802 a mean that can't be; E804 one system of too many states.
    """
    found = arrange(groups, exchange)
    for loop in found.loops:
        if loop.states > MOST_STATES:
            raise too_large(exchange, f"{exchange.peers:,} peers", loop.states)
    return Split(found.method, tuple(close_loop(loop) for loop in found.loops), found.notes)


def arrange(groups: Sequence[PeerGroup], exchange: Exchange) -> Arrangement:
    """Find the independent loops of a whole system: `split`, before any matrix is built.

    Parameters
    ----------
    groups, exchange
        As for `split`.
    """
    ways = used_ways(group.schedule for group in groups)
    graphs = list(dict.fromkeys(way.link for way in ways if not exchange.is_complete(way.link)))
    if not graphs:
        return Arrangement("modes", complete_loops(groups, exchange), ())
    named = " and ".join(f"{link} ({exchange.links[link].graph.shape})" for link in graphs)
    reason = f"the peers on {named} differ" if len(groups) > 1 else common_graph(ways, exchange)
    if not reason:
        scale = graph_scale(groups[0], ways, exchange)
        found = graph_modes(exchange.links[graphs[0]].graph, exchange.peers, mean=scale.by_mean)
        if found is not None:
            note = f"{len(found)} systems, one an eigenvalue of the graph of {named}"
            return Arrangement("modes", tuple(graph_loop(groups[0], one, scale) for one in found), (note,))
        reason = f"the graph of {named} has no full set of eigenvectors"
    return Arrangement("dense", (dense_loop(groups, exchange),), (f"all peers as one system: {reason}",))


def modes(groups: Sequence[PeerGroup], exchange: Exchange) -> tuple[ClosedSystem, ...]:
    """Close the loops of `complete_loops`."""
    return tuple(close_loop(loop) for loop in complete_loops(groups, exchange))


def complete_loops(groups: Sequence[PeerGroup], exchange: Exchange) -> tuple[Loop, ...]:
    """Split a system of complete graphs into a common loop and a difference loop a group of two or more.

    Parameters
    ----------
    groups
        All peers, see `peers.peer_groups`.
    exchange
        The links, all of them complete.
    """
    peers = sum(group.count for group in groups)
    degrees = _degrees(groups, exchange)
    weights = _couple(
        groups, exchange, lambda way, g, h: Fraction(groups[h].count - (1 if g == h else 0)), degrees
    )
    loops = [Loop("single" if peers == 1 else "common", 1, tuple(groups), weights)]
    for place, group in enumerate(groups):
        if group.count < 2:
            continue
        apart = _couple(groups, exchange, lambda way, g, h: Fraction(-1 if g == h else 0), degrees)
        own = {key: ((rows[place][place],),) for key, rows in apart.items()}
        name = "difference" if len(groups) == 1 else f"difference {group.name}"
        loops.append(Loop(name, group.count - 1, (group,), own))
    return tuple(loops)


def dense(groups: Sequence[PeerGroup], exchange: Exchange) -> ClosedSystem:
    """Assemble every peer of the whole system: the check on all else, at the cost of N³.

    Parameters
    ----------
    groups
        All peers, see `peers.peer_groups`.
    exchange
        The links.

    Raises
    ------
    ApcError
        E801, E802 a mean that can't be; E804 more than `MOST_STATES` states.
    """
    states = sum(group.count * states_of(group.schedule, group.jacobians) for group in groups)
    if states > MOST_STATES:
        raise too_large(exchange, f"{exchange.peers:,} peers", states)
    return close_loop(dense_loop(groups, exchange))


def dense_loop(groups: Sequence[PeerGroup], exchange: Exchange) -> Loop:
    """Return every peer of the whole system as one loop."""
    everyone = tuple(
        replace(group, name=exchange.peer_name(peer), count=1, peers=np.array([peer]))
        for peer, group in sorted(
            ((int(peer), group) for group in groups for peer in group.peers), key=lambda pair: pair[0]
        )
    )
    weights = {
        link: {
            (receiver, sender): Fraction(weight)
            for (sender, receiver), weight in zip(*(one.tolist() for one in exchange.arcs(link)), strict=True)
        }
        for link in exchange.links
    }
    degrees: dict[tuple[str, int], Fraction] = {}
    for link, entries in weights.items():
        for (receiver, sender), weight in entries.items():
            if everyone[sender].sends(link):
                degrees[link, receiver] = degrees.get((link, receiver), Fraction(0)) + weight
    coupling = _couple(
        everyone, exchange, lambda way, g, h: weights[way.link].get((g, h), Fraction(0)), degrees
    )
    return Loop("dense", 1, everyone, coupling)


def _degrees(groups: Sequence[PeerGroup], exchange: Exchange) -> dict[tuple[str, int], Fraction]:
    """Return how many others a peer of each group hears over each complete link."""
    degrees = {}
    for link in exchange.links:
        total = sum(group.count for group in groups if group.sends(link))
        for g, group in enumerate(groups):
            number = total - (1 if group.sends(link) else 0)
            if number:
                degrees[link, g] = Fraction(number)
    return degrees


def _couple(
    groups: Sequence[PeerGroup],
    exchange: Exchange,
    weigh: Callable[[Way, int, int], Fraction],
    degrees: Mapping[tuple[str, int], Fraction],
) -> Coupling:
    """Weigh each site's packets at each other, way by way.

    Parameters
    ----------
    groups
        The sites.
    exchange
        The links.
    weigh
        The weight of a packet of site h at site g in a plain sum.
    degrees
        What a mean is divided by, by link and site; who hears nobody has no entry.
    """
    coupling = {}
    for way in used_ways(group.schedule for group in groups):
        rows = []
        for g, group in enumerate(groups):
            hears = any(one.way == way for one in group.schedule.heard)
            if hears and way.operator == "mean":
                total = degrees.get((way.link, g))
                check_mean(
                    exchange, int(group.peers[0]), way.link, "mean", total is not None, total or Fraction(0)
                )
            row = []
            for h, sender in enumerate(groups):
                weight = weigh(way, g, h) if hears and sender.sends(way.link) else Fraction(0)
                if weight and exchange.delay(way.link, sender.role, group.role) == way.delay:
                    if way.operator == "mean":
                        weight /= degrees[way.link, g]
                    elif way.operator in ("max", "min"):  # the one it is taken from counts once
                        weight = Fraction(1 if weight > 0 else -1)
                    row.append(weight * group.gain(way, sender))
                else:
                    row.append(Fraction(0))
            rows.append(tuple(row))
        coupling[way] = tuple(rows)
    return coupling


def common_graph(ways: Sequence[Way], exchange: Exchange) -> str:
    """Return "" if the links' W are one graph, or else why they have not the same eigenvectors."""
    links = list(dict.fromkeys(way.link for way in ways))
    shapes = {exchange.links[link].graph.shape for link in links}
    listed = [exchange.links[link].graph for link in links]
    if len(shapes) > 1 or any(
        not np.array_equal(graph.arcs, listed[0].arcs) or not np.array_equal(graph.weights, listed[0].weights)
        for graph in listed
    ):
        return f"the graphs of {' and '.join(links)} are not the same"
    if len({way.operator == "mean" for way in ways}) > 1 and _degree(links[0], exchange) is None:
        return f"means and sums over {links[0]}, whose peers hear unequal weights"
    if any(way.operator in ("max", "min") for way in ways):
        return "who is the largest or smallest decides who is heard"
    return ""


def _degree(link: str, exchange: Exchange) -> Fraction | None:
    """Return the sum of the weights that every peer hears over a link, None when it differs."""
    pairs, weights = exchange.arcs(link)
    if np.all(weights == 1):
        counts = np.bincount(pairs[:, 1], minlength=exchange.peers)
        return Fraction(int(counts[0])) if np.all(counts == counts[0]) else None
    sums = [Fraction(0)] * exchange.peers
    for receiver, weight in zip(pairs[:, 1].tolist(), weights.tolist(), strict=True):
        sums[receiver] += Fraction(weight)
    return sums[0] if len(set(sums)) == 1 else None


@dataclass(frozen=True, slots=True)
class GraphScale:
    """What each way weighs a neighbour by, in units of W; `by_mean`: of the W whose rows add up to 1."""

    weights: Mapping[Way, Fraction]
    by_mean: bool


def graph_scale(group: PeerGroup, ways: Sequence[Way], exchange: Exchange) -> GraphScale:
    """Return how equal peers weigh their neighbours on the graph that all their ways share.

    Raises
    ------
    ApcError
        E801, E802 a mean that can't be.
    """
    link = ways[0].link
    means = any(way.operator == "mean" for way in ways)
    pairs, weights = exchange.arcs(link)
    if means:
        sums = np.bincount(pairs[:, 1], weights, minlength=exchange.peers)
        hears = np.bincount(pairs[:, 1], minlength=exchange.peers) > 0
        for peer in np.flatnonzero((sums == 0) | ~hears).tolist():
            total = sum(map(Fraction, weights[pairs[:, 1] == peer].tolist()), Fraction(0))
            check_mean(exchange, peer, link, "mean", bool(hears[peer]), total)
    degree = _degree(link, exchange)
    return GraphScale(
        {
            way: group.gain(way, group) / (degree if degree and way.operator == "mean" else Fraction(1))
            for way in ways
        },
        means and degree is None,
    )


def graph_loop(group: PeerGroup, mode: GraphMode, scale: GraphScale) -> Loop:
    """Let one site hear itself by an eigenvalue, or two by a complex pair."""
    a, b = mode.real, mode.imaginary
    weights = scale.weights
    doubts = {way: float(abs(one)) * mode.doubt for way, one in weights.items()}
    name = "common" if mode.common else f"graph {mode.value.real:+.6g}"
    if not b:
        coupling: Coupling = {way: ((one * a,),) for way, one in weights.items()}
        surds: Mapping[Way, Surd] = {}
        if mode.doubt and mode.surd:
            surd = mode.surd
            surds = {way: replace(surd, scale=one * surd.scale) for way, one in weights.items()}
        return Loop(name, mode.multiplicity, (group,), coupling, doubts, surds)
    pair = {way: ((one * a, -one * b), (one * b, one * a)) for way, one in weights.items()}
    sites = tuple(replace(group, name=part) for part in ("real", "imaginary"))
    return Loop(f"{name} ± {mode.value.imag:.6g}i", mode.multiplicity, sites, pair, doubts)


def close_loop(loop: Loop) -> ClosedSystem:
    """Let K sites hear each other: r_g = Σ_h W_gh s_h, each packet as old as its receiver finds it.

    Notes
    -----
    Packets heard in the frame they are sent in make a loop within the frame, s = S z + D r and r = W₀ s + …,
    that time orders: D W₀ is nilpotent, and I − D W₀ is solved exactly by as many steps as there are packets.
    """
    lifted = [group.lifted for group in loop.sites]
    layout = _layout(loop)
    exact = [(site.p, site.q, site.s, site.d) for site in lifted]
    matrix, heard = _closed(exact, _links(loop, layout, lambda weight, _: float(weight)), layout)
    marks = min(len(site.inside) for site in lifted)
    inside = np.zeros((marks, sum(site.continuous for site in lifted), len(layout.names)))
    motion: list[int] = []
    for site, offset, r in zip(lifted, layout.offsets, heard, strict=True):
        n_z = len(site.z_names)
        rows = slice(len(motion), len(motion) + site.continuous)
        inside[:, rows, offset : offset + n_z] = site.inside[:, :, :n_z]
        inside[:, rows] += site.inside[:, :, n_z:] @ r
        motion += range(offset, offset + site.continuous)
    return ClosedSystem(
        name=loop.name,
        multiplicity=loop.multiplicity,
        sites=loop.sites,
        coupling=loop.coupling,
        frame_s=lifted[0].frame_s,
        names=layout.names,
        offsets=layout.offsets,
        packets=layout.packets,
        matrix=matrix,
        error=_closing_errors(loop, layout, exact),
        inside=inside,
        motion=tuple(motion),
        doubts=loop.doubts,
        surds=loop.surds,
    )


def _closing_errors(loop: Loop, layout: _Layout, exact: Sequence[Sequence[Floats]]) -> Floats:
    """Return bounds on the errors of a closed matrix, entry by entry: its sites', its weights' and rounding.

    The magnitudes, and the magnitudes with their errors: the difference bounds the error to all orders.
    """
    lifted = [group.lifted for group in loop.sites]
    large = [tuple(np.abs(block) for block in blocks) for blocks in exact]
    wide = [
        tuple(
            block + error
            for block, error in zip(
                blocks, (site.p_error, site.q_error, site.s_error, site.d_error), strict=True
            )
        )
        for blocks, site in zip(large, lifted, strict=True)
    ]
    weights = _links(loop, layout, lambda weight, _: float(abs(weight)))
    doubtful = (
        _links(loop, layout, lambda weight, doubt: float(abs(weight)) + doubt) if loop.doubts else weights
    )
    bound, _ = _closed(large, weights, layout)
    upper, _ = _closed(wide, doubtful, layout)
    # A sum rounds as often as it has terms that are not zero, whatever the size of the whole.
    listened = max(len(group.schedule.heard) for group in loop.sites)
    senders = max((int(np.count_nonzero(now, axis=1).max(initial=0)) for now, _ in weights), default=0)
    terms = max(len(site.z_names) for site in lifted) + listened * (1 + senders)
    roundings = 4 * (terms + 2) * (1 + len(loop.sites[0].schedule.sent)) * UNIT
    return (upper - bound) + roundings * upper


def _links(
    loop: Loop, layout: _Layout, weigh: Callable[[Fraction, float], float]
) -> list[tuple[Floats, Floats]]:
    """Return, for each site, r over the packets sent this frame and over the state.

    `weigh` makes a number of a weight and by how much it may be off.
    """
    row_of = [{one: row for row, one in enumerate(group.schedule.sent)} for group in loop.sites]
    starts = np.cumsum([0] + [len(group.lifted.s) for group in loop.sites])
    found = []
    for g, group in enumerate(loop.sites):
        now = np.zeros((len(group.schedule.heard), starts[-1]))
        before = np.zeros((len(group.schedule.heard), len(layout.names)))
        for line, one in enumerate(group.schedule.heard):
            doubt = loop.doubts.get(one.way, 0.0)
            for h, weight in enumerate(loop.coupling[one.way][g]):
                if weight == 0 and doubt == 0:
                    continue
                row = row_of[h][one.sent]
                if one.lag == 0:
                    now[line, starts[h] + row] = weigh(weight, doubt)
                else:
                    before[line, layout.places[Packet(h, row, one.lag)]] = weigh(weight, doubt)
        found.append((now, before))
    return found


def _closed(
    blocks: Sequence[Sequence[Floats]], links: Sequence[tuple[Floats, Floats]], layout: _Layout
) -> tuple[Floats, list[Floats]]:
    """Return the closed matrix and what each site hears, over the state."""
    n = len(layout.names)
    send_state, send_now = [], []
    for (p, _, s, d), (now, before), offset in zip(blocks, links, layout.offsets, strict=True):
        row = np.zeros((len(s), n))
        row[:, offset : offset + len(p)] = s
        send_state.append(row + d @ before)
        send_now.append(d @ now)
    source, within = np.vstack(send_state), np.vstack(send_now)
    sent, term = source, within @ source
    for _ in range(len(within)):
        if not term.any():
            break
        sent, term = sent + term, within @ term
    assert not term.any(), "a packet is heard before it is sent"

    matrix = np.zeros((n, n))
    heard = []
    for (p, q, _, _), (now, before), offset in zip(blocks, links, layout.offsets, strict=True):
        r = now @ sent + before
        heard.append(r)
        rows = slice(offset, offset + len(p))
        matrix[rows, rows] += p
        matrix[rows] += q @ r
    starts = np.cumsum([0] + [len(s) for _, _, s, _ in blocks])
    for packet, place in layout.places.items():
        if packet.lag == 1:
            matrix[place] = sent[starts[packet.site] + packet.row]
        else:
            matrix[place, layout.places[Packet(packet.site, packet.row, packet.lag - 1)]] = 1.0
    return matrix, heard


@dataclass(frozen=True, slots=True)
class _Layout:
    """The state of a closed system: where each site's part starts, its names, and where each packet is."""

    offsets: tuple[int, ...]
    names: tuple[str, ...]
    packets: tuple[Packet, ...]
    places: Mapping[Packet, int]


def _layout(loop: Loop) -> _Layout:
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
    return _Layout(tuple(offsets), tuple(names), packets, places)


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
