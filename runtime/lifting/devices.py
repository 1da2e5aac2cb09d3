"""Haptic devices: the part of a peer that a hand holds, found in its equations, and peers with a hand added.

Takes: the Jacobians and exact parameters of a peer type; a `Model`.
Gives: `Device`, `find_device`, `find_devices`, `devices_of`, `coupled_directly`, `directions_of`;
`no_device`; `ForceInput`, `find_push`; `HANDS`, `with_hands`, `without_hands`, `clamped`, `gripped`;
`replaced_hands`; `refuse_hands`; `published`; `names_hand`, `refuse_numberless`; `LOCAL_MASS`, `UNHELD`;
`rewritten`.
Guarantees: a model whose devices are clamped or held is an ordinary model: parameters, groups and clocks
stay.
Does not: decide stability (see `absolute_stability` for every passive hand).

A device is the part that a hand of the topology is connected to. Without a hand, it is the moving part whose
position is not sent: what a peer sends is its object copy. Where no such part exists, as with two directly
coupled devices, it is a mass that is not an object copy. With m v' = f + …, the slope of v' over any variable
is J = j/m, so 1/m = −(∂J/∂m)/J: the effect of a force at that position, with all parts rigidly connected to
it. A copy of a shared mass is one of n copies: there J = n j/m. With M v' = f of several coupled velocities,
a mass of position i is added to M there: ∂J/∂m = −M⁻¹ eᵢ Jᵢ, and M⁻¹ eᵢ is the effect of a force at i on all
velocities.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.cache import HANDS_CHANGE
from apc.compiler.compiled import PEERS, ForcePorts, Model, Parameter, PeerType, Receive
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.interpolation import jacobian
from apc.compiler.language.vectors import whole_and_index
from apc.linearization.jacobians import SubsystemJacobians, jacobians
from apc.linearization.linearize import InitialReception, start_arguments
from apc.parameter_values.exact_arithmetic import evaluate_exact
from apc.parameter_values.overrides import apply, parse_override
from apc.parameter_values.parameters import rationals, resolve

if TYPE_CHECKING:
    from apc.compiler.components.component import Component

# The choices for hands: as in the topology, devices clamped, or a mass, damper and spring on each device; and
# every passive hand, which does not change the model.
FREE, CLAMPED, HELD, PASSIVE = HANDS = ("free", "clamped", "held", "passive")

# Error codes of a model that does not admit the requested hands, where another model could.
UNHELD = ("E931", "E932")
# A force of 0 N that names the part in a hand, without any other effect.
_HOLDS = "hands: {{grip: {{type: ConstantForce, flange: {part}, force: 0 N{at}}}}}"

# The reason for a peer without a device.
LOCAL_MASS = "masses: {device: {mass: 0.1 kg}}"

# The names and descriptions of the parameters of a hand that is added to every device.
HAND = "hand"
# Units of the parameters of a hand: mass, damping, stiffness.
_IMPEDANCE = ("kg", "N*s/m", "kg/s", "N/m", "kg/s^2")
_NUMBERS = (
    ("mass", "kg", "mass of the hand that moves with the device"),
    ("damping", "N*s/m", "damping of the hand against the arm"),
    ("stiffness", "N/m", "stiffness of the hand against the initial position of the device"),
)
# The example in a message: near the typical values of StylusArmForward in the library.
_TYPICAL = (("mass", "0.2 kg"), ("damping", "18 N*s/m"), ("stiffness", "270 N/m"))
_HAND_NAME = re.compile(rf"([\w.]+\.)?{HAND}\.\w")


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """The device of a peer: the part, or one axis of it, with its position and velocity states.

    A force F on the device adds F · `inverse` to the rate of the velocity, exact for the parameters of the
    linearization; `symbolic` returns 1/m for any parameters, as a CasADi function (x, u, p, t).
    """

    part: str
    position: int
    velocity: int
    inverse: Fraction
    symbolic: Any  # casadi.Function


def find_device(
    subsystem: SubsystemJacobians,
    parameters: NDArray[np.float64],
    unit_of: Mapping[str, str],
    initial_reception: InitialReception | None = None,
    *,
    part: str = "",
    direct: bool = False,
) -> Device | str | None:
    """Return the device of a peer; None without one, or the reason why the device cannot be determined.

    Parameters
    ----------
    subsystem, parameters, unit_of, initial_reception, part, direct
        As for `find_devices`.
    """
    peer_type = subsystem.peer_type
    if not _is_plain(subsystem):
        return f"{peer_type.name} has a nonlinear loop"
    result = find_devices(subsystem, parameters, unit_of, initial_reception, part=part, direct=direct)
    if not result:
        return None
    if len(result) > 1 and any(isinstance(item, Device) for item in result.values()):
        return f"the device of {peer_type.name} is not unique: {', '.join(result)}"
    text = next(iter(result.values()))
    return f"{peer_type.name}: {text}" if isinstance(text, str) else text


def _is_plain(subsystem: SubsystemJacobians) -> bool:
    """Return whether the equations of a peer can be traced symbolically: they have no nonlinear loop."""
    return bool(subsystem.walkable and subsystem.peer_type.derivative.is_a("SXFunction"))


def find_devices(
    subsystem: SubsystemJacobians,
    parameters: NDArray[np.float64],
    unit_of: Mapping[str, str],
    initial_reception: InitialReception | None = None,
    *,
    part: str = "",
    direct: bool = False,
) -> dict[str, Device | str]:
    """Return the possible devices of a peer by name, each with its data or the reason why it is refused.

    Parameters
    ----------
    subsystem, parameters, unit_of, initial_reception
        The peer type, its parameters (n_p,), their units, and its receptions at the start.
    part
        The requested part, or one axis of a part that moves along several, `device.x[2]`; by default the only
        part that a hand is connected to, else the part whose position is not sent.
    direct
        Whether devices are coupled directly (see `coupled_directly`): the default part may then be one whose
        position is sent, if it is not a copy of a shared mass.
    """
    peer_type = subsystem.peer_type
    owners = {_part(state.name) for state in peer_type.states}
    gripped = {owner for owner in owners if _is_gripped(peer_type, owner)}
    if not _is_plain(subsystem):
        return {}
    sent_parts = _sent_parts(subsystem)
    masses = tuple(index for index, name in enumerate(peer_type.parameters) if unit_of.get(name) == "kg")
    x, u, _, _, p, t = start_arguments(subsystem, rationals(parameters), Fraction, initial_reception)
    peers = peer_type.parameters.index(PEERS) if PEERS in peer_type.parameters else None
    variables = masses if peers is None else (*masses, peers)
    result: dict[str, Device | str] = {}
    for index, state in enumerate(peer_type.states):
        driven = np.flatnonzero(subsystem.pattern.a[index])
        local = _part(state.name)
        is_candidate = local in gripped if gripped else direct or local not in sent_parts
        is_candidate = part in (local, state.name) if part else is_candidate
        if state.unit != "m" or not is_candidate or len(driven) != 1 or subsystem.pattern.b[index].any():
            continue
        velocity = int(driven[0])
        slopes, *changes = evaluate_exact(_slopes(peer_type, velocity, variables), [x, u, p, t])
        count, copied = Fraction(1), [False] * len(slopes)
        if peers is not None:
            count = p[peers]
            copied = [
                count * count_slope == slope for slope, count_slope in zip(slopes, changes[-1], strict=True)
            ]
        inverses = {
            (mass, column): -change[column] / slopes[column] * (count if copied[column] else 1)
            for mass, change in enumerate(changes[: len(masses)])
            for column in range(len(slopes))
            if slopes[column] and change[column]
        }
        if state.name.endswith("]"):
            local = state.name  # one axis of several
        if len(set(inverses.values())) == 1:
            (mass, column), inverse = next(iter(inverses.items()))
            if copied[column] and direct and not part:
                continue
            shared = peers if copied[column] else None
            symbolic = _inverse(peer_type, velocity, masses[mass], column, shared)
            result[local] = Device(local, index, velocity, inverse, symbolic)
        elif inverses:
            result[local] = f"{local} is coupled to masses with other motions, so the device is not unique"
    return result


@functools.lru_cache(maxsize=64)
def coupled_directly(peer_types: tuple[PeerType, ...]) -> bool:
    """Return whether devices are coupled directly: every mass is sent, and some peers have no hand.

    If some peers have a hand, each peer without a hand must have the part that a hand is connected to.

    Parameters
    ----------
    peer_types
        The peer types of a model.
    """
    if any(_has_unsent_position(jacobians(analyzed(peer_type))) for peer_type in peer_types):
        return False
    parts = [{_part(state.name) for state in peer_type.states} for peer_type in peer_types]
    gripped = [
        {part for part in part_names if _is_gripped(peer_type, part)}
        for peer_type, part_names in zip(peer_types, parts, strict=True)
    ]
    all_gripped = set().union(*gripped)
    return not all(gripped) and all(part & all_gripped for part in parts if all_gripped)


def _is_gripped(peer_type: PeerType, part: str) -> bool:
    """Return whether a hand of the topology is connected to a part."""
    return any(part == text or part.startswith(f"{text}.") for text in peer_type.held)


def _has_unsent_position(subsystem: SubsystemJacobians) -> bool:
    """Return whether a peer has a moving part whose position is not sent."""
    sent_parts = _sent_parts(subsystem)
    return any(
        state.unit == "m" and _part(state.name) not in sent_parts and subsystem.pattern.a[index].any()
        for index, state in enumerate(subsystem.peer_type.states)
    )


def _sent_parts(subsystem: SubsystemJacobians) -> set[str]:
    """Return the parts whose positions are sent, directly or in a computed value."""
    peer_type = subsystem.peer_type
    ticks = {tick.clock: tick for tick in subsystem.pattern.ticks}
    computed = [ticks[hold.clock].x[hold.output] for hold in peer_type.holds]
    return {
        _part(peer_type.states[index].name)
        for send, sending in zip(subsystem.pattern.sends, peer_type.sends, strict=True)
        for row, hold_pattern, unit in zip(send.x, send.u, sending.units, strict=True)
        if unit == "m"
        for item in (row, *(computed[hold] for hold in np.flatnonzero(hold_pattern)))
        for index in np.flatnonzero(item)
    }


@dataclass(frozen=True, slots=True, eq=False)
class ForceInput:
    """The effect of a force on a part, or along one axis of the part: additions to velocity rates.

    `inverses` are exact, per newton, for the parameters of the linearization; `symbolic` returns them for any
    parameters, as a CasADi function (x, u, p, t).
    """

    part: str
    velocities: tuple[int, ...]
    inverses: tuple[Fraction, ...]
    symbolic: Any  # casadi.Function


def find_push(
    subsystem: SubsystemJacobians,
    parameters: NDArray[np.float64],
    unit_of: Mapping[str, str],
    initial_reception: InitialReception | None,
    position: int,
    known: dict[str, Device | str | None] | None = None,
) -> ForceInput | str | None:
    """Return the effect of a force along a position, None where no part has mass, or the reason for its
    refusal.

    Parameters
    ----------
    subsystem, parameters, unit_of, initial_reception
        As for `find_device`.
    position
        The index of the position among the states.
    known
        The device of each part, or the reason for its refusal: a cache for all positions of one peer. For a
        part of many positions all of them are searched.
    """
    known = {} if known is None else known
    peer_type, name = subsystem.peer_type, subsystem.peer_type.states[position].name
    reason = None
    for part in (_part(name), name):
        if part not in known:
            known[part] = find_device(subsystem, parameters, unit_of, initial_reception, part=part)
        device = known[part]
        if isinstance(device, Device):
            return ForceInput(device.part, (device.velocity,), (device.inverse,), device.symbolic)
        reason = device
    driven = np.flatnonzero(subsystem.pattern.a[position])
    masses = [
        index
        for index, parameter in enumerate(peer_type.parameters)
        if unit_of.get(parameter) == "kg" and _part(parameter) == _part(name)
    ]
    if reason is None or len(driven) != 1 or len(masses) != 1 or not subsystem.walkable:
        return reason
    velocity, mass = int(driven[0]), masses[0]
    x, u, _, _, p, t = start_arguments(subsystem, rationals(parameters), Fraction, initial_reception)
    peers = peer_type.parameters.index(PEERS) if PEERS in peer_type.parameters else None
    variables = (mass,) if peers is None else (mass, peers)
    slopes, change, *by_peers = evaluate_exact(_slopes(peer_type, velocity, variables), [x, u, p, t])
    column = next(
        (k for k, (slope, mass_slope) in enumerate(zip(slopes, change, strict=True)) if slope and mass_slope),
        None,
    )
    if column is None:
        return reason
    shared = None if peers is None or p[peers] * by_peers[0][column] != slopes[column] else peers
    symbolic, velocities = _force_effect(peer_type, velocity, mass, column, shared)
    (inverses,) = evaluate_exact(symbolic, [x, u, p, t])
    return ForceInput(_part(name), velocities, tuple(inverses), symbolic)


@functools.lru_cache(maxsize=64)
def _force_effect(
    peer_type: PeerType, velocity: int, mass: int, column: int, peers: int | None
) -> tuple[Any, tuple[int, ...]]:
    """Return the effect of a force at a velocity on all rates, as a CasADi function, and the indices of
    these rates.

    Parameters
    ----------
    peer_type, velocity, mass
        The peer type, the index of the velocity, and the index of the mass among the parameters.
    column
        The index of the state or hold whose slopes are compared.
    peers
        The index of the number of peers among the parameters for a shared mass, else None.
    """
    x, u, p, t = peer_type.derivative.sx_in()
    rates = jacobian(peer_type.derivative(x, u, p, t), casadi.vertcat(x, u))[:, column]
    changes = casadi.jacobian(rates, p[mass])
    rows = tuple(changes.sparsity().row())
    copies = 1 if peers is None else p[peers]
    entries = [-copies * changes[row] / rates[velocity] for row in rows]
    return casadi.Function("push", [x, u, p, t], [casadi.vertcat(*entries)]), rows


def _part(name: str) -> str:
    """Return the part of a state or a parameter."""
    return name.rpartition(".")[0]


@functools.lru_cache(maxsize=64)
def _slopes(peer_type: PeerType, velocity: int, masses: tuple[int, ...]) -> Any:
    """Return a CasADi function (x, u, p, t): the slopes of a velocity's rate, and their derivatives over
    each mass.
    """
    slopes, changes, inputs = _slope_expressions(peer_type, velocity, masses)
    return casadi.Function("slopes", inputs, [casadi.densify(item) for item in (slopes, *changes)])


def _slope_expressions(
    peer_type: PeerType, velocity: int, masses: Sequence[int]
) -> tuple[Any, list[Any], list[Any]]:
    """Return the slopes of a velocity's rate over (x, u), their derivatives over each mass, and the symbols
    (x, u, p, t).
    """
    x, u, p, t = peer_type.derivative.sx_in()
    rate = peer_type.derivative(x, u, p, t)[velocity]
    slopes = jacobian(rate, casadi.vertcat(x, u)).T
    return slopes, [casadi.jacobian(slopes, p[mass]) for mass in masses], [x, u, p, t]


@functools.lru_cache(maxsize=64)
def _inverse(peer_type: PeerType, velocity: int, mass: int, column: int, peers: int | None) -> Any:
    """Return 1/m as a function of (x, u, p, t), from one slope and its derivative over a mass.

    For a mass that peers share the result is that of one copy.

    Parameters
    ----------
    peer_type, velocity, mass
        The peer type, the index of the velocity, and the index of the mass among the parameters.
    column
        The index of the state or hold whose slopes are compared.
    peers
        The index of the number of peers among the parameters for a shared mass, else None.
    """
    slopes, (change,), inputs = _slope_expressions(peer_type, velocity, [mass])
    copies = 1 if peers is None else inputs[2][peers]
    return casadi.Function(
        "inverse_inertia", inputs, [casadi.simplify(-copies * change[column] / slopes[column])]
    )


def devices_of(model: Model, *, option: str) -> dict[int, Device]:
    """Return the device of each peer type that has one, by index; a server without a device is left out.

    Parameters
    ----------
    model
        The compiled model.
    option
        The option that requires devices, for messages.

    Raises
    ------
    ApcError
        E931 no peer has a device, or one has several possible devices.
    """
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    numbers, direct = resolve(model), coupled_directly(model.peer_types)
    result: dict[int, Device] = {}
    for index, group in enumerate(model.groups):
        subsystem = jacobians(analyzed(model.peer_types[group.peer_type]))
        device = find_device(subsystem, numbers.parameters[index][0], unit_of, direct=direct)
        if isinstance(device, str):
            candidates = find_devices(subsystem, numbers.parameters[index][0], unit_of, direct=direct)
            fix = _hand_entry(model, subsystem.peer_type, candidates)
            raise ApcError(
                Diagnostic("E931", SourceLocation(model.origin.topology), f"{option}: {device}", fix=fix)
            )
        if device is not None:
            result.setdefault(group.peer_type, device)
    if not result:
        raise no_device(model, option)
    return result


def _hand_entry(model: Model, peer_type: PeerType, candidates: Mapping[str, Device | str]) -> str:
    """Return a topology entry that connects a hand to the first of several possible devices, or ""."""
    part = next((part_name for part_name, device in candidates.items() if isinstance(device, Device)), "")
    if peer_type.held or len(candidates) < 2 or not part or part.endswith("]"):
        return ""
    having = [
        group.name
        for group in model.groups
        if any(_part(state.name) == part for state in model.peer_types[group.peer_type].states)
    ]
    group_list = f", at: [{', '.join(having)}]" if len(having) < len(model.groups) else ""
    return _HOLDS.format(part=part, at=group_list)


def directions_of(model: Model) -> dict[str, Model]:
    """Return one model for each direction in which devices move, with all other directions clamped.

    The result is empty if each device moves along one line only.

    Parameters
    ----------
    model
        The compiled model.
    """
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    numbers, direct = resolve(model), coupled_directly(model.peer_types)
    axis_names: dict[str, None] = {}
    for index, group in enumerate(model.groups):
        subsystem = jacobians(analyzed(model.peer_types[group.peer_type]))
        result = find_devices(subsystem, numbers.parameters[index][0], unit_of, direct=direct)
        axes = {part_name: device for part_name, device in result.items() if isinstance(device, Device)}
        wholes = {whole_and_index(axis)[0] if axis.endswith("]") else "" for axis in axes}
        if len(axes) == len(result) > 1 and len(wholes) == 1 and "" not in wholes:
            axis_names |= dict.fromkeys(axis.rpartition(".")[2] for axis in axes)
    return {
        axis: _with_clamped_axes(model, [text for text in axis_names if text != axis]) for axis in axis_names
    }


def _with_clamped_axes(model: Model, others: Sequence[str]) -> Model:
    """Return a model in which the given axes of the devices are clamped at their start."""
    peer_types = []
    for peer_type in model.peer_types:
        moving = [
            (index, int(driven[0]))
            for index, state in enumerate(peer_type.states)
            if state.unit == "m" and any(state.name.endswith(f".{axis}") for axis in others)
            if len(driven := np.flatnonzero(jacobians(analyzed(peer_type)).pattern.a[index])) == 1
        ]
        names = [
            (peer_type.states[position].name, peer_type.states[velocity].name)
            for position, velocity in moving
        ]
        for pair in names:
            index = {state.name: number for number, state in enumerate(peer_type.states)}
            peer_type = _with_clamped_device(peer_type, *(index[name] for name in pair))
        peer_types.append(peer_type)
    return replace(model, peer_types=tuple(peer_types))


def no_device(model: Model, option: str) -> ApcError:
    """Return the error for a model in which no peer has a device."""
    names = ", ".join(group.name for group in model.groups)
    message = f"{option}: no device at {names}: each mass is a copy of a shared object"
    return ApcError(Diagnostic("E931", SourceLocation(model.origin.topology), message, fix=LOCAL_MASS))


def refuse_hands(model: Model, option: str) -> None:
    """Raise ApcError E932 if a model has hands already."""
    for group in model.groups:
        for hand in model.peer_types[group.peer_type].hands:
            message = f"{option}: {group.name} already has the hand {hand}"
            advice = f"remove {hand} from the topology, or omit {option}"
            raise ApcError(Diagnostic("E932", SourceLocation(model.origin.topology), message, advice=advice))


def without_hands(model: Model, option: str) -> Model:
    """Return a model without the hands of its topology.

    Parameters
    ----------
    model
        The compiled model.
    option
        The option that requires devices, for messages.

    Raises
    ------
    ApcError
        E932 a hand is more than a mass, damper and spring between a device and its rest position.
    """
    if not any(peer_type.hands for peer_type in model.peer_types):
        return model
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    peer_types = tuple(
        _without_hands(peer_type, tuple(map(unit_of.get, peer_type.parameters)))
        for peer_type in model.peer_types
    )
    bare = tuple(item or peer_type for item, peer_type in zip(peer_types, model.peer_types, strict=True))
    compiled_model = replace(model, peer_types=bare)
    refuse_hands(compiled_model, option)
    return compiled_model


@functools.lru_cache(maxsize=64)
def _without_hands(peer_type: PeerType, units: tuple[str | None, ...]) -> PeerType | None:
    """Return a peer type whose hands have no mass, damping and stiffness, None if other terms of hands
    remain.
    """
    hand_parameters = [
        index
        for index, name in enumerate(peer_type.parameters)
        if any(_belongs_to_hand(name, hand) for hand in peer_type.hands)
    ]
    if (
        any(_belongs_to_hand(state.name, hand) for state in peer_type.states for hand in peer_type.hands)
        or not peer_type.hands
    ):
        return None

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        """Return the rates with the impedance of the hands set to 0."""
        numbers = casadi.vertsplit(p)
        for index in hand_parameters:
            if units[index] in _IMPEDANCE:
                numbers[index] = casadi.SX(0)
        return peer_type.derivative(x, u, casadi.vertcat(*numbers), t)

    result = rewritten(replace(peer_type, hands=()), peer_type, lambda x, p: x, rates)
    x, u, p, t = result.derivative.sx_in()
    depends = casadi.depends_on(
        result.derivative(x, u, p, t), casadi.vertcat(*(p[index] for index in hand_parameters))
    )
    if depends:
        return None
    return _with_linear(result, peer_type, lambda linear: _without_hands(linear, units) or linear)


def _belongs_to_hand(name: str, hand: str) -> bool:
    """Return whether a state or a parameter belongs to a hand."""
    return name.startswith(f"{hand}.") or _part(name) == hand


def replaced_hands(model: Model) -> tuple[str, ...]:
    """Return a note on the hands of the topology, which are replaced; empty if it has no hands."""
    names = [
        f"{hand} of {group.name}"
        for group in model.groups
        for hand in model.peer_types[group.peer_type].hands
    ]
    return (f"{', '.join(names)}: replaced by any passive operator",) if names else ()


def with_hands(model: Model, hands: str) -> Model:
    """Return a model with the requested hands; its name includes them.

    Parameters
    ----------
    model
        The compiled model.
    hands
        "free": unchanged. "clamped": devices are clamped. "held": a hand of `hand.mass`, `hand.damping` and
        `hand.stiffness` on each device, 0 at first. "passive": unchanged. Or the name of a hand of the
        library, with its default values (see `published`).

    Raises
    ------
    ApcError
        E930 unknown hands; E931 no device; E932 hands in the topology.
    """
    option = f"--hands {hands}"
    if hands in (FREE, PASSIVE):
        return model
    if hands == CLAMPED:
        compiled_model, name = clamped(model, option=option), "devices clamped"
    elif hands in HANDS:
        compiled_model, name = gripped(model, option=option), "devices held"
    else:
        typical = {name: numbers[2] for name, numbers in published(hands).items()}
        compiled_model, name = gripped(model, option=option), f"hands {hands}"
        compiled_model = apply(
            compiled_model,
            [parse_override(compiled_model, f"{name}={value}") for name, value in typical.items()],
        )
    return replace(
        compiled_model, name=f"{model.name}, {name}", origin=model.origin.after((HANDS_CHANGE, hands))
    )


def names_hand(text: str) -> bool:
    """Return whether a text begins with a parameter of the hand that `gripped` adds to a device."""
    return bool(_HAND_NAME.match(text.strip()))


def refuse_numberless(hands: str, named: Iterable[str]) -> None:
    """Raise an error for hands without any parameter: a hand of 0 kg, 0 N*s/m and 0 N/m is a free hand.

    Parameters
    ----------
    hands
        As for `with_hands`.
    named
        The names of parameters that are set or varied, or texts that begin with a name.

    Raises
    ------
    ApcError
        E930 none of `hand.mass`, `hand.damping` and `hand.stiffness` is among them.
    """
    if hands != HELD or any(map(names_hand, named)):
        return
    names = ", ".join(f"{HAND}.{name}" for name, _, _ in _NUMBERS)
    message, got = f"--hands {HELD}", "none, i.e. free devices"
    fix = f"--hands {HELD} " + " ".join(f'--set "{HAND}.{name}={value}"' for name, value in _TYPICAL)
    raise ApcError(Diagnostic("E930", SourceLocation("--hands"), message, f"a value for {names}", got, fix))


def clamped(model: Model, *, option: str = "--hands clamped") -> Model:
    """Return a model whose devices are clamped at their start.

    Raises
    ------
    ApcError
        E931 as `devices_of`, E932 as `without_hands`.
    """
    model = without_hands(model, option)
    # For devices that move along several directions all directions but one are clamped first.
    model = next(iter(directions_of(model).values()), model)
    devices = devices_of(model, option=option)
    peer_types = list(model.peer_types)
    for peer_type_index, device in devices.items():
        peer_type = peer_types[peer_type_index]
        peer_types[peer_type_index] = _with_clamped_device(peer_type, device.position, device.velocity)
    return replace(model, peer_types=tuple(peer_types))


def gripped(model: Model, *, option: str) -> Model:
    """Return a model with a hand on every device.

    Mass, damping and stiffness of the hand are parameters with the value 0.

    Raises
    ------
    ApcError
        E931 as `devices_of`, E932 hands in the topology.
    """
    refuse_hands(model, option)
    devices = devices_of(model, option=option)
    names = tuple(f"{HAND}.{name}" for name, _, _ in _NUMBERS)
    peer_types = list(model.peer_types)
    for number, device in devices.items():
        peer_types[number] = _with_hand(
            peer_types[number], device.position, device.velocity, device.symbolic, names
        )
    added = tuple(
        Parameter(name, unit, 0.0, minimum=0.0, description=description)
        for name, (_, unit, description) in zip(names, _NUMBERS, strict=True)
    )
    return replace(model, peer_types=tuple(peer_types), parameters=(*model.parameters, *added))


@functools.lru_cache(maxsize=64)
def _with_hand(
    peer_type: PeerType, position: int, velocity: int, inverse_inertia: Any, names: tuple[str, ...]
) -> PeerType:
    """Return a peer type whose device has a hand: (m + m_h) v' = m v'₀ − b_h v − k_h (x − x₀).

    Parameters
    ----------
    peer_type
        The peer type.
    position, velocity
        The indices of the device's position and velocity among the states.
    inverse_inertia
        1/m of the device, a CasADi function (x, u, p, t).
    names
        The names of the hand's mass, damping and stiffness.
    """
    parameter_count = len(peer_type.parameters)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        """Return the rates with the force and mass of the hand."""
        mass, damping, stiffness = casadi.vertsplit(p[parameter_count:])
        start = p[peer_type.parameters.index(peer_type.states[position].start)]
        rate = peer_type.derivative(x, u, p[:parameter_count], t)
        inverse = inverse_inertia(x, u, p[:parameter_count], t)
        pull = damping * x[velocity] + stiffness * (x[position] - start)
        row = (rate[velocity] - inverse * pull) / (1 + inverse * mass)
        return casadi.vertcat(rate[:velocity], row, rate[velocity + 1 :])

    extended = replace(peer_type, parameters=(*peer_type.parameters, *names))
    return _with_linear(
        rewritten(extended, peer_type, lambda x, p: x, rates),
        peer_type,
        lambda linear: _with_hand(linear, position, velocity, inverse_inertia, names),
    )


@functools.lru_cache(maxsize=64)
def _with_clamped_device(peer_type: PeerType, position: int, velocity: int) -> PeerType:
    """Return a peer type whose device is clamped at its start.

    Its position and velocity are removed from the states.
    """
    remaining = [index for index in range(len(peer_type.states)) if index not in (position, velocity)]
    start = peer_type.parameters.index(peer_type.states[position].start)

    def all_states(x: Any, p: Any) -> Any:
        """Return the states of the original peer type, from the remaining states and the parameters."""
        expressions = [casadi.SX(0)] * len(peer_type.states)
        for number, index in enumerate(remaining):
            expressions[index] = x[number]
        expressions[position] = p[start]
        return casadi.vertcat(*expressions)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        """Return the rates of the remaining states."""
        rate = peer_type.derivative(x, u, p, t)
        return casadi.vertcat(*(rate[index] for index in remaining))

    reduced = replace(peer_type, states=tuple(peer_type.states[index] for index in remaining))
    return _with_linear(
        rewritten(reduced, peer_type, all_states, rates),
        peer_type,
        lambda linear: _with_clamped_device(linear, position, velocity),
    )


def _with_linear(result: PeerType, before: PeerType, change: Callable[[PeerType], PeerType]) -> PeerType:
    """Return a changed peer type whose `linear` type, if any, is changed by `change` as well."""
    return replace(result, linear=None if before.linear is None else change(before.linear))


def analyzed(peer_type: PeerType) -> PeerType:
    """Return the peer type that represents a type in a linear analysis."""
    return peer_type.linear or peer_type


def rewritten(
    peer_type: PeerType,
    original: PeerType,
    original_states: Callable[[Any, Any], Any],
    rates: Callable[[Any, Any, Any, Any], Any],
) -> PeerType:
    """Return a peer type with other states, parameters or additional holds, and its functions rewritten
    for them.

    Parameters
    ----------
    peer_type, original
        The new type, still with the functions of the original, and the original type.
    original_states
        Returns the original states, from the new states and the parameters.
    rates
        Returns the new rates, from the original states and the new holds, parameters and time.
    """
    sizes = len(peer_type.states), len(peer_type.holds), len(peer_type.parameters)
    functions = [peer_type.derivative, *(clock.tick for clock in peer_type.clocks)]
    plain = all(function.is_a("SXFunction") for function in functions)  # else with a nonlinear loop
    symbol: Any = casadi.SX.sym if plain else casadi.MX.sym
    x, u, p = (symbol(name, size) for name, size in zip("xup", sizes, strict=True))
    states, hold_count, parameter_count = original_states(x, p), len(original.holds), len(original.parameters)

    def repeated(function: Any, body: Callable[..., Any] | None = None) -> Any:
        """Return a function (x, u, …, p, t) over the new states, holds and parameters."""
        _, _, *between, _, t = function.sx_in() if plain else function.mx_in()
        value = (
            body(states, u, p, t)
            if body
            else function(states, u[:hold_count], *between, p[:parameter_count], t)
        )
        argument_names = function.name_in(), function.name_out()
        return casadi.Function(function.name(), [x, u, *between, p, t], [value], *argument_names)

    def receiving(receive: Receive) -> Receive:
        """Return a receive with its edge function rewritten."""
        return receive if receive.edge is None else replace(receive, edge=repeated(receive.edge))

    clocks = tuple(
        replace(clock, tick=repeated(clock.tick), receives=tuple(map(receiving, clock.receives)))
        for clock in peer_type.clocks
    )
    sends = tuple(replace(send, send=repeated(send.send)) for send in peer_type.sends)
    ports = (
        None if peer_type.ports is None else ForcePorts(peer_type.ports.parts, repeated(peer_type.ports.port))
    )
    limits = tuple(
        limit if limit.value is None else replace(limit, value=repeated(limit.value))
        for limit in peer_type.limits
    )
    derivative = repeated(peer_type.derivative, rates)
    return replace(peer_type, derivative=derivative, clocks=clocks, sends=sends, ports=ports, limits=limits)


def published(name: str) -> dict[str, tuple[str, str, str]]:
    """Return the parameters of a hand of the library: minimum, maximum and default of each, with units.

    Parameters
    ----------
    name
        A component whose `mass`, `damping` and `stiffness` have a minimum, a maximum and a default.

    Raises
    ------
    ApcError
        E930 the library has no such component, or its parameters have no such bounds.
    """
    # The library reads YAML, which analyses of a compiled model do not need otherwise.
    from apc.compiler.components.component_library import Library

    library = Library()
    result = {
        component_name: ranges
        for component_name in library.component_names
        if (ranges := _impedance_ranges(library.component(component_name)))
    }
    if name not in result:
        listed = (*HANDS, *result)
        got = f"unknown hands {name[:40]!r}" if name.strip() else "no hands given"
        message = f"{got} ({', '.join(listed)})"
        near = nearest(name, listed)
        raise ApcError(
            Diagnostic("E930", SourceLocation("--hands"), message, fix=f"--hands {near or CLAMPED}")
        )
    return result[name]


def _impedance_ranges(component: Component | None) -> dict[str, tuple[str, str, str]]:
    """Return the bounds and defaults of a hand's mass, damping and stiffness; empty if a bound is missing."""
    declarations = {} if component is None else {declared.name: declared for declared in component.numbers}
    result = {}
    for name, unit, _ in _NUMBERS:
        declared = declarations.get(name)
        if (
            declared is None
            or declared.minimum is None
            or declared.maximum is None
            or declared.default is None
        ):
            return {}
        low, high, typical = (
            f"{float(v)!r} {unit}" for v in (declared.minimum, declared.maximum, declared.default)
        )
        result[f"{HAND}.{name}"] = low, high, typical
    return result
