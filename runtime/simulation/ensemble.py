"""Many runs of one scene, each with packets of its own, and what they have in common.

Takes: a `CompiledSystem`, its `Settings`, how many runs.
Gives: `Run`, `Ensemble`, `play_many`; `share_interval`.
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

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.timings import part
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
from apc.simulation.summary import Watch, is_position

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

QUANTILES = (0.05, 0.5, 0.95)
SURE = 1.959963984540054  # standard deviations of a normal within which 95 % lie
PART = 100  # runs handed to a process at a time: enough to pay for the way, few enough to share out evenly
TOGETHER = 2**19  # numbers of the rows of runs that are looked at side by side


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
class Ensemble(Result):
    """Runs of a scene, in their order; `interrupted` says that there were to be more."""

    shown_by = "simulation:ensemble"

    topology: str
    duration: Fraction
    seed: int
    runs: tuple[Run, ...]
    interrupted: bool = False

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
        E894 nothing in the scene is left to chance; E895 a process ended without a word; and those of
        `simulation.prepare`.
    """
    if not any(link.channel is not None for link in system.links):
        what = f"nothing in {system.name} is left to chance: every run would be the same"
        raise ApcError(Mistake("E894", Place(system.name), what, hint="links: {lan: {…, loss: 2 %}}"))
    seed = system.experiment.seed if settings.seed is None else settings.seed
    settings = replace(settings, seed=seed)
    parts = [range(first, min(first + PART, runs)) for first in range(0, runs, PART)]
    place = Place(system.name)
    done: list[Run] = []
    interrupted = False
    try:
        with _workers(system, settings, min(jobs, len(parts)), place) as workers:
            for found in results(workers, parts, Patience(), place):
                done += found
                if progress is not None:
                    progress(len(done))
    except KeyboardInterrupt:
        if not done:
            raise
        interrupted = True
    done.sort(key=lambda run: run.number)
    return Ensemble(system.name, settings.duration, seed, tuple(done), interrupted)


def _workers(
    system: CompiledSystem, settings: Settings, jobs: int, place: Place
) -> AbstractContextManager[Workers[range, list[Run]]]:
    """Return who plays: this process, or some that are started afresh."""
    if jobs == 1:
        return nullcontext(this_process(_runs, prepare(system, settings)))
    what = "a process that played runs ended without a word: stopped from outside, or out of memory"
    lost = Mistake("E895", place, what, hint="--jobs 1")
    return local_processes(_part, (model_bytes(system), settings), jobs, lost)


def _runs(simulation: Simulation, part: range) -> list[Run]:
    """Play some runs, as many side by side as their rows stay in the caches."""
    player, last = simulation.player(), int(simulation.settings.duration / simulation.quantum)
    if last // simulation.frame >= simulation.length:  # of a long run the rows pass, and are gone
        return [_alone(simulation, player, number) for number in part]
    numbers = simulation.length * len(simulation.marks) * max(simulation.population.width, 1)
    side = max(1, TOGETHER // numbers)
    parts = (part[first : first + side] for first in range(0, len(part), side))
    return [run for some in parts for run in _together(simulation, player, some, last)]


def _part(shared: tuple[bytes, Settings], part: range) -> list[Run]:
    return _runs(_opened(*shared), part)


@lru_cache(maxsize=1)
def _opened(model: bytes, settings: Settings) -> Simulation:
    return prepare(model_of_bytes(model), settings)


def _together(simulation: Simulation, player: Player, runs: range, last: int) -> list[Run]:
    """Play runs whose frames are one call of a player each; what leaves the range of floats goes alone."""
    signals = [simulation.signals[i] for i in np.argsort(simulation.order)]
    instants, kept = instants_of(simulation, 0, last)
    time = instants[kept] * simulation.quantum.numerator / simulation.quantum.denominator
    some: slice | Flags = slice(len(time)) if kept[: len(time)].all() else kept
    places = [i for i, one in enumerate(signals) if is_position(one)]
    forces = [i for i, one in enumerate(signals) if one.unit == "N"]
    positions = np.empty((len(time), len(runs), len(places)))
    largest, most = np.zeros((2, len(runs)))
    push, whole = pushes(simulation, 0), np.ones(len(runs), np.bool_)
    for place, number in enumerate(runs):
        player.begin(number)
        played = player.play(0, simulation.length, push)
        rows = played.rows[some]
        whole[place] = played.frames == simulation.length
        positions[:, place] = rows[:, places]
        size = np.abs(rows)
        most[place] = size.max(initial=0.0)
        largest[place] = size[:, forces].max(initial=0.0)
    watch = Watch(simulation, [signals[i] for i in places], len(runs))
    with np.errstate(all="ignore"):  # of what has diverged
        watch.take(time, positions.reshape(len(time), -1))
        found = _amounts(watch, runs, largest if forces else None)
    whole &= np.isfinite(most)
    for place in np.flatnonzero(~whole).tolist():
        found[place] = _alone(simulation, player, runs[place])
    return found


def _alone(simulation: Simulation, player: Player, number: int) -> Run:
    """Play one run block by block."""
    watch, block = Watch(simulation), None
    for block in blocks(simulation, run=number, player=player):
        watch.take(block.time, block.values)
    largest = watch.peak[watch.forces].max(keepdims=True) if watch.forces else None
    with np.errstate(all="ignore"):
        return _amounts(watch, range(number, number + 1), largest, stopped=bool(block and block.stopped))[0]


def _amounts(watch: Watch, runs: range, forces: Floats | None, *, stopped: bool = False) -> list[Run]:
    """Return what runs side by side amount to; `forces` (runs,) are the largest of each."""
    judged = watch.judged(stopped=stopped)
    apart = [distance for _, unit, distance in watch.copies() if unit == "m"]
    none = [None] * len(runs)
    settled = [None if math.isnan(one) else one for one in judged.settled_at.tolist()]
    largest = none if forces is None else forces.tolist()
    copies = np.max(apart, axis=0).tolist() if apart else none
    return [Run(*one) for one in zip(runs, judged.verdict.tolist(), settled, largest, copies, strict=True)]
