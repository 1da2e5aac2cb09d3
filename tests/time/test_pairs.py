"""What peers make of each other pair by pair is what looking at each of them by hand gives."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.network.channel import PacketSource, channel_law
from apc.simulation.trajectory import simulate
from tests.eventwise import MS, coast
from tests.pairs import FORCES, Force, X, scene
from tests.topologies import MESH, compiled, replaced

DURATION = Fraction(3, 10)
Ways = Mapping[tuple[int, int], float]  # the weight of each (sender, receiver)
COMPLETE: Ways = {(i, j): 1.0 for i in range(4) for j in range(4) if i != j}


def effective(late: list[float], tick: int, *, newest: bool) -> tuple[int, bool]:
    """Return the packet in effect on a way at a tick, and whether one is missing; times in ms, to 1 ps."""
    arrivals = [(8 * k + round(1000 * d, 9), k) for k, d in enumerate(late) if d < math.inf]
    arrived = [(at, k) for at, k in arrivals if at <= tick]
    number = max((k for _, k in arrived), default=-1) if newest else max(arrived, default=(0, -1))[1]
    gap = max((k for k, d in enumerate(late) if d == math.inf and 8 * k + 8 <= tick), default=-1)
    return number, gap > number


def by_hand(
    force: Force, ways: Ways, late: Callable[[int, int, int], tuple[int, bool]], *, zero: bool = False
) -> NDArray[np.float64]:
    """Return every body's x and v at each ms; `late` says which packet counts on a way at a tick."""
    motion = [(x, 0.0) for x in X]
    start = list(motion)
    sent: list[list[tuple[float, float]]] = [[] for _ in X]
    acting = [0.0] * 4
    rows = []
    for tick in range(int(DURATION / MS) + 1):
        rows.append([one for m in motion for one in m])
        if tick % 8 == 0:
            for i, m in enumerate(motion):
                sent[i].append(m)
        computed = []
        for j, m in enumerate(motion):
            heard = []
            for (i, receiver), weight in ways.items():
                if receiver == j:
                    number, missing = late(i, j, tick)
                    packet = sent[i][number] if number >= 0 else start[i]
                    heard.append((weight, *(m if missing and zero else packet)))
            computed.append(force(*m, acting[j], tick / 1000, heard))
        motion = [coast(*m, -f, 0.1, 5.0, 0.001) for m, f in zip(motion, acting, strict=True)]
        acting = computed  # each acts a tick after it was computed
    return np.array(rows)


def punctual(delays: Callable[[int, int], int]) -> Callable[[int, int, int], tuple[int, bool]]:
    return lambda i, j, tick: (max(-1, (tick - delays(i, j)) // 8), False)


def check(system: CompiledSystem, expected: NDArray[np.float64], seed: int = 0) -> None:
    found = simulate(system, duration=DURATION, signals=["body.*"], jit=False, seed=seed)
    assert np.abs(expected).max() > 0.01
    # 300 steps: what rounding leaves, 1e-12 of the largest velocity.
    np.testing.assert_allclose(found.values, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


ARCS: Ways = {(0, 1): 0.5, (2, 1): 2.0, (3, 1): 1.0, (1, 0): 1.0, (3, 2): 3.0, (0, 3): 0.25, (1, 3): 1.5}
GRAPHS: dict[str, Ways] = {
    "": COMPLETE,
    "ring": {(i, j): 1.0 for i in range(4) for j in ((i + 1) % 4, (i - 1) % 4)},
    "star": {(i, j): 1.0 for i in range(4) for j in range(4) if (i == 0) != (j == 0)},
    f"{{arcs: [{', '.join(f'[{i + 1}, {j + 1}, {w}]' for (i, j), w in ARCS.items())}]}}": ARCS,
}
OWN = "8 ms, delays: {near: {far: 19 ms}, far: {near: 2 ms}}"


@pytest.mark.few(12)
@pytest.mark.parametrize("name", FORCES)
@pytest.mark.parametrize("graph", GRAPHS)
@pytest.mark.parametrize("delay", ["0 ms", "3 ms", "8 ms", "21 ms", OWN])
def test_each_pair_is_what_looking_at_every_packet_gives(
    tmp_path: Path, name: str, graph: str, delay: str
) -> None:
    """With one delay for all, or pairs of groups with delays of their own; only who is tied is looked at."""
    text, force = FORCES[name]
    system = scene(tmp_path, text, f"delay: {delay}" + (f", graph: {graph}" if graph else ""))

    def late(i: int, j: int) -> int:
        own = delay == OWN and i // 2 != j // 2
        return (19 if i < j else 2) if own else int(delay.partition(" ")[0])

    check(system, by_hand(force, GRAPHS[graph], punctual(late)))


@pytest.mark.few(5)
@pytest.mark.parametrize("name", FORCES)
@pytest.mark.parametrize(
    ("more", "graph"),
    [
        ("loss: {p: 10 %, r: 30 %}", "ring"),
        ("loss: 30 %, on_loss: zero", ""),
        ("loss: 20 %, jitter: 9 ms, distribution: normal, reorder: all, on_loss: zero", "star"),
    ],
)
def test_a_lost_packet_is_missed_by_its_pair_alone(tmp_path: Path, name: str, more: str, graph: str) -> None:
    text, force = FORCES[name]
    system = scene(tmp_path, text, f"delay: 8 ms, {more}" + (f", graph: {graph}" if graph else ""))
    law = channel_law(system, system.links[0], 8 * MS)
    ways = GRAPHS[graph]
    late = {way: PacketSource(law, "lan", [way], seed=3).take(50)[0].tolist() for way in ways}

    def packet(i: int, j: int, tick: int) -> tuple[int, bool]:
        return effective(late[i, j], tick, newest="all" not in more)

    check(system, by_hand(force, ways, packet, zero="zero" in more), seed=3)


def test_a_mesh_whose_limit_is_never_reached_is_a_full_mesh() -> None:
    start = "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm], cube.x: [2 mm, 0 mm, 1 mm]}}"
    text = replaced(MESH, ("{count: 3}", start))
    mesh = simulate(compiled(text), duration=DURATION, jit=False)
    for limit, alike in (("5 kN", True), ("0.1 N", False)):
        odd = compiled(replaced(text, ("type: FullMesh", f"type: SaturatedMesh, limit: {limit}")))
        apart = np.abs(simulate(odd, duration=DURATION, jit=False).values - mesh.values).max()
        assert (apart < 1e-12 * np.abs(mesh.values).max()) == alike


def test_nobody_has_no_maximum(tmp_path: Path) -> None:
    with pytest.raises(ApcError, match=r"E801 far\[2\] hears nobody over lan: there is no max over nobody"):
        scene(tmp_path, FORCES["max"][0], "delay: 8 ms, graph: {arcs: [[1, 2], [2, 1], [1, 3]]}")


SOME_SEND = """\
topology: some-send
clocks: {haptic: 1 ms, network: 8 ms}
peers:
  near: {set: {body.x: [10 mm, -4 mm]}}
  far:  {set: {body.x: [7 mm, -12 mm]}}
masses:
  body: {mass: 0.1 kg, damping: 5 N*s/m}
couplers:
  pull: {type: AveragePosition, at: [near], object: body, stiffness: 500 N/m, clock: haptic, link: lan}
links:
  lan: {clock: network, delay: 8 ms}
"""


@pytest.mark.parametrize("link", ["", ", graph: ring", ", loss: 0 %", ", graph: ring, loss: 0 %"])
def test_who_sends_nothing_counts_in_no_mean(link: str) -> None:
    """Two of four peers send: each hears the other one whole, whatever else it is tied to."""
    two = replaced(SOME_SEND, ("  far:  {set: {body.x: [7 mm, -12 mm]}}\n", ""), (" at: [near],", ""))
    text = replaced(SOME_SEND, ("delay: 8 ms}", f"delay: 8 ms{link}}}"))
    found, expected = (
        simulate(compiled(one), duration=DURATION / 3, signals=["near*"], jit=False).values
        for one in (text, two)
    )
    assert np.ptp(expected, axis=0).max() > 0.005
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-14)
