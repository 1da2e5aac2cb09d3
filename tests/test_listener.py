"""Claims about `apc.network.timetable`."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.frame.schedule import Tick
from apc.frame.scheduling import build_schedules
from apc.network.channel import ChannelLaw, PacketSource
from apc.network.timetable import START, Listener
from tests.lossy import BURSTS, JITTER, RELIABLE, delays, recorded
from tests.sites import MS, paper


def listener(
    law: ChannelLaw, *pairs: tuple[int, int], newest: bool = True, quantum: Fraction = MS
) -> Listener:
    source = PacketSource(law, "lan", pairs or [(0, 1)])
    return Listener(source, newest=newest, phase=0, period=8, delay=8, quantum=quantum)


def heard(law: ChannelLaw, ticks: int, *, newest: bool = True) -> list[int]:
    return [int(one) for one in listener(law, newest=newest).hear(np.arange(ticks)).packets[:, 0]]


@pytest.mark.few(3)
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
    ear = listener(replace(JITTER, p=0.3, r=0.7), (0, 1), (1, 0), newest=False)
    for start in range(0, 80_000, 800):
        ear.hear(np.arange(start, start + 800))
        assert ear.remembered < 40


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
        source = PacketSource(law, "lan", [(0, 1)])
        ear = Listener(
            source,
            phase=0,
            period=int(network / quantum),
            delay=int(comm / quantum),
            quantum=quantum,
            newest=newest,
        )
        found = ear.hear(np.array(ticks))
        assert found.packets[:, 0].tolist() == expected
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
    # The way that is looked at is one of three that are heard together.
    found = listener(law, (3, 1), (0, 1), (0, 2), newest=newest).hear(np.array(ticks))
    assert found.packets[:, 1].tolist() == packets
    assert found.missing[:, 1].tolist() == missing
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
        found = listener(law, quantum=quantum).hear(np.array([whole - 1, whole]))
        assert found.packets[:, 0].tolist() == [START, 0]


def test_a_packet_is_missing_from_when_it_was_due_until_a_newer_one_is_there() -> None:
    law = recorded(8, math.inf, 8, math.inf, math.inf, 11, 8)
    found = listener(law).hear(np.arange(64))
    # Packet 1 was due at 16, packet 2 came at 24; 3 was due at 32, 4 at 40; 5 came at 51.
    assert np.flatnonzero(found.missing[:, 0]).tolist() == [*range(16, 24), *range(32, 51)]
    assert found.packets[[7, 8, 23, 24, 50, 51, 56], 0].tolist() == [-1, 0, 0, 2, 2, 5, 6]


def test_no_ticks_hear_nothing() -> None:
    assert len(listener(BURSTS).hear(np.zeros(0, np.int64)).packets) == 0


def test_ways_heard_together_are_what_each_hears_alone() -> None:
    pairs = [(i, j) for i in range(4) for j in range(4) if i != j]
    for newest in (True, False):
        law = replace(JITTER, p=0.2)
        together = listener(law, *pairs, newest=newest).hear(np.arange(900))
        for way, pair in enumerate(pairs):
            alone = listener(law, pair, newest=newest).hear(np.arange(900))
            assert alone.packets[:, 0].tolist() == together.packets[:, way].tolist()
            assert alone.missing[:, 0].tolist() == together.missing[:, way].tolist()
