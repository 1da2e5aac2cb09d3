"""Claims about `apc.eigen.listening`: what is heard at the start, worked out by hand."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.analysis.analysis import lifted_groups
from apc.eigen.peer_group import PeerGroup
from apc.frame.start import Listening
from tests.sites import columned, edged, paper

STARTS = [0.0, 0.25, 1.0]
CUBIC = 8.0


def _groups(operator: str) -> tuple[PeerGroup, ...]:
    system = columned(edged(paper(operator, kt=100.0, bt=3.0), operator, cubic=CUBIC), cube__x__start=STARTS)
    return lifted_groups(system)[0]


def _listening(group: PeerGroup) -> Listening:
    assert group.listening is not None
    return group.listening


def _pull(own: float, other: float) -> Fraction:
    """Return K d + c d³ with d from a peer to another."""
    d = Fraction(own) - Fraction(other)
    return 100 * d + 8 * d**3


def _slope(own: float, other: float) -> Fraction:
    return 100 + 24 * (Fraction(own) - Fraction(other)) ** 2


@pytest.mark.parametrize(("operator", "share"), [("sum", Fraction(1)), ("mean", Fraction(1, 2))])
def test_a_sum_and_a_mean_add_up_what_each_sender_makes(operator: str, share: Fraction) -> None:
    for g, group in enumerate(_groups(operator)):
        others = [start for h, start in enumerate(STARTS) if h != g]
        listening = _listening(group)
        assert listening.values == (share * sum(_pull(STARTS[g], one) for one in others),)
        [own] = listening.own
        assert own is not None
        # Over x = (x, v, x_O, v_O), then u: the pull follows x_O by its slopes, v_O by B_T each.
        assert own == (0, 0, share * sum(_slope(STARTS[g], one) for one in others), share * 3 * 2, 0, 0)


def test_each_sender_is_weighed_by_the_slope_where_the_pair_starts() -> None:
    gains = _groups("sum")[0].gains
    assert gains["haptic: pull", "coordination.x"][1:] == (-_slope(0.0, 0.25), -_slope(0.0, 1.0))
    assert set(gains["haptic: pull", "coordination.v"]) == {Fraction(-3)}


@pytest.mark.parametrize(("operator", "heard"), [("max", [0.25, 0.0, 0.0]), ("min", [1.0, 1.0, 0.25])])
def test_a_maximum_or_minimum_is_that_of_one_sender(operator: str, heard: list[float]) -> None:
    for group, own, other in zip(_groups(operator), STARTS, heard, strict=True):
        assert _listening(group).values == (_pull(own, other),)
