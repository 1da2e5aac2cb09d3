"""`source`: YAML 1.2's core schema with places, and every way a file can be refused."""

import hashlib
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apc.compiler.errors import ApcError, Place, place_in
from apc.compiler.source.nodes import MAX_BYTES, Mapping, Node, Scalar, Sequence
from apc.compiler.source.source import parse_source, read_source


def root(text: str | bytes) -> Node:
    data = text if isinstance(text, bytes) else text.encode()
    return parse_source(data, file="a.yaml").root


def mapping(text: str | bytes) -> Mapping:
    node = root(text)
    assert isinstance(node, Mapping)
    return node


def value(text: str) -> object:
    node = mapping(f"a: {text}\n").get("a")
    assert isinstance(node, Scalar)
    return node.value


def refusal(text: str | bytes) -> list[str]:
    """The first line of every message."""
    with pytest.raises(ApcError) as caught:
        root(text)
    return [str(mistake).splitlines()[0] for mistake in caught.value.mistakes]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(("true", True), ("False", False), ("null", None), ("~", None), ("", None)),
        *(("12", 12), ("-7", -7), ("0o17", 15), ("0x1F", 31), ("010", 10)),
        *(("1.5", 1.5), (".5", 0.5), ("5.", 5.0), ("1e3", 1000.0), ("-.inf", -float("inf"))),
        *(("!!str 5", "5"), ("!!float 5", 5.0), ("'5'", "5"), ('"a\\tb"', "a\tb")),
    ],
)
def test_scalars_follow_the_core_schema_of_yaml_1_2(text: str, expected: object) -> None:
    assert value(text) == expected
    assert type(value(text)) is type(expected)


@pytest.mark.parametrize(
    "text",
    ["on", "off", "yes", "no", "y", "1:30", "2001-01-01", "0b1", "1_000", "500 N/m", "1 ms", "tRUE", "nan"],
)
def test_what_yaml_1_1_would_convert_stays_a_word(text: str) -> None:
    assert value(text) == text


def test_a_number_of_a_million_digits_stays_a_word() -> None:
    assert isinstance(value("9" * 100_000), str)


def test_every_node_knows_line_and_column_from_1_and_its_line() -> None:
    node = mapping("a: 1\nb:\n  - {c: 'µ', d: 2}\n")
    items = node.get("b")
    assert isinstance(items, Sequence)
    inner = items.items[0]
    assert isinstance(inner, Mapping)
    assert inner.place == Place("a.yaml", 3, 5, "  - {c: 'µ', d: 2}")
    assert node.keys() == ("a", "b")
    assert node.get("no such key") is None


def test_a_byte_order_mark_and_windows_line_ends_are_accepted() -> None:
    node = mapping(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    places = [key.place for key, _ in node.entries]
    assert places == [Place("a.yaml", 1, 1, "a: 1"), Place("a.yaml", 2, 1, "b: 2")]


def test_places_on_a_long_line_share_its_text() -> None:
    node = mapping("a: [" + "1, " * 50_000 + "1]")
    items = node.get("a")
    assert isinstance(items, Sequence)
    assert items.items[0].place.source_line is items.items[-1].place.source_line


def test_an_alias_repeats_its_anchor() -> None:
    node = mapping("a: &x {c: 1}\nb: *x\n")
    assert node.get("a") == node.get("b")


def test_the_digest_is_that_of_the_bytes() -> None:
    assert parse_source(b"a: 1", file="a").digest == hashlib.sha256(b"a: 1").hexdigest()


def test_a_character_of_a_text_is_found_in_its_line_unless_it_was_folded() -> None:
    place = Place("a", 1, 4, "a: f = g + h")
    assert place_in(place, "f = g + h", 8).column == 12
    assert place_in(place, "f = other + h", 12) == place


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "a.yaml: E108 this file is empty."),
        (b"# only a comment\n", "a.yaml: E108 this file is empty."),
        (b"---\n", "a.yaml: E108 this file is empty."),
        (b"a: \xff", "a.yaml:1:4: E106 a YAML file wants UTF-8 text, got byte 0xff at offset 3."),
        (
            b"\xef\xbb\xbfa: \xff",
            "a.yaml:1:4: E106 a YAML file wants UTF-8 text, got byte 0xff at offset 6.",
        ),
        (
            b"a: \x00",
            "a.yaml:1:4: E107 a YAML file wants visible text, got U+0000 (a control character)"
            ": is this a binary file.",
        ),
        (
            "a: x\u2028y",
            "a.yaml:1:5: E107 a YAML file wants visible text, got U+2028 (LINE SEPARATOR).",
        ),
        (
            "a: 1\n---\nb: 2\n",
            "a.yaml:2:1: E110 a file wants one YAML document, got the start of a second one.",
        ),
        (
            "a:\n\tb: 1\n",
            "a.yaml:2:1: E109 a tab indents this line, and YAML allows spaces only. Write: spaces",
        ),
        ("a: [1, 2\nb: 3", "a.yaml:1:4: E109 this [ is never closed, or a comma is missing behind it."),
        ("a: {b: 1\nc: 3", "a.yaml:1:4: E109 this { is never closed, or a comma is missing behind it."),
        ("a: 'x\nb: 1\n", "a.yaml:1:4: E109 this quote is never closed."),
        ("a: @x\n", "a.yaml:1:4: E109 a text starting with @ needs quotes. Write: '@x'"),
        (
            "a: b: c\n",
            "a.yaml:1:5: E109 a ': ' cannot stand here: the line above ends wrongly, or the text needs"
            " quotes. Write: key: 'text: with a colon'",
        ),
        (
            "a: 1\nb\nc: 2\n",
            "a.yaml:2:1: E109 a key stands here without its colon and a space. Write: b:",
        ),
        (
            "a:\n  b: 1\n c: 2\n",
            "a.yaml:3:2: E109 this line is indented differently from the keys it belongs to.",
        ),
        ("? [a]\n: b\n", "a.yaml:1:3: E112 a key wants a name, got a list."),
        (
            "x: !!python/object/apply:os.system ['true']",
            "a.yaml:1:4: E113 the tag '!!python/object/apply:os.system' is not part of this language.",
        ),
        ("x: !mine 3", "a.yaml:1:4: E113 the tag '!mine' is not part of this language."),
        ("x: !!int y", "a.yaml:1:4: E113 !!int wants such a value, got 'y'."),
        ("a: &x [*x]", "a.yaml:1:8: E114 *x stands inside what it repeats: it would never end."),
        ("a: &one 1\nb: *ome", "a.yaml:2:4: E114 *ome has no &ome before it. Write: *one"),
        ("[" * 65, "a.yaml:1:65: E115 this is nested deeper than 64 levels."),
        (
            "a: &x {b: 1}\nc: {<<: *x}",
            "a.yaml:2:5: E116 the merge key << is not part of this language."
            " Write: the keys themselves, or an alias as the value of a key",
        ),
    ],
)
def test_a_text_that_is_refused_says_where_and_why(text: str | bytes, message: str) -> None:
    assert refusal(text) == [message]


def test_keys_that_stand_twice_are_reported_together_with_their_first_line() -> None:
    assert refusal("a: 1\nb: {c: 1, 'c': 2}\na: 2\n") == [
        "a.yaml:2:11: E111 'c' stands twice, first in line 2.",
        "a.yaml:3:1: E111 'a' stands twice, first in line 1.",
    ]


def test_aliases_that_explode_are_refused() -> None:
    levels = "".join(
        f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    (message,) = refusal("a: &a [1, 1, 1]\n" + levels)
    assert message.endswith("E117 this file has more than 100000 nodes, aliases written out.")


def test_aliases_cannot_build_what_is_too_deep_to_write() -> None:
    nested = "a: &a " + "[" * 40 + "]" * 40 + "\nb: " + "[" * 30 + "*a" + "]" * 30
    assert "E115" in refusal(nested)[0]


def test_a_million_brackets_are_refused_without_recursion() -> None:
    assert "E115" in refusal("[" * (MAX_BYTES - 1))[0]


def test_a_file_of_a_byte_too_many_is_refused() -> None:
    assert refusal(b" " * (MAX_BYTES + 1)) == [
        "a.yaml: E105 this file is larger than 1048576 bytes, the most a YAML file may have here."
    ]


def reading(path: Path) -> str:
    with pytest.raises(ApcError) as caught:
        read_source(path, shown="shown.yaml")
    return str(caught.value)


def test_a_file_is_read_under_the_name_it_is_shown_by(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b"a: 1\n")
    source = read_source(tmp_path / "a.yaml", shown="shown.yaml")
    assert (source.file, source.path, source.text) == ("shown.yaml", tmp_path / "a.yaml", "a: 1\n")
    assert source.root.place.file == "shown.yaml"
    assert read_source(tmp_path / "a.yaml").file == str(tmp_path / "a.yaml")


def test_a_missing_file_names_the_nearest_one(tmp_path: Path) -> None:
    (tmp_path / "three-users.yaml").write_text("a: 1")
    near = str(tmp_path / "three-users.yaml")
    assert reading(tmp_path / "thre-users.yaml") == (
        f"shown.yaml: E101 there is no such file; did you mean {near!r}?"
    )
    assert reading(tmp_path / "zzz") == "shown.yaml: E101 there is no such file."
    assert reading(tmp_path / "no" / "a.yaml").startswith("shown.yaml: E101 there is no folder ")
    assert reading(tmp_path / "three-users.yaml" / "b").startswith("shown.yaml: E101 ")


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    assert reading(tmp_path) == "shown.yaml: E102 this wants a YAML file, got a folder."


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000])
def test_a_name_no_file_can_have_is_refused(tmp_path: Path, name: str) -> None:
    assert "shown.yaml: E10" in reading(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_or_device_is_refused_without_waiting_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    expected = "shown.yaml: E104 this wants a YAML file, got a device, pipe or socket."
    assert reading(tmp_path / "pipe") == expected
    assert reading(Path("/dev/zero")) == expected


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: 1")
    (tmp_path / "a.yaml").chmod(0)
    assert reading(tmp_path / "a.yaml") == "shown.yaml: E103 this file may not be read (no permission)."


@settings(max_examples=200)
@given(
    st.one_of(st.binary(max_size=60), st.text("ab:-[]{}#&*!|>'\"%@`,? \n\t<1", max_size=40).map(str.encode))
)
def test_any_bytes_are_read_or_refused_and_nothing_else(data: bytes) -> None:
    try:
        parse_source(data, file="a.yaml")
    except ApcError as error:
        assert str(error)
