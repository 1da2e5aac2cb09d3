"""How far copies are from each other while every hand pushes at random, over all pushes and packets."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import pytest

from tests import bruteforce
from tests.held_topologies import topology
from tests.networks.second_moments import Law, rms_error
from tests.networks.test_loss import decided
from tests.topologies import replaced

GROUPS = """\
  left: {count: 1}
  right: {count: 1, set: {device.mass: 0.25 kg, coordination.stiffness: 700 N/m, contact.stiffness: 800 N/m}}
"""


def metres(text: str) -> float:
    found = decided(text)
    assert found.rms_error_m is not None, found.notes
    return found.rms_error_m


# By independent programs: users, K_T in N/m, 1 N² a tick of 1 ms at each device, every packet on time.
@pytest.mark.needs_extension("loss_models")
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("count", "stiffness", "expected"),
    [
        (3, 500.0, 0.00045741120952581685),
        (3, 900.0, 0.00050968295673221),
        (5, 900.0, 0.0004630448071397932),
        (2, 900.0, 0.0006146994924749179),
    ],
)
def test_with_next_to_no_loss_the_error_is_that_of_an_ideal_network(
    count: int, stiffness: float, expected: float
) -> None:
    for more in ("", ", on_loss: zero"):
        found = metres(topology(count, stiffness, loss="1e-9 %", more=more))
        assert found == pytest.approx(expected, rel=1e-9)


PATH = dict.fromkeys([(0, 1), (1, 0), (1, 2), (2, 1)], 1.0)


@pytest.mark.needs_extension("loss_models")
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("text", "more", "law"),
    [
        (topology(2, 500.0, loss="40 %"), {}, Law(0.4, 0.6)),
        (topology(2, 900.0, more=", on_loss: zero"), {"kt": 900.0}, Law(0.1, 0.9, zero=True)),
        (
            topology(2, 500.0, more=", on_loss: zero", delay="5 ms"),
            {"comm": Fraction(5, 1000)},
            Law(0.1, 0.9, zero=True),
        ),
        (topology(2, 500.0, loss="{p: 3 %, r: 30 %}"), {}, Law(0.03, 0.3)),
        (
            topology(2, 500.0, loss="{p: 3 %, r: 30 %}", delay="13 ms"),
            {"comm": Fraction(13, 1000)},
            Law(0.03, 0.3),
        ),
        (
            replaced(topology(2, 500.0), ("  user: {count: 2}\n", GROUPS)),
            {"users": ({}, {"device": 0.25, "kt": 700.0, "kc": 800.0})},
            Law(0.1, 0.9),
        ),
        pytest.param(
            topology(3, 500.0, loss="20 %", more=", graph: {edges: [[1, 2], [2, 3]]}"),
            {"peers": 3, "weights": PATH, "cube": 0.2},
            Law(0.2, 0.8),
            marks=pytest.mark.whole,
        ),
    ],
)
def test_it_is_that_of_moments_followed_event_by_event(text: str, more: dict[str, Any], law: Law) -> None:
    """The largest of all copies; whatever the delay, it is looked at as packets are sent."""
    followed = bruteforce.TopologySource(**{"peers": 2, "cube": 0.3, **more})
    assert metres(text) == pytest.approx(rms_error(followed, law), rel=1e-9)


@pytest.mark.whole
def test_of_many_users_bursts_tell_an_estimate_that_is_called_one() -> None:
    found = decided(topology(5, 500.0, loss="{p: 0.3 %, r: 30 %}"))
    assert found.rms_error_m == pytest.approx(metres(topology(5, 500.0, loss="1e-9 %")), rel=0.01)
    assert any("estimate: joint moments of at most 3 channel states" in note for note in found.notes)


@pytest.mark.few(1)
@pytest.mark.parametrize("more", ["", ", on_loss: zero"])
def test_a_million_users_cost_what_three_do(more: str) -> None:
    """Each then follows a mean that the others hardly move: the error is that of a user held by a spring."""
    near, far = (
        metres(replaced(topology(count, 500.0, more=more), ("0.6 kg", f"{0.2 * count:.1f} kg")))
        for count in (10**3, 10**6)
    )
    assert near == pytest.approx(far, rel=1e-3)
    assert near != far


@pytest.mark.whole
def test_a_force_moves_all_that_is_rigidly_connected_with_a_device() -> None:
    geared = replaced(
        topology(3, 500.0),
        ("couplers:\n", "couplers:\n  gear: {type: Gear, a: device, b: motor, ratio: 1}\n"),
        ("  cube:", "  motor: {mass: 80 g}\n  cube:"),
    )
    heavier = metres(replaced(topology(3, 500.0), ("mass: 0.1 kg", "mass: 0.18 kg")))
    assert metres(geared) == pytest.approx(heavier, rel=1e-12)
    found = decided(replaced(geared, ("ratio: 1", "ratio: 2")))
    why = "user: device is coupled to masses with other motions, so the device is not unique"
    assert found.rms_error_m is None and any(note.endswith(why) for note in found.notes)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            ("  cube:", "  glove: {mass: 1 kg, damping: 1 N*s/m}\n  cube:"),
            "the device of user is not unique: device, glove",
        ),
        (
            ("stiffness: 500.0", "stiffness: 0"),
            "the object copies are not coupled, so their difference grows without bound",
        ),
        (("stiffness: 500.0", "stiffness: 2000"), "available only if second moments decay"),
    ],
)
def test_where_there_is_none_it_says_why(change: tuple[str, str], why: str) -> None:
    found = decided(replaced(topology(3, 500.0), change))
    assert found.rms_error_m is None
    assert f"coordination error not available: {why}" in found.notes
