"""The three-user topology of Rakhsha and Constantinescu by programs written for it alone.

"Section" is the paper's; models/topologies/three-users-average.yaml states the same topology. Nothing here is
compiled: who compares with it compares with a second statement.
"""

from __future__ import annotations

import ctypes
import functools
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from apc.benchmark.timing import timed
from apc.simulation.c_compiler import native

Floats = NDArray[np.float64]

# Section III, before Fig. 3: m_HD, b_HD; m_O, b_O; T_c = T_VE; T_n = T_d.
USERS = 3
DEVICE_MASS, DEVICE_DAMPING = 0.1, 5.0  # kg, N·s/m
SHARED_MASS, CUBE_DAMPING = 0.6, 5.0  # kg, N·s/m: each copy has its share of the mass and the whole damping
CUBE_MASS = SHARED_MASS / USERS
TICK, FRAME = 1e-3, 8e-3  # s: forces act a tick after theirs, packets are used a frame after theirs
TICKS = 8  # in a frame

# A point inside the stable region of Fig. 3 (b), the topology file's own; there B_C = B_T = 0.
K_C, K_T = 1000.0, 500.0  # N/m

# Where the first device starts when the topology is played: the paper's has no start. m
START = 0.01

# ---- stability ----


@functools.cache
def by_exponential(mass: float, damping: float) -> Floats:
    """Return [F G] (2, 3) of a damped mass over a tick."""
    return np.asarray(expm(np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]]) * TICK)[:2])


def user(
    contact: float = K_C, coordination: float = K_T, damping: float = DEVICE_DAMPING
) -> tuple[Floats, Floats]:
    """Return a tick over (x_H, v_H, x_O, v_O, F_C, F_T, packet), and what of the others' packets is heard."""
    device, cube = by_exponential(DEVICE_MASS, damping), by_exponential(CUBE_MASS, damping)
    tick, receives = np.zeros((7, 7)), np.zeros((7, 7))
    tick[:2, :2], tick[:2, 4] = device[:, :2], -device[:, 2]
    tick[2:4, 2:4], tick[2:4, 4], tick[2:4, 5] = cube[:, :2], cube[:, 2], -cube[:, 2]
    tick[4, [0, 2]], tick[5, 2], tick[6, 6] = [contact, -contact], coordination, 1
    receives[5, 6] = -coordination
    return tick, receives


def whole_frame(tick: Floats, receives: Floats) -> Floats:
    """Return the map (21, 21) of one frame of all users, each hearing the mean of the others."""
    mean = (np.ones((USERS, USERS)) - np.eye(USERS)) / (USERS - 1)
    fast = np.kron(np.eye(USERS), tick) + np.kron(mean, receives)
    frame = np.linalg.matrix_power(fast, TICKS)
    frame[6::7] = np.kron(np.eye(USERS), np.eye(7)[2])  # sent at the frame's start, heard in the next
    return frame


def radius(damping: float) -> float:
    """Return the spectral radius of a frame of all users, without the eigenvalue nearest to 1."""
    values = np.linalg.eigvals(whole_frame(*user(damping=damping)))
    return float(np.abs(np.delete(values, np.argmin(np.abs(values - 1)))).max())


def mode_frames(contact: Floats, coordination: Floats, damping: float) -> Floats:
    """Return a frame (2, k, 7, 7) of each of two modes at many points (k,), as an expert writes it.

    The mean of the others is 1 times one's own packets where all move alike, −1/2 times where apart.
    """
    tick = np.zeros((2, len(contact), 7, 7))
    tick[:, :] = user(0.0, 0.0, damping)[0]
    tick[:, :, 4, 0], tick[:, :, 4, 2] = contact, -contact
    tick[:, :, 5, 2] = coordination
    tick[0, :, 5, 6], tick[1, :, 5, 6] = -coordination, coordination / (USERS - 1)
    for _ in range(TICKS.bit_length() - 1):
        tick = tick @ tick
    tick[:, :, 6] = np.eye(7)[2]
    return tick


def mode_radius(damping: float) -> float:
    """Return the spectral radius of one point, with participation and a disc of Gershgorin's a value."""
    frames = mode_frames(np.array([K_C]), np.array([K_T]), damping)[:, 0]
    values, vectors = np.linalg.eig(frames)
    inverse = np.linalg.inv(vectors)
    shares = np.abs(inverse.swapaxes(1, 2) * vectors)
    rounded = 7 * np.finfo(float).eps * np.abs(inverse) @ np.abs(frames) @ np.abs(vectors)
    off = np.abs(inverse @ frames @ vectors - np.eye(7) * values[:, None])
    assert (off + rounded).sum(axis=2).shape == shares[..., 0].shape
    return float(np.abs(np.delete(values, np.argmin(np.abs(values[0] - 1)))).max())  # all moving together


def modal_radii(contact: Floats, coordination: Floats) -> Floats:
    """Return the spectral radii (k,) of many points, the eigenvalue next to 1 of the first mode left out."""
    values = np.linalg.eigvals(mode_frames(contact, coordination, DEVICE_DAMPING))
    sizes = np.abs(values)
    sizes[0][np.abs(values[0] - 1) < 1e-7] = 0
    return np.asarray(sizes.max(axis=(0, 2)))


# ---- playing ----


def plant() -> tuple[Floats, Floats]:
    """Return A (4, 4) and B (4, 2) of dx/dt = A x + B F, x = (x_H, v_H, x_O, v_O), F = (F_C, F_T)."""
    a, b = np.zeros((4, 4)), np.zeros((4, 2))
    a[0, 1] = a[2, 3] = 1
    a[1, 1], a[3, 3] = -DEVICE_DAMPING / DEVICE_MASS, -CUBE_DAMPING / CUBE_MASS
    b[1, 0], b[3, 0], b[3, 1] = -1 / DEVICE_MASS, 1 / CUBE_MASS, -1 / CUBE_MASS
    return a, b


def moves() -> Floats:
    """Return (4, 6): what the states and the forces of a tick make of the states."""
    return user()[0][:4, :6]


def numpy_loop(ticks: int) -> Floats:
    """Play the three-user topology in NumPy, all users at once, a tick at a time; return (ticks, 3, 6)."""
    step = moves().T
    x, force = np.zeros((USERS, 4)), np.zeros((USERS, 2))
    x[0, 0] = START
    sent, received = np.zeros(USERS), np.zeros(USERS)
    rows = np.empty((ticks, USERS, 6))
    for k in range(ticks):
        rows[k, :, :4], rows[k, :, 4:] = x, force
        if k % TICKS == 0:
            received, sent = sent, x[:, 2].copy()
        acting, others = force, (received.sum() - received) / (USERS - 1)
        force = np.stack([K_C * (x[:, 0] - x[:, 2]), K_T * (x[:, 2] - others)], axis=1)
        x = x @ step[:4] + acting @ step[4:]
    return rows


def c_loop(number: int, frames: int, moved: int) -> Floats:
    """Play equal peers in C, the first so many moved; return their states (4, number) after the frames."""
    names = ("a", "b", "c", "d", "f_now", "g_now")
    sums = [
        " + ".join(f"{float(value)!r} * {name}" for value, name in zip(row, names, strict=True) if value)
        for row in moves()
    ]
    code = Path(__file__).with_name("by_hand.c").read_text(encoding="utf-8")
    named = {"TICKS": TICKS, "K_C": K_C, "K_T": K_T} | dict(zip(("P", "Q", "R", "S"), sums, strict=True))
    defined = "".join(f"#define {name} ({value})\n" for name, value in named.items())
    library = native(defined + code, many=True)
    assert library is not None, "there is no C compiler"
    memory = np.zeros((8, number))
    memory[0, :moved] = START
    library.play.argtypes = [ctypes.c_int64, ctypes.c_int64, *[ctypes.c_void_p] * 8]
    library.play(number, frames, *(row.ctypes.data for row in memory))
    return memory[:4]


def by_pathsim(seconds: float, tolerance: float | None) -> tuple[float, Floats]:
    """Play the topology in PathSim (pathsim.readthedocs.io); return the seconds and the states at every tick.

    It is given one linear plant of 12 states, a function of the forces, and sample-and-holds. It runs what
    happens at one instant in the order in which the blocks are listed, each seeing what those before it did;
    the hold that lets a force act is listed before the one that computes it, and takes the force of the tick
    before. A packet is handed on half a millisecond before it is due.
    """
    from pathsim import Connection, Simulation
    from pathsim.blocks import Function, SampleHold, Scope, StateSpace
    from pathsim.solvers import RKDP54

    users = np.eye(USERS)
    a, b = (np.kron(users, one) for one in plant())
    own = np.kron(users, [[K_C, 0, -K_C, 0], [0, 0, K_T, 0]])
    others = np.kron((np.ones((USERS, USERS)) - users) / (USERS - 1), [[0.0], [-K_T]])
    system = StateSpace(a, b, np.eye(12), np.zeros((12, 6)), initial_value=START * np.eye(12)[0])
    forces = Function(lambda *received: own @ np.array(received[:12]) + others @ np.array(received[12:]))
    computed, acting = SampleHold(TICK), SampleHold(TICK)
    used, due = SampleHold(FRAME), SampleHold(FRAME, FRAME - TICK / 2)
    scope = Scope(sampling_period=TICK)
    wires = [
        Connection(system[:12], forces[:12], scope[:12]),
        *(Connection(system[4 * place + 2], used[place]) for place in range(USERS)),
        Connection(used[:3], due[:3]),
        Connection(due[:3], forces[12:15]),
        Connection(forces[:6], computed[:6]),
        Connection(computed[:6], acting[:6]),
        Connection(acting[:6], system[:6]),
    ]
    blocks = [system, forces, scope, acting, due, computed, used]
    requested = {} if tolerance is None else {"tolerance_lte_abs": tolerance, "tolerance_lte_rel": tolerance}
    simulation = Simulation(blocks, wires, dt=TICK / 2, Solver=RKDP54, log=False, **requested)
    seconds_taken, _ = timed(
        partial(simulation.run, seconds + TICK / 4)
    )  # past the last tick, however rounded
    _, rows = scope.read()
    return seconds_taken, np.asarray(rows).T[: round(seconds / TICK) + 1]
