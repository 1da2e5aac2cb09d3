# ruff: noqa: E501 -- scenes are written by long lines
"""Random scenes over lossy networks, each verdict and bound against `second_moments`: `python -m tests.random_networks`.

Two or three peers: groups with numbers of their own, mixed clocks, components of one's own, weights, delays of
any length, links that differ; losses, bursts and jitter, hold and zero.
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction

from apc.compiler.compiled import CompiledSystem
from apc.compiler.components.library import Library
from apc.compiler.errors import ApcError
from apc.moments.network import NetworkVerdict, judge_network
from tests.bench.random_scenes import own_library
from tests.second_moments import MOST, Law, _Played, second_moment_radius
from tests.topologies import compiled

# What the iteration of the reference leaves of an eigenvalue.
ITERATED = 2e-9

# What an estimate may be off by.
ESTIMATED = 1e-4

# Numbers of all second moments that a quick run follows.
FEW = 20_000

# Draws after which a long run says how far it is.
EVERY = 10

MILLISECOND = Fraction(1, 1000)


@dataclass(frozen=True, slots=True)
class Draw:
    """A scene as text, and the law of each of its links."""

    text: str
    laws: dict[str, Law]


def draw(generator: random.Random, *, quick: bool = False) -> Draw:
    """Return a scene at random; `quick` has two peers."""
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
    if generator.random() < 0.2:
        laws["wan"] = _law(generator, network, haptic, plain=True) if generator.random() < 0.6 else Law()
        second = generator.choice(["network", "network", "haptic"]) if "8 ms" not in network else "network"
        couplers += f"  second: {{type: FullMesh, object: device, stiffness: {generator.uniform(20, 150):.1f} N/m, clock: haptic, delay: 0 s, link: wan}}\n"
        links += (
            f"  wan: {{clock: {second}, delay: {generator.choice(late)}{_said(laws['wan'], generator)}}}\n"
        )
    hands = ""
    if generator.random() < 0.25:
        hands = (
            "hands:\n  arm: {type: SpringDamperArm, flange: device, stiffness: 80 N/m, damping: 1 N*s/m}\n"
        )
    return Draw(f"topology: network\n{clocks}peers:\n  {groups}\n{masses}{couplers}{links}{hands}", laws)


def _law(generator: random.Random, network: str, haptic: str, *, plain: bool = False) -> Law:
    zero = generator.random() < 0.4
    kind = generator.random()
    loss = generator.choice([0.01, 0.1, 0.2, 0.4, 0.7])
    if kind < 0.5 or plain:
        return Law(loss, 1 - loss, zero=zero)
    if kind < 0.75:
        r = 1 / generator.choice([1.5, 3, 10, 50])
        p = min(loss * r / (1 - loss), 0.9)
        if generator.random() < 0.4:
            return Law(p, r, generator.choice([0.9, 0.5]), generator.choice([0.0, 0.02]), zero=zero)
        return Law(p, r, zero=zero)
    jitter = Fraction(generator.choice(["1", "2", "3", "3.5"])) * MILLISECOND
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


@dataclass
class Tally:
    """What came out."""

    judged: int = 0
    stable: int = 0
    too_large: int = 0
    slow: int = 0  # the reference's iteration came to no end
    beyond: int = 0  # refused by the compiler or the analysis
    undecided: int = 0
    unserved: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    nearest: float = 0.0  # the largest difference, relatively

    def __str__(self) -> str:
        """Return a few lines."""
        why = "\n".join(f"  {count:4} {text}" for text, count in self.unserved.most_common())
        return (
            f"{self.judged} judged, {self.stable} of them stable, {self.undecided} undecided, {len(self.wrong)} wrong; "
            f"largest difference {self.nearest:.1e}; {self.too_large} too large, {self.slow} without a reference, {self.beyond} refused, not judged:\n{why}"
        )


def check(one: Draw, library: Library, tally: Tally, most: int = MOST) -> None:
    """Judge a scene and compare."""
    try:
        system = compiled(one.text, library)
        told = judge_network(system)
    except ApcError as error:
        tally.beyond += 1
        tally.unserved[f"{error}".splitlines()[0].partition(": ")[2]] += 1
        return
    if told is None or told.mean_square_radius is None:
        tally.unserved["reliable" if told is None else told.notes[0]] += 1
        return
    if _size(system, one.laws) > most:
        tally.too_large += 1
        return
    truth = second_moment_radius(system, one.laws)
    if _wrong(told, truth):
        truth = second_moment_radius(system, one.laws, thorough=True)
    if math.isnan(truth):
        tally.slow += 1
        return
    tally.judged += 1
    tally.stable += bool(told.stable)
    tally.undecided += told.stable is None
    tally.nearest = max(tally.nearest, abs(told.mean_square_radius - truth) / truth)
    if _wrong(told, truth):
        tally.wrong.append(
            f"{told.mean_square_radius} ± {told.error}, {told.verdict}; truth {truth}\n{one.text}"
        )


def _wrong(told: NetworkVerdict, truth: float) -> bool:
    """Say whether a verdict is wrong, or the radius beyond its bound."""
    assert told.mean_square_radius is not None
    assert told.error is not None
    doubt = ITERATED * max(truth, 1.0)
    apart = abs(told.mean_square_radius - truth)
    if told.stable is not None and abs(truth - 1) > doubt and told.stable != (truth < 1):
        return True
    return apart > told.error + doubt if told.exact else apart > ESTIMATED


def _size(system: CompiledSystem, laws: dict[str, Law]) -> int:
    """Return how many numbers the reference moves."""
    laid = _Played.__new__(_Played)
    laid.lay_out(system, laws)
    return math.prod(way.states for way in laid.ways) * laid.size**2


def run(
    count: int, *, seed: int = 0, quick: bool = False, told: Callable[[int, Tally], None] | None = None
) -> Tally:
    """Judge so many scenes; `told` is told after each draw how many there were and what came out so far."""
    tally = Tally()
    with own_library() as library:
        number = 0
        while tally.judged < count:
            one = draw(random.Random(1_000_003 * seed + number), quick=quick)
            check(one, library, tally, FEW if quick else MOST)
            number += 1
            if told is not None:
                told(number, tally)
    return tally


def _progress(start: float) -> Callable[[int, Tally], None]:
    """Return what prints each wrong verdict as it comes, and every `EVERY` draws the tally so far."""
    shown = 0

    def told(number: int, tally: Tally) -> None:
        nonlocal shown
        for text in tally.wrong[shown:]:
            print(f"wrong, draw {number - 1}: {text}", flush=True)
        shown = len(tally.wrong)
        if number % EVERY == 0:
            first = f"{tally}".partition(", not judged:")[0]
            print(f"{number} draws, {time.perf_counter() - start:.0f} s: {first}", flush=True)

    return told


if __name__ == "__main__":
    count, seed = (*(int(one) for one in sys.argv[1:]), *(500, 0)[len(sys.argv) - 1 :])
    start = time.perf_counter()
    found = run(count, seed=seed, told=_progress(start))
    print(found, f"{time.perf_counter() - start:.0f} s", sep="\n")
    sys.exit(bool(found.wrong))
