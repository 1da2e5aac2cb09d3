"""Every packet of a scene's unreliable links: which of them each tick sees, on each way from peer to peer.

Takes: a `CompiledSystem` with its numbers, who hears whom, the quantum of its schedules, a seed.
Gives: `Route`, `routes_of`; `Timetable`.
Guarantees: a way is heard alike by all clocks of a receiver; what is remembered does not grow with time.
Does not: carry values: reliable links are not in it, and cost nothing here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Clock, CompiledSystem, Kind, Link
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.exchange import Exchange
from apc.network.channel_law import channel_law
from apc.network.listener import Listener, Seen
from apc.network.packets import PacketSource

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Ways from peer to peer: each has a random stream of its own, 2 KiB, and takes 0.1 ms a second at 1 kHz.
MOST_WAYS = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """What is heard over one unreliable link at the ticks of one clock.

    The clock's `period` and the `spacing` of packets are in seconds. `pairs` (M, 2) are the peers (sender,
    receiver), counted from 0, `weights` (M,) the graph's; `longest` is the longest time in seconds from a
    packet's sample to its arrival; `zero` says that the receiver's own value stands in for a missing one.
    """

    link: str
    clock: str
    period: Fraction
    spacing: Fraction
    pairs: Integers
    weights: Floats
    longest: float
    zero: bool


class Timetable:
    """The packets of all unreliable links of a scene, from time 0 on; time only goes forward."""

    def __init__(
        self,
        system: CompiledSystem,
        timings: Mapping[str, Fraction],
        exchange: Exchange,
        quantum: Fraction,
        *,
        seed: int = 0,
        run: int = 0,
    ) -> None:
        """Start at time 0.

        Parameters
        ----------
        system
            The compiled scene, with the numbers to use (see `overrides.apply`).
        timings
            Seconds by the name of the timing.
        exchange
            Who hears whom.
        quantum
            The time in seconds of which every period, phase and delay in use is a whole multiple.
        seed, run
            The experiment's seed, and which run of it this is.

        Raises
        ------
        ApcError
            E891 a group sets a number of a link for itself; E892 too many ways from peer to peer.
        """
        self._system, self._timings, self._exchange = system, timings, exchange
        self._quantum, self._seed, self._run = quantum, seed, run
        self._grids = {
            clock.name: (
                int(timings[clock.phase] / quantum),
                int(timings[clock.period] / quantum),
            )
            for clock in system.clocks
        }
        self.routes = routes_of(system, timings, exchange)
        self._listeners = [self._listen(route) for route in self.routes]
        self._now = 0

    def take(self, until: int) -> tuple[Seen, ...]:
        """Return what each route's ticks see, from where the last call ended to before `until`, in quanta."""
        seen = []
        for route, listeners in zip(self.routes, self._listeners, strict=True):
            phase, period = self._grids[route.clock]
            first = -(-(self._now - phase) // period)
            ticks = phase + period * np.arange(max(first, 0), -(-(until - phase) // period), dtype=np.int64)
            packets = np.empty((len(ticks), len(route.pairs)), np.int64)
            missing = np.empty(packets.shape, np.bool_)
            for ways, listener in listeners:
                heard = listener.hear(ticks)
                packets[:, ways], missing[:, ways] = heard.packets, heard.missing
            seen.append(Seen(packets, missing))
        self._now = until
        return tuple(seen)

    def _listen(self, route: Route) -> list[tuple[Integers, Listener]]:
        """Return a listener for the ways of each delay of a route, with their places in it."""
        link = self._exchange.links[route.link]
        assert link.channel is not None
        phase, period = self._grids[link.clock]
        ways_of: dict[Fraction, list[int]] = {}
        for way, pair in enumerate(_groups(self._exchange, route.pairs)):
            delay = self._timings[self._exchange.delay(link.name, *pair)]
            ways_of.setdefault(delay, []).append(way)
        return [
            (
                np.array(ways),
                Listener(
                    PacketSource(
                        channel_law(self._system, link, delay),
                        link.name,
                        route.pairs[ways].tolist(),
                        seed=self._seed,
                        run=self._run,
                    ),
                    phase=phase,
                    period=period,
                    delay=int(delay / self._quantum),
                    quantum=self._quantum,
                    newest=link.channel.reorder == "newest",
                ),
            )
            for delay, ways in ways_of.items()
        ]


def routes_of(
    system: CompiledSystem, timings: Mapping[str, Fraction], exchange: Exchange
) -> tuple[Route, ...]:
    """Return what is heard over unreliable links: a route for each of them and each clock that hears it.

    Parameters
    ----------
    system, timings, exchange
        As `Timetable` has them.

    Raises
    ------
    ApcError
        As `Timetable`.
    """
    unreliable = [link for link in system.links if link.channel is not None]
    found = [_route(system, timings, exchange, link, clock) for link in unreliable for clock in system.clocks]
    return tuple(route for route in found if len(route.pairs))


def _route(
    system: CompiledSystem, timings: Mapping[str, Fraction], exchange: Exchange, link: Link, clock: Clock
) -> Route:
    """Return the ways over a link whose receivers hear it at the ticks of a clock."""
    peers = exchange.peers
    if link.graph.shape == "complete" and peers * (peers - 1) > MOST_WAYS:
        what = (
            f"{link.name} is unreliable, and {peers} peers that all hear each other are "
            f"{peers * (peers - 1)} ways with packets of their own; at most {MOST_WAYS} can be followed"
        )
        raise ApcError(Mistake("E892", Place(system.name), what, hint="graph: ring"))
    sends = np.array([any(one.link == link.name for one in kind.sends) for kind in system.kinds])
    hears = np.array([_hears(kind, link.name, clock.name) for kind in system.kinds])
    kind_of = np.repeat([group.kind for group in system.groups], np.diff(exchange.starts))
    pairs, weights = exchange.arcs(link.name)
    used = sends[kind_of[pairs[:, 0]]] & hears[kind_of[pairs[:, 1]]]
    pairs = pairs[used]
    delays = {timings[exchange.delay(link.name, *pair)] for pair in set(_groups(exchange, pairs))}
    periods = {one.name: timings[one.period] for one in system.clocks}
    assert link.channel is not None
    return Route(
        link=link.name,
        clock=clock.name,
        period=periods[clock.name],
        spacing=periods[link.clock],
        pairs=pairs,
        weights=weights[used],
        longest=max((channel_law(system, link, delay).longest for delay in delays), default=0.0),
        zero=link.channel.on_loss == "zero",
    )


def _hears(kind: Kind, link: str, clock: str) -> bool:
    ticking = [partition for partition in kind.clocks if partition.clock == clock]
    return any(receive.link == link for partition in ticking for receive in partition.receives)


def _groups(exchange: Exchange, pairs: Integers) -> list[tuple[int, int]]:
    """Return the groups of each pair of peers."""
    groups = np.searchsorted(exchange.starts, pairs, side="right") - 1
    return [(int(sender), int(receiver)) for sender, receiver in groups]
