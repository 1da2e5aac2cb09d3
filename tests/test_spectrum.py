"""Claims about `apc.eigen.spectrum`."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import flint
import mpmath
import numpy as np
import pytest
from scipy.optimize import brentq

import apc
from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.components.library import Library
from apc.eigen import spectrum
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.spectrum import oscillation
from tests.bench.growing import row
from tests.bruteforce import Scene, as_ball, frame_matrix
from tests.reference import CONTACT_LIMITS, HELPED_LIMITS, LIMITS, OPERATORS, RADII
from tests.sites import MS, grouped, paper
from tests.topologies import ROOT, compiled

BOTH = {"comp": MS, "comm": 8 * MS}
NONE = {"comp": Fraction(0), "comm": Fraction(0)}
OWN = {**BOTH, "own_delay": True}
DELAYS: dict[tuple[bool, str], dict] = {(False, "all"): NONE, (True, "all"): BOTH, (True, "own"): OWN}


@pytest.mark.parametrize(("scheme", "peers", "delayed", "radius"), RADII)
def test_the_reference_radii_come_out(scheme: str, peers: int, delayed: bool, radius: float) -> None:
    delays = DELAYS[delayed, "all"]
    found = analyze(paper(OPERATORS[scheme], peers=peers, kt=800.0, bt=2.0, kc=1500.0, bc=2.0, **delays))
    assert found.spectral_radius == pytest.approx(radius, abs=1e-8)
    assert found.verdict == "stable up to a common translation"
    assert found.rigid_modes == 1


def _crossing(build: Any, low: float, high: float) -> float:
    """Return where the radius crosses 1 between two values, by bisection."""
    assert analyze(build(low)).spectral_radius < 1 < analyze(build(high)).spectral_radius
    return float(brentq(lambda value: analyze(build(value)).spectral_radius - 1, low, high, xtol=1e-5))


@pytest.mark.few(5)
@pytest.mark.parametrize(("delayed", "delays", "damping", "kc", "average", "mesh"), LIMITS)
def test_the_largest_coordination_stiffness_is_the_reference_one(
    delayed: bool, delays: str, damping: float, kc: float, average: float, mesh: float
) -> None:
    for operator, limit in (("mean", average), ("sum", mesh)):

        def build(kt: float, operator: str = operator) -> CompiledSystem:
            return paper(operator, kt=kt, bt=damping, kc=kc, bc=damping, **DELAYS[delayed, delays])

        assert _crossing(build, limit * 0.99, limit * 1.01) == pytest.approx(limit, abs=6e-4)
        for kt in np.linspace(1.0, limit * 0.99, 4):
            assert analyze(build(float(kt))).stable


@pytest.mark.parametrize(("damping", "limit"), CONTACT_LIMITS)
def test_the_largest_contact_stiffness_alone_is_the_reference_one(damping: float, limit: float) -> None:
    found = _crossing(lambda kc: paper(kc=kc, kt=0.0, bt=0.0, bc=damping, **BOTH), limit * 0.99, limit * 1.01)
    assert found == pytest.approx(limit, abs=6e-4)


def test_a_network_delay_can_help() -> None:
    """K_C = 2000, B = 2, and the computational delay: 2602 without, 3041 with a network delay of 8 ms."""
    for late, limit in HELPED_LIMITS:

        def build(kt: float, comm: Fraction = late * MS) -> CompiledSystem:
            return paper(kt=kt, bt=2.0, kc=2000.0, bc=2.0, comp=MS, comm=comm)

        assert _crossing(build, limit * 0.99, limit * 1.01) == pytest.approx(limit, abs=0.5)


@pytest.mark.parametrize("comp", [Fraction(0), MS])
@pytest.mark.parametrize(("operator", "viscosity"), [("mean", 2.3), ("sum", 4.6)])
def test_a_slow_late_network_brakes_like_a_damper(operator: str, viscosity: float, comp: Fraction) -> None:
    """K_eff ((T_n − T_c)/2 + T_d) at low frequency: a copy so heavy that v decays as e^(−B t/m)."""
    mass = 1e5
    system = grouped(
        paper(operator, kt=200.0, kc=0.0, cube=mass, comp=comp), ("user", 3, {"cube.damping": 0.0})
    )
    slow = next(mode for mode in analyze(system).modes if mode.shape == "common")
    assert -mass * math.log(slow.magnitude) / 0.008 == pytest.approx(viscosity, rel=1e-4)


# ---- error bounds ----


def _truth(scene: Scene) -> list[flint.acb]:
    """Return the eigenvalues of the full map at 120 digits, of which four equal ones keep 30."""
    before, flint.ctx.dps = flint.ctx.dps, 120
    try:
        rows = frame_matrix(scene, number=as_ball, exp=lambda value: value.exp())
        return flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")
    finally:
        flint.ctx.dps = before


# What four equal eigenvalues of the truth, a Jordan block of zeros say, keep of its 120 digits.
SCATTERED = 1e-30


def _random(generator: np.random.Generator, number: int) -> dict:
    """Return gains and delays, each of them exactly zero now and then."""

    def gain(largest: float, every: int) -> float:
        return 0.0 if number % every == every - 1 else float(generator.uniform(0, largest))

    return {
        "operator": "sum" if number % 2 else "mean",
        "kt": gain(4000, 4),
        "bt": gain(5, 3),
        "kc": gain(4000, 5),
        "bc": gain(4, 2),
        "comp": [Fraction(0), MS, MS * 2 / 5, MS * 5 / 2][number % 4],
        "comm": [Fraction(0), 8 * MS, 11 * MS][number % 3],
    }


def _check_against_truth(values: dict) -> Analysis:
    """Assert that truth is within every bound, and that no verdict contradicts it; return the analysis."""
    found = analyze(paper(peers=2, **values))
    truth = _truth(Scene(peers=2, **values))
    for mode in found.modes:
        place = flint.acb(mode.eigenvalue.real, mode.eigenvalue.imag)
        assert min(float(abs(place - value).mid()) for value in truth) <= mode.error + SCATTERED
    apart = sorted(truth, key=lambda value: float(abs(value - 1).mid()))
    rigid = sum(float(abs(value - 1).mid()) < 1e-40 for value in truth)
    assert rigid == found.rigid_modes
    radius = max(abs(value).mid() for value in apart[rigid:])
    assert abs(float(radius - flint.arb(found.spectral_radius))) <= found.spectral_radius_error
    if found.stable is not None:
        assert found.stable == bool(radius < 1)
    return found


@pytest.mark.few(1)
@pytest.mark.parametrize("draws", [20, 60])
def test_the_truth_at_120_digits_is_within_every_bound(draws: int) -> None:
    generator = np.random.default_rng(0)
    # Every way of setting some of the gains and delays to zero: of 4, of 3, of 5.
    found = [_check_against_truth(_random(generator, number)) for number in range(draws)]
    bounds = [one.spectral_radius_error for one in found]
    assert np.median(bounds) < 1e-10
    assert max(bounds) < 1e-6


@pytest.mark.parametrize("kt", [0.0, 0.05, 400.0])
def test_a_long_queue_that_hardly_anyone_answers_spoils_no_bound(kt: float) -> None:
    """Eleven packets on their way are a Jordan block: rounding scatters it to the eleventh root of 1e-16."""
    values = {"operator": "mean", "kt": kt, "kc": 1.0, "bc": 2.0, "comp": Fraction(0), "comm": 11 * MS}
    found = _check_against_truth({**values, "network": MS})
    assert found.spectral_radius_error < 1e-8
    assert found.stable


def test_next_to_the_boundary_every_verdict_is_decided_and_right() -> None:
    generator = np.random.default_rng(1)
    verdicts = set()
    for number in range(6):
        values = {**_random(generator, number), "bt": 1.0, "bc": 2.0, "kc": 500.0, "comp": MS}

        def beyond(kt: float, values: dict = values) -> float:
            return analyze(paper(peers=2, **{**values, "kt": kt})).spectral_radius - 1

        crossing = brentq(beyond, 1.0, 20000.0, xtol=1e-12)
        for step in (-1e-9, -1e-13, 0.0, 1e-13, 1e-9):
            found = _check_against_truth({**values, "kt": crossing * (1 + step)})
            verdicts.add(found.verdict)
    assert verdicts == {"stable up to a common translation", "unstable"}


def test_mpmath_at_50_digits_agrees() -> None:
    values = {"kt": 900.0, "bt": 1.0, "kc": 1200.0, "bc": 1.0, "comp": Fraction(0), "comm": Fraction(0)}
    with mpmath.workdps(50):
        rows = frame_matrix(Scene(peers=2, **values), number=mpmath.mpf, exp=mpmath.exp)
        truth = mpmath.eig(mpmath.matrix(rows), left=False, right=False)
        found = analyze(paper(peers=2, **values))
        radius = max(abs(value) for value in truth if abs(value - 1) > mpmath.mpf(10) ** -30)
        assert abs(radius - found.spectral_radius) <= found.spectral_radius_error


@pytest.mark.parametrize("spread", [0.0, 1e-12, 1e-6])
def test_the_bound_of_a_nearly_defective_pair_is_honest(spread: float) -> None:
    """[a 1; ε a] has eigenvalues a ± √ε, however close."""
    matrix = np.array([[0.5, 1.0], [spread, 0.5]])
    error = np.full((2, 2), 1e-14)
    moved = matrix.copy()
    moved[1, 0] += 1e-14
    pairs, found = enclose_eigenvalues(matrix, error)
    values, errors, low, high = pairs.values, found.errors, found.low, found.high
    truth = [0.5 + math.sqrt(spread + 1e-14), 0.5 - math.sqrt(spread + 1e-14)]
    for value, bound in zip(values, errors, strict=True):
        assert min(abs(value - one) for one in truth) <= bound
    assert low <= truth[0] <= high


def test_the_bound_of_a_large_jordan_block_is_honest() -> None:
    """An entry ε in the corner of a nilpotent block of n moves its eigenvalues to the n-th roots of ε."""
    n = 6
    matrix, error = np.eye(n, k=1), np.zeros((n, n))
    error[-1, 0] = 1e-12
    pairs, found = enclose_eigenvalues(matrix, error)
    values, errors, high = pairs.values, found.errors, found.high
    assert high >= 1e-12 ** (1 / n)
    assert all(bound + abs(value) >= 1e-12 ** (1 / n) for value, bound in zip(values, errors, strict=True))


def test_a_late_link_s_queue_is_bounded_with_the_truth_inside() -> None:
    """Ten packets on their way, too late to be stable, or twenty-five that nobody listens to."""
    for values in ({"kt": 400.0, "comm": 80 * MS}, {"kt": 0.0, "comm": 200 * MS}):
        found = _check_against_truth({"operator": "mean", "kc": 1000.0, "bc": 2.0, "comp": MS, **values})
        assert found.spectral_radius_error < 1e-10
        assert found.stable is (values["kt"] == 0.0)


@pytest.mark.parametrize(
    ("old", "new", "stable", "width"),
    [
        ("count: 3", "count: 1000", True, 1e-11),
        ("mass: 0.1 kg", "mass: 1e-4 kg", True, 1e-11),
        ("network, delay: 8 ms", "network, delay: 200 ms", False, 1e-10),
        ("network, delay: 8 ms", "network, delay: 1 s", False, 1e-7),
        ("haptic: 1 ms", "haptic: 1 s", False, 1e-8),
    ],
)
def test_scenes_with_long_queues_and_extreme_numbers_are_decided(
    tmp_path: Path, old: str, new: str, stable: bool, width: float
) -> None:
    text = (ROOT / "models" / "scenes" / "template.yaml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    (tmp_path / "scene.yaml").write_text(text.replace(old, new), encoding="utf-8")
    found = analyze(apc.compile(tmp_path / "scene.yaml"))
    assert found.stable is stable
    assert found.spectral_radius_error < width
    assert all(math.isfinite(mode.error) for mode in found.modes)


def _matrices(generator: np.random.Generator) -> list[np.ndarray]:
    """Return matrices that are random, complex, graded, repeated, triangular, defective, and queues."""
    n = int(generator.integers(2, 10))
    plain = generator.normal(size=(n, n)) / np.sqrt(n)
    grades = 10.0 ** generator.integers(-5, 6, size=n)
    queue = np.eye(n, k=-1)
    queue[0] = generator.normal(size=n) * 10.0 ** generator.integers(-6, 1, size=n)
    twin = np.kron(np.eye(2), generator.normal(size=(2, 2)))
    defective = plain @ (0.9 * np.eye(n) + np.eye(n, k=1)) @ np.linalg.inv(plain)
    turned = plain + 1j * generator.normal(size=(n, n)) / np.sqrt(n)
    return [plain, turned, plain * grades[:, None] / grades, queue, twin, np.triu(plain), defective]


def test_whatever_the_matrix_every_bound_is_finite_and_holds_the_truth() -> None:
    generator = np.random.default_rng(5)
    before, flint.ctx.dps = flint.ctx.dps, 60
    try:
        for _ in range(20):
            for matrix in _matrices(generator):
                error = np.abs(matrix) * 10.0 ** generator.integers(-16, -7)
                pairs, found = enclose_eigenvalues(matrix, error)
                values, errors, low, high = pairs.values, found.errors, found.low, found.high
                assert np.isfinite([*errors, high]).all()
                signs = generator.choice([-1, 1], size=matrix.shape)
                rows = [[flint.acb(complex(e)) for e in row] for row in matrix + 0.999 * signs * error]
                truth = np.array([complex(z) for z in flint.acb_mat(rows).eig(algorithm="approx")])
                assert low * (1 - 1e-15) <= np.abs(truth).max() <= high * (1 + 1e-15)
                for value, bound in zip(values, errors, strict=True):
                    assert np.abs(truth - value).min() <= bound + 1e-15 * abs(value)
    finally:
        flint.ctx.dps = before


def test_conjugates_of_a_real_matrix_are_exact_and_the_upper_one_is_first() -> None:
    found = analyze(paper(kt=800.0, bt=2.0, kc=1500.0, bc=2.0))
    pairs = [mode.eigenvalue for mode in found.modes if mode.eigenvalue.imag]
    assert pairs
    for upper, lower in zip(pairs[::2], pairs[1::2], strict=True):
        assert upper == lower.conjugate()
        assert upper.imag > 0


# ---- what a mode is called ----


def test_a_fast_shake_in_a_slow_frame_keeps_its_frequency() -> None:
    """Device and cube on a spring: ω² = K (1/m + 1/m_O); forces every 0.1 ms, 1.5 turns a frame."""
    stiffness = 1e5
    found = analyze(paper(kc=stiffness, kt=0.0, haptic=MS / 10, comp=Fraction(0)))
    expected = math.sqrt(stiffness * 15) / (2 * math.pi)
    assert expected > 1.5 / 0.008
    assert found.modes[0].frequency_hz == pytest.approx(expected, rel=3e-3)
    assert found.modes[0].damping_ratio < 0


def test_an_oscillator_has_its_textbook_frequency_and_damping() -> None:
    """A soft spring sampled fast: s² + (b/m) s + K (1/m + 1/m_O) with b/m equal for both masses."""
    system = grouped(
        paper(kc=100.0, kt=0.0, haptic=MS / 100, network=MS, comp=Fraction(0)),
        ("user", 3, {"device.damping": 2.0, "cube.damping": 4.0}),
    )
    [first, *_] = [mode for mode in analyze(system).modes if mode.frequency_hz > 0]
    natural = math.sqrt(100.0 * 15)
    ratio = 20.0 / (2 * natural)
    assert first.damping_ratio == pytest.approx(ratio, rel=2e-3)
    assert first.frequency_hz == pytest.approx(natural * math.sqrt(1 - ratio**2) / (2 * math.pi), rel=1e-3)


def test_shares_name_the_states_that_take_part_and_add_up() -> None:
    found = analyze(paper(kt=800.0, bt=2.0, kc=1500.0, bc=2.0))
    for mode in found.modes:
        assert sum(share for _, share in mode.participation) == pytest.approx(1, abs=1e-12)
        assert [name for name, _ in mode.participation][:2] == ["device.x", "device.v"]
    free = analyze(paper(kc=0.0, kt=0.0, comp=Fraction(0)))
    slow = next(mode for mode in free.modes if abs(mode.eigenvalue - math.exp(-0.2)) < 1e-9)  # b/m_O = 25/s
    assert dict(slow.participation)["cube.v"] == pytest.approx(1, abs=1e-9)


def test_a_mode_that_ends_in_finite_time_has_no_frequency() -> None:
    found = analyze(paper(kc=0.0, kt=0.0))
    dead = [mode for mode in found.modes if mode.magnitude < 1e-9]
    assert dead
    assert {(mode.frequency_hz, mode.damping_ratio) for mode in dead} == {(0.0, 1.0)}


# ---- verdicts ----


def _undamped(**values: Any) -> CompiledSystem:
    return grouped(paper(**values), ("user", 3, {"device.damping": 0.0, "cube.damping": 0.0}))


def test_every_verdict_says_what_it_says() -> None:
    assert analyze(paper()).verdict == "stable up to a common translation"
    assert analyze(paper(kc=2500.0)).verdict == "unstable"
    drifting = analyze(_undamped(kt=0.0, bt=2.0, bc=2.0, comp=Fraction(0)))
    assert (drifting.verdict, drifting.stable) == ("drifts", False)
    assert drifting.spectral_radius < 1
    shaking = analyze(_undamped(kt=0.0, bt=0.0, kc=3000.0))
    assert (shaking.verdict, shaking.stable) == ("unstable", False)


def test_the_dense_system_gives_the_same_answer() -> None:
    for values in ({}, {"kt": 0.0}, {"operator": "sum", "kc": 2500.0}):
        split, whole = analyze(paper(**values)), analyze(paper(**values), method="dense")
        assert split.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-12)
        assert (split.verdict, split.rigid_modes) == (whole.verdict, whole.rigid_modes)
        assert sum(mode.multiplicity for mode in split.modes) == len(whole.modes)


def test_an_angle_below_a_rounding_is_none() -> None:
    assert oscillation(0.5, 1e-77, 0.008) == (0.0, 1.0)


def test_only_the_modes_that_are_looked_at_are_followed_and_the_others_would_be_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = compiled(row(30, tmp_path), Library((tmp_path / "parts",)))
    monkeypatch.setattr(spectrum, "_motions", followed := Mock(side_effect=spectrum._motions))
    modes = analyze(system).modes
    assert len(modes) > spectrum.LOOKED_AT
    assert modes[-1].magnitude <= modes[0].magnitude
    assert not followed.call_count
    assert modes[0].frequency_hz > 0
    assert [len(call.args[3]) for call in followed.call_args_list] == [spectrum.LOOKED_AT]
    monkeypatch.setattr(spectrum, "LOOKED_AT", len(modes))
    for one, other in zip(modes, analyze(system).modes, strict=True):
        assert (one.eigenvalue, one.shape, one.error) == (other.eigenvalue, other.shape, other.error)
        # The same vector and exponential, in products of other widths.
        assert one.frequency_hz == pytest.approx(other.frequency_hz, rel=1e-9, abs=1e-9)
        assert dict(one.participation) == pytest.approx(dict(other.participation), abs=1e-9)
