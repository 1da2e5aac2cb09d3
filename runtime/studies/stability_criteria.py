"""Scalar criteria along one parameter: a spectral radius, or a growth factor, compared with 1.

Takes: a `Model` and the name of a parameter, also of its links' losses.
Gives: `MEAN_SQUARE`, `NOMINAL`, `PASSIVE`, `SCALAR_CRITERIA`, `criterion_of`, `refuse_timing_parameter`;
`PointwisePath`, `line_points`, `BOUNDED`; `verdict_with`, `unbounded_verdict`, `allowed`, `scale_of`;
`RadiusEvaluator`.
Guarantees: a verdict follows from bounds on the growth of second moments, or on the energy that passive hands
can extract, expressed as a growth (see `absolute_stability.passivity_radius`); nominally, from the analysis
itself.
Does not: find two crossings between neighbouring samples; vary a delay, whose segments belong to the nominal
search (see `parameter_path`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze, determinant_radius
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.data_age import aged
from apc.lifting.numeric_model import NumericModel
from apc.network.nominal_criterion import channel_numbers, unreliable
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, parameter_of, unit_of, value_now
from apc.studies.crossing import SingleSegment, SmoothSegment, Verdict
from apc.studies.evaluator import dominant_in_floats, overrides_at, reaches_time
from apc.studies.parameter_path import OPEN, SPAN, pointwise, spread, verdict_of
from apc.verdict import NO_PROOF, ProofMethod, StabilityProof

Floats = NDArray[np.float64]

# The relative step of a difference with equal truncation and rounding errors; the least root of a growth.
DIFFERENCE, LEAST = 1e-5, 1e-9

MEAN_SQUARE, NOMINAL, PASSIVE = "mean-square", "nominal", "passive"

# The scalar criteria, and the text of the verdict for each.
SCALAR_CRITERIA = {MEAN_SQUARE: "in mean square", PASSIVE: "with passive hands"}

# The proof of a crossing, by criterion.
BOUNDED = {
    MEAN_SQUARE: StabilityProof(ProofMethod.BOUNDED_MOMENTS),
    PASSIVE: StabilityProof(ProofMethod.BOUNDED_HANDS),
}
ITERATED = StabilityProof(ProofMethod.ITERATED_MOMENTS)
TAGGED = StabilityProof(ProofMethod.ESTIMATED_MOMENTS)

# The number of samples between 0 and 1 of a probability.
SHARES = 33


def criterion_of(
    model: Model, requested: str | None, location: SourceLocation, varied: Sequence[ParameterRef] = ()
) -> str:
    """Return the criterion of a verdict: the named one, or by default mean square if a link is unreliable.

    Parameters
    ----------
    model
        The compiled model.
    requested
        "mean-square", "nominal", "passive", or None.
    location
        The location of the request.
    varied
        The parameters to vary.

    Raises
    ------
    ApcError
        E898 an unknown criterion.
    """
    if requested not in (None, MEAN_SQUARE, NOMINAL, PASSIVE):
        message = f"{str(requested)[:40]} is not a criterion (available: {MEAN_SQUARE}, {NOMINAL}, {PASSIVE})"
        raise ApcError(Diagnostic("E898", location, message, fix=f"--criterion {MEAN_SQUARE}"))
    by_chance = unreliable(model) or any(
        parameter_ref.name in channel_numbers(model) for parameter_ref in varied
    )
    return requested or (MEAN_SQUARE if by_chance else NOMINAL)


def refuse_timing_parameter(
    model: Model, parameter_ref: ParameterRef, location: SourceLocation, criterion: str = MEAN_SQUARE
) -> None:
    """Raise an error for a parameter that cannot be varied under a scalar criterion.

    These are periods, phases and delays, which change the order of events, and with passive hands the
    parameters of a lossy channel. Jitter can be varied under the other criteria.

    Parameters
    ----------
    model, parameter_ref
        The compiled model and the parameter to vary.
    location
        The location of the request.
    criterion
        One of `SCALAR_CRITERIA`.

    Raises
    ------
    ApcError
        E898 a timing parameter; E930 the same, or a channel parameter, with passive hands.
    """
    jitter = {channel.jitter for link in model.links for channel in link.channels}
    if reaches_time(model, parameter_ref) and parameter_ref.name not in jitter:
        message = (
            f"{parameter_ref.label} can't be varied {SCALAR_CRITERIA[criterion]}, "
            "as it changes the order of events"
        )
        if criterion == PASSIVE:
            advice = f'analyze single values: apc analyze --hands passive --set {parameter_ref.label}="…"'
            raise ApcError(Diagnostic("E930", location, message, advice=advice))
        raise ApcError(Diagnostic("E898", location, message, fix=f"--criterion {NOMINAL}"))
    if criterion == PASSIVE and parameter_ref.name in channel_numbers(model):
        message = f"{parameter_ref.label} has no effect with passive hands, where all delays are nominal"
        raise ApcError(
            Diagnostic("E930", location, message, advice=f"use --criterion {MEAN_SQUARE} without --hands")
        )


# The codes of points without a value: overflow of a frame, and values out of a parameter's bounds.
NOWHERE = ("E806", "E624")


def verdict_with(
    numeric: NumericModel,
    overrides: Sequence[Override],
    location: SourceLocation,
    *,
    bounded: bool = True,
    criterion: str = MEAN_SQUARE,
) -> Verdict:
    """Return the verdict with other parameter values, by the spectral radius or a scalar criterion.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    overrides
        The parameter values.
    location
        The location of the request.
    bounded
        Whether bounds are required, with proofs where floats are undecided.
    criterion
        "nominal", or one of `SCALAR_CRITERIA`.

    Raises
    ------
    ApcError
        E898 no verdict exists over the network with these values; the errors of
        `absolute_stability.absolute_stability` and of `analysis.analyze`.
    """
    changed = numeric.at(apply(numeric.model, overrides))
    if criterion == NOMINAL and bounded:
        return verdict_of(analyze(changed))
    if criterion == NOMINAL:
        return unbounded_verdict(abs(dominant_in_floats(changed)))
    # Imported when needed: most models need neither.
    if criterion == PASSIVE:
        from apc.haptics.absolute_stability import passivity_radius

        result = passivity_radius(changed, bounded=bounded)
    else:
        from apc.mean_square.mean_square_stability import mean_square_growth

        result = mean_square_growth(changed, bounded=bounded)
    if result.why:
        message = f"no mean-square verdict: {result.why}"
        fix, advice = f"--criterion {NOMINAL}", ""
        if any(override.free.name in channel_numbers(numeric.model) for override in overrides):
            is_judged = not aged(numeric.model) and not mean_square_growth(numeric, bounded=False).why
            fix, advice = ("", "narrow the range") if is_judged else ("apc simulate", "")
        raise ApcError(Diagnostic("E898", location, message, fix=fix, advice=advice))
    if not bounded:
        return unbounded_verdict(result.radius)
    proof = TAGGED if not result.exact else BOUNDED[criterion] if result.proved else ITERATED
    error = max(result.high - result.radius, result.radius - result.low)
    return Verdict(result.stable, result.radius, error, (), proof)


def unbounded_verdict(radius: float) -> Verdict:
    """Return the verdict of a radius in floats, without a bound; undecided if it is not finite."""
    return Verdict(radius < 1, radius, math.nan, (), NO_PROOF) if math.isfinite(radius) else OPEN


@dataclass(frozen=True, slots=True, eq=False)
class RadiusEvaluator:
    """Evaluates a criterion at each point, as a matrix (1, 1): a search treats the number as an eigenvalue.

    `free` are the parameters of a point, `location` is that of errors. By a growth criterion the value is the
    root of the growth per frame. Derivatives are differences over a small part of the directions, with a
    relative error of about 1e-9.
    """

    numeric: NumericModel
    free: tuple[ParameterRef, ...]
    location: SourceLocation
    criterion: str = MEAN_SQUARE

    @property
    def model(self) -> Model:
        """The compiled model."""
        return self.numeric.model

    def verdict(self, value: Sequence[float], *, bounded: bool = False) -> Verdict:
        """Return the verdict at a point (m,); undecided if the point has no value."""
        overrides = overrides_at(self.model, self.free, value)
        try:
            return verdict_with(
                self.numeric, overrides, self.location, bounded=bounded, criterion=self.criterion
            )
        except ApcError as error:
            if self.criterion != NOMINAL and error.mistakes[0].code not in NOWHERE:
                raise
            return OPEN

    def quick_verdict(self, value: Sequence[float]) -> Verdict:
        """Return the verdict at a point (m,), without bounds where they take longer.

        Its radius may be an estimate on the same side of 1.
        """
        if self.criterion != NOMINAL:
            return self.verdict(value)
        try:
            numeric = self.numeric.at(apply(self.model, overrides_at(self.model, self.free, value)))
            radius = determinant_radius(numeric)
        except ApcError:
            return OPEN
        if math.isfinite(radius):
            return unbounded_verdict(radius)
        return self.verdict(value, bounded=True)  # an analysis avoids matrices that are too large

    def dominant(self, value: Sequence[float]) -> complex:
        """Return the dominant eigenvalue at a point (m,), or the criterion's value."""
        if self.criterion != NOMINAL:
            return complex(self.matrices(np.array([value]))[0].item())
        return dominant_in_floats(
            self.numeric.at(apply(self.model, overrides_at(self.model, self.free, value)))
        )

    def parts(self, value: Sequence[float]) -> list[float]:
        """Return the criterion value of each modal port loop at a point (m,); the largest is the model's."""
        if self.criterion != PASSIVE:
            return self.matrices(np.array([value]))[0].ravel().tolist()
        from apc.haptics.absolute_stability import loop_growths

        overrides = overrides_at(self.model, self.free, value)
        try:
            growths = loop_growths(self.numeric.at(apply(self.model, overrides)), bounded=False)
        except ApcError as error:
            if error.mistakes[0].code not in NOWHERE:
                raise
            return [math.nan]
        return [math.sqrt(growth.radius) for growth in growths]

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the criterion value (k, 1, 1) at values (k, m), NaN if undefined."""
        radii = np.array([self.verdict(value).radius for value in values.tolist()])[:, None, None]
        return (radii if self.criterion == NOMINAL else np.sqrt(radii),)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the criterion value (k, 1, 1) and its derivatives along directions (k, m)."""
        step = DIFFERENCE * along
        # At a bound of the parameter, the slope of the parabola through two interior points.
        near_bound = ~(self._allowed(values - step) & self._allowed(values + step))[:, None]
        direction = np.where(self._allowed(values + 2 * step), 1.0, -1.0)[:, None]
        first_points = values + np.where(near_bound, direction, -1.0) * step
        second_points = values + np.where(near_bound, 2 * direction, 1.0) * step
        (present,), (first,), (second,) = (
            self.matrices(points) for points in (values, first_points, second_points)
        )
        one_sided = (4 * first - 3 * present - second) * direction[:, None] / (2 * DIFFERENCE)
        return ((present, np.where(near_bound[:, None], one_sided, (second - first) / (2 * DIFFERENCE))),)

    def _allowed(self, values: Floats) -> NDArray[np.bool_]:
        """Return the mask of the values (k, m) that are within the bounds of each parameter."""
        result = np.ones(len(values), dtype=bool)
        for column, parameter_ref in zip(values.T, self.free, strict=True):
            lowest, highest = allowed(self.model, parameter_ref)
            result &= (column >= lowest) & (column <= highest)
        return result

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, 1, 1) on the errors of the criterion value at values (k, m)."""
        verdicts = [self.verdict(value, bounded=True) for value in values.tolist()]
        # The error of a root is half the error of its square, divided by the root: at most this.
        roots = [1.0 if self.criterion == NOMINAL else math.sqrt(verdict.radius) for verdict in verdicts]
        errors = [verdict.error / max(root, LEAST) for verdict, root in zip(verdicts, roots, strict=True)]
        return (np.array(errors)[:, None, None],)


def allowed(model: Model, parameter_ref: ParameterRef) -> tuple[float, float]:
    """Return the lowest and highest allowed value of a parameter or timing, infinite without a bound."""
    if any(timing.name == parameter_ref.name for timing in model.timings):
        return 0.0, math.inf
    parameter = parameter_of(model, parameter_ref)
    return (
        -math.inf if parameter.minimum is None else parameter.minimum,
        math.inf if parameter.maximum is None else parameter.maximum,
    )


@dataclass(frozen=True, eq=False)
class PointwisePath(SingleSegment):
    """A path along the one parameter of a `RadiusEvaluator`, each value evaluated once.

    `points` (k,) are the first samples; cell widths are relative to the value, or to `least` for smaller
    values. `cached` are the verdicts by value.
    """

    source: RadiusEvaluator
    points: Floats
    least: float
    cached: dict[float, Verdict] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The name of the parameter that varies."""
        return self.source.free[0].label

    def _quick_verdict(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, without error bounds if they take longer."""
        if float(value) not in self.cached:
            self.cached[float(value)] = self.source.quick_verdict([float(value)])
        return self.cached[float(value)]

    def verdict_at(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, with error bounds."""
        known = self.cached.get(float(value), OPEN)
        if self.source.criterion == NOMINAL and math.isfinite(known.error):
            return known  # an analysis
        return self.source.verdict([float(value)], bounded=True)

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the one segment of the path."""
        low, high = Fraction(self.points[0]), Fraction(self.points[-1])
        sample_at = partial(pointwise, self._quick_verdict)
        quick_at = self._quick_verdict
        yield SmoothSegment(
            low, high, self.points, self.least, sample_at, self.verdict_at, slow=True, quick_at=quick_at
        )


def scale_of(model: Model, parameter_ref: ParameterRef) -> float:
    """Return the value of a parameter; for 0, the largest magnitude of a parameter of its unit, else 1."""
    if present := value_now(model, parameter_ref):
        return present
    unit = unit_of(model, parameter_ref.name)
    others = (parameter for parameter in model.parameters if parameter.unit == unit)
    return max((abs(parameter.value) for parameter in others), default=0.0) or 1.0


def line_points(
    model: Model, parameter_ref: ParameterRef, low: float | None, high: float | None, scale: float
) -> tuple[Floats, float]:
    """Return the first samples along a parameter, and the value below which cells no longer become narrower.

    Parameters
    ----------
    model, parameter_ref
        The compiled model and the parameter that varies.
    low, high
        The range; by default, for a probability 0 (or one sample, where 0 is excluded) to one sample
        below 1, otherwise from 0 (for a negative value, from `SPAN`
        times the value) to `SPAN` times the scale.
    scale
        The present value, or a substitute for 0.
    """
    if unit_of(model, parameter_ref.name) == "1" and parameter_ref.name in channel_numbers(model):
        # Endless bursts (r = 0) have no stationary distribution, and a loss of 1 delivers no packet.
        channels = [channel for link in model.links for channel in link.channels]
        endless = {channel.loss.r for channel in channels if channel.loss}
        least = 1 / SHARES if parameter_ref.name in endless else 0.0
        start, end = low if low is not None else least, high if high is not None else 1 - 1 / SHARES
        return np.linspace(start, end, SHARES), 1 / SHARES
    least, highest = allowed(model, parameter_ref)
    start = low if low is not None else max(least, 0.0 if scale > 0 else SPAN * scale)
    end = high if high is not None else min(SPAN * max(abs(scale), abs(start)), highest)
    return spread(start, end, abs(scale)), abs(scale) / SPAN
