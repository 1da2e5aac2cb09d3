"""Peers by number, some of a group or of a scene.

Takes: numbers of peers, in runs or listed.
Gives: `Peers`, `Runs`; `shifted`, `joined`.
Guarantees: those that follow one another take no memory, however many they are.
Does not: know what a peer is.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Runs:
    """Peers by number, in runs that follow one another: a billion equal peers take no memory."""

    ranges: tuple[range, ...]

    def __len__(self) -> int:
        return sum(len(one) for one in self.ranges)

    def __iter__(self) -> Iterator[int]:
        return itertools.chain.from_iterable(self.ranges)

    def __getitem__(self, place: int | slice) -> Any:
        if isinstance(place, slice):
            return list(itertools.islice(self, place.start, place.stop, place.step))
        return next(itertools.islice(self, place, None))

    def shifted(self, by: int) -> Runs:
        """Return the peers counted from another start."""
        return Runs(tuple(range(one.start + by, one.stop + by) for one in self.ranges))


# Some peers of a group, or of the scene, by number.
Peers = Integers | Runs


def shifted(peers: Peers, by: int) -> Peers:
    """Return peers counted from another start."""
    return peers.shifted(by) if isinstance(peers, Runs) else peers + by


def joined(listed: Sequence[Peers]) -> Peers:
    """Return peers together, in order."""
    runs = [one for one in listed if isinstance(one, Runs)]
    if len(runs) == len(listed):
        return Runs(tuple(sorted((run for one in runs for run in one.ranges), key=lambda run: run.start)))
    return np.sort(np.concatenate([np.fromiter(one, np.int64, len(one)) for one in listed]))
