"""Claims about `apc.runtime.frame.overrides`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import pytest

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.runtime.frame.overrides import Override, apply, parse_override
from apc.runtime.frame.parameters import resolve
from tests.sites import NAMES, columned, derived, grouped, paper


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
    assert override == Override("contact.stiffness", None, Fraction(800))
    changed = apply(system, [override])
    assert [_value(changed, "contact.stiffness", group) for group in (0, 1)] == [800.0, 800.0]


def test_an_override_of_a_group_leaves_the_others() -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 1, {}))
    changed = apply(system, [parse_override(system, "right.device.mass = 150 g")])
    assert [_value(changed, "device.mass", group) for group in (0, 1)] == [0.1, 0.15]


def test_what_depends_on_a_parameter_follows_it() -> None:
    system = derived(paper(), coordination__stiffness="kt/(peers - 1)", lan__delay="2*wait")
    changed = apply(system, [Override("kt", None, Fraction(3000)), Override("wait", None, Fraction(1, 90))])
    assert _value(changed, "coordination.stiffness") == 1500.0
    assert resolve(changed).timings["lan.delay"] == Fraction(1, 45)


def test_what_no_override_reaches_keeps_its_very_number() -> None:
    system = derived(paper(kt=0.1 + 0.2), coordination__stiffness="kt/(peers - 1)")
    changed = apply(system, [Override("contact.stiffness", None, Fraction(800))])
    assert _value(changed, "coordination.stiffness") == 0.1 + 0.2


def test_a_decimal_in_the_text_is_a_decimal_again_for_times() -> None:
    system = derived(paper(), lan__delay="2*wait + kt*wait/kt")
    changed = apply(system, [Override("kt", None, Fraction(7))])
    assert resolve(changed).timings["lan.delay"] == Fraction(24, 1000)


def test_a_group_value_can_change_what_everybody_derives_from_it() -> None:
    system = derived(paper(), coordination__stiffness="2*kt")
    changed = apply(
        replace(grouped(system, ("left", 1, {}), ("right", 2, {}))), [Override("kt", "left", Fraction(10))]
    )
    assert [_value(changed, "coordination.stiffness", group) for group in (0, 1)] == [20.0, 500.0]


def test_setting_a_dependent_parameter_ends_its_dependence() -> None:
    system = derived(paper(), coordination__stiffness="2*kt")
    once = apply(system, [Override("coordination.stiffness", None, Fraction(5))])
    again = apply(once, [Override("kt", None, Fraction(1))])
    assert _value(again, "coordination.stiffness") == 5.0


def test_a_time_is_exact() -> None:
    override = parse_override(paper(), "clocks.network.period=1/90 s")
    assert override == Override("network.period", None, Fraction(1, 90))


def test_a_circle_is_a_contradiction_of_ours() -> None:
    system = derived(paper(), contact__stiffness="contact.damping", contact__damping="contact.stiffness")
    with pytest.raises(AssertionError, match="depends on itself"):
        apply(system, [Override("kt", None, Fraction(1))])


def test_mistakes_say_what_to_write() -> None:
    system = paper()
    assert _message(system, "contact.stifness=8 N/m") == (
        "E622 contact.stifness is no parameter of paper. Write: contact.stiffness"
    )
    assert _message(system, "contact.stiffness") == (
        "E621 an override wants NAME=VALUE, got contact.stiffness. Write: contact.stiffness=800 N/m"
    )
    assert _message(system, "contact.stiffness=800") == (
        "E204 contact.stiffness wants N/m, got 800 (no unit). Write: contact.stiffness: 800 N/m"
    )
    assert _message(system, "peers=4").startswith("E623 peers is the number of peers")
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
