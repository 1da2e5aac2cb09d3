"""Model size: the states, delays and packets of an analysis.

Takes: a `Model`.
Gives: `model_size`, the `ModelSize`; `SubsystemSize`.
Guarantees: the counts are those of the analysed systems; none of them is built.
Does not: analyse.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from apc.analysis.method_selection import make_plan
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.lifting.data_age import linear_subsystems, of_single_delay
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.linearization.evaluation_errors import finite_equations
from apc.linearization.jacobians import edge_name
from apc.result import Result


@dataclass(frozen=True, slots=True)
class SubsystemSize:
    """The number of states of one peer of a type, by kind: continuous states, stored outputs, packets in
    transit.
    """

    name: str
    motion: int
    stored: int
    packets: int

    @property
    def states(self) -> int:
        """The number of states of one peer: the sum of the three counts."""
        return self.motion + self.stored + self.packets


@dataclass(frozen=True, slots=True)
class ModelSize(Result):
    """The size of a model: `subsystems` one per peer type, `ticks` of each clock in a frame.

    `systems` are the (count, size) of the systems that `method` solves; `refused` is the reason if the model
    cannot be analysed. `pairs` names the receives that are evaluated once for each pair of peers.
    """

    shown_by = "analysis_output:model_size"

    peers: int
    frame: Fraction  # s
    subsystems: tuple[SubsystemSize, ...]
    ticks: tuple[tuple[str, int], ...]
    method: str
    systems: tuple[tuple[int, int], ...]
    refused: str
    pairs: tuple[str, ...]


def model_size(model: Model) -> ModelSize:
    """Return the numbers of states, ticks and packets in a frame of a model."""
    with finite_equations(model):
        return _model_size(model)


def _model_size(model: Model) -> ModelSize:
    """Return the size of a model; `refused` contains the reason if the model cannot be analysed.

    Peer types with ages of several delays are counted with the data of a single delay.
    """
    refused = ""
    try:
        numeric = numeric_model(model)
    except ApcError as error:  # ages of several delays; a simulation needs no single age
        refused = error.mistakes[0].sentence
        numeric = NumericModel(model, linear_subsystems(of_single_delay(model)))
    schedule_of = {
        group.peer_type: schedule
        for group, schedule in reversed(list(zip(model.groups, numeric.schedules, strict=True)))
    }
    subsystems = tuple(
        SubsystemSize(
            peer_type.name,
            len(peer_type.states),
            len(schedule_of[index].discrete_states),
            sum(schedule_of[index].depths),
        )
        for index, peer_type in enumerate(model.peer_types)
    )
    method: str = ""
    systems: tuple[tuple[int, int], ...] = ()
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # the sizes count here, not the values
            plan = None if refused else make_plan(numeric)
        if plan is not None:
            method, systems = plan.method, plan.systems
    except ApcError as error:  # a model that cannot be analysed may still be simulated
        refused = error.mistakes[0].sentence
    frame = numeric.schedules[0].frame_s
    return ModelSize(
        model.peers,
        frame,
        subsystems,
        tuple((clock.name, int(frame / numeric.timings[clock.period])) for clock in model.clocks),
        method,
        systems,
        refused,
        tuple(
            dict.fromkeys(
                receive.name
                for peer_type in model.peer_types
                for partition in peer_type.clocks
                for receive in partition.receives
                if edge_name(partition, receive)
            )
        ),
    )
