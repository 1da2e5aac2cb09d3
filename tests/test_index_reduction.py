"""Claims about index reduction: rigid connections, constraints, and the states chosen.

Each model is written as equations of one site; its right-hand side is evaluated at numbers and compared with
the equations of motion derived by hand.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from apc.compiler.equations.clock_inference import CONTINUOUS
from apc.compiler.equations.clocks import ClockedKind, HoldCrossing, Partition, SampleCrossing
from apc.compiler.equations.flatten import FlatEquation, FlatKind, FlatVariable
from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.structure import SortedKind, sort_kind
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.language.dimensions import DIMENSIONLESS
from apc.compiler.language.expression import Number
from apc.compiler.language.grammar import parse_equation, parse_expression
from tests.algebra import as_sympy

PLACE = Place("test.yaml", 1, 1)
MASS = """
der({0}.x) = {0}.v
{0}.m*der({0}.v) = {0}.f - {0}.c*{0}.v
"""


def site(
    text: str, variables: str, *, starts: str = "", holds: str = "", samples: dict[str, str] | None = None
) -> ClockedKind:
    """Return a kind whose continuous equations are the lines of a text; `holds` are names in it."""
    equations = []
    for line in filter(None, map(str.strip, text.splitlines())):
        parsed = parse_equation(line, PLACE)
        equations.append(FlatEquation(parsed.left, parsed.right, "test", None, PLACE))
    names, started = variables.split(), starts.split()
    flat = FlatKind.__new__(FlatKind)
    declared = tuple(FlatVariable(name, DIMENSIONLESS, name in started) for name in names)
    fields = {"name": "test", "variables": declared, "equations": tuple(equations)}
    for name in FlatKind.__slots__:
        object.__setattr__(flat, name, fields.get(name, ()))
    return ClockedKind(
        flat,
        (Partition(CONTINUOUS, tuple(names), tuple(equations)),),
        tuple(
            SampleCrossing(name, "haptic", parse_expression(expression, PLACE))
            for name, expression in (samples or {}).items()
        ),
        tuple(HoldCrossing(name, f"{name}.value", "haptic", Number(0)) for name in holds.split()),
        (),
        (),
        (),
    )


def sorted_site(text: str, variables: str, **more: Any) -> SortedKind:
    """Sort a site; raise its mistakes."""
    mistakes = Mistakes()
    kind = sort_kind(site(text, variables, **more), mistakes)
    mistakes.raise_if_any()
    return kind


def values(kind: SortedKind, **numbers: float) -> dict[str, float]:
    """Evaluate all assignments in order; a name `a.x` is given as `a_x`."""
    known = {name.replace(".", "_"): number for name, number in numbers.items()}
    for step in kind.partitions[0].assignments:
        assert not isinstance(step, ImplicitBlock)
        name, expression = step
        table = {as_sympy(s): known[s.name.replace(".", "_")] for s in expression.free_symbols}
        known[name.replace(".", "_")] = float(as_sympy(expression).subs(table))
    for name, expression in (*kind.aliases, *((s, e) for s, _, e in kind.samples)):
        table = {as_sympy(s): known[s.name.replace(".", "_")] for s in expression.free_symbols}
        known[name.replace(".", "_")] = float(as_sympy(expression).subs(table))
    return known


def mistakes_of(text: str, variables: str, **more: Any) -> list[str]:
    with pytest.raises(ApcError) as caught:
        sorted_site(text, variables, **more)
    return [f"{m.code} {m.sentence}" for m in caught.value.mistakes]


TWO = "a.x a.v a.f b.x b.v b.f"
TWO_STARTS = "a.x a.v b.x b.v"


def test_two_rigidly_joined_masses_are_one_of_the_summed_mass_and_damping() -> None:
    text = MASS.format("a") + MASS.format("b") + "a.x = b.x\na.f + b.f = push"
    kind = sorted_site(text, TWO, starts=TWO_STARTS)
    assert kind.states == ("a.x", "a.v")
    found = values(kind, a_m=0.1, b_m=0.3, a_c=5.0, b_c=2.0, push=4.0, a_x=0.01, a_v=0.5)
    acceleration = (4.0 - 7.0 * 0.5) / 0.4
    assert found["der(a_v)"] == pytest.approx(acceleration, rel=1e-14)
    assert found["b_f"] == pytest.approx(0.3 * acceleration + 2.0 * 0.5, rel=1e-14)
    assert (found["b_x"], found["b_v"]) == (0.01, 0.5)


def test_three_joined_masses_are_one_state_pair() -> None:
    text = "".join(MASS.format(name) for name in "abc")
    text += "a.x = b.x\nc.x = b.x\na.f + b.f + c.f = push"
    kind = sorted_site(text, f"{TWO} c.x c.v c.f", starts=f"{TWO_STARTS} c.x c.v")
    assert kind.states == ("a.x", "a.v")
    numbers = {"a_m": 0.1, "b_m": 0.2, "c_m": 0.4, "a_c": 1.0, "b_c": 2.0, "c_c": 3.0}
    found = values(kind, **numbers, push=1.0, a_x=0.0, a_v=-0.25)
    assert found["der(a_v)"] == pytest.approx((1.0 + 6.0 * 0.25) / 0.7, rel=1e-14)


def test_masses_joined_the_other_way_round_have_opposite_velocities() -> None:
    text = MASS.format("a") + MASS.format("b") + "a.x = -b.x\na.f - b.f = push"
    kind = sorted_site(text, TWO, starts=TWO_STARTS)
    assert kind.states == ("a.x", "a.v")
    found = values(kind, a_m=0.1, b_m=0.3, a_c=5.0, b_c=2.0, push=4.0, a_x=0.01, a_v=0.5)
    assert found["der(a_v)"] == pytest.approx((4.0 - 7.0 * 0.5) / 0.4, rel=1e-14)
    assert (found["b_x"], found["b_v"]) == (-0.01, -0.5)


def test_a_mass_fixed_to_the_ground_does_not_move() -> None:
    text = MASS.format("a") + "a.x = 0"
    kind = sorted_site(text, "a.x a.v a.f", starts="a.x a.v")
    assert kind.states == ()
    assert values(kind, a_m=0.1, a_c=5.0) == {"a_m": 0.1, "a_c": 5.0, "a_f": 0.0, "a_x": 0.0, "a_v": 0.0}


def test_a_gear_reflects_the_inertia_of_its_far_side() -> None:
    text = MASS.format("a") + MASS.format("b") + "b.x = k*a.x\na.f + k*b.f = push"
    kind = sorted_site(text, TWO, starts=TWO_STARTS)
    assert kind.states == ("a.x", "a.v")
    found = values(kind, a_m=0.1, b_m=0.3, a_c=5.0, b_c=2.0, k=3.0, push=4.0, a_x=0.01, a_v=0.5)
    acceleration = (4.0 - (5.0 + 9.0 * 2.0) * 0.5) / (0.1 + 9.0 * 0.3)
    assert found["der(a_v)"] == pytest.approx(acceleration, rel=1e-13)
    assert found["b_v"] == pytest.approx(1.5, rel=1e-15)
    assert found["der(b_v)"] == pytest.approx(3.0 * acceleration, rel=1e-13)


def test_a_mass_on_a_massless_bar_moves_with_the_mean_of_its_ends() -> None:
    text = MASS.format("a") + MASS.format("b") + MASS.format("c")
    text += "c.x = (a.x + b.x)/2\na.f + c.f/2 = 0\nb.f + c.f/2 = push"
    kind = sorted_site(text, f"{TWO} c.x c.v c.f", starts=f"{TWO_STARTS} c.x c.v")
    assert kind.states == ("a.x", "a.v", "b.x", "b.v")
    found = values(
        kind,
        a_m=1.0,
        b_m=2.0,
        c_m=4.0,
        a_c=0.0,
        b_c=0.0,
        c_c=0.0,
        push=3.0,
        a_x=0.0,
        a_v=1.0,
        b_x=2.0,
        b_v=2.0,
    )
    # Lagrange with c = (a + b)/2: [[m_a + m_c/4, m_c/4], [m_c/4, m_b + m_c/4]]·(a″, b″) = (0, push).
    determinant = 2.0 * 3.0 - 1.0
    assert found["der(a_v)"] == pytest.approx(-3.0 / determinant, rel=1e-13)
    assert found["der(b_v)"] == pytest.approx(6.0 / determinant, rel=1e-13)
    assert (found["c_x"], found["c_v"]) == (1.0, 1.5)


def test_a_constraint_that_time_moves_gives_its_own_derivatives() -> None:
    text = MASS.format("a") + "a.x = size*time^2"
    kind = sorted_site(text, "a.x a.v a.f", starts="a.x a.v")
    assert kind.states == ()
    found = values(kind, a_m=2.0, a_c=3.0, size=0.5, time=4.0)
    assert (found["a_x"], found["a_v"]) == (8.0, 4.0)
    assert found["a_f"] == pytest.approx(2.0 * 1.0 + 3.0 * 4.0)


def test_the_derivative_of_a_sampled_algebraic_variable_follows_by_the_chain_rule() -> None:
    text = MASS.format("a") + "a.f = push\np = exp(2*a.x)\nq = p + a.x"
    samples = {"s": "der(q)", "t": "der(der(a.x))"}
    kind = sorted_site(text, "a.x a.v a.f p q", starts="a.x a.v", samples=samples)
    assert kind.states == ("a.x", "a.v")
    found = values(kind, a_m=2.0, a_c=1.0, push=3.0, a_x=0.0, a_v=0.25)
    assert found["s"] == pytest.approx(0.75)
    assert found["t"] == pytest.approx(1.375)


def test_the_derivative_of_a_held_force_is_refused() -> None:
    [said] = mistakes_of("k*y = hand\nder(y) = z", "y z", holds="hand")
    assert said == (
        "E508 `k*y = hand` (test) needs the derivative of hand, a force that jumps at its ticks; "
        "a position follows such a force only through a mass."
    )
    [said] = mistakes_of("y = der(2*hand)", "y", holds="hand")
    assert said.startswith("E508 `y = der(2*hand)` (test) needs the derivative of hand, a force that jumps")


def test_a_pendulum_in_cartesian_coordinates_is_refused_and_told_to_take_an_angle() -> None:
    text = """
    der(x) = u
    der(y) = v
    m*der(u) = -tension*x
    m*der(v) = -tension*y - m*g
    x^2 + y^2 = length^2
    """
    [said] = mistakes_of(text, "x y u v tension", starts="x y u v")
    assert said == (
        "E509 the continuous equations: no variable follows from the constraint "
        "`x^2 + y^2 = length^2` (test) in every position, since the factor moves and may vanish: "
        "x (by the factor 2*x), y (by the factor 2*y). "
        "Write: the constraint with an angle or another coordinate that gives every position"
    )


def test_a_pendulum_in_its_angle_swings_by_the_textbook_equation() -> None:
    text = """
    der(angle) = rate
    x = length*sin(angle)
    y = -length*cos(angle)
    u = der(x)
    v = der(y)
    m*der(u) = -tension*x
    m*der(v) = -tension*y - m*g
    """
    kind = sorted_site(text, "x y u v tension angle rate", starts="angle rate")
    assert kind.states == ("angle", "rate")
    found = values(kind, m=0.3, g=9.81, length=0.5, angle=0.4, rate=1.2)
    assert found["der(rate)"] == pytest.approx(-9.81 / 0.5 * math.sin(0.4), rel=1e-12)


def test_a_state_without_a_start_value_is_refused() -> None:
    [said] = mistakes_of("der(a.x) = -a.x", "a.x")
    assert said == (
        "E510 a.x is a state, by `der(a.x) = -a.x` (test), and has no start value. Write: x: {…, start: …}"
    )
    [said] = mistakes_of("m*der(der(a.x)) = push", "a.x", starts="a.x")
    assert said.startswith("E510 der(a.x) is a state, by `m*der(der(a.x)) = push`")


def test_a_second_derivative_takes_the_velocity_that_is_named_as_its_state() -> None:
    kind = sorted_site("m*der(der(x)) = push - c*der(x)\nder(x) = v", "x v", starts="x v")
    assert kind.states == ("x", "v")
    assert values(kind, m=2.0, c=3.0, push=5.0, x=0.0, v=1.0)["der(v)"] == 1.0


def test_masses_joined_twice_leave_the_force_between_them_undetermined() -> None:
    text = MASS.format("a") + MASS.format("b") + "a.x = b.x\na.v = b.v"
    [said] = mistakes_of(text, TWO, starts=TWO_STARTS)
    assert said.startswith("E502 the continuous equations can't be solved: 1 equation hold")


def test_what_is_left_over_names_both_parts_and_only_them() -> None:
    text = "x = 1\nx = p\ny + z = 2\nw = x + 3"
    [said] = mistakes_of(text, "x y z w")
    assert said == (
        "E502 the continuous equations can't be solved: 2 equations hold only 1 unknown (x): "
        "`x = 1` (test), `x = p` (test); and 2 unknowns (y, z) have only 1 equation, `y + z = 2` (test)."
    )


def test_a_thousand_equations_are_solved_within_seconds() -> None:
    count = 160
    lines, names, starts = [], [], []
    for i in range(count):
        lines.append(MASS.format(f"m[{i + 1}]"))
        names += [
            f"m[{i + 1}].x",
            f"m[{i + 1}].v",
            f"m[{i + 1}].f",
            f"s[{i + 1}].f",
            f"s[{i + 1}].l",
            f"s[{i + 1}].e",
        ]
        starts += [f"m[{i + 1}].x", f"m[{i + 1}].v"]
        before = f"s[{i}].f" if i else "0"
        following = f"m[{i + 2}].x" if i + 1 < count else "0"
        lines.append(f"m[{i + 1}].f = s[{i + 1}].f - {before}")
        lines.append(f"s[{i + 1}].l = {following} - m[{i + 1}].x")
        lines.append(f"s[{i + 1}].f = k*s[{i + 1}].l + c*der(s[{i + 1}].l)")
        lines.append(f"s[{i + 1}].e = k*s[{i + 1}].l^2/2")
    kind = sorted_site("\n".join(lines), " ".join(names), starts=" ".join(starts))
    assert len(kind.states) == 2 * count


def test_a_thousand_masses_in_a_row_joined_rigidly_are_one() -> None:
    count = 250
    names = [f"m[{i + 1}]" for i in range(count)]
    text = "".join(MASS.format(name) for name in names)
    text += "\n".join(f"{one}.x = {two}.x" for one, two in itertools.pairwise(names))
    text += f"\n{' + '.join(f'{name}.f' for name in names[:60])} = part\npart + rest = push\n"
    text += "rest = " + " + ".join(f"{name}.f" for name in names[60:120]) + " + rest2\n"
    text += "rest2 = " + " + ".join(f"{name}.f" for name in names[120:180]) + " + rest3\n"
    text += "rest3 = " + " + ".join(f"{name}.f" for name in names[180:])
    variables = " ".join(f"{name}.x {name}.v {name}.f" for name in names) + " part rest rest2 rest3"
    starts = " ".join(f"{name}.x {name}.v" for name in names)
    kind = sorted_site(text, variables, starts=starts)
    assert kind.states == ("m[1].x", "m[1].v")
    numbers = {f"{name}.m": 0.5 for name in names} | {f"{name}.c": 0.1 for name in names}
    found = values(kind, **numbers, push=7.0, **{"m[1].x": 0.0, "m[1].v": 0.2})
    assert found["der(m[1]_v)"] == pytest.approx((7.0 - 0.1 * 0.2 * count) / (0.5 * count), rel=1e-11)
