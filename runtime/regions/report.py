"""Stable regions in words, for a terminal of 80 columns.

Takes: a `Region`, or `Panels` of them. Gives: `region_report`, `panels_report`.
Guarantees: says what was not looked for. Does not: compute.
"""

from __future__ import annotations

from math import isnan

from apc.compiler.words import known_digits, measured, with_unit, wrapped
from apc.regions.panels import Panels, panel_letter
from apc.regions.region import Curve, Region

# Curves listed; a boundary in more pieces is told by their number.
MOST_CURVES = 12


def region_report(found: Region) -> str:
    """Return what `apc region` prints of one region."""
    width = max(len(found.x.label), len(found.y.label))
    lines = [f"{found.topology}: {_words(found)}"]
    for note in found.left_out:
        lines += wrapped(note, "  ", "    ")
    lines.append("")
    for letter, axis in (("x", found.x), ("y", found.y)):
        span = with_unit(f"{float(axis.low):.6g} to {float(axis.high):.6g}", axis.unit)
        lines.append(f"  {letter}  {axis.label:<{width}}  {span}")
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


def panels_report(found: Panels) -> str:
    """Return what `apc region` prints of several regions."""
    lines: list[str] = []
    for place, panel in enumerate(found.panels):
        if panel.title:
            lines += [f"({panel_letter(place)}) {panel.title}", ""]
        for region, gain in zip(panel.regions, panel.gains, strict=True):
            lines.append(region_report(region))
            if gain != 1:
                lines.append(f"  Compared at equal effective gain: y counts {gain} times, once an other.")
            lines.append("")
    return "\n".join(lines).rstrip("\n")


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
