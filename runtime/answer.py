"""The whole answer of `apc analyze`: the verdict, and what stands beside it.

Takes: a `Model`.
Gives: `AnalysisReport`, `NetworkAnswer`, `answer`, `judge`; `sensitivities_of`, `proved_box`, `proved_at`.
Guarantees: what stands beside the verdict never changes it; what could not be had is said in a note.
Does not: compute any of it itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from apc.analysis.analysis import Analysis, analyze, analyze_sides, near_start
from apc.analysis.contact_modes import ContactModes, contact_modes
from apc.analysis.conventions import EventOrder, conventions
from apc.analysis.methods import PAPER
from apc.analysis.sides import Side
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.instance import Prepared, prepare
from apc.result import Result
from apc.vary.margins import NOT_STABLE, Margins, network_margins
from apc.vary.margins import margins as margins_of
from apc.vary.sensitivity import Sensitivities, network_sensitivities, sensitivities, varied
from apc.verdict import StabilityVerdict, Term

if TYPE_CHECKING:
    from apc.analysis.box_proof import RobustStability
    from apc.analysis.switching import ArbitrarySwitching
    from apc.frame.names import Range
    from apc.moments.network_verdict import MeanSquareStability
    from apc.simulation.buzz import LimitCycle

# How far the radius that is differentiated may be from that of the analysis, relative to 1: roundings of a
# well-conditioned frame stay below 1e-12; beyond ten times that, floats have lost what derivatives need.
SAME_RADIUS = 1e-11

# More peers than this, that differ or stand on a graph, are more than can be differentiated in passing.
FEW_PEERS = 100

# What is varied is composed hundreds of times, tick by tick: with more ticks in a frame for over ten seconds.
# Each number costs products of matrices of all states: with more of these together, for as long.
MOST_TICKS, MOST_PRODUCTS = 500, 1_000_000_000


@dataclass(frozen=True, slots=True)
class NetworkAnswer(Result):
    """A verdict over the network as it is, with the sensitivities and margins of its growth."""

    shown_by = "analysis_output:network_answer"

    verdict: MeanSquareStability
    sensitivities: Sensitivities
    margins: Margins


@dataclass(frozen=True, slots=True)
class AnalysisReport(Result):
    """An analysis with what moves its spectral radius most, its margins, and its modes of contact.

    `conventions` holds the analyses under every order of coincident events, or under those that could be had
    in passing; `detailed` says that they were asked for. `box` is the proof over a box of parameters, where
    one was asked for. `network` is the verdict over the network as it is, with what moves the growth of mean
    squares and how far that lets each number grow; None where all packets are on time.
    `switching` says whether contacts may open and close at will, None where nothing switches; `buzz` is None
    where it was not asked for, and where there is none to predict, which `no_buzz` says. `warnings` are those
    of the topology. `nominal` says that beside `network` all of the nominal network is wanted in words.
    """

    shown_by = "analysis_output:answer"

    analysis: Analysis
    network: NetworkAnswer | None
    sensitivities: Sensitivities
    margins: Margins
    contact_modes: ContactModes | None
    switching: ArbitrarySwitching | None
    buzz: LimitCycle | None
    conventions: EventOrder
    detailed: bool
    box: RobustStability | None
    no_buzz: str = ""
    warnings: tuple[str, ...] = ()
    nominal: bool = False


def judge(
    system: Model, *, method: str = "auto", certify: bool = False, prepared: Prepared | None = None
) -> Analysis:
    """Analyse a system by one of the methods of `analysis.analyze`, or "paper" (see `paper`).

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    method
        The method.
    certify
        Prove the verdict in ball arithmetic.
    prepared
        From `instance.prepare`, of this system with any numbers.
    """
    return _judged(system, prepared or prepare(system), method=method, certify=certify)[0]


def _judged(system: Model, prepared: Prepared, *, method: str, certify: bool) -> tuple[Analysis, Side]:
    """Return the analysis of the worst side of the kinks at which peers start, and that side."""
    if method != PAPER:
        return analyze_sides(system, method=method, certify=certify, prepared=prepared)
    if certify:
        what = "method paper gives no proof: its matrices hold every sample of a frame, rounded"
        raise ApcError(
            Diagnostic("E850", SourceLocation(system.origin.topology), what, hint="--method auto --certify")
        )
    from apc.analysis.paper import analyze_paper  # rarely asked for

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
    with_buzz: bool = False,
) -> AnalysisReport:
    """Analyse a system and look at what stands beside the verdict.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    method
        See `analysis.analyze`.
    certify
        Prove the verdict in ball arithmetic.
    box
        Ranges of parameters over which to prove stability as well.
    cells
        Of how many cells of the box that is tried at most, see `proved_box`.
    every_convention
        Repeat the analysis under every order of coincident events, however long it takes.
    margins
        Whether to look for margins: True, for all of them, however long it takes; False, for none; None, for
        all in a scene where that takes a second or so.
    with_buzz
        Predict the buzz of one-sided contacts, and play the scene to lay it beside.

    Raises
    ------
    ApcError
        As `analysis.analyze` and `box_proof.prove_box`.
    """
    prepared = prepare(system)
    analysis, side = _judged(system, prepared, method=method, certify=certify)
    modes, notes = _contact_modes(system, prepared)
    compared = conventions(system, prepared=prepared, default=analysis, quick=not every_convention)
    if compared.not_repeated and not every_convention:
        notes = (*notes, compared.not_repeated)
    moved = sensitivities_of(side.system, side.prepared, analysis)
    nominal = _margins(system, prepared, analysis, wanted=margins)
    buzz, no_buzz = _buzz(system, prepared) if with_buzz else (None, "")
    return AnalysisReport(
        analysis=replace(analysis, notes=(*analysis.notes, *notes, *_published(system))),
        network=_over_network(system, prepared, analysis, nominal, certify=certify, wanted=margins),
        sensitivities=moved,
        margins=nominal,
        contact_modes=modes,
        switching=_switching(system, prepared, modes) if modes else None,
        buzz=buzz,
        conventions=compared,
        detailed=every_convention,
        box=proved_box(system, box, cells=cells) if box else None,
        no_buzz=no_buzz,
        warnings=system.warnings,
    )


def _published(system: Model) -> tuple[str, ...]:
    """Return published conditions; imported here, as few topologies have an element they are about."""
    from apc.hands.published_limits import published_limits

    return published_limits(system)


def _over_network(
    system: Model,
    prepared: Prepared,
    analysis: Analysis,
    nominal: Margins,
    *,
    certify: bool,
    wanted: bool | None,
) -> NetworkAnswer | None:
    """Return the answer over the network as it is; imported here, as most scenes have an ideal one."""
    if all(link.channel is None for link in system.links):
        return None
    from apc.moments.network_verdict import judge_network

    verdict = judge_network(system, prepared, certify=certify)
    if verdict is None:
        return None
    if why := _too_large(system, prepared, analysis) or _too_many_products(system):
        return NetworkAnswer(verdict, _not_told(0.0, why), Margins((), why))
    moved = network_sensitivities(system, prepared)
    if wanted is False:
        return NetworkAnswer(verdict, moved, nominal)
    return NetworkAnswer(verdict, moved, network_margins(system, prepared, nominal, quick=not wanted))


def _switching(system: Model, prepared: Prepared, modes: ContactModes) -> ArbitrarySwitching:
    """Return whether contacts may switch at will; imported here, as most scenes have none."""
    from apc.analysis.switching import switching

    return switching(system, modes, prepared=prepared)


def _buzz(system: Model, prepared: Prepared) -> tuple[LimitCycle | None, str]:
    """Return the buzz of contacts, or why there is none; imported here, as few analyses ask for it."""
    from apc.simulation.buzz import buzz

    try:
        return buzz(system, prepared=prepared), ""
    except ApcError as error:
        return None, error.mistakes[0].reason


def proved_box(
    system: Model,
    box: Sequence[Range],
    *,
    passive: bool = False,
    cells: int | None = None,
    inside: float = 1.0,
) -> RobustStability:
    """Return the proof over a box; imported here, as few analyses ask for one.

    Parameters
    ----------
    system
        The compiled scene.
    box
        Ranges of parameters.
    passive
        Whether every passive hand is meant, over the nominal network: at the delays of a link alone.
    cells
        How many cells are looked at at most; without it, as many as take some seconds.
    inside
        What the spectral radius has to be below, over a network on which every packet is on time.

    Raises
    ------
    ApcError
        As `box_proof.prove_box`, or `moments.mean_square_box.prove_box` where links are, or may become,
        unreliable; E930 other ranges, with every passive hand.
    """
    from apc.network.nominal import channel_numbers, unreliable
    from apc.vary.delay_box import is_delay, prove_over_delay

    if passive and not (len(box) == 1 and is_delay(system, box[0].free)):
        what = "with every passive hand values are judged one by one, and of ranges that of a link's delay"
        hint = "apc region --hands passive, or apc critical --hands passive"
        raise ApcError(Diagnostic("E930", SourceLocation("--box"), what, hint=hint))
    if any(is_delay(system, interval.free) for interval in box):
        at_each = partial(proved_at, passive=passive, cells=cells, inside=inside)
        return prove_over_delay(system, box, at_each, nominal=not passive and not unreliable(system))
    from apc.analysis.box_proof import prove_box

    numbers = channel_numbers(system)
    if unreliable(system) or any(interval.free.name in numbers for interval in box):
        from apc.moments.mean_square_box import prove_box as prove_over_network

        return prove_over_network(system, box, cells=cells)
    return prove_box(system, box, cells=cells, inside=inside)


def proved_at(
    system: Model,
    box: Sequence[Range],
    *,
    passive: bool = False,
    cells: int | None = None,
    inside: float = 1.0,
) -> RobustStability:
    """Return the proof over a box; without any range, the verdict as it is.

    Parameters
    ----------
    system, box, passive, cells, inside
        As for `proved_box`.
    """
    if box:
        return proved_box(system, box, passive=passive, cells=cells, inside=inside)
    from apc.analysis.box_proof import RobustStability
    from apc.network.nominal import unreliable

    verdict: Term
    if passive:
        from apc.hands.passivity import passive_hands

        hands = passive_hands(system)
        verdict, stable, left = hands.verdict, hands.stable, hands.left_out
    elif unreliable(system):
        from apc.moments.network_verdict import judge_network

        prepared = prepare(system)
        network = judge_network(system, prepared)
        assert network is not None, "a link is unreliable"
        verdict, stable, left = network.verdict, network.stable, near_start(system, prepared)
    else:
        analysis = analyze(system)
        verdict, stable, left = analysis.verdict, analysis.stable, analysis.left_out
        if stable and inside != 1 and not analysis.spectral_radius + analysis.spectral_radius_error < inside:
            stable = False if analysis.spectral_radius - analysis.spectral_radius_error >= inside else None
    return RobustStability(system.name, (), verdict, stable, 1, float(stable is None), (), (), left)


def sensitivities_of(system: Model, prepared: Prepared, analysis: Analysis) -> Sensitivities:
    """Return what moves the spectral radius of an analysis most, or only why it couldn't be had.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    analysis
        Its analysis.
    """
    if why := _too_large(system, prepared, analysis) or _too_many_products(system):
        return _not_told(analysis.spectral_radius, why)
    try:
        moved = sensitivities(system, prepared=prepared)
    except ApcError as error:
        return _not_told(analysis.spectral_radius, f"not looked for: {error.mistakes[0].what}")
    # Derivatives are of matrices in floats, the analysis is of exact exponentials: both have one radius.
    apart = abs(moved.radius - analysis.spectral_radius) - analysis.spectral_radius_error
    if moved.active and not apart <= SAME_RADIUS * max(1.0, analysis.spectral_radius):
        why = "not told: floats lose the digits of what would be differentiated"
        return _not_told(analysis.spectral_radius, why)
    return moved


def _not_told(radius: float, why: str) -> Sensitivities:
    return Sensitivities(radius, (), (), f"what moves it most: {why}")


def _too_large(system: Model, prepared: Prepared, analysis: Analysis) -> str:
    """Return why nothing is varied, "" unless the scene is more than few small matrices and short frames."""
    if why := _too_many_peers(system, analysis):
        return why
    ticks = max(sum(schedule.ticks) for schedule in prepared.schedules)
    if ticks > MOST_TICKS:
        return f"not looked for: {ticks:,} ticks in a frame take too long"
    packets = max(len(schedule.heard) for schedule in prepared.schedules)
    if packets > MOST_TICKS:
        return f"not looked for: {packets:,} packets heard in a frame take too long"
    return ""


def _too_many_peers(system: Model, analysis: Analysis) -> str:
    """Return why nothing is varied, "" unless very many peers differ or stand on a graph."""
    complete = all(link.graph.shape == "complete" for link in system.links)
    apart = analysis.method == "determinant" or not complete
    return "not looked for in so large a population" if apart and system.peers > FEW_PEERS else ""


def _too_many_products(system: Model) -> str:
    """Return why nothing is differentiated, "" unless many numbers meet many states."""
    free, states = len(varied(system)), max(len(kind.states) for kind in system.kinds)
    if free * states**3 > MOST_PRODUCTS:
        return f"not looked for: {free:,} numbers of {states:,} states take too long"
    return ""


def _margins(system: Model, prepared: Prepared, analysis: Analysis, *, wanted: bool | None) -> Margins:
    """Return the margins, or only why they couldn't be had."""
    if wanted is False:
        return Margins((), "not looked for: they were not wanted")
    if analysis.stable is None or analysis.verdict is StabilityVerdict.UNSTABLE:
        return Margins((), NOT_STABLE.format("proved stable" if analysis.stable is None else "stable"))
    if why := _too_many_peers(system, analysis):
        return Margins((), why)
    try:
        return margins_of(system, prepared=prepared, quick=not wanted)
    except ApcError as error:
        return Margins((), f"not looked for: {error.mistakes[0].what}")


def _contact_modes(system: Model, prepared: Prepared) -> tuple[ContactModes | None, tuple[str, ...]]:
    """Return the modes of contact, None where nothing switches, and what to say where they can't be had."""
    try:
        modes = contact_modes(system, prepared=prepared)
    except ApcError as error:
        return None, (f"modes of contact: {error.mistakes[0].sentence}",)
    return (modes if modes.modes else None), ()
