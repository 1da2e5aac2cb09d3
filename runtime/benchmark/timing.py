"""How long a call takes: the one clock of every figure.

Takes: calls.
Gives: `timed`, `median_time`, `alternate`, `spread_of`.
Guarantees: a time is the processor's, of this process and all its threads, so that what else a machine does
counts little; of several the median counts, which one slow run doesn't move.
Does not: count the time of other processes.
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
    """Return the processor's seconds of a call, and its result."""
    began = time.process_time()
    result = call()
    return time.process_time() - began, result


def median_time(call: Callable[[], Result], runs: int, *, enough: float = math.inf) -> tuple[float, Result]:
    """Return the median of the processor's seconds of some runs, and the result of the last one.

    Parameters
    ----------
    call
        The function to run, at least once.
    runs
        How often.
    enough
        Seconds of all runs together after which there is no further one.
    """
    used, result = timed(call)
    times = [used]
    while len(times) < runs and sum(times) < enough:
        used, result = timed(call)
        times.append(used)
    return statistics.median(times), result


def alternate(
    calls: Mapping[str, Callable[[], Any]], rounds: int, *, enough: float = math.inf
) -> dict[str, list[float]]:
    """Time all calls in rounds, so that a temporary load on the machine slows all of them equally.

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
