"""The groups of peers that move alike: one site each, linearized and lifted once for all of them.

Takes: an `Instance` of a scene.
Gives: `PeerGroup`, `peer_groups`, `representatives`, `more_differ`; `used_ways`, `states_of`; `too_large`;
`Peers`, `Runs`.
Guarantees: as few groups as there are peers of different dynamics, found in a time that grows with the number
of peers, not with its square; peers that follow one another take no memory, however many they are. A site
that is not affine is linearized at its own start values, hearing the others at theirs. A group's matrices are
at hand in exact rationals as well, wherever its functions can be walked.
Does not: close the loop between them (see `modes` and `closing`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.weights import exact_weight
from apc.frame.exact import evaluate_exact
from apc.frame.exchange import Exchange, check_mean
from apc.frame.finite_equations import at_its_part
from apc.frame.instance import Instance
from apc.frame.jacobians import SiteJacobians, edge_name
from apc.frame.lift import FrameMap, check_packets, lift
from apc.frame.linearize import (
    Listening,
    linearize,
    linearize_exact,
    linearize_rows,
    start_sends,
    start_values,
)
from apc.frame.parameters import exact_numbers
from apc.frame.schedule import Schedule, Way
from apc.frame.site import LinearSite, rational_floats

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Runs:
    """Peers by number, in runs that follow one another: a billion equal peers take no memory."""

    ranges: tuple[range, ...]

    def __len__(self) -> int:
        return sum(len(run) for run in self.ranges)

    def __iter__(self) -> Iterator[int]:
        return itertools.chain.from_iterable(self.ranges)

    def __getitem__(self, place: int | slice) -> Any:
        if isinstance(place, slice):
            return list(itertools.islice(self, place.start, place.stop, place.step))
        return next(itertools.islice(self, place, None))

    def shifted(self, by: int) -> Runs:
        """Return the peers counted from another start."""
        return Runs(tuple(range(run.start + by, run.stop + by) for run in self.ranges))


# Some peers of a group, or of the scene, by number.
Peers = Integers | Runs


def shifted(peers: Peers, by: int) -> Peers:
    """Return peers counted from another start."""
    return peers.shifted(by) if isinstance(peers, Runs) else peers + by


def joined(listed: Sequence[Peers]) -> Peers:
    """Return peers together, in order."""
    runs = [runs for runs in listed if isinstance(runs, Runs)]
    if len(runs) == len(listed):
        return Runs(tuple(sorted((run for item in runs for run in item.ranges), key=lambda run: run.start)))
    return np.sort(np.concatenate([np.fromiter(item, np.int64, len(item)) for item in listed]))


# More states than this in one system are refused: at the cost of n³, its eigenvalues would take minutes, and
# their error bounds would decide nothing.
MOST_STATES = 1000

# Names of peers written out in the name of a group that is part of a scene's group.
MOST_NAMED = 4

# What a receive weighs each sender's channel by, by (edge, channel): one for all senders, or one a group.
Gains = Mapping[tuple[str, str], tuple[Fraction, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class PeerGroup:
    """`count` peers that move alike; `parameters` is the vector (n_p,) of the first of them.

    `peers` are their numbers in the scene, from 0; `role` is the scene's group where it has delays of its own
    (see `Exchange.role`); `place` is what `gains` calls the group. `exacting` gives `exact`, the site's
    matrices in rationals, where they can't be had its floats taken at their word, and `lifting` gives
    `lifted`: both are made when they are asked for.
    """

    name: str
    count: int
    parameters: Floats
    jacobians: SiteJacobians
    site: LinearSite
    exacting: Callable[[], LinearSite]
    schedule: Schedule
    lifting: Callable[[], FrameMap]
    peers: Peers
    role: int
    place: int
    listening: Listening | None
    gains: Gains

    @property
    def exact(self) -> LinearSite:
        """The site's matrices in rationals."""
        return self.exacting()

    @property
    def lifted(self) -> FrameMap:
        """The map of one frame, with its radii."""
        return self.lifting()

    @property
    def z_names(self) -> tuple[str, ...]:
        """The names of its part of the state: what moves, then what is remembered."""
        return (*(state.name for state in self.site.kind.states), *self.schedule.value_names)

    def with_lifted(self, lifted: FrameMap) -> PeerGroup:
        """Return the same peers with another map of one frame."""
        return replace(self, lifting=lambda: lifted)

    def sends(self, link: str) -> bool:
        """Say whether these peers send over a link."""
        return any(sending.link == link for sending in self.jacobians.kind.sends)

    def gain(self, way: Way, sender: PeerGroup) -> Fraction:
        """Return what a peer weighs a sender's packets on a way by, beside the link's own weights."""
        if not way.edge:
            return Fraction(1)
        listed = self.gains[way.edge, way.channel]
        return listed[0] if len(listed) == 1 else listed[sender.place]

    def with_site(
        self, site: LinearSite, exact: LinearSite, schedule: Schedule, lifted: FrameMap | None = None
    ) -> PeerGroup:
        """Return the same peers with other equations and events in a frame.

        Parameters
        ----------
        site, exact
            The equations in floats and in rationals.
        schedule
            What happens in a frame.
        lifted
            Their map over a frame; without it, that of `lift`.
        """
        return replace(
            self,
            jacobians=replace(self.jacobians, kind=site.kind),
            site=site,
            exacting=lambda: exact,
            schedule=schedule,
            lifting=functools.cache(lambda: lifted or lift(site, schedule, exact=exact)),
        )


def build_group(
    place: int,
    parts: Sequence[tuple[int, Peers]],
    vector: Floats,
    built: SiteJacobians,
    site: LinearSite,
    schedule: Schedule,
    exchange: Exchange,
    *,
    listening: Listening | None = None,
    gains: Gains | None = None,
) -> PeerGroup:
    """Put a site together with what is known of its peers, `parts` of the scene's groups.

    Parameters
    ----------
    place
        What the `gains` call the group.
    parts
        Its peers: groups of the scene and which of their peers, counted in the group.
    vector, built, site, schedule
        The parameters (n_p,) of the first of them, its kind's Jacobians, its matrices, its schedule.
    exchange
        The links.
    listening, gains
        What it hears at the start and weighs each sender by, where that matters.
    """
    check_packets(schedule)
    peers = joined([shifted(peers, int(exchange.starts[group])) for group, peers in parts])

    @functools.cache
    def exacting() -> LinearSite:
        # The functions of a nonlinear loop can't be walked one by one.
        return linearize_exact(built, vector, listening) if built.walkable else rational_floats(site)

    def lifting() -> FrameMap:
        return lift(site, schedule, exact=exacting() if built.walkable else None)

    return PeerGroup(
        name=group_name(parts, exchange),
        count=len(peers),
        parameters=vector,
        jacobians=built,
        site=site,
        exacting=exacting,
        schedule=schedule,
        lifting=functools.cache(lifting),
        peers=peers,
        role=exchange.role(parts[0][0]),
        place=place,
        listening=listening,
        gains=gains or {},
    )


def group_name(parts: Sequence[tuple[int, Peers]], exchange: Exchange) -> str:
    """Return `left+right[1,3]`, for peers of the scene's groups; all of a group are its name alone."""
    counts = np.diff(exchange.starts)
    names = []
    for group, peers in parts:
        name = exchange.groups[group]
        if len(peers) < counts[group]:
            more = ["…"] if len(peers) > MOST_NAMED else []
            name += f"[{','.join([*(str(int(peer) + 1) for peer in peers[:MOST_NAMED]), *more])}]"
        names.append(name)
    if len(names) > MOST_NAMED:
        names = [*names[:MOST_NAMED], "…"]
    return "+".join(names)


def used_ways(schedules: Iterable[Schedule]) -> tuple[Way, ...]:
    """Return every way on which something is heard, in order."""
    return tuple(sorted({heard.way for schedule in schedules for heard in schedule.heard}))


def states_of(schedule: Schedule, site: SiteJacobians) -> int:
    """Return how many states a peer keeps from frame to frame."""
    return len(site.kind.states) + len(schedule.carried) + sum(schedule.depths)


def check_size(sites: Sequence[SiteJacobians], exchange: Exchange) -> None:
    """Refuse more different peers than are worth an object each."""
    states = sum(len(site.kind.states) for site in sites)
    if states > MOST_STATES:
        raise too_large(exchange, f"{len(sites):,} different peers", states)


def too_large(exchange: Exchange, what: str, states: int, *, auto: bool = False) -> ApcError:
    """Return the refusal of a system of too many states, by the method `auto` or one that it may spare."""
    spared = "" if auto else "; apc analyze --method auto needs no such matrix of linear ones"
    return ApcError(
        Mistake(
            "E804",
            Place(exchange.scene),
            f"{what} make one system of {states:,} states; the matrix of one may have {MOST_STATES:,}",
            hint=f"fewer peers that differ{spared}",
        )
    )


class StartClasses:
    """Classes of peers that start alike at the start of time, each hearing the others where they start."""

    def __init__(self, instance: Instance, parts: Sequence[Sequence[tuple[int, Peers]]]) -> None:
        numbers, exchange = instance.numbers, instance.exchange
        self.exchange = exchange
        self.counts = [sum(len(peers) for _, peers in part) for part in parts]
        self.groups = [part[0][0] for part in parts]
        self.peers = [int(exchange.starts[part[0][0]] + part[0][1][0]) for part in parts]
        self.vectors = [
            numbers.parameters[group][numbers.rows[group][int(part[0][1][0])]]
            for group, part in zip(self.groups, parts, strict=True)
        ]
        self.sites = [instance.sites[group] for group in self.groups]
        self.schedules = [instance.schedules[group] for group in self.groups]
        exact: dict[tuple[int, bytes], tuple[list[Fraction], dict[str, list[Fraction]]]] = {}
        self.parameters: list[list[Fraction]] = []
        self.sent: list[dict[str, list[Fraction]]] = []
        for site, vector in zip(self.sites, self.vectors, strict=True):
            key = (id(site), vector.tobytes())
            if key not in exact:
                parameters = exact_numbers(site.kind, vector)
                exact[key] = parameters, start_sends(site, parameters)
            self.parameters.append(exact[key][0])
            self.sent.append(exact[key][1])
        class_of = {peer: g for g, peer in enumerate(self.peers)}
        self.arcs: dict[str, dict[int, list[tuple[int, Fraction]]]] = {}
        for name in exchange.links:
            if not exchange.is_complete(name) and len(class_of) == exchange.peers:
                hears: dict[int, list[tuple[int, Fraction]]] = {}
                pairs, weights = exchange.arcs(name)
                for (sender, receiver), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
                    hears.setdefault(class_of[receiver], []).append((class_of[sender], exact_weight(weight)))
                self.arcs[name] = hears
        self._edges: dict[tuple[Any, ...], list[Fraction]] = {}

    def _senders(self, link: str, g: int) -> list[tuple[int, Fraction, int]]:
        """Return the classes a peer of class g hears over a link: (class, weight together, number)."""
        if link in self.arcs:
            return [(h, weight, 1) for h, weight in self.arcs[link].get(g, ()) if link in self.sent[h]]
        counts = [count - (1 if g == h else 0) for h, count in enumerate(self.counts)]
        return [(h, Fraction(n), n) for h, n in enumerate(counts) if n and link in self.sent[h]]

    def listen(self, g: int) -> tuple[Listening, Gains]:
        """Return what class g hears at the start, and what its edge functions weigh each sender by."""
        site, schedule = self.sites[g], self.schedules[g]
        values: list[Fraction] = []
        own: list[tuple[Fraction, ...] | None] = []
        gains: dict[tuple[str, str], tuple[Fraction, ...]] = {}
        for p, partition in enumerate(site.kind.clocks):
            for place, receive in enumerate(partition.receives):
                senders = self._senders(receive.link, g)
                ways = schedule.ways(p, place)
                name = edge_name(partition, receive)
                if not name:
                    heard = [
                        (weight, self.sent[h][receive.link][receive.channel]) for h, weight, _ in senders
                    ]
                    norm = self._norm(receive.operator, g, receive.link, senders) if ways else Fraction(1)
                    values.append(sum((weight * value for weight, value in heard), Fraction(0)) / norm)
                    own.append(None)
                elif not ways:  # nothing that matters depends on it
                    values.append(Fraction(0))
                    own.append(None)
                else:
                    value, part, slopes = self._over_edges(g, p, place, senders)
                    values.append(value)
                    own.append(part)
                    channels = list(dict.fromkeys(channel for _, channel in ways))
                    rows = site.pattern.ticks[p].channels[place]
                    for row, channel in zip(rows, channels, strict=True):
                        listed = tuple(
                            slopes[h][row] if h in slopes else Fraction(0) for h in range(len(self.counts))
                        )
                        heard_ones = {listed[h] for h, _, _ in senders}
                        gains[name, channel] = tuple(heard_ones) if len(heard_ones) == 1 else listed
        return Listening(tuple(values), tuple(own)), gains

    def _norm(
        self, operator: str, g: int, link: str, senders: Sequence[tuple[int, Fraction, int]]
    ) -> Fraction:
        """Return what a mean is divided by, 1 for all else."""
        if operator != "mean":
            return Fraction(1)
        total = sum((weight for _, weight, _ in senders), Fraction(0))
        check_mean(self.exchange, self.peers[g], link, operator, bool(senders), total)
        return total

    def _over_edges(
        self, g: int, p: int, place: int, senders: Sequence[tuple[int, Fraction, int]]
    ) -> tuple[Fraction, tuple[Fraction, ...], dict[int, list[Fraction]]]:
        """Return a receive's value, its slopes over its own (x, u, m), and over each sender's channels."""
        site = self.sites[g]
        receive, edge = site.kind.clocks[p].receives[place], site.edges[p, place]
        x, u, m = start_values(site, self.parameters[g])
        inside = len(x) + len(u) + len(m[p])
        result = {}
        for h, _, _ in senders:
            sent = self.sent[h][receive.link][: edge.function.numel_in(3)]
            key = (id(edge), self.vectors[g].tobytes(), tuple(sent))
            if key not in self._edges:
                arguments = [x, u, m[p], sent, self.parameters[g], [Fraction(0)]]
                self._edges[key] = [Fraction(value) for value in evaluate_exact(edge.function, arguments)[0]]
            result[h] = self._edges[key]
        norm = self._norm(receive.operator, g, receive.link, senders)
        if receive.operator in ("sum", "mean"):
            taken = [(h, weight / norm) for h, weight, _ in senders]
        else:
            taken = [
                (self._extreme(g, receive.name, receive.operator, receive.link, senders, result), Fraction(1))
            ]
        value = sum((weight * result[h][0] for h, weight in taken), Fraction(0))
        own = tuple(
            sum((weight * result[h][1 + i] for h, weight in taken), Fraction(0)) for i in range(inside)
        )
        return value, own, {h: result[h][1 + inside :] for h, _ in taken}

    def _extreme(
        self,
        g: int,
        name: str,
        operator: str,
        link: str,
        senders: Sequence[tuple[int, Fraction, int]],
        result: Mapping[int, Sequence[Fraction]],
    ) -> int:
        """Return the class of the one sender that is the largest, or smallest."""
        check_mean(self.exchange, self.peers[g], link, operator, bool(senders), Fraction(1))
        best = (max if operator == "max" else min)(result[h][0] for h, _, _ in senders)
        winners = [(h, number) for h, _, number in senders if result[h][0] == best]
        if sum(number for _, number in winners) > 1:
            peer = self.exchange.peer_name(self.peers[g])
            what = f"{name} of {peer}: {operator} over equal peers has no linearization"
            hint = "start values that differ from peer to peer"
            raise ApcError(Mistake("E803", Place(self.exchange.scene), what, hint=hint))
        return winners[0][0]


# More different peers than this are refused where each has to be looked at with each other: the slopes of
# edge functions and the start values of what is heard cost their square.
MOST_DIFFERENT = 400

# Peers looked at together for whether they differ: mostly, the first ones tell.
PEEK = 1024

# What equal peers have in common: their kind, their role in the exchange, their numbers as bytes.
_Key = tuple[int, int, bytes]


def peer_groups(instance: Instance) -> tuple[PeerGroup, ...]:
    """Find the groups of equal peers of a system, linearize each once.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over nobody, E802 a mean whose weights add up to 0, E803 a maximum or
        minimum that is not smooth at the start, E804 more different peers than one system can hold, E808 a
        value that is not finite.
    """
    try:
        if all(site.parameters_suffice for site in instance.sites):
            return _by_matrices(instance)
        return _by_start(instance)
    except ApcError as error:
        origin = instance.system.origin
        raise ApcError(
            at_its_part(mistake, origin.topology, origin.texts) for mistake in error.mistakes
        ) from None


def _by_matrices(instance: Instance) -> tuple[PeerGroup, ...]:
    """Group peers of equal matrices, whatever their start values and constant forces."""
    numbers, exchange = instance.numbers, instance.exchange
    rows: dict[_Key, tuple[int, Floats]] = {}
    members: dict[_Key, list[tuple[int, Peers]]] = {}
    for place, (parameters, row_of) in enumerate(zip(numbers.parameters, numbers.rows, strict=True)):
        keys = _keys(instance, place, parameters)
        for key, vector in zip(keys, parameters, strict=True):
            rows.setdefault(key, (place, vector))
        for key, peers in _split(keys, row_of):
            members.setdefault(key, []).append((place, peers))
    check_size([instance.jacobians[key[0]] for key in members], exchange)
    peer_groups = []
    for number, (key, parts) in enumerate(members.items()):
        place, vector = rows[key]
        built = instance.sites[place]
        site = linearize(built, vector)
        peer_groups.append(
            build_group(number, parts, vector, built, site, instance.schedules[place], exchange)
        )
    return tuple(peer_groups)


def _keys(instance: Instance, place: int, parameters: Floats) -> list[_Key]:
    """Return what peers of a group that are equal have in common, for each row of parameters."""
    role, kind = instance.exchange.role(place), instance.system.groups[place].kind
    rows = linearize_rows(instance.jacobians[kind], parameters)
    return [(kind, role, matrices.tobytes()) for matrices in rows]


def _by_start(instance: Instance) -> tuple[PeerGroup, ...]:
    """Group peers that start alike among others that start alike, and linearize them there."""
    system, numbers, exchange = instance.system, instance.numbers, instance.exchange
    links = {way.link for way in used_ways(instance.schedules)}
    complete = all(exchange.is_complete(link) for link in links)
    members: dict[tuple[Any, ...], list[tuple[int, Peers]]] = {}
    for place, group in enumerate(system.groups):
        role, vectors = exchange.role(place), numbers.parameters[place]
        keys = [(group.kind, role, (vector + 0.0).tobytes()) for vector in vectors]
        for key, peers in _split(keys, numbers.rows[place]):
            if complete:
                members.setdefault(key, []).append((place, peers))
            else:  # who hears whom may differ from peer to peer
                members |= {
                    (*key, place, int(peer)): [(place, np.array([peer]))]
                    for peer in peers[: MOST_DIFFERENT + 1]
                }
    if len(members) > MOST_DIFFERENT:
        what = f"more than {MOST_DIFFERENT} peers that differ, in their place in a graph or at the start,"
        raise ApcError(Mistake("E804", Place(exchange.scene), f"{what} can't be linearized pair by pair"))
    parts = sorted(members.values(), key=lambda part: (part[0][0], int(part[0][1][0])))
    sites = StartClasses(instance, parts)
    listened = [sites.listen(g) for g in range(len(parts))]

    # Peers apart in the graph are one group if they turned out alike, and weigh all others alike.
    merged: dict[tuple[Any, ...], int] = {}
    alike = all(len(gain) == 1 for _, gains in listened for gain in gains.values())
    joined: dict[int, list[tuple[int, Peers]]] = {}
    for g, (listening, gains) in enumerate(listened):
        own = parts[g][0][0]
        same = (
            *(system.groups[own].kind, exchange.role(own), sites.vectors[g].tobytes()),
            *(listening, tuple(gains.items()), g if not alike else 0),
        )
        joined.setdefault(merged.setdefault(same, g), []).extend(parts[g])
    first = list(joined)
    built = [sites.sites[g] for g in first]
    check_size(built, exchange)
    return tuple(
        build_group(
            g,
            _together(joined[g]),
            sites.vectors[g],
            site,
            linearize(site, sites.vectors[g], listened[g][0]),
            sites.schedules[g],
            exchange,
            listening=listened[g][0],
            gains=listened[g][1],
        )
        for g, site in zip(first, built, strict=True)
    )


def more_differ(instance: Instance, states: int) -> bool:
    """Say whether peers of different matrices, all affine and without edges, have more states together."""
    sizes = [len(site.kind.states) for site in instance.sites]
    different = map(len, instance.numbers.parameters)
    if sum(count * size for count, size in zip(different, sizes, strict=True)) <= states:
        return False
    # Peers that are all alike are a few systems of one peer's size, however large that is.
    most, keys = max(1, states // max(sizes)), set[_Key]()
    for place, parameters in enumerate(instance.numbers.parameters):
        for start in range(0, len(parameters), PEEK):
            keys.update(_keys(instance, place, parameters[start : start + PEEK]))
            if len(keys) > most:  # mostly the first ones tell
                return True
    return False


def representatives(instance: Instance) -> list[PeerGroup]:
    """Return the first peer of each group of the scene, as many as there are peers in it."""
    result = []
    for place, (built, schedule) in enumerate(zip(instance.sites, instance.schedules, strict=True)):
        vector = instance.numbers.parameters[place][0]
        parts = [(place, Runs((range(instance.system.groups[place].count),)))]
        site = linearize(built, vector)
        result.append(build_group(place, parts, vector, built, site, schedule, instance.exchange))
    return result


def _split(keys: Sequence[_Key], row_of: Integers) -> list[tuple[_Key, Peers]]:
    """Return, for each different key, the peers (counted in their group) whose row has it."""
    different = list(dict.fromkeys(keys))
    if len(different) == 1:
        return [(different[0], Runs((range(len(row_of)),)))]
    number = {key: place for place, key in enumerate(different)}
    of_peer = np.array([number[key] for key in keys])[row_of]
    order = np.argsort(of_peer, kind="stable")
    ends = np.cumsum(np.bincount(of_peer, minlength=len(different)))[:-1]
    return list(zip(different, np.split(order, ends), strict=True))


def _together(parts: Sequence[tuple[int, Peers]]) -> list[tuple[int, Peers]]:
    """Join the parts of each group of the scene."""
    result: dict[int, list[Peers]] = {}
    for group, peers in parts:
        result.setdefault(group, []).append(peers)
    return [(group, joined(listed)) for group, listed in result.items()]
