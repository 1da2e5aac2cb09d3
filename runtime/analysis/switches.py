"""Switching parts: groups of decisions between linear pieces, such as contacts, walls, limits.

Takes: a peer type of a `Model` with its decisions.
Gives: `SwitchingPart`, `switching_parts`; `bind`, `varying_slopes`.
Guarantees: decisions that change a common output are one part.
Does not: find the decisions (see `frame.branch_conditions`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.interpolation import jacobian
from apc.frame.branch_conditions import Decision, SwitchedPeerType, bound_peer_type, find_switches
from apc.frame.jacobians import SubsystemJacobians, jacobians, with_equations
from apc.frame.linearize import start_values

# The limit of decisions of a part: its pieces are 2 to that power.
MOST_DECISIONS = 6


@dataclass(frozen=True, slots=True)
class SwitchingPart:
    """A switching part: its force depends on the motion if on; if off, less or not at all.

    `name` is its output, such as `contact.push`; `on` and `switched_off` are settings, decision by decision,
    of `decisions` (their indices in the peer type).
    """

    name: str
    decisions: tuple[int, ...]
    on: tuple[bool, ...]
    switched_off: tuple[bool, ...]


def switching_parts(switched: SwitchedPeerType, parameters: NDArray[np.float64]) -> tuple[SwitchingPart, ...]:
    """Return a peer type's decisions grouped by the outputs that they change, with pieces "on" and "off".

    Parameters
    ----------
    switched
        The peer type.
    parameters
        Parameters (n_p,) of this type: where two pieces depend on the same motions, the steeper is "on".

    Raises
    ------
    ApcError
        E863 a part with too many decisions.
    """
    parts = []
    for indices in _together(switched.decisions):
        names = list(dict.fromkeys(name for index in indices for name in switched.decisions[index].changes))
        owners = {name.rpartition(".")[0] or name for name in names}
        name = owners.pop() if len(names) > 1 and len(owners) == 1 else ", ".join(names)
        if len(indices) > MOST_DECISIONS:
            message = (
                f"{name} of {switched.peer_type.name} takes {len(indices)} decisions; "
                f"at most {MOST_DECISIONS} are analysed piece by piece"
            )
            raise ApcError(Diagnostic("E863", SourceLocation(switched.peer_type.name), message))
        pair = _extremes(switched, indices, parameters)
        if pair is not None:
            parts.append(SwitchingPart(name, indices, *pair))
    return tuple(parts)


def varying_slopes(subsystem: SubsystemJacobians) -> tuple[str, ...]:
    """Return the names of outputs with time-varying slopes in some piece.

    In a peer type with a nonlinear loop, all outputs of the loop are taken to depend on all its inputs.
    """
    if not subsystem.timed:
        return ()
    result: dict[str, None] = {}
    for function in find_switches(subsystem.peer_type).functions:
        *moving, _, t = function.inputs
        slopes = jacobian(function.output, casadi.vertcat(*moving))
        result |= dict.fromkeys(function.names(slopes, t))
    return tuple(result)


def bind(
    switched: SwitchedPeerType, base: SubsystemJacobians, settings: Mapping[int, bool]
) -> SubsystemJacobians:
    """Return the Jacobians of a peer type with every decision set.

    Parameters
    ----------
    switched
        The peer type.
    base
        Its ordinary Jacobians: states, start values and structural patterns are taken from them, so that
        every piece has the same frame and the same states.
    settings
        By the index of the decision; those left out are off.
    """
    return with_equations(base, bound_peer_type(switched, settings))


def _together(decisions: Sequence[Decision]) -> list[tuple[int, ...]]:
    """Return the indices of decisions that change a common output; without unused decisions."""
    read = [index for index, decision in enumerate(decisions) if decision.changes]
    shared = [[not set(decisions[a].changes).isdisjoint(decisions[b].changes) for b in read] for a in read]
    count, labels = connected_components(np.array(shared).reshape(len(read), len(read)), directed=False)
    return sorted(
        tuple(index for index, local in zip(read, labels, strict=True) if local == label)
        for label in range(count)
    )


def _extremes(
    switched: SwitchedPeerType, indices: Sequence[int], parameters: NDArray[np.float64]
) -> tuple[tuple[bool, ...], tuple[bool, ...]] | None:
    """Return the settings of the steepest and the flattest piece, None where all have the same slopes.

    The steeper piece depends on more motions, or else has larger slopes (in SI) at the start values.
    """
    slopes: dict[tuple[bool, ...], tuple[int, float, bytes]] = {}
    for setting in itertools.product((True, False), repeat=len(indices)):
        subsystem = jacobians(bound_peer_type(switched, dict(zip(indices, setting, strict=True))))
        x, u, m = start_values(subsystem, list(parameters))
        memories = [value for item in m for value in item]
        received = [0.0] * subsystem.function.numel_in(3)
        flat = np.asarray(
            subsystem.function(x, u, memories, received, parameters, 0.0), dtype=np.float64
        ).ravel()
        for edge in subsystem.edges.values():
            moving = (edge.function.numel_in(i) for i in range(4))
            values = edge.function(*([0.0] * size for size in moving), parameters, 0.0)
            flat = np.append(flat, np.asarray(values, dtype=np.float64).ravel()[1:])
        finite = np.nan_to_num(flat, posinf=0.0, neginf=0.0)
        structural = sum(int(matrix.sum()) for matrix in _patterns(subsystem))
        slopes[setting] = (structural, float(np.linalg.norm(finite)), flat.tobytes())
    steepest = max(slopes, key=lambda setting: slopes[setting][:2])
    flattest = min(slopes, key=lambda setting: slopes[setting][:2])
    if slopes[steepest][:2] == slopes[flattest][:2]:  # as |x| has, of slopes ±1
        others = [setting for setting in slopes if slopes[setting][2] != slopes[steepest][2]]
        return (steepest, others[0]) if others else None
    return steepest, flattest


def _patterns(subsystem: SubsystemJacobians) -> list[NDArray[Any]]:
    """Return a subsystem's structural patterns; edge functions are included in the ticks'."""
    pattern = subsystem.pattern
    listed = [pattern.a, pattern.b]
    for tick in pattern.ticks:
        channels = np.array([len(channel) for channel in tick.channels], dtype=np.int64)
        listed += [tick.x, tick.u, tick.m, tick.r * channels]
    for send in pattern.sends:
        listed += [send.x, send.u]
    return listed
