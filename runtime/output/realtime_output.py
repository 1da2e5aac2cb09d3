"""A real-time run as text and plain data: its ticks, its directed links, and the analysis for comparison.

Takes: a `RunComparison`, `Ticks`. Gives: `run_comparison_text`, `run_comparison_document`, `ticks_text`.
Guarantees: a missing comparison has a reason.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apc.compiler.wording import counted
from apc.output.formatting import Lines, headed, notes, record, sentences, table
from apc.output.network_output import recording_document
from apc.realtime.packets import DROPPED

if TYPE_CHECKING:
    from apc.realtime.run_comparison import ArcRun, MeasuredLink, RunComparison, Ticks

HEADINGS = ("50 %", "99 %", "99.9 %", "max")


def run_comparison_text(run_comparison: RunComparison) -> Lines:
    """Yield the run and its comparison with analysis."""
    peers = counted(len(run_comparison.ticks), "peer")
    yield f"{run_comparison.topology}: {peers}, {run_comparison.seconds:.6g} s in real time"
    if run_comparison.emulated:
        yield ""
        yield from sentences("The delay and loss of the links were emulated at the sender.")
    yield from headed("Comparison with a simulation of the same packets", _differences_text(run_comparison))
    yield from ticks_text(run_comparison.ticks)
    yield from headed("Packets", _arcs_text(run_comparison.arcs))
    yield from headed("Analysis with the measured network", _measured_text(run_comparison.measured))


def _differences_text(run_comparison: RunComparison) -> Lines:
    """Yield the largest difference from the simulation for each unit."""
    moving = [(unit, *pair) for unit, pair in run_comparison.differences.items() if pair[1]]
    if run_comparison.why_not:
        yield from sentences(f"Not simulated: {run_comparison.why_not}")
    elif not moving:
        yield from sentences("All signals are 0: the topology has no initial motion and no external force.")
    else:
        rows = [(unit, f"{far:.1g}", f"{large:.4g}") for unit, far, large in moving]
        yield from table([("unit", "max difference", "max value"), *rows], "<>>")


def ticks_text(ticks: Sequence[Ticks]) -> Lines:
    """Yield the delay and the computing time of ticks, one row per peer."""
    for subject, shares in (("Delay of ticks", "delayed"), ("Computing time of ticks", "took")):
        rows: list[tuple[str, ...]] = [("peer", "ticks", *HEADINGS)]
        rows += [(tick.peer, f"{tick.ticks:,}", *map(_ms, getattr(tick, shares))) for tick in ticks]
        yield from headed(subject, table(rows, "<>>>>>"))
    for tick in ticks:
        printed = [f"not granted: {why}" for why in tick.not_granted]
        printed += [f"joined at {tick.joined:.4g} s"] if tick.joined else []
        printed += ["stopped before the end"] if tick.stopped else []
        printed += [
            f"{counted(count, 'datagram', ',')} dropped: {DROPPED[why]}"
            for why, count in tick.dropped.items()
        ]
        if printed:
            yield from notes(f"{tick.peer}: {'; '.join(printed)}")


def _arcs_text(arcs: Iterable[ArcRun]) -> Lines:
    """Yield the delays and losses of each directed link."""
    rows = [("link", "from", "to", "packets", "lost", "median", "max")]
    folders = sorted({str(Path(arc.trace).parent) for arc in arcs})
    for arc in arcs:
        came = arc.came
        middle = dict(came.quantiles).get(0.5, came.mean)
        counts = f"{came.packets:,}", f"{came.lost.count:,}"
        rows.append((arc.link, arc.sender, arc.receiver, *counts, _ms(middle), _ms(came.longest)))
    if len(rows) > 1:
        yield from table(rows, "<<<>>>>")
        yield from notes(f"packet traces: {', '.join(folders)}")


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3f} ms"


def _measured_text(links: Iterable[MeasuredLink]) -> Lines:
    """Yield the analysis of each link with its measured delay, and with its recorded packets."""
    for measured in links:
        radius = measured.analysis.spectral_radius
        constant = f"{measured.analysis.verdict}, spectral radius {radius:.6f} per frame"
        recorded = "not analyzed, too many packets; use trace: FILE at the link"
        if measured.network is not None:
            recorded = measured.network.verdict
        name = f"{measured.link}, constant delay of {1e3 * measured.delay:.6g} ms"
        yield from notes(
            f"{name} (median of {measured.arc}): {constant}",
            f"{measured.link}, packets as recorded from {measured.arc}: {recorded}",
        )


def run_comparison_document(run_comparison: RunComparison) -> dict[str, Any]:
    """Return a run and its comparison as plain data; times in seconds."""
    measured = [
        {
            **record(measured, {"analysis": ..., "network": measured.network and measured.network.verdict}),
            "verdict": measured.analysis.verdict,
            "spectral_radius": measured.analysis.spectral_radius,
        }
        for measured in run_comparison.measured
    ]
    arcs = [record(arc, {"came": recording_document(arc.came)}) for arc in run_comparison.arcs]
    return record(run_comparison, {"arcs": arcs, "measured": measured})
