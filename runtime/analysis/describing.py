"""The buzz of one-sided contacts, predicted: their describing function in the linear loop.

Takes: a `Model` whose peers have one-sided contacts.
Gives: `Predicted`, `predict`; `gain_of`, `load_of`.
Guarantees: the gain at which the loop is marginal is found to rounding.
Does not: see a second frequency, or that contacts share a motion otherwise than their loads; say whether the
motion gets there (play it: see `simulation.buzz`).

A contact f = max(0, y) that moves as y = Y (β + cos ωt), −1 < β < 1, pushes at ω as a linear one of the gain
g(β), on the mean by Y m(β), and is closed for the share s(β) of the time (Gelb and Vander Velde, 1968):

    g = ½ + [asin β + β √(1 − β²)]/π    m = [√(1 − β²) + β (π/2 + asin β)]/π    s = ½ + asin(β)/π

All contacts move with one β where each moves as far as its load presses: g(β) is then the gain at which the
loop with linear contacts is marginal, ω its frequency, and Y m(β) the load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

from scipy.optimize import brentq

from apc.analysis.opened import with_gain
from apc.analysis.pushes import SectorNonlinearity
from apc.compiler.compiled import Model
from apc.eigen.closing import close_loop
from apc.eigen.modes import arrange
from apc.eigen.peers import PeerClass
from apc.eigen.spectrum import Spectrum, solve_spectrum
from apc.frame.exchange import CommunicationGraph, build_exchange
from apc.frame.parameters import resolve
from apc.unserved import NotSupportedError

# Gains tried between 0 and 1 on the way from 1 down, and how near the root of an equation is to be had.
CELLS, NEAR = 32, 1e-15

# How near 1 the magnitude of a mode is that is marginal.
MARGINAL = 1e-6


@dataclass(frozen=True, slots=True)
class Predicted:
    """A limit cycle as the describing function has it.

    `gain` is the share of the contact's stiffness at which the loop is marginal, `bias` β, `in_contact` the
    share of the time. `attracts` says that the motion comes back to it: with contacts always closed it is
    unstable, with weaker ones stable; otherwise what swings less dies out, and what swings more grows.
    """

    frequency_hz: float
    gain: float
    bias: float
    in_contact: float
    attracts: bool

    @property
    def peak_to_peak(self) -> float:
        """What a contact's y swings by, in all, under a load of 1."""
        return 2 / load_of(self.bias)


def gain_of(bias: float) -> float:
    """Return g(β)."""
    return 0.5 + (math.asin(bias) + bias * math.sqrt(1 - bias * bias)) / math.pi


def load_of(bias: float) -> float:
    """Return m(β)."""
    return (math.sqrt(1 - bias * bias) + bias * (math.pi / 2 + math.asin(bias))) / math.pi


def predict(system: Model, groups: list[tuple[PeerClass, tuple[SectorNonlinearity, ...]]]) -> Predicted:
    """Predict the buzz of a scene.

    Parameters
    ----------
    system
        The compiled scene.
    groups
        From `opened.contact_groups`.

    Raises
    ------
    NotSupportedError
        Why there is none to predict.
    """
    exchange = build_exchange(system, resolve(system).timings)

    def at(gain: float) -> Spectrum:
        return _spectrum(groups, exchange, gain)

    def excess(gain: float) -> float:
        return at(gain).spectral_radius - 1

    gains = [cell / CELLS for cell in range(CELLS, 0, -1)]
    unstable = excess(1.0) > 0
    below = next((gain for gain in gains if (excess(gain) > 0) != unstable), None)
    if below is None:
        word = "unstable" if unstable else "stable"
        raise NotSupportedError(f"no buzz: with contacts of any part of their stiffness it is {word}")
    gain = brentq(excess, below, below + 1 / CELLS, xtol=NEAR)
    spectrum = at(gain)
    frequency = max(
        (mode.frequency_hz for mode in spectrum.modes if abs(mode.magnitude - 1) < MARGINAL), default=0.0
    )
    if not frequency:
        what = f"with contacts of {gain:.6g} of their stiffness it drifts away without swinging"
        raise NotSupportedError(f"no buzz: {what}")
    bias = brentq(lambda item: gain_of(item) - gain, -1, 1, xtol=NEAR)
    return Predicted(frequency, gain, bias, 0.5 + math.asin(bias) / math.pi, unstable)


def _spectrum(
    groups: list[tuple[PeerClass, tuple[SectorNonlinearity, ...]]], exchange: CommunicationGraph, gain: float
) -> Spectrum:
    """Solve the scene with linear contacts of a part of their stiffness."""
    weaker = [with_gain(group, pushes, Fraction(gain)) for group, pushes in groups]
    return solve_spectrum([close_loop(loop) for loop in arrange(weaker, exchange).loops])
