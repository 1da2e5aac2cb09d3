"""`symbolic` and `terms`: trees become terms, which mean what is written, as mpmath and SymPy see it."""

from __future__ import annotations

import math
import operator
from typing import Any

import mpmath
import pytest
import sympy
from hypothesis import assume, given
from hypothesis import strategies as st

from apc.compiler.equations.symbolic import derivative_symbol, differential, is_no_number, to_term
from apc.compiler.equations.terms import NO_NUMBER, ONE, ZERO, Term, add, apply, multiply, symbol
from apc.compiler.errors import Place
from apc.compiler.language.expression import SMOOTH, Binary, Call, Expr, Name, Negate, Number, fold
from apc.compiler.language.grammar import parse_expression
from tests.algebra import as_sympy

X, Y = symbol("x"), symbol("y")
NAMES = ("x", "y", "z")


def build(text: str) -> Term:
    return to_term(parse_expression(text, Place("a.yaml")), lambda expression: apply("D", expression))


def joined(parts: Any) -> Any:
    two = st.tuples(parts, st.sampled_from("+-*/"), parts).map(lambda t: f"({t[0]}){t[1]}({t[2]})")
    exponents = st.sampled_from(("2", "3", "(-1)", "(-2)", "(1/2)", "(3/2)", "(1/3)"))
    raised = st.tuples(parts, exponents).map(lambda t: f"({t[0]})^{t[1]}")
    called = st.tuples(st.sampled_from(("sqrt", "abs", *SMOOTH)), parts)
    return st.one_of(
        two, two, two, raised, called.map(lambda t: f"{t[0]}({t[1]})"), parts.map("-({})".format)
    )


OPERATORS = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "^": operator.pow,
}
LEAVES = st.sampled_from((*NAMES, *NAMES, "0", "1", "2", "8", "0.1", "3"))
TEXTS = st.recursive(LEAVES, joined, max_leaves=8)


def at(text: str, point: dict[str, float]) -> Any:
    """Evaluate a text of the language by mpmath; an ArithmeticError or a ValueError where it has none."""

    def leaf(node: Name | Number) -> Any:
        if isinstance(node, Name):
            return mpmath.mpf(point[node.parts[0]])
        return mpmath.mpf(node.value.numerator) / node.value.denominator

    def operation(node: Expr, *operands: Any) -> Any:
        if isinstance(node, Call):
            found = abs(*operands) if node.function == "abs" else getattr(mpmath, node.function)(*operands)
        elif isinstance(node, Negate):
            found = -operands[0]
        else:
            assert isinstance(node, Binary)
            found = OPERATORS[node.operator](*operands)
        if not (isinstance(found, mpmath.mpf) and abs(found) < 1e12):
            raise ValueError("no real number of which 20 digits are known")
        return found

    return fold(parse_expression(text, Place("a.yaml")), leaf, operation)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x/3 - -y", "y + 1/3*x"),
        ("2*(x + y) - x", "x + 2*y"),
        ("x*y - y*x", "0"),
        ("x/x + x*x", "x^2 + 1"),
        ("(2*x*y)^2/x", "4*y^2*x"),
        ("sqrt(x)*sqrt(x)", "x"),
        ("sqrt(4*x^2*y)", "2*sqrt(y)*abs(x)"),
        ("abs(x)^2", "x^2"),
        ("x^(1/2)", "sqrt(x)"),
        ("sqrt(9/4)", "3/2"),
        ("sqrt(2)*sqrt(2)", "2"),
        ("exp(x)*exp(y)*exp(-x)", "exp(y)"),
        ("log(exp(x))", "x"),
        ("sin(x - y) + sin(y - x)", "0"),
        ("cos(-x)", "cos(x)"),
        ("asin(-x) + asin(x) + cosh(-x) - cosh(x)", "0"),
        ("acos(1) + tan(0) + atan(0)", "0"),
        ("floor(-2/3) + sign(-2/3) + floor(0*x) + sign(3)", "-1"),
        ("floor(-sqrt(2)) + sign(1 - sqrt(2)) + floor(sqrt(2)*sqrt(2))", "-1"),
        ("der(x*y)", "D(x*y)"),
    ],
)
def test_terms_have_one_normal_form(text: str, expected: str) -> None:
    assert str(build(text)) == expected or build(text) == build(expected)


@pytest.mark.parametrize(
    "text", ["max(x, y)", "if x < y then x else y", "if not (x == y or x != y) then 1 else 2"]
)
def test_what_bends_or_jumps_stays_as_it_is(text: str) -> None:
    assert str(build(text)) == text
    assert build(text).free_symbols == {X, Y}


@given(TEXTS, st.tuples(*(st.integers(-40, 40).map(lambda n: (n + 0.5) / 16) for _ in NAMES)))
def test_a_term_and_its_text_mean_what_is_written(text: str, point: tuple[float, ...]) -> None:
    values = dict(zip(NAMES, point, strict=True))
    term = build(text)
    with mpmath.workdps(40):
        try:
            expected = at(text, values)
        except (ArithmeticError, ValueError):
            return  # it has no value there
        assert term is not NO_NUMBER
        table = {sympy.Symbol(name, real=True): sympy.Rational(value) for name, value in values.items()}
        found = mpmath.mpf(str(sympy.re(as_sympy(term).subs(table).evalf(40))))
        for one in (found, at(str(term), values)):
            assert abs(one - expected) <= 1e-20 * (1 + abs(expected))


@pytest.mark.parametrize("text", ["asin(2)", "acos(-1.5)", "1 + asin(sqrt(2))"])
def test_no_angle_has_a_sine_beyond_one(text: str) -> None:
    assert is_no_number(build(text))


@pytest.mark.parametrize("text", ["atan2(x, y)", "atan2(y^2, x)", "atan2(x, x*y)", "x*atan2(sin(x), cos(x))"])
def test_the_slope_of_an_angle_is_sympys(text: str) -> None:
    x, y = sympy.symbols("x y", real=True)
    found = as_sympy(differential(build(text), lambda s: ONE if s == X else ZERO))
    expected = sympy.diff(as_sympy(build(text)), x)
    for point in ((0.3, 0.7), (-1.2, 0.4), (2.5, -3.0)):
        at_it = {x: sympy.Rational(str(point[0])), y: sympy.Rational(str(point[1]))}
        assert abs((found - expected).subs(at_it).evalf(30)) < 1e-20


@given(st.lists(TEXTS.map(build), min_size=2, max_size=5), st.randoms())
def test_terms_are_equal_in_any_order(terms: list[Term], dice: Any) -> None:
    other = list(terms)
    dice.shuffle(other)
    assert add(*terms) == add(*other)
    assert hash(add(*terms)) == hash(add(*other))
    assert add(*terms) - add(*other) == ZERO or add(*terms) is NO_NUMBER
    assert multiply(*terms) == multiply(*other)


@given(TEXTS)
def test_a_derivative_is_sympys(text: str) -> None:
    term = build(text)
    assume(not is_no_number(term) and "abs" not in str(term))
    slope = differential(term, lambda s: ONE if s == X else ZERO)
    x = sympy.Symbol("x", real=True)
    expected = sympy.diff(as_sympy(term), x)
    point = {sympy.Symbol(name, real=True): sympy.Rational(7 + n, 5) for n, name in enumerate(NAMES)}
    left, right = (complex(one.subs(point).evalf(30)) for one in (as_sympy(slope), expected))
    assume(math.isfinite(abs(right)))
    assert abs(left - right) <= 1e-12 * (1 + abs(right))


@pytest.mark.parametrize(
    "text",
    [
        *(
            "1/0",
            "x + 0*(1/0)",
            "max(x, 1/(y - y))",
            "sqrt(-2)*y",
            "log(0)",
            "log(1 - 2)",
            "x*(sqrt(2) - 2)^(1/2)",
        ),
        *("(1e300)^2", "x*1e300*1e300", "x + 1e300*1e300", "sqrt(-x^2)", "(x*y - y*x)^(-1)"),
    ],
)
def test_a_constant_that_is_no_number_shows(text: str) -> None:
    assert is_no_number(build(text))


@pytest.mark.parametrize(
    "text", ["1e300*x/1e300", "sqrt(2)", "log(2)", "sqrt(-x)", "1/x", "exp(-1000)", "0^2"]
)
def test_what_may_be_a_number_is_kept(text: str) -> None:
    assert not is_no_number(build(text))


def test_the_same_name_is_the_same_symbol() -> None:
    assert symbol("device.x") is symbol("device.x")
    assert derivative_symbol("device.x") == symbol("der(device.x)")
