"""A compiled model from somebody else is data: opening it runs nothing, and it stands for no topology."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from apc.__main__ import run
from apc.compiler import cache, seal, store
from apc.compiler.cache import MEMBER, SEAL
from apc.inputs import load_fresh
from tests.fuzz.models import ask, packed, zipped
from tests.topologies import AVERAGE, ROOT, SCENES, compiled, replaced, told

MODEL = Path("scene.apc")
BY_NAME = ("analyze", "critical contact.stiffness", "simulate --duration 20ms --no-jit", "region")
BESIDE = ("analyze", "simulate --duration 20ms --no-jit", "compile")
# Any command that a file names leaves this behind.
PWNED = "PWNED"
JIT = {"jit": True, "compiler": "shell", "jit_options": {"compiler": f"echo > {PWNED}; cc", "verbose": False}}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "cache")
    return tmp_path


def opened() -> tuple[Any, dict[str, bytes]]:
    """Return the document and the arrays of the model."""
    with zipfile.ZipFile(MODEL) as archive:
        document = json.loads(archive.read(MEMBER))
        return document, {name: archive.read(name) for name in document["members"]}


def sealing() -> bytes:
    with zipfile.ZipFile(MODEL) as archive:
        return archive.read(SEAL)


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


def attacks(text: str) -> list[Callable[[Any, dict[str, bytes]], None]]:
    """Return ways to have a function of CasADi's read: what each does to a document and its members."""

    def of_the_old_format(document: Any, members: dict[str, bytes]) -> None:
        document["format"] = 5
        in_a_member(document, members)

    def in_a_member(document: Any, members: dict[str, bytes]) -> None:
        members["function0.casadi"] = text.encode()
        document["system"]["kinds"][0]["derivative"] = "function0.casadi"

    def in_place_of_a_function(document: Any, members: dict[str, bytes]) -> None:
        document["system"]["kinds"][0]["derivative"] = text

    def as_a_name(document: Any, members: dict[str, bytes]) -> None:
        document["system"]["kinds"][0]["derivative"]["name"] = text

    def as_an_operation(document: Any, members: dict[str, bytes]) -> None:
        document["system"]["kinds"][0]["derivative"]["operations"][0][0] = "call"

    def with_options(document: Any, members: dict[str, bytes]) -> None:
        document["system"]["kinds"][0]["derivative"]["options"] = JIT
        document["system"]["kinds"][0]["derivative"]["loops"] = [[JIT, JIT]]

    def as_a_library(document: Any, members: dict[str, bytes]) -> None:
        document["system"]["kinds"][0]["derivative"] = {"external": f"./{PWNED}.so", **JIT}

    return [
        of_the_old_format,
        in_a_member,
        in_place_of_a_function,
        as_a_name,
        as_an_operation,
        with_options,
        as_a_library,
    ]


@pytest.mark.parametrize("which", range(7))
@pytest.mark.parametrize("beside", [False, True])
def test_a_function_that_calls_a_command_is_never_read(
    which: int, beside: bool, serialized: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    store.save(compiled(AVERAGE), MODEL)
    document, members = opened()
    attacks(serialized)[which](document, members)
    MODEL.write_bytes(packed(document, members))
    if not beside:
        Path("scene.yaml").unlink()
    for command in BESIDE if beside else BY_NAME:
        words = [*command.split(), "scene.yaml" if beside else "scene.apc"]
        assert run(words) == (0 if beside else 1)
        error = capsys.readouterr().err
        assert beside or "scene.apc: E604 is damaged" in error or "scene.apc: E603 has format" in error
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


def forged_seal(document: Any, members: dict[str, bytes]) -> dict[str, bytes]:
    """Return the seal that the file had."""
    return {SEAL: sealing()}


def no_seal(document: Any, members: dict[str, bytes]) -> dict[str, bytes]:
    return {}


def digest_for_a_seal(document: Any, members: dict[str, bytes]) -> dict[str, bytes]:
    return {SEAL: hashlib.sha256(json.dumps(document).encode()).hexdigest().encode()}


@pytest.mark.parametrize("sealed", [forged_seal, no_seal, digest_for_a_seal])
def test_what_a_topology_says_is_never_taken_from_a_model_somebody_else_wrote(
    sealed: Callable[[Any, dict[str, bytes]], dict[str, bytes]], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["compile", "scene.yaml"]) == 0
    honest = MODEL.read_bytes()
    assert run(["analyze", "scene.yaml", "--json"]) == 0
    verdict = capsys.readouterr().out.partition("{")[2]
    document, members = opened()
    [stiffness] = [one for one in document["system"]["parameters"] if one["name"] == "contact.stiffness"]
    stiffness |= {"value": 9000.0, "exact": "9000"}
    mark = sealed(document, members)
    MODEL.write_bytes(zipped({MEMBER: json.dumps(document).encode(), **members, **mark}))
    assert run(["analyze", "scene.apc", "--json"]) == 0  # what the file says, as it is asked by its name
    assert capsys.readouterr().out.partition("{")[2] != verdict
    assert run(["analyze", "scene.yaml", "--json"]) == 0
    assert capsys.readouterr().out.partition("{")[2] == verdict
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


@pytest.mark.parametrize("topology", ["", ".", "..", "../scene.yaml", "/etc/passwd", "a/b", "x\0"])
def test_a_model_of_a_topology_elsewhere_is_refused(topology: str) -> None:
    store.save(compiled(AVERAGE), MODEL)
    document, members = opened()
    document["system"]["origin"]["topology"] = topology
    MODEL.write_bytes(packed(document, members))
    assert "E604 is damaged" in told(load_fresh, MODEL)[0]


def test_what_a_model_from_elsewhere_names_is_not_read(capsys: pytest.CaptureFixture[str]) -> None:
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["compile"]) == 0
    os.mkfifo("pipe")  # who reads it waits for ever
    document, members = opened()
    texts = document["system"]["origin"]["texts"]
    texts[:0] = [["./pipe", "0" * 64], ["/", "0" * 64], ["../", "0" * 64], ["/dev/zero", "0" * 64]]
    MODEL.write_bytes(packed(document, members))
    assert load_fresh(MODEL).peers == 3
    Path("scene.yaml").write_text(AVERAGE + "# changed\n", encoding="utf-8")
    assert "E605 is stale: scene.yaml has changed" in told(load_fresh, MODEL)[0]


# ---- names ----

# Of what is text in a model all but these is a name, or of a closed list of words.
TEXTS = {"about", "origin", "text", "unit", "units", "exact", "value", "formula"}


def names_in(value: Any) -> set[str]:
    """Return the names that a document holds."""
    if isinstance(value, dict):
        return set().union(*(names_in(one) for key, one in value.items() if key not in TEXTS))
    if isinstance(value, list):
        return set().union(*map(names_in, value))
    return {value} if isinstance(value, str) else set()


@pytest.mark.parametrize("scene", ["lossy-average", "limited-motor", "two-handed-tool", "planar-users"])
def test_a_model_with_a_name_that_no_topology_can_give_is_refused(scene: str) -> None:
    store.save(compiled((SCENES / f"{scene}.yaml").read_text(encoding="utf-8")), MODEL)
    document, members = opened()
    title = document["system"]["name"]
    text = json.dumps(document["system"])
    names = names_in(document["system"]) - {title}
    assert {"device.x" if scene == "lossy-average" else "peers", "haptic"} <= names
    for name in names:
        for other in (f"../{name}", f"/{name}", f"{name}*/", f"{name}'"):
            renamed = json.loads(text.replace(json.dumps(name), json.dumps(other)))
            MODEL.write_bytes(packed({**document, "system": renamed}, members))
            assert "E604 is damaged" in told(store.load, MODEL)[0], (name, other)
    system = {**document["system"], "name": f"../../{title}"}  # which is any text
    MODEL.write_bytes(packed({**document, "system": system}, members))
    assert store.load(MODEL).name == f"../../{title}"


# ---- numbers ----


def constants_in(value: Any) -> list[list[float]]:
    """Return the constants of every function in a document."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    own = [value["constants"]] if isinstance(value, dict) and "constants" in value else []
    return own + [found for one in inside for found in constants_in(one)]


def test_a_constant_without_a_value_is_told_of_or_of_no_account() -> None:
    """No topology has one; a file may have it in place of any."""
    hand = "hands: {hand: {type: SineForce, flange: device, force: 1 N, frequency: 3 Hz}}\n"
    store.save(compiled(AVERAGE + hand), MODEL)
    document, members = opened()
    for found in constants_in(document):
        for place, own in enumerate(found):
            found[place] = float("nan")
            MODEL.write_bytes(packed(document, members))
            assert ask(MODEL) in ("answered", "refused")
            found[place] = own


# ---- size ----


def damage(**members: bytes) -> str:
    MODEL.write_bytes(zipped({MEMBER: b"{}", **members}))
    return told(store.load, MODEL)[0]


@pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_file_that_is_packed_otherwise_is_refused_before_it_is_unpacked(kind: int) -> None:
    MODEL.write_bytes(zipped({MEMBER: b"{}" * 10}, kind=kind))
    assert "E604 is damaged: it is not what apc compile writes" in told(store.load, MODEL)[0]


@pytest.mark.parametrize("piece", [b"[],", b"{},", b"0,", b"[[["])
def test_a_document_of_more_values_than_a_model_has_is_refused_before_it_is_read(
    piece: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(json, "loads", lambda text: pytest.fail("it is read"))
    MODEL.write_bytes(zipped({MEMBER: b"[" + piece * cache.MOST_VALUES + b"0]"}))
    assert MODEL.stat().st_size < 10**6
    assert f"E604 is damaged: it holds more than {cache.MOST_VALUES} values" in told(store.load, MODEL)[0]


def test_a_function_larger_than_its_model_is_refused_before_it_is_built() -> None:
    store.save(compiled(AVERAGE), MODEL)
    document, members = opened()
    document["system"]["kinds"][0]["derivative"]["inputs"][0][1] = 10**12
    MODEL.write_bytes(packed(document, members))
    assert "E604 is damaged" in told(store.load, MODEL)[0]


def test_a_member_is_unpacked_as_far_as_the_archive_says_and_no_further() -> None:
    """The list of members says 2 bytes; what is packed is 64 MiB of zeros."""
    large = 64 << 20
    content = bytearray(zipped({MEMBER: bytes(large)}))
    at = content.index(large.to_bytes(4, "little"))
    while at >= 0:
        content[at : at + 4] = (2).to_bytes(4, "little")
        at = content.find(large.to_bytes(4, "little"))
    MODEL.write_bytes(content)
    tracemalloc.start()
    try:
        assert "E604 is damaged" in told(store.load, MODEL)[0]
        assert tracemalloc.get_traced_memory()[1] < large / 16
    finally:
        tracemalloc.stop()


def test_a_list_of_members_without_end_is_refused_before_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    store.save(compiled(AVERAGE), MODEL)
    monkeypatch.setattr(cache, "MOST_LISTED", 100)
    monkeypatch.setattr(zipfile.ZipFile, "__init__", lambda *_: pytest.fail("it is read"))
    assert "E604 is damaged: its list of members is larger" in told(store.load, MODEL)[0]


def before(content: bytes) -> bytes:
    return b"#!/bin/sh\n" + content


def after(content: bytes) -> bytes:
    return content + b"\0"


def as_a_comment(content: bytes) -> bytes:
    return content[:-2] + b"\x01\x00x"


def as_a_longer_end(content: bytes) -> bytes:
    """Say by the longer form that the list is elsewhere, in a comment of the list's last member."""
    end = struct.Struct("<4s4H2LH")
    mark, *numbers, size, begin, _ = end.unpack(content[-end.size :])
    entry = content.rindex(b"PK\x01\x02")
    longer = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, 1, 1, size, begin)
    longer += struct.pack("<4sLQL", b"PK\x06\x07", 0, begin + size, 1)
    listed = bytearray(content[: -end.size])
    listed[entry + 32 : entry + 34] = len(longer).to_bytes(2, "little")
    return bytes(listed) + longer + end.pack(mark, *numbers, size + len(longer), begin, 0)


def as_a_member(content: bytes) -> bytes:
    document, members = opened()
    return zipped({MEMBER: json.dumps(document).encode(), **members, "run.sh": b"#!/bin/sh\n"})


def as_a_field(content: bytes) -> bytes:
    document, members = opened()
    return packed({**document, "more": 1}, members)


def as_a_member_twice(content: bytes) -> bytes:
    buffer = io.BytesIO(content)
    with zipfile.ZipFile(buffer, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr(MEMBER, archive.read(MEMBER))
    return buffer.getvalue()


@pytest.mark.parametrize(
    "add", [before, after, as_a_comment, as_a_longer_end, as_a_field, as_a_member, as_a_member_twice]
)
def test_a_file_that_holds_something_else_too_is_refused(add: Callable[[bytes], bytes]) -> None:
    store.save(compiled(AVERAGE), MODEL)
    MODEL.write_bytes(add(MODEL.read_bytes()))
    assert told(store.load, MODEL) == [
        "scene.apc: E604 is damaged: it is not what apc compile writes. Write: apc compile scene.yaml"
    ]


def units_of(document: Any) -> dict[str, list[tuple[Any, Any]]]:
    """Return where a document has units, by what has them: what holds each, and where in that."""
    system = document["system"]
    [kind] = system["kinds"]
    return {
        "parameter": [(one, "unit") for one in system["parameters"]],
        "value": [(one, "unit") for group in system["groups"] for one in group["values"]],
        "state": [(one, "unit") for one in kind["states"]],
        "output": [(part["units"], k) for part in kind["clocks"] for k in range(len(part["units"]))],
        "sent": [(part["units"], k) for part in kind["sends"] for k in range(len(part["units"]))],
    }


@pytest.mark.parametrize("unit", ["mm", "parsec", "", "N N", "m^", "kg*m/s^2*", "\x1b[31m"])
@pytest.mark.parametrize("of", ["parameter", "value", "state", "output", "sent"])
def test_a_number_in_a_unit_that_is_not_of_si_is_refused(of: str, unit: str) -> None:
    """Every number of a model is in SI: beside another unit it would be a wrong one."""
    groups = ("user: {count: 3}", "user: {count: 3, set: {device.mass: 0.2 kg}}")
    store.save(compiled(replaced(AVERAGE, groups)), MODEL)
    document, members = opened()
    for holder, key in units_of(document)[of]:
        before, holder[key] = holder[key], unit
        MODEL.write_bytes(packed(document, members))
        assert "E604 is damaged" in told(store.load, MODEL)[0]
        holder[key] = before
    MODEL.write_bytes(packed(document, members))
    assert store.load(MODEL).peers == 3


@pytest.mark.parametrize("of", ["value", "state"])
def test_a_number_of_two_units_is_refused(of: str) -> None:
    groups = ("user: {count: 3}", "user: {count: 3, set: {device.mass: 0.2 kg}}")
    store.save(compiled(replaced(AVERAGE, groups)), MODEL)
    document, members = opened()
    holder, key = units_of(document)[of][0]
    holder[key] = "A"
    MODEL.write_bytes(packed(document, members))
    assert "E604 is damaged" in told(store.load, MODEL)[0]


def test_an_honest_model_packed_anew_is_read() -> None:
    """What the tests above change is what is refused, not how they write it."""
    store.save(compiled(replaced(AVERAGE, ("count: 3", "count: 4"))), MODEL)
    MODEL.write_bytes(packed(*opened()))
    assert store.load(MODEL).peers == 4
