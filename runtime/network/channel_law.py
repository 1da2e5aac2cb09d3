"""What an unreliable link does to packets, in numbers.

Takes: a link's `Channel` and the scene's numbers; for `deviates`, random numbers from 0 to less than 1.
Gives: `ChannelLaw`, `channel_law`; `deviates`, the jitter's distributions, and `LATEST`.
Guarantees: one law for all ways of a link with one delay; nothing is drawn here, so that it is the same with
every version of NumPy.
Does not: draw a packet (see `packets`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Link
from apc.compiler.errors import ApcError, Mistake, Place

Floats = NDArray[np.float64]

# netem's Pareto table (iproute2, netem/pareto.c): shape 3, its mean 3/2 taken off, times 4/3, and no more
# than 4, the largest number that the table can hold (32767/8192).
PARETO_SHAPE = 3

PARETO_MOST = 4.0

# The largest numbers that `deviates` gives: of 53 random bits, a normal is never beyond √(2·53·ln 2) = 8.57.
LATEST = {"uniform": 1.0, "normal": math.sqrt(2 * 53 * math.log(2)), "pareto": PARETO_MOST}


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
