"""Measurements as text, plain data and a picture: error against time, one panel per task.

Takes: a `Bench`, a `HardReport`, a `Scale`. Gives: their texts, documents and pictures, among them
`bench_picture`.
Guarantees: every time has an error. In a picture every point is named; the Pareto front is a line of steps,
the default a filled mark.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from apc.benchmark.speed_and_error import SAME, Bench, MethodTiming, TaskComparison
from apc.compiler.wording import counted, wrapped
from apc.output.formatting import Lines, notes, record, table
from apc.output.pictures import COLOURS, new_figure
from apc.support.optional import need
from apc.verdict import StabilityVerdict

if TYPE_CHECKING:
    from apc.benchmark.hard import HardReport
    from apc.benchmark.scale import Scale

WIDTH, HEIGHT = 4.6, 4.2  # inches, of a panel
MARKS = "osDv^P<>"  # of methods
DECADES = 2  # of an axis with three labels in each
LEAST = 1e-17  # where an error of zero is drawn
NOTHING = "–"
BETTER = (
    "* Pareto-optimal: no other method is faster (by more than both spreads) and as accurate, or more "
    f"accurate and as fast; errors below {SAME:.1g} count as equal"
)
STARRED = {StabilityVerdict.STABLE_TRANSLATING: "stable*"}
_SHORT = {**STARRED, StabilityVerdict.UNDECIDED: StabilityVerdict.UNDECIDED.word}


def bench_text(bench: Bench) -> Lines:
    """Yield a table a task, the methods sorted by time."""
    peers = counted(bench.peers, "peer", ",")
    yield f"{bench.topology}: {peers}\n"
    for comparison in bench.comparisons:
        yield from _task(comparison)
        yield ""
    yield from notes(", ".join(f"{name} {value}" for name, value in bench.machine.items() if value))


def _task(comparison: TaskComparison) -> Lines:
    """Yield the table of the methods of one task, with notes."""
    yield f"apc {comparison.task}: time and error of the {comparison.quantity}"
    yield from notes(*comparison.limitations)
    yield ""
    if comparison.measured:
        rows = [("method", "median", "spread", "error", "bound", "")]
        for measured in comparison.measured:
            spread = NOTHING if measured.rounds < 2 else _time(measured.spread)
            marks = ("*" if measured.front else " ") + (" default" if measured.chosen else "")
            rows.append(
                (
                    measured.name,
                    _time(measured.seconds),
                    spread,
                    _size(measured.error),
                    _size(measured.bound),
                    marks,
                )
            )
        yield from table(rows, "<>>>><")
        yield ""
        known = any(measured.error is not None for measured in comparison.measured)
        legend = [f"error and bound are {comparison.relative}", BETTER] if known else []
        reference = f"{'' if known else 'no '}reference: {comparison.reference}"
        yield from notes(_times(comparison), *legend, _choice(comparison), reference, *comparison.notes)
    yield from notes(*(f"{name} excluded: {reason}" for name, reason in comparison.refused))


def _times(comparison: TaskComparison) -> str:
    """Return the meaning of the columns of times."""
    least, most = (pick(measured.rounds for measured in comparison.measured) for pick in (min, max))
    runs = counted(most, "run") if least == most else f"{least} to {most} runs"
    return f"median and spread (half the interquartile range) of {runs}, processor time of {comparison.timed}"


def _choice(comparison: TaskComparison) -> str:
    """Return in words whether the default method of a task is Pareto-optimal."""
    chosen: MethodTiming | None = comparison.chosen
    if chosen is None:
        return f"the default method of {comparison.task} is not among these"
    if chosen.error is None:
        where = "not rated without a reference"
    else:
        where = "Pareto-optimal" if chosen.front else "not Pareto-optimal"
    return f"default method of {comparison.task}: {chosen.name} ({where})"


def hard_text(hard_report: HardReport) -> Lines:
    """Yield a line for each hard case, and the failures."""
    yield f"{hard_report.folder}: {counted(len(hard_report.cases), 'topology')} with known results\n"
    rows = [("topology", "error", "bound", "bound÷error", "time", "verdict")]
    for case in hard_report.cases:
        loose = f"{case.looseness:.2g}" if math.isfinite(case.looseness) else NOTHING
        mark = "FAILED" if case.failed else _SHORT.get(case.verdict, case.verdict)
        rows.append((case.name, _size(case.error), _size(case.bound), loose, _time(case.seconds), mark))
    yield from table(rows, "<>>>><")
    yield ""
    yield from notes("error and bound of the spectral radius ρ, relative if ρ > 1")
    if any(case.verdict in STARRED and not case.failed for case in hard_report.cases):
        yield from notes(*(f"{word}: {verdict}" for verdict, word in STARRED.items()))
    yield from notes(*(f"{name} excluded: no known result" for name in hard_report.without))
    yield from notes(*(f"FAILED {case.name}: {case.failed}" for case in hard_report.failures))
    if hard_report.failures:
        undecided = sum(case.undecided for case in hard_report.cases)
        unbounded = sum(case.unbounded for case in hard_report.cases)
        topologies = f"{len(hard_report.failures)} of {counted(len(hard_report.cases), 'topology')} failed"
        yield from notes(f"{topologies}; {undecided} undecided, {unbounded} without a bound")
    else:
        yield from notes("all bounds hold; all verdicts are correct")


def scale_text(scale: Scale) -> Lines:
    """Yield a line a number of peers."""
    from apc.benchmark.scale import REPEATS  # loaded where there is one, and else not needed

    alongside = {row.peers - row.count for row in scale.rows} - {0}
    others = "".join(f", with {number:,} of other groups" for number in sorted(alongside))
    yield from wrapped(f"{scale.topology}: peers of group {scale.group}{others}")
    yield ""
    rows = [("peers", "compile", "analyze", "memory", "error", "bound", "method")]
    for row in scale.rows:
        memory = f"{row.memory / 2**20:.0f} MiB"
        numbers = (_time(row.compile_s), _time(row.analyze_s), memory, _size(row.error), _size(row.bound))
        rows.append((f"{row.count:,}", *numbers, row.method))
    yield from table(rows, ">>>>>><")
    yield ""
    times = f"processor time of compiling, and the median of {REPEATS} analyses"
    yield from notes(
        f"{times}; error of the spectral radius",
        f"memory: largest of the process, including {scale.floor}",
        *(f"{counted(count, 'peer', ',')}: {reason}" for count, reason in scale.refused),
    )


def hard_document(hard_report: HardReport) -> dict[str, Any]:
    """Return the output of `apc bench --hard --json`."""
    return {
        "folder": hard_report.folder,
        "cases": [record(case, {"bound_over_error": case.looseness}) for case in hard_report.cases],
        "without_truth": list(hard_report.without),
        "failed": [case.name for case in hard_report.failures],
        "undecided": [case.name for case in hard_report.cases if case.undecided],
        "unbounded": [case.name for case in hard_report.cases if case.unbounded],
    }


def bench_picture(bench: Bench) -> Any:
    """Draw every task that has errors; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figure = new_figure((WIDTH * len(bench.comparisons), HEIGHT))
    axes = figure.subplots(1, len(bench.comparisons), squeeze=False)[0]
    for ax, comparison in zip(axes, bench.comparisons, strict=True):
        _panel(ax, comparison)
    figure.suptitle(f"{bench.topology}: error versus time", fontsize=11)
    return figure


def _panel(ax: Any, comparison: TaskComparison) -> None:
    """Draw the error of each method over its time, and the Pareto front."""
    ax.set_title(f"apc {comparison.task}", fontsize=10)
    ax.set_xlabel("median time [ms]")
    ax.set_ylabel(f"error of the {comparison.quantity}", fontsize=9)
    points = [measured for measured in comparison.measured if measured.error is not None]
    if not points:
        why = "no reference" if comparison.measured else comparison.reference
        ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center")
        return
    ax.set(xscale="log", yscale="log")
    ax.margins(0.1)
    ax.grid(linewidth=0.4, alpha=0.6)
    _label_ticks(ax.xaxis, [1e3 * point.seconds for point in points])
    front = [point for point in points if point.front]
    steps = [[1e3 * measured.seconds for measured in front], [_plotted(measured) for measured in front]]
    ax.step(*steps, where="post", color="0.4", linewidth=1, zorder=1, label="Pareto front")
    for index, point in enumerate(points):
        colour = COLOURS[index % len(COLOURS)]
        ax.errorbar(
            1e3 * point.seconds,
            _plotted(point),
            xerr=1e3 * min(point.spread, 0.9 * point.seconds),
            fmt=MARKS[index % len(MARKS)],
            color=colour,
            markerfacecolor=colour if point.chosen else "white",
            label=point.name + (" (default)" if point.chosen else ""),
        )
    if max(map(_plotted, points)) < SAME:
        ax.axhline(SAME, color="0.4", linewidth=0.8, linestyle=":", label="rounding level")
    style = {"ncols": 2, "fontsize": 7, "frameon": False}
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), **style)  # every method is identified


def _label_ticks(axis: Any, values: Sequence[float]) -> None:
    """Label a logarithmic axis at 1, 2 and 5 of each decade; at 1 only in a range of more than `DECADES`."""
    ticker = need("matplotlib.ticker", "plot")
    wide = math.log10(max(values) / min(values)) > DECADES
    axis.set_major_locator(ticker.LogLocator(subs=(1,) if wide else (1, 2, 5)))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())


def _plotted(measured: MethodTiming) -> float:
    return max(measured.error or 0.0, LEAST)


def _time(seconds: float) -> str:
    if seconds < 0.9995e-3:  # above, three digits would round it to 1e+03
        return f"{seconds * 1e6:.3g} µs"
    return f"{seconds * 1e3:.4g} ms" if seconds < 1 else f"{seconds:.4g} s"


def _size(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.1e}"
