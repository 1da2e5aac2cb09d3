"""How long it takes to look for margins, from counts alone: the same on every machine, at any load.

Takes: a `CompiledSystem`, and what was prepared of it.
Gives: `Effort`, `effort_of`, `affordable`.
Guarantees: nothing is timed; where one peer alone makes a system that is too large, no matrix is made to say
so.
Does not: know what a proof of a crossing takes (it is among what was measured).

Seconds are those of a desktop with one thread, measured with the scenes of models/scenes and tests/hard and
with rows of 34 to 200 masses; half of them are to spare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from apc.analysis.analysis import Prepared, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.modes import arrange
from apc.eigen.peer_group import states_of

# Of a parameter: some sixty matrices, their eigenvalues with slopes, and the events of as many frames.
PARAMETER, PARAMETER_SQUARE, PARAMETER_EVENT = 0.025, 60e-6, 4e-6

# Of an analysis, and of each state that is no packet.
ANALYSIS, ANALYSIS_STATE = 0.1, 0.01

# Of a piece of a delay: its schedules, bounded matrices and eigenvalues at three values or more.
PIECE, PIECE_SQUARE, PIECE_EVENT, PIECE_ENTRY = 0.015, 40e-6, 40e-6, 0.6e-6

# Of a piece of a delay that only makes packets late.
LATE, LATE_SQUARE, LATE_EVENT = 0.005, 5e-6, 50e-6

# Beyond so many states time grows by their cube.
CUBIC = 200


@dataclass(frozen=True, slots=True)
class Effort:
    """What the effort follows from.

    `states` are those of each loop, `moving` those that are no packets on their way; `events` happen in a
    frame, of a peer whose maps have `width` columns.
    """

    states: tuple[int, ...]
    moving: tuple[int, ...]
    events: int
    width: int

    @property
    def largest(self) -> int:
        """The states of the largest loop."""
        return max(self.states, default=0)

    def of_analyses(self, count: int) -> float:
        """Return the seconds that so many analyses take that leave packets out of the state."""
        return count * (ANALYSIS + ANALYSIS_STATE * sum(self.moving))

    def of_parameter(self) -> float:
        """Return the seconds that a stiffness or damping takes."""
        composed = PARAMETER_EVENT * self.events * self.width
        return PARAMETER + PARAMETER_SQUARE * _squares(self.states) + composed

    def of_delay(self, pieces: int, *, late: bool) -> float:
        """Return the seconds that so many pieces of a delay take; `late`: only packets come later by it."""
        if late:
            return pieces * (LATE + LATE_SQUARE * _squares(self.moving) + LATE_EVENT * self.events)
        entries = self.events * self.width
        own = PIECE_SQUARE * _squares(self.states) + PIECE_EVENT * self.events + PIECE_ENTRY * entries
        return pieces * (PIECE + own)


def _squares(states: Sequence[int]) -> float:
    return sum(one**2 * max(1.0, one / CUBIC) for one in states)


def effort_of(system: CompiledSystem, prepared: Prepared, *, most: float) -> Effort:
    """Return what the effort follows from; of one peer alone where that takes more than `most` seconds."""
    schedules = prepared.schedules
    kinds = [prepared.jacobians[group.kind] for group in system.groups]
    sizes = [states_of(*pair) for pair in zip(schedules, kinds, strict=True)]
    events = max(len(one.events) for one in schedules)
    width = max(size + len(one.heard) for size, one in zip(sizes, schedules, strict=True))
    alone = Effort((max(sizes),), (0,), events, width)
    if alone.of_parameter() > most:
        return alone
    loops = arrange(*lifted_groups(system, prepared=prepared)).loops
    states = tuple(loop.states for loop in loops)
    moving = tuple(loop.states - len(loop.packets) for loop in loops)
    return Effort(states, moving, events, width)


def affordable(costs: Sequence[float], most: float) -> list[bool]:
    """Say which of some costs are borne, one after the other, as long as their sum stays within the most."""
    found = []
    for cost in costs:
        found.append(cost <= most)
        most -= cost if found[-1] else 0.0
    return found
