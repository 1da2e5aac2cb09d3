"""The columns of a recording as signals of a model, and as forces that act on its parts.

Takes: a `Model`, a `MeasuredTable` or a `RealtimeRun`.
Gives: `recorded_signals`, `signals_of_run`, `RecordedSignals`.
Guarantees: a force acts as by a `TableForce`: linear between the rows. Every column is used, or refused.
Does not: simulate.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Clock, Model, Parameter, PeerColumn, PeerType, Timing
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.interpolation import Interpolation, function_of
from apc.compiler.language.units import parse_unit
from apc.extensions.parameter_fit.measured_columns import MeasuredColumn, MeasuredTable
from apc.lifting.devices import Device, coupled_directly, find_devices, rewritten
from apc.linearization.jacobians import jacobians, structural_pattern
from apc.parameter_values.parameters import resolve
from apc.realtime.peer import live_topology
from apc.realtime.peer_run import RealtimeRun
from apc.realtime.run_comparison import reason_not_simulated
from apc.simulation.settings import Settings
from apc.simulation.signals import Signal
from apc.simulation.simulation import prepare

Floats = NDArray[np.float64]

CLOCK = "recording"  # the clock of a topology without clocks: a row for each row of the recording
_FORCE = re.compile(r"(?P<part>[\w.]+)\.force(\[\d+\])?\Z")  # the parameter of a constant force


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSignals:
    """A recording related to a model: the model with the recorded forces, and the measured signals.

    `values` (rows, signals) are in SI, at `times` (rows,) in seconds, until `duration`; `forces` are the
    columns that act as forces. `run` is the run that was recorded, None for a table; `start` is the recorded
    time of the first row in seconds.
    """

    system: Model
    times: Floats
    duration: Fraction
    signals: tuple[Signal, ...]
    values: Floats
    forces: tuple[str, ...] = ()
    run: RealtimeRun | None = None
    start: float = 0.0


@dataclass(frozen=True, slots=True)
class _Input:
    """A force input of a peer: a constant force with its parameter, or a part.

    `peer` is the number in the group, from 0; `parameter` is "" for a part.
    """

    group: int
    peer: int
    part: str
    parameter: str


def recorded_signals(system: Model, table: MeasuredTable, patterns: Sequence[str] = ()) -> RecordedSignals:
    """Return the measured signals of a recording, and the model with its forces.

    Parameters
    ----------
    system
        The model.
    table
        The recording. A column is named by a signal of `simulate`, by a hand with a constant force, which it
        replaces, or by a part, on which it acts. A name needs the peer only where several peers have it.
    patterns
        Patterns of the measured signals to use; by default all.

    Raises
    ------
    ApcError
        E711 a column is unknown, ambiguous or has another unit; no column is measured.
    """
    system = _with_clock(system, table.interval)
    signals = prepare(system, Settings(table.interval, jit=False)).signals
    inputs = [
        _Input(index, peer, part, parameter)
        for index, group in enumerate(system.groups)
        for part, parameter in _inputs(system, system.peer_types[group.peer_type])
        for peer in range(group.count)
    ]
    signal_names = _by_name((signal.group, signal.peer, signal.local) for signal in signals)
    input_names = _by_name((system.groups[item.group].name, item.peer + 1, item.part) for item in inputs)
    measured: dict[int, MeasuredColumn] = {}
    forces: dict[_Input, MeasuredColumn] = {}
    for column in table.columns:
        known = signal_names if column.name in signal_names else input_names
        if column.name not in known:
            expected = "a signal of apc simulate, a hand with a constant force, or a part"
            near = nearest(column.name, [*input_names, *signal_names])
            raise _fault(table, f"column {column.name}", expected, "an unknown name", near)
        if len(known[column.name]) > 1:
            first = known[column.name][:1]
            fix = next(name for name, indices in known.items() if indices == first)
            message = f"{len(known[column.name])} peers with this name"
            raise _fault(table, f"column {column.name}", "the name of one peer's signal", message, fix)
        (index,) = known[column.name]
        unit = signals[index].unit if known is signal_names else "N"
        if column.unit.dimension != parse_unit(unit, SourceLocation("")).dimension:
            fix = f"{column.name} [{unit}]"
            raise _fault(table, f"unit of column {column.name}", unit, column.unit.text, fix)
        if index in measured if known is signal_names else inputs[index] in forces:
            raise _fault(table, f"column {column.name}", "one column", "two with this meaning")
        if known is signal_names:
            measured[index] = column
        else:
            forces[inputs[index]] = column
    used = [index for index in measured if not patterns or _matches(signals[index].name, patterns)]
    if not used:
        got = ", ".join(column.name for column in table.columns[:6]) or "none"
        raise _fault(table, "columns", "a measured signal", got, signals[0].heading)
    return RecordedSignals(
        system=_with_forces(system, forces, table.times) if forces else system,
        times=table.times,
        duration=(table.rows - 1) * table.interval,
        signals=tuple(signals[index] for index in used),
        values=np.stack([measured[index].numbers for index in used], axis=1),
        forces=tuple(column.name for column in forces.values()),
        start=table.start,
    )


def signals_of_run(system: Model, run: RealtimeRun, patterns: Sequence[str] = ()) -> RecordedSignals:
    """Return the recorded signals of all peers of a run, and the model with the network of the run.

    Parameters
    ----------
    system
        The model.
    run
        The run.
    patterns
        As for `recorded_signals`.

    Raises
    ------
    ApcError
        E711 no signal matches, E713 the run is of another topology, or can't be simulated.
    """
    location = SourceLocation(run.folder)
    if _structure(system) != _structure(run.system):
        message = f"the run is of another topology than {system.name}"
        raise ApcError(Diagnostic("E713", location, message, fix=f"apc run {system.origin.topology}"))
    if reason := reason_not_simulated(run.system, run.peers):
        advice = "use a table of the measured force and motion"
        raise ApcError(Diagnostic("E713", location, f"the run can't be repeated: {reason}", advice=advice))
    live = live_topology(system)
    rows = min(len(peer.time) for peer in run.peers)
    columns = {
        name: column
        for peer in run.peers
        for name, column in zip(peer.signals, peer.values[:rows].T, strict=True)
        if not patterns or _matches(name, patterns)
    }
    signals = prepare(live, Settings(Fraction(1, 1000), jit=False)).signals
    used = tuple(signal for signal in signals if signal.name in columns)
    if not used:
        fix = f"--signals {signals[0].name}"
        raise ApcError(Diagnostic("E711", location, "no signal matches", fix=fix))
    return RecordedSignals(
        system=live,
        times=run.peers[0].time[:rows],
        duration=Fraction(float(run.peers[0].time[rows - 1])).limit_denominator(10**6),
        signals=used,
        values=np.stack([columns[signal.name] for signal in used], axis=1),
        run=run,
    )


def _structure(system: Model) -> tuple[Any, ...]:
    """Return the peers, clocks, links and times of a model, which a run has in common with its topology."""
    peers = tuple((group.name, group.count) for group in system.groups)
    states = tuple(peer_type.states for peer_type in system.peer_types)
    clocks = tuple((clock.name, clock.period, clock.phase) for clock in system.clocks)
    return peers, states, clocks, tuple(link.name for link in system.links), system.timings


def _with_clock(system: Model, interval: Fraction) -> Model:
    """Return a model that has rows at the instants of a recording, if it has no clocks."""
    if system.clocks:
        return system
    names = f"{CLOCK} period", f"{CLOCK} phase"
    timings = (Timing(names[0], interval), Timing(names[1], Fraction(0)))
    return replace(system, clocks=(Clock(CLOCK, *names),), timings=(*system.timings, *timings))


def _by_name(items: Iterable[tuple[str, int, str]]) -> dict[str, list[int]]:
    """Return the indices of items (group, peer, name) by name: with the peer, with the group, and alone."""
    result: dict[str, list[int]] = {}
    for index, (group, peer, local) in enumerate(items):
        for name in (f"{group}[{peer}].{local}", f"{group}.{local}", local):
            result.setdefault(name, []).append(index)
    return result


def _matches(name: str, patterns: Sequence[str]) -> bool:
    """Return whether a signal's name, with or without its peer, matches a pattern."""
    names = (name, name.partition("].")[2])
    return any(fnmatchcase(text, pattern.replace("[", "[[]")) for text in names for pattern in patterns)


def _inputs(system: Model, peer_type: PeerType) -> Iterator[tuple[str, str]]:
    """Yield the force inputs of a peer type by name: constant forces with their parameter, and parts."""
    units = {parameter.name: parameter.unit for parameter in system.parameters}
    for index, name in enumerate(peer_type.parameters):
        force = _FORCE.fullmatch(name)
        if force and units[name] == "N" and _is_constant_force(peer_type, index):
            yield (name if force[2] else force["part"]), name
    for state in peer_type.states:
        if state.unit == "m":
            yield (state.name if state.name.endswith("]") else state.name.rpartition(".")[0]), ""


def _is_constant_force(peer_type: PeerType, index: int) -> bool:
    """Return whether a parameter acts on the rates alone, with a constant factor, as a force."""
    if not _is_plain(peer_type):
        return False
    x, u, p, t = peer_type.derivative.sx_in()
    effect = casadi.jacobian(peer_type.derivative(x, u, p, t), p[index])
    functions = [*(clock.tick for clock in peer_type.clocks), *(send.send for send in peer_type.sends)]
    patterns = (structural_pattern(function.jac_sparsity(0, function.n_in() - 2)) for function in functions)
    elsewhere = any(pattern[:, index].any() for pattern in patterns)
    return (
        bool(effect.nnz())
        and not casadi.depends_on(effect, casadi.vertcat(x, u, p[index], t))
        and not elsewhere
    )


def _is_plain(peer_type: PeerType) -> bool:
    """Return whether a peer type can be rewritten: none of its functions contains a solver."""
    functions = [clock.tick for clock in peer_type.clocks] + [send.send for send in peer_type.sends]
    return all(function.is_a("SXFunction") for function in (peer_type.derivative, *functions))


def _with_forces(system: Model, forces: dict[_Input, MeasuredColumn], times: Floats) -> Model:
    """Return a model with recorded forces, linear between their rows.

    A force acts on its peer: its share, a parameter, is 1 there and 0 at other peers of the same type.
    """
    shares = {item: f"share of {column.name}" for item, column in forces.items()}
    groups = []
    for index, group in enumerate(system.groups):
        columns = list(group.columns)
        for item, share in shares.items():
            if item.group == index:
                columns.append(PeerColumn(share, np.eye(group.count)[item.peer]))
        groups.append(replace(group, columns=tuple(columns)))
    peer_types = list(system.peer_types)
    for number, peer_type in enumerate(system.peer_types):
        own = {item: name for item, name in shares.items() if system.groups[item.group].peer_type == number}
        if own:
            tables = {item: function_of(Interpolation(times, forces[item].numbers)) for item in own}
            effects = {item: _effect(system, peer_type, item) for item in own}
            peer_types[number] = _forced(peer_type, own, tables, effects)
    parameters = (*system.parameters, *(Parameter(name, "1", 0.0) for name in shares.values()))
    return replace(system, peer_types=tuple(peer_types), parameters=parameters, groups=tuple(groups))


def _effect(system: Model, peer_type: PeerType, item: _Input) -> Device | None:
    """Return the part that a force acts on, None for a constant force. Raises ApcError E711."""
    if item.parameter:
        return None
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    numbers = resolve(system)
    vector = numbers.parameters[item.group][numbers.rows[item.group][item.peer]]
    direct = coupled_directly(system.peer_types)
    found = find_devices(jacobians(peer_type), vector, unit_of, part=item.part, direct=direct)
    device = found.get(item.part)
    if not isinstance(device, Device):
        message = f"force on {item.part}: {device or 'its mass does not follow from linear equations'}"
        fix = f"hands: {{hand: {{type: ConstantForce, flange: {item.part}, force: 0 N}}}}"
        raise ApcError(Diagnostic("E711", SourceLocation(system.origin.topology), message, fix=fix))
    return device


def _forced(
    peer_type: PeerType,
    shares: dict[_Input, str],
    tables: dict[_Input, Any],
    effects: dict[_Input, Device | None],
) -> PeerType:
    """Return a peer type with forces from tables, each times its share."""
    count = len(peer_type.parameters)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        """Return the rates with the recorded forces."""
        numbers, added = casadi.vertsplit(p[:count]), [casadi.SX(0)] * len(peer_type.states)
        for index, item in enumerate(shares):
            force, share, device = tables[item](t), p[count + index], effects[item]
            if device is None:
                row = peer_type.parameters.index(item.parameter)
                numbers[row] += share * (force - numbers[row])
            else:
                added[device.velocity] += share * force * device.symbolic(x, u, p[:count], t)
        return peer_type.derivative(x, u, casadi.vertcat(*numbers), t) + casadi.vertcat(*added)

    extended = replace(peer_type, parameters=(*peer_type.parameters, *shares.values()), linear=None)
    return rewritten(extended, peer_type, lambda x, p: x, rates)


def _fault(table: MeasuredTable, message: str, expected: str, got: str, fix: str = "") -> ApcError:
    """Return the error E711 of a column."""
    return ApcError(Diagnostic("E711", SourceLocation(table.file), message, expected, got, fix))
