"""One frame as a map, of any topology: the text, compiled and lifted, against N full peers stepped one by
one.

`bruteforce` propagates the peers event by event with none of the code that is judged. What an instant means
(section 3 of the design) is among the examples. `python -m tests.fuzz --topologies 1000` tries more of them.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from apc.analysis.analysis import analyze, lifted_classes
from apc.compiler.errors import ApcError
from apc.lifting.numeric_model import numeric_model
from apc.spectrum.modes import dense, split
from tests.bruteforce import TopologySource, common_period, frame_matrix
from tests.sites import MS, alone, paper
from tests.topologies import compiled
from tests.truths import text_of

MOST_TICKS = 24  # a frame, so that stepping stays quick


@st.composite
def topologies(draw: st.DrawFn) -> TopologySource:
    """Draw a topology whose frame holds at most `MOST_TICKS` ticks: users, gains, periods, phases, delays."""
    periods = st.builds(Fraction, st.integers(1, 6), st.sampled_from([1, 1, 1, 2, 3]))
    haptic = draw(periods)
    network = draw(
        periods.filter(lambda period: common_period(haptic, period) / min(haptic, period) <= MOST_TICKS)
        | st.integers(1, 8).map(lambda times: times * haptic)
    )
    parts = st.sampled_from([Fraction(0), Fraction(0), Fraction(1, 2), Fraction(1, 3), Fraction(7, 10)])
    delays = st.sampled_from([Fraction(tenths, 10) for tenths in (0, 4, 10, 10, 15, 20)])
    masses = draw(st.lists(st.sampled_from([0.1, 0.2, 0.15]), min_size=2, max_size=5))
    stiffness = draw(st.integers(0, 20)) * 100.0
    return TopologySource(
        draw(st.sampled_from(["mean", "sum"])),
        len(masses),
        draw(st.integers(0, 10)) * 50.0,
        float(draw(st.integers(0, 3))),
        bc=float(draw(st.integers(0, 3))),
        kc=stiffness,
        comp=draw(delays) * haptic * MS,
        comm=draw(delays) * network * MS,
        own_delay=draw(st.booleans()),
        haptic=haptic * MS,
        network=network * MS,
        haptic_phase=draw(parts) * haptic * MS,
        network_phase=draw(parts) * network * MS,
        users=tuple({"device": mass} for mass in masses) if draw(st.booleans()) else (),
    )


def at(comp: float, comm: float, phase: float = 0, first: float = 0, own: bool = False) -> TopologySource:
    """Return a topology of the convention: delays and phases in ms, ticks of 2 ms, packets of 8 ms."""
    times = [Fraction(str(one)) * MS for one in (comp, comm, phase, first)]
    return TopologySource(
        "mean",
        2,
        700.0,
        3.0,
        comp=times[0],
        comm=times[1],
        haptic=2 * MS,
        haptic_phase=times[2],
        network_phase=times[3],
        own_delay=own,
    )


def check(topology: TopologySource) -> None:
    """Compare the split and the dense spectrum of a topology's text with that of peers stepped one by one."""
    peer_classes, comm_graph = lifted_classes(numeric_model(compiled(text_of(topology))))
    systems = split(peer_classes, comm_graph)
    modes = np.concatenate([np.repeat(np.linalg.eigvals(one.matrix), one.multiplicity) for one in systems])
    whole = np.linalg.eigvals(dense(peer_classes, comm_graph).matrix)
    expected = np.linalg.eigvals(np.array(frame_matrix(topology)))
    largest = max(1.0, float(np.abs(expected).max()))
    for found in (modes, whole):
        # The sums of their powers are smooth where eigenvalues scatter.
        for power in range(1, 7):
            one, other = ((values / largest) ** power for values in (found, expected))
            bound = 1e-9 * max(1.0, float(np.abs(other).sum()))
            assert abs(one.sum() - other.sum()) < bound, f"trace of power {power}: {topology}"
        apart = abs(np.abs(found).max() - np.abs(expected).max())
        assert apart < 1e-6 * largest, f"the largest differ by {apart}: {topology}"


QUIET = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]


# Everything at once; a packet that arrives exactly at a tick, just after, between two; delays within a tick's
# interval, two of one force, of several periods; phases.
@settings(max_examples=25, derandomize=True, suppress_health_check=QUIET)
@given(topologies())
@example(at(0, 0))
@example(at(2, 8))
@example(at(0, 4))
@example(at(0, 4.001))
@example(at(0, 3))
@example(at(0.4, 11))
@example(at(0.4, 11, own=True))
@example(at(5, 20))
@example(at(1, 5, 0.5, 3))
@example(at(1, 9.5, 0.5, 3, own=True))
@example(at(0.375, 2.625, 0.125, 0.625))
def test_any_topology_has_the_spectrum_of_its_peers_stepped_one_by_one(topology: TopologySource) -> None:
    check(topology)


def check_topologies(count: int) -> None:
    """Check that many random topologies; raises AssertionError with the smallest one that differs."""

    @settings(
        max_examples=count,
        deadline=None,  # run without pytest too
        database=None,
        suppress_health_check=QUIET,
        phases=[Phase.generate, Phase.shrink],
    )
    @given(topologies())
    def run(topology: TopologySource) -> None:
        check(topology)

    run()


PHI, GAMMA = float(np.exp(-0.001)), float(-np.expm1(-0.001))  # of x' = u − x, in a tick


@pytest.mark.parametrize(
    ("ticks", "delay", "names", "expected"),
    [
        # u[k] = −3 x[k−1], by previous() or by a computational delay of one tick.
        (
            ["f = -3*previous(s)", "s = sample(x)"],
            "0 s",
            ["it.x", "it.s(-1 ms)"],
            [[PHI, -3 * GAMMA], [1, 0]],
        ),
        (["f = -3*sample(x)"], "1 ms", ["it.x", "it.f(-1 ms)"], [[PHI, GAMMA], [-3, 0]]),
        # A memory that nothing reads is no state.
        (["f = -3*sample(x)", "s = previous(s) + sample(x)"], "0 s", ["it.x"], [[PHI - 3 * GAMMA]]),
        # A hold is read before it switches: f[k] = 0.5 u(t⁻) + 2 x with u(t⁻) = f[k−1].
        (
            ["f = 0.5*sample(hold(f, delay)) + 2*sample(x)"],
            "0 s",
            ["it.x", "it.f(-1 ms)"],
            [[PHI + 2 * GAMMA, 0.5 * GAMMA], [2, 0.5]],
        ),
    ],
)
def test_what_is_remembered_and_held_is_a_state_where_it_is_read(
    ticks: list[str], delay: str, names: list[str], expected: list[list[float]]
) -> None:
    variables = ", f: {unit: 1, start: 0}" + (", s: {unit: 1, start: 0}" if len(ticks) > 1 else "")
    [peer_class], _ = lifted_classes(
        numeric_model(alone("hold(f, delay) - x", *ticks, variables=variables, delay=delay))
    )
    assert list(peer_class.z_names) == names
    np.testing.assert_allclose(peer_class.lifted.p[0], expected, rtol=1e-14)


def test_clocks_that_hardly_ever_stand_as_before_are_refused_with_their_periods() -> None:
    with pytest.raises(ApcError, match=r"E805 the frame .common period of haptic 1.00003 ms"):
        analyze(numeric_model(paper(haptic=Fraction(100003, 10**8))))
