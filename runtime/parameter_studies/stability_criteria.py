"""Scalar criteria along one parameter: a spectral radius, or a growth factor, compared with 1.

Takes: a `Model` and the name of a parameter, also of its links' losses.
Gives: `MEAN_SQUARE`, `NOMINAL`, `PASSIVE`, `SCALAR_CRITERIA`, `criterion_of`, `refuse_time`; `PointwisePath`,
`line_points`, `BOUNDED`; `verdict_with`, `allowed`; `RadiusEvaluator`.
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

from apc.analysis.analysis import analyze
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.data_age import aged
from apc.frame.numeric_model import Prepared
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, parameter_of, unit_of
from apc.network.nominal_criterion import channel_numbers, unreliable
from apc.parameter_studies.crossing import SingleSegment, SmoothSegment, Verdict
from apc.parameter_studies.evaluator import dominant_in_floats, overrides_at, reaches_time
from apc.parameter_studies.parameter_path import OPEN, SPAN, pointwise, spread, verdict_of
from apc.verdict import NO_PROOF, ProofMethod, StabilityProof

Floats = NDArray[np.float64]

# The step of a difference, of a direction, with equal truncation and rounding errors; roots above 0.
DIFFERENCE, LEAST = 1e-5, 1e-9

MEAN_SQUARE, NOMINAL, PASSIVE = "mean-square", "nominal", "passive"

# The scalar criteria, and the text of the verdict for each.
SCALAR_CRITERIA = {MEAN_SQUARE: "in mean square", PASSIVE: "with passive hands"}

# The method by which a crossing is known.
BOUNDED = {
    MEAN_SQUARE: StabilityProof(ProofMethod.BOUNDED_MOMENTS),
    PASSIVE: StabilityProof(ProofMethod.BOUNDED_HANDS),
}
ITERATED = StabilityProof(ProofMethod.ITERATED_MOMENTS)
TAGGED = StabilityProof(ProofMethod.ESTIMATED_MOMENTS)

# The number of samples between 0 and 1 of a probability.
SHARES = 33


def criterion_of(
    system: Model, requested: str | None, location: SourceLocation, varied: Sequence[ParameterRef] = ()
) -> str:
    """Return the criterion of a verdict: as requested, or mean square for a possibly unreliable link.

    Parameters
    ----------
    system
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
        E898 no such criterion.
    """
    if requested not in (None, MEAN_SQUARE, NOMINAL, PASSIVE):
        message = f"{str(requested)[:40]} is no criterion ({MEAN_SQUARE}, {NOMINAL}, {PASSIVE})"
        raise ApcError(Diagnostic("E898", location, message, hint=f"--criterion {MEAN_SQUARE}"))
    by_chance = unreliable(system) or any(free.name in channel_numbers(system) for free in varied)
    return requested or (MEAN_SQUARE if by_chance else NOMINAL)


def refuse_time(
    system: Model, free: ParameterRef, location: SourceLocation, criterion: str = MEAN_SQUARE
) -> None:
    """Raise an error for a period, phase or delay varied by a scalar criterion; jitter is allowed.

    Parameters
    ----------
    system, free
        The compiled model and the parameter to vary.
    location
        The location of the request.
    criterion
        One of `SCALAR_CRITERIA`.

    Raises
    ------
    ApcError
        E898 or, with passive hands, E930: the parameter affects the instants of events.
    """
    jitter = {link.channel.jitter for link in system.links if link.channel is not None}
    if reaches_time(system, free) and free.name not in jitter:
        message = f"{free.label} can't be varied {SCALAR_CRITERIA[criterion]}: it changes the order of events"
        if criterion == PASSIVE:
            hint = f'apc analyze --hands passive --set {free.label}="…", one value after the other'
            raise ApcError(Diagnostic("E930", location, message, hint=hint))
        raise ApcError(Diagnostic("E898", location, message, hint=f"--criterion {NOMINAL}"))
    if criterion == PASSIVE and free.name in channel_numbers(system):
        message = (
            f"{free.label} can't be varied with passive hands: every packet takes its nominal delay there"
        )
        raise ApcError(
            Diagnostic("E930", location, message, hint=f"--criterion {MEAN_SQUARE}, with free hands")
        )


# Errors of points without a value: overflow of a frame, and values out of a parameter's bounds.
NOWHERE = ("E806", "E624")


def verdict_with(
    system: Model,
    prepared: Prepared,
    overrides: Sequence[Override],
    location: SourceLocation,
    *,
    bounded: bool = True,
    criterion: str = MEAN_SQUARE,
) -> Verdict:
    """Return the verdict with other parameter values, by the spectral radius or a scalar criterion.

    Parameters
    ----------
    system, prepared
        The compiled model, and the result of `numeric_model.prepare` for it.
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
        E898 the network has no verdict with these values, by name; those of
        `absolute_stability.absolute_stability` and of `analysis.analyze`.
    """
    changed = apply(system, overrides)
    if criterion == NOMINAL and bounded:
        return verdict_of(analyze(changed, prepared=prepared))
    if criterion == NOMINAL:
        radius = abs(dominant_in_floats(changed, prepared))
        return Verdict(radius < 1, radius, math.nan, (), NO_PROOF) if math.isfinite(radius) else OPEN
    # Each imported where it is asked for: most topologies need neither.
    if criterion == PASSIVE:
        from apc.haptics.absolute_stability import passivity_radius

        result = passivity_radius(changed, prepared, bounded=bounded)
    else:
        from apc.mean_square.mean_square_stability import mean_square_growth

        result = mean_square_growth(changed, prepared, bounded=bounded)
    if result.why:
        message = f"the topology can't be judged in mean square: {result.why}"
        hint = f"--criterion {NOMINAL}"
        if any(override.free.name in channel_numbers(system) for override in overrides):
            hint = "apc simulate" if aged(system) else "a narrower range between --lower and --upper"
        raise ApcError(Diagnostic("E898", location, message, hint=hint))
    proof = TAGGED if not result.exact else BOUNDED[criterion] if result.proved else ITERATED
    error = max(result.high - result.radius, result.radius - result.low)
    return Verdict(result.stable, result.radius, error, (), proof)


@dataclass(frozen=True, slots=True, eq=False)
class RadiusEvaluator:
    """A `MatrixSource` of one number at each point, as a matrix (1, 1): the deciding radius.

    By a growth criterion it is the root of the growth per frame. Derivatives are differences over a small
    part of the directions, accurate to about 1e-9 of them.
    """

    system: Model
    free: tuple[ParameterRef, ...]
    prepared: Prepared
    location: SourceLocation
    criterion: str = MEAN_SQUARE

    def verdict(self, value: Sequence[float], *, bounded: bool = False) -> Verdict:
        """Return the verdict at a point (m,), undecided where there is none."""
        overrides = overrides_at(self.system, self.free, value)
        where = self.system, self.prepared, overrides, self.location
        try:
            return verdict_with(*where, bounded=bounded, criterion=self.criterion)
        except ApcError as error:
            if self.criterion != NOMINAL and error.mistakes[0].code not in NOWHERE:
                raise
            return OPEN

    def dominant(self, value: Sequence[float]) -> complex:
        """Return the dominant eigenvalue at a point (m,), or the criterion's value."""
        if self.criterion != NOMINAL:
            return complex(self.matrices(np.array([value]))[0].item())
        return dominant_in_floats(
            apply(self.system, overrides_at(self.system, self.free, value)), self.prepared
        )

    def parts(self, value: Sequence[float]) -> list[float]:
        """Return the criterion value of each modal port loop at a point (m,); the largest decides."""
        if self.criterion != PASSIVE:
            return self.matrices(np.array([value]))[0].ravel().tolist()
        from apc.haptics.absolute_stability import loop_growths

        changes = overrides_at(self.system, self.free, value)
        try:
            growths = loop_growths(apply(self.system, changes), self.prepared, bounded=False)
        except ApcError as error:
            if error.mistakes[0].code not in NOWHERE:
                raise
            return [math.nan]
        return [math.sqrt(growth.radius) for growth in growths]

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the number (k, 1, 1) at values (k, m), NaN if undefined."""
        radii = np.array([self.verdict(value).radius for value in values.tolist()])[:, None, None]
        return (radii if self.criterion == NOMINAL else np.sqrt(radii),)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the number (k, 1, 1) and its derivatives along directions (k, m)."""
        moved = DIFFERENCE * along
        # At a bound of the parameter, the parabola through two points further inside.
        at_end = ~(self._allowed(values - moved) & self._allowed(values + moved))[:, None]
        direction = np.where(self._allowed(values + 2 * moved), 1.0, -1.0)[:, None]
        item = values + np.where(at_end, direction, -1.0) * moved
        other = values + np.where(at_end, 2 * direction, 1.0) * moved
        (present,), (first,), (second,) = (self.matrices(points) for points in (values, item, other))
        inside = (4 * first - 3 * present - second) * direction[:, None] / (2 * DIFFERENCE)
        return ((present, np.where(at_end[:, None], inside, (second - first) / (2 * DIFFERENCE))),)

    def _allowed(self, values: Floats) -> NDArray[np.bool_]:
        """Return which values (k, m) are within the bounds of each parameter."""
        result = np.ones(len(values), dtype=bool)
        for local, free in zip(values.T, self.free, strict=True):
            least, most = allowed(self.system, free)
            result &= (local >= least) & (local <= most)
        return result

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, 1, 1) on the errors of the number at values (k, m)."""
        verdicts = [self.verdict(value, bounded=True) for value in values.tolist()]
        # The error of a root is half the error of its square, divided by the root: at most this.
        roots = [1.0 if self.criterion == NOMINAL else math.sqrt(verdict.radius) for verdict in verdicts]
        errors = [verdict.error / max(root, LEAST) for verdict, root in zip(verdicts, roots, strict=True)]
        return (np.array(errors)[:, None, None],)


def allowed(system: Model, free: ParameterRef) -> tuple[float, float]:
    """Return the bounds of a parameter."""
    if any(timing.name == free.name for timing in system.timings):
        return 0.0, math.inf
    parameter = parameter_of(system, free)
    return (
        -math.inf if parameter.minimum is None else parameter.minimum,
        math.inf if parameter.maximum is None else parameter.maximum,
    )


@dataclass(frozen=True, eq=False)
class PointwisePath(SingleSegment):
    """The one parameter of a `RadiusEvaluator`, sampled first at `points` (k,), each value evaluated once.

    Cell widths are relative to at least `least`.
    """

    source: RadiusEvaluator
    points: Floats
    least: float
    known: dict[float, Verdict] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The parameter that varies."""
        return self.source.free[0].label

    def _sampled(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, without bounds where these take longer."""
        if float(value) not in self.known:
            bounded = self.source.criterion == NOMINAL  # an analysis avoids matrices that are too large
            self.known[float(value)] = self.source.verdict([float(value)], bounded=bounded)
        return self.known[float(value)]

    def verdict_at(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, with bounds."""
        if self.source.criterion == NOMINAL:
            return self._sampled(value)
        return self.source.verdict([float(value)], bounded=True)

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        """Yield the one segment."""
        low, high = Fraction(self.points[0]), Fraction(self.points[-1])
        sample_at = partial(pointwise, self._sampled)
        yield SmoothSegment(low, high, self.points, self.least, sample_at, self.verdict_at, slow=True)


def line_points(
    system: Model, free: ParameterRef, low: float | None, high: float | None, scale: float
) -> tuple[Floats, float]:
    """Return the first samples of a parameter, and the smallest scale of cell widths.

    Parameters
    ----------
    system, free
        The compiled model and the parameter that varies.
    low, high
        The range; by default, all of a probability, or from 0 (for a negative value, from `SPAN` times it) up
        to `SPAN` times the scale.
    scale
        The present value or, where it is 0, a substitute.
    """
    if unit_of(system, free.name) == "1" and free.name in channel_numbers(system):
        # Endless bursts (r = 0) have no stationary distribution, and a loss of 1 delivers no packet.
        endless = {link.channel.loss.r for link in system.links if link.channel and link.channel.loss}
        least = 1 / SHARES if free.name in endless else 0.0
        bottom, top = low if low is not None else least, high if high is not None else 1 - 1 / SHARES
        return np.linspace(bottom, top, SHARES), 1 / SHARES
    least, most = allowed(system, free)
    bottom = low if low is not None else max(least, 0.0 if scale > 0 else SPAN * scale)
    top = high if high is not None else min(SPAN * max(abs(scale), abs(bottom)), most)
    return spread(bottom, top, abs(scale)), abs(scale) / SPAN
