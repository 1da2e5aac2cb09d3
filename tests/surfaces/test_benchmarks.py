"""The benchmarks of this folder's neighbour: they fail on wrong numbers, and know what they import."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import math
from pathlib import Path

import pytest

from tests.bench.__main__ import HERE
from tests.bench.judge import NOISE, Judge


def _code(judge: Judge) -> int:
    with pytest.raises(SystemExit) as raised:
        judge.end()
    assert isinstance(raised.value.code, int)
    return raised.value.code


def test_a_wrong_number_fails_and_a_missed_time_only_when_asked() -> None:
    for error, most in ((1e-9, 1e-12), (math.nan, math.inf)):
        judge = Judge()
        assert judge.right("verdict", True) == "right"
        assert judge.within("radius", error, most) == "WRONG"
        assert _code(judge) == 1
    for strict in (False, True):
        judge = Judge(strict=strict)
        assert judge.in_time("a", NOISE * 0.99, 1.0) == "near"
        assert _code(judge) == 0
        assert judge.in_time("b", math.nan, 1.0) == "missed"
        assert _code(judge) == strict


@pytest.mark.parametrize("path", sorted(HERE.rglob("*.py")), ids=lambda path: path.stem)
def test_what_a_benchmark_imports_of_the_program_is_there(path: Path) -> None:
    for one in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(one, ast.ImportFrom) and (one.module or "").split(".")[0] == "apc":
            names = [alias.name for alias in one.names]
            found = importlib.import_module(one.module or "")
            gone = [name for name in names if not hasattr(found, name) and not _module(one.module, name)]
            assert not gone, f"{one.module} has no {gone}"


def _module(package: str | None, name: str) -> bool:
    """Say whether a name is that of a module of a package."""
    return importlib.util.find_spec(f"{package}.{name}") is not None
