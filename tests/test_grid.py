"""Which points a sweep has: exact values, a fixed order, and a message for every axis that can't be."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.frame.names import Free
from apc.sweeps.grid import GridAxis, build_grid, check_size, parse_axis
from tests.topologies import AVERAGE, compiled, told

MODEL = compiled(AVERAGE)
GROUPS = compiled(AVERAGE.replace("user: {count: 3}", "a: {count: 1}\n  b: {count: 2}"))


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("100 N/m:300 N/m:3", [100, 200, 300]),
        ("100:300 N/m:3", [100, 200, 300]),
        ("0 N/m:1 N/mm", [100 * step for step in range(11)]),
        ("0 N/m:1 N/m:4", [0, Fraction(1, 3), Fraction(2, 3), 1]),
        ("1 N/m:100 N/m:3:log", [1, 10, 100]),
        ("1 N/m:10 N/m:2:log", [1, 10]),
        ("300 N/m, 100 N/m", [300, 100]),
        ("0,8 N/m", [0, 8]),
        ("1.5 kN/m", [1500]),
    ],
)
def test_a_range_or_list_gives_exact_values(text: str, values: list[Fraction]) -> None:
    axis = parse_axis(MODEL, "contact.stiffness", text)
    assert (axis.free, axis.unit) == (Free("contact.stiffness"), "N/m")
    assert axis.heading == "contact.stiffness [N/m]"
    assert list(axis.values) == values


def test_equal_ratios_have_the_ends_given_and_short_decimals_between() -> None:
    axis = parse_axis(MODEL, "contact.stiffness", "10 N/m:3000 N/m:7:log")
    assert (axis.values[0], axis.values[-1]) == (10, 3000)
    ratios = [float(b / a) for a, b in zip(axis.values, axis.values[1:], strict=False)]
    assert ratios == pytest.approx([300 ** (1 / 6)] * 6, rel=1e-14)
    assert all(Fraction(repr(float(value))) == value for value in axis.values)


def test_a_name_may_have_its_section_or_group_before_it() -> None:
    assert parse_axis(MODEL, "links.lan.delay", "0,8 ms").values == (0, Fraction(8, 1000))
    axis = parse_axis(GROUPS, "b.device.mass", "0.1,0.2 kg")
    assert (axis.free, axis.heading) == (Free("device.mass", "b"), "b.device.mass [kg]")


def test_the_last_axis_turns_fastest() -> None:
    axes = [parse_axis(MODEL, "contact.stiffness", "1,2 N/m"), parse_axis(MODEL, "lan.delay", "0,8,16 ms")]
    grid = build_grid(axes)
    assert grid.points == 6
    rows = [tuple(float(value) for value in grid.values(point)) for point in range(6)]
    assert rows == [(k, t) for k in (1, 2) for t in (0, 0.008, 0.016)]
    assert [(one.free.label, one.value) for one in grid.overrides(4)] == [
        ("contact.stiffness", 2),
        ("lan.delay", Fraction(8, 1000)),
    ]


FORM = "--over contact.stiffness='100 N/m:3000 N/m:30'"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "contact.stifness",
            "0 N/m:1 N/m",
            "sweep: E622 contact.stifness is no parameter of three-users-average. Write: contact.stiffness",
        ),
        (
            "contact.stiffness",
            "300 N/m:100 N/m",
            "sweep: E881 the range of contact.stiffness wants its lower end first, and the upper above it, "
            "got 300 N/m to 100 N/m.",
        ),
        (
            "contact.stiffness",
            "100 N/m:100 N/m:5",
            "sweep: E881 the range of contact.stiffness wants its lower end first, and the upper above it, "
            "got 100 N/m to 100 N/m.",
        ),
        (
            "contact.stiffness",
            "1 N/m:100 N/m:0",
            f"sweep: E881 the range of contact.stiffness wants 2 values or more, got 0. Write: {FORM}",
        ),
        (
            "contact.stiffness",
            "1 N/m:100 N/m:many",
            f"sweep: E881 the range of contact.stiffness wants 2 values or more, got many. Write: {FORM}",
        ),
        (
            "contact.stiffness",
            "1 N/m:100 N/m:",
            f"sweep: E881 the range of contact.stiffness wants 2 values or more, got nothing. Write: {FORM}",
        ),
        (
            "contact.stiffness",
            "1 N/m:2 N/m:3:4",
            "sweep: E881 the range of contact.stiffness wants LOW:HIGH:COUNT or LOW:HIGH:COUNT:log, "
            f"got 1 N/m:2 N/m:3:4. Write: {FORM}",
        ),
        (
            "contact.stiffness",
            "0 N/m:100 N/m:3:log",
            "sweep: E881 the range of contact.stiffness wants a lower end above 0 for equal ratios, "
            "got 0 N/m.",
        ),
        (
            "contact.stiffness",
            "5 N/m, 1 N/m, 5 N/m",
            "sweep: E881 the list of contact.stiffness wants different values, got 5 N/m twice.",
        ),
        (
            "contact.stiffness",
            "1 kg:2 kg",
            "sweep: E204 contact.stiffness wants N/m, got 1 kg. Write: 1 N/m",
        ),
        (
            "contact.stiffness",
            "1:2",
            "sweep: E204 contact.stiffness wants N/m, got 1 (no unit). Write: 1 N/m",
        ),
        (
            "contact.stiffness",
            "5 N/m,",
            "sweep: E221 contact.stiffness wants N/m, got nothing. Write: 1 N/m",
        ),
        (
            "peers",
            "2:10",
            "sweep: E623 peers is the number of all peers, which follows from the groups'. Write: user.count",
        ),
        (
            "user.count",
            "2.5:10",
            "sweep: E881 the range of user.count wants whole numbers, got 2.5 to 10.",
        ),
        (
            "device.mass",
            "0 kg:1 kg",
            "sweep: E624 device.mass wants more than 0 kg, got 0 kg.",
        ),
        (
            "haptic.period",
            "0 ms, 1 ms",
            "sweep: E625 haptic.period wants a time above 0 s, got 0.0 s.",
        ),
    ],
)
def test_a_faulty_axis_gets_one_clear_message(name: str, text: str, message: str) -> None:
    assert told(parse_axis, MODEL, name, text) == [message]


def test_a_group_out_of_bounds_is_told_before_anything_is_computed() -> None:
    assert told(parse_axis, GROUPS, "b.device.mass", "-1 kg:1 kg") == [
        "sweep: E624 b.device.mass wants more than 0 kg, got -1 kg."
    ]


def test_a_grid_needs_axes_each_once_and_not_too_many_points() -> None:
    axis = parse_axis(MODEL, "contact.stiffness", "1,2 N/m")
    assert told(build_grid, []) == [f"sweep: E883 nothing is swept. Write: {FORM}"]
    assert told(build_grid, [axis, axis]) == ["sweep: E883 contact.stiffness is swept twice."]
    many = [GridAxis(Free(f"p{i}"), "1", tuple(Fraction(v) for v in range(1000))) for i in range(3)]
    assert told(build_grid, many) == [
        "sweep: E883 a sweep wants at most 10,000,000 points, got 1,000 × 1,000 × 1,000 = 1,000,000,000."
    ]


def test_a_grid_too_large_is_refused_before_its_values_are_built() -> None:
    """A tenth of a millisecond; the values would take seconds and gigabytes."""
    expected = "sweep: E883 a sweep wants at most 10,000,000 points, got "
    assert told(check_size, ["0 N/m:1 N/m:1000000", "0 N/m:1 N/m:1000000:log"]) == [
        f"{expected}1,000,000 × 1,000,000 = 1,000,000,000,000."
    ]
    assert told(check_size, ["0:1 N/m:99999999"]) == [f"{expected}99,999,999."]
    assert told(check_size, ["0:1 N/m:" + "9" * 5000])[0].startswith(expected)
    check_size(["0:1 N/m", "1, 2, 3 N/m", "0:1 N/m:many", "0:1 N/m:10000"])
