"""A run in real time as text and plain data: its ticks, its ways, and what is said of its scene.

Takes: a `RunComparison`, `Ticks`. Gives: `run_comparison_text`, `run_comparison_document`, `ticks_text`.
Guarantees: what is not compared says why.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from apc.compiler.words import counted
from apc.loop.packets import DROPPED
from apc.present.forms import Lines, notes, record, table
from apc.present.network_output import recording_document

if TYPE_CHECKING:
    from apc.loop.beside import ArcRun, MeasuredLink, RunComparison, Ticks

HEADINGS = ("50 %", "99 %", "99.9 %", "most")


def run_comparison_text(run_comparison: RunComparison) -> Lines:
    """Yield what happened beside what is said of it."""
    peers = counted(len(run_comparison.ticks), "peer")
    yield f"{run_comparison.topology}: {peers}, {run_comparison.seconds:.6g} s in real time\n"
    if run_comparison.emulated:
        yield from notes("packets were held back and lost at the sender, as the scene's links say")
        yield ""
    if run_comparison.why_not:
        yield from notes(f"not simulated beside it: {run_comparison.why_not}")
    else:
        yield from notes("beside simulate with the same packets at each tick, signals differ by at most")
        apart = run_comparison.apart.items()
        yield from table(
            [(f"  {far:.0e} {unit}", f"of up to {large:.4g} {unit}") for unit, (far, large) in apart]
        )
        if not any(large for _, (_, large) in apart):
            yield from notes("nothing moved: start values or a force in the scene would move it")
    yield ""
    yield from ticks_text(run_comparison.ticks)
    yield ""
    yield from _ways_text(run_comparison.ways)
    for measured in run_comparison.measured:
        yield ""
        yield from _measured_text(measured)


def ticks_text(ticks: Sequence[Ticks]) -> Lines:
    """Yield how late ticks were, a row a peer."""
    for what, shares in (("late by", "late"), ("took", "took")):
        rows: list[tuple[str, ...]] = [("instants", *HEADINGS, what)]
        rows += [(f"{tick.ticks:,}", *map(_ms, getattr(tick, shares)), tick.peer) for tick in ticks]
        yield from table(rows, ">>>>><")
    for tick in ticks:
        said = [f"not given: {why}" for why in tick.not_given]
        said += [f"joined at {tick.joined:.4g} s"] if tick.joined else []
        said += ["stopped before the end"] if tick.stopped else []
        said += [
            f"{counted(count, 'datagram', ',')} dropped: {DROPPED[why]}"
            for why, count in tick.dropped.items()
        ]
        if said:
            yield from notes(f"{tick.peer}: {'; '.join(said)}")


def _ways_text(ways: Iterable[ArcRun]) -> Lines:
    rows = [("packets", "lost", "half within", "all within", "way")]
    for way in ways:
        came = way.came
        middle = dict(came.quantiles).get(0.5, came.mean)
        name = f"{way.link} {way.sender} to {way.receiver}: {way.trace}"
        rows.append((f"{came.packets:,}", f"{came.lost.count:,}", _ms(middle), _ms(came.longest), name))
    return table(rows, ">>>><")


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3f} ms"


def _measured_text(measured: MeasuredLink) -> Lines:
    after = f"with {measured.link} heard after {1e3 * measured.delay:.6g} ms, as most of {measured.way} was"
    verdict = (
        f"{measured.analysis.verdict}, spectral radius {measured.analysis.spectral_radius:.6f} per frame"
    )
    judged = "not judged packet by packet, of which there are many: the link's trace: FILE asks for that"
    if measured.network is not None:
        judged = f"and with every packet of that way as it came: {measured.network.verdict}"
    return notes(f"analyze says, {after}: {verdict}", judged)


def run_comparison_document(run_comparison: RunComparison) -> dict[str, Any]:
    """Return a run beside its scene as plain data; times in seconds."""
    measured = [
        {
            **record(measured, {"analysis": ..., "network": measured.network and measured.network.verdict}),
            "verdict": measured.analysis.verdict,
            "spectral_radius": measured.analysis.spectral_radius,
        }
        for measured in run_comparison.measured
    ]
    ways = [record(way, {"came": recording_document(way.came)}) for way in run_comparison.ways]
    return record(run_comparison, {"ways": ways, "measured": measured})
