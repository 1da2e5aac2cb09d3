"""Claims about `apc.eigen.coupling`."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import pytest

from apc.analysis.analysis import lifted_groups
from apc.compiler.errors import ApcError
from apc.eigen.closing import Coupling
from apc.eigen.coupling import complete_degrees, couple
from apc.frame.schedule import Way
from tests.sites import MS, columned, edged, grouped, linked, paper


def _coupled(system: Any, weight: int = 1) -> Coupling:
    groups, exchange = lifted_groups(system)
    degrees = complete_degrees(groups, exchange)
    return couple(groups, exchange, lambda way, g, h: Fraction(weight * groups[h].count - (g == h)), degrees)


def _pair(operator: str, **values: Any) -> Any:
    return grouped(paper(operator, **values), ("left", 2, {"device.mass": 0.2}), ("right", 3, {}))


def test_a_sum_counts_the_others_and_a_mean_divides_by_them() -> None:
    [total] = _coupled(_pair("sum")).values()
    assert total == ((1, 3), (2, 2))
    [mean] = _coupled(_pair("mean")).values()
    assert mean == ((Fraction(1, 4), Fraction(3, 4)), (Fraction(2, 4), Fraction(2, 4)))


def test_senders_of_another_delay_are_on_another_way() -> None:
    found = _coupled(linked(_pair("sum"), delays={("left", "right"): 16 * MS}))
    usual, late = (found[Way("sum", "lan", name)] for name in ("lan.delay", "lan.delay left right"))
    assert usual == ((1, 3), (0, 2))
    assert late == ((0, 0), (2, 0))


def test_of_a_maximum_only_the_one_it_is_taken_from_counts_and_once() -> None:
    system = columned(edged(paper(peers=3, kt=100.0), "max"), cube__x__start=[0.0, 0.01, 0.03])
    position = next(rows for way, rows in _coupled(system).items() if way.channel == "coordination.x")
    # All look at the first but the first, which looks at the second: there its distance is largest.
    assert position == ((0, -100, 0), (-100, 0, 0), (-100, 0, 0))


def test_a_mean_of_weights_that_add_up_to_nothing_is_refused() -> None:
    groups, exchange = lifted_groups(paper())
    with pytest.raises(ApcError, match="E802"):
        couple(groups, exchange, lambda way, g, h: Fraction(1), {("lan", 0): Fraction(0)})
