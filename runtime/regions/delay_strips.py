"""The boundary of a stable region over a delay and another parameter, strip by strip of the delay.

Takes: a `Model`, a delay's range and another parameter's.
Gives: `TracedRegion`, `trace_delay_strips`.
Guarantees: within a strip the order of events stays: curves there are as right as those of two parameters
that reach no time; between strips, where events coincide, the boundary goes straight along the delay's value.
A number of peers goes by strips too, one each from halfway to the one before to halfway to the next.
Does not: take two times, or models linearized at their start (None: see `boundary.trace_steps`).

Where no event moves within a strip, as over a link, whose packets are read at ticks only, nothing changes
with the delay: the boundary is a straight line at a critical value of the other parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Model
from apc.eigen.relative_coordinates import relative_bounded
from apc.eigen.spectrum import mode_near
from apc.frame.numeric_model import Prepared
from apc.frame.parameter_names import ParameterRef, Range, parameter_of
from apc.parameter_studies.clock_periods import period_segments
from apc.parameter_studies.count_range import count_segments
from apc.parameter_studies.crossing import ESTIMATE, search
from apc.parameter_studies.delay_segments import DelaySegment, delay_progress, delay_segments
from apc.parameter_studies.evaluator import closed_at, evaluator_of_many, generic, reaches_count
from apc.parameter_studies.frame_matrices import batch_evaluator
from apc.parameter_studies.parameter_path import MatrixPath
from apc.parameter_studies.stability_criteria import NOMINAL, RadiusEvaluator
from apc.parameter_studies.timing_values import reaches_period, system_with_delay
from apc.regions.adaptive_grid import HALVINGS
from apc.regions.axes import LOCATION
from apc.regions.boundary import BoundaryArc, straight_arc, traced
from apc.regions.curves import tangents
from apc.regions.dominant_pairs import Eigenvalues, log_magnitudes
from apc.regions.rectangle import DirectFamily, Rectangle, family_over, rectangle_of

Floats = NDArray[np.float64]

# Magnitudes evaluated at each point: three complex pairs.
BRANCHES = 6

# Ends of curves on either side of a strip's edge that are nearer than this many tolerances are one point:
# each is off by a tolerance at most, and the coordinate it is relative to differs by little.
SAME = 8.0

# The distance inside a strip, relative to its width, of the point that represents its edge.
INSIDE = 1e-6


@dataclass(frozen=True, slots=True)
class TracedRegion:
    """A boundary in the unit square: the delay runs along `axis` (0: x, 1: y).

    `area` is the stable share of the square, `error_bound` bounds its error, `corner` is whether (0, 0) is
    stable, `cell` are the sides of the largest cells, `finest` is the share of them that the smallest had.
    """

    arcs: tuple[BoundaryArc, ...]
    area: float
    error_bound: float
    corner: bool
    cell: tuple[float, float]
    finest: float


@dataclass(frozen=True, slots=True)
class _Strip:
    """A strip from `start` to `end` of the delay's unit range, the delay first in its arcs' points.

    `stable` is the stability of the lower ends of its two edges.
    """

    start: float
    end: float
    arcs: tuple[BoundaryArc, ...]
    stable: tuple[bool, bool]
    area: float
    error_bound: float


def trace_delay_strips(
    system: Model,
    axes: tuple[Range, Range],
    axis: int,
    prepared: Prepared,
    *,
    cells: int,
    tolerance: float,
    progress: Callable[[str], None] | None = None,
) -> TracedRegion | None:
    """Follow the boundary strip by strip; None if a strip has no closed form.

    Parameters
    ----------
    system, axes
        The model, and its two parameters with their ranges.
    axis
        The index of the delay, 0 or 1; the other axis affects no time.
    prepared
        From `numeric_model.prepare`; all subsystems linear.
    cells, tolerance
        As for `stable_region.region`, of every strip.
    progress
        Called with the progress.

    Raises
    ------
    ApcError
        E844 a time that no delay is linear in.
    """
    delay, other = axes[axis], axes[1 - axis]
    strips: list[_Strip] = []
    for strip in _delay_strips(system, delay, other, prepared, cells, tolerance, progress):
        if strip is None:
            return None
        strips.append(strip)
    if reaches_period(system, delay.free):
        strips = _between_periods(strips)
    whole = RadiusEvaluator(system, (delay.free, other.free), prepared, LOCATION, NOMINAL)
    arcs = [list(strip.arcs) for strip in strips]
    rectangle = rectangle_of(delay, other)
    edges = []
    for index in range(1, len(strips)):
        listed_edges = _join(strips, arcs, index, SAME * tolerance, whole, rectangle)
        if reaches_period(system, delay.free):  # the edge is anywhere between two periods
            width = max(strips[k].end - strips[k].start for k in (index - 1, index))
            listed_edges = [replace(edge, errors=edge.errors + width) for edge in listed_edges]
        edges += listed_edges

    def mode_of(arc: BoundaryArc) -> str:
        value = rectangle.values(arc.knots)[0].tolist()
        closed = closed_at(system, whole.free, prepared, value)
        return mode_near(closed, complex(arc.values[0])).family

    listed = _joined([arc for local in arcs for arc in local] + edges, mode_of)
    widest = max(strip.end - strip.start for strip in strips)
    cell = (widest / cells, 1 / cells)
    return TracedRegion(
        arcs=tuple(replace(_swapped(arc) if axis else arc, chain=n) for n, arc in enumerate(listed)),
        area=sum((strip.end - strip.start) * strip.area for strip in strips),
        error_bound=sum((strip.end - strip.start) * strip.error_bound for strip in strips),
        corner=strips[0].stable[0],
        cell=cell[::-1] if axis else cell,
        finest=2.0**-HALVINGS,
    )


def _delay_strips(
    system: Model,
    delay: Range,
    other: Range,
    prepared: Prepared,
    cells: int,
    tolerance: float,
    progress: Callable[[str], None] | None,
) -> Iterator[_Strip | None]:
    """Yield the strips in order; None for one that can't be had in closed form."""
    if reaches_count(system, delay.free) or reaches_period(system, delay.free):
        pieces = count_segments if reaches_count(system, delay.free) else period_segments
        for piece in pieces(system, delay, LOCATION):
            ends = [
                float((number - delay.low) / (delay.high - delay.low)) for number in (piece.low, piece.high)
            ]
            yield _delay_independent_strip(piece, other, ends, prepared)
        return
    # An oversized problem is refused before any strip is analyzed.
    longest = system_with_delay(system, delay.free, delay.high)
    evaluator_of_many(longest, [other.free], LOCATION, prepared=prepared)
    report_progress = delay_progress(
        system, delay.free, delay.low, delay.high, location=LOCATION, progress=progress
    )
    for piece in delay_segments(system, delay.free, delay.low, prepared, location=LOCATION, high=delay.high):
        high = min(piece.high, delay.high)
        report_progress(high)
        ends = [float((number - delay.low) / (delay.high - delay.low)) for number in (piece.low, high)]
        if piece.evaluator is None:
            yield _delay_independent_strip(piece, other, ends, prepared)
        else:
            yield _moving(system, delay, other, piece, ends, prepared, cells, tolerance)


def _between_periods(strips: Sequence[_Strip]) -> list[_Strip]:
    """Return strips of which each holds at one period only, with the errors that follow.

    Lines are uncertain by the width of the strip, areas by half of what they differ from the next ones.
    """
    result = []
    for n, strip in enumerate(strips):
        width = strip.end - strip.start
        neighbours = [strips[k].area for k in (n - 1, n + 1) if 0 <= k < len(strips)]
        error_bound = (
            strip.error_bound + max((abs(area - strip.area) for area in neighbours), default=0.0) / 2
        )
        arcs = tuple(replace(arc, errors=arc.errors + width) for arc in strip.arcs)
        result.append(replace(strip, arcs=arcs, error_bound=error_bound))
    return result


def _delay_independent_strip(
    piece: DelaySegment, other: Range, ends: Sequence[float], prepared: Prepared
) -> _Strip | None:
    """Return a strip in which nothing depends on the delay: straight lines at the other's critical values."""
    low, high, free = float(other.low), float(other.high), other.free
    family = evaluator_of_many(piece.inside, [free], LOCATION, prepared=prepared)
    line = MatrixPath(family, prepared, np.array([parameter_of(piece.inside, free).value]), 0, low, high)
    result = search(line)
    if not result.stable or any(edge.proof == ESTIMATE for edge in result.edges):
        return None
    arcs, heights = [], [0.0]
    for crossing in result.edges:
        height = min(max((crossing.value - low) / (high - low), 0.0), 1.0)
        heights.append(height)
        # The stable side is on the left: to the west it is below, to the east above.
        indices = ends[::-1] if crossing.stable_side == "below" else ends
        values = line.sample_at(np.array([crossing.value]))[0][0]
        arcs.append(
            straight_arc(
                np.array([[indices[0], height], [indices[1], height]]),
                np.array([crossing.error / (high - low) + np.spacing(1.0)]),
                np.array([(ends[0] + ends[1]) / 2, height]),
                complex(values[np.argmax(np.abs(values))]),
            )
        )
    first = result.stable[0]
    steps = np.diff([*heights, 1.0])
    area = float(steps[0 if first else 1 :: 2].sum())
    error_bound = sum(float(arc.errors[0]) for arc in arcs)
    return _Strip(ends[0], ends[1], tuple(arcs), (first, first), area, error_bound)


def _moving(
    system: Model,
    delay: Range,
    other: Range,
    piece: DelaySegment,
    ends: Sequence[float],
    prepared: Prepared,
    cells: int,
    tolerance: float,
) -> _Strip | None:
    """Return a strip in which events move with the delay: its curves, in units of the whole range."""
    low = np.array([float(piece.low), float(other.low)])
    high = np.array([float(min(piece.high, delay.high)), float(other.high)])
    rectangle = Rectangle(low, high - low)
    family = _within(system, (delay.free, other.free), prepared, piece, rectangle)
    if family is None:
        return None
    arcs, survey, area, error_bound = traced(
        Eigenvalues(family),
        lambda points: log_magnitudes(family.matrices(points), BRANCHES),
        cells=cells,
        tolerance=tolerance,
        offset=rectangle.offset,
    )
    placed = tuple(_placed(arc, ends) for arc in arcs)
    return _Strip(ends[0], ends[1], placed, (survey.corners[0], survey.corners[1]), area, error_bound)


def _within(
    system: Model,
    free: tuple[ParameterRef, ParameterRef],
    prepared: Prepared,
    piece: DelaySegment,
    rectangle: Rectangle,
) -> DirectFamily | None:
    """Return the matrices over a strip, each step linear in the delay; None where other motions are free."""
    assert piece.evaluator is not None, "something depends on the delay"
    groups, exchange = lifted_groups(generic(piece.inside, free[1:]), prepared=prepared)
    family = batch_evaluator(piece.inside, free, groups, exchange, durations=piece.evaluator.durations)

    def errors(values: Floats) -> tuple[Floats, ...]:
        """Return those of analyses at values, in the coordinates of the evaluator."""
        closed = [closed_at(system, free, prepared, value) for value in values.tolist()]
        return tuple(
            np.stack(
                [
                    relative_bounded(closed_systems[k].matrix, closed_systems[k].error, wiring.relative)[1]
                    for closed_systems in closed
                ]
            )
            for k, wiring in enumerate(family.wirings)
        )

    if any(wiring.moving for wiring in family.wirings):
        return None
    return family_over(family, rectangle, errors)


def _placed(arc: BoundaryArc, ends: Sequence[float]) -> BoundaryArc:
    """Return an arc of a strip's unit square in that of the whole."""
    scale = np.array([ends[1] - ends[0], 1.0])

    def moved(points: Floats) -> Floats:
        """Return points of the strip's square; its edges become exactly the strip's ends."""
        placed: Floats = points * scale + np.array([ends[0], 0.0])
        placed[points[..., 0] == 0.0, 0], placed[points[..., 0] == 1.0, 0] = ends[0], ends[1]
        return placed

    # A line at distance e from another with the direction t is at distance e det S/|S t| in the scaled
    # square.
    shrunk = scale[0] / np.linalg.norm(tangents(arc.points, arc.handles) * scale, axis=1)
    return replace(
        arc,
        points=moved(arc.points),
        handles=moved(arc.handles),
        errors=arc.errors * np.maximum(shrunk[:-1], shrunk[1:]),
        knots=moved(arc.knots),
        rounding=arc.rounding * float(shrunk.max()),
    )


def _join(
    strips: Sequence[_Strip],
    arcs: list[list[BoundaryArc]],
    index: int,
    same: float,
    source: RadiusEvaluator,
    rectangle: Rectangle,
) -> list[BoundaryArc]:
    """Join the curves of two strips at the edge between them; return the straight pieces along it.

    Ends that are one point become one; where one side of the edge is stable and the other is not, the
    boundary follows the edge.
    """
    edge = strips[index].start
    marks: list[tuple[float, int, int, int]] = []  # height, side, arc, which end of it
    for side in (0, 1):
        for number, arc in enumerate(arcs[index - 1 + side]):
            marks += [
                (float(arc.points[end, 1]), side, number, end)
                for end in ((0, -1) if not arc.closed else ())
                if arc.points[end, 0] == edge
            ]
    marks.sort()
    state = [strips[index - 1].stable[1], strips[index].stable[0]]
    result, below = [], 0.0
    for height, side, number, end in [*marks, (1.0, -1, 0, 0)]:
        if state[0] != state[1]:
            if side >= 0 and below > 0.0 and height - below <= same:
                local = arcs[index - 1 + side][number]
                arcs[index - 1 + side][number] = _ended(local, end, np.array([edge, below]))
                height = below
            elif height > below:
                result.append(_edge_piece(edge, below, height, state[0], strips, index, source, rectangle))
        if side >= 0:
            state[side] = not state[side]
        below = height
    return result


def _ended(arc: BoundaryArc, end: int, point: Floats) -> BoundaryArc:
    """Return an arc with one end moved by less than a tolerance or so."""
    points, errors = arc.points.copy(), arc.errors.copy()
    errors[end] += float(np.linalg.norm(points[end] - point))
    points[end] = point
    return replace(arc, points=points, errors=errors)


def _edge_piece(
    edge: float,
    low: float,
    high: float,
    stable_before: bool,
    strips: Sequence[_Strip],
    index: int,
    source: RadiusEvaluator,
    rectangle: Rectangle,
) -> BoundaryArc:
    """Return a part of the boundary along an edge between strips, and the unstable mode next to it."""
    grows = strips[index] if stable_before else strips[index - 1]
    inside = (1 if stable_before else -1) * INSIDE * (grows.end - grows.start)
    knot = np.array([edge + inside, (low + high) / 2])
    points = np.array([[edge, low], [edge, high]])
    dominant = source.dominant(rectangle.values(knot).tolist())
    # Upwards, the left-hand side is the strip before.
    points = points if stable_before else points[::-1].copy()
    return straight_arc(points, np.array([np.spacing(1.0)]), knot, dominant)


def _joined(arcs: Sequence[BoundaryArc], mode_of: Callable[[BoundaryArc], str]) -> list[BoundaryArc]:
    """Return the arcs, straight ones of one mode that follow one another as one."""
    result = [arc for arc in arcs if arc.smooth]
    interchangeable: dict[str, list[BoundaryArc]] = {}
    for arc in arcs:
        if not arc.smooth:
            interchangeable.setdefault(mode_of(arc), []).append(arc)
    for listed in interchangeable.values():
        result += _chained(listed)
    return result


def _chained(listed: list[BoundaryArc]) -> list[BoundaryArc]:
    """Return straight arcs, those that follow one another as one."""
    arcs = []
    while listed:
        arc = listed.pop()
        for tail, head in ((-1, 0), (0, -1)):  # first what follows it, then what it follows
            while not arc.closed:
                end = arc.points[tail]
                index = next(
                    (n for n, arc in enumerate(listed) if np.array_equal(arc.points[head], end)), None
                )
                if index is None:
                    break
                other = listed.pop(index)
                arc = _after(arc, other) if tail else _after(other, arc)
        arcs.append(arc)
    return arcs


def _after(arc: BoundaryArc, other: BoundaryArc) -> BoundaryArc:
    """Return two arcs as one."""
    points = np.concatenate([arc.points, other.points[1:]])
    rest: dict[str, Any] = {
        name: np.concatenate([getattr(arc, name), getattr(other, name)])
        for name in ("handles", "errors", "knots", "values")
    }
    return replace(arc, points=points, **rest)


def _swapped(arc: BoundaryArc) -> BoundaryArc:
    """Return an arc with its coordinates in the other order, and so backwards: the stable side stays left."""
    names = ("points", "handles", "errors", "knots", "values")
    backwards: dict[str, Any] = {name: getattr(arc, name)[::-1] for name in names}
    for name in ("points", "handles", "knots"):
        backwards[name] = backwards[name][..., ::-1]
    backwards["handles"] = backwards["handles"][:, ::-1]
    return replace(arc, **{name: values.copy() for name, values in backwards.items()})
