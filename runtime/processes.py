"""Work shared out: to processes of this machine, or done by this one; its results as they come.

Takes: a function of what all tasks share and of a task; tasks.
Gives: `Workers`, `this_process`, `local_processes`, `cores`; `Patience`, `results`; `model_bytes`,
`model_of_bytes`.
Guarantees: every process starts afresh (spawned, never forked), imports nothing from the working folder that
the first one would not, computes with one thread, and ends with the one that started it, whatever ends that
one; an interrupt from the keyboard reaches the first process alone; one that is lost is told, one that is
silent is told of.
Does not: keep results, or decide which tasks are wanted.
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

SAFE_PATH = "PYTHONSAFEPATH"  # what makes Python leave the working folder out of its path

# Seconds without a result after which that is told, and again after twice as many.
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
    """What to do while no result comes: `notify` hears of it; after `limit` seconds the work ends."""

    limit: float | None = None
    notify: Callable[[str], None] = lambda _: None


def cores() -> int:
    """Return how many cores this process may use."""
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
    """Start `jobs` processes, and end them on leaving, at once, whatever they are doing.

    Parameters
    ----------
    compute
        A function of a module, which every process imports.
    shared
        What is handed to every process once, when it begins: sent with every task, a large model would cost
        more than the task.
    jobs
        How many processes.
    lost
        What to tell when one of them ends without a word.
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
    workers: Workers[Task, Result], tasks: Iterable[Task], patience: Patience, place: SourceLocation
) -> Iterator[Result]:
    """Yield each result as it comes; never more tasks are handed out than keep the workers busy.

    Parameters
    ----------
    workers, tasks
        Who does what.
    patience
        How long to wait for the next.
    place
        Whose work it is, for messages.

    Raises
    ------
    ApcError
        E889 nothing came for too long; what the workers' `trouble` says.
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
                _tell_silence(silent, patience, place)
            for future in finished:
                yield future.result()
    except ApcError:
        raise
    except Exception as error:
        trouble = workers.trouble(error)
        if trouble is None:
            raise
        raise trouble from error


def _tell_silence(seconds: float, patience: Patience, place: SourceLocation) -> None:
    """Say that nothing came for a while. Raises ApcError E889 if that is too long."""
    what = f"no result from the processes that compute for {seconds:g} s"
    if patience.limit is not None and seconds >= patience.limit:
        what += ": they are stuck, or a part takes longer"
        raise ApcError(Diagnostic("E889", place, what, hint=f'--patience "{2 * seconds:g} s"'))
    patience.notify(f"{what}; still waiting")


@contextmanager
def _safe_path() -> Iterator[None]:
    """Have what is started import the standard library's `struct`, not a struct.py of the working folder.

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


# What a process computes, and what its tasks share: set once when it begins.
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
