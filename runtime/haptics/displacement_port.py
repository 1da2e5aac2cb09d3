"""Port maps: from displacements of devices, imposed by hands, to the forces on them, one map per mode.

Takes: a `Model`.
Gives: `PortLoop`, `port_loops`; `reciprocal`.
Guarantees: exact for any motion of the hands: in an interval without samples and force switches, only the
displacement matters, and the minimum dissipation of the damping for it. Matrices have radii for their
rounding.
Does not: decide passivity (see `absolute_stability`).

Between two instants, τ apart, a device moves by Δ against a constant force f and its damper b. The hand
supplies ∫F v = ΔE + b ∫v² + f Δ, and ∫v² ≥ Δ²/τ, with equality for a constant velocity. The rest of the
system depends on the Δ alone, so the hand can extract unlimited energy if and only if Σ f Δ + b Δ²/τ is
unbounded below. With the map H from Δ to f this is a condition on He H(e^{jθ}) + diag(b/τ).

A constant displacement of devices by 1 causes the constant force K: H has the pole K/(z − 1), whose Hermitian
part on the circle is −K/2 for all θ. The pole is removed, with the motion of all other states under a
constant displacement; the remainder has exactly the modes of the model with clamped devices.
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
from apc.eigen.interconnection import ModalSystem, close_loop
from apc.eigen.modes import decompose, dense_loop
from apc.eigen.peer_classes import MOST_STATES, PeerClass, states_of
from apc.eigen.relative_coordinates import relative_coordinates, relative_rows, with_uncertainty
from apc.eigen.rigid_modes import find_rigid_modes
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.devices import Device, coupled_directly, find_device, no_device
from apc.frame.frame_inputs import FrameInputs, with_holds, with_ports
from apc.frame.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    error_radius,
    solve,
    value_of,
    with_error_radius,
)
from apc.frame.linear_subsystem import LinearSubsystem
from apc.frame.numeric_model import Prepared
from apc.frame.schedule import HoldUpdate, Propagate, Schedule, SendEvent, Tick
from apc.not_supported import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Graphs whose modes are orthogonal: the energy of all peers is the sum of the energies of the modes.
ORTHOGONAL = ("complete", "ring")

# The tolerance of reciprocal interaction between devices: far more than rounding.
EVEN = 1e-9

# The limit of intervals of all devices of a mode.
MOST_INTERVALS = 400


@dataclass(frozen=True, slots=True)
class _Touched:
    """A peer group with its device as an input: the group with inputs and readings, its device's damping.

    The damping is in N·s/m; `seconds` are the lengths of the device's intervals, `ports` the indices of
    inputs and readings in z.
    """

    group: PeerClass
    damping: Fraction
    seconds: tuple[Fraction, ...]
    ports: FrameInputs


@dataclass(frozen=True, slots=True, eq=False)
class PortLoop:
    """A mode of devices with hands: a map from displacements to forces, without its pole at 1.

    `a`, `b`, `c`, `d` (2, …) are over the states of the model with clamped devices; `weight` (2, m, m) is
    added to the Hermitian part: dampers, and the pole's part. Inputs and outputs are scaled: 1 more on the
    diagonal of `weight` is 1 N·s/m more at each device. `static` (2, k, k) is the stiffness of the pole
    between the k types of devices, of all peers together. `joined` states that the energies of all devices
    have equal weights, so that hands may be joint. `dampings` are the devices' in N·s/m; `seconds` (m,) are
    the lengths of the intervals, `starts` (m,) their beginnings in the frame.
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
    """Return the modes of a model in which hands impose the motion of all devices.

    Parameters
    ----------
    system, prepared
        The compiled model, and the result of `numeric_model.prepare` for it.
    option
        The option that requested it.

    Raises
    ------
    ApcError
        E931 no device, or none that can be separated; E933 too many intervals or states, or a rigid mode.
    NotSupportedError
        The reason why no device is ever passive.
    """
    groups, exchange = lifted_groups(system, prepared=prepared)
    location, unit_of = (
        SourceLocation(system.origin.topology),
        {parameter.name: parameter.unit for parameter in system.parameters},
    )
    received = {
        (receive.link, row)
        for group in groups
        for partition, tick in zip(group.jacobians.peer_type.clocks, group.exact.ticks, strict=True)
        for receive, column, rows in zip(partition.receives, tick.r.T, tick.channels, strict=True)
        if column.astype(np.bool_).any()
        for row in rows
    }
    direct = coupled_directly(system.peer_types)
    touched: dict[int, _Touched] = {}
    ported: list[PeerClass] = []
    for group in groups:
        device = find_device(
            group.jacobians, group.parameters, unit_of, group.initial_reception, direct=direct
        )
        if device is None:  # a server, say: it is not held
            ported.append(group)
            continue
        if isinstance(device, str):
            raise ApcError(Diagnostic("E931", location, f"{option}: {device}"))
        if used := _used_velocity(group, device, received):
            raise NotSupportedError(used)
        if touch := _other_touch(group, device):
            why, hint = touch
            raise ApcError(Diagnostic("E933", location, f"{option}: {why}", hint=hint))
        local = _touched(group, device)
        touched[id(local.group.schedule)] = local
        ported.append(local.group)
    if not touched:
        raise no_device(system, option)
    loops, weighted = _loops(system, ported, exchange, option=option)
    result = []
    for loop in loops:
        # A loop without devices is one of the model with its devices clamped.
        if any(id(subsystem.schedule) in touched for subsystem in loop.subsystems):
            together = weighted and len(loop.subsystems) > 1
            result.append(_port_loop(loop, touched, together=together, location=location, option=option))
    return tuple(result)


def _used_velocity(group: PeerClass, device: Device, received: Set[tuple[str, int]]) -> str:
    """Return the cause of samples of a device's velocity, "" if none; of sends, received channels count."""
    peer_type = group.jacobians.peer_type
    for partition, tick in zip(peer_type.clocks, group.exact.ticks, strict=True):
        for row in np.flatnonzero(tick.x[:, device.velocity].astype(np.bool_)):
            name = partition.outputs[row % len(partition.outputs)]
            return (
                f"{name} samples the velocity of {device.part}, and a hand that moves it just then, and "
                "hardly at all, gets any force for nothing"
            )
    for sending, send in zip(peer_type.sends, group.exact.sends, strict=True):
        rows = np.flatnonzero(send.x[:, device.velocity].astype(np.bool_))
        if any((sending.link, row) in received for row in rows.tolist()):
            return f"the velocity of {device.part} is sent over {sending.link} as sampled"
    return ""


def _other_touch(group: PeerClass, device: Device) -> tuple[str, str] | None:
    """Return the signals of a device other than samples and held forces, with a replacement."""
    a, local = group.exact.a, [device.position, device.velocity]
    others = [index for index in range(len(a)) if index not in local]
    both = a[np.ix_(others, local)].astype(np.bool_) | a[np.ix_(local, others)].T.astype(np.bool_)
    if both.any():
        name = group.jacobians.peer_type.states[others[int(np.flatnonzero(both.any(axis=1))[0])]].name
        return (
            f"{device.part} and what {name} is of act on one another at every moment",
            "a coupler that acts by sample and hold, as SampledSpringDamper",
        )
    if a[device.velocity, device.position] > 0 or a[device.velocity, device.velocity] > 0:
        return f"a spring or damper of {device.part} to the ground is negative", "values of 0 or more"
    return None


def _touched(group: PeerClass, device: Device) -> _Touched:
    """Return a group with the motion of its device as an input."""
    schedule = group.schedule
    at = _boundaries(group.exact, schedule, device)
    driven, readings = [], []
    for linear_subsystem, inverse in (
        (group.subsystem, float(device.inverse)),
        (group.exact, device.inverse),
    ):
        driven.append(_driven(linear_subsystem, device))
        reading = np.zeros((1, sum(driven[-1].b.shape)), dtype=linear_subsystem.b.dtype)
        reading[0, len(driven[-1].a) : -1] = -linear_subsystem.b[device.velocity] / inverse
        readings.append(reading)
    (subsystem, exact), full, ports = with_ports(driven, schedule, 1, at, readings, at)
    seconds = tuple(end * schedule.quantum for end in np.diff([*at, schedule.frame]).tolist())
    damping = -group.exact.a[device.velocity, device.velocity] / device.inverse
    return _Touched(group.with_subsystem(subsystem, exact, full), damping, seconds, ports)


def _boundaries(subsystem: LinearSubsystem, schedule: Schedule, device: Device) -> list[int]:
    """Return the instants, in quanta, at which a device is sampled or a force on it switches, and 0."""
    numbers, now, counts = {0}, 0, False
    for event in schedule.events:
        match event:
            case Propagate(duration):
                now += duration
            case Tick(partition, _, _):
                counts = bool(subsystem.ticks[partition].x[:, device.position].astype(np.bool_).any())
            case SendEvent(partition, _):
                counts = bool(subsystem.sends[partition].x[:, device.position].astype(np.bool_).any())
            case HoldUpdate(hold, _):
                counts = bool(subsystem.b[device.velocity, hold])
        if not isinstance(event, Propagate) and counts and now < schedule.frame:
            numbers.add(now)
    return sorted(numbers)


def _driven(subsystem: LinearSubsystem, device: Device) -> LinearSubsystem:
    """Return a subsystem without a device's states: a hold, the last, gives the position of the device."""
    stored = np.delete(np.arange(len(subsystem.a)), [device.position, device.velocity])
    smaller = replace(
        subsystem,
        peer_type=replace(
            subsystem.peer_type, states=tuple(subsystem.peer_type.states[index] for index in stored)
        ),
        a=subsystem.a[np.ix_(stored, stored)],
        b=subsystem.b[stored],
        ticks=tuple(replace(tick, x=tick.x[:, stored]) for tick in subsystem.ticks),
        sends=tuple(replace(send, x=send.x[:, stored]) for send in subsystem.sends),
    )
    linear_subsystem = with_holds(smaller, np.zeros((len(stored), 1), dtype=subsystem.b.dtype))
    for tick, whole in zip(linear_subsystem.ticks, subsystem.ticks, strict=True):
        tick.u[:, -1] = whole.x[:, device.position]
    for send, sent in zip(linear_subsystem.sends, subsystem.sends, strict=True):
        send.u[:, -1] = sent.x[:, device.position]
    return linear_subsystem


def _loops(
    system: Model, groups: Sequence[PeerClass], exchange: CommunicationGraph, *, option: str
) -> tuple[tuple[ModalSystem, ...], bool]:
    """Return loops that exchange no energy, and whether a subsystem represents all peers of its count."""
    used = {received.coupling_term.link for group in groups for received in group.schedule.received}
    if all(exchange.links[link].graph.shape in ORTHOGONAL for link in used):
        decomposed = decompose(groups, exchange)
        if decomposed.method == "modes":
            return decomposed.loops, True
    states = sum(group.count * states_of(group.schedule, group.jacobians) for group in groups)
    if states > MOST_STATES:
        message = (
            f"{exchange.peers:,} peers on such a graph make one system of {states:,} states and intervals"
        )
        hint = f"equal peers on complete graphs or rings, or {MOST_STATES:,} in all"
        raise ApcError(
            Diagnostic("E933", SourceLocation(system.origin.topology), f"{option}: {message}", hint=hint)
        )
    return (dense_loop(groups, exchange),), False


def _port_loop(
    loop: ModalSystem,
    touched: Mapping[int, _Touched],
    *,
    together: bool,
    location: SourceLocation,
    option: str,
) -> PortLoop:
    """Return the map of a loop with the motion of its devices as inputs.

    Parameters
    ----------
    loop
        The loop.
    touched
        The devices, by the schedule's id.
    together
        Whether a device of the loop represents all peers of its subsystem's count.
    location, option
        The topology, and the option that requested it, for errors.
    """
    gripped = [
        number for number, subsystem in enumerate(loop.subsystems) if id(subsystem.schedule) in touched
    ]
    subsystems = [touched[id(loop.subsystems[number].schedule)] for number in gripped]
    counts = [loop.subsystems[number].count if together else 1 for number in gripped]
    lengths = [len(subsystem.seconds) for subsystem in subsystems]
    if (m := sum(lengths)) > MOST_INTERVALS:
        message = f"devices that differ are sampled and pushed over {m:,} intervals of a frame"
        hint = f"fewer peers that differ: {MOST_INTERVALS:,} intervals at most"
        raise ApcError(Diagnostic("E933", location, f"{option}: {message}", hint=hint))
    closed = close_loop(loop)
    pairs = [
        (closed.offsets[number], subsystem.ports)
        for number, subsystem in zip(gripped, subsystems, strict=True)
    ]
    into = np.concatenate([start + ports.input_slots[:, 0] for start, ports in pairs])
    out = np.concatenate([start + ports.read[:, 0] for start, ports in pairs])
    rest = np.delete(
        np.arange(len(closed.matrix)),
        [start + location for start, ports in pairs for location in ports.added],
    )
    if len(rest) > MOST_STATES:
        message = f"with devices clamped {len(rest):,} states move in a frame"
        hint = f"{MOST_STATES:,} at most: shorter delays, or fewer peers that differ"
        raise ApcError(Diagnostic("E933", location, f"{option}: {message}", hint=hint))
    # The subsystem of each interval (m, k), and the intervals before it in a frame (m, m).
    whose = np.repeat(np.arange(len(subsystems)), lengths)
    of, sums = np.eye(len(subsystems))[whose], np.tril(whose[:, None] == whose, -1).astype(np.float64)
    seconds = np.array([float(second) for subsystem in subsystems for second in subsystem.seconds])
    starts = sums @ seconds
    whole, exact, multiply = (
        with_error_radius(closed.matrix, closed.error),
        MIDPOINT_RADIUS.exact,
        MIDPOINT_RADIUS.multiply,
    )
    a, placed, used = (
        whole[:, rows[:, None], columns] for rows, columns in ((rest, rest), (rest, into), (out, rest))
    )
    aside = _aside(a, placed, of)
    if aside is None:
        rigid = find_rigid_modes(loop).basis
        if rigid.size and not rigid[out].any():  # a mode without effect on devices
            to = with_uncertainty(relative_coordinates(rigid[rest]))
            less = relative_rows(np.concatenate([a, placed], axis=-1), to, MIDPOINT_RADIUS)
            a, placed, used = less[..., to.rest], less[..., len(rest) :], used[..., to.rest]
            aside = _aside(a, placed, of)
    if aside is None:
        message = "with its devices clamped the topology has a motion that nothing holds back"
        hint = "couplers that hold each object to a device"
        raise ApcError(Diagnostic("E933", location, f"{option}: {message}", hint=hint))
    # The position of a device is that at the start of the frame, moved by the intervals before.
    at_once = whole[:, out[:, None], into]
    forces = MIDPOINT_RADIUS.add(multiply(used, aside), multiply(at_once, exact(of)))
    first = np.argmax(of, axis=0)
    many, uncertainty = reciprocal(forces[:, first], counts)
    each = of @ many
    times = with_error_radius(np.diag(each), np.diag(of @ (many * uncertainty)))
    used, at_once, forces = (multiply(times, values) for values in (used, at_once, forces))
    static = forces[:, first]
    b = MIDPOINT_RADIUS.subtract(multiply(placed, exact(sums)), multiply(aside, exact(of.T)))
    pole = multiply(multiply(exact(of), static), exact(of.T))
    half = multiply(MIDPOINT_RADIUS.add(pole, np.swapaxes(pole, -1, -2)), exact(np.eye(m) / 4))
    dampings = np.array([float(subsystem.damping) for subsystem in subsystems])
    damping = np.diag(of @ dampings * each / seconds)
    units = exact(np.diag(np.sqrt(seconds / each)))
    weight = MIDPOINT_RADIUS.subtract(
        with_error_radius(damping, np.diag(of @ uncertainty + 8 * UNIT_ROUNDOFF) * damping), half
    )
    return PortLoop(
        name=loop.name,
        multiplicity=loop.multiplicity,
        a=a,
        b=multiply(b, units),
        c=multiply(units, used),
        d=multiply(multiply(units, multiply(at_once, exact(sums))), units),
        weight=multiply(multiply(units, weight), units),
        static=static,
        joined=bool((many == counts).all()),
        dampings=tuple(subsystem.damping for subsystem in subsystems),
        starts=starts,
        seconds=seconds,
        frame_s=closed.frame_s,
    )


def _aside(a: Matrix, placed: Matrix, of: Floats) -> Matrix | None:
    """Return the other states under a constant displacement of devices by 1, None if undetermined."""
    still = MIDPOINT_RADIUS.subtract(MIDPOINT_RADIUS.exact(np.eye(a.shape[-1])), a)
    return solve(still, MIDPOINT_RADIUS.multiply(placed, MIDPOINT_RADIUS.exact(of)))


def reciprocal(static: Matrix, counts: Sequence[int]) -> tuple[Floats, Floats]:
    """Return energy weights of devices for which the stiffness matrix is symmetric.

    Also the relative error bound of each weight.

    Parameters
    ----------
    static
        The force on each type of device for a displacement of each type by 1 (2, k, k), in N/m.
    counts
        The number of peers of each type, which is the weight where that suffices.

    Notes
    -----
    Separate passive hands stay passive for any positive weights of their energies. Without reciprocity, v_g
    K_gh = v_h K_hg determines the weights.
    """
    value = value_of(static)
    used = np.abs(value) > error_radius(static)
    weight_errors = error_radius(static) / np.abs(value)
    values, uncertainty = np.zeros((2, len(counts)))
    for start, count in enumerate(counts):
        if values[start]:
            continue
        values[start], waiting = count, [start]
        while waiting:
            g = waiting.pop()
            for h in np.flatnonzero(used[g] & used[:, g] & (values == 0)).tolist():
                ratio = value[g, h] / value[h, g]
                values[h] = values[g] * ratio if ratio > 0 else counts[h]
                # (1 + a)/(1 − b) − 1 of a quotient, and (1 + d)(1 + q) − 1 of a product.
                error_bound = (weight_errors[g, h] + weight_errors[h, g]) / (
                    1 - weight_errors[h, g]
                ) + 8 * UNIT_ROUNDOFF
                uncertainty[h] = (
                    (uncertainty[g] + error_bound + uncertainty[g] * error_bound) * (1 + 8 * UNIT_ROUNDOFF)
                    if ratio > 0
                    else 0.0
                )
                waiting.append(h)
    even = values * counts[0] / values[0] / counts
    if np.abs(even - 1).max() <= EVEN:
        return np.array(counts, dtype=np.float64), np.zeros(len(counts))
    return values, uncertainty
