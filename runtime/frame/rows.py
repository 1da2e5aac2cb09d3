"""Parameter vectors for many at once: the different peers of a group, or many values of some parameters.

Takes: a `CompiledSystem`, a group of it, and values of `Free` parameters.
Gives: `Columns`, `different_rows`, `free_rows`, `free_values`.
Guarantees: what depends on a value by an expression is worked out with it, in floats, in a time that grows
with the number of values; what none reaches keeps the very number it was compiled with. Complex values are
complex steps: the imaginary part is a derivative.
Does not: check bounds; change what everybody shares (`overrides`, in exact rationals).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Group, Parameter
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.names import OVERRIDE, Free

if TYPE_CHECKING:
    from apc.compiler.language.expression import Expr

Floats = NDArray[np.float64]


class Columns:
    """The parameters of one group that differ from peer to peer, given or by an expression."""

    def __init__(self, system: CompiledSystem, group: Group, holder: Mapping[str, Parameter]) -> None:
        self._group = group.name
        self._holder = holder
        self._timings = {timing.name: float(timing.value) for timing in system.timings}
        self._given = bool(group.columns)
        self._found: dict[str, Floats | None] = {column.name: column.values for column in group.columns}

    def of(self, name: str) -> Floats | None:
        """Return a parameter's values (count,), or None when all peers share one."""
        if name not in self._found:
            expression = self._holder[name].expression if name in self._holder else None
            self._found[name] = self._evaluated(name, expression) if expression and self._given else None
        return self._found[name]

    def _evaluated(self, name: str, text: str) -> Floats | None:
        from apc.compiler.language.expression import names
        from apc.compiler.language.grammar import parse_expression
        from apc.frame.row_arithmetic import compute_rows

        tree = parse_expression(text, Place(name, 1, 1, text))
        if all(self.of(".".join(node.parts)) is None for node in names(tree)):
            return None
        values = np.asarray(compute_rows(tree, self._look_up), dtype=np.float64)
        wrong = np.flatnonzero(~np.isfinite(values))
        if len(wrong):
            peer = f"{self._group}[{int(wrong[0]) + 1}]"
            raise ApcError(Mistake("E331", OVERRIDE, f"{name} = {text[:80]} has no finite value for {peer}"))
        return values

    def _look_up(self, name: str) -> Any:
        column = self.of(name)
        if column is not None:
            return column
        return self._holder[name].value if name in self._holder else self._timings[name]


def different_rows(system: CompiledSystem, group: Group) -> tuple[Floats, NDArray[np.int64]]:
    """Return a group's different parameter rows (k, n_p) and which of them each peer has (count,)."""
    names = system.kinds[group.kind].parameters
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    common = np.array([[holder[name].value for name in names]], dtype=np.float64).reshape(1, -1)
    columns = Columns(system, group, holder)
    varying = {place: column for place, name in enumerate(names) if (column := columns.of(name)) is not None}
    if not varying:
        # A view of one zero: a million equal peers take no memory.
        return common, np.broadcast_to(np.int64(0), (group.count,))
    table = np.stack(list(varying.values()), axis=1) + 0.0  # −0 and 0 are one number
    known: dict[bytes, int] = {}
    rows = np.array([known.setdefault(row.tobytes(), len(known)) for row in table], dtype=np.int64)
    first = np.zeros(len(known), dtype=np.int64)
    first[rows[::-1]] = np.arange(len(rows))[::-1]
    parameters = np.repeat(common, len(known), axis=0)
    parameters[:, list(varying)] = table[first]
    return parameters, rows


def free_rows(
    system: CompiledSystem, group: Group, peer: int, values: Mapping[Free, NDArray[Any]]
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
    from apc.frame.row_arithmetic import compute_rows

    listed = free_values(system, group, peer, values, compute_rows)
    count = max((len(one) for one in listed if np.ndim(one)), default=1)
    dtype = np.result_type(np.float64, *(one.dtype for one in listed if np.ndim(one)))
    rows = np.empty((count, len(listed)), dtype=dtype)
    for place, one in enumerate(listed):
        rows[:, place] = one
    return rows


def free_values(
    system: CompiledSystem,
    group: Group,
    peer: int,
    values: Mapping[Free, Any],
    compute: Callable[[Expr, Callable[[str], Any]], Any],
) -> list[Any]:
    """Return a peer's parameters, those that a free one reaches in its kind of number, the others as floats.

    Parameters
    ----------
    system, group, peer
        As for `free_rows`.
    values
        The value of each free parameter.
    compute
        Gives the value of an expression, the second argument that of a name.
    """
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    columns = Columns(system, group, holder)
    given = {column.name for column in group.columns}
    known: dict[str, Any] = {free.name: value for free, value in values.items() if free.group is None}
    known |= {free.name: value for free, value in values.items() if free.group == group.name}
    reached = set(known)
    timings = {timing.name: timing for timing in system.timings}

    def value_of(name: str) -> Any:
        if name not in known:
            known[name] = evaluated(name)
        return known[name]

    def evaluated(name: str) -> Any:
        parameter = holder.get(name) or timings[name]
        if parameter.expression and name not in given:
            from apc.compiler.language.expression import names
            from apc.compiler.language.grammar import parse_expression

            tree = parse_expression(parameter.expression, Place(name, 1, 1, parameter.expression))
            parts = [".".join(node.parts) for node in names(tree)]
            for part in parts:
                value_of(part)
            if not reached.isdisjoint(parts):
                reached.add(name)
                return compute(tree, value_of)
        column = columns.of(name)
        return float(parameter.value) if column is None else float(column[peer])

    return [value_of(name) for name in system.kinds[group.kind].parameters]
