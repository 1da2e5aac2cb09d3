"""Worker processes of a page: each computes the most recent request of every section, by priority.

Takes: a compiled model as bytes; tasks.
Gives: `Desk`.
Guarantees: the page never blocks. Only the newest request of a section is computed, and results older than
the displayed one are dropped. A process with an obsolete, long computation is ended.
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
from apc.processes import Workers, local_processes

# Seconds after which work that is no longer wanted is ended: to start afresh takes about one.
PATIENCE = 3.0
# Seconds for which each piece of work is held back at most while the desk before it is busy: who moves a
# slider without a stop sees what comes later some times a second.
HELD = 0.2
# Seconds that a browser has for drawing an answer before there is more to do.
PLOTTED = 0.05

LOST = Diagnostic(
    "E981", SourceLocation("explore"), "the process that computes ended without a word: too little memory?"
)

# Called with a section and its result.
Deliver = Callable[[str, SectionAnswer], None]


@dataclass(slots=True, eq=False)
class Desk:
    """One process with its pending tasks, by section; `order` is the priority.

    The section computed longest ago comes first; otherwise a continuously moved slider would starve all
    sections but one. While one of the desks `before` is busy, no task is started here, so that their results
    have the processor. All calls are from the server thread; `call_later` schedules a call in that thread
    after a number of seconds.
    """

    model: bytes
    order: tuple[str, ...]
    call_later: Callable[[Callable[[], None], float], None]
    deliver: Deliver
    before: list[Desk] = field(default_factory=list)
    behind: Desk | None = None
    last: dict[str, Task] = field(default_factory=dict)
    waiting: dict[str, tuple[int, Task]] = field(default_factory=dict)
    held: float | None = None  # since when
    begun: dict[str, int] = field(default_factory=dict)
    shown: dict[str, int] = field(default_factory=dict)
    numbers: itertools.count[int] = field(default_factory=itertools.count)
    busy: tuple[int, Task, float] | None = None
    stack: ExitStack = field(default_factory=ExitStack)
    workers: Workers[Task, SectionAnswer] | None = None

    def ask(self, task: Task) -> bool:
        """Schedule a section, replacing its pending task, unless the same task was requested last.

        Return whether it was scheduled.
        """
        if self.last.get(task.section) == task:
            return False
        self.last[task.section] = task
        self.waiting[task.section] = (next(self.numbers), task)
        if self.busy is not None:
            number, running, since = self.busy
            first = self.order.index(task.section) <= self.order.index(running.section)
            if first and time.monotonic() - since > PATIENCE:
                self._end()
                if running.section in self.last:  # what is still wanted comes after
                    self.waiting.setdefault(running.section, (number, running))
        self._next()
        return True

    def forget(self, section: str) -> None:
        """Cancel a section, and drop its pending result."""
        self.last.pop(section, None)
        self.waiting.pop(section, None)
        self.shown[section] = next(self.numbers)

    def close(self) -> None:
        """End the process immediately."""
        self.waiting.clear()
        self._end()

    def _end(self) -> None:
        self.busy, self.workers = None, None
        self.stack.close()

    def _next(self) -> None:
        if self.busy is not None or not self.waiting or self._must_wait():
            return
        if self.workers is None:
            self.workers = self.stack.enter_context(local_processes(compute, self.model, 1, LOST))
        section = min(self.waiting, key=lambda text: (self.begun.get(text, -1), self.order.index(text)))
        number, task = self.waiting.pop(section)
        self.begun[section], self.held = next(self.numbers), None
        self.busy = (number, task, time.monotonic())
        future = self.workers.submit(task)
        future.add_done_callback(lambda done: self.call_later(lambda: self._done(number, task, done), 0))

    def _must_wait(self) -> bool:
        """Return whether others go first, and look again when they may have had long enough."""
        now = time.monotonic()
        if all(desk.busy is None for desk in self.before):
            self.held = None
        elif self.held is None:
            self.held = now
            self.call_later(self._next, 1.1 * HELD)  # a timer may come early
        return self.held is not None and now - self.held < HELD

    def _done(self, number: int, task: Task, done: Future[SectionAnswer]) -> None:
        if self.busy is None or self.busy[0] != number:
            return  # it was ended, and is no longer asked
        self.busy = None
        try:
            answer = done.result()
        except (BrokenProcessPool, CancelledError):
            self._end()
            self.last.pop(task.section, None)
            answer = SectionAnswer(None, LOST.sentence)
        if number > self.shown.get(task.section, -1):
            self.shown[task.section] = number
            self.deliver(task.section, answer)
        self._next()
        if self.busy is None and self.behind is not None:
            self.call_later(self.behind._next, PLOTTED)

    def put_before(self, other: Desk) -> None:
        """Give requests here priority over those of another desk."""
        self.behind = other
        other.before.append(self)
