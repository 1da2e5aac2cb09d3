"""Claims about `apc.simulation.signals`."""

from __future__ import annotations

import pytest

from apc.compiler.errors import ApcError
from apc.simulation.signals import LocalSignal, choose, signals_of
from tests.sites import grouped, paper

SYSTEM = grouped(paper(), ("left", 2, {}), ("right", 1, {}))
LOCALS = (LocalSignal("cube.x", "m", "state", (2,)), LocalSignal("cube.v", "m/s", "state", (3,)))


def _names(*patterns: str) -> list[str]:
    return [one.name for one in signals_of(SYSTEM, choose(SYSTEM, [LOCALS, LOCALS], patterns))]


def test_peers_are_counted_from_one_and_headings_say_the_unit() -> None:
    found = signals_of(SYSTEM, choose(SYSTEM, [LOCALS, LOCALS], []))
    assert [one.heading for one in found][:3] == [
        "left[1].cube.x [m]",
        "left[1].cube.v [m/s]",
        "left[2].cube.x [m]",
    ]
    assert len(found) == 6


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("cube.x", ["left[1].cube.x", "left[2].cube.x", "right[1].cube.x"]),
        ("left[2].*", ["left[2].cube.x", "left[2].cube.v"]),
        ("right*.v", ["right[1].cube.v"]),
        ("*[1].cube.?", ["left[1].cube.x", "left[1].cube.v", "right[1].cube.x", "right[1].cube.v"]),
    ],
)
def test_a_pattern_means_every_peer_unless_it_names_one(pattern: str, names: list[str]) -> None:
    assert _names(pattern) == names


def test_a_pattern_that_fits_nothing_gets_the_nearest_name() -> None:
    with pytest.raises(ApcError, match=r"E873 no signal fits 'cube.y'.*--signals cube.[xv]"):
        _names("cube.x", "cube.y")
