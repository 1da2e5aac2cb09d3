"""Claims about `apc.vary.marginal`: the motion on the boundary is the one that decides."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.analysis.analysis import analyze
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.vary.critical import critical
from tests.topologies import AVERAGE, SCENES, compiled


def test_a_change_of_sign_at_every_tick_is_not_taken_for_a_rigid_motion() -> None:
    """Eight ticks of 1 ms make a frame: (−1)⁸ = 1, the eigenvalue of the peers' common translation."""
    text = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8").partition("\n")[2]
    scene = compiled(text)
    found = critical(scene, "coordination.damping", lower="100 N*s/m", upper="300 N*s/m")
    [one] = found.crossings
    assert one.frequency_hz == pytest.approx(500, rel=1e-9)
    beside = apply(
        scene, [Override(Free("coordination.damping"), Fraction(one.value) * Fraction(1001, 1000))]
    )
    assert analyze(beside).modes[0].frequency_hz == pytest.approx(500, rel=1e-9)


@pytest.mark.parametrize("name", ["contact.stiffness", "coordination.damping", "contact.delay"])
def test_the_frequency_is_that_of_the_leading_mode_of_an_analysis(name: str) -> None:
    scene = compiled(AVERAGE)
    [one, *_] = critical(scene, name).crossings
    here = analyze(apply(scene, [Override(Free(name), Fraction(one.value))]))
    assert one.frequency_hz == pytest.approx(here.modes[0].frequency_hz, rel=1e-6)
