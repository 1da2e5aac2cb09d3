"""Users who hold their devices, tick by tick: a program of its own, which knows nothing of lifting or modes.

A device (m, b) and a copy of the cube (M/N, B) at each user; a spring K_C between them from samples at each
tick, acting a tick later; a spring K_T to the mean of what the others sent, as old as `late` network ticks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Users:
    """The paper's scene, its numbers in SI; `tick` and `frame` in seconds."""

    count: int
    coupling: float
    contact: float = 1000.0
    late: int = 1
    device: float = 0.1
    damping: float = 5.0
    cube: float = 0.6
    drag: float = 5.0
    tick: float = 1e-3
    ticks: int = 8
    ring: bool = False

    def heard(self, positions: NDArray[Any]) -> NDArray[Any]:
        """Return what each user takes the mean of others, or of its two neighbours, to be."""
        if self.ring:
            return np.asarray((np.roll(positions, 1) + np.roll(positions, -1)) / 2)
        return np.asarray((positions.sum() - positions) / (self.count - 1))

    @property
    def equations(self) -> tuple[Floats, Floats, Floats]:
        """A over (x, v, X, V); what the two held forces do, of which the contact pushes both; a push."""
        copy = self.cube / self.count
        a = np.array(
            [
                [0, 1, 0, 0],
                [0, -self.damping / self.device, 0, 0],
                [0, 0, 0, 1],
                [0, 0, 0, -self.drag / copy],
            ]
        )
        b = np.array([[0, 0], [-1 / self.device, 0], [0, 0], [1 / copy, 1 / copy]], dtype=float)
        return a, b, np.array([0, 1 / self.device, 0, 0])


def response(users: Users, hertz: float, frames: int = 700) -> tuple[complex, complex, complex]:
    """Push the first user by e^{jωt}; return velocities of the first and second, and the first copy's error.

    The motion is followed until it is steady; the fundamental of the last frame is an integral that the
    matrix exponential takes along.
    """
    a, b, push = users.equations
    omega = 2 * np.pi * hertz
    # (x, v, X, V), two held forces, the push e^{jωt}, ∫ e^{−jω(t − t₀)} of v and of X.
    system = np.zeros((9, 9), dtype=complex)
    system[:4, :4], system[:4, 4:6], system[:4, 6] = a, b, push
    system[6, 6] = 1j * omega
    system[7, 1] = system[8, 2] = 1.0
    system[7, 7] = system[8, 8] = 1j * omega
    step = expm(system * users.tick)
    n = users.count
    z = np.zeros((n, 9), dtype=complex)
    contact, pull = np.zeros(n, complex), np.zeros(n, complex)
    packets = [np.zeros(n, complex)] * (users.late + 1)
    found = np.zeros((2, n), dtype=complex)
    for frame in range(frames):
        packets = [z[:, 2].copy(), *packets[:-1]]
        z[:, 7:] = 0
        heard = packets[users.late]
        for tick in range(users.ticks):
            z[:, 4], z[:, 5] = contact, pull
            contact = users.contact * (z[:, 0] - z[:, 2])
            pull = users.coupling * (users.heard(heard) - z[:, 2])
            z[:, 6] = 0
            z[0, 6] = np.exp(1j * omega * (frame * users.ticks + tick) * users.tick)
            z = z @ step.T
        length = users.ticks * users.tick
        turned = np.exp(-1j * omega * (frame + 1) * length)
        found = z[:, 7:].T * turned / length
    velocity, copies = found
    return velocity[0], velocity[1], copies[0] - copies[1:].mean()


def work(users: Users, moved: Complex, angle: float, *, apart: bool, frames: int = 4000) -> float:
    """Move all devices by Re(moved e^{jθk}) (ticks,) in the ticks of frame k; return what a frame takes.

    `moved` is of the first device; the others move alike or, `apart`, so that all add up to nothing. Of the
    last frames, on the average: the work of contacts and of the devices' dampers, in J.
    """
    a, b, _ = users.equations
    copy = np.block([[a[2:, 2:], b[2:]], [np.zeros((2, 4))]])
    step = expm(copy * users.tick)[:2]
    n = users.count
    shape = np.ones(n)
    if apart:
        shape[1:] = -1 / (n - 1)
    x, z = np.zeros(n), np.zeros((n, 2))
    contact, pull = np.zeros(n), np.zeros(n)
    packets = [np.zeros(n)] * (users.late + 1)
    # What sways from frame to frame and adds up to nothing is weighed out.
    weights = np.concatenate([np.zeros(frames // 2), np.hanning(frames - frames // 2)])
    taken = 0.0
    for frame in range(frames):
        packets = [z[:, 0].copy(), *packets[:-1]]
        heard = packets[users.late]
        for tick in range(users.ticks):
            acting, pulling = contact, pull
            contact = users.contact * (x - z[:, 0])
            pull = users.coupling * (users.heard(heard) - z[:, 0])
            gone = shape * (moved[tick] * np.exp(1j * angle * frame)).real
            spent = acting * gone + users.damping * gone**2 / users.tick
            taken += float(weights[frame] * spent.sum())
            x = x + gone
            z = np.column_stack([z, acting, pulling]) @ step.T
    return taken / float(weights.sum())
