"""What becomes of packets: how many are lost or late, which of them counts at a tick, and by what luck.

A channel is netem's: p, r, 1-h and 1-k of its `gemodel`, a delay with a jitter; luck is Philox.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from apc.mean_square.receiver_memory import arrives
from apc.network.channel import PARETO_MOST, ChannelLaw, PacketSource, channel_law, deviates
from apc.network.packet_schedule import LinkReceiver
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.lossy import BURSTS, RELIABLE, delays, effective, recorded, unreliable
from tests.sites import MS
from tests.topologies import compiled, replaced

# ---- luck ----


def noise(seed: int, run: int, sender: int, receiver: int, blocks: int) -> list[list[float]]:
    """Return the blocks of a way's stream over "lan", whose CRC-32 is 0x6860FDEF, in whole numbers.

    Philox-4x64-10 as Salmon et al. (SC '11) write it: ten rounds of two products, the key going up between.
    """
    found = []
    for block in range(1, blocks + 1):
        r0, l0, r1, l1, k0, k1 = block, sender, receiver, 0, seed, 0x6860FDEF + (run << 32)
        for _ in range(10):
            one, two = 0xD2E7470EE14C6C93 * r0, 0xCA5A826395121157 * r1
            r0, l0 = (two >> 64) ^ l0 ^ k0, two % 2**64
            r1, l1 = (one >> 64) ^ l1 ^ k1, one % 2**64
            k0, k1 = (k0 + 0x9E3779B97F4A7C15) % 2**64, (k1 + 0xBB67AE8584CAA73B) % 2**64
        found.append([(word >> 11) / 2**53 for word in (r0, l0, r1, l1)])
    return found


@pytest.mark.parametrize(("p", "r"), [*itertools.product([0.0, 0.5, 1.0], repeat=2), (0.3, 0.7)])
def test_each_packet_follows_from_its_own_luck_for_ever(p: float, r: float) -> None:
    law = replace(RELIABLE, jitter=0.008, p=p, r=r)
    found = PacketSource(law, "lan", [(4, 1)], seed=7, run=3).take(40)[0]
    first, *rest = noise(7, 3, 4, 1, 41)
    bad = first[0] < law.bad
    for packet, (turn, _, late, _) in zip(found, rest, strict=True):
        expected = math.inf if bad else 0.008 + 0.008 * (2 * late - 1)
        assert packet == pytest.approx(expected, rel=1e-12, abs=1e-15)
        bad = turn < 1 - r if bad else turn < p


# ---- how many are lost, and how late they are ----


@pytest.mark.parametrize(
    ("law", "share", "correlation"),
    [
        (BURSTS, 0.01 / 0.26, 1 - 0.01 - 0.25),
        (replace(RELIABLE, p=0.2, r=0.8), 0.2, 0.0),
        (replace(RELIABLE, p=0.1, r=0.3, one_minus_h=0.7, one_minus_k=0.05), 0.25 * 0.7 + 0.75 * 0.05, 0.6),
    ],
)
def test_as_many_are_lost_as_the_two_states_say(law: ChannelLaw, share: float, correlation: float) -> None:
    """The variance of a mean of a chain is (1 + c)/(1 − c) times that of independent packets, or less."""
    assert law.mean_loss == pytest.approx(share, abs=1e-12)
    count = 400_000
    sigma = math.sqrt(
        max(share * (1 - share), correlation / 3) / count * (1 + correlation) / (1 - correlation)
    )
    lost = np.isinf(delays(law, count))
    assert abs(lost.mean() - share) < 3 * sigma
    if law is BURSTS:  # 1/r = 4 packets a burst
        edges = np.diff(lost.astype(np.int8), prepend=0, append=0)
        lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
        assert abs(lengths.mean() - 4) < 3 * math.sqrt((1 - 0.25) / 0.25**2 / len(lengths))


def test_what_is_lost_at_some_probability_is_lost_at_any_larger_one_and_all_at_1() -> None:
    some, more = (np.isinf(delays(replace(RELIABLE, p=p, r=1 - p), 5000)) for p in (0.02, 0.1))
    assert some.any() and (more | ~some).all()
    assert np.isinf(delays(replace(RELIABLE, p=1.0, r=0.0), 1000)).all()
    assert (delays(RELIABLE, 1000) == 0.008).all()


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
    n, law = 400_000, replace(RELIABLE, delay=10.0, jitter=1.0, distribution=distribution)
    drawn = delays(law, n) - 10
    assert abs(drawn.mean() - mean) < 3 * math.sqrt(variance / n)
    assert abs(drawn.var() - variance) < 3 * math.sqrt((np.mean((drawn - mean) ** 4) - variance**2) / n)
    # Kolmogorov and Smirnov, at 0.1 %: no distribution function is further away than 1.95/√n. A step of the
    # function (the limit of Pareto) is seen from its left.
    points = np.linspace(-4, 3.99, 500)
    found = np.searchsorted(np.sort(drawn), points, side="right") / n
    assert np.abs(found - exact(points)).max() < 1.95 / math.sqrt(n)


def test_the_latest_packets_of_a_table_have_arrived_at_the_latest_tick_and_none_before_it_was_sent() -> None:
    """netem's table of Pareto ends at 4: 7.2 ms + 4·2.2 ms is the tick at 16 ms, though 0.0022 is more."""
    assert deviates("pareto", np.array([0.0, 1 - 16 / 65536]), np.zeros(2)) == pytest.approx([-2 / 3, 4.0])
    law = replace(RELIABLE, delay=0.0072, jitter=0.0022, distribution="pareto")
    assert Fraction(law.jitter) > Fraction(22, 10_000)
    assert arrives(law, Fraction(72, 10_000), Fraction(16, 1000)) == 1.0
    early = delays(replace(RELIABLE, delay=0.001, jitter=0.005, distribution="normal"), 10_000)
    assert early.min() == 0.0 and (early == 0).mean() == pytest.approx(
        0.4207, abs=0.02
    )  # the share below −1/5


# ---- which of them counts at a tick ----


def listener(
    law: ChannelLaw, *pairs: tuple[int, int], newest: bool = True, quantum: Fraction = MS
) -> LinkReceiver:
    source = PacketSource(law, "lan", pairs or [(0, 1)])
    return LinkReceiver(source, newest=newest, phase=0, period=8, delay=8, quantum=quantum)


@pytest.mark.few(1)
@pytest.mark.parametrize("newest", [True, False])
@pytest.mark.parametrize(
    "law",
    [
        *(replace(BURSTS, p=0.2, jitter=0.02, delay=0.02, distribution=one) for one in ("uniform", "normal")),
        replace(BURSTS, p=0.2, jitter=0.02, delay=0.02, distribution="pareto"),
        recorded(9, 3, math.inf, 20, 1),
    ],
)
def test_ticks_see_what_looking_at_every_packet_finds_however_time_is_cut(
    law: ChannelLaw, newest: bool
) -> None:
    ticks = np.arange(2000)
    late = delays(law, 400).tolist()
    expected = [effective(late, tick, newest=newest) for tick in range(2000)]
    for pieces in (1, 7, 450):
        # The way that is looked at is one of three that are heard together.
        ear = listener(law, (3, 1), (0, 1), (0, 2), newest=newest)
        parts = [ear.receive(part) for part in np.array_split(ticks, pieces)]
        packets, missing = (
            np.concatenate([getattr(part, name)[:, 1] for part in parts]).tolist()
            for name in ("packets", "missing")
        )
        assert [*zip(packets, missing, strict=True)] == expected
        assert ear.stored < 60  # and does not grow with time
    assert any(np.diff(packets) < 0) != newest, "an older packet overwrites a newer one only if all count"


# ---- who hears whom ----


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (
            [("count: 3", "count: 2000")],
            "lan is unreliable; 2000 completely connected peers .* 3998000 directed",
        ),
        ([("delay: 8 ms,", "delay: 9000.000000001 ms,")], "lan is unreliable; .* multiples of 1e-12 s"),
        ([("delay: 8 ms,", "delay: 9000.000000001 ms, on_loss: zero,")], "lan .* multiples of 1e-12 s"),
    ],
)
def test_more_than_can_be_kept_is_refused_by_number(changes: list[tuple[str, str]], why: str) -> None:
    with pytest.raises(ApcError, match=f"E892 {why}"):
        prepare(compiled(replaced(unreliable("loss: 1 %"), *changes)), Settings(Fraction(1)))


def test_the_law_of_a_link_is_no_groups() -> None:
    own = apc.set_parameters(compiled(unreliable("loss: 2 %")), {"user.lan.loss": "5 %"})
    with pytest.raises(ApcError, match=r"E891 lan\.loss belongs to a link and can't be set by group user"):
        channel_law(own, own.links[0], own.links[0].delay)
