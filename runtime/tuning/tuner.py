"""The gains that do best in all that they have to bear, as a person would type them, proved.

Takes: a `Model` and `TuningSpec`.
Gives: `Gain`, `ActiveConstraint`, `Proved`, `Tuning`, `tune`.
Guarantees: what is said to be proved is proved by the scene's own analysis at the gains as they are printed;
what is not, is said not to be.
Does not: prove that no other gains are better, but of at most three that a nominal network limits, by 2 %.

Gains are first the best of a few scenarios. Where another corner, number of peers or delay limits them more,
it is one of the scenarios from then on. They are rounded to as few digits as bear the scenarios, and what is
to be best goes back step by step as long as the proof leaves anything open.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze, near_start
from apc.analysis.box_proof import UNDECIDED, ChangingDelay, RobustStability
from apc.answer import proved_at
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.timings import part
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import prepare
from apc.frame.names import ParameterRef, Range, value_now
from apc.frame.overrides import Override, apply
from apc.hands.passivity import passive_hands
from apc.moments.changing_delay import loop_gain
from apc.network.nominal import left_out
from apc.result import Result
from apc.threads import single_threaded
from apc.tuning.bound import none_better
from apc.tuning.demands import CHANGING, HINF, PLACE, SUBJECT, TransparencyMetric, TuningSpec
from apc.tuning.limits import BEYOND, RESPONSES, ConstraintSet, Scenario, felt_in
from apc.tuning.optimum import BINDS, Optimum, ScenarioOptimizer
from apc.unserved import NotSupportedError
from apc.vary.crossing import Progress
from apc.vary.delay_box import changing
from apc.vary.growth import MEAN_SQUARE, NOMINAL, PASSIVE

Floats = NDArray[np.float64]

# Significant digits that a person types.
DIGITS = 4

# How much worse than the least a limit may be for rounding, as a share of it.
NEARLY = 1e-4

# How far gains go back from the best until they are proved, as shares of the best; where there is a box, they
# begin farther back: cells beside a limit are small, and there are very many.
BACK = (0.0, 1e-4, 1e-3, 1e-2)
BACK_IN_BOX = (5e-3, 1e-2)

# How far a level is kept from what it bounds, of its size: far more than rounding, less than what is shown.
SLACK = 1e-5

# What is said where only stability is proved.
SLOWER = "stable is proved; how fast motions die out, or what is felt, is only looked at scenario by scenario"

# What is said where every passive hand is to be borne in a box.
ONE_BY_ONE = "no box is proved with every passive hand: it is so in the scenarios looked at"

# What is reported where a delay that changes has no proof, and where there is a box as well.
CHANGES = "with a delay that changes from packet to packet it is not proved stable"
CHANGES_IN_BOX = "no box is proved with a delay that changes: it is so in the scenarios evaluated"

# What is said where one point takes too long to look for the worst of a box.
CORNERS = (
    "before rounding: the ends and the middle of each range in a box were looked at, and no point between"
)

# What is said where no gains that meet all demands were found in time.
LATE = "the time was up: these gains are those that were looked at last"

# Scenarios added at a time; how far above the others a limit is that counts.
MORE, ABOVE = 3, 1e-9

# Settings in which the worst point inside a box is looked for, those first whose corners limit gains most.
MOST_LIMITED = 8

# Scenarios, those first that limit gains most, in one of which gains that would do better are unstable.
LIMITING = 12

# Turns in which scenarios that limit nothing are left out.
DROPPING = 6


@dataclass(frozen=True, slots=True)
class Gain:
    """A free number: its `value` as it is typed, exact, what was best before rounding, what it is `now`."""

    parameter: str
    unit: str
    low: float
    high: float
    value: Fraction
    best: float
    now: float


@dataclass(frozen=True, slots=True)
class ActiveConstraint:
    """What keeps gains from doing better: a mode in a scenario, or an end of a gain's own range.

    `where` are the scenario's numbers as (label, value, unit). `shape` and `frequency_hz` are the mode's, ""
    and NaN where the criterion has none. `buys` are the ends of what has to be borne that meet there, as
    (label, end, unit, how much better the aim is for 1 % less of it).
    """

    where: tuple[tuple[str, float, str], ...]
    shape: str
    frequency_hz: float
    buys: tuple[tuple[str, float, str, float], ...]


@dataclass(frozen=True, slots=True)
class Proved:
    """What was proved of the gains with some numbers of peers, as (label, number): of the rest, all of it."""

    counts: tuple[tuple[str, int], ...]
    proof: RobustStability


@dataclass(frozen=True, slots=True)
class Tuning(Result):
    """The best gains, what was proved of them, and what binds.

    `value` is that of the aim with the gains as they are typed, `best` before they were rounded, right to
    `error` (infinite where nothing says); both are a spectral radius where that is the aim. `met` says
    whether any gains meet all demands in floats; `proved` whether all was proved of these. `worst` is the
    largest limit (see `limits`), as how much faster than allowed the fastest motion grows in a frame,
    ln |λ| less the `allowed`, below 0 if all are met. `decay` is a factor a second.
    `delay` is the one of `over` that a link has, at every constant value; `changing` is what is proved of
    the gains where it changes from packet to packet, by numbers of peers as in `proofs`, all else at its
    present value, and `demanded` whether stability was asked for there.
    `scenes` are those of `binding`, or one if nothing binds. `looked` points were looked at.
    `bounded` is in how many cells it is proved that no gains of these ranges do better by `bound.SHARE`, None
    where it is not.
    """

    shown_by = "tuning_output:tuning"

    topology: str
    aim: str
    unit: str
    larger: bool
    met: bool
    proved: bool
    value: float
    best: float
    error: float
    worst: float
    gains: tuple[Gain, ...]
    over: tuple[Range, ...]
    criterion: str
    decay: float
    felt: tuple[TransparencyMetric, ...]
    delay: Range | None
    changing: tuple[tuple[tuple[tuple[str, int], ...], ChangingDelay], ...]
    demanded: bool
    frame_s: float
    allowed: float
    proofs: tuple[Proved, ...]
    binding: tuple[ActiveConstraint, ...]
    looked: int
    bounded: int | None
    notes: tuple[str, ...]
    left_out: tuple[str, ...]
    ranges: tuple[Range, ...] = field(compare=False, repr=False)
    scenes: tuple[Model, ...] = field(compare=False, repr=False)

    def plot(self, ax: Any = None) -> Any:
        """Draw two gains over the stable regions of what limits them, and a strike; return the Axes.

        A strike is played now and with the gains found, in the scenario that limits them most.

        Raises
        ------
        ApcError
            E875 matplotlib is not installed; those of `regions.stable_region` and `trajectory.simulate`.
        """
        return self._shown("picture", ax)


@part("tune")
def tune(
    system: Model,
    demands: TuningSpec,
    *,
    seconds: float = math.inf,
    progress: Progress | None = None,
) -> Tuning:
    """Find the best gains, and prove that they bear all that is asked.

    Parameters
    ----------
    system, demands
        The compiled scene, and what `read_demands` read for it.
    seconds
        How long to go on; the best found until then is the answer, with what is not proved of it.
    progress
        Is told how far it is.

    Raises
    ------
    ApcError
        Those of the analysis that the scene needs, such as E898 a network that can't be judged; of `feel`;
        E996 what is asked about hands is felt nowhere.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        return _Work(system, demands, time.monotonic() + seconds, progress or (lambda _: None)).done()


@dataclass(eq=False)
class _Work:
    """The work: its scenarios grow."""

    system: Model
    demands: TuningSpec
    until: float
    progress: Progress
    scenarios: list[Scenario] = field(default_factory=list)
    looked: int = 0

    def __post_init__(self) -> None:
        self.limits = ConstraintSet(self.system, prepare(self.system), self.demands, self.until)
        # What can't be felt anywhere is refused before anything is looked for.
        asked = [felt for felt in self.demands.felt if felt.name in RESPONSES]
        asked += [felt for felt in self.demands.measured if felt.name == HINF]
        if asked:
            felt_in(self.system, asked, self.limits.prepared)
        self.every = self.limits.every()
        self.present = np.array(
            [float(value_now(self.system, interval.free)) for interval in self.demands.free]
        )
        first = len(self.every) // len(self.limits.settings)
        self.scenarios = list(dict.fromkeys((self.every[0], self.every[-first])))
        if self.demands.changing:
            try:
                self.limits.changing(0, np.array([[*self.present, *self.every[0].point]]))
            except NotSupportedError as why:
                raise ApcError(Diagnostic("E996", SUBJECT, f"{CHANGING} can't be decided: {why}")) from None
        if self.demands.aim.terms:
            self._with_level()

    def _with_level(self) -> None:
        """Find where the aim's level is looked for: from the best that is known on."""
        search = ScenarioOptimizer(self.limits, self.scenarios, None)
        points = np.vstack([self.present, search.gains(search.even)])
        sums = self.limits.sums(self.scenarios, points)
        known = sums[np.isfinite(sums)]
        if not len(known):
            what = f"nothing is known of {self.demands.aim.label} with any gains that were looked at"
            raise ApcError(Diagnostic("E996", PLACE, what, hint="wider ranges, or another aim"))
        best = float(known.max() if self.demands.aim.larger else known.min())
        scale = abs(best) or float(np.abs(known).max()) or 1.0
        name, unit = ParameterRef(self.demands.aim.label), self.demands.aim.unit
        level = Range(name, unit, Fraction(best), Fraction(best) + Fraction(scale))
        self.demands = replace(self.demands, aim=replace(self.demands.aim, level=level, scale=scale))
        self.limits = replace(self.limits, demands=self.demands)
        self.present = np.append(self.present, best)

    @property
    def _unproved(self) -> bool:
        """Whether nothing proves what is asked, beside that it is stable."""
        decays = self.limits.by_growth and (self.demands.decay < 1 or self.demands.aim.column is None)
        boxed = self.demands.criterion == PASSIVE and self.demands.box
        felt = self.demands.measured and (self.demands.box or self.demands.delay)
        gains = any(
            felt.name == HINF for felt in self.demands.measured
        )  # right to an error, not bounded by it
        return decays or gains or bool(boxed or felt)

    @property
    def late(self) -> bool:
        return self.limits.late

    def done(self) -> Tuning:
        aim = self.demands.aim
        starts: list[Floats] = []
        while True:
            optimum = self._borne(aim.column, starts)
            if aim.column is not None and optimum.worst > BINDS:  # perhaps they only were not found
                least = self._borne(None, [])
                if least.worst > 0:
                    return self._unmet(least)
                optimum = self._borne(aim.column, [self._shares(least)])
            if aim.column is None and self.demands.decay < 1 and optimum.worst > BINDS:
                return self._unmet(optimum)
            gains, proofs, failed = self._settled(optimum)
            if failed is None or self.late:
                return self._answer(optimum, gains, proofs)
            self.scenarios.append(failed)
            starts = [self._shares(optimum)]

    def _shares(self, optimum: Optimum) -> Floats:
        return ScenarioOptimizer(self.limits, self.scenarios, None).shares(optimum)

    def _borne(self, column: int | None, starts: list[Floats]) -> Optimum:
        """Return the best of all scenarios, those added that limit it more than those there are."""
        sign = 1.0 if self.demands.aim.larger else -1.0
        begun: list[Floats] = []
        for turn in itertools.count():
            self.progress(f"looking for gains in {len(self.scenarios)} of {len(self.every)} scenarios")
            search = ScenarioOptimizer(self.limits, self.scenarios, column, sign)
            if not starts:
                starts = begun = search.start(self.present, self.every)
                for start in starts:
                    self.limits.heard(self.scenarios, search.gains(start))
            optimum = search.best(starts)
            self.looked += optimum.looked
            bound = optimum.rows.scenario[optimum.multipliers > 0]
            if turn < DROPPING and len(bound):  # what limits nothing is looked at again with all others
                self.scenarios = [scenario for place, scenario in enumerate(self.scenarios) if place in bound]
            level = max(optimum.worst, 0.0 if column is not None else -math.inf)
            starts = [search.shares(optimum)]
            if self._added(optimum.gains, level) or self.limits.heard(self.scenarios, optimum.gains):
                if not self.late:
                    continue
                return search.at(begun[0]) if begun else optimum
            ahead = search.start(self.present, self.every, than=optimum)
            if self.late or not ahead:
                return optimum
            starts += ahead
        raise AssertionError("turns never end")

    def _added(self, gains: Floats, level: float) -> bool:
        """Add the scenarios that limit gains by more than a level; say whether there were any."""
        worst = self.limits.worst(self.every, gains[None])[0]
        order = np.argsort(-worst)
        new = [self.every[place] for place in order[:MORE] if worst[place] > level + ABOVE]
        new = [item for item in new if item not in self.scenarios]
        if not new and self.demands.box and not self.limits.slow:
            nearest = dict.fromkeys(self.every[place].setting for place in order.tolist())
            within = (self.limits.worst_within(item, gains) for item in list(nearest)[:MOST_LIMITED])
            new = [
                scenario
                for scenario, value in within
                if value > level + ABOVE and scenario not in self.scenarios
            ]
        self.scenarios += new
        return bool(new)

    def _settled(self, optimum: Optimum) -> tuple[list[Fraction], list[Proved], Scenario | None]:
        """Return gains as they are typed, what is proved of them, and a scenario that they don't bear."""
        column = self.demands.aim.column
        shares: tuple[float, ...] = BACK if self._unproved or not self.demands.over else BACK_IN_BOX
        if column is None:
            shares = (0.0,)
        elif not optimum.multipliers.any():  # the end of a range, which leaves room
            shares = (0.0, *shares)
        left = list(shares)
        while True:
            gains = self._typed(optimum, left[0])
            point = np.array([float(gain) for gain in gains])
            if column is not None and not self.late and self._added(point, -ABOVE):
                continue
            held = column is None or float(self.limits.worst(self.every, point[None]).max()) < 0
            last = self.late or len(left) == 1
            if held or last:
                proofs, failed = self._proofs(gains, whole=last)
                proved = self._unproved or all(proof.proof.stable for proof in proofs)
                if failed is not None or last or proved:
                    return gains, proofs, failed
            del left[0]

    def _typed(self, optimum: Optimum, share: float) -> list[Fraction]:
        """Return gains to as few digits as bear the scenarios, what is best of them less a share of it."""
        aim, free = self.demands.aim, self.demands.free
        best = self.limits.worst(self.scenarios, optimum.gains[None]).max()
        room = 0.0 if aim.column is not None else best + NEARLY * abs(best)
        values, binds = optimum.gains.copy(), optimum.multipliers > 0
        if aim.column is not None and binds.any():
            # As far inside of all that binds at once, which costs the aim this share.
            width = np.array([float(interval.high - interval.low) for interval in self.demands.columns])
            inwards = np.linalg.lstsq(optimum.rows.slopes[binds], -np.ones(binds.sum()), rcond=None)[0]
            cost = float(width[aim.column] * optimum.multipliers.sum())
            values += share * abs(values[aim.column]) / cost * width * inwards
        gains: list[Fraction] = []
        for digits in range(DIGITS if self.late else 1, DIGITS + 1):
            gains = [_decimal(value, digits) for value in values.tolist()]
            if aim.column is not None:
                gains[aim.column] = self._back(float(optimum.gains[aim.column]), share)
            pairs = zip(gains, free, strict=False)
            gains[: len(free)] = [min(max(gain, interval.low), interval.high) for gain, interval in pairs]
            point = np.array([[float(gain) for gain in gains]])
            if self.limits.worst(self.scenarios, point).max() <= room:
                break
        if aim.level:
            gains[-1] = self._worth(gains)
        return gains

    def _worth(self, gains: Sequence[Fraction]) -> Fraction:
        """Return the level that an aim keeps with gains in every scenario, rounded to where it is kept."""
        point = np.array([float(gain) for gain in gains])
        larger, sums = self.demands.aim.larger, self.limits.sums(self.every, point[None])
        worst = float(sums.min() if larger else sums.max())
        if not math.isfinite(worst):
            return gains[-1]
        margin = (-1 if larger else 1) * SLACK * self.demands.aim.scale
        return _decimal(worst + margin, DIGITS + 1, ROUND_FLOOR if larger else ROUND_CEILING)

    def _back(self, value: float, share: float) -> Fraction:
        """Return a gain less a share of it, rounded to the side where it does less."""
        larger = self.demands.aim.larger
        moved = value * (1 - share if larger == (value > 0) else 1 + share)
        return _decimal(moved, DIGITS, ROUND_FLOOR if larger else ROUND_CEILING)

    def _proofs(self, gains: Sequence[Fraction], *, whole: bool) -> tuple[list[Proved], Scenario | None]:
        """Return what is proved of gains with each number of peers, those first that limit them most.

        Without `whole` only as far as one that is left open.
        """
        inside = self._inside(gains)
        delay, counts = self.demands.delay, self.demands.counts
        ranges = [*([delay] if delay else []), *self.demands.box]
        changes = [
            Override(interval.free, value) for interval, value in zip(self.demands.free, gains, strict=False)
        ]
        point = np.array([[float(gain) for gain in gains]])
        worst = self.limits.worst(self.every, point)[0]
        order: dict[tuple[Override, ...], None] = {}
        for place in np.argsort(-worst, kind="stable"):
            numbers, _ = self.limits.settings[self.every[place].setting]
            order[numbers[: len(counts)]] = None
        proveds: list[Proved] = []
        for numbers in order:
            named = tuple((number.free.label, int(number.value)) for number in numbers)
            if self.late:
                proveds.append(Proved(named, _unlooked(self.system.name, ranges)))
                continue
            self.progress(f"proving {len(proveds) + 1} of {len(order)}")
            scene = apply(self.system, [*changes, *numbers])
            passive = self.demands.criterion == PASSIVE
            if passive and self.demands.box:
                proveds.append(
                    Proved(named, replace(_unlooked(self.system.name, ranges), notes=(ONE_BY_ONE,)))
                )
                continue
            inner = 1.0 if self.limits.by_growth else inside
            try:
                proof = proved_at(scene, ranges, passive=passive, inside=inner)
            except ApcError as error:
                if not ranges:
                    raise
                # No box of such scenes is proved, as of those that are not linear.
                proof = replace(_unlooked(self.system.name, ranges), notes=(error.mistakes[0].what,))
            if proof.stable and (self._unproved or not self._felt(numbers, point)):
                proof = replace(proof, verdict=UNDECIDED, stable=None, notes=(*proof.notes, SLOWER))
            if proof.stable and self.demands.changing and not self._stable_if_changing(scene):
                note = CHANGES_IN_BOX if self.demands.box else CHANGES
                proof = replace(proof, verdict=UNDECIDED, stable=None, notes=(*proof.notes, note))
            proveds.append(Proved(named, proof))
            if proof.stable is False:
                return proveds, self._failed(numbers, proof, ranges)
            if not (proof.stable or whole):
                break
        return proveds, None

    def _stable_if_changing(self, scene: Model) -> bool:
        """Return whether a scene is proved stable under a delay that changes, where nothing else varies."""
        delay = self.demands.delay
        if delay is None or self.demands.box:
            return False
        try:
            return loop_gain(scene, delay.free, delay.low, delay.high) < 1
        except NotSupportedError:
            return False

    def _changing(
        self, gains: Sequence[Fraction], proofs: Sequence[Proved]
    ) -> Iterator[tuple[tuple[tuple[str, int], ...], ChangingDelay]]:
        """Yield what is proved under a delay that changes, with each number of peers that has a proof."""
        demands = self.demands
        if demands.delay is None or demands.criterion != NOMINAL:
            return
        pairs = zip(demands.free, gains, strict=False)
        changes = [Override(interval.free, value) for interval, value in pairs]
        for item in proofs:
            found = item.proof.changing
            if found is None and item.proof.stable is not False and not self.late:
                values = zip(demands.counts, item.counts, strict=True)
                counts = [Override(count.free, Fraction(number)) for count, (_, number) in values]
                found = changing(apply(self.system, [*changes, *counts]), demands.delay)
            if found is not None:
                yield item.counts, found

    def _felt(self, numbers: tuple[Override, ...], point: Floats) -> bool:
        """Say whether it is proved that what is felt is as asked, where only numbers of peers vary."""
        places = [place for place, (overrides, _) in enumerate(self.limits.settings) if overrides == numbers]
        result = [self.limits.asked(place, point, bounded=True).max(initial=-1.0) for place in places]
        return max(result, default=-1.0) < 0

    def _inside(self, gains: Sequence[Fraction]) -> float:
        """Return what the spectral radius is to be proved below: of the least there is, a little above it."""
        if self.demands.aim.column is not None or self.limits.by_growth:
            return math.exp(self.limits.allowed)
        point = np.array([[float(gain) for gain in gains]])
        least = 1 - math.exp(float(self.limits.worst(self.every, point).max()) + self.limits.allowed)
        return float(1 - _decimal(least * (1 - BACK[-1]), DIGITS, ROUND_FLOOR))

    def _failed(
        self, numbers: tuple[Override, ...], proof: RobustStability, ranges: Sequence[Range]
    ) -> Scenario | None:
        """Return the scenario in which gains are proved not to hold; None where it is one already."""
        values = dict(zip([interval.free for interval in ranges], proof.point, strict=False))
        late = self.demands.delay and values.get(self.demands.delay.free)
        for place, (overrides, _) in enumerate(self.limits.settings):
            here = len(overrides) == len(numbers) or float(overrides[-1].value) == late
            if overrides[: len(numbers)] == numbers and here:
                box = tuple(values[interval.free] for interval in self.demands.box)
                scenario = Scenario(place, box)
                return None if scenario in self.scenarios else scenario
        return None

    def _unmet(self, least: Optimum) -> Tuning:
        """Return that no gains were found that meet all demands, and those that miss them least."""
        gains = [_decimal(value, DIGITS) for value in least.gains.tolist()]
        if self.demands.aim.level:
            gains[-1] = self._worth(gains)
        return self._answer(least, gains, [], met=False)

    def _answer(
        self, optimum: Optimum, gains: Sequence[Fraction], proofs: Sequence[Proved], *, met: bool = True
    ) -> Tuning:
        demands, column = self.demands, self.demands.aim.column
        worst = float(self.limits.worst(self.every, np.array([[float(gain) for gain in gains]])).max())
        met = met and (column is None or worst < 0)
        value = float(gains[column]) if column is not None else self._inside(gains)
        if column is None and self.limits.by_growth:
            value = math.exp(worst + self.limits.allowed)
        best, error = (
            (optimum.value, optimum.error) if column is not None else (math.exp(optimum.value), optimum.error)
        )
        if column is not None and not met:
            best = value if demands.aim.level else float(optimum.gains[column])
        return Tuning(
            topology=self.system.name,
            aim=demands.aim.label,
            unit=demands.aim.unit,
            larger=demands.aim.larger,
            met=met,
            proved=met and bool(proofs) and all(proof.proof.stable for proof in proofs),
            value=value,
            best=best,
            error=error,
            worst=worst,
            gains=tuple(
                Gain(
                    interval.free.label,
                    interval.unit,
                    float(interval.low),
                    float(interval.high),
                    typed,
                    float(before),
                    float(now),
                )
                for interval, typed, before, now in zip(
                    demands.free, gains, optimum.gains, self.present, strict=False
                )
            ),
            over=demands.over,
            criterion=demands.criterion,
            decay=demands.decay,
            felt=demands.felt,
            delay=demands.delay,
            changing=tuple(self._changing(gains, proofs)) if met else (),
            demanded=demands.changing,
            frame_s=float(self.limits.prepared.schedules[0].frame_s),
            allowed=self.limits.allowed,
            proofs=tuple(proofs),
            binding=tuple(self._binding(optimum, met=met)),
            looked=self.looked
            + sum(int((sample != BEYOND).sum()) for sample in self.limits.samples.values()),
            bounded=self._bounded(optimum, gains) if met else None,
            notes=(
                *[why for why in (self._why(),) if why and not met],
                *[CORNERS] * bool(demands.box and self.limits.slow),
                *[LATE] * (self.late and not met),
            ),
            left_out=(
                *near_start(self.system, self.limits.prepared),
                *left_out(
                    self.system,
                    network=demands.criterion != MEAN_SQUARE,
                    varied=[interval.free for interval in demands.over],
                ),
            ),
            ranges=demands.free,
            scenes=tuple(map(self._scene, self._binding_scenarios(optimum) or self.every[:1])),
        )

    def _why(self) -> str:
        """Return why no gains bear passive hands, where that follows from the equations alone."""
        return passive_hands(self.system).why if self.demands.criterion == PASSIVE else ""

    def _bounded(self, optimum: Optimum, gains: Sequence[Fraction]) -> int | None:
        """Return in how many cells it is proved that no gains do better, see `none_better`."""
        demands, column = self.demands, self.demands.aim.column
        if (
            column is None
            or not optimum.multipliers.any()
            or self.limits.by_growth
            or demands.measured
            or demands.changing
            or demands.aim.level
        ):
            return None
        worst = self.limits.worst(self.every, np.array([[float(gain) for gain in gains]]))[0]
        order = np.argsort(-worst, kind="stable").tolist()
        listed = dict.fromkeys([*self._binding_scenarios(optimum), *(self.every[place] for place in order)])
        self.progress("proving that no gains do better")
        return none_better(
            [self._scene(item) for item in list(listed)[:LIMITING]],
            self.limits.prepared,
            demands.free,
            column,
            value=gains[column],
            larger=demands.aim.larger,
            inside=self._inside(gains),
            until=self.until,
        )

    def _binding_scenarios(self, optimum: Optimum) -> list[Scenario]:
        """Return the scenario of each mode that binds."""
        return [optimum.scenarios[place] for place in optimum.rows.scenario[optimum.multipliers > 0].tolist()]

    def _scene(self, scenario: Scenario) -> Model:
        _, scene = self.limits.settings[scenario.setting]
        pairs = zip(self.demands.box, map(Fraction, scenario.point), strict=True)
        return apply(scene, [Override(interval.free, value) for interval, value in pairs])

    def _binding(self, optimum: Optimum, *, met: bool) -> list[ActiveConstraint]:
        """Return what binds: each mode with a multiplier, and what less of the ends that meet there buys."""
        bindings = []
        aim = self.demands.aim.column
        rows = self.limits.rows(optimum.scenarios, optimum.gains, wide=True)
        scale = 1.0
        if aim is not None and met:
            column = self.demands.columns[aim]
            scale = float(column.high - column.low) * (1 if self.demands.aim.larger else -1)
        for place in np.flatnonzero(optimum.multipliers > 0):
            scenario = optimum.scenarios[rows.scenario[place]]
            numbers, _ = self.limits.settings[scenario.setting]
            buys = []
            slopes = rows.slopes[place][len(self.demands.columns) :]
            for own, value, slope in zip(self.demands.box, scenario.point, slopes, strict=True):
                if value in (float(own.low), float(own.high)):
                    share = 0.01 * abs(value) / float(own.high - own.low)
                    change = -share if value == float(own.high) else share
                    better = -scale * float(optimum.multipliers[place]) * float(slope) * change
                    buys.append((own.free.label, value, own.unit, better))
            where = [
                (number.free.label, float(number.value), "1")
                for number in numbers[: len(self.demands.counts)]
            ]
            where += [
                (number.free.label, float(number.value), "s")
                for number in numbers[len(self.demands.counts) :]
            ]
            where += [
                (interval.free.label, value, interval.unit)
                for interval, value in zip(self.demands.box, scenario.point, strict=True)
            ]
            shape, frequency = self._mode(optimum, scenario, complex(rows.eigenvalue[place]))
            if not math.isnan(rows.frequency_hz[place]):
                frequency = float(rows.frequency_hz[place])
            bindings.append(ActiveConstraint(tuple(where), shape, frequency, tuple(buys)))
        return bindings

    def _mode(self, optimum: Optimum, scenario: Scenario, eigenvalue: complex) -> tuple[str, float]:
        """Return the shape and the frequency of a mode, "" and NaN where there is none."""
        passive = self.demands.criterion == PASSIVE
        if np.isnan(eigenvalue) and not (passive and not self.demands.measured):
            return "", math.nan
        pairs = zip(self.demands.free, map(Fraction, optimum.gains.tolist()), strict=False)
        changed = apply(self._scene(scenario), [Override(interval.free, value) for interval, value in pairs])
        if passive:
            worst = passive_hands(changed).worst
            return ("", math.nan) if worst is None else (worst.name, worst.frequency_hz or math.nan)
        try:
            modes = analyze(changed).modes
        except ApcError:
            return "", math.nan
        if not len(modes):
            return "", math.nan
        nearest = min(modes, key=lambda mode: abs(mode.eigenvalue - eigenvalue))
        return nearest.shape, nearest.frequency_hz


def _decimal(value: float, digits: int, rounding: str = ROUND_HALF_EVEN) -> Fraction:
    """Return a number to so many digits, as the decimal that a person types."""
    number = Decimal(repr(float(value)))
    place = number.adjusted() - digits + 1
    return Fraction(number.quantize(Decimal((0, (1,), place)), rounding=rounding)) if number else Fraction(0)


def _unlooked(name: str, ranges: Sequence[Range]) -> RobustStability:
    """Return what is proved where the time was up."""
    return RobustStability(name, tuple(ranges), UNDECIDED, None, 0, 1.0, (), ("the time was up",))
