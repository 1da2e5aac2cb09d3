"""The complete result of `apc analyze`: the verdict and additional results.

Takes: a `Model`.
Gives: `AnalysisReport`, `NetworkAnswer`, `answer`, `analysis_report`; `sensitivities_of`, `robust_stability`,
`proved_at`.
Guarantees: additional results never change the verdict; a missing result is explained in a note.
Does not: compute any result itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from apc.analysis.analysis import Analysis, analyze, analyze_sides, near_start
from apc.analysis.contact_modes import ContactModes, contact_modes
from apc.analysis.event_order import EventOrder, event_order
from apc.analysis.methods import PAPER
from apc.analysis.one_sided_slopes import Side
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.numeric_model import Prepared, prepare
from apc.parameter_studies.margins import NOT_STABLE, Margins, network_margins
from apc.parameter_studies.margins import margins as margins_of
from apc.parameter_studies.sensitivity import Sensitivities, network_sensitivities, sensitivities, varied
from apc.result import Result
from apc.verdict import StabilityVerdict, Term

if TYPE_CHECKING:
    from apc.analysis.arbitrary_switching import ArbitrarySwitching
    from apc.analysis.robust_stability import RobustStability
    from apc.frame.parameter_names import Range
    from apc.mean_square.mean_square_stability import MeanSquareStability
    from apc.simulation.limit_cycle import LimitCycle

# How far the radius that is differentiated may be from that of the analysis, relative to 1: roundings of a
# well-conditioned frame stay below 1e-12; beyond ten times that, floats lose the digits of derivatives.
SAME_RADIUS = 1e-11

# More peers than this, if different or on a graph, are too many for default sensitivities.
FEW_PEERS = 100

# What is varied is composed hundreds of times, tick by tick: with more ticks in a frame for over ten seconds.
# Each number costs products of matrices of all states: with more of these together, for as long.
MOST_TICKS, MOST_PRODUCTS = 500, 1_000_000_000


@dataclass(frozen=True, slots=True)
class NetworkAnswer(Result):
    """The verdict over the lossy network, with the sensitivities and margins of the mean-square growth."""

    shown_by = "analysis_output:network_answer"

    verdict: MeanSquareStability
    sensitivities: Sensitivities
    margins: Margins


@dataclass(frozen=True, slots=True)
class AnalysisReport(Result):
    """An analysis with its sensitivities, margins, and modes of contact.

    `event_order` holds the analyses under every order of coincident events, or under those available at
    little cost; `detailed` is whether they were requested. `box` is the proof over a box of parameters, if
    requested. `network` is the verdict over the lossy network, with the sensitivities and margins of the
    mean-square growth; None if all packets are on time. `arbitrary_switching` is the result for arbitrary
    switching of contacts, None without contacts; `limit_cycle` is None if not requested or not predictable,
    with the reason in `no_limit_cycle`. `warnings` are those of the topology. `nominal` is whether the text
    includes all results of the nominal network.
    """

    shown_by = "analysis_output:answer"

    analysis: Analysis
    network: NetworkAnswer | None
    sensitivities: Sensitivities
    margins: Margins
    contact_modes: ContactModes | None
    arbitrary_switching: ArbitrarySwitching | None
    limit_cycle: LimitCycle | None
    event_order: EventOrder
    detailed: bool
    box: RobustStability | None
    no_limit_cycle: str = ""
    warnings: tuple[str, ...] = ()
    nominal: bool = False


def analysis_report(
    system: Model, *, method: str = "auto", certify: bool = False, prepared: Prepared | None = None
) -> Analysis:
    """Analyse a system by one of the methods of `analysis.analyze`, or "paper" (see `paper_method`).

    Parameters
    ----------
    system
        The model, with the parameter values to analyze.
    method
        The method.
    certify
        Prove the verdict in ball arithmetic.
    prepared
        From `numeric_model.prepare`, of this model with any parameter values.
    """
    return _run_method(system, prepared or prepare(system), method=method, certify=certify)[0]


def _run_method(system: Model, prepared: Prepared, *, method: str, certify: bool) -> tuple[Analysis, Side]:
    """Return the analysis of the worst side of the kinks at which peers start, and that side."""
    if method != PAPER:
        return analyze_sides(system, method=method, certify=certify, prepared=prepared)
    if certify:
        message = "method paper gives no proof: its matrices hold every sample of a frame, rounded"
        raise ApcError(
            Diagnostic(
                "E850", SourceLocation(system.origin.topology), message, hint="--method auto --certify"
            )
        )
    from apc.analysis.paper_method import analyze_paper  # rarely asked for

    return analyze_paper(system), Side("", system, prepared)


def answer(
    system: Model,
    *,
    method: str = "auto",
    certify: bool = False,
    box: Sequence[Range] = (),
    cells: int | None = None,
    every_convention: bool = False,
    margins: bool | None = None,
    with_limit_cycle: bool = False,
) -> AnalysisReport:
    """Analyze a system, with the additional results of `apc analyze`.

    Parameters
    ----------
    system
        The model, with the parameter values to analyze.
    method
        See `analysis.analyze`.
    certify
        Prove the verdict in ball arithmetic.
    box
        Ranges of parameters over which to prove stability as well.
    cells
        The largest number of cells of the box, see `robust_stability`.
    every_convention
        Repeat the analysis under every order of coincident events, however long it takes.
    margins
        Whether to compute margins: True for all, however long it takes; False for none; None for all if that
        takes about a second.
    with_limit_cycle
        Predict the limit cycle of one-sided contacts, and simulate it for comparison.

    Raises
    ------
    ApcError
        As `analysis.analyze` and `robust_stability.prove_robust_stability`.
    """
    prepared = prepare(system)
    analysis, side = _run_method(system, prepared, method=method, certify=certify)
    modes, notes = _contact_modes(system, prepared)
    compared = event_order(system, prepared=prepared, default=analysis, quick=not every_convention)
    if compared.not_repeated and not every_convention:
        notes = (*notes, compared.not_repeated)
    moved = sensitivities_of(side.system, side.prepared, analysis)
    nominal = _margins(system, prepared, analysis, requested=margins)
    limit_cycle, no_limit_cycle = _limit_cycle(system, prepared) if with_limit_cycle else (None, "")
    return AnalysisReport(
        analysis=replace(analysis, notes=(*analysis.notes, *notes, *_published(system))),
        network=_over_network(system, prepared, analysis, nominal, certify=certify, requested=margins),
        sensitivities=moved,
        margins=nominal,
        contact_modes=modes,
        arbitrary_switching=_switching(system, prepared, modes) if modes else None,
        limit_cycle=limit_cycle,
        event_order=compared,
        detailed=every_convention,
        box=robust_stability(system, box, cells=cells) if box else None,
        no_limit_cycle=no_limit_cycle,
        warnings=system.warnings,
    )


def _published(system: Model) -> tuple[str, ...]:
    """Return published conditions; imported here, as few topologies have an element they are about."""
    from apc.haptics.published_limits import published_limits

    return published_limits(system)


def _over_network(
    system: Model,
    prepared: Prepared,
    analysis: Analysis,
    nominal: Margins,
    *,
    certify: bool,
    requested: bool | None,
) -> NetworkAnswer | None:
    """Return the result over the lossy network; imported here, as most models have an ideal one."""
    if all(link.channel is None for link in system.links):
        return None
    from apc.mean_square.mean_square_stability import mean_square_stability

    verdict = mean_square_stability(system, prepared, certify=certify)
    if verdict is None:
        return None
    if why := _too_large(system, prepared, analysis) or _too_many_products(system):
        return NetworkAnswer(verdict, _not_reported(0.0, why), Margins((), why))
    moved = network_sensitivities(system, prepared)
    if requested is False:
        return NetworkAnswer(verdict, moved, nominal)
    return NetworkAnswer(verdict, moved, network_margins(system, prepared, nominal, quick=not requested))


def _switching(system: Model, prepared: Prepared, modes: ContactModes) -> ArbitrarySwitching:
    """Return the result for arbitrary switching; imported here, as most models have no contacts."""
    from apc.analysis.arbitrary_switching import arbitrary_switching

    return arbitrary_switching(system, modes, prepared=prepared)


def _limit_cycle(system: Model, prepared: Prepared) -> tuple[LimitCycle | None, str]:
    """Return the buzz of contacts, or why there is none; imported here, as few analyses ask for it."""
    from apc.simulation.limit_cycle import limit_cycle

    try:
        return limit_cycle(system, prepared=prepared), ""
    except ApcError as error:
        return None, error.mistakes[0].reason


def robust_stability(
    system: Model,
    box: Sequence[Range],
    *,
    passive: bool = False,
    cells: int | None = None,
    inside: float = 1.0,
) -> RobustStability:
    """Return the proof over a box; imported here, as few analyses request one.

    Parameters
    ----------
    system
        The model.
    box
        Ranges of parameters.
    passive
        Whether the criterion is every passive hand, over the nominal network: for ranges of a link's delay
        only.
    cells
        The largest number of cells; by default as many as take some seconds.
    inside
        The upper limit of the spectral radius, over a network with all packets on time.

    Raises
    ------
    ApcError
        As `robust_stability.prove_robust_stability`, or `mean_square.mean_square_box.prove_mean_square`
        where links are, or may become, unreliable; E930 other ranges, with every passive hand.
    """
    from apc.network.nominal_criterion import channel_numbers, unreliable
    from apc.parameter_studies.delay_interval_proof import is_delay, prove_over_delay

    if passive and not (len(box) == 1 and is_delay(system, box[0].free)):
        message = "with every passive hand values are judged one by one, and of ranges that of a link's delay"
        hint = "apc region --hands passive, or apc critical --hands passive"
        raise ApcError(Diagnostic("E930", SourceLocation("--box"), message, hint=hint))
    if any(is_delay(system, interval.free) for interval in box):
        at_each = partial(proved_at, passive=passive, cells=cells, inside=inside)
        return prove_over_delay(system, box, at_each, nominal=not passive and not unreliable(system))
    from apc.analysis.robust_stability import prove_robust_stability

    numbers = channel_numbers(system)
    if unreliable(system) or any(interval.free.name in numbers for interval in box):
        from apc.mean_square.mean_square_box import prove_mean_square as prove_over_network

        return prove_over_network(system, box, cells=cells)
    return prove_robust_stability(system, box, cells=cells, inside=inside)


def proved_at(
    system: Model,
    box: Sequence[Range],
    *,
    passive: bool = False,
    cells: int | None = None,
    inside: float = 1.0,
) -> RobustStability:
    """Return the proof over a box; without ranges, the verdict.

    Parameters
    ----------
    system, box, passive, cells, inside
        As for `robust_stability`.
    """
    if box:
        return robust_stability(system, box, passive=passive, cells=cells, inside=inside)
    from apc.analysis.robust_stability import RobustStability
    from apc.network.nominal_criterion import unreliable

    verdict: Term
    if passive:
        from apc.haptics.absolute_stability import absolute_stability

        hands = absolute_stability(system)
        verdict, stable, left = hands.verdict, hands.stable, hands.limitations
    elif unreliable(system):
        from apc.mean_square.mean_square_stability import mean_square_stability

        prepared = prepare(system)
        network = mean_square_stability(system, prepared)
        assert network is not None, "a link is unreliable"
        verdict, stable, left = network.verdict, network.stable, near_start(system, prepared)
    else:
        analysis = analyze(system)
        verdict, stable, left = analysis.verdict, analysis.stable, analysis.limitations
        if stable and inside != 1 and not analysis.spectral_radius + analysis.spectral_radius_error < inside:
            stable = False if analysis.spectral_radius - analysis.spectral_radius_error >= inside else None
    return RobustStability(system.name, (), verdict, stable, 1, float(stable is None), (), (), left)


def sensitivities_of(system: Model, prepared: Prepared, analysis: Analysis) -> Sensitivities:
    """Return the sensitivities of an analysis, or the reason for their absence.

    Parameters
    ----------
    system, prepared
        The model, and the result of `numeric_model.prepare`.
    analysis
        Its analysis.
    """
    if why := _too_large(system, prepared, analysis) or _too_many_products(system):
        return _not_reported(analysis.spectral_radius, why)
    try:
        moved = sensitivities(system, prepared=prepared)
    except ApcError as error:
        return _not_reported(analysis.spectral_radius, f"not looked for: {error.mistakes[0].message}")
    # Derivatives are of matrices in floats, the analysis is of exact exponentials: both have one radius.
    separation = abs(moved.radius - analysis.spectral_radius) - analysis.spectral_radius_error
    if moved.active and not separation <= SAME_RADIUS * max(1.0, analysis.spectral_radius):
        why = "not told: floats lose the digits of what would be differentiated"
        return _not_reported(analysis.spectral_radius, why)
    return moved


def _not_reported(radius: float, why: str) -> Sensitivities:
    return Sensitivities(radius, (), (), f"what moves it most: {why}")


def _too_large(system: Model, prepared: Prepared, analysis: Analysis) -> str:
    """Return the reason for omitting margins, "" for few small matrices and short frames."""
    if why := _too_many_peers(system, analysis):
        return why
    ticks = max(sum(schedule.ticks) for schedule in prepared.schedules)
    if ticks > MOST_TICKS:
        return f"not looked for: {ticks:,} ticks in a frame take too long"
    packets = max(len(schedule.received) for schedule in prepared.schedules)
    if packets > MOST_TICKS:
        return f"not looked for: {packets:,} packets heard in a frame take too long"
    return ""


def _too_many_peers(system: Model, analysis: Analysis) -> str:
    """Return the reason for omitting sensitivities; "" unless very many peers differ or are on a graph."""
    complete = all(link.graph.shape == "complete" for link in system.links)
    separation = analysis.method == "determinant" or not complete
    return "not looked for in so large a population" if separation and system.peers > FEW_PEERS else ""


def _too_many_products(system: Model) -> str:
    """Return the reason for omitting derivatives, "" unless there are many parameters and states."""
    free, states = len(varied(system)), max(len(peer_type.states) for peer_type in system.peer_types)
    if free * states**3 > MOST_PRODUCTS:
        return f"not looked for: {free:,} numbers of {states:,} states take too long"
    return ""


def _margins(system: Model, prepared: Prepared, analysis: Analysis, *, requested: bool | None) -> Margins:
    """Return the margins, or only why they couldn't be had."""
    if requested is False:
        return Margins((), "not looked for: they were not wanted")
    if analysis.stable is None or analysis.verdict is StabilityVerdict.UNSTABLE:
        return Margins((), NOT_STABLE.format("proved stable" if analysis.stable is None else "stable"))
    if why := _too_many_peers(system, analysis):
        return Margins((), why)
    try:
        return margins_of(system, prepared=prepared, quick=not requested)
    except ApcError as error:
        return Margins((), f"not looked for: {error.mistakes[0].message}")


def _contact_modes(system: Model, prepared: Prepared) -> tuple[ContactModes | None, tuple[str, ...]]:
    """Return the modes of contact, None without contacts, and a note if they are unavailable."""
    try:
        modes = contact_modes(system, prepared=prepared)
    except ApcError as error:
        return None, (f"modes of contact: {error.mistakes[0].sentence}",)
    return (modes if modes.modes else None), ()
