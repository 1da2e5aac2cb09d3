"""A compiled model from elsewhere is refused, or compiled again from its texts; nothing in it is ever run.

Files are forged as whoever forges them would: every digest in them is that of what it stands for.
"""

from __future__ import annotations

import functools
import hashlib
import io
import itertools
import json
import math
import os
import re
import shutil
import stat
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import apc
from apc.__main__ import run
from tests.fuzz.models import zipped
from tests.topologies import AVERAGE, ROOT, replaced, told

SCENE, MODEL = Path("scene.yaml"), Path("scene.apc")
SCENES = {
    "paper": AVERAGE,
    "channels": replaced(
        AVERAGE,
        ("user: {count: 3}", "user: {count: 3, set: {device.mass: 0.2 kg}}"),
        ("delay: 8 ms}", "delay: 8 ms, loss: 2 %}"),
    ),
}
OTHER = replaced(AVERAGE, ("1000 N/m", "9000 N/m"))
# Any command that a file names leaves this behind.
PWNED = "PWNED"
JIT = {"jit": True, "compiler": "shell", "jit_options": {"compiler": f"echo > {PWNED}; cc", "verbose": False}}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "scenes").mkdir()
    monkeypatch.chdir(tmp_path / "scenes")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


Members = dict[str, bytes]


@functools.cache
def written(scene: str) -> bytes:
    """Return the file that `apc compile` writes of a scene."""
    SCENE.write_text(SCENES[scene], encoding="utf-8")
    assert run(["compile", "scene.yaml", "--force"]) == 0
    content = MODEL.read_bytes()
    SCENE.unlink()
    MODEL.unlink()
    return content


@functools.cache
def honest(scene: str) -> str:
    MODEL.write_bytes(written(scene))
    return outcome()


def members_of(content: bytes) -> Members:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def documents(members: Members) -> list[str]:
    """Return the names of the members that are JSON."""
    return [name for name, content in members.items() if content.startswith(b"{")]


def put(members: Members, name: str, content: bytes) -> None:
    """Change a member, and every digest of it in the others."""
    before = hashlib.sha256(members.get(name, b"")).hexdigest().encode()
    for other in documents(members):
        members[other] = members[other].replace(before, hashlib.sha256(content).hexdigest().encode())
    members[name] = content


def outcome() -> str:
    """Open the model by its name: return "refused", or what is answered with every digit."""
    if words := told(apc.load, MODEL):
        assert re.match(r"scene\.apc: E60[2-5] ", words[0]), words
        return "refused"
    answer = apc.analyze(MODEL)
    return json.dumps([answer.topology, answer.verdict, answer.spectral_radius])


# ---- code in a file ----


@pytest.fixture(scope="module")
def serialized(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a function in CasADi's serialization that calls a command when CasADi reads it."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler, without which CasADi makes no such function")
    where = tmp_path_factory.mktemp("made")
    make = (
        "import casadi, os, sys\n"
        "x, u, p, t = (casadi.SX.sym(*one) for one in (('x', 4), ('u', 2), ('p', 9), ('t', 1)))\n"
        f"f = casadi.Function('derivative', [x, u, p, t], [-x], ['x', 'u', 'p', 't'], ['dx'], {JIT!r})\n"
        "open('function', 'w').write(f.serialize())\n"
        f"os.unlink({PWNED!r})\n"
        "casadi.Function.deserialize(open('function').read())\n"
    )
    subprocess.run([sys.executable, "-c", make], cwd=where, check=True, capture_output=True)
    assert (where / PWNED).exists(), "the attack is none"
    return (where / "function").read_text(encoding="utf-8")


Place = tuple[Any, Any]


def places(value: Any, path: str = "") -> Iterator[tuple[str, Place]]:
    """Yield every place of a document, what holds it and where in that; its path is without numbers."""
    for key, one in value.items() if isinstance(value, dict) else enumerate(value):
        inner = f"{path}.{key if isinstance(value, dict) else ''}"
        yield inner, (value, key)
        if isinstance(one, (dict, list)):
            yield from places(one, inner)


def forgeries(members: Members, *values: Any) -> Iterator[tuple[str, Members]]:
    """Yield models with one place of a document changed, each sort of place once for every value in turn."""
    for name in documents(members):
        document = json.loads(members[name])
        sorts = dict(places(document))
        for (path, (holder, key)), value in zip(sorts.items(), itertools.cycle(values), strict=False):
            before, holder[key] = holder[key], value
            yield path, {**members, name: json.dumps(document).encode()}
            holder[key] = before


@pytest.mark.parametrize("beside", [False, True], ids=["by its name", "beside its topology"])
def test_a_function_that_calls_a_command_is_never_read(
    beside: bool, serialized: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In place of each member, as one more, and anywhere in a document."""
    members = members_of(written("paper"))
    forged = forgeries(members, serialized, {"external": f"./{PWNED}.so", **JIT})
    attacks = [content for path, content in forged if not path.endswith("origin.topology")]
    attacks = attacks[::20] if beside else attacks  # of which nothing is even looked at
    for name in (*members, "function0.casadi"):
        attacks.append({**members})
        put(attacks[-1], name, serialized.encode())
    words = "scene.yaml" if beside else "scene.apc"
    if beside:
        SCENE.write_text(AVERAGE, encoding="utf-8")
    commands = ("analyze", "critical contact.stiffness", "simulate --duration 20ms --no-jit")
    for attack, command in zip(attacks, itertools.cycle(commands), strict=False):
        MODEL.write_bytes(zipped(attack))
        code = run([*command.split(), words])
        assert code == 0 if beside else code in (0, 1)
        assert not list(Path().rglob(f"{PWNED}*"))
    assert "bug" not in capsys.readouterr().err


HOSTILE = (None, -1, 10**18, 10**400, math.nan, math.inf, "", "../../x", "9" * 5000, [], {}, [[0]], True)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("turn", [0, pytest.param(5, marks=pytest.mark.whole)])
def test_a_forged_document_ends_in_words(scene: str, turn: int) -> None:
    """Each sort of place with another hostile value: what is no model is refused, and nothing else raised."""
    values = (*HOSTILE[turn:], *HOSTILE[:turn])
    refusals = 0
    for path, members in forgeries(members_of(written(scene)), *values):
        MODEL.write_bytes(zipped(members))
        words = told(apc.load, MODEL)
        assert not words or re.match(r"scene\.apc: E60[2-5] ", words[0]), (path, words)
        refusals += bool(words)
    assert refusals > 20


@pytest.mark.whole
def test_forged_files_of_every_sort_do_nothing_else_and_end() -> None:
    """Each is opened and asked in a process that notes commands, libraries, sockets and files written."""
    counts = ("--models", "40", "--recordings", "40", "--parts", "40")
    command = [sys.executable, "-m", "tests.fuzz", "--inputs", "0", *counts, "--seed", "7"]
    command += ["--out", str(Path.cwd() / "failures")]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr


NAMES = ("device.x", "haptic", "lan", "contact.stiffness", "coordination.f")


@pytest.mark.few(7)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("other", ["../{}", "/{}", "{}*/", "{}'"])
def test_a_model_with_a_name_that_no_topology_can_give_is_refused(name: str, other: str) -> None:
    members = members_of(written("channels"))
    old, new = (json.dumps(one).encode() for one in (name, other.format(name)))
    for document in documents(members):
        members[document] = members[document].replace(old, new)
    MODEL.write_bytes(zipped(members))
    assert outcome() in ("refused", honest("channels"))


@pytest.mark.few(10)
@pytest.mark.parametrize("unit", ["mm", "parsec", "", "N N", "m^", "kg*m/s^2*", "A", "\x1b[31m"])
@pytest.mark.parametrize("own", ["N/m", "kg", "m", "m/s"])
def test_a_number_in_another_unit_than_its_own_is_refused(own: str, unit: str) -> None:
    """Every number of a model is in SI: beside another unit it would be a wrong one."""
    members = members_of(written("channels"))
    for name in documents(members):
        text = members[name].decode().replace(json.dumps(own), json.dumps(unit), 1)
        MODEL.write_bytes(zipped({**members, name: text.encode()}))
        assert outcome() in ("refused", honest("channels"))


# A name that no file can have is looked for all the same.
LONG = pytest.param("n" * 300, marks=pytest.mark.xfail(raises=OSError))


@pytest.mark.parametrize("topology", ["", ".", "..", "../scene.yaml", "/etc/passwd", "a/b", "x\0", LONG])
def test_a_model_of_a_topology_elsewhere_is_refused(topology: str) -> None:
    members = members_of(written("paper"))
    for name in documents(members):
        members[name] = members[name].replace(b'"scene.yaml"', json.dumps(topology).encode())
    MODEL.write_bytes(zipped(members))
    assert outcome() == "refused"


@pytest.mark.parametrize("name", ["./pipe", "/", "../", "/dev/zero", "/etc/passwd"])
def test_what_a_model_from_elsewhere_names_is_not_read(name: str) -> None:
    """Who reads the pipe waits for ever."""
    Path("users.csv").write_text("device.mass [kg]\n0.1\n0.2\n", encoding="utf-8")
    SCENE.write_text(replaced(AVERAGE, ("{count: 3}", "{table: users.csv}")), encoding="utf-8")
    assert run(["compile"]) == 0
    os.mkfifo("pipe")
    members = members_of(MODEL.read_bytes())
    for document in documents(members):
        members[document] = members[document].replace(b'"./users.csv"', json.dumps(name).encode())
    MODEL.write_bytes(zipped(members))
    outcome()
    SCENE.write_text(AVERAGE, encoding="utf-8")
    assert "E60" in told(apc.load, MODEL)[0]


# ---- what stands for a topology ----


def unchanged(capsys: pytest.CaptureFixture[str]) -> bool:
    """Compile the scene; return whether what was compiled already was good enough."""
    capsys.readouterr()
    assert run(["compile", "scene.yaml"]) == 0
    return "unchanged" in capsys.readouterr().out


@pytest.mark.parametrize("mark", ["theirs", "mine", "a digest", "none"])
def test_what_a_topology_says_is_never_taken_from_a_model_somebody_else_wrote(
    mark: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Theirs is of another topology, and says that it was made of this one."""
    with monkeypatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "theirs"))
        SCENE.write_text(OTHER, encoding="utf-8")
        assert run(["compile", "scene.yaml"]) == 0
        members = members_of(MODEL.read_bytes())
    SCENE.write_text(AVERAGE, encoding="utf-8")
    assert not unchanged(capsys)
    assert unchanged(capsys)
    mine = MODEL.read_bytes()
    radius = json.loads(honest_answer(capsys))["spectral_radius"]
    old, new = (hashlib.sha256(text.encode()).hexdigest().encode() for text in (OTHER, AVERAGE))
    inside = {json.dumps(OTHER).encode()[1:-1]: json.dumps(AVERAGE).encode()[1:-1], old: new}
    for name, (before, after) in itertools.product(documents(members), inside.items()):
        members[name] = members[name].replace(before, after)
    digest = hashlib.sha256(b"".join(members.values())).hexdigest().encode()
    marks = {"mine": members_of(mine).get("seal", b""), "a digest": digest, "none": b""}
    members["seal"] = marks.get(mark, members["seal"])
    MODEL.write_bytes(zipped({name: members[name] for name in members if name != "seal" or members[name]}))
    assert outcome() != "refused", "by its name it is opened"
    assert json.loads(honest_answer(capsys))["spectral_radius"] == radius
    assert not unchanged(capsys)
    assert MODEL.read_bytes() == mine


def honest_answer(capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert run(["analyze", "scene.yaml", "--json"]) == 0
    return capsys.readouterr().out


def elsewhere(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Be another user."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache.parent / "other"))


def no_folder(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(cache)
    cache.write_text("a file", encoding="utf-8")


def linked(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cache / "apc").rename(cache / "moved")
    (cache / "apc").symlink_to("moved")


def somebody_elses(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: mine + 1)


def forgotten(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(cache)


def short(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (cache / "apc").iterdir():
        path.write_bytes(b"known")


def readable(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (cache / "apc").iterdir():
        path.chmod(0o644)
    (cache / "apc").chmod(0o755)


@pytest.mark.parametrize(
    ("happens", "again"),
    [
        (elsewhere, True),
        (forgotten, True),
        (short, True),
        (readable, True),
        (no_folder, False),
        (linked, False),
        (somebody_elses, False),
    ],
)
def test_what_was_compiled_serves_this_user_alone(
    happens: Callable[[Path, pytest.MonkeyPatch], None],
    again: bool,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Without a folder of one's own, or with a secret that others may know, all is compiled again."""
    SCENE.write_text(AVERAGE, encoding="utf-8")
    assert not unchanged(capsys)
    assert unchanged(capsys)
    content = MODEL.read_bytes()
    happens(folder / "cache", monkeypatch)
    with monkeypatch.context() as patch:  # after which the secret is looked for again, as by a new process
        patch.setenv("XDG_CACHE_HOME", str(folder / "third"))
        assert not unchanged(capsys)
    MODEL.write_bytes(content)
    assert not unchanged(capsys)
    assert unchanged(capsys) is again
    assert run(["analyze", "scene.apc"]) == 0
    if again:
        mine = Path(os.environ["XDG_CACHE_HOME"]) / "apc"
        assert [stat.S_IMODE(path.stat().st_mode) for path in (mine, *mine.iterdir())] == [0o700, 0o600]


# ---- damage ----


@pytest.mark.parametrize(
    "content", [b"", b"garbage", b"PK\x05\x06" + 18 * b"\0", zipped({"model.json": b"{}"})]
)
def test_what_is_no_model_is_refused_and_beside_its_topology_passed_over(
    content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    MODEL.write_bytes(content)
    assert outcome() == "refused"
    SCENE.write_text(AVERAGE, encoding="utf-8")
    assert run(["analyze", "scene.yaml"]) == 0
    assert not unchanged(capsys)


def test_another_version_of_the_format_is_refused_by_number() -> None:
    members = members_of(written("paper"))
    (name,) = documents(members)
    document = json.loads(members[name])
    MODEL.write_bytes(zipped({**members, name: json.dumps({**document, "format": 99}).encode()}))
    [words] = told(apc.load, MODEL)
    assert words.startswith("scene.apc: E603 has format version 99, this program reads version ")
    assert words.endswith("Write: apc compile scene.yaml")


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(place=st.floats(0, 1, exclude_max=True), byte=st.integers(0, 255), cut=st.booleans())
def test_a_byte_changed_or_an_end_cut_off_is_refused_or_harmless(place: float, byte: int, cut: bool) -> None:
    data = written("paper")
    at = int(place * len(data))
    MODEL.write_bytes(data[:at] if cut else data[:at] + bytes([byte]) + data[at + 1 :])
    assert outcome() in ("refused", honest("paper"))


def as_a_member_twice(content: bytes) -> bytes:
    buffer = io.BytesIO(content)
    name, text = next(iter(members_of(content).items()))
    with zipfile.ZipFile(buffer, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr(name, text)
    return buffer.getvalue()


WITH_MORE: dict[str, Callable[[bytes], bytes]] = {
    "before it": lambda content: b"#!/bin/sh\n" + content,
    "after it": lambda content: content + b"\0",
    "as a comment": lambda content: content[:-2] + b"\x01\x00x",
    "as a member": lambda content: zipped(members_of(content) | {"run.sh": b"#!/bin/sh\n"}),
    "as a member twice": as_a_member_twice,
}


@pytest.mark.parametrize("where", WITH_MORE)
def test_a_file_that_holds_something_else_too_is_refused(where: str) -> None:
    MODEL.write_bytes(WITH_MORE[where](written("paper")))
    message = "scene.apc: E604 is damaged: it is not what apc compile writes. Write: apc compile scene.yaml"
    assert told(apc.load, MODEL) == [message]


# ---- size ----


@pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_file_that_is_packed_otherwise_is_refused_before_it_is_unpacked(kind: int) -> None:
    MODEL.write_bytes(zipped(members_of(written("paper")), kind=kind))
    assert "E604 is damaged: it is not what apc compile writes" in told(apc.load, MODEL)[0]


@pytest.mark.parametrize("piece", [b"[],", b"{},", b"0,", b"[[["])
def test_a_document_of_more_values_than_a_model_has_is_refused_before_it_is_read(
    piece: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    members = members_of(written("paper"))
    (name,) = documents(members)
    MODEL.write_bytes(zipped({**members, name: b'{"a": [' + piece * 2**22 + b"0]}"}))
    monkeypatch.setattr(json, "loads", lambda text: pytest.fail("it is read"))
    assert "E604 is damaged: it holds more than " in told(apc.load, MODEL)[0]


@pytest.mark.parametrize(("says", "words"), [(2, ""), (1 << 29, "it unpacks to more than 256 MiB")])
def test_a_member_is_unpacked_as_far_as_the_archive_says_and_no_further(says: int, words: str) -> None:
    """What is packed is 64 MiB of zeros; the list of members says less, or more than any model has."""
    large = 64 << 20
    (name,) = documents(members_of(written("paper")))
    content = zipped({name: bytes(large)}).replace(large.to_bytes(4, "little"), says.to_bytes(4, "little"))
    MODEL.write_bytes(content)
    tracemalloc.start()
    try:
        [message] = told(apc.load, MODEL)
        assert "E604 is damaged" in message and words in message
        assert tracemalloc.get_traced_memory()[1] < large / 16
    finally:
        tracemalloc.stop()


def test_a_list_of_members_without_end_is_refused_before_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    MODEL.write_bytes(zipped({f"{number}{'n' * 60_000}": b"" for number in range(80)}))
    monkeypatch.setattr(zipfile.ZipFile, "__init__", lambda *_: pytest.fail("it is read"))
    assert "E604 is damaged: its list of members is larger" in told(apc.load, MODEL)[0]


def test_what_is_not_there_or_a_folder_is_told() -> None:
    assert told(apc.load, "gone.apc") == ["gone.apc: E602 does not exist. Write: apc compile"]
    Path("folder.apc").mkdir()
    assert told(apc.load, "folder.apc") == ["folder.apc: E602 is a folder, not a compiled model."]
    model = apc.compile(ROOT / "models" / "scenes" / "three-users-average.yaml")
    assert told(apc.save, model, "no/scene.apc") == [
        "no/scene.apc: E601 can't be written: No such file or directory."
    ]
    assert "E601 can't be written" in told(apc.save, model, "folder.apc")[0]
    assert [path.name for path in Path().iterdir()] == ["folder.apc"]
