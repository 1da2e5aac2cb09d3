"""A topology as a graph: connected parts of a peer, peers connected over links; as text for Graphviz and
Mermaid.

Takes: `Topology`, or its file. Gives: `Diagram` of `Box` and `DiagramEdge`, `build_diagram`, `diagram_of`;
`draw_dot`, `draw_mermaid`; `node_of`, `shape_of`, `seconds`.
Guarantees: the graph contains every part of the topology, a long array as one box; the same topology gives
the same text.
Does not: lay out the graph on a page (see `output.graph`, Graphviz, Mermaid).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from html import escape
from operator import itemgetter
from pathlib import Path

from apc.compiler.components.component import ComponentVariable, NumberParameter, Reference
from apc.compiler.components.parts import DEFAULT_TYPES, GROUND
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.expression import format_expression
from apc.compiler.language.values import ScalarValue
from apc.compiler.language.vectors import by_vector, whole_and_index
from apc.compiler.source.source import read_source
from apc.compiler.topology.channels import ChannelDeclaration
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.links import LinkDeclaration
from apc.compiler.topology.topology import Topology, read_topology
from apc.compiler.wording import counted

ROLES = {"masses": "mass", "couplers": "coupler", "hands": "hand"}
LONGEST_ARRAY = 4  # an array with more elements is one box
MOST_LINES = 7  # numbers in one box
MOST_GROUPS = 8  # groups drawn
LONGEST_EXPRESSION = 27  # characters of an expression shown after its value, with the equals sign


@dataclass(frozen=True, slots=True)
class Box:
    """The box of a part, a link or a group; the first of `lines` is the name.

    `role` is mass, coupler, hand, ground, joint, link or group; `clock` is the clock of a part or link.
    """

    key: str
    role: str
    lines: tuple[str, ...]
    clock: str = ""


@dataclass(frozen=True, slots=True)
class DiagramEdge:
    """A line between two boxes, given by their keys; `sent` if values are sent over a link."""

    item: str
    two: str
    sent: bool


@dataclass(frozen=True, slots=True)
class Diagram:
    """The graph of a topology: the parts of one peer, the links, and the first groups."""

    topology: Topology
    boxes: tuple[Box, ...]
    edges: tuple[DiagramEdge, ...]


def build_diagram(topology: Topology) -> Diagram:
    """Return the graph of a topology."""
    by_name = {
        part.name: part for part in topology.parts if "." not in part.name
    }  # of parts with the same name the last, which is of the ordinary type
    parts = [*by_name.values()]
    sizes = Counter(_array_name(part.name) for part in parts)
    boxes: dict[str, Box] = {}
    connections: dict[DiagramEdge, None] = {}
    sent: list[DiagramEdge] = []

    def shown(name: str) -> str:
        """Return the name of the box of a part: the name of a long array instead of its elements."""
        return _array_name(name) if sizes[_array_name(name)] > LONGEST_ARRAY else name

    for part in parts:
        if (name := shown(part.name)) not in boxes:
            roles = {
                parameter.name: parameter.role
                for parameter in part.component.parameters
                if isinstance(parameter, Reference)
            }
            references = [(roles[parameter], word) for parameter, word in part.references]
            clock = next((word for role, word in references if role == "clock"), "")
            lines = _part_lines(topology, part, sizes[name] if name != part.name else 1)
            boxes[name] = Box(name, ROLES[part.section], (name, *lines), clock)
            received = dict.fromkeys(word for role, word in references if role == "link")
            sent += [DiagramEdge(name, f"link {link}", sent=True) for link in received]
    for part in parts:
        for _, other, _ in part.connections:
            text, two = shown(part.name), shown(other.partition(".")[0])
            if other == GROUND:
                two = f"{GROUND} of {text}"  # one ground for each part: the ground connects nothing
                boxes[two] = Box(two, GROUND, (GROUND,))
            elif (boxes[text].role == "mass") == (boxes[two].role == "mass"):
                # A rigid connection of two parts of the same role has a joint: the graph is bipartite.
                middle = f"{text} and {two}"
                boxes[middle] = Box(middle, "joint", (middle,))
                connections[DiagramEdge(middle, text, sent=False)] = None
                text = middle
            connections[DiagramEdge(two, text, sent=False)] = None
    links, groups = [*map(_link_box, topology.links)], [*_group_boxes(topology)]
    sent += [DiagramEdge(link.key, group.key, sent=True) for link in links for group in groups]
    return Diagram(topology, (*boxes.values(), *links, *groups), (*connections, *sent))


def diagram_of(path: Path) -> Diagram:
    """Return the graph of a topology file; no equations are read."""
    return build_diagram(read_topology(read_source(path)))


def _array_name(name: str) -> str:
    """Return the name of an array from the name of an element."""
    return name.partition("[")[0]


def _part_lines(topology: Topology, part: PartInstance, count: int) -> Iterator[str]:
    """Yield the lines of a part, or of an array of parts: the type, then the values."""
    component = part.component
    if count > 1:
        yield f"array of {count}"
    if component.name != DEFAULT_TYPES.get(part.section):
        yield component.name
    axes = {
        whole_and_index(potential.name)[1]
        for _, kind in component.connectors
        for potential in kind.potentials
    }
    if part.section == "masses" and 2 in axes:
        yield "in space" if 3 in axes else "in a plane"
    if part.groups != tuple(group.name for group in topology.groups):
        yield f"only at {', '.join(part.groups)}"
    numbers = list(_numbers(topology, part))
    if len(numbers) > MOST_LINES:
        numbers[MOST_LINES - 1 :] = [f"… and {len(numbers) - MOST_LINES + 1} more"]
    yield from numbers


def _numbers(topology: Topology, part: PartInstance) -> Iterator[str]:
    """Yield the nonzero numbers, start values, options without default value, and tables of a part."""
    for name, entries in by_vector(part.values, itemgetter(0)).items():
        if any(value.number for _, value in entries):
            yield f"{name} {_quantities(part, entries)}"
        for parameter, value in entries:
            if part.shared and getattr(part.component.parameter(parameter), "divided", False):
                of_copy = replace(value, number=value.number / topology.peers)
                yield f"shared: {_quantity(part, parameter, of_copy)} per copy"
    for name, entries in by_vector(part.starts, itemgetter(0)).items():
        yield f"{name} starts at {_quantities(part, entries)}"
    for option, word in part.options:
        if word != getattr(part.component.parameter(option), "default", None):
            yield f"{option} {word}"
    yield from (f"{table.name}: a table of {len(table.times)} rows" for table in part.tables)


def _quantities(part: PartInstance, entries: list[tuple[str, ScalarValue]]) -> str:
    """Return the text of a number with its unit and expression, or of the numbers of a vector."""
    first, *more = (_quantity(part, name, value) for name, value in entries)
    if more:
        return f"[{', '.join((first, *more))}]"
    tree = entries[0][1].expression
    text = "" if tree is None else f" = {format_expression(tree)}"
    return first + text if len(text) <= LONGEST_EXPRESSION else first


def _quantity(part: PartInstance, name: str, value: ScalarValue) -> str:
    """Return the text of a number in the unit of the topology or component, or the word for the number."""
    declared = part.component.parameter(name) or part.component.variable(name)
    assert isinstance(declared, NumberParameter | ComponentVariable)
    for word, number in declared.words if isinstance(declared, NumberParameter) else ():
        if number == value.number:
            return word
    if value.dimension == SECOND:
        return seconds(value.number)
    return str(replace(value, unit=value.unit or declared.unit.text)).replace("*", "·")


def seconds(number: Fraction) -> str:
    """Return the text of a time: in ms below one second, else in s."""
    return f"{float(number) * 1e3:.6g} ms" if abs(number) < 1 else f"{float(number):.6g} s"


def _link_box(link: LinkDeclaration) -> Box:
    """Return the box of a link, with its graph, clock, delays and channel."""
    delay = link.delay.number
    later = f"delay {seconds(delay)}" if delay else "no delay"
    lines = (link.name, shape_of(link), f"one packet per tick of {link.clock}", later)
    pairs = (
        ", ".join(
            (
                f"{pair.sender} to {pair.receiver}: delay {seconds(pair.delay.number)}",
                *[f"one packet per tick of {pair.clock}"] * bool(pair.clock),
                *_remarks(pair.channel),
            )
        )
        for pair in link.pairs
    )
    return Box(f"link {link.name}", "link", (*lines, *pairs, *_remarks(link.channel)), link.clock)


def _remarks(channel: ChannelDeclaration | None) -> tuple[str, ...]:
    """Return the remarks on a channel, none without one."""
    return () if channel is None else channel.remarks


def _group_boxes(topology: Topology) -> Iterator[Box]:
    """Yield the boxes of the groups, with their settings; at most `MOST_GROUPS`."""
    for group in topology.groups[:MOST_GROUPS]:
        lines = [f"{name}.type {word}" for name, word in group.types]
        for name, value in group.values:
            part, _, parameter = name.rpartition(".")
            lines.append(f"{name} {_quantities(topology.part(part), [(parameter, value)])}")
        lines += [f"{name} {word}" for name, word in group.words]
        lines += [f"{name} individual for each peer" for name, _ in group.columns]
        title = f"{group.name}: {counted(group.count, 'peer', ',')}"
        yield Box(f"group {group.name}", "group", (title, *lines[:MOST_LINES]))
    if (more := len(topology.groups) - MOST_GROUPS) > 0:
        yield Box("groups", "group", (f"and {more} more groups",))


def node_of(topology: Topology) -> str:
    """Return the text for the peer that the diagram shows."""
    return "the only peer" if topology.peers == 1 else f"one of {topology.peers} peers"


def shape_of(link: LinkDeclaration) -> str:
    """Return the text for the communication graph of a link."""
    graph = link.graph
    return counted(len(graph.arcs), "arc") if graph.shape == "arcs" else f"{graph.shape} graph"


_DOT = {"hand": "cds", GROUND: "underline", "joint": "point", "link": "ellipse", "group": "box3d"}


def draw_dot(diagram: Diagram) -> str:
    """Return a diagram in Graphviz's language."""
    topology = diagram.topology
    lines = [f"digraph {_quoted(topology.name)} {{", "  rankdir=LR; edge [dir=none]"]
    lines.append(
        f"  label={_quoted(f'{topology.name}, {node_of(topology)}. {topology.description}')}; labelloc=t"
    )
    for box in diagram.boxes:
        label, shape = _quoted("\n".join(box.lines)), _DOT.get(box.role, "box")
        lines.append(f"  {_quoted(box.key)} [label={label}, shape={shape}]")
    for edge in diagram.edges:
        style = " [dir=both, style=dashed]" if edge.sent else ""
        lines.append(f"  {_quoted(edge.item)} -> {_quoted(edge.two)}{style}")
    return "\n".join([*lines, "}"])


def draw_mermaid(diagram: Diagram) -> str:
    """Return a diagram in Mermaid's language."""
    number = {box.key: f"n{index}" for index, box in enumerate(diagram.boxes)}
    boxes = [f'  {number[box.key]}["{"<br>".join(map(escape, box.lines))}"]' for box in diagram.boxes]
    edges = [
        f"  {number[edge.item]} {'-.-' if edge.sent else '---'} {number[edge.two]}" for edge in diagram.edges
    ]
    return "\n".join(["flowchart LR", *boxes, *edges])


def _quoted(text: str) -> str:
    """Return a text as a quoted string of Graphviz."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'
