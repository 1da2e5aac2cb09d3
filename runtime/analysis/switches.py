"""Switching parts: groups of decisions between linear pieces, such as contacts, walls, limits.

Takes: a peer type of a `Model` with its decisions.
Gives: `SwitchingPart`, `switching_parts`; `bind`, `varying_slopes`.
Guarantees: decisions that change a common output are one part.
Does not: find the decisions (see `linearization.branch_conditions`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.interpolation import jacobian
from apc.linearization.branch_conditions import Decision, SwitchedPeerType, bound_peer_type, find_switches
from apc.linearization.jacobians import SubsystemJacobians, jacobians, with_equations
from apc.linearization.linearize import start_values
from apc.spectrum.eigenpairs import components

# The limit of decisions of a part: its pieces are 2 to that power.
MOST_DECISIONS = 6


@dataclass(frozen=True, slots=True)
class SwitchingPart:
    """A switching part: its force depends on the motion if on; if off, less or not at all.

    `name` is that of its output, such as `contact.push`. `decisions` are the indices of its decisions in the
    peer type; `on` and `switched_off` are the settings of these decisions, in the same order.
    """

    name: str
    decisions: tuple[int, ...]
    on: tuple[bool, ...]
    switched_off: tuple[bool, ...]


def switching_parts(switched: SwitchedPeerType, parameters: NDArray[np.float64]) -> tuple[SwitchingPart, ...]:
    """Return the switching parts of a peer type: decisions grouped by common outputs, each part on or off.

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
    for indices in _grouped_decisions(switched.decisions):
        names = list(dict.fromkeys(name for index in indices for name in switched.decisions[index].changes))
        owners = {name.rpartition(".")[0] or name for name in names}
        name = owners.pop() if len(names) > 1 and len(owners) == 1 else ", ".join(names)
        if len(indices) > MOST_DECISIONS:
            message = (
                f"{name} of {switched.peer_type.name} has {len(indices)} conditions; "
                f"at most {MOST_DECISIONS} are analyzed by cases"
            )
            raise ApcError(Diagnostic("E863", SourceLocation(switched.peer_type.name), message))
        pair = _extremes(switched, indices, parameters)
        if pair is not None:
            parts.append(SwitchingPart(name, indices, *pair))
    return tuple(parts)


def varying_slopes(subsystem: SubsystemJacobians) -> tuple[str, ...]:
    """Return the names of the outputs whose slopes vary with time in some piece; empty if none does.

    In a peer type with a nonlinear loop, all outputs of the loop are taken to depend on all its inputs.
    """
    if not subsystem.timed:
        return ()
    result: dict[str, None] = {}
    for function in find_switches(subsystem.peer_type).functions:
        *variables, _, t = function.inputs
        slopes = jacobian(function.output, casadi.vertcat(*variables))
        result |= dict.fromkeys(function.names(slopes, t))
    return tuple(result)


def bind(
    switched: SwitchedPeerType, base: SubsystemJacobians, settings: Mapping[int, bool]
) -> SubsystemJacobians:
    """Return the Jacobians of a peer type in one piece: with every decision set on or off.

    Parameters
    ----------
    switched
        The peer type.
    base
        Its ordinary Jacobians: states, start values and structural patterns are taken from them, so that
        every piece has the same frame and the same states.
    settings
        The setting of each decision by its index; other decisions are off.
    """
    return with_equations(base, bound_peer_type(switched, settings))


def _grouped_decisions(decisions: Sequence[Decision]) -> list[tuple[int, ...]]:
    """Return the indices of decisions in groups that change a common output.

    Decisions that change no output are left out.
    """
    used = [index for index, decision in enumerate(decisions) if decision.changes]
    shared = [[not set(decisions[a].changes).isdisjoint(decisions[b].changes) for b in used] for a in used]
    parts = components(np.array(shared, dtype=np.bool_).reshape(len(used), len(used)))
    return [tuple(used[position] for position in part) for part in parts]


def _extremes(
    switched: SwitchedPeerType, indices: Sequence[int], parameters: NDArray[np.float64]
) -> tuple[tuple[bool, ...], tuple[bool, ...]] | None:
    """Return the settings of the steepest and the flattest piece, None if all pieces have the same slopes.

    The steepest piece depends on the most motions; among equals, its slopes (SI, at the start values) have
    the largest norm.
    """
    slopes: dict[tuple[bool, ...], tuple[int, float, bytes]] = {}
    for setting in itertools.product((True, False), repeat=len(indices)):
        subsystem = jacobians(bound_peer_type(switched, dict(zip(indices, setting, strict=True))))
        x, u, m = start_values(subsystem, list(parameters))
        memories = [value for item in m for value in item]
        received = [0.0] * subsystem.function.numel_in(3)
        slope_vector = np.asarray(
            subsystem.function(x, u, memories, received, parameters, 0.0), dtype=np.float64
        ).ravel()
        for edge in subsystem.edges.values():
            input_sizes = (edge.function.numel_in(i) for i in range(4))
            values = edge.function(*([0.0] * size for size in input_sizes), parameters, 0.0)
            slope_vector = np.append(slope_vector, np.asarray(values, dtype=np.float64).ravel()[1:])
        finite = np.nan_to_num(slope_vector, posinf=0.0, neginf=0.0)
        nonzeros = sum(int(matrix.sum()) for matrix in _patterns(subsystem))
        slopes[setting] = (nonzeros, float(np.linalg.norm(finite)), slope_vector.tobytes())
    steepest = max(slopes, key=lambda setting: slopes[setting][:2])
    flattest = min(slopes, key=lambda setting: slopes[setting][:2])
    if slopes[steepest][:2] == slopes[flattest][:2]:  # such as those of |x|, ±1
        different = [setting for setting in slopes if slopes[setting][2] != slopes[steepest][2]]
        return (steepest, different[0]) if different else None
    return steepest, flattest


def _patterns(subsystem: SubsystemJacobians) -> list[NDArray[Any]]:
    """Return the sparsity patterns of a subsystem's matrices; those of a tick include its edge functions."""
    pattern = subsystem.pattern
    patterns = [pattern.a, pattern.b]
    for tick in pattern.ticks:
        channels = np.array([len(channel) for channel in tick.channels], dtype=np.int64)
        patterns += [tick.x, tick.u, tick.m, tick.r * channels]
    for send in pattern.sends:
        patterns += [send.x, send.u]
    return patterns
