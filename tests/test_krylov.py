"""Claims about `sparse_system` and `krylov`: sparse graphs."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_groups
from apc.eigen.modes import dense
from apc.large.krylov import argument_of, count_beyond, solve_sparse
from apc.large.sparse_system import rigid_space, small_matrix, sparse_system, without_rigid
from apc.large.translation import free_motions
from tests.populations import crowded, different
from tests.sites import MS, columned, grouped, linked, paper
from tests.topologies import MESH, compiled, replaced

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
    listed, exchange = crowded(different(6, graph=graph))
    whole = sparse_system(listed, exchange)
    motions = free_motions(listed, exchange)
    rigid = motions and rigid_space(whole, exchange, motions)
    assert rigid and len(rigid.held) == 1
    relative, _ = without_rigid(whole, rigid)
    assert np.abs(relative @ rigid.motions).max() < 1e-12
    one, other = (np.linalg.eigvals(part.toarray()) for part in (relative, whole.matrix))
    large = other[(np.abs(other) > 0.3) & (np.abs(other - 1) > 1e-9)]
    assert all(np.abs(one - value).min() < 1e-11 for value in large)
    assert np.abs(one - 1).min() > 1e-6


@pytest.mark.few(4)
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
    [population] = listed
    alone = np.linalg.eigvals(population.lifted.p).astype(complex).ravel()
    argument = argument_of(sparse_system(listed, exchange), listed)
    found = count_beyond(argument, (alone, np.ones(len(alone))), np.array([1.0 + 0j]), radius)
    assert found == int((np.abs(values) > radius).sum())


def test_the_notes_say_what_is_an_estimate() -> None:
    listed, exchange = crowded(different(20, graph="ring"))
    found = solve_sparse(listed, exchange)
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


@pytest.mark.parametrize("values", CLOCKS)
def test_the_small_determinant_is_that_of_the_whole_over_those_of_the_peers(values: dict[str, Any]) -> None:
    listed, exchange = crowded(different(5, graph=PATH[:4] + PATH[5:9], **values))
    system = sparse_system(listed, exchange)
    small, whole = small_matrix(system, listed), system.matrix.toarray()
    for point in (1.1 + 0.2j, 0.9j, -1.05 + 0j):
        peers = np.prod([np.linalg.det(np.eye(p.shape[-1]) - p / point) for p in listed[0].lifted.p])
        expected = np.linalg.det(np.eye(len(whole)) - whole / point) / peers
        assert np.linalg.det(small(point).toarray()) == pytest.approx(expected, rel=1e-9)


def test_peers_free_to_move_one_by_one_are_so_in_the_whole() -> None:
    system = different(12, graph="ring", kt=0.0, bt=0.0)
    found, whole = analyze(system, method="krylov"), analyze(system, method="dense")
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.rigid_modes == 12
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-11)


@pytest.mark.parametrize("loose", ["contact__stiffness", "none"])
def test_a_device_that_hangs_loose_translates_by_itself(loose: str) -> None:
    """Devices nobody holds, and copies that only move together, on a path of two parts."""
    arcs = [arc for arc in PATH if {arc[0], arc[1]} != {2, 3}]
    system = different(6, graph=arcs, kc=0.0, bc=0.0) if loose != "none" else different(6, graph=arcs)
    found, whole = analyze(system, method="krylov"), analyze(system, method="dense")
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.rigid_modes == (8 if loose != "none" else 2)
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-10)


def test_what_drifts_leaves_the_radius_open() -> None:
    frictionless = {"device.damping": 0.0, "cube.damping": 0.0}
    base = paper(peers=4, comp=Fraction(0), kt=0.0, bt=2.0, kc=500.0, bc=2.0)
    found = analyze(linked(grouped(base, ("user", 4, frictionless)), "ring"), method="krylov")
    assert found.stable is None
    assert found.spectral_radius_error >= found.spectral_radius
    assert any("drifts" in note for note in found.notes)


def test_a_peer_that_differs_in_what_it_is_free_to_do_leaves_the_verdict_open() -> None:
    system = columned(linked(paper(peers=5), "ring"), contact__stiffness=[0.0, *[1000.0] * 4])
    found = analyze(system, method="krylov")
    assert found.stable is None
    assert found.spectral_radius_error >= found.spectral_radius


@pytest.mark.parametrize("graph", ["star", "{edges: [[1, 2], [2, 3], [3, 4], [4, 5], [5, 6]]}"])
def test_a_mesh_whose_peers_hear_different_sums_translates_as_one(graph: str) -> None:
    """The centre of a star hears five, the others one: moved together, none of them feels a force."""
    masses = ", ".join(f"{0.1 + 0.013 * k:.3f} kg" for k in range(6))
    text = replaced(
        MESH,
        ("user: {count: 3}", f"user: {{count: 6, set: {{device.mass: [{masses}]}}}}"),
        ("delay: 8 ms}", f"delay: 8 ms, graph: {graph}}}"),
        ("stiffness: 500 N/m", "stiffness: 60 N/m"),
    )
    system = compiled(text)
    found, whole = analyze(system, method="krylov"), analyze(system, method="dense")
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.verdict == "stable up to a common translation"
    assert abs(found.spectral_radius - whole.spectral_radius) <= found.spectral_radius_error < 1e-6
