"""Pictures of stable regions in the style of papers: curves, hatched stable side, multiple panels.

Takes: a `Region`, or `Panels` of them.
Gives: `region_picture`, `panels_picture`, `draw_intersection`; `panel_letter`; `plotted_points`,
`stable_outlines`.
Guarantees: curves are distinct without color. The stable side is hatched. The legend is above the axes and
covers nothing; the stability criterion and the limitations are below them, once for all panels.
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

from apc.compiler.wording import known_digits
from apc.output.formatting import MEANT, axis_label
from apc.output.pictures import (
    COLOURS,
    LINES,
    new_figure,
    notes_below,
    prefixed,
    scale_ticks,
    short_legend,
)
from apc.regions.curves import between
from apc.regions.panels import Panel
from apc.regions.stable_region import side_of_curves
from apc.support.optional import need

if TYPE_CHECKING:
    from apc.parameter_values.parameter_names import Range
    from apc.regions.panels import Panels
    from apc.regions.stable_region import Region

Floats = NDArray[np.float64]

HATCHES = ("///", "\\\\\\", "|||", "---", "xxx", "+++", "...", "ooo")  # of each region's stable side
OVERLAY_LINES = ((0, (1, 2)), (0, (3, 1, 1, 1, 1, 1)), (0, (8, 3)))
HATCH = 0.25  # darkness of hatches: lighter than curves
PANEL = 3.5  # inches: the side of a panel, one column of a paper
SIDES = 301  # points along each side of the rectangle at which an intersection is evaluated
PLOTTED = 240  # straight lines a curve is drawn by at least: fewer show their corners
SAME = 1e-3  # of a panel's sides, less than a line is wide: curves that nowhere differ by more are one
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
STABLE = "Hatched: stable."
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
    panel = Panel("", (region,), (1,), ())
    own = new_figure((PANEL + 0.6, PANEL + 0.3)) if ax is None else None
    ax = own.subplots() if own else ax
    _draw_panel(ax, "", panel)
    if own:
        notes_below(own, _notes([panel]))
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
        _draw_panel(ax, title, panel)
        if panels.normalized:
            ax.set_ylabel(f"effective gain of\n{ax.get_ylabel()}")
        ax.label_outer(remove_inner_ticks=False)
    for ax in axes[count:]:
        ax.set_axis_off()
    handles, labels = short_legend(*axes[0].get_legend_handles_labels())
    if len(labels) > 1 or panels.normalized:
        style = {"frameon": False, "fontsize": 8.5, "ncols": min(columns, 2), "handlelength": 3}
        figure.legend(handles, labels, loc="outside upper center", **style)
    notes_below(figure, _notes(panels.panels))
    return figure


def _notes(panels: Sequence[Panel]) -> list[str]:
    """Return the notes on all regions of a figure: hatching, stability criterion and limitations."""
    regions = [region for panel in panels for region in panel.regions]
    hatched = [STABLE] if any(region.corner or region.curves for region in regions) else []
    criteria = [MEANT[region.criterion] for region in regions if region.criterion in MEANT]
    return [*hatched, *criteria, *(note for region in regions for note in region.limitations)]


def _unbroken(settings: str) -> str:
    """Return the settings of a panel without line breaks inside a setting."""
    parts = [part.strip().replace("=", " = ").replace(" ", NO_BREAK) for part in settings.split(",")]
    return ", ".join(parts)


def draw_intersection(ax: Any, regions: Sequence[Region], names: Sequence[str]) -> None:
    """Draw the intersection of regions with the same axes, hatched, and the boundaries of those with names.

    Parameters
    ----------
    ax
        The matplotlib Axes.
    regions
        The regions.
    names
        The names of the first of them.
    """
    _set_axes(ax, regions[0], 1)
    sides = np.linspace(0, 1, SIDES)
    grid = np.stack(np.meshgrid(sides, sides), axis=-1).reshape(-1, 2)
    stable = np.all([side_of_curves(region, grid)[0] for region in regions], axis=0)
    x, y = np.moveaxis(regions[0].rectangle.values(grid).reshape(SIDES, SIDES, 2), -1, 0)
    if stable.any():
        hatched = ax.contourf(
            x, y, stable.reshape(SIDES, SIDES) * 1.0, [0.5, 1.5], colors="none", hatches=["///"]
        )
        hatched.set(edgecolor=(0, 0, 0, HATCH), linewidth=0)
    label: str | None = (
        f"stable in all {len(regions)} scenarios" if len(regions) > 1 else "stability boundary"
    )
    for index, region in enumerate(regions):
        curves = [plotted_points(region, number) for number in range(len(region.curves))]
        others = [other for other in regions if other is not region]
        for number, points in enumerate(curves):
            if index < len(names) and len(regions) > 1:
                style = {"color": COLOURS[1 + index % 6], "linestyle": LINES[1 + index % 7], "linewidth": 1.0}
                ax.plot(*points.T, label=None if number else names[index], **style)
            unit = region.rectangle.points(points)
            inside = np.all([np.any(side_of_curves(other, unit), axis=0) for other in others], axis=0)
            part = np.where(np.broadcast_to(inside, len(points))[:, None], points, np.nan)
            if not np.isnan(part).all():
                ax.plot(*part.T, color="black", linewidth=1.8, label=label, zorder=3)
                label = None


def _set_axes(ax: Any, region: Region, gain: int) -> None:
    """Set limits, ticks and labels of the axes of a region whose y is multiplied by `gain`."""
    for axis, interval, times in ((ax.xaxis, region.x, 1), (ax.yaxis, region.y, gain)):
        low, high = float(interval.low) * times, float(interval.high) * times
        factor, unit = _axis_unit(region, interval, max(abs(low), abs(high)))
        axis.set_label_text(axis_label(interval.free.label, unit))
        scale_ticks(axis, low, high, factor)
    x, y = region.x, region.y
    ax.set(xlim=(float(x.low), float(x.high)), ylim=(float(y.low) * gain, float(y.high) * gain))
    ax.tick_params(direction="in", top=True, right=True)


def _draw_panel(ax: Any, title: str, panel: Panel) -> None:
    """Draw regions and overlays, of one region its share of the rectangle in the title."""
    regions, gains = panel.regions, panel.gains
    _set_axes(ax, regions[0], gains[0])
    printed = []
    plotted: list[tuple[str, Floats]] = []
    for index, (region, gain) in enumerate(zip(regions, gains, strict=True)):
        name = region.topology if gain == 1 else f"{region.topology}, y × {gain}"
        curves = [plotted_points(region, number) * [1, gain] for number in range(len(region.curves))]
        _draw_region(ax, region, gain, index, curves, name)
        if not curves:
            printed.append(f"{name}: stable {'everywhere' if region.corner else 'nowhere inside'}")
            continue
        points = np.concatenate([_dense(curve / [1, gains[0]], regions[0]) for curve in curves])
        same = next((other for other, theirs in plotted if _are_equal(points, theirs)), None)
        printed += [] if same is None else [f"{name}: identical to {same}"]
        plotted.append((name, points))
    for index, (label, points) in enumerate(panel.overlays):
        if not len(points):
            printed.append(f"{label}: no boundary in the rectangle")
        line = OVERLAY_LINES[index % len(OVERLAY_LINES)]
        ax.plot(*np.reshape(points, (-1, 2)).T, color="0.35", linestyle=line, linewidth=1.1, label=label)
    if len(regions) == 1 and regions[0].curves:
        printed.append(f"stable: {_share(regions[0])} % of the rectangle")
    texts = dict.fromkeys([title, *printed])
    ax.set_title("\n".join(line for text in texts for line in textwrap.wrap(text, 48)), fontsize=8.5)


def _axis_unit(region: Region, interval: Range, largest: float) -> tuple[float, str]:
    """Return the factor from SI to the unit of an axis, and that unit; probabilities are in percent."""
    channels = [channel for link in region.model.links for channel in link.channels]
    losses = [channel.loss.p for channel in channels if channel.loss]
    return (100.0, "%") if interval.free.name in losses else prefixed(largest, interval.unit)


def _share(region: Region) -> str:
    """Return the stable area in percent of the rectangle."""
    percent = 100 / float(region.rectangle.width.prod())
    return known_digits(percent * region.stable_area, percent * region.stable_area_error, 3)


def _draw_region(
    ax: Any, region: Region, gain: int, style_index: int, curves: Sequence[Floats], label: str
) -> None:
    """Draw one region: its stable side hatched, its boundary curves as lines.

    Parameters
    ----------
    ax
        The matplotlib Axes.
    region, gain
        The region, and the factor on its y.
    style_index
        The number of the region in its panel; it selects color, line style and hatch.
    curves, label
        The points (k, 2) of each curve, y multiplied by `gain`, and their common entry in the legend.
    """
    path_type = need("matplotlib.path", "plot").Path
    patches = need("matplotlib.patches", "plot")
    colour = COLOURS[style_index % len(COLOURS)]
    outlines = [
        path_type(np.concatenate([values, values[:1]]) * [1, gain], closed=True)
        for values in stable_outlines(region)
    ]
    if outlines:
        style = {"facecolor": "none", "edgecolor": colour, "alpha": HATCH, "linewidth": 0}
        outline_path = path_type.make_compound_path(*outlines)
        ax.add_patch(patches.PathPatch(outline_path, hatch=HATCHES[style_index % len(HATCHES)], **style))
    for curve_index, points in enumerate(curves or [np.empty((0, 2))]):
        style = {"color": colour, "linestyle": LINES[style_index % len(LINES)], "linewidth": 1.5}
        ax.plot(*points.T, label=None if curve_index else label, **style)


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
