"""Claims about `apc.runtime.frame.parameters`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from apc.compiler.compiled import CompiledSystem, Parameter
from apc.compiler.errors import ApcError
from apc.runtime.frame.parameters import Override, apply, parse_override, resolve
from tests.sites import NAMES, columned, grouped, paper


def _with(system: CompiledSystem, **expressions: str) -> CompiledSystem:
    """Add the parameter kt and expressions over it."""
    names = {key.replace("__", "."): text for key, text in expressions.items()}
    return replace(
        system,
        parameters=(
            Parameter("kt", "N/m", 500.0),
            Parameter("wait", "s", 0.008),
            *(replace(p, expression=names.get(p.name)) for p in system.parameters),
        ),
        timings=tuple(replace(t, expression=names.get(t.name)) for t in system.timings),
    )


def _value(system: CompiledSystem, name: str, group: int = 0) -> float:
    return float(resolve(system).parameters[group][0, NAMES.index(name)])


def _message(system: CompiledSystem, text: str) -> str:
    with pytest.raises(ApcError) as caught:
        apply(system, [parse_override(system, text)])
    [mistake] = caught.value.mistakes
    return f"{mistake.code} {mistake.sentence}"


def test_without_overrides_the_numbers_are_the_compiled_ones() -> None:
    numbers = resolve(paper(kt=123.0))
    assert numbers.parameters[0][0, NAMES.index("coordination.stiffness")] == 123.0
    assert numbers.timings["lan.delay"] == Fraction(1, 125)


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
    system = _with(paper(), coordination__stiffness="kt/(peers - 1)", lan__delay="2*wait")
    changed = apply(system, [Override("kt", None, Fraction(3000)), Override("wait", None, Fraction(1, 90))])
    assert _value(changed, "coordination.stiffness") == 1500.0
    assert resolve(changed).timings["lan.delay"] == Fraction(1, 45)


def test_what_no_override_reaches_keeps_its_very_number() -> None:
    system = _with(paper(kt=0.1 + 0.2), coordination__stiffness="kt/(peers - 1)")
    changed = apply(system, [Override("contact.stiffness", None, Fraction(800))])
    assert _value(changed, "coordination.stiffness") == 0.1 + 0.2


def test_a_decimal_in_the_text_is_a_decimal_again_for_times() -> None:
    system = _with(paper(), lan__delay="2*wait + kt*wait/kt")
    changed = apply(system, [Override("kt", None, Fraction(7))])
    assert resolve(changed).timings["lan.delay"] == Fraction(24, 1000)


def test_a_group_value_can_change_what_everybody_derives_from_it() -> None:
    system = _with(paper(), coordination__stiffness="2*kt")
    changed = apply(
        replace(grouped(system, ("left", 1, {}), ("right", 2, {}))), [Override("kt", "left", Fraction(10))]
    )
    assert [_value(changed, "coordination.stiffness", group) for group in (0, 1)] == [20.0, 500.0]


def test_setting_a_dependent_parameter_ends_its_dependence() -> None:
    system = _with(paper(), coordination__stiffness="2*kt")
    once = apply(system, [Override("coordination.stiffness", None, Fraction(5))])
    again = apply(once, [Override("kt", None, Fraction(1))])
    assert _value(again, "coordination.stiffness") == 5.0


def test_a_time_is_exact() -> None:
    override = parse_override(paper(), "clocks.network.period=1/90 s")
    assert override == Override("network.period", None, Fraction(1, 90))


def test_a_circle_is_a_contradiction_of_ours() -> None:
    system = _with(paper(), contact__stiffness="contact.damping", contact__damping="contact.stiffness")
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


def test_a_group_out_of_bounds_is_named() -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 1, {}))
    assert _message(system, "left.cube.mass=-1 kg") == "E624 left.cube.mass wants more than 0 kg, got -1 kg."


def test_a_timing_has_one_value_for_all_groups() -> None:
    system = grouped(paper(), ("left", 1, {}), ("right", 1, {}))
    assert _message(system, "left.lan.delay=1 ms").startswith("E622 left.lan.delay is no parameter of paper")


# ---- parameters that differ from peer to peer ----


def _column(system: CompiledSystem, name: str) -> list[float]:
    """Return a parameter's value of each peer of the first group."""
    numbers = resolve(system)
    return [float(value) for value in numbers.parameters[0][numbers.rows[0], NAMES.index(name)]]


def test_a_column_is_a_value_a_peer_and_equal_peers_share_a_row() -> None:
    system = columned(paper(), device__mass=[0.1, 0.2, 0.1], contact__damping=[0.0, 1.0, -0.0])
    assert _column(system, "device.mass") == [0.1, 0.2, 0.1]
    assert resolve(system).parameters[0].shape == (2, len(NAMES))
    assert resolve(system).rows[0].tolist() == [0, 1, 0]


def test_what_depends_on_a_column_is_worked_out_peer_by_peer() -> None:
    text = (
        "if device.mass > 0.15 and peers == 3 then kt*max(device.mass, 0.3) else -(-sqrt(kt)^2)/(peers - 1)"
    )
    system = columned(_with(paper(), coordination__stiffness=text), device__mass=[0.1, 0.2, 0.4])
    assert _column(system, "coordination.stiffness") == pytest.approx([250.0, 150.0, 200.0], rel=1e-15)
    doubled = apply(system, [Override("kt", None, Fraction(1000))])
    assert _column(doubled, "coordination.stiffness") == pytest.approx([500.0, 300.0, 400.0], rel=1e-15)


def test_what_no_column_reaches_keeps_its_very_number() -> None:
    system = columned(_with(paper(kt=0.1 + 0.2), coordination__stiffness="kt"), device__mass=[0.1, 0.2, 0.4])
    assert _column(system, "coordination.stiffness") == [0.1 + 0.2] * 3


@pytest.mark.parametrize("name", ["device.mass", "user.device.mass"])
def test_an_override_replaces_a_column(name: str) -> None:
    system = columned(paper(), device__mass=[0.1, 0.2, 0.1])
    changed = apply(system, [parse_override(system, f"{name}=0.5 kg")])
    assert _column(changed, "device.mass") == [0.5, 0.5, 0.5]
    kept = apply(system, [parse_override(system, "contact.stiffness=5 N/m")])
    assert _column(kept, "device.mass") == [0.1, 0.2, 0.1]


def test_a_peer_out_of_bounds_or_without_a_value_is_named() -> None:
    system = columned(paper(), device__mass=[0.1, 0.0, 0.1])
    assert _message(system, "contact.stiffness=5 N/m") == (
        "E624 user[2].device.mass wants more than 0 kg, got 0 kg."
    )
    heavy = columned(_with(paper(), coordination__stiffness="kt*(2 - cube.mass)"), cube__mass=[1.0, 1.0, 3.0])
    assert _message(heavy, "contact.stiffness=5 N/m") == (
        "E624 user[3].coordination.stiffness wants at least 0 N/m, got -500 N/m."
    )
    divided = columned(_with(paper(), coordination__stiffness="kt/cube.mass"), cube__mass=[0.1, 0.1, 0.0])
    with pytest.raises(
        ApcError, match=r"E331 coordination.stiffness = kt/cube.mass has no finite value for user"
    ):
        resolve(divided)


def test_a_hundred_thousand_different_peers_are_read_in_a_time_that_grows_with_their_number() -> None:
    masses = 0.1 + 1e-6 * np.arange(100_000)
    system = columned(
        _with(paper(peers=100_000), coordination__stiffness="kt*cube.mass/device.mass"), device__mass=masses
    )
    numbers = resolve(system)
    assert numbers.parameters[0].shape == (100_000, len(NAMES))
    assert numbers.parameters[0][7, NAMES.index("coordination.stiffness")] == 500.0 * 0.2 / masses[7]
