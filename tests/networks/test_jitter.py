"""Packets that come late or early by chance, against independent programs, who differ by 1.4e-9."""

from __future__ import annotations

import pytest

import apc
from apc.compiler.errors import ApcError
from tests.held_topologies import system_of, topology
from tests.networks.test_loss import radius


def late(peers: int, stiffness: float, jitter: str, delay: str = "8 ms") -> str:
    return topology(peers, stiffness, loss="0 %", more=f", jitter: {jitter}", delay=delay)


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("peers", "stiffness", "expected"),
    [
        (2, 500.0, 0.9065234528729412),
        (2, 900.0, 0.9436466028056727),
        (3, 500.0, 0.9143370941838205),
        (3, 900.0, 0.9664242408305221),
        (3, 1100.0, 0.9954032394497966),
        (5, 900.0, 0.9683634727072361),
    ],
)
def test_a_uniform_jitter_of_4_ms_meets_the_references(peers: int, stiffness: float, expected: float) -> None:
    assert radius(late(peers, stiffness, "4 ms")) == pytest.approx(expected, abs=1e-9)


def test_within_a_tick_nobody_hears_the_difference() -> None:
    # 7.2 ms to 7.8 ms is 8 ms where ticks come every 1 ms: the square of the nominal radius.
    assert radius(late(3, 500.0, "0.3 ms", "7.5 ms")) == pytest.approx(0.9161770691168368, rel=1e-12)


@pytest.mark.needs_extension("parameter_boxes")
def test_a_jitter_is_no_range_of_a_box_and_another_number_is() -> None:
    model = system_of(late(3, 500.0, "2 ms"))
    with pytest.raises(ApcError, match=r"E831 lan\.jitter is a time"):
        apc.robust_stability(model, {"lan.jitter": "±1%"})
    assert apc.robust_stability(model, {"contact.stiffness": "±0.01%"}).stable
    with pytest.raises(ApcError, match=r"E625 lan\.jitter: expected a time of 0 s or more"):
        apc.set_parameters(model, {"lan.jitter": "-1 ms"})
