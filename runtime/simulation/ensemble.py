"""Many runs of one scene, each with packets of its own, and what they have in common.

Takes: a `Model`, its `Settings`, how many runs.
Gives: `EnsembleRun`, `Ensemble`, `MeanSquare`, `play_many`; `share_interval`.
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

from apc.analysis.elements import is_linear
from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.frame import instance
from apc.frame.finite_equations import finite_equations
from apc.memory import refuse_beyond
from apc.moments.network_verdict import MeanSquareVerdict, growth, verdict_of
from apc.network.nominal import unreliable
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
from apc.simulation.driven import driven_until
from apc.simulation.rows_in_time import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.summary import BAND, SummaryAccumulator
from apc.simulation.verdicts import MotionVerdict
from apc.threads import single_threaded

Floats = NDArray[np.float64]

QUANTILES = (0.05, 0.5, 0.95)
SURE = 1.959963984540054  # standard deviations of a normal within which 95 % lie
# Verdicts of runs that decay, and of those that don't.
CALM, SUSTAINED = (
    (MotionVerdict.AT_REST, MotionVerdict.DECAYS),
    (MotionVerdict.OSCILLATES, MotionVerdict.DIVERGES),
)
PART = 100  # runs handed to a process at a time: enough to pay for the way, few enough to share out evenly
RUN = 300  # bytes of a run that is over


@dataclass(frozen=True, slots=True)
class EnsembleRun:
    """One run: its number, its verdict as in `summary`, and some numbers in SI, None where there is none.

    `copies_apart` is the largest distance between the peers' copies of a position at the end.
    """

    number: int
    verdict: MotionVerdict
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

    verdict: MeanSquareVerdict | None
    stable: bool | None
    settles_in: float | None
    linearized: bool
    why: str = ""


@dataclass(frozen=True, slots=True)
class Ensemble(Result):
    """Runs of a scene, in their order; `interrupted` says that there were to be more.

    `mean_square` is None where no packet is lost or late.
    """

    shown_by = "simulation_output:ensemble"

    topology: str
    duration: Fraction
    seed: int
    runs: tuple[EnsembleRun, ...]
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
        mean_square = self.mean_square
        if mean_square is None or mean_square.stable is None or mean_square.linearized:
            return None
        if mean_square.stable:
            return self.calm == len(self.runs)
        return any(run.verdict in SUSTAINED for run in self.runs)

    @property
    def verdicts(self) -> tuple[tuple[MotionVerdict, int], ...]:
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
        quantiles = tuple(float(item) for item in np.quantile(values, QUANTILES))
        return Statistics(n, float(values.mean()), error, float(values.min()), float(values.max()), quantiles)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a share, by Wilson's score (1927, J. Am. Stat. Assoc. 22)."""
    share, z2 = count / total, SURE**2
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = SURE * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    return max(centre - half, 0.0), min(centre + half, 1.0)


@part("play")
def play_many(
    system: Model,
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
    refuse_beyond(
        RUN * runs, "E876", SourceLocation(system.origin.topology), f"{runs:,} runs", "fewer --runs"
    )
    if not any(link.channel is not None for link in system.links):
        what = f"nothing in {system.name} is left to chance: every run would be the same"
        hint = f"links: {{{system.links[0].name}: {{…, loss: 2 %}}}}" if system.links else "apc simulate"
        raise ApcError(Diagnostic("E894", SourceLocation(system.origin.topology), what, hint=hint))
    seed = system.experiment.seed if settings.seed is None else settings.seed
    settings = replace(settings, seed=seed)
    parts = [range(first, min(first + PART, runs)) for first in range(0, runs, PART)]
    place = SourceLocation(system.origin.topology)
    done: list[EnsembleRun] = []
    interrupted = False
    try:
        with _workers(system, settings, min(jobs, len(parts)), place) as workers:
            for result in results(workers, parts, Patience(), place):
                done += result
                if progress is not None:
                    progress(len(done))
    except KeyboardInterrupt:
        if not done:
            raise
        interrupted = True
    done.sort(key=lambda run: run.number)
    mean_square = None if interrupted else _mean_square(system)
    return Ensemble(system.name, settings.duration, seed, tuple(done), interrupted, mean_square)


def _mean_square(system: Model) -> MeanSquare | None:
    """Return the verdict in mean square, None where no packet is lost or late."""
    if not unreliable(system):
        return None
    try:
        with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
            prepared = instance.prepare(system)
            result = growth(system, prepared)
    except ApcError as error:  # what can't be analysed can be played
        return MeanSquare(None, None, None, False, error.mistakes[0].what)
    linearized = not is_linear(system, prepared)
    settles_in = None
    if 0 < result.radius < 1:
        settles_in = 2 * math.log(BAND) / math.log(result.radius) * float(prepared.schedules[0].frame_s)
    return MeanSquare(verdict_of(result), result.stable, settles_in, linearized, result.why)


def _workers(
    system: Model, settings: Settings, jobs: int, place: SourceLocation
) -> AbstractContextManager[Workers[range, list[EnsembleRun]]]:
    """Return who plays: this process, or some that are started afresh."""
    if jobs == 1:
        return nullcontext(this_process(_runs, prepare(system, settings)))
    what = "a process that played runs ended without a word: stopped from outside, or out of memory"
    lost = Diagnostic("E895", place, what, hint="--jobs 1")
    return local_processes(_runs_of_model, (model_bytes(system), settings), jobs, lost)


def _runs_of_model(shared: tuple[bytes, Settings], numbers: range) -> list[EnsembleRun]:
    return _runs(_opened(*shared), numbers)


@lru_cache(maxsize=1)
def _opened(model: bytes, settings: Settings) -> Simulation:
    return prepare(model_of_bytes(model), settings)


def _runs(simulation: Simulation, numbers: range) -> list[EnsembleRun]:
    """Play some runs."""
    player, runs = simulation.player(), []
    lengths = {signal.local for signal in simulation.signals if signal.unit == LENGTH}
    until = driven_until(simulation)
    for number in numbers:
        watch = SummaryAccumulator(simulation, until)
        for block in blocks(simulation, run=number, player=player):
            watch.take(block.time, block.values)
        summary = watch.summary(block)
        force = None if summary.largest_force is None else summary.largest_force[1]
        copies = max((distance for name, distance in summary.copies if name in lengths), default=None)
        runs.append(EnsembleRun(number, summary.verdict, summary.settled, force, copies))
    return runs
