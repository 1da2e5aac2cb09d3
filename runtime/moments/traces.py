"""A scene over recorded delays, played again and again: frames that come back after a period.

Takes: a scene all of whose unreliable links say `trace`.
Gives: `trace_radius`, `Found`; `Packets`.
Guarantees: nothing is left to chance: each frame hears what `simulate` hears, once the first packets are
gone.
Does not: serve values that stand in for missed ones, or a trace of losses only.

Which packet a tick hears follows from the trace, so every frame of a period is a loop like that of an ideal
network, its packets of other ages; what all do in a period is the product of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.eigen.closing import ModalSystem, close, feedback_of, lay_out_loop
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import arrange
from apc.eigen.peers import MOST_STATES
from apc.eigen.relative import Relative, relative, relative_coordinates, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.instance import Prepared
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.frame.schedule import ReceivedSample, SentSample, UncertainSample
from apc.moments.crowd import PerTickReception, build_hearing, instants
from apc.network.timetable import instant_of
from apc.unserved import NotSupportedError

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


class Packets:
    """The packets of a scene, counted from the first of the frame they are looked at from: which ticks hear.

    `slots` says how many are sent in a frame on each link.
    """

    def __init__(self, system: Model, hearing: PerTickReception) -> None:
        self.hearing = hearing
        self.rows = dict.fromkeys(row for listed in hearing.rows.values() for row in listed)
        self.links = {link.name: link for link in system.links}
        self.times = {clock.name: instants(hearing, clock) for clock in system.clocks}
        self.slots = {name: len(self.times[link.clock]) for name, link in self.links.items()}

    def heard(
        self, row: UncertainSample, delay: Fraction | None = None, trace: Floats | None = None
    ) -> list[int]:
        """Return which packet a tick hears, frame by frame over a period.

        Parameters
        ----------
        row
            The tick.
        delay
            The delay of all packets in seconds, unless it is the nominal one.
        trace
            Delays to play again and again instead, in seconds, infinite for a lost packet.
        """
        link, hearing, slots = self.links[row.way.link], self.hearing, self.slots[row.way.link]
        sent, tick = self.times[link.clock], self.times[row.clock][row.tick]
        delays: list[Fraction | None] = [hearing.timings[row.way.delay] if delay is None else delay]
        if trace is not None:
            finite = np.isfinite(trace).tolist()
            pairs = zip(trace.tolist(), finite, strict=True)
            delays = [instant_of(late, hearing.quantum) if arrives else None for late, arrives in pairs]
        longest = max(late for late in delays if late is not None)
        newest = link.channel is None or link.channel.reorder == "newest"
        numbers = []
        for frame in range(_period_of(len(delays), slots)):
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

    def depths(self, numbers: Iterable[tuple[UncertainSample, int]], least: int = 0) -> dict[str, int]:
        """Return for how many frames packets of each link are kept, if ticks hear those of these numbers."""
        depths = dict.fromkeys(self.links, least)
        for row, number in numbers:
            depths[row.way.link] = max(depths[row.way.link], -(number // self.slots[row.way.link]))
        return depths

    def loop(
        self, loop: ModalSystem, numbers: Mapping[UncertainSample, int], depths: Mapping[str, int]
    ) -> ModalSystem:
        """Return a loop whose ticks hear the packets of these numbers."""
        sites = []
        for site, rows in zip(loop.sites, self.hearing.of(loop), strict=True):
            heard = []
            for row in rows:
                frames, slot = divmod(numbers[row], self.slots[row.way.link])
                heard.append(ReceivedSample(row.way, SentSample(row.way.link, row.channel, slot), -frames))
            kept = tuple(depths[sent.link] for sent in site.schedule.sent)
            sites.append(replace(site, schedule=replace(site.schedule, heard=tuple(heard), depths=kept)))
        return replace(loop, sites=tuple(sites))


def trace_radius(system: Model, prepared: Prepared) -> Found:
    """Return what motions grow by in a frame, on the mean over a period.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.

    Raises
    ------
    NotSupportedError
        The period or the delays are too long to follow.
    """
    packets = Packets(system, build_hearing(system, prepared))
    traces = {name: link.channel.trace for name, link in packets.links.items() if link.channel}
    lengths = {name: 1 if trace is None else len(trace) for name, trace in traces.items()}
    used = {row.way.link for row in packets.rows}
    frames = math.lcm(*(_period_of(lengths.get(name, 1), packets.slots[name]) for name in used))
    if frames > MOST_FRAMES:
        what = f"the recorded delays come again after {frames:,} frames"
        raise NotSupportedError(f"{what}, and {MOST_FRAMES:,} are the most")
    heard = {row: packets.heard(row, trace=traces.get(row.way.link)) for row in packets.rows}
    depths = packets.depths((row, number) for row, numbers in heard.items() for number in numbers)
    result = []
    for loop in arrange(packets.hearing.groups, packets.hearing.exchange).loops:
        kept = sum(depths[sent.link] for site in loop.sites for sent in site.schedule.sent)
        if kept + sum(len(site.z_names) for site in loop.sites) > MOST_STATES:
            raise NotSupportedError("the recorded delays are longer than can be followed")
        result.append(_period(loop, packets, heard, depths, frames))
    low, high, radius, doubt = np.array(result).max(axis=0).tolist()
    return Found(low, high, radius, doubt, frames)


def _period_of(delays: int, slots: int) -> int:
    """Return after how many frames of so many packets so many delays come again."""
    return math.lcm(delays, slots) // slots


def _period(
    loop: ModalSystem,
    packets: Packets,
    heard: Mapping[UncertainSample, Sequence[int]],
    depths: Mapping[str, int],
    frames: int,
) -> tuple[float, float, float, float]:
    """Return bounds on what a loop grows by in a frame, an estimate, and how far another one is from it."""
    known: dict[tuple[int, ...], Balls] = {}
    at: Relative | None = None
    rows = dict.fromkeys(row for listed in packets.hearing.of(loop) for row in listed)
    # The eigenvalues of a product are those of its halves in either order, with other roundings.
    halves: list[Balls] = []
    scale = 0
    for frame in range(frames):
        numbers = tuple(heard[row][frame % len(heard[row])] for row in rows)
        if numbers not in known:
            now = packets.loop(loop, dict(zip(rows, numbers, strict=True)), depths)
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
