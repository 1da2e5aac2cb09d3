"""The obvious program for a stability region: a grid, the frame's matrix by hand, its eigenvalues.

The scene of Rakhsha and Constantinescu (Fig. 3b, average position): three users, each a device and a copy of
the cube, forces every 1 ms acting 1 ms later, positions every 8 ms used 8 ms later; B_C = B_T = 0. The state
is (x_H, v_H, x_O, v_O) of each user, F_C and F_T computed at the last tick, and x_O as sent at the last
frame's start: 12 + 6 + 3 = 21 numbers. The verdict is max |λ| < 1, as one would write it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from tests.bench.paper_scene import TICK, TICKS, USERS, Floats, user_plant

STATES = 4 * USERS + 2 * USERS + USERS


def plant() -> tuple[Floats, Floats]:
    """Return x⁺ = A x + B F of all users over a tick, F = (F_C, F_T) of each user, held."""
    a, b = user_plant()
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)
    return np.kron(np.eye(USERS), both[:4, :4]), np.kron(np.eye(USERS), both[:4, 4:])


def frame(a: Floats, b: Floats, contact: float, coordination: float) -> Floats:
    """Return the map of one frame for K_C and K_T."""
    tick = np.zeros((STATES, STATES))
    tick[:12, :12] = a
    tick[:12, 12:18] = b
    for user in range(USERS):
        device, copy = 4 * user, 4 * user + 2
        tick[12 + 2 * user, device] = contact
        tick[12 + 2 * user, copy] = -contact
        tick[13 + 2 * user, copy] = coordination
        for other in range(USERS):
            if other != user:
                tick[13 + 2 * user, 18 + other] = -coordination / (USERS - 1)
    tick[18:, 18:] = np.eye(3)
    found = np.eye(STATES)
    for _ in range(TICKS):
        found = tick @ found
    found[18:] = 0
    for user in range(USERS):
        found[18 + user, 4 * user + 2] = 1  # sent at the frame's start, used in the next frame
    return found


def stable_grid(low: float, high: float, count: int) -> NDArray[np.bool_]:
    """Return the verdicts of a grid of K_C (columns) and K_T (rows)."""
    a, b = plant()
    stable = np.zeros((count, count), dtype=bool)
    for column, contact in enumerate(np.linspace(low, high, count)):
        for row, coordination in enumerate(np.linspace(low, high, count)):
            eigenvalues = np.linalg.eigvals(frame(a, b, contact, coordination))
            stable[row, column] = np.max(np.abs(eigenvalues)) < 1
    return stable
