"""Real-time privileges of the process under Linux, and those that were not granted.

Takes: nothing. Gives: `claim`, `now`.
Guarantees: privileges that are not granted are reported; no change outlives the process.
Does not: measure (see `peer`).
"""

from __future__ import annotations

import ctypes
import gc
import os
import time

PRIORITY = 50  # of SCHED_FIFO's 1 to 99: above the threads of interrupts, below watchdogs
MCL_CURRENT, MCL_FUTURE = 1, 2  # mlockall(2)


def now() -> int:
    """Return the time of the host's monotonic clock, in nanoseconds."""
    return time.monotonic_ns()


def claim() -> tuple[str, ...]:
    """Request real-time scheduling and locked memory; return the privileges that were not granted."""
    gc.collect()
    gc.freeze()
    gc.disable()
    missing = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (OSError, AttributeError) as error:
        missing.append(f"SCHED_FIFO: {_reason(error)}")
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(MCL_CURRENT | MCL_FUTURE):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    except (OSError, AttributeError, TypeError) as error:
        missing.append(f"mlockall: {_reason(error)}")
    return tuple(missing)


def _reason(error: Exception) -> str:
    """Return the reason of a failed request."""
    return (error.strerror if isinstance(error, OSError) else "") or "not available on this system"
