"""Whether a scene is stable for every delay of its links in a range: all of them at once.

Takes: a `CompiledSystem` and a parameter or timing that reaches nothing but how late packets are.
Gives: `LateStretch`, `late_stretches`.
Guarantees: stretches join on without a gap; within one, nothing depends on the delay.
Does not: vary what is held late, or what a force depends on (see `delays`); prove what it says of a stretch,
a count in floats as in `plane`.

A site's frame doesn't know which packet each of its ticks hears: with a row of r for each tick, one lifting
serves for all delays. What they tell is which packet stands in which row, how many frames of age (ζ to the
minus that); packets a whole frame later are the same ones, a frame older.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.compiler.multiples import common_divisor
from apc.eigen.bordered import Bordered, Logarithm, bordered, logarithm, side_by_side
from apc.eigen.closing import Loop, without_packets
from apc.eigen.modes import arrange
from apc.eigen.rigid import find_rigid_modes
from apc.frame.ages import aged
from apc.frame.hyperperiod import ClockGrid, Times
from apc.frame.names import Free
from apc.frame.parameters import resolve
from apc.frame.radius import value_of
from apc.frame.schedule import Schedule, Selected, tick_by_tick
from apc.frame.scheduling import build_schedules, newest
from apc.vary.delays import INSIDE, reaches_parameters, system_with_delay, timing_slopes
from apc.vary.encirclements import count_beyond
from apc.vary.evaluator import Asked

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]

# What a row of r hears at one delay: the slot it was sent at, and how many frames ago.
_Packet = tuple[int, int]

# Delays that are looked at together: the oldest packet of any at most so many times as old as that of each.
OCTAVE = 2

# Ranges of delays whose loops are kept for the next question: each may be tens of megabytes.
KEPT = 4


@dataclass(frozen=True, slots=True)
class LateStretch:
    """Delays between `low` and `high` seconds; `stable` is None where an eigenvalue is on the circle."""

    low: Fraction
    high: Fraction
    stable: bool | None


@dataclass(frozen=True, slots=True, eq=False)
class _LateSheet:
    """A loop at some delays, whose numbers are the values: a `plane.Sheet`.

    `loops` are those of all delays that are alike but for the age of packets; `alike` (k,) says which of them
    a delay's is, and `lags` (k, l) the ages there.
    """

    loops: Bordered
    alike: Integers
    lags: Integers
    rigid: int
    longest: int

    @property
    def states(self) -> int:
        """How many zeros it has, less what its packets make of them."""
        return self.loops.states

    def at(self, values: Floats, rows: Integers, points: Complexes) -> Logarithm:
        """Return the logarithm of F at points (z,), each at the delay with the number of its row."""
        number = values.astype(np.intp)[rows]
        return logarithm(self.loops, self.lags[number], self.alike[number], points, self.rigid)


def late_stretches(
    system: CompiledSystem,
    free: Free,
    low: Fraction,
    high: Fraction,
    prepared: Prepared,
    following: Callable[[Fraction], Fraction],
) -> list[LateStretch] | None:
    """Return the stretches of a range and whether each is stable, None where more than lags may change.

    Parameters
    ----------
    system, free
        The compiled scene and what varies.
    low, high
        Between which values.
    prepared
        From `analysis.prepare`; all sites as their parameters say.
    following
        From `delays.borders`.
    """
    moving = {name for name, slope in timing_slopes(system, free).items() if slope}
    if not _only_late(system, free, prepared, moving):
        return None
    borders = [low]
    while borders[-1] < high:
        borders.append(following(borders[-1]))
    pieces = tuple(itertools.pairwise(borders))
    found = np.zeros(len(pieces))
    for sheet in _sheets(Asked.of(system, [free], prepared), pieces):
        found += _beyond(sheet)
    if np.isnan(found).all():  # a drift, say, which keeps two eigenvalues at 1
        return None
    stable = [None if np.isnan(count) else count == 0 for count in found.tolist()]
    return [LateStretch(*piece, one) for piece, one in zip(pieces, stable, strict=True)]


@lru_cache(maxsize=KEPT)
def _sheets(of: Asked, pieces: tuple[tuple[Fraction, Fraction], ...]) -> tuple[_LateSheet, ...]:
    """Return each loop of a scene at a delay within each piece, and keep them for the next question."""
    system, prepared, (free,) = of.system, of.prepared, of.free
    slopes = timing_slopes(system, free)
    values = [start + INSIDE * (end - start) for start, end in pieces]
    inside = system_with_delay(system, free, values[0])
    timings = resolve(inside).timings
    patterns = [site.pattern for site in prepared.jacobians]
    kept = {link.name: 0 for link in system.links}
    schedules = build_schedules(inside, timings, patterns, order=prepared.order, kept=kept)
    delays = {
        name: [timings[name] + slopes[name] * (value - values[0]) for value in values]
        for name in {row.way.delay for one in schedules for row in one.selected}
    }
    packets = _packets(inside, schedules, delays, prepared.order)
    apart = {id(one): tick_by_tick(one) for one in schedules}
    by_tick = replace(prepared, schedules=tuple(apart[id(one)] for one in schedules), timings=timings)
    selected = {id(apart[id(one)]): one.selected for one in schedules}
    found = []
    for loop in arrange(*lifted_groups(inside, prepared=by_tick)).loops:
        rows = [
            [None if row.gap else packets[row] for row in selected[id(group.schedule)]]
            for group in loop.sites
        ]
        found.append(_sheet(loop, rows, len(pieces)))
    return tuple(found)


def _only_late(system: CompiledSystem, free: Free, prepared: Prepared, moving: set[str]) -> bool:
    """Say whether a value makes packets late, and nothing else that matters: no age of theirs."""
    if aged(system):
        return False
    held = {
        hold.delay
        for group, schedule in zip(system.groups, prepared.schedules, strict=True)
        for hold, acting in zip(system.kinds[group.kind].holds, schedule.acting, strict=True)
        if acting is not None
    }
    return not moving & held and not reaches_parameters(system, free)


def _packets(
    system: CompiledSystem,
    schedules: Sequence[Schedule],
    delays: dict[str, list[Fraction]],
    order: Sequence[str],
) -> dict[Selected, list[_Packet]]:
    """Return what each row of r hears at each of some delays, these by their name."""
    timings = resolve(system).timings
    clocks = {one.name: (timings[one.phase], timings[one.period]) for one in system.clocks}
    frame = schedules[0].frame_s
    apart = [value for late in delays.values() for value in late]
    quantum = common_divisor([frame, *(time for one in clocks.values() for time in one), *apart])
    times = Times(
        quantum=quantum,
        frame=int(frame / quantum),
        clocks={
            name: ClockGrid(int(phase % period / quantum), int(period / quantum))
            for name, (phase, period) in clocks.items()
        },
        delays={},
    )
    rank = {name: place for place, name in enumerate(order)}
    links = {link.name: link for link in system.links}
    rows = dict.fromkeys(row for one in schedules for row in one.selected)
    found: dict[Selected, list[_Packet]] = {row: [] for row in rows}
    for place in range(len(apart) // max(len(delays), 1)):
        here = replace(times, delays={name: int(late[place] / quantum) for name, late in delays.items()})
        for row, listed in found.items():
            at = here.clocks[row.clock].at(row.tick - row.way.before)
            one = newest(row.way, row.channel, links[row.way.link], at, here, rank)
            listed.append((one.sent.slot, one.lag))
    return found


def _sheet(loop: Loop, rows: Sequence[Sequence[Sequence[_Packet] | None]], count: int) -> _LateSheet:
    """Return a loop at all delays.

    Parameters
    ----------
    loop
        The loop, its sites hearing each tick by itself.
    rows
        What each row of r of each site hears at each delay; None for nothing.
    count
        How many delays there are.
    """
    heard = [(g, row, packets) for g, listed in enumerate(rows) for row, packets in enumerate(listed)]
    lags = [
        sorted({packets[place][1] for *_, packets in heard if packets is not None} or {0})
        for place in range(count)
    ]
    most = max(map(len, lags))
    kinds: dict[tuple[tuple[int, int], ...], int] = {}
    alike = [
        kinds.setdefault(
            tuple(
                (-1, 0) if packets is None else (packets[place][0], own.index(packets[place][1]))
                for *_, packets in heard
            ),
            len(kinds),
        )
        for place, own in enumerate(lags)
    ]
    sent = [group.schedule.sent for group in loop.sites]
    starts = np.cumsum([0, *map(len, sent)])
    weights = np.zeros((most, len(kinds), len(heard), int(starts[-1])))
    for kind, packets in enumerate(kinds):
        for line, ((g, row, _), (slot, layer)) in enumerate(zip(heard, packets, strict=True)):
            one = loop.sites[g].schedule.heard[row]
            packet = replace(one.sent, slot=slot)
            for h, weight in enumerate(loop.coupling[one.way][g]):
                if weight and slot >= 0:
                    weights[layer, kind, line, starts[h] + sent[h].index(packet)] = float(weight)
    loops = bordered(side_by_side([group.lifted.mapped(value_of) for group in loop.sites]), weights)
    rigid = len(find_rigid_modes(without_packets(loop), with_drifts=False).names)
    ages = np.array([one + [0] * (most - len(one)) for one in lags])
    return _LateSheet(loops, np.array(alike), ages, rigid, int(ages.max()))


def _beyond(sheet: _LateSheet) -> Floats:
    """Return how many eigenvalues of a loop are beyond the circle at each of its delays (k,)."""
    oldest = sheet.lags.max(axis=1)
    found, left = np.zeros(len(oldest)), np.ones(len(oldest), dtype=bool)
    while left.any():
        longest = int(oldest[left].max())
        some = left & (oldest * OCTAVE >= longest)
        within = replace(sheet, longest=longest)
        found[some] = count_beyond(within, np.flatnonzero(some).astype(np.float64))
        left &= ~some
    return found
