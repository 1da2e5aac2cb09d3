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
from apc.compiler.weights import arcs
from apc.extensions.loss_models.self_substitution import receivers_of
from apc.lifting.interval_arithmetic import value_of
from apc.mean_square.class_moments import PerTickReception, neutral_motions, stored_of
from apc.mean_square.mean_dynamics import ReceivedChannel, mean_loop, with_stored_values
from apc.network.channel import ChannelLaw, channel_law
from apc.spectrum.matrix_norms import balance
from apc.spectrum.modes import dense_loop
from apc.spectrum.relative_coordinates import Relative, relative_coordinates
from apc.support.not_supported import NotSupportedError

Floats = NDArray[np.float64]

# A channel: receiver, sender, and the number of its link and delay class.
LossChannel = tuple[int, int, int]
Arcs = tuple[LossChannel, ...]

# The float error allowed in the frame map of a neutral mode.
NEUTRAL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class LossyFrame:
    """A (n, n), and U_S (n, m) and F_S (m, n) of each set of channels in `terms`.

    States are divided by `scale` (n,); the states of each peer start at `offsets`; `stored` are the states
    of each channel. Neutral modes are projected out; `coordinates` are relative to them. `interchangeable` is
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
    coordinates: Relative
    interchangeable: bool

    @property
    def peers(self) -> int:
        """The number of peers."""
        return len(self.offsets) - 1


def refuse_unheld(model: Model, reception: PerTickReception) -> None:
    """Raise an error unless receivers hold the last received value, with one packet per frame.

    Raises
    ------
    NotSupportedError
        The link that is not supported, and the reason.
    """
    rows = [row for group_rows in reception.rows.values() for row in group_rows]
    clocks = {clock.name: clock for clock in model.clocks}
    for link in model.links:
        if len(link.clocks) > 1:
            raise NotSupportedError(f"pairs of groups of {link.name} have different clocks")
        for channel in link.channels:
            if channel.trace is not None:
                raise NotSupportedError(f"{link.name} has a trace")
            if channel.jitter is not None:
                raise NotSupportedError(f"{link.name} has jitter")
            if channel.on_loss != "hold":
                message = f"does not set the difference to 0 for a lost packet (on_loss: {channel.on_loss})"
                raise NotSupportedError(f"{link.name} {message}")
        if link.channel is None:
            continue
        if reception.timings[clocks[link.clock].period] < reception.frame:
            message = f"more than one packet in a frame of {float(reception.frame):g} s"
            raise NotSupportedError(f"{link.name} sends {message}")
        if not {row.coupling_term.operator for row in rows if row.coupling_term.link == link.name} <= {
            "mean",
            "sum",
        }:
            raise NotSupportedError(f"{link.name} has functions other than mean and sum")


def channels_of(link: Link, peers: int) -> int:
    """Return the number of channels of a link: its directed pairs of peers."""
    return peers * (peers - 1) if link.graph.shape == "complete" else len(arcs(link.graph, peers)[0])


def hold_frame(model: Model, reception: PerTickReception, *, interchangeable: bool = False) -> LossyFrame:
    """Return the lossy frame of peers whose receivers hold the last received value.

    Parameters
    ----------
    model, reception
        The model and its peers.
    interchangeable
        Whether the peers are exchangeable.
    """
    modal_system = dense_loop(reception.peer_classes, reception.comm_graph)
    memories = stored_of(model, reception, modal_system)
    links = {link.name: link for link in model.links}
    received_channels, loss_channels, laws = list[ReceivedChannel](), list[LossChannel](), list[ChannelLaw]()
    for number, memory in enumerate(memory for memory in memories if any(memory.sizes)):
        routes = [
            coupling_term
            for coupling_term in modal_system.coupling
            if (coupling_term.link, coupling_term.delay) == memory.route
        ]
        for g, h in itertools.product(range(len(modal_system.peer_classes)), repeat=2):
            weights = {coupling_term: modal_system.coupling[coupling_term][g][h] for coupling_term in routes}
            if any(weights.values()):
                received_channels.append(ReceivedChannel(g, memory.route, weights))
                loss_channels.append((g, h, number))
                laws.append(channel_law(model, links[memory.route[0]], memory.route[1]))
    no_neutral_modes = np.zeros((sum(len(peer_class.z_names) for peer_class in modal_system.peer_classes), 0))
    means = mean_loop(modal_system, reception.of(modal_system), memories, received_channels, no_neutral_modes)
    matrix, first = value_of(means.matrix), means.offsets[-1]
    noise = [index for channel in means.channels for index in channel.noise]
    states = np.delete(np.arange(len(matrix)), noise)
    width = max((len(channel.noise) for channel in means.channels), default=0)
    noise_inputs, reception_errors = (
        np.zeros((len(loss_channels), len(states), width)),
        np.zeros((len(loss_channels), width, len(states))),
    )
    for c, (channel, (_, sender, _), received_channel) in enumerate(
        zip(means.channels, loss_channels, received_channels, strict=True)
    ):
        error = value_of(means.reception_errors[sender, received_channel.route, 0])
        if error[:, noise].any():
            raise NotSupportedError("a packet depends on another packet of the same frame")
        error = error + value_of(channel.reception_errors[0])
        noise_inputs[c, :, : len(channel.noise)] = -matrix[states][:, list(channel.noise)]
        reception_errors[c, : len(channel.noise)] = error[:, states]
    ends = np.cumsum([first, *(len(channel.stored) for channel in means.channels)]).tolist()
    stored = tuple(map(range, ends, ends[1:]))
    neutral, loop_matrix = neutral_motions(modal_system), means.matrix[:, :first, :first]
    basis = np.zeros((len(states), neutral.shape[1]))
    basis[:first] = with_stored_values(loop_matrix, neutral, modal_system, means.offsets)
    mean, offsets = matrix[np.ix_(states, states)], means.offsets
    terms = tuple((coupling_term,) for coupling_term in loss_channels)
    return _projected(
        mean,
        terms,
        noise_inputs,
        reception_errors,
        loss_channels,
        laws,
        offsets,
        stored,
        basis,
        interchangeable,
    )


def substitution_frame(
    model: Model, reception: PerTickReception, most: int, *, interchangeable: bool = False
) -> LossyFrame:
    """Return the lossy frame of peers that substitute their own values for missing ones.

    Parameters
    ----------
    model, reception
        The model and its peers.
    most
        The limit of channels.
    interchangeable
        Whether the peers are exchangeable.

    Raises
    ------
    NotSupportedError
        More channels than the limit.

    Notes
    -----
    A peer receives a_g = 0 or 1 packets of sender g. The indicator of 1 is 1 − λ − ν_g, that of 0 is λ + ν_g.
    The frame map is the sum over all outcomes of the product of their indicators times their transition
    matrix: the part without ν is A, and the factor of ν_S is F_S.
    """
    modal_system = dense_loop(reception.peer_classes, reception.comm_graph)
    receivers, offsets, law = receivers_of(model, reception, modal_system, modal_system.coupling)
    senders_of_peers = [np.flatnonzero(receiver.received.any(axis=0)).tolist() for receiver in receivers]
    loss_channels = [(h, g, 0) for h, senders in enumerate(senders_of_peers) for g in senders]
    if len(loss_channels) > most:
        raise NotSupportedError(
            f"bursts with substituted values on {len(loss_channels)} directed connections; "
            f"the limit is {most}"
        )
    n = offsets[-1]
    width = max(np.diff(offsets))
    mean = np.zeros((n, n))
    terms, noise_inputs, reception_errors = list[Arcs](), list[Floats](), list[Floats]()
    for h, (receiver, senders) in enumerate(zip(receivers, senders_of_peers, strict=True)):
        rows = np.arange(offsets[h], offsets[h + 1])
        size = len(rows)
        # An outcome (m of them) is which packets are received: 0 or 1 of each sender.
        outcomes = receiver.received[:, :, None, None]
        transitions = np.concatenate(
            [
                value_of(sender_matrix) * outcomes[:, g]
                for g, sender_matrix in enumerate(receiver.received_from)
            ],
            axis=-1,
        )
        transitions[..., rows] += value_of(receiver.local_map)
        probabilities = np.where(receiver.received, 1 - law.mean_loss, law.mean_loss)
        for lost_count in range(len(senders) + 1):
            for lost in itertools.combinations(senders, lost_count):
                factors = probabilities.copy()
                # The factor of ν in the indicator: 1 for a lost packet, −1 for a received one.
                factors[:, lost] = 1 - 2 * receiver.received[:, lost]
                term = np.tensordot(factors[:, senders].prod(axis=1), transitions, 1)
                if not lost:
                    mean[rows] = term
                    continue
                terms.append(tuple((h, g, 0) for g in lost))
                noise_inputs.append(np.zeros((n, width)))
                reception_errors.append(np.zeros((width, n)))
                noise_inputs[-1][rows, np.arange(size)] = 1.0
                reception_errors[-1][:size] = term
    bounded_mean = np.stack([mean, np.full_like(mean, NEUTRAL)])
    basis = with_stored_values(bounded_mean, neutral_motions(modal_system), modal_system, offsets)
    parts = (
        tuple(terms),
        np.stack(noise_inputs),
        np.stack(reception_errors),
        loss_channels,
        [law] * len(loss_channels),
        offsets,
    )
    return _projected(mean, *parts, (range(0),) * len(loss_channels), basis, interchangeable)


def _projected(
    mean: Floats,
    terms: tuple[Arcs, ...],
    noise_inputs: Floats,
    reception_errors: Floats,
    loss_channels: Sequence[LossChannel],
    laws: Sequence[ChannelLaw],
    offsets: Sequence[int],
    stored: tuple[range, ...],
    basis: Floats,
    interchangeable: bool,
) -> LossyFrame:
    """Return a lossy frame with the neutral modes projected out, over scaled states.

    Parameters
    ----------
    mean, terms, noise_inputs, reception_errors
        A, the sets S of channels, U_S and F_S, as in `LossyFrame`.
    loss_channels, laws, offsets, stored
        The channels with their laws, the first state of each peer, and the states of each channel.
    basis
        The neutral modes (n, d).
    interchangeable
        Whether the peers are exchangeable.
    """
    # An orthogonal projection keeps the symmetry of exchangeable peers.
    projection = np.eye(len(basis)) - basis @ np.linalg.pinv(basis)
    mean, noise_inputs, reception_errors = (
        projection @ mean @ projection,
        projection @ noise_inputs,
        reception_errors @ projection,
    )
    scale = balance(np.abs(mean) + (np.abs(noise_inputs) @ np.abs(reception_errors)).max(axis=0, initial=0.0))
    if interchangeable:  # the same for all peers and channels, powers of two
        for rows in (np.arange(offsets[1]) + np.array(offsets[:-1])[:, None], np.array(stored, np.intp)):
            scale[rows] = 2.0 ** np.round(np.log2(scale[rows]).mean(axis=0))
    return LossyFrame(
        mean=mean / scale[:, None] * scale,
        terms=terms,
        input=noise_inputs / scale[:, None],
        reception_errors=reception_errors * scale,
        arcs=tuple(loss_channels),
        laws=tuple(laws),
        offsets=tuple(offsets),
        stored=stored,
        scale=scale,
        coordinates=relative_coordinates(basis),
        interchangeable=interchangeable,
    )
