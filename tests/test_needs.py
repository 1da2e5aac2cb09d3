"""`needs`: a scene keeps what it asks for and nothing else."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.analysis.analysis import analyze
from apc.analysis.needs import needs
from tests.sites import columned, edged, linked, paper
from tests.topologies import AVERAGE, MESH, ONE_MASS, compiled, replaced

CONTACT, COORDINATION, LINK = "haptic, delay: 1 ms}", "haptic, delay: 1 ms, link", "network, delay: 8 ms}"


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ((), (4, 2, 2)),
        (((CONTACT, "haptic}"),), (4, 1, 2)),
        (((COORDINATION, "haptic, link"),), (4, 1, 2)),
        (((LINK, "network}"),), (4, 2, 0)),
        (((CONTACT, "haptic}"), (COORDINATION, "haptic, link"), (LINK, "network}")), (4, 0, 0)),
        (((LINK, "network, delay: 16 ms}"),), (4, 2, 4)),
        (((LINK, "network, delay: 4 ms}"),), (4, 2, 2)),
        (((CONTACT, "haptic, delay: 3 ms}"),), (4, 4, 2)),
        (((CONTACT, "haptic, delay: 2.5 ms}"),), (4, 4, 2)),
        (((COORDINATION, "haptic, delay: 1 ms, delays: own, link"),), (4, 2, 2)),
    ],
)
def test_a_peer_keeps_its_motion_its_delayed_forces_and_its_packets_on_their_way(
    changes: tuple[tuple[str, str], ...], counts: tuple[int, int, int]
) -> None:
    system = compiled(replaced(AVERAGE, *changes))
    (site,) = needs(system).sites
    assert (site.motion, site.remembered, site.packets) == counts
    assert site.states == sum(counts) == analyze(system).states_per_peer


def test_the_papers_scene_needs_eight_states_a_peer() -> None:
    found = needs(compiled(AVERAGE))
    assert str(found) == (
        "8 states a peer (4 motion, 2 delayed force, 2 network), 3 peers; analysed as 2 modes of 8"
    )
    assert found.frame == Fraction(1, 125)
    assert found.ticks == (("haptic", 8), ("network", 1))


@pytest.mark.parametrize("count", [2, 3, 1_000_000])
def test_more_peers_need_no_more(count: int) -> None:
    system = compiled(MESH.replace("count: 3", f"count: {count}"))
    assert needs(system).sites == needs(compiled(MESH)).sites
    assert needs(system).systems == ((2, 8),)


def test_different_groups_are_one_larger_system_and_a_difference_each() -> None:
    system = compiled(
        replaced(
            AVERAGE, ("user: {count: 3}", "one: {count: 1, set: {device.mass: 2 kg}}\n  two: {count: 2}")
        )
    )
    assert needs(system).systems == ((1, 16), (1, 8))


def test_one_peer_alone_is_one_small_system() -> None:
    assert str(needs(compiled(ONE_MASS))) == "2 states a peer (2 motion), 1 peer; analysed as 1 mode of 2"


def test_graphs_and_different_peers_are_counted_as_they_are_analysed() -> None:
    assert str(needs(linked(paper(peers=8), "ring"))).endswith("8 peers; analysed as 5 modes of 8")
    different = columned(paper(), device__mass=[0.1, 0.2, 0.3])
    assert str(needs(different)).endswith("3 peers; analysed as 1 system of 24")
    assert needs(columned(linked(paper(), "ring"), device__mass=[0.1, 0.2, 0.3])).systems == ((1, 24),)
    assert needs(columned(linked(paper(), "ring"), device__mass=[0.1, 0.2, 0.1])).systems == ((1, 16), (1, 8))


def test_what_is_evaluated_once_a_pair_of_peers_is_named() -> None:
    assert str(needs(edged(paper()))).endswith(
        "analysed as 2 modes of 8; costs N²: pull is evaluated once a pair of peers"
    )
    assert "not analysed: pull of user[1]: max over equal peers has no linearization" in str(
        needs(edged(paper(), "max"))
    )
