"""Parameter values of a model, with the dependent parameters computed from their formulas.

Takes: a `Model`, and new values by name, in any number type.
Gives: `ParameterScope`, `scope_of`, the one resolver of dependent parameters; `ResolvedNumbers`, `resolve`,
`exact_numbers`; `columns_of`; `free_rows`, `free_values`; `with_times_of_groups`.
Guarantees: dependents of a changed value are computed in the order fixed at compilation; the others keep
their compiled values. Peers with the same parameters share one row. Complex values are complex steps: the
imaginary part is a derivative.
Does not: read or apply overrides, or check bounds (`overrides`); build a matrix (`linearize`, `scheduling`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Formula, Group, Model, Parameter, PeerType, Timing
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.language.evaluation import computed
from apc.frame.exact_arithmetic import ROWS
from apc.frame.parameter_names import OVERRIDE, ParameterRef, times_of

Floats = NDArray[np.float64]
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class ParameterScope:
    """The numbers that a group of peers sees, or everybody: `holder` by name, `formulas` in their order."""

    holder: Mapping[str, Parameter | Timing]
    formulas: Mapping[str, Formula]

    def follow(
        self,
        given: Mapping[str, V],
        compute: Callable[[str, Formula, list[Any]], V],
        now: Callable[[str], Any],
        requested: Collection[str] | None = None,
    ) -> dict[str, V]:
        """Return the values given, and those of all that follows from them.

        Parameters
        ----------
        given
            New values by name.
        compute
            Gives the value of a name by its formula, from the values of `Formula.names`.
        now
            Gives the value of a name that nothing given reaches.
        requested
            The requested names: other values that none of them depends on are left out. None for all.
        """
        needed = self.formulas.keys() if requested is None else self.needed(requested)
        result = dict(given)
        for name, formula in self.formulas.items():
            if name in needed and name not in given and not result.keys().isdisjoint(formula.names):
                values = [result[name] if name in result else now(name) for name in formula.names]
                result[name] = compute(name, formula, values)
        return result

    def needed(self, requested: Collection[str]) -> set[str]:
        """Return some names, and all that these follow from."""
        needed = set(requested)
        for name in reversed(list(self.formulas)):
            if name in needed:
                needed.update(self.formulas[name].names)
        return needed


def scope_of(
    system: Model, local: Sequence[Parameter | Timing] = (), *, fixed: Collection[str] = ()
) -> ParameterScope:
    """Return the parameters of a model for a group of peers, or those common to all.

    Parameters
    ----------
    system
        The compiled model.
    local
        The group's own values; of two with one name the later counts.
    fixed
        Names that follow from nothing here.
    """
    numbers: list[Parameter | Timing] = [*system.timings, *system.parameters, *local]
    holder = {number.name: number for number in numbers}
    formulas = {
        name: formula
        for name in system.followers
        if name in holder and name not in fixed and (formula := holder[name].formula) is not None
    }
    return ParameterScope(holder, formulas)


def with_times_of_groups(system: Model, given: Mapping[str, V]) -> dict[str, V]:
    """Return values by name, extended by the timings of groups that follow from them.

    A value for all groups replaces the timings of single groups, except those that are in `given` too.
    """
    group_timings = {
        time: value for name, value in given.items() for time in times_of(system, name) if time != name
    }
    return group_timings | dict(given)


def _rows(name: str, formula: Formula, values: list[Any]) -> Any:
    """Return a formula's value for all values (k,) of its names at once."""
    with np.errstate(all="ignore"):
        return computed(formula, values, ROWS.__getitem__)


def columns_of(
    system: Model, group: Group, requested: Collection[str] | None = None, peer: int | None = None
) -> dict[str, Floats]:
    """Return the parameters of a group that differ from peer to peer, given or by a formula, (count,) each.

    Parameters
    ----------
    system, group
        The group of peers.
    requested
        The names asked for; None for all.
    peer
        The only peer (1,) that is asked for, its number in the group from 0.

    Raises
    ------
    ApcError
        E331 a value that is not finite for a peer.
    """
    if not group.columns:
        return {}
    some = slice(None) if peer is None else slice(peer, peer + 1)
    given = {column.name: column.values[some] for column in group.columns}
    scope = scope_of(system, group.values, fixed=given)

    def compute(name: str, formula: Formula, values: list[Any]) -> Floats:
        result = np.asarray(_rows(name, formula, values), dtype=np.float64)
        wrong = np.flatnonzero(~np.isfinite(result))
        if len(wrong):
            where = f"{group.name}[{int(wrong[0]) + (peer or 0) + 1}]"
            message = f"{name} = {formula.text[:80]} has no finite value for {where}"
            raise ApcError(Diagnostic("E331", OVERRIDE, message))
        return result

    return scope.follow(given, compute, lambda name: float(scope.holder[name].value), requested)


@dataclass(frozen=True, slots=True, eq=False)
class ResolvedNumbers:
    """Everything a compiled system needs to become matrices.

    `parameters` holds one matrix (k, n_p) per group: its peers' distinct rows, in order of first appearance,
    columns in the order of its peer type's parameters; `rows` (count,) is the row of each peer. `timings` are
    seconds by name.
    """

    parameters: tuple[Floats, ...]
    rows: tuple[NDArray[np.int64], ...]
    timings: Mapping[str, Fraction]


def resolve(system: Model) -> ResolvedNumbers:
    """Return the numbers of a system. Raises ApcError as `columns_of`."""
    pairs = [_different_rows(system, group) for group in system.groups]
    return ResolvedNumbers(
        parameters=tuple(parameters for parameters, _ in pairs),
        rows=tuple(rows for _, rows in pairs),
        timings={timing.name: timing.value for timing in system.timings},
    )


def _different_rows(system: Model, group: Group) -> tuple[Floats, NDArray[np.int64]]:
    """Return a group's different parameter rows (k, n_p) and which of them each peer has (count,)."""
    names = system.peer_types[group.peer_type].parameters
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    common = np.array([[holder[name].value for name in names]], dtype=np.float64).reshape(1, -1)
    columns = columns_of(system, group, names)
    varying = {index: columns[name] for index, name in enumerate(names) if name in columns}
    if not varying:
        # A view of one zero: a million equal peers take no memory.
        return common, np.broadcast_to(np.int64(0), (group.count,))
    table = np.stack(list(varying.values()), axis=1) + 0.0  # −0 and 0 are one number
    keys = table.view(np.dtype((np.void, table.strides[0]))).ravel().tolist()
    known = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    rows = np.array([known[key] for key in keys], dtype=np.int64)
    first = np.zeros(len(known), dtype=np.int64)
    first[rows[::-1]] = np.arange(len(rows))[::-1]
    parameters = np.repeat(common, len(known), axis=0)
    parameters[:, list(varying)] = table[first]
    return parameters, rows


def exact_numbers(peer_type: PeerType, vector: Floats) -> list[Fraction]:
    """Return a peer's parameters (n_p,) exactly: the floats, or the rationals from which they were rounded.

    Parameters
    ----------
    peer_type
        The peer's type, with the exact values of rounded parameters.
    vector
        Its parameters (n_p,), in the order of `PeerType.parameters`.
    """
    numbers = [Fraction(value) for value in vector.tolist()]
    for index, rationals in peer_type.rounded:
        near = bisect_left(rationals, vector[index], key=float)
        assert float(rationals[near]) == vector[index], f"{peer_type.parameters[index]} is none of its values"
        numbers[index] = rationals[near]
    return numbers


def free_rows(
    system: Model, group: Group, peer: int, values: Mapping[ParameterRef, NDArray[Any]]
) -> NDArray[Any]:
    """Return a peer's parameter vector for many values of some parameters, with their dependents.

    Parameters
    ----------
    system
        The compiled model.
    group, peer
        The peer: its group, and its number in it, from 0.
    values
        Values (k,) of each free parameter, as `apply` would set them; the imaginary part of a complex step is
        returned as the derivative.

    Returns
    -------
    The vectors (k, n_p), or (1, n_p) when none of the values reaches this peer.
    """
    listed = free_values(system, group, peer, values, ROWS.__getitem__)
    count = max((len(item) for item in listed if np.ndim(item)), default=1)
    dtype = np.result_type(np.float64, *(item.dtype for item in listed if np.ndim(item)))
    rows = np.empty((count, len(listed)), dtype=dtype)
    for index, item in enumerate(listed):
        rows[:, index] = item
    return rows


def free_values(
    system: Model,
    group: Group,
    peer: int,
    values: Mapping[ParameterRef, Any],
    rule: Callable[[str], Callable[..., Any]],
) -> list[Any]:
    """Return a peer's parameters: dependents of a free one in its number type, the others as floats.

    Parameters
    ----------
    system, group, peer
        As for `free_rows`.
    values
        The value of each free parameter.
    rule
        The operations of the number type, as of `expression_data.walk`.
    """
    requested = system.peer_types[group.peer_type].parameters
    columns = columns_of(system, group, requested, peer)
    scope = scope_of(system, group.values, fixed={column.name for column in group.columns})
    given = with_times_of_groups(
        system, {free.name: value for free, value in values.items() if free.group is None}
    )
    given |= {free.name: value for free, value in values.items() if free.group == group.name}

    def now(name: str) -> float:
        return float(columns[name][0]) if name in columns else float(scope.holder[name].value)

    def compute(name: str, formula: Formula, values_of: list[Any]) -> Any:
        with np.errstate(all="ignore"):
            return computed(formula, values_of, rule)

    result = scope.follow(given, compute, now, requested)
    return [result[name] if name in result else now(name) for name in requested]
