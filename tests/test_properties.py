"""Random valid scenes: the compiled analysis against N full peers stepped one by one.

The scene's text goes through the compiler and the runtime; `bruteforce` propagates the same peers event by
event with none of their code. `python -m tests.fuzz --scenes 1000` tries more of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from apc.analysis.analysis import lifted_groups
from apc.eigen.modes import dense, split
from tests import bruteforce
from tests.bruteforce import common_period
from tests.topologies import compiled

MS = Fraction(1, 1000)
MOST_TICKS = 24  # a frame, so that stepping stays quick


@dataclass(frozen=True)
class Drawn:
    """A scene: times in ms, groups as (peers, stiffness of the contact, mass of the device)."""

    groups: tuple[tuple[int, int, Fraction], ...]
    operator: str
    haptic: Fraction
    network: Fraction
    haptic_phase: Fraction
    network_phase: Fraction
    comp: Fraction
    comm: Fraction
    own: bool
    kt: int
    bt: int
    bc: int

    @property
    def text(self) -> str:
        """The topology, its times written as ratios of a millisecond."""
        groups = "\n".join(
            f"  g{i}: {{count: {count}, set: {{contact.stiffness: {stiffness} N/m, device.mass: {mass} kg}}}}"
            for i, (count, stiffness, mass) in enumerate(self.groups)
        )
        times = f"clock: haptic, delay: {self.comp} ms"
        coordination = {"mean": "AveragePosition", "sum": "FullMesh"}[self.operator]
        return f"""\
topology: drawn
clocks:
  haptic: {{period: {self.haptic} ms, phase: {self.haptic_phase} ms}}
  network: {{period: {self.network} ms, phase: {self.network_phase} ms}}
peers:
{groups}
masses:
  device: {{mass: 0.1 kg, damping: 5 N*s/m}}
  cube: {{mass: {Fraction(1, 5) * self.peers} kg, damping: 5 N*s/m, shared: true}}
couplers:
  contact:
    {{type: SampledSpringDamper, a: device, b: cube, stiffness: 1 N/m, damping: {self.bc} N*s/m, {times}}}
  coordination:
    {{type: {coordination}, object: cube, stiffness: {self.kt} N/m, damping: {self.bt} N*s/m, {times},
      link: lan, delays: {"own" if self.own else "all"}}}
links:
  lan: {{clock: network, delay: {self.comm} ms}}
"""

    @property
    def peers(self) -> int:
        """The number of peers."""
        return sum(count for count, _, _ in self.groups)

    @property
    def by_hand(self) -> bruteforce.Scene:
        """The same scene, peer by peer."""
        users = [{"kc": float(k), "device": float(m)} for count, k, m in self.groups for _ in range(count)]
        return bruteforce.Scene(
            operator=self.operator,
            peers=self.peers,
            kt=self.kt,
            bt=self.bt,
            bc=self.bc,
            comp=self.comp * MS,
            comm=self.comm * MS,
            own_delay=self.own,
            haptic=self.haptic * MS,
            network=self.network * MS,
            haptic_phase=self.haptic_phase * MS,
            network_phase=self.network_phase * MS,
            users=tuple(users),
        )


@st.composite
def scenes(draw: st.DrawFn) -> Drawn:
    """Draw a scene whose frame holds at most `MOST_TICKS` ticks."""
    periods = st.builds(Fraction, st.integers(1, 6), st.sampled_from([1, 1, 1, 2, 3]))
    haptic = draw(periods)
    network = draw(
        periods.filter(lambda period: common_period(haptic, period) / min(haptic, period) <= MOST_TICKS)
        | st.integers(1, 8).map(lambda times: times * haptic)
    )
    parts = st.sampled_from([Fraction(0), Fraction(0), Fraction(1, 2), Fraction(1, 3), Fraction(7, 10)])
    delays = st.sampled_from([Fraction(tenths, 10) for tenths in (0, 4, 10, 10, 15, 20)])
    count = draw(st.integers(1, 3))
    groups = tuple(
        (
            draw(st.integers(1 if count > 1 else 2, 3 if count == 1 else 2)),
            draw(st.integers(0, 20)) * 100,
            draw(st.sampled_from([Fraction(1, 10), Fraction(1, 5), Fraction(3, 20)])),
        )
        for _ in range(count)
    )
    return Drawn(
        groups,
        draw(st.sampled_from(["mean", "sum"])),
        haptic,
        network,
        draw(parts) * haptic,
        draw(parts) * network,
        draw(delays) * haptic,
        draw(delays) * network,
        draw(st.booleans()),
        draw(st.integers(0, 10)) * 50,
        draw(st.integers(0, 3)),
        draw(st.integers(0, 3)),
    )


def check(drawn: Drawn) -> None:
    """Compare the split and the dense spectrum of a scene with that of peers stepped one by one."""
    groups, exchange = lifted_groups(compiled(drawn.text))
    systems = split(groups, exchange).systems
    modes = np.concatenate([np.repeat(np.linalg.eigvals(one.matrix), one.multiplicity) for one in systems])
    whole = np.linalg.eigvals(dense(groups, exchange).matrix)
    by_hand = np.array(bruteforce.frame_matrix(drawn.by_hand))
    expected = np.linalg.eigvals(by_hand)
    _compare(modes, expected, drawn)
    _compare(whole, expected, drawn)


def _compare(found: np.ndarray, expected: np.ndarray, drawn: Drawn) -> None:
    """Compare two spectra by the sums of their powers, which are smooth where eigenvalues scatter."""
    largest = max(1.0, float(np.abs(expected).max()))
    for power in range(1, 7):
        one, other = ((values / largest) ** power for values in (found, expected))
        bound = 1e-9 * max(1.0, float(np.abs(other).sum()))
        assert abs(one.sum() - other.sum()) < bound, f"trace of power {power}: {drawn.text}"
    apart = abs(np.abs(found).max() - np.abs(expected).max())
    assert apart < 1e-6 * largest, f"the largest differ by {apart}: {drawn.text}"


QUIET = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]


@settings(max_examples=25, derandomize=True, suppress_health_check=QUIET)
@given(scenes())
def test_any_scene_has_the_spectrum_of_its_peers_stepped_one_by_one(drawn: Drawn) -> None:
    check(drawn)


def check_scenes(count: int) -> None:
    """Check that many random scenes; raises AssertionError with the smallest one that differs."""

    @settings(
        max_examples=count,
        deadline=None,  # run without pytest too
        database=None,
        suppress_health_check=QUIET,
        phases=[Phase.generate, Phase.shrink],
    )
    @given(scenes())
    def run(drawn: Drawn) -> None:
        check(drawn)

    run()
