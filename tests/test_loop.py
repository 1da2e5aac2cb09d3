"""Claims about `apc.eigen.loop`."""

from __future__ import annotations

from apc.analysis.analysis import lifted_groups
from apc.eigen.closing import Packet, lay_out_loop
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
