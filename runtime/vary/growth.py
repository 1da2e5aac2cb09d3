"""The values of one parameter at which one number passes 1: a spectral radius, or a growth of its own.

Takes: a `Model` and the name of a parameter, or of what its links lose.
Gives: `MEAN_SQUARE`, `NOMINAL`, `PASSIVE`, `BY_GROWTH`, `criterion_of`, `refuse_time`; `PointwisePath`,
`line_points`, `BOUNDED`; `judge_at`, `allowed`; `RadiusEvaluator`.
Guarantees: a verdict is by bounds on the growth of second moments, or on what hands can draw, which counts
as a growth (see `passivity.passive_growth`); nominally, by the analysis itself.
Does not: find two crossings between neighbouring samples; follow a delay, whose stretches are the nominal
search's (see `line`).
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
from apc.frame.ages import aged
from apc.frame.instance import Prepared
from apc.frame.names import ParameterRef, parameter_of, unit_of
from apc.frame.overrides import Override, apply
from apc.network.nominal import channel_numbers, unreliable
from apc.vary.crossing import SingleSegment, SmoothSegment, Verdict
from apc.vary.evaluator import leading_in_floats, overrides_at, reaches_time
from apc.vary.line import OPEN, SPAN, one_by_one, spread, verdict_of
from apc.verdict import NO_PROOF, ProofMethod, StabilityProof

Floats = NDArray[np.float64]

# The step of a difference, of a direction, whose cut-off and rounding are then alike; roots above 0.
DIFFERENCE, LEAST = 1e-5, 1e-9

MEAN_SQUARE, NOMINAL, PASSIVE = "mean-square", "nominal", "passive"

# The criteria of one number, and how a verdict is by each.
BY_GROWTH = {MEAN_SQUARE: "in mean square", PASSIVE: "with passive hands"}

# What a crossing rests on.
BOUNDED = {
    MEAN_SQUARE: StabilityProof(ProofMethod.BOUNDED_MOMENTS),
    PASSIVE: StabilityProof(ProofMethod.BOUNDED_HANDS),
}
ITERATED = StabilityProof(ProofMethod.ITERATED_MOMENTS)
TAGGED = StabilityProof(ProofMethod.ESTIMATED_MOMENTS)

# Values looked at between 0 and 1 of a probability.
SHARES = 33


def criterion_of(
    system: Model, asked: str | None, place: SourceLocation, varied: Sequence[ParameterRef] = ()
) -> str:
    """Return the criterion of a verdict: as asked, or mean square where a link is, or may become, unreliable.

    Parameters
    ----------
    system
        The compiled scene.
    asked
        "mean-square", "nominal", "passive", or None.
    place
        Where it was asked for.
    varied
        What is to vary.

    Raises
    ------
    ApcError
        E898 no such criterion.
    """
    if asked not in (None, MEAN_SQUARE, NOMINAL, PASSIVE):
        what = f"{str(asked)[:40]} is no criterion ({MEAN_SQUARE}, {NOMINAL}, {PASSIVE})"
        raise ApcError(Diagnostic("E898", place, what, hint=f"--in {MEAN_SQUARE}"))
    by_chance = unreliable(system) or any(free.name in channel_numbers(system) for free in varied)
    return asked or (MEAN_SQUARE if by_chance else NOMINAL)


def refuse_time(
    system: Model, free: ParameterRef, place: SourceLocation, criterion: str = MEAN_SQUARE
) -> None:
    """Refuse to vary a period, phase or delay by a criterion of one number; how much delays vary may.

    Parameters
    ----------
    system, free
        The compiled scene and what is to vary.
    place
        Where it was asked for.
    criterion
        One of `BY_GROWTH`.

    Raises
    ------
    ApcError
        E898 or, with passive hands, E930: it reaches when something happens.
    """
    jitter = {link.channel.jitter for link in system.links if link.channel is not None}
    if reaches_time(system, free) and free.name not in jitter:
        what = f"{free.label} can't be varied {BY_GROWTH[criterion]}: it changes the order of events"
        if criterion == PASSIVE:
            hint = f'apc analyze --hands passive --set {free.label}="…", one value after the other'
            raise ApcError(Diagnostic("E930", place, what, hint=hint))
        raise ApcError(Diagnostic("E898", place, what, hint=f"--in {NOMINAL}"))
    if criterion == PASSIVE and free.name in channel_numbers(system):
        what = f"{free.label} can't be varied with passive hands: every packet takes its nominal delay there"
        raise ApcError(Diagnostic("E930", place, what, hint=f"--in {MEAN_SQUARE}, with free hands"))


# Where there is no number: a frame that grows beyond floats, and beyond what a parameter may be.
NOWHERE = ("E806", "E624")


def judge_at(
    system: Model,
    prepared: Prepared,
    overrides: Sequence[Override],
    place: SourceLocation,
    *,
    bounded: bool = True,
    criterion: str = MEAN_SQUARE,
) -> Verdict:
    """Return the verdict with other numbers, by the spectral radius or what stands for it by a criterion.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    overrides
        The numbers.
    place
        Where they were asked for.
    bounded
        Whether bounds are asked for, and what floats leave open is to be proved.
    criterion
        "nominal", or one of `BY_GROWTH`.

    Raises
    ------
    ApcError
        E898 the network can't be judged with these numbers, by name; those of `passivity.passive_hands` and
        of `analysis.analyze`.
    """
    changed = apply(system, overrides)
    if criterion == NOMINAL and bounded:
        return verdict_of(analyze(changed, prepared=prepared))
    if criterion == NOMINAL:
        radius = abs(leading_in_floats(changed, prepared))
        return Verdict(radius < 1, radius, math.nan, (), NO_PROOF) if math.isfinite(radius) else OPEN
    # Each imported where it is asked for: most scenes need neither.
    if criterion == PASSIVE:
        from apc.hands.passivity import passive_growth

        result = passive_growth(changed, prepared, bounded=bounded)
    else:
        from apc.moments.network_verdict import growth

        result = growth(changed, prepared, bounded=bounded)
    if result.why:
        what = f"the scene can't be judged in mean square: {result.why}"
        hint = f"--in {NOMINAL}"
        if any(override.free.name in channel_numbers(system) for override in overrides):
            hint = "apc simulate" if aged(system) else "a narrower range between --lower and --upper"
        raise ApcError(Diagnostic("E898", place, what, hint=hint))
    proof = TAGGED if not result.exact else BOUNDED[criterion] if result.proved else ITERATED
    error = max(result.high - result.radius, result.radius - result.low)
    return Verdict(result.stable, result.radius, error, (), proof)


@dataclass(frozen=True, slots=True, eq=False)
class RadiusEvaluator:
    """A `MatrixSource` of one number at each point, as a matrix (1, 1): the radius that decides.

    By a criterion of growth it is the root of what is said to grow in a frame. Derivatives are differences
    over a small part of the directions, right to about 1e-9 of them.
    """

    system: Model
    free: tuple[ParameterRef, ...]
    prepared: Prepared
    place: SourceLocation
    criterion: str = MEAN_SQUARE

    def verdict(self, value: Sequence[float], *, bounded: bool = False) -> Verdict:
        """Return the verdict at a point (m,), open where there is none."""
        overrides = overrides_at(self.system, self.free, value)
        where = self.system, self.prepared, overrides, self.place
        try:
            return judge_at(*where, bounded=bounded, criterion=self.criterion)
        except ApcError as error:
            if self.criterion != NOMINAL and error.mistakes[0].code not in NOWHERE:
                raise
            return OPEN

    def leading(self, value: Sequence[float]) -> complex:
        """Return the eigenvalue that decides at a point (m,), or the number that stands for it."""
        if self.criterion != NOMINAL:
            return complex(self.matrices(np.array([value]))[0].item())
        return leading_in_floats(
            apply(self.system, overrides_at(self.system, self.free, value)), self.prepared
        )

    def parts(self, value: Sequence[float]) -> list[float]:
        """Return the roots at a point (m,), of which the largest counts: one of each loop of hands."""
        if self.criterion != PASSIVE:
            return self.matrices(np.array([value]))[0].ravel().tolist()
        from apc.hands.passivity import loop_growths

        changes = overrides_at(self.system, self.free, value)
        try:
            growths = loop_growths(apply(self.system, changes), self.prepared, bounded=False)
        except ApcError as error:
            if error.mistakes[0].code not in NOWHERE:
                raise
            return [math.nan]
        return [math.sqrt(growth.radius) for growth in growths]

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the number (k, 1, 1) at values (k, m), NaN where there is none."""
        radii = np.array([self.verdict(value).radius for value in values.tolist()])[:, None, None]
        return (radii if self.criterion == NOMINAL else np.sqrt(radii),)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the number (k, 1, 1) and its derivatives along directions (k, m)."""
        moved = DIFFERENCE * along
        # At an end of what a parameter may be, the parabola through two points further inside.
        at_end = ~(self._allowed(values - moved) & self._allowed(values + moved))[:, None]
        way = np.where(self._allowed(values + 2 * moved), 1.0, -1.0)[:, None]
        item = values + np.where(at_end, way, -1.0) * moved
        other = values + np.where(at_end, 2 * way, 1.0) * moved
        (present,), (first,), (second,) = (self.matrices(points) for points in (values, item, other))
        inside = (4 * first - 3 * present - second) * way[:, None] / (2 * DIFFERENCE)
        return ((present, np.where(at_end[:, None], inside, (second - first) / (2 * DIFFERENCE))),)

    def _allowed(self, values: Floats) -> NDArray[np.bool_]:
        """Say which values (k, m) are within what each parameter may be."""
        result = np.ones(len(values), dtype=bool)
        for own, free in zip(values.T, self.free, strict=True):
            least, most = allowed(self.system, free)
            result &= (own >= least) & (own <= most)
        return result

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, 1, 1) on the errors of the number at values (k, m)."""
        verdicts = [self.verdict(value, bounded=True) for value in values.tolist()]
        # That of a root is half of what its square's is, divided by the root: at most this.
        roots = [1.0 if self.criterion == NOMINAL else math.sqrt(verdict.radius) for verdict in verdicts]
        errors = [verdict.error / max(root, LEAST) for verdict, root in zip(verdicts, roots, strict=True)]
        return (np.array(errors)[:, None, None],)


def allowed(system: Model, free: ParameterRef) -> tuple[float, float]:
    """Return between which values a parameter may be."""
    if any(timing.name == free.name for timing in system.timings):
        return 0.0, math.inf
    parameter = parameter_of(system, free)
    return (
        -math.inf if parameter.minimum is None else parameter.minimum,
        math.inf if parameter.maximum is None else parameter.maximum,
    )


@dataclass(frozen=True, eq=False)
class PointwisePath(SingleSegment):
    """The one parameter of a `RadiusEvaluator`, at `points` (k,) to begin with: each value by itself, once.

    Cells are measured against `least` where the value is smaller.
    """

    source: RadiusEvaluator
    points: Floats
    least: float
    known: dict[float, Verdict] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The number that varies."""
        return self.source.free[0].label

    def _sampled(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, without bounds where these take longer."""
        if float(value) not in self.known:
            bounded = self.source.criterion == NOMINAL  # an analysis spares matrices that are too large
            self.known[float(value)] = self.source.verdict([float(value)], bounded=bounded)
        return self.known[float(value)]

    def judge(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, bounded."""
        if self.source.criterion == NOMINAL:
            return self._sampled(value)
        return self.source.verdict([float(value)], bounded=True)

    def stretches(self) -> Iterator[SmoothSegment]:
        """Yield the one stretch."""
        low, high = Fraction(self.points[0]), Fraction(self.points[-1])
        look = partial(one_by_one, self._sampled)
        yield SmoothSegment(low, high, self.points, self.least, look, self.judge, slow=True)


def line_points(
    system: Model, free: ParameterRef, low: float | None, high: float | None, scale: float
) -> tuple[Floats, float]:
    """Return the values of a parameter to look at first, and what cells are measured against beside 0.

    Parameters
    ----------
    system, free
        The compiled scene and what varies.
    low, high
        Between which values; where not given, all of a probability, or from 0 (of what is negative, from
        `SPAN` times it) up to `SPAN` times the scale.
    scale
        The present value or, where it is 0, what stands for it.
    """
    if unit_of(system, free.name) == "1" and free.name in channel_numbers(system):
        # Bursts that never end (r = 0) have no long run, and all packets lost neither.
        endless = {link.channel.loss.r for link in system.links if link.channel and link.channel.loss}
        least = 1 / SHARES if free.name in endless else 0.0
        bottom, top = low if low is not None else least, high if high is not None else 1 - 1 / SHARES
        return np.linspace(bottom, top, SHARES), 1 / SHARES
    least, most = allowed(system, free)
    bottom = low if low is not None else max(least, 0.0 if scale > 0 else SPAN * scale)
    top = high if high is not None else min(SPAN * max(abs(scale), abs(bottom)), most)
    return spread(bottom, top, abs(scale)), abs(scale) / SPAN
