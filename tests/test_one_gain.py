"""Claims about `apc.vary.one_gain`."""

from __future__ import annotations

import numpy as np
import pytest

from apc.frame.names import parameter_of
from apc.vary import one_gain
from apc.vary.evaluator import evaluator
from apc.vary.margins import coupler_parameters, margins
from apc.vary.one_gain import Gain, NotTold, first_crossing, gains_of, response_of
from tests.topologies import AVERAGE, MESH, compiled


def test_a_gain_on_a_late_integrator_crosses_at_its_closed_form() -> None:
    """x⁺ = x − k y, y what x was d steps ago, is stable up to k = 2 sin(π / (4 d + 2))."""
    for delay in (1, 4, 20):
        start, n = 0.01, delay + 1
        shift = np.eye(n, k=-1)
        shift[0, 0] = 1.0
        into, out = np.zeros((n, 1)), np.zeros((1, n))
        into[0, 0], out[0, -1] = -1.0, 1.0
        gain = Gain(shift + start * into @ out, into, out, np.zeros((1, 1)))
        response = response_of(gain.a)
        assert response is not None
        root = first_crossing([(gain, response)], start, 3.0)
        assert root is not None
        assert abs(root.value - 2 * np.sin(np.pi / (4 * delay + 2))) < 1e-12
        assert abs(abs(np.angle(root.eigenvalue)) - np.pi / (2 * delay + 1)) < 1e-9


def test_a_mode_near_the_circle_that_little_moves_is_not_missed() -> None:
    """Of forty modes with 1e-6 of damping a gain takes the damping of one, and leaves the others alone."""
    angles = np.linspace(0.05, 3.0, 40)
    blocks = [(1 - 1e-6) * np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) for t in angles]
    whole = np.zeros((80, 80))
    for place, one in enumerate(blocks):
        whole[2 * place : 2 * place + 2, 2 * place : 2 * place + 2] = one
    into, out = np.zeros((80, 2)), np.zeros((2, 80))
    into[[34, 35], [0, 1]] = out[[0, 1], [34, 35]] = 1e-4
    gain = Gain(whole, into, out @ whole, np.zeros((2, 2)))
    response = response_of(whole)
    assert response is not None
    root = first_crossing([(gain, response)], 0.0, 1e3)
    assert root is not None
    # (1 − 1e-6) (1 + 1e-8 k) = 1
    assert root.value == pytest.approx((1 / (1 - 1e-6) - 1) / 1e-8, rel=1e-8)


@pytest.mark.parametrize("text", [AVERAGE, MESH])
def test_it_finds_the_margins_that_are_found_value_by_value(text: str) -> None:
    system = compiled(text)
    free = coupler_parameters(system)
    family = evaluator(system, free)
    base = np.array([parameter_of(system, one).value for one in free])
    responses = [response_of(one[0]) for one in family.matrices(base[None])]
    rows = {one.parameter: one for one in margins(system).rows}
    for column, one in enumerate(free):
        gains = gains_of(family, base, column)  # type: ignore[arg-type] # one of affine equations
        assert gains is not None
        other = base.copy()
        other[column] += 3.0
        for gain, matrix in zip(gains, family.matrices(other[None]), strict=True):
            assert np.allclose(gain.matrix(3.0)[0], matrix[0], rtol=1e-11, atol=1e-11)
        known = [(gain, found) for gain, found in zip(gains, responses, strict=True) if found]
        root = first_crossing(known, base[column], base[column] + 1e4)
        assert root is not None
        value = rows[one.label].value
        assert value is not None
        assert abs(root.value - value) < 1e-11 * value


def test_a_spring_that_acts_all_the_time_is_no_gain() -> None:
    system = compiled(
        AVERAGE.replace("SampledSpringDamper", "SpringDamper").replace(
            ", clock: haptic, delay: 1 ms}", "}", 1
        )
    )
    free = [one for one in coupler_parameters(system) if one.name == "contact.stiffness"]
    family = evaluator(system, free)
    assert gains_of(family, np.array([1000.0]), 0) is None  # type: ignore[arg-type] # one of affine equations


def test_where_angles_run_out_nothing_is_said_instead_of_none(monkeypatch: pytest.MonkeyPatch) -> None:
    shift = np.eye(5, k=-1)
    shift[0, 0] = 1.0
    into, out = np.zeros((5, 1)), np.zeros((1, 5))
    into[0, 0], out[0, -1] = -1.0, 1.0
    gain = Gain(shift + 0.01 * into @ out, into, out, np.zeros((1, 1)))
    response = response_of(gain.a)
    assert response is not None
    monkeypatch.setattr(one_gain, "_real", lambda *given: np.zeros((len(given[4]), 2)))
    with pytest.raises(NotTold):
        first_crossing([(gain, response)], 0.01, 3.0)
