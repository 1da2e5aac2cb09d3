"""The named numbers of a topology, and reading numbers that may be expressions over them.

Takes: the section `parameters`, the groups' counts and the topology's files.
Gives: `NamedNumbers`, by which all sections read numbers, `read_named_numbers`, `read_count_by_names`.
Guarantees: a number read has the required dimension; an expression over a name whose error was reported adds
no second message.
Does not: check a value, except against the bounds of a component's parameter.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from apc.compiler.components.component import RESERVED, ComponentVariable, NumberParameter, Settable
from apc.compiler.errors import Mistakes
from apc.compiler.files import FileReader
from apc.compiler.language.csv_tables import NamedFiles
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import Call, NumberLiteral, names
from apc.compiler.language.values import (
    PEERS,
    AlreadyReportedError,
    ScalarValue,
    ValueBinding,
    read_binding,
    read_free,
    resolve_in_order,
    settle,
)
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import MappingReader, brief, fault, name_of

_WORD = re.compile(r"[A-Za-z]\w*", re.ASCII)


def read_named_numbers(
    root: MappingReader, counts: Mapping[str, int], files: NamedFiles, *, complete: bool = True
) -> NamedNumbers:
    """Read the section `parameters: {kt: 2000 N/m}`; return the named numbers with their values in SI units.

    Parameters
    ----------
    root
        The topology.
    counts
        The number of peers of each group; the name `peers` is their sum.
    files
        The reader of the topology's files, which also collects the errors.
    complete
        Whether the count of every group is valid; otherwise values that depend on `peers` add no message.
    """
    bindings: dict[str, ValueBinding] = {}
    section = root.section("parameters", "{kt: 2000 N/m}")
    known = {key.text for key, _ in section} | {"peers"}
    for key, value in section:
        with files.mistakes:
            name = name_of(key, "a parameter", words=RESERVED)
            bindings[name] = read_free(value, name, known)
    values = resolve_in_order(bindings, sum(counts.values()) if complete else None, files.mistakes)
    faulty = {key.text for key, _ in section} - values.keys() | (set() if complete else {"peers"})
    return NamedNumbers(values, faulty, counts, files)


def read_count_by_names(node: Scalar, root: MappingReader) -> ScalarValue:
    """Return the number of peers of a group, an expression over named numbers that do not depend on `peers`.

    Parameters
    ----------
    node
        The expression.
    root
        The topology. Errors of its section `parameters` are not recorded: the section is read again later.

    Raises
    ------
    ApcError
        E208 the expression names an unknown number, or depends on the number of all peers.
    """
    numbers = read_named_numbers(root, {"": 1}, NamedFiles(Path(), Mistakes(), FileReader()))
    known = {*numbers.names, *numbers.faulty}
    if unknown := [word for word in _WORD.findall(node.text) if word not in known]:
        expected = "a whole number, or an expression in parameters"
        raise fault("E208", node.location, "count", expected, brief(unknown[0]))
    count = numbers.read(node, "count", DIMENSIONLESS, "1")
    used, unvisited = set[tuple[str, ...]](), [count]
    while unvisited:
        if (tree := unvisited.pop().expression) is not None:
            new = {name.parts for name in names(tree)} - used
            if PEERS in new:
                message = f"count {brief(node.text)} depends on peers, the sum of all counts"
                raise fault("E208", node.location, message)
            used |= new
            unvisited += (numbers.values[".".join(parts)] for parts in new)
    return count


@dataclass(frozen=True, slots=True)
class NamedNumbers:
    """The names available in expressions of the topology: `values`, and the number of peers.

    `faulty` are the names whose error was reported, so that they have no value; `counts` has the number of
    peers of each group; `files` reads files and collects mistakes.
    """

    values: Mapping[str, ScalarValue]
    faulty: Collection[str]
    counts: Mapping[str, int]
    files: NamedFiles

    @property
    def mistakes(self) -> Mistakes:
        """The collector of errors."""
        return self.files.mistakes

    @property
    def peers(self) -> int:
        """The number of all peers."""
        return sum(self.counts.values())

    @property
    def names(self) -> tuple[str, ...]:
        """The names an expression may use."""
        return ("peers", *self.values)

    def dimension(self, parts: tuple[str, ...]) -> Dimension | None:
        """Return the dimension of a name, or None if the name is unknown.

        Raises AlreadyReportedError for a name whose error was reported.
        """
        name = ".".join(parts)
        if name in self.faulty:
            raise AlreadyReportedError
        value = self.values.get(name)
        return DIMENSIONLESS if parts == PEERS else None if value is None else value.dimension

    def number(self, parts: tuple[str, ...]) -> Fraction:
        """Return the value of a name, in SI units."""
        return Fraction(self.peers) if parts == PEERS else self.values[".".join(parts)].number

    def read(
        self,
        node: Node,
        subject: str,
        dimension: Dimension,
        unit: str,
        words: Collection[tuple[str, Fraction]] = (),
    ) -> ScalarValue:
        """Return the number of a node, a quantity or an expression, with its dimension checked.

        Parameters
        ----------
        node
            The YAML node.
        subject
            The name of the number, for messages.
        dimension, unit
            The required dimension, and a unit for messages.
        words
            Words that represent numbers, with their values.

        Raises
        ------
        ApcError
            The number is invalid.
        """
        binding = read_binding(node, subject, dimension, unit, self.dimension, self.names, words)
        return settle(binding, self.number)

    def read_time(self, node: Node, subject: str, unit: str = "ms") -> ScalarValue:
        """Return the time of a node, in seconds; a rate in Hz is read as its reciprocal.

        `unit` is the unit proposed in messages. Raises ApcError for an invalid time or a rate that is not
        positive.
        """
        # In any case of the letters, so that the error of an incorrect one proposes a rate.
        if not (isinstance(node, Scalar) and re.search(r"(hz|hertz)\s*$", node.text, re.IGNORECASE)):
            return self.read(node, subject, SECOND, unit)
        rate = self.read(node, subject, SECOND.power(-1), "Hz")
        if rate.number <= 0:
            fix = f"{subject}: {node.text.strip().removeprefix('-')}" if rate.number else ""
            fix = "" if rate.expression else fix
            raise fault("E207", node.location, subject, "a rate above 0 Hz", brief(node.text), fix)
        expression = rate.expression and Call("/", (NumberLiteral(Fraction(1)), rate.expression))
        return ScalarValue(1 / rate.number, SECOND, expression, rate.location)

    def read_for(self, node: Node, subject: str, item: Settable) -> ScalarValue:
        """Return the number of a node for a declared parameter, or the start value of a declared variable.

        Parameters
        ----------
        node, subject
            The YAML node, and the name of the number for messages.
        item
            The declaration: unit, bounds, and words that represent numbers.

        Raises
        ------
        ApcError
            The number is invalid; a number out of bounds is recorded and returned.
        """
        assert isinstance(item, NumberParameter | ComponentVariable)
        words = item.words if isinstance(item, NumberParameter) else ()
        value = self.read(node, subject, item.unit.dimension, item.unit.text, words)
        if isinstance(item, NumberParameter):
            item.bounds.check(value, subject, self.mistakes)
        return value
