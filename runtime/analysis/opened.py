"""A scene with its contacts cut open: from the forces of a frame's ticks to what each follows.

Takes: a `CompiledSystem` whose peers have parts that switch.
Gives: `contact_groups`, `with_gain`; `Opened`, `OpenLoop`, `open_loops`; `negated`.
Guarantees: every matrix comes with its radii; what may drift with all contacts open is taken out, exactly.
The cost grows with the different peers, not with their number.
Does not: judge anything (see `switching`).

From the forces f to the numbers y they follow (see `pushes`), tick by tick over a frame, in relative
coordinates ξ:

    ξ⁺ = A ξ + B f      −y = C ξ + D f − s η      η⁺ = η + m f

η is the one motion that may drift, y follows it alike at all ticks of a contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.analysis.contact_modes import parts_of_kinds, settings
from apc.analysis.pushes import Push, push_of
from apc.analysis.switches import bind, find_switches
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Loop, StateLayout, close_loop, close_outside, lay_out
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.peer_group import PeerGroup
from apc.eigen.peers import peer_groups
from apc.eigen.relative import relative_coordinates, relative_rows, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.discretize import UNIT, discretize
from apc.frame.exchange import build_exchange
from apc.frame.lift import FrameMap, compose, step_durations, with_roundings
from apc.frame.parameters import resolve
from apc.frame.ports import with_cuts
from apc.frame.radius import RADII, radius_of, solve, value_of, with_radius
from apc.frame.site import LinearSite

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# States and ticks of contacts of one loop worth a proof: a Riccati equation of so many takes a second.
MOST_STATES = 150


@dataclass(frozen=True, slots=True, eq=False)
class Opened:
    """Peers with their contacts cut open: `map` over [z, y of each tick] and [r, f of each tick].

    `states` are those of z; `ticks` names each y and f by its part and tick, `slopes` are those of each y
    over the continuous states, exactly; `plain` says that it follows nothing else. `jumps` is as of a loop.
    """

    group: PeerGroup
    map: FrameMap
    states: int
    ticks: tuple[tuple[str, int], ...]
    slopes: tuple[tuple[Fraction, ...], ...]
    plain: bool
    jumps: str


@dataclass(frozen=True, slots=True, eq=False)
class OpenLoop:
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
    system: CompiledSystem, prepared: Prepared
) -> list[tuple[PeerGroup, tuple[Push, ...]]] | str:
    """Return the groups of equal peers with all contacts on, and what pushes at each; or why that can't be.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.

    Raises
    ------
    ApcError
        E863 a part that takes too many decisions.
    """
    numbers = resolve(system)
    kinds_now = [site.kind for site in prepared.jacobians]
    if any(partition.variants for kind in kinds_now for partition in kind.clocks):
        return "what is computed of what is heard changes with its age, from tick to tick"
    switched = [find_switches(kind) for kind in kinds_now]
    parts = parts_of_kinds(system, switched, numbers)
    on = tuple(
        bind(one, site, settings(listed, on=True)) if one.decisions else site
        for one, site, listed in zip(switched, prepared.jacobians, parts, strict=True)
    )
    for group in system.groups:
        if not on[group.kind].parameters_suffice:
            return f"some force at {group.name} is not linear, or looks at each of the others by itself"
    exchange = build_exchange(system, numbers.timings)
    kinds = {id(one): kind for kind, one in enumerate(on)}
    found = []
    for peers in peer_groups(system, on, prepared.schedules, numbers, exchange):
        kind = kinds[id(peers.jacobians)]
        pushes = []
        for one in parts[kind]:
            push = push_of(switched[kind], one, prepared.jacobians[kind], peers.parameters)
            if isinstance(push, str):
                return push
            pushes += [push] if push else []
        found.append((peers, tuple(pushes)))
    return found


def with_gain(group: PeerGroup, pushes: Sequence[Push], gain: Fraction) -> PeerGroup:
    """Return peers whose contacts, always on, push so many times as hard.

    Parameters
    ----------
    group, pushes
        As of `contact_groups`.
    gain
        The factor.
    """
    site, exact = (_pushing(one, pushes, gain) for one in (group.site, group.exact))
    return group.with_site(site, exact, group.schedule)


def _pushing(site: LinearSite, pushes: Sequence[Push], gain: Fraction) -> LinearSite:
    """Return a site whose contacts push so many times as hard, of floats or rationals."""
    ticks = list(site.ticks)
    for one in pushes:
        tick = ticks[one.partition]
        blocks = [block.copy() for block in (tick.x, tick.u, tick.m, tick.r)]
        for block in blocks:
            block[one.output] *= gain if block.dtype == object else float(gain)
        ticks[one.partition] = replace(tick, **dict(zip("xumr", blocks, strict=True)))
    return replace(site, ticks=tuple(ticks))


def open_loops(system: CompiledSystem, prepared: Prepared) -> list[OpenLoop] | str:
    """Cut all contacts open, or say why that can't be."""
    groups = contact_groups(system, prepared)
    if isinstance(groups, str):
        return groups
    opened: list[Opened] = []
    for group, pushes in groups:
        for one in pushes:
            if one.sector and not one.shares:
                return one.sector
        opened.append(_cut_open(group, pushes))
    of_site = {id(one.group.lifting): one for one in opened}
    exchange = build_exchange(system, resolve(system).timings)
    loops = loops_at_right_angles([one.group for one in opened], exchange, MOST_STATES)
    if isinstance(loops, str):
        return loops
    found = []
    for loop in loops:
        listed = [of_site[id(site.lifting)] for site in loop.sites]
        size = loop.states + sum(len(one.ticks) for one in listed)
        if size > MOST_STATES:
            return f"{size:,} states and ticks of contacts move together, and {MOST_STATES} are the most"
        one_open = _open_loop(loop, listed)
        if isinstance(one_open, str):
            return one_open
        found.append(one_open)
    return found


def _cut_open(group: PeerGroup, pushes: Sequence[Push]) -> Opened:
    """Cut the contacts of some peers open: their forces come from outside, and what they follow goes out."""
    schedule, bare = group.schedule, with_gain(group, pushes, Fraction(0))
    steps = step_durations(schedule)
    found = discretize(bare.exact.a, bare.exact.b, [step * schedule.quantum for step in steps])
    off = {
        step: with_radius(one.matrix, one.roundings * UNIT * one.size)
        for step, one in zip(steps, found, strict=True)
    }
    ticks: list[tuple[str, int]] = []
    slopes = []
    for one in pushes:
        count = schedule.ticks[one.partition]
        ticks += [(one.part, index) for index in range(count)]
        slopes += [tuple(map(Fraction, group.exact.ticks[one.partition].x[one.output]))] * count
    wide, whole = with_cuts(group.site, schedule, [(one.partition, one.output) for one in pushes])
    wide_map = compose(with_roundings(wide), whole, off, numbers=RADII)
    plain = not any(one.slopes[one.states :].any() for one in pushes)
    jumps = next((one.part for one in pushes if one.sector), "")
    return Opened(bare, wide_map, len(bare.lifted.z_names), tuple(ticks), tuple(slopes), plain, jumps)


def _open_loop(loop: Loop, opened: Sequence[Opened]) -> OpenLoop | str:
    """Close a loop whose contacts are cut open, or say why that can't be judged."""
    free = find_rigid_modes(close_loop(loop))
    if free.generalized.shape[1]:
        return "with all contacts open, something drifts ever farther"
    names = [(*one.group.lifted.z_names, *(f"{part}[{tick}]" for part, tick in one.ticks)) for one in opened]
    layout = lay_out(names, [site.schedule for site in loop.sites])
    closed = close_outside(
        loop, [one.map for one in opened], [len(one.ticks) for one in opened], layout, numbers=RADII
    )
    outside = np.concatenate(
        [
            offset + one.states + np.arange(len(one.ticks))
            for offset, one in zip(layout.offsets, opened, strict=True)
        ]
    )
    n = len(layout.names)
    own = np.delete(np.arange(n), outside)
    at = with_doubt(relative_coordinates(free.basis))
    rest, held = own[at.rest], own[at.held]
    taken = relative_rows(closed[:, own], at, RADII)
    a, b = taken[..., rest], taken[..., n:]
    c, d = closed[:, outside][..., rest], closed[:, outside][..., n:]
    each = list(zip(loop.sites, opened, strict=True))
    ports = tuple((site.name, *tick) for site, one in each for tick in one.ticks)
    counts = np.array([float(site.count) for site, one in each for _ in one.ticks])
    still, jumps = np.zeros((2, 1, len(ports))), next((one.jumps for one in opened if one.jumps), "")
    plain = OpenLoop(loop.name, a, b, negated(c), negated(d), ports, counts, (), still, jumps)
    if free.exact and not all(one.plain for one in opened):
        return "what a contact follows is more than positions, and something may drift with all contacts open"
    seen = _seen(opened, free.exact, layout, n, outside)
    if isinstance(seen, str) or not any(seen):
        return seen if isinstance(seen, str) else plain
    # What y follows, over the coordinates held, is that of the first y that does times `seen`.
    first = next(place for place, one in enumerate(seen) if one)
    factors = RADII.add(
        closed[:, outside[first : first + 1]][..., held], RADII.multiply(c[:, first : first + 1], at.weights)
    )
    pushed = RADII.multiply(factors, closed[:, held][..., rest])
    # k (1 − A) = what is pushed.
    left = RADII.subtract(RADII.exact(np.eye(a.shape[-1])), a)
    solved = solve(np.swapaxes(left, -1, -2), np.swapaxes(pushed, -1, -2))
    if solved is None:
        return "what moves with all contacts open can't be told from what drifts"
    along = np.swapaxes(solved, -1, -2)
    share = [one / seen[first] for one in seen]
    column = np.array([[(float(one),) for one in share], [(UNIT * abs(float(one)),) for one in share]])
    moved = RADII.add(RADII.multiply(factors, closed[:, held][..., n:]), RADII.multiply(along, b))
    return replace(
        plain, c=negated(RADII.subtract(c, RADII.multiply(column, along))), seen=tuple(share), moved=moved
    )


def negated(matrix: Matrix) -> Matrix:
    """Return a matrix with its radii times −1."""
    return with_radius(-value_of(matrix), radius_of(matrix))


def _seen(
    opened: Sequence[Opened],
    motions: Sequence[Sequence[Fraction]],
    layout: StateLayout,
    n: int,
    outside: NDArray[np.intp],
) -> tuple[Fraction, ...] | str:
    """Return how far each y follows the one motion that may drift, exactly, 0 where none does."""
    if not motions:
        return ()
    place_of = {int(place): k for k, place in enumerate(np.delete(np.arange(n), outside))}
    rows = []
    for offset, one in zip(layout.offsets, opened, strict=True):
        start = place_of[offset] if one.states else 0
        rows += [[_along(slopes, motion[start:]) for motion in motions] for slopes in one.slopes]
    first = next((row for row in rows if any(row)), None)
    if first is None:
        return ()
    pivot = next(place for place, one in enumerate(first) if one)
    shares = [row[pivot] / first[pivot] for row in rows]
    if any(row != [share * one for one in first] for row, share in zip(rows, shares, strict=True)):
        return "with all contacts open, several things may drift apart, and one is moved by another's contact"
    return tuple(shares)


def _along(slopes: Sequence[Fraction], motion: Sequence[Fraction]) -> Fraction:
    """Return how far a y follows a motion of the continuous states that come first."""
    return sum((s * x for s, x in zip(slopes, motion, strict=False)), Fraction(0))
