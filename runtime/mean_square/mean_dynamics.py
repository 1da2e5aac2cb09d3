"""The loops of mean dynamics, and the effect of one channel's random noise on them.

Takes: the loops of a model with a separate reception at each tick, and the receiver memories of the channels.
Gives: `RouteMemory`, `route_memory`; `MeanSubsystem`, `with_memory`, `with_stored_values`; `ReceivedChannel`,
`ReceptionChannel`, `MeanLoop`, `mean_loop`.
Guarantees: each matrix has an error radius that includes those of the sites' frame maps. Rigid modes, which
no noise excites, are removed.
Does not: compute second moments (see `second_moment_operator`).

A channel's memory h is the stored values of its receiver (see `receiver_memory`). The mean η depends on the
sender alone and is a state of the sender, as packets in transit are. The deviation δ = h − η has separate
dynamics, driven by the channel noise ξ, and acts on the receiver:

    η⁺ = (1 − π) η + π q        δ⁺ = (1 − π) δ + ξ        ξ = (I − π)(q − η − δ)

ξ has conditional mean 0 given the past, and is uncorrelated with that of any other channel or packet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.discretize import TOO_LARGE
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF, error_radius, value_of
from apc.lifting.lift import FrameMap
from apc.lifting.taylor_models import arithmetic_of, entrywise, hull, over_as_many
from apc.mean_square.receiver_memory import ReceiverMemory
from apc.spectrum.interconnection import (
    InterconnectionMatrices,
    ModalSystem,
    StateLayout,
    bounded_weight,
    interconnect,
)
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import Relative, relative_coordinates, relative_rows, with_uncertainty
from apc.timing.schedule import CouplingTerm, SentSample, UncertainSample

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# The packets of one link with one delay: the unit of random draws.
Route = tuple[str, str]

# A neutral mode is sent as a small rational multiple of its amplitude, such as a gear ratio. If a frame map
# has entries of very different magnitude, floats resolve only coarser fractions.
FINEST = (10**6, 10**4, 100)


@dataclass(frozen=True, slots=True, eq=False)
class RouteMemory:
    """The memory of a link's packets with one delay, equal for each of its `channels`.

    `clock` is the own clock of the pairs of groups, empty for that of the link.
    `after` is each value after all packets are sent, over [stored values, packets sent, noise].
    `reception_errors` is, for each slot, the difference between the content of its packet and its uncertain
    values before the packet.
    """

    route: Route
    memory: ReceiverMemory
    channels: tuple[str, ...]
    after: Matrix
    reception_errors: tuple[Matrix, ...]
    clock: str

    @property
    def sizes(self) -> list[int]:
        """The number of values that each slot's packet may replace at random."""
        return [len(self.memory.uncertain(slot)) for slot in range(self.memory.slots)]

    def of_all_channels(self, rows: Matrix) -> Matrix:
        """Return rows of `after` or `reception_errors` over [stored values, noise] of all channels."""
        count, first = self.memory.count, self.memory.count + self.memory.slots
        columns = [*range(count), *range(first, first + sum(self.sizes))]
        memory_rows = rows[..., columns]
        all_channels = np.kron(np.eye(len(self.channels)), memory_rows)
        # All values of a channel first, then the noise, slot by slot: the values of one packet are lost
        # together.
        index = np.arange(all_channels.shape[-1]).reshape(len(self.channels), -1)
        slots = np.split(index[:, count:], np.cumsum(self.sizes)[:-1], axis=1)
        return np.asarray(
            all_channels[..., [*index[:, :count].ravel(), *(item for slot in slots for item in slot.ravel())]]
        )


@dataclass(frozen=True, slots=True)
class ReceivedChannel:
    """A channel on `route`, whose receiver is `subsystem`, with `weights` by coupling term."""

    subsystem: int
    route: Route
    weights: Mapping[CouplingTerm, Fraction]


@dataclass(frozen=True, slots=True, eq=False)
class ReceptionChannel:
    """A channel in a loop: the indices of its stored values in the state, and of its noise ξ of the frame.

    `reception_errors` is, slot by slot, its own contribution to the difference between uncertain and sent
    values.
    """

    stored: range
    noise: range
    reception_errors: tuple[Matrix, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MeanLoop:
    """A loop of mean dynamics in relative coordinates, followed by stored values of channels and their noise.

    `matrix` (2, N, N) is the state matrix; `coordinates` are relative coordinates of the loop's n states, and
    `offsets` the first state of each subsystem. `reception_errors` (2, k, N) is the difference between the
    uncertain and the sent values of each subsystem's packets, by subsystem, route and slot.
    """

    matrix: Matrix
    channels: tuple[ReceptionChannel, ...]
    coordinates: Relative
    offsets: tuple[int, ...]
    reception_errors: Mapping[tuple[int, Route, int], Matrix]


def route_memory(
    route: Route, memory: ReceiverMemory, channels: Sequence[str], clock: str = ""
) -> RouteMemory:
    """Return the memory of a route after one frame: its values over stored values, sent packets and noise."""
    count, slots = memory.count, memory.slots
    sizes = [len(memory.uncertain(slot)) for slot in range(slots)]
    after = np.zeros((2 + len(memory.moves), len(memory.old), count + slots + sum(sizes)))
    after[0, np.arange(len(memory.old)), memory.old] = 1.0
    reception_errors = []
    first = count + slots
    for slot, size in enumerate(sizes):
        uncertain, certain = memory.uncertain(slot), memory.chances[:, slot] == 1
        reception_errors.append(-after[:, uncertain])
        reception_errors[slot][0, :, count + slot] = 1.0
        reception_errors[slot][1] *= -1
        after[:, certain] = 0.0
        after[0, certain, count + slot] = 1.0
        chance = memory.chance(slot)
        missed_chance = -chance[..., None]
        missed_chance[0] += 1
        missed_chance[1] = chance[1, :, None] + UNIT_ROUNDOFF
        after[:, uncertain] = entrywise(after[:, uncertain], missed_chance)
        after[:, uncertain, count + slot] = chance
        after[0, uncertain, first + np.arange(size)] = 1.0
        first += size
    return RouteMemory(route, memory, tuple(channels), after, tuple(reception_errors), clock)


@dataclass(frozen=True, slots=True)
class MeanSubsystem:
    """A subsystem with the mean of its receivers' memory as states; s of its map has three types of rows.

    `values` are the rows of received values, by route, channel and value; `reception_errors` are the rows of
    differences between a slot's uncertain and sent values; `sent` is the row of each packet as it is sent.
    """

    map: FrameMap
    values: Mapping[tuple[Route, str, int], int]
    reception_errors: Mapping[tuple[Route, int], slice]
    sent: Mapping[SentSample, int]

    @property
    def states(self) -> int:
        """The number of states."""
        return int(self.map.p.shape[-1])


def with_memory(
    peer_class: PeerClass, memory: Sequence[RouteMemory], frame: FrameMap | None = None
) -> MeanSubsystem:
    """Return a subsystem whose state includes the mean of its receivers' memory.

    Parameters
    ----------
    peer_class
        The subsystem.
    memory
        The memory of each route.
    frame
        The frame map of the subsystem, if different from the group's (for example over a cell).
    """
    frame_map, row_of = (
        frame or peer_class.lifted,
        {sent: row for row, sent in enumerate(peer_class.schedule.sent)},
    )
    numbers = [
        (item, channel)
        for item in memory
        for channel in item.channels
        if SentSample(item.route[0], channel, 0, item.clock) in row_of
    ]
    counts = [item.memory.count for item, _ in numbers]
    firsts, n_m, n_s = np.cumsum([0, *counts]), sum(counts), len(row_of)

    def over_all_channels(block: Matrix, index: int) -> Matrix:
        """Return rows over one channel's stored values and packets as rows over those of all channels."""
        memory, channel = numbers[index]
        values = np.zeros((len(block), block.shape[-2], n_m + n_s))
        values[..., firsts[index] : firsts[index + 1]] = block[..., : memory.memory.count]
        for slot in range(memory.memory.slots):
            row = row_of[SentSample(memory.route[0], channel, slot, memory.clock)]
            values[..., n_m + row] = block[..., memory.memory.count + slot]
        return values

    rows, stored = list[Matrix](), list[Matrix]()
    values: dict[tuple[Route, str, int], int] = {}
    reception_errors: dict[tuple[Route, int], slice] = {}
    count = 0
    for index, (item, channel) in enumerate(numbers):
        channel_rows = over_all_channels(item.after, index)
        values |= {(item.route, channel, value): count + value for value in range(len(item.memory.old))}
        rows.append(channel_rows)
        stored.append(channel_rows[:, item.memory.stored])
        count += channel_rows.shape[-2]
    for item in dict.fromkeys(route_memory for route_memory, _ in numbers):
        for slot in range(item.memory.slots):
            start = count
            for index, (channel_memory, _) in enumerate(numbers):
                if channel_memory is not item:
                    continue
                rows.append(over_all_channels(item.reception_errors[slot], index))
                count += rows[-1].shape[-2]
            reception_errors[item.route, slot] = slice(start, count)
    sent_rows = np.zeros((2, n_s, n_m + n_s))
    sent_rows[0, :, n_m:] = np.eye(n_s)
    rows, stored = [*rows, sent_rows], [*stored, np.zeros((2, 0, n_m + n_s))]
    output_rows, stored_rows = (
        np.concatenate([over_as_many(values, frame_map.p) for values in blocks], axis=-2)
        for blocks in (rows, stored)
    )
    n_z, multiply = frame_map.p.shape[-1], arithmetic_of(frame_map.p).multiply
    p = np.zeros((len(frame_map.p), n_z + n_m, n_z + n_m))
    p[:, :n_z, :n_z] = frame_map.p
    p[:, n_z:, :n_z] = multiply(stored_rows[..., n_m:], frame_map.s)
    p[:, n_z:, n_z:] = stored_rows[..., :n_m]
    q = np.concatenate([frame_map.q, multiply(stored_rows[..., n_m:], frame_map.d)], axis=-2)
    s = np.concatenate([multiply(output_rows[..., n_m:], frame_map.s), output_rows[..., :n_m]], axis=-1)
    d = multiply(output_rows[..., n_m:], frame_map.d)
    sent: dict[SentSample, int] = {sent: count + row for sent, row in row_of.items()}
    return MeanSubsystem(FrameMap(p, q, s, d), values, reception_errors, sent)


def mean_loop(
    modal_system: ModalSystem,
    received: Sequence[Sequence[UncertainSample]],
    memory: Sequence[RouteMemory],
    received_channels: Sequence[ReceivedChannel],
    neutral: Floats,
    frames: Mapping[str, FrameMap] | None = None,
) -> MeanLoop:
    """Return the closed loop of mean dynamics, with the effect of the noise of some channels.

    Its state is z of each subsystem with the mean of its receivers' memories, then the stored values and the
    noise of each of `received_channels`: the columns of `matrix` beyond the coordinates are those of noise.
    Neutral motions are removed.

    Parameters
    ----------
    modal_system
        The loop, with a separate reception at each tick.
    received
        The received sample of each row of r of each subsystem.
    memory
        The receiver memory of each route.
    received_channels
        The received channels.
    neutral
        The rigid modes over the loop's z, subsystem after subsystem (Σ n_z, d).
    frames
        The subsystems' frame maps by name, if different from the loop's: over a cell of m parameters (2 + m,
        …), as are then all matrices.
    """
    memory_by_route = {item.route: item for item in memory}
    subsystems = [
        with_memory(peer_class, memory, frames[peer_class.name] if frames else None)
        for peer_class in modal_system.peer_classes
    ]
    offsets = np.cumsum([0] + [subsystem.states for subsystem in subsystems]).tolist()
    starts = np.cumsum([0] + [subsystem.map.s.shape[-2] for subsystem in subsystems]).tolist()
    layout = StateLayout(tuple(offsets[:-1]), ("",) * offsets[-1], {})
    values = [
        memory_by_route[item.route].of_all_channels(memory_by_route[item.route].after)
        for item in received_channels
    ]
    firsts = np.cumsum([offsets[-1]] + [value.shape[-1] for value in values]).tolist()
    feedback, subsystem_map, numbers = (
        list[InterconnectionMatrices](),
        subsystems[0].map.p,
        arithmetic_of(subsystems[0].map.p),
    )
    for g, rows in enumerate(received):
        direct, delayed = (
            np.zeros((len(subsystem_map), len(rows), column_count))
            for column_count in (starts[-1], firsts[-1])
        )
        for input_row, row in enumerate(rows):
            item = memory_by_route.get((row.coupling_term.link, row.coupling_term.delay))
            if item is None or row.gap or row.channel not in item.channels:
                continue  # a missing value is held, without substitution
            value = item.memory.received[row.clock, row.tick]
            for h, weight in enumerate(modal_system.coupling[row.coupling_term][g]):
                if weight:
                    index = starts[h] + subsystems[h].values[item.route, row.channel, value]
                    direct[:2, input_row, index] = bounded_weight(
                        weight, modal_system.weight_errors.get(row.coupling_term, 0.0)
                    )
            index = item.channels.index(row.channel) * len(item.memory.old) + value
            for channel, channel_values, first in zip(received_channels, values, firsts, strict=False):
                if (
                    channel.subsystem == g
                    and channel.route == item.route
                    and channel.weights.get(row.coupling_term)
                ):
                    weight_ball = np.array(bounded_weight(channel.weights[row.coupling_term], 0.0)).reshape(
                        2, 1, 1
                    )
                    weighed = entrywise(channel_values[:, index, None], weight_ball)
                    delayed[:, input_row, first : first + channel_values.shape[-1]] = over_as_many(
                        weighed, subsystem_map
                    )[:, 0]
        feedback.append(InterconnectionMatrices(direct, delayed))
    closed = interconnect([subsystem.map for subsystem in subsystems], feedback, layout, numbers=numbers)
    coordinates = relative_coordinates(
        with_stored_values(closed.matrix[..., : offsets[-1]], neutral, modal_system, offsets)
    )
    remaining, n = coordinates.rest, len(coordinates.rest)
    relative_matrix = relative_rows(closed.matrix, with_uncertainty(coordinates, numbers), numbers)

    columns = np.concatenate([remaining, np.arange(offsets[-1], firsts[-1])])
    matrix = np.zeros((len(subsystem_map), len(columns), len(columns)))
    matrix[:, :n] = relative_matrix[..., columns]
    channels, start = [], n
    for received_channel, channel_values in zip(received_channels, values, strict=True):
        item = memory_by_route[received_channel.route]
        count = len(item.memory.old)
        stored = [number * count + e for number in range(len(item.channels)) for e in item.memory.stored]
        end = start + channel_values.shape[-1]
        matrix[:, start : start + len(stored), start:end] = over_as_many(
            channel_values[:, stored], subsystem_map
        )
        reception_errors = []
        for reception_error in item.reception_errors:
            of_all_channels = item.of_all_channels(reception_error)
            error_rows = np.zeros((len(subsystem_map), of_all_channels.shape[-2], len(columns)))
            error_rows[..., start:end] = over_as_many(of_all_channels, subsystem_map)
            reception_errors.append(error_rows)
        channels.append(
            ReceptionChannel(
                range(start, start + len(stored)), range(start + len(stored), end), tuple(reception_errors)
            )
        )
        start = end
    sent_errors = {
        (h, *route_and_slot): closed.sent[:, starts[h] + rows.start : starts[h] + rows.stop][..., columns]
        for h, subsystem in enumerate(subsystems)
        for route_and_slot, rows in subsystem.reception_errors.items()
    }
    return MeanLoop(matrix, tuple(channels), coordinates, tuple(offsets), sent_errors)


def with_stored_values(
    matrix: Matrix, neutral: Floats, modal_system: ModalSystem, offsets: Sequence[int]
) -> Floats:
    """Return the rigid modes (n_z, m), extended by the stored values to all states of the matrix.

    A rigid mode is constant, so its stored values s solve s = M_ss s + M_sz z. With rational weights they are
    small fractions: the least-squares solution is rounded to fractions, which are verified with error bounds.

    Parameters
    ----------
    matrix
        The matrix of the mean loop, with its error radius.
    neutral
        The rigid modes over z.
    modal_system, offsets
        The modal system; the start of each subsystem in the state, and the number of states.

    Raises
    ------
    ApcError
        E806 no fractions satisfy the equation within its error bounds, as entries overflow.
    """
    sizes = [len(peer_class.z_names) for peer_class in modal_system.peer_classes]
    state_indices = np.concatenate(
        [offset + np.arange(size) for offset, size in zip(offsets, sizes, strict=False)]
    )
    basis = np.zeros((offsets[-1], neutral.shape[1]))
    basis[state_indices] = neutral
    stored_indices = np.delete(np.arange(offsets[-1]), state_indices)
    if not neutral.shape[1] or not len(stored_indices):
        return basis
    value = value_of(matrix)
    stored_matrix, sent = (
        np.eye(len(stored_indices)) - value[np.ix_(stored_indices, stored_indices)],
        value[np.ix_(stored_indices, state_indices)] @ neutral,
    )
    stored_values = np.linalg.lstsq(stored_matrix, sent)[0]
    numbers = arithmetic_of(matrix)
    for finest in FINEST:
        basis[stored_indices] = [
            [float(Fraction(item).limit_denominator(finest)) for item in row]
            for row in stored_values.tolist()
        ]
        error_bound = hull(
            numbers.subtract(numbers.multiply(matrix, numbers.exact(basis)), numbers.exact(basis))
        )
        if (np.abs(value_of(error_bound)) <= error_radius(error_bound)).all():
            return basis
    raise ApcError(Diagnostic("E806", SourceLocation("the topology"), TOO_LARGE))
