"""What is kept from one answer to the next never tells of another topology: each is as in a process alone."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import apc
from apc.compiler.compiled import Model
from tests.topologies import AVERAGE, ROOT, compiled, replaced

OTHER = "user: {count: 2}\n  other: {count: 1, set: {device.mass: 0.3 kg}}"
# Each changes one thing that what is kept hangs on: a number, a time, how many, who hears whom, a law.
TOPOLOGIES: tuple[tuple[str, dict[str, str]], ...] = (
    (AVERAGE, {}),
    (AVERAGE, {"coordination.stiffness": "700 N/m"}),
    (AVERAGE, {"coordination.stiffness": "0 N/m"}),
    (AVERAGE, {"device.mass": "0.2 kg"}),
    (AVERAGE, {"device.damping": "0 N*s/m", "cube.damping": "0 N*s/m"}),
    (AVERAGE, {"lan.delay": "24 ms"}),
    (AVERAGE, {"contact.delay": "0 ms"}),
    (AVERAGE, {"network.period": "4 ms"}),
    (AVERAGE, {"user.count": "5"}),
    (AVERAGE.replace("AveragePosition", "FullMesh"), {}),
    (replaced(AVERAGE, ("clock: network", "graph: ring, clock: network")), {}),
    (replaced(AVERAGE, ("user: {count: 3}", OTHER)), {}),
)
DEEP, FIRST = (0, 1, 3, 5, 7), (5,)


def topology(place: int) -> Model:
    text, change = TOPOLOGIES[place]
    return apc.set_parameters(compiled(text), change)


def answers(place: int) -> str:
    """Return everything that is told of a topology, every digit of it."""
    model = topology(place)
    listed = [repr(apc.analyze(model)), repr(apc.event_order(model))]
    if place in DEEP:
        many = apc.analyze_many(model, {"contact.stiffness": [300.0, 700.0, 1500.0]})
        listed += [repr(many.to_dict()), repr(apc.margins(model)), repr(apc.sensitivities(model))]
    return "\n".join(listed)


@pytest.mark.whole
@pytest.mark.parametrize(
    "place",
    [pytest.param(k, marks=[] if k in FIRST else [pytest.mark.whole]) for k in range(len(TOPOLOGIES))],
)
def test_a_topology_after_others_is_told_as_it_is_alone(place: int) -> None:
    """Others are asked for first, in either order, and of other texts of as many states."""
    program = f"from tests.varying.test_nothing_is_kept import answers; print(answers({place}))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, check=True, capture_output=True, text=True, env=environment
    )
    for others in (range(len(TOPOLOGIES)), reversed(range(len(TOPOLOGIES)))):
        for other in others:
            apc.analyze(topology(other))
        assert answers(place) == ran.stdout.removesuffix("\n")
