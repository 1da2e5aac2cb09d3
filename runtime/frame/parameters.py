"""The numbers with which a compiled system becomes matrices, what follows from others worked out with them.

Takes: a `Model`, and new values by name, in any kind of number.
Gives: `ParameterScope`, `scope_of`, the one resolver of what follows from what; `ResolvedNumbers`, `resolve`,
`exact_numbers`; `columns_of`; `free_rows`, `free_values`; `with_times_of_groups`.
Guarantees: what a value reaches by a formula is worked out with it, in the order settled when the scene was
compiled; what none reaches keeps the very number it was compiled with. Peers with the same parameters share
one row. Complex values are complex steps: the imaginary part is a derivative.
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
from apc.frame.exact import ROWS
from apc.frame.names import OVERRIDE, ParameterRef, times_of

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
        wanted: Collection[str] | None = None,
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
        wanted
            The names asked for: what none of them follows from is left out. None for all.
        """
        needed = self.formulas.keys() if wanted is None else self.needed(wanted)
        result = dict(given)
        for name, formula in self.formulas.items():
            if name in needed and name not in given and not result.keys().isdisjoint(formula.names):
                values = [result[name] if name in result else now(name) for name in formula.names]
                result[name] = compute(name, formula, values)
        return result

    def needed(self, wanted: Collection[str]) -> set[str]:
        """Return some names, and all that these follow from."""
        needed = set(wanted)
        for name in reversed(list(self.formulas)):
            if name in needed:
                needed.update(self.formulas[name].names)
        return needed


def scope_of(
    system: Model, own: Sequence[Parameter | Timing] = (), *, fixed: Collection[str] = ()
) -> ParameterScope:
    """Return the numbers of a scene as they are seen by a group of peers, or by everybody.

    Parameters
    ----------
    system
        The compiled scene.
    own
        What the group has of its own; of two of a name the later counts.
    fixed
        Names that follow from nothing here.
    """
    numbers: list[Parameter | Timing] = [*system.timings, *system.parameters, *own]
    holder = {number.name: number for number in numbers}
    formulas = {
        name: formula
        for name in system.followers
        if name in holder and name not in fixed and (formula := holder[name].formula) is not None
    }
    return ParameterScope(holder, formulas)


def with_times_of_groups(system: Model, given: Mapping[str, V]) -> dict[str, V]:
    """Return values for all groups, and with each the timings that groups set for themselves.

    One value for all groups replaces a group's own. A timing of a group that is given itself keeps its value.
    """
    own = {time: value for name, value in given.items() for time in times_of(system, name) if time != name}
    return own | dict(given)


def _rows(name: str, formula: Formula, values: list[Any]) -> Any:
    """Return a formula's value for all values (k,) of its names at once."""
    with np.errstate(all="ignore"):
        return computed(formula, values, ROWS.__getitem__)


def columns_of(
    system: Model, group: Group, wanted: Collection[str] | None = None, peer: int | None = None
) -> dict[str, Floats]:
    """Return the parameters of a group that differ from peer to peer, given or by a formula, (count,) each.

    Parameters
    ----------
    system, group
        The group of the scene.
    wanted
        The names asked for; None for all.
    peer
        The only peer (1,) that is asked for, its number in the group from 0.

    Raises
    ------
    ApcError
        E331 what has no finite value for a peer.
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
            what = f"{name} = {formula.text[:80]} has no finite value for {where}"
            raise ApcError(Diagnostic("E331", OVERRIDE, what))
        return result

    return scope.follow(given, compute, lambda name: float(scope.holder[name].value), wanted)


@dataclass(frozen=True, slots=True, eq=False)
class ResolvedNumbers:
    """Everything a compiled system needs to become matrices.

    `parameters` holds one matrix (k, n_p) a group: its peers' different rows, in the order in which they come
    first, columns in the order of its kind's parameters; `rows` (count,) says which of them each peer has.
    `timings` are seconds by name.
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
    names = system.kinds[group.kind].parameters
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    common = np.array([[holder[name].value for name in names]], dtype=np.float64).reshape(1, -1)
    columns = columns_of(system, group, names)
    varying = {place: columns[name] for place, name in enumerate(names) if name in columns}
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


def exact_numbers(kind: PeerType, vector: Floats) -> list[Fraction]:
    """Return a peer's parameters (n_p,) exactly: as the floats they are, or what these floats round.

    Parameters
    ----------
    kind
        Of the peer: knows what is rounded.
    vector
        Its parameters (n_p,), in the order of `PeerType.parameters`.
    """
    numbers = [Fraction(value) for value in vector.tolist()]
    for place, rationals in kind.rounded:
        near = bisect_left(rationals, vector[place], key=float)
        assert float(rationals[near]) == vector[place], f"{kind.parameters[place]} is none of its values"
        numbers[place] = rationals[near]
    return numbers


def free_rows(
    system: Model, group: Group, peer: int, values: Mapping[ParameterRef, NDArray[Any]]
) -> NDArray[Any]:
    """Return a peer's parameter vector for many values of some parameters, what depends on them included.

    Parameters
    ----------
    system
        The compiled scene.
    group, peer
        The peer: its group, and its number in it, from 0.
    values
        Values (k,) of each free parameter, as `apply` would set them; complex ones are complex steps, whose
        imaginary part comes out as the derivative.

    Returns
    -------
    The vectors (k, n_p), or (1, n_p) when none of the values reaches this peer.
    """
    listed = free_values(system, group, peer, values, ROWS.__getitem__)
    count = max((len(item) for item in listed if np.ndim(item)), default=1)
    dtype = np.result_type(np.float64, *(item.dtype for item in listed if np.ndim(item)))
    rows = np.empty((count, len(listed)), dtype=dtype)
    for place, item in enumerate(listed):
        rows[:, place] = item
    return rows


def free_values(
    system: Model,
    group: Group,
    peer: int,
    values: Mapping[ParameterRef, Any],
    rule: Callable[[str], Callable[..., Any]],
) -> list[Any]:
    """Return a peer's parameters, those that a free one reaches in its kind of number, the others as floats.

    Parameters
    ----------
    system, group, peer
        As for `free_rows`.
    values
        The value of each free parameter.
    rule
        What an operation is in their kind of number, as of `plain.walk`.
    """
    wanted = system.kinds[group.kind].parameters
    columns = columns_of(system, group, wanted, peer)
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

    result = scope.follow(given, compute, now, wanted)
    return [result[name] if name in result else now(name) for name in wanted]
