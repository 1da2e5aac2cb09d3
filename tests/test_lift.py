"""Claims about `apc.frame.lift`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
import pytest
from scipy.linalg import expm

from apc.analysis.analysis import lifted_groups
from apc.frame.discretize import discretize
from apc.frame.lift import LiftedSite, composed_bounded, step_durations
from apc.frame.radius import radius_of, value_of
from tests.sites import MS, alone, paper
from tests.topologies import compiled


def _lifted(**values: Any) -> LiftedSite:
    [group], _ = lifted_groups(paper(**values))
    return group.lifted


def test_a_delayed_site_names_its_state() -> None:
    lifted = _lifted()
    assert lifted.z_names == (
        "device.x",
        "device.v",
        "cube.x",
        "cube.v",
        "contact.f(-1 ms)",
        "coordination.f(-1 ms)",
    )
    assert lifted.p.shape == (6, 6)
    assert lifted.q.shape == (6, 2)
    assert lifted.frame_s == 0.008


def test_one_rate_without_delay_is_the_sampled_closed_loop_of_the_textbook() -> None:
    """x⁺ = (Φ + Γ F) x with Φ, Γ from one exponential (Van Loan) and F the sampled feedback."""
    lifted = _lifted(network=MS, comp=Fraction(0), comm=MS, kc=1500.0, bc=2.0, kt=800.0, bt=3.0)
    a = np.array([[0, 1, 0, 0], [0, -50.0, 0, 0], [0, 0, 0, 1], [0, 0, 0, -25.0]])
    b = np.array([[0, 0], [-10.0, 0], [0, 0], [5.0, -5.0]])
    f = np.array([[1500.0, 2.0, -1500.0, -2.0], [0, 0, 800.0, 3.0]])
    step = expm(np.block([[a, b], [np.zeros((2, 6))]]) * 0.001)
    phi, gamma = step[:4, :4], step[:4, 4:]
    np.testing.assert_allclose(lifted.p, phi + gamma @ f, rtol=0, atol=1e-14)
    heard = np.zeros((2, 2))
    heard[1, [1, 0]] = [-800.0, -3.0]  # r is in the order (velocity, position)
    np.testing.assert_allclose(lifted.q, gamma @ heard, rtol=0, atol=1e-14)


def test_what_is_heard_and_sent_on_in_one_frame_is_nilpotent() -> None:
    lifted = _lifted(network=2 * MS, haptic=3 * MS, comm=Fraction(0), comp=Fraction(0))
    [group], _ = lifted_groups(paper(network=2 * MS, haptic=3 * MS, comm=Fraction(0), comp=Fraction(0)))
    assert lifted.d.any()
    feedback = np.zeros((len(lifted.s), len(lifted.s)))
    for place, one in enumerate(group.schedule.heard):
        if one.lag == 0:
            feedback[:, group.schedule.sent.index(one.sent)] += lifted.d[:, place]
    assert not np.linalg.matrix_power(feedback, len(feedback)).any()


@pytest.mark.parametrize("damping", [0.0, 1e-6, 5.0, 500.0])
def test_no_digit_is_lost_as_the_damping_goes_to_zero(damping: float) -> None:
    """(1 − e^(−bT/m)) m/b as expm1 has it; the plain formula loses every digit."""
    system = paper(kc=0.0, kt=0.0, comm=8 * MS)

    system = replace(
        system,
        parameters=tuple(
            replace(p, value=damping) if p.name == "device.damping" else p for p in system.parameters
        ),
    )
    [group], _ = lifted_groups(system)
    rate = damping / 0.1
    expected = -np.expm1(-rate * 0.008) / rate if rate else 0.008
    assert group.lifted.p[0, 1] == pytest.approx(expected, rel=1e-13)


# ---- one peer, dx/dt = −x + u sampled every millisecond: Φ = e^(−T), Γ = 1 − e^(−T) ----

PHI = float(np.exp(-0.001))
GAMMA = float(-np.expm1(-0.001))


def _alone(**values: Any) -> LiftedSite:
    [group], _ = lifted_groups(alone(lambda x, u: -x + u, **values))
    return group.lifted


def test_a_remembered_sample_is_a_delay_of_one_tick() -> None:
    """u[k] = −3 x[k−1], by previous() or by a computational delay of one tick."""
    remembered = _alone(
        tick=lambda x, u, m: casadi.vertcat(-3 * m[0], x), outputs=("f", "seen"), memories=(1,)
    )
    delayed = _alone(tick=lambda x, u, m: -3 * x, delay=MS)
    assert remembered.z_names == ("x", "seen(-1 ms)")
    np.testing.assert_allclose(remembered.p, [[PHI, -3 * GAMMA], [1, 0]], rtol=1e-14)
    np.testing.assert_allclose(delayed.p, [[PHI, GAMMA], [-3, 0]], rtol=1e-14)


def test_a_memory_that_nothing_reads_is_no_state() -> None:
    lifted = _alone(
        tick=lambda x, u, m: casadi.vertcat(-3 * x, m[0] + x), outputs=("f", "sum"), memories=(1,)
    )
    assert lifted.z_names == ("x",)


def test_a_tick_that_reads_a_hold_reads_it_before_it_switches() -> None:
    """f[k] = 0.5 u(t⁻) + 2 x with u(t⁻) = f[k−1]; then x[k+1] = Φ x + Γ f[k]."""
    lifted = _alone(tick=lambda x, u, m: 0.5 * u[0] + 2 * x)
    assert lifted.z_names == ("x", "f(-1 ms)")
    np.testing.assert_allclose(lifted.p, [[PHI + 2 * GAMMA, 0.5 * GAMMA], [2, 0.5]], rtol=1e-14)


def test_a_site_without_clocks_is_its_exponential() -> None:
    [group], _ = lifted_groups(alone())
    assert group.lifted.frame_s == 1.0
    np.testing.assert_allclose(group.lifted.p, [[np.exp(-1.0)]], rtol=1e-15)


# Clocks of which one ticks often between the ticks of another, holds that act late, memories, what is heard
# in the frame it is sent in.
RATES = """\
topology: rates
clocks: {{fast: {fast}, slow: {slow}, network: {network}}}
peers: {{user: {{count: 2}}}}
masses:
  device: {{mass: 0.1 kg, damping: 5 N*s/m}}
  cube: {{mass: 0.3 kg, damping: 5 N*s/m}}
couplers:
  near: {{type: SampledSpringDamper, a: device, b: cube, stiffness: 800 N/m, clock: fast, delay: {late}}}
  wall: {{type: VirtualWall, flange: cube, stiffness: 90 N/m, damping: 1 N*s/m, clock: slow}}
  far: {{type: AveragePosition, object: cube, stiffness: 300 N/m, damping: 2 N*s/m, clock: fast, link: lan}}
links: {{lan: {{clock: network, delay: {delay}}}}}
"""


@pytest.mark.parametrize("late", ["0 ms", "0.3 ms", "1 ms", "2.5 ms"])
@pytest.mark.parametrize("delay", ["0 ms", "8 ms", "11 ms"])
@pytest.mark.parametrize(
    "rates", [("1 ms", "16 ms", "16 ms"), ("1 ms", "4 ms", "8 ms"), ("0.5 ms", "3 ms", "2 ms")]
)
def test_events_that_repeat_are_squared_to_what_they_make_one_by_one(
    late: str, delay: str, rates: tuple[str, str, str]
) -> None:
    fast, slow, network = rates
    text = RATES.format(fast=fast, slow=slow, network=network, late=late, delay=delay)
    groups, _ = lifted_groups(compiled(text))
    squared = 0
    for group in groups:
        schedule = group.schedule
        squared += schedule.repeats is not None
        durations = step_durations(schedule)
        found = discretize(group.exact.a, group.exact.b, [one * schedule.quantum for one in durations])
        steps = dict(zip(durations, found, strict=True))
        one_by_one = composed_bounded(group.site, replace(schedule, repeats=None), steps)
        for mine, other in zip(
            composed_bounded(group.site, schedule, steps).blocks, one_by_one.blocks, strict=True
        ):
            assert (np.abs(value_of(mine) - value_of(other)) <= radius_of(mine) + radius_of(other)).all()
            assert (radius_of(mine) <= 2 * radius_of(other) + 1e-18).all()
    assert squared or slow != "16 ms"
