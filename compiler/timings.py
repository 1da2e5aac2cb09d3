"""Execution times of the parts of a command, for --timings.

Takes: the name of a part, around its code.
Gives: `part`, `record`, `recording`.
Guarantees: the time of a part does not include the parts inside it; without a recording nothing is measured.
Does not: print, or measure other processes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

# Time outside of all parts: modules are imported on first use, between the parts.
REST = "imports, rest"

_used: dict[str, float] | None = None  # seconds by part, in the order of first use
_within: list[float] = []  # for each open part, the seconds of the parts inside it


def recording() -> bool:
    """Return whether parts are being measured."""
    return _used is not None


@contextmanager
def part(name: str) -> Iterator[None]:
    """Measure the execution time of the `with` body as a part of the command; repeated parts are summed."""
    if _used is None:
        yield
        return
    _used.setdefault(name, 0.0)
    _within.append(0.0)
    start = time.perf_counter()
    try:
        yield
    finally:
        duration = time.perf_counter() - start
        _used[name] += duration - _within.pop()
        if _within:
            _within[-1] += duration


@contextmanager
def record() -> Iterator[dict[str, float]]:
    """Measure the parts of the `with` body; yield their seconds by name, with the remaining time."""
    global _used
    result: dict[str, float] = {}
    _used = result
    try:
        with part(REST):
            yield result
    finally:
        _used = None
        result[REST] = result.pop(REST)  # last
