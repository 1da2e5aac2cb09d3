"""What is kept from one answer to the next never tells of another scene: each is as in a process alone."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable

import pytest

import apc
from apc.compiler.compiled import CompiledSystem
from tests.topologies import AVERAGE, ROOT, compiled, replaced

# Each changes one thing that what is kept hangs on: a number, a time, how many, who hears whom, a law.
CHANGES: tuple[dict[str, str], ...] = (
    {},
    {"coordination.stiffness": "700 N/m"},
    {"coordination.stiffness": "0 N/m"},
    {"device.mass": "0.2 kg"},
    {"device.damping": "0 N*s/m", "cube.damping": "0 N*s/m"},
    {"lan.delay": "24 ms"},
    {"contact.delay": "0 ms"},
    {"network.period": "4 ms"},
    {"user.count": "5"},
)
TEXTS = (
    AVERAGE,
    AVERAGE.replace("AveragePosition", "FullMesh"),
    replaced(AVERAGE, ("clock: network", "graph: ring, clock: network")),
    replaced(
        AVERAGE, ("user: {count: 3}", "user: {count: 2}\n  other: {count: 1, set: {device.mass: 0.3 kg}}")
    ),
)
DEEP = (0, 1, 3, 5, 7)


def scene(place: int) -> CompiledSystem:
    """Return one of the scenes: the first text with each change, then the other texts."""
    if place < len(CHANGES):
        return apc.set_parameters(compiled(TEXTS[0]), CHANGES[place])
    return compiled(TEXTS[place - len(CHANGES) + 1])


def answers(place: int) -> str:
    """Return everything that is told of a scene, every digit of it."""
    system = scene(place)
    listed = [repr(apc.analyze(system)), repr(apc.conventions(system))]
    if place in DEEP:
        many = apc.analyze_many(system, {"contact.stiffness": [300.0, 700.0, 1500.0]})
        listed += [repr(many.to_dict()), repr(apc.margins(system)), repr(apc.sensitivities(system))]
    return "\n".join(listed)


def alone(places: Iterable[int]) -> list[str]:
    """Return what processes tell that are asked for one scene each."""
    program = (
        "import sys; from tests.varying.test_nothing_is_kept import answers; print(answers(int(sys.argv[1])))"
    )
    return [
        subprocess.run(
            [sys.executable, "-c", program, str(place)],
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        ).stdout.removesuffix("\n")
        for place in places
    ]


COUNT = len(CHANGES) + len(TEXTS) - 1


@pytest.mark.parametrize(
    "places",
    [
        (0, 5),
        *(pytest.param((k,), marks=pytest.mark.whole) for k in range(COUNT) if k not in (0, 5)),
    ],
    ids=str,
)
def test_a_scene_after_others_is_told_as_it_is_alone(places: tuple[int, ...]) -> None:
    """Others are asked for first, in either order, and of other texts of as many states."""
    expected = alone(places)
    for others in (range(COUNT), reversed(range(COUNT))):
        for other in others:
            apc.analyze(scene(other))
        assert [answers(place) for place in places] == expected
