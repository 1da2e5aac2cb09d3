"""Second moments over a lossy network by brute force over all patterns of luck: none of `apc.mean_square`.

Takes: a topology of `bruteforce`, and how its packets get lost.
Gives: `Law`, `second_moment_radius`, `rms_error`.
Guarantees: frames are stepped event by event for each pattern of packets; no symmetry is used, no jitter.

`PacketOutcomes` is a Markov chain of each arc: whether it is bad, whether its last packet is missed.
Of X, the second moments at each combination of these, a frame makes Σ P M X Mᵀ, over all that can happen.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse.linalg
from numpy.typing import NDArray

from tests.bruteforce import PacketOutcomes, TopologySource, arcs_of, common_period, lossy_frame

Floats = NDArray[np.float64]
State = tuple[bool, bool]  # of a way: whether it is bad, and whether its last packet is missed

# What stands still in every frame, in floats.
STANDING = 1e-9


@dataclass(frozen=True, slots=True)
class Law:
    """How packets get lost: netem's `gemodel`; where one is missing nothing pulls if `zero`."""

    p: float = 0.0
    r: float = 1.0
    bad_loss: float = 1.0
    good_loss: float = 0.0
    zero: bool = False

    @property
    def independent(self) -> bool:
        return abs(self.p + self.r - 1) < 1e-12

    def moves(self, arrivals: int) -> Iterator[tuple[State, State, float, tuple[bool, ...]]]:
        """Yield what so many packets of a way may do: (before, after, chance, which are there)."""
        losses = [self.good_loss, self.bad_loss]
        if self.independent:
            losses = [(1 - self.p) * self.good_loss + self.p * self.bad_loss]
        moods = (False, True)[: len(losses)]
        for before in itertools.product(moods, (False, True) if self.zero else (False,)):
            paths: list[tuple[State, float, tuple[bool, ...]]] = [(before, 1.0, ())]
            for _ in range(arrivals):
                paths = [
                    ((turned != bad, lost and self.zero), chance * of_loss * of_turn, (*there, not lost))
                    for (bad, _), chance, there in paths
                    for lost, of_loss in self._either(losses[bad])
                    for turned, of_turn in self._either(
                        0.0 if self.independent else self.r if bad else self.p
                    )
                ]
            yield from ((before, *path) for path in paths)

    @staticmethod
    def _either(chance: float) -> list[tuple[bool, float]]:
        return [one for one in ((True, chance), (False, 1 - chance)) if one[1]]


def arrivals_of(topology: TopologySource) -> int:
    """Return how many packets of a way arrive in a frame."""
    return int(common_period(topology.haptic, topology.network) / topology.network)


class Lossy:
    """All that may happen in a frame, and what it makes of second moments (states of luck, n, n).

    What happens, k, begins at the state of luck `before[k]`; `moved[k]` (n, n) is what it makes of motions,
    `pushed[k]` of pushes; with the chance `shares[after, k]` it leads to a state. Of the states of motion,
    those are left out that no body follows from in that state of luck, and of motions what stands still.
    """

    def __init__(self, topology: TopologySource, law: Law) -> None:
        arcs = arcs_of(topology)
        states: dict[tuple[State, ...], int] = {}
        happens: dict[tuple[int, tuple[bool, ...], tuple[tuple[bool, ...], ...]], int] = {}
        moves = []
        for joint in itertools.product([*law.moves(arrivals_of(topology))], repeat=len(arcs)):
            before, after, chances, there = zip(*joint, strict=True)
            first, last = (states.setdefault(one, len(states)) for one in (before, after))
            key = (first, tuple(missed for _, missed in before), there)
            moves.append((last, happens.setdefault(key, len(happens)), math.prod(chances)))
        self.shares = np.zeros((len(states), len(happens)))
        for last, k, chance in moves:
            self.shares[last, k] += chance
        self.before = [first for first, _, _ in happens]
        made = {}
        for _, missed, there in happens:
            if (missed, there) not in made:
                gone = [arc for arc, one in zip(arcs, missed, strict=True) if one]
                noise = PacketOutcomes(dict(zip(arcs, there, strict=True)), gone, law.zero)
                made[missed, there] = lossy_frame(topology, noise)
        moved = np.array([made[missed, there][0] for _, missed, there in happens])
        place = np.arange(moved.shape[1])
        size = (len(place) - 2 * len(arcs)) // topology.peers
        bodies = (place % size < 4) & (place < topology.peers * size)
        reads = np.tile(bodies, (len(states), 1))
        for _ in place:
            for k, first in enumerate(self.before):
                reads[first] |= moved[k][reads[self.shares[:, k] > 0].any(axis=0)].any(axis=0)
        read = place[reads.any(axis=0)]
        self.reads = reads[:, read, None] & reads[:, None, read]
        self.cubes = np.searchsorted(read, size * np.arange(topology.peers) + 2)
        moved = moved[:, read][:, :, read]
        unit = np.eye(len(read))
        standing = scipy.linalg.null_space((moved - unit).reshape(-1, len(unit)), rcond=STANDING)
        self.apart = unit - standing @ np.linalg.pinv(standing[bodies[read]]) @ unit[bodies[read]]
        self.moved = self.apart @ moved
        self.pushed = self.apart @ np.array([made[m, there][1][read] for _, m, there in happens])

    def frame(self, moments: Floats) -> Floats:
        """Return second moments a frame later."""
        after = self.moved @ moments[self.before] @ self.moved.transpose(0, 2, 1)
        return np.asarray(np.tensordot(self.shares, after, 1) * self.reads)

    def driven(self) -> Floats:
        """Return the second moments that pushes of variance 1, drawn anew at each tick, make in a frame."""
        chain = self.shares @ np.eye(len(self.shares))[self.before]
        stays = np.linalg.svd(chain - np.eye(len(chain)))[2][-1]
        after = self.pushed @ self.pushed.transpose(0, 2, 1)
        weighted = self.shares * (stays / stays.sum())[self.before]
        return np.asarray(np.tensordot(weighted, after, 1) * self.reads)


def second_moment_radius(topology: TopologySource, law: Law) -> float:
    """Return what second moments grow by in a frame, without motions that no luck moves."""
    lossy = Lossy(topology, law)
    shape = (len(lossy.shares), *lossy.apart.shape)
    start = np.broadcast_to(lossy.apart @ lossy.apart.T, shape)

    def step(flat: Floats) -> Floats:
        return lossy.frame(flat.reshape(shape)).ravel()

    operator = scipy.sparse.linalg.LinearOperator((start.size,) * 2, matvec=step, dtype=np.float64)
    # Moments map a cone into itself, so the largest value is real; a small Krylov space may miss it.
    options = {"which": "LR", "ncv": min(start.size, 144), "tol": 1e-12, "return_eigenvectors": False}
    values = scipy.sparse.linalg.eigs(operator, 2, v0=step(start.ravel()), **options)
    return float(np.abs(values).max())


def rms_error(topology: TopologySource, law: Law) -> float:
    """Return the largest root mean square distance (m) of a cube from the mean of others as frames begin.

    Each device is pushed by a force of variance 1 N², drawn anew at every tick.
    """
    lossy = Lossy(topology, law)
    forms = np.zeros((topology.peers, len(lossy.apart)))
    forms[:, lossy.cubes] = np.eye(topology.peers) * topology.peers / (topology.peers - 1) - 1 / (
        topology.peers - 1
    )
    driven = lossy.driven()
    moments, before, found = driven, 0.0, 1.0
    while abs(found - before) > 1e-13 * found:
        before = found
        moments = lossy.frame(moments) + driven
        found = float(np.einsum("pi,sij,pj->p", forms, moments, forms).max())
    return math.sqrt(found)
