"""Error against time: what each method gives for its work, on three topologies.

Run it from the project's folder: `python -m tests.bench.work_precision`.

    stiff contact   a device bounces on a hard ball, by Hunt and Crossley's law; a contact lasts a millisecond
    soft contact    the same on foam; a contact lasts twenty
    arm             an arm holds a device that pushes a tool by a spring, forces at ticks: linear

The error is that of the positions, relative to the way they go, against programs that share no method with
those compared: fifty digits event by event (`tests.fifty_digits`) for the arm. For the contacts the equations
are written here by hand (Hunt and Crossley, J. Applied Mechanics 42 (1975) 440) and solved by the explicit
method of Dormand and Prince of order 8 at the tightest tolerance it takes, stopped and started anew at every
tick, where the seat's force jumps, and at every beginning and end of a contact, where the push bends. The
time is that of the run, without preparing it, as a part of real time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp

from apc.benchmark.timing import median_time
from apc.simulation.settings import CVODES, EXACT, TOLERANCE, Method, Settings
from apc.simulation.simulation import prepare
from tests.bench.by_hand import TICK, Floats
from tests.bench.comparison import rows_of
from tests.bench.judge import Judge, decided, parser_of
from tests.fifty_digits.truth import exact_course
from tests.topologies import compiled

DURATION = Fraction(1, 2)
REPEATS = 3
BALL = """\
topology: ball
clocks: {haptic: 1 ms}
peers: {user: {count: 1, set: {device.x: -3 mm, device.v: 0.3 m/s}}}
masses:
  device: {mass: 0.1 kg, damping: 0.1 N*s/m}
  ball:   {mass: 0.3 kg, damping: 1 N*s/m}
couplers:
  contact: {type: HuntCrossleyContact, a: device, b: ball, stiffness: STIFF, damping: DAMPING}
  seat: {type: SampledSpringDamper, a: ball, b: ground, stiffness: 500 N/m, damping: 1 N*s/m, clock: haptic}
hands: {hand: {type: ConstantForce, flange: device, force: 3 N}}
"""
ARM = """\
topology: arm
clocks: {haptic: 1 ms}
peers: {user: {count: 1, set: {device.x: 10 mm}}}
masses:
  device: {mass: 0.1 kg, damping: 0.5 N*s/m}
  tool:   {mass: 0.2 kg, damping: 0.5 N*s/m}
couplers:
  spring: {type: SampledSpringDamper, a: device, b: tool, stiffness: 600 N/m, damping: 1 N*s/m, clock: haptic}
hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 300 N/m, damping: 2 N*s/m}}
"""
CONTACTS = {"stiff contact": (3e6, 1e6), "soft contact": (2e4, 1e4)}  # N/m^(3/2), N·s/m^(5/2)
# Errors of a step add up over a run: at the default's tolerance to hundreds of times that, which is what
# `methods.TOLERANCE` says and what is judged. Of other tolerances nothing is said: in the stiff contact 1e-11
# and 1e-12 come to some 2,000 times theirs. Exact transitions round at each of 500 ticks.
ADDED_UP, ROUNDED = 1e3, 1e-12
MS = Fraction(1, 1000)
STEPS = (MS, MS / 2, MS / 5, MS / 10, MS / 20, MS / 50, MS / 100)
METHODS = [
    *(Method("semi-implicit", step=step) for step in STEPS),
    *(Method("rk4", step=step) for step in STEPS),
    *(Method("cvodes", tolerance=10.0**-n) for n in range(3, 13)),
    Method(EXACT),
]
RTOL, ATOL = 2.3e-14, 1e-17  # SciPy refuses relative tolerances below 100 roundings
# m: so deep a contact begins, and so far off it ends, so that no crossing is met twice. Positions are rounded
# by 1e-18, and the push at this depth is 1e-16 N at most.
EDGE = 1e-15
LOOSER = 100.0  # the run that shows how far the reference is certain


@dataclass(frozen=True, slots=True)
class Bounce:
    """A topology: kg, N·s/m, N/m^(3/2), N·s/m^(5/2), N/m, N; `start` is the device's (x, v), the ball's
    is 0.
    """

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
    """Return the positions of device and ball just before each tick, from the first on (ticks + 1, 2)."""
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


def truth_of(topology: str) -> tuple[str, tuple[str, ...], Floats, float]:
    """Return a topology's text, its positions' names, these at every tick, and how far they are certain."""
    if topology == "arm":
        course = exact_course(compiled(ARM), DURATION)
        assert not isinstance(course, str), course
        places = [place for place, name in enumerate(course[0]) if name.endswith(".x")]
        return ARM, tuple(course[0][place] for place in places), course[1][:, places], 0.0
    stiffness, damping = CONTACTS[topology]
    text = BALL.replace("STIFF", f"{stiffness!r} N/m^(3/2)").replace("DAMPING", f"{damping!r} N*s/m^(5/2)")
    bounce, ticks = Bounce(stiffness, damping), int(DURATION / MS)
    rows = positions(bounce, ticks)
    uncertainty = (np.abs(rows - positions(bounce, ticks, LOOSER * RTOL)) / np.ptp(rows, axis=0)).max()
    return text, ("user[1].device.x", "user[1].ball.x"), rows, float(uncertainty)


def compared(judge: Judge, topology: str, methods: Sequence[Method]) -> None:
    """Print and judge what each method takes and is off by on a topology."""
    text, names, exact, uncertainty = truth_of(topology)
    model = compiled(text)
    print(f"\n{topology}, {float(DURATION):g} s, the truth certain to {uncertainty:.0e}")
    print(f"  {'method':<24}{'error / range':>14}{'of real time':>14}")
    for method in methods:
        ready = prepare(model, Settings(DURATION, method), signals=["*.x"])
        seconds, rows = median_time(partial(rows_of, ready), REPEATS)
        places = [[signal.name for signal in ready.signals].index(name) for name in names]
        error = float((np.abs(rows[:, places] - exact) / np.ptp(exact, axis=0)).max())
        print(f"  {method!s:<24}{error:>14.1e}{seconds / float(DURATION):>14.5f}")
        if method.name == EXACT:
            judge.within(f"{topology}, {method}", error, ROUNDED)
        elif method == Method(CVODES, tolerance=TOLERANCE):
            judge.within(f"{topology}, {method}", error, ADDED_UP * TOLERANCE + uncertainty)


def main() -> None:
    """Print a table a topology."""
    with decided(parser_of("work_precision", __doc__)) as (judge, given):
        every = [Method("cvodes", tolerance=TOLERANCE), Method(EXACT)] if given.quick else METHODS
        stepped = [method for method in every if method.name != EXACT]
        for topology in CONTACTS:
            compared(judge, topology, stepped)
        compared(judge, "arm", every)


if __name__ == "__main__":
    main()
