"""The packets of one frame of all peers, as they are sent, remembered and heard.

Takes: the members of a population, the exchange between them, the gates of unreliable links.
Gives: `FramePackets`.
Guarantees: sums and means over a complete graph cost one addition a peer, over any other graph one product
an arc.
Does not: move a peer (see `writing`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import casadi
import numpy as np

from apc.compiler.compiled import CompiledSystem
from apc.compiler.weights import sum_weights
from apc.frame.exchange import Exchange, check_mean
from apc.frame.schedule import Heard, Sent
from apc.network.gathering import Gate, Gathering
from apc.network.weights import weight_matrix
from apc.simulation.member import Member
from apc.simulation.pairs import Pairs
from apc.simulation.program import Segment, seconds_at


class FramePackets:
    """The packets of one frame, as they are sent, remembered and heard."""

    def __init__(
        self, system: CompiledSystem, exchange: Exchange, members: Sequence[Member], gates: Sequence[Gate]
    ) -> None:
        self.system, self.exchange, self.members = system, exchange, members
        self.gathering = Gathering(gates, exchange, members, self.packet)
        self.old: dict[tuple[int, Sent, int], Any] = {}  # (group, what, frames ago)
        self.new: dict[tuple[int, Sent], Any] = {}
        self.totals: dict[tuple[Sent, int, tuple[int, ...]], Any] = {}
        self.weights: dict[tuple[str, bool], Any] = {}
        self.sending = {
            link.name: [any(one.link == link.name for one in m.program.kind.sends) for m in members]
            for link in system.links
        }
        self.pairs = Pairs(exchange, members, self.sending, self.gathering, self._packet)

    def remember(self, histories: Sequence[Any]) -> None:
        """Take in what was sent in earlier frames."""
        for g, (member, history) in enumerate(zip(self.members, histories, strict=True)):
            row = 0
            schedule = member.program.schedule
            for sent, depth in zip(schedule.sent, schedule.depths, strict=True):
                for ago in range(1, depth + 1):
                    self.old[g, sent, ago] = history[row, :]
                    row += 1

    def send(self, group: int, segment: Segment, sent: Any) -> None:
        """Take in what a group sends in a segment."""
        schedule = self.members[group].program.schedule
        for place, row in enumerate(segment.sent):
            self.new[group, schedule.sent[row]] = sent[place, :]
        self.gathering.renew()

    def histories(self) -> list[Any]:
        """Return what is remembered when the frame ends."""
        result = []
        for g, member in enumerate(self.members):
            rows = []
            for sent, depth in zip(member.program.schedule.sent, member.program.schedule.depths, strict=True):
                listed = [self.new[g, sent], *(self.old[g, sent, ago] for ago in range(1, depth))]
                rows += listed[:depth]
            result.append(casadi.vertcat(*rows) if rows else casadi.MX(0, member.count))
        return result

    def hear(self, group: int, segment: Segment) -> Any:
        """Return what a group hears in a segment, a column a peer."""
        schedule = self.members[group].program.schedule
        rows = [self._heard(group, schedule.heard[row]) for row in segment.heard]
        return casadi.vertcat(*rows) if rows else casadi.MX(0, self.members[group].count)

    def look(
        self, group: int, segment: Segment, carry: Any, constants: Any, number: Any, ready: Mapping[int, Any]
    ) -> list[Any]:
        """Return what a group hears pair by pair as a segment begins, a column a peer.

        Parameters
        ----------
        group, segment
            The member's place, and the segment of its program.
        carry, constants
            What it knows as the segment begins, and its constants: a column a peer.
        number
            The number of the frame.
        ready
            The pair functions in the form in which they run, by the `id` of the original.
        """
        schedule, found = self.members[group].program.schedule, []
        for one in segment.pairs:
            own = casadi.vertcat(carry[list(one.carry), :], constants[list(one.constants), :])
            t = seconds_at(schedule, number, one.now)
            rows = [schedule.heard[row] for row in one.heard]
            found.append(self.pairs.hear(group, rows, own, t, ready[id(one.pair.function)]))
        return found

    def packet(self, group: int, sent: Sent, ago: int) -> Any:
        """Return what a group sent some frames ago, a column a peer: zeros if that is nothing, or later."""
        found = self.old.get((group, sent, ago)) if ago else self.new.get((group, sent))
        return casadi.MX(1, self.members[group].count) if found is None else found

    def _packet(self, group: int, heard: Heard) -> Any:
        return self.old[group, heard.sent, heard.lag] if heard.lag else self.new[group, heard.sent]

    def _heard(self, listener: int, heard: Heard) -> Any:
        if heard.clock:
            return self.gathering.hear(listener, heard)
        way, exchange = heard.way, self.exchange
        own = self.members[listener].group
        senders = [
            h
            for h, does in enumerate(self.sending[way.link])
            if does and exchange.delay(way.link, self.members[h].group, own) == way.delay
        ]
        count = self.members[listener].count
        if not exchange.is_complete(way.link):
            total = casadi.MX.zeros(1, count)
            for h in senders:
                matrix = self._weights(way.link, way.operator == "mean", h, listener)
                if matrix.nnz():
                    total = total + self._packet(h, heard) @ matrix
            return total
        key = (heard.sent, heard.lag, tuple(senders))
        if key not in self.totals:
            self.totals[key] = casadi.sum2(casadi.horzcat(*(self._packet(h, heard) for h in senders)))
        total = casadi.repmat(self.totals[key], 1, count)
        if listener in senders:
            total = total - self._packet(listener, heard)
        if way.operator == "mean":
            listed = zip(self.members, self.sending[way.link], strict=True)
            everybody = sum(member.count for member, does in listed if does)
            total = total / (everybody - int(self.sending[way.link][listener]))
        return total

    def _weights(self, link: str, mean: bool, sender: int, receiver: int) -> Any:
        """Return what each peer of a group weighs each of another by, (senders, receivers), sparse."""
        import scipy.sparse

        exchange = self.exchange
        if (link, mean) not in self.weights:
            pairs, weights = exchange.arcs(link)
            n = exchange.peers
            whole = scipy.sparse.coo_array((weights, (pairs[:, 0], pairs[:, 1])), shape=(n, n)).tocsc()
            if mean:
                sums = sum_weights(pairs[:, 1], weights, n).floats
                for peer in np.flatnonzero(sums == 0):
                    if self._averages(int(peer), link):
                        hears = bool((pairs[:, 1] == peer).any())
                        check_mean(exchange, int(peer), link, "mean", hears, Fraction(0))
                whole = whole @ scipy.sparse.diags_array(1 / np.where(sums == 0, 1.0, sums))
            self.weights[link, mean] = whole.tocsc()
        columns = self.weights[link, mean][:, self.members[receiver].peers]
        block = columns.tocsr()[self.members[sender].peers].tocoo()
        return weight_matrix(block.data, block.row, block.col, block.shape)

    def _averages(self, peer: int, link: str) -> bool:
        """Say whether a peer takes a mean over a link."""
        group = int(np.searchsorted(self.exchange.starts, peer, side="right")) - 1
        heard = next(one for one in self.members if one.group == group).program.schedule.heard
        return any(one.way.link == link and one.way.operator == "mean" for one in heard)
