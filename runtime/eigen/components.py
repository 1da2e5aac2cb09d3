"""The parts of a matrix whose states drive each other.

Takes: which entries of a square matrix can differ from zero.
Gives: `components`.
Guarantees: ordered by parts, the matrix is block triangular: its eigenvalues, each as often as it is one, are
those of the parts' own blocks.
Does not: look at a number.

Peers in a directed chain are a part each. Equal ones make one Jordan block of the whole, whose eigenvalues
floats scatter far about; those of a part have nothing to do with the next part's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Places = NDArray[np.intp]


def components(driven: NDArray[np.bool_]) -> list[Places]:
    """Return the strongly connected components of a matrix's graph, by their first places.

    Parameters
    ----------
    driven
        Whether state i is driven by state j (n, n).

    Returns
    -------
    The places of each part, in rising order.

    Notes
    -----
    A state that drives nobody left, or that nobody left drives, is a part of its own: such go first, as
    queues are full of them. Of the others, what a state reaches and what reaches it are its part.
    """
    links = driven.copy()
    np.fill_diagonal(links, False)
    left = np.ones(len(links), dtype=np.bool_)
    found: list[Places] = []
    while True:
        alone = left & ~((links & left).any(axis=1) & (links.T & left).any(axis=1))
        if not alone.any():
            break
        found += [np.array([place]) for place in np.flatnonzero(alone)]
        left &= ~alone
    while left.any():
        start = int(np.argmax(left))
        part = _reached(links, start, left) & _reached(links.T, start, left)
        found.append(np.flatnonzero(part))
        left &= ~part
    return sorted(found, key=lambda part: int(part[0]))


def _reached(links: NDArray[np.bool_], start: int, left: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of the states left are reached from one, itself included."""
    reached = np.zeros(len(links), dtype=np.bool_)
    reached[start] = True
    frontier = reached
    while frontier.any():
        frontier = links[frontier].any(axis=0) & left & ~reached
        reached = reached | frontier
    return reached
