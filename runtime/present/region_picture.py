"""Pictures of stable regions as papers print them: curves, the stable side hatched, panels side by side.

Takes: a `Region`, or `Panels` of them.
Gives: `region_picture`, `panels_picture`; `panel_letter`; `drawn_points`, `stable_outlines`.
Guarantees: curves can be told apart without colour; the stable side is hatched and named; the legend stands
below the axes, over nothing.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.optional import need
from apc.present.forms import MEANT
from apc.present.pictures import COLOURS, LINES
from apc.regions.curves import between
from apc.regions.region import side_of_curves

if TYPE_CHECKING:
    from apc.frame.names import Range
    from apc.regions.panels import Panel, Panels
    from apc.regions.region import Region

Floats = NDArray[np.float64]

HATCHES = (
    "///",
    "\\\\\\",
    "|||",
    "---",
    "xxx",
    "+++",
    "...",
    "ooo",
)  # how each region's stable side is hatched
OVERLAY_LINES = ((0, (1, 2)), (0, (3, 1, 1, 1, 1, 1)), (0, (8, 3)))
HATCH = 0.25  # how dark hatches are: curves and words must stand out
PANEL = 3.5  # inches: the side of a panel, one column of a paper
DRAWN = 240  # straight lines a curve is drawn by at least: fewer show their corners
SEARCHED = 48  # points along each side among which the widest place for a word is looked for
WORD = (0.1, 0.045)  # of a panel's sides: half of what the word takes
SAME = 1e-3  # of a panel's sides, less than a line is wide: curves that nowhere differ by more are one
NO_BREAK = "\N{NO-BREAK SPACE}"


def panel_letter(place: int) -> str:
    """Return the letter of a panel, "a" for the first; after "z" they begin anew."""
    return ascii_lowercase[place % len(ascii_lowercase)]


def region_picture(found: Region, ax: Any = None) -> Any:
    """Draw one region into a matplotlib Axes, or into a figure of its own; return the Axes.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    if ax is None:
        ax = figures.Figure(figsize=(PANEL + 0.6, PANEL), layout="constrained").subplots()
    _frame(ax, found.x, found.y)
    _draw(ax, found, 1, 0)
    named = _name_stable_side(ax, (found,), (1,))
    _entitle(ax, "", (found,), [*_said((found,), (1,)), *named])
    return ax


def panels_picture(found: Panels) -> Any:
    """Draw all panels side by side; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    count = len(found.panels)
    columns = 2 if count == 4 else min(count, 3)
    rows = -(-count // columns)
    figure = figures.Figure(figsize=(PANEL * columns + 0.6, PANEL * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for place, (ax, panel) in enumerate(zip(axes, found.panels, strict=False)):
        notes = _panel(ax, panel, found.normalized)
        if place % columns:
            ax.set_ylabel("")
        letter = f"({panel_letter(place)}) " if count > 1 else ""
        _entitle(ax, f"{letter}{_unbroken(panel.title)}".strip(), panel.regions, notes)
    for ax in axes[count:]:
        ax.set_axis_off()
    handles, labels = axes[0].get_legend_handles_labels()
    if len(labels) > 1 or found.normalized:
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            frameon=False,
            fontsize=8.5,
            ncols=min(columns, 2),
            handlelength=3,
        )
    return figure


def _entitle(ax: Any, title: str, regions: Sequence[Region], said: Sequence[str]) -> None:
    """Set a title, and beneath it what stable means, what is said of the curves and what is left out."""
    meant = [MEANT[one.criterion].removesuffix(" as it is") for one in regions if one.criterion in MEANT]
    notes = dict.fromkeys([*meant, *said, *(note for one in regions for note in one.left_out)])
    lines = [line for text in (title, *notes) for line in textwrap.wrap(text, 48)]
    if lines:
        ax.set_title("\n".join(lines), fontsize=8.5)


def _unbroken(settings: str) -> str:
    """Return what a panel sets with no line break inside a setting."""
    parts = [part.strip().replace("=", " = ").replace(" ", NO_BREAK) for part in settings.split(",")]
    return ", ".join(parts)


def _panel(ax: Any, panel: Panel, normalized: bool) -> list[str]:
    """Draw a panel; return what is to be said of it."""
    first, gain = panel.regions[0], panel.gains[0]
    _frame(ax, first.x, first.y, gain)
    if normalized:
        ax.set_ylabel(f"effective gain of\n{_label(first.y)}")
    for place, (region, factor) in enumerate(zip(panel.regions, panel.gains, strict=True)):
        _draw(ax, region, factor, place)
    named = _name_stable_side(
        ax, panel.regions, panel.gains, [points for _, points in panel.overlays if len(points)]
    )
    said = [f"{label}: no boundary here" for label, points in panel.overlays if not len(points)]
    for place, (label, points) in enumerate(panel.overlays):
        line = OVERLAY_LINES[place % len(OVERLAY_LINES)]
        ax.plot(*points.T, color="0.35", linestyle=line, linewidth=1.1, label=label)
    return [*_said(panel.regions, panel.gains), *said, *named]


def _frame(ax: Any, x: Range, y: Range, gain: int = 1) -> None:
    ax.set_xlim(float(x.low), float(x.high))
    ax.set_ylim(float(y.low) * gain, float(y.high) * gain)
    ax.set_xlabel(_label(x))
    ax.set_ylabel(_label(y))
    ax.tick_params(direction="in", top=True, right=True)


def _label(axis: Range) -> str:
    unit = axis.unit.replace("*", "·")
    return axis.free.label if unit == "1" else f"{axis.free.label} [{unit}]"


def _draw(ax: Any, found: Region, gain: int, place: int) -> None:
    """Draw one region: its stable side hatched and named, its boundary as a line."""
    path = need("matplotlib.path", "plot")
    patches = need("matplotlib.patches", "plot")
    line, colour = LINES[place % len(LINES)], COLOURS[place % len(COLOURS)]
    scale = np.array([1.0, float(gain)])
    outlines = stable_outlines(found)
    if outlines:
        vertices = np.concatenate([np.concatenate([one, one[:1]]) * scale for one in outlines])
        codes = np.concatenate(
            [
                [path.Path.MOVETO, *[path.Path.LINETO] * (len(one) - 1), path.Path.CLOSEPOLY]
                for one in outlines
            ]
        )
        ax.add_patch(
            patches.PathPatch(
                path.Path(vertices, codes),
                facecolor="none",
                edgecolor=colour,
                alpha=HATCH,
                hatch=HATCHES[place % len(HATCHES)],
                linewidth=0,
            )
        )
    for number in range(len(found.curves)):
        points = drawn_points(found, number) * scale
        ax.plot(
            *points.T,
            color=colour,
            linestyle=line,
            linewidth=1.5,
            label=None if number else _name(found, gain),
        )
    if not found.curves:
        ax.plot([], [], color=colour, linestyle=line, linewidth=1.5, label=_name(found, gain))


def _name(found: Region, gain: int) -> str:
    return found.topology if gain == 1 else f"{found.topology}, y × {gain}"


def _said(regions: Sequence[Region], gains: Sequence[int]) -> list[str]:
    """Say which regions have no boundary, and which have the same."""
    told = []
    drawn: list[tuple[str, list[Floats]]] = []
    for found, gain in zip(regions, gains, strict=True):
        name, scale = _name(found, gain), np.array([1.0, gain / gains[0]])
        rectangle = regions[0].rectangle
        curves = [rectangle.points(drawn_points(found, n) * scale) for n in range(len(found.curves))]
        if not curves:
            told.append(f"{name}: stable {'everywhere' if found.corner else 'nowhere'}")
            continue
        same = next((other for other, theirs in drawn if _are_one(curves, theirs)), None)
        told += [] if same is None else [f"{name}: identical to {same}"]
        drawn.append((name, curves))
    return told


def _are_one(these: Sequence[Floats], those: Sequence[Floats]) -> bool:
    """Return whether polylines in the unit square lie on one another."""
    return all(_off(np.concatenate(one), other) <= SAME for one, other in ((these, those), (those, these)))


def _off(points: Floats, curves: Sequence[Floats]) -> float:
    """Return how far the point (k, 2) that is furthest from all polylines is from the nearest."""
    nearest = np.full(len(points), np.inf)
    for curve in curves:
        start, step = curve[:-1], np.diff(curve, axis=0)
        length = np.square(step).sum(axis=1)
        for place, point in enumerate(points):
            share = ((point - start) * step).sum(axis=1) / np.where(length, length, 1.0)
            gap = point - start - np.clip(share, 0, 1)[:, None] * step
            nearest[place] = min(nearest[place], np.sqrt(np.square(gap).sum(axis=1).min()))
    return float(nearest.max())


def drawn_points(found: Region, number: int) -> Floats:
    """Return a curve as a polyline in SI (k, 2), fine enough for the eye."""
    curve = found.curves[number]
    if not curve.smooth:
        return curve.points
    pieces = -(-DRAWN // (len(curve.points) - 1))
    parts = [between(curve.points, curve.handles, share / pieces) for share in range(pieces)]
    return np.concatenate([np.stack(parts, axis=1).reshape(-1, 2), curve.points[-1:]])


def stable_outlines(found: Region) -> list[Floats]:
    """Return the closed polylines in SI around the stable side: outlines and, the other way round, holes.

    A curve that ends at the rectangle's edge is followed, counter-clockwise along the edge, by the next one
    that starts there: the stable side is on the left all the way.
    """
    rectangle = found.rectangle
    chains = _chains([rectangle.points(drawn_points(found, n)) for n in range(len(found.curves))])
    closed = [one for one in chains if np.array_equal(one[0], one[-1])]
    left = [one for one in chains if not np.array_equal(one[0], one[-1])]
    outlines = [one[:-1] for one in closed]
    if not left and found.corner:
        outlines.append(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
    while left:
        ring = [left.pop(0)]
        while True:
            here = _along_rim(ring[-1][-1])
            starts = [(_along_rim(one[0]) - here) % 4 for one in (ring[0], *left)]
            nearest = int(np.argmin(starts))
            ring.append(_rim_corners(here, starts[nearest]))
            if nearest == 0:
                break
            ring.append(left.pop(nearest - 1))
        outlines.append(np.concatenate(ring))
    return [rectangle.values(one) for one in outlines]


def _chains(curves: list[Floats]) -> list[Floats]:
    """Return curves joined where one begins as another ends, at a corner."""
    chains = list(curves)
    place = 0
    while place < len(chains):
        following = next(
            (n for n, one in enumerate(chains) if n != place and np.array_equal(one[0], chains[place][-1])),
            None,
        )
        if following is None or np.array_equal(chains[place][0], chains[place][-1]):
            place += 1
            continue
        chains[place] = np.concatenate([chains[place], chains[following][1:]])
        del chains[following]
        place = 0
    return chains


def _along_rim(point: Floats) -> float:
    """Return where on the rectangle's edge a point is: 0 to 4, counter-clockwise from (0, 0)."""
    x, y = np.clip(point, 0, 1)
    distances = [y, 1 - x, 1 - y, x]
    side = int(np.argmin(distances))
    return float(side + (x, y, 1 - x, 1 - y)[side])


def _rim_corners(start: float, length: float) -> Floats:
    """Return the rectangle's corners passed on its edge."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    passed = [corner for corner in range(1, 9) if start < corner < start + length]
    return corners[[corner % 4 for corner in passed]].reshape(-1, 2)


def _name_stable_side(
    ax: Any, regions: Sequence[Region], gains: Sequence[int], others: Sequence[Floats] = ()
) -> list[str]:
    """Write a word where it fits best: stable in as many regions as can be, far from all curves and edges.

    Where it would cover a curve it is not written, and what is said in its place is returned.

    Parameters
    ----------
    ax, regions, gains
        The matplotlib Axes, what is drawn in it, and the factors of y.
    others
        Curves that are drawn as well (k, 2), as drawn.
    """
    axis = (np.arange(SEARCHED) + 0.5) / SEARCHED
    points = np.stack([np.repeat(axis, SEARCHED), np.tile(axis, SEARCHED)], axis=1)
    first = regions[0].rectangle
    # Distances in halves of the word: a point of a curve is in its box where both are below 1.
    room = (np.minimum(points, 1 - points) / WORD).min(axis=1)
    shared = np.zeros(len(points), dtype=np.int64)
    drawn = [first.points(one / [1.0, gains[0]]) for one in others]
    for found, gain in zip(regions, gains, strict=True):
        # All in units of the first region's rectangle, as drawn.
        scale = np.array([1.0, gain / gains[0]])
        own = found.rectangle.points(first.values(points) / scale)
        shared += side_of_curves(found, own)[0]
        drawn += [first.points(drawn_points(found, number) * scale) for number in range(len(found.curves))]
    for curve in drawn:
        room = np.minimum(room, (np.abs(points[:, None] - curve[::3]) / WORD).max(axis=2).min(axis=1))
    if not shared.any():
        return []
    room[shared < shared.max()] = -1
    if room.max() < 1:
        return ["hatched: stable"]
    x, y = first.values(points[np.argmax(room)]) * [1.0, gains[0]]
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.9}
    ax.text(x, y, "stable", ha="center", va="center", fontsize=9, bbox=box)
    return []
