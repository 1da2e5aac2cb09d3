"""Mean-square stability of a model over its network, with lost and late packets.

Takes: a `Model` whose links have loss, jitter or a trace.
Gives: `MeanSquareStability`, `mean_square_stability`; `MeanSquareVerdict`, `verdict_of`; `StabilityMeasure`,
`mean_square_growth`, `worst_mean_square_growth`.
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
from apc.compiler.multiples import common_multiple
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.parameters import resolve
from apc.mean_square.class_moments import (
    Moments,
    PerTickReception,
    build_reception,
    class_moments,
    peer_classes,
)
from apc.mean_square.copy_error import forced, moments_error
from apc.mean_square.dropout_bounds import ConsecutiveLosses, worst_case
from apc.mean_square.gilbert_elliott import tagged_error, tagged_radius
from apc.mean_square.loss_patterns import (
    LossyFrame,
    channels_of,
    hold_frame,
    refuse_unheld,
    substitution_frame,
)
from apc.mean_square.lyapunov_exponent import TopLyapunovExponent, top_lyapunov_exponent
from apc.mean_square.periodic_delays import trace_radius
from apc.mean_square.receiver_memory import is_memoryless
from apc.mean_square.second_moment_operator import enclosed
from apc.mean_square.self_substitution import self_substitution
from apc.network.channel import LATEST, ChannelLaw
from apc.network.nominal_criterion import unreliable
from apc.not_supported import NotSupportedError
from apc.result import Result
from apc.threads import single_threaded
from apc.verdict import NO_PROOF, ProofMethod, ProofOutcome, ProofScope, StabilityProof, Term

UNPROVED = "not proved: the radius is that of an iteration in floats"

# Number of peers whose bursts are analyzed with all tags, and the largest number of tags; the two orders that
# are compared.
EXACTLY_TAGGED, MOST_TAGGED, ORDERS = 4, 8, (2, 3)
ESTIMATE = f"an estimate: moments of at most {ORDERS[1]} channels' states together; with {ORDERS[0]}"

# Number of channels up to which all loss patterns are enumerated.
MOST_CHANNELS = 6

# Number of peers with own-value substitution for which every number of received packets is enumerated.
ENUMERATED = 4

# Relative error of an eigenvalue by iteration: tolerance 1e-13; references agree to 1e-11.
ITERATED = 1e-10
ROUNDED = 4e-15

# Noise covariances times cubes of the mean order, up to which one growth evaluation takes some ten
# milliseconds.
QUICK = 200_000

# As much takes some ten seconds.
MOST_WORK = 20_000_000

# Factor from the difference of two estimates to the reported error; largest distance of bounds.
UNCERTAINTIES, LOOSE = 10, 1e-9

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

    `mean_square_radius` is the growth factor of second moments per frame, right to `error`; its root
    compares with the nominal spectral radius. `exact` is False where it is an estimate. `rms_error_m` is the
    deviation of a copy from the mean of the others, under independent hand forces of 1 N rms at each tick.
    `top_lyapunov_exponent` is told where mean squares do not settle it, `losses_in_a_row` where packets get
    lost. None means not supported, see `notes`. `linearized`: the topology is not linear, and this holds
    near its start only.
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
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StabilityMeasure:
    """A stability measure, below 1 for a stable model, with bounds; an estimate if `exact` is False.

    For a lossy network it is the growth factor of second moments per frame, for passive hands the energy they
    can extract.

    `why` is the reason for a missing value, `note` the description. `proved` is whether the bounds include
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
        """Whether it is below 1, None where bounds leave it open."""
        return True if self.high < 1 else False if self.low > 1 else None


@np.errstate(all="ignore")
def mean_square_growth(system: Model, prepared: Prepared, *, bounded: bool = True) -> StabilityMeasure:
    """Return the growth factor of second moments per frame, common translations excluded.

    Parameters
    ----------
    system, prepared
        The model, and the result of `numeric_model.prepare` with any values.
    bounded
        Whether bounds are computed; without, they may be the radius itself.
    """
    try:
        each = [_mean_square_growth(side.system, side.prepared, bounded) for side in sides(system, prepared)]
    except NotSupportedError as why:
        return StabilityMeasure(np.nan, 0.0, np.inf, False, str(why))
    return worst_mean_square_growth(each)


def worst_mean_square_growth(each: Sequence[StabilityMeasure]) -> StabilityMeasure:
    """Return the largest of several growth factors, all of which must be below 1."""
    largest = max(each, key=lambda growth: math.inf if math.isnan(growth.radius) else growth.radius)
    return replace(
        largest,
        low=max(growth.low for growth in each),
        high=max(growth.high for growth in each),
        exact=all(growth.exact for growth in each),
        proved=all(growth.proved for growth in each),
    )


def _mean_square_growth(system: Model, prepared: Prepared, bounded: bool) -> StabilityMeasure:
    """Return `mean_square_growth`; raise `NotSupportedError` if there is none."""
    lossy = unreliable(system)
    if why := _unserved(system, lossy):
        raise NotSupportedError(why)
    if any(law.trace is not None for _, law in lossy):
        return _over_trace(system, prepared)
    holding = {link.channel.on_loss == "hold" for link, law in lossy if link.channel and law.mean_loss}
    memoryless = all(is_memoryless(law) for _, law in lossy)
    if memoryless and holding <= {True}:
        return _by_gain(system, prepared, None, bounded=bounded)
    if any(law.jitter for _, law in lossy):
        raise NotSupportedError(
            "jitter beside losses of another link that come in bursts or with on_loss: zero"
        )
    if holding == {True}:
        return _by_tags(system, prepared, None)
    first = _due(system, lossy)
    if memoryless:
        return _by_gain(system, prepared, first, bounded=bounded)
    return _by_tags(system, prepared, first)


def _over_trace(system: Model, prepared: Prepared) -> StabilityMeasure:
    """Return the growth factor of second moments over recorded delays."""
    result = trace_radius(system, prepared)

    def errors() -> tuple[float, str]:
        raise NotSupportedError("it is not worked out over recorded delays")

    radius, low, high = result.radius**2, result.low**2 * (1 - ROUNDED), result.high**2 * (1 + ROUNDED)
    if low > 1 or high < 1 or high - low < LOOSE:
        return StabilityMeasure(min(max(radius, low), high), low, high, True, proved=True, errors=errors)
    uncertainty = max(UNCERTAINTIES * 2 * result.radius * result.uncertainty, LOOSE)
    note = f"an estimate: bounds on the roundings of {result.frames:,} frames leave it open"
    return StabilityMeasure(
        radius, max(radius - uncertainty, 0.0), radius + uncertainty, False, note=note, errors=errors
    )


def _by_gain(system: Model, prepared: Prepared, first: Fraction | None, *, bounded: bool) -> StabilityMeasure:
    """Return the growth factor of second moments under independent losses or delays.

    Parameters
    ----------
    system, prepared, bounded
        As for `mean_square_growth`.
    first
        The nominal arrival time if the receiver substitutes its own value for a missing one; None if the last
        received value is held.
    """
    reception = build_reception(system, prepared, first=first or Fraction(0), stand_in=first is not None)

    def moments(reception: PerTickReception) -> Moments:
        return class_moments(system, reception) if first is None else self_substitution(system, reception)

    def errors() -> tuple[float, str]:
        pushed = forced(system, reception, first or Fraction(0))
        classes = pushed.of(peer_classes(pushed.reception)[0].subsystems)
        return moments_error(moments(pushed.reception), classes), ""

    of = moments(reception)
    if of.entries * of.states**3 > MOST_WORK:
        raise NotSupportedError(
            f"{of.entries:,} covariances of random losses and delays that drive loops of {of.states} states "
            "would take minutes: fewer ticks at which a packet may arrive, a shorter delay, or fewer peers "
            "that differ"
        )
    inner = enclosed(of.operator, bounded=bounded)
    # With many peers and own-value substitution the quadrature nodes are rounded.
    proved = first is None or system.peers <= ENUMERATED
    quick = proved if first is not None else of.entries * of.states**3 <= QUICK
    return StabilityMeasure(
        inner.radius, inner.low, inner.high, True, proved=proved, quick=quick, errors=errors
    )


def _by_tags(system: Model, prepared: Prepared, first: Fraction | None) -> StabilityMeasure:
    """Return the growth factor of second moments under burst losses.

    Parameters
    ----------
    system, prepared, first
        As for `_by_gain`.
    """
    reception = build_reception(system, prepared, first=first or Fraction(0), stand_in=first is not None)
    complete = all(link.graph.shape == "complete" for link in system.links)
    interchangeable = complete and len(system.groups) == 1 and not system.groups[0].columns
    channels = MOST_CHANNELS
    if first is None:
        refuse_unheld(system, reception)
        links = [link for link in system.links if link.channel]
        channels = sum(channels_of(link, system.peers) for link in links)
        interchangeable = interchangeable and len(links) == 1 and system.peers <= MOST_TAGGED
        if not interchangeable and channels > MOST_CHANNELS:
            message = f"followed are {MOST_CHANNELS}, or {MOST_TAGGED} equal peers that hold what they miss"
            raise NotSupportedError(f"bursts on {channels} ways: {message}")
    orders = (channels,) if system.peers <= EXACTLY_TAGGED or channels <= MOST_CHANNELS else ORDERS

    def frame(reception: PerTickReception) -> LossyFrame:
        if first is None:
            return hold_frame(system, reception, interchangeable=interchangeable)
        return substitution_frame(system, reception, MOST_CHANNELS, interchangeable=interchangeable)

    def errors() -> tuple[float, str]:
        pushed = forced(system, reception, first or Fraction(0))
        whole = frame(pushed.reception)
        rough, *more = (tagged_error(whole, order, pushed.peer_by_peer()) for order in orders)
        return (more[0], f"{ESTIMATE} it is {rough:.9g} m") if more else (rough, "")

    whole = frame(reception)
    rough, *more = (tagged_radius(whole, order) for order in orders)
    if not more:
        return StabilityMeasure(rough, rough * (1 - ITERATED), rough * (1 + ITERATED), True, errors=errors)
    error_bound = abs(more[0] - rough)
    note = f"{ESTIMATE} the radius is {rough:.9g}"
    return StabilityMeasure(
        more[0], more[0] - error_bound, more[0] + error_bound, False, note=note, errors=errors
    )


def _unserved(system: Model, lossy: Sequence[tuple[Link, ChannelLaw]]) -> str:
    """Return the unsupported features of the model, "" if none."""
    if why := next((why for link, _ in lossy if (why := _other_coupling(system, link))), ""):
        return why
    if any(law.trace is not None for _, law in lossy):
        if not all(law.trace is not None for _, law in lossy):
            return "recorded delays beside links whose packets get lost or come late by chance"
        if any(law.trace is not None and not np.isfinite(law.trace).any() for _, law in lossy):
            return "a trace of losses only: nothing is ever heard"
        if any(
            link.channel is not None and link.channel.on_loss == "zero"
            for link, law in lossy
            if law.mean_loss
        ):
            return "recorded losses with on_loss: zero"
        return ""
    for link, law in lossy:
        assert link.channel is not None
        if law.r == 0 and law.p and not is_memoryless(law):
            return f"bursts of {link.name} that never end (r = 0): in the long run everything is lost"
        if law.mean_loss >= 1:
            return f"{link.name} loses everything: nothing is ever heard, and what is held never changes"
        if law.jitter and law.mean_loss and link.channel.on_loss == "zero":
            return f"jitter and losses of {link.name} together with on_loss: zero"
        if law.jitter and not is_memoryless(law):
            return f"jitter and bursts of {link.name} together"
        if law.jitter and link.channel.reorder == "all" and _overtakes(system, link, law):
            return f"packets of {link.name} that are overtaken and count all the same (reorder: all)"
    return ""


def _other_coupling(system: Model, link: Link) -> str:
    """Return the coupling of a model over a link besides packet contents, "" if there is none."""
    receives = [
        receive
        for peer_type in system.peer_types
        for partition in peer_type.clocks
        for receive in partition.receives
        if receive.link == link.name
    ]
    if any(receive.age for receive in receives):
        return f"the age of what is heard over {link.name}, which is left to chance and enters the equations"
    if any(receive.before for receive in receives):
        return f"what was heard over {link.name} at the tick before"
    return ""


def _overtakes(system: Model, link: Link, law: ChannelLaw) -> bool:
    """Return whether a packet may arrive before an earlier-sent one."""
    timings = resolve(system).timings
    period = next(timings[clock.period] for clock in system.clocks if clock.name == link.clock)
    least = max(law.delay - law.jitter * EARLIEST[law.distribution], 0.0)
    return law.longest - least >= float(period)


def _due(system: Model, lossy: Sequence[tuple[Link, ChannelLaw]]) -> Fraction:
    """Return the arrival time of packets in a frame, or raise the reason why it is not unique."""
    timings = resolve(system).timings
    clocks = {clock.name: clock for clock in system.clocks}
    if len(system.links) > 1 or system.links[0].delays:
        raise NotSupportedError("values that stand in beside packets of another link or delay")
    link = lossy[0][0]
    period, phase = timings[clocks[link.clock].period], timings[clocks[link.clock].phase]
    frame = common_multiple([timings[clock.period] for clock in system.clocks])
    if frame != period:
        raise NotSupportedError(f"a frame of {float(frame) * 1e3:.6g} ms with several packets of {link.name}")
    return (phase + timings[link.delay]) % period


def mean_square_stability(
    system: Model, prepared: Prepared | None = None, *, certify: bool = False
) -> MeanSquareStability | None:
    """Judge a model over the network that it has, None where every packet takes its nominal delay.

    Parameters
    ----------
    system
        The model, with the parameter values to analyze.
    prepared
        From `numeric_model.prepare`, of this model with any parameter values.
    certify
        Whether a proof is asked for: which numbers carry it.
    """
    if not unreliable(system):
        return None
    listed = sides(system, prepared or prepare(system))
    each = [_mean_square_stability(side.system, side.prepared, certify=certify) for side in listed]
    return max(
        each,
        key=lambda verdict: severity(
            verdict.stable, math.nan if verdict.mean_square_radius is None else verdict.mean_square_radius
        ),
    )


def _mean_square_stability(system: Model, prepared: Prepared, *, certify: bool) -> MeanSquareStability:
    """Judge a model without kinks whose packets get lost or come late by chance."""
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        result = mean_square_growth(system, prepared)
        lost = [link for link, law in unreliable(system) if law.mean_loss]
        followed = lost and not any(_other_coupling(system, link) for link in lost)
        worst = worst_case(system, prepared) if followed else None
        surely, unsure = _almost_sure(system, prepared, result)
        metres, unmeasured = _rms_error(result)
        linear = is_linear(system, prepared)
    decided_network = bool(np.isfinite(result.radius))
    decided = decided_network and result.stable is not None
    notes = (
        result.why and f"not judged: {result.why}",
        UNPROVED if certify and decided and not result.proved else "",
        result.note,
        unsure,
        unmeasured and f"root mean square error of copies: {unmeasured}",
        worst.note if worst is not None else "",
    )
    return MeanSquareStability(
        topology=system.name,
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
        rms_error_m=metres,
        almost_sure=surely,
        losses_in_a_row=worst,
        linearized=not linear,
        notes=tuple(text for text in notes if text),
    )


def _rms_error(growth: StabilityMeasure) -> tuple[float | None, str]:
    """Return the copy error if second moments decay, and notes on it."""
    if not growth.stable or growth.errors is None:
        return None, "" if growth.why else "only where second moments die out"
    if growth.high > 1 - DOUBTFUL:
        return None, "rounding leaves its digits in doubt"
    try:
        return growth.errors()
    except NotSupportedError as why:
        return None, str(why)


def verdict_of(growth: StabilityMeasure) -> MeanSquareVerdict:
    """Return the verdict on second moments of this growth."""
    if not np.isfinite(growth.radius):
        return MeanSquareVerdict.NOT_DECIDED
    if growth.stable is None:
        return MeanSquareVerdict.UNDECIDED
    if growth.exact:
        return MeanSquareVerdict.STABLE if growth.stable else MeanSquareVerdict.UNSTABLE
    return MeanSquareVerdict.PROBABLY_STABLE if growth.stable else MeanSquareVerdict.PROBABLY_UNSTABLE


def _almost_sure(
    system: Model, prepared: Prepared, growth: StabilityMeasure
) -> tuple[TopLyapunovExponent | None, str]:
    """Return the top Lyapunov exponent if mean squares are inconclusive, or the reason for its absence."""
    if growth.why or growth.stable:  # mean-square stability implies almost sure stability
        return None, ""
    try:
        return top_lyapunov_exponent(system, prepared), ""
    except NotSupportedError as why:
        return None, f"almost surely: {why}"
