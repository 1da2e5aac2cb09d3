"""Claims about `apc.eigen.runs`."""

from __future__ import annotations

import numpy as np

from apc.eigen.runs import Runs, joined, shifted


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
