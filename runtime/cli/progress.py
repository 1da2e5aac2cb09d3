"""The progress of a long computation, on a terminal as a bar or a line.

Takes: the completed amount of work. Gives: `Bar`, `progress_bar`, `status_line`, `at_work`.
Guarantees: all text goes to stderr, and is removed from a terminal at the end of the work, also after an
error. A pipe or file receives a line at increasing intervals, only for long work.
Does not: slow the work down: the library of the bar is loaded when a bar is shown.
"""

from __future__ import annotations

import math
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from apc.compiler.errors import visible
from apc.support.remaining_time import RemainingTime

LONG = 1.0  # seconds of work after which a bar is shown

# Seconds of work before the first line in a pipe or file. Each further line is printed after twice the time:
# the log of one day of work has a dozen lines.
QUIET = 10.0

# Receives the completed amount and the total.
Bar = Callable[[float, float], None]


@contextmanager
def progress_bar(title: str, unit: str, *, after: float = LONG) -> Iterator[Bar]:
    """Yield a function that shows the completed amount of long work.

    Parameters
    ----------
    title
        The name of the work.
    unit
        The unit of the amount.
    after
        Seconds of work before a bar is shown on a terminal.
    """
    remaining = RemainingTime()
    if not sys.stderr.isatty():
        write = _at_intervals()

        def print_line(done: float, total: float) -> None:
            times = remaining.text(done, total)
            write(lambda: f"{title}: {done:,.6g} of {total:,.6g} {unit}, {times}")

        yield print_line
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (
        TextColumn(title),
        BarColumn(),
        TextColumn(f"{{task.fields[of]}} {unit}, {{task.fields[times]}}"),
    )
    plotted = Progress(*columns, console=Console(stderr=True), transient=True)
    task = plotted.add_task(title, total=None, of="", times="")
    begun, shown = time.monotonic(), False

    def show(done: float, total: float) -> None:
        nonlocal shown
        if not shown and time.monotonic() - begun > after:
            plotted.start()
            shown = True
        of, times = f"{done:,.6g} of {total:,.6g}", remaining.text(done, total)
        plotted.update(task, completed=done, total=total, of=of, times=times)

    try:
        yield show
    finally:
        if shown:
            plotted.stop()


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """Yield a function that prints the current step; on a terminal each text replaces the last."""
    if not sys.stderr.isatty():
        write_line = _at_intervals()
        yield lambda text: write_line(lambda: text)
        return

    def write(text: str) -> None:
        sys.stderr.write(f"\r\x1b[K{visible(text)[: shutil.get_terminal_size().columns - 1]}")
        sys.stderr.flush()

    try:
        yield write
    finally:
        write("")


@contextmanager
def at_work(title: str, *, about: float = 0.0) -> Iterator[None]:
    """Print the elapsed time of work of unknown length: first after `QUIET`, then after twice the time.

    Parameters
    ----------
    title
        The name of the work.
    about
        The estimated time in seconds, printed at the start if it is long.
    """
    if about > QUIET:
        sys.stderr.write(f"{visible(title)}: estimated time {about:,.0f} s\n")
    if not math.isfinite(QUIET):
        yield
        return
    ended = threading.Event()
    watching = threading.Thread(target=_watch, args=(title, ended.wait), daemon=True)
    watching.start()
    try:
        yield
    finally:
        ended.set()
        watching.join()


def _watch(title: str, ended: Callable[[float], bool]) -> None:
    """Print the elapsed time at increasing intervals; `ended` waits, and returns true at the end."""
    gone = QUIET
    while not ended(gone if gone == QUIET else gone / 2):
        sys.stderr.write(f"{visible(title)}: {gone:,.0f} s elapsed\n")
        sys.stderr.flush()
        gone *= 2


def _at_intervals() -> Callable[[Callable[[], str]], None]:
    """Return a function that writes a line to a pipe or file after `QUIET`, then after twice the time."""
    begun, following = time.monotonic(), QUIET

    def write(text: Callable[[], str]) -> None:
        nonlocal following
        gone = time.monotonic() - begun
        if gone >= following:
            sys.stderr.write(f"{visible(text())}\n")
            sys.stderr.flush()
            following = 2 * gone

    return write
