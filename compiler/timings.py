"""How long the parts of a command take, for whoever asks with --timings.

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

_taken: dict[str, float] | None = None  # seconds by part, in the order they were first entered
_within: list[float] = []  # of each part that is open, the seconds of the parts inside it


def recording() -> bool:
    """Say whether parts are measured now."""
    return _taken is not None


@contextmanager
def part(name: str) -> Iterator[None]:
    """Count the body's time for a part of the command; as often as it is entered, for the same part."""
    if _taken is None:
        yield
        return
    _taken.setdefault(name, 0.0)
    _within.append(0.0)
    start = time.perf_counter()
    try:
        yield
    finally:
        whole = time.perf_counter() - start
        _taken[name] += whole - _within.pop()
        if _within:
            _within[-1] += whole


@contextmanager
def record() -> Iterator[dict[str, float]]:
    """Measure the parts of the body; give their seconds, and of what is in none of them."""
    global _taken
    result: dict[str, float] = {}
    _taken = result
    try:
        with part(REST):
            yield result
    finally:
        _taken = None
        result[REST] = result.pop(REST)  # last
