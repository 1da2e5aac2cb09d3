"""The mean loops and the luck of a scene: what its second moments are made of.

Takes: a `CompiledSystem` whose links lose or delay packets independently of each other.
Gives: `crowd`.
Guarantees: equal peers on complete graphs cost the same, however many they are; peers that can change places
are one class on any graph.
Does not: serve what `unserved` names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Loop, without_packets
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import complete_degrees, complete_loops, couple, dense_loop, split_exchangeable
from apc.eigen.peer_group import PeerGroup, used_ways
from apc.eigen.rigid import find_rigid_modes
from apc.frame.exchange import Exchange
from apc.frame.parameters import resolve
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.frame.discretize import UNIT
from apc.frame.schedule import Schedule, Selected, Way, tick_by_tick
from apc.frame.scheduling import build_schedules
from apc.moments.gains import Luck, Moments, Part
from apc.moments.mean_loops import Listened, Remembered, Route, mean_loop, remember
from apc.moments.memory import memory_of
from apc.network.channel import channel_law

Floats = NDArray[np.float64]


def crowd(system: CompiledSystem, prepared: Prepared) -> Moments:
    """Make the mean loops of a scene and the luck that drives them.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    """
    numbers = resolve(system)
    timings = numbers.timings
    patterns = [site.pattern for site in prepared.jacobians]
    kept = {link.name: 0 for link in system.links}
    schedules = build_schedules(system, timings, patterns, order=prepared.order, kept=kept)
    apart = {id(one): tick_by_tick(one) for one in schedules}
    rows = {id(apart[id(one)]): one.selected for one in schedules}
    by_tick = replace(prepared, schedules=tuple(apart[id(one)] for one in schedules), timings=timings)
    groups, exchange = lifted_groups(system, prepared=by_tick)
    loops, weights = _loops(groups, exchange)
    remembered = _remembered(system, timings, schedules, rows, loops[0], prepared.order)
    listened = _listened(loops[0], weights, remembered)
    parts = []
    means = [0.0, 0.0]
    luck = [
        Luck(
            route=one.route,
            sender=g,
            receiver=one.site,
            receivers=loops[0].sites[one.site].count,
            heard=loops[0].sites[g].count - (1 if g == one.site else 0),
            spreads=tuple(_spread(next(r for r in remembered if r.route == one.route), slot)
                          for slot in range(next(r for r in remembered if r.route == one.route).memory.slots)),
        )
        for g, one in listened
    ]
    for place, loop in enumerate(loops):
        alone = None if place == 0 else next(
            h for h, site in enumerate(loops[0].sites) if site.name == loop.sites[0].name
        )
        own = {
            d: one if alone is None else replace(one, site=0)
            for d, (_, one) in enumerate(listened)
            if alone is None or one.site == alone
        }
        standing = find_rigid_modes(without_packets(loop), with_drifts=False).directions
        z = sum(len(site.lifted.z_names) for site in loop.sites)
        mean, channels = mean_loop(
            loop,
            [rows[id(site.schedule)] for site in loop.sites],
            remembered,
            list(own.values()),
            standing[:z],
        )
        _, found = enclose_eigenvalues(value_of(mean.matrix), radius_of(mean.matrix))
        means = [max(means[0], found.low), max(means[1], found.high)]
        classes = tuple(range(len(loop.sites))) if alone is None else (alone,)
        parts.append(Part(mean, alone, classes, dict(zip(own, channels, strict=True))))
    return Moments(tuple(parts), tuple(luck), (means[0], means[1]))


def _spread(one: Remembered, slot: int):
    spread = one.memory.spread(slot)
    many = np.kron(np.ones((len(one.channels), len(one.channels))), spread)
    return with_radius(many, 16 * UNIT * np.abs(many))


def _loops(groups: Sequence[PeerGroup], exchange: Exchange):
    """Return the loops, that of all classes first, and one channel's weight by way, receiver and sender."""
    ways = used_ways(group.schedule for group in groups)
    if all(exchange.is_complete(way.link) for way in ways):
        degrees = complete_degrees(groups, exchange)
        one = couple(groups, exchange, lambda way, g, h: Fraction(groups[h].count > (1 if g == h else 0)), degrees)
        return complete_loops(groups, exchange), one
    whole = dense_loop(groups, exchange)
    loops = split_exchangeable(whole, exchange)
    places = {int(group.peers[0]): place for place, group in enumerate(whole.sites)}
    first = [int(site.peers[0]) for site in loops[0].sites]
    other = [int(site.peers[-1]) for site in loops[0].sites]
    weights = {
        way: tuple(
            tuple(rows[places[first[g]]][places[other[h] if g == h else first[h]]] if g != h or first[g] != other[g] else Fraction(0)
                  for h in range(len(first)))
            for g in range(len(first))
        )
        for way, rows in whole.coupling.items()
    }
    return loops, weights


def _remembered(system, timings, schedules, rows, common: Loop, order) -> list[Remembered]:
    links = {link.name: link for link in system.links}
    clocks = {one.name: one for one in system.clocks}
    frame = schedules[0].frame_s
    heard: dict[Route, list[Selected]] = {}
    for site in common.sites:
        q = site.lifted.q
        d = site.lifted.d
        for row, one in enumerate(rows[id(site.schedule)]):
            if one.gap or not (q[:, row].any() or d[:, row].any()):
                continue
            heard.setdefault((one.way.link, one.way.delay), []).append(one)
    found = []
    for route, listed in sorted(heard.items()):
        link = links[route[0]]
        delay = timings[route[1]]
        period = timings[clocks[link.clock].period]
        phase = timings[clocks[link.clock].phase] % period
        sent = [phase + k * period for k in range(int(frame / period))]
        ticks = {}
        for one in listed:
            own = timings[clocks[one.clock].period]
            ticks[one.clock, one.tick] = timings[clocks[one.clock].phase] % own + one.tick * own
        law = channel_law(system, link, delay)
        strictly = order.index("tick") < order.index("deliver")
        memory = memory_of(law, delay, sent, ticks, frame, strictly=strictly)
        found.append(remember(route, memory, tuple(sorted({one.channel for one in listed}))))
    return found


def _listened(common: Loop, weights, remembered) -> list[tuple[int, Listened]]:
    found = []
    for one in remembered:
        if not any(len(one.memory.uncertain(slot)) for slot in range(one.memory.slots)):
            continue
        for h, site in enumerate(common.sites):
            for g, sender in enumerate(common.sites):
                own = {
                    way: rows[h][g]
                    for way, rows in weights.items()
                    if (way.link, way.delay) == one.route and rows[h][g]
                }
                if own and (g != h or site.count > 1):
                    found.append((g, Listened(h, one.route, own)))
    return found
