"""The public functions: plain, with frozen results.

Takes: paths, compiled models, settings.
Gives: compiled models and analyses; `show`, `schema`.
Guarantees: what a command does, the function of its name does.
Does not: print.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from apc.arguments import checked
from apc.compiler import store
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

if TYPE_CHECKING:
    from apc.analysis.analysis import Analysis
    from apc.analysis.arbitrary_switching import ArbitrarySwitching
    from apc.analysis.contact_modes import ContactModes
    from apc.analysis.event_order import EventOrder
    from apc.analysis.methods import Method
    from apc.analysis.paper_method import PaperMethod
    from apc.analysis.robust_stability import RobustStability
    from apc.benchmark.speed_and_error import Bench
    from apc.comparison.comparison import SchemeComparison
    from apc.frame.parameter_listing import Parameters
    from apc.haptics.absolute_stability import AbsoluteStability
    from apc.haptics.frequency_response import Transparency
    from apc.mean_square.mean_square_stability import MeanSquareStability
    from apc.network.link_fit import LinkFit
    from apc.parameter_studies.batch_analysis import Analyses
    from apc.parameter_studies.critical_values import Critical
    from apc.parameter_studies.margins import Margins
    from apc.parameter_studies.sensitivity import Sensitivities
    from apc.regions.stable_region import Region
    from apc.reports.contents import Report
    from apc.result import Result
    from apc.simulation.limit_cycle import LimitCycle
    from apc.simulation.trajectory import Trajectory
    from apc.sweeps.resumable_sweep import Sweep
    from apc.tuning.pareto_front import ParetoFront
    from apc.tuning.specification import TuningSpec
    from apc.tuning.tuner import Tuning

TopologySource = Model | str | Path
Values = Mapping[str, str | float]  # by the name of a parameter, quantities or numbers in SI
Format = Literal["text", "json", "dot", "mermaid", "svg"]
Criterion = Literal["mean-square", "nominal", "passive"]


@checked
def compile(path: str | Path) -> Model:
    """Compile a topology file.

    Parameters
    ----------
    path
        The topology, a YAML file.

    Returns
    -------
    Model
        The compiled model; nothing is written (see `save`).

    Raises
    ------
    ApcError
        The file is invalid; holds every mistake found.
    """
    from apc.compiler.pipeline import compile_topology
    from apc.frame.start_checks import check_values

    system = compile_topology(Path(path))
    check_values(system)
    return system


@checked
def save(model: Model, path: str | Path) -> None:
    """Write a compiled model to a .apc file, whole or not at all. Raises ApcError if it can't be written."""
    store.save(model, Path(path))


@checked
def load(path: str | Path) -> Model:
    """Read a compiled model from a .apc file. Raises ApcError if it is damaged or older than its topology."""
    from apc.inputs import load_fresh

    return load_fresh(Path(path))


@checked
def with_hands(model: TopologySource, hands: str) -> Model:
    """Return the model with hands at all devices.

    Parameters
    ----------
    model
        As for `analyze`.
    hands
        "clamped": they are held fast; "held": a hand of `hand.mass`, `hand.damping` and `hand.stiffness`
        each, 0 until set; or a hand of the library, such as "StylusArmForward".

    Raises
    ------
    ApcError
        No such hands, a peer without a device, or with a hand already. E930 "passive", which are all
        hands there are: `absolute_stability`, `critical` and `region` judge them.
    """
    from apc.frame import devices

    changed = devices.with_hands(_model(model, None), hands)
    if hands == devices.PASSIVE:
        message = "passive hands are all that draw no energy, and a model has one hand a device"
        raise ApcError(
            Diagnostic("E930", SourceLocation("with_hands"), message, hint="apc.absolute_stability(model)")
        )
    return changed


@checked
def set_parameters(model: Model, values: Mapping[str, str | float]) -> Model:
    """Return the model with other parameter values, without compiling again.

    Parameters
    ----------
    model
        The compiled model; it is not changed.
    values
        Quantities by name, or numbers in SI: `{"contact.stiffness": "800 N/m", "lan.delay": 0.016}`.

    Raises
    ------
    ApcError
        A name is unknown, a unit is wrong, or a value lies outside its bounds.
    """
    from apc.frame.overrides import apply, parse_override

    overrides = [
        parse_override(model, f"{name}={_quantity(model, name, value)}") for name, value in values.items()
    ]
    return apply(model, overrides)


def _quantity(system: Model, name: str, value: str | float) -> str:
    """Return a parameter value as text; a number without a unit is in SI."""
    if isinstance(value, str):
        return value
    from apc.frame.parameter_names import find, unit_of

    if not isinstance(value, Real) or isinstance(value, bool):
        raise ApcError(
            Diagnostic("E204", SourceLocation(name), name, "a quantity or a number in SI", repr(value)[:80])
        )
    number = int(value) if isinstance(value, Integral) else float(value)
    return f"{number!r} {unit_of(system, find(system, name, counts=True).name)}".rstrip()


def _range(system: Model, name: str, value: str | Sequence[str | float]) -> str:
    """Return a parameter range as text, from a text or its two ends."""
    return value if isinstance(value, str) else ":".join(_quantity(system, name, end) for end in value)


@checked
def analyze(
    model: TopologySource,
    *,
    params: Values | None = None,
    method: Method = "auto",
    certify: bool = False,
) -> Analysis:
    """Analyze the stability of a model: verdict, spectral radius, and modes.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    params
        Parameter values to change first, as in `set_parameters`.
    method
        "auto": the method suited to the model; "modes": a few systems of one peer's size, at a cost that
        does not grow with the number of equal peers; "dense": every peer in one system, the check on the
        others; "determinant": the zeros of a small determinant, for peers that all differ and for long
        delays; "paper": the lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20).
    certify
        Prove the verdict in ball arithmetic.

    Returns
    -------
    Analysis
        Verdict, spectral radius per frame with its error bound, and the modes.

    Raises
    ------
    ApcError
        The input is invalid, or the method does not support the model.
    """
    from apc.analysis_report import analysis_report

    return analysis_report(_model(model, params), method=method, certify=certify)


@checked
def analyze_many(
    model: TopologySource,
    values: Mapping[str, Any],
    *,
    params: Values | None = None,
) -> Analyses:
    """Analyze a model at many parameter values at once, a hundred times as fast as one by one.

    Parameters
    ----------
    model, params
        As for `analyze`.
    values
        By parameter an array of its values, numbers in SI or quantities: {"contact.stiffness": [500, 1000],
        "lan.delay": ["8 ms", "16 ms"]}. Arrays are broadcast against one another.

    Returns
    -------
    Analyses
        Arrays of that shape: `.verdict`, `.stable`, `.spectral_radius` with its bound
        `.spectral_radius_error`, `.frequency_hz` and `.damping_ratio` of the dominant mode;
        `.to_dataframe()`.

    Raises
    ------
    ApcError
        The input is invalid; the error of a single point is in its `.message`.
    """
    from apc.parameter_studies import batch_analysis

    return batch_analysis.analyze_many(_model(model, params), values)


@checked
def critical(
    model: TopologySource,
    parameter: str,
    *,
    params: Values | None = None,
    lower: str | float | None = None,
    upper: str | float | None = None,
    criterion: Criterion | None = None,
) -> Critical:
    """Find the values of a parameter or delay at which a model becomes stable or unstable.

    Parameters
    ----------
    model, params
        As for `analyze`.
    parameter
        Its name, such as "coordination.stiffness" or "lan.delay".
    lower, upper
        The ends of the search range, such as "5000 N/m", or numbers in SI.
    criterion
        "mean-square": second moments decay over the lossy network, the default if a link loses or delays
        packets; "nominal": motions decay if every packet is on time; "passive": they decay with every passive
        hand at every device.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.parameter_studies import critical_values

    system = _model(model, params)
    low, high = (None if item is None else _quantity(system, parameter, item) for item in (lower, upper))
    return critical_values.critical(system, parameter, lower=low, upper=high, criterion=criterion)


@checked
def compare(
    models: TopologySource | Sequence[TopologySource],
    *,
    params: Values | None = None,
    over: Sequence[str] = (),
    criterion: Criterion | None = None,
    at: str = "",
) -> SchemeComparison:
    """Compare schemes: verdicts, largest stable stiffness, delay and loss, transparency, cost.

    Parameters
    ----------
    models
        Models as for `analyze`, usually several.
    params
        As for `analyze`, of all of them.
    over
        The varied stiffness, delay and loss, if a model has several; each uses those it has.
    criterion
        As for `critical`.
    at
        The device of the transparency analysis, as for `transparency`.

    Returns
    -------
    SchemeComparison
        Its `.schemes`, each with the results of `analyze`, `critical` and `transparency` of the model;
        `.to_dataframe()`, `.plot()`.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.comparison import comparison

    topologies = _several(models, "compare")
    return comparison.compare(
        [_model(topology, params) for topology in topologies], over=over, criterion=criterion, at=at
    )


@checked
def absolute_stability(model: TopologySource, *, params: Values | None = None) -> AbsoluteStability:
    """Decide stability with every passive hand at every device, and the damping required for it.

    Parameters
    ----------
    model, params
        As for `analyze`.

    Raises
    ------
    ApcError
        A peer has no device, or a hand already; a device is coupled other than by samples and holds.
    """
    from apc.haptics import absolute_stability

    return absolute_stability.absolute_stability(_model(model, params))


@checked
def transparency(
    model: TopologySource,
    frequencies: Sequence[float] | float,
    *,
    params: Values | None = None,
    at: str = "",
    between: str = "",
    unstable: bool = False,
) -> Transparency:
    """Compute the impedance at a device and the transmission of a force to another device.

    Parameters
    ----------
    model, params
        As for `analyze`.
    frequencies
        (k,), in Hz, at most half the rate of the fastest clock.
    at, between
        The driven device, such as "left[1].device", and another; by default the first peer's and the next
        one's.
    unstable
        Whether to return the response of the frame map for an unstable model, which has no steady state.

    Returns
    -------
    Transparency
        Impedance, transmitted admittance and error between copies, complex (k,), in SI, with a bound; mass,
        low-frequency damping and stiffness; H∞ norms; H2 norms, an rms at the ticks: motion between ticks is
        not included.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.haptics import frequency_response

    listed = [frequencies] if isinstance(frequencies, int | float) else frequencies
    return frequency_response.transparency(
        _model(model, params), listed, at=at, between=between, unstable=unstable
    )


@checked
def fit_link(recording: str | Path, *, interval: str | None = None) -> LinkFit:
    """Compute the statistics of a recorded network as keys of a link.

    Parameters
    ----------
    recording
        A file that ping or `irtt client -o` wrote, or a CSV table with a column `delay [ms]`.
    interval
        A time such as "8 ms" between two packets, if the file does not contain it.

    Returns
    -------
    LinkFit
        The share lost with its interval, bursts, delays, the nearest jitter distribution; the printed form is
        the link's entry.

    Raises
    ------
    ApcError
        The file is none of these.
    """
    from apc.network import link_fit
    from apc.option_value import option_value

    between = None if interval is None else option_value("interval=", interval, subject="a time", unit="s")
    return link_fit.fit_recording(recording, None if between is None else float(between))


@checked
def mean_square_stability(
    model: TopologySource, *, params: Values | None = None, certify: bool = False
) -> MeanSquareStability | None:
    """Analyze mean-square stability over the network, with lost and late packets.

    Parameters
    ----------
    model, params, certify
        As for `analyze`.

    Returns
    -------
    MeanSquareStability or None
        Verdict in mean square and the growth of second moments per frame with its error; None if every packet
        takes its nominal delay.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.mean_square import mean_square_stability

    return mean_square_stability.mean_square_stability(_model(model, params), certify=certify)


@checked
def margins(model: TopologySource, *, params: Values | None = None) -> Margins:
    """Compute the stability margin of each coupler's stiffness and damping and of each delay, one at a time.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.parameter_studies import margins as growth

    return growth.margins(_model(model, params))


@checked
def sensitivities(model: TopologySource, *, params: Values | None = None) -> Sensitivities:
    """Differentiate the spectral radius with respect to every parameter.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.parameter_studies import sensitivity

    return sensitivity.sensitivities(_model(model, params))


@checked
def event_order(model: TopologySource, *, params: Values | None = None) -> EventOrder:
    """Repeat the analysis under every order of coincident events and both readings of the start.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.analysis import event_order as orders

    return orders.event_order(_model(model, params))


@checked
def contact_modes(model: TopologySource, *, params: Values | None = None) -> ContactModes:
    """Analyse a model whose couplers push and never pull in each of their modes.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.analysis import contact_modes as switched

    return switched.contact_modes(_model(model, params))


@checked
def arbitrary_switching(model: TopologySource, *, params: Values | None = None) -> ArbitrarySwitching:
    """Prove stability under arbitrary switching of contacts, or under their state-dependent switching.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.analysis import arbitrary_switching as at_will
    from apc.analysis import contact_modes as switched

    system = _model(model, params)
    return at_will.arbitrary_switching(system, switched.contact_modes(system))


@checked
def limit_cycle(model: TopologySource, *, params: Values | None = None) -> LimitCycle:
    """Predict the limit cycle of a model's one-sided contacts, and simulate it.

    Parameters
    ----------
    model, params
        As for `analyze`.

    Raises
    ------
    ApcError
        E864 no contact that pushes from tick to tick and never pulls.
    """
    from apc.simulation import limit_cycle as cycles

    return cycles.limit_cycle(_model(model, params))


@checked
def robust_stability(
    model: TopologySource,
    box: Mapping[str, str | Sequence[str | float]],
    *,
    cells: int | None = None,
    params: Values | None = None,
) -> RobustStability:
    """Prove stability for all values of some parameters within their ranges.

    Parameters
    ----------
    model, params
        As for `analyze`.
    box
        Ranges by parameter, such as {"contact.stiffness": "±1%"}, "900 N/m:1100 N/m" or, in SI, (900, 1100).
    cells
        The largest number of cells; by default as many as take some seconds.
    """
    from apc.analysis.parametric_frames import parse_range
    from apc.analysis_report import robust_stability

    system = _model(model, params)
    ranges = [parse_range(system, f"{name}={_range(system, name, value)}") for name, value in box.items()]
    return robust_stability(system, ranges, cells=cells)


@checked
def parameters(model: TopologySource) -> Parameters:
    """List the settable parameters of a model: names, values, units and limits.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    """
    from apc.frame import parameter_listing

    return parameter_listing.parameters(_model(model, None))


@checked
def paper_method(model: TopologySource, *, params: Values | None = None) -> PaperMethod:
    """Return the lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20), rows and columns named.

    Parameters
    ----------
    model, params
        As for `analyze`.

    Raises
    ------
    ApcError
        E861 the model has not the form these matrices need.
    """
    from apc.analysis import paper_method

    return paper_method.paper_method(_model(model, params))


@checked
def region(
    model: TopologySource,
    *,
    x: str | tuple[str, str | float, str | float] | None = None,
    y: str | tuple[str, str | float, str | float] | None = None,
    criterion: Criterion | None = None,
    params: Values | None = None,
) -> Region:
    """Find the boundary of the stable region of two parameters, as curves with their errors.

    Parameters
    ----------
    model, params
        As for `analyze`.
    x, y
        A parameter and its range, such as "contact.stiffness=10 N/m:3000 N/m" or, in SI,
        ("contact.stiffness", 10, 3000); those of the model's `studies: region:` if not given.
    criterion
        As for `critical`.

    Returns
    -------
    Region
        Its curves, `.stable_area`, `.contains(x, y)` in SI, `.to_dataframe()`, `.plot()`.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.regions import stable_region
    from apc.regions.axes import parse_axes

    system = _model(model, params)
    first, second = (
        axis if axis is None or isinstance(axis, str) else f"{axis[0]}={_range(system, axis[0], axis[1:])}"
        for axis in (x, y)
    )
    return stable_region.region(system, parse_axes(system, first, second), criterion=criterion)


@checked
def tune(
    model: TopologySource,
    free: Mapping[str, str | Sequence[str | float]] | None = None,
    *,
    maximize: str = "",
    minimize: str = "",
    constraint: Sequence[str] = (),
    over: Mapping[str, str | Sequence[str | float]] | None = None,
    criterion: Criterion | None = None,
    seconds: float | None = None,
    params: Values | None = None,
) -> Tuning:
    """Find the optimal gains under a specification, and prove that they satisfy it.

    Parameters
    ----------
    model, params
        As for `analyze`.
    free
        Ranges of the gains by name: {"coordination.stiffness": "10 N/m:5000 N/m"} or, in SI, (10, 5000).
    maximize, minimize
        One of the two: a gain, a transparency metric ("coordination_error at 1 Hz", "damping",
        "coordination_error_h2", "coordination_error_hinf"), or a weighted sum of these in SI;
        "spectral_radius" and "settling_time" are for `minimize` only.
    constraint
        Demands in addition to stability, such as "decay=60 dB in 2 s".
    over
        The ranges of the scenarios: {"user.count": "2:10", "device.mass": "±20%", "lan.delay": "8 ms:20 ms"}.
    criterion
        As for `critical`; over unreliable links the default is mean-square. Omitted arguments are those of
        the topology's `studies: tune:`.
    seconds
        The time limit.

    Returns
    -------
    Tuning
        Its `.gains`, whether they are `.proved`, and the active constraints.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.tuning import tuner

    system, tuning_spec = _tuning_spec(model, params, free, over, criterion, maximize, minimize, constraint)
    return tuner.tune(system, tuning_spec, seconds=float("inf") if seconds is None else seconds)


@checked
def pareto_front(
    model: TopologySource,
    free: Mapping[str, str | Sequence[str | float]],
    tradeoff: str,
    *,
    maximize: str = "",
    minimize: str = "",
    constraint: Sequence[str] = (),
    over: Mapping[str, str | Sequence[str | float]] | None = None,
    criterion: Criterion | None = None,
    points: int = 20,
    seconds: float | None = None,
    params: Values | None = None,
) -> ParetoFront:
    """Compute the Pareto front of an objective and a transparency metric.

    Parameters
    ----------
    model, free, maximize, minimize, constraint, over, criterion, params
        As for `tune`.
    tradeoff
        The transparency metric: "impedance at 5 Hz", or transmitted, error, damping, error_h2,
        error_hinf.
    points
        The number of bounds, from the smallest metric to that at the best objective.
    seconds
        The time limit for all of them.

    Returns
    -------
    ParetoFront
        Its `.designs`; `.plot()` draws it.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.tuning.pareto_front import pareto_front as pareto
    from apc.tuning.specification import read_tradeoff

    system, tuning_spec = _tuning_spec(model, params, free, over, criterion, maximize, minimize, constraint)
    until = float("inf") if seconds is None else seconds
    return pareto(system, tuning_spec, read_tradeoff(tradeoff), points=points, seconds=until)


def _tuning_spec(
    model: TopologySource,
    values: Values | None,
    free: Mapping[str, Any] | None,
    over: Mapping[str, Any] | None,
    criterion: Criterion | None,
    maximize: str,
    minimize: str,
    constraint: Sequence[str],
) -> tuple[Model, TuningSpec]:
    """Return a model with hands as in its study or the criterion, and the tuning specification."""
    from apc.tuning.specification import gripped_as_studied, read_tuning_spec

    means: str | None = criterion
    system = _model(model, values)
    if criterion is None:
        system, means = gripped_as_studied(system)
    ranges, required = (
        [f"{name}={_range(system, name, value)}" for name, value in (requested or {}).items()]
        for requested in (free, over)
    )
    tuning_spec = read_tuning_spec(
        system,
        ranges,
        maximize=maximize,
        minimize=minimize,
        constraint=constraint,
        over=required,
        criterion=means,
    )
    return system, tuning_spec


@checked
def sweep(
    model: TopologySource,
    over: Mapping[str, str | Sequence[str | float]],
    *,
    of: str = "analyze",
    criterion: Criterion | None = None,
    out: str | Path | None = None,
    jobs: int | None = None,
    cluster: str | None = None,
    params: Values | None = None,
) -> Sweep:
    """Compute a result at every combination of some parameters' values.

    Parameters
    ----------
    model, params
        As for `analyze`.
    over
        Values by parameter: "500 N/m:1500 N/m:11" (lower end, upper end, number of values), or a list of
        quantities or of numbers in SI.
    of
        "analyze", or "critical:PARAMETER".
    criterion
        As for `critical`.
    out
        A .parquet or .csv file; finished parts are stored next to it, and the same call resumes after them.
    jobs
        Processes; the number of cores if not given.
    cluster
        The address of a Dask scheduler.
    """
    from apc.sweeps import resumable_sweep

    path = None if out is None else Path(out)
    system = _model(model, params)
    _check_out(model, system, path)
    values = {
        name: text if isinstance(text, str) else [_quantity(system, name, value) for value in text]
        for name, text in over.items()
    }
    return resumable_sweep.sweep(
        system, values, of=of, criterion=criterion, out=path, jobs=jobs, cluster=cluster
    )


def _several(topologies: TopologySource | Iterable[TopologySource], function: str) -> list[TopologySource]:
    """Return the models that a function is given, of which one needs no list; refuse none."""
    if isinstance(topologies, Model | str | Path):
        return [topologies]
    if listed := list(topologies):
        return listed
    hint = f'apc.{function}(["average.yaml", "mesh.yaml"])'
    raise ApcError(Diagnostic("E610", SourceLocation(function), "no topology is given", hint=hint))


def _path(topology: TopologySource, function: str) -> Path:
    """Return the path of a topology; refuse a compiled model, next to which it is expected."""
    from apc.inputs import refuse_model

    path = (
        Path(topology.origin.topology).with_suffix(".apc") if isinstance(topology, Model) else Path(topology)
    )
    refuse_model(path, function)
    return path


def _model(model: TopologySource, params: Values | None) -> Model:
    """Return a compiled model, with the parameters set."""
    if not isinstance(model, Model):
        from apc.inputs import load_or_compile

        model = load_or_compile(Path(model))
    return set_parameters(model, params) if params else model


def _check_out(model: TopologySource, system: Model, path: Path | None) -> None:
    """Refuse to overwrite the input of the model."""
    if path is not None and not isinstance(model, Model):
        from apc.inputs import check_outputs

        check_outputs(Path(model), (name for name, _ in system.origin.texts), {"out=": path})


@checked
def simulate(
    model: TopologySource,
    *,
    duration: str | float | None = None,
    params: Values | None = None,
    signals: Sequence[str] = (),
    jit: bool = True,
    seed: int | None = None,
    method: str | None = None,
    impulse: str | None = None,
    trace_of: Literal["worst"] | None = None,
    error: bool = False,
) -> Trajectory:
    """Simulate a model in time.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    duration
        The duration, such as "2 s" or 2; by default that of the model's experiment.
    params
        Parameter values to change first, as in `set_parameters`.
    signals
        Patterns of the signals to keep, such as "cube.x" or "left[2].*"; all if there is none.
    jit
        Whether to compile to machine code where there is a C compiler.
    seed
        Of the packets that get lost or come late; that of the model's experiment if not given.
    method
        "exact", "rk4:STEP", "semi-implicit:STEP" or "cvodes:RTOL", such as "rk4:0.1 ms"; exact where linear
        and by CVODES elsewhere if not given.
    impulse
        A peer that is struck as the model begins, such as "user[1]": its device starts at 0.1 m/s.
    trace_of
        "worst": lose packets by the periodic pattern that `analyze` finds to shake the model.
    error
        Whether to estimate the error, by a second run.

    Returns
    -------
    Trajectory
        A row for every tick of the fastest clock with the values before the tick, and a summary.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.simulation import trajectory
    from apc.simulation.settings import DEFAULT, parse_method

    system = _model(model, params)
    if impulse is not None:
        from apc.simulation import initial_velocity as push

        system, _ = push.initial_velocity(system, impulse)
        if duration is None and system.experiment.duration is None:
            duration = float(push.WATCHED)
    if trace_of is not None:
        from apc.mean_square.dropout_bounds import worst_trace

        system = worst_trace(system)
    length = duration if duration is None or isinstance(duration, str) else f"{float(duration)!r} s"
    return trajectory.simulate(
        system,
        duration=trajectory.parse_duration(length) if length is not None else None,
        signals=signals,
        jit=jit,
        seed=seed,
        method=parse_method(method) if method is not None else DEFAULT,
        error=error,
    )


@checked
def bench(
    model: TopologySource,
    *,
    params: Values | None = None,
    rounds: int | None = None,
) -> Bench:
    """Measure every method of analysis and of simulation on a model: time against true error.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology file.
    params
        Parameters to change first, as `{"contact.stiffness": "800 N/m"}`.
    rounds
        Runs of each method, fewer of slow ones; 15 if not given.

    Raises
    ------
    ApcError
        The model can't be analysed at all.
    """
    from apc.benchmark import speed_and_error

    return speed_and_error.bench(
        _model(model, params), rounds=speed_and_error.ROUNDS if rounds is None else rounds
    )


@checked
def export(
    model: TopologySource,
    to: str | None = None,
    out: str | Path | None = None,
    *,
    params: Values | None = None,
    open_at: str = "",
    symbolic: Sequence[str] = (),
    peer: str = "",
    device: str = "",
    method: str = "",
) -> Result:
    """Export a model to other tools.

    Parameters
    ----------
    model, params
        As for `analyze`.
    to
        "control", "mat" or "npz": a state space; "modelica": a model; "c": one peer in C99; "fmu": a model or
        a peer for co-simulation. The default follows from the suffix of `out`.
    out
        The file to write; nothing is written if not given.
    open_at
        The link or coupler to cut the loop open at.
    symbolic
        Parameters that stay free: `.function` is a `casadi.Function` of them that returns A, B, C and D.
    peer
        For "c" and "fmu": the peer, such as "left[1]". By default an FMU includes all peers.
    device
        For "c": the masses outside the peer's computer, "none" if none; by default those that are hand-held
        or not sent to others.
    method
        For "c" and "fmu": the integration method between ticks, as for `simulate`, such as "rk4:0.1 ms" for
        nonlinear equations.

    Returns
    -------
    Result
        The export: for a state space its matrices with the names and units of states, inputs and outputs, and
        `.to_control()`; for a Modelica model its `.text`.

    Raises
    ------
    ApcError
        The input is invalid, or the format does not support the model.
    """
    from apc.exports import formats

    path = None if out is None else Path(out)
    chosen = formats.format_of(to, path, option="=")
    system = _model(model, params)
    _check_out(model, system, path)
    requested = formats.ExportRequest(open_at, tuple(symbolic), peer, device, method)
    return formats.export(system, chosen, requested, path)


@checked
def report(
    files: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    params: Values | None = None,
) -> Report:
    """Create a report on topologies: all analyses on one page.

    Parameters
    ----------
    files
        Topologies, YAML files; several are compared.
    out
        The page to write, `.html` or `.pdf`; nothing is written if not given.
    params
        As for `analyze`, of all of them.

    Returns
    -------
    Report
        Its `.topologies`, each with sections of tables, which are those of the other functions.

    Raises
    ------
    ApcError
        The input is invalid, or the page cannot be written.
    """
    from apc.inputs import check_topology_outputs
    from apc.output.report_output import check_report_path, save_report
    from apc.reports import contents

    paths = [_path(topology, "report") for topology in _several(files, "report")]
    for path in paths:
        if out is not None:
            check_topology_outputs(path, {"out=": Path(out)})
    if out is not None:
        check_report_path(Path(out))
    result = contents.report(paths, [f"{name}={value}" for name, value in (params or {}).items()])
    if out is not None:
        save_report(result, Path(out))
    return result


@checked
def show(path: str | Path, *, format: Format = "text") -> str:
    """Return a description of a topology: its graph, its equations, and the events of one frame.

    Parameters
    ----------
    path
        The topology, a YAML file.
    format
        "text"; "json", the same as one document; "dot" and "mermaid", the graph in the languages of Graphviz
        and Mermaid; "svg", the graph as a picture.

    Raises
    ------
    ApcError
        The file is invalid, or is a compiled model instead of a topology.
    """
    from apc.compiler.view import diagram, listing
    from apc.output.formatting import json_text

    path = _path(path, "show")
    match format:
        case "text":
            return listing.show_text(path)
        case "json":
            return json_text(listing.show_document(path))
        case "dot":
            return diagram.draw_dot(listing.diagram_of(path))
        case "mermaid":
            return diagram.draw_mermaid(listing.diagram_of(path))
        case "svg":
            from apc.output.graph import graph_picture
            from apc.output.pictures import svg_text

            return svg_text(graph_picture(listing.diagram_of(path)))


@checked
def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of topologies, generated from the language and the library."""
    from apc.compiler.components.component_library import Library
    from apc.compiler.view.schema import topology_schema

    return topology_schema(Library())
