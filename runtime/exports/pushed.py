"""A scene whose devices are pushed from outside: a force on each that stays as it was set.

Takes: a `CompiledSystem`. Gives: `pushed`, `FORCE_ON`.
Guarantees: without a push nothing moves otherwise; a push that is set before a tick of the fastest clock acts
from that tick on. Along each axis of a device that moves along several there is a force of its own.
Does not: say who sets it.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi

from apc.compiler.compiled import CompiledSystem, Hold, Kind, Parameter, Ports, Timing
from apc.compiler.functions.exchange import NO_DELAY
from apc.frame.devices import Device, coupled_directly, find_devices
from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve

FORCE_ON = "force on "  # and the device


def pushed(system: CompiledSystem) -> CompiledSystem:
    """Return a scene with a force on each device: an output of the fastest clock that keeps its value.

    Parameters
    ----------
    system
        The compiled scene. A peer without a device, or whose forces no clock computes, is left as it is.
    """
    unit_of = {one.name: one.unit for one in system.parameters}
    numbers, direct = resolve(system), coupled_directly(system.kinds)
    periods = {one.name: numbers.timings[one.period] for one in system.clocks}
    kinds, names = list(system.kinds), dict[str, None]()
    for place, group in enumerate(system.groups):
        kind = system.kinds[group.kind]
        if kinds[group.kind] is not kind or not kind.clocks:
            continue
        found = find_devices(jacobians(kind), numbers.parameters[place][0], unit_of, direct=direct)
        devices = [one for one in found.values() if isinstance(one, Device)]
        fastest = min(range(len(kind.clocks)), key=lambda number: periods[kind.clocks[number].clock])
        if devices:
            kinds[group.kind] = _pushed(kind, devices, fastest)
            names |= dict.fromkeys(f"{FORCE_ON}{one.part}" for one in devices)
    timings = {one.name: one for one in (Timing(NO_DELAY, Fraction(0)), *system.timings)}
    added = (Parameter(name, "N", 0.0, about="a force from outside") for name in names)
    return replace(
        system,
        kinds=tuple(kinds),
        parameters=(*system.parameters, *added),
        timings=tuple(timings.values()) if names else system.timings,
    )


def _pushed(kind: Kind, devices: list[Device], fastest: int) -> Kind:
    """Return a kind with a force on each of its devices, which a clock partition keeps."""
    count, names = len(devices), tuple(f"{FORCE_ON}{one.part}" for one in devices)
    sizes = len(kind.holds), len(kind.parameters)

    def over(function: Any, memories: int = 0) -> tuple[list[Any], list[Any], Any, Any]:
        """Return new inputs of a function, those it had, and what is pushed and remembered of pushes."""
        x, _, *between, _, t = function.sx_in()
        held = casadi.SX.sym("u", sizes[0] + count)
        numbers = casadi.SX.sym("p", sizes[1] + count)
        kept = casadi.SX.sym("m", between[0].numel() + memories) if memories else casadi.SX(0, 1)
        new = [x, held, *between, numbers, t]
        old = [x, held[: sizes[0]], *between, numbers[: sizes[1]], t]
        if memories:
            new[2], old[2] = kept, kept[: between[0].numel()]
        return new, old, held[sizes[0] :], kept[kept.numel() - memories :]

    def again(function: Any, memories: int = 0, *, ticks: bool = False) -> Any:
        """Return a function of the new inputs; one that ticks gives the pushes, too."""
        new, old, _, kept = over(function, memories)
        value = casadi.vertcat(function(*old), kept) if ticks else function(*old)
        return casadi.Function(function.name(), new, [value], function.name_in(), function.name_out())

    new, old, forces, _ = over(kind.derivative)
    rates = casadi.vertsplit(kind.derivative(*old))
    for one, force in zip(devices, casadi.vertsplit(forces), strict=True):
        rates[one.velocity] += one.symbolic(*old) * force
    named = kind.derivative.name_in(), kind.derivative.name_out()
    derivative = casadi.Function(kind.derivative.name(), new, [casadi.vertcat(*rates)], *named)
    clocks = []
    for number, clock in enumerate(kind.clocks):
        more = count * (number == fastest)
        receives = tuple(
            one if one.edge is None else replace(one, edge=again(one.edge, more)) for one in clock.receives
        )
        clock = replace(clock, tick=again(clock.tick, more, ticks=True), receives=receives)
        if number == fastest:
            places = tuple(range(len(clock.outputs), len(clock.outputs) + count))
            clock = replace(
                clock,
                outputs=(*clock.outputs, *names),
                units=(*clock.units, *("N",) * count),
                memories=(*clock.memories, *places),
                starts=(*clock.starts, *names),
            )
        clocks.append(clock)
    own, first = clocks[fastest].clock, len(clocks[fastest].outputs) - count
    return replace(
        kind,
        derivative=derivative,
        clocks=tuple(clocks),
        holds=(*kind.holds, *(Hold(name, own, first + k, NO_DELAY) for k, name in enumerate(names))),
        parameters=(*kind.parameters, *names),
        sends=tuple(replace(one, send=again(one.send)) for one in kind.sends),
        ports=None if kind.ports is None else Ports(kind.ports.parts, again(kind.ports.port)),
        limits=tuple(
            one if one.value is None else replace(one, value=again(one.value)) for one in kind.limits
        ),
    )
