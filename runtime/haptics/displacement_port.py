"""Port maps: from displacements of devices, imposed by hands, to the forces on them, one map per mode.

Takes: a `NumericModel`.
Gives: `PortLoop`, `port_loops`; `reciprocal`.
Guarantees: exact for any motion of the hands: in an interval without samples and switches of forces, only the
displacement has an effect, and its minimum dissipation in the damper. Matrices have radii for rounding.
Does not: decide passivity (see `absolute_stability`).

In an interval of length τ a device moves by Δ against a constant force f and its damper b. The hand supplies
∫F v = ΔE + b ∫v² + f Δ, and ∫v² ≥ Δ²/τ, with equality for a constant velocity. The other states depend on Δ
only, so that the hand can extract unlimited energy if and only if Σ f Δ + b Δ²/τ is unbounded below. With the
map H from Δ to f this is a condition on He H(e^{jθ}) + diag(b/τ).

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

from apc.analysis.analysis import lifted_classes
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.devices import Device, coupled_directly, find_device, no_device
from apc.lifting.frame_inputs import FrameInputs, with_holds, with_ports
from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    error_radius,
    solve,
    value_of,
    with_error_radius,
)
from apc.lifting.numeric_model import NumericModel
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.spectrum.interconnection import ModalSystem, close_loop
from apc.spectrum.modes import accepted_loops
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import relative_coordinates, relative_rows, with_uncertainty
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import MATRIX_STATES
from apc.timing.schedule import HoldUpdate, Propagate, Schedule, SendEvent, Tick

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Graphs whose modes are orthogonal: the energy of all peers is the sum of the energies of the modes.
ORTHOGONAL = ("complete", "ring")

# The tolerance of reciprocal interaction between devices: far more than rounding.
EVEN = 1e-9

# The limit of intervals of all devices of a mode.
MOST_INTERVALS = 400


@dataclass(frozen=True, slots=True)
class _DeviceInput:
    """A class of peers with the displacement of its device as an input.

    `damping` is that of the device in N·s/m; `seconds` are the lengths of the device's intervals, `ports` the
    indices of inputs and readings in z.
    """

    peer_class: PeerClass
    damping: Fraction
    seconds: tuple[Fraction, ...]
    ports: FrameInputs


@dataclass(frozen=True, slots=True, eq=False)
class PortLoop:
    """A mode with hands at its devices: the map from displacements to forces, without its pole at 1.

    `a`, `b`, `c`, `d` (2, …) are over the states of the model with clamped devices; `weight` (2, m, m) is
    added to the Hermitian part: dampers, and the pole's part. Inputs and outputs are scaled: 1 added to the
    diagonal of `weight` is 1 N·s/m at each device. `static` (2, k, k) is the stiffness of the pole between
    the k types of devices, over all peers. `joined` states that the energies of all devices have equal
    weights, so that the result holds for joint hands. `dampings` are those of the devices in N·s/m; `seconds`
    (m,) are the lengths of the intervals, `starts` (m,) their beginnings in the frame.
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


def port_loops(numeric: NumericModel, *, option: str) -> tuple[PortLoop, ...]:
    """Return the modes of a model as maps from displacements of all devices to the forces on them.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    option
        The command-line option, for messages.

    Raises
    ------
    ApcError
        E931 no device, or none that can be separated; E933 too many intervals or states, or a rigid mode.
    NotSupportedError
        The reason why no device is ever passive.
    """
    model = numeric.model
    peer_classes, comm_graph = lifted_classes(numeric)
    location, unit_of = (
        SourceLocation(model.origin.topology),
        {parameter.name: parameter.unit for parameter in model.parameters},
    )
    received = {
        (receive.link, row)
        for peer_class in peer_classes
        for partition, tick in zip(peer_class.jacobians.peer_type.clocks, peer_class.exact.ticks, strict=True)
        for receive, column, rows in zip(partition.receives, tick.r.T, tick.channels, strict=True)
        if column.astype(np.bool_).any()
        for row in rows
    }
    direct = coupled_directly(model.peer_types)
    device_inputs: dict[int, _DeviceInput] = {}
    with_inputs: list[PeerClass] = []
    for peer_class in peer_classes:
        device = find_device(
            peer_class.jacobians, peer_class.parameters, unit_of, peer_class.initial_reception, direct=direct
        )
        if device is None:  # for example a server, without a hand
            with_inputs.append(peer_class)
            continue
        if isinstance(device, str):
            raise ApcError(Diagnostic("E931", location, f"{option}: {device}"))
        if reason := _velocity_use(peer_class, device, received):
            raise NotSupportedError(reason)
        if interaction := _unsupported_interaction(peer_class, device):
            why, advice = interaction
            raise ApcError(Diagnostic("E933", location, f"{option}: {why}", advice=advice))
        device_input = _with_device_input(peer_class, device)
        device_inputs[peer_class.index] = device_input
        with_inputs.append(device_input.peer_class)
    if not device_inputs:
        raise no_device(model, option)
    used = {
        received.coupling_term.link
        for peer_class in peer_classes
        for received in peer_class.schedule.received
    }
    is_orthogonal = all(comm_graph.links[link].graph.shape in ORTHOGONAL for link in used)
    loops, weighted = accepted_loops(with_inputs, comm_graph, lambda _: is_orthogonal, option)
    result = []
    for modal_system in loops:
        # A loop without devices is one of the model with its devices clamped.
        if any(peer_class.index in device_inputs for peer_class in modal_system.peer_classes):
            represents_all = weighted and len(modal_system.peer_classes) > 1
            result.append(
                _port_loop(
                    modal_system,
                    device_inputs,
                    represents_all=represents_all,
                    location=location,
                    option=option,
                )
            )
    return tuple(result)


def _velocity_use(peer_class: PeerClass, device: Device, received: Set[tuple[str, int]]) -> str:
    """Return the reason if a device's velocity is sampled or sent, "" otherwise.

    Only channels that some peer receives count.
    """
    peer_type = peer_class.jacobians.peer_type
    for partition, tick in zip(peer_type.clocks, peer_class.exact.ticks, strict=True):
        for row in np.flatnonzero(tick.x[:, device.velocity].astype(np.bool_)):
            name = partition.outputs[row % len(partition.outputs)]
            return (
                f"{name} samples the velocity of {device.part}; an arbitrarily small motion of the operator "
                "can cause any force"
            )
    for sending, send in zip(peer_type.sends, peer_class.exact.sends, strict=True):
        rows = np.flatnonzero(send.x[:, device.velocity].astype(np.bool_))
        if any((sending.link, row) in received for row in rows.tolist()):
            return f"the velocity of {device.part} is sent over {sending.link} as sampled"
    return ""


def _unsupported_interaction(peer_class: PeerClass, device: Device) -> tuple[str, str] | None:
    """Return a signal of a device other than samples and held forces, with advice on a replacement.

    The result is None without such a signal.
    """
    a, device_states = peer_class.exact.a, [device.position, device.velocity]
    others = [index for index in range(len(a)) if index not in device_states]
    coupled = a[np.ix_(others, device_states)].astype(np.bool_) | a[np.ix_(device_states, others)].T.astype(
        np.bool_
    )
    if coupled.any():
        name = peer_class.jacobians.peer_type.states[others[int(np.flatnonzero(coupled.any(axis=1))[0])]].name
        return (
            f"{device.part} is coupled to {name} in continuous time",
            "use a coupler with sample and hold, such as SampledSpringDamper",
        )
    if a[device.velocity, device.position] > 0 or a[device.velocity, device.velocity] > 0:
        return f"a spring or damper of {device.part} to the ground is negative", "use values of 0 or more"
    return None


def _with_device_input(peer_class: PeerClass, device: Device) -> _DeviceInput:
    """Return a class of peers with the displacement of its device as an input."""
    schedule = peer_class.schedule
    instants = _interval_starts(peer_class.exact, schedule, device)
    with_position_input, readings = [], []
    for linear_subsystem, inverse in (
        (peer_class.subsystem, float(device.inverse)),
        (peer_class.exact, device.inverse),
    ):
        with_position_input.append(_without_device_states(linear_subsystem, device))
        reading = np.zeros((1, sum(with_position_input[-1].b.shape)), dtype=linear_subsystem.b.dtype)
        reading[0, len(with_position_input[-1].a) : -1] = -linear_subsystem.b[device.velocity] / inverse
        readings.append(reading)
    (subsystem, exact), full, ports = with_ports(
        with_position_input, schedule, 1, instants, readings, instants
    )
    seconds = tuple(end * schedule.quantum for end in np.diff([*instants, schedule.frame]).tolist())
    damping = -peer_class.exact.a[device.velocity, device.velocity] / device.inverse
    return _DeviceInput(peer_class.with_subsystem(subsystem, exact, full), damping, seconds, ports)


def _interval_starts(subsystem: LinearSubsystem, schedule: Schedule, device: Device) -> list[int]:
    """Return the instants, in quanta, at which a device is sampled or a force on it switches, and 0."""
    instants, now, affects_device = {0}, 0, False
    for event in schedule.events:
        match event:
            case Propagate(duration):
                now += duration
            case Tick(partition, _, _):
                affects_device = bool(subsystem.ticks[partition].x[:, device.position].astype(np.bool_).any())
            case SendEvent(partition, _):
                affects_device = bool(subsystem.sends[partition].x[:, device.position].astype(np.bool_).any())
            case HoldUpdate(hold, _):
                affects_device = bool(subsystem.b[device.velocity, hold])
        if not isinstance(event, Propagate) and affects_device and now < schedule.frame:
            instants.add(now)
    return sorted(instants)


def _without_device_states(subsystem: LinearSubsystem, device: Device) -> LinearSubsystem:
    """Return a subsystem without its device's states; an additional, last hold is the device's position."""
    other_states = np.delete(np.arange(len(subsystem.a)), [device.position, device.velocity])
    reduced = replace(
        subsystem,
        peer_type=replace(
            subsystem.peer_type, states=tuple(subsystem.peer_type.states[index] for index in other_states)
        ),
        a=subsystem.a[np.ix_(other_states, other_states)],
        b=subsystem.b[other_states],
        ticks=tuple(replace(tick, x=tick.x[:, other_states]) for tick in subsystem.ticks),
        sends=tuple(replace(send, x=send.x[:, other_states]) for send in subsystem.sends),
    )
    linear_subsystem = with_holds(reduced, np.zeros((len(other_states), 1), dtype=subsystem.b.dtype))
    for tick, full_tick in zip(linear_subsystem.ticks, subsystem.ticks, strict=True):
        tick.u[:, -1] = full_tick.x[:, device.position]
    for send, full_send in zip(linear_subsystem.sends, subsystem.sends, strict=True):
        send.u[:, -1] = full_send.x[:, device.position]
    return linear_subsystem


def _port_loop(
    modal_system: ModalSystem,
    device_inputs: Mapping[int, _DeviceInput],
    *,
    represents_all: bool,
    location: SourceLocation,
    option: str,
) -> PortLoop:
    """Return the map of a loop from displacements of its devices to the forces on them.

    Parameters
    ----------
    modal_system
        The loop.
    device_inputs
        The device inputs, by the index of the class.
    represents_all
        Whether a device of the loop represents all peers of its subsystem's count.
    location, option
        The location and the command-line option, for messages.
    """
    gripped = [
        number
        for number, peer_class in enumerate(modal_system.peer_classes)
        if peer_class.index in device_inputs
    ]
    subsystems = [device_inputs[modal_system.peer_classes[number].index] for number in gripped]
    counts = [modal_system.peer_classes[number].count if represents_all else 1 for number in gripped]
    lengths = [len(subsystem.seconds) for subsystem in subsystems]
    if (m := sum(lengths)) > MOST_INTERVALS:
        message = f"different devices have {m:,} intervals of sampling and force in a frame"
        advice = f"reduce the number of different peers (limit: {MOST_INTERVALS:,} intervals)"
        raise ApcError(Diagnostic("E933", location, f"{option}: {message}", advice=advice))
    closed = close_loop(modal_system)
    pairs = [
        (closed.offsets[number], subsystem.ports)
        for number, subsystem in zip(gripped, subsystems, strict=True)
    ]
    input_indices = np.concatenate([start + ports.input_slots[:, 0] for start, ports in pairs])
    output_indices = np.concatenate([start + ports.read[:, 0] for start, ports in pairs])
    rest = np.delete(
        np.arange(len(closed.matrix)),
        [start + index for start, ports in pairs for index in ports.added],
    )
    if len(rest) > MATRIX_STATES:
        message = f"with devices clamped {len(rest):,} states remain in a frame"
        advice = f"use shorter delays or fewer different peers (limit: {MATRIX_STATES:,} states)"
        raise ApcError(Diagnostic("E933", location, f"{option}: {message}", advice=advice))
    # The subsystem of each interval (m, k), and the intervals before it in a frame (m, m).
    owners = np.repeat(np.arange(len(subsystems)), lengths)
    incidence, sums = (
        np.eye(len(subsystems))[owners],
        np.tril(owners[:, None] == owners, -1).astype(np.float64),
    )
    seconds = np.array([float(second) for subsystem in subsystems for second in subsystem.seconds])
    starts = sums @ seconds
    closed_matrix, exact, multiply = (
        with_error_radius(closed.matrix, closed.error),
        MIDPOINT_RADIUS.exact,
        MIDPOINT_RADIUS.multiply,
    )
    a, input_matrix, output_matrix = (
        closed_matrix[:, rows[:, None], columns]
        for rows, columns in ((rest, rest), (rest, input_indices), (output_indices, rest))
    )
    static_states = _static_response(a, input_matrix, incidence)
    if static_states is None:
        rigid = find_rigid_modes(modal_system).basis
        if rigid.size and not rigid[output_indices].any():  # a rigid mode without an effect on devices
            coordinates = with_uncertainty(relative_coordinates(rigid[rest]))
            reduced_rows = relative_rows(
                np.concatenate([a, input_matrix], axis=-1), coordinates, MIDPOINT_RADIUS
            )
            a, input_matrix, output_matrix = (
                reduced_rows[..., coordinates.rest],
                reduced_rows[..., len(rest) :],
                output_matrix[..., coordinates.rest],
            )
            static_states = _static_response(a, input_matrix, incidence)
    if static_states is None:
        message = "with clamped devices the topology has an unconstrained motion"
        advice = "couple each object to a device"
        raise ApcError(Diagnostic("E933", location, f"{option}: {message}", advice=advice))
    # The position of a device is that at the start of the frame plus the displacements of earlier intervals.
    feedthrough = closed_matrix[:, output_indices[:, None], input_indices]
    forces = MIDPOINT_RADIUS.add(
        multiply(output_matrix, static_states), multiply(feedthrough, exact(incidence))
    )
    first = np.argmax(incidence, axis=0)
    energy_weights, uncertainty = reciprocal(forces[:, first], counts)
    interval_weights = incidence @ energy_weights
    weighting = with_error_radius(
        np.diag(interval_weights), np.diag(incidence @ (energy_weights * uncertainty))
    )
    output_matrix, feedthrough, forces = (
        multiply(weighting, values) for values in (output_matrix, feedthrough, forces)
    )
    static = forces[:, first]
    b = MIDPOINT_RADIUS.subtract(
        multiply(input_matrix, exact(sums)), multiply(static_states, exact(incidence.T))
    )
    pole = multiply(multiply(exact(incidence), static), exact(incidence.T))
    half = multiply(MIDPOINT_RADIUS.add(pole, np.swapaxes(pole, -1, -2)), exact(np.eye(m) / 4))
    dampings = np.array([float(subsystem.damping) for subsystem in subsystems])
    damping = np.diag(incidence @ dampings * interval_weights / seconds)
    units = exact(np.diag(np.sqrt(seconds / interval_weights)))
    weight = MIDPOINT_RADIUS.subtract(
        with_error_radius(damping, np.diag(incidence @ uncertainty + 8 * UNIT_ROUNDOFF) * damping), half
    )
    return PortLoop(
        name=modal_system.name,
        multiplicity=modal_system.multiplicity,
        a=a,
        b=multiply(b, units),
        c=multiply(units, output_matrix),
        d=multiply(multiply(units, multiply(feedthrough, exact(sums))), units),
        weight=multiply(multiply(units, weight), units),
        static=static,
        joined=bool((energy_weights == counts).all()),
        dampings=tuple(subsystem.damping for subsystem in subsystems),
        starts=starts,
        seconds=seconds,
        frame_s=closed.frame_s,
    )


def _static_response(a: Matrix, input_matrix: Matrix, incidence: Floats) -> Matrix | None:
    """Return the other states for a constant displacement of devices by 1, None if undetermined."""
    resolvent_inverse = MIDPOINT_RADIUS.subtract(MIDPOINT_RADIUS.exact(np.eye(a.shape[-1])), a)
    return solve(resolvent_inverse, MIDPOINT_RADIUS.multiply(input_matrix, MIDPOINT_RADIUS.exact(incidence)))


def reciprocal(static: Matrix, counts: Sequence[int]) -> tuple[Floats, Floats]:
    """Return energy weights of devices that make the stiffness matrix symmetric, and their relative errors.

    Parameters
    ----------
    static
        The force on each type of device for a displacement of each type by 1 (2, k, k), in N/m.
    counts
        The number of peers of each type, the weight if these numbers suffice.

    Notes
    -----
    Separate passive hands stay passive for any positive weights of their energies. Without reciprocity, v_g
    K_gh = v_h K_hg determines the weights.
    """
    value = value_of(static)
    nonzero = np.abs(value) > error_radius(static)
    weight_errors = error_radius(static) / np.abs(value)
    values, relative_errors = np.zeros((2, len(counts)))
    for start, count in enumerate(counts):
        if values[start]:
            continue
        values[start], pending = count, [start]
        while pending:
            g = pending.pop()
            for h in np.flatnonzero(nonzero[g] & nonzero[:, g] & (values == 0)).tolist():
                ratio = value[g, h] / value[h, g]
                values[h] = values[g] * ratio if ratio > 0 else counts[h]
                # (1 + a)/(1 − b) − 1 of a quotient, and (1 + d)(1 + q) − 1 of a product.
                error_bound = (weight_errors[g, h] + weight_errors[h, g]) / (
                    1 - weight_errors[h, g]
                ) + 8 * UNIT_ROUNDOFF
                relative_errors[h] = (
                    (relative_errors[g] + error_bound + relative_errors[g] * error_bound)
                    * (1 + 8 * UNIT_ROUNDOFF)
                    if ratio > 0
                    else 0.0
                )
                pending.append(h)
    relative_weights = values * counts[0] / values[0] / counts
    if np.abs(relative_weights - 1).max() <= EVEN:
        return np.array(counts, dtype=np.float64), np.zeros(len(counts))
    return values, relative_errors
