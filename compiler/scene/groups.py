"""Groups of peers: how many, and what each sets for itself.

Takes: the `peers` section. Gives: `GroupBody` (counts), then `Settings` once the parts are known;
`with_followers`, what depends on them inside the parts that they set.
Guarantees: a list or table of settings has one value a peer, each with the right unit and within bounds; a
number inside a part that is an expression over one the group sets has the group's value, within its bounds,
and keeps its expression; what the group sets itself stays.
Does not: know sections other than `peers`; follow numbers that differ from peer to peer: whoever reads
columns computes what depends on them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from collections.abc import Sequence as SequenceType
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import LARGEST_COUNT, MOST_GROUPS
from apc.compiler.components.component import Number, Option, Reference, Settable, Variable
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.language.evaluation import evaluate
from apc.compiler.language.expression import names
from apc.compiler.language.tables import Column, NamedFiles, Table, read_table
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import PEERS, Value
from apc.compiler.language.vectors import SIZES, entry
from apc.compiler.language.vectors import entries as vector_entries
from apc.compiler.scene.instances import Part
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    form,
    listed,
    read_mapping,
    read_name,
    read_text,
    whole_number,
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
    body: MappingNode
    table: Table | None
    counted: Value | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """What a group sets: numbers, words (options and clocks), and numbers that differ from peer to peer."""

    values: tuple[tuple[str, Value], ...]
    words: tuple[tuple[str, str], ...]
    columns: Columns


def read_counts(
    node: Node | None, files: NamedFiles, read_named: Callable[[Node], Value | None]
) -> dict[str, GroupBody]:
    """Read how many peers each group has.

    A group says `count`, or has a `table` with a row a peer, or lists in `set` with a value a peer.

    Parameters
    ----------
    node
        The section `peers`.
    files
        Reads its tables, and takes what is at fault.
    read_named
        Reads a count that names numbers; None if it is at fault, which was reported.
    """
    mistakes = files.mistakes
    found: dict[str, GroupBody] = {}
    hint = "peers: {user: {count: 3}}"
    section = read_mapping(node, "peers", mistakes, hint=hint)
    if section is not None and not section.entries:
        mistakes.add("E201", section.place, "peers names no group", hint=hint)
    if section is not None and len(section.entries) > MOST_GROUPS:
        got, expected = f"{len(section.entries):,}", f"at most {MOST_GROUPS} groups"
        hint = "one group, {table: users.csv}, with a row a peer"
        mistakes.add("E208", section.place, "peers", expected=expected, got=got, hint=hint)
        return found
    for key, value in entries(section):
        name = read_name(key, "a group of peers", mistakes)
        body = read_mapping(value, key.text, mistakes, hint=f"{key.text}: {{count: 3}}")
        if name is None or body is None:
            continue
        body = check_keys(body, ("count", "set", "table"), f"group {name}", mistakes)
        table = _read_table(body.get("table"), files)
        node = body.get("count")
        if isinstance(node, Scalar) and node.plain and _IN_NAMES.match(node.text):
            counted = read_named(node)
            count = None if counted is None else _counted(counted, node, name, table, mistakes)
        else:
            counted, count = None, _read_count(body, name, table, mistakes)
        if count is not None:
            found[name] = GroupBody(name, count, body, table, counted)
    return found


def _read_table(node: Node | None, files: NamedFiles) -> Table | None:
    text = read_text(node, "table", files.mistakes, hint="table: users.csv")
    if node is None or text is None:
        return None
    return files.read(text, lambda path: read_table(path, node.place))


def _read_count(body: MappingNode, name: str, table: Table | None, mistakes: Mistakes) -> int | None:
    node = body.get("count")
    if node is None:
        if table is not None:
            return table.rows
        settings = body.get("set")
        lists = [
            len(value.items)
            for _, value in (settings.entries if isinstance(settings, MappingNode) else ())
            if isinstance(value, Sequence) and value.items
        ]
        if lists:
            return lists[0]
        if body.get("table") is None:
            mistakes.add("E201", body.place, f"group {name} has no count", hint="count: 3")
        return None
    return _allowed_count(whole_number(node), node, form(node), name, table, mistakes)


def _counted(counted: Value, node: Node, name: str, table: Table | None, mistakes: Mistakes) -> int | None:
    """Return the count that an expression over named numbers comes to."""
    number = counted.number
    got = f"{form(node)}, which is {float(number):.12g}"
    whole = int(number) if number.denominator == 1 else None
    return _allowed_count(whole, node, got, name, table, mistakes)


def _allowed_count(
    count: int | None, node: Node, got: str, name: str, table: Table | None, mistakes: Mistakes
) -> int | None:
    if count is not None and 1 <= count <= LARGEST_COUNT:
        if table is not None and table.rows != count:
            what = f"group {name} has a count of {count} and a table of {table.rows} rows"
            mistakes.add("E208", node.place, what, hint=f"count: {table.rows}")
            return None
        return count
    expected = f"a whole number from 1 to {LARGEST_COUNT}"
    mistakes.add("E208", node.place, "count", expected=expected, got=got, hint="count: 3")
    return None


def read_settings(
    group: GroupBody,
    settable: Mapping[str, list[tuple[str, Settable]]],
    places: Mapping[str, Collection[str]],
    clocks: Collection[str],
    read_number: Callable[[Node, str, Settable], Value | None],
    explained: Callable[[str, Place], bool],
    mistakes: Mistakes,
) -> Settings:
    """Read what a group sets.

    Parameters
    ----------
    group
        The group.
    settable
        What can be set: by the name a person writes, the whole names it stands for.
    places
        The groups that have each part.
    clocks
        The clocks of the scene.
    read_number
        Reads a value for what is set.
    explained
        Says of a name that can't be set, and its place, whether a better message than ours was given.
    mistakes
        Where faults go.
    """
    values: list[tuple[str, Value]] = []
    words: list[tuple[str, str]] = []
    columns: dict[str, NDArray[np.float64]] = {}
    section = read_mapping(group.body.get("set"), "set", mistakes, hint="set: {device.mass: 0.2 kg}")
    for key, node in _entry_by_entry(section, group, settable, mistakes):
        items = settable.get(key.text)
        if items is None and explained(key.text, key.place):
            continue
        if items is None:
            what = f"set names {brief(key.text)}, which is no parameter or variable of a part"
            add_unknown("E206", key.place, what, key.text, list(settable), mistakes)
            continue
        if _is_elsewhere(items, key.text, key.place, group.name, places, mistakes):
            continue
        for whole, item in items:
            if isinstance(item, Option | Reference):
                word = _word(node, key.text, item, clocks, mistakes)
                if word is not None:
                    words.append((whole, word))
            elif isinstance(node, Sequence):
                column = _listed(node, key.text, item, group.count, read_number, mistakes)
                if column is not None:
                    columns[whole] = column
            elif (value := read_number(node, key.text, item)) is not None:
                values.append((whole, value))
    for column_ in group.table.columns if group.table is not None else ():
        items = settable.get(column_.name)
        if items and _is_elsewhere(items, column_.name, column_.place, group.name, places, mistakes):
            continue
        for whole, item in _items_of(column_, settable, explained, mistakes):
            if whole in columns or whole in dict(values):
                mistakes.add("E702", column_.place, f"{whole} is given by set and by the table")
            columns[whole] = column_.numbers
            _check_column(column_, group.table.lines if group.table is not None else (), item, mistakes)
    return Settings(tuple(values), tuple(words), tuple(columns.items()))


def _is_elsewhere(
    items: SequenceType[tuple[str, Settable]],
    name: str,
    place: Place,
    group: str,
    places: Mapping[str, Collection[str]],
    mistakes: Mistakes,
) -> bool:
    """Record what a group sets of a part that it doesn't have; return whether that is so."""
    part = items[0][0].rpartition(".")[0]
    if group in places[part] or not places[part]:
        return False
    what = f"{group} sets {name} and has no {part}, which is at {', '.join(places[part])}"
    mistakes.add("E211", place, what, hint=f"at: [{', '.join((*places[part], group))}]")
    return True


def _entry_by_entry(
    section: MappingNode | None,
    group: GroupBody,
    settable: Mapping[str, list[tuple[str, Settable]]],
    mistakes: Mistakes,
) -> Iterator[tuple[Scalar, Node]]:
    """Yield what a group sets, a vector as its entries.

    A list of a vector's entries is that vector at each peer; a list of such lists has one a peer.
    """
    for key, node in entries(section):
        size = next((k for k in reversed(SIZES) if entry(key.text, k) in settable), 0)
        if not size:
            yield key, node
            continue
        unit = next(i.unit.text for _, i in settable[entry(key.text, 1)] if isinstance(i, Number | Variable))
        one = f"1 {unit}".removesuffix(" 1")
        nested = isinstance(node, Sequence) and any(isinstance(item, Sequence) for item in node.items)
        rows = node.items if nested and isinstance(node, Sequence) else (node,)
        values = [listed(row, key.text, size, one, mistakes) for row in rows]
        if not nested and group.table is None and group.body.get("count") is None:
            what = f"{key.text} is a vector of {size}, and its list doesn't tell how many peers there are"
            mistakes.add("E201", node.place, what, hint="count: 3")
        for k, name in enumerate(vector_entries(key.text, size)):
            column = tuple(value[k] for value in values if value is not None)
            if len(column) == len(values):
                yield replace(key, text=name), Sequence(column, node.place) if nested else column[0]


def _word(
    node: Node, what: str, item: Option | Reference, clocks: Collection[str], mistakes: Mistakes
) -> str | None:
    known = item.words if isinstance(item, Option) else clocks
    word = read_text(node, what, mistakes, hint=f"{what}: {next(iter(known), 'name')}")
    if word is None or word in known:
        return word
    role = "option" if isinstance(item, Option) else "clock"
    add_unknown("E206", node.place, f"{what} has no {role} {brief(word)}", word, list(known), mistakes)
    return None


def _listed(
    node: Sequence,
    what: str,
    item: Number | Variable,
    count: int,
    read_number: Callable[[Node, str, Settable], Value | None],
    mistakes: Mistakes,
) -> NDArray[np.float64] | None:
    if len(node.items) != count:
        expected, got = f"a value a peer, {count} in all", f"{len(node.items)}"
        mistakes.add("E208", node.place, f"the list of {what}", expected=expected, got=got)
        return None
    values = [read_number(one, what, item) for one in node.items]
    if any(value is None for value in values):
        return None
    return np.array([float(value.number) for value in values if value is not None])


def _items_of(
    column: Column,
    settable: Mapping[str, list[tuple[str, Settable]]],
    explained: Callable[[str, Place], bool],
    mistakes: Mistakes,
) -> list[tuple[str, Number | Variable]]:
    items = settable.get(column.name)
    numbers = [(whole, i) for whole, i in items or () if isinstance(i, Number | Variable)]
    if not numbers and not explained(column.name, column.place):
        known = [name for name, found in settable.items() if isinstance(found[0][1], Number | Variable)]
        what = f"a heading names {brief(column.name)}, which is no number of a part"
        add_unknown("E702", column.place, what, column.name, known, mistakes)
    return numbers


def _check_column(
    column: Column, lines: tuple[int, ...], item: Number | Variable, mistakes: Mistakes
) -> None:
    """Check a column's unit, and each of its numbers against the parameter's bounds."""
    if column.unit.dimension != item.unit.dimension or column.unit.dimension.clashes(item.unit.dimension):
        expected = format_dimension(item.unit.dimension)
        got = f"[{column.unit.text}]" if column.unit.text != "1" else "no unit"
        hint = f"{column.name} [{item.unit.text}]"
        if column.unit.dimension.clashes(item.unit.dimension):
            hint += f", each {'divided by' if expected == 'Hz' else 'times'} 2*pi"
        mistakes.add(
            "E702", column.place, f"the heading {column.name}", expected=f"[{expected}]", got=got, hint=hint
        )
        return
    if not isinstance(item, Number):
        return
    bounds = item.bounds
    low = -np.inf if bounds.minimum is None else float(bounds.minimum)
    high = np.inf if bounds.maximum is None else float(bounds.maximum)
    numbers = column.numbers
    outside = (numbers < low) | (numbers > high) | (bounds.open_minimum & (numbers == low))
    for row in np.flatnonzero(outside)[:5]:
        number = Fraction(float(numbers[row]))
        place = Place(column.place.file, lines[int(row)], 1)
        got = f"{float(number / bounds.scale):.12g} {bounds.unit}"
        mistakes.add("E207", place, column.name, expected=bounds.fault(number), got=got)


def with_followers(
    settings: Settings,
    parts: SequenceType[Part],
    numbers: Mapping[str, Value],
    peers: int,
    place: Place,
    mistakes: Mistakes,
) -> Settings:
    """Return what a group sets, and what follows from it.

    Parameters
    ----------
    settings
        What the group sets.
    parts
        All parts of the scene, each before the parts inside it.
    numbers, peers
        The named numbers, and the number of peers.
    place
        Where the group is, for messages.
    mistakes
        Takes E207 a number out of its bounds, and those of evaluating.
    """
    own, words = dict(settings.values), dict(settings.words)
    by_peer = {name for name, _ in settings.columns}
    known = dict(numbers)
    for part in parts:
        known |= {f"{part.name}.{name}": value for name, value in (*part.values, *part.starts)}

    def number(parts_of: tuple[str, ...]) -> Fraction:
        name = ".".join(parts_of)
        return Fraction(peers) if parts_of == PEERS else (own if name in own else known)[name].number

    for part in parts:
        words = dict(_words_inside(part, words)) | words
        for name, value in (*part.values, *part.starts):
            whole = f"{part.name}.{name}"
            if value.expression is None or whole in own or whole in by_peer:
                continue
            if not any(".".join(node.parts) in own for node in names(value.expression)):
                continue
            try:
                found = Fraction(evaluate(value.expression, number, place))
            except ApcError as error:
                mistakes.take(error)
                continue
            own[whole] = replace(value, number=found, place=place)
            declared = part.component.parameter(name)
            if isinstance(declared, Number):
                declared.bounds.check(own[whole], whole, mistakes)
    return replace(settings, values=tuple(own.items()), words=tuple(words.items()))


def _words_inside(part: Part, words: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the clocks that parts inside a part take over from it, where the group sets the outer one."""
    for inner in part.component.inner:
        for own, outer in inner.entry.references:
            if (word := words.get(f"{part.name}.{outer}")) is not None:
                yield f"{part.name}.{inner.name}.{own}", word
