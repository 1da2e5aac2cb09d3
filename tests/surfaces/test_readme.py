"""What the README shows is what the program does."""

from __future__ import annotations

import re
from fractions import Fraction

import click
import pytest

from apc.cli.commands import apc as group
from apc.compiler.components import declarations
from apc.compiler.components.component import ROLES
from apc.compiler.components.definitions import COMPONENT, CONNECTOR
from apc.compiler.components.parts import PART_KEYS
from apc.compiler.topology.graphs import PAIRS
from apc.compiler.topology.groups import GROUP
from apc.compiler.topology.links import PROBABILITIES
from apc.compiler.topology.studies import AXES, EXPERIMENT
from apc.compiler.topology.timebase import CLOCK
from apc.compiler.topology.topology import TOPOLOGY
from tests.commands import Cli, write
from tests.topologies import ROOT

TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
ROOMS = sorted((ROOT / "runtime").glob("*/README.md"))
WHOLE = "\n".join([TEXT, *(page.read_text(encoding="utf-8") for page in ROOMS)])


def block_after(mark: str) -> str:
    """Return the fenced block that follows a mark."""
    found = re.search(re.escape(mark) + r"\n```\w*\n(.*?)```", WHOLE, re.DOTALL)
    assert found, mark
    return found.group(1)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "words",
    [
        "analyze models/topologies/three-users-average.yaml",
        "critical coordination.stiffness models/topologies/three-users-average.yaml",
    ],
)
def test_what_is_shown_is_what_is_printed(words: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for what rounding may do on another processor: the last digit, and an error by twice itself."""
    monkeypatch.chdir(ROOT)
    ran, shown = cli(words), block_after(f"<!-- output: apc {words} -->")
    assert re.sub(r"[\s\d.]+", " ", ran.out) == re.sub(r"[\s\d.]+", " ", shown)
    for one, other in zip(NUMBER.findall(ran.out), NUMBER.findall(shown), strict=True):
        room = max(map(last_digit, (one, other))) if "e" not in one else max(map(Fraction, (one, other))) / 2
        assert abs(Fraction(one) - Fraction(other)) <= room, (one, other)


NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]\d+)?")


def last_digit(number: str) -> Fraction:
    return Fraction(1, 10 ** len(number.partition(".")[2]))


def test_the_topology_shown_is_a_topology_and_the_error_shown_is_its_message(cli: Cli) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
    topology = next(block for block in blocks if block.startswith("topology:"))
    write("three-users.yaml", topology)
    assert cli("check three-users.yaml").code == 0
    write("three-users.yaml", topology.replace("stiffness: 500 N/m", "stiffness: 500"))
    ran = cli("check three-users.yaml")
    assert (ran.code, ran.err) == (1, block_after("<!-- output: error -->"))


def test_the_python_shown_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    code = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert code
    exec(compile("\n".join(code), "README.md", "exec"), {})  # our own text
    assert "stable" in capsys.readouterr().out


def test_every_command_of_the_program_stands_in_the_table() -> None:
    for command in group.list_commands(click.Context(group)):
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


def test_every_key_that_is_read_stands_in_the_reference() -> None:
    page = (ROOT / "models" / "README.md").read_text(encoding="utf-8")
    words = {*re.findall(r"[\w-]+", page)}
    tables = (TOPOLOGY, GROUP, CLOCK, EXPERIMENT, AXES, PART_KEYS, PAIRS, PROBABILITIES)
    tables += (COMPONENT, CONNECTOR, ROLES, declarations.VARIABLE, declarations.NUMBER)
    tables += (declarations.OPTION, declarations.TABLE)
    assert {key for table in tables for key in table} <= words


def test_the_reference_shows_the_grammar() -> None:
    rules = (ROOT / "compiler" / "language" / "expression.lark").read_text(encoding="utf-8")
    shown = rules[rules.index("expression: ") : rules.index("NUMBER: /")].strip()
    assert shown in (ROOT / "models" / "README.md").read_text(encoding="utf-8")
