"""What moves when a hand pushes: the steady motion under a force e^{st}, of each mode of a scene.

Takes: peers with a device each, as loops.
Gives: `Site`, `open_site`; `Pushed`, `pushed_loop`; `spectra`; `Carried`, `add`, `scaled`; `force_lanes`.
Guarantees: no sampling of the force or of the motion: every tick, hold and packet acts when it does, and what
comes back at s and at s + 2πjk/T, T a frame, is exact but for rounding, which is bounded.
Does not: put modes together to peers (see `answers`).

Within an interval of a frame of length τ, a force e^{sσ} kicks the states by

    γ(s) = ∫ e^{A(τ−σ)} b e^{sσ} dσ = Σ s^i γ_i        γ_i = ∫ e^{A(τ−σ)} b σ^i/i! dσ

and what all kicks do to the state ξ of a frame, and to what holds put out, follows from the kernel. The state
repeats as (e^{sT} − M) ξ = Σ kicks. Of x' = A x + B u + b e^{st}, taken over a frame against e^{−s't},
s' = s + 2πjk/T, the ends cancel, and the motion at s' is (s' − A)⁻¹ (B û + b [k = 0]).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import Loop, close_loop
from apc.eigen.peers import PeerGroup
from apc.frame.devices import Device
from apc.frame.discretize import COEFFICIENT_ROUNDINGS, UNIT, Step, discretize, exponential_rows
from apc.frame.lift import bounded, check_packets, named, step_durations
from apc.frame.ports import Ports, with_holds, with_ports
from apc.frame.radius import radius_of, value_of, with_radius
from apc.frame.schedule import Propagate, Schedule

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrix = NDArray[Any]

# Numbers with what they may be off by.
Carried = tuple[Complex, Floats]

# Less than any number of interest, in SI.
LEAST = 1e-250

# Entries of the matrices that are solved at once, each some hundred bytes at work.
TOGETHER = 2**18

# A series ends where its terms, of the largest |s τ|, are less than this.
SERIES = 1e-18


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """A peer that may be pushed: its device, its equations, and its intervals in a frame.

    `a`, `b` (2, n_x, …) are the continuous equations with their radii, `push` (2, n_x) what a force at the
    device does; `seconds` and `starts` (r,) the intervals; `ports` where in z the kicks at their ends are
    and, as they begin, states and holds.
    """

    group: PeerGroup
    device: Device | None
    a: Matrix
    b: Matrix
    push: Matrix
    seconds: tuple[Fraction, ...]
    starts: tuple[Fraction, ...]
    ports: Ports

    @property
    def states(self) -> tuple[str, ...]:
        """The names of the continuous states."""
        return tuple(state.name for state in self.group.jacobians.kind.states)


@dataclass(frozen=True, slots=True, eq=False)
class Pushed:
    """A mode whose peers may be pushed: ξ⁺ = M ξ + K κ, and C ξ + D κ (2, …) is what is read, κ the kicks.

    `kicks` and `reads` say for each site which of κ are its, interval by interval: what its states get as one
    ends, and what samples of its device's position are off by from its beginning on (r, n_x + 1); and
    which of what is read are its states and holds as one begins (r, n_x + n_u).
    """

    name: str
    sites: tuple[Site, ...]
    m: Matrix
    k: Matrix
    c: Matrix
    d: Matrix
    kicks: tuple[NDArray[np.intp], ...]
    reads: tuple[NDArray[np.intp], ...]
    frame: Fraction


def open_site(group: PeerGroup, device: Device | None) -> tuple[PeerGroup, Site]:
    """Return a group whose states may be kicked and whose holds are read, interval by interval."""
    schedule = group.schedule
    at, seconds = _intervals(schedule)
    n_x, n_u = group.site.b.shape
    sites, readings = [], []
    for one in (group.site, group.exact):
        sites.append(with_holds(one, np.zeros((n_x, n_x + 1), dtype=one.b.dtype)))
        if device is not None:  # the last way in is what samples of its position are off by
            for tick, plain in zip(sites[-1].ticks, one.ticks, strict=True):
                tick.u[:, -1] = plain.x[:, device.position]
        seen = np.zeros((n_x + n_u, n_x + n_u + n_x + 1), dtype=one.b.dtype)
        seen[:, : n_x + n_u] += np.eye(n_x + n_u, dtype=np.int64)
        readings.append(seen)
    (site, exact), full, ports = with_ports(sites, schedule, n_x + 1, at, readings, at)
    check_packets(full)
    durations = step_durations(full)
    found = discretize(group.exact.a, group.exact.b, [one * full.quantum for one in durations])
    kicked = [_with_kicks(step, n_x) for step in found]
    lifted = named(site.kind, full, *bounded(site, full, dict(zip(durations, kicked, strict=True))))
    charge = COEFFICIENT_ROUNDINGS * UNIT
    push = np.zeros((2, n_x))
    if device is not None:
        push[0, device.velocity] = float(device.inverse)
        push[1, device.velocity] = UNIT * abs(float(device.inverse))
    own = group.with_site(site, exact, full, lifted)
    return own, Site(
        group=group,
        device=device,
        a=with_radius(group.site.a, charge * np.abs(group.site.a)),
        b=with_radius(group.site.b, charge * np.abs(group.site.b)),
        push=push,
        seconds=tuple(one * schedule.quantum for one in seconds),
        starts=tuple(one * schedule.quantum for one in at),
        ports=ports,
    )


def _intervals(schedule: Schedule) -> tuple[list[int], list[int]]:
    """Return when in a frame nothing happens for a while, from when on and for how long, in quanta."""
    at, lasting, now = [], [], 0
    for event in schedule.events:
        if isinstance(event, Propagate):
            at.append(now)
            lasting.append(event.duration)
            now += event.duration
    return at, lasting


def _with_kicks(step: Step, n_x: int) -> Step:
    """Return a step at whose end each of some more holds adds its value to a state."""
    matrix = np.concatenate([step.matrix, np.eye(n_x, n_x + 1)], axis=1)
    size = np.concatenate([step.size, np.zeros((n_x, n_x + 1))], axis=1)
    return Step(matrix, size, step.roundings)


def pushed_loop(loop: Loop, sites: Mapping[int, Site]) -> Pushed:
    """Close a loop of opened peers, and take their ways in and out from its states.

    Parameters
    ----------
    loop, sites
        Its groups are those of `open_site`, whose sites are known by the schedule's id.
    """
    closed = close_loop(loop)
    own = [sites[id(group.schedule)] for group in loop.sites]
    whole = with_radius(closed.matrix, closed.error)
    pairs = list(zip(closed.offsets, own, strict=True))
    added = [start + place for start, one in pairs for place in one.ports.added]
    rest = np.delete(np.arange(len(closed.matrix)), added)
    ways, numbered = [], []
    for listed in (
        [start + one.ports.drawn for start, one in pairs],
        [start + one.ports.read for start, one in pairs],
    ):
        ways.append(np.concatenate([one.ravel() for one in listed]))
        starts = np.cumsum([0, *(one.size for one in listed)])
        numbered.append(
            tuple(
                np.arange(start, start + one.size).reshape(one.shape)
                for start, one in zip(starts, listed, strict=False)
            )
        )
    into, out = ways
    return Pushed(
        name=loop.name,
        sites=tuple(own),
        m=whole[:, rest[:, None], rest],
        k=whole[:, rest[:, None], into],
        c=whole[:, out[:, None], rest],
        d=whole[:, out[:, None], into],
        kicks=numbered[0],
        reads=numbered[1],
        frame=own[0].group.schedule.frame_s,
    )


def spectra(loop: Pushed, pushed: int, wanted: Sequence[tuple[int, int, int]], s: Complex) -> list[Carried]:
    """Return what some states of a mode do under a force e^{st} at all devices of one of its sites.

    Parameters
    ----------
    loop, pushed
        The mode, and which of its sites is pushed with 1 N at each peer.
    wanted
        Which site and continuous state, each, and its motion at s + 2πjn/T for which n.
    s
        (k,), in 1/s.

    Returns
    -------
    For each (k,), in SI units a newton, and a bound on what it is off by.
    """
    kicks = np.zeros((len(s), loop.k.shape[-1]), dtype=np.complex128)
    doubt = np.zeros(kicks.shape)
    site = loop.sites[pushed]
    of_length = {seconds: _kick(site, seconds, s) for seconds in set(site.seconds)}
    for place, (seconds, start) in enumerate(zip(site.seconds, site.starts, strict=True)):
        places = loop.kicks[pushed][place, :-1]
        kicks[:, places], doubt[:, places] = _times(of_length[seconds], _exponential(s, start))
    state = _steady(loop.m, _exponential(s, loop.frame), _product((kicks, doubt), loop.k))
    read = add(_product(state, loop.c), _product((kicks, doubt), loop.d))
    found = {
        (of, alias): _motion(loop, of, read, s, alias, pushed=of == pushed)
        for of, alias in {(of, alias) for of, _, alias in wanted}
    }
    return [(value[:, row], off[:, row]) for of, row, alias in wanted for value, off in [found[of, alias]]]


def _motion(loop: Pushed, of: int, read: Carried, s: Complex, alias: int, *, pushed: bool) -> Carried:
    """Return the continuous states (k, n_x) of a site at s + 2πjn/T."""
    site, frame = loop.sites[of], float(loop.frame)
    at = s + 2j * np.pi * alias / frame
    held = loop.reads[of][:, len(site.states) :]
    value, off = read[0][:, held], read[1][:, held]  # (k, intervals, holds)
    of_length = {seconds: _lasting(at, float(seconds)) for seconds in set(site.seconds)}
    weights = [
        _times(_exponential(-at, start), of_length[seconds])
        for seconds, start in zip(site.seconds, site.starts, strict=True)
    ]
    weight, loose = (np.stack([one[place] for one in weights], axis=1)[:, :, None] for place in range(2))
    charge = (2 * len(weights) + 8) * UNIT
    mean = (value * weight).sum(axis=1) / frame
    doubt = (off * (np.abs(weight) + loose) + np.abs(value) * (loose + charge * np.abs(weight))).sum(axis=1)
    driven = _product((mean, doubt / frame * (1 + charge)), site.b)
    if pushed and alias == 0:
        driven = (
            driven[0] + site.push[0],
            driven[1] + site.push[1] + 2 * UNIT * np.abs(driven[0] + site.push[0]),
        )
    return _steady(site.a, (at, 4 * UNIT * np.abs(at)), driven)


def _exponential(s: Complex, time: Fraction) -> Carried:
    """Return e^{st} (k,)."""
    exact = float(time)
    value = np.exp(s * exact)
    return value, (3 * np.abs(s) * exact + 4) * UNIT * np.abs(value)


def _lasting(s: Complex, seconds: float) -> Carried:
    """Return ∫ e^{−sσ} dσ over so many seconds (k,)."""
    x = -s * seconds
    value = np.asarray(seconds * np.divide(np.expm1(x), x, out=np.ones_like(x), where=x != 0), np.complex128)
    return value, 16 * UNIT * seconds * np.exp(np.maximum(x.real, 0.0))


def _kick(site: Site, seconds: Fraction, s: Complex) -> Carried:
    """Return γ(s) (k, n_x) of an interval, by its series in s."""
    time = float(seconds)
    size = float(np.abs(s).max(initial=0.0)) * time
    terms, term = 1, 1.0
    while term > SERIES or terms < size:
        term *= size / terms
        terms += 1
    n, step = len(site.states), force_lanes(site, time, terms)
    lanes, off = step.matrix[0, :n, n:], step.roundings * UNIT * step.size[0, :n, n:]
    powers = (s * time)[:, None] ** np.arange(terms)
    magnitudes = np.abs(powers)
    value = powers @ lanes.T
    bound = magnitudes @ (off + (3 * np.arange(terms) + terms + 4) * UNIT * np.abs(lanes)).T
    left = term * np.exp(size) * np.abs(lanes[:, 0]) * (1 + np.abs(value_of(site.a) * time).sum())
    return value, bound + left


def force_lanes(site: Site, seconds: float, count: int) -> Step:
    """Return what forces σ^i/i!, σ from 0 to 1 over an interval, make of the states as it ends.

    Parameters
    ----------
    site, seconds
        The peer, and how long the interval is.
    count
        How many: γ_i is column n_x + i of the first n_x rows, i < count.

    Notes
    -----
    A lane that starts at σ^i/i! feeds the push: x' = A x + b ω₀, ω_i' = ω_{i+1}, the interval being 1.
    """
    n = len(site.states)
    generator = np.zeros((1, n + count, n + count))
    generator[0, :n, :n] = value_of(site.a) * seconds
    generator[0, :n, n] = site.push[0] * seconds
    generator[0, range(n, n + count - 1), range(n + 1, n + count)] = 1.0
    return exponential_rows(generator, np.zeros((1, n + count, 0)), 1.0)


def _times(one: Carried, other: Carried) -> Carried:
    """Return products entry by entry; a row (k,) goes with each column."""
    a, off_a = one
    b, off_b = other
    if a.ndim > b.ndim:
        b, off_b = b[:, None], off_b[:, None]
    value = a * b
    return value, off_a * (np.abs(b) + off_b) + np.abs(a) * off_b + 4 * UNIT * np.abs(value)


def add(one: Carried, other: Carried) -> Carried:
    """Return a sum, entry by entry."""
    value = one[0] + other[0]
    return value, one[1] + other[1] + 2 * UNIT * np.abs(value)


def scaled(one: Carried, share: float) -> Carried:
    """Return so many times what there is, a number that was rounded a few times."""
    return one[0] * share, one[1] * abs(share) + 8 * UNIT * np.abs(one[0] * share)


def _product(rows: Carried, matrix: Matrix) -> Carried:
    """Return rows (k, n) times the transpose of a real matrix (2, m, n) with its radii."""
    value, off = rows
    real, radius = value_of(matrix), radius_of(matrix)
    size = np.abs(value)
    charge = (real.shape[1] + 4) * UNIT
    bound = off @ (np.abs(real) + radius).T + size @ (radius + charge * np.abs(real)).T
    return value @ real.T, bound * (1 + charge)


def _steady(matrix: Matrix, at: Carried, driven: Carried) -> Carried:
    """Return x (k, n) of (z − M) x = driven, for z (k,) and a real M (2, n, n) with its radii.

    Notes
    -----
    With G = z − M, an inverse Y in floats and F = 1 − Y G, x in floats is off by e ≤ b + |F| e, b being
    |Y| times residual and radii; with |F| b ≤ θ b, entry by entry, that is at most b/(1 − θ).
    """
    real, radius = value_of(matrix), radius_of(matrix)
    n = len(real)
    block = TOGETHER // max(real.size, 1) or 1
    if len(at[0]) > block:
        places = [slice(first, first + block) for first in range(0, len(at[0]), block)]
        parts = [_steady(matrix, (at[0][i], at[1][i]), (driven[0][i], driven[1][i])) for i in places]
        return np.concatenate([value for value, _ in parts]), np.concatenate([off for _, off in parts])
    system = at[0][:, None, None] * np.eye(n) - real
    loose = at[1][:, None, None] * np.eye(n) + radius
    inverse = np.linalg.inv(system)
    value = np.matmul(inverse, driven[0][:, :, None])
    size, charge = np.abs(inverse), (n + 6) * UNIT
    loose = loose + charge * np.abs(system)
    wrong = np.abs(np.matmul(inverse, system) - np.eye(n)) + np.matmul(size, loose)
    residual = np.abs(driven[0][:, :, None] - np.matmul(system, value)) + np.matmul(loose, np.abs(value))
    residual += (driven[1] + charge * np.abs(driven[0]))[:, :, None]
    bound = np.matmul(size, residual) + LEAST
    share = (np.matmul(wrong, bound) / bound).max(axis=(1, 2))
    if (share >= 0.5).any():  # entries of it are far apart: a little of the largest is added to all
        norm = wrong.sum(axis=2).max(axis=1)
        bound += np.where(share < 0.5, 0.0, 4 * norm * bound.max(axis=(1, 2)))[:, None, None]
        share = (np.matmul(wrong, bound) / bound).max(axis=(1, 2))
    bound *= np.where(share < 0.5, (1 + charge) / (1 - share), np.inf)[:, None, None]
    return value[:, :, 0], bound[:, :, 0]
