"""Claims about `apc.compiler.equations.identities`."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction

import pytest

from apc.compiler.equations.symbolic import no_derivative, to_term
from apc.compiler.equations.terms import ONE, add, apply, multiply, number, power, symbol
from apc.compiler.equations.zero_test import ZeroTest
from apc.compiler.errors import Place
from apc.compiler.language.grammar import parse_expression
from tests.topologies import SCENES


@pytest.mark.parametrize(
    ("text", "zero"),
    [
        ("sin(x)^2 + cos(x)^2 - 1", True),
        ("sin(x)^2 + cos(x)^2 - 0.999999", False),
        ("exp(x)*exp(-x) - 1", True),
        ("exp(x + y) - exp(x)*exp(y)", True),
        ("sin(2*x) - 2*sin(x)*cos(x)", True),
        ("sin(2*x) - 2*sin(x)*cos(y)", False),
        ("tanh(x) - (exp(2*x) - 1)/(exp(2*x) + 1)", True),
        ("cos(x) - 1 + x^2/2", False),
        ("max(x, y) - max(y, x) + sin(x)", False),
    ],
)
def test_what_functions_have_in_common_is_known(text: str, zero: bool) -> None:
    term = to_term(parse_expression(text, Place("test")), no_derivative)
    assert ZeroTest()(term) is zero


def test_numbers_of_a_scene_are_put_in_first() -> None:
    angle, a = symbol("angle"), symbol("a")
    vanishing = multiply(apply("sin", angle), a)
    assert ZeroTest(values={angle: Fraction(0)})(vanishing)
    assert not ZeroTest(values={angle: Fraction(1)})(vanishing)
    one = add(power(apply("cos", a), Fraction(2)), power(apply("sin", a), Fraction(2)), number(-1))
    assert ZeroTest(values={angle: Fraction(1)})(one)
    assert not ZeroTest(values={angle: Fraction(1)})(add(one, ONE))


def test_ordinary_scenes_never_import_sympy() -> None:
    """Friction, contacts, walls and quantizers among them: it is half a second of a start."""
    text = (
        "import sys\nfrom pathlib import Path\nfrom apc.compiler.pipeline import compile_topology\n"
        f"for path in sorted(Path({str(SCENES)!r}).glob('*.yaml')):\n    compile_topology(path)\n"
        "print('sympy' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
