"""Communication graphs and pairs of groups, from a link's entry.

Takes: the YAML nodes of `graph`, `pairs` and `delays`. Gives: `read_graph`, the `Graph` of a compiled model;
`read_pairs`, the entries of pairs of groups; `is_connected`; `may_have_self_arcs`.
Guarantees: every peer of an edge exists; weights are finite and not zero.
Does not: build a matrix: a complete graph, a ring and a star are stored by name.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from apc.compiler.compiled import MOST_PLACED, Graph
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.files import InputFile
from apc.compiler.language.csv_tables import open_table
from apc.compiler.language.values import AlreadyReportedError
from apc.compiler.number_parsing import plain_float
from apc.compiler.peer_counts import graph_of_groups
from apc.compiler.source import nodes
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import MappingReader, among, brief, fault, form, mapping_of, unknown
from apc.compiler.topology.topology_parameters import NamedNumbers
from apc.compiler.weights import arcs

SHAPES = ("complete", "ring", "star")

# Other common names of a complete graph.
SYNONYMS_OF_COMPLETE = ("mesh", "full", "all", "clique")
PAIRS = ("edges", "arcs")

COMPLETE = Graph("complete", np.zeros((0, 2), np.int64), np.zeros(0))


def read_graph(node: Node, numbers: NamedNumbers) -> Graph:
    """Return the communication graph of a link, from `complete`, `ring`, `star`, `{edges: …}` or `{arcs: …}`.

    Parameters
    ----------
    node
        The YAML node of `graph`.
    numbers
        The named numbers: counts of the groups, reader of tables, collector of errors.

    Raises
    ------
    ApcError
        The entry is invalid; errors of single pairs are recorded.
    """
    mistakes, word = numbers.mistakes, node.text if isinstance(node, Scalar) else None
    if numbers.peers > MOST_PLACED and word != COMPLETE.shape:
        expected = f"at most {MOST_PLACED:,} peers unless complete"
        raise fault("E208", node.location, "graph", expected, f"{numbers.peers:,}", "graph: complete")
    if word is not None and word in SHAPES:
        return replace(COMPLETE, shape=word)
    if word is not None:
        message = f"unknown graph {brief(word)}"
        if word.lower() in SYNONYMS_OF_COMPLETE:
            raise fault("E206", node.location, message, fix=COMPLETE.shape)
        raise unknown("E206", node.location, message, word, (*SHAPES, *PAIRS))
    fix = "[[1, 2], [2, 3]]"
    body = MappingReader(mapping_of(node, "graph", f"graph: {{edges: {fix}}}"), PAIRS, "graph", mistakes)
    given = [key for key in PAIRS if key in body.nodes]
    if body.nodes and not given:
        raise AlreadyReportedError
    if len(given) != 1:
        got, shown = ("both", "") if given else ("neither", f"edges: {fix}")
        raise fault("E203", node.location, "graph", "edges or arcs", got, shown)
    [key] = given
    pairs = body.nodes[key]
    counts = numbers.counts
    numbered = _peer_indices(counts)
    if isinstance(pairs, Scalar) and pairs.text.endswith(".csv"):
        if "peers" in numbers.faulty:
            raise AlreadyReportedError
        reader = partial(_read_pairs, named_at=pairs.location, numbered=numbered)
        items = numbers.files.read(pairs.text, reader) or ()
    elif isinstance(pairs, Sequence):
        items = pairs.items
    else:
        raise fault(
            "E203", pairs.location, key, "a list of pairs or a .csv file", form(pairs), f"{key}: {fix}"
        )
    if "peers" in numbers.faulty:
        raise AlreadyReportedError
    result: dict[tuple[int | str, int | str], float] = {}
    for pair in items:
        with mistakes:
            sender, receiver, weight = _arc(pair, key, numbered, counts, mistakes)
            if (sender, receiver) in result or (key == "edges" and (receiver, sender) in result):
                reverse = (sender, receiver) not in result
                message = f"the arc from {_named(sender)} to {_named(receiver)} is given twice"
                if key == "edges":
                    first, second = (receiver, sender) if reverse else (sender, receiver)
                    message = f"the edge between {_named(first)} and {_named(second)} is given twice"
                advice = "it has both directions; arcs have one"
                raise fault("E213", pair.location, message, advice=advice if reverse else "")
            result[sender, receiver] = weight
    if key == "edges":
        result |= {(receiver, sender): weight for (sender, receiver), weight in result.items()}
    by_group = [
        (sender, receiver, weight)
        for (sender, receiver), weight in result.items()
        if isinstance(sender, str) and isinstance(receiver, str)
    ]
    if by_group and len(by_group) == len(result):
        return graph_of_groups(by_group, counts, pairs.location, "E208")
    if any(isinstance(end, str) for ends in result for end in ends):
        advice = "define a group of one peer, and name groups only"
        raise fault("E213", pairs.location, key, "pairs of groups or pairs of peers", "both", advice=advice)
    return Graph("arcs", np.array([*result], np.int64).reshape(-1, 2), np.array([*result.values()]))


def _named(end: int | str) -> str:
    """Return the name of an end of an arc: a peer by its number from 1, or a group."""
    return end if isinstance(end, str) else f"peer {end + 1}"


def _read_pairs(file: InputFile, named_at: SourceLocation, numbered: Mapping[str, int]) -> tuple[Node, ...]:
    """Return the rows of a table of pairs as YAML nodes `[from, to]` or `[from, to, weight]`.

    A peer is written by its number or by its name, as in YAML; `numbered` has the index of each. Raises
    ApcError (E701 to E703).
    """

    def peer(text: str) -> float:
        """Return the number of a peer, from 1, written as number or name."""
        number = numbered.get(text.strip())
        return plain_float(text) if number is None else number + 1

    with open_table(file, named_at) as opened:
        names, location = [name for name, _, _ in opened.headings], opened.headings[0][2]
        if names not in (["from", "to"], ["from", "to", "weight"]):
            expected = "the headings from, to and, optionally, weight"
            raise fault("E702", location, "table of pairs", expected, brief(", ".join(names)))
        readers = (peer, peer, plain_float)[: len(names)]
        expected = f"a finite number, or the name of a peer such as {_example(numbered)} in from and to"
        numbers, lines = opened.numbers(range(len(names)), readers, "cell", expected)
    pairs = []
    for line, *row in zip(lines, *numbers.reshape(-1, len(names)).T.tolist(), strict=True):
        row_location = SourceLocation(opened.file, line, 1)
        values = (int(number) if number.is_integer() else number for number in row)
        pairs.append(
            Sequence(tuple(Scalar(str(value), value, True, row_location) for value in values), row_location)
        )
    return tuple(pairs)


def _example(numbered: Mapping[str, int]) -> str:
    """Return the name of one peer, as an example in messages."""
    return next((name for name in numbered if name.endswith("]")), "user[1]")


def may_have_self_arcs(node: Node | None) -> bool:
    """Return whether the YAML node of a graph lists an arc from a peer to itself, or names a file."""
    arcs = node.get("arcs") if isinstance(node, nodes.Mapping) else None
    if not isinstance(arcs, Sequence):
        return arcs is not None
    pairs = (pair.items[:2] for pair in arcs.items if isinstance(pair, Sequence) and len(pair.items) >= 2)
    return any(
        isinstance(first, Scalar)
        and isinstance(second, Scalar)
        and first.text == second.text
        and not first.text.isidentifier()  # a group is connected to itself between different peers
        for first, second in pairs
    )


def _peer_indices(counts: Mapping[str, int]) -> dict[str, int]:
    """Return the zero-based index of each peer by its two spellings: its number from 1, and its name, such
    as `left[2]`.
    """
    names = [f"{group}[{number + 1}]" for group, count in counts.items() for number in range(count)]
    return {name: k for k, name in enumerate(names)} | {str(k + 1): k for k in range(len(names))}


def _arc(
    pair: Node, subject: str, index_of: Mapping[str, int], groups: Collection[str], mistakes: Mistakes
) -> tuple[int | str, int | str, float]:
    """Return an arc of a list of pairs: sender, receiver and weight.

    A peer is returned as its zero-based index, a group as its name.

    Parameters
    ----------
    pair, subject
        The YAML node `[from, to]` or `[from, to, weight]`, and the key of the list for messages.
    index_of, groups
        The index of each peer by its spellings, and the names of the groups.
    mistakes
        The collector of errors, for each invalid end.

    Raises
    ------
    ApcError
        The pair is invalid.
    """
    if not isinstance(pair, Sequence) or len(pair.items) not in (2, 3):
        expected = "two peers and, optionally, a weight"
        raise fault("E203", pair.location, subject, expected, form(pair), "[1, 2]")
    ends: list[int | str] = []
    for node in pair.items[:2]:
        with mistakes:
            quoted = isinstance(node, Scalar) and node.text.isdigit() and not node.plain
            text = node.text if isinstance(node, Scalar) and not quoted else ""
            if text not in index_of and text not in groups:
                expected = f"a number from 1 to {len(index_of) // 2}, a group, or a name in quotes "
                expected += f'such as "{_example(index_of)}"'
                raise fault("E213", node.location, "peer", expected, form(node))
            ends.append(index_of.get(text, text))
    weight = 1.0
    for node in pair.items[2:]:
        number = node.value if isinstance(node, Scalar) else None
        usable = isinstance(number, int | float) and not isinstance(number, bool)
        if not (usable and number and math.isfinite(float(number))):
            one = subject.removesuffix("s")
            message = f"weight of {one} [{', '.join(map(form, pair.items[:2]))}]"
            advice = f"remove the {one}, or give it a weight" if usable and not number else ""
            raise fault("E203", node.location, message, "a number other than 0", form(node), advice=advice)
        weight = float(number)
    if len(ends) < 2:
        raise AlreadyReportedError
    if ends[0] == ends[1] and subject == "edges" and ends[0] not in groups:
        message = f"an edge can't connect {_named(ends[0])} to itself"
        raise fault("E213", pair.location, message, advice="use arcs for a peer that sends to itself")
    return ends[0], ends[1], weight


def read_pairs(node: Node, key: str, value: str, numbers: NamedNumbers) -> list[tuple[str, str, Node]]:
    """Return the entries of pairs of groups `{SENDER: {RECEIVER: VALUE}}`: sender, receiver, node of value.

    Parameters
    ----------
    node, key
        The YAML node, and its key.
    value
        An example of a value, for messages.
    numbers
        The named numbers: groups of peers, collector of errors.

    Raises
    ------
    ApcError
        E201 no entry, E203 the node is not a mapping; other mistakes are recorded.
    """
    entries, subject, counts = [], f"{key}: unknown group of peers {{}}", numbers.counts
    first, *_, last = (*counts, *counts)
    inner = f"{{{last}: {value}}}"
    fix = f"{key}: {{{first}: {inner}}}"
    for sender_key, body in _entries_of(node, key, fix):
        with numbers.mistakes:
            sender = among(sender_key.text, counts, sender_key.location, subject)
            for receiver_key, item in _entries_of(body, sender, f"{sender}: {inner}"):
                with numbers.mistakes:
                    receiver = among(receiver_key.text, counts, receiver_key.location, subject)
                    entries.append((sender, receiver, item))
    return entries


def _entries_of(node: Node, subject: str, fix: str) -> tuple[tuple[Scalar, Node], ...]:
    """Return the entries of a mapping that is not empty; raises ApcError (E201, E203) for other nodes."""
    entries = mapping_of(node, subject, fix).entries
    if not entries:
        raise fault("E201", node.location, f"{subject}: no pair of groups is given", fix=fix)
    return entries


def is_connected(graph: Graph, sender: str, receiver: str, counts: Mapping[str, int]) -> bool:
    """Return whether a graph connects a group to another one, or would connect it to itself with more peers.

    Parameters
    ----------
    graph
        The graph of a link.
    sender, receiver
        The names of the groups.
    counts
        The number of peers of each group.
    """
    if graph.shape == COMPLETE.shape or (sender == receiver and counts[sender] == 1):
        return True
    starts = np.cumsum([0, *counts.values()])
    names, (pairs, _) = [*counts], arcs(graph, int(starts[-1]))
    groups = np.searchsorted(starts, pairs, side="right") - 1
    return bool((groups == [names.index(sender), names.index(receiver)]).all(axis=1).any())
