"""Is it stable, and by how much: the whole road from a compiled system to its spectrum.

Takes: a `Model`.
Gives: `Analysis`, `analyze`; `prepare_at_start` for many analyses of one system; `lifted_groups`;
`near_start`.
Guarantees: the cost grows with the number of different peers, not of peers, and not with the length of a
delay; of equal input comes equal output.
Does not: read files, or draw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Unpack

import numpy as np

from apc.analysis.elements import replaced_elements
from apc.analysis.plan import cannot_serve, make_plan, refuse_varying
from apc.analysis.sides import Side, SideVerdict, sides, worst_side
from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.eigen.closing import ModalSystem, close_loop
from apc.eigen.modes import arrange
from apc.eigen.peers import MOST_STATES, PeerClass, peer_groups, representatives, states_of, used_ways
from apc.eigen.rest import unrest
from apc.eigen.rigid import NeutralModes, what_stands
from apc.eigen.spectrum import Mode, Spectrum, solve_spectrum, up_to
from apc.frame.ages import linear_sites
from apc.frame.discretize import TOO_LARGE
from apc.frame.exchange import CommunicationGraph
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Instance, Prepared, instance, prepare, starting
from apc.frame.names import ParameterRef
from apc.network.nominal import left_out, unreliable
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
    "left out: the scene is not linear, and this holds near its start values only: of contacts and limits "
    "those that act there"
)

SETTLED = 0.02  # of where it began: a motion counts as settled


@dataclass(frozen=True, slots=True)
class Analysis(Result):
    """The answer of an analysis; `spectral_radius` is per frame, rigid modes removed.

    `states_per_peer` is that of the largest kind of peer in the scene. `method` is one of `methods.METHODS`.
    `linearized` says that some site is not affine: the answer then holds near its start values only. `notes`
    say why it was analysed as it was; `proof` is what ball arithmetic proved, false where floats decided;
    `left_out` says what of the scene the answer does not look at. Of the rigid modes
    `translations` and `rotations` move something; the others are of what `unfelt` names, memories that
    nothing reads at these values. `beyond` is how much larger than 1 the radius is, at least and at most,
    where that was proved: closer to 1, maybe, than two floats. `sides` are the verdicts of all sides of the
    kinks at which peers start, none where nothing has a kink; the analysis is that of the worst side.
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
    left_out: tuple[str, ...] = ()
    translations: int = 0
    rotations: int = 0
    unfelt: tuple[str, ...] = ()
    beyond: tuple[float, float] | None = None
    sides: tuple[SideVerdict, ...] = ()

    def plot(self, ax: Any = None, **look: Unpack[PlotStyle]) -> Any:
        """Draw the eigenvalues over the unit circle into a matplotlib Axes, or a figure's, as `look` says."""
        return self._drawn(ax, look=look)

    @property
    def settling_s(self) -> float | None:
        """Seconds after which the slowest motion is down to `SETTLED`; None if it doesn't die out.

        frame · ln(`SETTLED`)/ln(spectral radius): frames of different length can be compared by it.
        """
        if self.stable is not True or self.spectral_radius >= 1:
            return None
        return (
            self.frame_s * math.log(SETTLED) / math.log(self.spectral_radius) if self.spectral_radius else 0.0
        )


def prepare_at_start(
    system: Model, prepared: Prepared, varied: Sequence[ParameterRef] = ()
) -> Prepared | None:
    """Return what was prepared with every kind linearized where it starts, as its parameters say.

    None where that can't be: see `instance.starting`; and where peers start at a kink: each point is then
    analyzed on all sides.

    Parameters
    ----------
    system
        The compiled scene.
    prepared
        From `prepare`, of this system.
    varied
        The parameters that will have other values.

    Raises
    ------
    ApcError
        As `plan.refuse_varying` and `sides.sides`.
    """
    refuse_varying(system, prepared.jacobians)
    if sides(system, prepared)[0].system is not system:
        return None
    return starting(system, prepared, varied)


def near_start(system: Model, prepared: Prepared | None = None) -> tuple[str, ...]:
    """Return what an answer says of a scene that it linearizes: what is not at rest where it starts, and that
    it holds there only; nothing of a linear scene.

    Parameters
    ----------
    system
        The compiled scene.
    prepared
        From `prepare`, of this system with any numbers.
    """
    sites = prepared.jacobians if prepared else linear_sites(system)
    elements = replaced_elements(system)
    if all(sites[group.kind].affine for group in system.groups):
        return elements
    try:
        listed = sides(system, prepared or prepare(system))
        groups, _ = lifted_groups(listed[0].system, prepared=listed[0].prepared)
    except ApcError:  # at these values there is no answer
        return (*elements, NOT_LINEAR)
    return (*_of_sides([side.name for side in listed]), *elements, *_near_start(groups))


def _of_sides(names: Sequence[str]) -> tuple[str, ...]:
    """Return the limitation of an answer at a kink."""
    if len(names) < 2:
        return ()
    shown = " or ".join(names) if len(names) == 2 else f"{len(names)} combinations of sides"
    return (f"the start is at a kink ({shown}): the worst side decides",)


def _near_start(groups: Sequence[PeerClass]) -> tuple[str, ...]:
    moves = unrest(groups)
    return (*([f"{moves}; what happens is played: apc simulate"] if moves else []), NOT_LINEAR)


@part("analysis")
def analyze(
    system: Model,
    *,
    method: str = "auto",
    prepared: Prepared | None = None,
    certify: bool = False,
) -> Analysis:
    """Analyze a system by the method that serves it, or by one that is asked for.

    Where peers start at a kink every side is analyzed, and the result is that of the worst one.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse (see `overrides.apply`).
    method
        One of `methods.METHODS`. "modes": a few small systems, where equal peers and the graph allow that;
        "dense": all peers as one matrix, the check on all else, at the cost of N³; "determinant": the
        zeros of a small characteristic function, for peers that all differ on complete graphs and for delays
        of any length.
    prepared
        From `prepare`, of this system with any numbers; saves building the Jacobians again.
    certify
        Prove the verdict in ball arithmetic, whether or not floats leave it open.

    Raises
    ------
    ApcError
        E804 a system of too many states for its matrix, E806 numbers beyond floats, E850 a method that can't
        serve this scene; and those of `sides.sides`, `plan.refuse_varying` and `peers.peer_groups`.
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
        SideVerdict(side.name, one.verdict, one.stable, one.spectral_radius, one.spectral_radius_error)
        for side, one in zip(listed, each, strict=True)
    )
    worst = worst_side(verdicts)
    if len(listed) == 1:
        return each[0], listed[0]
    limitations = (*_of_sides([side.name for side in listed]), *each[worst].left_out)
    return replace(each[worst], sides=verdicts, left_out=limitations), listed[worst]


def _analyze(system: Model, *, method: str, prepared: Prepared, certify: bool) -> Analysis:
    """Analyze a system without kinks."""
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        scene = instance(system, prepared)
        plan = make_plan(scene, method)
        notes: tuple[Note, ...]
        if not plan.groups:
            spectrum, notes = _solve_populations(scene)
        elif plan.method == "determinant":
            spectrum, notes = _solve_determinant(plan.loops), ()
            small = all(loop.states <= MOST_STATES for loop in plan.loops)
            if (
                method == "auto" and spectrum.stable is None and small
            ):  # matrices bound what the determinant leaves open
                arranged = arrange(plan.groups, scene.exchange)
                plan = replace(plan, method=arranged.method, notes=arranged.notes)
                spectrum = _solve_closed(system, plan.loops, certify=certify)
        else:
            spectrum, notes = _solve_closed(system, plan.loops, certify=certify), ()
        if method == "determinant" and not np.isfinite(spectrum.spectral_radius_error):
            raise cannot_serve(system, method, "what a frame's ticks round hides the peers' own eigenvalues")
        if certify and (not plan.groups or plan.method == "determinant"):
            notes = (*notes, Limitation(LimitationCode.NO_BALLS, (plan.method,)))
        nonlinear = not scene.affine
        elements = replaced_elements(system)
        linearized = nonlinear or bool(elements)
        population = () if plan.loops else representatives(scene)
        stands = _what_stands(spectrum, plan.loops, population)
        verdict, stable = spectrum.verdict, spectrum.stable
        if verdict in (StabilityVerdict.STABLE_TRANSLATING, StabilityVerdict.DRIFTS):
            verdict = (
                StabilityVerdict.DRIFTS if stands.drifts else up_to(stands.translations, stands.rotations)
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
        peers=scene.exchange.peers,
        frame_s=float(scene.schedules[0].frame_s),
        states_per_peer=max(map(states_of, scene.schedules, scene.sites)),
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
        left_out=(*elements, *(_near_start(plan.groups) if nonlinear else ()), *left_out(system)),
        unfelt=stands.names,
        translations=stands.translations,
        rotations=stands.rotations,
        beyond=spectrum.beyond,
    )


def _what_stands(
    spectrum: Spectrum, loops: Sequence[ModalSystem], population: Sequence[PeerClass]
) -> NeutralModes:
    """Return what neither grows nor dies out.

    Where the loops are not at hand, of a large population, what is not felt is that of peers by themselves,
    and what moves counts as a translation.
    """
    if not spectrum.rigid_modes or not any(
        map(_remembers, (*population, *(g for loop in loops for g in loop.sites)))
    ):
        return NeutralModes(spectrum.rigid_modes, 0, spectrum.drifts, 0, ())
    listed: Sequence[tuple[ModalSystem, int]] = [(loop, loop.multiplicity) for loop in loops]
    for group in population:
        anyhow = {way: ((Fraction(-1, 3),),) for way in used_ways([group.schedule])}
        listed = [*listed, (ModalSystem(group.name, 1, (group,), anyhow), group.count)]
    with_drifts = bool(spectrum.drifts and loops)
    pairs = [(what_stands(loop, with_drifts=with_drifts), many) for loop, many in listed]
    names = tuple(dict.fromkeys(name for standing, _ in pairs for name in standing.names))
    unfelt = sum(standing.unfelt * many for standing, many in pairs)
    if not loops:
        return NeutralModes(spectrum.rigid_modes - unfelt, 0, spectrum.drifts, unfelt, names)
    return NeutralModes(
        translations=sum(standing.translations * many for standing, many in pairs),
        rotations=sum(standing.rotations * many for standing, many in pairs),
        drifts=sum(standing.drifts * many for standing, many in pairs),
        unfelt=unfelt,
        names=names,
    )


def _remembers(group: PeerClass) -> bool:
    """Say whether peers keep more than lengths with their rates."""
    kind = group.jacobians.kind
    return any(clock.memories for clock in kind.clocks) or any(
        state.unit.partition("/")[0] != LENGTH for state in kind.states
    )


def _solve_closed(system: Model, loops: Sequence[ModalSystem], *, certify: bool) -> Spectrum:
    """Solve loops by their matrices."""
    closed = tuple(close_loop(loop) for loop in loops)
    if not all(
        np.isfinite(closed_system.matrix).all() and np.isfinite(closed_system.error).all()
        for closed_system in closed
    ):
        raise ApcError(Diagnostic("E806", SourceLocation(system.origin.topology), TOO_LARGE))
    return solve_spectrum(closed, certify=certify)


def _solve_determinant(loops: Sequence[ModalSystem]) -> Spectrum:
    """Solve loops by the zeros of their characteristic functions."""
    # What serves large scenes is imported when one comes: all of it would cost every scene 30 ms.
    from apc.large.determinant_spectrum import solve_loops

    return solve_loops(loops)


def _solve_populations(scene: Instance) -> tuple[Spectrum, tuple[Note, ...]]:
    """Solve peers that all differ."""
    from apc.large.determinant_spectrum import solve_populations
    from apc.large.populations import populations
    from apc.large.translation import count_translations

    peers = populations(scene)
    rigid = count_translations(scene, peers)
    spectrum = solve_populations(peers, scene.exchange, rigid=rigid or 0)
    free = "the first peer moves freely in a way that not all others do: left open"
    return spectrum, () if rigid is not None else (free,)


def lifted_groups(
    system: Model, *, prepared: Prepared | None = None
) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
    """Return the peers of a system in groups of equal dynamics, lifted, and the exchange between them.

    Raises
    ------
    ApcError
        As `plan.refuse_varying` and `peers.peer_groups`.
    """
    scene = instance(system, prepared)
    refuse_varying(system, scene.jacobians)
    return peer_groups(scene), scene.exchange
