"""The reference cases, end to end: from the scenes' text to the printed numbers.

Conventions: rho is the spectral radius of the map of one frame of 8 ms, the rigid mode removed; limits are
the first crossing as the stiffness grows. m = 0.1 kg and 0.2 kg a copy, b = 5 N·s/m, T_c = 1 ms, T_n = 8 ms.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import numpy as np
import pytest

import apc
from apc.analysis.analysis import Analysis, Prepared, analyze, prepare
from apc.compiler.compiled import CompiledSystem
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from tests.reference import CONTACT_LIMITS, HELPED_LIMITS, LIMITS, RADII
from tests.topologies import AVERAGE, MESH, compiled, replaced

TEXTS = {"AP": AVERAGE, "VC": MESH}
SCHEMES = ("AP", "VC")
BOTH = {"contact.delay": 0.001, "coordination.delay": 0.001, "lan.delay": 0.008}
NONE = {"contact.delay": 0.0, "coordination.delay": 0.0, "lan.delay": 0.0}


@cache
def model(scheme: str, peers: int = 3, delays: str = "all") -> CompiledSystem:
    text = replaced(
        TEXTS[scheme],
        ("count: 3", f"count: {peers}"),
        ("mass: 0.6 kg", f"mass: {peers * 2}e-1 kg"),  # 0.2 kg a copy, whatever their number
        ("link: lan", f"link: lan, delays: {delays}"),
    )
    return compiled(text)


def changed(system: CompiledSystem, values: dict[str, float]) -> CompiledSystem:
    return apply(system, [Override(Free(name), Fraction(repr(value))) for name, value in values.items()])


@cache
def prepared(scheme: str, peers: int, delays: str, delayed: bool) -> tuple[CompiledSystem, Prepared]:
    """Return a scene with its delays set and what its analyses share."""
    system = changed(model(scheme, peers, delays), BOTH if delayed else NONE)
    return system, prepare(system)


def gains(k_t: float, b_t: float, k_c: float, b_c: float) -> dict[str, float]:
    return {
        "coordination.stiffness": k_t,
        "coordination.damping": b_t,
        "contact.stiffness": k_c,
        "contact.damping": b_c,
    }


def analyse(
    scheme: str, values: dict[str, float], *, peers: int = 3, delays: str = "all", delayed: bool = True
) -> Analysis:
    system, shared = prepared(scheme, peers, delays, delayed)
    return analyze(changed(system, values), prepared=shared)


@pytest.mark.parametrize(("scheme", "peers", "delayed", "rho"), RADII)
def test_spectral_radii_are_the_reference_to_1e_8(scheme: str, peers: int, delayed: bool, rho: float) -> None:
    result = analyse(scheme, gains(800, 2, 1500, 2), peers=peers, delayed=delayed)
    assert abs(result.spectral_radius - rho) < 1e-8
    assert result.spectral_radius_error < 1e-9
    assert result.rigid_modes == 1
    assert result.verdict == "stable up to a common translation"


def limit(scheme: str, delayed: bool, delays: str, b: float, k_c: float, near: float) -> float:
    """Return the K_T at which the verdict changes, by plain bisection within a tenth of a value near it."""

    def stable(k_t: float) -> bool:
        result = analyse(scheme, gains(k_t, b, k_c, b), delays=delays, delayed=delayed)
        assert result.stable is not None
        return result.stable

    # The first crossing: everything below is stable.
    assert all(stable(near * share) for share in (0.01, 0.1, 0.3, 0.5, 0.7, 0.9))
    low, high = 0.9 * near, 1.1 * near
    assert not stable(high)
    while high - low > 1e-7 * near:
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return (low + high) / 2


@pytest.mark.parametrize(("delayed", "delays", "b", "k_c", "average", "mesh"), LIMITS)
def test_stiffness_limits_are_the_reference_to_the_last_printed_digit(
    delayed: bool, delays: str, b: float, k_c: float, average: float, mesh: float
) -> None:
    found = {
        scheme: limit(scheme, delayed, delays, b, k_c, near)
        for scheme, near in zip(SCHEMES, (average, mesh), strict=True)
    }
    assert abs(found["AP"] - average) < 0.0005 + 1e-7 * average
    assert abs(found["VC"] - mesh) < 0.0005 + 1e-7 * mesh
    ratio = found["AP"] / found["VC"]
    if b == 0:
        assert ratio == pytest.approx(2, rel=1e-6), "Fig. 3: exactly twice, without damping"
    else:
        assert 1.5 < ratio < 1.85, "Fig. 4: less than twice, with it"


def test_a_network_delay_may_widen_the_stable_range() -> None:
    """With B = 2 and K_C = 2000 the largest stable K_T of AP rises from 2602 to 3041 when it is added."""
    for late, expected in HELPED_LIMITS:
        values = {**gains(0, 2, 2000, 2), "lan.delay": late / 1000}
        for k_t, stable in ((expected - 1, True), (expected + 1, False)):
            assert analyse("AP", {**values, "coordination.stiffness": k_t}).stable is stable


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("b_c", "k_c"), CONTACT_LIMITS)
def test_contact_limits_without_coordination_are_the_reference(scheme: str, b_c: float, k_c: float) -> None:
    def stable(value: float) -> bool:
        result = analyse(scheme, gains(0, 0, value, b_c))
        assert result.rigid_modes == 3, "each of three untied peers may be moved on its own"
        assert result.stable is not None
        return result.stable

    assert stable(k_c - 0.001)
    assert not stable(k_c + 0.001)


@pytest.mark.parametrize("peers", [2, 3, 5, 20])
@pytest.mark.parametrize("delays", ["all", "own"])
def test_full_mesh_is_the_average_with_n_minus_one_times_the_gains(peers: int, delays: str) -> None:
    k_t, b_t = 800 / (peers - 1), 2 / (peers - 1)
    mesh = analyse("VC", gains(k_t, b_t, 1500, 2), peers=peers, delays=delays)
    average = analyse("AP", gains(k_t * (peers - 1), b_t * (peers - 1), 1500, 2), peers=peers, delays=delays)
    assert abs(mesh.spectral_radius - average.spectral_radius) < 1e-12
    same_multiset(mesh, average, 1e-12)


def test_two_peers_make_the_two_schemes_one() -> None:
    one, two = (analyse(scheme, gains(800, 2, 1500, 2), peers=2) for scheme in SCHEMES)
    assert one.spectral_radius == two.spectral_radius
    assert [mode.eigenvalue for mode in one.modes] == [mode.eigenvalue for mode in two.modes]


def same_multiset(one: Analysis, other: Analysis, tolerance: float) -> None:
    """Pair the eigenvalues off, nearest first; those that die in a frame, a defective zero, are left out."""

    def listed(result: Analysis) -> list[complex]:
        return [
            mode.eigenvalue
            for mode in result.modes
            for _ in range(mode.multiplicity)
            if mode.magnitude > 1e-2
        ]

    left, right = listed(one), listed(other)
    assert len(left) == len(right)
    for value in left:
        nearest = min(right, key=lambda candidate: abs(candidate - value))
        assert abs(nearest - value) < tolerance
        right.remove(nearest)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("peers", [2, 3, 4, 7, 12, 30])
def test_modes_are_the_spectrum_of_all_peers_together(scheme: str, peers: int) -> None:
    system, shared = prepared(scheme, peers, "all", True)
    # The mesh is stiffer with every peer; a stable scene has the better conditioned eigenvalues.
    system = changed(system, gains(800 if scheme == "AP" else 800 / (peers - 1), 2, 1500, 2))
    modes, dense = analyze(system, prepared=shared), analyze(system, prepared=shared, method="dense")
    assert (modes.verdict, modes.rigid_modes) == (dense.verdict, dense.rigid_modes)
    assert abs(modes.spectral_radius - dense.spectral_radius) < 1e-12
    multiplicity = {mode.shape: mode.multiplicity for mode in modes.modes}
    assert multiplicity == {"common": 1, "difference": peers - 1}
    # Equal eigenvalues of the whole spread by rounding; what is well conditioned agrees to 1e-12.
    same_multiset(modes, dense, 1e-12)


def test_a_translation_is_one_exact_mode_and_never_a_question_of_tolerance() -> None:
    for k_t in np.linspace(1, 1000, 25):
        assert analyse("AP", gains(float(k_t), 0, 1000, 0)).rigid_modes == 1


def test_a_million_users_are_two_systems_like_three() -> None:
    text = AVERAGE.replace("count: 3", "count: 1000000").replace("0.6 kg", "2e5 kg")
    many, few = apc.analyze(compiled(text)), apc.analyze(compiled(AVERAGE))
    assert many.peers == 1_000_000
    assert many.states_per_peer == few.states_per_peer == 8
    assert [m.shape for m in many.modes if m.shape == "common"] == [
        m.shape for m in few.modes if m.shape == "common"
    ]
    assert len(many.modes) == len(few.modes)
    assert {m.multiplicity for m in many.modes} == {1, 999_999}
    assert many.to_dict().keys() == few.to_dict().keys()
    # The mean over more others couples less in the difference modes: −1/(N − 1) instead of −1/2.
    assert many.verdict == few.verdict


@pytest.mark.parametrize("computed", [0.0, 0.001])
@pytest.mark.parametrize(("scheme", "expected"), [("AP", 2.3), ("VC", 4.6)])
def test_a_slow_late_network_adds_the_viscosity_of_the_formula(
    scheme: str, expected: float, computed: float
) -> None:
    """K_eff ((T_n − T_c)/2 + T_d) at K_T = 200, read off the frame map of very heavy peers.

    Device and copy of mass M each coast together as 2 M dv/dt = −(b + b + D) v; for M this large the frame
    map's slowest common eigenvalue is exp(−(2 b + D) T/(2 M)) to first order in 1/M.
    """
    heavy = 1e5
    system, shared = prepared(scheme, 3, "all", True)
    system = changed(
        system,
        {
            **gains(200, 0, 1000, 50),
            "device.mass": heavy,
            "cube.mass": 3 * heavy,
            "contact.delay": computed,
            "coordination.delay": computed,
        },
    )
    result = analyze(system, prepared=shared)
    common = [mode for mode in result.modes if mode.shape == "common" and mode.eigenvalue.imag == 0]
    slowest = max(mode.magnitude for mode in common)
    total = -np.log(slowest) / result.frame_s * 2 * heavy
    added = (200 if scheme == "AP" else 400) * ((0.008 - 0.001) / 2 + 0.008)
    assert added == pytest.approx(expected, rel=1e-12)
    assert total - 2 * 5 == pytest.approx(added, rel=1e-3)
