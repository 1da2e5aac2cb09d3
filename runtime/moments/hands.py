"""Forces on what hands hold, and where copies are as frames begin: states that a scene gets beside its own.

Takes: a `CompiledSystem` and its peers (`crowd.Hearing`).
Gives: `Forced`, `Peer`, `forced`.
Guarantees: the peers move as before, and are pushed besides; positions are those at the start of a frame of
the scene, whenever frames are said to begin.
Does not: compute moments (see `errors`).

A device is what a peer moves and does not tell others about: what it tells them of is a copy of what all
hold. With m v' = f + …, a slope of v' over anything at all is J = j/m, so 1/m = −(∂J/∂m)/J: what a force at
that place does, whatever is rigidly connected with it.

Each force is drawn as the frame begins, acts from one tick of the fastest clock to the next, and is gone when
the frame ends: a value of a clock of its own, as `schedule` has them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ClockPartition, CompiledSystem, Hold, Kind
from apc.eigen.peer_group import PeerGroup
from apc.frame.exact import evaluate_exact
from apc.frame.lift import lift
from apc.frame.parameters import exact_numbers
from apc.frame.schedule import Act, Event, Propagate, Schedule, Tick, Value
from apc.frame.site import LinearSite, LinearTick
from apc.frame.start import start_arguments
from apc.moments.crowd import Hearing, instants

Matrix = NDArray[Any]

# The clocks of forces and of positions, which no scene can name so, and their outputs.
PUSHES, PLACES = "pushes of hands", "places of copies"
DRAWN, ACTING = 0, 1

# A copy is called by the link and channel that tell others where it is.
Copy = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Peer:
    """What of z a peer got: `drawn` are forces in N as a frame begins, `copies` positions in m.

    `added` are all that it got.
    """

    drawn: range
    added: range
    copies: Mapping[Copy, int]


@dataclass(frozen=True, slots=True)
class Forced:
    """The peers of a scene, pushed; `peers` says what of z they got, by the schedule's id."""

    told: Hearing
    peers: Mapping[int, Peer]


def forced(system: CompiledSystem, told: Hearing, first: Fraction = Fraction(0)) -> Forced | str:
    """Push what hands hold, each for itself, by a force of variance 1 N²; or say why that can't be done.

    Parameters
    ----------
    system
        The compiled scene.
    told
        Its peers.
    first
        When frames begin there, in seconds.
    """
    unit_of = {one.name: one.unit for one in system.parameters}
    used = {part.clock for kind in system.kinds for part in kind.clocks} | {one.clock for one in system.links}
    periods = {clock.name: told.timings[clock.period] for clock in system.clocks if clock.name in used}
    fastest = next(
        clock for clock in system.clocks if clock.name == min(periods, key=lambda name: periods[name])
    )
    ticks = instants(told, fastest)
    groups, rows, peers, built = [], {}, {}, {}
    pushed = False
    for group in told.groups:
        key = id(group.schedule), id(group.lifted)
        if key not in built:
            inverse = _inverse_inertia(group, unit_of)
            if isinstance(inverse, str):
                return inverse
            pushed = pushed or inverse is not None
            built[key] = _pushed(group, inverse, ticks, -first % told.frame)
        found, own = built[key]
        groups.append(
            replace(
                group,
                jacobians=found.jacobians,
                site=found.site,
                exact=found.exact,
                schedule=found.schedule,
                lifted=found.lifted,
            )
        )
        rows[id(found.schedule)] = told.rows[id(group.schedule)]
        peers[id(found.schedule)] = own
    if not pushed:
        return "no peer holds anything but what it tells others about"
    return Forced(replace(told, groups=tuple(groups), rows=rows), peers)


def _inverse_inertia(group: PeerGroup, unit_of: Mapping[str, str]) -> tuple[int, Fraction] | str | None:
    """Return which state a force on a device drives and by how much, None without a device; or why not."""
    site, kind = group.jacobians, group.jacobians.kind
    told_of = {
        _part(kind.states[place].name) for place in np.flatnonzero(_told(site.pattern, kind).any(axis=0))
    }
    masses = tuple(place for place, name in enumerate(kind.parameters) if unit_of.get(name) == "kg")
    if not (site.walkable and kind.derivative.is_a("SXFunction")):
        return f"{kind.name} has a nonlinear loop"
    x, u, _, _, p, t = start_arguments(site, exact_numbers(kind, group.parameters), Fraction, group.listening)
    found: dict[str, tuple[int, set[Fraction]]] = {}
    for place, state in enumerate(kind.states):
        driven = np.flatnonzero(site.pattern.a[place])
        part = _part(state.name)
        if state.unit != "m" or part in told_of or len(driven) != 1 or site.pattern.b[place].any():
            continue
        slopes, *changes = evaluate_exact(_slopes(kind, int(driven[0]), masses), [x, u, p, t])
        moved = [one for one in changes if any(one)]
        if moved:
            inverses = {-a / b for one in moved for a, b in zip(one, slopes, strict=True) if a or b}
            found[part] = int(driven[0]), inverses
    if not found:
        return None
    if len(found) > 1:
        return f"a hand may hold any of {', '.join(found)} ({kind.name})"
    ((part, (velocity, inverses)),) = found.items()
    if len(inverses) != 1:
        return f"{part} moves with masses that move otherwise, and a hand may hold any of them ({kind.name})"
    return velocity, inverses.pop()


def _part(name: str) -> str:
    """Return the part that a state or a parameter is of."""
    return name.rpartition(".")[0]


def _told(site: LinearSite, kind: Kind) -> Matrix:
    """Return what of the continuous states the positions depend on that are sent (positions, n_x)."""
    rows = [
        send.x[place]
        for send, sending in zip(site.sends, kind.sends, strict=True)
        for place, unit in enumerate(sending.units)
        if unit == "m"
    ]
    return np.array(rows).reshape(len(rows), len(kind.states))


@functools.lru_cache(maxsize=64)
def _slopes(kind: Kind, velocity: int, masses: tuple[int, ...]) -> Any:
    """Return the slopes of a velocity's rate over states and holds, and how they change with each mass."""
    x, u, p, t = kind.derivative.sx_in()
    rate = kind.derivative(x, u, p, t)[velocity]
    slopes = casadi.jacobian(rate, casadi.vertcat(x, u)).T
    columns = [slopes, *(casadi.jacobian(slopes, p[mass]) for mass in masses)]
    return casadi.Function("slopes", [x, u, p, t], [casadi.densify(one) for one in columns])


def _pushed(
    group: PeerGroup, force: tuple[int, Fraction] | None, ticks: Sequence[Fraction], start: Fraction
) -> tuple[PeerGroup, Peer]:
    """Return the first peer of a group with forces, drawn as a frame begins, and its copies' positions.

    Parameters
    ----------
    group
        The peers.
    force
        Which state a force drives, and by how much.
    ticks
        When each force begins to act, in seconds of a frame.
    start
        When positions are taken, in seconds of a frame.
    """
    kind, schedule = group.jacobians.kind, group.schedule
    copies = [
        (sending.link, name)
        for sending in kind.sends
        for name, unit in zip(sending.channels, sending.units, strict=True)
        if unit == "m"
    ]
    clock, hold, count = len(kind.clocks), len(kind.holds), len(ticks) if force is not None else 0
    kind = replace(
        kind,
        holds=(*kind.holds, Hold("push", PUSHES, DRAWN, "")),
        clocks=(
            *kind.clocks,
            ClockPartition(PUSHES, ("drawn", "acting"), ("N", "N"), (), (), (), None),
            ClockPartition(PLACES, tuple(name for _, name in copies), ("m",) * len(copies), (), (), (), None),
        ),
    )
    at = [int(time / schedule.quantum) for time in ticks[:count]]
    carries = bool(at) and at[0] > 0  # the last force of a frame acts on in the next
    drawn = [Value(clock, DRAWN, number - count) for number in range(count)]
    before = [Value(clock, ACTING, -1)] if carries else []
    places = [Value(clock + 1, number, -1) for number in range(len(copies))]
    acts = {instant: Act(hold, one) for instant, one in zip(at, drawn, strict=True)}
    taken = int(start / schedule.quantum)
    events: list[Event] = []
    for now, event in _stopping(schedule, {*at, taken}):
        if isinstance(event, Propagate):
            events += [acts[now]] if now in acts else []
            events += [Tick(clock + 1, 0, ())] if now == taken else []
        events.append(event)
    events += [Tick(clock, number, ()) for number in range(count)]
    first = len(kind.states) + len(schedule.carried)
    names = [f"push {number + 1}" for number in range(count)] + ["push before"] * carries
    full = replace(
        schedule,
        events=tuple(events),
        acting=(*schedule.acting, before[0] if carries else None),
        carried=(*schedule.carried, *drawn, *before, *places),
        ticks=(*schedule.ticks, count, 1),
        value_names=(*schedule.value_names, *names, *(f"{name} at the start" for _, name in copies)),
        repeats=None,
    )
    site, exact = (_with_push(one, kind, force) for one in (group.site, group.exact))
    own = replace(
        group,
        jacobians=replace(group.jacobians, kind=kind),
        site=site,
        exact=exact,
        schedule=full,
        lifted=lift(site, full, exact=exact),
    )
    behind = first + count + len(before)
    return own, Peer(
        drawn=range(first, first + count),
        added=range(first, behind + len(copies)),
        copies={copy: behind + number for number, copy in enumerate(copies)},
    )


def _stopping(schedule: Schedule, at: set[int]) -> list[tuple[int, Event]]:
    """Return a frame's events, each with its instant in quanta, so that propagation stops at some."""
    found: list[tuple[int, Event]] = []
    now = 0
    for event in schedule.events:
        if not isinstance(event, Propagate):
            found.append((now, event))
            continue
        end = now + event.duration
        for stop in sorted({one for one in at if now < one < end} | {end}):
            found.append((now, Propagate(stop - now)))
            now = stop
    return found


def _with_push(site: LinearSite, kind: Kind, force: tuple[int, Fraction] | None) -> LinearSite:
    """Return a site's matrices with a hold that pushes, and the two clocks of `kind`."""
    zero = Fraction(0) if site.b.dtype == object else 0.0

    def widened(matrix: Matrix) -> Matrix:
        return np.concatenate([matrix, np.full((len(matrix), 1), zero, matrix.dtype)], axis=1)

    b = widened(site.b)
    if force is not None:
        b[force[0], -1] = force[1] if b.dtype == object else float(force[1])
    n_x, n_u = b.shape
    nothing = (
        np.full((2, n_x), zero, b.dtype),
        np.full((2, n_u), zero, b.dtype),
        np.full((2, 0), zero, b.dtype),
    )
    nothing[1][ACTING, -1] += 1
    told = _told(site, kind)
    held = np.array(
        [
            send.u[place]
            for send, sending in zip(site.sends, kind.sends, strict=True)
            for place, unit in enumerate(sending.units)
            if unit == "m"
        ]
    ).reshape(len(told), n_u - 1)
    empty = np.full((len(told), 0), zero, b.dtype)
    return replace(
        site,
        kind=kind,
        b=b,
        ticks=(
            *(replace(tick, u=widened(tick.u)) for tick in site.ticks),
            LinearTick(PUSHES, *nothing, nothing[2], ()),
            LinearTick(PLACES, told.astype(b.dtype), widened(held.astype(b.dtype)), empty, empty, ()),
        ),
        sends=tuple(replace(send, u=widened(send.u)) for send in site.sends),
    )
