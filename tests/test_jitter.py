"""Claims about `apc.runtime.frame.jitter`."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from apc.runtime.frame.jitter import LATEST, PARETO_MOST, deviates
from tests.lossy import RELIABLE, delays


@pytest.mark.parametrize(
    ("distribution", "mean", "variance"),
    [
        ("uniform", 0.0, 1 / 3),
        ("normal", 0.0, 1.0),
        # X has the density 3/x⁴ from 1 on; (4/3)(min(X, 9/2) − 3/2): E min = 3/2 − 2/81, E min² = 3 − 4/9.
        ("pareto", -4 / 3 * 2 / 81, 16 / 9 * (3 - 4 / 9 - (3 / 2 - 2 / 81) ** 2)),
    ],
)
def test_jitter_has_the_moments_and_the_shape_of_its_distribution(
    distribution: str, mean: float, variance: float
) -> None:
    stats = pytest.importorskip("scipy.stats")
    exact = {
        "uniform": stats.uniform(-1, 2).cdf,
        "normal": stats.norm.cdf,
        "pareto": lambda x: np.where(x < PARETO_MOST, stats.pareto(3, -1.5 * 4 / 3, 4 / 3).cdf(x), 1.0),
    }[distribution]
    law = replace(RELIABLE, delay=10.0, jitter=1.0, distribution=distribution)
    drawn = delays(law, 400_000) - 10
    n = len(drawn)
    assert abs(drawn.mean() - mean) < 3 * math.sqrt(variance / n)
    fourth = float(np.mean((drawn - mean) ** 4))
    assert abs(drawn.var() - variance) < 3 * math.sqrt((fourth - variance**2) / n)
    # Kolmogorov and Smirnov, at 0.1 %: no distribution function is further away than 1.95/√n. A step of the
    # function (the limit of Pareto) is seen from its left.
    points = np.linspace(-4, 3.99, 500)
    found = np.searchsorted(np.sort(drawn), points, side="right") / n
    assert np.abs(found - exact(points)).max() < 1.95 / math.sqrt(n)


def test_pareto_is_netems_table() -> None:
    """The table's first and last entries: 65536/65536 gives −2/3, 16/65536 the limit."""
    assert LATEST["pareto"] == PARETO_MOST
    ends = deviates("pareto", np.array([0.0, 1 - 16 / 65536]), np.zeros(2))
    assert ends.tolist() == [pytest.approx(-2 / 3), 4.0]
