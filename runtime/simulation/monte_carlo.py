"""Monte Carlo runs of one model with independent packet losses, and their statistics.

Takes: a `Model`, its `Settings`, the number of runs.
Gives: `EnsembleRun`, `Ensemble`, `MeanSquare`, `simulate_many`; `share_interval`.
Guarantees: run k is independent of the process, the order and the number of runs. Shares and means have
confidence intervals. On Ctrl-C the finished runs are kept.
Does not: store rows: to record run k, simulate it alone.
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

from apc.analysis.nonlinear_elements import is_linear
from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.frame import numeric_model
from apc.frame.evaluation_errors import finite_equations
from apc.mean_square.mean_square_stability import MeanSquareVerdict, mean_square_growth, verdict_of
from apc.memory import refuse_beyond
from apc.network.nominal_criterion import unreliable
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
from apc.simulation.motion_classes import MotionVerdict
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.summary import BAND, SummaryAccumulator
from apc.threads import single_threaded

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

    `copy_error` is the largest distance between the peers' copies of a position at the end.
    """

    number: int
    verdict: MotionVerdict
    settled: float | None
    largest_force: float | None
    copy_error: float | None


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
    """The mean-square verdict compared with the runs; `why` is the reason for a missing one.

    `stable` is None if undecided. `settles_in` is the time in seconds after which the root of a mean square
    has fallen to the part of `summary.BAND`, None where it does not fall. `linearized` is whether it applies
    to small motions about the start only.
    """

    verdict: MeanSquareVerdict | None
    stable: bool | None
    settles_in: float | None
    linearized: bool
    why: str = ""


@dataclass(frozen=True, slots=True)
class Ensemble(Result):
    """Runs of a model, in order; `interrupted` is whether the ensemble is incomplete.

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
        """The number of runs that are at rest or decay."""
        return sum(run.verdict in CALM for run in self.runs)

    @property
    def agrees(self) -> bool | None:
        """Whether the runs agree with the mean-square verdict; None if that is undecided or linearized.

        Possible reasons for disagreement: the runs are too short, or an external force persists.
        """
        mean_square = self.mean_square
        if mean_square is None or mean_square.stable is None or mean_square.linearized:
            return None
        if mean_square.stable:
            return self.calm == len(self.runs)
        return any(run.verdict in SUSTAINED for run in self.runs)

    @property
    def verdicts(self) -> tuple[tuple[MotionVerdict, int], ...]:
        """The number of runs with each verdict, the most frequent first."""
        return tuple(Counter(run.verdict for run in self.runs).most_common())

    def statistics(self, name: str) -> Statistics | None:
        """Return statistics of the runs' values of a name, such as "settled"; None if no run has one."""
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


@part("simulate")
def simulate_many(
    system: Model,
    settings: Settings,
    *,
    runs: int,
    jobs: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Ensemble:
    """Simulate a model several times, each time with other packet losses.

    Parameters
    ----------
    system
        The model.
    settings
        The settings of each run; run k of a seed is reproducible.
    runs
        The number of runs, 1 or more.
    jobs
        The number of processes; 1: this one only.
    progress
        Called with the number of finished runs.

    Raises
    ------
    ApcError
        E876 too many runs to keep; E894 the model is deterministic; E895 a process ended unexpectedly; and
        those of `simulation.prepare`.
    """
    refuse_beyond(
        RUN * runs, "E876", SourceLocation(system.origin.topology), f"{runs:,} runs", "fewer --runs"
    )
    if not any(link.channel is not None for link in system.links):
        message = f"nothing in {system.name} is left to chance: every run would be the same"
        hint = f"links: {{{system.links[0].name}: {{…, loss: 2 %}}}}" if system.links else "apc simulate"
        raise ApcError(Diagnostic("E894", SourceLocation(system.origin.topology), message, hint=hint))
    seed = system.experiment.seed if settings.seed is None else settings.seed
    settings = replace(settings, seed=seed)
    parts = [range(first, min(first + PART, runs)) for first in range(0, runs, PART)]
    location = SourceLocation(system.origin.topology)
    done: list[EnsembleRun] = []
    interrupted = False
    try:
        with _workers(system, settings, min(jobs, len(parts)), location) as workers:
            for result in results(workers, parts, Patience(), location):
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
            prepared = numeric_model.prepare(system)
            result = mean_square_growth(system, prepared)
    except ApcError as error:  # a model that can't be analysed can still be simulated
        return MeanSquare(None, None, None, False, error.mistakes[0].message)
    linearized = not is_linear(system, prepared)
    settles_in = None
    if 0 < result.radius < 1:
        settles_in = 2 * math.log(BAND) / math.log(result.radius) * float(prepared.schedules[0].frame_s)
    return MeanSquare(verdict_of(result), result.stable, settles_in, linearized, result.why)


def _workers(
    system: Model, settings: Settings, jobs: int, location: SourceLocation
) -> AbstractContextManager[Workers[range, list[EnsembleRun]]]:
    """Return the workers: this process, or spawned ones."""
    if jobs == 1:
        return nullcontext(this_process(_runs, prepare(system, settings)))
    message = "a process that played runs ended without a word: stopped from outside, or out of memory"
    lost = Diagnostic("E895", location, message, hint="--jobs 1")
    return local_processes(_runs_of_model, (model_bytes(system), settings), jobs, lost)


def _runs_of_model(shared: tuple[bytes, Settings], numbers: range) -> list[EnsembleRun]:
    return _runs(_load(*shared), numbers)


@lru_cache(maxsize=1)
def _load(model: bytes, settings: Settings) -> Simulation:
    return prepare(model_of_bytes(model), settings)


def _runs(simulation: Simulation, numbers: range) -> list[EnsembleRun]:
    """Simulate some runs."""
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
