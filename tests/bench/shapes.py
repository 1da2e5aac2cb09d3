# ruff: noqa: E501 -- topologies are written by long lines
"""Random topologies of every shape a topology may have: graphs, weights, groups, clocks, integrators, expressions.

Takes: a generator. Gives: `Shape`, `SHAPES`, `draw_shape`, `numbers`, `PARTS`.
Guarantees: each compiles, and is linear or says what of it is not.
Does not: know what becomes of them.

A shape is a text in which `$name` stands for any of a name's alternatives (see `tests.fuzz.grammar`). Its numbers
are drawn apart from it: a range of decades by the parameter's name.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.parameter_values.overrides import Override
from apc.parameter_values.parameter_names import ParameterRef
from tests.fuzz.grammar import grown, rules_of

# Least and largest decade, and the chance of 0.
Decades = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Shape:
    """A topology, the decades its parameters are drawn from, and the error that it must give, if any."""

    text: str
    ranges: Mapping[str, Decades]
    refused: str = ""


MASSES: dict[str, Decades] = {
    "device.mass": (-4, 1, 0),
    "device.damping": (-6, 2, 0.1),
    "cube.mass": (-4, 1, 0),
    "cube.damping": (-6, 2, 0.1),
}
CONTACT: dict[str, Decades] = {"contact.stiffness": (-1, 5, 0.05), "contact.damping": (-3, 1.5, 0.4)}
COORDINATION: dict[str, Decades] = {
    "coordination.stiffness": (-1, 4, 0.05),
    "coordination.damping": (-3, 1.5, 0.4),
}

PARTS = {
    "WeightedMean": """
component: WeightedMean
description: Pulls a copy to what the weights make of the others, for rows that add up to 1.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {stiffness: {unit: N/m}, damping: {unit: N*s/m, default: 0}, clock: clock, link: link, delay: {unit: s, default: 0}}
equations:
  - f = stiffness*(sample(object.x) - sum(others.x)) + damping*sample(der(object.x))
  - object.f = hold(f, delay)
""",
    "Integrator": """
component: Integrator
description: Proportional, integral and differential, acting at every moment.
connectors: {a: Flange, b: Flange}
parameters: {kp: {unit: N/m}, ki: {unit: N/(m*s)}, kd: {unit: N*s/m}, leak: {unit: Hz}}
variables: {i: {unit: m*s, start: 0 m*s}}
equations:
  - der(i) = a.x - b.x - leak*i
  - a.f = kp*(a.x - b.x) + ki*i + kd*(der(a.x) - der(b.x))
  - b.f = -a.f
""",
    "SampledIntegrator": """
component: SampledIntegrator
description: A sum of errors at ticks, leaky or not, with a filtered difference.
connectors: {a: Flange, b: Flange}
parameters:
  kp: {unit: N/m}
  ki: {unit: N/(m*s)}
  kd: {unit: N*s/m}
  alpha: {unit: 1}
  leak: {unit: 1}
  period: {unit: s}
  clock: clock
  delay: {unit: s, default: 0}
variables: {e: {unit: m, start: 0 m}, s: {unit: m*s, start: 0 m*s}, d: {unit: m/s, start: 0 m/s}}
equations:
  - e = sample(a.x) - sample(b.x)
  - s = leak*previous(s) + period*e
  - d = alpha*previous(d) + (1 - alpha)*(e - previous(e))/period
  - a.f = hold(kp*e + ki*s + kd*d, delay)
  - b.f = -a.f
""",
    "HeldIntegrator": """
component: HeldIntegrator
description: An integrator of a held error.
connectors: {a: Flange, b: Flange}
parameters: {kp: {unit: N/m}, ki: {unit: N/(m*s)}, kd: {unit: N*s/m}, leak: {unit: Hz}, clock: clock, delay: {unit: s, default: 0}}
variables: {i: {unit: m*s, start: 0 m*s}}
equations:
  - der(i) = hold(sample(a.x) - sample(b.x), delay) - leak*i
  - a.f = kp*(a.x - b.x) + hold(ki*sample(i) + kd*(sample(der(a.x)) - sample(der(b.x))))
  - b.f = -a.f
""",
    "Memory": """
component: Memory
description: A second-order digital filter of an error.
connectors: {a: Flange, b: Flange}
parameters: {gain: {unit: N/m}, a1: {unit: 1}, a2: {unit: 1}, b0: {unit: 1}, b1: {unit: 1}, clock: clock, delay: {unit: s, default: 0}}
variables: {e: {unit: m, start: 0 m}, y: {unit: m, start: 0 m}, z: {unit: m, start: 0 m}}
equations:
  - e = sample(a.x) - sample(b.x)
  - z = previous(y)
  - y = a1*z + a2*previous(z) + b0*e + b1*previous(e)
  - a.f = hold(gain*y, delay)
  - b.f = -a.f
""",
    "Expressions": """
component: Expressions
description: A mesh with plain expressions wherever an expression can stand.
connectors: {object: Flange}
sends: {z: sample(object.x) + tau*sample(der(object.x)), w: -2*sample(object.x)}
parameters: {stiffness: {unit: N/m}, damping: {unit: N*s/m}, tau: {unit: s}, clock: clock, link: link, delay: {unit: s, default: 0}}
variables: {y: {unit: m, start: 0 m}, h: {unit: m, start: 0 m}}
equations:
  - h = sample(object.x/2)
  - y = previous(h)/4 + sample(2*object.x)
  - object.f = hold(stiffness*(count(others)*y/2 - sum(others.z + tau*0*others.w/tau)), delay/2) + hold(damping*count(others)*sample(der(object.x) + 0*der(object.x)))
""",
    "Named": """
component: Named
description: Expressions, every expression a variable of its own.
connectors: {object: Flange}
sends: {z: sample(object.x) + tau*sample(der(object.x)), w: -2*sample(object.x)}
parameters: {stiffness: {unit: N/m}, damping: {unit: N*s/m}, tau: {unit: s}, clock: clock, link: link, delay: {unit: s, default: 0}}
variables: {y: {unit: m, start: 0 m}, x: {unit: m, start: 0 m}, h: {unit: m, start: 0 m}, f: {unit: N}, g: {unit: N}}
equations:
  - x = sample(object.x)
  - h = x/2
  - y = previous(h)/4 + 2*x
  - f = stiffness*(count(others)*y/2 - sum(others.z))
  - g = damping*count(others)*sample(der(object.x))
  - object.f = hold(f, delay/2) + hold(g)
""",
    "Timed": """
component: Timed
description: A spring whose stiffness swings with time.
connectors: {a: Flange, b: Flange}
parameters: {stiffness: {unit: N/m}, rate: {unit: Hz, default: 3 Hz}, clock: clock}
equations:
  - a.f = hold(stiffness*(1 + cos(rate*time)/2)*(sample(a.x) - sample(b.x)))
  - b.f = -a.f
""",
    "Pushed": """
component: Pushed
description: A spring beside a force that swings with time.
connectors: {a: Flange, b: Flange}
parameters: {stiffness: {unit: N/m}, rate: {unit: Hz, default: 3 Hz}, length: {unit: m, default: 1 m}, clock: clock}
equations:
  - a.f = hold(stiffness*(sample(a.x) - sample(b.x) + length*cos(rate*time)))
  - b.f = -a.f
""",
}

_RULES = rules_of("""\
tick: 1 ms  0.5 ms  2 ms  4/3 ms
ratio: 1 ms  2 ms  4 ms  8 ms  2.5 ms  10 ms
phase: $none  $none  , phase: 0.2 ms  , phase: 1/7 ms
clocks: clocks: {haptic: {period: $tick$phase}, network: $ratio}
acts: 0 s  1 ms  1.5 ms  1/3 ms  0.13 ms
late: 0 s  1 ms  7/3 ms  4 ms  8 ms  8 ms
few: 1  2  3
some: 2  3  4
graph: $none  $none  , graph: ring  , graph: star
groups: {user: {count: $some}}  {user: {count: 3}}  {one: {count: 1, set: {device.mass: 0.37 kg}}, two: {count: $some}}
mesh: AveragePosition$delays  FullMesh$delays
delays: $none  $none  , delays: own
ground: cube  ground
gains: kp: 100 N/m, ki: 10 N/(m*s), kd: 1 N*s/m
integrator: Integrator, $gains, leak: 0 Hz  SampledIntegrator, $gains, leak: 1, alpha: 0.5, period: 1 ms, clock: haptic, delay: $acts  HeldIntegrator, $gains, leak: 0 Hz, clock: haptic, delay: $acts
share: -0.9  -0.41  0.13  0.367  0.638  0.85
expressions: Expressions  Named
""") | {
    "none": [""],
    "bodies": [
        "masses:\n  device: {mass: 0.1 kg, damping: 5 N*s/m}\n  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}\ncouplers:\n"
    ],
    "contact": [
        "  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: $acts}\n"
    ],
    "coordination": [
        "  coordination: {type: $mesh, object: cube, stiffness: 500 N/m, clock: haptic, delay: $acts, link: lan}\n"
    ],
    "spring": ["  spring: {type: SpringDamper, a: device, b: cube, stiffness: 100 N/m, damping: 1 N*s/m}\n"],
    "more": ["", "$contact", "  spring: {type: SpringDamper, a: device, b: ground, stiffness: 30 N/m}\n"],
    "arm": [
        "",
        "hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 80 N/m, damping: 1 N*s/m}}\n",
    ],
    "lan": ["links: {lan: {clock: network, delay: $late$graph}}\n"],
    "slow": ["2 ms", "{period: 2 ms, phase: 0.5 ms}", "1.5 ms"],
    "far": ["{contact.clock: slow, contact.delay: $acts, coordination.clock: slow}"],
}
_GAINS: dict[str, Decades] = {
    "own.kp": (-1, 4, 0.1),
    "own.ki": (-2, 4, 0.3),
    "own.kd": (-3, 1.5, 0.3),
    "own.leak": (-2, 0, 0.5),
}
_SPRING: dict[str, Decades] = {"spring.stiffness": (-1, 7, 0.05), "spring.damping": (-3, 2, 0.3)}
_LOCAL: dict[str, Decades] = {
    "own.stiffness": (-1, 4, 0.05),
    "own.damping": (-3, 1.5, 0.4),
    "own.tau": (-4, -1, 0.1),
}
_CONTACT, _WHOLE = MASSES | CONTACT, MASSES | CONTACT | COORDINATION

# What it is about, its text, its ranges and what is due. The paper's topology comes twice, as it has most forms.
SHAPES: tuple[Shape, ...] = (
    Shape("topology: users\n$clocks\npeers: $groups\n$bodies$contact$coordination$lan$arm", _WHOLE),
    Shape("topology: users\n$clocks\npeers: $groups\n$bodies$contact$coordination$lan", _WHOLE),
    Shape(
        "topology: weights\n$clocks\npeers: {user: {count: 3}}\n$bodies$contact$coordination\n"
        "links: {lan: {clock: network, delay: $late, graph: {GRAPH}}}\n$arm",
        _WHOLE,
    ),
    Shape(
        "topology: weighted\nclocks: {haptic: {period: $tick$phase}, network: $ratio}\npeers: {user: {count: 3}}\n$bodies$contact"
        "  coordination: {type: WeightedMean, object: cube, stiffness: 500 N/m, clock: haptic, delay: $acts, link: lan}\n"
        "links: {lan: {clock: network, delay: $late, graph: {ROWS}}}\n$arm",
        _WHOLE,
    ),
    Shape(
        "topology: integrators\n$clocks\npeers: {user: {count: $few}}\n$bodies  own: {a: device, b: $ground, type: $integrator}\n$more$arm",
        _CONTACT | _GAINS | {"spring.stiffness": (-1, 5, 0.1)},
    ),
    Shape("topology: unclocked\npeers: {user: {count: $few}}\n$bodies$spring$arm", MASSES | _SPRING),
    Shape(
        "topology: stiff\n$clocks\npeers: {user: {count: $few}}\n$bodies$spring"
        "  contact: {type: SampledSpringDamper, a: cube, b: ground, stiffness: 10 N/m, clock: haptic, delay: $acts}\n",
        _CONTACT | _SPRING,
    ),
    Shape(
        "topology: stiff\n$clocks\npeers: {user: {count: $some}}\n$bodies$spring$coordination$lan",
        MASSES | _SPRING | COORDINATION,
    ),
    Shape(
        "topology: clocks\nclocks: {haptic: 1 ms, slow: $slow, network: {period: 4 ms$phase}}\n"
        "peers: {near: {count: 2}, far: {count: 1, set: $far}}\n$bodies$contact$coordination\n"
        "links: {lan: {clock: network, delay: $late, delays: {far: {near: 3.3 ms}}}}\n$arm",
        _WHOLE,
    ),
    Shape(
        "topology: memories\n$clocks\npeers: {user: {count: 2}}\n$bodies$contact  own: {type: Memory, a: device, b: $ground, "
        "gain: 50 N/m, a1: $share, a2: $share, b0: $share, b1: $share, clock: haptic, delay: $acts}\n",
        _CONTACT | {"own.gain": (-1, 4, 0.1)},
    ),
    Shape(
        "topology: expressions\n$clocks\npeers: {user: {count: $some}}\n$bodies$contact  own: {type: $expressions, object: cube, "
        "stiffness: 100 N/m, damping: 1 N*s/m, tau: 3 ms, clock: haptic, link: lan, delay: $acts}\nlinks: {lan: {clock: network, delay: $late}}\n",
        _CONTACT | _LOCAL,
    ),
    # Time that multiplies a motion is refused; time that pushes is left out.
    Shape(
        "topology: timed\n$clocks\npeers: {user: {count: 2}}\n$bodies$contact  own: {type: Timed, a: device, b: ground, stiffness: 100 N/m, clock: haptic}\n",
        _CONTACT,
        "E810",
    ),
    Shape(
        "topology: pushed\n$clocks\npeers: {user: {count: 2}}\n$bodies$contact  own: {type: Pushed, a: device, b: ground, stiffness: 100 N/m, clock: haptic}\n",
        _CONTACT | _LOCAL,
    ),
)


def draw_shape(generator: random.Random) -> Shape:
    """Return a shape at random, each as likely as the next."""
    shape = generator.choice(SHAPES)
    text = shape.text.replace("GRAPH", _graph(generator)).replace("ROWS", _rows(generator))
    return replace(shape, text=grown(generator, _RULES, text, 9))


def _graph(generator: random.Random) -> str:
    """Return how three peers weigh one another by decimals, that doubles round."""
    digits = generator.choice([1, 2, 3, 6, 16])
    pairs = list(itertools.permutations((1, 2, 3), 2))
    peer_type, pairs = generator.choice([("edges", pairs[:2] + pairs[3:4]), ("arcs", pairs)])
    return f"{peer_type}: [{', '.join(f'[{a}, {b}, {round(generator.uniform(0.05, 1.5), digits)!r}]' for a, b in pairs)}]"


def _rows(generator: random.Random) -> str:
    """Return weights that add up to 1 for each of three receivers, in decimals."""
    whole = 10 ** generator.choice([1, 2, 3, 6])
    arcs = []
    for receiver, one, other in ((1, 2, 3), (2, 1, 3), (3, 1, 2)):
        part = generator.randint(1, whole - 1)
        arcs += [
            f"[{one}, {receiver}, {part / whole!r}]",
            f"[{other}, {receiver}, {(whole - part) / whole!r}]",
        ]
    return f"arcs: [{', '.join(arcs)}]"


def numbers(generator: random.Random, shape: Shape, model: Model) -> list[Override]:
    """Return numbers at random: a decade is as likely as the next."""
    known = {parameter.name for parameter in model.parameters}
    values = []
    for name, (low, high, zero) in shape.ranges.items():
        value = 0.0 if generator.random() < zero else 10 ** generator.uniform(low, high)
        if name in known:
            values.append(Override(ParameterRef(name), Fraction(value)))
    return values
