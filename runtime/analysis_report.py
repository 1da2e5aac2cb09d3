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
from apc.analysis.box_result import RobustStability
from apc.analysis.contact_modes import ContactModes, contact_modes
from apc.analysis.methods import PAPER
from apc.analysis.one_sided_slopes import Side
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.lifting.rest_position import operating_point_from
from apc.result import Result
from apc.studies.margins import NOT_STABLE, Margins, network_margins
from apc.studies.margins import margins as margins_of
from apc.studies.sensitivity import Sensitivities, network_sensitivities, sensitivities, varied
from apc.support.extension_table import find_extension, not_installed, require_extension
from apc.verdict import Note, StabilityVerdict, Term

if TYPE_CHECKING:
    from apc.mean_square.mean_square_stability import MeanSquareStability
    from apc.parameter_values.parameter_names import Range

# The largest difference between the spectral radius of the sensitivities and that of the analysis, relative
# to 1: rounding errors of a well-conditioned frame map are below 1e-12; above ten times this, derivatives are
# inaccurate.
SAME_RADIUS = 1e-11

# The largest number of different peers, or peers on a graph, for sensitivities by default.
FEW_PEERS = 100

# Limits above which sensitivities and margins take more than ten seconds: ticks of a frame, whose map is
# composed hundreds of times, and multiplications of matrix products for all varied parameters.
MOST_TICKS, MOST_PRODUCTS = 500, 1_000_000_000


@dataclass(frozen=True, slots=True)
class NetworkAnswer(Result):
    """The verdict over the lossy network, with sensitivities and margins of the mean-square growth."""

    shown_by = "analysis_output:network_answer"

    verdict: MeanSquareStability
    sensitivities: Sensitivities
    margins: Margins


@dataclass(frozen=True, slots=True)
class AnalysisReport(Result):
    """An analysis with its sensitivities, margins, and contact modes.

    `event_order` has the analyses under every order of coincident events, if requested; `order_warning`
    states in any case whether the verdict depends on it, as far as this costs little. `box` is the proof over
    a box of parameters, if requested. `network` is the verdict over the lossy network, with the sensitivities
    and margins of the mean-square growth; None if all packets are on time. `arbitrary_switching` is the
    result for arbitrary switching of contacts, None without contacts; `limit_cycle` is None if not requested
    or not predictable, with the reason in `no_limit_cycle`. `warnings` are those of the topology. `nominal`
    is whether the text includes all results of the nominal network, `all_modes` whether it has a row for
    every mode.
    """

    shown_by = "analysis_output:answer"

    analysis: Analysis
    network: NetworkAnswer | None
    sensitivities: Sensitivities
    margins: Margins
    contact_modes: ContactModes | None
    arbitrary_switching: Result | None
    limit_cycle: Result | None
    event_order: Result | None
    order_warning: str
    box: RobustStability | None
    no_limit_cycle: str = ""
    warnings: tuple[str, ...] = ()
    nominal: bool = False
    all_modes: bool = False


def analysis_report(numeric: NumericModel, *, method: str = "auto", certify: bool = False) -> Analysis:
    """Return the analysis of a model by a method of `analysis.analyze`, or by "paper" (see `paper_method`).

    Parameters
    ----------
    numeric
        The model with its parameter values.
    method
        The name of the method.
    certify
        Prove the verdict in ball arithmetic.
    """
    return _with_equilibrium(numeric.model, _run_method(numeric, method=method, certify=certify)[0])


def _with_equilibrium(model: Model, analysis: Analysis) -> Analysis:
    """Return an analysis with the equilibrium at which its model is linearized, if any."""
    if not model.at_equilibrium:
        return analysis
    return replace(analysis, equilibrium=operating_point_from(model))


def _run_method(numeric: NumericModel, *, method: str, certify: bool) -> tuple[Analysis, Side]:
    """Return the analysis on the worst side of the kinks at the start values, and this side."""
    model = numeric.model
    if method != PAPER:
        return analyze_sides(numeric, method=method, certify=certify)
    if certify:
        message = "method paper has no proof, because its matrices are rounded"
        raise ApcError(
            Diagnostic("E850", SourceLocation(model.origin.topology), message, fix="--method auto --certify")
        )
    paper_analysis: Analysis = require_extension("paper_method").analyze_paper(model)
    return paper_analysis, Side("", numeric)


def answer(
    model: Model,
    *,
    method: str = "auto",
    certify: bool = False,
    box: Sequence[Range] = (),
    cells: int | None = None,
    every_convention: bool = False,
    margins: bool | None = None,
    with_limit_cycle: bool = False,
) -> AnalysisReport:
    """Return the analysis of a model, with the additional results of `apc analyze`.

    Parameters
    ----------
    model
        The model, with the parameter values to analyze.
    method
        See `analysis.analyze`.
    certify
        Prove the verdict in ball arithmetic.
    box
        Ranges of parameters over which stability is to be proved.
    cells
        The largest number of cells of the box, see `robust_stability`.
    every_convention
        Whether to repeat the analysis under every order of coincident events, without a time limit.
    margins
        Whether to compute margins: True for all, without a time limit; False for none; None for all if this
        takes about a second.
    with_limit_cycle
        Whether to predict the limit cycle of one-sided contacts, and simulate it for comparison.

    Raises
    ------
    ApcError
        As `analysis.analyze` and `robust_stability.prove_robust_stability`.
    """
    numeric = numeric_model(model)
    analysis, side = _run_method(numeric, method=method, certify=certify)
    modes, notes = _contact_modes(numeric)
    orders, order_warning, order_notes = _event_orders(numeric, analysis, every=every_convention)
    sensitivity_result = sensitivities_of(side.numeric, analysis)
    nominal = _margins(numeric, analysis, requested=margins)
    limit_cycle, no_limit_cycle = _limit_cycle(numeric) if with_limit_cycle else (None, "")
    switching = _switching(numeric, modes) if modes else None
    if modes and switching is None:
        notes = (*notes, not_installed("switching"))
    return AnalysisReport(
        analysis=replace(
            _with_equilibrium(model, analysis),
            notes=(*analysis.notes, *notes, *order_notes, *_published_conditions(model)),
        ),
        network=_over_network(numeric, analysis, nominal, certify=certify, requested=margins),
        sensitivities=sensitivity_result,
        margins=nominal,
        contact_modes=modes,
        arbitrary_switching=switching,
        limit_cycle=limit_cycle,
        event_order=orders,
        order_warning=order_warning,
        box=robust_stability(model, box, cells=cells) if box else None,
        no_limit_cycle=no_limit_cycle,
        warnings=model.warnings,
    )


def _event_orders(
    numeric: NumericModel, analysis: Analysis, *, every: bool
) -> tuple[Result | None, str, tuple[Note, ...]]:
    """Return the analyses under every order of coincident events, a warning if they differ, and notes.

    The first is None unless every order is requested.
    """
    extension = require_extension("event_order") if every else find_extension("event_order")
    if extension is None:
        return None, "", (not_installed("event_order"),)
    orders = extension.event_order(numeric, default=analysis, quick=not every)
    if every:
        return orders, "", ()
    return None, orders.warning, (orders.not_repeated,) if orders.not_repeated else ()


def _published_conditions(model: Model) -> tuple[str, ...]:
    """Return the texts of published conditions; imported here, as few topologies have such parts."""
    from apc.haptics.published_limits import published_limits

    return published_limits(model)


def _over_network(
    numeric: NumericModel,
    analysis: Analysis,
    nominal: Margins,
    *,
    certify: bool,
    requested: bool | None,
) -> NetworkAnswer | None:
    """Return the result over the lossy network, None for an ideal one.

    The module is imported here, as most networks are ideal.
    """
    if all(link.channel is None for link in numeric.model.links):
        return None
    from apc.mean_square.mean_square_stability import mean_square_stability

    verdict = mean_square_stability(numeric, certify=certify)
    if verdict is None:
        return None
    if why := _too_large(numeric, analysis) or _too_many_products(numeric.model):
        return NetworkAnswer(verdict, _not_reported(0.0, why), Margins((), why))
    network_derivatives = network_sensitivities(numeric)
    if requested is False:
        return NetworkAnswer(verdict, network_derivatives, nominal)
    return NetworkAnswer(verdict, network_derivatives, network_margins(numeric, nominal, quick=not requested))


def _switching(numeric: NumericModel, modes: ContactModes) -> Result | None:
    """Return the result for arbitrary switching of contacts, None without the extension."""
    extension = find_extension("switching")
    if extension is None:
        return None
    result: Result = extension.arbitrary_switching(numeric, modes)
    return result


def _limit_cycle(numeric: NumericModel) -> tuple[Result | None, str]:
    """Return the predicted limit cycle of contacts, or None and the reason.

    Raises ApcError (E882) without the extension.
    """
    extension = require_extension("switching")
    try:
        return extension.limit_cycle(numeric), ""
    except ApcError as error:
        return None, error.mistakes[0].reason


def robust_stability(
    model: Model,
    box: Sequence[Range],
    *,
    passive: bool = False,
    cells: int | None = None,
    inside: float = 1.0,
) -> RobustStability:
    """Return the proof of stability over a box of parameters.

    The module of the proof is imported here, as it is rarely required.

    Parameters
    ----------
    model
        The model.
    box
        Ranges of parameters.
    passive
        Whether the criterion is stability with every passive hand, over the nominal network: only for ranges
        of a link's delay.
    cells
        The largest number of cells; by default a number that takes some seconds.
    inside
        The upper limit of the spectral radius, over a network with all packets on time.

    Raises
    ------
    ApcError
        As `robust_stability.prove_robust_stability`, or `mean_square_box.prove_mean_square` if links
        are, or may become, unreliable; E930 other ranges than a delay, with every passive hand; E882 without
        the extension.
    """
    from apc.network.nominal_criterion import channel_numbers, unreliable
    from apc.studies.representative_delays import is_delay

    if passive and not (len(box) == 1 and is_delay(model, box[0].free)):
        message = "with passive operators only a range of a link delay can be in a box"
        fix = "apc region --hands passive, or apc critical --hands passive"
        raise ApcError(Diagnostic("E930", SourceLocation("--box"), message, fix=fix))
    extension = require_extension("parameter_boxes")
    result: RobustStability
    if any(is_delay(model, interval.free) for interval in box):
        at_each = partial(proved_at, passive=passive, cells=cells, inside=inside)
        nominal = not passive and not unreliable(model)
        result = extension.prove_over_delay(model, box, at_each, nominal=nominal)
    elif unreliable(model) or any(interval.free.name in channel_numbers(model) for interval in box):
        result = extension.prove_mean_square(model, box, cells=cells)
    else:
        result = extension.prove_robust_stability(model, box, cells=cells, inside=inside)
    return result


def proved_at(
    model: Model,
    box: Sequence[Range],
    *,
    passive: bool = False,
    cells: int | None = None,
    inside: float = 1.0,
) -> RobustStability:
    """Return the proof over a box; for an empty box the verdict for the parameter values.

    Parameters
    ----------
    model, box, passive, cells, inside
        As for `robust_stability`.
    """
    if box:
        return robust_stability(model, box, passive=passive, cells=cells, inside=inside)
    from apc.network.nominal_criterion import unreliable

    verdict: Term
    if passive:
        from apc.haptics.absolute_stability import absolute_stability

        hands = absolute_stability(numeric_model(model))
        verdict, stable, limitations = hands.verdict, hands.stable, hands.limitations
    elif unreliable(model):
        from apc.mean_square.mean_square_stability import mean_square_stability

        numeric = numeric_model(model)
        network = mean_square_stability(numeric)
        assert network is not None, "a link is unreliable"
        verdict, stable, limitations = network.verdict, network.stable, near_start(numeric)
    else:
        analysis = analyze(numeric_model(model))
        verdict, stable, limitations = analysis.verdict, analysis.stable, analysis.limitations
        if stable and inside != 1 and not analysis.spectral_radius + analysis.spectral_radius_error < inside:
            stable = False if analysis.spectral_radius - analysis.spectral_radius_error >= inside else None
    return RobustStability(model.name, (), verdict, stable, 1, float(stable is None), (), (), limitations)


def sensitivities_of(numeric: NumericModel, analysis: Analysis) -> Sensitivities:
    """Return the sensitivities of an analysis, or an empty result with the reason.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    analysis
        The analysis of the model.
    """
    if why := _too_large(numeric, analysis) or _too_many_products(numeric.model):
        return _not_reported(analysis.spectral_radius, why)
    try:
        result = sensitivities(numeric, analysis=analysis)
    except ApcError as error:
        return _not_reported(analysis.spectral_radius, f"not computed: {error.mistakes[0].message}")
    # The matrices of the derivatives are rounded, the analysis is exact: both must have the same spectral
    # radius.
    difference = abs(result.radius - analysis.spectral_radius) - analysis.spectral_radius_error
    if result.active and not difference <= SAME_RADIUS * max(1.0, analysis.spectral_radius):
        why = "not computed: rounding dominates the derivative"
        return _not_reported(analysis.spectral_radius, why)
    return result


def _not_reported(radius: float, why: str) -> Sensitivities:
    """Return an empty result of sensitivities, with the reason."""
    return Sensitivities(radius, (), (), f"sensitivities {why}")


def _too_large(numeric: NumericModel, analysis: Analysis) -> str:
    """Return the reason for omitting margins; empty for few peers and short frames."""
    if why := _too_many_peers(numeric.model, analysis):
        return why
    ticks = max(sum(schedule.ticks) for schedule in numeric.schedules)
    if ticks > MOST_TICKS:
        return f"not computed: {ticks:,} ticks in a frame take too long"
    packets = max(len(schedule.received) for schedule in numeric.schedules)
    if packets > MOST_TICKS:
        return f"not computed: {packets:,} received packets in a frame take too long"
    return ""


def _too_many_peers(model: Model, analysis: Analysis) -> str:
    """Return the reason for omitting sensitivities; empty unless very many peers differ or are on a graph."""
    complete = all(link.graph.shape == "complete" for link in model.links)
    irregular = analysis.method == "determinant" or not complete
    return "not computed for a population of this size" if irregular and model.peers > FEW_PEERS else ""


def _too_many_products(model: Model) -> str:
    """Return the reason for omitting derivatives; empty unless parameters and states are very many."""
    free, states = len(varied(model)), max(len(peer_type.states) for peer_type in model.peer_types)
    if free * states**3 > MOST_PRODUCTS:
        return f"not computed: {free:,} parameters and {states:,} states take too long"
    return ""


def _margins(numeric: NumericModel, analysis: Analysis, *, requested: bool | None) -> Margins:
    """Return the stability margins, or an empty result with the reason."""
    if requested is False:
        return Margins((), "not requested")
    if analysis.stable is None or analysis.verdict is StabilityVerdict.UNSTABLE:
        return Margins((), NOT_STABLE.format("proved stable" if analysis.stable is None else "stable"))
    if why := _too_many_peers(numeric.model, analysis):
        return Margins((), why)
    try:
        known = None if analysis.method == PAPER else analysis  # its matrices are rounded
        return margins_of(numeric, quick=not requested, analysis=known)
    except ApcError as error:
        return Margins((), f"not computed: {error.mistakes[0].message}")


def _contact_modes(numeric: NumericModel) -> tuple[ContactModes | None, tuple[Note, ...]]:
    """Return the contact modes, None without contacts, and a note if they are not available."""
    try:
        modes = contact_modes(numeric)
    except ApcError as error:
        return None, (f"modes of contact: {error.mistakes[0].sentence}",)
    return (modes if modes.modes else None), ()
