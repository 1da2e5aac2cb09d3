"""What `apc bench` prints: tables of at most 80 columns.

Takes: a `Bench`, a `HardReport`, a `Scale`. Gives: text.
Guarantees: an error stands beside every time.
Does not: compute.
"""

from __future__ import annotations

import math

from apc.compiler.words import counted, wrapped
from apc.runtime.bench.bench import Bench, Comparison, Measured
from apc.runtime.bench.hard import HardReport
from apc.runtime.bench.scale import Scale

NOTHING = "–"


def bench_report(found: Bench) -> str:
    """Return a table a task, the methods sorted by time."""
    peers = counted(found.peers, "peer", ",")
    where = ", ".join(f"{name} {value}" for name, value in found.machine.items() if value)
    parts = [f"{found.topology}: {peers}", *(_task(one) for one in found.comparisons), _filled(where)]
    return "\n\n".join(parts)


def _task(found: Comparison) -> str:
    lines = [
        f"apc {found.task}: time against error of the {found.quantity}",
        "",
        "  method                      median     spread      error      bound",
    ]
    for one in found.measured:
        marks = ("*" if one.front else " ") + (" chosen" if one.chosen else "")
        lines.append(
            f"  {one.name:<22} {_time(one.seconds):>11} {_time(one.spread):>10} "
            f"{_size(one.error):>10} {_size(one.bound):>10} {marks}".rstrip()
        )
    if _known(found):
        lines += ["", "  * nothing here is both faster and more right (the Pareto front)"]
    lines.append(_filled(_choice(found)))
    lines.append(
        _filled(f"reference: {found.reference}" if _known(found) else f"no reference: {found.reference}")
    )
    lines += [_filled(note) for note in found.notes]
    lines += [_filled(f"{name} left out: {reason}") for name, reason in found.refused]
    return "\n".join(lines)


def _known(found: Comparison) -> bool:
    return any(one.error is not None for one in found.measured)


def _choice(found: Comparison) -> str:
    chosen: Measured | None = found.chosen
    if chosen is None:
        return f"what {found.task} chooses is none of these"
    if chosen.error is None:
        where = "which can't be judged without a reference"
    else:
        where = "which is on the front" if chosen.front else "which is NOT on the front"
    return f"{found.task} chooses {chosen.name}, {where}"


def hard_report(found: HardReport) -> str:
    """Return a line a hard case, and what failed."""
    lines = [
        f"{found.folder}: {counted(len(found.cases), 'scene')} with a known truth",
        "",
        "  scene                     error     bound  bound÷error        time  verdict",
    ]
    for case in found.cases:
        loose = NOTHING if not math.isfinite(case.looseness) else f"{case.looseness:.2g}"
        mark = "FAILED" if case.failed else _short(case.verdict)
        lines.append(
            f"  {case.name:<22} {_size(case.error):>8}  {_size(case.bound):>8} {loose:>12} "
            f"{_time(case.seconds):>11}  {mark}"
        )
    lines += ["", _filled("error and bound are of the spectral radius ρ, divided by ρ where it is above 1")]
    lines += [_filled(f"{name} has no truth beside it: left out") for name in found.without]
    lines += [_filled(f"FAILED {case.name}: {case.failed}") for case in found.failures]
    if found.failures:
        undecided = sum(case.undecided for case in found.cases)
        unbounded = sum(case.unbounded for case in found.cases)
        scenes = f"{len(found.failures)} of {counted(len(found.cases), 'scene')} failed"
        lines.append(f"  {scenes}; {undecided} left open, {unbounded} without a bound")
    else:
        lines.append("  every bound holds; every verdict is right")
    return "\n".join(lines)


def _short(verdict: str) -> str:
    words = {"stable up to a common translation": "stable*"}
    return words.get(verdict, verdict.partition(":")[0])


def scale_report(found: Scale) -> str:
    """Return a line a number of peers."""
    lines = [
        f"{found.topology}: more peers in group {found.group}",
        "",
        "       peers     compile     analyze      memory      error      bound  method",
    ]
    lines += [
        f"  {one.peers:>10,} {_time(one.compile_s):>11} {_time(one.analyze_s):>11} "
        f"{one.memory / 2**20:>7.0f} MiB {_size(one.error):>10} {_size(one.bound):>10}  {one.method}"
        for one in found.rows
    ]
    lines += ["", _filled("memory is the most the whole process took, of which " + found.floor)]
    lines += [_filled(f"{count:,} peers: {reason}") for count, reason in found.refused]
    return "\n".join(lines)


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{seconds * 1e6:.3g} us"
    return f"{seconds * 1e3:.4g} ms" if seconds < 1 else f"{seconds:.4g} s"


def _size(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.1e}"


def _filled(text: str) -> str:
    return "\n".join(wrapped(text, "  ", "    "))
