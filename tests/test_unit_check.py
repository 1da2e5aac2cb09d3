"""`unit_check`: what fits together, and which term is named when something does not."""

import pytest

from apc.compiler.errors import ApcError, Place
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import Name
from apc.compiler.language.grammar import parse_equation, parse_expression
from apc.compiler.language.unit_check import ANY, check_equation, dimension_of
from apc.compiler.language.units import parse_unit

HERE = Place("a.yaml")
UNITS = {
    "x": "m",
    "v": "m/s",
    "m": "kg",
    "d": "N*s/m",
    "k": "N/m",
    "f": "N",
    "n": "1",
    "delay": "s",
    "others.x": "m",
    "rate": "Hz",
    "speed": "rad/s",
    "time": "s",
}


def lookup(name: Name) -> Dimension | None:
    """`unknown` has no dimension yet."""
    text = ".".join(name.parts)
    return None if text == "unknown" else parse_unit(UNITS[text], HERE).dimension


def dimension(text: str) -> Dimension | None:
    return dimension_of(parse_expression(text, HERE), lookup, text, HERE)


def mistakes(text: str) -> list[str]:
    """Return column, code and sentence of every mistake in an equation."""
    place = Place("a.yaml", 9, 5, f"  - {text}")
    try:
        check_equation(parse_equation(text, place), lookup)
    except ApcError as error:
        return [str(m).splitlines()[0].removeprefix("a.yaml:9:") for m in error.mistakes]
    return []


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        *(("k*x + d*v", "N"), ("m*der(v)", "N"), ("der(x)", "m/s"), ("der(der(x))", "m/s^2"), ("x/v", "s")),
        *(("x^2", "m^2"), ("x^-1", "1/m"), ("sqrt(x*x)", "m"), ("sqrt(k/m)", "1/s"), ("(x^2)^(1/2)", "m")),
        *(("-x", "m"), ("abs(x)", "m"), ("sign(x)", "1"), ("exp(x/x)", "1"), ("tanh(n)", "1"), ("2*x", "m")),
        *(("atan2(x, 2*x)", "1"), ("acos(n)", "1"), ("asin(x/x)*x", "m")),
        *(
            ("sample(x)", "m"),
            ("previous(x)", "m"),
            ("initial(x)", "m"),
            ("hold(f, delay)", "N"),
            ("hold(f)", "N"),
        ),
        *(("mean(others.x)", "m"), ("sum(others.x)/count(others.x)", "m"), ("count(others.x)", "1")),
        *(
            ("max(x, 0)", "m"),
            ("min(others.x)", "m"),
            ("if x > 0 then x else 0", "m"),
            ("sin(time/delay)", "1"),
        ),
        *(("x + unknown", "m"), ("0*x", "m"), ("x + 0", "m"), ("n + 2", "1")),
    ],
)
def test_an_expression_has_the_unit_of_its_parts(text: str, unit: str) -> None:
    assert dimension(text) == parse_unit(unit, HERE).dimension


def test_a_literal_zero_fits_every_unit_and_other_literals_are_numbers() -> None:
    assert dimension("0") == dimension("-0") == dimension("max(0, 0)") == ANY
    assert dimension("2") == DIMENSIONLESS
    assert parse_unit("s", HERE).dimension == SECOND


def test_what_hangs_on_an_unknown_name_is_unknown_and_complains_about_nothing() -> None:
    assert dimension("unknown*x") is None
    assert dimension("sqrt(unknown)") is None
    assert mistakes("unknown*x = f + unknown") == []


@pytest.mark.parametrize(
    "text",
    [
        "m*der(v) = f - d*v",
        "f = hold(k*(sample(x) - mean(others.x)) + d*sample(v), delay)",
        "f = 0",
        "0 = f + k*x",
        "f = if x > 0 and v < 0 then k*x else 0",
        "n = 1 + exp(-time/delay)",
    ],
)
def test_a_right_equation_passes(text: str) -> None:
    assert mistakes(text) == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("m*der(v) = f - d*x", ["20: E401 d*x wants N like m*der(v), got N*s."]),
        ("f + d*x = m*der(v)", ["9: E401 d*x wants N like f, got N*s."]),
        ("x = 2", ["9: E401 2 wants m like x, got a plain number."]),
        ("n = x", ["9: E401 x wants a plain number like n, got m."]),
        ("f = k*(x + v)", ["16: E402 v wants m like x, got m/s."]),
        ("n = sin(x)", ["13: E403 x wants a plain number, got m."]),
        ("f = max(0, k*x, v)", ["21: E404 v wants N like k*x, got m/s."]),
        (
            "x = if x > v then x else f",
            ["16: E404 v wants m like x, got m/s.", "30: E404 f wants m like x, got N."],
        ),
        ("f = hold(f, x)", ["17: E405 x wants s, as a delay, got m."]),
        (
            "x + v = f + x",
            ["9: E401 v wants m like x, got m/s.", "13: E401 f wants m like x, got N."],
        ),
    ],
)
def test_the_term_that_does_not_fit_is_named_at_its_column(text: str, found: list[str]) -> None:
    assert mistakes(text) == found


def test_a_part_that_is_wrong_inside_is_reported_once() -> None:
    assert mistakes("f = k*(x + v + x)") == ["16: E402 v wants m like x, got m/s."]


def test_an_expression_alone_is_checked_too() -> None:
    with pytest.raises(ApcError, match="E402 v wants m like x, got m/s"):
        dimension("x + v")


def test_cycles_and_radians_are_not_added() -> None:
    assert mistakes("speed = 2*rate") == []  # a product counts neither
    assert mistakes("speed = rate") == ["13: E401 rate wants rad/s like speed, got Hz."]
    assert mistakes("speed = 2*pi*rate + 1/delay") == []
