"""Schemes of a few peers, tick by tick, by hand: laws as their sources have them, none of the runtime's code.

The bodies of a peer are point masses under held forces, in closed form. All columns of the frame's matrix go
through one frame together: a number is a row, what it is of each state at the beginning.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
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


@dataclass(frozen=True)
class ByHand:
    """A scheme: force ticks every millisecond, packets every `ratio` of them, `late` and `comp` in ticks.

    `bodies` are by peer (mass, damping, springs to the ground). A packet holds the sampled (x, v) of body
    `told` and what the law put out at the tick before. `hears` are by peer those it hears.
    """

    bodies: Sequence[Sequence[tuple[float, float, float]]]
    hears: Sequence[Sequence[int]]
    law: Law
    told: int
    memory: int = 0
    out: int = 0
    ratio: int = 8
    late: int = 8
    comp: int = 1
    period: float = 1e-3


@dataclass
class _Playing:
    """What all peers hold: newest first what is computed and waits, and packets."""

    motion: list[Any]
    forces: list[Any]
    memory: list[Any]
    out: list[Any]
    packets: list[Any]


def _kept(scheme: ByHand) -> int:
    """Return how many packets of a peer are kept."""
    return -(-scheme.late // scheme.ratio) + 1


def _tick(scheme: ByHand, now: _Playing, tick: int) -> None:
    """Play a tick of a frame, and the time to the next."""
    peers = range(len(scheme.bodies))
    if tick == 0:
        for i in peers:
            now.packets[i] = [[*now.motion[i][scheme.told], *now.out[i]], *now.packets[i][:-1]]
    sent = (tick - scheme.late) // scheme.ratio  # the newest packet that is here; 0 is the frame's own
    age = max(-sent, 0)
    seconds = (tick - sent * scheme.ratio) * scheme.period
    acting: list[Any] = []
    for i in peers:
        heard = {j: [*now.packets[j][age], seconds] for j in scheme.hears[i]}
        new, now.memory[i], now.out[i] = scheme.law(i, now.motion[i], heard, now.memory[i])
        queue = [list(new), *now.forces[i]]
        acting.append(queue[scheme.comp])
        now.forces[i] = queue[: scheme.comp]
    for i in peers:
        now.motion[i] = [
            _coast(x, v, force, *body, scheme.period)
            for (x, v), force, body in zip(now.motion[i], acting[i], scheme.bodies[i], strict=True)
        ]


def frame_matrix(scheme: ByHand) -> NDArray[np.float64]:
    """Return the one-frame matrix of all peers."""
    kept = _kept(scheme)
    sizes = [
        2 * len(own) + scheme.comp * len(own) + scheme.memory + scheme.out + kept * (2 + scheme.out)
        for own in scheme.bodies
    ]
    rows = iter(np.eye(sum(sizes)))
    now = _Playing([], [], [], [], [])
    for own in scheme.bodies:
        now.motion.append([(next(rows), next(rows)) for _ in own])
        now.forces.append([[next(rows) for _ in own] for _ in range(scheme.comp)])
        now.memory.append([next(rows) for _ in range(scheme.memory)])
        now.out.append([next(rows) for _ in range(scheme.out)])
        now.packets.append([[next(rows) for _ in range(2 + scheme.out)] for _ in range(kept)])
    assert next(rows, None) is None
    for tick in range(scheme.ratio):
        _tick(scheme, now, tick)
    rows_out = []
    for i in range(len(scheme.bodies)):
        rows_out += [value for pair in now.motion[i] for value in pair]
        rows_out += [value for one in now.forces[i] for value in one]
        rows_out += [*now.memory[i], *now.out[i], *(value for one in now.packets[i] for value in one)]
    return np.array(rows_out)


def played(
    scheme: ByHand,
    starts: Sequence[Sequence[tuple[float, float]]],
    memory: Sequence[Sequence[float]],
    ticks: int,
) -> NDArray[np.float64]:
    """Return the positions at each tick (ticks, bodies of all peers), of a law that need not be linear.

    Parameters
    ----------
    scheme
        The scheme.
    starts
        By peer the position and velocity of each body; who is not heard yet stands there.
    memory
        By peer its memory at first.
    ticks
        How many.
    """
    nought = [[0.0] * len(own) for own in scheme.bodies]
    silent = [0.0] * scheme.out
    now = _Playing(
        motion=[list(own) for own in starts],
        forces=[[own] * scheme.comp for own in nought],
        memory=[list(own) for own in memory],
        out=[silent for _ in starts],
        packets=[[[*own[scheme.told], *silent]] * _kept(scheme) for own in starts],
    )
    found = []
    for tick in range(ticks):
        found.append([x for own in now.motion for x, _ in own])
        _tick(scheme, now, tick % scheme.ratio)
    return np.array(found)


def _coast(
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


def mean(heard: dict[int, Sequence[Any]], place: int) -> Any:
    """Return the mean of one channel over those heard."""
    return sum(packet[place] for packet in heard.values()) / len(heard)
