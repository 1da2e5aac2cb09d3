"""Claims about `apc.large.translation`: what nothing holds back, each peer with its own numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.eigen.modes import dense
from apc.eigen.rigid import find_rigid_modes
from apc.large.translation import count_translations, free_motions
from tests.populations import crowded, different
from tests.sites import MS, columned, grouped, linked, paper


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize(
    ("values", "expected"), [({}, 1), ({"kt": 0.0}, 6), ({"kc": 0.0}, 7), ({"kc": 0.0, "kt": 0.0}, 12)]
)
def test_motions_are_counted_as_for_the_whole_matrix(
    operator: str, values: dict[str, float], expected: int
) -> None:
    system = different(6, operator, **values)
    whole = find_rigid_modes(dense(*lifted_groups(system)))
    assert count_translations(*crowded(system)) == expected == whole.directions.shape[1]


def test_a_motion_that_one_peer_does_not_share_is_not_told() -> None:
    contacts = [1000.0] * 5
    free = columned(paper(peers=5), contact__stiffness=[0.0, *contacts[1:]])
    assert count_translations(*crowded(free)) is None


def test_groups_of_different_peers_translate_together() -> None:
    system = grouped(paper(), ("left", 4, {"device.mass": 0.3}), ("right", 3, {"contact.stiffness": 700.0}))
    assert count_translations(*crowded(system)) == 1


@pytest.mark.parametrize("graph", ["ring", "star", [(0, 1, 0.5), (1, 0, 2.0), (1, 2, 1.0), (2, 1, 1.0)]])
def test_on_any_graph_the_common_motion_is_a_fixed_point_of_the_whole(graph: Any) -> None:
    system = columned(linked(paper(peers=3), graph), device__mass=[0.1, 0.2, 0.3])
    motions = free_motions(*crowded(system))
    assert motions is not None and not motions.own[0].size
    [(pivot, vectors)] = motions.together([0])
    assert vectors[0].shape == (8,) and vectors[0][pivot[1]] == 1
    whole = dense(*lifted_groups(system))
    moved = np.tile(vectors[0], 3)
    np.testing.assert_allclose(whole.matrix @ moved, moved, atol=1e-12)


def test_peers_free_to_move_one_by_one_do_so_whoever_hears_them() -> None:
    motions = free_motions(*crowded(different(4, graph="ring", kt=0.0)))
    assert motions is not None and motions.common == ()
    assert motions.own[0].shape == (8, 1) and len(motions.pivots[0]) == 1


def test_peers_whose_packets_take_different_times_translate_together() -> None:
    """Nobody hears all of the others on one way: the mean is over what comes on all of them."""
    base = grouped(paper(), ("near", 2, {"device.mass": 0.3}), ("far", 1, {}))
    system = linked(base, delays={("near", "far"): 40 * MS, ("far", "near"): 40 * MS})
    motions = free_motions(*crowded(system))
    assert motions is not None and len(motions.common) == 1
    [(_, vectors)] = motions.together([0, 1])
    whole = dense(*lifted_groups(system))
    moved = np.concatenate([vectors[0], vectors[0], vectors[1]])
    np.testing.assert_allclose(whole.matrix @ moved, moved, atol=1e-12)
