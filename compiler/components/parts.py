"""The entries of parts, in a topology or inside a component, checked against their components.

Takes: YAML mappings, the components, and the enclosing scope. Gives: `PartEntry`, `PartEntries`,
`EntryScope`; `read_entry`, the `PartBindings` of an entry; `Definitions`, `component_named`.
Guarantees: every number, word, reference and connection required by a component exists, or an error reports
it, once.
Does not: handle the sections of a topology.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Protocol, TypeVar

from apc.compiler.components.component import (
    RESERVED,
    Component,
    ComponentVariable,
    Connector,
    Named,
    NumberParameter,
    Option,
    Parameter,
    PartBindings,
    Reference,
    Settable,
)
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import format_expression
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.units import Unit
from apc.compiler.language.values import (
    AlreadyReportedError,
    ValueBinding,
    is_quantity,
    read_binding,
    text_location,
)
from apc.compiler.language.vectors import by_vector, sizes_of, whole_and_index, written_out
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import (
    MappingReader,
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
from apc.compiler.wording import enumerated

T = TypeVar("T")
Item = TypeVar("Item", bound=Settable)

GROUND = "ground"
LARGEST_ARRAY = 500
# Of one peer, those inside parts included: half a minute and 1 GB of compiling.
MOST_PARTS = 1000
# The keys of every part of a topology in addition to its type.
PART_KEYS = (
    "at",
    "shared",
    "count",
)
# By section, an entry without its name; and a type to show for an entry that has none.
EXAMPLES = {
    "masses": ("device", "{mass: 0.1 kg}", "Mass"),
    "links": ("lan", "{clock: network}", "Link"),
    "couplers": ("contact", "{type: SampledSpringDamper}", "SampledSpringDamper"),
    "hands": ("hand", "{type: ConstantForce}", "ConstantForce"),
    "parts": ("tip", "{type: Mass}", "Mass"),
}
_FAULTY = MappingNode((), SourceLocation(""))  # placeholder for an entry of a vector whose error was reported
DEFAULT_TYPES = {"masses": "Mass", "links": "Link"}
# A part, the first and last elements of an array, a connector.
_TARGET = re.compile(
    r"([A-Za-z]\w*)(?:\[(\d{1,6})(?::(\d{1,6}))?\])?(?:\.([A-Za-z]\w*))?\Z",
    re.ASCII,
)


class Definitions(Protocol):
    """The lookup of other definitions by name."""

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


def component_named(name: str, location: SourceLocation, library: Definitions, hint: str) -> Component:
    """Return a component that is named at a place. Raises ApcError where there is none, or its mistakes."""
    component = library.component(name)
    if component is not None:
        return component
    if name in library.names:
        raise fault("E206", location, f"{name} is a connector type, not a component", hint=hint)
    raise unknown("E206", location, f"there is no component {brief(name)}", name, library.component_names)


@dataclass(frozen=True, slots=True)
class PartEntry:
    """A part's entry before it is read; `count` is None for one that is no array."""

    name: str
    section: str
    body: MappingNode
    component: Component
    location: SourceLocation
    count: int | None

    @property
    def words(self) -> set[str]:
        """The meaning of its keys in one word."""
        return {value.text for _, value in self.body.entries if isinstance(value, Scalar)}

    def connectors(self, kind: str) -> list[str]:
        """Return its connectors of a type."""
        return [name for name, connector_type in self.component.connectors if connector_type.name == kind]


@dataclass(frozen=True, slots=True)
class PartEntries:
    """The parts of a topology or component, section by section, before their entries are read.

    `entries` are those of a known component; `faulty` names parts that are there and can't be read, which
    was reported. `used` are names that nothing may have again, None inside a component.
    """

    library: Definitions
    mistakes: Mistakes
    used: set[str] | None = None
    entries: dict[str, PartEntry] = field(default_factory=dict)
    faulty: set[str] = field(default_factory=set)

    def read(self, section: str, root: MappingReader) -> None:
        """Collect the parts of a section and their components, so that names can be resolved."""
        name, example, _ = EXAMPLES[section]
        subject, words = ("a part", ()) if self.used is None else (f"a part of {section}", RESERVED)
        for key, value in root.section(section, f"{{{name}: {example}}}"):
            if key.text not in self.entries:
                self.faulty.add(key.text)  # until it has been read
            with self.mistakes:
                body = mapping_of(value, key.text, f"{key.text}: {example}")
                name_of(key, subject, self.used or (), "this topology", words)
                component = self._component(section, key, body)
                count = None
                with self.mistakes:
                    count = _count(key.text, section, body)
                self.entries[key.text] = PartEntry(key.text, section, body, component, key.location, count)
                self.faulty.discard(key.text)
                if self.used is not None:
                    self.used.add(key.text)

    def _component(self, section: str, key: Scalar, body: MappingNode) -> Component:
        """Return the component that an entry is of."""
        node, name, typical = body.get("type"), DEFAULT_TYPES.get(section), EXAMPLES[section][-1]
        hint = f"type: {typical}"
        if node is not None:
            name = text_of(node, "type", hint)
        if name is None:
            hint = hint if section == "parts" else f"type: {self._example(section, body, typical)}"
            raise fault("E201", key.location, f"{key.text} has no type", hint=hint)
        return component_named(name, (node or key).location, self.library, hint)

    def _example(self, section: str, body: MappingNode, typical: str) -> str:
        """Return a type to propose for an entry without one: with its keys, and as few others as can be."""
        keys, fitting = {*body.keys()} - {*PART_KEYS}, []
        for name in self.library.component_names:
            with Mistakes():  # which are reported where it is asked for
                if (component := self.library.component(name)) is not None:
                    connectors = {connector for connector, _ in component.connectors}
                    known = connectors | {item.name for item in (*component.parameters, *component.variables)}
                    if known >= keys and (section != "hands" or connectors == {"flange"}):
                        fitting.append((name != typical, len(known), name))
        return min(fitting, default=(True, 0, typical))[-1]


def _count(name: str, section: str, body: MappingNode) -> int | None:
    """Return the number of elements of an array of parts; None for a single part and for a link."""
    if (node := body.get("count")) is None:
        return None
    count, link = whole_number(node), section == "links"
    if not link and count in range(1, LARGEST_ARRAY + 1):
        return count
    expected = "no count, as a link is one" if link else f"a whole number from 1 to {LARGEST_ARRAY}"
    raise fault("E208", node.location, f"the count of {name}", expected, form(node))


@dataclass(frozen=True, slots=True)
class EntryScope:
    """The names that an entry can refer to.

    `dimension` and `names` are the names an expression may use; `references` returns the names of a role, for
    a word, or raises the error of their section; `parts` are the connectable parts; `whole` is the context of
    the entry, in words; `complete` is False when a whole section of parts is missing or faulty and was
    reported; `outer` is the component around it, if there is one.
    """

    dimension: Callable[[tuple[str, ...]], Dimension | None]
    names: Collection[str]
    references: Callable[[str, str], Collection[str]]
    parts: PartEntries
    whole: str
    complete: bool = True
    outer: Component | None = None


def read_entry(entry: PartEntry, scope: EntryScope, mistakes: Mistakes, index: int = 1) -> PartBindings:
    """Read the entry of a part.

    Parameters
    ----------
    entry
        The entry in the topology, with its component.
    scope
        The names that it can refer to.
    mistakes
        The collector of errors.
    index
        The index of the element in its array.
    """
    component, within = entry.component, scope.outer
    # What names something; inside a component, a table is one of the outer's.
    naming = ("clock", "link") if within is None else ("clock", "link", "table")
    starts = [variable for variable in component.variables if variable.start is not None]
    named = (whole_and_index(item.name)[0] for item in (*component.parameters, *starts))
    common = PART_KEYS if within is None else ("count",)
    keys = dict.fromkeys(("type", *common, *dict(component.connectors), *named))
    nodes = MappingReader(entry.body, keys, f"{entry.name} ({component.name})", mistakes).nodes
    numbers: tuple[NumberParameter | ComponentVariable, ...] = (*component.numbers, *starts)
    for name, vector in by_vector(numbers).items():
        if len(vector) > 1 and name in nodes:  # a key for each entry, x[1], instead of x: [1 m, 0 m]
            values: tuple[Node, ...] = (_FAULTY,) * len(vector)
            with mistakes:
                values = _vector(nodes[name], name, vector, scope)
            nodes.update(zip((item.name for item in vector), values, strict=True))

    def due(parameter: Parameter) -> str:
        """Return the suggested text for a required parameter; empty for an optional one."""
        if isinstance(parameter, Reference):
            texts = scope.references(parameter.role, "") if parameter.role in naming else [""]
            return next(iter(texts), "name")
        if parameter.default is not None:
            return ""
        return parameter.words[0] if isinstance(parameter, Option) else _single(parameter.unit)

    def number(item: NumberParameter | ComponentVariable) -> ValueBinding | None:
        """Return a parameter's number, the default of one that isn't given, or a variable's start value."""
        node, unit, words = nodes.get(item.name), item.unit, Named[Fraction]()
        if isinstance(item, NumberParameter):
            words = item.words
            if node is None and item.default is not None:
                return ValueBinding(item.default, None, unit.dimension, entry.location, unit.text)
        if node is None or node is _FAULTY:
            return None
        message, pair = (item.name, unit.dimension, unit.text), (scope.dimension, scope.names)
        return read_binding(node, *message, *pair, words)

    def option(item: Option) -> str | None:
        name, words, node = item.name, item.words, nodes.get(item.name)
        if node is None:
            return item.default
        word = text_of(node, name, f"{name}: {words[0]}")
        if word in words:
            return word
        hint = f"{name}: {item.default or words[0]}"
        raise fault("E206", node.location, name, " or ".join(words), brief(word), hint)

    def reference(item: Reference) -> str | None:
        name, role, node = item.name, item.role, nodes.get(item.name)
        if node is None or role not in naming:
            return None
        word = text_of(node, name)
        outer = None if within is None else within.parameter(word)
        if isinstance(outer, Reference) and item.unit is not None and outer.unit is not None:
            # A table handed on to a part inside: only here do the two units meet.
            if outer.unit.dimension != item.unit.dimension:
                raise fault("E204", node.location, name, item.unit.text, outer.unit.text)
            return word
        missing = f"isn't in {role}s" if within is None else f"is no {role} of {within.name}"
        message = f"{entry.name} names {role} {{}}, which {missing}"
        return among(word, scope.references(role, word), node.location, message)

    def each(items: Iterable[Item], read: Callable[[Item], T | None]) -> Named[T]:
        """Return the results of reading items by name, invalid ones omitted."""
        pairs = []
        for item in items:
            with mistakes:
                if (value := read(item)) is not None:
                    pairs.append((item.name, value))
        return tuple(pairs)

    missing = dict[str, str]()
    for name, parameters in by_vector(component.parameters).items():
        requested = [due(parameter) for parameter in parameters if parameter.name not in nodes]
        if any(requested):
            missing[name] = requested[0] if len(requested) == 1 else f"[{', '.join(requested)}]"
    if missing:
        hint = ", ".join(f"{key}: {value}" for key, value in missing.items())
        message = f"{entry.name} has no {enumerated(tuple(missing))}"
        mistakes.add("E201", entry.location, message, hint=hint)
    references = [parameter for parameter in component.parameters if isinstance(parameter, Reference)]
    described = (reference.name for reference in references if reference.role not in naming)
    connections = []
    for name, kind in component.connectors:
        with mistakes:
            if joined := _joined(name, kind.name, nodes.get(name), entry, scope, index):
                connections.append((name, *joined))
    targets = [(part, connector_type) for _, part, connector_type in connections if part != GROUND]
    if len(targets) > 1 and len(set(targets)) == 1:
        mistakes.add("E210", entry.location, f"{entry.name} joins {targets[0][0]} to itself")
    return PartBindings(
        each(component.numbers, number),
        each((parameter for parameter in component.parameters if isinstance(parameter, Option)), option),
        each(references, reference),
        tuple((name, nodes[name]) for name in described if name in nodes),
        each(starts, number),
        tuple(connections),
    )


def _vector(
    node: Node, name: str, vector: Sequence[NumberParameter | ComponentVariable], scope: EntryScope
) -> tuple[Node, ...]:
    """Return a node for each entry of a vector, which inside a component may be an expression."""
    if isinstance(node, Scalar) and scope.outer is not None and not is_quantity(node.text):
        location = text_location(node)
        sizes = sizes_of(tuple(name.split(".")) for name in scope.names)
        tree = parse_expression(node.text, location)
        result = written_out(tree, lambda parts: sizes.get(parts, 0), node.text, location)
        if result is not None and len(result) == len(vector):
            return tuple(replace(node, text=format_expression(item)) for item in result)
    return list_of(node, name, len(vector), _single(vector[0].unit))


def _joined(
    connector: str, kind: str, node: Node | None, entry: PartEntry, scope: EntryScope, index: int
) -> tuple[str, str] | None:
    """Return the part and the connector of it that a connector, of a type, of an entry is joined to."""
    name, outer, parts = entry.name, scope.outer, scope.parts.entries
    if node is None:
        # A mass need not be joined, nor what another entry is joined to.
        if entry.section in ("masses", "parts") or any(
            f"{name}.{connector}" in other.words for other in parts.values()
        ):
            return None
        free = (part for part in parts.values() if part.name not in {name, *entry.words})
        fitting = (part.name for part in free if part.connectors(kind))
        message = f"{name} does not say what its {connector} is joined to"
        hint = f"{connector}: {next(fitting, GROUND)}"
        for item in parts.values():  # who joins the part without saying which of its connectors is meant
            for key, value in item.body.entries:
                if isinstance(value, Scalar) and value.text == name and key.text in item.connectors(kind):
                    hint = f"{item.name}: {{{key.text}: {name}.{connector}}}"
        raise fault("E210", entry.location, message, hint=hint)
    text = text_of(node, connector, f"{connector}: device")
    if text == GROUND:
        return GROUND, ""
    if outer is not None and text in dict(outer.connectors):
        return "", text
    if (result := _TARGET.match(text)) is None:
        expected = "a part, such as device, device.flange or chain[2]"
        raise fault("E210", node.location, connector, expected, brief(text))
    other, first, last, named = result.groups()
    part = parts.get(other)
    if other in scope.parts.faulty or (part is None and not scope.complete):
        raise AlreadyReportedError
    if part is None:
        message = f"{name} joins its {connector} to {brief(other)}, which is no part of {scope.whole}"
        raise unknown(
            "E206", node.location, message, other, [*(part for part in parts if part != name), GROUND]
        )
    element = _element(part, first, last, entry, index, connector, node.location)
    return element, _matching_connector(part, named, connector, kind, entry.section == "hands", node.location)


def _element(
    part: PartEntry,
    first: str | None,
    last: str | None,
    entry: PartEntry,
    index: int,
    connector: str,
    at: SourceLocation,
) -> str:
    """Return the part that an entry is joined to; of an array from `first` to `last`, the element."""
    other, size, message, hint = part.name, part.count, "", ""
    if size is None and first is None:
        return other
    low, high = int(first or 1), int(last or first or size or 0)
    if size is None:
        message, hint = f"{other} is one part, not an array", f"{connector}: {other}"
    elif not 1 <= low <= high <= size:
        message = f"{other} is an array of {size}: its elements are {other}[1] to {other}[{size}]"
    elif low == high and first:
        return f"{other}[{low}]"
    elif entry.count == high - low + 1:
        return f"{other}[{low + index - 1}]"
    else:
        mine = "one part" if entry.count is None else f"an array of {entry.count}"
        message = f"{entry.name} is {mine} and {other}[{low}:{high}] has {high - low + 1} elements"
        hint = f'{connector}: "{other}[1]"'
    raise fault("E210", at, message, hint=hint)


def _matching_connector(
    part: PartEntry, named: str | None, connector: str, kind: str, by_hand: bool, at: SourceLocation
) -> str:
    """Return the connector of another part that is named, or meant where none is."""
    shown, fitting = f"{part.name} ({part.component.name})", part.connectors(kind)
    meant = [name for name in fitting if (name in part.component.grips) == by_hand] or fitting
    if named is not None:
        return among(named, fitting, at, f"{shown} has no {kind} called {{}}")
    if len(meant) == 1:
        return meant[0]
    message, hint = f"{shown} has no connector of type {kind} to join {connector} to", ""
    if fitting:
        message = f"{shown} has {len(fitting)} connectors of type {kind}"
        hint = f"{connector}: {part.name}.{fitting[0]}"
    raise fault("E210", at, message, hint=hint)


def _single(unit: Unit) -> str:
    """Return a number in a unit, to show in a message."""
    return f"1 {unit.text}".removesuffix(" 1")
