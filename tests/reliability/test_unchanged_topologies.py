"""What was compiled serves as long as everything it was made from is the same, by content alone."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import apc
from apc.__main__ import run
from apc.compiler import cache, files, store
from tests.topologies import messages_of, replaced

TOPOLOGY, MODEL, TABLE = Path("topology.yaml"), Path("topology.apc"), Path("users.csv")
PART = """\
component: Tie
description: A spring to where the device is at rest.
connectors: {flange: Flange}
parameters: {stiffness: {unit: N/m, min: 0}}
equations: [flange.f = stiffness*flange.x]
"""
TEXT = """\
topology: topology
library: parts
peers: {user: {table: users.csv}}
masses: {device: {mass: 1 kg, damping: 2 N*s/m}}
couplers: {tie: {type: Tie, flange: device, stiffness: 3 N/m}}
"""
ROWS = "device.mass [kg]\n1\n2\n"


@pytest.fixture(autouse=True)
def compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile a topology that names a table and a folder of components."""
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path / "folder")
    Path("parts").mkdir()
    write("parts/tie.yaml", PART)
    write("users.csv", ROWS)
    write("topology.yaml", TEXT)
    assert run(["compile"]) == 0


def write(name: str, text: str) -> None:
    Path(name).write_text(text, encoding="utf-8")


def is_unchanged(capsys: pytest.CaptureFixture[str]) -> bool:
    capsys.readouterr()
    assert run(["compile"]) == 0
    return "up to date" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "shown"),
    [
        (lambda: write("topology.yaml", replaced(TEXT, ("3 N/m", "4 N/m"))), "topology.yaml"),
        (lambda: write("users.csv", f"{ROWS}3\n"), "users.csv"),
        (lambda: write("parts/tie.yaml", replaced(PART, ("= stiffness", "= 2*stiffness"))), "parts/tie.yaml"),
        (lambda: write("parts/mass.yaml", replaced(PART, ("Tie", "Spring"))), "parts/"),
        (lambda: Path("parts/tie.yaml").rename("parts/renamed.yaml"), "parts/"),
    ],
)
def test_a_change_of_anything_it_was_made_from_is_noticed(
    change: Callable[[], None], shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert is_unchanged(capsys)
    change()
    message = f"topology.apc: E605 model is out of date: {shown} has changed."
    assert messages_of(apc.load, MODEL) == [f"{message} Try: apc compile topology.yaml"]
    assert not is_unchanged(capsys)
    assert apc.load(MODEL).peers == len(TABLE.read_text(encoding="utf-8").splitlines()) - 1
    assert is_unchanged(capsys)


def move_the_folder() -> None:
    Path("../folder").rename("../moved")
    os.chdir("../moved")


def touch_everything() -> None:
    for path in (TOPOLOGY, TABLE, Path("parts/tie.yaml")):
        os.utime(path, (4e9, 4e9))
    os.utime(MODEL, (0, 0))


@pytest.mark.parametrize(
    "change",
    [
        touch_everything,
        move_the_folder,
        lambda: (write("users.csv", "other"), write("users.csv", ROWS)),
        lambda: write("parts/note.txt", "not read"),
        lambda: os.mkfifo("Mass"),  # a pipe named as a definition of the library
    ],
)
def test_what_is_no_change_is_none(change: Callable[[], None], capsys: pytest.CaptureFixture[str]) -> None:
    change()
    assert is_unchanged(capsys)


def test_a_change_of_the_library_is_noticed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write("other.yaml", "connector: Flange\n")
    library = {**cache.builtin_files(), "Flange": Path("other.yaml").resolve()}
    monkeypatch.setattr(cache, "builtin_files", lambda: library)
    assert "model is out of date: the library's Flange has changed" in messages_of(apc.load, MODEL)[0]
    assert not is_unchanged(capsys)


def test_what_another_program_compiled_is_compiled_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("apc.inputs.open_model", "apc.inputs.model_loading"):
        monkeypatch.setattr(f"{module}.program_digest", lambda: "other")
    monkeypatch.setattr(store, "decoded", lambda model: pytest.fail("it is read"))
    assert apc.load(MODEL).peers == 2
    assert not is_unchanged(capsys)


def test_the_program_is_every_module_of_the_compiler_and_the_version_of_casadi(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    digest = cache.program_digest.__wrapped__
    before = digest()
    with monkeypatch.context() as patch:
        patch.setattr(importlib.metadata, "version", lambda name: "0.0.0")
        assert digest() != before
    shutil.copytree(Path(cache.__file__).parent, "compiler")
    with monkeypatch.context() as patch:
        patch.setattr(cache, "__file__", str(Path("compiler/cache.py").resolve()))
        assert digest() == before
        write("compiler/signing.py", "# changed\n")
        assert digest() != before


def test_compiling_again_says_unchanged_and_force_compiles_to_the_same_bytes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = MODEL.read_bytes()
    capsys.readouterr()
    assert run(["compile"]) == 0
    assert capsys.readouterr().out == ("topology.yaml → topology.apc: up to date (--force compiles again)\n")
    assert run(["compile", "--force"]) == 0
    assert "unchanged" not in capsys.readouterr().out
    assert MODEL.read_bytes() == before


@pytest.mark.few(6)
@pytest.mark.parametrize(
    "put",
    [
        os.mkfifo,
        lambda name: Path(name).symlink_to("/dev/zero"),
        lambda name: Path(name).symlink_to("/proc/cpuinfo"),
    ],
    ids=["pipe", "device", "kernel"],
)
@pytest.mark.parametrize("name", ["users.csv", "parts/tie.yaml", "parts/more.yaml", "topology.apc"])
def test_what_is_no_file_is_not_read_and_is_a_change(name: str, put: Callable[[str], None]) -> None:
    """Who reads the pipe waits for ever, and who reads the device never ends."""
    Path(name).unlink(missing_ok=True)
    put(name)
    assert re_load() in ("E602", "E605")
    assert run(["analyze", "topology.yaml"]) == (0 if name == "topology.apc" else 1)


def re_load() -> str:
    return messages_of(apc.load, MODEL)[0].split()[1]


def test_a_folder_that_grew_is_not_walked_to_its_end_and_is_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MOST_ENTRIES", 0)
    assert "E605 model is out of date: parts/ has changed" in messages_of(apc.load, MODEL)[0]


def test_what_could_not_be_read_either_time_is_no_proof() -> None:
    archive = cache.read_archive(MODEL)
    assert cache.changed(archive, Path()) == ""
    texts = tuple((name, b"" if name == "./users.csv" else text) for name, text in archive.origin.texts)
    TABLE.unlink()
    repeated = replace(archive, origin=replace(archive.origin, texts=texts))
    assert cache.changed(repeated, Path()) == "users.csv"
