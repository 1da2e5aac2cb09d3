"""Claims about `apc.eigen.closing`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.eigen.closing import Packet, close_loop, lay_out_loop
from apc.eigen.modes import complete_loops, dense_loop
from tests.sites import MS, paper


def test_the_state_is_each_sites_own_then_its_packets_by_row_and_age() -> None:
    [common, _] = complete_loops(*lifted_groups(paper(comm=24 * MS)))
    assert common.names[6:] == (
        "coordination.v sent(-8 ms)",
        "coordination.v sent(-16 ms)",
        "coordination.v sent(-24 ms)",
        "coordination.x sent(-8 ms)",
        "coordination.x sent(-16 ms)",
        "coordination.x sent(-24 ms)",
    )
    assert common.packets[:4] == (Packet(0, 0, 1), Packet(0, 0, 2), Packet(0, 0, 3), Packet(0, 1, 1))
    assert common.states == len(common.names) == 12


def test_several_sites_stand_one_after_the_other_under_their_names() -> None:
    loop = dense_loop(*lifted_groups(paper()))
    layout = lay_out_loop(loop)
    assert layout.offsets == (0, 8, 16)
    assert layout.names[8] == "user[2].device.x"
    assert layout.packets == loop.packets
    assert sorted(layout.places.values()) == [6, 7, 14, 15, 22, 23]


def test_a_common_state_of_equal_peers_moves_as_each_of_them_does() -> None:
    groups, exchange = lifted_groups(paper(peers=3, kt=300.0))
    common = close_loop(complete_loops(groups, exchange)[0])
    whole = close_loop(dense_loop(groups, exchange))
    state = np.random.default_rng(1).standard_normal(len(common.names))
    np.testing.assert_allclose(
        whole.matrix @ np.tile(state, 3), np.tile(common.matrix @ state, 3), rtol=1e-12
    )
    # And so does what they hear.
    for heard in whole.heard:
        np.testing.assert_allclose(heard @ np.tile(state, 3), common.heard[0] @ state, rtol=1e-11, atol=1e-13)


def test_a_packet_on_its_way_grows_older_frame_by_frame() -> None:
    common = close_loop(complete_loops(*lifted_groups(paper(comm=24 * MS)))[0])
    place = common.names.index
    older = common.matrix[place("coordination.x sent(-16 ms)")]
    assert older[place("coordination.x sent(-8 ms)")] == 1 and np.count_nonzero(older) == 1
    newest = common.matrix[place("coordination.x sent(-8 ms)")]
    assert newest[place("cube.x")] == 1 and np.count_nonzero(newest) == 1


def test_what_is_heard_in_the_frame_it_is_sent_in_is_ordered_by_time() -> None:
    """A packet heard before it is sent would be a loop without delay: that is a contradiction of ours."""
    loop = complete_loops(*lifted_groups(paper(comm=Fraction(0))))[0]
    assert loop.packets == ()
    [group] = loop.sites
    lifted = replace(group.lifted, d=np.ones_like(group.lifted.d))
    with pytest.raises(AssertionError, match="heard before it is sent"):
        close_loop(replace(loop, sites=(group.with_lifted(lifted),)))


def test_what_a_weight_may_be_off_by_is_in_the_bound() -> None:
    loop = complete_loops(*lifted_groups(paper()))[0]
    [(way, ((weight,),))] = loop.coupling.items()
    sure, doubtful = close_loop(loop), close_loop(replace(loop, doubts={way: 1e-6}))
    moved = close_loop(replace(loop, coupling={way: ((weight + Fraction(1, 10**6),),)}))
    assert np.all(np.abs(moved.matrix - sure.matrix) <= doubtful.error)
    assert np.any(np.abs(moved.matrix - sure.matrix) > sure.error)
