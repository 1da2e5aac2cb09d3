"""What a picture is made of: texts, boxes, lines and dots on a page; and the picture written as SVG.

Takes: a `Picture`, placed elsewhere.
Gives: `Text`, `Box`, `Line`, `Dot`, their union `Mark`; `Picture`; `text_width`; the sizes and colours they
share; `draw_svg`.
Guarantees: plain frozen data; a text's box is an upper bound, as fonts differ. The same picture gives the
same bytes, on every machine: coordinates are in tenths.
Does not: place anything (see `layers`, `picture`).
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

SIZE, SMALL, TITLE = 12.0, 10.5, 18.0
INK, FAINT, FILL, EDGE = "#1f2933", "#6b7785", "#e8eff8", "#2b4a72"


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
    """Marks on a page of `width` times `height`; `title` says what it is to who can't see it."""

    width: float
    height: float
    marks: tuple[Mark, ...]
    title: str


def text_width(text: str, size: float, *, bold: bool = False) -> float:
    """Return about how wide a text is, rather too wide: as in DejaVu Sans, the widest font.

    `size` is the font's, in the units of the page; so is the width.
    """
    em = sum(
        0.36 if c in "iljtfrI.,:;|!'()[]/ -" else 0.98 if c in "mwMW@%…" else 0.72 if c.isupper() else 0.64
        for c in text
    )
    return em * size * (1.1 if bold else 1.0)


FONT = "Helvetica, Arial, 'DejaVu Sans', sans-serif"


def draw_svg(picture: Picture) -> str:
    """Return a picture as an SVG document."""
    size = f"{_n(picture.width)} {_n(picture.height)}"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" width="{_n(picture.width)}" '
        f'height="{_n(picture.height)}" font-family="{FONT}" role="img">'
    )
    title = f"<title>{escape(picture.title)}</title>"
    body = [_svg(mark) for mark in picture.marks]
    page = '<rect width="100%" height="100%" fill="white"/>'
    return "\n".join([head, title, page, *body, "</svg>"])


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
