"""The parts of a peer: entries read, arrays and the parts inside parts written out.

Takes: the entries of parts, the components they are of, and the scope they stand in. Gives: `Part`,
`PartReader`, `settable_names`.
Guarantees: every number of a part has a value within its bounds; its options and references are decided; what
it is joined to is there.
Does not: read a section (see `scene`), or look into equations.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import product

from apc.compiler.components.component import Component, Inner, Joined, Named, Reference, Settable
from apc.compiler.components.parts import GROUND, MOST_PARTS, PartEntry, Scope, read_entry
from apc.compiler.errors import Mistakes, Place
from apc.compiler.language.expression import Name, names
from apc.compiler.language.recordings import TimeTable, read_time_table
from apc.compiler.language.tables import NamedFiles
from apc.compiler.language.values import PEERS, Binding, Value, renamed, settle
from apc.compiler.language.vectors import entries, whole_and_index
from apc.compiler.scene.named_numbers import NamedNumbers
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import among, fault, form, text_of

LINK_ROLES = ("graph", "delays", "loss", "trace")

# What can be set: by the name a person writes, the whole names it stands for.
SettableNames = Mapping[str, list[tuple[str, Settable]]]


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
    values: Named[Value]
    options: Named[str]
    references: Named[str]
    tables: tuple[TimeTable, ...]
    starts: Named[Value]
    connections: Joined
    shared: bool
    groups: tuple[str, ...]
    place: Place

    def reference(self, role: str) -> str | None:
        """Return the clock or link this part names, when it names exactly one."""
        names = {p.name for p in self.component.parameters if isinstance(p, Reference) and p.role == role}
        named = [word for name, word in self.references if name in names]
        return named[0] if len(named) == 1 else None


@dataclass(slots=True)
class PartReader:
    """Reads the entries of parts, one after the other; counts the parts there are so far.

    `counts` are the groups and how many peers each has.
    """

    scope: Scope
    numbers: NamedNumbers
    counts: Mapping[str, int]
    files: NamedFiles
    number_of_parts: int = 0

    def read(self, entry: PartEntry) -> list[Part]:
        """Read a part's entry, once for each element of an array, and write out the parts inside."""
        name, component, mistakes = entry.name, entry.component, self.numbers.mistakes
        shared, groups = False, tuple(self.counts)
        with mistakes:
            shared = self._shared(entry)
        with mistakes:
            groups = self._groups_of(entry)
        roles = [p for p in component.parameters if isinstance(p, Reference) and p.role in LINK_ROLES]
        if roles and entry.section != "links":
            what = f"{name} is a {component.name}, whose {roles[0].name} only a link has"
            mistakes.add("E210", entry.place, what, hint=f"links: {{{name}: …}}")
        peers, due, shown = (
            sum(self.counts[group] for group in groups),
            component.peers,
            f"{name} ({component.name})",
        )
        if component.hears_others and peers == 1:
            what = f"{shown} follows the other peers and"
            hint = f"at: [{', '.join(self.counts)}]" if len(self.counts) > 1 else "count: 2"
            mistakes.add("E208", entry.place, what, expected="at least 2 peers", got="1", hint=hint)
        if due and peers > due:
            hint = f"count: {due}, or groups that make {due}: at: [left, right]"
            mistakes.add("E208", entry.place, shown, expected=f"{due} peers", got=f"{peers:,}", hint=hint)
        parts: list[Part] = []
        for index, element in enumerate(entries(name, entry.count or 0), 1):
            read = read_entry(entry, self.scope, mistakes, index)
            part = Part(
                element,
                entry.section,
                component,
                self.numbers.settled(read.values, component),
                read.options,
                read.references,
                self._tables(entry, dict(read.described)),
                self.numbers.settled(read.starts, component),
                read.connections,
                shared,
                groups,
                entry.place,
            )
            parts += self._with_inner(part)
        return parts

    def _with_inner(self, part: Part) -> list[Part]:
        """Return a part and the parts inside it."""
        self.number_of_parts += 1
        if self.number_of_parts > MOST_PARTS:
            what = f"a peer would have more than {MOST_PARTS} parts, those inside parts included"
            if self.number_of_parts == MOST_PARTS + 1:
                hint = "fewer or smaller arrays and components"
                self.numbers.mistakes.add("E216", part.place, what, hint=hint)
            return [part]
        inner = (_inside(part, inner, self.numbers.peers) for inner in part.component.inner)
        return [part, *(one for part in inner for one in self._with_inner(part))]

    def _tables(self, entry: PartEntry, nodes: Mapping[str, Node]) -> tuple[TimeTable, ...]:
        """Read the files of a part's quantities over time."""
        found = []
        for parameter in entry.component.parameters:
            if isinstance(parameter, Reference) and parameter.role == "table":
                name, unit = parameter.name, parameter.unit
                assert unit is not None
                with self.numbers.mistakes:
                    hint = f"{name}: force.csv"
                    if (node := nodes.get(name)) is None:
                        raise fault("E201", entry.place, f"{entry.name} has no {name}", hint=hint)
                    reader = partial(read_time_table, name=name, unit=unit, named_at=node.place)
                    found.append(self.files.read(text_of(node, name, hint), reader))
        return tuple(table for table in found if table is not None)

    def _shared(self, entry: PartEntry) -> bool:
        """Return whether a part says that it is the copy of one object, which its component allows."""
        if (node := entry.body.get("shared")) is None:
            return False
        if not (isinstance(node, Scalar) and node.plain and isinstance(node.value, bool)):
            raise fault("E203", node.place, "shared", "true or false", form(node), "shared: true")
        if node.value and not any(parameter.divided for parameter in entry.component.numbers):
            what = f"{entry.name} can't be shared: nothing of a {entry.component.name} is divided"
            raise fault("E210", node.place, what)
        return node.value

    def _groups_of(self, entry: PartEntry) -> tuple[str, ...]:
        """Return the groups whose peers have a part."""
        node, name, groups = entry.body.get("at"), entry.name, ", ".join(self.counts)
        if node is None:
            return tuple(self.counts)
        items = node.items if isinstance(node, Sequence) else (node,)
        if entry.section == "links":
            parts = self.scope.parts.entries.values()
            user = next((part.name for part in parts if name in part.words), "coordination")
            what = f"{name} is a link, which joins all peers: who takes part is said by what uses it"
            hint = f"{user}: {{at: [{', '.join(map(form, items)) or groups}]}}"
            raise fault("E211", node.place, what, hint=hint)
        if not (isinstance(node, Sequence) and items):
            got = "an empty one" if isinstance(node, Sequence) else form(node)
            raise fault("E203", node.place, "at", "a list of groups", got, f"at: [{groups}]")
        found = []
        for item in items:
            with self.numbers.mistakes:
                group = text_of(item, "a group")
                what = f"{name} is at {{}}, which is no group of peers"
                found.append(among(group, self.counts, item.place, what))
        return tuple(found)


def _inside(part: Part, inner: Inner, peers: int) -> Part:
    """Return a part inside a part; its numbers are expressions over the outer one's."""
    entry, references = inner.entry, dict(part.references)
    tables = {table.name: table for table in part.tables}
    return replace(
        part,
        name=f"{part.name}.{inner.name}",
        component=inner.component,
        values=_settled_inside(part, entry.values, peers),
        options=entry.options,
        references=tuple(
            (own, references.get(outer, "?")) for own, outer in entry.references if outer not in tables
        ),
        tables=tuple(replace(tables[outer], name=own) for own, outer in entry.references if outer in tables),
        starts=_settled_inside(part, entry.starts, peers),
        connections=tuple(
            (own, GROUND if other == GROUND else f"{part.name}.{other}", its)
            for own, other, its in entry.connections
            if other
        ),
    )


def _settled_inside(part: Part, bindings: Collection[tuple[str, Binding]], peers: int) -> Named[Value]:
    """Return what numbers in terms of an outer part come to, their expressions in whole names."""
    values: dict[tuple[str, ...], Fraction] = {PEERS: Fraction(peers)}
    values |= {(name,): value.number for name, value in part.values}

    def whole(parts: tuple[str, ...]) -> tuple[str, ...]:
        return parts if parts == PEERS else (*part.name.split("."), *parts)

    found = []
    for name, binding in bindings:
        if all(own.parts in values for own in names(binding.expression or Name(PEERS))):
            with Mistakes():
                value = replace(settle(binding, values.__getitem__), place=part.place)
                tree = value.expression
                found.append(
                    (name, value if tree is None else replace(value, expression=renamed(tree, whole)))
                )
    return tuple(found)


def settable_names(parts: Collection[Part]) -> dict[str, list[tuple[str, Settable]]]:
    """Return what a group can set: by the name a person writes, the whole names it stands for.

    The name of an array stands for all its elements: `a[1].b[2]` is one of `a.b[2]`, `a[1].b` and `a.b`.
    """
    found: dict[str, list[tuple[str, Settable]]] = {}
    for part in parts:
        items: list[Settable] = [
            p for p in part.component.parameters if not isinstance(p, Reference) or p.role == "clock"
        ]
        items += [v for v in part.component.variables if v.start is not None]
        elements = product(
            *(dict.fromkeys((name, whole_and_index(name)[0])) for name in part.name.split("."))
        )
        for name in map(".".join, elements):
            for item in items:
                found.setdefault(f"{name}.{item.name}", []).append((f"{part.name}.{item.name}", item))
    return found
