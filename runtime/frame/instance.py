"""A scene with numbers put in: what analyses of it share, and what one of them starts from.

Takes: a `Model`.
Gives: `Prepared`, `prepare`, `prepared_at`, `starting`, `hangs_on_heard`; `Instance`, `instance`;
`PeerIndices`.
Guarantees: what does not follow from the numbers is built once for all of them.
Does not: put peers together, or analyse (see `peers`).
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
from apc.frame.ages import at_timings, linear_sites
from apc.frame.exchange import CommunicationGraph, build_exchange
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.linearize import at_start, reaches_start, sends_nothing
from apc.frame.names import ParameterRef
from apc.frame.parameters import ResolvedNumbers, resolve
from apc.frame.schedule import ORDER, Schedule
from apc.frame.scheduling import build_schedules

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Prepared:
    """What analyses of one system with different numbers have in common.

    The Jacobians (one a kind) hold for any numbers; the schedules (one a group) for these timings and this
    order of coincident events. With `starting` the Jacobians are those where each kind starts (see
    `starting`).
    """

    jacobians: tuple[SubsystemJacobians, ...]
    schedules: tuple[Schedule, ...]
    timings: Mapping[str, Fraction]
    order: tuple[str, ...]
    starting: bool = False


@dataclass(frozen=True, slots=True)
class PeerIndices:
    """Peers of a scene by number, in rising runs, each of a group: a billion equal peers take no memory."""

    runs: tuple[range, ...]

    def __len__(self) -> int:
        return sum(map(len, self.runs))

    def __iter__(self) -> Iterator[int]:
        return itertools.chain.from_iterable(self.runs)

    def __contains__(self, peer: object) -> bool:
        return any(peer in run for run in self.runs)

    @property
    def first(self) -> int:
        """The first of them."""
        return self.runs[0].start

    @property
    def last(self) -> int:
        """The last of them."""
        return self.runs[-1][-1]

    @property
    def others(self) -> PeerIndices:
        """All but the first of them."""
        return PeerIndices(tuple(run for run in (self.runs[0][1:], *self.runs[1:]) if run))


@dataclass(frozen=True, slots=True)
class Instance:
    """A system at its numbers: Jacobians (one a kind), schedules (one a group), parameters, and the links."""

    system: Model
    jacobians: tuple[SubsystemJacobians, ...]
    schedules: tuple[Schedule, ...]
    numbers: ResolvedNumbers
    exchange: CommunicationGraph

    @property
    def sites(self) -> tuple[SubsystemJacobians, ...]:
        """The Jacobians of each group's kind."""
        return tuple(self.jacobians[group.kind] for group in self.system.groups)

    def vector(self, peer: int) -> Floats:
        """Return the parameters (n_p,) of a peer of the scene."""
        group = self.exchange.group_of(peer)
        row = self.numbers.rows[group][peer - self.exchange.starts[group]]
        return np.asarray(self.numbers.parameters[group][row])

    @property
    def affine(self) -> bool:
        """Whether every group's equations are."""
        return all(site.affine for site in self.sites)


def prepare(system: Model, sites: tuple[SubsystemJacobians, ...] | None = None) -> Prepared:
    """Do what analyses with different numbers can share.

    Parameters
    ----------
    system
        The compiled scene.
    sites
        The Jacobians of each kind; those of the nominal network if they are left out.

    Raises
    ------
    ApcError
        E811 as `ages.nominal`, without sites.
    """
    timings = {timing.name: timing.value for timing in system.timings}
    sites = linear_sites(system, timings, ORDER) if sites is None else sites
    return _scheduled(system, sites, timings, ORDER)


def instance(system: Model, prepared: Prepared | None = None) -> Instance:
    """Return a system at the numbers that it has.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse (see `overrides.apply`).
    prepared
        From `prepare`, of this system with any numbers; saves building the Jacobians again.

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
    """Return what was prepared for other timings: with their schedules, and with the ages they make.

    Raises
    ------
    ApcError
        E845 where what is heard at these timings decides how a kind moves where it starts.
    """
    if timings == prepared.timings:
        return prepared
    sites = at_timings(system, prepared.jacobians, timings, prepared.order)
    if prepared.starting and sites is not prepared.jacobians:
        result = _where_it_starts(system, sites)
        if result is None:
            raise hangs_on_heard(system)
        sites = result
    return replace(_scheduled(system, sites, timings, prepared.order), starting=prepared.starting)


def starting(system: Model, prepared: Prepared, varied: Sequence[ParameterRef] = ()) -> Prepared | None:
    """Return what was prepared with every kind linearized where it starts, as its parameters say.

    None where what is heard at the start decides as well (see `linearize.at_start`), unless that is 0 from
    every peer, whatever `varied` parameters are.

    Parameters
    ----------
    system
        The compiled scene.
    prepared
        From `prepare`, of this system.
    varied
        The parameters that will have other values.
    """
    result = _where_it_starts(system, prepared.jacobians, varied)
    return None if result is None else replace(prepared, jacobians=result, starting=True)


def _where_it_starts(
    system: Model, sites: tuple[SubsystemJacobians, ...], varied: Sequence[ParameterRef] = ()
) -> tuple[SubsystemJacobians, ...] | None:
    """Return the Jacobians of each kind where it starts, None where one's don't follow from parameters."""
    used = {group.kind for group in system.groups}
    silent = False
    if any(at_start(sites[kind]) is None for kind in used):
        silent = not any(reaches_start(system, free) for free in varied) and all(
            sends_nothing(system.kinds[group.kind], rows)
            for group, rows in zip(system.groups, resolve(system).parameters, strict=True)
        )
    at = [at_start(site, silent=silent) if kind in used else site for kind, site in enumerate(sites)]
    result = tuple(site for site in at if site is not None)
    return result if len(result) == len(sites) else None


def hangs_on_heard(system: Model) -> ApcError:
    """Return the refusal of a delay of a scene whose kinds' parameters don't say how these start."""
    what = "how the scene moves hangs on what is heard at the start: a delay can't be searched"
    hint = "apc critical of a stiffness or damping"
    return ApcError(Diagnostic("E845", SourceLocation(system.origin.topology), what, hint=hint))


def _scheduled(
    system: Model,
    built: tuple[SubsystemJacobians, ...],
    timings: Mapping[str, Fraction],
    order: tuple[str, ...],
) -> Prepared:
    """Add the schedules of these timings to the Jacobians."""
    schedules = build_schedules(system, timings, [site.pattern for site in built], order=order)
    return Prepared(built, schedules, timings, order)
