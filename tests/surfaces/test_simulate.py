"""The command `simulate`: what it prints, what it writes, how it ends."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from apc.__main__ import run
from apc.simulation import blocks, simulation
from tests.topologies import AVERAGE, SCENES, replaced

MOVED = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: 5 mm}}"))
EXPERIMENT = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scene(text: str) -> None:
    Path("scene.yaml").write_text(text, encoding="utf-8")


def test_the_only_scene_of_a_folder_is_played_for_as_long_as_it_says(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene(EXPERIMENT)
    assert run(["simulate"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("experiment-average: settles\n")
    assert "3001 rows of 18 signals until 3 s" in out
    assert err == ""


def test_rows_and_picture_are_written_and_named(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    scene(MOVED)
    words = ["--duration", "50 ms", "--signals", "cube.x", "--out", "run.csv", "--plot", "run.svg"]
    assert run(["simulate", "scene.yaml", *words]) == 0
    assert capsys.readouterr().out.endswith("  run.csv is written\n  run.svg is written\n")
    lines = Path("run.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "time [s],user[1].cube.x [m],user[2].cube.x [m],user[3].cube.x [m]"
    assert len(lines) == 52
    assert Path("run.svg").read_text(encoding="utf-8").startswith("<?xml")


def test_json_is_one_document_with_what_made_it(capsys: pytest.CaptureFixture[str]) -> None:
    scene(MOVED)
    words = ["--json", "--duration", "0.1 s", "--set", "contact.stiffness=800 N/m", "--no-jit"]
    assert run(["simulate", *words]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["topology"] == "three-users-average"
    assert document["rows"] == 101
    assert document["provenance"]["parameters"]["contact.stiffness"]["value"] == 800
    assert document["provenance"]["duration_s"] == "1/10"
    assert document["diverged"] is None
    assert document["signals"][0].keys() >= {"name", "unit", "first", "last", "low", "high"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "scene.yaml: E877 the scene says no duration."),
        (["--duration", "3"], '--duration: E204 duration wants s, got 3 (no unit). Write: --duration "3 s"'),
        (["--duration", "-1 s"], "scene.yaml: E877 the duration wants more than 0 s, got -1 s."),
        (["--duration", "1 s", "--signals", "cube.y"], "scene.yaml: E873 no signal fits 'cube.y';"),
        (["--duration", "1 s", "--out", "run.doc"], "run.doc: E878 the suffix of --out wants one of .csv,"),
        (["--duration", "1 s", "--out", "no/run.csv"], "no/run.csv: E601 can't be written: No such file"),
        (["--duration", "1 s", "--method", "euler:1ms"], "--method: E910 the method wants one of exact,"),
        (
            ["--duration", "1 s", "--method", "rk4:-1 ms"],
            "--method: E911 the step of rk4 wants more than 0 s",
        ),
        (["--duration", "1e9 s"], "scene.yaml: E915 the duration wants at most 1e+06 s"),
        (
            ["--duration", "1 s", "--method", "rk4:0"],
            "--method: E204 the step of rk4 wants s, got 0 (no unit). Write: rk4:0.1ms",
        ),
        (["--duration", "1 s", "--method", "rk4:3 ms"], "scene.yaml: E913 the step of rk4 wants at"),
        (["--duration", "1 s", "--still", "run.doc"], "run.doc: E878 the suffix of --still wants one of"),
        (["--duration", "1 s", "--plot", "run.doc"], "run.doc: E878 the suffix of --plot wants one of .png,"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    scene(MOVED)
    assert run(["simulate", *words]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(said)
    assert [one.name for one in Path().iterdir()] == ["scene.yaml"]


def test_a_scene_at_rest_is_said_to_rest(capsys: pytest.CaptureFixture[str]) -> None:
    scene(AVERAGE)
    assert run(["simulate", "--duration", "1 s"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "three-users-average: rests",
        "",
        "  Nothing moves: no force and no start value sets it in motion.",
        "",
        "  recorded       1001 rows of 24 signals until 1 s",
    ]


def test_an_unstable_scene_is_an_answer(capsys: pytest.CaptureFixture[str]) -> None:
    scene(replaced(MOVED, ("stiffness: 500 N/m", "stiffness: 50 kN/m")))
    assert run(["simulate", "--duration", "10 s", "--out", "run.csv"]) == 0
    assert "three-users-average: diverges" in capsys.readouterr().out
    text = Path("run.csv").read_text(encoding="utf-8")
    assert "nan" not in text
    assert "inf" not in text


def test_ctrl_c_keeps_what_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene(MOVED)
    monkeypatch.setattr(simulation, "MOST_FRAMES", 5)
    step = blocks._Runner.run

    def interrupted(self: blocks._Runner, first: int, last: int) -> blocks.Block:
        if first >= 10:
            raise KeyboardInterrupt
        return step(self, first, last)

    monkeypatch.setattr(blocks._Runner, "run", interrupted)
    assert run(["simulate", "--duration", "1 s", "--out", "run.csv"]) == 130
    out, err = capsys.readouterr()
    assert "run.csv is written" in out
    assert err.startswith("stopped at 0.079 s of 1 s; what was done is kept")
    assert len(Path("run.csv").read_text(encoding="utf-8").splitlines()) == 81


def test_the_error_and_the_method_are_told_if_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    scene(MOVED)
    assert run(["simulate", "--duration", "0.1 s", "--error"]) == 0
    out = capsys.readouterr().out
    assert "  error          none but rounding; about " in out
    assert "method" not in out
    assert run(["simulate", "--duration", "0.1 s", "--error", "--method", "semi-implicit:1/2ms"]) == 0
    out = capsys.readouterr().out
    assert "  method         semi-implicit:0.5 ms\n" in out
    assert "(half the step, semi-implicit:0.25 ms)" in " ".join(out.split())
    assert all(len(line) <= 80 for line in out.splitlines())
    assert run(["simulate", "--duration", "0.1 s", "--error", "--method", "rk4:1ms", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["provenance"]["method"] == "rk4:1 ms"
    assert document["error_estimate"]["kind"] == "method"
    assert len(document["error_estimate"]["signals"]) == len(document["signals"])
