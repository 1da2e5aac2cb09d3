"""The catalogue of message codes has an entry for each code, and its examples print their messages."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from apc.compiler.message_catalogue import (
    MessageEntry,
    MessageExample,
    catalogue,
    ranges,
    without_example,
)
from tests.commands import Cli
from tests.topologies import ROOT

CODE = re.compile(r"[EW]\d{3}")
FILES = [*(ROOT / "compiler").rglob("*.py"), *(ROOT / "runtime").rglob("*.py")]
PRINTED = Path(__file__).with_name("messages.txt").read_text(encoding="utf-8")
EXAMPLES = [(entry.code, entry.example) for entry in catalogue().values() if entry.example is not None]

LONGEST_TITLE, LONGEST_SENTENCE = 70, 25  # characters, words


def test_each_code_in_the_sources_has_an_entry_and_each_entry_a_code() -> None:
    texts = [path.read_text(encoding="utf-8") for path in FILES]
    used = {code for text in texts for code in re.findall(rf'"({CODE.pattern})"', text)}
    assert used == {*catalogue()}
    named = {code for text in texts for code in re.findall(rf"\b{CODE.pattern}\b", text)}
    assert named <= used, "a docstring or comment names a code that is not raised"


def test_codes_are_sorted_within_ranges_that_have_a_heading() -> None:
    codes = [*catalogue()]
    assert list(dict.fromkeys(code[:2] for code in codes)) == [*ranges()]
    for start, heading in ranges().items():
        members = [code for code in codes if code.startswith(start)]
        assert heading and members == sorted(members)


def test_titles_are_unique() -> None:
    titles = [entry.title for entry in catalogue().values()]
    assert len({*titles}) == len(titles)


def sentences(text: str) -> list[str]:
    return re.split(r"(?<=\.)\s+(?=[A-Z`])", text)


@pytest.mark.parametrize("entry", catalogue().values(), ids=[*catalogue()])
def test_an_entry_has_a_title_a_cause_and_a_remedy_within_limits(entry: MessageEntry) -> None:
    assert 0 < len(entry.title) <= LONGEST_TITLE and not entry.title.endswith(".")
    for text in (entry.cause, entry.remedy):
        assert text.endswith(".") and "\n" not in text
        assert 1 <= len(sentences(text)) <= 2
        assert all(len(sentence.split()) <= LONGEST_SENTENCE for sentence in sentences(text))


def test_each_code_has_an_example_or_a_reason() -> None:
    exemplified = {code for code, _ in EXAMPLES} | {*CODE.findall(PRINTED)}
    assert exemplified.isdisjoint(without_example())
    assert exemplified | {*without_example()} == {*catalogue()}
    assert all(without_example().values())


@pytest.mark.parametrize(("code", "example"), EXAMPLES, ids=[code for code, _ in EXAMPLES])
def test_the_message_of_an_example_begins_with_its_code(code: str, example: MessageExample) -> None:
    assert example.message.startswith(f"{code} ") and example.command.startswith("apc ")


@pytest.mark.few(5)
@pytest.mark.parametrize(("code", "example"), EXAMPLES, ids=[code for code, _ in EXAMPLES])
def test_the_command_of_an_example_prints_its_message(code: str, example: MessageExample, cli: Cli) -> None:
    for name, text in example.files:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text, encoding="utf-8")
    if not example.files:
        compiled = shutil.ignore_patterns("*.apc")
        shutil.copytree(ROOT / "models" / "topologies", ".", ignore=compiled, dirs_exist_ok=True)
    ran = cli(example.command.removeprefix("apc "))
    assert ran.code == (code[0] == "E")
    printed = " ".join(f"{ran.out} {ran.err}".split())  # warnings are wrapped
    message = " ".join(example.message.split())
    assert re.search(re.escape(message).replace("…", ".*"), printed), printed
