"""A whole system as few and small loops instead of one large one.

Takes: the groups of equal peers of a scene, and the exchange between them.
Gives: `split`; `ModalDecomposition`, `arrange`; `loops_at_right_angles`; `complete_loops`, `dense_loop`,
`dense`, `refuse_dense`, `split_exchangeable`; `couple`, `complete_degrees`.
Guarantees: the systems of a split, each as often as its multiplicity says, have together the spectrum of
`dense`, whatever the number of peers. Weights are exact; a mean over nobody, or of weights that add up to 0,
raises.
Does not: compute eigenvalues (see `spectrum`); find symmetries of different peers other than of two that
change places.

On a complete graph a peer of group g hears r = c_g (Σ_j s_j − s_own), with c_g = 1/(others) for a mean and 1
for a sum. K groups of n_1 … n_K equal peers then split exactly:

    common        all peers of a group alike: r_g = c_g Σ_h (n_h − δ_gh) s_h        once
    difference g  peers of group g apart, their sum zero, all else at rest: r_g = −c_g s_g        n_g − 1
    times

Equal peers on any other graph: see `graph_loops`. Different peers on such a graph are one whole system, less
those that are exchangeable: g and h of equal dynamics that hear all others alike and are heard by them alike.
A class c of n_c exchangeable peers that weigh themselves by w_own and one another by w_other moves alike, as
one site that hears w_own + (n_c − 1) w_other times itself and n_d W_cd times class d; or apart, its sum zero
and all else at rest, each of them hearing w_own − w_other times itself, n_c − 1 times over.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.weights import exact_weight
from apc.eigen.closing import ClosedLoop, Coupling, ModalSystem, close_loop
from apc.eigen.graph_loops import common_graph, graph_loop, graph_scale
from apc.eigen.graph_modes import graph_modes
from apc.eigen.peers import MOST_STATES, PeerClass, group_name, states_of, too_large, used_ways
from apc.frame.exchange import CommunicationGraph, check_mean
from apc.frame.instance import PeerIndices
from apc.frame.schedule import CouplingTerm
from apc.unserved import NotSupportedError

# The shape of modes of peers that differ.
COUPLED = "coupled"


@dataclass(frozen=True, slots=True)
class ModalDecomposition:
    """A whole system as independent loops; `method` is "modes" or "dense", `notes` say why."""

    method: str
    loops: tuple[ModalSystem, ...]
    notes: tuple[str, ...]


def split(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> tuple[ClosedLoop, ...]:
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
    loops = arrange(groups, exchange).loops
    for loop in loops:
        if loop.states > MOST_STATES:
            raise too_large(exchange, f"{exchange.peers:,} peers", loop.states)
    return tuple(close_loop(loop) for loop in loops)


def arrange(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> ModalDecomposition:
    """Find the independent loops of a whole system: `split`, before any matrix is built.

    Parameters
    ----------
    groups, exchange
        As for `split`.
    """
    ways = used_ways(group.schedule for group in groups)
    graphs = list(dict.fromkeys(way.link for way in ways if not exchange.is_complete(way.link)))
    if not graphs:
        return ModalDecomposition("modes", complete_loops(groups, exchange), ())
    named = " and ".join(f"{link} ({exchange.links[link].graph.shape})" for link in graphs)
    reason = f"the peers on {named} differ" if len(groups) > 1 else common_graph(ways, exchange)
    if not reason:
        scale = graph_scale(groups[0], ways, exchange)
        modes = graph_modes(exchange.links[graphs[0]].graph, exchange.peers, mean=scale.by_mean)
        if modes is not None:
            note = f"{len(modes)} systems, one an eigenvalue of the graph of {named}"
            return ModalDecomposition(
                "modes", tuple(graph_loop(groups[0], graph_mode, scale) for graph_mode in modes), (note,)
            )
        reason = f"the graph of {named} has no full set of eigenvectors"
    parts = split_exchangeable(dense_loop(groups, exchange), exchange)
    if len(parts) > 1:
        note = f"{len(parts)} systems, as peers that can change places move alike or apart"
        return ModalDecomposition("modes", parts, (note,))
    return ModalDecomposition("dense", parts, (f"all peers as one system: {reason}",))


def loops_at_right_angles(
    groups: Sequence[PeerClass], exchange: CommunicationGraph, most: int
) -> tuple[ModalSystem, ...]:
    """Split a scene into loops at right angles to one another, all peers alike the first.

    Parameters
    ----------
    groups, exchange
        As for `split`.
    most
        How many peers on a graph that isn't complete are not too many.

    Raises
    ------
    NotSupportedError
        More peers on such a graph.
    """
    graphs = {way.link for way in used_ways(group.schedule for group in groups)}
    graphs = {link for link in graphs if not exchange.is_complete(link)}
    if not graphs:
        return complete_loops(groups, exchange)
    count = sum(group.count for group in groups)
    if count > most:
        raise NotSupportedError(
            f"{count:,} peers on a graph that is not complete are too many: {most} are the most"
        )
    if len(groups) == 1 and all(exchange.links[link].graph.shape == "ring" for link in graphs):
        arrangement = arrange(groups, exchange)
        if arrangement.method == "modes":
            return arrangement.loops
    return split_exchangeable(dense_loop(groups, exchange), exchange)


def complete_loops(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> tuple[ModalSystem, ...]:
    """Split a system of complete graphs into a common loop and a difference loop a group of two or more.

    Parameters
    ----------
    groups
        All peers, see `peers.peer_groups`.
    exchange
        The links, all of them complete.
    """
    degrees = complete_degrees(groups, exchange)
    weights = couple(
        groups, exchange, lambda way, g, h: Fraction(groups[h].count - (1 if g == h else 0)), degrees
    )
    loops = [ModalSystem(_together_named(groups), 1, tuple(groups), weights)]
    if all(group.count < 2 for group in groups):
        return tuple(loops)
    apart = couple(groups, exchange, lambda way, g, h: Fraction(-1 if g == h else 0), degrees)
    for place, group in enumerate(groups):
        if group.count < 2:
            continue
        own = {key: ((rows[place][place],),) for key, rows in apart.items()}
        name = "difference" if len(groups) == 1 else f"difference {group.name}"
        loops.append(ModalSystem(name, group.count - 1, (group,), own))
    return tuple(loops)


def dense(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> ClosedLoop:
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
    refuse_dense(groups, exchange)
    return close_loop(dense_loop(groups, exchange))


def refuse_dense(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> None:
    """Refuse so many peers before each of them is looked at."""
    states = sum(group.count * states_of(group.schedule, group.jacobians) for group in groups)
    if states > MOST_STATES:
        raise too_large(exchange, f"{exchange.peers:,} peers", states)


def dense_loop(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> ModalSystem:
    """Return every peer of the whole system as one loop."""
    everyone = tuple(
        replace(group, name=exchange.peer_name(peer), count=1, peers=PeerIndices((range(peer, peer + 1),)))
        for peer, group in sorted(
            ((peer, group) for group in groups for peer in group.peers), key=lambda pair: pair[0]
        )
    )
    weights = {
        link: {
            (receiver, sender): exact_weight(weight)
            for (sender, receiver), weight in zip(*(arc.tolist() for arc in exchange.arcs(link)), strict=True)
        }
        for link in exchange.links
    }
    degrees: dict[tuple[str, int], Fraction] = {}
    for link, entries in weights.items():
        for (receiver, sender), weight in entries.items():
            if everyone[sender].sends(link):
                degrees[link, receiver] = degrees.get((link, receiver), Fraction(0)) + weight
    coupling = couple(
        everyone, exchange, lambda way, g, h: weights[way.link].get((g, h), Fraction(0)), degrees
    )
    return ModalSystem(COUPLED, 1, everyone, coupling)


def _together_named(sites: Sequence[PeerClass]) -> str:
    """Return how peers move together: one alone, equal ones alike, others each in its own way."""
    return COUPLED if len(sites) > 1 else "common" if sites[0].count > 1 else "single"


def split_exchangeable(loop: ModalSystem, exchange: CommunicationGraph) -> tuple[ModalSystem, ...]:
    """Split a loop by its exchangeable peers.

    Parameters
    ----------
    loop
        Of all peers, one a site, its weights exact; without exchangeable ones it is returned as it is.
    exchange
        The links, for the names of the groups.
    """
    classes: list[list[int]] = []
    for place in range(len(loop.sites)):
        alike = (members for members in classes if _are_exchangeable(loop, members[0], place))
        numbers = next(alike, None)
        if numbers is None:
            classes.append([place])
        else:
            numbers.append(place)
    if loop.doubts or len(classes) == len(loop.sites):
        return (loop,)
    sites = tuple(_together([loop.sites[place] for place in members], exchange) for members in classes)
    coupling = {
        way: tuple(tuple(_weight_of(loop, way, members, others) for others in classes) for members in classes)
        for way in loop.coupling
    }
    loops = [replace(loop, name=_together_named(sites), sites=sites, coupling=coupling)]
    for site, members in zip(sites, classes, strict=True):
        if len(members) > 1:
            first, second = members[:2]
            apart = {
                way: ((rows[first][first] - rows[first][second],),) for way, rows in loop.coupling.items()
            }
            many = loop.multiplicity * (len(members) - 1)
            loops.append(ModalSystem(f"difference {site.name}", many, (site,), apart))
    return tuple(loops)


def _are_exchangeable(loop: ModalSystem, g: int, h: int) -> bool:
    """Say whether two sites can change places."""
    site, other = loop.sites[g], loop.sites[h]
    if site.lifting is not other.lifting or site.schedule is not other.schedule:
        return False
    rest = [place for place in range(len(loop.sites)) if place not in (g, h)]
    return all(
        rows[g][g] == rows[h][h]
        and rows[g][h] == rows[h][g]
        and all(rows[g][k] == rows[h][k] and rows[k][g] == rows[k][h] for k in rest)
        for rows in loop.coupling.values()
    )


def _weight_of(
    loop: ModalSystem, way: CouplingTerm, members: Sequence[int], others: Sequence[int]
) -> Fraction:
    """Return what a site of one class hears of a class whose sites all move alike."""
    row = loop.coupling[way][members[0]]
    return sum((row[place] for place in others), Fraction(0))


def _together(sites: Sequence[PeerClass], exchange: CommunicationGraph) -> PeerClass:
    """Return equal sites as one group."""
    peers = PeerIndices(tuple(run for site in sites for run in site.peers.runs))
    return replace(sites[0], name=group_name(peers, exchange), count=len(peers), peers=peers)


def couple(
    groups: Sequence[PeerClass],
    exchange: CommunicationGraph,
    weigh: Callable[[CouplingTerm, int, int], Fraction],
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
            hears = any(heard.way == way for heard in group.schedule.heard)
            if hears and way.operator == "mean":
                total = degrees.get((way.link, g))
                check_mean(
                    exchange, group.peers.first, way.link, "mean", total is not None, total or Fraction(0)
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


def complete_degrees(
    groups: Sequence[PeerClass], exchange: CommunicationGraph
) -> dict[tuple[str, int], Fraction]:
    """Return how many others a peer of each group hears over each complete link."""
    degrees = {}
    for link in exchange.links:
        total = sum(group.count for group in groups if group.sends(link))
        for g, group in enumerate(groups):
            number = total - (1 if group.sends(link) else 0)
            if number:
                degrees[link, g] = Fraction(number)
    return degrees
