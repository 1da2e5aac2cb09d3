"""A model with an external force on each device; the force holds its last set value.

Takes: a `Model`. Gives: `with_external_force`, `FORCE_ON`.
Guarantees: a zero force leaves the motion unchanged. A force set before a tick of the fastest clock acts from
that tick on. A device with several axes has one force per axis.
Does not: set the force.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi

from apc.compiler.compiled import Hold, Model, Parameter, PeerType, Timing
from apc.compiler.functions.topology_data import NO_DELAY
from apc.lifting.devices import Device, coupled_directly, find_devices, rewritten
from apc.linearization.jacobians import jacobians
from apc.parameter_values.parameters import resolve

FORCE_ON = "force on "  # followed by the name of the device


def with_external_force(model: Model) -> Model:
    """Return a model with a force on each device: a parameter that the fastest clock outputs.

    Parameters
    ----------
    model
        The model. A peer without a device, or without clocked forces, is unchanged.
    """
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    numbers, direct = resolve(model), coupled_directly(model.peer_types)
    periods = {clock.name: numbers.timings[clock.period] for clock in model.clocks}
    peer_types, added = list(model.peer_types), dict[str, Parameter]()
    for index, group in enumerate(model.groups):
        peer_type = model.peer_types[group.peer_type]
        if peer_types[group.peer_type] is not peer_type or not peer_type.clocks:
            continue
        result = find_devices(jacobians(peer_type), numbers.parameters[index][0], unit_of, direct=direct)
        devices = {
            f"{FORCE_ON}{device.part}": device for device in result.values() if isinstance(device, Device)
        }
        fastest = min(
            range(len(peer_type.clocks)), key=lambda number: periods[peer_type.clocks[number].clock]
        )
        if devices:
            peer_types[group.peer_type] = _with_external_force(peer_type, devices, fastest)
            added |= {name: Parameter(name, "N", 0.0, description="external force") for name in devices}
    timings = {timing.name: timing for timing in (Timing(NO_DELAY, Fraction(0)), *model.timings)}
    return replace(
        model,
        peer_types=tuple(peer_types),
        parameters=(*model.parameters, *added.values()),
        timings=tuple(timings.values()) if added else model.timings,
    )


def _with_external_force(peer_type: PeerType, devices: dict[str, Device], fastest: int) -> PeerType:
    """Return a peer type with a force on each of its devices, by name, as outputs of a clock partition."""
    original = peer_type.clocks[fastest]
    hold_count, parameter_count, first = (
        len(peer_type.holds),
        len(peer_type.parameters),
        len(original.outputs),
    )
    holds = (Hold(name, original.clock, first + index, NO_DELAY) for index, name in enumerate(devices))

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        """Return the rates with the external forces added."""
        original_arguments = x, u[:hold_count], p[:parameter_count], t
        result = casadi.vertsplit(peer_type.derivative(*original_arguments))
        for device, force in zip(devices.values(), casadi.vertsplit(u[hold_count:]), strict=True):
            result[device.velocity] += device.symbolic(*original_arguments) * force
        return casadi.vertcat(*result)

    extended = replace(
        peer_type, parameters=(*peer_type.parameters, *devices), holds=(*peer_type.holds, *holds)
    )
    forced = rewritten(extended, peer_type, lambda x, p: x, rates)
    clock, inputs = forced.clocks[fastest], forced.clocks[fastest].tick.sx_in()
    value = casadi.vertcat(clock.tick(*inputs), inputs[-2][parameter_count:])
    tick = casadi.Function(
        original.tick.name(), inputs, [value], original.tick.name_in(), original.tick.name_out()
    )
    units = (*clock.units, *("N" for _ in devices))
    clock = replace(clock, tick=tick, outputs=(*clock.outputs, *devices), units=units)
    clocks = (*forced.clocks[:fastest], clock, *forced.clocks[fastest + 1 :])
    return replace(forced, clocks=clocks)
