"""Who hears whom over a link, and how late: graphs and delays between groups, as a link's entry gives them.

Takes: the YAML nodes of `graph` and `delays`. Gives: `Graph` (as `compiled` has it), `SceneDelay`.
Guarantees: every peer an edge names exists; weights are finite and not zero.
Does not: build a matrix: a complete graph, a ring and a star stay words.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping as MappingType
from dataclasses import dataclass

import numpy as np

from apc.compiler.compiled import MOST_PLACED, Graph
from apc.compiler.errors import Mistakes
from apc.compiler.language.tables import NamedFiles, Table, read_table
from apc.compiler.language.values import Value
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    form,
    read_mapping,
    read_text,
    whole_number,
)

SHAPES = ("complete", "ring", "star")
_PEER = re.compile(r"(?P<group>[A-Za-z]\w*)\[(?P<number>\d{1,10})\]\Z", re.ASCII)


COMPLETE = Graph("complete", np.zeros((0, 2), np.int64), np.zeros(0))


@dataclass(frozen=True, slots=True)
class SceneDelay:
    """The delay of a link from one group of peers to another."""

    sender: str
    receiver: str
    delay: Value


def read_graph(node: Node | None, counts: MappingType[str, int], files: NamedFiles) -> Graph:
    """Read `complete`, `ring`, `star`, `{edges: …}` or `{arcs: …}`.

    Parameters
    ----------
    node
        The node; None means complete.
    counts
        The number of peers by group, in order.
    files
        Reads tables of arcs, and takes what is at fault.
    """
    mistakes = files.mistakes
    if node is None:
        return COMPLETE
    peers = sum(counts.values())
    if peers > MOST_PLACED and not (isinstance(node, Scalar) and node.text == COMPLETE.shape):
        expected = f"at most {MOST_PLACED:,} peers where it isn't complete"
        mistakes.add(
            "E208", node.place, "a graph", expected=expected, got=f"{peers:,}", hint="graph: complete"
        )
        return COMPLETE
    if isinstance(node, Scalar):
        if node.text in SHAPES:
            return Graph(node.text, COMPLETE.arcs, COMPLETE.weights)
        what = f"there is no graph {brief(node.text)}"
        add_unknown("E206", node.place, what, node.text, (*SHAPES, "edges", "arcs"), mistakes)
        return COMPLETE
    body = read_mapping(node, "graph", mistakes, hint="graph: {edges: [[1, 2], [2, 3]]}")
    if body is None:
        return COMPLETE
    body = check_keys(body, ("edges", "arcs"), "graph", mistakes)
    if len(body.entries) != 1:
        mistakes.add(
            "E203", body.place, "graph", expected="either edges or arcs", hint="edges: [[1, 2], [2, 3]]"
        )
        return COMPLETE
    key, value = body.entries[0]
    reader = _ArcReader(counts, files)
    pairs = reader.read(value, key.text)
    if key.text == "edges":
        pairs += [(receiver, sender, weight) for sender, receiver, weight in pairs]
    arcs = np.array([pair[:2] for pair in pairs], np.int64).reshape(-1, 2)
    return Graph("arcs", arcs, np.array([pair[2] for pair in pairs]))


class _ArcReader:
    def __init__(self, counts: MappingType[str, int], files: NamedFiles) -> None:
        self.counts = counts
        self.files = files
        self.mistakes = files.mistakes
        self.peers = sum(counts.values())
        self.starts: dict[str, int] = {}
        total = 0
        for group, count in counts.items():
            self.starts[group] = total
            total += count

    def read(self, node: Node, what: str) -> list[tuple[int, int, float]]:
        if isinstance(node, Scalar) and node.text.endswith(".csv"):
            return self._from_file(node, what)
        if not isinstance(node, Sequence):
            hint = f"{what}: [[1, 2], [2, 3]]"
            self.mistakes.add(
                "E203", node.place, what, expected="a list of pairs or a .csv file", got=form(node), hint=hint
            )
            return []
        found: dict[tuple[int, int], float] = {}
        for item in node.items:
            pair = self._pair(item, what)
            if pair is not None and self._is_new(pair, found, item, what):
                found[pair[:2]] = pair[2]
        return [(a, b, weight) for (a, b), weight in found.items()]

    def _is_new(
        self, pair: tuple[int, int, float], found: dict[tuple[int, int], float], item: Node, what: str
    ) -> bool:
        twice = pair[:2] in found or (what == "edges" and (pair[1], pair[0]) in found)
        if twice:
            self.mistakes.add("E213", item.place, f"the pair {pair[0] + 1}, {pair[1] + 1} is given twice")
        return not twice

    def _pair(self, item: Node, what: str) -> tuple[int, int, float] | None:
        if not isinstance(item, Sequence) or len(item.items) not in (2, 3):
            expected = "two peers, and a weight if it isn't 1"
            self.mistakes.add("E203", item.place, what, expected=expected, got=form(item), hint="[1, 2]")
            return None
        one, two = (self._peer(node) for node in item.items[:2])
        weight = 1.0
        if len(item.items) == 3:
            node = item.items[2]
            number = node.value if isinstance(node, Scalar) else None
            usable = isinstance(number, int | float) and not isinstance(number, bool)
            if not usable or not math.isfinite(float(number or 0)) or float(number or 0) == 0:
                self.mistakes.add(
                    "E203",
                    node.place,
                    "a weight",
                    expected="a number other than 0",
                    got=form(node),
                    hint="0.5",
                )
                return None
            weight = float(number or 0)
        if one is None or two is None:
            return None
        if one == two:
            self.mistakes.add("E213", item.place, f"peer {one + 1} can't be joined to itself")
            return None
        return one, two, weight

    def _peer(self, node: Node) -> int | None:
        """Return a peer's number, from 0: written 1 to N, or as left[2]."""
        if isinstance(node, Scalar):
            number = whole_number(node)
            if number is not None and 1 <= number <= self.peers:
                return number - 1
            found = _PEER.match(node.text)
            if (
                found
                and found["group"] in self.counts
                and 1 <= int(found["number"]) <= self.counts[found["group"]]
            ):
                return self.starts[found["group"]] + int(found["number"]) - 1
        first = next(iter(self.counts), "user")
        expected = f'a number from 1 to {self.peers}, or a name in quotes such as "{first}[1]"'
        self.mistakes.add("E213", node.place, "a peer", expected=expected, got=form(node))
        return None

    def _from_file(self, node: Scalar, what: str) -> list[tuple[int, int, float]]:
        table = self.files.read(node.text, lambda path: read_table(path, node.place))
        if table is None:
            return []
        names = [column.name for column in table.columns]
        if names not in (["from", "to"], ["from", "to", "weight"]):
            got = brief(", ".join(names))
            self.mistakes.add(
                "E702",
                table.columns[0].place,
                "a table of pairs",
                expected="the headings from, to and weight or none",
                got=got,
            )
            return []
        return self._pairs_of(table, what)

    def _pairs_of(self, table: Table, what: str) -> list[tuple[int, int, float]]:
        ends = np.stack([table.columns[0].numbers, table.columns[1].numbers])
        weights = table.columns[2].numbers if len(table.columns) == 3 else np.ones(table.rows)
        bad = (ends != np.round(ends)) | (ends < 1) | (ends > self.peers)
        wrong = bad.any(axis=0) | (ends[0] == ends[1]) | (weights == 0)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            place = table.columns[0].place
            where = type(place)(place.file, table.lines[row], 1)
            expected = f"two different peers from 1 to {self.peers}, and a weight that isn't 0"
            self.mistakes.add("E213", where, f"a pair of {what}", expected=expected)
            return []
        keys = np.sort(ends, axis=0) if what == "edges" else ends
        if len(np.unique(keys, axis=1).T) < table.rows:
            self.mistakes.add("E213", table.columns[0].place, f"a pair of {what} is given twice")
            return []
        return [(int(a) - 1, int(b) - 1, float(w)) for a, b, w in zip(ends[0], ends[1], weights, strict=True)]


def read_pairs(
    node: Node | None, groups: MappingType[str, int], mistakes: Mistakes
) -> list[tuple[str, str, Node]]:
    """Read `{SENDER: {RECEIVER: value}}` between groups, the values unread.

    Parameters
    ----------
    node
        The mapping; None gives no pairs.
    groups
        How many peers each group has.
    mistakes
        Takes E203 and E206.
    """
    found = []
    hint = "delays: {left: {right: 12 ms}}"
    for sender, body in entries(read_mapping(node, "delays", mistakes, hint=hint)):
        if sender.text not in groups:
            what = f"delays names {brief(sender.text)}, which is no group of peers"
            add_unknown("E206", sender.place, what, sender.text, list(groups), mistakes)
            continue
        for receiver, value in entries(read_mapping(body, sender.text, mistakes, hint=hint)):
            if receiver.text not in groups:
                what = f"delays names {brief(receiver.text)}, which is no group of peers"
                add_unknown("E206", receiver.place, what, receiver.text, list(groups), mistakes)
            elif read_text(value, receiver.text, mistakes, hint=hint) is not None:
                found.append((sender.text, receiver.text, value))
    return found
