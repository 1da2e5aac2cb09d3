"""Unreliable links: which packets get lost, when the others arrive, and which of them a tick sees.

Takes: a link's `Channel` with its numbers, a seed, the two peers of a way.
Gives: `ChannelLaw`, `channel_law`; `PacketSource`, its delays; `Listener`, what is heard; `nominal_notes`.
Guarantees: equal seeds give equal packets, in any order of the ways, whoever else is there, however time is
cut into pieces, with every version of NumPy; every way from peer to peer is independent of the others;
without loss and jitter a tick sees the packet that `scheduling` says.
Does not: know what is in a packet, or move anything.

Each packet of a way uses up `WORDS` random words, whatever the channel: the change of state after it, its
loss, and two for its jitter. So runs of other probabilities meet the same luck: a packet that is lost at some
probability of independent losses is lost at any larger one.

A way starts in its stationary state: the first packet is as likely to be lost as any other (in netem, a way
starts good).
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Link
from apc.compiler.errors import ApcError, Mistake, Place

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

WORDS = 4  # random words a packet
START = -1  # the "packet" before the first: the sender's start values

# netem's Pareto table (iproute2, netem/pareto.c): shape 3, its mean 3/2 taken off, times 4/3, and no more
# than 4, the largest number that the table can hold (32767/8192).
PARETO_SHAPE = 3
PARETO_MOST = 4.0

# The largest numbers that `deviates` gives: of 53 random bits, a normal is never beyond √(2·53·ln 2) = 8.57.
LATEST = {"uniform": 1.0, "normal": math.sqrt(2 * 53 * math.log(2)), "pareto": PARETO_MOST}

# Arrivals are told apart down to this part of a quantum; everything that happens at ticks happens at whole
# quanta. A delay of some whole quanta, written as a float of seconds, is then that number exactly.
FINENESS = 2**20
# No delay is longer than so many quanta: beyond, a packet counts as lost (and integers would overflow).
LONGEST = 2**40


@dataclass(frozen=True, slots=True, eq=False)
class ChannelLaw:
    """The numbers of a channel.

    `p`, `r`, `one_minus_h` and `one_minus_k` are netem's `gemodel` (see `compiled.Loss`); `delay` and
    `jitter` are in seconds; `trace` (n,) replaces all of them: seconds, infinite for a lost packet.
    """

    p: float
    r: float
    one_minus_h: float
    one_minus_k: float
    delay: float
    jitter: float
    distribution: str
    trace: Floats | None

    @property
    def bad(self) -> float:
        """The share of time in the bad state: p/(p + r), 0 if the state never changes."""
        return self.p / (self.p + self.r) if self.p + self.r else 0.0

    @property
    def mean_loss(self) -> float:
        """The share of packets that get lost, in the long run."""
        if self.trace is not None:
            return float(np.mean(np.isinf(self.trace)))
        return self.bad * self.one_minus_h + (1 - self.bad) * self.one_minus_k

    @property
    def longest(self) -> float:
        """The longest delay that a packet which arrives can have, in seconds."""
        if self.trace is not None:
            return float(np.max(self.trace, initial=0.0, where=np.isfinite(self.trace)))
        return self.delay + self.jitter * LATEST[self.distribution]


def channel_law(system: CompiledSystem, link: Link, delay: Fraction) -> ChannelLaw:
    """Return the numbers of a link's channel.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to use (see `overrides.apply`).
    link
        A link of it that has a channel.
    delay
        The delay of the way, in seconds.

    Raises
    ------
    ApcError
        E891 a group of peers sets a number of the link for itself.
    """
    channel = link.channel
    assert channel is not None, f"{link.name} is reliable"
    loss = (
        ()
        if channel.loss is None
        else (channel.loss.p, channel.loss.r, channel.loss.one_minus_h, channel.loss.one_minus_k)
    )
    for group in system.groups:
        for parameter in group.values:
            if parameter.name in loss:
                what = f"{parameter.name} is of a link, the same for all peers: {group.name} can't set it"
                raise ApcError(Mistake("E891", Place(system.name), what))
    value = {parameter.name: parameter.value for parameter in system.parameters}
    seconds = {timing.name: float(timing.value) for timing in system.timings}
    p, r, one_minus_h, one_minus_k = (value[name] for name in loss) if loss else (0.0, 1.0, 1.0, 0.0)
    jitter = 0.0 if channel.jitter is None else seconds[channel.jitter]
    return ChannelLaw(
        p, r, one_minus_h, one_minus_k, float(delay), jitter, channel.distribution, channel.trace
    )


class PacketSource:
    """The packets of one way from peer to peer, in the order they are sent; what is taken is gone."""

    def __init__(
        self, law: ChannelLaw, link: str, sender: int, receiver: int, *, seed: int = 0, run: int = 0
    ) -> None:
        """Start at the first packet.

        Parameters
        ----------
        law
            The channel's numbers.
        link
            The link's name.
        sender, receiver
            The peers' numbers, from 0.
        seed, run
            The experiment's seed, and which run of it this is; 0 or more.
        """
        self.law = law
        self.taken = 0
        # A name, not a place among the links: another link beside this one changes nothing here.
        key = (zlib.crc32(link.encode()), run, sender, receiver)
        # A bit generator's words are the same in every version of NumPy (NEP 19), a distribution's are not.
        self._bits = np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key))
        self._bad = bool(self._uniforms(1)[0, 0] < law.bad)

    def take(self, count: int) -> Floats:
        """Return the delays (count,) in seconds of the next packets, infinite for those that get lost."""
        law, first = self.law, self.taken
        self.taken += count
        if law.trace is not None:
            return law.trace[np.arange(first, first + count) % law.trace.size]
        uniforms = self._uniforms(count)
        bad = self._states(uniforms[:, 0])
        lost = uniforms[:, 1] < np.where(bad, law.one_minus_h, law.one_minus_k)
        late = law.jitter * deviates(law.distribution, uniforms[:, 2], uniforms[:, 3]) if law.jitter else 0.0
        # Nothing arrives before it was sent: as in netem, a delay that would be negative is none.
        return np.where(lost, np.inf, np.maximum(law.delay + late, 0.0))

    def _uniforms(self, count: int) -> Floats:
        """Return numbers (count, WORDS) from 0 to less than 1, of 53 bits each."""
        words = self._bits.random_raw(count * WORDS).reshape(count, WORDS)
        return np.asarray((words >> np.uint64(11)) * 2.0**-53, dtype=np.float64)

    def _states(self, uniforms: Floats) -> Flags:
        """Return whether the way is bad at each packet.

        The step after a packet is a map of {good, bad} to itself: one of both constants, the identity, or the
        exchange. So the state is that of the last constant, exchanged as often as there were exchanges since.
        """
        turns_bad, turns_good = uniforms < self.law.p, uniforms >= 1 - self.law.r
        steps = np.arange(1, len(uniforms) + 1)
        constant = np.maximum.accumulate(np.where(turns_bad != turns_good, steps, 0))
        exchanges = np.concatenate([[0], np.cumsum(turns_bad & turns_good)])
        first = np.concatenate([[self._bad], turns_bad])[constant]
        after = first ^ ((exchanges[1:] - exchanges[constant]) % 2 == 1)
        bad = np.concatenate([[self._bad], after])
        self._bad = bool(bad[-1])
        return bad[:-1]


def deviates(distribution: str, one: Floats, two: Floats) -> Floats:
    """Return what a jitter of 1 adds to a delay, drawn from a distribution.

    Parameters
    ----------
    distribution
        "uniform": evenly from −1 to 1; "normal": of mean 0 and standard deviation 1; "pareto": netem's, from
        −2/3 to 4, many a little early and few very late, of mean −0.033 and standard deviation 0.84.
    one, two
        Independent numbers (n,) from 0 to less than 1.
    """
    match distribution:
        case "uniform":
            return 2 * one - 1
        case "normal":  # Box and Muller (1958)
            normal = np.sqrt(-2 * np.log1p(-one)) * np.cos(2 * np.pi * two)
            return np.asarray(normal, dtype=np.float64)
    assert distribution == "pareto", f"no such distribution: {distribution}"
    tail = (1 - one) ** (-1 / PARETO_SHAPE)
    late = (tail - PARETO_SHAPE / (PARETO_SHAPE - 1)) * 4 / 3
    return np.asarray(np.minimum(late, PARETO_MOST), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """What ticks see on a way.

    `packets` (n,) are the numbers of the packets in effect, counted from 0, `START` for the start values.
    `missing` (n,) says where a packet is known to be missing: from the tick at which a lost packet should
    have been there, had it taken its nominal delay, until a packet that was sent after it is in effect.
    """

    packets: Integers
    missing: Flags


class Listener:
    """What one way's receiver hears, tick by tick; time only goes forward."""

    def __init__(
        self, source: PacketSource, *, phase: int, period: int, delay: int, quantum: Fraction, newest: bool
    ) -> None:
        """Start before the first packet.

        Parameters
        ----------
        source
            The packets.
        phase, period
            Packet k is sent at phase + k*period, in quanta.
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
        self._effective = START
        self._gap = START  # the newest lost packet that should be there
        self._due = np.zeros(0, np.int64)  # lost packets that should be there later
        # On their way: numbers, whole quanta from which they are seen, and how much before that they arrive.
        self._under_way = np.zeros((3, 0), np.int64)

    @property
    def oldest(self) -> int:
        """The oldest packet that is, or may yet come, in effect; `START` while it is the start values."""
        return int(min([self._effective, *self._under_way[0, :]]))

    def hear(self, ticks: Integers) -> Heard:
        """Return what the ticks (n,) see, in quanta, rising, all after those heard before."""
        if not len(ticks):
            return Heard(np.zeros(0, np.int64), np.zeros(0, np.bool_))
        self._send_until(int(ticks[-1]))
        numbers, seen, _ = self._under_way
        arrived = seen <= ticks[-1]
        packets = (
            self._newest(ticks, numbers[arrived], seen[arrived])
            if self.newest
            else self._latest(ticks, self._under_way[:, arrived])
        )
        missing = self._gaps(ticks) > packets
        self._effective = int(packets[-1])
        keep = ~arrived & (numbers > self._effective) if self.newest else ~arrived
        self._under_way = self._under_way[:, keep]
        return Heard(packets, missing)

    def _send_until(self, tick: int) -> None:
        """Send the packets up to a time; what is sent later can't have arrived."""
        first = self.source.taken
        count = max((tick - self.phase) // self.period + 1 - first, 0)
        numbers = np.arange(first, first + count, dtype=np.int64)
        delays = self.source.take(count) / self.quantum
        lost = ~(delays < LONGEST)
        fine = np.rint(np.where(lost, 0.0, delays) * FINENESS).astype(np.int64)
        seen = self.phase + self.period * numbers - (-fine // FINENESS)
        before = -fine % FINENESS
        self._due = np.concatenate([self._due, numbers[lost]])
        sent = np.stack([numbers, seen, before])[:, ~lost]
        self._under_way = np.concatenate([self._under_way, sent], axis=1)

    def _newest(self, ticks: Integers, numbers: Integers, seen: Integers) -> Integers:
        """Return the packets sent last of those that have arrived."""
        packets = np.full(len(ticks), self._effective)
        np.maximum.at(packets, np.searchsorted(ticks, seen), numbers)
        return np.maximum.accumulate(packets)

    def _latest(self, ticks: Integers, arrived: Integers) -> Integers:
        """Return the packets that arrived last."""
        numbers, seen, before = arrived
        order = np.lexsort((numbers, -before, seen))
        place = np.searchsorted(seen[order], ticks, side="right")
        return np.concatenate([[self._effective], numbers[order]])[place]

    def _gaps(self, ticks: Integers) -> Integers:
        """Return the newest lost packets that should be there."""
        place = np.searchsorted(ticks, self.phase + self.period * self._due + self.delay)
        gaps = np.full(len(ticks), self._gap)
        due = place < len(ticks)
        np.maximum.at(gaps, place[due], self._due[due])
        gaps = np.maximum.accumulate(gaps)
        self._due, self._gap = self._due[~due], int(gaps[-1])
        return gaps


def nominal_notes(system: CompiledSystem) -> tuple[str, ...]:
    """Return, for each unreliable link, what an analysis of its nominal delay leaves out."""
    timings = {timing.name: timing.value for timing in system.timings}
    notes = []
    for link in system.links:
        if link.channel is None:
            continue
        law = channel_law(system, link, timings[link.delay])
        named = []
        if law.mean_loss:
            named.append(f"packet loss ({100 * law.mean_loss:.3g} %)")
        if law.jitter:
            named.append("jitter")
        if law.trace is not None:
            named.append("the recorded delays")
        if named:
            delay = f"{float(timings[link.delay]) * 1e3:.6g} ms"
            notes.append(
                f"{' and '.join(named)} of {link.name} are not in this verdict: every packet takes the "
                f"nominal {delay}; see apc simulate"
            )
    return tuple(notes)
