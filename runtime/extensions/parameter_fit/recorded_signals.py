"""The columns of a recording as signals of a model, and as forces that act on its parts.

Takes: a `Model`, a `MeasuredTable` or a `RealtimeRun`.
Gives: `recorded_signals`, `signals_of_run`, `RecordedSignals`.
Guarantees: a force acts as by a `TableForce`: linear between the rows. Every column is used, or refused.
Does not: simulate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
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
from apc.linearization.jacobians import jacobians
from apc.parameter_values.parameters import resolve
from apc.realtime.peer import live_topology
from apc.realtime.peer_run import RealtimeRun
from apc.realtime.run_comparison import reason_not_simulated
from apc.simulation.settings import Settings
from apc.simulation.signals import Signal
from apc.simulation.simulation import prepare

Floats = NDArray[np.float64]

CLOCK = "recording"  # the clock of a topology without clocks: a row for each row of the recording
FORCE = ".force"  # the end of the name of a constant force, before the index of a vector


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSignals:
    """A recording related to a model: the model with the recorded forces, and the measured signals.

    `values` (rows, signals) are in SI, at `times` (rows,) in seconds, until `duration`; `forces` are the
    columns that act as forces. `run` is the run that was recorded, None for a table; `start` is the recorded
    time of the first row in seconds.
    """

    model: Model
    times: Floats
    duration: Fraction
    signals: tuple[Signal, ...]
    values: Floats
    forces: tuple[str, ...] = ()
    run: RealtimeRun | None = None
    start: float = 0.0


@dataclass(frozen=True, slots=True)
class _Target:
    """The meaning of a column: a measured signal, or a force on a peer, whose number is from 1.

    A force is a constant force with its `parameter`, or acts on the part `local`.
    """

    group: str
    peer: int
    local: str
    unit: str
    signal: Signal | None = None
    parameter: str = ""

    @property
    def names(self) -> tuple[str, str, str]:
        """The names of a column: with the peer, with the group, and alone."""
        return f"{self.group}[{self.peer}].{self.local}", f"{self.group}.{self.local}", self.local


def recorded_signals(model: Model, table: MeasuredTable, patterns: Sequence[str] = ()) -> RecordedSignals:
    """Return the measured signals of a recording, and the model with its forces.

    Parameters
    ----------
    model
        The model.
    table
        The recording. A column is named by a signal of `simulate`, by a hand with a constant force, which it
        replaces, or by a part, on which it acts. A name needs the peer only where several peers have it.
    patterns
        Patterns of the measured signals to use, as for `simulate`; by default all.

    Raises
    ------
    ApcError
        E711 a column is unknown, ambiguous or has another unit; no column is measured.
    """
    if not model.clocks:  # rows at the instants of the recording
        names = f"{CLOCK} period", f"{CLOCK} phase"
        times = Timing(names[0], table.interval), Timing(names[1], Fraction(0))
        model = replace(model, clocks=(Clock(CLOCK, *names),), timings=(*model.timings, *times))
    signals = prepare(model, Settings(table.interval, jit=False)).signals
    measurable = [_Target(one.group, one.peer, one.local, one.unit, one) for one in signals]
    known: dict[str, dict[_Target, None]] = {}
    for target in (*measurable, *_force_targets(model)):
        for name in target.names:
            known.setdefault(name, {})[target] = None
    columns: dict[_Target, MeasuredColumn] = {}
    for column in table.columns:
        targets, message = [*known.get(column.name, ())], f"column {column.name}"
        if not targets:
            expected = "a signal of apc simulate, a hand with a constant force, or a part"
            raise _fault(table.file, message, expected, "an unknown name", nearest(column.name, known))
        target = targets[0]
        if len(targets) > 1:
            got = f"the name of {len(targets)} peers"
            raise _fault(table.file, message, "the name of one peer's signal", got, target.names[0])
        if target in columns:
            raise _fault(table.file, message, "one column", "two with this meaning")
        if column.unit.dimension != parse_unit(target.unit, SourceLocation("")).dimension:
            fix = f"{column.name} [{target.unit}]"
            raise _fault(table.file, f"unit of {message}", target.unit, column.unit.text, fix)
        columns[target] = column
    used = {one.signal: column.numbers for one, column in columns.items() if one.signal}
    forces = {one: column.numbers for one, column in columns.items() if not one.signal}
    recorded = RecordedSignals(
        model=_with_forces(model, forces, table.times) if forces else model,
        times=table.times,
        duration=table.interval * (len(table.times) - 1),
        signals=tuple(used),
        values=np.array([*used.values()]).T,
        forces=tuple(columns[target].name for target in forces),
        start=table.start,
    )
    return _selected(recorded, patterns, table.file, signals[0])


def signals_of_run(model: Model, run: RealtimeRun, patterns: Sequence[str] = ()) -> RecordedSignals:
    """Return the recorded signals of all peers of a run, and the model with the network of the run.

    Parameters
    ----------
    model
        The model.
    run
        The run.
    patterns
        As for `recorded_signals`.

    Raises
    ------
    ApcError
        E713 the run is of another topology, or can't be simulated.
    """
    live = live_topology(model)
    signals = {one.name: one for one in prepare(live, Settings(Fraction(1, 1000), jit=False)).signals}
    rows = min(len(peer.time) for peer in run.peers)
    columns = {
        name: column
        for peer in run.peers
        for name, column in zip(peer.signals, peer.values[:rows].T, strict=True)
    }
    reason = reason_not_simulated(run.model, run.peers)
    if not reason and (model.timings != run.model.timings or {*columns} != {*signals}):
        reason = f"it is of another topology than {model.name}"
    if reason:
        message, advice = f"the run can't be repeated: {reason}", "use a table of force and motion"
        raise ApcError(Diagnostic("E713", SourceLocation(run.folder), message, advice=advice))
    recorded = RecordedSignals(
        model=live,
        times=run.peers[0].time[:rows],
        duration=Fraction(float(run.peers[0].time[rows - 1])).limit_denominator(10**6),
        signals=tuple(signals.values()),
        values=np.array([columns[name] for name in signals]).T,
        run=run,
    )
    return _selected(recorded, patterns, run.folder, next(iter(signals.values())))


def _selected(
    recorded: RecordedSignals, patterns: Sequence[str], file: str, example: Signal
) -> RecordedSignals:
    """Return a recording with the signals that match a pattern. Raises ApcError E711 if none does."""
    settings = Settings(recorded.duration, jit=False)
    matching = {*prepare(recorded.model, settings, signals=patterns).signals}
    chosen = [index for index, signal in enumerate(recorded.signals) if signal in matching]
    if not chosen:
        got = "only forces" if recorded.forces and not recorded.signals else "none"
        raise _fault(file, "measured signals", "one or more", got, example.heading)
    signals = tuple(recorded.signals[index] for index in chosen)
    return replace(recorded, signals=signals, values=recorded.values[:, chosen])


def _force_targets(model: Model) -> Iterator[_Target]:
    """Yield the forces that can be recorded: constant forces of hands, and forces on parts."""
    units = {parameter.name: parameter.unit for parameter in model.parameters}
    for group in model.groups:
        peer_type = model.peer_types[group.peer_type]
        names = [
            (name.replace(FORCE, ""), name)
            for index, name in enumerate(peer_type.parameters)
            if FORCE in name and units[name] == "N" and _is_constant_force(peer_type, index)
        ]
        names += [
            (state.name if state.name[-1] == "]" else state.name.rpartition(".")[0], "")
            for state in peer_type.states
            if state.unit == "m"
        ]
        for peer in range(1, group.count + 1):
            yield from (_Target(group.name, peer, local, "N", None, name) for local, name in names)


def _is_constant_force(peer_type: PeerType, index: int) -> bool:
    """Return whether a parameter has an effect on the rates, without a factor that varies."""
    functions = (peer_type.derivative, *(clock.tick for clock in peer_type.clocks))
    if not all(function.is_a("SXFunction") for function in functions):  # a solver: it can't be rewritten
        return False
    x, u, p, t = peer_type.derivative.sx_in()
    effect = casadi.jacobian(peer_type.derivative(x, u, p, t), p[index])
    return bool(effect.nnz()) and not casadi.depends_on(effect, casadi.vertcat(x, u, p[index], t))


def _with_forces(model: Model, forces: dict[_Target, Floats], times: Floats) -> Model:
    """Return a model with recorded forces, linear between their rows.

    A force acts on its peer: its share, a parameter, is 1 there and 0 at other peers of the same type.
    """
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    numbers, direct = resolve(model), coupled_directly(model.peer_types)
    peer_types, groups, shares = list(model.peer_types), list(model.groups), list[Parameter]()
    for target, force in forces.items():
        index = next(index for index, group in enumerate(groups) if group.name == target.group)
        group, effect = groups[index], None
        if not target.parameter:
            vector = numbers.parameters[index][numbers.rows[index][target.peer - 1]]
            subsystem = jacobians(model.peer_types[group.peer_type])
            effect = find_devices(subsystem, vector, unit_of, part=target.local, direct=direct).get(
                target.local
            )
            if not isinstance(effect, Device):
                message = (
                    f"force on {target.local}: {effect or 'its mass does not follow from its equations'}"
                )
                fix = f"hands: {{hand: {{type: ConstantForce, flange: {target.local}, force: 0 N}}}}"
                raise ApcError(Diagnostic("E711", SourceLocation(model.origin.topology), message, fix=fix))
        share = Parameter(f"share of {target.names[0]}", "1", 0.0)
        shares.append(share)
        table = function_of(Interpolation(times, force))
        peer_types[group.peer_type] = _forced(
            peer_types[group.peer_type], share.name, table, effect or target.parameter
        )
        column = PeerColumn(share.name, np.eye(group.count)[target.peer - 1])
        groups[index] = replace(group, columns=(*group.columns, column))
    return replace(
        model,
        peer_types=tuple(peer_types),
        groups=tuple(groups),
        parameters=(*model.parameters, *shares),
    )


def _forced(peer_type: PeerType, share: str, table: Any, effect: Device | str) -> PeerType:
    """Return a peer type with a force from a table, times its share.

    Parameters
    ----------
    peer_type, share
        The peer type, and the name of the parameter of the share.
    table
        The force as a CasADi function of time.
    effect
        The part that it acts on, or the parameter of the constant force that it replaces.
    """
    count = len(peer_type.parameters)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        """Return the rates with the force."""
        force = p[count] * table(t)
        if isinstance(effect, Device):
            result = casadi.vertsplit(peer_type.derivative(x, u, p[:count], t))
            result[effect.velocity] += force * effect.symbolic(x, u, p[: effect.symbolic.numel_in(2)], t)
            return casadi.vertcat(*result)
        numbers, row = casadi.vertsplit(p[:count]), peer_type.parameters.index(effect)
        numbers[row] = (1 - p[count]) * numbers[row] + force
        return peer_type.derivative(x, u, casadi.vertcat(*numbers), t)

    extended = replace(peer_type, parameters=(*peer_type.parameters, share), linear=None)
    return rewritten(extended, peer_type, lambda x, p: x, rates)


def _fault(file: str, message: str, expected: str, got: str, fix: str = "") -> ApcError:
    """Return the error E711 of a column."""
    return ApcError(Diagnostic("E711", SourceLocation(file), message, expected, got, fix))
