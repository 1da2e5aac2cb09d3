"""A topology as typed data: every quantity in SI, every name resolved.

Takes: the YAML source of a topology and a library. Gives: `build_topology`, `read_topology`, the
`Topology`; `library_folders`, `readable_library`.
Guarantees: parts, clocks, links, parameters and connections that are named exist; quantities have the unit
their parameter requires and lie within its bounds; inner parts and array elements are separate parts; all
mistakes of the file are reported together.
Does not: analyze a component's equations, or read a section: each section has its own module
(`groups`, `topology_parameters`, `timebase`, `instances`, `links`, `studies`).
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
from apc.compiler.files import FileReader, RefusedError
from apc.compiler.language.csv_tables import NamedFiles
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.source.nodes import Mapping, Scalar, Sequence
from apc.compiler.source.reading import MappingReader, brief, fault, first_use, mapping_of, text_of
from apc.compiler.source.source import Source
from apc.compiler.topology.channels import PROBABILITY
from apc.compiler.topology.groups import GroupDeclaration, GroupReader, read_counts
from apc.compiler.topology.instances import PartInstance, PartReader, settable_names
from apc.compiler.topology.links import PAIR, LinkDeclaration, read_link, without_range
from apc.compiler.topology.redeclarations import redeclared
from apc.compiler.topology.studies import read_experiment, read_studies
from apc.compiler.topology.timebase import ClockDeclaration, read_clocks
from apc.compiler.topology.topology_parameters import read_named_numbers
from apc.compiler.topology.topology_warnings import topology_warnings

SECTIONS = ("masses", "couplers", "links", "hands")  # the sections with parts
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
KINDS = {"peers": "a group of peers", "parameters": "a parameter", "clocks": "a clock"}
# The sections that can be nested in another one by their indentation.
NESTED = (*SECTIONS, "clocks", "parameters", "peers", "experiment", "studies")
# The required sections, and an example of each.
REQUIRED = {
    "topology": "my-topology",
    "peers": "{user: {count: 3}}",
    "masses": "",  # by the objects of the couplers and hands
}


@dataclass(frozen=True, slots=True)
class Topology:
    """A topology with all its sections. `texts` are the names of the files that it refers to."""

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
        """The names of the groups and parts."""
        return (*(group.name for group in self.groups), *(part.name for part in self.parts))

    def part(self, name: str) -> PartInstance:
        """Return the part of this name."""
        return next(part for part in self.parts if part.name == name)


def library_folders(source: Source) -> tuple[Path, ...]:
    """Return the folders of components that a topology names in `library`.

    Raises ApcError for a folder that cannot be read.
    """
    node = source.root.get("library") if isinstance(source.root, Mapping) else None
    mistakes = Mistakes()
    paths = []
    for item in node.items if isinstance(node, Sequence) else () if node is None else (node,):
        with mistakes:
            text = text_of(item, "library", "library: ./parts")
            paths.append(readable_library(_folder_of(source) / text, source.reader, text, item.location))
    mistakes.raise_if_any()
    return tuple(paths)


def readable_library(
    folder: Path,
    reader: FileReader,
    text: str,
    location: SourceLocation,
    *,
    key: str = "library:",
    example: str = "./parts",
) -> Path:
    """Return the folder of components after checking that it can be read.

    Parameters
    ----------
    folder, reader, text
        The folder, the reader of the compilation, and the folder's name as written.
    location
        The place of the name.
    key, example
        The key or option that names the folder, and an example of its value, for the fix.

    Raises
    ------
    ApcError
        E214 the folder cannot be read.
    """
    try:
        reader.files_below(folder, SUFFIX)
    except RefusedError as refused:
        message = f"the library folder {brief(text)} {refused.words}"
        fix = f"{key} {example}" if refused.why == "large" else ""
        if refused.why == "missing" and folder.is_file():
            message = f"library: expected a folder, got the file {brief(text)}"
            parent = text.rpartition("/")[0] or "."
            fix = f"{key} {parent}" if text.endswith((".yaml", ".yml")) else ""
        elif refused.why == "missing" and folder != Path(text):
            message += f" (paths are relative to the topology; searched: {folder})"
        raise fault("E214", location, message, fix=fix) from None
    return folder


def _folder_of(source: Source) -> Path:
    """Return the folder that relative paths of a topology refer to."""
    return source.path.parent if source.path is not None else Path()


def read_topology(source: Source) -> Topology:
    """Return `build_topology` of a source with its own library."""
    return build_topology(source, Library(library_folders(source), reader=source.reader))


def build_topology(source: Source, library: Library) -> Topology:
    """Return the topology of a source. Raises ApcError with all mistakes of the source.

    A section is read after the sections whose names it can refer to.
    """
    mistakes = Mistakes()
    files = NamedFiles(_folder_of(source), mistakes, source.reader)
    node = mapping_of(source.root, "topology", "topology: my-topology")
    peer_type, name = definition_of(source)
    if peer_type:
        message = (
            f"{name} is a {peer_type}, not a topology; name its folder in a topology and use it as a type"
        )
        raise fault("E201", node.location, message, fix="library: ./parts")
    _refuse_nested_section(node)
    root = MappingReader(node, TOPOLOGY, "a topology", mistakes)
    for key, example in REQUIRED.items():
        if key not in root.nodes:
            message = (
                "the topology has no name" if key == "topology" else f"the topology has no {key} section"
            )
            if example:
                mistakes.add("E201", root.location, message, fix=f"{key}: {example}")
    bodies = read_counts(root, files)
    group_names = [key.text for key, _ in root.section("peers", "{user: {count: 3}}")]
    complete = len(bodies) == len(group_names)  # a group with an invalid count is included by name
    counts = {name: bodies[name].count if name in bodies else 2 for name in (*bodies, *group_names)}
    mistakes.names = tuple(counts)
    numbers = read_named_numbers(root, counts, files, complete=complete)
    uses = _uses(root, "peers", counts) | _uses(root, "parameters", numbers.values)
    clocks = read_clocks(root, numbers, uses)
    sections = PartEntries(library, mistakes, uses | _uses(root, "clocks", clocks))
    for section in SECTIONS:
        sections.read(section, root)
    if "masses" not in root.nodes:
        fix = f"masses: {sections.missing_masses()}"
        mistakes.add("E201", root.location, "the topology has no masses section", fix=fix)
    names = _Names(root, sections, clocks, tuple(counts))
    entries = sections.entries
    scope = EntryScope(numbers.dimension, numbers.names, names.of_role, sections, names.complete)
    reader = PartReader(scope, numbers)
    redeclared_entries = redeclared(bodies.values(), sections)
    for entry in entries.values():
        reader.read(without_range(entry), redeclared_entries.get(entry.name, {}))
    parts = reader.parts
    links: list[LinkDeclaration] = []
    for part in parts:
        if part.section == "links" and "." not in part.name:
            with mistakes:
                links.append(read_link(part, entries[part.name], numbers, scope))
    others = tuple(part for part in parts if part.section != "links")
    group_reader = GroupReader(
        settable_names(others), others, redeclared_entries, clocks, numbers, names.explain
    )
    groups = tuple(group_reader.read(group) for group in bodies.values())
    settable = settable_names(parts)
    for link in links:  # a loss probability is settable unless it depends on other numbers
        for channel in link.channels:
            settable |= {
                name: (PROBABILITY, [name]) for name, value in channel.loss if value.expression is None
            }
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
        topology_warnings(parts, links, entries, groups, library.replaced),
    )


def _uses(root: MappingReader, section: str, names: Collection[str]) -> dict[str, str]:
    """Return the use of each of some names that a section defines, for messages about a second use."""
    node = root.nodes.get(section)
    entries = node.entries if isinstance(node, Mapping) else ()
    return {key.text: first_use(KINDS[section], key.location) for key, _ in entries if key.text in names}


def _refuse_nested_section(root: Mapping) -> None:
    """Raise ApcError E202 for a section within another one, such as `couplers` within `masses`.

    A part can have the name of a section; then its values are no mappings.
    """
    for section in ("clocks", "parameters", "peers", *SECTIONS):
        body = root.get(section)
        for key, value in body.entries if isinstance(body, Mapping) else ():
            is_empty = isinstance(value, Scalar) and value.value is None
            items = value.entries if isinstance(value, Mapping) else ()
            if key.text in NESTED and (
                is_empty or (items and all(isinstance(item, Mapping) for _, item in items))
            ):
                message = f"{key.text} is a section, not an entry of {section}"
                advice = f"indent {key.text} like {section}"
                raise fault("E202", key.location, message, advice=advice)


@dataclass(frozen=True, slots=True)
class _Names:
    """The names of a topology: clocks, parts and groups, and whether the error of a missing part was
    reported.
    """

    root: MappingReader
    sections: PartEntries
    clocks: Collection[str]
    groups: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether the sections of parts are mappings and the required section `masses` exists."""
        nodes = self.root.nodes
        return "masses" in nodes and all(isinstance(nodes.get(key), Mapping | None) for key in SECTIONS)

    @property
    def links(self) -> list[str]:
        """The names of the links."""
        return [name for name, entry in self.sections.entries.items() if entry.section == "links"]

    def of_role(self, role: str, word: str) -> Collection[str]:
        """Return the names of the clocks or links, unused ones first, for `role` "clock" or "link".

        Raises ApcError if `word` is given and the section is missing, AlreadyReportedError if the entry of
        `word` is invalid.
        """
        section = f"{role}s"
        node = self.root.nodes.get(section)
        if word and node is None:
            nodes = (entry.body.get(role) for entry in self.sections.entries.values())
            used = dict.fromkeys(node.text for node in nodes if isinstance(node, Scalar) and node.text)
            value = "1 ms"
            if role == "link":
                value = f"{{clock: {next(iter(self.of_role('clock', '')), 'network')}}}"
            example = f"{section}: {{{', '.join(f'{name}: {value}' for name in used or (word,))}}}"
            raise fault("E201", self.root.location, f"the topology has no {section} section", fix=example)
        known = self.clocks if role == "clock" else self.links
        if word and word not in known and not (isinstance(node, Mapping) and node.get(word) is None):
            raise AlreadyReportedError
        text = () if word else {used for entry in self.sections.entries.values() for used in entry.words}
        return sorted(known, key=lambda name: name in text)

    def is_reported(self, name: str) -> bool:
        """Return whether the part of the name `part.parameter` is missing due to an error that was
        reported.
        """
        part = re.split(r"[.\[]", name)[0]
        return part in self.sections.faulty or (not self.complete and part not in self.sections.entries)

    def explain(self, name: str, location: SourceLocation, group: str, value: str) -> None:
        """Raise the specific error of a name `part.parameter` that a group can't set, if there is one.

        `value` is the value as written.

        Raises ApcError for a parameter of a link, AlreadyReportedError for a part whose error was reported.
        """
        link, _, parameter = name.partition(".")
        if link in self.links:
            other = next((name for name in reversed(self.groups) if name != group), group)
            example = f"{link}: {{pairs: {{{group}: {{{other}: {{{parameter}: {value}}}}}}}}}"
            advice = f"set it in links, as in {example}" if parameter in PAIR else ""
            message = f"{name} belongs to a link and can't be set by a group"
            raise fault("E211", location, message, advice=advice)
        if self.is_reported(name):
            raise AlreadyReportedError
