"""Claims about `apc.compiler.words`."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apc.compiler.words import WIDTH, counted, with_unit, wrapped


@pytest.mark.parametrize(("number", "expected"), [(0, "0 peers"), (1, "1 peer"), (2, "2 peers")])
def test_one_alone_has_no_plural(number: int, expected: str) -> None:
    assert counted(number, "peer") == expected


def test_a_plain_number_has_no_unit() -> None:
    assert (with_unit("0.5", "1"), with_unit("500", "N/m")) == ("0.5", "500 N/m")


@given(st.lists(st.text("abc", min_size=1, max_size=WIDTH - 4), max_size=40))
def test_lines_are_filled_up_to_the_width_and_no_word_is_lost(words: list[str]) -> None:
    lines = wrapped(" ".join(words), "  ", "    ")
    assert " ".join(" ".join(lines).split()) == " ".join(words)
    assert all(len(line) <= WIDTH for line in lines)
    for line, following in itertools.pairwise(lines):
        assert len(line) + 1 + len(following.split()[0]) > WIDTH, "the next word has its place on this line"
    assert all(line.startswith("    ") for line in lines[1:])


def test_a_word_wider_than_a_line_is_broken_behind_an_operator() -> None:
    product = "*".join(["stiffness"] * 12)
    lines = wrapped(f"f = {product}", "", "  ")
    assert "".join(line.strip() for line in lines) == f"f = {product}"
    assert len(lines) == 2 and lines[0].endswith("*") and max(map(len, lines)) <= WIDTH


def test_a_hyphen_is_no_place_to_break_a_name() -> None:
    name = "three-users-average"
    assert all(name in line for line in wrapped(" ".join([name] * 7)))


def test_a_word_that_can_not_be_broken_keeps_its_width() -> None:
    assert wrapped("a" * (WIDTH + 5)) == ["a" * (WIDTH + 5)]
    assert wrapped("") == []
