"""The result of a simulation for the user: rows, columns with names and units, and provenance.

Takes: a `Simulation`. Gives: `simulate`, `run_simulation`; `Trajectory`, `trajectory_of`, `SimulationReport`,
`Provenance`, `provenance_of`; `Sink`, `Keeper`, consumers of rows; `parse_duration`, `duration_of`,
`parameters_of`, `texts_of`.
Guarantees: no number is infinite, and NaN only at an absent peer; a diverging simulation is stored up to the
last finite row, and reported.
Does not: write files, or draw (see `output`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Protocol, Unpack

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerTime
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.result import PlotStyle, Result
from apc.simulation.accuracy import ErrorEstimate, compare_with
from apc.simulation.flow import Tolerance
from apc.simulation.output_blocks import OutputBlock, blocks
from apc.simulation.settings import DEFAULT, EXACT, WHERE_NEEDED, Method, Settings
from apc.simulation.signals import Signal
from apc.simulation.simulation import Simulation, check_length, prepare
from apc.simulation.summary import Summary, SummaryAccumulator, checked_by_analysis
from apc.support.distribution import versions
from apc.support.extension_table import require_extension
from apc.support.memory import refuse_beyond
from apc.support.option_value import option_value

Floats = NDArray[np.float64]

NUMBER = 16  # bytes of memory for a stored number: in its block, and in the joined rows
MOST_LISTED = 1000  # peers whose own parameters are listed; the digest of their table covers the others


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of a result: topology, method, seed, parameters and versions.

    `texts` is the SHA-256 of all texts of the model; `parameters` are (name, value in SI, unit). `joins` and
    `leaves` are the peers that join and leave.
    """

    topology: str
    texts: str
    duration_s: str
    method: str
    tolerances: tuple[Tolerance, ...]
    seed: int
    parameters: tuple[tuple[str, float, str], ...]
    timings: tuple[tuple[str, str], ...]
    joins: tuple[PeerTime, ...] = ()
    leaves: tuple[PeerTime, ...] = ()

    @property
    def versions(self) -> tuple[tuple[str, str], ...]:
        """The versions of the program and its libraries, read when a result is written."""
        return versions("casadi", "numpy")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SimulationReport(Result):
    """The summary of a run without its rows; `interrupted` states that the run ended early.

    `error` is the error estimate, None if it was not requested.
    """

    shown_by = "simulation_output:simulation"

    topology: str
    summary: Summary
    provenance: Provenance
    interrupted: bool
    error: ErrorEstimate | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Trajectory(SimulationReport):
    """The rows of a simulation: `time` (rows,) in seconds, `values` (rows, signals) in SI, one column per
    signal.

    A row contains the values just before the tick at its time.
    """

    time: Floats
    values: Floats
    signals: tuple[Signal, ...]

    def __getitem__(self, name: str) -> Floats:
        """Return the column of a signal (rows,); KeyError if no signal has this name."""
        for index, signal in enumerate(self.signals):
            if signal.name == name:
                return self.values[:, index]
        raise KeyError(name)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame: index `time [s]`, one column per signal, headings with units."""
        return self._shown("table")

    def to_xarray(self) -> Any:
        """Return an xarray Dataset over `time`, one variable per signal with its unit as attribute."""
        return self._shown("dataset")

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Return a Figure with one panel per quantity, or all signals in one Axes, in the style `look`.

        Parameters
        ----------
        ax
            The target Axes; signals of more than one unit need a separate figure.
        """
        return self._plotted(ax, style=style)


def provenance_of(simulation: Simulation) -> Provenance:
    """Return the provenance of a simulation's results."""
    model = simulation.model
    return Provenance(
        topology=model.name,
        texts=texts_of(model),
        duration_s=str(simulation.settings.duration),
        method=simulation.how,
        tolerances=simulation.tolerances,
        seed=simulation.seed,
        parameters=parameters_of(model),
        timings=tuple((timing.name, str(timing.value)) for timing in model.timings),
        joins=model.experiment.joins,
        leaves=model.experiment.leaves,
    )


def parameters_of(model: Model) -> tuple[tuple[str, float, str], ...]:
    """Return the parameters of a model, its groups and its peers: name, value in SI, unit."""
    parameters = [(parameter.name, parameter.value, parameter.unit) for parameter in model.parameters]
    for group in model.groups:
        parameters += [(f"{group.name}.{value.name}", value.value, value.unit) for value in group.values]
    units = {parameter.name: parameter.unit for parameter in model.parameters}
    for group in model.groups:
        for column in group.columns:
            parameters += [
                (f"{group.name}[{i + 1}].{column.name}", float(value), units.get(column.name, "1"))
                for i, value in enumerate(column.values[:MOST_LISTED])
            ]
    return tuple(parameters)


def texts_of(model: Model) -> str:
    """Return the SHA-256 of all texts of a model."""
    texts = "\n".join(f"{name} {digest}" for name, digest in model.origin.digests)
    return hashlib.sha256(texts.encode("utf-8", "surrogateescape")).hexdigest()


class Sink(Protocol):
    """A consumer of the blocks of a simulation."""

    def take(self, block: OutputBlock) -> None:
        """Process one block of rows."""


class Keeper:
    """A sink that stores all rows in memory."""

    def __init__(self, simulation: Simulation) -> None:
        numbers = simulation.rows * len(simulation.signals)
        message = f"{len(simulation.signals):,} signals over {float(simulation.settings.duration):g} s"
        advice = "use fewer --signals, a shorter --duration, or --out FILE.parquet alone"
        refuse_beyond(
            NUMBER * numbers, "E876", SourceLocation(simulation.model.origin.topology), message, advice
        )
        self.signals = len(simulation.signals)
        self.time: list[Floats] = []
        self.values: list[Floats] = []

    def take(self, block: OutputBlock) -> None:
        """Store one block of rows."""
        self.time.append(block.time)
        self.values.append(block.values)


@part("simulate")
def run_simulation(
    simulation: Simulation, sinks: Sequence[Sink], *, progress: Callable[[float], None] | None = None
) -> tuple[Summary, bool]:
    """Return the summary of a simulation run into sinks, and whether Ctrl-C ended the run early.

    Parameters
    ----------
    simulation
        The prepared simulation.
    sinks
        The consumers of the blocks.
    progress
        Called with the simulated time, in seconds, after each block.
    """
    accumulator, interrupted = SummaryAccumulator(simulation), False
    try:
        for block in blocks(simulation):
            accumulator.take(block.time, block.values)
            for sink in sinks:
                sink.take(block)
            if progress is not None and len(block.time):
                progress(float(block.time[-1]))
    except KeyboardInterrupt:
        if not accumulator.rows:
            raise
        interrupted = True
    summary = accumulator.summary(block)
    if simulation.settings.method.name in (EXACT, WHERE_NEEDED):
        model = simulation.topology
        if simulation.presence is not None:
            model = require_extension("changing_counts").model_at_end(simulation)
        summary = checked_by_analysis(summary, model)
    return summary, interrupted


def simulate(
    model: Model,
    *,
    duration: Fraction | None = None,
    signals: Sequence[str] = (),
    jit: bool = True,
    seed: int | None = None,
    method: Method = DEFAULT,
    error: bool = False,
) -> Trajectory:
    """Return the rows of a simulation of a model in time.

    Parameters
    ----------
    model
        The model.
    duration
        The duration in seconds; by default that of the model's experiment.
    signals
        Patterns of the signals to store, all signals without patterns; see `signals.choose`.
    jit
        Whether to compile to machine code if a C compiler exists.
    seed
        The seed of the random numbers; by default the experiment's.
    method
        The integration method between events.
    error
        Whether to estimate the error, by a second run.

    Raises
    ------
    ApcError
        E877 no duration is given, E876 too many numbers to store; and the errors of `simulation.prepare`.
    """
    settings = Settings(duration_of(model, duration), method, seed, jit)
    simulation = prepare(model, settings, signals=signals)
    keeper = Keeper(simulation)
    comparison = compare_with(simulation, signals=signals) if error else None
    summary, interrupted = run_simulation(simulation, [keeper, *([comparison] if comparison else [])])
    estimate = comparison.estimate() if comparison else None
    return trajectory_of(simulation, keeper, summary, interrupted, estimate)


def trajectory_of(
    simulation: Simulation,
    keeper: Keeper,
    summary: Summary,
    interrupted: bool,
    error: ErrorEstimate | None = None,
) -> Trajectory:
    """Return the stored rows of a simulation as a trajectory.

    Parameters
    ----------
    simulation
        The simulated model.
    keeper
        The stored rows.
    summary, interrupted
        The results of `run_simulation`.
    error
        The error estimate, if any.
    """
    return Trajectory(
        topology=simulation.model.name,
        time=np.concatenate(keeper.time),
        values=np.concatenate(keeper.values),
        signals=simulation.signals,
        summary=summary,
        provenance=provenance_of(simulation),
        interrupted=interrupted,
        error=error,
    )


def parse_duration(text: str) -> Fraction:
    """Return the duration of a text such as "2 s", in seconds; ApcError if the text is no duration."""
    return option_value("--duration", text, subject="duration", unit="s")


def duration_of(model: Model, duration: Fraction | None, *, runs: int = 1) -> Fraction:
    """Return the simulated duration in seconds: the given duration, or that of the experiment.

    Parameters
    ----------
    model
        The model.
    duration
        The duration in seconds, if given.
    runs
        The number of runs.

    Raises
    ------
    ApcError
        E877 no duration is given; E915 the run would take too long.
    """
    number = model.experiment.duration if duration is None else duration
    if number is None:
        message = "the topology has no duration"
        fix = 'experiment: {duration: 3 s}, or --duration "3 s"'
        raise ApcError(Diagnostic("E877", SourceLocation(model.origin.topology), message, fix=fix))
    if number <= 0:
        expected, got = "more than 0 s", f"{float(number):g} s"
        raise ApcError(
            Diagnostic("E877", SourceLocation(model.origin.topology), "duration", expected=expected, got=got)
        )
    check_length(model, number, runs=runs)
    return number
