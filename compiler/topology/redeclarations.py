"""Parts with another component type in one group of peers: `set: {device.type: Omega3}`.

Takes: the groups of peers and the parts' entries. Gives: `redeclared`, the redeclared entries of parts, by
part and group.
Guarantees: the new type has the same connectors, the same unit for numbers with the same name, and sends
nothing. The new entry has the values of the part's entry that the new type accepts, and the group's values.
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
    """Return the entries with another component type: by the name of the part, then by the name of the group.

    Parameters
    ----------
    groups
        The groups, with their settings.
    parts
        The entries of the topology's parts; errors in a type are added to `parts.mistakes`.
    """
    result: dict[str, dict[str, PartEntry]] = {}
    for group in groups:
        settings = list(_settings(group))
        for key, node in settings:
            entry = parts.entries.get(key.text.removesuffix(TYPE))
            if key.text.endswith(TYPE) and entry is not None:
                entry_by_group = result.setdefault(entry.name, {})
                entry_by_group[group.name] = entry  # the original entry remains if the new type is invalid
                with parts.mistakes:
                    entry_by_group[group.name] = _redeclared_entry(entry, key, node, settings, parts)
    return result


def _settings(group: GroupBody) -> Iterator[tuple[Scalar, Node]]:
    """Yield the keys and values of a group's `set` mapping."""
    node = group.body.nodes.get("set")
    return iter(node.entries if isinstance(node, MappingNode) else ())


def _redeclared_entry(
    entry: PartEntry, key: Scalar, node: Node, settings: list[tuple[Scalar, Node]], parts: PartEntries
) -> PartEntry:
    """Return a part's entry with the component type that a group sets.

    Parameters
    ----------
    entry
        The part's entry in the topology.
    key, node
        The key `PART.type` of the group's settings, and the name of the new type.
    settings
        All settings of the group; those of this part are included in the new entry.
    parts
        The parts of the topology, and the component library.

    Raises
    ------
    ApcError
        The new type does not fit: other connectors or units, messages over a link, or a missing number.
    """
    old, fix = entry.component, f"{key.text}: {entry.component.name}"
    new = component_named(text_of(node, key.text, fix), node.location, parts.library, fix)
    if entry.section == "links" or any(
        component.sends or component.receives_from_others for component in (old, new)
    ):
        message = f"the type of {entry.name} can't differ between groups, as it communicates over a link"
        raise fault("E210", node.location, message)
    if _connectors(new) != _connectors(old):
        pairs = ((new, old), (old, new))  # a component, and the one with a connector that it has not
        texts = [f"only {one.name} has {more}" for one, other in pairs if (more := _additional(one, other))]
        difference = enumerated(texts or ["the connectors have another order"])
        message = f"{key.text}: {new.name} can't replace {old.name}, as their connectors differ: {difference}"
        advice = f"define a second part of type {new.name}, with at"
        raise fault("E210", node.location, message, advice=advice)
    units = {number.name: number.unit for number in old.numbers}
    for number in new.numbers:
        before = units.get(number.name, number.unit)
        if before.dimension != number.unit.dimension:
            message = f"{key.text}: {new.name} can't replace {old.name}"
            expected, got = (f"{number.name} in {unit.text}" for unit in (before, number.unit))
            raise fault("E210", node.location, message, expected, got)
    known = {*PART_KEYS, "type", *dict(new.connectors)}
    known |= {item.name.partition("[")[0] for item in (*new.parameters, *new.variables)}
    body = {name.text: (name, value) for name, value in entry.body.entries if name.text in known}
    for name, value in settings:
        part, _, parameter = name.text.rpartition(".")
        if part == entry.name and parameter in known and not isinstance(value, Sequence):
            body.setdefault(parameter, (replace(name, text=parameter), value))
    body.pop("type", None)
    required_units = {
        f"{entry.name}.{declared.name}": declared.unit.text
        for declared in new.numbers
        if declared.default is None
    }
    if missing := {
        name: unit for name, unit in required_units.items() if name.rpartition(".")[2] not in body
    }:
        message = (
            f"{entry.name} as {new.name} has no {enumerated([name.rpartition('.')[2] for name in missing])}"
        )
        fix = ", ".join(f"{name}: 1 {unit}".removesuffix(" 1") for name, unit in missing.items())
        raise fault("E201", node.location, message, fix=fix)
    return replace(entry, component=new, body=replace(entry.body, entries=tuple(body.values())))


def _connectors(component: Component) -> list[str]:
    """Return the connectors of a component as texts, with the type, and whether hands can grip it."""
    grips = dict.fromkeys(component.grips, ", for hands")
    return [f"{name} ({kind.name}{grips.get(name, '')})" for name, kind in component.connectors]


def _additional(component: Component, other: Component) -> str:
    """Return the text of the connectors of a component that another one has not; empty if there is none."""
    return ", ".join(text for text in _connectors(component) if text not in _connectors(other))
