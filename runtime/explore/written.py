"""A topology with other values in it: the text as its author wrote it, but for the numbers.

Takes: the text of a topology; names and quantities, as `--set` takes them.
Gives: `with_values`.
Guarantees: comments, order and everything else stay; a number is written where it stands, or where it belongs
if it was left to its default; what differs from group to group is set group by group.
Does not: compile, or know what a number means.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

import yaml

from apc.compiler.compiled import CompiledSystem
from apc.compiler.language.vectors import whole_and_index
from apc.frame.names import Free

PARTS = ("masses", "couplers", "hands", "links")
_PLAIN = re.compile(r"[A-Za-z_][\w.-]*\Z")


def with_values(text: str, system: CompiledSystem, values: Mapping[Free, str]) -> str:
    """Return the text of a topology with other values.

    Parameters
    ----------
    text
        A topology that compiles.
    system
        What it is compiled to.
    values
        Quantities by the number that they are of.
    """
    for free, value in values.items():
        for path in _paths(text, system, free):
            text = _put(text, path, value)
    return text


def _paths(text: str, system: CompiledSystem, free: Free) -> list[Sequence[str]]:
    """Return where a number stands, or belongs: the keys on the way to it."""
    groups = [group.name for group in system.groups]
    if free.group is not None:
        return [("peers", free.group, "set", free.name)]
    first, _, rest = free.name.partition(".")
    root = yaml.compose(text, yaml.SafeLoader)
    if not rest:
        return [("parameters", first)]
    if first in groups and rest == "count":
        return [("peers", first, "count")]
    if first in groups:  # a delay of one group's own
        return [("peers", first, "set", rest)]
    if any(clock.name == first and free.name in (clock.period, clock.phase) for clock in system.clocks):
        short = rest == "period" and isinstance(_at(root, ("clocks", first)), yaml.ScalarNode)
        return [("clocks", first) if short else ("clocks", first, rest)]
    for section in PARTS:
        part = _at(root, (section, first))
        whole, index = whole_and_index(rest)
        if index and isinstance(_at(root, (section, first, whole)), yaml.SequenceNode):
            return [(section, first, whole, str(index))]
        if isinstance(part, yaml.MappingNode) and "." not in rest and not index:
            inside = isinstance(_at(root, (section, first, rest)), yaml.MappingNode)
            return [(section, first, rest, "p") if inside else (section, first, rest)]
        if section == "links" and part is not None:
            return [(section, first, *rest.split("."))]
    return [("peers", group, "set", free.name) for group in groups]


def _at(node: yaml.Node | None, path: Sequence[str]) -> yaml.Node | None:
    """Return the node that keys lead to."""
    for key in path:
        if isinstance(node, yaml.SequenceNode):  # of a vector: the entry, counted from 1
            node = node.value[int(key) - 1]
            continue
        entries = node.value if isinstance(node, yaml.MappingNode) else []
        node = next((value for name, value in entries if name.value == key), None)
    return node


def _put(text: str, path: Sequence[str], value: str) -> str:
    """Return a text with a value at the end of a path; what is missing of the path is added."""
    root = yaml.compose(text, yaml.SafeLoader)
    index = next(n for n in range(len(path), -1, -1) if _at(root, path[:n]) is not None)
    node, missing = _at(root, path[:index]), path[index:]
    assert node is not None
    for key in reversed(missing[1:]):
        value = f"{{{_key(key)}: {value}}}"
    start, end = node.start_mark.index, node.end_mark.index
    if not missing:
        return text[:start] + value + text[end:]
    entry = f"{_key(missing[0])}: {value}"
    if isinstance(node, yaml.ScalarNode):  # a period, or a share lost, that becomes one of several numbers
        short = "period" if path[0] == "clocks" else "p"
        return f"{text[:start]}{{{short}: {text[start:end]}, {entry}}}{text[end:]}"
    if getattr(node, "flow_style", False):
        return f"{text[: end - 1].rstrip()}{', ' if node.value else ''}{entry}{text[end - 1 :]}"
    return f"{text[:start]}{entry}\n{' ' * node.start_mark.column}{text[start:]}"


def _key(name: str) -> str:
    return name if _PLAIN.match(name) else json.dumps(name)
