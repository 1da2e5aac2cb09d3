"""Many runs of one scene, each with packets of its own, and what they have in common.

Takes: a `CompiledSystem`, its `Settings`, how many runs.
Gives: `Run`, `Ensemble`, `MeanSquare`, `play_many`; `share_interval`.
Guarantees: run k is the same whoever plays it, in whatever order, however many there are; a share and a mean
stand with how far chance may have moved them; on Ctrl-C the runs that are done are kept.
Does not: keep rows: to see run k, play it alone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apc.analysis import analysis
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.timings import part
from apc.finite_equations import finite_equations
from apc.memory import refuse_beyond
from apc.moments.network import growth, unreliable, verdict_of
from apc.processes import (
    Patience,
    Workers,
    local_processes,
    model_bytes,
    model_of_bytes,
    results,
    this_process,
)
from apc.result import Result
from apc.simulation.blocks import blocks, instants_of, pushes
from apc.simulation.population import Player
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.summary import BAND, Watch, is_position
from apc.threads import single_threaded

Floats = NDArray[np.float64]

QUANTILES = (0.05, 0.5, 0.95)
SURE = 1.959963984540054  # standard deviations of a normal within which 95 % lie
# Verdicts of runs that come to rest, and of those that don't.
CALM, SHAKEN = ("rests", "settles", "dies away"), ("shakes", "diverges")
PART = 100  # runs handed to a process at a time: enough to pay for the way, few enough to share out evenly
RUN = 300  # bytes of a run that is over
TOGETHER = 2**18  # numbers that runs side by side keep, and that rows of them are played at once


@dataclass(frozen=True, slots=True)
class Run:
    """One run: its number, its verdict as in `summary`, and some numbers in SI, None where there is none.

    `copies_apart` is the largest distance between the peers' copies of a position at the end.
    """

    number: int
    verdict: str
    settled: float | None
    largest_force: float | None
    copies_apart: float | None


@dataclass(frozen=True, slots=True)
class Statistics:
    """Of `count` numbers: mean with its standard error, ends, and the quantiles of `QUANTILES`."""

    count: int
    mean: float
    standard_error: float
    low: float
    high: float
    quantiles: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class MeanSquare:
    """The verdict in mean square that runs stand beside; `why` says why there is none.

    `stable` is None where it is open. `settles_in` is the time in seconds after which the root of a mean
    square has fallen to the part of `summary.BAND`, None where it does not fall. `linearized` says that it is
    of small motions about the start.
    """

    verdict: str
    stable: bool | None
    settles_in: float | None
    linearized: bool
    why: str = ""


@dataclass(frozen=True, slots=True)
class Ensemble(Result):
    """Runs of a scene, in their order; `interrupted` says that there were to be more.

    `mean_square` is None where no packet is lost or late.
    """

    shown_by = "simulation:ensemble"

    topology: str
    duration: Fraction
    seed: int
    runs: tuple[Run, ...]
    interrupted: bool = False
    mean_square: MeanSquare | None = None

    @property
    def calm(self) -> int:
        """How many runs come to rest, or are on their way to it."""
        return sum(run.verdict in CALM for run in self.runs)

    @property
    def agrees(self) -> bool | None:
        """Whether the runs show what the verdict in mean square says; None where that is open, or linearized.

        Where they don't they are about something else: they are too short, or something goes on pushing.
        """
        found = self.mean_square
        if found is None or found.stable is None or found.linearized:
            return None
        if found.stable:
            return self.calm == len(self.runs)
        return any(run.verdict in SHAKEN for run in self.runs)

    @property
    def verdicts(self) -> tuple[tuple[str, int], ...]:
        """How many runs have each verdict, the most frequent first."""
        return tuple(Counter(run.verdict for run in self.runs).most_common())

    def statistics(self, name: str) -> Statistics | None:
        """Return what the runs' numbers of a name, such as "settled", amount to; None if no run has one."""
        listed = [value for run in self.runs if (value := getattr(run, name)) is not None]
        if not listed:
            return None
        values = np.array(listed)
        n = len(values)
        error = float(values.std(ddof=1) / math.sqrt(n)) if n > 1 else math.inf
        quantiles = tuple(float(one) for one in np.quantile(values, QUANTILES))
        return Statistics(n, float(values.mean()), error, float(values.min()), float(values.max()), quantiles)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a share, by Wilson's score (1927, J. Am. Stat. Assoc. 22)."""
    share, z2 = count / total, SURE**2
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = SURE * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    return max(centre - half, 0.0), min(centre + half, 1.0)


@part("play")
def play_many(
    system: CompiledSystem,
    settings: Settings,
    *,
    runs: int,
    jobs: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Ensemble:
    """Play a scene many times, each time with other packets.

    Parameters
    ----------
    system
        The compiled scene.
    settings
        How each run is played; run k of a seed is always the same.
    runs
        How many, 1 or more.
    jobs
        How many processes share the work; 1: this one alone.
    progress
        Is told how many runs are done.

    Raises
    ------
    ApcError
        E876 too many runs to keep; E894 nothing in the scene is left to chance; E895 a process ended without
        a word; and those of `simulation.prepare`.
    """
    refuse_beyond(RUN * runs, "E876", Place(system.origin.topology), f"{runs:,} runs", "fewer --runs")
    if not any(link.channel is not None for link in system.links):
        what = f"nothing in {system.name} is left to chance: every run would be the same"
        hint = f"links: {{{system.links[0].name}: {{…, loss: 2 %}}}}" if system.links else "apc simulate"
        raise ApcError(Mistake("E894", Place(system.origin.topology), what, hint=hint))
    seed = system.experiment.seed if settings.seed is None else settings.seed
    settings = replace(settings, seed=seed)
    parts = [range(first, min(first + PART, runs)) for first in range(0, runs, PART)]
    place = Place(system.origin.topology)
    done: list[Run] = []
    interrupted = False
    try:
        with _workers(system, settings, min(runs, PART), min(jobs, len(parts)), place) as workers:
            for found in results(workers, parts, Patience(), place):
                done += found
                if progress is not None:
                    progress(len(done))
    except KeyboardInterrupt:
        if not done:
            raise
        interrupted = True
    done.sort(key=lambda run: run.number)
    told = None if interrupted else _mean_square(system)
    return Ensemble(system.name, settings.duration, seed, tuple(done), interrupted, told)


def _mean_square(system: CompiledSystem) -> MeanSquare | None:
    """Return the verdict in mean square, None where no packet is lost or late."""
    if not unreliable(system):
        return None
    try:
        with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
            prepared = analysis.prepare(system)
            found = growth(system, prepared)
    except ApcError as error:  # what can't be analysed can be played
        return MeanSquare("", None, None, False, error.mistakes[0].what)
    linearized = not all(prepared.jacobians[group.kind].affine for group in system.groups)
    settles_in = None
    if 0 < found.radius < 1:
        settles_in = 2 * math.log(BAND) / math.log(found.radius) * float(prepared.schedules[0].frame_s)
    return MeanSquare(verdict_of(found), found.stable, settles_in, linearized, found.why)


def _workers(
    system: CompiledSystem, settings: Settings, runs: int, jobs: int, place: Place
) -> AbstractContextManager[Workers[range, list[Run]]]:
    """Return who plays: this process, or some that are started afresh."""
    if jobs == 1:
        return nullcontext(this_process(_runs, _side(prepare(system, settings, runs=runs), runs)))
    what = "a process that played runs ended without a word: stopped from outside, or out of memory"
    lost = Mistake("E895", place, what, hint="--jobs 1")
    return local_processes(_part, (model_bytes(system), settings), jobs, lost)


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """What plays some runs side by side, and what looks at them: `positions` and `forces` among the signals.

    The signals are counted as a player gives them.
    """

    simulation: Simulation
    player: Player
    watch: Watch
    positions: tuple[int, ...]
    forces: tuple[int, ...]


def _side(simulation: Simulation, runs: int) -> _Side:
    """Return what plays runs, as many side by side as stay in the caches with a frame of their rows."""
    hearing, frame = simulation.population.hearing, len(simulation.marks) * max(len(simulation.signals), 1)
    ways = zip(simulation.lucks, hearing.routes, strict=True)
    kept = hearing.start.size * hearing.ring + sum(luck.kept(one) * len(one.pairs) for luck, one in ways)
    player = simulation.player(min(runs, max(1, TOGETHER // (frame + kept))))
    length = min(simulation.length, max(1, TOGETHER // (frame * player.runs)))
    signals = [simulation.signals[i] for i in np.argsort(simulation.order)]
    positions = tuple(i for i, one in enumerate(signals) if is_position(one))
    forces = tuple(i for i, one in enumerate(signals) if one.unit == "N")
    watch = Watch(simulation, [signals[i] for i in positions], player.runs)
    return _Side(replace(simulation, length=length), player, watch, positions, forces)


def _runs(side: _Side, part: range) -> list[Run]:
    """Play some runs."""
    parts = (part[first : first + side.player.runs] for first in range(0, len(part), side.player.runs))
    return [run for some in parts for run in _together(side, some)]


def _part(shared: tuple[bytes, Settings], part: range) -> list[Run]:
    return _runs(_opened(*shared), part)


@lru_cache(maxsize=1)
def _opened(model: bytes, settings: Settings) -> _Side:
    return _side(prepare(model_of_bytes(model), settings, runs=PART), PART)


def _together(side: _Side, runs: range) -> list[Run]:
    """Play runs side by side; what leaves the range of floats is played again, alone."""
    simulation, player, watch = side.simulation, side.player, side.watch
    last = int(simulation.settings.duration / simulation.quantum)
    largest, finite = np.zeros(player.runs), np.ones(player.runs, np.bool_)
    player.begin(runs.start)
    watch.begin()
    with np.errstate(all="ignore"):  # of what has diverged
        for first in range(0, last // simulation.frame + 1, simulation.length):
            played = player.play(first, simulation.length, pushes(simulation, first))
            if played.frames < simulation.length:
                return [_alone(simulation, number) for number in runs]
            instants, kept = instants_of(simulation, first, last)
            time = instants[kept] * simulation.quantum.numerator / simulation.quantum.denominator
            rows = played.rows if kept.all() else played.rows[kept]
            rows = rows.reshape(len(time), len(simulation.signals), player.runs)
            watch.take(time, rows[:, list(side.positions)].reshape(len(time), watch.signals * player.runs))
            low, high = rows.min(axis=0, initial=0.0), rows.max(axis=0, initial=0.0)
            finite &= (np.isfinite(low) & np.isfinite(high)).all(axis=0)
            size = np.maximum(abs(high), abs(low))[list(side.forces)].max(axis=0, initial=0.0)
            largest = np.maximum(largest, size)
        finite &= player.in_range()
        found = _amounts(watch, runs, largest if side.forces else None)
    return [found[i] if finite[i] else _alone(simulation, number) for i, number in enumerate(runs)]


def _alone(simulation: Simulation, number: int) -> Run:
    """Play one run block by block."""
    watch, block = Watch(simulation), None
    for block in blocks(simulation, run=number):
        watch.take(block.time, block.values)
    largest = watch.peak[watch.forces].max(keepdims=True) if watch.forces else None
    with np.errstate(all="ignore"):
        return _amounts(watch, range(number, number + 1), largest, stopped=bool(block and block.stopped))[0]


def _amounts(watch: Watch, runs: range, forces: Floats | None, *, stopped: bool = False) -> list[Run]:
    """Return what runs side by side amount to; `forces` (runs,) are the largest of each."""
    judged = watch.judged(stopped=stopped)
    apart = [distance for _, unit, distance in watch.copies() if unit == "m"]
    none = [None] * watch.runs
    settled = [None if math.isnan(one) else one for one in judged.settled_at.tolist()]
    largest = none if forces is None else forces.tolist()
    copies = np.max(apart, axis=0).tolist() if apart else none
    # Those beyond the last run that was wanted are left out.
    return [Run(*one) for one in zip(runs, judged.verdict.tolist(), settled, largest, copies, strict=False)]
