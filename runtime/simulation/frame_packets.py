"""The packets of one frame of all peers, as they are sent, remembered and heard.

Takes: the members of a population, the exchange between them, the routes over unreliable links.
Gives: `FramePackets`.
Guarantees: sums and means over a complete graph cost one addition a peer, over any other graph one product
an arc; who sends nothing counts in no mean. A sender is heard by the packet that the schedule says, or, on an
unreliable link, the timetable.
Does not: move a peer (see `writing`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np

from apc.compiler.weights import sum_weights
from apc.frame.exchange import Exchange, check_mean
from apc.frame.schedule import Heard, Selected, Sent, Way
from apc.network.timetable import Route
from apc.simulation.pairs import Arcs, reduction
from apc.simulation.program import Member, Segment, seconds_at
from apc.simulation.selection import Selection


class FramePackets:
    """The packets of one frame, as they are sent, remembered and heard."""

    def __init__(self, exchange: Exchange, members: Sequence[Member], routes: Sequence[Route]) -> None:
        self.exchange, self.members = exchange, members
        self.selection = Selection(routes, members, self.packet)
        self.old: dict[tuple[int, Sent, int], Any] = {}  # (group, what, frames ago)
        self.new: dict[tuple[int, Sent], Any] = {}
        self.totals: dict[tuple[Sent, int, tuple[int, ...]], Any] = {}
        self.weights: dict[tuple[int, Way, str, int], Any] = {}
        self.known: dict[Any, tuple[int, Any]] = {}  # what looks at pairs, and at how many packets
        self.sending = {
            link: [any(one.link == link for one in m.program.kind.sends) for m in members]
            for link in exchange.links
        }
        # Of each peer of the scene: its member, and its place among that member's peers.
        self.member_of = np.empty(exchange.peers, np.int64)
        self.place_in = np.empty(exchange.peers, np.int64)
        for number, member in enumerate(members):
            self.member_of[member.peers] = number
            self.place_in[member.peers] = np.arange(member.count)

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
        self.selection.renew()

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
        rows = [self._heard(group, schedule.received[row]) for row in segment.heard]
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
            rows = [schedule.received[row] for row in one.heard]
            found.append(self._looked(group, rows, own, t, ready[id(one.function)]))
        return found

    def packet(self, group: int, sent: Sent, ago: int) -> Any:
        """Return what a group sent some frames ago, a column a peer: zeros if that is nothing, or later."""
        found = self.old.get((group, sent, ago)) if ago else self.new.get((group, sent))
        return casadi.MX(1, self.members[group].count) if found is None else found

    def _packet(self, group: int, heard: Heard) -> Any:
        return self.old[group, heard.sent, heard.lag] if heard.lag else self.new[group, heard.sent]

    def _heard(self, listener: int, row: Heard | Selected) -> Any:
        """Return what a plain sum or mean hears, or the weight of what it misses: one number a peer."""
        way, count = row.way, self.members[listener].count
        if isinstance(row, Selected):
            return self.selection.on_ways(row) @ self._weights(listener, way, row.clock)
        senders = self._senders(listener, way.link, way.delay)
        if not self.exchange.is_complete(way.link):
            total = casadi.MX.zeros(1, count)
            for h in senders:
                matrix = self._weights(listener, way, "", h)
                if matrix.nnz():
                    total = total + self._packet(h, row) @ matrix
            return total
        key = (row.sent, row.lag, tuple(senders))
        if key not in self.totals:
            self.totals[key] = casadi.sum2(casadi.horzcat(*(self._packet(h, row) for h in senders)))
        total = casadi.repmat(self.totals[key], 1, count)
        if listener in senders:
            total = total - self._packet(listener, row)
        if way.operator == "mean":
            listed = zip(self.members, self.sending[way.link], strict=True)
            everybody = sum(member.count for member, does in listed if does)
            total = total / (everybody - int(self.sending[way.link][listener]))
        return total

    def _looked(
        self, listener: int, rows: Sequence[Heard | Selected], own: Any, t: Any, function: Any
    ) -> Any:
        """Return what a member makes of each pair: `own` are its rows (rows, count)."""
        way, count = rows[0].way, self.members[listener].count
        clock = rows[0].clock if isinstance(rows[0], Selected) else ""
        delays = tuple(dict.fromkeys(one.way.delay for one in rows))
        key = (listener, way.operator, way.link, clock, delays, id(function))
        if key not in self.known:
            arcs = (
                self._unreliable(listener, way.link, clock)
                if clock
                else self._joined([self._reliable(listener, way.link, delay) for delay in delays])
            )
            self._check(listener, way.link, way.operator, arcs)
            arcs = arcs.averaging(count) if way.operator == "mean" else arcs
            self.known[key] = arcs.width, reduction(function, way.operator, arcs, count)
        width, reduced = self.known[key]
        # Each way has one delay; a tick's rows over an unreliable link hold all ways, whatever the delay they
        # are named by.
        selected = [one for one in rows if isinstance(one, Selected) and one.way.delay == delays[0]]
        if selected:
            sent = casadi.vertcat(*(self.selection.on_ways(one) for one in selected if not one.gap))
            gaps = [self.selection.on_ways(one) for one in selected if one.gap]
        else:
            heard = [one for one in rows if isinstance(one, Heard)]
            sent = casadi.horzcat(*(self._sent(listener, heard, delay) for delay in delays))
            gaps = []
        return reduced(own, sent, gaps[0] if gaps else casadi.MX(1, width), t)

    def _sent(self, listener: int, heard: Sequence[Heard], delay: str) -> Any:
        """Return what is heard of all senders with some delay, a column a sender."""
        senders = self._senders(listener, heard[0].way.link, delay)
        rows = [one for one in heard if one.way.delay == delay]
        return casadi.vertcat(*(casadi.horzcat(*(self._packet(h, one) for h in senders)) for one in rows))

    # ---- who hears whom

    def _senders(self, listener: int, link: str, delay: str) -> list[int]:
        """Return the members that a member can hear over a reliable link with some delay."""
        own = self.members[listener].group
        return [
            h
            for h, does in enumerate(self.sending[link])
            if does and self.exchange.delay(link, self.members[h].group, own) == delay
        ]

    def _weights(self, listener: int, way: Way, clock: str, sender: int = -1) -> Any:
        """Return what each peer of a member weighs what it hears on a way by (heard, count), sparse.

        What is heard are the packets of the member `sender`, or those on the ways of an unreliable link.
        """
        key = (listener, way, clock, sender)
        if key not in self.weights:
            link, count = way.link, self.members[listener].count
            every = self._unreliable(listener, link, clock) if clock else self._reliable(listener, link)
            if way.operator == "mean":  # over all delays
                self._check(listener, link, "mean", every)
                every = every.averaging(count)
            if clock:
                pairs = self.selection.routes[link, clock].pairs[every.senders]
                groups = np.searchsorted(self.exchange.starts, pairs[:, 0], side="right") - 1
                own = self.members[listener].group
                delays = [self.exchange.delay(link, int(group), own) for group in groups]
                arcs = every.chosen(np.array(delays) == way.delay)
            else:
                first = sum(self.members[h].count for h in self._all_senders(link) if h < sender)
                width = self.members[sender].count
                arcs = every.chosen((every.senders >= first) & (every.senders < first + width))
                arcs = replace(arcs, senders=arcs.senders - first, width=width)
            self.weights[key] = arcs.matrix(count)
        return self.weights[key]

    def _all_senders(self, link: str) -> list[int]:
        return [h for h, does in enumerate(self.sending[link]) if does]

    def _unreliable(self, listener: int, link: str, clock: str) -> Arcs:
        """Return the arcs over an unreliable link, each of which has packets of its own."""
        route = self.selection.routes[link, clock]
        mine = np.flatnonzero(self.member_of[route.pairs[:, 1]] == listener)
        receivers = self.place_in[route.pairs[mine, 1]]
        return Arcs(mine, receivers, route.weights[mine], len(route.pairs))

    def _reliable(self, listener: int, link: str, delay: str | None = None) -> Arcs:
        """Return the arcs over a reliable link from those who send over it, with some delay or any."""
        senders = self._all_senders(link) if delay is None else self._senders(listener, link, delay)
        widths = [self.members[h].count for h in senders]
        first = np.zeros(len(self.members), np.int64)
        first[senders] = np.cumsum([0, *widths])[:-1]
        if self.exchange.is_complete(link):
            hearing = self.members[listener].peers
            numbers = np.concatenate([self.members[h].peers for h in senders])
            places, receivers = (one.ravel() for one in np.indices((len(numbers), len(hearing))))
            others = numbers[places] != hearing[receivers]
            return Arcs(places, receivers, np.ones(len(places)), len(numbers)).chosen(others)
        pairs, weights = self.exchange.arcs(link)
        group_of, receiver_of = self.member_of[pairs[:, 0]], self.member_of[pairs[:, 1]]
        used = np.isin(group_of, senders) & (receiver_of == listener)
        places = first[group_of[used]] + self.place_in[pairs[used, 0]]
        return Arcs(places, self.place_in[pairs[used, 1]], weights[used], sum(widths))

    @staticmethod
    def _joined(parts: Sequence[Arcs]) -> Arcs:
        """Return the arcs of one delay after those of another."""
        first = np.cumsum([0, *(one.width for one in parts)])
        return Arcs(
            np.concatenate([one.senders + start for one, start in zip(parts, first[:-1], strict=True)]),
            np.concatenate([one.receivers for one in parts]),
            np.concatenate([one.weights for one in parts]),
            int(first[-1]),
        )

    def _check(self, listener: int, link: str, operator: str, arcs: Arcs) -> None:
        """Refuse a mean, maximum or minimum over nobody, or a mean whose weights add up to 0."""
        if operator == "sum":
            return
        member = self.members[listener]
        hears = np.bincount(arcs.receivers, minlength=member.count) > 0
        totals = sum_weights(arcs.receivers, arcs.weights, member.count).floats
        enough = hears & (totals != 0) if operator == "mean" else hears
        for place in np.flatnonzero(~enough).tolist():
            peer = int(member.peers[place])
            check_mean(self.exchange, peer, link, operator, bool(hears[place]), Fraction(0))
