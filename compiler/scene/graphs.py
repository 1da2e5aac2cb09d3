"""Who hears whom over a link, and how late: graphs and delays between groups, as a link's entry gives them.

Takes: the YAML nodes of `graph` and `delays`. Gives: `Graph` (as `compiled` has it), `SceneDelay`.
Guarantees: every peer an edge names exists; weights are finite and not zero.
Does not: build a matrix: a complete graph, a ring and a star stay words.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from apc.compiler.compiled import MOST_PLACED, Graph
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.tables import NamedFiles, Table, read_table
from apc.compiler.language.values import AlreadyReportedError, Value
from apc.compiler.scene.named_numbers import NamedNumbers
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import Body, brief, fault, form, mapping_of, text_of, unknown, whole_number

SHAPES = ("complete", "ring", "star")
PAIRS = ("edges", "arcs")
_PEER = re.compile(r"(?P<group>[A-Za-z]\w*)\[(?P<number>\d{1,10})\]\Z", re.ASCII)

COMPLETE = Graph("complete", np.zeros((0, 2), np.int64), np.zeros(0))

Arc = tuple[int, int, float]  # sending and hearing peer, from 0, and a weight


@dataclass(frozen=True, slots=True)
class SceneDelay:
    """The delay of a link from one group of peers to another."""

    sender: str
    receiver: str
    delay: Value


def read_graph(node: Node, counts: Mapping[str, int], files: NamedFiles) -> Graph:
    """Read `complete`, `ring`, `star`, `{edges: …}` or `{arcs: …}`.

    Parameters
    ----------
    node
        The node.
    counts
        The number of peers by group, in order.
    files
        Reads tables of arcs, and takes what is at fault in them.

    Raises
    ------
    ApcError
        What is at fault.
    """
    peers, word = sum(counts.values()), node.text if isinstance(node, Scalar) else None
    if peers > MOST_PLACED and word != COMPLETE.shape:
        expected = f"at most {MOST_PLACED:,} peers where it isn't complete"
        raise fault("E208", node.place, "a graph", expected, f"{peers:,}", "graph: complete")
    if word in SHAPES:
        return replace(COMPLETE, shape=str(word))
    if word is not None:
        what = f"there is no graph {brief(word)}"
        raise unknown("E206", node.place, what, word, (*SHAPES, *PAIRS))
    hint = "edges: [[1, 2], [2, 3]]"
    body = Body(mapping_of(node, "graph", f"graph: {{{hint}}}"), PAIRS, "graph", files.mistakes)
    given = [key for key in PAIRS if key in body.nodes]
    if len(given) != 1 or len(body.nodes) != 1:
        raise fault("E203", node.place, "graph", "either edges or arcs", hint=hint)
    pairs, what = body.nodes[given[0]], given[0]
    if isinstance(pairs, Scalar) and pairs.text.endswith(".csv"):
        table = files.read(pairs.text, lambda path: read_table(path, pairs.place))
        arcs = [] if table is None else _arcs_of(table, what, peers)
    else:
        arcs = _listed(pairs, what, counts, files)
    if what == "edges":
        arcs += [(receiver, sender, weight) for sender, receiver, weight in arcs]
    ends = np.array([arc[:2] for arc in arcs], np.int64).reshape(-1, 2)
    return Graph("arcs", ends, np.array([arc[2] for arc in arcs]))


def _listed(node: Node, what: str, counts: Mapping[str, int], files: NamedFiles) -> list[Arc]:
    """Read `[[1, 2], [left[1], 3, 0.5]]`."""
    if not isinstance(node, Sequence):
        expected = "a list of pairs or a .csv file"
        raise fault("E203", node.place, what, expected, form(node), f"{what}: [[1, 2], [2, 3]]")
    found: dict[tuple[int, int], Arc] = {}
    for item in node.items:
        with files.mistakes:
            if not isinstance(item, Sequence) or len(item.items) not in (2, 3):
                expected = "two peers, and a weight if it isn't 1"
                raise fault("E203", item.place, what, expected, form(item), "[1, 2]")
            ends: list[int] = []
            for end in item.items[:2]:
                with files.mistakes:
                    ends.append(_peer(end, counts))
            weight = _weight(item.items[2]) if len(item.items) == 3 else 1.0
            if len(ends) < 2:
                raise AlreadyReportedError
            sender, receiver = ends
            if sender == receiver:
                raise fault("E213", item.place, f"peer {sender + 1} can't be joined to itself")
            if (sender, receiver) in found or (what == "edges" and (receiver, sender) in found):
                twice = f"the pair {sender + 1}, {receiver + 1} is given twice"
                raise fault("E213", item.place, twice)
            found[sender, receiver] = sender, receiver, weight
    return [*found.values()]


def _weight(node: Node) -> float:
    number = node.value if isinstance(node, Scalar) else None
    usable = isinstance(number, int | float) and not isinstance(number, bool)
    if usable and number and math.isfinite(float(number)):
        return float(number)
    raise fault("E203", node.place, "a weight", "a number other than 0", form(node), "0.5")


def _peer(node: Node, counts: Mapping[str, int]) -> int:
    """Return a peer's number, from 0: written 1 to N, or as left[2]."""
    peers = sum(counts.values())
    number, named = whole_number(node), _PEER.match(node.text) if isinstance(node, Scalar) else None
    if named and 1 <= int(named["number"]) <= counts.get(named["group"], 0):
        starts = dict(zip(counts, accumulate(counts.values(), initial=0), strict=False))
        number = starts[named["group"]] + int(named["number"])
    if number is not None and 1 <= number <= peers:
        return number - 1
    expected = f'a number from 1 to {peers}, or a name in quotes such as "{next(iter(counts), "user")}[1]"'
    raise fault("E213", node.place, "a peer", expected, form(node))


def _arcs_of(table: Table, what: str, peers: int) -> list[Arc]:
    """Read pairs from a table with the columns from, to and weight or none."""
    names, place = [column.name for column in table.columns], table.columns[0].place
    if names not in (["from", "to"], ["from", "to", "weight"]):
        expected = "the headings from, to and weight or none"
        raise fault("E702", place, "a table of pairs", expected, brief(", ".join(names)))
    sender, receiver, *rest = (column.numbers for column in table.columns)
    weights = rest[0] if rest else np.ones(table.rows)
    ends = np.stack([sender, receiver])
    bad = (ends != np.round(ends)) | (ends < 1) | (ends > peers) | (sender == receiver) | (weights == 0)
    if bad.any():
        line = table.lines[int(np.flatnonzero(bad.any(axis=0))[0])]
        expected = f"two different peers from 1 to {peers}, and a weight that isn't 0"
        raise fault(
            "E213", replace(place, line=line, column=1, source_line=""), f"a pair of {what}", expected
        )
    keys = np.sort(ends, axis=0) if what == "edges" else ends
    if len(np.unique(keys, axis=1).T) < table.rows:
        raise fault("E213", place, f"a pair of {what} is given twice")
    return [(int(a) - 1, int(b) - 1, float(w)) for a, b, w in zip(sender, receiver, weights, strict=True)]


def read_delays(node: Node, counts: Mapping[str, int], numbers: NamedNumbers) -> tuple[SceneDelay, ...]:
    """Read `{SENDER: {RECEIVER: 12 ms}}`: the delays of pairs of groups that differ from the link's.

    Parameters
    ----------
    node
        The mapping.
    counts
        How many peers each group has.
    numbers
        Reads a delay.

    Raises
    ------
    ApcError
        E203 it is no mapping; other mistakes are recorded.
    """
    found = []
    hint = "delays: {left: {right: 12 ms}}"

    def group(key: Scalar) -> str:
        if key.text in counts:
            return key.text
        what = f"delays names {brief(key.text)}, which is no group of peers"
        raise unknown("E206", key.place, what, key.text, counts)

    for key, body in mapping_of(node, "delays", hint).entries:
        with numbers.mistakes:
            sender = group(key)
            for inner, value in mapping_of(body, sender, hint).entries:
                with numbers.mistakes:
                    receiver = group(inner)
                    text_of(value, receiver, hint)
                    delay = numbers.read(value, f"the delay from {sender} to {receiver}", SECOND, "ms")
                    if delay.number < 0:
                        raise fault("E207", delay.place, "a delay", "0 s or more", str(delay))
                    found.append(SceneDelay(sender, receiver, delay))
    return tuple(found)
