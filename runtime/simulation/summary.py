"""What a simulated motion amounts to, in numbers and a word: whether it settles, and how far it goes.

Takes: the blocks of a simulation, as they come. Gives: `Watch`, `Summary`, `Extent`.
Guarantees: the memory used does not grow with the duration.
Does not: prove anything: what it says holds for the time that was simulated (see `analysis` for proof).

Settled means: from some time on, well before the end, every position stays within `BAND` of its range around
its last value; the range is the largest that any peer's position of that name goes through. A motion that
does not settle *shakes* if it turns to and fro without dying away, *dies away* if it turns and gets smaller,
*diverges* if a number leaves the range of floats, and *moves on* otherwise. It *rests* if no position ever
changes.

The work a coupler does is ∫ −f v dt over the forces it holds, f the flow into the coupler at each of its
flanges and v that flange's velocity: exact, as f is constant between events. Positive work feeds the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.simulation.blocks import Block
from apc.simulation.signals import Signal, sent_states
from apc.simulation.simulation import Simulation

Floats = NDArray[np.float64]

BAND = 0.05  # of the range: the 5 % of control engineering's settling time
LATE = 0.9  # of the duration: what settles after that has not been seen to
TAIL = 0.2  # of the duration: the end, where a motion that goes on is judged
LEAST_WAY = 0.2  # of the range: a shorter way from first to last has no overshoot to speak of
FEWEST_TURNS = 4  # within the tail: two periods
SMALLER = 0.9  # a swing of less than this part of that in the time before is dying away
BUCKETS = 512  # times that extremes are kept for
MOST_EXTREMES = 2**22  # numbers kept for each of three tables: 32 MiB


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

    `verdict` is "rests", "settles", "dies away", "shakes", "moves on" or "diverges"; `settled` is the time
    from which on it stays, in seconds. `overshoot` is a part of the way from first to last. `copies` are
    (name, distance at the end) of what is sent to the others as it is. `work` is (part, J).
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


class Watch:
    """Looks at the blocks of a simulation as they pass and keeps extremes, bucket by bucket of rows."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        n = len(simulation.signals)
        rows = int(simulation.settings.duration / (simulation.frame * simulation.quantum)) + 1
        rows *= len(simulation.marks)
        most = max(16, min(BUCKETS, MOST_EXTREMES // max(n, 1)))
        self.width = -(-rows // most)
        self.ends: list[float] = []
        self.low, self.high = np.empty((0, n)), np.empty((0, n))
        self.turns = np.empty((0, n), dtype=np.int64)
        self.pending, self.times = np.empty((0, n)), np.empty(0)
        self.before: Floats = np.empty((0, n))  # the last two rows already in a bucket
        self.first: Floats = np.zeros(n)
        self.last: Floats = np.zeros(n)
        self.peak, self.peak_at = np.zeros(n), np.zeros(n)
        self.rows = 0
        self.block: Block | None = None

    def take(self, block: Block) -> None:
        """Look at one block."""
        self.block = block
        if not len(block.time):
            return
        if not self.rows:
            self.first = block.values[0].copy()
        self.last = block.values[-1].copy()
        self.rows += len(block.time)
        size = np.abs(block.values)
        at = size.argmax(axis=0)
        largest = size[at, np.arange(size.shape[1])]
        higher = largest > self.peak
        self.peak = np.where(higher, largest, self.peak)
        self.peak_at = np.where(higher, block.time[at], self.peak_at)
        self._fill(np.concatenate([self.times, block.time]), np.concatenate([self.pending, block.values]))

    def _fill(self, times: Floats, values: Floats, *, all_of_it: bool = False) -> None:
        whole = len(times) // self.width
        if whole:
            cut = whole * self.width
            self._bucket(times[:cut], values[:cut], whole)
            times, values = times[cut:], values[cut:]
        if all_of_it and len(times):
            self._bucket(times, values, 1)
        self.times, self.pending = times, values

    def _bucket(self, times: Floats, values: Floats, number: int) -> None:
        shaped = values.reshape(number, len(values) // number, values.shape[1])
        self.low = np.concatenate([self.low, shaped.min(axis=1)])
        self.high = np.concatenate([self.high, shaped.max(axis=1)])
        self.ends += times.reshape(number, -1)[:, -1].tolist()
        steps = np.sign(np.diff(np.concatenate([self.before, values]), axis=0))
        turned = np.zeros(values.shape, dtype=np.int64)
        found = steps[1:] * steps[:-1] < 0
        if len(found):
            turned[-len(found) :] = found
        self.turns = np.concatenate([self.turns, turned.reshape(shaped.shape).sum(axis=1)])
        self.before = np.concatenate([self.before, values])[-2:].copy()

    def summary(self) -> Summary:
        """Return what has been seen."""
        self._fill(self.times, self.pending, all_of_it=True)
        signals, block = self.simulation.signals, self.block
        assert block is not None and self.rows, "a simulation has a row at time 0"
        end = self.ends[-1]
        low, high = self.low.min(axis=0), self.high.max(axis=0)
        with np.errstate(over="ignore"):  # of what has diverged
            settled = self._settled(self._spans(high - low), end)
        extents = tuple(
            Extent(one.name, one.unit, float(first), float(last), float(least), float(most), since)
            for one, first, last, least, most, since in zip(
                signals, self.first, self.last, low, high, settled, strict=True
            )
        )
        positions = [i for i, one in enumerate(signals) if one.role == "state" and one.unit in ("m", "rad")]
        verdict, swing = self._verdict(positions, settled, bool(block.stopped))
        if verdict == "settles" and positions and not np.any((high - low)[positions]):
            verdict = "rests"
        times = [settled[i] for i in positions]
        forces = [i for i, one in enumerate(signals) if one.unit == "N"]
        largest = max(forces, key=lambda i: float(self.peak[i]), default=None)
        return Summary(
            verdict=verdict,
            settled=max((one for one in times if one is not None), default=0.0)
            if verdict == "settles"
            else None,
            stopped=block.stopped,
            stopped_at=block.stopped_at if block.stopped else None,
            swing=swing,
            overshoot=_overshoot([extents[i] for i in positions]) if verdict == "settles" else None,
            largest_force=None
            if largest is None
            else (signals[largest].name, float(self.peak[largest]), float(self.peak_at[largest])),
            copies=_copies(self.simulation.system, signals, self.last),
            # Of a motion without bound the work is as meaningless as it is large.
            work=() if block.stopped else tuple(zip(self.simulation.parts, block.work.tolist(), strict=True)),
            rows=self.rows,
            signals=len(signals),
            end=end,
            extents=extents,
        )

    def _spans(self, own: Floats) -> Floats:
        """Return the largest range of each signal's name among the peers."""
        largest: dict[str, float] = {}
        for one, span in zip(self.simulation.signals, own, strict=True):
            largest[one.local] = max(largest.get(one.local, 0.0), float(span))
        return np.array([largest[one.local] for one in self.simulation.signals])

    def _settled(self, span: Floats, end: float) -> list[float | None]:
        """Return when each signal is within its band for good; None if that is not well before the end."""
        outside = (self.high - self.last > BAND * span) | (self.last - self.low > BAND * span)
        found: list[float | None] = []
        for column in outside.T:
            left = np.flatnonzero(column)
            at = self.ends[int(left[-1])] if len(left) else 0.0
            found.append(at if at <= LATE * end else None)
        return found

    def _verdict(
        self, positions: Sequence[int], settled: Sequence[float | None], stopped: bool
    ) -> tuple[str, tuple[str, float, float] | None]:
        """Return the word for the motion, and who swings by how much and how often a second, if anyone."""
        if stopped:
            return "diverges", None
        if all(settled[i] is not None for i in positions):
            return "settles", None
        number = len(self.ends)
        tail = max(1, round(TAIL * number))
        now, then = slice(number - tail, number), slice(max(0, number - 2 * tail), number - tail)
        span = np.maximum(self.high.max(axis=0) - self.low.min(axis=0), np.finfo(float).tiny)
        swing = self.high[now].max(axis=0) - self.low[now].min(axis=0)
        turns = self.turns[now].sum(axis=0)
        restless = [i for i in positions if settled[i] is None and turns[i] >= FEWEST_TURNS]
        if not restless or number < 2 * tail:
            return "moves on", None
        most = max(restless, key=lambda i: float(swing[i] / span[i]))
        earlier = self.high[then].max(axis=0) - self.low[then].min(axis=0)
        seconds = self.ends[-1] - (self.ends[number - tail - 1] if number > tail else 0.0)
        name = self.simulation.signals[most].name
        rate = float(turns[most]) / 2 / seconds if seconds > 0 else 0.0
        word = "dies away" if swing[most] < SMALLER * earlier[most] else "shakes"
        return word, (name, float(swing[most]), rate)


def _overshoot(extents: Sequence[Extent]) -> tuple[str, float] | None:
    """Return the largest way beyond the last value, as a part of the way from the first."""
    found = []
    for one in extents:
        way = one.last - one.first
        if abs(way) > LEAST_WAY * (one.high - one.low):
            beyond = one.high - one.last if way > 0 else one.last - one.low
            found.append((one.name, beyond / abs(way)))
    return max(found, key=lambda pair: pair[1], default=None)


def _copies(system: CompiledSystem, signals: Sequence[Signal], last: Floats) -> tuple[tuple[str, float], ...]:
    """Return how far apart the peers' copies of each state that is sent as it is are at the end."""
    names = dict.fromkeys(kind.states[i].name for kind in system.kinds for i in sent_states(kind))
    found = []
    for name in names:
        values = [last[i] for i, one in enumerate(signals) if one.local == name and one.unit in ("m", "rad")]
        if len(values) > 1:
            found.append((name, float(np.max(values) - np.min(values))))
    return tuple(found)
