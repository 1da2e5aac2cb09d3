"""The mean loops and the luck of a scene: what its second moments are made of.

Takes: a `CompiledSystem` whose links lose or delay packets independently of each other.
Gives: `crowd`; `Classes`, `classes_of`, `moments_of`; `Hearing`, `build_hearing`, `own_value`;
`peer_classes`, `remembered_of`, `standing_motions`, `instants`.
Guarantees: equal peers on complete graphs cost the same, however many they are; peers that can change places
are one class on any graph.
Does not: say what it can't serve (see `network`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Clock, CompiledSystem, Kind
from apc.eigen.closing import Coupling, Loop, without_packets
from apc.eigen.modes import complete_degrees, complete_loops, couple, dense_loop, split_exchangeable
from apc.eigen.peers import PeerGroup, used_ways
from apc.eigen.rigid import find_rigid_modes
from apc.frame.exchange import Exchange
from apc.frame.instance import Prepared
from apc.frame.lift import FrameMap
from apc.frame.parameters import resolve
from apc.frame.radius import radius_of, value_of
from apc.frame.schedule import Event, Schedule, Selected, Send, Sent, Tick, Way, tick_by_tick
from apc.frame.scheduling import build_schedules
from apc.frame.taylor import arithmetic_of, entrywise
from apc.moments.gains import Answer, Drive, Moments, Part, number_of
from apc.moments.mean_loops import Listened, Remembered, Route, mean_loop, remember
from apc.moments.packet_memory import memory_of
from apc.network.channel import ChannelLaw, channel_law

Floats = NDArray[np.float64]
Matrix = NDArray[Any]
Flags = NDArray[np.bool_]

EXACTLY: Mapping[str, tuple[float, ...]] = {}

# A link on which every packet takes the nominal delay.
PERFECT = ChannelLaw(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, "uniform", None)


@dataclass(frozen=True, slots=True, eq=False)
class Hearing:
    """The peers of a scene, each tick of theirs hearing by itself: `rows` says what, by the schedule's id."""

    groups: tuple[PeerGroup, ...]
    exchange: Exchange
    rows: Mapping[int, tuple[Selected, ...]]
    timings: Mapping[str, Fraction]
    frame: Fraction
    quantum: Fraction
    strictly: bool  # a tick misses what arrives just then

    def of(self, loop: Loop) -> list[tuple[Selected, ...]]:
        """Return what each row of r of each site of a loop hears."""
        return [self.rows[id(site.schedule)] for site in loop.sites]


def build_hearing(
    system: CompiledSystem, prepared: Prepared, *, first: Fraction = Fraction(0), stand_in: bool = False
) -> Hearing:
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
    return Hearing(groups, exchange, rows, timings, frame, quantum, strictly)


def own_value(row: Selected) -> Sent:
    """Return the name of what a peer sends itself at a tick, to stand in for a value it misses."""
    return Sent(f"{row.way.link} at {row.clock}", row.channel, row.tick)


def standing_in(schedule: Schedule, kind: Kind) -> Schedule:
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
                events.append(Send(number, ((channel, sent.index(own)),)))
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
class Classes:
    """The loops of a scene, that of all classes of peers first, with their rigid motions.

    `weights` says what a peer of one class weighs one of another by.
    """

    hearing: Hearing
    loops: tuple[Loop, ...]
    weights: Coupling
    standing: tuple[Floats, ...]

    def only(self, place: int) -> int | None:
        """Return the class whose peers a loop moves against each other, None for the loop of all classes."""
        names = [site.name for site in self.loops[0].sites]
        return names.index(self.loops[place].sites[0].name) if place else None


def classes_of(hearing: Hearing) -> Classes:
    """Return the loops of a scene with their rigid motions."""
    loops, weights = peer_classes(hearing)
    return Classes(hearing, loops, weights, tuple(map(standing_motions, loops)))


@dataclass(frozen=True, slots=True, eq=False)
class _Luck:
    """The luck of the channels from peers of class `sender` to those of `listened.site`.

    `places` are where each slot's covariances stand in G, `entries` which rows and columns (2, entries) of it
    they are, `units` a unit of each over the luck of all slots (b, k, k).
    """

    sender: int
    listened: Listened
    spreads: tuple[Matrix, ...]
    places: tuple[slice, ...]
    entries: tuple[NDArray[np.intp], ...]
    units: Floats


def crowd(system: CompiledSystem, hearing: Hearing) -> Moments:
    """Make the mean loops of a scene and the luck that drives them.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    hearing
        Its peers.
    """
    of = classes_of(hearing)
    return moments_of(of, remembered_of(system, of.hearing, of.loops[0]))


def moments_of(
    of: Classes, memories: Sequence[Remembered], frames: Mapping[str, FrameMap] | None = None
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
    luck = _luck(of.loops[0], of.weights, memories)
    parts, drives = [], []
    for number, loop in enumerate(of.loops):
        only = of.only(number)
        driving = [item for item in luck if only in (None, item.listened.site)]
        listened = [item.listened if only is None else replace(item.listened, site=0) for item in driving]
        mean, channels = mean_loop(loop, of.hearing.of(loop), memories, listened, of.standing[number], frames)
        classes = tuple(range(len(loop.sites))) if only is None else (only,)
        parts.append(
            Part(mean.matrix, only, mean.at, mean.offsets, tuple(_answers(mean.misses, luck, classes)))
        )
        for item, channel in zip(driving, channels, strict=True):
            receivers = of.loops[0].sites[item.listened.site].count
            heard = of.loops[0].sites[item.sender].count - (item.sender == item.listened.site)
            # One channel drives the mean of all receivers by 1/n, and their differences by 1 − 1/n or −1/n.
            by = 1 / receivers
            share = heard * (by if only is None else 1 - by)
            own = item, channel.own, by if only is None else -by
            answers = tuple(_answers(channel.misses, luck, classes, share, *own))
            place = slice(item.places[0].start, item.places[-1].stop)
            drives.append(Drive(channel.matrix, channel.into, item.units, place, answers, number, share))
    return Moments(tuple(parts), tuple(drives), luck[-1].places[-1].stop if luck else 0)


def _answers(
    misses: Mapping[tuple[int, Route, int], Matrix],
    luck: Sequence[_Luck],
    classes: Sequence[int],
    share: float = 1.0,
    driving: _Luck | None = None,
    matrices: Sequence[Matrix] = (),
    by: float = 0.0,
) -> Iterator[Answer]:
    """Give the covariances of luck that follow from a loop's moments.

    Parameters
    ----------
    misses
        How far packets are from what is heard, by site, route and slot, over the loop's states.
    luck
        All kinds of luck.
    classes
        The classes of the loop's sites.
    share
        How many channels drive the loop.
    driving, matrices, by
        Of a loop driven by a channel: which kind, how far its packets are from what it hears by itself, slot
        by slot, and how much of it the loop takes part in.
    """
    for (site, route, slot), miss in misses.items():
        for kind in luck:
            if (kind.listened.route, kind.sender) != (route, classes[site]):
                continue
            left, right, weights = miss[None], miss[None], np.array([share])
            if kind is driving:
                # by (m oᵀ + o mᵀ), and o oᵀ itself once, in the loop of all.
                numbers = arithmetic_of(miss)
                more = entrywise(miss, number_of(2 * by, numbers))
                more = numbers.add(more, matrices[slot]) if by > 0 else more
                left, right = np.stack([miss, more]), np.stack([miss, matrices[slot]])
                weights = np.array([share, 1.0])
            yield Answer(kind.places[slot], left, right, weights, kind.entries[slot], kind.spreads[slot])


def _luck(common: Loop, weights: Coupling, memories: Sequence[Remembered]) -> list[_Luck]:
    """Return the luck of the channels left to chance, one of each kind."""
    kinds: list[_Luck] = []
    first = 0
    for memory in memories:
        count, total = len(memory.channels), sum(memory.sizes)
        starts = np.cumsum([0, *memory.sizes])
        numbers = np.ones((count, count))  # all numbers of a packet are lost together
        spreads = tuple(np.kron(numbers, memory.memory.spread(slot)) for slot in range(memory.memory.slots))
        entries = tuple(np.array(np.triu_indices(count * size)) for size in memory.sizes)
        units = []
        for start, size, listed in zip(starts, memory.sizes, entries, strict=False):
            where = (np.arange(count)[:, None] * total + start + np.arange(size)).ravel()
            for a, b in where[listed].T:
                unit = np.zeros((count * total, count * total))
                unit[a, b] = unit[b, a] = 1.0
                units.append(unit)
        if not units:
            continue
        for h, site in enumerate(common.sites):
            for g in range(len(common.sites)):
                weighed = {
                    way: rows[h][g] for way, rows in weights.items() if (way.link, way.delay) == memory.route
                }
                if any(weighed.values()) and (g != h or site.count > 1):
                    ends = np.cumsum([first, *(entry.shape[1] for entry in entries)]).tolist()
                    places = tuple(map(slice, ends, ends[1:]))
                    listened = Listened(h, memory.route, weighed)
                    kinds.append(_Luck(g, listened, spreads, places, entries, np.array(units)))
                    first = ends[-1]
    return kinds


def standing_motions(loop: Loop) -> Floats:
    """Return the rigid motions of a loop over its sites' own states."""
    states = sum(len(site.z_names) for site in loop.sites)
    return find_rigid_modes(without_packets(loop), with_drifts=False).basis[:states]


def peer_classes(hearing: Hearing) -> tuple[tuple[Loop, ...], Coupling]:
    """Return the loops of a scene, that of all classes first, and what a peer of one weighs one of another
    by.

    Peers of a class can change places: each hears all others alike, of its own class too, or none of them.
    """
    groups, exchange = hearing.groups, hearing.exchange
    if all(exchange.is_complete(way.link) for way in used_ways(group.schedule for group in groups)):
        degrees = complete_degrees(groups, exchange)

        def one(way: Way, g: int, h: int) -> Fraction:
            return Fraction(groups[h].count > (1 if g == h else 0))

        return complete_loops(groups, exchange), couple(groups, exchange, one, degrees)
    whole = dense_loop(groups, exchange)
    loops = split_exchangeable(whole, exchange)
    place = {int(group.peers[0]): number for number, group in enumerate(whole.sites)}
    first = [place[int(site.peers[0])] for site in loops[0].sites]
    last = [place[int(site.peers[-1])] for site in loops[0].sites]
    weights = {
        way: tuple(tuple(rows[g][last[k] if g == h else h] for k, h in enumerate(first)) for g in first)
        for way, rows in whole.coupling.items()
    }
    return loops, weights


def remembered_of(
    system: CompiledSystem,
    hearing: Hearing,
    common: Loop,
    *,
    perfect: bool = False,
    lost: Mapping[str, tuple[float, ...]] = EXACTLY,
) -> list[Remembered]:
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
        link's name, as for `memory.memory_of`.
    """
    heard: dict[Route, list[Selected]] = {}
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


def instants(hearing: Hearing, clock: Clock) -> list[Fraction]:
    """Return when a clock ticks in a frame, in seconds."""
    phase, period = hearing.timings[clock.phase], hearing.timings[clock.period]
    return [phase % period + number * period for number in range(int(hearing.frame / period))]
