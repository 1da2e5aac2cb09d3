"""Claims about `apc.eigen.peers`."""

from __future__ import annotations

import pytest

from apc.analysis.analysis import lifted_groups, prepare
from apc.compiler.errors import ApcError
from apc.eigen.peers import group_of_row, more_differ
from apc.frame.parameters import resolve
from tests.sites import columned, edged, grouped, linked, paper


def test_peers_that_differ_in_nothing_that_moves_are_one_group_across_the_scenes() -> None:
    system = grouped(paper(), ("left", 2, {"device.x.start": 0.1}), ("right", 1, {"hand.force": 2.0}))
    [group], _ = lifted_groups(system)
    assert (group.name, group.count, list(group.peers)) == ("left+right", 3, [0, 1, 2])


def test_peers_are_grouped_by_their_numbers_and_named_by_them() -> None:
    system = columned(paper(peers=8), device__mass=[0.1, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1, 0.3])
    groups, _ = lifted_groups(system)
    assert [(one.name, one.count, list(one.peers)) for one in groups] == [
        ("user[1,3,4,5,…]", 6, [0, 2, 3, 4, 5, 6]),
        ("user[2]", 1, [1]),
        ("user[8]", 1, [7]),
    ]


def test_minus_zero_and_zero_are_one_number() -> None:
    groups, _ = lifted_groups(columned(paper(), contact__damping=[0.0, -0.0, 1.0]))
    assert [one.count for one in groups] == [2, 1]


def test_where_peers_start_counts_only_where_slopes_are_taken_there() -> None:
    starts = [0.0, 0.0, 0.01, 0.01]
    plain = columned(paper(peers=4), cube__x__start=starts)
    cubic = columned(edged(paper("sum", peers=4), "sum", cubic=1e5), cube__x__start=starts)
    assert [one.count for one in lifted_groups(plain)[0]] == [4]
    assert [one.count for one in lifted_groups(cubic)[0]] == [2, 2]


def test_peers_apart_in_a_graph_are_one_group_if_they_hear_alike() -> None:
    ring = linked(edged(paper("mean", peers=5), "mean", cubic=1e5), "ring")
    assert [one.count for one in lifted_groups(ring)[0]] == [5]
    path = linked(
        edged(paper("mean", peers=3), "mean", cubic=1e5), [(0, 1, 1.0), (1, 0, 1.0), (1, 2, 1.0), (2, 1, 1.0)]
    )
    assert sum(one.count for one in lifted_groups(path)[0]) == 3


def test_it_is_enough_to_look_until_too_many_differ() -> None:
    system = columned(paper(peers=6), device__mass=[0.1, 0.2, 0.3, 0.1, 0.2, 0.3])
    prepared = prepare(system)
    _, exchange = lifted_groups(system)
    answers = [more_differ(system, prepared.jacobians, resolve(system), exchange, count) for count in (2, 3)]
    assert answers == [True, False]


def test_one_peer_stands_for_as_many_as_are_said() -> None:
    system = columned(paper(peers=3), device__mass=[0.1, 0.2, 0.3])
    groups, exchange = lifted_groups(system)
    other = groups[1]
    found = group_of_row(other.jacobians, other.parameters, other.schedule, exchange, 0, 3)
    assert (found.count, found.name) == (3, "user")
    assert (found.lifted.p == other.lifted.p).all()


def test_a_maximum_over_equal_peers_has_no_linearization_and_one_over_different_ones_has() -> None:
    with pytest.raises(ApcError, match=r"E803 pull of user\[1\]: max over equal peers has no linearization"):
        lifted_groups(edged(paper(peers=3), "max"))
    system = columned(edged(paper(peers=3), "max"), cube__x__start=[0.0, 0.01, 0.03])
    assert [one.count for one in lifted_groups(system)[0]] == [1, 1, 1]


def test_too_many_peers_that_start_apart_are_refused() -> None:
    system = columned(edged(paper("sum", peers=401), "sum"), cube__x__start=[1e-4 * k for k in range(401)])
    with pytest.raises(ApcError, match="E804 more than 400 peers that differ"):
        lifted_groups(system)
