"""A picture written as SVG.

Takes: a `Diagram`, which is placed first. Gives: `draw_svg`.
Guarantees: the same picture gives the same bytes, on every machine: coordinates are in tenths.
Does not: place anything.
"""

from __future__ import annotations

from html import escape

from apc.compiler.view.diagram import Diagram
from apc.compiler.view.marks import Box, Dot, Line, Mark, Text
from apc.compiler.view.picture import place

FONT = "Helvetica, Arial, 'DejaVu Sans', sans-serif"


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
