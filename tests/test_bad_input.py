"""Whatever the input: one message at its place, exit code 1, nothing on stdout, nothing written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from apc.__main__ import run
from tests.topologies import AVERAGE, MESH, replaced

FILE = "scene.yaml"
ONE_PEER = replaced(MESH, ("count: 3", "count: 1"))
BOMB = "x0: &b0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"x{i}: &b{i} [{', '.join([f'*b{i - 1}'] * 10)}]\n" for i in range(1, 10)
)


def without(section: str) -> str:
    """Return the scene without one of its sections."""
    lines = AVERAGE.splitlines(keepends=True)
    start = next(i for i, line in enumerate(lines) if line.startswith(f"{section}:"))
    end = next((i for i in range(start + 1, len(lines)) if not lines[i].startswith(" ")), len(lines))
    return "".join(lines[:start] + lines[end:])


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def message(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Run a command that must fail, and return its one message, or all that it said."""
    before = {path.name: path.stat().st_mtime_ns for path in Path().iterdir()}
    code = run(list(words))
    out, err = capsys.readouterr()
    assert code == 1, err
    assert out == ""
    assert "Traceback" not in err
    assert {path.name: path.stat().st_mtime_ns for path in Path().iterdir()} == before
    lines = err.splitlines()
    # A message is one line, then perhaps the source line and its caret.
    assert len(lines) in (1, 3), err
    if len(lines) == 3:
        assert lines[2].strip() == "^"
    return lines[0]


def edited(old: str, new: str) -> str:
    return replaced(AVERAGE, (old, new))


def stiffness(text: str) -> str:
    """Return the scene with another text for the coordination stiffness."""
    return edited("500 N/m,", f"{text},")


CASES = {
    "missing peers": (
        without("peers"),
        "scene.yaml:1:1: E201 the topology has no peers section. Write: peers: {user: {count: 3}}",
    ),
    "missing masses": (
        without("masses"),
        "scene.yaml:1:1: E201 the topology has no masses section. Write: masses: {device: {mass: 0.1 kg}}",
    ),
    "masses that are a list": (
        without("masses") + "masses: [device, cube]\n",
        "scene.yaml:15:9: E203 masses wants a mapping of keys to values, got a list. "
        "Write: masses: {device: {mass: 0.1 kg}}",
    ),
    "missing clocks": (
        without("clocks"),
        "scene.yaml:1:1: E201 the topology has no clocks section. Write: clocks: {haptic: 1 ms}",
    ),
    "missing links": (
        without("links"),
        "scene.yaml:1:1: E201 the topology has no links section. Write: links: {lan: {clock: network}}",
    ),
    "missing topology": (
        without("topology"),
        "scene.yaml:1:1: E201 the topology has no topology. Write: topology: my-scene",
    ),
    "unknown section": (
        edited("couplers:", "coupler:"),
        "scene.yaml:11:1: E202 a topology has no key coupler; the nearest is couplers. Write: couplers",
    ),
    "unknown key": (
        edited("stiffness: 1000", "stifness: 1000"),
        "scene.yaml:12:65: E202 contact (SampledSpringDamper) has no key stifness; "
        "the nearest is stiffness. Write: stiffness",
    ),
    "unknown type": (
        edited("type: AveragePosition", "type: AveragePositon"),
        "scene.yaml:13:24: E206 there is no component AveragePositon; the nearest is AveragePosition. "
        "Write: AveragePosition",
    ),
    "wrong unit": (
        edited("1000 N/m", "1000 N*m"),
        "scene.yaml:12:76: E204 stiffness wants N/m, got 1000 N*m. Write: stiffness: 1000 N/m",
    ),
    "missing unit": (
        stiffness("500"),
        "scene.yaml:13:66: E204 stiffness wants N/m, got 500 (no unit). Write: stiffness: 500 N/m",
    ),
    "missing value": (
        stiffness(""),
        "scene.yaml:13:66: E203 stiffness wants a single value, got nothing. Write: stiffness: 1 N/m",
    ),
    "negative mass": (
        edited("0.1 kg", "-0.1 kg"),
        "scene.yaml:9:18: E207 mass wants more than 0 kg, got -0.1 kg.",
    ),
    "zero mass": (edited("0.1 kg", "0 kg"), "scene.yaml:9:18: E207 mass wants more than 0 kg, got 0 kg."),
    "zero period": (
        edited("haptic: 1 ms", "haptic: 0 ms"),
        "scene.yaml:4:11: E207 the period of clock haptic wants more than 0 s, got 0 s. Write: haptic: 1 ms",
    ),
    "negative delay": (
        edited("8 ms}", "-8 ms}"),
        "scene.yaml:15:32: E207 delay wants 0 ms or more, got -8 ms.",
    ),
    "unknown clock": (
        edited("clock: haptic, delay: 1 ms}", "clock: hapti, delay: 1 ms}"),
        "scene.yaml:12:93: E206 contact names clock hapti, which isn't in clocks; the nearest is haptic. "
        "Write: haptic",
    ),
    "unknown link": (
        edited("link: lan", "link: wan"),
        "scene.yaml:13:109: E206 coordination names link wan, which isn't in links; the nearest is lan. "
        "Write: lan",
    ),
    "unknown mass": (
        edited("a: device", "a: devise"),
        "scene.yaml:12:48: E206 contact joins its a to devise, which is no part of this topology; "
        "the nearest is device. Write: device",
    ),
    "one peer with full mesh": (
        ONE_PEER,
        "scene.yaml:13:3: E208 coordination (FullMesh) follows the other peers and wants at least 2 peers, "
        "got 1. Write: count: 2",
    ),
    "duplicate key": (
        edited("  network: 8 ms", "  network: 8 ms\n  haptic: 2 ms"),
        "scene.yaml:6:3: E111 'haptic' stands twice, first in line 4.",
    ),
    "not YAML": (
        "topology: [a\nmasses: {",
        "scene.yaml:1:11: E109 this [ is never closed, or a comma is missing behind it.",
    ),
    "empty": ("", "scene.yaml: E108 this file is empty."),
    "only comments": ("# nothing\n\n", "scene.yaml: E108 this file is empty."),
    "a list": (
        "- a\n",
        "scene.yaml:1:1: E203 a topology wants a mapping of keys to values, got a list. "
        "Write: topology: my-scene",
    ),
    "a section that is a list": (
        edited("  lan: {clock: network, delay: 8 ms}", "  - lan"),
        "scene.yaml:15:3: E203 links wants a mapping of keys to values, got a list. "
        "Write: links: {lan: {clock: network}}",
    ),
    "two documents": (
        AVERAGE + "---\na: 1\n",
        "scene.yaml:18:1: E110 a file wants one YAML document, got the start of a second one.",
    ),
    "NaN": (
        stiffness("nan N/m"),
        "scene.yaml:13:66: E221 stiffness wants N/m, got nan N/m. Write: stiffness: 1 N/m",
    ),
    "YAML's NaN": (
        stiffness(".nan"),
        "scene.yaml:13:66: E221 stiffness wants N/m, got .nan. Write: stiffness: 1 N/m",
    ),
    "infinity": (
        stiffness("inf N/m"),
        "scene.yaml:13:66: E221 stiffness wants N/m, got inf N/m. Write: stiffness: 1 N/m",
    ),
    "a number beyond floats": (
        stiffness("1e999 N/m"),
        "scene.yaml:13:66: E226 a number wants an exponent from -300 to 300, got 999.",
    ),
    "huge count": (
        edited("count: 3", "count: 1000000000000"),
        "scene.yaml:7:17: E208 count wants a whole number from 1 to 1000000000, got 1000000000000. "
        "Write: count: 3",
    ),
    "count of five thousand digits": (
        edited("count: 3", "count: " + "9" * 5000),
        "scene.yaml:7:17: E208 count wants a whole number from 1 to 1000000000, got "
        + "9" * 57
        + "... Write: count: 3",
    ),
    "no peers at all": (
        edited("count: 3", "count: 0"),
        "scene.yaml:7:17: E208 count wants a whole number from 1 to 1000000000, got 0. Write: count: 3",
    ),
    "half a peer": (
        edited("count: 3", "count: 2.5"),
        "scene.yaml:7:17: E208 count wants a whole number from 1 to 1000000000, got 2.5. Write: count: 3",
    ),
    "a Cyrillic letter in a name": (
        edited("clock: haptic, delay: 1 ms}", "clock: h\u0430ptic, delay: 1 ms}"),
        "scene.yaml:12:93: E206 contact names clock h\u0430ptic, which isn't in clocks; "
        "the nearest is haptic. Write: haptic",
    ),
    "a Cyrillic letter in a key": (
        edited("{mass: 0.1", "{m\u0430ss: 0.1"),
        "scene.yaml:9:12: E202 device (Mass) has no key m\u0430ss; the nearest is mass. Write: mass",
    ),
    "a Cyrillic letter in a unit": (
        edited("0.1 kg", "0.1 \u043ag"),
        "scene.yaml:9:22: E223 there is no unit \u043ag.",
    ),
    "a minus that is none": (
        edited("0.1 kg", "\u22120.1 kg"),
        "scene.yaml:9:18: E321 an expression wants ASCII letters, digits and + - * / ^ ( ), "
        "got \u2212 (U+2212, MINUS SIGN). Write: -",
    ),
    "a tab": (
        edited("  haptic: 1 ms", "\thaptic: 1 ms"),
        "scene.yaml:4:1: E109 a tab indents this line, and YAML allows spaces only. Write: spaces",
    ),
    "an alias bomb": (
        AVERAGE + BOMB,
        "scene.yaml:22:45: E117 this file has more than 100000 nodes, aliases written out.",
    ),
    "deep lists": (
        AVERAGE + "x: " + "[" * 5000 + "]" * 5000 + "\n",
        "scene.yaml:18:67: E115 this is nested deeper than 64 levels.",
    ),
    "deep mappings": (
        AVERAGE + "x: " + "{a: " * 200 + "1" + "}" * 200 + "\n",
        "scene.yaml:18:256: E115 this is nested deeper than 64 levels.",
    ),
    "deep parentheses": (
        stiffness("'" + "(" * 3000 + "500" + ")" * 3000 + "'"),
        "scene.yaml:13:167: E328 this is nested or chained more than 100 deep: give a part of it a name.",
    ),
    "an endless expression": (
        stiffness("'" + "1 + " * 5000 + "1'"),
        "scene.yaml:13:67: E328 an expression wants at most 10000 characters, got 20001.",
    ),
    "a tower of powers": (
        stiffness("9**9**9**9"),
        "scene.yaml:13:70: E326 a power of a power needs parentheses. Write: (x^2)^3",
    ),
    "a tower in parentheses": (
        stiffness("kt*(((9^64)^64)^64)^64").replace("clocks:", "parameters: {kt: 1 N/m}\nclocks:"),
        "scene.yaml:14:70: E331 (9^64)^64 is too large for a number.",
    ),
    "a dunder name": (
        stiffness("__import__"),
        "scene.yaml:13:66: E324 a name wants a letter first, got __import__.",
    ),
    "a call of the system": (
        stiffness("\"__import__('os').system('touch pwned')\""),
        "scene.yaml:13:67: E324 a name wants a letter first, got __import__.",
    ),
    "a dunder attribute": (
        stiffness("peers.__class__"),
        "scene.yaml:13:66: E324 a name wants a letter first, got peers.__class__.",
    ),
    "an attribute": (
        stiffness("peers.real"),
        "scene.yaml:13:66: E206 stiffness names peers.real, which is no parameter here; "
        "the nearest is peers. Write: peers",
    ),
    "a call": (
        stiffness("\"open('x')\""),
        "scene.yaml:13:67: E325 there is no function open; there are: abs,",
    ),
    "a subscript": (
        stiffness("'peers[0]'"),
        "scene.yaml:13:67: E324 an index wants a whole number counted from 1, got 0.",
    ),
    "a lambda": (
        stiffness("'(lambda: 1)()'"),
        "scene.yaml:13:74: E321 an expression wants ASCII letters, digits and + - * / ^ ( ), got :.",
    ),
    "a Python tag": (
        stiffness("!!python/object/apply:os.system [ls]"),
        "scene.yaml:13:66: E113 the tag '!!python/object/apply:os.system' is not part of this language.",
    ),
    "a division by zero": (
        stiffness("'500*kt/(peers - 3)'").replace("clocks:", "parameters: {kt: 1 N/m}\nclocks:"),
        "scene.yaml:14:67: E331 500*kt/(peers - 3) divides by zero.",
    ),
    "parameters in a circle": (
        edited("clocks:", "parameters: {a: b, b: a}\nclocks:"),
        "scene.yaml:3:17: E209 parameters depend in a circle: a → b → a.",
    ),
    "a part that joins itself": (
        edited("a: device", "a: contact"),
        "scene.yaml:12:48: E210 contact (SampledSpringDamper) has 2 connectors of type Flange. "
        "Write: a: contact.a",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_one_message_at_its_place_and_nothing_else(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    text, expected = CASES[name]
    Path(FILE).write_text(text, encoding="utf-8")
    assert message(capsys, "compile", FILE).startswith(expected)
    assert message(capsys, "check", FILE).startswith(expected)
    assert message(capsys, "analyze", FILE).startswith(expected)


@pytest.mark.parametrize("text", [AVERAGE.replace("\n", "\r\n"), "\ufeff" + AVERAGE, AVERAGE.rstrip("\n")])
def test_line_ends_marks_and_a_missing_last_line_end_are_fine(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(FILE).write_bytes(text.encode())
    assert run(["check"]) == 0
    assert capsys.readouterr().err == ""


def test_a_mistake_behind_carriage_returns_and_a_mark_is_told_at_its_place(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path(FILE).write_bytes(("\ufeff" + stiffness("500").replace("\n", "\r\n")).encode())
    assert message(capsys, "check", FILE) == (
        "scene.yaml:13:66: E204 stiffness wants N/m, got 500 (no unit). Write: stiffness: 500 N/m"
    )


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\x7fELF\x02\x01\x01\x00\x00", "scene.yaml:1:1: E107 a YAML file wants visible text, got U+007F"),
        (
            b"\x89PNG\r\n\x1a\n",
            "scene.yaml:1:1: E106 a YAML file wants UTF-8 text, got byte 0x89 at offset 0.",
        ),
        (
            AVERAGE.encode("utf-16"),
            "scene.yaml:1:1: E106 a YAML file wants UTF-8 text, got byte 0xff at offset 0.",
        ),
        (b"a: 1\nb: \xe4\n", "scene.yaml:2:4: E106 a YAML file wants UTF-8 text, got byte 0xe4 at offset 8."),
        (b"x" * (2 << 20), "scene.yaml: E105 this file is larger than 1048576 bytes"),
    ],
)
def test_a_file_that_is_no_text_is_refused(
    data: bytes, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(FILE).write_bytes(data)
    assert message(capsys, "compile", FILE).startswith(expected)


def test_a_file_that_is_not_there_is_told_with_the_nearest_name(capsys: pytest.CaptureFixture[str]) -> None:
    Path(FILE).write_text(AVERAGE, encoding="utf-8")
    assert message(capsys, "compile", "scen.yaml") == (
        "scen.yaml: E101 there is no such file; did you mean 'scene.yaml'?"
    )


def test_a_folder_is_no_topology(capsys: pytest.CaptureFixture[str]) -> None:
    Path("scenes.yaml").mkdir()
    assert message(capsys, "compile", "scenes.yaml") == (
        "scenes.yaml: E102 this wants a YAML file, got a folder."
    )
    Path("model.apc").mkdir()
    assert message(capsys, "analyze", "model.apc") == "model.apc: E602 is a folder, not a compiled model."


def test_a_file_that_may_not_be_read_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    Path(FILE).write_text(AVERAGE, encoding="utf-8")
    Path(FILE).chmod(0)
    if os.access(FILE, os.R_OK):
        pytest.skip("this user may read every file")
    assert message(capsys, "compile", FILE) == "scene.yaml: E103 this file may not be read (no permission)."


def test_a_folder_that_may_not_be_written_is_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    Path(FILE).write_text(AVERAGE, encoding="utf-8")
    tmp_path.chmod(0o500)
    try:
        if os.access(tmp_path, os.W_OK):
            pytest.skip("this user may write everywhere")
        assert message(capsys, "compile", FILE) == "scene.apc: E601 can't be written: Permission denied."
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_nobody_writes_to_does_not_wait(capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(FILE)
    assert message(capsys, "compile", FILE) == (
        "scene.yaml: E104 this wants a YAML file, got a device, pipe or socket."
    )


@pytest.mark.parametrize("data", [b"", b"garbage", b"PK\x03\x04", b"PK\x05\x06" + bytes(18)])
def test_a_damaged_model_is_refused_by_name(data: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    Path("scene.apc").write_bytes(data)
    assert message(capsys, "analyze", "scene.apc") == (
        "scene.apc: E604 is damaged: it is not what apc compile writes. Write: apc compile scene.yaml"
    )


def test_a_cut_off_model_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    Path(FILE).write_text(AVERAGE, encoding="utf-8")
    assert run(["compile"]) == 0
    capsys.readouterr()
    whole = Path("scene.apc").read_bytes()
    Path("scene.apc").write_bytes(whole[:200])
    assert "E604 is damaged" in message(capsys, "analyze", "scene.apc")


def test_a_stale_model_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    Path(FILE).write_text(AVERAGE, encoding="utf-8")
    assert run(["compile"]) == 0
    capsys.readouterr()
    Path(FILE).write_text(stiffness("800 N/m"), encoding="utf-8")
    assert message(capsys, "analyze", "scene.apc") == (
        "scene.apc: E605 is stale: scene.yaml has changed since it was compiled. "
        "Write: apc compile scene.yaml"
    )


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("contact.stifness=1 N/m", "E622 contact.stifness is no parameter of three-users-average."),
        ("contact.stiffness=1", "E204 contact.stiffness wants N/m, got 1 (no unit)."),
        ("contact.stiffness=nan N/m", "E221 contact.stiffness wants N/m, got nan N/m."),
        ("contact.stiffness", "E621 an override wants NAME=VALUE, got contact.stiffness."),
        ("contact.stiffness=-1 N/m", "E624 contact.stiffness wants at least 0 N/m, got -1 N/m."),
        ("contact.stiffness=9**9**9", "E222 a unit wants a name such as N, m or s, got ^."),
        ("haptic.period=0 s", "E625 haptic.period wants a time above 0 s"),
        ("__class__.x=1", "E622 __class__.x is no parameter of three-users-average."),
    ],
)
def test_a_setting_that_cannot_be_is_one_message(
    setting: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(FILE).write_text(AVERAGE, encoding="utf-8")
    assert expected in message(capsys, "analyze", "--set", setting)


def test_no_traceback_reaches_a_terminal(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text(stiffness("9**9**9**9"), encoding="utf-8")
    ran = subprocess.run(
        [sys.executable, "-m", "apc", "compile"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (ran.returncode, ran.stdout) == (1, "")
    assert ran.stderr.splitlines()[0] == CASES["a tower of powers"][1]
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
