"""The three-user scene of Rakhsha and Constantinescu in numbers, for programs written by hand.

"Section" is the paper's; models/scenes/three-users-average.yaml states the same scene. Nothing here is
compiled: who compares with it compares with a second statement.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Section III, before Fig. 3: m_HD, b_HD; m_O, b_O; T_c = T_VE; T_n = T_d.
USERS = 3
DEVICE_MASS, DEVICE_DAMPING = 0.1, 5.0  # kg, N·s/m
SHARED_MASS, CUBE_DAMPING = 0.6, 5.0  # kg, N·s/m: each copy has its share of the mass and the whole damping
CUBE_MASS = SHARED_MASS / USERS
TICK, FRAME = 1e-3, 8e-3  # s: forces act a tick after theirs, packets are used a frame after theirs
TICKS = 8  # in a frame

# A point inside the stable region of Fig. 3 (b), the scene file's own; there B_C = B_T = 0.
K_C, K_T = 1000.0, 500.0  # N/m

# Where the first device starts when the scene is played: the paper's has no start. m
START = 0.01


def user_plant() -> tuple[Floats, Floats]:
    """Return A (4, 4) and B (4, 2) of dx/dt = A x + B F, x = (x_H, v_H, x_O, v_O), F = (F_C, F_T)."""
    a = np.zeros((4, 4))
    a[0, 1] = a[2, 3] = 1
    a[1, 1], a[3, 3] = -DEVICE_DAMPING / DEVICE_MASS, -CUBE_DAMPING / CUBE_MASS
    b = np.zeros((4, 2))
    b[1, 0], b[3, 0], b[3, 1] = -1 / DEVICE_MASS, 1 / CUBE_MASS, -1 / CUBE_MASS
    return a, b
