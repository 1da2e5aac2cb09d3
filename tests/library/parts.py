"""A peer's equations with the numbers of its topology: what moves it, and what its only clock computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi

import apc
from tests.topologies import ONE_MASS, compiled

CLOCK = "clocks: {tick: 1 ms}\n"
TWO = ONE_MASS.replace("3 N*s/m}", "3 N*s/m}\n  load: {mass: 5 kg, damping: 1 N*s/m}")
MASSES = {"device": (2.0, 3.0), "load": (5.0, 1.0)}


def listed(result: Any) -> list[float]:
    return [float(value) for value in casadi.DM(result).full().ravel()]


def values(model: apc.Model) -> dict[str, float]:
    return {parameter.name: parameter.value for parameter in model.parameters}


def at(model: apc.Model, x: Mapping[str, float]) -> tuple[list[float], list[float], list[float]]:
    """Return the states, with 0 for those not named, zeros for what is held, and the numbers."""
    (peer_type,) = model.peer_types
    states = [state.name for state in peer_type.states]
    assert set(x) <= set(states)
    known = values(model)
    return (
        [x.get(one, 0.0) for one in states],
        [0.0] * len(peer_type.holds),
        [known[n] for n in peer_type.parameters],
    )


def rates(model: apc.Model, x: Mapping[str, float], held: Sequence[float] = ()) -> dict[str, float]:
    """Return dx/dt by state."""
    (peer_type,) = model.peer_types
    states, nothing, numbers = at(model, x)
    found = listed(peer_type.derivative(states, list(held) or nothing, numbers, 0.0))
    return dict(zip((state.name for state in peer_type.states), found, strict=True))


def ticked(
    model: apc.Model,
    x: Mapping[str, float],
    memory: Sequence[float] = (),
    received: Sequence[float] = (),
) -> dict[str, float]:
    """Return what the only clock computes."""
    ((clock,),) = (peer_type.clocks for peer_type in model.peer_types)
    states, nothing, numbers = at(model, x)
    found = listed(clock.tick(states, nothing, list(memory), list(received), numbers, 0))
    return dict(zip(clock.outputs, found, strict=True))


def pushes(model: apc.Model, x: Mapping[str, float], held: Sequence[float] = ()) -> list[float]:
    """Return the force of all parts on each of `MASSES`: m dv/dt + b v."""
    found = rates(model, x, held)
    return [
        mass * found[f"{name}.v"] + damping * x.get(f"{name}.v", 0.0)
        for name, (mass, damping) in MASSES.items()
        if f"{name}.v" in found
    ]


def coupled(part: str, *, base: str = TWO) -> apc.Model:
    return compiled(f"{base}{CLOCK}couplers:\n  it: {{{part}}}\n")


def held(part: str) -> apc.Model:
    return compiled(f"{ONE_MASS}hands:\n  it: {{{part}}}\n")
