"""The numbers of a model at its parameter values, resolved for each peer.

Takes: a `Model` and the Jacobians of its peer types.
Gives: `ModelNumbers`, `PeerIndices`; `cached_in_model`.
Guarantees: data that does not depend on parameter values is built once.
Does not: change parameter values (see `numeric_model`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, count_of
from apc.compiler.peer_counts import received_sums
from apc.linearization.jacobians import SubsystemJacobians
from apc.parameter_values.parameters import ResolvedNumbers, rationals, resolve
from apc.timing.communication_graph import CommunicationGraph, build_comm_graph
from apc.timing.schedule import ORDER, Schedule
from apc.timing.scheduling import build_schedules

Floats = NDArray[np.float64]
Arguments = ParamSpec("Arguments")
AnyModel = TypeVar("AnyModel", bound="ModelNumbers")
Returned = TypeVar("Returned")


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
class ModelNumbers:
    """A model at its parameter values, with the Jacobians of each peer type: the data of a `NumericModel`.

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
    def results(self) -> dict[Hashable, Any]:
        """The results of functions decorated by `cached_in_model`."""
        return {}

    @cached_property
    def numbers(self) -> ResolvedNumbers:
        """The resolved parameters of all peers."""
        return resolve(self.model)

    @cached_property
    def comm_graph(self) -> CommunicationGraph:
        """The communication graph."""
        return build_comm_graph(self.model, self.timings)

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
        group = self.comm_graph.group_of(peer)
        row = self.numbers.rows[group][peer - self.comm_graph.starts[group]]
        return np.asarray(self.numbers.parameters[group][row])

    @cached_property
    def weight_sums(self) -> dict[str, NDArray[Any]]:
        """The exact sum of the weights that each peer receives (N,), by the parameter of a link with arcs."""
        links = (link for link in self.model.links if link.graph.shape == "arcs")
        return {count_of(link.name): received_sums(link, self.comm_graph.peers) for link in links}

    def exact_vector(self, peer: int) -> list[Fraction]:
        """Return the parameters (n_p,) of a peer exactly: its floats, and its sums of weights."""
        group = self.model.groups[self.comm_graph.group_of(peer)]
        names = self.model.peer_types[group.peer_type].parameters
        return [
            self.weight_sums[name][peer] if name in self.weight_sums else number
            for name, number in zip(names, rationals(self.vector(peer)), strict=True)
        ]


def cached_in_model(
    function: Callable[Concatenate[AnyModel, Arguments], Returned],
) -> Callable[Concatenate[AnyModel, Arguments], Returned]:
    """Return a function of a model that stores its results in the model, as long as the model exists.

    A model with other parameter values is another object, with its own results.
    """

    @wraps(function)
    def cached(numeric: AnyModel, /, *arguments: Arguments.args, **options: Arguments.kwargs) -> Returned:
        """Return the stored result, computed at the first call."""
        key = function, arguments, tuple(options.items())
        if key not in numeric.results:
            numeric.results[key] = function(numeric, *arguments, **options)
        result: Returned = numeric.results[key]
        return result

    return cached
