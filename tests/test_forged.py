"""A compiled model from somebody else is its texts: these are compiled, and nothing else in it is read."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import apc
from apc.__main__ import run
from apc.compiler import cache, seal, store
from apc.inputs import load_fresh
from tests.topologies import AVERAGE, ROOT, compiled, replaced, told

MODEL = Path("scene.apc")
BY_NAME = ("analyze", "critical contact.stiffness", "simulate --duration 20ms --no-jit")
BESIDE = ("analyze", "simulate --duration 20ms --no-jit", "compile")
# Any command that a file names leaves this behind.
PWNED = "PWNED"
JIT = {"jit": True, "compiler": "shell", "jit_options": {"compiler": f"echo > {PWNED}; cc", "verbose": False}}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "cache")
    return tmp_path


def lines_of(path: Path = MODEL) -> list[bytes]:
    """Return the head, the seal, the origin and the model of a file."""
    return path.read_bytes().split(b"\n", 3)


def write(*lines: bytes) -> None:
    MODEL.write_bytes(b"\n".join(lines))


def edited(**fields: Any) -> None:
    """Change fields of what the model says it was made from, leaving its seal as it was."""
    head, mark, origin, model = lines_of()
    write(head, mark, json.dumps({**json.loads(origin), **fields}).encode(), model)


# ---- code in a file ----


@pytest.fixture(scope="module")
def serialized(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a function in CasADi's serialization that calls a command when CasADi reads it."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler, without which CasADi makes no such function")
    where = tmp_path_factory.mktemp("made")
    make = (
        "import casadi, sys\n"
        "x, u, p, t = (casadi.SX.sym(*one) for one in (('x', 4), ('u', 2), ('p', 9), ('t', 1)))\n"
        f"f = casadi.Function('derivative', [x, u, p, t], [-x], ['x', 'u', 'p', 't'], ['dx'], {JIT!r})\n"
        "open('function', 'w').write(f.serialize())\n"
    )
    subprocess.run([sys.executable, "-c", make], cwd=where, check=True, capture_output=True)
    (where / PWNED).unlink()
    read = "import casadi\ncasadi.Function.deserialize(open('function').read())"
    subprocess.run([sys.executable, "-c", read], cwd=where, check=True, capture_output=True)
    assert (where / PWNED).exists(), "the attack is none"
    return (where / "function").read_text(encoding="utf-8")


def old_seal(content: bytes) -> bytes:
    """Return the seal that the file had."""
    return lines_of()[1]


def no_seal(content: bytes) -> bytes:
    return b""


def digest_for_a_seal(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


@pytest.mark.parametrize("sealed", [old_seal, no_seal, digest_for_a_seal])
@pytest.mark.parametrize("beside", [False, True])
def test_a_function_that_calls_a_command_is_never_read(
    beside: bool, sealed: Callable[[bytes], bytes], serialized: str
) -> None:
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["compile"]) == 0
    head, _, origin, model = lines_of()
    function = apc.load(MODEL).kinds[0].derivative.serialize().encode()
    assert function in model
    forged = model.replace(function, serialized.encode())
    write(head, sealed(b"\n".join((head, origin, forged))), origin, forged)
    if not beside:
        Path("scene.yaml").unlink()
    for command in BESIDE if beside else BY_NAME:
        assert run([*command.split(), "scene.yaml" if beside else "scene.apc"]) == 0
        assert not list(Path().rglob(f"{PWNED}*"))


def test_forged_files_of_every_sort_do_nothing_else_and_end() -> None:
    """Each is opened and asked in a process that notes commands, libraries, sockets and files written.

    Here a dozen; thousands are `python -m tests.fuzz --inputs 0 --models 5000`.
    """
    counts = ("--models", "12", "--recordings", "12", "--parts", "12")
    command = [sys.executable, "-m", "tests.fuzz", "--inputs", "0", *counts, "--seed", "7"]
    ran = subprocess.run(
        [*command, "--out", str(Path.cwd() / "failures")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    for what in ("models", "recordings", "parts"):
        assert f"12 forged {what}" in ran.stdout


# ---- what stands for a topology ----


@pytest.mark.parametrize("sealed", [old_seal, no_seal, digest_for_a_seal])
def test_what_a_topology_says_is_never_taken_from_a_model_somebody_else_wrote(
    sealed: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("scene.yaml").write_text(replaced(AVERAGE, ("1000 N/m", "9000 N/m")), encoding="utf-8")
    assert run(["compile", "scene.yaml"]) == 0
    other = lines_of()[3]
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["compile", "scene.yaml"]) == 0
    honest = MODEL.read_bytes()
    assert run(["analyze", "scene.yaml", "--json"]) == 0
    verdict = capsys.readouterr().out.partition("{")[2]
    head, _, origin, _ = lines_of()
    write(head, sealed(b"\n".join((head, origin, other))), origin, other)
    for file in ("scene.apc", "scene.yaml"):
        assert run(["analyze", file, "--json"]) == 0
        assert capsys.readouterr().out.partition("{")[2] == verdict, "its texts decide"
    assert run(["compile", "scene.yaml"]) == 0
    assert "unchanged" not in capsys.readouterr().out
    assert MODEL.read_bytes() == honest


def test_a_model_of_another_user_is_compiled_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["compile"]) == 0
    assert run(["compile"]) == 0
    assert "unchanged" in capsys.readouterr().out
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "other")
    assert run(["compile"]) == 0
    assert "unchanged" not in capsys.readouterr().out


def test_without_a_folder_of_ones_own_everything_is_compiled_and_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "file" / "cache")
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    for _ in range(2):
        assert run(["compile"]) == 0
        assert "unchanged" not in capsys.readouterr().out
    assert run(["analyze", "scene.apc"]) == 0


# ---- a model by itself ----

PART = """\
component: Tie
about: A spring to where the device is at rest.
connectors: {flange: Flange}
parameters: {stiffness: {unit: N/m, min: 0}}
equations: [flange.f = stiffness*flange.x]
"""
OWN = """\
topology: scene
library: [parts, ../shared]
peers: {user: {table: users.csv}}
masses: {device: {mass: 1 kg, damping: 2 N*s/m}}
couplers:
  tie: {type: Tie, flange: device, stiffness: 3 N/m}
  more: {type: Other, flange: device, stiffness: 3 N/m}
"""


def made(tmp_path: Path) -> Path:
    """Compile a scene with tables and components of its own; return its model, moved elsewhere."""
    home = tmp_path / "home" / "scenes"
    (home / "parts" / "deep").mkdir(parents=True)
    (home.parent / "shared").mkdir()
    (home / "parts" / "deep" / "tie.yaml").write_text(PART, encoding="utf-8")
    (home.parent / "shared" / "other.yaml").write_text(PART.replace("Tie", "Other"), encoding="utf-8")
    (home / "users.csv").write_text("device.mass [kg]\n1\n2\n", encoding="utf-8")
    (home / "scene.yaml").write_text(OWN, encoding="utf-8")
    assert run(["compile", str(home / "scene.yaml")]) == 0
    shutil.copy(home / "scene.apc", MODEL)
    shutil.rmtree(home.parent)
    return MODEL


def test_a_model_of_somebody_else_needs_no_file_beside_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    expected = store.encoded(load_fresh(made(tmp_path)))
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "other")
    monkeypatch.setattr(store, "decoded", lambda model: pytest.fail("it is read"))
    assert store.encoded(load_fresh(MODEL)) == expected


def test_the_librarys_definitions_are_those_that_it_was_made_from(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    expected = store.encoded(load_fresh(made(tmp_path)))
    changed = tmp_path / "mass.yaml"
    changed.write_text("component: Mass\nabout: Nothing.\n", encoding="utf-8")
    library = {**cache.builtin_files(), "Mass": changed}
    monkeypatch.setattr("apc.compiler.components.library.builtin_files", lambda: library)
    monkeypatch.setattr(cache, "builtin_files", lambda: library)
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "other")
    assert store.encoded(load_fresh(MODEL)) == expected


@pytest.mark.parametrize(
    "change",
    [
        lambda system: apc.set_parameters(system, {"contact.stiffness": "800 N/m", "lan.delay": "5/3 ms"}),
        lambda system: apc.set_parameters(apc.with_hands(system, "held"), {"hand.stiffness": "0.1 N/mm"}),
        lambda system: apc.with_hands(apc.set_parameters(system, {"user.count": "5"}), "StylusArmForward"),
        lambda system: apc.with_hands(system, "clamped"),
    ],
)
def test_what_was_changed_before_it_was_saved_is_changed_again(
    change: Callable[[Any], Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    system = change(apc.compile("scene.yaml"))
    apc.save(system, MODEL)
    assert store.encoded(apc.load(MODEL)) == store.encoded(system)
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "other")
    assert store.encoded(apc.load(MODEL)) == store.encoded(system)


@pytest.mark.parametrize(
    "change",
    [
        *([["contact.stiffness", "1e99999999"]], [["contact.stiffness", "1/0"]], [["no", "1"]]),
        *([["hands", "no"]], [["peers", "3"]], [["contact.stiffness", "-1"]], [["lan.delay", "9" * 5000]]),
    ],
)
def test_a_change_that_can_be_none_is_refused(change: list[list[str]]) -> None:
    store.save(compiled(AVERAGE), MODEL)
    edited(changes=[change])
    assert told(load_fresh, MODEL)


@pytest.mark.parametrize("topology", ["", ".", "..", "../scene.yaml", "/etc/passwd", "a/b", "x\0"])
def test_a_model_of_a_topology_elsewhere_is_refused(topology: str) -> None:
    store.save(compiled(AVERAGE), MODEL)
    edited(topology=topology)
    assert "E604 is damaged" in told(load_fresh, MODEL)[0]


def test_what_a_model_from_elsewhere_names_is_not_read(capsys: pytest.CaptureFixture[str]) -> None:
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["compile"]) == 0
    os.mkfifo("pipe")  # who reads it waits for ever
    texts = json.loads(lines_of()[2])["texts"]
    edited(texts=[["./pipe", ""], ["/", ""], ["../", ""], ["/dev/zero", ""], *texts])
    assert load_fresh(MODEL).peers == 3
    Path("scene.yaml").write_text(AVERAGE + "# changed\n", encoding="utf-8")
    assert "E605 is stale: scene.yaml has changed" in told(load_fresh, MODEL)[0]


@pytest.mark.parametrize("where", ["secret.csv", "../secret.csv", "{}/secret.csv"])
def test_its_texts_read_no_file_of_this_machine(where: str, tmp_path: Path) -> None:
    """What a topology names that is not in the model is not there, whatever stands in the folder."""
    (tmp_path / "scenes").mkdir()
    for place in (tmp_path, tmp_path / "scenes"):
        (place / "secret.csv").write_text("device.mass [kg]\n1\n2\n", encoding="utf-8")
    os.chdir(tmp_path / "scenes")
    store.save(compiled(AVERAGE), MODEL)
    text = replaced(AVERAGE, ("count: 3", f"table: {where.format(tmp_path)}"))
    edited(texts=[["scene.yaml", __import__("base64").b64encode(text.encode()).decode()]])
    [line] = told(load_fresh, MODEL)
    assert line.startswith("scene.yaml:") and "secret.csv does not exist" in line


def test_a_mistake_in_the_texts_of_somebody_else_is_told_at_its_place(tmp_path: Path) -> None:
    store.save(compiled(AVERAGE), MODEL)
    text = replaced(AVERAGE, ("1000 N/m", "1000 N"))
    edited(texts=[["scene.yaml", __import__("base64").b64encode(text.encode()).decode()]])
    [line] = told(load_fresh, MODEL)
    assert line.startswith("scene.yaml:") and "E204" in line
