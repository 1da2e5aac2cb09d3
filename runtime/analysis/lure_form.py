"""Lur'e form: a model with its contacts cut open, from contact forces to the displacements that they follow.

Takes: a `Model` whose peers have switching parts.
Gives: `contact_groups`, `with_gain`; `CutPeers`, `LurePlant`, `lure_plants`; `negated`.
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
from apc.analysis.sector_nonlinearity import SectorNonlinearity, push_of
from apc.analysis.switches import bind
from apc.compiler.compiled import Model
from apc.eigen.interconnection import ModalSystem, close_loop, interconnect_with_inputs, lay_out
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.peer_classes import PeerClass, peer_groups
from apc.eigen.relative_coordinates import relative_coordinates, relative_rows, with_uncertainty
from apc.eigen.rigid_modes import find_rigid_modes
from apc.frame.branch_conditions import find_switches
from apc.frame.communication_graph import build_exchange
from apc.frame.discretize import discretize
from apc.frame.frame_inputs import with_cuts
from apc.frame.interval_arithmetic import (
    MIDPOINT_RADIUS,
    error_radius,
    rounded,
    solve,
    value_of,
    with_error_radius,
)
from apc.frame.lift import FrameMap, compose, step_durations, with_roundings
from apc.frame.linear_subsystem import LinearSubsystem
from apc.frame.numeric_model import Prepared, instance
from apc.frame.parameters import resolve
from apc.frame.schedule import Tick
from apc.not_supported import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# The limit of states and contact ticks of one loop for a proof: a Riccati equation of this size takes a
# second.
MOST_STATES = 150

_MORE = "what a contact follows is more than positions, and something may drift with all contacts open"
_SEPARATE = "with all contacts open, several things may drift apart, and one is moved by another's contact"


@dataclass(frozen=True, slots=True, eq=False)
class CutPeers:
    """Peers with their contacts cut open: `map` over [z, y of each tick] and [r, f of each tick].

    `states` are those of z; `ticks` names each y and f by its part and tick, `slopes` are those of each y
    over the continuous states, exactly; `plain` states that it depends on nothing else. `jumps` is as of a
    loop.
    """

    group: PeerClass
    map: FrameMap
    states: int
    ticks: tuple[tuple[str, int], ...]
    slopes: Matrix  # (ticks, n_x), of `Fraction`
    plain: bool
    jumps: str


@dataclass(frozen=True, slots=True, eq=False)
class LurePlant:
    """A loop with its contacts cut open; A, B, C and D are `a` to `d`, `measured` is s and `moved` is m.

    `ports` names each f by its subsystem, part and tick, `counts` are the numbers of their peers. `measured`
    is exact, its first nonzero being 1; it is empty without a drift. `jumps` names a part whose force jumps
    (see `sector_nonlinearity`), "" if there is none.
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


def contact_groups(
    system: Model, prepared: Prepared
) -> list[tuple[PeerClass, tuple[SectorNonlinearity, ...]]]:
    """Return the groups of equal peers with all contacts on, and the contact forces of each.

    Parameters
    ----------
    system, prepared
        The compiled model, and the result of `numeric_model.prepare` for it.

    Raises
    ------
    ApcError
        E863 a part with too many decisions.
    NotSupportedError
        The reason why the form does not exist.
    """
    numbers = resolve(system)
    current_peer_types = [subsystem.peer_type for subsystem in prepared.jacobians]
    if any(partition.variants for peer_type in current_peer_types for partition in peer_type.clocks):
        raise NotSupportedError("what is computed of what is heard changes with its age, from tick to tick")
    switched = [find_switches(peer_type) for peer_type in current_peer_types]
    parts = parts_of_peer_types(system, switched, numbers)
    on = tuple(
        bind(switched_peer_type, subsystem, settings(part, on=True))
        if switched_peer_type.decisions
        else subsystem
        for switched_peer_type, subsystem, part in zip(switched, prepared.jacobians, parts, strict=True)
    )
    for index, group in enumerate(system.groups):
        vector = numbers.parameters[index][0]
        for part in parts[group.peer_type]:
            push_of(switched[group.peer_type], part, prepared.jacobians[group.peer_type], vector)
        if not on[group.peer_type].parameters_suffice:
            raise NotSupportedError(
                f"some force at {group.name} is not linear, or looks at each of the others by itself"
            )
    topology = instance(system, replace(prepared, jacobians=on))
    peer_types = {id(subsystem_jacobians): peer_type for peer_type, subsystem_jacobians in enumerate(on)}
    pairs = []
    for peers in peer_groups(topology):
        peer_type = peer_types[id(peers.jacobians)]
        pushes = (
            push_of(switched[peer_type], part, prepared.jacobians[peer_type], peers.parameters)
            for part in parts[peer_type]
        )
        # A clock without effect, such as that of a force on a clamped device, has no ticks.
        ticking = {event.partition for event in peers.schedule.events if isinstance(event, Tick)}
        pairs.append((peers, tuple(push for push in pushes if push and push.partition in ticking)))
    return pairs


def with_gain(group: PeerClass, pushes: Sequence[SectorNonlinearity], gain: Fraction) -> PeerClass:
    """Return peers whose contacts, always on, have forces scaled by a factor.

    Parameters
    ----------
    group, pushes
        As of `contact_groups`.
    gain
        The factor.
    """
    subsystem, exact = (
        _pushing(linear_subsystem, pushes, gain) for linear_subsystem in (group.subsystem, group.exact)
    )
    return group.with_subsystem(subsystem, exact, group.schedule)


def _pushing(
    subsystem: LinearSubsystem, pushes: Sequence[SectorNonlinearity], gain: Fraction
) -> LinearSubsystem:
    """Return a subsystem with scaled contact forces, of floats or rationals."""
    ticks = list(subsystem.ticks)
    for push in pushes:
        tick = ticks[push.partition]
        blocks = [block.copy() for block in (tick.x, tick.u, tick.m, tick.r)]
        for block in blocks:
            block[push.output] *= gain if block.dtype == object else float(gain)
        x, u, m, r = blocks
        ticks[push.partition] = replace(tick, x=x, u=u, m=m, r=r)
    return replace(subsystem, ticks=tuple(ticks))


def lure_plants(system: Model, prepared: Prepared) -> list[LurePlant]:
    """Return the loops with all contacts cut open; NotSupportedError gives the reason if there are none."""
    opened: list[CutPeers] = []
    for group, pushes in contact_groups(system, prepared):
        for push in pushes:
            if push.sector and not push.shares:
                raise NotSupportedError(push.sector)
        opened.append(_cut_peers(group, pushes))
    of_subsystem = {id(item.group.lifting): item for item in opened}
    exchange = build_exchange(system, resolve(system).timings)
    loops = loops_at_right_angles([item.group for item in opened], exchange, MOST_STATES)
    result = []
    for loop in loops:
        cut_groups = [of_subsystem[id(subsystem.lifting)] for subsystem in loop.subsystems]
        size = loop.states + sum(len(opened.ticks) for opened in cut_groups)
        if size > MOST_STATES:
            raise NotSupportedError(
                f"{size:,} states and ticks of contacts move together, and {MOST_STATES} are the most"
            )
        result.append(_lure_plant(loop, cut_groups))
    return result


def _cut_peers(group: PeerClass, pushes: Sequence[SectorNonlinearity]) -> CutPeers:
    """Return peers with their contacts cut open: forces are inputs, and the variables they follow outputs."""
    schedule, bare = group.schedule, with_gain(group, pushes, Fraction(0))
    steps = step_durations(schedule)
    result = discretize(bare.exact.a, bare.exact.b, [step * schedule.quantum for step in steps])
    ticks: list[tuple[str, int]] = []
    slopes = []
    for push in pushes:
        count = schedule.ticks[push.partition]
        ticks += [(push.part, index) for index in range(count)]
        slopes += [group.exact.ticks[push.partition].x[push.output]] * count
    wide, whole = with_cuts(group.subsystem, schedule, [(push.partition, push.output) for push in pushes])
    wide_map = compose(
        with_roundings(wide), whole, dict(zip(steps, result, strict=True)), numbers=MIDPOINT_RADIUS
    )
    followed = np.array(slopes, dtype=object).reshape(len(ticks), len(bare.exact.a))
    plain = not any(push.slopes[push.states :].any() for push in pushes)
    jumps = next((push.part for push in pushes if push.sector), "")
    return CutPeers(bare, wide_map, len(bare.z_names), tuple(ticks), followed, plain, jumps)


def _lure_plant(loop: ModalSystem, opened: Sequence[CutPeers]) -> LurePlant:
    """Return a closed loop with cut contacts; NotSupportedError gives the reason if there is none."""
    free = find_rigid_modes(close_loop(loop))
    if free.drifts:
        raise NotSupportedError("with all contacts open, something drifts ever farther")
    names = [(*item.group.z_names, *(f"{part}[{tick}]" for part, tick in item.ticks)) for item in opened]
    layout = lay_out(names, [subsystem.schedule for subsystem in loop.subsystems])
    closed = interconnect_with_inputs(
        loop,
        [item.map for item in opened],
        [len(item.ticks) for item in opened],
        layout,
        numbers=MIDPOINT_RADIUS,
    ).matrix
    n, listed = len(layout.names), list(zip(loop.subsystems, opened, layout.offsets, strict=True))
    outside = np.concatenate(
        [offset + opened.states + np.arange(len(opened.ticks)) for _, opened, offset in listed]
    )
    local = np.delete(np.arange(n), outside)
    a, b = (closed[:, local][..., which] for which in (local, slice(n, None)))
    c, d = (closed[:, outside][..., which] for which in (local, slice(n, None)))
    ports = tuple((subsystem.name, *tick) for subsystem, opened, _ in listed for tick in opened.ticks)
    at = with_uncertainty(relative_coordinates(free.basis))
    shares, moved = np.zeros(0, dtype=object), np.zeros((2, 1, len(ports)))
    if free.exact:
        if not all(item.plain for item in opened):
            raise NotSupportedError(_MORE)
        motions = np.array(free.exact, dtype=object).T
        left = _left_vectors(a, motions, at.eliminated)
        if left is None:
            raise NotSupportedError("what moves with all contacts open can't be told from what drifts")
        rows = [(opened.slopes, np.searchsorted(local, offset)) for _, opened, offset in listed]
        followed = np.concatenate(
            [slopes @ motions[start : start + slopes.shape[1]] for slopes, start in rows], axis=0
        )
        along = rounded(followed.astype(np.float64))
        c = MIDPOINT_RADIUS.subtract(c, MIDPOINT_RADIUS.multiply(along, left))
        if followed.any():
            first = followed[followed.any(axis=1).argmax()]
            pivot = int((first != 0).argmax())
            shares = followed[:, pivot] / first[pivot]
            if (followed != np.outer(shares, first)).any():
                raise NotSupportedError(_SEPARATE)
            drift = rounded(first[None].astype(np.float64))
            moved = MIDPOINT_RADIUS.multiply(drift, MIDPOINT_RADIUS.multiply(left, b))
    return LurePlant(
        name=loop.name,
        a=relative_rows(a[..., at.rest], at, MIDPOINT_RADIUS),
        b=relative_rows(b, at, MIDPOINT_RADIUS),
        c=negated(c[..., at.rest]),
        d=negated(d),
        ports=ports,
        counts=np.array([float(subsystem.count) for subsystem, opened, _ in listed for _ in opened.ticks]),
        measured=tuple(shares),
        moved=moved,
        jumps=next((item.jumps for item in opened if item.jumps), ""),
    )


def _left_vectors(matrix: Matrix, motions: Matrix, held: NDArray[np.intp]) -> Matrix | None:
    """Return L (2, k, n) with L M = L and L V = 1, None where rounding prevents it.

    Parameters
    ----------
    matrix
        M (2, n, n), with its radii.
    motions
        V (n, k), exactly: M V = V, and no other vector is invariant.
    held
        Indices p (k,) at which V_p can be inverted.

    Notes
    -----
    Lᵀ solves (1 − M)ᵀ Lᵀ + 1_p Z = 0, Vᵀ Lᵀ = 1: Vᵀ times the first
    is V_pᵀ Z = 0.
    """
    n, k = motions.shape
    v = rounded(motions.astype(np.float64))
    bordered, right = np.zeros((2, n + k, n + k)), np.zeros((2, n + k, k))
    bordered[:, :n, :n] = np.swapaxes(
        MIDPOINT_RADIUS.subtract(MIDPOINT_RADIUS.exact(np.eye(n)), matrix), -1, -2
    )
    bordered[:, n:, :n] = np.swapaxes(v, -1, -2)
    bordered[0, held, n + np.arange(k)] = 1.0
    right[0, n:] = np.eye(k)
    solved = solve(bordered, right)
    return None if solved is None else np.swapaxes(solved[:, :n], -1, -2)


def negated(matrix: Matrix) -> Matrix:
    """Return a matrix with its radii times −1."""
    return with_error_radius(-value_of(matrix), error_radius(matrix))
