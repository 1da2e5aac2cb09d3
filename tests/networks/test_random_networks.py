# ruff: noqa: E501 -- scenes are written by long lines
"""Random scenes over random networks: no verdict or bound contradicts second moments moved event by event.

Graphs, weights, groups, clocks, delays and components of all kinds; losses, bursts and jitter, hold and zero.
"""

from __future__ import annotations

import itertools
import math
import random
from fractions import Fraction

import pytest

import apc
from apc.compiler.components.library import Library
from apc.compiler.errors import ApcError
from tests.bench.random_scenes import own_library
from tests.networks.second_moments import MOST, Law, second_moment_radius, size_of
from tests.topologies import compiled

# What the iteration of the reference leaves of an eigenvalue; what an estimate may be off by.
ITERATED, ESTIMATED = 2e-9, 1e-4


def draw(generator: random.Random, *, quick: bool = False) -> tuple[str, dict[str, Law]]:
    """Return a scene at random, and the law of each of its links; `quick` has two peers."""
    peers = 2 if quick else generator.choice([2, 2, 3])
    haptic, network, late = generator.choice(
        [
            ("1 ms", "8 ms", ["0 s", "3 ms", "8 ms", "8 ms", "12 ms", "20 ms"]),
            ("2 ms", "4 ms", ["0 s", "1 ms", "4 ms", "7 ms"]),
            ("1 ms", "{period: 4 ms, phase: 0.7 ms}", ["0 s", "4 ms", "1.3 ms"]),
            ("2 ms", "3 ms", ["0 s", "3 ms", "4 ms"]),
            ("4 ms", "2 ms", ["0 s", "2 ms", "3 ms"]),
        ]
    )
    slow = generator.choice(["", "", ", slow: 2 ms"])
    clocks = f"clocks: {{haptic: {haptic}, network: {network}{slow}}}\n"
    groups = f"user: {{count: {peers}}}"
    if generator.random() < 0.4:
        own = f"device.mass: {generator.uniform(0.05, 0.3):.3f} kg, coordination.stiffness: {generator.uniform(50, 600):.1f} N/m"
        groups = f"one: {{count: 1, set: {{{own}}}}}\n  two: {{count: {peers - 1}}}"
    masses = f"masses:\n  device: {{mass: {generator.uniform(0.05, 0.2):.3f} kg, damping: {generator.uniform(1, 8):.2f} N*s/m}}\n"
    masses += f"  cube: {{mass: {generator.uniform(0.3, 1):.3f} kg, damping: {generator.uniform(2, 8):.2f} N*s/m, shared: true}}\n"
    other = "slow" if slow and generator.random() < 0.6 else "haptic"
    couplers = f"couplers:\n  contact: {{type: SampledSpringDamper, a: device, b: cube, stiffness: {generator.uniform(100, 900):.1f} N/m, damping: {generator.choice([0, 0, 1])} N*s/m, clock: {other}, delay: {generator.choice(['0 s', '1 ms', '1.5 ms'])}}}\n"
    graph, kinds = "", ["AveragePosition", "AveragePosition", "FullMesh"]
    shape = generator.random()
    if shape < 0.25 and peers == 3:
        graph = generator.choice(
            [
                ", graph: ring",
                ", graph: star",
                f", graph: {{edges: [[1, 2, {generator.uniform(0.3, 1.5):.2f}], [2, 3], [1, 3, 0.5]]}}",
                f", graph: {{arcs: [[1, 2], [2, 3, {generator.uniform(0.3, 1.5):.2f}], [3, 1]]}}",
                ", graph: {arcs: [[1, 2], [2, 3], [3, 2]]}",
            ]
        )
    elif shape < 0.4 and peers == 3:
        one = round(generator.uniform(0.1, 0.9), 2)
        graph = f", graph: {{arcs: [[2, 1, {one}], [3, 1, {1 - one:.2f}], [1, 2, 0.5], [3, 2, 0.5], [1, 3, 0.3], [2, 3, 0.7]]}}"
        kinds = ["WeightedMean", "AveragePosition"]
    if not graph and "one:" not in groups and generator.random() < 0.25:
        kinds = ["Expressions"]
    kind = generator.choice(kinds)
    damping = generator.choice(["0", "0", "1.5"])
    delay = generator.choice(["0 s", "1 ms", "2.5 ms"])
    clock = "slow" if slow and other == "haptic" else "haptic"
    stiffness = generator.uniform(100, 1400) / (1 if kind in ("AveragePosition", "WeightedMean") else peers)
    if kind == "Expressions":
        couplers += f"  coordination: {{type: Expressions, object: cube, stiffness: {stiffness:.1f} N/m, damping: 1 N*s/m, tau: {generator.choice([0.5, 3])} ms, clock: {clock}, link: lan, delay: {delay}}}\n"
    else:
        own = ", delays: own" if kind != "WeightedMean" and generator.random() < 0.2 else ""
        couplers += f"  coordination: {{type: {kind}, object: cube, stiffness: {stiffness:.1f} N/m, damping: {damping} N*s/m, clock: {clock}, delay: {delay}, link: lan{own}}}\n"
    if generator.random() < 0.2:
        couplers += f"  own: {{type: SampledIntegrator, a: device, b: cube, kp: 20 N/m, ki: 3 N/(m*s), kd: 0.2 N*s/m, leak: {generator.choice([0.9, 0.99])}, alpha: 0.5, period: 1 ms, clock: haptic, delay: 0 s}}\n"
    laws = {"lan": _law(generator, network, haptic)}
    late_now = generator.choice(late)
    if laws["lan"].jitter:
        earliest = float(laws["lan"].jitter * 1000)
        late_now = generator.choice([one for one in late if float(one.split()[0]) >= earliest] or [late[-1]])
        if float(late_now.split()[0]) < earliest:
            laws["lan"] = Law(0.2, 0.8)
    pairs = ""
    if "one:" in groups and generator.random() < 0.3:
        pairs = f", delays: {{one: {{two: {generator.choice(late)}}}}}"
        if laws["lan"].jitter:
            pairs = ""
    links = (
        f"links:\n  lan: {{clock: network, delay: {late_now}{graph}{pairs}{_said(laws['lan'], generator)}}}\n"
    )
    hands = ""
    if generator.random() < 0.25:
        hands = (
            "hands:\n  arm: {type: SpringDamperArm, flange: device, stiffness: 80 N/m, damping: 1 N*s/m}\n"
        )
    return (f"topology: network\n{clocks}peers:\n  {groups}\n{masses}{couplers}{links}{hands}", laws)


def _law(generator: random.Random, network: str, haptic: str) -> Law:
    zero = generator.random() < 0.4
    kind = generator.random()
    loss = generator.choice([0.01, 0.1, 0.2, 0.4, 0.7])
    if kind < 0.5:
        return Law(loss, 1 - loss, zero=zero)
    if kind < 0.75:
        r = 1 / generator.choice([1.5, 3, 10, 50])
        p = min(loss * r / (1 - loss), 0.9)
        if generator.random() < 0.4:
            return Law(p, r, generator.choice([0.9, 0.5]), generator.choice([0.0, 0.02]), zero=zero)
        return Law(p, r, zero=zero)
    jitter = Fraction(generator.choice(["1", "2", "3", "3.5"])) * Fraction(1, 1000)
    if generator.random() < 0.4:
        return Law(loss, 1 - loss, jitter=jitter)
    return Law(jitter=jitter, zero=zero)


def _said(law: Law, generator: random.Random) -> str:
    """Return a law as a link says it."""
    said = ""
    if law.p:
        if law.bad_loss == 1 and law.good_loss == 0 and law.independent and generator.random() < 0.7:
            said += f", loss: {100 * law.p!r} %"
        else:
            said += f", loss: {{p: {law.p!r}, r: {law.r!r}, 1-h: {law.bad_loss!r}, 1-k: {law.good_loss!r}}}"
    if law.jitter:
        said += f", jitter: {law.jitter * 1000} ms"
    return said + (", on_loss: zero" if law.zero else "")


def is_judged(text: str, laws: dict[str, Law], library: Library, most: int) -> bool:
    """Say whether a scene of no more numbers than `most` is judged; what is judged must be right."""
    try:
        system = compiled(text, library)
        told = apc.judge_network(system)
    except ApcError:
        return False
    if told is None or told.mean_square_radius is None or size_of(system, laws) > most:
        return False
    truth = second_moment_radius(system, laws)
    doubt = ITERATED * max(truth, 1.0)
    apart, room = (
        abs(told.mean_square_radius - truth),
        doubt + (told.error or 0.0 if told.exact else ESTIMATED),
    )
    if apart > room:  # the smaller of two eigenvalues near each other may have been found
        apart = abs(told.mean_square_radius - (truth := second_moment_radius(system, laws, several=6)))
    if math.isnan(truth):  # its iteration came to no end
        return False
    assert apart <= room, (told, truth, text)
    assert told.stable in (None, truth < 1) or abs(truth - 1) <= doubt, (told, truth, text)
    return True


@pytest.mark.parametrize(
    ("seed", "count", "quick"), [(1, 6, True), pytest.param(2, 20, False, marks=pytest.mark.whole)]
)
def test_random_scenes_agree_with_moments_followed_event_by_event(seed: int, count: int, quick: bool) -> None:
    most = 20_000 if quick else MOST
    with own_library() as library:
        drawn = (draw(random.Random(1_000_003 * seed + n), quick=quick) for n in itertools.count())
        judged = (is_judged(*one, library, most) for one in drawn)
        assert sum(itertools.islice(filter(None, judged), count)) == count
