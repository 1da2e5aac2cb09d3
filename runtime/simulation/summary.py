"""What a simulated motion amounts to, in numbers and a word: whether it settles, and how far it goes.

Takes: the rows of a simulation, as they come. Gives: `Watch`, `Summary`, `Extent`, `Broken`.
Guarantees: the memory used does not grow with the duration.
Does not: prove anything: what it says holds for the time that was simulated (see `analysis` for proof).

Settled means: from some time on, well before the end, every position stays within `BAND` of its range around
its last value; the range is the largest that any peer's position of that name goes through. A motion that
does not settle *shakes* if it turns to and fro without dying away, *dies away* if it turns and gets smaller,
*diverges* if a number leaves the range of floats, and *moves on* otherwise. It *rests* if no position ever
changes. Without a position that was recorded it is *not judged*. An angle is a position, too.

The work a coupler does is ∫ −f v dt over the forces it holds, f the flow into the coupler at each of its
flanges and v that flange's velocity: exact, as f is constant between events. Positive work feeds the motion.

A limit is of a device's force and reach, and of whatever else declares one; it is looked at in every row of
what is recorded. To keep a motion within it is for equations (`limits: on` of a device).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ANGLES, LENGTH, CompiledSystem, Group
from apc.simulation.rows_in_time import Block
from apc.simulation.signals import Signal
from apc.simulation.simulation import Simulation

Floats = NDArray[np.float64]

BAND = 0.05  # of the range: the 5 % of control engineering's settling time
LATE = 0.9  # of the duration: what settles after that has not been seen to
TAIL = 0.2  # of the duration: the end, where a motion that goes on is judged
LEAST_WAY = 0.2  # of the range: a shorter way from first to last has no overshoot to speak of
POSITIONS = (LENGTH, *ANGLES)  # the units of what decides whether a motion settles
NOT_JUDGED = "not judged"
FEWEST_TURNS = 4  # within the tail: two periods
SMALLER = 0.9  # a swing of less than this part of that in the time before is dying away
BUCKETS = 512  # times that extremes are kept for
MOST_EXTREMES = 2**22  # numbers kept for each of three tables: 32 MiB


@dataclass(frozen=True, slots=True)
class Broken:
    """A limit that was broken: the `signal`, its `limit` by name and `value`, in SI, with its `unit`.

    It is beyond it from `first_s` seconds on; its largest size is `most`, at `at_s` seconds.
    """

    signal: str
    limit: str
    value: float
    unit: str
    first_s: float
    most: float
    at_s: float


@dataclass(frozen=True, slots=True)
class Extent:
    """Where a signal began, ended and went, in SI; `settled` seconds after which it stays, None if never."""

    name: str
    unit: str
    first: float
    last: float
    low: float
    high: float
    settled: float | None


@dataclass(frozen=True, slots=True)
class Summary:
    """A simulation in numbers, SI.

    `verdict` is "rests", "settles", "dies away", "shakes", "moves on", "diverges" or "not judged"; `settled`
    is the time from which on it stays, in seconds. `overshoot` is a part of the way from first to last.
    `copies` are (name, distance at the end) of what is sent to the others as it is. `work` is (part, J).
    `broken` are the limits that recorded signals went beyond, the first one first. `unrecorded` positions of
    the scene were not looked at.
    """

    verdict: str
    settled: float | None
    stopped: str
    stopped_at: float | None
    swing: tuple[str, float, float] | None
    overshoot: tuple[str, float] | None
    largest_force: tuple[str, float, float] | None
    copies: tuple[tuple[str, float], ...]
    work: tuple[tuple[str, float], ...]
    rows: int
    signals: int
    end: float
    extents: tuple[Extent, ...]
    broken: tuple[Broken, ...] = ()
    unrecorded: int = 0


class Watch:
    """Looks at a simulation's rows as they pass and keeps extremes, bucket by bucket of rows."""

    def __init__(self, simulation: Simulation) -> None:
        """Begin before the first row of what is played."""
        self.simulation, self.signals = simulation, simulation.signals
        n = len(self.signals)
        self.positions = [i for i, signal in enumerate(self.signals) if is_position(signal)]
        self.forces = [
            i for i, signal in enumerate(self.signals) if signal.unit == "N" and signal.role != "limited"
        ]
        self.limits = _limits(simulation.system, self.signals)
        self.width = -(-simulation.rows // max(16, min(BUCKETS, MOST_EXTREMES // max(n, 1))))
        buckets = -(-simulation.rows // self.width)
        self.low, self.high = np.full((buckets, n), np.inf), np.full((buckets, n), -np.inf)
        self.turns = np.zeros((buckets, len(self.positions)), np.int64)
        self.ends = np.zeros(buckets)
        self.before = np.empty((0, len(self.positions)))  # the last two rows
        self.first, self.last = np.zeros(n), np.zeros(n)
        self.peak, self.peak_at = np.full(n, -1.0), np.zeros(n)
        self.beyond = np.full(len(self.limits), np.nan)
        self.rows = 0

    def take(self, time: Floats, values: Floats) -> None:
        """Look at some rows: `time` (rows,), `values` (rows, signals)."""
        if not len(time):
            return
        if not self.rows:
            self.first = values[0].copy()
        self.last = values[-1].copy()
        bucket = (self.rows + np.arange(len(time))) // self.width
        self.rows += len(time)
        touched, starts = np.unique(bucket, return_index=True)
        self.low[touched] = np.minimum(self.low[touched], np.minimum.reduceat(values, starts))
        self.high[touched] = np.maximum(self.high[touched], np.maximum.reduceat(values, starts))
        self.ends[bucket] = time
        moving = np.concatenate([self.before, values[:, self.positions]])
        way = np.sign(np.diff(moving, axis=0))
        turned = np.zeros((len(time), len(self.positions)), np.int64)
        turned[len(time) - max(len(way) - 1, 0) :] = way[1:] * way[:-1] < 0
        self.turns[touched] += np.add.reduceat(turned, starts)
        self.before = moving[-2:]
        watched = np.array([*self.forces, *(column for column, _, _ in self.limits)], np.int64)
        size = np.abs(values[:, watched])
        largest = size.max(axis=0)
        grown = largest > self.peak[watched]
        self.peak[watched[grown]] = largest[grown]
        self.peak_at[watched[grown]] = time[size.argmax(axis=0)[grown]]
        over = size[:, len(self.forces) :] > [bound for _, _, bound in self.limits]
        began = over.any(axis=0) & np.isnan(self.beyond)
        self.beyond[began] = time[over.argmax(axis=0)[began]]

    def summary(self, block: Block) -> Summary:
        """Return what has been seen; `block` is the last."""
        assert self.rows, "a simulation has a row at time 0"
        number = (self.rows - 1) // self.width + 1
        low, high, ends = self.low[:number], self.high[:number], self.ends[:number]
        with np.errstate(over="ignore", invalid="ignore"):  # of what has diverged
            settled = self._settled(low, high, ends)
            swing = self._swing(low, high, ends, settled)
        signals, unsettled = self.signals, np.isnan(settled)
        numbers = np.stack([self.first, self.last, low.min(axis=0), high.max(axis=0)], axis=1).tolist()
        extents = tuple(
            Extent(signal.name, signal.unit, first, last, least, most, None if np.isnan(since) else since)
            for signal, since, (first, last, least, most) in zip(
                signals, settled.tolist(), numbers, strict=True
            )
        )
        moved = [extents[i] for i in self.positions]
        if block.stopped:
            verdict, swing = "diverges", None
        elif not self.positions:
            verdict = NOT_JUDGED
        elif all(extent.low == extent.high for extent in moved):
            verdict = "rests"
        elif not unsettled[self.positions].any():
            verdict = "settles"
        else:
            verdict = "moves on" if swing is None else "dies away" if swing[3] else "shakes"
        settles = verdict == "settles"
        largest = max(self.forces, key=lambda i: float(self.peak[i]), default=-1)
        work = tuple(zip(self.simulation.population.parts, block.work.tolist(), strict=True))
        force = None
        if largest >= 0:
            force = signals[largest].name, float(self.peak[largest]), float(self.peak_at[largest])
        return Summary(
            verdict=verdict,
            settled=float(settled[self.positions].max()) if settles else None,
            stopped=block.stopped,
            stopped_at=block.stopped_at if block.stopped else None,
            swing=swing[:3] if swing else None,
            overshoot=_overshoot(moved) if settles else None,
            largest_force=force,
            copies=self._copies(),
            # Of a motion without bound the work is as meaningless as it is large.
            work=() if block.stopped else work,
            rows=self.rows,
            signals=len(signals),
            end=float(ends[-1]),
            extents=extents,
            broken=self._broken(),
            unrecorded=_positions(self.simulation.system) - len(self.positions),
        )

    def _settled(self, low: Floats, high: Floats, ends: Floats) -> Floats:
        """Return when each signal is within its band for good; NaN if that is not well before the end."""
        span = high.max(axis=0) - low.min(axis=0)
        names = np.array([signal.local for signal in self.signals])
        for name in dict.fromkeys(names.tolist()):  # the largest range among the peers
            span[names == name] = span[names == name].max()
        outside = (high - self.last > BAND * span) | (self.last - low > BAND * span)
        after = np.where(outside.any(axis=0), len(outside) - outside[::-1].argmax(axis=0), 0)
        since = np.append(0.0, ends)[after]
        return np.where(since <= LATE * ends[-1], since, np.nan)

    def _swing(
        self, low: Floats, high: Floats, ends: Floats, settled: Floats
    ) -> tuple[str, float, float, bool] | None:
        """Return the position that turns, does not settle and swings most at the end; None if none does.

        That is, its name, the way to and fro, how often a second, and whether it is dying away.
        """
        number = len(ends)
        tail = max(1, round(TAIL * number))
        if number < 2 * tail:
            return None
        now, then = slice(number - tail, number), slice(number - 2 * tail, number - tail)
        turns = self.turns[:number][now].sum(axis=0)
        places = [
            i
            for i, many in zip(self.positions, turns, strict=True)
            if np.isnan(settled[i]) and many >= FEWEST_TURNS
        ]
        if not places:
            return None
        swing = high[now].max(axis=0) - low[now].min(axis=0)
        ranges = np.maximum(high.max(axis=0) - low.min(axis=0), np.finfo(float).tiny)
        units = [
            signal.unit for signal in self.signals
        ]  # a length and an angle are each compared with their like
        span = {
            unit: max(ranges[i] for i in self.positions if units[i] == unit)
            for unit in {*map(units.__getitem__, places)}
        }
        place = max(places, key=lambda i: float(swing[i] / span[units[i]]))
        seconds = ends[-1] - (ends[number - tail - 1] if number > tail else 0.0)
        rate = float(turns[self.positions.index(place)] / 2 / seconds) if seconds > 0 else 0.0
        earlier = high[then, place].max() - low[then, place].min()
        return self.signals[place].name, float(swing[place]), rate, bool(swing[place] < SMALLER * earlier)

    def _copies(self) -> tuple[tuple[str, float], ...]:
        """Return how far apart the peers' copies of each state that is sent as it is are at the end."""
        copies = []
        for name in self.simulation.sent:
            places = [
                i
                for i, signal in enumerate(self.signals)
                if signal.local == name and signal.unit in POSITIONS
            ]
            if len(places) > 1:
                copies.append((name, float(np.ptp(self.last[places]))))
        return tuple(copies)

    def _broken(self) -> tuple[Broken, ...]:
        """Return the limits that were broken, the first of them first."""
        broken = [
            Broken(
                self.signals[column].name,
                name,
                bound,
                self.signals[column].unit,
                float(first),
                float(self.peak[column]),
                float(self.peak_at[column]),
            )
            for (column, name, bound), first in zip(self.limits, self.beyond, strict=True)
            if not np.isnan(first)
        ]
        return tuple(sorted(broken, key=lambda limit: limit.first_s))


def _limits(system: CompiledSystem, signals: Sequence[Signal]) -> list[tuple[int, str, float]]:
    """Return the columns of signals that have a limit, its name and its value, those of each peer its own."""
    groups = {group.name: group for group in system.groups}
    common = {parameter.name: parameter.value for parameter in system.parameters}
    limits = {
        (group.name, limit.name): limit.limit
        for group in system.groups
        for limit in system.kinds[group.kind].limits
    }
    return [
        (column, name, _number(groups[signal.group], signal.peer, name, common))
        for column, signal in enumerate(signals)
        if (name := limits.get((signal.group, signal.local))) is not None
    ]


def _number(group: Group, peer: int, name: str, common: dict[str, float]) -> float:
    """Return a number of one peer, counted from 1: its own, its group's, or that of all."""
    for column in group.columns:
        if column.name == name:
            return float(column.values[peer - 1])
    return next((value.value for value in group.values if value.name == name), common[name])


def is_position(signal: Signal) -> bool:
    """Say whether a signal is a place, which decides whether a motion settles."""
    return signal.role == "state" and signal.unit in POSITIONS


def _positions(system: CompiledSystem) -> int:
    """Return how many positions there are in a scene."""
    each = [sum(state.unit in POSITIONS for state in kind.states) for kind in system.kinds]
    return sum(group.count * each[group.kind] for group in system.groups)


def _overshoot(extents: Sequence[Extent]) -> tuple[str, float] | None:
    """Return the largest way beyond the last value, as a part of the way from the first."""
    beyonds = []
    for extent in extents:
        way = extent.last - extent.first
        if way and abs(way) > LEAST_WAY * (extent.high - extent.low):
            beyond = extent.high - extent.last if way > 0 else extent.last - extent.low
            beyonds.append((extent.name, beyond / abs(way)))
    return max(beyonds, key=lambda pair: pair[1], default=None)
