"""The paper's users played in time, event by event, by hand: the check on `apc simulate`, none of its code.

Point masses under held forces in closed form; every packet and every force is a row of a list with the time
it was sent or computed, and whoever needs one looks for the newest that counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

MS = Fraction(1, 1000)


@dataclass(frozen=True)
class User:
    """Where a user starts and how it pushes; `side` is 0 for a contact that also pulls."""

    device_x: float = 0.0
    force: float = 0.0
    side: int = 0
    device_v: float = 0.0
    cube_x: float = 0.0


@dataclass(frozen=True)
class Play:
    """The scene; masses of one copy."""

    users: tuple[User, ...]
    operator: str = "mean"
    device: float = 0.1
    device_damping: float = 5.0
    cube: float = 0.2
    cube_damping: float = 5.0
    half_width: float = 0.0
    kc: float = 1000.0
    bc: float = 0.0
    kt: float = 500.0
    bt: float = 0.0
    comp: Fraction = MS
    comm: Fraction = 8 * MS
    haptic: Fraction = MS
    network: Fraction = 8 * MS


def coast(x: float, v: float, force: float, mass: float, damping: float, t: float) -> tuple[float, float]:
    """Move a damped mass under a constant force: m dv/dt = F − b v."""
    rate = damping / mass
    decay = math.exp(-rate * t)
    terminal = force / damping
    return x + terminal * t + (v - terminal) * -math.expm1(-rate * t) / rate, terminal + (
        v - terminal
    ) * decay


def play(scene: Play, duration: Fraction) -> list[list[float]]:
    """Return a row for every haptic tick until the end: time, then x, v, x_O, v_O, F_C, F_T of every user.

    The forces are those computed at the tick before.
    """
    n = len(scene.users)
    motion = [[one.device_x, one.device_v, one.cube_x, 0.0] for one in scene.users]
    forces: list[list[tuple[Fraction, float, float]]] = [[] for _ in scene.users]
    packets: list[list[tuple[Fraction, float, float]]] = [[(-Fraction(10**6), m[2], m[3])] for m in motion]
    instants = {k * scene.haptic for k in range(int(duration / scene.haptic) + 1)}
    instants |= {k * scene.haptic + scene.comp for k in range(int(duration / scene.haptic) + 1)}
    instants |= {k * scene.network for k in range(int(duration / scene.network) + 1)}
    times = sorted(one for one in instants if one <= duration)
    rows = []
    for i, now in enumerate(times):
        if now % scene.haptic == 0:
            row = [float(now)]
            for m, f in zip(motion, forces, strict=True):
                row += [*m, *(f[-1][1:] if f else (0.0, 0.0))]
            rows.append(row)
        if now % scene.network == 0:
            for m, p in zip(motion, packets, strict=True):
                p.append((now, m[2], m[3]))
        if now % scene.haptic == 0:
            heard = [[one for one in p if one[0] + scene.comm <= now][-1] for p in packets]
            for j, (user, m) in enumerate(zip(scene.users, motion, strict=True)):
                forces[j].append((now, contact(scene, user, m), pull(scene, j, m, heard, n)))
        end = times[i + 1] if i + 1 < len(times) else duration
        for j, (user, f) in enumerate(zip(scene.users, forces, strict=True)):
            acting = [one for one in f if one[0] + scene.comp <= now]
            f_c, f_t = acting[-1][1:] if acting else (0.0, 0.0)
            x, v, x_o, v_o = motion[j]
            t = float(end - now)
            x, v = coast(x, v, user.force - f_c, scene.device, scene.device_damping, t)
            x_o, v_o = coast(x_o, v_o, f_c - f_t, scene.cube, scene.cube_damping, t)
            motion[j] = [x, v, x_o, v_o]
            del f[:-40]
            del packets[j][:-40]
    return rows


def contact(scene: Play, user: User, m: Sequence[float]) -> float:
    """Return the force of the device on its copy of the cube."""
    if not user.side:
        return scene.kc * (m[0] - m[2]) + scene.bc * (m[1] - m[3])
    side = -1.0 if user.side > 0 else 1.0  # a user at the right pushes to the left
    depth = scene.half_width + side * (m[0] - m[2])
    return side * max(0.0, scene.kc * depth + scene.bc * side * (m[1] - m[3])) if depth > 0 else 0.0


def pull(scene: Play, j: int, m: Sequence[float], heard: Sequence[Sequence[float]], n: int) -> float:
    """Return the force that pulls a copy back to the others."""
    others = [one for i, one in enumerate(heard) if i != j]
    f = 0.0
    for _, x, v in others:
        f += scene.kt * (m[2] - x) + scene.bt * (m[3] - v)
    return f / len(others) if scene.operator == "mean" else f


def experiment(operator: str) -> Play:
    """Return the paper's experiment: one user pushes with 4 N against two with 2 N each."""
    right, left = User(0.03, -4.0, 1), User(-0.03, 2.0, -1)
    return Play(
        (right, left, left),
        operator,
        cube=0.1,
        half_width=0.02,
        kc=3900.0,
        bc=0.05,
        kt=2000.0,
        bt=1.0,
        comp=Fraction(0),
    )
