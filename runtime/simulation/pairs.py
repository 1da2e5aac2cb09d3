"""Reductions that look at each pair of peers, within the frame of all peers.

Takes: a kind's receives over an edge function, or of a maximum or minimum; the packets of a frame.
Gives: `PairFunction`, `pair_function`, `Pairwise`; `Pairs`, their part of the frame's function;
`count_pairs`.
Guarantees: one evaluation a pair of peers that hear each other, by one function for all of them; a sender is
heard by the packet that the schedule or the timetable says, as in a plain sum.
Does not: say when anything is sent or heard (see `scheduling`), or keep packets (see `population`).

    r_i = op_j e(x_i, u_i, m_i, s_ij, p_i, t)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.weights import sum_weights
from apc.frame.exchange import Exchange, check_mean
from apc.frame.jacobians import edge_name
from apc.frame.schedule import Heard
from apc.network.gathering import Gathering, GroupPeers
from apc.network.weights import weight_matrix

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Packet = Callable[[int, Heard], Any]  # of a member, over a reliable link: one number a peer, in a row

JOINS = {"max": casadi.fmax, "min": casadi.fmin}


@dataclass(frozen=True, slots=True)
class PairFunction:
    """What one peer makes of another: `function(own, s, missing, t) -> value`.

    `own` are the rows of (x, u, m, p) that matter, counted through; `s` are the channels that are heard;
    `missing` is 1 where what the peer would itself send stands in for a packet, else 0.
    """

    function: Any  # casadi.Function
    own: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Pairwise:
    """A pair function at one tick of a peer's frame, the first instant of a segment.

    `carry` are the rows of the carry, `constants` those of the site's constants that make up `own`; `heard`
    are rows of the schedule; `now` is the instant in quanta.
    """

    pair: PairFunction
    carry: tuple[int, ...]
    constants: tuple[int, ...]
    heard: tuple[int, ...]
    now: int


@dataclass(frozen=True, slots=True, eq=False)
class _Listing:
    """The pairs (M,) of a member's peers with those they hear: `receivers` are places among its peers.

    `senders` are places among all that is heard, which is `width` packets wide.
    """

    senders: Integers
    receivers: Integers
    weights: Floats
    width: int


def pair_function(kind: Kind, partition: int, receive: int) -> PairFunction:
    """Build what a receive (of a clock partition of a kind) evaluates for each sender."""
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
    return PairFunction(casadi.Function("pair", arguments, [value]), tuple(own))


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


class Pairs:
    """The pairs of peers as symbols of the frame's function."""

    def __init__(
        self,
        exchange: Exchange,
        members: Sequence[GroupPeers],
        sending: Mapping[str, Sequence[bool]],
        gathering: Gathering,
        packet: Packet,
    ) -> None:
        """Begin a frame.

        Parameters
        ----------
        exchange, members
            Who hears whom.
        sending
            By link, which members send over it.
        gathering, packet
            What is heard over unreliable and over reliable links.
        """
        self.exchange, self.members, self.sending = exchange, members, sending
        self.gathering, self.packet = gathering, packet
        self._known: dict[Any, tuple[_Listing, Any]] = {}

    def hear(self, listener: int, heard: Sequence[Heard], own: Any, t: Any, function: Any) -> Any:
        """Return what a member hears at a tick: one number a peer, in a row.

        Parameters
        ----------
        listener
            The member.
        heard
            What each sender is heard by.
        own
            What matters of each of its peers (rows, count).
        t
            The time in seconds.
        function
            The pair function, to evaluate.
        """
        way = heard[0].way
        delays = tuple(dict.fromkeys(one.way.delay for one in heard))
        key = (listener, way.operator, way.link, heard[0].clock, delays, id(function))
        if key not in self._known:
            listing = (
                self._unreliable(listener, heard[0])
                if heard[0].clock
                else self._reliable(listener, way.link, delays)
            )
            self._check(listener, way.link, way.operator, listing)
            count = self.members[listener].count
            self._known[key] = listing, _reduction(function, way.operator, listing, count)
        listing, reduction = self._known[key]
        if heard[0].clock:
            # Each way has one delay; a tick's rows hold all ways, whatever the delay they are named by.
            rows = [one for one in heard if one.way.delay == delays[0]]
            sent = casadi.vertcat(*(self.gathering.on_ways(one) for one in rows if not one.gap))
            gaps = [self.gathering.on_ways(one) for one in rows if one.gap]
            missing = gaps[0] if gaps else casadi.MX(1, listing.width)
        else:
            sent = casadi.horzcat(*(self._sent(listener, heard, delay) for delay in delays))
            missing = casadi.MX(1, listing.width)
        return reduction(own, sent, missing, t)

    def _senders(self, listener: int, link: str, delay: str) -> list[int]:
        """Return the members that a member can hear with some delay."""
        own = self.members[listener].group
        return [
            h
            for h, does in enumerate(self.sending[link])
            if does and self.exchange.delay(link, self.members[h].group, own) == delay
        ]

    def _sent(self, listener: int, heard: Sequence[Heard], delay: str) -> Any:
        """Return what is heard of all senders with some delay, a column a sender."""
        senders = self._senders(listener, heard[0].way.link, delay)
        rows = [one for one in heard if one.way.delay == delay]
        return casadi.vertcat(*(casadi.horzcat(*(self.packet(h, one) for h in senders)) for one in rows))

    def _unreliable(self, listener: int, heard: Heard) -> _Listing:
        """Return the pairs over an unreliable link, on which each pair has a packet of its own."""
        route, peers = self.gathering.route(heard), self.members[listener].peers
        mine = np.flatnonzero(np.isin(route.pairs[:, 1], peers))
        receivers = np.searchsorted(peers, route.pairs[mine, 1])
        return _Listing(mine, receivers, route.weights[mine], len(route.pairs))

    def _reliable(self, listener: int, link: str, delays: Sequence[str]) -> _Listing:
        """Return the pairs over a reliable link, those of one delay after those of another."""
        listings, width = [], 0
        for delay in delays:
            one = self._list(listener, link, self._senders(listener, link, delay))
            listings.append(replace(one, senders=one.senders + width))
            width += one.width
        return _Listing(
            np.concatenate([one.senders for one in listings]),
            np.concatenate([one.receivers for one in listings]),
            np.concatenate([one.weights for one in listings]),
            width,
        )

    def _list(self, listener: int, link: str, senders: Sequence[int]) -> _Listing:
        """Return the pairs of a member with those of other members that it hears."""
        hearing = self.members[listener].peers
        numbers = np.concatenate([self.members[h].peers for h in senders])
        if self.exchange.is_complete(link):
            places, receivers = (one.ravel() for one in np.indices((len(numbers), len(hearing))))
            others = numbers[places] != hearing[receivers]
            places, receivers = places[others], receivers[others]
            return _Listing(places, receivers, np.ones(len(places)), len(numbers))
        pairs, weights = self.exchange.arcs(link)
        used = np.isin(pairs[:, 0], numbers) & np.isin(pairs[:, 1], hearing)
        order = np.argsort(numbers)
        places = order[np.searchsorted(numbers, pairs[used, 0], sorter=order)]
        return _Listing(places, np.searchsorted(hearing, pairs[used, 1]), weights[used], len(numbers))

    def _check(self, listener: int, link: str, operator: str, listing: _Listing) -> None:
        """Refuse a mean, maximum or minimum over nobody, or a mean whose weights add up to 0."""
        if operator == "sum":
            return
        member = self.members[listener]
        hears = np.bincount(listing.receivers, minlength=member.count) > 0
        totals = sum_weights(listing.receivers, listing.weights, member.count).floats
        enough = hears & (totals != 0) if operator == "mean" else hears
        for place in np.flatnonzero(~enough).tolist():
            peer = int(member.peers[place])
            check_mean(self.exchange, peer, link, operator, bool(hears[place]), Fraction(0))


def _reduction(pair: Any, operator: str, listing: _Listing, count: int) -> Any:
    """Return the function (own, s of all that is heard, missing, t) -> what each of `count` peers hears."""
    own = casadi.MX.sym("own", pair.size1_in(0), count)
    sent = casadi.MX.sym("s", pair.size1_in(1), listing.width)
    missing, t = casadi.MX.sym("missing", 1, listing.width), casadi.MX.sym("t")
    senders, receivers, weights = listing.senders.tolist(), listing.receivers, listing.weights
    if not senders:
        result = casadi.MX.zeros(1, count)
    else:
        every = pair.map(len(senders))
        values = every(own[:, receivers.tolist()], sent[:, senders], missing[:, senders], t)
        if operator in JOINS:
            result = _joined(values, receivers, JOINS[operator])
        else:
            if operator == "mean":
                weights = weights / sum_weights(receivers, weights, count).floats[receivers]
            places, shape = np.arange(len(receivers)), (len(receivers), count)
            result = casadi.densify(values @ weight_matrix(weights, places, receivers, shape))
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
