"""What a report of scenes holds: the answers of the other commands, each with its table and its command.

Takes: topologies and settings.
Gives: `Table`, `Section`, `SceneReport`, `Report`; `report`; `differences`.
Guarantees: every number is that of the command beside it; a section that a scene can't fill says why. A
report keeps the scene's own texts, so that it can be computed anew from itself alone.
Does not: draw, or write files (see `present.report`).
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from operator import attrgetter
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from apc.analysis.needs import needs
from apc.answer import Answer, answer
from apc.comparison.choice import DELAY, LOSS, STIFFNESS, choose
from apc.comparison.comparison import Comparison, compare
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.compiler.words import counted, with_unit
from apc.distribution import versions
from apc.eigen.spectrum import Mode
from apc.frame.names import parameter_of, unit_of
from apc.frame.overrides import apply, parse_override
from apc.hands.asked import read_frequencies
from apc.hands.feel import feel
from apc.inputs import open_scene
from apc.moments.network import judge_network
from apc.regions.axes import parse_axes
from apc.regions.region import region
from apc.result import Result
from apc.simulation.trajectory import simulate
from apc.vary.critical import critical
from apc.vary.growth import MEAN_SQUARE, NOMINAL
from apc.vary.locus import root_locus
from apc.vary.margins import STIFFNESSES, coupler_parameters

Cell = str | float | int | None

LIBRARIES = ("casadi", "numpy", "scipy", "sympy", "python-flint", "matplotlib")
MODES = ("magnitude", "error", "times", "frequency [Hz]", "shape", "moves most")
MOST_MODES, MOST_SIGNALS, MOST_PLAYED = 12, 40, 60  # rows of a table; peers that are played
JITTER = "jitter"
FURTHER = 3  # times the present value a region reaches where the scene says no range
SECONDS = Fraction(1)  # that a scene is played, where it doesn't say how long
PUSH = "0.1 m/s"  # with which a device starts in a scene that is at rest
FEEL = ("0.1 Hz", 200)  # the lowest frequency, and how many
SHOWN = 9  # frequencies of the table
# Numbers computed anew, on another processor or by other libraries, are the same up to this, relatively, and
# by as much as their own errors; of what is next to nothing beside its column nothing is known.
SAME, NOTHING = 1e-6, 1e-9


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells below headings; a number in a column called "error" bounds the one before it."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report: sentences, tables, and `drawn`, results of which `present.report` has pictures.

    `refused` says why there is nothing else.
    """

    key: str
    command: str
    told: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    drawn: tuple[Any, ...] = ()
    refused: str = ""


@dataclass(frozen=True, slots=True)
class SceneReport:
    """All of one scene: `texts` are its own files by name, `origin` the digests of all it is made of."""

    name: str
    about: str
    path: Path
    settings: tuple[str, ...]
    texts: tuple[tuple[str, str], ...]
    origin: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]


@dataclass(frozen=True, slots=True)
class Report(Result):
    """Scenes side by side; `comparison` is there where they are several."""

    shown_by = "report:report"

    scenes: tuple[SceneReport, ...]
    comparison: Comparison | None
    refused: str
    versions: tuple[tuple[str, str], ...]


@part("report")
def report(paths: Sequence[Path], settings: Sequence[str] = ()) -> Report:
    """Gather what is known of scenes.

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
    systems = [open_scene(str(path), settings) for path in paths]
    scenes = tuple(_scene(path, system, settings) for path, system in zip(paths, systems, strict=True))
    beside, refused = None, ""
    if len(systems) > 1:
        try:
            beside = compare(systems)
        except ApcError as error:
            refused = _why(error)
    return Report(scenes, beside, refused, _versions())


def _versions() -> tuple[tuple[str, str], ...]:
    """Return the versions of the program and of those libraries that are there."""
    found = list(versions())
    for name in LIBRARIES:
        try:
            found.append(versions(name)[1])
        except ImportError:
            found.append((name, "not installed"))
    return tuple(found)


def _scene(path: Path, system: CompiledSystem, settings: Sequence[str]) -> SceneReport:
    words = " ".join(f"--set {shlex.quote(text)}" for text in settings)
    call = f"{shlex.quote(path.name)} {words}".strip()
    made: tuple[tuple[str, Callable[[CompiledSystem, str], Section]], ...] = (
        ("compiled", _compiled),
        ("verdict", _verdict),
        ("limits", _limits),
        ("region", _region),
        ("response", _response),
        ("network", _network),
        ("feel", _feel),
    )
    sections = []
    for key, make in made:
        try:
            sections.append(make(system, call))
        except ApcError as error:
            sections.append(Section(key, "", refused=_why(error)))
    texts = tuple(_texts(system))
    about = (system.name, system.about, path)
    return SceneReport(*about, tuple(settings), texts, system.origin.digests, tuple(sections))


def _why(error: ApcError) -> str:
    """Return the first mistake in words."""
    one = error.mistakes[0]
    wanted = f" wants {one.expected}, got {one.got}" if one.expected else ""
    return f"{one.what}{wanted}"


def _texts(system: CompiledSystem) -> Iterable[tuple[str, str]]:
    """Yield the texts of a scene's own: the topology, its tables, its components."""
    for name, text in system.origin.texts:
        if PurePath(name).suffix and not name.endswith("/"):
            yield name, text.decode()


# ---- the sections ----


def _compiled(system: CompiledSystem, call: str) -> Section:
    found = needs(system)
    told = [f"Warning: {one}" for one in system.warnings]
    told += [f"left out: {name}, as {reason}" for name, reason in system.dropped]
    facts: tuple[tuple[str, Cell], ...] = (
        ("peers", system.peers),
        ("frame [s]", float(found.frame)),
        ("method", found.method),
        *((f"ticks of {name} in a frame", count) for name, count in found.ticks),
    )
    kept = map(attrgetter("name", "states", "motion", "remembered", "packets"), found.sites)
    tables = (
        Table("The scene", ("what", "value"), facts),
        Table("What a peer keeps", ("kind", "states", "motion", "delayed", "on the network"), tuple(kept)),
    )
    return Section("compiled", f"apc compile {call.split(' --set')[0]}", tuple(told), tables)


def _answered(system: CompiledSystem) -> tuple[Answer, str]:
    """Return the analysis, proved where that can be had, and the option that proves it."""
    try:
        return answer(system, certify=True), " --certify"
    except ApcError:
        return answer(system), ""


def _verdict(system: CompiledSystem, call: str) -> Section:
    found, option = _answered(system)
    one, network = found.analysis, found.network
    rows: list[tuple[Cell, ...]] = [
        ("verdict", one.verdict, None),
        ("spectral radius a frame", one.spectral_radius, one.spectral_radius_error),
        ("settles within 2 % in [s]", one.settling_s, None),
        ("motions left out", one.rigid_modes, None),
    ]
    rows += [] if network is None else [("over the network as it is", network.verdict.verdict, None)]
    told = [f"Proof: {one.proof or 'none; floats with proved bounds decide'}.", *one.notes, *one.left_out]
    told += [] if found.switching is None else [" ".join(str(found.switching).split())]
    of = network or found
    notes = (("Margins", of.margins.note), ("What moves the radius", of.sensitivities.note))
    told += [f"{what}: {note}" for what, note in notes if note]
    slowest = [mode for mode in one.modes if mode.magnitude > mode.error + NOTHING]
    slowest = [mode for mode in slowest if mode.eigenvalue.imag >= -mode.error]
    moved = [row for row in of.sensitivities.rows if row.relative]
    grow = attrgetter("parameter", "unit", "present", "value", "error", "note")
    tables = (
        Table("Verdict", ("what", "value", "error"), tuple(rows)),
        Table("Modes, the slowest first", MODES, tuple(map(_mode, slowest[:MOST_MODES]))),
        Table(
            "May grow",
            ("parameter", "unit", "from", "to", "error", "note"),
            tuple(map(grow, of.margins.rows)),
        ),
        Table(
            "What moves the radius most",
            ("parameter", "unit", "value", "change for 100 %", "eigenvalue"),
            tuple((row.parameter, row.unit, row.value, row.relative, row.mode + 1) for row in moved),
        ),
    )
    shown = tuple(table for table in tables if table.rows)
    command = f"apc analyze {call}{option} --plot eigenvalues.svg"
    return Section("verdict", command, tuple(told), shown, (one,))


def _mode(mode: Mode) -> tuple[Cell, ...]:
    """Return a row: the mode, and the two states that it moves most."""
    most = sorted(mode.participation, key=lambda one: -round(one[1], 2))[:2]
    moves = ", ".join(f"{name} {share:.0%}" for name, share in most)
    frequency = None if math.isnan(mode.frequency_hz) else mode.frequency_hz
    return mode.magnitude, mode.error, mode.multiplicity, frequency, mode.shape, moves


def _limits(system: CompiledSystem, call: str) -> Section:
    return _criticals(system, call, "limits", (STIFFNESS, DELAY))


def _network(system: CompiledSystem, call: str) -> Section:
    found = _criticals(system, call, "network", (LOSS,))
    judged = judge_network(system)
    if judged is None:
        return found
    rows = (
        ("verdict", judged.verdict, None),
        ("mean squares grow a frame by", judged.mean_square_radius, judged.error),
        ("copies apart, hands pushing 1 N rms [m]", judged.rms_error_m, None),
    )
    table = Table("Over the network as it is", ("what", "value", "error"), rows)
    told = (*found.told, *([found.refused] if found.refused else []), *judged.notes)
    command = " && ".join(one for one in (f"apc analyze {call}", found.command) if one)
    return replace(found, command=command, told=told, tables=(table, *found.tables), refused="")


def _criticals(system: CompiledSystem, call: str, key: str, axes: Sequence[str]) -> Section:
    """Return where the verdict changes along what `apc compare` looks at."""
    rows: list[tuple[Cell, ...]] = []
    told, commands, drawn = [], [], []
    asked = [(axis, one.name, one.why) for axis, one in choose(system, ()).items() if axis in axes]
    channels = [link.channel for link in system.links if link.channel is not None and LOSS in axes]
    asked += [(JITTER, one.jitter, "") for one in channels if one.jitter is not None]
    for axis, name, why in asked:
        if not name:
            told.append(f"{axis}: {why}")
            continue
        try:
            found = critical(system, name)
        except ApcError as error:
            told.append(f"{axis}: {_why(error)}")
            continue
        plotted = f" --plot {axis}.svg" if axis == STIFFNESS else ""
        commands.append(f"apc critical {name} {call}{plotted}")
        crossings = map(attrgetter("value", "error", "stable_side", "frequency_hz"), found.crossings)
        rows += [(found.parameter, found.unit, *one) for one in crossings]
        low, high = (with_unit(f"{one:.6g}", found.unit) for one in found.scanned)
        said = f": {found.verdict}" if found.verdict else ""
        told.append(f"{found.parameter} is looked at from {low} to {high}{said}.")
        drawn += [root_locus(system, found)] if axis == STIFFNESS else []
    columns = ("parameter", "unit", "changes at", "error", "stable", "frequency [Hz]")
    tables = (Table("Where the verdict changes", columns, tuple(rows)),) if rows else ()
    refused = "" if commands else " ".join(told)
    return Section(key, " && ".join(commands), tuple(told) if commands else (), tables, tuple(drawn), refused)


def _region(system: CompiledSystem, call: str) -> Section:
    asked: list[str | None] = [None, None]
    if len(system.region) < 2:
        stiff = [one for one in coupler_parameters(system) if unit_of(system, one.name) in STIFFNESSES]
        if len(stiff) < 2:
            why = "the scene has fewer than two stiffnesses, and says no studies: region:"
            return Section("region", "", refused=why)
        asked = [
            f"{one.label}=0 N/m:{FURTHER * parameter_of(system, one).value or 1000:g} N/m"
            for one in stiff[:2]
        ]
    unreliable = any(link.channel is not None for link in system.links)
    criterion = NOMINAL if unreliable else None
    found = region(system, parse_axes(system, *asked), criterion=criterion)
    words = [f" --{axis} {shlex.quote(text)}" for axis, text in zip("xy", asked, strict=True) if text]
    words += [f" --in {NOMINAL}"] if criterion else []
    rows = [
        (place + 1, curve.mode, *curve.frequency_hz, curve.error, len(curve.points))
        for place, curve in enumerate(found.curves)
    ]
    whole = float((found.x.high - found.x.low) * (found.y.high - found.y.low))
    area = [("stable share of the rectangle", found.stable_area / whole, found.stable_area_error / whole)]
    tables = [Table("The region", ("what", "value", "error"), tuple(area))]
    columns = ("curve", "mode", "from [Hz]", "to [Hz]", "error", "points")
    tables += [Table("Its boundary", columns, tuple(rows))] if rows else []
    command = f"apc region {call}{''.join(words)} --out region.svg"
    told = list(found.left_out)
    if unreliable:
        lossy = command.replace(f"--in {NOMINAL}", f"--in {MEAN_SQUARE}")
        told.append(f"Stable here means with every packet on time. As they are lost and late: {lossy}")
    return Section("region", command, tuple(told), tuple(tables), (found,))


def _response(system: CompiledSystem, call: str) -> Section:
    if system.peers > MOST_PLAYED:
        why = f"{counted(system.peers, 'peer', ',')} are more than the {MOST_PLAYED} that a report plays"
        return Section("response", "", refused=f"{why}; apc simulate does")
    duration, told = system.experiment.duration, []
    length = "" if duration else f" --duration {shlex.quote(f'{float(SECONDS):g} s')}"
    found = simulate(system, duration=duration or SECONDS)
    if found.summary.verdict == "rests" and (push := _push(system)):
        told.append(f"At rest as it stands: here it starts with {push}.")
        length += f" --set {shlex.quote(push)}"
        pushed = apply(system, [parse_override(system, push)])
        found = simulate(pushed, duration=duration or SECONDS)
    summary = found.summary
    rows = [*map(attrgetter("name", "unit", "first", "last", "low", "high", "settled"), summary.extents)]
    told.append(f"It {summary.verdict}.")
    if len(rows) > MOST_SIGNALS:
        told.append(f"{MOST_SIGNALS} of {len(rows)} signals are listed.")
    columns = ("signal", "unit", "first", "last", "least", "most", "settled at [s]")
    table = Table("Over time", columns, tuple(rows[:MOST_SIGNALS]))
    return Section("response", f"apc simulate {call}{length} --plot run.svg", tuple(told), (table,), (found,))


def _push(system: CompiledSystem) -> str:
    """Return the setting that gives the first body of the first group a start velocity."""
    group = system.groups[0]
    starts = [state.start for state in system.kinds[group.kind].states if state.unit == "m/s"]
    name = f"{group.name}.{starts[0]}" if starts and len(system.groups) > 1 else "".join(starts[:1])
    return f"{name}={PUSH}" if name else ""


def _feel(system: CompiledSystem, call: str) -> Section:
    low, count = FEEL
    found = feel(system, read_frequencies(system, None, low, None, count))
    places = sorted({round(one) for one in np.linspace(0, len(found.frequency_hz) - 1, SHOWN)})
    size = np.abs(found.impedance)
    columns = (found.frequency_hz, size, size * found.bound, np.degrees(np.angle(found.impedance)))
    rows = np.stack(columns, axis=1)[places].tolist()
    headings = ("frequency [Hz]", "impedance [N*s/m]", "error", "phase [°]")
    tables = [Table(f"Felt at {found.at}", headings, tuple(map(tuple, rows)))]
    if (slow := found.low_frequency) is not None:
        names = ("mass [kg]", "damping [N*s/m]", "stiffness [N/m]")
        values = zip(names, (slow.mass, slow.damping, slow.stiffness), slow.errors, strict=True)
        tables.append(Table("Of slow motions", ("what", "value", "error"), tuple(values)))
    told = (*found.notes, *found.left_out)
    command = f"apc feel {call} --points {count} --out feel.svg"
    return Section("feel", command, told, tuple(tables), (found,))


# ---- computed anew ----


def differences(before: Sequence[Any], now: Sequence[Any]) -> list[str]:
    """Say what differs between tables that a report keeps and the same computed anew, as plain data."""
    kept, made = ({one["title"]: one for one in tables} for tables in (before, now))
    told = [f"{title} is new" for title in made if title not in kept]
    told += [f"{title} is gone" for title in kept if title not in made]
    for title in [title for title in made if title in kept]:
        rows, others = made[title]["rows"], kept[title]["rows"]
        if [len(one) for one in rows] != [len(one) for one in others]:
            told.append(f"{title}: {counted(len(rows), 'row')}, not the {len(others)} that it has")
            continue
        for row, other in zip(rows, others, strict=True):
            told += (f"{title}: {one}" for one in _changed(made[title], row, other))
    return told


def _changed(table: Any, row: Sequence[Cell], before: Sequence[Cell]) -> Iterable[str]:
    """Yield what differs in a row: numbers by more than roundings and their own errors, words at all."""
    columns = table["columns"]
    for place, (name, cell, old) in enumerate(zip(columns, row, before, strict=True)):
        if name == "error" or cell == old:
            continue  # an error counts for the number before it
        if isinstance(cell, int | float) and isinstance(old, int | float):
            bounded = place + 1 < len(row) and columns[place + 1] == "error"
            errors = [row[place + 1], before[place + 1]] if bounded else []
            column = max(
                abs(float(one[place])) for one in table["rows"] if isinstance(one[place], int | float)
            )
            allowed = sum(one for one in errors if isinstance(one, int | float))
            if abs(cell - old) <= max(SAME * abs(cell), NOTHING * column, allowed):
                continue
        of = f" of {row[0]}" if place and isinstance(row[0], str) else ""
        yield f"{name}{of} is {_shown(cell)}, not {_shown(old)}"


def _shown(cell: Cell) -> str:
    return f"{cell:.12g}" if isinstance(cell, float) else "nothing" if cell is None else str(cell)
