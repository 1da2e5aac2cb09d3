"""The entries of parts, in a topology or inside a component, read against the components they are of.

Takes: YAML mappings, the components, and the scope they stand in. Gives: `PartEntry`, `Parts`; `Entry` by
`read_entry`.
Guarantees: every number, word, reference and connection a component asks for is there, or a mistake says so;
what is missing or faulty is reported once.
Does not: know the sections of a topology.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Protocol

from apc.compiler.components.component import RESERVED, Component, Connector, Entry, Number, Option, Reference
from apc.compiler.errors import Mistakes, Place
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import format_expression
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.units import Unit
from apc.compiler.language.values import AlreadyReportedError, Binding, is_quantity, read_binding, text_place
from apc.compiler.language.vectors import entries, sizes_of, whole_and_index, written_out
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import (
    Body,
    among,
    brief,
    fault,
    form,
    list_of,
    mapping_of,
    name_of,
    text_of,
    unknown,
    whole_number,
)
from apc.compiler.words import enumerated

GROUND = "ground"
LARGEST_ARRAY = 500
# Of one peer, those inside parts included: half a minute and 1 GB of compiling.
MOST_PARTS = 1000
# The keys of every part of a topology beside its type.
PART_KEYS = (
    "at",
    "shared",
    "count",
)
# By section, an entry without its name; and a type to show for an entry that has none.
EXAMPLES = {
    "masses": ("device", "{mass: 0.1 kg}", "Mass"),
    "links": ("lan", "{clock: network}", "Mass"),
    "couplers": ("contact", "{type: SampledSpringDamper}", "SampledSpringDamper"),
    "hands": ("hand", "{type: ConstantForce}", "ConstantForce"),
    "parts": ("tip", "{type: Mass}", "Mass"),
}
_FAULTY = MappingNode((), Place(""))  # stands for an entry of a vector whose fault was reported
DEFAULT_TYPES = {"masses": "Mass", "links": "Link"}
_TARGET = re.compile(
    r"(?P<part>[A-Za-z]\w*)(\[(?P<first>\d{1,6})(:(?P<last>\d{1,6}))?\])?(\.(?P<connector>[A-Za-z]\w*))?\Z",
    re.ASCII,
)


class Definitions(Protocol):
    """Where a definition finds the others it names."""

    @property
    def component_names(self) -> tuple[str, ...]:
        """The names of the components that can be asked for."""

    @property
    def names(self) -> tuple[str, ...]:
        """Everything that can be asked for."""

    def component(self, name: str) -> Component | None:
        """Return a component, or None if there is no such name."""

    def connector(self, name: str) -> Connector | None:
        """Return a connector type, or None if there is no such name."""


def component_named(name: str, place: Place, library: Definitions, hint: str) -> Component:
    """Return a component that is named at a place. Raises ApcError where there is none, or its mistakes."""
    component = library.component(name)
    if component is not None:
        return component
    if name in library.names:
        raise fault("E206", place, f"{name} is a connector type, not a component", hint=hint)
    raise unknown("E206", place, f"there is no component {brief(name)}", name, library.component_names)


@dataclass(frozen=True, slots=True)
class PartEntry:
    """A part's entry before it is read; `count` is None for one that is no array."""

    name: str
    section: str
    body: MappingNode
    component: Component
    place: Place
    count: int | None

    @property
    def words(self) -> set[str]:
        """What its keys say in a word."""
        return {value.text for _, value in self.body.entries if isinstance(value, Scalar)}


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts of a topology or component, section by section, before their entries are read.

    `entries` are those of a known component; `faulty` names parts that are there and can't be read, which
    was reported. `taken` are names that nothing may have again, None inside a component.
    """

    library: Definitions
    mistakes: Mistakes
    taken: set[str] | None = None
    entries: dict[str, PartEntry] = field(default_factory=dict)
    faulty: set[str] = field(default_factory=set)

    def read(self, section: str, root: Body) -> None:
        """Collect the parts of a section and their components, so that names can be resolved."""
        name, example, usual = EXAMPLES[section]
        for key, value in root.section(section, f"{{{name}: {example}}}"):
            if key.text not in self.entries:
                self.faulty.add(key.text)  # until it has been read
            with self.mistakes:
                body = mapping_of(value, key.text, f"{key.text}: {example}")
                if self.taken is None:
                    name_of(key, "a part")
                else:
                    name_of(key, f"a part of {section}", self.taken, "this topology", RESERVED)
                component = self._component(section, key, body, usual)
                count = None
                with self.mistakes:
                    count = _count(key.text, section, body)
                self.entries[key.text] = PartEntry(key.text, section, body, component, key.place, count)
                self.faulty.discard(key.text)
                if self.taken is not None:
                    self.taken.add(key.text)

    def _component(self, section: str, key: Scalar, body: MappingNode, usual: str) -> Component:
        """Return the component that an entry is of."""
        node, default = body.get("type"), DEFAULT_TYPES.get(section)
        if node is None and default is None:
            hint = f"type: {usual if section == 'parts' else self._example(section, body, usual)}"
            raise fault("E201", key.place, f"{key.text} has no type", hint=hint)
        hint = f"type: {usual}"
        name = text_of(node, "type", hint) if node is not None else default or ""
        return component_named(name, key.place if node is None else node.place, self.library, hint)

    def _example(self, section: str, body: MappingNode, usual: str) -> str:
        """Return a type to propose for an entry without one: with its keys, and as few others as can be."""
        keys = {*body.keys()} - {*PART_KEYS}
        fitting = []
        for name in dict.fromkeys((usual, *self.library.component_names)):
            component = None
            with Mistakes():  # which are reported where it is asked for
                component = self.library.component(name)
            if component is None:
                continue
            connectors = {connector for connector, _ in component.connectors}
            known = connectors | {one.name for one in (*component.parameters, *component.variables)}
            if known >= keys and (section != "hands" or connectors == {"flange"}):
                fitting.append((name != usual, len(known), name))
        return min(fitting)[-1] if fitting else usual


def _count(name: str, section: str, body: MappingNode) -> int | None:
    """Return how many of a part there are; None for one that is no array, as a link never is."""
    if (node := body.get("count")) is None:
        return None
    count = whole_number(node)
    if section != "links" and count is not None and 1 <= count <= LARGEST_ARRAY:
        return count
    link = section == "links"
    expected = "no count, as a link is one" if link else f"a whole number from 1 to {LARGEST_ARRAY}"
    raise fault("E208", node.place, f"the count of {name}", expected, form(node))


@dataclass(frozen=True, slots=True)
class Scope:
    """What an entry can refer to.

    `dimension` and `names` are the names an expression may use; `references` gives the names of a role, for
    a word, or raises what is wrong with the section that would hold them; `parts` are the parts that can be
    joined; `whole` is what the entry stands in, in words; `complete` is False when a whole section of parts
    is missing or faulty and was reported; `outer` is the component around it, if there is one.
    """

    dimension: Callable[[tuple[str, ...]], Dimension | None]
    names: Collection[str]
    references: Callable[[str, str], Collection[str]]
    parts: Parts
    whole: str
    complete: bool = True
    outer: Component | None = None


def read_entry(entry: PartEntry, scope: Scope, mistakes: Mistakes, index: int = 1) -> Entry:
    """Read the entry of a part.

    Parameters
    ----------
    entry
        The entry, and what it is of.
    scope
        What it can refer to.
    mistakes
        Where faults go.
    index
        Which element of an array this is.
    """
    component, outer = entry.component, scope.outer
    units = {p.name: p.unit for p in component.numbers}
    units |= {v.name: v.unit for v in component.variables if v.start is not None}
    named = (whole_and_index(name)[0] for name in (*(p.name for p in component.parameters), *units))
    common = [*PART_KEYS] if outer is None else ["count"]
    keys = dict.fromkeys(("type", *common, *dict(component.connectors), *named))
    body = Body(entry.body, keys, f"{entry.name} ({component.name})", mistakes)
    reader = _EntryReader(entry, body.nodes, scope, mistakes, index, units)
    reader.write_vectors_out()
    found = reader.read()
    targets = [(part, its) for _, part, its in found.connections if part != GROUND]
    if len(targets) > 1 and len(set(targets)) == 1:
        mistakes.add("E210", entry.place, f"{entry.name} joins {targets[0][0]} to itself")
    return found


@dataclass(frozen=True, slots=True)
class _EntryReader:
    """Reads one entry, value by value; what is missing or at fault is reported and left out.

    `units` are those of the numbers, and entries of vectors, that it may give; `missing` is what is due and
    left out, and what to write.
    """

    entry: PartEntry
    nodes: dict[str, Node]
    scope: Scope
    mistakes: Mistakes
    index: int
    units: Mapping[str, Unit]
    missing: dict[str, str] = field(default_factory=dict)

    def write_vectors_out(self) -> None:
        """Give each entry of a vector a key, `x[1]`, in the place of `x: [1 m, 0 m]`."""
        for (name,), size in sizes_of((unit,) for unit in self.units).items():
            if (node := self.nodes.get(name)) is None:
                continue
            values: tuple[Node, ...] = (_FAULTY,) * size
            with self.mistakes:
                values = self._vector(node, name, size)
            self.nodes.update(zip(entries(name, size), values, strict=True))

    def _vector(self, node: Node, name: str, size: int) -> tuple[Node, ...]:
        """Return a node for each entry of a vector, which inside a component may be an expression."""
        if isinstance(node, Scalar) and self.scope.outer is not None and not is_quantity(node.text):
            place = text_place(node)
            sizes = sizes_of(tuple(known.split(".")) for known in self.scope.names)
            tree = parse_expression(node.text, place)
            found = written_out(tree, lambda parts: sizes.get(parts, 0), node.text, place)
            if found is not None and len(found) == size:
                return tuple(replace(node, text=format_expression(one)) for one in found)
        return list_of(node, name, size, _one(self.units[f"{name}[1]"]))

    def read(self) -> Entry:
        """Read the component's parameters, start values and connectors, each by what it is."""
        component = self.entry.component
        values, options, references, described, starts, connections = [], [], [], [], [], []
        for parameter in component.parameters:
            name, node = parameter.name, self.nodes.get(parameter.name)
            with self.mistakes:
                if isinstance(parameter, Number):
                    if (value := self._number(parameter, node)) is not None:
                        values.append((name, value))
                elif isinstance(parameter, Option):
                    if (word := self._option(parameter, node)) is not None:
                        options.append((name, word))
                elif self._is_named(parameter):
                    if (word := self._reference(parameter, node)) is not None:
                        references.append((name, word))
                elif node is not None:
                    described.append((name, node))
        if self.missing:
            hint = ", ".join(f"{key}: {value}" for key, value in self.missing.items())
            what = f"{self.entry.name} has no {enumerated(tuple(self.missing))}"
            self.mistakes.add("E201", self.entry.place, what, hint=hint)
        for variable in component.variables:
            node = self.nodes.get(variable.name) if variable.start is not None else None
            start = self._binding(variable.name, node, variable.unit)
            if start is not None:
                starts.append((variable.name, start))
        for name, kind in component.connectors:
            with self.mistakes:
                if (joined := self._connection(name, kind.name)) is not None:
                    connections.append((name, *joined))
        found = values, options, references, described, starts, connections
        return Entry(*map(tuple, found))  # type: ignore[arg-type] # each is of its own pairs

    def _is_named(self, parameter: Reference) -> bool:
        """Return whether a parameter names something; inside a component, a table is one of the outer's."""
        handed_on = parameter.role == "table" and self.scope.outer is not None
        return parameter.role in ("clock", "link") or handed_on

    def _binding(
        self, key: str, node: Node | None, unit: Unit, words: Collection[tuple[str, Fraction]] = ()
    ) -> Binding | None:
        if node is not None and node is not _FAULTY:
            known, names = self.scope.dimension, self.scope.names
            with self.mistakes:
                return read_binding(node, key, unit.dimension, unit.text, known, names, words)
        return None

    def _number(self, parameter: Number, node: Node | None) -> Binding | None:
        if node is None and parameter.default is not None:
            return Binding(parameter.default, None, parameter.unit.dimension, self.entry.place)
        if node is None:
            whole, index = whole_and_index(parameter.name)
            size = sum(whole_and_index(name)[0] == whole for name in self.units)
            item = _one(parameter.unit)
            self.missing[whole] = f"[{', '.join([item] * size)}]" if index else item
        return self._binding(parameter.name, node, parameter.unit, parameter.words)

    def _option(self, parameter: Option, node: Node | None) -> str | None:
        first, default = parameter.words[0], parameter.default
        if node is None:
            if default is None:
                self.missing[parameter.name] = first
            return default
        word = text_of(node, parameter.name, f"{parameter.name}: {first}")
        if word in parameter.words:
            return word
        hint = f"{parameter.name}: {default or first}"
        raise fault("E206", node.place, parameter.name, " or ".join(parameter.words), brief(word), hint)

    def _reference(self, parameter: Reference, node: Node | None) -> str | None:
        role, within = parameter.role, self.scope.outer
        if node is None:
            known: Collection[str] = ()
            with self.mistakes:
                known = self.scope.references(role, "")
            self.missing[parameter.name] = next(iter(known), "name")
            return None
        word = text_of(node, parameter.name)
        outer = None if within is None else within.parameter(word)
        if isinstance(outer, Reference) and parameter.unit is not None and outer.unit is not None:
            # A table handed on to a part inside: only here do the two units meet.
            if outer.unit.dimension != parameter.unit.dimension:
                raise fault("E204", node.place, parameter.name, parameter.unit.text, outer.unit.text)
            return word
        known = self.scope.references(role, word)
        missing = f"isn't in {role}s" if within is None else f"is no {role} of {within.name}"
        return among(word, known, node.place, f"{self.entry.name} names {role} {{}}, which {missing}")

    def _connection(self, connector: str, kind: str) -> tuple[str, str] | None:
        """Return the part and the connector of it that a connector is joined to."""
        node, name, outer = self.nodes.get(connector), self.entry.name, self.scope.outer
        parts = self.scope.parts.entries
        if node is None:
            # A mass need not be joined, nor what another entry is joined to.
            if self.entry.section in ("masses", "parts") or any(
                f"{name}.{connector}" in other.words for other in parts.values()
            ):
                return None
            free = (part for part in parts.values() if part.name not in {name, *self.entry.words})
            fitting = (part.name for part in free if kind in _kinds(part.component).values())
            what = f"{name} does not say what its {connector} is joined to"
            raise fault("E210", self.entry.place, what, hint=f"{connector}: {next(fitting, GROUND)}")
        text = text_of(node, connector, f"{connector}: device")
        if text == GROUND:
            return GROUND, ""
        found = _TARGET.match(text)
        if found is None:
            expected = "a part, such as device, device.flange or chain[2]"
            raise fault("E210", node.place, connector, expected, brief(text))
        if outer is not None and text in dict(outer.connectors):
            return "", text
        other = found["part"]
        if other in self.scope.parts.faulty or (other not in parts and not self.scope.complete):
            raise AlreadyReportedError
        if other not in parts:
            what = f"{name} joins its {connector} to {brief(other)}, which is no part of {self.scope.whole}"
            raise unknown("E206", node.place, what, other, [*(one for one in parts if one != name), GROUND])
        element = self._element(found, parts[other].count, connector, node)
        return element, self._its_connector(parts[other], found["connector"], connector, kind, node)

    def _element(self, found: re.Match[str], size: int | None, connector: str, node: Node) -> str:
        """Return the part, or the element of an array of `size`, that this element is joined to."""
        other, count = str(found["part"]), self.entry.count
        if size is None:
            if found["first"] is not None:
                what = f"{other} is one part, not an array"
                raise fault("E210", node.place, what, hint=f"{connector}: {other}")
            return other
        first = int(found["first"] or 1)
        last = int(found["last"] or found["first"] or size)
        if not 1 <= first <= last <= size:
            what = f"{other} is an array of {size}: its elements are {other}[1] to {other}[{size}]"
            raise fault("E210", node.place, what)
        if first == last and found["first"]:
            return f"{other}[{first}]"
        if count != last - first + 1:
            mine = "one part" if count is None else f"an array of {count}"
            what = f"{self.entry.name} is {mine} and {other}[{first}:{last}] has {last - first + 1} elements"
            raise fault("E210", node.place, what, hint=f'{connector}: "{other}[1]"')
        return f"{other}[{first + self.index - 1}]"

    def _its_connector(
        self, part: PartEntry, named: str | None, connector: str, kind: str, node: Node
    ) -> str:
        """Return the connector of another part that is named, or meant where none is."""
        shown, hand = f"{part.name} ({part.component.name})", self.entry.section == "hands"
        fitting = [name for name, its in _kinds(part.component).items() if its == kind]
        meant = [name for name in fitting if (name in part.component.grips) == hand] or fitting
        if named is not None:
            return among(named, fitting, node.place, f"{shown} has no {kind} called {{}}")
        if len(meant) == 1:
            return meant[0]
        if fitting:
            what = f"{shown} has {len(fitting)} connectors of type {kind}"
            raise fault("E210", node.place, what, hint=f"{connector}: {part.name}.{fitting[0]}")
        what = f"{shown} has no connector of type {kind} to join {connector} to"
        raise fault("E210", node.place, what)


def _kinds(component: Component) -> dict[str, str]:
    """Return the connectors of a component and the type of each."""
    return {name: kind.name for name, kind in component.connectors}


def _one(unit: Unit) -> str:
    """Return a number in a unit, to show in a message."""
    return f"1 {unit.text}".removesuffix(" 1")
