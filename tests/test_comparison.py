"""Schemes side by side: the numbers of their own commands, and the cost counted by hand."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import casadi
import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.comparison.choice import choose
from apc.comparison.comparison import FREQUENCIES, Comparison, compare
from apc.comparison.effort import effort
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from tests.topologies import AVERAGE, MESH, ONE_MASS, SCENES, compiled, replaced

LOSSLESS = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 0 %}"))
LOSSY = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 10 %}"))
SHAKING = replaced(MESH, ("stiffness: 500 N/m", "stiffness: 700 N/m"))
# Two couplers that hear others, over one link.
TWO_SPRINGS = replaced(
    AVERAGE,
    (
        "links:",
        "  leash: {type: FullMesh, object: device, stiffness: 20 N/m, clock: haptic, link: lan}\nlinks:",
    ),
)


@cache
def compared(*texts: str) -> Comparison:
    return compare([compiled(text) for text in texts])


def both() -> Comparison:
    return compared(AVERAGE, MESH)


# ---- the numbers ----


def test_each_number_is_that_of_its_own_command() -> None:
    for text in (AVERAGE, SHAKING, LOSSY):
        system = compiled(text)
        (found,) = compared(text).schemes
        assert found.analysis == apc.analyze(system)
        assert found.network == apc.judge_network(system)
        assert found.stiffness == apc.critical(system, "coordination.stiffness")
        if found.delay is not None:
            assert found.delay == apc.critical(system, "lan.delay")
        if found.loss is not None:
            assert found.loss == apc.critical(system, "lan.loss")
        if found.feel is not None:
            felt = apc.feel(system, FREQUENCIES)
            assert np.array_equal(found.feel.impedance, felt.impedance)
            assert found.feel.at == felt.at


def test_the_verdict_is_of_the_network_as_it_is_or_nominal_as_asked() -> None:
    system = compiled(LOSSY)
    assert compared(LOSSY).schemes[0].verdict == "stable in mean square"
    (nominal,) = compare([system], criterion="nominal").schemes
    assert (nominal.verdict, nominal.network) == ("stable up to a common translation", None)
    assert nominal.delay == apc.critical(system, "lan.delay", criterion="nominal")


def test_with_passive_hands_stable_means_that() -> None:
    system = compiled(AVERAGE)
    (found,) = compare([system], criterion="passive").schemes
    assert found.passive == apc.passive_hands(system)
    assert found.verdict == "unstable with some passive hands"
    assert found.stiffness == apc.critical(system, "coordination.stiffness", criterion="passive")


# ---- in time ----

BOUNCING = """\
topology: bouncing
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 1 N*s/m}}
couplers:
  wall: {type: VirtualWall, flange: device, position: 5 mm, stiffness: 500 N/m, clock: tick}
hands: {push: {type: ConstantForce, flange: device, force: 1 N}}
"""


def test_a_scheme_that_is_not_linear_is_judged_in_time_beside_its_linearization() -> None:
    """A wall is in no linearization about a start before it; in time 1 N rests 2 mm in 500 N/m."""
    system = compiled(f"{BOUNCING}experiment: {{duration: 3 s}}\n")
    found = compare([system, compiled(AVERAGE)])
    (one, linear) = found.schemes
    assert one.analysis.linearized
    assert linear.played is None
    assert one.played is not None
    run = apc.simulate(system)
    assert one.played.to_dict() == run.to_dict()
    assert one.played.summary.verdict == "settles"
    words = str(found).splitlines()
    place = words.index("     in time                            played")
    settled = f"settles at {run.summary.settled:.3g} s"
    assert words[place + 1 : place + 3] == [
        f"  1  {settled:<33}  3 s",
        "  2  as its verdict says: it is linear",
    ]
    column = found.to_dataframe()["in time"]
    assert column[0] == "settles"
    assert column.isna()[1]


def test_without_an_experiment_nothing_is_played_and_linear_schemes_need_none() -> None:
    (one,) = compare([compiled(BOUNCING)]).schemes
    assert one.played is None
    assert dict(one.missing)["played"] == (
        "apc simulate: the scene says no duration."  # what to write is for that command
    )
    assert "in time" not in str(both())


HELD = replaced(
    AVERAGE, ("links:", "hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 100 N/m}}\nlinks:")
)


def test_a_scheme_that_refuses_has_its_place_and_says_why(tmp_path: Path) -> None:
    files = []
    for name, text in (("free", AVERAGE), ("held", HELD)):
        (tmp_path / name).mkdir()
        files.append(tmp_path / name / "scene.yaml")
        files[-1].write_text(text, encoding="utf-8")
    out = tmp_path / "found.json"
    assert run(["compare", *map(str, files), "--hands", "passive", "--out", str(out)]) == 0
    one, other = json.loads(out.read_text(encoding="utf-8"))["schemes"]
    assert one["analysis"] is not None
    assert not one["refused"]
    assert (other["analysis"], other["stiffness"], other["feel"], other["stable"]) == (None,) * 4
    assert (other["verdict"], other["refused"]) == (
        "refused",
        "--hands passive: user has a hand already, arm.",
    )
    found = compare([compiled(AVERAGE), compiled(HELD)], criterion="passive", refused={1: "why not."})
    assert "  2  refused" in str(found)
    assert "why not." in str(found)
    assert found.schemes[1].effort == effort(compiled(HELD))
    assert found.to_dataframe()["missing"][1] == "why not."


def test_a_hand_feels_where_it_is_asked_to(capsys: pytest.CaptureFixture[str]) -> None:
    planar = (SCENES / "planar-users.yaml").read_text(encoding="utf-8")
    (one,) = compare([compiled(planar)], at="user[2].device.x[1]").schemes
    assert one.feel is not None
    assert one.feel.at == "user[2].device.x[1]"
    assert compare([compiled(planar)]).schemes[0].feel is None
    (proxied,) = compare([compiled((SCENES / "two-users-proxies.yaml").read_text(encoding="utf-8"))]).schemes
    assert proxied.feel is not None
    assert proxied.feel.at == "left[1].device"  # which the hands are joined to, not the proxy


# ---- what it costs ----


def operations(function: casadi.Function) -> int:
    """Count by CasADi's own list of instructions: what is neither input, output nor constant."""
    idle = {casadi.OP_INPUT, casadi.OP_OUTPUT, casadi.OP_CONST}
    return sum(function.instruction_id(k) not in idle for k in range(function.n_instructions()))


def test_a_tick_takes_its_arithmetic_and_one_operation_for_each_number_heard() -> None:
    """Position and velocity of two others: four numbers heard."""
    for text in (AVERAGE, MESH):
        system = compiled(text)
        found = effort(system)
        assert found.clock == "haptic"
        assert found.operations == operations(system.kinds[0].clocks[0].tick) + 2 * 2


def test_what_is_evaluated_pair_by_pair_counts_once_a_pair() -> None:
    system = compiled(
        replaced(MESH, ("FullMesh", "SaturatedMesh"), ("stiffness: 500", "limit: 9 N, stiffness: 500"))
    )
    (clock,) = system.kinds[0].clocks
    (heard,) = clock.receives
    assert effort(system).operations == operations(clock.tick) + 2 * (1 + operations(heard.edge))


@pytest.mark.parametrize(
    ("graph", "busiest", "arcs"),
    [
        ("complete", 4, 20),
        ("ring", 2, 10),
        ("star", 4, 8),
        ("{edges: [[1, 2], [2, 3], [2, 4], [4, 5]]}", 3, 8),
        ("{arcs: [[1, 2, 0.5], [2, 1, 1], [2, 3, 1], [3, 4, 1], [4, 5, 1], [5, 1, 1]]}", 2, 6),
    ],
)
def test_two_numbers_a_packet_go_to_everybody_who_hears_them(graph: str, busiest: int, arcs: int) -> None:
    """125 packets a second of a position and a velocity each."""
    text = replaced(AVERAGE, ("count: 3", "count: 5"), ("delay: 8 ms}", f"delay: 8 ms, graph: {graph}}}"))
    found = effort(compiled(text))
    assert found.sent == pytest.approx(2 * 125 * busiest, rel=1e-14)
    assert found.sent_by_all == pytest.approx(2 * 125 * arcs, rel=1e-14)


def test_a_million_peers_cost_no_million() -> None:
    found = effort(compiled(replaced(AVERAGE, ("count: 3", "count: 1000000000"))))
    assert found.sent == pytest.approx(2 * 125 * (1e9 - 1), rel=1e-14)


def test_who_has_no_coupler_neither_sends_nor_hears() -> None:
    text = replaced(
        AVERAGE,
        ("user: {count: 3}", "user: {count: 3}\n  guest: {count: 2}"),
        ("stiffness: 500 N/m,", "stiffness: 500 N/m, at: [user],"),
    )
    found = effort(compiled(text))
    assert (found.sent, found.sent_by_all) == pytest.approx((2 * 125 * 2, 2 * 125 * 6), rel=1e-14)


def test_a_scene_without_ticks_costs_nothing() -> None:
    found = effort(compiled(ONE_MASS))
    assert (found.operations, found.clock, found.sent, found.sent_by_all) == (0, "", 0, 0)


# ---- which stiffness, delay and loss ----


def chosen(system: CompiledSystem, over: Sequence[str] = ()) -> list[str]:
    return [one.name for one in choose(system, over).values()]


def test_the_stiffness_is_that_of_the_coupler_that_hears_others() -> None:
    assert chosen(compiled(LOSSLESS)) == ["coordination.stiffness", "lan.delay", "lan.loss"]


def test_what_follows_from_others_is_varied_by_what_it_follows_from() -> None:
    text = replaced(
        AVERAGE,
        ("peers:", "parameters: {kt: 250 N/m, late: 8 ms}\npeers:"),
        ("stiffness: 500 N/m", "stiffness: 2*kt"),
        ("delay: 8 ms}", "delay: late}"),
    )
    assert chosen(compiled(text)) == ["kt", "late", ""]


def test_of_several_none_is_taken_and_the_line_to_write_chooses() -> None:
    system = compiled(TWO_SPRINGS)
    with pytest.raises(ApcError) as caught:
        choose(system, ())
    assert str(caught.value).splitlines()[0] == (
        "scene.yaml: E941 has 2 numbers that could be compared as its stiffness: coordination.stiffness, "
        "leash.stiffness. Write: --over coordination.stiffness"
    )
    assert chosen(system, ["leash.stiffness"])[0] == "leash.stiffness"


def test_a_name_serves_the_scenes_that_have_it() -> None:
    found = compare([compiled(TWO_SPRINGS), compiled(MESH)], over=["leash.stiffness"])
    assert [one.stiffness.parameter for one in found.schemes if one.stiffness] == [
        "leash.stiffness",
        "coordination.stiffness",
    ]


@pytest.mark.parametrize(
    ("over", "message"),
    [
        ("leash.stifness", "--over: E622 leash.stifness is no parameter of three-users-average. "),
        (
            "cube.mass",
            "--over: E940 cube.mass of three-users-average wants a stiffness, a delay or a loss, got ",
        ),
    ],
)
def test_a_name_that_serves_no_scene_is_refused(over: str, message: str) -> None:
    with pytest.raises(ApcError) as caught:
        compare([compiled(AVERAGE), compiled(MESH)], over=[over])
    assert str(caught.value).startswith(message)


# ---- what is said ----


def test_a_cell_that_cant_be_had_says_why() -> None:
    found = compared(SHAKING, LOSSY, ONE_MASS)
    missing = [dict(one.missing) for one in found.schemes]
    assert [sorted(one) for one in missing] == [
        ["feel", "loss"],
        ["delay"],
        ["delay", "feel", "loss", "stiffness"],
    ]
    assert missing[0]["loss"] == "no packet can get lost; loss: 0 % written to lan lets its loss be varied"
    assert missing[1]["delay"].startswith("apc critical lan.delay: lan.delay can't be varied in mean square")
    text = " ".join(str(found).split())
    for one in missing:
        for why in one.values():
            assert " ".join(why.split()) in text


def test_the_line_that_a_missing_loss_asks_for_gives_it() -> None:
    assert compare([compiled(LOSSLESS)]).schemes[0].loss is not None


def test_no_dash_stands_without_its_footnote() -> None:
    found = str(compared(SHAKING, LOSSY, ONE_MASS))
    rows = [line.split() for line in found.splitlines()]
    dashed = [row for row in rows if len(row) > 1 and row[0].isdigit() and row[1] == "–"]
    assert len(dashed) == 7
    assert all(row[2].startswith("[") for row in dashed)


def test_schemes_that_differ_in_more_than_their_coupling_are_told_of() -> None:
    longer = replaced(AVERAGE, ("network: 8 ms", "network: 10 ms"), ("count: 3", "count: 4"))
    assert both().notes == ()
    assert compare([compiled(AVERAGE), compiled(longer), compiled(LOSSY)]).notes == (
        "they have different numbers of peers: 3, 4",
        "their frames differ, and with them what a spectral radius is of: 8 ms, 10 ms",
        "some are judged in mean square over the network as it is, some with every packet on time",
    )


def test_what_is_left_out_is_said_first_and_of_whom() -> None:
    found = compare([compiled(AVERAGE), compiled(LOSSY)])
    assert found.left_out == (
        "2: left out: packet loss (10 %) of lan; here every packet takes the nominal 8 ms",
    )
    assert str(found).splitlines()[1].startswith("  of a link that is, or becomes, unreliable: ")


def test_a_line_fits_a_terminal_whatever_names_are_used() -> None:
    name = "a-scene-with-a-very-long-name-that-fills-most-of-a-line-by-itself"
    text = replaced(AVERAGE, ("three-users-average", name))
    for old in ("coordination", "lan"):
        text = text.replace(old, f"{old}_of_{'long' * 10}")
    found = str(compare([compiled(text), compiled(SHAKING)]))
    assert max(len(line) for line in found.splitlines()) <= 80


# ---- the command ----


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    Path("average.yaml").write_text(AVERAGE, encoding="utf-8")
    Path("mesh.yaml").write_text(MESH, encoding="utf-8")
    return ["average.yaml", "mesh.yaml"]


def test_json_holds_each_part_as_the_json_of_its_command(
    scenes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["compare", *scenes, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["topology"] for one in told["schemes"]] == ["three-users-average", "three-users-mesh"]
    first = told["schemes"][0]
    for key, words in (
        ("stiffness", ["critical", "coordination.stiffness", scenes[0]]),
        ("delay", ["critical", "lan.delay", scenes[0]]),
    ):
        assert run([*words, "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == first[key]
    assert run(["analyze", scenes[0], "--json"]) == 0
    analysed = json.loads(capsys.readouterr().out)
    assert analysed["spectral_radius"] == first["analysis"]["spectral_radius"]
    assert run(["feel", scenes[0], "--frequencies", "1 Hz, 10 Hz", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["impedance"] == first["feel"]["impedance"]


def test_settings_and_hands_hold_for_all_files(scenes: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--set", "contact.stiffness=900 N/m", "--hands", "clamped", "--json"]
    assert run(["compare", *scenes, *words]) == 0
    told = json.loads(capsys.readouterr().out)["schemes"]
    for file, one in zip(scenes, told, strict=True):
        assert run(["analyze", file, *words]) == 0
        assert json.loads(capsys.readouterr().out)["spectral_radius"] == one["analysis"]["spectral_radius"]


def test_a_table_has_a_row_a_scheme_and_a_picture_is_the_same_each_time(
    scenes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["compare", *scenes, "--out", "out.csv"]) == 0
    with Path("out.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    system = compiled(MESH)
    assert float(rows[1]["stiffness [N/m]"]) == apc.critical(system, "coordination.stiffness").value
    assert rows[1]["delay parameter"] == "lan.delay"
    impedance = apc.feel(system, FREQUENCIES).impedance[1]
    assert complex(
        float(rows[1]["impedance at 10 Hz real [N*s/m]"]),
        float(rows[1]["impedance at 10 Hz imaginary [N*s/m]"]),
    ) == complex(impedance)
    pytest.importorskip("matplotlib")
    found = both()
    for name in ("one.svg", "two.svg"):
        assert run(["compare", *scenes, "--out", name]) == 0
    assert Path("one.svg").read_bytes() == Path("two.svg").read_bytes()
    texts = [text.get_text() for ax in found.plot().axes for text in ax.texts]
    assert texts[:2] == ["0.9572", "0.9926"]
    assert texts[2:4] == ["0.715", "4.207"]
    assert texts[4:6] == ["1096", "548.2"]
    assert texts[6] == "> 64"
    assert texts[8:10] == ["–", "–"]
    capsys.readouterr()


def test_a_bar_without_end_leaves_room_for_the_others() -> None:
    pytest.importorskip("matplotlib")
    waves = compiled((SCENES / "two-users-waves.yaml").read_text(encoding="utf-8"))
    figure = compare([compiled(MESH), waves]).plot()
    stiffness = figure.axes[2]
    mesh, endless = (bar.get_width() for bar in stiffness.patches)
    assert 3.9 < endless / mesh < 4.1
    assert [text.get_text() for text in stiffness.texts] == ["548.2", "> 5e+05"]


def test_one_file_at_fault_is_told_as_everywhere(
    scenes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("wrong.yaml").write_text(replaced(AVERAGE, ("500 N/m", "500")), encoding="utf-8")
    assert run(["compare", *scenes, "wrong.yaml"]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("wrong.yaml:13:66: E204 stiffness wants N/m, got 500 (no unit).")
    assert run(["compare", *scenes, "--out", "out.doc"]) == 1
    assert "E878" in capsys.readouterr().err
    assert run(["compare", *scenes, "--out", "mesh.yaml.csv", "--set", "nothing.there=1 N"]) == 1
    assert "E622 nothing.there is no parameter of three-users-average" in capsys.readouterr().err


def test_without_a_file_there_is_nothing_to_compare(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["compare"]) == 2
    assert "Missing argument 'FILE...'" in capsys.readouterr().err


def test_the_function_does_what_the_command_does(
    scenes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    found = apc.compare(scenes, set={"lan.delay": "16 ms"}, over=["contact.stiffness"])
    assert run(["compare", *scenes, "--set", "lan.delay=16 ms", "--over", "contact.stiffness"]) == 0
    assert capsys.readouterr().out.rstrip("\n") == str(found)
    pytest.importorskip("pandas")
    assert found.to_dataframe()["stiffness parameter"].tolist() == ["contact.stiffness"] * 2


def test_a_duration_that_nobody_waits_for_is_not_played(tmp_path: Path) -> None:
    """Only what is not linear is played: a finger that pushes against a wall."""
    text = (SCENES / "finger.yaml").read_text(encoding="utf-8").replace("duration: 2 s", "duration: 1e12 s")
    assert "1e12 s" in text
    (tmp_path / "finger.yaml").write_text(text, encoding="utf-8")
    found = apc.compare([tmp_path / "finger.yaml", SCENES / "limited-motor.yaml"])
    why = dict(found.schemes[0].missing)["played"]
    assert why.startswith("apc simulate: the duration wants at most 1e+06 s")
    with pytest.raises(ApcError, match="E915 the duration wants at most"):
        apc.simulate(tmp_path / "finger.yaml")
