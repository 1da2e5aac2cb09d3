"""`plain`: a function's operations are CasADi's; a loop is solved to rounding."""

from __future__ import annotations

import math
from typing import Any

import casadi
import numpy as np
import pytest

from apc.compiler.pipeline import compile_topology
from apc.compiler.plain import Loop, composed, straight, symbolic, walk
from tests.topologies import SCENES


def walked(function: Any, arguments: list[Any]) -> list[Any]:
    """Return the outputs of a function, evaluated anew from its operations by CasADi's rules."""
    known = straight(function)
    entries = [entry for one in arguments for entry in casadi.vertsplit(casadi.SX(one)) if one.size]
    values = walk(known, [*entries, *map(casadi.SX, known.constants)], symbolic)
    return [[float(values[place]) for place in places] for places in known.results]


@pytest.mark.parametrize("scene", ["three-users-average", "god-object", "two-users-waves", "client-server"])
def test_a_functions_operations_give_the_same_numbers(scene: str) -> None:
    numbers = np.random.default_rng(1)
    for kind in compile_topology(SCENES / f"{scene}.yaml").kinds:
        ticks = [one.tick for one in kind.clocks]
        for function in (kind.derivative, *ticks, *(one.send for one in kind.sends)):
            arguments = [numbers.uniform(-1, 1, function.numel_in(i)) for i in range(function.n_in())]
            for given, expected in zip(walked(function, arguments), function.call(arguments), strict=True):
                assert np.array_equal(given, np.asarray(expected).ravel(), equal_nan=True)


def test_a_loop_has_cardanos_root() -> None:
    x, z, q = (casadi.SX.sym(name) for name in "xzq")
    given = casadi.Function("given0", [x], [casadi.SX(0), x], ["x"], ["begin", "q"])
    residual = casadi.Function("residual", [z, q], [z + z**3 - q], ["z", "q"], ["r"])
    result = casadi.Function("result", [x, z], [2 * z], ["x", "z0"], ["y"])
    function = composed("f", [Loop(given, residual)], result, ["x"])
    root = math.sqrt(25 + 1 / 27)
    cardano = (5 + root) ** (1 / 3) - 1 / (3 * (5 + root) ** (1 / 3))
    assert float(function(10)) == pytest.approx(2 * cardano, rel=1e-14)
