"""Worker processes of a page: each computes the most recent request of every section, by priority.

Takes: a compiled model as bytes; tasks.
Gives: `SectionWorker`.
Guarantees: the page never blocks. Only the newest request of a section is computed, and results older than
the displayed result are dropped. A process with an obsolete, long computation is ended.
Does not: define or display the computation.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass, field

from apc.app.sections import SectionAnswer, Task, compute
from apc.compiler.errors import Diagnostic, SourceLocation
from apc.support.processes import Workers, local_processes

# Seconds after which an obsolete computation is ended: a new process takes about one second to start.
MAX_OBSOLETE_TIME = 3.0
# The longest delay of a task in seconds while a preceding worker is busy: during continuous motion of a
# slider the later sections are still updated several times per second.
LONGEST_HOLD = 0.2
# Seconds for the browser to draw a result before the following worker starts a task.
DRAWING_TIME = 0.05

LOST = Diagnostic(
    "E981",
    SourceLocation("explore"),
    "the computing process exited unexpectedly, possibly for lack of memory",
)

# Called with a section and its result.
Deliver = Callable[[str, SectionAnswer], None]


@dataclass(slots=True, eq=False)
class SectionWorker:
    """One process with its pending tasks, by section; `order` is the priority of the sections.

    The section whose last computation started first has priority; otherwise a continuously moved slider would
    block all sections except one. While a worker in `preceding` is busy, no task is started here, so that its
    computations have the processor. All calls are from the server thread; `call_later` schedules a call in
    that thread after a number of seconds.
    """

    model: bytes
    order: tuple[str, ...]
    call_later: Callable[[Callable[[], None], float], None]
    deliver: Deliver
    preceding: list[SectionWorker] = field(default_factory=list)
    following: SectionWorker | None = None
    last: dict[str, Task] = field(default_factory=dict)
    waiting: dict[str, tuple[int, Task]] = field(default_factory=dict)
    held_since: float | None = None  # the time since which tasks are delayed
    started: dict[str, int] = field(default_factory=dict)
    shown: dict[str, int] = field(default_factory=dict)
    numbers: itertools.count[int] = field(default_factory=itertools.count)
    busy: tuple[int, Task, float] | None = None
    stack: ExitStack = field(default_factory=ExitStack)
    workers: Workers[Task, SectionAnswer] | None = None

    def submit(self, task: Task) -> bool:
        """Schedule a task, replacing the pending task of its section, unless the last task of the section
        was the same.

        Return whether the task was scheduled.
        """
        if self.last.get(task.section) == task:
            return False
        self.last[task.section] = task
        self.waiting[task.section] = (next(self.numbers), task)
        if self.busy is not None:
            number, running, since = self.busy
            first = self.order.index(task.section) <= self.order.index(running.section)
            if first and time.monotonic() - since > MAX_OBSOLETE_TIME:
                self._stop_process()
                if running.section in self.last:  # a task that is not obsolete is computed again
                    self.waiting.setdefault(running.section, (number, running))
        self._start_next()
        return True

    def cancel(self, section: str) -> None:
        """Cancel the tasks of a section, and drop its pending result."""
        self.last.pop(section, None)
        self.waiting.pop(section, None)
        self.shown[section] = next(self.numbers)

    def close(self) -> None:
        """End the process immediately."""
        self.waiting.clear()
        self._stop_process()

    def _stop_process(self) -> None:
        """End the process; the next task starts a new one."""
        self.busy, self.workers = None, None
        self.stack.close()

    def _start_next(self) -> None:
        """Start the pending task with the highest priority, unless the process is busy or must wait."""
        if self.busy is not None or not self.waiting or self._must_wait():
            return
        if self.workers is None:
            self.workers = self.stack.enter_context(local_processes(compute, self.model, 1, LOST))
        section = min(self.waiting, key=lambda text: (self.started.get(text, -1), self.order.index(text)))
        number, task = self.waiting.pop(section)
        self.started[section], self.held_since = next(self.numbers), None
        self.busy = (number, task, time.monotonic())
        future = self.workers.submit(task)
        future.add_done_callback(lambda done: self.call_later(lambda: self._finish(number, task, done), 0))

    def _must_wait(self) -> bool:
        """Return whether a preceding worker is busy; schedule another check after the longest delay."""
        now = time.monotonic()
        if all(worker.busy is None for worker in self.preceding):
            self.held_since = None
        elif self.held_since is None:
            self.held_since = now
            self.call_later(self._start_next, 1.1 * LONGEST_HOLD)  # as a timer may be early
        return self.held_since is not None and now - self.held_since < LONGEST_HOLD

    def _finish(self, number: int, task: Task, future: Future[SectionAnswer]) -> None:
        """Deliver the result of a task unless it is obsolete, and start the next task."""
        if self.busy is None or self.busy[0] != number:
            return  # the process of this task was ended
        self.busy = None
        try:
            answer = future.result()
        except (BrokenProcessPool, CancelledError):
            self._stop_process()
            self.last.pop(task.section, None)
            answer = SectionAnswer(None, LOST.sentence)
        if number > self.shown.get(task.section, -1):
            self.shown[task.section] = number
            self.deliver(task.section, answer)
        self._start_next()
        if self.busy is None and self.following is not None:
            self.call_later(self.following._start_next, DRAWING_TIME)

    def precede(self, other: SectionWorker) -> None:
        """Give the tasks of this worker priority over the tasks of another worker."""
        self.following = other
        other.preceding.append(self)
