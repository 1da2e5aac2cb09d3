"""What a frame rounds is within its bounds: against rationals, eighty digits, the frame stepped in balls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest

from apc.analysis import selfcheck
from apc.analysis.selfcheck import check_frame
from apc.compiler.components.library import Library
from apc.frame import batch_lift
from apc.frame.lift import FrameMap, LiftedSite, compose, lift
from apc.frame.linearize import linearize_exact
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.frame.radius import FLOATS, RADII, radius_of, value_of, with_radius
from apc.frame.schedule import Propagate
from apc.frame.site import every_matrix
from apc.large.populations import Population
from tests.bench.growing import equations
from tests.populations import crowded, different
from tests.sites import MS, grouped, paper
from tests.topologies import compiled


def _fractions(matrix: Any) -> Any:
    exact = np.empty(matrix.size, dtype=object)
    exact[:] = [Fraction(float(entry)) for entry in matrix.ravel()]
    return exact.reshape(matrix.shape)


def _wild(random: np.random.Generator, *shape: int) -> Any:
    """Numbers of all sizes, that cancel, some of them 0."""
    return (
        random.standard_normal(shape) * 10.0 ** random.integers(-9, 9, shape) * (random.random(shape) < 0.7)
    )


def _within(found: Any, true: Any) -> bool:
    off = np.abs(_fractions(value_of(found)) - true)
    return bool((off <= _fractions(radius_of(found))).all())


OPERATIONS: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "product": lambda numbers: (numbers.multiply, (4, 6, 5)),
    "sum": lambda numbers: (numbers.add, (4, 6, 0)),
    "difference": lambda numbers: (numbers.subtract, (4, 6, 0)),
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize("seed", range(8))
def test_the_true_one_of_all_that_lie_within_the_radii_lies_within(name: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    computed, (n, m, k) = OPERATIONS[name](RADII)
    exactly = np.dot if name == "product" else OPERATIONS[name](FLOATS)[0]
    a, b = _wild(random, n, m), _wild(random, m, k) if k else _wild(random, n, m)
    off_a, off_b = (np.abs(one) * random.choice([0.0, 1e-15, 1e-3]) for one in (a, b))
    found = computed(with_radius(a, off_a), with_radius(b, off_b))
    for corner in ((0, 0), (1, 1), (-1, 1), (1, -1)):
        moved = [
            _fractions(one) + sign * _fractions(off)
            for one, off, sign in zip((a, b), (off_a, off_b), corner, strict=True)
        ]
        assert _within(found, exactly(*moved))


NAMES = ("p", "q", "s", "d")


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


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"operator": "sum", "own_delay": True},
        {"comp": MS * 5 / 2, "comm": 11 * MS},
        {"haptic": 3 * MS, "network": 2 * MS, "comm": Fraction(0), "haptic_phase": MS / 3},
    ],
)
def test_a_frame_stepped_and_lifted_agrees_to_rounding(values: dict[str, Any]) -> None:
    system = grouped(
        paper(kt=800.0, bt=2.0, kc=1500.0, bc=2.0, **values),
        ("right", 1, {"hand.force": -4.0, "device.x.start": 0.03}),
        ("left", 2, {"hand.force": 2.0, "device.mass": 0.2}),
    )
    assert check_frame(system) < 1e-13


def test_a_wrong_lift_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoiled(*arguments: Any, **options: Any) -> LiftedSite:
        lifted = lift(*arguments, **options)
        return replace(lifted, p=lifted.p * (1 + 1e-9))

    monkeypatch.setattr(selfcheck, "lift", spoiled)
    with pytest.raises(AssertionError, match="one frame of user, stepped and lifted, differ by"):
        check_frame(paper())


def test_many_masses_in_a_row_stepped_and_lifted_agree_to_rounding(tmp_path: Path) -> None:
    """Their steps are sums of a series, ball by ball, and of no matrix."""
    text = equations(150, tmp_path)
    assert check_frame(compiled(text, Library((tmp_path / "parts",)))) < 1e-15
