"""Claims about `apc.eigen.twins`: sites that can change places make few small loops of one large."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_groups
from apc.eigen.closing import close_loop
from apc.eigen.modes import dense_loop
from apc.eigen.twins import split_twins
from tests.sites import grouped, linked, paper

# A path of four with a fork at either end: 0 and 1 are twins, and 4 and 5.
FORKED = [(0, 2), (1, 2), (2, 3), (3, 4), (3, 5)]
ARCS = [(a, b, 1.0) for pair in FORKED for a, b in (pair, pair[::-1])]


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize(
    ("graph", "sizes"), [("star", [2, 1]), (ARCS, [4, 1, 1]), ("ring", [6]), ("complete", [2, 1])]
)
def test_the_loops_have_together_the_spectrum_of_the_whole(
    operator: str, graph: Any, sizes: list[int]
) -> None:
    first = ("first", 1, {"device.mass": 0.25}) if graph in ("star", "complete") else ("first", 1, {})
    base = grouped(paper(operator, kt=300.0, bt=1.0, kc=800.0), first, ("others", 5, {}))
    groups, exchange = lifted_groups(linked(base, graph))
    whole = dense_loop(groups, exchange)
    loops = split_twins(whole, exchange)
    assert [len(loop.sites) for loop in loops] == sizes
    together = [
        np.linalg.eigvals(close_loop(loop).matrix) for loop in loops for _ in range(loop.multiplicity)
    ]
    expected, found = np.linalg.eigvals(close_loop(whole).matrix), np.concatenate(together)
    assert len(found) == len(expected)
    for value in expected[np.abs(expected) > 0.1]:
        near = np.abs(found - value) < 1e-9
        assert near.sum() == (np.abs(expected - value) < 1e-9).sum()


def test_a_star_of_many_equal_peers_is_two_small_determinants() -> None:
    base = grouped(paper(kt=300.0, bt=1.0, kc=800.0), ("first", 1, {"device.mass": 0.25}), ("others", 19, {}))
    system = linked(base, "star")
    found, whole = analyze(system, method="determinant"), analyze(system, method="dense")
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    apart = abs(found.spectral_radius - whole.spectral_radius)
    assert apart <= found.spectral_radius_error + whole.spectral_radius_error
    assert found.spectral_radius_error < 1e-7
