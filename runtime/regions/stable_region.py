"""The stable region of two parameters: exact boundary curves, areas, and tests of points.

Takes: a `Model`, two parameters and their ranges.
Gives: `Curve`, `Region`, `region`, `side_of_curves`.
Guarantees: every curve comes with a bound on its distance from the boundary, the critical mode and its
frequency. Empty regions and regions without boundary are supported. The resolution of the search is part of
the result: a component smaller than a cell can be missed if values around it give no indication.
Does not: plot, or write files (see `output`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import near_start, prepare_at_start
from apc.analysis.one_sided_slopes import Side, sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.eigen.interconnection import ClosedLoop
from apc.eigen.spectrum import mode_near
from apc.frame.devices import replaced_hands
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.overrides import apply
from apc.frame.parameter_names import ParameterRef, Range, notes_for_all_groups
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.parameter_studies.crossing import Progress
from apc.parameter_studies.dominant_eigenvalue import DrivingPart
from apc.parameter_studies.evaluator import (
    JoinedEvaluator,
    PiecewiseEvaluator,
    closed_at,
    evaluator_of_many,
    overrides_at,
    parameters_suffice,
    reaches_count,
    reaches_time,
)
from apc.parameter_studies.frame_matrices import BatchEvaluator
from apc.parameter_studies.stability_criteria import (
    MEAN_SQUARE,
    NOMINAL,
    PASSIVE,
    SCALAR_CRITERIA,
    RadiusEvaluator,
    criterion_of,
    refuse_time,
    verdict_with,
)
from apc.parameter_studies.timing_values import is_scaled, reaches_period
from apc.regions.adaptive_grid import blurred, just_inside, survey
from apc.regions.axes import LOCATION
from apc.regions.boundary import BoundaryArc, relative_to, stable_area, trace_steps, traced
from apc.regions.curves import between
from apc.regions.delay_strips import BRANCHES, TracedRegion, trace_delay_strips
from apc.regions.dominant_pairs import Eigenvalues, log_magnitudes
from apc.regions.rectangle import INSIDE, DirectFamily, Rectangle, family_over, rectangle_of
from apc.result import PlotStyle, Result
from apc.threads import single_threaded

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

# The number of bisections of the segments of a boundary from verdicts, without steps.
HALVINGS = 3

# The distance in radians of an eigenvalue's angle from 0 or π below which its phase is computed anew.
FOLD = 0.1

# Points compared with all curves in one batch.
CHUNK = 1024


# The closed-loop systems at a point; none for a scalar criterion.
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
        """The smallest and the largest frequency of the critical mode along the curve.

        Both are NaN if unknown.
        """
        if self.closed_at is None:
            return np.nan, np.nan
        angles = np.abs(np.angle(self.eigenvalues))
        middle = len(self.knots) // 2
        indices = {middle} if self.smooth else set(range(len(self.knots)))
        if np.any(angles < FOLD) or np.any(angles > np.pi - FOLD):  # the phase may fold between knots
            indices |= {0, len(self.knots) - 1}
        values: list[float] = []
        for index in sorted(indices):
            _, turn, frame = _identify(self.closed_at, self.knots[index], complex(self.eigenvalues[index]))
            if np.isnan(turn):
                return np.nan, np.nan
            # turn = 2πm ± angle, and so is it along the curve.
            candidates = [
                2 * np.pi * round((turn - sign * float(angles[index])) / (2 * np.pi)) + sign * angles
                for sign in (1, -1)
            ]
            local = min(candidates, key=lambda candidate: abs(float(candidate[index]) - turn))
            listed = local if len(indices) == 1 else local[[index]]
            values += (np.abs(listed) / (2 * np.pi * frame)).tolist()
        return min(values), max(values)


@dataclass(frozen=True, slots=True, eq=False)
class Region(Result):
    """The stable region of a rectangle of two parameters.

    `stable_area` is in the product of the axes' units. `cell` are the sides of the coarse cells in SI,
    `finest` the relative size of the finest. `corner` is whether the corner of both lower ends is stable,
    `stepped` whether the boundary is accurate to a cell only (time parameters), `tolerance` that of smooth
    curves (see `coarse`), `linearized` whether the model is nonlinear; `criterion` is the stability
    criterion; `limitations` lists the limitations of the analysis.
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
    limitations: tuple[str, ...]
    system: Model

    @property
    def coarse(self) -> tuple[Curve, ...]:
        """The smooth curves with an error above the tolerance."""
        return tuple(curve for curve in self.curves if curve.smooth and not curve.error <= self.tolerance)

    @property
    def rectangle(self) -> Rectangle:
        """The ranges."""
        return rectangle_of(self.x, self.y)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the points of all curves as a table (needs pandas)."""
        table: pandas.DataFrame = self._shown("table")
        return table

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Plot the region into a matplotlib Axes, or a new figure, in the style `look`; return the Axes."""
        return self._plotted(ax, style=style)

    def contains(self, x: Any, y: Any) -> Any:
        """Return whether points are stable: by the curves or, nearer than their error, by eigenvalues.

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
            raise ApcError(Diagnostic("E904", LOCATION, "a point", ranges, "one outside"))
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
    """Compute the boundary of the stable region of two parameters.

    Parameters
    ----------
    system
        The model; all other parameters keep its values.
    axes
        The two parameters, from `parse_axes`.
    cells
        The initial number of cells along each side of the rectangle.
    tolerance
        Largest distance between curves and boundary, relative to a coordinate; curves that could not be
        followed so closely are `Region.coarse`. None: `TOLERANCE`, in mean square `TOLERANCE_OF_DIFFERENCES`.
    criterion
        "mean-square" or "nominal", see `critical_values.critical`.
    prepared
        From `numeric_model.prepare`, of this model with any parameter values.
    progress
        Called with a text on the progress.

    Raises
    ------
    ApcError
        E896 a parameter of an unreliable link; E905 the model cannot be analyzed everywhere in the rectangle,
        or rounding prevents locating the boundary; and those of `analysis.lifted_groups`.

    Notes
    -----
    Where one axis is a delay, the rectangle is cut where events coincide (see `delay_strips`). Along a period
    it is cut halfway between the analyzed periods (see `clock_periods`), unless all times scale with it.
    If both axes are times, each point is analyzed separately, and the boundary is a line from cell edge to
    cell edge with the error of a cell. A model whose start, and so its linearization, depends on an axis is
    analyzed point by point if its neutral modes change. With passive hands there are no steps: points are on
    the boundary, with straight segments between, and the error is estimated at their middles.
    """
    free = tuple(axis.free for axis in axes)
    meant = criterion_of(system, criterion, LOCATION, free)
    tolerance = tolerance or (TOLERANCE_OF_DIFFERENCES if meant in SCALAR_CRITERIA else TOLERANCE)
    for item in free:
        if meant == NOMINAL:
            refuse_channel_number(system, item, LOCATION, instead=f"--criterion {MEAN_SQUARE}")
        else:
            refuse_time(system, item, LOCATION, meant)
    rectangle = rectangle_of(*axes)
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        prepared = prepared or prepare(system)
        affine = all(prepared.jacobians[group.peer_type].affine for group in system.groups)
        times = [index for index, item in enumerate(free) if reaches_time(system, item)]
        counts = [index for index, item in enumerate(free) if reaches_count(system, item)]
        if counts:
            _check_count(axes[counts[0]], len(counts) == 2, bool(times), meant, affine=affine)
        times = [] if meant in SCALAR_CRITERIA else times + counts
        # Where every time scales with a period the frame is the same at all values, but for its length.
        scales = len(times) == 1 and not counts and _scales(system, free[times[0]])
        times = [] if scales else times
        _refuse_two_times(system, [free[index] for index in times])
        starts = () if meant in SCALAR_CRITERIA else _starts(system, prepared, free, rectangle)
        start = starts[0].prepared if len(starts) == 1 else None
        striped: TracedRegion | None = None
        if not starts or times or scales:
            plane = _points_plane(system, free, rectangle, prepared, meant, stepped=bool(times))
            if meant == NOMINAL and not times:
                tolerance = max(tolerance, TOLERANCE_OF_DIFFERENCES)
            if start is not None and len(times) == 1:
                striped = trace_delay_strips(
                    system, axes, times[0], start, cells=cells, tolerance=tolerance, progress=progress
                )
        else:
            source = JoinedEvaluator(
                system,
                free,
                tuple(
                    evaluator_of_many(side.system, free, LOCATION, prepared=side.prepared) for side in starts
                ),
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
        stable_area_error=striped.error_bound * whole,
        cell=(striped.cell[0] * float(rectangle.width[0]), striped.cell[1] * float(rectangle.width[1])),
        finest=striped.finest,
        corner=striped.corner,
        stepped=stepped,
        tolerance=tolerance,
        linearized=not affine,
        criterion=meant,
        limitations=(
            *near_start(system, prepared),
            *limitations(system, network=meant != MEAN_SQUARE, varied=free),
            *(replaced_hands(system) if meant == PASSIVE else ()),
            *notes_for_all_groups(system, free),
        ),
        system=system,
    )


def _starts(
    system: Model, prepared: Prepared, free: tuple[ParameterRef, ...], rectangle: Rectangle
) -> tuple[Side, ...]:
    """Return the models at the start, one for each side of a kink, with their Jacobians linearized there.

    Empty where the start does not decide, or where the number of sides changes over the rectangle.
    """
    kink_sides = sides(system, prepared)
    if len(kink_sides) > 1:
        for value in rectangle.values(INSIDE).tolist():
            elsewhere = apply(system, overrides_at(system, free, value))
            if len(sides(elsewhere, prepared)) != len(kink_sides):
                return ()
    starts = [prepare_at_start(side.system, side.prepared, free) for side in kink_sides]
    return tuple(
        replace(side, prepared=start)
        for side, start in zip(kink_sides, starts, strict=True)
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
            message = f"{free.label} is a period, and the other axis a time: their frames are too long"
            raise ApcError(Diagnostic("E903", LOCATION, message, hint=f"apc critical {free.label}"))


def _check_count(axis: Range, both: bool, timed: bool, meant: str, *, affine: bool) -> None:
    """Raise ApcError E903 for a number of peers on an axis where the region cannot be drawn in steps.

    Parameters
    ----------
    axis
        The axis of the number of peers.
    both, timed
        Whether the other axis is a number of peers, or a time.
    meant
        The stability criterion.
    affine
        Whether the model is linear.
    """
    reasons = {
        "two numbers of peers": both,
        "a time beside it": timed,
        f"what is stable {SCALAR_CRITERIA.get(meant, '')}": meant in SCALAR_CRITERIA,
        "a topology that is not linear": not affine,
    }
    why = next((text for text, applies in reasons.items() if applies), "")
    if why:
        message = f"{axis.free.label} is a number of peers: no steps are drawn for {why}"
        raise ApcError(Diagnostic("E903", LOCATION, message, hint=f"apc critical {axis.free.label}"))


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
    """Return the evaluator of a scalar criterion; `stepped`: a time or a number of peers varies."""
    source = RadiusEvaluator(system, free, prepared, LOCATION, meant)
    # One point's bounds are enough, and dear.
    (errors,) = source.errors(rectangle.values(np.array([[0.5, 0.5]])))
    family = DirectFamily(source, rectangle, (DrivingPart(0, np.arange(1)),), (errors[0],))
    closed = partial(closed_at, system, free, prepared) if meant == NOMINAL else None
    # The energy from hands is measured by the required damping, which is discontinuous.
    halvings = HALVINGS if meant == PASSIVE else 0
    return _Plane(family, closed, stepped or meant == PASSIVE, halvings)


def _pieces_plane(
    system: Model,
    source: BatchEvaluator,
    rectangle: Rectangle,
    prepared: Prepared,
    start: Prepared,
) -> _Plane:
    """Return the frame matrices of a model whose neutral modes change within the rectangle."""
    size = sum(len(closed.matrix) for closed in source.closed)
    pieces = PiecewiseEvaluator(system, source.free, start, size)
    (errors,) = pieces.errors(rectangle.values(np.array([[0.5, 0.5]])))
    family = DirectFamily(pieces, rectangle, (DrivingPart(0, np.arange(size)),), (errors[0],))
    return _Plane(family, partial(closed_at, system, source.free, prepared), stepped=False)


def _surveyed(plane: _Plane, cells: int, tolerance: float, progress: Progress | None) -> TracedRegion:
    """Survey the whole rectangle and follow the boundary through it, or go by steps from cell to cell."""
    deciding = Eigenvalues(plane.family)
    evaluations = 0

    def samples(points: Floats) -> Floats:
        nonlocal evaluations
        evaluations += len(points)
        if progress:
            progress(f"looking at {counted(evaluations, 'point')}")
        return _samples(plane, points)

    if plane.stepped:
        result = survey(samples, cells=cells)
        arcs = trace_steps(
            lambda points: samples(points)[:, 0],
            lambda point: _dominant(plane, point),
            result,
            halvings=plane.halvings,
        )
        area, error_bound = stable_area(arcs, result)
    else:
        offset = plane.family.rectangle.offset
        arcs, result, area, error_bound = traced(
            deciding, samples, cells=cells, tolerance=tolerance, offset=offset
        )
    if error_bound >= 1:  # of the unit square: the boundary may be anywhere in it
        raise blurred()
    return TracedRegion(
        arcs, area, error_bound, result.corners[0], (result.cell, result.cell), result.finest / result.cell
    )


def _samples(plane: _Plane, points: Floats) -> Floats:
    """Return the logarithms of the largest magnitudes, or raise the error of a point."""
    source, rectangle = plane.family.evaluator, plane.family.rectangle
    matrices = plane.family.matrices(points)
    for matrix in matrices:
        wrong = np.flatnonzero(~np.isfinite(matrix).all(axis=(1, 2)))
        if len(wrong):
            value = rectangle.values(points[wrong[:1]])[0].tolist()
            overrides = overrides_at(source.system, source.free, value)
            apply(source.system, overrides)  # reports an unavailable value itself
            if plane.closed_at is not None:
                plane.closed_at(value)
            message = (
                "the topology's frame leaves the range of floating point numbers in part of the rectangle"
            )
            raise ApcError(Diagnostic("E905", LOCATION, message, hint="a smaller range"))
    return log_magnitudes(matrices, BRANCHES)


def _dominant(plane: _Plane, point: Floats) -> complex:
    """Return the eigenvalue that decides at a point (2,) where one number is known."""
    source, rectangle = plane.family.evaluator, plane.family.rectangle
    assert isinstance(source, RadiusEvaluator), "one number is known"
    return source.dominant(rectangle.values(point).tolist())


def _curve(plane: _Plane, arc: BoundaryArc, criterion: str) -> Curve:
    """Return an arc in SI."""
    rectangle, values = plane.family.rectangle, arc.values
    if arc.smooth and criterion == NOMINAL and isinstance(plane.family.evaluator, RadiusEvaluator):
        values = np.array([_dominant(plane, point) for point in just_inside(arc.knots)])
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
    return mode.family, 2 * np.pi * mode.frequency_hz * frame_s, frame_s


def side_of_curves(region: Region, points: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return whether points (k, 2) of the unit square are stable, and which are too close to a curve.

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
            separation = np.hypot(x - a[:, 0] - along * chord[:, 0], y - a[:, 1] - along * chord[:, 1])
            near[some] |= (separation <= reach).any(axis=1)
    return stable, near


def _decide(region: Region, values: Floats) -> NDArray[np.bool_]:
    """Return whether parameter values (k, 2) are stable, by one analysis each."""
    prepared = prepare(region.system)
    decided = []
    for value in values.tolist():
        overrides = overrides_at(region.system, (region.x.free, region.y.free), value)
        verdict = verdict_with(region.system, prepared, overrides, LOCATION, criterion=region.criterion)
        decided.append(bool(verdict.stable))
    return np.array(decided, dtype=bool)
