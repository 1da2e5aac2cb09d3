"""Smooth plane curves through points and tangents.

Takes: points and unit tangents (k, 2) along a curve.
Gives: `between`, `refined`, `area_beside`, `off_an_arc`, `stencils`, `through_four`, `fill`.
Guarantees: `between` is the one interpolant that results are given by; `through_four` is a much better one,
which tells between which of its points `between` needs more, and gives them.
Does not: know what the curves bound.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# A stencil whose tangents turn farther from the chord than this cosine is no graph over the chord.
STRAIGHT = 0.4

# Pieces an interval is cut into at most; each doubling makes `between` 16 times better.
MOST_PIECES = 64

# The other three of each of four points.
_OTHERS = ([1, 0, 0, 0], [2, 2, 1, 1], [3, 3, 3, 2])

# Pieces whose ends are all worked out at once: intervals rarely need more.
FIRST_PIECES = 8

# What the quarter points of an interval may be off more than its middle was, beyond what halving leaves.
RESERVE = 2.0


def between(a: Floats, b: Floats, tangent_a: Floats, tangent_b: Floats, share: float | Floats) -> Floats:
    """Return points (k, 2) of the cubics from a to b with unit tangents at both ends.

    Parameters
    ----------
    a, b
        The ends (k, 2).
    tangent_a, tangent_b
        Unit tangents there (k, 2).
    share
        How far along, from 0 to 1: one number for all, or one each (k,).

    Notes
    -----
    The slopes are as long as those that meet a circular arc to sixth order: chord/cos²(θ/4), θ the angle
    between the tangents (de Boor, Höllig and Sabin, High accuracy geometric Hermite interpolation, 1987).
    """
    length = _slope_length(a, b, tangent_a, tangent_b)
    s = np.asarray(share)[..., None]
    bump = s * (1 - s) * length[:, None] * ((1 - s) * tangent_a - s * tangent_b)
    points: Floats = (1 - s) ** 2 * (1 + 2 * s) * a + s**2 * (3 - 2 * s) * b + bump
    return points


def _slope_length(a: Floats, b: Floats, tangent_a: Floats, tangent_b: Floats) -> Floats:
    turn = np.clip((tangent_a * tangent_b).sum(axis=1), -1, 1)
    length: Floats = 2 * np.linalg.norm(b - a, axis=1) / (1 + np.sqrt((1 + turn) / 2))
    return length


def area_beside(points: Floats, tangents: Floats) -> float:
    """Return ∫ x dy along the cubics of a curve (k, 2): exactly, by three Gauss points an interval."""
    a, b, tangent_a, tangent_b = points[:-1], points[1:], tangents[:-1], tangents[1:]
    length = _slope_length(a, b, tangent_a, tangent_b)
    total = 0.0
    for node, weight in zip((-np.sqrt(0.6), 0.0, np.sqrt(0.6)), (5 / 18, 8 / 18, 5 / 18), strict=True):
        s = (1 + node) / 2
        x = between(a, b, tangent_a, tangent_b, s)[:, 0]
        rate = 6 * s * (1 - s) * (b - a)[:, 1]
        rate += length * ((1 - s) * (1 - 3 * s) * tangent_a + s * (3 * s - 2) * tangent_b)[:, 1]
        total += weight * float(x @ rate)
    return total


def refined(points: Floats, tangents: Floats, pieces: int) -> tuple[Floats, Floats]:
    """Return points and unit tangents along the cubics of a curve (k, 2), each cut into so many pieces."""
    a, b, tangent_a, tangent_b = points[:-1], points[1:], tangents[:-1], tangents[1:]
    length = _slope_length(a, b, tangent_a, tangent_b)[:, None]
    found, ways = [], []
    for piece in range(pieces):
        s = piece / pieces
        found.append(between(a, b, tangent_a, tangent_b, s))
        ways.append(
            6 * s * (1 - s) * (b - a)
            + length * ((1 - s) * (1 - 3 * s) * tangent_a + s * (3 * s - 2) * tangent_b)
        )
    every = np.concatenate([np.stack(found, axis=1).reshape(-1, 2), points[-1:]])
    along = np.concatenate([np.stack(ways, axis=1).reshape(-1, 2), tangents[-1:]])
    return every, along / np.linalg.norm(along, axis=1, keepdims=True)


def off_an_arc(tangent_a: Floats, tangent_b: Floats, length: Floats) -> Floats:
    """Return how far `between` is at most from a circular arc: it meets it in the middle, and nothing shows.

    The chord subtends θ: the distance is (2/27) r sin⁶(θ/4)/cos²(θ/4), r = chord/(2 sin(θ/2)).
    """
    turn = np.clip((tangent_a * tangent_b).sum(axis=1), -1, 1)
    quarter = np.arccos(turn) / 4
    off: Floats = length / 54 * np.sin(quarter) ** 5 / np.cos(quarter) ** 3
    return off


def stencils(run: Integers) -> Integers:
    """Return, for each interval between knots in order, the first of the four knots around it, or −1.

    Parameters
    ----------
    run
        Which smooth curve each knot is on (k,), ascending.

    Returns
    -------
    (k − 1,): −1 between two curves and on curves of fewer than four knots.
    """
    count = len(run)
    starts = np.searchsorted(run, run)
    ends = np.searchsorted(run, run, side="right")
    place = np.arange(count - 1)
    first = np.clip(place - 1, starts[:-1], ends[:-1] - 4)
    return np.where((run[:-1] == run[1:]) & (ends[:-1] - starts[:-1] >= 4), first, -1)


def through_four(
    points: Floats, tangents: Floats, a: Floats, b: Floats, share: Floats
) -> tuple[Floats, Floats]:
    """Return points of the curves through four points and tangents, over the chord from a to b.

    Parameters
    ----------
    points, tangents
        Four of each a curve (k, 4, 2), in order.
    a, b
        The ends (k, 2) of the interval looked at.
    share
        How far along the chord, 0 to 1: (k, m), or (m,) if the same for all.

    Returns
    -------
    Points and unit tangents (k, m, 2); NaN where the curve is no graph over the chord.

    Notes
    -----
    In the frame of the chord the curve is v(u); v is the polynomial of degree seven through four values and
    slopes, Σ_j v_j (1 − 2 (u − u_j) c_j) l_j² + v′_j (u − u_j) l_j², l_j Lagrange's polynomials and
    c_j = l_j′(u_j).
    """
    chord = b - a
    length = np.linalg.norm(chord, axis=1)
    along = chord / length[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    u = ((points - a[:, None]) * along[:, None]).sum(axis=2) / length[:, None]
    v = ((points - a[:, None]) * across[:, None]).sum(axis=2) / length[:, None]
    forward = (tangents * along[:, None]).sum(axis=2)
    graph = (forward > STRAIGHT).all(axis=1) & (np.diff(u, axis=1) > 0).all(axis=1)
    u = np.where(graph[:, None], u, np.arange(4.0))
    slope = (tangents * across[:, None]).sum(axis=2) / np.where(graph[:, None], forward, np.nan)
    gaps = u[:, :, None] - u[:, None, :] + np.eye(4)
    weight = 1 / gaps.prod(axis=2)  # of Lagrange's polynomials
    centre = (1 / gaps).sum(axis=2) - 1
    share = np.atleast_2d(share)[..., None]
    at = share - u[:, None, :]  # (k, m, 4)
    one, two, three = (at[..., places] for places in _OTHERS)
    others = one * two * three
    sums = one * two + one * three + two * three  # of l_j' what `others` is of l_j
    lagrange, lagrange_slope = others * weight[:, None], sums * weight[:, None]
    square, square_slope = lagrange**2, 2 * lagrange * lagrange_slope
    tilt = 1 - 2 * at * centre[:, None]
    value = (v[:, None] * tilt * square + slope[:, None] * at * square).sum(axis=2)
    rate = (
        v[:, None] * (tilt * square_slope - 2 * centre[:, None] * square)
        + slope[:, None] * (square + at * square_slope)
    ).sum(axis=2)
    place = a[:, None] + length[:, None, None] * (share * along[:, None] + value[..., None] * across[:, None])
    direction = along[:, None] + rate[..., None] * across[:, None]
    return place, direction / np.linalg.norm(direction, axis=2, keepdims=True)


def fill(points: Floats, tangents: Floats, errors: Floats, allowed: Floats) -> tuple[Floats, Floats, Floats]:
    """Put as many points between those of one curve as `between` needs.

    Parameters
    ----------
    points, tangents
        The curve's knots (k, 2).
    errors
        How far `through_four` (or `between`, on a curve of fewer than four knots) is from the truth (k − 1,).
    allowed
        How far `between` may be from it (k − 1,).

    Returns
    -------
    Points, tangents, and the distance of `between` from the truth in each interval of them.
    """
    first = stencils(np.zeros(len(points), dtype=np.int64))
    if len(points) < 4:
        return points, tangents, errors
    stencil = first[:, None] + np.arange(4)
    a, b, tangent_a, tangent_b = points[:-1], points[1:], tangents[:-1], tangents[1:]
    eighths = np.arange(1, FIRST_PIECES) / FIRST_PIECES
    places, directions = through_four(points[stencil], tangents[stencil], a, b, eighths)
    middle = places[:, FIRST_PIECES // 2 - 1]
    off = np.linalg.norm(middle - between(a, b, tangent_a, tangent_b, 0.5), axis=1)
    off = RESERVE * (off + off_an_arc(tangent_a, tangent_b, np.linalg.norm(b - a, axis=1)))
    off = np.where(np.isfinite(off), off, 0.0)
    left = np.maximum(allowed - errors, allowed / 2)
    wanted = np.ceil(np.log2(np.maximum(off / left, 1.0)) / 4)
    pieces = (2 ** np.minimum(wanted, np.log2(MOST_PIECES))).astype(np.int64)
    starts = np.concatenate([[0], np.cumsum(pieces)])
    all_points, all_tangents = np.empty((starts[-1] + 1, 2)), np.empty((starts[-1] + 1, 2))
    all_points[starts], all_tangents[starts] = points, tangents
    for count in sorted(set(pieces[pieces > 1].tolist())):
        chosen = np.flatnonzero(pieces == count)
        rows = starts[chosen][:, None] + np.arange(1, count)
        if count <= FIRST_PIECES:
            every = FIRST_PIECES // count
            picked = slice(every - 1, None, every)
            all_points[rows], all_tangents[rows] = places[chosen, picked], directions[chosen, picked]
        else:
            one, shares = stencil[chosen], np.arange(1, count) / count
            found = through_four(points[one], tangents[one], a[chosen], b[chosen], shares)
            all_points[rows], all_tangents[rows] = found
    finer = errors + off / pieces.astype(np.float64) ** 4
    return all_points, all_tangents, np.repeat(finer, pieces)
