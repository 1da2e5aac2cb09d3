"""Unreliable links within the frame of all peers: each way's packet is picked by a number that comes in.

Takes: the routes of a `Timetable`, the members of a population.
Gives: `Gate`, `build_gates`, `kept_links`; `Gathering`, their part of the frame's function; `Arrivals`, the
numbers that come in.
Guarantees: what a tick hears on a way is the packet its timetable says, at a cost of one step a way; the
memory kept is that of the longest delay, however long a packet stays in effect.
Does not: draw packets (see `packets`), or touch reliable links.

What a way can hear in a frame stands in one column, the candidates of a channel:

    0, what is held on each way since the last frame, then packet by packet of this frame and of those kept,
    the youngest frame first, every packet one number a peer.

A way's number is its row there; row 0 is what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Protocol

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.weights import sum_weights
from apc.frame.exchange import Exchange, check_mean
from apc.frame.schedule import Heard, Kept, Schedule, Sent
from apc.network.listener import START, Seen
from apc.network.timetable import Route, Timetable
from apc.network.weights import weight_matrix

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MISSING = 0  # the row of what is missing
Packet = Callable[[int, Sent, int], Any]  # of a member, a slot, frames ago: one number a peer, in a row


class GroupPeers(Protocol):
    """What a gathering asks of a member of a population: peers of one group."""

    @property
    def group(self) -> int:
        """The group's place in the scene."""

    @property
    def peers(self) -> Integers:
        """The peers' numbers in the scene."""

    @property
    def count(self) -> int:
        """The number of peers."""


@dataclass(frozen=True, slots=True, eq=False)
class Gate:
    """A route in the frame: `ticks` of its clock and `slots` of its link's a frame, `frames` of packets kept.

    `place` (N,) is where each peer of the scene stands in a packet; `channels` are what is heard.
    """

    route: Route
    channels: tuple[str, ...]
    ticks: int
    slots: int
    frames: int
    place: Integers

    @property
    def ways(self) -> int:
        """The number of ways."""
        return len(self.route.pairs)

    def rows(self, packets: Integers, held: Integers, frame: Integers) -> Integers:
        """Return the candidates' rows of packets.

        Parameters
        ----------
        packets
            The packets' numbers (ticks, M).
        held
            What is held since the last frame (ticks, M), by number.
        frame
            The number of the frame that each tick is in (ticks,).
        """
        ago = frame[:, None] - packets // self.slots
        assert ((packets == held) | ((ago >= 0) & (ago <= self.frames))).all(), "a packet is no longer kept"
        peers = len(self.place)
        sent = (ago * self.slots + packets % self.slots) * peers + self.place[self.route.pairs[:, 0]]
        return np.where(packets == held, 1 + np.arange(self.ways), 1 + self.ways + sent)


def kept_links(routes: Sequence[Route], frame_s: Fraction) -> dict[str, Kept]:
    """Return for how many frames the packets of each unreliable link are kept.

    A packet is first heard at most one tick after it arrives, and a clock ticks in every frame.
    """
    kept: dict[str, Kept] = {}
    for route in routes:
        frames = math.ceil(route.longest / float(frame_s)) + 1
        before = kept.get(route.link)
        kept[route.link] = Kept(max(frames, before.frames if before else 0), route.zero)
    return kept


def build_gates(
    routes: Sequence[Route],
    kept: Mapping[str, Kept],
    exchange: Exchange,
    schedules: Sequence[Schedule],
    members: Sequence[GroupPeers],
) -> tuple[Gate, ...]:
    """Return the gates of routes.

    Parameters
    ----------
    routes, kept
        What is heard over unreliable links, and as `kept_links` has it.
    exchange
        Who hears whom.
    schedules
        One a group, built with `kept`.
    members
        The members of the population, in their order.
    """
    place = np.empty(exchange.peers, np.int64)
    place[np.concatenate([member.peers for member in members])] = np.arange(exchange.peers)
    sent = {one for schedule in schedules for one in schedule.sent}
    frame_s = schedules[0].frame_s
    return tuple(
        Gate(
            route,
            tuple(sorted({one.channel for one in sent if one.link == route.link})),
            int(frame_s / route.period),
            int(frame_s / route.spacing),
            kept[route.link].frames,
            place,
        )
        for route in routes
    )


class Gathering:
    """The gates as symbols of the frame's function: what they hold, which rows come in, what comes out."""

    def __init__(
        self, gates: Sequence[Gate], exchange: Exchange, members: Sequence[GroupPeers], packet: Packet
    ) -> None:
        """Make the symbols; `packet` gives what was sent, or zeros for what isn't (or not yet)."""
        self.gates, self.exchange, self.members, self.packet = gates, exchange, members, packet
        self.held = [casadi.MX.sym("held", len(one.channels), one.ways) for one in gates]
        self._seen = [casadi.MX.sym("seen", one.ways, one.ticks) for one in gates]
        self._last = [casadi.MX.sym("last", one.ways) for one in gates]
        self._gaps = [casadi.MX.sym("gaps", one.ways, one.ticks if one.route.zero else 0) for one in gates]
        self._known: dict[tuple[int, str], Any] = {}
        self._weights: dict[tuple[int, int, str, str], Any] = {}

    @property
    def inputs(self) -> list[Any]:
        """What comes in: of each gate the rows at its ticks, at the frame's end, and what is missing."""
        listed = zip(self._seen, self._last, self._gaps, strict=True)
        return [symbol for one in listed for symbol in one]

    def hear(self, listener: int, heard: Heard) -> Any:
        """Return what a member hears at a tick, or the weight of what it misses: one number a peer."""
        return self.on_ways(heard) @ self._weigh(self._number(heard), listener, heard)

    def on_ways(self, heard: Heard) -> Any:
        """Return what is heard at a tick on each way of a gate, in a row, or 1 where something is missed."""
        number = self._number(heard)
        if heard.gap:
            return self._gaps[number][:, heard.tick].T
        rows = self._seen[number][:, heard.tick]
        return self._candidates(number, heard.sent.channel).get_nz(False, rows).T

    def route(self, heard: Heard) -> Route:
        """Return the ways on which it is heard."""
        return self.gates[self._number(heard)].route

    def _number(self, heard: Heard) -> int:
        gates = enumerate(self.gates)
        return next(n for n, g in gates if (g.route.link, g.route.clock) == (heard.way.link, heard.clock))

    def renew(self) -> None:
        """Take notice that something was sent."""
        self._known.clear()

    def finish(self) -> list[Any]:
        """Return what the gates hold when the frame ends."""
        return [
            casadi.vertcat(
                *(
                    self._candidates(number, channel).get_nz(False, self._last[number]).T
                    for channel in gate.channels
                )
            )
            for number, gate in enumerate(self.gates)
        ]

    def _candidates(self, number: int, channel: str) -> Any:
        if (number, channel) not in self._known:
            gate = self.gates[number]
            packets = [
                self.packet(member, Sent(gate.route.link, channel, slot), ago)
                for ago in range(gate.frames + 1)
                for slot in range(gate.slots)
                for member in range(len(self.members))
            ]
            held = self.held[number][gate.channels.index(channel), :]
            column = casadi.densify(casadi.horzcat(casadi.MX(1, 1), held, *packets)).T
            self._known[number, channel] = column
        return self._known[number, channel]

    def _weigh(self, number: int, listener: int, heard: Heard) -> Any:
        """Return what each peer of a member weighs each way by (M, count), sparse: those of one delay."""
        way = heard.way
        key = (number, listener, way.operator, way.delay)
        if key not in self._weights:
            self._weights[key] = self._weigh_afresh(number, listener, heard)
        return self._weights[key]

    def _weigh_afresh(self, number: int, listener: int, heard: Heard) -> Any:
        route, exchange, member = self.gates[number].route, self.exchange, self.members[listener]
        groups = np.searchsorted(exchange.starts, route.pairs[:, 0], side="right") - 1
        delays = [exchange.delay(route.link, int(group), member.group) for group in groups]
        mine = np.isin(route.pairs[:, 1], member.peers) & (np.array(delays) == heard.way.delay)
        weights = route.weights.copy()
        if heard.way.operator == "mean":
            totals = sum_weights(route.pairs[:, 1], route.weights, exchange.peers).floats
            for peer in member.peers[totals[member.peers] == 0].tolist():
                hears = bool((route.pairs[:, 1] == peer).any())
                check_mean(exchange, peer, route.link, "mean", hears, Fraction(0))
            weights /= totals[route.pairs[:, 1]]
        column = np.searchsorted(member.peers, route.pairs[mine, 1])
        shape = (len(route.pairs), member.count)
        return weight_matrix(weights[mine], np.flatnonzero(mine), column, shape)


class Arrivals:
    """The numbers that come in, frame by frame; time only goes forward."""

    def __init__(self, gates: Sequence[Gate], table: Timetable, frame: int) -> None:
        """Start at time 0; `frame` is in quanta."""
        self._gates, self._table, self._frame = gates, table, frame
        self._now = 0
        self._held = [np.full(gate.ways, START, np.int64) for gate in gates]

    def take(self, frames: int) -> list[Floats]:
        """Return what comes in for the next frames, in the order of `Gathering.inputs`, flat."""
        first = self._now
        self._now += frames
        found: list[Floats] = []
        for number, seen in enumerate(self._table.take(self._now * self._frame)):
            found += self._of_gate(number, seen, first, frames)
        return found

    def _of_gate(self, number: int, seen: Seen, first: int, frames: int) -> list[Floats]:
        gate = self._gates[number]
        last = seen.packets[gate.ticks - 1 :: gate.ticks]
        held = np.concatenate([self._held[number][None, :], last])
        self._held[number] = last[-1]
        numbers = first + np.arange(frames)
        rows = gate.rows(
            seen.packets, np.repeat(held[:-1], gate.ticks, axis=0), np.repeat(numbers, gate.ticks)
        )
        if gate.route.zero:
            rows = np.where(seen.missing, MISSING, rows)
        gaps = seen.missing if gate.route.zero else np.zeros((0, gate.ways))
        listed = (rows, gate.rows(last, held[:-1], numbers), gaps)
        return [one.astype(np.float64).reshape(-1) for one in listed]
