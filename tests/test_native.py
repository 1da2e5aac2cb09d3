"""`native`: machine code where there is a compiler, the same functions otherwise."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import casadi
import pytest

from apc.compiler import seal
from apc.simulation import native as module
from apc.simulation.native import compiler, native
from tests.topologies import ROOT


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "cache")
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
    before = {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in cache.iterdir()}
    assert sorted(Path(name).suffix for name in before) == ["", ".seal", ".so"]
    native(functions())
    assert before == {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in cache.iterdir()}


def results(listed: Sequence[casadi.Function]) -> list[str]:
    return [str(listed[0].call([[0.1, 0.2], 0.3])), str(listed[1].call([[2, 3]]))]


@needs_compiler
@pytest.mark.parametrize("part", [0, 7, 13, 19])
def test_a_library_with_a_bit_turned_is_compiled_again(cache: Path, part: int) -> None:
    native(functions())
    [library] = cache.glob("*.so")
    # Written anew under its name: a library that this process has loaded stays what it is.
    whole = library.read_bytes()
    data = bytearray(whole)
    data[len(data) * part // 20] ^= 1 << part % 8
    library.unlink()
    library.write_bytes(data)
    ran = subprocess.run(
        [sys.executable, "-c", AGAIN, str(cache)], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == str(results(functions()))
    assert library.read_bytes() == whole


AGAIN = """
import sys
from pathlib import Path
from apc.compiler import seal
from tests.test_native import functions, native, results
seal._folder = lambda: Path(sys.argv[1])
built = native(functions())
assert built[0].class_name() == "External"
print(results(built))
"""


@needs_compiler
def test_a_library_that_somebody_else_put_there_is_not_loaded(cache: Path) -> None:
    native(functions())
    [library], [mark] = cache.glob("*.so"), cache.glob("*.seal")
    whole = library.read_bytes()
    library.unlink()
    library.write_bytes(b"another library")
    mark.write_text(hashlib.sha256(b"another library").hexdigest(), encoding="ascii")
    assert results(native(functions())) == results(functions())
    assert library.read_bytes() == whole


@needs_compiler
def test_a_folder_of_another_user_is_not_used(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.mkdir(mode=0o700)
    mine = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: mine + 1)
    listed = functions()
    assert all(one is two for one, two in zip(native(listed), listed, strict=True))
    assert list(cache.iterdir()) == []


@needs_compiler
@pytest.mark.parametrize("above", [False, True])
def test_a_folder_that_others_can_write_to_is_not_used(cache: Path, above: bool) -> None:
    cache.mkdir(mode=0o700)
    (cache.parent if above else cache).chmod(0o777)
    listed = functions()
    assert all(one is two for one, two in zip(native(listed), listed, strict=True))
    assert list(cache.iterdir()) == []


def test_without_a_compiler_the_functions_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "compiler", lambda: None)
    listed = functions()
    assert all(one is two for one, two in zip(native(listed), listed, strict=True))


@needs_compiler
def test_a_folder_that_cant_be_written_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "file" / "cache")
    listed = functions()
    assert all(one is two for one, two in zip(native(listed), listed, strict=True))


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
