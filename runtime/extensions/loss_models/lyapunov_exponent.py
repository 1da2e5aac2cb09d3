"""Monte Carlo estimate of the top Lyapunov exponent of a model with packet losses, per frame.

Takes: a `NumericModel` whose links lose packets, whose receivers hold the last received value.
Gives: `top_lyapunov_exponent`.
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

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from apc.extensions.loss_models.loss_patterns import channels_of, hold_frame, refuse_unheld
from apc.lifting.numeric_model import NumericModel
from apc.mean_square.class_moments import build_reception
from apc.mean_square.loss_results import TopLyapunovExponent
from apc.network.channel import ChannelLaw
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import LYAPUNOV_STATES

# Realizations, the frames evaluated in each, and the frames before, for the directions to become stationary.
# Realizations are long rather than many, as the error of the first frames occurs once in each.
REALIZATIONS, FRAMES, SETTLING = 64, 16_384, 1024

# Frames between two evaluations of the norm, in which no state under- or overflows.
STRIDE = 8

# The quantile of 95 % on both sides together.
QUANTILE = 0.975


def top_lyapunov_exponent(numeric: NumericModel) -> TopLyapunovExponent:
    """Return a Monte Carlo estimate of the top Lyapunov exponent of a model, per frame.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    """
    model = numeric.model
    reception = build_reception(numeric)
    refuse_unheld(model, reception)
    lossy = [link for link in model.links if link.channel]
    states = sum(len(peer_class.z_names) * peer_class.count for peer_class in reception.peer_classes)
    states += sum(channels_of(link, model.peers) for link in lossy)
    if states > LYAPUNOV_STATES:
        message = f"{model.peers:,} peers and their channels have {states:,} states"
        raise NotSupportedError(f"{message}; the limit is {LYAPUNOV_STATES}")
    frame = hold_frame(model, reception)
    share = np.array([law.mean_loss for law in frame.laws])[:, None, None]
    n, count, width = len(frame.mean), len(frame.laws), frame.reception_errors.shape[1]
    noise_inputs = frame.input.transpose(1, 0, 2).reshape(n, count * width)
    # The frame matrix with all packets received, and the correction terms for losses.
    received = frame.mean - (share * (frame.input @ frame.reception_errors)).sum(axis=0)
    stacked = np.concatenate([received, frame.reception_errors.reshape(count * width, n)])
    rng = np.random.Generator(np.random.Philox(0))
    x, total = rng.standard_normal((n, REALIZATIONS)), np.zeros(REALIZATIONS)
    for number, lost in enumerate(_sample_losses(frame.laws, REALIZATIONS, SETTLING + FRAMES, rng)):
        product = stacked @ x
        x = product[:n] + noise_inputs @ (product[n:] * np.repeat(lost, width, axis=0))
        if (number + 1) % STRIDE == 0:
            size = np.linalg.norm(x, axis=0)
            if not size.all():  # all states are 0
                return TopLyapunovExponent(-math.inf, (-math.inf, -math.inf))
            x /= size
            total += np.log(size) * (number >= SETTLING)
    values = total / FRAMES
    middle = float(values.mean())
    half_width = (
        float(stdtrit(REALIZATIONS - 1, QUANTILE)) * float(values.std(ddof=1)) / math.sqrt(REALIZATIONS)
    )
    return TopLyapunovExponent(middle, (middle - half_width, middle + half_width))


def _sample_losses(
    laws: Sequence[ChannelLaw], realizations: int, frames: int, rng: np.random.Generator
) -> Iterator[NDArray[np.bool_]]:
    """Yield, frame by frame, whether each channel loses its packet in each realization (channels,
    realizations).

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
