"""Equations without a value are the user's to mend; anything else is ours."""

from __future__ import annotations

import math

import pytest

from apc.compiler.errors import ApcError
from apc.finite_equations import finite_equations


def test_an_equation_without_a_value_is_one_mistake() -> None:
    with pytest.raises(ApcError, match="E808"), finite_equations("scene"):
        math.sqrt(-1)
    with pytest.raises(ApcError, match="E808"), finite_equations("scene"):
        assert 1 / 0


def test_a_fault_of_our_own_passes_as_it_is() -> None:
    with pytest.raises(ValueError, match="unpack"), finite_equations("scene"):
        raise ValueError("too many values to unpack")
