"""A model at its parameter values: the input of every analysis.

Takes: a `Model`.
Gives: `NumericModel`, `numeric_model`, `linearized_at_start`, `delay_search_refused`; `PeerIndices`.
Guarantees: data that does not depend on parameter values is built once.
Does not: group peers, or analyse (see `peer_classes`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.data_age import at_timings, linear_subsystems
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linearize import at_start, reaches_start, sends_nothing
from apc.parameter_values.parameter_names import ParameterRef
from apc.parameter_values.parameters import ResolvedNumbers, resolve
from apc.timing.communication_graph import CommunicationGraph, build_exchange
from apc.timing.schedule import ORDER, Schedule
from apc.timing.scheduling import build_schedules

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PeerIndices:
    """The peer numbers of a model, as consecutive runs, one per group: a billion peers take no memory."""

    runs: tuple[range, ...]

    def __len__(self) -> int:
        return sum(map(len, self.runs))

    def __iter__(self) -> Iterator[int]:
        return itertools.chain.from_iterable(self.runs)

    def __contains__(self, peer: object) -> bool:
        return any(peer in run for run in self.runs)

    @property
    def first(self) -> int:
        """The first peer."""
        return self.runs[0].start

    @property
    def last(self) -> int:
        """The last peer."""
        return self.runs[-1][-1]

    @property
    def others(self) -> PeerIndices:
        """All peers but the first."""
        return PeerIndices(tuple(run for run in (self.runs[0][1:], *self.runs[1:]) if run))


@dataclass(frozen=True)
class NumericModel:
    """A model at its parameter values, with the Jacobians of each peer type.

    `order` is the order of coincident events. If `starting`, the Jacobians are those at each peer type's
    start, as functions of its parameters. `given_schedules`, one per group, replace those of
    `build_schedules`. Equal models with the same Jacobians and order are equal.
    """

    model: Model
    jacobians: tuple[SubsystemJacobians, ...]
    order: tuple[str, ...] = ORDER
    starting: bool = field(default=False, compare=False)
    given_schedules: tuple[Schedule, ...] = field(default=(), compare=False, repr=False)

    @property
    def timings(self) -> dict[str, Fraction]:
        """Seconds by the name of the timing."""
        return {timing.name: timing.value for timing in self.model.timings}

    @cached_property
    def schedules(self) -> tuple[Schedule, ...]:
        """The schedule of each group."""
        if self.given_schedules:
            return self.given_schedules
        patterns = [subsystem.pattern for subsystem in self.jacobians]
        return build_schedules(self.model, self.timings, patterns, order=self.order)

    @cached_property
    def numbers(self) -> ResolvedNumbers:
        """The resolved parameters of all peers."""
        return resolve(self.model)

    @cached_property
    def exchange(self) -> CommunicationGraph:
        """The communication graph."""
        return build_exchange(self.model, self.timings)

    @property
    def subsystems(self) -> tuple[SubsystemJacobians, ...]:
        """The Jacobians of each group's peer type."""
        return tuple(self.jacobians[group.peer_type] for group in self.model.groups)

    @property
    def affine(self) -> bool:
        """Whether the equations of every group are affine."""
        return all(subsystem.affine for subsystem in self.subsystems)

    def vector(self, peer: int) -> Floats:
        """Return the parameters (n_p,) of a peer."""
        group = self.exchange.group_of(peer)
        row = self.numbers.rows[group][peer - self.exchange.starts[group]]
        return np.asarray(self.numbers.parameters[group][row])

    def at(self, model: Model) -> NumericModel:
        """Return the same topology with other parameter values.

        The Jacobians are shared, and the schedules if the timings are equal. The ages of received values
        follow the timings.

        Raises
        ------
        ApcError
            E845 the values received with other timings affect the linearization of a peer type at its start.
        """
        if model is self.model:
            return self
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
        E811 as `data_age.nominal`.
    """
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
