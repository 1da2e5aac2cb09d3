"""Claims about `apc.simulation.frame_packets`: what hearing costs."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.compiler.compiled import CompiledSystem
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.sites import grouped, linked, paper


def _instructions(system: CompiledSystem) -> int:
    return int(prepare(system, Settings(Fraction(1), jit=False)).population.frame.n_instructions())


@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_the_frame_of_a_thousand_peers_has_the_instructions_of_three(operator: str) -> None:
    for graph in ("complete", "ring"):
        few, many = (_instructions(linked(paper(operator, peers=n), graph)) for n in (3, 1000))
        assert few == many


def test_a_second_group_adds_its_own_and_not_a_product() -> None:
    counts = [
        _instructions(grouped(paper(), *((f"g{i}", 2, {"device.mass": 0.1 + i}) for i in range(n))))
        for n in (1, 2, 3, 4)
    ]
    assert counts[3] - counts[2] <= 2 * (counts[2] - counts[1])
    assert counts[2] - counts[1] == pytest.approx(counts[1] - counts[0], rel=0.5)
