"""Claims about `apc.eigen.graph_modes`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.compiler.compiled import Graph
from apc.eigen.graph_modes import GraphMode, graph_modes
from apc.frame.exchange import arcs
from tests.sites import COMPLETE


def _graph(shape: str) -> Graph:
    return Graph(shape, COMPLETE.arcs, COMPLETE.weights)


def _given(*listed: tuple[int, int, float]) -> Graph:
    return Graph("arcs", np.array([arc[:2] for arc in listed]), np.array([arc[2] for arc in listed]))


def _matrix(graph: Graph, peers: int, *, mean: bool) -> np.ndarray:
    matrix = np.zeros((peers, peers))
    for (sender, receiver), weight in zip(*arcs(graph, peers), strict=True):
        matrix[receiver, sender] += weight
    return matrix / matrix.sum(axis=1)[:, None] if mean else matrix


def _values(modes: tuple[GraphMode, ...]) -> list[complex]:
    pairs = [[one.value] if not one.imaginary else [one.value, one.value.conjugate()] for one in modes]
    return [value for one, pair in zip(modes, pairs, strict=True) for value in pair * one.multiplicity]


@pytest.mark.parametrize("peers", [2, 3, 4, 5, 6, 9, 12])
@pytest.mark.parametrize("shape", ["ring", "star", "complete"])
@pytest.mark.parametrize("mean", [True, False])
def test_closed_forms_are_the_eigenvalues_of_the_matrix(shape: str, peers: int, mean: bool) -> None:
    found = graph_modes(_graph(shape), peers, mean=mean)
    assert found is not None
    expected = np.sort(np.linalg.eigvals(_matrix(_graph(shape), peers, mean=mean)).real)
    np.testing.assert_allclose(np.sort(np.array(_values(found)).real), expected, atol=1e-12)


def test_equal_row_sums_are_an_exact_eigenvalue_as_often_as_peers_are_apart() -> None:
    pairs = _given((0, 1, 0.1), (1, 0, 0.1), (2, 3, 0.1), (3, 2, 0.1))
    found = graph_modes(pairs, 4, mean=False)
    assert found is not None
    assert found[0] == GraphMode(Fraction(1, 10), Fraction(0), 2, 0.0, True)


def test_a_cycle_one_way_has_complex_pairs() -> None:
    found = graph_modes(_given((0, 1, 1.0), (1, 2, 1.0), (2, 0, 1.0)), 3, mean=True)
    assert found is not None
    assert [one.multiplicity for one in found] == [1, 1]
    assert found[1].value == pytest.approx(complex(-0.5, 3**0.5 / 2), abs=found[1].doubt)


def test_a_matrix_without_a_full_set_of_eigenvectors_is_told() -> None:
    assert graph_modes(_given((0, 1, 1.0), (1, 2, 1.0)), 3, mean=False) is None


@pytest.mark.parametrize("mean", [True, False])
@pytest.mark.parametrize("shape", ["star", "ring"])
def test_two_peers_are_exact(shape: str, mean: bool) -> None:
    found = graph_modes(_graph(shape), 2, mean=mean)
    assert found is not None
    assert all(mode.doubt == 0 for mode in found)
    assert sorted(_values(found), key=lambda value: value.real) == pytest.approx(
        sorted(np.linalg.eigvals(_matrix(_graph(shape), 2, mean=mean)).astype(complex), key=lambda v: v.real)
    )


def test_simple_fractions_are_exact_and_others_have_a_doubt() -> None:
    """Three peers who hear both others by halves: 1 and twice −1/2. A path of four: the golden section."""
    halves = _given(*((i, j, 0.5) for i in range(3) for j in range(3) if i != j))
    found = graph_modes(halves, 3, mean=False)
    assert found is not None
    assert [(mode.real, mode.multiplicity, mode.doubt) for mode in found] == [
        (1, 1, 0),
        (Fraction(-1, 2), 2, 0),
    ]
    path = _given(*((i, j, 1.0) for i in range(4) for j in range(4) if abs(i - j) == 1))
    found = graph_modes(path, 4, mean=False)
    assert found is not None
    golden = (1 + 5**0.5) / 2
    for mode, value in zip(found, (golden, 1 / golden, -1 / golden, -golden), strict=True):
        assert 0 < mode.doubt < 1e-12
        assert abs(mode.value - value) <= mode.doubt
