"""Where a peer's equations switch between linear pieces: contacts, walls, limits.

Takes: a kind of a `Model` with its decisions.
Gives: `SwitchingPart`, `switching_parts`; `bind`, `varying_slopes`.
Guarantees: decisions that change something in common are one part.
Does not: find the decisions (see `frame.decisions`).
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
from apc.frame.decisions import Decision, SwitchedPeerType, bound_kind, find_switches
from apc.frame.jacobians import SubsystemJacobians, jacobians, with_equations
from apc.frame.linearize import start_values

# A part with more decisions than this is refused: its pieces are as many as 2 to that power.
MOST_DECISIONS = 6


@dataclass(frozen=True, slots=True)
class SwitchingPart:
    """What switches as one: on, its force follows the motion; off, it does not, or less.

    `name` is what it computes, such as `contact.push`; `on` and `off` are settings, decision by decision, of
    `decisions` (their places in the kind).
    """

    name: str
    decisions: tuple[int, ...]
    on: tuple[bool, ...]
    off: tuple[bool, ...]


def switching_parts(switched: SwitchedPeerType, parameters: NDArray[np.float64]) -> tuple[SwitchingPart, ...]:
    """Group a kind's decisions by what they change, and find each group's pieces "on" and "off".

    Parameters
    ----------
    switched
        The kind.
    parameters
        A vector (n_p,) of this kind: where two pieces depend on the same motions, the steeper is "on".

    Raises
    ------
    ApcError
        E863 a part with too many decisions.
    """
    parts = []
    for places in _together(switched.decisions):
        names = list(dict.fromkeys(name for place in places for name in switched.decisions[place].changes))
        owners = {name.rpartition(".")[0] or name for name in names}
        name = owners.pop() if len(names) > 1 and len(owners) == 1 else ", ".join(names)
        if len(places) > MOST_DECISIONS:
            what = (
                f"{name} of {switched.kind.name} takes {len(places)} decisions; "
                f"at most {MOST_DECISIONS} are analysed piece by piece"
            )
            raise ApcError(Diagnostic("E863", SourceLocation(switched.kind.name), what))
        pair = _extremes(switched, places, parameters)
        if pair is not None:
            parts.append(SwitchingPart(name, places, *pair))
    return tuple(parts)


def varying_slopes(site: SubsystemJacobians) -> tuple[str, ...]:
    """Return the names of what has slopes that change with time in some piece, whatever else moves.

    Of a kind with a nonlinear loop nothing is known: all that is in the loop depends on all that drives it.
    """
    if not site.timed:
        return ()
    result: dict[str, None] = {}
    for function in find_switches(site.kind).functions:
        *moving, _, t = function.inputs
        slopes = jacobian(function.output, casadi.vertcat(*moving))
        result |= dict.fromkeys(function.names(slopes, t))
    return tuple(result)


def bind(
    switched: SwitchedPeerType, base: SubsystemJacobians, settings: Mapping[int, bool]
) -> SubsystemJacobians:
    """Return the Jacobians of a kind with every decision set.

    Parameters
    ----------
    switched
        The kind.
    base
        Its ordinary Jacobians: states, start values and structural patterns stay theirs, so that every piece
        has the same frame and the same states.
    settings
        By the place of the decision; what is left out is off.
    """
    return with_equations(base, bound_kind(switched, settings))


def _together(decisions: Sequence[Decision]) -> list[tuple[int, ...]]:
    """Return the places of decisions that change something in common; not of those nobody reads."""
    read = [place for place, decision in enumerate(decisions) if decision.changes]
    shared = [[not set(decisions[a].changes).isdisjoint(decisions[b].changes) for b in read] for a in read]
    count, labels = connected_components(np.array(shared).reshape(len(read), len(read)), directed=False)
    return sorted(
        tuple(place for place, own in zip(read, labels, strict=True) if own == label)
        for label in range(count)
    )


def _extremes(
    switched: SwitchedPeerType, places: Sequence[int], parameters: NDArray[np.float64]
) -> tuple[tuple[bool, ...], tuple[bool, ...]] | None:
    """Return the settings of the steepest and the flattest piece, None where all have the same slopes.

    Steeper is what depends on more motions, then what has the larger slopes (in SI) at the start values.
    """
    slopes: dict[tuple[bool, ...], tuple[int, float, bytes]] = {}
    for setting in itertools.product((True, False), repeat=len(places)):
        site = jacobians(bound_kind(switched, dict(zip(places, setting, strict=True))))
        x, u, m = start_values(site, list(parameters))
        memories = [value for item in m for value in item]
        heard = [0.0] * site.function.numel_in(3)
        flat = np.asarray(site.function(x, u, memories, heard, parameters, 0.0), dtype=np.float64).ravel()
        for edge in site.edges.values():
            moving = (edge.function.numel_in(i) for i in range(4))
            values = edge.function(*([0.0] * size for size in moving), parameters, 0.0)
            flat = np.append(flat, np.asarray(values, dtype=np.float64).ravel()[1:])
        finite = np.nan_to_num(flat, posinf=0.0, neginf=0.0)
        structural = sum(int(matrix.sum()) for matrix in _patterns(site))
        slopes[setting] = (structural, float(np.linalg.norm(finite)), flat.tobytes())
    steepest = max(slopes, key=lambda setting: slopes[setting][:2])
    flattest = min(slopes, key=lambda setting: slopes[setting][:2])
    if slopes[steepest][:2] == slopes[flattest][:2]:  # as |x| has, of slopes ±1
        others = [setting for setting in slopes if slopes[setting][2] != slopes[steepest][2]]
        return (steepest, others[0]) if others else None
    return steepest, flattest


def _patterns(site: SubsystemJacobians) -> list[NDArray[Any]]:
    """Return a site's structural patterns; edges' own parts are among the ticks'."""
    pattern = site.pattern
    listed = [pattern.a, pattern.b]
    for tick in pattern.ticks:
        channels = np.array([len(channel) for channel in tick.channels], dtype=np.int64)
        listed += [tick.x, tick.u, tick.m, tick.r * channels]
    for send in pattern.sends:
        listed += [send.x, send.u]
    return listed
