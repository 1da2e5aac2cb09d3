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
from apc.eigen.modes import dense_loop
from apc.eigen.peer_classes import PeerClass
from apc.eigen.relative_coordinates import Relative
from apc.frame.devices import Device, coupled_directly, find_device
from apc.frame.frame_inputs import with_holds, with_ports
from apc.frame.linear_subsystem import LinearSubsystem
from apc.mean_square.class_moments import Moments, PerTickReception, instants
from apc.mean_square.second_moment_operator import settled
from apc.not_supported import NotSupportedError

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
    """The peers of a model with force inputs; `peers` lists the measured rows of z, by schedule id."""

    reception: PerTickReception
    peers: Mapping[int, PeerReadings]

    def of(self, subsystems: Sequence[PeerClass]) -> list[tuple[int, PeerReadings]]:
        """Return the number of peers of each class, and their readings."""
        return [(subsystem.count, self.peers[id(subsystem.schedule)]) for subsystem in subsystems]

    def peer_by_peer(self) -> list[tuple[int, PeerReadings]]:
        """Return the readings of each peer, in order."""
        return self.of(dense_loop(self.reception.groups, self.reception.exchange).subsystems)


def forced(system: Model, reception: PerTickReception, first: Fraction = Fraction(0)) -> Forced:
    """Add an independent force of variance 1 N² at each hand-held device.

    Parameters
    ----------
    system
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
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    direct = coupled_directly(system.peer_types)
    used = {part.clock for peer_type in system.peer_types for part in peer_type.clocks} | {
        link.clock for link in system.links
    }
    fastest = min(
        (clock for clock in system.clocks if clock.name in used),
        key=lambda clock: reception.timings[clock.period],
    )
    ticks = instants(reception, fastest)
    groups, rows, peers = [], {}, {}
    built: dict[tuple[int, int], tuple[PeerClass, PeerReadings]] = {}
    for group in reception.groups:
        key = id(group.schedule), id(group.lifting)
        if key not in built:
            held = find_device(
                group.jacobians, group.parameters, unit_of, group.initial_reception, direct=direct
            )
            if isinstance(held, str):
                raise NotSupportedError(held)
            built[key] = _forced(group, held, ticks, -first % reception.frame)
        pushed, peer = built[key]
        groups.append(
            replace(
                group,
                jacobians=pushed.jacobians,
                subsystem=pushed.subsystem,
                exacting=pushed.exacting,
                schedule=pushed.schedule,
                lifting=pushed.lifting,
            )
        )
        rows[id(pushed.schedule)] = reception.rows.get(id(group.schedule), ())
        peers[id(pushed.schedule)] = peer
    if not any(peer.input_slots for peer in peers.values()):
        raise NotSupportedError("no peer holds anything but what it tells others about")
    return Forced(replace(reception, groups=tuple(groups), rows=rows), peers)


def _forced(
    group: PeerClass, device: Device | None, ticks: Sequence[Fraction], start: Fraction
) -> tuple[PeerClass, PeerReadings]:
    """Return the first peer of a group with forces, drawn as a frame begins, and its copies' positions.

    Parameters
    ----------
    group
        The peers.
    device
        The driven bodies.
    ticks
        The start of each force, in seconds within a frame.
    start
        The instants of positions, in seconds within a frame.
    """
    peer_type, schedule = group.jacobians.peer_type, group.schedule
    copies = [
        (sending.link, name)
        for sending in peer_type.sends
        for name, unit in zip(sending.channels, sending.units, strict=True)
        if unit == "m"
    ]
    subsystems, readings = [], []
    for subsystem in (group.subsystem, group.exact):
        push = np.zeros((len(subsystem.a), 1), dtype=subsystem.a.dtype)
        if device is not None:
            push[device.velocity] += device.inverse if subsystem.a.dtype == object else float(device.inverse)
        subsystems.append(with_holds(subsystem, push))
        readings.append(_positions(subsystems[-1], peer_type))
    at = [int(time / schedule.quantum) for time in ticks] if device is not None else []
    used = int(start / schedule.quantum)
    (subsystem, exact), full, ports = with_ports(subsystems, schedule, 1, at, readings, [used])
    input_slots = ports.input_slots.ravel().tolist()
    peer = PeerReadings(
        input_slots=range(input_slots[0], input_slots[-1] + 1) if input_slots else range(0),
        copies=dict(zip(copies, ports.read[0].tolist(), strict=True)),
    )
    return group.with_subsystem(subsystem, exact, full), peer


def _positions(subsystem: LinearSubsystem, peer_type: PeerType) -> Matrix:
    """Return the dependence of sent positions on states and holds (positions, n_x + n_u)."""
    rows = [
        np.concatenate([send.x[index], send.u[index]])
        for send, sending in zip(subsystem.sends, peer_type.sends, strict=True)
        for index, unit in enumerate(sending.units)
        if unit == "m"
    ]
    return np.array(rows, dtype=subsystem.b.dtype).reshape(len(rows), sum(subsystem.b.shape))


def moments_error(of: Moments, classes: Sequence[tuple[int, PeerReadings]]) -> float:
    """Return the largest copy error in m.

    Parameters
    ----------
    of
        The second-moment operator of peers with force inputs.
    classes
        The number of peers of each class, and their readings.
    """
    added = []
    for moving, n in zip(of.moving, of.operator.sizes, strict=True):
        input_slots = np.zeros(n)
        if moving.received is None:  # a peer that is pushed
            _, peer = classes[moving.loop.of[0]]
            whole = np.zeros(len(moving.at.eliminated) + len(moving.at.rest))
            whole[np.array(peer.input_slots, np.intp)] = 1.0
            input_slots[:] = whole[moving.at.rest]
        added.append(np.diag(input_slots))
    moments = settled(of.operator, added)
    variances = dict[tuple[Copy, int], float]()
    for moving, moment in zip(of.moving, moments, strict=True):
        subsystems = [
            (subsystem.count, classes[g][1])
            for subsystem, g in zip(moving.loop.loop.subsystems, moving.loop.of, strict=True)
        ]
        for copy, index, row in _error_rows(subsystems, moving.at, moving.offsets):
            n, weight = len(row), moving.loop.many[index] * (moving.received or 1)
            key = copy, moving.loop.of[index]
            variances[key] = variances.get(key, 0.0) + weight * float(row @ moment[:n, :n] @ row)
    return _largest(np.array(list(variances.values())))


def largest_error(
    moments: Floats, at: Relative, offsets: Sequence[int], classes: Sequence[tuple[int, PeerReadings]]
) -> float:
    """Return the largest error of copies in m of peers that are followed one by one.

    Parameters
    ----------
    moments
        The second moments (n, n) of a long run over relative coordinates.
    at, offsets
        These, of states that begin at the offsets, peer by peer.
    classes
        The readings of each peer, as for `moments_error`.
    """
    rows = _error_rows(classes, at, offsets)
    return _largest(np.array([row @ moments @ row for *_, row in rows]))


def _largest(variances: Floats) -> float:
    """Return the root of the largest variance."""
    largest = float(variances.max())
    if not largest >= 0:
        raise NotSupportedError("rounding leaves its digits in doubt")
    return math.sqrt(largest)


def _error_rows(
    subsystems: Sequence[tuple[int, PeerReadings]], at: Relative, offsets: Sequence[int]
) -> list[tuple[Copy, int, Floats]]:
    """Return copy errors over coordinates, with copy and subsystem, for each subsystem with other copies.

    It is x_i − (Σ_j x_j − x_i)/(N − 1).

    Parameters
    ----------
    subsystems
        The number of peers of each subsystem, and their readings.
    at, offsets
        Relative coordinates, of states that begin at the offsets, subsystem by subsystem.
    """
    errors = []
    for copy in dict.fromkeys(copy for _, peer in subsystems for copy in peer.copies):
        indices = {
            g: offsets[g] + peer.copies[copy] for g, (_, peer) in enumerate(subsystems) if copy in peer.copies
        }
        others = sum(subsystems[g][0] for g in indices) - 1
        for g in indices if others else ():
            row = np.zeros(len(at.eliminated) + len(at.rest))
            for k, location in indices.items():
                row[location] = (k == g) * (1 + 1 / others) - subsystems[k][0] / others
            moved = row[at.eliminated] + row[at.rest] @ at.weights
            if np.abs(moved).max(initial=0.0) > NEUTRAL * np.abs(row).max(initial=0.0):
                raise NotSupportedError(
                    "nothing holds the copies together: what they differ by grows for ever"
                )
            errors.append((copy, g, row[at.rest]))
    if not errors:
        raise NotSupportedError("no position of a mass is told to others")
    return errors
