"""Schemes of a few peers, tick by tick, by hand: laws as their sources have them, none of the runtime's code.

The bodies of a peer are point masses under held forces, in closed form. All columns of the frame's matrix go
through one frame together: a number is a row, what it is of each state at the beginning.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# What a peer computes at a tick: (peer, its bodies' positions and velocities, the newest packets of the
# others by peer, each with its age in seconds behind it, its memory) → (forces on the bodies, its memory,
# what it holds to be sent).
Law = Callable[
    [int, Sequence[tuple[Any, Any]], dict[int, Sequence[Any]], Sequence[Any]], tuple[Any, Any, Any]
]


# (sender, receiver, tick) → which packet counts, and whether a newer one is missing. The number 0 is the
# first that was sent, −1 stands for the start values.
Late = Callable[[int, int, int], tuple[int, bool]]


@dataclass(frozen=True)
class ByHand:
    """A scheme: force ticks every millisecond, packets every `ratio` of them, `late` and `comp` in ticks.

    `bodies` are by peer (mass, damping, springs to the ground). A packet holds the sampled (x, v) of `many`
    bodies from `first_sent` on, and what the law put out at the tick before. `receives` are by peer those it
    hears.
    Where a packet is missing and `zero` is set, a peer hears its own motion in its place.
    """

    bodies: Sequence[Sequence[tuple[float, float, float]]]
    receives: Sequence[Sequence[int]]
    law: Law
    first_sent: int
    many: int = 1
    memory: int = 0
    out: int = 0
    ratio: int = 8
    late: int | Late = 8
    comp: int = 1
    period: float = 1e-3
    zero: bool = False

    def sampled(self, motion: Sequence[tuple[Any, Any]]) -> list[Any]:
        """Return what is sent of a peer's motion."""
        return [value for body in motion[self.first_sent : self.first_sent + self.many] for value in body]

    @property
    def stored(self) -> int:
        """How many packets of a peer are kept from before a frame."""
        return -(-self.late // self.ratio) + 1 if isinstance(self.late, int) else 1

    def counts(self, sender: int, receiver: int, tick: int) -> tuple[int, bool]:
        """Return the packet that counts on a way at a tick, and whether a newer one is missing."""
        if isinstance(self.late, int):
            return (tick - self.late) // self.ratio, False
        return self.late(sender, receiver, tick)


@dataclass
class Playing:
    """What all peers hold: newest first what is computed and waits, and packets."""

    motion: list[Any]
    forces: list[Any]
    memory: list[Any]
    out: list[Any]
    packets: list[Any]


def _tick(scheme: ByHand, now: Playing, tick: int) -> None:
    """Play a tick, and the time to the next."""
    peers = range(len(scheme.bodies))
    if tick % scheme.ratio == 0:
        for i in peers:
            now.packets[i] = [[*scheme.sampled(now.motion[i]), *now.out[i]], *now.packets[i]]
    acting: list[Any] = []
    for i in peers:
        received = {}
        for j in scheme.receives[i]:
            number, missing = scheme.counts(j, i, tick)
            packet = now.packets[j][tick // scheme.ratio - number]
            if missing and scheme.zero:
                packet = scheme.sampled(now.motion[i])
            received[j] = [*packet, (tick - number * scheme.ratio) * scheme.period]
        new, now.memory[i], now.out[i] = scheme.law(i, now.motion[i], received, now.memory[i])
        queue = [list(new), *now.forces[i]]
        acting.append(queue[scheme.comp])
        now.forces[i] = queue[: scheme.comp]
    for i in peers:
        now.motion[i] = [
            coast(x, v, force, *body, scheme.period)
            for (x, v), force, body in zip(now.motion[i], acting[i], scheme.bodies[i], strict=True)
        ]


def frame_matrix(scheme: ByHand) -> NDArray[np.float64]:
    """Return the one-frame matrix of all peers."""
    stored = scheme.stored
    sizes = [
        2 * len(own)
        + scheme.comp * len(own)
        + scheme.memory
        + scheme.out
        + stored * (2 * scheme.many + scheme.out)
        for own in scheme.bodies
    ]
    rows = iter(np.eye(sum(sizes)))
    now = Playing([], [], [], [], [])
    for own in scheme.bodies:
        now.motion.append([(next(rows), next(rows)) for _ in own])
        now.forces.append([[next(rows) for _ in own] for _ in range(scheme.comp)])
        now.memory.append([next(rows) for _ in range(scheme.memory)])
        now.out.append([next(rows) for _ in range(scheme.out)])
        now.packets.append([[next(rows) for _ in range(2 * scheme.many + scheme.out)] for _ in range(stored)])
    assert next(rows, None) is None
    for tick in range(scheme.ratio):
        _tick(scheme, now, tick)
    rows_out = []
    for i in range(len(scheme.bodies)):
        rows_out += [value for pair in now.motion[i] for value in pair]
        rows_out += [value for one in now.forces[i] for value in one]
        rows_out += [
            *now.memory[i],
            *now.out[i],
            *(value for one in now.packets[i][:stored] for value in one),
        ]
    return np.array(rows_out)


def course(
    scheme: ByHand, starts: Sequence[Sequence[tuple[float, float]]], memory: Sequence[Sequence[float]] = ()
) -> Iterator[Playing]:
    """Yield all that is held before each tick, of a law that need not be linear; it changes on the way.

    Parameters
    ----------
    scheme
        The scheme.
    starts
        By peer the position and velocity of each body; who is not heard yet stands there.
    memory
        By peer its memory at first, none if left out.
    """
    silent = [0.0] * scheme.out
    now = Playing(
        motion=[list(own) for own in starts],
        forces=[[[0.0] * len(own)] * scheme.comp for own in starts],
        memory=[list(own) for own in memory or [()] * len(starts)],
        out=[silent for _ in starts],
        packets=[[[*scheme.sampled(own), *silent]] * scheme.stored for own in starts],
    )
    for tick in itertools.count():
        yield now
        _tick(scheme, now, tick)


def played(
    scheme: ByHand,
    starts: Sequence[Sequence[tuple[float, float]]],
    memory: Sequence[Sequence[float]],
    ticks: int,
) -> NDArray[np.float64]:
    """Return the positions at each tick (ticks, bodies of all peers)."""
    rows = itertools.islice(course(scheme, starts, memory), ticks)
    return np.array([[x for own in now.motion for x, _ in own] for now in rows])


def experiment(operator: str, ticks: int) -> NDArray[np.float64]:
    """Return the paper's experiment: one user pushes with 4 N against two with 2 N each.

    The rows are x, v, x_O, v_O and the forces F_C, F_T computed at the tick before (ticks, users, 6).
    """
    pushes, half_width = [-4.0, 2.0, 2.0], 0.02

    def law(i: int, motion: Sequence[tuple[Any, Any]], received: Any, memory: Any) -> tuple[Any, Any, Any]:
        (x, v), (x_o, v_o) = motion
        side = math.copysign(1.0, pushes[i])  # the user at the right pushes to the left
        depth = half_width + side * (x - x_o)
        f_c = side * max(0.0, 3900 * depth + 0.05 * side * (v - v_o)) if depth > 0 else 0.0
        f_t = sum(2000 * (x_o - packet[0]) + v_o - packet[1] for packet in received.values())
        f_t = f_t / 2 if operator == "mean" else f_t
        return [pushes[i] - f_c, f_c - f_t], [f_c, f_t], []

    bodies = [[(0.1, 5.0, 0.0)] * 2] * 3
    scheme = ByHand(bodies, everybody(3), law, first_sent=1, memory=2, comp=0)
    starts = [[(-math.copysign(0.03, push), 0.0), (0.0, 0.0)] for push in pushes]
    rows = itertools.islice(course(scheme, starts, [[0.0, 0.0]] * 3), ticks)
    return np.array(
        [[[*motion[0], *motion[1], *now.memory[i]] for i, motion in enumerate(now.motion)] for now in rows]
    )


def coast(
    x: Any, v: Any, force: Any, mass: float, damping: float, spring: float, time: float
) -> tuple[Any, Any]:
    """Move a mass under a constant force: m x'' + b x' + k x = F, by its two roots (or m v' + b v = F)."""
    if spring == 0:
        decay = math.exp(-damping * time / mass) if damping else 1.0
        rise = (1 - decay) / damping if damping else time / mass  # ∫₀ᵗ e^(−b s/m)/m ds
        far = (time - mass * rise) / damping if damping else time**2 / (2 * mass)
        return x + mass * rise * v + far * force, decay * v + rise * force
    half, rest = damping / (2 * mass), force / spring
    turn = cmath.sqrt(spring / mass - half**2)  # imaginary where damping keeps it from turning
    decay, cos, sine = (
        math.exp(-half * time),
        cmath.cos(turn * time).real,
        (cmath.sin(turn * time) / turn).real,
    )
    y = x - rest
    return (
        rest + decay * (y * (cos + half * sine) + v * sine),
        decay * (v * (cos - half * sine) - y * (spring / mass) * sine),
    )


def magnitudes(scheme: ByHand) -> tuple[int, float]:
    """Return how many eigenvalues are 1 to rounding, and the largest magnitude of the others."""
    values = np.linalg.eigvals(frame_matrix(scheme))
    rigid = np.abs(values - 1) < 1e-6
    return int(rigid.sum()), float(np.abs(values[~rigid]).max())


def everybody(peers: int) -> list[list[int]]:
    """Return by peer all others."""
    return [[j for j in range(peers) if j != i] for i in range(peers)]


def mean(received: dict[int, Sequence[Any]], place: int) -> Any:
    """Return the mean of one channel over those heard."""
    return sum(packet[place] for packet in received.values()) / len(received)
