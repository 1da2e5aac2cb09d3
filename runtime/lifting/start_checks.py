"""Test that the equations of a model have finite values at the start, and its frame a finite map.

Takes: a `Model`. Gives: `check_values`.
Guarantees: a compiled model can be linearized and lifted, or the message names the value that is not finite.
Does not: bound the map's error (see `lift`).
"""

from __future__ import annotations

import numpy as np

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.lifting.data_age import linear_subsystems, of_single_delay
from apc.lifting.discretize import TOO_LARGE, refuse_many
from apc.lifting.lift import lift
from apc.linearization.evaluation_errors import evaluating
from apc.linearization.linearize import check_start, linearize
from apc.parameter_values.parameters import resolve
from apc.timing.scheduling import build_schedules

# Subsystems of a peer type that are checked: they differ in parameter values only.
MOST_CHECKED = 3


@part("check of values")
def check_values(model: Model) -> None:
    """Linearize and lift the first few subsystems of each peer type; raise an error for a non-finite value.

    A peer type whose slopes depend on received values is left to the analysis, which computes the start. Ages
    are those of each link's own delay: where delays differ from pair to pair, only an analysis refuses the
    model, and a simulation needs no single age.

    Raises
    ------
    ApcError
        E806 a frame leaves the range of floats; E808 an equation has no finite value at the start values;
        E812 a peer has too many states.
    """
    location = SourceLocation(model.origin.topology)
    for peer_type in model.peer_types:
        refuse_many(len(peer_type.states), location)
    numbers = resolve(model)
    subsystems = linear_subsystems(of_single_delay(model), numbers.timings)
    schedules = build_schedules(model, numbers.timings, [subsystem.pattern for subsystem in subsystems])
    with evaluating(model):
        for group, schedule, rows in zip(model.groups, schedules, numbers.parameters, strict=True):
            if not subsystems[group.peer_type].parameters_suffice:
                continue
            for parameters in np.unique(rows[:MOST_CHECKED], axis=0):
                check_start(subsystems[group.peer_type], parameters)
                frame = lift(linearize(subsystems[group.peer_type], parameters), schedule)
                if not all(np.isfinite(block).all() for block in (frame.p, frame.q, frame.s, frame.d)):
                    raise ApcError(Diagnostic("E806", location, TOO_LARGE))
