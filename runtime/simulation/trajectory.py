"""The result of a simulation for the user: rows, columns with names and units, and provenance.

Takes: a `Simulation`. Gives: `simulate`, `run_simulation`; `Trajectory`, `trajectory_of`, `SimulationReport`,
`Provenance`, `provenance_of`; `Sink`, `Keeper`, where rows are stored; `parse_duration`, `duration_of`,
`parameters_of`, `texts_of`.
Guarantees: no number is NaN or infinite; a diverging simulation is kept up to the last finite row, and
reported.
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

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.distribution import versions
from apc.memory import refuse_beyond
from apc.option_value import option_value
from apc.result import PlotStyle, Result
from apc.simulation.accuracy import ErrorEstimate, compare_with
from apc.simulation.flow import Tolerance
from apc.simulation.output_blocks import OutputBlock, blocks
from apc.simulation.settings import DEFAULT, EXACT, WHERE_NEEDED, Method, Settings
from apc.simulation.signals import Signal
from apc.simulation.simulation import Simulation, check_length, prepare
from apc.simulation.summary import Summary, SummaryAccumulator, agreed

Floats = NDArray[np.float64]

NUMBER = 16  # bytes of a number that is kept: in its block, and in the rows put together
MOST_LISTED = 1000  # peers whose own numbers are written out; the digest of their table covers the others


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of a result: `texts` is the SHA-256 of all texts, `parameters` (name, SI, unit)."""

    topology: str
    texts: str
    duration_s: str
    method: str
    tolerances: tuple[Tolerance, ...]
    seed: int
    parameters: tuple[tuple[str, float, str], ...]
    timings: tuple[tuple[str, str], ...]

    @property
    def versions(self) -> tuple[tuple[str, str], ...]:
        """The versions of the program and its libraries: determined when a result is written."""
        return versions("casadi", "numpy")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SimulationReport(Result):
    """The summary of a run without its rows; `interrupted` is whether it ended early.

    `error` is present on request.
    """

    shown_by = "simulation_output:simulation"

    topology: str
    summary: Summary
    provenance: Provenance
    interrupted: bool
    error: ErrorEstimate | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Trajectory(SimulationReport):
    """Rows over time: `time` (rows,) in seconds, `values` (rows, signals) in SI, a column a signal.

    A row holds what was before the tick at its time.
    """

    time: Floats
    values: Floats
    signals: tuple[Signal, ...]

    def __getitem__(self, name: str) -> Floats:
        """Return the column of a signal (rows,). Raises KeyError if there is none of that name."""
        for index, signal in enumerate(self.signals):
            if signal.name == name:
                return self.values[:, index]
        raise KeyError(name)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame: index `time [s]`, a column a signal, headings with units."""
        return self._shown("table")

    def to_xarray(self) -> Any:
        """Return an xarray Dataset over `time`, a variable a signal with its unit as attribute."""
        return self._shown("dataset")

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Plot a panel per quantity, or all signals into one Axes, in the style `reduction`; return the
        Figure.

        Parameters
        ----------
        ax
            The target Axes; signals of more than one unit need a separate figure.
        """
        return self._plotted(ax, style=style)


def provenance_of(simulation: Simulation) -> Provenance:
    """Return the provenance of a simulation's results."""
    system = simulation.system
    return Provenance(
        topology=system.name,
        texts=texts_of(system),
        duration_s=str(simulation.settings.duration),
        method=simulation.how,
        tolerances=simulation.tolerances,
        seed=simulation.seed,
        parameters=parameters_of(system),
        timings=tuple((timing.name, str(timing.value)) for timing in system.timings),
    )


def parameters_of(system: Model) -> tuple[tuple[str, float, str], ...]:
    """Return the parameters of a model, its groups and peers: name, value in SI, unit."""
    parameters = [(parameter.name, parameter.value, parameter.unit) for parameter in system.parameters]
    for group in system.groups:
        parameters += [(f"{group.name}.{value.name}", value.value, value.unit) for value in group.values]
    units = {parameter.name: parameter.unit for parameter in system.parameters}
    for group in system.groups:
        for column in group.columns:
            parameters += [
                (f"{group.name}[{i + 1}].{column.name}", float(value), units.get(column.name, "1"))
                for i, value in enumerate(column.values[:MOST_LISTED])
            ]
    return tuple(parameters)


def texts_of(system: Model) -> str:
    """Return the SHA-256 of all texts of a model."""
    texts = "\n".join(f"{name} {digest}" for name, digest in system.origin.digests)
    return hashlib.sha256(texts.encode("utf-8", "surrogateescape")).hexdigest()


class Sink(Protocol):
    """A consumer of the blocks of a simulation."""

    def take(self, block: OutputBlock) -> None:
        """Take one block."""


class Keeper:
    """Keeps the rows in memory."""

    def __init__(self, simulation: Simulation) -> None:
        numbers = simulation.rows * len(simulation.signals)
        message = f"{len(simulation.signals):,} signals over {float(simulation.settings.duration):g} s"
        hint = "fewer --signals, a shorter --duration, or --out FILE.parquet alone"
        refuse_beyond(
            NUMBER * numbers, "E876", SourceLocation(simulation.system.origin.topology), message, hint
        )
        self.signals = len(simulation.signals)
        self.time: list[Floats] = []
        self.values: list[Floats] = []

    def take(self, block: OutputBlock) -> None:
        """Keep one block."""
        self.time.append(block.time)
        self.values.append(block.values)


@part("simulate")
def run_simulation(
    simulation: Simulation, sinks: Sequence[Sink], *, progress: Callable[[float], None] | None = None
) -> tuple[Summary, bool]:
    """Run a simulation into sinks; return its summary, and whether Ctrl-C ended it early.

    Parameters
    ----------
    simulation
        The prepared simulation.
    sinks
        The consumers of the blocks.
    progress
        Called with the simulated time, in seconds, after each block.
    """
    watch, interrupted = SummaryAccumulator(simulation), False
    try:
        for block in blocks(simulation):
            watch.take(block.time, block.values)
            for sink in sinks:
                sink.take(block)
            if progress is not None and len(block.time):
                progress(float(block.time[-1]))
    except KeyboardInterrupt:
        if not watch.rows:
            raise
        interrupted = True
    summary = watch.summary(block)
    if simulation.settings.method.name in (EXACT, WHERE_NEEDED):
        summary = agreed(summary, simulation.topology)
    return summary, interrupted


def simulate(
    system: Model,
    *,
    duration: Fraction | None = None,
    signals: Sequence[str] = (),
    jit: bool = True,
    seed: int | None = None,
    method: Method = DEFAULT,
    error: bool = False,
) -> Trajectory:
    """Simulate a model in time and store its rows.

    Parameters
    ----------
    system
        The model.
    duration
        In seconds; that of the model's experiment if not given.
    signals
        Patterns of the signals to keep, all if there is none; see `signals.choose`.
    jit
        Whether to compile to machine code where there is a C compiler.
    seed
        The seed of the random numbers; by default the experiment's.
    method
        The integration method between events.
    error
        Whether to estimate the error, by a second run.

    Raises
    ------
    ApcError
        E877 no duration is known, E876 too many numbers to keep; and those of `simulation.prepare`.
    """
    settings = Settings(duration_of(system, duration), method, seed, jit)
    simulation = prepare(system, settings, signals=signals)
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
    """Return the stored rows as a trajectory.

    Parameters
    ----------
    simulation
        The simulated model.
    keeper
        The stored rows.
    summary, interrupted
        As `run_simulation` returns them.
    error
        The error estimate, if any.
    """
    return Trajectory(
        topology=simulation.system.name,
        time=np.concatenate(keeper.time),
        values=np.concatenate(keeper.values),
        signals=simulation.signals,
        summary=summary,
        provenance=provenance_of(simulation),
        interrupted=interrupted,
        error=error,
    )


def parse_duration(text: str) -> Fraction:
    """Read a duration such as "2 s". Raises ApcError if it is none."""
    return option_value("--duration", text, subject="duration", unit="s")


def duration_of(system: Model, duration: Fraction | None, *, runs: int = 1) -> Fraction:
    """Return the simulated duration: the given one, or that of the experiment.

    Parameters
    ----------
    system
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
    number = system.experiment.duration if duration is None else duration
    if number is None:
        message = "the topology says no duration"
        hint = 'experiment: {duration: 3 s}  (or --duration "3 s")'
        raise ApcError(Diagnostic("E877", SourceLocation(system.origin.topology), message, hint=hint))
    if number <= 0:
        expected, got = "more than 0 s", f"{float(number):g} s"
        raise ApcError(
            Diagnostic(
                "E877", SourceLocation(system.origin.topology), "the duration", expected=expected, got=got
            )
        )
    check_length(system, number, runs=runs)
    return number
