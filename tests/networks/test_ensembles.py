"""Many runs of one topology, each by a luck of its own: they are the runs they say, and what is told of
them.
"""

from __future__ import annotations

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.simulation import monte_carlo
from apc.simulation.c_compiler import compiler
from apc.simulation.monte_carlo import Ensemble, share_interval, simulate_many
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.simulation.trajectory import run_simulation
from tests.lossy import apart
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, replaced

SHAKY = apart(AVERAGE, "loss: {p: 10 %, r: 20 %}, jitter: 8 ms")

machine_code = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


def runs(text: str, count: int = 6, seconds: str = "3", *, jit: bool = True, jobs: int = 1) -> Ensemble:
    return simulate_many(compiled(text), Settings(Fraction(seconds), seed=3, jit=jit), runs=count, jobs=jobs)


def printed(found: Ensemble) -> str:
    assert max(map(len, str(found).splitlines())) <= 80
    return " ".join(str(found).split())


ALL = apart(
    AVERAGE, "loss: 20 %, jitter: 9 ms, distribution: normal, reorder: all, on_loss: zero, graph: ring"
)


@pytest.mark.whole
# Machine code plays 13 side by side: more than are added up at once, and no multiple of it.
@pytest.mark.parametrize(
    ("text", "part", "jit"),
    [
        (SHAKY, 5, False),
        pytest.param(SHAKY, 13, True, marks=[machine_code, pytest.mark.whole]),
        pytest.param(ALL, 13, True, marks=[machine_code, pytest.mark.whole]),
    ],
)
def test_a_run_does_not_depend_on_how_many_there_are_or_who_plays_it(
    text: str, part: int, jit: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(monte_carlo, "PART", part)
    few = runs(text, 4, "1/2", jit=jit).runs
    together = runs(text, 2 * part, "1/2", jit=jit, jobs=1 if jit else 2)
    shared = together.runs
    assert [one.number for one in shared] == [*range(2 * part)]
    assert shared[:4] == few
    assert len({one.settled for one in shared}) > 3, "they are different runs"
    settled = [one.settled for one in shared if one.settled is not None]
    of_all = together.statistics("settled")
    assert of_all is not None and of_all.count == len(settled)
    assert (of_all.low, of_all.high) == (min(settled), max(settled))
    assert of_all.mean == pytest.approx(np.mean(settled))
    assert of_all.standard_error == pytest.approx(np.std(settled, ddof=1) / math.sqrt(len(settled)))
    alone, _ = run_simulation(prepare(compiled(text), Settings(Fraction(1, 2), seed=3, jit=jit)), [])
    assert alone.largest_force is not None
    reported = (few[0].verdict, few[0].settled, few[0].largest_force)
    assert reported == (alone.verdict, alone.settled, alone.largest_force[1])


def test_a_shares_interval_is_wilsons() -> None:
    """Newcombe (1998, Statist. Med. 17), table I: 81 of 263, 0 of 20 and 1 of 29."""
    for some, of, interval in ((81, 263, (0.2553, 0.3662)), (0, 20, (0, 0.1611)), (1, 29, (0.0061, 0.1718))):
        assert share_interval(some, of) == pytest.approx(interval, abs=5e-5)


def moved(stiffness: float) -> str:
    """Return the three users apart at the start; a fifth of all packets lost, they are stable to 1205 N/m."""
    return replaced(apart(AVERAGE, "loss: 20 %"), ("stiffness: 500 N/m", f"stiffness: {stiffness} N/m"))


@pytest.mark.whole
def test_runs_agree_with_the_judgedin_mean_square_and_take_the_time_of_its_growth() -> None:
    stable, unstable = runs(moved(1000)), runs(moved(1300))
    for found, verdict in ((stable, "stable in mean square"), (unstable, "unstable in mean square")):
        assert found.mean_square is not None
        assert found.mean_square.verdict == verdict and found.agrees
    assert stable.calm == 6
    assert "6 of 6 runs decay or are at rest. The runs agree with the verdict." in printed(stable)
    reported = stable.mean_square
    assert reported is not None and reported.settles_in is not None
    # After this time the root of a mean square is a twentieth of what it was.
    decided = apc.mean_square_stability(compiled(moved(1000)))
    assert decided is not None and decided.mean_square_radius is not None
    assert decided.mean_square_radius ** (reported.settles_in / 0.008 / 2) == pytest.approx(0.05, rel=1e-9)


@pytest.mark.whole
def test_runs_that_are_about_something_else_than_a_verdict_say_so() -> None:
    short = runs(moved(1200), 2, "0.3")
    assert short.agrees is False and "Settling takes about" in printed(short)
    hand = "hands:\n  hand: {type: SineForce, flange: device, force: 1 N, frequency: 3 Hz}\n"
    driven = runs(moved(500) + hand, 2, "1")
    assert driven.agrees is False and "A force that does not end drives the others" in printed(driven)
    text = (TOPOLOGIES / "experiment-average.yaml").read_text(encoding="utf-8")
    pressed = runs(replaced(text, ("delay: 8 ms}", "delay: 8 ms, loss: 5 %}")), 2)
    assert pressed.mean_square is not None and pressed.mean_square.linearized and pressed.agrees is None
    assert "The verdict holds for small motions about the start" in printed(pressed)
    unjudged = runs(SHAKY, 2, "0.1")
    assert unjudged.agrees is None
    assert "verdict is not available: jitter and bursts of lan together" in printed(unjudged)


def test_a_topology_without_chance_is_not_played_many_times() -> None:
    with pytest.raises(ApcError, match="E894 no part of three-users-average is random"):
        runs(AVERAGE)


def test_the_command_prints_it_and_keeps_no_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The seed is the experiment's, if none is given."""
    monkeypatch.chdir(tmp_path)
    Path("topology.yaml").write_text(SHAKY + "experiment: {duration: 200 ms, seed: 5}\n", encoding="utf-8")
    assert run(["simulate", "--runs", "3", "--no-jit"]) == 0
    assert capsys.readouterr().out.startswith("three-users-average: 3 runs of 0.2 s, seed 5\n")
    assert run(["simulate", "--runs", "3", "--seed", "4", "--no-jit", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["runs"], document["seed"]) == (3, 4)
    assert run(["simulate", "--runs", "3", "--out", "rows.csv"]) == 2
    assert "--runs can't be combined with" in capsys.readouterr().err
