"""One part's entry, in a topology or inside a component, read against the component it is of.

Takes: a YAML mapping, the component, and the scope it stands in. Gives: `Entry`.
Guarantees: every number, word, reference and connection a component asks for is there, or a mistake says so.
Does not: know the sections of a topology.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

from apc.compiler.components.component import Component, Entry, Number, Option, Reference
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import format_expression
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.values import Binding, is_quantity, read_binding, text_place
from apc.compiler.language.vectors import entries, entry, sizes_of, whole_and_index, written_out
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import add_unknown, brief, check_keys, form, listed, read_text, whole_number
from apc.compiler.words import enumerated

GROUND = "ground"
LARGEST_ARRAY = 500
# Of one peer, those inside parts included: half a minute and 1 GB of compiling.
MOST_PARTS = 1000
_TARGET = re.compile(
    r"(?P<part>[A-Za-z]\w*)(\[(?P<first>\d{1,6})(:(?P<last>\d{1,6}))?\])?(\.(?P<connector>[A-Za-z]\w*))?\Z",
    re.ASCII,
)


@dataclass(frozen=True, slots=True)
class Scope:
    """What an entry can refer to.

    `dimension` and `names` are the names an expression may use; `references` gives the names of a role, or
    None when the section that would hold them is missing or faulty and was reported; `parts` are the
    components of the parts that can be joined, `counts` how many of an array there are; `faulty` names parts
    that can't be read and were reported; `complete` is False when a whole section of parts is missing or
    faulty and was reported; `whole` is what the entry stands in, in words; `outer` is the component around
    it, if there is one.
    """

    dimension: Callable[[tuple[str, ...]], Dimension | None]
    names: Collection[str]
    references: Callable[[str, str, Place], Collection[str] | None]
    parts: Mapping[str, Component]
    counts: Mapping[str, int]
    faulty: Collection[str]
    whole: str
    complete: bool = True
    outer: Component | None = None


def read_count(name: str, body: MappingNode, mistakes: Mistakes, *, single: bool = False) -> int | None:
    """Return how many of a part there are; None for one that is no array, as a `single` one never is."""
    node = body.get("count")
    if node is None:
        return None
    count = whole_number(node)
    if not single and count is not None and 1 <= count <= LARGEST_ARRAY:
        return count
    expected = "no count, as a link is one" if single else f"a whole number from 1 to {LARGEST_ARRAY}"
    mistakes.add("E208", node.place, f"the count of {name}", expected=expected, got=form(node))
    return None


def read_entry(
    name: str,
    body: MappingNode,
    component: Component,
    place: Place,
    scope: Scope,
    mistakes: Mistakes,
    *,
    more_keys: Collection[str] = (),
    index: int = 1,
    count: int | None = None,
    free_connectors: Collection[str] = (),
    hand: bool = False,
) -> Entry:
    """Read the entry of a part.

    Parameters
    ----------
    name
        The part's name, without index.
    body, component, place
        Its entry, what it is of, and where its name stands.
    scope
        What it can refer to.
    mistakes
        Where faults go.
    more_keys
        Keys that the caller reads.
    index, count
        Which element of an array of how many this is; `count` None for a part that is no array.
    free_connectors
        Those of its connectors that may be left unjoined here, as those of a mass.
    hand
        Whether it is a hand, which takes the connectors that are for hands.
    """
    connectors = dict(component.connectors)
    numbers = {p.name: p.unit.text for p in component.parameters if isinstance(p, Number)}
    numbers |= {v.name: v.unit.text for v in component.variables if v.start is not None}
    known = dict.fromkeys(
        whole_and_index(key)[0] for key in (*(p.name for p in component.parameters), *numbers)
    )
    body = check_keys(
        body,
        ("type", *more_keys, *connectors, *known),
        f"{name} ({component.name})",
        mistakes,
    )
    vectors = {parts[0]: size for parts, size in sizes_of((one,) for one in numbers).items()}
    body, faulty = _entry_by_entry(body, numbers, vectors, scope, mistakes)
    reader = _EntryReader(name, body, place, scope, mistakes, index, count, vectors, faulty, hand)
    told = reader.parameters(component)
    reader.tell_missing()
    starts = reader.starts(component)
    connections = tuple(
        joined
        for connector, type_ in component.connectors
        if (joined := reader.connection(connector, type_.name, connector in free_connectors)) is not None
    )
    targets = [(part, its) for _, part, its in connections if part != GROUND]
    if len(targets) > 1 and len(set(targets)) == 1:
        mistakes.add("E210", place, f"{name} joins {targets[0][0]} to itself")
    return Entry(told.values, told.options, told.references, told.described, starts, connections)


def _entry_by_entry(
    body: MappingNode,
    numbers: Mapping[str, str],
    vectors: Mapping[str, int],
    scope: Scope,
    mistakes: Mistakes,
) -> tuple[MappingNode, Collection[str]]:
    """Return an entry in which each entry of a vector has a key, `x[1]`, in the place of `x: [1 m, 0 m]`.

    Parameters
    ----------
    body
        The entry.
    numbers
        The numbers, and entries of vectors, that it may give, and the unit of each.
    vectors
        The vectors among them, and their sizes.
    scope
        What it can refer to: `x: x0` takes a vector of a component around it.
    mistakes
        Takes E203 a list of another length, or none.

    Returns
    -------
    The entry, and the vectors that are at fault, which is told.
    """
    if not vectors:
        return body, ()
    found: list[tuple[Scalar, Node]] = []
    faulty = []
    for key, node in body.entries:
        size = vectors.get(key.text, 0)
        unit = numbers.get(entry(key.text, 1), "")
        values = _vector(node, key.text, size, unit, scope, mistakes) if size else (node,)
        if not values:
            faulty.append(key.text)
        for one, value in zip(entries(key.text, size), values, strict=False):
            found.append((replace(key, text=one), value))
    return replace(body, entries=tuple(found)), faulty


def _vector(
    node: Node, what: str, size: int, unit: str, scope: Scope, mistakes: Mistakes
) -> tuple[Node, ...]:
    """Return a node for each entry of a vector; with a fault, which is told, none."""
    if isinstance(node, Scalar) and scope.outer is not None and not is_quantity(node.text):
        place = text_place(node)
        sizes = sizes_of(tuple(name.split(".")) for name in scope.names)
        try:
            tree = parse_expression(node.text, place)
            found = written_out(tree, lambda parts: sizes.get(parts, 0), node.text, place)
        except ApcError as error:
            mistakes.take(error)
            return ()
        if isinstance(found, tuple) and len(found) == size:
            return tuple(replace(node, text=format_expression(one)) for one in found)
    return listed(node, what, size, f"1 {unit}".removesuffix(" 1"), mistakes) or ()


@dataclass(frozen=True, slots=True)
class _Told:
    """What an entry says of its component's parameters: those of `Entry`."""

    values: tuple[tuple[str, Binding], ...]
    options: tuple[tuple[str, str], ...]
    references: tuple[tuple[str, str], ...]
    described: tuple[tuple[str, Node], ...]


class _EntryReader:
    """Reads one entry, value by value; what is missing or at fault is reported and left out.

    `vectors` are the sizes of those among its numbers, `faulty` those that were reported already; `hand` says
    that it is the entry of a hand.
    """

    def __init__(
        self,
        name: str,
        body: MappingNode,
        place: Place,
        scope: Scope,
        mistakes: Mistakes,
        index: int,
        count: int | None,
        vectors: Mapping[str, int],
        faulty: Collection[str],
        hand: bool,
    ) -> None:
        self.hand = hand
        self.vectors = vectors
        self.faulty = faulty
        self.name = name
        self.body = body
        self.place = place
        self.scope = scope
        self.mistakes = mistakes
        self.index = index
        self.count = count
        self.missing: dict[str, str] = {}  # what is due and left out, and what to write

    def tell_missing(self) -> None:
        """Record what is left out: one mistake, whose line has all of it."""
        if self.missing:
            hint = ", ".join(f"{key}: {value}" for key, value in self.missing.items())
            what = f"{self.name} has no {enumerated(tuple(self.missing))}"
            self.mistakes.add("E201", self.place, what, hint=hint)

    def parameters(self, component: Component) -> _Told:
        """Read the component's parameters, each by what it is."""
        values, options, references, described = [], [], [], []
        for parameter in component.parameters:
            if isinstance(parameter, Number):
                value = self.number(parameter)
                if value is not None:
                    values.append((parameter.name, value))
            elif isinstance(parameter, Option):
                word = self.option(parameter)
                if word is not None:
                    options.append((parameter.name, word))
            elif self._is_named(parameter):
                target = self.reference(parameter)
                if target is not None:
                    references.append((parameter.name, target))
            elif (node := self.body.get(parameter.name)) is not None:
                described.append((parameter.name, node))
        return _Told(tuple(values), tuple(options), tuple(references), tuple(described))

    def _is_named(self, parameter: Reference) -> bool:
        """Return whether a parameter names something; inside a component, a table is one of the outer's."""
        handed_on = parameter.role == "table" and self.scope.outer is not None
        return parameter.role in ("clock", "link") or handed_on

    def starts(self, component: Component) -> tuple[tuple[str, Binding], ...]:
        """Read the start values that are given."""
        found = []
        for variable in component.variables:
            if variable.start is not None and self.body.get(variable.name) is not None:
                start = self.binding(variable.name, variable.unit.dimension, variable.unit.text, ())
                if start is not None:
                    found.append((variable.name, start))
        return tuple(found)

    def binding(
        self, key: str, dimension: Dimension, unit: str, words: Collection[tuple[str, object]]
    ) -> Binding | None:
        return read_binding(
            self.body.get(key),
            key,
            dimension,
            unit,
            self.scope.dimension,
            self.scope.names,
            self.mistakes,
            words=words,  # type: ignore[arg-type] # pairs of a word and a Fraction
        )

    def number(self, parameter: Number) -> Binding | None:
        if self.body.get(parameter.name) is not None:
            return self.binding(
                parameter.name, parameter.unit.dimension, parameter.unit.text, parameter.words
            )
        if parameter.default is not None:
            return Binding(parameter.default, None, parameter.unit.dimension, self.place)
        whole, index = whole_and_index(parameter.name)
        if whole not in self.faulty and index <= 1:
            one = f"1 {parameter.unit.text}".removesuffix(" 1")
            value = f"[{', '.join([one] * self.vectors[whole])}]" if index else one
            self.missing[whole] = value
        return None

    def option(self, parameter: Option) -> str | None:
        node = self.body.get(parameter.name)
        if node is None:
            if parameter.default is None:
                self.missing[parameter.name] = parameter.words[0]
            return parameter.default
        word = read_text(node, parameter.name, self.mistakes, hint=f"{parameter.name}: {parameter.words[0]}")
        if word is None or word in parameter.words:
            return word
        self.mistakes.add(
            "E206",
            node.place,
            parameter.name,
            expected=" or ".join(parameter.words),
            got=brief(word),
            hint=f"{parameter.name}: {parameter.default or parameter.words[0]}",
        )
        return None

    def reference(self, parameter: Reference) -> str | None:
        node = self.body.get(parameter.name)
        if node is None:
            known = self.scope.references(parameter.role, "", self.place) or ()
            self.missing[parameter.name] = next(iter(known), "name")
            return None
        word = read_text(node, parameter.name, self.mistakes)
        if word is None:
            return None
        outer = self.scope.outer.parameter(word) if self.scope.outer is not None else None
        if isinstance(outer, Reference) and parameter.unit is not None and outer.unit is not None:
            # A table handed on to a part inside: only here do the two units meet.
            if outer.unit.dimension != parameter.unit.dimension:
                expected, got = parameter.unit.text, outer.unit.text
                self.mistakes.add("E204", node.place, parameter.name, expected=expected, got=got)
            return word
        known_names = self.scope.references(parameter.role, word, node.place)
        if known_names is None or word in known_names:
            return word
        within = self.scope.outer
        missing = (
            f"isn't in {parameter.role}s" if within is None else f"is no {parameter.role} of {within.name}"
        )
        what = f"{self.name} names {parameter.role} {brief(word)}, which {missing}"
        add_unknown("E206", node.place, what, word, list(known_names), self.mistakes)
        return None

    def connection(self, connector: str, type_name: str, free: bool) -> tuple[str, str, str] | None:
        node = self.body.get(connector)
        if node is None:
            if not free:
                taken = {self.name, *(n.text for _, n in self.body.entries if isinstance(n, Scalar))}
                fitting = [
                    part
                    for part, component in self.scope.parts.items()
                    if part not in taken and any(type_.name == type_name for _, type_ in component.connectors)
                ]
                hint = f"{connector}: {next(iter(fitting), GROUND)}"
                what = f"{self.name} does not say what its {connector} is joined to"
                self.mistakes.add("E210", self.place, what, hint=hint)
            return None
        text = read_text(node, connector, self.mistakes, hint=f"{connector}: device")
        if text is None:
            return None
        if text == GROUND:
            return connector, GROUND, ""
        found = _TARGET.match(text)
        if found is None:
            expected = "a part, such as device, device.flange or chain[2]"
            self.mistakes.add("E210", node.place, connector, expected=expected, got=brief(text))
            return None
        outer = self.scope.outer
        if outer is not None and text in dict(outer.connectors):
            return connector, "", text
        part = self._target(found, connector, node)
        if part is None:
            return None
        its = self._its_connector(found, part.partition("[")[0], connector, type_name, node)
        return None if its is None else (connector, part, its)

    def _target(self, found: re.Match[str], connector: str, node: Node) -> str | None:
        other = found["part"]
        if other in self.scope.faulty:
            return None  # reported where it is
        if other not in self.scope.parts:
            if not self.scope.complete:
                return None  # it would be in the section that was reported
            what = (
                f"{self.name} joins its {connector} to {brief(other)}, which is no part of {self.scope.whole}"
            )
            known = [*(n for n in self.scope.parts if n != self.name), GROUND]
            add_unknown("E206", node.place, what, other, known, self.mistakes)
            return None
        size = self.scope.counts.get(other)
        if size is None:
            if found["first"] is not None:
                self.mistakes.add(
                    "E210", node.place, f"{other} is one part, not an array", hint=f"{connector}: {other}"
                )
                return None
            return other
        return self._element(found, other, size, connector, node)

    def _element(self, found: re.Match[str], other: str, size: int, connector: str, node: Node) -> str | None:
        first = int(found["first"]) if found["first"] else 1
        last = int(found["last"]) if found["last"] else (first if found["first"] else size)
        if not 1 <= first <= last <= size:
            self.mistakes.add(
                "E210",
                node.place,
                f"{other} is an array of {size}: its elements are {other}[1] to {other}[{size}]",
            )
            return None
        if first == last and found["first"]:
            return f"{other}[{first}]"
        if self.count is None or self.count != last - first + 1:
            mine = "one part" if self.count is None else f"an array of {self.count}"
            what = f"{self.name} is {mine} and {other}[{first}:{last}] has {last - first + 1} elements"
            self.mistakes.add("E210", node.place, what, hint=f'{connector}: "{other}[1]"')
            return None
        return f"{other}[{first + self.index - 1}]"

    def _its_connector(
        self, found: re.Match[str], other: str, connector: str, type_name: str, node: Node
    ) -> str | None:
        component = self.scope.parts[other]
        fitting = [name for name, type_ in component.connectors if type_.name == type_name]
        named = found["connector"]
        if named in fitting:
            return str(named)
        meant = [name for name in fitting if (name in component.grips) == self.hand] or fitting
        if named is not None:
            what = f"{other} ({component.name}) has no {type_name} called {brief(named)}"
            add_unknown("E206", node.place, what, named, fitting, self.mistakes)
        elif len(meant) == 1:
            return meant[0]
        elif fitting:
            what = f"{other} ({component.name}) has {len(fitting)} connectors of type {type_name}"
            self.mistakes.add("E210", node.place, what, hint=f"{connector}: {other}.{fitting[0]}")
        else:
            what = f"{other} ({component.name}) has no connector of type {type_name} to join {connector} to"
            self.mistakes.add("E210", node.place, what)
        return None
