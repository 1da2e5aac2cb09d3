"""Text to YAML nodes that know where they stand.

Takes: a file, or its bytes. Gives: `Source`, the tree of `Scalar`, `Sequence` and `Mapping`.
Guarantees: scalars read by YAML 1.2's core schema (`on`, `no`, `1:30` are words); keys are scalars, unique in
their mapping; size, depth and the number of nodes are bounded; nothing recurses and nothing is constructed.
Does not: know what a topology is, or what any key means.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NoReturn

import yaml

from apc.compiler.errors import ApcError, Mistake, Mistakes, Place, nearest

MAX_BYTES = 1 << 20  # 1 MiB; the largest scene we know of is a hundredth of it
MAX_DEPTH = 64  # levels of nesting; a scene needs about six
MAX_NODES = 100_000  # after aliases are expanded
MAX_NUMBER = 400  # characters of a scalar still tried as a number: Python refuses an integer of 4300 digits


@dataclass(frozen=True, slots=True)
class Scalar:
    """A leaf: `text` as written, quotes undone; `value` by the core schema; `plain` if it was unquoted."""

    text: str
    value: bool | int | float | str | None
    plain: bool
    place: Place


@dataclass(frozen=True, slots=True)
class Sequence:
    """A list of nodes."""

    items: tuple[Node, ...]
    place: Place


@dataclass(frozen=True, slots=True)
class Mapping:
    """Keys and nodes in the order of the text; no two keys have the same text."""

    entries: tuple[tuple[Scalar, Node], ...]
    place: Place

    def get(self, key: str) -> Node | None:
        """Return the node of a key, or None when the key is not there."""
        return next((node for scalar, node in self.entries if scalar.text == key), None)

    def keys(self) -> tuple[str, ...]:
        """Return the keys in the order of the text."""
        return tuple(scalar.text for scalar, _ in self.entries)


Node = Scalar | Sequence | Mapping


@dataclass(frozen=True, slots=True)
class Source:
    """A text that was read: `file` is its name in messages, `digest` the SHA-256 of its bytes (hex)."""

    file: str
    path: Path | None
    text: str
    digest: str
    root: Node


def read_source(path: Path, *, shown: str | None = None) -> Source:
    """Read a YAML file.

    Parameters
    ----------
    path
        The file.
    shown
        Its name in messages; the path as given by default.

    Raises
    ------
    ApcError
        E101 no such file, E102 a folder, E103 not readable, E104 not a regular file;
        and those of `parse_source`.
    """
    file = str(path) if shown is None else shown
    place = Place(file)
    try:
        if path.is_dir():
            raise ApcError(Mistake("E102", place, "this", "a YAML file", "a folder"))
        with path.open("rb") if os.name == "nt" else _open(path) as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                raise ApcError(Mistake("E104", place, "this", "a YAML file", "a device, pipe or socket"))
            data = stream.read(MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise ApcError(Mistake("E101", place, _missing(path))) from None
    except PermissionError:
        raise ApcError(Mistake("E103", place, "this file may not be read (no permission)")) from None
    except (OSError, ValueError) as error:  # a name too long, a loop of links, a NUL in the name
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ApcError(Mistake("E103", place, f"this file cannot be read: {reason}")) from None
    return parse_source(data, file=file, path=path)


def parse_source(data: bytes, *, file: str, path: Path | None = None) -> Source:
    """Parse the bytes of a YAML file.

    Parameters
    ----------
    data
        UTF-8, with or without a byte order mark; lines end with LF, CRLF or CR.
    file
        The name shown in messages.
    path
        Where it came from, if from a file.

    Raises
    ------
    ApcError
        E105 too large, E106 not UTF-8, E107 control character, E108 empty, E109 not YAML,
        E110 several documents, E111 a key twice, E112 a key that is no name, E113 a tag,
        E114 an alias without end or without anchor, E115 nested too deep, E116 a merge key,
        E117 too many nodes.
    """
    if len(data) > MAX_BYTES:
        what = f"this file is larger than {MAX_BYTES} bytes, the most a YAML file may have here"
        raise ApcError(Mistake("E105", Place(file), what))
    text = _decode(data, file)
    lines = _Lines(file, text)
    _refuse_control_characters(text, lines)
    root = _Builder(lines).build(text)
    return Source(file, path, text, hashlib.sha256(data).hexdigest(), root)


def place_in(place: Place, text: str, offset: int) -> Place:
    """Return the place of character `offset` of a text that starts at `place`.

    A text folded from several lines, or one with escapes, does not stand in the source line as it is: then
    the start of the text is the best place we know.
    """
    start = place.column - 1
    if place.source_line and not place.source_line.startswith(text[:offset], max(start, 0)):
        return place
    return place.shifted(offset)


def _open(path: Path) -> IO[bytes]:
    """Open for reading without waiting: a named pipe nobody writes to would block for ever."""
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))


def _missing(path: Path) -> str:
    """Say that a file is not there, with the nearest name in its folder."""
    folder = path.parent
    try:
        known = sorted(entry.name for entry in folder.iterdir())
    except OSError:
        return f"there is no folder {str(folder)!r}"
    close = nearest(path.name, known)
    return (
        f"there is no such file; did you mean {str(folder / close)!r}?" if close else "there is no such file"
    )


def _decode(data: bytes, file: str) -> str:
    """Return the text without its byte order mark, or say which byte is not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # With a mark in front, Python counts from behind it.
        start = error.start + (len(data) - len(error.object))
        before = re.split(rb"\r\n|\n|\r", data[:start])
        line, column = len(before), len(before[-1].decode("utf-8-sig", "replace")) + 1
        got = f"byte 0x{data[start]:02x} at offset {start}"
        raise ApcError(Mistake("E106", Place(file, line, column), "a YAML file", "UTF-8 text", got)) from None


class _Lines:
    """The lines of a text, each kept once: every `Place` on a line shares its string."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.lines = re.split(r"\r\n|\n|\r", text)

    def place(self, line: int, column: int) -> Place:
        """Return a place; `line` and `column` count from 0, as YAML's marks do."""
        source_line = self.lines[line] if line < len(self.lines) else ""
        return Place(self.file, line + 1, column + 1, source_line)

    def of(self, mark: Any) -> Place:
        """Return the place of a YAML mark."""
        return self.place(mark.line, mark.column)


# YAML's line breaks beyond LF and CR (U+0085, U+2028, U+2029) show in few editors: refused with the rest.
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")


def _refuse_control_characters(text: str, lines: _Lines) -> None:
    """Raise E107 for the first character that no editor shows."""
    if (found := _CONTROL.search(text)) is None:
        return
    before = re.split(r"\r\n|\n|\r", text[: found.start()])
    character = found.group()
    name = unicodedata.name(character, "a control character")
    got = f"U+{ord(character):04X} ({name})" + (": is this a binary file" if character == "\0" else "")
    place = lines.place(len(before) - 1, len(before[-1]))
    raise ApcError(Mistake("E107", place, "a YAML file", "visible text", got))


_CORE = "tag:yaml.org,2002:"
_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WORDS: dict[str, bool | float | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **{sign + word: float(sign + "inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")},
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}


def _core_value(text: str) -> bool | int | float | str | None:
    """Resolve a plain scalar; source: YAML 1.2.2, section 10.3.2."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) > MAX_NUMBER:
        return text
    if _INTEGER.fullmatch(text):
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
    return float(text) if _FLOAT.fullmatch(text) else text


_TAGGED: dict[str, tuple[type, ...]] = {
    "null": (type(None),),
    "bool": (bool,),
    "int": (int,),
    "float": (int, float),
}


@dataclass(slots=True)
class _Open:
    """A collection whose end has not come yet."""

    mapping: bool
    place: Place
    anchor: str | None
    nodes: list[Node] = field(default_factory=list)  # of a mapping: key, value, key, value, …
    seen: dict[str, Place] = field(default_factory=dict)
    size: int = 1
    height: int = 1


@dataclass(frozen=True, slots=True)
class _Anchored:
    """A finished node with an anchor: how many nodes it stands for, and how many levels."""

    node: Node
    size: int
    height: int


class _Builder:
    """Builds the tree from YAML's events on a stack of its own."""

    def __init__(self, lines: _Lines) -> None:
        self.lines = lines
        self.mistakes = Mistakes()
        self.stack: list[_Open] = []
        self.anchors: dict[str, _Anchored | None] = {}  # None: not finished yet
        self.root: Node | None = None
        self.nodes = 0

    def build(self, text: str) -> Node:
        """Return the root; mistakes that leave the rest readable are raised together at the end."""
        documents = 0
        try:
            for event in _events(text):
                if isinstance(event, yaml.DocumentStartEvent):
                    documents += 1
                    if documents > 1:
                        place = self.lines.of(event.start_mark)
                        got = "the start of a second one"
                        self.mistakes.add("E110", place, "a file", expected="one YAML document", got=got)
                        break
                else:
                    self._take(event)
        except yaml.MarkedYAMLError as error:
            self.mistakes.take(ApcError(_not_yaml(error, self.lines)))
        except yaml.YAMLError as error:
            self.mistakes.add("E109", Place(self.lines.file), f"this is not YAML: {error}")
        self.mistakes.raise_if_any()
        root = self.root
        if root is None or (isinstance(root, Scalar) and root.plain and not root.text):
            raise ApcError(Mistake("E108", Place(self.lines.file), "this file is empty"))
        return root

    def _take(self, event: Any) -> None:
        """Put one event into the tree."""
        match event:
            case yaml.AliasEvent():
                self._alias(event)
            case yaml.ScalarEvent():
                place = self.lines.of(event.start_mark)
                plain = not event.style
                self._add(Scalar(event.value, self._value(event, place), plain, place), event.anchor, 1, 1)
            case yaml.SequenceStartEvent() | yaml.MappingStartEvent():
                self._start(event)
            case yaml.SequenceEndEvent() | yaml.MappingEndEvent():
                self._end(self.stack.pop())

    def _start(self, event: Any) -> None:
        place = self.lines.of(event.start_mark)
        mapping = isinstance(event, yaml.MappingStartEvent)
        if event.tag not in (None, "!", _CORE + ("map" if mapping else "seq")):
            self._refuse_tag(event.tag, place)
        if len(self.stack) >= MAX_DEPTH:
            self._give_up("E115", place, f"this is nested deeper than {MAX_DEPTH} levels")
        if event.anchor is not None:
            self.anchors[event.anchor] = None
        self.stack.append(_Open(mapping, place, event.anchor))

    def _end(self, done: _Open) -> None:
        node: Node
        if done.mapping:
            pairs = zip(done.nodes[::2], done.nodes[1::2], strict=True)
            # A key that is no scalar has been reported; it is left out so that the rest can be read.
            entries = tuple((key, value) for key, value in pairs if isinstance(key, Scalar))
            node = Mapping(entries, done.place)
        else:
            node = Sequence(tuple(done.nodes), done.place)
        self._add(node, done.anchor, done.size, done.height)

    def _alias(self, event: Any) -> None:
        place, name = self.lines.of(event.start_mark), event.anchor
        if name not in self.anchors:
            close = nearest(name, self.anchors)
            hint = f"*{close}" if close else ""
            self._give_up("E114", place, f"*{name} has no &{name} before it", hint)
        target = self.anchors[name]
        if target is None:
            self._give_up("E114", place, f"*{name} stands inside what it repeats: it would never end")
        if len(self.stack) + target.height - 1 > MAX_DEPTH:
            self._give_up("E115", place, f"this is nested deeper than {MAX_DEPTH} levels")
        self._add(target.node, None, target.size, target.height, at=place)

    def _add(
        self, node: Node, anchor: str | None, size: int, height: int, *, at: Place | None = None
    ) -> None:
        """Give a finished node to the collection it stands in; `at` is where an alias stands."""
        place = at or node.place
        # Leaves and aliases are counted once here; a collection's own nodes were counted as they came.
        self.nodes += size if at or isinstance(node, Scalar) else 1
        if self.nodes > MAX_NODES:
            self._give_up("E117", place, f"this file has more than {MAX_NODES} nodes, aliases written out")
        if anchor is not None:
            self.anchors[anchor] = _Anchored(node, size, height)
        if not self.stack:
            self.root = node
            return
        parent = self.stack[-1]
        if parent.mapping and len(parent.nodes) % 2 == 0:
            self._check_key(node, parent, place)
        parent.nodes.append(node)
        parent.size += size
        parent.height = max(parent.height, height + 1)

    def _check_key(self, key: Node, parent: _Open, place: Place) -> None:
        if not isinstance(key, Scalar):
            kind = "a mapping" if isinstance(key, Mapping) else "a list"
            self.mistakes.add("E112", place, "a key", expected="a name", got=kind)
        elif not key.text:
            self.mistakes.add("E112", place, "a key", expected="a name", got="nothing")
        elif key.plain and key.text == "<<":
            hint = "the keys themselves, or an alias as the value of a key"
            self.mistakes.add("E116", place, "the merge key << is not part of this language", hint=hint)
        elif key.text in parent.seen:
            first = parent.seen[key.text].line
            self.mistakes.add("E111", place, f"{_shown(key.text)} stands twice, first in line {first}")
        else:
            parent.seen[key.text] = place

    def _value(self, event: Any, place: Place) -> bool | int | float | str | None:
        tag = event.tag
        if tag in (None, "!", _CORE + "str"):
            # "!" and !!str say: text, whatever it looks like.
            text_only = tag is not None or bool(event.style)
            return str(event.value) if text_only else _core_value(event.value)
        value = _core_value(event.value)
        name = tag.removeprefix(_CORE)
        if name not in _TAGGED or not tag.startswith(_CORE):
            self._refuse_tag(tag, place)
        elif type(value) not in _TAGGED[name]:
            self.mistakes.add("E113", place, f"!!{name}", expected="such a value", got=_shown(event.value))
        return float(value) if name == "float" and type(value) is int else value

    def _refuse_tag(self, tag: str, place: Place) -> None:
        shown = "!!" + tag.removeprefix(_CORE) if tag.startswith(_CORE) else tag
        self.mistakes.add("E113", place, f"the tag {_shown(shown)} is not part of this language")

    def _give_up(self, code: str, place: Place, what: str, hint: str = "") -> NoReturn:
        """Raise at once, with what was found before: reading on would mislead, or not end."""
        self.mistakes.add(code, place, what, hint=hint)
        self.mistakes.raise_if_any()
        raise AssertionError("a mistake was added")


def _events(text: str) -> Iterator[Any]:
    """Return YAML's events, by the C parser where PyYAML has it (about ten times faster)."""
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    events: Iterator[Any] = yaml.parse(text, Loader=loader)
    return events


def _shown(text: str) -> str:
    """Return a text short enough for a message."""
    return repr(text if len(text) <= 40 else text[:37] + "…")


# Part of PyYAML's problem, or of what it was doing, in either of its two parsers -> our sentence and hint.
_PROBLEMS: tuple[tuple[str, str, str], ...] = (
    ("unexpected end of stream", "this quote is never closed", ""),
    (
        "quoted scalar",
        "this quoted text is broken: a line starts in the wrong place or an escape is unknown",
        "",
    ),
    (
        "mapping values are not allowed",
        "a ': ' cannot stand here: the line above ends wrongly, or the text needs quotes",
        "key: 'text: with a colon'",
    ),
    (
        "<document start>",
        "this line belongs to nothing above it: its indent or a closing bracket is wrong",
        "",
    ),
    ("node content", "a value or a closing bracket is missing here", ""),
    ("could not find expected ':'", "this line is neither 'key: value' nor '- item'", "key: value"),
    ("expected ',' or '}'", "this { is never closed, or a comma is missing behind it", ""),
    ("expected ',' or ']'", "this [ is never closed, or a comma is missing behind it", ""),
    ("flow mapping", "this { is never closed, or a comma is missing behind it", ""),
    ("flow sequence", "this [ is never closed, or a comma is missing behind it", ""),
    ("block mapping", "this line is indented differently from the keys it belongs to", ""),
    ("block collection", "this line is indented differently from the items it belongs to", ""),
    ("block sequence", "this line is indented differently from the items it belongs to", ""),
)


def _not_yaml(error: yaml.MarkedYAMLError, lines: _Lines) -> Mistake:
    """Rewrite PyYAML's error as one sentence at the place that has to change."""
    mark = error.problem_mark or error.context_mark
    if mark is None:
        return Mistake("E109", Place(lines.file), f"this is not YAML: {error.problem}")
    place = lines.of(mark)
    rest = place.source_line[place.column - 1 :]
    indent = place.source_line[: len(place.source_line) - len(place.source_line.lstrip())]
    if "\t" in indent or rest.startswith("\t"):
        return Mistake("E109", place, "a tab indents this line, and YAML allows spaces only", hint="spaces")
    if "cannot start any token" in (error.problem or ""):
        quoted = f"'{rest.strip()[:40]}'"
        return Mistake("E109", place, f"a text starting with {rest[:1]} needs quotes", hint=quoted)
    told = f"{error.problem}; {error.context}"
    for part, sentence, hint in _PROBLEMS:
        if part in told:
            opened = sentence.startswith("this ") and error.context_mark is not None
            where = lines.of(error.context_mark) if opened and "indented" not in sentence else place
            return Mistake("E109", where, sentence, hint=hint)
    return Mistake("E109", place, f"this is not YAML: {error.problem}")
