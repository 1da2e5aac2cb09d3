"""Claims about `apc.frame.start`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from apc.frame.jacobians import jacobians
from apc.frame.start import Listening, start_arguments, start_sends, start_values
from tests.sites import NAMES, edged, paper


def _parameters(operator: str = "mean") -> list[Fraction]:
    values = dict.fromkeys(NAMES, Fraction(1))
    values |= {"device.x.start": Fraction(3, 100), "cube.x.start": Fraction(1, 100), "zero": Fraction(0)}
    return [Fraction(values[name]) for name in NAMES[:-1]] + [Fraction(5)]


def test_a_site_starts_where_its_parameters_say_and_holds_put_out_zero() -> None:
    x, u, m = start_values(jacobians(paper().kinds[0]), _parameters())
    assert (x, u, m) == ([Fraction(3, 100), 0, Fraction(1, 100), 0], [0, 0], [[]])


def test_what_is_sent_at_the_start_is_exact() -> None:
    assert start_sends(jacobians(paper().kinds[0]), _parameters()) == {"lan": [Fraction(1, 100), 0]}


def test_others_stand_where_the_site_stands_unless_it_is_said_what_is_heard() -> None:
    [kind] = edged(paper("sum"), "sum", cubic=1.0).kinds
    site = jacobians(kind)
    r = start_arguments(site, _parameters(), Fraction, None)[3]
    assert r == [4 * Fraction(1, 100)]  # a sum over four others
    heard = Listening((Fraction(1, 3),), (None,))
    assert start_arguments(site, _parameters(), Fraction, heard)[3] == [Fraction(1, 3)]


def test_an_affine_site_is_asked_nothing_but_its_parameters() -> None:
    site = jacobians(paper().kinds[0])
    *moving, parameters, t = start_arguments(site, [2.0] * len(NAMES), float, None)
    assert not np.concatenate(moving).any()
    assert (parameters, t) == ([2.0] * len(NAMES), [0.0])
