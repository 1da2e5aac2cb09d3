"""Parts and topologies whose limits are known by a formula, for searches along one number."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

from apc.compiler.compiled import Model
from tests.topologies import compiled, library

# x⁺ = e^{gT} x − p x(d ticks ago), p = pull (e^{gT} − 1)/g, which is pull·T where nothing grows.
LATE = """\
component: Late
description: A position that grows by itself and is pulled back by what it was.
connectors: {a: Flange}
parameters: {pull: {unit: 1/s, min: 0}, growth: {unit: 1/s}, clock: clock, delay: {unit: s, min: 0}}
variables: {x: {unit: m, start: 0 m}}
equations:
  - der(x) = growth*x - hold(pull*sample(x), delay)
  - a.x = x
"""

# All together: x⁺ = (1 − p) x + p x(d packets ago); at p = 1 all its eigenvalues are on the circle at once.
FOLLOWER = """\
component: Follower
description: A position that follows the mean of the others'.
connectors: {a: Flange}
parameters: {pull: {unit: 1/s, min: 0}, clock: clock, link: link}
sends: {x: sample(x)}
variables: {x: {unit: m, start: 0 m}}
equations:
  - der(x) = -hold(pull*(sample(x) - mean(others.x)))
  - a.x = x
"""

# A spring whose stiffness depends on a setting by a shape; a copy of the part for each shape.
SPRING = """\
component: NAME
description: A spring whose stiffness depends on a setting.
connectors: {a: Flange, b: Flange}
parameters:
  low: {unit: N/m, min: 0}
  high: {unit: N/m}
  u: {unit: 1}
  rate: {unit: N/m/s, default: 0}
  clock: clock
  delay: {unit: s, min: 0, default: 0}
equations:
  - k = low + high*(SHAPE) + rate*delay
  - f = k*(sample(a.x) - sample(b.x))
  - a.f = hold(f, delay)
  - b.f = -a.f
"""
BUMP = "1/(1 + ((u - 1237)/WIDTH)^4)"
SHAPES = {
    "Straight": "u",
    "Bump": BUMP.replace("WIDTH", "50"),
    "Narrow": BUMP.replace("WIDTH", "0.01"),
    "Narrower": BUMP.replace("WIDTH", "0.0001"),
    "Step": "if u > 1000 and u < 1002 then 1 else 0",
    "Kink": "max(0, 1 - abs(u - 1001)/2)",
    "Bell": "exp(-(u - 1001)^2/4)",
    "Plateau": "tanh(u - 1001) - tanh(u - 1003)",
    "Angle": "atan2(4, 8*(u - 1003)) - atan2(4, 8*(u - 1001))",
}


@functools.cache
def built(text: str) -> Model:
    """Compile a text that may use the parts of this file; the same text gives the same model."""
    return compiled(text, _parts())


@functools.cache
def _parts() -> object:
    springs = [SPRING.replace("NAME", name).replace("SHAPE", shape) for name, shape in SHAPES.items()]
    with tempfile.TemporaryDirectory() as folder:
        return library(Path(folder), LATE, FOLLOWER, *springs)


def late(ticks: int, growth: float = 0.0) -> Model:
    """Return one position pulled back by what it was so many ticks of 1 ms ago."""
    return built(
        "topology: late\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        f"masses: {{it: {{type: Late, pull: 1 Hz, growth: {growth!r} Hz, clock: tick, delay: {ticks} ms}}}}\n"
    )


def followers(packets: int, pull: float = 100.0) -> Model:
    """Return three who follow one another's mean of so many packets ago, all at 1 kHz."""
    return built(
        "topology: followers\nclocks: {tick: 1 ms, network: 1 ms}\npeers: {user: {count: 3}}\n"
        f"masses: {{it: {{type: Follower, pull: {pull!r} Hz, clock: tick, link: lan}}}}\n"
        f"links: {{lan: {{clock: network, delay: {packets} ms}}}}\n"
    )


def sprung(shape: str, numbers: str = "low: 500 N/m, high: 8000 N/m, u: 2*dial - dial") -> Model:
    """Return a device on a sampled spring whose stiffness follows a setting by a shape, 1 ms late."""
    return built(
        "topology: setting\nparameters: {dial: 700}\nclocks: {haptic: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}\n"
        f"couplers: {{c: {{type: {shape}, a: device, b: ground, {numbers}, clock: haptic, delay: 1 ms}}}}\n"
    )
