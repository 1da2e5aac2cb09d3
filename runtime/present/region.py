"""Stable regions as text, plain data, tables and files.

Takes: a `Region`, or `Panels` of them, and a path.
Gives: their texts, documents, tables and pictures; `write_panels`.
Guarantees: a text says what was not looked for. A file that can't be written is refused before anything is
computed, as far as that can be known, and written whole or not at all.
Does not: compute, or draw itself (see `region_picture`).
"""

from __future__ import annotations

from collections.abc import Iterator
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.files import write_text
from apc.compiler.timings import part
from apc.compiler.words import counted, known_digits, measured, with_unit, wrapped
from apc.distribution import program_version
from apc.optional import need
from apc.present.analysis import range_document
from apc.present.forms import MEANT, document, json_text, note
from apc.present.pictures import FORMATS, check_result_path, write_figure
from apc.present.region_picture import panel_letter, panels_picture, region_picture  # noqa: F401 -- looked up
from apc.tables import SUFFIXES, Column, Row, blocks_of, write_table

if TYPE_CHECKING:
    import pandas

    from apc.regions.panels import Panel, Panels
    from apc.regions.region import Curve, Region

Floats = NDArray[np.float64]

# Curves listed; a boundary in more pieces is told by their number.
MOST_CURVES = 12


def region_text(found: Region) -> str:
    """Return what `apc region` prints of one region."""
    width = max(len(found.x.free.label), len(found.y.free.label))
    lines = [f"{found.topology}: {_words(found)}"]
    if found.criterion in MEANT:
        lines += note(MEANT[found.criterion])
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
    if coarse := found.coarse:
        most, many = max(one.error for one in coarse), counted(len(coarse), "curve")
        what = f"{many} could not be followed to {found.tolerance:.0e} of a coordinate, but to {most:.0e}"
        lines += ["", *wrapped(what, "  ", "  ")]
    cell = " × ".join(
        with_unit(f"{size:.4g}", axis.unit) for size, axis in zip(found.cell, (found.x, found.y), strict=True)
    )
    lines += ["", f"  Looked at in cells of {cell}, and finer where the"]
    lines.append("  eigenvalues hint at more; an island inside one cell could be missed.")
    if found.stepped and found.criterion == "passive":
        lines.append("  Its points are on the boundary; between them it is drawn straight.")
    elif found.stepped:
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
        "tolerance": found.tolerance,
        "coarse": [number for number, one in enumerate(found.curves) if one in found.coarse],
        "boundary": [_curve_document(curve) for curve in found.curves],
        "stable_area": found.stable_area,
        "stable_area_error": found.stable_area_error,
        "area_unit": _product(found.x.unit, found.y.unit),
        "cell": list(found.cell),
        "finest_cell": found.finest,
        "criterion": found.criterion,
        "left_out": list(found.left_out),
        "origin": dict(found.system.origin.digests),
    }


def _curve_document(curve: Curve) -> dict[str, Any]:
    return {
        "points": curve.points.tolist(),
        "handles": curve.handles.tolist(),
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


@part("draw")
def write_panels(path: Path, found: Panels) -> None:
    """Write regions to a file, its format chosen by the suffix. Raises ApcError E601 if it can't."""
    suffix = check_result_path(path)
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
        write_table(path, _columns(first), blocks_of(rows), made)
    else:
        write_text(path, json_text(found.to_dict()))


def _origins(found: Panels) -> dict[str, Any]:
    return {one.topology: dict(one.system.origin.digests) for panel in found.panels for one in panel.regions}


def _columns(found: Region) -> list[Column]:
    """Return the columns of a table of boundary points."""
    x, y = (Column(one.free.label, "" if one.unit == "1" else one.unit) for one in (found.x, found.y))
    words = (Column("panel", kind="text"), Column("topology", kind="text"))
    curve = (Column("curve", kind="count"), Column("mode", kind="text"))
    return [*words, *curve, x, y, Column("error")]


def _rows(found: Region, panel: str = "") -> Iterator[Row]:
    """Yield a row a point of every curve, in the order of `_columns`."""
    for number, curve in enumerate(found.curves):
        mode = curve.mode
        for point in curve.points.tolist():
            yield (panel, found.topology, number, mode, *point, curve.error)
