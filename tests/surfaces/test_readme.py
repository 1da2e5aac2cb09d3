"""The pages show the outputs of the program.

`python -m tests.surfaces.test_readme` writes the present outputs into the pages.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tempfile
from fractions import Fraction
from pathlib import Path

import click
import pytest

from apc.cli.commands import apc as group
from apc.compiler.components import declarations
from apc.compiler.components.component import ROLES
from apc.compiler.components.component_library import Library
from apc.compiler.components.definitions import COMPONENT, CONNECTOR
from apc.compiler.components.parts import PART_KEYS
from apc.compiler.topology.channels import PROBABILITIES
from apc.compiler.topology.graphs import PAIRS
from apc.compiler.topology.groups import GROUP
from apc.compiler.topology.studies import AXES, EXPERIMENT, TUNED
from apc.compiler.topology.timebase import CLOCK
from apc.compiler.topology.topology import TOPOLOGY
from apc.compiler.view.catalogue import library_document
from tests.commands import Cli, write
from tests.topologies import ROOT

TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
REFERENCE = ROOT / "docs" / "reference"
FOLDERS = ("runtime", "compiler", "models", "tests", "docs")
PAGES = [*ROOT.glob("*.md"), *(page for name in FOLDERS for page in sorted((ROOT / name).rglob("*.md")))]
MARK = re.compile(r"<!-- output(?:, (\d+) lines)?: (.*?) -->\n```\w*\n(.*?)```", re.DOTALL)
SHOWN = [
    (page.relative_to(ROOT).as_posix(), words, int(count or 0), shown)
    for page in PAGES
    for count, words, shown in MARK.findall(page.read_text(encoding="utf-8"))
]


def test_every_mark_of_an_output_names_a_command_and_has_a_block() -> None:
    """The blocks that follow are compared below, on each page of the repository."""
    marks = [
        (page.relative_to(ROOT).as_posix(), mark)
        for page in PAGES
        for mark in re.findall(r"<!-- *output.*", page.read_text(encoding="utf-8"))
    ]
    counts = {count: f", {count} lines" if count else "" for _, _, count, _ in SHOWN}
    assert marks == [(page, f"<!-- output{counts[count]}: {words} -->") for page, words, count, _ in SHOWN]
    assert all(words == "error" or words.startswith("apc ") for _, words, *_ in SHOWN)
    assert len(SHOWN) >= 4


@pytest.mark.needs_extension("parameter_boxes")
@pytest.mark.few(3)
@pytest.mark.parametrize(("page", "words", "count", "shown"), [row for row in SHOWN if row[1] != "error"])
def test_what_is_shown_is_what_is_printed(
    page: str, words: str, count: int, shown: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for what rounding may do on another processor: the last digit, and an error by twice itself."""
    monkeypatch.chdir(ROOT)
    ran = cli(words.removeprefix("apc "))
    assert ran.code == 0, page
    out = first(ran.out, count)
    assert re.sub(r"[\s\d.]+", " ", out) == re.sub(r"[\s\d.]+", " ", shown)
    for one, other in zip(NUMBER.findall(out), NUMBER.findall(shown), strict=True):
        room = max(map(last_digit, (one, other))) if "e" not in one else max(map(Fraction, (one, other))) / 2
        assert abs(Fraction(one) - Fraction(other)) <= room, (one, other)


def first(text: str, count: int) -> str:
    """Return the first lines of a text, all of them for a count of 0."""
    return "".join(text.splitlines(keepends=True)[: count or None])


NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]\d+)?")


def last_digit(number: str) -> Fraction:
    return Fraction(1, 10 ** len(number.partition(".")[2]))


def topology_shown() -> str:
    blocks = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
    return next(str(block) for block in blocks if block.startswith("topology:"))


def without_unit() -> str:
    return topology_shown().replace("stiffness: 500 N/m", "stiffness: 500")


def test_the_topology_shown_is_a_topology_and_the_error_shown_is_its_message(cli: Cli) -> None:
    write("three-users.yaml", topology_shown())
    assert cli("check three-users.yaml").code == 0
    write("three-users.yaml", without_unit())
    ran = cli("check three-users.yaml")
    blocks = {shown for _, words, _, shown in SHOWN if words == "error"}
    assert (ran.code, {ran.err}) == (1, blocks)


def test_the_python_shown_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    code = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert code
    exec(compile("\n".join(code), "README.md", "exec"), {})  # our own text
    assert capsys.readouterr().out.startswith("True 0.9")


def test_the_readme_names_commands_of_the_program_and_has_at_most_110_lines() -> None:
    named = {words.split()[0] for words in re.findall(r"`apc ((?!COMMAND)[a-z][^`]*)`", TEXT)}
    assert named <= {*group.list_commands(click.Context(group))} and len(named) >= 8
    assert len(TEXT.splitlines()) <= 110


DOCS = ROOT / "docs"


def pages_of_the_manual() -> set[Path]:
    """Return the pages in the tables of contents, and the tutorials; a build of the manual makes some."""
    tutorials = (ROOT / "models" / "notebooks").glob("*.ipynb")
    pages = {DOCS / "tutorial" / path.name for path in tutorials}
    for index in DOCS.glob("*/index.md"):
        for names in re.findall(r"```{toctree}\n(.*?)```", index.read_text(encoding="utf-8"), re.DOTALL):
            pages |= {index.parent / f"{name}.md" for name in re.findall(r"^[\w-]+$", names, re.MULTILINE)}
    return pages


def test_every_file_linked_exists() -> None:
    listed = pages_of_the_manual()
    folders = [ROOT / name for name in ("", "models", "runtime")]
    missing = []
    for page in (*(folder / "README.md" for folder in folders), *sorted(DOCS.rglob("*.md"))):
        for target in re.findall(r"\]\((?!http|#)([^)]+)\)", page.read_text(encoding="utf-8")):
            path = (page.parent / target.partition("#")[0]).resolve()
            if not (path.exists() or path in listed):
                missing.append(f"{page.relative_to(ROOT)}: {target}")
    assert not missing, "\n".join(missing)


def test_every_folder_of_the_library_has_a_page_of_the_manual() -> None:
    """Each page lists all components of its folder, as it is generated from them."""
    listed = (REFERENCE / "components.md").read_text(encoding="utf-8")
    generator = (ROOT / "docs" / "generate.py").read_text(encoding="utf-8")
    for folder in library_document(Library(())):
        assert f"\ncomponents/{folder}\n" in listed, folder
        assert f'    "{folder}": "' in generator, folder


def test_every_key_that_is_read_is_in_the_reference() -> None:
    pages = (REFERENCE / f"{name}.md" for name in ("language", "links", "equations"))
    texts = [page.read_text(encoding="utf-8") for page in pages]
    words = {word for text in texts for word in re.findall(r"[\w-]+", text)}
    tables = (TOPOLOGY, GROUP, CLOCK, EXPERIMENT, AXES, TUNED, PART_KEYS, PAIRS, PROBABILITIES)
    tables += (COMPONENT, CONNECTOR, ROLES, declarations.VARIABLE, declarations.NUMBER)
    tables += (declarations.OPTION, declarations.TABLE)
    assert {key for table in tables for key in table} <= words


def test_the_reference_shows_the_grammar() -> None:
    rules = (ROOT / "compiler" / "language" / "expression.lark").read_text(encoding="utf-8")
    shown = rules[rules.index("expression: ") : rules.index("NUMBER: /")].strip()
    assert shown in (REFERENCE / "equations.md").read_text(encoding="utf-8")


def _present(words: str) -> str:
    """Return the present output of a command, or the message of the topology without a unit."""
    call = [sys.executable, "-m", "apc"]
    if words != "error":
        ran = subprocess.run([*call, *shlex.split(words)[1:]], cwd=ROOT, capture_output=True, check=True)
        return ran.stdout.decode()
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "three-users.yaml").write_text(without_unit(), encoding="utf-8")
        call += ["check", "three-users.yaml"]
        return subprocess.run(call, cwd=folder, capture_output=True, check=False).stderr.decode()


if __name__ == "__main__":
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        for found in reversed(list(MARK.finditer(text))):
            shown = first(_present(found[2]), int(found[1] or 0))
            text = text[: found.start(3)] + shown + text[found.end(3) :]
        path.write_text(text, encoding="utf-8")
