"""A scene over recorded delays, played again and again: frames that come back after a period.

Takes: a scene all of whose unreliable links say `trace`.
Gives: `trace_radius`, `Found`; `heard_packets`, `hearing_packets`.
Guarantees: nothing is left to chance: each frame hears what `simulate` hears, once the first packets are
gone.
Does not: serve values that stand in for missed ones, or a trace of losses only.

Which packet a tick hears follows from the trace, so every frame of a period is a loop like that of an ideal
network, its packets of other ages; what all do in a period is the product of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Link
from apc.eigen.closing import Loop, close, feedback_of, lay_out_loop
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import arrange
from apc.eigen.peers import MOST_STATES
from apc.eigen.relative import Relative, relative, relative_coordinates, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.instance import Prepared
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.frame.schedule import Heard, Schedule, Selected, Sent
from apc.moments.crowd import Hearing, build_hearing, instants
from apc.moments.unserved import UnservedError
from apc.network.timetable import instant_of

Floats = NDArray[np.float64]
Balls = NDArray[Any]  # of numbers with their radii

# Frames of a period that are multiplied one by one.
MOST_FRAMES = 20_000


@dataclass(frozen=True, slots=True)
class Found:
    """What motions grow by in a frame: proved bounds, and an estimate with how far another one is from it."""

    low: float
    high: float
    radius: float
    doubt: float
    frames: int


def trace_radius(system: CompiledSystem, prepared: Prepared) -> Found:
    """Return what motions grow by in a frame, on the mean over a period.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.

    Raises
    ------
    UnservedError
        The period or the delays are too long to follow.
    """
    hearing = build_hearing(system, prepared)
    links = {link.name: link for link in system.links}
    times = {clock.name: instants(hearing, clock) for clock in system.clocks}
    rows = {row: None for listed in hearing.rows.values() for row in listed}
    slots = {name: len(times[link.clock]) for name, link in links.items()}
    frames = math.lcm(*(_period_of(links[row.way.link], slots[row.way.link]) for row in rows))
    if frames > MOST_FRAMES:
        what = f"the recorded delays come again after {frames:,} frames"
        raise UnservedError(f"{what}, and {MOST_FRAMES:,} are the most")
    heard = {
        row: heard_packets(
            link, hearing.timings[row.way.delay], times[link.clock], times[row.clock][row.tick], hearing
        )
        for row in rows
        for link in [links[row.way.link]]
    }
    depth = {
        name: max(
            (-(n // slots[name]) for row in rows if row.way.link == name for n in heard[row]), default=0
        )
        for name in links
    }
    result = []
    for loop in arrange(hearing.groups, hearing.exchange).loops:
        packets = sum(depth[sent.link] for site in loop.sites for sent in site.schedule.sent)
        if packets + sum(len(site.z_names) for site in loop.sites) > MOST_STATES:
            raise UnservedError("the recorded delays are longer than can be followed")
        result.append(_period(loop, hearing, heard, depth, slots, frames))
    low, high, radius, doubt = np.array(result).max(axis=0).tolist()
    return Found(low, high, radius, doubt, frames)


def heard_packets(
    link: Link, delay: Fraction, sent: Sequence[Fraction], tick: Fraction, hearing: Hearing
) -> list[int]:
    """Return which packet a tick hears, frame by frame over a period, counted from the first of its frame.

    Parameters
    ----------
    link, delay
        The link, and its nominal delay in seconds.
    sent, tick
        When in a frame packets are sent, and when the tick is, in seconds.
    hearing
        The peers of the scene.
    """
    slots = len(sent)
    trace = None if link.channel is None else link.channel.trace
    delays = (
        [delay]
        if trace is None
        else [instant_of(late, hearing.quantum) if math.isfinite(late) else None for late in trace.tolist()]
    )
    longest = max(late for late in delays if late is not None)
    newest = link.channel is None or link.channel.reorder == "newest"
    numbers = []
    for frame in range(_period_of(link, slots)):
        best: tuple[Fraction, int] | None = None
        for number in itertools.count(slots - 1, -1):
            ago, slot = divmod(number, slots)
            at = sent[slot] + ago * hearing.frame
            if best is not None and (newest or at + longest < best[0]):
                break  # what was sent before this can't have arrived later
            late = delays[(frame * slots + number) % len(delays)]
            if late is None or at + late > tick or (at + late == tick and hearing.strictly):
                continue
            best = max(best or (at + late, number), (at + late, number))
        assert best is not None
        numbers.append(best[1])
    return numbers


def _period_of(link: Link, slots: int) -> int:
    """Return after how many frames what ticks hear of a link comes again."""
    trace = None if link.channel is None else link.channel.trace
    count = 1 if trace is None else len(trace)
    return math.lcm(count, slots) // slots


def _period(
    loop: Loop,
    hearing: Hearing,
    heard: Mapping[Selected, Sequence[int]],
    depth: Mapping[str, int],
    slots: Mapping[str, int],
    frames: int,
) -> tuple[float, float, float, float]:
    """Return bounds on what a loop grows by in a frame, an estimate, and how far another one is from it."""
    known: dict[tuple[int, ...], Balls] = {}
    at: Relative | None = None
    rows = [hearing.rows[id(site.schedule)] for site in loop.sites]
    # The eigenvalues of a product are those of its halves in either order, with other roundings.
    halves: list[Balls] = []
    scale = 0
    for frame in range(frames):
        numbers = tuple(heard[row][frame % len(heard[row])] for listed in rows for row in listed)
        if numbers not in known:
            now = hearing_packets(loop, rows, iter(numbers), depth, slots)
            layout = lay_out_loop(now)
            maps = [site.lifted for site in now.sites]
            matrix = close(maps, feedback_of(now, layout), layout, numbers=RADII).matrix
            if at is None:
                at = with_doubt(relative_coordinates(find_rigid_modes(now, with_drifts=False).basis))
            known[numbers] = relative(matrix, at, RADII)
        if frame in (0, frames // 2):
            halves.append(known[numbers])
        else:
            product = RADII.multiply(known[numbers], halves[-1])
            halves[-1], more = _scaled(product, float(np.abs(value_of(product)).max(initial=0.0)))
            scale += more
    first, last = (halves * 2)[:2]
    product, turned = last, value_of(last)
    if frames > 1:
        product, turned = RADII.multiply(last, first), value_of(first) @ value_of(last)
    # Enclosures are as narrow as asked for where the radius is near 1.
    product, more = _scaled(product, _radius(value_of(product)))
    _, bounds = enclose_eigenvalues(value_of(product), radius_of(product))
    grown = bounds.low, bounds.high, _radius(value_of(product)), _radius(np.ldexp(turned, -more))
    low, high, radius, other = np.array(grown) ** (1 / frames) * math.exp2((scale + more) / frames)
    return low, high, radius, abs(other - radius)


def _radius(matrix: Floats) -> float:
    """Return the spectral radius of a matrix, in floats."""
    return float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0))


def _scaled(matrix: Balls, near: float) -> tuple[Balls, int]:
    """Return a matrix over the power of two that a number is near to, and its exponent."""
    exponent = math.frexp(near)[1] if 0 < near < math.inf else 0
    value, radius = (np.ldexp(item, -exponent) for item in (value_of(matrix), radius_of(matrix)))
    return with_radius(value, radius), exponent


def hearing_packets(
    loop: Loop,
    rows: Sequence[Sequence[Selected]],
    numbers: Iterator[int],
    depth: Mapping[str, int],
    slots: Mapping[str, int],
) -> Loop:
    """Return a loop whose ticks hear the packets of these numbers.

    Parameters
    ----------
    loop, rows
        The loop, and what each row of r of each site hears.
    numbers
        The packets, row after row, counted from the first of their frame.
    depth, slots
        How many frames a packet is kept for, and how many are sent in a frame, by the link's name.
    """
    sites = []
    for site, row in zip(loop.sites, rows, strict=True):
        depths = tuple(depth[sent.link] for sent in site.schedule.sent)
        packets = tuple(_packet(row, next(numbers), slots) for row in row)
        schedule: Schedule = replace(site.schedule, heard=packets, depths=depths)
        sites.append(replace(site, schedule=schedule))
    return replace(loop, sites=tuple(sites))


def _packet(row: Selected, number: int, slots: Mapping[str, int]) -> Heard:
    frames, slot = divmod(number, slots[row.way.link])
    return Heard(row.way, Sent(row.way.link, row.channel, slot), -frames)
