"""A topology file to a scene: typed, every quantity in SI, every name resolved.

Takes: the YAML source of a topology and a library. Gives: `Scene`.
Guarantees: parts, clocks, links, parameters and connections that are named exist; quantities have the unit
their parameter wants and lie within its bounds; parts inside parts and arrays are written out; all mistakes
of the file are reported together.
Does not: look into a component's equations, or read a section itself: each has a module of its own
(`groups`, `named_numbers`, `timebase`, `sections`, `instances`, `links`, `studies`).
"""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Mapping as MappingType
from dataclasses import dataclass
from pathlib import Path

from apc.compiler.cache import SUFFIX
from apc.compiler.compiled import Axis, Experiment
from apc.compiler.components.component import Settable
from apc.compiler.components.library import Library, definition_of
from apc.compiler.errors import Mistake, Mistakes, Place, visible
from apc.compiler.files import RefusedError, files_below
from apc.compiler.language.tables import NamedFiles
from apc.compiler.language.values import Value
from apc.compiler.scene.channels import PROBABILITY
from apc.compiler.scene.groups import Columns, GroupBody, read_counts, read_settings, with_followers
from apc.compiler.scene.instances import Part, PartReader, settable_names
from apc.compiler.scene.links import SceneLink, read_link
from apc.compiler.scene.named_numbers import NamedNumbers, read_count_by_names, read_named_numbers
from apc.compiler.scene.oddities import oddities
from apc.compiler.scene.sections import SECTIONS, PartSections
from apc.compiler.scene.studies import read_experiment, read_region
from apc.compiler.scene.timebase import SceneClock, read_clocks
from apc.compiler.source.nodes import Mapping, Node, Sequence
from apc.compiler.source.reading import (
    brief,
    check_keys,
    read_mapping,
    read_text,
)
from apc.compiler.source.source import Source

KEYS = (
    "topology",
    "about",
    "library",
    "clocks",
    "parameters",
    "peers",
    *SECTIONS,
    "experiment",
    "studies",
)


@dataclass(frozen=True, slots=True, eq=False)
class SceneGroup:
    """`count` peers.

    `values` are the group's own settings by whole name (`contact.stiffness`) and what follows from them
    inside parts, `words` its own options and clocks, `columns` settings that differ from peer to peer,
    `counted` its count where that follows from named numbers.
    """

    name: str
    count: int
    values: tuple[tuple[str, Value], ...]
    words: tuple[tuple[str, str], ...]
    columns: Columns
    place: Place
    counted: Value | None = None


@dataclass(frozen=True, slots=True)
class Scene:
    """A topology, whole. `texts` are the files it names; `warnings` are no mistakes."""

    name: str
    about: str
    clocks: tuple[SceneClock, ...]
    parameters: tuple[tuple[str, Value], ...]
    groups: tuple[SceneGroup, ...]
    parts: tuple[Part, ...]
    links: tuple[SceneLink, ...]
    experiment: Experiment
    region: tuple[Axis, ...]
    texts: tuple[str, ...]
    place: Place
    warnings: tuple[Mistake, ...] = ()

    @property
    def peers(self) -> int:
        """The number of peers."""
        return sum(group.count for group in self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its groups and parts."""
        return (*(group.name for group in self.groups), *(part.name for part in self.parts))

    def part(self, name: str) -> Part:
        """Return the part of this name."""
        return next(part for part in self.parts if part.name == name)


def build_scene(source: Source, library: Library) -> Scene:
    """Read a topology. Raises ApcError with every mistake of the file."""
    mistakes = Mistakes()
    scene = _read_scene(source, library, mistakes)
    mistakes.raise_if_any()
    assert scene is not None
    return scene


def library_folders(source: Source) -> tuple[Path, ...]:
    """Return the folders of components that a topology names. Raises ApcError for one that isn't there."""
    if not isinstance(source.root, Mapping):
        return ()
    node = source.root.get("library")
    nodes = node.items if isinstance(node, Sequence) else () if node is None else (node,)
    mistakes = Mistakes()
    found = []
    for item in nodes:
        text = read_text(item, "library", mistakes, hint="library: ./parts")
        if text is not None:
            folder = _folder_of(source) / text
            try:
                files_below(folder, SUFFIX)
            except RefusedError as refused:
                mistakes.add(
                    "E214",
                    item.place,
                    f"the library folder {brief(text)} {refused.words}",
                    hint="library: ./parts" if refused.why == "large" else "",
                )
            else:
                found.append(folder)
    mistakes.raise_if_any()
    return tuple(found)


def _folder_of(source: Source) -> Path:
    return source.path.parent if source.path is not None else Path()


def _read_scene(source: Source, library: Library, mistakes: Mistakes) -> Scene | None:
    """Read every section, those first that others refer to."""
    files = NamedFiles(_folder_of(source), mistakes)
    root = read_mapping(source.root, "a topology", mistakes, hint="topology: my-scene")
    if root is None:
        return None
    kind, name = definition_of(source)
    if kind:
        what = f"{name} is a {kind}; a topology has parts of its type, and names the folder it is in"
        mistakes.add("E201", root.place, what, hint="library: ./parts")
        return None
    root = check_keys(root, KEYS, "a topology", mistakes)
    title = visible(read_text(_required(root, "topology", "my-scene", mistakes), "topology", mistakes) or "")
    about = visible(read_text(root.get("about"), "about", mistakes) or "")
    peers = _required(root, "peers", "{user: {count: 3}}", mistakes)
    _required(root, "masses", "{device: {mass: 0.1 kg}}", mistakes)
    named = root.get("parameters")
    bodies = read_counts(peers, files, lambda node: read_count_by_names(node, named, mistakes))
    counts = {name: group.count for name, group in bodies.items()}
    mistakes.names = tuple(counts)
    numbers = read_named_numbers(named, sum(counts.values()), mistakes)
    clocks = read_clocks(root.get("clocks"), numbers, {*numbers.values, *counts}, mistakes)
    sections = PartSections(root, library, {*numbers.values, *counts, *clocks}, mistakes)
    reader = PartReader(sections.entries, sections.scope(numbers, clocks), numbers, counts, files)
    parts = [part for name in sections.entries for part in reader.read(name)]
    links = [
        read_link(part, sections.entries[part.name].body, counts, numbers, files)
        for part in parts
        if part.section == "links" and "." not in part.name
    ]
    read_links = tuple(link for link in links if link is not None)
    settable = settable_names(parts)
    varied = settable | _of_losses(read_links)
    groups = _read_groups(bodies, settable, parts, clocks, sections, numbers)
    set_by_groups = {name for group in groups for name, _ in (*group.values, *group.words, *group.columns)}
    # Where there are mistakes, what is missing for one would be told a second time.
    warnings = () if mistakes else oddities(parts, sections.entries, counts, set_by_groups)
    return Scene(
        title,
        about,
        tuple(clocks.values()),
        tuple(numbers.values.items()),
        groups,
        tuple(part for part in parts if part.section != "links"),
        read_links,
        read_experiment(root.get("experiment"), numbers.read_time, mistakes),
        read_region(root.get("studies"), varied, sections.is_reported, numbers.read_for, mistakes),
        tuple(sorted(files.names)),
        root.place,
        warnings,
    )


def _of_losses(links: Collection[SceneLink]) -> dict[str, list[tuple[str, Settable]]]:
    """Return the probabilities of links' losses that can vary: those that follow from no other."""
    return {
        name: [(name, PROBABILITY)]
        for link in links
        if link.channel is not None
        for name, value in link.channel.loss
        if value.expression is None
    }


def _required(root: Mapping, key: str, example: str, mistakes: Mistakes) -> Node | None:
    """Return the node of a key that a topology must have."""
    node = root.get(key)
    if node is None:
        what = f"the topology has no {key}" + ("" if key == "topology" else " section")
        mistakes.add("E201", root.place, what, hint=f"{key}: {example}")
    return node


def _read_groups(
    bodies: MappingType[str, GroupBody],
    settable: MappingType[str, list[tuple[str, Settable]]],
    parts: list[Part],
    clocks: Collection[str],
    sections: PartSections,
    numbers: NamedNumbers,
) -> tuple[SceneGroup, ...]:
    """Read what each group of peers sets for itself: anything but what is of a link."""
    own = {name: items for name, items in settable.items() if not sections.is_of_link(name)}
    places = {part.name: part.groups for part in parts}

    def explained(name: str, place: Place) -> bool:
        """Return whether it was said why a group can't set `part.parameter`; of a link's, say it here."""
        if not sections.is_of_link(name):
            return sections.is_reported(name)
        link, _, parameter = name.partition(".")
        sender, receiver = next(iter(bodies)), list(bodies)[-1]
        hint = f"{link}: {{delays: {{{sender}: {{{receiver}: 12 ms}}}}}}" if parameter == "delay" else ""
        what = f"{name} is of a link, the same for all peers: a group can't set it"
        numbers.mistakes.add("E211", place, what, hint=hint)
        return True

    found = []
    for group in bodies.values():
        place = group.body.place
        settings = read_settings(group, own, places, clocks, numbers.read_for, explained, numbers.mistakes)
        settings = with_followers(settings, parts, numbers.values, numbers.peers, place, numbers.mistakes)
        found.append(
            SceneGroup(
                *(group.name, group.count, settings.values, settings.words, settings.columns, place),
                counted=group.counted,
            )
        )
    return tuple(found)
