"""Measurement of the processor time of calls.

Takes: calls.
Gives: `timed`, `median_time`, `alternate`, `spread_of`.
Guarantees: times are processor times of this process and its threads, which depend little on the load of the
machine; of several runs the median is used, which is robust to single slow runs.
Does not: include the time of other processes.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

Result = TypeVar("Result")

# The smallest number of runs of each call in rounds, for a meaningful median.
LEAST_ROUNDS = 3


def timed(call: Callable[[], Result]) -> tuple[float, Result]:
    """Return the processor time of a call in seconds, and the result of the call."""
    start = time.process_time()
    result = call()
    return time.process_time() - start, result


def median_time(call: Callable[[], Result], runs: int, *, enough: float = math.inf) -> tuple[float, Result]:
    """Return the median processor time of several runs in seconds, and the result of the last run.

    Parameters
    ----------
    call
        The function to run, at least once.
    runs
        The largest number of runs.
    enough
        The total time of all runs in seconds after which no further run starts.
    """
    seconds, result = timed(call)
    times = [seconds]
    while len(times) < runs and sum(times) < enough:
        seconds, result = timed(call)
        times.append(seconds)
    return statistics.median(times), result


def alternate(
    calls: Mapping[str, Callable[[], Any]], rounds: int, *, enough: float = math.inf
) -> dict[str, list[float]]:
    """Return the processor times of all calls in seconds, by name.

    The calls run in rounds, so that a temporary load of the machine affects all of them equally.

    Parameters
    ----------
    calls
        The calls by name.
    rounds
        The largest number of runs of each call.
    enough
        The total time of a call in seconds after which the call has at most `LEAST_ROUNDS` runs.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(rounds):
        for name, call in calls.items():
            if number < LEAST_ROUNDS or sum(times[name]) <= enough:
                times[name].append(timed(call)[0])
    return times


def spread_of(times: Sequence[float]) -> float:
    """Return half the interquartile range of times, 0 for a single time."""
    if len(times) < 2:
        return 0.0
    low, _, high = statistics.quantiles(times, n=4)
    return (high - low) / 2
