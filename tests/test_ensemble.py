"""Claims about `apc.simulation.ensemble`."""

from __future__ import annotations

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.__main__ import run
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.moments.network import judge_network
from apc.simulation import ensemble, summary
from apc.simulation.blocks import pushes
from apc.simulation.ensemble import Ensemble, Run, play_many, share_interval
from apc.simulation.native import compiler
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.simulation.trajectory import play
from tests.pairs import FORCES, scene
from tests.test_selection import LINK, ODD, apart
from tests.topologies import AVERAGE, SCENES, compiled, replaced

SHAKY = apart(AVERAGE, "loss: {p: 10 %, r: 20 %}, jitter: 8 ms")


def many(*settled: float | None) -> Ensemble:
    runs = [
        Run(number, "moves on" if at is None else "settles", at, 2.0 * number, 0.001)
        for number, at in enumerate(settled)
    ]
    return Ensemble("scene", Fraction(3), 7, tuple(runs))


def test_a_run_does_not_depend_on_how_many_there_are_or_who_plays_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ensemble, "PART", part := 5)
    system = compiled(SHAKY)
    few = play_many(system, Settings(Fraction(1, 2), seed=3, jit=False), runs=4)
    assert play_many(system, Settings(Fraction(1, 2), seed=3, jit=False), runs=2).runs == few.runs[:2]
    shared = play_many(system, Settings(Fraction(1, 2), seed=3, jit=False), runs=part + 4, jobs=2)
    assert [one.number for one in shared.runs] == list(range(part + 4))
    assert shared.runs[:4] == few.runs
    assert len({one.settled for one in shared.runs}) > 3, "they are different runs"


def test_run_0_is_the_run_that_is_played_alone() -> None:
    system = compiled(SHAKY)
    [alone] = play_many(system, Settings(Fraction(1, 2), seed=3, jit=False), runs=1).runs
    one, _ = play(prepare(system, Settings(Fraction(1, 2), seed=3, jit=False)), [])
    assert one.largest_force is not None
    assert (alone.verdict, alone.settled, alone.largest_force) == (
        one.verdict,
        one.settled,
        one.largest_force[1],
    )


def rows_of_runs(system: CompiledSystem, runs: int, first: int) -> NDArray[np.float64]:
    """Return the rows of some runs that machine code plays side by side (rows, width, runs)."""
    simulation = prepare(system, Settings(Fraction(1, 10), seed=3), runs=runs)
    player = simulation.player(runs)
    player.begin(first)
    played = player.play(0, simulation.length, pushes(simulation, 0))
    return played.rows.reshape(-1, simulation.population.width, runs).copy()


SIDE = 13  # more runs than are added up at once, and no multiple of it
ALONE = (2, 9, 14)


@pytest.mark.few(3)
@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize(("peers", "more"), [*((3, more) for more in ("", *ODD)), (7, ""), (7, ODD[-1])])
def test_runs_side_by_side_are_to_the_bit_those_played_alone(peers: int, more: str) -> None:
    starts = ", ".join(f"{place} mm" for place in range(peers))
    link = f"{LINK[:-1]}, {more}}}" if more else LINK
    many = f"{{set: {{cube.x: [{starts}], device.x: [{starts}]}}}}"
    system = compiled(replaced(AVERAGE, ("{count: 3}", many), (LINK, link)))
    together = rows_of_runs(system, SIDE, 2)
    for number in ALONE:
        np.testing.assert_array_equal(together[:, :, number - 2], rows_of_runs(system, 1, number)[:, :, 0])


@pytest.mark.few(3)
@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize("name", FORCES)
@pytest.mark.parametrize("link", ["delay: 8 ms", "delay: 8 ms, jitter: 9 ms, loss: 20 %, on_loss: zero"])
def test_so_are_those_that_look_at_each_pair(tmp_path: Path, name: str, link: str) -> None:
    system = scene(tmp_path, FORCES[name][0], link)
    together = rows_of_runs(system, SIDE, 2)
    for number in ALONE:
        np.testing.assert_array_equal(together[:, :, number - 2], rows_of_runs(system, 1, number)[:, :, 0])


@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
def test_machine_code_judges_the_runs_as_the_virtual_machine_does() -> None:
    system = compiled(SHAKY)
    many, alone = (
        play_many(system, Settings(Fraction(1, 2), seed=3, jit=jit), runs=20).runs for jit in (True, False)
    )
    for one, other in zip(many, alone, strict=True):
        assert (one.number, one.verdict, one.settled) == (other.number, other.verdict, other.settled)
        assert one.largest_force == pytest.approx(other.largest_force, rel=1e-12)
        assert one.copies_apart == pytest.approx(other.copies_apart, abs=1e-15)


def test_runs_of_a_scene_without_positions_are_judged_as_one_is(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (ensemble, summary):
        monkeypatch.setattr(module, "is_position", lambda _: False)
    system, how = compiled(SHAKY), Settings(Fraction(1, 10), seed=3)
    found = play_many(system, how, runs=3).runs
    alone, _ = play(prepare(system, how), [])
    assert [one.verdict for one in found] == [alone.verdict] * 3
    assert [one.copies_apart for one in found] == [None] * 3


def test_runs_that_diverge_are_told_from_those_beside_them() -> None:
    """So stiff a coupling grows until the numbers end, however the packets come."""
    stiff = replaced(SHAKY, ("stiffness: 500 N/m", "stiffness: 500 kN/m"))
    found = play_many(compiled(stiff), Settings(Fraction(20), seed=3), runs=3).runs
    assert [one.verdict for one in found] == ["diverges"] * 3


def test_the_seed_is_the_experiments_if_none_is_given() -> None:
    system = compiled(SHAKY + "experiment: {seed: 5}\n")
    assert play_many(system, Settings(Fraction(1, 10), jit=False), runs=1).seed == 5


def test_statistics_are_those_of_the_runs_that_have_the_number() -> None:
    found = many(0.1, 0.4, None, 0.2)
    one = found.statistics("settled")
    assert one is not None
    assert (one.count, one.low, one.high) == (3, 0.1, 0.4)
    assert one.mean == pytest.approx(0.7 / 3)
    assert one.standard_error == pytest.approx(math.sqrt((0.01 + 0.16 + 0.04 - 0.49 / 3) / 2 / 3))
    assert one.quantiles[1] == pytest.approx(0.2)
    assert many(None).statistics("settled") is None
    assert found.verdicts == (("settles", 3), ("moves on", 1))


def test_a_shares_interval_is_wilsons() -> None:
    """Newcombe (1998, Statist. Med. 17), table I: 81 of 263, 0 of 20 and 1 of 29."""
    assert share_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert share_interval(0, 20) == pytest.approx((0, 0.1611), abs=5e-5)
    assert share_interval(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


PUSHES = "hands:\n  hand: {type: SineForce, flange: device, force: 1 N, frequency: 3 Hz}\n"


def beside(text: str, runs: int = 6, seconds: str = "3") -> Ensemble:
    return play_many(compiled(text), Settings(Fraction(seconds), seed=3), runs=runs)


def moved(stiffness: float, loss: str) -> str:
    """Return the three users apart at the start, over a network that loses packets."""
    return replaced(apart(AVERAGE, loss), ("stiffness: 500 N/m", f"stiffness: {stiffness} N/m"))


def test_runs_agree_with_the_verdict_in_mean_square() -> None:
    """A fifth of all packets lost one by one, three users are stable to 1205 N/m."""
    stable, unstable = beside(moved(1000, "loss: 20 %")), beside(moved(1300, "loss: 20 %"))
    for found, verdict in ((stable, "stable in mean square"), (unstable, "unstable in mean square")):
        assert found.mean_square is not None
        assert found.mean_square.verdict == verdict
        assert found.agrees
    assert stable.calm == 6
    assert "stable in mean square, and 6 of 6 runs settle or die away: they agree" in words(stable)
    assert stable.to_dict()["mean_square"]["agrees"] is True


def words(found: Ensemble) -> str:
    text = str(found)
    assert max(map(len, text.splitlines())) <= 80
    return " ".join(text.split())


def test_the_time_a_mean_square_takes_is_that_of_its_growth() -> None:
    """Beside the radius that `judge_network` tells: after it the root of a mean square is a twentieth."""
    text = moved(1000, "loss: 20 %")
    verdict, found = judge_network(compiled(text)), beside(text, 1).mean_square
    assert verdict is not None
    assert verdict.mean_square_radius is not None
    assert found is not None
    assert found.settles_in is not None
    frames = found.settles_in / 0.008
    assert verdict.mean_square_radius ** (frames / 2) == pytest.approx(0.05, rel=1e-9)


def test_runs_that_are_about_something_else_say_so() -> None:
    short = beside(moved(1200, "loss: 20 %"), seconds="0.3")
    assert short.agrees is False
    assert "and the runs show how it begins" in words(short)
    driven = beside(moved(500, "loss: 20 %") + PUSHES)
    assert driven.agrees is False
    assert "what moves the others is a force that goes on" in words(driven)


def test_runs_with_contacts_stand_beside_the_verdict_of_the_linearization() -> None:
    text = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8")
    found = beside(replaced(text, ("delay: 8 ms}", "delay: 8 ms, loss: 5 %}")), 2)
    assert found.mean_square is not None
    assert found.mean_square.linearized
    assert found.agrees is None
    assert "that verdict is of small motions about the start" in words(found)


def test_a_network_that_is_not_judged_says_why_beside_its_runs() -> None:
    found = beside(SHAKY, 2, "0.1")
    assert found.agrees is None
    assert "in mean square: not judged: jitter and bursts of lan together" in words(found)


def test_a_scene_without_chance_is_not_played_many_times() -> None:
    with pytest.raises(ApcError, match="E894 nothing in three-users-average is left to chance"):
        play_many(compiled(AVERAGE), Settings(Fraction(1)), runs=10)


def test_its_words_fit_a_terminal() -> None:
    text = str(many(0.1, 0.4, None, 0.2))
    assert max(map(len, text.splitlines())) <= 80
    assert text.splitlines()[0] == "scene: 4 runs of 3 s, seed 7"
    assert "settles           3   75 % (95 % sure: 30.1 % to 95.4 %)" in text
    assert "of the 3 runs that settle" in text


def test_the_command_prints_it_and_keeps_no_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(SHAKY + "experiment: {duration: 200 ms}\n", encoding="utf-8")
    assert run(["simulate", "--runs", "3", "--seed", "4", "--no-jit"]) == 0
    assert capsys.readouterr().out.startswith("three-users-average: 3 runs of 0.2 s, seed 4\n")
    assert run(["simulate", "--runs", "3", "--seed", "4", "--no-jit", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["runs"], document["seed"]) == (3, 4)
    assert run(["simulate", "--runs", "3", "--out", "rows.csv"]) == 2
    assert "--runs keeps no rows" in capsys.readouterr().err
