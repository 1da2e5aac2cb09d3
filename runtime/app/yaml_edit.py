"""A topology with other values in it: the text as its author wrote it, except for the numbers.

Takes: the text of a topology; names and quantities, as `--set` takes them.
Gives: `with_values`, `write_topology`.
Guarantees: comments, order and layout stay; a number is written where it is, or where it belongs if it was
left to its default; a value that aliases share changes in one place only. The text compiles to the model
with these values and no other number changed, or it is refused and nothing is written.
Does not: know what a number means; change a table of peers.

The text is cut at the marks of the events of the parser that the compiler uses. A round-trip library writes
the spaces between the entries of a flow mapping anew, and refuses tabs that this parser reads.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import yaml

from apc.analysis.analysis import analyze
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import write_text
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.pipeline import compile_again, stages_of
from apc.compiler.source.source import parse_source
from apc.frame.overrides import apply, parse_override
from apc.frame.parameter_names import ParameterRef
from apc.frame.parameters import columns_of
from apc.frame.start_checks import check_values

PARTS = ("masses", "couplers", "hands", "links")
# Scalars that are the same text inside a flow mapping.
_PLAIN = re.compile(r"(?:[\w.(][\w .+*/^%()@-]*[\w.)%]|[\w.])?\Z|[-+][\w.(][\w .+*/^%()-]*\Z")
_BLOCK_COMMENT = re.compile(r"[|>][-+0-9]*([ \t]+#[^\r\n]*)")


def write_topology(path: Path, text: str, system: Model, values: Mapping[ParameterRef, str]) -> None:
    """Write the text of a topology with other values to a file, once it is known to compile to them there.

    Parameters
    ----------
    path
        The file to write; files that the topology names are searched for in its folder.
    text, system, values
        As for `with_values`.

    Raises
    ------
    ApcError
        E601 it can't be written, E997 the text would not have these values, and those of the compiler.
    """
    changed = _changed(text, system, values)
    *_, (_, compiled) = stages_of(parse_source(changed.encode(), file=str(path), path=path))
    assert isinstance(compiled, Model)
    check_values(compiled)
    meant = _check(compiled, system, values, SourceLocation(str(path)))
    verdicts = [analyze(item).verdict for item in (meant, compiled)]
    if verdicts[0] != verdicts[1]:
        raise ApcError(Diagnostic("E997", SourceLocation(str(path)), "the topology written", *verdicts))
    write_text(path, changed.removesuffix("\n"))


def with_values(text: str, system: Model, values: Mapping[ParameterRef, str]) -> str:
    """Return the text of a topology with other values.

    Parameters
    ----------
    text
        A topology that compiles.
    system
        The expected model.
    values
        Quantities by the number that they are of.

    Raises
    ------
    ApcError
        E997 the text would not have these values.
    """
    changed = _changed(text, system, values)
    name = system.origin.topology
    texts = tuple((key, changed.encode() if key == name else old) for key, old in system.origin.texts)
    compiled = compile_again(replace(system.origin, texts=texts, changes=()), Path())
    _check(compiled, system, values, SourceLocation(name))
    return changed


def _changed(text: str, system: Model, values: Mapping[ParameterRef, str]) -> str:
    """Return the text with the values where they belong, unchecked."""
    text = text.removeprefix("\ufeff")
    groups = {group.name: group.count for group in system.groups}
    # What all groups have is written before what one of them has.
    for free, value in sorted(values.items(), key=lambda pair: pair[0].label.partition(".")[0] in groups):
        for path in _paths(_tree(text), system, free):
            root = _tree(text)
            count = (*path[:2], "count")
            listed = path[0] == "peers" and path[2] == "set" and isinstance(_at(root, path), _List)
            if listed and _at(root, count) is None:  # the list gave the number of peers
                text = _put(text, count, str(groups[path[1]]))
            text = _put(text, path, value)
    return text


# ---- that it is the model that was meant ----


def _check(
    written: Model, system: Model, values: Mapping[ParameterRef, str], location: SourceLocation
) -> Model:
    """Return the model with these values; raise E997 if a compiled text has another number than that."""
    overrides = [parse_override(system, f"{free.label}={value}") for free, value in values.items()]
    result = apply(system, overrides)
    meant, actual = _numbers(result), _numbers(written)
    for name in dict.fromkeys((*meant, *actual)):
        if meant.get(name) != actual.get(name):
            expected, got = (_shown(numbers.get(name)) for numbers in (meant, actual))
            message = f"{name} in the topology to be written"
            hint = " ".join(f'--set "{free.label}={value}"' for free, value in values.items())
            raise ApcError(Diagnostic("E997", location, message, expected, got, hint))
    return result


def _shown(number: Any) -> str:
    if isinstance(number, tuple):
        return f"{len(number)} values"
    return "none" if number is None else f"{float(number):.12g}"


def _numbers(system: Model) -> dict[str, Any]:
    """Return every number of a model, exactly: of each group its own, of one that differs a tuple."""
    # A lone share lost is the first of four numbers once another of these is given, and has another name.
    losses = [(link.name, link.channel.loss) for link in system.links if link.channel is not None]
    lost = {
        getattr(loss, item.name): f"{link}.loss {item.name}"
        for link, loss in losses
        if loss is not None
        for item in fields(loss)
    }
    result: dict[str, Any] = {timing.name: timing.value for timing in system.timings}
    for group in system.groups:
        result[f"number of peers of {group.name}"] = group.count
        local = {parameter.name: parameter.number for parameter in (*system.parameters, *group.values)}
        columns = {name: tuple(column.tolist()) for name, column in columns_of(system, group).items()}
        result |= {
            f"{group.name}.{lost.get(name, name)}": number for name, number in (local | columns).items()
        }
    return result


# ---- where a number is ----


def _paths(root: _Node, system: Model, free: ParameterRef) -> list[Sequence[str]]:
    """Return the location of a number, or its insertion point: the path of keys."""
    groups = [group.name for group in system.groups]
    if free.group is not None:
        return [_in_set(root, free.group, free.name)]
    first, _, rest = free.name.partition(".")
    if not rest:
        return [("parameters", first)]
    if first in groups and rest == "count":
        return [("peers", first, "count")]
    if first in groups:  # a delay of one group's own
        return [_in_set(root, first, rest)]
    if any(clock.name == first and free.name in (clock.period, clock.phase) for clock in system.clocks):
        clock = _at(root, ("clocks", first))
        return [
            ("clocks", first) if rest == "period" and isinstance(clock, _Scalar) else ("clocks", first, rest)
        ]
    local = [
        _in_set(root, group.name, free.name)
        for group in system.groups
        if free.name in {*(value.name for value in group.values), *(column.name for column in group.columns)}
    ]
    for section in PARTS:
        part = _at(root, (section, first))
        whole, index = whole_and_index(rest)
        if index and isinstance(_at(root, (section, first, whole)), _List):
            return [(section, first, whole, str(index)), *local]
        if isinstance(part, _Map) and "." not in rest and not index:
            inside = isinstance(_at(root, (section, first, rest)), _Map)
            return [(section, first, rest, "p") if inside else (section, first, rest), *local]
        if section == "links" and part is not None:
            return [(section, first, *rest.split("."))]
    having = [
        group.name for group in system.groups if free.name in system.peer_types[group.peer_type].parameters
    ]
    return [_in_set(root, group, free.name) for group in having or groups]


def _in_set(root: _Node, group: str, name: str) -> Sequence[str]:
    """Return the path at which a group sets a number: its own key, or an entry of a vector."""
    whole, index = whole_and_index(name)
    if index and isinstance(_at(root, ("peers", group, "set", whole)), _List):
        return ("peers", group, "set", whole, str(index))
    return ("peers", group, "set", name)


# ---- the text as a tree ----


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Node:
    """From `start` to `end` in the text; `alias` marks an alias, of which `node` is the value."""

    start: int
    end: int

    @property
    def node(self) -> _Node:
        return self


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Scalar(_Node):
    value: str
    style: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _List(_Node):
    flow: bool
    items: tuple[_Node, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Map(_Node):
    flow: bool
    entries: tuple[tuple[_Node, _Node], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Alias(_Node):
    of: _Node

    @property
    def node(self) -> _Node:
        return self.of


def _tree(text: str) -> _Node:
    """Return the root of a text that the compiler reads."""
    events = yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    anchors: dict[str, _Node] = {}

    def tree(event: Any) -> _Node:
        start, end = event.start_mark.index, event.end_mark.index
        if isinstance(event, yaml.AliasEvent):
            return _Alias(start=start, end=end, of=anchors[str(event.anchor)])
        node: _Node
        if isinstance(event, yaml.ScalarEvent):
            # One in several lines of its own ends where the next thing begins.
            end = start + len(text[start:end].rstrip()) if event.style in ("|", ">") else end
            node = _Scalar(start=start, end=end, value=event.value, style=event.style or "")
        else:
            items: list[_Node] = []
            while not isinstance(last := next(events), yaml.CollectionEndEvent):
                items.append(tree(last))
            flow = bool(event.flow_style)
            end = int(last.end_mark.index) if flow and last.end_mark else items[-1].end
            if isinstance(event, yaml.SequenceStartEvent):
                node = _List(start=start, end=end, flow=flow, items=tuple(items))
            else:
                pairs = zip(items[::2], items[1::2], strict=True)
                node = _Map(start=start, end=end, flow=flow, entries=tuple(pairs))
        if event.anchor is not None:
            anchors[event.anchor] = node
        return node

    while not isinstance(event := next(events), yaml.ScalarEvent | yaml.CollectionStartEvent):
        pass
    return tree(event)


def _below(node: _Node) -> Iterator[_Node]:
    """Yield a node and all inside it; of an alias the alias alone."""
    yield node
    if isinstance(node, _Map):
        inside = [child for pair in node.entries for child in pair]
    else:
        inside = list(node.items) if isinstance(node, _List) else []
    for child in inside:
        yield from _below(child)


def _child(node: _Node, key: str) -> _Node | None:
    """Return the value of a key, or of a one-based list index; an alias is not followed."""
    if isinstance(node, _List):
        return node.items[int(key) - 1] if int(key) <= len(node.items) else None
    entries = node.entries if isinstance(node, _Map) else ()
    return next((value for name, value in entries if isinstance(name, _Scalar) and name.value == key), None)


def _at(root: _Node, path: Sequence[str]) -> _Node | None:
    """Return the node that keys lead to."""
    node: _Node | None = root
    for key in path:
        child = None if node is None else _child(node, key)
        node = None if child is None else child.node
    return node


# ---- the text with one value changed ----


def _put(text: str, path: Sequence[str], value: str) -> str:
    """Return a text with a value at the end of a path; missing keys are added.

    Other aliases of the changed node are replaced by its former text.
    """
    nodes = [_tree(text)]
    for index, key in enumerate(path, 1):
        child = _child(nodes[-1], key)
        if child is None:
            break
        if isinstance(child, _Alias):
            return f"{text[: child.start]}{_flow(child.of, path, index, value)}{text[child.end :]}"
        nodes.append(child)
    cuts = [
        (node.start, node.end, _flow(node.of))
        for node in _below(nodes[0])
        if isinstance(node, _Alias) and node.of in nodes
    ]
    cuts.append(_cut(text, nodes, path, value))
    for start, end, new in sorted(cuts, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def _cut(text: str, nodes: Sequence[_Node], path: Sequence[str], value: str) -> tuple[int, int, str]:
    """Return from where to where the text of the last node on a path is replaced, and by what."""
    node, missing = nodes[-1], path[len(nodes) - 1 :]
    if isinstance(node, _Map) and missing:
        inner = _flow(None, missing, 1, value)
        entry = f"{_word(missing[0])}: {inner}"
        if not node.entries:
            start = text.index("{", node.start) + 1
            return start, start, entry
        end = node.entries[-1][1].end
        if node.flow:
            return end, end, f", {entry}"
        first = node.entries[0][0].start
        column = first - (text.rfind("\n", 0, first) + 1)
        line = text.find("\n", end)
        end = len(text) if line < 0 else line
        end -= text[end - 1] == "\r"
        return end, end, f"{_line_end(text)}{' ' * column}{entry}"
    new = _flow(node, path, len(nodes) - 1, value)
    start = node.start
    if isinstance(node, _Scalar) and node.style in ("|", ">"):
        comment = _BLOCK_COMMENT.search(text, start, node.end)
        new += comment[1] if comment else ""
    elif isinstance(node, _Map | _List) and not node.flow:  # which may begin as far left as its key
        parent = nodes[-2]
        assert isinstance(parent, _Map)
        key = next(key for key, child in parent.entries if child is node)
        start, new = text.index(":", key.end) + 1, f" {new}"
    return start, node.end, f" {new}" if text[start - 1] == ":" and new[0] != " " else new


def _flow(node: _Node | None, path: Sequence[str] = (), index: int = 0, value: str = "") -> str:
    """Return a node on one line, with the value at the end of a path of keys (from `index` on) replaced.

    Without a path it is unchanged; it has no anchors, aliases or comments.
    """
    if path and index == len(path):
        return _word(value)
    key = path[index] if path else ""
    if node is not None:
        node = node.node
    if isinstance(node, _List):
        inside = [
            _flow(item, path, index + 1, value) if key == str(number) else _flow(item)
            for number, item in enumerate(node.items, 1)
        ]
        return f"[{', '.join(inside)}]"
    pairs: dict[str, str] = {}
    if isinstance(node, _Scalar):
        text = _word(node.value) if not node.style else json.dumps(node.value, ensure_ascii=False)
        if not path:
            return text
        if text:  # a period, or a share lost, that becomes one of several numbers
            pairs["period" if path[0] == "clocks" else "p"] = text
    if isinstance(node, _Map):
        for name, child in node.entries:
            assert isinstance(name, _Scalar)
            pairs[name.value] = _flow(child, path, index + 1, value) if key == name.value else _flow(child)
    if path and key not in pairs:
        pairs[key] = _flow(None, path, index + 1, value)
    return f"{{{', '.join(f'{_word(name)}: {text}' for name, text in pairs.items())}}}"


def _word(text: str) -> str:
    """Return a scalar as it may be written in a flow mapping."""
    return text if _PLAIN.match(text) else json.dumps(text, ensure_ascii=False)


def _line_end(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"
