"""`symbolic`: trees become SymPy nodes, exactly, and nothing is parsed or simplified on the way."""

from __future__ import annotations

import pytest
import sympy

from apc.compiler.equations.symbolic import derivative_symbol, head, symbol, to_sympy
from apc.compiler.errors import Place
from apc.compiler.language.grammar import parse_expression

X, Y = symbol("x"), symbol("y")


def build(text: str) -> sympy.Expr:
    return to_sympy(
        parse_expression(text, Place("a.yaml")), lambda expression: sympy.Function("D")(expression)
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.1*x", sympy.Rational(1, 10) * X),
        ("x/3 - -y", X / 3 + Y),
        ("x^2", X**2),
        ("x^(1/2)", sympy.sqrt(X)),
        ("sqrt(x)", sympy.sqrt(X)),
        ("exp(x) + log(y) + sin(x)*cos(y) + tanh(x)", None),
        ("a.b.c", symbol("a.b.c")),
        ("der(x*y)", sympy.Function("D")(X * Y)),
        ("max(x, y)", head("max")(X, Y)),
        ("if x < y then x else y", head("if")(head("less")(X, Y), X, Y)),
        ("if not (x == y or x != y) then 1 else 2", None),
    ],
)
def test_a_tree_becomes_the_same_expression(text: str, expected: sympy.Expr | None) -> None:
    built = build(text)
    if expected is not None:
        assert built == expected
    assert built.free_symbols <= {X, Y, symbol("a.b.c")}


def test_the_same_name_is_the_same_symbol() -> None:
    assert symbol("device.x") == symbol("device.x")
    assert derivative_symbol("device.x") == symbol("der(device.x)")


def test_names_of_sympys_own_stay_plain_names() -> None:
    assert all(build(name) == symbol(name) for name in ("E", "I", "S", "N", "pi", "oo", "Q", "beta", "gamma"))
