"""Which limits a motion breaks: of a device's force and reach, and of whatever else declares one.

Takes: a compiled scene, the signals that are recorded, rows as they come. Gives: `Broken`, `LimitWatch`.
Guarantees: looks at every row, and at what is recorded; the limits of each peer are its own.
Does not: keep a motion within them; that is for equations (`limits: on` of a device).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Group
from apc.simulation.signals import Signal

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Broken:
    """A limit that was broken: the `signal`, its `limit` by name and `value`, in SI, with its `unit`.

    It is beyond it from `first_s` seconds on; its largest size is `most`, at `at_s` seconds.
    """

    signal: str
    limit: str
    value: float
    unit: str
    first_s: float
    most: float
    at_s: float


class LimitWatch:
    """Looks at those signals that have a limit, as rows pass."""

    def __init__(self, system: CompiledSystem, signals: Sequence[Signal]) -> None:
        """Begin before the first row; `signals` are those of the rows, in their order."""
        self.signals = signals
        limits = {
            (group.name, one.name): one.limit
            for group in system.groups
            for one in system.kinds[group.kind].limits
        }
        groups = {group.name: group for group in system.groups}
        everywhere = {one.name: one.value for one in system.parameters}
        own = [
            (i, one, limits[one.group, one.local])
            for i, one in enumerate(signals)
            if (one.group, one.local) in limits
        ]
        self.columns = [i for i, _, _ in own]
        self.names = [name for _, _, name in own]
        self.bounds = np.array(
            [_number(groups[one.group], one.peer, name, everywhere) for _, one, name in own]
        )
        self.first = np.full(len(own), np.nan)
        self.most, self.at = self.bounds.copy(), np.zeros(len(own))

    def take(self, time: Floats, values: Floats) -> None:
        """Look at some rows: `time` (rows,), `values` (rows, signals)."""
        if not self.columns or not len(time):
            return
        size = np.abs(values[:, self.columns])
        beyond = size > self.bounds
        began = beyond.any(axis=0) & np.isnan(self.first)
        self.first[began] = time[beyond[:, began].argmax(axis=0)]
        largest = size.max(axis=0)
        grown = largest > self.most
        self.most[grown], self.at[grown] = largest[grown], time[size[:, grown].argmax(axis=0)]

    def broken(self) -> tuple[Broken, ...]:
        """Return the limits that were broken, the first of them first."""
        found = [
            Broken(
                self.signals[column].name,
                name,
                float(self.bounds[place]),
                self.signals[column].unit,
                float(self.first[place]),
                float(self.most[place]),
                float(self.at[place]),
            )
            for place, (column, name) in enumerate(zip(self.columns, self.names, strict=True))
            if not np.isnan(self.first[place])
        ]
        return tuple(sorted(found, key=lambda one: one.first_s))


def _number(group: Group, peer: int, name: str, everywhere: dict[str, float]) -> float:
    """Return a number of one peer, counted from 1: its own, its group's, or that of all."""
    for column in group.columns:
        if column.name == name:
            return float(column.values[peer - 1])
    return next((one.value for one in group.values if one.name == name), everywhere[name])
