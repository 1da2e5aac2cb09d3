"""Is a scene stable in mean square over the network that it has, lost and late packets included.

Takes: a `CompiledSystem` whose links say loss, jitter or a trace.
Gives: `NetworkVerdict`, `judge_network`; `Growth`, `growth`; `unreliable`.
Guarantees: a network that can't be judged is not: a note says by name why.
Does not: look at the nominal network (see `analysis`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np

from apc.analysis.analysis import Prepared, prepare
from apc.compiler.compiled import CompiledSystem, Link
from apc.compiler.multiples import common_multiple
from apc.finite_equations import finite_equations
from apc.frame.exchange import arcs
from apc.frame.parameters import resolve
from apc.moments.almost_sure import AlmostSure, almost_sure, unplayed
from apc.moments.bursts import tagged_radius
from apc.moments.crowd import crowd
from apc.moments.errors import Told, crowd_error, pattern_error, standing_error, tagged_error
from apc.moments.gains import gain_of, mean_square_radius, too_much
from apc.moments.memory import is_memoryless
from apc.moments.patterns import MOST_CHANNELS, pattern_radius, patterns
from apc.moments.stand_in import stand_in
from apc.moments.traces import trace_radius
from apc.moments.worst import LossesInARow, worst_case
from apc.network.channel import LATEST, ChannelLaw, channel_law
from apc.result import Result
from apc.threads import single_threaded

STABLE = "stable in mean square"
UNSTABLE = "unstable in mean square"
UNDECIDED = "undecided"
NOT_JUDGED = "not judged"

STABLE_PROVED = "proved stable in mean square, by floats whose every rounding is bounded"
UNSTABLE_PROVED = "proved unstable in mean square, by floats whose every rounding is bounded"
UNPROVED = "not proved: the radius is that of an iteration in floats"

# Peers whose bursts are followed with all tags, and with so many at most; the orders then compared.
EXACTLY_TAGGED, MOST_TAGGED, ORDERS = 4, 8, (2, 3)

# Peers of which any number may be heard, one by one, where values stand in.
ENUMERATED = 4

# What an iteration leaves of an eigenvalue, relatively: 1e-13 asked for, and references met to 1e-11.
ITERATED = 1e-10
ROUNDED = 4e-15

# Covariances of luck times cubes of the means' states, up to which one growth takes some ten milliseconds.
QUICK = 200_000

# How many times what two estimates differ by counts as their error; what bounds may be apart at most.
DOUBTS, LOOSE = 10, 1e-9

# How much earlier than its nominal delay a jitter of 1 can make a packet.
EARLIEST = {"uniform": 1.0, "normal": LATEST["normal"], "pareto": 2 / 3}


@dataclass(frozen=True, slots=True)
class NetworkVerdict(Result):
    """What becomes of a scene whose packets get lost or come late by chance.

    `mean_square_radius` is what second moments grow by in a frame, right to `error`; its root compares with
    the nominal spectral radius. `exact` is False where it is an estimate. `rms_error_m` is how far a copy is
    from the mean of the others, while every hand pushes with 1 N rms, anew at each tick. `almost_sure` is
    told where mean squares do not settle it, `losses_in_a_row` where packets get lost. None is what is not
    served, as `notes` say. `linearized`: the scene is not linear, and this holds near its start only.
    """

    shown_by = "network:network"

    topology: str
    verdict: str
    stable: bool | None
    mean_square_radius: float | None
    error: float | None
    exact: bool
    proof: str
    rms_error_m: float | None
    almost_sure: AlmostSure | None
    losses_in_a_row: LossesInARow | None
    linearized: bool
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Growth:
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
    errors: Callable[[], Told] | None = None

    @property
    def stable(self) -> bool | None:
        """Whether it is below 1, None where bounds leave it open."""
        return True if self.high < 1 else False if self.low > 1 else None


def unreliable(system: CompiledSystem) -> list[tuple[Link, ChannelLaw]]:
    """Return the links that lose packets or delay them by chance, with their laws."""
    timings = resolve(system).timings
    laws = [
        (link, channel_law(system, link, timings[link.delay]))
        for link in system.links
        if link.channel is not None
    ]
    return [(link, law) for link, law in laws if law.mean_loss or law.jitter or law.trace is not None]


@np.errstate(all="ignore")
def growth(system: CompiledSystem, prepared: Prepared, *, bounded: bool = True) -> Growth:
    """Return what second moments grow by in a frame, common translations left out.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it with any numbers.
    bounded
        Whether bounds are asked for; without them, they may be the radius itself.
    """
    lossy = unreliable(system)
    why = _unserved(system, lossy)
    if why:
        return Growth(np.nan, 0.0, np.inf, False, why)
    if any(law.trace is not None for _, law in lossy):
        found = trace_radius(system, prepared)
        if isinstance(found, str):
            return Growth(np.nan, 0.0, np.inf, False, found)
        unserved = partial(Told, None, "it is not worked out over recorded delays")
        low, high = found.low**2 * (1 - ROUNDED), found.high**2 * (1 + ROUNDED)
        if low > 1 or high < 1 or high - low < LOOSE:
            return Growth(min(max(found.radius**2, low), high), low, high, True, proved=True, errors=unserved)
        doubt = max(DOUBTS * 2 * found.radius * found.doubt, LOOSE)
        note = f"an estimate: bounds on the roundings of {found.frames:,} frames leave it open"
        radius = found.radius**2
        return Growth(radius, max(radius - doubt, 0.0), radius + doubt, False, note=note, errors=unserved)
    holding = {link.channel.on_loss == "hold" for link, _ in lossy if link.channel is not None}
    if all(is_memoryless(law) for _, law in lossy):
        if holding == {True} or not any(law.mean_loss for _, law in lossy):
            of = crowd(system, prepared)
            entries = sum(len(listed) for one in of.luck for listed in one.entries)
            states = [channel.matrix.shape[-1] for part in of.parts for channel in part.channels.values()]
            if why := too_much(entries, max(states, default=0)):
                return Growth(np.nan, 0.0, np.inf, False, why)
            inner = mean_square_radius(*of.means, gain_of(of), bounded=bounded)
            errors = partial(crowd_error, system, prepared)
            quick = entries * max(states, default=0) ** 3 <= QUICK
            return Growth(inner.radius, inner.low, inner.high, True, proved=True, quick=quick, errors=errors)
        first, why = _due(system, lossy)
        if not why and len(system.links) == 1 and not system.links[0].delays:
            closed = stand_in(system, prepared, first)
            if isinstance(closed, str):
                return Growth(np.nan, 0.0, np.inf, False, closed)
            means, luck = closed
            inner = mean_square_radius(means, [], luck, bounded=bounded)
            errors = partial(standing_error, system, prepared, first)
            every = system.peers <= ENUMERATED  # of more, a quadrature's nodes are rounded
            return Growth(inner.radius, inner.low, inner.high, True, proved=every, quick=every, errors=errors)
    else:
        first, why = _due(system, lossy)
    if not why and any(law.jitter for _, law in lossy):
        why = "jitter of one link beside losses of another that come in bursts or with on_loss: zero"
    if why:
        return Growth(np.nan, 0.0, np.inf, False, why)
    return _by_patterns(system, prepared, first, lossy, holding)


def _by_patterns(
    system: CompiledSystem,
    prepared: Prepared,
    first: Fraction,
    lossy: Sequence[tuple[Link, ChannelLaw]],
    holding: set[bool],
) -> Growth:
    """Return what second moments grow by where losses come in bursts, or links differ."""
    channels = sum(_channels(link, system.peers) for link, _ in lossy)
    laws = {(law.p, law.r) for _, law in lossy}
    sure = all(law.one_minus_h == 1 and law.one_minus_k == 0 for _, law in lossy)
    alike = len(system.groups) == 1 and not system.groups[0].columns and len(lossy) == 1
    complete = all(link.graph.shape == "complete" for link in system.links)
    if holding == {True} and sure and len(laws) == 1 and alike and complete and system.peers <= MOST_TAGGED:
        if system.peers <= EXACTLY_TAGGED:
            (radius,) = tagged_radius(system, prepared, first, (channels,))
            errors = partial(tagged_error, system, prepared, first, (channels,))
            return Growth(radius, radius * (1 - ITERATED), radius * (1 + ITERATED), True, errors=errors)
        rough, radius = tagged_radius(system, prepared, first, ORDERS)
        note = (
            f"an estimate: moments of at most {ORDERS[1]} channels' states together; with {ORDERS[0]} the "
            f"radius is {rough:.9g}"
        )
        low, high = radius - abs(radius - rough), radius + abs(radius - rough)
        errors = partial(tagged_error, system, prepared, first, ORDERS)
        return Growth(radius, low, high, False, note=note, errors=errors)
    if channels > MOST_CHANNELS:
        bursts = not all(is_memoryless(law) for _, law in lossy)
        what = "bursts" if bursts else "values that stand in"
        why = (
            f"{what} on {channels} ways: followed are {MOST_CHANNELS}, or {MOST_TAGGED} equal peers that "
            "hold what they miss"
        )
        return Growth(np.nan, 0.0, np.inf, False, why)
    radius = pattern_radius(patterns(system, prepared, first))
    errors = partial(pattern_error, system, prepared, first)
    return Growth(radius, radius * (1 - ITERATED), radius * (1 + ITERATED), True, errors=errors)


def _channels(link: Link, peers: int) -> int:
    """Return how many ways a link has."""
    return peers * (peers - 1) if link.graph.shape == "complete" else len(arcs(link.graph, peers)[0])


def _unserved(system: CompiledSystem, lossy: Sequence[tuple[Link, ChannelLaw]]) -> str:
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


def _asked_of_packets(system: CompiledSystem, link: Link) -> str:
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


def _overtakes(system: CompiledSystem, link: Link, law: ChannelLaw) -> bool:
    """Say whether a packet may arrive before one that was sent before it."""
    timings = resolve(system).timings
    period = next(timings[clock.period] for clock in system.clocks if clock.name == link.clock)
    least = max(law.delay - law.jitter * EARLIEST[law.distribution], 0.0)
    return law.longest - least >= float(period)


def _due(system: CompiledSystem, lossy: Sequence[tuple[Link, ChannelLaw]]) -> tuple[Fraction, str]:
    """Return when in a frame packets are due, or why there is no one instant."""
    timings = resolve(system).timings
    clocks = {clock.name: clock for clock in system.clocks}
    found = set()
    for link, _ in lossy:
        clock = clocks[link.clock]
        for delay in {timings[link.delay], *(timings[one.delay] for one in link.delays)}:
            found.add((timings[clock.period], (timings[clock.phase] + delay) % timings[clock.period]))
    if len(found) > 1:
        return Fraction(0), "packets that are due at different instants of a frame"
    ((period, first),) = found
    frame = common_multiple([timings[clock.period] for clock in system.clocks])
    if frame != period:
        return first, f"a frame of {float(frame) * 1e3:.6g} ms with several packets of {lossy[0][0].name}"
    return first, ""


def judge_network(
    system: CompiledSystem, prepared: Prepared | None = None, *, certify: bool = False
) -> NetworkVerdict | None:
    """Judge a scene over the network that it has, None where every packet takes its nominal delay.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    certify
        Whether a proof is asked for: which numbers carry it.
    """
    if not unreliable(system):
        return None
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        prepared = prepared or prepare(system)
        found = growth(system, prepared)
        lost = [link for link, law in unreliable(system) if law.mean_loss]
        followed = lost and not any(_asked_of_packets(system, link) for link in lost)
        worst = worst_case(system, prepared) if followed else None
        surely, unsure = _almost_sure(system, prepared, found)
        rms = _rms_error(found)
        linear = all(prepared.jacobians[group.kind].affine for group in system.groups)
    told = bool(np.isfinite(found.radius))
    decided = told and found.stable is not None
    notes = (
        found.why and f"not judged: {found.why}",
        UNPROVED if certify and decided and not found.proved else "",
        found.note,
        unsure,
        rms.why and f"root mean square error of copies: {rms.why}",
        worst.note if worst is not None else "",
    )
    return NetworkVerdict(
        topology=system.name,
        verdict=verdict_of(found),
        stable=found.stable if told else None,
        mean_square_radius=found.radius if told else None,
        error=max(found.high - found.radius, found.radius - found.low) if told else None,
        exact=found.exact,
        proof=(STABLE_PROVED if found.stable else UNSTABLE_PROVED)
        if certify and decided and found.proved
        else "",
        rms_error_m=rms.metres,
        almost_sure=surely,
        losses_in_a_row=worst,
        linearized=not linear,
        notes=tuple(text for text in notes if text),
    )


def _rms_error(found: Growth) -> Told:
    """Return the error of copies where second moments die out, or why there is none."""
    if found.stable and found.errors is not None:
        return found.errors()
    return Told(None, "" if found.why else "only where second moments die out")


def verdict_of(found: Growth) -> str:
    """Return the verdict in words."""
    if not np.isfinite(found.radius):
        return NOT_JUDGED
    verdict = {True: STABLE, False: UNSTABLE, None: UNDECIDED}[found.stable]
    return f"probably {verdict}" if not found.exact and found.stable is not None else verdict


def _almost_sure(system: CompiledSystem, prepared: Prepared, found: Growth) -> tuple[AlmostSure | None, str]:
    """Return how a scene settles almost surely where mean squares leave it open, or why that is not told."""
    if found.why or found.stable:  # what settles in mean square settles almost surely
        return None, ""
    if why := unplayed(system, prepared):
        return None, f"almost surely: {why}"
    return almost_sure(system, prepared), ""
