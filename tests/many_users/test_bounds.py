"""The bounds of every mode hold the truth at 120 digits, and no verdict contradicts it."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import flint
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from apc.analysis.analysis import Analysis, analyze
from tests.bruteforce import Scene, as_ball, frame_matrix
from tests.sites import MS, grouped, paper


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


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, Any]:
    """Draw gains and delays of two users, each of them exactly zero now and then."""

    def gain(largest: float) -> st.SearchStrategy[float]:
        return st.just(0.0) | st.floats(0, largest).map(lambda value: round(value, 3))

    return {
        "operator": draw(st.sampled_from(["mean", "sum"])),
        "kt": draw(gain(4000)),
        "bt": draw(gain(5)),
        "kc": draw(gain(4000)),
        "bc": draw(gain(4)),
        "comp": draw(st.sampled_from([Fraction(0), MS, MS * 2 / 5, MS * 5 / 2])),
        "comm": draw(st.sampled_from([Fraction(0), 8 * MS, 11 * MS])),
    }


@settings(max_examples=12, derandomize=True)
@given(scenes())
@example(
    {
        "operator": "mean",
        "kt": 0.05,
        "kc": 1.0,
        "bc": 2.0,
        "network": MS,
        "comp": Fraction(0),
        "comm": 11 * MS,
    }
)
@example({"operator": "mean", "kt": 0.0, "kc": 1000.0, "bc": 2.0, "comm": 80 * MS})
def test_the_truth_at_120_digits_is_within_the_bound_of_every_mode(values: dict[str, Any]) -> None:
    found = _check_against_truth(values)
    assert found.spectral_radius_error < 1e-6


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


@pytest.mark.parametrize("bt", [0.0, 1.0])
def test_next_to_the_boundary_every_verdict_is_decided_and_right(bt: float) -> None:
    values = {"bt": bt, "bc": 2.0, "kc": 500.0, "comp": MS, "comm": 8 * MS}

    def beyond(kt: float) -> float:
        return analyze(paper(peers=2, **values, kt=kt)).spectral_radius - 1

    crossing = brentq(beyond, 1.0, 20000.0, xtol=1e-12)
    steps = (-1e-9, -1e-13, 0.0, 1e-13, 1e-9)
    verdicts = {_check_against_truth({**values, "kt": crossing * (1 + step)}).verdict for step in steps}
    assert verdicts == {"stable up to a common translation", "unstable"}


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


def test_conjugates_of_a_real_matrix_are_exact_and_the_upper_one_is_first() -> None:
    found = analyze(paper(kt=800.0, bt=2.0, kc=1500.0, bc=2.0))
    pairs = [mode.eigenvalue for mode in found.modes if mode.eigenvalue.imag]
    assert pairs
    for upper, lower in zip(pairs[::2], pairs[1::2], strict=True):
        assert upper == lower.conjugate()
        assert upper.imag > 0


def test_a_translation_is_one_exact_mode_and_never_a_question_of_tolerance() -> None:
    for k_t in np.linspace(1, 1000, 9):
        assert analyze(paper(kt=float(k_t))).rigid_modes == 1
