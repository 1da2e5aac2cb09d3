"""What published results are compared with: small matrices made by hand, without the program."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq


def held(a: np.ndarray, b: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return e^{A t} and ∫₀ᵗ e^{A s} B ds of x' = A x + B u, with u constant."""
    n = len(a)
    both = expm(np.block([[a, b], [np.zeros((1, n + 1))]]) * time)
    return both[:n, :n], both[:n, n:]


def radius(matrix: np.ndarray) -> float:
    return float(abs(np.linalg.eigvals(matrix)).max())


def last_stable(radius_at: Callable[[float], float], low: float, high: float) -> float:
    """Return where the radius passes 1, by the first of 200 steps after which it is larger."""
    values = np.linspace(low, high, 200)
    after = next(k for k, value in enumerate(values) if radius_at(value) > 1)
    return float(brentq(lambda value: radius_at(value) - 1, *values[after - 1 : after + 1], xtol=1e-15))


# ---- a virtual wall ----


def stiffness_of_wall(m: float, b: float, B: float, T: float, t_d: float) -> float:
    """Return the largest stable stiffness of a wall: m x″ + b x′ = −f(t − t_d).

    f = K x + B (x(t) − x(t − T))/T at each tick, and is held. The states are x, x′, x at the tick before, and
    the forces that do not act yet.
    """
    late = round(t_d / T)
    free, push = held(np.array([[0, 1], [0, -b / m]]), np.array([[0], [1 / m]]), T)

    def radius_at(stiffness: float) -> float:
        force = np.zeros(3 + late)
        force[[0, 2]] = stiffness + B / T, -B / T
        acting = force if not late else np.eye(3 + late)[-1]
        step = np.zeros((3 + late, 3 + late))
        step[:2, :2] = free
        step[:2] -= push * acting
        step[2, 0] = 1
        if late:
            step[3] = force
            step[4:, 3:-1] = np.eye(late - 1)
        return radius(step)

    rule = (b + B) / (T / 2 + t_d)
    return last_stable(radius_at, rule / 100, 1.5 * rule)


# ---- consensus of integrators ----


def delay_of_consensus(L: float, T: float) -> float:
    """Return the largest stable delay d of x′ = −L x, x sampled every T, held, and late by d."""

    def radius_at(delay: float) -> float:
        whole = int(delay // T)
        rest = delay - whole * T
        step = np.diag(np.ones(whole + 1), -1)
        step[0, 0] = 1
        step[0, whole] -= L * (T - rest)
        step[0, whole + 1] -= L * rest
        return radius(step)

    return last_stable(radius_at, T, np.pi / L)


# ---- a motor with a roller ----


def growth(*delays: float) -> float:
    """Return the spectral radius per period of x″ = 126.7 u, u = −50 x − 11.8 x′ of samples every 1 ms.

    The samples act after these delays in turn. The states are x, x′ and u of the tick before.
    """
    period, a, b = 1e-3, np.array([[0.0, 1], [0, 0]]), np.array([[0], [126.7]])
    gain = np.array([[50, 11.8]])
    loop = np.eye(3)
    for delay in delays:
        free, whole = held(a, b, period)
        new = held(a, b, period - delay)[1]
        step = np.block([[free - new @ gain, whole - new], [-gain, np.zeros((1, 1))]])
        loop = step @ loop
    return float(radius(loop) ** (1 / len(delays)))


# ---- sampled state feedback ----


def largest_period(a: float, b: float, k1: float, k2: float) -> float:
    """Return the largest stable period of x″ = −a x′ + b u, u = −k1 x − k2 x′ of samples."""
    process, force, gain = np.array([[0, 1], [0, -a]]), np.array([[0], [b]]), np.array([[k1, k2]])

    def radius_at(period: float) -> float:
        free, push = held(process, force, period)
        return radius(free - push @ gain)

    return last_stable(radius_at, 0.01, 5.0)


def most_losses(T: float, a: float, b: float, k1: float, k2: float) -> int:
    """Return the most consecutive losses whose repetition is stable: the control is held."""
    process, force, gain = np.array([[0, 1], [0, -a]]), np.array([[0], [b]]), np.array([[k1, k2]])
    losses = 0
    while True:
        free, push = held(process, force, (losses + 1) * T)
        if radius(free - push @ gain) > 1:
            return losses - 1
        losses += 1


# ---- words ----


def verdict(*radii: float) -> str:
    """Return the verdict for all of some spectral radii."""
    return "stable" if max(radii) < 1 else "unstable"
