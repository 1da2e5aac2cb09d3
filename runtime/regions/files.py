"""Stable regions as files: pictures, tables and JSON, by the suffix.

Takes: `Panels`, and a path.
Gives: `check_region_path`, `write_panels`; `headings`, `region_rows`.
Guarantees: a file that can't be written is refused before anything is computed, as far as that can be known;
written whole or not at all.
Does not: compute.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from apc.compiler.files import check_target, write_file
from apc.distribution import program_version
from apc.optional import need
from apc.regions.figure import draw_panels
from apc.regions.panels import Panels
from apc.regions.region import Region
from apc.simulation.figures import FORMATS, write_figure
from apc.suffixes import check_suffix
from apc.sweeps.quantities import Row
from apc.sweeps.table_file import SUFFIXES, check_table_path, write_table

COLUMNS = (
    *(("panel", "text"), ("topology", "text"), ("curve", "count"), ("mode", "text")),
    *(("x", "number"), ("y", "number"), ("tangent x", "number"), ("tangent y", "number")),
    ("error", "number"),
)


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
        write_figure(draw_panels(found), path)
    elif suffix in SUFFIXES:
        first = found.panels[0].regions[0]
        rows = (
            row for panel in found.panels for one in panel.regions for row in region_rows(one, panel.title)
        )
        made = {
            "axes": [first.x.to_dict(), first.y.to_dict()],
            "apc": program_version(),
            "left_out": {one.topology: list(one.left_out) for panel in found.panels for one in panel.regions},
            "origin": _origins(found),
        }
        write_table(path, headings(first), [kind for _, kind in COLUMNS], rows, made)
    else:
        text = json.dumps(found.to_dict(), ensure_ascii=False, allow_nan=False, indent=2)
        write_file(path, lambda temporary: _write_text(temporary, text))


def _write_text(path: Path, text: str) -> None:
    path.write_bytes(f"{text}\n".encode())


def _origins(found: Panels) -> dict[str, Any]:
    return {one.topology: dict(one.system.origin.texts) for panel in found.panels for one in panel.regions}


def headings(found: Region) -> list[str]:
    """Return the headings of a table of boundary points."""
    names = {
        axis: f"{one.label} [{one.unit}]" if one.unit != "1" else one.label
        for axis, one in (("x", found.x), ("y", found.y))
    }
    return [names.get(name, name) for name, _ in COLUMNS]


def region_rows(found: Region, panel: str = "") -> Iterator[Row]:
    """Yield a row a point of every curve, in the order of `COLUMNS`."""
    for number, curve in enumerate(found.curves):
        mode = curve.mode
        for point, tangent in zip(curve.points.tolist(), curve.tangents.tolist(), strict=True):
            yield (panel, found.topology, number, mode, *point, *tangent, curve.error)
