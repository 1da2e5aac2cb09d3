"""`listing`: the value of every stage is text a person can read, the same each time."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from apc.compiler.view.stages import describe
from tests.topologies import AVERAGE, clocked, compiled, flat, ordered, scene, source


@pytest.mark.parametrize(
    ("stage", "lines"),
    [
        (source, ("topology:  (1:1)", "  'three-users-average'  (str, 1:11)", "      '3'  (int, 7:17)")),
        (
            scene,
            (
                "clock haptic: every 0.001 s, first at 0 s",
                "group user: 3 peers",
                "masses cube: Mass, shared, at user",
                "  stiffness = 1000 N/m",
                "  a joins device.flange",
            ),
        ),
        (
            flat,
            (
                "kind user: 18 equations, 18 unknowns",
                "  unknown device.x [m]",
                "  device.flange.f + contact.a.f = 0    # connection",
            ),
        ),
        (
            clocked,
            (
                "  haptic: contact.f, coordination.own, coordination.received, coordination.f",
                "  sample on haptic: contact.a.x",
                "  hold of haptic: contact.f, after contact.delay s",
                "  receive on haptic over lan: mean of others.coordination.x",
                "  send over lan: coordination.x = coordination.object.x",
            ),
        ),
        (
            ordered,
            (
                "kind user: states device.x, device.v, cube.x, cube.v",
                "  alias contact.a.x = device.x",
                "    der(device.x) := device.v",
                "  send over lan: coordination.x := cube.x",
            ),
        ),
        (
            compiled,
            (
                "timing haptic.period = 1/1000 s",
                "parameter contact.stiffness = 1000 N/m",
                "    der(device.x) = device.v",
                "    coordination.x = cube.x",
            ),
        ),
    ],
)
def test_a_stage_is_told_line_by_line(stage: Callable[[str], object], lines: tuple[str, ...]) -> None:
    text = describe(stage(AVERAGE))
    for line in lines:
        assert line in text.splitlines()
    assert describe(stage(AVERAGE)) == text


def test_only_stages_can_be_told() -> None:
    with pytest.raises(AssertionError, match="int is no stage's value"):
        describe(3)
