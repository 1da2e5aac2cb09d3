"""The public functions: plain, with frozen results.

Takes: paths, compiled models, settings. Gives: compiled models and analyses.
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
    from apc.analysis.box_proof import RobustStability
    from apc.analysis.contact_modes import ContactModes
    from apc.analysis.conventions import EventOrder
    from apc.analysis.methods import Method
    from apc.analysis.paper import PaperMethod
    from apc.analysis.switching import ArbitrarySwitching
    from apc.benchmark.speed_and_error import Bench
    from apc.comparison.comparison import SchemeComparison
    from apc.frame.settable import Parameters
    from apc.hands.frequency_response import Transparency
    from apc.hands.passivity import AbsoluteStability
    from apc.moments.network_verdict import MeanSquareStability
    from apc.network.recorded import LinkFit
    from apc.regions.stable_region import Region
    from apc.reports.contents import Report
    from apc.result import Result
    from apc.simulation.buzz import LimitCycle
    from apc.simulation.trajectory import Trajectory
    from apc.sweeps.resumable_sweep import Sweep
    from apc.tuning.demands import TuningSpec
    from apc.tuning.front import ParetoFront
    from apc.tuning.tuner import Tuning
    from apc.vary.critical_values import Critical
    from apc.vary.many import Analyses
    from apc.vary.margins import Margins
    from apc.vary.sensitivity import Sensitivities

Scene = Model | str | Path
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
        The file is at fault; holds every mistake found.
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
def with_hands(model: Scene, hands: str) -> Model:
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
        hands there are: `passive_hands`, `critical` and `region` judge them.
    """
    from apc.frame import devices

    changed = devices.with_hands(_model(model, None), hands)
    if hands == devices.PASSIVE:
        what = "passive hands are all that draw no energy, and a model has one hand a device"
        raise ApcError(
            Diagnostic("E930", SourceLocation("with_hands"), what, hint="apc.passive_hands(model)")
        )
    return changed


@checked
def set_parameters(model: Model, values: Mapping[str, str | float]) -> Model:
    """Return the model with other parameter values, without compiling again.

    Parameters
    ----------
    model
        The compiled model; it stays as it is.
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
    """Return a value of a parameter as it is written: a number without a unit is in SI."""
    if isinstance(value, str):
        return value
    from apc.frame.names import find, unit_of

    if not isinstance(value, Real) or isinstance(value, bool):
        raise ApcError(
            Diagnostic("E204", SourceLocation(name), name, "a quantity or a number in SI", repr(value)[:80])
        )
    number = int(value) if isinstance(value, Integral) else float(value)
    return f"{number!r} {unit_of(system, find(system, name, counts=True).name)}".rstrip()


def _range(system: Model, name: str, value: str | Sequence[str | float]) -> str:
    """Return a range of a parameter as it is written, of a text or of its two ends."""
    return value if isinstance(value, str) else ":".join(_quantity(system, name, end) for end in value)


@checked
def analyze(
    model: Scene,
    *,
    set: Values | None = None,
    method: Method = "auto",
    certify: bool = False,
) -> Analysis:
    """Say whether a scene is stable, by how much, and in which modes.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    set
        Parameter values to change first, as in `set_parameters`.
    method
        "auto": what serves the scene; "modes": a few systems of a site's size, at a cost that does not grow
        with the number of equal peers; "dense": every peer in one system, the check on the others;
        "determinant": the zeros of a small determinant, for peers that all differ and for long delays;
        "paper": the lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20).
    certify
        Prove the verdict in ball arithmetic.

    Returns
    -------
    Analysis
        Verdict, spectral radius per frame with its error bound, and the modes.

    Raises
    ------
    ApcError
        The input is at fault, or the method can't serve the scene.
    """
    from apc.answer import judge

    return judge(_model(model, set), method=method, certify=certify)


@checked
def analyze_many(
    model: Scene,
    values: Mapping[str, Any],
    *,
    set: Values | None = None,
) -> Analyses:
    """Say the same of many values of some parameters at once, a hundred times as fast as one by one.

    Parameters
    ----------
    model, set
        As for `analyze`.
    values
        By parameter an array of its values, numbers in SI or quantities: {"contact.stiffness": [500, 1000],
        "lan.delay": ["8 ms", "16 ms"]}. Arrays are broadcast against one another.

    Returns
    -------
    Analyses
        Arrays of that shape: `.verdict`, `.stable`, `.spectral_radius` with its bound
        `.spectral_radius_error`, `.frequency_hz` and `.damping_ratio` of the leading mode; `.to_dataframe()`.

    Raises
    ------
    ApcError
        The input is at fault; of a single point, its `.message` says so.
    """
    from apc.vary import many

    return many.analyze_many(_model(model, set), values)


@checked
def critical(
    model: Scene,
    parameter: str,
    *,
    set: Values | None = None,
    lower: str | float | None = None,
    upper: str | float | None = None,
    criterion: Criterion | None = None,
) -> Critical:
    """Find the values of a parameter or delay at which a scene becomes stable or unstable.

    Parameters
    ----------
    model, set
        As for `analyze`.
    parameter
        Its name, such as "coordination.stiffness" or "lan.delay".
    lower, upper
        Quantities between which to look, such as "5000 N/m", or numbers in SI.
    criterion
        "mean-square": stable means that second moments die out over the network as it is, the default where
        a link loses or delays packets; "nominal": that motions die out if every packet is on time; "passive":
        that they do so with every passive hand at every device.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.vary import critical_values

    system = _model(model, set)
    low, high = (None if item is None else _quantity(system, parameter, item) for item in (lower, upper))
    return critical_values.critical(system, parameter, lower=low, upper=high, criterion=criterion)


@checked
def compare(
    models: Scene | Sequence[Scene],
    *,
    set: Values | None = None,
    over: Sequence[str] = (),
    criterion: Criterion | None = None,
    at: str = "",
) -> SchemeComparison:
    """Put schemes side by side: verdicts, largest stable stiffness, delay, loss, what is felt, what it costs.

    Parameters
    ----------
    models
        What `analyze` takes, mostly several.
    set
        As for `analyze`, of all of them.
    over
        Which stiffness, delay or loss is looked at, where a model has several; each takes those it has.
    criterion
        As for `critical`.
    at
        The device whose hand feels, as for `feel`.

    Returns
    -------
    SchemeComparison
        Its `.schemes`, each with the results of `analyze`, `critical` and `feel` that it is made of;
        `.to_dataframe()`, `.plot()`.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.comparison import comparison

    scenes = _several(models, "compare")
    return comparison.compare([_model(scene, set) for scene in scenes], over=over, criterion=criterion, at=at)


@checked
def passive_hands(model: Scene, *, set: Values | None = None) -> AbsoluteStability:
    """Say whether a scene is stable with every passive hand at every device, and how much damping that takes.

    Parameters
    ----------
    model, set
        As for `analyze`.

    Raises
    ------
    ApcError
        A peer has no device, or a hand already; a device is touched otherwise than by samples and holds.
    """
    from apc.hands import passivity

    return passivity.passive_hands(_model(model, set))


@checked
def feel(
    model: Scene,
    frequencies: Sequence[float] | float,
    *,
    set: Values | None = None,
    at: str = "",
    between: str = "",
    unstable: bool = False,
) -> Transparency:
    """Say what a hand feels at its device, and what of a push arrives at another.

    Parameters
    ----------
    model, set
        As for `analyze`.
    frequencies
        (k,), in Hz, at most half the rate of the fastest clock.
    at, between
        The device that is pushed, such as "left[1].device", and another: the first peer's and the next one's.
    unstable
        Whether of an unstable scene, which has no response in time, that of its map is wanted.

    Returns
    -------
    Transparency
        Impedance, transmitted admittance and error between copies, complex (k,), in SI, with a bound; mass,
        damping and stiffness of slow motions; H∞ norms; H2 norms, an rms at the ticks: motion between ticks
        is not included.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.hands import frequency_response

    listed = [frequencies] if isinstance(frequencies, int | float) else frequencies
    return frequency_response.feel(_model(model, set), listed, at=at, between=between, unstable=unstable)


@checked
def describe_network(recording: str | Path, *, interval: str | None = None) -> LinkFit:
    """Say what a recorded network amounts to, as a link's own keys.

    Parameters
    ----------
    recording
        A file that ping or `irtt client -o` wrote, or a CSV table with a column `delay [ms]`.
    interval
        A time such as "8 ms" between two packets, where the file doesn't say.

    Returns
    -------
    LinkFit
        The share lost with its interval, bursts, delays, the nearest law of a jitter; printed, the link's
        entry.

    Raises
    ------
    ApcError
        The file is none of these.
    """
    from apc.network import recorded
    from apc.option_value import option_value

    between = None if interval is None else option_value("interval=", interval, what="a time", unit="s")
    return recorded.describe(recording, None if between is None else float(between))


@checked
def judge_network(
    model: Scene, *, set: Values | None = None, certify: bool = False
) -> MeanSquareStability | None:
    """Say what becomes of a scene over the network that it has, lost and late packets included.

    Parameters
    ----------
    model, set, certify
        As for `analyze`.

    Returns
    -------
    MeanSquareStability or None
        Verdict in mean square and the growth of second moments a frame with its error; None where every
        packet takes its nominal delay.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.moments import network_verdict

    return network_verdict.judge_network(_model(model, set), certify=certify)


@checked
def margins(model: Scene, *, set: Values | None = None) -> Margins:
    """Say how far each coupler's stiffness and damping and each delay may grow, all else as it is.

    Parameters
    ----------
    model, set
        As for `analyze`.
    """
    from apc.vary import margins as growth

    return growth.margins(_model(model, set))


@checked
def sensitivities(model: Scene, *, set: Values | None = None) -> Sensitivities:
    """Differentiate the spectral radius with respect to every parameter.

    Parameters
    ----------
    model, set
        As for `analyze`.
    """
    from apc.vary import sensitivity

    return sensitivity.sensitivities(_model(model, set))


@checked
def conventions(model: Scene, *, set: Values | None = None) -> EventOrder:
    """Repeat the analysis under every order of coincident events and both readings of the start.

    Parameters
    ----------
    model, set
        As for `analyze`.
    """
    from apc.analysis import conventions as orders

    return orders.conventions(_model(model, set))


@checked
def contact_modes(model: Scene, *, set: Values | None = None) -> ContactModes:
    """Analyse a scene whose couplers push and never pull in each of their modes.

    Parameters
    ----------
    model, set
        As for `analyze`.
    """
    from apc.analysis import contact_modes as switched

    return switched.contact_modes(_model(model, set))


@checked
def switching(model: Scene, *, set: Values | None = None) -> ArbitrarySwitching:
    """Say whether a scene is proved stable however its contacts open and close, or as they do by themselves.

    Parameters
    ----------
    model, set
        As for `analyze`.
    """
    from apc.analysis import contact_modes as switched
    from apc.analysis import switching as at_will

    system = _model(model, set)
    return at_will.switching(system, switched.contact_modes(system))


@checked
def buzz(model: Scene, *, set: Values | None = None) -> LimitCycle:
    """Predict the buzz of a scene's one-sided contacts, and play it beside.

    Parameters
    ----------
    model, set
        As for `analyze`.

    Raises
    ------
    ApcError
        E864 no contact that pushes from tick to tick and never pulls.
    """
    from apc.simulation import buzz as cycles

    return cycles.buzz(_model(model, set))


@checked
def prove_box(
    model: Scene,
    box: Mapping[str, str | Sequence[str | float]],
    *,
    cells: int | None = None,
    set: Values | None = None,
) -> RobustStability:
    """Prove that a scene is stable for every value of some parameters within their ranges.

    Parameters
    ----------
    model, set
        As for `analyze`.
    box
        Ranges by parameter, such as {"contact.stiffness": "±1%"}, "900 N/m:1100 N/m" or, in SI, (900, 1100).
    cells
        How many cells are looked at at most; without it, as many as take some seconds.
    """
    from apc.analysis.box import parse_range
    from apc.answer import proved_box

    system = _model(model, set)
    ranges = [parse_range(system, f"{name}={_range(system, name, value)}") for name, value in box.items()]
    return proved_box(system, ranges, cells=cells)


@checked
def parameters(model: Scene) -> Parameters:
    """List what may be set of a scene: its names, values, units and limits.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    """
    from apc.frame import settable

    return settable.parameters(_model(model, None))


@checked
def paper_route(model: Scene, *, set: Values | None = None) -> PaperMethod:
    """Return the lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20), rows and columns named.

    Parameters
    ----------
    model, set
        As for `analyze`.

    Raises
    ------
    ApcError
        E861 the scene has not the form these matrices need.
    """
    from apc.analysis import paper

    return paper.paper_route(_model(model, set))


@checked
def region(
    model: Scene,
    *,
    x: str | tuple[str, str | float, str | float] | None = None,
    y: str | tuple[str, str | float, str | float] | None = None,
    criterion: Criterion | None = None,
    set: Values | None = None,
) -> Region:
    """Find the boundary of the stable region of two parameters, as curves with their errors.

    Parameters
    ----------
    model, set
        As for `analyze`.
    x, y
        A parameter and its range, such as "contact.stiffness=10 N/m:3000 N/m" or, in SI,
        ("contact.stiffness", 10, 3000); those of the scene's `studies: region:` if not given.
    criterion
        As for `critical`.

    Returns
    -------
    Region
        Its curves, `.stable_area`, `.contains(x, y)` in SI, `.to_dataframe()`, `.plot()`.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.regions import stable_region
    from apc.regions.axes import parse_axes

    system = _model(model, set)
    first, second = (
        axis if axis is None or isinstance(axis, str) else f"{axis[0]}={_range(system, axis[0], axis[1:])}"
        for axis in (x, y)
    )
    return stable_region.region(system, parse_axes(system, first, second), criterion=criterion)


@checked
def tune(
    model: Scene,
    free: Mapping[str, str | Sequence[str | float]] | None = None,
    *,
    maximize: str = "",
    minimize: str = "",
    subject: Sequence[str] = (),
    over: Mapping[str, str | Sequence[str | float]] | None = None,
    criterion: Criterion | None = None,
    seconds: float | None = None,
    set: Values | None = None,
) -> Tuning:
    """Find the gains that do best in all that they have to bear, and prove that they bear it.

    Parameters
    ----------
    model, set
        As for `analyze`.
    free
        Ranges of the gains by name: {"coordination.stiffness": "10 N/m:5000 N/m"} or, in SI, (10, 5000).
    maximize, minimize
        One of them: a gain, what hands feel ("feel.error at 1 Hz", "feel.damping", "feel.error_h2",
        "feel.error_hinf"), or a weighted sum of these in SI; "spectral_radius" and "settling_time" may be
        small, too.
    subject
        Demands beside stability, such as "decay=60 dB in 2 s".
    over
        What has to be borne: {"user.count": "2:10", "device.mass": "±20%", "lan.delay": "8 ms:20 ms"}.
    criterion
        As for `critical`; over unreliable links stable means so in mean square.
        What is left out of these is as the scene's `studies: tune:` says.
    seconds
        How long to go on at most.

    Returns
    -------
    Tuning
        Its `.gains`, whether they are `.proved`, and what binds.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.tuning import tuner

    system, demands = _demands(model, set, free, over, criterion, maximize, minimize, subject)
    return tuner.tune(system, demands, seconds=float("inf") if seconds is None else seconds)


@checked
def front(
    model: Scene,
    free: Mapping[str, str | Sequence[str | float]],
    against: str,
    *,
    maximize: str = "",
    minimize: str = "",
    subject: Sequence[str] = (),
    over: Mapping[str, str | Sequence[str | float]] | None = None,
    criterion: Criterion | None = None,
    points: int = 20,
    seconds: float | None = None,
    set: Values | None = None,
) -> ParetoFront:
    """Weigh an aim against what a hand feels: the best of the one for each of several bounds on the other.

    Parameters
    ----------
    model, free, maximize, minimize, subject, over, criterion, set
        As for `tune`.
    against
        What is felt: "feel.impedance at 5 Hz", or transmitted, error, damping, error_h2, error_hinf.
    points
        How many bounds, from the least that is felt to what the best of the aim is felt like.
    seconds
        How long to go on at most, with all of them.

    Returns
    -------
    ParetoFront
        Its `.designs`; `.plot()` draws it.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.tuning.demands import read_against
    from apc.tuning.front import front as pareto

    system, demands = _demands(model, set, free, over, criterion, maximize, minimize, subject)
    until = float("inf") if seconds is None else seconds
    return pareto(system, demands, read_against(against), points=points, seconds=until)


def _demands(
    model: Scene,
    values: Values | None,
    free: Mapping[str, Any] | None,
    over: Mapping[str, Any] | None,
    criterion: Criterion | None,
    maximize: str,
    minimize: str,
    subject: Sequence[str],
) -> tuple[Model, TuningSpec]:
    """Return a scene as its study or a criterion has its devices held, and what is asked of gains."""
    from apc.tuning.demands import held_as_studied, read_demands

    means: str | None = criterion
    system = _model(model, values)
    if criterion is None:
        system, means = held_as_studied(system)
    ranges, borne = (
        [f"{name}={_range(system, name, value)}" for name, value in (asked or {}).items()]
        for asked in (free, over)
    )
    demands = read_demands(
        system,
        ranges,
        maximize=maximize,
        minimize=minimize,
        subject=subject,
        over=borne,
        criterion=means,
    )
    return system, demands


@checked
def sweep(
    model: Scene,
    over: Mapping[str, str | Sequence[str | float]],
    *,
    of: str = "analyze",
    criterion: Criterion | None = None,
    out: str | Path | None = None,
    jobs: int | None = None,
    cluster: str | None = None,
    set: Values | None = None,
) -> Sweep:
    """Compute a result at every combination of some parameters' values.

    Parameters
    ----------
    model, set
        As for `analyze`.
    over
        Values by parameter: "500 N/m:1500 N/m:11" (lower end, upper end, how many), or a list of quantities
        or of numbers in SI.
    of
        "analyze", or "critical:PARAMETER".
    criterion
        As for `critical`.
    out
        A .parquet or .csv file; finished parts are kept beside it, and the same call takes up where it ended.
    jobs
        Processes; the number of cores if not given.
    cluster
        The address of a Dask scheduler.
    """
    from apc.sweeps import resumable_sweep

    path = None if out is None else Path(out)
    system = _model(model, set)
    _check_out(model, system, path)
    values = {
        name: text if isinstance(text, str) else [_quantity(system, name, value) for value in text]
        for name, text in over.items()
    }
    return resumable_sweep.sweep(
        system, values, of=of, criterion=criterion, out=path, jobs=jobs, cluster=cluster
    )


def _several(scenes: Scene | Iterable[Scene], function: str) -> list[Scene]:
    """Return the scenes that a function is given, of which one needs no list; refuse none."""
    if isinstance(scenes, Model | str | Path):
        return [scenes]
    if listed := list(scenes):
        return listed
    hint = f'apc.{function}(["average.yaml", "mesh.yaml"])'
    raise ApcError(Diagnostic("E610", SourceLocation(function), "no scene is given", hint=hint))


def _path(scene: Scene, function: str) -> Path:
    """Return the path of a topology; refuse a compiled model, beside which it stands."""
    from apc.inputs import refuse_model

    path = Path(scene.origin.topology).with_suffix(".apc") if isinstance(scene, Model) else Path(scene)
    refuse_model(path, function)
    return path


def _model(model: Scene, set: Values | None) -> Model:
    """Return a compiled model, with the parameters set."""
    if not isinstance(model, Model):
        from apc.inputs import load_or_compile

        model = load_or_compile(Path(model))
    return set_parameters(model, set) if set else model


def _check_out(model: Scene, system: Model, path: Path | None) -> None:
    """Refuse to write over what the model was read from."""
    if path is not None and not isinstance(model, Model):
        from apc.inputs import check_outputs

        check_outputs(Path(model), (name for name, _ in system.origin.texts), {"out=": path})


@checked
def simulate(
    model: Scene,
    *,
    duration: str | float | None = None,
    set: Values | None = None,
    signals: Sequence[str] = (),
    jit: bool = True,
    seed: int | None = None,
    method: str | None = None,
    strike: str | None = None,
    trace_of: Literal["worst"] | None = None,
    error: bool = False,
) -> Trajectory:
    """Play a scene in time.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    duration
        How long, such as "2 s" or 2; that of the scene's experiment if not given.
    set
        Parameter values to change first, as in `set_parameters`.
    signals
        Patterns of the signals to keep, such as "cube.x" or "left[2].*"; all if there is none.
    jit
        Whether to compile to machine code where there is a C compiler.
    seed
        Of the packets that get lost or come late; that of the scene's experiment if not given.
    method
        "exact", "rk4:STEP", "semi-implicit:STEP" or "cvodes:RTOL", such as "rk4:0.1 ms"; exact where linear
        and by CVODES elsewhere if not given.
    strike
        A peer that is struck as the scene begins, such as "user[1]": its device starts at 0.1 m/s.
    trace_of
        "worst": lose packets by the periodic pattern that `analyze` finds to shake the scene.
    error
        Whether to estimate the error, by a second run.

    Returns
    -------
    Trajectory
        A row for every tick of the fastest clock with the values before the tick, and a summary.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.simulation import trajectory
    from apc.simulation.settings import DEFAULT, parse_method

    system = _model(model, set)
    if strike is not None:
        from apc.simulation import strike as push

        system, _ = push.strike(system, strike)
        if duration is None and system.experiment.duration is None:
            duration = float(push.WATCHED)
    if trace_of is not None:
        from apc.moments.worst import trace_of_worst

        system = trace_of_worst(system)
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
    model: Scene,
    *,
    set: Values | None = None,
    rounds: int | None = None,
) -> Bench:
    """Measure every method of analysis and of simulation on a scene: time against true error.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology file.
    set
        Parameters to change first, as `{"contact.stiffness": "800 N/m"}`.
    rounds
        Runs of each method, fewer of slow ones; 15 if not given.

    Raises
    ------
    ApcError
        The scene can't be analysed at all.
    """
    from apc.benchmark import speed_and_error

    return speed_and_error.bench(
        _model(model, set), rounds=speed_and_error.ROUNDS if rounds is None else rounds
    )


@checked
def export(
    model: Scene,
    to: str | None = None,
    out: str | Path | None = None,
    *,
    set: Values | None = None,
    cut: str = "",
    free: Sequence[str] = (),
    peer: str = "",
    device: str = "",
    method: str = "",
) -> Result:
    """Hand a scene over to other tools.

    Parameters
    ----------
    model, set
        As for `analyze`.
    to
        "control", "mat" or "npz": a state space; "modelica": a model; "c": one peer in C99; "fmu": a scene
        or a peer for co-simulation. The suffix of `out` says it if not given.
    out
        The file to write; nothing is written if not given.
    cut
        The link or coupler to cut the loop open at.
    free
        Parameters that stay free: `.function` is a `casadi.Function` of them that gives A, B, C and D.
    peer
        Of "c" and "fmu": the peer, such as "left[1]". An FMU is of all peers if not given.
    device
        Of "c": the masses that move outside the peer's computer, "none" if none does; those that a hand holds
        or that others are not told of if not given.
    method
        Of "c" and "fmu": how states move between ticks, as for `simulate`; such as "rk4:0.1 ms" where they
        are not linear.

    Returns
    -------
    Result
        What was made, and written if asked: of a state space its matrices with the names and units of states,
        inputs and outputs, and `.to_control()`; of a model its `.text`.

    Raises
    ------
    ApcError
        The input is at fault, or the scene can't be handed over so.
    """
    from apc.exports import formats

    path = None if out is None else Path(out)
    chosen = formats.format_of(to, path, option="=")
    system = _model(model, set)
    _check_out(model, system, path)
    asked = formats.ExportRequest(cut, tuple(free), peer, device, method)
    return formats.export(system, chosen, asked, path)


@checked
def report(
    files: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    set: Values | None = None,
) -> Report:
    """Gather all that is known of scenes, for one page.

    Parameters
    ----------
    files
        Topologies, YAML files; several stand side by side.
    out
        The page to write, `.html` or `.pdf`; nothing is written if not given.
    set
        As for `analyze`, of all of them.

    Returns
    -------
    Report
        Its `.scenes`, each with sections of tables, which are those of the other functions.

    Raises
    ------
    ApcError
        The input is at fault, or the page can't be written.
    """
    from apc.inputs import check_topology_outputs
    from apc.present.report_output import check_report_path, save_report
    from apc.reports import contents

    paths = [_path(scene, "report") for scene in _several(files, "report")]
    for path in paths:
        if out is not None:
            check_topology_outputs(path, {"out=": Path(out)})
    if out is not None:
        check_report_path(Path(out))
    result = contents.report(paths, [f"{name}={value}" for name, value in (set or {}).items()])
    if out is not None:
        save_report(result, Path(out))
    return result


@checked
def show(path: str | Path, *, format: Format = "text") -> str:
    """Tell what a scene is made of: its graph, its equations, and what happens in one frame.

    Parameters
    ----------
    path
        The topology, a YAML file.
    format
        "text" for a person; "json", the same as one document; "dot" and "mermaid", the graph in the
        languages of Graphviz and Mermaid; "svg", the graph as a picture.

    Raises
    ------
    ApcError
        The file is at fault, or is a compiled model: its topology is meant.
    """
    from apc.compiler.view import diagram, listing
    from apc.present.forms import json_text

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
            from apc.present.graph import graph_picture
            from apc.present.pictures import svg_text

            return svg_text(graph_picture(listing.diagram_of(path)))


@checked
def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of topologies, generated from the language and the library."""
    from apc.compiler.components.component_library import Library
    from apc.compiler.view.schema import topology_schema

    return topology_schema(Library())
