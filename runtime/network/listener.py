"""Which packets of some ways of an unreliable link are in effect at each tick of their receivers.

Takes: a `PacketSource`, the times of a link in quanta.
Gives: `Listener`, `Seen`; `START`.
Guarantees: without loss and jitter a tick sees the packet that `scheduling` says; it does not matter how time
is cut into pieces; what is remembered does not grow with time.
Does not: know what is in a packet, or move anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.network.packets import PacketSource

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

START = -1  # the "packet" before the first: the sender's start values

# Arrivals are told apart down to this part of a quantum; everything that happens at ticks happens at whole
# quanta. A delay of some whole quanta, written as a float of seconds, is then that number exactly.
FINENESS = 2**20
# No delay is longer than so many quanta: beyond, a packet counts as lost (and integers would overflow).
LONGEST = 2**40


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What ticks see on M ways.

    `packets` (ticks, M) are the numbers of the packets in effect, counted from 0, `START` for the start
    values. `missing` (ticks, M) says where a packet is known to be missing: from the tick at which a lost
    packet should have been there, had it taken its nominal delay, until a packet that was sent after it is in
    effect.
    """

    packets: Integers
    missing: Flags


class Listener:
    """What the receivers of some ways hear, tick by tick; time only goes forward."""

    def __init__(
        self, source: PacketSource, *, phase: int, period: int, delay: int, quantum: Fraction, newest: bool
    ) -> None:
        """Start before the first packet.

        Parameters
        ----------
        source
            The packets.
        phase, period
            Packet k of every way is sent at phase + k*period, in quanta.
        delay
            The nominal delay in quanta.
        quantum
            Seconds a quantum; all ticks are at whole ones.
        newest
            Whether the packet sent last is in effect, or else the one that arrived last (of several that
            arrive at once, the one sent last).
        """
        self.source = source
        self.phase = phase
        self.period = period
        self.delay = delay
        self.quantum = float(quantum)
        self.newest = newest
        self._effective = np.full(source.ways, START, np.int64)
        self._gap = np.full(source.ways, START, np.int64)  # the newest lost packets that should be there
        # Lost packets that should be there later: their ways and numbers.
        self._due = np.zeros((2, 0), np.int64)
        # On their way: ways, numbers, whole quanta from which they are seen, how much before they arrive.
        self._under_way = np.zeros((4, 0), np.int64)

    @property
    def remembered(self) -> int:
        """How many packets may yet come in effect, or be found missing, on all ways."""
        return self._under_way.shape[1] + self._due.shape[1]

    def hear(self, ticks: Integers) -> Seen:
        """Return what the ticks (n,) see, in quanta, rising, all after those heard before."""
        if not len(ticks):
            nothing = (0, self.source.ways)
            return Seen(np.zeros(nothing, np.int64), np.zeros(nothing, np.bool_))
        self._send_until(int(ticks[-1]))
        ways, numbers, seen, _ = self._under_way
        arrived = seen <= ticks[-1]
        packets = self._in_effect(ticks, self._under_way[:, arrived])
        missing = self._gaps(ticks) > packets
        self._effective = packets[-1].copy()
        keep = ~arrived & (numbers > self._effective[ways]) if self.newest else ~arrived
        self._under_way = self._under_way[:, keep]
        return Seen(packets, missing)

    def _send_until(self, tick: int) -> None:
        """Send the packets up to a time; what is sent later can't have arrived."""
        first = self.source.taken
        count = max((tick - self.phase) // self.period + 1 - first, 0)
        delays = self.source.take(count) / self.quantum
        lost = ~(delays < LONGEST)
        fine = np.rint(np.where(lost, 0.0, delays) * FINENESS).astype(np.int64)
        ways, numbers = np.indices(delays.shape)
        numbers += first
        seen = self.phase + self.period * numbers - (-fine // FINENESS)
        before = -fine % FINENESS
        sent = np.stack([ways, numbers, seen, before])
        self._due = np.concatenate([self._due, sent[:2, lost]], axis=1)
        self._under_way = np.concatenate([self._under_way, sent[:, ~lost]], axis=1)

    def _in_effect(self, ticks: Integers, arrived: Integers) -> Integers:
        """Return the packets (n, M) sent last, or arrived last, of those that have arrived."""
        ways, numbers, seen, before = arrived
        if self.newest:
            return _highest(ticks, ways, seen, numbers, self._effective)
        order = np.lexsort((numbers, -before, seen))
        rank = np.arange(len(order))
        latest = _highest(ticks, ways[order], seen[order], rank, np.full(self.source.ways, -1))
        return np.where(latest < 0, self._effective, np.append(numbers[order], START)[latest])

    def _gaps(self, ticks: Integers) -> Integers:
        """Return the newest lost packets (n, M) that should be there."""
        ways, numbers = self._due
        when = self.phase + self.period * numbers + self.delay
        due = when <= ticks[-1]
        gaps = _highest(ticks, ways[due], when[due], numbers[due], self._gap)
        self._due, self._gap = self._due[:, ~due], gaps[-1].copy()
        return gaps


def _highest(ticks: Integers, ways: Integers, when: Integers, ranks: Integers, first: Integers) -> Integers:
    """Return, for each tick and way, the highest rank of what has happened by then.

    Parameters
    ----------
    ticks
        The ticks (n,), rising.
    ways, when, ranks
        What happened (K,): on which of the M ways, when (no later than the last tick), of what rank.
    first
        The ranks (M,) at the beginning.
    """
    found = np.full((len(ticks), len(first)), START, np.int64)
    found[0] = first
    np.maximum.at(found.reshape(-1), np.searchsorted(ticks, when) * len(first) + ways, ranks)
    return np.maximum.accumulate(found, axis=0)
