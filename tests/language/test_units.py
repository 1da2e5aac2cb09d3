"""Quantities are exact rationals in SI, their units told as an engineer writes them."""

from __future__ import annotations

import functools
from fractions import Fraction

import pint
import pytest

from apc.compiler.compiled import Parameter
from apc.compiler.errors import SourceLocation
from apc.compiler.language.units import TABULATED, parse_unit, unit_by_pint
from tests.topologies import ONE_MASS, compiled, messages_of


@functools.cache
def _named(texts: tuple[str, ...]) -> list[Parameter]:
    listed = "".join(f"  p{place}: {text!r}\n" for place, text in enumerate(texts))
    found = {one.name: one for one in compiled(f"{ONE_MASS}parameters:\n{listed}").parameters}
    return [found[f"p{place}"] for place in range(len(texts))]


def read(*texts: str) -> list[Parameter]:
    """Return the parameters of a topology that have these values."""
    return _named(texts)


def table(text: str) -> dict[str, Fraction]:
    """Return what stands before each arrow, and the number behind it."""
    pairs = (one.split(" → ") for one in text.split(";"))
    return {left.strip(): Fraction(right.strip()) for left, right in pairs}


VALUES = table("""
500 N/m → 500; 500N/m → 500; -4 N → -4; +.5 m → 1/2; 1 ms → 1/1000; 1e-3 s → 1/1000; 1/90 s → 1/90;
-7/3 N → -7/3; 0.1 kg → 1/10; 30 mm → 3/100; 3 kN/mm → 3000000; 1 lb → 45359237/100000000;
1 inch → 127/5000; 5 % → 1/20; 200 Hz → 200; 5 µs → 1/200000; 0.5 → 1/2; 5 1/s → 5; -3 1/min → -1/20;
1/90 1/s → 1/90; 2e3 1/m^2 → 2000; 2 1/(N*s) → 2; 4 1·1/ms → 4000; 3 (N*s)/m → 3; 3(kN) → 3000; 2 m² → 2;
2 cm**2 → 1/5000; 2 m*s^-2 → 2; 7 km^(1/1) → 7000
""")


def test_values_are_exact_rationals_in_si() -> None:
    assert [one.exact for one in read(*VALUES)] == list(VALUES.values())


# What is written, and the unit in which it is shown.
SHOWN = {
    **{unit: unit for unit in ("N", "N/m", "N*s/m", "kg", "m", "m/s", "m/s^2", "s", "1/s", "N*m", "W")},
    **{unit: unit for unit in ("N*s", "kg*m^2", "1/(A*K)", "kg^(1/2)", "rad/s^2", "rad/s", "Hz", "N*m/rad")},
    "kHz": "Hz",
    "rpm": "rad/s",
    "deg": "rad",
    "%": "1",
    **dict.fromkeys(("N/(m/s)", "N·s/m"), "N*s/m"),
    "kg*m/N": "s^2",
    "J": "N*m",
    "m^-1*kg^2": "kg^2/m",
}


def test_a_dimension_is_shown_as_the_unit_an_engineer_writes_and_reads_back() -> None:
    assert [one.unit for one in read(*(f"3 {unit}" for unit in SHOWN))] == list(SHOWN.values())
    repeated = [one for one in SHOWN.values() if one != "1"]
    assert [one.exact for one in read(*(f"3 {unit}" for unit in repeated))] == [3] * len(repeated)


# What a haptics engineer writes, which pint knows by these names too.
ENGINEERS = "N kN mN lbf m mm cm um µm inch ft s ms us min kg g mg lb slug rad deg mrad Pa kPa psi bar mbar"
ENGINEERS += " mil J mJ W V A K newton meter second kilogram radian degree ozf gf"


def test_a_unit_is_what_pint_says_it_is() -> None:
    registry = pint.UnitRegistry()
    names = {"ozf": "force_ounce", "gf": "force_gram"}
    units = ENGINEERS.split()
    for unit, found in zip(units, read(*(f"1 {unit}" for unit in units)), strict=True):
        expected = registry.Quantity(1, names.get(unit, unit)).to_base_units().magnitude
        assert found.value == pytest.approx(expected, rel=1e-12), unit
    assert [one.exact for one in read("1 Hz", "1 kHz", "1 MHz")] == [1, 10**3, 10**6], "told apart from rad/s"


def test_an_angle_in_degrees_is_right_to_more_than_a_float() -> None:
    half = Fraction("1.5707963267948966192313216916397514420985846996875529104874")  # OEIS A019669
    [angle] = read("90 deg")
    assert angle.exact is not None
    assert abs(angle.exact - half) < Fraction(1, 10**38)


@pytest.mark.parametrize(
    "unit", ["(((%^9)^9)^9)^9", "((((Tm^9/Tm^9)^9)^9)^9)^9", f"{'(' * 90}m{')' * 90}", "(m^9)^9", "m^999"]
)
def test_a_unit_is_bounded_in_every_direction(unit: str) -> None:
    for line in messages_of(compiled, f"{ONE_MASS}parameters:\n  p: 5 {unit}\n"):
        assert "E225" in line or "E222" in line


@pytest.mark.parametrize("text", ["5*1/peers", "1/peers", "5/rate", "1/(rate - 1)"])
def test_an_operator_behind_a_number_makes_an_expression(text: str) -> None:
    model = compiled(f"{ONE_MASS}parameters: {{rate: 2, p: {text}}}\n")
    found = {one.name: one.exact for one in model.parameters}
    assert found["p"] == eval(text, {"peers": 1, "rate": Fraction(2)})


def test_the_table_of_units_is_that_of_pint() -> None:
    names = [line.split()[0] for line in TABULATED.strip().splitlines()]
    assert len(names) == len(set(names)) > 30
    for name in names:
        tabulated, defined = parse_unit(name, SourceLocation("test")), unit_by_pint(name)
        assert tabulated == defined
        assert tabulated.dimension.turning == defined.dimension.turning  # ignored by ==
