"""The stable region of two parameters: exact boundary curves, areas, and tests of points.

Takes: a `NumericModel`, two parameters and their ranges.
Gives: `Curve`, `Region`, `region`, `side_of_curves`.
Guarantees: every curve comes with a bound on its distance from the boundary, the critical mode and its
frequency. Empty regions and regions without boundary are supported. The resolution of the search is part of
the result: a component smaller than a cell can be missed if it has no effect on the values around it.
Does not: plot, or write files (see `output`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import near_start
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.lifting.devices import replaced_hands
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.parameter_values.overrides import apply
from apc.parameter_values.parameter_names import ParameterRef, Range, notes_for_all_groups
from apc.regions.adaptive_grid import blurred, just_inside, survey
from apc.regions.axes import LOCATION
from apc.regions.boundary import BoundaryArc, relative_to, stable_area, survey_and_trace, trace_steps
from apc.regions.curves import between
from apc.regions.delay_strips import BRANCHES, TracedRegion, trace_delay_strips
from apc.regions.dominant_pairs import Eigenvalues, log_magnitudes
from apc.regions.rectangle import INSIDE, DirectFamily, Rectangle, family_over, rectangle_of
from apc.result import PlotStyle, Result
from apc.spectrum.interconnection import ClosedLoop
from apc.spectrum.spectrum import mode_near
from apc.studies.crossing import Progress
from apc.studies.dominant_eigenvalue import DrivingPart
from apc.studies.evaluator import (
    JoinedEvaluator,
    PiecewiseEvaluator,
    closed_at,
    evaluator_of_many,
    overrides_at,
    parameters_suffice,
)
from apc.studies.evaluator_choice import EvaluatorKind, evaluator_for, kind_for_parameter, radius_evaluator
from apc.studies.frame_matrices import BatchEvaluator
from apc.studies.stability_criteria import (
    MEAN_SQUARE,
    NOMINAL,
    PASSIVE,
    SCALAR_CRITERIA,
    RadiusEvaluator,
    criterion_of,
    refuse_timing_parameter,
    verdict_with,
)
from apc.studies.timing_values import is_scaled, reaches_period

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]

# Coarse cells along each side of the rectangle.
CELLS = 12

# Distance of a smooth curve from the boundary, relative to a coordinate (see `boundary.trace`). Curves of a
# larger distance are listed in `Region.coarse`.
TOLERANCE = 1e-9

# The same for a scalar criterion, whose slopes are differences: each value takes milliseconds.
TOLERANCE_OF_DIFFERENCES = 1e-6

# The number of bisections of the segments of a boundary without steps that is located by verdicts.
HALVINGS = 3

# The distance in radians of an eigenvalue's angle from 0 or π below which its phase is computed again.
FOLD = 0.1

# Points compared with all curves in one batch.
CHUNK = 1024


# The closed-loop systems at a point; none for a scalar criterion.
ClosedAt = Callable[[Sequence[float]], tuple[ClosedLoop, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A piece of the boundary with one critical mode; the stable side is on the left of the points' order.

    `points` (k, 2) and `handles` (k − 1, 2, 2) are in SI: two consecutive points are joined by the cubic
    Bézier curve with these two control points, a straight line unless `smooth` (coincident events, two times,
    passive hands). `error` bounds the curve's distance from the true boundary, relative to the coordinate in
    which the difference is smaller, `distance` the distance in units of the ranges. `knots` (m, 2) are the
    points solved for, in SI, and `eigenvalues` (m,) the critical eigenvalues there.
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
        """The name of the closed system with the critical mode, or the name of the criterion."""
        if self.closed_at is None:
            return self.criterion
        middle = len(self.knots) // 2
        return _identify(self.closed_at, self.knots[middle], complex(self.eigenvalues[middle]))[0]

    @property
    def frequency_hz(self) -> tuple[float, float]:
        """The smallest and the largest frequency in Hz of the critical mode along the curve, NaN if
        unknown.
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
            _, phase_advance, frame = _identify(
                self.closed_at, self.knots[index], complex(self.eigenvalues[index])
            )
            if np.isnan(phase_advance):
                return np.nan, np.nan
            # The phase advance is 2πm ± angle, with constant m and sign along the curve.
            candidates = [
                2 * np.pi * round((phase_advance - sign * float(angles[index])) / (2 * np.pi)) + sign * angles
                for sign in (1, -1)
            ]
            advance = min(candidates, key=lambda candidate: abs(float(candidate[index]) - phase_advance))
            used = advance if len(indices) == 1 else advance[[index]]
            values += (np.abs(used) / (2 * np.pi * frame)).tolist()
        return min(values), max(values)


@dataclass(frozen=True, slots=True, eq=False)
class Region(Result):
    """The stable region of a rectangle of two parameters.

    `stable_area` is in the product of the axes' units. `cell` are the sides of the coarse cells in SI,
    `finest` the relative size of the finest. `corner` states whether the corner of both lower ends is stable,
    `stepped` whether the boundary is accurate to a cell only (time parameters), `tolerance` is that of smooth
    curves (see `coarse`), `linearized` states whether the model is nonlinear; `criterion` is the stability
    criterion; `limitations` are the limitations of the result.
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
    model: Model

    @property
    def coarse(self) -> tuple[Curve, ...]:
        """The smooth curves with an error above the tolerance."""
        return tuple(curve for curve in self.curves if curve.smooth and not curve.error <= self.tolerance)

    @property
    def rectangle(self) -> Rectangle:
        """The rectangle of the two ranges."""
        return rectangle_of(self.x, self.y)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the points of all curves as a table (needs pandas)."""
        table: pandas.DataFrame = self._shown("table")
        return table

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Plot the region into a matplotlib Axes, or a new figure, in the style `look`; return the Axes."""
        return self._plotted(ax, style=style)

    def contains(self, x: Any, y: Any) -> Any:
        """Return whether points are stable: by the curves or, within their error, by analyses.

        Parameters
        ----------
        x, y
            Values of the two parameters in SI, numbers or arrays that broadcast.

        Returns
        -------
        A bool, or an array of bool.

        Raises
        ------
        ApcError
            E904 a point outside the rectangle.
        """
        x_values, y_values = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        values = np.stack([x_values.ravel(), y_values.ravel()], axis=1)
        points = self.rectangle.points(values)
        if not np.all((points >= 0) & (points <= 1)):
            ranges = " and ".join(
                f"{axis.free.label} in {float(axis.low):g} to {float(axis.high):g} {axis.unit}"
                for axis in (self.x, self.y)
            )
            raise ApcError(Diagnostic("E904", LOCATION, "point", ranges, "one outside"))
        stable, near_boundary = side_of_curves(self, points)
        if near_boundary.any():
            stable[near_boundary] = _stable_by_analysis(self, values[near_boundary])
        return bool(stable[0]) if x_values.ndim == 0 else stable.reshape(x_values.shape)


@part("region")
def region(
    numeric: NumericModel,
    axes: tuple[Range, Range],
    *,
    cells: int = CELLS,
    tolerance: float | None = None,
    criterion: str | None = None,
    progress: Progress | None = None,
) -> Region:
    """Return the stable region of two parameters, with its boundary curves and area.

    Parameters
    ----------
    numeric
        The model with its parameter values; all other parameters keep them.
    axes
        The two parameters, from `parse_axes`.
    cells
        The initial number of cells along each side of the rectangle.
    tolerance
        Largest distance between curves and boundary, relative to a coordinate; curves of a larger distance
        are `Region.coarse`. None: `TOLERANCE`, for a scalar criterion `TOLERANCE_OF_DIFFERENCES`.
    criterion
        "mean-square", "nominal" or "passive", see `critical_values.critical`.
    progress
        Called with a text on the progress.

    Raises
    ------
    ApcError
        E896 a parameter of an unreliable link; E905 the model cannot be analyzed everywhere in the rectangle,
        or rounding prevents locating the boundary; and the errors of `analysis.lifted_classes`.

    Notes
    -----
    If one axis is a delay, the rectangle is divided into strips where events coincide (see `delay_strips`).
    Along a period the strips end halfway between analyzed periods (see `clock_periods`), unless all times
    scale with the period. If both axes are times, each point is analyzed separately, and the boundary is a
    line from cell edge to cell edge with the error of a cell. A model whose linearization point depends on an
    axis is analyzed point by point if its neutral modes change. With passive hands points on the boundary are
    joined by straight segments, with errors estimated at their middles.
    """
    model = numeric.model
    parameter_refs = tuple(axis.free for axis in axes)
    chosen_criterion = criterion_of(model, criterion, LOCATION, parameter_refs)
    tolerance = tolerance or (TOLERANCE_OF_DIFFERENCES if chosen_criterion in SCALAR_CRITERIA else TOLERANCE)
    for parameter_ref in parameter_refs:
        if chosen_criterion == NOMINAL:
            refuse_channel_number(model, parameter_ref, LOCATION, instead=f"--criterion {MEAN_SQUARE}")
        else:
            refuse_timing_parameter(model, parameter_ref, LOCATION, chosen_criterion)
    rectangle = rectangle_of(*axes)
    with evaluating(model):
        kinds = [kind_for_parameter(model, parameter_ref) for parameter_ref in parameter_refs]
        timed = [index for index, kind in enumerate(kinds) if kind is not EvaluatorKind.MATRICES]
        counts = [axes[index] for index in timed if kinds[index] is EvaluatorKind.COUNTS]
        if counts:
            _check_count(
                counts[0], len(counts) == 2, len(timed) > len(counts), chosen_criterion, affine=numeric.affine
            )
        timed = [] if chosen_criterion in SCALAR_CRITERIA else timed
        # If every time scales with a period, frames differ in their length only.
        scales = [kinds[index] for index in timed] == [EvaluatorKind.PERIODS] and is_scaled(
            model, parameter_refs[timed[0]], delays=True
        )
        times = [] if scales else timed
        _refuse_two_times(model, [parameter_refs[index] for index in times])
        linearized = evaluator_for(numeric, parameter_refs, chosen_criterion).linearized
        if len(linearized) > 1 and _number_of_sides_changes(numeric, parameter_refs, rectangle):
            linearized = ()
        start = linearized[0] if len(linearized) == 1 else None
        traced_region: TracedRegion | None = None
        if timed or not linearized:
            plane = _points_plane(numeric, parameter_refs, rectangle, chosen_criterion, stepped=bool(times))
            if chosen_criterion == NOMINAL and not times:
                tolerance = max(tolerance, TOLERANCE_OF_DIFFERENCES)
            if start is not None and len(times) == 1:
                traced_region = trace_delay_strips(
                    start, axes, times[0], cells=cells, tolerance=tolerance, progress=progress
                )
        else:
            source = JoinedEvaluator(
                model,
                parameter_refs,
                tuple(evaluator_of_many(start, parameter_refs, LOCATION) for start in linearized),
            )
            plane = _Plane(family_over(source, rectangle, source.errors), source.closed_at, stepped=False)
            try:
                traced_region = _trace_plane(plane, cells, tolerance, progress)
            except ApcError as error:
                # Rigid modes differ, or peers start at a kink, for other values.
                if error.mistakes[0].code not in ("E808", "E905") or parameters_suffice(numeric):
                    raise
                if start is None:
                    plane = _points_plane(numeric, parameter_refs, rectangle, chosen_criterion, stepped=False)
                else:
                    plane = _pieces_plane(numeric, source.sources[0], rectangle, start)
        stepped = plane.stepped and traced_region is None
        traced_region = traced_region or _trace_plane(plane, cells, tolerance, progress)
        curves = tuple(_curve(plane, arc, chosen_criterion) for arc in traced_region.arcs)
    area_unit = float(rectangle.width.prod())
    return Region(
        topology=model.name,
        x=axes[0],
        y=axes[1],
        curves=curves,
        stable_area=traced_region.area * area_unit,
        stable_area_error=traced_region.error_bound * area_unit,
        cell=(
            traced_region.cell[0] * float(rectangle.width[0]),
            traced_region.cell[1] * float(rectangle.width[1]),
        ),
        finest=traced_region.finest,
        corner=traced_region.corner,
        stepped=stepped,
        tolerance=tolerance,
        linearized=not numeric.affine,
        criterion=chosen_criterion,
        limitations=(
            *near_start(numeric),
            *limitations(model, network=chosen_criterion != MEAN_SQUARE, varied=parameter_refs),
            *(replaced_hands(model) if chosen_criterion == PASSIVE else ()),
            *notes_for_all_groups(model, parameter_refs),
        ),
        model=model,
    )


def _number_of_sides_changes(
    numeric: NumericModel, parameter_refs: tuple[ParameterRef, ...], rectangle: Rectangle
) -> bool:
    """Return whether the number of sides of the kinks at the start differs in the rectangle."""
    elsewhere = (
        numeric.at(apply(numeric.model, overrides_at(numeric.model, parameter_refs, value)))
        for value in rectangle.values(INSIDE).tolist()
    )
    return any(len(sides(changed)) != len(sides(numeric)) for changed in elsewhere)


def _refuse_two_times(model: Model, times: Sequence[ParameterRef]) -> None:
    """Raise ApcError E903 for a period together with another time, unless all clocks scale with the
    period.
    """
    if len(times) < 2:
        return
    for parameter_ref in times:
        if reaches_period(model, parameter_ref) and not is_scaled(model, parameter_ref):
            message = f"{parameter_ref.label} is a period and the other axis a time; the frames are too long"
            raise ApcError(Diagnostic("E903", LOCATION, message, fix=f"apc critical {parameter_ref.label}"))


def _check_count(axis: Range, both: bool, timed: bool, meant: str, *, affine: bool) -> None:
    """Raise ApcError E903 for a number of peers on an axis if the region cannot be computed in steps.

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
        "a time on the other axis": timed,
        f"a region of stability {SCALAR_CRITERIA.get(meant, '')}": meant in SCALAR_CRITERIA,
        "a nonlinear topology": not affine,
    }
    why = next((text for text, applies in reasons.items() if applies), "")
    if why:
        message = f"{axis.free.label} is a number of peers, which is not supported with {why}"
        raise ApcError(Diagnostic("E903", LOCATION, message, fix=f"apc critical {axis.free.label}"))


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """The matrices over the unit square, with a closed system at each point.

    `stepped` states that only verdicts at single points are known.
    """

    family: DirectFamily
    closed_at: ClosedAt | None
    stepped: bool
    halvings: int = 0


def _points_plane(
    numeric: NumericModel,
    parameter_refs: tuple[ParameterRef, ...],
    rectangle: Rectangle,
    criterion: str,
    *,
    stepped: bool,
) -> _Plane:
    """Return the plane of a model evaluated point by point; `stepped`: a time or a number of peers varies."""
    source = radius_evaluator(numeric, parameter_refs, LOCATION, criterion)
    # Bounds are expensive: one point represents the rectangle.
    (errors,) = source.errors(rectangle.values(np.array([[0.5, 0.5]])))
    family = DirectFamily(source, rectangle, (DrivingPart(0, np.arange(1)),), (errors[0],))
    closed = partial(closed_at, numeric, parameter_refs) if criterion == NOMINAL else None
    # The energy from hands is measured by the required damping, which is discontinuous.
    halvings = HALVINGS if criterion == PASSIVE else 0
    return _Plane(family, closed, stepped or criterion == PASSIVE, halvings)


def _pieces_plane(
    numeric: NumericModel,
    source: BatchEvaluator,
    rectangle: Rectangle,
    start: NumericModel,
) -> _Plane:
    """Return the plane of a model whose neutral modes change within the rectangle."""
    size = sum(len(closed.matrix) for closed in source.closed)
    pieces = PiecewiseEvaluator(start, source.free, size)
    (errors,) = pieces.errors(rectangle.values(np.array([[0.5, 0.5]])))
    family = DirectFamily(pieces, rectangle, (DrivingPart(0, np.arange(size)),), (errors[0],))
    return _Plane(family, partial(closed_at, numeric, source.free), stepped=False)


def _trace_plane(plane: _Plane, cells: int, tolerance: float, progress: Progress | None) -> TracedRegion:
    """Return the boundary through the whole rectangle, as smooth curves or by steps from cell to cell."""
    eigenvalues = Eigenvalues(plane.family)
    evaluations = 0

    def samples(points: Floats) -> Floats:
        """Return the logarithms of the largest magnitudes at points, and report the progress."""
        nonlocal evaluations
        evaluations += len(points)
        if progress:
            progress(f"{counted(evaluations, 'point')} evaluated")
        return _log_magnitudes_at(plane, points)

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
        arcs, result, area, error_bound = survey_and_trace(
            eigenvalues, samples, cells=cells, tolerance=tolerance, offset=offset
        )
    if error_bound >= 1:  # of the unit square: the boundary may be anywhere in it
        raise blurred()
    return TracedRegion(
        arcs, area, error_bound, result.corners[0], (result.cell, result.cell), result.finest / result.cell
    )


def _log_magnitudes_at(plane: _Plane, points: Floats) -> Floats:
    """Return the logarithms of the largest magnitudes at points (k, 2).

    A point without matrices raises its error.
    """
    source, rectangle = plane.family.evaluator, plane.family.rectangle
    matrices = plane.family.matrices(points)
    for matrix in matrices:
        invalid = np.flatnonzero(~np.isfinite(matrix).all(axis=(1, 2)))
        if len(invalid):
            value = rectangle.values(points[invalid[:1]])[0].tolist()
            overrides = overrides_at(source.model, source.free, value)
            apply(source.model, overrides)  # raises its own error for an invalid value
            if plane.closed_at is not None:
                plane.closed_at(value)
            message = "floating-point overflow in a part of the rectangle"
            raise ApcError(Diagnostic("E905", LOCATION, message, advice="use a smaller range"))
    return log_magnitudes(matrices, BRANCHES)


def _dominant(plane: _Plane, point: Floats) -> complex:
    """Return the dominant eigenvalue, or the criterion value, at a point (2,) of a pointwise evaluator."""
    source, rectangle = plane.family.evaluator, plane.family.rectangle
    assert isinstance(source, RadiusEvaluator), "one number is known"
    return source.dominant(rectangle.values(point).tolist())


def _curve(plane: _Plane, arc: BoundaryArc, criterion: str) -> Curve:
    """Return an arc of the unit square as a curve in SI."""
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
    """Return the largest distance of an arc from the boundary, relative to the coordinate that it
    changes less.
    """
    size = relative_to(arc.points, arc.normals, offset)
    errors = np.maximum(np.append(arc.errors, 0.0), np.insert(arc.errors, 0, 0.0)) + arc.rounding
    return float((errors / size).max())


def _identify(closed_at: ClosedAt, value: Floats, eigenvalue: complex) -> tuple[str, float, float]:
    """Return the name of an eigenvalue's closed system, its phase advance per frame, and the frame in s."""
    closed = closed_at(value.tolist())
    mode, frame_s = mode_near(closed, eigenvalue), closed[0].frame_s
    return mode.family, 2 * np.pi * mode.frequency_hz * frame_s, frame_s


def side_of_curves(region: Region, points: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the mask of stable points (k, 2) of the unit square, and the mask of points near a curve.

    Each crossing of a curve changes sides, on the way straight down from the point and along the lower edge
    to its left corner. Curves are replaced by their chords, exact beyond their sagitta.
    """
    rectangle = region.rectangle
    stable = np.full(len(points), region.corner)
    near_curve = np.zeros(len(points), dtype=bool)
    for curve in region.curves:
        knots = rectangle.points(curve.points)
        a, b = knots[:-1], knots[1:]
        middle = between(knots, rectangle.points(curve.handles), 0.5)
        sagitta = 1.5 * np.linalg.norm(middle - (a + b) / 2, axis=1)
        margin = sagitta + curve.distance
        ends = [knots[0], knots[-1]] if not curve.closed else []
        for start in range(0, len(points), CHUNK):
            batch = slice(start, start + CHUNK)
            # A chord that ends at the right-hand edge also counts for points above it on this edge.
            x = np.minimum(points[batch, 0, None], np.nextafter(1.0, 0.0))
            y = points[batch, 1, None]
            chord = b - a
            spans = (a[:, 0] <= x) != (b[:, 0] <= x)
            height = a[:, 1] + (x - a[:, 0]) * chord[:, 1] / np.where(chord[:, 0] == 0, 1.0, chord[:, 0])
            crossings = (spans & (height < y)).sum(axis=1)
            crossings += sum(((end[1] == 0.0) & (end[0] < x[:, 0])).astype(int) for end in ends)
            stable[batch] ^= crossings % 2 == 1
            size = np.maximum(np.square(chord).sum(axis=1), np.finfo(np.float64).tiny)
            along = np.clip(((x - a[:, 0]) * chord[:, 0] + (y - a[:, 1]) * chord[:, 1]) / size, 0, 1)
            separation = np.hypot(x - a[:, 0] - along * chord[:, 0], y - a[:, 1] - along * chord[:, 1])
            near_curve[batch] |= (separation <= margin).any(axis=1)
    return stable, near_curve


def _stable_by_analysis(region: Region, values: Floats) -> NDArray[np.bool_]:
    """Return whether parameter values (k, 2) are stable, by one analysis each."""
    numeric = numeric_model(region.model)
    decided = []
    for value in values.tolist():
        overrides = overrides_at(region.model, (region.x.free, region.y.free), value)
        verdict = verdict_with(numeric, overrides, LOCATION, criterion=region.criterion)
        decided.append(bool(verdict.stable))
    return np.array(decided, dtype=bool)
