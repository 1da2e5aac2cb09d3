"""Groups of peers: their counts and their settings.

Takes: the `peers` section. Gives: `read_counts`, a `GroupBody` per group; `GroupReader`, a `GroupDeclaration`
per group once the parts are known.
Guarantees: a list or table of settings has one value per peer, with the right unit and within bounds. A
number inside a part that is an expression over a number set by the group has the value for this group, within
its bounds, and keeps its expression; numbers set by the group remain.
Does not: read sections other than `peers`; compute the numbers that depend on columns: the reader of the
columns computes them for each peer.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import LARGEST_COUNT, MOST_GROUPS
from apc.compiler.components.component import (
    ComponentVariable,
    Named,
    NumberParameter,
    Option,
    Reference,
    Settable,
)
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.csv_tables import CsvColumn, NamedFiles, Table, read_table
from apc.compiler.language.evaluation import evaluate
from apc.compiler.language.expression import names
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.language.vectors import SIZES, entries, entry, whole_and_index
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import (
    MappingReader,
    among,
    brief,
    fault,
    form,
    list_of,
    mapping_of,
    name_of,
    named,
    unknown,
    value_of,
    whole_number,
)
from apc.compiler.topology.instances import PartInstance, SettableNames
from apc.compiler.topology.topology_parameters import NamedNumbers, read_count_by_names

MOST_FAULTS = 5  # number of values of a column that are printed
GROUP = (
    "count",
    "set",
    "table",
)
# How a count begins that is no number, word of YAML or quantity: with a name, or a parenthesis before one.
_IN_NAMES = re.compile(
    r"\(*\s*(?!(true|false|null)\Z)[A-Za-z]\w*|[0-9]+\s*[-+*/]\s*\(*\s*[A-Za-z]\w*", re.ASCII
)

# By whole name, one number a peer, in SI.
Columns = tuple[tuple[str, NDArray[np.float64]], ...]


@dataclass(frozen=True, slots=True)
class GroupBody:
    """A group before its settings are read: its name, count and mapping, and its table, if any.

    `counted` is the value of the count if the count is an expression, else None.
    """

    name: str
    count: int
    body: MappingReader
    table: Table | None
    counted: ScalarValue | None


@dataclass(frozen=True, slots=True, eq=False)
class GroupDeclaration:
    """A group of `count` peers.

    `values` has the numbers set by the group and the numbers that depend on them inside parts, by qualified
    name (`contact.stiffness`); `words` its options and clocks; `columns` the settings with one value per
    peer; `counted` its count if that is an expression; `types` the parts with another component type, with
    all their numbers in `values`.
    """

    name: str
    count: int
    values: Named[ScalarValue]
    words: Named[str]
    columns: Columns
    location: SourceLocation
    counted: ScalarValue | None = None
    types: Named[str] = ()


def read_counts(root: MappingReader, files: NamedFiles) -> dict[str, GroupBody]:
    """Return the groups of peers by name, with the number of peers of each.

    A group has a `count`, or a `table` with one row per peer, or lists in `set` with one value per peer.

    Parameters
    ----------
    root
        The topology.
    files
        The reader of the topology's tables.
    """
    result: dict[str, GroupBody] = {}
    example = "{user: {count: 3}}"
    section, peers = root.section("peers", example), root.nodes.get("peers")
    if isinstance(peers, MappingNode) and not section:
        root.mistakes.add("E201", peers.location, "peers: no group is defined", fix=f"peers: {example}")
    with root.mistakes:
        if peers is not None and len(section) > MOST_GROUPS:
            advice = "use one group with {table: users.csv} and one row for each peer"
            got = f"{len(section):,}"
            raise fault("E208", peers.location, "peers", f"at most {MOST_GROUPS} groups", got, advice=advice)
        for key, value in section:
            with root.mistakes:
                name = name_of(key, "a group of peers")
                group = "user" if name == "count" else name  # `peers: {count: 3}` has no name of a group
                number = value.text if isinstance(value, Scalar) and value.text.isdecimal() else "3"
                node = mapping_of(value, name, f"{group}: {{count: {number}}}")
                body = MappingReader(node, GROUP, f"group {name}", root.mistakes)
                table, counted = None, None
                if text := body.text("table", "table: users.csv"):
                    table = files.read(text, partial(read_table, named_at=body.nodes["table"].location))
                count = body.nodes.get("count")
                if isinstance(count, Scalar) and count.plain and _IN_NAMES.match(count.text):
                    counted = read_count_by_names(count, root)
                result[name] = GroupBody(name, _count(name, body, table, counted), body, table, counted)
    return result


def _count(name: str, body: MappingReader, table: Table | None, computed: ScalarValue | None) -> int:
    """Return the number of peers of a group, from its count, its table or its lists.

    Parameters
    ----------
    name, body
        The name of the group, and its mapping in the topology.
    table
        The table with one row per peer, if any.
    computed
        The value of the count if that is an expression, else None.

    Raises
    ------
    ApcError
        The group has no valid count.
    """
    node, settings = body.nodes.get("count"), body.nodes.get("set")
    if node is None:
        if table is not None:
            return table.rows
        for _, value in settings.entries if isinstance(settings, MappingNode) else ():
            if isinstance(value, Sequence) and value.items:
                return len(value.items)
        if "table" in body.nodes:
            raise AlreadyReportedError
        raise fault("E201", body.location, f"group {name} has no count", fix="count: 3")
    count, got = whole_number(node), form(node)
    if computed is not None:
        count = int(computed.number) if computed.number.denominator == 1 else None
        got += f", which is {float(computed.number):.12g}"
    if count is None or not 1 <= count <= LARGEST_COUNT:
        expected = f"a whole number from 1 to {LARGEST_COUNT:,}"
        raise fault("E208", node.location, "count", expected, got, _nearest_counts(node))
    if table is not None and table.rows != count:
        message = f"group {name} has a count of {count} and a table of {table.rows} rows"
        raise fault("E208", node.location, message, fix=f"count: {table.rows}")
    return count


def _nearest_counts(node: Node) -> str:
    """Return the fix for an invalid count: the nearest valid ones; empty if it is no number or too large."""
    value = node.value if isinstance(node, Scalar) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not value <= LARGEST_COUNT:
        return ""
    if value < 1:
        return f"count: {-value}" if isinstance(value, int) and 1 <= -value <= LARGEST_COUNT else ""
    counts = dict.fromkeys((math.floor(value), math.ceil(value)))
    return ", or ".join(f"count: {count}" for count in counts)


@dataclass(frozen=True, slots=True)
class GroupReader:
    """Reads the settings of groups.

    `settable` has the settable declarations by written name; `parts` are all parts of the topology, an outer
    part before its inner parts; `redeclared` are the names of parts with another type at a group, by group;
    `explain` raises a more specific error for a name that a group can't set, if there is one.
    """

    settable: SettableNames
    parts: Collection[PartInstance]
    redeclared: Mapping[str, Collection[str]]
    clocks: Collection[str]
    numbers: NamedNumbers
    explain: Callable[[str, SourceLocation, str, str], None]

    def read(self, group: GroupBody) -> GroupDeclaration:
        """Return the declaration of a group: its settings, and the numbers that depend on them."""
        values: dict[str, ScalarValue] = {}
        words: dict[str, str] = {}
        columns: dict[str, NDArray[np.float64]] = {}
        mistakes, table = self.numbers.mistakes, group.table
        for key, node in self._entry_by_entry(group):
            with mistakes:
                message, whole = f"set: unknown name {named(key.text)}", f"set: {brief(key.text)} is a part"
                if isinstance(node, MappingNode) and any(part.name == key.text for part in self.parts):
                    pairs = [
                        (parameter.text, scalar.text)
                        for parameter, scalar in node.entries
                        if isinstance(scalar, Scalar)
                    ]
                    fix = ", ".join(f"{key.text}.{name}: {value}" for name, value in pairs)
                    raise fault("E206", key.location, f"{whole}, not a parameter", fix=fix)
                if listed := [name for name in self.settable if name.startswith(f"{key.text}.")]:
                    raise unknown("E206", key.location, f"{whole}, not a parameter", "", listed)
                given = node.text if isinstance(node, Scalar) else "…"
                item, qualified_names = self._settable(
                    key.text, key.location, group.name, "E206", message, given
                )
                if isinstance(item, Option | Reference):
                    words |= dict.fromkeys(qualified_names, self._word(node, key.text, item))
                elif isinstance(node, Sequence):
                    columns |= dict.fromkeys(
                        qualified_names, self._per_peer_values(node, key.text, item, group.count)
                    )
                else:
                    values |= dict.fromkeys(qualified_names, self.numbers.read_for(node, key.text, item))
        for column in () if table is None else table.columns:
            with mistakes:
                message = f"heading: unknown name {named(column.name)}"
                item, qualified_names = self._settable(
                    column.name, column.location, group.name, "E702", message
                )
                for whole in qualified_names:
                    if whole in columns or whole in values:
                        mistakes.add(
                            "E702", column.location, f"{whole} is given both by set and by the table"
                        )
                columns |= dict.fromkeys(qualified_names, column.numbers)
                assert table is not None and isinstance(item, NumberParameter | ComponentVariable)
                _check_column(column, table.lines, item, mistakes)
        self._add_dependent_values(values, words, columns, group)
        types = {}
        for part in self._parts_at(group):
            if group.name in self.redeclared.get(whole_and_index(part.name.partition(".")[0])[0], ()):
                if "." not in part.name:
                    types[part.name] = part.component.name
                for name, value in (*part.values, *part.all_starts):
                    if (whole := f"{part.name}.{name}") not in columns:
                        values.setdefault(whole, value)
        settings = tuple(values.items()), tuple(words.items()), tuple(columns.items())
        location, changed_types = group.body.location, tuple(types.items())
        return GroupDeclaration(group.name, group.count, *settings, location, group.counted, changed_types)

    def _parts_at(self, group: GroupBody) -> list[PartInstance]:
        """Return the parts of a group's peers."""
        return [part for part in self.parts if group.name in part.groups]

    def _settable(
        self, name: str, location: SourceLocation, group: str, code: str, message: str, value: str = "…"
    ) -> tuple[Settable, list[str]]:
        """Return the declaration of a settable name, and the qualified names it represents.

        Parameters
        ----------
        name, location, group
            The name, its location, and the group that sets it.
        code, message
            The error for an unknown name. A heading of a table (E702) can name only a number.
        value
            The value as written, for messages.

        Raises
        ------
        ApcError
            The name is unknown, or belongs to a part that the group does not have.
        """
        kinds = (
            (NumberParameter, ComponentVariable)
            if code == "E702"
            else (NumberParameter, ComponentVariable, Option, Reference)
        )
        declaration, qualified_names = self.settable.get(name, (None, []))
        if not isinstance(declaration, kinds):
            self.explain(name, location, group, value)
            known = [written for written, (other, _) in self.settable.items() if isinstance(other, kinds)]
            known += [f"{part.name}.type" for part in self.parts if code == "E206" and "." not in part.name]
            raise unknown(code, location, message, name, known)
        part = qualified_names[0].rpartition(".")[0]
        at = [where for owner in self.parts if owner.name == part for where in owner.groups]
        if at and group not in at:
            message = f"{group} sets {name}, but {part} is only at {', '.join(at)}"
            raise fault("E211", location, message, fix=f"at: [{', '.join((*at, group))}]")
        return declaration, qualified_names

    def _entry_by_entry(self, group: GroupBody) -> Iterator[tuple[Scalar, Node]]:
        """Yield the settings of a group as key and value, a vector as its entries.

        A list of a vector's entries is the vector of every peer; a list of vectors has one vector per peer.
        """
        for key, node in group.body.section("set", "{device.mass: 0.2 kg}"):
            if group.name in self.redeclared.get(key.text.removesuffix(".type"), ()):
                continue  # component types were read before the parts
            size = next((k for k in reversed(SIZES) if entry(key.text, k) in self.settable), 0)
            if not size:
                yield key, node
                continue
            declaration, _ = self.settable[entry(key.text, 1)]
            assert isinstance(declaration, NumberParameter | ComponentVariable)
            text = f"1 {declaration.unit.text}".removesuffix(" 1")
            nested = isinstance(node, Sequence) and any(
                isinstance(declaration, Sequence) for declaration in node.items
            )
            if not nested and group.table is None and "count" not in group.body.nodes:
                message = (
                    f"group {group.name} has no count, and {key.text} is one vector, not a list of vectors"
                )
                self.numbers.mistakes.add("E201", node.location, message, fix="count: 3")
            with self.numbers.mistakes:
                rows = node.items if nested and isinstance(node, Sequence) else (node,)
                subjects = [entry(key.text, k + 1) for k in range(len(rows))] if nested else [key.text]
                vectors = (
                    list_of(row, subject, size, text, "" if nested else key.text)
                    for row, subject in zip(rows, subjects, strict=True)
                )
                columns = zip(*vectors, strict=True)
                for name, column in zip(entries(key.text, size), columns, strict=True):
                    yield replace(key, text=name), Sequence(column, node.location) if nested else column[0]

    def _word(self, node: Node, subject: str, declaration: Option | Reference) -> str:
        """Return the option or the clock named by a node. Raises ApcError for an unknown word."""
        role, known = (
            ("option", declaration.words) if isinstance(declaration, Option) else ("clock", self.clocks)
        )
        word = value_of(node, subject, next(iter(known), "name"))
        return among(word, known, node.location, f"{subject}: unknown {role} {{}}")

    def _per_peer_values(
        self, node: Sequence, subject: str, declaration: Settable, count: int
    ) -> NDArray[np.float64]:
        """Return the values (count,) of a list with one number per peer, in SI units.

        `declaration` has the unit and the bounds of the numbers; `subject` is their name for messages.
        """
        if len(node.items) != count:
            expected, got = f"{count} values, one for each peer", f"{len(node.items)}"
            raise fault("E208", node.location, f"list of {subject}", expected, got)
        return np.array(
            [
                float(self.numbers.read_for(entry_node, _of_peer(subject, index), declaration).number)
                for index, entry_node in enumerate(node.items, 1)
            ]
        )

    def _add_dependent_values(
        self,
        values: dict[str, ScalarValue],
        words: dict[str, str],
        columns: Collection[str],
        group: GroupBody,
    ) -> None:
        """Add the numbers and clocks inside a group's parts that depend on the settings of the group.

        Parameters
        ----------
        values, words
            The numbers and the options and clocks of the group, by qualified name; the dependent ones are
            added.
        columns
            The qualified names with one value per peer, which are omitted.
        group
            The group.
        """
        known: dict[str, ScalarValue] = {}
        location = group.body.location
        for part in self._parts_at(group):
            known |= {f"{part.name}.{name}": value for name, value in (*part.values, *part.starts)}
            for inner in part.component.inner:  # an inner part has the clocks of the outer part
                for reference, outer in inner.entry.references:
                    if (word := words.get(f"{part.name}.{outer}")) is not None:
                        words.setdefault(f"{part.name}.{inner.name}.{reference}", word)

        def number(parts: tuple[str, ...]) -> Fraction:
            """Return the number of a name: set by the group, else of a part, else of the topology."""
            value = values.get(name := ".".join(parts), known.get(name))
            return self.numbers.number(parts) if value is None else value.number

        for (
            qualified,
            value,
        ) in known.items():  # the numbers of an outer part come before those of its inner parts
            tree = value.expression
            if tree is None or qualified in values or qualified in columns:
                continue
            if any(".".join(node.parts) in values for node in names(tree)):
                with self.numbers.mistakes:
                    new_number = Fraction(evaluate(tree, number, location))
                    values[qualified] = replace(value, number=new_number, location=location)
                    if isinstance(item := self.settable[qualified][0], NumberParameter):
                        item.bounds.check(values[qualified], qualified, self.numbers.mistakes)


def _of_peer(subject: str, index: int) -> str:
    """Return the name of the number of one peer, with an index from 1; an entry of a vector is unchanged."""
    return subject if subject.endswith("]") else entry(subject, index)


def _check_column(
    column: CsvColumn,
    lines: tuple[int, ...],
    declaration: NumberParameter | ComponentVariable,
    mistakes: Mistakes,
) -> None:
    """Check the unit of a column of a table, and its numbers against the bounds of their declaration.

    `lines` are the lines of the rows in the file. Raises ApcError E702 for a wrong unit; wrong numbers are
    added to `mistakes`.
    """
    dimension, required = column.unit.dimension, declaration.unit.dimension
    if dimension != required or dimension.clashes(required):
        expected = format_dimension(required)
        got = f"[{column.unit.text}]" if column.unit.text != "1" else "no unit"
        fix, advice = f"{column.name} [{declaration.unit.text}]", ""
        if dimension.clashes(required):
            advice = f"{'divide' if expected == 'Hz' else 'multiply'} each number by 2*pi"
        raise fault("E702", column.location, f"heading {column.name}", f"[{expected}]", got, fix, advice)
    if isinstance(declaration, NumberParameter):
        bounds, rows = declaration.bounds, zip(lines, map(Fraction, column.numbers.tolist()), strict=True)
        invalid = ((line, number) for line, number in rows if bounds.fault(number))
        for line, number in islice(invalid, MOST_FAULTS):
            value = ScalarValue(number, required, None, SourceLocation(column.location.file, line, 1))
            bounds.check(value, column.name, mistakes)
