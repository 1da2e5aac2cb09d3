"""The bodies of a model and the surfaces between them, determined from its equations.

Takes: a `Model`.
Gives: `DrawnBody`, `Disc`, `SupportLine`, `Contact`, `PeerView`, `moves_in_plane`, `bodies_of`,
`contacts_of`, `views_of`; `positions_of`, `heading`.
Guarantees: a body is a position, a number or a vector of numbers in metres, and the angle of the part whose
position it is; a condition on the distance of two of them, or of one from a fixed point, in metres, gives a
disc. A condition on the distance from a line or plane, or on an axis from a point, gives a line.
Does not: simulate, draw, or use part names.

A condition on the distance of two bodies minus w, as in a contact, means contact at distance w. The body that
is sent to the others, or else the second, has the radius w; the other is a point.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerType
from apc.compiler.interpolation import jacobian
from apc.compiler.language.vectors import whole_and_index
from apc.linearization.jacobians import guards_of, jacobians
from apc.linearization.linearize import start_values
from apc.parameter_values.parameters import resolve
from apc.simulation.signals import sent_states

Floats = NDArray[np.float64]

MOST_PEERS = 12  # in a picture: more are not distinguishable
PROBES = 4  # states at which a surface is evaluated: three equations each, four unknowns of a disc
SAME = 1e-9  # relative: what is equal but for roundings


@dataclass(frozen=True, slots=True)
class DrawnBody:
    """A body at the start: position (d,) and radius, 0 for a point, in m; `states` are its coordinates.

    Of a body on an axis d is 1, and the radius half its width. `turning` are its states of orientation, if
    any: its angle in a plane, or in space Rodrigues' vector, the axis times twice the tangent of half the
    angle; `angle` is its `heading` in rad.
    """

    name: str
    position: tuple[float, ...]
    radius: float
    states: tuple[str, ...]
    turning: tuple[str, ...] = ()
    angle: float = 0.0


@dataclass(frozen=True, slots=True)
class Disc:
    """A fixed disc or sphere, in m."""

    centre: tuple[float, ...]
    radius: float


@dataclass(frozen=True, slots=True)
class SupportLine:
    """The set normal·x = offset: a point of an axis, a line or a plane; the normal has length 1, in m."""

    normal: tuple[float, ...]
    offset: float


@dataclass(frozen=True, slots=True)
class Contact:
    """A force between a point `holder` and a body `held`: it depends on the difference of their positions.

    `arm` is the grasp point, from the body's centre along its axes, in m; (0, …) is the centre.
    """

    holder: str
    held: str
    arm: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PeerView:
    """A peer at the start: its bodies, those of a plane only if there are some, surfaces and contacts."""

    name: str
    bodies: tuple[DrawnBody, ...]
    surfaces: tuple[Disc | SupportLine, ...]
    contacts: tuple[Contact, ...] = ()


def positions_of(peer_type: PeerType) -> dict[str, list[int]]:
    """Return the positions of a peer type, each by the places of its coordinates among the states."""
    result: dict[str, list[int]] = {}
    for index, state in enumerate(peer_type.states):
        if state.unit == "m":
            result.setdefault(whole_and_index(state.name)[0], []).append(index)
    return result


def heading(turned: Floats) -> Floats:
    """Return the angle in rad from the first axis to that of a body, as seen along the third axis.

    Parameters
    ----------
    turned
        How it is turned (…, k): by nothing, by an angle, or by Rodrigues' vector in space.
    """
    if turned.shape[-1] < 3:
        return np.asarray(turned.sum(axis=-1))
    # Of the first axis turned by 2 g, (1 + g·g) times the first two coordinates (Shuster, see SpatialBody).
    a, b, c = np.moveaxis(turned / 2, -1, 0)
    return np.asarray(np.arctan2(2 * (c + a * b), 1 + a**2 - b**2 - c**2))


def rotations_of(peer_type: PeerType) -> dict[str, list[int]]:
    """Return of each part that turns, in a plane or in space, the places of how among the states."""
    result: dict[str, list[int]] = {}
    for index, state in enumerate(peer_type.states):
        if state.unit == "rad":
            result.setdefault(state.name.rpartition(".")[0], []).append(index)
    return {part: locations for part, locations in result.items() if len(locations) in (1, 3)}


def moves_in_plane(model: Model) -> bool:
    """Return whether some body's position is a vector."""
    return any(
        len(indices) > 1 for peer_type in model.peer_types for indices in positions_of(peer_type).values()
    )


def views_of(model: Model) -> list[PeerView]:
    """Return the first `MOST_PEERS` peers as they look at the start."""
    numbers = resolve(model)
    subsystems = [jacobians(peer_type) for peer_type in model.peer_types]
    plane = moves_in_plane(model)
    peer_views: list[PeerView] = []
    for group, members in enumerate(model.groups):
        for peer in range(min(members.count, MOST_PEERS - len(peer_views))):
            vector = [float(value) for value in numbers.parameters[group][numbers.rows[group][peer]]]
            start, _, _ = start_values(subsystems[members.peer_type], vector)
            bodies, surfaces = bodies_of(model.peer_types[members.peer_type], vector, start)
            shown = tuple(body for body in bodies if not plane or len(body.position) > 1)
            names = {body.name for body in shown}
            contacts = tuple(
                contact
                for contact in contacts_of(model.peer_types[members.peer_type], vector, start)
                if {contact.holder, contact.held} <= names
            )
            peer_views.append(PeerView(f"{members.name}[{peer + 1}]", shown, tuple(surfaces), contacts))
    return peer_views


def bodies_of(
    peer_type: PeerType, vector: Sequence[float], start: Sequence[float]
) -> tuple[list[DrawnBody], list[Disc | SupportLine]]:
    """Return the drawing of a peer's initial state.

    Parameters
    ----------
    peer_type
        The peer type.
    vector
        Its parameters (n_p,), SI.
    start
        Its states at the start (n_x,), SI.
    """
    positions = positions_of(peer_type)
    radii = dict.fromkeys(positions, 0.0)
    sent = sent_states(peer_type)
    fixed: dict[Disc | SupportLine, None] = {}
    for points, values, slopes in _decisions(peer_type, vector):
        moving = set(np.flatnonzero(slopes.any(axis=0)).tolist())
        names = [name for name, locations in positions.items() if moving & set(locations)]
        if not moving <= {index for name in names for index in positions[name]} or len(names) not in (1, 2):
            continue
        first, last = (positions[names[end]] for end in (0, -1))
        at = points[:, first]
        if len(names) == 2:
            if len(first) != len(last) or not _equal(slopes[:, first], -slopes[:, last]):
                continue
            at = at - points[:, last]
        surface = _surface(at, values, slopes[:, first])
        if surface is None:
            continue
        if len(names) == 1:
            fixed[surface] = None
            continue
        wide = next((name for name in names if positions[name][0] in sent), names[1])
        if isinstance(surface, SupportLine) and len(first) == 1:
            radii[wide] = max(radii[wide], abs(surface.offset))
        elif isinstance(surface, Disc) and _equal(surface.centre, 0):
            radii[wide] = max(radii[wide], surface.radius)
    turns = rotations_of(peer_type)
    bodies = [
        DrawnBody(
            part,
            tuple(float(start[index]) for index in locations),
            radii[name],
            tuple(peer_type.states[index].name for index in locations),
            tuple(peer_type.states[index].name for index in turned),
            float(heading(np.array([start[index] for index in turned], dtype=np.float64))),
        )
        for name, locations in positions.items()
        for part in [name.rpartition(".")[0]]
        for turned in [turns.get(part, [])]
    ]
    return bodies, list(fixed)


def contacts_of(peer_type: PeerType, vector: Sequence[float], start: Sequence[float]) -> list[Contact]:
    """Return the forces between two bodies of a peer, in its initial state.

    A force K(x₁ − x₂ − R(φ) p) has opposite slopes over the two positions, and the slope −K R'(φ) p over the
    angle of the second body, by which its arm p is determined.

    Parameters
    ----------
    peer_type, vector, start
        As for `bodies_of`.
    """
    positions, turns = positions_of(peer_type), rotations_of(peer_type)
    result: dict[Contact, None] = {}
    for slopes in _slopes_at(peer_type, vector, start):
        for first, second in itertools.permutations(positions, 2):
            one, two = positions[first], positions[second]
            turned = turns.get(second.rpartition(".")[0], [])
            if len(one) != len(two) or len(one) == 3 or turns.get(first.rpartition(".")[0]):
                continue
            scale = np.abs(slopes[:, one]).max(initial=0.0)
            rows = (np.abs(slopes[:, one] + slopes[:, two]) <= SAME * scale).all(axis=1)
            rows &= (np.abs(slopes[:, one]) > SAME * scale).any(axis=1)
            stiffness = slopes[rows][:, two]
            if not scale or np.linalg.matrix_rank(stiffness) < len(one):
                continue
            arm = np.zeros(len(one))
            if turned:
                angle = start[turned[0]]
                turn = np.array([[-np.sin(angle), -np.cos(angle)], [np.cos(angle), -np.sin(angle)]])
                arm = turn.T @ np.linalg.lstsq(stiffness, slopes[rows, turned[0]], rcond=None)[0]
            elif _is_reversed(result, first, second):
                continue
            holder, held = (name.rpartition(".")[0] for name in (first, second))
            result[Contact(holder, held, tuple(map(_tidy, arm)))] = None
    return list(result)


def _is_reversed(contacts: Iterable[Contact], first: str, second: str) -> bool:
    """Return whether a contact between two positions is there, with the second as the holder."""
    pair = (second.rpartition(".")[0], first.rpartition(".")[0])
    return any((contact.holder, contact.held) == pair for contact in contacts)


def _slopes_at(peer_type: PeerType, vector: Sequence[float], start: Sequence[float]) -> Iterator[Floats]:
    """Yield the slopes (k, n_x) over the states of the derivative and of the clocks' outputs."""
    for function in (peer_type.derivative, *(clock.tick for clock in peer_type.clocks)):
        if not function.is_a("SXFunction"):
            continue
        inputs: list[Any] = function.sx_in()
        outputs = function(*inputs)
        whole = casadi.vertcat(*outputs) if isinstance(outputs, tuple | list) else outputs
        slopes = casadi.Function(
            "slopes", inputs, [casadi.densify(jacobian(casadi.densify(whole), inputs[0]))]
        )
        values = [start, *(np.zeros(one.shape) for one in inputs[1:-2]), vector, 0.0]
        found = np.asarray(slopes(*values), np.float64)
        if np.isfinite(found).all():
            yield found


def _decisions(peer_type: PeerType, vector: Sequence[float]) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Yield of all that is decided by states alone: states (k, n_x), its values (k,), slopes (k, n_x)."""
    points = np.random.default_rng(1).uniform(-1, 1, (PROBES, len(peer_type.states)))
    for function in (peer_type.derivative, *(clock.tick for clock in peer_type.clocks)):
        if not function.is_a("SXFunction"):
            continue
        inputs: list[Any] = function.sx_in()
        x, p = inputs[0], inputs[-2]
        others = casadi.vertcat(*inputs[1:-2], inputs[-1])
        for guard in guards_of(casadi.densify(function(*inputs)), x):
            if casadi.depends_on(guard, others):
                continue
            at = casadi.Function("at", [x, p], [casadi.densify(casadi.horzcat(guard, jacobian(guard, x)))])
            rows = np.array([np.asarray(at(point, vector), np.float64)[0] for point in points])
            if np.isfinite(rows).all():
                yield points, rows[:, 0], rows[:, 1:]


def _equal(values: Any, others: Any, scale: float = 1.0) -> bool:
    return np.allclose(values, others, rtol=0, atol=SAME * scale)


def _surface(at: Floats, values: Floats, slopes: Floats) -> Disc | SupportLine | None:
    """Return the zero set of a function of a point, if it is the signed distance from a disc or a line.

    Parameters
    ----------
    at, values, slopes
        Points (k, d), the function there (k,), and its slopes (k, d).
    """
    if not _equal(np.linalg.norm(slopes, axis=1), 1):
        return None
    count, size = at.shape
    if _equal(slopes, slopes[0]):
        normal = slopes[0] * np.sign(slopes[0][np.abs(slopes[0]).argmax()])
        offset = normal @ at[0] - (normal @ slopes[0]) * values[0]
        return SupportLine(tuple(map(_tidy, normal)), _tidy(offset))
    if size == 1:
        return None
    # g = ∓(R − |p − c|) has the slope ±(p − c)/|p − c|: c = p − g·slope ∓ R·slope, the same from every point.
    system = np.hstack([np.tile(np.eye(size), (count, 1)), slopes.reshape(-1, 1)])
    right = (at - values[:, None] * slopes).ravel()
    solution = np.linalg.lstsq(system, right, rcond=None)[0]
    if not _equal(system @ solution, right, 1 + np.abs(right).max()):
        return None
    return Disc(tuple(map(_tidy, solution[:size])), abs(_tidy(solution[size])))


def _tidy(number: Any) -> float:
    """Return a number without its last roundings, so that a surface that is found twice is one."""
    return float(f"{number:.9g}") if abs(number) > SAME else 0.0
