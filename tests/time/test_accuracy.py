"""The error that a run tells of itself is about the error that it makes."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.output.simulation_output import error_text
from apc.simulation.settings import parse_method
from apc.simulation.trajectory import simulate
from tests.fifty_digits.truth import exact_course
from tests.time.test_contacts import CROSSLEY
from tests.topologies import AVERAGE, compiled, replaced

SPRING = """\
topology: spring
clocks: {haptic: 1 ms}
peers: {user: {count: 1, set: {device.x: 10 mm}}}
masses: {device: {mass: 0.1 kg, damping: 0.3 N*s/m}}
couplers: {spring: {type: SampledSpringDamper, a: device, b: ground, stiffness: 200 N/m, clock: haptic}}
experiment: {duration: 1 s}
"""


def test_an_exact_topology_is_off_by_roundings_and_the_estimate_is_no_less() -> None:
    model = compiled(SPRING)
    found = simulate(model, error=True, jit=False)
    assert found.error is not None
    assert found.error.kind == "rounding"
    followed = exact_course(model, Fraction(1))
    assert not isinstance(followed, str), followed
    made = np.abs(found.values[:, :2] - followed[1]).max(axis=0)
    reported = np.array([one.error for one in found.error.signals[:2]])
    assert (made <= reported).all() and (reported <= 100 * made).all()
    assert error_text(found.error).startswith("rounding only, about ")


@pytest.mark.few(3)
@pytest.mark.parametrize("method", ["rk4:1ms", "semi-implicit:0.1ms", "cvodes:1e-7", "rk4:0.3ms"])
def test_the_estimate_of_a_linear_topology_is_its_distance_from_the_exact_motion(method: str) -> None:
    model = compiled(replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: [9 mm, 0 mm, 0 mm]}}")))
    duration = Fraction(1, 10)
    exact = simulate(model, duration=duration, jit=False)
    found = simulate(model, duration=duration, method=parse_method(method), error=True, jit=False)
    assert found.error is not None
    made = np.abs(found.values - exact.values).max(axis=0)
    reported = np.array([one.error for one in found.error.signals])
    assert reported == pytest.approx(made, rel=0.5, abs=1e-14)


def test_the_estimate_of_a_contact_is_its_distance_from_a_far_tighter_run() -> None:
    model = compiled(CROSSLEY)
    length = Fraction(1, 20)
    best = simulate(model, duration=length, method=parse_method("cvodes:1e-12"), jit=False).values
    for method in ("cvodes:1e-7", "rk4:0.05ms"):
        found = simulate(model, duration=length, method=parse_method(method), error=True, jit=False)
        assert found.error is not None
        made = np.abs(found.values - best).max(axis=0)
        reported = np.array([one.error for one in found.error.signals])
        assert (reported > 0.3 * made).all()
        assert (reported < 5 * made).all()
    document = found.to_dict()["error_estimate"]
    assert document["compared_with"] == "half the step, rk4:0.025 ms"
    assert document["signals"][0].keys() == {"name", "unit", "error", "time_s", "range"}
