"""The order of coincident events and what is heard at the start: another convention, another frame."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Hashable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.compiler.compiled import Model
from apc.extensions.event_order import coincident_events
from apc.extensions.event_order.coincident_events import (
    DEPARTURES,
    EventOrder,
    Outcome,
    _frame_effect,
    _orders_by_frame,
    event_order,
)
from apc.inputs.open_model import load_or_compile
from apc.lifting.numeric_model import numeric_model
from apc.timing.schedule import ORDER
from apc.timing.scheduling import build_schedules
from tests import bruteforce
from tests.sites import MS, edged, paper
from tests.topologies import AVERAGE, ROOT, TOPOLOGIES, compiled

FLIPPING = (ROOT / "tests" / "small_topologies" / "verdict-hangs-on-the-order.yaml").read_text(
    encoding="utf-8"
)


NONE = Fraction(0)


def radius(topology: bruteforce.TopologySource) -> float:
    """Return the spectral radius without the one eigenvalue 1 of the translation."""
    values = np.linalg.eigvals(np.array(bruteforce.frame_matrix(topology)))
    return float(np.abs(np.delete(values, np.argmin(np.abs(values - 1.0)))).max())


def outcome(found: EventOrder, order: tuple[str, ...]) -> Outcome:
    [one] = [one for one in found.outcomes if order in one.orders]
    return one


def test_a_verdict_that_hangs_on_the_order_of_coincident_events_is_told_with_both_truths() -> None:
    """A tick that misses the packet arriving with it sees it at the next: as if 8 to 9 ms late."""
    found = event_order(numeric_model(compiled(FLIPPING)))
    topology = bruteforce.TopologySource(kt=1110.0, kc=1000.0)
    default, late = radius(topology), radius(replace(topology, comm=Fraction(17, 2000)))
    assert late < 1 < default
    first, second = found.outcomes
    assert (first.verdict, second.verdict) == ("unstable", "stable up to a common translation")
    assert first.spectral_radius == pytest.approx(default, abs=1e-10)
    assert second.spectral_radius == pytest.approx(late, abs=1e-10)
    assert found.flips
    assert ORDER in first.orders
    assert second.departures == ("a packet that arrives at a tick is used one tick later",)
    assert len(first.orders) == len(second.orders) == 12
    assert found.warning == (
        "the verdict depends on the event order: stable up to a common translation if a packet "
        "that arrives at a tick is used one tick later (list: --event-order)"
    )


@pytest.mark.parametrize(
    ("comp", "comm", "classes"),
    [(MS, 8 * MS, 2), (MS / 2, 9 * MS / 2, 1), (NONE, 8 * MS, 4), (NONE, NONE, 8)],
)
def test_only_orders_that_mean_another_frame_are_analysed_again(
    comp: Fraction, comm: Fraction, classes: int
) -> None:
    """What waits half a tick coincides with nothing; each delay of zero adds an order of its own."""
    found = event_order(numeric_model(paper(comp=comp, comm=comm)))
    assert len(found.outcomes) == classes
    listed = [order for one in found.outcomes for order in one.orders]
    assert sorted(listed) == sorted(itertools.permutations(ORDER))


def test_late_actions_and_deliveries_are_delays_of_a_tick_by_brute_force() -> None:
    found = event_order(numeric_model(paper(comp=NONE, comm=NONE, kt=600.0)))
    late_force = outcome(found, ("send", "deliver", "act", "tick"))
    late_packet = outcome(found, ("deliver", "send", "tick", "act"))
    topology = bruteforce.TopologySource(kt=600.0, comp=NONE, comm=NONE)
    assert late_force.spectral_radius == pytest.approx(radius(replace(topology, comp=MS)), abs=1e-10)
    assert late_packet.spectral_radius == pytest.approx(radius(replace(topology, comm=8 * MS)), abs=1e-10)


def test_the_start_cannot_matter_where_all_is_linear_and_one_line_says_so() -> None:
    found = event_order(numeric_model(compiled(AVERAGE)))
    assert not found.start_matters
    assert not found.flips
    assert found.warning == ""
    assert str(found).endswith("Values received before the first packet do not affect the verdict.")
    # A contact is not linear, but what is heard moves no contact.
    assert not event_order(
        numeric_model(compiled((TOPOLOGIES / "experiment-average.yaml").read_text()))
    ).start_matters


def test_where_the_slope_depends_on_what_is_heard_both_readings_of_the_start_are_analysed() -> None:
    """Between copies 10 mm apart a cubic coupling is stiffer than between a copy and nothing heard at 0."""
    model = edged("sum", [0.0, 0.01, 0.01], cubic=1e7)
    found = event_order(numeric_model(model))
    assert found.start_matters
    readings = {one.start: one.spectral_radius for one in found.outcomes if ORDER in one.orders}
    assert set(readings) == {"the sender's initial values", "nothing"}
    assert readings["the sender's initial values"] == analyze(numeric_model(model)).spectral_radius
    apart = edged("sum", [0.0, 0.0, 0.0], cubic=1e7)
    assert readings["nothing"] != readings["the sender's initial values"]
    # Everybody at 0 hears 0, as if nothing.
    interchangeable = {
        one.spectral_radius for one in event_order(numeric_model(apart)).outcomes if ORDER in one.orders
    }
    assert max(interchangeable) == pytest.approx(min(interchangeable), abs=1e-12)


def test_a_reading_that_cannot_be_analysed_says_why() -> None:
    """The largest of all that is heard has no slope where nothing is heard yet: all are equal, zero."""
    model = edged("max", [0.0, 0.01, 0.02])
    found = event_order(numeric_model(model))
    silent = next(one for one in found.outcomes if one.start == "nothing")
    assert (silent.verdict, silent.stable) == (None, None)
    assert "max over peers with equal values has no linearization" in silent.refusal
    assert found.flips
    assert "not analyzed" in str(found)


NAMES = ("three-users-scheduled", "mixed-clocks", "two-users-proxies", "two-users-waves")
ZERO_DELAYS = [paper(comp=comp, comm=comm) for comp in (NONE, MS) for comm in (NONE, MS / 2, 8 * MS)]


@pytest.mark.parametrize(
    "model", [*ZERO_DELAYS, *(load_or_compile(TOPOLOGIES / f"{name}.yaml") for name in NAMES)]
)
def test_orders_are_grouped_as_if_every_order_were_built(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    numeric, pairs = numeric_model(model), tuple(DEPARTURES)
    built, frames = [], defaultdict[Hashable, list[tuple[str, ...]]](list)
    patterns = [subsystem.pattern for subsystem in numeric.jacobians]
    for order in itertools.permutations(ORDER):
        schedules = build_schedules(model, numeric.timings, patterns, order=order)
        effects = map(_frame_effect, schedules, [subsystem.pattern for subsystem in numeric.subsystems])
        frames[tuple(effects)].append(order)

    def counted(*given: Any, order: tuple[str, ...]) -> Any:
        built.append(order)
        return build_schedules(*given, order=order)

    monkeypatch.setattr(coincident_events, "build_schedules", counted)
    found = _orders_by_frame(numeric, pairs)
    assert found[0][0] == ORDER and sorted(map(sorted, found)) == sorted(map(sorted, frames.values()))
    # As many as a graph of four events in a circle has acyclic orientations.
    assert len(built) == len(set(built)) <= 14
