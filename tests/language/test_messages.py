"""Every mistake is told once: its place, its code, the sentence, and a line to write that is then accepted.

`messages.txt` is the table. A row is a change to a topology or component, as a diff has it (`-` what stands
there, `+` what a user writes), and under it what `apc check` says, a mistake a line. Where that proposes what
to write, the line is put in its place and checked again: nothing is left to say. Where it says so in general
words, the row shows what a user then writes (`=`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from apc.__main__ import run
from tests.topologies import AVERAGE, replaced

HERE = Path(__file__).parent
MISTAKE = re.compile(r"^\S+\.(?:yaml|csv):(?:\d+:\d+:)? ?[EW]\d{3} .*", re.MULTILINE)


def _split(name: str, heading: str) -> list[list[str]]:
    """Return what stands under each heading of a file beside this one, behind the parts of the heading."""
    parts = re.split(rf"^# {heading}\n", (HERE / name).read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return [parts[place : place + 3] for place in range(0, len(parts), 3)]


# By section its files; the first one is changed. An empty text is the first topology of the library.
MODELS: dict[str, dict[str, str]] = {}
for section, file, body in _split("models.txt", r"(\S+) (\S+)"):
    MODELS.setdefault(section, {})[file] = body or AVERAGE
ROWS = [
    (section, row)
    for section, _, body in _split("messages.txt", "([^:]+): (.*)")
    for row in re.split(r"\n{2,}", body.strip("\n"))
]


def _lines(row: str, mark: str) -> str:
    return "\n".join(line[2:] for line in row.splitlines() if line[:2] == f"{mark} ")


def _reported(row: str) -> list[str]:
    return [line for line in row.splitlines() if line[:2] not in ("- ", "+ ", "= ")]


@pytest.fixture
def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Return what gives the mistakes that `apc check` tells of a section with its first file changed."""
    monkeypatch.chdir(tmp_path)
    Path("parts").mkdir()

    def mistakes(section: str, text: str) -> list[str]:
        changed = next(iter(MODELS[section]))
        for file, body in {**MODELS[section], changed: text}.items():
            Path(file).write_text(body, encoding="utf-8")
        code = run(["check", "topology.yaml"])
        found = MISTAKE.findall(capsys.readouterr().err)
        assert code == bool(found)
        return [line.removeprefix("./").removeprefix(f"{changed}:") for line in found]

    return mistakes


# A value behind its key: a list, a mapping, what is quoted, or words to the next comma or bracket.
VALUE = r"(?:\[[^\]]*\]|\{[^}]*\}|\"[^\"]*\"|'[^']*'|(?:[^,}\s]|(?<!\}) (?!#))*(?:,\d[^,}]*)?)"


def written(text: str, mistake: str, line: str) -> str:
    """Return a text with a line that is proposed in the place of what stands there: nothing is weighed."""
    lines = text.splitlines()
    row, column = (int(number) - 1 for number in mistake.split(":")[:2])
    before, at, key = lines[row][:column], lines[row][column:], line.partition(": ")[0]
    entry = re.compile(rf"(?<![\w.]){re.escape(key)}: ?{VALUE}")
    own = max(before.rstrip().rfind(f"{key}:"), 0)  # the key of the value at the column, if it is there
    if (row, column) == (0, 0):  # a section, which may stand anywhere
        return f"{text}{line}\n"
    if "E109" in mistake and line.startswith(", "):
        lines[row] = before + line + at.removeprefix(line[1:])
    elif "E109" in mistake:
        rest = at.partition("  #")[0] if "{" in at or "{" not in before else re.split("[,}]", at)[0]
        lines[row] = before + at.replace(rest.rstrip(), line, 1)
    elif " = " in line:
        lines[row] = before + line
    elif re.fullmatch(r"-?[\d.]+ [^\s,]+", line):  # a quantity in a list
        lines[row] = before + re.sub(r"[^,\]}]+", line, at, count=1)
    elif ": " not in line:  # a word, a unit, or what a function is called
        call = r"(\([^()]*\))?" if "(" in line and "(…)" not in line else ""
        word = line.replace("(…)", "").strip('"')
        lines[row] = before + re.sub(rf"\w[\w.]*(\[\d+\][\w.]*)?{call}|\W", word, at, count=1)
    elif found := entry.match(before + at, own) or entry.search(before + at):
        lines[row] = (before + at)[: found.start()] + line + (before + at)[found.end() :]
    else:
        lines[row] = before + at.replace("{", f"{{{line}, ", 1)
    return "\n".join(lines) + "\n"


def _named(rows: list[tuple[str, str]]) -> Any:
    return pytest.mark.parametrize(
        ("section", "row"), rows, ids=[row.partition(" Try: ")[0][-60:] for _, row in rows]
    )


@_named(ROWS)
def test_a_mistake_is_told_once_at_its_place(section: str, row: str, check: Any) -> None:
    text = next(iter(MODELS[section].values()))
    reported = check(section, replaced(text, (_lines(row, "-"), _lines(row, "+"))))
    assert reported == _reported(row)


@pytest.mark.few(30)
@_named([(section, row) for section, row in ROWS if "Try: " in row or _lines(row, "=")])
def test_what_a_message_says_to_write_is_accepted(section: str, row: str, check: Any) -> None:
    text = next(iter(MODELS[section].values()))
    old, new, instead = (_lines(row, mark) for mark in "-+=")
    wrong = replaced(text, (old, new))
    hints = [(one, one.partition("Try: ")[2].split(", or ")) for one in _reported(row) if "Try: " in one]
    if instead:
        assert check(section, replaced(text, (old, instead))) == []
        return
    for place in range(max(len(lines) for _, lines in hints)):
        right = wrong
        for mistake, lines in reversed(hints):
            right = written(right, mistake, lines[min(place, len(lines) - 1)])
        assert check(section, right) == []
