"""The order of coincident events and what is heard at the start: another convention, another frame."""

from __future__ import annotations

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.analysis.event_order import EventOrder, Outcome, event_order
from apc.frame.schedule import ORDER
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
    found = event_order(compiled(FLIPPING))
    topology = bruteforce.TopologySource(kt=1110.0, kc=1000.0)
    default, late = radius(topology), radius(replace(topology, comm=Fraction(17, 2000)))
    assert late < 1 < default
    first, second = found.outcomes
    assert (first.verdict, second.verdict) == ("unstable", "stable up to a common translation")
    assert first.spectral_radius == pytest.approx(default, abs=1e-10)
    assert second.spectral_radius == pytest.approx(late, abs=1e-10)
    assert found.flips
    assert ORDER in first.orders
    assert second.departures == ("a tick misses a packet that arrives with it",)
    assert len(first.orders) == len(second.orders) == 12
    assert found.warning == (
        "the verdict hangs on a convention: stable up to a common translation if a tick "
        "misses a packet that arrives with it (--event-order lists all)"
    )


@pytest.mark.parametrize(
    ("comp", "comm", "classes"),
    [(MS, 8 * MS, 2), (MS / 2, 9 * MS / 2, 1), (NONE, 8 * MS, 4), (NONE, NONE, 8)],
)
def test_only_orders_that_mean_another_frame_are_analysed_again(
    comp: Fraction, comm: Fraction, classes: int
) -> None:
    """What waits half a tick coincides with nothing; each delay of zero adds an order of its own."""
    found = event_order(paper(comp=comp, comm=comm))
    assert len(found.outcomes) == classes
    listed = [order for one in found.outcomes for order in one.orders]
    assert sorted(listed) == sorted(itertools.permutations(ORDER))


def test_late_actions_and_deliveries_are_delays_of_a_tick_by_brute_force() -> None:
    found = event_order(paper(comp=NONE, comm=NONE, kt=600.0))
    late_force = outcome(found, ("send", "deliver", "act", "tick"))
    late_packet = outcome(found, ("deliver", "send", "tick", "act"))
    topology = bruteforce.TopologySource(kt=600.0, comp=NONE, comm=NONE)
    assert late_force.spectral_radius == pytest.approx(radius(replace(topology, comp=MS)), abs=1e-10)
    assert late_packet.spectral_radius == pytest.approx(radius(replace(topology, comm=8 * MS)), abs=1e-10)


def test_the_start_cannot_matter_where_all_is_linear_and_one_line_says_so() -> None:
    found = event_order(compiled(AVERAGE))
    assert not found.start_matters
    assert not found.flips
    assert found.warning == ""
    assert str(found).endswith("What is heard before the first packet can't change the verdict.")
    # A contact is not linear, but what is heard moves no contact.
    assert not event_order(compiled((TOPOLOGIES / "experiment-average.yaml").read_text())).start_matters


def test_where_the_slope_depends_on_what_is_heard_both_readings_of_the_start_are_analysed() -> None:
    """Between copies 10 mm apart a cubic coupling is stiffer than between a copy and nothing heard at 0."""
    system = edged("sum", [0.0, 0.01, 0.01], cubic=1e7)
    found = event_order(system)
    assert found.start_matters
    readings = {one.start: one.spectral_radius for one in found.outcomes if ORDER in one.orders}
    assert set(readings) == {"the sender's start values", "nothing"}
    assert readings["the sender's start values"] == analyze(system).spectral_radius
    apart = edged("sum", [0.0, 0.0, 0.0], cubic=1e7)
    assert readings["nothing"] != readings["the sender's start values"]
    # Everybody at 0 hears 0, as if nothing.
    interchangeable = {one.spectral_radius for one in event_order(apart).outcomes if ORDER in one.orders}
    assert max(interchangeable) == pytest.approx(min(interchangeable), abs=1e-12)


def test_a_reading_that_cannot_be_analysed_says_why() -> None:
    """The largest of all that is heard has no slope where nothing is heard yet: all are equal, zero."""
    system = edged("max", [0.0, 0.01, 0.02])
    found = event_order(system)
    silent = next(one for one in found.outcomes if one.start == "nothing")
    assert (silent.verdict, silent.stable) == (None, None)
    assert "max over equal peers has no linearization" in silent.refusal
    assert found.flips
    assert "not analysed" in str(found)
