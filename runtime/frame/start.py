"""A site at the start of time: its states, what it remembers, what it sends and what it hears.

Takes: a kind's Jacobians and a parameter vector, in any kind of number.
Gives: `start_values`, `start_sends`, `start_arguments`; `at_start`, `sends_nothing`; `start_names`,
`reaches_start`; `Listening`.
Guarantees: holds put out zero.
Does not: ask who hears whom (see `peers`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PEERS, CompiledSystem, Kind
from apc.frame.exact import evaluate_exact
from apc.frame.jacobians import SiteJacobians
from apc.frame.names import Free
from apc.frame.parameters import scope_of

# Kinds that are kept as they start.
KEPT = 64


@dataclass(frozen=True, slots=True)
class Listening:
    """What a site's receives (of all clocks in a row) are at the start, and their own parts.

    `values` (n_r,) are exact; `own` are the slopes over (x, u, m) of each receive, None for a plain one.
    """

    values: tuple[Fraction, ...]
    own: tuple[tuple[Fraction, ...] | None, ...]


def start_values(
    site: SiteJacobians, parameters: Sequence[Any]
) -> tuple[list[Any], list[Any], list[list[Any]]]:
    """Return x, u and every clock partition's m at the start, where holds put out zero."""
    place = {name: index for index, name in enumerate(site.kind.parameters)}
    x = [parameters[place[state.start]] for state in site.kind.states]
    m = [[parameters[place[start]] for start in partition.starts] for partition in site.kind.clocks]
    return x, [0] * len(site.kind.holds), m


def start_sends(
    site: SiteJacobians, parameters: Sequence[Any], number: Callable[[float], Any] = Fraction
) -> dict[str, list[Any]]:
    """Return what a site sends at the start, by link."""
    x, u, _ = start_values(site, parameters)
    sent = {}
    for sending in site.kind.sends:
        if not sending.send.is_a("SXFunction"):
            rounded = sending.send(*([float(value) for value in part] for part in (x, u, parameters, [0.0])))
            sent[sending.link] = [number(float(value)) for value in np.asarray(rounded).ravel()]
            continue
        symbols = sending.send.sx_in()
        dense = casadi.Function("send", symbols, [casadi.densify(sending.send(*symbols))])
        sent[sending.link] = evaluate_exact(dense, [x, u, parameters, [number(0.0)]], number=number)[0]
    return sent


def start_names(system: CompiledSystem) -> set[str]:
    """Return the parameters that are start values of states and of what clocks remember."""
    return {name for kind in system.kinds for name in _starts(kind)}


def _starts(kind: Kind) -> list[str]:
    remembered = (name for clock in kind.clocks for name in clock.starts)
    return [*(state.start for state in kind.states), *remembered]


def reaches_start(system: CompiledSystem, free: Free) -> bool:
    """Say whether where a scene starts is, or depends on, this parameter."""
    starts = start_names(system)
    return free.name in starts or free.name in scope_of(system).needed(sorted(starts))


def sends_nothing(kind: Kind, rows: NDArray[np.float64]) -> bool:
    """Say whether all that peers send at the start is 0, whatever their parameters but the start values.

    Parameters
    ----------
    kind
        The peers' kind.
    rows
        The parameters of each different one, in SI (k, n_p).
    """
    if not all(one.send.is_a("SXFunction") for one in kind.sends):
        return False
    place = {name: index for index, name in enumerate(kind.parameters)}
    starts = sorted({place[name] for name in _starts(kind)})
    symbols = [casadi.SX.sym(name) for name in kind.parameters]
    for values in np.unique(rows[:, starts], axis=0).tolist():
        known = dict(zip(starts, values, strict=True))
        listed = [known.get(index, symbol) for index, symbol in enumerate(symbols)]
        x = casadi.vertcat(*(listed[place[state.start]] for state in kind.states))
        arguments = [x, casadi.SX.zeros(len(kind.holds)), casadi.vertcat(*listed), casadi.SX(0)]
        if not all(one.send(*arguments).is_zero() for one in kind.sends):
            return False
    return True


@lru_cache(maxsize=KEPT)
def at_start(site: SiteJacobians, *, silent: bool = False) -> SiteJacobians | None:
    """Return a kind's Jacobians where it starts, which follow from its parameters alone.

    Start values are parameters, too. None where what is heard decides as well, or a nonlinear loop does;
    with `silent` all that is heard at the start is 0.
    """
    if site.parameters_suffice:
        return site
    if site.edges or not site.walkable:
        return None
    symbols = site.function.sx_in()
    parameters, heard = symbols[4], symbols[3]
    x, u, memories = start_values(site, casadi.vertsplit(parameters) if parameters.numel() else [])
    m = [value for one in memories for value in one]
    flat = site.function(casadi.vertcat(*x), casadi.vertcat(*u), casadi.vertcat(*m), heard, parameters, 0)
    if flat.numel() and casadi.depends_on(flat, heard):
        if not silent:
            return None
        flat = casadi.substitute(flat, heard, casadi.SX.zeros(heard.shape))
    return replace(site, function=casadi.Function("jacobians", symbols, [flat]), affine=True, timed=False)


def start_arguments(
    site: SiteJacobians,
    parameters: list[Any],
    number: Callable[[float], Any],
    listening: Listening | None,
) -> list[list[Any]]:
    """Return (x, u, m, r, p, t) at the start: holds put out zero.

    The Jacobians of an affine site look at nothing but the parameters: zeros will do.
    """
    kind, zero = site.kind, number(0.0)
    if site.affine:
        sizes = [site.function.numel_in(argument) for argument in range(4)]
        x, u, m, r = ([zero] * size for size in sizes)
        return [x, u, m, r, parameters, [zero]]
    x, u, memories = start_values(site, parameters)
    m = [value for one in memories for value in one]
    if listening is not None:
        r = [number(value) for value in listening.values]  # type: ignore[arg-type] # Fraction and float take both
        return [x, u, m, r, parameters, [zero]]
    place = {name: index for index, name in enumerate(kind.parameters)}
    sent = start_sends(site, parameters, number)
    others = parameters[place[PEERS]] - 1 if PEERS in place else number(1.0)
    r = [
        sent[heard.link][heard.channel] * (others if heard.operator == "sum" else number(1.0))
        for partition in kind.clocks
        for heard in partition.receives
    ]
    return [x, u, m, r, parameters, [zero]]
