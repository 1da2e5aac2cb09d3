"""A diagram placed on a page: one peer's parts, the links beside it, groups and clocks below.

Takes: `Diagram`. Gives: `place`, a `Picture`.
Guarantees: no text overlaps another or is crossed by a line; the same diagram gives the same picture.
Does not: look at equations, or write a file (see `svg`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from apc.compiler.multiples import common_multiple
from apc.compiler.view.diagram import Crowd, Diagram, Net, Pulse, Vertex, one_of, seconds
from apc.compiler.view.layers import (
    BETWEEN,
    LINE,
    PAD,
    SYMBOL,
    Spot,
    connected_columns,
    has_symbol,
    joint_lines,
    link_ways,
    place_columns,
)
from apc.compiler.view.svg import (
    EDGE,
    FAINT,
    FILL,
    INK,
    SIZE,
    SMALL,
    TITLE,
    Box,
    Dot,
    Line,
    Mark,
    Picture,
    Text,
    text_width,
)
from apc.compiler.words import counted

THUMB = 96.0  # diameter of a picture of who hears whom
WIDEST_ABOUT = 900.0  # what a longer sentence is cut to, unless the picture is wider
MOST_PEERS = 16  # in such a picture
MOST_TICKS = 120  # of one clock along the frame
# Colours that stay apart for a colour-blind reader (Okabe and Ito, 2008).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


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
    for columns in connected_columns(diagram):
        spots, width, height = place_columns(columns, diagram, left + 18, y)
        marks += joint_lines(diagram, spots)
        for spot in spots.values():
            marks += _drawn(spot, colours)
        for link, way, port in link_ways(columns, spots):
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
    everything = (frame, *marks, *net_marks, title, *head[: 2 if about else 1], *legend)
    return Picture(width, end + 20, everything, f"{diagram.title}. {diagram.about}".strip())


def _cut(text: str, width: float, size: float) -> str:
    while text and text_width(text, size) > width:
        text = text.rstrip("…")[:-1].rstrip() + "…"
    return text


def _drawn(spot: Spot, colours: dict[str, str]) -> Iterable[Mark]:
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
    if has_symbol(node):
        yield from _symbol(node, middle, y + PAD + 6)
        text_y += SYMBOL
    yield Text(middle, text_y, node.name, SIZE, bold=True, middle=True)
    for line in node.lines:
        text_y += LINE
        yield Text(middle, text_y, line, middle=True, colour=INK if " " in line else FAINT)


def _symbol(node: Vertex, x: float, y: float) -> Iterable[Mark]:
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
        captions = [f"{counted(diagram.peers, 'peer')}, {_shape(net)}"]
        if diagram.peers > MOST_PEERS:
            captions.append(f"{MOST_PEERS} drawn, {diagram.peers - MOST_PEERS:,} left out")
        caption_width = max(text_width(caption, SMALL) for caption in captions)
        band = max(height, THUMB + 2 * LINE * len(captions))
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
        thumb_x = x + width + 60 + max(THUMB, caption_width) / 2
        start, end = x + width + 4, thumb_x - THUMB / 2 - 12
        marks.append(Line(((start, middle), (end, middle)), FAINT, dashed=True, arrows=True))
        marks += _who_hears_whom(diagram, net, thumb_x, middle, crowd_colours)
        for i, caption in enumerate(captions, 1):
            marks.append(Text(thumb_x, middle + THUMB / 2 + LINE * i + 2, caption, middle=True, colour=FAINT))
        right = max(right, thumb_x + max(THUMB, caption_width) / 2 + 6)
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
    centre = net.shape == "star"  # the first peer, drawn in the middle
    around = [2 * math.pi * i / max(1, number - centre) for i in range(number - centre)]
    at = [(x - radius * math.cos(turn), y - radius * math.sin(turn)) for turn in around]
    at = [(x, y), *at] if centre else at
    for one, two in _pairs(net, number):
        yield Line((at[one], at[two]), FAINT, width=0.8)
    for i, (dot_x, dot_y) in enumerate(at):
        colour = colours[owners[i]]
        yield Dot(dot_x, dot_y, 6 if i == 0 else 4.5, colour, INK)


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
    if not diagram.pulses:
        return marks, right, y
    frame = common_multiple(pulse.period for pulse in diagram.pulses)
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
