"""What peers make of those they hear: their weights, and reductions that look at each pair of peers.

Takes: a kind's receives over an edge function, or of a maximum or minimum; who hears whom.
Gives: `Arcs`; `pair_function`, `Pairwise`, `reduction`; `count_pairs`.
Guarantees: one evaluation a pair of peers that hear each other, by one function for all of them.
Does not: say when anything is sent or heard (see `scheduling`), or keep packets (see `frame_packets`).

    r_i = op_j e(x_i, u_i, m_i, s_ij, p_i, t)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.weights import sum_weights
from apc.frame.exchange import Exchange
from apc.frame.jacobians import edge_name

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

JOINS = {"max": casadi.fmax, "min": casadi.fmin}


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


@dataclass(frozen=True, slots=True, eq=False)
class Arcs:
    """Who of a member's peers hears whom, arc by arc (M,): `receivers` are places among those peers.

    `senders` are places in what is heard, which is `width` packets wide.
    """

    senders: Integers
    receivers: Integers
    weights: Floats
    width: int

    def chosen(self, which: NDArray[np.bool_]) -> Arcs:
        """Return some of the arcs."""
        return Arcs(self.senders[which], self.receivers[which], self.weights[which], self.width)

    def averaging(self, count: int) -> Arcs:
        """Return the same arcs with the weights of a mean: those of each of `count` peers add up to 1."""
        totals = sum_weights(self.receivers, self.weights, count).floats
        return replace(self, weights=self.weights / totals[self.receivers])

    def matrix(self, count: int) -> Any:
        """Return the weights as a casadi.DM (width, count): a product costs a multiplication an arc."""
        return _sparse(self.weights, self.senders, self.receivers, (self.width, count))


def pair_function(kind: Kind, partition: int, receive: int) -> tuple[Any, tuple[int, ...]]:
    """Build what a receive (of a clock partition of a kind) evaluates for each sender.

    Returns
    -------
    The casadi.Function (own, s, missing, t) -> value, and which rows of (x, u, m, p), counted through, are
    `own`: those that matter. `s` are the channels that are heard; `missing` is 1 where what the peer would
    itself send stands in for a packet, else 0.
    """
    clock = kind.clocks[partition]
    hearing = clock.receives[receive]
    sending = next((one for one in kind.sends if one.link == hearing.link), None)
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
    own = _rows_used(value, every)
    arguments = [_rows(every, own), _rows(sent, channels), missing, t]
    return casadi.Function("pair", arguments, [value]), tuple(own)


def _rows_used(value: Any, symbols: Any) -> list[int]:
    """Return the rows of a column on which a value depends."""
    return sorted(set(casadi.jacobian(value, symbols).sparsity().get_triplet()[1]))


def _rows(symbols: Any, places: Sequence[int]) -> Any:
    return casadi.vertcat(*(symbols[place] for place in places)) if places else casadi.SX(0, 1)


def count_pairs(system: CompiledSystem, exchange: Exchange) -> int:
    """Return how many pairs of peers look at each other at a tick, over all links."""
    links = {
        receive.link
        for kind in system.kinds
        for partition in kind.clocks
        for receive in partition.receives
        if edge_name(partition, receive)
    }
    n = exchange.peers
    return sum(n * (n - 1) if exchange.is_complete(one) else len(exchange.arcs(one)[0]) for one in links)


def reduction(pair: Any, operator: str, arcs: Arcs, count: int) -> Any:
    """Return the function (own, s of all that is heard, missing, t) -> what each of `count` peers hears.

    Parameters
    ----------
    pair
        A `pair_function`, in the form in which it runs.
    operator
        "sum", "mean", "max" or "min".
    arcs
        Who hears whom; of a mean as `Arcs.averaging` gives them.
    count
        How many peers the member has.
    """
    own = casadi.MX.sym("own", pair.size1_in(0), count)
    sent = casadi.MX.sym("s", pair.size1_in(1), arcs.width)
    missing, t = casadi.MX.sym("missing", 1, arcs.width), casadi.MX.sym("t")
    senders, receivers = arcs.senders.tolist(), arcs.receivers
    if not senders:
        result = casadi.MX.zeros(1, count)
    else:
        every = pair.map(len(senders))
        values = every(own[:, receivers.tolist()], sent[:, senders], missing[:, senders], t)
        if operator in JOINS:
            result = _joined(values, receivers, JOINS[operator])
        else:
            places, shape = np.arange(len(receivers)), (len(receivers), count)
            result = casadi.densify(values @ _sparse(arcs.weights, places, receivers, shape))
    return casadi.Function("look", [own, sent, missing, t], [result])


def _joined(values: Any, receivers: Integers, join: Callable[[Any, Any], Any]) -> Any:
    """Return the maximum or minimum of each receiver's values, two at a time: log₂ steps."""
    order = np.argsort(receivers, kind="stable")
    values, receivers = values[:, order.tolist()], receivers[order]
    while len(receivers) > len(np.unique(receivers)):
        first = np.searchsorted(receivers, receivers)  # where each one's receiver begins
        even = np.flatnonzero((np.arange(len(receivers)) - first) % 2 == 0)
        after = np.minimum(even + 1, len(receivers) - 1)
        # The last of an odd number is joined with itself.
        odd = np.where(receivers[after] == receivers[even], after, even)
        values = join(values[:, even.tolist()], values[:, odd.tolist()])
        receivers = receivers[even]
    return values


def _sparse(weights: Floats, rows: Integers, columns: Integers, shape: tuple[int, int]) -> Any:
    """Return the casadi.DM of this shape with each weight (k,) at its row and its column."""
    import scipy.sparse

    whole = scipy.sparse.coo_array((weights, (rows, columns)), shape=shape).tocsc()
    whole.sort_indices()  # CasADi wants the rows of a column in order
    return casadi.DM(whole)
