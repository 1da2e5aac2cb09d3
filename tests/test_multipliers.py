"""Weighted loops of contacts: the forces of all peers at once, frequency by frequency."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.analysis.analysis import prepare
from apc.analysis.multipliers import is_proved, least_of, weights_of
from apc.analysis.opened import OpenLoop, open_loops
from tests.test_switching import ALONE, HELD, TIES, stiff, tick
from tests.topologies import compiled, replaced

Floats = NDArray[np.float64]


def loops_of(system: apc.CompiledSystem) -> list[OpenLoop]:
    found = open_loops(system, prepare(system))
    assert not isinstance(found, str)
    return found


def all_peers(count: int, stiffness: float, tie: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the held scene's frame from contact forces to what they follow, peer by peer in each tick.

    The state is, peer by peer, (x, v, x_O, v_O), both forces, and the packet of the frame before.
    """
    step, states = tick(), 7 * count
    whole = np.eye(states + 8 * count)
    follows = []
    for k in range(8):
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


def least_real_part(count: int, stiffness: float, tie: float, weights: Floats, lag: float) -> float:
    """Return the least eigenvalue of He M (1 + H), over its weights, on a grid of frequencies."""
    a, b, c, d = all_peers(count, stiffness, tie)
    size, total = len(c), np.repeat(weights, count)
    before = np.eye(size, k=-count)
    around = np.eye(size, k=size - count)
    h = lag * weights.mean()
    root = np.sqrt(np.outer(total, total))
    least = np.inf
    for angle in np.geomspace(1e-3, np.pi, 3000):
        z = np.exp(1j * angle)
        inner = np.eye(size) - c @ np.linalg.solve(z * np.eye(len(a)) - a, b) - d
        real = (np.diag(total) + h * (np.eye(size) - before - around / z)) @ inner
        least = min(least, float(np.linalg.eigvalsh((real + real.conj().T) / 2 / root)[0]))
    return least


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
    truth = least_real_part(count, stiffness, TIES[count], by_tick, lag)
    # The grid misses the least by a little, and the pole at 0 Hz loses digits beside it.
    assert found == pytest.approx(truth, rel=1e-3, abs=1e-5 * (1 + lag))
    assert all(is_proved(one, weights, lag) for one in loops) is (truth > 0)


def test_contacts_of_one_peer_count_their_own_ticks() -> None:
    # One from the left and one from the right: by symmetry of their signs they weigh alike.
    other = "  stop: {type: OneSidedContact, a: device, b: cube, side: right, half_width: 5 mm, stiffness: 60 N/m, clock: haptic}\n"  # noqa: E501
    text = ALONE.rstrip("\n") + "\n" + other
    text = replaced(text, ("clocks: {haptic: 1 ms}", "clocks: {haptic: 1 ms, slow: 3 ms}"))
    text = replaced(
        text,
        (
            "masses:",
            "hands:\n  arm: {type: SpringDamperArm, flange: device, stiffness: 9 N/m, damping: 1 N*s/m}\nmasses:",
        ),
    )  # noqa: E501
    system = compiled(text.replace("clock: haptic}", "clock: slow}", 1))
    loops = loops_of(system)
    weights = weights_of(loops)
    assert not isinstance(weights, str)
    (one,) = loops
    assert len({port[:2] for port in one.ports}) == 2
    for lag in (0.0, 30.0):
        assert np.isfinite(least_of(one, weights, lag))
