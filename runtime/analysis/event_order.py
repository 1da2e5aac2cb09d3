"""Dependence of the verdict on conventions: the order of coincident events, and receptions at the start.

Takes: a `Model`.
Gives: `Outcome`, `EventOrder`, `event_order`.
Guarantees: every order of `schedule.ORDER` is covered; orders with the same frame are analysed once.
Does not: omit anything silently: a skipped repetition has a reason.

Coincident events that do not commute: a packet that arrives at a tick, a packet without delay, a force
without delay, a hold that switches as a tick or a packet reads it. Before the first packet a receiver holds
the sender's start values, or zero; that can matter only where the linearization depends on received values.
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
from apc.frame.data_age import at_timings
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.linear_subsystem import LinearSubsystem
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.schedule import ORDER, ClockedValue, HoldUpdate, Propagate, Schedule, SendEvent, Tick
from apc.frame.scheduling import build_schedules
from apc.result import Result
from apc.verdict import StabilityVerdict

Order = tuple[str, ...]

# The pairs of events whose order at one instant can change the frame, and the meaning of each order other
# than the default. Sending and ticking read the same instant and write different values: their order has no
# effect.
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

# The limit of repetitions of an analysis by default: cubes of states, and events of a frame, over all
# repetitions. Each takes some milliseconds (measured: 1e6 cubes 10 ms, 1,000 events 15 ms).
QUICK_CUBES = 1_500_000
QUICK_EVENTS = 2_000
QUICK_METHODS = ("modes", "dense")  # those with a cost in cubes of states


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result under one set of conventions.

    `orders` are the orders of coincident events with this frame, `departures` describe their common
    differences from the default order; `start` describes the receptions before the first packet, "" where
    they have no effect. Where the analysis raises an error, `verdict` is "" and `refusal` is the reason.
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
    radius_excess: tuple[float, float] | None = None  # of 1, see `Analysis`

    @property
    def words(self) -> str:
        """The conventions in words."""
        order = "; ".join(self.departures) or DEFAULT
        return f"{order}; before the first packet {self.start}" if self.start else order


@dataclass(frozen=True, slots=True)
class EventOrder(Result):
    """The outcomes, the default one first; `repeated` states whether there are others to compare.

    `not_repeated` is the reason why not. `start_matters` states whether the linearization depends on received
    values.
    """

    shown_by = "analysis_output:event_order"

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
        """A warning in one sentence if the verdict changes, else ""."""
        default = self.outcomes[0]
        other = next((outcome for outcome in self.outcomes if outcome.verdict is not default.verdict), None)
        if other is None:
            return ""
        verdict = other.verdict or "not analysed"
        return f"the verdict hangs on a convention: {verdict} if {other.words} (--event-order lists all)"


@part("event order")
def event_order(
    system: Model,
    *,
    prepared: Prepared | None = None,
    default: Analysis | None = None,
    quick: bool = False,
) -> EventOrder:
    """Return the analyses under all conventions of time.

    Parameters
    ----------
    system
        The compiled model, with the parameter values to analyse.
    prepared
        From `numeric_model.prepare`, of this model with these timings; avoids building the Jacobians again.
    default
        The analysis under the default conventions, if already computed.
    quick
        Skip repetitions that would take more than some tens of milliseconds, with a reason.

    Raises
    ------
    ApcError
        The errors of the analysis under the default conventions.
    """
    prepared = prepared or prepare(system)
    default = default or analyze(system, prepared=prepared)
    subsystems = [prepared.jacobians[group.peer_type] for group in system.groups]
    matters = any(map(_reception_order_matters, subsystems))
    discrete_states = any(send.u.any() for subsystem in subsystems for send in subsystem.pattern.sends)
    pairs = {pair: words for pair, words in DEPARTURES.items() if pair != ("act", "send") or discrete_states}
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
        return Outcome(
            tuple(orders), departures, start, *answer, refusal="", radius_excess=analysis.radius_excess
        )

    def only(why: str) -> EventOrder:
        first = replace(outcome([ORDER], readings[0], default, default.frame_s), departures=())
        return EventOrder(system.name, (first,), matters, why)

    if quick and (why := _too_much(prepared, default, 1)):
        return only(why)
    classes: dict[Hashable, list[Order]] = {}
    patterns = [subsystem.pattern for subsystem in prepared.jacobians]
    for order in sorted(itertools.permutations(ORDER), key=lambda order: order != ORDER):
        schedules = build_schedules(system, prepared.timings, patterns, order=order)
        meaning = tuple(
            _meaning(schedule, subsystem.pattern)
            for schedule, subsystem in zip(schedules, subsystems, strict=True)
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
    """Return the prepared data for another order of events, `silent` with zero receptions at the start."""
    subsystems = at_timings(system, prepared.jacobians, prepared.timings, order)
    schedules = build_schedules(
        system, prepared.timings, [subsystem.pattern for subsystem in subsystems], order=order
    )
    return Prepared(
        tuple(map(_silent, subsystems)) if silent else subsystems, schedules, prepared.timings, order
    )


def _meaning(schedule: Schedule, pattern: LinearSubsystem) -> Hashable:
    """Return the effect of a schedule, independent of the order of commuting coincident events."""
    active_at_start: list[ClockedValue | None] = list(schedule.active_at_start)
    by_motion = _holds(pattern.b)
    by_sends = [_holds(send.u) for send in pattern.sends]
    by_ticks = [_holds(tick.u) for tick in pattern.ticks]

    def reads(holds: Sequence[int]) -> Hashable:
        return tuple(active_at_start[h] for h in holds)

    mode_path: list[Hashable] = []
    instant: set[Hashable] = set()
    for event in schedule.events:
        match event:
            case Propagate(duration):
                mode_path += [frozenset(instant), duration, reads(by_motion)]
                instant = set()
            case HoldUpdate(hold, value):
                active_at_start[hold] = value
            case SendEvent(partition, rows):
                sent = tuple((channel, schedule.sent[row]) for channel, row in rows)
                instant.add(("send", partition, sent, reads(by_sends[partition])))
            case Tick(partition, index, received):
                names = tuple(tuple(schedule.received[row] for row in rows) for rows in received)
                instant.add(("tick", partition, index, names, reads(by_ticks[partition])))
    return tuple(mode_path), frozenset(instant)


def _holds(reading: Any) -> list[int]:
    """Return the holds that a matrix over them reads."""
    numbers: list[int] = np.flatnonzero(np.asarray(reading).any(axis=0)).tolist()
    return numbers


def _reception_order_matters(subsystem: SubsystemJacobians) -> bool:
    """Return whether a subsystem's linearization depends on its received values."""
    if subsystem.affine:
        return False
    if not all(edge.affine for edge in subsystem.edges.values()) or not subsystem.walkable:
        return True
    received = subsystem.function.sx_in()[3]
    return bool(
        received.numel() and casadi.depends_on(subsystem.function(*subsystem.function.sx_in()), received)
    )


def _silent(subsystem: SubsystemJacobians) -> SubsystemJacobians:
    """Return a subsystem whose sent values are zero at the start; its slopes are unchanged."""
    sends = []
    for sending in subsystem.peer_type.sends:
        inputs = sending.send.sx_in()
        nothing = casadi.Function("nothing", inputs, [casadi.SX.zeros(len(sending.channels))])
        sends.append(replace(sending, send=nothing))
    return replace(subsystem, peer_type=replace(subsystem.peer_type, sends=tuple(sends)))


def _too_much(prepared: Prepared, default: Analysis, times: int) -> str:
    """Return the reason for not repeating an analysis by default, "" if it is repeated."""
    if default.method not in QUICK_METHODS:
        why = f"analysed by {default.method} they take long (--event-order)"
        return f"not repeated under other conventions: {why}"
    sizes = Counter(mode.family for mode in default.modes)
    events = max(len(schedule.events) for schedule in prepared.schedules) * len(set(prepared.schedules))
    if times * sum(size**3 for size in sizes.values()) > QUICK_CUBES or times * events > QUICK_EVENTS:
        return "not repeated under other conventions: too large to do in passing"
    return ""
