"""Parallel work: in processes of this machine, or in this one; results in order of completion.

Takes: a function of shared data and of a task; tasks.
Gives: `Workers`, `this_process`, `local_processes`, `cores`; `Patience`, `results`; `model_bytes`,
`model_of_bytes`; `digest_of`.
Guarantees: every process is spawned, never forked, and imports nothing from the working folder that the
parent would not. It computes with one thread and ends with the parent, for whatever reason. A keyboard
interrupt reaches the parent only. A crashed or unresponsive process is reported.
Does not: store results, or select tasks.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

from apc.compiler import store
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.threads import single_threaded

Shared = TypeVar("Shared")
Task = TypeVar("Task")
Result = TypeVar("Result")

SAFE_PATH = "PYTHONSAFEPATH"  # makes Python exclude the working folder from its path

# Seconds without a result after which a note is printed; doubled after each note.
SILENCE = 60.0


@dataclass(frozen=True, slots=True)
class Workers(Generic[Task, Result]):
    """Those who compute: `submit` hands over a task; `waiting` of them at a time keep all of them busy.

    `trouble` turns what a future raises into the message for a person, or None where it is no fault of
    theirs.
    """

    submit: Callable[[Task], Future[Result]]
    waiting: int
    trouble: Callable[[BaseException], ApcError | None]


@dataclass(frozen=True, slots=True)
class Patience:
    """Handling of missing results: `notify` is called; after `limit` seconds the work ends."""

    limit: float | None = None
    notify: Callable[[str], None] = lambda _: None


def cores() -> int:
    """Return the number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def this_process(compute: Callable[[Shared, Task], Result], shared: Shared) -> Workers[Task, Result]:
    """Return workers that are this process itself: a task is done when it is submitted."""

    def submit(task: Task) -> Future[Result]:
        future: Future[Result] = Future()
        future.set_result(compute(shared, task))
        return future

    return Workers(submit, 1, lambda _: None)


@contextmanager
def local_processes(
    compute: Callable[[Shared, Task], Result], shared: Shared, jobs: int, lost: Diagnostic
) -> Iterator[Workers[Task, Result]]:
    """Start `jobs` processes, and end them immediately on exit.

    Parameters
    ----------
    compute
        A function of a module, which every process imports.
    shared
        Data sent to every process once, at its start: a large model sent with every task would cost more than
        the task.
    jobs
        The number of processes.
    lost
        The message for an unexpected end of one of them.
    """
    context = multiprocessing.get_context("spawn")
    # Nothing is ever sent through it: the other end closes when this process closes it, or dies.
    lifeline, held = context.Pipe(duplex=False)
    with _safe_path():  # it starts one that tidies up after all others
        pool = ProcessPoolExecutor(jobs, context, _begin, (lifeline, compute, shared))

    def submit(task: Task) -> Future[Result]:
        with _safe_path(), _interrupts_ignored():  # a process started now inherits both
            return pool.submit(_compute, task)

    def trouble(error: BaseException) -> ApcError | None:
        return ApcError(lost) if isinstance(error, BrokenProcessPool) else None

    try:
        yield Workers(submit, 2 * jobs, trouble)
    finally:
        held.close()
        for process in list((pool._processes or {}).values()):  # one that was stopped sees no lifeline
            process.kill()
        pool.shutdown(wait=True, cancel_futures=True)
        lifeline.close()


def results(
    workers: Workers[Task, Result], tasks: Iterable[Task], patience: Patience, location: SourceLocation
) -> Iterator[Result]:
    """Yield each result as it comes; never more tasks are handed out than keep the workers busy.

    Parameters
    ----------
    workers, tasks
        The workers and their tasks.
    patience
        The handling of missing results.
    location
        The location for messages.

    Raises
    ------
    ApcError
        E889 no result for too long; the error in the workers' `trouble`.
    """
    silent = 0.0  # seconds since the last result
    left = iter(tasks)
    running: set[Future[Result]] = set()
    try:
        while True:
            for task in left:
                running.add(workers.submit(task))
                if len(running) >= workers.waiting:
                    break
            if not running:
                return
            pause = silent or SILENCE
            if patience.limit is not None:
                pause = min(pause, patience.limit - silent)
            finished, running = wait(running, pause, return_when=FIRST_COMPLETED)
            silent = 0.0 if finished else silent + pause
            if silent:
                _tell_silence(silent, patience, location)
            for future in finished:
                yield future.result()
    except ApcError:
        raise
    except Exception as error:
        trouble = workers.trouble(error)
        if trouble is None:
            raise
        raise trouble from error


def _tell_silence(seconds: float, patience: Patience, location: SourceLocation) -> None:
    """Report that no result came for a while. Raises ApcError E889 if that is too long."""
    message = f"no result from the processes that compute for {seconds:g} s"
    if patience.limit is not None and seconds >= patience.limit:
        message += ": they are stuck, or a part takes longer"
        raise ApcError(Diagnostic("E889", location, message, hint=f'--patience "{2 * seconds:g} s"'))
    patience.notify(f"{message}; still waiting")


@contextmanager
def _safe_path() -> Iterator[None]:
    """Ensure that child processes import `struct` of the standard library, not of the working folder.

    A process is spawned as `python -c`, which puts the working folder before everything else. It gets this
    one's path once it runs.
    """
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore the keyboard, as a process started now does too while it imports."""
    if threading.current_thread() is not threading.main_thread():  # only it may set how signals are taken
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


# The function of a process, and the data common to its tasks: set once at its start.
_mine: list[tuple[Callable[[Any, Any], Any], Any]] = []


def _begin(lifeline: Connection, compute: Callable[[Any, Any], Any], shared: Any) -> None:
    """Make ready a process that has just started."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()
    _mine.append((compute, shared))


def _end_with(lifeline: Connection) -> None:
    """End this process when the other end of the lifeline closes."""
    try:
        lifeline.recv_bytes()
    except EOFError:
        os._exit(0)


def _compute(task: Any) -> Any:
    compute, shared = _mine[0]
    with single_threaded():
        return compute(shared, task)


def model_bytes(system: Model) -> bytes:
    """Return a compiled model as bytes for another process of this program; equal models give equal bytes."""
    return store.encoded(system)


def digest_of(system: Model) -> bytes:
    """Return the SHA-256 of a compiled model, its numbers included."""
    return hashlib.sha256(store.model_of(system)).digest()


def model_of_bytes(model: bytes) -> Model:
    """Return the compiled model of bytes that another process of this program made."""
    return store.decoded(model)
