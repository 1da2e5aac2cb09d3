"""What is proved to settle, played by a program of its own: random scenes, starts and gaps of contacts."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from apc.compiler.frozen import dataclass
from tests.test_switching import TICK, judged, stiff

Floats = NDArray[np.float64]

STARTS, SECONDS = 24, 6.0


@dataclass(frozen=True, slots=True)
class Drawn:
    """A scene of one-sided contacts in SI; all peers are alike, and press into their contact or off it."""

    count: int
    mass: float
    damping: float
    arm: tuple[float, float, float]  # stiffness, damping, where it holds
    cube: tuple[float, float]  # mass of each copy, damping
    half_width: float
    side: int  # 1: the device is left of the cube
    delay: bool  # of the contact's force, by a tick
    tie: float  # between copies, by a tick later
    pin: float  # of the spring that holds each cube at 0; with none, a cube may drift
    ticks: int  # of a frame, as many as a packet is on its way

    @property
    def inside(self) -> float:
        """How deep the devices would be if nothing pushed them back, in m."""
        return self.half_width + self.side * self.arm[2]

    def scene(self, stiffness: float) -> str:
        """Return the scene's text."""
        alone = self.count == 1
        mass, damping = self.cube
        side, late = "left" if self.side > 0 else "right", "1 ms" if self.delay else "0 ms"
        links = f"links:\n  lan: {{clock: network, delay: {self.ticks} ms}}\n"
        tie = (
            f"  tie: {{type: AveragePosition, object: cube, stiffness: {self.tie!r} N/m, clock: haptic, "
            "delay: 1 ms, link: lan}\n"
        )
        shared = "" if alone else ", shared: true"
        network = "" if alone else f", network: {self.ticks} ms"
        k, b, at = self.arm
        return (
            f"topology: drawn\nclocks: {{haptic: 1 ms{network}}}\npeers: {{user: {{count: {self.count}}}}}\n"
            f"masses:\n  device: {{mass: {self.mass!r} kg, damping: {self.damping!r} N*s/m}}\n"
            f"  cube: {{mass: {mass * self.count!r} kg, damping: {damping!r} N*s/m{shared}}}\n"
            f"couplers:\n  contact: {{type: OneSidedContact, a: device, b: cube, side: {side}, half_width: "
            f"{self.half_width!r} m, stiffness: {stiffness!r} N/m, clock: haptic, delay: {late}}}\n"
            f"{'' if alone else tie}{'' if alone else links}"
            f"hands:\n  arm: {{type: SpringDamperArm, flange: device, stiffness: {k!r} N/m, "
            f"damping: {b!r} N*s/m, position: {at!r} m}}\n"
            f"  pin: {{type: SpringDamperArm, flange: cube, stiffness: {self.pin!r} N/m}}\n"
        )

    def step(self) -> Floats:
        """Return what a tick makes of (x, v, x_O, v_O) under the forces on device and cube, and of 1."""
        rates = np.zeros((7, 7))
        rates[0, 1] = rates[2, 3] = 1.0
        k, b, at = self.arm
        rates[1, [0, 1, 4, 6]] = np.array([-k, -b - self.damping, -1, k * at]) / self.mass
        rates[3, [2, 3, 4, 5]] = np.array([-self.pin, -self.cube[1], 1, -1]) / self.cube[0]
        return np.asarray(expm(rates * TICK)[:4])

    def frame(self, stiffness: float, now: Floats, *, linear: bool = False) -> Floats:
        """Return what a frame makes of many scenes' (x, v, x_O, v_O), push, tie and packet, (7, k, count).

        `linear`: contacts always push and pull, of depth 0 at 0, and nothing loads them.
        """
        step, many = self.step(), now.shape[1:]
        state, push, tie, heard = now[:4], now[4], now[5], now[6]
        packet, load = state[2], np.full(many, 0.0 if linear else 1.0)
        others = (heard.sum(axis=1, keepdims=True) - heard) / max(self.count - 1, 1)
        for _ in range(self.ticks):
            apart = self.side * (state[0] - state[2])
            fresh = stiffness * (apart if linear else np.maximum(self.half_width + apart, 0)) * self.side
            pull = (self.count > 1) * self.tie * (state[2] - others)
            whole = np.array([*state, push if self.delay else fresh, tie, load])
            state = (step @ whole.reshape(7, -1)).reshape(4, *many)
            push, tie = fresh, pull
        return np.array([*state, push, tie, packet])

    def play(self, stiffness: float, start: Floats, frames: int) -> list[float]:
        """Return how far the positions of many scenes go in each frame, of the one that goes furthest.

        `start` (k, count, 4) are positions and speeds; nothing is sent or pushed before.
        """
        nothing = np.zeros(start.shape[:2])
        now = np.array([*np.moveaxis(start, 2, 0), nothing, nothing, start[:, :, 2]])
        moved = []
        for _ in range(frames):
            before, now = now, self.frame(stiffness, now)
            moved.append(float(np.abs(now - before)[[0, 2]].max()))
        return moved

    def growth(self, stiffness: float) -> float:
        """Return what motions grow by in a frame at most, while contacts push and pull."""
        size = 7 * self.count
        units = np.eye(size).reshape(size, 7, self.count).swapaxes(0, 1)
        frame = self.frame(stiffness, units, linear=True).swapaxes(0, 1).reshape(size, size)
        return float(np.abs(np.linalg.eigvals(frame)).max())


def drawn(number: int) -> Drawn:
    """Return a scene."""
    any_of = np.random.default_rng(number)
    side = int(any_of.choice([-1, 1]))
    return Drawn(
        count=int(any_of.choice([1, 2, 3])),
        mass=round(float(any_of.uniform(0.05, 0.3)), 3),
        damping=round(float(any_of.uniform(2.0, 8.0)), 2),
        arm=(
            round(float(any_of.uniform(30, 300)), 1),
            round(float(any_of.uniform(1, 6)), 2),
            round(side * float(any_of.uniform(-0.03, 0.03)), 4),
        ),
        cube=(round(float(any_of.uniform(0.1, 0.5)), 3), round(float(any_of.uniform(2.0, 8.0)), 2)),
        half_width=round(float(any_of.choice([0.0, 0.01, 0.02])), 3),
        side=side,
        delay=bool(any_of.random() < 0.5),
        tie=round(float(any_of.uniform(50, 250)), 1),
        pin=round(float(any_of.uniform(20, 150)) * float(any_of.choice([1, 1, 0])), 1),
        ticks=int(any_of.choice([2, 4, 8])),
    )


def limit_of(scene: Drawn) -> float:
    """Return the stiffness up to which contacts that always push and pull come to rest, to some 1 %."""
    low, high = 10.0, 1e5
    while high / low > 1.01:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if scene.growth(middle) < 1 else (low, middle)
    return low


@pytest.mark.few(4)
@pytest.mark.parametrize("number", range(12))
def test_what_is_said_to_settle_does_from_any_start_and_what_loads_an_unstable_contact_does_not(
    number: int,
) -> None:
    one = drawn(number)
    limit = limit_of(one)
    generator = np.random.default_rng(number)
    start = generator.normal(size=(STARTS, one.count, 4)) * [0.04, 0.4, 0.04, 0.4]
    frames = round(SECONDS / (TICK * one.ticks))
    for share in (0.5, 0.9):
        settles = judged(stiff(one.scene(1.0), share * limit)).settles
        assert settles or share > 0.5  # near the limit a proof may fail
        moved = one.play(share * limit, start, frames) if settles else [1.0, 0.0]
        assert moved[-1] < 1e-3 * moved[0] and moved[-1] < moved[len(moved) // 2] + 1e-12
    assert not judged(stiff(one.scene(1.0), 1.1 * limit)).settles
    if one.pin and one.inside > 1e-3:  # pressed together, contacts have nowhere else to rest
        assert one.play(1.1 * limit, start, frames)[-1] > 1e-6
