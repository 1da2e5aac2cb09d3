"""`reading`: a node of the wrong form is one mistake, and reading goes on."""

from __future__ import annotations

import pytest

from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    form,
    read_mapping,
    read_name,
    read_text,
)
from apc.compiler.source.source import parse_source

HERE = Place("a.yaml", 1, 1)


def node(text: str) -> Node:
    return parse_source(text.encode(), file="a.yaml").root


def mapping(text: str) -> Mapping:
    found = node(text)
    assert isinstance(found, Mapping)
    return found


def sentences(mistakes: Mistakes) -> list[str]:
    try:
        mistakes.raise_if_any()
    except ApcError as error:
        return [str(mistake).splitlines()[0] for mistake in error.mistakes]
    return []


@pytest.mark.parametrize(
    ("text", "words"), [("{a: 1}", "a mapping"), ("[1]", "a list"), ("hello", "hello"), ("''", "nothing")]
)
def test_a_node_is_told_in_words(text: str, words: str) -> None:
    assert form(node(text)) == words


def test_a_long_text_is_told_in_sixty_characters_on_one_line() -> None:
    assert brief("x\n" * 100) == "x " * 28 + "x..."
    assert brief("short  text") == "short text"


def test_a_list_where_a_mapping_is_due_is_one_mistake_with_a_line_to_write() -> None:
    mistakes = Mistakes()
    assert read_mapping(node("[1]"), "clocks", mistakes, hint="clocks: {haptic: 1 ms}") is None
    assert sentences(mistakes) == [
        "a.yaml:1:1: E203 clocks wants a mapping of keys to values, got a list. Write: clocks: {haptic: 1 ms}"
    ]


def test_what_is_missing_is_no_mistake_here() -> None:
    mistakes = Mistakes()
    assert read_mapping(None, "clocks", mistakes) is None
    assert read_text(None, "clock", mistakes) is None
    assert list(entries(None)) == []
    assert not mistakes


@pytest.mark.parametrize(("text", "got"), [("{a: 1}", "a mapping"), ("[1]", "a list"), ("' '", "nothing")])
def test_a_single_value_is_neither_a_collection_nor_empty(text: str, got: str) -> None:
    mistakes = Mistakes()
    assert read_text(node(text), "clock", mistakes) is None
    assert sentences(mistakes) == [f"a.yaml:1:1: E203 clock wants a single value, got {got}."]


@pytest.mark.parametrize("text", ["_x", "1x", "a-b", "ä", "a.b", "x" * 64, "__class__"])
def test_a_name_is_a_letter_then_letters_digits_underscores(text: str) -> None:
    mistakes = Mistakes()
    scalar = node(text)
    assert isinstance(scalar, Scalar)
    assert read_name(scalar, "a clock", mistakes) is None
    wanted = "a letter followed by letters, digits or underscores (63 at most)"
    assert sentences(mistakes) == [
        f"a.yaml:1:1: E205 the name of a clock wants {wanted}, got {brief(scalar.text)}"
        + ("" if len(text) > 60 else ".")
    ]


def test_a_misspelt_key_is_told_and_read_as_it_was_meant() -> None:
    mistakes = Mistakes()
    meant = check_keys(mapping("{stifness: 3}"), ("stiffness", "clock"), "contact", mistakes)
    assert sentences(mistakes) == [
        "a.yaml:1:2: E202 contact has no key stifness; the nearest is stiffness. Write: stiffness"
    ]
    assert isinstance(value := meant.get("stiffness"), Scalar)
    assert value.text == "3"


def test_a_misspelt_key_never_replaces_the_right_one() -> None:
    meant = check_keys(mapping("{stiffness: 1, stifness: 2}"), ("stiffness",), "contact", Mistakes())
    assert isinstance(value := meant.get("stiffness"), Scalar)
    assert value.text == "1"


@pytest.mark.parametrize(
    ("known", "ending"),
    [
        (("haptic", "network"), "; the nearest is haptic. Write: haptic"),
        (("one", "two"), "; there are: one, two."),
        ((), "; there is none."),
        (tuple("abcdefghijklmn"), "; there are: a, b, c, d, e, f, g, h, i, j, k, l, …."),
    ],
)
def test_an_unknown_name_gets_the_nearest_or_the_list(known: tuple[str, ...], ending: str) -> None:
    mistakes = Mistakes()
    add_unknown("E206", HERE, "no clock hptic", "hptic", known, mistakes)
    assert sentences(mistakes) == [f"a.yaml:1:1: E206 no clock hptic{ending}"]
