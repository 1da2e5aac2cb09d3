"""Schedules of compiled systems, for tests."""

from __future__ import annotations

from collections.abc import Sequence

from apc.compiler.compiled import CompiledSystem
from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.frame.schedule import ORDER, Schedule
from apc.frame.scheduling import build_schedules


def schedules(system: CompiledSystem, order: Sequence[str] = ORDER) -> tuple[Schedule, ...]:
    """Return the schedule of every group."""
    patterns = [jacobians(kind).pattern for kind in system.kinds]
    return build_schedules(system, resolve(system).timings, patterns, order=order)
