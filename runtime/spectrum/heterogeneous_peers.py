"""Populations of thousands of different peers: the matrices of all peers in arrays, without an object each.

Takes: a `NumericModel`.
Gives: `HeterogeneousGroup`, `populations`, `concatenate_maps`; `close_self_feedback`,
`own_packet_rows`; `mode_oscillation`.
Guarantees: the different peers of a population are computed in array operations, without a Python call for
each peer; equal peers of a population are computed once and counted.
Does not: merge equal peers of different groups (see `peer_classes`), or take subsystems that are not affine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, rounded
from apc.lifting.lift import FrameMap, lift
from apc.lifting.numeric_model import NumericModel
from apc.lifting.phase_unwrapping import phase_advance
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linear_subsystem import LinearSubsystem, every_matrix
from apc.linearization.linearize import linearize, linearize_rows, subsystem_of
from apc.spectrum.interconnection import InterconnectionMatrices, interconnect, lay_out
from apc.spectrum.peer_classes import states_of
from apc.spectrum.spectrum import LEAST_SHARE, oscillation
from apc.support.memory import refuse_beyond
from apc.timing.schedule import Schedule

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]


# Subsystems composed together: their matrices then stay in the cache of a processor.
CHUNK = 2048

# Largest total number of peers in groups with differences: some hundred megabytes of stored data.
MOST_DIFFERENT = 2 * 10**7
ENTRY = 100  # bytes for an entry of a different peer's matrix, with its radius and intermediate results


@dataclass(frozen=True, slots=True, eq=False)
class HeterogeneousGroup:
    """The peers of one group of the model, k different ones.

    `group` is the index of the group in the model; `parameters` (k, n_p) and `maps` (k, …), with their radii,
    are those of the different peers; `rows` (count,) is the index of each peer's parameters, `counts` (k,)
    the number of peers with the same parameters.
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


def populations(numeric: NumericModel) -> tuple[HeterogeneousGroup, ...]:
    """Return all different peers of a model, linearized and lifted; affine, without edge functions.

    Raises
    ------
    ApcError
        E804 more different peers than the memory can store.
    """
    model, schedules, numbers = numeric.model, numeric.schedules, numeric.numbers
    if sum(map(len, numbers.rows)) > MOST_DIFFERENT:
        message = (
            f"{model.peers:,} peers, some of which differ; the limit for different peers is "
            f"{MOST_DIFFERENT:,}"
        )
        raise ApcError(
            Diagnostic(
                "E804", SourceLocation(model.origin.topology), message, advice="reduce the number of peers"
            )
        )
    states = list(map(states_of, schedules, numeric.subsystems))
    needed = ENTRY * sum(len(rows) * n**2 for rows, n in zip(numbers.parameters, states, strict=True))
    message = f"{sum(map(len, numbers.parameters)):,} different peers of up to {max(states)} states"
    refuse_beyond(
        needed,
        "E804",
        SourceLocation(model.origin.topology),
        message,
        "reduce the number of different peers",
    )
    result = []
    for index, (subsystem, schedule) in enumerate(zip(numeric.subsystems, schedules, strict=True)):
        group, parameters = model.groups[index], numbers.parameters[index]
        matrices = linearize_rows(subsystem, parameters)
        parts = [
            lift(subsystem_of(subsystem, matrices[start : start + CHUNK]), schedule)
            for start in range(0, len(matrices), CHUNK)
        ]
        rows = numbers.rows[index]
        counts = np.bincount(rows, minlength=len(parameters)).astype(np.float64)
        result.append(
            HeterogeneousGroup(
                group.name, index, subsystem, schedule, parameters, concatenate_maps(parts), rows, counts
            )
        )
    return tuple(result)


def concatenate_maps(parts: Sequence[FrameMap]) -> FrameMap:
    """Return the frame maps of several chunks of subsystems as one."""
    return parts[0].mapped(lambda *blocks: np.concatenate(blocks), *parts[1:])


def close_self_feedback(maps: FrameMap, schedule: Schedule, values: Floats, others: Floats) -> FrameMap:
    """Return frame maps with weighted self-feedback closed; other received values remain inputs, with radii.

    Parameters
    ----------
    maps, schedule
        The frame maps of k subsystems, with their radii, and their schedule.
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
    layout, selection = lay_out([[""] * maps.p.shape[-1]], [schedule]), own_packet_rows(schedule)
    n, n_r = len(layout.names), len(schedule.received)
    direct, delayed = np.zeros((n_r, len(schedule.sent))), np.zeros((n_r, n + n_r))
    direct += selection.get(0, 0.0)
    for packet, index in layout.indices.items():
        if packet.lag in selection:
            delayed[:, index] = selection[packet.lag][:, packet.row]
    delayed = values[:, None] * delayed
    delayed[:, n:] = np.diag(others)
    received = InterconnectionMatrices(rounded(values[:, None] * direct), rounded(delayed))
    parts = []
    for start in range(0, len(maps.p), CHUNK):
        frame_map = maps.mapped(lambda block, start=start: block[start : start + CHUNK])
        closed = interconnect([frame_map], [received], layout, numbers=MIDPOINT_RADIUS)
        matrix, sent = closed.matrix, closed.sent
        parts.append(FrameMap(matrix[..., :n], matrix[..., n:], sent[..., :n], sent[..., n:]))
    return concatenate_maps(parts)


def own_packet_rows(schedule: Schedule) -> dict[int, Floats]:
    """Return the selection of own packets at each entry of r, by lag (n_r, n_s): 1 where the packet is
    received.
    """
    result: dict[int, Floats] = {}
    for input_row, received in enumerate(schedule.received):
        if received.sent in schedule.sent:
            selection = result.setdefault(
                received.lag, np.zeros((len(schedule.received), len(schedule.sent)))
            )
            selection[input_row, schedule.sent.index(received.sent)] = 1.0
    return result


def mode_oscillation(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    value: complex,
    z: Complexes,
    received: Complexes,
    covector: Complexes,
) -> tuple[float, float]:
    """Return the frequency and damping of a mode, with turns counted on the state with most participation.

    Parameters
    ----------
    subsystem, schedule
        The subsystem and the schedule of the peer with the largest participation.
    value
        The eigenvalue.
    z, received, covector
        The peer's state (n,), its received values (n_r,) and its left vector (n,).
    """
    if not len(z):
        return 0.0, 1.0
    participation, count = np.abs(covector * z), len(subsystem.peer_type.states)
    is_continuous = participation[:count].max(initial=0.0) > LEAST_SHARE * participation.sum()
    state = np.array([int(np.argmax(participation[:count] if is_continuous else participation))])
    subsystem = every_matrix(subsystem, lambda matrix: matrix[None])
    angle = phase_advance(subsystem, schedule, z[None], received[None], state, np.array([value]))
    return oscillation(abs(value), float(angle[0]), float(schedule.frame_s))
