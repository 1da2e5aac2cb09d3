"""Claims about `apc.frame.linearize`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import casadi
import numpy as np

from apc.frame.jacobians import jacobians
from apc.frame.linearize import linearize, linearize_exact, linearize_rows, site_of_row, sites_of_rows
from apc.frame.parameters import resolve
from tests.sites import NAMES, paper, user


def _vector(**values: float) -> np.ndarray:
    return resolve(paper(**values)).parameters[0][0]


def test_the_paper_site_has_the_matrices_derived_by_hand() -> None:
    site = linearize(jacobians(user("mean")), _vector(kt=800.0, bt=2.0, kc=1500.0, bc=3.0, cube=0.25))
    np.testing.assert_array_equal(site.a, [[0, 1, 0, 0], [0, -50.0, 0, 0], [0, 0, 0, 1], [0, 0, 0, -20.0]])
    np.testing.assert_array_equal(site.b, [[0, 0], [-10.0, 0], [0, 0], [4.0, -4.0]])
    [tick], [send] = site.ticks, site.sends
    np.testing.assert_array_equal(tick.x, [[1500.0, 3.0, -1500.0, -3.0], [0, 0, 800.0, 2.0]])
    np.testing.assert_array_equal(tick.r, [[0, 0], [-800.0, -2.0]])
    np.testing.assert_array_equal(tick.u, np.zeros((2, 2)))
    assert tick.m.shape == (2, 0)
    np.testing.assert_array_equal(send.x, [[0, 0, 1, 0], [0, 0, 0, 1]])
    assert site.affine


def test_full_mesh_pulls_with_the_number_of_others() -> None:
    site = linearize(jacobians(user("sum")), _vector(kt=100.0, bt=2.0, peers=5))
    np.testing.assert_array_equal(site.ticks[0].x[1], [0, 0, 400.0, 8.0])
    np.testing.assert_array_equal(site.ticks[0].r[1], [-100.0, -2.0])


def test_exact_matrices_are_the_floats_without_their_rounding() -> None:
    built, parameters = jacobians(user("sum")), _vector(kt=0.1, peers=4)
    exact, rounded = linearize_exact(built, parameters), linearize(built, parameters)
    assert exact.ticks[0].x[1, 2] == 3 * Fraction(0.1)
    assert exact.b[1, 0] == -1 / Fraction(0.1)
    np.testing.assert_allclose(exact.a.astype(float), rounded.a, rtol=1e-15)


def test_a_site_that_is_not_affine_is_linearized_at_its_start_values() -> None:
    kind = user("mean")
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)
    p, t = casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    cubic = casadi.vertcat(x[1], u[0] - x[0] ** 3, x[3], u[1])
    built = jacobians(replace(kind, derivative=casadi.Function("derivative", [x, u, p, t], [cubic])))
    parameters = _vector()
    parameters[NAMES.index("device.x.start")] = 2.0
    assert not built.affine
    assert linearize(built, parameters).a[1, 0] == -12.0
    assert linearize_exact(built, parameters).a[1, 0] == -12


def test_many_rows_are_the_sites_one_by_one() -> None:
    built = jacobians(user("mean"))
    vectors = np.stack([_vector(kt=kt, cube=cube) for kt, cube in ((100.0, 0.1), (200.0, 0.3), (0.0, 1.0))])
    rows = linearize_rows(built, vectors)
    together = sites_of_rows(built, rows)
    for place, vector in enumerate(vectors):
        alone = linearize(built, vector)
        for site in (site_of_row(built, rows[place]), alone):
            np.testing.assert_array_equal(site.a, together.a[place])
            np.testing.assert_array_equal(site.ticks[0].r, together.ticks[0].r[place])
