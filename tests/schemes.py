"""Schemes of a few peers, tick by tick, by hand: laws as their sources have them, none of the runtime's code.

The bodies of a peer are point masses under held forces, in closed form. All columns of the frame's matrix go
through one frame together: a number is a row, what it is of each state at the beginning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# What a peer computes at a tick: (peer, its bodies' positions and velocities, by whom it is heard: the newest
# packets of the others by peer, its memory) → (forces on the bodies, its memory, what it holds to be sent).
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


def frame_matrix(scheme: ByHand) -> NDArray[np.float64]:
    """Return the one-frame matrix of all peers."""
    peers = range(len(scheme.bodies))
    kept = -(-scheme.late // scheme.ratio) + 1
    sizes = [
        2 * len(own) + scheme.comp * len(own) + scheme.memory + scheme.out + kept * (2 + scheme.out)
        for own in scheme.bodies
    ]
    rows = iter(np.eye(sum(sizes)))
    motion, forces, memory, out, packets = [], [], [], [], []
    for own in scheme.bodies:
        motion.append([(next(rows), next(rows)) for _ in own])
        forces.append([[next(rows) for _ in own] for _ in range(scheme.comp)])  # newest first
        memory.append([next(rows) for _ in range(scheme.memory)])
        out.append([next(rows) for _ in range(scheme.out)])
        packets.append([[next(rows) for _ in range(2 + scheme.out)] for _ in range(kept)])  # newest first
    assert next(rows, None) is None
    for tick in range(scheme.ratio):
        if tick == 0:
            for i in peers:
                packets[i] = [[*motion[i][scheme.told], *out[i]], *packets[i][:-1]]
        age = max(-((tick - scheme.late) // scheme.ratio), 0)  # packets sent since the newest that is here
        acting: list[Any] = []
        for i in peers:
            heard = {j: packets[j][age] for j in scheme.hears[i]}
            new, memory[i], out[i] = scheme.law(i, motion[i], heard, memory[i])
            queue = [list(new), *forces[i]]
            acting.append(queue[scheme.comp])
            forces[i] = queue[: scheme.comp]
        for i in peers:
            motion[i] = [
                _coast(x, v, force, *body, scheme.period)
                for (x, v), force, body in zip(motion[i], acting[i], scheme.bodies[i], strict=True)
            ]
    rows_out = []
    for i in peers:
        rows_out += [value for pair in motion[i] for value in pair]
        rows_out += [value for one in forces[i] for value in one]
        rows_out += [*memory[i], *out[i], *(value for one in packets[i] for value in one)]
    return np.array(rows_out)


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
    turn = math.sqrt(spring / mass - half**2)
    decay, cos, sin = math.exp(-half * time), math.cos(turn * time), math.sin(turn * time)
    y = x - rest
    return (
        rest + decay * (y * (cos + half / turn * sin) + v * sin / turn),
        decay * (v * (cos - half / turn * sin) - y * (spring / mass) / turn * sin),
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
