"""The stable region of two parameters: exact boundary curves, areas, and who is inside.

Takes: a `Model`, two parameters and their ranges.
Gives: `Curve`, `Region`, `region`, `side_of_curves`.
Guarantees: every curve comes with a bound on its distance from the boundary, the mode that makes it and that
mode's frequency; an empty region and one without boundary are answers. What was looked at how finely is part
of the answer: a component smaller than a cell, with nothing around it that hints at it, can be missed.
Does not: draw, or write files (see `present`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import near_start, prepare_at_start
from apc.analysis.sides import Side, sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.timings import part
from apc.compiler.words import counted
from apc.eigen.closing import ClosedLoop
from apc.eigen.spectrum import mode_near
from apc.frame.devices import replaced_hands
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.names import ParameterRef, Range, notes_for_all_groups
from apc.frame.overrides import apply
from apc.network.nominal import left_out, refuse_channel_number
from apc.regions.axes import PLACE
from apc.regions.boundary import BoundaryArc, relative_to, stable_area, trace_steps, traced
from apc.regions.curves import between
from apc.regions.deciding import Eigenvalues, log_magnitudes
from apc.regions.rectangle import INSIDE, DirectFamily, Rectangle, family_over, rectangle_of
from apc.regions.strips import BRANCHES, TracedRegion, trace_strips
from apc.regions.survey import blurred, just_inside, survey
from apc.result import PlotStyle, Result
from apc.threads import single_threaded
from apc.vary.batch import BatchEvaluator
from apc.vary.crossing import Progress
from apc.vary.evaluator import (
    JoinedEvaluator,
    PiecewiseEvaluator,
    closed_at,
    evaluator_of_many,
    overrides_at,
    parameters_suffice,
    reaches_count,
    reaches_time,
)
from apc.vary.growth import (
    BY_GROWTH,
    MEAN_SQUARE,
    NOMINAL,
    PASSIVE,
    RadiusEvaluator,
    criterion_of,
    judge_at,
    refuse_time,
)
from apc.vary.leading import DrivingPart
from apc.vary.timing_values import is_scaled, reaches_period

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]

# Coarse cells along each side of the rectangle.
CELLS = 12

# Distance of a smooth curve from the boundary, relative to a coordinate (see `boundary.trace`). Of one that
# could not be followed so closely it is said, see `Region.coarse`.
TOLERANCE = 1e-9

# The same by a criterion of one number, whose slopes are differences: each of its values takes milliseconds.
TOLERANCE_OF_DIFFERENCES = 1e-6

# How often the straight lines of a boundary known by verdicts alone are halved, where it has no steps.
HALVINGS = 3

# How near to 0 or π, in radians, an eigenvalue's angle may come before its turns are counted again.
FOLD = 0.1

# Points looked at together when they are compared with all curves.
CHUNK = 1024


# What gives the closed systems at a point; none where one number decides.
ClosedAt = Callable[[Sequence[float]], tuple[ClosedLoop, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A piece of the boundary made by one mode; the stable side is on the left of the points' order.

    `points` (k, 2) are in SI, as are `handles` (k − 1, 2, 2): from each point to the next goes the cubic
    Bézier curve with these two control points between, a straight line if not `smooth` (where events
    coincide, in the steps over two times, and with passive hands). `error` bounds the curve's distance from
    the true boundary, relative to the coordinate in which it makes the smaller difference, `distance` the
    same in units of the ranges. `knots` (m, 2) are the points solved for, in SI, and `eigenvalues` (m,) those
    that decide there.
    """

    points: Floats
    handles: Floats
    error: float
    distance: float
    closed: bool
    smooth: bool
    knots: Floats
    eigenvalues: NDArray[np.complex128]
    criterion: str
    closed_at: ClosedAt | None

    @property
    def mode(self) -> str:
        """The name of the closed system that makes the boundary here, or the criterion that does."""
        if self.closed_at is None:
            return self.criterion
        middle = len(self.knots) // 2
        return _identify(self.closed_at, self.knots[middle], complex(self.eigenvalues[middle]))[0]

    @property
    def frequency_hz(self) -> tuple[float, float]:
        """The least and the largest frequency, along the curve, of the motion that neither grows nor dies.

        Both are NaN where it can't be told.
        """
        if self.closed_at is None:
            return np.nan, np.nan
        angles = np.abs(np.angle(self.eigenvalues))
        middle = len(self.knots) // 2
        places = {middle} if self.smooth else set(range(len(self.knots)))
        if np.any(angles < FOLD) or np.any(angles > np.pi - FOLD):  # it may fold on the way
            places |= {0, len(self.knots) - 1}
        values: list[float] = []
        for place in sorted(places):
            _, turn, frame = _identify(self.closed_at, self.knots[place], complex(self.eigenvalues[place]))
            if np.isnan(turn):
                return np.nan, np.nan
            # turn = 2πm ± angle, and so is it along the curve.
            candidates = [
                2 * np.pi * round((turn - sign * float(angles[place])) / (2 * np.pi)) + sign * angles
                for sign in (1, -1)
            ]
            own = min(candidates, key=lambda candidate: abs(float(candidate[place]) - turn))
            listed = own if len(places) == 1 else own[[place]]
            values += (np.abs(listed) / (2 * np.pi * frame)).tolist()
        return min(values), max(values)


@dataclass(frozen=True, slots=True, eq=False)
class Region(Result):
    """The stable region of a rectangle of two parameters.

    `stable_area` is in the product of the axes' units. `cell` are the sides of the cells the rectangle was
    looked at in, in SI; where values hinted at more, cells down to `finest` of them. `corner` says whether
    the corner of both lower ends is stable, `stepped` that the boundary is right to a cell only, as times
    vary, `tolerance` how near smooth curves were to come (see `coarse`), `linearized` that the scene is not
    linear; `criterion` what stable means; `left_out` says what of the scene the answer does not look at.
    """

    shown_by = "region_output:region"

    topology: str
    x: Range
    y: Range
    curves: tuple[Curve, ...]
    stable_area: float
    stable_area_error: float
    cell: tuple[float, float]
    finest: float
    corner: bool
    stepped: bool
    tolerance: float
    linearized: bool
    criterion: str
    left_out: tuple[str, ...]
    system: Model

    @property
    def coarse(self) -> tuple[Curve, ...]:
        """The smooth curves that could not be followed to the tolerance, as their errors say."""
        return tuple(curve for curve in self.curves if curve.smooth and not curve.error <= self.tolerance)

    @property
    def rectangle(self) -> Rectangle:
        """The ranges."""
        return rectangle_of(self.x, self.y)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the points of all curves as a table (needs pandas)."""
        table: pandas.DataFrame = self._shown("table")
        return table

    def plot(self, ax: Any = None, **look: Unpack[PlotStyle]) -> Any:
        """Draw the region into a matplotlib Axes, or a figure of its own, as `look` says; return the Axes."""
        return self._drawn(ax, look=look)

    def contains(self, x: Any, y: Any) -> Any:
        """Say whether points are stable: by the curves or, nearer to them than their error, by eigenvalues.

        Parameters
        ----------
        x, y
            Values of the two parameters in SI, numbers or arrays that broadcast.

        Returns
        -------
        bool, or an array of them.

        Raises
        ------
        ApcError
            E904 a point outside the rectangle.
        """
        wide, high = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        values = np.stack([wide.ravel(), high.ravel()], axis=1)
        points = self.rectangle.points(values)
        if not np.all((points >= 0) & (points <= 1)):
            ranges = " and ".join(
                f"{axis.free.label} in {float(axis.low):g} to {float(axis.high):g} {axis.unit}"
                for axis in (self.x, self.y)
            )
            raise ApcError(Diagnostic("E904", PLACE, "a point", ranges, "one outside"))
        inside, near = side_of_curves(self, points)
        if near.any():
            inside[near] = _decide(self, values[near])
        return bool(inside[0]) if wide.ndim == 0 else inside.reshape(wide.shape)


@part("region")
def region(
    system: Model,
    axes: tuple[Range, Range],
    *,
    cells: int = CELLS,
    tolerance: float | None = None,
    criterion: str | None = None,
    prepared: Prepared | None = None,
    progress: Progress | None = None,
) -> Region:
    """Find the boundary of the stable region of two parameters.

    Parameters
    ----------
    system
        The compiled scene; all other parameters keep its numbers.
    axes
        The two parameters, from `parse_axes`.
    cells
        Into how many cells each side of the rectangle is divided to begin with.
    tolerance
        Largest distance between curves and boundary, relative to a coordinate; curves that could not be
        followed so closely are `Region.coarse`. None: `TOLERANCE`, in mean square `TOLERANCE_OF_DIFFERENCES`.
    criterion
        "mean-square" or "nominal", see `critical_values.critical`.
    prepared
        From `instance.prepare`, of this system with any numbers.
    progress
        Is told, in words, how far the work is.

    Raises
    ------
    ApcError
        E896 a number of an unreliable link; E905 the scene can't be analysed everywhere in the rectangle, or
        rounding leaves open where in it the boundary runs; and
        those of `analysis.lifted_groups`.

    Notes
    -----
    Where one axis is a delay, the rectangle is cut where events coincide (see `strips`). Along a period it is
    cut halfway between the periods that are analysed (see `periods`), unless all times scale with it. Where
    both axes are times each point is analysed by itself, and the boundary is a line from cell edge to cell
    edge, its error the size of a cell. A scene that is linearized at its start, and starts elsewhere along an
    axis, is analysed point by point where other motions are free. With passive hands there are no steps: its
    points are on the boundary, straight lines between, and its error is an estimate by their middles.
    """
    free = tuple(axis.free for axis in axes)
    meant = criterion_of(system, criterion, PLACE, free)
    tolerance = tolerance or (TOLERANCE_OF_DIFFERENCES if meant in BY_GROWTH else TOLERANCE)
    for item in free:
        if meant == NOMINAL:
            refuse_channel_number(system, item, PLACE, instead=f"--in {MEAN_SQUARE}")
        else:
            refuse_time(system, item, PLACE, meant)
    rectangle = rectangle_of(*axes)
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        prepared = prepared or prepare(system)
        affine = all(prepared.jacobians[group.kind].affine for group in system.groups)
        times = [place for place, item in enumerate(free) if reaches_time(system, item)]
        counts = [place for place, item in enumerate(free) if reaches_count(system, item)]
        if counts:
            _check_count(axes[counts[0]], len(counts) == 2, bool(times), meant, affine=affine)
        times = [] if meant in BY_GROWTH else times + counts
        # Where every time scales with a period the frame is the same at all values, but for its length.
        scales = len(times) == 1 and not counts and _scales(system, free[times[0]])
        times = [] if scales else times
        _refuse_two_times(system, [free[place] for place in times])
        starts = () if meant in BY_GROWTH else _starts(system, prepared, free, rectangle)
        start = starts[0].prepared if len(starts) == 1 else None
        striped: TracedRegion | None = None
        if not starts or times or scales:
            plane = _points_plane(system, free, rectangle, prepared, meant, stepped=bool(times))
            if meant == NOMINAL and not times:
                tolerance = max(tolerance, TOLERANCE_OF_DIFFERENCES)
            if start is not None and len(times) == 1:
                striped = trace_strips(
                    system, axes, times[0], start, cells=cells, tolerance=tolerance, progress=progress
                )
        else:
            source = JoinedEvaluator(
                system,
                free,
                tuple(evaluator_of_many(side.system, free, PLACE, prepared=side.prepared) for side in starts),
            )
            plane = _Plane(family_over(source, rectangle, source.errors), source.closed_at, stepped=False)
            try:
                striped = _surveyed(plane, cells, tolerance, progress)
            except ApcError as error:
                # Other motions are free, or there is a kink, where it starts elsewhere.
                if error.mistakes[0].code not in ("E808", "E905") or parameters_suffice(system, prepared):
                    raise
                if start is None:
                    plane = _points_plane(system, free, rectangle, prepared, meant, stepped=False)
                else:
                    plane = _pieces_plane(system, source.sources[0], rectangle, prepared, start)
        stepped = plane.stepped and striped is None
        striped = striped or _surveyed(plane, cells, tolerance, progress)
        curves = tuple(_curve(plane, arc, meant) for arc in striped.arcs)
    whole = float(rectangle.width.prod())
    return Region(
        topology=system.name,
        x=axes[0],
        y=axes[1],
        curves=curves,
        stable_area=striped.area * whole,
        stable_area_error=striped.off * whole,
        cell=(striped.cell[0] * float(rectangle.width[0]), striped.cell[1] * float(rectangle.width[1])),
        finest=striped.finest,
        corner=striped.corner,
        stepped=stepped,
        tolerance=tolerance,
        linearized=not affine,
        criterion=meant,
        left_out=(
            *near_start(system, prepared),
            *left_out(system, network=meant != MEAN_SQUARE, varied=free),
            *(replaced_hands(system) if meant == PASSIVE else ()),
            *notes_for_all_groups(system, free),
        ),
        system=system,
    )


def _starts(
    system: Model, prepared: Prepared, free: tuple[ParameterRef, ...], rectangle: Rectangle
) -> tuple[Side, ...]:
    """Return the models at the start, one for each side of a kink, with their Jacobians linearized there.

    None where the start does not decide, or where the number of sides changes over the rectangle.
    """
    listed = sides(system, prepared)
    if len(listed) > 1:
        for value in rectangle.values(INSIDE).tolist():
            elsewhere = apply(system, overrides_at(system, free, value))
            if len(sides(elsewhere, prepared)) != len(listed):
                return ()
    starts = [prepare_at_start(side.system, side.prepared, free) for side in listed]
    return tuple(
        replace(side, prepared=start)
        for side, start in zip(listed, starts, strict=True)
        if start is not None and None not in starts
    )


def _scales(system: Model, free: ParameterRef) -> bool:
    return reaches_period(system, free) and is_scaled(system, free, delays=True)


def _refuse_two_times(system: Model, times: Sequence[ParameterRef]) -> None:
    """Refuse a period together with another time, unless all clocks scale with it: ApcError E903."""
    if len(times) < 2:
        return
    for free in times:
        if reaches_period(system, free) and not is_scaled(system, free):
            what = f"{free.label} is a period, and the other axis a time: their frames are too long"
            raise ApcError(Diagnostic("E903", PLACE, what, hint=f"apc critical {free.label}"))


def _check_count(axis: Range, both: bool, timed: bool, meant: str, *, affine: bool) -> None:
    """Refuse a number of peers beside what no steps are drawn for: ApcError E903."""
    reasons = {
        "two numbers of peers": both,
        "a time beside it": timed,
        f"what is stable {BY_GROWTH.get(meant, '')}": meant in BY_GROWTH,
        "a scene that is not linear": not affine,
    }
    why = next((text for text, applies in reasons.items() if applies), "")
    if why:
        what = f"{axis.free.label} is a number of peers: no steps are drawn for {why}"
        raise ApcError(Diagnostic("E903", PLACE, what, hint=f"apc critical {axis.free.label}"))


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """The systems over the unit square; `stepped`: known at single points only, by verdicts."""

    family: DirectFamily
    closed_at: ClosedAt | None
    stepped: bool
    halvings: int = 0


def _points_plane(
    system: Model,
    free: tuple[ParameterRef, ...],
    rectangle: Rectangle,
    prepared: Prepared,
    meant: str,
    *,
    stepped: bool,
) -> _Plane:
    """Return what gives the one number of a criterion; `stepped`: a time or a number of peers varies."""
    source = RadiusEvaluator(system, free, prepared, PLACE, meant)
    # One point's bounds are enough, and dear.
    (errors,) = source.errors(rectangle.values(np.array([[0.5, 0.5]])))
    family = DirectFamily(source, rectangle, (DrivingPart(0, np.arange(1)),), (errors[0],))
    closed = partial(closed_at, system, free, prepared) if meant == NOMINAL else None
    # What hands can draw is known as the damping needed, which jumps.
    halvings = HALVINGS if meant == PASSIVE else 0
    return _Plane(family, closed, stepped or meant == PASSIVE, halvings)


def _pieces_plane(
    system: Model,
    source: BatchEvaluator,
    rectangle: Rectangle,
    prepared: Prepared,
    start: Prepared,
) -> _Plane:
    """Return what gives the matrices of a scene in which other motions are free in parts of the rectangle."""
    size = sum(len(closed.matrix) for closed in source.closed)
    pieces = PiecewiseEvaluator(system, source.free, start, size)
    (errors,) = pieces.errors(rectangle.values(np.array([[0.5, 0.5]])))
    family = DirectFamily(pieces, rectangle, (DrivingPart(0, np.arange(size)),), (errors[0],))
    return _Plane(family, partial(closed_at, system, source.free, prepared), stepped=False)


def _surveyed(plane: _Plane, cells: int, tolerance: float, progress: Progress | None) -> TracedRegion:
    """Survey the whole rectangle and follow the boundary through it, or go by steps from cell to cell."""
    deciding = Eigenvalues(plane.family)
    looked = 0

    def samples(points: Floats) -> Floats:
        nonlocal looked
        looked += len(points)
        if progress:
            progress(f"looking at {counted(looked, 'point')}")
        return _samples(plane, points)

    if plane.stepped:
        result = survey(samples, cells=cells)
        arcs = trace_steps(
            lambda points: samples(points)[:, 0],
            lambda point: _leading(plane, point),
            result,
            halvings=plane.halvings,
        )
        area, off = stable_area(arcs, result)
    else:
        offset = plane.family.rectangle.offset
        arcs, result, area, off = traced(deciding, samples, cells=cells, tolerance=tolerance, offset=offset)
    if off >= 1:  # of the unit square: the boundary may be anywhere in it
        raise blurred()
    return TracedRegion(
        arcs, area, off, result.corners[0], (result.cell, result.cell), result.finest / result.cell
    )


def _samples(plane: _Plane, points: Floats) -> Floats:
    """Return the logarithms of the largest magnitudes, or raise what is wrong with a point."""
    source, rectangle = plane.family.evaluator, plane.family.rectangle
    matrices = plane.family.matrices(points)
    for matrix in matrices:
        wrong = np.flatnonzero(~np.isfinite(matrix).all(axis=(1, 2)))
        if len(wrong):
            value = rectangle.values(points[wrong[:1]])[0].tolist()
            overrides = overrides_at(source.system, source.free, value)
            apply(source.system, overrides)  # says so itself if the value can't be
            if plane.closed_at is not None:
                plane.closed_at(value)
            what = "the scene's frame leaves the range of floating point numbers in part of the rectangle"
            raise ApcError(Diagnostic("E905", PLACE, what, hint="a smaller range"))
    return log_magnitudes(matrices, BRANCHES)


def _leading(plane: _Plane, point: Floats) -> complex:
    """Return the eigenvalue that decides at a point (2,) where one number is known."""
    source, rectangle = plane.family.evaluator, plane.family.rectangle
    assert isinstance(source, RadiusEvaluator), "one number is known"
    return source.leading(rectangle.values(point).tolist())


def _curve(plane: _Plane, arc: BoundaryArc, criterion: str) -> Curve:
    """Return an arc in SI."""
    rectangle, values = plane.family.rectangle, arc.values
    if arc.smooth and criterion == NOMINAL and isinstance(plane.family.evaluator, RadiusEvaluator):
        values = np.array([_leading(plane, point) for point in just_inside(arc.knots)])
    return Curve(
        points=rectangle.values(arc.points),
        handles=rectangle.values(arc.handles),
        error=_relative_error(arc, rectangle.offset),
        distance=float(arc.errors.max(initial=0.0)) + arc.rounding,
        closed=arc.closed,
        smooth=arc.smooth,
        knots=rectangle.values(arc.knots),
        eigenvalues=values,
        criterion=criterion,
        closed_at=plane.closed_at,
    )


def _relative_error(arc: BoundaryArc, offset: Floats) -> float:
    """Return the largest distance from the boundary, relative to the coordinate it changes less."""
    size = relative_to(arc.points, arc.normals, offset)
    errors = np.maximum(np.append(arc.errors, 0.0), np.insert(arc.errors, 0, 0.0)) + arc.rounding
    return float((errors / size).max())


def _identify(closed_at: ClosedAt, value: Floats, eigenvalue: complex) -> tuple[str, float, float]:
    """Return the name of an eigenvalue's closed system, its turn in a frame, and the frame in s."""
    closed = closed_at(value.tolist())
    mode, frame_s = mode_near(closed, eigenvalue), closed[0].frame_s
    return mode.shape, 2 * np.pi * mode.frequency_hz * frame_s, frame_s


def side_of_curves(region: Region, points: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Say of points (k, 2) of the unit square whether they are stable, and which are too near a curve to say.

    From the point straight down, then along the lower edge to its left corner: each crossing of a curve
    changes sides. Curves are replaced by their chords, which is right farther from them than their sagitta.
    """
    rectangle = region.rectangle
    stable = np.full(len(points), region.corner)
    near = np.zeros(len(points), dtype=bool)
    for curve in region.curves:
        knots = rectangle.points(curve.points)
        a, b = knots[:-1], knots[1:]
        middle = between(knots, rectangle.points(curve.handles), 0.5)
        sagitta = 1.5 * np.linalg.norm(middle - (a + b) / 2, axis=1)
        reach = sagitta + curve.distance
        ends = [knots[0], knots[-1]] if not curve.closed else []
        for start in range(0, len(points), CHUNK):
            some = slice(start, start + CHUNK)
            # A chord that ends at the right-hand edge is crossed by what comes from below there, too.
            x = np.minimum(points[some, 0, None], np.nextafter(1.0, 0.0))
            y = points[some, 1, None]
            chord = b - a
            over = (a[:, 0] <= x) != (b[:, 0] <= x)
            height = a[:, 1] + (x - a[:, 0]) * chord[:, 1] / np.where(chord[:, 0] == 0, 1.0, chord[:, 0])
            crossings = (over & (height < y)).sum(axis=1)
            crossings += sum(((end[1] == 0.0) & (end[0] < x[:, 0])).astype(int) for end in ends)
            stable[some] ^= crossings % 2 == 1
            size = np.maximum(np.square(chord).sum(axis=1), np.finfo(np.float64).tiny)
            along = np.clip(((x - a[:, 0]) * chord[:, 0] + (y - a[:, 1]) * chord[:, 1]) / size, 0, 1)
            apart = np.hypot(x - a[:, 0] - along * chord[:, 0], y - a[:, 1] - along * chord[:, 1])
            near[some] |= (apart <= reach).any(axis=1)
    return stable, near


def _decide(region: Region, values: Floats) -> NDArray[np.bool_]:
    """Say of parameter values (k, 2) whether they are stable, each by an analysis of its own."""
    prepared = prepare(region.system)
    decided = []
    for value in values.tolist():
        overrides = overrides_at(region.system, (region.x.free, region.y.free), value)
        verdict = judge_at(region.system, prepared, overrides, PLACE, criterion=region.criterion)
        decided.append(bool(verdict.stable))
    return np.array(decided, dtype=bool)
