"""`plain`: a function and its data are one another; data of no function is refused, and nothing built."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest

from apc.compiler import plain as module
from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.compiler.plain import Loop, composed, plain, read_function
from tests.fuzz.models import _EDGES, _LOOP, _PART
from tests.topologies import SCENES


def functions_of(system: CompiledSystem) -> list[Any]:
    found = []
    for kind in system.kinds:
        found += [kind.derivative, *(one.tick for one in kind.clocks), *(one.send for one in kind.sends)]
        found += [kind.ports.port] if kind.ports else []
        found += [one.edge for part in kind.clocks for one in part.receives if one.edge is not None]
    return found


def again(function: Any) -> Any:
    """Return a function built from what is written of it."""
    return read_function(json.loads(json.dumps(plain(function).document()))).build()


def same_numbers(one: Any, other: Any) -> None:
    numbers = np.random.default_rng(1)
    for _ in range(5):
        arguments = [numbers.uniform(-1, 1, one.numel_in(i)) for i in range(one.n_in())]
        for a, b in zip(one.call(arguments), other.call(arguments), strict=True):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.mark.parametrize("scene", sorted(path.stem for path in SCENES.glob("*.yaml")))
def test_every_function_of_every_scene_comes_back_with_the_same_data_and_the_same_numbers(scene: str) -> None:
    for function in functions_of(compile_topology(SCENES / f"{scene}.yaml")):
        built = again(function)
        assert plain(built) == plain(function)
        assert built.name_in() == function.name_in() and built.name_out() == function.name_out()
        same_numbers(function, built)


@pytest.mark.parametrize("text", [_LOOP, _EDGES])
def test_loops_and_edges_come_back_too(text: str, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "cubic.yaml").write_text(_PART, encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")
    found = functions_of(compile_topology(tmp_path / "scene.yaml"))
    assert any(one.is_a("MXFunction") for one in found) == (text is _LOOP)
    for function in found:
        assert plain(again(function)) == plain(function)
        same_numbers(function, again(function))


def test_every_operation_of_the_list_comes_back() -> None:
    x, y = casadi.SX.sym("x"), casadi.SX.sym("y")
    for name, code in module._UNARY.items():
        function = casadi.Function("f", [x], [casadi.SX.unary(code, x)])
        assert plain(function).operations == ((name, 0),)
        same_numbers(function, again(function))
    for name, code in module._BINARY.items():
        second = casadi.SX(2.5) if name == "constpow" else y  # it is the power of a constant
        function = casadi.Function("f", [x, y], [casadi.SX.binary(code, x, second)])
        [(found, *_)] = plain(function).operations
        assert found == name
        same_numbers(function, again(function))


def test_a_loop_has_cardanos_root_after_it_is_read() -> None:
    x, z, q = (casadi.SX.sym(name) for name in "xzq")
    given = casadi.Function("given0", [x], [casadi.SX(0), x], ["x"], ["begin", "q"])
    residual = casadi.Function("residual", [z, q], [z + z**3 - q], ["z", "q"], ["r"])
    result = casadi.Function("result", [x, z], [2 * z], ["x", "z0"], ["y"])
    function = again(composed("f", [Loop(given, residual)], result, ["x"]))
    root = math.sqrt(25 + 1 / 27)
    cardano = (5 + root) ** (1 / 3) - 1 / (3 * (5 + root) ** (1 / 3))
    assert float(function(10)) == pytest.approx(2 * cardano, rel=1e-14)


def document() -> dict[str, Any]:
    x, y = casadi.SX.sym("x", 2), casadi.SX.sym("y")
    function = casadi.Function(
        "f", [x, y], [casadi.vertcat(x[0] * y + 2.5, casadi.sin(x[1]))], ["x", "y"], ["z"]
    )
    return json.loads(json.dumps(plain(function).document()))  # type: ignore[no-any-return] # it is one


WRONG: tuple[tuple[tuple[Any, ...], Any], ...] = (
    *((("name",), name) for name in ("", "a b", "a;b", "_a", "a__b", "é", "a" * 300, 3, None)),
    *((("inputs", 0), one) for one in (["x", -1], ["x", 1.5], ["x", True], ["x"], ["y", 2], ["x", "2"], 3)),
    *((("outputs",), one) for one in ([], ["z", "w"], ["x"], [3], None)),
    *((("constants", 0), one) for one in (1, "2.5", None, [2.5], True)),
    *(
        (("operations", 0), one)
        for one in (["call", 0, 1], ["mul", 0], ["sin", 0, 1], ["mul", 0, 1, 2], [], "sin")
    ),
    *((("operations", 0, 1), one) for one in (-1, 4, 10**9, 0.0, True, "0", None)),
    *((("results", 0, 0), one) for one in (-1, 7, 10**9, 0.0, True, None)),
    *((("loops",), one) for one in ([3], [[]], [[{}, {}]], {"jit": True}, "x")),
)


@pytest.mark.parametrize(("place", "value"), WRONG)
def test_what_tells_no_function_is_refused(
    place: tuple[Any, ...], value: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = copy.deepcopy(document())
    holder: Any = wrong
    for step in place[:-1]:
        holder = holder[step]
    holder[place[-1]] = value
    monkeypatch.setattr(casadi, "Function", lambda *_: pytest.fail("it is built"))
    with pytest.raises((ValueError, KeyError, TypeError)):
        read_function(wrong)
