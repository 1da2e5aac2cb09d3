"""Claims about `apc.simulation.simulation`: how much a simulation will be is told before it is played."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.compiler.errors import ApcError
from apc.simulation.settings import Settings
from apc.simulation.simulation import MOST_ROWS, check_length, prepare, size_note
from tests.topologies import AVERAGE, compiled

SCENE = compiled(AVERAGE)


def test_what_no_one_will_wait_for_is_refused_with_the_line_to_write() -> None:
    longest = Fraction(MOST_ROWS, 1000)  # a row a tick of 1 ms
    check_length(SCENE, longest)
    wanted = r'E915 the duration wants at most 1e\+06 s: .* Write: --duration "1e\+06 s"'
    with pytest.raises(ApcError, match=wanted):
        check_length(SCENE, longest + 1)
    check_length(SCENE, longest / 10, runs=10)
    with pytest.raises(ApcError, match=r"at most 100000 s in each of 10 runs: .*got 200000 s"):
        check_length(SCENE, longest / 5, runs=10)


def test_a_large_file_is_told_of_by_its_rows_and_columns() -> None:
    short = prepare(SCENE, Settings(Fraction(1), jit=False))
    assert size_note(short, decimal=True) == ""
    long = prepare(SCENE, Settings(Fraction(10_000), jit=False))
    assert size_note(long, decimal=False) == "will hold 10,000,000 rows of 25 columns, about 2 GB"
    assert size_note(long, decimal=True) == "will hold 10,000,000 rows of 25 columns, about 5 GB"
