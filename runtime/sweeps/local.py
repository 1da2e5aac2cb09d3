"""Parts of a sweep computed by processes of this machine.

Takes: `Work`. Gives: `Workers`, `this_process`, `local_processes`.
Guarantees: every process starts afresh (spawned, never forked), computes with one thread, and ends with the
one that started it, whatever ends that one; an interrupt from the keyboard reaches the first process alone.
Does not: keep results, or decide which parts are wanted.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection

from apc.compiler.errors import ApcError, Mistake, Place
from apc.sweeps.work import Computed, Work, compute_part

PLACE = Place("sweep")


@dataclass(frozen=True, slots=True)
class Workers:
    """Those who compute: `submit` hands over a part; `waiting` parts at a time keep all of them busy.

    `trouble` turns what a future raises into the message for a person, or None where it is no fault of
    theirs.
    """

    submit: Callable[[int], Future[Computed]]
    waiting: int
    trouble: Callable[[BaseException], ApcError | None]


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def this_process(work: Work) -> Workers:
    """Return workers that are this process itself: a part is computed when it is submitted."""

    def submit(part: int) -> Future[Computed]:
        future: Future[Computed] = Future()
        future.set_result(compute_part(work, part))
        return future

    return Workers(submit, 1, lambda _: None)


@contextmanager
def local_processes(work: Work, jobs: int) -> Iterator[Workers]:
    """Start `jobs` processes, and end them on leaving, at once, whatever they are doing."""
    context = multiprocessing.get_context("spawn")
    # Nothing is ever sent through it: the other end closes when this process closes it, or dies.
    lifeline, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(jobs, context, _begin, (lifeline, work))

    def submit(part: int) -> Future[Computed]:
        with _interrupts_ignored():  # a process started now inherits it, and keeps it while it imports
            return pool.submit(_compute, part)

    try:
        yield Workers(submit, 2 * jobs, _trouble)
    finally:
        held.close()
        pool.shutdown(wait=True, cancel_futures=True)
        lifeline.close()


def _trouble(error: BaseException) -> ApcError | None:
    if not isinstance(error, BrokenProcessPool):
        return None
    what = (
        "a process that computed ended without a word: stopped from outside, out of memory, or started by a "
        "script that sweeps when it is imported"
    )
    hint = "--jobs 1; in a script, if __name__ == '__main__': around the sweep"
    return ApcError(Mistake("E889", PLACE, what, hint=hint))


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # only it may set how signals are taken
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


# The work of a process, set once when it begins: sent with every part, a large model would cost more than it.
_work: list[Work] = []


def _begin(lifeline: Connection, work: Work) -> None:
    """Make ready a process that has just started."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()
    _work.append(work)


def _end_with(lifeline: Connection) -> None:
    """End this process when the other end of the lifeline closes."""
    try:
        lifeline.recv_bytes()
    except EOFError:
        os._exit(0)


def _compute(part: int) -> Computed:
    return compute_part(_work[0], part)
