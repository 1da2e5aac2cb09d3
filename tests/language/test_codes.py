"""Each code that a user can be told means one thing, and stands in `codes.txt` with what it means."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.topologies import ROOT

CATALOGUE = Path(__file__).with_name("codes.txt").read_text(encoding="utf-8")
ROWS = [line.split(": ", 1) for line in CATALOGUE.splitlines()]
FILES = [*(ROOT / "compiler").rglob("*.py"), *(ROOT / "runtime").rglob("*.py")]


def test_a_code_has_one_meaning_and_a_meaning_one_code() -> None:
    codes, meanings = zip(*ROWS, strict=True)
    assert len(set(codes)) == len(set(meanings)) == len(codes)


@pytest.mark.whole
def test_codes_that_are_told_are_those_of_the_catalogue_and_docstrings_name_no_others() -> None:
    pages = [path.read_text(encoding="utf-8") for path in FILES]
    nodes = [node for page in pages for node in ast.walk(ast.parse(page)) if isinstance(node, ast.Constant)]
    told = {str(node.value) for node in nodes if re.fullmatch(r"[EW]\d{3}", str(node.value))}
    assert told == {code for code, _ in ROWS}
    assert {code for page in pages for code in re.findall(r"\b[EW]\d{3}\b", page)} <= told
