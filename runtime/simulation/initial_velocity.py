"""Initial velocity of one peer's device.

Takes: a `Model` and the name of a peer.
Gives: `initial_velocity`, `impulse_text`; `SPEED`, `WATCHED`.
Guarantees: all other start values are those of the model.
Does not: simulate it (see `trajectory`).
"""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction

import numpy as np

from apc.compiler.compiled import Model, PeerColumn, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.simulation.signals import sent_states

# The default initial velocity of the device in m/s, and the default duration in s.
SPEED, WATCHED = 0.1, Fraction(1)

MM = 1e3

_PEER = re.compile(r"(?P<group>.+?)(\[(?P<number>\d+)\])?")


def impulse_text(name: str) -> str:
    """Return the sentence on the initial velocity of what `initial_velocity` named.

    >>> impulse_text("user[1].device")
    'user[1].device starts with 100 mm/s more than in the topology.'
    """
    return f"{name} starts with {SPEED * MM:g} mm/s more than in the topology."


def initial_velocity(system: Model, peer: str = "") -> tuple[Model, str]:
    """Return the model with a peer's device moving by `SPEED` at the start, and the name of what moves.

    Parameters
    ----------
    system
        The model.
    peer
        Such as "user[2]"; of a group's name alone, the first of it; without a name, the first of all.

    Raises
    ------
    ApcError
        E983 no such peer, or nothing of it that a push could move.
    """
    names = [group.name for group in system.groups]
    result = _PEER.fullmatch(peer.strip() or names[0])
    number = int(result["number"] or 1) if result else 0
    location = names.index(result["group"]) if result and result["group"] in names else -1
    if location < 0 or not 1 <= number <= system.groups[location].count:
        message = f"there is no peer {peer.strip()[:60]} to strike"
        raise ApcError(
            Diagnostic(
                "E983", SourceLocation(system.name), message, hint=f'--impulse "{names[max(location, 0)]}[1]"'
            )
        )
    group = system.groups[location]
    peer_type: PeerType = system.peer_types[group.peer_type]
    sent = sent_states(peer_type)
    moving = [row for row, state in enumerate(peer_type.states) if state.unit == "m/s"]
    local = [row for row in moving if row not in sent] or moving
    if not local:
        message = f"nothing of {group.name} has a velocity that a push could change"
        raise ApcError(Diagnostic("E983", SourceLocation(system.name), message))
    state = peer_type.states[local[0]]
    known = {column.name: column.values for column in group.columns}
    present = [
        parameter.value for parameter in (*system.parameters, *group.values) if parameter.name == state.start
    ][-1]
    values = np.array(known.get(state.start, np.full(group.count, present)), dtype=np.float64)
    values[number - 1] += SPEED
    columns = (
        *(column for column in group.columns if column.name != state.start),
        PeerColumn(state.start, values),
    )
    changed = replace(group, columns=columns)
    groups = (*system.groups[:location], changed, *system.groups[location + 1 :])
    return replace(system, groups=groups), f"{group.name}[{number}].{state.name.rpartition('.')[0]}"
