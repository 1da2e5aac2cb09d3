"""The error between object copies under random hand forces, over the nominal or lossy network.

Takes: a mean-square stable model, and its second-moment operator.
Gives: `Forced`, `forced`, `PeerReadings`; `moments_error`, `largest_error`.
Guarantees: the peers' dynamics are unchanged except for the added forces. Positions are those at the start of
the model's frame, independent of the frame start used for lifting.
Does not: decide stability (see `mean_square_stability`); bound rounding.

Every device has an independent force input of variance 1 N², new at each tick of the fastest clock. The error
of a copy is its position minus the mean of the others', at the start of frames. The forces add to the second
moments in each frame; the result is the stationary solution of the moment recursion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerType
from apc.compiler.peer_counts import clocks_in_use
from apc.lifting.devices import Device, coupled_directly, find_device
from apc.lifting.frame_inputs import with_holds, with_ports
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.mean_square.class_moments import Moments, PerTickReception, instants
from apc.mean_square.second_moment_operator import stationary_moments
from apc.spectrum.modes import dense_loop
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import Relative
from apc.support.not_supported import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Tolerance for the motion of copies in a neutral mode: modes of rational weights are rounded.
NEUTRAL = 1e-9

# A copy is named by the link and channel that send its position.
Copy = tuple[str, str]


@dataclass(frozen=True, slots=True)
class PeerReadings:
    """A peer's readings in z: `input_slots` are forces in N at the start of a frame, `copies` positions
    in m.
    """

    input_slots: range
    copies: Mapping[Copy, int]


@dataclass(frozen=True, slots=True)
class Forced:
    """The peers of a model with force inputs; `peers` are the measured rows of z by class."""

    reception: PerTickReception
    peers: Mapping[int, PeerReadings]

    def of(self, peer_classes: Sequence[PeerClass]) -> list[tuple[int, PeerReadings]]:
        """Return the number of peers of each class, and the class's readings."""
        return [(peer_class.count, self.peers[peer_class.index]) for peer_class in peer_classes]

    def peer_by_peer(self) -> list[tuple[int, PeerReadings]]:
        """Return the readings of each peer, in the order of peers."""
        return self.of(dense_loop(self.reception.peer_classes, self.reception.comm_graph).peer_classes)


def forced(model: Model, reception: PerTickReception, first: Fraction = Fraction(0)) -> Forced:
    """Return the peers with an independent force of variance 1 N² at each hand-held device.

    Parameters
    ----------
    model
        The model.
    reception
        The peers of the model.
    first
        The start of the frames, in seconds.

    Raises
    ------
    NotSupportedError
        The hand-held devices are ambiguous.
    """
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    direct = coupled_directly(model.peer_types)
    used_clocks = clocks_in_use(model)
    fastest = min(
        (clock for clock in model.clocks if clock.name in used_clocks),
        key=lambda clock: reception.timings[clock.period],
    )
    ticks = instants(reception, fastest)
    peer_classes: list[PeerClass] = []
    peers: dict[int, PeerReadings] = {}
    for peer_class in reception.peer_classes:
        device = find_device(
            peer_class.jacobians, peer_class.parameters, unit_of, peer_class.initial_reception, direct=direct
        )
        if isinstance(device, str):
            raise NotSupportedError(device)
        forced_class, peers[peer_class.index] = _forced(peer_class, device, ticks, -first % reception.frame)
        peer_classes.append(forced_class)
    if not any(peer.input_slots for peer in peers.values()):
        raise NotSupportedError("no peer has a device besides its object copies")
    return Forced(replace(reception, peer_classes=tuple(peer_classes)), peers)


def _forced(
    peer_class: PeerClass, device: Device | None, ticks: Sequence[Fraction], start: Fraction
) -> tuple[PeerClass, PeerReadings]:
    """Return a peer class with a force input at its device, new values at each frame, and readings of the
    positions of its copies.

    Parameters
    ----------
    peer_class
        The peers.
    device
        The hand-held device, None without one.
    ticks
        The instants at which forces change, in seconds within a frame.
    start
        The instant of the positions, in seconds within a frame.
    """
    peer_type, schedule = peer_class.jacobians.peer_type, peer_class.schedule
    copies = [
        (sending.link, name)
        for sending in peer_type.sends
        for name, unit in zip(sending.channels, sending.units, strict=True)
        if unit == "m"
    ]
    subsystems, readings = [], []
    for subsystem in (peer_class.subsystem, peer_class.exact):
        force_column = np.zeros((len(subsystem.a), 1), dtype=subsystem.a.dtype)
        if device is not None:
            force_column[device.velocity] += (
                device.inverse if subsystem.a.dtype == object else float(device.inverse)
            )
        subsystems.append(with_holds(subsystem, force_column))
        readings.append(_positions(subsystems[-1], peer_type))
    force_instants = [int(time / schedule.quantum) for time in ticks] if device is not None else []
    reading_instant = int(start / schedule.quantum)
    (subsystem, exact), extended_schedule, ports = with_ports(
        subsystems, schedule, 1, force_instants, readings, [reading_instant]
    )
    input_slots = ports.input_slots.ravel().tolist()
    peer = PeerReadings(
        input_slots=range(input_slots[0], input_slots[-1] + 1) if input_slots else range(0),
        copies=dict(zip(copies, ports.read[0].tolist(), strict=True)),
    )
    return peer_class.with_subsystem(subsystem, exact, extended_schedule), peer


def _positions(subsystem: LinearSubsystem, peer_type: PeerType) -> Matrix:
    """Return the dependence of sent positions on states and holds (positions, n_x + n_u)."""
    rows = [
        np.concatenate([send.x[index], send.u[index]])
        for send, sending in zip(subsystem.sends, peer_type.sends, strict=True)
        for index, unit in enumerate(sending.units)
        if unit == "m"
    ]
    return np.array(rows, dtype=subsystem.b.dtype).reshape(len(rows), sum(subsystem.b.shape))


def moments_error(peer_moments: Moments, classes: Sequence[tuple[int, PeerReadings]]) -> float:
    """Return the largest copy error in m.

    Parameters
    ----------
    peer_moments
        The second-moment operator of peers with force inputs.
    classes
        The number of peers of each class, and their readings.
    """
    inputs = []
    for block_coordinates, n in zip(peer_moments.moving, peer_moments.operator.sizes, strict=True):
        input_slots = np.zeros(n)
        if block_coordinates.received is None:  # the block of a peer with a force input
            _, peer = classes[block_coordinates.loop.class_of[0]]
            state_inputs = np.zeros(
                len(block_coordinates.coordinates.eliminated) + len(block_coordinates.coordinates.rest)
            )
            state_inputs[np.array(peer.input_slots, np.intp)] = 1.0
            input_slots[:] = state_inputs[block_coordinates.coordinates.rest]
        inputs.append(np.diag(input_slots))
    moments = stationary_moments(peer_moments.operator, inputs)
    variances = dict[tuple[Copy, int], float]()
    for block_coordinates, moment in zip(peer_moments.moving, moments, strict=True):
        subsystems = [
            (peer_class.count, classes[g][1])
            for peer_class, g in zip(
                block_coordinates.loop.modal_system.peer_classes, block_coordinates.loop.class_of, strict=True
            )
        ]
        for copy, index, row in _error_rows(
            subsystems, block_coordinates.coordinates, block_coordinates.offsets
        ):
            n, weight = len(row), block_coordinates.loop.candidates[index] * (block_coordinates.received or 1)
            key = copy, block_coordinates.loop.class_of[index]
            variances[key] = variances.get(key, 0.0) + weight * float(row @ moment[:n, :n] @ row)
    return _largest(np.array(list(variances.values())))


def largest_error(
    moments: Floats,
    coordinates: Relative,
    offsets: Sequence[int],
    classes: Sequence[tuple[int, PeerReadings]],
) -> float:
    """Return the largest copy error in m, of peers that are single subsystems.

    Parameters
    ----------
    moments
        The second moments (n, n) of a long run over relative coordinates.
    coordinates, offsets
        The relative coordinates, and the offset of each peer's states.
    classes
        The readings of each peer, as for `moments_error`.
    """
    rows = _error_rows(classes, coordinates, offsets)
    return _largest(np.array([row @ moments @ row for *_, row in rows]))


def _largest(variances: Floats) -> float:
    """Return the square root of the largest variance."""
    largest = float(variances.max())
    if not largest >= 0:
        raise NotSupportedError("rounding exceeds the required accuracy")
    return math.sqrt(largest)


def _error_rows(
    subsystems: Sequence[tuple[int, PeerReadings]], coordinates: Relative, offsets: Sequence[int]
) -> list[tuple[Copy, int, Floats]]:
    """Return the error of each copy over relative coordinates, with its copy and subsystem.

    The error is x_i − (Σ_j x_j − x_i)/(N − 1).

    Parameters
    ----------
    subsystems
        The number of peers of each subsystem, and their readings.
    coordinates, offsets
        The relative coordinates, and the offset of each subsystem's states.
    """
    errors = []
    for copy in dict.fromkeys(copy for _, peer in subsystems for copy in peer.copies):
        state_indices = {
            g: offsets[g] + peer.copies[copy] for g, (_, peer) in enumerate(subsystems) if copy in peer.copies
        }
        others = sum(subsystems[g][0] for g in state_indices) - 1
        for g in state_indices if others else ():
            row = np.zeros(len(coordinates.eliminated) + len(coordinates.rest))
            for subsystem, state_index in state_indices.items():
                row[state_index] = (subsystem == g) * (1 + 1 / others) - subsystems[subsystem][0] / others
            neutral_part = row[coordinates.eliminated] + row[coordinates.rest] @ coordinates.weights
            if np.abs(neutral_part).max(initial=0.0) > NEUTRAL * np.abs(row).max(initial=0.0):
                raise NotSupportedError(
                    "the object copies are not coupled, so their difference grows without bound"
                )
            errors.append((copy, g, row[coordinates.rest]))
    if not errors:
        raise NotSupportedError("no position is sent to other peers")
    return errors
