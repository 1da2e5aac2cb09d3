"""The loops that the mean of all peers moves by, and what one channel's luck does to them.

Takes: the loops of a scene whose ticks each hear by themselves, and what channels remember.
Gives: `RouteMemory`, `remember`; `MeanSubsystem`, `with_memory`, `standing_state`; `Listened`,
`ReceptionChannel`, `MeanLoop`, `mean_loop`.
Guarantees: each matrix comes with the radius of its rounding, those of the sites' frames included; rigid
motions are taken out, which no luck moves.
Does not: compute second moments (see `gains`).

A channel's memory is what its receiver goes on with (see `packet_memory`). Its mean depends on the sender
alone and is a state η of the sender, as packets on their way are; what is left, δ = h − η, moves by itself,
driven by its own luck ξ, and reaches the receiver:

    η⁺ = (1 − π) η + π q        δ⁺ = (1 − π) δ + ξ        ξ = (I − π)(q − η − δ)

ξ has mean 0 whatever came before, and is uncorrelated with that of any other channel or packet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.closing import InterconnectionMatrices, ModalSystem, StateLayout, bounded_weight, close
from apc.eigen.peers import PeerClass
from apc.eigen.relative import Relative, relative_coordinates, relative_rows, with_doubt
from apc.frame.discretize import TOO_LARGE
from apc.frame.lift import FrameMap
from apc.frame.radius import UNIT, radius_of, value_of
from apc.frame.schedule import CouplingTerm, SentSample, UncertainSample
from apc.frame.taylor import arithmetic_of, entrywise, hull, over_as_many
from apc.moments.packet_memory import ReceiverMemory

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# The packets of one link with one delay: what luck is drawn for.
Route = tuple[str, str]

# What stands still is sent as a small fraction of how far it stands aside: a gear's ratio, say. Where a frame
# grows by many decades floats tell only coarser ones.
FINEST = (10**6, 10**4, 100)


@dataclass(frozen=True, slots=True, eq=False)
class RouteMemory:
    """What is remembered of a link's packets with one delay: of each of its `channels` the same.

    `after` holds each value once all packets are sent, over [values kept, packets sent, luck]; `misses`, for
    each slot, how far its uncertain values are before its packet from what that holds.
    """

    route: Route
    memory: ReceiverMemory
    channels: tuple[str, ...]
    after: Matrix
    misses: tuple[Matrix, ...]

    @property
    def sizes(self) -> list[int]:
        """How many values each slot's packet may replace by chance."""
        return [len(self.memory.uncertain(slot)) for slot in range(self.memory.slots)]

    def memorized(self, rows: Matrix) -> Matrix:
        """Return rows of `after` or `misses` over [values kept, luck], for each of the channels."""
        count, first = self.memory.count, self.memory.count + self.memory.slots
        columns = [*range(count), *range(first, first + sum(self.sizes))]
        inner = rows[..., columns]
        many = np.kron(np.eye(len(self.channels)), inner)
        # Each channel's values first, then their luck, slot by slot: what one packet holds is lost together.
        place = np.arange(many.shape[-1]).reshape(len(self.channels), -1)
        slots = np.split(place[:, count:], np.cumsum(self.sizes)[:-1], axis=1)
        return np.asarray(
            many[..., [*place[:, :count].ravel(), *(item for slot in slots for item in slot.ravel())]]
        )


@dataclass(frozen=True, slots=True)
class Listened:
    """A channel on `route`, whose receiver is the site `site` and weighs it by way."""

    site: int
    route: Route
    weights: Mapping[CouplingTerm, Fraction]


@dataclass(frozen=True, slots=True, eq=False)
class ReceptionChannel:
    """A channel in a loop: where in the state what it keeps is, and its luck ξ, drawn as a frame begins.

    `misses` say, slot by slot, what it adds itself to how far its uncertain values are from what is sent.
    """

    kept: range
    luck: range
    misses: tuple[Matrix, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MeanLoop:
    """A loop of means in relative coordinates, and behind these what some channels keep, and their luck.

    `matrix` (2, N, N) moves them all; of the loop's own n states, `at` are the coordinates, of states that
    begin at `offsets`, site by site. `misses` say how far what is uncertain of each site's packets, by site,
    route and slot, is from what is sent (2, k, N).
    """

    matrix: Matrix
    channels: tuple[ReceptionChannel, ...]
    at: Relative
    offsets: tuple[int, ...]
    misses: Mapping[tuple[int, Route, int], Matrix]


def remember(route: Route, memory: ReceiverMemory, channels: Sequence[str]) -> RouteMemory:
    """Follow what is remembered on a route through a frame."""
    count, slots = memory.count, memory.slots
    sizes = [len(memory.uncertain(slot)) for slot in range(slots)]
    after = np.zeros((2 + len(memory.moves), len(memory.old), count + slots + sum(sizes)))
    after[0, np.arange(len(memory.old)), memory.old] = 1.0
    misses = []
    first = count + slots
    for slot, size in enumerate(sizes):
        uncertain, certain = memory.uncertain(slot), memory.chances[:, slot] == 1
        misses.append(-after[:, uncertain])
        misses[slot][0, :, count + slot] = 1.0
        misses[slot][1] *= -1
        after[:, certain] = 0.0
        after[0, certain, count + slot] = 1.0
        chance = memory.chance(slot)
        missed = -chance[..., None]
        missed[0] += 1
        missed[1] = chance[1, :, None] + UNIT
        after[:, uncertain] = entrywise(after[:, uncertain], missed)
        after[:, uncertain, count + slot] = chance
        after[0, uncertain, first + np.arange(size)] = 1.0
        first += size
    return RouteMemory(route, memory, tuple(channels), after, tuple(misses))


@dataclass(frozen=True, slots=True)
class MeanSubsystem:
    """A site with what its receivers remember of it on the mean: its map, whose s holds three kinds of rows.

    `values` says which row is a value that ticks hear, by route, channel and value; `misses` are those of how
    far a slot's uncertain values are from what is sent; `sent` is the row of each packet as it is sent.
    """

    map: FrameMap
    values: Mapping[tuple[Route, str, int], int]
    misses: Mapping[tuple[Route, int], slice]
    sent: Mapping[SentSample, int]

    @property
    def states(self) -> int:
        """How many states it has."""
        return int(self.map.p.shape[-1])


def with_memory(
    group: PeerClass, remembered: Sequence[RouteMemory], frame: FrameMap | None = None
) -> MeanSubsystem:
    """Return a site whose state holds what its receivers remember of it on the mean.

    Parameters
    ----------
    group
        The site.
    remembered
        What they remember.
    frame
        Its map, where it is not the group's: over a cell, say.
    """
    plain, row_of = frame or group.lifted, {sent: row for row, sent in enumerate(group.schedule.sent)}
    numbers = [
        (item, channel)
        for item in remembered
        for channel in item.channels
        if SentSample(item.route[0], channel, 0) in row_of
    ]
    counts = [remembered.memory.count for remembered, _ in numbers]
    firsts, n_m, n_s = np.cumsum([0, *counts]), sum(counts), len(row_of)

    def over_all(block: Matrix, place: int) -> Matrix:
        """Return rows over one number's kept values and packets as rows over those of all."""
        remembered, channel = numbers[place]
        values = np.zeros((len(block), block.shape[-2], n_m + n_s))
        values[..., firsts[place] : firsts[place + 1]] = block[..., : remembered.memory.count]
        for slot in range(remembered.memory.slots):
            values[..., n_m + row_of[SentSample(remembered.route[0], channel, slot)]] = block[
                ..., remembered.memory.count + slot
            ]
        return values

    rows, kept = list[Matrix](), list[Matrix]()
    values: dict[tuple[Route, str, int], int] = {}
    misses: dict[tuple[Route, int], slice] = {}
    count = 0
    for place, (item, channel) in enumerate(numbers):
        whole = over_all(item.after, place)
        values |= {(item.route, channel, value): count + value for value in range(len(item.memory.old))}
        rows.append(whole)
        kept.append(whole[:, item.memory.kept])
        count += whole.shape[-2]
    for item in dict.fromkeys(remembered for remembered, _ in numbers):
        for slot in range(item.memory.slots):
            start = count
            for place, (other, _) in enumerate(numbers):
                if other is not item:
                    continue
                rows.append(over_all(item.misses[slot], place))
                count += rows[-1].shape[-2]
            misses[item.route, slot] = slice(start, count)
    plainly = np.zeros((2, n_s, n_m + n_s))
    plainly[0, :, n_m:] = np.eye(n_s)
    rows, kept = [*rows, plainly], [*kept, np.zeros((2, 0, n_m + n_s))]
    listed, keeping = (
        np.concatenate([over_as_many(values, plain.p) for values in some], axis=-2) for some in (rows, kept)
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
    return MeanSubsystem(FrameMap(p, q, s, d), values, misses, sent)


def mean_loop(
    loop: ModalSystem,
    heard: Sequence[Sequence[UncertainSample]],
    remembered: Sequence[RouteMemory],
    listened: Sequence[Listened],
    standing: Floats,
    frames: Mapping[str, FrameMap] | None = None,
) -> MeanLoop:
    """Close a loop of means, and say what the luck of some channels does to it.

    Parameters
    ----------
    loop
        The loop, its sites hearing each tick by itself.
    heard
        What each row of r of each site hears.
    remembered
        What is remembered on each route.
    listened
        The channels.
    standing
        The rigid motions over the loop's own z, site after site (Σ n_z, d).
    frames
        The sites' maps by name, where they are not the loop's: over a cell of m parameters (2 + m, …), as
        then are all matrices.
    """
    of_route = {item.route: item for item in remembered}
    sites = [with_memory(group, remembered, frames[group.name] if frames else None) for group in loop.sites]
    offsets = np.cumsum([0] + [site.states for site in sites]).tolist()
    starts = np.cumsum([0] + [site.map.s.shape[-2] for site in sites]).tolist()
    layout = StateLayout(tuple(offsets[:-1]), ("",) * offsets[-1], {})
    values = [of_route[item.route].memorized(of_route[item.route].after) for item in listened]
    firsts = np.cumsum([offsets[-1]] + [value.shape[-1] for value in values]).tolist()
    feedback, like, numbers = list[InterconnectionMatrices](), sites[0].map.p, arithmetic_of(sites[0].map.p)
    for g, rows in enumerate(heard):
        now, before = (np.zeros((len(like), len(rows), many)) for many in (starts[-1], firsts[-1]))
        for line, row in enumerate(rows):
            item = of_route.get((row.way.link, row.way.delay))
            if item is None or row.gap or row.channel not in item.channels:
                continue  # what is missed is held, and nothing stands in for it
            value = item.memory.heard[row.clock, row.tick]
            for h, weight in enumerate(loop.coupling[row.way][g]):
                if weight:
                    place = starts[h] + sites[h].values[item.route, row.channel, value]
                    now[:2, line, place] = bounded_weight(weight, loop.doubts.get(row.way, 0.0))
            place = item.channels.index(row.channel) * len(item.memory.old) + value
            for channel, own, first in zip(listened, values, firsts, strict=False):
                if channel.site == g and channel.route == item.route and channel.weights.get(row.way):
                    by = np.array(bounded_weight(channel.weights[row.way], 0.0)).reshape(2, 1, 1)
                    weighed = entrywise(own[:, place, None], by)
                    before[:, line, first : first + own.shape[-1]] = over_as_many(weighed, like)[:, 0]
        feedback.append(InterconnectionMatrices(now, before))
    closed = close([site.map for site in sites], feedback, layout, numbers=numbers)
    at = relative_coordinates(standing_state(closed.matrix[..., : offsets[-1]], standing, loop, offsets))
    rest, n = at.rest, len(at.rest)
    moved = relative_rows(closed.matrix, with_doubt(at, numbers), numbers)

    columns = np.concatenate([rest, np.arange(offsets[-1], firsts[-1])])
    matrix = np.zeros((len(like), len(columns), len(columns)))
    matrix[:, :n] = moved[..., columns]
    channels, start = [], n
    for listen, own in zip(listened, values, strict=True):
        item = of_route[listen.route]
        count = len(item.memory.old)
        kept = [number * count + e for number in range(len(item.channels)) for e in item.memory.kept]
        end = start + own.shape[-1]
        matrix[:, start : start + len(kept), start:end] = over_as_many(own[:, kept], like)
        misses = []
        for miss in item.misses:
            memorized = item.memorized(miss)
            wide = np.zeros((len(like), memorized.shape[-2], len(columns)))
            wide[..., start:end] = over_as_many(memorized, like)
            misses.append(wide)
        channels.append(
            ReceptionChannel(range(start, start + len(kept)), range(start + len(kept), end), tuple(misses))
        )
        start = end
    missed = {
        (h, *which): closed.sent[:, starts[h] + rows.start : starts[h] + rows.stop][..., columns]
        for h, site in enumerate(sites)
        for which, rows in site.misses.items()
    }
    return MeanLoop(matrix, tuple(channels), at, tuple(offsets), missed)


def standing_state(matrix: Matrix, standing: Floats, loop: ModalSystem, offsets: Sequence[int]) -> Floats:
    """Return rigid motions with what is remembered of them: whatever stands still is heard as it is sent.

    Of rational weights, it is made of small fractions; which of them, the matrix tells.

    Raises
    ------
    ApcError
        E806 the frame grows so fast that floats don't.
    """
    own = [len(group.z_names) for group in loop.sites]
    moving = np.concatenate([offset + np.arange(size) for offset, size in zip(offsets, own, strict=False)])
    basis = np.zeros((offsets[-1], standing.shape[1]))
    basis[moving] = standing
    rest = np.delete(np.arange(offsets[-1]), moving)
    if not standing.shape[1] or not len(rest):
        return basis
    value = value_of(matrix)
    still, sent = np.eye(len(rest)) - value[np.ix_(rest, rest)], value[np.ix_(rest, moving)] @ standing
    held = np.linalg.lstsq(still, sent)[0]
    numbers = arithmetic_of(matrix)
    for finest in FINEST:
        basis[rest] = [
            [float(Fraction(item).limit_denominator(finest)) for item in row] for row in held.tolist()
        ]
        off = hull(numbers.subtract(numbers.multiply(matrix, numbers.exact(basis)), numbers.exact(basis)))
        if (np.abs(value_of(off)) <= radius_of(off)).all():
            return basis
    raise ApcError(Diagnostic("E806", SourceLocation("the scene"), TOO_LARGE))
