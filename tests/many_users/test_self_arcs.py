"""A peer that sends to itself over a link: one networked loop, stepped by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.compiler.errors import ApcError
from tests.topologies import compiled

MASS, DAMPING, STIFFNESS = 0.1, 1.0, 100.0  # kg, N·s/m, N/m


def topology(graph: str = "{arcs: [[1, 1]]}", loss: str = "", count: int = 1) -> str:
    return (
        "topology: loop\nclocks: {haptic: 1 ms, network: 8 ms}\n"
        f"peers: {{user: {{count: {count}}}}}\n"
        f"masses: {{device: {{mass: {MASS} kg, damping: {DAMPING} N*s/m}}}}\n"
        "couplers:\n  pull: {type: AveragePosition, object: device, stiffness: "
        f"{STIFFNESS} N/m, clock: haptic, link: lan}}\n"
        f"links: {{lan: {{clock: network, delay: 8 ms{loss}, graph: {graph}}}}}\n"
    )


def frame() -> NDArray[np.float64]:
    """Return the map of (x, v, packet) over 8 ms: F = K (x(t_k - 8 ms) - x) at each millisecond."""
    rate = DAMPING / MASS
    decay = math.exp(-rate * 1e-3)
    reach = (1 - decay) / rate
    step = np.array([[1, reach], [0, decay]])
    push = np.array([(1e-3 - reach) / DAMPING, (1 - decay) / DAMPING])
    columns = []
    for x, v, packet in np.eye(3):
        state = np.array([x, v])
        for _ in range(8):
            state = step @ state + push * STIFFNESS * (packet - state[0])
        columns.append([*state, x])
    return np.array(columns).T


def test_the_loop_is_that_by_hand() -> None:
    found = apc.analyze(compiled(topology()))
    values = sorted(abs(np.linalg.eigvals(frame())))
    assert found.rigid_modes == 1
    assert found.spectral_radius == pytest.approx(values[-2], rel=1e-12)


def test_a_simulation_is_the_same() -> None:
    found = apc.simulate(compiled(topology()), duration="0.4 s", params={"device.v": 1.0})
    state = np.linalg.matrix_power(frame(), 50) @ [0, 1, 0]
    ends = {signal.name: value for signal, value in zip(found.signals, found.values[-1], strict=True)}
    assert ends["user[1].device.x"] == pytest.approx(state[0], rel=1e-9)


def test_its_losses_are_not_judged() -> None:
    found = apc.mean_square_stability(compiled(topology(loss=", loss: 20 %")))
    assert found.stable is None and "a peer sends to itself" in str(found)


@pytest.mark.parametrize("graph", ["{edges: [[1, 1]]}", "complete", "{arcs: [[1, 2]]}"])
def test_one_peer_receives_only_over_an_arc_to_itself(graph: str) -> None:
    with pytest.raises(ApcError, match=r"E208|E213"):
        compiled(topology(graph))
