"""Contacts that close and open by turns: a pattern by which a scene grows.

Takes: loops with their contacts cut open.
Gives: `Alternation`, `alternating`.
Guarantees: the growth is proved to be more than 1.
Does not: find the worst pattern; look at contacts that switch at different ticks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.analysis.opened import Matrix, OpenLoop, negated
from apc.eigen.enclosure import enclose_eigenvalues
from apc.frame.discretize import UNIT
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of, value_of

Floats = NDArray[np.float64]
Pattern = tuple[bool, ...]

# Ticks for which contacts are closed, or open, in the patterns that are tried.
SPANS = (1, 2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 50, 70, 100)

# Products of matrices, in cubes of their states, worth a try.
WORK = 2 * 10**8

# A growth in floats that is worth proving to be above 1.
ABOVE = 1 + 1e-9


@dataclass(frozen=True, slots=True)
class Alternation:
    """All contacts closed for `closed` ticks and open for `opened`, by turns: `growth` a frame, in a mode."""

    closed: int
    opened: int
    growth: float
    mode: str


@dataclass(frozen=True, slots=True, eq=False)
class _Loop:
    """A loop over ξ and what may drift: state⁺ = `moves` state + `pushes` f, y = `follows` state + `again` f.

    Of some kind of number; `tick` is that of each f.
    """

    moves: Matrix
    pushes: Matrix
    follows: Matrix
    again: Matrix
    tick: NDArray[np.intp]

    @property
    def plain(self) -> _Loop:
        """The same without radii."""
        moves, pushes, follows, again = map(value_of, (self.moves, self.pushes, self.follows, self.again))
        return _Loop(moves, pushes, follows, again, self.tick)


def alternating(loops: Sequence[OpenLoop]) -> Alternation | None:
    """Find a pattern of all contacts closed and open by turns that makes a scene grow, None if none is met.

    Parameters
    ----------
    loops
        From `opened.open_loops`.
    """
    best, found, work = ABOVE, None, 0
    for loop in loops:
        ticks = _ticks(loop)
        exact = _with_drift(loop)
        plain = exact.plain
        known: dict[Pattern, Floats] = {}
        for closed, opened in itertools.product(SPANS, repeat=2) if ticks else ():
            frames = _frames(closed, opened, ticks)
            work += len(frames) * len(plain.moves) ** 3
            if work > WORK:
                break
            product = np.eye(len(plain.moves))
            for pattern in frames:
                if pattern not in known:
                    known[pattern] = _frame(plain, pattern, FLOATS)
                product = known[pattern] @ product
            growth = float(np.abs(np.linalg.eigvals(product)).max()) ** (1 / len(frames))
            if growth > best:
                best, found = growth, (exact, frames, Alternation(closed, opened, growth, loop.name))
    if found is None:
        return None
    loop_found, frames, told = found
    product = RADII.exact(np.eye(loop_found.moves.shape[-1]))
    for pattern in frames:
        product = RADII.multiply(_frame(loop_found, pattern, RADII), product)
    grows = enclose_eigenvalues(value_of(product), radius_of(product))[1].low > 1
    return told if grows else None


def _with_drift(loop: OpenLoop) -> _Loop:
    """Return a loop's matrices, with their radii, over ξ and what may drift."""
    n, drifts = loop.a.shape[-1], int(bool(loop.seen))
    follows = np.zeros((2, len(loop.ports), n + drifts))
    follows[..., :n], again = negated(loop.c), negated(loop.d)
    pushes, moves = loop.b, np.zeros((2, n + drifts, n + drifts))
    moves[:, :n, :n] = loop.a
    if drifts:
        seen = np.array([float(one) for one in loop.seen])
        follows[..., n] = np.stack([seen, UNIT * np.abs(seen)])
        pushes = np.concatenate([loop.b, loop.moved], axis=-2)
        moves[0, n, n] = 1.0
    return _Loop(moves, pushes, follows, again, np.array([tick for _, _, tick in loop.ports], np.intp))


def _ticks(loop: OpenLoop) -> int:
    """Return how many ticks a frame of each contact has, 0 where they differ."""
    counts: dict[tuple[str, str], int] = {}
    for site, part, _ in loop.ports:
        counts[site, part] = counts.get((site, part), 0) + 1
    return next(iter(counts.values()), 0) if len(set(counts.values())) < 2 else 0


def _frames(closed: int, opened: int, ticks: int) -> list[Pattern]:
    """Return the frames of a period: which of their ticks are closed."""
    length = closed + opened
    count = length // math.gcd(length, ticks)
    return [tuple((frame * ticks + i) % length < closed for i in range(ticks)) for frame in range(count)]


def _frame(loop: _Loop, pattern: Pattern, numbers: Arithmetic) -> Matrix:
    """Return the matrix of a frame with contacts closed at some ticks.

    Notes
    -----
    f = y at closed ticks, and y hears of forces of earlier ticks only: f is found in as many steps as there
    are ticks.
    """
    closed = np.array(pattern)[loop.tick]
    follows, again = np.array(loop.follows), np.array(loop.again)
    follows[..., ~closed, :] = again[..., ~closed, :] = 0.0
    force = term = follows
    for _ in pattern:
        term = numbers.multiply(again, term)
        if not term.any():
            break
        force = numbers.add(force, term)
    return numbers.add(loop.moves, numbers.multiply(loop.pushes, force))
