"""May contacts open and close at will: one quadratic function that falls whatever is on, tick by tick.

Takes: a `CompiledSystem` whose peers have parts that switch, and its modes of contact.
Gives: `Switching`, `switching`.
Guarantees: what is called stable is proved, for every pattern of contacts that are on, off or anything
between, each peer and tick by itself; the cost grows with the different peers, not with their number.
Does not: say that a scene whose proof fails is unstable, unless a mode of contact is; look for functions that
are not quadratic, or that change with the contacts.

All contacts cut open, H is the lifted map from their forces f, tick by tick over a frame, to the numbers y
they follow (see `sectors`). Closed again f = φ(y) with f(y − f) ≥ 0, at each tick for itself. So the scene
settles if for some weights λ > 0 of the ticks, Λ = diag(λ),

    Λ + He(−Λ H(e^{jθ})) ≻ 0        for all θ

which is the circle criterion (Tsypkin, 1964) on the lifted system. What can drift with all contacts open is a
pole of H at z = 1, R/(z − 1). Where it is one motion, y follows it alike at all ticks, R = c mᵀ, and with
λ = −m/c the rest is free of it: He(−ΛR/(z − 1)) = ΛR/2 on the circle, of either sign of θ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, prepare
from apc.analysis.contact_modes import ContactModes, parts_of_kinds, settings
from apc.analysis.sectors import Push, push_of
from apc.analysis.switches import bind, find_switches
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.eigen.closing import Feedback, Loop, StateLayout, close, close_loop, feedback_of, lay_out
from apc.eigen.dissipation import least_real, proves_positive
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.peer_group import PeerGroup
from apc.eigen.peers import peer_groups
from apc.eigen.relative import relative_coordinates
from apc.eigen.rigid import find_rigid_modes
from apc.frame.discretize import UNIT, discretize
from apc.frame.exchange import build_exchange
from apc.frame.lift import FrameMap, compose, lift, step_durations, with_roundings
from apc.frame.parameters import resolve
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.frame.schedule import Heard, Sent, Tick, Value, Way
from apc.frame.site import LinearSite
from apc.result import Result

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# States and ticks of contacts of one loop worth a proof: a Riccati equation of so many takes a second.
MOST_STATES = 150

# What comes from outside stands where packets do, and is of no link.
_OUTSIDE = Heard(Way("", "", ""), Sent("", "", 0), 0)

# λ of a tick of a part at a site, and its radius.
_Weights = dict[tuple[str, str, int], tuple[float, float]]

STABLE, CANNOT, OPEN = "stable", "cannot be", "not decided"


@dataclass(frozen=True, slots=True)
class Switching(Result):
    """Whether a scene is stable however its contacts switch; `verdict` is one of STABLE, CANNOT and OPEN.

    `reach` is how many times as stiff all contacts might be for the criterion to hold (infinite: any), None
    where it was not worked out; `mode` is where it is nearest to failing. `reason` says why it is not stable
    or not decided.
    """

    shown_by = "analysis:switching"

    topology: str
    verdict: str
    reason: str
    reach: float | None = None
    mode: str = ""

    @property
    def stable(self) -> bool | None:
        """True where proved, False where some mode is unstable, None where it is open."""
        return {STABLE: True, CANNOT: False}.get(self.verdict)


@part("switching")
def switching(system: CompiledSystem, modes: ContactModes, *, prepared: Prepared | None = None) -> Switching:
    """Say whether contacts may open and close at will.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    modes
        Its modes of contact.
    prepared
        From `analysis.prepare`, of this system with these timings.

    Raises
    ------
    ApcError
        E863 a part that takes too many decisions.
    """
    if modes.unstable:
        named = " or ".join(modes.unstable)
        return Switching(system.name, CANNOT, f"it is not stable when {named}")
    unknown = [mode.name for mode in modes.modes if mode.stable is None or mode.linearized]
    if unknown or modes.notes:
        reason = f"not known when {' or '.join(unknown)}" if unknown else modes.notes[0]
        return Switching(system.name, OPEN, reason)
    try:
        found = _open_scene(system, prepared or prepare(system))
        reason = found if isinstance(found, str) else ""
        return Switching(system.name, OPEN, reason) if isinstance(found, str) else _judge(system.name, found)
    except ApcError as error:
        return Switching(system.name, OPEN, error.mistakes[0].sentence)


@dataclass(frozen=True, slots=True, eq=False)
class _Opened:
    """Peers with their contacts cut open: `map` over [z, y of each tick] and [r, f of each tick].

    `states` are those of z; `ticks` names each y and f by its part and tick, `slopes` are those of each y
    over the continuous states, exactly.
    """

    group: PeerGroup
    map: FrameMap
    states: int
    ticks: tuple[tuple[str, int], ...]
    slopes: tuple[tuple[Fraction, ...], ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Circle:
    """A loop with its contacts cut open, from f to −y, what can drift taken out.

    `ports` name each f by its site, part and tick, `counts` how many peers have it. What can drift moves by
    `moved` · f; y follows it by `seen`, exactly but for one factor; both are empty where nothing does.
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
    switched = [find_switches(kind) for kind in system.kinds]
    parts = parts_of_kinds(system, switched, numbers)
    on = tuple(
        bind(one, site, settings(listed, on=True)) if one.decisions else site
        for one, site, listed in zip(switched, prepared.jacobians, parts, strict=True)
    )
    for place, one in enumerate(system.groups):
        for listed in parts[one.kind]:
            site, vector = prepared.jacobians[one.kind], numbers.parameters[place][0]
            told = push_of(switched[one.kind], listed, site, vector)
            if isinstance(told, str):
                return told
        if not on[one.kind].parameters_suffice:
            return f"some force at {one.name} is not linear, or looks at each of the others by itself"
    exchange = build_exchange(system, numbers.timings)
    kinds = {id(one): kind for kind, one in enumerate(on)}
    found = []
    for group in peer_groups(system, on, prepared.schedules, numbers, exchange):
        kind = kinds[id(group.jacobians)]
        site = prepared.jacobians[kind]
        pushes = [push_of(switched[kind], listed, site, group.parameters) for listed in parts[kind]]
        found.append((group, tuple(one for one in pushes if isinstance(one, Push))))
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
    return replace(group, site=site, exact=exact, lifted=lift(site, group.schedule, exact=exact))


def _pushing(site: LinearSite, pushes: Sequence[Push], gain: Fraction) -> LinearSite:
    """Return a site whose contacts push so many times as hard, of floats or rationals."""
    ticks = list(site.ticks)
    for one in pushes:
        tick = ticks[one.partition]
        blocks = [np.array(block) for block in (tick.x, tick.u, tick.m, tick.r)]
        for block in blocks:
            block[one.output] *= gain if block.dtype == object else float(gain)
        x, u, m, r = blocks
        ticks[one.partition] = replace(tick, x=x, u=u, m=m, r=r)
    return replace(site, ticks=tuple(ticks))


def _open_scene(system: CompiledSystem, prepared: Prepared) -> list[_Circle] | str:
    """Cut all contacts open, or say why that can't be."""
    groups = contact_groups(system, prepared)
    if isinstance(groups, str):
        return groups
    opened: list[_Opened] = []
    for group, pushes in groups:
        for one in pushes:
            if one.sector:
                return one.sector
        opened.append(_cut_open(group, pushes))
    by_name = {one.group.name: one for one in opened}
    exchange = build_exchange(system, resolve(system).timings)
    loops = loops_at_right_angles([one.group for one in opened], exchange, MOST_STATES)
    if isinstance(loops, str):
        return loops
    found = []
    for loop in loops:
        size = loop.states + sum(len(by_name[site.name].ticks) for site in loop.sites)
        if size > MOST_STATES:
            return f"{size:,} states and ticks of contacts move together, and {MOST_STATES} are the most"
        circle = _circle(loop, [by_name[site.name] for site in loop.sites])
        if isinstance(circle, str):
            return circle
        found.append(circle)
    return found


def _cut_open(group: PeerGroup, pushes: Sequence[Push]) -> _Opened:
    """Cut the contacts of some peers open: their forces come from outside, and what they follow goes out."""
    schedule, bare = group.schedule, with_gain(group, pushes, Fraction(0))
    steps = step_durations(schedule)
    found = discretize(bare.exact.a, bare.exact.b, [step * schedule.quantum for step in steps])
    off = {
        step: with_radius(one.matrix, one.roundings * UNIT * one.size)
        for step, one in zip(steps, found, strict=True)
    }
    wide, carried, heard = bare.site, list(schedule.carried), len(schedule.heard)
    rows: dict[int, list[int]] = {}
    ticks: list[tuple[str, int]] = []
    slopes = []
    for one in pushes:
        listed, own = list(wide.ticks), group.site.ticks[one.partition]
        tick, outputs = listed[one.partition], len(listed[one.partition].x)
        force = np.zeros((outputs + 1, 1))
        force[one.output] = 1.0
        listed[one.partition] = replace(
            tick,
            x=np.vstack([tick.x, own.x[one.output]]),
            u=np.vstack([tick.u, own.u[one.output]]),
            m=np.vstack([tick.m, own.m[one.output]]),
            r=np.hstack([np.vstack([tick.r, np.zeros((1, tick.r.shape[1]))]), force]),
        )
        wide = replace(wide, ticks=tuple(listed))
        count = schedule.ticks[one.partition]
        carried += [Value(one.partition, outputs, index - count) for index in range(count)]
        rows.setdefault(one.partition, []).append(heard + len(ticks))
        ticks += [(one.part, index) for index in range(count)]
        slopes += [tuple(map(Fraction, group.exact.ticks[one.partition].x[one.output]))] * count
    events = tuple(
        replace(one, heard=(*one.heard, *((row + one.index,) for row in rows.get(one.partition, ()))))
        if isinstance(one, Tick)
        else one
        for one in schedule.events
    )
    whole = replace(
        schedule,
        events=events,
        carried=tuple(carried),
        heard=(*schedule.heard, *(_OUTSIDE,) * len(ticks)),
        repeats=None,
    )
    wide_map = compose(with_roundings(wide), whole, off, numbers=RADII)
    return _Opened(bare, wide_map, len(bare.lifted.z_names), tuple(ticks), tuple(slopes))


def _circle(loop: Loop, opened: Sequence[_Opened]) -> _Circle | str:
    """Close a loop whose contacts are cut open, or say why that can't be judged."""
    free = find_rigid_modes(close_loop(loop))
    if free.generalized.shape[1]:
        return "with all contacts open, something drifts ever farther"
    names = [(*one.group.lifted.z_names, *(f"{part}[{tick}]" for part, tick in one.ticks)) for one in opened]
    layout = lay_out(names, [site.schedule for site in loop.sites])
    closed = _closed(loop, opened, layout)
    outside = np.concatenate(
        [
            offset + one.states + np.arange(len(one.ticks))
            for offset, one in zip(layout.offsets, opened, strict=True)
        ]
    )
    n = len(layout.names)
    own = np.delete(np.arange(n), outside)
    at = relative_coordinates(free.basis)
    rest, held = own[at.rest], own[at.held]
    weights = with_radius(at.weights, at.doubt)
    taken = closed[:, rest]
    if len(held):
        taken = RADII.subtract(taken, RADII.multiply(weights, closed[:, held]))
    a, b = taken[..., rest], taken[..., n:]
    c, d = closed[:, outside][..., rest], closed[:, outside][..., n:]
    ports = tuple((one.group.name, *tick) for one in opened for tick in one.ticks)
    counts = np.array([float(one.group.count) for one in opened for _ in one.ticks])
    circle = _Circle(loop.name, a, b, _turned(c), _turned(d), ports, counts, (), np.zeros((2, 1, len(ports))))
    seen = _seen(opened, free.exact, layout, n, outside)
    if isinstance(seen, str) or not any(seen):
        return seen if isinstance(seen, str) else circle
    # What y follows, over the coordinates held, is that of the first y that does times `seen`.
    first = next(place for place, one in enumerate(seen) if one)
    factors = RADII.add(
        closed[:, outside[first : first + 1]][..., held], RADII.multiply(c[:, first : first + 1], weights)
    )
    pushed = RADII.multiply(factors, closed[:, held][..., rest])
    along = _solved(pushed, a)
    if along is None:
        return "what moves with all contacts open can't be told from what drifts"
    share = [one / seen[first] for one in seen]
    column = np.array([[(float(one),) for one in share], [(UNIT * abs(float(one)),) for one in share]])
    moved = RADII.add(RADII.multiply(factors, closed[:, held][..., n:]), RADII.multiply(along, b))
    return replace(
        circle, c=_turned(RADII.subtract(c, RADII.multiply(column, along))), seen=tuple(share), moved=moved
    )


def _turned(matrix: Matrix) -> Matrix:
    """Return a matrix with its radii times −1."""
    return with_radius(-value_of(matrix), radius_of(matrix))


def _closed(loop: Loop, opened: Sequence[_Opened], layout: StateLayout) -> Matrix:
    """Close a loop over its states, the y among them, and the forces from outside behind them."""
    total, first = sum(len(one.ticks) for one in opened), 0
    feedback = []
    for one, plain in zip(opened, feedback_of(loop, layout), strict=True):
        many, heard = len(one.ticks), plain.now.shape[1]
        now = np.zeros((2, heard + many, plain.now.shape[2]))
        before = np.zeros((2, heard + many, len(layout.names) + total))
        now[:, :heard], before[:, :heard, : len(layout.names)] = plain.now, plain.before
        before[0, heard:, len(layout.names) + first : len(layout.names) + first + many] = np.eye(many)
        feedback.append(Feedback(now, before))
        first += many
    return close([one.map for one in opened], feedback, layout, numbers=RADII).matrix


def _seen(
    opened: Sequence[_Opened],
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
        rows += [
            [
                sum((s * x for s, x in zip(slopes, motion[start:], strict=False)), Fraction(0))
                for motion in motions
            ]
            for slopes in one.slopes
        ]
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


def _solved(right: Matrix, a: Matrix) -> Matrix | None:
    """Return k with k (1 − A) = a row (2, 1, n), with its radius; None where that can't be bounded."""
    n = a.shape[-1]
    left = RADII.subtract(RADII.exact(np.eye(n)), a)
    try:
        inverse = np.linalg.inv(value_of(left))
    except np.linalg.LinAlgError:
        return None
    near = value_of(right) @ inverse
    off = RADII.subtract(right, RADII.multiply(RADII.exact(near), left))
    wrong = RADII.subtract(RADII.exact(np.eye(n)), RADII.multiply(left, RADII.exact(inverse)))
    size = float((np.abs(value_of(wrong)) + radius_of(wrong)).sum(axis=0).max(initial=0.0))
    if not size < 0.5:
        return None
    bound = (np.abs(value_of(off)) + radius_of(off)) @ np.abs(inverse)
    return with_radius(near, (1 + (n + 4) * UNIT) * (bound + 2 * size * bound.max(initial=0.0)))


def _judge(topology: str, circles: Sequence[_Circle]) -> Switching:
    """Prove the circle criterion of all loops, or say which fails."""
    drifting = [one for one in circles if one.seen]
    if len(drifting) > 1:
        names = " and ".join(one.name for one in drifting)
        reason = f"with all contacts open, what may drift is of several modes: {names}"
        return Switching(topology, OPEN, reason)
    weights: _Weights = {}
    for one in drifting:
        for k, (site, name, tick) in enumerate(one.ports):
            if not one.seen[k]:
                return Switching(
                    topology, OPEN, f"{name} does not hold what may drift with all contacts open"
                )
            by = -1 / (float(one.seen[k]) * one.counts[k])
            moved, off = (float(one.moved[which, 0, k]) for which in (0, 1))
            weights[site, name, tick] = by * moved, abs(by) * (off + 8 * UNIT * abs(moved))
            if not weights[site, name, tick][0] > weights[site, name, tick][1]:
                return Switching(topology, OPEN, f"{name} drives away what may drift with all contacts open")
    least, worst = np.inf, ""
    for one in circles:
        root = np.sqrt(np.diag(value_of(_weigh(one, weights))))
        a, b, c, d = (value_of(block) for block in (one.a, one.b, one.c, one.d))
        pole = value_of(one.moved)[0] / root
        scaled = b / root, root[:, None] * c, root[:, None] * d / root
        found, _ = least_real(a, *scaled, -np.outer(pole, pole) / 2)
        if found < least:
            least, worst = found, one.name
    reach = float("inf") if least >= 0 else float(-1 / least)
    fails = [one.name for one in circles if not _is_proved(one, weights)]
    if not reach > 1:
        reason = f"the circle criterion fails in the {worst} mode"
    elif fails:
        reason = f"the circle criterion holds too narrowly to be proved in the {fails[0]} mode"
    else:
        return Switching(topology, STABLE, "", reach, worst)
    return Switching(topology, OPEN, reason, reach, worst)


def _weigh(one: _Circle, weights: _Weights) -> Matrix:
    """Return the weights of a loop's ticks, of all their peers, on a diagonal with their radii."""
    found = np.zeros((2, len(one.ports), len(one.ports)))
    for k, (port, count) in enumerate(zip(one.ports, one.counts.tolist(), strict=True)):
        value, radius = weights.get(port, (1.0, 0.0))
        found[:, k, k] = value * count, (radius + UNIT * value) * count * (1 + 4 * UNIT)
    return found


def _is_proved(one: _Circle, weights: _Weights) -> bool:
    """Say whether a loop's circle criterion is proved with these weights of the ticks."""
    weigh = _weigh(one, weights)
    half = RADII.multiply(np.swapaxes(one.moved / 2, -1, -2), one.moved)
    c, d = (RADII.multiply(weigh, block) for block in (one.c, one.d))
    return proves_positive(one.a, one.b, c, d, RADII.subtract(weigh, half))
