"""A run in real time as text and plain data: its ticks, its ways, and what is said of its scene.

Takes: a `RunComparison`, `Ticks`. Gives: `run_comparison_text`, `run_comparison_document`, `ticks_text`.
Guarantees: what is not compared says why.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from apc.compiler.words import WIDTH, counted, wrapped
from apc.loop.packets import DROPPED
from apc.present.forms import document, note
from apc.present.recorded_network import recording_document

if TYPE_CHECKING:
    from apc.loop.beside import Measured, RunComparison, Ticks, WayRun

HEADINGS = ("50 %", "99 %", "99.9 %", "most")


def run_comparison_text(found: RunComparison) -> str:
    """Return what happened beside what is said of it."""
    peers = counted(len(found.ticks), "peer")
    lines = [f"{found.topology}: {peers}, {found.seconds:.6g} s in real time", ""]
    if found.emulated:
        lines += [*note("packets were held back and lost at the sender, as the scene's links say"), ""]
    if found.why_not:
        lines += [*note(f"not simulated beside it: {found.why_not}"), ""]
    else:
        lines += note("beside simulate with the same packets at each tick, signals differ by at most")
        for unit, (far, large) in found.apart.items():
            lines.append(f"    {far:.0e} {unit}".ljust(18) + f" of up to {large:.4g} {unit}")
        if not any(large for _, large in found.apart.values()):
            lines += note("nothing moved: start values or a force in the scene would move it")
        lines.append("")
    lines += [*ticks_text(found.ticks), "", *_ways_text(found.ways)]
    for one in found.measured:
        lines += ["", *_measured_text(one)]
    return "\n".join(lines)


def ticks_text(ticks: Iterable[Ticks]) -> list[str]:
    """Return how late ticks were, a row a peer."""
    listed = list(ticks)
    lines = []
    for what, shares in (("late by", "late"), ("took", "took")):
        rows = [(what, f"{'instants':>11}" + "".join(f"{heading:>12}" for heading in HEADINGS))]
        for one in listed:
            cells = "".join(f"{f'{1e3 * value:.3f} ms':>12}" for value in getattr(one, shares))
            rows.append((one.peer, f"{one.ticks:>11,}{cells}"))
        lines += _rows(rows)
    for one in listed:
        said = [f"not given: {why}" for why in one.not_given]
        said += [f"joined at {one.joined:.4g} s"] if one.joined else []
        said += ["stopped before the end"] if one.stopped else []
        said += [
            f"{counted(count, 'datagram', ',')} dropped: {DROPPED[why]}" for why, count in one.dropped.items()
        ]
        if said:
            lines += wrapped(f"{one.peer}: {'; '.join(said)}", "  ", "    ")
    return lines


def _ways_text(ways: Iterable[WayRun]) -> list[str]:
    listed = [(f"{one.link} {one.sender} to {one.receiver}", one) for one in ways]
    rows = [("way", f"{'packets':>9}{'lost':>8}{'half within':>13}{'all within':>13}")]
    for name, one in listed:
        came = one.came
        middle = f"{1e3 * dict(came.quantiles).get(0.5, came.mean):.3f} ms"
        cells = f"{came.packets:>9,}{came.lost.count:>8,}{middle:>13}{f'{1e3 * came.longest:.3f} ms':>13}"
        rows += [(name, cells), (f"  {one.trace}", "")]
    return _rows(rows)


def _rows(rows: Iterable[tuple[str, str]]) -> list[str]:
    """Return rows of names and equally wide cells; a name that leaves these no room has a line to itself."""
    listed = list(rows)
    wide = max(len(cells) for _, cells in listed)
    width = max([len(name) for name, cells in listed if cells and len(name) + wide + 4 <= WIDTH], default=0)
    lines = []
    for name, cells in listed:
        if cells and len(name) <= width:
            lines.append(f"  {name:<{width}}  {cells}")
        else:
            lines += [f"  {name}", *([f"  {'':<{width}}  {cells}"] if cells else [])]
    return lines


def _measured_text(one: Measured) -> list[str]:
    after = f"with {one.link} heard after {1e3 * one.delay:.6g} ms, as most of {one.way} was"
    verdict = f"{one.analysis.verdict}, spectral radius {one.analysis.spectral_radius:.6f} per frame"
    lines = wrapped(f"analyze says, {after}: {verdict}", "  ", "    ")
    if one.network is not None:
        lines += wrapped(f"and with every packet of that way as it came: {one.network.verdict}", "  ", "    ")
    else:
        lines += note(
            "not judged packet by packet, of which there are many: the link's trace: FILE asks for that"
        )
    return lines


def run_comparison_document(found: RunComparison) -> dict[str, Any]:
    """Return a run beside its scene as plain data; times in seconds."""
    plain: dict[str, Any] = document(found, {"ways": None, "measured": None})
    plain["ways"] = [
        {**document(one, {"came": None}), "came": recording_document(one.came)} for one in found.ways
    ]
    plain["measured"] = [
        {
            "link": one.link,
            "way": one.way,
            "delay": one.delay,
            "verdict": one.analysis.verdict,
            "spectral_radius": one.analysis.spectral_radius,
            "network": None if one.network is None else one.network.verdict,
        }
        for one in found.measured
    ]
    return plain
