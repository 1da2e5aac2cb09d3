"""The independent engine of fifty digits against computations that share nothing with it, and balls."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import flint
import pytest

from apc.benchmark.truth import spectral_truth as of_balls
from apc.compiler.compiled import Model
from apc.compiler.pipeline import compile_topology
from apc.spectrum.ball_arithmetic import precision
from tests.bench.random_topologies import run
from tests.bruteforce import TopologySource, as_ball, frame_matrix
from tests.fifty_digits.truth import Truth, spectral_truth
from tests.sites import MS, paper
from tests.topologies import TOPOLOGIES


def _radius(topology: TopologySource, rigid: int) -> flint.arb:
    """Return the radius by the brute force of the tests, which knows the topology and no compiled
    function.
    """
    with precision(600):
        rows = frame_matrix(topology, number=as_ball, exp=lambda value: value.exp())
        values = flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")
        values.sort(key=lambda value: float(abs(value - 1).mid()))
        return max(abs(value).mid() for value in values[rigid:])


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["ring-of-eight", "star-lecture", "mixed-clocks", "experiment-mesh"][::-1])
def test_what_bench_compares_with_is_the_truth_of_the_independent_engine(name: str) -> None:
    model = compile_topology(TOPOLOGIES / f"{name}.yaml")
    found = of_balls(model)
    assert found.digits[:45] == _truth(model).digits[:45]


def _truth(model: Model) -> Truth:
    found = spectral_truth(model)
    assert isinstance(found, Truth), found
    return found


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "values",
    [
        {},
        {"operator": "sum", "peers": 2, "bt": 2.0, "bc": 1.0},
        {"comp": MS / 7, "comm": MS * 22 / 7},
        {"comp": Fraction(0), "comm": Fraction(0), "own_delay": True},
        {"peers": 2, "operator": "sum", "network": Fraction(1, 90), "comm": Fraction(1, 45)},
        {"haptic_phase": MS / 2, "network_phase": MS * 3},
    ],
)
def test_fifty_digits_are_those_of_the_brute_force(values: dict[str, Any]) -> None:
    topology = {"kt": 300.0, **values}
    found = _truth(paper(**topology))
    assert found.rigid == 1
    with precision(600):
        assert float(abs(found.radius - _radius(TopologySource(**topology), 1))) < 1e-50


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [11, 14])
def test_no_bound_fails_and_no_verdict_is_wrong(seed: int) -> None:
    tally = run(4, seed=seed, draws=4)
    assert tally.wrong == []
    assert tally.topologies + tally.refused == 4
    assert tally.tightest <= 1
