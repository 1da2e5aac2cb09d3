"""What a hand holds: a peer's device, found in its equations, and the peer with a hand on it.

Takes: a kind's Jacobians and exact numbers; a `Model`.
Gives: `Device`, `find_device`, `find_devices`, `devices_of`, `coupled_directly`,
`directions_of`; `no_device`; `ForceInput`,
`find_push`; `HANDS`, `with_hands`, `without_hands`, `clamped`, `held`; `replaced_hands`; `refuse_hands`;
`published`; `names_hand`, `refuse_numberless`; `OWN_MASS`, `UNHELD`.
Guarantees: a scene that is clamped or held is a scene as any other: parameters, groups and clocks stay.
Does not: ask whether it is stable (see `passivity` for hands of every kind).

A device is the part that a hand of the scene is joined to. Where there is none, it is what a peer moves and
does not tell others about: what it tells them of is a copy of what all hold; where no peer has anything else,
it is a mass that is no such copy, as of two devices that are coupled directly. With m v' = f + …, a slope of
v' over anything at all is J = j/m, so 1/m = −(∂J/∂m)/J: what a force at that place does, whatever is rigidly
connected with it. A copy of a shared mass is one of n: there J = n j/m.
With M v' = f of several that move with one another, a mass of place i adds to M there: ∂J/∂m = −M⁻¹ eᵢ Jᵢ,
whose columns say what a force at i does to all of them, M⁻¹ eᵢ.
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
from apc.frame.exact import evaluate_exact
from apc.frame.jacobians import SubsystemJacobians, jacobians
from apc.frame.linearize import InitialReception, start_arguments
from apc.frame.overrides import apply, parse_override
from apc.frame.parameters import exact_numbers, resolve

if TYPE_CHECKING:
    from apc.compiler.components.component import Component

# How hands can be taken: as the scene has them, holding devices fast, or as a mass, damper and spring each;
# and as all that give back no more energy than they got, which changes no scene.
FREE, CLAMPED, HELD, PASSIVE = HANDS = ("free", "clamped", "held", "passive")

# Codes of a scene that can't have the hands asked for, where another could.
UNHELD = ("E931", "E932")
# A force of 0 N that names the part in a hand, and changes nothing else.
_HOLDS = "hands: {{grip: {{type: ConstantForce, flange: {part}, force: 0 N{at}}}}}"

# What a peer without a device lacks.
OWN_MASS = "masses: {device: {mass: 0.1 kg}}, where it moves in a plane with type: PlanarMass, at each peer"

# What the parameters of a hand that is put on every device are named after, and what each is.
HAND = "hand"
# Units of what makes a hand a mass, a damper or a spring.
_IMPEDANCE = ("kg", "N*s/m", "kg/s", "N/m", "kg/s^2")
_NUMBERS = (
    ("mass", "kg", "what of the hand moves with the device"),
    ("damping", "N*s/m", "of the hand, to where the arm stands"),
    ("stiffness", "N/m", "of the hand, to where it holds the device at the start"),
)
# The example in a message: about the usual values of StylusArmForward in the library.
_USUAL = (("mass", "0.2 kg"), ("damping", "18 N*s/m"), ("stiffness", "270 N/m"))
_HAND_NAME = re.compile(rf"([\w.]+\.)?{HAND}\.\w")


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """What a hand holds: the part, or an axis of it, its position and velocity among the states.

    A force F there adds F · `inverse` to the rate of the velocity, exact for the numbers it was found with;
    `mass` is the same for any, as a CasADi function (x, u, p, t) → 1/m.
    """

    part: str
    position: int
    velocity: int
    inverse: Fraction
    symbolic: Any  # casadi.Function


def find_device(
    site: SubsystemJacobians,
    parameters: NDArray[np.float64],
    unit_of: Mapping[str, str],
    listening: InitialReception | None = None,
    *,
    part: str = "",
    direct: bool = False,
) -> Device | str | None:
    """Return what a hand holds, None where there is nothing; or say why that can't be said.

    Parameters
    ----------
    site, parameters, unit_of, listening, part, direct
        As for `find_devices`.
    """
    kind = site.kind
    if not _is_plain(site):
        return f"{kind.name} has a nonlinear loop"
    result = find_devices(site, parameters, unit_of, listening, part=part, direct=direct)
    if not result:
        return None
    if len(result) > 1 and any(isinstance(item, Device) for item in result.values()):
        return f"a hand may hold any of {', '.join(result)} ({kind.name})"
    text = next(iter(result.values()))
    return f"{text} ({kind.name})" if isinstance(text, str) else text


def _is_plain(site: SubsystemJacobians) -> bool:
    """Return whether a site's equations can be walked through: they have no nonlinear loop."""
    return bool(site.walkable and site.kind.derivative.is_a("SXFunction"))


def find_devices(
    site: SubsystemJacobians,
    parameters: NDArray[np.float64],
    unit_of: Mapping[str, str],
    listening: InitialReception | None = None,
    *,
    part: str = "",
    direct: bool = False,
) -> dict[str, Device | str]:
    """Return what a hand may hold, by name; or why that can't be held, in words.

    Parameters
    ----------
    site, parameters, unit_of, listening
        The kind, a vector (n_p,) of its parameters, their units, and what it hears at the start.
    part
        The part that is meant, or the axis of one that moves along several, `device.x[2]`; without it, the
        only one that a hand is joined to, or else that others are not told about.
    direct
        Whether devices are coupled directly (see `coupled_directly`): without a part, one is meant that
        others are told about, too, if it is no copy of a shared one.
    """
    kind = site.kind
    owners = {_part(state.name) for state in kind.states}
    gripped = {owner for owner in owners if _grips(kind, owner)}
    if not _is_plain(site):
        return {}
    told_of = _told_of(site)
    masses = tuple(place for place, name in enumerate(kind.parameters) if unit_of.get(name) == "kg")
    x, u, _, _, p, t = start_arguments(site, exact_numbers(kind, parameters), Fraction, listening)
    peers = kind.parameters.index(PEERS) if PEERS in kind.parameters else None
    over = masses if peers is None else (*masses, peers)
    result: dict[str, Device | str] = {}
    for place, state in enumerate(kind.states):
        driven = np.flatnonzero(site.pattern.a[place])
        own = _part(state.name)
        wanted = own in gripped if gripped else direct or own not in told_of
        wanted = part in (own, state.name) if part else wanted
        if state.unit != "m" or not wanted or len(driven) != 1 or site.pattern.b[place].any():
            continue
        velocity = int(driven[0])
        slopes, *changes = evaluate_exact(_slopes(kind, velocity, over), [x, u, p, t])
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
            own = state.name  # one axis of several
        if len(set(inverses.values())) == 1:
            (mass, at), inverse = next(iter(inverses.items()))
            if copied[at] and direct and not part:
                continue
            shared = peers if copied[at] else None
            symbolic = _inverse(kind, velocity, masses[mass], at, shared)
            result[own] = Device(own, place, velocity, inverse, symbolic)
        elif inverses:
            result[own] = f"{own} moves with masses that move otherwise, and a hand may hold any of them"
    return result


@functools.lru_cache(maxsize=64)
def coupled_directly(kinds: tuple[PeerType, ...]) -> bool:
    """Say whether devices are coupled directly: no mass is kept from the others, and some peers have no hand.

    Where some have a hand, each of the others has the part that it is joined to, and may be held there.

    Parameters
    ----------
    kinds
        Those of a scene.
    """
    if any(_keeps_to_itself(jacobians(analyzed(kind))) for kind in kinds):
        return False
    parts = [{_part(state.name) for state in kind.states} for kind in kinds]
    gripped = [{part for part in own if _grips(kind, part)} for kind, own in zip(kinds, parts, strict=True)]
    anywhere = set().union(*gripped)
    return not all(gripped) and all(part & anywhere for part in parts if anywhere)


def _grips(kind: PeerType, part: str) -> bool:
    """Say whether a hand of the scene is joined to a part."""
    return any(part == text or part.startswith(f"{text}.") for text in kind.held)


def _keeps_to_itself(site: SubsystemJacobians) -> bool:
    """Say whether a peer moves something that it tells nobody about."""
    told_of = _told_of(site)
    return any(
        state.unit == "m" and _part(state.name) not in told_of and site.pattern.a[place].any()
        for place, state in enumerate(site.kind.states)
    )


def _told_of(site: SubsystemJacobians) -> set[str]:
    """Return the parts whose positions others are told: as they are, or in what was computed to be sent."""
    kind = site.kind
    ticks = {tick.clock: tick for tick in site.pattern.ticks}
    computed = [ticks[hold.clock].x[hold.output] for hold in kind.holds]
    return {
        _part(kind.states[place].name)
        for send, sending in zip(site.pattern.sends, kind.sends, strict=True)
        for row, held, unit in zip(send.x, send.u, sending.units, strict=True)
        if unit == "m"
        for item in (row, *(computed[hold] for hold in np.flatnonzero(held)))
        for place in np.flatnonzero(item)
    }


@dataclass(frozen=True, slots=True, eq=False)
class ForceInput:
    """What a force at a part, or along an axis of it, does: so much to the rate of each of some velocities.

    `inverses` are exact, per newton, for the numbers it was found with; `symbolic` gives them for any, as a
    CasADi function (x, u, p, t).
    """

    part: str
    velocities: tuple[int, ...]
    inverses: tuple[Fraction, ...]
    symbolic: Any  # casadi.Function


def find_push(
    site: SubsystemJacobians,
    parameters: NDArray[np.float64],
    unit_of: Mapping[str, str],
    listening: InitialReception | None,
    position: int,
    known: dict[str, Device | str | None] | None = None,
) -> ForceInput | str | None:
    """Return what a force along a position of a peer does, None where nothing has a mass, or why not.

    Parameters
    ----------
    site, parameters, unit_of, listening
        As for `find_device`.
    position
        Its place among the states.
    known
        What each part is found to be, kept here from one position of a peer to the next: of a part of many
        positions all are looked through.
    """
    known = {} if known is None else known
    kind, name = site.kind, site.kind.states[position].name
    why = None
    for part in (_part(name), name):
        if part not in known:
            known[part] = find_device(site, parameters, unit_of, listening, part=part)
        text = known[part]
        if isinstance(text, Device):
            return ForceInput(text.part, (text.velocity,), (text.inverse,), text.symbolic)
        why = text
    driven = np.flatnonzero(site.pattern.a[position])
    masses = [
        place
        for place, parameter in enumerate(kind.parameters)
        if unit_of.get(parameter) == "kg" and _part(parameter) == _part(name)
    ]
    if why is None or len(driven) != 1 or len(masses) != 1 or not site.walkable:
        return why
    velocity, mass = int(driven[0]), masses[0]
    x, u, _, _, p, t = start_arguments(site, exact_numbers(kind, parameters), Fraction, listening)
    peers = kind.parameters.index(PEERS) if PEERS in kind.parameters else None
    over = (mass,) if peers is None else (mass, peers)
    slopes, change, *by_peers = evaluate_exact(_slopes(kind, velocity, over), [x, u, p, t])
    at = next((k for k, (slope, by) in enumerate(zip(slopes, change, strict=True)) if slope and by), None)
    if at is None:
        return why
    shared = None if peers is None or p[peers] * by_peers[0][at] != slopes[at] else peers
    symbolic, moved = _column(kind, velocity, mass, at, shared)
    (inverses,) = evaluate_exact(symbolic, [x, u, p, t])
    return ForceInput(_part(name), moved, tuple(inverses), symbolic)


@functools.lru_cache(maxsize=64)
def _column(
    kind: PeerType, velocity: int, mass: int, at: int, peers: int | None
) -> tuple[Any, tuple[int, ...]]:
    """Return what a force at a velocity does to others' rates, from how slopes change with its mass."""
    x, u, p, t = kind.derivative.sx_in()
    rates = jacobian(kind.derivative(x, u, p, t), casadi.vertcat(x, u))[:, at]
    changes = casadi.jacobian(rates, p[mass])
    moved = tuple(changes.sparsity().row())
    copies = 1 if peers is None else p[peers]
    column = [-copies * changes[row] / rates[velocity] for row in moved]
    return casadi.Function("push", [x, u, p, t], [casadi.vertcat(*column)]), moved


def _part(name: str) -> str:
    """Return the part that a state or a parameter is of."""
    return name.rpartition(".")[0]


@functools.lru_cache(maxsize=64)
def _slopes(kind: PeerType, velocity: int, masses: tuple[int, ...]) -> Any:
    """Return the slopes of a velocity's rate over states and holds, and how they change with each mass."""
    slopes, changes, inputs = _rates(kind, velocity, masses)
    return casadi.Function("slopes", inputs, [casadi.densify(item) for item in (slopes, *changes)])


def _rates(kind: PeerType, velocity: int, masses: Sequence[int]) -> tuple[Any, list[Any], list[Any]]:
    """Return the same as expressions, and the symbols they are of."""
    x, u, p, t = kind.derivative.sx_in()
    rate = kind.derivative(x, u, p, t)[velocity]
    slopes = jacobian(rate, casadi.vertcat(x, u)).T
    return slopes, [casadi.jacobian(slopes, p[mass]) for mass in masses], [x, u, p, t]


@functools.lru_cache(maxsize=64)
def _inverse(kind: PeerType, velocity: int, mass: int, at: int, peers: int | None) -> Any:
    """Return 1/m as a function of (x, u, p, t), from one slope and how it changes with a mass.

    Of a mass that peers share it is that of a copy: `peers` is where their number is among the parameters.
    """
    slopes, (change,), inputs = _rates(kind, velocity, [mass])
    copies = 1 if peers is None else inputs[2][peers]
    return casadi.Function("inverse_inertia", inputs, [casadi.simplify(-copies * change[at] / slopes[at])])


def devices_of(system: Model, *, option: str) -> dict[int, Device]:
    """Return the device of each kind of peer that has one; a server without any is not held.

    Parameters
    ----------
    system
        The compiled scene.
    option
        What asked for it.

    Raises
    ------
    ApcError
        E931 no peer with a device, or one with several that a hand might hold.
    """
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    numbers, direct = resolve(system), coupled_directly(system.kinds)
    result: dict[int, Device] = {}
    for place, group in enumerate(system.groups):
        site = jacobians(analyzed(system.kinds[group.kind]))
        device = find_device(site, numbers.parameters[place][0], unit_of, direct=direct)
        if isinstance(device, str):
            found = find_devices(site, numbers.parameters[place][0], unit_of, direct=direct)
            hint = _naming_what_is_held(system, site.kind, found)
            raise ApcError(
                Diagnostic("E931", SourceLocation(system.origin.topology), f"{option}: {device}", hint=hint)
            )
        if device is not None:
            result.setdefault(group.kind, device)
    if not result:
        raise no_device(system, option)
    return result


def _naming_what_is_held(system: Model, kind: PeerType, found: Mapping[str, Device | str]) -> str:
    """Return the entry of a hand at the first of several parts that a hand may hold, or nothing."""
    part = next((own for own, device in found.items() if isinstance(device, Device)), "")
    if kind.held or len(found) < 2 or not part or part.endswith("]"):
        return ""
    having = [
        group.name
        for group in system.groups
        if any(_part(state.name) == part for state in system.kinds[group.kind].states)
    ]
    at = f", at: [{', '.join(having)}]" if len(having) < len(system.groups) else ""
    return _HOLDS.format(part=part, at=at)


def directions_of(system: Model) -> dict[str, Model]:
    """Return the scene once for each direction in which its devices move, held fast in all others.

    Nothing where each device moves along one line only.

    Parameters
    ----------
    system
        The compiled scene.
    """
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    numbers, direct = resolve(system), coupled_directly(system.kinds)
    wanted: dict[str, None] = {}
    for place, group in enumerate(system.groups):
        site = jacobians(analyzed(system.kinds[group.kind]))
        result = find_devices(site, numbers.parameters[place][0], unit_of, direct=direct)
        axes = {own: device for own, device in result.items() if isinstance(device, Device)}
        wholes = {whole_and_index(axis)[0] if axis.endswith("]") else "" for axis in axes}
        if len(axes) == len(result) > 1 and len(wholes) == 1 and "" not in wholes:
            wanted |= dict.fromkeys(axis.rpartition(".")[2] for axis in axes)
    return {axis: _along(system, [text for text in wanted if text != axis]) for axis in wanted}


def _along(system: Model, others: Sequence[str]) -> Model:
    """Return a scene in which whatever moves along other axes is held where it starts."""
    kinds = []
    for kind in system.kinds:
        moving = [
            (place, int(driven[0]))
            for place, state in enumerate(kind.states)
            if state.unit == "m" and any(state.name.endswith(f".{axis}") for axis in others)
            if len(driven := np.flatnonzero(jacobians(analyzed(kind)).pattern.a[place])) == 1
        ]
        names = [(kind.states[position].name, kind.states[velocity].name) for position, velocity in moving]
        for pair in names:
            place = {state.name: number for number, state in enumerate(kind.states)}
            kind = _without(kind, *(place[name] for name in pair))
        kinds.append(kind)
    return replace(system, kinds=tuple(kinds))


def no_device(system: Model, option: str) -> ApcError:
    """Return the refusal of a scene in which nobody has a device."""
    names = ", ".join(group.name for group in system.groups)
    what = f"{option}: nothing can be held at {names}: each mass is a copy that others are told of"
    return ApcError(Diagnostic("E931", SourceLocation(system.origin.topology), what, hint=OWN_MASS))


def refuse_hands(system: Model, option: str) -> None:
    """Refuse a scene that has hands already: ApcError E932."""
    for group in system.groups:
        for hand in system.kinds[group.kind].hands:
            what = f"{option}: {group.name} has a hand already, {hand}"
            hint = f"a scene without {hand}, or no {option}"
            raise ApcError(Diagnostic("E932", SourceLocation(system.origin.topology), what, hint=hint))


def without_hands(system: Model, option: str) -> Model:
    """Return a scene without its hands, in the place of which others stand.

    Parameters
    ----------
    system
        The compiled scene.
    option
        What asked for it.

    Raises
    ------
    ApcError
        E932 a hand that is more than a mass, damper and spring between a device and where it stands.
    """
    if not any(kind.hands for kind in system.kinds):
        return system
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    kinds = tuple(_without_hands(kind, tuple(map(unit_of.get, kind.parameters))) for kind in system.kinds)
    bare = tuple(item or kind for item, kind in zip(kinds, system.kinds, strict=True))
    compiled_system = replace(system, kinds=bare)
    refuse_hands(compiled_system, option)
    return compiled_system


@functools.lru_cache(maxsize=64)
def _without_hands(kind: PeerType, units: tuple[str | None, ...]) -> PeerType | None:
    """Return a kind whose hands have no mass, damping nor stiffness, None where more of them is left."""
    own = [
        place for place, name in enumerate(kind.parameters) if any(_is_of(name, hand) for hand in kind.hands)
    ]
    if any(_is_of(state.name, hand) for state in kind.states for hand in kind.hands) or not kind.hands:
        return None

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        numbers = casadi.vertsplit(p)
        for place in own:
            if units[place] in _IMPEDANCE:
                numbers[place] = casadi.SX(0)
        return kind.derivative(x, u, casadi.vertcat(*numbers), t)

    result = rewritten(replace(kind, hands=()), kind, lambda x, p: x, rates)
    x, u, p, t = result.derivative.sx_in()
    left = casadi.depends_on(result.derivative(x, u, p, t), casadi.vertcat(*(p[place] for place in own)))
    if left:
        return None
    return _with_linear(result, kind, lambda linear: _without_hands(linear, units) or linear)


def _is_of(name: str, hand: str) -> bool:
    """Say whether a state or a parameter is of a hand."""
    return name.startswith(f"{hand}.") or _part(name) == hand


def replaced_hands(system: Model) -> tuple[str, ...]:
    """Return what is said of hands of the scene in the place of which others stand."""
    names = [f"{hand} of {group.name}" for group in system.groups for hand in system.kinds[group.kind].hands]
    return (f"{', '.join(names)}: any passive hand stands there instead",) if names else ()


def with_hands(system: Model, hands: str) -> Model:
    """Return a scene with hands of a kind, its name saying so.

    Parameters
    ----------
    system
        The compiled scene.
    hands
        "free": as it is. "clamped": its devices are held fast. "held": a hand of `hand.mass`, `hand.damping`
        and `hand.stiffness` on each, 0 at first. "passive": as it is. Or one of
        the library, of its usual numbers (see `published`).

    Raises
    ------
    ApcError
        E930 no such hands; E931 no device; E932 hands in the scene.
    """
    option = f"--hands {hands}"
    if hands in (FREE, PASSIVE):
        return system
    if hands == CLAMPED:
        compiled_system, name = clamped(system, option=option), "devices clamped"
    elif hands in HANDS:
        compiled_system, name = held(system, option=option), "devices held"
    else:
        usual = {name: numbers[2] for name, numbers in published(hands).items()}
        compiled_system, name = held(system, option=option), f"hands {hands}"
        compiled_system = apply(
            compiled_system,
            [parse_override(compiled_system, f"{name}={value}") for name, value in usual.items()],
        )
    return replace(
        compiled_system, name=f"{system.name}, {name}", origin=system.origin.after((HANDS_CHANGE, hands))
    )


def names_hand(text: str) -> bool:
    """Return whether a text begins with a parameter of the hand that `held` puts on a device."""
    return bool(_HAND_NAME.match(text.strip()))


def refuse_numberless(hands: str, named: Iterable[str]) -> None:
    """Refuse hands that are held but have no number: a hand of 0 kg, 0 N*s/m and 0 N/m is a free hand.

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
    what, got = f"--hands {HELD}", "none, which is a free hand"
    hint = f"--hands {HELD} " + " ".join(f'--set "{HAND}.{name}={value}"' for name, value in _USUAL)
    raise ApcError(Diagnostic("E930", SourceLocation("--hands"), what, f"a value for {names}", got, hint))


def clamped(system: Model, *, option: str = "--hands clamped") -> Model:
    """Return a scene whose devices are held fast where they start.

    Raises
    ------
    ApcError
        E931 as `devices_of`, E932 as `without_hands`.
    """
    system = without_hands(system, option)
    # Of devices that move along several directions all but one are held first.
    system = next(iter(directions_of(system).values()), system)
    devices = devices_of(system, option=option)
    kinds = list(system.kinds)
    for number, device in devices.items():
        kind = kinds[number]
        kinds[number] = _without(kind, device.position, device.velocity)
    return replace(system, kinds=tuple(kinds))


def held(system: Model, *, option: str) -> Model:
    """Return a scene with a hand on every device: mass, damping and stiffness are parameters, 0 at first.

    Raises
    ------
    ApcError
        E931 as `devices_of`, E932 hands in the scene.
    """
    refuse_hands(system, option)
    devices = devices_of(system, option=option)
    names = tuple(f"{HAND}.{name}" for name, _, _ in _NUMBERS)
    kinds = list(system.kinds)
    for number, device in devices.items():
        kinds[number] = _with_hand(kinds[number], device.position, device.velocity, device.symbolic, names)
    added = tuple(
        Parameter(name, unit, 0.0, minimum=0.0, about=about)
        for name, (_, unit, about) in zip(names, _NUMBERS, strict=True)
    )
    return replace(system, kinds=tuple(kinds), parameters=(*system.parameters, *added))


@functools.lru_cache(maxsize=64)
def _with_hand(
    kind: PeerType, position: int, velocity: int, inverse_inertia: Any, names: tuple[str, ...]
) -> PeerType:
    """Return a kind whose device carries a hand: (m + m_h) v' = m v'₀ − b_h v − k_h (x − x₀)."""
    own = len(kind.parameters)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        mass, damping, stiffness = casadi.vertsplit(p[own:])
        start = p[kind.parameters.index(kind.states[position].start)]
        rate = kind.derivative(x, u, p[:own], t)
        inverse = inverse_inertia(x, u, p[:own], t)
        pull = damping * x[velocity] + stiffness * (x[position] - start)
        row = (rate[velocity] - inverse * pull) / (1 + inverse * mass)
        return casadi.vertcat(rate[:velocity], row, rate[velocity + 1 :])

    larger = replace(kind, parameters=(*kind.parameters, *names))
    return _with_linear(
        rewritten(larger, kind, lambda x, p: x, rates),
        kind,
        lambda linear: _with_hand(linear, position, velocity, inverse_inertia, names),
    )


@functools.lru_cache(maxsize=64)
def _without(kind: PeerType, position: int, velocity: int) -> PeerType:
    """Return a kind whose device stays where it starts, and is no state."""
    kept = [place for place in range(len(kind.states)) if place not in (position, velocity)]
    start = kind.parameters.index(kind.states[position].start)

    def whole(x: Any, p: Any) -> Any:
        expressions = [casadi.SX(0)] * len(kind.states)
        for number, place in enumerate(kept):
            expressions[place] = x[number]
        expressions[position] = p[start]
        return casadi.vertcat(*expressions)

    def rates(x: Any, u: Any, p: Any, t: Any) -> Any:
        rate = kind.derivative(x, u, p, t)
        return casadi.vertcat(*(rate[place] for place in kept))

    smaller = replace(kind, states=tuple(kind.states[place] for place in kept))
    return _with_linear(
        rewritten(smaller, kind, whole, rates), kind, lambda linear: _without(linear, position, velocity)
    )


def _with_linear(result: PeerType, before: PeerType, change: Callable[[PeerType], PeerType]) -> PeerType:
    """Return a changed kind with the same change of the kind that represents it in a linear analysis."""
    return replace(result, linear=None if before.linear is None else change(before.linear))


def analyzed(kind: PeerType) -> PeerType:
    """Return the kind that represents a kind in a linear analysis."""
    return kind.linear or kind


def rewritten(
    kind: PeerType,
    before: PeerType,
    whole: Callable[[Any, Any], Any],
    rates: Callable[[Any, Any, Any, Any], Any],
) -> PeerType:
    """Return a kind of other states, parameters or more holds with its functions.

    Parameters
    ----------
    kind, before
        What it is to be, with the functions that the kind had before.
    whole
        Gives the states of before, from those of now and the parameters.
    rates
        Gives the rates of now, from the states of before, the holds and parameters of now and the time.
    """
    sizes = len(kind.states), len(kind.holds), len(kind.parameters)
    x, u, p = (casadi.SX.sym(name, size) for name, size in zip("xup", sizes, strict=True))
    states, held, own = whole(x, p), len(before.holds), len(before.parameters)

    def again(function: Any, body: Callable[..., Any] | None = None) -> Any:
        """Return a function (x, u, …, p, t) over the states, holds and parameters of now."""
        _, _, *between, _, t = function.sx_in()
        value = body(states, u, p, t) if body else function(states, u[:held], *between, p[:own], t)
        named = function.name_in(), function.name_out()
        return casadi.Function(function.name(), [x, u, *between, p, t], [value], *named)

    def receiving(receive: Receive) -> Receive:
        return receive if receive.edge is None else replace(receive, edge=again(receive.edge))

    clocks = tuple(
        replace(clock, tick=again(clock.tick), receives=tuple(map(receiving, clock.receives)))
        for clock in kind.clocks
    )
    sends = tuple(replace(send, send=again(send.send)) for send in kind.sends)
    ports = None if kind.ports is None else ForcePorts(kind.ports.parts, again(kind.ports.port))
    limits = tuple(
        limit if limit.value is None else replace(limit, value=again(limit.value)) for limit in kind.limits
    )
    derivative = again(kind.derivative, rates)
    return replace(kind, derivative=derivative, clocks=clocks, sends=sends, ports=ports, limits=limits)


def published(name: str) -> dict[str, tuple[str, str, str]]:
    """Return the parameters of a hand of the library: least, largest and usual value of each, with units.

    Parameters
    ----------
    name
        A component whose `mass`, `damping` and `stiffness` have bounds on either side, and defaults between.

    Raises
    ------
    ApcError
        E930 the library has no such component, or it says no such bounds.
    """
    # The library reads YAML, which no analysis of a compiled model does otherwise.
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
        what = f"{got} ({', '.join(listed)})"
        near = nearest(name, listed)
        raise ApcError(Diagnostic("E930", SourceLocation("--hands"), what, hint=f"--hands {near or CLAMPED}"))
    return result[name]


def _ranges(component: Component | None) -> dict[str, tuple[str, str, str]]:
    """Return the bounds and defaults of a hand's mass, damping and stiffness, nothing if they have none."""
    numbers = {} if component is None else {number.name: number for number in component.numbers}
    result = {}
    for name, unit, _ in _NUMBERS:
        number = numbers.get(name)
        if number is None or number.minimum is None or number.maximum is None or number.default is None:
            return {}
        low, high, usual = (f"{float(v)!r} {unit}" for v in (number.minimum, number.maximum, number.default))
        result[f"{HAND}.{name}"] = low, high, usual
    return result
