"""A topology file to a scene: typed, every quantity in SI, every name resolved.

Takes: the YAML source of a topology and a library. Gives: `Scene`.
Guarantees: parts, clocks, links, parameters and connections that are named exist; quantities have the unit
their parameter wants and lie within its bounds; parts inside parts and arrays are written out; all mistakes
of the file are reported together.
Does not: look into a component's equations.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from apc.compiler.channels import SceneChannel, read_channel
from apc.compiler.compiled import Axis, Experiment, Graph
from apc.compiler.component import Component, Number, Option, Reference, Settable
from apc.compiler.definitions import RESERVED, read_type
from apc.compiler.dimensions import SECOND
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.graphs import COMPLETE, SceneDelay, read_graph, read_pairs
from apc.compiler.groups import Columns, GroupBody, read_counts, read_settings
from apc.compiler.library import Library
from apc.compiler.parts import LARGEST_ARRAY, MOST_PARTS, Scope, read_entry
from apc.compiler.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    form,
    read_mapping,
    read_name,
    read_text,
)
from apc.compiler.source import Mapping, Node, Scalar, Sequence, Source
from apc.compiler.studies import read_experiment, read_region
from apc.compiler.tables import TimeTable, read_time_table
from apc.compiler.units import DIMENSIONLESS, Dimension
from apc.compiler.values import (
    PEERS,
    AlreadyReportedError,
    Binding,
    Value,
    read_binding,
    read_free,
    renamed,
    resolve_in_order,
    settle,
)

SECTIONS = ("masses", "couplers", "links", "hands")
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
DEFAULT_TYPES = {"masses": "Mass", "links": "Link"}
EXAMPLES = {
    "masses": "device: {mass: 0.1 kg}",
    "links": "lan: {clock: network}",
    "couplers": "contact: {type: SampledSpringDamper}",
    "hands": "hand: {type: ConstantForce}",
}
TYPE_EXAMPLES = {"couplers": "SampledSpringDamper", "hands": "ConstantForce"}
PART_KEYS = ("at", "shared", "count")


@dataclass(frozen=True, slots=True)
class SceneClock:
    """Ticks at `phase + k*period`, in seconds."""

    name: str
    period: Value
    phase: Value


@dataclass(frozen=True, slots=True)
class Part:
    """An instance of a component at every peer of `groups`; parts inside parts are parts of their own.

    `values` holds a value for every number the component declares, `options` and `references` a word for
    every option and every clock or link it names, `starts` the start values given here; `connections` join
    a connector of this part to (part, connector), the part "ground" being fixed.
    """

    name: str
    section: str
    component: Component
    values: tuple[tuple[str, Value], ...]
    options: tuple[tuple[str, str], ...]
    references: tuple[tuple[str, str], ...]
    tables: tuple[TimeTable, ...]
    starts: tuple[tuple[str, Value], ...]
    connections: tuple[tuple[str, str, str], ...]
    shared: bool
    groups: tuple[str, ...]
    place: Place

    def reference(self, role: str) -> str | None:
        """Return the clock or link this part names, when it names exactly one."""
        names = {p.name for p in self.component.parameters if isinstance(p, Reference) and p.role == role}
        named = [word for name, word in self.references if name in names]
        return named[0] if len(named) == 1 else None


@dataclass(frozen=True, slots=True)
class SceneLink:
    """Who hears whom over a link, how late, and how unreliably (`channel`, None for a reliable one)."""

    name: str
    clock: str
    delay: Value
    graph: Graph
    delays: tuple[SceneDelay, ...]
    channel: SceneChannel | None
    place: Place


@dataclass(frozen=True, slots=True)
class SceneGroup:
    """`count` peers.

    `values` are the group's own settings by whole name (`contact.stiffness`), `words` its own options and
    clocks, `columns` settings that differ from peer to peer.
    """

    name: str
    count: int
    values: tuple[tuple[str, Value], ...]
    words: tuple[tuple[str, str], ...]
    columns: Columns
    place: Place


@dataclass(frozen=True, slots=True)
class Scene:
    """A topology, whole. `texts` are the digests of the files it names."""

    name: str
    about: str
    clocks: tuple[SceneClock, ...]
    parameters: tuple[tuple[str, Value], ...]
    groups: tuple[SceneGroup, ...]
    parts: tuple[Part, ...]
    links: tuple[SceneLink, ...]
    experiment: Experiment
    region: tuple[Axis, ...]
    texts: tuple[tuple[str, str], ...]
    place: Place

    @property
    def peers(self) -> int:
        """The number of peers."""
        return sum(group.count for group in self.groups)

    def part(self, name: str) -> Part:
        """Return the part of this name."""
        return next(part for part in self.parts if part.name == name)


@dataclass(frozen=True, slots=True)
class _Body:
    """A part's entry before it is read."""

    section: str
    body: Mapping
    component: Component
    place: Place
    count: int | None


def build_scene(source: Source, library: Library) -> Scene:
    """Read a topology. Raises ApcError with every mistake of the file."""
    reader = _Reader(source, library)
    scene = reader.read()
    reader.mistakes.raise_if_any()
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
            if folder.is_dir():
                found.append(folder)
            else:
                mistakes.add("E214", item.place, f"the library folder {brief(text)} does not exist")
    mistakes.raise_if_any()
    return tuple(found)


def _folder_of(source: Source) -> Path:
    return source.path.parent if source.path is not None else Path()


class _Reader:
    """The state of one reading: what is known so far, and the mistakes."""

    def __init__(self, source: Source, library: Library) -> None:
        self.library = library
        self.mistakes = Mistakes()
        self.source = source
        self.folder = _folder_of(source)
        self.clocks: dict[str, SceneClock] = {}
        self.parameters: dict[str, Value] = {}
        self.bodies: dict[str, _Body] = {}
        self.groups: dict[str, GroupBody] = {}
        self.faulty: set[str] = set()  # parts that are there but can't be read: reported once, there
        self.faulty_names: set[str] = set()  # parameters without a value, likewise
        self.complete = True  # False when a section of parts is missing or faulty
        self.texts: dict[str, str] = {}
        self.number_of_parts = 0

    @property
    def counts(self) -> dict[str, int]:
        return {name: group.count for name, group in self.groups.items()}

    def read(self) -> Scene | None:
        mistakes = self.mistakes
        root = read_mapping(self.source.root, "a topology", mistakes, hint="topology: my-scene")
        if root is None:
            return None
        root = check_keys(root, KEYS, "a topology", mistakes)
        title = read_text(self._required(root, "topology", "topology: my-scene"), "topology", mistakes) or ""
        about = read_text(root.get("about"), "about", mistakes) or ""
        peers = self._required(root, "peers", "peers: {user: {count: 3}}")
        self.groups = read_counts(peers, self.folder, mistakes, self.texts)
        self._required(root, "masses", "masses: {device: {mass: 0.1 kg}}")
        self._read_parameters(root.get("parameters"))
        self._read_clocks(root.get("clocks"))
        for section in SECTIONS:
            node = root.get(section)
            self._read_section(section, node)
            required = section == "masses"
            self.complete &= isinstance(node, Mapping) or (node is None and not required)
        parts = [part for name, body in self.bodies.items() for part in self._read_part(name, body, root)]
        links = tuple(self._link(part) for part in parts if part.section == "links" and "." not in part.name)
        settable = _settable(parts)
        groups = tuple(self._group(group, settable) for group in self.groups.values())
        experiment = read_experiment(root.get("experiment"), self._time, mistakes)
        studies = root.get("studies")
        region = read_region(studies, settable, self._is_reported, self._binding_of, mistakes)
        return Scene(
            title,
            about,
            tuple(self.clocks.values()),
            tuple(self.parameters.items()),
            groups,
            tuple(part for part in parts if part.section != "links"),
            tuple(link for link in links if link is not None),
            experiment,
            region,
            tuple(sorted(self.texts.items())),
            root.place,
        )

    def _required(self, root: Mapping, key: str, hint: str) -> Node | None:
        node = root.get(key)
        if node is None:
            what = f"the topology has no {key}" + ("" if key == "topology" else " section")
            self.mistakes.add("E201", root.place, what, hint=hint)
        return node

    # ---- named numbers ----

    def _dimension(self, parts: tuple[str, ...]) -> Dimension | None:
        if parts == PEERS:
            return DIMENSIONLESS
        name = ".".join(parts)
        if name in self.faulty_names:
            raise AlreadyReportedError
        value = self.parameters.get(name)
        return None if value is None else value.dimension

    def _number(self, parts: tuple[str, ...]) -> Fraction:
        return (
            Fraction(sum(self.counts.values())) if parts == PEERS else self.parameters[".".join(parts)].number
        )

    def _value(self, node: Node | None, what: str, dimension: Dimension, unit: str) -> Value | None:
        names = ("peers", *self.parameters)
        return self._settled(read_binding(node, what, dimension, unit, self._dimension, names, self.mistakes))

    def _settled(self, binding: Binding | None) -> Value | None:
        if binding is None:
            return None
        try:
            return settle(binding, self._number)
        except ApcError as error:
            self.mistakes.take(error)
            return None

    def _time(self, node: Node | None, what: str) -> Value | None:
        """Read a duration; a rate in Hz counts as its reciprocal."""
        if not (isinstance(node, Scalar) and node.text.rstrip().endswith("Hz")):
            return self._value(node, what, SECOND, "s")
        rate = self._value(node, what, SECOND.power(-1), "Hz")
        if rate is None:
            return None
        if rate.number == 0:
            got = brief(node.text)
            self.mistakes.add("E207", node.place, what, expected="a rate above 0 Hz", got=got)
            return None
        return Value(1 / rate.number, SECOND, None, rate.place)

    def _read_parameters(self, node: Node | None) -> None:
        section = read_mapping(node, "parameters", self.mistakes, hint="parameters: {kt: 2000 N/m}")
        waiting: dict[str, Binding] = {}
        for key, value in entries(section):
            name = read_name(key, "a parameter", self.mistakes)
            binding = read_free(value, key.text, self.mistakes)
            if name in RESERVED:
                self.mistakes.add("E205", key.place, f"{name} is a word of the language and can't be a name")
            elif name is not None and binding is not None:
                waiting[name] = binding
                continue
            self.faulty_names.add(key.text)
        self.parameters, faulty = resolve_in_order(waiting, sum(self.counts.values()), self.mistakes)
        self.faulty_names |= faulty

    def _read_clocks(self, node: Node | None) -> None:
        for key, value in entries(read_mapping(node, "clocks", self.mistakes, hint="clocks: {haptic: 1 ms}")):
            name = read_name(key, "a clock", self.mistakes)
            if name is None:
                continue
            if name in RESERVED:
                self.mistakes.add("E205", key.place, f"{name} is a word of the language and can't be a name")
                continue
            if name in self.parameters or name in self.groups:
                self.mistakes.add("E205", key.place, f"the name {name} is used twice in this topology")
                continue
            phase: Value | None = Value(Fraction(0), SECOND, None, value.place)
            if isinstance(value, Mapping):
                body = check_keys(value, ("period", "phase"), f"clock {name}", self.mistakes)
                period = self._time(body.get("period"), "period")
                if body.get("period") is None:
                    self.mistakes.add("E201", value.place, f"clock {name} has no period", hint="period: 1 ms")
                if body.get("phase") is not None:
                    phase = self._time(body.get("phase"), "phase")
            else:
                period = self._time(value, name)
            if period is not None and phase is not None and self._check_clock(name, period, phase):
                self.clocks[name] = SceneClock(name, period, phase)

    def _check_clock(self, name: str, period: Value, phase: Value) -> bool:
        if period.number <= 0:
            what, got = f"the period of clock {name}", str(period)
            self.mistakes.add(
                "E207", period.place, what, expected="more than 0 s", got=got, hint=f"{name}: 1 ms"
            )
            return False
        if not 0 <= phase.number < period.number:
            what, expected = f"the phase of clock {name}", "0 s or more and less than its period"
            self.mistakes.add("E207", phase.place, what, expected=expected, got=str(phase))
            return False
        return True

    # ---- parts ----

    def _read_section(self, section: str, node: Node | None) -> None:
        """Collect the parts of a section and their components, so that names can be resolved."""
        hint = f"{section}: {{{EXAMPLES[section]}}}"
        for key, value in entries(read_mapping(node, section, self.mistakes, hint=hint)):
            name = read_name(key, f"a part of {section}", self.mistakes)
            body = read_mapping(value, key.text, self.mistakes, hint=EXAMPLES[section])
            if key.text not in self.bodies:
                self.faulty.add(key.text)  # until it has been read
            if name is None or body is None:
                continue
            if name in self.bodies or name in self.clocks or name in self.parameters or name in self.groups:
                self.mistakes.add("E205", key.place, f"the name {name} is used twice in this topology")
                continue
            if name in RESERVED:
                self.mistakes.add("E205", key.place, f"{name} is a word of the language and can't be a name")
                continue
            component = read_type(
                key,
                body,
                DEFAULT_TYPES.get(section),
                self.library,
                self.mistakes,
                example=TYPE_EXAMPLES.get(section, "Mass"),
            )
            if component is not None:
                self.bodies[name] = _Body(
                    section, body, component, key.place, self._count(name, section, body)
                )
                self.faulty.discard(name)

    def _count(self, name: str, section: str, body: Mapping) -> int | None:
        """Return how many of a part there are; None for one that is no array."""
        node = body.get("count")
        if node is None:
            return None
        count = node.value if isinstance(node, Scalar) and node.plain else None
        usable = isinstance(count, int) and not isinstance(count, bool) and section != "links"
        if usable and isinstance(count, int) and 1 <= count <= LARGEST_ARRAY:
            return count
        expected = (
            f"a whole number from 1 to {LARGEST_ARRAY}"
            if section != "links"
            else "no count, as a link is one"
        )
        self.mistakes.add("E208", node.place, f"the count of {name}", expected=expected, got=form(node))
        return None

    def _is_reported(self, name: str) -> bool:
        """Return whether `part.parameter` is of a part that is missing for a fault that was reported."""
        part = re.split(r"[.\[]", name)[0]
        return part in self.faulty or (not self.complete and part not in self.bodies)

    def _is_of_link(self, name: str) -> bool:
        body = self.bodies.get(name.partition(".")[0])
        return body is not None and body.section == "links"

    def _is_explained(self, name: str, place: Place) -> bool:
        """Return whether it was said why a group can't set `part.parameter`; of a link's, say it here."""
        if not self._is_of_link(name):
            return self._is_reported(name)
        link, _, parameter = name.partition(".")
        sender, receiver = next(iter(self.groups)), list(self.groups)[-1]
        hint = f"{link}: {{delays: {{{sender}: {{{receiver}: 12 ms}}}}}}" if parameter == "delay" else ""
        what = f"{name} is of a link, the same for all peers: a group can't set it"
        self.mistakes.add("E211", place, what, hint=hint)
        return True

    def _scope(self, root: Mapping) -> Scope:
        links = [name for name, body in self.bodies.items() if body.section == "links"]

        def references(role: str, word: str, place: Place) -> Collection[str] | None:
            section = f"{role}s"
            node = root.get(section)
            if word and node is None:
                example = "clocks: {haptic: 1 ms}" if role == "clock" else "links: {lan: {clock: network}}"
                self.mistakes.add("E201", root.place, f"the topology has no {section} section", hint=example)
                return None
            known = self.clocks if role == "clock" else links
            reported = word not in known and not (isinstance(node, Mapping) and node.get(word) is None)
            return None if reported else known

        return Scope(
            dimension=self._dimension,
            names=("peers", *self.parameters),
            references=references,
            parts={name: body.component for name, body in self.bodies.items()},
            counts={name: body.count for name, body in self.bodies.items() if body.count is not None},
            faulty=self.faulty,
            whole="this topology",
            complete=self.complete,
        )

    def _read_part(self, name: str, entry: _Body, root: Mapping) -> list[Part]:
        """Read a part's entry, once for each element of an array, and write out the parts inside."""
        shared = self._shared(name, entry.component, entry.body.get("shared"))
        groups = self._groups_of(name, entry.body.get("at"))
        peers = sum(self.counts.get(group, 0) for group in groups)
        if entry.component.hears_others and peers == 1:
            what = f"{name} ({entry.component.name}) follows the other peers and"
            self.mistakes.add(
                "E208", entry.place, what, expected="at least 2 peers", got="1", hint="count: 2"
            )
        scope = self._scope(root)
        found: list[Part] = []
        for index in range(1, (entry.count or 1) + 1):
            read = read_entry(
                name,
                entry.body,
                entry.component,
                entry.place,
                scope,
                self.mistakes,
                more_keys=PART_KEYS,
                index=index,
                count=entry.count,
                free_connectors=self._free_connectors(name, entry),
            )
            part = Part(
                name if entry.count is None else f"{name}[{index}]",
                entry.section,
                entry.component,
                self._settled_all(read.values, entry.component),
                read.options,
                read.references,
                self._tables(name, entry, read.described),
                self._settled_all(read.starts, None),
                read.connections,
                shared,
                groups,
                entry.place,
            )
            found += self._with_inner(part)
        return found

    def _free_connectors(self, name: str, entry: _Body) -> Collection[str]:
        """Return the connectors an entry need not mention: a mass's, and those another entry is joined to."""
        connectors = [connector for connector, _ in entry.component.connectors]
        if entry.section == "masses":
            return connectors
        named = {
            value.text
            for other in self.bodies.values()
            for _, value in other.body.entries
            if isinstance(value, Scalar)
        }
        return [connector for connector in connectors if f"{name}.{connector}" in named]

    def _settled_all(
        self, bindings: Collection[tuple[str, Binding]], component: Component | None
    ) -> tuple[tuple[str, Value], ...]:
        found = []
        for name, binding in bindings:
            value = self._settled(binding)
            if value is None:
                continue
            parameter = component.parameter(name) if component is not None else None
            if isinstance(parameter, Number):
                parameter.bounds.check(value, name, self.mistakes)
            found.append((name, value))
        return tuple(found)

    def _with_inner(self, part: Part) -> list[Part]:
        """Return a part and the parts inside it; an inner part's numbers are expressions over the outer's."""
        found = [part]
        self.number_of_parts += 1
        if self.number_of_parts > MOST_PARTS:
            if self.number_of_parts == MOST_PARTS + 1:
                what = f"a peer would have more than {MOST_PARTS} parts, those inside parts included"
                self.mistakes.add("E216", part.place, what, hint="fewer or smaller arrays and components")
            return found
        values = dict(part.values)
        references = dict(part.references)
        tables = {table.name: table for table in part.tables}

        def number(parts: tuple[str, ...]) -> Fraction:
            own = parts[-1]
            return Fraction(sum(self.counts.values())) if parts == PEERS else values[own].number

        def whole(parts: tuple[str, ...]) -> tuple[str, ...]:
            return parts if parts == PEERS else (*part.name.split("."), *parts)

        for inner in part.component.inner:

            def settled(bindings: Collection[tuple[str, Binding]]) -> tuple[tuple[str, Value], ...]:
                listed = []
                for name, binding in bindings:
                    tree = None if binding.expression is None else renamed(binding.expression, whole)
                    moved = Binding(binding.number, tree, binding.dimension, part.place)
                    try:
                        listed.append((name, settle(moved, number)))
                    except (ApcError, KeyError):
                        continue  # the outer number it depends on was reported
                return tuple(listed)

            entry = inner.entry
            instance = Part(
                f"{part.name}.{inner.name}",
                part.section,
                inner.component,
                settled(entry.values),
                entry.options,
                tuple(
                    (own, references.get(outer, "?"))
                    for own, outer in entry.references
                    if outer not in tables
                ),
                tuple(replace(tables[outer], name=own) for own, outer in entry.references if outer in tables),
                settled(entry.starts),
                tuple(
                    (own, other if other == "ground" else f"{part.name}.{other}", its)
                    for own, other, its in entry.connections
                    if other
                ),
                part.shared,
                part.groups,
                part.place,
            )
            found += self._with_inner(instance)
        return found

    def _tables(
        self, name: str, entry: _Body, described: Collection[tuple[str, Node]]
    ) -> tuple[TimeTable, ...]:
        nodes = dict(described)
        found = []
        for parameter in entry.component.parameters:
            if not (isinstance(parameter, Reference) and parameter.role == "table"):
                continue
            node = nodes.get(parameter.name)
            text = read_text(node, parameter.name, self.mistakes, hint=f"{parameter.name}: force.csv")
            if node is None:
                hint = f"{parameter.name}: force.csv"
                self.mistakes.add("E201", entry.place, f"{name} has no {parameter.name}", hint=hint)
            elif text is not None:
                assert parameter.unit is not None
                try:
                    table = read_time_table(self.folder / text, parameter.name, parameter.unit, node.place)
                except ApcError as error:
                    self.mistakes.take(error)
                    continue
                self.texts[text] = table.digest
                found.append(table)
        return tuple(found)

    def _shared(self, name: str, component: Component, node: Node | None) -> bool:
        if node is None:
            return False
        if not (isinstance(node, Scalar) and node.plain and isinstance(node.value, bool)):
            got = form(node)
            self.mistakes.add(
                "E203", node.place, "shared", expected="true or false", got=got, hint="shared: true"
            )
            return False
        if node.value and not any(parameter.divided for parameter in component.numbers):
            what = f"{name} can't be shared: nothing of a {component.name} is divided"
            self.mistakes.add("E210", node.place, what)
        return node.value

    def _groups_of(self, name: str, node: Node | None) -> tuple[str, ...]:
        if node is None:
            return tuple(self.groups)
        if not isinstance(node, Sequence):
            got = form(node)
            self.mistakes.add(
                "E203", node.place, "at", expected="a list of groups", got=got, hint="at: [user]"
            )
            return ()
        found = []
        for item in node.items:
            group = read_text(item, "a group", self.mistakes)
            if group in self.groups:
                found.append(group)
            elif group is not None:
                what = f"{name} is at {brief(group)}, which is no group of peers"
                add_unknown("E206", item.place, what, group, list(self.groups), self.mistakes)
        return tuple(found)

    # ---- links, groups, studies ----

    def _link(self, part: Part) -> SceneLink | None:
        body = self.bodies[part.name].body
        values = dict(part.values)
        clock = part.reference("clock")
        roles = {p.role: p.name for p in part.component.parameters if isinstance(p, Reference)}
        graph = COMPLETE
        if "graph" in roles:
            node = body.get(roles["graph"])
            graph = read_graph(node, self.counts, self.folder, self.mistakes, self.texts)
        pairs = read_pairs(body.get(roles["delays"]), self.counts, self.mistakes) if "delays" in roles else []
        delays = []
        for sender, receiver, node in pairs:
            value = self._value(node, f"the delay from {sender} to {receiver}", SECOND, "s")
            if value is not None and value.number < 0:
                self.mistakes.add("E207", value.place, "a delay", expected="0 s or more", got=str(value))
            elif value is not None:
                delays.append(SceneDelay(sender, receiver, value))
        if "clock" not in roles or part.component.parameter("delay") is None:
            what = f"{part.name} is a {part.component.name}, which is no link: it has no clock and delay"
            self.mistakes.add("E210", part.place, what, hint="type: Link")
            return None
        channel = read_channel(
            part.name,
            body,
            {role: body.get(name) for role, name in roles.items()} | {"jitter": body.get("jitter")},
            values.get("jitter"),
            dict(part.options),
            lambda node, what: self._value(node, what, DIMENSIONLESS, "%"),
            self.folder,
            self.mistakes,
            self.texts,
        )
        if clock is None or "delay" not in values:
            return None  # reported where it is
        return SceneLink(part.name, clock, values["delay"], graph, tuple(delays), channel, part.place)

    def _group(self, group: GroupBody, settable: dict[str, list[tuple[str, Settable]]]) -> SceneGroup:
        own = {name: items for name, items in settable.items() if not self._is_of_link(name)}
        settings = read_settings(group, own, self.clocks, self._binding_of, self._is_explained, self.mistakes)
        return SceneGroup(
            group.name, group.count, settings.values, settings.words, settings.columns, group.body.place
        )

    def _binding_of(self, node: Node, what: str, item: Settable) -> Value | None:
        """Read a number for a parameter, or a start value for a variable."""
        words = item.words if isinstance(item, Number) else ()
        names = ("peers", *self.parameters)
        assert not isinstance(item, Option) and item.unit is not None
        unit = item.unit
        binding = read_binding(
            node, what, unit.dimension, unit.text, self._dimension, names, self.mistakes, words=words
        )
        value = self._settled(binding)
        if value is not None and isinstance(item, Number):
            item.bounds.check(value, what, self.mistakes)
        return value


def _settable(parts: Collection[Part]) -> dict[str, list[tuple[str, Settable]]]:
    """Return what a group can set: by the name a person writes, the whole names it stands for.

    The name of an array stands for all its elements.
    """
    found: dict[str, list[tuple[str, Settable]]] = {}
    for part in parts:
        items: list[Settable] = [
            p for p in part.component.parameters if not isinstance(p, Reference) or p.role == "clock"
        ]
        items += [v for v in part.component.variables if v.start is not None]
        for item in items:
            whole = f"{part.name}.{item.name}"
            found.setdefault(whole, []).append((whole, item))
            head, bracket, rest = part.name.partition("[")
            if bracket:
                alias = f"{head}{rest.partition(']')[2]}.{item.name}"
                found.setdefault(alias, []).append((whole, item))
    return found
