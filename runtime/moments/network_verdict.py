"""Is a scene stable in mean square over the network that it has, lost and late packets included.

Takes: a `Model` whose links say loss, jitter or a trace.
Gives: `MeanSquareStability`, `judge_network`; `StabilityMeasure`, `growth`; `unreliable`.
Guarantees: a network that can't be judged is not: a note says by name why.
Does not: look at the nominal network (see `analysis`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from apc.analysis.elements import is_linear
from apc.analysis.sides import severity, sides
from apc.compiler.compiled import Link, Model
from apc.compiler.multiples import common_multiple
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.parameters import resolve
from apc.moments.almost_sure import TopLyapunovExponent, almost_sure
from apc.moments.bursts import tagged_error, tagged_radius
from apc.moments.copies_apart import forced, moments_error
from apc.moments.crowd import Moments, PerTickReception, build_hearing, crowd, peer_classes
from apc.moments.frames import LossyFrame, channels_of, held_frame, refuse_unheld, stand_in_frame
from apc.moments.operator import enclosed
from apc.moments.packet_memory import is_memoryless
from apc.moments.stand_in import stand_in
from apc.moments.traces import trace_radius
from apc.moments.worst import ConsecutiveLosses, worst_case
from apc.network.channel import LATEST, ChannelLaw
from apc.network.nominal import unreliable
from apc.result import Result
from apc.threads import single_threaded
from apc.unserved import NotSupportedError
from apc.verdict import NO_PROOF, ProofMethod, ProofOutcome, ProofScope, StabilityProof, Term

UNPROVED = "not proved: the radius is that of an iteration in floats"

# Peers whose bursts are followed with all tags, and with so many at most; the orders then compared.
EXACTLY_TAGGED, MOST_TAGGED, ORDERS = 4, 8, (2, 3)
ESTIMATE = f"an estimate: moments of at most {ORDERS[1]} channels' states together; with {ORDERS[0]}"

# Channels whose patterns are all looked at.
MOST_CHANNELS = 6

# Peers of which any number may be heard, one by one, where values stand in.
ENUMERATED = 4

# What an iteration leaves of an eigenvalue, relatively: 1e-13 asked for, and references met to 1e-11.
ITERATED = 1e-10
ROUNDED = 4e-15

# Covariances of luck times cubes of the means' states, up to which one growth takes some ten milliseconds.
QUICK = 200_000

# As much takes some ten seconds.
MOST_WORK = 20_000_000

# How many times what two estimates differ by counts as their error; what bounds may be apart at most.
DOUBTS, LOOSE = 10, 1e-9

# How near to 1 a growth leaves the digits of a root mean square error to rounding.
DOUBTFUL = 1e-9

# How much earlier than its nominal delay a jitter of 1 can make a packet.
EARLIEST = {"uniform": 1.0, "normal": LATEST["normal"], "pareto": 2 / 3}


class MeanSquareVerdict(Term):
    """The verdict on second moments; `PROBABLY` where the growth is an estimate."""

    STABLE = "stable in mean square"
    UNSTABLE = "unstable in mean square"
    PROBABLY_STABLE = "probably stable in mean square"
    PROBABLY_UNSTABLE = "probably unstable in mean square"
    UNDECIDED = "undecided"
    NOT_JUDGED = "not judged"


@dataclass(frozen=True, slots=True)
class MeanSquareStability(Result):
    """What becomes of a scene whose packets get lost or come late by chance.

    `mean_square_radius` is what second moments grow by in a frame, right to `error`; its root compares with
    the nominal spectral radius. `exact` is False where it is an estimate. `rms_error_m` is how far a copy is
    from the mean of the others, while every hand pushes with 1 N rms, anew at each tick. `almost_sure` is
    told where mean squares do not settle it, `losses_in_a_row` where packets get lost. None is what is not
    served, as `notes` say. `linearized`: the scene is not linear, and this holds near its start only.
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
    """One number, below 1 where a scene is stable, with bounds; an estimate where `exact` is False.

    Of a lossy network it is what second moments grow by in a frame, of passive hands what they can draw.

    `why` says why there is none, `note` what it is; `proved` that every rounding is in the bounds; `quick`
    that it took some milliseconds. `errors` works out how far copies are from each other.
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
def growth(system: Model, prepared: Prepared, *, bounded: bool = True) -> StabilityMeasure:
    """Return what second moments grow by in a frame, common translations left out.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it with any numbers.
    bounded
        Whether bounds are asked for; without them, they may be the radius itself.
    """
    try:
        each = [_growth(side.system, side.prepared, bounded) for side in sides(system, prepared)]
    except NotSupportedError as why:
        return StabilityMeasure(np.nan, 0.0, np.inf, False, str(why))
    return worst_growth(each)


def worst_growth(each: Sequence[StabilityMeasure]) -> StabilityMeasure:
    """Return the largest of several numbers, all of which have to be below 1."""
    largest = max(each, key=lambda growth: math.inf if math.isnan(growth.radius) else growth.radius)
    return replace(
        largest,
        low=max(growth.low for growth in each),
        high=max(growth.high for growth in each),
        exact=all(growth.exact for growth in each),
        proved=all(growth.proved for growth in each),
    )


def _growth(system: Model, prepared: Prepared, bounded: bool) -> StabilityMeasure:
    """Return `growth`, or raise why there is none."""
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
    """Return what second moments grow by over recorded delays."""
    result = trace_radius(system, prepared)

    def errors() -> tuple[float, str]:
        raise NotSupportedError("it is not worked out over recorded delays")

    radius, low, high = result.radius**2, result.low**2 * (1 - ROUNDED), result.high**2 * (1 + ROUNDED)
    if low > 1 or high < 1 or high - low < LOOSE:
        return StabilityMeasure(min(max(radius, low), high), low, high, True, proved=True, errors=errors)
    doubt = max(DOUBTS * 2 * result.radius * result.doubt, LOOSE)
    note = f"an estimate: bounds on the roundings of {result.frames:,} frames leave it open"
    return StabilityMeasure(radius, max(radius - doubt, 0.0), radius + doubt, False, note=note, errors=errors)


def _by_gain(system: Model, prepared: Prepared, first: Fraction | None, *, bounded: bool) -> StabilityMeasure:
    """Return what second moments grow by where packets are lost or late one by one.

    Parameters
    ----------
    system, prepared, bounded
        As for `growth`.
    first
        When packets are due, where the receiver's own value stands in for a missing one; None where what was
        heard last is held.
    """
    hearing = build_hearing(system, prepared, first=first or Fraction(0), stand_in=first is not None)

    def moments(hearing: PerTickReception) -> Moments:
        return crowd(system, hearing) if first is None else stand_in(system, hearing)

    def errors() -> tuple[float, str]:
        pushed = forced(system, hearing, first or Fraction(0))
        classes = pushed.of(peer_classes(pushed.hearing)[0].sites)
        return moments_error(moments(pushed.hearing), classes), ""

    of = moments(hearing)
    if of.entries * of.states**3 > MOST_WORK:
        raise NotSupportedError(
            f"{of.entries:,} covariances of random losses and delays that drive loops of {of.states} states "
            "would take minutes: fewer ticks at which a packet may arrive, a shorter delay, or fewer peers "
            "that differ"
        )
    inner = enclosed(of.operator, bounded=bounded)
    # Of many peers whose values stand in, the nodes of a quadrature are rounded.
    proved = first is None or system.peers <= ENUMERATED
    quick = proved if first is not None else of.entries * of.states**3 <= QUICK
    return StabilityMeasure(
        inner.radius, inner.low, inner.high, True, proved=proved, quick=quick, errors=errors
    )


def _by_tags(system: Model, prepared: Prepared, first: Fraction | None) -> StabilityMeasure:
    """Return what second moments grow by where losses come in bursts.

    Parameters
    ----------
    system, prepared, first
        As for `_by_gain`.
    """
    hearing = build_hearing(system, prepared, first=first or Fraction(0), stand_in=first is not None)
    complete = all(link.graph.shape == "complete" for link in system.links)
    alike = complete and len(system.groups) == 1 and not system.groups[0].columns
    channels = MOST_CHANNELS
    if first is None:
        refuse_unheld(system, hearing)
        links = [link for link in system.links if link.channel]
        channels = sum(channels_of(link, system.peers) for link in links)
        alike = alike and len(links) == 1 and system.peers <= MOST_TAGGED
        if not alike and channels > MOST_CHANNELS:
            what = f"followed are {MOST_CHANNELS}, or {MOST_TAGGED} equal peers that hold what they miss"
            raise NotSupportedError(f"bursts on {channels} ways: {what}")
    orders = (channels,) if system.peers <= EXACTLY_TAGGED or channels <= MOST_CHANNELS else ORDERS

    def frame(hearing: PerTickReception) -> LossyFrame:
        if first is None:
            return held_frame(system, hearing, alike=alike)
        return stand_in_frame(system, hearing, MOST_CHANNELS, alike=alike)

    def errors() -> tuple[float, str]:
        pushed = forced(system, hearing, first or Fraction(0))
        whole = frame(pushed.hearing)
        rough, *more = (tagged_error(whole, order, pushed.peer_by_peer()) for order in orders)
        return (more[0], f"{ESTIMATE} it is {rough:.9g} m") if more else (rough, "")

    whole = frame(hearing)
    rough, *more = (tagged_radius(whole, order) for order in orders)
    if not more:
        return StabilityMeasure(rough, rough * (1 - ITERATED), rough * (1 + ITERATED), True, errors=errors)
    off = abs(more[0] - rough)
    note = f"{ESTIMATE} the radius is {rough:.9g}"
    return StabilityMeasure(more[0], more[0] - off, more[0] + off, False, note=note, errors=errors)


def _unserved(system: Model, lossy: Sequence[tuple[Link, ChannelLaw]]) -> str:
    """Return what of the scene can't be judged, "" if all can."""
    if why := next((why for link, _ in lossy if (why := _asked_of_packets(system, link))), ""):
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


def _asked_of_packets(system: Model, link: Link) -> str:
    """Return what a scene asks of packets over a link beside what is in them, "" if nothing."""
    receives = [
        receive
        for kind in system.kinds
        for partition in kind.clocks
        for receive in partition.receives
        if receive.link == link.name
    ]
    if any(receive.age for receive in receives):
        return f"the age of what is heard over {link.name}, which is left to chance and enters the equations"
    if any(receive.before for receive in receives):
        return f"what was heard over {link.name} at the tick before"
    return ""


def _overtakes(system: Model, link: Link, law: ChannelLaw) -> bool:
    """Say whether a packet may arrive before one that was sent before it."""
    timings = resolve(system).timings
    period = next(timings[clock.period] for clock in system.clocks if clock.name == link.clock)
    least = max(law.delay - law.jitter * EARLIEST[law.distribution], 0.0)
    return law.longest - least >= float(period)


def _due(system: Model, lossy: Sequence[tuple[Link, ChannelLaw]]) -> Fraction:
    """Return when in a frame packets are due, or raise why there is no one instant."""
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


def judge_network(
    system: Model, prepared: Prepared | None = None, *, certify: bool = False
) -> MeanSquareStability | None:
    """Judge a scene over the network that it has, None where every packet takes its nominal delay.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with any numbers.
    certify
        Whether a proof is asked for: which numbers carry it.
    """
    if not unreliable(system):
        return None
    listed = sides(system, prepared or prepare(system))
    each = [_judge_network(side.system, side.prepared, certify=certify) for side in listed]
    return max(
        each,
        key=lambda verdict: severity(
            verdict.stable, math.nan if verdict.mean_square_radius is None else verdict.mean_square_radius
        ),
    )


def _judge_network(system: Model, prepared: Prepared, *, certify: bool) -> MeanSquareStability:
    """Judge a scene without kinks whose packets get lost or come late by chance."""
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        result = growth(system, prepared)
        lost = [link for link, law in unreliable(system) if law.mean_loss]
        followed = lost and not any(_asked_of_packets(system, link) for link in lost)
        worst = worst_case(system, prepared) if followed else None
        surely, unsure = _almost_sure(system, prepared, result)
        metres, unmeasured = _rms_error(result)
        linear = is_linear(system, prepared)
    judged = bool(np.isfinite(result.radius))
    decided = judged and result.stable is not None
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
        stable=result.stable if judged else None,
        mean_square_radius=result.radius if judged else None,
        error=max(result.high - result.radius, result.radius - result.low) if judged else None,
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
    """Return the error of copies where second moments die out, and what there is to say of it."""
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
        return MeanSquareVerdict.NOT_JUDGED
    if growth.stable is None:
        return MeanSquareVerdict.UNDECIDED
    if growth.exact:
        return MeanSquareVerdict.STABLE if growth.stable else MeanSquareVerdict.UNSTABLE
    return MeanSquareVerdict.PROBABLY_STABLE if growth.stable else MeanSquareVerdict.PROBABLY_UNSTABLE


def _almost_sure(
    system: Model, prepared: Prepared, growth: StabilityMeasure
) -> tuple[TopLyapunovExponent | None, str]:
    """Return how a scene settles almost surely where mean squares leave it open, or why that is not told."""
    if growth.why or growth.stable:  # what settles in mean square settles almost surely
        return None, ""
    try:
        return almost_sure(system, prepared), ""
    except NotSupportedError as why:
        return None, f"almost surely: {why}"
