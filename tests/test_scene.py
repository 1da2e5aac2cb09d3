"""`scene`: every quantity in SI and exact, every name resolved, every mistake of the file at once."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import pytest

from apc.compiler.compiled import Experiment
from apc.compiler.language.expression import format_expression
from apc.compiler.scene.groups import LARGEST_COUNT
from apc.compiler.scene.scene import build_scene
from apc.compiler.source.source import parse_source
from apc.compiler.store import model_of
from apc.frame.names import unit_of
from tests.topologies import AVERAGE, MESH, ONE_MASS, built_in, compiled, library, replaced, scene, told

GROUPS = replaced(
    AVERAGE,
    (
        "  user: {count: 3}",
        "  right: {count: 1, set: {device.mass: 200 g, device.x: 30 mm}}\n  left: {count: 2}",
    ),
)


def messages(*pairs: tuple[str, str], text: str = AVERAGE) -> list[str]:
    """Return what is told about a scene with pieces of its text replaced, without the file's name."""
    return [line.removeprefix("scene.yaml:") for line in told(scene, replaced(text, *pairs))]


def test_the_papers_scene_is_read_whole_and_in_exact_si() -> None:
    found = scene(AVERAGE)
    assert found.name == "three-users-average"
    assert found.peers == 3
    assert [(c.name, c.period.number, c.phase.number) for c in found.clocks] == [
        ("haptic", Fraction(1, 1000), 0),
        ("network", Fraction(1, 125), 0),
    ]
    assert [(part.name, part.section, part.component.name) for part in found.parts] == [
        ("device", "masses", "Mass"),
        ("cube", "masses", "Mass"),
        ("contact", "couplers", "SampledSpringDamper"),
        ("coordination", "couplers", "AveragePosition"),
    ]
    assert [(link.name, link.clock, link.delay.number, link.graph.shape) for link in found.links] == [
        ("lan", "network", Fraction(1, 125), "complete")
    ]
    device = dict(found.part("device").values)
    assert device["mass"].number == Fraction(1, 10)
    assert found.part("cube").shared
    assert not found.part("device").shared
    assert found.part("contact").connections == (("a", "device", "flange"), ("b", "cube", "flange"))
    coordination = found.part("coordination")
    assert (coordination.reference("clock"), coordination.reference("link")) == ("haptic", "lan")
    assert dict(coordination.values)["damping"].number == 0, "a default"
    assert dict(coordination.options) == {"delays": "all"}
    assert [(axis.parameter, axis.low, axis.high) for axis in found.region] == [
        ("contact.stiffness", 0, 5000),
        ("coordination.stiffness", 0, 1500),
    ]


def test_units_convert_exactly() -> None:
    found = scene(
        replaced(
            AVERAGE,
            ("mass: 0.1 kg", "mass: 100 g"),
            ("1000 N/m", "1 N/mm"),
            ("haptic: 1 ms", "haptic: 1/90 s"),
        )
    )
    assert dict(found.part("device").values)["mass"].number == Fraction(1, 10)
    assert dict(found.part("contact").values)["stiffness"].number == 1000
    assert found.clocks[0].period.number == Fraction(1, 90)


def test_a_rate_serves_as_a_period_and_a_clock_may_have_a_phase() -> None:
    found = scene(replaced(AVERAGE, ("haptic: 1 ms", "haptic: {period: 1 kHz, phase: 0.25 ms}")))
    clock = found.clocks[0]
    assert (clock.period.number, clock.phase.number) == (Fraction(1, 1000), Fraction(1, 4000))


def test_an_expression_may_name_parameters_and_the_number_of_peers() -> None:
    found = scene(
        replaced(
            AVERAGE,
            ("clocks:", "parameters: {half: whole/2, whole: 2000 N/m}\nclocks:"),
            ("500 N/m,", "half/(peers - 1),"),
        )
    )
    assert dict(found.parameters)["half"].number == 1000, "whichever stands first"
    value = dict(found.part("coordination").values)["stiffness"]
    assert value.number == 500
    assert value.expression is not None and format_expression(value.expression) == "half/(peers - 1)"


def test_a_group_sets_parameters_and_start_values_of_its_own() -> None:
    found = scene(GROUPS)
    assert found.peers == 3
    right, left = found.groups
    assert {name: value.number for name, value in right.values} == {
        "device.mass": Fraction(1, 5),
        "device.x": Fraction(3, 100),
    }
    assert left.values == ()
    assert found.part("device").groups == ("right", "left")


def test_a_part_may_be_at_some_groups_only() -> None:
    found = scene(
        GROUPS + "hands:\n  hand: {type: ConstantForce, flange: device, force: -4 N, at: [right]}\n"
    )
    assert found.part("hand").groups == ("right",)


def test_start_values_stand_with_their_part() -> None:
    found = scene(ONE_MASS.replace("2 kg,", "2 kg, x: 5 mm,"))
    assert [(name, value.number) for name, value in found.part("device").starts] == [("x", Fraction(1, 200))]


def test_an_experiment_has_a_duration_and_a_seed() -> None:
    found = scene(ONE_MASS + "experiment: {duration: 3 s, seed: 7}\n")
    assert (found.experiment.duration, found.experiment.seed) == (3, 7)
    assert scene(ONE_MASS).experiment == Experiment(None, 0)


def test_all_mistakes_of_a_file_come_together_in_its_order() -> None:
    assert messages(
        ("haptic: 1 ms", "haptic: 1 kg"), ("0.1 kg", "0.1"), ("link: lan", "link: lam"), ("8 ms}", "-8 ms}")
    ) == [
        "4:11: E204 haptic wants ms, got 1 kg.",
        "9:18: E204 mass wants kg, got 0.1 (no unit). Write: mass: 0.1 kg",
        "13:109: E206 coordination names link lam, which isn't in links; the nearest is lan. Write: lan",
        "15:32: E207 delay wants 0 ms or more, got -8 ms.",
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "1000 N/m",
            "1000 N*m",
            "12:76: E204 stiffness wants N/m, got 1000 N*m. Write: stiffness: 1000 N/m",
        ),
        ("stiffness: 1000 N/m, ", "", "12:3: E201 contact has no stiffness. Write: stiffness: 1 N/m"),
        (
            "clock: haptic, delay: 1 ms}",
            "delay: 1 ms}",
            "12:3: E201 contact has no clock. Write: clock: haptic",
        ),
        ("a: device, ", "", "12:3: E210 contact does not say what its a is joined to. Write: a: device"),
        (
            "a: device",
            "a: devise",
            "12:48: E206 contact joins its a to devise, which is no part of this topology; "
            "the nearest is device. Write: device",
        ),
        (
            "a: device",
            "a: device.flang",
            "12:48: E206 device (Mass) has no Flange called flang; the nearest is flange. Write: flange",
        ),
        (
            "a: device",
            "a: lan",
            "12:48: E210 lan (Link) has no connector of type Flange to join a to.",
        ),
        (
            "type: AveragePosition",
            "type: Flange",
            "13:24: E206 Flange is a connector type, not a component. Write: type: SampledSpringDamper",
        ),
        (
            "type: SampledSpringDamper, ",
            "",
            "12:3: E201 contact has no type. Write: type: SampledSpringDamper",
        ),
        (
            "link: lan",
            "link: lan, delays: som",
            "13:122: E206 delays wants all or own, got som. Write: delays: all",
        ),
        (
            "shared: true",
            "shared: yes",
            "10:52: E203 shared wants true or false, got yes. Write: shared: true",
        ),
        (
            "clock: network, delay",
            "clock: network, shared: true, delay",
            "15:33: E210 lan can't be shared: nothing of a Link is divided.",
        ),
        (
            "count: 3",
            f"count: {LARGEST_COUNT + 1}",
            "7:17: E208 count wants a whole number from 1 to 1000000000, got 1000000001. Write: count: 3",
        ),
        (
            "{count: 3}",
            "{}",
            "7:9: E201 group user has no count. Write: count: 3",
        ),
        (
            "{count: 3}",
            "{count: 3, set: {device.mas: 1 kg}}",
            "7:26: E206 set names device.mas, which is no parameter or variable of a part; "
            "the nearest is device.mass. Write: device.mass",
        ),
        (
            "{count: 3}",
            "{count: 3, set: {device.mass: 0 kg}}",
            "7:39: E207 device.mass wants more than 0 kg, got 0 kg.",
        ),
        (
            "haptic: 1 ms",
            "haptic: {period: 1 ms, phase: 1 ms}",
            "4:33: E207 the phase of clock haptic wants 0 s or more and less than its period, got 0.001 s.",
        ),
        ("haptic: 1 ms", "haptic: 0 Hz", "4:11: E207 haptic wants a rate above 0 Hz, got 0 Hz."),
        ("haptic: 1 ms", "1haptic: 1 ms", "4:3: E205 the name of a clock wants a letter followed by"),
        ("  cube:   {", "  haptic: {", "10:3: E205 the name haptic is used twice in this topology."),
        (
            "[0 N/m, 5000 N/m]",
            "[5000 N/m, 0 N/m]",
            "17:35: E207 the range of contact.stiffness wants its lower end first, got 5000 N/m to 0 N/m.",
        ),
        ("[0 N/m, 5000 N/m]", "5000 N/m", "17:35: E203 contact.stiffness wants a list of two values"),
        (
            "clocks:",
            "parameters: {a: b, b: c, c: a}\nclocks:",
            "3:17: E209 parameters depend in a circle: a → b → c → a.",
        ),
        (
            "clocks:",
            "parameters: {kt: kp}\nclocks:",
            "3:18: E206 kt names kp, which is no parameter here; there are: peers.",
        ),
        (
            "500 N/m,",
            "peers,",
            "13:66: E204 stiffness wants N/m, got peers, which has no unit. Write: stiffness: 1 N/m",
        ),
        (
            "clocks:",
            "experiment: {duration: 0 s}\nclocks:",
            "3:24: E207 duration wants more than 0 s, got 0 s.",
        ),
        (
            "clocks:",
            "experiment: {seed: -1}\nclocks:",
            "3:20: E203 seed wants a whole number, 0 or more, got -1.",
        ),
        (
            "clocks:",
            "experiment: {seed: true}\nclocks:",
            "3:20: E203 seed wants a whole number, 0 or more, got true.",
        ),
        (
            "studies:",
            "studis:",
            "16:1: E202 a topology has no key studis; the nearest is studies. Write: studies",
        ),
        (
            "couplers:",
            "coupler:",
            "11:1: E202 a topology has no key coupler; the nearest is couplers. Write: couplers",
        ),
    ],
)
def test_a_mistake_is_told_once_at_its_place(old: str, new: str, message: str) -> None:
    lines = messages((old, new))
    if "E205" in message:  # what has no good name can't be found by the others either
        lines = lines[:1]
    (line,) = lines
    assert line.startswith(message)


def test_what_is_set_of_a_part_that_cannot_be_read_is_no_second_mistake() -> None:
    lines = messages(
        ("{count: 3}", "{count: 3, set: {device.mass: 1 kg}}"), ("0.1 kg,", "0.1 kg, type: Mas,")
    )
    assert lines == ["9:32: E206 there is no component Mas; the nearest is Mass. Write: Mass"]


def test_a_group_cannot_set_what_is_of_a_link() -> None:
    groups = "  left: {count: 1, set: {lan.delay: 2 ms}}\n  right: {count: 2, set: {lan.clock: haptic}}"
    assert messages(("  user: {count: 3}", groups)) == [
        "7:26: E211 lan.delay is of a link, the same for all peers: a group can't set it. "
        "Write: lan: {delays: {left: {right: 12 ms}}}",
        "8:27: E211 lan.clock is of a link, the same for all peers: a group can't set it.",
    ]
    delays = ("delay: 8 ms}", "delay: 8 ms, delays: {left: {right: 12 ms}}}")
    (link,) = scene(
        replaced(AVERAGE, ("  user: {count: 3}", "  left: {count: 1}\n  right: {count: 2}"), delays)
    ).links
    ((sender, receiver, delay),) = [(d.sender, d.receiver, d.delay.number) for d in link.delays]
    assert (sender, receiver, delay) == ("left", "right", Fraction(12, 1000))


def test_at_names_groups() -> None:
    assert messages(("a: device,", "a: device, at: [usr],")) == [
        "12:61: E206 contact is at usr, which is no group of peers; the nearest is user. Write: user"
    ]


def test_one_peer_cannot_follow_the_others() -> None:
    assert messages(("count: 3", "count: 1"), text=MESH) == [
        "13:3: E208 coordination (FullMesh) follows the other peers and wants at least 2 peers, got 1. "
        "Write: count: 2"
    ]


def test_what_is_not_a_mapping_is_no_topology() -> None:
    assert told(scene, "- a\n") == [
        "scene.yaml:1:1: E203 a topology wants a mapping of keys to values, got a list. "
        "Write: topology: my-scene"
    ]


KINDS = """\
topology: kinds
clocks: {haptic: 1 ms, slow: 2 ms, network: 8 ms}
peers: {left: {count: 2}, right: {count: 2}}
masses:
  device: {mass: 0.1 kg}
  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic}
  coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}
links:
  lan: {clock: network, delay: 8 ms}
  wan: {clock: network, delay: 8 ms}
hands:
  arm: {type: SpringDamperArm, flange: device, stiffness: 50 N/m, damping: 1 N*s/m}
"""
# Of each kind of part: what stands there, a key more or another, and, if it is refused, the code of why.
DEVICE, CONTACT, LAN, ARM = "mass: 0.1 kg", "b: cube, ", "lan: {clock: network", "flange: device, "
KEYS = [
    (DEVICE, "type: Falcon, mass: 0.1 kg", ""),
    (DEVICE, "mass: 0.1 kg, at: [left]", "E210"),
    (DEVICE, "mass: 0.1 kg, shared: true", ""),
    (DEVICE, "mass: 0.1 kg, count: 2", "E210"),
    (DEVICE, "mass: 0.1 kg, flange: cube", ""),
    (DEVICE, "mass: 0.1 kg, x: 1 mm", ""),
    (DEVICE, "mass: 0.2 kg", ""),
    (CONTACT, "b: cube, at: [left], ", ""),
    (CONTACT, "b: cube, at: [], ", "E203"),
    (CONTACT, "b: cube, shared: true, ", "E210"),
    (CONTACT, "b: cube, count: 2, ", ""),
    (CONTACT, "b: ground, ", ""),
    (CONTACT, "b: cube, delay: 1 ms, ", ""),
    (CONTACT, "b: cube, link: lan, ", "E202"),
    (CONTACT, "b: cube, graph: ring, ", "E202"),
    (LAN, "lan: {type: Mass, clock: network", "E201 E202 E210"),
    (LAN, "lan: {at: [left], clock: network", "E211"),
    (LAN, "lan: {at: left, clock: network", "E211"),
    (LAN, "lan: {shared: true, clock: network", "E210"),
    (LAN, "lan: {count: 2, clock: network", "E208"),
    (LAN, "lan: {clock: slow", ""),
    (LAN, "lan: {graph: ring, clock: network", ""),
    (LAN, "lan: {delays: {left: {right: 9 ms}}, clock: network", ""),
    (LAN, "lan: {loss: 1 %, clock: network", ""),
    (LAN, "lan: {loss: 1 %, on_loss: zero, clock: network", ""),
    (LAN, "lan: {jitter: 1 ms, clock: network", ""),
    (LAN, "lan: {jitter: 1 ms, distribution: pareto, clock: network", ""),
    (LAN, "lan: {jitter: 1 ms, reorder: all, clock: network", ""),
    (LAN, "lan: {distribution: pareto, clock: network", "E262"),
    (ARM, "flange: device, at: [right], ", ""),
    (ARM, "flange: device, at: [left, right], ", "same"),
    (ARM, "flange: device, shared: true, ", "E210"),
    (ARM, "flange: device, count: 2, ", ""),
    (ARM, "flange: cube, ", ""),
    (ARM, "flange: device, position: 1 mm, ", ""),
    ("left: {count: 2", "left: {count: 2, set: {arm.stiffness: 60 N/m}", ""),
    ("left: {count: 2", "left: {count: 2, set: {lan.delay: 9 ms}", "E211"),
    ("link: lan", "link: lan, at: [right]", ""),
]


@pytest.mark.parametrize(("old", "new", "codes"), KEYS)
def test_every_key_of_every_kind_of_part_is_obeyed_or_refused(old: str, new: str, codes: str) -> None:
    """A key is accepted only where it makes another model: not a byte of it would be written otherwise."""
    text = replaced(KINDS, (old, new))
    if codes not in ("", "same"):
        assert sorted({line.split()[1] for line in told(compiled, text)}) == codes.split()
        return
    assert (model_of(compiled(KINDS)) == model_of(compiled(text))) == (codes == "same")


def test_who_takes_part_is_said_by_what_uses_a_link() -> None:
    [line] = messages(("lan: {clock", "lan: {at: [left], clock"), text=KINDS)
    assert line == (
        "11:13: E211 lan is a link, which joins all peers: who takes part is said by what uses it. "
        "Write: coordination: {at: [left]}"
    )
    [line] = messages(("lan: {clock", "lan: {at: [], clock"), text=KINDS)
    assert line.endswith("Write: coordination: {at: [left, right]}")
    assert not messages(("link: lan}", "link: lan, at: [left]}"), text=KINDS)


def test_a_group_sets_nothing_of_a_part_that_it_has_not() -> None:
    text = replaced(KINDS, ("b: cube, ", "b: cube, at: [left], "))
    line = ("right: {count: 2}", "right: {count: 2, set: {contact.stiffness: 1 N/m}}")
    assert messages(line, text=text) == [
        "3:51: E211 right sets contact.stiffness and has no contact, which is at left. "
        "Write: at: [left, right]"
    ]


@pytest.mark.parametrize(
    ("body", "has"),
    [
        ("extends: Link\nparameters: {colour: {unit: 1, default: 1}}\n", "colour"),
        ("extends: Link\nvariables: {x: {unit: m}}\nequations: [x = 0]\n", "x"),
    ],
)
def test_what_no_link_obeys_is_refused_of_its_component(body: str, has: str, tmp_path: Path) -> None:
    own = library(tmp_path, f"component: Own\n{body}")
    text = replaced(KINDS, ("wan: {", "wan: {type: Own, "))
    assert [line.partition("E210 ")[2] for line in told(lambda: scene(text, own))] == [
        f"wan is a Own, which is no link: a link has no {has}. Write: type: Link"
    ]
    text = replaced(KINDS, ("  contact: {", "  carried: {type: Link, clock: network}\n  contact: {"))
    assert [line.split()[1] for line in told(scene, text)] == ["E210"]


SHAKEN = """\
topology: shaken
parameters: {f: 2 Hz, w: 4 rad/s}
peers: {user: {count: 1}}
masses: {device: {mass: 1 kg}}
hands: {push: {type: SineForce, flange: device, force: 1 N, frequency: f, phase: 90 deg}}
"""


def test_what_counts_cycles_or_radians_is_shown_in_its_unit_everywhere() -> None:
    found = compiled(SHAKEN)
    units = {one.name: one.unit for one in found.parameters}
    assert (units["f"], units["w"], units["push.frequency"], units["push.phase"]) == (
        "Hz",
        "rad/s",
        "Hz",
        "rad",
    )
    assert unit_of(found, "push.frequency") == "Hz"


@pytest.mark.parametrize(
    ("written", "told_of", "right"),
    [
        ("w", "w, which is in rad/s. Write: frequency: w/(2*pi)", "w/(2*pi)"),
        ("2*(f + f) - f", "", ""),
        ("w + w", "w + w, which is in rad/s. Write: frequency: (w + w)/(2*pi)", "(w + w)/(2*pi)/2"),
    ],
)
def test_a_name_keeps_what_its_unit_counts(written: str, told_of: str, right: str) -> None:
    line = messages(("frequency: f", f"frequency: {written}"), text=SHAKEN)
    assert [one.partition("wants Hz, got ")[2] for one in line] == [told_of][: bool(told_of)]
    if right:
        found = scene(replaced(SHAKEN, ("frequency: f", f"frequency: {right}")))
        frequency = dict(found.part("push").values)["frequency"].number
        assert float(frequency) == pytest.approx(4 / (2 * math.pi))


def test_no_name_of_a_topology_or_component_is_pi(tmp_path: Path) -> None:
    assert messages(("f: 2 Hz", "pi: 3, f: 2 Hz"), text=SHAKEN) == [
        "2:14: E205 pi is a word of the language and can't be a name."
    ]
    own = "component: Own\nparameters: {pi: {unit: 1}}\nconnectors: {a: Flange}\nequations: [a.f = 0]\n"
    text = replaced(ONE_MASS, ("  device: {", "  other: {type: Own, pi: 3}\n  device: {"))
    assert "E205 pi is a word" in told(lambda: scene(text, library(tmp_path, own)))[0]


def test_a_table_tells_cycles_and_radians_apart(tmp_path: Path) -> None:
    (tmp_path / "users.csv").write_text("push.frequency [rad/s]\n1\n2\n", encoding="utf-8")
    text = replaced(SHAKEN, ("user: {count: 1}", "user: {table: users.csv}"))
    read = parse_source(text.encode(), file="scene.yaml", path=tmp_path / "scene.yaml")
    [line] = told(build_scene, read, built_in())
    assert line.partition("E702 ")[2] == (
        "the heading push.frequency wants [Hz], got [rad/s]. Write: push.frequency [Hz], each divided by 2*pi"
    )
