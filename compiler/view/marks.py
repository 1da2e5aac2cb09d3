"""What a picture is made of: texts, boxes, lines and dots on a page.

Takes: nothing (data types). Gives: `Text`, `Box`, `Line`, `Dot`, their union `Mark`; `Picture`; `text_width`;
the sizes and colours they share.
Guarantees: plain frozen data; a text's box is an upper bound, as fonts differ.
Does not: place anything (see `picture`), or write a file (see `svg`).
"""

from __future__ import annotations

from dataclasses import dataclass

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
    """Marks on a page of `width` times `height`."""

    width: float
    height: float
    marks: tuple[Mark, ...]


def text_width(text: str, size: float, *, bold: bool = False) -> float:
    """Return about how wide a text is, rather too wide: as in DejaVu Sans, the widest font.

    `size` is the font's, in the units of the page; so is the width.
    """
    em = sum(
        0.36 if c in "iljtfrI.,:;|!'()[]/ -" else 0.98 if c in "mwMW@%…" else 0.72 if c.isupper() else 0.64
        for c in text
    )
    return em * size * (1.1 if bold else 1.0)
