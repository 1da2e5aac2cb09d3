"""A topology as typed data: every quantity in SI, every name resolved.

Takes: the YAML source of a topology and a library. Gives: `build_topology`, the `Topology`;
`library_folders`, `readable_library`.
Guarantees: parts, clocks, links, parameters and connections that are named exist; quantities have the unit
their parameter wants and lie within its bounds; parts inside parts and arrays are written out; all mistakes
of the file are reported together.
Does not: look into a component's equations, or read a section itself: each has a module of its own
(`groups`, `parameters`, `timebase`, `instances`, `links`, `studies`).
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from apc.compiler.cache import SUFFIX
from apc.compiler.compiled import Axis, Experiment
from apc.compiler.components.component import Named
from apc.compiler.components.component_library import Library, definition_of
from apc.compiler.components.parts import EntryScope, PartEntries
from apc.compiler.errors import Diagnostic, Mistakes, SourceLocation, visible
from apc.compiler.files import RefusedError, files_below
from apc.compiler.language.csv_tables import NamedFiles
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.source.nodes import Mapping, Sequence
from apc.compiler.source.reading import MappingReader, brief, fault, mapping_of, text_of
from apc.compiler.source.source import Source
from apc.compiler.topology.groups import GroupDeclaration, GroupReader, read_counts
from apc.compiler.topology.instances import PartInstance, PartReader, settable_names
from apc.compiler.topology.links import PROBABILITY, LinkDeclaration, read_link, without_range
from apc.compiler.topology.redeclarations import redeclared
from apc.compiler.topology.studies import read_experiment, read_studies
from apc.compiler.topology.timebase import ClockDeclaration, read_clocks
from apc.compiler.topology.topology_parameters import read_named_numbers
from apc.compiler.topology.topology_warnings import topology_warnings

SECTIONS = ("masses", "couplers", "links", "hands")  # those of parts
# The sections of a topology, described in view/schema.yaml.
TOPOLOGY = (
    "topology",
    "description",
    "library",
    "clocks",
    "parameters",
    "peers",
    "masses",
    "couplers",
    "links",
    "hands",
    "experiment",
    "studies",
)
# The required sections, and an example of each.
REQUIRED = {
    "topology": "my-topology",
    "peers": "{user: {count: 3}}",
    "masses": "{device: {mass: 0.1 kg}}",
}


@dataclass(frozen=True, slots=True)
class Topology:
    """A topology, whole. `texts` are the files it names; `warnings` are no mistakes."""

    name: str
    description: str
    clocks: tuple[ClockDeclaration, ...]
    parameters: Named[ScalarValue]
    groups: tuple[GroupDeclaration, ...]
    parts: tuple[PartInstance, ...]
    links: tuple[LinkDeclaration, ...]
    experiment: Experiment
    region: tuple[Axis, ...]
    tune: tuple[tuple[str, str], ...]
    texts: tuple[str, ...]
    location: SourceLocation
    warnings: tuple[Diagnostic, ...]

    @property
    def peers(self) -> int:
        """The number of peers."""
        return sum(group.count for group in self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its groups and parts."""
        return (*(group.name for group in self.groups), *(part.name for part in self.parts))

    def part(self, name: str) -> PartInstance:
        """Return the part of this name."""
        return next(part for part in self.parts if part.name == name)


def library_folders(source: Source) -> tuple[Path, ...]:
    """Return the folders of components that a topology names. Raises ApcError for one that isn't there."""
    node = source.root.get("library") if isinstance(source.root, Mapping) else None
    mistakes = Mistakes()
    paths = []
    for item in node.items if isinstance(node, Sequence) else () if node is None else (node,):
        with mistakes:
            text = text_of(item, "library", "library: ./parts")
            paths.append(readable_library(_folder_of(source) / text, text, item.location))
    mistakes.raise_if_any()
    return tuple(paths)


def readable_library(
    folder: Path, text: str, location: SourceLocation, *, key: str = "library:", example: str = "./parts"
) -> Path:
    """Return a folder of components.

    Parameters
    ----------
    folder, text
        The folder, and its name as written.
    location
        Where it is named.
    key, example
        The key or option that names it, and a value for it, for the fix.

    Raises
    ------
    ApcError
        E214 the folder cannot be read.
    """
    try:
        files_below(folder, SUFFIX)
    except RefusedError as refused:
        message = f"the library folder {brief(text)} {refused.words}"
        hint = f"{key} {example}" if refused.why == "large" else ""
        if refused.why == "missing" and folder.is_file():
            message = f"the library {brief(text)} is a file, and a library is a folder"
            hint = f"{key} {text.rpartition('/')[0] or '.'}"
        elif refused.why == "missing" and folder != Path(text):
            message += f": {folder} was looked for, as paths begin beside the topology"
        raise fault("E214", location, message, hint=hint) from None
    return folder


def _folder_of(source: Source) -> Path:
    return source.path.parent if source.path is not None else Path()


def build_topology(source: Source, library: Library) -> Topology:
    """Read a topology, those sections first that others refer to. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    files = NamedFiles(_folder_of(source), mistakes)
    node = mapping_of(source.root, "a topology", "topology: my-topology")
    peer_type, name = definition_of(source)
    if peer_type:
        message = f"{name} is a {peer_type}; a topology has parts of its type, and names the folder it is in"
        raise fault("E201", node.location, message, hint="library: ./parts")
    root = MappingReader(node, TOPOLOGY, "a topology", mistakes)
    for key, example in REQUIRED.items():
        if key not in root.nodes:
            message = (
                "the topology has no name" if key == "topology" else f"the topology has no {key} section"
            )
            mistakes.add("E201", root.location, message, hint=f"{key}: {example}")
    bodies = read_counts(root, files)
    named = [key.text for key, _ in root.section("peers", "{user: {count: 3}}")]
    complete = len(bodies) == len(named)  # a group whose count is at fault is named all the same
    counts = {name: bodies[name].count if name in bodies else 2 for name in (*bodies, *named)}
    mistakes.names = tuple(counts)
    numbers = read_named_numbers(root, counts, files, complete=complete)
    clocks = read_clocks(root, numbers, {*numbers.values, *counts})
    sections = PartEntries(library, mistakes, {*numbers.values, *counts, *clocks})
    for section in SECTIONS:
        sections.read(section, root)
    names = _Names(root, sections, clocks, tuple(counts))
    entries = sections.entries
    scope = EntryScope(
        numbers.dimension, numbers.names, names.of_role, sections, "this topology", names.complete
    )
    reader = PartReader(scope, numbers)
    others_at = redeclared(bodies.values(), sections)
    for entry in entries.values():
        reader.read(without_range(entry), others_at.get(entry.name, {}))
    parts = reader.parts
    links: list[LinkDeclaration] = []
    for part in parts:
        if part.section == "links" and "." not in part.name:
            with mistakes:
                links.append(read_link(part, entries[part.name], numbers))
    others = tuple(part for part in parts if part.section != "links")
    group_reader = GroupReader(settable_names(others), others, others_at, clocks, numbers, names.explain)
    groups = tuple(group_reader.read(group) for group in bodies.values())
    settable = settable_names(parts)
    for link in links:  # what one loses by can vary where it follows from no other number
        for name, value in link.channel.loss if link.channel is not None else ():
            if value.expression is None:
                settable[name] = PROBABILITY, [name]
    experiment = read_experiment(root, numbers)
    region, tune = read_studies(root, settable, numbers, names.is_reported)
    name, description = (visible(root.text(key)) for key in ("topology", "description"))
    mistakes.raise_if_any()  # before warnings, which would repeat missing items reported as errors
    return Topology(
        name,
        description,
        tuple(clocks.values()),
        tuple(numbers.values.items()),
        groups,
        others,
        tuple(links),
        experiment,
        region,
        tune,
        tuple(sorted(files.names)),
        root.location,
        topology_warnings(parts, entries, groups, library.replaced),
    )


@dataclass(frozen=True, slots=True)
class _Names:
    """The meanings of the names in a topology, and whether the error of an undefined one was reported."""

    root: MappingReader
    sections: PartEntries
    clocks: Collection[str]
    groups: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether no section of parts is missing that has to be there, or is none."""
        nodes = self.root.nodes
        return "masses" in nodes and all(isinstance(nodes.get(key), Mapping | None) for key in SECTIONS)

    @property
    def links(self) -> list[str]:
        """The names of the links."""
        return [name for name, entry in self.sections.entries.items() if entry.section == "links"]

    def of_role(self, role: str, word: str) -> Collection[str]:
        """Return the clocks or links, unused ones first. Raises the errors of their section."""
        section = f"{role}s"
        node = self.root.nodes.get(section)
        if word and node is None:
            example = "clocks: {haptic: 1 ms}" if role == "clock" else "links: {lan: {clock: network}}"
            raise fault("E201", self.root.location, f"the topology has no {section} section", hint=example)
        known = self.clocks if role == "clock" else self.links
        if word and word not in known and not (isinstance(node, Mapping) and node.get(word) is None):
            raise AlreadyReportedError
        text = () if word else {word for entry in self.sections.entries.values() for word in entry.words}
        return sorted(known, key=lambda name: name in text)

    def is_reported(self, name: str) -> bool:
        """Return whether `part.parameter` is of a part that is missing for a fault that was reported."""
        part = re.split(r"[.\[]", name)[0]
        return part in self.sections.faulty or (not self.complete and part not in self.sections.entries)

    def explain(self, name: str, location: SourceLocation) -> None:
        """Raise why a group can't set `part.parameter`, if that is known or was reported."""
        link, _, parameter = name.partition(".")
        if link in self.links:
            example = f"{link}: {{delays: {{{self.groups[0]}: {{{self.groups[-1]}: 12 ms}}}}}}"
            message = f"{name} is of a link, the same for all peers: a group can't set it"
            raise fault("E211", location, message, hint=example if parameter == "delay" else "")
        if self.is_reported(name):
            raise AlreadyReportedError
