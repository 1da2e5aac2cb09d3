"""The frequency and damping a mode has, however long the frame: against textbook oscillators."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.analysis.analysis import analyze, lifted_classes
from apc.lifting.numeric_model import numeric_model
from apc.spectrum.modes import split
from apc.spectrum.spectrum import angles_in_frame
from tests.language import own
from tests.sites import paper
from tests.topologies import OSCILLATOR, TOPOLOGIES, compiled, library


def numbers(hertz: float, ratio: float) -> dict[str, str]:
    natural = 2 * math.pi * hertz
    return {"stiffness": repr(natural**2), "damping": repr(2 * ratio * natural)}


# The same with a clock that makes the frame, and a force too small to matter.
CLOCKED = OSCILLATOR.replace("peers:", "clocks: {{haptic: {frame}}}\npeers:") + (
    "  t: {{type: SampledSpringDamper, a: device, b: ground, stiffness: 1e-9 N/m, clock: haptic}}\n"
)


@pytest.mark.parametrize(
    ("hertz", "ratio"),
    [(0.3, 0.1), (10.3, 0.05), (40, 0.02), (40, 0.0), (700, 0.001), (0.4999, 0.3), (5000, 1e-4)],
)
def test_an_oscillator_without_clocks_has_its_own_frequency(hertz: float, ratio: float) -> None:
    """The frame is one second, so that all of them fold but the first."""
    found = analyze(numeric_model(compiled(OSCILLATOR.format(**numbers(hertz, ratio)))))
    expected = hertz * math.sqrt(1 - ratio**2)
    for mode in found.modes:
        assert mode.frequency_hz == pytest.approx(expected, rel=1e-9)
        assert mode.damping_ratio == pytest.approx(ratio, rel=1e-6, abs=1e-9)


@pytest.mark.few(6)
@pytest.mark.parametrize("frame", ["1 ms", "7/3 ms", "20 ms", "100 ms", "1 s"])
@pytest.mark.parametrize(("hertz", "ratio"), [(3.3, 0.2), (40, 0.02), (700, 0.001)])
def test_the_frame_does_not_matter(frame: str, hertz: float, ratio: float) -> None:
    found = analyze(numeric_model(compiled(CLOCKED.format(frame=frame, **numbers(hertz, ratio)))))
    mode = found.modes[0]
    assert mode.frequency_hz == pytest.approx(hertz * math.sqrt(1 - ratio**2), rel=1e-6)
    assert mode.damping_ratio == pytest.approx(ratio, rel=1e-4)


@pytest.mark.parametrize("halves", [1, 2, 79, 80, 1400])
def test_what_folds_onto_the_real_axis_is_told_by_its_changes_of_sign(halves: int) -> None:
    """So many half turns in a frame: e^{sT} is real, twice, up to the rounding of the numbers."""
    damped = math.pi * halves
    text = OSCILLATOR.format(stiffness=repr(damped**2 + 0.25), damping="1.0")
    for mode in analyze(numeric_model(compiled(text))).modes:
        assert mode.frequency_hz == pytest.approx(halves / 2, rel=1e-6)
        assert mode.damping_ratio == pytest.approx(0.5 / math.hypot(damped, 0.5), rel=1e-6)


def test_what_is_computed_from_itself_alone_turns_from_tick_to_tick(tmp_path: Path) -> None:
    """It is −0.9 times what it was at each of ten ticks of a frame: five turns."""
    law = own.component("s = -0.9*previous(s)", "flange.f = hold(s + 0*K*sample(flange.x))", variables="s=N:")
    slow = "  slow: {type: SampledSpringDamper, a: device, b: ground, stiffness: 1 N/m, clock: late}\n"
    text = own.topology(law).replace("clocks: {", f"couplers:\n{slow}clocks: {{late: 10 ms, ")
    flips = next(
        one
        for one in analyze(numeric_model(compiled(text, library(tmp_path, law)))).modes
        if one.magnitude < 0.5
    )
    assert flips.magnitude == pytest.approx(0.9**10, rel=1e-9)
    assert flips.frequency_hz == pytest.approx(500, rel=1e-9)


@pytest.mark.parametrize(("name", "count"), [("three-users-mesh", 3), ("planar-users", 2)])
def test_a_certified_real_negative_eigenvalue_keeps_its_frequency_and_damping(name: str, count: int) -> None:
    """λ = −|λ| is e^{sT} with Im s T = π: half a turn in a frame of 8 ms, 62.5 Hz. In a plane λ is double."""
    modes = analyze(numeric_model(apc.compile(TOPOLOGIES / f"{name}.yaml")), certify=True).modes
    negative = [mode for mode in modes if abs(mode.eigenvalue.imag) < 1e-99 and mode.eigenvalue.real < -1e-6]
    assert len(negative) == count
    for mode in negative:
        decay = -math.log(mode.magnitude)
        assert mode.frequency_hz == pytest.approx(1 / (2 * 0.008), rel=1e-12)
        assert mode.damping_ratio == pytest.approx(decay / math.hypot(decay, math.pi), rel=1e-12)


def test_what_a_mode_turns_hangs_on_no_phase_of_its_vector() -> None:
    for closed_loop in split(
        *lifted_classes(numeric_model(apc.compile(TOPOLOGIES / "two-users-reported.yaml")))
    ):
        values, vectors = np.linalg.eig(closed_loop.matrix.astype(complex))
        values.imag[np.abs(values.imag) < 1e-12] = 0.0
        shares = np.abs(vectors * np.linalg.pinv(vectors).T)
        turned = np.exp(1j * np.array([0.0, 0.7, 2.0]))
        angles = [angles_in_frame(closed_loop, values, vectors * turn, shares) for turn in turned]
        assert np.allclose(angles, angles[0], equal_nan=True)


def test_what_is_gone_within_a_frame_has_no_frequency_rather_than_a_wrong_one() -> None:
    """e^(−31) of it is left after a frame: 3e-14, which rounding hides."""
    found = analyze(numeric_model(compiled(OSCILLATOR.format(**numbers(10.0, 0.5)))))
    assert all(math.isnan(mode.frequency_hz) and math.isnan(mode.damping_ratio) for mode in found.modes)
    assert [mode["frequency_hz"] for mode in found.to_dict()["modes"]] == [None, None]


def test_modes_of_a_directed_graph_that_are_real_but_for_rounding_have_no_frequency() -> None:
    """Followed with 320 bits the pair turns once a frame, 1,000 Hz; in floats the last digit chooses."""
    text = """\
topology: weights
clocks: {haptic: {period: 0.5 ms}, network: 1 ms}
peers: {user: {count: 3}}
masses:
  device: {mass: 7.131 g}
  cube: {mass: 0.1156 g, damping: 1.859 mN*s/m, shared: true}
couplers:
  contact:
    {type: SampledSpringDamper, a: device, b: cube, stiffness: 2196 N/m, damping: 0.745 N*s/m, clock: haptic}
  coordination:
    {type: AveragePosition, object: cube, stiffness: 0.864 N/m, damping: 1.82 N*s/m, clock: haptic, link: lan}
links:
  lan:
    clock: network
    delay: 7/3 ms
    graph: {arcs: [[1, 2, 0.233], [1, 3, 0.999], [2, 3, 0.248], [2, 1, 1.262], [3, 1, 0.904], [3, 2, 0.698]]}
hands:
  arm: {type: SpringDamperArm, flange: device, stiffness: 80 N/m, damping: 1 N*s/m}
"""
    common, one, other = analyze(numeric_model(compiled(text))).modes[:3]
    assert common.frequency_hz == pytest.approx(1000)
    assert one.eigenvalue == other.eigenvalue.conjugate()
    assert one.magnitude == pytest.approx(common.magnitude, rel=1e-6)
    assert math.isnan(one.frequency_hz) and math.isnan(other.frequency_hz)


def test_shares_name_the_states_that_take_part_and_add_up() -> None:
    found = analyze(numeric_model(paper(kt=800.0, bt=2.0, kc=1500.0, bc=2.0)))
    for mode in found.modes:
        assert sum(share for _, share in mode.participation) == pytest.approx(1, abs=1e-12)
        assert [name for name, _ in mode.participation][:2] == ["device.x", "device.v"]
    free = analyze(numeric_model(paper(kc=0.0, kt=0.0, comp=Fraction(0))))
    slow = next(mode for mode in free.modes if abs(mode.eigenvalue - math.exp(-0.2)) < 1e-9)  # b/m_O = 25/s
    assert dict(slow.participation)["cube.v"] == pytest.approx(1, abs=1e-9)
