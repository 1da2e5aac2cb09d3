"""The equilibrium of a model: the rest position under constant forces, contacts included.

Takes: a `Model`. Gives: `OperatingPoint`, `RestValue`, `operating_point_from`; `at_equilibrium`, the model
with start values at rest; `linearized_at`, the model of the option `--operating-point`; `OPERATING_POINTS`;
`equilibrium_moves`, `equilibrium_note`.
Guarantees: those of `equilibrium_equations`.
Does not: simulate (see `studies.operating_point`), or decide stability.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.cache import EQUILIBRIUM_CHANGE
from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.compiler.wording import with_unit
from apc.lifting.data_age import aged, linear_subsystems
from apc.lifting.equilibrium_equations import VELOCITIES, EquilibriumEquations, classes_of_equals, root_of
from apc.lifting.model_numbers import ModelNumbers
from apc.lifting.start_parameters import (
    at_topology_start,
    names_at_rest,
    with_start_parameters,
    with_start_values,
)
from apc.linearization.evaluation_errors import evaluating
from apc.parameter_values.display_units import DisplayUnit, as_shown
from apc.parameter_values.parameter_names import ParameterRef, parameter_of, times_of
from apc.parameter_values.parameters import free_rows
from apc.result import Result

START, EQUILIBRIUM = "start", "equilibrium"
OPERATING_POINTS = (START, EQUILIBRIUM)

SHORT = 0.1  # m: shorter lengths are displayed in mm
MOST_NOTED = 6  # positions in one line
OTHERS_MAY_EXIST = "the equilibrium is the one found from the start values; others may exist"
CACHE_SIZE = 32  # models with cached equilibria

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RestValue:
    """The value of a position, or of another state except a velocity, at rest in SI."""

    name: str
    value: float
    unit: str

    @property
    def text(self) -> str:
        """The value in its display unit, with six digits; without such a unit small lengths are in mm."""
        factor, unit = as_shown(self.value, self.unit)
        if unit == LENGTH and not getattr(self.unit, "display", "") and 0 < abs(self.value) < SHORT:
            factor, unit = Fraction(1000), "mm"
        return with_unit(f"{float(self.value * factor):.6g}", unit)


@dataclass(frozen=True, slots=True)
class OperatingPoint(Result):
    """The equilibrium of a model: positions of each peer, velocities being 0.

    `residual` is the largest unbalanced force in `residual_unit`, below `tolerance`: N, or m/s² without a
    sampled force. `active` states for each contact or limit whether it is on, by name. `initial` is the start
    of the search. `model` has the equilibrium as its start values.
    """

    shown_by = "operating_point_output:operating_point"

    topology: str
    initial: str
    converged: bool
    positions: tuple[RestValue, ...]
    active: tuple[tuple[str, bool], ...]
    residual: float
    residual_unit: str
    tolerance: float
    model: Model


def linearized_at(model: Model, operating_point: str) -> Model:
    """Return the model of an operating point: linearized at its start values, or at its equilibrium.

    Parameters
    ----------
    model
        The compiled model.
    operating_point
        One of `OPERATING_POINTS`.

    Raises
    ------
    ApcError
        E840 another operating point; E847, E848 and E849 as `operating_point_from`.
    """
    if operating_point not in OPERATING_POINTS:
        expected = " or ".join(OPERATING_POINTS)
        location = SourceLocation("operating point")
        raise ApcError(Diagnostic("E840", location, "operating point", expected, operating_point[:40]))
    if operating_point == START:
        return model
    changed = replace(model, at_equilibrium=True)
    operating_point_from(changed)
    return changed


def equilibrium_moves(model: Model, varied: Sequence[ParameterRef]) -> bool:
    """Return whether some parameter may change the equilibrium of a model: all except times alone."""
    numbers = np.array([1.0, 2.0])
    for ref in varied:
        if aged(model) or not times_of(model, ref.name):
            return True
        groups = [group for group in model.groups if ref.group in (None, group.name)]
        with np.errstate(all="ignore"):
            if any(len(free_rows(model, group, 0, {ref: numbers})) > 1 for group in groups):
                return True
    return False


def equilibrium_note(model: Model) -> tuple[str, ...]:
    """Return the positions of the equilibrium in one line; empty for a model linearized at its start."""
    if not model.at_equilibrium:
        return ()
    positions = operating_point_from(model).positions
    shown = [f"{position.name} = {position.text}" for position in positions[:MOST_NOTED]]
    return (
        f"equilibrium at the present values: {', '.join([*shown, *['…'][: len(positions) - MOST_NOTED]])}",
        OTHERS_MAY_EXIST,
    )


def at_equilibrium(model: Model) -> Model:
    """Return a nonlinear model with the equilibrium as its start values; a linear model unchanged.

    The linearization of a linear model is the same at every point.
    """
    numeric = _at_start(with_start_parameters(model))
    return model if numeric.affine else operating_point_from(model).model


@part("equilibrium")
def operating_point_from(
    model: Model, start: Mapping[str, float] | None = None, initial: str = START
) -> OperatingPoint:
    """Return the equilibrium of a model, from its start values or other states.

    Parameters
    ----------
    model
        The compiled model at its parameter values.
    start
        States by peer and name, such as "left[1].device.x", in SI; by default the start values.
    initial
        The name of these states in the result.

    Raises
    ------
    ApcError
        E804 too many different peers; E808 a value that is not finite; E847 no equilibrium, as a constant
        force acts on a body that nothing holds; E848 no convergence; E849 an equation that depends on time.
    """
    return _operating_point(model, None if start is None else tuple(start.items()), initial)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _operating_point(
    model: Model, start: tuple[tuple[str, float], ...] | None, initial: str
) -> OperatingPoint:
    """Return the equilibrium of `operating_point_from`, cached."""
    extended = with_start_parameters(model)
    with evaluating(model):
        numeric = _at_start(extended)
        classes = classes_of_equals(numeric)
        equations = EquilibriumEquations(numeric, classes, dict(start or ()))
        z = root_of(equations)
        active = equations.active(z)
        residual, unit, tolerance, _ = equations.largest_force(z)
    values = [
        dict(zip(peer_type.parameters, parameters, strict=True))
        | dict(zip(names_at_rest(peer_type), row.tolist(), strict=True))
        for peer_type, row, parameters in zip(
            equations.peer_types, equations.split(z), equations.parameters, strict=True
        )
    ]
    origin = model.origin if model.at_equilibrium else model.origin.after((EQUILIBRIUM_CHANGE, initial))
    return OperatingPoint(
        topology=model.name,
        initial=initial,
        converged=True,
        positions=_positions(equations, z),
        active=active,
        residual=residual,
        residual_unit=unit,
        tolerance=tolerance,
        model=replace(with_start_values(extended, classes, values), origin=origin),
    )


def _at_start(extended: Model) -> ModelNumbers:
    """Return a model at its parameter values, with the start values of the topology."""
    base = at_topology_start(extended)
    return ModelNumbers(base, linear_subsystems(base))


def _positions(equations: EquilibriumEquations, z: Floats) -> tuple[RestValue, ...]:
    """Return the states of all classes at rest, except velocities."""
    model, result = equations.numeric.model, []
    for g, (prefix, peer_type) in enumerate(zip(equations.prefixes(), equations.peer_types, strict=True)):
        group = model.groups[equations.starting.groups[g]].name
        for state, value in zip(peer_type.states, equations.split(z)[g].tolist(), strict=False):
            if state.unit not in VELOCITIES:
                shown = parameter_of(model, ParameterRef(state.start, group)).display_unit
                result.append(RestValue(f"{prefix}{state.name}", value, DisplayUnit(state.unit, shown)))
    return tuple(result)
