"""The contents of a report of topologies: results of other commands, each with its command.

Takes: topologies and settings.
Gives: `Section`, `TopologyReport`, `Report`; `report`; `differences`.
Guarantees: every number is that of the command beside it; a section that a topology can't fill says why. A
report keeps the topology's own texts, so that it can be computed anew from itself alone.
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
from apc.comparison.choice import DELAY, LOSS, STIFFNESS, choose
from apc.comparison.comparison import SchemeComparison, compare
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.distribution import versions
from apc.frame.parameter_names import parameter_of, unit_of
from apc.haptics.device_port import read_frequencies
from apc.haptics.frequency_response import transparency
from apc.inputs import open_topology
from apc.mean_square.mean_square_stability import mean_square_stability
from apc.parameter_studies.critical_values import critical
from apc.parameter_studies.margins import STIFFNESSES, coupler_parameters
from apc.parameter_studies.stability_criteria import MEAN_SQUARE, NOMINAL
from apc.regions.axes import parse_axes
from apc.regions.stable_region import region
from apc.result import Result
from apc.simulation.initial_velocity import WATCHED, impulse_text, initial_velocity
from apc.simulation.motion_classes import MotionVerdict
from apc.simulation.trajectory import simulate

LIBRARIES = ("casadi", "numpy", "scipy", "sympy", "python-flint", "matplotlib")
MOST_SIMULATED = 60  # peers
JITTER = "jitter"
FURTHER = 3  # times the present value a region reaches where the topology says no range
TRANSPARENCY = ("0.1 Hz", 200)  # the lowest frequency, and how many
# Numbers computed anew, on another processor or by other libraries, are the same up to this, relatively, and
# by as much as their own errors; of what is next to nothing beside the others of a list nothing is known.
SAME, NOTHING = 1e-6, 1e-9


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report: `remarks`, `results` shown as text, and `figures`, results with a picture.

    `refused` is the reason if there is nothing else.
    """

    key: str
    command: str
    remarks: tuple[str, ...] = ()
    results: tuple[Result, ...] = ()
    figures: tuple[Any, ...] = ()
    refused: str = ""


@dataclass(frozen=True, slots=True)
class TopologyReport:
    """All of one topology: `texts` are its own files by name, `origin` the digests of all it is made of."""

    name: str
    description: str
    path: Path
    settings: tuple[str, ...]
    texts: tuple[tuple[str, str], ...]
    origin: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]


@dataclass(frozen=True, slots=True)
class Report(Result):
    """Topologies side by side; `comparison` is there where they are several."""

    shown_by = "report_output:report"

    topologies: tuple[TopologyReport, ...]
    comparison: SchemeComparison | None
    refused: str
    versions: tuple[tuple[str, str], ...]


@part("report")
def report(paths: Sequence[Path], settings: Sequence[str] = ()) -> Report:
    """Gather the results of topologies.

    Parameters
    ----------
    paths
        Topologies.
    settings
        Parameters to change first in all of them, each `NAME=QUANTITY`.

    Raises
    ------
    ApcError
        A file or a setting is at fault.
    """
    systems = [open_topology(str(path), settings) for path in paths]
    topologies = tuple(_topology(path, system, settings) for path, system in zip(paths, systems, strict=True))
    alongside, refused = None, ""
    if len(systems) > 1:
        try:
            alongside = compare(systems)
        except ApcError as error:
            refused = _why(error)
    return Report(topologies, alongside, refused, _versions())


def _versions() -> tuple[tuple[str, str], ...]:
    """Return the versions of the program and of those libraries that are there."""
    result = list(versions())
    for name in LIBRARIES:
        try:
            result.append(versions(name)[1])
        except ImportError:
            result.append((name, "not installed"))
    return tuple(result)


def _topology(path: Path, system: Model, settings: Sequence[str]) -> TopologyReport:
    words = " ".join(f"--set {shlex.quote(text)}" for text in settings)
    call = f"{shlex.quote(path.name)} {words}".strip()
    made: tuple[tuple[str, Callable[[Model, str], Section]], ...] = (
        ("compiled", _compiled),
        ("verdict", _verdict),
        ("limits", _limits),
        ("region", _region),
        ("response", _response),
        ("network", _network),
        ("transparency", _transparency),
    )
    sections = []
    for key, make in made:
        try:
            sections.append(make(system, call))
        except ApcError as error:
            sections.append(Section(key, "", refused=_why(error)))
    texts = tuple(_texts(system))
    description = (system.name, system.description, path)
    return TopologyReport(*description, tuple(settings), texts, system.origin.digests, tuple(sections))


def _why(error: ApcError) -> str:
    """Return the first mistake in words."""
    mistake = error.mistakes[0]
    requested = f" wants {mistake.expected}, got {mistake.got}" if mistake.expected else ""
    return f"{mistake.message}{requested}"


def _texts(system: Model) -> Iterable[tuple[str, str]]:
    """Yield the texts of a topology's own: the topology, its tables, its components."""
    for name, text in system.origin.texts:
        if PurePath(name).suffix and not name.endswith("/"):
            yield name, text.decode()


# ---- the sections ----


def _compiled(system: Model, call: str) -> Section:
    remarks = [f"Warning: {warning}" for warning in system.warnings]
    remarks += [f"left out: {name}, as {reason}" for name, reason in system.dropped]
    return Section(
        "compiled", f"apc compile {call.split(' --set')[0]}", tuple(remarks), (model_size(system),)
    )


def _answered(system: Model) -> tuple[AnalysisReport, str]:
    """Return the analysis, proved where that can be had, and the option that proves it."""
    try:
        return answer(system, certify=True), " --certify"
    except ApcError:
        return answer(system), ""


def _verdict(system: Model, call: str) -> Section:
    answer, option = _answered(system)
    command = f"apc analyze {call}{option} --plot eigenvalues.svg"
    return Section("verdict", command, (), (answer,), (answer.analysis,))


def _limits(system: Model, call: str) -> Section:
    requested = [(axis, choice.name, choice.why) for axis, choice in choose(system, ()).items()]
    return _criticals(system, call, "limits", [item for item in requested if item[0] in (STIFFNESS, DELAY)])


def _network(system: Model, call: str) -> Section:
    loss = choose(system, ())[LOSS]
    channels = [link.channel for link in system.links if link.channel is not None]
    jitters = [(JITTER, channel.jitter, "") for channel in channels if channel.jitter is not None]
    return _criticals(
        system, call, "network", [(LOSS, loss.name, loss.why), *jitters], mean_square_stability(system)
    )


def _criticals(
    system: Model,
    call: str,
    key: str,
    requested: Sequence[tuple[str, str, str]],
    verdict: Result | None = None,
) -> Section:
    """Return where the verdict changes along what `apc compare` looks at, behind a verdict that is known."""
    remarks, plotted = [], []
    results: list[Result] = [] if verdict is None else [verdict]
    commands = [] if verdict is None else [f"apc analyze {call}"]
    for axis, name, why in requested:
        try:
            result = critical(system, name) if name else None
        except ApcError as error:
            result, why = None, _why(error)
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


def _region(system: Model, call: str) -> Section:
    requested: list[str | None] = [None, None]
    if len(system.region) < 2:
        stiff = [free for free in coupler_parameters(system) if unit_of(system, free.name) in STIFFNESSES]
        if len(stiff) < 2:
            why = "all peers share fewer than two stiffnesses, and the topology says no studies: region:"
            return Section("region", "", refused=why)
        requested = [
            f"{free.label}=0 N/m:{FURTHER * parameter_of(system, free).value or 1000:g} N/m"
            for free in stiff[:2]
        ]
    unreliable = any(link.channel is not None for link in system.links)
    criterion = NOMINAL if unreliable else None
    result = region(system, parse_axes(system, *requested), criterion=criterion)
    words = [f" --{axis} {shlex.quote(text)}" for axis, text in zip("xy", requested, strict=True) if text]
    words += [f" --criterion {NOMINAL}"] if criterion else []
    command = f"apc region {call}{''.join(words)} --out region.svg"
    lossy = command.replace(f"--criterion {NOMINAL}", f"--criterion {MEAN_SQUARE}")
    text = f"Stable here means with every packet on time. As they are lost and late: {lossy}"
    return Section("region", command, (text,) if unreliable else (), (result,), (result,))


def _response(system: Model, call: str) -> Section:
    if system.peers > MOST_SIMULATED:
        why = f"{counted(system.peers, 'peer', ',')} are more than the {MOST_SIMULATED} that a report plays"
        return Section("response", "", refused=f"{why}; apc simulate does")
    duration, remarks = system.experiment.duration, []
    length = "" if duration else f" --duration {shlex.quote(f'{float(WATCHED):g} s')}"
    trajectory = simulate(system, duration=duration or WATCHED)
    if trajectory.summary.verdict is MotionVerdict.AT_REST:
        try:
            struck, subject = initial_velocity(system)
        except ApcError as error:
            remarks.append(_why(error))
        else:
            remarks.append(f"The start is at rest. Here {impulse_text(subject)}")
            length += f" --impulse {shlex.quote(subject.partition('.')[0])}"
            trajectory = simulate(struck, duration=duration or WATCHED)
    command = f"apc simulate {call}{length} --plot run.svg"
    return Section("response", command, tuple(remarks), (trajectory,), (trajectory,))


def _transparency(system: Model, call: str) -> Section:
    low, count = TRANSPARENCY
    result = transparency(system, read_frequencies(system, None, low, None, count))
    return Section(
        "transparency",
        f"apc transparency {call} --points {count} --out transparency.svg",
        (),
        (result,),
        (result,),
    )


# ---- computed anew ----


def differences(before: Any, now: Any) -> Iterator[str]:
    """Yield the differences between plain data stored in a report and the same data recomputed.

    Words differ if they are others; numbers by more than roundings and the errors that stand beside them.
    """
    stored, made = dict(_leaves(before)), dict(_leaves(now))
    for name in {**stored, **made}:
        cell, least = made.get(name, (None, 0.0))
        old, below = stored.get(name, (None, 0.0))
        numbers = isinstance(cell, int | float) and isinstance(old, int | float)
        if cell != old and not (numbers and abs(cell - old) <= max(SAME * abs(cell), least + below)):
            yield f"{name} is {_shown(cell)}, not {_shown(old)}"


def _leaves(data: Any, name: str = "", value: float = 0.0) -> Iterator[tuple[str, tuple[Any, float]]]:
    """Yield what is no list or mapping by its place, and how far off it may be, which no error is itself."""
    if isinstance(data, Mapping):
        errors = (
            item for key, item in data.items() if key.endswith("error") and isinstance(item, int | float)
        )
        value = sum(errors) or value
        for key, item in data.items():
            if "error" not in key:
                yield from _leaves(item, f"{name}.{key}" if name else key, value)
    elif isinstance(data, list):
        sizes = [abs(item) for item in data if isinstance(item, int | float)]
        for index, item in enumerate(data):
            yield from _leaves(item, f"{name}[{index + 1}]", max(value, NOTHING * max(sizes, default=0.0)))
    else:
        yield name, (data, value)


def _shown(cell: Any) -> str:
    return f"{cell:.12g}" if isinstance(cell, float) else "nothing" if cell is None else str(cell)
