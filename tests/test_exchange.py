"""Claims about `apc.frame.exchange`."""

from __future__ import annotations

from apc.compiler.compiled import Graph
from apc.frame.exchange import arcs, build_exchange
from apc.frame.parameters import resolve
from tests.sites import COMPLETE, MS, grouped, linked, paper


def _graph(shape: str) -> Graph:
    return Graph(shape, COMPLETE.arcs, COMPLETE.weights)


def test_a_ring_hears_two_neighbours_and_a_star_its_centre() -> None:
    assert sorted(map(tuple, arcs(_graph("ring"), 3)[0].tolist())) == [
        (i, j) for i in range(3) for j in range(3) if i != j
    ]
    assert sorted(map(tuple, arcs(_graph("star"), 3)[0].tolist())) == [(0, 1), (0, 2), (1, 0), (2, 0)]
    assert [len(arcs(_graph(shape), n)[0]) for shape in ("ring", "star") for n in (1, 2)] == [0, 2, 0, 2]


def test_a_delay_of_equal_value_is_the_usual_one() -> None:
    base = grouped(paper(), ("left", 1, {}), ("right", 2, {}))
    system = linked(base, delays={("left", "right"): 8 * MS, ("right", "left"): 3 * MS})
    exchange = build_exchange(system, resolve(system).timings)
    assert exchange.delay("lan", 0, 1) == "lan.delay"
    assert exchange.delay("lan", 1, 0) == "lan.delay right left"
    assert [exchange.role(group) for group in (0, 1)] == [0, 1]
    assert [exchange.peer_name(peer) for peer in range(3)] == ["left[1]", "right[1]", "right[2]"]
