"""`flatten`: the equations of one peer of each kind, in whole names, after connection."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from apc.compiler.equations.flatten import FlatKind
from tests.topologies import AVERAGE, MESH, ONE_MASS, flat, library, replaced, scene, told


def only(text: str) -> FlatKind:
    (kind,) = flat(text).kinds
    return kind


def equations(kind: FlatKind, origin: str) -> list[str]:
    return [equation.text for equation in kind.equations if equation.origin == origin]


def test_a_part_is_its_component_in_whole_names() -> None:
    assert equations(only(ONE_MASS), "device") == [
        "der(device.x) = device.v",
        "device.mass*der(device.v) = device.flange.f - device.damping*device.v",
        "device.flange.x = device.x",
    ]


def test_where_connectors_meet_potentials_are_equal_and_flows_sum_to_zero() -> None:
    assert equations(only(AVERAGE), "connection") == [
        "contact.a.x = device.flange.x",
        "device.flange.f + contact.a.f = 0",
        "contact.b.x = cube.flange.x",
        "coordination.object.x = cube.flange.x",
        "cube.flange.f + contact.b.f + coordination.object.f = 0",
    ]


def test_a_connector_nobody_joins_has_no_flow() -> None:
    assert equations(only(ONE_MASS), "connection") == ["device.flange.f = 0"]


@pytest.mark.parametrize("text", [AVERAGE, MESH, ONE_MASS])
def test_a_kind_has_as_many_equations_as_unknowns(text: str) -> None:
    kind = only(text)
    assert len(kind.equations) == len(kind.variables)
    assert len({variable.name for variable in kind.variables}) == len(kind.variables)


def test_a_shared_object_divides_its_mass_among_the_copies_and_keeps_its_damping_whole() -> None:
    motion = equations(only(AVERAGE), "cube")[1]
    assert motion == "cube.mass/peers*der(cube.v) = cube.flange.f - cube.damping*cube.v"


def test_an_option_is_decided() -> None:
    assert equations(only(AVERAGE), "coordination")[-1] == (
        "coordination.object.f = hold(coordination.f, coordination.delay)"
    )
    own = only(replaced(AVERAGE, ("link: lan", "link: lan, delays: own")))
    assert equations(own, "coordination")[-1] == (
        "coordination.object.f = hold(coordination.own, coordination.delay) + hold(coordination.received)"
    )


def test_samples_and_others_carry_their_clock_and_part() -> None:
    lines = equations(only(MESH), "coordination")
    assert lines[0] == (
        "coordination.own = count(others.coordination)"
        "*(coordination.stiffness*sample(coordination.object.x, haptic)"
        " + coordination.damping*sample(der(coordination.object.x), haptic))"
    )
    assert lines[1] == (
        "coordination.received = -coordination.stiffness*sum(others.coordination.x)"
        " - coordination.damping*sum(others.coordination.v)"
    )
    sends = only(MESH).sends
    assert [(send.name, send.link) for send in sends] == [
        ("coordination.x", "lan"),
        ("coordination.v", "lan"),
    ]


def test_groups_that_differ_in_numbers_only_are_one_kind() -> None:
    kind = only(
        replaced(
            AVERAGE, ("user: {count: 3}", "one: {count: 1, set: {device.mass: 2 kg}}\n  two: {count: 9}")
        )
    )
    assert kind.groups == ("one", "two")
    assert kind.name == "one and two"


def test_groups_with_different_parts_are_different_kinds() -> None:
    text = replaced(AVERAGE, ("user: {count: 3}", "one: {count: 1}\n  two: {count: 2}"))
    text += "hands:\n  hand: {type: ConstantForce, flange: device, force: 1 N, at: [one]}\n"
    one, two = flat(text).kinds
    assert (one.groups, two.groups) == (("one",), ("two",))
    assert set(one.parts) - set(two.parts) == {"hand"}
    assert "device.flange.f + contact.a.f + hand.flange.f = 0" in equations(one, "connection")
    assert "device.flange.f + contact.a.f = 0" in equations(two, "connection")


def test_the_number_of_peers_costs_no_equation() -> None:
    assert only(AVERAGE).equations == only(AVERAGE.replace("count: 3", "count: 1000000")).equations


def test_a_part_cannot_join_one_that_is_elsewhere() -> None:
    text = replaced(
        AVERAGE,
        ("user: {count: 3}", "one: {count: 2}\n  two: {count: 2}"),
        ("damping: 5 N*s/m}", "damping: 5 N*s/m, at: [one]}"),
    )
    (line,) = told(flat, text)
    assert line == (
        "scene.yaml:13:3: E210 contact is at groups where device, which it joins, is not. "
        "Write: at: the same groups at both contact and device"
    )


def test_a_word_stands_for_its_number(tmp_path: Path) -> None:
    own = library(
        tmp_path,
        "component: Pusher\nconnectors: {flange: Flange}\n"
        "parameters: {side: {unit: N, options: {left: -1 N, right: 1 N}}}\n"
        "equations: ['flange.f = if side == left then 2*side else side']\n",
    )
    text = ONE_MASS + "hands:\n  hand: {type: Pusher, flange: device, side: left}\n"
    (kind,) = flat(text, own).kinds
    assert equations(kind, "hand") == ["hand.flange.f = if hand.side == -1 then 2*hand.side else hand.side"]
    assert dict(scene(text, own).part("hand").values)["side"].number == -1


def test_what_samples_or_sends_must_name_its_clock_or_link(tmp_path: Path) -> None:
    own = library(
        tmp_path,
        "component: Pusher\nconnectors: {flange: Flange}\nsends: {x: flange.x}\n"
        "parameters: {stiffness: {unit: N/m}}\nequations: ['flange.f = stiffness*hold(sample(flange.x))']\n",
    )
    text = ONE_MASS + "hands:\n  hand: {type: Pusher, flange: device, stiffness: 1 N/m}\n"
    lines = [line.rpartition("/")[2] for line in told(flat, text, own)]
    assert lines == [
        "part0.yaml:3:12: E504 Pusher sends x but has no parameter that names one link. "
        "Write: parameters: {link: link}",
        "part0.yaml:5:40: E504 Pusher samples but has no parameter that names one clock. "
        "Write: parameters: {clock: clock}",
    ]


LATE = """\
component: LateMean
connectors: {object: Flange}
sends: {x: "hold(w, lag)*1"}
parameters: {stiffness: {unit: N/m}, lag: {unit: s, default: 1 ms}, clock: clock, link: link}
equations:
  - w = sample(object.x)
  - f = stiffness*(sample(object.x) - mean(others.x))
  - object.f = hold(f)
"""


@pytest.mark.parametrize("groups", ["one: {count: 1}", "one: {count: 1, set: {coordination.lag: 5 ms}}"])
def test_a_delay_in_what_is_sent_is_the_groups_own(tmp_path: Path, groups: str) -> None:
    text = f"""\
topology: late
clocks: {{haptic: 1 ms, network: 8 ms}}
peers: {{{groups}, two: {{count: 2, set: {{coordination.lag: 5 ms}}}}}}
masses: {{cube: {{mass: 0.6 kg, damping: 5 N*s/m, shared: true}}}}
couplers:
  coordination: {{type: LateMean, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}}
links: {{lan: {{clock: network, delay: 8 ms}}}}
"""
    kinds = flat(text, library(tmp_path, LATE)).kinds
    assert [kind.groups for kind in kinds] == [("one",), ("two",)], "each can be changed on its own"
    assert [[(name, group, value.number) for name, group, value in kind.delays] for kind in kinds][1] == [
        ("coordination.lag", "two", Fraction(5, 1000))
    ]
