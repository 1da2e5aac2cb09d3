"""How fast a scene settles almost surely: its growth per frame over an endless course of luck, estimated.

Takes: a `Model` whose links lose packets, whose receivers hold what they heard last.
Gives: `TopLyapunovExponent`, `almost_sure`.
Guarantees: equal seeds give equal numbers. The interval is of independent courses, which begin once
directions have settled, so that it holds what a norm's choice makes of both ends, O(1/T).
Does not: prove; play more peers than fit in one matrix.

With x_T = A_T ⋯ A_1 x_0 the exponent is lim log‖x_T‖ / T, the same for almost all luck (Furstenberg and
Kesten, 1960). Where directions x/‖x‖ are distributed as they will stay, the mean of log‖x_{k+1}‖ − log‖x_k‖
is the exponent itself, at every k and in any norm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from apc.compiler.compiled import Model
from apc.frame.instance import Prepared
from apc.moments.crowd import build_hearing
from apc.moments.frames import channels_of, held_frame, refuse_unheld
from apc.network.channel import ChannelLaw
from apc.unserved import NotSupportedError

# States of all peers and their channels in one matrix: ten equal peers of the paper's.
MOST_STATES = 180

# Courses, and the frames that count in each, after those for directions to settle. Long ones rather than
# many: what directions still drift by after they settled counts once in each.
COURSES, FRAMES, SETTLING = 64, 16_384, 1024

# Frames from one look at a norm to the next, in which nothing under- or overflows.
STRIDE = 8

# The quantile of 95 % on both sides together.
QUANTILE = 0.975


@dataclass(frozen=True, slots=True)
class TopLyapunovExponent:
    """The exponent per frame (log of the growth), and the 95 % confidence interval it is in."""

    exponent: float
    interval: tuple[float, float]


def almost_sure(system: Model, prepared: Prepared, *, seed: int = 0) -> TopLyapunovExponent:
    """Estimate a scene's growth per frame over one endless course of luck.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with any numbers.
    seed
        Of the luck.
    """
    hearing = build_hearing(system, prepared)
    refuse_unheld(system, hearing)
    lossy = [link for link in system.links if link.channel]
    states = sum(len(group.z_names) * group.count for group in hearing.groups)
    states += sum(channels_of(link, system.peers) for link in lossy)
    if states > MOST_STATES:
        what = f"{system.peers:,} peers and their channels have {states:,} states"
        raise NotSupportedError(f"{what}, and {MOST_STATES} are the most")
    frame = held_frame(system, hearing)
    share = np.array([law.mean_loss for law in frame.laws])[:, None, None]
    n, count, width = len(frame.mean), len(frame.laws), frame.misses.shape[1]
    enters = frame.enters.transpose(1, 0, 2).reshape(n, count * width)
    # Everything heard, and what comes on top where packets are lost.
    heard = frame.mean - (share * (frame.enters @ frame.misses)).sum(axis=0)
    both = np.concatenate([heard, frame.misses.reshape(count * width, n)])
    luck = np.random.Generator(np.random.Philox(seed))
    x, total = luck.standard_normal((n, COURSES)), np.zeros(COURSES)
    for number, lost in enumerate(_lost(frame.laws, COURSES, SETTLING + FRAMES, luck)):
        moved = both @ x
        x = moved[:n] + enters @ (moved[n:] * np.repeat(lost, width, axis=0))
        if (number + 1) % STRIDE == 0:
            size = np.linalg.norm(x, axis=0)
            if not size.all():  # nothing is left
                return TopLyapunovExponent(-math.inf, (-math.inf, -math.inf))
            x /= size
            total += np.log(size) * (number >= SETTLING)
    values = total / FRAMES
    middle = float(values.mean())
    half = float(stdtrit(COURSES - 1, QUANTILE)) * float(values.std(ddof=1)) / math.sqrt(COURSES)
    return TopLyapunovExponent(middle, (middle - half, middle + half))


def _lost(
    laws: Sequence[ChannelLaw], courses: int, frames: int, luck: np.random.Generator
) -> Iterator[NDArray[np.bool_]]:
    """Give, frame by frame, whether each channel loses its packet in each course.

    Each channel starts in its stationary state.
    """
    names = ("p", "r", "bad", "one_minus_h", "one_minus_k")
    numbers = np.array([[getattr(law, name) for law in laws] for name in names])[..., None]
    p, r, share, in_bad, in_good = numbers
    bad = luck.random((len(laws), courses)) < share
    for _ in range(frames):
        loss, change = luck.random((2, len(laws), courses))
        yield loss < np.where(bad, in_bad, in_good)
        bad = np.where(bad, change >= r, change < p)
