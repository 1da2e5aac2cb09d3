"""The matrices of a site where it starts: of one, or of many at once.

Takes: a kind's `SubsystemJacobians`, a parameter vector or many, what the site hears at the start.
Gives: `linearize`, `linearize_exact`, `linearize_rows`, `of_rows`; `site_of`, `site_of_entries`; what a site
is and sends at the start (`start_values`, `start_sends`, `start_arguments`, `start_names`, `reaches_start`,
`sends_nothing`, `at_start`); `InitialReception`.
Guarantees: a site that is not affine is linearized at its start values; holds put out zero there.
Does not: decide when anything happens (see `scheduling`); ask who hears whom (see `peers`).
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
from apc.frame.exact import evaluate_exact
from apc.frame.finite_equations import part_of
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.kinks import refuse_kinks, tie_indicators
from apc.frame.names import ParameterRef
from apc.frame.parameters import exact_numbers, scope_of
from apc.frame.site import LinearSubsystem, assemble, cut, every_matrix, with_own_parts

# Kinds that are kept as they start, and functions of many sites.
KEPT = 64


@dataclass(frozen=True, slots=True)
class InitialReception:
    """What a site's receives (of all clocks in a row) are at the start, and their own parts.

    `values` (n_r,) are exact; `own` are the slopes over (x, u, m) of each receive, None for a plain one.
    """

    values: tuple[Fraction, ...]
    own: tuple[tuple[Fraction, ...] | None, ...]


def start_values(
    site: SubsystemJacobians, parameters: Sequence[Any]
) -> tuple[list[Any], list[Any], list[list[Any]]]:
    """Return x, u and every clock partition's m at the start, where holds put out zero."""
    place = {name: index for index, name in enumerate(site.kind.parameters)}
    x = [parameters[place[state.start]] for state in site.kind.states]
    m = [[parameters[place[start]] for start in partition.starts] for partition in site.kind.clocks]
    return x, [0] * len(site.kind.holds), m


def start_sends(
    site: SubsystemJacobians, parameters: Sequence[Any], number: Callable[[float], Any] = Fraction
) -> dict[str, list[Any]]:
    """Return what a site sends at the start, by link."""
    x, u, _ = start_values(site, parameters)
    sent = {}
    for sending in site.kind.sends:
        if not sending.send.is_a("SXFunction"):
            rounded = sending.send(*([float(value) for value in part] for part in (x, u, parameters, [0.0])))
            sent[sending.link] = [number(float(value)) for value in np.asarray(rounded).ravel()]
            continue
        symbols = sending.send.sx_in()
        dense = casadi.Function("send", symbols, [casadi.densify(sending.send(*symbols))])
        sent[sending.link] = evaluate_exact(dense, [x, u, parameters, [number(0.0)]], number=number)[0]
    return sent


def start_names(system: Model) -> set[str]:
    """Return the parameters that are start values of states and of what clocks remember."""
    return {name for kind in system.kinds for name in _starts(kind)}


def _starts(kind: PeerType) -> list[str]:
    remembered = (name for clock in kind.clocks for name in clock.starts)
    return [*(state.start for state in kind.states), *remembered]


def reaches_start(system: Model, free: ParameterRef) -> bool:
    """Say whether where a scene starts is, or depends on, this parameter."""
    starts = start_names(system)
    return free.name in starts or free.name in scope_of(system).needed(sorted(starts))


def sends_nothing(kind: PeerType, rows: NDArray[np.float64]) -> bool:
    """Say whether all that peers send at the start is 0, whatever their parameters but the start values.

    Parameters
    ----------
    kind
        The peers' kind.
    rows
        The parameters of each different one, in SI (k, n_p).
    """
    if not all(send.send.is_a("SXFunction") for send in kind.sends):
        return False
    place = {name: index for index, name in enumerate(kind.parameters)}
    starts = sorted({place[name] for name in _starts(kind)})
    symbols = [casadi.SX.sym(name) for name in kind.parameters]
    for values in np.unique(rows[:, starts], axis=0).tolist():
        known = dict(zip(starts, values, strict=True))
        listed = [known.get(index, symbol) for index, symbol in enumerate(symbols)]
        x = casadi.vertcat(*(listed[place[state.start]] for state in kind.states))
        arguments = [x, casadi.SX.zeros(len(kind.holds)), casadi.vertcat(*listed), casadi.SX(0)]
        if not all(send.send(*arguments).is_zero() for send in kind.sends):
            return False
    return True


@lru_cache(maxsize=KEPT)
def at_start(site: SubsystemJacobians, *, silent: bool = False) -> SubsystemJacobians | None:
    """Return a kind's Jacobians where it starts, which follow from its parameters alone.

    Start values are parameters, too. None where what is heard decides as well, or a nonlinear loop does;
    with `silent` all that is heard at the start is 0.
    """
    if site.parameters_suffice:
        return site
    if site.edges or not site.walkable:
        return None
    symbols = site.function.sx_in()
    parameters, heard = symbols[4], symbols[3]
    x, u, memories = start_values(site, casadi.vertsplit(parameters) if parameters.numel() else [])
    m = [value for memory in memories for value in memory]
    flat = site.function(casadi.vertcat(*x), casadi.vertcat(*u), casadi.vertcat(*m), heard, parameters, 0)
    if flat.numel() and casadi.depends_on(flat, heard):
        if not silent:
            return None
        flat = casadi.substitute(flat, heard, casadi.SX.zeros(heard.shape))
    built = replace(site, function=casadi.Function("jacobians", symbols, [flat]), affine=True, timed=False)
    ties = tie_indicators(site.equations)
    if ties is None:
        return built
    point = [casadi.vertcat(*x), casadi.vertcat(*u), casadi.vertcat(*m)]
    column = ties(*point, casadi.SX.zeros(heard.shape) if silent else heard, parameters, 0)
    if casadi.depends_on(column, heard):
        return None
    return replace(built, ties=casadi.Function("ties", symbols, [column]))


def start_arguments(
    site: SubsystemJacobians,
    parameters: list[Any],
    number: Callable[[float], Any],
    listening: InitialReception | None,
) -> list[list[Any]]:
    """Return (x, u, m, r, p, t) at the start: holds put out zero.

    The Jacobians of an affine site look at nothing but the parameters: zeros will do.
    """
    kind, zero = site.kind, number(0.0)
    if site.affine:
        sizes = [site.function.numel_in(argument) for argument in range(4)]
        x, u, m, r = ([zero] * size for size in sizes)
        return [x, u, m, r, parameters, [zero]]
    x, u, memories = start_values(site, parameters)
    m = [value for memory in memories for value in memory]
    if listening is not None:
        r = [number(value) for value in listening.values]  # type: ignore[arg-type] # Fraction and float take both
        return [x, u, m, r, parameters, [zero]]
    place = {name: index for index, name in enumerate(kind.parameters)}
    sent = start_sends(site, parameters, number)
    others = parameters[place[PEERS]] - 1 if PEERS in place else number(1.0)
    r = [
        sent[heard.link][heard.channel] * (others if heard.operator == "sum" else number(1.0))
        for partition in kind.clocks
        for heard in partition.receives
    ]
    return [x, u, m, r, parameters, [zero]]


def linearize(
    site: SubsystemJacobians, parameters: NDArray[np.float64], listening: InitialReception | None = None
) -> LinearSubsystem:
    """Return the matrices of a site, in floats.

    Parameters
    ----------
    site
        The kind's Jacobians.
    parameters
        The site's vector (n_p,), in the order of `PeerType.parameters`.
    listening
        What the site hears at the start. Left out, the others stand where this site stands; a site with edge
        functions can't do without.
    """
    if listening is not None and site.edges:
        # A sum of slopes over many peers: rounded once, whatever cancels in it.
        exact = linearize_exact(site, parameters, listening)
        return every_matrix(exact, lambda matrix: matrix.astype(np.float64))
    return site_of(site, _finite_slopes(site, parameters, listening))


def linearize_exact(
    site: SubsystemJacobians, parameters: NDArray[np.float64], listening: InitialReception | None = None
) -> LinearSubsystem:
    """Return the same matrices as `linearize` in exact rationals, as object arrays of `Fraction`, and 0.

    Parameters
    ----------
    site, parameters, listening
        As for `linearize`.
    """
    assert listening is not None or not site.edges, "who is heard decides what an edge function does"
    assert site.function.is_a("SXFunction"), "the solution of a nonlinear loop is no rational number"
    _finite_slopes(site, parameters, listening)
    arguments = start_arguments(site, exact_numbers(site.kind, parameters), Fraction, listening)
    exact = site_of_entries(site, evaluate_exact(site.function, arguments)[0], 0)
    if listening is None:
        return exact
    rest = iter(listening.own)
    own = [
        [None if (part := next(rest)) is None else np.array(part, dtype=object) for _ in partition.receives]
        for partition in site.kind.clocks
    ]
    return with_own_parts(exact, own, np.add, np.multiply.outer)


def _finite_slopes(
    site: SubsystemJacobians, parameters: NDArray[np.float64], listening: InitialReception | None
) -> NDArray[np.float64]:
    """Return the site's function at the start, in floats.

    Raises
    ------
    ApcError
        E808 a value of the site, or a slope of one, that is not finite.
    """
    if site.parameters_suffice:
        rows = linearize_rows(site, np.asarray(parameters, dtype=np.float64)[None])
        flat: NDArray[np.float64] = rows[0]
    else:
        if not site.affine:  # else the start is anywhere
            check_start(site, parameters, listening)
            _refuse_kinks(site, parameters, listening)
        arguments = start_arguments(site, [float(value) for value in parameters], float, listening)
        flat = np.asarray(site.function(*arguments), dtype=np.float64).ravel()
    if site.ties is not None and np.isnan(flat).all():
        refuse_kinks(site.equations, site.kind.name, _start_point(site, parameters))
    _refuse_infinite(site, flat)
    return flat


def _refuse_kinks(
    site: SubsystemJacobians, parameters: NDArray[np.float64], listening: InitialReception | None
) -> None:
    """Refuse a point at which slopes differ from side to side."""
    ties = tie_indicators(site.equations)
    if ties is not None:
        arguments = start_arguments(site, [float(value) for value in parameters], float, listening)
        if np.asarray(ties(*arguments)).any():
            refuse_kinks(site.equations, site.kind.name, _start_point(site, parameters, arguments[3]))


def _start_point(
    site: SubsystemJacobians, parameters: NDArray[np.float64], received: Sequence[float] | None = None
) -> dict[str, Sequence[float]]:
    """Return where a site starts, by the columns of `kinks.Point`; by default it receives zeros."""
    numbers = [float(value) for value in parameters]
    x, u, m = start_values(site, numbers)
    point: dict[str, Sequence[float]] = {"x": x, "u": u, "p": numbers, "t": [0.0]}
    rest = iter(received or itertools.repeat(0.0))
    for p, (partition, memory) in enumerate(zip(site.equations.clocks, m, strict=True)):
        point |= {f"m{p}": memory, f"r{p}": [next(rest) for _ in partition.receives]}
    return point


def check_start(
    site: SubsystemJacobians, parameters: NDArray[np.float64], listening: InitialReception | None = None
) -> None:
    """Evaluate the site's equations at the start values.

    Parameters
    ----------
    site, parameters
        The site and its numbers (n_p,).
    listening
        What it hears where that matters.

    Raises
    ------
    ApcError
        E808 a value that is not finite, by name.
    """
    x, u, m, r, p, t = start_arguments(site, [float(value) for value in parameters], float, listening)
    kind = site.kind
    values = [("der({})", [state.name for state in kind.states], kind.derivative(x, u, p, t))]
    memories, heard = iter(m), iter(r)
    for clock in kind.clocks:
        pair = [next(memories) for _ in clock.memories], [next(heard) for _ in clock.receives]
        column = clock.tick(x, u, *pair, p, t)
        values.append(("{}", list(clock.outputs) * (column.numel() // len(clock.outputs)), column))
    values += [("{}", list(send.channels), send.send(x, u, p, t)) for send in kind.sends]
    for form, rows, column in values:
        _check_finite([form.format(row) for row in rows], np.asarray(column).ravel(), "", kind.name)


def _refuse_infinite(site: SubsystemJacobians, flat: NDArray[np.float64]) -> None:
    """Refuse a slope that is not finite, by name."""
    kind = site.kind
    if not np.isfinite(flat).all():
        matrices = iter(cut(flat, site.shapes))
        rates = [f"der({state.name})" for state in kind.states]
        ticks = [
            (clock.outputs * (clock.tick.numel_out(0) // len(clock.outputs)), 4) for clock in kind.clocks
        ]
        blocks: list[tuple[Sequence[str], int]] = [(rates, 2), *ticks]
        blocks += [(send.channels, 2) for send in kind.sends]
        for names, count in blocks:
            for _ in range(count):
                _check_finite(names, next(matrices).sum(axis=1), "the slope of ", kind.name)


def _check_finite(rows: Sequence[str], values: NDArray[np.float64], what: str, where: str) -> None:
    """Refuse what is not finite, by name."""
    for row, value in zip(rows, values, strict=True):
        if not np.isfinite(value):
            text = (
                f"{what}{row} is {value:g} at the start values: a division by zero, a root or logarithm of "
            )
            hint = "start values at which every equation has a finite value and slope"
            raise ApcError(
                Diagnostic(
                    "E808",
                    SourceLocation(where),
                    f"{text}a number below zero, or the like",
                    hint=hint,
                    subject=part_of(row),
                )
            )


def linearize_rows(site: SubsystemJacobians, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices of an affine site without edges for many parameter vectors (k, n_p), as rows.

    The rows (k, …) hold what `site_of` makes a site of.
    """
    assert site.parameters_suffice, "the start matters"
    count, function = len(parameters), site.function
    width, places = _output(function)
    rows = np.zeros((count, width))
    (values,) = of_rows(function, {4: parameters})
    rows[:, places] = values + 0.0  # −0 and 0 are one number
    if site.ties is not None:
        (ties,) = of_rows(site.ties, {4: parameters})
        for row in np.flatnonzero((ties > 0).any(axis=1)):
            try:
                refuse_kinks(site.equations, site.kind.name, _start_point(site, parameters[row]))
            except ApcError:
                rows[row] = np.nan
    return rows


@lru_cache(maxsize=KEPT)
def _of_many(function: Any, count: int) -> Any:
    """Return a CasADi function of so many arguments side by side: to make it takes longer than to call it."""
    return function.map(count)


@lru_cache(maxsize=KEPT)
def _layout(function: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return how long a function's arguments are, and how many entries of its outputs are stored."""
    sizes = tuple(function.numel_in(place) for place in range(function.n_in()))
    return sizes, tuple(function.nnz_out(place) for place in range(function.n_out()))


@lru_cache(maxsize=KEPT)
def _output(function: Any) -> tuple[int, NDArray[np.int64]]:
    """Return how long a function's first output is, and where it is not zero."""
    stored = np.array(function.sparsity_out(0).row(), dtype=np.int64)
    stored.setflags(write=False)
    return function.numel_out(0), stored


def of_rows(function: Any, given: Mapping[int, NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return a CasADi function's outputs at many rows of its arguments, each (k, entries that are stored).

    Parameters
    ----------
    function
        The function, of dense arguments.
    given
        Arguments (k, size) by their places; the others are zero.
    """
    count = len(next(iter(given.values())))
    sizes, stored = _layout(function)
    result = [np.empty((count, number)) for number in stored]
    if not any(values.size for values in result):
        return result
    # Evaluated where the numbers stand: CasADi's own matrices are copied entry by entry.
    buffer, evaluate = _of_many(function, count).buffer()
    numbers = [np.zeros(max(1, count * size)) for size in sizes]
    for place, rows in given.items():
        numbers[place] = np.array(rows, dtype=np.float64, order="C").ravel()
    for place, number in enumerate(numbers):
        buffer.set_arg(place, number.data)
    for place, rows in enumerate(result):
        buffer.set_res(place, rows.reshape(-1).data)
    evaluate()
    return result


def site_of(site: SubsystemJacobians, numbers: NDArray[Any]) -> LinearSubsystem:
    """Return the site of a row of `linearize_rows`, or of many (k, …) as one with a leading axis (k)."""
    channels = [tick.channels for tick in site.pattern.ticks]
    return assemble(site.kind, site.affine, cut(numbers, site.shapes), channels)


def site_of_entries(site: SubsystemJacobians, result: Sequence[Any], zero: Any) -> LinearSubsystem:
    """Return the site of a function's output over another kind of number (see `exact`), with its zero."""
    sparsity = site.function.sparsity_out(0)
    entries = np.empty(sparsity.numel(), dtype=object)
    entries[:] = [zero]
    entries[sparsity.row()] = result
    return site_of(site, entries)
