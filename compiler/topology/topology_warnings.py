"""Warnings for unusual topologies: an unused link, an unconnected mass, a single copy.

Takes: parts and links as read. Gives: `topology_warnings`, the warnings; `warning_texts`.
Guarantees: warnings are not errors: the topology is compiled unchanged; each warning has its location.
Does not: analyze equations, or change the topology.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from scipy.cluster.hierarchy import DisjointSet

from apc.compiler.components.parts import PartEntry
from apc.compiler.errors import Diagnostic, Mistakes
from apc.compiler.source.nodes import Sequence as ListNode
from apc.compiler.topology.groups import GroupDeclaration
from apc.compiler.topology.instances import PartInstance


def topology_warnings(
    parts: Sequence[PartInstance],
    entries: Mapping[str, PartEntry],
    groups: Iterable[GroupDeclaration],
    replaced: Mapping[str, Path],
) -> tuple[Diagnostic, ...]:
    """Return the warnings about a topology, in the order of its file.

    Parameters
    ----------
    parts
        The parts of a peer, links too, those inside parts among them.
    entries
        The entries of the topology.
    groups
        The groups of peers.
    replaced
        The files of components that take the place of the library's, by name.
    """
    used = {word for part in parts for _, word in part.references}
    warnings = Mistakes()
    for name, entry in entries.items():
        if entry.section == "links" and name not in used:
            warnings.add("W271", entry.location, f"nobody uses the link {name}")
        if entry.section == "links" and isinstance(entry.body.get("delay"), ListNode):
            message = (
                f"{name}.delay is a range: analyze and tune are for every constant delay in it, and report "
                "delays that change from packet to packet; other answers are for its middle"
            )
            message += "; simulate and export want one delay"
            warnings.add("W275", entry.location, message)
    outer = [part for part in parts if part.name.partition("[")[0] in entries and "." not in part.name]
    for part in {part.component.name: part for part in reversed(outer)}.values():
        if part.component.name in replaced:
            file = replaced[part.component.name].name
            message = f"{part.component.name} is that of {file}, in the place of the library's"
            warnings.add("W276", part.location, message)
    counts = {group.name: group.count for group in groups}
    joined = {group: _joined([part for part in outer if group in part.groups]) for group in counts}
    receiving = {part.name: part for part in outer if part.component.receives_from_others}
    masses = [part for part in outer if part.section == "masses"]
    given = {name for group in groups for name, _ in (*group.values, *group.words, *group.columns)}
    for part in reversed(masses):  # of one location, `Mistakes` reports the last first
        near = {group: joined[group].subset(part.name) for group in part.groups}
        alone = [group for group, names in near.items() if len(names) == 1]
        if alone and part.component.connectors and not part.connections:
            where = "" if len(alone) == len(near) else f" of {' and '.join(alone)}"
            message = f"{part.name}{where} is joined to nothing: no coupler, no hand and no other mass"
            warnings.add("W272", part.location, message)
        anywhere = {name for names in near.values() for name in names}
        if sum(counts[group] for group in near) < 2:
            continue
        if part.shared and not anywhere & receiving.keys():
            warnings.add("W273", part.location, f"{part.name} is shared, and nothing couples its copies")
        # A mass is taken for a copy if a coupler follows the others by it alone, the same in all groups, and
        # something else of the peer moves it too.
        followed = [
            item for item in receiving.values() if [other for _, other, _ in item.connections] == [part.name]
        ]
        divided = [number.name for number in part.component.numbers if number.divided]
        local = {f"{part.name}.{name}" for name in divided}
        local |= {f"{part.name}.{name}" for part in followed for name, _ in part.options}
        touched = any(mass is not part and mass.name in anywhere for mass in masses)
        text = entries[part.name.partition("[")[0]].body.get("shared") is not None
        if not text and followed and divided and touched and local.isdisjoint(given):
            follows = f"{part.name} follows the other peers' by {followed[0].name} and is not shared"
            message = f"{follows}: its {divided[0]} counts once a peer"
            hint = "shared: true, or shared: false where each is a mass of its own"
            warnings.add("W274", part.location, message, hint=hint)
    return warnings.result


def _joined(parts: Sequence[PartInstance]) -> DisjointSet:
    """Return the connected components of one group's parts; the ground connects nothing."""
    result = DisjointSet(part.name for part in parts)
    for part in parts:
        for _, other, _ in part.connections:
            if other in result:
                result.merge(part.name, other)
    return result


def warning_texts(warnings: Collection[Diagnostic]) -> tuple[str, ...]:
    """Return warnings as texts, each with its place in the topology, whose folder is left out."""
    return tuple(
        f"{replace(mistake.location, file=Path(mistake.location.file).name)}: {mistake.code} "
        f"{mistake.sentence}"
        for mistake in warnings
    )
