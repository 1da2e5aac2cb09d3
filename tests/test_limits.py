"""Work that could grow without end is estimated first: refused with its number and the limit, or cheap."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from apc import answer as answering
from apc.analysis.analysis import lifted_groups
from apc.analysis.selfcheck import check_frame
from apc.answer import answer
from apc.api import analyze, simulate
from apc.compiler.errors import ApcError, Place
from apc.compiler.language import tables
from apc.compiler.language.recordings import read_time_table, read_trace
from apc.compiler.language.tables import read_table
from apc.compiler.language.units import parse_unit
from apc.compiler.pipeline import compile_topology
from apc.eigen import rigid
from apc.eigen.modes import dense
from apc.frame import discretize as discretizing
from apc.frame import scheduling
from apc.frame.discretize import discretize, moved_together
from apc.regions.axes import parse_axes
from apc.regions.region import region
from apc.vary import delays
from apc.vary.critical import critical
from apc.vary.sensitivity import varied
from tests.topologies import AVERAGE, compiled, replaced, told

NOWHERE = Place("scene.yaml", 7, 9)


def table(folder: Path, text: str) -> Path:
    path = folder / "users.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_is_refused_by_its_size_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = table(tmp_path, "device.mass [kg]\n0.1\n")
    with path.open("r+b") as file:
        file.truncate((64 << 20) + 1)
    monkeypatch.setattr(tables.csv, "reader", lambda _: pytest.fail("it is read"))
    assert told(read_table, path, NOWHERE) == [
        f"scene.yaml:7:9: E701 the table {path} is larger than 64 MiB, the most it may have."
    ]


def test_the_columns_of_a_table_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_heading", lambda *_: pytest.fail("a heading is read"))
    path = table(tmp_path, ",".join(f"a{i} [kg]" for i in range(1001)) + "\n")
    assert told(read_table, path, NOWHERE) == [
        f"{path}:1:1: E702 the table has 1001 columns, and 1000 are the most. "
        "Write: several groups, each with a table"
    ]


def test_a_heading_of_spaces_and_brackets_is_read_in_one_pass(tmp_path: Path) -> None:
    for heading in (" " * 100_000 + "[", "[" * 100_000, "a" + " " * 100_000 + "] [kg]"):
        (message,) = told(read_table, table(tmp_path, f"b [kg],{heading}\n"), NOWHERE)
        assert ":1:8: E702 a heading wants a name and its unit" in message


def test_a_heading_without_end_is_told_in_a_few_words(tmp_path: Path) -> None:
    """Of every reader of a table: what a heading says is shown cut."""
    long = "a" * 10_000
    newton = parse_unit("N", NOWHERE)
    path = table(tmp_path, f"time [s],{long}\n0,1\n1,2\n")
    shown = f"{'a' * 57}..."
    assert told(read_time_table, path, "force", newton, NOWHERE) == [
        f"{path}:1:10: E702 {shown} wants N, got 1."
    ]
    path.write_text(f"from,to,{long}\n1,2,1\n", encoding="utf-8")
    edges = ("delay: 8 ms}", "delay: 8 ms, graph: {edges: users.csv}}")
    (tmp_path / "scene.yaml").write_text(replaced(AVERAGE, edges), encoding="utf-8")
    (message,) = told(compile_topology, tmp_path / "scene.yaml")
    assert message.endswith(f"wants the headings from, to and weight or none, got from, to, {'a' * 47}...")


def test_a_row_is_at_the_line_it_begins_in(tmp_path: Path) -> None:
    """A cell in quotes may go over lines, to the end of the file if they are never closed."""
    path = table(tmp_path, 'a,b,c\n\n1,"2\n",3\n4,x,6\n7,8,"9\n\n')
    assert told(read_table, path, NOWHERE) == [f"{path}:5:3: E703 a cell wants a finite number, got x."]
    path.write_text('a,b\n1,2\n,"x\n\n', encoding="utf-8")
    assert told(read_table, path, NOWHERE) == [
        f"{path}:3:1: E703 a cell wants a finite number, got nothing.",
        f"{path}:3:2: E703 a cell wants a finite number, got x.",
    ]
    path.write_text('delay [ms],b\n"1\n",2\n1,2\nx,"\n\n', encoding="utf-8")
    (message,) = told(read_trace, path, NOWHERE)
    assert f"{path}:5:1: E703 a delay wants" in message


@pytest.mark.parametrize("cell", ["1_0", "١٠", "nan", "infinity", "0x10"])
def test_a_cell_is_a_plain_number(tmp_path: Path, cell: str) -> None:
    path = table(tmp_path, f"device.mass [kg]\n{cell}\n")
    assert told(read_table, path, NOWHERE) == [f"{path}:2:1: E703 a cell wants a finite number, got {cell}."]


def test_delays_of_forces_are_refused_by_what_they_keep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduling, "_build", lambda *_: pytest.fail("a schedule is built"))
    late = compiled(replaced(AVERAGE, ("clock: haptic, delay: 1 ms}", "clock: haptic, delay: 10 s}")))
    assert told(check_frame, late) == [
        "scene.yaml: E805 with contact.delay = 10 s each peer keeps 10,001 values that are computed "
        "and do not act yet; at most 1,000 can be analysed. Write: contact.delay: 0.998 s, or a slower clock"
    ]


@pytest.mark.parametrize("asked", ["10 s", "1285.71 ms", "1001 ms"])
def test_the_delay_that_is_proposed_for_a_force_is_taken(asked: str) -> None:
    def late(delay: str) -> list[str]:
        return told(
            check_frame, compiled(replaced(AVERAGE, ("haptic, delay: 1 ms}", f"haptic, delay: {delay}}}")))
        )

    [message] = late(asked)
    assert late(message.split("Write: contact.delay: ")[1].split(",")[0]) == []


def test_what_moves_together_has_a_limit_and_what_is_apart_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discretizing, "MOST_TOGETHER", 3)
    rates = np.array([[Fraction(-i - 1)] for i in range(4)])
    apart = np.where(np.eye(4, dtype=bool), rates, Fraction(0))
    step = discretize(apart, np.ones((4, 20)), [Fraction(1)])[0].matrix
    decay = np.exp(-np.arange(1.0, 5))
    assert step[:, :4] == pytest.approx(np.diag(decay), rel=1e-15)
    assert step[:, 4:] == pytest.approx(np.outer((1 - decay) / np.arange(1.0, 5), np.ones(20)), rel=1e-15)
    monkeypatch.setattr(discretizing, "FEW_TOGETHER", 3)
    slow = discretize(np.full((4, 4), Fraction(1)), np.ones((4, 1)), [Fraction(1)])[0].matrix
    assert slow[:, :4] == pytest.approx(np.eye(4) + np.full((4, 4), np.expm1(4) / 4), rel=1e-13)
    monkeypatch.setattr(discretizing, "_step", lambda *_: pytest.fail("an exponential is taken"))
    turning = np.array([[Fraction((i - j) * 10**12) for j in range(4)] for i in range(4)])
    with pytest.raises(
        ApcError,
        match=r"E812 4 states of one peer move together .* so fast .*, and 3 such states are the most",
    ):
        discretize(turning, np.ones((4, 1)), [Fraction(1)])


def test_the_states_of_a_peer_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discretizing, "moved_together", lambda _: pytest.fail("it is looked at"))
    with pytest.raises(ApcError, match=r"E812 one peer has 1,001 states, and 1,000 are the most"):
        discretize(np.zeros((1001, 1001)), np.ones((1001, 1)), [Fraction(1)])


def test_states_move_together_where_one_enters_the_rate_of_another() -> None:
    rates = np.zeros((6, 6))
    rates[0, 3] = rates[3, 5] = rates[1, 1] = rates[4, 2] = 1
    assert [one.tolist() for one in moved_together(rates)] == [[0, 3, 5], [1], [2, 4]]


def test_a_delay_is_searched_only_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delays, "_piece", lambda *_: pytest.fail("a piece is built"))
    (message,) = told(lambda: critical(compiled(AVERAGE), "lan.delay", upper="1e6 s"))
    assert message == (
        "critical value: E846 from 0 to 1e+06 (SI) events coincide at more than 10,000 values of lan.delay, "
        "the most that are searched. Write: a range up to 10"
    )


def test_a_range_is_refused_by_the_states_that_it_would_hold_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(delays, "_piece", lambda *_: pytest.fail("a piece is built"))
    average = compiled(replaced(AVERAGE, ("delay: 8 ms}", "delay: 2 s}")))
    expected = (
        "E804 a range of values is looked at in hundreds of matrices, here of 506 states; 300 are the most. "
        "Write: apc sweep, which analyses value by value"
    )
    for x in ("contact.stiffness=500 N/m:900 N/m", "lan.delay=0 s:2 s"):
        axes = parse_axes(average, x, "coordination.stiffness=0 N/m:1500 N/m")
        (message,) = told(lambda axes=axes: region(average, axes))
        assert message == f"region: {expected}"


@pytest.mark.parametrize("graph", ["ring", "star", "{edges: [[1, 2], [2, 3]]}"])
def test_peers_on_a_graph_have_a_limit_and_those_on_a_complete_one_none(graph: str) -> None:
    many = replaced(AVERAGE, ("count: 3", "count: 1000000000"))
    joined = replaced(many, ("network, delay: 8 ms}", f"network, delay: 8 ms, graph: {graph}}}"))
    (message,) = told(compiled, joined)
    assert message.endswith(
        "E208 a graph wants at most 1,000,000 peers where it isn't complete, got 1,000,000,000. "
        "Write: graph: complete"
    )
    assert told(compiled, many) == []


def leaf_and_levels(folder: Path, levels: int, width: int) -> str:
    """Write components, each of so many of the one before; return a topology that has the last."""
    folder.mkdir()
    leaf = (
        "component: L0\nconnectors: {flange: Flange}\nparameters: {k: {unit: N/m, default: 1}}\n"
        "equations: [flange.f = -k*flange.x]\n"
    )
    (folder / "l0.yaml").write_text(leaf, encoding="utf-8")
    for level in range(1, levels + 1):
        parts = ", ".join(f"p{i}: {{type: L{level - 1}}}" for i in range(width))
        text = (
            f"component: L{level}\nconnectors: {{flange: Flange}}\nparts: {{{parts}}}\n"
            "connect: {flange: p0.flange}\n"
        )
        (folder / f"l{level}.yaml").write_text(text, encoding="utf-8")
    return f"{AVERAGE}library: ./{folder.name}\nhands: {{h: {{type: L{levels}, flange: device}}}}\n"


@pytest.mark.parametrize(
    ("levels", "width", "message"),
    [
        (
            9,
            10,
            ":1:12: E216 L3 holds 1,111 parts, those inside parts included, and 1000 are the most",
        ),
        (11, 1, ":1:12: E216 the parts of L10 stand inside one another more than 10 deep"),
        (500, 1, "E212 components contain or extend one another more than 50 deep"),
    ],
)
def test_parts_in_parts_are_counted_where_they_are_defined(
    tmp_path: Path, levels: int, width: int, message: str
) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(leaf_and_levels(tmp_path / "parts", levels, width), encoding="utf-8")
    assert any(message in one for one in told(compile_topology, scene))


def test_what_is_too_large_is_judged_and_not_varied(monkeypatch: pytest.MonkeyPatch) -> None:
    model = compiled(AVERAGE)
    monkeypatch.setattr(answering, "MOST_TICKS", 7)
    monkeypatch.setattr(answering, "sensitivities", lambda *_, **__: pytest.fail("it is differentiated"))
    found = answer(model)
    assert found.analysis.stable
    told_of = "not looked for: 8 ticks in a frame take too long"
    assert found.sensitivities.note == f"what moves it most: {told_of}"


def test_what_is_too_much_to_differentiate_has_margins_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    model = compiled(AVERAGE)
    monkeypatch.setattr(answering, "MOST_PRODUCTS", 7)
    monkeypatch.setattr(answering, "sensitivities", lambda *_, **__: pytest.fail("it is differentiated"))
    found = answer(model)
    told_of = f"not looked for: {len(varied(model))} numbers of 4 states take too long"
    assert found.sensitivities.note == f"what moves it most: {told_of}"
    assert found.margins.rows


def test_what_stands_still_is_written_out_once_however_many_ways_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []
    standing = rigid._standing
    monkeypatch.setattr(rigid, "_standing", lambda *given: calls.append(1) or standing(*given))

    def counted(free: int) -> int:
        text = f"  free: {{mass: 1 kg, damping: 1 N*s/m, count: {free}}}\ncouplers:"
        system = dense(*lifted_groups(compiled(replaced(AVERAGE, ("couplers:", text)))))
        calls.clear()
        assert rigid.stays_rigid(system, [group.exact for group in system.sites])
        return len(calls)

    assert counted(2) == counted(9)


def test_a_force_that_has_no_value_from_some_instant_on_ends_the_run_there(tmp_path: Path) -> None:
    """Where halves of an interval are integrated until they agree, what has no value never would."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/own.yaml").write_text(
        "component: Own\nconnectors: {flange: Flange}\n"
        "parameters: {F: {unit: N, default: 1}, T0: {unit: s, default: 0.0105}}\n"
        "equations: [flange.f = F*sqrt(1 - time/T0)]\n",
        encoding="utf-8",
    )
    (tmp_path / "scene.yaml").write_text(
        "topology: scene\nlibrary: parts\nclocks: {haptic: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 1 kg, damping: 1 N*s/m}}\nhands: {hand: {type: Own, flange: device}}\n",
        encoding="utf-8",
    )
    ran = simulate(compile_topology(tmp_path / "scene.yaml"), duration="20 ms", jit=False)
    assert ran.time[-1] == pytest.approx(0.01)
    assert np.isfinite(ran.values).all()


def test_packets_in_a_frame_and_groups_have_a_limit_that_is_told_at_once() -> None:
    beside = ("haptic: 1 ms", "haptic: 1/2003 s"), ("network: 8 ms", "network: 1/1999 s")
    [message] = told(analyze, compiled(replaced(AVERAGE, *beside)))
    assert "E805 3,998 packets of one peer in a frame, and 1000 are the most that are analysed" in message
    groups = "".join(f"  g{i}: {{count: 1}}\n" for i in range(1001))
    [message] = told(compiled, replaced(AVERAGE, ("  user: {count: 3}\n", groups)))
    assert "E208 peers wants at most 1000 groups, got 1,001" in message


def test_different_peers_are_counted_before_a_number_is_kept_of_each() -> None:
    groups = "".join(f"  g{i}: {{count: 1000000000, set: {{device.mass: {i + 1} kg}}}}\n" for i in range(300))
    [message] = told(analyze, compiled(replaced(AVERAGE, ("  user: {count: 3}\n", groups))))
    assert "E804 300,000,000,000 peers, some of whom differ, and 20,000,000 are the most of these" in message
