"""What a frame rounds is within its bounds: against rationals, and the frame stepped in balls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apc.analysis import selfcheck
from apc.analysis.selfcheck import check_frame
from apc.compiler.components.library import Library
from apc.frame.lift import LiftedSite, lift
from apc.frame.radius import FLOATS, RADII, radius_of, value_of, with_radius
from tests.bench.growing import equations
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
        ("right", 1, {"device.x": 0.03}),
        ("left", 2, {"device.mass": 0.2}),
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
