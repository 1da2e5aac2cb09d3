"""Claims about `apc.runtime.frame.packets`."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.compiler.errors import ApcError
from apc.runtime.frame.jacobians import jacobians
from apc.runtime.frame.packets import (
    PARETO_MOST,
    START,
    ChannelLaw,
    Listener,
    PacketSource,
    channel_law,
    deviates,
    nominal_notes,
)
from apc.runtime.frame.parameters import resolve
from apc.runtime.frame.schedule import Tick
from apc.runtime.frame.scheduling import build_schedules
from tests.sites import MS, paper
from tests.topologies import AVERAGE, compiled, replaced

LINK = "  lan: {clock: network, delay: 8 ms}"
RELIABLE = ChannelLaw(0.0, 1.0, 1.0, 0.0, 0.008, 0.0, "uniform", None)
BURSTS = replace(RELIABLE, p=0.01, r=0.25)
JITTER = replace(BURSTS, jitter=0.006, distribution="normal")
TIMES = {"phase": 0, "period": 8, "delay": 8, "quantum": MS}


def unreliable(text: str) -> str:
    """Return the three-users scene with a link that says more."""
    return replaced(AVERAGE, (LINK, f"{LINK[:-1]}, {text}}}"))


def delays(law: ChannelLaw, count: int, **key: int) -> NDArray[np.float64]:
    return PacketSource(law, "lan", 0, 1, **key).take(count)


def listener(law: ChannelLaw, *, newest: bool = True, seed: int = 0, sender: int = 0) -> Listener:
    return Listener(PacketSource(law, "lan", sender, 1, seed=seed), newest=newest, **TIMES)


def recorded(*milliseconds: float) -> ChannelLaw:
    return replace(RELIABLE, trace=np.array(milliseconds) / 1000)


def heard(law: ChannelLaw, ticks: int, *, newest: bool = True) -> list[int]:
    return listener(law, newest=newest).hear(np.arange(ticks)).packets.tolist()


# ---- loss ----


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
    source = PacketSource(law, "lan", 0, 1)
    twin = PacketSource(law, "lan", 0, 1)
    lost = np.isinf(source.take(500))
    bad, expected = twin._bad, []
    for turn in twin._uniforms(500)[:, 0].tolist():
        expected.append(bad)
        bad = turn < 1 - r if bad else turn < p
    assert lost.tolist() == expected
    assert source._bad == bad


def test_the_first_packet_is_lost_as_often_as_any_other() -> None:
    first = [np.isinf(delays(BURSTS, 1, run=run)[0]) for run in range(4000)]
    share = BURSTS.mean_loss
    assert abs(np.mean(first) - share) < 3 * math.sqrt(share * (1 - share) / 4000)


def test_a_loss_of_one_loses_everything_and_of_zero_nothing() -> None:
    assert np.isinf(delays(replace(RELIABLE, p=1.0, r=0.0), 1000)).all()
    assert (delays(RELIABLE, 1000) == 0.008).all()


def test_what_is_lost_at_some_probability_of_independent_losses_is_lost_at_any_larger_one() -> None:
    some, more = (np.isinf(delays(replace(RELIABLE, p=p, r=1 - p), 5000)) for p in (0.02, 0.1))
    assert some.any()
    assert (more | ~some).all()


# ---- jitter ----


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
    ends = deviates("pareto", np.array([0.0, 1 - 16 / 65536]), np.zeros(2))
    assert ends.tolist() == [pytest.approx(-2 / 3), 4.0]


def test_nothing_arrives_before_it_was_sent() -> None:
    found = delays(replace(RELIABLE, delay=0.001, jitter=0.005, distribution="normal"), 10_000)
    assert found.min() == 0.0
    assert (found == 0).mean() == pytest.approx(0.4207, abs=0.02)  # the normal's share below −1/5


# ---- reproducibility ----


def test_the_same_seed_gives_the_same_packets_for_ever() -> None:
    """PCG64 seeded with entropy 7 and the key (CRC-32 of "lan", 3, 0, 1), worked out by hand."""
    key = (0x6860FDEF, 3, 0, 1)
    words = np.random.PCG64(np.random.SeedSequence(7, spawn_key=key)).random_raw(44)
    uniforms = [word / 2**64 for word in words.tolist()]
    found = delays(replace(RELIABLE, jitter=0.008, p=0.3, r=0.7), 10, seed=7, run=3)
    bad = uniforms[0] < 0.3
    for i in range(10):
        turn, _, late, _ = uniforms[4 * (i + 1) : 4 * (i + 2)]
        expected = math.inf if bad else 0.008 + 0.008 * (2 * late - 1)
        assert found[i] == pytest.approx(expected, rel=1e-12, abs=1e-15)
        bad = turn < 0.3


def test_ways_runs_seeds_and_links_are_independent() -> None:
    law = replace(RELIABLE, jitter=0.008)
    rows = [
        PacketSource(law, link, sender, receiver, seed=seed, run=run).take(4000)
        for link, sender, receiver, seed, run in itertools.product(
            ["lan", "wan"], [0, 1], [2, 3], [0, 1], [0, 1]
        )
    ]
    apart = np.corrcoef(rows) - np.eye(len(rows))
    # 496 correlations of standard deviation 1/√4000: none beyond 5 of them, save once in 3500 seeds.
    assert np.abs(apart).max() < 5 / math.sqrt(4000)


@pytest.mark.parametrize("law", [BURSTS, JITTER, recorded(9, 3, math.inf, 20, 1)])
@pytest.mark.parametrize("newest", [True, False])
def test_it_does_not_matter_how_time_is_cut(law: ChannelLaw, newest: bool) -> None:
    ticks = np.arange(0, 6000, 3)
    whole = listener(law, newest=newest).hear(ticks)
    for pieces in (2000, 7, 450):
        ear = listener(law, newest=newest)
        parts = [ear.hear(part) for part in np.array_split(ticks, pieces)]
        assert np.concatenate([part.packets for part in parts]).tolist() == whole.packets.tolist()
        assert np.concatenate([part.missing for part in parts]).tolist() == whole.missing.tolist()


def test_what_is_remembered_does_not_grow_with_time() -> None:
    ear = listener(replace(JITTER, p=0.3, r=0.7), newest=False)
    for start in range(0, 80_000, 800):
        found = ear.hear(np.arange(start, start + 800))
        assert ear._under_way.shape[1] < 20
        assert len(ear._due) < 20
        assert ear.oldest <= found.packets[-1]
        assert found.packets[-1] - ear.oldest < 20


# ---- what a tick sees ----


@pytest.mark.parametrize(
    "comm", [Fraction(0), MS / 3, 3 * MS, 8 * MS, 8 * MS + MS / 7, 25 * MS, Fraction(1, 90)]
)
@pytest.mark.parametrize(
    ("haptic", "network"), [(MS, 8 * MS), (Fraction(1, 90), Fraction(1, 60)), (3 * MS, 7 * MS)]
)
def test_a_perfect_channel_is_the_reliable_schedule(
    comm: Fraction, haptic: Fraction, network: Fraction
) -> None:
    system = paper(comm=comm, haptic=haptic, network=network)
    patterns = [jacobians(kind).pattern for kind in system.kinds]
    [schedule] = build_schedules(system, resolve(system).timings, patterns)
    quantum, frames = schedule.quantum, 12
    slots = schedule.frame_s / network
    expected, ticks = [], []
    for frame in range(frames):
        for event in schedule.events:
            if isinstance(event, Tick):
                one = schedule.heard[event.heard[0][0]]
                expected.append(max(int((frame - one.lag) * slots) + one.sent.slot, START))
                ticks.append(int((frame * schedule.frame_s + event.index * haptic) / quantum))
    for newest in (True, False):
        law = replace(RELIABLE, delay=float(comm))
        source = PacketSource(law, "lan", 0, 1)
        ear = Listener(
            source,
            phase=0,
            period=int(network / quantum),
            delay=int(comm / quantum),
            quantum=quantum,
            newest=newest,
        )
        found = ear.hear(np.array(ticks))
        assert found.packets.tolist() == expected
        assert not found.missing.any()


def brute(law: ChannelLaw, ticks: list[int], *, newest: bool) -> tuple[list[int], list[bool]]:
    """Return what `Listener` should: every packet looked at again at every tick, to a picosecond."""
    late = [round(d * 1000, 9) if d < math.inf else None for d in delays(law, 400).tolist()]
    packets: list[int] = []
    missing: list[bool] = []
    for tick in ticks:
        arrived = [(8 * k + d, k) for k, d in enumerate(late) if d is not None and 8 * k + d <= tick]
        effective = max((k for _, k in arrived), default=-1) if newest else max(arrived, default=(0, -1))[1]
        packets.append(effective)
        gap = max((k for k, d in enumerate(late) if d is None and 8 * k + 8 <= tick), default=-1)
        missing.append(gap > effective)
    return packets, missing


@pytest.mark.parametrize("newest", [True, False])
@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto"])
def test_ticks_see_what_looking_at_every_packet_finds(distribution: str, newest: bool) -> None:
    law = replace(BURSTS, p=0.2, jitter=0.02, delay=0.02, distribution=distribution)
    ticks = list(range(2000))
    packets, missing = brute(law, ticks, newest=newest)
    found = listener(law, newest=newest).hear(np.array(ticks))
    assert found.packets.tolist() == packets
    assert found.missing.tolist() == missing
    assert any(np.diff(packets) < 0) != newest, "an older packet overwrites a newer one only if all count"


def test_a_late_older_packet_is_ignored_or_overwrites() -> None:
    law = recorded(20, 1, 1, math.inf)  # packets sent at 0, 8, 16, 24, … ms
    assert heard(law, 24) == [-1] * 9 + [1] * 8 + [2] * 7
    assert heard(law, 24, newest=False) == [-1] * 9 + [1] * 8 + [2] * 3 + [0] * 4


def test_a_recorded_delay_of_whole_ticks_is_seen_by_the_tick_it_arrives_at() -> None:
    """In floats 0.003/0.001 is 3, but 0.3/0.1 is not: neither may move a packet by a tick."""
    for quantum, delay in ((Fraction(1, 10), 0.3), (MS, 0.003), (Fraction(1, 90), 3 / 90), (MS, 0.007)):
        law = replace(RELIABLE, trace=np.array([delay]))
        whole = round(delay / float(quantum))
        ear = Listener(
            PacketSource(law, "lan", 0, 1), phase=0, period=50, delay=0, quantum=quantum, newest=True
        )
        assert ear.hear(np.array([whole - 1, whole])).packets.tolist() == [START, 0]


def test_a_trace_begins_again_when_it_ends() -> None:
    assert delays(recorded(1, 2, math.inf), 7).tolist() == [0.001, 0.002, math.inf] * 2 + [0.001]
    assert recorded(1, 2, math.inf).mean_loss == pytest.approx(1 / 3)


def test_a_packet_is_missing_from_when_it_was_due_until_a_newer_one_is_there() -> None:
    law = recorded(8, math.inf, 8, math.inf, math.inf, 11, 8)
    found = listener(law).hear(np.arange(64))
    # Packet 1 was due at 16, packet 2 came at 24; 3 was due at 32, 4 at 40; 5 came at 51.
    assert np.flatnonzero(found.missing).tolist() == [*range(16, 24), *range(32, 51)]
    assert found.packets[[7, 8, 23, 24, 50, 51, 56]].tolist() == [-1, 0, 0, 2, 2, 5, 6]


def test_no_ticks_hear_nothing() -> None:
    assert len(listener(BURSTS).hear(np.zeros(0, np.int64)).packets) == 0


# ---- a scene's numbers ----


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


def test_an_analysis_can_say_what_it_leaves_out() -> None:
    assert nominal_notes(compiled(AVERAGE)) == ()
    assert nominal_notes(compiled(unreliable("loss: 0 %, jitter: 0 ms"))) == ()
    [note] = nominal_notes(compiled(unreliable("loss: {p: 1 %, r: 25 %}, jitter: 2 ms")))
    assert note == (
        "packet loss (3.85 %) and jitter of lan are not in this verdict: every packet takes the nominal "
        "8 ms; see apc simulate"
    )
