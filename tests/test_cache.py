"""`cache`: a compiled model serves as long as everything it was made from is the same, by content alone."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import apc
from apc import inputs, opening
from apc.__main__ import run
from apc.api import load
from apc.compiler import cache, files, store, timings
from apc.compiler.cache import changed, read_archive
from apc.inputs import compiled_already
from tests.topologies import replaced, told

SCENE = Path("scene.yaml")
MODEL = Path("scene.apc")
PART = """\
component: Tie
about: A spring to where the device is at rest.
connectors: {flange: Flange}
parameters: {stiffness: {unit: N/m, min: 0}}
equations: [flange.f = stiffness*flange.x]
"""
TEXT = """\
topology: scene
library: parts
peers: {user: {table: users.csv}}
masses: {device: {mass: 1 kg, damping: 2 N*s/m}}
couplers: {tie: {type: Tie, flange: device, stiffness: 3 N/m}}
"""


@pytest.fixture(autouse=True)
def compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Compile a scene that names a table and a folder of components."""
    monkeypatch.chdir(tmp_path)
    Path("parts").mkdir()
    Path("parts/tie.yaml").write_text(PART, encoding="utf-8")
    Path("users.csv").write_text("device.mass [kg]\n1\n2\n", encoding="utf-8")
    SCENE.write_text(TEXT, encoding="utf-8")
    assert run(["compile"]) == 0, capsys.readouterr().err
    capsys.readouterr()


def change_the_topology() -> None:
    SCENE.write_text(replaced(TEXT, ("3 N/m", "4 N/m")), encoding="utf-8")


def change_a_table() -> None:
    Path("users.csv").write_text("device.mass [kg]\n1\n3\n", encoding="utf-8")


def remove_a_table() -> None:
    Path("users.csv").unlink()


def change_a_component() -> None:
    Path("parts/tie.yaml").write_text(replaced(PART, ("= stiffness", "= 2*stiffness")), encoding="utf-8")


def add_a_component_that_hides_one_of_the_library() -> None:
    Path("parts/mass.yaml").write_text(PART.replace("Tie", "Mass"), encoding="utf-8")


@pytest.mark.parametrize(
    ("change", "shown"),
    [
        (change_the_topology, "scene.yaml"),
        (change_a_table, "users.csv"),
        (remove_a_table, "users.csv"),
        (change_a_component, "parts/tie.yaml"),
        (add_a_component_that_hides_one_of_the_library, "parts/"),
    ],
)
def test_a_change_of_anything_it_was_made_from_is_noticed(change: Callable[[], None], shown: str) -> None:
    assert compiled_already(SCENE)
    change()
    assert not compiled_already(SCENE)
    assert told(load, MODEL) == [
        f"scene.apc: E605 is stale: {shown} has changed since it was compiled. Write: apc compile scene.yaml"
    ]


def test_a_change_of_the_library_or_of_the_program_is_noticed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with monkeypatch.context() as patch:
        for module in (inputs, opening):
            patch.setattr(module, "program_digest", lambda: "other")
        assert not compiled_already(SCENE)
        patch.setattr(store, "opened", lambda archive: pytest.fail("what another program compiled is used"))
        assert load(MODEL).name == "scene", "compiled again from its texts"
    (tmp_path / "other.yaml").write_text("connector: Flange\n", encoding="utf-8")
    changed_library = {**cache.builtin_files(), "Flange": tmp_path / "other.yaml"}
    with monkeypatch.context() as patch:
        patch.setattr(cache, "builtin_files", lambda: changed_library)
        assert not compiled_already(SCENE)
        assert "is stale: the library's Flange has changed" in told(load, MODEL)[0]
    assert compiled_already(SCENE)


def test_times_of_modification_mean_nothing() -> None:
    SCENE.write_text(TEXT, encoding="utf-8")
    for path in (SCENE, Path("users.csv"), Path("parts/tie.yaml")):
        os.utime(path, (4e9, 4e9))
    os.utime(MODEL, (0, 0))
    assert compiled_already(SCENE)


def test_a_change_taken_back_is_no_change() -> None:
    change_a_table()
    Path("users.csv").write_text("device.mass [kg]\n1\n2\n", encoding="utf-8")
    assert compiled_already(SCENE)


def test_the_folder_may_move() -> None:
    here = Path.cwd()
    moved = here.with_name(f"{here.name}-moved")
    here.rename(moved)
    os.chdir(moved)
    assert compiled_already(SCENE)


def test_compiling_again_says_unchanged_and_force_compiles(capsys: pytest.CaptureFixture[str]) -> None:
    before = MODEL.read_bytes()
    assert run(["compile"]) == 0
    line = "scene.yaml → scene.apc: unchanged, not compiled again (--force does)\n"
    assert capsys.readouterr().out == line
    assert run(["compile", "--force"]) == 0
    assert "self-check" in capsys.readouterr().out
    assert MODEL.read_bytes() == before, "the same texts give the same bytes"
    change_the_topology()
    assert run(["compile"]) == 0
    assert "self-check" in capsys.readouterr().out
    assert compiled_already(SCENE)


def test_timings_name_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["compile", "--timings"]) == 0
    rows = [line.rsplit(maxsplit=2) for line in capsys.readouterr().err.splitlines()]
    stages = ["source", "scene", "flat", "clocked", "sorted", "compiled", "self-check", "save"]
    assert [row[0].strip() for row in rows] == ["start", *stages, "imports, rest", "all"]
    numbers = [float(row[1]) for row in rows]
    assert sum(numbers[:-1]) == pytest.approx(numbers[-1], abs=1.0)


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["analyze", "--json"], ["read", "analysis", "sensitivities", "margins", "print"]),
        (["critical", "tie.stiffness"], ["read", "critical", "print"]),
        (["simulate", "--duration", "0.1 s"], ["read", "prepare", "play", "print"]),
        (["check"], ["source", "scene", "flat", "clocked", "sorted", "compiled"]),
    ],
)
def test_every_command_says_what_its_parts_take_on_stderr(
    words: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 0
    plain = capsys.readouterr()
    assert run([*words, "--timings"]) == 0
    found = capsys.readouterr()
    assert found.out == plain.out
    told = [line.rsplit(maxsplit=2)[0].strip() for line in found.err.splitlines()]
    assert [name for name in told if name in parts] == parts
    assert told[0] == "start" and told[-2:] == ["imports, rest", "all"]


def test_a_part_within_another_counts_for_itself_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 3.0, 7.0, 12.0, 20.0, 30.0, 50.0])
    monkeypatch.setattr(timings.time, "perf_counter", lambda: next(clock))
    with timings.record() as taken:
        with timings.part("outer"), timings.part("inner"):
            pass
        with timings.part("inner"):
            pass
    assert taken == {"outer": 7.0, "inner": 14.0, "imports, rest": 29.0}
    assert not timings.recording()
    with timings.part("outer"):
        assert not timings.recording()


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x05\x06" + 18 * b"\0"])
def test_a_damaged_model_stands_for_no_topology(content: bytes) -> None:
    MODEL.write_bytes(content)
    assert not compiled_already(SCENE)


@pytest.mark.parametrize("line", range(4))
def test_a_model_with_a_changed_line_stands_for_no_topology(line: int) -> None:
    lines = MODEL.read_bytes().split(b"\n", 3)
    lines[line] = lines[line].replace(b"a", b"b") if line == 2 else lines[line] + b" "
    MODEL.write_bytes(b"\n".join(lines))
    assert not compiled_already(SCENE)


def test_a_model_that_was_changed_or_saved_by_hand_stands_for_no_topology() -> None:
    apc.save(apc.load(MODEL), MODEL)
    assert not compiled_already(SCENE)
    assert load(MODEL).name == "scene"


def put_a_pipe(path: Path) -> None:
    os.mkfifo(path)  # who reads it waits for ever


def put_a_device(path: Path) -> None:
    path.symlink_to("/dev/zero")  # who reads it never ends


def put_an_answer_of_the_kernel(path: Path) -> None:
    path.symlink_to("/proc/self/maps")


@pytest.mark.parametrize("put", [put_a_pipe, put_a_device, put_an_answer_of_the_kernel])
@pytest.mark.parametrize(
    "name", ["scene.yaml", "users.csv", "parts/tie.yaml", "parts/more.yaml", "scene.apc"]
)
def test_what_is_no_file_is_not_read_and_is_a_change(name: str, put: Callable[[Path], None]) -> None:
    Path(name).unlink(missing_ok=True)
    put(Path(name))
    assert not compiled_already(SCENE)


def test_a_folder_that_grew_is_not_walked_to_its_end_and_is_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    archive = read_archive(MODEL)
    assert changed(archive, Path()) == ""
    monkeypatch.setattr(files, "MOST_ENTRIES", 0)
    assert changed(archive, Path()) == "parts/"


def test_a_pipe_named_as_a_definition_is_none_of_the_scene_s() -> None:
    os.mkfifo("Mass")
    assert compiled_already(SCENE)


def test_what_it_was_made_from_is_named_from_the_topology() -> None:
    origin = read_archive(MODEL).origin
    assert {name for name, _ in origin.texts} == {
        *("scene.yaml", "./users.csv", "./parts/", "./parts/tie.yaml", "Flange", "Mass"),
    }
    assert dict(origin.texts)["scene.yaml"] == TEXT.encode()


def test_saying_unchanged_needs_no_algebra_no_units_and_no_numbers() -> None:
    code = "import sys\nfrom apc.__main__ import run\nassert run(['compile']) == 0\n"
    code += "assert not {'sympy', 'pint', 'casadi', 'numpy'} & set(sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "unchanged" in ran.stdout
