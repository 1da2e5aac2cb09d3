"""The benchmarks of this folder's neighbour: they fail on wrong numbers, and what they import is there."""

from __future__ import annotations

import importlib
import math

import pytest

from tests.bench.__main__ import HERE
from tests.bench.judge import NOISE, Judge


def test_a_wrong_number_fails_and_a_missed_time_only_when_asked() -> None:
    for error, most in ((1e-9, 1e-12), (math.nan, math.inf)):
        judge = Judge()
        assert judge.right("verdict", True) == "right"
        assert (judge.within("radius", error, most), judge.code) == ("WRONG", 1)
    for strict in (False, True):
        judge = Judge(strict=strict)
        assert (judge.in_time("a", NOISE * 0.99, 1.0), judge.code) == ("near", 0)
        assert (judge.in_time("b", math.nan, 1.0), judge.code) == ("missed", strict)


@pytest.mark.parametrize("name", sorted(path.stem for path in HERE.glob("*.py")))
def test_what_a_benchmark_imports_of_the_program_is_there(name: str) -> None:
    importlib.import_module(f"tests.bench.{name}")
