"""Pairwise coupling: functions of a receiving peer and each sender, evaluated pair by pair.

Takes: a peer type's receives over an edge function, or of a maximum or minimum; the communication graph.
Gives: `pair_function`, `Pairwise`; `count_pairs`.
Guarantees: one function for all pairs.
Does not: determine times of sending and reception (see `scheduling`), or senders (see `exchange_program`).

    r_i = op_j e(x_i, u_i, m_i, s_ij, p_i, t)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from apc.compiler.compiled import Model, PeerType
from apc.linearization.jacobians import edge_name
from apc.timing.communication_graph import CommunicationGraph


@dataclass(frozen=True, slots=True)
class Pairwise:
    """The pairwise function of one peer at one tick of its frame, at the start of a segment.

    `function` is that of `pair_function`. `carry` are the rows of the carry, and `constants` the rows of the
    subsystem's constants, that form its argument `local`; `received` are the received rows of the schedule;
    `now` is the instant in quanta.
    """

    function: Any  # casadi.Function
    carry: tuple[int, ...]
    constants: tuple[int, ...]
    received: tuple[int, ...]
    now: int


def pair_function(peer_type: PeerType, partition: int, receive: int) -> tuple[Any, tuple[int, ...]]:
    """Return the pairwise function of a receive of a clock partition, and the rows of (x, u, m, p) that
    it reads.

    Returns
    -------
    The casadi.Function (own, s, missing, t) -> value; the rows of (x, u, m, p), numbered consecutively, that
    are its argument `own`. `s` are the received channels; `missing` is 1 if the peer's own value replaces a
    missing packet, else 0.

    Returns
    -------
    The casadi.Function (own, s, missing, t) -> value, and the rows of (x, u, m, p), numbered consecutively,
    that are the relevant `local` values. `s` are the received channels; `missing` is 1 if the peer's own
    value substitutes a packet, else 0.
    """
    clock = peer_type.clocks[partition]
    receiving = clock.receives[receive]
    sending = next((send for send in peer_type.sends if send.link == receiving.link), None)
    sizes = (len(peer_type.states), len(peer_type.holds), len(clock.memories), len(peer_type.parameters))
    x, u, m, p = (casadi.SX.sym("local", size) for size in sizes)
    t, missing = casadi.SX.sym("t"), casadi.SX.sym("missing")

    def value_for(s: Any) -> Any:
        """Return the value of the receive for the channels s of one sender."""
        return s[receiving.channel] if receiving.edge is None else receiving.edge(x, u, m, s, p, t)

    sent = casadi.SX.sym(
        "s",
        receiving.channel + 1 if receiving.edge is None else receiving.edge.numel_in(3),
    )
    channels = _rows_used(value_for(sent), sent)
    received = sent
    if sending is not None:
        own_packet = sending.send(x, u, p, t)
        received = casadi.vertcat(*(sent[row] + missing * own_packet[row] for row in range(sent.numel())))
    value = casadi.densify(value_for(received))
    own_values = casadi.vertcat(x, u, m, p)
    used_rows = _rows_used(value, own_values)
    arguments = [_rows(own_values, used_rows), _rows(sent, channels), missing, t]
    return casadi.Function("pair", arguments, [value]), tuple(used_rows)


def _rows_used(value: Any, symbols: Any) -> list[int]:
    """Return the rows of a column vector on which a value depends."""
    return sorted(set(casadi.jacobian(value, symbols).sparsity().get_triplet()[1]))


def _rows(symbols: Any, indices: Sequence[int]) -> Any:
    """Return the rows of a column vector with these indices, in this order."""
    return casadi.vertcat(*(symbols[index] for index in indices)) if indices else casadi.SX(0, 1)


def count_pairs(model: Model, comm_graph: CommunicationGraph) -> int:
    """Return the number of pairwise evaluations at one tick, summed over all links."""
    links = {
        receive.link
        for peer_type in model.peer_types
        for partition in peer_type.clocks
        for receive in partition.receives
        if edge_name(partition, receive)
    }
    n = comm_graph.peers
    return sum(
        n * (n - 1) if comm_graph.is_complete(link) else len(comm_graph.arcs(link)[0]) for link in links
    )
