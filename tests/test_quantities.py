"""What a sweep computes at a point: each quantity is what the function of its name gives."""

from __future__ import annotations

import pytest

from apc.compiler.errors import ApcError, Mistake, Place
from apc.sweeps.grid import build_grid, parse_axis
from apc.sweeps.quantities import QUANTITIES, Cells, faulty, find_quantity
from apc.sweeps.sweep import sweep
from tests.sweeping import CHEAP
from tests.topologies import compiled, told

MODEL = compiled(CHEAP)
GRID = build_grid([parse_axis(MODEL, "tick.period", "1,2 ms")])


@pytest.mark.parametrize("text", ["analyze", "critical:it.stiffness"])
def test_every_quantity_has_verdict_first_and_message_last(text: str) -> None:
    assert {name.partition(":")[0] for name in ("analyze", "critical:it.stiffness")} == set(QUANTITIES)
    quantity = find_quantity(MODEL, text)
    names = [column.name for column in quantity.columns]
    assert (names[0], names[-1]) == ("verdict", "message")
    assert [len(column) for column in quantity.cells(GRID, [0])] == [1] * len(names)


def test_a_row_does_not_depend_on_the_rows_before() -> None:
    quantity = find_quantity(MODEL, "analyze")
    first, slower = quantity.cells(GRID, [0]), quantity.cells(GRID, [1])
    assert not same(slower, first)
    assert same(quantity.cells(GRID, [0]), first)
    assert same(find_quantity(MODEL, "analyze").cells(GRID, [0]), first)


def same(left: Cells, right: Cells) -> bool:
    """Say whether cells are equal, what isn't a number too."""
    return repr([column.tolist() for column in left]) == repr([column.tolist() for column in right])


def test_the_critical_stiffness_of_a_wall_is_swept_over_its_delay() -> None:
    # m = 0.1 kg, b = 5 N·s/m, T = 1 ms: 3378.939 N/m at a delay of 1 ms, to the digits printed.
    found = sweep(MODEL, {"it.delay": "0,1 ms"}, of="critical:it.stiffness", jobs=1)
    names = ("verdict", "value [N/m]", "error [N/m]", "crossings", "proof", "message")
    assert found.headings[1:] == names
    values = found.column("value [N/m]")
    assert values[1] == pytest.approx(3378.939, abs=5e-4)
    assert values[0] > values[1]
    assert found.column("error [N/m]")[1] < 1e-6
    assert list(found.column("verdict")) == ["stable below the value"] * 2


def test_a_point_at_fault_has_the_code_as_its_verdict() -> None:
    columns = find_quantity(MODEL, "analyze").columns
    error = ApcError(Mistake("E803", Place("scene"), "x", "y", "z"))
    row = faulty(columns, error)
    assert (row[0], row[-1]) == ("error: E803", "x wants y, got z.")
    assert set(row[1:-1]) == {None}
    assert len(row) == len(columns)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("analyse", "E884 analyse is nothing a sweep computes (analyze, critical). Write: analyze"),
        ("", "E884 an empty name is nothing a sweep computes (analyze, critical)."),
        ("analyze:x", "E884 analyze wants no parameter, got x. Write: --of analyze"),
        (
            "critical",
            "E884 critical wants a parameter, got nothing. Write: --of critical:coordination.stiffness",
        ),
        ("critical:it.stifness", "E622 it.stifness is no parameter of wall. Write: it.stiffness"),
    ],
)
def test_a_quantity_that_is_none_is_told(text: str, message: str) -> None:
    assert told(find_quantity, MODEL, text) == [f"sweep: {message}"]
