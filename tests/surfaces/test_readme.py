"""What the README shows is what the program does."""

from __future__ import annotations

import re
from fractions import Fraction
from itertools import zip_longest
from pathlib import Path

import pytest
from click.testing import CliRunner

from apc.__main__ import run

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
ROOMS = sorted((ROOT / "runtime").glob("*/README.md"))
WHOLE = "\n".join([TEXT, *(page.read_text(encoding="utf-8") for page in ROOMS)])


def block_after(mark: str) -> str:
    """Return the fenced block that follows a mark."""
    found = re.search(re.escape(mark) + r"\n```\w*\n(.*?)```", WHOLE, re.DOTALL)
    assert found, mark
    return found.group(1)


def test_the_analysis_shown_is_what_analyze_prints(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    mark = "<!-- output: apc analyze models/scenes/three-users-average.yaml -->"
    assert run(["analyze", "models/scenes/three-users-average.yaml"]) == 0
    assert differences(capsys.readouterr().out, block_after(mark)) == []


def test_the_critical_value_shown_is_what_critical_prints(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    words = ["critical", "coordination.stiffness", "models/scenes/three-users-average.yaml"]
    assert run(words) == 0
    assert differences(capsys.readouterr().out, block_after(f"<!-- output: apc {' '.join(words)} -->")) == []


def differences(printed: str, shown: str) -> list[tuple[str, str]]:
    """Return the lines that are not the same, but for what rounding may do on another processor.

    A number with an error may be anywhere within both; an error is a bound, and may be twice another one; the
    last digit of any other number may be the next.
    """
    pairs = list(zip_longest(printed.splitlines(), shown.splitlines(), fillvalue=""))
    return [pair for pair in pairs if not _same(*pair)]


NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?")


def _same(one: str, other: str) -> bool:
    pieces = [NUMBER.split(re.sub(r"\s+", " ", line)) for line in (one.rstrip(), other.rstrip())]
    numbers = list(zip(NUMBER.findall(one), NUMBER.findall(other), strict=False))
    if pieces[0] != pieces[1]:
        return False
    for place, (a, b) in enumerate(numbers):
        before, after = pieces[0][place], pieces[0][place + 1]
        room = max(_last_digit(a), _last_digit(b))
        if "±" in after:
            room = sum(Fraction(error) for error in numbers[place + 1])
        elif "±" in before:
            room = max(Fraction(a), Fraction(b)) / 2
        if abs(Fraction(a) - Fraction(b)) > room:
            return False
    return True


def _last_digit(number: str) -> Fraction:
    digits, _, power = number.partition("e")
    return Fraction(10) ** (int(power or 0) - len(digits.partition(".")[2]))


def test_a_number_is_another_one_beyond_its_error_or_its_last_digit() -> None:
    line = "  spectral radius  0.9571713896250 ± 5e-13 per frame of 8 ms"
    assert differences(line, line.replace("6250", "6257").replace("5e-13", "7e-13")) == []
    assert differences(line, line.replace("6250", "6310"))
    assert differences(line, line.replace("5e-13", "5e-12"))
    assert differences(line, line.replace("8 ms", "10 ms"))
    assert differences(line, line.replace("± 5e-13 ", ""))
    assert differences(line, line.replace("frame", "tick"))
    row = "   0.957171  difference      2   19.65 Hz   0.0443  device.x 27%, device.v 25%"
    assert differences(row, row.replace("27%", "28%").replace("0.957171", "0.957172")) == []
    assert differences(row, row.replace("27%", "29%"))
    assert differences(row, row + "\n") == []
    assert differences(row, f"{row}\nmore")


def test_the_topology_shown_is_a_scene_and_the_error_shown_is_its_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    topology = next(
        block for block in re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL) if block.startswith("topology:")
    )
    Path("three-users.yaml").write_text(topology, encoding="utf-8")
    assert run(["check", "three-users.yaml"]) == 0
    broken = topology.replace("stiffness: 500 N/m", "stiffness: 500")
    Path("three-users.yaml").write_text(broken, encoding="utf-8")
    capsys.readouterr()
    assert run(["check", "three-users.yaml"]) == 1
    assert capsys.readouterr().err == block_after("<!-- output: error -->")


def test_the_python_shown_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    code = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert code
    exec(compile("\n".join(code), "README.md", "exec"), {})  # our own text
    assert "stable" in capsys.readouterr().out


def test_every_command_of_the_program_stands_in_the_table() -> None:
    from apc.cli.commands import apc

    help_text = CliRunner().invoke(apc, ["--help"]).output
    commands = re.findall(r"^  (\w+)  ", help_text.split("Commands:")[1], re.MULTILINE)
    for command in commands:
        assert f"| `apc {command}" in TEXT, command


def test_every_file_linked_exists() -> None:
    for page in (ROOT / "README.md", ROOT / "models" / "README.md", *ROOMS):
        for target in re.findall(r"\]\((?!http|#)([^)]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target.partition("#")[0]).exists(), target


def test_every_component_of_the_library_stands_in_its_reference() -> None:
    page = (ROOT / "models" / "README.md").read_text(encoding="utf-8")
    for path in sorted((ROOT / "models").rglob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        found = re.match(r"component: (\w+)", text)
        if found:
            assert f"[`{found.group(1)}`]({path.relative_to(ROOT / 'models')})" in page, path
