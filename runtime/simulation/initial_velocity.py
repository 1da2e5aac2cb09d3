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

MM = 1e3  # millimetres per metre

_PEER = re.compile(r"(?P<group>.+?)(\[(?P<number>\d+)\])?")


def impulse_text(name: str) -> str:
    """Return the sentence on the initial velocity of a device named by `initial_velocity`.

    >>> impulse_text("user[1].device") 'initial velocity of user[1].device increased by 100 mm/s.'
    """
    return f"initial velocity of {name} increased by {SPEED * MM:g} mm/s."


def initial_velocity(model: Model, peer: str = "") -> tuple[Model, str]:
    """Return the model with `SPEED` added to the start velocity of one peer's device, and the device's name.

    Parameters
    ----------
    model
        The model.
    peer
        A peer such as "user[2]"; a group's name alone is its first peer; "" is the first peer of all.

    Raises
    ------
    ApcError
        E983 a peer that does not exist, or has no velocity.
    """
    names = [group.name for group in model.groups]
    parsed = _PEER.fullmatch(peer.strip() or names[0])
    number = int(parsed["number"] or 1) if parsed else 0
    location = names.index(parsed["group"]) if parsed and parsed["group"] in names else -1
    if location < 0 or not 1 <= number <= model.groups[location].count:
        message = f"unknown peer {peer.strip()[:60]}"
        raise ApcError(
            Diagnostic(
                "E983", SourceLocation(model.name), message, fix=f'--impulse "{names[max(location, 0)]}[1]"'
            )
        )
    group = model.groups[location]
    peer_type: PeerType = model.peer_types[group.peer_type]
    sent = sent_states(peer_type)
    velocities = [row for row, state in enumerate(peer_type.states) if state.unit == "m/s"]
    candidates = [row for row in velocities if row not in sent] or velocities
    if not candidates:
        message = f"no part of {group.name} has a velocity"
        raise ApcError(Diagnostic("E983", SourceLocation(model.name), message))
    state = peer_type.states[candidates[0]]
    own_columns = {column.name: column.values for column in group.columns}
    start_value = [
        parameter.value for parameter in (*model.parameters, *group.values) if parameter.name == state.start
    ][-1]
    values = np.array(own_columns.get(state.start, np.full(group.count, start_value)), dtype=np.float64)
    values[number - 1] += SPEED
    columns = (
        *(column for column in group.columns if column.name != state.start),
        PeerColumn(state.start, values),
    )
    changed = replace(group, columns=columns)
    groups = (*model.groups[:location], changed, *model.groups[location + 1 :])
    return replace(model, groups=groups), f"{group.name}[{number}].{state.name.rpartition('.')[0]}"
