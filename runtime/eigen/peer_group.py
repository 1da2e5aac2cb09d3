"""Peers that move alike: one site, linearized and lifted once for all of them.

Takes: a parameter vector of theirs, its matrices, its schedule, what it hears at the start; their numbers.
Gives: `PeerGroup`, `build_group`; `used_ways`, `states_of`; `check_size`, `too_large`; `Peers`, `Runs`,
`shifted`, `joined`.
Guarantees: a group's matrices are at hand in exact rationals as well, wherever its functions can be walked;
peers that follow one another take no memory, however many they are.
Does not: find out who is alike (see `peers`); close a loop (see `closing`).
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
from apc.frame.exchange import Exchange
from apc.frame.jacobians import SiteJacobians
from apc.frame.lift import LiftedSite, check_packets, lift
from apc.frame.linearize import linearize_exact
from apc.frame.schedule import Schedule, Way
from apc.frame.site import LinearSite, rational_floats
from apc.frame.start import Listening

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Runs:
    """Peers by number, in runs that follow one another: a billion equal peers take no memory."""

    ranges: tuple[range, ...]

    def __len__(self) -> int:
        return sum(len(one) for one in self.ranges)

    def __iter__(self) -> Iterator[int]:
        return itertools.chain.from_iterable(self.ranges)

    def __getitem__(self, place: int | slice) -> Any:
        if isinstance(place, slice):
            return list(itertools.islice(self, place.start, place.stop, place.step))
        return next(itertools.islice(self, place, None))

    def shifted(self, by: int) -> Runs:
        """Return the peers counted from another start."""
        return Runs(tuple(range(one.start + by, one.stop + by) for one in self.ranges))


# Some peers of a group, or of the scene, by number.
Peers = Integers | Runs


def shifted(peers: Peers, by: int) -> Peers:
    """Return peers counted from another start."""
    return peers.shifted(by) if isinstance(peers, Runs) else peers + by


def joined(listed: Sequence[Peers]) -> Peers:
    """Return peers together, in order."""
    runs = [one for one in listed if isinstance(one, Runs)]
    if len(runs) == len(listed):
        return Runs(tuple(sorted((run for one in runs for run in one.ranges), key=lambda run: run.start)))
    return np.sort(np.concatenate([np.fromiter(one, np.int64, len(one)) for one in listed]))


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
    lifting: Callable[[], LiftedSite]
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
    def lifted(self) -> LiftedSite:
        """The map of one frame."""
        return self.lifting()

    @property
    def z_names(self) -> tuple[str, ...]:
        """The names of its part of the state: what moves, then what is remembered."""
        return (*(state.name for state in self.site.kind.states), *self.schedule.value_names)

    def with_lifted(self, lifted: LiftedSite) -> PeerGroup:
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
        self, site: LinearSite, exact: LinearSite, schedule: Schedule, lifted: LiftedSite | None = None
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

    def lifting() -> LiftedSite:
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
    return tuple(sorted({one.way for schedule in schedules for one in schedule.heard}))


def states_of(schedule: Schedule, site: SiteJacobians) -> int:
    """Return how many states a peer keeps from frame to frame."""
    return len(site.kind.states) + len(schedule.carried) + sum(schedule.depths)


def check_size(sites: Sequence[SiteJacobians], exchange: Exchange) -> None:
    """Refuse more different peers than are worth an object each."""
    states = sum(len(site.kind.states) for site in sites)
    if states > MOST_STATES:
        raise too_large(exchange, f"{len(sites):,} different peers", states)


def too_large(exchange: Exchange, what: str, states: int) -> ApcError:
    """Return the refusal of a system of too many states."""
    return ApcError(
        Mistake(
            "E804",
            Place(exchange.scene),
            f"{what} make one system of {states:,} states; the matrix of one may have {MOST_STATES:,}",
            hint="fewer peers that differ; apc analyze --method auto needs no such matrix of linear ones",
        )
    )
