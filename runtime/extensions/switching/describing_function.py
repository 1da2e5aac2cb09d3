"""Limit cycles of one-sided contacts, predicted by their describing function in the linear loop.

Takes: a `Model` whose peers have one-sided contacts.
Gives: `Predicted`, `predict`; `gain_of`, `load_of`.
Guarantees: the gain at which the loop is marginal is correct to rounding.
Does not: cover a second frequency, or contacts that share a motion in another ratio than their loads; decide
whether the motion converges to it (simulate: see `extensions.switching.limit_cycle`).

A contact f = max(0, y) with y = Y (β + cos ωt), −1 < β < 1, acts at ω as a linear one of the gain g(β), has
the mean Y m(β), and is closed for the share s(β) of the time (Gelb and Vander Velde, 1968):

    g = ½ + [asin β + β √(1 − β²)]/π    m = [√(1 − β²) + β (π/2 + asin β)]/π    s = ½ + asin(β)/π

All contacts have one β where the amplitude of each is in proportion to its load: g(β) is then the gain at
which the loop with linear contacts is marginal, ω its frequency, and Y m(β) the load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

from scipy.optimize import brentq

from apc.compiler.compiled import Model
from apc.extensions.switching.lure_form import with_gain
from apc.extensions.switching.sector_nonlinearity import SectorNonlinearity
from apc.parameter_values.parameters import resolve
from apc.spectrum.interconnection import close_loop
from apc.spectrum.modes import decompose
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.spectrum import Spectrum, solve_spectrum
from apc.support.not_supported import NotSupportedError
from apc.timing.communication_graph import CommunicationGraph, build_comm_graph

# Gains tried between 1 and 0, in descending order, and the relative tolerance of a root.
CELLS, NEAR = 32, 1e-15

# The tolerance of a marginal mode's magnitude around 1.
MARGINAL = 1e-6


@dataclass(frozen=True, slots=True)
class Predicted:
    """A limit cycle predicted by the describing function.

    `gain` is the share of the contact's stiffness at which the loop is marginal, `bias` β, `in_contact` the
    share of the time. `attracts` states that the limit cycle is stable: the loop is unstable with contacts
    always closed, and stable with weaker ones; otherwise smaller oscillations decay, and larger ones grow.
    """

    frequency_hz: float
    gain: float
    bias: float
    in_contact: float
    attracts: bool

    @property
    def peak_to_peak(self) -> float:
        """The peak-to-peak amplitude of a contact's y, under a load of 1."""
        return 2 / load_of(self.bias)


def gain_of(bias: float) -> float:
    """Return g(β), the equivalent gain of a one-sided contact at the bias β, −1 ≤ β ≤ 1."""
    return 0.5 + (math.asin(bias) + bias * math.sqrt(1 - bias * bias)) / math.pi


def load_of(bias: float) -> float:
    """Return m(β), the mean force of a one-sided contact at the bias β, for an amplitude of 1."""
    return (math.sqrt(1 - bias * bias) + bias * (math.pi / 2 + math.asin(bias))) / math.pi


def predict(model: Model, with_contacts: list[tuple[PeerClass, tuple[SectorNonlinearity, ...]]]) -> Predicted:
    """Return the limit cycle of a model that the describing function predicts.

    Parameters
    ----------
    model
        The compiled model.
    with_contacts
        From `lure_form.contact_classes`.

    Raises
    ------
    NotSupportedError
        The reason why no limit cycle is predicted.
    """
    comm_graph = build_comm_graph(model, resolve(model).timings)

    def spectrum_at(gain: float) -> Spectrum:
        """Return the spectrum of the loop with linear contacts of this share of their stiffness."""
        return _spectrum(with_contacts, comm_graph, gain)

    def excess(gain: float) -> float:
        """Return the excess over 1 of the spectral radius with linear contacts of this share of their
        stiffness.
        """
        return spectrum_at(gain).spectral_radius - 1

    gains = [cell / CELLS for cell in range(CELLS, 0, -1)]
    unstable = excess(1.0) > 0
    lower_gain = next((gain for gain in gains if (excess(gain) > 0) != unstable), None)
    if lower_gain is None:
        word = "unstable" if unstable else "stable"
        raise NotSupportedError(f"no limit cycle: {word} at every fraction of the contact stiffness")
    gain = brentq(excess, lower_gain, lower_gain + 1 / CELLS, xtol=NEAR)
    spectrum = spectrum_at(gain)
    frequency = max(
        (mode.frequency_hz for mode in spectrum.modes if abs(mode.magnitude - 1) < MARGINAL), default=0.0
    )
    if not frequency:
        message = f"with {gain:.6g} of the contact stiffness the motion drifts without oscillation"
        raise NotSupportedError(f"no limit cycle: {message}")
    bias = brentq(lambda trial_bias: gain_of(trial_bias) - gain, -1, 1, xtol=NEAR)
    return Predicted(frequency, gain, bias, 0.5 + math.asin(bias) / math.pi, unstable)


def _spectrum(
    with_contacts: list[tuple[PeerClass, tuple[SectorNonlinearity, ...]]],
    comm_graph: CommunicationGraph,
    gain: float,
) -> Spectrum:
    """Return the spectrum of the model with linear contacts of a reduced stiffness."""
    scaled_classes = [with_gain(peer_class, forces, Fraction(gain)) for peer_class, forces in with_contacts]
    return solve_spectrum(
        [close_loop(modal_system) for modal_system in decompose(scaled_classes, comm_graph).loops]
    )
