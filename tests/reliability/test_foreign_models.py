"""A compiled model from elsewhere is its texts: they are compiled again, and nothing else in it is read."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import apc
from apc.__main__ import run
from apc.compiler import cache, signing, store
from apc.compiler.compiled import Model
from tests.commands import write
from tests.reliability.test_unchanged_topologies import PART, TEXT
from tests.topologies import AVERAGE, ROOT, compiled, messages_of, replaced

Other = Callable[[], Model]
MODEL = Path("topology.apc")
OTHER = replaced(AVERAGE, ("1000 N/m", "9000 N/m"))
DAMAGED = r"topology\.apc: E604 is damaged, or was not written by apc compile\. "
# Makes a function that calls a command when CasADi reads it, and reads it: the command leaves PWNED behind.
ATTACK = """\
import casadi, os
shell = {"compiler": "echo > PWNED; cc", "verbose": False}
options = {"jit": True, "compiler": "shell", "jit_options": shell}
x, u, p, t = (casadi.SX.sym(name, size) for name, size in (("x", 4), ("u", 2), ("p", 9), ("t", 1)))
f = casadi.Function("derivative", [x, u, p, t], [-x], ["x", "u", "p", "t"], ["dx"], options)
open("function", "w").write(f.serialize())
os.unlink("PWNED")
casadi.Function.deserialize(open("function").read())
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "topologies").mkdir()
    monkeypatch.chdir(tmp_path / "topologies")
    monkeypatch.setattr(signing, "_folder", lambda: tmp_path / "cache")
    return tmp_path


@pytest.fixture
def other(monkeypatch: pytest.MonkeyPatch) -> Other:
    """Return what loads the model as another user, who reads none: what is opened was compiled."""

    def load() -> Model:
        monkeypatch.setattr(signing, "_folder", lambda: Path("../theirs").resolve())
        monkeypatch.setattr(store, "decoded", lambda model: pytest.fail("it is read"))
        return apc.load(MODEL)

    return load


def lines_of(content: bytes) -> list[bytes]:
    """Return the head, the seal, the origin and the model of a file."""
    return content.split(b"\n", 3)


def forge(text: tuple[str, bytes], **fields: Any) -> None:
    """Write a model that says otherwise what it was made from, with nothing in the place of the model."""
    origin = compiled(AVERAGE).origin
    texts = (*origin.texts, text)
    MODEL.write_bytes(cache.packed(replace(origin, texts=texts, **fields), b"", compiled=True))


def unchanged(capsys: pytest.CaptureFixture[str]) -> bool:
    """Compile the topology; return whether what was compiled already was good enough."""
    capsys.readouterr()
    assert run(["compile", "topology.yaml"]) == 0
    return "up to date" in capsys.readouterr().out


@pytest.fixture(scope="module")
def serialized(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return a function in CasADi's serialization that calls a command when CasADi reads it."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler, without which CasADi makes no such function")
    where = tmp_path_factory.mktemp("made")
    subprocess.run([sys.executable, "-c", ATTACK], cwd=where, check=True, capture_output=True)
    assert (where / "PWNED").exists(), "the attack is none"
    return (where / "function").read_bytes()


@pytest.mark.whole
def test_forged_files_of_every_sort_do_nothing_else_and_end() -> None:
    """Each is opened and asked in a process that notes commands, libraries, sockets and files written."""
    options = "--inputs 0 --models 40 --recordings 40 --parts 40 --networks 400 --seed 7"
    command = f"cd {ROOT}; {sys.executable} -m tests.fuzz {options} --out {Path.cwd()}/failures"
    assert os.system(command) == 0


# ---- what stands for a topology ----


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("theirs", "mark"),
    [("0", b""), ("1", b""), ("2", b""), ("3", b""), ("13", b"\xe9"), ("23", b""), ("123", b"0")],
)
def test_lines_of_somebody_else_run_nothing_and_stand_for_no_topology(
    theirs: str, mark: bytes, serialized: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    """Theirs say another topology, or hold a function that calls a command; they are sealed or not."""
    apc.save(compiled(OTHER), MODEL)
    other = lines_of(MODEL.read_bytes())
    write("topology.yaml", AVERAGE)
    assert (unchanged(capsys), unchanged(capsys)) == (False, True)
    mine = MODEL.read_bytes()
    honest = apc.load(MODEL).peer_types[0].derivative.serialize().encode()
    assert honest in mine
    lines = lines_of(mine)
    other[1:] = mark, other[2], lines[3].replace(honest, serialized)
    head, sealed, *rest = (other[k] if str(k) in theirs else lines[k] for k in range(4))
    checksum = hashlib.sha256(b"\n".join((head, *rest))).hexdigest().encode()
    MODEL.write_bytes(b"\n".join((head, sealed.split(b" ")[0] + b" " + checksum, *rest)))
    for file in ("topology.yaml",) if "2" in theirs else ("topology.yaml", "topology.apc"):
        right = apc.analyze(compiled(AVERAGE)).spectral_radius
        assert apc.analyze(file).spectral_radius == right, "the texts decide"
    assert bool(messages_of(apc.load, MODEL)) == ("2" in theirs), "it is stale"
    assert not list(Path().rglob("PWNED*"))
    assert (unchanged(capsys), MODEL.read_bytes()) == (False, mine)


@pytest.mark.parametrize(
    ("happens", "repeated"),
    [
        *(("mv cache other", True), ("printf known > cache/secret", True)),
        *(("chmod 644 cache/secret; chmod 755 cache", True), ("rm -r cache", True)),
        *(("rm -r cache; touch cache", False), ("mv cache moved; ln -s moved cache", False)),
        *(("chown 1 cache", False), ("chmod 777 cache", False), ("chmod 777 .", False)),
    ],
)
def test_what_was_compiled_serves_this_user_alone(
    happens: str, repeated: bool, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a folder of one's own, or with a secret that others may know, all is compiled again."""
    write("topology.yaml", AVERAGE)
    assert (unchanged(capsys), unchanged(capsys)) == (False, True)
    if os.system(f"cd {folder} && {happens}"):
        pytest.skip("only root can give a folder to somebody else")
    signing._secret.cache_clear()
    assert (unchanged(capsys), unchanged(capsys)) == (False, repeated)
    assert not repeated or (folder / "cache" / "secret").stat().st_mode & 0o777 == 0o600


# ---- a model by itself ----


def test_a_model_of_somebody_else_needs_no_file_beside_it_and_not_this_library(
    other: Other, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("parts").mkdir()
    write("parts/tie.yaml", PART)
    write("users.csv", "device.mass [kg]\n1\n2\n")
    write("topology.yaml", TEXT)
    assert run(["compile"]) == 0
    expected = store.encoded(apc.load(MODEL))
    for path in ("topology.yaml", "users.csv", "parts/tie.yaml"):
        Path(path).unlink()
    write("mass.yaml", "component: Mass\ndescription: Nothing.\n")
    library = {**cache.builtin_files(), "Mass": Path("mass.yaml").resolve()}
    for module in ("apc.compiler.components.component_library", "apc.compiler.cache"):
        monkeypatch.setattr(f"{module}.builtin_files", lambda: library)
    assert store.encoded(other()) == expected


def test_what_was_changed_before_it_was_saved_is_changed_again(other: Other) -> None:
    write("topology.yaml", AVERAGE)
    numbers = {"contact.stiffness": "800 N/m", "lan.delay": "5/3 ms", "user.count": "5"}
    model = apc.set_parameters(apc.with_hands(apc.compile("topology.yaml"), "held"), numbers)
    apc.save(model, MODEL)
    assert store.encoded(apc.load(MODEL)) == store.encoded(model)
    assert store.encoded(other()) == store.encoded(model)


SECRETS = ("secret.csv", "../secret.csv", "/dev/zero", "/etc/passwd")
NAMES = ("", ".", "..", "../topology.yaml", "/etc/passwd", "a/b")
ODD = ("\0", "n" * 300, "\x1b[31m")
PATHS = ("./pipe", "./pipe/", "/", "/dev/zero", "Mass/", *NAMES, *ODD)
NUMBERS = ("1e99999999", "1/0", "-1", "nan", "9" * 5000, "__import__('os')")
CHANGES = (*(("lan.delay", number) for number in NUMBERS), ("no", "1"), ("peers", "3"), ("hands", "no"))


@pytest.mark.few(8)
@pytest.mark.parametrize(
    ("text", "fields", "words"),
    [
        *((name, {"topology": name}, DAMAGED) for name in NAMES),
        *((name, {"topology": name}, "") for name in ODD),
        *((path, {}, "") for path in PATHS),
        *(("", {"changes": ((change,),)}, ".") for change in CHANGES),
        ("topology.yaml", {}, r"topology\.yaml: E"),
    ],
)
def test_what_a_model_says_it_was_made_from_is_refused_or_compiled_and_not_looked_for(
    text: str, fields: dict[str, Any], words: str, other: Other
) -> None:
    """Who reads the pipe waits for ever."""
    os.mkfifo("pipe")
    forge((text, b""), **fields)
    refused = messages_of(other)
    assert re.match(words, refused[0]) if words else refused or other().peers == 3


@pytest.mark.parametrize("name", SECRETS)
def test_what_a_models_texts_name_is_read_from_the_model_alone(name: str, other: Other) -> None:
    write("secret.csv", "device.mass [kg]\n1\n2\n")
    write("../secret.csv", "device.mass [kg]\n1\n2\n")
    forge(("topology.yaml", replaced(AVERAGE, ("count: 3", f"table: {name}")).encode()))
    [line] = messages_of(other)
    assert line.startswith("topology.yaml:") and f"{name} does not exist" in line


# ---- damage and size ----

EMPTY = '{"topology": "topology.yaml", "texts": [], "program": "", "changes": []}'
DEEP = "[" * 10**6


def unsealed(origin: str) -> str:
    """Return the file of an empty model that nobody has sealed, whole."""
    head = f"apc {cache.FORMAT} compiled"
    checksum = hashlib.sha256(f"{head}\n{origin}\n".encode("latin-1")).hexdigest()
    return f"{head}\n {checksum}\n{origin}\n"


ORIGINS = ("", "[]", "{}", "null", "\xff", DEEP, EMPTY, EMPTY.replace("}", f', "x": {DEEP}'))
TEXTS = ('"topology.yaml"', '["topology.yaml", 3]', '["topology.yaml", "*"]')
NEWER = f"topology.apc: E603 has format version 99, this program reads version {cache.FORMAT}"


@pytest.mark.few(8)
@pytest.mark.parametrize(
    ("content", "words"),
    [
        *((content, DAMAGED) for content in ("", "\n\n\n", "PK\5\6", "#!/bin/sh\n" + unsealed(""))),
        *((unsealed(origin), DAMAGED) for origin in ORIGINS),
        *((unsealed(EMPTY.replace("[]", f"[{text}]", 1)), DAMAGED) for text in TEXTS),
        ("apc 99 compiled\n", NEWER),
    ],
)
def test_what_is_no_model_is_refused_and_beside_its_topology_passed_over(content: str, words: str) -> None:
    MODEL.write_bytes(content.encode("latin-1"))
    assert re.match(words, messages_of(apc.load, MODEL)[0])
    write("topology.yaml", AVERAGE)
    assert apc.analyze("topology.yaml").topology == "three-users-average"


def test_a_byte_changed_or_an_end_cut_off_is_refused(other: Other) -> None:
    apc.save(compiled(AVERAGE), MODEL)
    data = MODEL.read_bytes()
    whole = len(data.split(b"\n", 1)[0]) + 66  # behind the seal, which is another user's anyway
    for end in range(whole, len(data), 1_999):
        for rest in (b"", bytes([data[end] ^ 1]) + data[end + 1 :]):
            MODEL.write_bytes(data[:end] + rest)
            assert re.match(DAMAGED, messages_of(other)[0])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gone.apc", "E602 does not exist. Try: apc compile"),
        ("folder.apc", "E602 is a folder, not a compiled model."),
        ("large.apc", "E602 is larger than the limit of 256 MiB."),
        (
            "topology.apc",
            "E604 is damaged, or was not written by apc compile. Obtain the file again from its author.",
        ),
    ],
)
def test_what_is_not_there_or_a_folder_or_too_large_is_told(
    name: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("folder.apc").mkdir()
    write("large.apc", "")
    os.truncate("large.apc", 2**40)
    apc.save(compiled(AVERAGE), MODEL)
    monkeypatch.setattr(cache, "LARGEST_ORIGIN", 100)
    assert messages_of(apc.load, name) == [f"{name}: {words}"]
