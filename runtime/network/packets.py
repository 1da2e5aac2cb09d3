"""Packets over unreliable links: which get lost, and how long the others take.

Takes: a `ChannelLaw`, the two peers of each way, a seed.
Gives: `PacketSource`, its delays.
Guarantees: equal seeds give equal packets, in any order of the ways, whoever else is there, however time is
cut into pieces, with every version of NumPy; every way from peer to peer is independent of the others.
Does not: know what is in a packet, or which of them a tick sees (see `listener`).

Each packet of a way uses up `WORDS` random words, whatever the channel: the change of state after it, its
loss, and two for its jitter. So runs of other probabilities meet the same luck: a packet that is lost at some
probability of independent losses is lost at any larger one.

A way starts in its stationary state: the first packet is as likely to be lost as any other (in netem, a way
starts good).
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apc.network.channel_law import ChannelLaw, deviates

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

WORDS = 4  # random words a packet


class PacketSource:
    """The packets of some ways of one link, in the order they are sent; what is taken is gone."""

    def __init__(
        self, law: ChannelLaw, link: str, pairs: Sequence[tuple[int, int]], *, seed: int = 0, run: int = 0
    ) -> None:
        """Start at the first packet.

        Parameters
        ----------
        law
            The channel's numbers, those of all these ways.
        link
            The link's name.
        pairs
            The peers (sender, receiver) of each of the M ways, by their numbers, from 0.
        seed, run
            The experiment's seed, and which run of it this is; 0 or more.
        """
        self.law = law
        self.ways = len(pairs)
        self.taken = 0  # packets of each way
        # A name, not a place among the links: another link beside this one changes nothing here.
        number = zlib.crc32(link.encode())
        # A bit generator's words are the same in every version of NumPy (NEP 19), a distribution's are not.
        self._bits = [
            np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(number, run, sender, receiver)))
            for sender, receiver in pairs
        ]
        self._bad: Flags = self._uniforms(1)[:, 0, 0] < law.bad

    def take(self, count: int) -> Floats:
        """Return the delays (M, count) in seconds of the next packets, infinite for those that get lost."""
        law, first = self.law, self.taken
        self.taken += count
        if law.trace is not None:
            recorded = law.trace[np.arange(first, first + count) % law.trace.size]
            return np.broadcast_to(recorded, (self.ways, count))
        uniforms = self._uniforms(count)
        bad = self._states(uniforms[..., 0])
        lost = uniforms[..., 1] < np.where(bad, law.one_minus_h, law.one_minus_k)
        late = deviates(law.distribution, uniforms[..., 2], uniforms[..., 3]) if law.jitter else 0.0
        # Nothing arrives before it was sent: as in netem, a delay that would be negative is none.
        return np.where(lost, np.inf, np.maximum(law.delay + law.jitter * late, 0.0))

    def _uniforms(self, count: int) -> Floats:
        """Return numbers (M, count, WORDS) from 0 to less than 1, of 53 bits each."""
        words = np.empty((self.ways, count * WORDS), np.uint64)
        for row, bits in zip(words, self._bits, strict=True):
            row[:] = bits.random_raw(count * WORDS)
        uniforms = np.asarray((words >> np.uint64(11)) * 2.0**-53, dtype=np.float64)
        return uniforms.reshape(self.ways, count, WORDS)

    def _states(self, uniforms: Floats) -> Flags:
        """Return whether each way is bad at each packet (M, count).

        The step after a packet is a map of {good, bad} to itself: one of both constants, the identity, or the
        exchange. So the state is that of the last constant, exchanged as often as there were exchanges since.
        """
        turns_bad, turns_good = uniforms < self.law.p, uniforms >= 1 - self.law.r
        steps = np.arange(1, uniforms.shape[1] + 1)
        constant = np.maximum.accumulate(np.where(turns_bad != turns_good, steps, 0), axis=1)
        none = np.zeros((self.ways, 1), np.int64)
        exchanges = np.hstack([none, np.cumsum(turns_bad & turns_good, axis=1)])
        first = np.take_along_axis(np.hstack([self._bad[:, None], turns_bad]), constant, axis=1)
        since = exchanges[:, 1:] - np.take_along_axis(exchanges, constant, axis=1)
        bad = np.hstack([self._bad[:, None], first ^ (since % 2 == 1)])
        self._bad = bad[:, -1]
        return bad[:, :-1]
