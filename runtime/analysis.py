"""Is it stable, and by how much: the whole road from a compiled system to its spectrum.

Takes: a `CompiledSystem`.
Gives: `Analysis`, `analyze_modes`, `analyze_dense`; `Prepared`, `prepare` for many analyses of one system.
Guarantees: the cost of `analyze_modes` grows with the number of different groups, not of peers; of equal
input comes equal output.
Does not: read files, or draw.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.discretize import TOO_LARGE
from apc.runtime.exchange import Exchange, build_exchange
from apc.runtime.linearize import SiteJacobians, jacobians
from apc.runtime.modes import Split, dense, split
from apc.runtime.parameters import resolve
from apc.runtime.peers import PeerGroup, peer_groups, states_of
from apc.runtime.schedule import ORDER, Schedule, build_schedules
from apc.runtime.spectrum import Mode, solve_spectrum
from apc.runtime.threads import single_threaded
from apc.runtime.trouble import finite_equations


@dataclass(frozen=True, slots=True)
class Prepared:
    """What analyses of one system with different numbers have in common.

    The Jacobians (one a kind) hold for any numbers; the schedules (one a group) for these timings and this
    order of coincident events.
    """

    jacobians: tuple[SiteJacobians, ...]
    schedules: tuple[Schedule, ...]
    timings: Mapping[str, Fraction]
    order: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Analysis:
    """The answer of an analysis; `spectral_radius` is per frame, rigid modes removed.

    `states_per_peer` is that of the largest kind of peer in the scene. `method` is "modes" or "dense".
    `linearized` says that some site is not affine: the answer then holds near its start values only. `notes`
    say why it was analysed as it was.
    """

    topology: str
    peers: int
    frame_s: float
    states_per_peer: int
    method: str
    verdict: str
    stable: bool | None
    spectral_radius: float
    spectral_radius_error: float
    rigid_modes: int
    modes: tuple[Mode, ...]
    linearized: bool
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """Return the verdict in words, the numbers, and the modes as a table."""
        from apc.runtime.report import analysis_report  # it needs this module

        return analysis_report(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the analysis as plain data, ready for JSON."""
        return {
            "topology": self.topology,
            "peers": self.peers,
            "frame_s": self.frame_s,
            "states_per_peer": self.states_per_peer,
            "method": self.method,
            "verdict": self.verdict,
            "stable": self.stable,
            "spectral_radius": self.spectral_radius,
            "spectral_radius_error": self.spectral_radius_error,
            "rigid_modes": self.rigid_modes,
            "modes": [
                {
                    "eigenvalue": [mode.eigenvalue.real, mode.eigenvalue.imag],
                    "magnitude": mode.magnitude,
                    "multiplicity": mode.multiplicity,
                    "frequency_hz": mode.frequency_hz,
                    "damping_ratio": mode.damping_ratio,
                    "shape": mode.shape,
                    "participation": dict(mode.participation),
                    "error": mode.error,
                }
                for mode in self.modes
            ],
            "linearized": self.linearized,
            "notes": list(self.notes),
        }


def prepare(system: CompiledSystem, *, order: Sequence[str] = ORDER) -> Prepared:
    """Do what analyses with different numbers can share.

    Parameters
    ----------
    system
        The compiled scene.
    order
        The order of coincident events, see `schedule.ORDER`.
    """
    built = tuple(jacobians(kind) for kind in system.kinds)
    return _scheduled(system, built, resolve(system).timings, tuple(order))


def analyze_modes(system: CompiledSystem, *, prepared: Prepared | None = None) -> Analysis:
    """Analyse a system as few small ones where its graphs and groups allow, or else as a whole.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse (see `parameters.apply`).
    prepared
        From `prepare`, of this system with any numbers; saves building the Jacobians again.
    """
    return _analyze(system, prepared, split)


def analyze_dense(system: CompiledSystem, *, prepared: Prepared | None = None) -> Analysis:
    """Analyse a system as one matrix over all peers: the check on `analyze_modes`, at the cost of N³."""
    return _analyze(system, prepared, lambda groups, exchange: Split("dense", (dense(groups, exchange),), ()))


def lifted_groups(
    system: CompiledSystem, *, prepared: Prepared | None = None
) -> tuple[tuple[PeerGroup, ...], Exchange]:
    """Return the peers of a system in groups of equal dynamics, lifted, and the exchange between them."""
    numbers = resolve(system)
    prepared = prepared or prepare(system)
    if numbers.timings != prepared.timings:
        prepared = _scheduled(system, prepared.jacobians, numbers.timings, prepared.order)
    exchange = build_exchange(system, numbers.timings)
    groups = peer_groups(system, prepared.jacobians, prepared.schedules, numbers, exchange)
    return groups, exchange


def _scheduled(
    system: CompiledSystem,
    built: tuple[SiteJacobians, ...],
    timings: Mapping[str, Fraction],
    order: tuple[str, ...],
) -> Prepared:
    """Add the schedules of these timings to the Jacobians."""
    schedules = build_schedules(system, timings, [site.pattern for site in built], order=order)
    return Prepared(built, schedules, timings, order)


def _analyze(
    system: CompiledSystem,
    prepared: Prepared | None,
    method: Callable[[Sequence[PeerGroup], Exchange], Split],
) -> Analysis:
    """Analyse a system, split into closed systems by a method."""
    with single_threaded(), finite_equations(system.name), np.errstate(all="ignore"):
        groups, exchange = lifted_groups(system, prepared=prepared)
        found = method(groups, exchange)
        if not all(np.isfinite(one.matrix).all() and np.isfinite(one.error).all() for one in found.systems):
            raise ApcError(Mistake("E806", Place(system.name), TOO_LARGE))
        spectrum = solve_spectrum(found.systems)
    return Analysis(
        topology=system.name,
        peers=system.peers,
        frame_s=found.systems[0].frame_s,
        states_per_peer=max(states_of(group.schedule, group.jacobians) for group in groups),
        method=found.method,
        verdict=spectrum.verdict,
        stable=spectrum.stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        rigid_modes=spectrum.rigid_modes,
        modes=spectrum.modes,
        linearized=not all(group.site.affine for group in groups),
        notes=found.notes,
    )
