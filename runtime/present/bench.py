"""Measurements as text, plain data and a picture: error against time, a panel a task.

Takes: a `Bench`, a `HardReport`, a `Scale`. Gives: their texts, documents and pictures; `save_bench`.
Guarantees: an error stands beside every time. In a picture every point is named; the Pareto front is a line
of steps, the default a filled mark.
Does not: compute, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apc.benchmark.bench import SAME, Bench, Comparison, Measured
from apc.compiler.words import counted, wrapped
from apc.optional import need
from apc.present.forms import document, note
from apc.present.pictures import write_figure

if TYPE_CHECKING:
    from apc.benchmark.hard import HardReport
    from apc.benchmark.scale import Scale

Box = tuple[float, ...]  # left, bottom, right, top, in pixels

WIDTH, HEIGHT = 4.6, 3.6  # inches, of a panel
LEAST = 1e-17  # where an error of zero is drawn
FRONT, OTHER, CHOSEN = "#0072B2", "#555555", "#D55E00"  # distinct for colour-blind eyes (Okabe and Ito, 2008)
ROOM = 0.12  # of an axis: kept free at its ends for names
# Where a name may stand beside its point, the first that is free: (right, up) in points, and what of the name
# is there.
PLACES = tuple(
    (right * (6 if right else 0), up, {1: "left", -1: "right", 0: "center"}[right])
    for up in (3, -7, 9, -13, 15, -19, 21, -25)
    for right in (1, -1, 0)
    if right or abs(up) > 3
)
SPAN = 12.0  # from end to end of an axis at the least: one power of ten is named on it
CLEAR = 3.0  # points: about a mark, where no name may stand

NOTHING = "–"
BETTER = (
    "* on the Pareto front: none here is faster by more than both spreads and no less right, or more right "
    f"and no slower; errors below {SAME:.1g} are roundings, and equal"
)
STARRED = "stable*: stable up to a common translation"


def bench_text(found: Bench) -> str:
    """Return a table a task, the methods sorted by time."""
    peers = counted(found.peers, "peer", ",")
    where = ", ".join(f"{name} {value}" for name, value in found.machine.items() if value)
    parts = [f"{found.topology}: {peers}", *(_task(one) for one in found.comparisons), _filled(where)]
    return "\n\n".join(parts)


def _task(found: Comparison) -> str:
    title = f"apc {found.task}: time against error of the {found.quantity}"
    left_out = [_filled(f"{name} left out: {reason}") for name, reason in found.refused]
    head = [title, *(_filled(text) for text in found.left_out), ""]
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
    lines += [_filled(text) for text in found.notes]
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


def hard_text(found: HardReport) -> str:
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


def scale_text(found: Scale) -> str:
    """Return a line a number of peers."""
    from apc.benchmark.scale import REPEATS  # loaded where there is one, and else not needed

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


bench_document = scale_document = document


def hard_document(found: HardReport) -> dict[str, Any]:
    """Return what `apc bench --hard --json` prints."""
    return {
        "folder": found.folder,
        "cases": [{**document(case), "bound_over_error": document(case.looseness)} for case in found.cases],
        "without_truth": list(found.without),
        "failed": [case.name for case in found.failures],
        "undecided": [case.name for case in found.cases if case.undecided],
        "unbounded": [case.name for case in found.cases if case.unbounded],
    }


def bench_picture(found: Bench) -> Any:
    """Draw every task that has errors; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    figures = need("matplotlib.figure", "plot")
    figure = figures.Figure(figsize=(WIDTH * len(found.comparisons), HEIGHT), layout="constrained")
    axes = figure.subplots(1, len(found.comparisons), squeeze=False)[0]
    for ax, one in zip(axes, found.comparisons, strict=True):
        _panel(ax, one)
    figure.suptitle(f"{found.topology}: error against time", fontsize=11)
    figure.draw_without_rendering()  # names are placed where the panels will be
    for ax, one in zip(axes, found.comparisons, strict=True):
        _name_points(ax, one)
    return figure


def save_bench(found: Bench, path: Path) -> None:
    """Draw to a file whose suffix says the format. Raises ApcError if it can't be written."""
    write_figure(bench_picture(found), path)


def _panel(ax: Any, found: Comparison) -> None:
    ax.set_title(f"apc {found.task}", fontsize=10)
    ax.set_xlabel("median time [s]")
    ax.set_ylabel(f"error of the {found.quantity}", fontsize=9)
    points = [one for one in found.measured if one.error is not None]
    if not points:
        why = "no reference" if found.measured else found.reference
        ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center")
        return
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.grid(True, which="major", linewidth=0.4, alpha=0.6)
    front = [one for one in points if one.front]
    ax.step(
        [one.seconds for one in front],
        [max(one.error or 0.0, LEAST) for one in front],
        where="post",
        color=FRONT,
        linewidth=1,
        zorder=1,
    )
    for one in points:
        size = max(one.error or 0.0, LEAST)
        colour = CHOSEN if one.chosen else FRONT if one.front else OTHER
        ax.errorbar(
            one.seconds, size, xerr=min(one.spread, 0.9 * one.seconds), color=colour, linewidth=0.8, zorder=2
        )
        ax.plot(
            one.seconds,
            size,
            "o",
            color=colour,
            markerfacecolor=colour if one.chosen else "white",
            markersize=5,
        )
    if max(one.error or 0.0 for one in points) < SAME:
        ax.axhline(SAME, color=OTHER, linewidth=0.8, linestyle=":")
        ax.text(
            0.02,
            0.97,
            "errors below the dotted line are roundings",
            transform=ax.transAxes,
            va="top",
            fontsize=7,
        )
    ax.margins(ROOM)
    for low, high, set_limits in ((*ax.get_xlim(), ax.set_xlim), (*ax.get_ylim(), ax.set_ylim)):
        more = max(SPAN * low / high, 1.0) ** 0.5
        set_limits(low / more, high * more)
    ax.xaxis.set_minor_formatter("")
    ax.yaxis.set_minor_formatter("")


def _name_points(ax: Any, found: Comparison) -> None:
    """Write each point's name beside it, over no mark and no other name, within the axes."""
    points = [one for one in found.measured if one.error is not None]
    marks = [ax.transData.transform((one.seconds, max(one.error or 0.0, LEAST))) for one in points]
    clear = CLEAR * ax.figure.dpi / 72
    taken = [(x - clear, y - clear, x + clear, y + clear) for x, y in marks]
    taken += [tuple(text.get_window_extent().extents) for text in ax.texts]
    frame = tuple(ax.get_window_extent().extents)
    for one in points:
        name = ax.annotate(
            one.name + (" (default)" if one.chosen else ""),
            (one.seconds, max(one.error or 0.0, LEAST)),
            xytext=(0, 0),
            textcoords="offset points",
            fontsize=7,
        )
        for right, up, side in PLACES:
            name.set_position((right, up))
            name.set_horizontalalignment(side)
            box = tuple(name.get_window_extent().extents)
            if _within(box, frame) and not any(_overlap(box, other) for other in taken):
                break
        taken.append(tuple(name.get_window_extent().extents))


def _within(box: Box, frame: Box) -> bool:
    return frame[0] < box[0] and frame[1] < box[1] and box[2] < frame[2] and box[3] < frame[3]


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _time(seconds: float) -> str:
    if seconds < 0.9995e-3:  # above, three digits would round it to 1e+03
        return f"{seconds * 1e6:.3g} us"
    return f"{seconds * 1e3:.4g} ms" if seconds < 1 else f"{seconds:.4g} s"


def _size(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.1e}"


def _filled(text: str) -> str:
    return "\n".join(note(text))
