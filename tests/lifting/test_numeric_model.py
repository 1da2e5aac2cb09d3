"""A model at its parameter values: which data other values share."""

from __future__ import annotations

import numpy as np

from apc.api import set_parameters
from apc.lifting.numeric_model import numeric_model
from tests.topologies import AVERAGE, compiled


def test_other_values_share_jacobians_and_schedules() -> None:
    numeric = numeric_model(compiled(AVERAGE))
    assert numeric.at(numeric.model) is numeric
    changed = numeric.at(set_parameters(numeric.model, {"coordination.stiffness": "800 N/m"}))
    assert changed.jacobians is numeric.jacobians
    assert changed.schedules is numeric.schedules
    stiffness = numeric.model.peer_types[0].parameters.index("coordination.stiffness")
    assert np.flatnonzero(changed.vector(0) - numeric.vector(0)).tolist() == [stiffness]
    assert changed.vector(0)[stiffness] == 800


def test_another_delay_has_other_packets_in_transit() -> None:
    # A packet every 8 ms, delayed by 8 ms or 12 ms: one or two are in transit at the start of a frame.
    numeric = numeric_model(compiled(AVERAGE))
    delayed = numeric.at(set_parameters(numeric.model, {"lan.delay": "12 ms"}))
    assert delayed.jacobians is numeric.jacobians
    assert [set(one.schedules[0].depths) for one in (numeric, delayed)] == [{1}, {2}]
    assert numeric.at(delayed.model).schedules == delayed.at(numeric.model).at(delayed.model).schedules


def test_equal_models_with_the_same_jacobians_have_one_key() -> None:
    numeric = numeric_model(compiled(AVERAGE))
    values = {"coordination.stiffness": "800 N/m"}
    one, same = (numeric.at(set_parameters(numeric.model, values)) for _ in range(2))
    assert one is not same and one == same and len({one, same, numeric}) == 2
