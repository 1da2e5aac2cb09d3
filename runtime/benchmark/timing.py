"""How long a call takes: the one clock of every figure.

Takes: calls.
Gives: `timed`, `median_time`, `take_turns`, `spread_of`; `waited`.
Guarantees: a time is the processor's, of this process and all its threads, so that what else a machine does
counts little; of several the median counts, which one slow run doesn't move.
Does not: see what other processes do: who starts some waits for them by `waited`, the clock on the wall.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

Result = TypeVar("Result")

# In turns each call runs so often at least, whatever it takes: a median of fewer is no median.
LEAST_ROUNDS = 3


def timed(call: Callable[[], Result]) -> tuple[float, Result]:
    """Return the processor's seconds of a call, and what it returned."""
    began = time.process_time()
    result = call()
    return time.process_time() - began, result


def waited(call: Callable[[], Result]) -> tuple[float, Result]:
    """Return the seconds that a person waits for a call, the processes it starts included, and its result."""
    began = time.perf_counter()
    result = call()
    return time.perf_counter() - began, result


def median_time(call: Callable[[], Result], runs: int, *, enough: float = math.inf) -> tuple[float, Result]:
    """Return the median of the processor's seconds of some runs, and what the last one returned.

    Parameters
    ----------
    call
        What is run, at least once.
    runs
        How often.
    enough
        Seconds of all runs together after which there is no further one.
    """
    taken, result = timed(call)
    times = [taken]
    while len(times) < runs and sum(times) < enough:
        taken, result = timed(call)
        times.append(taken)
    return statistics.median(times), result


def take_turns(
    calls: Mapping[str, Callable[[], Any]], rounds: int, *, enough: float = math.inf
) -> dict[str, list[float]]:
    """Time all calls in rounds, so that what slows the machine for a while slows them alike.

    Parameters
    ----------
    calls
        By name.
    rounds
        Runs of each.
    enough
        Seconds of one call's runs together after which it has `LEAST_ROUNDS` at most.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(rounds):
        for name, call in calls.items():
            if number < LEAST_ROUNDS or sum(times[name]) <= enough:
                times[name].append(timed(call)[0])
    return times


def spread_of(times: Sequence[float]) -> float:
    """Return half the distance between the quartiles, 0 of a single time."""
    if len(times) < 2:
        return 0.0
    low, _, high = statistics.quantiles(times, n=4)
    return (high - low) / 2
