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
from apc.frame.exact_arithmetic import evaluate_exact
from apc.frame.jacobians import SubsystemJacobians, jacobians
from apc.frame.linearize import InitialReception, start_arguments
from apc.frame.overrides import apply, parse_override
from apc.frame.parameters import exact_numbers, resolve

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
LOCAL_MASS = "masses: {device: {mass: 0.1 kg}}, where it moves in a plane with type: PlanarMass, at each peer"

# The names and descriptions of the parameters of a hand that is added to every device.
HAND = "hand"
# Units of the parameters of a hand: mass, damping, stiffness.
_IMPEDANCE = ("kg", "N*s/m", "kg/s", "N/m", "kg/s^2")
_NUMBERS = (
    ("mass", "kg", "what of the hand moves with the device"),
    ("damping", "N*s/m", "of the hand, to where the arm stands"),
    ("stiffness", "N/m", "of the hand, to where it holds the device at the start"),
)
# The example in a message: near the typical values of StylusArmForward in the library.
_TYPICAL = (("mass", "0.2 kg"), ("damping", "18 N*s/m"), ("stiffness", "270 N/m"))
_HAND_NAME = re.compile(rf"([\w.]+\.)?{HAND}\.\w")


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """The device of a peer: the part, or one axis of it, with its position and velocity states.

    A force F on it adds F · `inverse` to the rate of the velocity, exact for the parameters of the
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
    """Return the device of a peer, None if there is none, or the reason why it cannot be determined.

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
        return f"a hand may hold any of {', '.join(result)} ({peer_type.name})"
    text = next(iter(result.values()))
    return f"{text} ({peer_type.name})" if isinstance(text, str) else text


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
    gripped = {owner for owner in owners if _grips(peer_type, owner)}
    if not _is_plain(subsystem):
        return {}
    reported_by = _reported_by(subsystem)
    masses = tuple(index for index, name in enumerate(peer_type.parameters) if unit_of.get(name) == "kg")
    x, u, _, _, p, t = start_arguments(
        subsystem, exact_numbers(peer_type, parameters), Fraction, initial_reception
    )
    peers = peer_type.parameters.index(PEERS) if PEERS in peer_type.parameters else None
    over = masses if peers is None else (*masses, peers)
    result: dict[str, Device | str] = {}
    for index, state in enumerate(peer_type.states):
        driven = np.flatnonzero(subsystem.pattern.a[index])
        local = _part(state.name)
        requested = local in gripped if gripped else direct or local not in reported_by
        requested = part in (local, state.name) if part else requested
        if state.unit != "m" or not requested or len(driven) != 1 or subsystem.pattern.b[index].any():
            continue
        velocity = int(driven[0])
        slopes, *changes = evaluate_exact(_slopes(peer_type, velocity, over), [x, u, p, t])
        count, copied = Fraction(1), [False] * len(slopes)
        if peers is not None:
            count = p[peers]
            copied = [count * by == slope for slope, by in zip(slopes, changes[-1], strict=True)]
        inverses = {
            (mass, at): -change[at] / slopes[at] * (count if copied[at] else 1)
            for mass, change in enumerate(changes[: len(masses)])
            for at in range(len(slopes))
            if slopes[at] and change[at]
        }
        if state.name.endswith("]"):
            local = state.name  # one axis of several
        if len(set(inverses.values())) == 1:
            (mass, at), inverse = next(iter(inverses.items()))
            if copied[at] and direct and not part:
                continue
            shared = peers if copied[at] else None
            symbolic = _inverse(peer_type, velocity, masses[mass], at, shared)
            result[local] = Device(local, index, velocity, inverse, symbolic)
        elif inverses:
            result[local] = f"{local} moves with masses that move otherwise, and a hand may hold any of them"
    return result


@functools.lru_cache(maxsize=64)
def coupled_directly(peer_types: tuple[PeerType, ...]) -> bool:
    """Return whether devices are coupled directly: every mass is sent, and some peers have no hand.

    Where some peers have a hand, each of the others has the part that the hand is connected to, and may be
    held there.

    Parameters
    ----------
    peer_types
        The peer types of a model.
    """
    if any(_keeps_to_itself(jacobians(analyzed(peer_type))) for peer_type in peer_types):
        return False
    parts = [{_part(state.name) for state in peer_type.states} for peer_type in peer_types]
    gripped = [
        {part for part in local if _grips(peer_type, part)}
        for peer_type, local in zip(peer_types, parts, strict=True)
    ]
    anywhere = set().union(*gripped)
    return not all(gripped) and all(part & anywhere for part in parts if anywhere)


def _grips(peer_type: PeerType, part: str) -> bool:
    """Return whether a hand of the topology is connected to a part."""
    return any(part == text or part.startswith(f"{text}.") for text in peer_type.held)


def _keeps_to_itself(subsystem: SubsystemJacobians) -> bool:
    """Return whether a peer has a moving part whose position is not sent."""
    reported_by = _reported_by(subsystem)
    return any(
        state.unit == "m" and _part(state.name) not in reported_by and subsystem.pattern.a[index].any()
        for index, state in enumerate(subsystem.peer_type.states)
    )


def _reported_by(subsystem: SubsystemJacobians) -> set[str]:
    """Return the parts whose positions are sent, directly or in a computed value."""
    peer_type = subsystem.peer_type
    ticks = {tick.clock: tick for tick in subsystem.pattern.ticks}
    computed = [ticks[hold.clock].x[hold.output] for hold in peer_type.holds]
    return {
        _part(peer_type.states[index].name)
        for send, sending in zip(subsystem.pattern.sends, peer_type.sends, strict=True)
        for row, gripped, unit in zip(send.x, send.u, sending.units, strict=True)
        if unit == "m"
        for item in (row, *(computed[hold] for hold in np.flatnonzero(gripped)))
        for index in np.flatnonzero(item)
    }


@dataclass(frozen=True, slots=True, eq=False)
class ForceInput:
    """The effect of a force on a part, or along one axis of it: additions to velocity rates.

    `inverses` are exact, per newton, for the parameters of the linearization; `symbolic` gives them for any
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
    """Return the effect of a force along a position, None where no part has mass, or why it is refused.

    Parameters
    ----------
    subsystem, parameters, unit_of, initial_reception
        As for `find_device`.
    position
        The index of the position among the states.
    known
        The result for each part, stored from one position of a peer to the next; for a part of many positions
        all of them are searched.
    """
    known = {} if known is None else known
    peer_type, name = subsystem.peer_type, subsystem.peer_type.states[position].name
    why = None
    for part in (_part(name), name):
        if part not in known:
            known[part] = find_device(subsystem, parameters, unit_of, initial_reception, part=part)
        text = known[part]
        if isinstance(text, Device):
            return ForceInput(text.part, (text.velocity,), (text.inverse,), text.symbolic)
        why = text
    driven = np.flatnonzero(subsystem.pattern.a[position])
    masses = [
        index
        for index, parameter in enumerate(peer_type.parameters)
        if unit_of.get(parameter) == "kg" and _part(parameter) == _part(name)
    ]
    if why is None or len(driven) != 1 or len(masses) != 1 or not subsystem.walkable:
        return why
    velocity, mass = int(driven[0]), masses[0]
    x, u, _, _, p, t = start_arguments(
        subsystem, exact_numbers(peer_type, parameters), Fraction, initial_reception
    )
    peers = peer_type.parameters.index(PEERS) if PEERS in peer_type.parameters else None
    over = (mass,) if peers is None else (mass, peers)
    slopes, change, *by_peers = evaluate_exact(_slopes(peer_type, velocity, over), [x, u, p, t])
    at = next((k for k, (slope, by) in enumerate(zip(slopes, change, strict=True)) if slope and by), None)
    if at is None:
        return why
    shared = None if peers is None or p[peers] * by_peers[0][at] != slopes[at] else peers
    symbolic, moved = _column(peer_type, velocity, mass, at, shared)
    (inverses,) = evaluate_exact(symbolic, [x, u, p, t])
    return ForceInput(_part(name), moved, tuple(inverses), symbolic)


@functools.lru_cache(maxsize=64)
def _column(
    peer_type: PeerType, velocity: int, mass: int, at: int, peers: int | None
) -> tuple[Any, tuple[int, ...]]:
    """Return the effect of a force at a velocity on all rates, from the mass derivatives of the slopes."""
    x, u, p, t = peer_type.derivative.sx_in()
    rates = jacobian(peer_type.derivative(x, u, p, t), casadi.vertcat(x, u))[:, at]
    changes = casadi.jacobian(rates, p[mass])
    moved = tuple(changes.sparsity().row())
    copies = 1 if peers is None else p[peers]
    column = [-copies * changes[row] / rates[velocity] for row in moved]
    return casadi.Function("push", [x, u, p, t], [casadi.vertcat(*column)]), moved


def _part(name: str) -> str:
    """Return the part of a state or a parameter."""
    return name.rpartition(".")[0]


@functools.lru_cache(maxsize=64)
def _slopes(peer_type: PeerType, velocity: int, masses: tuple[int, ...]) -> Any:
    """Return the slopes of a velocity's rate over states and holds, and their derivatives over each mass."""
    slopes, changes, inputs = _rates(peer_type, velocity, masses)
    return casadi.Function("slopes", inputs, [casadi.densify(item) for item in (slopes, *changes)])


def _rates(peer_type: PeerType, velocity: int, masses: Sequence[int]) -> tuple[Any, list[Any], list[Any]]:
    """Return the same slopes and derivatives as expressions, with their symbols."""
    x, u, p, t = peer_type.derivative.sx_in()
    rate = peer_type.derivative(x, u, p, t)[velocity]
    slopes = jacobian(rate, casadi.vertcat(x, u)).T
    return slopes, [casadi.jacobian(slopes, p[mass]) for mass in masses], [x, u, p, t]


@functools.lru_cache(maxsize=64)
def _inverse(peer_type: PeerType, velocity: int, mass: int, at: int, peers: int | None) -> Any:
    """Return 1/m as a function of (x, u, p, t), from one slope and its derivative over a mass.

    For a mass that peers share the result is that of one copy: `peers` is the index of the number of peers
    among the parameters.
    """
    slopes, (change,), inputs = _rates(peer_type, velocity, [mass])
    copies = 1 if peers is None else inputs[2][peers]
    return casadi.Function("inverse_inertia", inputs, [casadi.simplify(-copies * change[at] / slopes[at])])


def devices_of(system: Model, *, option: str) -> dict[int, Device]:
    """Return the device of each peer type that has one; a server without a device is not held.

    Parameters
    ----------
    system
        The compiled model.
    option
        The option that requested it.

    Raises
    ------
    ApcError
        E931 no peer has a device, or one has several possible devices.
    """
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    numbers, direct = resolve(system), coupled_directly(system.peer_types)
    result: dict[int, Device] = {}
    for index, group in enumerate(system.groups):
        subsystem = jacobians(analyzed(system.peer_types[group.peer_type]))
        device = find_device(subsystem, numbers.parameters[index][0], unit_of, direct=direct)
        if isinstance(device, str):
            candidates = find_devices(subsystem, numbers.parameters[index][0], unit_of, direct=direct)
            hint = _name_gripped(system, subsystem.peer_type, candidates)
            raise ApcError(
                Diagnostic("E931", SourceLocation(system.origin.topology), f"{option}: {device}", hint=hint)
            )
        if device is not None:
            result.setdefault(group.peer_type, device)
    if not result:
        raise no_device(system, option)
    return result


def _name_gripped(system: Model, peer_type: PeerType, candidates: Mapping[str, Device | str]) -> str:
    """Return the entry of a hand on the first of several parts that can be held, or an empty entry."""
    part = next((local for local, device in candidates.items() if isinstance(device, Device)), "")
    if peer_type.held or len(candidates) < 2 or not part or part.endswith("]"):
        return ""
    having = [
        group.name
        for group in system.groups
        if any(_part(state.name) == part for state in system.peer_types[group.peer_type].states)
    ]
    at = f", at: [{', '.join(having)}]" if len(having) < len(system.groups) else ""
    return _HOLDS.format(part=part, at=at)


def directions_of(system: Model) -> dict[str, Model]:
    """Return one model for each direction in which its devices move, clamped in all other directions.

    The result is empty where each device moves along one line only.

    Parameters
    ----------
    system
        The compiled model.
    """
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    numbers, direct = resolve(system), coupled_directly(system.peer_types)
    requested: dict[str, None] = {}
    for index, group in enumerate(system.groups):
        subsystem = jacobians(analyzed(system.peer_types[group.peer_type]))
        result = find_devices(subsystem, numbers.parameters[index][0], unit_of, direct=direct)
        axes = {local: device for local, device in result.items() if isinstance(device, Device)}
        wholes = {whole_and_index(axis)[0] if axis.endswith("]") else "" for axis in axes}
        if len(axes) == len(result) > 1 and len(wholes) == 1 and "" not in wholes:
            requested |= dict.fromkeys(axis.rpartition(".")[2] for axis in axes)
    return {axis: _along(system, [text for text in requested if text != axis]) for axis in requested}


def _along(system: Model, others: Sequence[str]) -> Model:
    """Return a model in which every other axis of the devices is clamped at its start."""
    peer_types = []
    for peer_type in system.peer_types:
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
            peer_type = _without(peer_type, *(index[name] for name in pair))
        peer_types.append(peer_type)
    return replace(system, peer_types=tuple(peer_types))


def no_device(system: Model, option: str) -> ApcError:
    """Return the error for a model in which no peer has a device."""
    names = ", ".join(group.name for group in system.groups)
    message = f"{option}: nothing can be held at {names}: each mass is a copy that others are told of"
    return ApcError(Diagnostic("E931", SourceLocation(system.origin.topology), message, hint=LOCAL_MASS))


def refuse_hands(system: Model, option: str) -> None:
    """Raise ApcError E932 if a model has hands already."""
    for group in system.groups:
        for hand in system.peer_types[group.peer_type].hands:
            message = f"{option}: {group.name} has a hand already, {hand}"
            hint = f"a topology without {hand}, or no {option}"
            raise ApcError(Diagnostic("E932", SourceLocation(system.origin.topology), message, hint=hint))


def without_hands(system: Model, option: str) -> Model:
    """Return a model without its hands, which are replaced by others.

    Parameters
    ----------
    system
        The compiled model.
    option
        The option that requested it.

    Raises
    ------
    ApcError
        E932 a hand is more than a mass, damper and spring between a device and its rest position.
    """
    if not any(peer_type.hands for peer_type in system.peer_types):
        return system
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    peer_types = tuple(
        _without_hands(peer_type, tuple(map(unit_of.get, peer_type.parameters)))
        for peer_type in system.peer_types
    )
    bare = tuple(item or peer_type for item, peer_type in zip(peer_types, system.peer_types, strict=True))
    compiled_system = replace(system, peer_types=bare)
    refuse_hands(compiled_system, option)
    return compiled_system


@functools.lru_cache(maxsize=64)
def _without_hands(peer_type: PeerType, units: tuple[str | None, ...]) -> PeerType | None:
    """Return a peer type whose hands have no mass, damping and stiffness, None where other terms remain."""
    local = [
        index
        for index, name in enumerate(peer_type.parameters)
        if any(_is_of(name, hand) for hand in peer_type.hands)
    ]
    if (
        any(_is_of(state.name, hand) for state in peer_type.states for hand in peer_type.hands)
        or not peer_type.hands
    ):
        return None

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        numbers = casadi.vertsplit(p)
        for index in local:
            if units[index] in _IMPEDANCE:
                numbers[index] = casadi.SX(0)
        return peer_type.derivative(x, u, casadi.vertcat(*numbers), t)

    result = rewritten(replace(peer_type, hands=()), peer_type, lambda x, p: x, rates)
    x, u, p, t = result.derivative.sx_in()
    left = casadi.depends_on(result.derivative(x, u, p, t), casadi.vertcat(*(p[index] for index in local)))
    if left:
        return None
    return _with_linear(result, peer_type, lambda linear: _without_hands(linear, units) or linear)


def _is_of(name: str, hand: str) -> bool:
    """Return whether a state or a parameter belongs to a hand."""
    return name.startswith(f"{hand}.") or _part(name) == hand


def replaced_hands(system: Model) -> tuple[str, ...]:
    """Return the note on hands of the topology that are replaced."""
    names = [
        f"{hand} of {group.name}"
        for group in system.groups
        for hand in system.peer_types[group.peer_type].hands
    ]
    return (f"{', '.join(names)}: any passive hand stands there instead",) if names else ()


def with_hands(system: Model, hands: str) -> Model:
    """Return a model with the requested hands, and with a name that states them.

    Parameters
    ----------
    system
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
        return system
    if hands == CLAMPED:
        compiled_system, name = clamped(system, option=option), "devices clamped"
    elif hands in HANDS:
        compiled_system, name = gripped(system, option=option), "devices held"
    else:
        typical = {name: numbers[2] for name, numbers in published(hands).items()}
        compiled_system, name = gripped(system, option=option), f"hands {hands}"
        compiled_system = apply(
            compiled_system,
            [parse_override(compiled_system, f"{name}={value}") for name, value in typical.items()],
        )
    return replace(
        compiled_system, name=f"{system.name}, {name}", origin=system.origin.after((HANDS_CHANGE, hands))
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
        The parameters that are set or varied: names, or texts that begin with a name.

    Raises
    ------
    ApcError
        E930 none of `hand.mass`, `hand.damping` and `hand.stiffness` is among them.
    """
    if hands != HELD or any(map(names_hand, named)):
        return
    names = ", ".join(f"{HAND}.{name}" for name, _, _ in _NUMBERS)
    message, got = f"--hands {HELD}", "none, which is a free hand"
    hint = f"--hands {HELD} " + " ".join(f'--set "{HAND}.{name}={value}"' for name, value in _TYPICAL)
    raise ApcError(Diagnostic("E930", SourceLocation("--hands"), message, f"a value for {names}", got, hint))


def clamped(system: Model, *, option: str = "--hands clamped") -> Model:
    """Return a model whose devices are clamped at their start.

    Raises
    ------
    ApcError
        E931 as `devices_of`, E932 as `without_hands`.
    """
    system = without_hands(system, option)
    # For devices that move along several directions all directions but one are clamped first.
    system = next(iter(directions_of(system).values()), system)
    devices = devices_of(system, option=option)
    peer_types = list(system.peer_types)
    for number, device in devices.items():
        peer_type = peer_types[number]
        peer_types[number] = _without(peer_type, device.position, device.velocity)
    return replace(system, peer_types=tuple(peer_types))


def gripped(system: Model, *, option: str) -> Model:
    """Return a model with a hand on every device: mass, damping and stiffness are parameters, 0 at first.

    Raises
    ------
    ApcError
        E931 as `devices_of`, E932 hands in the topology.
    """
    refuse_hands(system, option)
    devices = devices_of(system, option=option)
    names = tuple(f"{HAND}.{name}" for name, _, _ in _NUMBERS)
    peer_types = list(system.peer_types)
    for number, device in devices.items():
        peer_types[number] = _with_hand(
            peer_types[number], device.position, device.velocity, device.symbolic, names
        )
    added = tuple(
        Parameter(name, unit, 0.0, minimum=0.0, description=description)
        for name, (_, unit, description) in zip(names, _NUMBERS, strict=True)
    )
    return replace(system, peer_types=tuple(peer_types), parameters=(*system.parameters, *added))


@functools.lru_cache(maxsize=64)
def _with_hand(
    peer_type: PeerType, position: int, velocity: int, inverse_inertia: Any, names: tuple[str, ...]
) -> PeerType:
    """Return a peer type whose device carries a hand: (m + m_h) v' = m v'₀ − b_h v − k_h (x − x₀)."""
    local = len(peer_type.parameters)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        mass, damping, stiffness = casadi.vertsplit(p[local:])
        start = p[peer_type.parameters.index(peer_type.states[position].start)]
        rate = peer_type.derivative(x, u, p[:local], t)
        inverse = inverse_inertia(x, u, p[:local], t)
        pull = damping * x[velocity] + stiffness * (x[position] - start)
        row = (rate[velocity] - inverse * pull) / (1 + inverse * mass)
        return casadi.vertcat(rate[:velocity], row, rate[velocity + 1 :])

    larger = replace(peer_type, parameters=(*peer_type.parameters, *names))
    return _with_linear(
        rewritten(larger, peer_type, lambda x, p: x, rates),
        peer_type,
        lambda linear: _with_hand(linear, position, velocity, inverse_inertia, names),
    )


@functools.lru_cache(maxsize=64)
def _without(peer_type: PeerType, position: int, velocity: int) -> PeerType:
    """Return a peer type whose device stays at its start and has no states."""
    stored = [index for index in range(len(peer_type.states)) if index not in (position, velocity)]
    start = peer_type.parameters.index(peer_type.states[position].start)

    def whole(x: Any, p: Any) -> Any:
        expressions = [casadi.SX(0)] * len(peer_type.states)
        for number, index in enumerate(stored):
            expressions[index] = x[number]
        expressions[position] = p[start]
        return casadi.vertcat(*expressions)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        rate = peer_type.derivative(x, u, p, t)
        return casadi.vertcat(*(rate[index] for index in stored))

    smaller = replace(peer_type, states=tuple(peer_type.states[index] for index in stored))
    return _with_linear(
        rewritten(smaller, peer_type, whole, rates),
        peer_type,
        lambda linear: _without(linear, position, velocity),
    )


def _with_linear(result: PeerType, before: PeerType, change: Callable[[PeerType], PeerType]) -> PeerType:
    """Return a changed peer type with the same change of the type that represents it in a linear analysis."""
    return replace(result, linear=None if before.linear is None else change(before.linear))


def analyzed(peer_type: PeerType) -> PeerType:
    """Return the peer type that represents a type in a linear analysis."""
    return peer_type.linear or peer_type


def rewritten(
    peer_type: PeerType,
    before: PeerType,
    whole: Callable[[Any, Any], Any],
    rates: Callable[[Any, Any, Any, Any], Any],
) -> PeerType:
    """Return a peer type with other states, parameters or additional holds, and the functions for them.

    Parameters
    ----------
    peer_type, before
        The new type, with the functions of the type before.
    whole
        Gives the states of the type before, from the new states and the parameters.
    rates
        Gives the new rates, from the states before and the new holds, parameters and time.
    """
    sizes = len(peer_type.states), len(peer_type.holds), len(peer_type.parameters)
    x, u, p = (casadi.SX.sym(name, size) for name, size in zip("xup", sizes, strict=True))
    states, gripped, local = whole(x, p), len(before.holds), len(before.parameters)

    def repeated(function: Any, body: Callable[..., Any] | None = None) -> Any:
        """Return a function (x, u, …, p, t) over the new states, holds and parameters."""
        _, _, *between, _, t = function.sx_in()
        value = body(states, u, p, t) if body else function(states, u[:gripped], *between, p[:local], t)
        named = function.name_in(), function.name_out()
        return casadi.Function(function.name(), [x, u, *between, p, t], [value], *named)

    def receiving(receive: Receive) -> Receive:
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
        if (ranges := _ranges(library.component(component_name)))
    }
    if name not in result:
        listed = (*HANDS, *result)
        got = f"there are no hands {name[:40]!r}" if name.strip() else "no hands are named"
        message = f"{got} ({', '.join(listed)})"
        near = nearest(name, listed)
        raise ApcError(
            Diagnostic("E930", SourceLocation("--hands"), message, hint=f"--hands {near or CLAMPED}")
        )
    return result[name]


def _ranges(component: Component | None) -> dict[str, tuple[str, str, str]]:
    """Return the bounds and defaults of a hand's mass, damping and stiffness, empty if there are none."""
    numbers = {} if component is None else {number.name: number for number in component.numbers}
    result = {}
    for name, unit, _ in _NUMBERS:
        number = numbers.get(name)
        if number is None or number.minimum is None or number.maximum is None or number.default is None:
            return {}
        low, high, typical = (
            f"{float(v)!r} {unit}" for v in (number.minimum, number.maximum, number.default)
        )
        result[f"{HAND}.{name}"] = low, high, typical
    return result
