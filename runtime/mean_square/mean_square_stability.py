"""Mean-square stability of a model over its network, with lost and late packets.

Takes: a `NumericModel` whose links have loss, jitter or a trace.
Gives: `MeanSquareStability`, `mean_square_stability`; `MeanSquareVerdict`, `verdict_of`; `StabilityMeasure`,
`mean_square_growth`, `independent_channels`, `independent_growth`, `worst_mean_square_growth`.
Guarantees: a network that is not supported has no verdict; a note gives the reason.
Does not: analyze the nominal network (see `analysis`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from apc.analysis.nonlinear_elements import is_linear
from apc.analysis.one_sided_slopes import severity, sides
from apc.compiler.compiled import Link, Model
from apc.lifting.model_numbers import cached_in_model
from apc.lifting.numeric_model import NumericModel
from apc.linearization.evaluation_errors import evaluating
from apc.mean_square.class_moments import (
    Moments,
    PerTickReception,
    build_reception,
    class_moments,
    common_modal_system,
)
from apc.mean_square.copy_error import forced, moments_error
from apc.mean_square.loss_results import ConsecutiveLosses, TopLyapunovExponent
from apc.mean_square.receiver_memory import is_memoryless
from apc.mean_square.second_moment_operator import enclose_growth
from apc.network.channel import LATEST, ChannelLaw
from apc.network.nominal_criterion import unreliable
from apc.parameter_values.parameters import resolve
from apc.result import Result
from apc.support.extension_table import find_extension, not_installed
from apc.support.not_supported import NotSupportedError
from apc.verdict import NO_PROOF, ProofMethod, ProofOutcome, ProofScope, StabilityProof, Term

UNPROVED = "not proved: the growth is from a floating-point iteration"

# Noise covariances times cubes of the mean order, up to which one growth evaluation takes some ten
# milliseconds.
QUICK = 200_000

# As much takes some ten seconds.
MOST_WORK = 20_000_000

# The distance of a growth from 1 at which rounding dominates the root mean square error.
DOUBTFUL = 1e-9

# The largest advance of a packet before its nominal delay, at a jitter of 1.
EARLIEST = {"uniform": 1.0, "normal": LATEST["normal"], "pareto": 2 / 3}


class MeanSquareVerdict(Term):
    """The verdict on second moments; `PROBABLY_STABLE` or `PROBABLY_UNSTABLE` by an estimated growth."""

    STABLE = "stable in mean square"
    UNSTABLE = "unstable in mean square"
    PROBABLY_STABLE = "probably stable in mean square"
    PROBABLY_UNSTABLE = "probably unstable in mean square"
    UNDECIDED = "undecided"
    NOT_DECIDED = "not judged"


@dataclass(frozen=True, slots=True)
class MeanSquareStability(Result):
    """The mean-square stability of a topology with random packet losses or delays.

    `mean_square_radius` is the growth factor of second moments per frame, with the error bound `error`; its
    square root compares with the nominal spectral radius. `exact` is False if it is an estimate.
    `rms_error_m` is the deviation of a copy from the mean of the others, under independent hand forces of 1 N
    rms at each tick. `almost_sure` is the top Lyapunov exponent if mean squares are inconclusive,
    `losses_in_a_row` the worst case if packets get lost. None means not supported (see `notes`). `linearized`
    states that the topology is not linear, and that the result holds near its start only.
    """

    shown_by = "network_output:network"

    topology: str
    verdict: MeanSquareVerdict
    stable: bool | None
    mean_square_radius: float | None
    error: float | None
    exact: bool
    proof: StabilityProof
    rms_error_m: float | None
    almost_sure: TopLyapunovExponent | None
    losses_in_a_row: ConsecutiveLosses | None
    linearized: bool
    at_equilibrium: bool
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StabilityMeasure:
    """A stability measure, below 1 for a stable model, with bounds; an estimate if `exact` is False.

    For a lossy network it is the growth factor of second moments per frame, for passive hands the energy they
    can extract.

    `why` is the reason for a missing value, `note` a remark. `proved` states whether the bounds include
    all rounding, `quick` whether an evaluation takes some milliseconds. `errors` computes the copy errors.
    """

    radius: float
    low: float
    high: float
    exact: bool
    why: str = ""
    note: str = ""
    proved: bool = False
    quick: bool = False
    errors: Callable[[], tuple[float, str]] | None = None

    @property
    def stable(self) -> bool | None:
        """Whether the measure is below 1, None if the bounds leave it undecided."""
        return True if self.high < 1 else False if self.low > 1 else None


@np.errstate(all="ignore")
@cached_in_model
def mean_square_growth(numeric: NumericModel, *, bounded: bool = True) -> StabilityMeasure:
    """Return the growth factor of second moments per frame, common translations excluded.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    bounded
        Whether bounds are computed; otherwise they may be equal to the radius.
    """
    try:
        each = [_mean_square_growth(side.numeric, bounded) for side in sides(numeric)]
    except NotSupportedError as why:
        return StabilityMeasure(np.nan, 0.0, np.inf, False, str(why))
    return worst_mean_square_growth(each)


def worst_mean_square_growth(each: Sequence[StabilityMeasure]) -> StabilityMeasure:
    """Return the largest of several growth factors, with bounds on the largest."""
    largest = max(each, key=lambda growth: math.inf if math.isnan(growth.radius) else growth.radius)
    return replace(
        largest,
        low=max(growth.low for growth in each),
        high=max(growth.high for growth in each),
        exact=all(growth.exact for growth in each),
        proved=all(growth.proved for growth in each),
    )


def _mean_square_growth(numeric: NumericModel, bounded: bool) -> StabilityMeasure:
    """Return `mean_square_growth` of a model without kinks.

    Raises
    ------
    NotSupportedError
        The network is not supported.
    """
    model = numeric.model
    lossy = unreliable(model)
    if why := _reason_not_supported(model, lossy):
        raise NotSupportedError(why)
    if independent_channels(model):
        reception = build_reception(numeric, first=Fraction(0), stand_in=False)
        return independent_growth(model, reception, class_moments, bounded=bounded)
    extension = find_extension("loss_models")
    if extension is None:
        raise NotSupportedError(str(not_installed("loss_models")))
    growth: StabilityMeasure = extension.channel_growth(numeric, lossy, bounded=bounded)
    return growth


def independent_channels(model: Model) -> bool:
    """Return whether all packets are lost or delayed independently, a lost one being replaced by the last."""
    lossy = unreliable(model)
    return not _reason_not_supported(model, lossy) and all(
        law.trace is None and is_memoryless(law) and not (law.mean_loss and law.zero) for _, law in lossy
    )


def independent_growth(
    model: Model,
    reception: PerTickReception,
    moments: Callable[[Model, PerTickReception], Moments],
    *,
    arrival: Fraction = Fraction(0),
    bounded: bool,
) -> StabilityMeasure:
    """Return the growth factor of second moments under independent losses or delays.

    Parameters
    ----------
    model, reception
        The model, and its receptions by tick.
    moments
        The function that returns the second-moment operator of the peers.
    arrival
        The nominal arrival time in a frame, in seconds, if the receiver substitutes its own value.
    bounded
        As for `mean_square_growth`.
    """

    def errors() -> tuple[float, str]:
        """Return the copy error in m, and a note."""
        pushed = forced(model, reception, arrival)
        classes = pushed.of(common_modal_system(pushed.reception)[0].peer_classes)
        return moments_error(moments(model, pushed.reception), classes), ""

    of = moments(model, reception)
    if of.entries * of.states**3 > MOST_WORK:
        raise NotSupportedError(
            f"{of.entries:,} covariances of losses and delays with {of.states} states take too long; "
            "reduce the jitter, the delay or the number of different peers"
        )
    inner = enclose_growth(of.operator, bounded=bounded)
    quick = of.entries * of.states**3 <= QUICK
    return StabilityMeasure(
        inner.radius, inner.low, inner.high, True, proved=bounded, quick=quick, errors=errors
    )


def _reason_not_supported(model: Model, lossy: Sequence[tuple[Link, ChannelLaw]]) -> str:
    """Return the reason why a network is not supported, "" if it is supported."""
    if why := next((why for link, _ in lossy if (why := _other_coupling(model, link))), ""):
        return why
    for link in model.links:  # also where no packet is lost at the present values
        if link.graph.shape == "arcs" and (link.graph.arcs[:, 0] == link.graph.arcs[:, 1]).any():
            return f"packets of {link.name} that a peer sends to itself"
    if any(law.trace is not None for _, law in lossy):
        if not all(law.trace is not None for _, law in lossy):
            return "recorded delays together with random loss or jitter of another link"
        if any(law.trace is not None and not np.isfinite(law.trace).any() for _, law in lossy):
            return "the trace has only losses"
        if any(law.mean_loss and law.zero for _, law in lossy):
            return "recorded losses with on_loss: zero"
        return ""
    for link, law in lossy:
        assert link.channel is not None
        if law.r == 0 and law.p and not is_memoryless(law):
            return f"bursts of {law.label} without end (r = 0), so eventually every packet is lost"
        if law.mean_loss >= 1:
            return f"every packet of {law.label} is lost, so the received values never change"
        if law.jitter and law.mean_loss and law.zero:
            return f"jitter and losses of {law.label} together with on_loss: zero"
        if law.jitter and not is_memoryless(law):
            return f"jitter and bursts of {law.label} together"
        if law.jitter and link.channel.reorder == "all" and _overtakes(model, link, law):
            return f"reordered packets of {law.label} that are accepted (reorder: all)"
    return ""


def _other_coupling(model: Model, link: Link) -> str:
    """Return the use of ages or earlier packets of a link in the equations, as a text; "" without any."""
    receives = [
        receive
        for peer_type in model.peer_types
        for partition in peer_type.clocks
        for receive in partition.receives
        if receive.link == link.name
    ]
    if any(receive.age for receive in receives):
        return f"the random age of packets of {link.name}, which enters the equations"
    if any(receive.before for receive in receives):
        return f"packets of {link.name} from the previous tick"
    return ""


def _overtakes(model: Model, link: Link, law: ChannelLaw) -> bool:
    """Return whether a packet may arrive before a packet sent earlier."""
    timings = resolve(model).timings
    period = min(timings[clock.period] for clock in model.clocks if clock.name in link.clocks)
    least = max(law.delay - law.jitter * EARLIEST[law.distribution], 0.0)
    return law.longest - least >= float(period)


def mean_square_stability(numeric: NumericModel, *, certify: bool = False) -> MeanSquareStability | None:
    """Return the mean-square stability of a model over its network.

    The result is None if every packet has its nominal delay.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    certify
        Whether a proof is requested: the result then states the proof, or that it failed.
    """
    if not unreliable(numeric.model):
        return None
    kink_sides = sides(numeric)
    each = [_mean_square_stability(side.numeric, certify=certify) for side in kink_sides]
    return max(
        each,
        key=lambda verdict: severity(
            verdict.stable, math.nan if verdict.mean_square_radius is None else verdict.mean_square_radius
        ),
    )


def _mean_square_stability(numeric: NumericModel, *, certify: bool) -> MeanSquareStability:
    """Return the mean-square stability of a model without kinks."""
    model = numeric.model
    with evaluating(model):
        result = mean_square_growth(numeric)
        lossy_links = [link for link, law in unreliable(model) if law.mean_loss]
        has_worst_case = lossy_links and not any(_other_coupling(model, link) for link in lossy_links)
        extension = find_extension("loss_models")
        worst = extension.worst_case(numeric) if extension and has_worst_case else None
        exponent, exponent_note = _lyapunov_exponent(numeric, result)
        error_m, unmeasured = _rms_error(result)
        linear = is_linear(numeric)
    decided_network = bool(np.isfinite(result.radius))
    decided = decided_network and result.stable is not None
    notes = (
        result.why and f"not judged: {result.why}",
        UNPROVED if certify and decided and not result.proved else "",
        result.note,
        exponent_note,
        unmeasured and f"coordination error not available: {unmeasured}",
        worst.note if worst is not None else "",
        "" if extension else str(not_installed("loss_models")),
    )
    return MeanSquareStability(
        topology=model.name,
        verdict=verdict_of(result),
        stable=result.stable if decided_network else None,
        mean_square_radius=result.radius if decided_network else None,
        error=max(result.high - result.radius, result.radius - result.low) if decided_network else None,
        exact=result.exact,
        proof=StabilityProof(
            ProofMethod.ROUNDED,
            outcome=ProofOutcome.STABLE if result.stable else ProofOutcome.UNSTABLE,
            scope=(ProofScope.MEAN_SQUARE,),
        )
        if certify and decided and result.proved
        else NO_PROOF,
        rms_error_m=error_m,
        almost_sure=exponent,
        losses_in_a_row=worst,
        linearized=not linear,
        at_equilibrium=model.at_equilibrium,
        notes=tuple(text for text in notes if text),
    )


def _rms_error(growth: StabilityMeasure) -> tuple[float | None, str]:
    """Return the copy error in m if second moments decay, else None, and a note."""
    if not growth.stable or growth.errors is None:
        return None, "" if growth.why else "available only if second moments decay"
    if growth.high > 1 - DOUBTFUL:
        return None, "rounding exceeds the required accuracy"
    try:
        return growth.errors()
    except NotSupportedError as why:
        return None, str(why)


def verdict_of(growth: StabilityMeasure) -> MeanSquareVerdict:
    """Return the verdict on second moments for a growth factor with bounds."""
    if not np.isfinite(growth.radius):
        return MeanSquareVerdict.NOT_DECIDED
    if growth.stable is None:
        return MeanSquareVerdict.UNDECIDED
    if growth.exact:
        return MeanSquareVerdict.STABLE if growth.stable else MeanSquareVerdict.UNSTABLE
    return MeanSquareVerdict.PROBABLY_STABLE if growth.stable else MeanSquareVerdict.PROBABLY_UNSTABLE


def _lyapunov_exponent(
    numeric: NumericModel, growth: StabilityMeasure
) -> tuple[TopLyapunovExponent | None, str]:
    """Return the top Lyapunov exponent if mean squares are inconclusive, else None, and a note on a
    missing value.
    """
    if growth.why or growth.stable:  # mean-square stability implies almost sure stability
        return None, ""
    extension = find_extension("loss_models")
    if extension is None:
        return None, ""
    try:
        return extension.top_lyapunov_exponent(numeric), ""
    except NotSupportedError as why:
        return None, f"almost surely: {why}"
