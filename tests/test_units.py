"""`units`: exact values, the dimensions of common units, and the messages for everything else."""

import math
import re
from collections.abc import Callable
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apc.compiler.errors import ApcError, Place
from apc.compiler.language import units
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.si_forms import is_si
from apc.compiler.language.unit_text import format_dimension, format_si
from apc.compiler.language.units import NO_UNIT, parse_quantity, parse_unit, quantity
from apc.compiler.language.values import is_quantity

HERE = Place("a.yaml", 1, 1)
LENGTH, TIME = Dimension((("m", 1),)), Dimension((("s", 1),))
FORCE = Dimension((("kg", 1), ("m", 1), ("s", -2)))


def refusal(text: str, parser: Callable[[str, Place], object] = parse_quantity) -> str:
    with pytest.raises(ApcError) as caught:
        parser(text, Place("a.yaml", 1, 1, text))
    return str(caught.value).splitlines()[0].removeprefix("a.yaml:1:")


def wanting(text: str, unit: str) -> str:
    with pytest.raises(ApcError) as caught:
        quantity(text, Place("a.yaml", 1, 12, f"stiffness: {text}"), what="stiffness", unit=unit)
    return str(caught.value).splitlines()[0]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(("500 N/m", Fraction(500)), ("-4 N", Fraction(-4)), ("+.5 m", Fraction(1, 2))),
        *(("1 ms", Fraction(1, 1000)), ("1e-3 s", Fraction(1, 1000)), ("1/90 s", Fraction(1, 90))),
        *(("0.1 kg", Fraction(1, 10)), ("30 mm", Fraction(3, 100)), ("500N/m", Fraction(500))),
        *(("1 lb", Fraction(45359237, 10**8)), ("1 inch", Fraction(254, 10**4)), ("5 %", Fraction(1, 20))),
        *(
            ("200 Hz", Fraction(200)),
            ("5 1/s", Fraction(5)),
            ("5 µs", Fraction(5, 10**6)),
            ("0.5", Fraction(1, 2)),
        ),
    ],
)
def test_values_are_exact_rationals_in_si(text: str, value: Fraction) -> None:
    assert parse_quantity(text, HERE).value == value


@pytest.mark.parametrize(
    ("text", "dimension"),
    [
        *(("N", FORCE), ("N/m", FORCE.divide(LENGTH)), ("N*s/m", FORCE.multiply(TIME).divide(LENGTH))),
        *(("N·s/m", FORCE.multiply(TIME).divide(LENGTH)), ("N/(m/s)", FORCE.multiply(TIME).divide(LENGTH))),
        *(("m/s²", LENGTH.divide(TIME.power(2))), ("m/s**2", LENGTH.divide(TIME.power(2)))),
        *(("m*s^-2", LENGTH.divide(TIME.power(2))), ("m^(1/2)", LENGTH.power(Fraction(1, 2)))),
        *(("rad", DIMENSIONLESS), ("rad/s", TIME.power(-1)), ("1", DIMENSIONLESS), ("kg*m/N", TIME.power(2))),
    ],
)
def test_units_multiply_divide_and_have_powers(text: str, dimension: Dimension) -> None:
    assert parse_unit(text, HERE).dimension == dimension
    assert parse_unit(text, HERE).scale == 1


def test_an_angle_in_degrees_is_right_to_more_than_a_float() -> None:
    half = Fraction(
        "1.5707963267948966192313216916397514420985846996875529104874722961539082"
    )  # OEIS A019669
    assert abs(parse_quantity("90 deg", HERE).value - half) < Fraction(1, 10**38)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "1: E221 a quantity wants a number and its unit, got nothing."),
        ("N", "1: E221 a quantity wants a number and its unit, got N."),
        ("nan", "1: E221 a quantity wants a finite number, got nan."),
        ("-.inf N", "1: E221 a quantity wants a finite number, got -.inf N."),
        ("−4 N", "1: E221 a quantity wants a number and its unit, got −4 N. Write: -4 N"),
        ("1,5 N", "2: E221 a number has a decimal point, not a comma. Write: 1.5 N"),
        ("1/0 s", "1: E221 1/0 divides by zero."),
        ("1" * 201, "1: E221 a quantity wants at most 200 characters, got 201."),
        ("5 N s/m", "5: E222 a unit wants * or / between two names, got s. Write: N*s/m"),
        ("5 /s", "2: E222 a unit wants something above the /, got nothing. Write: 5 1/s"),
        ("5 (N/m", "7: E222 a unit wants ), got its end."),
        ("5 N//m", "5: E222 a unit wants a name such as N, m or s, got /."),
        ("5 m^10", "5: E222 a unit wants a whole exponent up to 9, got 10."),
        ("5 m^(1/0)", "9: E222 a unit wants an exponent that does not divide by zero, got )."),
        ("5 km^(1/2)", "11: E222 a unit wants a root whose scale is a rational number, got its end."),
        ("5 __class__", "3: E222 a unit wants names joined by * and /, with exponents such as ^2, got '_'."),
        ("5 n/M", "3: E223 there is no unit n. Write: N"),
        ("5 Newton", "3: E223 there is no unit Newton. Write: newton"),
        ("5 Nm", "3: E223 there is no unit Nm. Write: N*m"),
        ("5 m2", "3: E223 there is no unit m2. Write: m^2"),
        ("1 foo/bar", "3: E223 there is no unit foo."),
        ("20 degC", "4: E224 degC (degree_Celsius) is no multiple of an SI unit. Write: K"),
        ("3 dB", "3: E224 dB (decibel) is no multiple of an SI unit."),
        ("5 bit", "3: E224 bit (bit) is no multiple of an SI unit."),
        ("1e400 s", "1: E226 a number wants an exponent from -300 to 300, got 400."),
        ("1" * 100 + "e300 m", "1: E226 this quantity is too large for a number."),
        (
            "5 (m^9)^9",
            "2: E225 (m^9)^9 is no unit of this world: an exponent or its scale is too large.",
        ),
    ],
)
def test_a_refused_quantity_is_answered_with_one_line(text: str, message: str) -> None:
    assert refusal(text) == message


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        *(("100 gr", "g"), ("3 dr", ""), ("2 drachm", ""), ("5 st", "s"), ("1 ct", ""), ("3 furlong", "")),
        *(("2 fathom", ""), ("1 a", ""), ("8 Ms", "ms"), ("1 ks", ""), ("2 Mim", "m"), ("5 kinch", "")),
        *(("1 oz_t", ""), ("1 stone", "s"), ("1 eV", ""), ("3 cal", ""), ("1 Gy", ""), ("5 Bq", "")),
        *(("1 fortnight", ""), ("1 dpt", ""), ("20 mN_mm", ""), ("1 cup", ""), ("1 baud", ""), ("1 Qm", "")),
    ],
)
def test_a_unit_that_is_out_of_use_is_refused_and_not_taken_for_one_that_is_meant(
    text: str, meant: str
) -> None:
    told = refusal(text)
    assert re.search(r"E22[234] ", told)
    assert told.partition("Write: ")[2] in (meant, "")


def test_a_gram_is_no_grain() -> None:
    assert refusal("100 gr") == (
        "5: E223 there is no unit gr here: grain is out of use; there are kg, g, lb. Write: g"
    )


@pytest.mark.parametrize("name", [*units.COMMON, "lbf", "ozf", "gf", "psi", "bar", "mbar", "mil", "slug"])
def test_what_a_haptics_engineer_writes_is_a_unit(name: str) -> None:
    assert parse_unit(name, HERE).scale > 0


@pytest.mark.parametrize(
    ("text", "unit", "same", "as_it_is"),
    [
        ("20 Hz", "rad/s", "125.663706 rad/s", "20 rad/s"),
        ("0.02 kHz", "rad/s", "125.663706 rad/s", "0.02 rad/s"),
        ("30 rpm", "Hz", "0.5 Hz", "30 Hz"),
        ("360 deg/s", "Hz", "1 Hz", "360 Hz"),
        ("1 Hz", "deg/s", "360 deg/s", "1 deg/s"),
    ],
)
def test_cycles_and_radians_a_second_are_told_apart(text: str, unit: str, same: str, as_it_is: str) -> None:
    told = wanting(text, unit)
    assert told == (
        f"a.yaml:1:12: E204 stiffness wants {unit}, got {text}, which is {same}. "
        f"Write: stiffness: {same}, or stiffness: {as_it_is}"
    )
    turns = quantity(same, HERE, what="", unit=unit).value / parse_quantity(text, HERE).value
    turning = 2 * math.pi if parse_unit(text.split()[1], HERE).dimension.turning == "Hz" else 0.5 / math.pi
    assert float(turns) == pytest.approx(turning, rel=1e-8)
    assert quantity("3 1/s", HERE, what="", unit=unit).value == 3


@pytest.mark.parametrize(
    ("unit", "shown"),
    [
        *(("Hz", "Hz"), ("kHz", "Hz"), ("1/s", "1/s"), ("rad/s", "rad/s"), ("rpm", "rad/s"), ("deg", "rad")),
        *(("rad/s^2", "rad/s^2"), ("N*m/rad", "N*m"), ("1", "1"), ("%", "1")),
    ],
)
def test_a_unit_is_shown_with_what_it_counts(unit: str, shown: str) -> None:
    text = format_dimension(parse_unit(unit, HERE).dimension)
    assert text == shown
    assert is_si(text)


@pytest.mark.parametrize("text", ["(((%^9)^9)^9)^9", "((((Tm^9/Tm^9)^9)^9)^9)^9", "(" * 99 + "m" + ")" * 99])
def test_a_unit_is_bounded_in_every_direction(text: str) -> None:
    try:
        assert parse_unit(text, HERE).dimension in (LENGTH, DIMENSIONLESS)
    except ApcError as error:
        assert "E225" in str(error)


@pytest.mark.parametrize(
    ("text", "unit", "message"),
    [
        ("500", "N/m", "E204 stiffness wants N/m, got 500 (no unit). Write: stiffness: 500 N/m"),
        ("0", "N/m", "E204 stiffness wants N/m, got 0 (no unit). Write: stiffness: 0 N/m"),
        ("5 kg", "N/m", "E204 stiffness wants N/m, got 5 kg. Write: stiffness: 5 N/m"),
        ("5 N", "1", "E204 stiffness wants a plain number, got 5 N. Write: stiffness: 5"),
        (
            "1 MS",
            "s",
            "E204 stiffness wants s, got 1 MS (MS is megasiemens: case matters). Write: stiffness: 1 ms",
        ),
        (
            "5 MS^(1/2)",
            "N/m",
            "E204 stiffness wants N/m, got 5 MS^(1/2).",
        ),  # no root of what is meant is a unit
        ("5 (mm^2)^(1/2)", "N/m", "E204 stiffness wants N/m, got 5 (mm^2)^(1/2)."),
        ("stiff", "N/m", "E221 stiffness wants N/m, got stiff. Write: stiffness: 1 N/m"),
        ("", "N/m", "E221 stiffness wants N/m, got nothing. Write: stiffness: 1 N/m"),
    ],
)
def test_a_quantity_that_does_not_fit_gets_the_line_to_write(text: str, unit: str, message: str) -> None:
    assert wanting(text, unit) == f"a.yaml:1:12: {message}"


def test_a_fitting_quantity_may_be_in_any_unit_of_its_dimension() -> None:
    assert quantity("3 kN/mm", HERE, what="stiffness", unit="N/m").value == 3_000_000
    assert quantity("50 %", HERE, what="share", unit="1").value == Fraction(1, 2)
    assert quantity("2", HERE, what="share", unit="1").unit == NO_UNIT


@pytest.mark.parametrize(
    "text",
    [
        "1",
        "N",
        "N/m",
        "N*s/m",
        "kg",
        "m",
        "m/s",
        "m/s^2",
        "s",
        "1/s",
        "N*m",
        "W",
        "N*s",
        "kg*m^2",
        "1/(A*K)",
        "kg^(1/2)",
    ],
)
def test_a_dimension_prints_as_the_unit_an_engineer_writes(text: str) -> None:
    assert format_dimension(parse_unit(text, HERE).dimension) == text


@settings(max_examples=100)
@given(
    st.dictionaries(st.sampled_from(["A", "K", "cd", "kg", "m", "mol", "s"]), st.integers(-9, 9).filter(bool))
)
def test_a_printed_dimension_reads_back(powers: dict[str, int]) -> None:
    dimension = Dimension(tuple(sorted(powers.items())))
    unit = parse_unit(format_dimension(dimension), HERE)
    assert unit.scale == 1
    assert unit.dimension == dimension


def test_an_si_value_prints_with_its_unit() -> None:
    assert format_si(500.0, parse_unit("N/m", HERE)) == "500 N/m"
    assert format_si(0.001, TIME) == "0.001 s"
    assert format_si(2.5, DIMENSIONLESS) == "2.5"


@settings(max_examples=100)
@given(st.fractions(-1000, 1000, max_denominator=1000))
def test_every_rational_survives(value: Fraction) -> None:
    assert parse_quantity(f"{value.numerator}/{value.denominator} N", HERE).value == value


@settings(max_examples=200)
@given(st.one_of(st.text(max_size=20), st.text("0123456789eE.,+-*/^() Nmskg²°%", max_size=30)))
def test_any_text_is_a_quantity_or_refused_and_nothing_else(text: str) -> None:
    for parser in (parse_quantity, parse_unit):
        try:
            parser(text, HERE)
        except ApcError as error:
            assert len(error.mistakes) == 1


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5 1/s", Fraction(5)),
        ("0 1/s", Fraction(0)),
        ("-3 1/min", Fraction(-1, 20)),
        ("1/90 1/s", Fraction(1, 90)),
        ("2e3 1/m^2", Fraction(2000)),
        ("2 1/(N*s)", Fraction(2)),
        ("4 1·1/ms", Fraction(4000)),
        ("3 (N*s)/m", Fraction(3)),
        ("3(kN)", Fraction(3000)),
    ],
)
def test_a_unit_may_start_with_a_one_or_a_parenthesis(text: str, value: Fraction) -> None:
    assert is_quantity(text)
    assert parse_quantity(text, Place("scene.yaml")).value == value


@pytest.mark.parametrize("text", ["5 1", "5*1/s", "1/peers", "5/rate", "2 - 1/s", "1/(peers - 1)", "kt 1/s"])
def test_an_operator_behind_a_number_makes_an_expression(text: str) -> None:
    assert not is_quantity(text)
