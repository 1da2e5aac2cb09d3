"""Peers of one group in a population: what each of them brings to it.

Takes: a group's program, its different sites, which of them each peer is.
Gives: `Member`, `build_member`.
Guarantees: what many peers have in common is kept once.
Does not: know the other members (see `frame_packets`, `population`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.frame.jacobians import SiteJacobians
from apc.frame.start import start_sends, start_values
from apc.simulation.program import Program
from apc.simulation.propagate import Transitions

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """Peers of one group of the scene in a population.

    `peers` (count,) are their numbers in the scene. `rows` (count,) says which of the different sites each
    is; `parameters` are those sites' vectors, `transitions` theirs; `sends` is what each of them sends at the
    start, by link.
    """

    group: int
    peers: NDArray[np.int64]
    program: Program
    rows: NDArray[np.int64]
    parameters: Floats
    transitions: tuple[Transitions, ...]
    sends: tuple[Mapping[str, Sequence[float]], ...]
    carry: Floats  # (sites, rows of the carry)

    @property
    def count(self) -> int:
        """The number of peers."""
        return len(self.rows)

    def each(self, values: Floats) -> Floats:
        """Return one row a peer of what is one row a site."""
        return np.ascontiguousarray(values[self.rows])


def build_member(
    group: int,
    peers: NDArray[np.int64],
    site: SiteJacobians,
    rows: NDArray[np.int64],
    vectors: Floats,
    program: Program,
    transitions: Sequence[Transitions],
) -> Member:
    """Collect what some peers of a group bring to a population.

    Parameters
    ----------
    group
        The group's place in the scene.
    peers
        The peers' numbers in the scene (count,).
    site
        The group's kind.
    rows, vectors, transitions
        Which of the group's different sites each peer is (count,), their parameters (sites, n_p), and what
        each does over the program's intervals.
    program
        What each peer does in a frame.
    """
    used, own = np.unique(rows, return_inverse=True)
    sends, carries = [], []
    for vector in vectors[used]:
        listed = [float(one) for one in vector]
        x, _, remembered = start_values(site, listed)
        carries.append(program.start(x, remembered))
        sends.append(start_sends(site, listed, float))
    moves = tuple(transitions[place] for place in used)
    return Member(group, peers, program, own, vectors[used], moves, tuple(sends), np.array(carries))
