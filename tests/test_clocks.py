"""`clocks`: every variable gets one clock, every crossing is said and named."""

from __future__ import annotations

from pathlib import Path

import pytest

from apc.compiler.equations.clocks import ClockedKind
from apc.compiler.language.expression import format_expression
from tests.topologies import AVERAGE, MESH, ONE_MASS, clocked, library, replaced, told

# A component whose equations are the test's; `s` and `w` may belong to a clock or to none.
PART = """\
component: Part
connectors: {{flange: Flange}}
parameters: {{clock: clock, k: {{unit: N/m, default: 1}}}}
variables: {{s: {{unit: m, start: 0}}, w: {{unit: m}}}}
equations:
  - {first}
  - {second}
  - {third}
"""
TEXT = (
    ONE_MASS + "clocks: {tick: 1 ms, tock: 2 ms}\nhands:\n  hand: {type: Part, flange: device, clock: tick}\n"
)


def only(text: str) -> ClockedKind:
    (kind,) = clocked(text).kinds
    return kind


def of_part(folder: Path, *equations: str) -> ClockedKind:
    first, second, third = equations
    own = library(folder, PART.format(first=first, second=second, third=third))
    (kind,) = clocked(TEXT, own).kinds
    return kind


def told_of(folder: Path, *equations: str) -> list[str]:
    first, second, third = equations
    own = library(folder, PART.format(first=first, second=second, third=third))
    return [line.rpartition("/")[2] for line in told(clocked, TEXT, own)]


@pytest.mark.parametrize("text", [AVERAGE, MESH])
def test_the_papers_scene_is_one_continuous_and_one_haptic_partition(text: str) -> None:
    kind = only(text)
    assert [partition.clock for partition in kind.partitions] == ["continuous", "haptic"]
    assert kind.partitions[1].variables == (
        *("contact.f", "coordination.own", "coordination.received", "coordination.f"),
    )
    for partition in kind.partitions:
        assert len(partition.variables) == len(partition.equations)


def test_every_crossing_of_the_papers_scene_is_named() -> None:
    kind = only(AVERAGE)
    assert [sample.symbol for sample in kind.samples] == [
        "sample(contact.a.x, haptic)",
        "sample(contact.b.x, haptic)",
        "sample(der(contact.a.x), haptic)",
        "sample(der(contact.b.x), haptic)",
        "sample(coordination.object.x, haptic)",
        "sample(der(coordination.object.x), haptic)",
    ]
    assert [(hold.variable, hold.clock, format_expression(hold.delay)) for hold in kind.holds] == [
        ("contact.f", "haptic", "contact.delay"),
        ("coordination.f", "haptic", "coordination.delay"),
    ]
    assert [(r.operator, r.of.send, r.link, r.clock) for r in kind.receives] == [
        ("mean", "coordination.x", "lan", "haptic"),
        ("mean", "coordination.v", "lan", "haptic"),
    ]
    assert [(send.name, send.link, format_expression(send.expression)) for send in kind.sends] == [
        ("coordination.x", "lan", "coordination.object.x"),
        ("coordination.v", "lan", "der(coordination.object.x)"),
    ]
    assert kind.previous == ()


def test_one_value_held_with_two_delays_is_two_holds() -> None:
    own = only(replaced(AVERAGE, ("link: lan", "link: lan, delays: own")))
    assert [(hold.variable, format_expression(hold.delay)) for hold in own.holds] == [
        ("contact.f", "contact.delay"),
        ("coordination.own", "coordination.delay"),
        ("coordination.received", "0"),
    ]


def test_previous_is_a_crossing_to_the_tick_before(tmp_path: Path) -> None:
    kind = of_part(tmp_path, "s = previous(s) + sample(flange.x)", "w = 2*s", "flange.f = k*hold(w)")
    assert [(p.symbol, p.variable, p.clock) for p in kind.previous] == [
        ("previous(hand.s)", "hand.s", "tick")
    ]
    assert kind.partitions[1].variables == ("hand.s", "hand.w")


def test_an_expression_that_is_held_gets_a_variable_of_its_own(tmp_path: Path) -> None:
    kind = of_part(tmp_path, "s = sample(flange.x)", "w = s", "flange.f = k*hold(s - 2*w)")
    assert [hold.variable for hold in kind.holds] == ["hand.held1"]
    assert "hand.held1" in kind.partitions[1].variables


def test_a_continuous_variable_needs_sample_to_be_read_at_a_tick(tmp_path: Path) -> None:
    assert told_of(tmp_path, "s = sample(flange.x)", "w = s + flange.x", "flange.f = k*hold(w)") == [
        "part0.yaml:7:5: E505 in `hand.w = hand.s + hand.flange.x` of hand, hand.flange.x is continuous "
        "and the rest is on clock tick. Write: sample(hand.flange.x)"
    ]


def test_a_clocked_variable_needs_hold_to_act(tmp_path: Path) -> None:
    assert told_of(tmp_path, "s = sample(flange.x)", "w = s", "flange.f = k*w") == [
        "part0.yaml:8:5: E505 hand.flange.f acts on what it is joined to at all times, and is on clock tick. "
        "Write: flange.f = hold(k*w)"
    ]


def test_what_is_continuous_already_cannot_be_held(tmp_path: Path) -> None:
    (line,) = told_of(tmp_path, "s = flange.x", "w = s", "flange.f = k*hold(w)")
    assert line == (
        "part0.yaml:8:5: E505 hold(hand.w, 0) holds hand.w, which is continuous already. Write: hand.w"
    )


def test_the_value_of_the_tick_before_the_first_must_be_said(tmp_path: Path) -> None:
    (line,) = told_of(tmp_path, "s = sample(flange.x)", "w = previous(w) + s", "flange.f = k*hold(w)")
    assert line.startswith("part0.yaml:7:5: E507 previous(hand.w) needs a start value of hand.w.")


FOLLOWER = """\
component: Follower
connectors: {{flange: Flange}}
sends: {{x: sample(flange.x)}}
parameters: {{clock: clock, link: link, k: {{unit: N/m}}}}
equations: ['f = {force}', flange.f = hold(f)]
"""
TWO = (
    ONE_MASS.replace("count: 1", "count: 2")
    + "clocks: {tick: 1 ms}\nlinks: {lan: {clock: tick}}\n"
    + "couplers: {all: {type: Follower, flange: device, k: 1 N/m, clock: tick, link: lan}}\n"
)


def following(folder: Path, force: str) -> tuple[ClockedKind, str]:
    """Return a kind whose clocked force is `force`, and what became of it."""
    (kind,) = clocked(TWO, library(folder, FOLLOWER.format(force=force))).kinds
    return kind, format_expression(kind.partitions[1].equations[0].right)


@pytest.mark.parametrize(
    ("force", "expected"),
    [
        ("k*mean(2*others.x)", "all.k*(2*mean(others.all.x))"),
        (
            "mean(k*(sample(flange.x) - others.x))",
            "sample(all.flange.x, tick)*all.k + -1*all.k*mean(others.all.x)",
        ),
        (
            "sum(k*(sample(flange.x) - others.x))",
            "count(lan)*(sample(all.flange.x, tick)*all.k) + -1*all.k*sum(others.all.x)",
        ),
        ("k*sample(flange.x)*count(others)", "all.k*sample(all.flange.x, tick)*count(lan)"),
    ],
)
def test_a_linear_reduction_of_the_others_is_one_of_what_they_send(
    tmp_path: Path, force: str, expected: str
) -> None:
    kind, found = following(tmp_path, force)
    assert found == expected
    for receive in kind.receives:
        assert (receive.of.send, receive.link, receive.clock, receive.edge) == ("all.x", "lan", "tick", None)


def test_a_reduction_that_is_not_linear_is_taken_over_each_pair(tmp_path: Path) -> None:
    kind, found = following(tmp_path, "k*sum(max(others.x - sample(flange.x), 0))")
    (receive,) = kind.receives
    assert found == f"all.k*{receive.symbol}"
    assert (receive.operator, receive.link) == ("sum", "lan")
    assert receive.edge is not None
    assert format_expression(receive.edge) == "max(others.all.x - sample(all.flange.x, tick), 0)"


def test_a_value_of_the_others_is_no_value_of_ones_own(tmp_path: Path) -> None:
    (line,) = told(clocked, TWO, library(tmp_path, FOLLOWER.format(force="k*others.x")))
    assert line.rpartition("/")[2] == (
        "part0.yaml:5:14: E506 others.x of all is a value of each other peer, and one is due here. "
        "Write: mean(others.x), or sum, max, min"
    )


def test_the_time_convention_stands_in_the_docstring_of_this_stage() -> None:
    from apc.compiler.equations import clocks as stage

    assert stage.__doc__ is not None
    order = [
        stage.__doc__.index(word) for word in ("are sampled", "network clocks tick", "force clocks tick")
    ]
    assert order == sorted(order)
    assert "a tick at exactly t + T_d sees it" in stage.__doc__
