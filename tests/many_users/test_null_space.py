"""Null spaces in rationals: those of SymPy, also where arithmetic modulo a prime is of no use."""

from __future__ import annotations

import random
import re
from fractions import Fraction

import numpy as np
import pytest
import sympy

import apc
from apc.spectrum import null_space as module
from apc.spectrum import translation
from apc.spectrum.null_space import PRIME, null_space
from tests.topologies import AVERAGE, compiled


def expected(matrix: np.ndarray) -> list[list[Fraction]]:
    """Return SymPy's null space, reduced: the columns in reversed order, as the pivots of `null_space`."""
    reversed_columns = sympy.Matrix(matrix[:, ::-1].tolist()).applyfunc(
        lambda x: sympy.Rational(x.numerator, x.denominator)
    )
    vectors = [
        [Fraction(int(x.p), int(x.q)) for x in vector][::-1] for vector in reversed_columns.nullspace()
    ]
    return sorted(vectors, key=lambda vector: next(i for i, entry in enumerate(vector) if entry))


@pytest.mark.parametrize("seed", range(20))
def test_the_vectors_are_those_of_sympy(seed: int) -> None:
    draw = random.Random(seed)
    rows, columns = draw.randint(1, 6), draw.randint(2, 8)
    entries = [
        Fraction(draw.randint(-9, 9) * draw.randint(0, 1), draw.randint(1, 50)) for _ in range(rows * columns)
    ]
    matrix = np.array(entries, dtype=object).reshape(rows, columns)
    assert null_space(matrix) == expected(matrix)


@pytest.mark.parametrize("entry", [Fraction(1, PRIME), Fraction(PRIME), Fraction(PRIME + 2, 2**90)])
def test_an_entry_without_a_use_modulo_the_prime_is_eliminated_exactly(
    entry: Fraction, monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = np.array(
        [[entry, Fraction(1), Fraction(0)], [Fraction(1), Fraction(0), Fraction(1)]], dtype=object
    )
    exact = []
    basis = module._null_space_basis
    monkeypatch.setattr(
        module, "_null_space_basis", lambda *arguments: exact.append(arguments) or basis(*arguments)
    )
    assert null_space(matrix) == [[Fraction(1), -entry, Fraction(-1)]] == expected(matrix)
    assert exact


def test_groups_of_one_peer_have_nothing_to_compare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peers of a group with equal parameters equal their representative."""
    compared = []
    monkeypatch.setattr(translation, "stays_rigid", lambda *arguments: compared.append(arguments) or True)
    groups = ", ".join(f"g{k}: {{count: 1, set: {{device.mass: {100 + k} g}}}}" for k in range(60))
    text = re.sub(r"^peers:\n(?:  .*\n)+", f"peers: {{{groups}}}\n", AVERAGE, flags=re.MULTILINE)
    result = apc.analyze(compiled(text))
    assert result.method == "determinant" and result.translations == 1
    assert not compared
