"""Is it stable, and by how much: the whole road from a compiled system to its spectrum.

Takes: a `CompiledSystem`.
Gives: `Analysis`, `analyze`, `METHODS`; `Prepared`, `prepare` for many analyses of one system.
Guarantees: the cost grows with the number of different peers, not of peers, and not with the length of a
delay; of equal input comes equal output.
Does not: read files, or draw.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.crowds import crowds
from apc.runtime.determinant_spectrum import solve_crowds, solve_loops
from apc.runtime.discretize import TOO_LARGE
from apc.runtime.exchange import Exchange, build_exchange
from apc.runtime.krylov import solve_sparse
from apc.runtime.large_graph import large_graph, with_the_rest
from apc.runtime.linearize import SiteJacobians, jacobians
from apc.runtime.modes import Arrangement, Loop, arrange, close_loop, dense_loop
from apc.runtime.packets import nominal_notes
from apc.runtime.parameters import Numbers, resolve
from apc.runtime.peers import (
    MOST_STATES,
    PeerGroup,
    more_differ,
    peer_groups,
    states_of,
    too_large,
    used_ways,
)
from apc.runtime.schedule import ORDER, Schedule, build_schedules
from apc.runtime.spectrum import Mode, Spectrum, solve_spectrum
from apc.runtime.threads import single_threaded
from apc.runtime.translation import common_translation, count_translations
from apc.runtime.trouble import finite_equations

METHODS = ("auto", "modes", "dense", "determinant", "krylov")

# Up to so many states of motion of peers that differ, one matrix of all is quicker than what spares it, and
# says more.
FEW_STATES = 200

# Up to so many peers a complete graph is written out as arcs.
MOST_FULL = 500

# Equal peers on a graph without a closed form: of so many, its eigenvalues are not computed.
MANY_PEERS = 1500

# From so many packets on their way on, leaving them out of the state is quicker.
LONG_LINES = 120


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

    `states_per_peer` is that of the largest kind of peer in the scene. `method` is one of `METHODS`.
    `linearized` says that some site is not affine: the answer then holds near its start values only. `notes`
    say why it was analysed as it was; `proof` says what ball arithmetic proved, "" where floats decided.
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
    proof: str = ""

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
            "proof": self.proof,
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


def analyze(
    system: CompiledSystem,
    *,
    method: str = "auto",
    prepared: Prepared | None = None,
    certify: bool = False,
) -> Analysis:
    """Analyse a system by the method that serves it, or by one that is asked for.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse (see `parameters.apply`).
    method
        One of `METHODS`. "modes": a few small systems, where equal peers and the graph allow that; "dense":
        all peers as one matrix, the check on all else, at the cost of N³; "determinant": the zeros of a small
        characteristic function, for peers that all differ on complete graphs and for delays of any length;
        "krylov": the largest eigenvalues of one sparse matrix, for peers that differ on sparse graphs.
    prepared
        From `prepare`, of this system with any numbers; saves building the Jacobians again.
    certify
        Prove the verdict in ball arithmetic, whether or not floats leave it open.

    Raises
    ------
    ApcError
        E804 a system of too many states for its matrix, E806 numbers beyond floats, E850 a method that can't
        serve this scene; and those of `peers.peer_groups`.
    """
    assert method in METHODS, f"no such method: {method}"
    with single_threaded(), finite_equations(system.name), np.errstate(all="ignore"):
        numbers = resolve(system)
        prepared = _timed(system, prepared or prepare(system), numbers)
        exchange = build_exchange(system, numbers.timings)
        if method in ("auto", "determinant", "krylov"):
            reason = _not_crowds(system, prepared)
            if method == "krylov" and reason:
                raise _cannot(system, method, reason)
            if not reason and (method == "krylov" or _many(system, prepared, numbers, exchange)):
                return _analyze_crowds(system, prepared, numbers, exchange, method)
        groups = peer_groups(system, prepared.jacobians, prepared.schedules, numbers, exchange)
        large = large_graph(groups, exchange) if method in ("auto", "modes") else None
        found = large.arrangement if large else _arranged(system, groups, exchange, method)
        if found.method == "determinant":
            spectrum = solve_loops(found.loops)
        else:
            closed = tuple(close_loop(loop) for loop in _small_enough(found.loops, exchange))
            if not all(np.isfinite(one.matrix).all() and np.isfinite(one.error).all() for one in closed):
                raise ApcError(Mistake("E806", Place(system.name), TOO_LARGE))
            spectrum = solve_spectrum(closed, certify=certify)
        if large:
            spectrum = with_the_rest(spectrum, large)
        states = max(states_of(group.schedule, group.jacobians) for group in groups)
        affine = all(group.site.affine for group in groups)
        return _answer(system, exchange, prepared, found.method, spectrum, states, affine, found.notes)


def _answer(
    system: CompiledSystem,
    exchange: Exchange,
    prepared: Prepared,
    method: str,
    spectrum: Spectrum,
    states: int,
    affine: bool,
    notes: tuple[str, ...],
) -> Analysis:
    """Put an analysis together."""
    return Analysis(
        topology=system.name,
        peers=exchange.peers,
        frame_s=float(prepared.schedules[0].frame_s),
        states_per_peer=states,
        method=method,
        verdict=spectrum.verdict,
        stable=spectrum.stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        rigid_modes=spectrum.rigid_modes,
        modes=spectrum.modes,
        linearized=not affine,
        notes=(*notes, *spectrum.notes, *nominal_notes(system)),
        proof=spectrum.proof,
    )


def _cannot(system: CompiledSystem, method: str, reason: str) -> ApcError:
    """Return the refusal of a method that can't serve a scene."""
    what = f"method {method} can't serve this scene: {reason}"
    return ApcError(Mistake("E850", Place(system.origin.topology), what, hint="--method auto"))


def _not_crowds(system: CompiledSystem, prepared: Prepared) -> str:
    """Say why peers can't be taken by the thousand, "" if they can."""
    for kind, site in zip(system.kinds, prepared.jacobians, strict=True):
        if site.edges:
            return f"{kind.name} looks at each sender by itself"
        if not site.affine:
            return f"{kind.name} is not linear, so that each peer is linearized where it starts"
    return ""


def _many(system: CompiledSystem, prepared: Prepared, numbers: Numbers, exchange: Exchange) -> bool:
    """Say whether so many peers differ that they are not worth an object each."""
    closed_form = all(
        exchange.links[way.link].graph.shape in ("complete", "ring", "star")
        for way in used_ways(prepared.schedules)
    )
    if not closed_form and exchange.peers > MANY_PEERS:
        return True
    states = sum(
        len(rows) * len(system.kinds[group.kind].states)
        for rows, group in zip(numbers.parameters, system.groups, strict=True)
    )
    if states <= FEW_STATES:
        return False
    most = max(len(kind.states) for kind in system.kinds)
    return more_differ(system, prepared.jacobians, numbers, exchange, FEW_STATES // most)


def _arranged(
    system: CompiledSystem, groups: Sequence[PeerGroup], exchange: Exchange, method: str
) -> Arrangement:
    """Split the whole into loops, and say by which method they are solved."""
    if method == "dense":
        if exchange.peers * min(len(group.jacobians.kind.states) for group in groups) > MOST_STATES:
            states = sum(group.count * states_of(group.schedule, group.jacobians) for group in groups)
            raise too_large(exchange, f"{exchange.peers:,} peers", states)
        return Arrangement("dense", (dense_loop(groups, exchange),), ())
    found = arrange(groups, exchange)
    if method == "modes" and found.method != "modes":
        raise _cannot(system, method, found.notes[0])
    packets = max(sum(sum(group.schedule.depths) for group in loop.sites) for loop in found.loops)
    if method == "determinant":
        return replace(found, method="determinant")
    if method == "auto" and packets > LONG_LINES:
        note = f"{packets:,} packets are on their way at a time, none of which is made a state"
        return replace(found, method="determinant", notes=(*found.notes, note))
    return found


def _small_enough(loops: Sequence[Loop], exchange: Exchange) -> Sequence[Loop]:
    """Refuse loops whose matrix would be too large."""
    for loop in loops:
        if loop.states > MOST_STATES:
            raise too_large(exchange, f"{exchange.peers:,} peers", loop.states)
    return loops


def _analyze_crowds(
    system: CompiledSystem, prepared: Prepared, numbers: Numbers, exchange: Exchange, method: str
) -> Analysis:
    """Analyse peers that all differ."""
    graphs = [way.link for way in used_ways(prepared.schedules) if not exchange.is_complete(way.link)]
    if method == "auto":
        method = "krylov" if graphs else "determinant"
    if method == "determinant" and graphs:
        raise _cannot(
            system, method, f"the peers differ, and not all of them hear all others over {graphs[0]}"
        )
    listed = crowds(system, prepared.jacobians, prepared.schedules, numbers)
    different = sum(len(crowd.parameters) for crowd in listed)
    states = max(states_of(crowd.schedule, crowd.jacobians) for crowd in listed)
    if method == "krylov":
        _refuse_full_graphs(system, exchange, prepared)
        motions = common_translation(listed, exchange)
        notes = [f"{different:,} peers of different numbers, as one sparse matrix"]
        if motions is None:
            notes.append("peers move freely one by one, or the first as not all others do: left open")
        spectrum = solve_sparse(listed, exchange, motions)
    else:
        rigid = count_translations(listed, exchange)
        notes = [f"{different:,} peers of different numbers, by one determinant of what is sent in a frame"]
        if rigid is None:
            notes.append("the first peer moves freely in a way that not all others do: left open")
        spectrum = solve_crowds(listed, exchange, rigid=rigid or 0)
    return _answer(system, exchange, prepared, method, spectrum, states, True, tuple(notes))


def _refuse_full_graphs(system: CompiledSystem, exchange: Exchange, prepared: Prepared) -> None:
    """Refuse complete graphs of so many peers that their arcs are no sparse matrix."""
    full = [way.link for way in used_ways(prepared.schedules) if exchange.is_complete(way.link)]
    if full and exchange.peers > MOST_FULL:
        reason = f"all of {exchange.peers:,} peers hear each other over {full[0]}: nothing is sparse"
        raise _cannot(system, "krylov", reason)


def lifted_groups(
    system: CompiledSystem, *, prepared: Prepared | None = None
) -> tuple[tuple[PeerGroup, ...], Exchange]:
    """Return the peers of a system in groups of equal dynamics, lifted, and the exchange between them."""
    numbers = resolve(system)
    prepared = _timed(system, prepared or prepare(system), numbers)
    exchange = build_exchange(system, numbers.timings)
    groups = peer_groups(system, prepared.jacobians, prepared.schedules, numbers, exchange)
    return groups, exchange


def _timed(system: CompiledSystem, prepared: Prepared, numbers: Numbers) -> Prepared:
    """Return what was prepared, with the schedules of these timings."""
    if numbers.timings == prepared.timings:
        return prepared
    return _scheduled(system, prepared.jacobians, numbers.timings, prepared.order)


def _scheduled(
    system: CompiledSystem,
    built: tuple[SiteJacobians, ...],
    timings: Mapping[str, Fraction],
    order: tuple[str, ...],
) -> Prepared:
    """Add the schedules of these timings to the Jacobians."""
    schedules = build_schedules(system, timings, [site.pattern for site in built], order=order)
    return Prepared(built, schedules, timings, order)
