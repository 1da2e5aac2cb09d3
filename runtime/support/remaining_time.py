"""The estimate of the remaining time of a computation, and its text.

Takes: the completed amount of work, repeatedly. Gives: `RemainingTime`.
Guarantees: there is an estimate only once `SHARE` of the work is complete, at a steady rate.
Does not: print.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Callable

from apc.compiler.wording import time_text

# The share of the work that is complete before the first estimate.
SHARE = 0.3

# The largest ratio of the times of successive halves of the completed work at a steady rate.
STEADY = 1.25

# The number of stored points over the complete work.
POINTS = 400


class RemainingTime:
    """The rate of a computation, recorded from its start.

    Work that becomes slower, such as a search over increasing delays, has no estimate: an extrapolation would
    be too short.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._start = clock, clock()
        self._amounts, self._times = [0.0], [0.0]

    def seconds(self, done: float, total: float) -> float | None:
        """Record the completed amount, and return the estimated remaining time, None without an estimate."""
        if len(self._amounts) > 1 and (done - self._amounts[-2]) * POINTS < total:
            del self._amounts[-1], self._times[-1]  # too close to the previous point
        self._amounts.append(done)
        self._times.append(self._clock() - self._start)
        if not SHARE * total <= done < total:
            return None
        halves = self._time_between(0.0, done / 2), self._time_between(done / 2, done)
        quarters = self._time_between(done / 2, 3 * done / 4), self._time_between(3 * done / 4, done)
        if any(later > STEADY * earlier or earlier > STEADY * later for earlier, later in (halves, quarters)):
            return None
        return halves[1] / (done / 2) * (total - done)

    def text(self, done: float, total: float) -> str:
        """Record the completed amount, and return the elapsed time and the estimated remaining time."""
        left = self.seconds(done, total)
        estimate = "" if left is None else f", about {time_text(left)} left"
        return f"{time_text(self._clock() - self._start)} elapsed{estimate}"

    def _time_between(self, low: float, high: float) -> float:
        """Return the time of the work between two amounts, interpolated between stored points."""
        return self._time_at(high) - self._time_at(low)

    def _time_at(self, amount: float) -> float:
        """Return the time at which an amount was complete."""
        index = min(bisect_left(self._amounts, amount), len(self._amounts) - 1)
        if not index or self._amounts[index] <= amount:
            return self._times[index]
        before, after = self._amounts[index - 1], self._amounts[index]
        part = (amount - before) / (after - before)
        return self._times[index - 1] + part * (self._times[index] - self._times[index - 1])
