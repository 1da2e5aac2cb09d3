"""Boundary curves of a stable region in the unit square, to a stated accuracy.

Takes: an `Eigenvalues` and the `Survey` of its cells.
Gives: `BoundaryArc`, `trace`, `survey_and_trace`; `trace_steps`, `straight_arc` for a boundary that has
steps; `stable_area`, `relative_to`.
Guarantees: every point lies on the boundary to rounding; between its points a curve is the cubic Hermite
interpolant through points and tangents, compared with the true boundary in the middle of every interval.
Where the critical mode changes the curve has a corner, which is solved for. Steps are located along each
cell's edge to `RESOLUTION` of the range. The area is exact for the curves; their distances from the boundary
bound its error.
Does not: find pieces of the boundary without a crossing in the survey.

On the boundary log|λ| = 0 for the critical eigenvalue; its gradient gives Newton's step

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

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.regions.adaptive_grid import Survey, just_inside, survey
from apc.regions.boundary_points import (
    MOST_STEPS,
    MOST_TRIES,
    SHORT,
    cross,
    extrapolated,
    is_outermost,
    newton_refine,
)
from apc.regions.curves import area_under, distance_from_arc, handles_of, straight_handles, tangents
from apc.regions.dominant_pairs import Eigenvalues, Pairs, join

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]

# The largest number of halvings of intervals between the first points of a curve. Each halving makes the
# interpolant 16 times more accurate.
MOST_HALVINGS = 12

# The assumed gain in accuracy by a knot in the middle of an interval: half of the theoretical 16.
GAIN = 8.0

# A knot whose log|λ| is farther from 0 is at a jump: rigid modes differ between both sides.
JUMP = 1e-6

# Points closer to each other than this are equal.
COINCIDENT = 1e-11

# The error of a curve, in the unit square, above which it is lost; the number of cell halvings to find it.
LOST, MOST_HALVED = 1e-3, 3

# Number of points on either side of a chord at which the boundary is searched, at growing distances, and the
# largest number of chords.
FARTHER, FEW = 24, 8

# A middle farther from the expected point, relative to the interval, is not on the same piece.
ASTRAY = 0.25

# Two ends of an interval are on one branch if the eigenvalues' difference agrees with their slopes to this
# share.
EXPLAINED = 0.25

# The allowed share of the tolerance in the middle of an interval: elsewhere the distance may be twice as
# large, and rounding adds to it.
FILLED = 0.375

# The accuracy of a boundary step on a cell's edge, as a share of the range: finer than any figure.
RESOLUTION = 2.0**-24

# A straight line with a smaller error, as a share of the range, is not halved.
STRAIGHT = 2.5e-4

# Errors are relative to a coordinate, or to this share of its range where the coordinate is smaller.
LEAST_COORDINATE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class BoundaryArc:
    """An arc of the boundary with one critical mode, stable side on the left, in the unit square.

    For `points` (k, 2) and `handles` (k − 1, 2, 2) see `curves`. `errors` (k − 1,) are the distances of its
    segments from the boundary. `knots` (m, 2) are the points that were solved for, `values` (m,) the critical
    eigenvalues there, `system` is the index of their closed-loop system, and `rounding` bounds the rounding
    error of knots. `chain` is the index of the arc's chain in the survey. An arc that is not `smooth` has
    straight segments.
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
        """Unit normals (k, 2) at the points, towards the unstable side."""
        normals: Floats = tangents(self.points, self.handles)[:, ::-1] * np.array([1.0, -1.0])
        return normals

    @property
    def closed(self) -> bool:
        """Whether the arc is a closed curve."""
        return bool(len(self.points) > 2 and np.array_equal(self.points[0], self.points[-1]))


class _Knots:
    """Points on the boundary with their critical eigenvalues; `key` is their order within a chain.

    `error` is that of the interval from a knot to the next; `last` states whether an arc ends at the knot.
    """

    def __init__(self, points: Floats, pairs: Pairs, chain: Integers, key: Floats) -> None:
        self.points, self.pairs, self.chain, self.key = points, pairs, chain, key
        self.error = np.zeros(len(key))
        self.last = np.zeros(len(key), dtype=bool)

    def add(self, points: Floats, pairs: Pairs, after: Integers, key: Floats) -> Integers:
        """Add knots to the chains of the knots `after`; return the indices of the new knots."""
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
        """The mask of knots at which the spectral radius is discontinuous."""
        return np.asarray(~(np.abs(self.pairs.log_radius) <= JUMP))

    def tangents(self, knots: Integers) -> Floats:
        """Return the unit tangents (k, 2) at some knots, with decreasing log|λ| on their left."""
        gradient = self.pairs.gradient[knots]
        rotated = np.stack([-gradient[:, 1], gradient[:, 0]], axis=1)
        unit: Floats = rotated / np.maximum(
            np.linalg.norm(rotated, axis=1, keepdims=True), np.finfo(np.float64).tiny
        )
        return unit


def trace(
    evaluator: Eigenvalues, survey: Survey, *, tolerance: float, offset: Floats
) -> tuple[BoundaryArc, ...]:
    """Return the boundary as smooth arcs through all crossings of a survey.

    Parameters
    ----------
    evaluator
        The evaluator over the unit square.
    survey
        The crossings of the boundary with the cells' edges, in order.
    tolerance
        Largest distance between curves and boundary, relative to the coordinate in which the difference is
        smaller.
    offset
        The offset from unit coordinates to values relative to zero (2,): lower end over width of the range.
    """
    if not survey.chains:
        return ()
    points, pairs = cross(evaluator, survey.stable, survey.unstable, survey.log_radius)
    members: list[int] = []
    chain: list[int] = []
    key: list[int] = []
    for number, (crossings, closed) in enumerate(zip(survey.chains, survey.closed, strict=True)):
        closed_chain = [*crossings, crossings[0]] if closed else list(crossings)
        members += closed_chain
        chain += [number] * len(closed_chain)
        key += range(len(closed_chain))
    used = np.array(members)
    knots = _Knots(points[used], pairs.at(used), np.array(chain), np.array(key, np.float64))
    first = np.flatnonzero(knots.chain[1:] == knots.chain[:-1])
    intervals = np.stack([first, first + 1], axis=1)
    for halving in range(MOST_HALVINGS):
        intervals = _without_empty_intervals(knots, intervals)
        if not len(intervals):
            break
        intervals = _halve_intervals(evaluator, knots, intervals, tolerance, offset, guarded=not halving)
    for a, b in intervals.tolist():  # not resolved: the chord bounds the error
        knots.error[a] = max(knots.error[a], float(np.linalg.norm(knots.points[b] - knots.points[a])))
    return _arcs(evaluator, knots, survey.closed)


def _without_empty_intervals(knots: _Knots, intervals: Integers) -> Integers:
    """Return the intervals of positive length.

    An empty interval between two modes marks the end of an arc.
    """
    a, b = intervals.T
    has_length = np.linalg.norm(knots.points[b] - knots.points[a], axis=1) > COINCIDENT
    empty = intervals[~has_length]
    knots.last[empty[~_on_single_branch(knots, empty), 0]] = True
    remaining: Integers = intervals[has_length]
    return remaining


def _halve_intervals(
    evaluator: Eigenvalues,
    knots: _Knots,
    intervals: Integers,
    tolerance: float,
    offset: Floats,
    *,
    guarded: bool,
) -> Integers:
    """Add a knot to every interval, or a corner; return the intervals that are not accurate enough yet.

    `guarded`: other eigenvalues outside the unit circle are tested at the new knots.
    """
    same = _on_single_branch(knots, intervals)
    lost, open_intervals = intervals[~same], []
    jumps = knots.jumps[lost].any(axis=1)
    if not jumps.all():
        next_to_corners, without_corner = _solve_corners(evaluator, knots, lost[~jumps])
        open_intervals, lost = [next_to_corners], np.concatenate([without_corner, lost[jumps]])
    a, b = intervals[same].T
    if len(a):
        chord = knots.points[b] - knots.points[a]
        length = _lengths(chord)
        tangent_a, tangent_b = knots.tangents(a), knots.tangents(b)
        # The middle of the cubic with these tangents.
        handles = handles_of(knots.points[a], knots.points[b], tangent_a, tangent_b)
        expected = (knots.points[a] + knots.points[b] + 3 * handles.sum(axis=1)) / 8
        unmeasured = distance_from_arc(tangent_a, tangent_b, length)
        points, pairs = newton_refine(evaluator, expected, _guess_at_middle(knots, a, b, chord))
        error_bound = _lengths(points - expected)
        accepted = error_bound <= ASTRAY * length
        if guarded:
            accepted &= is_outermost(evaluator, points, pairs)
        lost = np.concatenate([lost, np.stack([a[~accepted], b[~accepted]], axis=1)])
        a, b, points, pairs = a[accepted], b[accepted], points[accepted], pairs.at(accepted)
        error_bound = (error_bound[accepted] + unmeasured[accepted]) / GAIN
        middle = knots.add(points, pairs, a, (knots.key[a] + knots.key[b]) / 2)
        knots.error[a] = knots.error[middle] = error_bound
        # The rounding of the boundary point limits the accuracy.
        values = _rounding(evaluator, pairs)
        fine = error_bound <= np.maximum(
            FILLED * tolerance * relative_to(points, pairs.gradient, offset), values
        )
        open_intervals += [np.stack([a, middle], axis=1)[~fine], np.stack([middle, b], axis=1)[~fine]]
    if len(lost):
        open_intervals.append(_search_across_chords(evaluator, knots, lost, tolerance, offset))
    return np.concatenate(open_intervals) if open_intervals else intervals[:0]


def _lengths(vectors: Floats) -> Floats:
    """Return the lengths (…,) of vectors (…, 2)."""
    return np.hypot(vectors[..., 0], vectors[..., 1])


def relative_to(points: Floats, gradient: Floats, offset: Floats) -> Floats:
    """Return the scale of a relative distance from the boundary, at points (k, 2).

    A distance d is a difference d/|n_x| in one coordinate or d/|n_y| in the other, n the unit normal.
    """
    normal = np.abs(gradient) / np.linalg.norm(gradient, axis=1, keepdims=True)
    size: Floats = (normal * np.maximum(np.abs(points + offset), LEAST_COORDINATE)).max(axis=1)
    return size


def _on_single_branch(knots: _Knots, intervals: Integers) -> NDArray[np.bool_]:
    """Return for each interval whether the eigenvalues at its ends are on one branch."""
    a, b = intervals.T
    chord = knots.points[b] - knots.points[a]
    predicted = [(knots.pairs.slope[end] * chord).sum(axis=1) for end in (a, b)]
    difference = knots.pairs.value[b] - knots.pairs.value[a]
    # A complex pair may meet on the real axis: slopes are then useless, but the eigenvalue is near the axis.
    size = np.abs(difference) + np.abs(predicted[0]) + np.abs(predicted[1])
    is_single: NDArray[np.bool_] = (knots.pairs.system[a] == knots.pairs.system[b]) & ~knots.jumps[
        intervals
    ].any(axis=1)
    is_single &= np.abs(difference - (predicted[0] + predicted[1]) / 2) <= EXPLAINED * size + SHORT
    return is_single


def _guess_at_middle(knots: _Knots, a: Integers, b: Integers, chord: Floats) -> Pairs:
    """Return a guess of the eigenpairs in the middle of intervals, from values and slopes at their ends."""
    start, end = knots.pairs.at(a), knots.pairs.at(b)
    slopes = ((start.slope - end.slope) * chord).sum(axis=1)
    return replace(start, value=(start.value + end.value) / 2 + slopes / 8)


def _solve_corners(evaluator: Eigenvalues, knots: _Knots, intervals: Integers) -> tuple[Integers, Integers]:
    """Return the intervals next to the corners between two modes, and the intervals without a corner."""
    a, b = intervals.T
    count = len(a)
    chord = knots.points[b] - knots.points[a]
    length = _lengths(chord)
    location = (knots.points[a] + knots.points[b]) / 2
    pairs = join([knots.pairs.at(a), knots.pairs.at(b)])
    previous = np.concatenate([knots.points[a], knots.points[b]])
    for _ in range(MOST_STEPS):
        locations = np.concatenate([location, location])
        pairs = evaluator.refine(locations, extrapolated(pairs, locations - previous))
        previous = locations
        rows = np.stack([pairs.gradient[:count], pairs.gradient[count:]], axis=1)
        log_radii = np.stack([pairs.log_radius[:count], pairs.log_radius[count:]], axis=1)
        is_regular = np.abs(np.linalg.det(rows)) > UNIT_ROUNDOFF * np.square(rows).sum(axis=(1, 2))
        rows = np.where(is_regular[:, None, None], rows, np.eye(2))
        step = -np.linalg.solve(rows, log_radii[:, :, None])[:, :, 0]
        # The first step may overshoot: steps are limited to the length of the chord.
        size = np.linalg.norm(step, axis=1)
        step *= np.minimum(1, length / np.maximum(size, np.finfo(np.float64).tiny))[:, None]
        location = location + step
        if np.all(size <= SHORT):
            break
    error_bound = np.linalg.norm(location - (knots.points[a] + knots.points[b]) / 2, axis=1)
    accepted = is_regular & (size <= SHORT) & (error_bound <= length)
    accepted &= is_outermost(evaluator, location, pairs.at(np.arange(count)))
    a, b, location = a[accepted], b[accepted], location[accepted]
    corner_pairs = pairs.at(np.concatenate([accepted, accepted]))
    third = (knots.key[b] - knots.key[a]) / 3
    ends = knots.add(location, corner_pairs.at(np.arange(len(a))), a, knots.key[a] + third)
    starts = knots.add(location, corner_pairs.at(np.arange(len(a), 2 * len(a))), a, knots.key[b] - third)
    knots.last[ends] = True
    next_to_corners = np.concatenate([np.stack([a, ends], axis=1), np.stack([starts, b], axis=1)])
    return next_to_corners, intervals[~accepted]


def _search_across_chords(
    evaluator: Eigenvalues, knots: _Knots, intervals: Integers, tolerance: float, offset: Floats
) -> Integers:
    """Add a knot to each interval at the crossing of the boundary with the perpendicular bisector.

    The crossing may be far from the chord, for example at a long narrow tongue. Returns the halves that are
    not accurate enough yet; an interval without a crossing has the length of the chord as its error. Along a
    jump the boundary consists of straight lines, with the distance of the knot from the chord as error.
    """
    a, b = intervals.T
    chord = knots.points[b] - knots.points[a]
    middle = (knots.points[a] + knots.points[b]) / 2
    half_normal = np.stack([chord[:, 1], -chord[:, 0]], axis=1) / 2  # to the right, the unstable side
    # From stable to unstable, in units of half a chord: first close to it, then up to the edges of the
    # square.
    count = FARTHER if len(a) <= FEW else 1
    offsets = np.geomspace(1, 2 / np.maximum(_lengths(half_normal), COINCIDENT), count)
    indices = (
        np.concatenate([-offsets[::-1], offsets])[:, :, None] * half_normal + middle
    )  # (2 · count, k, 2)
    indices = np.asarray(just_inside(indices.reshape(-1, 2)))
    growth = evaluator.growth(indices.reshape(-1, 2)).reshape(2 * count, -1)
    sign_changes = (growth[:-1] < 0) & (growth[1:] >= 0)
    distances = np.abs(np.arange(2 * count - 1) - count + 1)
    nearest = np.argmin(np.where(sign_changes, distances[:, None], count), axis=0)
    has_crossing, columns = sign_changes.any(axis=0), np.arange(len(a))
    stable, unstable = (indices.reshape(2 * count, -1, 2)[nearest + number, columns] for number in (0, 1))
    ends = np.stack([growth[nearest + number, columns] for number in (0, 1)], axis=1)
    knots.error[a[~has_crossing]] = np.linalg.norm(chord[~has_crossing], axis=1)
    a, b = a[has_crossing], b[has_crossing]
    if not len(a):
        return intervals[:0]
    tries = 1 if knots.jumps[np.stack([a, b])].any(axis=0).all() else MOST_TRIES
    index, pairs = cross(
        evaluator, stable[has_crossing], unstable[has_crossing], ends[has_crossing], tries=tries
    )
    new_knots = knots.add(index, pairs, a, (knots.key[a] + knots.key[b]) / 2)
    along_jump = knots.jumps[np.stack([a, new_knots, b])].all(axis=0)
    error_bound = _lengths(index - middle[has_crossing])
    along_jump &= error_bound <= FILLED * tolerance * relative_to(index, half_normal[has_crossing], offset)
    knots.error[a[along_jump]] = knots.error[new_knots[along_jump]] = error_bound[along_jump]
    a, b, new_knots = a[~along_jump], b[~along_jump], new_knots[~along_jump]
    return np.concatenate([np.stack([a, new_knots], axis=1), np.stack([new_knots, b], axis=1)])


def _arcs(evaluator: Eigenvalues, knots: _Knots, closed: tuple[bool, ...]) -> tuple[BoundaryArc, ...]:
    """Return the arcs of all chains: their knots in order, divided at corners and jumps."""
    arcs = []
    for chain, is_closed in enumerate(closed):
        members = np.flatnonzero(knots.chain == chain)
        order = members[np.argsort(knots.key[members], kind="stable")]
        pieces = np.split(order, np.flatnonzero(knots.last[order]) + 1)
        if is_closed and len(pieces) > 1:  # the first crossing is no corner
            pieces = [np.concatenate([pieces[-1], pieces[0][1:]]), *pieces[1:-1]]
        for piece in itertools.chain.from_iterable(_between_jumps(knots, piece) for piece in pieces):
            distinct = _distinct_points(knots.points[piece])
            if len(distinct) > 1:
                arcs.append(_arc(evaluator, knots, piece[distinct], chain))
    return tuple(arcs)


def _between_jumps(knots: _Knots, piece: Integers) -> list[Integers]:
    """Return the parts of a curve along a mode and along jumps, each starting at the end of the
    previous one.
    """
    jumps = knots.jumps[piece]
    cuts = np.flatnonzero(np.diff(jumps[:-1] | jumps[1:])) + 1
    return [piece[a : b + 1] for a, b in itertools.pairwise([0, *cuts.tolist(), len(piece) - 1])]


def _distinct_points(points: Floats) -> Integers:
    """Return the indices of the points of a curve without repetitions; both ends are included."""
    differs = _lengths(np.diff(points, axis=0)) > COINCIDENT
    indices = np.flatnonzero(np.concatenate([[True], differs]))
    if len(indices) > 1:
        indices[-1] = len(points) - 1
    return indices


def _arc(evaluator: Eigenvalues, knots: _Knots, piece: Integers, chain: int) -> BoundaryArc:
    """Return some knots of a chain as an arc: smooth, or with straight segments along a jump."""
    jumps = knots.jumps[piece]
    if jumps.any():
        middle = piece[jumps][jumps.sum() // 2]
        value = complex(knots.pairs.value[middle])
        return straight_arc(
            knots.points[piece], knots.error[piece[:-1]], knots.points[middle], value, chain, RESOLUTION
        )
    pairs = knots.pairs.at(piece)
    system = int(pairs.system[0])
    points, tangents_at_points = knots.points[piece], knots.tangents(piece)
    return BoundaryArc(
        points=points,
        handles=handles_of(points[:-1], points[1:], tangents_at_points[:-1], tangents_at_points[1:]),
        errors=knots.error[piece[:-1]],
        knots=points,
        values=pairs.value,
        system=system,
        rounding=float(_rounding(evaluator, pairs).max()),
        chain=chain,
    )


def _rounding(evaluator: Eigenvalues, pairs: Pairs) -> Floats:
    """Return the rounding error of boundary points (k,), from their eigenpairs."""
    steepness = np.linalg.norm(pairs.gradient, axis=1)
    displacement: Floats = evaluator.value_errors(pairs) / np.maximum(steepness, np.finfo(np.float64).tiny)
    return displacement


def trace_steps(
    growth: Callable[[Floats], Floats],
    dominant: Callable[[Floats], complex],
    survey: Survey,
    *,
    halvings: int = 0,
) -> tuple[BoundaryArc, ...]:
    """Return a boundary with straight segments, located by stability verdicts only.

    Packets are read at ticks only: the radius is a step function of a link's delay, and the boundary a
    staircase with a step wherever a packet arrives one tick later. Within a cell the boundary is not
    resolved: its error there is the length of the segment.

    Parameters
    ----------
    growth
        The function from points (k, 2) to the logarithm of the spectral radius, or of its substitute, (k,).
    dominant
        The function from a point (2,) to its critical eigenvalue.
    survey
        The crossings of the boundary with the cells' edges, in order.
    halvings
        The number of bisections of a segment, if the boundary has no steps; the error is then the last
        displacement.
    """
    stable, unstable = _bisect_brackets(growth, survey.stable, survey.unstable)
    arcs = []
    for number, (chain, closed) in enumerate(zip(survey.chains, survey.closed, strict=True)):
        members = [*chain, chain[0]] if closed else list(chain)
        points = (stable[members] + unstable[members]) / 2
        errors = np.maximum(_lengths(np.diff(points, axis=0)), RESOLUTION)
        for _ in range(halvings):
            points, errors = _halve_segments(growth, points, errors)
        middle = members[len(members) // 2]  # the critical mode is that of the unstable side
        arcs.append(
            straight_arc(points, errors, unstable[middle], dominant(unstable[middle]), number, RESOLUTION)
        )
    return tuple(arcs)


def _bisect_brackets(
    growth: Callable[[Floats], Floats], stable: Floats, unstable: Floats
) -> tuple[Floats, Floats]:
    """Return brackets from stable to unstable points (k, 2), bisected to lengths up to `RESOLUTION`."""
    while len(stable) and float(np.abs(unstable - stable).max()) > RESOLUTION:
        middle = (stable + unstable) / 2
        is_unstable = growth(middle) >= 0
        unstable, stable = (
            np.where(is_unstable[:, None], middle, unstable),
            np.where(is_unstable[:, None], stable, middle),
        )
    return stable, unstable


def _halve_segments(
    growth: Callable[[Floats], Floats], points: Floats, errors: Floats
) -> tuple[Floats, Floats]:
    """Return points and errors with a boundary point added in the middle of each segment above `STRAIGHT`.

    Halving a chord of a circular arc reduces the error by four; a factor of two is assumed.
    """
    segments = np.flatnonzero(errors > STRAIGHT)
    chord = np.diff(points, axis=0)[segments]
    middle = (points[segments] + points[segments + 1]) / 2
    half_normal = np.stack([chord[:, 1], -chord[:, 0]], axis=1) / 2  # to the right, the unstable side
    stable, unstable = just_inside(middle - half_normal), just_inside(middle + half_normal)
    if not len(segments):
        return points, errors
    crossed = (growth(stable) < 0) & (growth(unstable) >= 0)
    ends = _bisect_brackets(growth, stable[crossed], unstable[crossed])
    segments, added = segments[crossed], (ends[0] + ends[1]) / 2
    errors = errors.copy()
    errors[segments] = np.maximum(_lengths(added - middle[crossed]) / 2, RESOLUTION)
    return np.insert(points, segments + 1, added, axis=0), np.insert(errors, segments, errors[segments])


def straight_arc(
    points: Floats, errors: Floats, knot: Floats, value: complex, chain: int = 0, rounding: float = 0.0
) -> BoundaryArc:
    """Return an arc of straight segments.

    Parameters
    ----------
    points
        The segments' ends (k, 2) in the unit square, the stable side on the left of their order.
    errors
        Bounds on each segment's distance from the boundary (k − 1,).
    knot, value
        A point (2,) on the boundary or beyond it, and the critical eigenvalue there.
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


def survey_and_trace(
    evaluator: Eigenvalues,
    samples: Callable[[Floats], Floats],
    *,
    cells: int,
    tolerance: float,
    offset: Floats,
) -> tuple[tuple[BoundaryArc, ...], Survey, float, float]:
    """Return the boundary in the unit square by a survey and tracing; cells are halved where a curve is lost.

    A curve is lost if two crossings are on one side of a cell, so that crossings of different curves are
    linked.

    Parameters
    ----------
    evaluator, tolerance, offset
        As for `trace`.
    samples, cells
        As for `survey`.

    Returns
    -------
    The arcs, their survey, and the stable share of the unit square with its error.
    """
    result = survey(samples, cells=cells)
    arcs = trace(evaluator, result, tolerance=tolerance, offset=offset)
    area, error_bound = stable_area(arcs, result)
    for halving in range(1, MOST_HALVED + 1):
        if error_bound >= 1 or max((float(arc.errors.max()) for arc in arcs), default=0.0) <= LOST:
            break
        finer = survey(samples, cells=cells * 2**halving)
        repeated = trace(evaluator, finer, tolerance=tolerance, offset=offset)
        better = stable_area(repeated, finer)
        if better[1] < error_bound:  # for example at a cusp
            arcs, result, (area, error_bound) = repeated, finer, better
    return arcs, result, area, error_bound


def stable_area(arcs: Sequence[BoundaryArc], survey: Survey) -> tuple[float, float]:
    """Return the stable share of the unit square, by Green's theorem, and a bound on its error.

    ∮ x dy around the stable side: along the curves, and along the stable parts of the right edge.
    """
    area, error_bound = 0.0, 0.0
    ends: dict[int, list[Floats]] = {}
    for arc in arcs:
        area += area_under(arc.points, arc.handles)
        length = np.linalg.norm(np.diff(arc.points, axis=0), axis=1)
        error_bound += float(length @ arc.errors) + float(length.sum()) * arc.rounding
        ends.setdefault(arc.chain, []).append(arc.points)
    heights = []
    for chain, pieces in ends.items():
        if not survey.closed[chain]:
            heights += [float(end[1]) for end in (pieces[0][0], pieces[-1][-1]) if end[0] == 1.0]
    stable, previous = survey.corners[1], 0.0
    for height in [*sorted(heights), 1.0]:
        area += (height - previous) if stable else 0.0
        stable, previous = not stable, height
    return min(max(area, 0.0), 1.0), error_bound
