"""Claims about `apc.eigen.peer_group`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.compiler.errors import ApcError
from apc.eigen.peer_group import MOST_STATES, Runs, check_size, joined, shifted, states_of, used_ways
from tests.sites import edged, paper


def test_a_billion_peers_are_two_numbers() -> None:
    peers = Runs((range(10**9),))
    assert len(peers) == 10**9
    assert peers[:3] == [0, 1, 2]
    assert shifted(peers, 5)[0] == 5


def test_runs_together_are_in_order_and_counted_through() -> None:
    peers = joined([Runs((range(7, 9),)), Runs((range(2),))])
    assert list(peers) == [0, 1, 7, 8]
    assert (peers[2], peers[1:3], len(peers)) == (7, [1, 7], 4)


def test_runs_and_listed_peers_together_are_listed() -> None:
    peers = joined([Runs((range(3, 5),)), np.array([9, 0])])
    assert isinstance(peers, np.ndarray)
    assert peers.tolist() == [0, 3, 4, 9]
    assert shifted(peers, 2).tolist() == [2, 5, 6, 11]


def test_a_peers_states_are_its_motion_what_is_remembered_and_what_is_on_its_way() -> None:
    [group], _ = lifted_groups(paper())
    # Four of motion, two delayed forces, two numbers on their way over the network.
    assert states_of(group.schedule, group.jacobians) == 4 + 2 + 2


def test_a_groups_exact_matrices_are_those_of_its_numbers_without_rounding() -> None:
    [group], _ = lifted_groups(paper(kt=0.1))
    exact = group.exact
    assert exact.ticks[0].r[1, 0] == -Fraction(0.1)
    np.testing.assert_array_equal(exact.a.astype(float), group.site.a)


def test_ways_are_those_on_which_something_is_heard() -> None:
    [plain], _ = lifted_groups(paper())
    [one] = used_ways([plain.schedule])
    assert (one.operator, one.link, one.edge) == ("mean", "lan", "")
    assert plain.gain(one, plain) == 1
    [looking], _ = lifted_groups(edged(paper("sum", kt=100.0, bt=3.0)))
    gains = {way.channel: looking.gain(way, looking) for way in used_ways([looking.schedule])}
    assert gains == {"coordination.x": -100, "coordination.v": -3}


def test_too_many_states_are_refused_with_what_to_do() -> None:
    [group], exchange = lifted_groups(paper())
    check_size([group.jacobians] * (MOST_STATES // 4), exchange)
    with pytest.raises(
        ApcError, match=r"E804 251 different peers make one system of 1,004 states.*--method auto"
    ):
        check_size([group.jacobians] * (MOST_STATES // 4 + 1), exchange)
