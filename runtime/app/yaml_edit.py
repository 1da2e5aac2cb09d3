"""Change of values in the text of a topology, with an otherwise unchanged text.

Takes: the text of a topology; names and quantities, as for `--set`.
Gives: `with_values`, `write_topology`.
Guarantees: comments, order and layout remain; a value is replaced in place, or inserted at its path if it had
the default; a value shared by aliases is changed at one place only. The text compiles to the model with these
values and no other changed number, or an error is raised and nothing is written.
Does not: interpret numbers; change a table of peer values.

The text is edited at the marks of the events of the compiler's parser. A round-trip library would change
the spaces between the entries of a flow mapping, and refuses tabs that this parser accepts.
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
from apc.lifting.numeric_model import numeric_model
from apc.lifting.start_checks import check_values
from apc.parameter_values.overrides import apply, parse_override
from apc.parameter_values.parameter_names import ParameterRef
from apc.parameter_values.parameters import columns_of

PARTS = ("masses", "couplers", "hands", "links")
# Scalars that need no quotes inside a flow mapping.
_PLAIN = re.compile(r"(?:[\w.(][\w .+*/^%()@-]*[\w.)%]|[\w.])?\Z|[-+][\w.(][\w .+*/^%()-]*\Z")
_BLOCK_COMMENT = re.compile(r"[|>][-+0-9]*([ \t]+#[^\r\n]*)")


def write_topology(path: Path, text: str, model: Model, values: Mapping[ParameterRef, str]) -> None:
    """Write a topology with other values to a file, after checking that the text compiles to these values.

    Parameters
    ----------
    path
        The file to write; files named by the topology are read from its folder.
    text, model, values
        As for `with_values`.

    Raises
    ------
    ApcError
        E601 the file can't be written, E997 the text would have other values; and the errors of the compiler.
    """
    changed = _edited_text(text, model, values)
    *_, (_, compiled) = stages_of(parse_source(changed.encode(), file=str(path), path=path))
    assert isinstance(compiled, Model)
    check_values(compiled)
    expected = _check(compiled, model, values, SourceLocation(str(path)))
    verdicts = [analyze(numeric_model(item)).verdict for item in (expected, compiled)]
    if verdicts[0] != verdicts[1]:
        raise ApcError(Diagnostic("E997", SourceLocation(str(path)), "topology written", *verdicts))
    write_text(path, changed.removesuffix("\n"))


def with_values(text: str, model: Model, values: Mapping[ParameterRef, str]) -> str:
    """Return the text of a topology with other values.

    Parameters
    ----------
    text
        The text of a valid topology.
    model
        The model of the topology.
    values
        The new quantities, by parameter.

    Raises
    ------
    ApcError
        E997 the text would have other values.
    """
    changed = _edited_text(text, model, values)
    name = model.origin.topology
    texts = tuple((key, changed.encode() if key == name else old) for key, old in model.origin.texts)
    compiled = compile_again(replace(model.origin, texts=texts, changes=()), Path())
    _check(compiled, model, values, SourceLocation(name))
    return changed


def _edited_text(text: str, model: Model, values: Mapping[ParameterRef, str]) -> str:
    """Return the text with the new values at their paths, without a check of the result."""
    text = text.removeprefix("\ufeff")
    groups = {group.name: group.count for group in model.groups}
    # Values of all groups are written before values of single groups.
    for parameter_ref, value in sorted(
        values.items(), key=lambda pair: pair[0].label.partition(".")[0] in groups
    ):
        for path in _paths(_tree(text), model, parameter_ref):
            root = _tree(text)
            count = (*path[:2], "count")
            is_list = path[0] == "peers" and path[2] == "set" and isinstance(_node_at(root, path), _List)
            if is_list and _node_at(root, count) is None:  # the number of peers followed from the list
                text = _insert_value(text, count, str(groups[path[1]]))
            text = _insert_value(text, path, value)
    return text


# ---- check of the new model ----


def _check(
    written: Model, model: Model, values: Mapping[ParameterRef, str], location: SourceLocation
) -> Model:
    """Return the model with the new values. Raises E997 if the compiled text has another number.

    `written` is the model compiled from the text, `model` the model before the change.
    """
    overrides = [
        parse_override(model, f"{parameter_ref.label}={value}") for parameter_ref, value in values.items()
    ]
    result = apply(model, overrides)
    expected_numbers, actual = _numbers(result), _numbers(written)
    for name in dict.fromkeys((*expected_numbers, *actual)):
        if expected_numbers.get(name) != actual.get(name):
            expected, got = (_shown(numbers.get(name)) for numbers in (expected_numbers, actual))
            message = f"{name} in the written topology"
            fix = " ".join(
                f'--set "{parameter_ref.label}={value}"' for parameter_ref, value in values.items()
            )
            raise ApcError(Diagnostic("E997", location, message, expected, got, fix))
    return result


def _shown(number: Any) -> str:
    """Return the text of a number in a message."""
    if isinstance(number, tuple):
        return f"{len(number)} values"
    return "none" if number is None else f"{float(number):.12g}"


def _numbers(model: Model) -> dict[str, Any]:
    """Return every exact number of a model by name and group, as a tuple if it differs between peers."""
    # The name of a single loss probability changes if another number of the loss model is given.
    losses = [channel.loss for link in model.links for channel in link.channels]
    lost = {
        getattr(loss, item.name): f"{loss.r.removesuffix('.r')} {item.name}"
        for loss in losses
        if loss is not None
        for item in fields(loss)
    }
    result: dict[str, Any] = {timing.name: timing.value for timing in model.timings}
    for group in model.groups:
        result[f"number of peers of {group.name}"] = group.count
        scalars = {parameter.name: parameter.number for parameter in (*model.parameters, *group.values)}
        columns = {name: tuple(column.tolist()) for name, column in columns_of(model, group).items()}
        result |= {
            f"{group.name}.{lost.get(name, name)}": number for name, number in (scalars | columns).items()
        }
    return result


# ---- paths of numbers ----


def _paths(root: _Node, model: Model, parameter_ref: ParameterRef) -> list[Sequence[str]]:
    """Return the paths of keys at which a parameter is written, or is to be inserted."""
    groups = [group.name for group in model.groups]
    if parameter_ref.group is not None:
        return [_in_set(root, parameter_ref.group, parameter_ref.name)]
    first, _, local_name = parameter_ref.name.partition(".")
    if not local_name:
        return [("parameters", first)]
    if first in groups and local_name == "count":
        return [("peers", first, "count")]
    if first in groups:  # a delay set by one group
        return [_in_set(root, first, local_name)]
    if any(
        clock.name == first and parameter_ref.name in (clock.period, clock.phase) for clock in model.clocks
    ):
        clock = _node_at(root, ("clocks", first))
        return [
            ("clocks", first)
            if local_name == "period" and isinstance(clock, _Scalar)
            else ("clocks", first, local_name)
        ]
    group_paths = [
        _in_set(root, group.name, parameter_ref.name)
        for group in model.groups
        if parameter_ref.name
        in {*(value.name for value in group.values), *(column.name for column in group.columns)}
    ]
    for section in PARTS:
        part = _node_at(root, (section, first))
        vector, index = whole_and_index(local_name)
        if index and isinstance(_node_at(root, (section, first, vector)), _List):
            return [(section, first, vector, str(index)), *group_paths]
        if isinstance(part, _Map) and "." not in local_name and not index:
            inside = isinstance(_node_at(root, (section, first, local_name)), _Map)
            return [
                (section, first, local_name, "p") if inside else (section, first, local_name),
                *group_paths,
            ]
        if section == "links" and part is not None:
            return [(section, first, *local_name.split("."))]
    groups_with_part = [
        group.name
        for group in model.groups
        if parameter_ref.name in model.peer_types[group.peer_type].parameters
    ]
    return [_in_set(root, group, parameter_ref.name) for group in groups_with_part or groups]


def _in_set(root: _Node, group: str, name: str) -> Sequence[str]:
    """Return the path at which a group sets a number: its own key, or an entry of a vector."""
    vector, index = whole_and_index(name)
    if index and isinstance(_node_at(root, ("peers", group, "set", vector)), _List):
        return ("peers", group, "set", vector, str(index))
    return ("peers", group, "set", name)


# ---- the text as a tree ----


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Node:
    """A node of the text, from offset `start` to `end`.

    `node` is the node itself, for an alias the referenced node.
    """

    start: int
    end: int

    @property
    def node(self) -> _Node:
        """The node itself."""
        return self


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Scalar(_Node):
    """A scalar with its value and style."""

    value: str
    style: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _List(_Node):
    """A sequence; `flow` is whether it is written in brackets."""

    flow: bool
    items: tuple[_Node, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Map(_Node):
    """A mapping; `flow` is whether it is written in braces."""

    flow: bool
    entries: tuple[tuple[_Node, _Node], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Alias(_Node):
    """An alias of the node `target`."""

    target: _Node

    @property
    def node(self) -> _Node:
        """The referenced node."""
        return self.target


def _tree(text: str) -> _Node:
    """Return the root node of a valid text."""
    events = yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    anchors: dict[str, _Node] = {}

    def tree(event: Any) -> _Node:
        """Return the node that starts with an event."""
        start, end = event.start_mark.index, event.end_mark.index
        if isinstance(event, yaml.AliasEvent):
            return _Alias(start=start, end=end, target=anchors[str(event.anchor)])
        node: _Node
        if isinstance(event, yaml.ScalarEvent):
            # The end mark of a block scalar is at the start of the next token.
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


def _descendants(node: _Node) -> Iterator[_Node]:
    """Yield a node and all nodes inside it; aliases are not followed."""
    yield node
    if isinstance(node, _Map):
        inside = [child for pair in node.entries for child in pair]
    else:
        inside = list(node.items) if isinstance(node, _List) else []
    for child in inside:
        yield from _descendants(child)


def _child(node: _Node, key: str) -> _Node | None:
    """Return the value of a key, or of a one-based list index; aliases are not followed."""
    if isinstance(node, _List):
        return node.items[int(key) - 1] if int(key) <= len(node.items) else None
    entries = node.entries if isinstance(node, _Map) else ()
    return next((value for name, value in entries if isinstance(name, _Scalar) and name.value == key), None)


def _node_at(root: _Node, path: Sequence[str]) -> _Node | None:
    """Return the node at a path of keys, None if there is none; aliases are followed."""
    node: _Node | None = root
    for key in path:
        child = None if node is None else _child(node, key)
        node = None if child is None else child.node
    return node


# ---- change of one value ----


def _insert_value(text: str, path: Sequence[str], value: str) -> str:
    """Return the text of a topology with the value at the end of a path of keys replaced or inserted.

    Missing keys are added. Other places keep their values: an alias on the path, and an alias elsewhere of a
    node on the path, are replaced by the former text of their node.
    """
    nodes = [_tree(text)]
    for index, key in enumerate(path, 1):
        child = _child(nodes[-1], key)
        if child is None:
            break
        if isinstance(child, _Alias):
            return f"{text[: child.start]}{_flow_text(child.target, path, index, value)}{text[child.end :]}"
        nodes.append(child)
    replacements = [
        (node.start, node.end, _flow_text(node.target))
        for node in _descendants(nodes[0])
        if isinstance(node, _Alias) and node.target in nodes
    ]
    replacements.append(_replacement(text, nodes, path, value))
    for start, end, new_text in sorted(replacements, reverse=True):
        text = text[:start] + new_text + text[end:]
    return text


def _replacement(text: str, nodes: Sequence[_Node], path: Sequence[str], value: str) -> tuple[int, int, str]:
    """Return start and end of the text to be replaced for the last existing node on a path, and the
    new text.
    """
    node, missing = nodes[-1], path[len(nodes) - 1 :]
    if isinstance(node, _Map) and missing:
        inner = _flow_text(None, missing, 1, value)
        entry = f"{_scalar_text(missing[0])}: {inner}"
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
    new = _flow_text(node, path, len(nodes) - 1, value)
    start = node.start
    if isinstance(node, _Scalar) and node.style in ("|", ">"):
        comment = _BLOCK_COMMENT.search(text, start, node.end)
        new += comment[1] if comment else ""
    elif isinstance(node, _Map | _List) and not node.flow:  # a block node may begin in the column of its key
        parent = nodes[-2]
        assert isinstance(parent, _Map)
        key = next(key for key, child in parent.entries if child is node)
        start, new = text.index(":", key.end) + 1, f" {new}"
    return start, node.end, f" {new}" if text[start - 1] == ":" and new[0] != " " else new


def _flow_text(node: _Node | None, path: Sequence[str] = (), index: int = 0, value: str = "") -> str:
    """Return a node as text on one line, with the value at the end of a path of keys (from `index` on)
    replaced.

    Without a path the node is unchanged. The text has no anchors, aliases or comments.
    """
    if path and index == len(path):
        return _scalar_text(value)
    key = path[index] if path else ""
    if node is not None:
        node = node.node
    if isinstance(node, _List):
        inside = [
            _flow_text(item, path, index + 1, value) if key == str(number) else _flow_text(item)
            for number, item in enumerate(node.items, 1)
        ]
        return f"[{', '.join(inside)}]"
    pairs: dict[str, str] = {}
    if isinstance(node, _Scalar):
        text = _scalar_text(node.value) if not node.style else json.dumps(node.value, ensure_ascii=False)
        if not path:
            return text
        if text:  # a period or a loss probability becomes a key of a mapping
            pairs["period" if path[0] == "clocks" else "p"] = text
    if isinstance(node, _Map):
        for name, child in node.entries:
            assert isinstance(name, _Scalar)
            pairs[name.value] = (
                _flow_text(child, path, index + 1, value) if key == name.value else _flow_text(child)
            )
    if path and key not in pairs:
        pairs[key] = _flow_text(None, path, index + 1, value)
    return f"{{{', '.join(f'{_scalar_text(name)}: {text}' for name, text in pairs.items())}}}"


def _scalar_text(text: str) -> str:
    """Return a scalar as text inside a flow mapping, quoted if necessary."""
    return text if _PLAIN.match(text) else json.dumps(text, ensure_ascii=False)


def _line_end(text: str) -> str:
    """Return the line end of a text."""
    return "\r\n" if "\r\n" in text else "\n"
