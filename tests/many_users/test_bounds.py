"""The bounds of every mode hold the truth at 120 digits, and no verdict contradicts it."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import flint
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

import apc
from apc.analysis.analysis import Analysis
from tests.bruteforce import TopologySource, as_ball, frame_matrix
from tests.topologies import compiled
from tests.truths import text_of

MS = Fraction(1, 1000)

# What four equal eigenvalues of the truth, a Jordan block of zeros say, keep of its 120 digits.
SCATTERED = 1e-30


def analyze(topology: TopologySource, **requested: Any) -> Analysis:
    return apc.analyze(compiled(text_of(topology)), **requested)


def truth_of(topology: TopologySource) -> list[flint.acb]:
    """Return the eigenvalues of the full map at 120 digits, of which four equal ones keep 30."""
    before, flint.ctx.dps = flint.ctx.dps, 120
    try:
        rows = frame_matrix(topology, number=as_ball, exp=lambda value: value.exp())
        return flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")
    finally:
        flint.ctx.dps = before


@st.composite
def topologies(draw: st.DrawFn) -> dict[str, Any]:
    """Draw gains and delays of two users, each of them exactly zero now and then."""

    def gain(largest: float) -> st.SearchStrategy[float]:
        return st.just(0.0) | st.floats(0, largest).map(lambda value: round(value, 3))

    return {
        "operator": draw(st.sampled_from(["mean", "sum"])),
        **{name: draw(gain(largest)) for name, largest in (("kt", 4000), ("bt", 5), ("kc", 4000), ("bc", 4))},
        "comp": draw(st.sampled_from([Fraction(0), MS, MS * 2 / 5, MS * 5 / 2])),
        "comm": draw(st.sampled_from([Fraction(0), 8 * MS, 11 * MS])),
    }


def check(values: dict[str, Any]) -> Analysis:
    """Assert that truth is within every bound, and that no verdict contradicts it; return the analysis."""
    topology = TopologySource(peers=2, **values)
    found, truth = analyze(topology), truth_of(topology)
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


QUEUE = {"operator": "mean", "kt": 0.05, "kc": 1.0, "bc": 2.0, "network": MS, "comp": Fraction(0)}


@pytest.mark.whole
@settings(max_examples=4, derandomize=True)
@given(topologies())
@example({**QUEUE, "comm": 11 * MS})
@example({"operator": "mean", "kt": 0.0, "kc": 1000.0, "bc": 2.0, "comm": 80 * MS})
def test_the_truth_at_120_digits_is_within_the_bound_of_every_mode(values: dict[str, Any]) -> None:
    assert check(values).spectral_radius_error < 1e-6


@pytest.mark.parametrize("bt", [0.0, 1.0])
def test_next_to_the_boundary_every_verdict_is_decided_and_right(bt: float) -> None:
    values = {"bt": bt, "bc": 2.0, "kc": 500.0, "comp": MS, "comm": 8 * MS}
    model = compiled(text_of(TopologySource(peers=2, kt=1.0, **values)))  # type: ignore[arg-type] # numbers and times

    def beyond(kt: float) -> float:
        return apc.analyze(model, params={"coordination.stiffness": f"{kt!r} N/m"}).spectral_radius - 1

    crossing = brentq(beyond, 1.0, 20000.0, xtol=1e-12)
    steps = (-1e-9, -1e-13, 0.0, 1e-13, 1e-9)
    verdicts = {check({**values, "kt": crossing * (1 + step)}).verdict for step in steps}
    assert verdicts == {"stable up to a common translation", "unstable"}


def test_as_many_digits_are_taken_as_decide() -> None:
    """At the last float below a boundary, 1 − ρ is 1e-16 or less: too near for floats, not for a proof."""
    model = compiled(text_of(TopologySource()))

    def at(kt: float) -> Analysis:
        return apc.analyze(model, params={"coordination.stiffness": f"{kt!r} N/m"})

    low, high = 1096.0, 1097.0
    while np.nextafter(low, high) < high:
        middle = (low + high) / 2
        low, high = (middle, high) if at(middle).stable else (low, middle)
    assert (at(low).stable, at(high).stable) == (True, False)
    assert str(at(low).proof).startswith(("decided with", "proved stable"))
    assert str(at(high).proof).startswith("proved unstable")
    assert abs(low - 1096.411) < 6e-4  # the reference limit of K_T at K_C = 1000


@pytest.mark.parametrize("comp", [Fraction(0), MS])
@pytest.mark.parametrize(("operator", "viscosity"), [("mean", 2.3), ("sum", 4.6)])
def test_a_slow_late_network_brakes_like_a_damper(operator: str, viscosity: float, comp: Fraction) -> None:
    """K_eff ((T_n − T_c)/2 + T_d) at low frequency: a copy so heavy that v decays as e^(−B t/m)."""
    topology = TopologySource(operator, kt=200.0, kc=0.0, cube=1e5, cube_damping=0.0, comp=comp)
    slow = next(mode for mode in analyze(topology).modes if mode.family == "common")
    assert -1e5 * math.log(slow.magnitude) / 0.008 == pytest.approx(viscosity, rel=1e-4)


def test_conjugates_of_a_real_matrix_are_exact_and_the_upper_one_is_first() -> None:
    found = analyze(TopologySource(kt=800.0, bt=2.0, kc=1500.0, bc=2.0))
    pairs = [mode.eigenvalue for mode in found.modes if mode.eigenvalue.imag]
    assert pairs
    for upper, lower in zip(pairs[::2], pairs[1::2], strict=True):
        assert upper == lower.conjugate() and upper.imag > 0


# ---- what nothing holds back ----

LOOSE = TopologySource(device_damping=0.0, cube_damping=0.0)


@pytest.mark.few(5)
@pytest.mark.parametrize(
    ("values", "rigid"),
    [
        ({"kt": 1.0}, 1),
        ({"kt": 0.0, "bt": 0.0}, 3),  # nothing ties the peers
        ({"kt": 0.0, "bt": 2.0}, 3),  # a damper holds no position
        ({"kt": 0.0, "bt": 2.0, "kc": 0.0}, 6),  # device and cube apart
        ({"kt": 1e-300}, 1),  # the weakest spring holds
        ({"kc": 1e-300}, 1),
        ({"kc": 0.0}, 4),
    ],
)
@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("interchangeable", [True, False])
def test_a_stiffness_of_exactly_zero_frees_what_it_held(
    values: dict[str, float], rigid: int, operator: str, interchangeable: bool
) -> None:
    users = () if interchangeable else tuple({"device": mass} for mass in (0.1, 0.2, 0.15))
    topology = TopologySource(operator, users=users, **values)  # type: ignore[arg-type] # numbers
    methods = ["auto", "dense"] if interchangeable or 1e-300 in values.values() else ["auto", "determinant"]
    assert {analyze(topology, method=method).rigid_modes for method in methods} == {rigid}


@pytest.mark.parametrize(
    ("values", "verdict", "rigid"),
    [
        ({"kt": 0.0, "bt": 0.0, "kc": 0.0}, "drifts", 6),
        ({"kt": 0.0, "bt": 0.0, "bc": 2.0, "comp": Fraction(0)}, "drifts", 3),
        ({"kt": 0.0, "bt": 2.0, "bc": 2.0, "comp": Fraction(0)}, "drifts", 3),  # apart, the damper brakes
        # The late network brakes: K_eff ((T_n − T_c)/2 + T_d).
        ({"kt": 100.0, "bt": 2.0, "bc": 3.0}, "stable up to a common translation", 1),
        ({"kt": 0.0, "bt": 0.0, "kc": 3000.0}, "unstable", 3),
    ],
)
def test_undamped_peers_drift_as_far_as_nothing_brakes_them(
    values: dict[str, Any], verdict: str, rigid: int
) -> None:
    for requested in ({}, {"certify": True}):
        found = analyze(replace(LOOSE, **values), **requested)
        assert (found.verdict, found.rigid_modes) == (verdict, rigid)
    beginning = {"d": "proved to drift", "s": "proved stable", "u": "proved"}[verdict[0]]
    assert str(found.proof).startswith(beginning)
