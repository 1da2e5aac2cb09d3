"""The command line: what it prints, what it writes, how it ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.present.forms import document, json_text
from tests.topologies import AVERAGE, MESH, SCENES

COMMANDS = (
    *(
        "new",
        "check",
        "compile",
        "show",
        "analyze",
        "compare",
        "critical",
        "region",
        "simulate",
        "sweep",
        "bench",
        "schema",
        "library",
    ),
)


class Ran(NamedTuple):
    code: int
    out: str
    err: str


Cli = Callable[..., Ran]


@pytest.fixture
def cli(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Cli:
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*words: str) -> Ran:
        code = run(list(words))
        return Ran(code, *capsys.readouterr())

    return call


def written(name: str, text: str = AVERAGE) -> str:
    Path(name).write_text(text, encoding="utf-8")
    return name


def folder() -> list[str]:
    return sorted(path.name for path in Path().iterdir())


def test_from_nothing_to_a_verdict_in_three_commands(cli: Cli) -> None:
    ran = cli("new")
    assert ran == Ran(0, "topology.yaml is written. Next: apc compile topology.yaml\n", "")
    ran = cli("compile")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith("topology → topology.apc\n  8 states a peer")
    ran = cli("analyze")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith("topology: stable up to a common translation\n")
    assert folder() == ["topology.apc", "topology.yaml"]


def test_new_writes_under_the_name_given_and_overwrites_nothing(cli: Cli) -> None:
    assert cli("new", "my-scene").code == 0
    assert Path("my-scene.yaml").read_text(encoding="utf-8").count("topology: my-scene") == 1
    Path("my-scene.yaml").write_text("mine", encoding="utf-8")
    ran = cli("new", "my-scene")
    assert ran == Ran(
        1, "", "my-scene.yaml: E613 exists already and is left as it is. Write: apc new another-name\n"
    )
    assert Path("my-scene.yaml").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("name", ["../evil", "a/b", "a b", ".hidden", "x" * 64, "", "a\nb"])
def test_new_takes_a_plain_name_only(cli: Cli, name: str) -> None:
    ran = cli("new", name)
    assert (ran.code, ran.out) == (1, "")
    assert "E612 a scene's name wants letters, digits, - and _, 63 at most" in ran.err
    assert folder() == []


def test_check_builds_nothing(cli: Cli) -> None:
    written("scene.yaml")
    assert cli("check") == Ran(0, "scene.yaml: no mistakes. three-users-average, 3 peers.\n", "")
    assert folder() == ["scene.yaml"]


def test_check_reports_every_mistake(cli: Cli) -> None:
    written("scene.yaml", AVERAGE.replace("0.1 kg", "0.1").replace("link: lan", "link: lam"))
    ran = cli("check")
    assert (ran.code, ran.out) == (1, "")
    assert [line for line in ran.err.splitlines() if line.startswith("scene.yaml")] == [
        "scene.yaml:9:18: E204 mass wants kg, got 0.1 (no unit). Write: mass: 0.1 kg",
        "scene.yaml:13:109: E206 coordination names link lam, which isn't in links; the nearest is lan. "
        "Write: lan",
    ]


@pytest.mark.parametrize("stage", ["source", "scene", "flat", "clocked", "sorted"])
def test_until_prints_a_stage_and_writes_nothing(cli: Cli, stage: str) -> None:
    ran = cli("compile", written("scene.yaml"), "--until", stage)
    assert (ran.code, ran.err) == (0, "")
    assert len(ran.out.splitlines()) > 10
    assert folder() == ["scene.yaml"]


def test_a_compiled_model_is_not_compiled_again(cli: Cli) -> None:
    written("scene.yaml")
    cli("compile")
    ran = cli("compile", "scene.apc")
    assert ran == Ran(1, "", "scene.apc: E614 is compiled already. Write: apc analyze scene.apc\n")


def test_json_is_one_document_and_nothing_else(cli: Cli) -> None:
    written("scene.yaml")
    ran = cli("analyze", "--json")
    assert (ran.code, ran.err) == (0, "")
    document = json.loads(ran.out)
    assert document["topology"] == "three-users-average"
    assert document["peers"] == 3
    assert document["frame_s"] == 0.008
    assert document["stable"] is True
    assert document["rigid_modes"] == 1
    assert 0 < document["spectral_radius_error"] < 1e-9
    assert set(document["modes"][0]) >= {
        *("eigenvalue", "magnitude", "multiplicity", "frequency_hz", "damping_ratio", "shape"),
        "participation",
    }


def test_an_unstable_scene_is_an_answer(cli: Cli) -> None:
    written("scene.yaml")
    ran = cli("analyze", "--set", "coordination.stiffness=5000 N/m", "--json")
    assert ran.code == 0
    assert json.loads(ran.out)["stable"] is False


def test_set_may_be_repeated_and_the_section_may_be_named(cli: Cli) -> None:
    written("scene.yaml")
    one = cli(
        "analyze", "--set", "couplers.contact.stiffness=1.5 N/mm", "--set", "links.lan.delay=0 s", "--json"
    )
    text = AVERAGE.replace("1000 N/m", "1500 N/m").replace("delay: 8 ms", "delay: 0 s")
    two = cli("analyze", written("scene.yaml", text), "--json")
    assert (one.code, two.code) == (0, 0)
    assert json.loads(one.out) == json.loads(two.out)


def test_methods_agree(cli: Cli) -> None:
    written("scene.yaml", MESH)
    modes, dense = (json.loads(cli("analyze", "--method", m, "--json").out) for m in ("modes", "dense"))
    assert dense["method"] == "dense"
    assert abs(modes["spectral_radius"] - dense["spectral_radius"]) < 1e-12


def test_a_model_works_without_its_topology_and_a_stale_one_is_refused(cli: Cli) -> None:
    written("scene.yaml")
    cli("compile")
    fresh = cli("analyze", "--json")
    written("scene.yaml", AVERAGE.replace("500 N/m,", "5000 N/m,"))
    assert cli("analyze", "scene.apc") == Ran(
        1,
        "",
        "scene.apc: E605 is stale: scene.yaml has changed since it was compiled. "
        "Write: apc compile scene.yaml\n",
    )
    assert json.loads(cli("analyze", "scene.yaml", "--json").out)["stable"] is False, "the text decides"
    Path("scene.yaml").unlink()
    assert cli("analyze", "--json") == fresh


def test_a_damaged_model_beside_its_topology_is_passed_over(cli: Cli) -> None:
    written("scene.yaml")
    Path("scene.apc").write_bytes(b"garbage")
    assert cli("analyze", "scene.yaml").code == 0
    assert cli("analyze", "scene.apc").code == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("analyse",), "No such command 'analyse'."),
        (("compile", "--until", "nowhere"), "Invalid value for '--until'"),
        (("analyze", "--method", "schur"), "Invalid value for '--method'"),
        (("analyze", "--jsn"), "No such option '--jsn'"),
        (("compile", "a", "b"), "Got unexpected extra argument (b)"),
    ],
)
def test_a_wrong_call_ends_with_two(cli: Cli, words: tuple[str, ...], message: str) -> None:
    ran = cli(*words)
    assert (ran.code, ran.out) == (2, "")
    assert message in ran.err.replace("option: --jsn", "option '--jsn'")


def test_a_bug_of_ours_ends_with_three_and_keeps_a_report(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("apc.compiler.pipeline.compile_topology", lambda path: 1 // 0)
    ran = cli("check", written("scene.yaml"))
    assert (ran.code, ran.out) == (3, "")
    assert ran.err.startswith("apc: this is a bug of apc, not of your input; a report is in ")
    assert "Traceback" not in ran.err
    report = Path(ran.err.split(" a report is in ")[1].strip())
    text = report.read_text(encoding="utf-8")
    assert "ZeroDivisionError" in text
    assert "arguments: ['check', 'scene.yaml']" in text


@pytest.mark.parametrize("words", [("--help",), *((command, "--help") for command in COMMANDS)])
def test_help_fits_a_terminal_and_ends_with_a_full_stop(cli: Cli, words: tuple[str, ...]) -> None:
    ran = cli(*words)
    assert (ran.code, ran.err) == (0, "")
    assert max(len(line) for line in ran.out.splitlines()) <= 80
    assert "-h, --help" in ran.out


def test_version_is_told(cli: Cli) -> None:
    assert cli("--version") == Ran(0, f"apc {apc.__version__}\n", "")


def test_the_module_runs_like_the_command(tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "apc", "new"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["topology.yaml"]


@pytest.mark.skipif(os.name == "nt", reason="pipes close differently there")
def test_a_reader_who_leaves_early_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    command = f"{sys.executable} -m apc compile --until source scene.yaml"
    script = f"set -o pipefail; {command} | true; exit $?"
    ran = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


def _finite(word: str) -> float:
    pytest.fail(f"{word} is no JSON")


@pytest.mark.few(6)
@pytest.mark.parametrize(
    "command",
    [
        ["analyze"],
        ["critical", "contact.stiffness"],
        ["feel"],
        ["region", "--x", "contact.stiffness=1 N/m:100 N/m", "--y", "device.mass=1 g:1 kg"],
        ["simulate", "--duration", "16 ms"],
    ],
    ids=lambda command: str(command[0]),
)
@pytest.mark.parametrize(
    "value", ["device.damping=1e30 N*s/m", "device.mass=1e-300 kg", "device.mass=1e300 kg"]
)
def test_json_has_no_number_that_is_not_finite(
    command: list[str], value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run([*command, str(SCENES / "three-users-average.yaml"), "--set", value, "--json"])
    assert code in (0, 1)
    if not code:
        json.loads(capsys.readouterr().out, parse_constant=_finite)


def test_what_is_not_finite_is_null_wherever_it_stands() -> None:
    values = {"a": float("nan"), "b": [float("inf"), 1.0], "c": np.array([1.0, -np.inf])}
    assert json.loads(json_text(document(values))) == {"a": None, "b": [None, 1.0], "c": [1.0, None]}
    assert json.loads(json_text({"a": [float("nan")]})) == {"a": [None]}
