"""Output of the verdicts under every order of simultaneous events.

Takes: an `EventOrder`. Gives: its text and document.
Guarantees: every line fits 80 columns where its words allow it.
Does not: compute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apc.compiler.wording import wrapped
from apc.output.analysis_output import refusable_record
from apc.output.formatting import (
    Lines,
    Plain,
    radius_text,
    record,
)

if TYPE_CHECKING:
    from apc.extensions.event_order.coincident_events import EventOrder


# The events in words, where their names are other words.
EVENTS = {"tick": "compute", "act": "apply"}


def event_order_text(event_order: EventOrder) -> Lines:
    """Yield the result of every event order."""
    from apc.extensions.event_order.coincident_events import (  # loaded with the outcomes
        DEFAULT,
        ORDERS,
    )

    headline = "the verdict is the same for every order of simultaneous events"
    if not event_order.repeated:
        headline = event_order.not_repeated
    elif event_order.flips:
        headline = "the verdict depends on the order of simultaneous events"
    yield from wrapped(f"{event_order.topology}: {headline}", "", "  ")
    yield ""
    for number, outcome in enumerate(event_order.outcomes, 1):
        radius = radius_text(outcome.spectral_radius, outcome.spectral_radius_error, outcome.radius_excess)
        yield f"  {number}  {outcome.verdict or 'not analyzed'}"
        yield f"     spectral radius {radius}" if outcome.verdict else f"     {outcome.refusal}"
        yield from (f"     {departure}" for departure in outcome.departures or (DEFAULT,))
        if outcome.start:
            yield f"     received before the first packet: {outcome.start}"
        order = ", ".join(EVENTS.get(event, event) for event in outcome.orders[0])
        yield f"     {len(outcome.orders)} of {ORDERS} orders, such as: {order}"
    if event_order.repeated and not event_order.start_matters:
        yield "\n  Values received before the first packet do not affect the verdict."


def event_order_document(event_order: EventOrder) -> Plain:
    """Return the result of every event order as plain data."""
    outcomes = [refusable_record(outcome, {}) for outcome in event_order.outcomes]
    return record(
        event_order, {"flips": event_order.flips, "repeated": event_order.repeated, "outcomes": outcomes}
    )
