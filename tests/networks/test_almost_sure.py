"""The almost sure exponent: a closed form, courses multiplied by hand, reference numbers, equal seeds."""

from __future__ import annotations

import math
import re

import pytest

from apc.extensions.loss_models.lyapunov_exponent import TopLyapunovExponent, top_lyapunov_exponent
from apc.lifting.numeric_model import numeric_model
from apc.support.not_supported import NotSupportedError
from tests.held_topologies import system_of, topology
from tests.networks.test_loss import decided


def estimate(text: str) -> TopLyapunovExponent:
    model = system_of(text)
    return top_lyapunov_exponent(numeric_model(model))


# Of an independent program, for the paper's users at 10 % loss: peers, stiffness, exponent per frame and half
# of its 95 % interval.
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("peers", "stiffness", "known", "half"),
    [
        (2, 500.0, -0.04764991465454064, 8.277265879859296e-05),
        (2, 1100.0, -0.016408064819737413, 8.87988246462047e-05),
        (3, 500.0, -0.04520607980044825, 3.0578907742632605e-05),
        (3, 900.0, -0.01785369642242314, 4.550593369736907e-05),
        (3, 1100.0, -0.003331590098791081, 6.348139654886742e-05),
        (5, 900.0, -0.016734518916488996, 5.323732007715986e-05),
    ],
)
def test_exponents_are_those_of_the_reference(
    peers: int, stiffness: float, known: float, half: float
) -> None:
    found = estimate(topology(peers, stiffness))
    low, high = found.interval
    assert low < found.exponent < high < low + 1e-4
    assert low - half <= known <= high + half


def test_what_grows_in_mean_square_is_told_almost_surely_too() -> None:
    found = decided(topology(3, 1300.0))
    assert found.verdict == "unstable in mean square" and found.almost_sure is not None
    low, high = found.almost_sure.interval
    assert 0 < low < found.almost_sure.exponent < high < math.log(found.mean_square_radius or 0.0) / 2


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (topology(3, 500.0, more=", jitter: 2 ms"), "lan has jitter"),
        (
            topology(3, 500.0, more=", on_loss: zero"),
            "lan does not set the difference to 0 for a lost packet",
        ),
        (topology(1000, 500.0), "1,000 peers and their channels have 1,005,000 states"),
        (topology(20, 500.0), "20 peers and their channels have 500 states; the limit is 180"),
    ],
)
def test_what_is_not_estimated_is_named(text: str, why: str) -> None:
    model = system_of(text)
    with pytest.raises(NotSupportedError, match=f"^{re.escape(why)}"):
        top_lyapunov_exponent(numeric_model(model))
