"""What an expression means: exact where it is arithmetic, the functions of the math module, derivatives."""

from __future__ import annotations

import math
import random
from fractions import Fraction
from pathlib import Path
from typing import Any

import mpmath
import pytest

from tests.language.own import force, model
from tests.language.test_units import table
from tests.library.parts import ticked
from tests.topologies import AVERAGE, ONE_MASS, compiled, library, replaced


def parameters(*texts: str, before: str = "") -> list[Fraction | float]:
    """Return what expressions of parameters come to in a topology: a fraction where it is exact."""
    named = ", ".join(f"p{place}: '{text}'" for place, text in enumerate(texts))
    model = compiled(f"{ONE_MASS}parameters: {{{before}{named}}}\n")
    found = {one.name: one.value if one.exact is None else one.exact for one in model.parameters}
    return [found[f"p{place}"] for place in range(len(texts))]


# With a = 2, b = 3, c = 5: no other reading of the signs comes to the same.
BINDING = table("""
a + b*c → 17; a - b - c → -6; a/b*c → 10/3; -a^2 → -4; (-a)^2 → 4; -a*b → -6; a*-b → -6; +a → 2; --a → 2;
a - -b → 5; a**2 → 4; a^-2 → 1/4; (a^2)^3 → 64; a - (b - c) → 4; a/(b*c) → 2/15; c/a/b → 5/6;
if a < b or not a == b and b > c then 1 else 0 → 1; if (a > b or not a == b) and b > c then 1 else 0 → 0;
if not (a < b and b < c) then 1 else 0 → 0; if a > b then 1 elseif b < c then 2 else 3 → 2;
a + (if a != 2 then a else b) → 5
""")
EXACT = table("""
0.1 + 0.2 → 3/10; 1e-3 → 1/1000; 1/3 + 1/6 → 1/2; 2^-3 → 1/8; sqrt(4/9) → 2/3; (9/4)^(-3/2) → 8/27;
floor(-7/2) → -4; max(1, 2, 1/2) + min(1, 2) → 3; abs(-3)*sign(-2) → -3;
if 1 < 2 and not 3 < 2 then 3 else 1/0 → 3; 6000/(peers + a) → 2000; ((0.1^100)^100)^100 → 0
""")
FLOATS = {
    "exp(1) + sin(2)*log(3)": math.exp(1) + math.sin(2) * math.log(3),
    "2^(1/2)": math.sqrt(2),
    "2*pi*a": 4 * math.pi,
    "a/2*pi - pi/2": math.pi / 2,
}


def test_operators_bind_as_in_arithmetic_and_rational_operations_stay_exact() -> None:
    expected = {**BINDING, **EXACT}
    found = parameters(*expected, before="a: b - 1, b: 3, c: 5, ")
    assert found == list(expected.values())
    assert all(isinstance(one, Fraction) for one in found)
    floats = [float(one) for one in parameters(*FLOATS, before="a: 2, ")]
    assert floats == list(FLOATS.values())


# A condition of numbers becomes one of functions, which are asked at numbers.
TERMS = {
    "max(x, 1)": lambda x: max(x, 1),
    "min(x, 1)": lambda x: min(x, 1),
    "max(x, 3*x/2, 2*x)": lambda x: max(x, 1.5 * x, 2 * x),
    "abs(x)": abs,
    "sign(x)": lambda x: math.copysign(1, x),
    "floor(x)": math.floor,
    **{f"{one.__name__}(x)": one for one in (math.exp, math.sin, math.cos, math.tan, math.atan)},
    **{f"{one.__name__}(x)": one for one in (math.sinh, math.cosh, math.tanh)},
    "log(x + 9)": lambda x: math.log(x + 9),
    "asin(x/4)": lambda x: math.asin(x / 4),
    "acos(x/4)": lambda x: math.acos(x / 4),
    "atan2(x, 2)": lambda x: math.atan2(x, 2),
    "atan2(-2, x)": lambda x: math.atan2(-2, x),
    "sqrt(x + 9)": lambda x: math.sqrt(x + 9),
    "sqrt(x^2)": abs,
    "x^3": lambda x: x**3,
    "(x + 9)^(1/3)": lambda x: (x + 9) ** (1 / 3),
    "1/(x + 9)^2": lambda x: 1 / (x + 9) ** 2,
    "if x < 1 and not x >= 2 or x == 3 then 4 else 5": lambda x: 4 if x < 1 or x == 3 else 5,
}


@pytest.mark.parametrize("term", TERMS)
def test_every_function_of_the_language_has_its_meaning_and_its_slope(term: str, tmp_path: Path) -> None:
    equations = ["x = flange.x/L", f"y = {term}", "s = T*sample(der(y))", "flange.f = -F*y - hold(F*s)"]
    compiled_model, value = model(tmp_path, *equations), TERMS[term]
    for x in (-1.5, 0.5, 1.0, 2.5, 3.0):
        assert force(compiled_model, x) == pytest.approx(value(x), rel=1e-14), x
    for x in (-1.5, 0.5, 2.5):
        slope = (value(x + 1e-6) - value(x - 1e-6)) / 2e-6
        for held in ticked(compiled_model, {"device.x": x, "device.v": 0.5}).values():
            assert held == pytest.approx(0.5 * slope, rel=1e-7, abs=1e-9), x


def _random(chance: random.Random, depth: int) -> str:
    """Return a smooth expression of x: with a value and a slope at every x from 0.2 to 2."""
    if not depth:
        return chance.choice(["x", "x", "2", "0.1", "3"])
    one, two = (_random(chance, depth - 1) for _ in range(2))
    name = chance.choice(["sin", "cos", "tanh", "atan"])
    return chance.choice(
        [
            *(f"({one} + {two})", f"({one} - {two})", f"{one}*{two}", f"-({one})", f"{name}({one})"),
            *(f"{one}/(2 + sin({two}))", f"(2 + sin({one}))^(3/2)", f"({one})^2", f"sqrt(1 + ({two})^2)"),
            *(f"log(2 + cos({one}))", f"exp(sin({one}))", f"atan2({one}, 3 + sin({two}))"),
        ]
    )


@pytest.mark.parametrize("seed", range(25))
def test_an_expression_and_its_derivative_mean_what_is_written(seed: int, tmp_path: Path) -> None:
    """By mpmath: the force is the expression, what is held at a tick its derivative, by the chain rule."""
    text = _random(random.Random(seed), 3)
    equations = ["x = flange.x/L", f"y = {text}", "s = T*sample(der(y))", "flange.f = -F*y - hold(F*s)"]
    compiled_model = model(tmp_path, *equations)
    names = ("sin", "cos", "tanh", "atan", "sqrt", "log", "exp", "atan2")
    known = {name: getattr(mpmath, name) for name in names}

    def value(x: Any) -> Any:
        return eval(text.replace("^", "**"), {**known, "x": x})

    for x in (0.2, 0.9, 2.0):
        with mpmath.workdps(30):
            expected, slope = value(mpmath.mpf(x)), mpmath.diff(value, x)
        assert force(compiled_model, x) == pytest.approx(float(expected), rel=1e-12, abs=1e-12)
        for held in ticked(compiled_model, {"device.x": x, "device.v": 0.5}).values():
            assert held == pytest.approx(0.5 * float(slope), rel=1e-11, abs=1e-11)


def test_what_follows_from_others_keeps_its_text_and_follows() -> None:
    text = replaced(
        AVERAGE,
        ("clocks:", "parameters: {half: whole/2, whole: 2 N/mm}\nclocks:"),
        ("500 N/m,", "half/(peers - 1),"),
    )
    model = compiled(text)
    found = {one.name: one for one in model.parameters}
    assert (found["half"].exact, found["coordination.stiffness"].exact) == (1000, 500)
    formula = found["coordination.stiffness"].formula
    assert formula is not None and formula.text == "half/(peers - 1)"
    assert set(model.followers) == {"half", "coordination.stiffness"}


NAMED = """\
component: Own
connectors: {flange: Flange}
parameters:
  pie: {unit: N, default: 3}
  side: {unit: N, default: -1, options: {left: -1, right: 1}}
equations: ['flange.f = if side == left then pie else 2*side']
"""


@pytest.mark.parametrize(("side", "expected"), [("left", -3.0), ("right", -2.0)])
def test_a_word_stands_for_its_number_and_pie_is_no_pi(side: str, expected: float, tmp_path: Path) -> None:
    topology = f"{ONE_MASS}hands: {{own: {{type: Own, flange: device, side: {side}}}}}\n"
    assert force(compiled(topology, library(tmp_path, NAMED))) == expected
