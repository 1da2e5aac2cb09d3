"""What devices are pushed by, while hands move them as they like: one map a mode.

Takes: a `Model`.
Gives: `PortLoop`, `port_loops`; `reciprocal`.
Guarantees: exact for any motion of the hands: where nothing samples a device and no force on it switches,
only how far it went counts, and the least that its damping takes of that. Matrices carry the radius of their
rounding.
Does not: say whether energy can be drawn (see `passivity`).

Between two instants, τ apart, a device moves by Δ against a constant force f and its damper b. The hand gives
∫F v = ΔE + b ∫v² + f Δ, and ∫v² ≥ Δ²/τ, with equality for a constant velocity. All that others can do depends
on the Δ alone, so the hand can draw energy if and only if Σ f Δ + b Δ²/τ can fall below all bounds. With the
map H from Δ to f this is a question of He H(e^{jθ}) + diag(b/τ).

Devices that stand aside by 1 are pushed back by K for ever: H has the pole K/(z − 1), whose Hermitian part on
the circle is −K/2 for all θ. It is taken out, with what all else moves by when devices stand aside; what
remains has the motions of the scene with devices clamped, and no others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.closing import ModalSystem, close_loop
from apc.eigen.modes import arrange, dense_loop
from apc.eigen.peers import MOST_STATES, PeerClass, states_of
from apc.eigen.relative import relative_coordinates, relative_rows, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.devices import Device, coupled_directly, find_device, no_device
from apc.frame.exchange import CommunicationGraph
from apc.frame.instance import Prepared
from apc.frame.ports import FrameInputs, with_holds, with_ports
from apc.frame.radius import RADII, UNIT, radius_of, solve, value_of, with_radius
from apc.frame.schedule import HoldUpdate, Propagate, Schedule, SendEvent, Tick
from apc.frame.site import LinearSubsystem
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Graphs whose modes are orthogonal: what hands give all peers together is the sum of what they give each.
ORTHOGONAL = ("complete", "ring")

# How alike devices feel each other to count alike: far more than rounding.
EVEN = 1e-9

# Intervals of all devices of a mode together.
MOST_INTERVALS = 400


@dataclass(frozen=True, slots=True)
class _Touched:
    """A peer group whose device is moved from outside: the group with ways in and out, its device's damping.

    The damping is in N·s/m; `seconds` says how long each of the device's intervals is, `ports` where they are
    in z.
    """

    group: PeerClass
    damping: Fraction
    seconds: tuple[Fraction, ...]
    ports: FrameInputs


@dataclass(frozen=True, slots=True, eq=False)
class PortLoop:
    """A mode of devices that hands move: a map from how far they go to what pushes them back, less its pole.

    `a`, `b`, `c`, `d` (2, …) are over the states of the scene with clamped devices; `weight` (2, m, m) is
    what is added to the Hermitian part: dampers, and the pole's. Inputs and outputs are scaled: 1 more on the
    diagonal of `weight` is 1 N·s/m more at each device. `static` (2, k, k) is the stiffness of the pole
    between the k kinds of devices, of all peers together. `joined` says that the energies of all devices
    count alike, so that hands may be joined to each other. `dampings` are the devices' in N·s/m; of the
    intervals `seconds` (m,) says how long they are, `starts` (m,) when they begin in the frame.
    """

    name: str
    multiplicity: int
    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    weight: Matrix
    static: Matrix
    joined: bool
    dampings: tuple[Fraction, ...]
    starts: Floats
    seconds: Floats
    frame_s: float


def port_loops(system: Model, prepared: Prepared, *, option: str) -> tuple[PortLoop, ...]:
    """Return the modes of a scene in which hands move all devices.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    option
        What asked for it.

    Raises
    ------
    ApcError
        E931 no device, or none that can be cut out; E933 too many intervals or states, or a motion that
        nothing holds back.
    NotSupportedError
        Why no device is ever passive.
    """
    groups, exchange = lifted_groups(system, prepared=prepared)
    place, unit_of = (
        SourceLocation(system.origin.topology),
        {parameter.name: parameter.unit for parameter in system.parameters},
    )
    heard = {
        (receive.link, row)
        for group in groups
        for partition, tick in zip(group.jacobians.kind.clocks, group.exact.ticks, strict=True)
        for receive, column, rows in zip(partition.receives, tick.r.T, tick.channels, strict=True)
        if column.astype(np.bool_).any()
        for row in rows
    }
    direct = coupled_directly(system.kinds)
    touched: dict[int, _Touched] = {}
    ported: list[PeerClass] = []
    for group in groups:
        device = find_device(group.jacobians, group.parameters, unit_of, group.listening, direct=direct)
        if device is None:  # a server, say: it is not held
            ported.append(group)
            continue
        if isinstance(device, str):
            raise ApcError(Diagnostic("E931", place, f"{option}: {device}"))
        if felt := _felt_velocity(group, device, heard):
            raise NotSupportedError(felt)
        if touch := _other_touch(group, device):
            why, hint = touch
            raise ApcError(Diagnostic("E933", place, f"{option}: {why}", hint=hint))
        own = _touched(group, device)
        touched[id(own.group.schedule)] = own
        ported.append(own.group)
    if not touched:
        raise no_device(system, option)
    loops, weighted = _loops(system, ported, exchange, option=option)
    result = []
    for loop in loops:
        # A loop in which nothing is held is one of the scene with its devices clamped.
        if any(id(site.schedule) in touched for site in loop.sites):
            together = weighted and len(loop.sites) > 1
            result.append(_port_loop(loop, touched, together=together, place=place, option=option))
    return tuple(result)


def _felt_velocity(group: PeerClass, device: Device, heard: Set[tuple[str, int]]) -> str:
    """Say what samples a device's velocity, "" if nothing does: of what is sent, the channels heard count."""
    kind = group.jacobians.kind
    for partition, tick in zip(kind.clocks, group.exact.ticks, strict=True):
        for row in np.flatnonzero(tick.x[:, device.velocity].astype(np.bool_)):
            name = partition.outputs[row % len(partition.outputs)]
            return (
                f"{name} samples the velocity of {device.part}, and a hand that moves it just then, and "
                "hardly at all, gets any force for nothing"
            )
    for sending, send in zip(kind.sends, group.exact.sends, strict=True):
        rows = np.flatnonzero(send.x[:, device.velocity].astype(np.bool_))
        if any((sending.link, row) in heard for row in rows.tolist()):
            return f"the velocity of {device.part} is sent over {sending.link} as sampled"
    return ""


def _other_touch(group: PeerClass, device: Device) -> tuple[str, str] | None:
    """Say what touches a device otherwise than by samples and held forces, and what to write instead."""
    a, own = group.exact.a, [device.position, device.velocity]
    others = [place for place in range(len(a)) if place not in own]
    both = a[np.ix_(others, own)].astype(np.bool_) | a[np.ix_(own, others)].T.astype(np.bool_)
    if both.any():
        name = group.jacobians.kind.states[others[int(np.flatnonzero(both.any(axis=1))[0])]].name
        return (
            f"{device.part} and what {name} is of act on one another at every moment",
            "a coupler that acts by sample and hold, as SampledSpringDamper",
        )
    if a[device.velocity, device.position] > 0 or a[device.velocity, device.velocity] > 0:
        return f"a spring or damper of {device.part} to the ground is negative", "values of 0 or more"
    return None


def _touched(group: PeerClass, device: Device) -> _Touched:
    """Return a group whose device is moved from outside."""
    schedule = group.schedule
    at = _boundaries(group.exact, schedule, device)
    driven, readings = [], []
    for linear_site, inverse in ((group.site, float(device.inverse)), (group.exact, device.inverse)):
        driven.append(_driven(linear_site, device))
        reading = np.zeros((1, sum(driven[-1].b.shape)), dtype=linear_site.b.dtype)
        reading[0, len(driven[-1].a) : -1] = -linear_site.b[device.velocity] / inverse
        readings.append(reading)
    (site, exact), full, ports = with_ports(driven, schedule, 1, at, readings, at)
    seconds = tuple(end * schedule.quantum for end in np.diff([*at, schedule.frame]).tolist())
    damping = -group.exact.a[device.velocity, device.velocity] / device.inverse
    return _Touched(group.with_site(site, exact, full), damping, seconds, ports)


def _boundaries(site: LinearSubsystem, schedule: Schedule, device: Device) -> list[int]:
    """Return the instants, in quanta, at which a device is sampled or a force on it switches, and 0."""
    numbers, now, counts = {0}, 0, False
    for event in schedule.events:
        match event:
            case Propagate(duration):
                now += duration
            case Tick(partition, _, _):
                counts = bool(site.ticks[partition].x[:, device.position].astype(np.bool_).any())
            case SendEvent(partition, _):
                counts = bool(site.sends[partition].x[:, device.position].astype(np.bool_).any())
            case HoldUpdate(hold, _):
                counts = bool(site.b[device.velocity, hold])
        if not isinstance(event, Propagate) and counts and now < schedule.frame:
            numbers.add(now)
    return sorted(numbers)


def _driven(site: LinearSubsystem, device: Device) -> LinearSubsystem:
    """Return a site without a device's states: a hold, the last, says where the device is."""
    kept = np.delete(np.arange(len(site.a)), [device.position, device.velocity])
    smaller = replace(
        site,
        kind=replace(site.kind, states=tuple(site.kind.states[place] for place in kept)),
        a=site.a[np.ix_(kept, kept)],
        b=site.b[kept],
        ticks=tuple(replace(tick, x=tick.x[:, kept]) for tick in site.ticks),
        sends=tuple(replace(send, x=send.x[:, kept]) for send in site.sends),
    )
    linear_site = with_holds(smaller, np.zeros((len(kept), 1), dtype=site.b.dtype))
    for tick, whole in zip(linear_site.ticks, site.ticks, strict=True):
        tick.u[:, -1] = whole.x[:, device.position]
    for send, sent in zip(linear_site.sends, site.sends, strict=True):
        send.u[:, -1] = sent.x[:, device.position]
    return linear_site


def _loops(
    system: Model, groups: Sequence[PeerClass], exchange: CommunicationGraph, *, option: str
) -> tuple[tuple[ModalSystem, ...], bool]:
    """Return loops that share no energy, and whether a site of them stands for as many peers as it counts."""
    used = {heard.way.link for group in groups for heard in group.schedule.heard}
    if all(exchange.links[link].graph.shape in ORTHOGONAL for link in used):
        arranged = arrange(groups, exchange)
        if arranged.method == "modes":
            return arranged.loops, True
    states = sum(group.count * states_of(group.schedule, group.jacobians) for group in groups)
    if states > MOST_STATES:
        what = f"{exchange.peers:,} peers on such a graph make one system of {states:,} states and intervals"
        hint = f"equal peers on complete graphs or rings, or {MOST_STATES:,} in all"
        raise ApcError(
            Diagnostic("E933", SourceLocation(system.origin.topology), f"{option}: {what}", hint=hint)
        )
    return (dense_loop(groups, exchange),), False


def _port_loop(
    loop: ModalSystem, touched: Mapping[int, _Touched], *, together: bool, place: SourceLocation, option: str
) -> PortLoop:
    """Return the map of a loop whose devices are moved from outside.

    Parameters
    ----------
    loop
        The loop.
    touched
        What is held, by the schedule's id.
    together
        Whether a device of the loop stands for as many peers as its site counts.
    place, option
        The scene, and what asked for it, for a refusal.
    """
    held = [number for number, site in enumerate(loop.sites) if id(site.schedule) in touched]
    sites = [touched[id(loop.sites[number].schedule)] for number in held]
    counts = [loop.sites[number].count if together else 1 for number in held]
    lengths = [len(site.seconds) for site in sites]
    if (m := sum(lengths)) > MOST_INTERVALS:
        what = f"devices that differ are sampled and pushed over {m:,} intervals of a frame"
        hint = f"fewer peers that differ: {MOST_INTERVALS:,} intervals at most"
        raise ApcError(Diagnostic("E933", place, f"{option}: {what}", hint=hint))
    closed = close_loop(loop)
    pairs = [(closed.offsets[number], site.ports) for number, site in zip(held, sites, strict=True)]
    into = np.concatenate([start + ports.drawn[:, 0] for start, ports in pairs])
    out = np.concatenate([start + ports.read[:, 0] for start, ports in pairs])
    rest = np.delete(
        np.arange(len(closed.matrix)), [start + place for start, ports in pairs for place in ports.added]
    )
    if len(rest) > MOST_STATES:
        what = f"with devices clamped {len(rest):,} states move in a frame"
        hint = f"{MOST_STATES:,} at most: shorter delays, or fewer peers that differ"
        raise ApcError(Diagnostic("E933", place, f"{option}: {what}", hint=hint))
    # Of which site each interval is (m, k), and which came before it in a frame (m, m).
    whose = np.repeat(np.arange(len(sites)), lengths)
    of, sums = np.eye(len(sites))[whose], np.tril(whose[:, None] == whose, -1).astype(np.float64)
    seconds = np.array([float(second) for site in sites for second in site.seconds])
    starts = sums @ seconds
    whole, exact, multiply = with_radius(closed.matrix, closed.error), RADII.exact, RADII.multiply
    a, placed, felt = (
        whole[:, rows[:, None], columns] for rows, columns in ((rest, rest), (rest, into), (out, rest))
    )
    aside = _aside(a, placed, of)
    if aside is None:
        rigid = find_rigid_modes(loop).basis
        if rigid.size and not rigid[out].any():  # a motion that no device feels
            to = with_doubt(relative_coordinates(rigid[rest]))
            less = relative_rows(np.concatenate([a, placed], axis=-1), to, RADII)
            a, placed, felt = less[..., to.rest], less[..., len(rest) :], felt[..., to.rest]
            aside = _aside(a, placed, of)
    if aside is None:
        what = "with its devices clamped the scene has a motion that nothing holds back"
        hint = "couplers that hold each object to a device"
        raise ApcError(Diagnostic("E933", place, f"{option}: {what}", hint=hint))
    # A device is where it was as the frame began, and the intervals before have moved it since.
    at_once = whole[:, out[:, None], into]
    forces = RADII.add(multiply(felt, aside), multiply(at_once, exact(of)))
    first = np.argmax(of, axis=0)
    many, doubt = reciprocal(forces[:, first], counts)
    each = of @ many
    times = with_radius(np.diag(each), np.diag(of @ (many * doubt)))
    felt, at_once, forces = (multiply(times, values) for values in (felt, at_once, forces))
    static = forces[:, first]
    b = RADII.subtract(multiply(placed, exact(sums)), multiply(aside, exact(of.T)))
    pole = multiply(multiply(exact(of), static), exact(of.T))
    half = multiply(RADII.add(pole, np.swapaxes(pole, -1, -2)), exact(np.eye(m) / 4))
    dampings = np.array([float(site.damping) for site in sites])
    damping = np.diag(of @ dampings * each / seconds)
    units = exact(np.diag(np.sqrt(seconds / each)))
    weight = RADII.subtract(with_radius(damping, np.diag(of @ doubt + 8 * UNIT) * damping), half)
    return PortLoop(
        name=loop.name,
        multiplicity=loop.multiplicity,
        a=a,
        b=multiply(b, units),
        c=multiply(units, felt),
        d=multiply(multiply(units, multiply(at_once, exact(sums))), units),
        weight=multiply(multiply(units, weight), units),
        static=static,
        joined=bool((many == counts).all()),
        dampings=tuple(site.damping for site in sites),
        starts=starts,
        seconds=seconds,
        frame_s=closed.frame_s,
    )


def _aside(a: Matrix, placed: Matrix, of: Floats) -> Matrix | None:
    """Return where all else is while devices stand aside by 1, site by site; None where it can't be said."""
    still = RADII.subtract(RADII.exact(np.eye(a.shape[-1])), a)
    return solve(still, RADII.multiply(placed, RADII.exact(of)))


def reciprocal(static: Matrix, counts: Sequence[int]) -> tuple[Floats, Floats]:
    """Return what the energies of devices are to be multiplied by for their stiffness to be that of springs.

    And what each factor may be off by, relatively.

    Parameters
    ----------
    static
        What each kind of device is pushed back by as those of each stand aside (2, k, k), in N/m.
    counts
        How many peers have each, which is what to multiply by where that serves.

    Notes
    -----
    Hands that give back no more than they got, each by itself, do so whatever their energies are multiplied
    by. Where one device feels another more than that feels it, v_g K_gh = v_h K_hg leaves one choice.
    """
    value = value_of(static)
    felt = np.abs(value) > radius_of(static)
    doubts = radius_of(static) / np.abs(value)
    values, doubt = np.zeros((2, len(counts)))
    for start, count in enumerate(counts):
        if values[start]:
            continue
        values[start], waiting = count, [start]
        while waiting:
            g = waiting.pop()
            for h in np.flatnonzero(felt[g] & felt[:, g] & (values == 0)).tolist():
                ratio = value[g, h] / value[h, g]
                values[h] = values[g] * ratio if ratio > 0 else counts[h]
                # (1 + a)/(1 − b) − 1 of a quotient, and (1 + d)(1 + q) − 1 of a product.
                off = (doubts[g, h] + doubts[h, g]) / (1 - doubts[h, g]) + 8 * UNIT
                doubt[h] = (doubt[g] + off + doubt[g] * off) * (1 + 8 * UNIT) if ratio > 0 else 0.0
                waiting.append(h)
    even = values * counts[0] / values[0] / counts
    if np.abs(even - 1).max() <= EVEN:
        return np.array(counts, dtype=np.float64), np.zeros(len(counts))
    return values, doubt
