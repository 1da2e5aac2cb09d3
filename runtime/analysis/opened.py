"""A scene with its contacts cut open: from the forces of a frame's ticks to what each follows.

Takes: a `Model` whose peers have parts that switch.
Gives: `contact_groups`, `with_gain`; `CutPeers`, `LurePlant`, `open_loops`; `negated`.
Guarantees: every matrix comes with its radii; what may drift with all contacts open is taken out, exactly.
The cost grows with the different peers, not with their number.
Does not: judge anything (see `switching`).

From the forces f to the numbers y they follow (see `pushes`), tick by tick over a frame:

    ξ⁺ = A ξ + B f      −y = C ξ + D f − s η      η⁺ = η + m f

η is the one motion that may drift, y follows it alike at all ticks of a contact. The loop as it is has M and
C₀; M V = V is what stands with all contacts open. With L M = L, L V = 1, the state is V (L x) and a part that
follows from ξ, the relative coordinates: C ξ = (C₀ − C₀ V L) x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.contact_modes import parts_of_kinds, settings
from apc.analysis.pushes import SectorNonlinearity, push_of
from apc.analysis.switches import bind
from apc.compiler.compiled import Model
from apc.eigen.closing import ModalSystem, close_loop, close_outside, lay_out
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.peers import PeerClass, peer_groups
from apc.eigen.relative import relative_coordinates, relative_rows, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.decisions import find_switches
from apc.frame.discretize import discretize
from apc.frame.exchange import build_exchange
from apc.frame.instance import Prepared, instance
from apc.frame.lift import FrameMap, compose, step_durations, with_roundings
from apc.frame.parameters import resolve
from apc.frame.ports import with_cuts
from apc.frame.radius import RADII, radius_of, rounded, solve, value_of, with_radius
from apc.frame.schedule import Tick
from apc.frame.site import LinearSubsystem
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# States and ticks of contacts of one loop worth a proof: a Riccati equation of so many takes a second.
MOST_STATES = 150

_MORE = "what a contact follows is more than positions, and something may drift with all contacts open"
_APART = "with all contacts open, several things may drift apart, and one is moved by another's contact"


@dataclass(frozen=True, slots=True, eq=False)
class CutPeers:
    """Peers with their contacts cut open: `map` over [z, y of each tick] and [r, f of each tick].

    `states` are those of z; `ticks` names each y and f by its part and tick, `slopes` are those of each y
    over the continuous states, exactly; `plain` says that it follows nothing else. `jumps` is as of a loop.
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
    """A loop with its contacts cut open; A, B, C and D are `a` to `d`, `seen` is s and `moved` is m.

    `ports` name each f by its site, part and tick, `counts` how many peers have it. `seen` is exact, its
    first that isn't 0 being 1; it is empty where nothing may drift. `jumps` names a part whose force jumps
    (see `pushes`), "" if none does.
    """

    name: str
    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    ports: tuple[tuple[str, str, int], ...]
    counts: Floats
    seen: tuple[Fraction, ...]
    moved: Matrix
    jumps: str


def contact_groups(
    system: Model, prepared: Prepared
) -> list[tuple[PeerClass, tuple[SectorNonlinearity, ...]]]:
    """Return the groups of equal peers with all contacts on, and what pushes at each.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.

    Raises
    ------
    ApcError
        E863 a part that takes too many decisions.
    NotSupportedError
        Why that can't be.
    """
    numbers = resolve(system)
    kinds_now = [site.kind for site in prepared.jacobians]
    if any(partition.variants for kind in kinds_now for partition in kind.clocks):
        raise NotSupportedError("what is computed of what is heard changes with its age, from tick to tick")
    switched = [find_switches(kind) for kind in kinds_now]
    parts = parts_of_kinds(system, switched, numbers)
    on = tuple(
        bind(switched_kind, site, settings(part, on=True)) if switched_kind.decisions else site
        for switched_kind, site, part in zip(switched, prepared.jacobians, parts, strict=True)
    )
    for place, group in enumerate(system.groups):
        vector = numbers.parameters[place][0]
        for part in parts[group.kind]:
            push_of(switched[group.kind], part, prepared.jacobians[group.kind], vector)
        if not on[group.kind].parameters_suffice:
            raise NotSupportedError(
                f"some force at {group.name} is not linear, or looks at each of the others by itself"
            )
    scene = instance(system, replace(prepared, jacobians=on))
    kinds = {id(site_jacobians): kind for kind, site_jacobians in enumerate(on)}
    pairs = []
    for peers in peer_groups(scene):
        kind = kinds[id(peers.jacobians)]
        pushes = (
            push_of(switched[kind], part, prepared.jacobians[kind], peers.parameters) for part in parts[kind]
        )
        # A clock on which nothing depends, as of a force on a clamped device, has no ticks.
        ticking = {event.partition for event in peers.schedule.events if isinstance(event, Tick)}
        pairs.append((peers, tuple(push for push in pushes if push and push.partition in ticking)))
    return pairs


def with_gain(group: PeerClass, pushes: Sequence[SectorNonlinearity], gain: Fraction) -> PeerClass:
    """Return peers whose contacts, always on, push so many times as hard.

    Parameters
    ----------
    group, pushes
        As of `contact_groups`.
    gain
        The factor.
    """
    site, exact = (_pushing(linear_site, pushes, gain) for linear_site in (group.site, group.exact))
    return group.with_site(site, exact, group.schedule)


def _pushing(site: LinearSubsystem, pushes: Sequence[SectorNonlinearity], gain: Fraction) -> LinearSubsystem:
    """Return a site whose contacts push so many times as hard, of floats or rationals."""
    ticks = list(site.ticks)
    for push in pushes:
        tick = ticks[push.partition]
        blocks = [block.copy() for block in (tick.x, tick.u, tick.m, tick.r)]
        for block in blocks:
            block[push.output] *= gain if block.dtype == object else float(gain)
        x, u, m, r = blocks
        ticks[push.partition] = replace(tick, x=x, u=u, m=m, r=r)
    return replace(site, ticks=tuple(ticks))


def open_loops(system: Model, prepared: Prepared) -> list[LurePlant]:
    """Cut all contacts open; NotSupportedError says why that can't be."""
    opened: list[CutPeers] = []
    for group, pushes in contact_groups(system, prepared):
        for push in pushes:
            if push.sector and not push.shares:
                raise NotSupportedError(push.sector)
        opened.append(_cut_open(group, pushes))
    of_site = {id(item.group.lifting): item for item in opened}
    exchange = build_exchange(system, resolve(system).timings)
    loops = loops_at_right_angles([item.group for item in opened], exchange, MOST_STATES)
    result = []
    for loop in loops:
        cut_groups = [of_site[id(site.lifting)] for site in loop.sites]
        size = loop.states + sum(len(opened.ticks) for opened in cut_groups)
        if size > MOST_STATES:
            raise NotSupportedError(
                f"{size:,} states and ticks of contacts move together, and {MOST_STATES} are the most"
            )
        result.append(_open_loop(loop, cut_groups))
    return result


def _cut_open(group: PeerClass, pushes: Sequence[SectorNonlinearity]) -> CutPeers:
    """Cut the contacts of some peers open: their forces come from outside, and what they follow goes out."""
    schedule, bare = group.schedule, with_gain(group, pushes, Fraction(0))
    steps = step_durations(schedule)
    result = discretize(bare.exact.a, bare.exact.b, [step * schedule.quantum for step in steps])
    ticks: list[tuple[str, int]] = []
    slopes = []
    for push in pushes:
        count = schedule.ticks[push.partition]
        ticks += [(push.part, index) for index in range(count)]
        slopes += [group.exact.ticks[push.partition].x[push.output]] * count
    wide, whole = with_cuts(group.site, schedule, [(push.partition, push.output) for push in pushes])
    wide_map = compose(with_roundings(wide), whole, dict(zip(steps, result, strict=True)), numbers=RADII)
    followed = np.array(slopes, dtype=object).reshape(len(ticks), len(bare.exact.a))
    plain = not any(push.slopes[push.states :].any() for push in pushes)
    jumps = next((push.part for push in pushes if push.sector), "")
    return CutPeers(bare, wide_map, len(bare.z_names), tuple(ticks), followed, plain, jumps)


def _open_loop(loop: ModalSystem, opened: Sequence[CutPeers]) -> LurePlant:
    """Close a loop whose contacts are cut open; NotSupportedError says why that can't be judged."""
    free = find_rigid_modes(close_loop(loop))
    if free.drifts:
        raise NotSupportedError("with all contacts open, something drifts ever farther")
    names = [(*item.group.z_names, *(f"{part}[{tick}]" for part, tick in item.ticks)) for item in opened]
    layout = lay_out(names, [site.schedule for site in loop.sites])
    closed = close_outside(
        loop, [item.map for item in opened], [len(item.ticks) for item in opened], layout, numbers=RADII
    ).matrix
    n, listed = len(layout.names), list(zip(loop.sites, opened, layout.offsets, strict=True))
    outside = np.concatenate(
        [offset + opened.states + np.arange(len(opened.ticks)) for _, opened, offset in listed]
    )
    own = np.delete(np.arange(n), outside)
    a, b = (closed[:, own][..., which] for which in (own, slice(n, None)))
    c, d = (closed[:, outside][..., which] for which in (own, slice(n, None)))
    ports = tuple((site.name, *tick) for site, opened, _ in listed for tick in opened.ticks)
    at = with_doubt(relative_coordinates(free.basis))
    shares, moved = np.zeros(0, dtype=object), np.zeros((2, 1, len(ports)))
    if free.exact:
        if not all(item.plain for item in opened):
            raise NotSupportedError(_MORE)
        motions = np.array(free.exact, dtype=object).T
        left = _left_vectors(a, motions, at.held)
        if left is None:
            raise NotSupportedError("what moves with all contacts open can't be told from what drifts")
        rows = [(opened.slopes, np.searchsorted(own, offset)) for _, opened, offset in listed]
        followed = np.concatenate(
            [slopes @ motions[start : start + slopes.shape[1]] for slopes, start in rows], axis=0
        )
        along = rounded(followed.astype(np.float64))
        c = RADII.subtract(c, RADII.multiply(along, left))
        if followed.any():
            first = followed[followed.any(axis=1).argmax()]
            pivot = int((first != 0).argmax())
            shares = followed[:, pivot] / first[pivot]
            if (followed != np.outer(shares, first)).any():
                raise NotSupportedError(_APART)
            drift = rounded(first[None].astype(np.float64))
            moved = RADII.multiply(drift, RADII.multiply(left, b))
    return LurePlant(
        name=loop.name,
        a=relative_rows(a[..., at.rest], at, RADII),
        b=relative_rows(b, at, RADII),
        c=negated(c[..., at.rest]),
        d=negated(d),
        ports=ports,
        counts=np.array([float(site.count) for site, opened, _ in listed for _ in opened.ticks]),
        seen=tuple(shares),
        moved=moved,
        jumps=next((item.jumps for item in opened if item.jumps), ""),
    )


def _left_vectors(matrix: Matrix, motions: Matrix, held: NDArray[np.intp]) -> Matrix | None:
    """Return L (2, k, n) with L M = L and L V = 1, None where rounding hides it.

    Parameters
    ----------
    matrix
        M (2, n, n), with its radii.
    motions
        V (n, k), exactly: M V = V, and nothing else stands.
    held
        Places p (k,) at which V_p can be inverted.

    Notes
    -----
    Lᵀ solves (1 − M)ᵀ Lᵀ + 1_p Z = 0, Vᵀ Lᵀ = 1: Vᵀ times the first
    is V_pᵀ Z = 0.
    """
    n, k = motions.shape
    v = rounded(motions.astype(np.float64))
    bordered, right = np.zeros((2, n + k, n + k)), np.zeros((2, n + k, k))
    bordered[:, :n, :n] = np.swapaxes(RADII.subtract(RADII.exact(np.eye(n)), matrix), -1, -2)
    bordered[:, n:, :n] = np.swapaxes(v, -1, -2)
    bordered[0, held, n + np.arange(k)] = 1.0
    right[0, n:] = np.eye(k)
    solved = solve(bordered, right)
    return None if solved is None else np.swapaxes(solved[:, :n], -1, -2)


def negated(matrix: Matrix) -> Matrix:
    """Return a matrix with its radii times −1."""
    return with_radius(-value_of(matrix), radius_of(matrix))
