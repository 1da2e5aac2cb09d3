"""`functions`: CasADi functions that hold what is needed, and give what the equations say by hand."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import pytest

from apc.analysis.selfcheck import check_frame
from apc.compiler.compiled import CompiledSystem, Formula, Kind, Parameter
from apc.compiler.plain import PlainFunction
from tests.topologies import AVERAGE, MESH, ONE_MASS, compiled, library, replaced, told


def only(text: str) -> Kind:
    (kind,) = compiled(text).kinds
    return kind


def numbers(result: Any) -> list[float]:
    return [float(value) for value in casadi.DM(result).full().ravel()]


def vector(system: CompiledSystem, kind: Kind) -> list[float]:
    value = {parameter.name: parameter.value for parameter in system.parameters}
    return [value[name] for name in kind.parameters]


@pytest.mark.parametrize(("text", "weight"), [(AVERAGE, 1), (MESH, 2)])
def test_the_functions_give_the_papers_equations(text: str, weight: int) -> None:
    system = compiled(replaced(text, ("500 N/m,", "500 N/m, damping: 2 N*s/m,")))
    (kind,) = system.kinds
    (haptic,) = kind.clocks
    (lan,) = kind.sends
    p = vector(system, kind)
    x, v, x_o, v_o = state = [0.01, -0.2, 0.03, 0.5]
    held_contact, held_pull = held = [3.0, -7.0]
    heard = [0.04, 0.25]
    assert [s.name for s in kind.states] == ["device.x", "device.v", "cube.x", "cube.v"]
    assert [h.name for h in kind.holds] == ["contact.f", "coordination.f"]
    # Eqs. (1) and (2): the contact pushes the device back and the cube on; the others pull the cube.
    assert numbers(kind.derivative(state, held, p, 0)) == pytest.approx(
        [v, (-held_contact - 5 * v) / 0.1, v_o, (held_contact - held_pull - 5 * v_o) / 0.2], rel=1e-15
    )
    # Eqs. (3) and (4).
    pull = 500 * (weight * x_o - heard[0]) + 2 * (weight * v_o - heard[1])
    ticked = numbers(haptic.tick(state, held, [], heard, p, 0))
    assert haptic.outputs == ("contact.f", "coordination.f")
    assert ticked == pytest.approx([1000 * (x - x_o), pull], rel=1e-14)
    assert (lan.link, lan.channels, lan.units) == ("lan", ("coordination.x", "coordination.v"), ("m", "m/s"))
    assert numbers(lan.send(state, held, p, 0)) == [x_o, v_o]
    assert [(r.operator, r.link, r.channel) for r in haptic.receives] == [
        ("mean" if weight == 1 else "sum", "lan", 0),
        ("mean" if weight == 1 else "sum", "lan", 1),
    ]


def test_a_quotient_is_rounded_once() -> None:
    system = compiled(ONE_MASS.replace("2 kg", "3 kg").replace("3 N*s/m", "0.1 N*s/m"))
    (kind,) = system.kinds
    assert numbers(kind.derivative([0.0, 0.7], [], vector(system, kind), 0))[1] == -(0.1 * 0.7) / 3


def test_timings_are_exact_and_each_is_there_once() -> None:
    system = compiled(AVERAGE)
    assert {t.name: t.value for t in system.timings} == {
        "contact.delay": Fraction(1, 1000),
        "coordination.delay": Fraction(1, 1000),
        "lan.delay": Fraction(1, 125),
        "haptic.period": Fraction(1, 1000),
        "haptic.phase": 0,
        "network.period": Fraction(1, 125),
        "network.phase": 0,
    }
    assert len({t.name for t in system.timings}) == len(system.timings)


def test_a_parameter_keeps_its_bounds_its_unit_and_what_it_follows_from() -> None:
    text = replaced(
        AVERAGE, ("clocks:", "parameters: {kt: 2 N/mm}\nclocks:"), ("500 N/m,", "kt/(peers + 1),")
    )
    system = compiled(text)
    found = {parameter.name: parameter for parameter in system.parameters}
    quotient = PlainFunction(*((("p", 2), ("c", 1)), (), (("add", 1, 2), ("div", 0, 3)), ((4,),)))
    spans = ((0, 2), (4, 9), (12, 13), (4, 13), (0, 14))
    formula = Formula("kt/(peers + 1)", ("kt", "peers"), (Fraction(1),), quotient, spans)
    assert system.followers == ("coordination.stiffness",)
    assert found["coordination.stiffness"] == Parameter(
        *("coordination.stiffness", "N/m", 500.0, formula, 0.0, False, None),
        *("force per distance from the mean", Fraction(500)),
    )
    assert (found["device.mass"].minimum, found["device.mass"].open_minimum) == (0.0, True)
    assert (found["kt"].value, found["kt"].unit) == (2000.0, "N/m")
    assert found["peers"].value == 3.0
    assert found["device.x"].unit == "m"


def test_what_nobody_reads_is_left_out_and_said() -> None:
    system = compiled(
        replaced(
            AVERAGE,
            ("  network: 8 ms", "  network: 8 ms\n  spare: 3 ms"),
            ("  lan: {", "  wan: {clock: network}\n  lan: {"),
        )
    )
    assert system.dropped == (("wan", "nobody hears what it would carry"), ("spare", "nothing ticks with it"))
    assert [link.name for link in system.links] == ["lan"]
    assert [clock.name for clock in system.clocks] == ["haptic", "network"]


def test_what_is_sent_and_never_heard_is_left_out(tmp_path: Path) -> None:
    own = library(
        tmp_path,
        "component: Follower\nconnectors: {flange: Flange}\n"
        "sends: {x: sample(flange.x), same: sample(flange.x), v: sample(der(flange.x))}\n"
        "parameters: {clock: clock, link: link, k: {unit: N/m}}\n"
        "equations: ['f = k*mean(others.x) + k*sum(others.same)', 'flange.f = hold(f)']\n",
    )
    text = ONE_MASS.replace("count: 1", "count: 2") + (
        "clocks: {tick: 1 ms}\nlinks: {lan: {clock: tick}}\n"
        "couplers: {all: {type: Follower, flange: device, k: 1 N/m, clock: tick, link: lan}}\n"
    )
    system = compiled(text, own)
    (kind,) = system.kinds
    assert kind.sends[0].channels == ("all.x",), "equal expressions share a row"
    assert [(r.operator, r.channel) for r in kind.clocks[0].receives] == [("mean", 0), ("sum", 0)]
    assert ("all.v", "nobody hears it") in system.dropped


def test_a_value_of_the_tick_before_is_a_memory(tmp_path: Path) -> None:
    own = library(
        tmp_path,
        "component: Filter\nconnectors: {flange: Flange}\n"
        "parameters: {clock: clock, k: {unit: N/m}}\nvariables: {s: {unit: m, start: 2 mm}}\n"
        "equations: [s = 0.5*previous(s) + sample(flange.x), flange.f = k*hold(s)]\n",
    )
    text = ONE_MASS + (
        "clocks: {tick: 1 ms}\ncouplers: {all: {type: Filter, flange: device, k: 9 N/m, clock: tick}}\n"
    )
    system = compiled(text, own)
    (kind,) = system.kinds
    (tick,) = kind.clocks
    assert (tick.outputs, tick.memories, tick.starts) == (("all.s",), (0,), ("all.s",))
    p = vector(system, kind)
    assert numbers(tick.tick([0.25, 0], [0], [3.0], [], p, 0)) == [1.75]
    assert numbers(kind.derivative([0, 0], [0.5], p, 0)) == [0, -9 * 0.5 / 2]


def test_every_function_of_the_language_has_its_meaning(tmp_path: Path) -> None:
    terms = (
        "max(a, 1) + min(a, 1) + abs(a) + sign(a) + floor(a) + exp(a) + log(a + 9) + sin(a) + cos(a)"
        " + tanh(a) + sqrt(a + 9) + a^3 + tan(a) + asin(a/4) + acos(a/4) + atan(a)"
        " + sinh(a) + cosh(a) + atan2(a, 2) + atan2(2, a) + 1/(a + 9)^2 + (a + 9)^(1/3)"
        " + (if a < 1 and not a >= 2 or a == 3 then 4 else 5)"
    )
    own = library(
        tmp_path,
        "component: Odd\nconnectors: {flange: Flange}\nparameters: {k: {unit: N}, m: {unit: m}}\n"
        f"equations:\n  - a = flange.x/m\n  - flange.f = k*({terms})\n",
    )
    system = compiled(ONE_MASS + "hands: {odd: {type: Odd, flange: device, k: 1 N, m: 1 m}}\n", own)
    (kind,) = system.kinds
    p = vector(system, kind)
    for a in (-1.5, 0.5, 1.0, 2.5, 3.0):
        import math

        expected = max(a, 1) + min(a, 1) + abs(a) + math.copysign(1, a) + math.floor(a) + math.exp(a)
        expected += math.log(a + 9) + math.sin(a) + math.cos(a) + math.tanh(a) + math.sqrt(a + 9) + a**3
        expected += math.tan(a) + math.asin(a / 4) + math.acos(a / 4) + math.atan(a) + math.sinh(a)
        expected += math.cosh(a) + math.atan2(a, 2) + math.atan2(2, a)
        expected += 1 / (a + 9) ** 2 + (a + 9) ** (1 / 3) + (4 if a < 1 or a == 3 else 5)
        got = numbers(kind.derivative([a, 0.0], [], p, 0))[1]
        assert got == pytest.approx(-expected / 2, rel=1e-14), a


def test_the_largest_of_three_is_one_of_them(tmp_path: Path) -> None:
    own = library(
        tmp_path,
        "component: Odd\nconnectors: {flange: Flange}\nparameters: {k: {unit: N/m}}\n"
        "equations: ['flange.f = max(k*flange.x, 1.5*k*flange.x, 2*k*flange.x)']\n",
    )
    system = compiled(ONE_MASS + "hands: {odd: {type: Odd, flange: device, k: 3 N/m}}\n", own)
    (kind,) = system.kinds
    p = vector(system, kind)
    got = [numbers(kind.derivative([x, 0.0], [], p, 0))[1] for x in (-1.0, 1.0)]
    assert got == [3 / 2, -6 / 2]  # of 2 kg


def test_a_memory_that_nobody_reads_is_none(tmp_path: Path) -> None:
    own = library(
        tmp_path,
        "component: Filter\nconnectors: {flange: Flange}\n"
        "parameters: {clock: clock, k: {unit: N/m}}\nvariables: {s: {unit: m, start: 2 mm}}\n"
        "equations: [s = sample(flange.x), before = previous(s), flange.f = k*hold(s)]\n",
    )
    text = ONE_MASS + (
        "clocks: {tick: 1 ms}\ncouplers: {all: {type: Filter, flange: device, k: 9 N/m, clock: tick}}\n"
    )
    (kind,) = compiled(text, own).kinds
    assert (kind.clocks[0].outputs, kind.clocks[0].memories) == (("all.s",), ())
    assert "all.s" not in kind.parameters


def test_a_group_may_have_a_delay_of_its_own() -> None:
    groups = "one: {count: 1, set: {contact.delay: 2 ms}}\n  two: {count: 2}"
    system = compiled(replaced(AVERAGE, ("user: {count: 3}", groups)))
    one, two = system.groups
    assert one.kind != two.kind, "each has a schedule of its own"
    delays = [{hold.name: hold.delay for hold in system.kinds[group.kind].holds} for group in (one, two)]
    assert delays == [
        {"contact.f": "one.contact.delay", "coordination.f": "coordination.delay"},
        {"contact.f": "contact.delay", "coordination.f": "coordination.delay"},
    ]
    timings = {timing.name: timing.value for timing in system.timings}
    assert timings["one.contact.delay"] == Fraction(2, 1000)
    assert timings["contact.delay"] == Fraction(1, 1000)


def test_a_delay_is_the_same_for_all_peers_of_a_group() -> None:
    text = replaced(AVERAGE, ("{count: 3}", "{set: {contact.delay: [1 ms, 2 ms, 2 ms]}}"))
    (line,) = told(compiled, text)
    assert line == (
        "scene.yaml:7:9: E211 contact.delay can't differ from peer to peer within a group. "
        "Write: a group of its own for each delay"
    )


def test_groups_of_one_kind_share_its_functions() -> None:
    system = compiled(
        replaced(
            AVERAGE, ("user: {count: 3}", "one: {count: 1, set: {device.mass: 2 kg}}\n  two: {count: 9}")
        )
    )
    one, two = system.groups
    assert (one.kind, two.kind, len(system.kinds)) == (0, 0, 1)
    assert [(parameter.name, parameter.value) for parameter in one.values] == [("device.mass", 2.0)]
    assert two.values == ()
    assert system.peers == 10


def test_a_link_over_which_only_some_send_a_value_is_refused() -> None:
    text = replaced(
        AVERAGE,
        ("user: {count: 3}", "a: {count: 2}\n  b: {count: 2}"),
        (
            "  coordination:",
            "  grip: {type: AveragePosition, object: device, stiffness: 5 N/m, clock: haptic, link: lan,"
            " at: [a]}\n  coordination:",
        ),
    )
    (line,) = told(compiled, text)
    assert line.partition(": ")[2] == (
        "E215 grip.x travels over lan, and those of b send other values over it. "
        "Write: a link of its own for what only some groups send"
    )


def test_a_held_value_is_sent_though_only_another_kind_of_peer_hears_it(tmp_path: Path) -> None:
    """And what it is multiplied by, a parameter, is one of the sender's."""
    component = """\
component: Told
about: A client tells its force, held and in other units of it; the server puts it on its object.
source: this test
connectors: {object: Flange}
sends: {x: sample(object.x), f: gain*sample(acting)}
parameters:
  role: {options: [server, client], default: client, about: which of both}
  stiffness: {unit: N/m, min: 0, about: of the pull}
  gain: {unit: 1, default: 1, about: of what is told}
  clock: clock
  link: link
variables:
  pull: {unit: N, about: force}
  acting: {unit: N, about: held}
  f: {unit: N, about: on the object}
equations:
  - pull = stiffness*(sample(object.x) - mean(others.x))
  - acting = hold(pull)
  - f = if role == server then -sum(others.f) else pull
  - object.f = hold(f)
"""
    text = """\
topology: told
clocks: {tick: 1 ms}
peers:
  server: {count: 1, set: {it.role: server}}
  client: {count: 2}
masses: {cube: {mass: 1 kg, damping: 1 N*s/m}}
couplers: {it: {type: Told, object: cube, stiffness: 50 N/m, gain: 0.5, clock: tick, link: lan}}
links: {lan: {clock: tick, delay: 2 ms, graph: star}}
"""
    system = compiled(text, library(tmp_path, component))
    check_frame(system)
    server, client = system.kinds
    (send,) = client.sends
    place = send.channels.index("it.f")
    held = [hold.name for hold in client.holds].index("it.pull")
    u = [float(number == held) for number in range(len(client.holds))]
    values = {parameter.name: parameter.value for parameter in system.parameters}
    p = [values[name] for name in client.parameters]
    assert float(send.send([0.0] * len(client.states), u, p, 0)[place]) == 0.5
    assert [one.name for one in server.clocks[0].receives][-1] == "sum(others.it.f)"
