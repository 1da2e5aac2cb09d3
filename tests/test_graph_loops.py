"""Claims about `apc.eigen.graph_loops`."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.compiler.errors import ApcError
from apc.eigen.closing import close_loop
from apc.eigen.graph_loops import common_graph, graph_loop, graph_scale
from apc.eigen.graph_modes import graph_modes
from apc.eigen.modes import complete_loops
from apc.eigen.peer_group import used_ways
from tests.sites import linked, paper


def test_the_common_mode_of_a_mean_on_any_graph_is_that_of_the_complete_one() -> None:
    ring, exchange = lifted_groups(linked(paper("mean", peers=5), "ring"))
    scale = graph_scale(ring[0], used_ways([ring[0].schedule]), exchange)
    common = next(
        one for one in graph_modes(exchange.links["lan"].graph, 5, mean=scale.by_mean) or () if one.common
    )
    found = close_loop(graph_loop(ring[0], common, scale))
    complete = close_loop(complete_loops(*lifted_groups(paper("mean", peers=5)))[0])
    np.testing.assert_array_equal(found.matrix, complete.matrix)


def test_a_mode_of_a_ring_hears_itself_by_the_cosine() -> None:
    [group], exchange = lifted_groups(linked(paper("sum", peers=7), "ring"))
    [way] = used_ways([group.schedule])
    scale = graph_scale(group, [way], exchange)
    loops = [
        graph_loop(group, one, scale) for one in graph_modes(exchange.links["lan"].graph, 7, mean=False) or ()
    ]
    assert [one.multiplicity for one in loops] == [1, 2, 2, 2]
    weights = sorted(float(one.coupling[way][0][0]) for one in loops)
    assert weights == pytest.approx(sorted(2 * math.cos(2 * math.pi * k / 7) for k in range(4)), rel=1e-15)
    assert all(one.surds or one.doubts[way] == 0 for one in loops)


def test_a_complex_pair_is_two_sites_that_turn() -> None:
    arcs = [(i, (i + 1) % 3, 1.0) for i in range(3)]
    [group], exchange = lifted_groups(linked(paper("sum"), arcs))
    [way] = used_ways([group.schedule])
    found = graph_modes(exchange.links["lan"].graph, 3, mean=False) or ()
    [pair] = [graph_loop(group, one, graph_scale(group, [way], exchange)) for one in found if one.imaginary]
    (a, b), (c, d) = ([float(one) for one in row] for row in pair.coupling[way])
    assert (a, c) == (d, -b)
    assert (a, abs(c)) == pytest.approx((-1 / 2, math.sqrt(3) / 2), rel=1e-14)
    assert [site.name for site in pair.sites] == ["real", "imaginary"]


def test_one_graph_for_all_ways_or_a_reason_why_not() -> None:
    [group], exchange = lifted_groups(linked(paper("sum", peers=4), "star"))
    [way] = used_ways([group.schedule])
    assert common_graph([way], exchange) == ""
    mean = replace(way, operator="mean")
    assert common_graph([way, mean], exchange) == "means and sums over lan, whose peers hear unequal weights"
    largest = replace(way, operator="max")
    assert common_graph([largest], exchange) == "who is the largest or smallest decides who is heard"


def test_a_mean_over_weights_that_add_up_to_nothing_is_refused() -> None:
    arcs = [(0, 1, 1.0), (2, 1, -1.0), (1, 0, 1.0), (1, 2, 1.0)]
    with pytest.raises(ApcError, match="E802"):
        groups, exchange = lifted_groups(linked(paper("mean"), arcs))
        graph_scale(groups[0], used_ways([groups[0].schedule]), exchange)


def test_equal_weights_of_a_mean_are_divided_exactly() -> None:
    [group], exchange = lifted_groups(linked(paper("mean", peers=5), "ring"))
    [way] = used_ways([group.schedule])
    scale = graph_scale(group, [way], exchange)
    assert (scale.weights[way], scale.by_mean) == (Fraction(1, 2), False)
