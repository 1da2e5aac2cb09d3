"""Claims about `rings`: few of many systems decide, and the others are shown not to."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_groups
from apc.analysis.plan import is_large_ring
from apc.eigen.closing import close_loop
from apc.eigen.graph_loops import graph_loop, graph_scale
from apc.eigen.graph_modes import ring_mode, ring_values
from apc.eigen.peer_group import used_ways
from apc.large.rings import deciding_loops, find_extremes
from tests.sites import MS, grouped, linked, paper

VARIED: list[dict[str, Any]] = [
    {},
    {"kt": 900.0},
    {"kc": 2400.0},
    {"comm": 16 * MS},
    {"kt": 3000.0, "bt": 3.0, "bc": 2.0},
    {"kc": 1500.0, "kt": 5000.0},
    {"comp": Fraction(0), "comm": Fraction(0), "kt": 2000.0},
    {"bt": 2.0, "bc": 2.0, "kt": 1500.0},
]


@pytest.mark.parametrize("values", VARIED)
def test_no_system_left_out_is_above_the_bound(values: dict[str, Any]) -> None:
    """Every system of a ring of 301, one by one."""
    peers = 301
    groups, exchange = lifted_groups(linked(paper(peers=peers, **values), "ring"))
    [group] = groups
    scale = graph_scale(group, used_ways([group.schedule]), exchange)
    weights = np.array([float(scale.weights[one.way]) for one in group.schedule.heard])
    closed = [close_loop(graph_loop(group, ring_mode(k, peers, mean=False), scale)) for k in range(1, 151)]
    radii = np.array([np.abs(np.linalg.eigvals(one.matrix)).max() for one in closed])
    assert not scale.by_mean
    n = len(closed[0].matrix)
    found = find_extremes(group, weights, ring_values(peers, mean=False)[1:], np.zeros((n, 0)))
    assert found.proved
    assert int(np.argmax(radii)) in found.places.tolist()
    left_out = np.setdiff1d(np.arange(len(radii)), found.places)
    assert radii[left_out].max() <= found.below < radii.max()
    assert len(found.places) <= 4


@pytest.mark.parametrize("values", [{}, {"kt": 900.0}, {"kt": 0.0}])
def test_a_large_ring_has_the_radius_of_all_its_systems(values: dict[str, Any]) -> None:
    from apc.eigen.modes import split
    from apc.eigen.spectrum import solve_spectrum

    system = linked(paper(peers=300, **values), "ring")
    groups, exchange = lifted_groups(system)
    assert is_large_ring(groups, exchange)
    found, whole = analyze(system), solve_spectrum(split(groups, exchange).systems)
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-13)
    assert found.spectral_radius_error < 1e-8


def test_a_ring_of_a_hundred_thousand_peers_solves_a_handful_of_systems() -> None:
    system = linked(paper(peers=100_000), "ring")
    found = analyze(system)
    assert (found.verdict, found.rigid_modes) == ("stable up to a common translation", 1)
    # The slowest difference of neighbours: the eigenvalue of the second system, 2π/N apart from the first.
    mu = 1 - np.cos(2 * np.pi / 100_000)
    slow = 1 - analyze(linked(paper(peers=1000), "ring")).spectral_radius
    assert 1 - found.spectral_radius == pytest.approx(slow * mu / (1 - np.cos(2 * np.pi / 1000)), rel=1e-3)
    assert found.spectral_radius_error < 1e-12
    assert found.notes == (
        "50,001 systems, one an eigenvalue of the graph of lan (ring): 2 of them are solved, "
        "all others are shown to die out faster",
    )


def test_a_site_that_passes_on_what_it_hears_in_a_frame_is_estimated_and_says_so() -> None:
    clocks = {"haptic": 3 * MS, "network": 2 * MS, "comp": Fraction(0), "comm": Fraction(0)}
    found = analyze(linked(paper(peers=300, **clocks), "ring"))
    few = analyze(linked(paper(peers=200, **clocks), "ring"))
    assert "all others are estimated to die out faster" in found.notes[0]
    assert found.spectral_radius > few.spectral_radius


def test_other_graphs_and_different_peers_are_no_large_ring() -> None:
    for system in (
        linked(paper(peers=300), "star"),
        linked(paper(peers=40), "ring"),
        grouped(linked(paper(), "ring"), ("left", 200, {}), ("right", 200, {"device.mass": 0.3})),
        paper(peers=300),
    ):
        assert not is_large_ring(*lifted_groups(system))


def test_the_loops_that_decide_are_named_by_their_eigenvalues() -> None:
    ring = deciding_loops(*lifted_groups(linked(paper(peers=1000, kt=900.0), "ring")))
    assert [loop.name for loop in ring.arrangement.loops] == ["common", "graph -2"]
    assert ring.rigid == 0
