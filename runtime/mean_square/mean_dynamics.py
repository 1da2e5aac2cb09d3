"""The loops of mean dynamics, and the effect of one channel's random noise on them.

Takes: the loops of a model with a separate reception at each tick, and the receiver memories of the channels.
Gives: `RouteMemory`, `route_memory`; `MeanSubsystem`, `with_memory`, `neutral_state`; `Listened`,
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
from apc.eigen.interconnection import (
    InterconnectionMatrices,
    ModalSystem,
    StateLayout,
    bounded_weight,
    interconnect,
)
from apc.eigen.peer_classes import PeerClass
from apc.eigen.relative_coordinates import Relative, relative_coordinates, relative_rows, with_uncertainty
from apc.frame.discretize import TOO_LARGE
from apc.frame.interval_arithmetic import UNIT_ROUNDOFF, error_radius, value_of
from apc.frame.lift import FrameMap
from apc.frame.schedule import CouplingTerm, SentSample, UncertainSample
from apc.frame.taylor_models import arithmetic_of, entrywise, hull, over_as_many
from apc.mean_square.receiver_memory import ReceiverMemory

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

    `after` is each value after all packets are sent, over [stored values, packets sent, noise].
    `reception_errors` is, for each slot, the difference of its uncertain values from the contents of its
    packet, before the packet.
    """

    route: Route
    memory: ReceiverMemory
    channels: tuple[str, ...]
    after: Matrix
    reception_errors: tuple[Matrix, ...]

    @property
    def sizes(self) -> list[int]:
        """The number of values that each slot's packet may replace at random."""
        return [len(self.memory.uncertain(slot)) for slot in range(self.memory.slots)]

    def memorized(self, rows: Matrix) -> Matrix:
        """Return rows of `after` or `reception_errors` over [stored values, noise], for each of the
        channels.
        """
        count, first = self.memory.count, self.memory.count + self.memory.slots
        columns = [*range(count), *range(first, first + sum(self.sizes))]
        inner = rows[..., columns]
        many = np.kron(np.eye(len(self.channels)), inner)
        # All values of a channel first, then the noise, slot by slot: the values of one packet are lost
        # together.
        index = np.arange(many.shape[-1]).reshape(len(self.channels), -1)
        slots = np.split(index[:, count:], np.cumsum(self.sizes)[:-1], axis=1)
        return np.asarray(
            many[..., [*index[:, :count].ravel(), *(item for slot in slots for item in slot.ravel())]]
        )


@dataclass(frozen=True, slots=True)
class Listened:
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

    `matrix` (2, N, N) is the state matrix; of the loop's n states, `at` are the coordinates, and `offsets`
    the first state of each subsystem. `reception_errors` (2, k, N) is the difference between the uncertain
    and the sent values of each subsystem's packets, by subsystem, route and slot.
    """

    matrix: Matrix
    channels: tuple[ReceptionChannel, ...]
    at: Relative
    offsets: tuple[int, ...]
    reception_errors: Mapping[tuple[int, Route, int], Matrix]


def route_memory(route: Route, memory: ReceiverMemory, channels: Sequence[str]) -> RouteMemory:
    """Propagate the stored values of a route through a frame."""
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
        missed = -chance[..., None]
        missed[0] += 1
        missed[1] = chance[1, :, None] + UNIT_ROUNDOFF
        after[:, uncertain] = entrywise(after[:, uncertain], missed)
        after[:, uncertain, count + slot] = chance
        after[0, uncertain, first + np.arange(size)] = 1.0
        first += size
    return RouteMemory(route, memory, tuple(channels), after, tuple(reception_errors))


@dataclass(frozen=True, slots=True)
class MeanSubsystem:
    """A subsystem augmented by the mean of its receivers' memory: its map, whose s has three types of rows.

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
    group: PeerClass, memory: Sequence[RouteMemory], frame: FrameMap | None = None
) -> MeanSubsystem:
    """Return a subsystem whose state includes the mean of its receivers' memory.

    Parameters
    ----------
    group
        The subsystem.
    memory
        The memory of each route.
    frame
        Its frame map, if different from the group's (for example over a cell).
    """
    plain, row_of = frame or group.lifted, {sent: row for row, sent in enumerate(group.schedule.sent)}
    numbers = [
        (item, channel)
        for item in memory
        for channel in item.channels
        if SentSample(item.route[0], channel, 0) in row_of
    ]
    counts = [memory.memory.count for memory, _ in numbers]
    firsts, n_m, n_s = np.cumsum([0, *counts]), sum(counts), len(row_of)

    def over_all(block: Matrix, index: int) -> Matrix:
        """Return rows over one number's kept values and packets as rows over those of all."""
        memory, channel = numbers[index]
        values = np.zeros((len(block), block.shape[-2], n_m + n_s))
        values[..., firsts[index] : firsts[index + 1]] = block[..., : memory.memory.count]
        for slot in range(memory.memory.slots):
            values[..., n_m + row_of[SentSample(memory.route[0], channel, slot)]] = block[
                ..., memory.memory.count + slot
            ]
        return values

    rows, stored = list[Matrix](), list[Matrix]()
    values: dict[tuple[Route, str, int], int] = {}
    reception_errors: dict[tuple[Route, int], slice] = {}
    count = 0
    for index, (item, channel) in enumerate(numbers):
        whole = over_all(item.after, index)
        values |= {(item.route, channel, value): count + value for value in range(len(item.memory.old))}
        rows.append(whole)
        stored.append(whole[:, item.memory.stored])
        count += whole.shape[-2]
    for item in dict.fromkeys(memory for memory, _ in numbers):
        for slot in range(item.memory.slots):
            start = count
            for index, (other, _) in enumerate(numbers):
                if other is not item:
                    continue
                rows.append(over_all(item.reception_errors[slot], index))
                count += rows[-1].shape[-2]
            reception_errors[item.route, slot] = slice(start, count)
    plainly = np.zeros((2, n_s, n_m + n_s))
    plainly[0, :, n_m:] = np.eye(n_s)
    rows, stored = [*rows, plainly], [*stored, np.zeros((2, 0, n_m + n_s))]
    listed, keeping = (
        np.concatenate([over_as_many(values, plain.p) for values in some], axis=-2) for some in (rows, stored)
    )
    n_z, multiply = plain.p.shape[-1], arithmetic_of(plain.p).multiply
    p = np.zeros((len(plain.p), n_z + n_m, n_z + n_m))
    p[:, :n_z, :n_z] = plain.p
    p[:, n_z:, :n_z] = multiply(keeping[..., n_m:], plain.s)
    p[:, n_z:, n_z:] = keeping[..., :n_m]
    q = np.concatenate([plain.q, multiply(keeping[..., n_m:], plain.d)], axis=-2)
    s = np.concatenate([multiply(listed[..., n_m:], plain.s), listed[..., :n_m]], axis=-1)
    d = multiply(listed[..., n_m:], plain.d)
    sent: dict[SentSample, int] = {sent: count + row for sent, row in row_of.items()}
    return MeanSubsystem(FrameMap(p, q, s, d), values, reception_errors, sent)


def mean_loop(
    loop: ModalSystem,
    received: Sequence[Sequence[UncertainSample]],
    memory: Sequence[RouteMemory],
    listened: Sequence[Listened],
    neutral: Floats,
    frames: Mapping[str, FrameMap] | None = None,
) -> MeanLoop:
    """Close a loop of mean dynamics, with the effect of the noise of some channels.

    Parameters
    ----------
    loop
        The loop, with a separate reception at each tick.
    received
        The received sample of each row of r of each subsystem.
    memory
        The receiver memory of each route.
    listened
        The channels.
    neutral
        The rigid modes over the loop's z, subsystem after subsystem (Σ n_z, d).
    frames
        The subsystems' frame maps by name, if different from the loop's: over a cell of m parameters (2 + m,
        …), as are then all matrices.
    """
    of_route = {item.route: item for item in memory}
    subsystems = [
        with_memory(group, memory, frames[group.name] if frames else None) for group in loop.subsystems
    ]
    offsets = np.cumsum([0] + [subsystem.states for subsystem in subsystems]).tolist()
    starts = np.cumsum([0] + [subsystem.map.s.shape[-2] for subsystem in subsystems]).tolist()
    layout = StateLayout(tuple(offsets[:-1]), ("",) * offsets[-1], {})
    values = [of_route[item.route].memorized(of_route[item.route].after) for item in listened]
    firsts = np.cumsum([offsets[-1]] + [value.shape[-1] for value in values]).tolist()
    feedback, like, numbers = (
        list[InterconnectionMatrices](),
        subsystems[0].map.p,
        arithmetic_of(subsystems[0].map.p),
    )
    for g, rows in enumerate(received):
        now, before = (np.zeros((len(like), len(rows), many)) for many in (starts[-1], firsts[-1]))
        for line, row in enumerate(rows):
            item = of_route.get((row.coupling_term.link, row.coupling_term.delay))
            if item is None or row.gap or row.channel not in item.channels:
                continue  # a missing value is held, without substitution
            value = item.memory.received[row.clock, row.tick]
            for h, weight in enumerate(loop.coupling[row.coupling_term][g]):
                if weight:
                    index = starts[h] + subsystems[h].values[item.route, row.channel, value]
                    now[:2, line, index] = bounded_weight(
                        weight, loop.weight_errors.get(row.coupling_term, 0.0)
                    )
            index = item.channels.index(row.channel) * len(item.memory.old) + value
            for channel, local, first in zip(listened, values, firsts, strict=False):
                if (
                    channel.subsystem == g
                    and channel.route == item.route
                    and channel.weights.get(row.coupling_term)
                ):
                    by = np.array(bounded_weight(channel.weights[row.coupling_term], 0.0)).reshape(2, 1, 1)
                    weighed = entrywise(local[:, index, None], by)
                    before[:, line, first : first + local.shape[-1]] = over_as_many(weighed, like)[:, 0]
        feedback.append(InterconnectionMatrices(now, before))
    closed = interconnect([subsystem.map for subsystem in subsystems], feedback, layout, numbers=numbers)
    at = relative_coordinates(neutral_state(closed.matrix[..., : offsets[-1]], neutral, loop, offsets))
    rest, n = at.rest, len(at.rest)
    moved = relative_rows(closed.matrix, with_uncertainty(at, numbers), numbers)

    columns = np.concatenate([rest, np.arange(offsets[-1], firsts[-1])])
    matrix = np.zeros((len(like), len(columns), len(columns)))
    matrix[:, :n] = moved[..., columns]
    channels, start = [], n
    for listen, local in zip(listened, values, strict=True):
        item = of_route[listen.route]
        count = len(item.memory.old)
        stored = [number * count + e for number in range(len(item.channels)) for e in item.memory.stored]
        end = start + local.shape[-1]
        matrix[:, start : start + len(stored), start:end] = over_as_many(local[:, stored], like)
        reception_errors = []
        for miss in item.reception_errors:
            memorized = item.memorized(miss)
            wide = np.zeros((len(like), memorized.shape[-2], len(columns)))
            wide[..., start:end] = over_as_many(memorized, like)
            reception_errors.append(wide)
        channels.append(
            ReceptionChannel(
                range(start, start + len(stored)), range(start + len(stored), end), tuple(reception_errors)
            )
        )
        start = end
    missed = {
        (h, *which): closed.sent[:, starts[h] + rows.start : starts[h] + rows.stop][..., columns]
        for h, subsystem in enumerate(subsystems)
        for which, rows in subsystem.reception_errors.items()
    }
    return MeanLoop(matrix, tuple(channels), at, tuple(offsets), missed)


def neutral_state(matrix: Matrix, neutral: Floats, loop: ModalSystem, offsets: Sequence[int]) -> Floats:
    """Return rigid modes with their stored values: a constant state is received as it is sent.

    With rational weights the stored values are small fractions, determined from the matrix.

    Raises
    ------
    ApcError
        E806 the entries of the frame map overflow floats.
    """
    local = [len(group.z_names) for group in loop.subsystems]
    moving = np.concatenate([offset + np.arange(size) for offset, size in zip(offsets, local, strict=False)])
    basis = np.zeros((offsets[-1], neutral.shape[1]))
    basis[moving] = neutral
    rest = np.delete(np.arange(offsets[-1]), moving)
    if not neutral.shape[1] or not len(rest):
        return basis
    value = value_of(matrix)
    still, sent = np.eye(len(rest)) - value[np.ix_(rest, rest)], value[np.ix_(rest, moving)] @ neutral
    held = np.linalg.lstsq(still, sent)[0]
    numbers = arithmetic_of(matrix)
    for finest in FINEST:
        basis[rest] = [
            [float(Fraction(item).limit_denominator(finest)) for item in row] for row in held.tolist()
        ]
        error_bound = hull(
            numbers.subtract(numbers.multiply(matrix, numbers.exact(basis)), numbers.exact(basis))
        )
        if (np.abs(value_of(error_bound)) <= error_radius(error_bound)).all():
            return basis
    raise ApcError(Diagnostic("E806", SourceLocation("the topology"), TOO_LARGE))
