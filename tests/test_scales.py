"""`flow`: how large the states of a scene are."""

from __future__ import annotations

import numpy as np
import pytest

from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.simulation.flow import UNKNOWN, state_scales
from tests.topologies import ONE_MASS, compiled, replaced


def scales(text: str) -> np.ndarray:
    system = compiled(text)
    [kind] = system.kinds
    return state_scales(system, kind, jacobians(kind), resolve(system).parameters[0])


def test_a_scale_is_the_largest_number_of_the_scene_in_that_unit() -> None:
    text = replaced(ONE_MASS, ("count: 1", "count: 2, set: {device.x: [5 mm, -20 mm], device.v: -3 m/s}"))
    assert scales(text) == pytest.approx([0.02, 3.0])


def test_a_velocity_is_what_the_first_force_makes_of_the_way() -> None:
    text = replaced(ONE_MASS, ("count: 1", "count: 1, set: {device.x: 20 mm}"))
    text += "hands: {hand: {type: ConstantForce, flange: device, force: 8 N}}\n"
    assert scales(text) == pytest.approx([0.02, np.sqrt(2 * 4 * 0.02)])


def test_where_the_scene_says_nothing_a_scale_is_a_thousandth() -> None:
    assert scales(ONE_MASS) == pytest.approx([UNKNOWN, UNKNOWN])
