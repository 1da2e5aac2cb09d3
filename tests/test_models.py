"""The parts of the three-users scenes against their closed forms; `test_library_models` has the others."""

from __future__ import annotations

import cmath
import math
from typing import Any

import casadi
import numpy as np
import pytest

import apc
from apc.compiler.compiled import CompiledSystem
from tests.topologies import AVERAGE, MESH, ONE_MASS, compiled, replaced

CLOCK = "clocks: {tick: 1 ms}\n"
TWO = ONE_MASS.replace("damping: 3 N*s/m}", "damping: 3 N*s/m}\n  wall: {mass: 5 kg, damping: 1 N*s/m}")


def numbers(result: Any) -> list[float]:
    return [float(value) for value in casadi.DM(result).full().ravel()]


def derivative(system: CompiledSystem, x: list[float], u: list[float]) -> list[float]:
    """Return dx/dt of the only kind with the numbers of the scene."""
    (kind,) = system.kinds
    value = {parameter.name: parameter.value for parameter in system.parameters}
    return numbers(kind.derivative(x, u, [value[name] for name in kind.parameters], 0))


def ticked(system: CompiledSystem, x: list[float], u: list[float], r: list[float]) -> dict[str, float]:
    """Return what the only clock of the only kind computes."""
    (kind,) = system.kinds
    (clock,) = kind.clocks
    value = {parameter.name: parameter.value for parameter in system.parameters}
    p = [value[name] for name in kind.parameters]
    return dict(zip(clock.outputs, numbers(clock.tick(x, u, [], r, p, 0)), strict=True))


def test_mass_coasts_to_rest_as_an_exponential() -> None:
    """Its velocity falls to exp(−b T/m) in a time T, and a translation is left as it is."""
    result = apc.analyze(compiled(ONE_MASS))
    assert result.rigid_modes == 1
    assert result.frame_s == 1.0
    assert result.spectral_radius == pytest.approx(math.exp(-3 / 2), rel=1e-14)


def test_mass_without_damping_drifts() -> None:
    assert apc.analyze(compiled(ONE_MASS.replace("damping: 3 N*s/m", "damping: 0 N*s/m"))).verdict == "drifts"


def test_mass_of_a_shared_object_is_divided_and_its_damping_is_not() -> None:
    text = ONE_MASS.replace("damping: 3 N*s/m", "damping: 3 N*s/m, shared: true").replace(
        "count: 1", "count: 4"
    )
    assert apc.analyze(compiled(text)).spectral_radius == pytest.approx(math.exp(-3 / (2 / 4)), rel=1e-14)


def test_flange_joins_positions_and_adds_forces() -> None:
    """Two hands on one flange push with the sum of their forces: m dv/dt = F₁ + F₂ − b v."""
    text = ONE_MASS + (
        "hands:\n  one: {type: ConstantForce, flange: device, force: 5 N}\n"
        "  two: {type: ConstantForce, flange: device, force: -1 N}\n"
    )
    assert derivative(compiled(text), [0.3, 2.0], []) == [2.0, (5 - 1 - 3 * 2.0) / 2]


def test_constant_force_pushes_towards_larger_x() -> None:
    text = ONE_MASS + "hands:\n  hand: {type: ConstantForce, flange: device, force: 5 N}\n"
    system = compiled(text)
    assert derivative(system, [0.0, 0.0], []) == [0.0, 5 / 2]
    assert derivative(system, [7.0, 5 / 3], []) == [5 / 3, pytest.approx(0, abs=1e-15)], "v = F/b is steady"


def test_sampled_spring_damper_pulls_its_ends_together() -> None:
    text = (
        TWO
        + CLOCK
        + (
            "couplers: {spring: {type: SampledSpringDamper, a: device, b: wall, stiffness: 70 N/m,"
            " damping: 4 N*s/m, clock: tick}}\n"
        )
    )
    system = compiled(text)
    x = [0.5, -1.0, 0.2, 3.0]
    f = 70 * (0.5 - 0.2) + 4 * (-1.0 - 3.0)
    assert ticked(system, x, [0.0], []) == {"spring.f": pytest.approx(f, rel=1e-15)}
    assert derivative(system, x, [f]) == pytest.approx([-1.0, (-f + 3) / 2, 3.0, (f - 3) / 5], rel=1e-15)


def test_sampled_spring_damper_on_a_heavy_wall_is_the_sampled_oscillator_of_the_textbook() -> None:
    """x⁺ = A x + B u with u = −K x held over T: the eigenvalues of the exact 2×2 map, written out by hand.

    For m dv/dt = −b v + u the exact step is [1, m ρ; 0, e] and [(T − m ρ)/b; ρ], with e = exp(−b T/m) and
    ρ = (1 − e)/b. A wall of 10²⁰ kg stands still.
    """
    m, b, k, t = 2.0, 3.0, 900.0, 0.01
    e = math.exp(-b * t / m)
    rho = (1 - e) / b
    a11, a12 = 1 - k * (t - m * rho) / b, m * rho
    a21, a22 = -k * rho, e
    half, det = (a11 + a22) / 2, a11 * a22 - a12 * a21
    expected = abs(half + cmath.sqrt(half * half - det))
    text = TWO.replace("mass: 5 kg", "mass: 1e20 kg") + (
        "clocks: {tick: 10 ms}\ncouplers: {spring: {type: SampledSpringDamper, a: device, b: wall,"
        " stiffness: 900 N/m, clock: tick}}\n"
    )
    magnitudes = [mode.magnitude for mode in apc.analyze(compiled(text)).modes]
    assert min(abs(magnitude - expected) for magnitude in magnitudes) < 1e-13


@pytest.mark.parametrize(("name", "weight"), [("AveragePosition", 1), ("FullMesh", 3)])
def test_average_position_and_full_mesh_follow_their_equations(name: str, weight: int) -> None:
    """F_T = K (x − mean x_j) + B (v − mean v_j), and Σ_j K (x − x_j) + B (v − v_j), for four peers."""
    text = (
        ONE_MASS.replace("count: 1", "count: 4")
        + CLOCK
        + (
            "links: {lan: {clock: tick}}\n"
            f"couplers: {{all: {{type: {name}, object: device, stiffness: 70 N/m, damping: 4 N*s/m,"
            " clock: tick, link: lan}}\n"
        )
    )
    system = compiled(text)
    x, v = 0.5, -1.0
    others = [(0.1, 2.0), (-0.3, 1.0), (0.4, -5.0)]
    heard = [sum(one[i] for one in others) / (3 if name == "AveragePosition" else 1) for i in (0, 1)]
    expected = sum(70 * (x - x_j) + 4 * (v - v_j) for x_j, v_j in others) * weight / 3
    found = ticked(system, [x, v], [0.0], heard)
    assert found == {"all.f": pytest.approx(expected, rel=1e-14)}
    assert derivative(system, [x, v], [expected]) == pytest.approx([v, (-expected - 3 * v) / 2], rel=1e-14)


def test_average_position_over_a_fast_network_is_a_spring_of_n_over_n_minus_one() -> None:
    """In the difference mode x − mean of the others = x N/(N − 1): 3/2 K for three peers, 5/4 K for five."""
    for n, factor in ((3, 1.5), (5, 1.25)):
        assert effective("AveragePosition", n) == pytest.approx(factor, rel=1e-3)


def test_full_mesh_over_a_fast_network_is_a_spring_of_n() -> None:
    for n in (3, 5):
        assert effective("FullMesh", n) == pytest.approx(n, rel=1e-3)


def effective(name: str, n: int) -> float:
    """Return (ω/ω₀)² of the difference mode of n undamped masses, ω₀² = K/m, sampled finely."""
    text = ONE_MASS.replace("count: 1", f"count: {n}").replace("damping: 3 N*s/m", "damping: 0 N*s/m") + (
        "clocks: {tick: 10 us}\nlinks: {lan: {clock: tick}}\n"
        f"couplers: {{all: {{type: {name}, object: device, stiffness: 200 N/m, clock: tick, link: lan}}}}\n"
    )
    result = apc.analyze(compiled(text))
    mode = next(mode for mode in result.modes if mode.shape == "difference")
    return (2 * math.pi * mode.frequency_hz) ** 2 / (200 / 2)


@pytest.mark.parametrize("text", [AVERAGE, MESH])
def test_average_position_and_full_mesh_may_delay_their_own_part_only(text: str) -> None:
    """`delays: own` holds both parts apart: the heard part acts at once."""
    system = compiled(replaced(text, ("link: lan", "link: lan, delays: own")))
    (kind,) = system.kinds
    assert [(hold.name, hold.delay) for hold in kind.holds] == [
        ("contact.f", "contact.delay"),
        ("coordination.own", "coordination.delay"),
        ("coordination.received", "no delay"),
    ]
    found = derivative(system, [0.0] * 4, [0.0, 1.0, 10.0])
    assert found[3] == pytest.approx(-11 / 0.2, rel=1e-15)


def test_link_brings_each_packet_after_its_delay() -> None:
    """A mass that follows another, undriven one: M has the link's delay as a chain of shifts."""
    text = (
        ONE_MASS.replace("count: 1", "count: 2")
        + CLOCK
        + (
            "links: {lan: {clock: tick, delay: 3 ms}}\n"
            "couplers: {all: {type: AveragePosition, object: device, stiffness: 70 N/m, clock: tick,"
            " link: lan}}\n"
        )
    )
    result = apc.analyze(compiled(text), method="dense")
    assert result.states_per_peer == 2 + 2 * 3, "x and v, each three packets deep"
    # One peer of two, in the difference mode, hears minus its own past: x⁺ = A x + B K (−x − x(−3 ms)).
    m, b, k, t = 2.0, 3.0, 70.0, 0.001
    e = math.exp(-b * t / m)
    rho = (1 - e) / b
    a = np.array([[1, m * rho], [0, e]])
    shove = np.array([[(t - m * rho) / b], [rho]]) @ np.array([[k, 0.0]])
    shift = np.zeros((5, 5))
    shift[:2, :2], shift[:2, 4] = a - shove, -shove[:, 0]
    shift[2, 0], shift[3, 2], shift[4, 3] = 1, 1, 1
    expected = max(abs(np.linalg.eigvals(shift)))
    assert result.spectral_radius == pytest.approx(expected, rel=1e-12)
