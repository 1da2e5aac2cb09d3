"""Lur'e form: a model with its contacts cut open, from contact forces to the displacements that they follow.

Takes: a `NumericModel` whose peers have switching parts.
Gives: `contact_classes`, `with_gain`; `CutPeers`, `LurePlant`, `lure_plants`; `negated`.
Guarantees: every matrix has radii; a drift with all contacts open is removed, exactly. The cost grows with
the number of different peers, not of all.
Does not: decide stability (see `arbitrary_switching`).

From the forces f to the variables y that they follow (see `sector_nonlinearity`), by the ticks of a frame:

    ξ⁺ = A ξ + B f      −y = C ξ + D f − s η      η⁺ = η + m f

η is the one motion that may drift, and shifts y equally at all ticks of a contact. The uncut loop has M and
C₀; M V = V is its constant motion with all contacts open. With L M = L, L V = 1, the state is V (L x) and a
part that follows from ξ, the relative coordinates: C ξ = (C₀ − C₀ V L) x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.contact_modes import parts_of_peer_types, settings
from apc.analysis.switches import bind
from apc.extensions.switching.sector_nonlinearity import SectorNonlinearity, contact_force
from apc.lifting.discretize import discretize
from apc.lifting.frame_inputs import with_cuts
from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    error_radius,
    rounded,
    solve,
    value_of,
    with_error_radius,
)
from apc.lifting.lift import FrameMap, compose, step_durations, with_roundings
from apc.lifting.numeric_model import NumericModel
from apc.linearization.branch_conditions import find_switches
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.spectrum.interconnection import ModalSystem, close_loop, interconnect_with_inputs, lay_out
from apc.spectrum.modes import orthogonal_loops
from apc.spectrum.peer_classes import PeerClass, classes_of_peers
from apc.spectrum.relative_coordinates import relative_coordinates, relative_rows, with_uncertainty
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import LURE_STATES
from apc.timing.schedule import Tick

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

_MORE = "a contact force depends on more than positions, and the topology may drift with all contacts open"
_SEPARATE = "with all contacts open, several bodies move independently, and their contacts are coupled"


@dataclass(frozen=True, slots=True, eq=False)
class CutPeers:
    """Equal peers with their contacts cut open: `map` over [z, y of each tick] and [r, f of each tick].

    `states` is the number of entries of z; `ticks` names each y and f by its part and tick. `slopes` are the
    exact slopes of each y over the continuous states; `plain` states that y depends on continuous states
    only. `jumps` is as for `LurePlant`.
    """

    peer_class: PeerClass
    map: FrameMap
    states: int
    ticks: tuple[tuple[str, int], ...]
    slopes: Matrix  # (ticks, n_x), of `Fraction`
    plain: bool
    jumps: str


@dataclass(frozen=True, slots=True, eq=False)
class LurePlant:
    """A loop with its contacts cut open, with the matrices A to D; `measured` is s and `moved` is m.

    `ports` names each f by its subsystem, part and tick, `counts` are the numbers of their peers. `measured`
    is exact, its first nonzero entry being 1; it is empty without a drift. `jumps` names a part whose force
    jumps (see `sector_nonlinearity`), "" if no force jumps.
    """

    name: str
    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    ports: tuple[tuple[str, str, int], ...]
    counts: Floats
    measured: tuple[Fraction, ...]
    moved: Matrix
    jumps: str


def contact_classes(numeric: NumericModel) -> list[tuple[PeerClass, tuple[SectorNonlinearity, ...]]]:
    """Return the classes of equal peers with all contacts on, and the contact forces of each class.

    Parameters
    ----------
    numeric
        The model with its parameter values.

    Raises
    ------
    ApcError
        E863 a part with too many decisions.
    NotSupportedError
        The reason why the Lur'e form does not exist.
    """
    model = numeric.model
    numbers = numeric.numbers
    current_peer_types = [subsystem.peer_type for subsystem in numeric.jacobians]
    if any(partition.variants for peer_type in current_peer_types for partition in peer_type.clocks):
        raise NotSupportedError(
            "values computed from received packets depend on their age, which varies between ticks"
        )
    switched = [find_switches(peer_type) for peer_type in current_peer_types]
    parts = parts_of_peer_types(model, switched, numbers)
    on = tuple(
        bind(switched_peer_type, subsystem, settings(parts_of_type, on=True))
        if switched_peer_type.decisions
        else subsystem
        for switched_peer_type, subsystem, parts_of_type in zip(
            switched, numeric.jacobians, parts, strict=True
        )
    )
    for index, group in enumerate(model.groups):
        parameter_vector = numbers.parameters[index][0]
        for part in parts[group.peer_type]:
            contact_force(
                switched[group.peer_type], part, numeric.jacobians[group.peer_type], parameter_vector
            )
        if not on[group.peer_type].parameters_suffice:
            raise NotSupportedError(f"a force at {group.name} is nonlinear or depends on individual senders")
    pairs = []
    for peers in classes_of_peers(numeric.with_jacobians(on)):
        type_index = model.groups[numeric.comm_graph.group_of(peers.peers.first)].peer_type
        forces = (
            contact_force(switched[type_index], part, numeric.jacobians[type_index], peers.parameters)
            for part in parts[type_index]
        )
        # A clock without effect, such as that of a force on a clamped device, has no ticks.
        ticking = {event.partition for event in peers.schedule.events if isinstance(event, Tick)}
        pairs.append((peers, tuple(force for force in forces if force and force.partition in ticking)))
    return pairs


def with_gain(peer_class: PeerClass, forces: Sequence[SectorNonlinearity], gain: Fraction) -> PeerClass:
    """Return peers whose contacts are always on, with forces scaled by a factor.

    Parameters
    ----------
    peer_class, forces
        As for `contact_classes`.
    gain
        The factor.
    """
    subsystem, exact = (
        _with_scaled_forces(linear_subsystem, forces, gain)
        for linear_subsystem in (peer_class.subsystem, peer_class.exact)
    )
    return peer_class.with_subsystem(subsystem, exact, peer_class.schedule)


def _with_scaled_forces(
    subsystem: LinearSubsystem, forces: Sequence[SectorNonlinearity], gain: Fraction
) -> LinearSubsystem:
    """Return a subsystem, over floats or rationals, with its contact forces scaled by a factor."""
    ticks = list(subsystem.ticks)
    for force in forces:
        tick = ticks[force.partition]
        blocks = [block.copy() for block in (tick.x, tick.u, tick.m, tick.r)]
        for block in blocks:
            block[force.output] *= gain if block.dtype == object else float(gain)
        x, u, m, r = blocks
        ticks[force.partition] = replace(tick, x=x, u=u, m=m, r=r)
    return replace(subsystem, ticks=tuple(ticks))


def lure_plants(numeric: NumericModel) -> list[LurePlant]:
    """Return the loops of a model with all contacts cut open.

    Raises NotSupportedError with the reason if the form does not exist.
    """
    cut_classes: list[CutPeers] = []
    for peer_class, forces in contact_classes(numeric):
        for force in forces:
            if force.sector and not force.shares:
                raise NotSupportedError(force.sector)
        cut_classes.append(_cut_peers(peer_class, forces))
    cut_of_class = {item.peer_class.index: item for item in cut_classes}
    loops = orthogonal_loops([item.peer_class for item in cut_classes], numeric.comm_graph, LURE_STATES)
    result = []
    for modal_system in loops:
        cuts = [cut_of_class[peer_class.index] for peer_class in modal_system.peer_classes]
        size = modal_system.states + sum(len(cut.ticks) for cut in cuts)
        if size > LURE_STATES:
            raise NotSupportedError(f"{size:,} coupled states and contact ticks; the limit is {LURE_STATES}")
        result.append(_lure_plant(modal_system, cuts))
    return result


def _cut_peers(peer_class: PeerClass, forces: Sequence[SectorNonlinearity]) -> CutPeers:
    """Return peers with their contacts cut open: contact forces are inputs, their variables y outputs."""
    schedule, without_forces = peer_class.schedule, with_gain(peer_class, forces, Fraction(0))
    steps = step_durations(schedule)
    discretized = discretize(
        without_forces.exact.a, without_forces.exact.b, [step * schedule.quantum for step in steps]
    )
    ticks: list[tuple[str, int]] = []
    slopes = []
    for force in forces:
        count = schedule.ticks[force.partition]
        ticks += [(force.part, index) for index in range(count)]
        slopes += [peer_class.exact.ticks[force.partition].x[force.output]] * count
    extended, extended_schedule = with_cuts(
        peer_class.subsystem, schedule, [(force.partition, force.output) for force in forces]
    )
    extended_map = compose(
        with_roundings(extended),
        extended_schedule,
        dict(zip(steps, discretized, strict=True)),
        numbers=MIDPOINT_RADIUS,
    )
    exact_slopes = np.array(slopes, dtype=object).reshape(len(ticks), len(without_forces.exact.a))
    plain = not any(force.slopes[force.states :].any() for force in forces)
    jumps = next((force.part for force in forces if force.sector), "")
    return CutPeers(
        without_forces, extended_map, len(without_forces.z_names), tuple(ticks), exact_slopes, plain, jumps
    )


def _lure_plant(modal_system: ModalSystem, cut_classes: Sequence[CutPeers]) -> LurePlant:
    """Return a closed loop with cut contacts.

    Raises NotSupportedError with the reason if the form does not exist.
    """
    rigid = find_rigid_modes(close_loop(modal_system))
    if rigid.drifts:
        raise NotSupportedError("with all contacts open, a rigid-body motion grows without bound")
    names = [
        (*cut_peers.peer_class.z_names, *(f"{part}[{tick}]" for part, tick in cut_peers.ticks))
        for cut_peers in cut_classes
    ]
    layout = lay_out(names, [peer_class.schedule for peer_class in modal_system.peer_classes])
    closed = interconnect_with_inputs(
        modal_system,
        [cut_peers.map for cut_peers in cut_classes],
        [len(cut_peers.ticks) for cut_peers in cut_classes],
        layout,
        numbers=MIDPOINT_RADIUS,
    ).matrix
    n, placed = (
        len(layout.names),
        list(zip(modal_system.peer_classes, cut_classes, layout.offsets, strict=True)),
    )
    port_rows = np.concatenate(
        [offset + cut_peers.states + np.arange(len(cut_peers.ticks)) for _, cut_peers, offset in placed]
    )
    state_rows = np.delete(np.arange(n), port_rows)
    a, b = (closed[:, state_rows][..., columns] for columns in (state_rows, slice(n, None)))
    c, d = (closed[:, port_rows][..., columns] for columns in (state_rows, slice(n, None)))
    ports = tuple((peer_class.name, *tick) for peer_class, cut_peers, _ in placed for tick in cut_peers.ticks)
    coordinates = with_uncertainty(relative_coordinates(rigid.basis))
    drift_output, drift_input = np.zeros(0, dtype=object), np.zeros((2, 1, len(ports)))
    if rigid.exact:
        if not all(cut_peers.plain for cut_peers in cut_classes):
            raise NotSupportedError(_MORE)
        motions = np.array(rigid.exact, dtype=object).T
        left_vectors = _left_vectors(a, motions, coordinates.eliminated)
        if left_vectors is None:
            raise NotSupportedError("with all contacts open, modes and drifts can't be separated numerically")
        rows = [(cut_peers.slopes, np.searchsorted(state_rows, offset)) for _, cut_peers, offset in placed]
        followed_motions = np.concatenate(
            [slopes @ motions[start : start + slopes.shape[1]] for slopes, start in rows], axis=0
        )
        rigid_outputs = rounded(followed_motions.astype(np.float64))
        c = MIDPOINT_RADIUS.subtract(c, MIDPOINT_RADIUS.multiply(rigid_outputs, left_vectors))
        if followed_motions.any():
            first_motion = followed_motions[followed_motions.any(axis=1).argmax()]
            pivot = int((first_motion != 0).argmax())
            drift_output = followed_motions[:, pivot] / first_motion[pivot]
            if (followed_motions != np.outer(drift_output, first_motion)).any():
                raise NotSupportedError(_SEPARATE)
            drift = rounded(first_motion[None].astype(np.float64))
            drift_input = MIDPOINT_RADIUS.multiply(drift, MIDPOINT_RADIUS.multiply(left_vectors, b))
    return LurePlant(
        name=modal_system.name,
        a=relative_rows(a[..., coordinates.rest], coordinates, MIDPOINT_RADIUS),
        b=relative_rows(b, coordinates, MIDPOINT_RADIUS),
        c=negated(c[..., coordinates.rest]),
        d=negated(d),
        ports=ports,
        counts=np.array(
            [float(peer_class.count) for peer_class, cut_peers, _ in placed for _ in cut_peers.ticks]
        ),
        measured=tuple(drift_output),
        moved=drift_input,
        jumps=next((cut_peers.jumps for cut_peers in cut_classes if cut_peers.jumps), ""),
    )


def _left_vectors(matrix: Matrix, motions: Matrix, pivots: NDArray[np.intp]) -> Matrix | None:
    """Return the left invariant vectors L (2, k, n): L M = L and L V = 1, None where rounding prevents it.

    Parameters
    ----------
    matrix
        M (2, n, n), with its radii.
    motions
        V (n, k), exactly: M V = V, and no other vector is invariant.
    pivots
        Indices p (k,) at which V_p can be inverted.

    Notes
    -----
    Lᵀ and Z (k, k) solve (1 − M)ᵀ Lᵀ + E Z = 0 and Vᵀ Lᵀ = 1; E are the columns p of the unit matrix. Vᵀ
    times the first equation is V_pᵀ Z = 0: so Z is 0, and L M = L.
    """
    n, k = motions.shape
    v = rounded(motions.astype(np.float64))
    bordered, right = np.zeros((2, n + k, n + k)), np.zeros((2, n + k, k))
    bordered[:, :n, :n] = np.swapaxes(
        MIDPOINT_RADIUS.subtract(MIDPOINT_RADIUS.exact(np.eye(n)), matrix), -1, -2
    )
    bordered[:, n:, :n] = np.swapaxes(v, -1, -2)
    bordered[0, pivots, n + np.arange(k)] = 1.0
    right[0, n:] = np.eye(k)
    solved = solve(bordered, right)
    return None if solved is None else np.swapaxes(solved[:, :n], -1, -2)


def negated(matrix: Matrix) -> Matrix:
    """Return a matrix with its radii times −1."""
    return with_error_radius(-value_of(matrix), error_radius(matrix))
