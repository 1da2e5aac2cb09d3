"""Stability analysis: from a compiled model to its spectrum and verdict.

Takes: a `NumericModel`.
Gives: `Analysis`, `analyze`; `prepare_at_start` for many analyses of one model; `lifted_classes`;
`near_start`; `analyze_sides`, `analyze_worst_side`; `determinant_radius`.
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

from apc.analysis.method_selection import AnalysisPlan, cannot_serve, make_plan, refuse_varying
from apc.analysis.nonlinear_elements import replaced_elements
from apc.analysis.one_sided_slopes import Side, SideVerdict, severity, sides, worst_side
from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.lifting.discretize import TOO_LARGE
from apc.lifting.equilibrium_equations import depends_on_time
from apc.lifting.numeric_model import NumericModel, linearized_at_start
from apc.lifting.rest_position import OperatingPoint, equilibrium_moves, equilibrium_note
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import limitations, unreliable
from apc.parameter_values.parameter_names import ParameterRef
from apc.result import PlotStyle, Result
from apc.spectrum.enclosure import WIDE
from apc.spectrum.equilibrium import equilibrium_residual
from apc.spectrum.interconnection import ModalSystem, close_loop
from apc.spectrum.modes import decompose
from apc.spectrum.peer_classes import (
    PeerClass,
    classes_of_peers,
    representatives,
    states_of,
    used_coupling_terms,
)
from apc.spectrum.rigid_modes import NeutralModes, classify_neutral_modes
from apc.spectrum.spectrum import Mode, Spectrum, solve_spectrum, up_to
from apc.support.state_limits import MATRIX_STATES
from apc.timing.communication_graph import CommunicationGraph
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
    "nonlinear topology: the result holds near the initial state, with the contacts and limits that are "
    "active there"
)
AT_REST = NOT_LINEAR.replace("initial state", "equilibrium")

# What a start that is not at rest admits: a simulation; without forces that depend on time, an equilibrium.
SIMULATED = "for the motion over time, run apc simulate"
AT_EQUILIBRIUM = "for its equilibrium, run apc analyze --operating-point equilibrium"

SETTLED = 0.02  # of the initial deviation: below it a motion counts as settled


@dataclass(frozen=True, slots=True)
class Analysis(Result):
    """The result of an analysis; `spectral_radius` is per frame, rigid modes removed.

    `states_per_peer` is that of the largest peer type in the model. `method` is one of `methods.METHODS`.
    `linearized` states that some subsystem is not affine: the result then holds near its start values only.
    `notes` are the reasons for the method; `proof` is the result of ball arithmetic, empty where floats
    decided; `limitations` are the limitations of the result. Of the rigid modes, `translations` and
    `rotations` are motions; the others belong to the unobservable memories named in `unobservable`.
    `radius_excess` bounds the spectral radius less 1 from below and above if that was proved, closer than two
    floats can. `sides` are the verdicts of all sides of the kinks at which peers start, empty without kinks;
    the analysis is that of the worst side. `equilibrium` is the point of linearization of a
    requested analysis, None at the start values, and in the analyses of a search.
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
    equilibrium: OperatingPoint | None = None

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Draw the eigenvalues and the unit circle into matplotlib Axes, or a new figure, in the style
        `look`.
        """
        return self._plotted(ax, style=style)

    @property
    def settling_s(self) -> float | None:
        """Settling time of the slowest mode to `SETTLED` of the start, in seconds.

        It is None if the mode does not decay.

        frame · ln(`SETTLED`)/ln(spectral radius): independent of the length of the frame.
        """
        if self.stable is not True or self.spectral_radius >= 1:
            return None
        return (
            self.frame_s * math.log(SETTLED) / math.log(self.spectral_radius) if self.spectral_radius else 0.0
        )


def prepare_at_start(numeric: NumericModel, varied: Sequence[ParameterRef] = ()) -> NumericModel | None:
    """Return a model with every peer type linearized at its start, as functions of its parameters.

    None if that is impossible (see `numeric_model.linearized_at_start`), if peers start at a kink, as each
    point is then analyzed on all sides, or if the start is an equilibrium that varies.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    varied
        The parameters that will have other values.

    Raises
    ------
    ApcError
        As `method_selection.refuse_varying` and `one_sided_slopes.sides`.
    """
    refuse_varying(numeric.model, numeric.jacobians)
    if sides(numeric)[0].numeric is not numeric:
        return None
    if numeric.model.at_equilibrium and not numeric.affine and equilibrium_moves(numeric.model, varied):
        return None
    return linearized_at_start(numeric, varied)


def near_start(numeric: NumericModel) -> tuple[str, ...]:
    """Return the limitations of a result that holds near the start values only; empty for a linear model.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    """
    at_rest = numeric.model.at_equilibrium
    elements = (*equilibrium_note(numeric.model), *replaced_elements(numeric.model))
    if numeric.affine:
        return elements
    try:
        all_sides = sides(numeric)
        peer_classes, _ = lifted_classes(all_sides[0].numeric)
    except ApcError:  # no result with these values
        return (*elements, AT_REST if at_rest else NOT_LINEAR)
    return (
        *_kink_limitation([side.name for side in all_sides]),
        *elements,
        *_start_limitations(peer_classes, at_rest=at_rest),
    )


def _kink_limitation(names: Sequence[str]) -> tuple[str, ...]:
    """Return the limitation of a result at a kink with these names of sides; empty without a kink."""
    if len(names) < 2:
        return ()
    shown = " or ".join(names) if len(names) == 2 else f"{len(names)} combinations of sides"
    return (f"the start is at a kink ({shown}): the worst side decides",)


def _start_limitations(peer_classes: Sequence[PeerClass], *, at_rest: bool) -> tuple[str, ...]:
    """Return the limitations of a linearized model: a motion at the start values, and the nonlinearity.

    Parameters
    ----------
    peer_classes
        The classes of peers, linearized.
    at_rest
        Whether the start values are those of the equilibrium, where nothing moves.
    """
    if at_rest:
        return (AT_REST,)
    moves = equilibrium_residual(peer_classes)
    if not moves:
        return (NOT_LINEAR,)
    timed = any(depends_on_time(peer_class.jacobians.peer_type) for peer_class in peer_classes)
    return f"{moves}; {SIMULATED if timed else f'{SIMULATED}; {AT_EQUILIBRIUM}'}", NOT_LINEAR


@part("analysis")
def analyze(
    numeric: NumericModel,
    *,
    method: str = "auto",
    certify: bool = False,
) -> Analysis:
    """Return the stability analysis of a model by the fastest applicable method, or by the method named.

    Where peers start at a kink every side is analyzed, and the result is that of the worst side.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    method
        One of `methods.METHODS`. "modes": a few small systems, if equal peers and the graph allow them;
        "dense": all peers as one matrix, the reference, at the cost of N³; "determinant": the zeros of a
        small characteristic function, for different peers on complete graphs and for delays of any length.
    certify
        Prove the verdict in ball arithmetic, also where floats decide it.

    Raises
    ------
    ApcError
        E804 a system of too many states for its matrix, E806 an overflow, E850 a method that is not
        applicable; the errors of `one_sided_slopes.sides`, `method_selection.refuse_varying` and
        `peer_classes.classes_of_peers`.
    """
    return analyze_sides(numeric, method=method, certify=certify)[0]


def analyze_sides(numeric: NumericModel, *, method: str, certify: bool) -> tuple[Analysis, Side]:
    """Return the analysis of the worst side of a kink, and this side; without a kink, of the model.

    Parameters
    ----------
    numeric, method, certify
        As for `analyze`.
    """
    return analyze_worst_side(sides(numeric), method=method, certify=certify)


def analyze_worst_side(
    all_sides: Sequence[Side],
    *,
    method: str = "auto",
    certify: bool = False,
    exact_work: float = math.inf,
    first_unstable: bool = False,
) -> tuple[Analysis, Side]:
    """Return the analysis of the worst side, and this side.

    Floats analyze every side first. Exact arithmetic then decides what they leave undecided, from the side
    with the largest spectral radius to the first unstable side.

    Parameters
    ----------
    all_sides
        The result of `one_sided_slopes.sides`, in any order.
    method, certify
        As for `analyze`.
    exact_work
        The largest number of states times events of a frame for which exact arithmetic decides what floats
        leave undecided; beyond, the verdict stays undecided.
    first_unstable
        Whether the first side that floats find unstable is the result.
    """
    one_pass = certify or len(all_sides) == 1
    analyses = []
    for side in all_sides:
        analyses.append(
            _analyze(side, method=method, certify=certify, exact_work=exact_work if one_pass else 0)
        )
        if first_unstable and analyses[-1].verdict is StabilityVerdict.UNSTABLE:
            return analyses[-1], side
    if exact_work and not one_pass:
        radii = [severity(None, analysis.spectral_radius) for analysis in analyses]
        for n in sorted(range(len(analyses)), key=radii.__getitem__, reverse=True):
            if not _is_decided(analyses[n]):
                analyses[n] = _analyze(all_sides[n], method=method, certify=False, exact_work=exact_work)
            if analyses[n].verdict is StabilityVerdict.UNSTABLE:
                break
    verdicts = tuple(
        SideVerdict(
            side.name,
            analysis.verdict,
            analysis.stable,
            analysis.spectral_radius,
            analysis.spectral_radius_error,
        )
        for side, analysis in zip(all_sides, analyses, strict=True)
    )
    worst = worst_side(verdicts)
    if len(all_sides) == 1:
        return analyses[0], all_sides[0]
    limitations = (*_kink_limitation([side.name for side in all_sides]), *analyses[worst].limitations)
    return replace(analyses[worst], sides=verdicts, limitations=limitations), all_sides[worst]


def _is_decided(analysis: Analysis) -> bool:
    """Return whether the verdict is decided, and the spectral radius known to WIDE."""
    return analysis.stable is not None and analysis.spectral_radius_error <= WIDE * max(
        analysis.spectral_radius, 1.0
    )


def _analyze(side: Side, *, method: str, certify: bool, exact_work: float) -> Analysis:
    """Return the stability analysis of a side: a model that is differentiable at its start values.

    Parameters
    ----------
    side
        The model at its parameter values.
    method, certify, exact_work
        As for `analyze_worst_side`.
    """
    numeric = side.numeric
    model, nonlinear = numeric.model, not numeric.affine
    elements = replaced_elements(model)
    linearized = nonlinear or bool(elements)
    with evaluating(model):
        plan, spectrum, notes = _spectrum(numeric, method, certify=certify, exact_work=exact_work)
        neutral_modes = _neutral_modes(spectrum, plan.loops, () if plan.loops else representatives(numeric))
    verdict, proof = _verdict(spectrum, neutral_modes), spectrum.proof
    if proof.outcome is ProofOutcome.DRIFTS and verdict is not StabilityVerdict.DRIFTS:
        proof = replace(proof, outcome=ProofOutcome.STABLE)  # the drift is that of an unobservable memory
    scopes = (
        (ProofScope.LINEARIZATION, linearized),
        (ProofScope.NOMINAL_NETWORK, bool(unreliable(model))),
    )
    if proof:
        proof = replace(proof, scope=tuple(scope for scope, applies in scopes if applies))
    return Analysis(
        topology=model.name,
        peers=numeric.comm_graph.peers,
        frame_s=float(numeric.schedules[0].frame_s),
        states_per_peer=max(map(states_of, numeric.schedules, numeric.subsystems)),
        method=plan.method,
        verdict=verdict,
        stable=verdict.stable,
        spectral_radius=spectrum.spectral_radius,
        spectral_radius_error=spectrum.spectral_radius_error,
        rigid_modes=spectrum.rigid_modes,
        modes=spectrum.modes,
        linearized=linearized,
        notes=(*plan.notes, *notes, *spectrum.notes),
        proof=proof,
        limitations=(
            *elements,
            *(_start_limitations(plan.peer_classes, at_rest=model.at_equilibrium) if nonlinear else ()),
            *limitations(model),
        ),
        unobservable=neutral_modes.names,
        translations=neutral_modes.translations,
        rotations=neutral_modes.rotations,
        radius_excess=spectrum.radius_excess,
    )


def _spectrum(
    numeric: NumericModel, method: str, *, certify: bool, exact_work: float
) -> tuple[AnalysisPlan, Spectrum, tuple[Note, ...]]:
    """Return the plan of an analysis, the spectrum by its method, and notes on the solution.

    An undecided determinant is followed by the matrices, where they fit.
    """
    model = numeric.model
    plan = make_plan(numeric, method)
    notes: tuple[Note, ...] = ()
    if not plan.peer_classes:
        spectrum, notes = _solve_populations(numeric)
    elif plan.method == "determinant":
        spectrum = _solve_determinant(plan.loops)
        matrices_fit = all(modal_system.states <= MATRIX_STATES for modal_system in plan.loops)
        if method == "auto" and spectrum.stable is None and matrices_fit:
            decomposed = decompose(plan.peer_classes, numeric.comm_graph)
            plan = replace(plan, method=decomposed.method, notes=decomposed.notes)
            spectrum = _solve_closed(model, plan.loops, certify=certify, exact_work=exact_work)
    else:
        spectrum = _solve_closed(model, plan.loops, certify=certify, exact_work=exact_work)
    if method == "determinant" and not np.isfinite(spectrum.spectral_radius_error):
        raise cannot_serve(model, method, "rounding within a frame exceeds the eigenvalues of single peers")
    if certify and (not plan.peer_classes or plan.method == "determinant"):
        notes = (*notes, Limitation(LimitationCode.NO_BALLS, (plan.method,)))
    return plan, spectrum, notes


def _verdict(spectrum: Spectrum, neutral_modes: NeutralModes) -> StabilityVerdict:
    """Return the verdict of a spectrum: with eigenvalues at 1, that of their motions."""
    if spectrum.verdict not in (StabilityVerdict.STABLE_TRANSLATING, StabilityVerdict.DRIFTS):
        return spectrum.verdict
    if neutral_modes.drifts:
        return StabilityVerdict.DRIFTS
    return up_to(neutral_modes.translations, neutral_modes.rotations)


def _neutral_modes(
    spectrum: Spectrum, loops: Sequence[ModalSystem], population: Sequence[PeerClass]
) -> NeutralModes:
    """Return the neutral modes of a model: translations, rotations, drifts, and unobservable memories.

    For a large population without loops, unobservable modes are those of single peers, and every other mode
    counts as a translation.
    """
    if not spectrum.rigid_modes or not any(
        map(
            _has_other_states,
            (*population, *(g for modal_system in loops for g in modal_system.peer_classes)),
        )
    ):
        return NeutralModes(spectrum.rigid_modes, 0, spectrum.drifts, 0, ())
    systems: Sequence[tuple[ModalSystem, int]] = [
        (modal_system, modal_system.multiplicity) for modal_system in loops
    ]
    for peer_class in population:
        generic_coupling = {
            coupling_term: ((Fraction(-1, 3),),)
            for coupling_term in used_coupling_terms([peer_class.schedule])
        }
        systems = [
            *systems,
            (ModalSystem(peer_class.name, 1, (peer_class,), generic_coupling), peer_class.count),
        ]
    with_drifts = bool(spectrum.drifts and loops)
    pairs = [
        (classify_neutral_modes(modal_system, with_drifts=with_drifts), multiplicity)
        for modal_system, multiplicity in systems
    ]
    names = tuple(dict.fromkeys(name for neutral, _ in pairs for name in neutral.names))
    unobservable = sum(neutral.unobservable * multiplicity for neutral, multiplicity in pairs)
    if not loops:
        return NeutralModes(spectrum.rigid_modes - unobservable, 0, spectrum.drifts, unobservable, names)
    return NeutralModes(
        translations=sum(neutral.translations * multiplicity for neutral, multiplicity in pairs),
        rotations=sum(neutral.rotations * multiplicity for neutral, multiplicity in pairs),
        drifts=sum(neutral.drifts * multiplicity for neutral, multiplicity in pairs),
        unobservable=unobservable,
        names=names,
    )


def _has_other_states(peer_class: PeerClass) -> bool:
    """Return whether peers have states other than lengths and their rates."""
    peer_type = peer_class.jacobians.peer_type
    return any(clock.memories for clock in peer_type.clocks) or any(
        state.unit.partition("/")[0] != LENGTH for state in peer_type.states
    )


def _solve_closed(
    model: Model, loops: Sequence[ModalSystem], *, certify: bool, exact_work: float
) -> Spectrum:
    """Return the spectrum of loops from their matrices."""
    closed = tuple(close_loop(modal_system) for modal_system in loops)
    if not all(
        np.isfinite(closed_system.matrix).all() and np.isfinite(closed_system.error).all()
        for closed_system in closed
    ):
        raise ApcError(Diagnostic("E806", SourceLocation(model.origin.topology), TOO_LARGE))
    return solve_spectrum(closed, certify=certify, exact_work=exact_work)


def determinant_radius(numeric: NumericModel) -> float:
    """Return the spectral radius in floats of a model whose verdict is that of the determinant method.

    NaN for other methods, at a kink, or if a count of eigenvalues contradicts the radius.
    """
    if sides(numeric)[0].numeric is not numeric:
        return math.nan
    from apc.spectrum.determinant_spectrum import radius_in_floats  # most models need no determinant

    plan = make_plan(numeric)
    return radius_in_floats(plan.loops) if plan.method == "determinant" and plan.loops else math.nan


def _solve_determinant(loops: Sequence[ModalSystem]) -> Spectrum:
    """Return the spectrum of loops from the zeros of their characteristic functions."""
    # Modules for large models are imported when needed: importing them costs 30 ms.
    from apc.spectrum.determinant_spectrum import solve_loops

    return solve_loops(loops)


def _solve_populations(numeric: NumericModel) -> tuple[Spectrum, tuple[Note, ...]]:
    """Return the spectrum of a model whose peers all differ, and notes on undecided translations."""
    from apc.spectrum.determinant_spectrum import solve_populations
    from apc.spectrum.heterogeneous_peers import populations
    from apc.spectrum.translation import count_translations

    peers = populations(numeric)
    rigid = count_translations(numeric, peers)
    spectrum = solve_populations(peers, numeric.comm_graph, rigid=rigid or 0)
    note = "the first peer has a rigid mode that other peers lack; the rigid modes are undecided"
    return spectrum, () if rigid is not None else (note,)


def lifted_classes(
    numeric: NumericModel,
) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
    """Return the classes of peers with equal dynamics, lifted over a frame, and the communication graph.

    Raises
    ------
    ApcError
        As `method_selection.refuse_varying` and `peer_classes.classes_of_peers`.
    """
    refuse_varying(numeric.model, numeric.jacobians)
    return classes_of_peers(numeric), numeric.comm_graph
