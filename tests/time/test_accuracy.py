"""The error that a run tells of itself is about the error that it makes."""

from __future__ import annotations

from fractions import Fraction

import mpmath
import numpy as np
import pytest

from apc.present.simulation import error_text
from apc.simulation.settings import parse_method
from apc.simulation.trajectory import simulate
from tests.time.test_contacts import CROSSLEY
from tests.topologies import AVERAGE, compiled, replaced

SPRING = """\
topology: spring
clocks: {haptic: 1 ms}
peers: {user: {count: 1, set: {device.x: 10 mm}}}
masses: {device: {mass: 0.1 kg, damping: 0.3 N*s/m}}
couplers: {spring: {type: SampledSpringDamper, a: device, b: ground, stiffness: 200 N/m, clock: haptic}}
experiment: {duration: 2 s}
"""


def spring_in_50_digits(rows: int) -> list[tuple[mpmath.mpf, mpmath.mpf]]:
    with mpmath.workdps(50):
        m, b, k = (mpmath.mpf(value) for value in (0.1, 0.3, 200.0))
        h, a = mpmath.mpf(1) / 1000, b / m
        decay = mpmath.exp(-a * h)
        x, v = mpmath.mpf(0.01), mpmath.mpf(0)
        found = []
        for _ in range(rows):
            found.append((x, v))
            push = -k * x / m
            x, v = (
                x + v * (1 - decay) / a + push * (h / a - (1 - decay) / a**2),
                v * decay + push * (1 - decay) / a,
            )
        return found


def test_an_exact_scene_is_off_by_roundings_and_the_estimate_is_no_less() -> None:
    found = simulate(compiled(SPRING), error=True, jit=False)
    true = spring_in_50_digits(len(found.time))
    assert found.error is not None
    assert found.error.kind == "rounding"
    for column, one in enumerate(found.error.signals[:2]):
        pairs = zip(true, found.values[:, column], strict=True)
        made = max(abs(float(row[column] - mpmath.mpf(float(value)))) for row, value in pairs)
        assert made <= one.error <= 100 * made
    assert error_text(found.error).startswith("none but rounding; about ")


@pytest.mark.few(3)
@pytest.mark.parametrize("method", ["rk4:1ms", "semi-implicit:0.1ms", "cvodes:1e-7", "rk4:0.3ms"])
def test_the_estimate_of_a_linear_scene_is_its_distance_from_the_exact_motion(method: str) -> None:
    system = compiled(replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: [9 mm, 0 mm, 0 mm]}}")))
    duration = Fraction(1, 10)
    exact = simulate(system, duration=duration, jit=False)
    found = simulate(system, duration=duration, method=parse_method(method), error=True, jit=False)
    assert found.error is not None
    made = np.abs(found.values - exact.values).max(axis=0)
    told = np.array([one.error for one in found.error.signals])
    assert told == pytest.approx(made, rel=0.5, abs=1e-14)


def test_the_estimate_of_a_contact_is_its_distance_from_a_far_tighter_run() -> None:
    system = compiled(CROSSLEY)
    length = Fraction(1, 20)
    best = simulate(system, duration=length, method=parse_method("cvodes:1e-12"), jit=False).values
    for method in ("cvodes:1e-7", "rk4:0.05ms"):
        found = simulate(system, duration=length, method=parse_method(method), error=True, jit=False)
        assert found.error is not None
        made = np.abs(found.values - best).max(axis=0)
        told = np.array([one.error for one in found.error.signals])
        assert (told > 0.3 * made).all()
        assert (told < 5 * made).all()
    document = found.to_dict()["error_estimate"]
    assert document["compared_with"] == "half the step, rk4:0.025 ms"
    assert document["signals"][0].keys() == {"name", "unit", "error", "time_s", "range"}
