"""Parameters of a topology estimated from a recording by least squares.

Takes: a `Model`, its free parameters with ranges, a recording.
Gives: `fit`, `read_free`; `ParameterFit`, `Estimate`, `SignalResiduals`.
Guarantees: residuals are those of the exact simulation at the recorded instants, and their derivatives are
exact. Parameters that the recording does not determine are refused by name.
Does not: estimate times, counts or the network.

    min_θ Σ_j Σ_i ((y_j(t_i) − y_j(t_i; θ)) / σ_j)²        Cov θ = s² (Jᵀ J)⁻¹

with the noise σ_j of each signal estimated from its own residuals, in turn with θ (Bates and Watts, Nonlinear
Regression Analysis, 1988, chapters 2 and 4). Standard errors are those of the linear approximation at the
estimate, intervals those of Student's distribution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar, Unpack

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import with_unit
from apc.extensions.parameter_fit.measured_columns import read_recording
from apc.extensions.parameter_fit.recorded_signals import RecordedSignals, recorded_signals, signals_of_run
from apc.extensions.parameter_fit.sensitivity_model import name_of, with_sensitivities, with_values
from apc.network.nominal_criterion import chance, unreliable
from apc.parameter_values.parameter_names import Range, find, overlap, proposed_range, value_now
from apc.realtime.run_comparison import DeliveredRun
from apc.realtime.run_folder import read_run
from apc.result import PlotStyle, Result
from apc.simulation.interpreted_engine import InterpretedEngine
from apc.simulation.output_blocks import blocks, instants_of
from apc.simulation.presence import refuse_joins_and_leaves
from apc.simulation.settings import DEFAULT, Method, Settings
from apc.simulation.simulation import check_length, prepare
from apc.studies.parameter_ranges import parse_range
from apc.studies.representative_delays import is_delay
from apc.support.option_value import NamedValues, named_values
from apc.support.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

FREE = SourceLocation("--free")
CONFIDENCE = 0.95  # of the intervals, the usual one
# Relative singular value of the Jacobian, its columns of length 1, below which a combination of parameters is
# undetermined: its standard error is 1e8 times that of one parameter. Derivatives are exact to about 1e-12.
SINGULAR = 1e-8
NAMED = 0.1  # share of a singular vector, relative to its largest, above which a parameter belongs to it
NO_EFFECT = 1e-12  # relative change of a signal over the range of a parameter that counts as rounding
EXACT = 1e-9  # residuals, relative to the signal, that count as rounding: their correlation has no meaning
# Of SciPy's least_squares: changes of the sum of squares and of parameters, the gradient, and evaluations.
TOLERANCES = {"ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-12, "max_nfev": 200}
MOST_EVALUATIONS = 1000  # simulations of one fit: most fits take about ten
SETTLED = 1e-6  # relative change of the noise of each signal at the end
AT_END = 1e-6  # share of the range within which an estimate counts as at its end
LAGS = (
    10  # of the whiteness test, at most a fifth of the rows (Hyndman and Athanasopoulos, FPP3, section 5.4)
)
WHITE = 0.01  # the probability below which white residuals are rejected


@dataclass(frozen=True, slots=True)
class Estimate:
    """A parameter: its estimate, standard error and 95 % interval, in SI; `low` and `high` are its range.

    `at_end` states that the estimate is at an end of its range, so that its interval has no meaning.
    """

    name: str
    value: float
    unit: str
    standard_error: float
    interval: tuple[float, float]
    low: float
    high: float
    at_end: bool


@dataclass(frozen=True, slots=True)
class SignalResiduals:
    """The residuals of a signal: their rms in SI, and the Ljung-Box test of their whiteness.

    `probability` is that of a larger statistic over `lags` lags for white residuals, NaN if the residuals are
    rounding errors. `used` states whether the signal depends on a free parameter.
    """

    signal: str
    unit: str
    rms: float
    lags: int
    probability: float
    used: bool

    @property
    def white(self) -> bool:
        """Whether the residuals are consistent with white noise."""
        return not self.probability < WHITE


@dataclass(frozen=True, slots=True, eq=False)
class ParameterFit(Result):
    """The parameters of a topology estimated from a recording.

    `correlation` (k, k) is that of the estimates. `samples` of the `rows` of the recording, at ticks of the
    fastest clock, are compared, over `duration` seconds; `start` is the recorded time of the first row.
    `forces` are the columns that act as forces. `time` (samples,) in seconds, `measured` and `fitted`
    (samples, signals) are in SI.
    """

    shown_by: ClassVar[str] = "apc.extensions.parameter_fit.parameter_fit_output:parameter_fit"

    topology: str
    recording: str
    parameters: tuple[Estimate, ...]
    correlation: tuple[tuple[float, ...], ...]
    residuals: tuple[SignalResiduals, ...]
    rows: int
    samples: int
    duration: float
    start: float
    forces: tuple[str, ...]
    evaluations: int
    time: Floats = field(repr=False)
    measured: Floats = field(repr=False)
    fitted: Floats = field(repr=False)

    @property
    def params(self) -> dict[str, float]:
        """The estimates by name, as the argument `params` of other functions."""
        return {estimate.name: estimate.value for estimate in self.parameters}

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with one row for each parameter, in SI."""
        return self._shown("table")

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Return a Figure with the residuals of each signal, or draw those of a single signal into `ax`."""
        return self._plotted(ax, style=style)


def read_free(model: Model, given: Sequence[str | NamedValues]) -> tuple[Range, ...]:
    """Return the free parameters of texts `NAME=LOW:HIGH`, or of names with the two ends.

    Raises
    ------
    ApcError
        E714 there is none, a parameter is given twice or is a delay, or its value is outside its range; and
        the errors of `parse_range`.
    """
    if not given:
        message, fix = "no free parameter", f'--free "{proposed_range(model)}"'
        raise ApcError(Diagnostic("E714", FREE, message, fix=fix))
    free: list[Range] = []
    for named in given:
        name = named_values(named)[0]
        if name and is_delay(model, find(model, name, FREE)):
            message = f"{name} is a delay: the order of events changes with it"
            raise ApcError(Diagnostic("E714", FREE, message, advice="fit it to packets with apc network"))
        item = parse_range(model, named, FREE)
        label, value = item.free.label, value_now(model, item.free)
        if any(overlap(model, item.free, other.free) for other in free):
            raise ApcError(Diagnostic("E714", FREE, f"{label} has two ranges"))
        if not item.low <= value <= item.high:
            low, high, now, middle = (
                with_unit(f"{float(number):.6g}", item.unit).removesuffix(" 1")
                for number in (item.low, item.high, value, (item.low + item.high) / 2)
            )
            message, fix = f"start value of {label}", f'--set "{label}={middle}"'
            raise ApcError(Diagnostic("E714", FREE, message, f"{low} to {high}", now, fix))
        free.append(item)
    return tuple(free)


def fit(
    model: Model,
    recording: Path,
    free: Sequence[Range],
    *,
    signals: Sequence[str] = (),
    method: Method = DEFAULT,
) -> ParameterFit:
    """Return the parameters of a model fitted to a recording.

    Parameters
    ----------
    model
        The model; its parameter values are the start of the search.
    recording
        A table of force and motion (see `measured_columns`), or the folder of a run.
    free
        The free parameters.
    signals
        Patterns of the measured signals to compare; by default all of the recording.
    method
        The integration method between events, as for `simulate`.

    Raises
    ------
    ApcError
        E711 to E713 the recording or the model is unsuitable, E715 the recording does not determine a
        parameter, E716 the search fails; and those of `simulate`.
    """
    refuse_joins_and_leaves(model, "apc fit")
    if recording.is_dir():
        recorded = signals_of_run(model, read_run(recording), signals)
    else:
        for _, law in unreliable(model):
            if law.trace is None:
                message = f"{chance(law)}: a table does not contain the packets that arrived"
                location, fix = SourceLocation(model.origin.topology), f"apc run {model.origin.topology}"
                raise ApcError(Diagnostic("E713", location, message, fix=fix))
        recorded = recorded_signals(model, read_recording(recording), signals)
    settings = Settings(recorded.duration, method, jit=recorded.run is None)
    return _solve(_problem_of(model, recorded, str(recording), free, settings))


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """A least-squares problem over shares of the ranges, from 0 to 1.

    `model` has the sensitivities; `start` (k,) are the shares of its present values. `rows` are the
    simulated rows at recorded instants, `time` (samples,) and `measured` (samples, signals) the values there.
    `scale` (signals,) is the spread of each signal.
    """

    topology: str
    file: str
    recorded: RecordedSignals
    free: Sequence[Range]
    settings: Settings
    model: Model
    start: Floats
    rows: Integers
    time: Floats
    measured: Floats
    scale: Floats

    def values(self, shares: Floats) -> Floats:
        """Return the parameters (k,) in SI at shares of their ranges."""
        low, high = np.array([(float(item.low), float(item.high)) for item in self.free]).T
        return np.asarray(np.clip(low + (high - low) * shares, low, high))


def _problem_of(
    model: Model, recorded: RecordedSignals, file: str, free: Sequence[Range], settings: Settings
) -> _Problem:
    """Return the least-squares problem of a recording. Raises ApcError E712 for a short recording."""
    check_length(recorded.model, recorded.duration)
    simulation = prepare(recorded.model, Settings(recorded.duration, jit=False))
    last = int(recorded.duration / simulation.quantum)
    instants, is_row = instants_of(simulation, 0, last // simulation.frame + 1, last)
    ticks, tolerance = instants[is_row] * float(simulation.quantum), AT_END * float(simulation.quantum)
    indices = np.minimum(np.searchsorted(recorded.times, ticks - tolerance), len(recorded.times) - 1)
    rows = np.flatnonzero(np.abs(recorded.times[indices] - ticks) <= tolerance)
    measured, frame = recorded.values[indices[rows]], simulation.frame * simulation.quantum
    for message, enough, expected, got in (
        ("duration", last >= simulation.frame, f"at least one frame, {_ms(frame)}", _ms(recorded.duration)),
        (
            "samples at ticks",
            len(rows) > len(free),
            f"more than {len(free)} parameters",
            f"{len(rows)}",
        ),
    ):
        if not enough:
            advice = "use a longer recording, or rows at the ticks of the clocks"
            raise ApcError(Diagnostic("E712", SourceLocation(file), message, expected, got, advice=advice))
    spread = np.maximum(measured.std(axis=0), EXACT * np.abs(measured).max(axis=0))
    return _Problem(
        topology=model.name,
        file=file,
        recorded=recorded,
        free=free,
        settings=settings,
        model=with_sensitivities(recorded.model, free),
        start=np.array(
            [(value_now(model, one.free) - float(one.low)) / float(one.high - one.low) for one in free]
        ).clip(0, 1),
        rows=rows,
        time=recorded.times[indices[rows]],
        measured=measured,
        scale=np.where(spread > 0, spread, 1.0),
    )


def _ms(seconds: Fraction) -> str:
    """Return a time as text in ms."""
    return f"{1000 * float(seconds):.6g} ms"


def _simulate(problem: _Problem, shares: Floats) -> Floats:
    """Return the signals and their derivatives over shares (samples, signals, 1 + k).

    They are infinite if the motion diverges.
    """
    recorded = problem.recorded
    names = [
        f"{signal.group}[{signal.peer}].{name_of(k, signal.local)}"
        for signal in recorded.signals
        for k in range(len(shares) + 1)
    ]
    model = with_values(problem.model, problem.free, problem.values(shares))
    simulation, run, player = prepare(model, problem.settings, signals=names), recorded.run, None
    if run is not None:
        population = simulation.population
        player = InterpretedEngine(population, lambda _: DeliveredRun(run, population))
    rows = np.concatenate([block.values for block in blocks(simulation, player=player)])
    shape = len(problem.rows), len(recorded.signals), len(shares) + 1
    if len(rows) <= problem.rows[-1]:
        return np.full(shape, np.inf)
    order = {signal.name: index for index, signal in enumerate(simulation.signals)}
    return rows[problem.rows][:, [order[name] for name in names]].reshape(shape)


def _solve(problem: _Problem) -> ParameterFit:
    """Return the solution of a least-squares problem.

    Raises
    ------
    ApcError
        E715 the recording does not determine a parameter, E716 the motion diverges or the search fails.
    """
    least_squares = load_pool("scipy.optimize").least_squares
    known: dict[bytes, Floats] = {}
    evaluations = 0

    def outputs(shares: Floats) -> Floats:
        """Return the outputs at shares; the last ones are kept."""
        nonlocal evaluations
        if shares.tobytes() not in known:
            known.clear()
            known[shares.tobytes()] = _simulate(problem, shares)
            evaluations += 1
        return known[shares.tobytes()]

    def residuals(shares: Floats, noise: Floats) -> Floats:
        """Return the residuals relative to the noise."""
        return np.asarray((outputs(shares)[..., 0] - problem.measured) / noise).ravel()

    def slopes(shares: Floats, noise: Floats) -> Floats:
        """Return the Jacobian of `residuals`."""
        return (outputs(shares)[..., 1:] / noise[:, None]).reshape(-1, len(shares))

    shares, noise = problem.start, problem.scale
    message = "the motion diverges at the start values of the free parameters"
    advice = "start from values of a stable topology"
    while evaluations < MOST_EVALUATIONS and np.isfinite(outputs(shares)).all():
        solution = least_squares(
            residuals, shares, slopes, bounds=(0, 1), x_scale="jac", **TOLERANCES, kwargs={"noise": noise}
        )
        shares, last = solution.x, noise
        rms = np.sqrt(np.mean((outputs(shares)[..., 0] - problem.measured) ** 2, axis=0))
        noise = np.maximum(rms, EXACT * problem.scale)
        if solution.success and (len(noise) == 1 or np.abs(noise / last - 1).max() < SETTLED):
            return _result(problem, shares, outputs(shares), evaluations)
        message = f"no minimum within {evaluations} simulations"
        advice = "use narrower ranges, or fewer free parameters"
    raise ApcError(Diagnostic("E716", SourceLocation(problem.file), message, advice=advice))


def _result(problem: _Problem, shares: Floats, found: Floats, evaluations: int) -> ParameterFit:
    """Return the estimates with their statistics, from the outputs at the solution."""
    from scipy.stats import t as student

    recorded, difference = problem.recorded, problem.measured - found[..., 0]
    rms = np.sqrt(np.mean(difference**2, axis=0))
    noise = np.maximum(rms, EXACT * problem.scale)
    effects = np.abs(found[..., 1:]).max(axis=0) / problem.scale[:, None] > NO_EFFECT
    used = effects.any(axis=1)
    jacobian = (found[..., 1:] / noise[:, None])[:, used].reshape(-1, len(shares))
    lengths = np.where(effects.any(axis=0), np.linalg.norm(jacobian, axis=0), 1.0)
    _, singular, right = np.linalg.svd(jacobian / lengths, full_matrices=False)
    _check_determined(problem, effects.any(axis=0), singular, right)
    freedom = len(jacobian) - len(shares)
    variance = float(np.sum((difference / noise)[:, used] ** 2)) / freedom
    covariance = (right.T / singular**2) @ right  # of the parameters times `lengths`, for unit variance
    deviation = np.sqrt(np.diag(covariance))
    widths = np.array([float(item.high - item.low) for item in problem.free])
    errors = np.sqrt(variance) * deviation / lengths * widths
    quantile = float(student.ppf((1 + CONFIDENCE) / 2, freedom))
    numbers = zip(problem.free, problem.values(shares).tolist(), errors.tolist(), shares, strict=True)
    return ParameterFit(
        topology=problem.topology,
        recording=problem.file,
        parameters=tuple(
            Estimate(
                name=item.free.label,
                value=value,
                unit=item.unit,
                standard_error=error,
                interval=(value - quantile * error, value + quantile * error),
                low=float(item.low),
                high=float(item.high),
                at_end=not AT_END < share < 1 - AT_END,
            )
            for item, value, error, share in numbers
        ),
        correlation=tuple(map(tuple, (covariance / np.outer(deviation, deviation)).tolist())),
        residuals=tuple(
            SignalResiduals(
                signal.name,
                signal.unit,
                float(rms[j]),
                min(LAGS, len(difference) // 5),
                _ljung_box(difference[:, j]) if rms[j] > EXACT * problem.scale[j] else float("nan"),
                bool(used[j]),
            )
            for j, signal in enumerate(recorded.signals)
        ),
        rows=len(recorded.times),
        samples=len(problem.rows),
        duration=float(recorded.duration),
        start=recorded.start,
        forces=recorded.forces,
        evaluations=evaluations,
        time=problem.time,
        measured=problem.measured,
        fitted=found[..., 0],
    )


def _check_determined(problem: _Problem, has_effect: Flags, singular: Floats, right: Floats) -> None:
    """Raise ApcError E715 with the parameters that the recording does not determine.

    The Fisher information JᵀJ is singular where a singular value of J is 0: a parameter without effect, or a
    combination of parameters without effect.

    Parameters
    ----------
    problem, has_effect
        The problem, and whether each parameter has an effect on a signal (k,).
    singular, right
        The singular values of J, its columns of length 1, and the right singular vectors (k, k).
    """
    names = np.array([item.free.label for item in problem.free])
    message, advice = f"{', '.join(names[~has_effect])}: no effect on the measured signals", ""
    if has_effect.all():
        weights = np.abs(right[singular <= SINGULAR * singular[0]]).max(axis=0, initial=0.0)
        among = names[weights > NAMED * weights.max()]
        if not len(among):
            return
        message = f"{', '.join(among)}: only a combination of these has an effect on the measured signals"
        advice = f"fix one of them, without --free {among[-1]}, or record another signal"
    advice = advice or "omit its --free, or record a motion on which it acts"
    raise ApcError(Diagnostic("E715", SourceLocation(problem.file), message, advice=advice))


def _ljung_box(residuals: Floats) -> float:
    """Return the probability of a Ljung-Box test, NaN for too few residuals.

    Q = n (n + 2) Σ_h r_h² / (n − h) is distributed as χ² with as many degrees of freedom as lags, for white
    residuals with autocorrelations r_h (Ljung and Box, Biometrika 65, 1978, 297).
    """
    from scipy.stats import chi2

    n, centered = len(residuals), residuals - residuals.mean()
    h = np.arange(1, min(LAGS, n // 5) + 1)
    r = np.array([centered[lag:] @ centered[:-lag] for lag in h]) / (centered @ centered)
    return float(chi2.sf(n * (n + 2) * np.sum(r**2 / (n - h)), len(h)))
