"""A topology as a graph: parts joined within a peer, peers joined over links; as text for Graphviz and
Mermaid.

Takes: `Topology`. Gives: `Diagram` of `Box` and `DiagramEdge`, `build_diagram`; `draw_dot`, `draw_mermaid`;
`node_of`, `shape_of`, `seconds`.
Guarantees: every part of the topology is in it, a long array as one box; the same topology gives the same
text.
Does not: place anything on a page: `output.graph` does, or Graphviz, or Mermaid.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from html import escape
from operator import itemgetter

from apc.compiler.components.component import ComponentVariable, NumberParameter, Reference
from apc.compiler.components.parts import DEFAULT_TYPES, GROUND
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.expression import format_expression
from apc.compiler.language.values import ScalarValue
from apc.compiler.language.vectors import by_vector, whole_and_index
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.links import LinkDeclaration
from apc.compiler.topology.topology import Topology
from apc.compiler.wording import counted

ROLES = {"masses": "mass", "couplers": "coupler", "hands": "hand"}
LONGEST_ARRAY = 4  # with more elements an array is one box
MOST_LINES = 7  # of numbers in one box
MOST_GROUPS = 8  # that are drawn
LONGEST_EXPRESSION = 27  # characters shown behind its value, with the sign between them


@dataclass(frozen=True, slots=True)
class Box:
    """A box of a part, a link or a group: its `lines`, with its name first.

    `role` is mass, coupler, hand, ground, joint, link or group; `clock` is the one a part or link ticks on.
    """

    key: str
    role: str
    lines: tuple[str, ...]
    clock: str = ""


@dataclass(frozen=True, slots=True)
class DiagramEdge:
    """A line between two boxes, by their keys; `sent` if over a link."""

    item: str
    two: str
    sent: bool


@dataclass(frozen=True, slots=True)
class Diagram:
    """The graph of a topology: one peer's parts, the links, and the first of several groups."""

    topology: Topology
    boxes: tuple[Box, ...]
    edges: tuple[DiagramEdge, ...]


def build_diagram(topology: Topology) -> Diagram:
    """Return the graph of a topology."""
    by_name = {
        part.name: part for part in topology.parts if "." not in part.name
    }  # the last: as it usually is
    parts = [*by_name.values()]
    sizes = Counter(_array(part.name) for part in parts)
    boxes: dict[str, Box] = {}
    joined: dict[DiagramEdge, None] = {}
    sent: list[DiagramEdge] = []

    def shown(name: str) -> str:
        return _array(name) if sizes[_array(name)] > LONGEST_ARRAY else name

    for part in parts:
        if (name := shown(part.name)) not in boxes:
            roles = {
                parameter.name: parameter.role
                for parameter in part.component.parameters
                if isinstance(parameter, Reference)
            }
            named = [(roles[local], word) for local, word in part.references]
            clock = next((word for role, word in named if role == "clock"), "")
            lines = _part_lines(topology, part, sizes[name] if name != part.name else 1)
            boxes[name] = Box(name, ROLES[part.section], (name, *lines), clock)
            received = dict.fromkeys(word for role, word in named if role == "link")
            sent += [DiagramEdge(name, f"link {link}", sent=True) for link in received]
    for part in parts:
        for _, other, _ in part.connections:
            text, two = shown(part.name), shown(other.partition(".")[0])
            if other == GROUND:
                two = f"{GROUND} of {text}"  # each has its own: the ground joins nothing
                boxes[two] = Box(two, GROUND, (GROUND,))
            elif (boxes[text].role == "mass") == (boxes[two].role == "mass"):
                # Parts of one role are joined rigidly, at a point of its own: the graph has two sides.
                middle = f"{text} and {two}"
                boxes[middle] = Box(middle, "joint", (middle,))
                joined[DiagramEdge(middle, text, sent=False)] = None
                text = middle
            joined[DiagramEdge(two, text, sent=False)] = None
    links, groups = [*map(_link_box, topology.links)], [*_group_boxes(topology)]
    sent += [DiagramEdge(link.key, group.key, sent=True) for link in links for group in groups]
    return Diagram(topology, (*boxes.values(), *links, *groups), (*joined, *sent))


def _array(name: str) -> str:
    return name.partition("[")[0]


def _part_lines(topology: Topology, part: PartInstance, count: int) -> Iterator[str]:
    """Yield the text of a part, or of an array of parts: its type, then its values."""
    component = part.component
    if count > 1:
        yield f"{count} of them"
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
    """Yield a part's nonzero numbers, start values, options other than the default, and tables."""
    for name, entries in by_vector(part.values, itemgetter(0)).items():
        if any(value.number for _, value in entries):
            yield f"{name} {_quantities(part, entries)}"
        for local, value in entries:
            if part.shared and getattr(part.component.parameter(local), "divided", False):
                each = replace(value, number=value.number / topology.peers)
                yield f"shared: {_quantity(part, local, each)} a copy"
    for name, entries in by_vector(part.starts, itemgetter(0)).items():
        yield f"{name} starts at {_quantities(part, entries)}"
    for local, word in part.options:
        if word != getattr(part.component.parameter(local), "default", None):
            yield f"{local} {word}"
    yield from (f"{table.name}: a table of {len(table.times)} rows" for table in part.tables)


def _quantities(part: PartInstance, entries: list[tuple[str, ScalarValue]]) -> str:
    """Return a number with its unit and its expression, or the numbers of a vector's entries."""
    first, *more = (_quantity(part, name, value) for name, value in entries)
    if more:
        return f"[{', '.join((first, *more))}]"
    tree = entries[0][1].expression
    text = "" if tree is None else f" = {format_expression(tree)}"
    return first + text if len(text) <= LONGEST_EXPRESSION else first


def _quantity(part: PartInstance, name: str, value: ScalarValue) -> str:
    """Return a number as written in the topology or its component, or the word that represents it."""
    declared = part.component.parameter(name) or part.component.variable(name)
    assert isinstance(declared, NumberParameter | ComponentVariable)
    for word, number in declared.words if isinstance(declared, NumberParameter) else ():
        if number == value.number:
            return word
    if value.dimension == SECOND:
        return seconds(value.number)
    return str(replace(value, unit=value.unit or declared.unit.text)).replace("*", "·")


def seconds(number: Fraction) -> str:
    """Return a time for a person: in ms below a second."""
    return f"{float(number) * 1e3:.6g} ms" if abs(number) < 1 else f"{float(number):.6g} s"


def _link_box(link: LinkDeclaration) -> Box:
    delay, remarks = link.delay.number, () if link.channel is None else link.channel.remarks
    later = f"available {seconds(delay)} later" if delay else "available at once"
    lines = (link.name, shape_of(link), f"a packet each tick of {link.clock}", later)
    delays = (f"{d.sender} to {d.receiver}: {seconds(d.delay.number)} later" for d in link.delays)
    return Box(f"link {link.name}", "link", (*lines, *delays, *remarks), link.clock)


def _group_boxes(topology: Topology) -> Iterator[Box]:
    for group in topology.groups[:MOST_GROUPS]:
        lines = [f"{name}.type {word}" for name, word in group.types]
        for name, value in group.values:
            part, _, local = name.rpartition(".")
            lines.append(f"{name} {_quantities(topology.part(part), [(local, value)])}")
        lines += [f"{name} {word}" for name, word in group.words]
        lines += [f"{name} of its own for each peer" for name, _ in group.columns]
        title = f"{group.name}: {counted(group.count, 'peer', ',')}"
        yield Box(f"group {group.name}", "group", (title, *lines[:MOST_LINES]))
    if (more := len(topology.groups) - MOST_GROUPS) > 0:
        yield Box("groups", "group", (f"and {more} more groups",))


def node_of(topology: Topology) -> str:
    """Return the description of the drawn peer."""
    return "the only peer" if topology.peers == 1 else f"one of {topology.peers} peers"


def shape_of(link: LinkDeclaration) -> str:
    """Return the communication graph of a link, in words."""
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
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'
