"""The frame map of all peers individually, as a function of the packets lost in the frame.

Takes: a model with lossy links, one packet per frame on each directed link.
Gives: `LossyFrame`, `hold_frame`, `substitution_frame`; `refuse_unheld`; `channels_of`.
Guarantees: exact except for rounding; peers may be of any type, and losses may be bursty.
Does not: bound its rounding; serve delays that vary.

Let ν_c be 1 − λ_c in a frame in which channel c loses its packet, and −λ_c in any other; λ_c is its loss
probability. For a set S of channels let ν_S be the product of their ν_c. The frame map is

    x⁺ = (A + Σ_S ν_S U_S F_S) x

If a receiver holds the last received value, the sets S are single channels, and F_c is the difference between
held and sent value. If it substitutes its own value, they are all sets of channels to one receiver.
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
from apc.eigen.relative_coordinates import Relative, relative_coordinates
from apc.frame.communication_graph import arcs
from apc.frame.interval_arithmetic import value_of
from apc.mean_square.class_moments import PerTickReception, neutral_motions, stored_of
from apc.mean_square.mean_dynamics import Listened, mean_loop, neutral_state
from apc.mean_square.self_substitution import receivers_of
from apc.network.channel import ChannelLaw, channel_law
from apc.not_supported import NotSupportedError

Floats = NDArray[np.float64]

# A channel: sender and receiver, and the link and delay class.
LossChannel = tuple[int, int, int]
Arcs = tuple[LossChannel, ...]

# The float error allowed in the frame map of a neutral mode.
NEUTRAL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class LossyFrame:
    """A (n, n), and U_S (n, m) and F_S (m, n) of each set of channels in `terms`.

    States are divided by `scale` (n,); those of each peer start at `offsets`, those that each channel holds
    are `held`. Neutral modes are projected out; `at` are coordinates relative to them. `interchangeable` is
    whether the peers are exchangeable.
    """

    mean: Floats
    terms: tuple[Arcs, ...]
    input: Floats
    reception_errors: Floats
    arcs: Arcs
    laws: tuple[ChannelLaw, ...]
    offsets: tuple[int, ...]
    stored: tuple[range, ...]
    scale: Floats
    at: Relative
    interchangeable: bool

    @property
    def peers(self) -> int:
        """The number of peers."""
        return len(self.offsets) - 1


def refuse_unheld(system: Model, reception: PerTickReception) -> None:
    """Refuse a model unless its receivers hold the last received value, with one packet per frame.

    Raises
    ------
    NotSupportedError
        The link that is not supported, and why.
    """
    rows = [row for listed in reception.rows.values() for row in listed]
    clocks = {clock.name: clock for clock in system.clocks}
    for link in system.links:
        if (channel := link.channel) is None:
            continue
        if channel.trace is not None:
            raise NotSupportedError(f"{link.name} plays a trace")
        if channel.jitter is not None:
            raise NotSupportedError(f"{link.name} has jitter")
        if channel.on_loss != "hold":
            message = f"takes no difference where a packet is missed (on_loss: {channel.on_loss})"
            raise NotSupportedError(f"{link.name} {message}")
        if reception.timings[clocks[link.clock].period] < reception.frame:
            message = f"more than one packet in a frame of {float(reception.frame):g} s"
            raise NotSupportedError(f"{link.name} sends {message}")
        if not {row.coupling_term.operator for row in rows if row.coupling_term.link == link.name} <= {
            "mean",
            "sum",
        }:
            raise NotSupportedError(f"more than means and sums are taken over {link.name}")


def channels_of(link: Link, peers: int) -> int:
    """Return the number of channels of a link."""
    return peers * (peers - 1) if link.graph.shape == "complete" else len(arcs(link.graph, peers)[0])


def hold_frame(system: Model, reception: PerTickReception, *, interchangeable: bool = False) -> LossyFrame:
    """Return the frame of peers whose receivers hold the last received value.

    Parameters
    ----------
    system, reception
        The model and its peers.
    interchangeable
        Whether the peers are exchangeable.
    """
    loop = dense_loop(reception.groups, reception.exchange)
    memories = stored_of(system, reception, loop)
    links = {link.name: link for link in system.links}
    listened, loss_channels, laws = list[Listened](), list[LossChannel](), list[ChannelLaw]()
    for number, memory in enumerate(memory for memory in memories if any(memory.sizes)):
        routes = [
            coupling_term
            for coupling_term in loop.coupling
            if (coupling_term.link, coupling_term.delay) == memory.route
        ]
        for g, h in itertools.product(range(len(loop.subsystems)), repeat=2):
            weights = {coupling_term: loop.coupling[coupling_term][g][h] for coupling_term in routes}
            if any(weights.values()):
                listened.append(Listened(g, memory.route, weights))
                loss_channels.append((g, h, number))
                laws.append(channel_law(system, links[memory.route[0]], reception.timings[memory.route[1]]))
    everything = np.zeros((sum(len(subsystem.z_names) for subsystem in loop.subsystems), 0))
    means = mean_loop(loop, reception.of(loop), memories, listened, everything)
    matrix, first = value_of(means.matrix), means.offsets[-1]
    noise = [index for channel in means.channels for index in channel.noise]
    rest = np.delete(np.arange(len(matrix)), noise)
    width = max((len(channel.noise) for channel in means.channels), default=0)
    enters, reception_errors = (
        np.zeros((len(loss_channels), len(rest), width)),
        np.zeros((len(loss_channels), width, len(rest))),
    )
    for c, (channel, (_, sender, _), listen) in enumerate(
        zip(means.channels, loss_channels, listened, strict=True)
    ):
        missed = value_of(means.reception_errors[sender, listen.route, 0])
        if missed[:, noise].any():
            raise NotSupportedError("a packet follows from another one of its frame")
        missed = missed + value_of(channel.reception_errors[0])
        enters[c, :, : len(channel.noise)] = -matrix[rest][:, list(channel.noise)]
        reception_errors[c, : len(channel.noise)] = missed[:, rest]
    ends = np.cumsum([first, *(len(channel.stored) for channel in means.channels)]).tolist()
    held = tuple(map(range, ends, ends[1:]))
    neutral, loop_matrix = neutral_motions(loop), means.matrix[:, :first, :first]
    basis = np.zeros((len(rest), neutral.shape[1]))
    basis[:first] = neutral_state(loop_matrix, neutral, loop, means.offsets)
    mean, offsets = matrix[np.ix_(rest, rest)], means.offsets
    terms = tuple((coupling_term,) for coupling_term in loss_channels)
    return _projected(
        mean, terms, enters, reception_errors, loss_channels, laws, offsets, held, basis, interchangeable
    )


def substitution_frame(
    system: Model, reception: PerTickReception, most: int, *, interchangeable: bool = False
) -> LossyFrame:
    """Return the frame of peers that substitute their own values for missing ones.

    Parameters
    ----------
    system, reception
        As for `self_substitution.self_substitution`.
    most
        The largest number of channels.
    interchangeable
        Whether the peers are exchangeable.
    """
    loop = dense_loop(reception.groups, reception.exchange)
    receivers, offsets, law = receivers_of(system, reception, loop, loop.coupling)
    received = [np.flatnonzero(receiver.received.any(axis=0)).tolist() for receiver in receivers]
    loss_channels = [(h, g, 0) for h, senders in enumerate(received) for g in senders]
    if len(loss_channels) > most:
        raise NotSupportedError(
            f"bursts of values that stand in on {len(loss_channels)} ways: {most} are the most that are "
            "followed"
        )
    n = offsets[-1]
    width = max(np.diff(offsets))
    mean = np.zeros((n, n))
    terms, enters, reception_errors = list[Arcs](), list[Floats](), list[Floats]()
    for h, (receiver, senders) in enumerate(zip(receivers, received, strict=True)):
        rows = np.arange(offsets[h], offsets[h + 1])
        size = len(rows)
        counts = receiver.received[:, :, None, None]
        moved = np.concatenate(
            [value_of(by) * counts[:, g] for g, by in enumerate(receiver.received_from)], axis=-1
        )
        moved[..., rows] += value_of(receiver.local)
        chance = np.where(receiver.received, 1 - law.mean_loss, law.mean_loss)
        for count in range(len(senders) + 1):
            for lost in itertools.combinations(senders, count):
                factors = chance.copy()
                factors[:, lost] = 1 - 2 * receiver.received[:, lost]
                term = np.tensordot(factors[:, senders].prod(axis=1), moved, 1)
                if not lost:
                    mean[rows] = term
                    continue
                terms.append(tuple((h, g, 0) for g in lost))
                enters.append(np.zeros((n, width)))
                reception_errors.append(np.zeros((width, n)))
                enters[-1][rows, np.arange(size)] = 1.0
                reception_errors[-1][:size] = term
    known = np.stack([mean, np.full_like(mean, NEUTRAL)])
    basis = neutral_state(known, neutral_motions(loop), loop, offsets)
    listed = (
        tuple(terms),
        np.stack(enters),
        np.stack(reception_errors),
        loss_channels,
        [law] * len(loss_channels),
        offsets,
    )
    return _projected(mean, *listed, (range(0),) * len(loss_channels), basis, interchangeable)


def _projected(
    mean: Floats,
    terms: tuple[Arcs, ...],
    enters: Floats,
    reception_errors: Floats,
    loss_channels: Sequence[LossChannel],
    laws: Sequence[ChannelLaw],
    offsets: Sequence[int],
    held: tuple[range, ...],
    basis: Floats,
    interchangeable: bool,
) -> LossyFrame:
    """Return a frame whose motions `basis` (n, d), which nothing holds back, are projected out."""
    # At right angles: peers may still change places.
    project = np.eye(len(basis)) - basis @ np.linalg.pinv(basis)
    mean, enters, reception_errors = project @ mean @ project, project @ enters, reception_errors @ project
    scale = balance(np.abs(mean) + (np.abs(enters) @ np.abs(reception_errors)).max(axis=0, initial=0.0))
    if interchangeable:  # the same for all peers and channels, powers of two
        for rows in (np.arange(offsets[1]) + np.array(offsets[:-1])[:, None], np.array(held, np.intp)):
            scale[rows] = 2.0 ** np.round(np.log2(scale[rows]).mean(axis=0))
    return LossyFrame(
        mean=mean / scale[:, None] * scale,
        terms=terms,
        input=enters / scale[:, None],
        reception_errors=reception_errors * scale,
        arcs=tuple(loss_channels),
        laws=tuple(laws),
        offsets=tuple(offsets),
        stored=held,
        scale=scale,
        at=relative_coordinates(basis),
        interchangeable=interchangeable,
    )
