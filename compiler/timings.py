"""Execution times of the parts of a command, for --timings.

Takes: the name of a part, around its code.
Gives: `part`, `record`, `recording`.
Guarantees: a part inside another counts for itself alone; where nobody records, nothing is measured.
Does not: print, or look into other processes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

# What is in no part: modules are imported where they are first needed, between the parts.
REST = "imports, rest"

_used: dict[str, float] | None = None  # seconds by part, in the order they were first entered
_within: list[float] = []  # of each part that is open, the seconds of the parts inside it


def recording() -> bool:
    """Return whether parts are being measured."""
    return _used is not None


@contextmanager
def part(name: str) -> Iterator[None]:
    """Measure the body's time for a part of the command; repeated entries are summed."""
    if _used is None:
        yield
        return
    _used.setdefault(name, 0.0)
    _within.append(0.0)
    start = time.perf_counter()
    try:
        yield
    finally:
        whole = time.perf_counter() - start
        _used[name] += whole - _within.pop()
        if _within:
            _within[-1] += whole


@contextmanager
def record() -> Iterator[dict[str, float]]:
    """Measure the parts of the body; yield their seconds, with the rest."""
    global _used
    result: dict[str, float] = {}
    _used = result
    try:
        with part(REST):
            yield result
    finally:
        _used = None
        result[REST] = result.pop(REST)  # last
