"""YAML's events to a tree of nodes: composing, as YAML calls it.

Takes: a text and its lines. Gives: `compose`, the root node.
Guarantees: scalars read by YAML 1.2's core schema (`on`, `no`, `1:30` are words); keys are scalars, unique in
their mapping; depth and the number of nodes are bounded; nothing recurses and nothing is constructed.
Does not: read files, or know what any key means.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NoReturn

import yaml

from apc.compiler.errors import ApcError, Mistake, Mistakes, Place, nearest
from apc.compiler.source.nodes import Lines, Mapping, Node, Scalar, Sequence
from apc.compiler.source.reading import either_comma
from apc.compiler.source.yaml_faults import NO_COLON, not_yaml, with_colon
from apc.compiler.words import cut

MAX_DEPTH = 64  # levels of nesting; a scene needs about six
MAX_NODES = 100_000  # after aliases are expanded
MAX_NUMBER = 400  # characters of a scalar still tried as a number: Python refuses an integer of 4300 digits


_CORE = "tag:yaml.org,2002:"
_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WHOLE = re.compile(r"[-+]?[0-9]+")
_DIGITS = re.compile(r"[0-9]+")
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


def compose(text: str, lines: Lines) -> Node:
    """Return the root node of a text of one YAML document.

    Raises
    ------
    ApcError
        E108 empty, E109 not YAML, E110 several documents, E111 a key twice, E112 a key that is no name,
        E113 a tag, E114 an alias without end or without anchor, E115 nested too deep, E116 a merge key,
        E117 too many nodes.
    """
    return _Composer(lines).build(text)


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


class _Composer:
    """Builds the tree from YAML's events on a stack of its own."""

    def __init__(self, lines: Lines) -> None:
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
            self.mistakes.take(ApcError(not_yaml(error, self.lines)))
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
            self._check_entries(entries)
            node = Mapping(entries, done.place)
        else:
            node = Sequence(tuple(done.nodes), done.place)
        self._add(node, done.anchor, done.size, done.height)

    def _check_entries(self, entries: tuple[tuple[Scalar, Node], ...]) -> None:
        """Record a decimal comma, which ends a value, and a key without its colon."""
        before: tuple[Scalar, Node] | None = None
        for key, node in entries:
            if isinstance(node, Scalar) and node.value is None and not node.text and key.plain:
                given = before[1] if before is not None else None
                if key.text[:1].isdigit() and isinstance(given, Scalar) and _WHOLE.fullmatch(given.text):
                    assert before is not None
                    name, number = before[0].text, f"{given.text},{key.text}"
                    digits = _DIGITS.match(key.text)
                    assert digits is not None
                    hint = either_comma(name, given.text, digits[0], key.text[digits.end() :])
                    self.mistakes.add(
                        "E203", given.place, name, expected="a decimal point", got=number, hint=hint
                    )
                elif line := with_colon(key.text):
                    self.mistakes.add("E109", key.place, NO_COLON, hint=line)
            before = key, node

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
    """Return a text short enough for a message, in quotes."""
    return repr(cut(text))
