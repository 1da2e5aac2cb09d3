"""A model with parameter values: data shared by its analyses, and the start of one of them.

Takes: a `Model`.
Gives: `Prepared`, `prepare`, `prepared_at`, `linearized_at_start`, `delay_search_refused`; `Instance`,
`instance`; `PeerIndices`.
Guarantees: data that does not depend on parameter values is built once.
Does not: group peers, or analyse (see `peer_classes`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.communication_graph import CommunicationGraph, build_exchange
from apc.frame.data_age import at_timings, linear_subsystems
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.linearize import at_start, reaches_start, sends_nothing
from apc.frame.parameter_names import ParameterRef
from apc.frame.parameters import ResolvedNumbers, resolve
from apc.frame.schedule import ORDER, Schedule
from apc.frame.scheduling import build_schedules

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Prepared:
    """The data shared by analyses of one model with different parameter values.

    The Jacobians (one per peer type) hold for any values; the schedules (one per group) for these timings and
    this order of coincident events. With `starting` the Jacobians are those at each peer type's start (see
    `starting`).
    """

    jacobians: tuple[SubsystemJacobians, ...]
    schedules: tuple[Schedule, ...]
    timings: Mapping[str, Fraction]
    order: tuple[str, ...]
    starting: bool = False


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


@dataclass(frozen=True, slots=True)
class Instance:
    """A model with parameter values: Jacobians (per peer type), schedules (per group), and the links."""

    system: Model
    jacobians: tuple[SubsystemJacobians, ...]
    schedules: tuple[Schedule, ...]
    numbers: ResolvedNumbers
    exchange: CommunicationGraph

    @property
    def subsystems(self) -> tuple[SubsystemJacobians, ...]:
        """The Jacobians of each group's peer type."""
        return tuple(self.jacobians[group.peer_type] for group in self.system.groups)

    def vector(self, peer: int) -> Floats:
        """Return the parameters (n_p,) of a peer."""
        group = self.exchange.group_of(peer)
        row = self.numbers.rows[group][peer - self.exchange.starts[group]]
        return np.asarray(self.numbers.parameters[group][row])

    @property
    def affine(self) -> bool:
        """Whether the equations of every group are affine."""
        return all(subsystem.affine for subsystem in self.subsystems)


def prepare(system: Model, subsystems: tuple[SubsystemJacobians, ...] | None = None) -> Prepared:
    """Return the data that analyses with different parameter values share.

    Parameters
    ----------
    system
        The compiled model.
    subsystems
        The Jacobians of each peer type; by default those of the nominal network.

    Raises
    ------
    ApcError
        E811 as `data_age.nominal`, if the Jacobians are not given.
    """
    timings = {timing.name: timing.value for timing in system.timings}
    subsystems = linear_subsystems(system, timings, ORDER) if subsystems is None else subsystems
    return _scheduled(system, subsystems, timings, ORDER)


def instance(system: Model, prepared: Prepared | None = None) -> Instance:
    """Return the instance of a model at its present parameter values.

    Parameters
    ----------
    system
        The compiled model, with the values to analyse (see `overrides.apply`).
    prepared
        From `prepare`, of this model with any values; avoids building the Jacobians again.

    Raises
    ------
    ApcError
        As `prepared_at`.
    """
    numbers = resolve(system)
    prepared = prepared_at(system, prepared or prepare(system), numbers.timings)
    exchange = build_exchange(system, numbers.timings)
    return Instance(system, prepared.jacobians, prepared.schedules, numbers, exchange)


def prepared_at(system: Model, prepared: Prepared, timings: Mapping[str, Fraction]) -> Prepared:
    """Return the shared data for other timings, with their schedules and ages.

    Raises
    ------
    ApcError
        E845 the values received with these timings affect the linearization of a peer type at its start.
    """
    if timings == prepared.timings:
        return prepared
    subsystems = at_timings(system, prepared.jacobians, timings, prepared.order)
    if prepared.starting and subsystems is not prepared.jacobians:
        result = _where_it_starts(system, subsystems)
        if result is None:
            raise delay_search_refused(system)
        subsystems = result
    return replace(_scheduled(system, subsystems, timings, prepared.order), starting=prepared.starting)


def linearized_at_start(
    system: Model, prepared: Prepared, varied: Sequence[ParameterRef] = ()
) -> Prepared | None:
    """Return the shared data with every peer type linearized at its start, as a function of its parameters.

    None where values received at the start matter as well (see `linearize.at_start`), unless every peer sends
    0 there, for any values of the `varied` parameters.

    Parameters
    ----------
    system
        The compiled model.
    prepared
        From `prepare`, of this model.
    varied
        The parameters that will have other values.
    """
    result = _where_it_starts(system, prepared.jacobians, varied)
    return None if result is None else replace(prepared, jacobians=result, starting=True)


def _where_it_starts(
    system: Model, subsystems: tuple[SubsystemJacobians, ...], varied: Sequence[ParameterRef] = ()
) -> tuple[SubsystemJacobians, ...] | None:
    """Return the Jacobians of each peer type at its start, None if one depends on received values."""
    used = {group.peer_type for group in system.groups}
    silent = False
    if any(at_start(subsystems[peer_type]) is None for peer_type in used):
        silent = not any(reaches_start(system, free) for free in varied) and all(
            sends_nothing(system.peer_types[group.peer_type], rows)
            for group, rows in zip(system.groups, resolve(system).parameters, strict=True)
        )
    at = [
        at_start(subsystem, silent=silent) if peer_type in used else subsystem
        for peer_type, subsystem in enumerate(subsystems)
    ]
    result = tuple(subsystem for subsystem in at if subsystem is not None)
    return result if len(result) == len(subsystems) else None


def delay_search_refused(system: Model) -> ApcError:
    """Return the error for a delay of a model whose start depends on received values."""
    message = "how the topology moves hangs on what is heard at the start: a delay can't be searched"
    hint = "apc critical of a stiffness or damping"
    return ApcError(Diagnostic("E845", SourceLocation(system.origin.topology), message, hint=hint))


def _scheduled(
    system: Model,
    built: tuple[SubsystemJacobians, ...],
    timings: Mapping[str, Fraction],
    order: tuple[str, ...],
) -> Prepared:
    """Return the Jacobians with the schedules of these timings."""
    schedules = build_schedules(system, timings, [subsystem.pattern for subsystem in built], order=order)
    return Prepared(built, schedules, timings, order)
