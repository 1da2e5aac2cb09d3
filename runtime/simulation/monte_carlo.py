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
from apc.lifting.numeric_model import numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.mean_square.mean_square_stability import MeanSquareVerdict, mean_square_growth, verdict_of
from apc.network.nominal_criterion import unreliable
from apc.result import Result
from apc.simulation.driven import driven_until
from apc.simulation.motion_classes import MotionVerdict
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.summary import BAND, SummaryAccumulator
from apc.support.memory import refuse_beyond
from apc.support.processes import (
    Patience,
    Workers,
    local_processes,
    model_bytes,
    model_of_bytes,
    results,
    this_process,
)

QUANTILES = (0.05, 0.5, 0.95)  # of the motions of all runs that are reported
SURE = 1.959963984540054  # standard deviations of the two-sided 95 % interval of a normal distribution
# Verdicts of runs that decay, and of those that don't.
CALM, SUSTAINED = (
    (MotionVerdict.AT_REST, MotionVerdict.DECAYS),
    (MotionVerdict.OSCILLATES, MotionVerdict.DIVERGES),
)
PART = 100  # runs per task of a process: enough to outweigh the transfer, few enough for even shares
RUN = 300  # bytes of the stored result of a run


@dataclass(frozen=True, slots=True)
class EnsembleRun:
    """The result of one run: its number, its verdict as in `summary`, and values in SI.

    `settled` is the settling time, `copy_error` the largest distance between the peers' copies of a position
    at the end. A value is None if it does not exist.
    """

    number: int
    verdict: MotionVerdict
    settled: float | None
    largest_force: float | None
    copy_error: float | None


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of `count` values: mean and its standard error, smallest and largest value, `QUANTILES`."""

    count: int
    mean: float
    standard_error: float
    low: float
    high: float
    quantiles: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class MeanSquare:
    """The mean-square verdict, for comparison with the runs; `why` is the reason if there is no verdict.

    `stable` is None if undecided. `settles_in` is the time in seconds in which the root of the mean square
    falls to the share `summary.BAND`, None if it does not fall. `linearized` states that the verdict holds
    for small motions about the start only.
    """

    verdict: MeanSquareVerdict | None
    stable: bool | None
    settles_in: float | None
    linearized: bool
    why: str = ""


@dataclass(frozen=True, slots=True)
class Ensemble(Result):
    """The results of the runs of a model, in order; `interrupted` states that runs are missing.

    `mean_square` is None if no packet is lost or late, or if peers join or leave.
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
        """Whether the runs agree with the mean-square verdict.

        It is None if the verdict is undecided or linearized.

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
        """Return statistics of one field of the runs, such as "settled"; None if no run has a value."""
        present = [value for run in self.runs if (value := getattr(run, name)) is not None]
        if not present:
            return None
        values = np.array(present)
        n = len(values)
        error = float(values.std(ddof=1) / math.sqrt(n)) if n > 1 else math.inf
        quantiles = tuple(float(quantile) for quantile in np.quantile(values, QUANTILES))
        return Statistics(n, float(values.mean()), error, float(values.min()), float(values.max()), quantiles)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a proportion, by Wilson's score (J. Am. Stat. Assoc.

    22, 1927).
    """
    share, z2 = count / total, SURE**2
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = SURE * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    return max(centre - half, 0.0), min(centre + half, 1.0)


@part("simulate")
def simulate_many(
    model: Model,
    settings: Settings,
    *,
    runs: int,
    jobs: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Ensemble:
    """Return the results of several simulations of a model, each with independent packet losses.

    Parameters
    ----------
    model
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
        E876 too many runs to store; E894 the model is deterministic; E895 a process ended unexpectedly; and
        the errors of `simulation.prepare`.
    """
    refuse_beyond(
        RUN * runs, "E876", SourceLocation(model.origin.topology), f"{runs:,} runs", "reduce --runs"
    )
    if not any(link.channel is not None for link in model.links):
        message = f"no part of {model.name} is random: all runs are identical"
        advice = f"write loss or jitter at link {model.links[0].name}, or " if model.links else ""
        advice += "omit --runs"
        raise ApcError(Diagnostic("E894", SourceLocation(model.origin.topology), message, advice=advice))
    seed = model.experiment.seed if settings.seed is None else settings.seed
    settings = replace(settings, seed=seed)
    tasks = [range(first, min(first + PART, runs)) for first in range(0, runs, PART)]
    location = SourceLocation(model.origin.topology)
    finished: list[EnsembleRun] = []
    interrupted = False
    try:
        with _workers(model, settings, min(jobs, len(tasks)), location) as workers:
            for result in results(workers, tasks, Patience(), location):
                finished += result
                if progress is not None:
                    progress(len(finished))
    except KeyboardInterrupt:
        if not finished:
            raise
        interrupted = True
    finished.sort(key=lambda run: run.number)
    changing = model.experiment.joins or model.experiment.leaves
    mean_square = None if interrupted or changing else _mean_square(model)
    return Ensemble(model.name, settings.duration, seed, tuple(finished), interrupted, mean_square)


def _mean_square(model: Model) -> MeanSquare | None:
    """Return the mean-square verdict of a model, None if no packet is lost or late."""
    if not unreliable(model):
        return None
    try:
        with evaluating(model):
            numeric = numeric_model(model)
            result = mean_square_growth(numeric)
    except ApcError as error:  # a model that can't be analysed can still be simulated
        return MeanSquare(None, None, None, False, error.mistakes[0].message)
    linearized = not is_linear(numeric)
    settles_in = None
    if 0 < result.radius < 1:
        settles_in = 2 * math.log(BAND) / math.log(result.radius) * float(numeric.schedules[0].frame_s)
    return MeanSquare(verdict_of(result), result.stable, settles_in, linearized, result.why)


def _workers(
    model: Model, settings: Settings, jobs: int, location: SourceLocation
) -> AbstractContextManager[Workers[range, list[EnsembleRun]]]:
    """Return the workers that simulate runs: this process, or separate processes."""
    if jobs == 1:
        return nullcontext(this_process(_runs, prepare(model, settings)))
    message = "a simulating process exited unexpectedly: stopped, or out of memory"
    loss_error = Diagnostic("E895", location, message, fix="--jobs 1")
    return local_processes(_runs_of_model, (model_bytes(model), settings), jobs, loss_error)


def _runs_of_model(shared: tuple[bytes, Settings], numbers: range) -> list[EnsembleRun]:
    """Return the results of these runs, simulated in a worker process from a serialized model."""
    return _runs(_load(*shared), numbers)


@lru_cache(maxsize=1)
def _load(model: bytes, settings: Settings) -> Simulation:
    """Return the prepared simulation of a serialized model, cached in the process."""
    return prepare(model_of_bytes(model), settings)


def _runs(simulation: Simulation, numbers: range) -> list[EnsembleRun]:
    """Return the results of the runs with these numbers."""
    engine, runs = simulation.player(), []
    length_names = {signal.local for signal in simulation.signals if signal.unit == LENGTH}
    until = driven_until(simulation)
    for run_number in numbers:
        accumulator = SummaryAccumulator(simulation, until)
        for block in blocks(simulation, run=run_number, player=engine):
            accumulator.take(block.time, block.values)
        summary = accumulator.summary(block)
        force = None if summary.largest_force is None else summary.largest_force[1]
        copy_error = max(
            (distance for name, distance in summary.copies if name in length_names), default=None
        )
        runs.append(EnsembleRun(run_number, summary.verdict, summary.settled, force, copy_error))
    return runs
