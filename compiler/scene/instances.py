"""The parts of a peer: entries read, arrays and the parts inside parts written out.

Takes: the entries of parts, the components they are of, and the scope they stand in. Gives: `Part`,
`PartEntry`, `PartReader`, `settable_names`.
Guarantees: every number of a part has a value within its bounds; its options and references are decided; what
it is joined to is there.
Does not: read a section (see `scene`), or look into equations.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from collections.abc import Mapping as MappingType
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import product

from apc.compiler.components.component import Component, Inner, Reference, Settable
from apc.compiler.components.parts import GROUND, MOST_PARTS, Scope, read_entry
from apc.compiler.errors import ApcError, Place
from apc.compiler.language.recordings import TimeTable, read_time_table
from apc.compiler.language.tables import NamedFiles
from apc.compiler.language.values import (
    PEERS,
    Binding,
    Value,
    renamed,
    settle,
)
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.scene.named_numbers import NamedNumbers
from apc.compiler.source.nodes import Mapping, Node, Scalar, Sequence
from apc.compiler.source.reading import (
    add_unknown,
    brief,
    form,
    read_text,
)

PART_KEYS = ("at", "shared", "count")
LINK_ROLES = ("graph", "delays", "loss", "trace")


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
class PartEntry:
    """A part's entry before it is read; `count` is None for one that is no array."""

    section: str
    body: Mapping
    component: Component
    place: Place
    count: int | None


class PartReader:
    """Reads the entries of parts, one after the other; counts the parts there are so far.

    `counts` are the groups and how many peers each has.
    """

    def __init__(
        self,
        entries: MappingType[str, PartEntry],
        scope: Scope,
        numbers: NamedNumbers,
        counts: MappingType[str, int],
        files: NamedFiles,
    ) -> None:
        self.entries = entries
        self.scope = scope
        self.numbers = numbers
        self.counts = counts
        self.files = files
        self.mistakes = numbers.mistakes
        self.number_of_parts = 0

    def read(self, name: str) -> list[Part]:
        """Read a part's entry, once for each element of an array, and write out the parts inside."""
        entry = self.entries[name]
        shared = self._shared(name, entry.component, entry.body.get("shared"))
        groups = self._groups_of(name, entry)
        self._check_roles(name, entry)
        peers = sum(self.counts.get(group, 0) for group in groups)
        if entry.component.hears_others and peers == 1:
            what = f"{name} ({entry.component.name}) follows the other peers and"
            hint = f"at: [{', '.join(self.counts)}]" if len(self.counts) > 1 else "count: 2"
            self.mistakes.add("E208", entry.place, what, expected="at least 2 peers", got="1", hint=hint)
        if (due := entry.component.peers) and peers > due:
            what, expected = f"{name} ({entry.component.name})", f"{due} peers"
            hint = f"count: {due}, or groups that make {due}: at: [left, right]"
            self.mistakes.add("E208", entry.place, what, expected=expected, got=f"{peers:,}", hint=hint)
        found: list[Part] = []
        for index in range(1, (entry.count or 1) + 1):
            read = read_entry(
                name,
                entry.body,
                entry.component,
                entry.place,
                self.scope,
                self.mistakes,
                more_keys=PART_KEYS,
                index=index,
                count=entry.count,
                free_connectors=self._free_connectors(name, entry),
                hand=entry.section == "hands",
            )
            part = Part(
                name if entry.count is None else f"{name}[{index}]",
                entry.section,
                entry.component,
                self.numbers.settled_all(read.values, entry.component),
                read.options,
                read.references,
                self._tables(name, entry, read.described),
                self.numbers.settled_all(read.starts),
                read.connections,
                shared,
                groups,
                entry.place,
            )
            found += self._with_inner(part)
        return found

    def _free_connectors(self, name: str, entry: PartEntry) -> Collection[str]:
        """Return the connectors an entry need not mention: a mass's, and those another entry is joined to."""
        connectors = [connector for connector, _ in entry.component.connectors]
        if entry.section == "masses":
            return connectors
        named = {
            value.text
            for other in self.entries.values()
            for _, value in other.body.entries
            if isinstance(value, Scalar)
        }
        return [connector for connector in connectors if f"{name}.{connector}" in named]

    def _with_inner(self, part: Part) -> list[Part]:
        """Return a part and the parts inside it."""
        found = [part]
        self.number_of_parts += 1
        if self.number_of_parts > MOST_PARTS:
            if self.number_of_parts == MOST_PARTS + 1:
                what = f"a peer would have more than {MOST_PARTS} parts, those inside parts included"
                self.mistakes.add("E216", part.place, what, hint="fewer or smaller arrays and components")
            return found
        for inner in part.component.inner:
            found += self._with_inner(_inside(part, inner, self.numbers.peers))
        return found

    def _tables(
        self, name: str, entry: PartEntry, described: Collection[tuple[str, Node]]
    ) -> tuple[TimeTable, ...]:
        """Read the files of a part's quantities over time."""
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
                own = partial(read_time_table, name=parameter.name, unit=parameter.unit, named_at=node.place)
                found.append(self.files.read(text, own))
        return tuple(table for table in found if table is not None)

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

    def _check_roles(self, name: str, entry: PartEntry) -> None:
        """Record a part that is no link and would have what only a link obeys: a graph, losses."""
        roles = [p for p in entry.component.parameters if isinstance(p, Reference) and p.role in LINK_ROLES]
        if roles and entry.section != "links":
            what = f"{name} is a {entry.component.name}, whose {roles[0].name} only a link has"
            self.mistakes.add("E210", entry.place, what, hint=f"links: {{{name}: …}}")

    def _groups_of(self, name: str, entry: PartEntry) -> tuple[str, ...]:
        node = entry.body.get("at")
        if node is None:
            return tuple(self.counts)
        if entry.section == "links":
            what = f"{name} is a link, which joins all peers: who takes part is said by what uses it"
            groups = map(form, node.items) if isinstance(node, Sequence) else [form(node)]
            told = ", ".join(groups) or ", ".join(self.counts)
            hint = f"{self._user_of(name)}: {{at: [{told}]}}"
            self.mistakes.add("E211", node.place, what, hint=hint)
            return tuple(self.counts)
        if not (isinstance(node, Sequence) and node.items):
            got = form(node) if not isinstance(node, Sequence) else "an empty one"
            hint = f"at: [{', '.join(self.counts)}]"
            self.mistakes.add("E203", node.place, "at", expected="a list of groups", got=got, hint=hint)
            return ()
        found = []
        for item in node.items:
            group = read_text(item, "a group", self.mistakes)
            if group is None:
                continue
            if group in self.counts:
                found.append(group)
            else:
                what = f"{name} is at {brief(group)}, which is no group of peers"
                add_unknown("E206", item.place, what, group, list(self.counts), self.mistakes)
        return tuple(found)

    def _user_of(self, link: str) -> str:
        """Return the first part that names a link, or an example of one."""
        users = (
            name
            for name, entry in self.entries.items()
            for _, value in entry.body.entries
            if isinstance(value, Scalar) and value.text == link
        )
        return next(users, "coordination")


def _inside(part: Part, inner: Inner, peers: int) -> Part:
    """Return a part inside a part; its numbers are expressions over the outer one's."""
    entry = inner.entry
    references = dict(part.references)
    tables = {table.name: table for table in part.tables}
    return Part(
        f"{part.name}.{inner.name}",
        part.section,
        inner.component,
        _settled_inside(part, entry.values, peers),
        entry.options,
        tuple((own, references.get(outer, "?")) for own, outer in entry.references if outer not in tables),
        tuple(replace(tables[outer], name=own) for own, outer in entry.references if outer in tables),
        _settled_inside(part, entry.starts, peers),
        tuple(
            (own, GROUND if other == GROUND else f"{part.name}.{other}", its)
            for own, other, its in entry.connections
            if other
        ),
        part.shared,
        part.groups,
        part.place,
    )


def _settled_inside(
    part: Part, bindings: Collection[tuple[str, Binding]], peers: int
) -> tuple[tuple[str, Value], ...]:
    """Return what numbers in terms of an outer part come to, their expressions in whole names."""
    values = dict(part.values)

    def number(parts: tuple[str, ...]) -> Fraction:
        return Fraction(peers) if parts == PEERS else values[parts[-1]].number

    def whole(parts: tuple[str, ...]) -> tuple[str, ...]:
        return parts if parts == PEERS else (*part.name.split("."), *parts)

    found = []
    for name, binding in bindings:
        tree = None if binding.expression is None else renamed(binding.expression, whole)
        try:
            found.append((name, settle(Binding(binding.number, tree, binding.dimension, part.place), number)))
        except (ApcError, KeyError):
            continue  # the outer number it depends on was reported
    return tuple(found)


def settable_names(parts: Collection[Part]) -> dict[str, list[tuple[str, Settable]]]:
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
            for name in _of_arrays(part.name):
                found.setdefault(f"{name}.{item.name}", []).append((whole, item))
    return found


def _of_arrays(part: str) -> Iterator[str]:
    """Yield the names that stand for a part among others: `a[1].b[2]` is one of `a.b[2]`, `a[1].b`, `a.b`."""
    elements = [(name, whole_and_index(name)[0]) for name in part.split(".")]
    names = product(*(dict.fromkeys(either) for either in elements))
    return (one for name in names if (one := ".".join(name)) != part)
