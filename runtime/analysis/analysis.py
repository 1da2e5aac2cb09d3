"""Stability analysis: from a compiled model to its spectrum and verdict.

Takes: a `Model`.
Gives: `Analysis`, `analyze`; `prepare_at_start` for many analyses of one model; `lifted_groups`;
`near_start`; `analyze_sides`.
Guarantees: the cost grows with the number of different peers, not of all, and not with the length of a delay;
equal input gives equal output.
Does not: read files, or draw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Unpack

import numpy as np

from apc.analysis.method_selection import cannot_serve, make_plan, refuse_varying
from apc.analysis.nonlinear_elements import replaced_elements
from apc.analysis.one_sided_slopes import Side, SideVerdict, sides, worst_side
from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.eigen.equilibrium import equilibrium_residual
from apc.eigen.interconnection import ModalSystem, close_loop
from apc.eigen.modes import decompose
from apc.eigen.peer_classes import (
    MOST_STATES,
    PeerClass,
    peer_groups,
    representatives,
    states_of,
    used_coupling_terms,
)
from apc.eigen.rigid_modes import NeutralModes, classify_neutral_modes
from apc.eigen.spectrum import Mode, Spectrum, solve_spectrum, up_to
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.data_age import linear_subsystems
from apc.frame.discretize import TOO_LARGE
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Instance, Prepared, instance, linearized_at_start, prepare
from apc.frame.parameter_names import ParameterRef
from apc.network.nominal_criterion import limitations, unreliable
from apc.result import PlotStyle, Result
from apc.threads import single_threaded
from apc.verdict import (
    NO_PROOF,
    Limitation,
    LimitationCode,
    Note,
    ProofOutcome,
    ProofScope,
    StabilityProof,
    StabilityVerdict,
)

NOT_LINEAR = (
    "left out: the topology is not linear, and this holds near its start values only: of contacts and limits "
    "those that act there"
)

SETTLED = 0.02  # of the start: a motion counts as settled


@dataclass(frozen=True, slots=True)
class Analysis(Result):
    """The result of an analysis; `spectral_radius` is per frame, rigid modes removed.

    `states_per_peer` is that of the largest peer type in the model. `method` is one of `methods.METHODS`.
    `linearized` states that some subsystem is not affine: the result then holds near its start values only.
    `notes` are the reasons for the method; `proof` is the result of ball arithmetic, "" where floats decided;
    `limitations` are the limitations. Of the rigid modes `translations` and `rotations` move something; the
    others are those of the unobservable memories that `unobservable` names. `radius_excess` bounds the excess
    of the radius over 1 from below and above, where that was proved: possibly closer to 1 than two floats.
    `sides` are the verdicts of all sides of the kinks at which peers start, empty without kinks; the analysis
    is that of the worst side.
    """

    shown_by = "analysis_output:analysis"

    topology: str
    peers: int
    frame_s: float
    states_per_peer: int
    method: str
    verdict: StabilityVerdict
    stable: bool | None
    spectral_radius: float
    spectral_radius_error: float
    rigid_modes: int
    modes: Sequence[Mode]
    linearized: bool
    notes: tuple[Note, ...]
    proof: StabilityProof = NO_PROOF
    limitations: tuple[str, ...] = ()
    translations: int = 0
    rotations: int = 0
    unobservable: tuple[str, ...] = ()
    radius_excess: tuple[float, float] | None = None
    sides: tuple[SideVerdict, ...] = ()

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Draw the eigenvalues over the unit circle into matplotlib Axes, or a figure's, in style `look`."""
        return self._plotted(ax, style=style)

    @property
    def settling_s(self) -> float | None:
        """Settling time of the slowest mode to `SETTLED`, in seconds; None if it does not decay.

        frame · ln(`SETTLED`)/ln(spectral radius): independent of the length of the frame.
        """
        if self.stable is not True or self.spectral_radius >= 1:
            return None
        return (
            self.frame_s * math.log(SETTLED) / math.log(self.spectral_radius) if self.spectral_radius else 0.0
        )


def prepare_at_start(
    system: Model, prepared: Prepared, varied: Sequence[ParameterRef] = ()
) -> Prepared | None:
    """Return the prepared data with every peer type linearized at its start, over its parameters.

    None where that is impossible: see `numeric_model.linearized_at_start`; and where peers start at a kink:
    each point is then analyzed on all sides.

    Parameters
    ----------
    system
        The compiled model.
    prepared
        From `prepare`, of this model.
    varied
        The parameters that will have other values.

    Raises
    ------
    ApcError
        As `method_selection.refuse_varying` and `one_sided_slopes.sides`.
    """
    refuse_varying(system, prepared.jacobians)
    if sides(system, prepared)[0].system is not system:
        return None
    return linearized_at_start(system, prepared, varied)


def near_start(system: Model, prepared: Prepared | None = None) -> tuple[str, ...]:
    """Return the limitations of a linearized result, empty for a linear model.

    Parameters
    ----------
    system
        The compiled model.
    prepared
        From `prepare`, of this model with any parameter values.
    """
    subsystems = prepared.jacobians if prepared else linear_subsystems(system)
    elements = replaced_elements(system)
    if all(subsystems[group.peer_type].affine for group in system.groups):
        return elements
    try:
        listed = sides(system, prepared or prepare(system))
        groups, _ = lifted_groups(listed[0].system, prepared=listed[0].prepared)
    except ApcError:  # no result with these values
        return (*elements, NOT_LINEAR)
    return (*_of_sides([side.name for side in listed]), *elements, *_near_start(groups))


def _of_sides(names: Sequence[str]) -> tuple[str, ...]:
    """Return the limitation of a result at a kink."""
    if len(names) < 2:
        return ()
    shown = " or ".join(names) if len(names) == 2 else f"{len(names)} combinations of sides"
    return (f"the start is at a kink ({shown}): the worst side decides",)


def _near_start(groups: Sequence[PeerClass]) -> tuple[str, ...]:
    moves = equilibrium_residual(groups)
    return (*([f"{moves}; what happens is played: apc simulate"] if moves else []), NOT_LINEAR)


@part("analysis")
def analyze(
    system: Model,
    *,
    method: str = "auto",
    prepared: Prepared | None = None,
    certify: bool = False,
) -> Analysis:
    """Analyze a model by the method that suits it, or by the requested one.

    Where peers start at a kink every side is analyzed, and the result is that of the worst one.

    Parameters
    ----------
    system
        The compiled model, with the parameter values to analyse (see `overrides.apply`).
    method
        One of `methods.METHODS`. "modes": a few small systems, where equal peers and the graph allow that;
        "dense": all peers as one matrix, the reference, at the cost of N³; "determinant": the zeros of a
        small characteristic function, for different peers on complete graphs and for delays of any length.
    prepared
        From `prepare`, of this model with any parameter values; avoids building the Jacobians again.
    certify
        Prove the verdict in ball arithmetic, also where floats decide it.

    Raises
    ------
    ApcError
        E804 a system of too many states for its matrix, E806 an overflow, E850 a method that is not
        applicable; and those of `one_sided_slopes.sides`, `method_selection.refuse_varying` and
        `peer_classes.peer_groups`.
    """
    return analyze_sides(system, method=method, prepared=prepared, certify=certify)[0]


def analyze_sides(
    system: Model, *, method: str, prepared: Prepared | None, certify: bool
) -> tuple[Analysis, Side]:
    """Return the analysis of the worst side, and that side.

    Parameters
    ----------
    system, method, prepared, certify
        As for `analyze`.
    """
    listed = sides(system, prepared or prepare(system))
    each = [_analyze(side.system, method=method, prepared=side.prepared, certify=certify) for side in listed]
    verdicts = tuple(
        SideVerdict(side.name, item.verdict, item.stable, item.spectral_radius, item.spectral_radius_error)
        for side, item in zip(listed, each, strict=True)
    )
    worst = worst_side(verdicts)
    if len(listed) == 1:
        return each[0], listed[0]
    limitations = (*_of_sides([side.name for side in listed]), *each[worst].limitations)
    return replace(each[worst], sides=verdicts, limitations=limitations), listed[worst]


def _analyze(system: Model, *, method: str, prepared: Prepared, certify: bool) -> Analysis:
    """Return the analysis of a model without kinks."""
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        topology = instance(system, prepared)
        plan = make_plan(topology, method)
        notes: tuple[Note, ...]
        if not plan.groups:
            spectrum, notes = _solve_populations(topology)
        elif plan.method == "determinant":
            spectrum, notes = _solve_determinant(plan.loops), ()
            small = all(loop.states <= MOST_STATES for loop in plan.loops)
            if (
                method == "auto" and spectrum.stable is None and small
            ):  # matrices bound an undecided determinant
                decomposed = decompose(plan.groups, topology.exchange)
                plan = replace(plan, method=decomposed.method, notes=decomposed.notes)
                spectrum = _solve_closed(system, plan.loops, certify=certify)
        else:
            spectrum, notes = _solve_closed(system, plan.loops, certify=certify), ()
        if method == "determinant" and not np.isfinite(spectrum.spectral_radius_error):
            raise cannot_serve(system, method, "what a frame's ticks round hides the peers' own eigenvalues")
        if certify and (not plan.groups or plan.method == "determinant"):
            notes = (*notes, Limitation(LimitationCode.NO_BALLS, (plan.method,)))
        nonlinear = not topology.affine
        elements = replaced_elements(system)
        linearized = nonlinear or bool(elements)
        population = () if plan.loops else representatives(topology)
        neutral_modes = _neutral_modes(spectrum, plan.loops, population)
        verdict, stable = spectrum.verdict, spectrum.stable
        if verdict in (StabilityVerdict.STABLE_TRANSLATING, StabilityVerdict.DRIFTS):
            verdict = (
                StabilityVerdict.DRIFTS
                if neutral_modes.drifts
                else up_to(neutral_modes.translations, neutral_modes.rotations)
            )
            stable = verdict.stable
        proof = spectrum.proof
        if proof.outcome is ProofOutcome.DRIFTS and verdict is not StabilityVerdict.DRIFTS:
            proof = replace(proof, outcome=ProofOutcome.STABLE)  # what drifts is a memory that nothing reads
        of = ((ProofScope.LINEARIZATION, linearized), (ProofScope.NOMINAL_NETWORK, bool(unreliable(system))))
        if proof:
            proof = replace(proof, scope=tuple(scope for scope, is_so in of if is_so))
    return Analysis(
        topology=system.name,
        peers=topology.exchange.peers,
        frame_s=float(topology.schedules[0].frame_s),
        states_per_peer=max(map(states_of, topology.schedules, topology.subsystems)),
        method=plan.method,
        verdict=verdict,
        stable=stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        rigid_modes=spectrum.rigid_modes,
        modes=spectrum.modes,
        linearized=linearized,
        notes=(*plan.notes, *notes, *spectrum.notes),
        proof=proof,
        limitations=(*elements, *(_near_start(plan.groups) if nonlinear else ()), *limitations(system)),
        unobservable=neutral_modes.names,
        translations=neutral_modes.translations,
        rotations=neutral_modes.rotations,
        radius_excess=spectrum.radius_excess,
    )


def _neutral_modes(
    spectrum: Spectrum, loops: Sequence[ModalSystem], population: Sequence[PeerClass]
) -> NeutralModes:
    """Return the neutral modes.

    For a large population without loops, unobservable modes are those of single peers, and every other mode
    counts as a translation.
    """
    if not spectrum.rigid_modes or not any(
        map(_remembers, (*population, *(g for loop in loops for g in loop.subsystems)))
    ):
        return NeutralModes(spectrum.rigid_modes, 0, spectrum.drifts, 0, ())
    listed: Sequence[tuple[ModalSystem, int]] = [(loop, loop.multiplicity) for loop in loops]
    for group in population:
        anyhow = {
            coupling_term: ((Fraction(-1, 3),),) for coupling_term in used_coupling_terms([group.schedule])
        }
        listed = [*listed, (ModalSystem(group.name, 1, (group,), anyhow), group.count)]
    with_drifts = bool(spectrum.drifts and loops)
    pairs = [(classify_neutral_modes(loop, with_drifts=with_drifts), many) for loop, many in listed]
    names = tuple(dict.fromkeys(name for neutral, _ in pairs for name in neutral.names))
    unobservable = sum(neutral.unobservable * many for neutral, many in pairs)
    if not loops:
        return NeutralModes(spectrum.rigid_modes - unobservable, 0, spectrum.drifts, unobservable, names)
    return NeutralModes(
        translations=sum(neutral.translations * many for neutral, many in pairs),
        rotations=sum(neutral.rotations * many for neutral, many in pairs),
        drifts=sum(neutral.drifts * many for neutral, many in pairs),
        unobservable=unobservable,
        names=names,
    )


def _remembers(group: PeerClass) -> bool:
    """Return whether peers have states other than lengths and their rates."""
    peer_type = group.jacobians.peer_type
    return any(clock.memories for clock in peer_type.clocks) or any(
        state.unit.partition("/")[0] != LENGTH for state in peer_type.states
    )


def _solve_closed(system: Model, loops: Sequence[ModalSystem], *, certify: bool) -> Spectrum:
    """Return the spectrum of loops from their matrices."""
    closed = tuple(close_loop(loop) for loop in loops)
    if not all(
        np.isfinite(closed_system.matrix).all() and np.isfinite(closed_system.error).all()
        for closed_system in closed
    ):
        raise ApcError(Diagnostic("E806", SourceLocation(system.origin.topology), TOO_LARGE))
    return solve_spectrum(closed, certify=certify)


def _solve_determinant(loops: Sequence[ModalSystem]) -> Spectrum:
    """Return the spectrum of loops from the zeros of their characteristic functions."""
    # Modules for large models are imported when needed: importing them costs 30 ms.
    from apc.large_scale.determinant_spectrum import solve_loops

    return solve_loops(loops)


def _solve_populations(topology: Instance) -> tuple[Spectrum, tuple[Note, ...]]:
    """Return the spectrum of peers that all differ."""
    from apc.large_scale.determinant_spectrum import solve_populations
    from apc.large_scale.heterogeneous_peers import populations
    from apc.large_scale.translation import count_translations

    peers = populations(topology)
    rigid = count_translations(topology, peers)
    spectrum = solve_populations(peers, topology.exchange, rigid=rigid or 0)
    free = "the first peer moves freely in a way that not all others do: left open"
    return spectrum, () if rigid is not None else (free,)


def lifted_groups(
    system: Model, *, prepared: Prepared | None = None
) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
    """Return the peers of a model in groups of equal dynamics, lifted, and the links between them.

    Raises
    ------
    ApcError
        As `method_selection.refuse_varying` and `peer_classes.peer_groups`.
    """
    topology = instance(system, prepared)
    refuse_varying(system, topology.jacobians)
    return peer_groups(topology), topology.exchange
