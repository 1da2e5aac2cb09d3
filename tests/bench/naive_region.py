"""The obvious program for a stability region: a grid, the frame's matrix by hand, its eigenvalues.

The scene of Rakhsha and Constantinescu (Fig. 3b, average position): three users, each a device and a copy of
the cube, forces every 1 ms acting 1 ms later, positions every 8 ms used 8 ms later; B_C = B_T = 0. The state
is (x_H, v_H, x_O, v_O) of each user, F_C and F_T computed at the last tick, and x_O as sent at the last
frame's start: 12 + 6 + 3 = 21 numbers. The verdict is max |λ| < 1, as one would write it.
`modal_radii` is the same by somebody who knows better.
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


def modal_radii(contact: Floats, coordination: Floats) -> Floats:
    """Return the spectral radii of many points (k,) as an expert writes it: two modes, all points at once.

    The mean of the others is 1 times one's own packets where all move alike, −1/2 times where they move
    apart: 7 states a mode. The eigenvalue next to 1 of the first is left out.
    """
    a, b = user_plant()
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)
    tick = np.zeros((2, len(contact), 7, 7))
    tick[:, :, :4, :6] = both[:4]
    tick[:, :, 4, 0], tick[:, :, 4, 2] = contact, -contact
    tick[:, :, 5, 2], tick[:, :, 6, 6] = coordination, 1
    tick[0, :, 5, 6], tick[1, :, 5, 6] = -coordination, coordination / (USERS - 1)
    for _ in range(TICKS.bit_length() - 1):
        tick = tick @ tick
    tick[:, :, 6] = [0, 0, 1, 0, 0, 0, 0]
    values = np.linalg.eigvals(tick)
    sizes = np.abs(values)
    sizes[0][np.abs(values[0] - 1) < 1e-7] = 0
    return np.asarray(sizes.max(axis=(0, 2)))


def stable_grid(low: float, high: float, count: int) -> NDArray[np.bool_]:
    """Return the verdicts of a grid of K_C (columns) and K_T (rows)."""
    a, b = plant()
    stable = np.zeros((count, count), dtype=bool)
    for column, contact in enumerate(np.linspace(low, high, count)):
        for row, coordination in enumerate(np.linspace(low, high, count)):
            eigenvalues = np.linalg.eigvals(frame(a, b, contact, coordination))
            stable[row, column] = np.max(np.abs(eigenvalues)) < 1
    return stable
