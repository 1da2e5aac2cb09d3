"""The paper's users over a link that loses packets, and their frames as matrices made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from tests.bruteforce import PacketOutcomes, TopologySource, arcs_of, lossy_frame, states_read
from tests.topologies import compiled

Floats = NDArray[np.float64]


def topology(
    peers: int,
    stiffness: float,
    *,
    loss: str = "10 %",
    coupler: str = "AveragePosition",
    damping: float = 0.0,
    more: str = "",
    delay: str = "8 ms",
) -> str:
    """Return the paper's topology with equal users."""
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
def system_of(text: str) -> Model:
    """Return a topology compiled, once."""
    return compiled(text)


@dataclass(frozen=True)
class Frames:
    """One frame of all users and of what each hears of each; `pairs` are (sender, receiver).

    `read` are the states that something follows from.
    """

    topology: TopologySource
    pairs: tuple[tuple[int, int], ...]
    read: NDArray[np.intp]

    def matrix(self, received: Sequence[float]) -> Floats:
        """Return the frame's matrix where ways hear (1) or lose (0) the packet that arrives in it."""
        return _whole(self.topology, self.pairs, received)[np.ix_(self.read, self.read)]


def _whole(topology: TopologySource, pairs: Sequence[tuple[int, int]], received: Sequence[float]) -> Floats:
    return lossy_frame(
        topology, PacketOutcomes({pair: (bool(one),) for pair, one in zip(pairs, received, strict=True)})
    )[0]


def frames(peers: int, stiffness: float, damping: float = 0.0, operator: str = "mean") -> Frames:
    """Return the frames of the paper's users, whose packets are heard in the frame after they are sent."""
    topology = TopologySource(operator=operator, peers=peers, kt=stiffness, bt=damping, cube=0.6 / peers)
    pairs = tuple(arcs_of(topology))
    either = np.array([_whole(topology, pairs, [one] * len(pairs)) for one in (0.0, 1.0)])
    return Frames(topology, pairs, states_read(either))


def growth(matrices: list[Floats]) -> float:
    """Return what a product of frames makes of a motion per frame, the translation of all left out."""
    product = np.eye(len(matrices[0]))
    for one in matrices:
        product = one @ product
    values = np.linalg.eigvals(product)
    rigid = np.argmin(np.abs(values - 1))
    assert abs(values[rigid] - 1) < 1e-7
    return float(np.abs(np.delete(values, rigid)).max() ** (1 / len(matrices)))
