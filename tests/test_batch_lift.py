"""Claims about `apc.frame.batch_lift`: many sites at once are the sites one by one."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
import pytest

from apc.frame import batch_lift
from apc.frame.batch_lift import lift_rows
from apc.frame.discretize import UNIT, discretize, exponential_rows, step_rows
from apc.frame.jacobians import jacobians
from apc.frame.lift import FrameMap, compose, lift
from apc.frame.linearize import linearize, linearize_exact, linearize_rows, site_of_row
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.frame.parameters import resolve
from apc.frame.schedule import Propagate
from apc.frame.scheduling import build_schedules
from apc.frame.site import every_matrix
from apc.large.populations import Population
from tests.populations import crowded, different
from tests.sites import MS
from tests.test_selfcheck import STIFF
from tests.topologies import compiled

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
    [population], _ = crowded(different(5, **values))
    for row, vector in enumerate(population.parameters):
        site = site_of_row(population.jacobians, linearize_rows(population.jacobians, vector[None])[0])
        alone = lift(site, population.schedule, exact=linearize_exact(population.jacobians, vector))
        for name in NAMES:
            apart = np.abs(getattr(population.lifted, name)[row] - getattr(alone, name))
            allowed = getattr(population.lifted.error, name)[row] + getattr(alone.error, name)
            assert np.all(apart <= allowed)
        assert population.lifted.error.p[row].max() < 1e-12 * max(1.0, np.abs(alone.p).max())


@pytest.mark.parametrize("decay", [0.0, 1e-9, 1.0, 50.0, 4000.0])
def test_exponentials_are_within_their_bound_of_ball_arithmetic(decay: float) -> None:
    """A mass with damping and a spring to a held input, slow and stiff."""
    a = np.array([[0.0, 1.0], [-30.0, -decay]])
    b = np.array([[0.0], [2.0]])
    [truth] = discretize(a, b, [Fraction(1, 100)])
    step = exponential_rows(a[None], b[None], 0.01)
    off = step.roundings * UNIT * step.size[0]
    assert np.all(np.abs(step.matrix[0] - truth.matrix) <= off + UNIT * truth.size)
    assert np.all(off < 1e-10)


def test_what_moves_by_itself_or_alike_in_all_sites_is_within_its_bound_of_ball_arithmetic() -> None:
    """Sites of a mass of their own, an object that all have alike and that dies out fast, two held inputs.

    The third site's mass hangs on the object, so that in no site they may be taken apart.
    """
    for coupled in (0.0, 3.0):
        a, b = np.zeros((3, 4, 4)), np.zeros((3, 4, 2))
        a[:, 0, 1] = a[:, 2, 3] = 1.0
        a[:, 1, 1], a[:, 3, 3] = (-50.0, -70.0, -110.0), -8000.0
        a[2, 1, 2] = coupled
        b[:, 1, 0], b[:, 3, 0], b[:, 3, 1] = (-10.0, -9.0, -8.0), 1600.0, -1600.0
        step = step_rows(a, b, 0.001)
        for site in range(3):
            [truth] = discretize(a[site], b[site], [Fraction(0.001)])
            off = step.roundings * UNIT * step.size[site]
            assert np.all(np.abs(step.matrix[site] - truth.matrix) <= off + UNIT * truth.size)
            assert np.all(off < 1e-11 * np.maximum(1.0, np.abs(truth.matrix)))


def _many_digits(matrix: Any) -> Any:
    """Return a matrix of rationals as mpmath numbers, with a leading axis."""
    plain = np.asarray(matrix, dtype=object)
    found = [mpmath.mpf(one.numerator) / one.denominator for one in plain.reshape(-1)]
    return np.array(found, dtype=object).reshape(1, *plain.shape)


def _true_frame(population: Population, vector: Any) -> FrameMap:
    """Return the map of one site's frame, its events followed in many digits."""
    site = every_matrix(linearize_exact(population.jacobians, vector), _many_digits)
    n_x, n_u = site.b.shape[-2:]
    steps = {}
    for duration in {one.duration for one in population.schedule.events if isinstance(one, Propagate)}:
        seconds = duration * population.schedule.quantum
        whole = mpmath.zeros(n_x + n_u)
        for i, row in enumerate(np.concatenate([site.a[0], site.b[0]], axis=1)):
            for j, entry in enumerate(row):
                whole[i, j] = entry * seconds.numerator / seconds.denominator
        moved = mpmath.expm(whole, method="taylor")[:n_x, :]
        steps[duration] = np.array(moved.tolist(), dtype=object).reshape(1, n_x, n_x + n_u)
    return compose(site, population.schedule, steps)


@pytest.mark.few(5)
@pytest.mark.parametrize("hopeless", [0.0, np.inf], ids=["estimate", "bound"])
@pytest.mark.parametrize(
    ("grams", "seed", "values"),
    [
        # Of two frames moved at random, the changes in some entry of these were both too small by chance.
        ("0.01", 0, {"comp": Fraction(0), "comm": Fraction(0)}),
        ("0.01", 5, {"kt": 2000.0}),
        ("0.01", 9, {"bc": 0.2}),
        ("0.1", 4, {}),
        ("1", 2, {"kc": 3000.0}),
    ],
)
def test_bound_and_estimate_cover_the_error_against_eighty_digits(
    grams: str, seed: int, values: Any, hopeless: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_lift, "HOPELESS", hopeless)
    system = apply(different(6, seed=seed, **values), [Override(Free("cube.mass"), Fraction(grams) / 1000)])
    [population], _ = crowded(system)
    lifted = population.lifted
    assert lifted.estimated == (hopeless == 0.0)
    with mpmath.workdps(80):
        for row, vector in enumerate(population.parameters):
            true = _true_frame(population, vector)
            for name in NAMES:
                error = np.abs(getattr(lifted, name)[row] - getattr(true, name)[0]).astype(float)
                assert np.all(error <= getattr(lifted.error, name)[row])


def test_a_bound_says_something_of_copies_of_a_tenth_of_a_gram_and_nothing_is_estimated() -> None:
    """What rounds in their frame is charged where it rounds, not at the size of all that passes."""
    system = apply(different(6), [Override(Free("cube.mass"), Fraction(1, 10**4))])
    [population], _ = crowded(system)
    assert not population.lifted.estimated
    assert population.lifted.error.largest.max() < batch_lift.HOPELESS / 10


def test_where_the_bound_is_hopeless_the_errors_are_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    """By far less than a bound says; what is estimated holds the error of another way to the same frame."""
    monkeypatch.setattr(batch_lift, "HOPELESS", 0.0)
    system = apply(different(6), [Override(Free("cube.mass"), Fraction(1, 10**4))])
    [population], _ = crowded(system)
    assert population.lifted.estimated
    for row, vector in enumerate(population.parameters):
        site = site_of_row(population.jacobians, linearize_rows(population.jacobians, vector[None])[0])
        alone = lift(
            site, population.schedule, exact=linearize_exact(population.jacobians, vector)
        )  # Arb's exponentials
        for name in NAMES:
            apart = np.abs(getattr(population.lifted, name)[row] - getattr(alone, name))
            estimate = getattr(population.lifted.error, name)[row]
            assert np.all(apart <= estimate)
            assert estimate.max() < 1e-8 * max(1.0, np.abs(getattr(alone, name)).max())


@pytest.mark.parametrize("text", STIFF.values(), ids=STIFF)
def test_an_estimate_covers_the_digits_that_an_exponential_loses(text: str) -> None:
    system = compiled(text)
    [site] = [jacobians(kind) for kind in system.kinds]
    numbers = resolve(system)
    [schedule] = build_schedules(system, numbers.timings, [site.pattern])
    vector = numbers.parameters[0][0]
    many = lift_rows(site, schedule, linearize_rows(site, vector[None]))
    exact = linearize_exact(site, vector)
    alone = lift(linearize(site, vector), schedule, exact=exact)
    for name in NAMES:
        apart = np.abs(getattr(many, name)[0] - getattr(alone, name))
        assert (apart <= getattr(many.error, name)[0] + getattr(alone.error, name)).all()
