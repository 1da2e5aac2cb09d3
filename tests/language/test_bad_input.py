"""Whatever the input: one message at its place, exit code 1, nothing on stdout, nothing written."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import apc
from apc.__main__ import run
from tests.topologies import AVERAGE, replaced

FILE = Path("topology.yaml")
Say = Callable[..., str]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def message(capsys: pytest.CaptureFixture[str]) -> Say:
    """Return what runs a command that must fail, and gives the first line of its only message."""

    def printed(*words: str) -> str:
        before = {path.name: path.stat().st_mtime_ns for path in Path().iterdir()}
        code = run(list(words))
        out, err = capsys.readouterr()
        assert (code, out) == (1, ""), err
        assert {path.name: path.stat().st_mtime_ns for path in Path().iterdir()} == before
        first, *source = err.splitlines()
        assert not source or (len(source) == 2 and source[1].strip() == "^"), err
        return first

    return printed


def stiffness(text: str) -> str:
    return replaced(AVERAGE, ("500 N/m,", f"{text},"))


def nested(opened: str, closed: str, depth: int) -> str:
    return f"{AVERAGE}x: {opened * depth}1{closed * depth}\n"


BOMB = "x0: &b0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"x{i}: &b{i} [{', '.join([f'*b{i - 1}'] * 10)}]\n" for i in range(1, 10)
)
DEEP = "E328 the expression is nested more than 100 levels deep; give a subexpression a name."
LIST = "1:1: E203 topology: expected a mapping of keys to values, got a list. Try: topology: my-topology"
TABBED = "indentation: expected spaces, got a tab."
NO_TEXT = "E107 file: expected text without control characters, got "
NO_PLACE = "E109 unexpected line: wrong indentation, or an unmatched closing bracket."
FILES: list[tuple[str | bytes, str]] = [
    ("", "E108 the file is empty."),
    ("# nothing\n\n", "E108 the file is empty."),
    ("- a\n- b\n", LIST),
    ("just text\n", LIST.replace("a list", "just text")),
    ("topology: [a\nmasses: {", "1:11: E109 this [ is not closed, or a comma is missing after it."),
    ("{a: 1}}\n", f"1:7: {NO_PLACE}"),
    (" a: 1\nb: 2\n", f"2:1: {NO_PLACE}"),
    ("? [a]\n: b\n", "1:3: E112 key: expected a name, got a list."),
    ("a: 'x\n", "1:4: E109 this quote is not closed."),
    ("a: @x\n", "1:4: E109 text that starts with @ needs quotes. Try: '@x'"),
    ("a: b: c\n", "1:5: E109 unexpected ': ': the line above is incomplete"),
    ("a: {x: O[1], y: 1}\n", '1:8: E109 text with [ needs quotes here. Try: "O[1]"'),
    ("a: [r = {1, 2}]\n", '1:5: E109 text with { needs quotes here. Try: "r = {1, 2}"'),
    ("a: {x: [1] [2]}\n", "1:4: E109 this { is not closed, or a comma is missing after it."),
    ("{a: \n", "2:1: E109 expected a value or a closing bracket."),
    ("a: 1\n\tb: 2\n", f"2:1: E109 {TABBED}"),
    ("a: 1\nb\nc: 2\n", "2:1: E109 expected a colon and a space after this key. Try: b:"),
    ("a:\n  b: 1\n c: 2\n", "3:2: E109 this line is indented differently from the keys it belongs to."),
    ("x: !mine 3", "1:4: E113 the tag '!mine' is not supported."),
    ("x: !!int y", "1:4: E113 !!int: expected a value of this type, got 'y'."),
    (
        "a: &one 1\nb: *ome",
        "2:4: E114 the alias *ome has no anchor &ome before it. Try: *one",
    ),
    (f"{AVERAGE}---\na: 1\n", "18:1: E110 file: expected one YAML document, got the start of a second one."),
    (AVERAGE + BOMB, "22:45: E117 the file has more than 100000 nodes, aliases expanded."),
    (nested("[", "]", 200), "18:67: E115 nested more than 64 levels deep."),
    (nested("{a: ", "}", 200), "18:256: E115 nested more than 64 levels deep."),
    (f"a: &a {'[' * 40}{']' * 40}\nb: {'[' * 30}*a{']' * 30}", "2:34: E115 nested more than 64 levels deep"),
    ("x: 'a\u2028'", f"1:6: {NO_TEXT}U+2028 (LINE SEPARATOR)."),
    (b"a: \x00", f"1:4: {NO_TEXT}U+0000 (a control character), as in a binary file."),
    (b"\x7fELF\x02\x01\x01\x00\x00", f"1:1: {NO_TEXT}U+007F"),
    (b"\x89PNG\r\n\x1a\n", "1:1: E106 file: expected UTF-8 text, got byte 0x89 at offset 0."),
    (b"a: 1\nb: \xe4\n", "2:4: E106 file: expected UTF-8 text, got byte 0xe4 at offset 8."),
    (b"\xef\xbb\xbfa: \xff", "1:4: E106 file: expected UTF-8 text, got byte 0xff at offset 6."),
    (b"x" * ((1 << 20) + 1), "E105 the file is larger than 1048576 bytes, the limit for a YAML file"),
    (stiffness(f"'{'(' * 3000}500{')' * 3000}'"), f"13:167: {DEEP}"),
    (stiffness(f"'{'-' * 3000}500'"), f"13:167: {DEEP}"),
    (stiffness(f"'{'abs(' * 1900}1{')' * 1900}'"), f"13:467: {DEEP}"),
    (stiffness(f"'{'+'.join('1' * 200)}'"), f"13:67: {DEEP}"),
    (stiffness(f"'{'if 1<2 then 1 else ' * 400}2'"), f"13:1934: {DEEP}"),
    (stiffness(f"'{'1 + ' * 5000}1'"), "13:67: E328 expression: expected at most 10000 characters"),
    (stiffness(f"'{'1' * 1001}*peers'"), "13:67: E323 number: expected at most 1000 characters, got 1001."),
    (stiffness(f"{'1' * 201} N/m"), "13:66: E221 stiffness: expected N/m, got 11111"),
    (
        AVERAGE.replace("count: 3", f"count: {'9' * 5000}"),
        "7:17: E208 count: expected a whole number from 1 to",
    ),
]


@pytest.mark.parametrize(("text", "expected"), FILES, ids=[expected[:40] for _, expected in FILES])
def test_a_file_that_is_no_topology_is_told_in_one_sentence(
    text: str | bytes, expected: str, message: Say
) -> None:
    FILE.write_bytes(text if isinstance(text, bytes) else text.encode())
    place = ":" if expected[0].isdigit() else ": "
    assert message("check", "topology.yaml").startswith(f"topology.yaml{place}{expected}")


@pytest.mark.parametrize("command", ["compile", "check", "analyze", "simulate", "show"])
@pytest.mark.parametrize("text", ["500", "9**9**9**9", "\"__import__('os').system('touch pwned')\""])
def test_every_command_says_the_same_and_writes_nothing(command: str, text: str, message: Say) -> None:
    FILE.write_text(stiffness(text), encoding="utf-8")
    assert message(command, "topology.yaml") == message("check", "topology.yaml")


def test_a_mistake_behind_carriage_returns_and_a_mark_is_told_at_its_place(message: Say) -> None:
    FILE.write_bytes(("\ufeff" + stiffness("500").replace("\n", "\r\n")).encode())
    assert message("check", "topology.yaml").startswith("topology.yaml:13:66: E204 stiffness: expected N/m")


@pytest.mark.parametrize("text", [AVERAGE.replace("\n", "\r\n"), "\ufeff" + AVERAGE, AVERAGE.rstrip("\n")])
def test_line_ends_marks_and_a_missing_last_line_end_are_fine(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    FILE.write_bytes(text.encode())
    assert (run(["check"]), capsys.readouterr().err) == (0, "")


@pytest.mark.parametrize(
    ("text", "count"), [("0x1F", 31), ("0o17", 15), ("010", 10), ("!!int 5", 5), ("&n 4", 4)]
)
def test_numbers_are_those_of_yaml_1_2(text: str, count: int) -> None:
    FILE.write_text(replaced(AVERAGE, ("count: 3", f"count: {text}")), encoding="utf-8")
    assert apc.compile(FILE).peers == count


@pytest.mark.parametrize("word", ["on", "off", "yes", "y", "tRUE", "1", "~"])
def test_what_yaml_1_1_would_convert_stays_a_word(word: str, message: Say) -> None:
    FILE.write_text(replaced(AVERAGE, ("shared: true", f"shared: {word}")), encoding="utf-8")
    assert "E203 shared: expected true or false, got" in message("check", "topology.yaml")


def test_keys_that_stand_twice_are_told_together_and_mistakes_in_the_order_of_the_file(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def report_of() -> list[str]:
        assert run(["check", "topology.yaml"]) == 1
        lines = capsys.readouterr().err.splitlines()
        return [" ".join(line.split()[:2]) for line in lines if line.startswith("topology.yaml:")]

    FILE.write_text("a: 1\nb: {c: 1, 'c': 2}\na: 2\n", encoding="utf-8")
    assert report_of() == ["topology.yaml:2:11: E111", "topology.yaml:3:1: E111"]
    wrong = [("haptic: 1 ms", "haptic: 1 kg"), ("network: 8 ms", "network: 0 s"), ("0.1 kg", "0.1")]
    wrong += [("shared: true", "shared: yes"), ("1000 N/m", "1000 N"), ("delay: 8 ms}", "delay: 8 s m}")]
    wrong += [("contact.stiffness: [0 N/m, 5000", "contact.stifness: [0 N/m, 5000")]
    FILE.write_text(replaced(AVERAGE, *wrong), encoding="utf-8")
    codes = ["4:11: E204", "5:12: E207", "9:18: E204", "10:52: E203", "12:76: E204", "15:36: E222"]
    assert report_of() == [f"topology.yaml:{one}" for one in (*codes, "17:16: E206")]


def test_the_line_is_shown_with_a_caret_under_the_place_however_long_it_is(
    capsys: pytest.CaptureFixture[str],
) -> None:
    FILE.write_text(replaced(AVERAGE, ("haptic: 1 ms", "haptic: 1 kg")), encoding="utf-8")
    assert run(["check"]) == 1
    assert capsys.readouterr().err == (
        "topology.yaml:4:11: E204 haptic: expected a time or a rate, got 1 kg. Try: haptic: 1 ms\n"
        "      haptic: 1 kg\n              ^\n"
    )
    FILE.write_text(f"a: [{'b, ' * 100}!mine 1{', d' * 100}]", encoding="utf-8")
    assert run(["check", "topology.yaml"]) == 1
    _, shown, caret = capsys.readouterr().err.splitlines()
    assert shown[caret.index("^") :].startswith("!mine")
    assert len(shown) < 110


@pytest.mark.parametrize(
    ("command", "file", "expected"),
    [
        (
            "compile",
            "topolog.yaml",
            "topolog.yaml: E101 the file does not exist; did you mean 'topology.yaml'?",
        ),
        ("compile", "zzz", "zzz: E101 the file does not exist."),
        ("compile", "no/a.yaml", "no/a.yaml: E101 the folder "),
        ("compile", "topology.yaml/b", "topology.yaml/b: E101 "),
        ("compile", "x" * 5000, f"{'x' * 5000}: E10"),
        ("compile", "topologies.yaml", "topologies.yaml: E102 input: expected a YAML file, got a folder."),
        ("analyze", "model.apc", "model.apc: E602 is a folder, not a compiled model."),
        (
            "compile",
            "pipe.yaml",
            "pipe.yaml: E104 input: expected a YAML file, got a device, pipe or socket.",
        ),
        (
            "compile",
            "/dev/zero",
            "/dev/zero: E104 input: expected a YAML file, got a device, pipe or socket.",
        ),
    ],
)
def test_a_file_that_can_not_be_read_is_told_and_nobody_waits_for_it(
    command: str, file: str, expected: str, message: Say
) -> None:
    FILE.write_text(AVERAGE, encoding="utf-8")
    for name in ("topologies.yaml", "model.apc"):
        Path(name).mkdir()
    os.mkfifo("pipe.yaml")
    assert message(command, file).startswith(expected)


def test_what_may_not_be_read_or_written_is_told(message: Say, folder: Path) -> None:
    FILE.write_text(AVERAGE, encoding="utf-8")
    folder.chmod(0o500)
    try:
        if os.access(folder, os.W_OK):
            pytest.skip("this user may read and write everywhere")
        assert (
            message("compile", "topology.yaml") == "topology.apc: E601 can't be written: Permission denied."
        )
    finally:
        folder.chmod(0o700)
    FILE.chmod(0)
    assert (
        message("compile", "topology.yaml")
        == "topology.yaml: E103 the file can't be read (permission denied)."
    )


def test_a_model_that_is_damaged_or_older_than_its_topology_is_refused(message: Say) -> None:
    FILE.write_text(AVERAGE, encoding="utf-8")
    model = Path("topology.apc")
    apc.save(apc.compile(FILE), model)
    whole = model.read_bytes()
    origin = whole.split(b"\n", 3)[2]
    garbage = (b"", b"garbage", b"PK\x03\x04", b"PK\x05\x06" + bytes(18))
    for data in (*garbage, whole[: whole.index(origin) + len(origin) // 2], whole[:-9]):
        model.write_bytes(data)
        assert "E604 is damaged" in message("analyze", "topology.apc")
    model.write_bytes(whole)
    assert apc.analyze(model).stable
    assert "E614 file is a compiled model. Try: apc analyze" in message("compile", "topology.apc")
    FILE.write_text(f"{AVERAGE}# more\n", encoding="utf-8")
    assert message("analyze", "topology.apc") == (
        "topology.apc: E605 model is out of date: topology.yaml has changed. Try: apc compile topology.yaml"
    )
    FILE.unlink()
    assert apc.analyze(model).stable, "no topology there to be older than"
    model.write_bytes(b"garbage")
    assert message("analyze", "topology.apc").endswith("Obtain the file again from its author.")


EACH = "peers: {user: {count: 3, set: {device.x: [0 m, 10 mm, 0 m]}}}"


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("contact.stifness=1 N/m", "E622 contact.stifness is not a parameter of three-users-average."),
        ("haptic=2 ms", "E622 haptic is not a parameter of three-users-average. Try: haptic.period"),
        ("contact.stiffness=1", "E204 contact.stiffness: expected N/m, got 1 (no unit)."),
        (
            "contact.stiffness=nan N/m",
            "E221 contact.stiffness: expected a finite number in N/m, got nan N/m.",
        ),
        ("contact.stiffness", "E621 override: expected NAME=VALUE, got contact.stiffness."),
        ("contact.stiffness=-1 N/m", "E624 contact.stiffness: expected at least 0 N/m, got -1 N/m."),
        ("contact.stiffness=9**9**9", "E222 unit **9**9: expected a name, such as N, m or s, got ^."),
        ("haptic.period=0 s", "E625 haptic.period: expected a time above 0 s"),
        ("peers=4", "E623 peers is the number of all peers"),
        ("cube.mass=0 kg", "E624 cube.mass: expected more than 0 kg, got 0 kg."),
        ("lan.delay=-1 ms", "E625 lan.delay: expected a time of 0 s or more, got -1 ms."),
        ("user.lan.delay=1 ms", "E622 user.lan.delay is not a parameter of three-users-average"),
        ("__class__.x=1", "E622 __class__.x is not a parameter of three-users-average."),
        ("user[2].device.x=10 mm", f"Try: {EACH}"),
    ],
)
def test_a_setting_that_cannot_be_is_one_message(setting: str, expected: str, message: Say) -> None:
    FILE.write_text(AVERAGE, encoding="utf-8")
    assert expected in message("analyze", "--set", setting)
    if EACH in expected:
        FILE.write_text(replaced(AVERAGE, ("peers:\n  user: {count: 3}", EACH)), encoding="utf-8")
        assert apc.compile(FILE).groups[0].columns[0].values.tolist() == [0.0, 0.01, 0.0]


# ---- the topology that is meant ----

NOTHING = "Try: apc new"


@pytest.mark.whole
def test_the_only_topology_of_a_folder_is_the_one_that_is_meant(
    message: Say, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("part.yaml").write_text("component: Part\n", encoding="utf-8")
    Path("notes.txt").write_text("topology: no\n", encoding="utf-8")
    Path("folder.yaml").mkdir()
    assert message("analyze") == f"current folder: E610 no topology or compiled model. {NOTHING}"
    for start in ("", "\ufeff", "# mine\r\n"):
        FILE.write_text(start + AVERAGE, encoding="utf-8")
        assert run(["check"]) == 0
    assert run(["compile"]) == run(["analyze"]) == 0
    FILE.unlink()
    assert run(["analyze"]) == 0, "a model without its topology"
    capsys.readouterr()
    assert message("compile") == f"current folder: E610 no topology. {NOTHING}"
    for name in ("b", "a"):
        Path(f"{name}.yaml").write_text(AVERAGE, encoding="utf-8")
    Path("topology.apc").unlink()
    expected = "current folder: E611 topologies: expected one, got 2. Try: a.yaml, or b.yaml"
    assert message("analyze") == expected


@pytest.mark.whole
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(st.binary(max_size=60), st.text("ab:-[]{}#&*!|>'\"%@`,? \n\t<1", max_size=40).map(str.encode))
)
def test_any_bytes_are_read_or_refused_and_nothing_else(data: bytes) -> None:
    FILE.write_bytes(data)
    with pytest.raises(apc.ApcError):
        apc.compile(FILE)


@pytest.mark.whole
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.text(st.characters(exclude_categories=["C"]), max_size=20),
        st.text("0123456789eE.,+-*/^<=() Nmskgpersabif²°%[]{}_", max_size=30),
    )
)
def test_any_text_is_a_value_or_refused_and_nothing_else(text: str) -> None:
    quoted = text.replace("'", "''")
    topology = f"topology: t\npeers: {{u: {{count: 1}}}}\nparameters: {{a: '{quoted}'}}\n"
    FILE.write_text(topology, encoding="utf-8")
    with pytest.raises(apc.ApcError, match="E201 the topology has no masses section"):
        apc.compile(FILE)
