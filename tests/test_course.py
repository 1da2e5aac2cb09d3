"""Claims about `apc.frame.course`: the frequency a mode has, however long the frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.analysis.analysis import analyze
from apc.frame.course import A_TURN, FEWEST, _fast_enough, _fastest, _phases, _turned, followed_closely
from apc.vary.critical import critical
from tests.topologies import compiled

# Textbook: m x″ + d x′ + k x = 0.
OSCILLATOR = """\
topology: oscillator
peers: {{user: {{count: 1}}}}
masses:
  device: {{mass: 1 kg}}
couplers:
  s: {{type: SpringDamper, a: device, b: ground, stiffness: {stiffness} N/m, damping: {damping} N*s/m}}
"""
# The same with a clock that makes the frame, and a force too small to matter.
CLOCKED = OSCILLATOR.replace("peers:", "clocks: {{haptic: {frame}}}\npeers:") + (
    "  t: {{type: SampledSpringDamper, a: device, b: ground, stiffness: 1e-9 N/m, clock: haptic}}\n"
)


def numbers(hertz: float, ratio: float) -> dict[str, str]:
    natural = 2 * math.pi * hertz
    return {"stiffness": repr(natural**2), "damping": repr(2 * ratio * natural)}


@pytest.mark.parametrize(
    ("hertz", "ratio"),
    [(0.3, 0.1), (10.3, 0.05), (40, 0.02), (40, 0.0), (700, 0.001), (0.4999, 0.3), (5000, 1e-4)],
)
def test_an_oscillator_without_clocks_has_its_own_frequency(hertz: float, ratio: float) -> None:
    """The frame is one second, so that all of them fold but the first."""
    found = analyze(compiled(OSCILLATOR.format(**numbers(hertz, ratio))))
    expected = hertz * math.sqrt(1 - ratio**2)
    for mode in found.modes:
        assert mode.frequency_hz == pytest.approx(expected, rel=1e-9)
        assert mode.damping_ratio == pytest.approx(ratio, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("frame", ["1 ms", "7/3 ms", "20 ms", "100 ms", "1 s"])
@pytest.mark.parametrize(("hertz", "ratio"), [(3.3, 0.2), (40, 0.02), (700, 0.001)])
def test_the_frame_does_not_matter(frame: str, hertz: float, ratio: float) -> None:
    found = analyze(compiled(CLOCKED.format(frame=frame, **numbers(hertz, ratio))))
    mode = found.modes[0]
    assert mode.frequency_hz == pytest.approx(hertz * math.sqrt(1 - ratio**2), rel=1e-6)
    assert mode.damping_ratio == pytest.approx(ratio, rel=1e-4)


@pytest.mark.parametrize("halves", [1, 2, 79, 80, 1400])
def test_what_folds_onto_the_real_axis_is_told_by_its_changes_of_sign(halves: int) -> None:
    """So many half turns in a frame: e^{sT} is real, twice, up to the rounding of the numbers."""
    damped = math.pi * halves
    text = OSCILLATOR.format(stiffness=repr(damped**2 + 0.25), damping="1.0")
    for mode in analyze(compiled(text)).modes:
        assert mode.frequency_hz == pytest.approx(halves / 2, rel=1e-6)
        assert mode.damping_ratio == pytest.approx(0.5 / math.hypot(damped, 0.5), rel=1e-6)


def test_what_is_gone_within_a_frame_has_no_frequency_rather_than_a_wrong_one() -> None:
    """e^(−31) of it is left after a frame: 3e-14, which rounding hides."""
    found = analyze(compiled(OSCILLATOR.format(**numbers(10.0, 0.5))))
    assert all(math.isnan(mode.frequency_hz) and math.isnan(mode.damping_ratio) for mode in found.modes)
    assert [mode["frequency_hz"] for mode in found.to_dict()["modes"]] == [None, None]


def test_a_fast_loop_has_the_frequency_of_its_limit() -> None:
    """A spring computed every 10 µs, on a frame of 8 ms: 90 Hz, half of what the frame tells is 62.5 Hz."""
    text = """\
topology: fast
clocks: {fast: 0.01 ms, slow: 8 ms}
peers: {user: {count: 2}}
masses:
  device: {mass: 1 kg, damping: 20 N*s/m}
couplers:
  s: {type: SampledSpringDamper, a: device, b: ground, stiffness: 319775 N/m, clock: fast}
  c: {type: AveragePosition, object: device, stiffness: 1e-6 N/m, clock: slow, link: lan}
links:
  lan: {clock: slow}
"""
    mode = analyze(compiled(text)).modes[0]
    # To first order, a force held for T is late by T/2: damping less K T/2.
    damping = 20 - 319775 * 5e-6
    assert mode.frequency_hz == pytest.approx(math.sqrt(319775 - damping**2 / 4) / (2 * math.pi), rel=1e-4)
    assert mode.damping_ratio == pytest.approx(damping / (2 * math.sqrt(319775)), rel=1e-3)


def test_a_point_of_the_boundary_has_the_frequency_of_its_motion() -> None:
    """A continuous spring of 300 Hz, shaken by a slow tick's force: half the frame's rate is 62.5 Hz."""
    text = """\
topology: boundary
clocks: {haptic: 8 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 1 kg, damping: 0.5 N*s/m}
couplers:
  s: {type: SpringDamper, a: device, b: ground, stiffness: 3553058 N/m}
  t: {type: SampledSpringDamper, a: device, b: ground, stiffness: 100 N/m, clock: haptic, delay: 1 ms}
"""
    system = compiled(text)
    for one in critical(system, "t.stiffness").crossings:
        assert one.frequency_hz == pytest.approx(300, rel=0.02)


def turned(course: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return _turned(_phases(course))


def test_a_change_of_sign_is_half_a_turn_whatever_the_zeros_sign() -> None:
    course = np.array([complex(1.0, 0.0), complex(-1.5, -0.0), complex(1.2, 0.0), complex(-1.8, -0.0)])
    course = np.append(course, complex(2.3, 0.0))
    for one in (course, course.conj(), -course, course * np.exp(1j)):
        angle, widest = turned(one[:, None])
        assert angle[0] == pytest.approx(4 * math.pi, rel=1e-12)
        assert widest[0] == pytest.approx(math.pi, rel=1e-12)


def test_a_course_over_the_whole_range_of_floats_still_has_its_angle() -> None:
    """A quarter turn a point for six points, from 1e-250 to 1e250: one and a half turns."""
    sizes = np.array([1e-250, 1e-200, 1e-100, 1.0, 1e100, 1e200, 1e250])
    course = sizes * np.exp(0.5j * np.pi * np.arange(7))
    assert turned(course[:, None])[0] == pytest.approx(3 * np.pi)


def test_a_course_that_starts_or_passes_at_zero_keeps_its_direction() -> None:
    course = np.array([0, 1, 1j, 0, -1, 0], np.complex128)
    assert turned(course[:, None])[0] == pytest.approx(np.pi)


def test_what_rounding_leaves_of_a_course_does_not_turn_it() -> None:
    """As where a light mass comes to rest between two events, and is pushed the same way again."""
    course = np.array([-0.5, -2e-7, -4e-14, 3e-17, -1e-17, 3e-17, -0.6, -0.7])
    assert turned(course[:, None])[0] == 0
    swings = np.exp(-0.5 * np.arange(40)) * np.cos(np.arange(40) * np.pi)
    assert turned(swings[:, None])[0] == pytest.approx(39 * np.pi)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("distance", "known"), [(0.1, True), (1e-3, True), (1e-9, False)])
def test_a_course_that_rounding_may_lead_past_zero_on_either_side_is_not_known(
    side: float, distance: float, known: bool
) -> None:
    """From −1 to 1 past 0, and on by half a turn; a vector of an eigenvalue is hardly right to 1e-9."""
    time = np.linspace(-1, 1, 17)[:, None]
    course = time + 1j * side * distance * (1 - time**2)
    angle, told = followed_closely(course, np.array([1.0 + 1e-12j]))
    assert told == [known]
    assert angle == pytest.approx([-side * math.pi], rel=1e-12)


def test_a_mode_that_is_real_changes_its_sign_whatever_rounding_says() -> None:
    time = np.linspace(-1, 1, 16)[:, None]
    for rounding in (1e-13, -1e-13):
        assert followed_closely(time * (1 + rounding * 1j * time), np.array([-1.0 + 0j]))[1] == [True]


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
    common, one, other = analyze(compiled(text)).modes[:3]
    assert common.frequency_hz == pytest.approx(1000)
    assert one.eigenvalue == other.eigenvalue.conjugate()
    assert one.magnitude == pytest.approx(common.magnitude, rel=1e-6)
    assert math.isnan(one.frequency_hz) and math.isnan(other.frequency_hz)


def test_what_stands_for_the_fastest_swing_is_a_bound_and_asks_for_no_more_points() -> None:
    """Masses in a row, springs stiff: the bound holds, and stands in where the fewest points are enough."""
    n = 40
    spring = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-1e4 * spring, -3.0 * np.eye(n)]])
    fastest = _fastest(a)
    closed_form = 200 * math.cos(math.pi / (2 * (n + 1))) / math.tau  # of the stiffest mode, hardly damped
    assert fastest == pytest.approx(closed_form, rel=1e-3)
    bounds = []
    for longest in (1e-5, 1e-3, 3e-3, 1e-2, 1.0):
        found = _fast_enough(a, longest)
        assert found == fastest or (found >= fastest and A_TURN * found * longest <= FEWEST)
        bounds.append(found > fastest)
    assert bounds[0] and not bounds[-1]
