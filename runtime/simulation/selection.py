"""Packet selection: what each tick hears on the ways of unreliable links, picked by numbers that come in.

Takes: the routes of a `Timetable`, the members of a population.
Gives: `Selection`, its part of the frame's function; `Arrivals`, the numbers that come in.
Guarantees: what a tick hears on a way is the packet its timetable says, at a cost of one step a way; the
memory kept is that of the longest delay, however long a packet stays in effect.
Does not: draw packets (see `timetable`), weigh what is heard (see `frame_packets`), or touch reliable links.

What a way can hear in a frame stands in one column, the candidates of a channel:

    0, what is held on each way since the last frame, then packet by packet of this frame and of those kept,
    the youngest frame first, every packet one number a peer.

A way's number is its row there; row 0 is what is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.frame.schedule import Selected, Sent
from apc.network.timetable import START, Route, Seen, Timetable
from apc.simulation.program import Member

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MISSING = 0  # the row of what is missing
Packet = Callable[[int, Sent, int], Any]  # of a member, a slot, frames ago: one number a peer, in a row


class Selection:
    """The routes as symbols of the frame's function: what they hold, which rows come in, what comes out."""

    def __init__(self, routes: Sequence[Route], members: Sequence[Member], packet: Packet) -> None:
        """Make the symbols; `packet` gives what was sent, or zeros for what isn't (or not yet)."""
        self.members, self.packet = members, packet
        self.routes = {(one.link, one.clock): one for one in routes}
        sent = {one for member in members for one in member.program.schedule.sent}
        self.channels = {
            key: sorted({one.channel for one in sent if one.link == route.link})
            for key, route in self.routes.items()
        }
        self._held = {
            key: casadi.MX.sym("held", len(self.channels[key]), len(one.pairs))
            for key, one in self.routes.items()
        }
        self._seen = {k: casadi.MX.sym("seen", len(one.pairs), one.ticks) for k, one in self.routes.items()}
        self._last = {k: casadi.MX.sym("last", len(one.pairs)) for k, one in self.routes.items()}
        self._gaps = {
            k: casadi.MX.sym("gaps", len(one.pairs), one.ticks if one.zero else 0)
            for k, one in self.routes.items()
        }
        self._known: dict[tuple[tuple[str, str], str], Any] = {}

    @property
    def held(self) -> list[Any]:
        """What comes in of each route from the frame before."""
        return list(self._held.values())

    @property
    def inputs(self) -> list[Any]:
        """What comes in: of each route the rows at its ticks, at the frame's end, and what is missing."""
        return [one[key] for key in self.routes for one in (self._seen, self._last, self._gaps)]

    def route(self, row: Selected) -> Route:
        """Return the ways on which it is heard."""
        return self.routes[row.way.link, row.clock]

    def on_ways(self, row: Selected) -> Any:
        """Return what is heard at a tick on each way of a route, or 1 where something is missed; in a row."""
        key = (row.way.link, row.clock)
        if row.gap:
            return self._gaps[key][:, row.tick].T
        return self._candidates(key, row.channel).get_nz(False, self._seen[key][:, row.tick]).T

    def renew(self) -> None:
        """Take notice that something was sent."""
        self._known.clear()

    def finish(self) -> list[Any]:
        """Return what the routes hold when the frame ends."""
        return [
            casadi.vertcat(
                *(self._candidates(key, channel).get_nz(False, self._last[key]).T for channel in channels)
            )
            for key, channels in self.channels.items()
        ]

    def start(self) -> list[Floats]:
        """Return what every way holds at time 0, a row a way: its sender's start values."""
        return [
            np.concatenate([_first_packet(one, route.link, self.channels[key]) for one in self.members])[
                places(self.members)[route.pairs[:, 0]]
            ]
            for key, route in self.routes.items()
        ]

    def _candidates(self, key: tuple[str, str], channel: str) -> Any:
        if (key, channel) not in self._known:
            route = self.routes[key]
            packets = [
                self.packet(member, Sent(route.link, channel, slot), ago)
                for ago in range(route.frames + 1)
                for slot in range(route.slots)
                for member in range(len(self.members))
            ]
            held = self._held[key][self.channels[key].index(channel), :]
            column = casadi.densify(casadi.horzcat(casadi.MX(1, 1), held, *packets)).T
            self._known[key, channel] = column
        return self._known[key, channel]


def places(members: Sequence[Member]) -> Integers:
    """Return where each peer of the scene stands in a packet of all members (N,)."""
    return np.argsort(np.concatenate([member.peers for member in members]))


def _first_packet(member: Member, link: str, channels: Sequence[str]) -> Floats:
    """Return what each peer of a member sends at the start (count, channels), 0 where it sends nothing."""
    sent = next((one.channels for one in member.program.kind.sends if one.link == link), ())
    rows = [
        [one[link][sent.index(name)] if name in sent else 0.0 for name in channels] for one in member.sends
    ]
    return member.each(np.array(rows).reshape(len(rows), len(channels)))


class Arrivals:
    """The numbers that come in, frame by frame; time only goes forward."""

    def __init__(self, table: Timetable, members: Sequence[Member], frame: int) -> None:
        """Start at time 0; `frame` is in quanta."""
        self._table, self._frame, self._now = table, frame, 0
        place = places(members)
        self._peers = len(place)
        self._senders = [place[route.pairs[:, 0]] for route in table.routes]
        self._held = [np.full(len(route.pairs), START, np.int64) for route in table.routes]

    def take(self, frames: int) -> list[Floats]:
        """Return what comes in for the next frames, in the order of `Selection.inputs`, flat."""
        numbers = self._now + np.arange(frames)
        self._now += frames
        found: list[Floats] = []
        for place, seen in enumerate(self._table.take(self._now * self._frame)):
            found += self._on_route(place, seen, numbers)
        return found

    def _on_route(self, place: int, seen: Seen, numbers: Integers) -> list[Floats]:
        route = self._table.routes[place]
        last = seen.packets[route.ticks - 1 :: route.ticks]
        held = np.concatenate([self._held[place][None, :], last])
        self._held[place] = last[-1]
        ticks = np.repeat(numbers, route.ticks)
        rows = self._rows(place, seen.packets, np.repeat(held[:-1], route.ticks, axis=0), ticks)
        if route.zero:
            rows = np.where(seen.missing, MISSING, rows)
        gaps = seen.missing if route.zero else np.zeros((0, len(route.pairs)))
        listed = (rows, self._rows(place, last, held[:-1], numbers), gaps)
        return [one.astype(np.float64).reshape(-1) for one in listed]

    def _rows(self, place: int, packets: Integers, held: Integers, frame: Integers) -> Integers:
        """Return the candidates' rows of packets.

        Parameters
        ----------
        place
            The route's place.
        packets
            The packets' numbers (ticks, M).
        held
            What is held since the last frame (ticks, M), by number.
        frame
            The number of the frame that each tick is in (ticks,).
        """
        route, ways = self._table.routes[place], packets.shape[1]
        ago = frame[:, None] - packets // route.slots
        assert ((packets == held) | ((ago >= 0) & (ago <= route.frames))).all(), "a packet is no longer kept"
        sent = (ago * route.slots + packets % route.slots) * self._peers + self._senders[place]
        return np.where(packets == held, 1 + np.arange(ways), 1 + ways + sent)
