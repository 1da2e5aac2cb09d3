"""`apc bench`: what is measured, what counts as better, what is printed."""

from __future__ import annotations

import itertools
import json
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

import apc
from apc.__main__ import run
from apc.benchmark.bench import (
    SAME,
    Bench,
    Measured,
    bench,
    bench_analysis,
    bench_simulation,
    pareto_front,
)
from apc.benchmark.scale import scale, with_count
from apc.benchmark.truth import MOST_STATES
from apc.compiler.errors import ApcError, Mistake, Place
from apc.present.bench import bench_picture, save_bench
from apc.simulation.settings import EXACT, Method
from tests.topologies import AVERAGE, SCENES, compiled, library, replaced


@pytest.fixture(scope="module")
def found() -> Bench:
    return bench(compiled(AVERAGE), rounds=1, duration=Fraction(1, 50))


def _one(name: str, seconds: float, error: float | None, spread: float = 0.0) -> Measured:
    return Measured(name, seconds, spread, 3, error, None, False)


def test_the_front_is_what_nothing_beats_in_both_ways() -> None:
    quick, right = _one("quick", 1.0, 1e-3), _one("right", 4.0, 1e-9)
    between, beaten = _one("between", 2.0, 1e-5), _one("beaten", 3.0, 1e-4)
    marked = pareto_front([right, beaten, between, quick])
    assert [(one.name, one.front) for one in marked] == [
        ("quick", True),
        ("between", True),
        ("beaten", False),
        ("right", True),
    ]


def test_differences_within_spread_or_rounding_are_none() -> None:
    assert all(one.front for one in pareto_front([_one("a", 1.0, 1e-9, 0.2), _one("b", 1.1, 1e-9, 0.1)]))
    rounding = [_one("a", 1.0, SAME / 2), _one("b", 2.0, 0.0)]
    assert [one.front for one in pareto_front(rounding)] == [True, False]


def test_without_errors_there_is_no_front() -> None:
    assert not any(one.front for one in pareto_front([_one("a", 1.0, None), _one("b", 2.0, None)]))


@pytest.mark.whole
def test_every_method_that_serves_the_scene_is_measured_beside_its_error(found: Bench) -> None:
    analysis, simulation = found.comparisons
    names = {"modes", "dense", "determinant", "krylov", "certified", "paper"}
    assert {one.name for one in analysis.measured} == names
    assert analysis.reference.startswith("the same equations in 512-bit balls")
    assert "spectral radius 0.957171389625094952208279125575" in analysis.reference
    for one in analysis.measured:
        assert one.error is not None
        assert one.bound is not None
        assert one.error <= one.bound
    assert analysis.chosen is not None
    assert analysis.chosen.name == "modes"
    errors = {one.name: one.error for one in simulation.measured}
    assert errors["exact"] is not None
    assert errors["exact"] < 1e-14
    assert simulation.reference.startswith("the exact transition")
    assert simulation.chosen is not None
    assert simulation.chosen.name == "exact"
    # Of order four and one: a step of a quarter and of a tenth.
    assert errors["rk4:1 ms"] / errors["rk4:0.25 ms"] > 100  # type: ignore[operator] # no error is None here
    assert 5 < errors["semi-implicit:1 ms"] / errors["semi-implicit:0.1 ms"] < 20  # type: ignore[operator] # likewise
    note = "nothing moves in this scene: device.x of its first peer starts 0.001 m elsewhere"
    assert simulation.notes == (note,)


PUSHED = """\
topology: pushed
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.25 kg, damping: 2 N*s/m}}
couplers:
  idle: {type: SampledSpringDamper, a: device, b: ground, stiffness: 9 N/m, clock: haptic}
"""
BETWEEN = """\
hands:
  on: {type: StepForce, flange: device, force: 3 N, start: 10.25 ms}
  off: {type: StepForce, flange: device, force: -3 N, start: 10.75 ms}
"""
ROTOR = """\
component: Rotor
about: A wheel that turns about its axis.
connectors: {flange: Flange}
parameters:
  inertia: {unit: kg*m^2, above: 0}
  drag: {unit: N*m*s, min: 0}
  radius: {unit: m, above: 0}
variables:
  angle: {unit: rad, start: 0 rad}
  rate: {unit: rad/s, start: 0 rad/s}
equations:
  - der(angle) = rate
  - inertia*der(rate) = radius*flange.f - drag*rate
  - flange.x = radius*angle
"""


@pytest.fixture
def played_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave all other methods of simulation out: they say nothing of how a scene is set in motion."""
    monkeypatch.setattr("apc.benchmark.bench._methods", lambda _: [Method(EXACT)])


@pytest.mark.usefixtures("played_exactly")
def test_a_push_between_two_ticks_is_no_rest() -> None:
    assert "nothing moves" in bench_simulation(compiled(PUSHED), Fraction(1, 50), rounds=1).notes[0]
    pushed = bench_simulation(compiled(PUSHED + BETWEEN), Fraction(1, 50), rounds=1)
    assert pushed.notes == ()
    assert pushed.chosen is not None
    assert pushed.chosen.error is not None
    assert pushed.chosen.error < 1e-12


@pytest.mark.usefixtures("played_exactly")
def test_what_rests_is_moved_by_its_own_scale_in_its_own_unit(tmp_path: Path) -> None:
    wheel = "{type: Rotor, inertia: 1 kg*m^2, drag: 1 N*m*s, radius: 5 mm}"
    turning = replaced(PUSHED, ("{mass: 0.25 kg, damping: 2 N*s/m}", wheel))
    found = bench_simulation(compiled(turning, library(tmp_path, ROTOR)), Fraction(1, 50), rounds=1)
    assert found.notes == (
        "nothing moves in this scene: device.angle of its first peer starts 0.001 rad elsewhere",
    )
    wide = replaced(PUSHED, ("{count: 1}", "{count: 2, set: {device.x: [20 mm, 30 mm]}}"))
    still = compiled(replaced(wide, ("9 N/m", "0 N/m")))
    [note] = bench_simulation(still, Fraction(1, 50), rounds=1).notes
    assert "device.x of its first peer starts 0.03 m" in note


def test_the_function_of_its_name_does_what_the_command_does() -> None:
    found = apc.bench(compiled(AVERAGE), set={"coordination.stiffness": "400 N/m"}, rounds=1)
    assert isinstance(found, apc.Bench)
    assert "spectral radius 0.95" in found.comparisons[0].reference
    assert found.topology == "three-users-average"


def test_a_method_that_cannot_serve_is_left_out_and_says_why() -> None:
    text = replaced(
        AVERAGE,
        ("haptic: 1 ms", "haptic: 1 ms\n  slow: 2 ms"),
        ("clock: haptic, delay: 1 ms, link", "clock: slow, delay: 1 ms, link"),
    )
    [(name, reason)] = bench_analysis(compiled(text), rounds=1).refused
    assert name == "paper"
    assert "one clock of forces (here are haptic and slow)" in reason


def test_a_matrix_of_all_peers_that_is_too_large_is_left_out_with_the_reason_of_who_refuses_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    many = compiled(replaced(AVERAGE, ("count: 3", "count: 1000000")))
    found = bench_analysis(many, rounds=1)
    reasons = dict(found.refused)
    assert reasons["krylov"] == "its matrix of 8,000,000 states is above the 2,500 tried here"
    for name in ("dense", "paper"):
        assert "system of 8,000,000 states; the matrix of one may have 1,000" in reasons[name]
    assert not any("Write:" in reason for reason in reasons.values())
    assert {"modes", "certified"} <= {one.name for one in found.measured}
    monkeypatch.setattr("apc.analysis.openloop.MOST_ROWS", 5)
    [(name, reason)] = bench_analysis(compiled(AVERAGE), rounds=1).refused
    assert name == "paper"
    assert reason.endswith("have more than 5 rows")


def test_a_proof_that_was_not_had_is_left_out_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apc.eigen.spectrum.MOST_PROVED", 3)
    found = bench_analysis(compiled(AVERAGE), rounds=1)
    assert "not proved, as it has" in dict(found.refused)["certified"]
    assert "certified" not in {one.name for one in found.measured}


def test_what_is_too_large_to_be_played_is_analysed_all_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("apc.simulation.simulation.NUMBER", 1e20)
    found = bench(compiled(AVERAGE), rounds=1)
    analysis, simulation = found.comparisons
    assert analysis.measured
    assert simulation.measured == ()
    text = str(found)
    assert "every method left out: 3 peers hold" in text
    assert "--signals" not in text
    save_bench(found, tmp_path / "bench.png")


def test_the_report_fits_a_terminal_and_names_the_choice(found: Bench) -> None:
    text = str(found)
    assert max(map(len, text.splitlines())) <= 80
    assert "analyze chooses modes, which is" in text
    assert "simulate chooses exact, which is" in text
    words = " ".join(text.split())
    assert "are of 1 run: processor time of an analysis, from the compiled scene to its verdict" in words
    assert "processor time of a run, without what prepares it" in words
    assert "error and bound are relative to the largest value of a state's unit" in words
    assert "faster by more than both spreads and no less right, or more right and no slower" in words


def test_a_spread_needs_several_runs_and_a_time_has_no_exponent(found: Bench) -> None:
    [analysis, _] = found.comparisons
    one = replace(analysis.measured[0], seconds=0.9997e-3, spread=0.9996e-3)
    lines = str(replace(found, comparisons=(replace(analysis, measured=(one,)),))).splitlines()
    assert next(line for line in lines if one.name in line).split()[1:4] == ["0.9997", "ms", "–"]
    many = replace(analysis, measured=(replace(one, rounds=3),))
    assert "0.9996 ms" in str(replace(found, comparisons=(many,)))
    json.dumps(found.to_dict(), allow_nan=False)


def test_the_picture_has_a_panel_a_task(found: Bench, tmp_path: Path) -> None:
    axes = bench_picture(found).axes
    assert [ax.get_title() for ax in axes] == ["apc analyze", "apc simulate"]
    assert "exact (default)" in [text.get_text() for text in axes[1].texts]
    save_bench(found, tmp_path / "bench.svg")
    assert (tmp_path / "bench.svg").stat().st_size > 10_000


def test_no_name_in_the_picture_stands_over_another_or_leaves_its_panel(found: Bench) -> None:
    near = [_one(f"semi-implicit:{k} ms", 1e-3 * (1 + k / 50), 1e-9 * (1 + k / 20)) for k in range(9)]
    for comparison in (*found.comparisons, replace(found.comparisons[1], measured=pareto_front(near))):
        figure = bench_picture(replace(found, comparisons=(comparison, *found.comparisons[1:])))
        figure.draw_without_rendering()
        ax = figure.axes[0]
        boxes = [text.get_window_extent() for text in ax.texts]
        assert len(boxes) >= len(comparison.measured)
        assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
        frame = ax.get_window_extent()
        assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)


def test_a_scaled_scene_is_the_text_with_another_count(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    grown, expected = with_count(path, 30), compiled(replaced(AVERAGE, ("count: 3", "count: 30")))
    assert (grown.peers, grown.parameters) == (30, expected.parameters)
    assert path.read_text(encoding="utf-8") == AVERAGE
    two = replaced(AVERAGE, ("user: {count: 3}", "one: {count: 1}\n  many: {count: 4}"))
    path.write_text(two, encoding="utf-8")
    assert [group.count for group in with_count(path, 7).groups] == [1, 7]


def test_more_peers_are_measured_each_in_a_process_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    found = scale(path, [3, 3000])
    assert [row.peers for row in found.rows] == [3, 3000]
    assert all(row.error is not None and row.error <= row.bound for row in found.rows)
    assert all(row.memory > 10 * 2**20 for row in found.rows)
    text = str(found)
    assert max(map(len, text.splitlines())) <= 80
    assert "3,000" in text
    assert "peers of group user\n" in text


def test_the_group_that_grows_is_named_and_a_number_is_measured_once(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    two = replaced(AVERAGE, ("user: {count: 3}", "one: {count: 1}\n  many: {count: 4}"))
    path.write_text(two, encoding="utf-8")
    found = scale(path, [5, 5])
    assert [(row.count, row.peers) for row in found.rows] == [(5, 6)]
    assert "peers of group many, beside 1 of other groups" in str(found)


def test_numbers_none_of_which_can_be_analysed_are_an_error(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    with pytest.raises(ApcError, match=r"E921 leaves nothing to measure: 1 peer of user: .* 2 peers"):
        scale(path, [1])


@pytest.mark.parametrize("counts", [[], [0], [3, -1]])
def test_numbers_of_peers_that_are_none_are_refused(tmp_path: Path, counts: list[int]) -> None:
    with pytest.raises(ApcError, match="E921") as raised:
        scale(tmp_path / "scene.yaml", counts)
    assert "[" not in str(raised.value)


def test_a_scene_of_a_table_has_no_count_to_grow() -> None:
    with pytest.raises(ApcError, match="no group of this topology has a count that could grow"):
        scale(SCENES / "users-table.yaml", [3])


def test_the_command_prints_one_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    assert run(["bench", str(path), "--scale", "3", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [row["peers"] for row in document["rows"]] == [3]
    assert run(["bench", str(path), "--hard"]) == 2


@pytest.mark.parametrize("words", ["many", "3,,4", "3.5", "nan", "1e400", "0", "1e10"])
def test_a_list_that_is_none_of_peers_is_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", str(SCENES / "template.yaml"), "--scale", words]) == 1
    assert capsys.readouterr().err.startswith("--scale: E921 the list wants numbers ")


def test_a_picture_that_cannot_be_drawn_is_refused_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("apc.benchmark.bench.bench", lambda *_: pytest.fail("it is measured"))
    words = ["bench", str(SCENES / "template.yaml"), "--plot"]
    assert run([*words, "bench.txt"]) == 1
    assert "E878 the suffix of --plot" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run([*words, "bench.png"]) == 1
    assert "E875 matplotlib is not installed" in capsys.readouterr().err


def test_a_picture_that_cannot_be_written_is_refused_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("apc.benchmark.bench.bench", lambda *_: pytest.fail("it is measured"))
    folder = tmp_path / "folder.png"
    folder.mkdir()
    for plot, message in (
        (str(tmp_path / "nowhere" / "bench.png"), "E601 can't be written: No such file or directory"),
        (str(folder), "E601 can't be written: it is a folder"),
        (".", "E601 can't be written: it is a folder"),
        ("", "E601 can't be written: it is a folder"),
    ):
        assert run(["bench", str(SCENES / "template.yaml"), "--plot", plot]) == 1
        assert message in capsys.readouterr().err


def test_a_picture_that_could_not_be_written_in_the_end_costs_no_figures(
    found: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise ApcError(Mistake("E601", Place("bench.png"), "can't be written: no space"))

    monkeypatch.setattr("apc.benchmark.bench.bench", lambda *_: found)
    monkeypatch.setattr("apc.present.bench.save_bench", full)
    assert run(["bench", str(SCENES / "template.yaml"), "--plot", str(tmp_path / "bench.png")]) == 1
    printed = capsys.readouterr()
    assert "E601 can't be written" in printed.err
    assert "analyze chooses modes" in printed.out


def test_a_bound_that_does_not_hold_ends_with_code_1_after_the_figures(
    found: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert found.faults == ()
    note = "WRONG: the bound of dense does not hold"
    first, *rest = found.comparisons
    broken = replace(found, comparisons=(replace(first, notes=(note,)), *rest))
    monkeypatch.setattr("apc.benchmark.bench.bench", lambda *_: broken)
    assert run(["bench", str(SCENES / "template.yaml")]) == 1
    printed = capsys.readouterr()
    assert "E922" in printed.err and note in printed.err
    assert "analyze chooses modes" in printed.out


def test_the_help_names_the_limits_of_the_reference(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--help"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert f"at most {MOST_STATES} states" in words
    assert "against the same equations in 512-bit balls" in words
