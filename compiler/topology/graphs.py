"""Communication graphs and delays between groups, from a link's entry.

Takes: the YAML nodes of `graph` and `delays`. Gives: `read_graph`, the `Graph` of a compiled model;
`read_delays`, a `DelayDeclaration` per entry.
Guarantees: every peer of an edge exists; weights are finite and not zero.
Does not: build a matrix: a complete graph, a ring and a star are kept as words.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from apc.compiler.compiled import MOST_PLACED, Graph
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.csv_tables import open_table
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.number_parsing import plain_float
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import MappingReader, among, brief, fault, form, mapping_of, text_of, unknown
from apc.compiler.topology.topology_parameters import NamedNumbers

SHAPES = ("complete", "ring", "star")

# What others call a graph in which each is joined to each.
MEANING_COMPLETE = ("mesh", "full", "all", "clique")
PAIRS = ("edges", "arcs")

COMPLETE = Graph("complete", np.zeros((0, 2), np.int64), np.zeros(0))


@dataclass(frozen=True, slots=True)
class DelayDeclaration:
    """The delay of a link from one group of peers to another."""

    sender: str
    receiver: str
    delay: ScalarValue


def read_graph(node: Node, numbers: NamedNumbers) -> Graph:
    """Read `complete`, `ring`, `star`, `{edges: …}` or `{arcs: …}`.

    Parameters
    ----------
    node
        The node.
    numbers
        Knows the groups, reads tables of arcs, and collects their errors.

    Raises
    ------
    ApcError
        An invalid entry.
    """
    mistakes, word = numbers.mistakes, node.text if isinstance(node, Scalar) else None
    if numbers.peers > MOST_PLACED and word != COMPLETE.shape:
        expected = f"at most {MOST_PLACED:,} peers where it isn't complete"
        raise fault("E208", node.location, "a graph", expected, f"{numbers.peers:,}", "graph: complete")
    if word is not None and word in SHAPES:
        return replace(COMPLETE, shape=word)
    if word is not None:
        message = f"there is no graph {brief(word)}"
        if word.lower() in MEANING_COMPLETE:
            raise fault("E206", node.location, message, hint=COMPLETE.shape)
        raise unknown("E206", node.location, message, word, (*SHAPES, *PAIRS))
    hint = "[[1, 2], [2, 3]]"
    body = MappingReader(mapping_of(node, "graph", f"graph: {{edges: {hint}}}"), PAIRS, "graph", mistakes)
    if len(body.nodes) != 1:
        raise fault("E203", node.location, "graph", "either edges or arcs", hint=f"edges: {hint}")
    [(key, pairs)] = body.nodes.items()
    if key not in PAIRS:
        raise AlreadyReportedError
    numbered = _peers(numbers.counts)
    if isinstance(pairs, Scalar) and pairs.text.endswith(".csv"):
        if "peers" in numbers.faulty:
            raise AlreadyReportedError
        reader = partial(_read_pairs, named_at=pairs.location, numbered=numbered)
        items = numbers.files.read(pairs.text, reader) or ()
    elif isinstance(pairs, Sequence):
        items = pairs.items
    else:
        raise fault(
            "E203", pairs.location, key, "a list of pairs or a .csv file", form(pairs), f"{key}: {hint}"
        )
    if "peers" in numbers.faulty:
        raise AlreadyReportedError
    result: dict[tuple[int, int], float] = {}
    for pair in items:
        with mistakes:
            sender, receiver, weight = _arc(pair, key, numbered, mistakes)
            if (sender, receiver) in result or (key == "edges" and (receiver, sender) in result):
                raise fault("E213", pair.location, f"the pair {sender + 1}, {receiver + 1} is given twice")
            result[sender, receiver] = weight
    if key == "edges":
        result |= {(receiver, sender): weight for (sender, receiver), weight in result.items()}
    return Graph("arcs", np.array([*result], np.int64).reshape(-1, 2), np.array([*result.values()]))


def _read_pairs(path: Path, named_at: SourceLocation, numbered: Mapping[str, int]) -> tuple[Node, ...]:
    """Return the rows of a table with the columns from, to and weight or none as pairs.

    A peer is written by its number or by its name, as in YAML. Raises ApcError (E701 to E703).
    """

    def peer(text: str) -> float:
        number = numbered.get(text.strip())
        return plain_float(text) if number is None else number + 1

    with open_table(path, named_at) as opened:
        names, location = [name for name, _, _ in opened.headings], opened.headings[0][2]
        if names not in (["from", "to"], ["from", "to", "weight"]):
            expected = "the headings from, to and weight or none"
            raise fault("E702", location, "a table of pairs", expected, brief(", ".join(names)))
        readers = (peer, peer, plain_float)[: len(names)]
        expected = f"a finite number, or the name of a peer such as {_example(numbered)} in from and to"
        numbers, lines = opened.numbers(range(len(names)), readers, "a cell", expected)
    pairs = []
    for line, *row in zip(lines, *numbers.reshape(-1, len(names)).T.tolist(), strict=True):
        at = SourceLocation(opened.file, line, 1)
        values = (int(number) if number.is_integer() else number for number in row)
        pairs.append(Sequence(tuple(Scalar(str(value), value, True, at) for value in values), at))
    return tuple(pairs)


def _example(numbered: Mapping[str, int]) -> str:
    """Return the name of a peer."""
    return next((name for name in numbered if name.endswith("]")), "user[1]")


def _peers(counts: Mapping[str, int]) -> dict[str, int]:
    """Return the number of each peer, from 0, by how it is written: 1 to N, or left[2]."""
    names = [f"{group}[{number + 1}]" for group, count in counts.items() for number in range(count)]
    return {name: k for k, name in enumerate(names)} | {str(k + 1): k for k in range(len(names))}


def _arc(pair: Node, subject: str, numbered: Mapping[str, int], mistakes: Mistakes) -> tuple[int, int, float]:
    """Return the sender and the receiver of a pair, zero-based, and its weight."""
    if not isinstance(pair, Sequence) or len(pair.items) not in (2, 3):
        expected = "two peers, and a weight if it isn't 1"
        raise fault("E203", pair.location, subject, expected, form(pair), "[1, 2]")
    ends: list[int] = []
    for node in pair.items[:2]:
        with mistakes:
            quoted = isinstance(node, Scalar) and node.text.isdigit() and not node.plain
            text = node.text if isinstance(node, Scalar) and not quoted else ""
            if text not in numbered:
                numbers = f"a number from 1 to {len(numbered) // 2}, or a name in quotes such as "
                numbers += f'"{_example(numbered)}"'
                raise fault("E213", node.location, "a peer", numbers, form(node))
            ends.append(numbered[text])
    weight = 1.0
    for node in pair.items[2:]:
        number = node.value if isinstance(node, Scalar) else None
        usable = isinstance(number, int | float) and not isinstance(number, bool)
        if not (usable and number and math.isfinite(float(number))):
            raise fault("E203", node.location, "a weight", "a number other than 0", form(node), "0.5")
        weight = float(number)
    if len(ends) < 2:
        raise AlreadyReportedError
    if ends[0] == ends[1]:
        raise fault("E213", pair.location, f"peer {ends[0] + 1} can't be joined to itself")
    return ends[0], ends[1], weight


def read_delays(node: Node, numbers: NamedNumbers) -> tuple[DelayDeclaration, ...]:
    """Read `{SENDER: {RECEIVER: 12 ms}}`: the delays of pairs of groups that differ from the link's.

    Parameters
    ----------
    node
        The mapping.
    numbers
        Knows the groups, and reads a delay.

    Raises
    ------
    ApcError
        E203 it is no mapping; other mistakes are recorded.
    """
    topology_delays, subject = [], "delays names {}, which is no group of peers"
    hint, counts = "delays: {left: {right: 12 ms}}", numbers.counts
    for key, body in mapping_of(node, "delays", hint).entries:
        with numbers.mistakes:
            sender = among(key.text, counts, key.location, subject)
            for inner, value in mapping_of(body, sender, hint).entries:
                with numbers.mistakes:
                    receiver = among(inner.text, counts, inner.location, subject)
                    text_of(value, receiver, hint)
                    delay = numbers.read(value, f"the delay from {sender} to {receiver}", SECOND, "ms")
                    if delay.number < 0:
                        raise fault("E207", delay.location, "a delay", "0 s or more", str(delay))
                    topology_delays.append(DelayDeclaration(sender, receiver, delay))
    return tuple(topology_delays)
