"""Weighted loops of contacts: the forces of all peers at once, frequency by frequency."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

import apc
from apc.analysis.analysis import prepare
from apc.analysis.multipliers import is_proved, least_of, weights_of
from apc.analysis.opened import OpenLoop, open_loops
from tests.test_switching import HELD, TIES, stiff, tick
from tests.topologies import compiled, replaced

Floats = NDArray[np.float64]


def loops_of(system: apc.CompiledSystem) -> list[OpenLoop]:
    found = open_loops(system, prepare(system))
    assert not isinstance(found, str)
    return found


def all_peers(
    count: int, stiffness: float, tie: float, step: Floats, ticks: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the held scene's frame from contact forces to what they follow, peer by peer in each tick.

    The state is, peer by peer, (x, v, x_O, v_O), both forces, and the packet of the frame before.
    """
    states = 7 * count
    whole = np.eye(states + ticks * count)
    follows = []
    for k in range(ticks):
        now = whole[:states].reshape(count, 7, -1).copy()
        if not k:
            heard, now[:, 6] = now[:, 6].copy(), now[:, 2]
        follows.append(stiffness * (now[:, 0] - now[:, 2]))
        q = tie * (now[:, 2] - (heard.sum(axis=0) - heard) / (count - 1))
        now[:, :4] = np.einsum("ij,pjc->pic", step, now[:, :6])
        now[:, 4], now[:, 5] = whole[states + k * count : states + (k + 1) * count], q
        whole[:states] = now.reshape(states, -1)
    y = np.concatenate(follows)
    return whole[:states, :states], whole[:states, states:], y[:, :states], y[:, states:]


def least_real_part(
    count: int, stiffness: float, tie: float, weights: Floats, lag: float, step: Floats
) -> float:
    """Return the least eigenvalue of He M (1 + H), over its weights, on a grid of frequencies."""
    a, b, c, d = all_peers(count, stiffness, tie, step, len(weights))
    size, total = len(c), np.repeat(weights, count)
    before = np.eye(size, k=-count)
    around = np.eye(size, k=size - count)
    h = lag * weights.mean()
    root = np.sqrt(np.outer(total, total))
    least = np.inf
    for angle in np.geomspace(1e-4, np.pi, 4000):
        z = np.exp(1j * angle)
        inner = np.eye(size) - c @ np.linalg.solve(z * np.eye(len(a)) - a, b) - d
        real = (np.diag(total) + h * (np.eye(size) - before - around / z)) @ inner
        least = min(least, float(np.linalg.eigvalsh((real + real.conj().T) / 2 / root)[0]))
    return least


@pytest.mark.few(4)
@pytest.mark.parametrize(("count", "stiffness"), [(2, 100.0), (3, 400.0), (3, 2200.0), (3, 2500.0)])
@pytest.mark.parametrize("lag", [0.0, 1.0, 64.0, 1000.0])
def test_all_peers_at_once_take_out_as_little_energy_as_the_least_of_their_modes(
    count: int, stiffness: float, lag: float
) -> None:
    text = replaced(HELD, ("count: 3", f"count: {count}"), ("mass: 0.6 kg", f"mass: {0.2 * count} kg"))
    text = replaced(text, ("stiffness: 500 N/m", f"stiffness: {TIES[count]} N/m"))
    loops = loops_of(stiff(text, stiffness))
    weights = weights_of(loops)
    assert not isinstance(weights, str)
    found = 1 + min(least_of(one, weights, lag) for one in loops)
    by_tick = np.array([weights["user", "contact.push", k][0] for k in range(8)])
    truth = least_real_part(count, stiffness, TIES[count], by_tick, lag, tick())
    # The grid misses the least by a little, and the pole at 0 Hz loses digits beside it.
    assert found == pytest.approx(truth, rel=1e-3, abs=1e-5 * (1 + lag))
    assert all(is_proved(one, weights, lag) for one in loops) is (truth > 0)


GRIPPED = """\
topology: gripped
clocks: {haptic: 1 ms, slow: 3 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube: {mass: 0.6 kg, damping: 5 N*s/m}
couplers:
  push: {type: OneSidedContact, a: device, b: cube, stiffness: 80 N/m, clock: slow, delay: 1 ms}
  pull: {type: OneSidedContact, a: device, b: cube, side: right, half_width: 5 mm, stiffness: 300 N/m, clock: haptic}
hands:
  arm: {type: SpringDamperArm, flange: device, stiffness: 9 N/m, damping: 1 N*s/m}
"""  # noqa: E501


@pytest.mark.parametrize("lag", [0.0, 4.0, 200.0])
def test_each_contact_of_a_peer_counts_its_own_ticks(lag: float) -> None:
    # A tick of (x, v, x_O, v_O) under both forces, then a frame of three from four forces: one of push, which
    # acts a tick later, and three of pull.
    rates = np.zeros((6, 6))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, [0, 1, 4, 5]] = -90, -60, -10, 10
    rates[3, [3, 4, 5]] = np.array([-5, 1, -1]) / 0.6
    step = expm(1e-3 * rates)[:4]
    whole = np.eye(9)
    apart = np.array([1, 0, -1, 0, 0]) @ whole[:5]
    follows = [80 * apart]
    for k in range(3):
        follows.append(-300 * (whole[0] - whole[2]))
        acting = whole[4] if k == 0 else np.eye(9)[5]
        whole[:4] = step @ np.vstack([whole[:4], acting, np.eye(9)[6 + k]])
    whole[4] = np.eye(9)[5]
    (a, b), y = (whole[:5, :5], whole[:5, 5:]), np.array(follows)

    loops = loops_of(compiled(GRIPPED))
    weights = weights_of(loops)
    assert not isinstance(weights, str)
    (one,) = loops
    listed = [("user", "push.push", 0), *(("user", "pull.push", k) for k in range(3))]
    assert sorted(one.ports) == sorted(listed)
    own = np.array([weights.get(port, (1.0, 0.0))[0] for port in listed])
    h = lag * np.array([own[0], *[own[1:].mean()] * 3])
    before, around = np.diag([0.0, 1, 1], -1), np.zeros((4, 4))
    before[1, 0] = 0.0
    around[0, 0] = around[1, 3] = 1.0
    truth = np.inf
    for angle in np.geomspace(1e-4, np.pi, 4000):
        z = np.exp(1j * angle)
        inner = np.eye(4) - y[:, :5] @ np.linalg.solve(z * np.eye(5) - a, b) - y[:, 5:]
        real = (np.diag(own) + h[:, None] * (np.eye(4) - before - around / z)) @ inner
        scaled = (real + real.conj().T) / 2 / np.sqrt(np.outer(own, own))
        truth = min(truth, float(np.linalg.eigvalsh(scaled)[0]))
    assert 1 + least_of(one, weights, lag) == pytest.approx(truth, rel=1e-3, abs=1e-5 * (1 + lag))
    assert is_proved(one, weights, lag) is (truth > 0)


@pytest.mark.parametrize(("stiffness", "lag"), [(50.0, 0.0), (100.0, 0.0), (1000.0, 64.0), (1500.0, 1000.0)])
def test_several_modes_that_drift_share_a_contact_of_one_tick(stiffness: float, lag: float) -> None:
    # Users whose devices nobody holds, and a network as fast as the contacts: each of them may drift apart.
    text = replaced(HELD.split("hands:")[0], ("network: 8 ms", "network: 1 ms"))
    text = replaced(text, ("delay: 8 ms}", "delay: 1 ms}"), ("stiffness: 500 N/m", "stiffness: 200 N/m"))
    loops = loops_of(stiff(text, stiffness))
    weights = weights_of(loops)
    assert not isinstance(weights, str)
    assert [bool(one.seen) for one in loops] == [True, True]
    own = np.array([weights["user", "contact.push", 0][0]])
    truth = least_real_part(3, stiffness, 200.0, own, lag, tick(arm=(0.0, 0.0)))
    found = 1 + min(least_of(one, weights, lag) for one in loops)
    assert found == pytest.approx(truth, rel=1e-3, abs=1e-5 * (1 + lag))
    assert all(is_proved(one, weights, lag) for one in loops) is (truth > 0)
