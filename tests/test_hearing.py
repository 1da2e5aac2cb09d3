"""Claims about `apc.simulation.hearing`: whom means are over, and what hearing costs."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.compiler.compiled import CompiledSystem
from apc.simulation.blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.sites import grouped, linked, paper
from tests.topologies import compiled, replaced


def _operations(system: CompiledSystem) -> int:
    hearing = prepare(system, Settings(Fraction(1), jit=False)).population.hearing
    return sum(map(len, hearing.segments))


@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_the_frame_of_a_thousand_peers_has_the_operations_of_three(operator: str) -> None:
    for graph in ("complete", "ring"):
        few, many = (_operations(linked(paper(operator, peers=n), graph)) for n in (3, 1000))
        assert few == many


def test_a_second_group_adds_its_own_and_not_a_product() -> None:
    counts = [
        _operations(grouped(paper(), *((f"g{i}", 2, {"device.mass": 0.1 + i}) for i in range(n))))
        for n in (1, 2, 3, 4)
    ]
    assert counts[3] - counts[2] <= 2 * (counts[2] - counts[1])
    assert counts[2] - counts[1] == pytest.approx(counts[1] - counts[0], rel=0.5)


SOME_SEND = """\
topology: some-send
clocks: {haptic: 1 ms, network: 8 ms}
peers:
  near: {set: {body.x: [10 mm, -4 mm]}}
  far:  {set: {body.x: [7 mm, -12 mm]}}
masses:
  body: {mass: 0.1 kg, damping: 5 N*s/m}
couplers:
  pull:
    type: AveragePosition
    at: [near]
    object: body
    stiffness: 500 N/m
    clock: haptic
    link: lan
links:
  lan: {clock: network, delay: 8 ms}
"""


def _played(text: str) -> np.ndarray:
    simulation = prepare(compiled(text), Settings(Fraction(1, 10), jit=False), signals=["near*"])
    return np.concatenate([block.values for block in blocks(simulation)])


@pytest.mark.parametrize("link", ["", ", graph: ring", ", loss: 0 %", ", graph: ring, loss: 0 %"])
def test_who_sends_nothing_counts_in_no_mean(link: str) -> None:
    """Two of four peers send: each hears the other one whole, whatever else it is tied to."""
    alone = replaced(SOME_SEND, ("  far:  {set: {body.x: [7 mm, -12 mm]}}\n", ""), ("    at: [near]\n", ""))
    text = replaced(SOME_SEND, ("delay: 8 ms}", f"delay: 8 ms{link}}}"))
    near, two = _played(text), _played(alone)
    assert np.ptp(two, axis=0).max() > 0.005
    assert near == pytest.approx(two, rel=1e-12, abs=1e-14)
