"""The values of one parameter at which one number passes 1: in mean square, or with passive hands.

Takes: a `CompiledSystem` and the name of a parameter, or of what its links lose.
Gives: `MEAN_SQUARE`, `NOMINAL`, `PASSIVE`, `BY_GROWTH`, `criterion_of`, `refuse_time`; `GrowthLine`,
`growth_points`, `BOUNDED`; `growth_at`, `allowed`; `GrowthEvaluator`.
Guarantees: a verdict is by bounds on the growth of second moments, or on what hands can draw, which counts
as a growth (see `passivity.passive_growth`).
Does not: find two crossings between neighbouring samples; follow a delay, whose stretches are the nominal
search's (see `line`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.ages import aged
from apc.frame.instance import Prepared
from apc.frame.names import Free, parameter_of, unit_of
from apc.frame.overrides import Override, apply
from apc.hands.passivity import loop_growths, passive_growth
from apc.moments.network_verdict import Growth, growth
from apc.network.nominal import channel_numbers, unreliable
from apc.vary.crossing import OneStretch, Stretch, Verdict
from apc.vary.evaluator import reaches_time
from apc.vary.line import SAMPLES, SPAN

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# The step of a difference, of a direction, whose cut-off and rounding are then alike; roots above 0.
DIFFERENCE, LEAST = 1e-5, 1e-9

MEAN_SQUARE, NOMINAL, PASSIVE = "mean-square", "nominal", "passive"

# The criteria of one number, and how a verdict is by each.
BY_GROWTH = {MEAN_SQUARE: "in mean square", PASSIVE: "with passive hands"}

# What a crossing rests on.
BOUNDED = {
    MEAN_SQUARE: "second moments bounded on either side",
    PASSIVE: "what hands can draw bounded on either side",
}
ITERATED = "second moments by iteration in floats, not proved"
TAGGED = "an estimate, not proved: of second moments that are themselves estimates"

# Values looked at between 0 and 1 of a probability.
SHARES = 33


def criterion_of(system: CompiledSystem, asked: str | None, place: Place, varied: Sequence[Free] = ()) -> str:
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
        raise ApcError(Mistake("E898", place, what, hint=f"--in {MEAN_SQUARE}"))
    by_chance = unreliable(system) or any(free.name in channel_numbers(system) for free in varied)
    return asked or (MEAN_SQUARE if by_chance else NOMINAL)


def refuse_time(system: CompiledSystem, free: Free, place: Place, criterion: str = MEAN_SQUARE) -> None:
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
            raise ApcError(Mistake("E930", place, what, hint=hint))
        raise ApcError(Mistake("E898", place, what, hint=f"--in {NOMINAL}"))
    if criterion == PASSIVE and free.name in channel_numbers(system):
        what = f"{free.label} can't be varied with passive hands: every packet takes its nominal delay there"
        raise ApcError(Mistake("E930", place, what, hint=f"--in {MEAN_SQUARE}, with free hands"))


# Where there is no number: a frame that grows beyond floats, and beyond what a parameter may be.
NOWHERE = ("E806", "E624")


def growth_at(
    system: CompiledSystem,
    prepared: Prepared,
    overrides: list[Override],
    place: Place,
    *,
    bounded: bool = True,
    criterion: str = MEAN_SQUARE,
) -> Growth:
    """Return what second moments grow by with other numbers, or what stands for that by another criterion.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    overrides
        The numbers.
    place
        Where they were asked for.
    bounded
        Whether bounds are asked for.
    criterion
        One of `BY_GROWTH`.

    Raises
    ------
    ApcError
        E898 the network can't be judged with these numbers, by name; those of `passivity.passive_hands`.
    """
    changed = apply(system, overrides)
    if criterion == PASSIVE:
        return passive_growth(changed, prepared, bounded=bounded)
    result = growth(changed, prepared, bounded=bounded)
    if result.why:
        what = f"the scene can't be judged in mean square: {result.why}"
        hint = f"--in {NOMINAL}"
        if any(override.free.name in channel_numbers(system) for override in overrides):
            hint = "apc simulate" if aged(system) else "a narrower range between --lower and --upper"
        raise ApcError(Mistake("E898", place, what, hint=hint))
    return result


@dataclass(frozen=True, slots=True, eq=False)
class GrowthEvaluator:
    """An `Evaluator` of one number: the root of what is said to grow in a frame, as a matrix (1, 1).

    Derivatives are differences over a small part of the directions, right to about 1e-9 of them.
    """

    system: CompiledSystem
    free: tuple[Free, ...]
    prepared: Prepared
    place: Place
    criterion: str = MEAN_SQUARE

    def growth(self, value: Sequence[float], *, bounded: bool = False) -> Growth:
        """Return what second moments grow by at a point (m,), NaN where there is none."""
        overrides = [
            Override(free, Fraction(float(number))) for free, number in zip(self.free, value, strict=True)
        ]
        where = self.system, self.prepared, overrides, self.place
        try:
            return growth_at(*where, bounded=bounded, criterion=self.criterion)
        except ApcError as error:
            if error.mistakes[0].code not in NOWHERE:
                raise
            return Growth(math.nan, math.nan, math.nan, exact=True)

    def parts(self, value: Sequence[float]) -> list[float]:
        """Return the roots at a point (m,), of which the largest counts: one of each loop of hands."""
        if self.criterion != PASSIVE:
            return [math.sqrt(self.growth(value).radius)]
        changes = [Override(*pair) for pair in zip(self.free, map(Fraction, value), strict=True)]
        try:
            growths = loop_growths(apply(self.system, changes), self.prepared, bounded=False)
        except ApcError as error:
            if error.mistakes[0].code not in NOWHERE:
                raise
            return [math.nan]
        return [math.sqrt(growth.radius) for growth in growths]

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the root (k, 1, 1) at values (k, m)."""
        return (np.sqrt([self.growth(value).radius for value in values.tolist()])[:, None, None],)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the root (k, 1, 1) and its derivatives along directions (k, m)."""
        moved = DIFFERENCE * along
        # At an end of what a parameter may be, the parabola through two points further inside.
        at_end = ~(self._allowed(values - moved) & self._allowed(values + moved))[:, None]
        way = np.where(self._allowed(values + 2 * moved), 1.0, -1.0)[:, None]
        item = values + np.where(at_end, way, -1.0) * moved
        other = values + np.where(at_end, 2 * way, 1.0) * moved
        (here,), (first,), (second,) = (self.matrices(points) for points in (values, item, other))
        inside = (4 * first - 3 * here - second) * way[:, None] / (2 * DIFFERENCE)
        return ((here, np.where(at_end[:, None], inside, (second - first) / (2 * DIFFERENCE))),)

    def _allowed(self, values: Floats) -> NDArray[np.bool_]:
        """Say which values (k, m) are within what each parameter may be."""
        result = np.ones(len(values), dtype=bool)
        for own, free in zip(values.T, self.free, strict=True):
            least, most = allowed(self.system, free)
            result &= (own >= least) & (own <= most)
        return result

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, 1, 1) on the errors of the root at values (k, m)."""
        growths = [self.growth(value, bounded=True) for value in values.tolist()]
        return (
            np.array([(growth.high - growth.low) / max(growth.radius, LEAST) for growth in growths])[
                :, None, None
            ],
        )


def allowed(system: CompiledSystem, free: Free) -> tuple[float, float]:
    """Return between which values a parameter may be."""
    if any(timing.name == free.name for timing in system.timings):
        return 0.0, math.inf
    parameter = parameter_of(system, free)
    return (
        -math.inf if parameter.minimum is None else parameter.minimum,
        math.inf if parameter.maximum is None else parameter.maximum,
    )


@dataclass(frozen=True, eq=False)
class GrowthLine(OneStretch):
    """The one parameter of an evaluator of one number, at `points` (k,) to begin with."""

    source: GrowthEvaluator
    points: Floats
    known: dict[float, Growth] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The number that varies."""
        return self.source.free[0].label

    def look(self, values: Floats) -> tuple[Complexes, Complexes]:
        """Return the growth at values (k, 1) without bounds, and no slopes."""
        for value in values.tolist():
            if value not in self.known:
                self.known[value] = self.source.growth([value])
        result = np.array([self.known[value].radius for value in values.tolist()], np.complex128)[:, None]
        return result, np.full(result.shape, np.nan, np.complex128)

    def judge(self, value: Fraction) -> Verdict:
        """Return the verdict at a value, bounded."""
        growth = self.source.growth([float(value)], bounded=True)
        proof = BOUNDED[self.source.criterion] if growth.proved else ITERATED
        error = max(growth.high - growth.radius, growth.radius - growth.low)
        return Verdict(growth.stable, growth.radius, error, (), proof if growth.exact else TAGGED)

    def stretches(self) -> Iterator[Stretch]:
        """Yield the one stretch."""
        low, high = Fraction(self.points[0]), Fraction(self.points[-1])
        least = float(self.points[self.points > 0].min(initial=1.0))
        yield Stretch(low, high, self.points, least, self.look, self.judge, slow=True)


def growth_points(
    system: CompiledSystem, free: Free, low: float | None, high: float | None, present: float
) -> Floats:
    """Return the values to look at first.

    Parameters
    ----------
    system, free
        The compiled scene and what varies.
    low, high
        Between which values; where not given, a probability's all, or `SPAN` times smaller and larger than
        the present value.
    present
        The present value.
    """
    if unit_of(system, free.name) == "1" and free.name in channel_numbers(system):
        # Bursts that never end (r = 0) have no long run, and all packets lost neither.
        endless = {link.channel.loss.r for link in system.links if link.channel and link.channel.loss}
        least = 1 / SHARES if free.name in endless else 0.0
        bottom, top = low if low is not None else least, high if high is not None else 1 - 1 / SHARES
        return np.linspace(bottom, top, SHARES)
    scale = abs(present) or 1.0
    bottom = low if low is not None else scale / SPAN
    top = high if high is not None else max(scale, abs(bottom)) * SPAN
    if bottom > 0:
        count = max(math.ceil(SAMPLES * math.log10(top / bottom)), SAMPLES)
        return np.geomspace(bottom, top, count + 1)
    return np.linspace(bottom, top, 6 * SAMPLES + 1)
