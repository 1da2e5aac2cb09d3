"""Groups of peers: their counts and their settings.

Takes: the `peers` section. Gives: `read_counts`, a `GroupBody` per group; `GroupReader`, a `GroupDeclaration`
per group once the parts are known.
Guarantees: a list or table of settings has one value a peer, each with the right unit and within bounds; a
number inside a part that is an expression over one the group sets has the group's value, within its bounds,
and keeps its expression; what the group sets itself stays.
Does not: know sections other than `peers`; follow numbers that differ from peer to peer: whoever reads
columns computes what depends on them.
"""

from __future__ import annotations

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
    text_of,
    unknown,
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
    """A group before its settings are read; `counted` is its count where that follows from named numbers."""

    name: str
    count: int
    body: MappingReader
    table: Table | None
    counted: ScalarValue | None


@dataclass(frozen=True, slots=True, eq=False)
class GroupDeclaration:
    """`count` peers.

    `values` are the group's own settings by whole name (`contact.stiffness`) and what follows from them
    inside parts, `words` its own options and clocks, `columns` settings that differ from peer to peer,
    `counted` its count where that follows from named numbers, `types` the parts of another type, all of whose
    numbers are the group's own.
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
    """Read the number of peers of each group.

    A group has a `count`, or a `table` with one row per peer, or lists in `set` with one value per peer.

    Parameters
    ----------
    root
        The topology.
    files
        Reads its tables.
    """
    result: dict[str, GroupBody] = {}
    example = "{user: {count: 3}}"
    section, peers = root.section("peers", example), root.nodes.get("peers")
    if isinstance(peers, MappingNode) and not section:
        root.mistakes.add("E201", peers.location, "peers names no group", hint=f"peers: {example}")
    with root.mistakes:
        if peers is not None and len(section) > MOST_GROUPS:
            hint = "one group, {table: users.csv}, with a row a peer"
            got = f"{len(section):,}"
            raise fault("E208", peers.location, "peers", f"at most {MOST_GROUPS} groups", got, hint)
        for key, value in section:
            with root.mistakes:
                name = name_of(key, "a group of peers")
                group = "user" if name == "count" else name  # a number of peers instead of a group
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


def _count(name: str, body: MappingReader, table: Table | None, counted: ScalarValue | None) -> int:
    """Return the number of peers of a group from its count, its table or its lists."""
    node, settings = body.nodes.get("count"), body.nodes.get("set")
    if node is None:
        if table is not None:
            return table.rows
        for _, value in settings.entries if isinstance(settings, MappingNode) else ():
            if isinstance(value, Sequence) and value.items:
                return len(value.items)
        if "table" in body.nodes:
            raise AlreadyReportedError
        raise fault("E201", body.location, f"group {name} has no count", hint="count: 3")
    count, got = whole_number(node), form(node)
    if counted is not None:
        count = int(counted.number) if counted.number.denominator == 1 else None
        got += f", which is {float(counted.number):.12g}"
    if count is None or not 1 <= count <= LARGEST_COUNT:
        expected = f"a whole number from 1 to {LARGEST_COUNT}"
        raise fault("E208", node.location, "count", expected, got, "count: 3")
    if table is not None and table.rows != count:
        message = f"group {name} has a count of {count} and a table of {table.rows} rows"
        raise fault("E208", node.location, message, hint=f"count: {table.rows}")
    return count


@dataclass(frozen=True, slots=True)
class GroupReader:
    """Reads the settings of groups.

    `settable` are the settable declarations, by the name in the topology; `parts` are all parts of the
    topology, each before the parts inside it; `redeclared` are the names of parts with another type at a
    group, by group; `explain` raises a more specific error for a name that can't be set, if there is one.
    """

    settable: SettableNames
    parts: Collection[PartInstance]
    redeclared: Mapping[str, Collection[str]]
    clocks: Collection[str]
    numbers: NamedNumbers
    explain: Callable[[str, SourceLocation], None]

    def read(self, group: GroupBody) -> GroupDeclaration:
        """Read the settings of a group, and their dependent values."""
        values: dict[str, ScalarValue] = {}
        words: dict[str, str] = {}
        columns: dict[str, NDArray[np.float64]] = {}
        mistakes, table = self.numbers.mistakes, group.table
        for key, node in self._entry_by_entry(group):
            with mistakes:
                message = f"set names {brief(key.text)}, which is no parameter or variable of a part"
                if isinstance(node, MappingNode) and any(part.name == key.text for part in self.parts):
                    pairs = [
                        (local.text, scalar.text)
                        for local, scalar in node.entries
                        if isinstance(scalar, Scalar)
                    ]
                    hint = ", ".join(f"{key.text}.{name}: {value}" for name, value in pairs)
                    raise fault("E206", key.location, message, hint=hint)
                item, wholes = self._settable(key.text, key.location, group.name, "E206", message)
                if isinstance(item, Option | Reference):
                    words |= dict.fromkeys(wholes, self._word(node, key.text, item))
                elif isinstance(node, Sequence):
                    columns |= dict.fromkeys(wholes, self._listed(node, key.text, item, group.count))
                else:
                    values |= dict.fromkeys(wholes, self.numbers.read_for(node, key.text, item))
        for column in () if table is None else table.columns:
            with mistakes:
                message = f"a heading names {brief(column.name)}, which is no number of a part"
                item, wholes = self._settable(column.name, column.location, group.name, "E702", message)
                for whole in wholes:
                    if whole in columns or whole in values:
                        mistakes.add("E702", column.location, f"{whole} is given by set and by the table")
                columns |= dict.fromkeys(wholes, column.numbers)
                assert table is not None and isinstance(item, NumberParameter | ComponentVariable)
                _check_column(column, table.lines, item, mistakes)
        self._add_followers(values, words, columns, group)
        types = {}
        for part in self._parts_at(group):
            if group.name in self.redeclared.get(whole_and_index(part.name.partition(".")[0])[0], ()):
                if "." not in part.name:
                    types[part.name] = part.component.name
                for name, value in (*part.values, *part.all_starts):
                    if (whole := f"{part.name}.{name}") not in columns:
                        values.setdefault(whole, value)
        settings = tuple(values.items()), tuple(words.items()), tuple(columns.items())
        location, local_types = group.body.location, tuple(types.items())
        return GroupDeclaration(group.name, group.count, *settings, location, group.counted, local_types)

    def _parts_at(self, group: GroupBody) -> list[PartInstance]:
        """Return the parts that a group's peers have."""
        return [part for part in self.parts if group.name in part.groups]

    def _settable(
        self, name: str, location: SourceLocation, group: str, code: str, message: str
    ) -> tuple[Settable, list[str]]:
        """Return the meaning of a name, with its qualified names; in a heading (E702) only a number."""
        kinds = (
            (NumberParameter, ComponentVariable)
            if code == "E702"
            else (NumberParameter, ComponentVariable, Option, Reference)
        )
        item, wholes = self.settable.get(name, (None, []))
        if not isinstance(item, kinds):
            self.explain(name, location)
            known = [known for known, (other, _) in self.settable.items() if isinstance(other, kinds)]
            known += [f"{part.name}.type" for part in self.parts if code == "E206" and "." not in part.name]
            raise unknown(code, location, message, name, known)
        part = wholes[0].rpartition(".")[0]
        at = [name for item in self.parts if item.name == part for name in item.groups]
        if at and group not in at:
            message = f"{group} sets {name} and has no {part}, which is at {', '.join(at)}"
            raise fault("E211", location, message, hint=f"at: [{', '.join((*at, group))}]")
        return item, wholes

    def _entry_by_entry(self, group: GroupBody) -> Iterator[tuple[Scalar, Node]]:
        """Yield the settings of a group, a vector by its entries.

        A list of a vector's entries is that vector at each peer; a list of such lists has one a peer.
        """
        for key, node in group.body.section("set", "{device.mass: 0.2 kg}"):
            if group.name in self.redeclared.get(key.text.removesuffix(".type"), ()):
                continue  # it was read before the parts
            size = next((k for k in reversed(SIZES) if entry(key.text, k) in self.settable), 0)
            if not size:
                yield key, node
                continue
            item, _ = self.settable[entry(key.text, 1)]
            assert isinstance(item, NumberParameter | ComponentVariable)
            text = f"1 {item.unit.text}".removesuffix(" 1")
            nested = isinstance(node, Sequence) and any(isinstance(item, Sequence) for item in node.items)
            if not nested and group.table is None and "count" not in group.body.nodes:
                message = (
                    f"{key.text} is a vector of {size}, and its list doesn't tell how many peers there are"
                )
                self.numbers.mistakes.add("E201", node.location, message, hint="count: 3")
            with self.numbers.mistakes:
                rows = node.items if nested and isinstance(node, Sequence) else (node,)
                columns = zip(*(list_of(row, key.text, size, text) for row in rows), strict=True)
                for name, column in zip(entries(key.text, size), columns, strict=True):
                    yield replace(key, text=name), Sequence(column, node.location) if nested else column[0]

    def _word(self, node: Node, subject: str, item: Option | Reference) -> str:
        """Read an option, or the name of a clock."""
        role, known = ("option", item.words) if isinstance(item, Option) else ("clock", self.clocks)
        word = text_of(node, subject, f"{subject}: {next(iter(known), 'name')}")
        return among(word, known, node.location, f"{subject} has no {role} {{}}")

    def _listed(self, node: Sequence, subject: str, item: Settable, count: int) -> NDArray[np.float64]:
        """Read a list with a number a peer."""
        if len(node.items) != count:
            expected, got = f"a value a peer, {count} in all", f"{len(node.items)}"
            raise fault("E208", node.location, f"the list of {subject}", expected, got)
        return np.array(
            [float(self.numbers.read_for(candidate, subject, item).number) for candidate in node.items]
        )

    def _add_followers(
        self,
        values: dict[str, ScalarValue],
        words: dict[str, str],
        columns: Collection[str],
        group: GroupBody,
    ) -> None:
        """Add the values that depend on a group's settings, inside the affected parts."""
        known: dict[str, ScalarValue] = {}
        location = group.body.location
        for part in self._parts_at(group):
            known |= {f"{part.name}.{name}": value for name, value in (*part.values, *part.starts)}
            for inner in part.component.inner:  # which takes its clocks over from the outer part
                for local, outer in inner.entry.references:
                    if (word := words.get(f"{part.name}.{outer}")) is not None:
                        words.setdefault(f"{part.name}.{inner.name}.{local}", word)

        def number(parts: tuple[str, ...]) -> Fraction:
            value = values.get(name := ".".join(parts), known.get(name))
            return self.numbers.number(parts) if value is None else value.number

        for whole, value in known.items():  # of an outer part before those inside it
            tree = value.expression
            if tree is None or whole in values or whole in columns:
                continue
            if any(".".join(node.parts) in values for node in names(tree)):
                with self.numbers.mistakes:
                    follows = Fraction(evaluate(tree, number, location))
                    values[whole] = replace(value, number=follows, location=location)
                    if isinstance(item := self.settable[whole][0], NumberParameter):
                        item.bounds.check(values[whole], whole, self.numbers.mistakes)


def _check_column(
    column: CsvColumn, lines: tuple[int, ...], item: NumberParameter | ComponentVariable, mistakes: Mistakes
) -> None:
    """Check a column's unit, and each of its numbers against the parameter's bounds."""
    dimension, due = column.unit.dimension, item.unit.dimension
    if dimension != due or dimension.clashes(due):
        expected = format_dimension(due)
        got = f"[{column.unit.text}]" if column.unit.text != "1" else "no unit"
        hint = f"{column.name} [{item.unit.text}]"
        if dimension.clashes(due):
            hint += f", each {'divided by' if expected == 'Hz' else 'times'} 2*pi"
        raise fault("E702", column.location, f"the heading {column.name}", f"[{expected}]", got, hint)
    if isinstance(item, NumberParameter):
        bounds, rows = item.bounds, zip(lines, map(Fraction, column.numbers.tolist()), strict=True)
        wrong = ((line, number) for line, number in rows if bounds.fault(number))
        for line, number in islice(wrong, MOST_FAULTS):
            value = ScalarValue(number, due, None, SourceLocation(column.location.file, line, 1))
            bounds.check(value, column.name, mistakes)
