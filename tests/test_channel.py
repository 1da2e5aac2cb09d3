"""Claims about `apc.network.channel`."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from apc.moments.memory import arrives
from apc.network.channel import LATEST, PARETO_MOST, channel_law, deviates
from tests.lossy import RELIABLE, delays, unreliable
from tests.topologies import compiled


def test_the_numbers_are_the_scenes_and_follow_a_setting() -> None:
    system = compiled(unreliable("loss: 2 %, jitter: 3 ms, distribution: pareto"))
    [link] = system.links
    law = channel_law(system, link, Fraction(8, 1000))
    assert (law.p, law.r, law.one_minus_h, law.one_minus_k) == (0.02, 0.98, 1.0, 0.0)
    assert (law.delay, law.jitter, law.distribution) == (0.008, 0.003, "pareto")
    more = apc.set_parameters(system, {"lan.loss": "5 %", "lan.jitter": "1 ms"})
    law = channel_law(more, more.links[0], Fraction(8, 1000))
    assert (law.p, law.r, law.jitter) == (0.05, 0.95, 0.001)


def test_a_probability_is_kept_within_its_bounds_when_it_is_set() -> None:
    system = compiled(unreliable("loss: {p: 2 %, r: 30 %}"))
    for name, value in (("lan.loss.p", "101 %"), ("lan.loss.1-h", "-1"), ("lan.loss.r", "2")):
        with pytest.raises(ApcError, match=r"E624 lan\.loss"):
            apc.set_parameters(system, {name: value})
    with pytest.raises(ApcError, match=r"E625 lan\.jitter wants a time of 0 s or more"):
        apc.set_parameters(compiled(unreliable("jitter: 1 ms")), {"lan.jitter": "-1 ms"})


def test_a_group_can_not_set_a_number_of_a_link() -> None:
    system = apc.set_parameters(compiled(unreliable("loss: 2 %")), {"user.lan.loss": "5 %"})
    with pytest.raises(ApcError, match=r"E891 lan\.loss is of a link, .*: user can't set it"):
        channel_law(system, system.links[0], Fraction(0))


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


def test_the_latest_packets_of_a_table_have_arrived_at_the_latest_tick() -> None:
    """One in 91 is 4 jitters late, all at one instant: 7.2 ms + 4·2.2 ms is the tick at 16 ms."""
    law = replace(RELIABLE, delay=0.0072, jitter=0.0022, distribution="pareto")
    assert Fraction(law.jitter) > Fraction(22, 10_000)  # so that the quotient falls short of 4
    assert arrives(law, Fraction(72, 10_000), Fraction(16, 1000)) == 1.0
