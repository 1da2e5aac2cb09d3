"""Claims about `characteristic`, `zeros`, `determinant`, `determinant_spectrum`: many peers, a small one."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import Analysis, analyze, lifted_groups
from apc.compiler.pipeline import compile_topology
from apc.eigen.modes import arrange, complete_loops, dense, split
from apc.eigen.spectrum import Spectrum
from apc.frame.overrides import apply, parse_override
from apc.large.characteristic import characteristic_ball, refine
from apc.large.determinant import of_populations
from apc.large.determinant_spectrum import solve_loops, solve_populations
from apc.large.translation import count_translations
from apc.large.zeros import beyond, find_zeros, near_poles
from tests.bruteforce import Scene, frame_matrix
from tests.populations import crowded, different
from tests.sites import MS, columned, grouped, linked, paper
from tests.topologies import SCENES

VARIED: list[dict[str, Any]] = [
    {},
    {"operator": "sum"},
    {"kc": 2400.0},
    {"kt": 6000.0},
    {"comp": Fraction(0), "comm": Fraction(0)},
    {"comp": MS * 5 / 2, "comm": 4 * MS},
    {"haptic": 2 * MS, "network": 3 * MS},
    {"haptic": 3 * MS, "network": 2 * MS, "comp": Fraction(0), "comm": Fraction(0), "operator": "sum"},
    {"comm": 30 * MS},
    {"kt": 0.0},
]


def _solved(system: Any) -> Spectrum:
    listed, exchange = crowded(system)
    return solve_populations(listed, exchange, rigid=count_translations(listed, exchange) or 0)


def _agree(found: Spectrum | Analysis, whole: Analysis) -> None:
    """The radius is the whole's within its bound; every mode listed is one of the whole, as described."""
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-12)
    apart = abs(found.spectral_radius - whole.spectral_radius)
    assert apart <= found.spectral_radius_error + whole.spectral_radius_error
    assert found.spectral_radius_error < 1e-7
    for mode in found.modes:
        same = min(whole.modes, key=lambda one: abs(one.eigenvalue - mode.eigenvalue))
        assert abs(same.eigenvalue - mode.eigenvalue) <= mode.error + same.error
        assert abs(same.eigenvalue - mode.eigenvalue) < 1e-11
        assert mode.frequency_hz == pytest.approx(same.frequency_hz, abs=1e-9)
        assert mode.damping_ratio == pytest.approx(same.damping_ratio, abs=1e-10)
    if found.modes:  # the shares of all peers together
        mode = found.modes[0]
        same = min(whole.modes, key=lambda one: abs(one.eigenvalue - mode.eigenvalue))
        shares: dict[str, float] = {}
        for name, share in same.participation:
            name = name.split("].")[-1]
            name = name.split("(")[0] if "sent(" in name else name
            shares[name] = shares.get(name, 0.0) + share
        for name, share in mode.participation:
            assert share == pytest.approx(shares[name.split("user.")[-1]], abs=1e-8)


@pytest.mark.few(10)
@pytest.mark.parametrize("values", VARIED)
@pytest.mark.parametrize("peers", [2, 5, 12])
def test_different_peers_have_the_spectral_radius_of_their_whole_matrix(
    peers: int, values: dict[str, Any]
) -> None:
    values = dict(values)
    system = different(peers, values.pop("operator", "mean"), **values)
    _agree(_solved(system), analyze(system, method="dense"))


def test_sixty_different_peers_do_too() -> None:
    system = different(60)
    found, whole = analyze(system), analyze(system, method="dense")
    assert (found.method, whole.method) == ("determinant", "dense")
    _agree(found, whole)


def test_independent_brute_force_agrees() -> None:
    masses = np.linspace(0.1, 0.3, 6)
    gains = {"kt": 300.0, "bt": 1.0, "kc": 900.0, "bc": 1.0}
    found = _solved(columned(paper(peers=6, **gains), device__mass=masses))
    scene = Scene(peers=6, users=tuple({"device": mass} for mass in masses), **gains)
    values = np.linalg.eigvals(np.array(frame_matrix(scene)))
    others = np.sort(np.abs(values[np.abs(values - 1) > 1e-9]))
    assert found.spectral_radius == pytest.approx(others[-1], abs=1e-12)


def test_equal_peers_among_different_ones_are_counted() -> None:
    masses = [0.1, 0.1, 0.1, 0.2, 0.2, 0.3, 0.15, 0.15, 0.12]
    system = columned(paper(peers=9, kt=400.0), device__mass=masses)
    _agree(_solved(system), analyze(system, method="dense"))
    [population], _ = crowded(system)
    assert population.counts.tolist() == [3.0, 2.0, 1.0, 2.0, 1.0]


PAIRS = {("left", "right"): 12 * MS, ("right", "left"): 3 * MS, ("right", "right"): 8 * MS}


@pytest.mark.parametrize("delays", [{}, PAIRS])
def test_groups_with_delays_of_their_own_are_one_determinant(delays: dict[tuple[str, str], Fraction]) -> None:
    base = grouped(paper(kt=300.0), ("left", 3, {"device.mass": 0.3}), ("right", 2, {"cube.mass": 0.1}))
    system = linked(base, delays=delays)
    found, whole = _solved(system), analyze(system, method="dense")
    assert found.verdict == whole.verdict
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-12)
    assert found.spectral_radius_error < 1e-7


@pytest.mark.parametrize("radius", [0.7, 0.8, 0.9, 0.95, 1.05])
def test_a_count_is_the_number_of_eigenvalues_of_the_whole_matrix(radius: float) -> None:
    system = different(8, kt=2000.0)
    values = np.linalg.eigvals(dense(*lifted_groups(system)).matrix)
    function, _ = of_populations(*crowded(system))
    assert beyond(function, radius, 0) == int((np.abs(values) > radius).sum())


def test_newtons_method_finds_zeros_and_says_where_it_does_not() -> None:
    system = different(5)
    values = np.linalg.eigvals(dense(*lifted_groups(system)).matrix)
    function, _ = of_populations(*crowded(system))
    poles = near_poles(function, 8)
    for zero in refine(function, poles * (1 + 1e-7), poles=poles):
        assert np.isnan(zero) or np.abs(values - zero).min() < 1e-12


def test_the_function_stays_within_its_ball() -> None:
    function, _ = of_populations(*crowded(different(6)))
    points, reach = np.array([1.05, 0.9 + 0.6j, -1.0]), np.full(3, 1e-3)
    centre = characteristic_ball(function, points, reach)
    random = np.random.default_rng(0)
    for _ in range(20):
        there = points + reach * np.exp(2j * np.pi * random.random(3))
        turned = characteristic_ball(function, there, np.zeros(3)).direction / centre.direction
        assert np.all(np.abs(np.angle(turned)) <= np.arcsin(np.minimum(centre.change, 1.0)))


def test_what_is_said_to_be_rigid_and_is_not_leaves_the_verdict_open() -> None:
    listed, exchange = crowded(different(6))
    wrong = solve_populations(listed, exchange, rigid=0)
    assert wrong.stable is None


# ---- delays of many frames ----


@pytest.mark.parametrize("frames", [1, 7, 20, 50])
@pytest.mark.parametrize(
    "values", [{"kt": 5.0, "kc": 500.0}, {"kt": 20.0, "bt": 0.2, "bc": 1.0}, {"kt": 300.0}]
)
def test_long_delays_have_the_spectral_radius_of_the_whole_matrix(
    frames: int, values: dict[str, float]
) -> None:
    system = paper(peers=3, comm=8 * MS * frames, **values)
    found = solve_loops(complete_loops(*lifted_groups(system)))
    systems = split(*lifted_groups(system)).systems
    values_of = np.concatenate([np.linalg.eigvals(one.matrix) for one in systems])
    truth = np.abs(values_of[np.abs(values_of - 1) > 1e-9]).max()
    assert found.rigid_modes == 1
    assert found.spectral_radius == pytest.approx(truth, abs=1e-10)
    assert found.spectral_radius_error < 1e-8


def test_groups_and_delays_of_their_own_are_one_loop_each() -> None:
    groups = ("left", 3, {"device.mass": 0.3}), ("right", 2, {"cube.mass": 0.1})
    base = grouped(paper(kt=20.0, bt=0.1), *groups)
    system = linked(base, delays={("left", "right"): 40 * MS, ("right", "left"): 56 * MS})
    found, whole = solve_loops(complete_loops(*lifted_groups(system))), analyze(system, method="dense")
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-11)


def test_a_drift_is_told_from_a_translation_whatever_the_delay() -> None:
    """Damped against one another only, all peers together drift: two eigenvalues 1."""
    frictionless = {"device.damping": 0.0, "cube.damping": 0.0}
    for frames in (2, 200):
        base = paper(peers=3, comp=Fraction(0), comm=8 * MS * frames, kt=0.0, bt=2.0, kc=500.0, bc=2.0)
        system = grouped(base, ("user", 3, frictionless))
        assert analyze(system, method="determinant").verdict == "drifts"


def _site_in_50_digits(values: dict[str, float]) -> tuple[Any, Any, Any]:
    """Return P, Q and S of one peer, from two peers stepped one by one at 50 digits, a frame of delay."""
    import mpmath

    rows = frame_matrix(Scene(peers=2, **values), number=mpmath.mpf, exp=mpmath.exp)
    half = len(rows) // 2
    packet = half - 2 * 2  # after motion and forces, the newest of two packets: position and velocity
    own, heard, sent = range(packet), range(half + packet, half + packet + 2), range(packet, packet + 2)
    p, q, s = (
        mpmath.matrix([[rows[i][j] for j in columns] for i in lines])
        for lines, columns in ((own, own), (own, heard), (sent, own))
    )
    return p, q, s


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "values", [{"kt": 5.0, "kc": 500.0}, {"kt": 20.0, "bt": 0.2, "kc": 1000.0, "bc": 1.0}]
)
def test_a_thousand_frames_of_delay_are_right_to_twelve_digits(values: dict[str, float]) -> None:
    mpmath = pytest.importorskip("mpmath")
    frames = 1000
    found = analyze(paper(peers=2, comm=8 * MS * frames, **values))
    assert found.method == "determinant"
    with mpmath.workdps(50):
        p, q, s = _site_in_50_digits(values)

        def function(point: Any, sign: int) -> Any:
            inside = mpmath.inverse(point * mpmath.eye(p.rows) - p) * q
            return mpmath.det(mpmath.eye(2) - sign * point**-frames * (s * inside))

        leading = found.modes[0]
        sign = 1 if leading.shape == "common" else -1
        before, truth = mpmath.mpc(leading.eigenvalue) * (1 + mpmath.mpf("1e-12")), leading.eigenvalue
        value_before, value = function(before, sign), function(truth, sign)
        while abs(truth - before) > mpmath.mpf("1e-30"):  # the secant method
            step = value * (truth - before) / (value - value_before)
            before, value_before, truth = truth, value, truth - step
            value = function(truth, sign)
        assert abs(truth - leading.eigenvalue) <= leading.error
        assert abs(abs(truth) - found.spectral_radius) < 1e-12
        assert abs(abs(truth) - found.spectral_radius) <= found.spectral_radius_error
    _count_by_samples(p, q, s, frames, found)


def _count_by_samples(p: Any, q: Any, s: Any, frames: int, found: Analysis) -> None:
    """Beyond a circle just inside of the radius there is the leading pair or zero, and the rigid one."""
    blocks = [np.array(block.tolist(), dtype=float) for block in (p, q, s)]
    for sign, shape in ((1, "common"), (-1, "difference")):
        sizes = sorted({mode.magnitude for mode in found.modes if mode.shape == shape}, reverse=True)
        radius = (sizes[0] + sizes[1]) / 2
        points = radius * np.exp(2j * np.pi * (np.arange(2**17) + 0.5) / 2**17)
        shifted = points[:, None, None] * np.eye(len(blocks[0])) - blocks[0]
        answer = blocks[2] @ np.linalg.solve(shifted, blocks[1].astype(complex))
        value = np.linalg.det(np.eye(2) - sign * points[:, None, None] ** -frames * answer)
        turns = np.angle(np.roll(value, -1) / value)
        assert np.abs(turns).max() < 1.0
        poles = int((np.abs(np.linalg.eigvals(blocks[0])) > radius).sum())
        outside = poles - round(turns.sum() / (2 * np.pi))
        leading = sum(mode.shape == shape and mode.magnitude > radius for mode in found.modes)
        assert outside == leading + (1 if shape == "common" else 0)


def test_zeros_bound_the_radius_from_both_sides() -> None:
    system = different(10)
    function, _ = of_populations(*crowded(system))
    values = np.abs(np.linalg.eigvals(dense(*lifted_groups(system)).matrix))
    truth = np.sort(values)[-2]
    zeros = find_zeros(function, np.zeros(0, complex), rigid=1, listed=3, near=4)
    assert zeros.low <= truth + 1e-13 and truth - 1e-13 <= zeros.high
    assert zeros.counted and zeros.rigid_counted
    assert zeros.high - zeros.low < 1e-8


def test_a_zero_that_no_start_leads_to_is_found_by_the_count() -> None:
    system = different(10)
    function, _ = of_populations(*crowded(system))
    blind = find_zeros(function, np.array([0.5 + 0.1j]), rigid=1, listed=3, near=0)
    sighted = find_zeros(function, np.zeros(0, complex), rigid=1, listed=3, near=8)
    assert blind.counted and blind.low == pytest.approx(sighted.low, abs=1e-9)


def test_an_eigenvalue_that_is_a_pole_is_told_by_the_count() -> None:
    """On a ring of eight, graph eigenvalue 0, nobody hears anybody: f is 1, the eigenvalues are the poles."""
    groups, exchange = lifted_groups(linked(paper(peers=8, kt=300.0, bt=1.0, kc=1000.0), "ring"))
    [deaf] = [loop for loop in arrange(groups, exchange).loops if loop.name == "graph +0"]
    found = solve_loops([deaf])
    poles = np.linalg.eigvals(groups[0].lifted.p)
    assert found.spectral_radius == pytest.approx(np.abs(poles).max(), abs=1e-13)
    assert found.spectral_radius_error < 1e-10
    [site] = deaf.sites
    shares = dict(found.modes[0].participation)
    assert sum(shares[name] for name in site.lifted.z_names) == pytest.approx(1.0, abs=1e-6)


def test_equal_students_of_a_star_near_the_boundary_are_not_missed() -> None:
    scene = compile_topology(SCENES / "star-lecture.yaml")
    system = apply(scene, [parse_override(scene, "contact.stiffness=2098 N/m")])
    found, whole = analyze(system, method="determinant"), analyze(system, method="dense")
    assert found.stable is whole.stable is True
    apart = abs(found.spectral_radius - whole.spectral_radius)
    assert apart <= found.spectral_radius_error + whole.spectral_radius_error
    assert found.spectral_radius_error < 1e-8
    assert {mode.multiplicity for mode in found.modes} == {1, 19}
