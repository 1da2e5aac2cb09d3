"""Claims about `apc.frame.site`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from apc.frame.jacobians import jacobians
from apc.frame.linearize import linearize
from apc.frame.parameters import resolve
from apc.frame.site import (
    LinearSite,
    assemble,
    cut,
    every_matrix,
    matrices_of,
    rational_floats,
    with_own_parts,
)
from tests.sites import paper


def _site() -> LinearSite:
    system = paper(kt=0.1, bt=2.0)
    return linearize(jacobians(system.kinds[0]), resolve(system).parameters[0][0])


def test_taken_apart_and_put_together_a_site_is_the_same() -> None:
    site = _site()
    listed = matrices_of(site)
    again = assemble(site.kind, site.affine, listed, [tick.channels for tick in site.ticks])
    assert all(one is other for one, other in zip(matrices_of(again), listed, strict=True))
    flat = np.concatenate([one.ravel(order="F") for one in listed])
    for one, other in zip(cut(flat, [one.shape for one in listed]), listed, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_change_of_every_entry_or_matrix_leaves_names_and_shapes() -> None:
    site = _site()
    assert rational_floats(site).ticks[0].r[1, 0] == -Fraction(0.1)
    doubled = every_matrix(site, lambda matrix: 2 * matrix)
    assert [one.shape for one in matrices_of(doubled)] == [one.shape for one in matrices_of(site)]
    assert doubled.ticks[0].channels == site.ticks[0].channels


def test_a_receives_own_part_goes_into_what_the_tick_makes_of_it() -> None:
    """y = X x + R r with r = r' + g x: X becomes X + R g."""
    site = _site()
    part = np.array([1.0, 0, 3, 0, 0, 0])  # over x (4) and u (2); there is no m
    [tick] = with_own_parts(site, [[part, None]], np.add, np.multiply.outer).ticks
    np.testing.assert_array_equal(tick.x, site.ticks[0].x + np.outer(site.ticks[0].r[:, 0], part[:4]))
    np.testing.assert_array_equal(tick.r, site.ticks[0].r)
