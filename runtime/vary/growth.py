"""The values of one parameter at which one number passes 1: in mean square, or with passive hands.

Takes: a `CompiledSystem` and the name of a parameter, or of what its links lose.
Gives: `MEAN_SQUARE`, `NOMINAL`, `PASSIVE`, `BY_GROWTH`, `criterion_of`, `refuse_time`; `search_growth`;
`first_lost`, `FirstLost`, `BOUNDED`; `growth_at`, `allowed`; `GrowthEvaluator`.
Guarantees: on either side of a crossing, by its error, bounds on the growth of second moments decide, or on
what hands can draw, which counts as a growth (see `passivity.passive_growth`).
Does not: find two crossings between neighbouring samples; follow a delay, whose pieces are the nominal
search's (see `delays`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.ages import aged
from apc.frame.names import Free, parameter_of, unit_of
from apc.frame.overrides import Override, apply
from apc.hands.passivity import passive_growth, passive_hands
from apc.moments.network import Growth, growth, unreliable
from apc.network.nominal import channel_numbers
from apc.vary.evaluator import reaches_time
from apc.vary.search import SAMPLES, SPAN, Crossing, Search, Told

Floats = NDArray[np.float64]

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
ESTIMATED = "an estimate: bounds leave either side open"
ITERATED = "second moments by iteration in floats, not proved"
TAGGED = "an estimate, not proved: of second moments that are themselves estimates"

# Values looked at between 0 and 1 of a probability.
SHARES = 33

# How near a crossing is found at first, relatively, and how far its bounds may be at last.
NEAR, FAR = 1e-14, 1e-4

# After so many values at which nothing changes, second moments don't depend on a parameter.
STILL = 4

# The first width at which bounds are asked for; how many times wider the next is where they say nothing of
# that, where they do beyond what they want, and at most; steps towards a crossing.
FIRST, WIDER, BEYOND, WIDEST, STEPS = 1e-12, 4.0, 1.5, 64.0, 60


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
    by_chance = unreliable(system) or any(one.name in channel_numbers(system) for one in varied)
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
        what = f"{free.label} can't be varied {BY_GROWTH[criterion]}: what happens when would change with it"
        if criterion == PASSIVE:
            hint = f'apc analyze --hands passive --set {free.label}="…", one value after the other'
            raise ApcError(Mistake("E930", place, what, hint=hint))
        raise ApcError(Mistake("E898", place, what, hint=f"--in {NOMINAL}"))
    if criterion == PASSIVE and free.name in channel_numbers(system):
        what = f"{free.label} can't be varied with passive hands: every packet takes its nominal delay there"
        raise ApcError(Mistake("E930", place, what, hint=f"--in {MEAN_SQUARE}, with free hands"))


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
        The compiled scene, and what `analysis.prepare` made of it.
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
    found = growth(changed, prepared, bounded=bounded)
    if found.why:
        what = f"the scene can't be judged in mean square: {found.why}"
        hint = f"--in {NOMINAL}"
        if any(one.free.name in channel_numbers(system) for one in overrides):
            hint = "apc simulate" if aged(system) else "a narrower range between --lower and --upper"
        raise ApcError(Mistake("E898", place, what, hint=hint))
    return found


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
        """Return what second moments grow by at a point (m,)."""
        overrides = [
            Override(one, Fraction(float(number))) for one, number in zip(self.free, value, strict=True)
        ]
        return growth_at(
            *(self.system, self.prepared, overrides, self.place), bounded=bounded, criterion=self.criterion
        )

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the root (k, 1, 1) at values (k, m)."""
        return (np.sqrt([self.growth(value).radius for value in values.tolist()])[:, None, None],)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the root (k, 1, 1) and its derivatives along directions (k, m)."""
        moved = DIFFERENCE * along
        # At an end of what a parameter may be, the parabola through two points further inside.
        at_end = ~(self._allowed(values - moved) & self._allowed(values + moved))[:, None]
        way = np.where(self._allowed(values + 2 * moved), 1.0, -1.0)[:, None]
        one = values + np.where(at_end, way, -1.0) * moved
        other = values + np.where(at_end, 2 * way, 1.0) * moved
        (here,), (first,), (second,) = (self.matrices(points) for points in (values, one, other))
        inside = (4 * first - 3 * here - second) * way[:, None] / (2 * DIFFERENCE)
        return ((here, np.where(at_end[:, None], inside, (second - first) / (2 * DIFFERENCE))),)

    def _allowed(self, values: Floats) -> NDArray[np.bool_]:
        """Say which values (k, m) are within what each parameter may be."""
        found = np.ones(len(values), dtype=bool)
        for own, one in zip(values.T, self.free, strict=True):
            least, most = allowed(self.system, one)
            found &= (own >= least) & (own <= most)
        return found

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, 1, 1) on the errors of the root at values (k, m)."""
        found = [self.growth(value, bounded=True) for value in values.tolist()]
        return (np.array([(one.high - one.low) / max(one.radius, LEAST) for one in found])[:, None, None],)


def allowed(system: CompiledSystem, free: Free) -> tuple[float, float]:
    """Return between which values a parameter may be."""
    if any(timing.name == free.name for timing in system.timings):
        return 0.0, math.inf
    one = parameter_of(system, free)
    return (
        -math.inf if one.minimum is None else one.minimum,
        math.inf if one.maximum is None else one.maximum,
    )


def search_growth(
    system: CompiledSystem,
    free: Free,
    low: float | None,
    high: float | None,
    present: float,
    prepared: Prepared,
    place: Place,
    *,
    told: Told | None = None,
    criterion: str = MEAN_SQUARE,
) -> Search:
    """Find where second moments begin or cease to grow as one parameter varies, or what stands for them.

    Parameters
    ----------
    system, free
        The compiled scene and what varies.
    low, high
        Between which values; where not given, a probability's all, or `SPAN` times smaller and larger than
        the present value.
    present
        The present value.
    prepared
        From `analysis.prepare`.
    place
        Where it was asked for.
    told
        Is told how far the search is.
    criterion
        One of `BY_GROWTH`.

    Raises
    ------
    ApcError
        E898 the network can't be judged, or a delay is to vary; E930 the same with passive hands.
    """
    refuse_time(system, free, place, criterion)
    samples = _samples(system, free, low, high, present)
    looking = _Looking(system, free, prepared, place, {}, criterion)
    known = looking.known
    for number, value in enumerate(samples):
        if told is not None:
            told(f"{number} of {len(samples)} values")
        looking.at(value)
    verdicts = [known[value].radius < 1 for value in samples]
    edges, stable = [], [verdicts[0]]
    for place_of, (one, other) in enumerate(itertools.pairwise(samples)):
        if verdicts[place_of] != verdicts[place_of + 1]:
            edges.append(looking.crossing(one, other))
            stable.append(verdicts[place_of + 1])
    radii = {known[value].radius for value in samples}
    return Search(
        edges=tuple(edges),
        stable=tuple(stable),
        scanned=(samples[0], samples[-1]),
        whole=True,
        known=False,
        looked=len(known),
        # Beyond where clamped devices shake all values are one, and tell nothing of what enters.
        enters=len(radii) > 1 or (criterion == PASSIVE and not passive_hands(system, prepared).why),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Looking:
    """A scene looked at for values of one parameter; `known` are those without bounds."""

    system: CompiledSystem
    free: Free
    prepared: Prepared
    place: Place
    known: dict[float, Growth]
    criterion: str = MEAN_SQUARE

    def at(self, value: float) -> Growth:
        """Return what second moments grow by, without bounds."""
        if value not in self.known:
            self.known[value] = self._growth(value, bounded=False)
        return self.known[value]

    def _growth(self, value: float, *, bounded: bool) -> Growth:
        overrides = [Override(self.free, Fraction(value))]
        return growth_at(
            *(self.system, self.prepared, overrides, self.place), bounded=bounded, criterion=self.criterion
        )

    def crossing(self, low: float, high: float) -> Crossing:
        """Return the crossing between two values of other verdicts, and how far bounds leave it open.

        By secants that keep a point on either side, one that stays twice counting half (the Illinois rule).
        """
        at_low, at_high = math.log(self.at(low).radius), math.log(self.at(high).radius)
        value, stayed, stable_below = low, 0, at_low < 0
        for _ in range(STEPS):
            middle = low - at_low * (high - low) / (at_high - at_low)
            if not low < middle < high:
                break
            value, found = middle, math.log(self.at(middle).radius)
            if abs(found) < NEAR or high - low <= NEAR * abs(high):
                break
            if (found < 0) == (at_low < 0):
                low, at_low = middle, found
                at_high, stayed = (at_high / 2, 1) if stayed == 1 else (at_high, 1)
            else:
                high, at_high = middle, found
                at_low, stayed = (at_low / 2, -1) if stayed == -1 else (at_low, -1)
        width = FIRST * max(abs(value), 1e-300)
        while width <= FAR * max(abs(value), 1e-300):
            sides = [self._growth(one, bounded=True) for one in (value - width, value + width)]
            below, above = (one.stable for one in sides)
            if None not in (below, above) and below != above:
                proof = BOUNDED[self.criterion] if all(one.proved for one in sides) else ITERATED
                proof = proof if all(one.exact for one in sides) else TAGGED
                return Crossing(value, width, "below" if below else "above", math.nan, "crossing", proof)
            width *= _wider(sides)
        side = "below" if stable_below else "above"
        return Crossing(value, width, side, math.nan, "crossing", ESTIMATED)


def _wider(sides: Sequence[Growth]) -> float:
    """Return how many times farther off bounds decide, as what grows changes evenly near a crossing."""
    wanted = [
        ((one.high if one.radius < 1 else one.low) - one.radius) / (1 - one.radius)
        for one in sides
        if one.stable is None and one.radius != 1
    ]
    return min(max([WIDER] if not wanted else [BEYOND, *(BEYOND * one for one in wanted)]), WIDEST)


@dataclass(frozen=True, slots=True)
class FirstLost:
    """How far a parameter grows from a stable value until second moments do; `crossing` None: not up to
    `reached`.

    `enters` says whether second moments depend on it, `looked` at how many values, `why` why not farther.
    """

    crossing: Crossing | None
    reached: float
    enters: bool
    looked: int
    why: str


def first_lost(
    system: CompiledSystem,
    free: Free,
    samples: Sequence[float],
    prepared: Prepared,
    place: Place,
    here: Growth,
) -> FirstLost:
    """Look at values of a parameter, from a stable one on, until second moments grow.

    Parameters
    ----------
    system, free
        The compiled scene and what varies.
    samples
        Where to look, the first the present value, a stable one.
    prepared, place
        As for `search_growth`.
    here
        What second moments grow by as the scene is.
    """
    looking, why, reached = _Looking(system, free, prepared, place, {samples[0]: here}), "", samples[0]
    for one, other in itertools.pairwise(samples):
        try:
            grows = looking.at(one).radius < 1 <= looking.at(other).radius
        except ApcError as error:
            why = error.mistakes[0].what
            break
        reached = other
        if grows:
            found = looking.crossing(one, other)
            return FirstLost(found, reached, True, len(looking.known), "")
        if len(looking.known) == STILL and len({found.radius for found in looking.known.values()}) == 1:
            break
    enters = len({found.radius for found in looking.known.values()}) > 1
    return FirstLost(None, reached, enters, len(looking.known), why)


def _samples(
    system: CompiledSystem, free: Free, low: float | None, high: float | None, present: float
) -> list[float]:
    """Return the values to look at first."""
    if unit_of(system, free.name) == "1" and free.name in channel_numbers(system):
        # Bursts that never end (r = 0) have no long run, and all packets lost neither.
        endless = {link.channel.loss.r for link in system.links if link.channel and link.channel.loss}
        least = 1 / SHARES if free.name in endless else 0.0
        bottom, top = low if low is not None else least, high if high is not None else 1 - 1 / SHARES
        return [float(one) for one in np.linspace(bottom, top, SHARES)]
    scale = abs(present) or 1.0
    bottom = low if low is not None else scale / SPAN
    top = high if high is not None else max(scale, abs(bottom)) * SPAN
    if bottom > 0:
        count = max(math.ceil(SAMPLES * math.log10(top / bottom)), SAMPLES)
        return [float(one) for one in np.geomspace(bottom, top, count + 1)]
    return [float(one) for one in np.linspace(bottom, top, 6 * SAMPLES + 1)]
