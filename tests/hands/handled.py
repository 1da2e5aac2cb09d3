"""What the paper's users feel, by one dense system of all of them: a program that knows no lifting or modes.

A device (m, 5 N·s/m) and a copy of the cube (0.6 kg/N, 5 N·s/m) at each user; a spring of 1000 N/m between
them from samples at each tick of 1 ms, acting a tick later; a spring to the mean of what is heard of others,
sent every eight ticks and a frame late.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Complexes = NDArray[np.complex128]

TICKS, TICK = 8, 1e-3


def responses(
    masses: NDArray[np.float64], stiffness: float, hertz: float, *, ring: bool = False
) -> tuple[complex, complex, complex]:
    """Return velocity here and at the second device, and the first copy's error, a newton at the first.

    ξ⁺ = M ξ + k, ξ⁺ = e^{jωT} ξ. Of x = e^{jωt} w, w' = (A − jω) w + B u e^{−jωt} + b, and the mean of w over
    a frame is what is wanted.
    """
    count, omega = len(masses), 2j * np.pi * hertz
    steps = [_tick(mass, 0.6 / count, omega) for mass in masses.tolist()]
    # Of each peer: both motions, the two forces that act, the position that is on its way; last, 1 N.
    whole = np.eye(7 * count + 1, dtype=complex)
    mean = np.zeros((count, 4, 7 * count + 1), dtype=complex)
    sent = whole[6 : 7 * count : 7]
    if ring:
        received = (np.roll(sent, 1, axis=0) + np.roll(sent, -1, axis=0)) / 2
    else:
        received = (sent.sum(axis=0) - sent) / (count - 1)
    for i in range(count):
        whole[7 * i + 6] = whole[7 * i + 2]
    for tick in range(TICKS):
        turned = np.exp(omega * tick * TICK)
        for i, step in enumerate(steps):
            now = np.concatenate([whole[7 * i : 7 * i + 6], whole[-1:] * turned * (i == 0)])
            moved = step @ now
            pressed, drawn = 1000 * (now[0] - now[2]), stiffness * (now[2] - received[i])
            whole[7 * i : 7 * i + 4], whole[7 * i + 4], whole[7 * i + 5] = moved[:4], pressed, drawn
            mean[i] += moved[4:] / turned / (TICKS * TICK)
    z = np.exp(omega * TICKS * TICK)
    state = np.linalg.solve(z * np.eye(7 * count) - whole[:-1, :-1], whole[:-1, -1])
    motion = mean[:, :, :-1] @ state + mean[:, :, -1]
    return motion[0, 1], motion[1, 1], motion[0, 2] - motion[1:, 2].mean()


def _tick(mass: float, copy: float, omega: complex) -> Complexes:
    """Return what a tick makes of the motions, and ∫ x e^{−jωσ}, of motions, forces and a push (8, 7)."""
    rate = np.zeros((11, 11), dtype=complex)
    rate[0, 1] = rate[2, 3] = 1
    rate[1, [1, 4, 6]] = -5 / mass, -1 / mass, 1 / mass
    rate[3, [3, 4, 5]] = -5 / copy, 1 / copy, -1 / copy
    for place in range(6):  # what is held turns backwards, seen from the push
        rate[place, place] -= omega
    rate[range(7, 11), range(4)] = 1
    moved = scipy.linalg.expm(rate * TICK)
    moved[:4] *= np.exp(omega * TICK)
    return np.asarray(moved[[*range(4), *range(7, 11)], :7])
