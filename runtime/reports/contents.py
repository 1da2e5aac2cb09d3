"""The contents of a report of topologies: results of other commands, each with its command.

Takes: topologies and settings.
Gives: `Section`, `TopologyReport`, `Report`; `report`; `differences`.
Guarantees: every number is from the command shown with it; a section without results has a reason. A
report contains the texts of the topology, so that it can be recomputed without other files.
Does not: draw, or write files (see `output.report_output`).
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from apc.analysis.model_size import model_size
from apc.analysis_report import AnalysisReport, answer
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.haptics.device_port import read_frequencies
from apc.haptics.frequency_response import transparency
from apc.inputs.open_model import open_topology
from apc.lifting.numeric_model import numeric_model
from apc.mean_square.mean_square_stability import mean_square_stability
from apc.parameter_values.parameter_names import parameter_of, unit_of
from apc.regions.axes import parse_axes
from apc.regions.stable_region import region
from apc.result import Result
from apc.simulation.initial_velocity import WATCHED, impulse_text, initial_velocity
from apc.simulation.motion_classes import MotionVerdict
from apc.simulation.trajectory import simulate
from apc.studies.choice import DELAY, LOSS, STIFFNESS, choose
from apc.studies.comparison import SchemeComparison, compare
from apc.studies.critical_values import critical
from apc.studies.margins import STIFFNESSES, coupler_parameters
from apc.studies.stability_criteria import MEAN_SQUARE, NOMINAL
from apc.support.distribution import versions

LIBRARIES = ("casadi", "numpy", "scipy", "sympy", "python-flint", "matplotlib")
MOST_SIMULATED = 60  # the largest number of peers simulated
JITTER = "jitter"
FURTHER = 3  # upper end of a region's range, relative to the present value, if the topology has no range
TRANSPARENCY = ("0.1 Hz", 200)  # the lowest frequency, and the number of frequencies
# The relative tolerance of recomputed numbers, on another processor or with other libraries, in addition to
# their errors; and the tolerance of small numbers relative to the largest number in the same list.
SAME, NOTHING = 1e-6, 1e-9


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a report: `remarks`, `results` as text, and `figures`, results with a picture.

    `refused` is the reason for a section without results.
    """

    key: str
    command: str
    remarks: tuple[str, ...] = ()
    results: tuple[Result, ...] = ()
    figures: tuple[Any, ...] = ()
    refused: str = ""


@dataclass(frozen=True, slots=True)
class TopologyReport:
    """The report of one topology.

    `texts` are its own files by name, `origin` the digests of all its sources.
    """

    name: str
    description: str
    path: Path
    settings: tuple[str, ...]
    texts: tuple[tuple[str, str], ...]
    origin: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]


@dataclass(frozen=True, slots=True)
class Report(Result):
    """The reports of topologies; `comparison` is None for a single topology."""

    shown_by = "report_output:report"

    topologies: tuple[TopologyReport, ...]
    comparison: SchemeComparison | None
    refused: str
    versions: tuple[tuple[str, str], ...]


@part("report")
def report(paths: Sequence[Path], settings: Sequence[str] = ()) -> Report:
    """Return the report of topologies.

    Parameters
    ----------
    paths
        The topology files.
    settings
        Parameters to change first in all of them, each `NAME=QUANTITY`.

    Raises
    ------
    ApcError
        A file or a setting is invalid.
    """
    systems = [open_topology(str(path), settings) for path in paths]
    topologies = tuple(_topology(path, model, settings) for path, model in zip(paths, systems, strict=True))
    comparison, refused = None, ""
    if len(systems) > 1:
        try:
            comparison = compare(systems)
        except ApcError as error:
            refused = _error_text(error)
    return Report(topologies, comparison, refused, _versions())


def _versions() -> tuple[tuple[str, str], ...]:
    """Return the versions of the program and of its libraries."""
    result = list(versions())
    for name in LIBRARIES:
        try:
            result.append(versions(name)[1])
        except ImportError:
            result.append((name, "not installed"))
    return tuple(result)


def _topology(path: Path, model: Model, settings: Sequence[str]) -> TopologyReport:
    """Return the report of one topology, with all sections."""
    words = " ".join(f"--set {shlex.quote(text)}" for text in settings)
    call = f"{shlex.quote(path.name)} {words}".strip()
    section_builders: tuple[tuple[str, Callable[[Model, str], Section]], ...] = (
        ("compiled", _compiled),
        ("verdict", _verdict),
        ("limits", _limits),
        ("region", _region),
        ("response", _response),
        ("network", _network),
        ("transparency", _transparency),
    )
    sections = []
    for key, make in section_builders:
        try:
            sections.append(make(model, call))
        except ApcError as error:
            sections.append(Section(key, "", refused=_error_text(error)))
    texts = tuple(_texts(model))
    description = (model.name, model.description, path)
    return TopologyReport(*description, tuple(settings), texts, model.origin.digests, tuple(sections))


def _error_text(error: ApcError) -> str:
    """Return the text of the first mistake of an error, without its location."""
    mistake = error.mistakes[0]
    requested = f": expected {mistake.expected}, got {mistake.got}" if mistake.expected else ""
    return f"{mistake.message}{requested}"


def _texts(model: Model) -> Iterable[tuple[str, str]]:
    """Yield the names and texts of a topology's own files: the topology, its tables, its components."""
    for name, text in model.origin.texts:
        if PurePath(name).suffix and not name.endswith("/"):
            yield name, text.decode()


# ---- the sections ----


def _compiled(model: Model, call: str) -> Section:
    """Return the section of the compiled model: warnings, unused items, and size."""
    remarks = [f"Warning: {warning}" for warning in model.warnings]
    remarks += [f"omitted: {name}, as {reason}" for name, reason in model.dropped]
    return Section("compiled", f"apc compile {call.split(' --set')[0]}", tuple(remarks), (model_size(model),))


def _analysis(model: Model) -> tuple[AnalysisReport, str]:
    """Return the analysis, proved if possible, and the option for the proof."""
    try:
        return answer(model, certify=True), " --certify"
    except ApcError:
        return answer(model), ""


def _verdict(model: Model, call: str) -> Section:
    """Return the section of the verdict, with the eigenvalues as figure."""
    answer, option = _analysis(model)
    command = f"apc analyze {call}{option} --plot eigenvalues.svg"
    return Section("verdict", command, (), (answer,), (answer.analysis,))


def _limits(model: Model, call: str) -> Section:
    """Return the section of the critical stiffness and delay."""
    parameters = [(axis, choice.name, choice.why) for axis, choice in choose(model, ()).items()]
    return _criticals(model, call, "limits", [item for item in parameters if item[0] in (STIFFNESS, DELAY)])


def _network(model: Model, call: str) -> Section:
    """Return the section of the lossy network: mean-square stability, critical loss and jitter."""
    loss = choose(model, ())[LOSS]
    channels = [channel for link in model.links for channel in link.channels]
    names = dict.fromkeys(channel.jitter for channel in channels if channel.jitter is not None)
    jitters = [(JITTER, name, "") for name in names]
    return _criticals(
        model,
        call,
        "network",
        [(LOSS, loss.name, loss.why), *jitters],
        mean_square_stability(numeric_model(model)),
    )


def _criticals(
    model: Model,
    call: str,
    key: str,
    parameters: Sequence[tuple[str, str, str]],
    verdict: Result | None = None,
) -> Section:
    """Return a section of the values of parameters at which the verdict changes.

    Parameters
    ----------
    model, call
        The model, and the arguments of the commands.
    key
        The key of the section.
    parameters
        For each parameter its role, its name ("" if none), and the reason if there is none.
    verdict
        A verdict to be shown first.
    """
    remarks, plotted = [], []
    results: list[Result] = [] if verdict is None else [verdict]
    commands = [] if verdict is None else [f"apc analyze {call}"]
    for axis, name, why in parameters:
        try:
            result = critical(model, name) if name else None
        except ApcError as error:
            result, why = None, _error_text(error)
        if result is None:
            remarks.append(f"{axis}: {why}")
            continue
        stiff = axis == STIFFNESS
        commands.append(f"apc critical {name} {call}{f' --plot {axis}.svg' if stiff else ''}")
        results.append(result)
        plotted += [result] if stiff else []
    if not results:
        return Section(key, "", refused=" ".join(remarks))
    return Section(key, " && ".join(commands), tuple(remarks), tuple(results), tuple(plotted))


def _region(model: Model, call: str) -> Section:
    """Return the section of the stable region of two parameters."""
    axis_texts: list[str | None] = [None, None]
    if len(model.region) < 2:
        stiff = [
            parameter_ref
            for parameter_ref in coupler_parameters(model)
            if unit_of(model, parameter_ref.name) in STIFFNESSES
        ]
        if len(stiff) < 2:
            why = "fewer than two stiffnesses are common to all peers; the topology has no studies.region"
            return Section("region", "", refused=why)
        axis_texts = [
            f"{parameter_ref.label}=0 N/m:{FURTHER * parameter_of(model, parameter_ref).value or 1000:g} N/m"
            for parameter_ref in stiff[:2]
        ]
    unreliable = any(link.channel is not None for link in model.links)
    criterion = NOMINAL if unreliable else None
    axes = parse_axes(model, *axis_texts)
    result = region(numeric_model(model), axes, criterion=criterion)
    words = [f" --{axis} {shlex.quote(text)}" for axis, text in zip("xy", axis_texts, strict=True) if text]
    words += [f" --criterion {NOMINAL}"] if criterion else []
    command = f"apc region {call}{''.join(words)} --out region.svg"
    lossy = command.replace(f"--criterion {NOMINAL}", f"--criterion {MEAN_SQUARE}")
    text = f"The region is that of the nominal network. With packet loss and jitter: {lossy}"
    return Section("region", command, (text,) if unreliable else (), (result,), (result,))


def _response(model: Model, call: str) -> Section:
    """Return the section of the simulation; a model at rest is simulated with an impulse."""
    if model.peers > MOST_SIMULATED:
        why = (
            f"{counted(model.peers, 'peer', ',')} exceed the limit of {MOST_SIMULATED} for a "
            "simulation in a report"
        )
        return Section("response", "", refused=f"{why}; use apc simulate")
    duration, remarks = model.experiment.duration, []
    length = "" if duration else f" --duration {shlex.quote(f'{float(WATCHED):g} s')}"
    trajectory = simulate(model, duration=duration or WATCHED)
    if trajectory.summary.verdict is MotionVerdict.AT_REST:
        try:
            struck, subject = initial_velocity(model)
        except ApcError as error:
            remarks.append(_error_text(error))
        else:
            remarks.append(f"The initial state is at rest: {impulse_text(subject)}")
            length += f" --impulse {shlex.quote(subject.partition('.')[0])}"
            trajectory = simulate(struck, duration=duration or WATCHED)
    command = f"apc simulate {call}{length} --plot run.svg"
    return Section("response", command, tuple(remarks), (trajectory,), (trajectory,))


def _transparency(model: Model, call: str) -> Section:
    """Return the section of the transparency."""
    low, count = TRANSPARENCY
    frequencies = read_frequencies(model, None, low, None, count)
    result = transparency(numeric_model(model), frequencies)
    return Section(
        "transparency",
        f"apc transparency {call} --points {count} --out transparency.svg",
        (),
        (result,),
        (result,),
    )


# ---- recomputed reports ----


def differences(before: Any, now: Any) -> Iterator[str]:
    """Yield texts on the differences between plain data stored in a report and the same data recomputed.

    Texts differ if they are not equal; numbers if the difference exceeds rounding and their errors.
    """
    stored, recomputed = dict(_leaves(before)), dict(_leaves(now))
    for name in {**stored, **recomputed}:
        cell, new_error = recomputed.get(name, (None, 0.0))
        old, stored_error = stored.get(name, (None, 0.0))
        numbers = isinstance(cell, int | float) and isinstance(old, int | float)
        if cell != old and not (
            numbers and abs(cell - old) <= max(SAME * abs(cell), new_error + stored_error)
        ):
            yield f"{name} is {_shown(cell)}, not {_shown(old)}"


def _leaves(data: Any, name: str = "", error: float = 0.0) -> Iterator[tuple[str, tuple[Any, float]]]:
    """Yield the numbers and texts in nested lists and mappings by path, with their error.

    Entries that are errors themselves are omitted. `error` is the error of the enclosing level.
    """
    if isinstance(data, Mapping):
        errors = (
            item for key, item in data.items() if key.endswith("error") and isinstance(item, int | float)
        )
        error = sum(errors) or error
        for key, item in data.items():
            if "error" not in key:
                yield from _leaves(item, f"{name}.{key}" if name else key, error)
    elif isinstance(data, list):
        sizes = [abs(item) for item in data if isinstance(item, int | float)]
        for index, item in enumerate(data):
            yield from _leaves(item, f"{name}[{index + 1}]", max(error, NOTHING * max(sizes, default=0.0)))
    else:
        yield name, (data, error)


def _shown(cell: Any) -> str:
    """Return the text of a number or a text."""
    return f"{cell:.12g}" if isinstance(cell, float) else "nothing" if cell is None else str(cell)
