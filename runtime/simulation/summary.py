"""What a simulated motion amounts to, in numbers and a word: whether it settles, and how far it goes.

Takes: the rows of a simulation, as they come. Gives: `Watch`, `Summary`, `Extent`, `Judged`.
Guarantees: the memory used does not grow with the duration.
Does not: prove anything: what it says holds for the time that was simulated (see `analysis` for proof).

Settled means: from some time on, well before the end, every position stays within `BAND` of its range around
its last value; the range is the largest that any peer's position of that name goes through. A motion that
does not settle *shakes* if it turns to and fro without dying away, *dies away* if it turns and gets smaller,
*diverges* if a number leaves the range of floats, and *moves on* otherwise. It *rests* if no position ever
changes. Without a position that was recorded it is *not judged*. An angle is a position, too.

The work a coupler does is ∫ −f v dt over the forces it holds, f the flow into the coupler at each of its
flanges and v that flange's velocity: exact, as f is constant between events. Positive work feeds the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ANGLES, LENGTH, CompiledSystem
from apc.simulation.blocks import Block
from apc.simulation.limits import Broken, LimitWatch
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
PASSED = 32  # of them looked at at once, which stay in the caches
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


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What several runs of one scene amount to, side by side.

    `verdict` (runs,) are words; `settled` (signals, runs) seconds, NaN where a signal does not settle, and of
    all positions together (runs,), NaN but for runs that settle; `swing` (signals, runs) is the way to and
    fro at the end, `rate` how often a second, `restless` (runs,) the signal that swings most, −1 if none
    does.
    """

    verdict: NDArray[np.str_]
    settled: Floats
    settled_at: Floats
    swing: Floats
    rate: Floats
    restless: NDArray[np.int64]


class Watch:
    """Looks at some runs of a simulation as they pass and keeps extremes, bucket by bucket of rows."""

    def __init__(
        self, simulation: Simulation, signals: Sequence[Signal] | None = None, runs: int = 1
    ) -> None:
        """Begin before the first row.

        Parameters
        ----------
        simulation
            What is played.
        signals
            What to look at, all signals of the simulation if not given.
        runs
            How many runs stand side by side: the first signal of all is followed by the next of all.
        """
        self.simulation, self.runs = simulation, runs
        self.listed = simulation.signals if signals is None else tuple(signals)
        self.signals = len(self.listed)
        self.positions = [i for i, one in enumerate(self.listed) if is_position(one)]
        self.forces = [i for i, one in enumerate(self.listed) if one.unit == "N" and one.role != "limited"]
        n = self.signals * runs
        rows = int(simulation.settings.duration / (simulation.frame * simulation.quantum)) + 1
        rows *= len(simulation.marks)
        most = max(16, min(BUCKETS, MOST_EXTREMES // max(len(simulation.signals), 1)))
        self.width = -(-rows // most)
        buckets = -(-rows // self.width)
        self.low, self.high = np.empty((buckets, n)), np.empty((buckets, n))
        self.turns = np.empty((buckets, len(self.positions) * runs), np.min_scalar_type(self.width))
        self.begin()

    def begin(self) -> None:
        """Begin again before the first row: memory that was used once is at hand."""
        n = self.signals * self.runs
        self.ends: list[float] = []
        self.pending, self.times = np.empty((0, n)), np.empty(0)
        self.before: Floats = np.empty((0, self.turns.shape[1]))  # the last two rows already in a bucket
        self.first: Floats = np.zeros(n)
        self.last: Floats = np.zeros(n)
        self.peak, self.peak_at = np.zeros(n), np.zeros(n)
        self.limits = LimitWatch(self.simulation.system, self.listed if self.runs == 1 else ())
        self.rows = 0

    def take(self, time: Floats, values: Floats) -> None:
        """Look at some rows: `time` (rows,), `values` (rows, signals · runs)."""
        if not len(time):
            return
        if not self.rows:
            self.first = values[0].copy()
        self.last = values[-1].copy()
        self.rows += len(time)
        self.limits.take(time, values)
        for column in self.forces if self.runs == 1 else ():
            size = np.abs(values[:, column])
            at = size.argmax()
            if size[at] > self.peak[column]:
                self.peak[column], self.peak_at[column] = size[at], time[at]
        if len(self.times):
            time, values = np.concatenate([self.times, time]), np.concatenate([self.pending, values])
        self._fill(time, values)

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
        here = slice(len(self.ends), len(self.ends) + number)
        shaped.min(axis=1, out=self.low[here])
        shaped.max(axis=1, out=self.high[here])
        self.ends += times.reshape(number, -1)[:, -1].tolist()
        positions = values
        if len(self.positions) < self.signals:
            positions = values.reshape(len(values), -1, self.runs)[:, self.positions]
        moving = np.concatenate([self.before, positions.reshape(len(values), self.turns.shape[1])])
        up, down = moving[1:] > moving[:-1], moving[1:] < moving[:-1]
        found = (up[1:] & down[:-1]) | (down[1:] & up[:-1])
        turned = np.zeros((len(values), moving.shape[1]), dtype=np.bool_)
        if len(found):
            turned[-len(found) :] = found
        each = turned.view(np.uint8).reshape(*shaped.shape[:2], moving.shape[1])
        each.sum(axis=1, dtype=self.turns.dtype, out=self.turns[here])
        self.before = moving[-2:].copy()

    def judged(self, *, stopped: bool = False) -> Judged:
        """Return what has been seen of every run; `stopped` says that something left the range of floats."""
        self._fill(self.times, self.pending, all_of_it=True)
        assert self.rows, "a simulation has a row at time 0"
        low, high = self._tables()
        settled = self._settled(low, high)
        number = len(self.ends)
        tail = max(1, round(TAIL * number))
        now, then = slice(number - tail, number), slice(max(0, number - 2 * tail), number - tail)
        swing = high[now].max(axis=0) - low[now].min(axis=0)
        span = np.maximum(high.max(axis=0) - low.min(axis=0), np.finfo(float).tiny)
        turns = np.zeros(swing.shape, np.int64)
        turns[self.positions] = self.turns[now].sum(axis=0, dtype=np.int64).reshape(-1, self.runs)
        # Of the positions that turn and don't settle, the one that swings most.
        restless = np.isnan(settled[self.positions]) & (turns[self.positions] >= FEWEST_TURNS)
        restless &= number >= 2 * tail
        for unit in POSITIONS:  # a length and an angle are each compared with their like
            alike = [place for place in self.positions if self.listed[place].unit == unit]
            span[alike] = span[alike].max(axis=0, initial=0.0)
        share = np.where(restless, (swing / span)[self.positions], -1.0)
        which = np.full(self.runs, -1, np.int64)
        if self.positions:
            which = np.where(restless.any(axis=0), np.array(self.positions)[share.argmax(axis=0)], -1)
        earlier = np.zeros(swing.shape)
        if then.stop > then.start:
            earlier = high[then].max(axis=0) - low[then].min(axis=0)
        smaller = swing < SMALLER * earlier
        dying = smaller[which, np.arange(self.runs)] if self.positions else np.zeros(self.runs, np.bool_)
        verdict = np.where(which < 0, "moves on", np.where(dying, "dies away", "shakes"))
        times = settled[self.positions]
        calm = ~np.isnan(times).any(axis=0)
        whole = (high.max(axis=0) - low.min(axis=0))[self.positions]
        still = calm & ~whole.any(axis=0) & bool(self.positions)
        verdict = np.where(
            still, "rests", np.where(calm, "settles" if self.positions else NOT_JUDGED, verdict)
        )
        verdict = np.where(stopped, "diverges", verdict)
        seconds = self.ends[-1] - (self.ends[number - tail - 1] if number > tail else 0.0)
        return Judged(
            verdict=verdict,
            settled=settled,
            settled_at=np.where(verdict == "settles", times.max(axis=0, initial=0.0), np.nan),
            swing=swing,
            rate=turns / 2 / seconds if seconds > 0 else np.zeros(turns.shape),
            restless=np.where(calm | stopped, -1, which),
        )

    def summary(self, block: Block) -> Summary:
        """Return what has been seen of the only run; `block` is its last."""
        with np.errstate(over="ignore", invalid="ignore"):  # of what has diverged
            judged = self.judged(stopped=bool(block.stopped))
        signals, (low, high) = self.listed, self._tables()
        listed = [None if np.isnan(one) else float(one) for one in judged.settled[:, 0]]
        extents = tuple(
            Extent(one.name, one.unit, float(first), float(last), float(least), float(most), since)
            for one, first, last, least, most, since in zip(
                signals,
                self.first,
                self.last,
                low[:, :, 0].min(axis=0),
                high[:, :, 0].max(axis=0),
                listed,
                strict=True,
            )
        )
        verdict, restless = str(judged.verdict[0]), int(judged.restless[0])
        swing = (
            (signals[restless].name, float(judged.swing[restless, 0]), float(judged.rate[restless, 0]))
            if restless >= 0
            else None
        )
        largest = max(self.forces, key=lambda i: float(self.peak[i]), default=-1)
        return Summary(
            verdict=verdict,
            settled=float(judged.settled_at[0]) if verdict == "settles" else None,
            stopped=block.stopped,
            stopped_at=block.stopped_at if block.stopped else None,
            swing=swing,
            overshoot=_overshoot([extents[i] for i in self.positions]) if verdict == "settles" else None,
            largest_force=None
            if largest < 0
            else (signals[largest].name, float(self.peak[largest]), float(self.peak_at[largest])),
            copies=tuple((name, float(distance[0])) for name, _, distance in self.copies()),
            # Of a motion without bound the work is as meaningless as it is large.
            work=() if block.stopped else tuple(zip(self.simulation.parts, block.work.tolist(), strict=True)),
            rows=self.rows,
            signals=len(signals),
            end=self.ends[-1],
            extents=extents,
            broken=self.limits.broken(),
            unrecorded=_positions(self.simulation.system) - len(self.positions),
        )

    def copies(self) -> list[tuple[str, str, Floats]]:
        """Return how far apart the peers' copies of each state that is sent as it is are at the end.

        Name, unit, and distances (runs,).
        """
        signals = self.listed
        last = self.last.reshape(-1, self.runs)
        found = []
        for name in self.simulation.sent:
            here = [i for i, one in enumerate(signals) if one.local == name and one.unit in POSITIONS]
            if len(here) > 1:
                found.append((name, signals[here[0]].unit, np.ptp(last[here], axis=0)))
        return found

    def _tables(self) -> tuple[Floats, Floats]:
        """Return the least and the largest values of every bucket (buckets, signals, runs)."""
        shape = (len(self.ends), self.signals, self.runs)
        return self.low[: len(self.ends)].reshape(shape), self.high[: len(self.ends)].reshape(shape)

    def _settled(self, low: Floats, high: Floats) -> Floats:
        """Return when each signal is within its band for good; NaN if that is not well before the end."""
        with np.errstate(over="ignore"):  # of what has diverged
            own = high.max(axis=0) - low.min(axis=0)
        span, names = np.empty(own.shape), [one.local for one in self.listed]
        for name in dict.fromkeys(names):  # the largest range among the peers
            here = [i for i, one in enumerate(names) if one == name]
            span[here] = own[here].max(axis=0)
        last, end = self.last.reshape(self.signals, self.runs), self.ends[-1]
        ends = np.concatenate([[0.0], self.ends])  # of the last bucket outside the band, 0 if there is none
        after, band = np.zeros(own.shape, np.int64), BAND * span
        for begin in range(0, len(low), PASSED):
            some = slice(begin, begin + PASSED)
            outside = (high[some] - last > band) | (last - low[some] > band)
            places = np.arange(1, len(outside) + 1, dtype=np.uint8)[:, None, None]
            latest = (outside.view(np.uint8) * places).max(axis=0)
            after = np.where(latest, begin + latest.astype(np.int64), after)
        return np.where(ends[after] <= LATE * end, ends[after], np.nan)


def is_position(signal: Signal) -> bool:
    """Say whether a signal is a place, which decides whether a motion settles."""
    return signal.role == "state" and signal.unit in POSITIONS


def _positions(system: CompiledSystem) -> int:
    """Return how many positions there are in a scene."""
    each = [sum(state.unit in POSITIONS for state in kind.states) for kind in system.kinds]
    return sum(group.count * each[group.kind] for group in system.groups)


def _overshoot(extents: Sequence[Extent]) -> tuple[str, float] | None:
    """Return the largest way beyond the last value, as a part of the way from the first."""
    found = []
    for one in extents:
        way = one.last - one.first
        if abs(way) > LEAST_WAY * (one.high - one.low):
            beyond = one.high - one.last if way > 0 else one.last - one.low
            found.append((one.name, beyond / abs(way)))
    return max(found, key=lambda pair: pair[1], default=None)
