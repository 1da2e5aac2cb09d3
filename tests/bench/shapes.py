# ruff: noqa: E501 -- scenes are written by long lines
"""Random topologies of every shape a scene may have: graphs, weights, groups, clocks, integrators, expressions.

Takes: a generator. Gives: `Shape`, `SHAPES`, `draw_shape`, `PARTS`.
Guarantees: each compiles, and is linear or says what of it is not.
Does not: know what becomes of them.

A shape's numbers are drawn apart from it (see `random_scenes`): a range of decades by the parameter's name.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction

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
about: Pulls a copy to what the weights make of the others, for rows that add up to 1.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {stiffness: {unit: N/m}, damping: {unit: N*s/m, default: 0}, clock: clock, link: link, delay: {unit: s, default: 0}}
equations:
  - f = stiffness*(sample(object.x) - sum(others.x)) + damping*sample(der(object.x))
  - object.f = hold(f, delay)
""",
    "Integrator": """
component: Integrator
about: Proportional, integral and differential, acting at every moment.
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
about: A sum of errors at ticks, leaky or not, with a filtered difference.
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
about: An integrator of a held error.
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
about: A second-order digital filter of an error.
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
about: A mesh with plain expressions wherever an expression can stand.
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
about: Expressions, every expression a variable of its own.
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
about: A spring whose stiffness swings with time.
connectors: {a: Flange, b: Flange}
parameters: {stiffness: {unit: N/m}, rate: {unit: Hz, default: 3 Hz}, clock: clock}
equations:
  - a.f = hold(stiffness*(1 + cos(rate*time)/2)*(sample(a.x) - sample(b.x)))
  - b.f = -a.f
""",
    "Pushed": """
component: Pushed
about: A spring beside a force that swings with time.
connectors: {a: Flange, b: Flange}
parameters: {stiffness: {unit: N/m}, rate: {unit: Hz, default: 3 Hz}, length: {unit: m, default: 1 m}, clock: clock}
equations:
  - a.f = hold(stiffness*(sample(a.x) - sample(b.x) + length*cos(rate*time)))
  - b.f = -a.f
""",
}

TICKS = ("1 ms", "0.5 ms", "2 ms", "4/3 ms")
LATE = ("0 s", "1 ms", "1.5 ms", "1/3 ms", "0.13 ms")
BODIES = "masses:\n  device: {mass: 0.1 kg, damping: 5 N*s/m}\n  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}\n"


def draw_shape(generator: random.Random) -> Shape:
    """Return a shape at random, each as likely as the next."""
    return generator.choice(tuple(SHAPES.values()))(generator)


def _contact(tick: str, delay: str) -> str:
    return f"  contact: {{type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: {tick}, delay: {delay}}}\n"


def _coordination(generator: random.Random, delay: str, kind: str = "") -> str:
    kind = kind or generator.choice(["AveragePosition", "FullMesh"])
    own = generator.choice(["", "", ", delays: own"]) if kind in ("AveragePosition", "FullMesh") else ""
    return f"  coordination: {{type: {kind}, object: cube, stiffness: 500 N/m, clock: haptic, delay: {delay}, link: lan{own}}}\n"


def _arm(generator: random.Random) -> str:
    arm = "hands:\n  arm: {type: SpringDamperArm, flange: device, stiffness: 80 N/m, damping: 1 N*s/m}\n"
    return arm if generator.random() < 0.4 else ""


def _clocks(generator: random.Random) -> tuple[str, str]:
    """Return the clocks, and a link's delay that they don't make too long."""
    tick, ratio = (
        generator.choice(TICKS),
        generator.choice(["1 ms", "2 ms", "4 ms", "8 ms", "2.5 ms", "10 ms"]),
    )
    late = generator.choice(
        ["0 s", "1 ms", "7/3 ms", ratio, ratio, "8 ms" if Fraction(ratio.split()[0]) < 4 else "20 ms"]
    )
    phase = generator.choice(["", "", ", phase: 0.2 ms", ", phase: 1/7 ms"])
    return f"clocks: {{haptic: {{period: {tick}{phase}}}, network: {ratio}}}\n", late


def users(generator: random.Random) -> Shape:
    """Users who move a cube, on any graph: the paper's scene."""
    clocks, late = _clocks(generator)
    delay, peers = generator.choice(LATE), generator.randint(2, 5)
    graph = generator.choice(["", "", ", graph: ring", ", graph: star"])
    groups = f"user: {{count: {min(peers, 3) if graph else peers}}}"
    if generator.random() < 0.4:
        groups = (
            f"one: {{count: 1, set: {{device.mass: 0.37 kg}}}}\n  two: {{count: {2 if graph else peers}}}"
        )
    text = f"topology: users\n{clocks}peers:\n  {groups}\n{BODIES}couplers:\n{_contact('haptic', delay)}{_coordination(generator, delay)}"
    return Shape(
        f"{text}links:\n  lan: {{clock: network, delay: {late}{graph}}}\n{_arm(generator)}",
        MASSES | CONTACT | COORDINATION,
    )


def weights(generator: random.Random) -> Shape:
    """Peers who weigh one another by decimals, that doubles round."""
    clocks, late = _clocks(generator)
    digits, kind = (
        generator.choice([1, 2, 3, 6, 16]),
        generator.choice(["FullMesh", "AveragePosition", "WeightedMean"]),
    )
    drawn = {
        pair: round(generator.uniform(0.05, 1.5), digits)
        for pair in ((1, 2), (1, 3), (2, 3), (2, 1), (3, 1), (3, 2))
    }
    if kind == "WeightedMean":  # rows that add up to 1, in decimals
        for receiver in (1, 2, 3):
            one, two = (sender for sender in (1, 2, 3) if sender != receiver)
            tenths = generator.randint(1, 10**digits - 1) if digits < 10 else generator.randint(1, 999)
            whole = 10**digits if digits < 10 else 1000
            drawn[one, receiver], drawn[two, receiver] = tenths / whole, (whole - tenths) / whole
    if kind != "WeightedMean" and generator.random() < 0.5:
        graph = f"edges: [{', '.join(f'[{a}, {b}, {drawn[a, b]!r}]' for a, b in ((1, 2), (1, 3), (2, 3)))}]"
    else:
        graph = f"arcs: [{', '.join(f'[{a}, {b}, {weight!r}]' for (a, b), weight in drawn.items())}]"
    delay = generator.choice(LATE)
    text = f"topology: weights\n{clocks}peers: {{user: {{count: 3}}}}\n{BODIES}couplers:\n{_contact('haptic', delay)}{_coordination(generator, delay, kind)}"
    return Shape(
        f"{text}links:\n  lan: {{clock: network, delay: {late}, graph: {{{graph}}}}}\n{_arm(generator)}",
        MASSES | CONTACT | COORDINATION,
    )


GAINS: dict[str, Decades] = {
    "own.kp": (-1, 4, 0.1),
    "own.ki": (-2, 4, 0.3),
    "own.kd": (-3, 1.5, 0.3),
    "own.leak": (-2, 0, 0.5),
}


def integrators(generator: random.Random) -> Shape:
    """Integrators of all kinds, some of which nobody reads."""
    clocks, _ = _clocks(generator)
    kind = generator.choice(["Integrator", "SampledIntegrator", "HeldIntegrator"])
    values = "kp: 100 N/m, ki: 10 N/(m*s), kd: 1 N*s/m"
    values += {
        "Integrator": ", leak: 0 Hz",
        "SampledIntegrator": ", leak: 1, alpha: 0.5, period: 1 ms, clock: haptic, delay: "
        + generator.choice(LATE),
        "HeldIntegrator": ", leak: 0 Hz, clock: haptic, delay: " + generator.choice(LATE),
    }[kind]
    ground = generator.choice(["cube", "ground"])
    text = f"topology: integrators\n{clocks}peers: {{user: {{count: {generator.randint(1, 3)}}}}}\n{BODIES}couplers:\n"
    text += f"  own: {{type: {kind}, a: device, b: {ground}, {values}}}\n"
    text += generator.choice(
        [
            "",
            "  spring: {type: SpringDamper, a: device, b: ground, stiffness: 30 N/m}\n",
            _contact("haptic", "0 s"),
        ]
    )
    return Shape(text + _arm(generator), MASSES | CONTACT | GAINS | {"spring.stiffness": (-1, 5, 0.1)})


SPRING: dict[str, Decades] = {"spring.stiffness": (-1, 7, 0.05), "spring.damping": (-3, 2, 0.3)}


def unclocked(generator: random.Random) -> Shape:
    """No clock at all: two masses on a spring, held or free."""
    held = generator.choice(
        ["", "  arm: {type: SpringDamperArm, flange: device, stiffness: 80 N/m, damping: 1 N*s/m}\n"]
    )
    text = f"topology: unclocked\npeers: {{user: {{count: {generator.randint(1, 3)}}}}}\n{BODIES}couplers:\n"
    text += "  spring: {type: SpringDamper, a: device, b: cube, stiffness: 100 N/m, damping: 1 N*s/m}\n"
    return Shape(text + (f"hands:\n{held}" if held else ""), MASSES | SPRING)


def stiff(generator: random.Random) -> Shape:
    """A continuous spring, stiff or not, beside sampled couplers."""
    clocks, late = _clocks(generator)
    delay = generator.choice(LATE)
    text = (
        f"topology: stiff\n{clocks}peers: {{user: {{count: {generator.randint(1, 4)}}}}}\n{BODIES}couplers:\n"
    )
    text += "  spring: {type: SpringDamper, a: device, b: cube, stiffness: 100 N/m, damping: 1 N*s/m}\n"
    if generator.random() < 0.5:
        text += f"  contact: {{type: SampledSpringDamper, a: cube, b: ground, stiffness: 10 N/m, clock: haptic, delay: {delay}}}\n"
        return Shape(text, MASSES | SPRING | CONTACT)
    text = text.replace("count: 1}", "count: 2}")
    text += f"{_coordination(generator, delay)}links:\n  lan: {{clock: network, delay: {late}}}\n"
    return Shape(text, MASSES | SPRING | COORDINATION)


def several_clocks(generator: random.Random) -> Shape:
    """Groups with clocks, delays and a link's delays of their own."""
    late = generator.choice(["0 s", "4 ms", "8 ms"])
    slow = generator.choice(["2 ms", "{period: 2 ms, phase: 0.5 ms}", "1.5 ms"])
    clocks = f"clocks: {{haptic: 1 ms, slow: {slow}, network: {{period: 4 ms, phase: {generator.choice(['0 s', '0.7 ms', '3 ms'])}}}}}\n"
    own = f"contact.clock: slow, contact.delay: {generator.choice(LATE)}, coordination.clock: slow"
    text = f"topology: clocks\n{clocks}peers:\n  near: {{count: {generator.randint(1, 2)}}}\n  far: {{count: 1, set: {{{own}}}}}\n{BODIES}couplers:\n"
    text += _contact("haptic", generator.choice(LATE)) + _coordination(generator, generator.choice(LATE))
    text += f"links:\n  lan: {{clock: network, delay: {late}, delays: {{far: {{near: {generator.choice(['0 s', '9 ms', '3.3 ms'])}}}}}}}\n"
    return Shape(text + _arm(generator), MASSES | CONTACT | COORDINATION)


def memories(generator: random.Random) -> Shape:
    """A digital filter between two masses, or to the ground."""
    clocks, _ = _clocks(generator)
    b, delay = generator.choice(["cube", "ground"]), generator.choice(LATE)
    drawn = ", ".join(f"{name}: {generator.uniform(-0.9, 0.9):.3f}" for name in ("a1", "a2", "b0", "b1"))
    text = f"topology: memories\n{clocks}peers: {{user: {{count: 2}}}}\n{BODIES}couplers:\n{_contact('haptic', delay)}"
    text += (
        f"  own: {{type: Memory, a: device, b: {b}, gain: 50 N/m, {drawn}, clock: haptic, delay: {delay}}}\n"
    )
    return Shape(text, MASSES | CONTACT | {"own.gain": (-1, 4, 0.1)})


def expressions(generator: random.Random) -> Shape:
    """Plain expressions in every place an expression can stand, or the same with a name for each."""
    clocks, late = _clocks(generator)
    kind = generator.choice(["Expressions", "Named"])
    text = f"topology: expressions\n{clocks}peers: {{user: {{count: {generator.randint(2, 4)}}}}}\n{BODIES}couplers:\n{_contact('haptic', '0 s')}"
    text += f"  own: {{type: {kind}, object: cube, stiffness: 100 N/m, damping: 1 N*s/m, tau: 3 ms, clock: haptic, link: lan, delay: {generator.choice(LATE)}}}\n"
    ranges = {"own.stiffness": (-1, 4, 0.05), "own.damping": (-3, 1.5, 0.4), "own.tau": (-4, -1, 0.1)}
    return Shape(f"{text}links:\n  lan: {{clock: network, delay: {late}}}\n", MASSES | CONTACT | ranges)


def timed(generator: random.Random) -> Shape:
    """Time that multiplies a motion, which is refused, or that pushes, which is left out."""
    clocks, _ = _clocks(generator)
    kind = generator.choice(["Timed", "Pushed"])
    text = f"topology: timed\n{clocks}peers: {{user: {{count: 2}}}}\n{BODIES}couplers:\n{_contact('haptic', '0 s')}"
    text += f"  own: {{type: {kind}, a: device, b: ground, stiffness: 100 N/m, clock: haptic}}\n"
    return Shape(text, MASSES | CONTACT | {"own.stiffness": (-1, 4, 0)}, "E810" if kind == "Timed" else "")


SHAPES: Mapping[str, Callable[[random.Random], Shape]] = {
    one.__name__: one
    for one in (
        users,
        users,
        weights,
        integrators,
        unclocked,
        stiff,
        several_clocks,
        memories,
        expressions,
        timed,
    )
}
