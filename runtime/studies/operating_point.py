"""The equilibrium of a model, searched from its start values or from the end of a simulation.

Takes: a `Model`. Gives: `operating_point`.
Guarantees: those of `lifting.rest_position`, wherever the search begins.
Does not: linearize.
"""

from __future__ import annotations

from fractions import Fraction

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.rest_position import START, OperatingPoint, operating_point_from
from apc.simulation.presence import refuse_joins_and_leaves
from apc.simulation.trajectory import simulate

SIMULATION = "simulation"


def operating_point(
    model: Model, *, initial: str = START, duration: Fraction | None = None
) -> OperatingPoint:
    """Return the equilibrium of a model.

    Parameters
    ----------
    model
        The model at its parameter values.
    initial
        The start of the search: "start" or "simulation".
    duration
        The duration of the simulation in seconds; by default that of the model's experiment.

    Raises
    ------
    ApcError
        E840 another start; the errors of `rest_position.operating_point_from` and `trajectory.simulate`.
    """
    if initial == START:
        return operating_point_from(model)
    if initial != SIMULATION:
        location, expected = SourceLocation("operating_point"), f"{START} or {SIMULATION}"
        raise ApcError(Diagnostic("E840", location, "initial", expected, initial[:40]))
    refuse_joins_and_leaves(model, "operating_point")
    trajectory = simulate(model, duration=duration)
    final = {
        signal.name: float(value)
        for signal, value in zip(trajectory.signals, trajectory.values[-1], strict=True)
    }
    return operating_point_from(model, final, SIMULATION)
