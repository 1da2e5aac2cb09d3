"""Claims about `apc.frame.overrides`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from apc.compiler.compiled import PEERS, CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.frame.names import Free
from apc.frame.overrides import Override, apply, parse_override
from apc.frame.parameters import resolve
from tests.sites import NAMES, columned, derived, grouped, paper
from tests.topologies import SCENES, compiled, library


def _value(system: CompiledSystem, name: str, group: int = 0) -> float:
    return float(resolve(system).parameters[group][0, NAMES.index(name)])


def _message(system: CompiledSystem, text: str) -> str:
    with pytest.raises(ApcError) as caught:
        apply(system, [parse_override(system, text)])
    [mistake] = caught.value.mistakes
    return f"{mistake.code} {mistake.sentence}"


def _column(system: CompiledSystem, name: str) -> list[float]:
    """Return a parameter's value of each peer of the first group."""
    numbers = resolve(system)
    return [float(value) for value in numbers.parameters[0][numbers.rows[0], NAMES.index(name)]]


@pytest.mark.parametrize("name", ["contact.stiffness", "couplers.contact.stiffness"])
def test_an_override_reaches_every_group(name: str) -> None:
    system = grouped(paper(), ("left", 1, {"contact.stiffness": 7.0}), ("right", 1, {}))
    override = parse_override(system, f"{name}=0.8 N/mm")
    assert override == Override(Free("contact.stiffness"), Fraction(800))
    changed = apply(system, [override])
    assert [_value(changed, "contact.stiffness", group) for group in (0, 1)] == [800.0, 800.0]


def test_an_override_of_a_group_leaves_the_others() -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 1, {}))
    changed = apply(system, [parse_override(system, "right.device.mass = 150 g")])
    assert [_value(changed, "device.mass", group) for group in (0, 1)] == [0.1, 0.15]


def test_what_depends_on_a_parameter_follows_it() -> None:
    system = derived(paper(), coordination__stiffness="kt/(peers - 1)", lan__delay="2*wait")
    changed = apply(system, [Override(Free("kt"), Fraction(3000)), Override(Free("wait"), Fraction(1, 90))])
    assert _value(changed, "coordination.stiffness") == 1500.0
    assert resolve(changed).timings["lan.delay"] == Fraction(1, 45)


def test_what_no_override_reaches_keeps_its_very_number() -> None:
    system = derived(paper(kt=0.1 + 0.2), coordination__stiffness="kt/(peers - 1)")
    changed = apply(system, [Override(Free("contact.stiffness"), Fraction(800))])
    assert _value(changed, "coordination.stiffness") == 0.1 + 0.2


def test_a_decimal_in_the_text_is_a_decimal_again_for_times() -> None:
    system = derived(paper(), lan__delay="2*wait + kt*wait/kt")
    changed = apply(system, [Override(Free("kt"), Fraction(7))])
    assert resolve(changed).timings["lan.delay"] == Fraction(24, 1000)


def test_a_group_value_can_change_what_everybody_derives_from_it() -> None:
    system = derived(paper(), coordination__stiffness="2*kt")
    changed = apply(
        replace(grouped(system, ("left", 1, {}), ("right", 2, {}))),
        [Override(Free("kt", "left"), Fraction(10))],
    )
    assert [_value(changed, "coordination.stiffness", group) for group in (0, 1)] == [20.0, 500.0]


def test_a_group_takes_over_only_what_its_own_value_reaches() -> None:
    system = grouped(derived(paper(), coordination__stiffness="2*kt"), ("left", 1, {}), ("right", 2, {}))
    overrides = [
        Override(Free("coordination.stiffness"), Fraction(7)),
        Override(Free("device.mass", "left"), Fraction(1)),
    ]
    changed = apply(system, overrides)
    assert [[value.name for value in group.values] for group in changed.groups] == [["device.mass"], []]
    assert [_value(changed, "coordination.stiffness", group) for group in (0, 1)] == [7.0, 7.0]


def test_setting_a_dependent_parameter_ends_its_dependence() -> None:
    system = derived(paper(), coordination__stiffness="2*kt")
    once = apply(system, [Override(Free("coordination.stiffness"), Fraction(5))])
    again = apply(once, [Override(Free("kt"), Fraction(1))])
    assert _value(again, "coordination.stiffness") == 5.0


@pytest.mark.parametrize(
    ("text", "setting", "message"),
    [
        ("2 + 500/(kt - 3)", "kt=3 N/m", "1:5: E331 500/(kt - 3) divides by zero."),
        ("500*(1 + log(kt))", "kt=0 N/m", "1:10: E331 log(kt) has no real value."),
        ("max(1, exp(kt), 2)", "kt=1000 N/m", "1:8: E331 exp(kt) is too large for a number."),
        ("if not kt > 3 then 1/(kt - 3) else sqrt(kt)", "kt=3 N/m", "1:20: E331 1/(kt - 3) divides by zero."),
        ("-(kt - 3)^(-2)", "kt=3 N/m", "1:2: E331 (kt - 3)^(-2) divides by zero."),
    ],
)
def test_what_has_no_value_any_more_is_told_with_its_place(text: str, setting: str, message: str) -> None:
    system = derived(paper(), coordination__stiffness=text)
    with pytest.raises(ApcError) as caught:
        apply(system, [parse_override(system, setting)])
    assert str(caught.value).splitlines()[0] == f"coordination.stiffness:{message}"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("if kt == 0 then 7 else 1/kt", 7.0),
        ("if kt != 0 and 1/kt > 2 then 1 else 2", 2.0),
        ("if kt == 0 or log(kt) > 2 then 1 else 2", 1.0),
        ("sqrt(kt + 4/9)*3", 2.0),
        ("(kt + 4)^(-1/2) + floor(kt - 1/2) + 2*sign(kt + 1) + abs(kt - 1)", 2.5),
        ("min(kt, 1, -3) + max(kt, 1, -3)", -2.0),
    ],
)
def test_what_is_not_asked_for_does_no_harm_and_rationals_stay_exact(text: str, value: float) -> None:
    system = derived(paper(), coordination__stiffness=text, coordination__damping="0*kt")
    free = replace(system, parameters=tuple(replace(one, minimum=None) for one in system.parameters))
    changed = apply(free, [Override(Free("kt"), Fraction(0))])
    assert _value(changed, "coordination.stiffness") == value
    found = next(one for one in changed.parameters if one.name == "coordination.stiffness")
    assert found.exact == Fraction(value)


def test_a_time_is_exact() -> None:
    override = parse_override(paper(), "clocks.network.period=1/90 s")
    assert override == Override(Free("network.period"), Fraction(1, 90))


def test_mistakes_say_what_to_write() -> None:
    system = paper()
    assert _message(system, "contact.stifness=8 N/m") == (
        "E622 contact.stifness is no parameter of paper. Write: contact.stiffness"
    )
    assert _message(system, "contact.stiffness") == (
        "E621 an override wants NAME=VALUE, got contact.stiffness. Write: contact.stiffness=800 N/m"
    )
    assert _message(system, "contact.stiffness=800") == (
        "E204 contact.stiffness wants N/m, got 800 (no unit). Write: contact.stiffness=800 N/m"
    )
    assert _message(system, "peers=4").startswith("E623 peers is the number of all peers")
    assert _message(system, "cube.mass=0 kg") == "E624 cube.mass wants more than 0 kg, got 0 kg."
    assert _message(system, "contact.damping=-1 N*s/m") == (
        "E624 contact.damping wants at least 0 N*s/m, got -1 N*s/m."
    )
    assert _message(system, "haptic.period=0 s") == "E625 haptic.period wants a time above 0 s, got 0.0 s."
    assert _message(system, "lan.delay=-1 ms") == "E625 lan.delay wants a time of 0 s or more, got -0.001 s."


def test_a_timing_has_one_value_for_all_groups() -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 1, {}))
    assert _message(system, "left.lan.delay=1 ms").startswith("E622 left.lan.delay is no parameter of paper")


@pytest.mark.parametrize("name", ["device.mass", "user.device.mass"])
def test_an_override_replaces_a_column(name: str) -> None:
    system = columned(paper(), device__mass=[0.1, 0.2, 0.1])
    changed = apply(system, [parse_override(system, f"{name}=0.5 kg")])
    assert _column(changed, "device.mass") == [0.5, 0.5, 0.5]
    kept = apply(system, [parse_override(system, "contact.stiffness=5 N/m")])
    assert _column(kept, "device.mass") == [0.1, 0.2, 0.1]


THIRDS = """\
topology: thirds
clocks: {haptic: 1 ms, network: 8 ms}
parameters: {ratio: 5/3, base: 4.8 ms}
peers: {user: {count: 3}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}
  coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}
links: {lan: {clock: network, delay: base*ratio}}
"""


@pytest.mark.parametrize("setting", ["base=4.8 ms", "ratio=5/3"])
def test_a_time_that_depends_on_a_third_stays_the_very_tick(setting: str) -> None:
    """4.8 ms · 5/3 is 8 ms: a packet that came 2e-19 s later would miss its tick."""
    system = compiled(THIRDS)
    changed = apply(system, [parse_override(system, setting)])
    assert resolve(changed).timings["lan.delay"] == Fraction(8, 1000)


def _own_values(system: CompiledSystem) -> list[Override]:
    """Return every number and time of a scene as an override that sets it to what it is."""
    own = {value.name for group in system.groups for value in group.values}
    own |= {column.name for group in system.groups for column in group.columns}
    found = [Override(Free(one.name), one.number) for one in system.parameters if one.name not in own]
    found += [Override(Free(one.name), one.value) for one in system.timings]
    found += [
        Override(Free(one.name, group.name), one.number)
        for group in system.groups
        for one in group.values
        if one.formula is None
    ]
    return [one for one in found if one.free.name != PEERS]


@pytest.mark.parametrize("scene", sorted(path.name for path in SCENES.glob("*.yaml")))
def test_setting_a_number_to_what_it_is_changes_nothing(scene: str) -> None:
    system = compile_topology(SCENES / scene)
    before = resolve(system)
    for override in _own_values(system):
        after = resolve(apply(system, [override]))
        assert after.timings == before.timings, override
        for one, other in zip(after.parameters, before.parameters, strict=True):
            assert np.array_equal(one, other), override


OUTER = """\
component: Outer
connectors: {a: Flange, b: Flange}
parameters: {k: {unit: N/m}, lag: {unit: s, default: 1 ms}, slack: {unit: s, default: 0 s}, clock: clock}
parts:
  inner: {type: SampledSpringDamper, a: a, b: b, stiffness: 2*k, clock: clock, delay: lag + slack}
"""
NESTED = """\
topology: nested
clocks: {haptic: 1 ms, slow: 2 ms}
peers: {one: {count: 1}, two: {count: 2, set: {o.k: 7 N/m, o.lag: 2 ms, o.clock: slow}}}
masses: {device: {mass: 0.1 kg}, cube: {mass: 0.1 kg}}
couplers: {o: {type: Outer, a: device, b: cube, k: 1 N/m, clock: haptic}}
"""


@pytest.mark.parametrize(
    ("settings", "stiffness", "delays"),
    [
        ([], (2, 14), (1, 2)),
        (["o.k=3 N/m"], (6, 6), (1, 2)),
        (["two.o.k=3 N/m"], (2, 6), (1, 2)),
        (["o.lag=5 ms"], (2, 14), (5, 2)),
        (["two.o.lag=5 ms"], (2, 14), (1, 5)),
        (["o.lag=5 ms", "two.o.lag=3 ms"], (2, 14), (5, 3)),
        (["o.slack=1 ms"], (2, 14), (2, 3)),
    ],
)
def test_what_a_group_sets_of_a_part_reaches_the_parts_inside(
    tmp_path: Path, settings: list[str], stiffness: tuple[int, int], delays: tuple[int, int]
) -> None:
    system = compiled(NESTED, library(tmp_path, OUTER))
    changed = apply(system, [parse_override(system, text) for text in settings])
    numbers = resolve(changed)
    kinds = [changed.kinds[group.kind] for group in changed.groups]
    rows = zip(kinds, numbers.parameters, strict=True)
    assert [row[0, kind.parameters.index("o.inner.stiffness")] for kind, row in rows] == list(stiffness)
    assert [numbers.timings[kind.holds[0].delay] * 1000 for kind in kinds] == list(delays)
    assert [kind.holds[0].clock for kind in kinds] == ["haptic", "slow"]


def test_a_group_can_not_set_what_a_time_of_all_groups_depends_on(tmp_path: Path) -> None:
    text = NESTED.replace("o.k: 7 N/m, o.lag: 2 ms, o.clock: slow", "o.k: 7 N/m")
    system = compiled(text, library(tmp_path, OUTER))
    assert _message(system, "two.o.lag=2 ms") == (
        "E622 o.inner.delay is one time for all groups, and depends on what is set for two. "
        "Write: the same without the group, or a group with a set of its own"
    )


def test_a_group_out_of_bounds_is_named() -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 1, {}))
    assert _message(system, "left.cube.mass=-1 kg") == "E624 left.cube.mass wants more than 0 kg, got -1 kg."


def test_a_peer_out_of_bounds_or_without_a_value_is_named() -> None:
    system = columned(paper(), device__mass=[0.1, 0.0, 0.1])
    assert _message(system, "contact.stiffness=5 N/m") == (
        "E624 user[2].device.mass wants more than 0 kg, got 0 kg."
    )
    heavy = columned(
        derived(paper(), coordination__stiffness="kt*(2 - cube.mass)"), cube__mass=[1.0, 1.0, 3.0]
    )
    assert _message(heavy, "contact.stiffness=5 N/m") == (
        "E624 user[3].coordination.stiffness wants at least 0 N/m, got -500 N/m."
    )
    divided = columned(derived(paper(), coordination__stiffness="kt/cube.mass"), cube__mass=[0.1, 0.1, 0.0])
    with pytest.raises(
        ApcError, match=r"E331 coordination.stiffness = kt/cube.mass has no finite value for user"
    ):
        resolve(divided)
