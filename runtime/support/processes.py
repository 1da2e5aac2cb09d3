"""Parallel computation in processes of this machine, or in this process; results in order of completion.

Takes: a function of shared data and a task; tasks.
Gives: `Workers`, `this_process`, `local_processes`, `cores`; `Patience`, `results`; `model_bytes`,
`model_of_bytes`; `digest_of`.
Guarantees: every process is spawned, never forked, and imports nothing from the working folder that the
parent would not. It computes with one thread and ends when the parent ends. A keyboard
interrupt affects only the parent. A crashed or unresponsive process is reported.
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
from apc.support.threads import single_threaded

Shared = TypeVar("Shared")
Task = TypeVar("Task")
Result = TypeVar("Result")

SAFE_PATH = "PYTHONSAFEPATH"  # excludes the working folder from the path of Python

# Seconds without a result after which a note is printed; doubled after each note.
SILENCE = 60.0


@dataclass(frozen=True, slots=True)
class Workers(Generic[Task, Result]):
    """The executors of tasks: `submit` starts a task.

    `waiting` is the number of submitted tasks that keeps all executors busy. `trouble` returns the error for
    the exception of a future, or None if the exception is not an error of the executors.
    """

    submit: Callable[[Task], Future[Result]]
    waiting: int
    trouble: Callable[[BaseException], ApcError | None]


@dataclass(frozen=True, slots=True)
class Patience:
    """The handling of missing results: `notify` is called; after `limit` seconds the computation ends."""

    limit: float | None = None
    notify: Callable[[str], None] = lambda _: None


def cores() -> int:
    """Return the number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def this_process(compute: Callable[[Shared, Task], Result], shared: Shared) -> Workers[Task, Result]:
    """Return workers that run in this process: a task is complete when it is submitted."""

    def submit(task: Task) -> Future[Result]:
        """Return a future with the result of a task."""
        future: Future[Result] = Future()
        future.set_result(compute(shared, task))
        return future

    return Workers(submit, 1, lambda _: None)


@contextmanager
def local_processes(
    compute: Callable[[Shared, Task], Result], shared: Shared, jobs: int, lost: Diagnostic
) -> Iterator[Workers[Task, Result]]:
    """Start `jobs` processes, yield them as workers, and end them immediately on exit.

    Parameters
    ----------
    compute
        The function, defined in a module that every process imports.
    shared
        Data sent once to every process, at its start: sending a large model with every task would take longer
        than the task.
    jobs
        The number of processes.
    lost
        The error for an unexpected end of a process.
    """
    context = multiprocessing.get_context("spawn")
    # No data are sent through the pipe: a process ends when the parent's end is closed, also by the parent's
    # end.
    lifeline, parent_end = context.Pipe(duplex=False)
    with _safe_path():  # the pool starts a process that releases resources
        pool = ProcessPoolExecutor(jobs, context, _begin, (lifeline, compute, shared))

    def submit(task: Task) -> Future[Result]:
        """Return the future of a task."""
        with _safe_path(), _interrupts_ignored():  # a process started by this call inherits both settings
            return pool.submit(_compute, task)

    def trouble(error: BaseException) -> ApcError | None:
        """Return the error of an unexpectedly ended process, None for other exceptions."""
        return ApcError(lost) if isinstance(error, BrokenProcessPool) else None

    try:
        yield Workers(submit, 2 * jobs, trouble)
    finally:
        parent_end.close()
        for process in list((pool._processes or {}).values()):  # a stopped process does not react to the pipe
            process.kill()
        pool.shutdown(wait=True, cancel_futures=True)
        lifeline.close()


def results(
    workers: Workers[Task, Result], tasks: Iterable[Task], patience: Patience, location: SourceLocation
) -> Iterator[Result]:
    """Yield each result when it is complete; only as many tasks are submitted as keep the workers busy.

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
        E889 no result within the limit; the error of the workers' `trouble`.
    """
    waited = 0.0  # seconds since the last result
    remaining_tasks = iter(tasks)
    running: set[Future[Result]] = set()
    try:
        while True:
            for task in remaining_tasks:
                running.add(workers.submit(task))
                if len(running) >= workers.waiting:
                    break
            if not running:
                return
            pause = waited or SILENCE
            if patience.limit is not None:
                pause = min(pause, patience.limit - waited)
            finished, running = wait(running, pause, return_when=FIRST_COMPLETED)
            waited = 0.0 if finished else waited + pause
            if waited:
                _report_silence(waited, patience, location)
            for future in finished:
                yield future.result()
    except ApcError:
        raise
    except Exception as error:
        trouble = workers.trouble(error)
        if trouble is None:
            raise
        raise trouble from error


def _report_silence(seconds: float, patience: Patience, location: SourceLocation) -> None:
    """Report the time without a result. Raises ApcError (E889) if it exceeds the limit."""
    message = f"no result from the worker processes for {seconds:g} s"
    if patience.limit is not None and seconds >= patience.limit:
        raise ApcError(Diagnostic("E889", location, message, fix=f'--patience "{2 * seconds:g} s"'))
    patience.notify(f"{message}; still waiting")


@contextmanager
def _safe_path() -> Iterator[None]:
    """Within the `with` body, exclude the working folder from the path of new processes until they run.

    A process is spawned as `python -c`, whose path begins with the working folder: a file `struct.py` there
    would replace the standard module. It gets this process's path once it runs.
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
    """Ignore keyboard interrupts within the `with` body; a process started there inherits this."""
    if (
        threading.current_thread() is not threading.main_thread()
    ):  # only the main thread can set signal handlers
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


# The function of this worker process and its shared data: set once at its start.
_worker_state: list[tuple[Callable[[Any, Any], Any], Any]] = []


def _begin(lifeline: Connection, compute: Callable[[Any, Any], Any], shared: Any) -> None:
    """Initialize a worker process: ignore interrupts, watch the pipe of the parent, store function
    and data.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()
    _worker_state.append((compute, shared))


def _end_with(lifeline: Connection) -> None:
    """End this process when the other end of the pipe closes."""
    try:
        lifeline.recv_bytes()
    except EOFError:
        os._exit(0)


def _compute(task: Any) -> Any:
    """Return the result of a task in a worker process, with one thread."""
    compute, shared = _worker_state[0]
    with single_threaded():
        return compute(shared, task)


def model_bytes(model: Model) -> bytes:
    """Return a compiled model as bytes for another process of this program."""
    return store.encoded(model)


def digest_of(model: Model) -> bytes:
    """Return the SHA-256 of a compiled model with its numbers."""
    return hashlib.sha256(store.model_of(model)).digest()


def model_of_bytes(model: bytes) -> Model:
    """Return the compiled model from bytes of `model_bytes`."""
    return store.decoded(model)
