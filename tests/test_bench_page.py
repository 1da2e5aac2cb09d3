"""The command that makes the page of figures: it knows every benchmark of its folder."""

from __future__ import annotations

import importlib.util

from tests.bench.__main__ import HERE, PAGE, PARTS, Part, run, sections

HELPERS = {"__init__", "__main__", "naive_region"}  # not run by themselves


def test_every_benchmark_is_part_of_the_page() -> None:
    modules = {path.stem for path in HERE.glob("*.py")} - HELPERS
    named = {word.removeprefix("tests.bench.") for part in PARTS for word in part.words[:1]} - {"apc"}
    assert named == modules
    assert len({part.name for part in PARTS}) == len(PARTS)


def test_a_quick_run_is_of_the_same_program() -> None:
    for part in PARTS:
        assert part.command(True)[0] == part.command(False)[0]
        assert part.words[0] == "apc" or importlib.util.find_spec(part.words[0])


def test_a_section_shows_its_command_its_output_and_how_it_ended() -> None:
    fine = run(Part("one", "Title", ("apc", "--version")), quick=False)
    assert fine.startswith("## Title\n\n`apc --version` (20")
    assert "```text\napc" in fine
    assert "ended with" not in fine
    assert "It ended with code 1." in run(Part("two", "T", ("apc", "check", "no.yaml")), quick=True)


def test_the_page_has_a_section_a_part_and_gives_them_back() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert list(sections(text)) == [part.title for part in PARTS]
    assert text.endswith("\n".join(sections(text).values()))
