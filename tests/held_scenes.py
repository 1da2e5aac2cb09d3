"""The paper's users over a link that loses packets, and their frames as matrices made by hand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from tests.bruteforce import Scene, frame_matrix
from tests.topologies import compiled

Floats = NDArray[np.float64]


def scene(
    peers: int,
    stiffness: float,
    *,
    loss: str = "10 %",
    coupler: str = "AveragePosition",
    damping: float = 0.0,
    more: str = "",
    delay: str = "8 ms",
) -> str:
    """Return the paper's scene with equal users."""
    return f"""\
topology: lossy
clocks: {{haptic: 1 ms, network: 8 ms}}
peers:
  user: {{count: {peers}}}
masses:
  device: {{mass: 0.1 kg, damping: 5 N*s/m}}
  cube:   {{mass: 0.6 kg, damping: 5 N*s/m, shared: true}}
couplers:
  contact: {{type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}}
  coordination:
    {{type: {coupler}, object: cube, stiffness: {stiffness} N/m, damping: {damping} N*s/m,
     clock: haptic, delay: 1 ms, link: lan}}
links:
  lan: {{clock: network, delay: {delay}, loss: {loss}{more}}}
"""


@cache
def system_of(text: str) -> CompiledSystem:
    """Return a scene compiled, once."""
    return compiled(text)


@dataclass(frozen=True)
class Frames:
    """One frame, x⁺ = A x + B h and q = C x, of the motion x of all users and what each hears of each, h.

    A user's packet is its position and velocity; `pairs` (receiver, sender) names the channels, each of two
    numbers in h.
    """

    a: Floats
    b: Floats
    c: Floats
    pairs: tuple[tuple[int, int], ...]

    def matrix(self, heard: Floats) -> Floats:
        """Return the frame's matrix over (x, h) where channels hear (1) or lose (0) the packet sent in it."""
        kept = np.repeat(heard, 2)
        return np.block([[self.a, self.b], [kept[:, None] * self.c, np.diag(1 - kept)]])


def frames(peers: int, stiffness: float, damping: float = 0.0, operator: str = "mean") -> Frames:
    """Take the frame of `bruteforce` apart, whose packets are heard in the frame after they are sent."""
    whole = np.array(
        frame_matrix(Scene(operator=operator, peers=peers, kt=stiffness, bt=damping, cube=0.6 / peers))
    )
    size = len(whole) // peers
    packet = size - 4  # the newest of two that are kept
    moves = [peer * size + place for peer in range(peers) for place in range(packet)]
    pairs = tuple((i, j) for i in range(peers) for j in range(peers) if i != j)
    b = np.zeros((len(moves), 2 * len(pairs)))
    c = np.zeros((2 * len(pairs), len(moves)))
    for place, (i, j) in enumerate(pairs):
        own = slice(i * packet, (i + 1) * packet)
        columns = [j * size + packet, j * size + packet + 1]
        b[own, 2 * place : 2 * place + 2] = whole[i * size : i * size + packet, columns]
        c[2 * place : 2 * place + 2] = whole[np.ix_(columns, moves)]
    return Frames(whole[np.ix_(moves, moves)], b, c, pairs)


def growth(matrices: list[Floats]) -> float:
    """Return what a product of frames makes of a motion per frame, the translation of all left out."""
    product = np.eye(len(matrices[0]))
    for one in matrices:
        product = one @ product
    values = np.linalg.eigvals(product)
    rigid = np.argmin(np.abs(values - 1))
    assert abs(values[rigid] - 1) < 1e-7
    return float(np.abs(np.delete(values, rigid)).max() ** (1 / len(matrices)))
