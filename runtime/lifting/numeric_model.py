"""A model at its parameter values: the input of every analysis.

Takes: a `Model`.
Gives: `NumericModel`, `numeric_model`, `linearized_at_start`, `delay_search_refused`.
Guarantees: data that does not depend on parameter values is built once. A model that is linearized at its
equilibrium has the equilibrium of its parameter values.
Does not: group peers, or analyse (see `peer_classes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.data_age import at_timings, linear_subsystems
from apc.lifting.model_numbers import ModelNumbers
from apc.lifting.rest_position import at_equilibrium
from apc.lifting.start_parameters import has_start_parameters
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linearize import at_start, reaches_start, sends_nothing
from apc.parameter_values.parameter_names import ParameterRef


@dataclass(frozen=True)
class NumericModel(ModelNumbers):
    """A model at its parameter values, with the Jacobians of each peer type (see `ModelNumbers`)."""

    def at(self, model: Model) -> NumericModel:
        """Return the same topology with other parameter values.

        The Jacobians are shared, and the schedules if the timings are equal. The ages of received values
        follow the timings. A model at its equilibrium has that of the new values.

        Raises
        ------
        ApcError
            E845 the values received with other timings affect the linearization of a peer type at its start.
        """
        if model is self.model:
            return self
        if model.at_equilibrium and not (self.starting and has_start_parameters(model)):
            model = at_equilibrium(model)
        changed = replace(self, model=model, given_schedules=())
        if changed.timings == self.timings:
            return replace(changed, given_schedules=self.schedules)
        jacobians = at_timings(model, self.jacobians, changed.timings, self.order)
        if self.starting and jacobians is not self.jacobians:
            result = _jacobians_at_start(replace(changed, jacobians=jacobians))
            if result is None:
                raise delay_search_refused(model)
            jacobians = result
        return replace(changed, jacobians=jacobians)

    def with_jacobians(self, jacobians: tuple[SubsystemJacobians, ...]) -> NumericModel:
        """Return the same model and schedules with other Jacobians."""
        return replace(self, jacobians=jacobians, given_schedules=self.schedules)


def numeric_model(model: Model) -> NumericModel:
    """Return a model at its parameter values, with the Jacobians of the nominal network.

    Parameters
    ----------
    model
        The compiled model, with the values to analyse (see `overrides.apply`).

    Raises
    ------
    ApcError
        E811 as `data_age.nominal`; for a model at its equilibrium, as `rest_position.operating_point_from`.
    """
    if model.at_equilibrium:
        model = at_equilibrium(model)
    return NumericModel(model, linear_subsystems(model))


def linearized_at_start(numeric: NumericModel, varied: Sequence[ParameterRef] = ()) -> NumericModel | None:
    """Return a model with every peer type linearized at its start, as a function of its parameters.

    The result is None if slopes depend on the values received at the start (see `linearize.at_start`), unless
    every peer sends 0 there, for any values of the `varied` parameters.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    varied
        The parameters that will have other values.
    """
    result = _jacobians_at_start(numeric, varied)
    return None if result is None else replace(numeric.with_jacobians(result), starting=True)


def _jacobians_at_start(
    numeric: NumericModel, varied: Sequence[ParameterRef] = ()
) -> tuple[SubsystemJacobians, ...] | None:
    """Return the Jacobians of each peer type at its start, None if some depend on received values."""
    model, subsystems = numeric.model, numeric.jacobians
    used_types = {group.peer_type for group in model.groups}
    silent = False
    if any(at_start(subsystems[peer_type]) is None for peer_type in used_types):
        silent = not any(reaches_start(model, parameter_ref) for parameter_ref in varied) and all(
            sends_nothing(model.peer_types[group.peer_type], rows)
            for group, rows in zip(model.groups, numeric.numbers.parameters, strict=True)
        )
    started = [
        at_start(subsystem, silent=silent) if peer_type in used_types else subsystem
        for peer_type, subsystem in enumerate(subsystems)
    ]
    result = tuple(subsystem for subsystem in started if subsystem is not None)
    return result if len(result) == len(subsystems) else None


def delay_search_refused(model: Model) -> ApcError:
    """Return the error for a delay of a model whose start depends on received values."""
    message = "the linearization depends on the initial packets, so delays can't be varied"
    advice = "use apc critical for a stiffness or damping"
    return ApcError(Diagnostic("E845", SourceLocation(model.origin.topology), message, advice=advice))
