"""Many users as few small systems, by groups, graphs, columns: against all of them stepped by hand."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import close_loop
from apc.eigen.modes import dense, dense_loop, split, split_exchangeable
from tests.bruteforce import Scene, frame_matrix
from tests.pairing import apart, arcs_of
from tests.sites import MS, columned, grouped, linked, paper

PAIRS = {("left", "right"): 12 * MS, ("right", "left"): 3 * MS, ("right", "right"): 8 * MS}


def _split(system: CompiledSystem) -> np.ndarray:
    """Return all eigenvalues of the split system, each as often as it counts."""
    systems = split(*lifted_groups(system)).systems
    return np.concatenate([np.repeat(np.linalg.eigvals(one.matrix), one.multiplicity) for one in systems])


def _check(system: CompiledSystem, scene: Scene, bound: float = 1e-11) -> None:
    """Assert that the split system and the whole have the spectrum of the peers stepped one by one."""
    expected = np.linalg.eigvals(np.array(frame_matrix(scene)))
    assert apart(_split(system), expected) < bound
    assert apart(np.linalg.eigvals(dense(*lifted_groups(system)).matrix), expected) < bound


@pytest.mark.parametrize("peers", [2, 3, 8, 12])
def test_common_and_difference_modes_are_the_whole_spectrum(peers: int) -> None:
    operator = "mean" if peers % 2 else "sum"
    gains = GAINS if operator == "mean" else {**GAINS, "kt": 800.0 / peers, "bt": 2.0 / peers}
    _check(paper(operator, peers=peers, **gains), Scene(operator, peers, **gains))


GAINS = {"kt": 800.0, "bt": 2.0, "kc": 1500.0, "bc": 2.0}


def test_groups_that_differ_in_nothing_that_moves_are_one() -> None:
    system = grouped(paper(), ("left", 2, {"device.x": 0.1}), ("right", 1, {"cube.x": 2.0}))
    [group], exchange = lifted_groups(system)
    assert (group.name, group.count) == ("left+right", 3)
    assert [one.name for one in split([group], exchange).systems] == ["common", "difference"]


@pytest.mark.parametrize(
    ("name", "operator", "method"),
    [
        ("ring", "sum", "modes"),
        ("star", "mean", "modes"),
        ("path", "mean", "modes"),
        ("two pairs", "mean", "modes"),
        ("cycle", "sum", "modes"),
        ("apart", "mean", "modes"),
        ("one way", "sum", "dense"),  # nilpotent: no full set of eigenvectors
    ],
)
def test_equal_peers_on_any_graph_have_the_spectrum_of_all_of_them(
    name: str, operator: str, method: str
) -> None:
    arcs = arcs_of(name, 4)
    system = linked(paper(operator, peers=4, **GAINS), arcs)
    assert split(*lifted_groups(system)).method == method
    # A defective eigenvalue scatters by the root of its rounding, four peers deep.
    scene = Scene(operator, 4, weights={(i, j): weight for i, j, weight in arcs}, **GAINS)
    _check(system, scene, 1e-10 if method == "modes" else 2e-3)


@pytest.mark.parametrize(
    ("masses", "modes"),
    [
        ([0.1, 0.2, 0.15, 0.3], [("dense", 1)]),
        ([0.1, 0.2, 0.1, 0.3], [("common", 1), ("difference user[1,3]", 1)]),  # who hear the same two
    ],
)
def test_different_peers_on_a_ring_move_alike_or_apart_where_they_can_change_places(
    masses: list[float], modes: list[tuple[str, int]]
) -> None:
    system = columned(linked(paper(peers=4, **GAINS), "ring"), device__mass=masses)
    weights = {(i, j): weight for i, j, weight in arcs_of("ring", 4)}
    _check(system, Scene(peers=4, weights=weights, users=tuple({"device": m} for m in masses), **GAINS))
    found = split(*lifted_groups(system))
    assert [(one.name, one.multiplicity) for one in found.systems] == modes


def test_peers_that_differ_one_by_one_are_grouped_by_what_they_share() -> None:
    masses = [0.1, 0.2, 0.1, 0.1, 0.2]
    system = columned(
        paper(peers=5, **GAINS),
        device__mass=masses,
        contact__damping=[2.0] * 5,
        hand__force=[1.0, 2, 3, 4, 5],
    )
    groups, exchange = lifted_groups(system)
    assert [(one.name, one.count, one.peers.tolist()) for one in groups] == [
        ("user[1,3,4]", 3, [0, 2, 3]),
        ("user[2,5]", 2, [1, 4]),
    ]
    assert [one.multiplicity for one in split(groups, exchange).systems] == [1, 2, 1]
    _check(system, Scene(peers=5, users=tuple({"device": mass} for mass in masses), **GAINS))


@pytest.mark.few(4)
@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["complete", "ring"])
@pytest.mark.parametrize(
    "delays",
    [PAIRS, {("left", "left"): Fraction(0), ("left", "right"): 4 * MS}, {("left", "right"): 8 * MS}],
)
def test_pairs_of_groups_may_have_delays_of_their_own(
    operator: str, graph: str, delays: dict[tuple[str, str], Fraction]
) -> None:
    gains = {**GAINS, "kt": 200.0}
    base = grouped(paper(operator, **gains), ("left", 2, {}), ("right", 2, {}))
    system = linked(base, graph, delays=delays)
    names = ["left", "left", "right", "right"]
    late = {(i, j): delays.get((names[i], names[j]), 8 * MS) for i in range(4) for j in range(4)}
    weights = {(i, j): w for i, j, w in arcs_of("ring", 4)} if graph == "ring" else None
    # A delay equal to the usual one is none of its own.
    assert len(lifted_groups(system)[0]) == (1 if set(delays.values()) == {8 * MS} else 2)
    _check(system, Scene(operator, 4, weights=weights, late=late, **gains))


# A path of four with a fork at either end: 0 and 1 are twins, and 4 and 5.
FORKED = [(0, 2), (1, 2), (2, 3), (3, 4), (3, 5)]


ARCS = [(a, b, 1.0) for pair in FORKED for a, b in (pair, pair[::-1])]


def test_minus_zero_and_zero_are_one_number() -> None:
    groups, _ = lifted_groups(columned(paper(), contact__damping=[0.0, -0.0, 1.0]))
    assert [one.count for one in groups] == [2, 1]


@pytest.mark.parametrize(
    ("graph", "sizes"), [("star", [2, 1]), (ARCS, [4, 1, 1]), ("ring", [6]), ("complete", [2, 1])]
)
def test_peers_that_can_change_places_on_a_graph_are_few_loops(graph: Any, sizes: list[int]) -> None:
    own = ("first", 1, {"device.mass": 0.25 if graph in ("star", "complete") else 0.1})
    system = linked(grouped(paper(kt=300.0, bt=1.0, kc=800.0), own, ("others", 5, {})), graph)
    groups, exchange = lifted_groups(system)
    whole = dense_loop(groups, exchange)
    loops = split_exchangeable(whole, exchange)
    assert [len(loop.sites) for loop in loops] == sizes
    values = [np.linalg.eigvals(close_loop(loop).matrix) for loop in loops for _ in range(loop.multiplicity)]
    assert apart(np.concatenate(values), np.linalg.eigvals(close_loop(whole).matrix)) < 1e-9


@pytest.mark.parametrize("peers", [2, 5, 20])
def test_full_mesh_is_the_average_with_gains_times_the_others(peers: int) -> None:
    others = peers - 1
    mesh = analyze(paper("sum", peers=peers, kt=900.0 / others, bt=3.0 / others, comm=11 * MS))
    mean = analyze(paper("mean", peers=peers, kt=900.0, bt=3.0, comm=11 * MS))
    assert mesh.spectral_radius == pytest.approx(mean.spectral_radius, abs=1e-12)
    assert len(mesh.modes) == len(mean.modes)
