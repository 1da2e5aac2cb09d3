"""Monte Carlo estimate of the top Lyapunov exponent of a model with packet losses, per frame.

Takes: a `Model` whose links lose packets, whose receivers hold the last received value.
Gives: `TopLyapunovExponent`, `top_lyapunov_exponent`.
Guarantees: equal seeds give equal numbers. The confidence interval is computed from independent realizations
after a burn-in of the direction distribution; the effect of the norm on both ends, O(1/T), is within it.
Does not: prove; simulate more peers than fit in one matrix.

With x_T = A_T ⋯ A_1 x_0 the exponent is lim log‖x_T‖ / T, the same for almost all loss sequences (Furstenberg
and Kesten, 1960). Under the stationary distribution of the directions x/‖x‖, the mean of log‖x_{k+1}‖ −
log‖x_k‖ is the exponent itself, at every k and in any norm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from apc.compiler.compiled import Model
from apc.frame.numeric_model import Prepared
from apc.mean_square.class_moments import build_reception
from apc.mean_square.loss_patterns import channels_of, hold_frame, refuse_unheld
from apc.network.channel import ChannelLaw
from apc.not_supported import NotSupportedError

# States of all peers and their channels in one matrix: ten equal peers of the paper's.
MOST_STATES = 180

# Courses, and the frames that count in each, after those for directions to settle. Long ones rather than
# many: what directions still drift by after they settled counts once in each.
REALIZATIONS, FRAMES, SETTLING = 64, 16_384, 1024

# Frames from one look at a norm to the next, in which nothing under- or overflows.
STRIDE = 8

# The quantile of 95 % on both sides together.
QUANTILE = 0.975


@dataclass(frozen=True, slots=True)
class TopLyapunovExponent:
    """The exponent per frame (log of the growth), and the 95 % confidence interval it is in."""

    exponent: float
    interval: tuple[float, float]


def top_lyapunov_exponent(system: Model, prepared: Prepared, *, seed: int = 0) -> TopLyapunovExponent:
    """Estimate the top Lyapunov exponent of a model, per frame.

    Parameters
    ----------
    system
        The model, with the parameter values to analyze.
    prepared
        From `numeric_model.prepare`, of this model with any parameter values.
    seed
        Of the random losses.
    """
    reception = build_reception(system, prepared)
    refuse_unheld(system, reception)
    lossy = [link for link in system.links if link.channel]
    states = sum(len(group.z_names) * group.count for group in reception.groups)
    states += sum(channels_of(link, system.peers) for link in lossy)
    if states > MOST_STATES:
        message = f"{system.peers:,} peers and their channels have {states:,} states"
        raise NotSupportedError(f"{message}, and {MOST_STATES} are the most")
    frame = hold_frame(system, reception)
    share = np.array([law.mean_loss for law in frame.laws])[:, None, None]
    n, count, width = len(frame.mean), len(frame.laws), frame.reception_errors.shape[1]
    enters = frame.input.transpose(1, 0, 2).reshape(n, count * width)
    # The frame matrix with all packets received, and the correction terms for losses.
    received = frame.mean - (share * (frame.input @ frame.reception_errors)).sum(axis=0)
    both = np.concatenate([received, frame.reception_errors.reshape(count * width, n)])
    rng = np.random.Generator(np.random.Philox(seed))
    x, total = rng.standard_normal((n, REALIZATIONS)), np.zeros(REALIZATIONS)
    for number, lost in enumerate(_lost(frame.laws, REALIZATIONS, SETTLING + FRAMES, rng)):
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
    half = float(stdtrit(REALIZATIONS - 1, QUANTILE)) * float(values.std(ddof=1)) / math.sqrt(REALIZATIONS)
    return TopLyapunovExponent(middle, (middle - half, middle + half))


def _lost(
    laws: Sequence[ChannelLaw], realizations: int, frames: int, rng: np.random.Generator
) -> Iterator[NDArray[np.bool_]]:
    """Yield, frame by frame, whether each channel loses its packet in each realization.

    Each channel starts in its stationary distribution.
    """
    names = ("p", "r", "bad", "one_minus_h", "one_minus_k")
    numbers = np.array([[getattr(law, name) for law in laws] for name in names])[..., None]
    p, r, share, in_bad, in_good = numbers
    bad = rng.random((len(laws), realizations)) < share
    for _ in range(frames):
        loss, change = rng.random((2, len(laws), realizations))
        yield loss < np.where(bad, in_bad, in_good)
        bad = np.where(bad, change >= r, change < p)
