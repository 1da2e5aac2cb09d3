"""Scenes of four peers that look at each other pair by pair, and their forces by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology

K, B, LIMIT = 500.0, 2.0, 1.5

# What a component says its force is, and the same by hand: of what the peer has (x, v, its force before, the
# time) and what it hears, with weights.
Heard = Sequence[tuple[float, float, float]]  # weight, x, v
Force = Callable[[float, float, float, float, Heard], float]


def limited(x: float, v: float, x_j: float, v_j: float) -> float:
    return max(-LIMIT, min(LIMIT, K * (x - x_j) + B * (v - v_j)))


def of_sum(x: float, v: float, f: float, t: float, heard: Heard) -> float:
    return sum(w * limited(x, v, *one) for w, *one in heard)


def of_mean(x: float, v: float, f: float, t: float, heard: Heard) -> float:
    return of_sum(x, v, f, t, heard) / sum(w for w, *_ in heard)


def of_largest(x: float, v: float, f: float, t: float, heard: Heard) -> float:
    return K * (x - max(one for _, one, _ in heard))


def of_least_pull(x: float, v: float, f: float, t: float, heard: Heard) -> float:
    return min(K * (x - x_j) * abs(x_j) / 0.01 + B * v for _, x_j, _ in heard)


def of_memory_and_time(x: float, v: float, f: float, t: float, heard: Heard) -> float:
    pulls = [(w, K * (x - x_j) + f / 4 + LIMIT * math.sin(100 * t)) for w, x_j, _ in heard]
    return sum(w * max(-LIMIT, min(LIMIT, pull)) for w, pull in pulls)


LIMITED = "max(-limit, min(limit, stiffness*(x - others.x) + damping*(v - others.v)))"
# Without words of its own the component is the library's.
FORCES: dict[str, tuple[str, Force]] = {
    "SaturatedMesh": ("", of_sum),
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
about: A coupling that looks at each peer by itself.
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


def scene(folder: Path, force: str, link: str = "delay: 8 ms") -> CompiledSystem:
    """Return two near and two far peers whose bodies pull each other."""
    (folder / "parts").mkdir(exist_ok=True)
    (folder / "parts" / "odd.yaml").write_text(COMPONENT.replace("FORCE", force), encoding="utf-8")
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
    type: {"Odd" if force else "SaturatedMesh"}
    object: body
    stiffness: 500 N/m
    damping: 2 N*s/m
    limit: 1.5 N
    clock: haptic
    delay: 1 ms
    link: lan
links:
  lan: {{clock: network, {link}}}
"""
    (folder / "scene.yaml").write_text(text, encoding="utf-8")
    return compile_topology(folder / "scene.yaml")
