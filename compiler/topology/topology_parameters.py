"""The named numbers of a topology, and reading numbers that may be expressions over them.

Takes: the section `parameters`, the groups' counts and the topology's files.
Gives: `NamedNumbers`, which all sections read by, `read_named_numbers`, `read_count_by_names`.
Guarantees: a number read has the dimension it must have; what depends on a name whose fault was reported adds
no message of its own.
Does not: know what a number is for, but for the bounds of a component's parameter.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from apc.compiler.components.component import RESERVED, ComponentVariable, NumberParameter, Settable
from apc.compiler.errors import Mistakes
from apc.compiler.language.csv_tables import NamedFiles
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import names
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
    """Read `parameters: {kt: 2000 N/m}`.

    Parameters
    ----------
    root
        The topology.
    counts
        The number of peers of each group; the name `peers` is their sum.
    files
        Reads the topology's files, and collects errors.
    complete
        Whether every group's count is known; otherwise values that depend on `peers` add no message.
    """
    waiting: dict[str, ValueBinding] = {}
    section = root.section("parameters", "{kt: 2000 N/m}")
    others = {key.text for key, _ in section} | {"peers"}
    for key, value in section:
        with files.mistakes:
            name = name_of(key, "a parameter", words=RESERVED)
            waiting[name] = read_free(value, name, others)
    values = resolve_in_order(waiting, sum(counts.values()) if complete else None, files.mistakes)
    faulty = {key.text for key, _ in section} - values.keys() | (set() if complete else {"peers"})
    return NamedNumbers(values, faulty, counts, files)


def read_count_by_names(node: Scalar, root: MappingReader) -> ScalarValue:
    """Read how many peers a group has from named numbers, before it is known how many there are in all.

    Parameters
    ----------
    node
        The count, an expression.
    root
        The topology, whose own mistakes are recorded when it is read for good.

    Raises
    ------
    ApcError
        E208 what the count names that isn't there, or what follows from the number of peers.
    """
    numbers = read_named_numbers(root, {"": 1}, NamedFiles(Path(), Mistakes()))
    known = {*numbers.names, *numbers.faulty}
    if unknown := [word for word in _WORD.findall(node.text) if word not in known]:
        expected = "a whole number, or an expression over numbers of parameters"
        raise fault("E208", node.location, "count", expected, brief(unknown[0]), "count: 3")
    count = numbers.read(node, "count", DIMENSIONLESS, "1")
    used, waiting = set[tuple[str, ...]](), [count]
    while waiting:
        if (tree := waiting.pop().expression) is not None:
            new = {name.parts for name in names(tree)} - used
            if PEERS in new:
                message = f"{brief(node.text)} depends on peers, which it is a part of"
                raise fault("E208", node.location, message, hint="count: 3")
            used |= new
            waiting += (numbers.values[".".join(parts)] for parts in new)
    return count


@dataclass(frozen=True, slots=True)
class NamedNumbers:
    """The names available in expressions of the topology: `values`, and the number of peers.

    `faulty` are names without a value, each of which was reported; `counts` the groups and how many peers
    each has; `files` reads files that are named, and takes mistakes.
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
        """Return the dimension of a name, None of none there is. Raises AlreadyReportedError."""
        name = ".".join(parts)
        if name in self.faulty:
            raise AlreadyReportedError
        value = self.values.get(name)
        return DIMENSIONLESS if parts == PEERS else None if value is None else value.dimension

    def number(self, parts: tuple[str, ...]) -> Fraction:
        """Return the value of a name, in SI."""
        return Fraction(self.peers) if parts == PEERS else self.values[".".join(parts)].number

    def read(
        self,
        node: Node,
        subject: str,
        dimension: Dimension,
        unit: str,
        words: Collection[tuple[str, Fraction]] = (),
    ) -> ScalarValue:
        """Read a number.

        Parameters
        ----------
        node
            The YAML node.
        subject
            Its name, for messages.
        dimension, unit
            The required dimension and unit.
        words
            Words that represent numbers.

        Raises
        ------
        ApcError
            An invalid number.
        """
        binding = read_binding(node, subject, dimension, unit, self.dimension, self.names, words)
        return settle(binding, self.number)

    def read_time(self, node: Node, subject: str, unit: str = "ms") -> ScalarValue:
        """Read a time, mostly in `unit`; a rate in Hz counts as its reciprocal. Raises ApcError."""
        if not (isinstance(node, Scalar) and node.text.rstrip().endswith("Hz")):
            return self.read(node, subject, SECOND, unit)
        rate = self.read(node, subject, SECOND.power(-1), "Hz")
        if rate.number <= 0:
            raise fault("E207", node.location, subject, "a rate above 0 Hz", brief(node.text))
        return ScalarValue(1 / rate.number, SECOND, None, rate.location)

    def read_for(self, node: Node, subject: str, item: Settable) -> ScalarValue:
        """Read a number for a parameter, within its bounds, or a start value for a variable.

        Parameters
        ----------
        node, subject
            The YAML node, and its name for messages.
        item
            The declaration: unit, bounds, and words that represent numbers.

        Raises
        ------
        ApcError
            An invalid number; a number out of bounds is recorded.
        """
        assert isinstance(item, NumberParameter | ComponentVariable)
        words = item.words if isinstance(item, NumberParameter) else ()
        value = self.read(node, subject, item.unit.dimension, item.unit.text, words)
        if isinstance(item, NumberParameter):
            item.bounds.check(value, subject, self.mistakes)
        return value
