"""Where a topology is not linear it is linearized where it starts, pair by pair, and says so."""

from __future__ import annotations

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_classes
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.lifting.numeric_model import numeric_model
from apc.spectrum.modes import dense, split
from tests.bruteforce import TopologySource, frame_matrix
from tests.pairing import apart, arcs_of
from tests.sites import edged, paper

GAINS = {"kt": 800.0, "bt": 2.0, "kc": 1500.0, "bc": 2.0}


def _cubic_pairs(starts: list[float], cubic: float) -> dict[tuple[int, int], float]:
    """Return the slopes of K d + c d³ where each pair starts."""
    everyone = range(len(starts))
    return {
        (i, j): GAINS["kt"] + 3 * cubic * (starts[i] - starts[j]) ** 2
        for i in everyone
        for j in everyone
        if i != j
    }


@pytest.mark.few(6)
@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["complete", "ring", "star", "apart"])
@pytest.mark.parametrize("starts", [[0.0, 0.0, 0.0, 0.0], [0.01, 0.02, 0.05, 0.02]])
def test_an_edge_function_is_linearized_pair_by_pair(operator: str, graph: str, starts: list[float]) -> None:
    arcs = None if graph == "complete" else {(i, j): weight for i, j, weight in arcs_of(graph, 4)}
    model = edged(operator, starts, cubic=2e5, weights=arcs, **GAINS)
    topology = TopologySource(operator, 4, weights=arcs, pairs=_cubic_pairs(starts, 2e5), **GAINS)
    expected = np.linalg.eigvals(np.array(frame_matrix(topology)))
    assert apart(_split(model), expected) < 1e-11
    whole = np.linalg.eigvals(dense(*lifted_classes(numeric_model(model))).matrix)
    assert apart(whole, expected) < 1e-11


def _split(model: Model) -> np.ndarray:
    """Return all eigenvalues of the split system, each as often as it counts."""
    systems = split(*lifted_classes(numeric_model(model)))
    return np.concatenate([np.repeat(np.linalg.eigvals(one.matrix), one.multiplicity) for one in systems])


def test_the_largest_of_equal_peers_has_no_linearization() -> None:
    with pytest.raises(
        ApcError, match=r"E803 .* of user\[1\]: max over peers with equal values has no linearization"
    ):
        analyze(numeric_model(edged("max", [0.0] * 3)))
    assert analyze(numeric_model(edged("max", [0.0, 0.01, 0.02]))).linearized
    # Two peers: the only other one is the largest, and the smallest, and the mean.
    two = [
        analyze(numeric_model(edged(operator, [0.0] * 2))).spectral_radius
        for operator in ("max", "min", "mean")
    ]
    assert two == pytest.approx([two[0]] * 3, abs=1e-12)


def test_the_largest_is_the_one_that_starts_furthest_away() -> None:
    """F_T = K max_j (x_i − x_j): everyone hears the lowest, the lowest the next: a graph of arcs."""
    arcs = {(1, 0): 1.0, (2, 1): 1.0, (1, 2): 1.0}
    expected = analyze(numeric_model(paper(weights=arcs)), method="dense").spectral_radius
    assert analyze(numeric_model(edged("max", [0.03, 0.0, 0.01]))).spectral_radius == pytest.approx(
        expected, abs=1e-10
    )
