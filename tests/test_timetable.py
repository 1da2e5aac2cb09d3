"""Claims about `apc.network.timetable`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.frame.exchange import build_exchange
from apc.frame.parameters import resolve
from apc.network.channel import PacketSource, channel_law
from apc.network.timetable import Listener, Timetable, luck_of, routes_of
from tests.sites import MS
from tests.topologies import AVERAGE, compiled, replaced

LINK = "  lan: {clock: network, delay: 8 ms}"
JITTER = "loss: 20 %, jitter: 9 ms, distribution: pareto"


def system_of(more: str, *changes: tuple[str, str]) -> CompiledSystem:
    return compiled(replaced(AVERAGE, (LINK, f"{LINK[:-1]}, {more}}}"), *changes))


def timetable(system: CompiledSystem, *, seed: int = 0, run: int = 0, quantum: Fraction = MS) -> Timetable:
    timings = resolve(system).timings
    exchange = build_exchange(system, timings)
    routes = routes_of(system, timings, exchange, 8 * MS)
    lucks = [luck_of(system, timings, exchange, route, quantum) for route in routes]
    return Timetable(routes, lucks, seed=seed, run=run)


def test_a_scene_of_reliable_links_has_no_timetable() -> None:
    assert timetable(compiled(AVERAGE)).routes == ()
    assert timetable(compiled(AVERAGE)).take(8) == ()


def test_each_way_is_what_its_own_listener_hears() -> None:
    system = system_of(JITTER)
    table = timetable(system, seed=5, run=2)
    [route] = table.routes
    assert (route.link, route.clock, route.zero) == ("lan", "haptic", False)
    assert sorted(map(tuple, route.pairs.tolist())) == [(i, j) for i in range(3) for j in range(3) if i != j]
    [seen] = table.take(400)
    assert seen.packets.shape == (400, 6)
    law = channel_law(system, system.links[0], 8 * MS)
    for way, (sender, receiver) in enumerate(route.pairs.tolist()):
        source = PacketSource(law, "lan", [(sender, receiver)], seed=5, run=2)
        alone = Listener(source, phase=0, period=8, delay=8, quantum=MS, newest=True).hear(np.arange(400))
        assert seen.packets[:, way].tolist() == alone.packets[:, 0].tolist()
        assert seen.missing[:, way].tolist() == alone.missing[:, 0].tolist()


def test_it_goes_on_where_it_ended() -> None:
    whole = timetable(system_of(JITTER)).take(1000)[0]
    table = timetable(system_of(JITTER))
    parts = [table.take(until)[0] for until in (0, 1, 8, 300, 301, 1000)]
    assert np.concatenate([part.packets for part in parts]).tolist() == whole.packets.tolist()
    assert np.concatenate([part.missing for part in parts]).tolist() == whole.missing.tolist()


def test_more_peers_change_nothing_for_those_who_were_there() -> None:
    few, many = timetable(system_of(JITTER)), timetable(system_of(JITTER, ("count: 3", "count: 5")))
    seen = {}
    for name, table in (("few", few), ("many", many)):
        [one] = table.take(300)
        pairs = map(tuple, table.routes[0].pairs.tolist())
        seen[name] = {pair: one.packets[:, way].tolist() for way, pair in enumerate(pairs)}
    assert len(seen["many"]) == 20
    assert all(seen["many"][pair] == packets for pair, packets in seen["few"].items())


def test_clocks_and_graphs_and_delays_between_groups_are_kept() -> None:
    groups = (
        "  user: {count: 3}",
        "  near: {count: 2}\n  far: {count: 1, set: {coordination.clock: slow}}",
    )
    clocks = ("  haptic: 1 ms", "  haptic: 1 ms\n  slow: {period: 2 ms, phase: 1 ms}")
    system = system_of(
        "loss: 0 %, graph: {arcs: [[1, 2, 0.5], [2, 1], [3, 1], [1, 3]]}, delays: {far: {near: 20 ms}}",
        groups,
        clocks,
    )
    fast, slow = timetable(system).routes
    assert (fast.clock, fast.pairs.tolist(), fast.weights.tolist()) == (
        "haptic",
        [[1, 0], [2, 0], [0, 1]],
        [1, 1, 0.5],
    )
    assert (slow.clock, slow.pairs.tolist()) == ("slow", [[0, 2]])
    assert (fast.longest, slow.longest) == (0.02, 0.02)
    assert [(one.ticks, one.slots, one.frames) for one in (fast, slow)] == [(8, 1, 4), (4, 1, 4)]
    near, far = timetable(system).take(60)
    ticks = np.arange(60)
    assert near.packets[:, 0].tolist() == np.maximum((ticks - 8) // 8, -1).tolist()
    assert near.packets[:, 1].tolist() == np.maximum((ticks - 20) // 8, -1).tolist()
    assert far.packets[:, 0].tolist() == np.maximum((ticks[1::2] - 8) // 8, -1).tolist()


def test_no_packet_arrives_later_than_the_longest_delay() -> None:
    for more in ("jitter: 9 ms", "jitter: 9 ms, distribution: normal", "jitter: 9 ms, distribution: pareto"):
        system = system_of(more)
        [route] = timetable(system).routes
        law = channel_law(system, system.links[0], 8 * MS)
        delays = PacketSource(law, "lan", [(0, 1)]).take(200_000)
        assert delays.max() <= route.longest
    assert route.longest == pytest.approx(0.008 + 4 * 0.009)


def test_too_many_ways_are_refused() -> None:
    with pytest.raises(ApcError, match=r"E892 lan is unreliable, and 2000 peers .* 3998000 ways"):
        timetable(system_of("loss: 1 %", ("count: 3", "count: 2000")))
    assert (
        len(timetable(system_of("loss: 1 %, graph: ring", ("count: 3", "count: 500"))).routes[0].pairs)
        == 1000
    )


@pytest.mark.parametrize("on_loss", ["hold", "zero"])
def test_a_delay_of_more_parts_than_can_be_counted_is_refused(on_loss: str) -> None:
    system = system_of(f"loss: 1 %, on_loss: {on_loss}", ("delay: 8 ms,", "delay: 2 s,"))
    with pytest.raises(ApcError, match=r"E892 lan is unreliable, .* parts of 1e-12 s"):
        timetable(system, quantum=Fraction(1, 10**12))


def test_more_packets_on_their_way_than_can_be_kept_are_refused() -> None:
    """A thousand peers, 999,000 ways; 10 s are 1,250 packets of each."""
    changes = ("count: 3", "count: 1000"), ("delay: 8 ms,", "delay: 10 s,")
    with pytest.raises(ApcError, match=r"E892 lan is unreliable, .* 999000 ways .* at most 536870912"):
        timetable(system_of("loss: 1 %", *changes))
