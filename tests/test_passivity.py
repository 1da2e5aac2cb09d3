"""Published conditions: their numbers, and what they promise of real scenes."""

from __future__ import annotations

import numpy as np
import pytest

import apc
from apc.regions.passivity import (
    CONDITIONS,
    abbott_limit,
    colgate_limit,
    diolaiti_limit,
    gil_limit,
)
from tests.topologies import wall


def critical(mass: float, damping: float, delay: float, virtual: float) -> float:
    """Return the stiffness at which the wall's spectral radius passes 1, by bisection, to 1e-9."""
    model = wall(mass, damping, delay, 100.0, virtual)
    low, high = 100.0, 50_000.0
    while high / low > 1 + 1e-9:
        middle = (low * high) ** 0.5
        stable = apc.analyze(apc.set_parameters(model, {"it.stiffness": f"{middle!r} N/m"})).stable
        low, high = (middle, high) if stable else (low, middle)
    return low


@pytest.mark.parametrize(("virtual", "limit"), [(0.0, 1600.0), (0.4, 800.0), (-0.4, 800.0), (0.9, 0.0)])
def test_colgate_and_schenkel_allow_the_published_stiffness(virtual: float, limit: float) -> None:
    # 2 (0.8 − |B|)/0.001; nothing at all where the wall's damping exceeds the device's.
    assert colgate_limit(0.8, virtual, 0.001) == pytest.approx(limit, rel=1e-15)


@pytest.mark.parametrize("virtual", [0.0, 0.1, 0.4, -0.3])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_colgate_and_schenkel_agree_with_their_own_general_condition(virtual: float, share: float) -> None:
    """b > T/2 · Re((1 − 1/z) H(z))/(1 − cos ωT), z = e^{jωT}, all ω up to Nyquist, H = K + B (1 − 1/z)/T."""
    b, period = 0.8, 0.001
    stiffness = share * float(colgate_limit(b, virtual, period))
    z = np.exp(1j * np.linspace(1e-3, np.pi, 4001))
    impedance = stiffness + virtual * (1 - 1 / z) / period
    needed = period / 2 * ((1 - 1 / z) * impedance).real / (1 - z.real)
    assert bool((needed < b).all()) is (share < 1)


@pytest.mark.parametrize(
    ("mass", "damping", "delay", "linear", "exact"),
    [(0.1, 5.0, 0.001, 3333.333, 3378.939), (0.04, 0.8, 0.0, 1600.0, 1605.351)],
)
def test_the_linear_condition_is_within_4_percent_of_a_walls_exact_limit(
    mass: float, damping: float, delay: float, linear: float, exact: float
) -> None:
    assert gil_limit(damping, 0.0, 0.001, delay) == pytest.approx(linear, abs=5e-4)
    assert diolaiti_limit(damping, 0.001, delay) == gil_limit(damping, 0.0, 0.001, delay)
    found = critical(mass, damping, delay, 0.0)
    assert found == pytest.approx(exact, abs=5e-4)  # printed to three decimals
    assert linear == pytest.approx(found, rel=0.04)


@pytest.mark.parametrize(("virtual", "delay"), [(2.0, 0.0), (2.0, 0.001), (5.0, 0.001)])
def test_the_linear_condition_holds_with_a_damped_wall_too(virtual: float, delay: float) -> None:
    # Little damping for the mass: (b + B) T/m is 0.03 at most.
    assert gil_limit(5.0, virtual, 0.001, delay) == pytest.approx(
        critical(0.4, 5.0, delay, virtual), rel=0.04
    )


@pytest.mark.parametrize("virtual", [0.0, 0.2, 0.6])
def test_a_passive_wall_is_stable(virtual: float) -> None:
    limit = float(colgate_limit(0.8, virtual, 0.001))
    assert apc.analyze(wall(0.04, 0.8, 0.0, 0.999 * limit, virtual)).stable


def test_quantization_sets_a_ceiling_that_friction_raises() -> None:
    # Encoder step 61.4 µm, friction 0.02 N: 2·0.02/61.4e-6 = 651.5 N/m is below 2·0.8/1e-3 = 1600 N/m.
    assert abbott_limit(0.8, 0.001, 0.02, 6.14e-5) == pytest.approx(651.4657980456026, rel=1e-12)
    assert abbott_limit(0.8, 0.001, 0.2, 6.14e-5) == pytest.approx(1600, rel=1e-15)


def test_limits_work_over_arrays() -> None:
    virtual = np.array([0.0, 0.2, 0.4])
    assert colgate_limit(0.8, virtual, 0.001) == pytest.approx(2 * (0.8 - virtual) / 0.001)
    assert gil_limit(0.8, virtual, 0.001, [0.0, 0.001, 0.002]).shape == (3,)


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_margin_changes_sign_at_its_limit(name: str) -> None:
    condition = CONDITIONS[name]
    numbers = {"b": 0.8, "B": 0.1, "T": 0.001, "t_d": 0.002, "c": 0.02, "D": 6e-5}
    rest = [numbers[symbol] for symbol in condition.symbols[1:]]
    limit = float(condition.limit(*rest))
    assert condition.margin(0.999 * limit, *rest) > 0 > condition.margin(1.001 * limit, *rest)
    assert condition.source and condition.assumptions
    assert condition.formula in str(condition) and condition.source in str(condition)
