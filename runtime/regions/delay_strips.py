"""The boundary of a stable region over a delay and another parameter, strip by strip of the delay.

Takes: a `NumericModel`, a delay's range and another parameter's.
Gives: `TracedRegion`, `trace_delay_strips`.
Guarantees: within a strip the order of events is constant: curves are as accurate as those of two parameters
that affect no time; between strips, where events coincide, the boundary is straight along the delay's value.
Each number of peers is a strip, too, with edges halfway to the neighbouring numbers.
Does not: cover two times, or models linearized at their start (None: see `boundary.trace_steps`).

If no event depends on the delay within a strip, as for a link, whose packets are read at ticks only, the
boundary is a straight line at a critical value of the other parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_classes
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.parameter_names import ParameterRef, Range, parameter_of
from apc.regions.adaptive_grid import HALVINGS
from apc.regions.axes import LOCATION
from apc.regions.boundary import BoundaryArc, straight_arc, survey_and_trace
from apc.regions.curves import tangents
from apc.regions.dominant_pairs import Eigenvalues, log_magnitudes
from apc.regions.rectangle import DirectFamily, Rectangle, family_over, rectangle_of
from apc.spectrum.relative_coordinates import relative_bounded
from apc.spectrum.spectrum import mode_near
from apc.studies.clock_periods import period_segments
from apc.studies.count_range import count_segments
from apc.studies.crossing import ESTIMATE, search
from apc.studies.delay_segments import DelaySegment, delay_progress, delay_segments
from apc.studies.evaluator import closed_at, evaluator_of_many, generic
from apc.studies.evaluator_choice import EvaluatorKind, kind_for_parameter
from apc.studies.frame_matrices import batch_evaluator
from apc.studies.parameter_path import MatrixPath
from apc.studies.stability_criteria import NOMINAL, RadiusEvaluator
from apc.studies.timing_values import model_with_time

Floats = NDArray[np.float64]

# Magnitudes evaluated at each point: three complex pairs.
BRANCHES = 6

# Ends of curves on both sides of a strip's edge are joined if their distance is below this number of
# tolerances: the error of each is at most one tolerance.
SAME = 8.0

# The distance inside a strip, relative to its width, of the point that represents its edge.
INSIDE = 1e-6


@dataclass(frozen=True, slots=True)
class TracedRegion:
    """A boundary in the unit square, from strips of a delay or from one survey.

    `area` is the stable share of the square, `error_bound` bounds its error, `corner` states whether (0, 0)
    is stable, `cell` are the sides of the largest cells, `finest` is the relative size of the smallest.
    """

    arcs: tuple[BoundaryArc, ...]
    area: float
    error_bound: float
    corner: bool
    cell: tuple[float, float]
    finest: float


@dataclass(frozen=True, slots=True)
class _Strip:
    """A strip from `start` to `end` of the delay's unit range; its arcs' first coordinate is the delay.

    `stable` is the stability at the lower ends of its two edges.
    """

    start: float
    end: float
    arcs: tuple[BoundaryArc, ...]
    stable: tuple[bool, bool]
    area: float
    error_bound: float


def trace_delay_strips(
    numeric: NumericModel,
    axes: tuple[Range, Range],
    axis: int,
    *,
    cells: int,
    tolerance: float,
    progress: Callable[[str], None] | None = None,
) -> TracedRegion | None:
    """Return the boundary strip by strip; None if the matrices of a strip have no closed form.

    Parameters
    ----------
    numeric, axes
        The model, all subsystems linear, and two of its parameters with their ranges.
    axis
        The index of the delay, 0 or 1; the other axis affects no time.
    cells, tolerance
        As for `stable_region.region`, of every strip.
    progress
        Called with the progress.

    Raises
    ------
    ApcError
        E844 a time that is not linear in the delay.
    """
    model = numeric.model
    delay, other = axes[axis], axes[1 - axis]
    is_period = kind_for_parameter(model, delay.free) is EvaluatorKind.PERIODS
    strips: list[_Strip] = []
    for strip in _delay_strips(numeric, delay, other, cells, tolerance, progress):
        if strip is None:
            return None
        strips.append(strip)
    if is_period:
        strips = _with_period_errors(strips)
    pointwise = RadiusEvaluator(numeric, (delay.free, other.free), LOCATION, NOMINAL)
    arcs = [list(strip.arcs) for strip in strips]
    rectangle = rectangle_of(delay, other)
    edges = []
    for index in range(1, len(strips)):
        edge_arcs = _join_at_edge(strips, arcs, index, SAME * tolerance, pointwise, rectangle)
        if is_period:  # the edge is anywhere between two periods
            width = max(strips[k].end - strips[k].start for k in (index - 1, index))
            edge_arcs = [replace(edge, errors=edge.errors + width) for edge in edge_arcs]
        edges += edge_arcs

    def mode_of(arc: BoundaryArc) -> str:
        """Return the name of the closed system of an arc's critical mode."""
        value = rectangle.values(arc.knots)[0].tolist()
        closed = closed_at(numeric, pointwise.free, value)
        return mode_near(closed, complex(arc.values[0])).family

    merged = _merged_arcs([arc for arcs_of_strip in arcs for arc in arcs_of_strip] + edges, mode_of)
    widest = max(strip.end - strip.start for strip in strips)
    cell = (widest / cells, 1 / cells)
    return TracedRegion(
        arcs=tuple(replace(_swapped(arc) if axis else arc, chain=n) for n, arc in enumerate(merged)),
        area=sum((strip.end - strip.start) * strip.area for strip in strips),
        error_bound=sum((strip.end - strip.start) * strip.error_bound for strip in strips),
        corner=strips[0].stable[0],
        cell=cell[::-1] if axis else cell,
        finest=2.0**-HALVINGS,
    )


def _delay_strips(
    numeric: NumericModel,
    delay: Range,
    other: Range,
    cells: int,
    tolerance: float,
    progress: Callable[[str], None] | None,
) -> Iterator[_Strip | None]:
    """Yield the strips in order; None for a strip without a closed form."""
    model = numeric.model
    kind = kind_for_parameter(model, delay.free)
    if kind is not EvaluatorKind.DELAYS:
        segments_of = count_segments if kind is EvaluatorKind.COUNTS else period_segments
        for segment in segments_of(model, delay, LOCATION):
            ends = [
                float((number - delay.low) / (delay.high - delay.low))
                for number in (segment.low, segment.high)
            ]
            yield _delay_independent_strip(segment, other, ends, numeric)
        return
    # An oversized problem is refused before any strip is analyzed.
    longest = model_with_time(model, delay.free, delay.high)
    evaluator_of_many(numeric.at(longest), [other.free], LOCATION)
    report_progress = delay_progress(
        model, delay.free, delay.low, delay.high, location=LOCATION, progress=progress
    )
    for segment in delay_segments(numeric, delay.free, delay.low, location=LOCATION, high=delay.high):
        high = min(segment.high, delay.high)
        report_progress(high)
        ends = [float((number - delay.low) / (delay.high - delay.low)) for number in (segment.low, high)]
        if segment.evaluator is None:
            yield _delay_independent_strip(segment, other, ends, numeric)
        else:
            yield _varying_strip(numeric, delay, other, segment, ends, cells, tolerance)


def _with_period_errors(strips: Sequence[_Strip]) -> list[_Strip]:
    """Return strips that are exact at one period each, with errors for the width of the strips.

    Lines are uncertain by the width of the strip, areas by half of their difference from neighbouring areas.
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
    segment: DelaySegment, other: Range, ends: Sequence[float], numeric: NumericModel
) -> _Strip | None:
    """Return a strip that is constant in the delay: straight lines at the other parameter's critical
    values.
    """
    low, high, parameter_ref = float(other.low), float(other.high), other.free
    inside = numeric.at(segment.inside)
    family = evaluator_of_many(inside, [parameter_ref], LOCATION)
    path = MatrixPath(
        family, inside, np.array([parameter_of(segment.inside, parameter_ref).value]), 0, low, high
    )
    result = search(path)
    if not result.stable or any(item.proof == ESTIMATE for item in result.crossings):
        return None
    arcs, heights = [], [0.0]
    for crossing in result.crossings:
        height = min(max((crossing.value - low) / (high - low), 0.0), 1.0)
        heights.append(height)
        # The stable side is on the left: below for a line towards smaller delays, above for one towards
        # larger.
        line_ends = ends[::-1] if crossing.stable_side == "below" else ends
        values = path.sample_at(np.array([crossing.value]))[0][0]
        arcs.append(
            straight_arc(
                np.array([[line_ends[0], height], [line_ends[1], height]]),
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


def _varying_strip(
    numeric: NumericModel,
    delay: Range,
    other: Range,
    segment: DelaySegment,
    ends: Sequence[float],
    cells: int,
    tolerance: float,
) -> _Strip | None:
    """Return a strip in which events depend on the delay: its curves, in units of the complete range."""
    low = np.array([float(segment.low), float(other.low)])
    high = np.array([float(min(segment.high, delay.high)), float(other.high)])
    rectangle = Rectangle(low, high - low)
    family = _family_of_strip(numeric, (delay.free, other.free), segment, rectangle)
    if family is None:
        return None
    arcs, survey, area, error_bound = survey_and_trace(
        Eigenvalues(family),
        lambda points: log_magnitudes(family.matrices(points), BRANCHES),
        cells=cells,
        tolerance=tolerance,
        offset=rectangle.offset,
    )
    scaled = tuple(_scaled_arc(arc, ends) for arc in arcs)
    return _Strip(ends[0], ends[1], scaled, (survey.corners[0], survey.corners[1]), area, error_bound)


def _family_of_strip(
    numeric: NumericModel,
    parameter_refs: tuple[ParameterRef, ParameterRef],
    segment: DelaySegment,
    rectangle: Rectangle,
) -> DirectFamily | None:
    """Return the matrices over a strip, step durations linear in the delay; None if rigid modes change."""
    assert segment.evaluator is not None, "something depends on the delay"
    peer_classes, comm_graph = lifted_classes(numeric.at(generic(segment.inside, parameter_refs[1:])))
    family = batch_evaluator(
        segment.inside, parameter_refs, peer_classes, comm_graph, durations=segment.evaluator.durations
    )

    def errors(values: Floats) -> tuple[Floats, ...]:
        """Return the error bounds of analyses at values, in the coordinates of the evaluator."""
        closed = [closed_at(numeric, parameter_refs, value) for value in values.tolist()]
        return tuple(
            np.stack(
                [
                    relative_bounded(closed_systems[k].matrix, closed_systems[k].error, wiring.relative)[1]
                    for closed_systems in closed
                ]
            )
            for k, wiring in enumerate(family.wirings)
        )

    if any(wiring.modes_vary for wiring in family.wirings):
        return None
    return family_over(family, rectangle, errors)


def _scaled_arc(arc: BoundaryArc, ends: Sequence[float]) -> BoundaryArc:
    """Return an arc of a strip's unit square in the unit square of the complete range."""
    scale = np.array([ends[1] - ends[0], 1.0])

    def scaled_points(points: Floats) -> Floats:
        """Return points in the complete square; the strip's edges are exactly its ends."""
        scaled: Floats = points * scale + np.array([ends[0], 0.0])
        scaled[points[..., 0] == 0.0, 0], scaled[points[..., 0] == 1.0, 0] = ends[0], ends[1]
        return scaled

    # A line at distance e from another with the direction t is at distance e det S/|S t| in the scaled
    # square.
    factor = scale[0] / np.linalg.norm(tangents(arc.points, arc.handles) * scale, axis=1)
    return replace(
        arc,
        points=scaled_points(arc.points),
        handles=scaled_points(arc.handles),
        errors=arc.errors * np.maximum(factor[:-1], factor[1:]),
        knots=scaled_points(arc.knots),
        rounding=arc.rounding * float(factor.max()),
    )


def _join_at_edge(
    strips: Sequence[_Strip],
    arcs: list[list[BoundaryArc]],
    index: int,
    same: float,
    source: RadiusEvaluator,
    rectangle: Rectangle,
) -> list[BoundaryArc]:
    """Join the curves of two strips at the edge between them; return the straight pieces along the edge.

    Ends within the distance `same` become one point; where one side of the edge is stable and the other is
    not, the boundary follows the edge.
    """
    edge = strips[index].start
    arc_ends: list[tuple[float, int, int, int]] = []  # height, side, arc, which end of it
    for side in (0, 1):
        for number, arc in enumerate(arcs[index - 1 + side]):
            arc_ends += [
                (float(arc.points[end, 1]), side, number, end)
                for end in ((0, -1) if not arc.closed else ())
                if arc.points[end, 0] == edge
            ]
    arc_ends.sort()
    stable_sides = [strips[index - 1].stable[1], strips[index].stable[0]]
    result, previous = [], 0.0
    for height, side, number, end in [*arc_ends, (1.0, -1, 0, 0)]:
        if stable_sides[0] != stable_sides[1]:
            if side >= 0 and previous > 0.0 and height - previous <= same:
                arc_to_join = arcs[index - 1 + side][number]
                arcs[index - 1 + side][number] = _with_moved_end(arc_to_join, end, np.array([edge, previous]))
                height = previous
            elif height > previous:
                result.append(
                    _edge_piece(edge, previous, height, stable_sides[0], strips, index, source, rectangle)
                )
        if side >= 0:
            stable_sides[side] = not stable_sides[side]
        previous = height
    return result


def _with_moved_end(arc: BoundaryArc, end: int, point: Floats) -> BoundaryArc:
    """Return an arc with one end moved by about a tolerance, with its error increased by the distance."""
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
    """Return a straight part of the boundary along an edge between strips, with the unstable mode
    next to it.
    """
    unstable_strip = strips[index] if stable_before else strips[index - 1]
    offset = (1 if stable_before else -1) * INSIDE * (unstable_strip.end - unstable_strip.start)
    knot = np.array([edge + offset, (low + high) / 2])
    points = np.array([[edge, low], [edge, high]])
    dominant = source.dominant(rectangle.values(knot).tolist())
    # For an upward piece, the left side is the previous strip.
    points = points if stable_before else points[::-1].copy()
    return straight_arc(points, np.array([np.spacing(1.0)]), knot, dominant)


def _merged_arcs(arcs: Sequence[BoundaryArc], mode_of: Callable[[BoundaryArc], str]) -> list[BoundaryArc]:
    """Return the arcs, with consecutive straight arcs of one mode merged."""
    result = [arc for arc in arcs if arc.smooth]
    straight_arcs: dict[str, list[BoundaryArc]] = {}
    for arc in arcs:
        if not arc.smooth:
            straight_arcs.setdefault(mode_of(arc), []).append(arc)
    for arcs_of_mode in straight_arcs.values():
        result += _chains_of(arcs_of_mode)
    return result


def _chains_of(remaining: list[BoundaryArc]) -> list[BoundaryArc]:
    """Return straight arcs with consecutive ones merged."""
    arcs = []
    while remaining:
        arc = remaining.pop()
        for tail, head in ((-1, 0), (0, -1)):  # first the arcs after it, then the arcs before it
            while not arc.closed:
                end = arc.points[tail]
                index = next(
                    (n for n, arc in enumerate(remaining) if np.array_equal(arc.points[head], end)), None
                )
                if index is None:
                    break
                neighbour = remaining.pop(index)
                arc = _concatenated(arc, neighbour) if tail else _concatenated(neighbour, arc)
        arcs.append(arc)
    return arcs


def _concatenated(arc: BoundaryArc, following: BoundaryArc) -> BoundaryArc:
    """Return the concatenation of two arcs; the second starts at the end of the first."""
    points = np.concatenate([arc.points, following.points[1:]])
    fields: dict[str, Any] = {
        name: np.concatenate([getattr(arc, name), getattr(following, name)])
        for name in ("handles", "errors", "knots", "values")
    }
    return replace(arc, points=points, **fields)


def _swapped(arc: BoundaryArc) -> BoundaryArc:
    """Return an arc with exchanged coordinates, in reverse order: the stable side stays on the left."""
    names = ("points", "handles", "errors", "knots", "values")
    reversed_fields: dict[str, Any] = {name: getattr(arc, name)[::-1] for name in names}
    for name in ("points", "handles", "knots"):
        reversed_fields[name] = reversed_fields[name][..., ::-1]
    reversed_fields["handles"] = reversed_fields["handles"][:, ::-1]
    return replace(arc, **{name: values.copy() for name, values in reversed_fields.items()})
