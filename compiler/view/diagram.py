"""A scene as a graph: parts joined within a peer, peers joined over links; as text for Graphviz and Mermaid.

Takes: `Scene`. Gives: `Diagram`, `build_diagram`; what is drawn of it, `boxes_of` and `edges_of`; `draw_dot`,
`draw_mermaid`; `one_of`, `shape_of`, `seconds`.
Guarantees: every part of the topology is in it, a long array as one node; the same scene gives the same text.
Does not: place anything on a page: `present.graph` does, or Graphviz, or Mermaid.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from html import escape

from apc.compiler.components.component import Number, Reference
from apc.compiler.components.parts import DEFAULT_TYPES, GROUND
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.expression import format_expression
from apc.compiler.language.unit_text import format_si
from apc.compiler.language.values import Value
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.scene.instances import Part
from apc.compiler.scene.links import SceneLink
from apc.compiler.scene.scene import Scene
from apc.compiler.words import counted

ROLES = {"masses": "mass", "couplers": "coupler", "hands": "hand"}
LONGEST_ARRAY = 4  # with more elements an array is one node
MOST_LINES = 7  # of numbers in one node
MOST_CROWDS = 8  # groups that are drawn
LONGEST_EXPRESSION = 24  # characters shown beside its value


@dataclass(frozen=True, slots=True)
class Vertex:
    """A part, or where parts meet.

    `role` is mass, coupler, hand, ground or joint; `about` are its type, then its numbers; `links` those over
    which it hears.
    """

    name: str
    role: str
    about: tuple[str, ...]
    clock: str
    links: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Net:
    """A link: the shape of its graph, what is told of it, and who hears whom, peers counted from 0.

    `arcs` are (sender, receiver) of a graph given arc by arc, and empty for the other shapes.
    """

    name: str
    clock: str
    graph: str
    arcs: tuple[tuple[int, int], ...]
    about: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Crowd:
    """A group of peers: how many, and its own settings as texts."""

    name: str
    count: int
    settings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Pulse:
    """A clock, in seconds."""

    name: str
    period: Fraction
    phase: Fraction


@dataclass(frozen=True, slots=True)
class Diagram:
    """One peer's parts, and the peers. `joints` are pairs of parts by name."""

    title: str
    about: str
    parts: tuple[Vertex, ...]
    joints: tuple[tuple[str, str], ...]
    links: tuple[Net, ...]
    groups: tuple[Crowd, ...]
    pulses: tuple[Pulse, ...]

    @property
    def peers(self) -> int:
        """The number of peers."""
        return sum(group.count for group in self.groups)


def build_diagram(scene: Scene) -> Diagram:
    """Return the graph of a scene."""
    parts = [part for part in scene.parts if "." not in part.name]
    sizes: dict[str, int] = {}
    for part in parts:
        sizes[_array(part.name)] = sizes.get(_array(part.name), 0) + 1
    nodes: dict[str, Vertex] = {}
    joints: dict[tuple[str, str], None] = {}

    def shown(name: str) -> str:
        return _array(name) if sizes.get(_array(name), 0) > LONGEST_ARRAY else name

    for part in parts:
        name = shown(part.name)
        if name not in nodes:
            nodes[name] = _node(scene, part, name, sizes[_array(part.name)] if name != part.name else 1)
    for part in parts:
        for _, other, _ in part.connections:
            one, two = shown(part.name), shown(other.partition(".")[0])
            if other == GROUND:
                two = f"{GROUND} of {one}"  # each has its own: the ground joins nothing
                nodes.setdefault(two, Vertex(two, GROUND, (), "", ()))
            elif (nodes[one].role == "mass") == (nodes[two].role == "mass"):
                # Parts of one role are joined rigidly, at a point of its own: the graph has two sides.
                middle = f"{one} and {two}"
                nodes.setdefault(middle, Vertex(middle, "joint", (), "", ()))
                joints[(middle, one)] = None
                one = middle
            joints[(two, one)] = None
    return Diagram(
        scene.name,
        scene.about,
        tuple(nodes.values()),
        tuple(joints),
        tuple(_net(link) for link in scene.links),
        tuple(_crowds(scene)),
        tuple(Pulse(c.name, c.period.number, c.phase.number) for c in scene.clocks),
    )


def _array(name: str) -> str:
    return name.partition("[")[0]


def _node(scene: Scene, part: Part, name: str, count: int) -> Vertex:
    component = part.component
    role = ROLES[part.section]
    lines = [] if component.name == DEFAULT_TYPES.get(part.section) else [component.name]
    axes = max(
        (whole_and_index(one.name)[1] for _, type_ in component.connectors for one in type_.potentials),
        default=0,
    )
    if role == "mass" and axes > 1:
        lines.append("in a plane" if axes == 2 else "in space")
    if count > 1:
        lines[:0] = [f"{count} of them"]
    if part.groups != tuple(group.name for group in scene.groups):
        lines.append(f"only at {', '.join(part.groups)}")
    numbers = list(_numbers(scene, part))
    if len(numbers) > MOST_LINES:
        numbers = [*numbers[: MOST_LINES - 1], f"… and {len(numbers) - MOST_LINES + 1} more"]
    by_role = {p.name: p.role for p in component.parameters if isinstance(p, Reference)}
    named = [(by_role.get(own), word) for own, word in part.references]
    return Vertex(
        name,
        role,
        (*lines, *numbers),
        next((word for its_role, word in named if its_role == "clock"), ""),
        tuple(dict.fromkeys(word for its_role, word in named if its_role == "link")),
    )


def _numbers(scene: Scene, part: Part) -> Iterator[str]:
    """Yield a part's numbers, those that are zero left out, and its words that are no default."""
    for name, named in _by_vector(part.values):
        if any(value.number for _, value in named):
            yield f"{name} {_quantities(part, named)}{_expression(named[0][1]) if len(named) == 1 else ''}"
        for own, value in named:
            parameter = part.component.parameter(own)
            if part.shared and isinstance(parameter, Number) and parameter.divided:
                each = Value(value.number / scene.peers, value.dimension, None, value.place)
                yield f"shared: {_quantity(part, own, each)} a copy"
    for name, named in _by_vector(part.starts):
        yield f"{name} starts at {_quantities(part, named)}"
    for own, word in part.options:
        if word != getattr(part.component.parameter(own), "default", None):
            yield f"{own} {word}"
    for table in part.tables:
        yield f"{table.name}: a table of {len(table.times)} rows"


def _by_vector(values: Iterable[tuple[str, Value]]) -> Iterator[tuple[str, list[tuple[str, Value]]]]:
    """Yield numbers by name, the entries of a vector together."""
    found: dict[str, list[tuple[str, Value]]] = {}
    for own, value in values:
        found.setdefault(whole_and_index(own)[0], []).append((own, value))
    yield from found.items()


def _quantities(part: Part, named: Sequence[tuple[str, Value]]) -> str:
    """Return a number with its unit, or those of a vector's entries."""
    shown = [_quantity(part, own, value) for own, value in named]
    return shown[0] if len(shown) == 1 else f"[{', '.join(shown)}]"


def _expression(value: Value) -> str:
    text = format_expression(value.expression) if value.expression else ""
    return f" = {text}" if text and len(text) <= LONGEST_EXPRESSION else ""


def _quantity(part: Part, own: str, value: Value) -> str:
    """Return a number in the unit that its component declares."""
    declared = part.component.parameter(own) or part.component.variable(own)
    for word, number in declared.words if isinstance(declared, Number) else ():
        if number == value.number:
            return word
    unit = getattr(declared, "unit", None)
    if value.dimension == SECOND:
        return seconds(value.number)
    if unit is None:
        return format_si(float(value.number), value.dimension)
    text = "" if unit.text == "1" else f" {unit.text.replace('*', '·')}"
    return f"{float(value.number / unit.scale):.6g}{text}"


def seconds(number: Fraction) -> str:
    """Return a time for a person: in ms below a second."""
    return f"{float(number) * 1e3:.6g} ms" if abs(number) < 1 else f"{float(number):.6g} s"


def _net(link: SceneLink) -> Net:
    lines = [f"a packet each tick of {link.clock}", f"available {seconds(link.delay.number)} later"]
    if not link.delay.number:
        lines[-1] = "available at once"
    lines += [f"{d.sender} to {d.receiver}: {seconds(d.delay.number)} later" for d in link.delays]
    lines += [] if link.channel is None else link.channel.told
    pairs = tuple((int(sender), int(receiver)) for sender, receiver in link.graph.arcs)
    return Net(link.name, link.clock, link.graph.shape, pairs, tuple(lines))


def _crowds(scene: Scene) -> Iterator[Crowd]:
    by_name = {part.name: part for part in scene.parts}
    for group in scene.groups:
        settings = []
        for name, value in group.values:
            whole, _, own = name.rpartition(".")
            settings.append(f"{name} {_quantity(by_name[whole], own, value)}{_expression(value)}")
        settings += [f"{name} {word}" for name, word in group.words]
        settings += [f"{name} of its own for each peer" for name, _ in group.columns]
        yield Crowd(group.name, group.count, tuple(settings))


def one_of(diagram: Diagram) -> str:
    """Return what the peer drawn is, in words."""
    return "the only peer" if diagram.peers == 1 else f"one of {diagram.peers} peers"


@dataclass(frozen=True, slots=True)
class Box:
    """What is drawn of a part, a link or a group: its `lines`, of which the first is its name.

    `role` is that of a part, or link or group.
    """

    key: str
    role: str
    lines: tuple[str, ...]
    clock: str = ""


@dataclass(frozen=True, slots=True)
class Edge:
    """What joins two boxes, by their keys; `sent` if it is a link that does."""

    one: str
    two: str
    sent: bool


def boxes_of(diagram: Diagram) -> tuple[Box, ...]:
    """Return what is drawn of a scene, of many groups the first."""
    found = [
        Box(part.name, part.role, (GROUND if part.role == GROUND else part.name, *part.about), part.clock)
        for part in diagram.parts
    ]
    found += [
        Box(f"link {net.name}", "link", (net.name, shape_of(net), *net.about), net.clock)
        for net in diagram.links
    ]
    for crowd in diagram.groups[:MOST_CROWDS]:
        name = f"{crowd.name}: {counted(crowd.count, 'peer', ',')}"
        found.append(Box(f"group {crowd.name}", "group", (name, *crowd.settings[:MOST_LINES])))
    if len(diagram.groups) > MOST_CROWDS:
        found.append(Box("groups", "group", (f"and {len(diagram.groups) - MOST_CROWDS} more groups",)))
    return tuple(found)


def edges_of(diagram: Diagram) -> tuple[Edge, ...]:
    """Return what joins the boxes of a scene."""
    joined = [Edge(one, two, sent=False) for one, two in diagram.joints]
    heard = [Edge(node.name, f"link {link}", sent=True) for node in diagram.parts for link in node.links]
    groups = [box.key for box in boxes_of(diagram) if box.role == "group"]
    told = [Edge(f"link {net.name}", group, sent=True) for net in diagram.links for group in groups]
    return (*joined, *heard, *told)


def shape_of(net: Net) -> str:
    """Return who hears whom over a link, in words."""
    return counted(len(net.arcs), "arc") if net.graph == "arcs" else f"{net.graph} graph"


_DOT = {
    "mass": "box",
    "hand": "cds",
    GROUND: "underline",
    "joint": "point",
    "link": "ellipse",
    "group": "box3d",
}


def draw_dot(diagram: Diagram) -> str:
    """Return a diagram in Graphviz's language."""
    lines = [f"digraph {_quoted(diagram.title)} {{", "  rankdir=LR; edge [dir=none]"]
    lines.append(f"  label={_quoted(f'{diagram.title}, {one_of(diagram)}. {diagram.about}')}; labelloc=t")
    for box in boxes_of(diagram):
        label, shape = _quoted("\n".join(box.lines)), _DOT.get(box.role, "box")
        lines.append(f"  {_quoted(box.key)} [label={label}, shape={shape}]")
    for edge in edges_of(diagram):
        style = " [dir=both, style=dashed]" if edge.sent else ""
        lines.append(f"  {_quoted(edge.one)} -> {_quoted(edge.two)}{style}")
    return "\n".join([*lines, "}"])


def draw_mermaid(diagram: Diagram) -> str:
    """Return a diagram in Mermaid's language."""
    number = {box.key: f"n{place}" for place, box in enumerate(boxes_of(diagram))}
    lines = ["flowchart LR"]
    for box in boxes_of(diagram):
        text = "<br>".join(escape(line) for line in box.lines)
        lines.append(f'  {number[box.key]}["{text}"]')
    lines += [
        f"  {number[edge.one]} {'-.-' if edge.sent else '---'} {number[edge.two]}"
        for edge in edges_of(diagram)
    ]
    return "\n".join(lines)


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'
