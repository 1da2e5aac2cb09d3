"""Contacts that close and open by turns: a pattern by which a scene grows.

Takes: loops with their contacts cut open.
Gives: `Alternation`, `alternating`.
Guarantees: the growth is proved to be more than 1.
Does not: find the worst pattern; look at contacts that switch at different ticks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.analysis.opened import Matrix, OpenLoop
from apc.eigen.enclosure import enclose_eigenvalues
from apc.frame.discretize import UNIT
from apc.frame.radius import RADII, radius_of, value_of

Floats = NDArray[np.float64]
Pattern = tuple[bool, ...]

# Ticks for which contacts are closed, or open, in the patterns that are tried.
SPANS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 64, 80, 100, 128)

# Products of matrices, in cubes of their states, worth a try.
WORK = 10**9

# A growth in floats that is worth proving to be above 1.
ABOVE = 1 + 1e-9


@dataclass(frozen=True, slots=True)
class Alternation:
    """All contacts closed for `closed` ticks and open for `opened`, by turns: `growth` a frame, in a mode."""

    closed: int
    opened: int
    growth: float
    mode: str


def alternating(loops: Sequence[OpenLoop]) -> Alternation | None:
    """Find a pattern of all contacts closed and open by turns that makes a scene grow, None if none is met.

    Parameters
    ----------
    loops
        From `opened.open_loops`.
    """
    best: tuple[float, OpenLoop, int, int] | None = None
    for loop in loops:
        ticks = _ticks(loop)
        if ticks is None or not ticks:
            continue
        states = len(loop.a[0]) + bool(loop.seen)
        known: dict[Pattern, Floats] = {}
        work = 0
        for closed in SPANS:
            for opened in SPANS:
                frames = _frames(closed, opened, ticks)
                work += len(frames) * states**3
                if work > WORK:
                    break
                product = np.eye(states)
                for pattern in frames:
                    if pattern not in known:
                        known[pattern] = value_of(_frame(loop, pattern))
                    product = known[pattern] @ product
                growth = float(np.abs(np.linalg.eigvals(product)).max()) ** (1 / len(frames))
                if growth > (best[0] if best else ABOVE):
                    best = growth, loop, closed, opened
    if best is None:
        return None
    growth, loop, closed, opened = best
    product = RADII.exact(np.eye(len(loop.a[0]) + bool(loop.seen)))
    for pattern in _frames(closed, opened, _ticks(loop) or 0):
        product = RADII.multiply(_frame(loop, pattern), product)
    if not enclose_eigenvalues(value_of(product), radius_of(product))[1].low > 1:
        return None
    return Alternation(closed, opened, growth, loop.name)


def _ticks(loop: OpenLoop) -> int | None:
    """Return how many ticks a frame of each contact has, None where they differ."""
    counts: dict[tuple[str, str], int] = {}
    for site, part, _ in loop.ports:
        counts[site, part] = counts.get((site, part), 0) + 1
    return next(iter(counts.values()), 0) if len(set(counts.values())) < 2 else None


def _frames(closed: int, opened: int, ticks: int) -> list[Pattern]:
    """Return the frames of a period: which of their ticks are closed."""
    length = closed + opened
    count = length // math.gcd(length, ticks)
    return [tuple((frame * ticks + i) % length < closed for i in range(ticks)) for frame in range(count)]


def _frame(loop: OpenLoop, pattern: Pattern) -> Matrix:
    """Return the matrix of a frame with contacts closed at some ticks, over ξ and what may drift.

    Notes
    -----
    f = y at closed ticks, and y hears of forces of earlier ticks only: f is found in as many steps as there
    are ticks.
    """
    n, drifts = len(loop.a[0]), bool(loop.seen)
    closed = np.array([pattern[tick] for _, _, tick in loop.ports])
    follows = np.zeros((2, len(loop.ports), n + drifts))
    follows[0, :, :n], follows[1, :, :n] = -value_of(loop.c), radius_of(loop.c)
    again = np.stack([-value_of(loop.d), radius_of(loop.d)])
    pushes, moves = loop.b, np.zeros((2, n + drifts, n + drifts))
    moves[:, :n, :n] = loop.a
    if drifts:
        exact = np.array([float(one) for one in loop.seen])
        follows[0, :, n], follows[1, :, n] = exact, np.abs(exact) * UNIT
        pushes = np.concatenate([loop.b, loop.moved], axis=-2)
        moves[0, n, n] = 1.0
    follows[:, ~closed], again[:, ~closed] = 0.0, 0.0
    force = term = follows
    for _ in range(len(pattern)):
        term = RADII.multiply(again, term)
        if not term.any():
            break
        force = RADII.add(force, term)
    assert not term.any() or not np.isfinite(term).all(), "a contact hears of a force before it is there"
    return RADII.add(moves, RADII.multiply(pushes, force))
