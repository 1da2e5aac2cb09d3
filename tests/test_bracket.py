"""Claims about `apc.vary.bracket`: what holds a crossing, in balls and in floats."""

from __future__ import annotations

import pytest

from apc.vary import bracket as brackets
from apc.vary.critical import critical
from tests.topologies import AVERAGE, ROOT, compiled

LIMIT = 1096.410868365630  # tests.reference, of the paper's scene
PATH = "coordination.stiffness"


def test_more_states_than_balls_are_worth_are_held_in_floats_and_around_the_proved_value(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = compiled(AVERAGE)
    proved = critical(scene, PATH)
    monkeypatch.setattr(brackets, "MOST_PROVED", 3)
    held = critical(scene, PATH)
    assert proved.crossings[0].proof.startswith("proved with")
    assert held.crossings[0].proof == "bounded in floats"
    assert None not in (held.value, held.error, proved.value, proved.error)
    assert abs(held.value - proved.value) <= held.error + proved.error  # type: ignore[operator] # they are there
    assert held.value == pytest.approx(LIMIT, rel=1e-11)
    assert held.error < 1e-9 * LIMIT  # type: ignore[operator] # it is there


def test_a_delays_crossing_is_held_in_floats_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = compiled(AVERAGE)
    proved = critical(scene, "contact.delay", upper="3 ms").crossings[0]
    monkeypatch.setattr(brackets, "MOST_PROVED", 3)
    held = critical(scene, "contact.delay", upper="3 ms").crossings[0]
    assert held.proof == "bounded in floats"
    assert abs(held.value - proved.value) <= held.error + proved.error
    assert held.error < 1e-9 * proved.value


def test_a_defective_cluster_is_held_where_its_eigenvalue_alone_crosses() -> None:
    """Four equal peers in a chain have one eigenvector; floats scatter their eigenvalue by a part in 10⁴.

    Each of them is a part of its own, which has it once.
    """
    text = (ROOT / "tests" / "hard" / "defective.yaml").read_text(encoding="utf-8")
    chain = critical(compiled(text), PATH).crossings[0]
    # One of them behind the first moves as each of them does; a copy keeps its share of the mass.
    alone = text.replace("count: 4", "count: 1").replace("mass: 1 kg", "mass: 0.4 kg")
    alone = alone.replace("[1, 2, 1], [2, 3, 1], [3, 4, 1], [4, 5, 1]", "[1, 2, 1]")
    one = critical(compiled(alone), PATH).crossings[0]
    assert one.proof.startswith("proved with")
    assert chain.proof.startswith("proved with")
    assert abs(chain.value - one.value) <= chain.error + one.error
    assert chain.error < 1e-11 * chain.value
