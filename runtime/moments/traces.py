"""A scene over recorded delays, played again and again: frames that come back after a period.

Takes: a scene all of whose unreliable links say `trace`.
Gives: `trace_radius`.
Guarantees: nothing is left to chance: each frame hears what `simulate` hears, once the first packets are
gone.
Does not: serve values that stand in for missed ones, or a trace of losses only.

Which packet a tick hears follows from the trace, so every frame of a period is a loop like that of an ideal
network, its packets of other ages; what all do in a period is the product of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem, Link
from apc.eigen.closing import Loop, close, feedback_of, lay_out_loop
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import arrange
from apc.eigen.peer_group import MOST_STATES
from apc.eigen.relative import relative, relative_coordinates
from apc.eigen.rigid import find_rigid_modes
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.frame.schedule import Heard, Schedule, Selected, Sent
from apc.moments.crowd import Hearing, hearing, instants

Floats = NDArray[np.float64]

# Frames of a period that are multiplied one by one.
MOST_FRAMES = 20_000


def trace_radius(system: CompiledSystem, prepared: Prepared) -> tuple[float, float] | str:
    """Return bounds on what motions grow by in a frame, on the mean over a period; or why there are none.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    """
    told = hearing(system, prepared)
    links = {link.name: link for link in system.links}
    clocks = {clock.name: clock for clock in system.clocks}
    loops = arrange(told.groups, told.exchange).loops
    rows = {row: None for listed in told.rows.values() for row in listed}
    heard: dict[Selected, list[int]] = {}
    periods = []
    for row in rows:
        link = links[row.way.link]
        sent = instants(told, clocks[link.clock])
        tick = instants(told, clocks[row.clock])[row.tick]
        heard[row] = _heard(link, told.timings[row.way.delay], sent, tick, told)
        periods.append(len(heard[row]))
    frames = math.lcm(*periods) if periods else 1
    if frames > MOST_FRAMES:
        return f"the recorded delays come again after {frames:,} frames, and {MOST_FRAMES:,} are the most"
    slots = {name: len(instants(told, clocks[link.clock])) for name, link in links.items()}
    depth = {
        name: max(
            (-(number // slots[name]) for row in rows if row.way.link == name for number in heard[row]),
            default=0,
        )
        for name in links
    }
    low, high = 0.0, 0.0
    for loop in loops:
        if (
            sum(
                len(site.lifted.z_names) + sum(depth[one.link] for one in site.schedule.sent)
                for site in loop.sites
            )
            > MOST_STATES
        ):
            return "the recorded delays are longer than can be followed"
        found = _period(loop, told, heard, depth, slots, frames)
        low, high = max(low, found[0]), max(high, found[1])
    return low, high


def _heard(link: Link, delay: Fraction, sent: Sequence[Fraction], tick: Fraction, told: Hearing) -> list[int]:
    """Return which packet a tick hears, frame by frame over a period, counted from the first of its frame."""
    slots = len(sent)
    trace = None if link.channel is None else link.channel.trace
    delays = np.array([float(delay)]) if trace is None else trace
    period = math.lcm(len(delays), slots) // slots
    finite = delays[np.isfinite(delays)]
    back = math.ceil(Fraction(float(finite.max())) / told.frame) + math.ceil(len(delays) / slots) + 2
    found = []
    for frame in range(period):
        best: tuple[Any, int] | None = None
        for number in range(-back * slots, slots):
            ago, slot = divmod(number, slots)
            late = delays[(frame * slots + number) % len(delays)]
            if not np.isfinite(late):
                continue
            exact = delay if trace is None else Fraction(float(late))
            arrived = sent[slot] + ago * told.frame + exact
            if arrived < tick or (arrived == tick and not told.strictly):
                rank = (
                    number if link.channel is None or link.channel.reorder == "newest" else (arrived, number)
                )
                if best is None or rank > best[0]:
                    best = rank, number
        assert best is not None
        found.append(best[1])
    return found


def _period(
    loop: Loop,
    told: Hearing,
    heard: Mapping[Selected, Sequence[int]],
    depth: Mapping[str, int],
    slots: Mapping[str, int],
    frames: int,
) -> tuple[float, float]:
    """Return bounds on the growth of a loop in a frame."""
    product = None
    at = None
    for frame in range(frames):
        sites = []
        for site in loop.sites:
            rows = tuple(
                _packet(row, heard[row][frame % len(heard[row])], slots)
                for row in told.rows[id(site.schedule)]
            )
            depths = tuple(depth[one.link] for one in site.schedule.sent)
            schedule: Schedule = replace(site.schedule, heard=rows, depths=depths)
            sites.append(replace(site, schedule=schedule))
        now = replace(loop, sites=tuple(sites))
        layout = lay_out_loop(now)
        matrix = close(
            [site.lifted.bounded for site in sites], feedback_of(now, layout), layout, numbers=RADII
        ).matrix
        if at is None:
            at = relative_coordinates(find_rigid_modes(now, with_drifts=False).basis)
        known = replace(at, weights=with_radius(at.weights, at.doubt))
        own = relative(matrix, known, RADII)
        product = own if product is None else RADII.multiply(own, product)
    assert product is not None
    _, found = enclose_eigenvalues(value_of(product), radius_of(product))
    return found.low ** (1 / frames), found.high ** (1 / frames)


def _packet(row: Selected, number: int, slots: Mapping[str, int]) -> Heard:
    frames, slot = divmod(number, slots[row.way.link])
    return Heard(row.way, Sent(row.way.link, row.channel, slot), -frames)
