"""The command that makes the page of figures: it knows every benchmark of its folder."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import subprocess
from pathlib import Path

import pytest

from tests.bench.__main__ import BESIDE, HERE, PAGE, PARTS, Part, main, run, sections
from tests.bench.judge import HEAD, Judge
from tests.bench.readme import BLOCK, ERROR, PAGES, ROOT, pictures, printed, whole

HELPERS = {  # not run by themselves
    "__init__",
    "__main__",
    "by_hand",
    "growing",
    "judge",
    "sensitivity_truth",
    "shapes",
    "losses",  # draws a picture of the README
}


def test_every_benchmark_is_part_of_the_page() -> None:
    modules = {path.stem for path in HERE.glob("*.py")} - HELPERS
    named = {word.removeprefix("tests.bench.") for part in PARTS for word in part.words[:1]} - {"apc"}
    assert named == modules
    assert len({part.name for part in PARTS}) == len(PARTS)


@pytest.mark.parametrize("path", sorted(HERE.rglob("*.py")), ids=lambda path: path.stem)
def test_what_a_benchmark_imports_of_the_program_is_there(path: Path) -> None:
    for one in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(one, ast.ImportFrom) and (one.module or "").split(".")[0] == "apc":
            names = [alias.name for alias in one.names]
            found = importlib.import_module(one.module or "")
            gone = [name for name in names if not hasattr(found, name) and not _module(one.module, name)]
            assert not gone, f"{one.module} has no {gone}"


def _module(package: str | None, name: str) -> bool:
    """Say whether a name is that of a module of a package."""
    return importlib.util.find_spec(f"{package}.{name}") is not None


def test_a_quick_run_is_of_the_same_program() -> None:
    for part in PARTS:
        assert part.command(True)[0] == part.command(False)[0]
        assert part.words[0] == "apc" or importlib.util.find_spec(part.words[0])


def test_a_section_shows_its_command_its_output_and_how_it_ended() -> None:
    fine, _, code = run(Part("one", "Title", ("apc", "--version")), quick=False)
    assert code == 0
    assert fine.startswith("## Title\n\n`apc --version` (20")
    assert "```text\napc" in fine
    assert "ended with" not in fine
    wrong, _, code = run(Part("two", "T", ("apc", "check", "no.yaml")), quick=True)
    assert code == 1
    assert "It ended with code 1." in wrong


def test_what_a_program_says_on_stderr_is_kept_beside_its_output(monkeypatch: pytest.MonkeyPatch) -> None:
    both = subprocess.CompletedProcess([], 1, "a table\n", "E922 not every hard case came out right\n")
    monkeypatch.setattr("tests.bench.__main__.subprocess.run", lambda *_, **__: both)
    text, _, code = run(Part("one", "Title", ("apc", "--version")), quick=False)
    assert "```text\na table\n\nE922 not every hard case came out right\n```" in text
    assert code == 1


def test_a_part_that_fails_fails_the_page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def ran(part: Part, *_: object) -> tuple[str, list[str], int]:
        return f"## {part.title}\n", [], int(part.name == "hands")

    monkeypatch.setattr("tests.bench.__main__.PAGE", tmp_path / "README.md")
    monkeypatch.setattr("tests.bench.__main__.run", ran)
    monkeypatch.setattr("sys.argv", ["bench", "--only", "hard"])
    main()
    monkeypatch.setattr("sys.argv", ["bench"])
    with pytest.raises(SystemExit, match="failed: hands"):
        main()


def test_the_first_table_is_made_of_the_rows_of_the_parts_and_keeps_those_not_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    page = tmp_path / "README.md"
    monkeypatch.setattr("tests.bench.__main__.PAGE", page)

    def played(seconds: float, *names: str) -> list[str]:
        def ran(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
            judge = Judge()
            judge.beside(words[2].rpartition(".")[2], (seconds, "1e-9"), "by hand", (2.0, "–"))
            said = f"a line\n\n{HEAD}\n{judge.rows[0]}\n\nevery number is right\n"
            return subprocess.CompletedProcess([], 0, said, "")

        monkeypatch.setattr("tests.bench.__main__.subprocess.run", ran)
        monkeypatch.setattr("sys.argv", ["bench", *(word for name in names for word in ("--only", name))])
        main()
        found = sections(page.read_text(encoding="utf-8"))
        assert "```text\na line\n\nevery number is right\n```" in found["Regions"]
        return [line for line in found[BESIDE].splitlines() if "by hand" in line]

    row = "| {} | {} | 1e-9 | by hand | 2 s | – | {} | {} |"
    first = played(0.5, "region", "hands")
    assert first == [
        row.format("region", "500 ms", "0.25", "Regions"),
        row.format("hands", "500 ms", "0.25", "Hands"),
    ]
    assert played(4.0, "hands") == [first[0], row.format("hands", "4 s", "2", "Hands")]


def test_every_part_with_targets_knows_strict() -> None:
    for part in PARTS:
        source = HERE / f"{part.words[0].rpartition('.')[2]}.py"
        known = part.words[0] != "apc" and "parser_of(" in source.read_text(encoding="utf-8")
        assert part.timed == known, part.name
        assert ("--strict" in part.command(quick=False, strict=True)) == known


def test_the_page_has_a_section_a_part_and_gives_them_back() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert list(sections(text)) == [BESIDE, *(part.title for part in PARTS)]
    assert text.endswith("\n".join(sections(text).values()))


def test_every_picture_of_the_pages_is_drawn_by_a_command_that_stands_there() -> None:
    text = whole()
    shown = list(dict.fromkeys(re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)))
    found = pictures(text)
    assert shown
    assert list(found) == shown
    assert {words[1] for words in found.values()} == {"region", "simulate", "compare", "-m"}
    for picture, words in found.items():
        assert words[-1] == picture
        assert all((ROOT / word).is_file() for word in words if word.endswith(".yaml"))
    assert {path.name for path in (ROOT / "models" / "figures").iterdir()} == {
        Path(picture).name for picture in shown
    }


def test_every_printed_block_of_the_pages_has_a_maker_that_prints_it() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert len(BLOCK.findall(text)) == text.count("```text\n") > 0
    for words, block in BLOCK.findall(text):
        if words == ERROR:  # the commands are run by the tests of the README
            assert printed(words, text) == block


def test_every_number_of_the_readmes_prose_on_regions_stands_on_the_page() -> None:
    """1.51 to 1.85 times with damping, and the mesh ahead from where the contact is at its limit."""
    page = sections(PAGE.read_text(encoding="utf-8"))["Regions"]
    low, high = 1.5116401379, 1.8485695579
    assert f"{low:.10f}" in page
    assert f"{high:.10f}" in page
    assert f"{low:.2f} to {high:.2f} times" in whole()
