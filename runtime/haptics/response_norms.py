"""System norms of a device's response, and the damping due to the network, as data.

Takes: nothing. Gives: `Peak`, `HinfGains`, `H2Gains`, `NetworkDamping`.
Guarantees: every number has its error.
Does not: compute them (see `extensions.system_norms`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apc.support.threads import single_threaded

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Peak:
    """An H∞ norm in SI units per newton, with `error`, and the frequency in Hz of the largest gain.

    An unstable mode has an infinite norm, and the frequency of its eigenvalue of largest magnitude.
    """

    norm: float
    error: float
    frequency_hz: float


@dataclass(frozen=True)
class HinfGains:
    """The H∞ norms of one mode: gains from a force to the velocity of devices, or to a copy's error.

    `on_ticks` is for held forces and motions read at the instants of events; `sampled_data` for arbitrary
    forces; `gains_of` computes the largest gain at each frequency, see `gains`. `of` is the output:
    "velocity" of a device, or "error", the distance of a copy from the mean of all copies in a difference
    mode of equal peers.
    """

    mode: str
    of: str
    on_ticks: Peak
    sampled_data: Peak
    gains_of: Callable[[], Floats] = field(compare=False, repr=False)

    @cached_property
    def gains(self) -> Floats:
        """The largest gain (k,) at each frequency, computed on first access: norms do not use it."""
        with single_threaded(), np.errstate(all="ignore"):
            return self.gains_of()


@dataclass(frozen=True, slots=True)
class H2Gains:
    """Root mean squares at the ticks of a frame, for independent white noise at each peer.

    `error_m` is that of a copy's distance from the mean of the others, `velocity_m_s` that of a device: for
    hand forces of 1 N rms, or position samples with errors of 1 m rms (a sensor of steps q has an error of
    q/√12). None if the noise drives a drift. `errors` are proved bounds, in this order. Motion between ticks
    is not included.
    """

    source: str
    error_m: float | None
    velocity_m_s: float | None
    errors: tuple[float | None, float | None]


@dataclass(frozen=True, slots=True)
class NetworkDamping:
    """The damping that the network adds to slow motions, in N·s/m: `network` ± `error`."""

    network: float
    error: float
