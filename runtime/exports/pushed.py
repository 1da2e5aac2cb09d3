"""A scene whose devices are pushed from outside: a force on each that stays as it was set.

Takes: a `Model`. Gives: `pushed`, `FORCE_ON`.
Guarantees: without a push nothing moves otherwise; a push that is set before a tick of the fastest clock acts
from that tick on. Along each axis of a device that moves along several there is a force of its own.
Does not: say who sets it.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi

from apc.compiler.compiled import Hold, Model, Parameter, PeerType, Timing
from apc.compiler.functions.scene_data import NO_DELAY
from apc.frame.devices import Device, coupled_directly, find_devices, rewritten
from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve

FORCE_ON = "force on "  # and the device


def pushed(system: Model) -> Model:
    """Return a scene with a force on each device: a parameter that the fastest clock puts out.

    Parameters
    ----------
    system
        The compiled scene. A peer without a device, or whose forces no clock computes, is left as it is.
    """
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    numbers, direct = resolve(system), coupled_directly(system.kinds)
    periods = {clock.name: numbers.timings[clock.period] for clock in system.clocks}
    kinds, added = list(system.kinds), dict[str, Parameter]()
    for place, group in enumerate(system.groups):
        kind = system.kinds[group.kind]
        if kinds[group.kind] is not kind or not kind.clocks:
            continue
        result = find_devices(jacobians(kind), numbers.parameters[place][0], unit_of, direct=direct)
        devices = {
            f"{FORCE_ON}{device.part}": device for device in result.values() if isinstance(device, Device)
        }
        fastest = min(range(len(kind.clocks)), key=lambda number: periods[kind.clocks[number].clock])
        if devices:
            kinds[group.kind] = _pushed(kind, devices, fastest)
            added |= {name: Parameter(name, "N", 0.0, about="a force from outside") for name in devices}
    timings = {timing.name: timing for timing in (Timing(NO_DELAY, Fraction(0)), *system.timings)}
    return replace(
        system,
        kinds=tuple(kinds),
        parameters=(*system.parameters, *added.values()),
        timings=tuple(timings.values()) if added else system.timings,
    )


def _pushed(kind: PeerType, devices: dict[str, Device], fastest: int) -> PeerType:
    """Return a kind with a force on each of its devices, by name, which a clock partition puts out."""
    before = kind.clocks[fastest]
    held, own, first = len(kind.holds), len(kind.parameters), len(before.outputs)
    holds = (Hold(name, before.clock, first + place, NO_DELAY) for place, name in enumerate(devices))

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        old = x, u[:held], p[:own], t
        result = casadi.vertsplit(kind.derivative(*old))
        for device, force in zip(devices.values(), casadi.vertsplit(u[held:]), strict=True):
            result[device.velocity] += device.symbolic(*old) * force
        return casadi.vertcat(*result)

    larger = replace(kind, parameters=(*kind.parameters, *devices), holds=(*kind.holds, *holds))
    whole = rewritten(larger, kind, lambda x, p: x, rates)
    clock, inputs = whole.clocks[fastest], whole.clocks[fastest].tick.sx_in()
    value = casadi.vertcat(clock.tick(*inputs), inputs[-2][own:])
    tick = casadi.Function(before.tick.name(), inputs, [value], before.tick.name_in(), before.tick.name_out())
    units = (*clock.units, *("N" for _ in devices))
    clock = replace(clock, tick=tick, outputs=(*clock.outputs, *devices), units=units)
    clocks = (*whole.clocks[:fastest], clock, *whole.clocks[fastest + 1 :])
    return replace(whole, clocks=clocks)
