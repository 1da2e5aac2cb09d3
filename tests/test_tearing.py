"""Claims about algebraic loops: linear ones come out explicit, nonlinear ones are torn and solved inside."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apc.compiler.compiled import Kind, SendPartition, State
from apc.compiler.equations.blocks import solve_blocks
from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.matching import match_columns, strong_components
from apc.compiler.equations.residuals import Residual
from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.symbolic import no_derivative, to_term
from apc.compiler.equations.terms import symbol
from apc.compiler.equations.zero_test import Divisors
from apc.compiler.errors import Mistakes, Place
from apc.compiler.functions.casadi_writer import Writer
from apc.compiler.language.expression import Name
from apc.compiler.language.grammar import parse_equation
from apc.frame.jacobians import jacobians
from apc.frame.linearize import linearize

PLACE = Place("test.yaml", 1, 1)


def solve(text: str, unknowns: str) -> tuple[tuple[object, ...], list[str]]:
    """Return the steps that solve the lines of a text, and the mistakes."""
    residuals = []
    for line in filter(None, map(str.strip, text.splitlines())):
        parsed = parse_equation(line, PLACE)
        left, right = (to_term(side, no_derivative) for side in (parsed.left, parsed.right))
        equation = FlatEquation(parsed.left, parsed.right, "test", None, PLACE)
        residuals.append(Residual(left - right, equation))
    mistakes = Mistakes()
    own = [symbol(u) for u in unknowns.split()]
    steps = solve_blocks(residuals, own, "the equations", mistakes)
    return steps, [f"{m.code} {m.sentence}" for m in mistakes._found]


def values(text: str, unknowns: str, **numbers: float) -> dict[str, float]:
    """Solve, in CasADi, at the numbers given."""
    steps, said = solve(text, unknowns)
    assert not said
    definitions = {}
    for step in steps:
        if isinstance(step, ImplicitBlock):
            definitions |= {symbol(name): step for name in step.unknowns}
        else:
            definitions[symbol(step[0])] = step[1]
    given = casadi.SX.sym("given", len(numbers))
    writer = _writer({symbol(name): given[place] for place, name in enumerate(numbers)}, definitions)
    written = writer.column(writer.write(symbol(name)) for name in unknowns.split())
    function = writer.function("f", {"given": given}, "found", written)
    found = np.asarray(function(list(numbers.values()))).ravel()
    return dict(zip(unknowns.split(), map(float, found), strict=True))


def _writer(known: dict[str, Any], definitions: dict[str, Any]) -> Writer:
    return Writer(known, definitions, {}, {})


@pytest.mark.parametrize("x", [-20.0, -1.0, 0.0, 0.3, 2.0, 1e6])
def test_a_cubic_loop_has_cardanos_root(x: float) -> None:
    root = math.sqrt(x * x / 4 + 1 / 27)
    cardano = math.copysign(abs(x) / 2 + root, x)
    first = math.copysign(abs(cardano) ** (1 / 3), x)
    exact = first - 1 / (3 * first)
    assert values("y + y^3 = x", "y", x=x)["y"] == pytest.approx(exact, rel=1e-13, abs=1e-13)


def test_a_loop_of_many_unknowns_is_torn_to_one() -> None:
    text = "a = p*b\nb = c + 1\nc = d - 2\nd + d^3 = 3*a"
    [block], said = solve(text, "a b c d")
    assert isinstance(block, ImplicitBlock)
    assert not said
    assert len(block.tearing) == len(block.residuals) == 1
    assert len(block.inner) == 3
    assert block.chain == "a → b → c → d → a"
    assert block.equations[3] == "`d + d^3 = 3*a` (test)"
    assert {s.name for s in block.free_symbols} == {"p"}
    found = values(text, "a b c d", p=0.25)
    assert found["d"] + found["d"] ** 3 == pytest.approx(3 * 0.25 * (found["d"] - 1), abs=1e-13)


def test_two_guesses_are_made_where_one_is_not_enough() -> None:
    text = "x^3 + y = 3\nx + y^3 = 3 + e"
    [block], _ = solve(text, "x y")
    assert isinstance(block, ImplicitBlock)
    found = values(text, "x y", e=0.0)
    assert found["x"] ** 3 + found["y"] == pytest.approx(3.0, abs=1e-12)
    assert found["x"] + found["y"] ** 3 == pytest.approx(3.0, abs=1e-12)


def test_what_follows_a_loop_is_explicit() -> None:
    steps, _ = solve("z = 2*y\ny + exp(y) = x\nw = x + 1", "w y z")
    assert [isinstance(step, ImplicitBlock) for step in steps].count(True) == 1
    found = values("z = 2*y\ny + exp(y) = x\nw = x + 1", "w y z", x=1.0)
    assert found == {"w": 2.0, "y": pytest.approx(0.0, abs=1e-13), "z": pytest.approx(0.0, abs=1e-13)}


def test_a_loop_through_a_condition_that_is_known_stays_linear() -> None:
    steps, _ = solve("f = if x > 0 then k*(f - 1) + x else 0", "f")
    assert not any(isinstance(step, ImplicitBlock) for step in steps)
    assert values("f = if x > 0 then k*(f - 1) + x else 0", "f", x=2.0, k=0.5)["f"] == 3.0


def test_a_loop_that_holds_no_unknown_in_the_end_is_a_mistake() -> None:
    _, said = solve("u = sin(v)\nu = sin(v) + 1", "u v")
    assert said == [
        "E503 the equations hold a loop without an unknown left to solve for: u → v → u, "
        "by `u = sin(v)` (test), `u = sin(v) + 1` (test)."
    ]


def test_linear_equations_that_depend_on_each_other_are_named() -> None:
    _, said = solve("a + b + c = 1\na - b = 2\n2*b + c = p\nd = a", "a b c d")
    assert said == [
        "E511 the equations depend on each other and don't determine c: `a + b + c = 1` (test), "
        "`a - b = 2` (test), `2*b + c = p` (test)."
    ]


def test_a_pivot_is_a_number_where_there_is_one() -> None:
    # At c = 0 the equations are regular, and dividing by c would lose that.
    found = values("c*a + b = 1\na - c*b = 2", "a b", c=0.0)
    assert found == {"a": 2.0, "b": 1.0}


@given(st.integers(2, 6), st.integers(0, 10**6))
def test_linear_loops_have_the_solution_numpy_finds(size: int, seed: int) -> None:
    numbers = np.random.default_rng(seed)
    matrix = numbers.integers(-3, 4, (size, size)) + 10 * np.eye(size, dtype=int)
    right = numbers.integers(-3, 4, size)
    names = [f"x{i}" for i in range(size)]
    lines = [
        " + ".join(f"({int(value)})*k*{name}" for value, name in zip(row, names, strict=True))
        + f" = {int(b)}*k"
        for row, b in zip(matrix, right, strict=True)
    ]
    found = values("\n".join(lines), " ".join(names), k=1.5)
    np.testing.assert_allclose(list(found.values()), np.linalg.solve(matrix, right), rtol=1e-10, atol=1e-12)


def test_a_chain_of_three_hundred_linear_equations_does_not_grow() -> None:
    size = 300
    lines = [f"(2 + k[{i + 1}])*x{i} - x{max(i - 1, 0)} - x{min(i + 1, size - 1)} = 1" for i in range(size)]
    names = " ".join(f"x{i}" for i in range(size))
    found = values("\n".join(lines), names, **{f"k[{i + 1}]": 0.01 for i in range(size)})
    assert found["x150"] == pytest.approx(100.0, rel=1e-9)


@given(st.lists(st.lists(st.integers(0, 5), max_size=4), max_size=6))
def test_a_matching_is_as_large_as_halls_theorem_allows(incidence: list[list[int]]) -> None:
    matched = sum(row is not None for row in match_columns(incidence, 6))
    rows = range(len(incidence))
    deficiency = max(
        (
            sum(mask >> i & 1 for i in rows) - len({c for i in rows if mask >> i & 1 for c in incidence[i]})
            for mask in range(1 << len(incidence))
        ),
        default=0,
    )
    assert matched == len(incidence) - deficiency


def test_components_come_after_what_they_need() -> None:
    assert strong_components([[1], [2], [1], [0, 3]]) == [[1, 2], [0], [3]]


def test_the_derivative_of_a_loop_is_that_of_the_implicit_function() -> None:
    [block], _ = solve("y + y^3 = x", "y")
    assert isinstance(block, ImplicitBlock)
    given, x = casadi.SX.sym("x"), casadi.MX.sym("x")
    writer = _writer({symbol("x"): given}, {symbol("y"): block})
    function = writer.function("f", {"x": given}, "y", writer.write(symbol("y")))
    slope = casadi.Function("slope", [x], [casadi.jacobian(function(x), x)])
    assert float(slope(10.0)) == pytest.approx(1 / (1 + 3 * 4.0), rel=1e-12)
    assert Name(("y",)) == parse_equation("y = 1", PLACE).left


def test_a_kind_with_a_loop_is_linearized_through_it() -> None:
    # dx/dt = -y where y + y³ = x: at x = 10, y = 2, the slope is -1/(1 + 3·4).
    [block], _ = solve("y + y^3 = x", "y")
    assert isinstance(block, ImplicitBlock)
    inputs = {name: casadi.SX.sym(name, size) for name, size in (("x", 1), ("u", 0), ("p", 1), ("t", 1))}
    writer = _writer({symbol("x"): inputs["x"]}, {symbol("y"): block})
    y = writer.write(symbol("y"))
    kind = Kind(
        "loop",
        (State("x", "m", "x"),),
        (),
        ("x",),
        writer.function("derivative", inputs, "dx", -y),
        (),
        (SendPartition("lan", ("y",), ("m",), writer.function("send", inputs, "s", y)),),
    )
    built = jacobians(kind)
    site = linearize(built, np.array([10.0]))
    assert not built.affine
    assert site.a[0, 0] == pytest.approx(-1 / 13, rel=1e-12)
    assert site.sends[0].x[0, 0] == pytest.approx(1 / 13, rel=1e-12)


def test_only_what_needs_a_loop_solves_it() -> None:
    [block], _ = solve("y + y^3 = x", "y")
    x = casadi.SX.sym("x")
    writer = _writer({symbol("x"): x}, {symbol("y"): block})
    y = writer.write(symbol("y"))
    assert writer.function("f", {"x": x}, "y", 2 * x).is_a("SXFunction")
    assert writer.function("f", {"x": x}, "y", 2 * y).is_a("MXFunction")


def test_a_loop_that_needs_another_is_solved_after_it() -> None:
    found = values("y + y^3 = x\nz + z^5 = 2*y\nw = z - y", "y z w", x=10.0)
    assert found["y"] == pytest.approx(2.0, abs=1e-12)
    assert found["z"] + found["z"] ** 5 == pytest.approx(4.0, abs=1e-12)
    assert found["w"] == found["z"] - found["y"]


def test_a_number_a_peer_has_the_residue_of_its_fraction() -> None:
    numbers = [0.1, -3.5, 1e300, 5e-324, -2.3e-308, 0.0, 1.0, 123456789.123]
    for number in numbers:
        others = [one for one in numbers if one != number]
        test = Divisors(numbers=[{symbol("a"): np.array(others), symbol("b"): Fraction(number)}]).vanishes
        assert not test(symbol("a") - symbol("b"))
        test = Divisors(numbers=[{symbol("a"): np.array(numbers), symbol("b"): Fraction(number)}]).vanishes
        assert test(symbol("a") - symbol("b"))
