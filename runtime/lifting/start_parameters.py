"""Parameters for the start values of a model: those of states, memories and holds.

Takes: a `Model`.
Gives: `with_start_parameters`, `has_start_parameters`, `at_topology_start`, `with_start_values`;
`start_parameters`, `start_units`, `names_at_rest`.
Guarantees: a start value that is also a parameter of an equation, such as the reference of a spring, keeps
its value there.
Does not: find the values (see `rest_position`).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Hold, Model, Parameter, PeerColumn, PeerType, rest_of, start_of
from apc.lifting.devices import rewritten
from apc.lifting.model_numbers import PeerIndices

CACHE_SIZE = 64  # peer types with cached functions of start values


def start_parameters(peer_type: PeerType) -> list[str]:
    """Return the parameters for the start values of states, memories and holds, in this order."""
    memories = [start for clock in peer_type.clocks for start in clock.starts]
    states = [state.start for state in peer_type.states]
    return [*states, *memories, *(hold.start for hold in peer_type.holds)]


def start_units(peer_type: PeerType) -> list[str]:
    """Return the units of the start values, in the order of `start_parameters`."""
    units = {clock.clock: clock.units for clock in peer_type.clocks}
    memories = [clock.units[output] for clock in peer_type.clocks for output in clock.memories]
    states = [state.unit for state in peer_type.states]
    return [*states, *memories, *(units[hold.clock][hold.output] for hold in peer_type.holds)]


def names_at_rest(peer_type: PeerType) -> list[str]:
    """Return the parameters for the values at rest, in the order of `start_parameters`."""
    names = [rest_of(start) for start in start_parameters(replace(peer_type, holds=()))]
    names += [_hold_start(hold) for hold in peer_type.holds]
    assert len(set(names)) == len(names), "each start value has a parameter of its own"
    return names


def _hold_start(hold: Hold) -> str:
    """Return the parameter for the output of a hold at rest."""
    return hold.start or rest_of(f"hold {hold.name}")


def with_start_parameters(model: Model) -> Model:
    """Return a model with a parameter of its own for each start value, 0 at first, unless it has them."""
    if has_start_parameters(model):
        return model
    peer_types = tuple(map(_with_parameters, model.peer_types))
    display = {parameter.name: parameter.display_unit for parameter in model.parameters}
    units: dict[str, str] = {}
    for peer_type in (*peer_types, *(item.linear for item in peer_types if item.linear is not None)):
        units |= zip(start_parameters(peer_type), start_units(peer_type), strict=True)
    added = (
        Parameter(name, unit, 0.0, display_unit=display.get(start_of(name), ""))
        for name, unit in units.items()
    )
    return replace(model, peer_types=peer_types, parameters=(*model.parameters, *added))


def has_start_parameters(model: Model) -> bool:
    """Return whether a model has parameters of its own for its start values."""
    return all(start_parameters(item) == names_at_rest(item) for item in model.peer_types)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _with_parameters(peer_type: PeerType, added: tuple[str, ...] = ()) -> PeerType:
    """Return a peer type with parameters for its start values, cached.

    `added` are those of its peer type for a linear type, which has the same parameters.
    """
    count, linear = len(peer_type.parameters), peer_type.linear
    if not added:
        names = [*names_at_rest(peer_type), *(() if linear is None else names_at_rest(linear))]
        added = tuple(dict.fromkeys(names))
    renamed = replace(
        peer_type,
        states=tuple(replace(state, start=rest_of(state.start)) for state in peer_type.states),
        holds=tuple(replace(hold, start=_hold_start(hold)) for hold in peer_type.holds),
        clocks=tuple(replace(clock, starts=tuple(map(rest_of, clock.starts))) for clock in peer_type.clocks),
        parameters=(*peer_type.parameters, *added),
        linear=None if linear is None else _with_parameters(linear, added),
    )
    return rewritten(
        renamed, peer_type, lambda x, p: x, lambda x, u, p, t: peer_type.derivative(x, u, p[:count], t)
    )


def at_topology_start(model: Model) -> Model:
    """Return a model of `with_start_parameters` that starts at the start values of the topology."""
    return replace(model, peer_types=tuple(map(_from_start, model.peer_types)))


@functools.lru_cache(maxsize=CACHE_SIZE)
def _from_start(peer_type: PeerType) -> PeerType:
    """Return a peer type that starts at the start values of the topology, with holds at zero, cached."""
    return replace(
        peer_type,
        states=tuple(replace(state, start=start_of(state.start)) for state in peer_type.states),
        holds=tuple(replace(hold, start="") for hold in peer_type.holds),
        clocks=tuple(replace(clock, starts=tuple(map(start_of, clock.starts))) for clock in peer_type.clocks),
        linear=None if peer_type.linear is None else _from_start(peer_type.linear),
    )


def with_start_values(
    model: Model, classes: Sequence[PeerIndices], values: Sequence[Mapping[str, float]]
) -> Model:
    """Return a model of `with_start_parameters` with new start values.

    Parameters
    ----------
    model
        The model.
    classes, values
        Classes of peers, each within one group, and the start values of each class by the names of
        parameters. What a linear analysis leaves out keeps its start value, also by its name.
    """
    groups, first = [], 0
    for group in model.groups:
        names = start_parameters(model.peer_types[group.peer_type])
        rows = [
            (
                [peer - first for peer in peers] if len(peers) < group.count else [],
                [found.get(name, found.get(start_of(name), 0.0)) for name in names],
            )
            for peers, found in zip(classes, values, strict=True)
            if first <= peers.first < first + group.count
        ]
        first += group.count
        kept = tuple(value for value in group.values if value.name not in names)
        columns = tuple(column for column in group.columns if column.name not in names)
        if len(rows) == 1:
            holder = {parameter.name: parameter for parameter in model.parameters}
            kept += tuple(replace(holder[n], value=value) for n, value in zip(names, rows[0][1], strict=True))
        else:
            table: NDArray[np.float64] = np.empty((group.count, len(names)))
            for peers, row in rows:
                table[peers] = row
            columns += tuple(PeerColumn(n, column.copy()) for n, column in zip(names, table.T, strict=True))
        groups.append(replace(group, values=kept, columns=columns))
    return replace(model, groups=tuple(groups))
