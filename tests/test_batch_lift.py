"""Claims about `apc.runtime.frame.batch_lift`: many sites at once are the sites one by one."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.runtime.frame.batch_lift import exponential_rows
from apc.runtime.frame.discretize import UNIT, discretize
from apc.runtime.frame.lift import lift
from apc.runtime.frame.linearize import linearize_exact, linearize_rows, site_of_row
from apc.runtime.frame.overrides import Override, apply
from tests.populations import crowded, different
from tests.sites import MS

NAMES = ("p", "q", "s", "d")


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"comp": Fraction(0), "comm": Fraction(0)},
        {"comp": MS * 5 / 2, "comm": 4 * MS},
        {"haptic": 2 * MS, "network": 3 * MS},
        {"own_delay": True},
    ],
)
def test_many_sites_at_once_are_the_sites_one_by_one(values: dict[str, Fraction]) -> None:
    [crowd], _ = crowded(different(5, **values))
    for row, vector in enumerate(crowd.parameters):
        site = site_of_row(crowd.jacobians, linearize_rows(crowd.jacobians, vector[None])[0])
        alone = lift(site, crowd.schedule, exact=linearize_exact(crowd.jacobians, vector))
        for name in NAMES:
            apart = np.abs(getattr(crowd.lifted, name)[row] - getattr(alone, name))
            allowed = getattr(crowd.lifted, f"{name}_error")[row] + getattr(alone, f"{name}_error")
            assert np.all(apart <= allowed)
        assert crowd.lifted.p_error[row].max() < 1e-12 * max(1.0, np.abs(alone.p).max())


@pytest.mark.parametrize("decay", [0.0, 1e-9, 1.0, 50.0, 4000.0])
def test_exponentials_are_within_their_bound_of_ball_arithmetic(decay: float) -> None:
    """A mass with damping and a spring to a held input, slow and stiff."""
    a = np.array([[0.0, 1.0], [-30.0, -decay]])
    b = np.array([[0.0], [2.0]])
    [truth] = discretize(a, b, [Fraction(1, 100)])
    step, size, charge = exponential_rows(a[None], b[None], 0.01)
    assert np.all(np.abs(step[0] - truth.matrix) <= charge * UNIT * size[0] + UNIT * truth.size)
    assert np.all(charge * UNIT * size[0] < 1e-10)


def test_where_the_bound_is_hopeless_the_estimate_covers_the_truth() -> None:
    """A copy of a tenth of a gram: magnitudes grow without measure over a frame, the errors don't."""
    system = apply(different(6), [Override("cube.mass", None, Fraction(1, 10**4))])
    [crowd], _ = crowded(system)
    assert crowd.lifted.estimated
    for row, vector in enumerate(crowd.parameters):
        site = site_of_row(crowd.jacobians, linearize_rows(crowd.jacobians, vector[None])[0])
        alone = lift(
            site, crowd.schedule, exact=linearize_exact(crowd.jacobians, vector)
        )  # Arb's exponentials
        for name in NAMES:
            apart = np.abs(getattr(crowd.lifted, name)[row] - getattr(alone, name))
            estimate = getattr(crowd.lifted, f"{name}_error")[row]
            assert np.all(apart <= estimate)
            assert estimate.max() < 1e-8 * max(1.0, np.abs(getattr(alone, name)).max())
