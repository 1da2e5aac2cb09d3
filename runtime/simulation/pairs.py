"""What peers make of those they hear, where they look at each pair of peers.

Takes: a kind's receives over an edge function, or of a maximum or minimum; who hears whom.
Gives: `pair_function`, `Pairwise`; `count_pairs`.
Guarantees: one function for all pairs.
Does not: say when anything is sent or heard (see `scheduling`), or who hears whom (see `hearing`).

    r_i = op_j e(x_i, u_i, m_i, s_ij, p_i, t)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from apc.compiler.compiled import Model, PeerType
from apc.frame.exchange import CommunicationGraph
from apc.frame.jacobians import edge_name


@dataclass(frozen=True, slots=True)
class Pairwise:
    """What one peer makes of each other at one tick of its frame, the first instant of a segment.

    `function` is as `pair_function` gives it; `carry` are the rows of the carry, `constants` those of the
    site's constants that make up `own`; `heard` are rows of the schedule; `now` is the instant in quanta.
    """

    function: Any  # casadi.Function
    carry: tuple[int, ...]
    constants: tuple[int, ...]
    heard: tuple[int, ...]
    now: int


def pair_function(kind: PeerType, partition: int, receive: int) -> tuple[Any, tuple[int, ...]]:
    """Build what a receive (of a clock partition of a kind) evaluates for each sender.

    Returns
    -------
    The casadi.Function (own, s, missing, t) -> value, and which rows of (x, u, m, p), counted through, are
    `own`: those that matter. `s` are the channels that are heard; `missing` is 1 where what the peer would
    itself send stands in for a packet, else 0.
    """
    clock = kind.clocks[partition]
    hearing = clock.receives[receive]
    sending = next((send for send in kind.sends if send.link == hearing.link), None)
    sizes = (len(kind.states), len(kind.holds), len(clock.memories), len(kind.parameters))
    x, u, m, p = (casadi.SX.sym("own", size) for size in sizes)
    t, missing = casadi.SX.sym("t"), casadi.SX.sym("missing")

    def evaluated(s: Any) -> Any:
        return s[hearing.channel] if hearing.edge is None else hearing.edge(x, u, m, s, p, t)

    sent = casadi.SX.sym("s", hearing.channel + 1 if hearing.edge is None else hearing.edge.numel_in(3))
    channels = _rows_used(evaluated(sent), sent)
    heard = sent
    if sending is not None:
        stand_in = sending.send(x, u, p, t)
        heard = casadi.vertcat(*(sent[row] + missing * stand_in[row] for row in range(sent.numel())))
    value = casadi.densify(evaluated(heard))
    every = casadi.vertcat(x, u, m, p)
    numbers = _rows_used(value, every)
    arguments = [_rows(every, numbers), _rows(sent, channels), missing, t]
    return casadi.Function("pair", arguments, [value]), tuple(numbers)


def _rows_used(value: Any, symbols: Any) -> list[int]:
    """Return the rows of a column on which a value depends."""
    return sorted(set(casadi.jacobian(value, symbols).sparsity().get_triplet()[1]))


def _rows(symbols: Any, places: Sequence[int]) -> Any:
    return casadi.vertcat(*(symbols[place] for place in places)) if places else casadi.SX(0, 1)


def count_pairs(system: Model, exchange: CommunicationGraph) -> int:
    """Return how many pairs of peers look at each other at a tick, over all links."""
    links = {
        receive.link
        for kind in system.kinds
        for partition in kind.clocks
        for receive in partition.receives
        if edge_name(partition, receive)
    }
    n = exchange.peers
    return sum(n * (n - 1) if exchange.is_complete(link) else len(exchange.arcs(link)[0]) for link in links)
