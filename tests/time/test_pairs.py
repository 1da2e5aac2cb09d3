"""What peers make of each other pair by pair is what looking at each of them by hand gives."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.network.channel import ChannelLaw, PacketSource, channel_law
from apc.simulation.trajectory import simulate
from tests.lossy import effective
from tests.schemes import ByHand, Late, course
from tests.sites import MS
from tests.topologies import compiled, replaced

DURATION = Fraction(3, 10)
K, B, LIMIT = 500.0, 2.0, 1.5

# What a component says its force is, and the same by hand: of what the peer has (x, v, its force before, the
# time) and what it hears, with weights.
Heard = Sequence[tuple[float, float, float]]  # weight, x, v
Force = Callable[[float, float, float, float, Heard], float]


def limited(x: float, v: float, x_j: float, v_j: float) -> float:
    return max(-LIMIT, min(LIMIT, K * (x - x_j) + B * (v - v_j)))


def of_sum(x: float, v: float, f: float, t: float, received: Heard) -> float:
    return sum(w * limited(x, v, *one) for w, *one in received)


def of_mean(x: float, v: float, f: float, t: float, received: Heard) -> float:
    return of_sum(x, v, f, t, received) / sum(w for w, *_ in received)


def of_largest(x: float, v: float, f: float, t: float, received: Heard) -> float:
    return K * (x - max(one for _, one, _ in received))


def of_least_pull(x: float, v: float, f: float, t: float, received: Heard) -> float:
    return min(K * (x - x_j) * abs(x_j) / 0.01 + B * v for _, x_j, _ in received)


def of_memory_and_time(x: float, v: float, f: float, t: float, received: Heard) -> float:
    pulls = [(w, K * (x - x_j) + f / 4 + LIMIT * math.sin(100 * t)) for w, x_j, _ in received]
    return sum(w * max(-LIMIT, min(LIMIT, pull)) for w, pull in pulls)


def of_linear_sum(x: float, v: float, f: float, t: float, received: Heard) -> float:
    return sum(w * (K * (x - x_j) + B * (v - v_j)) for w, x_j, v_j in received)


def of_linear_mean(x: float, v: float, f: float, t: float, received: Heard) -> float:
    return of_linear_sum(x, v, f, t, received) / sum(w for w, *_ in received)


LIMITED = "max(-limit, min(limit, stiffness*(x - others.x) + damping*(v - others.v)))"
# Without words of its own the component is the library's.
FORCES: dict[str, tuple[str, Force]] = {
    "SaturatedMesh": ("", of_sum),
    "AveragePosition": ("", of_linear_mean),
    "FullMesh": ("", of_linear_sum),
    "sum": (f"sum({LIMITED})", of_sum),
    "mean": (f"mean({LIMITED})", of_mean),
    "max": ("stiffness*(x - max(others.x))", of_largest),
    "min": ("min(stiffness*(x - others.x)*abs(others.x)/scale + damping*v)", of_least_pull),
    "memory": (
        "sum(max(-limit, min(limit, stiffness*(x - others.x) + previous(f)/4 + limit*sin(rate*time))))",
        of_memory_and_time,
    ),
}

COMPONENT = """\
component: Odd
description: A coupling that looks at each peer by itself.
connectors: {object: Flange}
sends: {x: sample(object.x), v: sample(der(object.x))}
parameters:
  stiffness: {unit: N/m, min: 0}
  damping:   {unit: N*s/m, min: 0}
  limit:     {unit: N, default: 1.5 N}
  scale:     {unit: m, default: 10 mm}
  rate:      {unit: 1/s, default: 100 1/s}
  clock: clock
  link: link
  delay:     {unit: s, min: 0, default: 0 s}
variables:
  x: {unit: m}
  v: {unit: m/s}
  f: {unit: N, start: 0 N}
equations:
  - x = sample(object.x)
  - v = sample(der(object.x))
  - f = FORCE
  - object.f = hold(f, delay)
"""
X = (0.01, -0.004, 0.007, -0.012)


def topology(folder: Path, name: str, link: str) -> Model:
    """Return two near and two far peers whose bodies pull each other."""
    (folder / "parts").mkdir(exist_ok=True)
    force, _ = FORCES[name]
    (folder / "parts" / "odd.yaml").write_text(COMPONENT.replace("FORCE", force), encoding="utf-8")
    limit = "limit: 1.5 N" if force or name == "SaturatedMesh" else ""
    text = f"""\
topology: pairs
clocks: {{haptic: 1 ms, network: 8 ms}}
library: parts
peers:
  near: {{set: {{body.x: [10 mm, -4 mm]}}}}
  far:  {{set: {{body.x: [7 mm, -12 mm]}}}}
masses:
  body: {{mass: 0.1 kg, damping: 5 N*s/m}}
couplers:
  pull:
    type: {"Odd" if force else name}
    object: body
    stiffness: 500 N/m
    damping: 2 N*s/m
    {limit}
    clock: haptic
    delay: 1 ms
    link: lan
links:
  lan: {{clock: network, {link}}}
"""
    (folder / "topology.yaml").write_text(text, encoding="utf-8")
    return compile_topology(folder / "topology.yaml")


ArcWeights = Mapping[tuple[int, int], float]  # the weight of each (sender, receiver)
COMPLETE: ArcWeights = {(i, j): 1.0 for i in range(4) for j in range(4) if i != j}


def by_hand(force: Force, arcs: ArcWeights, late: Late, *, zero: bool = False) -> NDArray[np.float64]:
    """Return every body's x and v at each ms; `late` says which packet counts on a way at a tick."""

    def law(i: int, motion: Any, received: Any, memory: Any) -> tuple[Any, Any, Any]:
        weighted = [(arcs[j, i], *packet[:2]) for j, packet in received.items()]
        f = force(*motion[0], memory[0], memory[1] / 1000, weighted)
        return [-f], [f, memory[1] + 1], []

    receives = [[j for j in range(4) if (j, i) in arcs] for i in range(4)]
    scheme = ByHand([[(0.1, 5.0, 0.0)]] * 4, receives, law, first_sent=0, memory=2, late=late, zero=zero)
    rows = itertools.islice(course(scheme, [[(x, 0.0)] for x in X], [[0.0, 0]] * 4), int(DURATION / MS) + 1)
    return np.array([[one for motion in now.motion for body in motion for one in body] for now in rows])


def punctual(delays: Callable[[int, int], int]) -> Late:
    return lambda i, j, tick: (max(-1, (tick - delays(i, j)) // 8), False)


def check(model: Model, expected: NDArray[np.float64], *, seed: int = 0, jit: bool = False) -> None:
    found = simulate(model, duration=DURATION, signals=["body.*"], jit=jit, seed=seed)
    assert np.abs(expected).max() > 0.01
    # 300 steps: what rounding leaves, 1e-12 of the largest velocity.
    np.testing.assert_allclose(found.values, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


ARCS: ArcWeights = {
    (0, 1): 0.5,
    (2, 1): 2.0,
    (3, 1): 1.0,
    (1, 0): 1.0,
    (3, 2): 3.0,
    (0, 3): 0.25,
    (1, 3): 1.5,
}
GRAPHS: dict[str, ArcWeights] = {
    "": COMPLETE,
    "ring": {(i, j): 1.0 for i in range(4) for j in ((i + 1) % 4, (i - 1) % 4)},
    "star": {(i, j): 1.0 for i in range(4) for j in range(4) if (i == 0) != (j == 0)},
    f"{{arcs: [{', '.join(f'[{i + 1}, {j + 1}, {w}]' for (i, j), w in ARCS.items())}]}}": ARCS,
}
OWN = "8 ms, delays: {near: {far: 19 ms}, far: {near: 2 ms}}"


@pytest.mark.few(4)
@pytest.mark.parametrize("name", FORCES)
@pytest.mark.parametrize(
    ("graph", "delay"),
    [*zip(GRAPHS, ("0 ms", "3 ms", "8 ms", "21 ms"), strict=True), ("", OWN), ([*GRAPHS][-1], OWN)],
)
def test_each_pair_is_what_looking_at_every_packet_gives(
    tmp_path: Path, name: str, graph: str, delay: str
) -> None:
    """With one delay for all, or pairs of groups with delays of their own; only who is tied is looked at."""
    _, force = FORCES[name]
    model = topology(tmp_path, name, f"delay: {delay}" + (f", graph: {graph}" if graph else ""))

    def late(i: int, j: int) -> int:
        own = delay == OWN and i // 2 != j // 2
        return (19 if i < j else 2) if own else int(delay.partition(" ")[0])

    check(model, by_hand(force, GRAPHS[graph], punctual(late)))


@pytest.mark.few(1)
@pytest.mark.parametrize("name", FORCES)
@pytest.mark.parametrize(
    ("more", "graph"),
    [
        ("loss: {p: 10 %, r: 30 %}", "ring"),
        ("loss: 30 %, on_loss: zero", ""),
        ("jitter: 6 ms", ""),
        ("jitter: 25 ms, distribution: pareto, reorder: all", ""),
        ("loss: 20 %, jitter: 9 ms, distribution: normal, on_loss: zero", ""),
        ("loss: 20 %, jitter: 9 ms, distribution: normal, reorder: all, on_loss: zero", "star"),
    ],
)
def test_a_lost_packet_is_missed_by_its_pair_alone(tmp_path: Path, name: str, more: str, graph: str) -> None:
    _, force = FORCES[name]
    model = topology(tmp_path, name, f"delay: 8 ms, {more}" + (f", graph: {graph}" if graph else ""))
    law = channel_law(model, model.links[0], model.links[0].delay)
    arcs = GRAPHS[graph]
    late = {arc: PacketSource(law, "lan", [arc], seed=3).take(50)[0].tolist() for arc in arcs}

    def packet(i: int, j: int, tick: int) -> tuple[int, bool]:
        return effective(late[i, j], tick, newest="all" not in more)

    expected = by_hand(force, arcs, packet, zero="zero" in more)
    for jit in (False, True):
        check(model, expected, seed=3, jit=jit)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", FORCES)
@pytest.mark.parametrize("graph", ["", [*GRAPHS][-1]])
def test_each_pair_of_groups_loses_and_delays_by_its_own_law(tmp_path: Path, name: str, graph: str) -> None:
    """What a pair does not say is the link's; of losses, only those from near to far are replaced by zero."""
    _, force = FORCES[name]
    pairs = "near: {far: {loss: 40 %, on_loss: zero}}"
    pairs += ", far: {far: {loss: 0 %}, near: {delay: 19 ms, jitter: 6 ms}}"
    graphed = f", graph: {graph}" if graph else ""
    model = topology(tmp_path, name, f"delay: 8 ms, loss: 10 %, pairs: {{{pairs}}}{graphed}")
    plain = ChannelLaw(0.1, 0.9, 1.0, 0.0, 0.008, 0.0, "uniform", None)
    laws = {
        (False, False): plain,
        (False, True): replace(plain, p=0.4, r=0.6),
        (True, True): replace(plain, p=0.0, r=1.0),
        (True, False): replace(plain, delay=0.019, jitter=0.006),
    }
    late = {
        arc: PacketSource(laws[arc[0] >= 2, arc[1] >= 2], "lan", [arc], seed=3).take(50)[0].tolist()
        for arc in GRAPHS[graph]
    }

    def packet(i: int, j: int, tick: int) -> tuple[int, bool]:
        number, missing = effective(late[i, j], tick, newest=True)
        return number, missing and i < 2 <= j

    expected = by_hand(force, GRAPHS[graph], packet, zero=True)
    for jit in (False, True):
        check(model, expected, seed=3, jit=jit)


def test_nobody_has_no_maximum(tmp_path: Path) -> None:
    with pytest.raises(
        ApcError, match=r"E801 far\[2\] has no incoming connection over lan, so max\(\) is undefined"
    ):
        topology(tmp_path, "max", "delay: 8 ms, graph: {arcs: [[1, 2], [2, 1], [1, 3]]}")


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
