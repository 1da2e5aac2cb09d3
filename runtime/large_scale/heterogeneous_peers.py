"""Peers by the thousand, all different: the matrices of every one, without an object for each.

Takes: a `Model`, its numbers, Jacobians and schedules.
Gives: `HeterogeneousGroup`, `populations`, `joined`; `receive_from_themselves`, `lines_of`; `turned_by`.
Guarantees: a population costs what its different peers cost in one array operation each, not in one Python
call each; equal peers of a population are counted.
Does not: merge equal peers of different groups (see `peer_classes`), or take subsystems that are not affine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.interconnection import InterconnectionMatrices, interconnect, lay_out
from apc.eigen.peer_classes import states_of
from apc.eigen.spectrum import LEAST_SHARE, oscillation
from apc.frame.interval_arithmetic import MIDPOINT_RADIUS, rounded
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.lift import FrameMap, lift
from apc.frame.linear_subsystem import LinearSubsystem, every_matrix
from apc.frame.linearize import linearize, linearize_rows, subsystem_of
from apc.frame.numeric_model import Instance
from apc.frame.phase_unwrapping import phase_advance
from apc.frame.schedule import Schedule
from apc.memory import refuse_beyond

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]


# Subsystems composed together: their matrices then stay in the cache of a processor.
CHUNK = 2048

# Largest total number of peers in groups with differences: some hundred megabytes of stored data.
MOST_DIFFERENT = 2 * 10**7
ENTRY = 100  # bytes of an entry of a different peer's matrix: with its radius, what it is made of and becomes


@dataclass(frozen=True, slots=True, eq=False)
class HeterogeneousGroup:
    """The peers of one group of the model, k different ones.

    `group` is its index in the model; `parameters` (k, n_p) and `maps` (k, …), with their radii, are the
    different peers', `rows` (count,) is the index for each peer, `counts` (k,) their numbers.
    """

    name: str
    group: int
    jacobians: SubsystemJacobians
    schedule: Schedule
    parameters: Floats
    maps: FrameMap
    rows: Integers
    counts: Floats

    def subsystem(self, row: int) -> LinearSubsystem:
        """Return the matrices of one of the different peers."""
        return linearize(self.jacobians, self.parameters[row])

    def sends(self, link: str) -> bool:
        """Return whether these peers send over a link."""
        return any(sending.link == link for sending in self.jacobians.peer_type.sends)


def populations(instance: Instance) -> tuple[HeterogeneousGroup, ...]:
    """Linearize and lift all different peers of a system, every kind of it affine and without edge functions.

    Raises
    ------
    ApcError
        E804 more different peers than the memory holds.
    """
    system, schedules, numbers = instance.system, instance.schedules, instance.numbers
    if sum(map(len, numbers.rows)) > MOST_DIFFERENT:
        message = f"{system.peers:,} peers, some of whom differ, and {MOST_DIFFERENT:,} are the most of these"
        raise ApcError(
            Diagnostic("E804", SourceLocation(system.origin.topology), message, hint="smaller counts")
        )
    states = list(map(states_of, schedules, instance.subsystems))
    needed = ENTRY * sum(len(rows) * n**2 for rows, n in zip(numbers.parameters, states, strict=True))
    message = f"{sum(map(len, numbers.parameters)):,} different peers of up to {max(states)} states"
    refuse_beyond(needed, "E804", SourceLocation(system.origin.topology), message, "fewer peers that differ")
    result = []
    for index, (subsystem, schedule) in enumerate(zip(instance.subsystems, schedules, strict=True)):
        group, parameters = system.groups[index], numbers.parameters[index]
        matrices = linearize_rows(subsystem, parameters)
        parts = [
            lift(subsystem_of(subsystem, matrices[start : start + CHUNK]), schedule)
            for start in range(0, len(matrices), CHUNK)
        ]
        rows = numbers.rows[index]
        counts = np.bincount(rows, minlength=len(parameters)).astype(np.float64)
        result.append(
            HeterogeneousGroup(
                group.name, index, subsystem, schedule, parameters, joined(parts), rows, counts
            )
        )
    return tuple(result)


def joined(parts: Sequence[FrameMap]) -> FrameMap:
    """Return the maps of several chunks of subsystems as those of all."""
    return parts[0].mapped(lambda *blocks: np.concatenate(blocks), *parts[1:])


def receive_from_themselves(maps: FrameMap, schedule: Schedule, values: Floats, others: Floats) -> FrameMap:
    """Close the weighted self-feedback of every subsystem; other received values remain inputs, with radii.

    Parameters
    ----------
    maps, schedule
        Of k subsystems, with their radii.
    values
        The weight of the subsystem's packets at each line of r (n_r,).
    others
        The weight of the external input at each line (n_r,).

    Notes
    -----
    The state is z, then the packets in transit, row by row of s, the newest first. With A_l selecting the
    received packets of l frames ago for each line, r = others·τ + own·Σ_l A_l s(−l) and s = S z + D r: as in
    `interconnection.interconnect`, D A₀ is nilpotent.
    """
    layout, picked = lay_out([[""] * maps.p.shape[-1]], [schedule]), lines_of(schedule)
    n, n_r = len(layout.names), len(schedule.received)
    now, before = np.zeros((n_r, len(schedule.sent))), np.zeros((n_r, n + n_r))
    now += picked.get(0, 0.0)
    for packet, index in layout.indices.items():
        if packet.lag in picked:
            before[:, index] = picked[packet.lag][:, packet.row]
    before = values[:, None] * before
    before[:, n:] = np.diag(others)
    received = InterconnectionMatrices(rounded(values[:, None] * now), rounded(before))
    parts = []
    for start in range(0, len(maps.p), CHUNK):
        frame_map = maps.mapped(lambda block, start=start: block[start : start + CHUNK])
        closed = interconnect([frame_map], [received], layout, numbers=MIDPOINT_RADIUS)
        matrix, sent = closed.matrix, closed.sent
        parts.append(FrameMap(matrix[..., :n], matrix[..., n:], sent[..., :n], sent[..., n:]))
    return joined(parts)


def lines_of(schedule: Schedule) -> dict[int, Floats]:
    """Return which packets of itself a subsystem receives at each line of r, by lag (n_r, n_s)."""
    result: dict[int, Floats] = {}
    for line, received in enumerate(schedule.received):
        if received.sent in schedule.sent:
            picked = result.setdefault(received.lag, np.zeros((len(schedule.received), len(schedule.sent))))
            picked[line, schedule.sent.index(received.sent)] = 1.0
    return result


def turned_by(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    value: complex,
    z: Complexes,
    received: Complexes,
    covector: Complexes,
) -> tuple[float, float]:
    """Return the frequency and damping of a mode; turns are counted on the state with most participation.

    Parameters
    ----------
    subsystem, schedule
        Those of the peer with the largest participation.
    value
        The eigenvalue.
    z, received, covector
        The peer's state (n,), its received values (n_r,) and its left vector (n,).
    """
    if not len(z):
        return 0.0, 1.0
    taking, count = np.abs(covector * z), len(subsystem.peer_type.states)
    moves = taking[:count].max(initial=0.0) > LEAST_SHARE * taking.sum()
    state = np.array([int(np.argmax(taking[:count] if moves else taking))])
    subsystem = every_matrix(subsystem, lambda matrix: matrix[None])
    angle = phase_advance(subsystem, schedule, z[None], received[None], state, np.array([value]))
    return oscillation(abs(value), float(angle[0]), float(schedule.frame_s))
