"""Does the verdict hang on a convention: every order of coincident events, and both readings of the start.

Takes: a `Model`.
Gives: `Outcome`, `EventOrder`, `conventions`.
Guarantees: every order of `schedule.ORDER` is covered; orders that mean the same frame are analysed once.
Does not: leave anything out silently: what is not repeated says why.

What coincides and does not commute: a packet that arrives at a tick, a packet without delay, a force without
delay, a hold that switches as a tick or a packet reads it. Before the first packet a receiver holds the
sender's start values, or nothing (zero); that can matter only where the linearization depends on what is
heard.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.frame.ages import at_timings
from apc.frame.instance import Prepared, prepare
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.schedule import ORDER, ClockedValue, HoldUpdate, Propagate, Schedule, SendEvent, Tick
from apc.frame.scheduling import build_schedules
from apc.frame.site import LinearSubsystem
from apc.result import Result
from apc.verdict import StabilityVerdict

Order = tuple[str, ...]

# The pairs of events whose order at one instant can change the frame, and what each order other than the
# default means. Sending and ticking read the same instant and write different things: their order can't.
DEPARTURES = {
    ("tick", "deliver"): "a tick misses a packet that arrives with it",
    ("deliver", "send"): "a packet without delay is delivered a tick of its link later",
    ("act", "tick"): "a hold switches before the tick; a force without delay acts a tick later",
    ("act", "send"): "a hold switches before a packet that carries it is sent",
}
DEFAULT = "sent, delivered, computed, acting (the default)"

ORDERS = math.factorial(len(ORDER))

SENDER = "the sender's start values"
NOTHING = "nothing"

# A plain analysis repeats at most so much: cubes of states, and events of a frame, over all repetitions. Each
# takes some milliseconds (measured: 1e6 cubes 10 ms, 1,000 events 15 ms).
QUICK_CUBES = 1_500_000
QUICK_EVENTS = 2_000
QUICK_METHODS = ("modes", "dense")  # those whose cost the cubes say


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one reading of the conventions leads to.

    `orders` are the orders of coincident events that mean this frame, `departures` in words what they all do
    other than the default order; `start` is what is heard before the first packet, "" where it can't matter.
    Where the analysis refuses this reading, `verdict` is None and `refusal` is the reason.
    """

    orders: tuple[Order, ...]
    departures: tuple[str, ...]
    start: str
    verdict: StabilityVerdict | None
    stable: bool | None
    spectral_radius: float
    spectral_radius_error: float
    frame_s: float
    refusal: str
    beyond: tuple[float, float] | None = None  # of 1, see `Analysis`

    @property
    def words(self) -> str:
        """The reading in words."""
        order = "; ".join(self.departures) or DEFAULT
        return f"{order}; before the first packet {self.start}" if self.start else order


@dataclass(frozen=True, slots=True)
class EventOrder(Result):
    """The outcomes, the default one first; `repeated` says whether there are others to compare it with.

    `not_repeated` says why not. `start_matters` says whether the linearization depends on what is heard.
    """

    shown_by = "analysis_output:conventions"

    topology: str
    outcomes: tuple[Outcome, ...]
    start_matters: bool
    not_repeated: str

    @property
    def repeated(self) -> bool:
        """Whether the analysis was repeated under every convention."""
        return not self.not_repeated

    @property
    def flips(self) -> bool:
        """Whether the verdict depends on the conventions."""
        return len({(outcome.verdict, bool(outcome.refusal)) for outcome in self.outcomes}) > 1

    @property
    def warning(self) -> str:
        """A warning in one sentence if the verdict flips, else ""."""
        default = self.outcomes[0]
        other = next((outcome for outcome in self.outcomes if outcome.verdict is not default.verdict), None)
        if other is None:
            return ""
        verdict = other.verdict or "not analysed"
        return f"the verdict hangs on a convention: {verdict} if {other.words} (--conventions lists all)"


@part("conventions")
def conventions(
    system: Model,
    *,
    prepared: Prepared | None = None,
    default: Analysis | None = None,
    quick: bool = False,
) -> EventOrder:
    """Repeat an analysis under every convention of time.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with these timings; saves building the Jacobians again.
    default
        The analysis under the default conventions, if it was done before.
    quick
        Give up, and say so, where repeating would take more than some tens of milliseconds.

    Raises
    ------
    ApcError
        Whatever the analysis under the default conventions raises.
    """
    prepared = prepared or prepare(system)
    default = default or analyze(system, prepared=prepared)
    sites = [prepared.jacobians[group.kind] for group in system.groups]
    matters = any(map(_hearing_matters, sites))
    carried = any(send.u.any() for site in sites for send in site.pattern.sends)
    pairs = {pair: words for pair, words in DEPARTURES.items() if pair != ("act", "send") or carried}
    readings = [SENDER, NOTHING] if matters else [""]

    def outcome(
        orders: Sequence[Order], start: str, analysis: Analysis | ApcError, frame_s: float
    ) -> Outcome:
        departures = tuple(
            words
            for (a, b), words in pairs.items()
            if all(order.index(a) < order.index(b) for order in orders)
        )
        if isinstance(analysis, ApcError):
            nan, refusal = float("nan"), analysis.mistakes[0].sentence
            return Outcome(tuple(orders), departures, start, None, None, nan, nan, frame_s, refusal)
        radius, error = analysis.spectral_radius, analysis.spectral_radius_error
        answer = analysis.verdict, analysis.stable, radius, error, analysis.frame_s
        return Outcome(tuple(orders), departures, start, *answer, refusal="", beyond=analysis.beyond)

    def only(why: str) -> EventOrder:
        first = replace(outcome([ORDER], readings[0], default, default.frame_s), departures=())
        return EventOrder(system.name, (first,), matters, why)

    if quick and (why := _too_much(prepared, default, 1)):
        return only(why)
    classes: dict[Hashable, list[Order]] = {}
    patterns = [site.pattern for site in prepared.jacobians]
    for order in sorted(itertools.permutations(ORDER), key=lambda order: order != ORDER):
        schedules = build_schedules(system, prepared.timings, patterns, order=order)
        meaning = tuple(
            _meaning(schedule, site.pattern) for schedule, site in zip(schedules, sites, strict=True)
        )
        classes.setdefault(meaning, []).append(order)
    if quick and (why := _too_much(prepared, default, len(classes) * len(readings) - 1)):
        return only(why)
    outcomes = []
    for orders, start in itertools.product(classes.values(), readings):
        result: Analysis | ApcError = default
        if ORDER not in orders or start == NOTHING:
            changed = _prepared(system, prepared, orders[0], silent=start == NOTHING)
            try:
                result = analyze(system, prepared=changed)
            except ApcError as refused:
                result = refused
        outcomes.append(outcome(orders, start, result, default.frame_s))
    return EventOrder(system.name, tuple(outcomes), matters, "")


def _prepared(system: Model, prepared: Prepared, order: Order, *, silent: bool) -> Prepared:
    """Return what was prepared for another order of events, `silent` with nothing heard at the start."""
    sites = at_timings(system, prepared.jacobians, prepared.timings, order)
    schedules = build_schedules(system, prepared.timings, [site.pattern for site in sites], order=order)
    return Prepared(tuple(map(_silent, sites)) if silent else sites, schedules, prepared.timings, order)


def _meaning(schedule: Schedule, pattern: LinearSubsystem) -> Hashable:
    """Return what a schedule does, whatever the order of events at one instant that commute."""
    acting: list[ClockedValue | None] = list(schedule.acting)
    by_motion = _holds(pattern.b)
    by_sends = [_holds(send.u) for send in pattern.sends]
    by_ticks = [_holds(tick.u) for tick in pattern.ticks]

    def reads(holds: Sequence[int]) -> Hashable:
        return tuple(acting[h] for h in holds)

    course: list[Hashable] = []
    instant: set[Hashable] = set()
    for event in schedule.events:
        match event:
            case Propagate(duration):
                course += [frozenset(instant), duration, reads(by_motion)]
                instant = set()
            case HoldUpdate(hold, value):
                acting[hold] = value
            case SendEvent(partition, rows):
                sent = tuple((channel, schedule.sent[row]) for channel, row in rows)
                instant.add(("send", partition, sent, reads(by_sends[partition])))
            case Tick(partition, index, heard):
                names = tuple(tuple(schedule.heard[row] for row in rows) for rows in heard)
                instant.add(("tick", partition, index, names, reads(by_ticks[partition])))
    return tuple(course), frozenset(instant)


def _holds(reading: Any) -> list[int]:
    """Return the holds that a matrix over them reads."""
    numbers: list[int] = np.flatnonzero(np.asarray(reading).any(axis=0)).tolist()
    return numbers


def _hearing_matters(site: SubsystemJacobians) -> bool:
    """Say whether a site's linearization depends on what it hears."""
    if site.affine:
        return False
    if not all(edge.affine for edge in site.edges.values()) or not site.walkable:
        return True
    heard = site.function.sx_in()[3]
    return bool(heard.numel() and casadi.depends_on(site.function(*site.function.sx_in()), heard))


def _silent(site: SubsystemJacobians) -> SubsystemJacobians:
    """Return a site whose start value of everything it sends is zero; how it sends is not changed."""
    sends = []
    for sending in site.kind.sends:
        inputs = sending.send.sx_in()
        nothing = casadi.Function("nothing", inputs, [casadi.SX.zeros(len(sending.channels))])
        sends.append(replace(sending, send=nothing))
    return replace(site, kind=replace(site.kind, sends=tuple(sends)))


def _too_much(prepared: Prepared, default: Analysis, times: int) -> str:
    """Say why an analysis is not repeated so many times in passing, "" if it is."""
    if default.method not in QUICK_METHODS:
        why = f"analysed by {default.method} they take long (--conventions)"
        return f"not repeated under other conventions: {why}"
    sizes = Counter(mode.shape for mode in default.modes)
    events = max(len(schedule.events) for schedule in prepared.schedules) * len(set(prepared.schedules))
    if times * sum(size**3 for size in sizes.values()) > QUICK_CUBES or times * events > QUICK_EVENTS:
        return "not repeated under other conventions: too large to do in passing"
    return ""
