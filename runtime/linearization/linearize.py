"""Linearization: the matrices of one subsystem, or of many, at the start values.

Takes: the `SubsystemJacobians` of a peer type, one or many parameter vectors, the values received at the
start.
Gives: `linearize`, `linearize_exact`, `linearize_rows`, `of_rows`; `subsystem_of`, `subsystem_of_entries`;
the start values and the values sent at the start (`start_values`, `start_sends`, `start_arguments`,
`start_names`, `reaches_start`, `sends_nothing`, `at_start`); `InitialReception`; `check_start`.
Guarantees: a subsystem that is not affine is linearized at its start values, with zero outputs of holds.
Does not: schedule events (see `scheduling`) or select senders (see `peer_classes`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PEERS, Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.linearization.evaluation_errors import part_of
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.kinks import refuse_kinks, tie_indicators
from apc.linearization.linear_subsystem import LinearSubsystem, assemble, cut, with_local_parts
from apc.parameter_values.exact_arithmetic import evaluate_exact
from apc.parameter_values.parameter_names import ParameterRef
from apc.parameter_values.parameters import scope_of

# Cached peer types at their start, and batch functions of subsystems.
CACHE_SIZE = 64


@dataclass(frozen=True, slots=True)
class InitialReception:
    """The values of a subsystem's receives (of all clocks) at the start, and their slopes.

    `values` (n_r,) are exact; `local_slopes` are the slopes of each receive over (x, u, m), None for a plain
    sum or mean.
    """

    values: tuple[Fraction, ...]
    local_slopes: tuple[tuple[Fraction, ...] | None, ...]


def start_values(
    subsystem: SubsystemJacobians, parameters: Sequence[Any]
) -> tuple[list[Any], list[Any], list[list[Any]]]:
    """Return x, u and the memories of every clock partition at the start.

    Outputs of holds are zero, unless the start is an equilibrium.
    """
    position = {name: index for index, name in enumerate(subsystem.peer_type.parameters)}
    x = [parameters[position[state.start]] for state in subsystem.peer_type.states]
    m = [
        [parameters[position[start]] for start in partition.starts]
        for partition in subsystem.peer_type.clocks
    ]
    u = [parameters[position[hold.start]] if hold.start else 0 for hold in subsystem.peer_type.holds]
    return x, u, m


def start_sends(
    subsystem: SubsystemJacobians, parameters: Sequence[Any], number: Callable[[float], Any] = Fraction
) -> dict[str, list[Any]]:
    """Return the values that a subsystem sends at the start, by link, in the order of the link's channels.

    `number` converts a float to the number type of the result, by default exact rationals.
    """
    x, u, _ = start_values(subsystem, parameters)
    sent = {}
    for sending in subsystem.peer_type.sends:
        if not sending.send.is_a("SXFunction"):
            rounded = sending.send(*([float(value) for value in part] for part in (x, u, parameters, [0.0])))
            sent[sending.link] = [number(float(value)) for value in np.asarray(rounded).ravel()]
            continue
        symbols = sending.send.sx_in()
        dense = casadi.Function("send", symbols, [casadi.densify(sending.send(*symbols))])
        sent[sending.link] = evaluate_exact(dense, [x, u, parameters, [number(0.0)]], number=number)[0]
    return sent


def start_names(model: Model) -> set[str]:
    """Return the parameters that are start values of states, of clock memories and of holds."""
    return {name for peer_type in model.peer_types for name in _start_names(peer_type)}


def _start_names(peer_type: PeerType) -> list[str]:
    """Return the parameters of a peer type that are start values of states, clock memories and holds."""
    memory_starts = (name for clock in peer_type.clocks for name in clock.starts)
    hold_starts = (hold.start for hold in peer_type.holds if hold.start)
    return [*(state.start for state in peer_type.states), *memory_starts, *hold_starts]


def reaches_start(model: Model, parameter_ref: ParameterRef) -> bool:
    """Return whether the start values depend on a parameter."""
    starts = start_names(model)
    return parameter_ref.name in starts or parameter_ref.name in scope_of(model).needed(sorted(starts))


def sends_nothing(peer_type: PeerType, rows: NDArray[np.float64]) -> bool:
    """Return whether all values sent at the start are 0, for any parameters except the start values.

    Parameters
    ----------
    peer_type
        The peer type.
    rows
        The parameters of each distinct peer, in SI (k, n_p).
    """
    if not all(send.send.is_a("SXFunction") for send in peer_type.sends):
        return False
    position = {name: index for index, name in enumerate(peer_type.parameters)}
    starts = sorted({position[name] for name in _start_names(peer_type)})
    symbols = [casadi.SX.sym(name) for name in peer_type.parameters]
    for values in np.unique(rows[:, starts], axis=0).tolist():
        start_by_index = dict(zip(starts, values, strict=True))
        vector = [start_by_index.get(index, symbol) for index, symbol in enumerate(symbols)]
        x = casadi.vertcat(*(vector[position[state.start]] for state in peer_type.states))
        u = casadi.vertcat(
            *(vector[position[hold.start]] if hold.start else casadi.SX(0) for hold in peer_type.holds)
        )
        arguments = [x, u, casadi.vertcat(*vector), casadi.SX(0)]
        if not all(send.send(*arguments).is_zero() for send in peer_type.sends):
            return False
    return True


@lru_cache(maxsize=CACHE_SIZE)
def at_start(subsystem: SubsystemJacobians, *, silent: bool = False) -> SubsystemJacobians | None:
    """Return a peer type's Jacobians at its start values, as functions of its parameters alone.

    Start values are parameters, too. The result is None if slopes depend on received values or on a nonlinear
    loop; with `silent` all values received at the start are 0.
    """
    if subsystem.parameters_suffice:
        return subsystem
    if subsystem.edges or not subsystem.walkable:
        return None
    symbols = subsystem.function.sx_in()
    parameters, received = symbols[4], symbols[3]
    x, u, memories = start_values(subsystem, casadi.vertsplit(parameters) if parameters.numel() else [])
    m = [value for memory in memories for value in memory]
    flat = subsystem.function(
        casadi.vertcat(*x), casadi.vertcat(*u), casadi.vertcat(*m), received, parameters, 0
    )
    if flat.numel() and casadi.depends_on(flat, received):
        if not silent:
            return None
        flat = casadi.substitute(flat, received, casadi.SX.zeros(received.shape))
    built = replace(
        subsystem, function=casadi.Function("jacobians", symbols, [flat]), affine=True, timed=False
    )
    ties = tie_indicators(subsystem.equations)
    if ties is None:
        return built
    point = [casadi.vertcat(*x), casadi.vertcat(*u), casadi.vertcat(*m)]
    column = ties(*point, casadi.SX.zeros(received.shape) if silent else received, parameters, 0)
    if casadi.depends_on(column, received):
        return None
    return replace(built, ties=casadi.Function("ties", symbols, [column]))


def start_arguments(
    subsystem: SubsystemJacobians,
    parameters: list[Any],
    number: Callable[[float], Any],
    initial_reception: InitialReception | None,
) -> list[list[Any]]:
    """Return (x, u, m, r, p, t) at the start, with zero outputs of holds.

    The Jacobians of an affine subsystem depend on the parameters alone: the other arguments are zeros.

    Parameters
    ----------
    subsystem, parameters
        The peer type's Jacobians and its parameters (n_p,), in the number type.
    number
        Converts a float to the number type.
    initial_reception
        The values received at the start; by default the other peers have the start values of this subsystem.
    """
    peer_type, zero = subsystem.peer_type, number(0.0)
    if subsystem.affine:
        sizes = [subsystem.function.numel_in(argument) for argument in range(4)]
        x, u, m, r = ([zero] * size for size in sizes)
        return [x, u, m, r, parameters, [zero]]
    x, u, memories = start_values(subsystem, parameters)
    m = [value for memory in memories for value in memory]
    if initial_reception is not None:
        r = [number(value) for value in initial_reception.values]  # type: ignore[arg-type] # Fraction and float take both
        return [x, u, m, r, parameters, [zero]]
    position = {name: index for index, name in enumerate(peer_type.parameters)}
    sent = start_sends(subsystem, parameters, number)
    others = parameters[position[PEERS]] - 1 if PEERS in position else number(1.0)
    r = [
        sent[received.link][received.channel] * (others if received.operator == "sum" else number(1.0))
        for partition in peer_type.clocks
        for received in partition.receives
    ]
    return [x, u, m, r, parameters, [zero]]


def linearize(
    subsystem: SubsystemJacobians,
    parameters: NDArray[np.float64],
    initial_reception: InitialReception | None = None,
) -> LinearSubsystem:
    """Return the matrices of a subsystem, in floats.

    Parameters
    ----------
    subsystem
        The peer type's Jacobians.
    parameters
        The subsystem's parameters (n_p,), in the order of `PeerType.parameters`.
    initial_reception
        The values received at the start. By default the other peers have the start values of this subsystem.
    """
    return subsystem_of(subsystem, _finite_slopes(subsystem, parameters, initial_reception))


def linearize_exact(
    subsystem: SubsystemJacobians,
    parameters: Sequence[Fraction],
    initial_reception: InitialReception | None = None,
) -> LinearSubsystem:
    """Return the matrices of `linearize` in exact rationals, as object arrays of `Fraction`, and 0.

    Parameters
    ----------
    subsystem, parameters, initial_reception
        As for `linearize`, the parameters as exact rationals. A subsystem with edge functions requires the
        values received at the start.
    """
    assert initial_reception is not None or not subsystem.edges, "an edge function depends on the sender"
    assert subsystem.function.is_a("SXFunction"), "the solution of a nonlinear loop is no rational number"
    _finite_slopes(subsystem, np.array(parameters, dtype=np.float64), initial_reception)
    arguments = start_arguments(subsystem, [*parameters], Fraction, initial_reception)
    exact = subsystem_of_entries(subsystem, evaluate_exact(subsystem.function, arguments)[0], 0)
    if initial_reception is None:
        return exact
    remaining = iter(initial_reception.local_slopes)
    receive_slopes = [
        [
            None if (slopes := next(remaining)) is None else np.array(slopes, dtype=object)
            for _ in partition.receives
        ]
        for partition in subsystem.peer_type.clocks
    ]
    return with_local_parts(exact, receive_slopes, np.add, np.multiply.outer)


def _finite_slopes(
    subsystem: SubsystemJacobians, parameters: NDArray[np.float64], initial_reception: InitialReception | None
) -> NDArray[np.float64]:
    """Return the entries of a subsystem's matrices at the start, in floats.

    Raises
    ------
    ApcError
        E808 a value of the subsystem, or a slope, that is not finite, or a kink.
    """
    if subsystem.parameters_suffice:
        rows = linearize_rows(subsystem, np.asarray(parameters, dtype=np.float64)[None])
        flat: NDArray[np.float64] = rows[0]
    else:
        if not subsystem.affine:  # else any start will do
            check_start(subsystem, parameters, initial_reception)
            _refuse_kinks(subsystem, parameters, initial_reception)
        arguments = start_arguments(
            subsystem, [float(value) for value in parameters], float, initial_reception
        )
        flat = np.asarray(subsystem.function(*arguments), dtype=np.float64).ravel()
    if subsystem.ties is not None and np.isnan(flat).all():
        refuse_kinks(subsystem.equations, subsystem.peer_type.name, _start_point(subsystem, parameters))
    _refuse_infinite(subsystem, flat)
    return flat


def _refuse_kinks(
    subsystem: SubsystemJacobians, parameters: NDArray[np.float64], initial_reception: InitialReception | None
) -> None:
    """Raise ApcError E808 for a start point with different slopes on different sides."""
    ties = tie_indicators(subsystem.equations)
    if ties is not None:
        arguments = start_arguments(
            subsystem, [float(value) for value in parameters], float, initial_reception
        )
        if np.asarray(ties(*arguments)).any():
            refuse_kinks(
                subsystem.equations,
                subsystem.peer_type.name,
                _start_point(subsystem, parameters, arguments[3]),
            )


def _start_point(
    subsystem: SubsystemJacobians, parameters: NDArray[np.float64], received: Sequence[float] | None = None
) -> dict[str, Sequence[float]]:
    """Return the start of a subsystem, by the columns of `kinks.Point`; by default it receives zeros."""
    numbers = [float(value) for value in parameters]
    x, u, m = start_values(subsystem, numbers)
    point: dict[str, Sequence[float]] = {"x": x, "u": u, "p": numbers, "t": [0.0]}
    remaining = iter(received or itertools.repeat(0.0))
    for p, (partition, memory) in enumerate(zip(subsystem.equations.clocks, m, strict=True)):
        point |= {f"m{p}": memory, f"r{p}": [next(remaining) for _ in partition.receives]}
    return point


def check_start(
    subsystem: SubsystemJacobians,
    parameters: NDArray[np.float64],
    initial_reception: InitialReception | None = None,
) -> None:
    """Evaluate the subsystem's equations at the start values.

    Parameters
    ----------
    subsystem, parameters
        The subsystem and its parameters (n_p,).
    initial_reception
        The values that the subsystem receives; by default as for `linearize`.

    Raises
    ------
    ApcError
        E808 a value that is not finite, by name.
    """
    x, u, m, r, p, t = start_arguments(
        subsystem, [float(value) for value in parameters], float, initial_reception
    )
    peer_type = subsystem.peer_type
    checked = [("der({})", [state.name for state in peer_type.states], peer_type.derivative(x, u, p, t))]
    memories, received = iter(m), iter(r)
    for clock in peer_type.clocks:
        clock_inputs = [next(memories) for _ in clock.memories], [next(received) for _ in clock.receives]
        column = clock.tick(x, u, *clock_inputs, p, t)
        checked.append(("{}", list(clock.outputs) * (column.numel() // len(clock.outputs)), column))
    checked += [("{}", list(send.channels), send.send(x, u, p, t)) for send in peer_type.sends]
    for template, names, column in checked:
        _check_finite([template.format(row) for row in names], np.asarray(column).ravel(), "", peer_type.name)


def _refuse_infinite(subsystem: SubsystemJacobians, flat: NDArray[np.float64]) -> None:
    """Raise ApcError E808 for a slope that is not finite, by name."""
    peer_type = subsystem.peer_type
    if not np.isfinite(flat).all():
        matrices = iter(cut(flat, subsystem.shapes))
        rates = [f"der({state.name})" for state in peer_type.states]
        ticks = [
            (clock.outputs * (clock.tick.numel_out(0) // len(clock.outputs)), 4) for clock in peer_type.clocks
        ]
        blocks: list[tuple[Sequence[str], int]] = [(rates, 2), *ticks]
        blocks += [(send.channels, 2) for send in peer_type.sends]
        for names, count in blocks:
            for _ in range(count):
                _check_finite(names, next(matrices).sum(axis=1), "the slope of ", peer_type.name)


def _check_finite(names: Sequence[str], values: NDArray[np.float64], subject: str, where: str) -> None:
    """Raise ApcError E808 for a value that is not finite.

    Parameters
    ----------
    names, values
        The values, and their names for the message.
    subject
        The text in front of a name: empty, or the kind of slope.
    where
        The name of the peer type, as the location of the error.
    """
    for name, value in zip(names, values, strict=True):
        if not np.isfinite(value):
            text = (
                f"{subject}{name} is {value:g} at the initial state: a division by zero, a root or "
                "logarithm of "
            )
            advice = "choose an initial state at which every equation has a finite value and slope"
            raise ApcError(
                Diagnostic(
                    "E808",
                    SourceLocation(where),
                    f"{text}a negative number",
                    advice=advice,
                    subject=part_of(name),
                )
            )


def linearize_rows(subsystem: SubsystemJacobians, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices of an affine subsystem without edges for parameter vectors (k, n_p), as rows.

    `subsystem_of` converts the rows (k, …) to a subsystem; rows with a kink are NaN.
    """
    assert subsystem.parameters_suffice, "the start matters"
    count, function = len(parameters), subsystem.function
    width, indices = _output(function)
    rows = np.zeros((count, width))
    (values,) = of_rows(function, {4: parameters})
    rows[:, indices] = values + 0.0  # −0 and 0 are one number
    if subsystem.ties is not None:
        (ties,) = of_rows(subsystem.ties, {4: parameters})
        for row in np.flatnonzero((ties > 0).any(axis=1)):
            try:
                refuse_kinks(
                    subsystem.equations, subsystem.peer_type.name, _start_point(subsystem, parameters[row])
                )
            except ApcError:
                rows[row] = np.nan
    return rows


@lru_cache(maxsize=CACHE_SIZE)
def _batched(function: Any, count: int) -> Any:
    """Return a CasADi function with the given number of arguments side by side, cached."""
    return function.map(count)


@lru_cache(maxsize=CACHE_SIZE)
def _layout(function: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the lengths of a function's arguments, and the numbers of stored entries of its outputs."""
    sizes = tuple(function.numel_in(index) for index in range(function.n_in()))
    return sizes, tuple(function.nnz_out(index) for index in range(function.n_out()))


@lru_cache(maxsize=CACHE_SIZE)
def _output(function: Any) -> tuple[int, NDArray[np.int64]]:
    """Return the length of a function's first output, and the indices of its nonzeros."""
    stored = np.array(function.sparsity_out(0).row(), dtype=np.int64)
    stored.setflags(write=False)
    return function.numel_out(0), stored


def of_rows(function: Any, given: Mapping[int, NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return the outputs of a CasADi function for many rows of its arguments, each (k, stored entries).

    Parameters
    ----------
    function
        The function, of dense arguments.
    given
        Arguments (k, size) by their indices; the others are zero.
    """
    count = len(next(iter(given.values())))
    sizes, stored = _layout(function)
    result = [np.empty((count, entries)) for entries in stored]
    if not any(values.size for values in result):
        return result
    # Evaluated in place: CasADi's own matrices would be copied entry by entry.
    buffer, evaluate = _batched(function, count).buffer()
    arguments = [np.zeros(max(1, count * size)) for size in sizes]
    for index, argument_rows in given.items():
        arguments[index] = np.array(argument_rows, dtype=np.float64, order="C").ravel()
    for index, argument in enumerate(arguments):
        buffer.set_arg(index, argument.data)
    for index, output in enumerate(result):
        buffer.set_res(index, output.reshape(-1).data)
    evaluate()
    return result


def subsystem_of(subsystem: SubsystemJacobians, numbers: NDArray[Any]) -> LinearSubsystem:
    """Return the subsystem of a row of `linearize_rows`; of many rows (k, …) with a leading axis (k)."""
    channels = [tick.channels for tick in subsystem.pattern.ticks]
    return assemble(subsystem.peer_type, subsystem.affine, cut(numbers, subsystem.shapes), channels)


def subsystem_of_entries(subsystem: SubsystemJacobians, result: Sequence[Any], zero: Any) -> LinearSubsystem:
    """Return the subsystem of a function's output in another number type.

    Parameters
    ----------
    subsystem
        The peer type's Jacobians.
    result
        The structural nonzeros of the function (see `exact_arithmetic`).
    zero
        The zero of the number type.
    """
    sparsity = subsystem.function.sparsity_out(0)
    entries = np.empty(sparsity.numel(), dtype=object)
    entries[:] = [zero]
    entries[sparsity.row()] = result
    return subsystem_of(subsystem, entries)
