"""Warnings for unusual topologies: an unused link, an unconnected mass, copies without a coupler.

Takes: parts and links as read. Gives: `topology_warnings`, the warnings; `warning_texts`.
Guarantees: warnings are not errors: the topology is compiled unchanged; each warning has its location.
Does not: analyze equations, or change the topology.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from apc.compiler.components.parts import PartEntry
from apc.compiler.disjoint_sets import DisjointSets
from apc.compiler.errors import Diagnostic, Mistakes
from apc.compiler.source.nodes import Scalar
from apc.compiler.source.nodes import Sequence as ListNode
from apc.compiler.topology.groups import GroupDeclaration
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.links import LinkDeclaration


def topology_warnings(
    parts: Sequence[PartInstance],
    links: Sequence[LinkDeclaration],
    entries: Mapping[str, PartEntry],
    groups: Sequence[GroupDeclaration],
    replaced: Mapping[str, Path],
) -> tuple[Diagnostic, ...]:
    """Return the warnings about a topology, in the order of its file.

    Parameters
    ----------
    parts
        All parts of the peers, with links and parts inside parts.
    links
        The links as read.
    entries
        The entries of the topology's parts, by name.
    groups
        The groups of peers.
    replaced
        The files of components that replace components of the library, by component name.
    """
    used = {word for part in parts for _, word in part.references}
    warnings = Mistakes()
    for name, entry in entries.items():
        if entry.section == "links" and name not in used:
            warnings.add("W271", entry.location, f"the link {name} is not used")
        if entry.section == "links" and isinstance(entry.body.get("delay"), ListNode):
            message = (
                f"{name}.delay is a range: analyze and tune cover every constant delay in it and report "
                "delays that change from packet to packet; other commands use the midpoint"
            )
            message += "; simulate and export need a single delay"
            warnings.add("W275", entry.location, message)
    counts = {group.name: group.count for group in groups}
    first_peer = dict(zip(counts, itertools.accumulate(counts.values(), initial=0), strict=False))
    for link in links:
        if link.channel is not None and link.channel.loses_all:
            loss = entries[link.name].body.get("loss")
            location = link.location if loss is None else loss.location
            fix = "loss: 1 %" if isinstance(loss, Scalar) and isinstance(loss.value, int | float) else ""
            message = f"every packet of {link.name} is lost, so no packet ever arrives"
            warnings.add("W277", location, message, fix=fix)
        for pair in link.pairs:
            name = f"{link.name} from {pair.sender} to {pair.receiver}"
            if pair.channel is not None and pair.channel.loses_all:
                message = f"every packet of {name} is lost, so no packet ever arrives"
                warnings.add("W277", pair.location, message)
            is_single = pair.sender == pair.receiver and counts[pair.sender] == 1
            if is_single and [first_peer[pair.sender]] * 2 not in link.graph.arcs.tolist():
                message = f"no packet of {name} is sent, as {pair.sender} has one peer"
                warnings.add("W278", pair.location, message)
    outer = [part for part in parts if part.name.partition("[")[0] in entries and "." not in part.name]
    for part in {part.component.name: part for part in reversed(outer)}.values():
        if part.component.name in replaced:
            file = replaced[part.component.name].name
            message = f"{part.component.name} is defined in {file} and replaces the component of the library"
            warnings.add("W276", part.location, message)
    connected = {group: _joined([part for part in outer if group in part.groups]) for group in counts}
    receiving = {part.name: part for part in outer if part.component.receives_from_others}
    masses = [part for part in outer if part.section == "masses"]
    group_settings = {name for group in groups for name, _ in (*group.values, *group.words, *group.columns)}
    for part in reversed(masses):  # of one location, `Mistakes` reports the last first
        connected_names = {group: connected[group][part.name] for group in part.groups}
        alone = [group for group, names in connected_names.items() if len(names) == 1]
        if alone and part.component.connectors and not part.connections:
            where = "" if len(alone) == len(connected_names) else f" of {' and '.join(alone)}"
            message = f"{part.name}{where} is not connected to a coupler, a hand or another mass"
            warnings.add("W272", part.location, message)
        anywhere = {name for names in connected_names.values() for name in names}
        if sum(counts[group] for group in connected_names) < 2:
            continue
        if part.shared and not anywhere & receiving.keys():
            warnings.add("W273", part.location, f"{part.name} is shared, but no element couples its copies")
        # A mass is probably an object copy if it is the only connection of a coupler to the other peers, the
        # same in all groups, and it is also connected to another mass of the peer.
        followed = [
            item for item in receiving.values() if [other for _, other, _ in item.connections] == [part.name]
        ]
        divided = [number.name for number in part.component.numbers if number.divided]
        copy_parameters = {f"{part.name}.{name}" for name in divided}
        copy_parameters |= {f"{part.name}.{name}" for part in followed for name, _ in part.options}
        has_other_mass = any(mass is not part and mass.name in anywhere for mass in masses)
        text = entries[part.name.partition("[")[0]].body.get("shared") is not None
        if (
            not text
            and followed
            and divided
            and has_other_mass
            and copy_parameters.isdisjoint(group_settings)
        ):
            follows = f"{part.name} is coupled to the other peers by {followed[0].name} but is not shared"
            message = f"{follows}; its {divided[0]} applies to each peer in full"
            fix = "shared: true, or shared: false"
            advice = "use shared: false if each peer has a separate mass"
            warnings.add("W274", part.location, message, fix=fix, advice=advice)
    return warnings.result


def _joined(parts: Sequence[PartInstance]) -> DisjointSets:
    """Return the sets of parts of one group that are connected to each other; the ground connects nothing."""
    result, names = DisjointSets(), {part.name for part in parts}
    for part in parts:
        for _, other, _ in part.connections:
            if other in names:
                result.merge(part.name, other)
    return result


def warning_texts(warnings: Collection[Diagnostic]) -> tuple[str, ...]:
    """Return the texts of warnings, each with file, line and column; the folder of the file is omitted."""
    return tuple(
        f"{replace(mistake.location, file=Path(mistake.location.file).name)}: {mistake.code} "
        f"{mistake.sentence}"
        for mistake in warnings
    )
