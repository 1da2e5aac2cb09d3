"""A real-time run as text and plain data: its ticks, its directed links, and the analysis for comparison.

Takes: a `RunComparison`, `Ticks`. Gives: `run_comparison_text`, `run_comparison_document`, `ticks_text`.
Guarantees: a missing comparison has a reason.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from apc.compiler.wording import counted
from apc.output.formatting import Lines, notes, record, table
from apc.output.network_output import recording_document
from apc.realtime.packets import DROPPED

if TYPE_CHECKING:
    from apc.realtime.run_comparison import ArcRun, MeasuredLink, RunComparison, Ticks

HEADINGS = ("50 %", "99 %", "99.9 %", "most")


def run_comparison_text(run_comparison: RunComparison) -> Lines:
    """Yield the run and its comparison with analysis."""
    peers = counted(len(run_comparison.ticks), "peer")
    yield f"{run_comparison.topology}: {peers}, {run_comparison.seconds:.6g} s in real time\n"
    if run_comparison.emulated:
        yield from notes("packets were held back and lost at the sender, as the topology's links say")
        yield ""
    if run_comparison.why_not:
        yield from notes(f"not simulated beside it: {run_comparison.why_not}")
    else:
        yield from notes("beside simulate with the same packets at each tick, signals differ by at most")
        differences = run_comparison.differences.items()
        yield from table(
            [(f"  {far:.0e} {unit}", f"of up to {large:.4g} {unit}") for unit, (far, large) in differences]
        )
        if not any(large for _, (_, large) in differences):
            yield from notes("nothing moved: start values or a force in the topology would move it")
    yield ""
    yield from ticks_text(run_comparison.ticks)
    yield ""
    yield from _arcs_text(run_comparison.arcs)
    for measured in run_comparison.measured:
        yield ""
        yield from _measured_text(measured)


def ticks_text(ticks: Sequence[Ticks]) -> Lines:
    """Yield the lateness of ticks, one row per peer."""
    for subject, shares in (("late by", "delayed"), ("took", "took")):
        rows: list[tuple[str, ...]] = [(subject, "instants", *HEADINGS)]
        rows += [(tick.peer, f"{tick.ticks:,}", *map(_ms, getattr(tick, shares))) for tick in ticks]
        yield from table(rows, "<>>>>>")
    for tick in ticks:
        printed = [f"not given: {why}" for why in tick.not_granted]
        printed += [f"joined at {tick.joined:.4g} s"] if tick.joined else []
        printed += ["stopped before the end"] if tick.stopped else []
        printed += [
            f"{counted(count, 'datagram', ',')} dropped: {DROPPED[why]}"
            for why, count in tick.dropped.items()
        ]
        if printed:
            yield from notes(f"{tick.peer}: {'; '.join(printed)}")


def _arcs_text(arcs: Iterable[ArcRun]) -> Lines:
    rows = [("link", "packets", "lost", "half within", "all within")]
    for arc in arcs:
        came = arc.came
        middle = dict(came.quantiles).get(0.5, came.mean)
        name = f"{arc.link} {arc.sender} to {arc.receiver}: {arc.trace}"
        rows.append((name, f"{came.packets:,}", f"{came.lost.count:,}", _ms(middle), _ms(came.longest)))
    return table(rows, "<>>>>")


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3f} ms"


def _measured_text(measured: MeasuredLink) -> Lines:
    after = f"with {measured.link} heard after {1e3 * measured.delay:.6g} ms, as most of {measured.arc} was"
    verdict = (
        f"{measured.analysis.verdict}, spectral radius {measured.analysis.spectral_radius:.6f} per frame"
    )
    decided = "not judged packet by packet, of which there are many: the link's trace: FILE asks for that"
    if measured.network is not None:
        decided = f"and with every packet of that way as it came: {measured.network.verdict}"
    return notes(f"analyze says, {after}: {verdict}", decided)


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
