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
from apc.compiler.components.parts import GROUND, MOST_PARTS, EntryScope, PartEntry, joining_of, read_entry
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.recordings import TimeTable, read_time_table
from apc.compiler.language.values import PEERS, ScalarValue, ValueBinding, renamed, settle
from apc.compiler.language.vectors import entries, whole_and_index
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import among, fault, form, text_of
from apc.compiler.topology.graphs import may_have_self_arcs
from apc.compiler.topology.topology_parameters import NamedNumbers

LINK_ROLES = ("graph", "delays", "pairs", "loss", "trace")

# The settable names: for each written name its type and its qualified names.
SettableNames = Mapping[str, tuple[Settable, list[str]]]


@dataclass(frozen=True, slots=True)
class PartInstance:
    """An instance of a component at every peer of `groups`; inner parts are separate instances.

    `values` has a value for every number the component declares, `options` and `references` a word for every
    option and every clock or link, `starts` the start values given in the entry. `connections` connect a
    connector of this part to (part, connector); the part "ground" is fixed. `joining` is "mean" or "start",
    or "" if the entry does not declare it.
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
    joining: str = ""

    @property
    def joins_at_mean(self) -> bool:
        """Whether the values at a joining peer are the mean of the others'.

        The entry declares it, else the component. By default they are for shared objects and parts that send.
        """
        default = "mean" if self.shared or self.component.sends else "start"
        return (self.joining or self.component.joining or default) == "mean"

    @property
    def all_starts(self) -> Named[ScalarValue]:
        """The start values of all variables that have one: from the entry, else from the component."""
        of_component = {
            variable.name: ScalarValue(variable.start, variable.unit.dimension, None, self.location)
            for variable in self.component.variables
            if variable.start is not None
        }
        return tuple((of_component | dict(self.starts)).items())

    def reference(self, role: str) -> str | None:
        """Return the clock or link that the part refers to in `role`; None if there is not exactly one."""
        names = {p.name for p in self.component.parameters if isinstance(p, Reference) and p.role == role}
        named = [word for name, word in self.references if name in names]
        return named[0] if len(named) == 1 else None


@dataclass(frozen=True, slots=True)
class PartReader:
    """Reads the entries of parts into `parts`; an outer part comes before the parts inside it.

    `scope` has the names that entries can refer to, `numbers` the named numbers of the topology.
    """

    scope: EntryScope
    numbers: NamedNumbers
    parts: list[PartInstance] = field(default_factory=list)

    def read(self, entry: PartEntry, redeclared: Mapping[str, PartEntry]) -> None:
        """Read a part's entry, with array elements and inner parts, and add the instances to `parts`.

        Parameters
        ----------
        entry
            The entry.
        redeclared
            The part's entry with another component type, by the name of the group that sets the type.
        """
        groups = tuple(self.numbers.counts)
        with self.numbers.mistakes:
            groups = self._groups_of(entry)
        others = {group: redeclared[group] for group in groups if redeclared.get(group, entry) is not entry}
        for group, other in others.items():
            self._read(other, (group,))
        # The part of the ordinary type comes last: a table of names stores the last entry of a name.
        remaining = tuple(group for group in groups if group not in others)
        if remaining or not others:
            self._read(entry, remaining)

    def _read(self, entry: PartEntry, groups: tuple[str, ...]) -> None:
        """Read an entry of the topology as a part of some groups of peers, and add its instances to `parts`.

        `groups` are the names of the groups. Errors are added to the collector.
        """
        name, component = entry.name, entry.component
        counts, mistakes = self.numbers.counts, self.numbers.mistakes
        shared, joining = False, ""
        with mistakes:
            shared = _shared(entry)
        with mistakes:
            joining = _joining(entry)
        roles = [p.name for p in component.parameters if isinstance(p, Reference) and p.role in LINK_ROLES]
        if roles and entry.section != "links":
            message = f"{name} ({component.name}) is valid only in links, not in {entry.section}"
            mistakes.add("E210", entry.location, message, advice=f"move {name} to links")
        if entry.section == "links" and not _has_clock_and_delay(component):
            message = f"{name} is a {component.name}, not a link: it has no clock or delay"
            mistakes.add("E210", entry.location, message, fix="type: Link")
            self.scope.parts.faulty.add(name)
            return
        peers, peer_limit = sum(counts[group] for group in groups), component.peers
        subject = f"{name} ({component.name})"
        if component.receives_from_others and peers == 1 and not self._has_self_arcs():
            message = f"{name} receives from other peers"
            fix = f"at: [{', '.join(counts)}]" if len(counts) > 1 else f"{next(iter(counts))}: {{count: 2}}"
            advice = "" if len(counts) > 1 else "use graph: {arcs: [[1, 1]]} for a peer that sends to itself"
            mistakes.add(
                "E208", entry.location, message, expected="at least 2 peers", got="1", fix=fix, advice=advice
            )
        if peer_limit and peers > peer_limit:
            expected, got = f"{peer_limit} peers", f"{peers:,}"
            advice = f"set count: {peer_limit}, or at: to groups of {peer_limit} peers in total"
            mistakes.add("E208", entry.location, subject, expected=expected, got=got, advice=advice)
        for index, element in enumerate(entries(name, entry.count or 0), 1):
            read = read_entry(entry, self.scope, mistakes, index)
            values, starts = (self._evaluated(pairs, component) for pairs in (read.values, read.starts))
            tables = self._tables(entry, dict(read.described))
            bindings = values, read.options, read.references, tables, starts, read.connections
            self._add(
                PartInstance(
                    element, entry.section, component, *bindings, shared, groups, entry.location, joining
                )
            )

    def _add(self, part: PartInstance) -> None:
        """Add a part and its inner parts to `parts`, at most `MOST_PARTS`."""
        self.parts.append(part)
        if len(self.parts) <= MOST_PARTS:
            for inner in part.component.inner:
                self._add(_inner_instance(part, inner, self.numbers.peers, self.numbers.mistakes))
        elif len(self.parts) == MOST_PARTS + 1:
            message = f"expected at most {MOST_PARTS} parts at a peer, inner parts included"
            advice = "use fewer or smaller arrays and components"
            self.numbers.mistakes.add("E216", part.location, message, advice=advice)

    def _evaluated(self, bindings: Named[ValueBinding], component: Component) -> Named[ScalarValue]:
        """Return the values of named bindings.

        Values out of the bounds of the component's parameters are recorded.
        """
        pairs = []
        for name, binding in bindings:
            with self.numbers.mistakes:
                pairs.append((name, value := settle(binding, self.numbers.number)))
                if isinstance(parameter := component.parameter(name), NumberParameter):
                    parameter.bounds.check(value, name, self.numbers.mistakes)
        return tuple(pairs)

    def _tables(self, entry: PartEntry, nodes: Mapping[str, Node]) -> tuple[TimeTable, ...]:
        """Return the time series of a part, read from the files that its entry names.

        `nodes` has the YAML nodes of the file names, by parameter.
        """
        time_tables = []
        for parameter in entry.component.parameters:
            if isinstance(parameter, Reference) and parameter.role == "table":
                name, unit = parameter.name, parameter.unit
                assert unit is not None
                with self.numbers.mistakes:
                    fix = f"{name}: force.csv"
                    if (node := nodes.get(name)) is None:
                        advice = f"use a .csv file with the columns time [s] and {name} [{unit.text}]"
                        message = f"{entry.name} has no {name}"
                        raise fault("E201", entry.location, message, fix=fix, advice=advice)
                    reader = partial(read_time_table, name=name, unit=unit, named_at=node.location)
                    time_tables.append(self.numbers.files.read(text_of(node, name, fix), reader))
        return tuple(filter(None, time_tables))

    def _has_self_arcs(self) -> bool:
        """Return whether a link of the topology may connect a peer to itself."""
        links = (entry for entry in self.scope.parts.entries.values() if entry.section == "links")
        return any(may_have_self_arcs(entry.body.get("graph")) for entry in links)

    def _groups_of(self, entry: PartEntry) -> tuple[str, ...]:
        """Return the groups of peers that have a part: the list `at` of its entry, or all groups."""
        node, name, counts = entry.body.get("at"), entry.name, self.numbers.counts
        if node is None:
            return tuple(counts)
        items, groups = node.items if isinstance(node, Sequence) else (node,), ", ".join(counts)
        if entry.section == "links":
            parts = self.scope.parts.entries.values()
            user = next((part.name for part in parts if name in part.words), f"a coupler over {name}")
            message, at = f"at has no effect on the link {name}", ", ".join(map(form, items)) or groups
            advice = f"set at: [{at}] in {user}, or name the groups in its graph"
            raise fault("E211", node.location, message, advice=advice)
        if not (isinstance(node, Sequence) and items):
            got = "an empty list" if isinstance(node, Sequence) else form(node)
            raise fault("E203", node.location, "at", "a list of groups", got, f"at: [{groups}]")
        texts = []
        for item in items:
            with self.numbers.mistakes:
                message = f"at of {name}: unknown group of peers {{}}"
                texts.append(among(text_of(item, "group"), counts, item.location, message))
        return tuple(texts)


def _has_clock_and_delay(component: Component) -> bool:
    """Return whether a component has a clock and a delay, as every link has."""
    roles = {parameter.role for parameter in component.parameters if isinstance(parameter, Reference)}
    return "clock" in roles and component.parameter("delay") is not None


def _shared(entry: PartEntry) -> bool:
    """Return whether an entry declares `shared: true`.

    Raises ApcError if its component has no divided parameter.
    """
    if (node := entry.body.get("shared")) is None:
        return False
    if not (isinstance(node, Scalar) and node.plain and isinstance(node.value, bool)):
        raise fault("E203", node.location, "shared", "true or false", form(node), "shared: true")
    if node.value and not any(parameter.divided for parameter in entry.component.numbers):
        message = f"shared: no parameter of {entry.name} ({entry.component.name}) is divided among peers"
        raise fault("E210", node.location, message, advice="remove shared")
    return node.value


def _joining(entry: PartEntry) -> str:
    """Return the values of a part at a joining peer, "" if its entry does not declare them."""
    if (node := entry.body.get("joining")) is None:
        return ""
    if entry.section == "links":
        message = f"joining has no effect on the link {entry.name}"
        raise fault("E211", node.location, message, advice="write it at a mass, a coupler or a hand")
    return joining_of(node, "joining")


def _inner_instance(part: PartInstance, inner: Inner, peers: int, mistakes: Mistakes) -> PartInstance:
    """Return the instance of a part inside `part`.

    Its numbers are expressions over the outer part's numbers, by qualified name. `peers` is the number of all
    peers; `mistakes` collects the errors of numbers.
    """
    entry, references = inner.entry, dict(part.references)
    tables = {table.name: table for table in part.tables}
    numbers: dict[tuple[str, ...], Fraction] = {(name,): value.number for name, value in part.values}
    numbers[PEERS] = Fraction(peers)

    def qualified(parts: tuple[str, ...]) -> tuple[str, ...]:
        """Return a name in the outer part with the name of that part in front; `peers` remains."""
        return parts if parts == PEERS else (*part.name.split("."), *parts)

    def evaluated(bindings: Named[ValueBinding]) -> Named[ScalarValue]:
        """Return the values of bindings; a number of the outer part without a value is omitted."""
        pairs = []
        for name, binding in bindings:
            with mistakes, suppress(KeyError):  # a missing value of the outer part was already reported
                value = settle(binding, numbers.__getitem__)
                tree = value.expression and renamed(value.expression, qualified)
                pairs.append((name, replace(value, location=part.location, expression=tree)))
        return tuple(pairs)

    return replace(
        part,
        name=f"{part.name}.{inner.name}",
        component=inner.component,
        values=evaluated(entry.values),
        options=entry.options,
        references=tuple(
            (name, references.get(outer, "?")) for name, outer in entry.references if outer not in tables
        ),
        tables=tuple(
            replace(tables[outer], name=name) for name, outer in entry.references if outer in tables
        ),
        starts=evaluated(entry.starts),
        connections=tuple(
            (connector, GROUND if neighbor == GROUND else f"{part.name}.{neighbor}", neighbor_connector)
            for connector, neighbor, neighbor_connector in entry.connections
            if neighbor
        ),
    )


def settable_names(parts: Iterable[PartInstance]) -> dict[str, tuple[Settable, list[str]]]:
    """Return the settable names of a group: the declaration and the qualified names of each written name.

    The name of an array represents all its elements: `a[1].b[2]` is an element of `a.b[2]`, `a[1].b` and
    `a.b`.
    """
    result: dict[str, tuple[Settable, list[str]]] = {}
    for part in parts:
        declarations: list[Settable] = [
            parameter
            for parameter in part.component.parameters
            if not isinstance(parameter, Reference) or parameter.role == "clock"
        ]
        declarations += [variable for variable in part.component.variables if variable.start is not None]
        elements = product(
            *(dict.fromkeys((name, whole_and_index(name)[0])) for name in part.name.split("."))
        )
        for name, declaration in product(map(".".join, elements), declarations):
            _, qualified = result.setdefault(f"{name}.{declaration.name}", (declaration, []))
            qualified.append(f"{part.name}.{declaration.name}")
    return result
