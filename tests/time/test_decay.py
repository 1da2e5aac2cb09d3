"""Decay rate and frequency of synthetic signals whose rates and frequencies are known, for any duration."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.simulation.decay import Fit, fit_motion

Floats = NDArray[np.float64]
DURATIONS = [0.1, 0.25, 1.0, 2.0, 8.0, 60.0]


def fitted(x: Floats) -> Fit:
    found = fit_motion(1e-3, x[:, None], np.array([np.ptp(x)]))
    assert found is not None
    return found


def instants(seconds: float) -> Floats:
    return np.arange(round(1000 * seconds) + 1) * 1e-3


@pytest.mark.parametrize("seconds", DURATIONS)
@pytest.mark.parametrize("rate", [-10.0, -0.25, -1e-3, 0.0, 1e-3, 0.25, 10.0])
@pytest.mark.parametrize("hertz", [14.41, 237.0])
def test_an_oscillation_has_its_rate_and_frequency(hertz: float, rate: float, seconds: float) -> None:
    t = instants(seconds)
    found = fitted(0.3 + np.exp(rate * t) * np.cos(2 * np.pi * hertz * t))
    assert abs(found.rate - rate) <= found.error < 1e-4
    assert (found.decays, found.grows, found.lasts) == (rate < 0, rate > 0, rate == 0)
    assert found.oscillation is not None and not found.ramp
    assert abs(found.oscillation.frequency - hertz) <= found.oscillation.error < 1e-4


@pytest.mark.parametrize("seconds", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("rate", [-10.0, -0.25, 0.8])
def test_a_real_exponential_has_its_rate_and_no_frequency(rate: float, seconds: float) -> None:
    found = fitted(1 + np.exp(rate * instants(seconds)))
    assert abs(found.rate - rate) <= found.error < 1e-4
    assert found.oscillation is None and not found.ramp


@pytest.mark.parametrize("seconds", [1.0, 4.0])
def test_of_several_modes_the_slowest_counts(seconds: float) -> None:
    t = instants(seconds)
    fast, slow = np.exp(-2 * t) * np.cos(2 * np.pi * 15 * t), np.exp(-t / 4) * np.cos(2 * np.pi * 14 * t)
    found = fitted(fast + 0.5 * slow)
    assert abs(found.rate + 0.25) <= found.error < 1e-4


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("seconds", [0.5, 2.0, 8.0])
def test_what_moves_on_is_a_ramp_and_neither_decays_nor_oscillates(seconds: float, power: int) -> None:
    found = fitted(instants(seconds) ** power)
    assert found.ramp and not found.decays and not found.grows and found.oscillation is None


@pytest.mark.parametrize("seconds", [2.0, 3.0, 6.0, 20.0])
@pytest.mark.parametrize("slow", ["ramp", "decay", "sway"])
def test_a_fast_ripple_about_a_slow_motion_is_no_alias(slow: str, seconds: float) -> None:
    t = instants(seconds)
    about = {
        "ramp": 0.2 * t,
        "decay": np.exp(-8 * t / seconds),
        "sway": 1e-4 * np.sin(2 * np.pi * t / seconds),
    }
    found = fitted(about[slow] + 1e-5 * np.sin(2 * np.pi * 125 * t + 0.3))
    assert found.ramp is (slow == "ramp")
    if slow == "ramp":
        assert found.oscillation is not None
        assert abs(found.oscillation.frequency - 125) <= max(found.oscillation.error, 1e-3)
    elif found.oscillation is not None:
        hertz = found.oscillation.frequency
        assert min(abs(hertz - 125), abs(hertz - 1 / seconds)) <= max(found.oscillation.error, 0.1 / seconds)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rate", [-1.0, 0.0, 1.0])
def test_the_error_holds_under_noise(rate: float, seed: int) -> None:
    t = instants(3.0)
    noise = 1e-3 * np.random.default_rng(seed).normal(size=len(t))
    found = fitted(np.exp(rate * t) * np.cos(2 * np.pi * 14.41 * t) + noise)
    assert abs(found.rate - rate) <= found.error
    assert (found.decays, found.grows, found.lasts) == (rate < 0, rate > 0, rate == 0)
    assert found.oscillation is not None
    assert abs(found.oscillation.frequency - 14.41) <= found.oscillation.error < 1


def test_what_is_noise_alone_or_too_short_has_no_known_rate() -> None:
    noise = np.random.default_rng(0).normal(size=2000)
    assert not fitted(noise).grows and not fitted(noise).decays
    t = instants(0.03)
    short = fitted(np.cos(2 * np.pi * 2 * t) + 1e-3 * noise[: len(t)])
    assert not (short.grows or short.decays or short.lasts)
    assert fit_motion(1e-3, np.zeros((1000, 1)), np.ones(1)) is None


def test_what_has_ended_has_the_rate_that_it_had() -> None:
    t = instants(5.0)
    found = fitted(2 + np.exp(-20 * t) * np.cos(2 * np.pi * 14.41 * t))
    assert found.ended and abs(found.rate + 20) <= found.error < 1e-4


def test_angles_and_lengths_are_fitted_together() -> None:
    """Two positions of other modes: the rate is that of the slower mode, the frequency of the larger one."""
    t = instants(4.0)
    x = np.stack(
        [np.exp(-t) * np.cos(2 * np.pi * 5 * t), 3 * np.exp(-t / 5) * np.cos(2 * np.pi * 9 * t)], axis=1
    )
    found = fit_motion(1e-3, x, np.ptp(x, axis=0))
    assert found is not None and abs(found.rate + 0.2) <= found.error < 1e-4
    assert found.oscillation is not None and found.oscillation.index == 1
    assert abs(found.oscillation.frequency - 9) <= found.oscillation.error < 1e-4
