"""Parts that are of another type in one group of peers: `set: {device.type: Omega3}`.

Takes: the groups of peers and the parts' entries. Gives: `redeclared`, the entry of a part at a group, by
both names.
Guarantees: the other type has the same connectors, numbers of one name in one unit, and sends nothing. The
entry has the values of the part's entry that the other type accepts, and those set by the group.
Does not: read the numbers of an entry (see `components.parts`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from apc.compiler.components.component import Component
from apc.compiler.components.parts import PART_KEYS, PartEntries, PartEntry, component_named
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import fault, text_of
from apc.compiler.topology.groups import GroupBody
from apc.compiler.wording import enumerated

TYPE = ".type"


def redeclared(groups: Iterable[GroupBody], parts: PartEntries) -> dict[str, dict[str, PartEntry]]:
    """Return the entries of parts whose type a group sets, by the part's name and the group's.

    Parameters
    ----------
    groups
        The groups, with their settings.
    parts
        The parts of the topology; errors in a type are added to its mistakes.
    """
    result: dict[str, dict[str, PartEntry]] = {}
    for group in groups:
        settings = list(_settings(group))
        for key, node in settings:
            entry = parts.entries.get(key.text.removesuffix(TYPE))
            if key.text.endswith(TYPE) and entry is not None:
                at = result.setdefault(entry.name, {})
                at[group.name] = entry  # if there is a mistake in it
                with parts.mistakes:
                    at[group.name] = _entry(entry, key, node, settings, parts)
    return result


def _settings(group: GroupBody) -> Iterator[tuple[Scalar, Node]]:
    node = group.body.nodes.get("set")
    return iter(node.entries if isinstance(node, MappingNode) else ())


def _entry(
    entry: PartEntry, key: Scalar, node: Node, settings: list[tuple[Scalar, Node]], parts: PartEntries
) -> PartEntry:
    """Return a part's entry with the type that a group sets. Raises ApcError for one that doesn't fit."""
    old, hint = entry.component, f"{key.text}: {entry.component.name}"
    new = component_named(text_of(node, key.text, hint), node.location, parts.library, hint)
    if entry.section == "links" or any(
        component.sends or component.receives_from_others for component in (old, new)
    ):
        message = f"{entry.name} sends or hears over a link, and is of one type at all peers"
        raise fault("E210", node.location, message)
    if _connectors(new) != _connectors(old):
        message = f"{key.text}, to take the place of {old.name},"
        raise fault(
            "E210",
            node.location,
            message,
            *(f"the connectors {_connectors(component)}" for component in (old, new)),
        )
    units = {number.name: number.unit for number in old.numbers}
    for number in new.numbers:
        before = units.get(number.name, number.unit)
        if before.dimension != number.unit.dimension:
            message = f"{key.text}, to take the place of {old.name},"
            expected, got = (f"{number.name} in {unit.text}" for unit in (before, number.unit))
            raise fault("E210", node.location, message, expected, got)
    known = {*PART_KEYS, "type", *dict(new.connectors)}
    known |= {item.name.partition("[")[0] for item in (*new.parameters, *new.variables)}
    body = {name.text: (name, value) for name, value in entry.body.entries if name.text in known}
    for name, value in settings:
        part, _, local = name.text.rpartition(".")
        if part == entry.name and local in known and not isinstance(value, Sequence):
            body.setdefault(local, (replace(name, text=local), value))
    body.pop("type", None)
    due = {
        f"{entry.name}.{number.name}": number.unit.text for number in new.numbers if number.default is None
    }
    if missing := {name: unit for name, unit in due.items() if name.rpartition(".")[2] not in body}:
        message = (
            f"{entry.name} as {new.name} has no {enumerated([name.rpartition('.')[2] for name in missing])}"
        )
        hint = ", ".join(f"{name}: 1 {unit}".removesuffix(" 1") for name, unit in missing.items())
        raise fault("E201", node.location, message, hint=hint)
    return replace(entry, component=new, body=replace(entry.body, entries=tuple(body.values())))


def _connectors(component: Component) -> str:
    """Return the connectors of a component in words, those for hands too."""
    named = (f"{name} ({kind.name})" for name, kind in component.connectors)
    hands = f", for hands: {', '.join(component.grips)}" if component.grips else ""
    return (", ".join(named) or "none") + hands
