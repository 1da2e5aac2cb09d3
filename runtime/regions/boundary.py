"""Boundary curves of a stable region in the unit square, to a stated accuracy.

Takes: an `Eigenvalues` and the `Survey` of its cells.
Gives: `BoundaryArc`, `trace`, `traced`; `trace_steps`, `straight_arc` for a boundary that has steps;
`stable_area`, `relative_to`.
Guarantees: every point lies on the boundary to rounding; between its points a curve is the cubic Hermite
interpolant through points and tangents, and that has been measured against the true boundary in the middle
of every interval. Where one mode takes over from another the curve has a corner, solved for. Steps are known
along each cell's edge to `RESOLUTION` of the range. The area is exact for the curves as given; how far these
are off the boundary bounds its error.
Does not: find pieces the survey has not seen.

On the boundary log|λ| = 0 for the deciding eigenvalue; its gradient gives Newton's step

    P ← P − log|λ| ∇log|λ| / |∇log|λ||²

and the tangent (−∂_y, ∂_x) log|λ|, which has the stable side on its left. A corner is where two eigenvalues
have log|λ_a| = log|λ_b| = 0.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.frame.interval_arithmetic import UNIT_ROUNDOFF
from apc.regions.adaptive_grid import Survey, just_inside, survey
from apc.regions.boundary_points import (
    MOST_STEPS,
    MOST_TRIES,
    SHORT,
    clear,
    cross,
    moved,
    newton_refine,
)
from apc.regions.curves import area_under, distance_from_arc, handles_of, straight_handles, tangents
from apc.regions.dominant_pairs import Eigenvalues, Pairs, join

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]

# Halvings of the intervals between the first points of a curve. Each makes the interpolant 16 times better.
MOST_HALVINGS = 12

# The middle of an interval, put in, makes the cubic 16 times better than it was measured there; half of that
# is counted on.
GAIN = 8.0

# A knot whose log|λ| is farther from 0 is at a jump: where other motions are free on either side.
JUMP = 1e-6

# Points nearer to each other than this are one.
COINCIDENT = 1e-11

# An error of a curve, of the unit square, beyond which it is lost; how often cells are halved to find it.
LOST, MOST_HALVED = 1e-3, 3

# Number of points on either side of a chord at which the boundary is searched, at growing distances, and the
# largest number of chords.
FARTHER, FEW = 24, 8

# A middle farther from where it is expected, in lengths of the interval, is not on the same piece.
ASTRAY = 0.25

# Two ends of an interval are on one branch if the eigenvalue's slopes explain its difference to this share.
EXPLAINED = 0.25

# The share of the tolerance that the middle of an interval may be off: elsewhere in it the miss is up to
# twice that, and rounding takes a share.
FILLED = 0.375

# The accuracy of a boundary step on a cell's edge, as a share of the range: finer than any picture.
RESOLUTION = 2.0**-24

# A straight line that is off by less, in shares of the range, is not halved.
STRAIGHT = 2.5e-4

# Errors are relative to a coordinate, or to this share of its range where the coordinate is smaller.
LEAST_COORDINATE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class BoundaryArc:
    """An arc of the boundary with one critical mode, stable side on the left.

    `points` (k, 2) and `handles` (k − 1, 2, 2), see `curves`, are of the unit square. `errors` (k − 1,) are
    its distances from the boundary. `knots` (m, 2) are the points that were solved for, `values` (m,) the
    eigenvalues there, `system` is their closed-loop system, and `rounding` bounds their rounding error.
    `chain` is the index of the arc's chain in the survey. An arc that is not `smooth` has steps, and straight
    lines between its points.
    """

    points: Floats
    handles: Floats
    errors: Floats
    knots: Floats
    values: Complexes
    system: int
    rounding: float
    chain: int
    smooth: bool = True

    @property
    def normals(self) -> Floats:
        """Unit normals (k, 2) at its points, towards the unstable side."""
        normals: Floats = tangents(self.points, self.handles)[:, ::-1] * np.array([1.0, -1.0])
        return normals

    @property
    def closed(self) -> bool:
        """Whether the arc comes back to its own first point."""
        return bool(len(self.points) > 2 and np.array_equal(self.points[0], self.points[-1]))


class _Knots:
    """Points on the boundary with their critical eigenvalues; `key` orders those of a chain.

    `error` is that of the interval from a knot to the next; `last` is whether the arc ends with the knot.
    """

    def __init__(self, points: Floats, pairs: Pairs, chain: Integers, key: Floats) -> None:
        self.points, self.pairs, self.chain, self.key = points, pairs, chain, key
        self.error = np.zeros(len(key))
        self.last = np.zeros(len(key), dtype=bool)

    def add(self, points: Floats, pairs: Pairs, after: Integers, key: Floats) -> Integers:
        """Add knots on the chains of the knots `after`; return their numbers."""
        before = len(self.key)
        self.points = np.concatenate([self.points, points])
        self.pairs = join([self.pairs, pairs])
        self.chain = np.concatenate([self.chain, self.chain[after]])
        self.key = np.concatenate([self.key, key])
        self.error = np.concatenate([self.error, np.zeros(len(key))])
        self.last = np.concatenate([self.last, np.zeros(len(key), dtype=bool)])
        return np.arange(before, len(self.key))

    @property
    def jumps(self) -> NDArray[np.bool_]:
        """Return for each knot whether the spectral radius is discontinuous there."""
        return np.asarray(~(np.abs(self.pairs.log_radius) <= JUMP))

    def tangents(self, knots: Integers) -> Floats:
        """Return the unit tangents (k, 2) at some knots, with falling log|λ| on their left."""
        gradient = self.pairs.gradient[knots]
        turned = np.stack([-gradient[:, 1], gradient[:, 0]], axis=1)
        unit: Floats = turned / np.maximum(
            np.linalg.norm(turned, axis=1, keepdims=True), np.finfo(np.float64).tiny
        )
        return unit


def trace(
    deciding: Eigenvalues, survey: Survey, *, tolerance: float, offset: Floats
) -> tuple[BoundaryArc, ...]:
    """Follow the boundary through all crossings of a survey.

    Parameters
    ----------
    deciding
        The evaluator over the unit square.
    survey
        The crossings of the boundary with the cells' edges, in order.
    tolerance
        Largest distance between curves and boundary, relative to one of the two coordinates: that in which
        the distance makes the smaller difference.
    offset
        The offset from unit coordinates to values relative to zero (2,): lower end over width of the range.
    """
    if not survey.chains:
        return ()
    points, pairs = cross(deciding, survey.stable, survey.unstable, survey.log_radius)
    members: list[int] = []
    chain: list[int] = []
    key: list[int] = []
    for number, (listed, closed) in enumerate(zip(survey.chains, survey.closed, strict=True)):
        whole = [*listed, listed[0]] if closed else list(listed)
        members += whole
        chain += [number] * len(whole)
        key += range(len(whole))
    used = np.array(members)
    knots = _Knots(points[used], pairs.at(used), np.array(chain), np.array(key, np.float64))
    first = np.flatnonzero(knots.chain[1:] == knots.chain[:-1])
    intervals = np.stack([first, first + 1], axis=1)
    for halving in range(MOST_HALVINGS):
        intervals = _separate(knots, intervals)
        if not len(intervals):
            break
        intervals = _halve(deciding, knots, intervals, tolerance, offset, guarded=not halving)
    for a, b in intervals.tolist():  # given up: the chord is all that is known
        knots.error[a] = max(knots.error[a], float(np.linalg.norm(knots.points[b] - knots.points[a])))
    return _arcs(deciding, knots, survey.closed)


def _separate(knots: _Knots, intervals: Integers) -> Integers:
    """Return the intervals longer than nothing; where two modes meet in one of no length, an arc ends."""
    a, b = intervals.T
    separation = np.linalg.norm(knots.points[b] - knots.points[a], axis=1) > COINCIDENT
    meeting = intervals[~separation]
    knots.last[meeting[~_on_single_branch(knots, meeting), 0]] = True
    left: Integers = intervals[separation]
    return left


def _halve(
    deciding: Eigenvalues,
    knots: _Knots,
    intervals: Integers,
    tolerance: float,
    offset: Floats,
    *,
    guarded: bool,
) -> Integers:
    """Put a knot into every interval, or a corner; return the intervals that are not good enough yet.

    `guarded` asks whether another eigenvalue has left the unit circle at the new knots.
    """
    same = _on_single_branch(knots, intervals)
    lost, left = intervals[~same], []
    jumps = knots.jumps[lost].any(axis=1)
    if not jumps.all():
        cornered, others = _corners(deciding, knots, lost[~jumps])
        left, lost = [cornered], np.concatenate([others, lost[jumps]])
    a, b = intervals[same].T
    if len(a):
        chord = knots.points[b] - knots.points[a]
        length = _norm(chord)
        tangent_a, tangent_b = knots.tangents(a), knots.tangents(b)
        # The cubic with these tangents goes through here in its middle.
        handles = handles_of(knots.points[a], knots.points[b], tangent_a, tangent_b)
        expected = (knots.points[a] + knots.points[b] + 3 * handles.sum(axis=1)) / 8
        unseen = distance_from_arc(tangent_a, tangent_b, length)
        index, pairs = newton_refine(deciding, expected, _halfway(knots, a, b, chord))
        error_bound = _norm(index - expected)
        good = error_bound <= ASTRAY * length
        if guarded:
            good &= clear(deciding, index, pairs)
        lost = np.concatenate([lost, np.stack([a[~good], b[~good]], axis=1)])
        a, b, index, pairs = a[good], b[good], index[good], pairs.at(good)
        error_bound = (error_bound[good] + unseen[good]) / GAIN
        middle = knots.add(index, pairs, a, (knots.key[a] + knots.key[b]) / 2)
        knots.error[a] = knots.error[middle] = error_bound
        # No nearer than where rounding has the boundary, which the curve's error counts as well.
        values = _rounding(deciding, pairs)
        fine = error_bound <= np.maximum(
            FILLED * tolerance * relative_to(index, pairs.gradient, offset), values
        )
        left += [np.stack([a, middle], axis=1)[~fine], np.stack([middle, b], axis=1)[~fine]]
    if len(lost):
        left.append(_search(deciding, knots, lost, tolerance, offset))
    return np.concatenate(left) if left else intervals[:0]


def _norm(vectors: Floats) -> Floats:
    """Return the lengths (…,) of vectors (…, 2)."""
    return np.hypot(vectors[..., 0], vectors[..., 1])


def relative_to(points: Floats, gradient: Floats, offset: Floats) -> Floats:
    """Return the scale of a relative distance from the boundary, at points (k, 2).

    A distance d is a difference d/|n_x| of one coordinate or d/|n_y| of the other, n the unit normal.
    """
    normal = np.abs(gradient) / np.linalg.norm(gradient, axis=1, keepdims=True)
    size: Floats = (normal * np.maximum(np.abs(points + offset), LEAST_COORDINATE)).max(axis=1)
    return size


def _on_single_branch(knots: _Knots, intervals: Integers) -> NDArray[np.bool_]:
    """Return for each interval whether the eigenvalues at its ends are on one branch."""
    a, b = intervals.T
    chord = knots.points[b] - knots.points[a]
    moves = [(knots.pairs.slope[end] * chord).sum(axis=1) for end in (a, b)]
    moved = knots.pairs.value[b] - knots.pairs.value[a]
    # A complex pair may meet on the real axis: slopes are then useless, but the eigenvalue is near the axis.
    size = np.abs(moved) + np.abs(moves[0]) + np.abs(moves[1])
    same: NDArray[np.bool_] = (knots.pairs.system[a] == knots.pairs.system[b]) & ~knots.jumps[intervals].any(
        axis=1
    )
    same &= np.abs(moved - (moves[0] + moves[1]) / 2) <= EXPLAINED * size + SHORT
    return same


def _halfway(knots: _Knots, a: Integers, b: Integers, chord: Floats) -> Pairs:
    """Return a guess of the pairs in the middle of intervals: the cubic through values and slopes."""
    start, end = knots.pairs.at(a), knots.pairs.at(b)
    slopes = ((start.slope - end.slope) * chord).sum(axis=1)
    return replace(start, value=(start.value + end.value) / 2 + slopes / 8)


def _corners(deciding: Eigenvalues, knots: _Knots, intervals: Integers) -> tuple[Integers, Integers]:
    """Solve for the corner in each interval; return the intervals adjacent to corners, and those without."""
    a, b = intervals.T
    count = len(a)
    chord = knots.points[b] - knots.points[a]
    length = _norm(chord)
    location = (knots.points[a] + knots.points[b]) / 2
    pairs = join([knots.pairs.at(a), knots.pairs.at(b)])
    before = np.concatenate([knots.points[a], knots.points[b]])
    for _ in range(MOST_STEPS):
        both = np.concatenate([location, location])
        pairs = deciding.follow(both, moved(pairs, both - before))
        before = both
        rows = np.stack([pairs.gradient[:count], pairs.gradient[count:]], axis=1)
        growth = np.stack([pairs.log_radius[:count], pairs.log_radius[count:]], axis=1)
        regular = np.abs(np.linalg.det(rows)) > UNIT_ROUNDOFF * np.square(rows).sum(axis=(1, 2))
        rows = np.where(regular[:, None, None], rows, np.eye(2))
        step = -np.linalg.solve(rows, growth[:, :, None])[:, :, 0]
        # The first step may overshoot; the corner is no farther than the chord is long.
        size = np.linalg.norm(step, axis=1)
        step *= np.minimum(1, length / np.maximum(size, np.finfo(np.float64).tiny))[:, None]
        location = location + step
        if np.all(size <= SHORT):
            break
    error_bound = np.linalg.norm(location - (knots.points[a] + knots.points[b]) / 2, axis=1)
    good = regular & (size <= SHORT) & (error_bound <= length)
    good &= clear(deciding, location, pairs.at(np.arange(count)))
    a, b, location = a[good], b[good], location[good]
    local = pairs.at(np.concatenate([good, good]))
    third = (knots.key[b] - knots.key[a]) / 3
    ends = knots.add(location, local.at(np.arange(len(a))), a, knots.key[a] + third)
    starts = knots.add(location, local.at(np.arange(len(a), 2 * len(a))), a, knots.key[b] - third)
    knots.last[ends] = True
    alongside = np.concatenate([np.stack([a, ends], axis=1), np.stack([starts, b], axis=1)])
    return alongside, intervals[~good]


def _search(
    deciding: Eigenvalues, knots: _Knots, intervals: Integers, tolerance: float, offset: Floats
) -> Integers:
    """Insert a knot into open intervals, at the intersection of the boundary with the perpendicular bisector.

    The intersection is near the chord, or farther away, as for a long narrow tongue. Returns the halves that
    are not good enough yet; an interval without such a crossing keeps the chord as its error. Along a jump
    the boundary is followed by straight lines: they are off by what the knot is.
    """
    a, b = intervals.T
    chord = knots.points[b] - knots.points[a]
    middle = (knots.points[a] + knots.points[b]) / 2
    across = np.stack([chord[:, 1], -chord[:, 0]], axis=1) / 2  # to the right, where it is unstable
    # From stable to unstable, in units of half a chord: nearby, then out to where the square ends.
    reach = FARTHER if len(a) <= FEW else 1
    out = np.geomspace(1, 2 / np.maximum(_norm(across), COINCIDENT), reach)
    indices = np.concatenate([-out[::-1], out])[:, :, None] * across + middle  # (2 · reach, k, 2)
    indices = np.asarray(just_inside(indices.reshape(-1, 2)))
    growth = deciding.growth(indices.reshape(-1, 2)).reshape(2 * reach, -1)
    rotations = (growth[:-1] < 0) & (growth[1:] >= 0)
    away = np.abs(np.arange(2 * reach - 1) - reach + 1)
    nearest = np.argmin(np.where(rotations, away[:, None], reach), axis=0)
    result, every = rotations.any(axis=0), np.arange(len(a))
    stable, unstable = (indices.reshape(2 * reach, -1, 2)[nearest + number, every] for number in (0, 1))
    ends = np.stack([growth[nearest + number, every] for number in (0, 1)], axis=1)
    knots.error[a[~result]] = np.linalg.norm(chord[~result], axis=1)
    a, b = a[result], b[result]
    if not len(a):
        return intervals[:0]
    tries = 1 if knots.jumps[np.stack([a, b])].any(axis=0).all() else MOST_TRIES
    index, pairs = cross(deciding, stable[result], unstable[result], ends[result], tries=tries)
    new = knots.add(index, pairs, a, (knots.key[a] + knots.key[b]) / 2)
    straight = knots.jumps[np.stack([a, new, b])].all(axis=0)
    error_bound = _norm(index - middle[result])
    straight &= error_bound <= FILLED * tolerance * relative_to(index, across[result], offset)
    knots.error[a[straight]] = knots.error[new[straight]] = error_bound[straight]
    a, b, new = a[~straight], b[~straight], new[~straight]
    return np.concatenate([np.stack([a, new], axis=1), np.stack([new, b], axis=1)])


def _arcs(deciding: Eigenvalues, knots: _Knots, closed: tuple[bool, ...]) -> tuple[BoundaryArc, ...]:
    """Return each chain's knots in order, cut at its corners."""
    arcs = []
    for chain, comes_back in enumerate(closed):
        members = np.flatnonzero(knots.chain == chain)
        order = members[np.argsort(knots.key[members], kind="stable")]
        pieces = np.split(order, np.flatnonzero(knots.last[order]) + 1)
        if comes_back and len(pieces) > 1:  # the first crossing is no corner
            pieces = [np.concatenate([pieces[-1], pieces[0][1:]]), *pieces[1:-1]]
        for piece in itertools.chain.from_iterable(_between_jumps(knots, piece) for piece in pieces):
            numbers = _without_copies(knots.points[piece])
            if len(numbers) > 1:
                arcs.append(_arc(deciding, knots, piece[numbers], chain))
    return tuple(arcs)


def _between_jumps(knots: _Knots, piece: Integers) -> list[Integers]:
    """Return the parts of a curve that follow a mode, and those along jumps; each begins where one ends."""
    jumps = knots.jumps[piece]
    cuts = np.flatnonzero(np.diff(jumps[:-1] | jumps[1:])) + 1
    return [piece[a : b + 1] for a, b in itertools.pairwise([0, *cuts.tolist(), len(piece) - 1])]


def _without_copies(points: Floats) -> Integers:
    """Return the points of a curve to keep so that consecutive ones differ; both ends are kept."""
    separation = _norm(np.diff(points, axis=0)) > COINCIDENT
    stored = np.flatnonzero(np.concatenate([[True], separation]))
    if len(stored) > 1:
        stored[-1] = len(points) - 1
    return stored


def _arc(deciding: Eigenvalues, knots: _Knots, piece: Integers, chain: int) -> BoundaryArc:
    """Return some knots as an arc."""
    jumps = knots.jumps[piece]
    if jumps.any():
        middle = piece[jumps][jumps.sum() // 2]
        value = complex(knots.pairs.value[middle])
        return straight_arc(
            knots.points[piece], knots.error[piece[:-1]], knots.points[middle], value, chain, RESOLUTION
        )
    pairs = knots.pairs.at(piece)
    system = int(pairs.system[0])
    points, along = knots.points[piece], knots.tangents(piece)
    return BoundaryArc(
        points=points,
        handles=handles_of(points[:-1], points[1:], along[:-1], along[1:]),
        errors=knots.error[piece[:-1]],
        knots=points,
        values=pairs.value,
        system=system,
        rounding=float(_rounding(deciding, pairs).max()),
        chain=chain,
    )


def _rounding(deciding: Eigenvalues, pairs: Pairs) -> Floats:
    """Return the rounding error of points of the boundary (k,), from their eigenpairs."""
    steepness = np.linalg.norm(pairs.gradient, axis=1)
    moved_by: Floats = deciding.value_errors(pairs) / np.maximum(steepness, np.finfo(np.float64).tiny)
    return moved_by


def trace_steps(
    growth: Callable[[Floats], Floats],
    dominant: Callable[[Floats], complex],
    survey: Survey,
    *,
    halvings: int = 0,
) -> tuple[BoundaryArc, ...]:
    """Follow a boundary from stability verdicts only, by straight segments.

    Over a link a packet is read at ticks only: the radius is a step function of the delay, and the boundary a
    staircase with a step wherever a packet arrives one tick later. Within a cell the boundary is not
    resolved: its error there is the length of the segment.

    Parameters
    ----------
    growth
        Returns the logarithm of the spectral radius (k,), or of its substitute, at points (k, 2).
    dominant
        Returns the critical eigenvalue at a point (2,).
    survey
        The crossings of the boundary with the cells' edges, in order.
    halvings
        The number of bisections of a segment, if the boundary has no steps; the error is then the last
        displacement.
    """
    stable, unstable = _closed_in(growth, survey.stable, survey.unstable)
    arcs = []
    for number, (chain, closed) in enumerate(zip(survey.chains, survey.closed, strict=True)):
        members = [*chain, chain[0]] if closed else list(chain)
        points = (stable[members] + unstable[members]) / 2
        errors = np.maximum(_norm(np.diff(points, axis=0)), RESOLUTION)
        for _ in range(halvings):
            points, errors = _halved(growth, points, errors)
        middle = members[len(members) // 2]  # its unstable side has the motion that grows
        arcs.append(
            straight_arc(points, errors, unstable[middle], dominant(unstable[middle]), number, RESOLUTION)
        )
    return tuple(arcs)


def _closed_in(growth: Callable[[Floats], Floats], stable: Floats, unstable: Floats) -> tuple[Floats, Floats]:
    """Bisect stretches from stable to unstable points (k, 2) until they are as short as `RESOLUTION`."""
    while len(stable) and float(np.abs(unstable - stable).max()) > RESOLUTION:
        middle = (stable + unstable) / 2
        out = growth(middle) >= 0
        unstable, stable = np.where(out[:, None], middle, unstable), np.where(out[:, None], stable, middle)
    return stable, unstable


def _halved(growth: Callable[[Floats], Floats], points: Floats, errors: Floats) -> tuple[Floats, Floats]:
    """Insert a point of the boundary at the middle of each segment with an error above `STRAIGHT`.

    Halving a chord of a circular arc reduces the error by four; a factor of two is assumed.
    """
    lines = np.flatnonzero(errors > STRAIGHT)
    chord = np.diff(points, axis=0)[lines]
    middle = (points[lines] + points[lines + 1]) / 2
    across = np.stack([chord[:, 1], -chord[:, 0]], axis=1) / 2  # to the right, where it is unstable
    stable, unstable = just_inside(middle - across), just_inside(middle + across)
    if not len(lines):
        return points, errors
    crossed = (growth(stable) < 0) & (growth(unstable) >= 0)
    ends = _closed_in(growth, stable[crossed], unstable[crossed])
    lines, added = lines[crossed], (ends[0] + ends[1]) / 2
    errors = errors.copy()
    errors[lines] = np.maximum(_norm(added - middle[crossed]) / 2, RESOLUTION)
    return np.insert(points, lines + 1, added, axis=0), np.insert(errors, lines, errors[lines])


def straight_arc(
    points: Floats, errors: Floats, knot: Floats, value: complex, chain: int = 0, rounding: float = 0.0
) -> BoundaryArc:
    """Return an arc of straight lines.

    Parameters
    ----------
    points
        The lines' ends (k, 2) in the unit square, the stable side on the left of their order.
    errors
        Bounds on each line's distance from the boundary (k − 1,).
    knot, value
        A point (2,) on the boundary or beyond it, and the eigenvalue that decides there.
    chain
        The index of the arc's chain in the survey.
    rounding
        The error of the points.
    """
    return BoundaryArc(
        points=points,
        handles=straight_handles(points),
        errors=errors,
        knots=knot[None],
        values=np.array([value], np.complex128),
        system=0,
        rounding=rounding,
        chain=chain,
        smooth=False,
    )


def traced(
    deciding: Eigenvalues,
    samples: Callable[[Floats], Floats],
    *,
    cells: int,
    tolerance: float,
    offset: Floats,
) -> tuple[tuple[BoundaryArc, ...], Survey, float, float]:
    """Survey the unit square and follow the boundary; cells are halved where a curve is lost.

    It was then taken for another one: two crossings lie on one side of a cell.

    Parameters
    ----------
    deciding, tolerance, offset
        As for `trace`.
    samples, cells
        As for `survey`.

    Returns
    -------
    The arcs, the survey they are of, and the stable area with its error, of the unit square.
    """
    result = survey(samples, cells=cells)
    arcs = trace(deciding, result, tolerance=tolerance, offset=offset)
    area, error_bound = stable_area(arcs, result)
    for halving in range(1, MOST_HALVED + 1):
        if error_bound >= 1 or max((float(arc.errors.max()) for arc in arcs), default=0.0) <= LOST:
            break
        finer = survey(samples, cells=cells * 2**halving)
        repeated = trace(deciding, finer, tolerance=tolerance, offset=offset)
        better = stable_area(repeated, finer)
        if better[1] < error_bound:  # for example at a cusp
            arcs, result, (area, error_bound) = repeated, finer, better
    return arcs, result, area, error_bound


def stable_area(arcs: Sequence[BoundaryArc], survey: Survey) -> tuple[float, float]:
    """Return the stable share of the unit square, by Green's theorem, and a bound on its error.

    ∮ x dy around the stable side: along the curves, and up the right edge where that is stable.
    """
    area, error_bound = 0.0, 0.0
    ends: dict[int, list[Floats]] = {}
    for arc in arcs:
        area += area_under(arc.points, arc.handles)
        length = np.linalg.norm(np.diff(arc.points, axis=0), axis=1)
        error_bound += float(length @ arc.errors) + float(length.sum()) * arc.rounding
        ends.setdefault(arc.chain, []).append(arc.points)
    rotations = []
    for chain, pieces in ends.items():
        if not survey.closed[chain]:
            rotations += [float(end[1]) for end in (pieces[0][0], pieces[-1][-1]) if end[0] == 1.0]
    stable, below = survey.corners[1], 0.0
    for turn in [*sorted(rotations), 1.0]:
        area += (turn - below) if stable else 0.0
        stable, below = not stable, turn
    return min(max(area, 0.0), 1.0), error_bound
