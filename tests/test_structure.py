"""`structure`: every unknown assigned once, in an order in which it can be computed."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import sympy
from hypothesis import given
from hypothesis import strategies as st

from apc.compiler.equations.matching import match_columns, strong_components
from apc.compiler.equations.structure import SortedKind, sort
from apc.compiler.equations.terms import Term, symbol
from tests.algebra import as_sympy
from tests.topologies import AVERAGE, MESH, ONE_MASS, clocked, library, ordered, replaced, told

GRAPHS = st.integers(1, 6).flatmap(
    lambda n: st.lists(st.lists(st.integers(0, n - 1), max_size=4, unique=True), min_size=n, max_size=n)
)
# A part with one algebraic equation system, the test's.
PART = """\
component: Part
connectors: {{flange: Flange}}
parameters: {{k: {{unit: N/m, default: 2}}}}
variables: {{p: {{unit: N}}, q: {{unit: N}}}}
equations:
  - {first}
  - {second}
  - flange.f = p
"""
TEXT = ONE_MASS + "hands:\n  hand: {type: Part, flange: device}\n"


def only(text: str) -> SortedKind:
    (kind,) = ordered(text).kinds
    return kind


def with_part(folder: Path, first: str, second: str) -> SortedKind:
    (kind,) = ordered(TEXT, library(folder, PART.format(first=first, second=second))).kinds
    return kind


def told_of(folder: Path, first: str, second: str) -> list[str]:
    lines = told(ordered, TEXT, library(folder, PART.format(first=first, second=second)))
    return [line.rpartition("/")[2] if "part0" in line else line for line in lines]


def assignments(kind: SortedKind, partition: int = 0) -> dict[str, Term]:
    return dict(kind.partitions[partition].assignments)


@pytest.mark.parametrize("text", [AVERAGE, MESH])
def test_the_states_are_what_is_differentiated(text: str) -> None:
    assert only(text).states == ("device.x", "device.v", "cube.x", "cube.v")


def test_the_motion_comes_out_as_written_by_hand() -> None:
    found = assignments(only(AVERAGE))
    v, f, m, b = (symbol(name) for name in ("cube.v", "cube.flange.f", "cube.mass", "cube.damping"))
    assert sympy.simplify(as_sympy(found["der(cube.v)"] - symbol("peers") / m * (f - b * v))) == 0
    assert found["der(cube.x)"] == v


def test_a_variable_of_a_component_outlives_its_aliases() -> None:
    aliases = dict(only(AVERAGE).aliases)
    assert aliases["contact.b.x"] == aliases["coordination.object.x"] == symbol("cube.x")
    assert aliases["contact.a.f"] == -symbol("device.flange.f")
    assert "cube.x" not in aliases


def test_samples_and_sends_are_in_states() -> None:
    kind = only(AVERAGE)
    assert {name: expression for name, _, expression in kind.samples}[
        "sample(contact.a.x, haptic)"
    ] == symbol("device.x")
    assert [send.expression for send in kind.sends] == [symbol("cube.x"), symbol("cube.v")]
    assert [send.unit for send in kind.sends] == ["m", "m/s"]


@pytest.mark.parametrize("text", [AVERAGE, MESH, replaced(AVERAGE, ("link: lan", "link: lan, delays: own"))])
def test_an_assignment_reads_only_what_was_assigned_before(text: str) -> None:
    for partition in only(text).partitions:
        later = {symbol(name) for name, _ in partition.assignments}
        for name, expression in partition.assignments:
            assert not expression.free_symbols & later, name
            later.discard(symbol(name))


def test_a_linear_loop_is_solved(tmp_path: Path) -> None:
    found = assignments(with_part(tmp_path, "p + q = k*flange.x", "p - 2*q = 0"))
    k, x = symbol("hand.k"), symbol("device.x")
    solved = {name: value for name, value in found.items() if name.startswith("hand.")}
    p = solved.get("hand.p")
    p = p if p is not None else -solved["hand.flange.f"]
    by_name = {symbol(name): value for name, value in found.items()}
    while p.free_symbols & by_name.keys():
        p = p.xreplace(by_name)
    assert sympy.simplify(as_sympy(p - k * x * sympy.Rational(2, 3))) == 0


def test_an_equation_too_many_here_and_one_too_few_there_names_both(tmp_path: Path) -> None:
    assert told_of(tmp_path, "p = 1*k*flange.x", "p = k*flange.x") == [
        "part0.yaml:7:5: E502 the continuous equations can't be solved: 3 equations hold only 2 unknowns "
        "(device.x, hand.p): "
        "`device.mass*der(device.v) = device.flange.f - device.damping*device.v` (device), "
        "`hand.p = 1*hand.k*hand.flange.x` (hand), `hand.p = hand.k*hand.flange.x` (hand); "
        "and 1 unknown (hand.q) has no equation."
    ]


@given(GRAPHS)
def test_components_are_those_of_mutual_reach_each_after_what_it_needs(needs: list[list[int]]) -> None:
    n = len(needs)
    reach = [[i == j or j in needs[i] for j in range(n)] for i in range(n)]
    for k, i, j in itertools.product(range(n), repeat=3):
        reach[i][j] = reach[i][j] or (reach[i][k] and reach[k][j])
    found = strong_components(needs)
    assert sorted(itertools.chain(*found)) == list(range(n))
    done: set[int] = set()
    for block in found:
        for i, j in itertools.product(block, range(n)):
            assert (reach[i][j] and reach[j][i]) == (j in block)
        done |= set(block)
        assert all(set(needs[i]) <= done for i in block)


@given(GRAPHS)
def test_as_many_columns_are_matched_as_can_be(incidence: list[list[int]]) -> None:
    n = len(incidence)
    match = match_columns(incidence, n)
    rows = [row for row in match if row is not None]
    assert len(rows) == len(set(rows))
    assert all(row is None or column in incidence[row] for column, row in enumerate(match))

    def most(row: int, free: frozenset[int]) -> int:
        if row == n:
            return 0
        return max(
            [most(row + 1, free)] + [1 + most(row + 1, free - {c}) for c in incidence[row] if c in free]
        )

    assert len(rows) == most(0, frozenset(range(n)))


def test_a_chain_of_thousands_needs_no_deep_stack() -> None:
    n = 5000
    assert strong_components([[i + 1] if i + 1 < n else [] for i in range(n)])[0] == [n - 1]
    # Row i may take column i or i + 1, and the last row must push every other one aside.
    incidence = [[i, i + 1] for i in range(n)] + [[0]]
    assert match_columns(incidence, n + 1).count(None) == 0


def test_sorting_the_same_system_twice_gives_the_same() -> None:
    system = clocked(AVERAGE)
    assert sort(system) == sort(system)
