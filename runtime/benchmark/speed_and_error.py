"""Speed against error: every method on one topology, on this machine, beside the truth.

Takes: a `Model`.
Gives: `MethodTiming`, `TaskComparison`, `Bench`, `bench`; `pareto_front`; `reason_of`.
Guarantees: times are the processor's, medians over rounds in which all methods take turns; an error is the
distance from the same equations in balls (of a spectral radius) or from the exact transition (of a motion,
whose own error is what one rounding of every coefficient makes), and is left out where there is none.
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
from apc.analysis.paper_method import analyze_paper
from apc.benchmark.timing import alternate, spread_of, timed
from apc.benchmark.truth import spectral_truth
from apc.compiler.compiled import Model, PeerColumn
from apc.compiler.errors import ApcError
from apc.compiler.wording import with_unit
from apc.distribution import versions
from apc.frame.interval_arithmetic import UNIT_ROUNDOFF
from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.not_supported import NotSupportedError
from apc.result import Result
from apc.simulation.flow import state_scales
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import CVODES, DEFAULT, EXACT, RK4, SEMI_IMPLICIT, Method, Settings, finer
from apc.simulation.simulation import Simulation, prepare
from apc.threads import single_threaded
from apc.verdict import Limitation, LimitationCode, Note, code_of

Floats = NDArray[np.float64]

# Rounds in which every method takes its turn; a method gets fewer once its runs took so many seconds, and
# none after its first run if that alone did.
ROUNDS, ENOUGH = 15, 3.0

# Errors below this count as equal: their order is random. An eigenvalue of n states is computed to some n
# roundings, a state after so many ticks to about as many as the root of their number; topologies have tens of
# states and hundreds of ticks.
SAME = 64 * UNIT_ROUNDOFF

# Duration of the simulation: longer than any start-up.
DURATION = Fraction(1, 4)

# Limitations that no method may have.
WRONG = {LimitationCode.WRONG_VERDICT, LimitationCode.OPEN_VERDICT, LimitationCode.WRONG_BOUND}

# Of `analyze(method=…)`, and the two that are called otherwise.
CERTIFIED = "certified"
ANALYSES = (*(text for text in METHODS if text not in (AUTO, PAPER)), CERTIFIED, PAPER)


@dataclass(frozen=True, slots=True)
class MethodTiming:
    """One method: median `seconds`, `spread` (half the distance between the quartiles), over `rounds` runs.

    `error` is the true one, None without a reference; `bound` what the method itself says, None if it says
    nothing. `front` says that no other method is both faster and more right; `chosen` that it is the default.
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
    """All methods of one task, the fastest first.

    `quantity` is the quantity with an error, `relative` the reference of that error, `timed` the measured
    operation. `reference` describes the true value, or the reason why there is none; `refused` are the
    methods that do not support the topology, with the reason; `limitations` are those of all methods.
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
        """The failures: a wrong verdict or bound, or a method that crashes."""
        wrong = [note for note in self.notes if code_of(note) in WRONG]
        crashed = [pair for pair in self.refused if code_of(pair[1]) is LimitationCode.CRASHED]
        return (*map(str, wrong), *(f"{name} {reason}" for name, reason in crashed))


@dataclass(frozen=True, slots=True)
class Bench(Result):
    """Both tasks on a topology; `machine` says where."""

    shown_by = "bench_output:bench"

    topology: str
    peers: int
    machine: Mapping[str, str]
    comparisons: tuple[TaskComparison, ...]

    @property
    def faults(self) -> tuple[str, ...]:
        """The failures on all topologies, empty if there are none."""
        return tuple(fault for comparison in self.comparisons for fault in comparison.faults)


def bench(system: Model, *, rounds: int = ROUNDS, duration: Fraction = DURATION) -> Bench:
    """Measure every method of analysis and of simulation on a topology.

    Parameters
    ----------
    system
        The compiled topology, with the numbers to use.
    rounds
        Runs of each method, fewer of slow ones.
    duration
        The duration of the simulation, in seconds.

    Raises
    ------
    ApcError
        The topology can't be analysed at all.
    """
    with single_threaded():
        analysis = bench_analysis(system, rounds=rounds)
        try:
            simulation = bench_simulation(system, duration, rounds=rounds)
        except ApcError as error:  # a model too large to simulate can still be analysed
            simulation = _simulation(duration, (), "nothing is played", (("every method", reason_of(error)),))
    return Bench(system.name, system.peers, machine(), (analysis, simulation))


def reason_of(error: ApcError) -> str:
    """Return why something was refused; the line to write instead is of another command."""
    return replace(error.mistakes[0], hint="").sentence.removesuffix(".")


def machine() -> dict[str, str]:
    """Return the description of the machine."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": str(cpu_count()),
        "python": platform.python_version(),
        **dict(versions("numpy", "scipy", "casadi", "python-flint")),
    }


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:  # noqa: PTH123 -- one line of a file of the kernel's
            return next(
                (line.partition(":")[2].strip() for line in file if line.startswith("model name")), ""
            )
    except OSError:
        return platform.processor()


def bench_analysis(system: Model, *, rounds: int = ROUNDS) -> TaskComparison:
    """Measure every method of analysis, from the compiled topology to its verdict.

    The error is that of the spectral radius, rigid modes left out.
    """
    calls: dict[str, Callable[[], Analysis]] = {
        name: partial(analyze, system, method=name) for name in ANALYSES if name not in (CERTIFIED, PAPER)
    }
    calls[CERTIFIED] = partial(analyze, system, certify=True)
    calls[PAPER] = partial(analyze_paper, system)
    default = analyze(system)
    limitations = []
    truth, text = None, "the same equations in 512-bit balls, of the numbers as doubles: spectral radius"
    try:
        truth = spectral_truth(system)
        text = f"{text} {truth.digits}"
    except NotSupportedError as why:
        text = str(why)
    results, refused, slow = _first(calls)
    if CERTIFIED in results and (reason := _not_proved(results[CERTIFIED])):
        limitations.append((CERTIFIED, reason))
        del results[CERTIFIED]
    times = slow | alternate(
        {name: calls[name] for name in results if name not in slow}, rounds, enough=ENOUGH
    )
    measured = [
        _measured(
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
    """Return why an analysis that was to prove its verdict did not, "" if it did."""
    outcome = analysis.proof.outcome
    if outcome is not None and outcome.proved:
        return ""
    unproved = (LimitationCode.NOT_PROVED, LimitationCode.NO_BALLS)
    reasons = [str(note) for note in analysis.notes if code_of(note) in unproved]
    return "; ".join(reasons) or f"not proved: {analysis.proof}"


def bench_simulation(system: Model, duration: Fraction = DURATION, *, rounds: int = ROUNDS) -> TaskComparison:
    """Measure every method of simulation, from the first instant to the last.

    The error is the largest distance of any continuous state at any tick from the exact transition, relative
    to the largest value that a state of its unit takes. The exact transition itself is as far off as it moves
    where every coefficient is off by one rounding (see `accuracy`).
    """
    notes = []
    if _rests(system, duration):
        system, how = _moved(system)
        notes.append(f"nothing moves in this topology: {how}")
    calls = {str(method): partial(_ready, system, duration, method) for method in _methods(system)}
    ready, refused, _ = _first(calls)
    times = alternate({name: partial(_simulate, item) for name, item in ready.items()}, rounds, enough=ENOUGH)
    chosen = prepare(system, Settings(duration)).how
    exact = ready.get(EXACT)
    rounded, _ = finer(Method(EXACT), all_linear=True)
    measured = [
        _measured(
            name,
            times[name],
            error=exact and _distance(_ready(system, duration, rounded) if item is exact else item, exact),
            bound=None,
            chosen=name == chosen or (name == str(DEFAULT) and chosen != EXACT),
        )
        for name, item in ready.items()
    ]
    exact_by = "the exact transition, itself off by what one rounding of each number makes"
    text = str(dict(refused).get(EXACT, exact_by))
    return _simulation(duration, pareto_front(measured), text, refused, tuple(notes))


def _simulation(
    duration: Fraction,
    measured: tuple[MethodTiming, ...],
    reference: str,
    refused: tuple[tuple[str, Note], ...],
    notes: tuple[Note, ...] = (),
) -> TaskComparison:
    return TaskComparison(
        task="simulate",
        quantity=f"states over {float(duration):g} s",
        relative="relative to the largest value of a state's unit",
        timed="a run, without what prepares it",
        measured=measured,
        reference=reference,
        refused=refused,
        notes=notes,
    )


def _methods(system: Model) -> list[Method]:
    """Return the methods to compare, their steps cut from the period of the fastest clock."""
    seconds = resolve(system).timings
    tick = min((seconds[clock.period] for clock in system.clocks), default=Fraction(1, 1000))
    return [
        Method(EXACT),
        *(Method(RK4, step=tick / parts) for parts in (1, 4, 16)),
        *(Method(SEMI_IMPLICIT, step=tick / parts) for parts in (1, 10)),
        *(Method(CVODES, tolerance=tolerance) for tolerance in (1e-6, 1e-8, 1e-10)),
    ]


def _rests(system: Model, duration: Fraction) -> bool:
    """Say whether no state ever changes: whatever pushes, and be it between two ticks, leaves its trace."""
    names = tuple(dict.fromkeys(state.name for peer_type in system.peer_types for state in peer_type.states))
    if not names:
        return False
    first: Floats | None = None
    for block in blocks(prepare(system, Settings(duration), signals=names)):
        first = block.values[0] if first is None else first
        if block.stopped or np.any(block.values != first):
            return False
    return True


def _moved(system: Model) -> tuple[Model, str]:
    """Let the first peer start by its first state's own scale elsewhere, and say so."""
    first, *others = system.groups
    peer_type, numbers = system.peer_types[first.peer_type], resolve(system)
    state = peer_type.states[0]
    rows = numbers.parameters[0]
    by = float(state_scales(system, peer_type, jacobians(peer_type), list(rows))[0])
    values = np.array(rows[numbers.rows[0], peer_type.parameters.index(state.start)], dtype=np.float64)
    values[0] += by
    columns = (
        *(column for column in first.columns if column.name != state.start),
        PeerColumn(state.start, values),
    )
    changed = replace(system, groups=(replace(first, columns=columns), *others))
    return changed, f"{state.name} of its first peer starts {with_unit(f'{by:g}', state.unit)} elsewhere"


def _ready(system: Model, duration: Fraction, method: Method) -> Simulation:
    return prepare(system, Settings(duration, method))


def _simulate(simulation: Simulation) -> None:
    for _ in blocks(simulation):
        pass


def _distance(simulation: Simulation, exact: Simulation) -> float:
    """Return how far any state is from an exact run, relative to the largest value of its unit there."""
    names = {state.name for peer_type in simulation.system.peer_types for state in peer_type.states}
    moving = [index for index, signal in enumerate(exact.signals) if signal.local in names]
    rows = (row for block in blocks(simulation) for row in block.values)
    separation, size = np.zeros(len(moving)), np.zeros(len(moving))
    for block in blocks(exact):
        for row in block.values[:, moving]:
            other = next(rows, None)
            if other is None:
                return np.inf  # it left the range of floats
            separation, size = (
                np.maximum(separation, np.abs(other[moving] - row)),
                np.maximum(size, np.abs(row)),
            )
    worst = 0.0
    units = np.array([exact.signals[index].unit for index in moving])
    for unit in dict.fromkeys(units.tolist()):
        error, largest = (float(values[units == unit].max()) for values in (separation, size))
        worst = max(worst, error / largest if largest else error)
    return worst


def _first(
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
        except Exception as error:  # a bug of one method is a result, and no reason to lose the others'
            refused.append((name, Limitation(LimitationCode.CRASHED, (repr(error),))))
        else:
            if seconds > ENOUGH:
                slow[name] = [seconds]
    return results, tuple(refused), slow


def _measured(
    name: str, times: Sequence[float], *, error: float | None, bound: float | None, chosen: bool
) -> MethodTiming:
    return MethodTiming(name, statistics.median(times), spread_of(times), len(times), error, bound, chosen)


def pareto_front(measured: Sequence[MethodTiming]) -> tuple[MethodTiming, ...]:
    """Mark what no other is better than in both ways, and sort by time.

    One beats another if it is faster by more than both spreads together and not less right, or more right and
    not slower. Half the distance between the quartiles is 0.67 of a normal deviation σ, the median of 15 runs
    is certain to 0.32 σ, so that a difference of both spreads is three deviations of the random part. More
    right is what errs less by more than chance (`SAME`). Without errors there is no front.
    """
    return tuple(
        replace(
            item,
            front=item.error is not None
            and not any(_beats(other, item) for other in measured if other.error is not None),
        )
        for item in sorted(measured, key=lambda measured: measured.seconds)
    )


def _beats(measured: MethodTiming, other: MethodTiming) -> bool:
    faster = measured.seconds + measured.spread + other.spread < other.seconds
    mine, theirs = (max(m.error or 0.0, SAME) for m in (measured, other))
    return (faster and mine <= theirs) or (mine < theirs and measured.seconds <= other.seconds)
