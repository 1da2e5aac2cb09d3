"""What long work shows on a terminal while it goes on: a bar, or a line in words.

Takes: how far the work is. Gives: `Bar`, `progress_bar`, `status_line`, `at_work`.
Guarantees: all of it goes to stderr, and is gone from a terminal when the work ends, however it ends; what is
no terminal is told of long work alone, in a line now and then.
Does not: slow the work down: what draws a bar is loaded when one is shown.
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
from apc.compiler.wording import time_left

LONG = 1.0  # seconds of work after which a bar is shown

# Seconds of work after which what is no terminal is told how far it is, and again each time it has gone on
# for twice as long: a log of a day's work has a dozen lines of it.
QUIET = 10.0

# Is told how much is done, and of how much.
Bar = Callable[[float, float], None]


@contextmanager
def progress_bar(title: str, unit: str, *, after: float = LONG) -> Iterator[Bar]:
    """Give a function that shows on a terminal how much is done, once the work takes long.

    Parameters
    ----------
    title
        What is being done, in a word.
    unit
        What is counted.
    after
        Seconds of work after which it is shown.
    """
    if not sys.stderr.isatty():
        begun, write = time.monotonic(), _now_and_then()
        yield lambda done, total: write(
            lambda: (
                f"{title}: {done:,.6g} of {total:,.6g} {unit}"
                + time_left(time.monotonic() - begun, done, total)
            )
        )
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn(title),
        BarColumn(),
        TextColumn(f"{{task.fields[of]}} {unit}"),
        TimeRemainingColumn(),
    )
    plotted = Progress(*columns, console=Console(stderr=True), transient=True)
    task = plotted.add_task(title, total=None, of="")
    begun, shown = time.monotonic(), False

    def show(done: float, total: float) -> None:
        nonlocal shown
        if not shown and time.monotonic() - begun > after:
            plotted.start()
            shown = True
        plotted.update(task, completed=done, total=total, of=f"{done:,.6g} of {total:,.6g}")

    try:
        yield show
    finally:
        if shown:
            plotted.stop()


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """Give a function that writes what is being done over what it wrote before."""
    if not sys.stderr.isatty():
        spoken = _now_and_then()
        yield lambda text: spoken(lambda: text)
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
    """Say on stderr, while work of unknown length goes on, that it does: after `QUIET`, then ever rarer.

    Parameters
    ----------
    title
        What is being done, in a few words.
    about
        Seconds it will take, as far as is known: said first if it is long.
    """
    if about > QUIET:
        sys.stderr.write(f"{visible(title)}: this may take {about:,.0f} s\n")
    if not math.isfinite(QUIET):
        yield
        return
    ended = threading.Event()
    # Never longer than the work: a thread that only waits.
    watching = threading.Thread(target=_watch, args=(title, ended.wait), daemon=True)
    watching.start()
    try:
        yield
    finally:
        ended.set()
        watching.join()


def _watch(title: str, ended: Callable[[float], bool]) -> None:
    """Say now and then that work goes on, until `ended` says after some seconds that it doesn't."""
    gone = QUIET
    while not ended(gone if gone == QUIET else gone / 2):
        sys.stderr.write(f"{visible(title)}: at work for {gone:,.0f} s\n")
        sys.stderr.flush()
        gone *= 2


def _now_and_then() -> Callable[[Callable[[], str]], None]:
    """Return what writes a line to what is no terminal: first after `QUIET`, then after twice as long, …."""
    begun, following = time.monotonic(), QUIET

    def write(text: Callable[[], str]) -> None:
        nonlocal following
        gone = time.monotonic() - begun
        if gone >= following:
            sys.stderr.write(f"{visible(text())}\n")
            sys.stderr.flush()
            following = 2 * gone

    return write
