"""Optimal gains under all specified demands, rounded to few digits and proved.

Takes: a `Model` and `TuningSpec`.
Gives: `Gain`, `ActiveConstraint`, `Proved`, `Tuning`, `tune`.
Guarantees: a result marked proved is proved by the model's analysis at the printed gains; all others are
marked unproved.
Does not: prove global optimality, except within 2 % for at most three gains over a nominal network.

Gains are first optimized for a few scenarios. Another corner, number of peers or delay with a larger
constraint is then added as a scenario. The gains are rounded to the fewest digits that satisfy the scenarios,
and the objective is relaxed step by step until the proof succeeds.
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
from apc.analysis.robust_stability import UNDECIDED, ChangingDelay, RobustStability
from apc.analysis_report import proved_at
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.timings import part
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import prepare
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, Range, value_now
from apc.haptics.absolute_stability import absolute_stability
from apc.mean_square.time_varying_delay import loop_gain
from apc.network.nominal_criterion import limitations
from apc.not_supported import NotSupportedError
from apc.parameter_studies.crossing import Progress
from apc.parameter_studies.delay_interval_proof import changing
from apc.parameter_studies.stability_criteria import MEAN_SQUARE, NOMINAL, PASSIVE
from apc.result import Result
from apc.threads import single_threaded
from apc.tuning.constraints import BEYOND, RESPONSES, ConstraintSet, Scenario, transparency_in
from apc.tuning.optimality_bound import none_better
from apc.tuning.scenario_optimizer import BINDS, Optimum, ScenarioOptimizer
from apc.tuning.specification import CHANGING, CONSTRAINT, HINF, LOCATION, TransparencyMetric, TuningSpec

Floats = NDArray[np.float64]

# Significant digits that a person types.
DIGITS = 4

# The relative worsening allowed for rounding a constraint beyond its minimum.
NEARLY = 1e-4

# Steps by which the objective is relaxed until the gains are proved, as shares of the optimum. With a box the
# first step is larger: near a constraint, the cells are small and very numerous.
BACK = (0.0, 1e-4, 1e-3, 1e-2)
BACK_IN_BOX = (5e-3, 1e-2)

# The relative distance of a level from the bounded value: far above rounding, below the printed digits.
SLACK = 1e-5

# The text if only stability is proved.
SLOWER = "stable is proved; how fast motions die out, or what is felt, is only looked at scenario by scenario"

# Text for the demand of every passive hand in a box.
POINTWISE = "no box is proved with every passive hand: it is so in the scenarios looked at"

# The texts for a time-varying delay without proof, and for one with a box.
CHANGES = "with a delay that changes from packet to packet it is not proved stable"
CHANGES_IN_BOX = "no box is proved with a delay that changes: it is so in the scenarios evaluated"

# The text if the search for the worst point of a box is too slow.
CORNERS = (
    "before rounding: the ends and the middle of each range in a box were looked at, and no point between"
)

# The text if no gains that satisfy all demands were found in time.
TIMED_OUT = "the time was up: these gains are those that were looked at last"

# Scenarios added at a time; how far above the others a limit is that counts.
MORE, ABOVE = 3, 1e-9

# Number of settings in which the worst interior point of a box is searched, starting with the largest
# constraints at corners.
MOST_LIMITED = 8

# Scenarios, those first that limit gains most, in one of which gains that would do better are unstable.
LIMITING = 12

# Turns in which scenarios that limit nothing are left out.
DROPPING = 6


@dataclass(frozen=True, slots=True)
class Gain:
    """A free gain: its decimal `value`, exact, the optimum before rounding, and its present value `now`."""

    parameter: str
    unit: str
    low: float
    high: float
    value: Fraction
    optimum: float
    current: float


@dataclass(frozen=True, slots=True)
class ActiveConstraint:
    """An active constraint: a mode in a scenario, or an end of a gain's range.

    `where` are the scenario's values as (label, value, unit). `family` and `frequency_hz` are those of the
    mode, "" and NaN if the criterion has none. `shadow_prices` are the active ends of the scenario ranges, as
    (label, end, unit, improvement of the objective for 1 % less).
    """

    where: tuple[tuple[str, float, str], ...]
    family: str
    frequency_hz: float
    shadow_prices: tuple[tuple[str, float, str, float], ...]


@dataclass(frozen=True, slots=True)
class Proved:
    """The proof for some numbers of peers, as (label, number): over all other ranges."""

    counts: tuple[tuple[str, int], ...]
    proof: RobustStability


@dataclass(frozen=True, slots=True)
class Tuning(Result):
    """The optimal gains, the proof, and the active constraints.

    `value` is the objective at the decimal gains, `optimum` that before rounding, within `error` (infinite if
    unknown); both are a spectral radius if that is the objective. `feasible` is whether the gains satisfy all
    demands in floats; `proved` whether all are proved. `worst_case` is the largest constraint (see
    `constraints`), ln |λ| per frame minus the `allowed` value, below 0 if all are satisfied. `decay` is a
    factor per second. `delay` is the one of `over` that a link has, at every constant value; `changing` is
    the result for a delay that varies from packet to packet, by numbers of peers as in `proofs`, with all
    other parameters at their present values, and `demanded` whether this stability is a demand. `topologies`
    are those of `active`, or one if nothing binds. `evaluations` is the number of evaluations. `bound_cells`
    is the number of cells in the proof that no gains in these ranges are better by `optimality_bound.SHARE`,
    None without proof.
    """

    shown_by = "tuning_output:tuning"

    topology: str
    objective: str
    unit: str
    maximize: bool
    feasible: bool
    proved: bool
    value: float
    optimum: float
    error: float
    worst_case: float
    gains: tuple[Gain, ...]
    over: tuple[Range, ...]
    criterion: str
    decay: float
    transparency_metrics: tuple[TransparencyMetric, ...]
    delay: Range | None
    changing: tuple[tuple[tuple[tuple[str, int], ...], ChangingDelay], ...]
    demanded: bool
    frame_s: float
    allowed: float
    proofs: tuple[Proved, ...]
    active: tuple[ActiveConstraint, ...]
    evaluations: int
    bound_cells: int | None
    notes: tuple[str, ...]
    limitations: tuple[str, ...]
    ranges: tuple[Range, ...] = field(compare=False, repr=False)
    topologies: tuple[Model, ...] = field(compare=False, repr=False)

    def plot(self, ax: Any = None) -> Any:
        """Draw two gains over the stable regions of the limiting scenarios, and a strike; return the Axes.

        A strike is simulated with the present and the tuned gains, in the scenario that limits them most.

        Raises
        ------
        ApcError
            E875 matplotlib is not installed; those of `regions.stable_region` and `trajectory.simulate`.
        """
        return self._shown("picture", ax)


@part("tune")
def tune(
    system: Model,
    spec: TuningSpec,
    *,
    seconds: float = math.inf,
    progress: Progress | None = None,
) -> Tuning:
    """Optimize the gains, and prove that they satisfy all demands.

    Parameters
    ----------
    system, spec
        The model, and its specification from `read_tuning_spec`.
    seconds
        The time limit; the best result until then is returned, with its unproved demands.
    progress
        Called with the progress.

    Raises
    ------
    ApcError
        Those of the analyses, such as E898 an unsupported network; of `transparency`; E996 a transparency
        metric is undefined everywhere.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        return _Work(system, spec, time.monotonic() + seconds, progress or (lambda _: None)).done()


@dataclass(eq=False)
class _Work:
    """The work: its scenarios grow."""

    system: Model
    spec: TuningSpec
    until: float
    progress: Progress
    scenarios: list[Scenario] = field(default_factory=list)
    evaluations: int = 0

    def __post_init__(self) -> None:
        self.constraints = ConstraintSet(self.system, prepare(self.system), self.spec, self.until)
        # A metric that is undefined everywhere is refused before the search.
        requested = [metric for metric in self.spec.transparency_metrics if metric.name in RESPONSES]
        requested += [metric for metric in self.spec.measured if metric.name == HINF]
        if requested:
            transparency_in(self.system, requested, self.constraints.prepared)
        self.every = self.constraints.every()
        self.present = np.array([float(value_now(self.system, interval.free)) for interval in self.spec.free])
        first = len(self.every) // len(self.constraints.settings)
        self.scenarios = list(dict.fromkeys((self.every[0], self.every[-first])))
        if self.spec.changing:
            try:
                self.constraints.changing(0, np.array([[*self.present, *self.every[0].point]]))
            except NotSupportedError as why:
                raise ApcError(
                    Diagnostic("E996", CONSTRAINT, f"{CHANGING} can't be decided: {why}")
                ) from None
        if self.spec.objective.terms:
            self._with_level()

    def _with_level(self) -> None:
        """Determine the search range of the objective's level, from the best known value on."""
        search = ScenarioOptimizer(self.constraints, self.scenarios, None)
        points = np.vstack([self.present, search.gains(search.even)])
        sums = self.constraints.sums(self.scenarios, points)
        known = sums[np.isfinite(sums)]
        if not len(known):
            message = f"nothing is known of {self.spec.objective.label} with any gains that were looked at"
            raise ApcError(Diagnostic("E996", LOCATION, message, hint="wider ranges, or another aim"))
        best = float(known.max() if self.spec.objective.maximize else known.min())
        scale = abs(best) or float(np.abs(known).max()) or 1.0
        name, unit = ParameterRef(self.spec.objective.label), self.spec.objective.unit
        level = Range(name, unit, Fraction(best), Fraction(best) + Fraction(scale))
        self.spec = replace(self.spec, objective=replace(self.spec.objective, level=level, scale=scale))
        self.constraints = replace(self.constraints, spec=self.spec)
        self.present = np.append(self.present, best)

    @property
    def _unproved(self) -> bool:
        """Whether the demands beyond stability have no proof method."""
        decays = self.constraints.by_scalar_criterion and (
            self.spec.decay < 1 or self.spec.objective.column is None
        )
        boxed = self.spec.criterion == PASSIVE and self.spec.box
        transparency_metrics = self.spec.measured and (self.spec.box or self.spec.delay)
        gains = any(
            metric.name == HINF for metric in self.spec.measured
        )  # right to an error, not bounded by it
        return decays or gains or bool(boxed or transparency_metrics)

    @property
    def timed_out(self) -> bool:
        return self.constraints.timed_out

    def done(self) -> Tuning:
        objective = self.spec.objective
        starts: list[Floats] = []
        while True:
            optimum = self._optimize_scenarios(objective.column, starts)
            if (
                objective.column is not None and optimum.worst_case > BINDS
            ):  # perhaps they only were not found
                least = self._optimize_scenarios(None, [])
                if least.worst_case > 0:
                    return self._unmet(least)
                optimum = self._optimize_scenarios(objective.column, [self._shares(least)])
            if objective.column is None and self.spec.decay < 1 and optimum.worst_case > BINDS:
                return self._unmet(optimum)
            gains, proofs, failed = self._settled(optimum)
            if failed is None or self.timed_out:
                return self._answer(optimum, gains, proofs)
            self.scenarios.append(failed)
            starts = [self._shares(optimum)]

    def _shares(self, optimum: Optimum) -> Floats:
        return ScenarioOptimizer(self.constraints, self.scenarios, None).shares(optimum)

    def _optimize_scenarios(self, column: int | None, starts: list[Floats]) -> Optimum:
        """Return the best of all scenarios, those added that limit it more than those there are."""
        sign = 1.0 if self.spec.objective.maximize else -1.0
        begun: list[Floats] = []
        for turn in itertools.count():
            self.progress(f"looking for gains in {len(self.scenarios)} of {len(self.every)} scenarios")
            search = ScenarioOptimizer(self.constraints, self.scenarios, column, sign)
            if not starts:
                starts = begun = search.start(self.present, self.every)
                for start in starts:
                    self.constraints.with_frequencies(self.scenarios, search.gains(start))
            optimum = search.best_point(starts)
            self.evaluations += optimum.evaluations
            bound = optimum.rows.scenario[optimum.multipliers > 0]
            if turn < DROPPING and len(bound):  # re-evaluate inactive ones with all others
                self.scenarios = [scenario for index, scenario in enumerate(self.scenarios) if index in bound]
            level = max(optimum.worst_case, 0.0 if column is not None else -math.inf)
            starts = [search.shares(optimum)]
            if self._added(optimum.gains, level) or self.constraints.with_frequencies(
                self.scenarios, optimum.gains
            ):
                if not self.timed_out:
                    continue
                return search.at(begun[0]) if begun else optimum
            ahead = search.start(self.present, self.every, than=optimum)
            if self.timed_out or not ahead:
                return optimum
            starts += ahead
        raise AssertionError("turns never end")

    def _added(self, gains: Floats, level: float) -> bool:
        """Add the scenarios with constraints above a level; return whether there were any."""
        worst = self.constraints.worst_case(self.every, gains[None])[0]
        order = np.argsort(-worst)
        new = [self.every[index] for index in order[:MORE] if worst[index] > level + ABOVE]
        new = [item for item in new if item not in self.scenarios]
        if not new and self.spec.box and not self.constraints.slow:
            nearest = dict.fromkeys(self.every[index].setting for index in order.tolist())
            within = (
                self.constraints.worst_case_within(item, gains) for item in list(nearest)[:MOST_LIMITED]
            )
            new = [
                scenario
                for scenario, value in within
                if value > level + ABOVE and scenario not in self.scenarios
            ]
        self.scenarios += new
        return bool(new)

    def _settled(self, optimum: Optimum) -> tuple[list[Fraction], list[Proved], Scenario | None]:
        """Return decimal gains, their proof, and a scenario that they violate."""
        column = self.spec.objective.column
        shares: tuple[float, ...] = BACK if self._unproved or not self.spec.over else BACK_IN_BOX
        if column is None:
            shares = (0.0,)
        elif not optimum.multipliers.any():  # the end of a range, which leaves room
            shares = (0.0, *shares)
        left = list(shares)
        while True:
            gains = self._rounded_gains(optimum, left[0])
            point = np.array([float(gain) for gain in gains])
            if column is not None and not self.timed_out and self._added(point, -ABOVE):
                continue
            held = column is None or float(self.constraints.worst_case(self.every, point[None]).max()) < 0
            last = self.timed_out or len(left) == 1
            if held or last:
                proofs, failed = self._proofs(gains, whole=last)
                proved = self._unproved or all(proof.proof.stable for proof in proofs)
                if failed is not None or last or proved:
                    return gains, proofs, failed
            del left[0]

    def _rounded_gains(self, optimum: Optimum, share: float) -> list[Fraction]:
        """Return gains with the fewest digits that satisfy the scenarios, with a relaxed objective."""
        objective, free = self.spec.objective, self.spec.free
        best = self.constraints.worst_case(self.scenarios, optimum.gains[None]).max()
        room = 0.0 if objective.column is not None else best + NEARLY * abs(best)
        values, binds = optimum.gains.copy(), optimum.multipliers > 0
        if objective.column is not None and binds.any():
            # As far inside of all that binds at once, which costs the aim this share.
            width = np.array([float(interval.high - interval.low) for interval in self.spec.columns])
            inwards = np.linalg.lstsq(optimum.rows.slopes[binds], -np.ones(binds.sum()), rcond=None)[0]
            cost = float(width[objective.column] * optimum.multipliers.sum())
            values += share * abs(values[objective.column]) / cost * width * inwards
        gains: list[Fraction] = []
        for digits in range(DIGITS if self.timed_out else 1, DIGITS + 1):
            gains = [_decimal(value, digits) for value in values.tolist()]
            if objective.column is not None:
                gains[objective.column] = self._back(float(optimum.gains[objective.column]), share)
            pairs = zip(gains, free, strict=False)
            gains[: len(free)] = [min(max(gain, interval.low), interval.high) for gain, interval in pairs]
            point = np.array([[float(gain) for gain in gains]])
            if self.constraints.worst_case(self.scenarios, point).max() <= room:
                break
        if objective.level:
            gains[-1] = self._worth(gains)
        return gains

    def _worth(self, gains: Sequence[Fraction]) -> Fraction:
        """Return the level that an aim keeps with gains in every scenario, rounded to where it is kept."""
        point = np.array([float(gain) for gain in gains])
        larger, sums = self.spec.objective.maximize, self.constraints.sums(self.every, point[None])
        worst = float(sums.min() if larger else sums.max())
        if not math.isfinite(worst):
            return gains[-1]
        margin = (-1 if larger else 1) * SLACK * self.spec.objective.scale
        return _decimal(worst + margin, DIGITS + 1, ROUND_FLOOR if larger else ROUND_CEILING)

    def _back(self, value: float, share: float) -> Fraction:
        """Return a gain less a share of it, rounded to the side where it does less."""
        larger = self.spec.objective.maximize
        moved = value * (1 - share if larger == (value > 0) else 1 + share)
        return _decimal(moved, DIGITS, ROUND_FLOOR if larger else ROUND_CEILING)

    def _proofs(self, gains: Sequence[Fraction], *, whole: bool) -> tuple[list[Proved], Scenario | None]:
        """Return the proofs for each number of peers, starting with the largest constraint.

        Without `whole` only as far as one that is left open.
        """
        inside = self._inside(gains)
        delay, counts = self.spec.delay, self.spec.counts
        ranges = [*([delay] if delay else []), *self.spec.box]
        changes = [
            Override(interval.free, value) for interval, value in zip(self.spec.free, gains, strict=False)
        ]
        point = np.array([[float(gain) for gain in gains]])
        worst = self.constraints.worst_case(self.every, point)[0]
        order: dict[tuple[Override, ...], None] = {}
        for index in np.argsort(-worst, kind="stable"):
            numbers, _ = self.constraints.settings[self.every[index].setting]
            order[numbers[: len(counts)]] = None
        proveds: list[Proved] = []
        for numbers in order:
            named = tuple((number.free.label, int(number.value)) for number in numbers)
            if self.timed_out:
                proveds.append(Proved(named, _unlooked(self.system.name, ranges)))
                continue
            self.progress(f"proving {len(proveds) + 1} of {len(order)}")
            topology = apply(self.system, [*changes, *numbers])
            passive = self.spec.criterion == PASSIVE
            if passive and self.spec.box:
                proveds.append(
                    Proved(named, replace(_unlooked(self.system.name, ranges), notes=(POINTWISE,)))
                )
                continue
            inner = 1.0 if self.constraints.by_scalar_criterion else inside
            try:
                proof = proved_at(topology, ranges, passive=passive, inside=inner)
            except ApcError as error:
                if not ranges:
                    raise
                # No box of such models is proved, as of those that are not linear.
                proof = replace(_unlooked(self.system.name, ranges), notes=(error.mistakes[0].message,))
            if proof.stable and (self._unproved or not self._transparency_metrics(numbers, point)):
                proof = replace(proof, verdict=UNDECIDED, stable=None, notes=(*proof.notes, SLOWER))
            if proof.stable and self.spec.changing and not self._stable_if_changing(topology):
                note = CHANGES_IN_BOX if self.spec.box else CHANGES
                proof = replace(proof, verdict=UNDECIDED, stable=None, notes=(*proof.notes, note))
            proveds.append(Proved(named, proof))
            if proof.stable is False:
                return proveds, self._failed(numbers, proof, ranges)
            if not (proof.stable or whole):
                break
        return proveds, None

    def _stable_if_changing(self, topology: Model) -> bool:
        """Return whether a model is proved stable under a delay that changes, where nothing else varies."""
        delay = self.spec.delay
        if delay is None or self.spec.box:
            return False
        try:
            return loop_gain(topology, delay.free, delay.low, delay.high) < 1
        except NotSupportedError:
            return False

    def _changing(
        self, gains: Sequence[Fraction], proofs: Sequence[Proved]
    ) -> Iterator[tuple[tuple[tuple[str, int], ...], ChangingDelay]]:
        """Yield the proofs under a time-varying delay, for each number of peers with a proof."""
        spec = self.spec
        if spec.delay is None or spec.criterion != NOMINAL:
            return
        pairs = zip(spec.free, gains, strict=False)
        changes = [Override(interval.free, value) for interval, value in pairs]
        for item in proofs:
            result = item.proof.changing
            if result is None and item.proof.stable is not False and not self.timed_out:
                values = zip(spec.counts, item.counts, strict=True)
                counts = [Override(count.free, Fraction(number)) for count, (_, number) in values]
                result = changing(apply(self.system, [*changes, *counts]), spec.delay)
            if result is not None:
                yield item.counts, result

    def _transparency_metrics(self, numbers: tuple[Override, ...], point: Floats) -> bool:
        """Return whether the transparency demands are proved, if only numbers of peers vary."""
        indices = [
            index for index, (overrides, _) in enumerate(self.constraints.settings) if overrides == numbers
        ]
        result = [
            self.constraints.constraint_values(index, point, bounded=True).max(initial=-1.0)
            for index in indices
        ]
        return max(result, default=-1.0) < 0

    def _inside(self, gains: Sequence[Fraction]) -> float:
        """Return the limit of the spectral radius in the proof: slightly above the minimum."""
        if self.spec.objective.column is not None or self.constraints.by_scalar_criterion:
            return math.exp(self.constraints.allowed)
        point = np.array([[float(gain) for gain in gains]])
        least = 1 - math.exp(
            float(self.constraints.worst_case(self.every, point).max()) + self.constraints.allowed
        )
        return float(1 - _decimal(least * (1 - BACK[-1]), DIGITS, ROUND_FLOOR))

    def _failed(
        self, numbers: tuple[Override, ...], proof: RobustStability, ranges: Sequence[Range]
    ) -> Scenario | None:
        """Return the scenario in which gains are proved not to hold; None where it is one already."""
        values = dict(zip([interval.free for interval in ranges], proof.counterexample, strict=False))
        timed_out = self.spec.delay and values.get(self.spec.delay.free)
        for index, (overrides, _) in enumerate(self.constraints.settings):
            here = len(overrides) == len(numbers) or float(overrides[-1].value) == timed_out
            if overrides[: len(numbers)] == numbers and here:
                box = tuple(values[interval.free] for interval in self.spec.box)
                scenario = Scenario(index, box)
                return None if scenario in self.scenarios else scenario
        return None

    def _unmet(self, least: Optimum) -> Tuning:
        """Return that no gains were found that meet all demands, and those that miss them least."""
        gains = [_decimal(value, DIGITS) for value in least.gains.tolist()]
        if self.spec.objective.level:
            gains[-1] = self._worth(gains)
        return self._answer(least, gains, [], feasible=False)

    def _answer(
        self, optimum: Optimum, gains: Sequence[Fraction], proofs: Sequence[Proved], *, feasible: bool = True
    ) -> Tuning:
        spec, column = self.spec, self.spec.objective.column
        worst = float(
            self.constraints.worst_case(self.every, np.array([[float(gain) for gain in gains]])).max()
        )
        feasible = feasible and (column is None or worst < 0)
        value = float(gains[column]) if column is not None else self._inside(gains)
        if column is None and self.constraints.by_scalar_criterion:
            value = math.exp(worst + self.constraints.allowed)
        best, error = (
            (optimum.value, optimum.error) if column is not None else (math.exp(optimum.value), optimum.error)
        )
        if column is not None and not feasible:
            best = value if spec.objective.level else float(optimum.gains[column])
        return Tuning(
            topology=self.system.name,
            objective=spec.objective.label,
            unit=spec.objective.unit,
            maximize=spec.objective.maximize,
            feasible=feasible,
            proved=feasible and bool(proofs) and all(proof.proof.stable for proof in proofs),
            value=value,
            optimum=best,
            error=error,
            worst_case=worst,
            gains=tuple(
                Gain(
                    interval.free.label,
                    interval.unit,
                    float(interval.low),
                    float(interval.high),
                    rounded,
                    float(before),
                    float(now),
                )
                for interval, rounded, before, now in zip(
                    spec.free, gains, optimum.gains, self.present, strict=False
                )
            ),
            over=spec.over,
            criterion=spec.criterion,
            decay=spec.decay,
            transparency_metrics=spec.transparency_metrics,
            delay=spec.delay,
            changing=tuple(self._changing(gains, proofs)) if feasible else (),
            demanded=spec.changing,
            frame_s=float(self.constraints.prepared.schedules[0].frame_s),
            allowed=self.constraints.allowed,
            proofs=tuple(proofs),
            active=tuple(self._active(optimum, feasible=feasible)),
            evaluations=self.evaluations
            + sum(int((sample != BEYOND).sum()) for sample in self.constraints.samples.values()),
            bound_cells=self._optimality_bound(optimum, gains) if feasible else None,
            notes=(
                *[why for why in (self._why(),) if why and not feasible],
                *[CORNERS] * bool(spec.box and self.constraints.slow),
                *[TIMED_OUT] * (self.timed_out and not feasible),
            ),
            limitations=(
                *near_start(self.system, self.constraints.prepared),
                *limitations(
                    self.system,
                    network=spec.criterion != MEAN_SQUARE,
                    varied=[interval.free for interval in spec.over],
                ),
            ),
            ranges=spec.free,
            topologies=tuple(map(self._topology, self._active_scenarios(optimum) or self.every[:1])),
        )

    def _why(self) -> str:
        """Return the reason why no gains are stable with passive hands, if the equations imply it."""
        return absolute_stability(self.system).why if self.spec.criterion == PASSIVE else ""

    def _optimality_bound(self, optimum: Optimum, gains: Sequence[Fraction]) -> int | None:
        """Return in how many cells it is proved that no gains do better, see `none_better`."""
        spec, column = self.spec, self.spec.objective.column
        if (
            column is None
            or not optimum.multipliers.any()
            or self.constraints.by_scalar_criterion
            or spec.measured
            or spec.changing
            or spec.objective.level
        ):
            return None
        worst = self.constraints.worst_case(self.every, np.array([[float(gain) for gain in gains]]))[0]
        order = np.argsort(-worst, kind="stable").tolist()
        listed = dict.fromkeys([*self._active_scenarios(optimum), *(self.every[index] for index in order)])
        self.progress("proving that no gains do better")
        return none_better(
            [self._topology(item) for item in list(listed)[:LIMITING]],
            self.constraints.prepared,
            spec.free,
            column,
            value=gains[column],
            larger=spec.objective.maximize,
            inside=self._inside(gains),
            until=self.until,
        )

    def _active_scenarios(self, optimum: Optimum) -> list[Scenario]:
        """Return the scenario of each mode that binds."""
        return [optimum.scenarios[index] for index in optimum.rows.scenario[optimum.multipliers > 0].tolist()]

    def _topology(self, scenario: Scenario) -> Model:
        _, topology = self.constraints.settings[scenario.setting]
        pairs = zip(self.spec.box, map(Fraction, scenario.point), strict=True)
        return apply(topology, [Override(interval.free, value) for interval, value in pairs])

    def _active(self, optimum: Optimum, *, feasible: bool) -> list[ActiveConstraint]:
        """Return the active constraints: each mode with a multiplier, and the benefit of narrower ranges."""
        bindings = []
        objective = self.spec.objective.column
        rows = self.constraints.rows(optimum.scenarios, optimum.gains, wide=True)
        scale = 1.0
        if objective is not None and feasible:
            column = self.spec.columns[objective]
            scale = float(column.high - column.low) * (1 if self.spec.objective.maximize else -1)
        for index in np.flatnonzero(optimum.multipliers > 0):
            scenario = optimum.scenarios[rows.scenario[index]]
            numbers, _ = self.constraints.settings[scenario.setting]
            shadow_prices = []
            slopes = rows.slopes[index][len(self.spec.columns) :]
            for local, value, slope in zip(self.spec.box, scenario.point, slopes, strict=True):
                if value in (float(local.low), float(local.high)):
                    share = 0.01 * abs(value) / float(local.high - local.low)
                    change = -share if value == float(local.high) else share
                    better = -scale * float(optimum.multipliers[index]) * float(slope) * change
                    shadow_prices.append((local.free.label, value, local.unit, better))
            where = [
                (number.free.label, float(number.value), "1") for number in numbers[: len(self.spec.counts)]
            ]
            where += [
                (number.free.label, float(number.value), "s") for number in numbers[len(self.spec.counts) :]
            ]
            where += [
                (interval.free.label, value, interval.unit)
                for interval, value in zip(self.spec.box, scenario.point, strict=True)
            ]
            shape, frequency = self._mode(optimum, scenario, complex(rows.eigenvalue[index]))
            if not math.isnan(rows.frequency_hz[index]):
                frequency = float(rows.frequency_hz[index])
            bindings.append(ActiveConstraint(tuple(where), shape, frequency, tuple(shadow_prices)))
        return bindings

    def _mode(self, optimum: Optimum, scenario: Scenario, eigenvalue: complex) -> tuple[str, float]:
        """Return the shape and the frequency of a mode, "" and NaN where there is none."""
        passive = self.spec.criterion == PASSIVE
        if np.isnan(eigenvalue) and not (passive and not self.spec.measured):
            return "", math.nan
        pairs = zip(self.spec.free, map(Fraction, optimum.gains.tolist()), strict=False)
        changed = apply(
            self._topology(scenario), [Override(interval.free, value) for interval, value in pairs]
        )
        if passive:
            worst = absolute_stability(changed).worst_mode
            return ("", math.nan) if worst is None else (worst.name, worst.frequency_hz or math.nan)
        try:
            modes = analyze(changed).modes
        except ApcError:
            return "", math.nan
        if not len(modes):
            return "", math.nan
        nearest = min(modes, key=lambda mode: abs(mode.eigenvalue - eigenvalue))
        return nearest.family, nearest.frequency_hz


def _decimal(value: float, digits: int, rounding: str = ROUND_HALF_EVEN) -> Fraction:
    """Return a number to `digits` digits, as a decimal."""
    number = Decimal(repr(float(value)))
    index = number.adjusted() - digits + 1
    return Fraction(number.quantize(Decimal((0, (1,), index)), rounding=rounding)) if number else Fraction(0)


def _unlooked(name: str, ranges: Sequence[Range]) -> RobustStability:
    """Return the proof status at the time limit."""
    return RobustStability(name, tuple(ranges), UNDECIDED, None, 0, 1.0, (), ("the time was up",))
