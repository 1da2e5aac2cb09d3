"""Claims about `apc.network.channel`."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from apc.network.channel import PacketSource
from apc.network.philox import words
from tests.lossy import BURSTS, RELIABLE, delays, recorded


def test_bursts_have_the_loss_and_the_length_of_gilbert_and_elliott() -> None:
    """Mean loss p/(p + r) = 0.03846, mean burst 1/r = 4 packets, for 1-h = 1 and 1-k = 0."""
    assert pytest.approx(0.038461538461538464, abs=1e-12) == BURSTS.mean_loss
    count = 2_000_000
    lost = np.isinf(delays(BURSTS, count))
    # The variance of a mean of a two-state chain of correlation c = 1 − p − r is that of independent packets
    # times (1 + c)/(1 − c).
    share, correlation = BURSTS.mean_loss, 1 - 0.01 - 0.25
    sigma = math.sqrt(share * (1 - share) * (1 + correlation) / (1 - correlation) / count)
    assert abs(lost.mean() - share) < 3 * sigma
    edges = np.diff(lost.astype(np.int8), prepend=0, append=0)
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    assert abs(lengths.mean() - 4) < 3 * math.sqrt((1 - 0.25) / 0.25**2 / len(lengths))


def test_losses_are_independent_when_only_p_is_given() -> None:
    law = replace(RELIABLE, p=0.2, r=0.8)
    assert law.mean_loss == pytest.approx(0.2)
    lost = np.isinf(delays(law, 500_000)).astype(float)
    assert abs(lost.mean() - 0.2) < 3 * math.sqrt(0.2 * 0.8 / 500_000)
    after = lost[1:][lost[:-1] == 1]
    assert abs(after.mean() - 0.2) < 3 * math.sqrt(0.2 * 0.8 / len(after))


def test_both_states_lose_packets_with_their_own_probability() -> None:
    law = replace(RELIABLE, p=0.1, r=0.3, one_minus_h=0.7, one_minus_k=0.05)
    assert law.mean_loss == pytest.approx(0.25 * 0.7 + 0.75 * 0.05)
    correlation, count = 0.6, 1_000_000
    sigma = math.sqrt(0.25 / count * (1 + correlation) / (1 - correlation))  # no more than of any loss
    assert abs(np.isinf(delays(law, count)).mean() - law.mean_loss) < 3 * sigma


@pytest.mark.parametrize(("p", "r"), list(itertools.product([0.0, 0.3, 0.5, 1.0], repeat=2)))
def test_states_follow_each_other_as_one_step_after_the_other_says(p: float, r: float) -> None:
    law = replace(RELIABLE, p=p, r=r)
    lost = np.isinf(PacketSource(law, "lan", [(0, 1)]).take(500)[0])
    first, *turns = (words[0] for words in luck(0, 0, 0, 1, 501))
    bad, expected = first < law.bad, []
    for turn in turns:
        expected.append(bad)
        bad = turn < 1 - r if bad else turn < p
    assert lost.tolist() == expected


@pytest.mark.few(1)
@pytest.mark.parametrize("draws", [1000, 4000])
def test_the_first_packet_is_lost_as_often_as_any_other(draws: int) -> None:
    first = [np.isinf(delays(BURSTS, 1, run=run)[0]) for run in range(draws)]
    share = BURSTS.mean_loss
    assert abs(np.mean(first) - share) < 3 * math.sqrt(share * (1 - share) / draws)


def test_a_loss_of_one_loses_everything_and_of_zero_nothing() -> None:
    assert np.isinf(delays(replace(RELIABLE, p=1.0, r=0.0), 1000)).all()
    assert (delays(RELIABLE, 1000) == 0.008).all()


def test_what_is_lost_at_some_probability_of_independent_losses_is_lost_at_any_larger_one() -> None:
    some, more = (np.isinf(delays(replace(RELIABLE, p=p, r=1 - p), 5000)) for p in (0.02, 0.1))
    assert some.any()
    assert (more | ~some).all()


def test_nothing_arrives_before_it_was_sent() -> None:
    found = delays(replace(RELIABLE, delay=0.001, jitter=0.005, distribution="normal"), 10_000)
    assert found.min() == 0.0
    assert (found == 0).mean() == pytest.approx(0.4207, abs=0.02)  # the normal's share below −1/5


def luck(seed: int, run: int, sender: int, receiver: int, blocks: int) -> list[list[float]]:
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


def test_the_same_seed_gives_the_same_packets_for_ever() -> None:
    blocks = luck(7, 3, 4, 1, 11)
    law = replace(RELIABLE, jitter=0.008, p=0.3, r=0.7)
    found = PacketSource(law, "lan", [(4, 1)], seed=7, run=3).take(10)[0]
    bad = blocks[0][0] < 0.3
    for i, (turn, _, late, _) in enumerate(blocks[1:]):
        expected = math.inf if bad else 0.008 + 0.008 * (2 * late - 1)
        assert found[i] == pytest.approx(expected, rel=1e-12, abs=1e-15)
        bad = turn < 0.3


def test_the_words_are_those_of_numpys_philox_in_any_order() -> None:
    key, random = (7, 2**63 + 5), np.random.default_rng(1)
    for sender, receiver in random.integers(0, 2**40, (5, 2)).tolist():
        counter = np.array([0, sender, receiver, 0], np.uint64)
        stream = np.random.Philox(key=np.array(key, np.uint64), counter=counter).random_raw(4 * 50)
        order = random.permutation(50)
        found = words(key, (order + 1, sender, receiver))
        assert found.tolist() == stream.reshape(50, 4)[order].tolist()


def test_ways_runs_seeds_and_links_are_independent() -> None:
    law = replace(RELIABLE, jitter=0.008)
    rows = [
        PacketSource(law, link, [(sender, receiver)], seed=seed, run=run).take(4000)[0]
        for link, sender, receiver, seed, run in itertools.product(
            ["lan", "wan"], [0, 1], [2, 3], [0, 1], [0, 1]
        )
    ]
    apart = np.corrcoef(rows) - np.eye(len(rows))
    # 496 correlations of standard deviation 1/√4000: none beyond 5 of them, save once in 3500 seeds.
    assert np.abs(apart).max() < 5 / math.sqrt(4000)


def test_a_trace_begins_again_when_it_ends() -> None:
    assert delays(recorded(1, 2, math.inf), 7).tolist() == [0.001, 0.002, math.inf] * 2 + [0.001]
    assert recorded(1, 2, math.inf).mean_loss == pytest.approx(1 / 3)
