"""Parameter values of a model, with the dependent parameters computed from their formulas.

Takes: a `Model`, and new values by name, in any number type.
Gives: `ParameterScope`, `scope_of`, the one resolver of dependent parameters; `ResolvedNumbers`, `resolve`,
`rationals`; `columns_of`; `free_rows`, `free_values`; `with_times_of_groups`.
Guarantees: dependents of a changed value are computed in the order fixed at compilation; the others keep
their compiled values. Peers with the same parameters share one row. Complex values are complex steps: the
imaginary part is a derivative.
Does not: read or apply overrides, or check bounds (`overrides`); build a matrix (`linearize`, `scheduling`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Formula, Group, Model, Parameter, Timing
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.language.evaluation import computed
from apc.parameter_values.exact_arithmetic import ROWS
from apc.parameter_values.parameter_names import OVERRIDE, ParameterRef, times_of

Floats = NDArray[np.float64]
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class ParameterScope:
    """The numbers of a group of peers, or those common to all: `holder` by name, `formulas` in the order of
    evaluation.
    """

    holder: Mapping[str, Parameter | Timing]
    formulas: Mapping[str, Formula]

    def follow(
        self,
        given: Mapping[str, V],
        compute: Callable[[str, Formula, list[Any]], V],
        present_value: Callable[[str], Any],
        requested: Collection[str] | None = None,
    ) -> dict[str, V]:
        """Return the given values and the values of their dependents, by name.

        Parameters
        ----------
        given
            New values by name.
        compute
            Returns the value of a name by its formula, from the values of `Formula.names`.
        present_value
            Returns the present value of a name that does not depend on a given value.
        requested
            The names to compute; values that none of them depends on are left out. None for all.
        """
        needed = self.formulas.keys() if requested is None else self.needed(requested)
        result = dict(given)
        for name, formula in self.formulas.items():
            if name in needed and name not in given and not result.keys().isdisjoint(formula.names):
                values = [result[name] if name in result else present_value(name) for name in formula.names]
                result[name] = compute(name, formula, values)
        return result

    def needed(self, requested: Collection[str]) -> set[str]:
        """Return the given names and all names that their formulas depend on."""
        needed = set(requested)
        for name in reversed(list(self.formulas)):
            if name in needed:
                needed.update(self.formulas[name].names)
        return needed


def scope_of(
    model: Model, group_values: Sequence[Parameter | Timing] = (), *, fixed: Collection[str] = ()
) -> ParameterScope:
    """Return the parameters and timings of a group of peers, or those common to all peers.

    Parameters
    ----------
    model
        The compiled model.
    group_values
        The group's own values; a later value replaces an earlier one of the same name.
    fixed
        Names whose formulas are not used.
    """
    numbers: list[Parameter | Timing] = [*model.timings, *model.parameters, *group_values]
    holder = {number.name: number for number in numbers}
    formulas = {
        name: formula
        for name in model.followers
        if name in holder and name not in fixed and (formula := holder[name].formula) is not None
    }
    return ParameterScope(holder, formulas)


def with_times_of_groups(model: Model, given: Mapping[str, V]) -> dict[str, V]:
    """Return values by name, extended by the timings of groups that follow from them.

    A value for all groups replaces the timings of single groups, except those that are in `given` too.
    """
    group_timings = {
        time: value for name, value in given.items() for time in times_of(model, name) if time != name
    }
    return group_timings | dict(given)


def _formula_values(name: str, formula: Formula, values: list[Any]) -> Any:
    """Return the values (k,) of a formula for arrays (k,) of the values of its names."""
    with np.errstate(all="ignore"):
        return computed(formula, values, ROWS.__getitem__)


def columns_of(
    model: Model, group: Group, requested: Collection[str] | None = None, peer: int | None = None
) -> dict[str, Floats]:
    """Return the parameters of a group that differ from peer to peer, given or by a formula, (count,) each.

    Parameters
    ----------
    model, group
        The group of peers.
    requested
        The names of parameters to compute; None for all.
    peer
        The number of one peer in the group, from 0, to compute its values (1,) alone.

    Raises
    ------
    ApcError
        E331 a value that is not finite for a peer.
    """
    if not group.columns:
        return {}
    selection = slice(None) if peer is None else slice(peer, peer + 1)
    given = {column.name: column.values[selection] for column in group.columns}
    scope = scope_of(model, group.values, fixed=given)

    def compute(name: str, formula: Formula, values: list[Any]) -> Floats:
        """Return a parameter's value for each peer by its formula.

        Raises
        ------
        ApcError
            E331 a value that is not finite.
        """
        result = np.asarray(_formula_values(name, formula, values), dtype=np.float64)
        not_finite = np.flatnonzero(~np.isfinite(result))
        if len(not_finite):
            where = f"{group.name}[{int(not_finite[0]) + (peer or 0) + 1}]"
            message = f"{name} = {formula.text[:80]} has no finite value for {where}"
            raise ApcError(Diagnostic("E331", OVERRIDE, message))
        return result

    return scope.follow(given, compute, lambda name: float(scope.holder[name].value), requested)


@dataclass(frozen=True, slots=True, eq=False)
class ResolvedNumbers:
    """The numerical values of a model from which its matrices are computed.

    `parameters` holds one matrix (k, n_p) per group: its peers' distinct rows, in order of first appearance,
    columns in the order of its peer type's parameters; `rows` (count,) is the row of each peer. `timings` are
    seconds by name.
    """

    parameters: tuple[Floats, ...]
    rows: tuple[NDArray[np.int64], ...]
    timings: Mapping[str, Fraction]


def resolve(model: Model) -> ResolvedNumbers:
    """Return the numerical values of a model. Raises ApcError as `columns_of`."""
    pairs = [_distinct_rows(model, group) for group in model.groups]
    return ResolvedNumbers(
        parameters=tuple(parameters for parameters, _ in pairs),
        rows=tuple(rows for _, rows in pairs),
        timings={timing.name: timing.value for timing in model.timings},
    )


def _distinct_rows(model: Model, group: Group) -> tuple[Floats, NDArray[np.int64]]:
    """Return a group's distinct parameter rows (k, n_p), and the index (count,) of each peer's row."""
    names = model.peer_types[group.peer_type].parameters
    holder = {parameter.name: parameter for parameter in (*model.parameters, *group.values)}
    common = np.array([[holder[name].value for name in names]], dtype=np.float64).reshape(1, -1)
    columns = columns_of(model, group, names)
    varying = {index: columns[name] for index, name in enumerate(names) if name in columns}
    if not varying:
        # A view of one zero: a million equal peers take no memory.
        return common, np.broadcast_to(np.int64(0), (group.count,))
    table = np.stack(list(varying.values()), axis=1) + 0.0  # −0 and 0 are one number
    keys = table.view(np.dtype((np.void, table.strides[0]))).ravel().tolist()
    row_numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    rows = np.array([row_numbers[key] for key in keys], dtype=np.int64)
    first = np.zeros(len(row_numbers), dtype=np.int64)
    first[rows[::-1]] = np.arange(len(rows))[::-1]
    parameters = np.repeat(common, len(row_numbers), axis=0)
    parameters[:, list(varying)] = table[first]
    return parameters, rows


def rationals(vector: Floats) -> list[Fraction]:
    """Return floats (n,) as exact rationals."""
    return list(map(Fraction, vector.tolist()))


def free_rows(
    model: Model, group: Group, peer: int, values: Mapping[ParameterRef, NDArray[Any]]
) -> NDArray[Any]:
    """Return a peer's parameter vector for many values of some parameters, with their dependents.

    Parameters
    ----------
    model
        The compiled model.
    group, peer
        The peer's group, and its number in the group, from 0.
    values
        Values (k,) of each free parameter, as `apply` would set them; the imaginary part of a complex step is
        returned as the derivative.

    Returns
    -------
    The vectors (k, n_p), or (1, n_p) if none of the values applies to this peer.
    """
    columns = free_values(model, group, peer, values, ROWS.__getitem__)
    count = max((len(item) for item in columns if np.ndim(item)), default=1)
    dtype = np.result_type(np.float64, *(item.dtype for item in columns if np.ndim(item)))
    rows = np.empty((count, len(columns)), dtype=dtype)
    for index, item in enumerate(columns):
        rows[:, index] = item
    return rows


def free_values(
    model: Model,
    group: Group,
    peer: int,
    values: Mapping[ParameterRef, Any],
    rule: Callable[[str], Callable[..., Any]],
) -> list[Any]:
    """Return a peer's parameters: free parameters and their dependents in their number type, others as
    floats.

    Parameters
    ----------
    model, group, peer
        As for `free_rows`.
    values
        The value of each free parameter.
    rule
        The operations of the number type, as of `expression_data.walk`.
    """
    names = model.peer_types[group.peer_type].parameters
    columns = columns_of(model, group, names, peer)
    scope = scope_of(model, group.values, fixed={column.name for column in group.columns})
    given = with_times_of_groups(
        model,
        {parameter_ref.name: value for parameter_ref, value in values.items() if parameter_ref.group is None},
    )
    given |= {
        parameter_ref.name: value
        for parameter_ref, value in values.items()
        if parameter_ref.group == group.name
    }

    def present_value(name: str) -> float:
        """Return the peer's compiled value of a parameter."""
        return float(columns[name][0]) if name in columns else float(scope.holder[name].value)

    def compute(name: str, formula: Formula, values_of: list[Any]) -> Any:
        """Return a formula's value in the number type."""
        with np.errstate(all="ignore"):
            return computed(formula, values_of, rule)

    result = scope.follow(given, compute, present_value, names)
    return [result[name] if name in result else present_value(name) for name in names]
