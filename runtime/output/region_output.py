"""Stable regions as text, plain data, tables and files.

Takes: a `Region`, or `Panels` of them.
Gives: their texts, documents, rows and pictures.
Guarantees: a text states the limits of the search.
Does not: compute, or draw (see `region_picture`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from apc.compiler.wording import counted, known_digits
from apc.output.analysis_output import range_document
from apc.output.formatting import (
    MEANT,
    Lines,
    Plain,
    headed,
    labelled,
    notes,
    picked,
    quantity,
    sentences,
    span,
    table,
)
from apc.output.region_picture import panel_letter, panels_picture, region_picture  # noqa: F401 -- looked up
from apc.parameter_values.display_units import as_shown
from apc.support.tables import Row, TableColumn, Tabled

if TYPE_CHECKING:
    from apc.regions.panels import Panel, Panels
    from apc.regions.stable_region import Curve, Region


# Curves listed; of a boundary with more curves only the number is printed.
MOST_CURVES = 12

# A coordinate, relative to the side of the rectangle, and a frequency in Hz, below which zero is printed.
LEAST_SHARE, LEAST_HZ = 1e-6, 1e-6

ERROR = "error: relative to each coordinate of the curve"


def region_text(region: Region) -> Lines:
    """Yield the output of `apc region` for one region."""
    axes = [
        (letter, interval.free.label, span(float(interval.low), float(interval.high), interval.unit))
        for letter, interval in (("x", region.x), ("y", region.y))
    ]
    off, percent = region.stable_area_error, 100 / float(region.rectangle.width.prod())
    share = known_digits(percent * region.stable_area, percent * off, 4)
    yield f"{region.topology}: {_words(region)}"
    yield from notes(MEANT.get(region.criterion, ""), *region.limitations)
    yield ""
    yield from table([("axis", "parameter", "range"), *axes])
    yield ""
    yield from labelled(("stable area", f"{share} % of the rectangle"))
    if region.curves:
        rows = [("mode", "f [Hz]", "from (x, y)", "to (x, y)", "error")]
        shown = [curve for curve in region.curves if not _is_point(region, curve)][:MOST_CURVES]
        curves = [*rows, *(_row(region, curve) for curve in shown)]
        if not any(_is_modal(curve) for curve in region.curves):
            curves = [cells[2:] for cells in curves]
        yield from headed("Boundary curves", table(curves, "<" * len(curves[0])))
        yield from notes(ERROR)
        left = len(region.curves) - len(shown)
        if left > 0:
            yield f"  {counted(left, 'more curve')} not shown (--json)"
    if coarse := region.coarse:
        most, many = max(curve.error for curve in coarse), counted(len(coarse), "curve")
        yield ""
        yield from sentences(
            f"relative error of {many}: up to {most:.0e}, above the requested {region.tolerance:.0e}"
        )
    sizes = zip(region.cell, (region.x, region.y), strict=True)
    cell = " × ".join(quantity(size, axis.unit, 4) for size, axis in sizes)
    yield ""
    yield from sentences(f"Stable or unstable regions smaller than a cell of {cell} could be missed.")
    if region.stepped and region.criterion == "passive":
        yield from sentences(
            "The points of a curve are on the boundary and connected by straight lines; the error is an "
            "estimate from the midpoints of these lines, not a bound."
        )
    elif region.stepped:
        yield from sentences("The boundary has steps along a time axis; it is accurate to one cell.")


def _words(region: Region) -> str:
    """Return in words where a region is stable, and of how many curves its boundary consists."""
    if region.curves:
        closed = sum(curve.closed for curve in region.curves)
        pieces = counted(len(region.curves), "curve")
        return f"stable in a part of the rectangle, boundary: {pieces}" + (
            f" ({closed} closed)" if closed else ""
        )
    return "stable in the whole rectangle" if region.corner else "stable nowhere inside the rectangle"


def _row(region: Region, curve: Curve) -> tuple[str, ...]:
    low, high = (f"{value if value > LEAST_HZ else 0.0:.4g}" for value in curve.frequency_hz)
    low = "nan" if np.isnan(curve.frequency_hz[0]) else low
    frequency = "–" if low == "nan" else low if low == high else f"{low} to {high}"
    end = "closed" if curve.closed else _point(region, curve, -1)
    return f"{curve.mode:.11}", frequency, _point(region, curve, 0), end, f"{curve.error:.0e}"


def _point(region: Region, curve: Curve, index: int) -> str:
    """Return a point of a curve in the units of the axes; its error is relative to each coordinate."""
    numbers = []
    for value, axis in zip(curve.points[index].tolist(), (region.x, region.y), strict=True):
        by = float(as_shown(float(axis.high), axis.unit)[0])
        value = value if abs(value) > LEAST_SHARE * float(axis.high - axis.low) else 0.0
        numbers.append(known_digits(value * by, curve.error * abs(value * by), 6))
    return f"({', '.join(numbers)})"


def _is_modal(curve: Curve) -> bool:
    """Return whether a curve is the stability boundary of a mode, not of second moments or passivity."""
    return not np.isnan(curve.frequency_hz[0])


def _is_point(region: Region, curve: Curve) -> bool:
    """Return whether a curve is shorter than `LEAST_SHARE` of each side of the rectangle."""
    return bool(np.all(np.ptp(region.rectangle.points(curve.points), axis=0) < LEAST_SHARE))


def region_document(region: Region) -> Plain:
    """Return the `apc region --json` data of one region."""
    names = ("topology", "tolerance", "stable_area", "stable_area_error", "cell", "criterion", "limitations")
    each = ("points", "handles", "error", "mode", "frequency_hz", "closed", "smooth")
    return {
        **picked(region, *names),
        "x": range_document(region.x),
        "y": range_document(region.y),
        "coarse": [number for number, curve in enumerate(region.curves) if curve in region.coarse],
        "boundary": [{**picked(curve, *each), "stable_side": "left"} for curve in region.curves],
        "area_unit": _product(region.x.unit, region.y.unit),
        "finest_cell": region.finest,
        "origin": dict(region.model.origin.digests),
    }


def _product(x: str, y: str) -> str:
    """Return the unit of an area."""
    units = [unit for unit in (x, y) if unit != "1"]
    return "*".join(f"({unit})" if "/" in unit or "*" in unit else unit for unit in units) or "1"


def panels_text(panels: Panels) -> Lines:
    """Yield the output of `apc region` for several regions."""
    for index, panel in enumerate(panels.panels):
        if panel.title:
            yield f"({panel_letter(index)}) {panel.title}\n"
        for region, gain in zip(panel.regions, panel.gains, strict=True):
            yield from region_text(region)
            if gain != 1:
                yield f"  Normalized to equal effective gain: y is multiplied by {gain}."
            yield ""


def panels_document(panels: Panels) -> Plain:
    """Return the output of `apc region --json`: the region if single, else the panels."""
    if panels.alone is not None:
        return panels.alone.to_dict()
    return {"normalized": panels.normalized, "panels": [_panel_document(panel) for panel in panels.panels]}


def _panel_document(panel: Panel) -> Plain:
    """Return a panel as plain data: its regions, with the factor of y, and its overlays."""
    return {
        "panel": panel.title,
        "regions": [
            {**region.to_dict(), "y_multiplied_by": gain}
            for region, gain in zip(panel.regions, panel.gains, strict=True)
        ],
        "overlays": [{"label": label, "points": points.tolist()} for label, points in panel.overlays],
    }


def panels_rows(panels: Panels) -> Tabled:
    """Return the columns of a table of boundary points, a row a point, and how they were made."""
    regions = [(region, panel.title) for panel in panels.panels for region in panel.regions]
    made = {
        "axes": [range_document(interval) for interval in (regions[0][0].x, regions[0][0].y)],
        "limitations": {region.topology: list(region.limitations) for region, _ in regions},
        "origin": {region.topology: dict(region.model.origin.digests) for region, _ in regions},
    }
    rows = (row for region, title in regions for row in _rows(region, title))
    return _columns(regions[0][0]), rows, made


def region_rows(region: Region) -> Tabled:
    """Return the same of one region."""
    return _columns(region), _rows(region), {}


def _columns(region: Region) -> list[TableColumn]:
    """Return the columns of a table of boundary points."""
    x, y = (
        TableColumn(interval.free.label, "" if interval.unit == "1" else interval.unit)
        for interval in (region.x, region.y)
    )
    words = (TableColumn("panel", kind="text"), TableColumn("topology", kind="text"))
    curve = (TableColumn("curve", kind="count"), TableColumn("mode", kind="text"))
    return [*words, *curve, x, y, TableColumn("error")]


def _rows(region: Region, panel: str = "") -> Iterator[Row]:
    """Yield a row a point of every curve, in the order of `_columns`."""
    for number, curve in enumerate(region.curves):
        mode = curve.mode
        for point in curve.points.tolist():
            yield (panel, region.topology, number, mode, *point, curve.error)
