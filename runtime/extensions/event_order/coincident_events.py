"""Dependence of the verdict on conventions: the order of coincident events, and receptions at the start.

Takes: a `NumericModel`.
Gives: `Outcome`, `EventOrder`, `event_order`.
Guarantees: every order of `schedule.ORDER` is covered; orders with the same frame are analysed once.
Does not: omit anything silently: a skipped repetition has a reason.

Coincident events that do not commute: a packet that arrives at a tick, a packet without delay, a force
without delay, a hold that switches as a tick or a packet reads it. Before the first packet a receiver holds
the sender's start values, or zero; that can matter only where the linearization depends on received values.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.lifting.data_age import at_timings
from apc.lifting.numeric_model import NumericModel
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.result import Result
from apc.timing.schedule import ORDER, ClockedValue, HoldUpdate, Propagate, Schedule, SendEvent, Tick
from apc.timing.scheduling import build_schedules
from apc.verdict import StabilityVerdict

Order = tuple[str, ...]

# The pairs of events whose order at one instant can change the frame, and the effect of each order other than
# the default. Sending and ticking read the same values and write different ones: their order has no effect.
DEPARTURES = {
    ("tick", "deliver"): "a packet that arrives at a tick is used one tick later",
    ("deliver", "send"): "a packet without delay is delivered one link tick later",
    ("act", "tick"): "a hold switches before the tick; a force without delay acts one tick later",
    ("act", "send"): "a hold switches before its value is sent",
}
DEFAULT = "send, deliver, compute, apply (default)"

ORDERS = math.factorial(len(ORDER))

SENDER = "the sender's initial values"
NOTHING = "nothing"

# The limit of repetitions of an analysis by default: cubes of states, and events of a frame, over all
# repetitions. Each takes some milliseconds (measured: 1e6 cubes 10 ms, 1,000 events 15 ms).
QUICK_CUBES = 1_500_000
QUICK_EVENTS = 2_000
QUICK_METHODS = ("modes", "dense")  # methods with a cost in cubes of states


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of an analysis under one set of conventions.

    `orders` are the orders of coincident events with this frame, `departures` describe their common
    differences from the default order; `start` describes the receptions before the first packet, "" where
    they have no effect. Where the analysis raises an error, `verdict` is None and `refusal` is the reason.
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
        """The conventions as text."""
        order = "; ".join(self.departures) or DEFAULT
        return f"{order}; before the first packet {self.start}" if self.start else order


@dataclass(frozen=True, slots=True)
class EventOrder(Result):
    """The outcomes under all conventions, the default first.

    `start_matters` states whether the linearization depends on received values. `not_repeated` is the reason
    if only the default outcome is given, "" otherwise.
    """

    shown_by = "apc.extensions.event_order.event_order_output:event_order"

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
        """A warning in one sentence if the verdict depends on the conventions, else ""."""
        default = self.outcomes[0]
        other = next((outcome for outcome in self.outcomes if outcome.verdict is not default.verdict), None)
        if other is None:
            return ""
        verdict = other.verdict or "not analyzed"
        return f"the verdict depends on the event order: {verdict} if {other.words} (list: --event-order)"


@part("event order")
def event_order(
    numeric: NumericModel,
    *,
    default: Analysis | None = None,
    quick: bool = False,
) -> EventOrder:
    """Return the verdict under every order of coincident events and every reception before the first packet.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    default
        The analysis under the default conventions, if already computed.
    quick
        Skip repetitions that would take more than some tens of milliseconds, with a reason.

    Raises
    ------
    ApcError
        The errors of the analysis under the default conventions.
    """
    model = numeric.model
    default = default or analyze(numeric)
    subsystems = [numeric.jacobians[group.peer_type] for group in model.groups]
    start_matters = any(map(_depends_on_received, subsystems))
    discrete_states = any(send.u.any() for subsystem in subsystems for send in subsystem.pattern.sends)
    departure_pairs = {
        pair: text for pair, text in DEPARTURES.items() if pair != ("act", "send") or discrete_states
    }
    starts = [SENDER, NOTHING] if start_matters else [""]

    def outcome(
        orders: Sequence[Order], start: str, analysis: Analysis | ApcError, frame_s: float
    ) -> Outcome:
        """Return the outcome of one analysis, or of its error, with the departures common to these orders."""
        departures = tuple(
            text
            for (a, b), text in departure_pairs.items()
            if all(order.index(a) < order.index(b) for order in orders)
        )
        if isinstance(analysis, ApcError):
            nan, refusal = float("nan"), analysis.mistakes[0].sentence
            return Outcome(tuple(orders), departures, start, None, None, nan, nan, frame_s, refusal)
        radius, error = analysis.spectral_radius, analysis.spectral_radius_error
        result_fields = analysis.verdict, analysis.stable, radius, error, analysis.frame_s
        return Outcome(
            tuple(orders), departures, start, *result_fields, refusal="", radius_excess=analysis.radius_excess
        )

    def default_alone(reason: str) -> EventOrder:
        """Return the default outcome alone, with the reason for not repeating the analysis."""
        first = replace(outcome([ORDER], starts[0], default, default.frame_s), departures=())
        return EventOrder(model.name, (first,), start_matters, reason)

    if quick and (reason := _reason_not_repeated(numeric, default, 1)):
        return default_alone(reason)
    classes = _orders_by_frame(numeric, tuple(departure_pairs))
    if quick and (reason := _reason_not_repeated(numeric, default, len(classes) * len(starts) - 1)):
        return default_alone(reason)
    outcomes = []
    for orders, start in itertools.product(classes, starts):
        result: Analysis | ApcError = default
        if ORDER not in orders or start == NOTHING:
            changed = _reordered(numeric, orders[0], silent=start == NOTHING)
            try:
                result = analyze(changed)
            except ApcError as refused:
                result = refused
        outcomes.append(outcome(orders, start, result, default.frame_s))
    return EventOrder(model.name, tuple(outcomes), start_matters, "")


def _orders_by_frame(numeric: NumericModel, pairs: Sequence[tuple[str, str]]) -> list[list[Order]]:
    """Return all orders of coincident events in lists with the same frame, the default order first.

    Only orders that differ in a pair that affects the frame are built. The effect of a pair does not depend
    on the others: each decides about other coincidences.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    pairs
        The pairs of events that may affect the frame.
    """
    patterns = [subsystem.pattern for subsystem in numeric.jacobians]

    @functools.cache
    def frame_of(order: Order) -> Hashable:
        """Return a key of the frame of all groups under an order of coincident events."""
        schedules = build_schedules(numeric.model, numeric.timings, patterns, order=order)
        return tuple(
            _frame_effect(schedule, subsystem.pattern)
            for schedule, subsystem in zip(schedules, numeric.subsystems, strict=True)
        )

    def has_effect(later: str, earlier: str) -> bool:
        """Return whether two events in reverse order affect the frame; True if they are not adjacent."""
        rank = ORDER.index(earlier)
        if ORDER[rank + 1] != later:
            return True
        return frame_of((*ORDER[:rank], later, earlier, *ORDER[rank + 2 :])) != frame_of(ORDER)

    effective = [pair for pair in pairs if has_effect(*pair)]
    representatives: dict[tuple[bool, ...], Order] = {}
    orders_of_frame: dict[Hashable, list[Order]] = {}
    for order in sorted(itertools.permutations(ORDER), key=lambda order: order != ORDER):
        reversed_pairs = tuple(order.index(a) < order.index(b) for a, b in effective)
        frame = frame_of(representatives.setdefault(reversed_pairs, order))
        orders_of_frame.setdefault(frame, []).append(order)
    return list(orders_of_frame.values())


def _reordered(numeric: NumericModel, order: Order, *, silent: bool) -> NumericModel:
    """Return a model with another order of coincident events.

    `silent` states that every peer receives zeros before the first packet.
    """
    subsystems = at_timings(numeric.model, numeric.jacobians, numeric.timings, order)
    reordered = NumericModel(numeric.model, subsystems, order)
    return reordered.with_jacobians(tuple(map(_with_zero_start, subsystems))) if silent else reordered


def _frame_effect(schedule: Schedule, pattern: LinearSubsystem) -> Hashable:
    """Return a key of a schedule's effect over a frame, equal for orders that differ in commuting
    events only.
    """
    active_at_start: list[ClockedValue | None] = list(schedule.active_at_start)
    holds_of_motion = _holds(pattern.b)
    holds_of_sends = [_holds(send.u) for send in pattern.sends]
    holds_of_ticks = [_holds(tick.u) for tick in pattern.ticks]

    def hold_values(holds: Sequence[int]) -> Hashable:
        """Return the values that these holds output at this instant."""
        return tuple(active_at_start[h] for h in holds)

    intervals: list[Hashable] = []
    instant: set[Hashable] = set()
    for event in schedule.events:
        match event:
            case Propagate(duration):
                intervals += [frozenset(instant), duration, hold_values(holds_of_motion)]
                instant = set()
            case HoldUpdate(hold, value):
                active_at_start[hold] = value
            case SendEvent(partition, rows):
                sent = tuple((channel, schedule.sent[row]) for channel, row in rows)
                instant.add(("send", partition, sent, hold_values(holds_of_sends[partition])))
            case Tick(partition, index, received):
                names = tuple(tuple(schedule.received[row] for row in rows) for rows in received)
                instant.add(("tick", partition, index, names, hold_values(holds_of_ticks[partition])))
    return tuple(intervals), frozenset(instant)


def _holds(matrix: Any) -> list[int]:
    """Return the indices of the holds with a nonzero column in a matrix."""
    indices: list[int] = np.flatnonzero(np.asarray(matrix).any(axis=0)).tolist()
    return indices


def _depends_on_received(subsystem: SubsystemJacobians) -> bool:
    """Return whether a subsystem's linearization may depend on its received values.

    True as well if its expressions cannot be inspected.
    """
    if subsystem.affine:
        return False
    if not all(edge.affine for edge in subsystem.edges.values()) or not subsystem.walkable:
        return True
    received = subsystem.function.sx_in()[3]
    return bool(
        received.numel() and casadi.depends_on(subsystem.function(*subsystem.function.sx_in()), received)
    )


def _with_zero_start(subsystem: SubsystemJacobians) -> SubsystemJacobians:
    """Return a subsystem whose peers send zero at the start; its slopes are unchanged."""
    sends = []
    for sending in subsystem.peer_type.sends:
        inputs = sending.send.sx_in()
        nothing = casadi.Function("nothing", inputs, [casadi.SX.zeros(len(sending.channels))])
        sends.append(replace(sending, send=nothing))
    return replace(subsystem, peer_type=replace(subsystem.peer_type, sends=tuple(sends)))


def _reason_not_repeated(numeric: NumericModel, default: Analysis, times: int) -> str:
    """Return the reason for not repeating an analysis `times` times by default, "" if it is repeated."""
    if default.method not in QUICK_METHODS:
        why = f"the method {default.method} takes long (--event-order)"
        return f"not repeated for other event orders: {why}"
    sizes = Counter(mode.family for mode in default.modes)
    events = max(len(schedule.events) for schedule in numeric.schedules) * len(set(numeric.schedules))
    if times * sum(size**3 for size in sizes.values()) > QUICK_CUBES or times * events > QUICK_EVENTS:
        return "not repeated for other event orders: the topology is too large"
    return ""
