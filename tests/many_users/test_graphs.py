"""Who hears whom: eigenvalues of graphs, weights as the decimals they are, and what no mean can be of."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.compiler.errors import ApcError
from apc.compiler.weights import sum_weights
from apc.eigen.balls import precision
from tests.bench.random_scenes import check, truth
from tests.sites import linked, paper
from tests.topologies import MESH, compiled, library, replaced

# A mean whose weights are those of the graph as they stand, for rows that add up to 1.
STOCHASTIC = """\
component: WeightedMean
about: Pulls a copy to what the weights make of the others.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {stiffness: {unit: N/m}, clock: clock, link: link}
equations:
  - object.f = hold(f)
  - f = stiffness*(sample(object.x) - sum(others.x))
"""


def weighted(edges: str, text: str = MESH) -> str:
    """Return a scene of three users who hear one another over weighted edges or arcs."""
    return replaced(text, ("delay: 8 ms}", f"delay: 8 ms, graph: {{{edges}}}}}"))


def test_sums_that_floats_cannot_tell_apart_are_told_apart() -> None:
    sums = sum_weights(np.array([0, 1, 1]), np.array([0.3, 0.3, 1e-20]), 2)
    assert sums.floats[0] == sums.floats[1]
    assert not sums.alike(0, 2)


@pytest.mark.few(3)
@pytest.mark.parametrize("seed", range(6))
def test_peers_that_weigh_one_another_move_together_freely(seed: int) -> None:
    generator = random.Random(seed)
    digits = (1, 2, 4, 9, 15, 17)[seed]
    arcs = [
        f"[{sender}, {receiver}, {generator.uniform(0.05, 1.2):.{digits}f}]"
        for sender in (1, 2, 3)
        for receiver in (1, 2, 3)
        if sender != receiver
    ]
    system = compiled(weighted(f"arcs: [{', '.join(arcs)}]"))
    found = analyze(system, certify=True)
    assert found.verdict == "stable up to a common translation"
    assert found.proof.startswith("proved stable")
    with precision(256):
        assert check(found, *truth(system)) == ""


def test_rows_of_weights_that_add_up_to_one_are_a_mean(tmp_path: Path) -> None:
    text = weighted("arcs: [[1, 2, 0.1], [3, 2, 0.9], [2, 1, 0.3], [3, 1, 0.7], [1, 3, 0.4], [2, 3, 0.6]]")
    text = replaced(text, ("type: FullMesh", "type: WeightedMean"), (", delay: 1 ms, link", ", link"))
    system = compiled(text, library(tmp_path, STOCHASTIC))
    assert analyze(system, certify=True).verdict == "stable up to a common translation"


def test_counts_that_doubles_cannot_tell_apart_are_refused() -> None:
    with pytest.raises(ApcError, match=r"E217 .* sums that doubles can't tell apart"):
        compiled(weighted("arcs: [[1, 2, 0.3], [2, 1, 0.3], [3, 1, 1.0e-20], [1, 3]]"))


def test_a_mean_of_weights_that_cancel_as_decimals_is_refused() -> None:
    arcs = "arcs: [[1, 4, 0.1], [2, 4, 0.2], [3, 4, -0.3], [4, 1], [4, 2], [4, 3]]"
    text = replaced(weighted(arcs), ("FullMesh", "AveragePosition"), ("count: 3", "count: 4"))
    with pytest.raises(ApcError, match="E802"):
        analyze(compiled(text))


def test_a_mean_whose_weights_add_up_to_nothing_is_refused() -> None:
    arcs = [(0, 1, 1.0), (2, 1, -1.0), (1, 0, 1.0), (1, 2, 1.0)]
    message = r"E802 the weights of what user\[2\] hears over lan add up to 0: there is no mean"
    for method in ("auto", "dense"):
        with pytest.raises(ApcError, match=message):
            analyze(linked(paper(), arcs), method=method)
        with pytest.raises(ApcError, match=r"E801 user\[1\] hears nobody over lan"):
            analyze(linked(paper(), arcs[:2]), method=method)
    assert analyze(linked(paper("sum"), arcs)).method in ("modes", "dense")
