"""Claims about `sparse_system` and `krylov`: different peers on sparse graphs."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.runtime.analysis.analysis import analyze, lifted_groups
from apc.runtime.eigen.modes import dense
from apc.runtime.large.krylov import count_beyond, solve_sparse
from apc.runtime.large.sparse_system import relative_matrix, sparse_system
from apc.runtime.large.translation import common_translation
from tests.populations import crowded, different
from tests.sites import MS, columned, grouped, linked, paper

CLOCKS: list[dict[str, Any]] = [
    {},
    {"comm": 4 * MS, "comp": MS * 5 / 2},
    {"comm": Fraction(0)},
    {"haptic": 3 * MS, "network": 2 * MS, "comm": Fraction(0), "comp": Fraction(0)},
    {"comm": 20 * MS},
]
PATH = [(i, i + 1, 0.5 + i) for i in range(5)] + [(i + 1, i, 1.0) for i in range(5)]


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["ring", "star", PATH, "complete"])
@pytest.mark.parametrize("values", CLOCKS)
def test_the_sparse_matrix_is_the_dense_one(operator: str, graph: Any, values: dict[str, Any]) -> None:
    system = different(6, operator, graph, **values)
    found, whole = sparse_system(*crowded(system)), dense(*lifted_groups(system))
    assert np.all(np.abs(found.matrix.toarray() - whole.matrix) <= found.error.toarray() + whole.error)
    assert found.error.max() < 1e-9


def test_groups_with_delays_of_their_own_are_the_dense_matrix_too() -> None:
    base = grouped(paper(kt=200.0), ("left", 2, {"device.mass": 0.3}), ("right", 3, {"cube.mass": 0.1}))
    system = linked(base, "ring", delays={("left", "right"): 12 * MS, ("right", "right"): 3 * MS})
    found, whole = sparse_system(*crowded(system)), dense(*lifted_groups(system))
    assert np.all(np.abs(found.matrix.toarray() - whole.matrix) <= found.error.toarray() + whole.error)


@pytest.mark.parametrize("graph", ["ring", PATH])
def test_taking_the_rigid_motion_out_leaves_all_other_eigenvalues(graph: Any) -> None:
    system = different(6, graph=graph)
    whole = sparse_system(*crowded(system))
    [motions] = common_translation(*crowded(system)) or [np.zeros((0, 0))]
    relative = relative_matrix(whole, np.tile(motions, (6, 1)))
    assert len(relative.places) == relative.matrix.shape[0] == whole.matrix.shape[0] - 1
    one, other = (np.linalg.eigvals(part.toarray()) for part in (relative.matrix, whole.matrix))
    large = other[(np.abs(other) > 0.3) & (np.abs(other - 1) > 1e-9)]
    assert all(np.abs(one - value).min() < 1e-11 for value in large)
    assert np.abs(one - 1).min() > 1e-6


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["ring", "star"])
@pytest.mark.parametrize("values", [{}, {"kc": 2500.0}, {"kt": 3000.0}])
def test_the_largest_modes_are_those_of_the_whole_matrix(
    operator: str, graph: str, values: dict[str, Any]
) -> None:
    system = different(16, operator, graph, **values)
    found, whole = analyze(system, method="krylov"), analyze(system, method="dense")
    assert found.method == "krylov"
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-11)
    assert abs(found.spectral_radius - whole.spectral_radius) <= found.spectral_radius_error < 1e-6
    for mode in found.modes:
        same = min(whole.modes, key=lambda one: abs(one.eigenvalue - mode.eigenvalue))
        assert abs(same.eigenvalue - mode.eigenvalue) <= mode.error + same.error
        assert mode.frequency_hz == pytest.approx(same.frequency_hz, abs=1e-8)


def test_the_shares_are_those_of_the_whole_matrix() -> None:
    system = different(12, graph="ring")
    mode = analyze(system, method="krylov").modes[0]
    whole = analyze(system, method="dense").modes[0]
    shares: dict[str, float] = {}
    for name, share in whole.participation:
        name = name.split("].")[-1]
        name = name.split("(")[0] if "sent(" in name else name
        shares[name] = shares.get(name, 0.0) + share
    assert dict(mode.participation) == pytest.approx(shares, abs=1e-9)


@pytest.mark.parametrize("radius", [0.85, 0.93, 0.97, 1.02])
def test_a_count_on_samples_is_the_number_of_larger_eigenvalues(radius: float) -> None:
    system = different(20, graph="ring", kt=1500.0)
    listed, exchange = crowded(system)
    values = np.linalg.eigvals(dense(*lifted_groups(system)).matrix)
    [crowd] = listed
    alone = np.linalg.eigvals(crowd.lifted.p).astype(complex).ravel()
    matrix = sparse_system(listed, exchange).matrix
    found = count_beyond(matrix, (alone, np.ones(len(alone))), np.array([1.0 + 0j]), radius)
    assert found == int((np.abs(values) > radius).sum())


def test_the_notes_say_what_is_an_estimate() -> None:
    listed, exchange = crowded(different(20, graph="ring"))
    found = solve_sparse(listed, exchange, common_translation(listed, exchange))
    assert found.notes == (
        "the largest modes only, by Arnoldi's method; their errors are estimates, not bounds",
        "that no eigenvalue is larger was counted by the argument principle on samples",
    )


def test_two_rings_that_do_not_hear_each_other_translate_apart() -> None:
    ring = [(i, (i + 1) % 5) for i in range(5)]
    arcs = [(i + k, j + k, 1.0) for k in (0, 5) for a, b in ring for i, j in ((a, b), (b, a))]
    system = columned(linked(paper(peers=10), arcs), device__mass=np.linspace(0.1, 0.2, 10))
    found, whole = analyze(system, method="krylov"), analyze(system, method="dense")
    assert found.rigid_modes == whole.rigid_modes == 2
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-11)


def test_peers_free_to_move_one_by_one_leave_the_verdict_open() -> None:
    found = analyze(different(12, graph="ring", kt=0.0, bt=0.0), method="krylov")
    assert found.stable is None
    assert any("left open" in note for note in found.notes)
