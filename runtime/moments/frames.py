"""A frame of all peers, one by one, by which packets get lost in it.

Takes: a scene whose links lose packets, one packet a frame on each way.
Gives: `LossyFrame`, `held_frame`, `stand_in_frame`; `refuse_unheld`.
Guarantees: exact but for rounding; peers may be of any kind, and losses come in bursts.
Does not: bound its rounding; serve delays that vary.

Let ν_c be 1 − λ_c in a frame in which channel c loses its packet, and −λ_c in any other, λ_c being the share
that it loses; and ν_S, of a set of channels, their product. What moves in a frame is

    x⁺ = (A + Σ_S ν_S U_S F_S) x

Where a receiver holds what it heard last, S are single channels, and F_c is how far what is held is from what
is sent. Where its own value stands in, they are all sets of channels to one receiver.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model
from apc.eigen.matrix_norms import balance
from apc.eigen.modes import dense_loop
from apc.eigen.relative import Relative, relative_coordinates
from apc.frame.exchange import arcs
from apc.frame.radius import value_of
from apc.moments.crowd import PerTickReception, remembered_of, standing_motions
from apc.moments.mean_loops import Listened, mean_loop, standing_state
from apc.moments.stand_in import receivers_of
from apc.network.channel import ChannelLaw, channel_law
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]

# A channel: who hears whom, and which of the scene's links and delays it is of.
LossChannel = tuple[int, int, int]
Arcs = tuple[LossChannel, ...]

# What the frame of a motion that stands still may be off by, in floats.
STANDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class LossyFrame:
    """A (n, n), and U_S (n, m) and F_S (m, n) of each set of channels in `terms`.

    States are divided by `scale` (n,); those of each peer start at `offsets`, those that each channel holds
    are `held`. Motions that nothing holds back are projected out; `at` are coordinates relative to them.
    `alike`: peers can change places.
    """

    mean: Floats
    terms: tuple[Arcs, ...]
    enters: Floats
    misses: Floats
    arcs: Arcs
    laws: tuple[ChannelLaw, ...]
    offsets: tuple[int, ...]
    held: tuple[range, ...]
    scale: Floats
    at: Relative
    alike: bool

    @property
    def peers(self) -> int:
        """How many peers there are."""
        return len(self.offsets) - 1


def refuse_unheld(system: Model, hearing: PerTickReception) -> None:
    """Refuse a scene whose receivers don't just hold what they heard last, one packet a frame.

    Raises
    ------
    NotSupportedError
        Which link is in the way, and by what.
    """
    rows = [row for listed in hearing.rows.values() for row in listed]
    clocks = {clock.name: clock for clock in system.clocks}
    for link in system.links:
        if (channel := link.channel) is None:
            continue
        if channel.trace is not None:
            raise NotSupportedError(f"{link.name} plays a trace")
        if channel.jitter is not None:
            raise NotSupportedError(f"{link.name} has jitter")
        if channel.on_loss != "hold":
            what = f"takes no difference where a packet is missed (on_loss: {channel.on_loss})"
            raise NotSupportedError(f"{link.name} {what}")
        if hearing.timings[clocks[link.clock].period] < hearing.frame:
            what = f"more than one packet in a frame of {float(hearing.frame):g} s"
            raise NotSupportedError(f"{link.name} sends {what}")
        if not {row.way.operator for row in rows if row.way.link == link.name} <= {"mean", "sum"}:
            raise NotSupportedError(f"more than means and sums are taken over {link.name}")


def channels_of(link: Link, peers: int) -> int:
    """Return how many channels a link has."""
    return peers * (peers - 1) if link.graph.shape == "complete" else len(arcs(link.graph, peers)[0])


def held_frame(system: Model, hearing: PerTickReception, *, alike: bool = False) -> LossyFrame:
    """Return the frame of peers whose receivers hold what they heard last.

    Parameters
    ----------
    system, hearing
        The compiled scene and its peers.
    alike
        Whether the peers can change places.
    """
    loop = dense_loop(hearing.groups, hearing.exchange)
    memories = remembered_of(system, hearing, loop)
    links = {link.name: link for link in system.links}
    listened, ways, laws = list[Listened](), list[LossChannel](), list[ChannelLaw]()
    for number, memory in enumerate(memory for memory in memories if any(memory.sizes)):
        routes = [way for way in loop.coupling if (way.link, way.delay) == memory.route]
        for g, h in itertools.product(range(len(loop.sites)), repeat=2):
            weights = {way: loop.coupling[way][g][h] for way in routes}
            if any(weights.values()):
                listened.append(Listened(g, memory.route, weights))
                ways.append((g, h, number))
                laws.append(channel_law(system, links[memory.route[0]], hearing.timings[memory.route[1]]))
    everything = np.zeros((sum(len(site.z_names) for site in loop.sites), 0))
    means = mean_loop(loop, hearing.of(loop), memories, listened, everything)
    matrix, first = value_of(means.matrix), means.offsets[-1]
    luck = [place for channel in means.channels for place in channel.luck]
    rest = np.delete(np.arange(len(matrix)), luck)
    width = max((len(channel.luck) for channel in means.channels), default=0)
    enters, misses = np.zeros((len(ways), len(rest), width)), np.zeros((len(ways), width, len(rest)))
    for c, (channel, (_, sender, _), listen) in enumerate(zip(means.channels, ways, listened, strict=True)):
        missed = value_of(means.misses[sender, listen.route, 0])
        if missed[:, luck].any():
            raise NotSupportedError("a packet follows from another one of its frame")
        missed = missed + value_of(channel.misses[0])
        enters[c, :, : len(channel.luck)] = -matrix[rest][:, list(channel.luck)]
        misses[c, : len(channel.luck)] = missed[:, rest]
    ends = np.cumsum([first, *(len(channel.kept) for channel in means.channels)]).tolist()
    held = tuple(map(range, ends, ends[1:]))
    standing, loop_matrix = standing_motions(loop), means.matrix[:, :first, :first]
    basis = np.zeros((len(rest), standing.shape[1]))
    basis[:first] = standing_state(loop_matrix, standing, loop, means.offsets)
    mean, offsets = matrix[np.ix_(rest, rest)], means.offsets
    terms = tuple((way,) for way in ways)
    return _projected(mean, terms, enters, misses, ways, laws, offsets, held, basis, alike)


def stand_in_frame(system: Model, hearing: PerTickReception, most: int, *, alike: bool = False) -> LossyFrame:
    """Return the frame of peers whose own values stand in for missing ones.

    Parameters
    ----------
    system, hearing
        As for `stand_in.stand_in`.
    most
        How many channels are the most.
    alike
        Whether the peers can change places.
    """
    loop = dense_loop(hearing.groups, hearing.exchange)
    receivers, offsets, law = receivers_of(system, hearing, loop, loop.coupling)
    heard = [np.flatnonzero(receiver.heard.any(axis=0)).tolist() for receiver in receivers]
    ways = [(h, g, 0) for h, senders in enumerate(heard) for g in senders]
    if len(ways) > most:
        raise NotSupportedError(
            f"bursts of values that stand in on {len(ways)} ways: {most} are the most that are followed"
        )
    n = offsets[-1]
    width = max(np.diff(offsets))
    mean = np.zeros((n, n))
    terms, enters, misses = list[Arcs](), list[Floats](), list[Floats]()
    for h, (receiver, senders) in enumerate(zip(receivers, heard, strict=True)):
        rows = np.arange(offsets[h], offsets[h + 1])
        size = len(rows)
        counts = receiver.heard[:, :, None, None]
        moved = np.concatenate(
            [value_of(by) * counts[:, g] for g, by in enumerate(receiver.heard_of)], axis=-1
        )
        moved[..., rows] += value_of(receiver.alone)
        chance = np.where(receiver.heard, 1 - law.mean_loss, law.mean_loss)
        for count in range(len(senders) + 1):
            for lost in itertools.combinations(senders, count):
                factors = chance.copy()
                factors[:, lost] = 1 - 2 * receiver.heard[:, lost]
                term = np.tensordot(factors[:, senders].prod(axis=1), moved, 1)
                if not lost:
                    mean[rows] = term
                    continue
                terms.append(tuple((h, g, 0) for g in lost))
                enters.append(np.zeros((n, width)))
                misses.append(np.zeros((width, n)))
                enters[-1][rows, np.arange(size)] = 1.0
                misses[-1][:size] = term
    known = np.stack([mean, np.full_like(mean, STANDING)])
    basis = standing_state(known, standing_motions(loop), loop, offsets)
    listed = tuple(terms), np.stack(enters), np.stack(misses), ways, [law] * len(ways), offsets
    return _projected(mean, *listed, (range(0),) * len(ways), basis, alike)


def _projected(
    mean: Floats,
    terms: tuple[Arcs, ...],
    enters: Floats,
    misses: Floats,
    ways: Sequence[LossChannel],
    laws: Sequence[ChannelLaw],
    offsets: Sequence[int],
    held: tuple[range, ...],
    basis: Floats,
    alike: bool,
) -> LossyFrame:
    """Return a frame whose motions `basis` (n, d), which nothing holds back, are projected out."""
    # At right angles: peers may still change places.
    project = np.eye(len(basis)) - basis @ np.linalg.pinv(basis)
    mean, enters, misses = project @ mean @ project, project @ enters, misses @ project
    scale = balance(np.abs(mean) + (np.abs(enters) @ np.abs(misses)).max(axis=0, initial=0.0))
    if alike:  # the same for all peers and channels, powers of two
        for rows in (np.arange(offsets[1]) + np.array(offsets[:-1])[:, None], np.array(held, np.intp)):
            scale[rows] = 2.0 ** np.round(np.log2(scale[rows]).mean(axis=0))
    return LossyFrame(
        mean=mean / scale[:, None] * scale,
        terms=terms,
        enters=enters / scale[:, None],
        misses=misses * scale,
        arcs=tuple(ways),
        laws=tuple(laws),
        offsets=tuple(offsets),
        held=held,
        scale=scale,
        at=relative_coordinates(basis),
        alike=alike,
    )
