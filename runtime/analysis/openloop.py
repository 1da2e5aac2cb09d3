"""The loop of the whole system, cut at every force: the paper's open-loop model.

Takes: a `CompiledSystem` of the paper's form: linear, one clock of forces, one network clock at a whole
multiple of its period.
Gives: `OpenLoop`, `Input`, `Heard`, `open_loop`, `whole_system`, `over`.
Guarantees: any number of peers, any ratio, any graph; a scene of another form is told what it lacks.
Does not: stack ticks into a frame, or delay anything (see `paper`).

With x of all peers, u_c what a force makes of its own peer's samples, u_n what it makes of the others'
packets, and y_n what is heard (Rakhsha and Constantinescu, eqs. (7) to (18)):

    dx/dt = A x + B (u_c, u_n),   y = (x, y_n) = C x

A force that has both parts counts as two inputs, through one column of B each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.closing import ClosedSystem
from apc.eigen.modes import dense
from apc.eigen.peer_group import PeerGroup
from apc.frame.discretize import discretize
from apc.frame.schedule import Way

Floats = NDArray[np.float64]

# More rows than this of y_D are refused: four dense matrices of that size already fill 100 MB.
MOST_ROWS = 1800

# What a scene of another form can do instead.
_INSTEAD = "--method modes, which asks for none of it"


@dataclass(frozen=True, slots=True)
class Input:
    """An input: force `name` acts through column `hold` of site `site`, `delay` force ticks late.

    It is the sum of weight · y over `terms`: (place in y_c or y_n, weight).
    """

    name: str
    site: int
    hold: int
    delay: int
    terms: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class Heard:
    """A row of y_n: what site `site` hears, `delay` frames late; `terms` are (place in x, weight)."""

    name: str
    site: int
    delay: int
    terms: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class OpenLoop:
    """Eq. (18) with what the delays and the feedback need; `step` is [F G_c G_n] of one force period."""

    ratio: int
    period: Fraction
    states: tuple[str, ...]
    fast: tuple[Input, ...]
    slow: tuple[Input, ...]
    heard: tuple[Heard, ...]
    a: Floats
    b: Floats
    step: Floats
    step_size: Floats  # the true entries lie within UNIT · step_size of `step`
    c_n: Floats  # (n_yn, n): y_n over x


def over(rows: Sequence[Sequence[tuple[int, float]]], width: int) -> Floats:
    """Return sparse rows as a matrix (len(rows), width)."""
    matrix = np.zeros((len(rows), width))
    for line, terms in enumerate(rows):
        for place, weight in terms:
            matrix[line, place] = weight
    return matrix


def whole_system(system: CompiledSystem) -> ClosedSystem:
    """Return the whole system of the direct route, whose sites are the peers one by one."""
    return dense(*lifted_groups(system))


def open_loop(system: CompiledSystem, whole: ClosedSystem) -> OpenLoop:
    """Cut the loop at every force and name its two parts."""
    sites = whole.sites
    period, frame = _periods(system, sites)
    ratio = int(frame / period)
    timings = {timing.name: timing.value for timing in system.timings}
    starts = np.cumsum([0, *(len(group.jacobians.kind.states) for group in sites)]).tolist()
    n = starts[-1]
    if (n + 2 * len(sites)) * ratio > MOST_ROWS:
        what = (
            f"the paper's matrices for {len(sites)} peers at {ratio} force ticks a frame have more than "
            f"{MOST_ROWS:,} rows"
        )
        raise ApcError(Mistake("E862", Place(system.origin.topology), what, hint=_INSTEAD))
    heard, places = _heard_rows(whole, starts, timings, frame)
    fast: list[Input] = []
    slow: list[Input] = []
    for i, group in enumerate(sites):
        own, received = _inputs(i, group, starts[i], places[i], timings, period)
        fast += own
        slow += received
    a, b = np.zeros((n, n)), np.zeros((n, len(fast) + len(slow)))
    step, size = np.zeros((n, n + len(fast) + len(slow))), np.zeros((n, n + len(fast) + len(slow)))
    known: dict[int, Any] = {}
    for i, group in enumerate(sites):
        if id(group.site) not in known:
            exact = group.exact
            [known[id(group.site)]] = discretize(exact.a, exact.b, [period])
        found, own_rows = known[id(group.site)], slice(starts[i], starts[i + 1])
        n_x = starts[i + 1] - starts[i]
        a[own_rows, own_rows] = group.site.a
        step[own_rows, own_rows], size[own_rows, own_rows] = found.matrix[:, :n_x], found.size[:, :n_x]
        for column, one in enumerate((*fast, *slow)):
            if one.site == i:
                b[own_rows, column] = group.site.b[:, one.hold]
                step[own_rows, n + column] = found.matrix[:, n_x + one.hold]
                size[own_rows, n + column] = found.size[:, n_x + one.hold]
    return OpenLoop(
        ratio=ratio,
        period=period,
        states=tuple(
            f"{group.name}.{state.name}" for group in sites for state in group.jacobians.kind.states
        ),
        fast=tuple(fast),
        slow=tuple(slow),
        heard=tuple(heard),
        a=a,
        b=b,
        step=step,
        step_size=size,
        c_n=over([one.terms for one in heard], n),
    )


def _inputs(
    site: int,
    group: PeerGroup,
    start: int,
    place_of: Mapping[tuple[Way, str], int],
    timings: Mapping[str, Fraction],
    period: Fraction,
) -> tuple[list[Input], list[Input]]:
    """Return the fast and the slow inputs of one peer: each force's own part and its received part."""
    kind, pattern = group.jacobians.kind, group.jacobians.pattern
    partition_of = {partition.clock: p for p, partition in enumerate(kind.clocks)}
    fast, slow = [], []
    for h, hold in enumerate(kind.holds):
        if group.schedule.acting[h] is None:
            continue
        p = partition_of[hold.clock]
        tick, shape = group.site.ticks[p], pattern.ticks[p]
        name, delay = f"{group.name}.{hold.name}", int(timings[hold.delay] / period)
        received = shape.r[hold.output].any()
        if shape.x[hold.output].any() or not received:
            terms = [(start + i, float(k)) for i, k in enumerate(tick.x[hold.output]) if k]
            fast.append(Input(f"{name} own" if received else name, site, h, delay, tuple(terms)))
        if received:
            weights: dict[int, float] = {}
            for place, k in enumerate(tick.r[hold.output]):
                for way in group.schedule.ways(p, place) if k else ():
                    weights[place_of[way]] = weights.get(place_of[way], 0.0) + float(k)
            slow.append(Input(f"{name} received", site, h, delay, tuple(weights.items())))
    return fast, slow


def _heard_rows(
    whole: ClosedSystem, starts: Sequence[int], timings: Mapping[str, Fraction], frame: Fraction
) -> tuple[list[Heard], list[dict[tuple[Way, str], int]]]:
    """Return the rows of y_n, and for each peer where it finds what it hears on a way."""
    rows: list[Heard] = []
    places: list[dict[tuple[Way, str], int]] = []
    for i, group in enumerate(whole.sites):
        own: dict[tuple[Way, str], int] = {}
        several = len({one.way.delay for one in group.schedule.heard}) > 1
        receives = [
            pair
            for p, partition in enumerate(group.jacobians.kind.clocks)
            for place in range(len(partition.receives))
            for pair in group.schedule.ways(p, place)
        ]
        for way, channel in dict.fromkeys(receives):
            terms: dict[int, float] = {}
            for j, weight in enumerate(whole.coupling[way][i]):
                for place, k in _sent(whole.sites[j], way.link, channel) if weight else ():
                    terms[starts[j] + place] = terms.get(starts[j] + place, 0.0) + float(weight) * k
            own[way, channel] = len(rows)
            delay = int(timings[way.delay] / frame)
            late = f" {delay} frames late" if several else ""
            name = f"{group.name}.{way.operator}(others.{channel}){late}"
            rows.append(Heard(name, i, delay, tuple(terms.items())))
        places.append(own)
    return rows, places


def _sent(group: PeerGroup, link: str, channel: str) -> Iterator[tuple[int, float]]:
    """Yield what a peer's channel is made of: (state, weight)."""
    for sending, send in zip(group.jacobians.kind.sends, group.site.sends, strict=True):
        if sending.link == link and channel in sending.channels:
            row = send.x[sending.channels.index(channel)]
            yield from ((int(place), float(row[place])) for place in row.nonzero()[0])


def _periods(system: CompiledSystem, sites: Sequence[PeerGroup]) -> tuple[Fraction, Fraction]:
    """Return T_c and T_n, or say everything that keeps a scene from having the paper's form."""
    timings = {timing.name: timing.value for timing in system.timings}
    clock_of = {clock.name: clock for clock in system.clocks}
    link_clock = {link.name: link.clock for link in system.links}
    missing: dict[str, None] = {}
    forces: dict[str, None] = {}
    networks: dict[str, None] = {}
    for group in {id(group.site): group for group in sites}.values():
        missing |= dict.fromkeys(_misfits(group))
        for h, hold in enumerate(group.jacobians.kind.holds):
            if group.schedule.acting[h] is not None:
                forces[hold.clock] = None
        networks |= {link_clock[one.way.link]: None for one in group.schedule.heard}
    for what, found in (("clock of forces", forces), ("network clock", networks)):
        if len(found) != 1:
            listed = f"here are {' and '.join(found)}" if found else "here is none"
            missing[f"one {what} ({listed})"] = None
    if missing:
        raise _not_of_the_form(system, missing)
    fast, slow = clock_of[next(iter(forces))], clock_of[next(iter(networks))]
    period, frame = timings[fast.period], timings[slow.period]
    if (frame / period).denominator != 1:
        missing[f"a network period that is a whole multiple of that of {fast.name}"] = None
    elif ((timings[slow.phase] - timings[fast.phase]) / period).denominator != 1:
        missing[f"ticks of {slow.name} that fall on ticks of {fast.name}"] = None
    for group in sites:
        for h, hold in enumerate(group.jacobians.kind.holds):
            if group.schedule.acting[h] is not None and (timings[hold.delay] / period).denominator != 1:
                missing[f"a computational delay of {hold.name} of whole ticks of {fast.name}"] = None
        for one in group.schedule.heard:
            if (timings[one.way.delay] / frame).denominator != 1:
                missing[f"a delay of {one.way.link} of whole ticks of {slow.name}"] = None
    if missing:
        raise _not_of_the_form(system, missing)
    return period, frame


def _misfits(group: PeerGroup) -> Iterator[str]:
    """Yield what a peer's own equations lack."""
    kind, pattern = group.jacobians.kind, group.jacobians.pattern
    if not group.site.affine:
        yield f"linear equations ({kind.name} is not linear)"
    for partition, tick in zip(kind.clocks, pattern.ticks, strict=True):
        if partition.variants:
            yield "forces that are the same at every tick (they follow the age of what is heard)"
        if any(receive.before for receive in partition.receives):
            yield "forces of what is heard now (what the tick before heard counts as well)"
        if tick.m.any():
            names = [partition.outputs[partition.memories[m]] for m in np.flatnonzero(tick.m.any(axis=0))]
            yield f"forces of the samples alone ({', '.join(names)} is remembered from tick to tick)"
        if tick.u.any():
            yield f"forces of the samples alone (on {partition.clock}, a held force is read)"
    if any(send.u.any() for send in pattern.sends):
        yield "packets of the motion alone (a held force is sent)"


def _not_of_the_form(system: CompiledSystem, missing: Mapping[str, None]) -> ApcError:
    what = "the paper's route is written for another form of scene; missing: " + "; ".join(missing)
    return ApcError(Mistake("E861", Place(system.origin.topology), what, hint=_INSTEAD))
