"""Stable regions as text, plain data, tables, pictures as papers print them, and files.

Takes: a `Region`, or `Panels` of them, and a path.
Gives: their texts, documents, tables and pictures; `check_region_path`, `write_panels`; `stable_outlines`.
Guarantees: a text says what was not looked for. In a picture curves can be told apart without colour; the
stable side is hatched and named; the legend stands below the axes, over nothing. A file that can't be written
is refused before anything is computed, as far as that can be known, and written whole or not at all.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from math import isnan
from pathlib import Path
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.files import check_target, write_text
from apc.compiler.words import known_digits, measured, with_unit
from apc.distribution import program_version
from apc.optional import need
from apc.present.analysis import range_document
from apc.present.forms import document, json_text, note
from apc.present.pictures import FORMATS, write_figure
from apc.regions.curves import between
from apc.regions.region import side_of_curves
from apc.suffixes import check_suffix
from apc.tables import SUFFIXES, Column, Row, check_table_path, write_table

if TYPE_CHECKING:
    import pandas

    from apc.frame.names import Range
    from apc.regions.panels import Panel, Panels
    from apc.regions.region import Curve, Region

Floats = NDArray[np.float64]

# Curves listed; a boundary in more pieces is told by their number.
MOST_CURVES = 12

# Of each region: its line, its colour (distinct in print and for colour-blind eyes: Okabe and Ito, 2008), and
# how its stable side is hatched.
STYLES = (
    ("-", "#000000", "///"),
    ((0, (5, 2)), "#0072B2", "\\\\\\"),
    ((0, (5, 1.5, 1, 1.5)), "#D55E00", "|||"),
    ((0, (1, 1.2)), "#009E73", "---"),
)
OVERLAY_LINES = ((0, (1, 2)), (0, (3, 1, 1, 1, 1, 1)), (0, (8, 3)))
HATCH = 0.25  # how dark hatches are: curves and words must stand out
PANEL = 3.5  # inches: the side of a panel, one column of a paper
DRAWN = 240  # straight lines a curve is drawn by at least: fewer show their corners
SEARCHED = 48  # points along each side among which the widest place for a word is looked for
NO_BREAK = "\N{NO-BREAK SPACE}"


def region_text(found: Region) -> str:
    """Return what `apc region` prints of one region."""
    width = max(len(found.x.free.label), len(found.y.free.label))
    lines = [f"{found.topology}: {_words(found)}"]
    for text in found.left_out:
        lines += note(text)
    lines.append("")
    for letter, axis in (("x", found.x), ("y", found.y)):
        span = with_unit(f"{float(axis.low):.6g} to {float(axis.high):.6g}", axis.unit)
        lines.append(f"  {letter}  {axis.free.label:<{width}}  {span}")
    whole = float(found.rectangle.width.prod())
    share = 100 * found.stable_area / whole
    off = found.stable_area_error
    area = measured(found.stable_area, off) if off else f"{found.stable_area:.9g}"
    lines += ["", f"  stable area  {area} in SI, {share:.4g} % of the rectangle"]
    if found.curves:
        lines += ["", "  boundary     frequency [Hz]   from (x, y)         to (x, y)           error"]
        lines += [_row(curve) for curve in found.curves[:MOST_CURVES]]
        left = len(found.curves) - MOST_CURVES
        if left > 0:
            lines.append(f"  and {left} more (--json lists all)")
    cell = " × ".join(
        with_unit(f"{size:.4g}", axis.unit) for size, axis in zip(found.cell, (found.x, found.y), strict=True)
    )
    lines += ["", f"  Looked at in cells of {cell}, and finer where the"]
    lines.append("  eigenvalues hint at more; an island inside one cell could be missed.")
    if found.stepped:
        lines.append("  Along these times the boundary has steps: it is right to a cell only.")
    return "\n".join(lines)


def _words(found: Region) -> str:
    if found.curves:
        closed = sum(curve.closed for curve in found.curves)
        pieces = "one piece" if len(found.curves) == 1 else f"{len(found.curves)} pieces"
        return f"the stable region has a boundary in {pieces}" + (f", {closed} closed" if closed else "")
    return "stable in the whole rectangle" if found.corner else "stable nowhere in the rectangle"


def _row(curve: Curve) -> str:
    low, high = curve.frequency_hz
    span = (
        "–" if isnan(low) else f"{low:.4g}" if f"{low:.4g}" == f"{high:.4g}" else f"{low:.4g} to {high:.4g}"
    )
    start = _point(curve, 0)
    end = "closed" if curve.closed else _point(curve, -1)
    return f"  {curve.mode:<11.11}  {span:<15}  {start:<18}  {end:<18}  {curve.error:.0e}"


def _point(curve: Curve, place: int) -> str:
    """Return a point of a curve, whose error is relative to each coordinate."""
    return "({}, {})".format(*(known_digits(one, curve.error * abs(one), 6) for one in curve.points[place]))


def region_document(found: Region) -> dict[str, Any]:
    """Return what `apc region --json` prints of one region."""
    return {
        "topology": found.topology,
        "x": range_document(found.x),
        "y": range_document(found.y),
        "boundary": [_curve_document(curve) for curve in found.curves],
        "stable_area": found.stable_area,
        "stable_area_error": found.stable_area_error,
        "area_unit": _product(found.x.unit, found.y.unit),
        "cell": list(found.cell),
        "finest_cell": found.finest,
        "left_out": list(found.left_out),
        "origin": dict(found.system.origin.texts),
    }


def _curve_document(curve: Curve) -> dict[str, Any]:
    return {
        "points": curve.points.tolist(),
        "tangents": curve.tangents.tolist(),
        "error": curve.error,
        "mode": curve.mode,
        "frequency_hz": document(curve.frequency_hz),
        "closed": curve.closed,
        "smooth": curve.smooth,
        "stable_side": "left",
    }


def _product(x: str, y: str) -> str:
    """Return the unit of an area."""
    units = [unit for unit in (x, y) if unit != "1"]
    return "*".join(f"({unit})" if "/" in unit or "*" in unit else unit for unit in units) or "1"


def region_table(found: Region) -> pandas.DataFrame:
    """Return the points of all curves of a region."""
    return need("pandas", "data").DataFrame(
        list(_rows(found)), columns=[one.heading for one in _columns(found)]
    )


def panels_text(found: Panels) -> str:
    """Return what `apc region` prints of several regions."""
    lines: list[str] = []
    for place, panel in enumerate(found.panels):
        if panel.title:
            lines += [f"({panel_letter(place)}) {panel.title}", ""]
        for region, gain in zip(panel.regions, panel.gains, strict=True):
            lines.append(region_text(region))
            if gain != 1:
                lines.append(f"  Compared at equal effective gain: y counts {gain} times, once an other.")
            lines.append("")
    return "\n".join(lines).rstrip("\n")


def panel_letter(place: int) -> str:
    """Return the letter of a panel, "a" for the first; after "z" they begin anew."""
    return ascii_lowercase[place % len(ascii_lowercase)]


def panels_document(found: Panels) -> dict[str, Any]:
    """Return what `apc region --json` prints: the region itself if it is alone, else the panels."""
    if found.alone is not None:
        return found.alone.to_dict()
    return {"normalized": found.normalized, "panels": [_panel_document(one) for one in found.panels]}


def _panel_document(panel: Panel) -> dict[str, Any]:
    return {
        "panel": panel.title,
        "regions": [
            {**one.to_dict(), "y_multiplied_by": gain}
            for one, gain in zip(panel.regions, panel.gains, strict=True)
        ],
        "overlays": [{"label": label, "points": points.tolist()} for label, points in panel.overlays],
    }


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
    _name_stable_side(ax, (found,), (1,))
    _entitle(ax, "", (found,))
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
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = figures.Figure(figsize=(PANEL * columns + 0.6, PANEL * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for place, (ax, panel) in enumerate(zip(axes, found.panels, strict=False)):
        _panel(ax, panel, found.normalized)
        if place % columns:
            ax.set_ylabel("")
        letter = f"({panel_letter(place)}) " if count > 1 else ""
        _entitle(ax, f"{letter}{_unbroken(panel.title)}".strip(), panel.regions)
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


def _entitle(ax: Any, title: str, regions: Sequence[Region]) -> None:
    """Set a title, and beneath it what the regions leave out."""
    notes = dict.fromkeys(note for one in regions for note in one.left_out)
    lines = [line for text in (title, *notes) for line in textwrap.wrap(text, 48)]
    if lines:
        ax.set_title("\n".join(lines), fontsize=8.5)


def _unbroken(settings: str) -> str:
    """Return what a panel sets with no line break inside a setting."""
    parts = [part.strip().replace("=", " = ").replace(" ", NO_BREAK) for part in settings.split(",")]
    return ", ".join(parts)


def _panel(ax: Any, panel: Panel, normalized: bool) -> None:
    first, gain = panel.regions[0], panel.gains[0]
    _frame(ax, first.x, first.y, gain)
    if normalized:
        ax.set_ylabel(f"effective gain of\n{_label(first.y)}")
    for place, (region, factor) in enumerate(zip(panel.regions, panel.gains, strict=True)):
        _draw(ax, region, factor, place)
    _name_stable_side(ax, panel.regions, panel.gains)
    for place, (label, points) in enumerate(panel.overlays):
        line = OVERLAY_LINES[place % len(OVERLAY_LINES)]
        where = "" if len(points) else " (no boundary here)"
        ax.plot(*points.T, color="0.35", linestyle=line, linewidth=1.1, label=f"{label}{where}")


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
    line, colour, hatch = STYLES[place % len(STYLES)]
    name = found.topology if gain == 1 else f"{found.topology}, y × {gain}"
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
                hatch=hatch,
                linewidth=0,
            )
        )
    for number in range(len(found.curves)):
        points = drawn_points(found, number) * scale
        ax.plot(*points.T, color=colour, linestyle=line, linewidth=1.5, label=None if number else name)
    if not found.curves:
        ax.plot([], [], color=colour, linestyle=line, linewidth=1.5, label=f"{name}: {_nowhere(found)}")


def _nowhere(found: Region) -> str:
    return "stable everywhere" if found.corner else "stable nowhere"


def drawn_points(found: Region, number: int) -> Floats:
    """Return a curve as a polyline in SI (k, 2), fine enough for the eye."""
    curve = found.curves[number]
    if not curve.smooth:
        return curve.points
    rectangle = found.rectangle
    knots = rectangle.points(curve.points)
    ends = (knots[:-1], knots[1:], curve.tangents[:-1], curve.tangents[1:])
    pieces = -(-DRAWN // (len(knots) - 1))
    parts = [between(*ends, share / pieces) for share in range(pieces)]
    points = np.stack(parts, axis=1).reshape(-1, 2)
    return rectangle.values(np.concatenate([points, knots[-1:]]))


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


def _name_stable_side(ax: Any, regions: Sequence[Region], gains: Sequence[int]) -> None:
    """Write a word where it fits best: stable in as many regions as can be, far from all curves and edges."""
    axis = (np.arange(SEARCHED) + 0.5) / SEARCHED
    points = np.stack([np.repeat(axis, SEARCHED), np.tile(axis, SEARCHED)], axis=1)
    first = regions[0].rectangle
    room = np.minimum(points, 1 - points).min(axis=1)
    shared = np.zeros(len(points), dtype=np.int64)
    for found, gain in zip(regions, gains, strict=True):
        # All in units of the first region's rectangle, as drawn.
        scale = np.array([1.0, gain / gains[0]])
        own = found.rectangle.points(first.values(points) / scale)
        shared += side_of_curves(found, own)[0]
        for number in range(len(found.curves)):
            drawn = first.points(drawn_points(found, number)[::3] * scale)
            room = np.minimum(room, np.sqrt(np.square(points[:, None] - drawn).sum(axis=2)).min(axis=1))
    if shared.any():
        room[shared < shared.max()] = -1
        x, y = first.values(points[np.argmax(room)]) * [1.0, gains[0]]
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.9}
        ax.text(x, y, "stable", ha="center", va="center", fontsize=9, bbox=box)


def check_region_path(path: Path) -> str:
    """Refuse a file that can't be written here, or of no known format; return the suffix of its format.

    Raises
    ------
    ApcError
        E878 the suffix, E601 the place, E887 or E875 a library that is missing.
    """
    suffix = check_suffix(path, (*FORMATS, *SUFFIXES, ".json"), "--out")
    check_target(path)
    if suffix in SUFFIXES:
        check_table_path(path, "--out")
    elif suffix in FORMATS:
        need("matplotlib.figure", "plot")
    return suffix


def write_panels(path: Path, found: Panels) -> None:
    """Write regions to a file, its format chosen by the suffix. Raises ApcError E601 if it can't."""
    suffix = check_region_path(path)
    if suffix in FORMATS:
        write_figure(found.plot(), path)
    elif suffix in SUFFIXES:
        first = found.panels[0].regions[0]
        rows = (row for panel in found.panels for one in panel.regions for row in _rows(one, panel.title))
        made = {
            "axes": [range_document(first.x), range_document(first.y)],
            "apc": program_version(),
            "left_out": {one.topology: list(one.left_out) for panel in found.panels for one in panel.regions},
            "origin": _origins(found),
        }
        write_table(path, _columns(first), rows, made)
    else:
        write_text(path, json_text(found.to_dict()))


def _origins(found: Panels) -> dict[str, Any]:
    return {one.topology: dict(one.system.origin.texts) for panel in found.panels for one in panel.regions}


def _columns(found: Region) -> list[Column]:
    """Return the columns of a table of boundary points."""
    x, y = (Column(one.free.label, "" if one.unit == "1" else one.unit) for one in (found.x, found.y))
    words = (Column("panel", kind="text"), Column("topology", kind="text"))
    curve = (Column("curve", kind="count"), Column("mode", kind="text"))
    return [*words, *curve, x, y, Column("tangent x"), Column("tangent y"), Column("error")]


def _rows(found: Region, panel: str = "") -> Iterator[Row]:
    """Yield a row a point of every curve, in the order of `_columns`."""
    for number, curve in enumerate(found.curves):
        mode = curve.mode
        for point, tangent in zip(curve.points.tolist(), curve.tangents.tolist(), strict=True):
            yield (panel, found.topology, number, mode, *point, *tangent, curve.error)
