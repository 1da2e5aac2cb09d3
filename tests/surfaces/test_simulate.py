"""The command `simulate`: what it prints, what it writes, how it ends."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from apc.simulation import output_blocks, simulation
from tests.commands import Cli, folder, write
from tests.topologies import AVERAGE, TOPOLOGIES, replaced

MOVED = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: 5 mm}}"))


@pytest.fixture
def moved(cli: Cli) -> Cli:
    write("topology.yaml", MOVED)
    return cli


@pytest.mark.whole
def test_the_only_topology_of_a_folder_is_played_for_as_long_as_it_says(cli: Cli) -> None:
    write("topology.yaml", (TOPOLOGIES / "experiment-average.yaml").read_text(encoding="utf-8"))
    ran = cli("simulate")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith("experiment-average: decays\n")
    assert "3001 samples of 18 signals until 3 s" in ran.out


def test_rows_and_picture_are_written_and_named(moved: Cli) -> None:
    pytest.importorskip("matplotlib")
    ran = moved("simulate topology.yaml --duration 50ms --signals cube.x --out run.csv --plot run.svg")
    assert ran.code == 0
    assert ran.out.endswith("\n\nrun.csv is written\nrun.svg is written\n")
    lines = Path("run.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "time [s],user[1].cube.x [m],user[2].cube.x [m],user[3].cube.x [m]"
    assert len(lines) == 52
    assert Path("run.svg").read_text(encoding="utf-8").startswith("<?xml")


def test_json_is_one_document_with_what_made_it(moved: Cli) -> None:
    ran = moved("simulate --json --duration 0.1s --set 'contact.stiffness=800 N/m' --no-jit")
    reported = json.loads(ran.out)
    assert (reported["topology"], reported["rows"], reported["diverged"]) == (
        "three-users-average",
        101,
        None,
    )
    assert reported["provenance"]["parameters"]["contact.stiffness"]["value"] == 800
    assert reported["provenance"]["duration_s"] == "1/10"
    assert reported["signals"][0].keys() >= {"name", "unit", "first", "last", "low", "high"}


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        ("", "topology.yaml: E877 the topology has no duration."),
        ("--duration 3", '--duration: E204 duration: expected s, got 3 (no unit). Try: --duration "3 s"'),
        ("--duration 1s --out run.doc", "run.doc: E878 suffix of --out: expected one of .csv,"),
        ("--out p.png", "one of .csv, .parquet, .mat, .npz, .gif, .mp4, got .png. Try: --plot p.png"),
        ("--duration 1s --snapshot run.doc", "run.doc: E878 suffix of --snapshot: expected one of"),
        ("--duration 1s --plot run.doc", "run.doc: E878 suffix of --plot: expected one of .png,"),
        ("--duration 1s --out no/run.csv", "no/run.csv: E601 can't be written: No such file"),
        ("--duration 1s --method euler:1ms", "--method: E910 method: expected one of exact,"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(words: str, printed: str, moved: Cli) -> None:
    ran = moved(f"simulate {words}")
    assert (ran.code, ran.out) == (1, "")
    assert printed in ran.err
    assert folder() == ["topology.yaml"]


def test_a_topology_at_rest_is_said_to_rest_and_an_unstable_one_is_an_answer(cli: Cli) -> None:
    write("topology.yaml", AVERAGE)
    assert cli("simulate --duration 1s").out.splitlines() == [
        "three-users-average: at rest",
        "",
        "  No position changes.",
        "",
        "  recorded            1001 samples of 24 signals until 1 s",
    ]
    write("topology.yaml", replaced(MOVED, ("stiffness: 500 N/m", "stiffness: 50 kN/m")))
    ran = cli("simulate --duration 10s --out run.csv")
    assert ran.code == 0 and "three-users-average: diverges" in ran.out
    text = Path("run.csv").read_text(encoding="utf-8")
    assert "nan" not in text and "inf" not in text


def test_ctrl_c_keeps_what_is_done(moved: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "MOST_FRAMES", 5)
    pushes = output_blocks.forces_in_time

    def interrupted(played: simulation.Simulation, first: int) -> list[np.ndarray | None]:
        if first >= 10:
            raise KeyboardInterrupt
        return pushes(played, first)

    monkeypatch.setattr(output_blocks, "forces_in_time", interrupted)
    ran = moved("simulate --duration 1s --out run.csv")
    assert ran.code == 130 and "run.csv is written" in ran.out
    assert ran.err.startswith("stopped at 0.079 s of 1 s; completed rows are stored")
    assert len(Path("run.csv").read_text(encoding="utf-8").splitlines()) == 81


@pytest.mark.whole
def test_the_error_and_the_method_are_told_if_asked_for(moved: Cli) -> None:
    exact = moved("simulate --duration 0.1s --error").out
    assert "  error               rounding only, about " in exact and "method" not in exact
    out = moved("simulate --duration 0.1s --error --method semi-implicit:1/2ms").out
    assert "  method              semi-implicit:0.5 ms\n" in out
    assert "(half the step, semi-implicit:0.25 ms)" in " ".join(out.split())
    assert all(len(line) <= 80 for line in out.splitlines())
    reported = json.loads(moved("simulate --duration 0.1s --error --method rk4:1ms --json").out)
    assert reported["provenance"]["method"] == "rk4:1 ms"
    assert reported["error_estimate"]["kind"] == "method"
    assert len(reported["error_estimate"]["signals"]) == len(reported["signals"])
