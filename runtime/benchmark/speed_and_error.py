"""Time and error of every method on one topology, on this machine.

Takes: a `Model`.
Gives: `MethodTiming`, `TaskComparison`, `Bench`, `bench`; `pareto_front`; `reason_of`; `analysis_of`.
Guarantees: times are processor times, medians over rounds in which all methods alternate; an error is the
distance from the solution of the same equations in balls (spectral radius) or by the exact transition
(motion, with the effect of one rounding of every coefficient as its own error); it is omitted without a
reference.
Does not: draw (see `output.bench_output`), or grow the topology (see `benchmark.scale`).
"""

from __future__ import annotations

import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from os import cpu_count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze
from apc.analysis.methods import AUTO, METHODS, PAPER
from apc.benchmark.timing import alternate, spread_of, timed
from apc.benchmark.truth import spectral_truth
from apc.compiler.compiled import Model, PeerColumn
from apc.compiler.errors import ApcError
from apc.compiler.wording import with_unit
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.lifting.numeric_model import numeric_model
from apc.linearization.jacobians import jacobians
from apc.parameter_values.parameters import resolve
from apc.result import Result
from apc.simulation.flow import state_scales
from apc.simulation.output_blocks import blocks
from apc.simulation.presence import refuse_joins_and_leaves
from apc.simulation.settings import CVODES, DEFAULT, EXACT, RK4, SEMI_IMPLICIT, Method, Settings, finer
from apc.simulation.simulation import Simulation, prepare
from apc.support.distribution import versions
from apc.support.extension_table import find_extension
from apc.support.not_supported import NotSupportedError
from apc.support.threads import single_threaded
from apc.verdict import Limitation, LimitationCode, Note, code_of

Floats = NDArray[np.float64]

# The number of rounds with a run of every method, and the seconds after which a method has fewer runs: one
# run only if the first run takes longer.
ROUNDS, ENOUGH = 15, 3.0

# Errors below this are considered equal: their order is random. The error of an eigenvalue of n states is
# about n roundings, of a state after k ticks about √k roundings; topologies have tens of states and hundreds
# of ticks.
SAME = 64 * UNIT_ROUNDOFF

# Duration of the simulation: longer than any start-up.
DURATION = Fraction(1, 4)

# Limitations that no method may have.
WRONG = {LimitationCode.WRONG_VERDICT, LimitationCode.OPEN_VERDICT, LimitationCode.WRONG_BOUND}

# The methods of `analyze(method=…)`, and two methods with their own calls.
CERTIFIED = "certified"
ANALYSES = (*(text for text in METHODS if text not in (AUTO, PAPER)), CERTIFIED, PAPER)


@dataclass(frozen=True, slots=True)
class MethodTiming:
    """The measurement of one method: median `seconds`, and `spread` (half the interquartile range), over
    `rounds` runs.

    `error` is the true error, None without a reference; `bound` is the method's error bound, None if there is
    none. `front` is whether no other method is both faster and more accurate; `chosen` whether it is the
    default.
    """

    name: str
    seconds: float
    spread: float
    rounds: int
    error: float | None
    bound: float | None
    chosen: bool
    front: bool = False

    @property
    def fails(self) -> bool:
        """Whether the true error exceeds the method's error bound."""
        return self.error is not None and self.bound is not None and not self.error <= self.bound


@dataclass(frozen=True, slots=True)
class TaskComparison:
    """All methods for one task, sorted by time.

    `quantity` is the quantity with an error, `relative` the reference value of the error, `timed` the
    measured operation. `reference` describes the reference solution, or the reason why there is none;
    `refused` are the methods that do not support the topology, with the reason; `limitations` are those of
    all methods.
    """

    task: str
    quantity: str
    relative: str
    timed: str
    measured: tuple[MethodTiming, ...]
    reference: str
    refused: tuple[tuple[str, Note], ...]
    notes: tuple[Note, ...] = ()
    limitations: tuple[str, ...] = ()

    @property
    def chosen(self) -> MethodTiming | None:
        """The default method."""
        return next((measured for measured in self.measured if measured.chosen), None)

    @property
    def faults(self) -> tuple[str, ...]:
        """The texts of failures: a wrong verdict or bound, or a method that crashes."""
        wrong = [note for note in self.notes if code_of(note) in WRONG]
        crashed = [pair for pair in self.refused if code_of(pair[1]) is LimitationCode.CRASHED]
        return (*map(str, wrong), *(f"{name} {reason}" for name, reason in crashed))


@dataclass(frozen=True, slots=True)
class Bench(Result):
    """The measurements of both tasks on a topology; `machine` describes the machine."""

    shown_by = "bench_output:bench"

    topology: str
    peers: int
    machine: Mapping[str, str]
    comparisons: tuple[TaskComparison, ...]

    @property
    def faults(self) -> tuple[str, ...]:
        """The texts of failures of both tasks, empty if there are none."""
        return tuple(fault for comparison in self.comparisons for fault in comparison.faults)


def bench(model: Model, *, rounds: int = ROUNDS, duration: Fraction = DURATION) -> Bench:
    """Return the measurements of every method of analysis and simulation on a topology.

    Parameters
    ----------
    model
        The model, with the parameter values to use.
    rounds
        The number of runs of each method, fewer for slow methods.
    duration
        The duration of the simulation, in seconds.

    Raises
    ------
    ApcError
        No method can analyze the topology.
    """
    with single_threaded():
        analysis = bench_analysis(model, rounds=rounds)
        try:
            simulation = bench_simulation(model, duration, rounds=rounds)
        except ApcError as error:  # a model that is too large for simulation can still be analyzed
            simulation = _simulation_comparison(
                duration, (), "no simulation", (("every method", reason_of(error)),)
            )
    return Bench(model.name, model.peers, machine(), (analysis, simulation))


def reason_of(error: ApcError) -> str:
    """Return the text of an error without its fix, which would be for another command."""
    return replace(error.mistakes[0], fix="").sentence.removesuffix(".")


def machine() -> dict[str, str]:
    """Return the description of the machine and of the libraries, by property."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": str(cpu_count()),
        "python": platform.python_version(),
        **dict(versions("numpy", "scipy", "casadi", "python-flint")),
    }


def _processor() -> str:
    """Return the name of the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:  # noqa: PTH123 -- one line of a file of the kernel's
            return next(
                (line.partition(":")[2].strip() for line in file if line.startswith("model name")), ""
            )
    except OSError:
        return platform.processor()


def analysis_of(model: Model, *, method: str = AUTO, certify: bool = False) -> Analysis:
    """Return the analysis of a model, with its Jacobians and schedules; parameters as for `analyze`."""
    return analyze(numeric_model(model), method=method, certify=certify)


def bench_analysis(model: Model, *, rounds: int = ROUNDS) -> TaskComparison:
    """Return the measurements of every method of analysis, from the compiled topology to the verdict.

    The error is that of the spectral radius without rigid modes.
    """
    calls: dict[str, Callable[[], Analysis]] = {
        name: partial(analysis_of, model, method=name) for name in ANALYSES if name not in (CERTIFIED, PAPER)
    }
    calls[CERTIFIED] = partial(analysis_of, model, certify=True)
    if paper_method := find_extension("paper_method"):
        calls[PAPER] = partial(paper_method.analyze_paper, model)
    default = analysis_of(model)
    limitations = []
    truth, text = (
        None,
        "the same equations in 512-bit ball arithmetic, with parameters as doubles: spectral radius",
    )
    try:
        truth = spectral_truth(model)
        text = f"{text} {truth.digits}"
    except NotSupportedError as why:
        text = str(why)
    results, refused, slow = _first_results(calls)
    if CERTIFIED in results and (reason := _not_proved(results[CERTIFIED])):
        limitations.append((CERTIFIED, reason))
        del results[CERTIFIED]
    times = slow | alternate(
        {name: calls[name] for name in results if name not in slow}, rounds, enough=ENOUGH
    )
    measured = [
        _timing(
            name,
            times[name],
            error=truth.error_of(result.spectral_radius) if truth else None,
            bound=result.spectral_radius_error,
            chosen=name == default.method,
        )
        for name, result in results.items()
    ]
    notes = [
        Limitation(LimitationCode.WRONG_VERDICT, (name, result.verdict, default.method, default.verdict))
        for name, result in results.items()
        if result.stable is not None and default.stable is not None and result.verdict != default.verdict
    ]
    if default.stable is None:
        notes.append(Limitation(LimitationCode.OPEN_VERDICT, (default.verdict,)))
    notes += [Limitation(LimitationCode.WRONG_BOUND, (item.name,)) for item in measured if item.fails]
    return TaskComparison(
        task="analyze",
        quantity="spectral radius",
        relative="absolute",
        timed="an analysis, from the compiled topology to its verdict",
        measured=pareto_front(measured),
        reference=text,
        refused=(*limitations, *refused),
        notes=tuple(notes),
        limitations=default.limitations,
    )


def _not_proved(analysis: Analysis) -> str:
    """Return the reason why an analysis did not prove its verdict, "" if it did."""
    outcome = analysis.proof.outcome
    if outcome is not None and outcome.proved:
        return ""
    unproved = (LimitationCode.NOT_PROVED, LimitationCode.NO_BALLS)
    reasons = [str(note) for note in analysis.notes if code_of(note) in unproved]
    return "; ".join(reasons) or f"not proved: {analysis.proof}"


def bench_simulation(model: Model, duration: Fraction = DURATION, *, rounds: int = ROUNDS) -> TaskComparison:
    """Return the measurements of every method of simulation, from the first instant to the last.

    The error is the largest distance of all continuous states at all ticks from the exact transition,
    relative to the largest value of all states with the same unit. The error of the exact transition is its
    change if every coefficient is changed by one rounding (see `accuracy`).
    """
    refuse_joins_and_leaves(model, "apc bench")
    notes = []
    if _is_at_rest(model, duration):
        model, how = _with_displaced_start(model)
        notes.append(f"this topology is at rest: {how}")
    calls = {
        str(method): partial(_prepared_simulation, model, duration, method) for method in _methods(model)
    }
    simulations, refused, _ = _first_results(calls)
    times = alternate(
        {name: partial(_simulate, item) for name, item in simulations.items()}, rounds, enough=ENOUGH
    )
    chosen = prepare(model, Settings(duration)).how
    exact = simulations.get(EXACT)
    rounded, _ = finer(Method(EXACT), all_linear=True)
    measured = [
        _timing(
            name,
            times[name],
            error=exact
            and _distance(_prepared_simulation(model, duration, rounded) if item is exact else item, exact),
            bound=None,
            chosen=name == chosen or (name == str(DEFAULT) and chosen != EXACT),
        )
        for name, item in simulations.items()
    ]
    exact_by = "the exact transition matrix, whose error is that of one rounding of each coefficient"
    text = str(dict(refused).get(EXACT, exact_by))
    return _simulation_comparison(duration, pareto_front(measured), text, refused, tuple(notes))


def _simulation_comparison(
    duration: Fraction,
    measured: tuple[MethodTiming, ...],
    reference: str,
    refused: tuple[tuple[str, Note], ...],
    notes: tuple[Note, ...] = (),
) -> TaskComparison:
    """Return the comparison of simulation methods, with the texts of this task."""
    return TaskComparison(
        task="simulate",
        quantity=f"states over {float(duration):g} s",
        relative="relative to the largest value of a state's unit",
        timed="a run, without its preparation",
        measured=measured,
        reference=reference,
        refused=refused,
        notes=notes,
    )


def _methods(model: Model) -> list[Method]:
    """Return the simulation methods to compare, with steps that divide the period of the fastest clock."""
    seconds = resolve(model).timings
    tick = min((seconds[clock.period] for clock in model.clocks), default=Fraction(1, 1000))
    return [
        Method(EXACT),
        *(Method(RK4, step=tick / parts) for parts in (1, 4, 16)),
        *(Method(SEMI_IMPLICIT, step=tick / parts) for parts in (1, 10)),
        *(Method(CVODES, tolerance=tolerance) for tolerance in (1e-6, 1e-8, 1e-10)),
    ]


def _is_at_rest(model: Model, duration: Fraction) -> bool:
    """Return whether no continuous state changes during a simulation."""
    names = tuple(dict.fromkeys(state.name for peer_type in model.peer_types for state in peer_type.states))
    if not names:
        return False
    first: Floats | None = None
    for block in blocks(prepare(model, Settings(duration), signals=names)):
        first = block.values[0] if first is None else first
        if block.stopped or np.any(block.values != first):
            return False
    return True


def _with_displaced_start(model: Model) -> tuple[Model, str]:
    """Return the model with the first state of the first peer displaced at the start, and a text that
    describes this.

    The displacement is the scale of the state.
    """
    first, *others = model.groups
    peer_type, numbers = model.peer_types[first.peer_type], resolve(model)
    state = peer_type.states[0]
    rows = numbers.parameters[0]
    by = float(state_scales(model, peer_type, jacobians(peer_type), list(rows))[0])
    values = np.array(rows[numbers.rows[0], peer_type.parameters.index(state.start)], dtype=np.float64)
    values[0] += by
    columns = (
        *(column for column in first.columns if column.name != state.start),
        PeerColumn(state.start, values),
    )
    changed = replace(model, groups=(replace(first, columns=columns), *others))
    return (
        changed,
        f"the initial {state.name} of the first peer is displaced by {with_unit(f'{by:g}', state.unit)}",
    )


def _prepared_simulation(model: Model, duration: Fraction, method: Method) -> Simulation:
    """Return the prepared simulation by one method."""
    return prepare(model, Settings(duration, method))


def _simulate(simulation: Simulation) -> None:
    """Run a simulation without storing the result."""
    for _ in blocks(simulation):
        pass


def _distance(simulation: Simulation, exact: Simulation) -> float:
    """Return the largest distance of all states from an exact simulation.

    The distance is relative to the largest value of all states with the same unit in the exact simulation.
    """
    names = {state.name for peer_type in simulation.model.peer_types for state in peer_type.states}
    state_columns = [index for index, signal in enumerate(exact.signals) if signal.local in names]
    rows = (row for block in blocks(simulation) for row in block.values)
    largest_difference, largest_value = np.zeros(len(state_columns)), np.zeros(len(state_columns))
    for block in blocks(exact):
        for row in block.values[:, state_columns]:
            other = next(rows, None)
            if other is None:
                return np.inf  # the simulation ended outside the range of floats
            largest_difference, largest_value = (
                np.maximum(largest_difference, np.abs(other[state_columns] - row)),
                np.maximum(largest_value, np.abs(row)),
            )
    worst = 0.0
    units = np.array([exact.signals[index].unit for index in state_columns])
    for unit in dict.fromkeys(units.tolist()):
        error, largest = (
            float(values[units == unit].max()) for values in (largest_difference, largest_value)
        )
        worst = max(worst, error / largest if largest else error)
    return worst


def _first_results(
    calls: Mapping[str, Callable[[], Any]],
) -> tuple[dict[str, Any], tuple[tuple[str, Note], ...], dict[str, list[float]]]:
    """Call each method once; return the results, the failures with reasons, and the times of slow methods."""
    results, slow = {}, {}
    refused: list[tuple[str, Note]] = []
    for name, call in calls.items():
        try:
            seconds, results[name] = timed(call)
        except ApcError as error:
            refused.append((name, reason_of(error)))
        except (
            Exception
        ) as error:  # a crash of one method is a result, and must not prevent the other results
            refused.append((name, Limitation(LimitationCode.CRASHED, (repr(error),))))
        else:
            if seconds > ENOUGH:
                slow[name] = [seconds]
    return results, tuple(refused), slow


def _timing(
    name: str, times: Sequence[float], *, error: float | None, bound: float | None, chosen: bool
) -> MethodTiming:
    """Return the measurement of one method from the times of its runs."""
    return MethodTiming(name, statistics.median(times), spread_of(times), len(times), error, bound, chosen)


def pareto_front(measured: Sequence[MethodTiming]) -> tuple[MethodTiming, ...]:
    """Return the measurements sorted by time, with those on the Pareto front of time and error marked.

    A method dominates another if it is faster by more than the sum of both spreads and not less accurate, or
    more accurate and not slower. Half the interquartile range is 0.67 standard deviations σ, the standard
    error of the median of 15 runs is 0.32 σ, so that the sum of both spreads is three standard errors. A
    method is more accurate if its error is smaller by more than rounding (`SAME`). Without errors there is no
    front.
    """
    return tuple(
        replace(
            item,
            front=item.error is not None
            and not any(_dominates(other, item) for other in measured if other.error is not None),
        )
        for item in sorted(measured, key=lambda measured: measured.seconds)
    )


def _dominates(measured: MethodTiming, other: MethodTiming) -> bool:
    """Return whether a measurement dominates another in time and error."""
    faster = measured.seconds + measured.spread + other.spread < other.seconds
    error, other_error = (max(m.error or 0.0, SAME) for m in (measured, other))
    return (faster and error <= other_error) or (error < other_error and measured.seconds <= other.seconds)
