"""Claims about `apc.analysis.switches`."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.analysis.switches import SwitchingPart, bind, find_switches, switching_parts
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.frame.jacobians import jacobians
from apc.frame.linearize import linearize
from apc.frame.site import LinearSite
from tests.sites import alone
from tests.topologies import AVERAGE, SCENES, compiled, replaced


def parts(system: CompiledSystem) -> tuple[SwitchingPart, ...]:
    [kind] = system.kinds
    return switching_parts(find_switches(kind), np.zeros(len(kind.parameters)))


def piece(system: CompiledSystem, setting: dict[int, bool]) -> LinearSite:
    """Return the one piece of the one kind with these decisions."""
    [kind] = system.kinds
    return linearize(bind(find_switches(kind), jacobians(kind), setting), np.zeros(len(kind.parameters)))


def slope(function: Any, setting: dict[int, bool]) -> float:
    """Return the slope of y = function(x) in one piece."""
    site = piece(alone(lambda x, u: -x + u, lambda x, u, m: function(x[0])), setting)
    assert site.affine
    return float(site.ticks[0].x[0, 0])


def test_each_kind_of_decision_has_the_slopes_of_its_two_pieces() -> None:
    assert [slope(lambda x: casadi.fmax(0, 3 * x), {0: on}) for on in (True, False)] == [0.0, 3.0]
    assert [slope(lambda x: casadi.fmin(2 * x, x + 1), {0: on}) for on in (True, False)] == [2.0, 1.0]
    assert [slope(lambda x: casadi.fabs(2 * x), {0: on}) for on in (True, False)] == [2.0, -2.0]
    assert [slope(lambda x: casadi.sign(x) + x, {0: on}) for on in (True, False)] == [1.0, 1.0]
    assert [slope(lambda x: casadi.if_else(x > 1, 5 * x, 7), {0: on}) for on in (True, False)] == [5.0, 0.0]


def test_conditions_together_and_inside_one_another_are_decisions_each() -> None:
    def both(x: Any) -> Any:
        return casadi.if_else(casadi.logic_and(x > 0, casadi.logic_not(x > 2)), 4 * x, 0)

    found = {(a, b): slope(both, {0: a, 1: b}) for a in (True, False) for b in (True, False)}
    assert found == {(True, False): 4.0, (True, True): 0.0, (False, False): 0.0, (False, True): 0.0}


def test_of_the_pieces_of_a_limit_one_follows_the_motion() -> None:
    def limit(x: Any) -> Any:
        return casadi.fmax(-1, casadi.fmin(1, 9 * x))

    slopes = [slope(limit, {0: a, 1: b}) for a in (True, False) for b in (True, False)]
    assert sorted(slopes) == [0.0, 0.0, 0.0, 9.0]


def test_what_is_decided_twice_is_one_decision() -> None:
    [kind] = alone(lambda x, u: -x + u, lambda x, u, m: casadi.if_else(x > 0, x, 2 * x) * (x > 0)).kinds
    assert len(find_switches(kind).decisions) == 1


def test_a_limit_and_a_dead_zone_switch_and_a_sign_and_a_smooth_function_do_not() -> None:
    def listed(function: Any) -> list[str]:
        return [part.name for part in parts(alone(lambda x, u: -x + u, lambda x, u, m: function(x)))]

    assert listed(lambda x: casadi.fmax(-1, casadi.fmin(1, x))) == ["f"]
    assert listed(lambda x: casadi.if_else(casadi.fabs(x) > 1, x, 0)) == ["f"]
    assert listed(lambda x: casadi.fabs(x)) == ["f"]
    assert listed(lambda x: casadi.sign(x)) == []
    assert listed(lambda x: casadi.tanh(x)) == []


def test_on_is_the_steeper_of_two_slopes() -> None:
    hardening = alone(lambda x, u: -x + u, lambda x, u, m: -casadi.if_else(x > 0, 2 * x, 9 * x))
    [part] = parts(hardening)
    slopes = [
        piece(hardening, dict(zip(part.decisions, setting, strict=True))).ticks[0].x[0, 0]
        for setting in (part.on, part.off)
    ]
    assert slopes == [-9.0, -2.0]


def test_what_time_or_parameters_decide_is_no_switch() -> None:
    hand = "hands:\n  hand: {type: StepForce, flange: device, force: 1 N, start: 1 s}\n"
    [kind] = compiled(replaced(AVERAGE, ("couplers:", f"{hand}couplers:"))).kinds
    assert "hand.start" in kind.parameters
    assert find_switches(kind).decisions == ()


def test_a_contact_is_named_by_what_it_computes_and_a_continuous_one_by_its_part() -> None:
    experiment = (SCENES / "experiment-average.yaml").read_text()
    [kind] = compiled(experiment).kinds
    switched = find_switches(kind)
    assert {decision.changes for decision in switched.decisions} == {("contact.push",)}
    pressed = (
        experiment.replace("OneSidedContact", "HuntCrossleyContact")
        .replace("stiffness: 3900 N/m, damping: 0.05 N*s/m", "stiffness: 3900 N/m^(3/2)")
        .replace("N/m^(3/2), clock: haptic}", "N/m^(3/2)}")
    )
    [kind] = compiled(pressed).kinds
    assert {decision.changes for decision in find_switches(kind).decisions} == {("contact",)}


def test_a_continuous_decision_of_several_parts_is_named_by_them_all() -> None:
    """A motor's limit of what a wall asks for: the wall's side stands in it, too."""
    limited = compiled((SCENES / "limited-motor.yaml").read_text(encoding="utf-8"))
    assert [one.name for one in parts(limited)] == ["motor, wall", "wall.push"]


def test_the_pieces_of_a_contact_are_the_spring_and_nothing() -> None:
    system = compiled((SCENES / "experiment-average.yaml").read_text())
    [kind] = system.kinds
    values = dict.fromkeys(kind.parameters, 0.0) | {
        "contact.stiffness": 3900.0,
        "contact.damping": 0.05,
        "contact.side": -1.0,
        "device.mass": 0.1,
        "cube.mass": 0.1,
    }
    vector = np.array([values[name] for name in kind.parameters])
    switched = find_switches(kind)
    [part] = switching_parts(switched, vector)
    base = jacobians(kind)
    for setting, expected in ((part.on, [-3900.0, -0.05, 3900.0, 0.05]), (part.off, [0.0] * 4)):
        bound = bind(switched, base, dict(zip(part.decisions, setting, strict=True)))
        assert bound.affine
        site = linearize(bound, vector)
        names = [state.name for state in kind.states]
        place = [names.index(name) for name in ("device.x", "device.v", "cube.x", "cube.v")]
        assert site.ticks[0].x[0, place].tolist() == expected
    assert not base.affine


def test_opening_the_decisions_changes_no_value() -> None:
    """A piece, at a point of its own, is the function itself."""
    system = alone(lambda x, u: -x + u, lambda x, u, m: casadi.fmax(-1, casadi.fmin(1, 9 * x)))
    [kind] = system.kinds
    switched = find_switches(kind)
    symbols = casadi.vertcat(*(one.symbol for one in switched.decisions))
    [opened] = [one for one in switched.functions if one.where[0] == "tick"]
    function = casadi.Function("f", [*opened.inputs, symbols], [opened.output])
    for x, inside in ((0.05, True), (3.0, False), (-3.0, False)):
        settings = ([a, b] for a in (0, 1) for b in (0, 1))
        values = {float(function(x, 0, [], [], 0, 0, setting)) for setting in settings}
        truth = float(kind.clocks[0].tick(x, 0, [], [], 0, 0))
        assert truth in values
        assert inside == (abs(truth) < 1)


def test_a_part_that_decides_too_much_is_refused() -> None:
    stairs = alone(
        lambda x, u: -x + u,
        lambda x, u, m: sum((casadi.fmax(0, x - step) for step in range(7)), casadi.SX(0)),
    )
    with pytest.raises(ApcError, match=r"E863 f of alone takes 7 decisions; at most 6"):
        parts(stairs)


def test_a_scene_without_decisions_is_as_it_was() -> None:
    system = compiled(AVERAGE)
    [kind] = system.kinds
    switched = find_switches(kind)
    assert switched.walkable
    assert switched.decisions == ()
    assert analyze(system).stable
