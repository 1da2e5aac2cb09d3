"""Work that could grow without end is estimated first: refused with its number and the limit, or cheap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis.model_size import model_size
from tests.topologies import AVERAGE, compiled, library, messages_of, replaced

DELAY = "delay: 8 ms}"
LONG, SHOWN = "a" * 10_000, f"{'a' * 57}..."


def tabled(
    folder: Path, text: str | None, change: tuple[str, str] = ("count: 3", "table: users.csv")
) -> list[str]:
    """Return what is told of the first topology with a change, beside a table of such a text."""
    if text is not None:
        (folder / "users.csv").write_text(text, encoding="utf-8")
    (folder / "topology.yaml").write_text(replaced(AVERAGE, change), encoding="utf-8")
    return [line.replace(f"{folder}/", "") for line in messages_of(apc.compile, folder / "topology.yaml")]


def test_a_table_is_refused_by_its_size_before_it_is_read(tmp_path: Path) -> None:
    with (tmp_path / "users.csv").open("wb") as file:
        file.truncate((64 << 20) + 1)
    assert tabled(tmp_path, None) == [
        "topology.yaml:7:17: E701 the table users.csv is larger than the limit of 64 MiB."
    ]


NUMBER = "E703 cell: expected a finite number, got"
TABLES = [
    (",".join(f"a{i} [kg]" for i in range(1001)), "1:1: E702 table: expected at most 1000 columns, got 1001. "
     "Use several groups, each with a table."),
    (f"device.mass [kg],{' ' * 100_000}[\n1,1\n", "1:18: E702 heading: expected a name and its unit"),
    (f"device.mass [kg],{'[' * 100_000}\n1,1\n", "1:18: E702 heading: expected a name and its unit"),
    ('device.mass [kg],cube.mass [kg],device.x [m]\n\n1,"2\n",3\n4,x,6\n7,8,"9\n\n', f"5:3: {NUMBER} x."),
    ('device.mass [kg],cube.mass [kg]\n1,2\n,1\n', f"3:1: {NUMBER} nothing."),
    *((f"device.mass [kg]\n{cell}\n", f"2:1: {NUMBER} {cell}.")
      for cell in ("1_0", "١٠", "nan", "infinity", "0x10")),
]  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), TABLES, ids=[expected[:30] for _, expected in TABLES])
def test_a_table_is_read_in_one_pass_and_told_of_at_the_line_a_row_begins_in(
    text: str, expected: str, tmp_path: Path
) -> None:
    [line] = tabled(tmp_path, text)
    assert line.startswith(f"users.csv:{expected}")


@pytest.mark.parametrize("key", ["edges", "arcs"])
def test_peers_in_a_file_of_pairs_have_numbers_or_names(tmp_path: Path, key: str) -> None:
    """The graph is that of the same names in YAML."""
    rows = ['"user[1]",2,1', "user[2], user[3] ,0.5", "3,user[1],2"]
    (tmp_path / "net.csv").write_text("\n".join(["from,to,weight", *rows, ""]), encoding="utf-8")
    pairs = '[["user[1]", 2, 1], ["user[2]", "user[3]", 0.5], [3, "user[1]", 2]]'
    graphs = []
    for written in ("net.csv", pairs):
        changed = replaced(AVERAGE, (DELAY, f"delay: 8 ms, graph: {{{key}: {written}}}}}"))
        (tmp_path / "topology.yaml").write_text(changed, encoding="utf-8")
        graphs.append(apc.compile(tmp_path / "topology.yaml").links[0].graph)
    assert graphs[0].arcs.tolist() == graphs[1].arcs.tolist()
    assert graphs[0].weights.tolist() == graphs[1].weights.tolist()


@pytest.mark.parametrize("row", ["user[4],2,1", "1,user,1", "1,2,user[1]"])
def test_other_names_in_a_file_of_pairs_are_refused(tmp_path: Path, row: str) -> None:
    edges = (DELAY, "delay: 8 ms, graph: {edges: users.csv}}")
    [line] = tabled(tmp_path, f"from,to,weight\n{row}\n", edges)
    column = 1 + max(row.find("user"), 0)
    assert line.startswith(
        f"users.csv:2:{column}: E703 cell: expected a finite number, or the name of a peer"
    )
    assert "such as user[1]" in line


def test_a_heading_without_end_is_told_in_a_few_words(tmp_path: Path) -> None:
    edges = (DELAY, "delay: 8 ms, graph: {edges: users.csv}}")
    [line] = tabled(tmp_path, f"from,to,{LONG}\n1,2,1\n", edges)
    assert line.endswith(
        f"expected the headings from, to and, optionally, weight, got from, to, {'a' * 47}..."
    )
    push = "hands: {push: {type: TableForce, flange: device, force: users.csv}}\nlinks:"
    assert tabled(tmp_path, f"time [s],{LONG}\n0,1\n1,2\n", ("links:", push)) == [
        f"users.csv:1:10: E702 {SHOWN}: expected N, got 1."
    ]


@pytest.mark.whole
@pytest.mark.parametrize("requested", ["10 s", "1285.71 ms", "1001 ms"])
def test_the_delay_that_is_proposed_for_a_force_is_taken(requested: str, tmp_path: Path) -> None:
    def late(delay: str) -> list[str]:
        return tabled(tmp_path, "", ("haptic, delay: 1 ms}", f"haptic, delay: {delay}}}"))

    [message] = late(requested)
    assert "computed values that are not yet applied; the limit is 1,000" in message
    assert late(message.split("Try: delay: ")[1].split(",")[0]) == []
    assert not model_size(apc.compile(tmp_path / "topology.yaml")).refused


def wrong(*pairs: tuple[str, str]) -> str:
    """Return the only thing that is told when the first topology with changes is compiled and analysed."""
    [line] = messages_of(lambda: apc.analyze(compiled(replaced(AVERAGE, *pairs))))
    return line


GROUPS = "".join(f"  g{i}: {{count: 1}}\n" for i in range(1001))
UNLIKE = "".join(f"  g{i}: {{count: 1000000000, set: {{device.mass: {i + 1} kg}}}}\n" for i in range(300))
MANY = ("count: 3", "count: 1000000000")
ON_A_GRAPH = "E208 graph: expected at most 1,000,000 peers unless complete, got 1,000,000,000."
MUCH: list[tuple[tuple[tuple[str, str], ...], str]] = [
    ((("haptic: 1 ms", "haptic: 1/2003 s"), ("network: 8 ms", "network: 1/1999 s")),
     "E805 3,998 packets of one peer in a frame; the limit is 1000"),
    ((("  user: {count: 3}\n", GROUPS),), "E208 peers: expected at most 1000 groups, got 1,001"),
    ((("  user: {count: 3}\n", UNLIKE),),
     "E804 300,000,000,000 peers, some of which differ; the limit for different peers is 20,000,000"),
    *(((MANY, (DELAY, f"delay: 8 ms, graph: {graph}}}")), ON_A_GRAPH)
      for graph in ("ring", "star", "{edges: [[1, 2], [2, 3]]}")),
    ((("  cube:", "  more: {mass: 1 kg, count: 499}\n  cube:"),), "E804 1 different peers form one system of "
     "1,002 states; the limit is 1,000"),
]  # fmt: skip


@pytest.mark.few(2)
@pytest.mark.parametrize(("pairs", "expected"), MUCH, ids=[expected for _, expected in MUCH])
def test_what_is_too_much_is_told_at_once(pairs: tuple[tuple[str, str], ...], expected: str) -> None:
    assert expected in wrong(*pairs)


def test_peers_on_a_complete_graph_have_no_limit() -> None:
    assert apc.analyze(compiled(replaced(AVERAGE, MANY))).stable


@pytest.mark.whole
def test_delays_are_searched_and_varied_only_so_far() -> None:
    assert messages_of(lambda: apc.critical(compiled(AVERAGE), "lan.delay", upper="1e6 s")) == [
        "critical value: E846 from 0 s to 1e+06 s events coincide at more than 1,000 values of lan.delay, "
        "the limit of the search. Use a range up to 1 s."
    ]
    late = compiled(replaced(AVERAGE, (DELAY, "delay: 2 s}")))
    for x in ("contact.stiffness=500 N/m:900 N/m", "lan.delay=0 s:2 s"):
        [message] = messages_of(lambda x=x: apc.region(late, x=x, y="coordination.stiffness=0 N/m:1500 N/m"))
        assert "hundreds of matrices, here of 506 states; the limit is 300" in message


@pytest.mark.whole
def test_what_takes_too_long_is_judged_and_not_varied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("topology.yaml").write_text(
        replaced(AVERAGE, ("network: 8 ms", "network: 504 ms")), encoding="utf-8"
    )
    assert run(["analyze"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "sensitivities not computed: 504 ticks in a frame take too long" in printed


# ---- parts in parts ----

LEAF = """\
component: L0
connectors: {flange: Flange}
parameters: {k: {unit: N/m, default: 1}}
equations: [flange.f = -k*flange.x]
"""


@pytest.mark.parametrize(
    ("levels", "width", "message"),
    [
        (9, 10, ":1:12: E216 L3: expected at most 1000 parts, inner parts included, got 1,111"),
        (24, 2, "expected at most 1000 parts, inner parts included"),
        (11, 1, ":1:12: E216 the parts of L10 are nested more than 10 levels deep"),
        (500, 1, "E212 components contain or extend one another more than 50 deep"),
    ],
)
def test_parts_in_parts_are_counted_where_they_are_defined(
    levels: int, width: int, message: str, tmp_path: Path
) -> None:
    texts = [LEAF]
    for level in range(1, levels + 1):
        parts = ", ".join(f"p{i}: {{type: L{level - 1}}}" for i in range(width))
        head = f"component: L{level}\nconnectors: {{flange: Flange}}\nparts: {{{parts}}}\n"
        texts.append(f"{head}connect: {{flange: p0.flange}}\n")
    text = f"{AVERAGE}hands: {{h: {{type: L{levels}, flange: device}}}}\n"
    assert any(message in line for line in messages_of(compiled, text, library(tmp_path, *texts)))


def test_an_array_of_composites_or_inside_one_has_a_limit(tmp_path: Path) -> None:
    pair = "component: Pair\nparts:\n  a: {type: Mass, mass: 1 kg}\n  b: {type: Mass, mass: 1 kg}\n"
    many = pair.replace("Pair", "Many").replace("Mass, mass", "Mass, count: 501, mass")
    own = library(tmp_path, pair, many)
    [line] = messages_of(compiled, f"{AVERAGE}hands: {{n: {{type: Pair, count: 500}}}}\n", own)
    assert "E216 expected at most 1000 parts at a peer" in line
    lines = messages_of(compiled, f"{AVERAGE}hands: {{n: {{type: Many}}}}\n", own)
    assert "E208 count of a: expected a whole number from 1 to 500, got 501." in lines[0]


@pytest.mark.whole
def test_a_chain_of_masses_is_sorted_in_seconds_and_a_rigid_one_is_one_mass() -> None:
    """Springs between 160 masses; 60 masses joined rigidly by gears, which move as one."""

    def row(count: int, peer_type: str) -> str:
        masses = f"masses: {{m: {{count: {count}, mass: 0.5 kg, damping: 0.1 N*s/m}}}}\n"
        pairs = f"count: {count - 1}, a: 'm[1:{count - 1}]', b: 'm[2:{count}]'"
        return (
            f"topology: row\npeers: {{u: {{count: 1}}}}\n{masses}couplers: "
            f"{{c: {{{pairs}, type: {peer_type}}}}}\n"
        )

    assert len(compiled(row(160, "SpringDamper, stiffness: 9 N/m")).peer_types[0].states) == 320
    rigid = compiled(row(60, "Gear, ratio: 1"))
    assert len(rigid.peer_types[0].states) == 2
    assert apc.analyze(rigid).spectral_radius == pytest.approx(np.exp(-0.1 / 0.5), rel=1e-12)


def test_a_force_that_has_no_value_from_some_instant_on_ends_the_run_there(tmp_path: Path) -> None:
    """Where halves of an interval are integrated until they agree, what has no value never would."""
    own = "component: Own\nconnectors: {flange: Flange}\nparameters: {F: {unit: N, default: 1}, T0: {unit: s,"
    own += " default: 0.0105}}\nequations: [flange.f = F*sqrt(1 - time/T0)]\n"
    text = "topology: topology\nclocks: {haptic: 1 ms}\npeers: {user: {count: 1}}\n"
    text += "masses: {device: {mass: 1 kg, damping: 1 N*s/m}}\nhands: {hand: {type: Own, flange: device}}\n"
    ran = apc.simulate(compiled(text, library(tmp_path, own)), duration="20 ms", jit=False)
    assert ran.time[-1] == pytest.approx(0.01)
    assert np.isfinite(ran.values).all()
