"""The topologies whose spectral radius is known, with where the number comes from and what it may be off by.

Takes: nothing. Gives: `Case`, `CASES`, `Truth`; `model`, `truth` of a case, each made once.
Guarantees: no number here was computed by what it judges. `hard` are the stored fifty digits of tests/hard,
`library` the topologies that come with apc and `stiff` ones, followed in fifty digits when they are asked
for; `reference` the numbers of `tests.reference`; `closed` formulas, by hand; `stepped` all peers, one by
one.
Does not: say anything of the modes but the largest (see `many_users/test_bounds.py`).
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint

import apc
from apc.spectrum.ball_arithmetic import precision
from tests.bruteforce import TopologySource, as_ball, frame_matrix
from tests.fifty_digits.truth import RIGID, spectral_truth
from tests.reference import MIDPOINT_RADIUS, OPERATORS
from tests.topologies import ONE_MASS, OSCILLATOR, ROOT, compiled

TRANSLATING = "stable up to a common translation"
STORED: dict[str, dict[str, Any]] = json.loads((ROOT / "tests" / "hard" / "truths.json").read_text("utf-8"))
LIBRARY = sorted((ROOT / "models" / "topologies").glob("*.yaml")) + sorted(
    (ROOT / "tests" / "small_topologies").glob("*.yaml")
)

# Linearizations of which no truth is to be had event by event, and why; they are played by hand elsewhere.
UNTOLD = {
    "carried-beam": "contain functions whose values are rounded",
    "god-object": "contain functions whose values are rounded",
    "limited-motor": "is not linear",
    "three-users-scheduled": "looks at each sender by itself",
    "two-users-passivity": "not linear in what it hears",
    "two-users-set-position": "contain functions whose values are rounded",
}


@dataclass(frozen=True, slots=True)
class Truth:
    """The spectral radius without what is rigid, right to `error`, and the verdict ("" if not told)."""

    radius: Any  # flint.arb
    rigid: int
    error: float = 1e-45
    verdict: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """A topology by what makes it, and its truth by what computes that."""

    name: str
    source: str
    build: Callable[[], apc.Model]
    tell: Callable[[], Truth]

    def __str__(self) -> str:
        return f"{self.source}: {self.name}"


def _stored(path: Path) -> Case:
    reported = STORED[path.stem]

    def tell() -> Truth:
        with precision(256):
            return Truth(
                flint.arb(reported["spectral_radius"]), reported["rigid_modes"], 1e-45, reported["verdict"]
            )

    return Case(path.stem, "hard", lambda: apc.compile(path), tell)


def _followed(name: str, source: str, build: Callable[[], apc.Model]) -> Case:
    def tell() -> Truth:
        found = spectral_truth(build())
        assert not isinstance(found, str), found
        with precision(256):  # where nothing ticks a frame is 1 s, and there it is 1 ms
            return Truth(found.radius if build().clocks else found.radius**1000, found.rigid)

    return Case(name, source, build, tell)


def _reference(scheme: str, peers: int, delayed: bool, radius: float) -> Case:
    delays: dict[str, Any] = {} if delayed else {"comp": Fraction(0), "comm": Fraction(0)}
    gains = {"kt": 800.0, "bt": 2.0, "kc": 1500.0, "bc": 2.0}
    return Case(
        f"{scheme} of {peers}, {'delayed' if delayed else 'at once'}",
        "reference",
        lambda: compiled(text_of(TopologySource(OPERATORS[scheme], peers, **gains, **delays))),
        lambda: Truth(flint.arb(radius), 1, 1e-8, TRANSLATING),
    )


def _closed(name: str, text: str, radius: Callable[[], Any], rigid: int, verdict: str) -> Case:
    def tell() -> Truth:
        with precision(256):
            return Truth(radius(), rigid, 1e-45, verdict)

    return Case(name, "closed", lambda: compiled(text), tell)


# What moves fast within a frame, or dies out far sooner.
STIFF = {
    "a frame of 1 s without clocks": """
topology: no-clock
peers: {left: {count: 1}}
masses:
  device: {mass: 0.0345 kg, damping: 5.05 N*s/m}
  cube: {mass: 0.0533 kg}
couplers:
  pad: {type: SpringDamper, a: device, b: cube, stiffness: 87.8 N/m, damping: 0.84 N*s/m}
""",
    "what dies out 10^5 times faster than the frame": """
topology: stiff
clocks: {haptic: 8 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.0009 kg, damping: 0.08 N*s/m}
  cube: {mass: 0.0086 kg, damping: 100 N*s/m}
couplers:
  pad: {type: SpringDamper, a: device, b: cube, stiffness: 5000 N/m, damping: 5 N*s/m}
  wall: {type: SampledSpringDamper, a: cube, b: ground, stiffness: 10 N/m, clock: haptic}
""",
}


CLOSED = [
    # m dv/dt = −b v over the frame of 1 s of remove clocks; a position that nothing holds.
    _closed("a damped mass", ONE_MASS, lambda: (-flint.arb(3) / 2).exp(), 1, TRANSLATING),
    _closed(
        "a light one",
        ONE_MASS.replace("2 kg", "1e-6 kg"),
        lambda: (-flint.arb(3) * 10**6).exp(),
        1,
        TRANSLATING,
    ),
    # m x″ + d x′ + k x = 0: |e^{sT}| = e^{−dT/(2m)} where it swings, critically damped or not.
    _closed(
        "a swing",
        OSCILLATOR.format(stiffness=40000, damping=3),
        lambda: (-flint.arb(3) / 2).exp(),
        0,
        "stable",
    ),
    _closed(
        "critically damped",
        OSCILLATOR.format(stiffness=4, damping=4),
        lambda: flint.arb(-2).exp(),
        0,
        "stable",
    ),
    # An undamped swing lies on the circle, exactly: nobody can tell.
    _closed(
        "on the circle",
        OSCILLATOR.format(stiffness=9, damping=0),
        lambda: flint.arb(1),
        0,
        "undecided: |ρ−1| below the error bound",
    ),
]


def _in_balls(topology: TopologySource, rigid: int, bits: int) -> Truth:
    with precision(bits):
        rows = frame_matrix(topology, number=as_ball, exp=lambda value: value.exp())
        values = flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")
        values.sort(key=lambda value: float(abs(value - 1).mid()))
        assert all(float(abs(value - 1).mid()) < RIGID for value in values[:rigid])
        return Truth(max((abs(value).mid() for value in values[rigid:]), default=flint.arb(0)), rigid, 1e-20)


def text_of(topology: TopologySource) -> str:
    """Return the YAML text of a topology: equal users are one group, others a group each."""
    each = topology.users or ({},) * topology.peers
    names = [f"u{i + 1}" for i in range(topology.peers)]
    interchangeable = not topology.users and not topology.late
    groups = f"  user: {{count: {topology.peers}}}\n"
    if not interchangeable:
        own = [", ".join(f"{OWN[key]}: {value!r} {UNIT[key]}" for key, value in one.items()) for one in each]
        groups = "".join(
            f"  {name}: {{count: 1, set: {{{one}}}}}\n" for name, one in zip(names, own, strict=True)
        )
    received = {
        names[i]: "".join(
            f"{names[j]}: {_ms(late)}, " for (sender, j), late in topology.late.items() if sender == i
        )
        for i, _ in topology.late
    }
    pairs = "".join(f"{name}: {{{listed}}}, " for name, listed in received.items())
    arcs = "".join(f"[{i + 1}, {j + 1}, {weight!r}], " for (i, j), weight in (topology.weights or {}).items())
    link = f"clock: network, delay: {_ms(topology.comm)}"
    link += f", delays: {{{pairs}}}" if pairs else ""
    link += f", graph: {{arcs: [{arcs}]}}" if arcs else ""
    peer_type = {"mean": "AveragePosition", "sum": "FullMesh"}[topology.operator]
    which = "own" if topology.own_delay else "all"
    return f"""\
topology: stepped
clocks:
  haptic: {{period: {_ms(topology.haptic)}, phase: {_ms(topology.haptic_phase)}}}
  network: {{period: {_ms(topology.network)}, phase: {_ms(topology.network_phase)}}}
peers:
{groups}masses:
  device: {{mass: {topology.device!r} kg, damping: {topology.device_damping!r} N*s/m}}
  cube: {{mass: {topology.cube!r} kg, damping: {topology.cube_damping!r} N*s/m}}
couplers:
  contact:
    {{type: SampledSpringDamper, a: device, b: cube, stiffness: {topology.kc!r} N/m,
      damping: {topology.bc!r} N*s/m, clock: haptic, delay: {_ms(topology.contact_delay)}}}
  coordination:
    {{type: {peer_type}, object: cube, stiffness: {topology.kt!r} N/m, damping: {topology.bt!r} N*s/m,
      clock: haptic, delay: {_ms(topology.comp)}, link: lan, delays: {which}}}
links:
  lan: {{{link}}}
"""


def _ms(time: Fraction) -> str:
    return f"{1000 * time} ms"


# What `bruteforce.TopologySource` calls a user's own numbers, and what a topology does.
OWN = {"kc": "contact.stiffness", "cube": "cube.mass", "device": "device.mass"}
UNIT = {"kc": "N/m", "cube": "kg", "device": "kg"}


def _stepped(name: str, *, rigid: int = 1, bits: int = 500, **values: Any) -> Case:
    topology = TopologySource(**{"peers": 2, **values})
    return Case(
        name, "stepped", lambda: compiled(text_of(topology)), lambda: _in_balls(topology, rigid, bits)
    )


MS = Fraction(1, 1000)
GAINS = {"kt": 800.0, "bt": 2.0, "kc": 1500.0, "bc": 2.0}
NONE = Fraction(0)
RING = dict.fromkeys([(i, j) for i in range(4) for j in range(4) if (i - j) % 4 in (1, 3)], 1.0)
CYCLE = {(0, 1): 0.7, (1, 2): 0.7, (2, 0): 0.7}
SEPARATE = {(0, 1): 2.0, (1, 0): 2.0, (0, 2): -0.5, (3, 2): 1.5, (2, 3): 1.0}
LAMENESS = {"device_damping": 1e-12, "cube_damping": 1e-12}

STEPPED = [
    _stepped("each at once", comp=NONE, comm=NONE, **GAINS),
    _stepped("phases", haptic_phase=MS * 3 / 10, network_phase=MS * 5 / 2, comm=5 * MS, **GAINS),
    _stepped("clocks of 2 and 5 ms", haptic=2 * MS, network=5 * MS, comm=7 * MS, **GAINS),
    _stepped("heard and passed on in a frame", haptic=3 * MS, network=2 * MS, comm=NONE, comp=NONE, **GAINS),
    _stepped("delays within a tick", comp=MS / 7, comm=MS * 22 / 7, operator="sum", **GAINS),
    _stepped("only the own part late", own_delay=True, operator="sum", comm=NONE, **GAINS),
    _stepped("1/90 s", network=Fraction(1, 90), comm=Fraction(1, 90)),
    _stepped("40 ticks a packet", network=40 * MS, comm=40 * MS),
    _stepped("twelve frames late", comm=96 * MS, bt=2.0, kt=50.0),
    _stepped(
        "eleven packets that hardly anyone answers",
        network=MS,
        comm=11 * MS,
        kt=0.05,
        kc=1.0,
        bc=2.0,
        comp=NONE,
    ),
    _stepped("hardly damped, hardly tied", kt=1e-3, kc=1e-3, bits=800, **LAMENESS),
    _stepped("no damping but of the ties", kt=100.0, bt=2.0, bc=3.0, device_damping=0.0, cube_damping=0.0),
    _stepped("groups", peers=3, comm=5 * MS, users=({}, {}, {"device": 0.3, "cube": 0.4}), **GAINS),
    _stepped(
        "different on a ring", peers=4, weights=RING, users=tuple({"device": m / 10} for m in (1, 2, 1.5, 3))
    ),
    _stepped("a ring", peers=4, weights=RING, **{**GAINS, "kt": 300.0}),
    _stepped("weights of either sign", peers=4, weights=SEPARATE, **GAINS),
    _stepped("a cycle one way", peers=3, weights=CYCLE, **GAINS),
    _stepped("pairs with delays of their own", peers=3, late={(0, 1): 12 * MS, (1, 0): 3 * MS}, **GAINS),
    _stepped("nobody hears the third", peers=3, weights={(0, 1): 1.0, (1, 0): 1.0, (0, 2): 1.0}),
]

CASES: dict[str, Case] = {
    str(case): case
    for case in (
        *(_stored(path) for path in sorted((ROOT / "tests" / "hard").glob("*.yaml"))),
        *(
            _followed(path.stem, "library", functools.partial(apc.compile, path))
            for path in LIBRARY
            if path.stem not in UNTOLD
        ),
        *(_followed(name, "stiff", functools.partial(compiled, text)) for name, text in STIFF.items()),
        *(_reference(*row) for row in MIDPOINT_RADIUS),
        *CLOSED,
        *STEPPED,
    )
}


@functools.cache
def model(name: str) -> apc.Model:
    """Return the compiled topology of a case."""
    return CASES[name].build()


@functools.cache
def truth(name: str) -> Truth:
    """Return the truth of a case."""
    return CASES[name].tell()


def distance(value: float, reported: Truth) -> float:
    """Return how far a radius is from the truth at least."""
    if not math.isfinite(value):
        return math.inf
    with precision(256):
        return max(0.0, abs(float((flint.arb(value) - reported.radius).mid())) - reported.error)
