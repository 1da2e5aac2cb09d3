"""Claims about `apc.frame.parameters`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.compiler.compiled import CompiledSystem
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.frame.parameters import free_rows, resolve
from tests.sites import NAMES, columned, derived, paper


def _column(system: CompiledSystem, name: str) -> list[float]:
    """Return a parameter's value of each peer of the first group."""
    numbers = resolve(system)
    return [float(value) for value in numbers.parameters[0][numbers.rows[0], NAMES.index(name)]]


def test_without_overrides_the_numbers_are_the_compiled_ones() -> None:
    numbers = resolve(paper(kt=123.0))
    assert numbers.parameters[0][0, NAMES.index("coordination.stiffness")] == 123.0
    assert numbers.timings["lan.delay"] == Fraction(1, 125)


def test_a_column_is_a_value_a_peer_and_equal_peers_share_a_row() -> None:
    system = columned(paper(), device__mass=[0.1, 0.2, 0.1], contact__damping=[0.0, 1.0, -0.0])
    assert _column(system, "device.mass") == [0.1, 0.2, 0.1]
    assert resolve(system).parameters[0].shape == (2, len(NAMES))
    assert resolve(system).rows[0].tolist() == [0, 1, 0]


def test_what_depends_on_a_column_is_worked_out_peer_by_peer() -> None:
    text = (
        "if device.mass > 0.15 and peers == 3 then kt*max(device.mass, 0.3) else -(-sqrt(kt)^2)/(peers - 1)"
    )
    system = columned(derived(paper(), coordination__stiffness=text), device__mass=[0.1, 0.2, 0.4])
    assert _column(system, "coordination.stiffness") == pytest.approx([250.0, 150.0, 200.0], rel=1e-15)
    doubled = apply(system, [Override(Free("kt"), Fraction(1000))])
    assert _column(doubled, "coordination.stiffness") == pytest.approx([500.0, 300.0, 400.0], rel=1e-15)


def test_what_no_column_reaches_keeps_its_very_number() -> None:
    system = columned(
        derived(paper(kt=0.1 + 0.2), coordination__stiffness="kt"), device__mass=[0.1, 0.2, 0.4]
    )
    assert _column(system, "coordination.stiffness") == [0.1 + 0.2] * 3


def test_a_hundred_thousand_different_peers_are_read_in_a_time_that_grows_with_their_number() -> None:
    masses = 0.1 + 1e-6 * np.arange(100_000)
    system = columned(
        derived(paper(peers=100_000), coordination__stiffness="kt*cube.mass/device.mass"), device__mass=masses
    )
    numbers = resolve(system)
    assert numbers.parameters[0].shape == (100_000, len(NAMES))
    assert numbers.parameters[0][7, NAMES.index("coordination.stiffness")] == 500.0 * 0.2 / masses[7]


def test_free_values_give_the_rows_that_overrides_give_what_depends_on_them_included() -> None:
    system = derived(paper(), coordination__stiffness="kt/(peers - 1)")
    values = np.array([100.0, 300.0, 700.0])
    rows = free_rows(system, system.groups[0], 0, {Free("kt"): values})
    for value, row in zip(values, rows, strict=True):
        changed = apply(system, [Override(Free("kt"), Fraction(value))])
        assert row.tolist() == resolve(changed).parameters[0][0].tolist()


def test_a_complex_step_carries_the_derivative_through_an_expression() -> None:
    system = derived(paper(), coordination__stiffness="abs(-kt)^1.5 + max(kt, 2*wait)")
    rows = free_rows(system, system.groups[0], 0, {Free("kt"): np.array([400.0 + 1e-20j])})
    # d/dk (k^1.5 + k) = 1.5 k^0.5 + 1
    assert rows[0, NAMES.index("coordination.stiffness")].imag / 1e-20 == pytest.approx(31.0, rel=1e-15)


def test_values_that_reach_no_peer_of_the_group_leave_one_row() -> None:
    system = paper()
    rows = free_rows(system, system.groups[0], 0, {Free("contact.stiffness", "nobody"): np.array([1.0, 2.0])})
    assert rows.tolist() == resolve(system).parameters[0].tolist()
