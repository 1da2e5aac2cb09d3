"""What `apc bench` prints: tables of at most 80 columns.

Takes: a `Bench`, a `HardReport`, a `Scale`. Gives: text.
Guarantees: an error stands beside every time.
Does not: compute.
"""

from __future__ import annotations

import math

from apc.benchmark.bench import SAME, Bench, Comparison, Measured
from apc.benchmark.hard import HardReport
from apc.benchmark.scale import REPEATS, Scale
from apc.compiler.words import counted, wrapped

NOTHING = "–"
BETTER = (
    "* on the Pareto front: none here is faster by more than both spreads and no less right, or more right "
    f"and no slower; errors below {SAME:.1g} are roundings, and equal"
)
STARRED = "stable*: stable up to a common translation"


def bench_report(found: Bench) -> str:
    """Return a table a task, the methods sorted by time."""
    peers = counted(found.peers, "peer", ",")
    where = ", ".join(f"{name} {value}" for name, value in found.machine.items() if value)
    parts = [f"{found.topology}: {peers}", *(_task(one) for one in found.comparisons), _filled(where)]
    return "\n\n".join(parts)


def _task(found: Comparison) -> str:
    title = f"apc {found.task}: time against error of the {found.quantity}"
    left_out = [_filled(f"{name} left out: {reason}") for name, reason in found.refused]
    head = [title, *(_filled(note) for note in found.left_out), ""]
    if not found.measured:
        return "\n".join([*head, *left_out])
    lines = [
        *head,
        "  method                      median     spread      error      bound",
    ]
    for one in found.measured:
        marks = ("*" if one.front else " ") + (" chosen" if one.chosen else "")
        lines.append(
            f"  {one.name:<22} {_time(one.seconds):>11} {_spread(one):>10} "
            f"{_size(one.error):>10} {_size(one.bound):>10} {marks}".rstrip()
        )
    lines += ["", _filled(_times(found))]
    if _known(found):
        lines += [_filled(f"error and bound are {found.relative}"), _filled(BETTER)]
    lines.append(_filled(_choice(found)))
    lines.append(
        _filled(f"reference: {found.reference}" if _known(found) else f"no reference: {found.reference}")
    )
    lines += [_filled(note) for note in found.notes]
    return "\n".join([*lines, *left_out])


def _times(found: Comparison) -> str:
    """Say what the columns of times are."""
    least, most = (pick(one.rounds for one in found.measured) for pick in (min, max))
    runs = counted(most, "run") if least == most else f"{least} to {most} runs"
    columns = "median and spread (half the distance between the quartiles)"
    return f"{columns} are of {runs}: processor time of {found.timed}"


def _spread(one: Measured) -> str:
    return NOTHING if one.rounds < 2 else _time(one.spread)


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
    if any(_short(case.verdict) == "stable*" for case in found.cases if not case.failed):
        lines.append(_filled(STARRED))
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
    beside = {one.peers - one.count for one in found.rows} - {0}
    others = "".join(f", beside {number:,} of other groups" for number in sorted(beside))
    lines = [
        *wrapped(f"{found.topology}: peers of group {found.group}{others}"),
        "",
        "       peers    compile    analyze     memory    error    bound  method",
    ]
    lines += [
        f"  {one.count:>10,} {_time(one.compile_s):>10} {_time(one.analyze_s):>10} "
        f"{one.memory / 2**20:>6.0f} MiB {_size(one.error):>8} {_size(one.bound):>8}  {one.method}"
        for one in found.rows
    ]
    times = f"processor time of compiling, and the median of {REPEATS} analyses"
    lines += ["", _filled(f"{times}; error of the spectral radius")]
    lines += [_filled("memory is the most the whole process took, of which " + found.floor)]
    lines += [_filled(f"{counted(count, 'peer', ',')}: {reason}") for count, reason in found.refused]
    return "\n".join(lines)


def _time(seconds: float) -> str:
    if seconds < 0.9995e-3:  # above, three digits would round it to 1e+03
        return f"{seconds * 1e6:.3g} us"
    return f"{seconds * 1e3:.4g} ms" if seconds < 1 else f"{seconds:.4g} s"


def _size(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.1e}"


def _filled(text: str) -> str:
    return "\n".join(wrapped(text, "  ", "    "))
