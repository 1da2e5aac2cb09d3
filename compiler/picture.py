"""A diagram as a picture: placed by a layout of our own, written as SVG.

Takes: `Diagram`. Gives: `place`, what stands where, and `draw_svg`.
Guarantees: the same diagram gives the same bytes; no text overlaps another or is crossed by a line.
Does not: look at equations.

One peer's parts stand in columns: what drives a device first, then each part one column behind the one it is
joined to (layers by breadth-first search, after Sugiyama, Tagawa and Toda, IEEE Trans. SMC 1981). As masses
are joined to couplers only, every line runs between neighbouring columns and crosses no box.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from html import escape

from apc.compiler.diagram import Crowd, Diagram, Net, Node, Pulse, common_period, one_of, seconds
from apc.compiler.words import counted

FONT = "Helvetica, Arial, 'DejaVu Sans', sans-serif"
SIZE, SMALL, TITLE = 12.0, 10.5, 18.0
LINE = 15.0  # from one line of text to the next
PAD, GAP, BETWEEN = 10.0, 42.0, 20.0  # inside a box, between columns, between rows
SYMBOL = 26.0  # height of a spring or damper
THUMB = 96.0  # diameter of a picture of who hears whom
WIDEST_ABOUT = 900.0  # what a longer sentence is cut to, unless the picture is wider
MOST_PEERS = 16  # in such a picture
MOST_TICKS = 120  # of one clock along the frame
INK, FAINT, FILL, EDGE = "#1f2933", "#6b7785", "#e8eff8", "#2b4a72"
# Colours that stay apart for a colour-blind reader (Okabe and Ito, 2008).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text; (x, y) is where its baseline starts, or its middle with `middle`."""

    x: float
    y: float
    text: str
    size: float = SMALL
    bold: bool = False
    middle: bool = False
    colour: str = INK

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom: an upper bound, as fonts differ."""
        width = text_width(self.text, self.size, bold=self.bold)
        left = self.x - width / 2 if self.middle else self.x
        return left, self.y - 0.8 * self.size, left + width, self.y + 0.25 * self.size


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle with round corners."""

    x: float
    y: float
    width: float
    height: float
    fill: str = "white"
    stroke: str = INK
    dashed: bool = False
    round: float = 4.0


@dataclass(frozen=True, slots=True)
class Line:
    """A line through points, or with `curved` the curve from the first to the last, level at both ends."""

    points: tuple[tuple[float, float], ...]
    colour: str = INK
    dashed: bool = False
    arrows: bool = False
    curved: bool = False
    width: float = 1.4


@dataclass(frozen=True, slots=True)
class Dot:
    """A circle."""

    x: float
    y: float
    radius: float
    fill: str = INK
    stroke: str = INK


Mark = Text | Box | Line | Dot


@dataclass(frozen=True, slots=True)
class Picture:
    """Marks on a page of `width` times `height`."""

    width: float
    height: float
    marks: tuple[Mark, ...]


def text_width(text: str, size: float, *, bold: bool = False) -> float:
    """Return about how wide a text is, rather too wide: as in DejaVu Sans, the widest font."""
    em = sum(
        0.36 if c in "iljtfrI.,:;|!'()[]/ -" else 0.98 if c in "mwMW@%…" else 0.72 if c.isupper() else 0.64
        for c in text
    )
    return em * size * (1.1 if bold else 1.0)


# ---- layout ----


@dataclass(frozen=True, slots=True)
class _Cell:
    """What stands in a column: a node, or (without one) the way of a line that goes on to the right."""

    key: str
    node: Node | None
    width: float
    height: float
    link: str = ""  # where the line leads
    after: str = ""  # the cell it comes from


@dataclass(frozen=True, slots=True)
class _Spot:
    """Where a cell stands: its left side and middle, and the sides of its column."""

    cell: _Cell
    x: float
    middle: float
    left: float
    right: float


def place(diagram: Diagram) -> Picture:
    """Place everything on a page."""
    marks: list[Mark] = []
    colours = {pulse.name: COLOURS[i % len(COLOURS)] for i, pulse in enumerate(diagram.pulses)}
    top = 64.0 if diagram.about else 46.0
    left = 24.0
    heading = one_of(diagram)
    y = top + 30
    ports: list[tuple[str, float, float]] = []  # link, x, y: where a line leaves the peer
    right = left + text_width(heading, SIZE, bold=True) + 2 * PAD
    for columns in _connected(diagram):
        spots, width, height = _layered(columns, diagram, left + 18, y)
        marks += _joints(diagram, spots)
        for spot in spots.values():
            marks += _drawn(spot, colours)
        for link, way, port in _outgoing(columns, spots):
            marks += way
            ports.append((link, *port))
        right = max(right, left + 18 + width + 18)
        y += height + 2 * BETWEEN
    bottom = y - BETWEEN
    frame = Box(left, top, right - left, bottom - top, "none", FAINT, round=10)
    title = Text(left + 12, top + 18, heading, SIZE, bold=True, colour=FAINT)
    net_marks, net_right, net_bottom = _nets(diagram, ports, right, top, colours)
    legend, legend_right, end = _legend(
        diagram, left, max(bottom, net_bottom) + 34, max(right, net_right), colours
    )
    heads = text_width(diagram.title, TITLE, bold=True), min(text_width(diagram.about, SIZE), WIDEST_ABOUT)
    width = max(right, net_right, legend_right, *(left + head for head in heads)) + 24
    about = _cut(diagram.about, width - 2 * left, SIZE)
    head = [Text(left, 32, diagram.title, TITLE, bold=True), Text(left, 52, about, SIZE, colour=FAINT)]
    return Picture(width, end + 20, (frame, *marks, *net_marks, title, *head[: 2 if about else 1], *legend))


def _cut(text: str, width: float, size: float) -> str:
    while text and text_width(text, size) > width:
        text = text.rstrip("…")[:-1].rstrip() + "…"
    return text


def _cell(node: Node) -> _Cell:
    if node.role == "joint":
        return _Cell(node.name, node, 8, 8)
    if node.role == "ground":
        return _Cell(node.name, node, 26, 30)
    widths = [text_width(node.name, SIZE, bold=True), *(text_width(line, SMALL) for line in node.lines), 70]
    height = 2 * PAD + LINE * (1 + len(node.lines)) + (SYMBOL if _has_symbol(node) else 0)
    return _Cell(node.name, node, max(widths) + 2 * PAD, height)


def _has_symbol(node: Node) -> bool:
    return node.role == "hand" or (node.role == "coupler" and (node.spring or node.damper))


def _connected(diagram: Diagram) -> list[list[list[_Cell]]]:
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
                        column.append(_Cell(key, None, 0, 6, link, after))
                        after = key
        found.append(layers)
    return found


def _layered(
    columns: list[list[_Cell]], diagram: Diagram, left: float, top: float
) -> tuple[dict[str, _Spot], float, float]:
    """Return where each cell stands, and the width and height of all."""
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
    spots: dict[str, _Spot] = {}
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
            spots[cell.key] = _Spot(cell, start, centre[cell.key], x, x + width)
        x += width + GAP
    highest = min(spot.middle - spot.cell.height / 2 for spot in spots.values())
    lowest = max(spot.middle + spot.cell.height / 2 for spot in spots.values())
    moved = {key: replace(spot, middle=spot.middle - highest + top) for key, spot in spots.items()}
    return moved, x - GAP - left, lowest - highest


def _joints(diagram: Diagram, spots: dict[str, _Spot]) -> Iterable[Line]:
    for one, two in diagram.joints:
        if one in spots and two in spots:
            first, second = sorted((spots[one], spots[two]), key=lambda spot: spot.left)
            yield from _way(first, second, INK)


def _way(first: _Spot, second: _Spot, colour: str, *, dashed: bool = False) -> Iterable[Line]:
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


def _outgoing(
    columns: list[list[_Cell]], spots: dict[str, _Spot]
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


# ---- marks ----


def _drawn(spot: _Spot, colours: dict[str, str]) -> Iterable[Mark]:
    cell, node = spot.cell, spot.cell.node
    if node is None:
        return
    x, y = spot.x, spot.middle - cell.height / 2
    if node.role == "joint":
        yield Dot(x + 4, y + 4, 3)
        return
    if node.role == "ground":
        yield Line(((x, y), (x, y + cell.height)), width=2)
        for i in range(5):
            top = y + 2 + i * 6
            yield Line(((x, top + 4), (x + 8, top - 2)), FAINT, width=1)
        return
    mass = node.role == "mass"
    yield Box(
        *(x, y, cell.width, cell.height),
        fill=FILL if mass else "white",
        stroke=EDGE if mass else colours.get(node.clock, FAINT),
        round=2 if mass else 8,
    )
    middle = x + cell.width / 2
    text_y = y + PAD + 10
    if _has_symbol(node):
        yield from _symbol(node, middle, y + PAD + 6)
        text_y += SYMBOL
    yield Text(middle, text_y, node.name, SIZE, bold=True, middle=True)
    for line in node.lines:
        text_y += LINE
        yield Text(middle, text_y, line, middle=True, colour=INK if " " in line else FAINT)


def _symbol(node: Node, x: float, y: float) -> Iterable[Mark]:
    """Draw a spring, a damper, both side by side, or the arrow of a force."""
    if node.role == "hand":
        yield Line(((x - 22, y), (x + 22, y)), width=2)
        yield Line(((x + 14, y - 6), (x + 22, y), (x + 14, y + 6)), width=2)
        return
    both = node.spring and node.damper
    if node.spring:
        row = y - 5 if both else y
        zigzag = [(x - 14 + 4 * i, row + (4 if i % 2 else -4)) for i in range(8)]
        yield Line(((x - 26, row), (x - 18, row), *zigzag, (x + 18, row), (x + 26, row)))
    if node.damper:
        row = y + 8 if both else y
        yield Line(((x - 26, row), (x - 2, row)))
        yield Line(((x - 2, row - 4), (x - 2, row + 4)))
        yield Line(((x - 8, row - 6), (x + 8, row - 6), (x + 8, row + 6), (x - 8, row + 6)))
        yield Line(((x + 8, row), (x + 26, row)))
    if both:
        yield Line(((x - 26, y - 5), (x - 26, y + 8)))
        yield Line(((x + 26, y - 5), (x + 26, y + 8)))


def _nets(
    diagram: Diagram,
    ports: Sequence[tuple[str, float, float]],
    left: float,
    top: float,
    colours: dict[str, str],
) -> tuple[list[Mark], float, float]:
    """Draw the links to the right of the peer, the nearest to its own lines first, and who hears whom."""
    marks: list[Mark] = []
    at = {net.name: [y for link, _, y in ports if link == net.name] for net in diagram.nets}
    nets = sorted(diagram.nets, key=lambda net: sum(at[net.name]) / max(1, len(at[net.name])))
    x, y, right = left + 78, top, left
    crowd_colours = _crowd_colours(diagram)
    for net in nets:
        lines = net.lines
        width = max(text_width(net.name, SIZE, bold=True), *(text_width(t, SMALL) for t in lines)) + 2 * PAD
        height = 2 * PAD + LINE * (1 + len(lines))
        caption = f"{counted(diagram.peers, 'peer')}, {_shape(net)}"
        band = max(height, THUMB + 2 * LINE)
        wanted = sum(at[net.name]) / len(at[net.name]) - band / 2 if at[net.name] else y
        y = max(y, wanted)
        middle = y + band / 2
        marks.append(
            Box(x, middle - height / 2, width, height, "white", colours.get(net.clock, FAINT), True, 14)
        )
        marks.append(Text(x + width / 2, middle - height / 2 + PAD + 10, net.name, SIZE, True, True))
        for i, line in enumerate(lines, 1):
            line_y = middle - height / 2 + PAD + 10 + LINE * i
            marks.append(Text(x + width / 2, line_y, line, middle=True))
        for link, port_x, port_y in ports:
            if link == net.name:
                marks += _to_net((port_x, port_y), (left, port_y), (x, middle))
        thumb_x = x + width + 60 + max(THUMB, text_width(caption, SMALL)) / 2
        start, end = x + width + 4, thumb_x - THUMB / 2 - 12
        marks.append(Line(((start, middle), (end, middle)), FAINT, dashed=True, arrows=True))
        marks += _who_hears_whom(diagram, net, thumb_x, middle, crowd_colours)
        marks.append(Text(thumb_x, middle + THUMB / 2 + LINE + 2, caption, middle=True, colour=FAINT))
        right = max(right, thumb_x + max(THUMB, text_width(caption, SMALL)) / 2 + 6)
        y += band + BETWEEN
    return marks, right, y


def _to_net(
    leaves: tuple[float, float], border: tuple[float, float], link: tuple[float, float]
) -> Iterable[Line]:
    """Draw the way from a part, level to the border of the peer, then to the link's box."""
    if border[0] > leaves[0]:
        yield Line((leaves, border), FAINT, dashed=True)
    yield Line((border, (link[0] - 4, link[1])), FAINT, dashed=True, arrows=True, curved=True)


def _crowd_colours(diagram: Diagram) -> dict[str, str]:
    """Return a colour a group, from the other end than the clocks'."""
    return {crowd.name: COLOURS[-1 - i % len(COLOURS)] for i, crowd in enumerate(diagram.crowds)}


def _shape(net: Net) -> str:
    return counted(len(net.pairs), "arc") if net.shape == "arcs" else f"{net.shape} graph"


def _who_hears_whom(
    diagram: Diagram, net: Net, x: float, y: float, colours: dict[str, str]
) -> Iterable[Mark]:
    """Draw the peers on a circle and their arcs; of many peers the first. The one drawn whole is larger."""
    number = min(diagram.peers, MOST_PEERS)
    owners = [crowd.name for crowd in diagram.crowds for _ in range(min(crowd.count, MOST_PEERS))][:number]
    radius = THUMB / 2 - 8
    at = [
        (x - radius * math.cos(2 * math.pi * i / number), y - radius * math.sin(2 * math.pi * i / number))
        for i in range(number)
    ]
    for one, two in _pairs(net, number):
        if net.shape == "star" and one == 0:
            # The first peer is the centre: it is drawn in the middle.
            yield Line(((x, y), at[two]), FAINT, width=0.8)
        else:
            yield Line((at[one], at[two]), FAINT, width=0.8)
    for i, (dot_x, dot_y) in enumerate(at):
        colour = colours[owners[i]]
        centre = net.shape == "star" and i == 0
        yield Dot(x if centre else dot_x, y if centre else dot_y, 6 if i == 0 else 4.5, colour, INK)


def _pairs(net: Net, number: int) -> list[tuple[int, int]]:
    if net.shape == "complete":
        return [(i, j) for i in range(number) for j in range(i + 1, number)]
    if net.shape == "ring":
        return [(i, (i + 1) % number) for i in range(number)]
    if net.shape == "star":
        return [(0, i) for i in range(1, number)]
    ends = [(min(pair), max(pair)) for pair in net.pairs if max(pair) < number]
    return list(dict.fromkeys(ends))


def _legend(
    diagram: Diagram, left: float, y: float, right: float, colours: dict[str, str]
) -> tuple[list[Mark], float, float]:
    """Draw the groups with their settings, then the clocks with their ticks along one frame."""
    marks: list[Mark] = []
    crowd_colours = _crowd_colours(diagram)
    if len(diagram.crowds) > 1 or any(crowd.settings for crowd in diagram.crowds):
        for crowd in diagram.crowds:
            marks.append(Dot(left + 6, y - 4, 4.5, crowd_colours[crowd.name]))
            label = Text(left + 18, y, f"{crowd.name}: {counted(crowd.count, 'peer')}", SMALL, bold=True)
            marks.append(label)
            start = label.box[2] + 12
            for line in _filled(crowd, max(right - start, 320)):
                marks.append(Text(start, y, line))
                y += LINE
            y += LINE * (0 if crowd.settings else 1) + 2
        y += 10
    frame = common_period(pulse.period for pulse in diagram.pulses)
    if frame is None:
        return marks, right, y
    names = [_pulse_text(pulse) for pulse in diagram.pulses]
    start = left + 18 + max(text_width(name, SMALL) for name in names) + 20
    end = max(right, start + 260)
    for pulse, name in zip(diagram.pulses, names, strict=True):
        colour = colours[pulse.name]
        marks.append(Box(left, y - 9, 11, 11, "white", colour, round=3))
        marks.append(Text(left + 18, y, name))
        count = int(frame / pulse.period)
        marks.append(Line(((start, y - 4), (end, y - 4)), FAINT, width=0.8))
        for k in range(count if count <= MOST_TICKS else 0):
            tick = start + float((pulse.phase + k * pulse.period) / frame) * (end - start)
            marks.append(Line(((tick, y - 10), (tick, y + 2)), colour, width=1.6))
        if count > MOST_TICKS:
            marks.append(Text((start + end) / 2, y - 8, f"{count} ticks", middle=True, colour=colour))
        y += LINE + 4
    marks.append(Line(((start, y - 4), (end, y - 4)), FAINT, arrows=True, width=0.8))
    marks.append(Text((start + end) / 2, y + 10, f"one frame, {seconds(frame)}", middle=True, colour=FAINT))
    return marks, end + 4, y + 14


def _pulse_text(pulse: Pulse) -> str:
    text = f"clock {pulse.name}: every {seconds(pulse.period)}"
    return text + (f", first at {seconds(pulse.phase)}" if pulse.phase else "")


def _filled(crowd: Crowd, width: float) -> list[str]:
    """Return a group's settings as lines no wider than `width`, where a single one fits."""
    lines: list[str] = []
    for setting in crowd.settings:
        longer = f"{lines[-1]},  {setting}" if lines else ""
        if longer and text_width(longer, SMALL) <= width:
            lines[-1] = longer
        else:
            lines.append(setting)
    return lines


# ---- SVG ----


def draw_svg(diagram: Diagram) -> str:
    """Return a diagram as an SVG document."""
    picture = place(diagram)
    size = f"{_n(picture.width)} {_n(picture.height)}"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" width="{_n(picture.width)}" '
        f'height="{_n(picture.height)}" font-family="{FONT}" role="img">'
    )
    what = escape(f"{diagram.title}. {diagram.about}".strip())
    body = [_svg(mark) for mark in picture.marks]
    return "\n".join(
        [head, f"<title>{what}</title>", '<rect width="100%" height="100%" fill="white"/>', *body, "</svg>"]
    )


def _svg(mark: Mark) -> str:
    match mark:
        case Text():
            bold = ' font-weight="bold"' if mark.bold else ""
            anchor = ' text-anchor="middle"' if mark.middle else ""
            place_ = f'x="{_n(mark.x)}" y="{_n(mark.y)}" font-size="{_n(mark.size)}"'
            return f'<text {place_} fill="{mark.colour}"{bold}{anchor}>{escape(mark.text)}</text>'
        case Box():
            dash = ' stroke-dasharray="5 3"' if mark.dashed else ""
            size = f'x="{_n(mark.x)}" y="{_n(mark.y)}" width="{_n(mark.width)}" height="{_n(mark.height)}"'
            look = f'rx="{_n(mark.round)}" fill="{mark.fill}" stroke="{mark.stroke}" stroke-width="1.3"{dash}'
            return f"<rect {size} {look}/>"
        case Dot():
            where = f'cx="{_n(mark.x)}" cy="{_n(mark.y)}" r="{_n(mark.radius)}"'
            return f'<circle {where} fill="{mark.fill}" stroke="{mark.stroke}" stroke-width="0.8"/>'
        case Line():
            return _line(mark)


def _line(line: Line) -> str:
    dash = ' stroke-dasharray="5 3"' if line.dashed else ""
    style = f'fill="none" stroke="{line.colour}" stroke-width="{_n(line.width)}"{dash}'
    (x0, y0), (x1, y1) = line.points[0], line.points[-1]
    if line.curved:
        half = (x1 - x0) / 2
        path = f"M{_n(x0)} {_n(y0)} C{_n(x0 + half)} {_n(y0)} {_n(x1 - half)} {_n(y1)} {_n(x1)} {_n(y1)}"
    else:
        path = "M" + " L".join(f"{_n(x)} {_n(y)}" for x, y in line.points)
    drawn = f'<path d="{path}" {style}/>'
    if line.arrows:
        for x, y, way in ((x0, y0, 1), (x1, y1, -1)):
            head = f"{_n(x)} {_n(y)} {_n(x + 7 * way)} {_n(y - 3.5)} {_n(x + 7 * way)} {_n(y + 3.5)}"
            drawn += f'<polygon points="{head}" fill="{line.colour}"/>'
    return drawn


def _n(number: float) -> str:
    """Return a coordinate, in tenths; the same on every machine."""
    return f"{number + 0.0:.1f}".removesuffix(".0")
