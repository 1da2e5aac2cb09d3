"""Schemes side by side as text, plain data and a table; the file of a comparison.

Takes: a `Comparison`, and a path.
Gives: its text, document and table; `write_comparison`.
Guarantees: what is left out stands first; a cell that can't be had says why in a footnote; a line is at most
80 columns wide.
Does not: compute, or draw itself (see `comparison_picture`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.files import write_text
from apc.compiler.timings import part
from apc.compiler.words import WIDTH, counted, known_digits, measured, with_unit, wrapped
from apc.distribution import program_version
from apc.optional import need
from apc.present.comparison_picture import comparison_picture  # noqa: F401 -- looked up
from apc.present.forms import MEANT, document, json_text, note
from apc.present.pictures import FORMATS, check_result_path, write_figure
from apc.tables import SUFFIXES, Column, Row, blocks_of, write_table

if TYPE_CHECKING:
    import pandas

    from apc.comparison.comparison import Comparison, Scheme
    from apc.vary.critical import Critical

NONE = "–"
DIGITS = 6  # of what is felt, at most

# What is varied, and how a column of it is headed.
VARIED = (
    ("stiffness", "largest stable stiffness"),
    ("delay", "delay that breaks it"),
    ("loss", "loss that breaks it"),
)


class _Footnotes:
    """Footnotes as they are asked for, each text once."""

    def __init__(self) -> None:
        self.texts: dict[str, int] = {}

    def mark(self, texts: Sequence[str]) -> str:
        """Return what stands in a cell for some footnotes: " [1]"."""
        marks = [f"[{self.texts.setdefault(text, len(self.texts) + 1)}]" for text in texts if text]
        return f" {' '.join(marks)}" if marks else ""


def comparison_text(found: Comparison) -> str:
    """Return what `apc compare` prints: a table for each question, a line for each scheme."""
    schemes = found.schemes
    lines = [f"{counted(len(schemes), 'scheme')} side by side"]
    for text in (*_meant(found), *found.left_out):
        lines += note(text)
    for text in found.notes:
        lines += note(f"note: {text}")
    feet = _Footnotes()
    named = [(f"{one.topology}, {counted(one.peers, 'peer', ',d')}",) for one in schemes]
    lines += _table(("",), named)
    lines += _table(("verdict", "spectral radius a frame"), [_verdict(one, feet) for one in schemes])
    if any(one.linearized for one in schemes):
        lines += _table(("in time", "played"), [_in_time(one, feet) for one in schemes])
    for key, heading in VARIED:
        lines += _table((heading, "of"), [_varied(one, key, feet) for one in schemes])
    headings = ("felt at 1 Hz", "at 10 Hz", "of the hand at")
    lines += _table(headings, [_felt(one, feet) for one in schemes])
    costs = [
        (
            counted(one.effort.operations, "operation", ",d")
            + (f" of {one.effort.clock}" if one.effort.clock else ""),
            f"{one.effort.sent:,.6g} a second",
            f"{one.effort.sent_by_all:,.6g} a second",
        )
        for one in schemes
    ]
    lines += _table(("work a tick", "a peer sends at most", "all send"), costs)
    if feet.texts:
        lines.append("")
    for text, number in feet.texts.items():
        lines += wrapped(text, f"  [{number}] ", "      ")
    return "\n".join(lines)


def _table(headings: tuple[str, ...], cells: Sequence[tuple[str, ...]]) -> list[str]:
    """Return a table of numbered schemes; the last column takes as many lines as it needs."""
    rows = [("", *headings), *((str(place + 1), *row) for place, row in enumerate(cells))]
    widths = [max(len(row[column]) for row in rows) for column in range(len(headings))]
    lines = [""]
    for row in rows:
        first = "  " + "".join(f"{cell:<{width}}  " for cell, width in zip(row[:-1], widths, strict=True))
        if row[-1] and len(first) + len(row[-1]) > WIDTH:
            lines += wrapped(row[-1], first, " " * 5)
        elif any(row):
            lines.append(f"{first}{row[-1]}".rstrip())
    return lines


def _meant(found: Comparison) -> Iterator[str]:
    """Yield what stable means, where it is not that motions die out."""
    if any(one.passive for one in found.schemes):
        yield MEANT["passive"]
    elif any(one.criterion in MEANT for scheme in found.schemes for one in _criticals(scheme)):
        yield f"of a link that is, or becomes, unreliable: {MEANT['mean-square']}"


def _criticals(one: Scheme) -> list[Critical]:
    return [found for found in (one.stiffness, one.delay, one.loss) if found is not None]


def _why(one: Scheme, key: str) -> tuple[str, ...]:
    return tuple(text for name, text in one.missing if name == key)


def _verdict(one: Scheme, feet: _Footnotes) -> tuple[str, str]:
    if one.analysis is None:
        return one.verdict, f"{NONE}{feet.mark([one.refused])}"
    told = list(_why(one, "verdict"))
    if one.network is not None and one.network.mean_square_radius is not None:
        root, error = math.sqrt(one.network.mean_square_radius), one.network.error or 0.0
        grown = measured(root, error / (2 * root) if root else error)
        told.append(
            f"the radius is that with every packet on time; mean squares grow by {grown} squared a frame"
        )
    if one.passive is not None:
        told.append("the radius is that with free hands")
    verdict = one.verdict + (", linearized" if one.analysis.linearized else "")
    radius = measured(one.analysis.spectral_radius, one.analysis.spectral_radius_error)
    return verdict, f"{radius}{feet.mark(told)}"


def _in_time(one: Scheme, feet: _Footnotes) -> tuple[str, str]:
    """Return the verdict of a simulation, where that of an analysis is of a linearization."""
    if one.analysis is None:
        return NONE, NONE
    if not one.linearized:
        return "as its verdict says: it is linear", ""
    if one.played is None:
        return f"{NONE}{feet.mark(_why(one, 'played'))}", NONE
    summary = one.played.summary
    at = {"settles": summary.settled, "diverges": summary.stopped_at}.get(summary.verdict)
    return f"{summary.verdict}{'' if at is None else f' at {at:.3g} s'}", f"{summary.end:g} s"


def _varied(one: Scheme, key: str, feet: _Footnotes) -> tuple[str, str]:
    found: Critical | None = getattr(one, key)
    if found is None:
        return f"{NONE}{feet.mark(_why(one, key))}", NONE
    told = []
    if len(found.crossings) > 1:
        told.append(f"{counted(len(found.crossings), 'crossing')} in all: apc critical {found.parameter}")
    if found.groups:
        told.append("one value for all groups, which differ in the scene")
    return f"{_reach(found)}{feet.mark(told)}", found.parameter


def _reach(found: Critical) -> str:
    """Return in words how far a scene is stable."""
    low, high = (f"{one:.6g}" for one in found.scanned)
    if found.value is None:
        if not found.enters:
            return f"{found.verdict.partition(' ')[0]} whatever it is"
        if found.verdict.startswith("stable"):
            return f"none up to {with_unit(high, found.unit)}"
        return f"{found.verdict.partition(' ')[0]} from {low} to {with_unit(high, found.unit)}"
    value = with_unit(f"{found.value:.15g}", found.unit)
    if found.error:
        value = measured(found.value, found.error, found.unit)
    return value if found.stable_side == "below" else f"{value}, stable above it"


def _felt(one: Scheme, feet: _Footnotes) -> tuple[str, str, str]:
    if one.feel is None:
        return f"{NONE}{feet.mark(_why(one, 'feel'))}", NONE, NONE
    cells = []
    for value, bound in zip(one.feel.impedance.tolist(), one.feel.bound.tolist(), strict=True):
        size = known_digits(abs(value), abs(value) * bound, DIGITS)
        cells.append(f"{size} N*s/m, {np.degrees(np.angle(value)):.2f}°")
    return cells[0], cells[1], one.feel.at


def comparison_document(found: Comparison) -> dict[str, Any]:
    """Return the same as plain data, in SI: each part as the JSON of its command."""
    return {"schemes": [_document(one) for one in found.schemes], "notes": list(found.notes)}


def _document(one: Scheme) -> dict[str, Any]:
    parts = ("analysis", "network", "passive", "played", "stiffness", "delay", "loss", "feel")
    told = {key: None if getattr(one, key) is None else getattr(one, key).to_dict() for key in parts}
    return {
        "topology": one.topology,
        "peers": one.peers,
        "verdict": one.verdict,
        "stable": one.stable,
        "left_out": list(one.left_out),
        **told,
        "effort": document(one.effort),
        "missing": dict(one.missing),
        "refused": one.refused,
    }


def comparison_table(found: Comparison) -> pandas.DataFrame:
    """Return a pandas table with a row a scheme."""
    headings = [one.heading for one in _columns()]
    return need("pandas", "data").DataFrame([_row(one) for one in found.schemes], columns=headings)


@part("draw")
def write_comparison(path: Path, found: Comparison) -> None:
    """Write a comparison to a picture, a table or JSON, by the suffix."""
    suffix = check_result_path(path)
    if suffix in FORMATS:
        write_figure(found.plot(), path)
    elif suffix in SUFFIXES:
        made = {
            "apc": program_version(),
            "left_out": {one.topology: list(one.left_out) for one in found.schemes},
            "notes": list(found.notes),
        }
        write_table(path, _columns(), blocks_of(_row(one) for one in found.schemes), made)
    else:
        write_text(path, json_text(found.to_dict()))


def _columns() -> list[Column]:
    """Return the columns of a table of schemes; of what is varied, how far it was looked as well."""
    varied = [
        column
        for key, unit in (("stiffness", "N/m"), ("delay", "s"), ("loss", ""))
        for column in (
            Column(f"{key} parameter", kind="text"),
            Column(key, unit),
            Column(f"{key} error", unit),
            Column(f"{key} stable side", kind="text"),
            Column(f"{key} scanned to", unit),
            Column(f"{key} verdict", kind="text"),
        )
    ]
    felt = [
        Column(f"impedance at {at} Hz {part}", "N*s/m") for at in (1, 10) for part in ("real", "imaginary")
    ]
    return [
        Column("topology", kind="text"),
        Column("peers", kind="count"),
        Column("verdict", kind="text"),
        Column("in time", kind="text"),
        Column("frame", "s"),
        Column("spectral radius"),
        Column("spectral radius error"),
        Column("mean square radius"),
        *varied,
        Column("felt at", kind="text"),
        *felt,
        Column("operations a tick", kind="count"),
        Column("numbers sent", "1/s"),
        Column("numbers sent by all", "1/s"),
        Column("missing", kind="text"),
    ]


def _row(one: Scheme) -> Row:
    """Return a row of the table."""
    analysis = one.analysis
    varied = [
        cell
        for found in (one.stiffness, one.delay, one.loss)
        for cell in (
            (None,) * 6
            if found is None
            else (
                found.parameter,
                found.value,
                found.error,
                found.stable_side,
                found.scanned[1],
                found.verdict or None,
            )
        )
    ]
    felt: list[float | None] = [None] * 4
    if one.feel is not None:
        felt = [float(part) for value in one.feel.impedance.tolist() for part in (value.real, value.imag)]
    return (
        one.topology,
        one.peers,
        one.verdict,
        None if one.played is None else one.played.summary.verdict,
        None if analysis is None else analysis.frame_s,
        None if analysis is None else analysis.spectral_radius,
        None if analysis is None else analysis.spectral_radius_error,
        None if one.network is None else one.network.mean_square_radius,
        *varied,
        None if one.feel is None else one.feel.at,
        *felt,
        one.effort.operations,
        one.effort.sent,
        one.effort.sent_by_all,
        "; ".join(f"{key}: {text}" for key, text in one.missing) or one.refused or None,
    )
