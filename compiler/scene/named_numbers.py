"""The named numbers of a topology, and reading numbers that may be expressions over them.

Takes: the section `parameters` and the number of peers.
Gives: `NamedNumbers`, `read_named_numbers`, `read_count_by_names`; `read_new_name`.
Guarantees: a number read has the dimension it must have; what depends on a name whose fault was reported adds
no message of its own.
Does not: know what a number is for, but for the bounds of a component's parameter.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Container, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.components.component import RESERVED, Component, Number, Option, Settable
from apc.compiler.errors import ApcError, Mistakes
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import names
from apc.compiler.language.values import (
    PEERS,
    AlreadyReportedError,
    Binding,
    Value,
    read_binding,
    read_free,
    resolve_in_order,
    settle,
)
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import brief, entries, read_mapping, read_name

_WORD = re.compile(r"[A-Za-z]\w*", re.ASCII)


def read_new_name(key: Scalar, what: str, taken: Container[str], mistakes: Mistakes) -> str | None:
    """Read a name that nothing in the topology has yet, and that is no word of the language."""
    name = read_name(key, what, mistakes)
    if name in RESERVED:
        mistakes.add("E205", key.place, f"{name} is a word of the language and can't be a name")
    elif name is not None and name in taken:
        mistakes.add("E205", key.place, f"the name {name} is used twice in this topology")
    else:
        return name
    return None


def read_named_numbers(node: Node | None, peers: int, mistakes: Mistakes) -> NamedNumbers:
    """Read `parameters: {kt: 2000 N/m}`; `peers` is the number that the name `peers` stands for."""
    section = read_mapping(node, "parameters", mistakes, hint="parameters: {kt: 2000 N/m}")
    waiting: dict[str, Binding] = {}
    faulty: set[str] = set()
    for key, value in entries(section):
        name = read_new_name(key, "a parameter", (), mistakes)
        binding = read_free(value, key.text, mistakes)
        if name is not None and binding is not None:
            waiting[name] = binding
        else:
            faulty.add(key.text)
    values, unresolved = resolve_in_order(waiting, peers, mistakes)
    return NamedNumbers(values, frozenset(faulty | unresolved), peers, mistakes)


def read_count_by_names(node: Node, parameters: Node | None, mistakes: Mistakes) -> Value | None:
    """Read how many peers a group has from named numbers, before it is known how many there are in all.

    Parameters
    ----------
    node
        The count, an expression.
    parameters
        The section `parameters`, whose own mistakes are told when it is read for good.
    mistakes
        Takes E208 what the count names that isn't there, or what follows from the number of peers.
    """
    numbers = read_named_numbers(parameters, 1, Mistakes())
    words = _WORD.findall(node.text) if isinstance(node, Scalar) else []
    unknown = [word for word in words if word != "peers" and word not in {*numbers.values, *numbers.faulty}]
    if unknown:
        expected, got = "a whole number, or an expression over numbers of parameters", brief(unknown[0])
        mistakes.add("E208", node.place, "count", expected=expected, got=got, hint="count: 3")
        return None
    found = replace(numbers, mistakes=mistakes).read(node, "count", DIMENSIONLESS, "1")
    waiting = [] if found is None or found.expression is None else list(names(found.expression))
    seen = set()
    while waiting:
        name = waiting.pop()
        if name.parts == PEERS:
            shown = brief(node.text) if isinstance(node, Scalar) else "count"
            what = f"{shown} depends on peers, which it is a part of"
            mistakes.add("E208", node.place, what, hint="count: 3")
            return None
        own = numbers.values[".".join(name.parts)].expression
        if own is not None and name.parts not in seen:
            seen.add(name.parts)
            waiting += names(own)
    return found


@dataclass(frozen=True, slots=True)
class NamedNumbers:
    """What an expression of the topology may name: `values`, and the number of `peers`.

    `faulty` are names without a value, each of which was reported; `mistakes` takes those of what is read.
    """

    values: Mapping[str, Value]
    faulty: frozenset[str]
    peers: int
    mistakes: Mistakes

    @property
    def names(self) -> tuple[str, ...]:
        """The names an expression may use."""
        return ("peers", *self.values)

    def dimension(self, parts: tuple[str, ...]) -> Dimension | None:
        """Return the dimension of a name, None of none there is. Raises AlreadyReportedError."""
        if parts == PEERS:
            return DIMENSIONLESS
        name = ".".join(parts)
        if name in self.faulty:
            raise AlreadyReportedError
        value = self.values.get(name)
        return None if value is None else value.dimension

    def number(self, parts: tuple[str, ...]) -> Fraction:
        """Return the number a name stands for, in SI."""
        return Fraction(self.peers) if parts == PEERS else self.values[".".join(parts)].number

    def read(self, node: Node | None, what: str, dimension: Dimension, unit: str) -> Value | None:
        """Read a number.

        Parameters
        ----------
        node
            Where it stands; None if it isn't there.
        what
            What it is, for messages.
        dimension, unit
            What it must be in.
        """
        return self.settled(
            read_binding(node, what, dimension, unit, self.dimension, self.names, self.mistakes)
        )

    def read_time(self, node: Node | None, what: str, unit: str = "ms") -> Value | None:
        """Read a time, mostly in `unit`; a rate in Hz counts as its reciprocal."""
        if not (isinstance(node, Scalar) and node.text.rstrip().endswith("Hz")):
            return self.read(node, what, SECOND, unit)
        rate = self.read(node, what, SECOND.power(-1), "Hz")
        if rate is None:
            return None
        if rate.number == 0:
            got = brief(node.text)
            self.mistakes.add("E207", node.place, what, expected="a rate above 0 Hz", got=got)
            return None
        return Value(1 / rate.number, SECOND, None, rate.place)

    def read_for(self, node: Node, what: str, item: Settable) -> Value | None:
        """Read a number for a parameter, within its bounds, or a start value for a variable.

        Parameters
        ----------
        node, what
            Where it stands, and what it is, for messages.
        item
            What it is given to: its unit, its bounds, and words that stand for numbers.
        """
        words = item.words if isinstance(item, Number) else ()
        assert not isinstance(item, Option) and item.unit is not None
        dimension, unit = item.unit.dimension, item.unit.text
        binding = read_binding(
            node, what, dimension, unit, self.dimension, self.names, self.mistakes, words=words
        )
        value = self.settled(binding)
        if value is not None and isinstance(item, Number):
            item.bounds.check(value, what, self.mistakes)
        return value

    def settled(self, binding: Binding | None) -> Value | None:
        """Return what a binding comes to; None of none, or of one at fault."""
        if binding is None:
            return None
        try:
            return settle(binding, self.number)
        except ApcError as error:
            self.mistakes.take(error)
            return None

    def settled_all(
        self, bindings: Collection[tuple[str, Binding]], component: Component | None = None
    ) -> tuple[tuple[str, Value], ...]:
        """Return what named bindings come to, within the bounds of a component's parameters."""
        found = []
        for name, binding in bindings:
            value = self.settled(binding)
            if value is None:
                continue
            parameter = component.parameter(name) if component is not None else None
            if isinstance(parameter, Number):
                parameter.bounds.check(value, name, self.mistakes)
            found.append((name, value))
        return tuple(found)
