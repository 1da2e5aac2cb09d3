"""Where the parts of one peer stand: in columns, each one behind what it is joined to.

Takes: `Diagram`. Gives: `Cell`, `Spot`; `connected_columns`, `place_columns`, and the ways between them,
`joint_lines` and `link_ways`.
Guarantees: no line crosses a box; the same diagram gives the same places.
Does not: draw a cell (see `picture`).

What drives a device comes first, then each part one column behind the one it is joined to (layers by
breadth-first search, after Sugiyama, Tagawa and Toda, IEEE Trans. SMC 1981). As masses are joined to couplers
only, every line runs between neighbouring columns.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from apc.compiler.view.diagram import Diagram, Vertex
from apc.compiler.view.svg import FAINT, INK, SIZE, SMALL, Line, text_width

LINE = 15.0  # from one line of text to the next
PAD, GAP, BETWEEN = 10.0, 42.0, 20.0  # inside a box, between columns, between rows
SYMBOL = 26.0  # height of a spring or damper


@dataclass(frozen=True, slots=True)
class Cell:
    """What stands in a column: a node, or (without one) the way of a line that goes on to the right."""

    key: str
    node: Vertex | None
    width: float
    height: float
    link: str = ""  # where the line leads
    after: str = ""  # the cell it comes from


@dataclass(frozen=True, slots=True)
class Spot:
    """Where a cell stands: its left side and middle, and the sides of its column."""

    cell: Cell
    x: float
    middle: float
    left: float
    right: float


def _cell(node: Vertex) -> Cell:
    if node.role == "joint":
        return Cell(node.name, node, 8, 8)
    if node.role == "ground":
        return Cell(node.name, node, 26, 30)
    widths = [text_width(node.name, SIZE, bold=True), *(text_width(line, SMALL) for line in node.lines), 70]
    height = 2 * PAD + LINE * (1 + len(node.lines)) + (SYMBOL if has_symbol(node) else 0)
    return Cell(node.name, node, max(widths) + 2 * PAD, height)


def has_symbol(node: Vertex) -> bool:
    """Return whether a part is drawn with a spring, a damper or an arrow."""
    return node.role == "hand" or (node.role == "coupler" and (node.spring or node.damper))


def connected_columns(diagram: Diagram) -> list[list[list[Cell]]]:
    """Return the connected sets of nodes, each as columns of cells; lines that go on right get cells too."""
    neighbours: dict[str, list[str]] = {node.name: [] for node in diagram.nodes}
    for one, two in diagram.joints:
        neighbours[one].append(two)
        neighbours[two].append(one)
    by_name = {node.name: node for node in diagram.nodes}
    rank = {"hand": 0, "mass": 1, "coupler": 2, "joint": 3, "ground": 4}
    left = sorted(by_name, key=lambda name: rank[by_name[name].role])  # stable: the file's order within
    seen: set[str] = set()
    found = []
    for first in left:
        if first in seen:
            continue
        layer = [first]
        seen.add(first)
        layers = []
        while layer:
            layers.append([_cell(by_name[name]) for name in layer])
            ahead = dict.fromkeys(two for one in layer for two in neighbours[one] if two not in seen)
            seen |= ahead.keys()
            layer = list(ahead)
        for depth, cells in enumerate([list(cells) for cells in layers]):
            for cell in cells:
                for link in cell.node.links if cell.node else ():
                    after = cell.key
                    for column in layers[depth + 1 :]:
                        key = f"{link} behind {after}"
                        column.append(Cell(key, None, 0, 6, link, after))
                        after = key
        found.append(layers)
    return found


def place_columns(
    columns: list[list[Cell]], diagram: Diagram, left: float, top: float
) -> tuple[dict[str, Spot], float, float]:
    """Return where each cell stands, and the width and height of all.

    Parameters
    ----------
    columns
        A connected set of cells, from left to right.
    diagram
        Knows what is joined to what.
    left, top
        Where the first column begins and the highest cell ends, in the units of the page.
    """
    depth = {cell.key: i for i, column in enumerate(columns) for cell in column}
    before: dict[str, list[str]] = {key: [] for key in depth}
    for one, two in diagram.joints:
        if one in depth and two in depth:
            first, second = sorted((one, two), key=lambda name: depth[name])
            before[second].append(first)
    for column in columns:
        for cell in column:
            if cell.after:
                before[cell.key].append(cell.after)
    centre: dict[str, float] = {}
    spots: dict[str, Spot] = {}
    x = left
    for column in columns:
        width = max(cell.width for cell in column)
        wanted = {
            cell.key: sum(centre[name] for name in before[cell.key]) / max(1, len(before[cell.key]))
            for cell in column
        }
        ordered = sorted(column, key=lambda cell: wanted[cell.key])
        edge = -math.inf
        for cell in ordered:
            centre[cell.key] = max(wanted[cell.key], edge + cell.height / 2)
            edge = centre[cell.key] + cell.height / 2 + BETWEEN
        shift = sum(wanted[cell.key] - centre[cell.key] for cell in ordered) / len(ordered)
        for cell in ordered:
            centre[cell.key] += shift
            start = x if cell.node is None else x + (width - cell.width) / 2
            spots[cell.key] = Spot(cell, start, centre[cell.key], x, x + width)
        x += width + GAP
    highest = min(spot.middle - spot.cell.height / 2 for spot in spots.values())
    lowest = max(spot.middle + spot.cell.height / 2 for spot in spots.values())
    moved = {key: replace(spot, middle=spot.middle - highest + top) for key, spot in spots.items()}
    return moved, x - GAP - left, lowest - highest


def joint_lines(diagram: Diagram, spots: dict[str, Spot]) -> Iterable[Line]:
    """Draw the lines between parts that are joined."""
    for one, two in diagram.joints:
        if one in spots and two in spots:
            first, second = sorted((spots[one], spots[two]), key=lambda spot: spot.left)
            yield from _way(first, second, INK)


def _way(first: Spot, second: Spot, colour: str, *, dashed: bool = False) -> Iterable[Line]:
    """Draw from a cell to one in the next column: level beside the cells, bending between the columns."""
    y0, y1 = first.middle, second.middle
    if y0 == y1:
        yield Line(((first.x + first.cell.width, y0), (second.x, y1)), colour, dashed)
        return
    if first.x + first.cell.width < first.right:
        yield Line(((first.x + first.cell.width, y0), (first.right, y0)), colour, dashed)
    yield Line(((first.right, y0), (second.left, y1)), colour, dashed, curved=True)
    if second.left < second.x:
        yield Line(((second.left, y1), (second.x, y1)), colour, dashed)


def link_ways(
    columns: list[list[Cell]], spots: dict[str, Spot]
) -> Iterable[tuple[str, list[Line], tuple[float, float]]]:
    """Yield, for each line from a part to a link: the link, its way to the last column, where that ends."""
    for column in columns:
        for cell in column:
            for link in cell.node.links if cell.node else ():
                way: list[Line] = []
                spot = spots[cell.key]
                for later in columns:
                    for passing in later:
                        if passing.link == link and passing.after == spot.cell.key:
                            way += _way(spot, spots[passing.key], FAINT, dashed=True)
                            spot = spots[passing.key]
                yield link, way, (spot.x + spot.cell.width, spot.middle)
