"""What a scene needs: the states, delays and packets its analysis keeps, and nothing else.

Takes: a `Model`. Gives: `ModelSize`.
Guarantees: the counts are those of the systems that are analysed; none of them is built.
Does not: analyse.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from apc.analysis.plan import make_plan
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.frame.ages import linear_sites, of_one_delay
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import instance, prepare
from apc.frame.jacobians import edge_name
from apc.result import Result


@dataclass(frozen=True, slots=True)
class SubsystemSize:
    """What one peer of a kind keeps from frame to frame."""

    name: str
    motion: int
    remembered: int
    packets: int

    @property
    def states(self) -> int:
        """All of it together."""
        return self.motion + self.remembered + self.packets


@dataclass(frozen=True, slots=True)
class ModelSize(Result):
    """What a scene keeps: `sites` one a kind, `ticks` of each clock in a frame.

    It is analysed by `method` as `systems`, (count, size); `refused` says why there are none, where there are
    none. `pairs` names the receives that are evaluated once a pair of peers.
    """

    shown_by = "analysis_output:needs"

    peers: int
    frame: Fraction  # s
    sites: tuple[SubsystemSize, ...]
    ticks: tuple[tuple[str, int], ...]
    method: str
    systems: tuple[tuple[int, int], ...]
    refused: str
    pairs: tuple[str, ...]


def needs(system: Model) -> ModelSize:
    """Count what a scene keeps from frame to frame."""
    with finite_equations(system.origin.topology):
        return _needs(system)


def _needs(system: Model) -> ModelSize:
    refused = ""
    try:
        prepared = prepare(system)
    except ApcError as error:  # ages of several delays, which a simulation needs no single value of
        refused = error.mistakes[0].sentence
        prepared = prepare(system, linear_sites(of_one_delay(system)))
    schedule_of = {
        group.kind: schedule
        for group, schedule in reversed(list(zip(system.groups, prepared.schedules, strict=True)))
    }
    sites = tuple(
        SubsystemSize(
            kind.name, len(kind.states), len(schedule_of[place].carried), sum(schedule_of[place].depths)
        )
        for place, kind in enumerate(system.kinds)
    )
    method: str = ""
    systems: tuple[tuple[int, int], ...] = ()
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # the sizes count here, not the numbers
            plan = None if refused else make_plan(instance(system, prepared))
        if plan is not None:
            method, systems = plan.method, plan.systems
    except ApcError as error:  # a scene that can't be analysed may still be run
        refused = error.mistakes[0].sentence
    frame = prepared.schedules[0].frame_s
    return ModelSize(
        system.peers,
        frame,
        sites,
        tuple((clock.name, int(frame / prepared.timings[clock.period])) for clock in system.clocks),
        method,
        systems,
        refused,
        tuple(
            dict.fromkeys(
                receive.name
                for kind in system.kinds
                for partition in kind.clocks
                for receive in partition.receives
                if edge_name(partition, receive)
            )
        ),
    )
