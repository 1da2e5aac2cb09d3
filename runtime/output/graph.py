"""A topology's graph as a picture: the SVG, PNG or PDF output of `apc show`, drawn by matplotlib.

Takes: the graph of a topology. Gives: `graph_picture`.
Guarantees: no two boxes overlap and no line crosses one; of many peers and groups only the first are drawn,
and the others are counted.
Does not: use equations.

Boxes are arranged in columns, each one column after its nearest neighbor (layers by breadth-first search). As
masses and links are joined only to couplers, hands and groups, every line runs between two columns that are
neighbours.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

from apc.compiler.multiples import common_multiple
from apc.compiler.topology.links import LinkDeclaration
from apc.compiler.topology.topology import Topology
from apc.compiler.view.diagram import Box, Diagram, DiagramEdge, node_of, seconds, shape_of
from apc.compiler.wording import counted
from apc.output.pictures import COLOURS
from apc.support.optional import need

# All in points.
SIZE, TITLE = 8.0, 12.0  # of letters
LINE, PAD = 12.0, 7.0  # from one line to the next, inside a box
GAP, BETWEEN, MARGIN = 46.0, 16.0, 12.0  # between columns, between boxes, around all
HEAD = 42.0  # of the title and what the model is about
BELOW, ALONGSIDE = (
    140.0,
    170.0,
)  # height and width of the pictures of the communication graph, and of the clocks
MOST_PEERS = 16  # in a picture of the communication graph
MOST_TICKS = 120  # of one clock along the frame
FILLS = {"mass": "#e8eff8", "hand": "#fdf3e0", "link": "#f2f2f2"}
GRAPHS = {"complete": "complete_graph", "ring": "cycle_graph", "star": "star_graph"}  # of networkx
INK, FAINT = "#1f2933", "#6b7785"

_Layout = dict[str, tuple[float, float, float, float]]  # left, top, width and height of each box


def graph_picture(diagram: Diagram) -> Any:
    """Draw a model; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib or networkx is not installed.
    """
    topology, boxes, edges = diagram.topology, diagram.boxes, diagram.edges
    indices = _layout(boxes, edges)
    title = f"{topology.name}, {node_of(topology)}"
    count = len(topology.links) + bool(topology.clocks)
    right = max(left + wide for left, _, wide, _ in indices.values())
    below = ALONGSIDE * (count + bool(topology.clocks))
    width = max(below, max(right, _width(title, TITLE)) + 2 * MARGIN)
    graph = max(top + high for _, top, _, high in indices.values()) + BETWEEN
    small = BELOW if count else 0.0
    height = HEAD + graph + small + MARGIN
    size = (width / 72, height / 72)
    figure = need("matplotlib.figure", "plot").Figure(figsize=size, layout="constrained" if count else None)
    ax = figure.add_axes((0, (small + MARGIN) / height, 1, (graph + HEAD) / height), xlim=(0, width))
    ax.set_ylim(graph, -HEAD)
    ax.set_axis_off()
    description = textwrap.shorten(topology.description, int(width / 4.6), placeholder="…")
    ax.text(MARGIN, 18 - HEAD, title, size=TITLE, weight="bold", color=INK, parse_math=False)
    ax.text(MARGIN, 32 - HEAD, description, size=SIZE, color=FAINT, parse_math=False)
    for edge in edges:
        (x, y, wide, high), (left, top, _, tall) = sorted((indices[edge.item], indices[edge.two]))
        style = {"color": FAINT, "linestyle": "--"} if edge.sent else {"color": INK}
        ax.plot((MARGIN + x + wide, MARGIN + left), (y + high / 2, top + tall / 2), lw=1, **style)
    colours = _colours(topology)
    for box in boxes:
        _draw(ax, box, indices[box.key], colours)
    if count:
        figure.get_layout_engine().set(rect=(0, 0, 1, small / height))
        shares = [*(1 for _ in topology.links), *([2] if topology.clocks else [])]
        axes = figure.subplots(1, count, squeeze=False, width_ratios=shares)[0]
        for small_ax, link in zip(axes, topology.links, strict=False):
            _draw_peers(small_ax, topology, link, colours)
        if topology.clocks:
            _draw_ticks(axes[-1], topology, colours)
    return figure


def _layout(boxes: Sequence[Box], edges: Sequence[DiagramEdge]) -> _Layout:
    """Return the position of each box, connected components in separate columns."""
    networkx = need("networkx", "plot")
    by_key = {box.key: box for box in boxes}
    graph = networkx.Graph()
    graph.add_nodes_from(by_key)
    graph.add_edges_from((edge.item, edge.two) for edge in edges)
    result: _Layout = {}
    below = 0.0
    for box in boxes:
        if box.key in result:
            continue
        joined = networkx.node_connected_component(graph, box.key)
        hands = [key for key in by_key if key in joined and by_key[key].role == "hand"]
        # A layer comes in any order: boxes keep that of the model.
        layers = map(set, networkx.bfs_layers(graph, hands or [box.key]))
        columns = [[box for box in boxes if box.key in layer] for layer in layers]
        heights = [sum(_height(box) + BETWEEN for box in column) - BETWEEN for column in columns]
        left = 0.0
        for column, height in zip(columns, heights, strict=True):
            width = max(_width(line, SIZE) for box in column for line in box.lines) + 2 * PAD
            top = below + (max(heights) - height) / 2
            for item in column:
                result[item.key] = left, top, width, _height(item)
                top += _height(item) + BETWEEN
            left += width + GAP
        below += max(heights) + 2 * BETWEEN
    return result


def _width(text: str, size: float) -> float:
    """Return the width of a line in bold letters, in points."""
    bold = need("matplotlib.font_manager", "plot").FontProperties(weight="bold", size=size)
    letters = need("matplotlib.textpath", "plot").text_to_path
    return float(letters.get_text_width_height_descent(text, bold, False)[0])


def _height(box: Box) -> float:
    return LINE * len(box.lines) + 2 * PAD


def _draw(ax: Any, box: Box, rectangle: tuple[float, float, float, float], colours: dict[str, str]) -> None:
    """Draw a box of a topology and its lines of text.

    `rectangle` is its left, top, width and height, without the margin.
    """
    patches = need("matplotlib.patches", "plot")
    left, top, width, height = rectangle[0] + MARGIN, *rectangle[1:]
    style = "round,pad=0,rounding_size=6" if box.role != "mass" else "square,pad=0"
    edge = colours.get(box.key) or colours.get(f"clock {box.clock}", FAINT)
    fill, dash = FILLS.get(box.role, "white"), "--" if box.role == "link" else "-"
    node_style = {"facecolor": fill, "edgecolor": edge, "linestyle": dash, "linewidth": 1.3}
    ax.add_patch(patches.FancyBboxPatch((left, top), width, height, boxstyle=style, zorder=3, **node_style))
    for row, line in enumerate(box.lines):
        weight, y = "bold" if row == 0 else "normal", top + PAD + LINE * (row + 0.75)
        node_style = {"size": SIZE, "ha": "center", "weight": weight, "color": INK, "parse_math": False}
        ax.text(left + width / 2, y, line, zorder=4, **node_style)


def _colours(topology: Topology) -> dict[str, str]:
    """Return the colours of clocks, and from the other end those of groups."""
    clocks = {f"clock {clock.name}": COLOURS[1 + i % 6] for i, clock in enumerate(topology.clocks)}
    groups = {f"group {group.name}": COLOURS[-1 - i % 6] for i, group in enumerate(topology.groups)}
    return clocks | groups


def _draw_peers(ax: Any, topology: Topology, link: LinkDeclaration, colours: dict[str, str]) -> None:
    """Draw the communication graph of a link, in the colors of groups."""
    networkx = need("networkx", "plot")
    owners = [group.name for group in topology.groups for _ in range(min(group.count, MOST_PEERS))]
    fills = [colours[f"group {name}"] for name in owners[:MOST_PEERS]]
    number = len(fills)
    star = link.graph.shape == "star"
    if link.graph.shape in GRAPHS:
        graph = getattr(networkx, GRAPHS[link.graph.shape])(number - star)  # of a star, those around one
    else:
        graph = networkx.DiGraph(pair for pair in link.graph.arcs.tolist() if max(pair) < number)
        graph.add_nodes_from(range(number))
    shells = [indices for indices in ([*range(star)], [*range(star, number)]) if indices]
    node_style = {"node_size": 40, "edge_color": FAINT, "width": 0.7, "with_labels": False}
    positions = networkx.shell_layout(graph, shells)
    networkx.draw_networkx(graph, positions, ax=ax, nodelist=range(number), node_color=fills, **node_style)
    text = f"{link.name}: {counted(topology.peers, 'peer', ',')}, {shape_of(link)}"
    if topology.peers > number:
        text += f"\n{number} of {topology.peers:,} peers drawn"
    ax.set_title(text, size=SIZE, color=INK)
    ax.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal")
    ax.set_axis_off()


def _draw_ticks(ax: Any, topology: Topology, colours: dict[str, str]) -> None:
    """Draw the ticks of each clock along a frame."""
    frame = common_multiple(clock.period.number for clock in topology.clocks)
    for row, clock in enumerate(topology.clocks):
        period, phase = clock.period.number, clock.phase.number
        count, colour = int(frame / period), colours[f"clock {clock.name}"]
        if count <= MOST_TICKS:
            ticks = [float(phase + k * period) * 1e3 for k in range(count)]
            ax.eventplot(ticks, lineoffsets=-row, linelengths=0.6, colors=colour)
        else:
            node_style = {"size": SIZE, "ha": "center", "va": "center", "color": colour}
            ax.text(float(frame) * 5e2, -row, f"{count:,} ticks", **node_style)
    names = [f"{clock.name}: every {seconds(clock.period.number)}" for clock in topology.clocks]
    ax.set_yticks([-row for row in range(len(names))], names, size=SIZE)
    ax.set(xlim=(0, float(frame) * 1e3), ylim=(0.5 - len(names), 0.5))
    ax.tick_params(labelsize=SIZE, length=2)
    ax.set_xlabel(f"time in a frame of {seconds(frame)} [ms]", size=SIZE, color=FAINT)
    ax.spines[["top", "right", "left"]].set_visible(False)
