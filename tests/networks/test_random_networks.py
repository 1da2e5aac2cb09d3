"""Lossy topologies of any shape: no verdict or bound contradicts second moments moved pattern by pattern.

Periods, phases, delays, weights and users of all kinds; losses one by one and in bursts, hold and zero.
"""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

import apc
from tests.bruteforce import TopologySource, common_period
from tests.networks.second_moments import Law, arrivals_of, second_moment_radius
from tests.sites import MS
from tests.topologies import compiled, replaced
from tests.truths import text_of

# What the iteration of the reference leaves of an eigenvalue; what an estimate may be off by.
ITERATED, ESTIMATED = 2e-9, 1e-4

MOST_TICKS, MOST_ARRIVALS = 12, 2  # in a frame


@st.composite
def topologies(draw: st.DrawFn) -> TopologySource:
    """Draw two users whose frame is stepped quickly."""
    periods = st.sampled_from([Fraction(one) for one in ("1", "2", "4", "3/2")])
    haptic = draw(periods)
    network = draw(periods | st.integers(2, 8).map(lambda times: times * haptic))
    frame = common_period(haptic, network)
    assume(frame / haptic <= MOST_TICKS and frame / network <= MOST_ARRIVALS)
    parts = st.sampled_from([Fraction(0), Fraction(0), Fraction(1, 2), Fraction(7, 10)])
    delays = st.sampled_from([Fraction(one, 10) for one in (0, 4, 10, 10, 15, 25)])
    weights = st.none() | st.floats(0.3, 1.5).map(lambda w: {(0, 1): round(w, 2), (1, 0): 1.0})
    users = st.just(()) | st.tuples(st.just({}), st.builds(lambda m: {"device": m / 100}, st.integers(5, 30)))
    operator = draw(st.sampled_from(["mean", "sum"]))
    return TopologySource(
        operator,
        2,
        draw(st.integers(2, 24)) * 50.0,
        draw(st.sampled_from([0.0, 1.5])),
        draw(st.integers(1, 9)) * 100.0,
        draw(st.sampled_from([0.0, 1.0])),
        comp=draw(delays) * haptic * MS,
        comm=draw(delays) * network * MS,
        own_delay=draw(st.booleans()),
        haptic=haptic * MS,
        network=network * MS,
        network_phase=draw(parts) * network * MS,
        users=draw(users),
        weights=draw(weights) if operator == "mean" else None,
    )


@st.composite
def laws(draw: st.DrawFn) -> Law:
    """Draw losses one by one or in bursts."""
    loss, zero = draw(st.sampled_from([0.01, 0.1, 0.2, 0.4, 0.7])), draw(st.booleans())
    length = draw(st.sampled_from([None, 1.5, 3.0, 10.0, 50.0]))
    if length is None:
        return Law(loss, 1 - loss, zero=zero)
    p = min(loss / length / (1 - loss), 0.9)
    bad, good = draw(st.sampled_from([(1.0, 0.0), (0.9, 0.0), (0.5, 0.02)]))
    return Law(p, 1 / length, bad, good, zero)


@pytest.mark.whole
@settings(max_examples=15, derandomize=True, suppress_health_check=[*HealthCheck])
@given(topologies(), laws())
@example(
    TopologySource(peers=2, kt=900.0, cube=0.3, comm=Fraction(12, 1000)), Law(0.03, 0.3, 0.9, 0.02, zero=True)
)
@example(TopologySource(peers=2, haptic=3 * MS, network=2 * MS, comm=2 * MS, comp=MS), Law(0.1, 0.9))
@example(TopologySource(peers=2, bt=3.0, network=MS / 2, comm=Fraction(0), comp=Fraction(0)), Law(0.5, 0.5))
def test_verdicts_are_those_of_moments_followed_pattern_by_pattern(
    topology: TopologySource, law: Law
) -> None:
    assume(arrivals_of(topology) == 1 or (law.independent and not law.zero))  # or it takes seconds
    printed = f"loss: {{p: {law.p!r}, r: {law.r!r}, 1-h: {law.bad_loss!r}, 1-k: {law.good_loss!r}}}"
    printed += ", on_loss: zero" if law.zero else ""
    text = replaced(text_of(topology), ("lan: {clock: network, ", f"lan: {{clock: network, {printed}, "))
    reported = apc.mean_square_stability(compiled(text))
    assert reported is not None
    if reported.mean_square_radius is None:
        return
    truth = second_moment_radius(topology, law)
    room = ITERATED * max(truth, 1.0) + ((reported.error or 0.0) if reported.exact else ESTIMATED)
    assert abs(reported.mean_square_radius - truth) <= room, (reported, truth)
    assert reported.stable in (None, truth < 1) or abs(truth - 1) <= room, (reported, truth)
