"""`native`: machine code where there is a compiler, the same functions otherwise."""

from __future__ import annotations

from pathlib import Path

import casadi
import pytest

from apc.runtime.simulate import native as module
from apc.runtime.simulate.native import cache_folder, compiler, native


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def functions() -> list[casadi.Function]:
    x, y = casadi.SX.sym("x", 2), casadi.SX.sym("y")
    one = casadi.Function("f", [x, y], [x[0] * y + casadi.sin(x[1]), x / y])
    return [one, casadi.Function("f", [x], [casadi.fmax(x[0], x[1])])]


needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@needs_compiler
def test_machine_code_gives_the_same_numbers_to_the_last_bit(cache: Path) -> None:
    one, two = native(functions())
    assert one.class_name() == "External"
    for plain, built, arguments in zip(functions(), (one, two), ([[0.1, 0.2], 0.3], [[2, 3]]), strict=True):
        expected, found = plain.call(arguments), built.call(arguments)
        assert [str(a) for a in expected] == [str(b) for b in found]


@needs_compiler
def test_what_was_compiled_once_is_found_again(cache: Path) -> None:
    native(functions())
    [library] = cache.iterdir()
    before = library.stat().st_mtime_ns
    native(functions())
    assert [one.stat().st_mtime_ns for one in cache.iterdir()] == [before]


def test_without_a_compiler_the_functions_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "compiler", lambda: None)
    listed = functions()
    assert all(one is two for one, two in zip(native(listed), listed, strict=True))


@needs_compiler
def test_a_folder_that_cant_be_written_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "file" / "cache")
    listed = functions()
    assert all(one is two for one, two in zip(native(listed), listed, strict=True))


def test_the_cache_is_where_the_system_keeps_such_things(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert cache_folder() == Path("/somewhere/apc")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder() == Path.home() / ".cache" / "apc"


@needs_compiler
def test_steps_that_repeat_are_compiled_and_solvers_are_left_as_they_are(cache: Path) -> None:
    x = casadi.SX.sym("x")
    step = casadi.Function("step", [x], [x - 0.01 * casadi.sin(x)])
    whole = casadi.MX.sym("whole")
    many = casadi.Function("many", [whole], [2 * step.fold(1000)(whole)])
    solver = casadi.integrator("solver", "cvodes", {"x": x, "ode": -x}, 0, 1)
    solved = casadi.Function("solved", [whole], [solver(x0=whole)["xf"]])
    quick, same = native([many, solved])
    assert quick is not many
    assert same is solved
    assert float(quick(1.5)) == float(many(1.5))
