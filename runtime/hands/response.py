"""What moves when a hand pushes: the steady motion under a force e^{st}, of each mode of a scene.

Takes: peers with a device each, as loops.
Gives: `DrivenPeer`, `open_site`; `DrivenMode`, `pushed_loop`; `spectra`; `force_lanes`.
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

from apc.eigen.closing import ModalSystem, close_loop
from apc.eigen.peers import PeerClass
from apc.frame.devices import Device
from apc.frame.discretize import COEFFICIENT_ROUNDINGS, discretize, exponential
from apc.frame.lift import check_packets, compose, step_durations, with_roundings
from apc.frame.ports import FrameInputs, with_holds, with_ports
from apc.frame.radius import RADII, UNIT, rounded, solve, value_of, with_radius
from apc.frame.schedule import Propagate, Schedule

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrix = NDArray[Any]

# Entries of the matrices that are solved at once, each some hundred bytes at work.
TOGETHER = 2**18

# A series ends where its terms, of the largest |s τ|, are less than this.
SERIES = 1e-18


@dataclass(frozen=True, slots=True, eq=False)
class DrivenPeer:
    """A peer that may be pushed: its device, its equations, and its intervals in a frame.

    `a`, `b` (2, n_x, …) are the continuous equations with their radii, `push` (2, n_x) what a force at the
    device does; `seconds` and `starts` (r,) the intervals; `ports` where in z the kicks at their ends are
    and, as they begin, states and holds.
    """

    group: PeerClass
    device: Device | None
    a: Matrix
    b: Matrix
    push: Matrix
    seconds: tuple[Fraction, ...]
    starts: tuple[Fraction, ...]
    ports: FrameInputs

    @property
    def states(self) -> tuple[str, ...]:
        """The names of the continuous states."""
        return tuple(state.name for state in self.group.jacobians.kind.states)


@dataclass(frozen=True, slots=True, eq=False)
class DrivenMode:
    """A mode whose peers may be pushed: ξ⁺ = M ξ + K κ, and C ξ + D κ (2, …) is what is read, κ the kicks.

    `kicks` and `reads` say for each site which of κ are its, interval by interval: what its states get as one
    ends, and what samples of its device's position are off by from its beginning on (r, n_x + 1); and
    which of what is read are its states and holds as one begins (r, n_x + n_u).
    """

    name: str
    sites: tuple[DrivenPeer, ...]
    m: Matrix
    k: Matrix
    c: Matrix
    d: Matrix
    kicks: tuple[NDArray[np.intp], ...]
    reads: tuple[NDArray[np.intp], ...]
    frame: Fraction


def open_site(group: PeerClass, device: Device | None) -> tuple[PeerClass, DrivenPeer]:
    """Return a group whose states may be kicked and whose holds are read, interval by interval."""
    schedule = group.schedule
    at, seconds = _intervals(schedule)
    n_x, n_u = group.site.b.shape
    sites, readings = [], []
    for linear_site in (group.site, group.exact):
        sites.append(with_holds(linear_site, np.zeros((n_x, n_x + 1), dtype=linear_site.b.dtype)))
        if device is not None:  # the last way in is what samples of its position are off by
            for tick, plain in zip(sites[-1].ticks, linear_site.ticks, strict=True):
                tick.u[:, -1] = plain.x[:, device.position]
        seen = np.zeros((n_x + n_u, n_x + n_u + n_x + 1), dtype=linear_site.b.dtype)
        seen[:, : n_x + n_u] += np.eye(n_x + n_u, dtype=np.int64)
        readings.append(seen)
    (site, exact), full, ports = with_ports(sites, schedule, n_x + 1, at, readings, at)
    check_packets(full)
    durations = step_durations(full)
    steps = discretize(group.exact.a, group.exact.b, [duration * full.quantum for duration in durations])
    # At the end of a step each of some more holds adds its value to a state.
    kick = RADII.exact(np.eye(n_x, n_x + 1))
    kicked = [np.concatenate([step, kick], axis=-1) for step in steps]
    lifted = compose(with_roundings(site), full, dict(zip(durations, kicked, strict=True)), numbers=RADII)
    push = np.zeros((2, n_x))
    if device is not None:
        push[0, device.velocity] = float(device.inverse)
        push[1, device.velocity] = UNIT * abs(float(device.inverse))
    peer_group = group.with_site(site, exact, full, lifted)
    return peer_group, DrivenPeer(
        group=group,
        device=device,
        a=rounded(group.site.a, COEFFICIENT_ROUNDINGS),
        b=rounded(group.site.b, COEFFICIENT_ROUNDINGS),
        push=push,
        seconds=tuple(second * schedule.quantum for second in seconds),
        starts=tuple(number * schedule.quantum for number in at),
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


def pushed_loop(loop: ModalSystem, sites: Mapping[int, DrivenPeer]) -> DrivenMode:
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
    added = [start + place for start, site in pairs for place in site.ports.added]
    rest = np.delete(np.arange(len(closed.matrix)), added)
    ways, numbered = [], []
    for listed in (
        [start + site.ports.drawn for start, site in pairs],
        [start + site.ports.read for start, site in pairs],
    ):
        ways.append(np.concatenate([places.ravel() for places in listed]))
        starts = np.cumsum([0, *(places.size for places in listed)])
        numbered.append(
            tuple(
                np.arange(start, start + places.size).reshape(places.shape)
                for start, places in zip(starts, listed, strict=False)
            )
        )
    into, out = ways
    return DrivenMode(
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


def spectra(
    loop: DrivenMode, pushed: int, wanted: Sequence[tuple[int, int, int]], s: Complex
) -> list[Matrix]:
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
    For each (k, 2, 1, 1), in SI units a newton, with its radius.
    """
    kicks = np.zeros((len(s), 2, loop.k.shape[-1], 1), dtype=np.complex128)
    site = loop.sites[pushed]
    of_length = {seconds: _kick(site, seconds, s) for seconds in set(site.seconds)}
    for place, (seconds, start) in enumerate(zip(site.seconds, site.starts, strict=True)):
        turned = RADII.multiply(of_length[seconds], _exponential(s, start))
        kicks[:, :, loop.kicks[pushed][place, :-1]] = turned
    state = _steady(loop.m, _exponential(s, loop.frame), RADII.multiply(loop.k, kicks))
    read = RADII.add(RADII.multiply(loop.c, state), RADII.multiply(loop.d, kicks))
    result = {
        (of, alias): _motion(loop, of, read, s, alias, pushed=of == pushed)
        for of, alias in {(of, alias) for of, _, alias in wanted}
    }
    return [result[of, alias][:, :, row, None] for of, row, alias in wanted]


def _motion(loop: DrivenMode, of: int, read: Matrix, s: Complex, alias: int, *, pushed: bool) -> Matrix:
    """Return the continuous states (k, 2, n_x, 1) of a site at s + 2πjn/T."""
    site, frame = loop.sites[of], float(loop.frame)
    at = s + 2j * np.pi * alias / frame
    held = read[:, :, loop.reads[of][:, len(site.states) :].T, 0]  # (k, 2, holds, intervals)
    of_length = {seconds: _lasting(at, float(seconds)) for seconds in set(site.seconds)}
    weights = [
        RADII.multiply(_exponential(-at, start), of_length[seconds])
        for seconds, start in zip(site.seconds, site.starts, strict=True)
    ]
    share = with_radius(np.array([[1 / frame]]), np.array([[2 * UNIT / frame]]))
    mean = RADII.multiply(RADII.multiply(held, np.concatenate(weights, axis=-2)), share)
    driven = RADII.multiply(site.b, mean)
    if pushed and alias == 0:
        driven = RADII.add(driven, site.push[..., None])
    return _steady(site.a, _numbers(at, 4 * UNIT * np.abs(at)), driven)


def _numbers(value: Matrix, off: Floats) -> Matrix:
    """Return numbers (k,) with what they may be off by as matrices (k, 2, 1, 1)."""
    return with_radius(value[:, None, None], off[:, None, None])


def _exponential(s: Complex, time: Fraction) -> Matrix:
    """Return e^{st} (k, 2, 1, 1)."""
    exact = float(time)
    value = np.exp(s * exact)
    return _numbers(value, (3 * np.abs(s) * exact + 4) * UNIT * np.abs(value))


def _lasting(s: Complex, seconds: float) -> Matrix:
    """Return ∫ e^{−sσ} dσ over so many seconds (k, 2, 1, 1)."""
    x = -s * seconds
    value = seconds * np.divide(np.expm1(x), x, out=np.ones_like(x), where=x != 0)
    return _numbers(value, 16 * UNIT * seconds * np.exp(np.maximum(x.real, 0.0)))


def _kick(site: DrivenPeer, seconds: Fraction, s: Complex) -> Matrix:
    """Return γ(s) (k, 2, n_x, 1) of an interval, by its series in s."""
    time = float(seconds)
    size = float(np.abs(s).max(initial=0.0)) * time
    terms, term = 1, 1.0
    while term > SERIES or terms < size:
        term *= size / terms
        terms += 1
    n, step = len(site.states), force_lanes(site, time, terms)
    lanes = step[:, :n, n:]
    powers = ((s * time)[:, None] ** np.arange(terms))[..., None]
    doubt = (3 * np.arange(terms)[:, None] + 4) * UNIT * np.abs(powers)
    values = RADII.multiply(lanes, with_radius(powers, doubt))
    left = term * np.exp(size) * np.abs(value_of(lanes)[:, 0]) * (1 + np.abs(value_of(site.a) * time).sum())
    values[:, 1, :, 0] += left
    return values


def force_lanes(site: DrivenPeer, seconds: float, count: int) -> Matrix:
    """Return what forces σ^i/i!, σ from 0 to 1 over an interval, make of the states as it ends.

    Parameters
    ----------
    site, seconds
        The peer, and how long the interval is.
    count
        How many: γ_i is column n_x + i of the first n_x rows, i < count.

    Returns
    -------
    The exponential of all, with its radii (2, n_x + count, n_x + count).

    Notes
    -----
    A lane that starts at σ^i/i! feeds the push: x' = A x + b ω₀, ω_i' = ω_{i+1}, the interval being 1.
    """
    n = len(site.states)
    generator = np.zeros((2, n + count, n + count))
    generator[:, :n, :n] = RADII.scaled(site.a, seconds)
    generator[:, :n, n : n + 1] = RADII.scaled(site.push[..., None], seconds)
    generator[0, range(n, n + count - 1), range(n + 1, n + count)] = 1.0
    return exponential(generator, np.zeros((2, n + count, 0)), 1.0, RADII)


def _steady(matrix: Matrix, at: Matrix, driven: Matrix) -> Matrix:
    """Return x (k, 2, n, 1) of (z − M) x = driven, for z (k, 2, 1, 1) and M (2, n, n) with their radii."""
    n = matrix.shape[-1]
    values = None
    if len(at) * n**2 <= TOGETHER or len(at) == 1:
        values = solve(RADII.subtract(at * np.eye(n), matrix), driven)
    if values is None and len(at) > 1:
        half = len(at) // 2
        values = np.concatenate(
            [_steady(matrix, at[own], driven[own]) for own in (slice(half), slice(half, None))]
        )
    if values is None:  # z is an eigenvalue, for all that is known
        values = np.full(driven.shape, np.nan + 0j)
        values[:, 1] = np.inf
    return np.asarray(values)
