"""The entries of parts, in a topology or inside a component, checked against their components.

Takes: YAML mappings, the components, and the enclosing scope. Gives: `PartEntry`, `PartEntries`,
`EntryScope`; `read_entry`, the `PartBindings` of an entry; `read_option`, `read_reference`; `Definitions`,
`component_named`, `joining_of`.
Guarantees: every number, option, reference and connection required by a component exists, or one error
reports that it is missing.
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
from apc.compiler.errors import Mistakes, SourceLocation, location_in, nearest
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import Call, format_expression, walk
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
    IDENTIFIER,
    MappingReader,
    brief,
    fault,
    first_use,
    form,
    list_of,
    mapping_of,
    name_of,
    named,
    quoted,
    text_of,
    unknown,
    value_of,
    whole_number,
)
from apc.compiler.wording import enumerated

T = TypeVar("T")
Item = TypeVar("Item", bound=Settable)

GROUND = "ground"
LARGEST_ARRAY = 500
# Parts of one peer with inner parts: compiling this number takes half a minute and 1 GB.
MOST_PARTS = 1000
# The keys of every part of a topology in addition to its type.
PART_KEYS = (
    "at",
    "shared",
    "joining",
    "count",
)
JOINING = ("mean", "start")  # the values of a part at a joining peer
# By section: the name of an example part, its entry, and the type proposed for an entry without a type.
EXAMPLES = {
    "masses": ("device", "{mass: 0.1 kg}", "Mass"),
    "links": ("lan", "{clock: network}", "Link"),
    "couplers": ("contact", "{type: SampledSpringDamper}", "SampledSpringDamper"),
    "hands": ("hand", "{type: ConstantForce}", "ConstantForce"),
    "parts": ("tip", "{type: Mass}", "Mass"),
}
# What a part of a section is called in messages.
KINDS = {"masses": "a mass", "links": "a link", "couplers": "a coupler", "hands": "a hand", "parts": "a part"}
MOST_CHOICES = 12  # names that a message lists
SHORTEST_WORD = 4  # letters of a word that is searched in the names of components
# Other words for an option, as of a distribution.
_SYNONYMS = {"gauss": "normal", "gaussian": "normal"}
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
        """The names of all components."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all components and connector types."""

    def component(self, name: str) -> Component | None:
        """Return the component of a name, or None if there is none."""

    def connector(self, name: str) -> Connector | None:
        """Return the connector type of a name, or None if there is none."""


def component_named(
    name: str, location: SourceLocation, library: Definitions, fix: str, keys: Collection[str] = ()
) -> Component:
    """Return the component of a name that is written at `location`.

    Parameters
    ----------
    name, location
        The name, and its location.
    library
        The components.
    fix
        The fix for the name of a connector type.
    keys
        The keys of the entry: a component with all of them is proposed first.

    Raises
    ------
    ApcError
        E206 there is no such component, or with the mistakes of its definition.
    """
    component = library.component(name)
    if component is not None:
        return component
    if name in library.names:
        raise fault("E206", location, f"{name} is a connector type, not a component", fix=fix)
    message, names = f"unknown component {named(name)}", library.component_names
    fitting = _with_keys(library, {*keys}) if keys else {}
    complete = [name for name, component in fitting.items() if _required(component) <= {*keys}]
    for known in (complete, fitting, names):
        if close := _name_with_word(name, known) or nearest(name, known):
            raise unknown("E206", location, message, close, [close])
    raise unknown("E206", location, message, name, names)


def _name_with_word(word: str, names: Collection[str]) -> str:
    """Return the shortest name that starts with a word, or else contains it, in any case of the letters.

    The result is empty if there is none: `average` is a word of AveragePosition.
    """
    word = word.lower()
    starting, containing = (
        [name for name in names if word in name.lower()[: len(word) if at_start else None]]
        for at_start in (True, False)
    )
    return min(starting or containing, key=len, default="") if len(word) >= SHORTEST_WORD else ""


def _keys(component: Component) -> set[str]:
    """Return the keys of an entry that are defined by its component."""
    items = (*component.parameters, *component.variables)
    return {whole_and_index(item.name)[0] for item in items} | {*dict(component.connectors)}


def _required(component: Component) -> set[str]:
    """Return the names of the numbers and options of a component that have no default."""
    items = (item for item in component.parameters if isinstance(item, NumberParameter | Option))
    return {whole_and_index(item.name)[0] for item in items if item.default is None}


def _with_keys(library: Definitions, keys: set[str]) -> dict[str, Component]:
    """Return the components of a library whose entries can have some keys, by name."""
    result = {}
    for name in library.component_names:
        with Mistakes():  # errors of a definition are reported when an entry uses it
            component = library.component(name)
            if component is not None and keys <= _keys(component):
                result[name] = component
    return result


@dataclass(frozen=True, slots=True)
class PartEntry:
    """A part's entry before it is read; `count` is None for a part that is no array."""

    name: str
    section: str
    body: MappingNode
    component: Component
    location: SourceLocation
    count: int | None

    @property
    def words(self) -> set[str]:
        """The values of the entry that are texts."""
        return {value.text for _, value in self.body.entries if isinstance(value, Scalar)}

    @property
    def is_shared(self) -> bool:
        """Whether the entry is that of a shared object."""
        shared = self.body.get("shared")
        return isinstance(shared, Scalar) and shared.value is True

    def connectors(self, kind: str) -> list[str]:
        """Return the names of the connectors of a type."""
        return [name for name, connector_type in self.component.connectors if connector_type.name == kind]


@dataclass(frozen=True, slots=True)
class PartEntries:
    """The parts of a topology or component, section by section, before their entries are read.

    `entries` are the parts with a valid component; `faulty` the names of parts with an error that was
    reported. `used` has the names that are already used, with their `use`; it is None inside a component.
    """

    library: Definitions
    mistakes: Mistakes
    used: dict[str, str] | None = None
    entries: dict[str, PartEntry] = field(default_factory=dict)
    faulty: set[str] = field(default_factory=set)

    def read(self, section: str, root: MappingReader) -> None:
        """Add the parts of a section, with their components, to `entries`."""
        name, example, _ = EXAMPLES[section]
        subject, words = ("a part", ()) if self.used is None else (f"a part of {section}", RESERVED)
        for key, value in root.section(section, f"{{{name}: {example}}}"):
            if key.text not in self.entries:
                self.faulty.add(key.text)  # removed once the entry is valid
            with self.mistakes:
                body = mapping_of(value, key.text, f"{key.text}: {example}")
                name_of(key, subject, self.used, words)
                component = self._component(section, key, body)
                count = None
                with self.mistakes:
                    count = _count(key.text, section, body)
                self.entries[key.text] = PartEntry(key.text, section, body, component, key.location, count)
                self.faulty.discard(key.text)
                if self.used is not None:
                    self.used[key.text] = first_use(KINDS[section], key.location)

    def _component(self, section: str, key: Scalar, body: MappingNode) -> Component:
        """Return the component of an entry. Raises ApcError for a missing or unknown type."""
        node, name, typical = body.get("type"), DEFAULT_TYPES.get(section), EXAMPLES[section][-1]
        fix = f"type: {typical}"
        if node is not None:
            name = text_of(node, "type", fix)
        if name is None:
            fix = fix if section == "parts" else f"type: {self._example(section, body, typical)}"
            raise fault("E201", key.location, f"{key.text} has no type", fix=fix)
        keys = {*body.keys()} - {*PART_KEYS, "type"}
        return component_named(name, (node or key).location, self.library, fix, keys)

    def _example(self, section: str, body: MappingNode, typical: str) -> str:
        """Return the component type to propose for an entry without a type.

        The type has all keys of the entry, and as few others as possible; `typical` is the section's most
        common type.
        """
        candidates = [
            (name != typical, len(_keys(component)), name)
            for name, component in _with_keys(self.library, {*body.keys()} - {*PART_KEYS}).items()
            if section != "hands" or {*dict(component.connectors)} == {"flange"}
        ]
        return min(candidates, default=(True, 0, typical))[-1]

    def missing_masses(self) -> str:
        """Return the text of a section `masses` with the parts that entries are connected to and that are
        missing; of one mass if there is none.
        """
        shared = {
            node.text: entry.component.receives_from_others
            for entry in self.entries.values()
            for name, _ in entry.component.connectors
            if isinstance(node := entry.body.get(name), Scalar) and IDENTIFIER.match(node.text)
        }
        missing = [name for name in shared if name not in {GROUND, *self.entries, *self.faulty}]
        texts = {
            name: "{mass: 0.1 kg, shared: true}" if shared[name] else "{mass: 0.1 kg}" for name in missing
        }
        name, example, _ = EXAMPLES["masses"]
        return f"{{{', '.join(f'{name}: {text}' for name, text in (texts or {name: example}).items())}}}"


def _count(name: str, section: str, body: MappingNode) -> int | None:
    """Return the number of elements of an array of parts; None for a single part and for a link."""
    if (node := body.get("count")) is None:
        return None
    count, link = whole_number(node), section == "links"
    if not link and count in range(1, LARGEST_ARRAY + 1):
        return count
    expected = "none, as a link can't be an array" if link else f"a whole number from 1 to {LARGEST_ARRAY}"
    raise fault("E208", node.location, f"count of {name}", expected, form(node))


@dataclass(frozen=True, slots=True)
class EntryScope:
    """The names that an entry can refer to.

    `dimension` returns the dimension of a name in an expression, and `names` are these names; `references`
    returns the clocks, links or tables for a role and a word, or raises the error of their section; `parts`
    are the parts that can be connected; `complete` is False
    if a section of parts is missing or invalid, which was reported; `outer` is the enclosing component, None
    in a topology.
    """

    dimension: Callable[[tuple[str, ...]], Dimension | None]
    names: Collection[str]
    references: Callable[[str, str], Collection[str]]
    parts: PartEntries
    complete: bool = True
    outer: Component | None = None


@dataclass(frozen=True, slots=True)
class WrittenConnection:
    """A connection as written, for messages.

    `subject` names the connector and its part; `connector` is the key and `text` the value; `fix` proposes
    another part, empty if there is none.
    """

    subject: str
    connector: str
    text: str
    location: SourceLocation
    fix: str


def read_option(node: Node, item: Option) -> str:
    """Return the word of an option. Raises ApcError for an unknown word."""
    name, words = item.name, item.words
    word = value_of(node, name, words[0])
    if word in words:
        return word
    close = _SYNONYMS.get(word.lower()) or nearest(word, words)
    fix = f"{name}: {close}" if close in words else ""
    expected = " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))
    raise fault("E206", node.location, name, expected, brief(word), fix)


def read_entry(entry: PartEntry, scope: EntryScope, mistakes: Mistakes, index: int = 1) -> PartBindings:
    """Return the values, options, references, start values and connections of a part's entry.

    Parameters
    ----------
    entry
        The entry in the topology, with its component.
    scope
        The names that the entry can refer to.
    mistakes
        The collector of errors.
    index
        The index of the element in an array of parts, from 1.
    """
    component, within = entry.component, scope.outer
    # The roles of references by name; inside a component, a table is a reference to a table of the outer
    # part.
    named_roles = ("clock", "link") if within is None else ("clock", "link", "table")
    starts = [variable for variable in component.variables if variable.start is not None]
    settable_names = (whole_and_index(item.name)[0] for item in (*component.parameters, *starts))
    common = PART_KEYS if within is None else ("count",)
    keys = dict.fromkeys(("type", *common, *dict(component.connectors), *settable_names))
    body = replace(
        entry.body,
        entries=tuple(
            (key, node)
            for key, node in entry.body.entries
            if key.text in keys or not _undeclared_reference(key, node, component, scope, mistakes)
        ),
    )
    nodes = MappingReader(body, keys, f"{entry.name} ({component.name})", mistakes).nodes
    numbers: tuple[NumberParameter | ComponentVariable, ...] = (*component.numbers, *starts)
    for name, vector in by_vector(numbers).items():
        if len(vector) > 1 and name in nodes:  # a key for each entry, x[1], instead of x: [1 m, 0 m]
            values: tuple[Node, ...] = (_FAULTY,) * len(vector)
            with mistakes:
                values = _vector_nodes(nodes[name], name, vector, scope)
            nodes.update(zip((item.name for item in vector), values, strict=True))

    def suggestion(parameter: Parameter) -> str:
        """Return the suggested text for a required parameter; empty for an optional one."""
        if isinstance(parameter, Reference):
            texts = scope.references(parameter.role, "") if parameter.role in named_roles else [""]
            return next(iter(texts), "name")
        if parameter.default is not None:
            return ""
        return parameter.words[0] if isinstance(parameter, Option) else _single(parameter.unit)

    def number(item: NumberParameter | ComponentVariable) -> ValueBinding | None:
        """Return the value of a parameter, its default if missing, or the start value of a variable.

        The result is None if the value is missing or invalid.
        """
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
        """Return the word of an option, its default if missing. Raises ApcError for an unknown word."""
        node = nodes.get(item.name)
        return item.default if node is None else read_option(node, item)

    def reference(item: Reference) -> str | None:
        """Return the name of a referenced clock, link or table; None if it is missing or only described."""
        name, role, node = item.name, item.role, nodes.get(item.name)
        if node is None or role not in named_roles:
            return None
        word = text_of(node, name)
        outer = None if within is None else within.parameter(word)
        if isinstance(outer, Reference) and item.unit is not None and outer.unit is not None:
            # A table of the outer part is passed to an inner part: the two units must have the same
            # dimension.
            if outer.unit.dimension != item.unit.dimension:
                raise fault("E204", node.location, name, item.unit.text, outer.unit.text)
            return word
        return read_reference(node, name, role=role, subject=entry.name, scope=scope)

    def read_all(items: Iterable[Item], read: Callable[[Item], T | None]) -> Named[T]:
        """Return the values of items by name; missing and invalid items are omitted."""
        pairs = []
        for item in items:
            with mistakes:
                if (value := read(item)) is not None:
                    pairs.append((item.name, value))
        return tuple(pairs)

    missing = dict[str, str]()
    for name, parameters in by_vector(component.parameters).items():
        suggestions = [suggestion(parameter) for parameter in parameters if parameter.name not in nodes]
        if any(suggestions):
            missing[name] = suggestions[0] if len(suggestions) == 1 else f"[{', '.join(suggestions)}]"
    if missing:
        fix = ", ".join(f"{key}: {value}" for key, value in missing.items())
        message = f"{entry.name} has no {enumerated(tuple(missing))}"
        mistakes.add("E201", entry.location, message, fix=fix)
    references = [parameter for parameter in component.parameters if isinstance(parameter, Reference)]
    described = (reference.name for reference in references if reference.role not in named_roles)
    connections = []
    for name, kind in component.connectors:
        with mistakes:
            if target := _connection_target(name, kind.name, nodes.get(name), entry, scope, index):
                connections.append((name, *target))
    targets = [(part, connector_type) for _, part, connector_type in connections if part != GROUND]
    if len(targets) > 1 and len(set(targets)) == 1:
        joined = [name for name, part, _ in connections if part != GROUND]
        message = f"{enumerated(joined)} of {entry.name} are connected to the same part, {targets[0][0]}"
        second = dict(component.connectors)[joined[1]]
        fix = f"{joined[1]}: {next(iter(_free_parts(entry, scope, second.name)), GROUND)}"
        mistakes.add("E210", nodes[joined[1]].location, message, fix=fix)
    return PartBindings(
        read_all(component.numbers, number),
        read_all((parameter for parameter in component.parameters if isinstance(parameter, Option)), option),
        read_all(references, reference),
        tuple((name, nodes[name]) for name in described if name in nodes),
        read_all(starts, number),
        tuple(connections),
    )


def read_reference(node: Node, key: str, *, role: str, subject: str, scope: EntryScope) -> str:
    """Return the name of an existing clock, link or table, as `role` is, from the value of a key.

    Parameters
    ----------
    node, key, role
        The value, its key, and what it names.
    subject, scope
        The owner of the key for messages, and the names that exist.

    Raises
    ------
    ApcError
        E206 an unknown name.
    """
    word, within = text_of(node, key), scope.outer
    known = scope.references(role, word)
    if word in known:
        return word
    missing = f"not in {role}s" if within is None else f"not a {role} of {within.name}"
    message = f"{subject}: unknown {role} {named(word)} ({missing})"
    if other := (scope.parts.used or {}).get(word, ""):
        fix = f"{key}: {next(iter(known))}" if len(known) == 1 else ""
        got = f"{word}, {other.partition(',')[0]}"
        choice = f"a {role}" if fix else f"a {role} ({', '.join([*known][:MOST_CHOICES])})"
        raise fault("E206", node.location, f"{key} of {subject}", choice, got, fix)
    raise unknown("E206", node.location, message, word, known)


def _undeclared_reference(
    key: Scalar, node: Node, component: Component, scope: EntryScope, mistakes: Mistakes
) -> bool:
    """Return whether an entry has a key for a clock or link that its component uses and does not declare.

    The error E504 of the component is recorded: the key of the entry is correct.
    """
    for role in ("clock", "link"):
        if any(isinstance(item, Reference) and item.role == role for item in component.parameters):
            continue
        faults = _faults_without(role, component)
        if faults and isinstance(node, Scalar) and node.text in scope.references(role, ""):
            location, message = faults
            advice = f"add {key.text}: {role} to its parameters"
            mistakes.add("E504", location, message, advice=advice)
            return True
    return False


def _faults_without(role: str, component: Component) -> tuple[SourceLocation, str] | None:
    """Return the location and the message of the first use of a clock or link in a component that declares
    none; None if it uses none.
    """
    if role == "link":
        uses = ((send.location, f"sends {send.name}") for send in component.sends)
    else:
        uses = (
            (location_in(equation.location, equation.text, node.start), "uses sample")
            for equation in component.equations
            for side in (equation.left, equation.right)
            for node in walk(side)
            if isinstance(node, Call) and node.function == "sample" and len(node.arguments) == 1
        )
    found = next(uses, None)
    return found and (found[0], f"{component.name} {found[1]} but has no {role} parameter")


def _vector_nodes(
    node: Node, name: str, vector: Sequence[NumberParameter | ComponentVariable], scope: EntryScope
) -> tuple[Node, ...]:
    """Return one node for each entry of a vector. Raises ApcError for a wrong number of entries.

    Inside a component the vector may be an expression over vectors of the outer part.
    """
    if isinstance(node, Scalar) and scope.outer is not None and not is_quantity(node.text):
        location = text_location(node)
        sizes = sizes_of(tuple(known.split(".")) for known in scope.names)
        tree = parse_expression(node.text, location)
        result = written_out(tree, lambda parts: sizes.get(parts, 0), node.text, location)
        if result is not None and len(result) == len(vector):
            return tuple(replace(node, text=format_expression(item)) for item in result)
    return list_of(node, name, len(vector), _single(vector[0].unit))


def _connection_target(
    connector: str, kind: str, node: Node | None, entry: PartEntry, scope: EntryScope, index: int
) -> tuple[str, str] | None:
    """Return the part and the connector that a connector of an entry is connected to.

    Parameters
    ----------
    connector, kind
        The connector of the entry, and its connector type.
    node
        The value of the connector's key; None if the key is missing.
    entry, scope
        The entry, and the names that it can refer to.
    index
        The index of the element in an array of parts, from 1.

    Returns
    -------
    None if the connector may remain unconnected; ("ground", "") for the ground; ("", connector) for a
    connector of the enclosing component.

    Raises
    ------
    ApcError
        The connection is missing or invalid.
    """
    name, outer, parts = entry.name, scope.outer, scope.parts.entries
    if node is None:
        # A mass, an inner part, or a connector named by another entry needs no connection of its own.
        if entry.section in ("masses", "parts") or any(
            f"{name}.{connector}" in other.words for other in parts.values()
        ):
            return None
        message = f"connector {connector} of {name} is not connected"
        fix = f"{connector}: {next(iter(_free_parts(entry, scope, kind)), GROUND)}"
        for item in parts.values():  # an entry connected to the part without a named connector
            for key, value in item.body.entries:
                if isinstance(value, Scalar) and value.text == name and key.text in item.connectors(kind):
                    fix = f"{item.name}: {{{key.text}: {name}.{connector}}}"
        raise fault("E210", entry.location, message, fix=fix)
    text = value_of(node, connector, "device")
    if text == GROUND:
        return GROUND, ""
    if outer is not None and text in dict(outer.connectors):
        return "", text
    if (result := _TARGET.match(text)) is None:
        usable = _free_parts(entry, scope, kind)
        known = [part.name for part in parts.values() if part.name in text.split()]
        fix = f"{connector}: {known[0]}" if len(known) == 1 else ""
        expected = f"the name of a part or connector, such as {next(iter(usable), 'device')}"
        raise fault("E210", node.location, connector, expected, quoted(text), fix)
    other, first, last, at_connector = result.groups()
    part = parts.get(other)
    if other in scope.parts.faulty or (part is None and not scope.complete):
        raise AlreadyReportedError
    if part is None:
        message = f"{connector} of {name}: unknown part {brief(other)}"
        others = [part for part in parts.values() if part.name != name and part.connectors(kind)]
        names = [*(part.name for part in others), GROUND]
        if entry.component.receives_from_others:  # a coupler of copies: the objects only, shared ones first
            objects = [part for part in others if part.section == "masses"]
            names = [part.name for part in sorted(objects, key=lambda one: not one.is_shared)]
        raise unknown("E206", node.location, message, other, names)
    if part.name == name and at_connector is None and len(part.connectors(kind)) > 1:
        raise fault("E210", node.location, f"{connector} of {name}", "another part", name)
    element = _element(part, first, last, entry, index, connector, node.location)
    by_hand = entry.section == "hands"
    free = [known for known in _free_parts(entry, scope, kind) if known != name]
    subject = f"{connector} of {name}"
    fix = f"{connector}: {free[0]}" if free else ""
    written = WrittenConnection(subject, connector, text, node.location, fix)
    return element, _matching_connector(part, at_connector, written, kind, by_hand)


def _free_parts(entry: PartEntry, scope: EntryScope, kind: str) -> list[str]:
    """Return the names of the parts with a connector of a type that an entry does not name yet.

    For an entry that receives from other peers, shared objects are first.
    """
    used = {entry.name, *entry.words}
    free = [part for part in scope.parts.entries.values() if part.name not in used and part.connectors(kind)]
    if entry.component.receives_from_others:
        free.sort(key=lambda part: not part.is_shared)
    return [part.name for part in free]


def _element(
    part: PartEntry,
    first: str | None,
    last: str | None,
    entry: PartEntry,
    index: int,
    connector: str,
    at: SourceLocation,
) -> str:
    """Return the name of the connected part, or of the connected element of an array.

    Parameters
    ----------
    part
        The part that is connected.
    first, last
        The written indices of the first and last element of an array, None if not written.
    entry, index
        The entry that contains the connection, and the index of its element.
    connector
        The connector of the entry.
    at
        The place of the connection, for messages.

    Raises
    ------
    ApcError
        The indices do not match the array.
    """
    other, size, message, fix = part.name, part.count, "", ""
    if size is None and first is None:
        return other
    low, high = int(first or 1), int(last or first or size or 0)
    if size is None:
        message, fix = f"{other} is a single part, not an array", f"{connector}: {other}"
    elif not 1 <= low <= high <= size:
        shown = f"{low}" if low == high else f"{low}:{high}"
        message = f"index of {other}: expected 1 to {size}, got {shown}"
    elif low == high and first:
        return f"{other}[{low}]"
    elif entry.count == high - low + 1:
        return f"{other}[{low + index - 1}]"
    else:
        mine = "a single part" if entry.count is None else f"an array of {entry.count}"
        theirs = f"{other}[{low}:{high}] has {high - low + 1} elements" if first else f"{other} has {size}"
        message = f"{entry.name} is {mine}, but {theirs}{'' if first else ' elements'}"
        elements = f"1:{entry.count}" if entry.count and entry.count <= size else "1"
        fix = f'{connector}: "{other}[{elements}]"'
    raise fault("E210", at, message, fix=fix)


def _matching_connector(
    part: PartEntry, named_connector: str | None, written: WrittenConnection, kind: str, by_hand: bool
) -> str:
    """Return the connector of the connected part: the connector named, else the only one of the same type.

    Parameters
    ----------
    part
        The part that is connected.
    named_connector
        The name of its connector, None if not written.
    written
        The connection, for messages.
    kind
        The connector type of the entry's connector.
    by_hand
        Whether the entry is a hand, which is connected to connectors for hands first.

    Raises
    ------
    ApcError
        No connector, or more than one, is possible.
    """
    shown, fitting = f"{part.name} ({part.component.name})", part.connectors(kind)
    preferred = [name for name in fitting if (name in part.component.grips) == by_hand] or fitting
    if named_connector in fitting:
        return named_connector
    if not fitting:
        got = f"{part.name}, a link" if part.section == "links" else shown
        expected = f"a part with a connector of type {kind}"
        raise fault("E210", written.location, written.subject, expected, got, written.fix)
    if named_connector is not None:
        message = f"{shown} has no connector {named_connector} of type {kind}"
        close = nearest(named_connector, fitting)
        if not close and len(fitting) > 1:
            raise unknown("E206", written.location, message, named_connector, fitting)
        target = f"{written.text.rpartition('.')[0]}.{close or fitting[0]}"
        fix = f'{written.connector}: "{target}"' if "[" in target else target
        message += f"; the nearest is {close}" if close else ""
        raise fault("E206", written.location, message, fix=fix)
    if len(preferred) == 1:
        return preferred[0]
    message = f"{shown} has {len(fitting)} connectors of type {kind}"
    fix = f"{written.connector}: {part.name}.{fitting[0]}"
    raise fault("E210", written.location, message, fix=fix)


def _single(unit: Unit) -> str:
    """Return the text of a number in a unit, as an example in messages."""
    return f"1 {unit.text}".removesuffix(" 1")


def joining_of(node: Node, subject: str) -> str:
    """Return the values of a part at a joining peer, from `joining: mean` or `joining: start`."""
    word = text_of(node, subject, f"{subject}: mean")
    if word not in JOINING:
        raise fault("E203", node.location, subject, " or ".join(JOINING), form(node), f"{subject}: mean")
    return word
