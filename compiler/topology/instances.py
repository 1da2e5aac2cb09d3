"""The parts of a peer: entries read, arrays and inner parts expanded.

Takes: the entries of parts, their components, and the enclosing scope. Gives: `PartInstance`, `PartReader`,
`settable_names`.
Guarantees: every number of a part has a value within its bounds; its options and references are resolved; its
connections exist.
Does not: read a section (see `topology`), or analyze equations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from itertools import product

from apc.compiler.components.component import (
    Component,
    Inner,
    Joined,
    Named,
    NumberParameter,
    Reference,
    Settable,
)
from apc.compiler.components.parts import GROUND, MOST_PARTS, EntryScope, PartEntry, read_entry
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.recordings import TimeTable, read_time_table
from apc.compiler.language.values import PEERS, ScalarValue, ValueBinding, renamed, settle
from apc.compiler.language.vectors import entries, whole_and_index
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import among, fault, form, text_of
from apc.compiler.topology.topology_parameters import NamedNumbers

LINK_ROLES = ("graph", "delays", "loss", "trace")

# The settable names: for each written name its type and its qualified names.
SettableNames = Mapping[str, tuple[Settable, list[str]]]


@dataclass(frozen=True, slots=True)
class PartInstance:
    """An instance of a component at every peer of `groups`; inner parts are separate instances.

    `values` holds a value for every number the component declares, `options` and `references` a word for
    every option and every clock or link it names, `starts` the start values given here; `connections` join
    a connector of this part to (part, connector), the part "ground" being fixed.
    """

    name: str
    section: str
    component: Component
    values: Named[ScalarValue]
    options: Named[str]
    references: Named[str]
    tables: tuple[TimeTable, ...]
    starts: Named[ScalarValue]
    connections: Joined
    shared: bool
    groups: tuple[str, ...]
    location: SourceLocation

    @property
    def all_starts(self) -> Named[ScalarValue]:
        """The start values of all its variables that have one: those given here, else the component's own."""
        local = {
            variable.name: ScalarValue(variable.start, variable.unit.dimension, None, self.location)
            for variable in self.component.variables
            if variable.start is not None
        }
        return tuple((local | dict(self.starts)).items())

    def reference(self, role: str) -> str | None:
        """Return the clock or link this part names, when it names exactly one."""
        names = {p.name for p in self.component.parameters if isinstance(p, Reference) and p.role == role}
        named = [word for name, word in self.references if name in names]
        return named[0] if len(named) == 1 else None


@dataclass(frozen=True, slots=True)
class PartReader:
    """Reads the entries of parts, one after the other, into `parts`, each before those inside it."""

    scope: EntryScope
    numbers: NamedNumbers
    parts: list[PartInstance] = field(default_factory=list)

    def read(self, entry: PartEntry, redeclared: Mapping[str, PartEntry]) -> None:
        """Read a part's entry, once for each element of an array, and write out the parts inside.

        Parameters
        ----------
        entry
            The entry.
        redeclared
            By group, the entry that the part has there instead, of another type.
        """
        groups = tuple(self.numbers.counts)
        with self.numbers.mistakes:
            groups = self._groups_of(entry)
        others = {group: redeclared[group] for group in groups if redeclared.get(group, entry) is not entry}
        for group, other in others.items():
            self._read(other, (group,))
        # Other meanings of a name come last: a table of names keeps the last.
        rest = tuple(group for group in groups if group not in others)
        if rest or not others:
            self._read(entry, rest)

    def _read(self, entry: PartEntry, groups: tuple[str, ...]) -> None:
        """Read an entry as it applies to some groups."""
        name, component = entry.name, entry.component
        counts, mistakes = self.numbers.counts, self.numbers.mistakes
        shared = False
        with mistakes:
            shared = _shared(entry)
        roles = [p.name for p in component.parameters if isinstance(p, Reference) and p.role in LINK_ROLES]
        if roles and entry.section != "links":
            message = f"{name} is a {component.name}, whose {roles[0]} only a link has"
            mistakes.add("E210", entry.location, message, hint=f"links: {{{name}: …}}")
        peers, due = sum(counts[group] for group in groups), component.peers
        shown = f"{name} ({component.name})"
        if component.receives_from_others and peers == 1:
            message = f"{shown} follows the other peers and"
            hint = f"at: [{', '.join(counts)}]" if len(counts) > 1 else f"{next(iter(counts))}: {{count: 2}}"
            mistakes.add("E208", entry.location, message, expected="at least 2 peers", got="1", hint=hint)
        if due and peers > due:
            hint = f"count: {due}, or groups that make {due}: at: [left, right]"
            mistakes.add("E208", entry.location, shown, expected=f"{due} peers", got=f"{peers:,}", hint=hint)
        for index, element in enumerate(entries(name, entry.count or 0), 1):
            read = read_entry(entry, self.scope, mistakes, index)
            values, starts = (self._settled(pairs, component) for pairs in (read.values, read.starts))
            tables = self._tables(entry, dict(read.described))
            text = values, read.options, read.references, tables, starts, read.connections
            self._add(PartInstance(element, entry.section, component, *text, shared, groups, entry.location))

    def _add(self, part: PartInstance) -> None:
        """Add a part and those inside it."""
        self.parts.append(part)
        if len(self.parts) <= MOST_PARTS:
            for inner in part.component.inner:
                self._add(_inside(part, inner, self.numbers.peers, self.numbers.mistakes))
        elif len(self.parts) == MOST_PARTS + 1:
            message = f"a peer would have more than {MOST_PARTS} parts, those inside parts included"
            hint = "fewer or smaller arrays and components"
            self.numbers.mistakes.add("E216", part.location, message, hint=hint)

    def _settled(self, bindings: Named[ValueBinding], component: Component) -> Named[ScalarValue]:
        """Return the values of named bindings, within the bounds of a component's parameters."""
        pairs = []
        for name, binding in bindings:
            with self.numbers.mistakes:
                pairs.append((name, value := settle(binding, self.numbers.number)))
                if isinstance(parameter := component.parameter(name), NumberParameter):
                    parameter.bounds.check(value, name, self.numbers.mistakes)
        return tuple(pairs)

    def _tables(self, entry: PartEntry, nodes: Mapping[str, Node]) -> tuple[TimeTable, ...]:
        """Read the files of a part's quantities over time."""
        time_tables = []
        for parameter in entry.component.parameters:
            if isinstance(parameter, Reference) and parameter.role == "table":
                name, unit = parameter.name, parameter.unit
                assert unit is not None
                with self.numbers.mistakes:
                    hint = f"{name}: force.csv"
                    if (node := nodes.get(name)) is None:
                        raise fault("E201", entry.location, f"{entry.name} has no {name}", hint=hint)
                    reader = partial(read_time_table, name=name, unit=unit, named_at=node.location)
                    time_tables.append(self.numbers.files.read(text_of(node, name, hint), reader))
        return tuple(filter(None, time_tables))

    def _groups_of(self, entry: PartEntry) -> tuple[str, ...]:
        """Return the groups whose peers have a part."""
        node, name, counts = entry.body.get("at"), entry.name, self.numbers.counts
        if node is None:
            return tuple(counts)
        items, groups = node.items if isinstance(node, Sequence) else (node,), ", ".join(counts)
        if entry.section == "links":
            parts = self.scope.parts.entries.values()
            user = next((part.name for part in parts if name in part.words), "coordination")
            message = f"{name} is a link, which joins all peers: who takes part is said by what uses it"
            hint = f"{user}: {{at: [{', '.join(map(form, items)) or groups}]}}"
            raise fault("E211", node.location, message, hint=hint)
        if not (isinstance(node, Sequence) and items):
            got = "an empty one" if isinstance(node, Sequence) else form(node)
            raise fault("E203", node.location, "at", "a list of groups", got, f"at: [{groups}]")
        texts = []
        for item in items:
            with self.numbers.mistakes:
                message = f"{name} is at {{}}, which is no group of peers"
                texts.append(among(text_of(item, "a group"), counts, item.location, message))
        return tuple(texts)


def _shared(entry: PartEntry) -> bool:
    """Return whether a part is declared a copy of one object, which its component allows."""
    if (node := entry.body.get("shared")) is None:
        return False
    if not (isinstance(node, Scalar) and node.plain and isinstance(node.value, bool)):
        raise fault("E203", node.location, "shared", "true or false", form(node), "shared: true")
    if node.value and not any(parameter.divided for parameter in entry.component.numbers):
        message = f"{entry.name} can't be shared: nothing of a {entry.component.name} is divided"
        raise fault("E210", node.location, message)
    return node.value


def _inside(part: PartInstance, inner: Inner, peers: int, mistakes: Mistakes) -> PartInstance:
    """Return a part inside a part; its numbers are expressions over the outer one's, in whole names.

    `mistakes` takes those of numbers without a value.
    """
    entry, references = inner.entry, dict(part.references)
    tables = {table.name: table for table in part.tables}
    numbers: dict[tuple[str, ...], Fraction] = {(name,): value.number for name, value in part.values}
    numbers[PEERS] = Fraction(peers)

    def whole(parts: tuple[str, ...]) -> tuple[str, ...]:
        return parts if parts == PEERS else (*part.name.split("."), *parts)

    def settled(bindings: Named[ValueBinding]) -> Named[ScalarValue]:
        pairs = []
        for name, binding in bindings:
            with mistakes, suppress(KeyError):  # what the outer part has no value for was reported there
                value = settle(binding, numbers.__getitem__)
                tree = value.expression and renamed(value.expression, whole)
                pairs.append((name, replace(value, location=part.location, expression=tree)))
        return tuple(pairs)

    return replace(
        part,
        name=f"{part.name}.{inner.name}",
        component=inner.component,
        values=settled(entry.values),
        options=entry.options,
        references=tuple(
            (local, references.get(outer, "?")) for local, outer in entry.references if outer not in tables
        ),
        tables=tuple(
            replace(tables[outer], name=local) for local, outer in entry.references if outer in tables
        ),
        starts=settled(entry.starts),
        connections=tuple(
            (local, GROUND if other == GROUND else f"{part.name}.{other}", connector_of_other)
            for local, other, connector_of_other in entry.connections
            if other
        ),
    )


def settable_names(parts: Iterable[PartInstance]) -> dict[str, tuple[Settable, list[str]]]:
    """Return the settable names of a group: for each written name its type and its qualified names.

    The name of an array represents all its elements: `a[1].b[2]` is one of `a.b[2]`, `a[1].b` and `a.b`.
    """
    result: dict[str, tuple[Settable, list[str]]] = {}
    for part in parts:
        items: list[Settable] = [
            p for p in part.component.parameters if not isinstance(p, Reference) or p.role == "clock"
        ]
        items += [v for v in part.component.variables if v.start is not None]
        elements = product(
            *(dict.fromkeys((name, whole_and_index(name)[0])) for name in part.name.split("."))
        )
        for name, item in product(map(".".join, elements), items):
            _, wholes = result.setdefault(f"{name}.{item.name}", (item, []))
            wholes.append(f"{part.name}.{item.name}")
    return result
