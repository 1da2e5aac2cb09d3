"""The channel model of an unreliable link: its numerical law, and the loss and delay of each packet.

Takes: a link's `Channel` and the model's parameter values; the peer pair of each directed link; a seed.
Gives: `ChannelLaw`, `channel_law`, `LATEST`; `deviates`, the jitter's distributions; `PacketSource`, the
packet delays; `stream_key`, the key of a random stream.
Guarantees: one law for all directed links of a network link with one timing as delay. Equal seeds give equal
packets. The result is independent of the order of the directed links, of other links, of the partition of
time into calls, and of the NumPy version. Directed links are statistically independent.
Does not: handle packet contents, or select the packets in effect at a tick (see `packet_schedule`).

The random numbers of packet k of a directed link are block k + 2 of the stream `numpy.random.Philox` with the
key (seed, CRC-32 of the link's name + 2³² run) and the counter (0, sender, receiver, 0); the first block
determines the initial channel state. Of a packet's four words, one determines the state change after it, one
its loss, and two its jitter, for every channel type. Runs with different probabilities therefore use common
random numbers: a packet lost at one probability of independent losses is lost at every larger one.

Each directed link starts in the stationary distribution, so the first packet has the same loss probability as
any other (netem starts in the good state).
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apc.compiler.compiled import Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

BLOCK = 4  # words of one counter

# Numbers of packets per directed link, and over all links, that are drawn in one batch. Positioning in a
# random stream takes longer than drawing a hundred numbers.
AHEAD, MOST_AHEAD = 64, 2**19

# netem's Pareto table (iproute2, netem/pareto.c): shape 3, its mean 3/2 taken off, times 4/3, and no more
# than 4, the largest number that the table can hold (32767/8192).
PARETO_SHAPE = 3
PARETO_MOST = 4.0

# The largest numbers of `deviates`: from 53 random bits, a normal number is never beyond √(2·53·ln 2) = 8.57.
LATEST = {"uniform": 1.0, "normal": math.sqrt(2 * 53 * math.log(2)), "pareto": PARETO_MOST}


@dataclass(frozen=True, slots=True, eq=False)
class ChannelLaw:
    """The parameters of a channel.

    `p`, `r`, `one_minus_h` and `one_minus_k` are netem's `gemodel` (see `compiled.Loss`); `delay` and
    `jitter` are in seconds; `trace` (n,) replaces all of them: seconds, infinite for a lost packet. `zero`
    states whether the receiver substitutes its own value for a lost packet; `label` names the directed links.
    """

    p: float
    r: float
    one_minus_h: float
    one_minus_k: float
    delay: float
    jitter: float
    distribution: str
    trace: Floats | None
    zero: bool = False
    label: str = ""

    @property
    def bad(self) -> float:
        """The share of time in the bad state: p/(p + r), 0 if the state never changes."""
        return self.p / (self.p + self.r) if self.p + self.r else 0.0

    @property
    def mean_loss(self) -> float:
        """The mean share of packets that get lost."""
        if self.trace is not None:
            return float(np.mean(np.isinf(self.trace)))
        return self.bad * self.one_minus_h + (1 - self.bad) * self.one_minus_k

    @property
    def longest(self) -> float:
        """The longest delay of a packet that arrives, in seconds."""
        if self.trace is not None:
            return float(np.max(self.trace, initial=0.0, where=np.isfinite(self.trace)))
        return self.delay + self.jitter * LATEST[self.distribution]


def channel_law(model: Model, link: Link, delay: str) -> ChannelLaw:
    """Return the parameters of the channel of a link or of a pair of groups, for the model's present values.

    Parameters
    ----------
    model
        The model, with the parameter values to use (see `overrides.apply`).
    link
        A link of the model that has a channel.
    delay
        The timing of the delay of the directed links, which identifies their channel.

    Raises
    ------
    ApcError
        E891 a group of peers sets its own value for a link parameter.
    """
    channel = link.channel_at(delay)
    assert channel is not None, f"{link.name} is reliable"
    loss = (
        ()
        if channel.loss is None
        else (channel.loss.p, channel.loss.r, channel.loss.one_minus_h, channel.loss.one_minus_k)
    )
    for group in model.groups:
        for parameter in group.values:
            if parameter.name in loss:
                message = f"{parameter.name} belongs to a link and can't be set by group {group.name}"
                location = SourceLocation(model.origin.topology)
                raise ApcError(Diagnostic("E891", location, message, advice="set it without a group"))
    value = {parameter.name: parameter.value for parameter in model.parameters}
    seconds = {timing.name: float(timing.value) for timing in model.timings}
    p, r, one_minus_h, one_minus_k = (value[name] for name in loss) if loss else (0.0, 1.0, 1.0, 0.0)
    jitter = 0.0 if channel.jitter is None else seconds[channel.jitter]
    of_pairs = (
        f"{link.name} from {pair.sender} to {pair.receiver}"
        for pair in link.pairs
        if pair.delay == delay and pair.channel is not None
    )
    return ChannelLaw(
        p,
        r,
        one_minus_h,
        one_minus_k,
        seconds[delay],
        jitter,
        channel.distribution,
        channel.trace,
        channel.on_loss == "zero",
        next(of_pairs, link.name),
    )


def deviates(distribution: str, values: Floats, second_values: Floats) -> Floats:
    """Return random numbers (n,) from the distribution of a jitter, in units of the jitter.

    Parameters
    ----------
    distribution
        "uniform": evenly from −1 to 1; "normal": of mean 0 and standard deviation 1; "pareto": netem's, from
        −2/3 to 4, many a little early and few very late, of mean −0.033 and standard deviation 0.821.
    values, second_values
        Independent numbers (n,) from 0 to less than 1.
    """
    match distribution:
        case "uniform":
            return 2 * values - 1
        case "normal":  # Box and Muller (1958)
            normal = np.sqrt(-2 * np.log1p(-values)) * np.cos(2 * np.pi * second_values)
            return np.asarray(normal, dtype=np.float64)
    assert distribution == "pareto", f"no such distribution: {distribution}"
    tail = (1 - values) ** (-1 / PARETO_SHAPE)
    lateness = (tail - PARETO_SHAPE / (PARETO_SHAPE - 1)) * 4 / 3
    return np.asarray(np.minimum(lateness, PARETO_MOST), dtype=np.float64)


def stream_key(link: str, seed: int, run: int) -> tuple[int, int]:
    """Return the random-stream key of a link, derived from its name, so that other links do not affect it."""
    return seed, zlib.crc32(link.encode()) + (run << 32)


class PacketSource:
    """The packets of a link's directed peer pairs in the order of sending; each packet is returned once."""

    def __init__(self, law: ChannelLaw, link: str, pairs: ArrayLike, *, seed: int = 0, run: int = 0) -> None:
        """Start at the first packet.

        Parameters
        ----------
        law
            The channel law, common to these directed links.
        link
            The link's name.
        pairs
            The peers (sender, receiver) of each of the M directed links (M, 2), as zero-based peer indices.
        seed, run
            The seed of the experiment and the index of the run, both nonnegative.
        """
        self.law = law
        self.used = 0  # packets of each directed link
        self._key = stream_key(link, seed, run)
        self._pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
        self.arcs = len(self._pairs)
        self._bad: Flags = self._uniforms(1, 1)[:, 0, 0] < law.bad
        self._drawn = np.empty((self.arcs, 0, BLOCK))  # random numbers drawn ahead, from packet `used` on

    def take(self, count: int) -> Floats:
        """Return the delays (M, count) in seconds of the next packets, infinite for lost packets."""
        law, first = self.law, self.used
        self.used += count
        if law.trace is not None:
            recorded = law.trace[np.arange(first, first + count) % law.trace.size]
            return np.broadcast_to(recorded, (self.arcs, count))
        stored = self._drawn.shape[1]
        if count > stored:
            drawn_count = max(count - stored, min(AHEAD, MOST_AHEAD // max(self.arcs, 1)))
            self._drawn = np.concatenate(
                [self._drawn, self._uniforms(first + stored + 2, drawn_count)], axis=1
            )
        uniforms, self._drawn = self._drawn[:, :count], self._drawn[:, count:]
        bad = self._states(uniforms[..., 0])
        lost = uniforms[..., 1] < np.where(bad, law.one_minus_h, law.one_minus_k)
        lateness = deviates(law.distribution, uniforms[..., 2], uniforms[..., 3]) if law.jitter else 0.0
        # As in netem, a negative delay is replaced by 0.
        return np.where(lost, np.inf, np.maximum(law.delay + law.jitter * lateness, 0.0))

    def _uniforms(self, first: int, count: int) -> Floats:
        """Return `count` blocks per directed link (M, count, BLOCK) of uniform numbers on [0, 1) with
        53 bits.
        """
        generator = np.random.Philox(key=np.array(self._key, np.uint64))
        state: Any = generator.state
        words = np.empty((self.arcs, count * BLOCK), np.uint64)
        for row, pair in zip(words, self._pairs, strict=True):
            # Philox increments the counter before each block.
            state["state"]["counter"] = np.array([first - 1, *pair, 0], np.uint64)
            generator.state = state
            row[:] = generator.random_raw(count * BLOCK)
        indices = words.reshape(self.arcs, count, BLOCK)
        return np.asarray((indices >> np.uint64(11)) * 2.0**-53, dtype=np.float64)

    def _states(self, uniforms: Floats) -> Flags:
        """Return whether each directed link is in the bad state at each packet (M, count).

        The step after a packet is a map of {good, bad} to itself: one of both constants, the identity, or the
        exchange. The state is therefore that of the last constant map, inverted once per later exchange.
        """
        turns_bad, turns_good = uniforms < self.law.p, uniforms >= 1 - self.law.r
        steps = np.arange(1, uniforms.shape[1] + 1)
        constant = np.maximum.accumulate(np.where(turns_bad != turns_good, steps, 0), axis=1)
        no_exchange = np.zeros((self.arcs, 1), np.int64)
        exchanges = np.hstack([no_exchange, np.cumsum(turns_bad & turns_good, axis=1)])
        first = np.take_along_axis(np.hstack([self._bad[:, None], turns_bad]), constant, axis=1)
        exchanges_since = exchanges[:, 1:] - np.take_along_axis(exchanges, constant, axis=1)
        bad = np.hstack([self._bad[:, None], first ^ (exchanges_since % 2 == 1)])
        self._bad = bad[:, -1]
        return bad[:, :-1]
