"""The mean loops and the luck of a scene: what its second moments are made of.

Takes: a `Model` whose links lose or delay packets independently of each other.
Gives: `crowd`; `Classes`, `classes_of`, `moments_of`; `PerTickReception`, `build_hearing`, `own_value`;
`peer_classes`, `remembered_of`, `standing_motions`, `instants`.
Guarantees: equal peers on complete graphs cost the same, however many they are; peers that can change places
are one class on any graph.
Does not: say what it can't serve (see `network_verdict`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Clock, Model, PeerType
from apc.eigen.closing import Coupling, ModalSystem, without_packets
from apc.eigen.modes import complete_degrees, complete_loops, couple, dense_loop, split_exchangeable
from apc.eigen.peers import PeerClass, used_ways
from apc.eigen.relative import Relative
from apc.eigen.rigid import find_rigid_modes
from apc.frame.exchange import CommunicationGraph
from apc.frame.instance import PeerIndices, Prepared
from apc.frame.lift import FrameMap
from apc.frame.parameters import resolve
from apc.frame.radius import radius_of, value_of
from apc.frame.schedule import (
    CouplingTerm,
    Event,
    Schedule,
    SendEvent,
    SentSample,
    Tick,
    UncertainSample,
    tick_by_tick,
)
from apc.frame.scheduling import build_schedules
from apc.frame.taylor import arithmetic_of
from apc.moments.mean_loops import Listened, ReceptionChannel, Route, RouteMemory, mean_loop, remember
from apc.moments.operator import MomentBlock, Operator
from apc.moments.packet_memory import memory_of
from apc.network.channel import ChannelLaw, channel_law

Floats = NDArray[np.float64]
Matrix = NDArray[Any]
Flags = NDArray[np.bool_]

# No share lost is off by anything.
EXACTLY: Mapping[str, tuple[float, ...]] = {}

# A link on which every packet takes the nominal delay.
PERFECT = ChannelLaw(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, "uniform", None)


@dataclass(frozen=True, slots=True, eq=False)
class PerTickReception:
    """The peers of a scene, each tick of theirs hearing by itself: `rows` says what, by the schedule's id."""

    groups: tuple[PeerClass, ...]
    exchange: CommunicationGraph
    rows: Mapping[int, tuple[UncertainSample, ...]]
    timings: Mapping[str, Fraction]
    frame: Fraction
    quantum: Fraction
    strictly: bool  # a tick misses what arrives just then

    def of(self, loop: ModalSystem) -> list[tuple[UncertainSample, ...]]:
        """Return what each row of r of each site of a loop hears."""
        return [self.rows[id(site.schedule)] for site in loop.sites]


def build_hearing(
    system: Model, prepared: Prepared, *, first: Fraction = Fraction(0), stand_in: bool = False
) -> PerTickReception:
    """Lift the peers of a scene with a row of r for each tick that hears.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    first
        When frames begin, in seconds.
    stand_in
        Whether peers send, at each tick, what would stand in for a value they miss (see `own_value`).
    """
    timings = dict(resolve(system).timings)
    for clock in system.clocks:
        timings[clock.phase] = (timings[clock.phase] - first) % timings[clock.period]
    patterns = [site.pattern for site in prepared.jacobians]
    kept = {link.name: 0 for link in system.links}
    schedules = build_schedules(system, timings, patterns, order=prepared.order, kept=kept)
    apart = {
        (id(schedule), group.kind): standing_in(schedule, system.kinds[group.kind])
        if stand_in
        else tick_by_tick(schedule)
        for schedule, group in zip(schedules, system.groups, strict=True)
    }
    by_tick = tuple(
        apart[id(schedule), group.kind] for schedule, group in zip(schedules, system.groups, strict=True)
    )
    rows = {id(own): schedule.selected for schedule, own in zip(schedules, by_tick, strict=True)}
    moved = replace(
        system, timings=tuple(replace(timing, value=timings[timing.name]) for timing in system.timings)
    )
    groups, exchange = lifted_groups(moved, prepared=replace(prepared, schedules=by_tick, timings=timings))
    strictly = prepared.order.index("tick") < prepared.order.index("deliver")
    frame, quantum = schedules[0].frame_s, schedules[0].quantum
    return PerTickReception(groups, exchange, rows, timings, frame, quantum, strictly)


def own_value(row: UncertainSample) -> SentSample:
    """Return the name of what a peer sends itself at a tick, to stand in for a value it misses."""
    return SentSample(f"{row.way.link} at {row.clock}", row.channel, row.tick)


def standing_in(schedule: Schedule, kind: PeerType) -> Schedule:
    """Return `tick_by_tick` of a schedule, with what stands in for missed values sent at the ticks."""
    partition = {send.link: place for place, send in enumerate(kind.sends)}
    sent = list(schedule.sent)
    events: list[Event] = []
    for event in schedule.events:
        places = [place for listed in event.heard for place in listed] if isinstance(event, Tick) else []
        for row in (schedule.selected[place - len(schedule.heard)] for place in places):
            if row.gap:
                own = own_value(row)
                if own not in sent:
                    sent.append(own)
                number = partition[row.way.link]
                channel = kind.sends[number].channels.index(row.channel)
                events.append(SendEvent(number, ((channel, sent.index(own)),)))
        events.append(event)
    more = len(sent) - len(schedule.sent)
    return replace(
        tick_by_tick(schedule),
        events=tuple(events),
        sent=tuple(sent),
        depths=(*schedule.depths, *[0] * more),
        sent_names=(*schedule.sent_names, *[item.link for item in sent[len(schedule.sent) :]]),
        sent_times=(*schedule.sent_times, *[0] * more),
        repeats=None,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PeerVersusRest:
    """A loop in which one peer of a class, its first site, moves apart from the others.

    `of` says of which class each site is, `many` for how many peers the first site's place could be taken by
    another such that a peer of a site is in the same place: what luck of all such peers drives a peer by.
    `standing` are its rigid motions over the sites' own z.
    """

    loop: ModalSystem
    of: tuple[int, ...]
    many: tuple[int, ...]
    standing: Floats

    def sites_of(self, which: int) -> list[tuple[int, int]]:
        """Return the sites of a class, and `many` of each."""
        listed = enumerate(zip(self.of, self.many, strict=True))
        return [(site, many) for site, (own, many) in listed if own == which]


@dataclass(frozen=True, slots=True, eq=False)
class Classes:
    """The classes of a scene's peers that can change places: the loop of all, and of each one that of a peer.

    `weights` says what a peer of one class weighs one of another by.
    """

    hearing: PerTickReception
    common: ModalSystem
    weights: Coupling
    loops: tuple[PeerVersusRest, ...]

    @property
    def counts(self) -> list[int]:
        """How many peers each class has."""
        return [site.count for site in self.common.sites]


def classes_of(hearing: PerTickReception) -> Classes:
    """Return the loops of a scene with their rigid motions."""
    common, weights = peer_classes(hearing)
    loops = []
    for which, own in enumerate(common.sites):
        alone = PeerIndices((range(own.peers.first, own.peers.first + 1),))
        sites = [(which, replace(own, count=1, peers=alone), 1)]
        for g, site in enumerate(common.sites):
            first = int(g == which)
            if count := site.count - first:
                many = count if first else own.count
                others = site.peers.others if first else site.peers
                sites.append((g, replace(site, count=count, peers=others), many))
        coupling = {
            way: tuple(
                tuple(rows[g][h] * (to.count - (place == of)) for of, (h, to, _) in enumerate(sites))
                for place, (g, *_) in enumerate(sites)
            )
            for way, rows in weights.items()
        }
        loop = ModalSystem(own.name, 1, tuple(site for _, site, _ in sites), coupling)
        listed = tuple(g for g, *_ in sites), tuple(many for *_, many in sites)
        loops.append(PeerVersusRest(loop, *listed, standing_motions(loop)))
    return Classes(hearing, common, weights, tuple(loops))


@dataclass(frozen=True, slots=True, eq=False)
class MomentCoordinates:
    """Where a block's motions are: the relative coordinates `at` of a loop whose sites begin at `offsets`.

    It stands for `heard` channels to the loop's first site; or for that site itself.
    """

    loop: PeerVersusRest
    at: Relative
    offsets: tuple[int, ...]
    heard: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """How second moments of a scene move, and what each block of them is.

    `entries` counts covariances of luck, `states` are those of the largest loop that luck drives.
    """

    operator: Operator
    moving: tuple[MomentCoordinates, ...]
    entries: int
    states: int


@dataclass(frozen=True, slots=True, eq=False)
class _Kind:
    """The channels from peers of class `sender` to those of class `receiver`; their lucks, slot by slot.

    Each slot's packet replaces so many values by chance, of covariance `spreads`; `heard` such channels reach
    each receiver.
    """

    sender: int
    receiver: int
    heard: int
    listened: Listened
    lucks: range
    spreads: tuple[Matrix, ...]


def crowd(system: Model, hearing: PerTickReception) -> Moments:
    """Make the mean loops of a scene and the luck that drives them.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    hearing
        Its peers.
    """
    of = classes_of(hearing)
    return moments_of(of, remembered_of(system, of.hearing, of.common))


def moments_of(
    of: Classes, memories: Sequence[RouteMemory], frames: Mapping[str, FrameMap] | None = None
) -> Moments:
    """Make the mean loops and the luck of a scene's classes of peers.

    Parameters
    ----------
    of
        The classes.
    memories
        From `remembered_of`.
    frames
        As for `mean_loops.mean_loop`.
    """
    kinds = _kinds(of, memories)
    spreads = [spread for kind in kinds for spread in kind.spreads]
    widths = [len(spread[0]) for spread in spreads]
    blocks, moving, states = list[MomentBlock](), list[MomentCoordinates](), 0
    for h, apart in enumerate(of.loops):
        driving = [kind for kind in kinds if kind.receiver == h]
        rows = of.hearing.of(apart.loop)
        listened = [kind.listened for kind in driving]
        mean = mean_loop(apart.loop, rows, memories, listened, apart.standing, frames)
        n = len(mean.at.rest)
        for kind, channel in [(None, None), *zip(driving, mean.channels, strict=True)]:
            own = np.arange(n) if channel is None else np.r_[0:n, channel.kept]
            luck = channel.luck if channel else range(0)
            forms = _forms(kinds, apart, mean.misses, kind, channel)
            blocks.append(_block(mean.matrix, own, luck, forms, widths, kind.lucks if kind else ()))
            moving.append(MomentCoordinates(apart, mean.at, mean.offsets, kind.heard if kind else None))
            states = max(states, len(own))
    width, like = max(widths, default=0), blocks[0].matrix
    listed = np.zeros((len(widths), len(like), width, width))
    for own, spread, size in zip(listed, spreads, widths, strict=True):
        own[: len(spread), :size, :size] = spread
    entries = sum(size * (size + 1) // 2 for size in widths)
    return Moments(Operator(tuple(blocks), listed), tuple(moving), entries, states)


# What luck follows from: which, by what weight, and by which form over a block's states and its own luck.
Form = tuple[int, float, Matrix]


def _forms(
    kinds: Sequence[_Kind],
    apart: PeerVersusRest,
    misses: Mapping[tuple[int, Route, int], Matrix],
    kind: _Kind | None,
    channel: ReceptionChannel | None,
) -> list[Form]:
    """Return by which forms luck follows from what moves in a loop, driven by channels of a kind or none.

    Parameters
    ----------
    kinds, apart
        All kinds of channels, and the loop.
    misses
        How far packets are from what is heard, by site, route and slot.
    kind, channel
        What drives it, and that in the loop.
    """
    forms = []
    for target in kinds:
        for (slot, luck), (site, many) in itertools.product(
            enumerate(target.lucks), apart.sites_of(target.sender)
        ):
            miss = misses[site, target.listened.route, slot]
            weight = many * (1 if kind is None else kind.heard)
            if channel and target is kind and site:  # one of these channels is that whose packet it is
                weight -= 1
                forms.append((luck, 1.0, arithmetic_of(miss).add(miss, channel.misses[slot])))
            if weight:
                forms.append((luck, float(weight), miss))
    return forms


def _block(
    matrix: Matrix,
    own: NDArray[np.intp],
    luck: range,
    forms: Sequence[Form],
    widths: Sequence[int],
    by: Sequence[int],
) -> MomentBlock:
    """Return a block of the operator.

    Parameters
    ----------
    matrix
        What moves a loop.
    own, luck
        Which of its states are of the block, and which are the luck that drives it.
    forms
        What luck follows from them.
    widths, by
        How many values each luck has, and which drive the block, one after the other.
    """
    p = max(widths, default=0)
    ends = np.cumsum([luck.start, *(widths[luck] for luck in by)]).tolist()
    spans = [slice(*span) for span in itertools.pairwise(ends)]
    enters = np.zeros((len(by), len(matrix), len(own), p))
    seen, shares = np.zeros((len(forms), len(matrix), p, len(own))), np.zeros((len(widths), len(forms)))
    at_once = np.zeros((len(forms), len(by), len(matrix), p, p))
    for e, span in enumerate(spans):
        enters[e, ..., : span.stop - span.start] = matrix[:, own, span]
    for k, (number, weight, form) in enumerate(forms):
        shares[number, k] = weight
        seen[k, :, : widths[number]] = form[..., own]
        for e, span in enumerate(spans):
            at_once[k, e, :, : widths[number], : span.stop - span.start] = form[..., span]
    moved = matrix[:, own[:, None], own]
    return MomentBlock(moved, enters, tuple(by), seen, shares, at_once if at_once.any() else None)


def _kinds(of: Classes, memories: Sequence[RouteMemory]) -> list[_Kind]:
    """Return the kinds of channels left to chance."""
    kinds: list[_Kind] = []
    first, counts = 0, of.counts
    for memory in memories:
        if not any(memory.sizes):
            continue
        numbers = np.ones((len(memory.channels),) * 2)  # all numbers of a packet are lost together
        spreads = tuple(np.kron(numbers, memory.memory.spread(slot)) for slot in range(memory.memory.slots))
        for h, g in itertools.product(range(len(counts)), repeat=2):
            weighed = {
                way: rows[h][g] for way, rows in of.weights.items() if (way.link, way.delay) == memory.route
            }
            heard = counts[g] - (g == h)
            if heard and any(weighed.values()):
                lucks = range(first, first := first + len(spreads))
                kinds.append(_Kind(g, h, heard, Listened(0, memory.route, weighed), lucks, spreads))
    return kinds


def standing_motions(loop: ModalSystem) -> Floats:
    """Return the rigid motions of a loop over its sites' own states."""
    states = sum(len(site.z_names) for site in loop.sites)
    return find_rigid_modes(without_packets(loop), with_drifts=False).basis[:states]


def peer_classes(hearing: PerTickReception) -> tuple[ModalSystem, Coupling]:
    """Return the loop of all classes of peers, and what a peer of one weighs one of another by.

    Peers of a class can change places: each hears all others alike, of its own class too, or none of them.
    """
    groups, exchange = hearing.groups, hearing.exchange
    if all(exchange.is_complete(way.link) for way in used_ways(group.schedule for group in groups)):
        degrees = complete_degrees(groups, exchange)

        def weight(way: CouplingTerm, g: int, h: int) -> Fraction:
            return Fraction(groups[h].count > (1 if g == h else 0))

        return complete_loops(groups, exchange)[0], couple(groups, exchange, weight, degrees)
    whole = dense_loop(groups, exchange)
    common = split_exchangeable(whole, exchange)[0]
    place = {group.peers.first: number for number, group in enumerate(whole.sites)}
    first = [place[site.peers.first] for site in common.sites]
    last = [place[site.peers.last] for site in common.sites]
    weights = {
        way: tuple(tuple(rows[g][last[k] if g == h else h] for k, h in enumerate(first)) for g in first)
        for way, rows in whole.coupling.items()
    }
    return common, weights


def remembered_of(
    system: Model,
    hearing: PerTickReception,
    common: ModalSystem,
    *,
    perfect: bool = False,
    lost: Mapping[str, tuple[float, ...]] = EXACTLY,
) -> list[RouteMemory]:
    """Return what is remembered on each route that anybody listens to.

    Parameters
    ----------
    system, hearing
        The compiled scene and its peers.
    common
        The loop of all classes.
    perfect
        Whether every packet counts as on time.
    lost
        How far the share of packets that a link loses may be off, and how it changes over a cell, by the
        link's name, as for `packet_memory.memory_of`.
    """
    heard: dict[Route, list[UncertainSample]] = {}
    for site, rows in zip(common.sites, hearing.of(common), strict=True):
        size = site.lifted.mapped(lambda block: np.abs(value_of(block)) + radius_of(block))
        felt: Flags = np.any(size.q, axis=0) | np.any(size.d, axis=0)
        for place, row in enumerate(rows):
            if felt[place] and not row.gap:
                heard.setdefault((row.way.link, row.way.delay), []).append(row)
    links = {link.name: link for link in system.links}
    memories = []
    times = {clock.name: instants(hearing, clock) for clock in system.clocks}
    for route, selected in sorted(heard.items()):
        link, delay = links[route[0]], hearing.timings[route[1]]
        sent = times[link.clock]
        ticks = {(row.clock, row.tick): times[row.clock][row.tick] for row in selected}
        law = PERFECT if perfect or link.channel is None else channel_law(system, link, delay)
        off = lost.get(route[0], (0.0,))
        memory = memory_of(law, delay, sent, ticks, hearing.frame, strictly=hearing.strictly, lost=off)
        memories.append(remember(route, memory, sorted({row.channel for row in selected})))
    return memories


def instants(hearing: PerTickReception, clock: Clock) -> list[Fraction]:
    """Return when a clock ticks in a frame, in seconds."""
    phase, period = hearing.timings[clock.phase], hearing.timings[clock.period]
    return [phase % period + number * period for number in range(int(hearing.frame / period))]
