"""A device that bounces on a ball, by a program of its own: the reference of `tests.bench.work_precision`.

The equations are written here by hand and solved by the explicit method of Dormand and Prince of order 8
(SciPy's DOP853) at the tightest tolerance it takes. It stops and starts anew at every tick, where the seat's
force jumps, and at every beginning and end of a contact, where the push bends. None of it is the project's:
no component, no compiled function, no CVODES. Hunt and Crossley, J. Applied Mechanics 42 (1975) 440.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.bench.paper_scene import Floats

TICK = 1e-3  # s
RTOL, ATOL = 2.3e-14, 1e-17  # SciPy refuses relative tolerances below 100 roundings
# m: so deep a contact begins, and so far off it ends, so that no crossing is met twice. Positions are rounded
# by 1e-18, and the push at this depth is 1e-16 N at most.
EDGE = 1e-15
LOOSER = 100.0  # the run that shows how far the reference is certain


@dataclass(frozen=True, slots=True)
class Bounce:
    """A scene: kg, N·s/m, N/m^(3/2), N·s/m^(5/2), N/m, N; `start` is the device's (x, v), the ball's is 0."""

    stiffness: float
    damping: float
    device: tuple[float, float] = (0.1, 0.1)  # mass, damping
    ball: tuple[float, float] = (0.3, 1.0)
    seat: tuple[float, float] = (500.0, 1.0)  # stiffness, damping; computed at each tick
    hand: float = 3.0
    start: tuple[float, float] = (-3e-3, 0.3)

    def rate(self, state: Floats, seat: float, touching: bool) -> list[float]:
        """Return the rates of (x, v, x_b, v_b) while the seat pulls with a force."""
        x, v, x_b, v_b = state.tolist()
        depth = x - x_b
        push = 0.0
        if touching and depth > 0:
            push = depth**1.5 * max(0.0, self.stiffness + self.damping * (v - v_b))
        (mass, drag), (mass_b, drag_b) = self.device, self.ball
        return [v, (self.hand - push - drag * v) / mass, v_b, (push - seat - drag_b * v_b) / mass_b]


def positions(bounce: Bounce, ticks: int, rtol: float = RTOL) -> Floats:
    """Return the positions of device and ball just before each tick, from the first on (ticks + 1, 2).

    Parameters
    ----------
    bounce
        The scene.
    ticks
        How many to play.
    rtol
        The relative tolerance of each step.
    """
    state = np.array([*bounce.start, 0.0, 0.0])
    touching = False
    rows = [state[[0, 2]]]
    for tick in range(ticks):
        seat = bounce.seat[0] * state[2] + bounce.seat[1] * state[3]
        now, end = tick * TICK, (tick + 1) * TICK
        while now < end:
            state, now, met = _until(bounce, state, (now, end), seat, touching, rtol)
            touching ^= met
        rows.append(state[[0, 2]])
    return np.array(rows)


def _until(
    bounce: Bounce, state: Floats, span: tuple[float, float], seat: float, touching: bool, rtol: float
) -> tuple[Floats, float, bool]:
    """Go on until the end or until a contact begins or ends; return state, time and whether one did."""

    def depth(_: float, y: Floats) -> float:
        return float(y[0] - y[2]) + (EDGE if touching else -EDGE)

    depth.terminal, depth.direction = True, -1.0 if touching else 1.0  # type: ignore[attr-defined] # SciPy's way
    found = solve_ivp(
        lambda _, y: bounce.rate(y, seat, touching), span, state, "DOP853", events=depth, rtol=rtol, atol=ATOL
    )
    assert found.success, found.message
    return found.y[:, -1], float(found.t[-1]), found.status == 1


def reference(bounce: Bounce, ticks: int) -> tuple[Floats, float]:
    """Return the positions, and how far two runs of different tolerances are apart beside the ranges."""
    rows = positions(bounce, ticks)
    looser = positions(bounce, ticks, LOOSER * RTOL)
    return rows, float((np.abs(rows - looser) / np.ptp(rows, axis=0)).max())
