"""Composition of a tree of nodes from YAML events.

Takes: a text and its lines. Gives: `compose`, the root node.
Guarantees: scalars read by YAML 1.2's core schema (`on`, `no`, `1:30` are words); keys are scalars, unique in
their mapping; depth and the number of nodes are bounded, and nothing is constructed.
Does not: read files, or interpret keys.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NoReturn

import yaml

from apc.compiler.errors import ApcError, Mistakes, SourceLocation, nearest
from apc.compiler.source.nodes import Lines, Mapping, Node, Scalar, Sequence
from apc.compiler.source.reading import either_comma, fault
from apc.compiler.source.yaml_errors import NO_COLON, not_yaml, with_colon
from apc.compiler.wording import cut

MAX_DEPTH = 64  # levels of nesting; a topology needs about six
MAX_NODES = 100_000  # after aliases are expanded
MAX_NUMBER = (
    400  # characters of the longest scalar read as a number: Python refuses an integer of 4300 digits
)

_CORE = "tag:yaml.org,2002:"
_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_COMMA = re.compile(r"([-+]?[0-9]+),([0-9]+)(.*)", re.DOTALL)
_WORDS: dict[str, bool | float | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **{sign + word: float(sign + "inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")},
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}
_TAGGED = {"null": (type(None),), "bool": (bool,), "int": (int,), "float": (int, float)}


def _core_value(text: str) -> bool | int | float | str | None:
    """Return the value of a plain scalar by the core schema (YAML 1.2.2, section 10.3.2)."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) <= MAX_NUMBER and _INTEGER.fullmatch(text):
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
    return float(text) if len(text) <= MAX_NUMBER and _FLOAT.fullmatch(text) else text


def compose(text: str, lines: Lines) -> Node:
    """Return the root node of a text with one YAML document.

    Raises
    ------
    ApcError
        E108 an empty text, E109 invalid YAML, E110 several documents, E111 a repeated key, E112 a key that is
        not a name, E113 a tag, E114 a recursive alias or an alias without anchor, E115 too many levels, E116
        a merge key, E117 too many nodes.
    """
    composer = _Composer(text, lines)
    root: Node | None = None
    try:
        for event in composer.events:
            if isinstance(event, yaml.DocumentStartEvent):
                if root is not None:
                    location, got = lines.of(event.start_mark), "the start of a second one"
                    composer.mistakes.add("E110", location, "file", expected="one YAML document", got=got)
                    break
                root = composer.tree(next(composer.events), 1).node
    except yaml.MarkedYAMLError as error:
        composer.mistakes.take(ApcError(not_yaml(error, lines)))
    except yaml.YAMLError as error:
        composer.mistakes.add("E109", SourceLocation(lines.file), f"invalid YAML: {error}")
    composer.mistakes.raise_if_any()
    if root is None or (isinstance(root, Scalar) and root.plain and not root.text):
        raise fault("E108", SourceLocation(lines.file), "the file is empty")
    return root


@dataclass(frozen=True, slots=True)
class _Tree:
    """A node, the location of the node or its alias, its number of nodes, and its depth."""

    node: Node
    location: SourceLocation
    size: int = 1
    height: int = 1


class _Composer:
    """The composition of trees from YAML events; errors that do not prevent further reading are collected."""

    def __init__(self, text: str, lines: Lines) -> None:
        """Start the parser of a text."""
        # The C parser, if available, is about ten times faster.
        self.events: Any = yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        self.lines = lines
        self.mistakes = Mistakes()
        self.anchors: dict[str, _Tree | None] = {}  # None: the tree is not yet complete
        self.nodes = 0

    def tree(self, event: Any, depth: int) -> _Tree:
        """Return the tree that starts with an event; `depth` is its level, from 1."""
        location = self.lines.of(event.start_mark)
        if isinstance(event, yaml.AliasEvent):
            tree = self.alias(event.anchor or "", location, depth)
            self.count(tree.size, location)
            return tree
        if isinstance(event, yaml.ScalarEvent):
            tree = _Tree(
                Scalar(event.value, self.value(event, location), not event.style, location), location
            )
        else:
            tree = self.collection(event, location, depth)
        self.count(1, location)
        if event.anchor is not None:
            self.anchors[event.anchor] = tree
        return tree

    def count(self, nodes: int, location: SourceLocation) -> None:
        """Add to the number of nodes. Raises E117 for too many nodes."""
        self.nodes += nodes
        if self.nodes > MAX_NODES:
            self.give_up("E117", location, f"the file has more than {MAX_NODES} nodes, aliases expanded")

    def collection(self, event: Any, location: SourceLocation, depth: int) -> _Tree:
        """Return the tree of a sequence or mapping, from its start event to its end event."""
        is_mapping = isinstance(event, yaml.MappingStartEvent)
        if event.tag not in (None, "!", _CORE + ("map" if is_mapping else "seq")):
            self.refuse_tag(event.tag, location)
        self.check_depth(depth, location)
        if event.anchor is not None:
            self.anchors[event.anchor] = None
        trees: list[_Tree] = []  # of a mapping: alternating keys and values
        first_locations: dict[str, SourceLocation] = {}
        while not isinstance(event := next(self.events), yaml.CollectionEndEvent):
            tree = self.tree(event, depth + 1)
            if is_mapping and len(trees) % 2 == 0:
                self.check_key(tree.node, first_locations, tree.location)
            trees.append(tree)
        nodes = tuple(tree.node for tree in trees)
        node: Node = Sequence(nodes, location)
        if is_mapping:
            # A key that is not a scalar was reported; it is omitted so that the other keys can be read.
            pairs = zip(nodes[::2], nodes[1::2], strict=True)
            node = Mapping(tuple((key, value) for key, value in pairs if isinstance(key, Scalar)), location)
            self.check_entries(node)
        size = 1 + sum(tree.size for tree in trees)
        return _Tree(node, location, size, 1 + max((tree.height for tree in trees), default=0))

    def check_depth(self, depth: int, location: SourceLocation) -> None:
        """Raise E115 for too many levels."""
        if depth > MAX_DEPTH:
            self.give_up("E115", location, f"nested more than {MAX_DEPTH} levels deep")

    def check_entries(self, mapping: Mapping) -> None:
        """Record entries whose value ends at a decimal comma, and keys without a colon."""
        before: tuple[Scalar, Node] | None = None
        for key, node in mapping.entries:
            if isinstance(node, Scalar) and node.value is None and not node.text and key.plain:
                given = before[1] if before and isinstance(before[1], Scalar) else None
                if before and given and (number := _COMMA.fullmatch(f"{given.text},{key.text}")):
                    name, fix = before[0].text, either_comma(before[0].text, *number.groups())
                    expected, got = "a decimal point", number[0]
                    self.mistakes.add("E203", given.location, name, expected=expected, got=got, fix=fix)
                elif line := with_colon(key.text):
                    self.mistakes.add("E109", key.location, NO_COLON, fix=line)
            before = key, node

    def alias(self, name: str, location: SourceLocation, depth: int) -> _Tree:
        """Return the tree of an anchor. Raises E114 for an unknown or a recursive anchor."""
        if name not in self.anchors:
            close = nearest(name, self.anchors)
            self.give_up(
                "E114",
                location,
                f"the alias *{name} has no anchor &{name} before it",
                f"*{close}" if close else "",
            )
        tree = self.anchors[name]
        if tree is None:
            self.give_up("E114", location, f"the alias *{name} is inside the value of its own anchor &{name}")
        self.check_depth(depth + tree.height - 2, location)
        return _Tree(tree.node, location, tree.size, tree.height)

    def check_key(
        self, key: Node, first_locations: dict[str, SourceLocation], location: SourceLocation
    ) -> None:
        """Record a key that is not a name, a merge key, or a repeated key."""
        if not isinstance(key, Scalar) or not key.text:
            got = "nothing" if isinstance(key, Scalar) else "a list"
            got = "a mapping" if isinstance(key, Mapping) else got
            self.mistakes.add("E112", location, "key", expected="a name", got=got)
        elif key.plain and key.text == "<<":
            advice = "repeat the keys, or use an alias as the value of a key"
            self.mistakes.add("E116", location, "the merge key << is not supported", advice=advice)
        elif key.text in first_locations:
            first = first_locations[key.text].line
            self.mistakes.add("E111", location, f"{cut(key.text)!r} is given twice, first in line {first}")
        else:
            first_locations[key.text] = location

    def value(self, event: Any, location: SourceLocation) -> bool | int | float | str | None:
        """Return the value of a scalar by its tag or by the core schema; an invalid tag is recorded."""
        tag = event.tag
        if tag in (None, "!", _CORE + "str"):
            # "!" and !!str declare text, independent of the contents.
            text_only = tag is not None or bool(event.style)
            return str(event.value) if text_only else _core_value(event.value)
        value = _core_value(event.value)
        name = tag.removeprefix(_CORE)
        if name not in _TAGGED or name == tag:
            self.refuse_tag(tag, location)
        elif type(value) not in _TAGGED[name]:
            got = repr(cut(event.value))
            self.mistakes.add("E113", location, f"!!{name}", expected="a value of this type", got=got)
        return float(value) if name == "float" and type(value) is int else value

    def refuse_tag(self, tag: str, location: SourceLocation) -> None:
        """Record an unsupported tag (E113)."""
        shown = "!!" + tag.removeprefix(_CORE) if tag.startswith(_CORE) else tag
        self.mistakes.add("E113", location, f"the tag {cut(shown)!r} is not supported")

    def give_up(self, code: str, location: SourceLocation, message: str, fix: str = "") -> NoReturn:
        """Raise an error immediately, with the errors recorded so far: further reading is not possible."""
        self.mistakes.add(code, location, message, fix=fix)
        self.mistakes.raise_if_any()
        raise AssertionError("a mistake was added")
