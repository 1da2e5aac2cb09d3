"""H-infinity and H2 norms of the response at a device, for the modes of its peers.

Takes: the `Responses` of a device. Gives: `hinf_gains`, `h2_gains`.
Guarantees: a variance has a proved bound; an output that drifts has no variance.
Does not: compute the norm of one mode (see `norms`).
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.extensions.system_norms.norms import noise_variance, sampled_data_peak, tick_peak
from apc.haptics.device_port import ticks_in
from apc.haptics.peer_responses import Responses, Weights
from apc.haptics.response_norms import H2Gains, HinfGains
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF

Floats = NDArray[np.float64]


def hinf_gains(response: Responses, frequency_hz: Floats) -> tuple[HinfGains, ...]:
    """Return the H∞ norms, and the gains at frequencies (k,), of the driven peer's modes."""
    result, copy = [], response.copies[response.local]
    for number, subsystem, _ in response.parts:
        loop, basis = response.loops[number], response.bases[number]
        rows = [("velocity", response.device.velocity)]
        if number and copy is not None:
            rows.append(("error", copy[1]))
        for name, row in rows:
            arguments = (loop, subsystem, subsystem, row, basis)
            result.append(
                HinfGains(
                    loop.name, name, tick_peak(*arguments), *sampled_data_peak(*arguments, frequency_hz)
                )
            )
    return tuple(result)


def h2_gains(model: Model, response: Responses) -> tuple[H2Gains, ...]:
    """Return the rms responses of the driven peer to white noise at all peers.

    The result is empty if a frame does not start with a tick of the fastest clock.
    """
    ticks = ticks_in(model, response.frame)
    if ticks is None:
        return ()
    noises = []
    for source, sensors in (("hands", False), ("sensors", True)):
        velocity = _variance(response, ticks, response.velocity, sensors=sensors)
        error = _variance(response, ticks, response.error, sensors=sensors)
        (error_m, error_off), (velocity_m_s, velocity_off) = map(_rms, (error, velocity))
        noises.append(H2Gains(source, error_m, velocity_m_s, (error_off, velocity_off)))
    return tuple(noises)


def _rms(variance: tuple[float, float] | None) -> tuple[float, float] | tuple[None, None]:
    """Return the root of a variance and its error bound, None without a variance."""
    if variance is None:
        return None, None
    value, error_bound = variance
    root = max(value, 0.0) ** 0.5
    return root, min(error_bound / root if root else np.inf, error_bound**0.5) + 2 * UNIT_ROUNDOFF * root


def _variance(
    response: Responses, ticks: list[Fraction], weights: Weights, *, sensors: bool
) -> tuple[float, float] | None:
    """Return the variance of an output of the driven peer, and its error bound; None for a drift.

    The noise is independent at each peer of a class.
    """
    if not any(weights):
        return None
    total = error_bound = 0.0
    gripped = [
        index for index, subsystem in enumerate(response.loops[0].subsystems) if subsystem.device is not None
    ]
    for (number, subsystem, share), outputs in zip(response.parts, weights, strict=False):
        sources = {subsystem: share} if number else {index: 1 / response.members[index] for index in gripped}
        if outputs:
            loop, basis = response.loops[number], response.bases[number]
            pair = noise_variance(loop, ticks, sources, outputs, basis, sensors=sensors)
            if pair is None:
                return None
            total, error_bound = total + pair[0], error_bound + pair[1]
    return total, error_bound + 2 * UNIT_ROUNDOFF * total
