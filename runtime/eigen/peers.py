"""The groups of peers that move alike: one site each, linearized and lifted once for all of them.

Takes: an `Instance` of a scene.
Gives: `PeerClass`, `peer_groups`, `representatives`, `more_differ`; `used_ways`, `states_of`; `too_large`.
Guarantees: as few groups as there are peers of different dynamics, found in a time that grows with the number
of peers, not with its square; peers that follow one another take no memory, however many they are. A site
that is not affine is linearized at its own start values, hearing the others at theirs. A group's matrices are
at hand in exact rationals as well, wherever its functions can be walked.
Does not: close the loop between them (see `modes` and `closing`).
"""

from __future__ import annotations

import bisect
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.exchange import CommunicationGraph
from apc.frame.finite_equations import at_its_part
from apc.frame.instance import Instance, PeerIndices
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.lift import FrameMap, check_packets, lift
from apc.frame.linearize import (
    InitialReception,
    linearize,
    linearize_exact,
    linearize_rows,
)
from apc.frame.schedule import CouplingTerm, Schedule
from apc.frame.site import LinearSubsystem, rational_floats
from apc.frame.start_classes import Gains, StartClasses

Floats = NDArray[np.float64]


# More states than this in one system are refused: at the cost of n³, its eigenvalues would take minutes, and
# their error bounds would decide nothing.
MOST_STATES = 1000

# Names of peers written out in the name of a group that is part of a scene's group.
MOST_NAMED = 4


@dataclass(frozen=True, slots=True, eq=False)
class PeerClass:
    """`count` peers that move alike; `parameters` is the vector (n_p,) of the first of them.

    `peers` are their numbers in the scene, from 0; `role` is the scene's group where it has delays of its own
    (see `CommunicationGraph.role`); `place` is what `gains` calls the group. `exacting` gives `exact`, the
    site's matrices in rationals, where they can't be had its floats taken at their word, and `lifting` gives
    `lifted`: both are made when they are asked for.
    """

    name: str
    count: int
    parameters: Floats
    jacobians: SubsystemJacobians
    site: LinearSubsystem
    exacting: Callable[[], LinearSubsystem]
    schedule: Schedule
    lifting: Callable[[], FrameMap]
    peers: PeerIndices
    role: int
    place: int
    listening: InitialReception | None
    gains: Gains

    @property
    def exact(self) -> LinearSubsystem:
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

    def with_lifted(self, lifted: FrameMap) -> PeerClass:
        """Return the same peers with another map of one frame."""
        return replace(self, lifting=lambda: lifted)

    def sends(self, link: str) -> bool:
        """Say whether these peers send over a link."""
        return any(sending.link == link for sending in self.jacobians.kind.sends)

    def gain(self, way: CouplingTerm, sender: PeerClass) -> Fraction:
        """Return what a peer weighs a sender's packets on a way by, beside the link's own weights."""
        if not way.edge:
            return Fraction(1)
        listed = self.gains[way.edge, way.channel]
        return listed[0] if len(listed) == 1 else listed[sender.place]

    def with_site(
        self,
        site: LinearSubsystem,
        exact: LinearSubsystem,
        schedule: Schedule,
        lifted: FrameMap | None = None,
    ) -> PeerClass:
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
    instance: Instance,
    place: int,
    peers: PeerIndices,
    listening: InitialReception | None = None,
    gains: Gains | None = None,
) -> PeerClass:
    """Return peers that move alike as a group.

    Parameters
    ----------
    instance
        The scene.
    place
        What the `gains` call the group.
    peers
        Its peers; the first one stands for all.
    listening, gains
        What it hears at the start and weighs each sender by, where that matters.
    """
    exchange = instance.exchange
    group, vector = exchange.group_of(peers.first), instance.vector(peers.first)
    built, schedule = instance.sites[group], instance.schedules[group]
    check_packets(schedule)
    site = linearize(built, vector, listening)

    @functools.cache
    def exacting() -> LinearSubsystem:
        # The functions of a nonlinear loop can't be walked one by one.
        return linearize_exact(built, vector, listening) if built.walkable else rational_floats(site)

    def lifting() -> FrameMap:
        return lift(site, schedule, exact=exacting() if built.walkable else None)

    return PeerClass(
        name=group_name(peers, exchange),
        count=len(peers),
        parameters=vector,
        jacobians=built,
        site=site,
        exacting=exacting,
        schedule=schedule,
        lifting=functools.cache(lifting),
        peers=peers,
        role=exchange.role(group),
        place=place,
        listening=listening,
        gains=gains or {},
    )


def group_name(peers: PeerIndices, exchange: CommunicationGraph) -> str:
    """Return `left+right[1,3]`, for peers of the scene's groups; all of a group are its name alone."""
    names, starts = [], exchange.starts.tolist()
    for end, listed in itertools.groupby(peers.runs, key=lambda run: bisect.bisect(starts, run.start)):
        inside, start = PeerIndices(tuple(listed)), starts[end - 1]
        name = exchange.groups[end - 1]
        if len(inside) < starts[end] - start:
            more = ["…"] if len(inside) > MOST_NAMED else []
            numbers = (str(peer - start + 1) for peer in itertools.islice(inside, MOST_NAMED))
            name += f"[{','.join([*numbers, *more])}]"
        names.append(name)
    if len(names) > MOST_NAMED:
        names = [*names[:MOST_NAMED], "…"]
    return "+".join(names)


def used_ways(schedules: Iterable[Schedule]) -> tuple[CouplingTerm, ...]:
    """Return every way on which something is heard, in order."""
    return tuple(sorted({heard.way for schedule in schedules for heard in schedule.heard}))


def states_of(schedule: Schedule, site: SubsystemJacobians) -> int:
    """Return how many states a peer keeps from frame to frame."""
    return len(site.kind.states) + len(schedule.carried) + sum(schedule.depths)


def check_size(sites: Sequence[SubsystemJacobians], exchange: CommunicationGraph) -> None:
    """Refuse more different peers than are worth an object each."""
    states = sum(len(site.kind.states) for site in sites)
    if states > MOST_STATES:
        raise too_large(exchange, f"{len(sites):,} different peers", states)


# The subject of a refusal that a method without the matrix of all states avoids.
MATRIX = "the matrix of all states"


def too_large(exchange: CommunicationGraph, what: str, states: int, *, auto: bool = False) -> ApcError:
    """Return the refusal of a system of too many states, by the method `auto` or one that it may spare."""
    spared = "" if auto else "; apc analyze --method auto needs no such matrix of linear ones"
    return ApcError(
        Diagnostic(
            "E804",
            SourceLocation(exchange.scene),
            f"{what} make one system of {states:,} states; the matrix of one may have {MOST_STATES:,}",
            hint=f"fewer peers that differ{spared}",
            subject="" if auto else MATRIX,
        )
    )


# More different peers than this are refused where each has to be looked at with each other: the slopes of
# edge functions and the start values of what is heard cost their square.
MOST_DIFFERENT = 400


def peer_groups(instance: Instance) -> tuple[PeerClass, ...]:
    """Find the groups of equal peers of a system, linearize each once.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over nobody, E802 a mean whose weights add up to 0, E803 a maximum or
        minimum that is not smooth at the start, E804 more different peers than one system can hold, E808 a
        value that is not finite.
    """
    try:
        return _peer_groups(instance)
    except ApcError as error:
        origin = instance.system.origin
        raise ApcError(
            at_its_part(mistake, origin.topology, origin.texts) for mistake in error.mistakes
        ) from None


def _peer_groups(instance: Instance) -> tuple[PeerClass, ...]:
    """Group peers of equal matrices; where the start matters, those that start alike among such others."""
    exchange = instance.exchange
    by_matrices = all(site.parameters_suffice for site in instance.sites)
    classes = _classes(instance, by_matrices=True) if by_matrices else start_classes(instance)
    heard: list[tuple[InitialReception | None, Gains]] = [(None, {})] * len(classes)
    places = list(range(len(classes)))
    if not by_matrices:
        starting = StartClasses(instance, classes)
        listened = [starting.listen(g) for g in range(len(classes))]
        places, classes = _merged(starting, listened, classes)
        heard = [*listened]
    check_size([instance.sites[exchange.group_of(peers.first)] for peers in classes], exchange)
    return tuple(
        build_group(instance, place, peers, *heard[place])
        for place, peers in zip(places, classes, strict=True)
    )


def start_classes(instance: Instance) -> list[PeerIndices]:
    """Return the peers in classes of equal start values that receive from the same peers.

    Raises
    ------
    ApcError
        E804 more than MOST_DIFFERENT classes.
    """
    exchange = instance.exchange
    classes = _classes(instance, by_matrices=False)
    links = {way.link for way in used_ways(instance.schedules)}
    if not all(map(exchange.is_complete, links)):  # the senders may differ from peer to peer
        each = itertools.islice(itertools.chain.from_iterable(classes), MOST_DIFFERENT + 1)
        classes = [PeerIndices((range(peer, peer + 1),)) for peer in each]
    if len(classes) > MOST_DIFFERENT:
        what = f"more than {MOST_DIFFERENT} peers that differ, in their place in a graph or at the start,"
        raise ApcError(
            Diagnostic("E804", SourceLocation(exchange.scene), f"{what} can't be linearized pair by pair")
        )
    return sorted(classes, key=lambda peers: peers.first)


def _merged(
    starting: StartClasses, heard: Sequence[tuple[InitialReception, Gains]], classes: Sequence[PeerIndices]
) -> tuple[list[int], list[PeerIndices]]:
    """Return the classes that start alike joined: the place of the first of each, and all its peers."""
    alike = all(len(gain) == 1 for _, gains in heard for gain in gains.values())
    members: dict[tuple[Any, ...], list[int]] = {}
    for g, (listening, gains) in enumerate(heard):
        same = (
            *(
                id(starting.sites[g]),
                starting.exchange.role(starting.groups[g]),
                starting.vectors[g].tobytes(),
            ),
            *(listening, tuple(gains.items()), g if not alike else 0),
        )
        members.setdefault(same, []).append(g)
    return [listed[0] for listed in members.values()], [
        _joined(run for g in listed for run in classes[g].runs) for listed in members.values()
    ]


def _joined(runs: Iterable[range]) -> PeerIndices:
    """Return the peers of some runs, in order."""
    return PeerIndices(tuple(sorted(runs, key=lambda run: run.start)))


def _classes(instance: Instance, *, by_matrices: bool) -> list[PeerIndices]:
    """Return the peers of equal matrices, or of equal numbers, that have the same kind and role."""
    numbers, exchange = instance.numbers, instance.exchange
    classes: dict[tuple[int, int, bytes], list[range]] = {}
    for place, group in enumerate(instance.system.groups):
        vectors, start = numbers.parameters[place], int(exchange.starts[place])
        rows = linearize_rows(instance.sites[place], vectors) if by_matrices else vectors + 0.0
        keys = [(group.kind, exchange.role(place), row.tobytes()) for row in rows]
        number = {key: count for count, key in enumerate(dict.fromkeys(keys))}
        if len(number) == 1:
            classes.setdefault(keys[0], []).append(range(start, start + group.count))
            continue
        of_peer = np.array([number[key] for key in keys])[numbers.rows[place]]
        ends = np.append(np.flatnonzero(np.diff(of_peer)) + 1, len(of_peer))
        listed = list(number)
        for first, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
            classes.setdefault(listed[of_peer[first]], []).append(range(start + first, start + end))
    return [PeerIndices(tuple(runs)) for runs in classes.values()]


def more_differ(instance: Instance, states: int) -> bool:
    """Say whether peers of different matrices, all affine and without edges, have more states together."""
    sizes = [len(site.kind.states) for site in instance.sites]
    different = map(len, instance.numbers.parameters)
    if sum(count * size for count, size in zip(different, sizes, strict=True)) <= states:
        return False
    # Peers that are all alike are a few systems of one peer's size, however large that is.
    return len(_classes(instance, by_matrices=True)) > max(1, states // max(sizes))


def representatives(instance: Instance) -> list[PeerClass]:
    """Return the first peer of each group of the scene, as many as there are peers in it."""
    runs = itertools.pairwise(instance.exchange.starts.tolist())
    return [build_group(instance, place, PeerIndices((range(*run),))) for place, run in enumerate(runs)]
