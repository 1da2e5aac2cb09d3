"""The public functions, one for each command, with frozen results.

Takes: paths, compiled models, settings.
Gives: compiled models and analyses; `show`, `schema`.
Guarantees: a function has the same result as the command with its name.
Does not: print.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from numbers import Rational, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from apc.compiler import store
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.support.arguments import checked
from apc.support.extension_table import require_extension

if TYPE_CHECKING:
    from apc.analysis.analysis import Analysis
    from apc.analysis.box_result import RobustStability
    from apc.analysis.contact_modes import ContactModes
    from apc.analysis.methods import Method
    from apc.benchmark.speed_and_error import Bench
    from apc.extensions.changing_counts.joins_and_leaves import ChangingCounts
    from apc.extensions.event_order.coincident_events import EventOrder
    from apc.extensions.paper_method.lifted_matrices import PaperMethod
    from apc.extensions.parameter_fit.parameter_estimation import ParameterFit
    from apc.extensions.pareto_front.trade_off import ParetoFront
    from apc.extensions.switching.arbitrary_switching import ArbitrarySwitching
    from apc.extensions.switching.limit_cycle import LimitCycle
    from apc.haptics.absolute_stability import AbsoluteStability
    from apc.haptics.frequency_response import Transparency
    from apc.lifting.numeric_model import NumericModel
    from apc.lifting.rest_position import OperatingPoint
    from apc.mean_square.mean_square_stability import MeanSquareStability
    from apc.network.link_fit import LinkFit
    from apc.parameter_values.parameter_listing import Parameters
    from apc.regions.stable_region import Region
    from apc.reports.contents import Report
    from apc.result import Result
    from apc.simulation.trajectory import Trajectory
    from apc.studies.batch_analysis import Analyses
    from apc.studies.comparison import SchemeComparison
    from apc.studies.critical_values import Critical
    from apc.studies.margins import Margins
    from apc.studies.resumable_sweep import Sweep
    from apc.studies.sensitivity import Sensitivities
    from apc.tuning.specification import TuningSpec
    from apc.tuning.tuner import Tuning

TopologySource = Model | str | Path
Values = Mapping[str, str | float]  # by the name of a parameter, quantities or numbers in SI
Format = Literal["text", "json", "dot", "mermaid", "svg"]
Criterion = Literal["mean-square", "nominal", "passive"]
Point = Literal["start", "equilibrium"]


@checked
def compile(path: str | Path) -> Model:
    """Return the compiled model of a topology file.

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
        The file is invalid; the error contains all mistakes.
    """
    from apc.compiler.pipeline import compile_topology
    from apc.lifting.start_checks import check_values

    model = compile_topology(Path(path))
    check_values(model)
    return model


@checked
def save(model: Model, path: str | Path) -> None:
    """Write a compiled model to a .apc file, completely or not at all.

    Raises ApcError if it can't be written.
    """
    store.save(model, Path(path))


@checked
def load(path: str | Path) -> Model:
    """Return the compiled model in a .apc file.

    Raises ApcError if the file is damaged, or if its topology has changed.
    """
    from apc.inputs.open_model import load_fresh

    return load_fresh(Path(path))


@checked
def with_hands(model: TopologySource, hands: str) -> Model:
    """Return the model with a hand at every device.

    Parameters
    ----------
    model
        As for `analyze`.
    hands
        "clamped": the devices are fixed; "held": a hand with `hand.mass`, `hand.damping` and `hand.stiffness`
        at each device, 0 by default; or a hand of the library, such as "StylusArmForward".

    Raises
    ------
    ApcError
        Unknown hands, a peer without a device, or a peer that already has a hand. E930 "passive", which
        represents all passive hands: see `absolute_stability`, `critical` and `region`.
    """
    from apc.lifting import devices

    changed = devices.with_hands(_model(model, None), hands)
    if hands == devices.PASSIVE:
        message = "passive hands are a set of operators, not a model of one hand"
        raise ApcError(
            Diagnostic("E930", SourceLocation("with_hands"), message, fix="apc.absolute_stability(model)")
        )
    return changed


@checked
def set_parameters(model: Model, values: Mapping[str, str | float]) -> Model:
    """Return the model with other parameter values, without recompilation.

    Parameters
    ----------
    model
        The compiled model, which remains unchanged.
    values
        Quantities or numbers in SI units, by name: `{"contact.stiffness": "800 N/m", "lan.delay": 0.016}`.

    Raises
    ------
    ApcError
        A name is unknown, a unit is wrong, or a value is outside its bounds.
    """
    from apc.parameter_values.overrides import Override, apply, parse_override
    from apc.parameter_values.parameter_names import OVERRIDE, find

    overrides = [
        parse_override(model, f"{name}={value}")
        if isinstance(value, str)
        else Override(find(model, name, OVERRIDE, counts=True), _si_number(name, value))
        for name, value in values.items()
    ]
    return apply(model, overrides)


def _si_number(name: str, value: float) -> Fraction:
    """Return a number in SI exactly; a float is the shortest decimal that rounds to it."""
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        raise ApcError(
            Diagnostic("E204", SourceLocation(name), name, "a quantity or an SI number", repr(value)[:80])
        )
    return Fraction(value) if isinstance(value, Rational) else Fraction(repr(float(value)))


def _values(name: str, given: str | Sequence[str | float]) -> str | list[str | Fraction]:
    """Return values of a parameter, or the ends of its range: text, or texts and exact numbers in SI."""
    if isinstance(given, str):
        return given
    return [item if isinstance(item, str) else _si_number(name, item) for item in given]


@checked
def analyze(
    model: TopologySource,
    *,
    params: Values | None = None,
    method: Method = "auto",
    certify: bool = False,
    operating_point: Point = "start",
) -> Analysis:
    """Return the stability analysis of a model: verdict, spectral radius, and modes.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    params
        Parameter values to change first, as in `set_parameters`.
    method
        "auto": selected by the model; "modes": a few systems of the size of one peer, at a cost
        independent of the number of equal peers; "dense": all peers in one system, as a check of the
        other methods; "determinant": the zeros of a small determinant, for peers that all differ and for long
        delays; "paper": the lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20).
    certify
        Whether to prove the verdict in ball arithmetic.
    operating_point
        The point of linearization of a nonlinear model: "start", its start values, or "equilibrium" (see
        `operating_point`), found again at every parameter value that is evaluated.

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

    return analysis_report(_numeric(model, params, operating_point), method=method, certify=certify)


@checked
def operating_point(
    model: TopologySource,
    *,
    params: Values | None = None,
    initial: Literal["start", "simulation"] = "start",
    duration: str | float | None = None,
) -> OperatingPoint:
    """Return the equilibrium of a model: the rest position under its constant forces, contacts included.

    Velocities are 0, forces are balanced, and every received value is the sender's value at rest. A direction
    without stiffness, such as a common translation, keeps its start value.

    Parameters
    ----------
    model, params
        As for `analyze`.
    initial
        The start of the search: "start", the start values of the topology, or "simulation", the end of a
        simulation.
    duration
        The duration of this simulation, as for `simulate`.

    Returns
    -------
    OperatingPoint
        `.positions`, each with name, value in SI and unit; `.active`, whether each contact or limit is on;
        the `.residual` force in N; `.model`, with the equilibrium as start values.

    Raises
    ------
    ApcError
        The input is invalid. E847 a constant force acts on a body that nothing holds; E848 no convergence;
        E849 a force depends on time.

    Notes
    -----
    The root is found by Newton's method with the exact Jacobian.

    Examples
    --------
    >>> rest = apc.operating_point("experiment-average.yaml")
    >>> [(position.name, position.text) for position in rest.positions][1]
    ('right.cube.x', '-3 mm')
    >>> dict(rest.active)["right.contact.push"]
    True
    >>> apc.analyze(rest.model).verdict
    'stable up to a common translation'
    """
    from apc.studies import operating_point as equilibrium

    return equilibrium.operating_point(_model(model, params), initial=initial, duration=_duration(duration))


@checked
def analyze_many(
    model: TopologySource,
    values: Mapping[str, Any],
    *,
    params: Values | None = None,
) -> Analyses:
    """Return the analyses of a model at many parameter values, about 100 times faster than single analyses.

    Parameters
    ----------
    model, params
        As for `analyze`.
    values
        Arrays of values by parameter, numbers in SI units or quantities: {"contact.stiffness": [500, 1000],
        "lan.delay": ["8 ms", "16 ms"]}. Arrays are broadcast against each other.

    Returns
    -------
    Analyses
        Arrays of the common shape: `.verdict`, `.stable`, `.spectral_radius` with its bound
        `.spectral_radius_error`, `.frequency_hz` and `.damping_ratio` of the dominant mode;
        `.to_dataframe()`.

    Raises
    ------
    ApcError
        The input is invalid; the error of a single point is in its `.message`.
    """
    from apc.studies import batch_analysis

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
    operating_point: Point = "start",
) -> Critical:
    """Return the values of a parameter or delay at which a model becomes stable or unstable.

    Parameters
    ----------
    model, params
        As for `analyze`.
    parameter
        The name of the parameter, such as "coordination.stiffness" or "lan.delay".
    lower, upper
        The ends of the search range, such as "5000 N/m", or numbers in SI units.
    criterion
        "mean-square": second moments decay over the lossy network, the default if a link loses or delays
        packets; "nominal": motions decay if every packet is on time; "passive": motions decay with every
        passive hand at every device.
    operating_point
        As for `analyze`.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.studies import critical_values

    compiled_model = _model(model, params, operating_point)
    low, high = (
        item if item is None or isinstance(item, str) else _si_number(parameter, item)
        for item in (lower, upper)
    )
    return critical_values.critical(compiled_model, parameter, lower=low, upper=high, criterion=criterion)


@checked
def compare(
    models: TopologySource | Sequence[TopologySource],
    *,
    params: Values | None = None,
    over: Sequence[str] = (),
    criterion: Criterion | None = None,
    at: str = "",
) -> SchemeComparison:
    """Return the comparison of schemes: verdicts, largest stable stiffness, delay and loss,
    transparency, cost.

    Parameters
    ----------
    models
        Models as for `analyze`, usually several.
    params
        As for `analyze`, for all models.
    over
        The varied stiffness, delay and loss, if a model has several; each model uses its own of these.
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
    from apc.studies import comparison

    topologies = _several(models, "compare")
    return comparison.compare(
        [_model(topology, params) for topology in topologies], over=over, criterion=criterion, at=at
    )


@checked
def absolute_stability(model: TopologySource, *, params: Values | None = None) -> AbsoluteStability:
    """Return the verdict for every passive hand at every device, and the damping required for stability.

    Parameters
    ----------
    model, params
        As for `analyze`.

    Raises
    ------
    ApcError
        A peer has no device, or already a hand; a device is not coupled only by samples and holds.
    """
    from apc.haptics import absolute_stability

    return absolute_stability.absolute_stability(_numeric(model, params))


@checked
def transparency(
    model: TopologySource,
    frequencies: Sequence[float] | float,
    *,
    params: Values | None = None,
    at: str = "",
    between: str = "",
    unstable: bool = False,
    operating_point: Point = "start",
) -> Transparency:
    """Return the impedance at a device, and the transmission of a force to another device.

    Parameters
    ----------
    model, params
        As for `analyze`.
    frequencies
        The frequencies (k,) in Hz, at most half the rate of the fastest clock.
    at, between
        The driven device, such as "left[1].device", and a second device; by default the devices of the first
        two peers.
    unstable
        Whether to return the response of the frame map for an unstable model, which has no steady state.
    operating_point
        As for `analyze`.

    Returns
    -------
    Transparency
        Impedance, transmitted admittance and error between copies, complex (k,), in SI units, with error
        bounds; mass, low-frequency damping and stiffness; H∞ norms; H2 norms, which are rms values at the
        ticks: motion between ticks is not included.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.haptics import frequency_response

    frequency_list = [frequencies] if isinstance(frequencies, int | float) else frequencies
    return frequency_response.transparency(
        _numeric(model, params, operating_point), frequency_list, at=at, between=between, unstable=unstable
    )


@checked
def fit_link(recording: str | Path, *, interval: str | None = None) -> LinkFit:
    """Return the statistics of a recorded network as the keys of a link.

    Parameters
    ----------
    recording
        A file written by ping or `irtt client -o`, or a CSV table with a column `delay [ms]`.
    interval
        The time between two packets, such as "8 ms", if the file does not contain this time.

    Returns
    -------
    LinkFit
        The loss rate with its confidence interval, bursts, delays, and the nearest jitter distribution; the
        printed form is the link's entry.

    Raises
    ------
    ApcError
        The file is not a recording of one of these formats.
    """
    from apc.network import link_fit
    from apc.support.option_value import option_value

    sending_interval = (
        None if interval is None else option_value("interval=", interval, subject="time", unit="s")
    )
    return link_fit.fit_recording(recording, None if sending_interval is None else float(sending_interval))


@checked
def fit(
    model: TopologySource,
    recording: str | Path,
    *,
    free: Mapping[str, str | Sequence[str | float]],
    params: Values | None = None,
    signals: Sequence[str] = (),
    method: str | None = None,
) -> ParameterFit:
    """Return parameters of a model fitted to recorded force and motion by least squares.

    Parameters
    ----------
    model
        As for `analyze`.
    recording
        A table (.csv, .parquet, .mat) with a column `time [s]`, or the folder of `apc run`. Its columns are
        signals of `simulate`, such as `device.x [m]`, and forces, such as `hand [N]`.
    free
        The ranges of the free parameters: {"device.mass": "0.05 kg:1 kg"}, or the two ends, as quantities or
        numbers in SI units.
    params
        As for `analyze`; the values of the free parameters are the start of the search.
    signals
        Patterns of the measured signals to compare; by default all of the recording.
    method
        The integration method, as for `simulate`.

    Returns
    -------
    ParameterFit
        `.parameters` with estimates, standard errors and 95 % intervals, `.correlation`, and `.residuals`
        with a test of whiteness; `.params` for `set_parameters`; `.plot()` draws the residuals.

    Raises
    ------
    ApcError
        The input is invalid, or the recording does not determine a parameter.

    Examples
    --------
    >>> ranges = {"device.mass": ("0.05 kg", "1 kg"), "device.damping": "0 N*s/m:50 N*s/m"}
    >>> fit = apc.fit("one-device.yaml", "push.csv", free=ranges)
    >>> {name: round(value, 3) for name, value in fit.params.items()}
    {'device.mass': 0.2, 'device.damping': 4.0}
    """
    from apc.simulation.settings import DEFAULT, parse_method

    compiled_model, extension = _model(model, params), require_extension("parameter_fit")
    chosen = DEFAULT if method is None else parse_method(method)
    ranges = extension.read_free(
        compiled_model, [(name, _values(name, value)) for name, value in free.items()]
    )
    result: ParameterFit = extension.fit(
        compiled_model, Path(recording), ranges, signals=signals, method=chosen
    )
    return result


@checked
def mean_square_stability(
    model: TopologySource, *, params: Values | None = None, certify: bool = False
) -> MeanSquareStability | None:
    """Return the mean-square stability over the network, with lost and late packets.

    Parameters
    ----------
    model, params, certify
        As for `analyze`.

    Returns
    -------
    MeanSquareStability or None
        Verdict in mean square, and the growth of second moments per frame with its error; None if every
        packet has its nominal delay.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.mean_square import mean_square_stability

    return mean_square_stability.mean_square_stability(_numeric(model, params), certify=certify)


@checked
def margins(model: TopologySource, *, params: Values | None = None) -> Margins:
    """Return the stability margins of each coupler's stiffness and damping and of each delay, varied one at
    a time.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.studies import margins as growth

    return growth.margins(_numeric(model, params))


@checked
def sensitivities(model: TopologySource, *, params: Values | None = None) -> Sensitivities:
    """Return the derivatives of the spectral radius with respect to every parameter.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.studies import sensitivity

    return sensitivity.sensitivities(_numeric(model, params))


@checked
def changing_counts(model: TopologySource, counts: str, *, params: Values | None = None) -> ChangingCounts:
    """Return the stability of a model while users join and leave.

    Stability for every number of peers is not stability through changes of the number.

    Parameters
    ----------
    model, params
        As for `analyze`.
    counts
        The number of peers of a group and its values: "user.count=2:10", or "user.count=2, 4".

    Returns
    -------
    The verdict under arbitrary changes, otherwise a proved sufficient time between changes in seconds
    (`dwell_s`), and counts of successive frames under which motions grow (`sequence`). A peer that joins
    starts at the mean of the others; changes happen at the starts of frames.

    Raises
    ------
    ApcError
        E881 invalid values; E890 a parameter that is no number of peers, or peers that are not
        interchangeable; E882 the extension is not installed, E875 cvxpy is not.

    Notes
    -----
    A common quadratic function by a semidefinite program, verified with all rounding; dwell times by Geromel
    and Colaneri, SIAM Journal on Control and Optimization 45, 2006.

    Examples
    --------
    >>> import apc
    >>> result = apc.changing_counts("three-users-average.yaml", "user.count=2:5")
    >>> result.verdict, result.sequence, result.dwell_frames
    ('unstable under a sequence of changes', (5, 5, 2), 12)
    """
    from apc.network.nominal_criterion import unreliable

    numeric = _numeric(model, params)
    extension = require_extension("changing_counts")
    result: ChangingCounts = extension.changing_counts(numeric, counts, lossy=bool(unreliable(numeric.model)))
    return result


@checked
def event_order(model: TopologySource, *, params: Values | None = None) -> EventOrder:
    """Return the analyses under every order of coincident events and both interpretations of the start.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    result: EventOrder = require_extension("event_order").event_order(_numeric(model, params))
    return result


@checked
def contact_modes(model: TopologySource, *, params: Values | None = None) -> ContactModes:
    """Return the analyses of a model with one-sided contacts, in each contact mode.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.analysis import contact_modes as modes

    return modes.contact_modes(_numeric(model, params))


@checked
def arbitrary_switching(model: TopologySource, *, params: Values | None = None) -> ArbitrarySwitching:
    """Return the proof of stability under arbitrary switching of contacts, or under state-dependent
    switching.

    Parameters
    ----------
    model, params
        As for `analyze`.
    """
    from apc.analysis import contact_modes as modes

    numeric = _numeric(model, params)
    switching = require_extension("switching")
    result: ArbitrarySwitching = switching.arbitrary_switching(numeric, modes.contact_modes(numeric))
    return result


@checked
def limit_cycle(model: TopologySource, *, params: Values | None = None) -> LimitCycle:
    """Return the predicted limit cycle of a model's one-sided contacts, and its simulation.

    Parameters
    ----------
    model, params
        As for `analyze`.

    Raises
    ------
    ApcError
        E864 no one-sided contact that is computed at ticks.
    """
    result: LimitCycle = require_extension("switching").limit_cycle(_numeric(model, params))
    return result


@checked
def robust_stability(
    model: TopologySource,
    box: Mapping[str, str | Sequence[str | float]],
    *,
    cells: int | None = None,
    params: Values | None = None,
) -> RobustStability:
    """Return the proof of stability for all values of parameters within ranges.

    Parameters
    ----------
    model, params
        As for `analyze`.
    box
        Ranges by parameter, such as {"contact.stiffness": "±1%"}, "900 N/m:1100 N/m" or, in SI units, (900,
        1100).
    cells
        The largest number of cells; by default a number that takes some seconds.
    """
    from apc.analysis_report import robust_stability
    from apc.studies.parameter_ranges import parse_range

    compiled_model = _model(model, params)
    ranges = [parse_range(compiled_model, (name, _values(name, value))) for name, value in box.items()]
    return robust_stability(compiled_model, ranges, cells=cells)


@checked
def parameters(model: TopologySource) -> Parameters:
    """Return the settable parameters of a model: names, values, units and limits.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    """
    from apc.parameter_values import parameter_listing

    return parameter_listing.parameters(_model(model, None))


@checked
def paper_method(model: TopologySource, *, params: Values | None = None) -> PaperMethod:
    """Return the lifted matrices of Rakhsha and Constantinescu, equations 18 to 20.

    Their rows and columns are named.

    Parameters
    ----------
    model, params
        As for `analyze`.

    Raises
    ------
    ApcError
        E861 the model does not have the form assumed for these matrices.
    """
    result: PaperMethod = require_extension("paper_method").paper_method(_model(model, params))
    return result


@checked
def region(
    model: TopologySource,
    *,
    x: str | tuple[str, str | float, str | float] | None = None,
    y: str | tuple[str, str | float, str | float] | None = None,
    criterion: Criterion | None = None,
    operating_point: Point = "start",
    params: Values | None = None,
) -> Region:
    """Return the boundary of the stable region of two parameters, as curves with their errors.

    Parameters
    ----------
    model, params
        As for `analyze`.
    x, y
        A parameter and its range, such as "contact.stiffness=10 N/m:3000 N/m" or, in SI units,
        ("contact.stiffness", 10, 3000); by default the axes of the model's `studies: region:`.
    criterion
        As for `critical`.
    operating_point
        As for `analyze`.

    Returns
    -------
    Region
        The curves, `.stable_area`, `.contains(x, y)` in SI units, `.to_dataframe()`, `.plot()`.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.lifting.numeric_model import numeric_model
    from apc.regions import stable_region
    from apc.regions.axes import parse_axes

    compiled_model = _model(model, params, operating_point)
    first, second = (
        axis if axis is None or isinstance(axis, str) else (axis[0], _values(axis[0], axis[1:]))
        for axis in (x, y)
    )
    axes = parse_axes(compiled_model, first, second)
    return stable_region.region(numeric_model(compiled_model), axes, criterion=criterion)


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
    operating_point: Point = "start",
    params: Values | None = None,
) -> Tuning:
    """Return the optimal gains under a specification, with a proof that they satisfy it.

    Parameters
    ----------
    model, params
        As for `analyze`.
    free
        Ranges of the gains by name: {"coordination.stiffness": "10 N/m:5000 N/m"} or, in SI units, (10,
        5000).
    maximize, minimize
        The objective, one of the two: a gain, a transparency metric ("coordination_error at 1 Hz", "damping",
        "coordination_error_h2", "coordination_error_hinf"), or a weighted sum of these in SI units;
        "spectral_radius" and "settling_time" are for `minimize` only.
    constraint
        Constraints in addition to stability, such as "decay=60 dB in 2 s".
    over
        The ranges of the scenarios: {"user.count": "2:10", "device.mass": "±20%", "lan.delay": "8 ms:20 ms"}.
    criterion
        As for `critical`; over unreliable links the default is mean-square. The default of all arguments is
        the topology's `studies: tune:`.
    seconds
        The time limit.
    operating_point
        As for `analyze`.

    Returns
    -------
    Tuning
        The gains (`.gains`), whether they are `.proved`, and the active constraints.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.lifting.rest_position import linearized_at
    from apc.tuning import tuner

    compiled_model, tuning_spec = _tuning_spec(
        model, params, free, over, criterion, maximize, minimize, constraint
    )
    compiled_model = linearized_at(compiled_model, operating_point)
    return tuner.tune(compiled_model, tuning_spec, seconds=float("inf") if seconds is None else seconds)


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
    """Return the Pareto front of an objective and a transparency metric.

    Parameters
    ----------
    model, free, maximize, minimize, constraint, over, criterion, params
        As for `tune`.
    tradeoff
        The transparency metric: "impedance at 5 Hz", or transmitted, error, damping, error_h2,
        error_hinf.
    points
        The number of bounds on the metric, from its smallest value to its value at the best objective.
    seconds
        The time limit for all points.

    Returns
    -------
    ParetoFront
        The designs (`.designs`); `.plot()` draws the front.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.tuning.specification import read_tradeoff

    compiled_model, tuning_spec = _tuning_spec(
        model, params, free, over, criterion, maximize, minimize, constraint
    )
    until = float("inf") if seconds is None else seconds
    result: ParetoFront = require_extension("pareto_front").pareto_front(
        compiled_model, tuning_spec, read_tradeoff(tradeoff), points=points, seconds=until
    )
    return result


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
    """Return a model with the hands of its study or the criterion, and the tuning specification."""
    from apc.tuning.specification import gripped_as_studied, read_tuning_spec

    used_criterion: str | None = criterion
    compiled_model = _model(model, values)
    if criterion is None:
        compiled_model, used_criterion = gripped_as_studied(compiled_model)
    ranges, required = (
        [(name, _values(name, value)) for name, value in (named_ranges or {}).items()]
        for named_ranges in (free, over)
    )
    tuning_spec = read_tuning_spec(
        compiled_model,
        ranges,
        maximize=maximize,
        minimize=minimize,
        constraint=constraint,
        over=required,
        criterion=used_criterion,
    )
    return compiled_model, tuning_spec


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
    """Return a result at every combination of parameter values.

    Parameters
    ----------
    model, params
        As for `analyze`.
    over
        Values by parameter: "500 N/m:1500 N/m:11" (lower end, upper end, number of values), or a list of
        quantities or of numbers in SI units.
    of
        The result: "analyze", or "critical:PARAMETER".
    criterion
        As for `critical`.
    out
        A .parquet or .csv file; finished parts are stored in its folder, and the same call resumes after
        them.
    jobs
        The number of processes; by default the number of cores, for a sweep of more than some seconds.
    cluster
        The address of a Dask scheduler.
    """
    from apc.studies import resumable_sweep

    path = None if out is None else Path(out)
    compiled_model = _model(model, params)
    _check_out(model, compiled_model, path)
    values = {name: _values(name, given) for name, given in over.items()}
    return resumable_sweep.sweep(
        compiled_model, values, of=of, criterion=criterion, out=path, jobs=jobs, cluster=cluster
    )


def _several(topologies: TopologySource | Iterable[TopologySource], function: str) -> list[TopologySource]:
    """Return the models as a list, also for a single model. Raises ApcError if there is none."""
    if isinstance(topologies, Model | str | Path):
        return [topologies]
    if models := list(topologies):
        return models
    fix = f'apc.{function}(["average.yaml", "mesh.yaml"])'
    raise ApcError(Diagnostic("E610", SourceLocation(function), "no topology given", fix=fix))


def _path(topology: TopologySource, function: str) -> Path:
    """Return the path of a topology file. Raises ApcError for a compiled model."""
    from apc.inputs.open_model import refuse_model

    path = (
        Path(topology.origin.topology).with_suffix(".apc") if isinstance(topology, Model) else Path(topology)
    )
    refuse_model(path, function)
    return path


def _model(model: TopologySource, params: Values | None, operating_point: Point = "start") -> Model:
    """Return the compiled model, with parameter values changed, and linearized at an operating point."""
    if not isinstance(model, Model):
        from apc.inputs.open_model import load_or_compile

        model = load_or_compile(Path(model))
    changed = set_parameters(model, params) if params else model
    if operating_point == "start":
        return changed
    from apc.lifting.rest_position import linearized_at

    return linearized_at(changed, operating_point)


def _numeric(model: TopologySource, params: Values | None, operating_point: Point = "start") -> NumericModel:
    """Return the model at its parameter values, with parameter values changed, and its operating point."""
    from apc.lifting.numeric_model import numeric_model

    return numeric_model(_model(model, params, operating_point))


def _check_out(model: TopologySource, compiled_model: Model, path: Path | None) -> None:
    """Raise ApcError if an output file would overwrite the input of the model."""
    if path is not None and not isinstance(model, Model):
        from apc.inputs.open_model import check_outputs

        check_outputs(Path(model), (name for name, _ in compiled_model.origin.texts), {"out=": path})


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
    joins: Mapping[str, str | float] | None = None,
    leaves: Mapping[str, str | float] | None = None,
    trace_of: Literal["worst"] | None = None,
    error: bool = False,
) -> Trajectory:
    """Return the simulation of a model in time.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    duration
        The duration, such as "2 s", or a number in seconds; by default the duration of the model's
        experiment.
    params
        Parameter values to change first, as in `set_parameters`.
    signals
        Patterns of the signals to store, such as "cube.x" or "left[2].*"; by default all signals.
    jit
        Whether to compile to machine code if there is a C compiler.
    seed
        The seed of random losses and delays of packets; by default the seed of the model's experiment.
    method
        "exact", "rk4:STEP", "semi-implicit:STEP" or "cvodes:RTOL", such as "rk4:0.1 ms"; by default exact for
        linear equations, and CVODES for nonlinear ones.
    impulse
        A peer with an impulse at the start, such as "user[1]": its device has an initial velocity of 0.1 m/s.
    joins, leaves
        The instants at which peers join after the start and leave before the end, such as
        `{"user[3]": "1 s"}`, or numbers in seconds; by default those of the model's experiment.
    trace_of
        "worst": packets are lost in the periodic pattern for which `analyze` finds instability.
    error
        Whether to estimate the error by a second simulation.

    Returns
    -------
    Trajectory
        One row for every tick of the fastest clock, with the values before the tick, and a summary. Values of
        a peer that is absent are NaN.

    Raises
    ------
    ApcError
        The input is invalid.
    """
    from apc.simulation import trajectory
    from apc.simulation.settings import DEFAULT, parse_method

    compiled_model = _model(model, params)
    if impulse is not None:
        from apc.simulation import initial_velocity as push

        compiled_model, _ = push.initial_velocity(compiled_model, impulse)
        if duration is None and compiled_model.experiment.duration is None:
            duration = float(push.WATCHED)
    if trace_of is not None:
        compiled_model = require_extension("loss_models").worst_trace(compiled_model)
    if joins or leaves:
        texts = ([f"{peer}={_time(at)}" for peer, at in (times or {}).items()] for times in (joins, leaves))
        compiled_model = require_extension("changing_counts").with_peer_times(compiled_model, *texts)
    return trajectory.simulate(
        compiled_model,
        duration=_duration(duration),
        signals=signals,
        jit=jit,
        seed=seed,
        method=parse_method(method) if method is not None else DEFAULT,
        error=error,
    )


def _duration(duration: str | float | None) -> Fraction | None:
    """Return a duration in seconds, None if none is given."""
    if duration is None:
        return None
    from apc.simulation.trajectory import parse_duration

    return parse_duration(_time(duration))


def _time(time: str | float) -> str:
    """Return a time as text; a number is in seconds."""
    return time if isinstance(time, str) else f"{float(time)!r} s"


@checked
def bench(
    model: TopologySource,
    *,
    params: Values | None = None,
    rounds: int | None = None,
) -> Bench:
    """Return time and true error of every method of analysis and simulation for a model.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology file.
    params
        Parameters to change first, as `{"contact.stiffness": "800 N/m"}`.
    rounds
        The number of runs of each method, fewer for slow methods; by default 15.

    Raises
    ------
    ApcError
        No method can analyze the model.
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
    """Return a model in the format of another tool, and write it to a file if `out` is given.

    Parameters
    ----------
    model, params
        As for `analyze`.
    to
        "control", "mat" or "npz": a state space; "modelica": a model; "c": one peer in C99; "fmu": a model or
        a peer for co-simulation. The default follows from the suffix of `out`.
    out
        The file to write; by default no file is written.
    open_at
        The link or coupler at which the loop is opened.
    symbolic
        Parameters that remain symbolic: `.function` is a `casadi.Function` of them that returns A, B, C and
        D.
    peer
        For "c" and "fmu": the peer, such as "left[1]". By default an FMU includes all peers.
    device
        For "c": the masses outside the peer's computer, or "none"; by default the masses that are hand-held
        or not sent to other peers.
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
    compiled_model = _model(model, params)
    _check_out(model, compiled_model, path)
    requested = formats.ExportRequest(open_at, tuple(symbolic), peer, device, method)
    return formats.export(compiled_model, chosen, requested, path)


@checked
def report(
    files: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    params: Values | None = None,
) -> Report:
    """Return a report on topologies, with all analyses on one page, and write it if `out` is given.

    Parameters
    ----------
    files
        Topologies, YAML files; several are compared.
    out
        The page to write, `.html` or `.pdf`; by default no page is written.
    params
        As for `analyze`, for all topologies.

    Returns
    -------
    Report
        The topologies (`.topologies`), each with sections of tables, as from the other functions.

    Raises
    ------
    ApcError
        The input is invalid, or the page cannot be written.
    """
    from apc.inputs.open_model import check_topology_outputs
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
            return diagram.draw_dot(diagram.diagram_of(path))
        case "mermaid":
            return diagram.draw_mermaid(diagram.diagram_of(path))
        case "svg":
            from apc.output.graph import graph_picture
            from apc.output.pictures import svg_text

            return svg_text(graph_picture(diagram.diagram_of(path)))


@checked
def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of topologies, generated from the language and the library."""
    from apc.compiler.components.component_library import Library
    from apc.compiler.view.schema import topology_schema

    return topology_schema(Library())
