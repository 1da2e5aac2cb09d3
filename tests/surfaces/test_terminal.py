"""What reaches a terminal does not act on it, and a terminal that has gone is no bug."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

from apc.__main__ import run
from apc.compiler.errors import ApcError, Mistake, Place, visible
from tests.topologies import AVERAGE, ROOT, replaced

ESCAPES = "\x1b[31m\x9b2J\x7f\u202e"


def test_what_is_not_printed_is_written_out_as_json_has_it() -> None:
    assert visible("a b\u00a0ü\n\t→") == "a b\u00a0ü\n\t→"
    assert visible(ESCAPES) == r"\u001b[31m\u009b2J\u007f\u202e"
    document = json.dumps({"a": ESCAPES}, ensure_ascii=False)
    assert json.loads(visible(document)) == {"a": ESCAPES}
    assert json.loads(f'"{visible(chr(0xE0001))}"') == chr(0xE0001)


def test_a_message_shows_names_of_files_and_what_was_got_escaped() -> None:
    text = str(ApcError(Mistake("E101", Place(f"{ESCAPES}.yaml", 3, 1), "this", "that", ESCAPES, ESCAPES)))
    assert text.isprintable()
    assert text.count(r"\u001b") == 3


@pytest.mark.parametrize("words", [("check",), ("compile",), ("analyze",), ("analyze", "--json"), ("show",)])
def test_a_name_in_a_file_does_not_act_on_the_terminal(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    text = replaced(AVERAGE, ("topology: three-users-average", r'topology: "a\e[31mb"'))
    Path("scene.yaml").write_text(text, encoding="utf-8")
    assert run([*words, "scene.yaml"]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out and r"\u001b[31m" in out
    assert run(["analyze", "\x1b[2J.yaml"]) == 1
    assert run(["analyze", "a", "\x1b[2J.yaml"]) == 2
    assert "\x1b" not in capsys.readouterr().err


def test_every_command_prints_by_what_escapes() -> None:
    for path in sorted((ROOT / "runtime" / "cli").glob("*.py")):
        if path.name == "options.py":  # which does the escaping
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            assert not (isinstance(node, ast.Attribute) and node.attr in ("echo", "secho")), path.name


@pytest.mark.parametrize("words", [("--jobs", "1_0"), ("--jobs", "١")])
def test_a_count_is_in_plain_digits(capsys: pytest.CaptureFixture[str], words: tuple[str, ...]) -> None:
    assert run(["simulate", *words]) == 2
    assert "is not a whole number" in capsys.readouterr().err


LONG = "n" * 300


@pytest.mark.parametrize(
    "words",
    [
        ("compile", "."),
        ("compile", "/"),
        ("analyze", "."),
        ("compile", f"{LONG}.yaml"),
        ("analyze", f"{LONG}.apc"),
        ("show", "scene.yaml", "--out", f"{LONG}.txt"),
        ("schema", "--out", f"{LONG}.json"),
        ("simulate", "scene.yaml", "--duration", "1 ms", "--out", f"{LONG}.csv"),
        ("sweep", "scene.yaml", "--over", "contact.stiffness=1,2 N/m", "--out", f"{LONG}.csv"),
        (
            "sweep",
            "scene.yaml",
            "--jobs",
            "1",
            "--over",
            "contact.stiffness=1,2 N/m",
            "--out",
            f"{LONG[:249]}.csv",
        ),
        ("region", "scene.yaml", "--out", f"{LONG}.csv"),
    ],
)
def test_a_name_that_can_be_none_is_one_message(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(list(words)) == 1
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1


def test_two_topologies_of_one_model_are_refused_naming_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("x.yaml", "x.yml"):
        Path(name).write_text(AVERAGE, encoding="utf-8")
    assert run(["compile", "x.yml"]) == 1
    assert capsys.readouterr().err == (
        "x.yml: E617 and x.yaml would both be compiled to x.apc. Write: mv x.yml x-2.yml\n"
    )
    assert not Path("x.apc").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="a shell of another kind")
@pytest.mark.parametrize(
    ("line", "code", "told"),
    [
        ("{apc} schema | head -c 1 >/dev/null; exit ${{PIPESTATUS[0]}}", 0, ""),
        ("{apc} schema >&-", 1, "there is no stdout"),
    ],
)
def test_an_output_that_is_closed_is_no_bug(line: str, code: int, told: str) -> None:
    command = line.format(apc=f"{sys.executable} -m apc")
    ran = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ran.returncode == code, ran.stderr
    assert told in ran.stderr and "bug" not in ran.stderr
