"""Pictures of stable regions in the style of papers: curves, hatched stable side, multiple panels.

Takes: a `Region`, or `Panels` of them.
Gives: `region_picture`, `panels_picture`, `draw_panel`; `panel_letter`; `plotted_points`, `stable_outlines`.
Guarantees: curves are distinct without color. The stable side is hatched, as stated in the title. The legend
is below the axes and covers nothing.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.optional import need
from apc.output.formatting import MEANT, axis_label
from apc.output.pictures import COLOURS, LINES, new_figure
from apc.regions.curves import between
from apc.regions.panels import Panel

if TYPE_CHECKING:
    from apc.regions.panels import Panels
    from apc.regions.stable_region import Region

Floats = NDArray[np.float64]

HATCHES = ("///", "\\\\\\", "|||", "---", "xxx", "+++", "...", "ooo")  # of each region's stable side
OVERLAY_LINES = ((0, (1, 2)), (0, (3, 1, 1, 1, 1, 1)), (0, (8, 3)))
HATCH = 0.25  # darkness of hatches: lighter than curves
PANEL = 3.5  # inches: the side of a panel, one column of a paper
PLOTTED = 240  # straight lines a curve is drawn by at least: fewer show their corners
SAME = 1e-3  # of a panel's sides, less than a line is wide: curves that nowhere differ by more are one
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
STABLE = "hatched: stable"
NO_BREAK = "\N{NO-BREAK SPACE}"


def panel_letter(index: int) -> str:
    """Return the letter of a panel, "a" for the first; after "z" they begin anew."""
    return ascii_lowercase[index % len(ascii_lowercase)]


def region_picture(region: Region, ax: Any = None) -> Any:
    """Draw one region into a matplotlib Axes, or into a new figure; return the Axes.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    if ax is None:
        ax = new_figure((PANEL + 0.6, PANEL)).subplots()
    draw_panel(ax, "", Panel("", (region,), (1,), ()))
    return ax


def panels_picture(panels: Panels) -> Any:
    """Draw all panels side by side; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    count = len(panels.panels)
    columns = 2 if count == 4 else min(count, 3)
    rows = -(-count // columns)
    figure = new_figure((PANEL * columns + 0.6, PANEL * rows + 0.6))
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for index, (ax, panel) in enumerate(zip(axes, panels.panels, strict=False)):
        letter = f"({panel_letter(index)}) " if count > 1 else ""
        title = f"{letter}{_unbroken(panel.title)}".strip()
        draw_panel(ax, title, panel)
        if panels.normalized:
            ax.set_ylabel(f"effective gain of\n{ax.get_ylabel()}")
        ax.label_outer(remove_inner_ticks=False)
    for ax in axes[count:]:
        ax.set_axis_off()
    handles, labels = axes[0].get_legend_handles_labels()
    if len(labels) > 1 or panels.normalized:
        style = {"frameon": False, "fontsize": 8.5, "ncols": min(columns, 2), "handlelength": 3}
        figure.legend(handles, labels, loc="outside lower center", **style)
    return figure


def _unbroken(settings: str) -> str:
    """Return the settings of a panel without line breaks inside a setting."""
    parts = [part.strip().replace("=", " = ").replace(" ", NO_BREAK) for part in settings.split(",")]
    return ", ".join(parts)


def draw_panel(ax: Any, title: str, panel: Panel) -> None:
    """Draw regions and overlays; below the title are the stability criterion and the limitations."""
    regions, gains = panel.regions, panel.gains
    x, y = regions[0].x, regions[0].y
    ax.set(xlim=(float(x.low), float(x.high)), ylim=(float(y.low) * gains[0], float(y.high) * gains[0]))
    ax.set(xlabel=axis_label(x.free.label, x.unit), ylabel=axis_label(y.free.label, y.unit))
    ax.tick_params(direction="in", top=True, right=True)
    meant = [
        MEANT[region.criterion].removesuffix(" as it is") for region in regions if region.criterion in MEANT
    ]
    printed = []
    plotted: list[tuple[str, Floats]] = []
    for index, (region, gain) in enumerate(zip(regions, gains, strict=True)):
        name = region.topology if gain == 1 else f"{region.topology}, y × {gain}"
        curves = [plotted_points(region, number) * [1, gain] for number in range(len(region.curves))]
        _draw(ax, region, gain, index, curves, name)
        if not curves:
            printed.append(f"{name}: stable {'everywhere' if region.corner else 'nowhere inside'}")
            continue
        points = np.concatenate([_dense(curve / [1, gains[0]], regions[0]) for curve in curves])
        same = next((other for other, theirs in plotted if _are_equal(points, theirs)), None)
        printed += [] if same is None else [f"{name}: identical to {same}"]
        plotted.append((name, points))
    for index, (label, points) in enumerate(panel.overlays):
        if not len(points):
            printed.append(f"{label}: no boundary here")
        line = OVERLAY_LINES[index % len(OVERLAY_LINES)]
        ax.plot(*np.reshape(points, (-1, 2)).T, color="0.35", linestyle=line, linewidth=1.1, label=label)
    hatched = [STABLE] if any(region.corner or region.curves for region in regions) else []
    limitations = [note for region in regions for note in region.limitations]
    texts = dict.fromkeys([title, *meant, *printed, *hatched, *limitations])
    ax.set_title("\n".join(line for text in texts for line in textwrap.wrap(text, 48)), fontsize=8.5)


def _draw(ax: Any, region: Region, gain: int, index: int, curves: Sequence[Floats], name: str) -> None:
    """Draw one region: its stable side hatched, its boundary as a line."""
    path = need("matplotlib.path", "plot").Path
    patches = need("matplotlib.patches", "plot")
    colour = COLOURS[index % len(COLOURS)]
    outlines = [
        path(np.concatenate([values, values[:1]]) * [1, gain], closed=True)
        for values in stable_outlines(region)
    ]
    if outlines:
        style = {"facecolor": "none", "edgecolor": colour, "alpha": HATCH, "linewidth": 0}
        whole = path.make_compound_path(*outlines)
        ax.add_patch(patches.PathPatch(whole, hatch=HATCHES[index % len(HATCHES)], **style))
    for number, points in enumerate(curves or [np.empty((0, 2))]):
        style = {"color": colour, "linestyle": LINES[index % len(LINES)], "linewidth": 1.5}
        ax.plot(*points.T, label=None if number else name, **style)


def _dense(points: Floats, region: Region) -> Floats:
    """Return points of a polyline in the unit square (k, 2), nearer to each other than `SAME`."""
    points = region.rectangle.points(points)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    some = np.linspace(0, along[-1], int(2 * along[-1] / SAME) + 2)
    return np.stack([np.interp(some, along, column) for column in points.T], axis=1)


def _are_equal(these: Floats, those: Floats) -> bool:
    """Return whether two sets of points nowhere differ by more than `SAME`."""
    from scipy.spatial import cKDTree

    return all(
        cKDTree(values).query(other)[0].max() <= SAME for values, other in ((these, those), (those, these))
    )


def plotted_points(region: Region, number: int) -> Floats:
    """Return a curve as a polyline in SI (k, 2), fine enough for the eye."""
    curve = region.curves[number]
    if not curve.smooth:
        return curve.points
    pieces = -(-PLOTTED // (len(curve.points) - 1))
    parts = [between(curve.points, curve.handles, share / pieces) for share in range(pieces)]
    return np.concatenate([np.stack(parts, axis=1).reshape(-1, 2), curve.points[-1:]])


def stable_outlines(region: Region) -> list[Floats]:
    """Return closed polylines in SI that wind once around the stable side, and not at all around the rest.

    Each curve, whose left is stable, is closed along the rectangle's edge, counter-clockwise from its end to
    its start. What these wind around too often is taken away by whole rectangles, clockwise.
    """
    rectangle = region.rectangle
    curves = [rectangle.points(plotted_points(region, number)) for number in range(len(region.curves))]
    rings = [np.concatenate([curve, _along_edge(curve[-1], curve[0])]) for curve in curves]
    wound = sum(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 for x, y in (ring.T for ring in rings))
    turns = round(wound - region.stable_area / float(rectangle.width.prod()))
    rings += [CORNERS[::-1] if turns > 0 else CORNERS] * abs(turns)
    return [rectangle.values(ring) for ring in rings]


def _along_edge(end: Floats, start: Floats) -> Floats:
    """Return points (k, 2) along the unit square's edge, counter-clockwise from next to one to another."""
    first, last = _label_position(end), _label_position(start)
    last += 4 if last < first else 0
    indices = [first, *range(math.floor(first) + 1, math.ceil(last)), last]
    return np.stack([np.interp(indices, range(12), np.tile(column, 3)) for column in CORNERS.T], axis=1)


def _label_position(point: Floats) -> float:
    """Return the nearest place on the unit square's edge, 0 to 4 counter-clockwise."""
    x, y = np.clip(point, 0, 1)
    side = int(np.argmin((y, 1 - x, 1 - y, x)))
    return float(side + (x, y, 1 - x, 1 - y)[side])
