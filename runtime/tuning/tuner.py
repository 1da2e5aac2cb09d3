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
from apc.analysis.box_result import UNDECIDED, ChangingDelay, RobustStability
from apc.analysis_report import proved_at
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.timings import part
from apc.haptics.absolute_stability import absolute_stability
from apc.lifting.numeric_model import numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import limitations
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, Range, value_now
from apc.result import Result
from apc.studies.crossing import Progress
from apc.studies.stability_criteria import MEAN_SQUARE, NOMINAL, PASSIVE
from apc.support.extension_table import find_extension, require_extension
from apc.support.not_supported import NotSupportedError
from apc.tuning.constraints import BEYOND, RESPONSES, ConstraintSet, Scenario, transparency_in
from apc.tuning.scenario_optimizer import BINDS, Optimum, ScenarioOptimizer
from apc.tuning.specification import CHANGING, CONSTRAINT, HINF, LOCATION, TransparencyMetric, TuningSpec

Floats = NDArray[np.float64]

# The largest number of significant digits of printed gains.
DIGITS = 4

# The relative increase of the minimized constraint that rounding may cause.
NEARLY = 1e-4

# The relaxations of the objective until the gains are proved, as shares of the optimum. With a box the first
# relaxation is larger: near an active constraint, a proof needs many small cells.
BACK = (0.0, 1e-4, 1e-3, 1e-2)
BACK_IN_BOX = (5e-3, 1e-2)

# The relative distance of a level from the bounded value: far above rounding, below the printed digits.
SLACK = 1e-5

# The text if only stability is proved.
SLOWER = "decay and metrics, evaluated for each scenario only; stability is proved"

# Text for the demand of every passive hand in a box.
POINTWISE = "no box is proved with passive hands; the scenarios were evaluated"

# The texts for a time-varying delay without proof, and for one with a box.
CHANGES = "not proved stable for a delay that varies from packet to packet"
CHANGES_IN_BOX = "no box is proved with a varying delay; the scenarios were evaluated"

# The text if the search for the worst point of a box is too slow.
CORNERS = "before rounding: only the ends and the middle of each range in a box were evaluated"

# The text if no gains that satisfy all demands were found in time.
TIMED_OUT = "the time limit was reached; the gains are the last evaluated"

# Scenarios added at a time; the least excess of a constraint over the others for an addition.
MORE, ABOVE = 3, 1e-9

# Number of settings in which the worst interior point of a box is searched, starting with the largest
# constraints at corners.
MOST_LIMITED = 8

# The number of scenarios, by decreasing constraints, in the proof that better gains are unstable.
LIMITING = 12

# The number of iterations after which inactive scenarios are removed.
DROPPING = 6


@dataclass(frozen=True, slots=True)
class Gain:
    """A free gain: decimal `value`, exact; `optimum` before rounding; `current` value; range in SI."""

    parameter: str
    unit: str
    low: float
    high: float
    value: Fraction
    optimum: float
    current: float


@dataclass(frozen=True, slots=True)
class ActiveConstraint:
    """An active constraint: a critical mode in a scenario.

    `where` are the scenario's values as (label, value, unit). `family` and `frequency_hz` are those of the
    mode, "" and NaN if the criterion has no mode. `shadow_prices` are the active ends of the scenario ranges,
    as (label, end, unit, improvement of the objective if the end is 1 % smaller).
    """

    where: tuple[tuple[str, float, str], ...]
    family: str
    frequency_hz: float
    shadow_prices: tuple[tuple[str, float, str, float], ...]


@dataclass(frozen=True, slots=True)
class Proved:
    """The proof over all other ranges for one combination of numbers of peers, as (label, number)."""

    counts: tuple[tuple[str, int], ...]
    proof: RobustStability


@dataclass(frozen=True, slots=True)
class Tuning(Result):
    """The optimal gains, the proof, and the active constraints.

    `value` is the objective at the decimal gains, `optimum` the objective before rounding, within `error`
    (infinite if unknown); both are a spectral radius if that is the objective. `feasible` states whether the
    gains satisfy all demands in floats; `proved` whether all demands are proved. `worst_case` is the largest
    constraint (see `constraints`), the logarithm of the largest eigenvalue magnitude per frame minus the
    `allowed` value, below 0 if all are satisfied.
    `decay` is a factor per second. `delay` is the range of a link's constant delay in `over`; `changing` is
    the result for a delay that varies from packet to packet, by numbers of peers as in `proofs`, with all
    other parameters at their present values, and `demanded` states whether this stability is a demand.
    `topologies` are the models of the `active` constraints, or one without active constraints. `evaluations`
    is the number of evaluations. `bound_cells` is the number of cells in the proof that no gains in these
    ranges are better by `specification.OPTIMALITY_GAP`, None without proof.
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
        """Draw two gains over the stable regions of the active scenarios, and an impulse response; return
        Axes.

        The impulse is simulated with the present and the tuned gains, in the most critical scenario.

        Raises
        ------
        ApcError
            E875 matplotlib is not installed; the errors of `regions.stable_region` and
            `trajectory.simulate`.
        """
        return self._shown("picture", ax)


@part("tune")
def tune(
    model: Model,
    spec: TuningSpec,
    *,
    seconds: float = math.inf,
    progress: Progress | None = None,
) -> Tuning:
    """Return the optimal gains under all demands, with the proof that the demands are satisfied.

    Parameters
    ----------
    model, spec
        The model, and its specification from `read_tuning_spec`.
    seconds
        The time limit; the best result until then is returned, with its unproved demands.
    progress
        Called with the progress.

    Raises
    ------
    ApcError
        The errors of the analyses, such as E898 an unsupported network, and of `transparency`; E996 a
        transparency metric that is undefined everywhere.
    """
    with evaluating(model):
        return _Tuner(model, spec, time.monotonic() + seconds, progress or (lambda _: None)).tuned()


@dataclass(eq=False)
class _Tuner:
    """The optimization of the gains of a specification: scenarios are added until the proof succeeds."""

    model: Model
    spec: TuningSpec
    until: float
    progress: Progress
    scenarios: list[Scenario] = field(default_factory=list)
    evaluations: int = 0
    evaluated: dict[bytes, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.constraints = ConstraintSet(numeric_model(self.model), self.spec, self.until)
        # A metric that is undefined everywhere is refused before the search.
        metrics = [metric for metric in self.spec.transparency_metrics if metric.name in RESPONSES]
        metrics += [metric for metric in self.spec.measured if metric.name == HINF]
        if metrics:
            transparency_in(self.constraints.numeric, metrics)
        self.every = self.constraints.every()
        self.present = np.array([float(value_now(self.model, interval.free)) for interval in self.spec.free])
        scenarios_per_setting = len(self.every) // len(self.constraints.settings)
        self.scenarios = list(dict.fromkeys((self.every[0], self.every[-scenarios_per_setting])))
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
        """Set the search range of the objective's level, from the best sampled value on."""
        optimizer = ScenarioOptimizer(self.constraints, self.scenarios, None)
        points = np.vstack([self.present, optimizer.gains(optimizer.sample_points)])
        sums = self.constraints.sums(self.scenarios, points)
        finite_sums = sums[np.isfinite(sums)]
        if not len(finite_sums):
            message = f"{self.spec.objective.label} is unknown at all evaluated gains"
            raise ApcError(
                Diagnostic("E996", LOCATION, message, advice="use wider ranges, or another objective")
            )
        best = float(finite_sums.max() if self.spec.objective.maximize else finite_sums.min())
        scale = abs(best) or float(np.abs(finite_sums).max()) or 1.0
        name, unit = ParameterRef(self.spec.objective.label), self.spec.objective.unit
        level = Range(name, unit, Fraction(best), Fraction(best) + Fraction(scale))
        self.spec = replace(self.spec, objective=replace(self.spec.objective, level=level, scale=scale))
        self.constraints = replace(self.constraints, spec=self.spec)
        self.present = np.append(self.present, best)

    @property
    def _unproved(self) -> bool:
        """Whether some demand beyond stability has no proof method."""
        decay_of_scalar = self.constraints.by_scalar_criterion and (
            self.spec.decay < 1 or self.spec.objective.column is None
        )
        boxed = self.spec.criterion == PASSIVE and self.spec.box
        transparency_metrics = self.spec.measured and (self.spec.box or self.spec.delay)
        peak_gains = any(
            metric.name == HINF for metric in self.spec.measured
        )  # with an error estimate, not a bound
        return decay_of_scalar or peak_gains or bool(boxed or transparency_metrics)

    @property
    def timed_out(self) -> bool:
        """Whether the time limit is reached."""
        return self.constraints.timed_out

    def tuned(self) -> Tuning:
        """Return the gains that are optimal, rounded and proved, or the result that the demands cannot be
        satisfied.

        While the proof finds a scenario in which the rounded gains are unstable, it is added and all is
        repeated, up to the time limit.
        """
        objective = self.spec.objective
        starts: list[Floats] = []
        while True:
            optimum = self._optimize_scenarios(objective.column, starts)
            # The descent ended at gains that violate a constraint, but others may satisfy all.
            if objective.column is not None and optimum.worst_case > BINDS:
                least_violation = self._optimize_scenarios(None, [])
                if least_violation.worst_case > 0:
                    return self._infeasible_result(least_violation)
                optimum = self._optimize_scenarios(objective.column, [self._shares(least_violation)])
            if objective.column is None and self.spec.decay < 1 and optimum.worst_case > BINDS:
                return self._infeasible_result(optimum)
            gains, proofs, violated = self._round_and_prove(optimum)
            if violated is None or self.timed_out:
                return self._result(optimum, gains, proofs)
            self.scenarios.append(violated)
            starts = [self._shares(optimum)]

    def _shares(self, optimum: Optimum) -> Floats:
        """Return the gains of an optimum as shares of their ranges."""
        return ScenarioOptimizer(self.constraints, self.scenarios, None).shares(optimum)

    def _optimize_scenarios(self, column: int | None, starts: list[Floats]) -> Optimum:
        """Return the optimum over all scenarios, by an active set of scenarios.

        The gains are optimized over a few scenarios. Then all others are evaluated at these gains: those with
        a larger constraint join the set, and in the first turns inactive ones leave it. The search ends when
        no scenario has a larger constraint and no other start gives better gains. When the time limit is
        reached, the first start is returned if later gains violate a scenario.

        Parameters
        ----------
        column
            The index of the gain, or level, to optimize; None to minimize the largest constraint.
        starts
            The start points of the descent, as shares of the ranges; if empty, the best of the sample points.
        """
        sign = 1.0 if self.spec.objective.maximize else -1.0
        first_starts: list[Floats] = []
        for turn in itertools.count():
            self.progress(f"optimizing gains for {len(self.scenarios)} of {len(self.every)} scenarios")
            optimizer = ScenarioOptimizer(self.constraints, self.scenarios, column, sign)
            if not starts:
                starts = first_starts = optimizer.start(self.present, self.every)
                for start in starts:
                    self.constraints.with_frequencies(self.scenarios, optimizer.gains(start))
            optimum = optimizer.best_point(starts)
            self.evaluations += optimum.evaluations
            active = optimum.rows.scenario[optimum.multipliers > 0]
            if turn < DROPPING and len(active):  # re-evaluate inactive ones with all others
                self.scenarios = [
                    scenario for index, scenario in enumerate(self.scenarios) if index in active
                ]
            level = max(optimum.worst_case, 0.0 if column is not None else -math.inf)
            starts = [optimizer.shares(optimum)]
            if self._add_scenarios(optimum.gains, level) or self.constraints.with_frequencies(
                self.scenarios, optimum.gains
            ):
                if not self.timed_out:
                    continue
                return optimizer.at(first_starts[0]) if first_starts else optimum
            better_starts = optimizer.start(self.present, self.every, than=optimum)
            if self.timed_out or not better_starts:
                return optimum
            starts += better_starts
        raise AssertionError("turns never end")

    def _worst_cases(self, gains: Sequence[Fraction] | Floats) -> Floats:
        """Return the largest constraint in each scenario (s,) at gains (m,), computed once."""
        point = np.array(gains, dtype=np.float64)
        key = point.tobytes()
        if key not in self.evaluated:
            self.evaluated[key] = self.constraints.worst_case(self.every, point[None])[0]
        return self.evaluated[key]

    def _add_scenarios(self, gains: Floats, level: float) -> bool:
        """Add the scenarios with constraints above a level; return whether any were added."""
        worst = self._worst_cases(gains)
        order = np.argsort(-worst)
        additions = [self.every[index] for index in order[:MORE] if worst[index] > level + ABOVE]
        additions = [candidate for candidate in additions if candidate not in self.scenarios]
        if not additions and self.spec.box and not self.constraints.slow:
            nearest = dict.fromkeys(self.every[index].setting for index in order.tolist())
            interior = (
                self.constraints.worst_case_within(candidate, gains)
                for candidate in list(nearest)[:MOST_LIMITED]
            )
            additions = [
                scenario
                for scenario, value in interior
                if value > level + ABOVE and scenario not in self.scenarios
            ]
        self.scenarios += additions
        return bool(additions)

    def _round_and_prove(self, optimum: Optimum) -> tuple[list[Fraction], list[Proved], Scenario | None]:
        """Return decimal gains near an optimum, their proofs, and a scenario in which they are proved
        unstable, if any.

        The objective is relaxed by one step of `BACK` after another until the gains are proved; those of the
        last step are returned without a proof.
        """
        column = self.spec.objective.column
        all_relaxations: tuple[float, ...] = BACK if self._unproved or not self.spec.over else BACK_IN_BOX
        if column is None:
            all_relaxations = (0.0,)
        elif not optimum.multipliers.any():  # the end of a range, which leaves room
            all_relaxations = (0.0, *all_relaxations)
        relaxations = list(all_relaxations)
        while True:
            gains = self._rounded_gains(optimum, relaxations[0])
            if (
                column is not None
                and not self.timed_out
                and self._add_scenarios(np.array(gains, np.float64), -ABOVE)
            ):
                continue  # the same relaxation again, with the violated scenarios
            satisfied = column is None or float(self._worst_cases(gains).max()) < 0
            last = self.timed_out or len(relaxations) == 1
            if satisfied or last:
                proofs, failed = self._proofs(gains, whole=last)
                proved = self._unproved or all(proof.proof.stable for proof in proofs)
                if failed is not None or last or proved:
                    return gains, proofs, failed
            del relaxations[0]

    def _rounded_gains(self, optimum: Optimum, share: float) -> list[Fraction]:
        """Return gains with the fewest digits that satisfy the scenarios, the objective relaxed by
        a share.
        """
        objective, gain_ranges = self.spec.objective, self.spec.free
        best = self.constraints.worst_case(self.scenarios, optimum.gains[None]).max()
        limit = 0.0 if objective.column is not None else best + NEARLY * abs(best)
        values, is_active = optimum.gains.copy(), optimum.multipliers > 0
        if objective.column is not None and is_active.any():
            # Into the interior of all active constraints, at the cost of this share of the objective.
            width = np.array([float(interval.high - interval.low) for interval in self.spec.columns])
            direction = np.linalg.lstsq(
                optimum.rows.slopes[is_active], -np.ones(is_active.sum()), rcond=None
            )[0]
            cost = float(width[objective.column] * optimum.multipliers.sum())
            values += share * abs(values[objective.column]) / cost * width * direction
        gains: list[Fraction] = []
        for digits in range(DIGITS if self.timed_out else 1, DIGITS + 1):
            gains = [_decimal(value, digits) for value in values.tolist()]
            if objective.column is not None:
                gains[objective.column] = self._relaxed_gain(float(optimum.gains[objective.column]), share)
            pairs = zip(gains, gain_ranges, strict=False)
            gains[: len(gain_ranges)] = [
                min(max(gain, interval.low), interval.high) for gain, interval in pairs
            ]
            point = np.array([[float(gain) for gain in gains]])
            if self.constraints.worst_case(self.scenarios, point).max() <= limit:
                break
        if objective.level:
            gains[-1] = self._satisfied_level(gains)
        return gains

    def _satisfied_level(self, gains: Sequence[Fraction]) -> Fraction:
        """Return the level of the objective that gains satisfy in every scenario, with rounding in its
        favour.
        """
        point = np.array([float(gain) for gain in gains])
        is_maximized, sums = self.spec.objective.maximize, self.constraints.sums(self.every, point[None])
        worst = float(sums.min() if is_maximized else sums.max())
        if not math.isfinite(worst):
            return gains[-1]
        margin = (-1 if is_maximized else 1) * SLACK * self.spec.objective.scale
        return _decimal(worst + margin, DIGITS + 1, ROUND_FLOOR if is_maximized else ROUND_CEILING)

    def _relaxed_gain(self, value: float, share: float) -> Fraction:
        """Return the objective's gain relaxed by a share, rounded to the relaxed side."""
        is_maximized = self.spec.objective.maximize
        relaxed = value * (1 - share if is_maximized == (value > 0) else 1 + share)
        return _decimal(relaxed, DIGITS, ROUND_FLOOR if is_maximized else ROUND_CEILING)

    def _proofs(self, gains: Sequence[Fraction], *, whole: bool) -> tuple[list[Proved], Scenario | None]:
        """Return the proofs for each combination of numbers of peers, the largest constraint first.

        A second result is a scenario in which the gains are proved unstable, if any. Without `whole`, the
        proofs end with the first undecided one.
        """
        inside = self._required_radius(gains)
        delay, counts = self.spec.delay, self.spec.counts
        ranges = [*([delay] if delay else []), *self.spec.box]
        gain_overrides = [
            Override(interval.free, value) for interval, value in zip(self.spec.free, gains, strict=False)
        ]
        point = np.array([[float(gain) for gain in gains]])
        worst = self._worst_cases(gains)
        order: dict[tuple[Override, ...], None] = {}
        for index in np.argsort(-worst, kind="stable"):
            numbers, _ = self.constraints.settings[self.every[index].setting]
            order[numbers[: len(counts)]] = None
        proveds: list[Proved] = []
        for numbers in order:
            labelled_counts = tuple((number.free.label, int(number.value)) for number in numbers)
            if self.timed_out:
                proveds.append(Proved(labelled_counts, _timed_out_proof(self.model.name, ranges)))
                continue
            self.progress(f"proving scenario {len(proveds) + 1} of {len(order)}")
            topology = apply(self.model, [*gain_overrides, *numbers])
            passive = self.spec.criterion == PASSIVE
            if passive and self.spec.box:
                proveds.append(
                    Proved(
                        labelled_counts,
                        replace(_timed_out_proof(self.model.name, ranges), notes=(POINTWISE,)),
                    )
                )
                continue
            radius_limit = 1.0 if self.constraints.by_scalar_criterion else inside
            try:
                proof = proved_at(topology, ranges, passive=passive, inside=radius_limit)
            except ApcError as error:
                if not ranges:
                    raise
                # For example of nonlinear models, boxes cannot be proved.
                proof = replace(_timed_out_proof(self.model.name, ranges), notes=(error.mistakes[0].message,))
            if proof.stable and (self._unproved or not self._transparency_is_proved(numbers, point)):
                proof = replace(proof, verdict=UNDECIDED, stable=None, notes=(*proof.notes, SLOWER))
            if proof.stable and self.spec.changing and not self._stable_if_changing(topology):
                note = CHANGES_IN_BOX if self.spec.box else CHANGES
                proof = replace(proof, verdict=UNDECIDED, stable=None, notes=(*proof.notes, note))
            proveds.append(Proved(labelled_counts, proof))
            if proof.stable is False:
                return proveds, self._violated_scenario(numbers, proof, ranges)
            if not (proof.stable or whole):
                break
        return proveds, None

    def _stable_if_changing(self, topology: Model) -> bool:
        """Return whether a model is proved stable under a delay that changes from packet to packet."""
        delay = self.spec.delay
        if delay is None or self.spec.box:
            return False
        try:
            gain: float = require_extension("loss_models").loop_gain(
                topology, delay.free, delay.low, delay.high
            )
            return gain < 1
        except NotSupportedError:
            return False

    def _varying_delay_results(
        self, gains: Sequence[Fraction], proofs: Sequence[Proved]
    ) -> Iterator[tuple[tuple[tuple[str, int], ...], ChangingDelay]]:
        """Yield the results under a time-varying delay, for each combination of numbers of peers with
        a proof.
        """
        spec = self.spec
        extension = find_extension("parameter_boxes")
        if extension is None or spec.delay is None or spec.criterion != NOMINAL:
            return
        pairs = zip(spec.free, gains, strict=False)
        gain_overrides = [Override(interval.free, value) for interval, value in pairs]
        for proved in proofs:
            result = proved.proof.changing
            if result is None and proved.proof.stable is not False and not self.timed_out:
                values = zip(spec.counts, proved.counts, strict=True)
                counts = [Override(count.free, Fraction(number)) for count, (_, number) in values]
                changed = apply(self.model, [*gain_overrides, *counts])
                result = extension.varying_delay_result(changed, spec.delay)
            if result is not None:
                yield proved.counts, result

    def _transparency_is_proved(self, numbers: tuple[Override, ...], point: Floats) -> bool:
        """Return whether the transparency demands are proved at these numbers of peers."""
        indices = [
            index for index, (overrides, _) in enumerate(self.constraints.settings) if overrides == numbers
        ]
        result = [
            self.constraints.constraint_values(index, point, bounded=True).max(initial=-1.0)
            for index in indices
        ]
        return max(result, default=-1.0) < 0

    def _required_radius(self, gains: Sequence[Fraction]) -> float:
        """Return the limit of the spectral radius in the proof.

        If the objective is the decay rate, the limit is slightly above the minimum.
        """
        if self.spec.objective.column is not None or self.constraints.by_scalar_criterion:
            return math.exp(self.constraints.allowed)
        margin = 1 - math.exp(float(self._worst_cases(gains).max()) + self.constraints.allowed)
        return float(1 - _decimal(margin * (1 - BACK[-1]), DIGITS, ROUND_FLOOR))

    def _violated_scenario(
        self, numbers: tuple[Override, ...], proof: RobustStability, ranges: Sequence[Range]
    ) -> Scenario | None:
        """Return the scenario of a counterexample; None if it is already a scenario of the search."""
        values = dict(zip([interval.free for interval in ranges], proof.counterexample, strict=False))
        timed_out = self.spec.delay and values.get(self.spec.delay.free)
        for index, (overrides, _) in enumerate(self.constraints.settings):
            same_delay = len(overrides) == len(numbers) or float(overrides[-1].value) == timed_out
            if overrides[: len(numbers)] == numbers and same_delay:
                box = tuple(values[interval.free] for interval in self.spec.box)
                scenario = Scenario(index, box)
                return None if scenario in self.scenarios else scenario
        return None

    def _infeasible_result(self, least_violation: Optimum) -> Tuning:
        """Return the result without feasible gains: the gains with the least violation."""
        gains = [_decimal(value, DIGITS) for value in least_violation.gains.tolist()]
        if self.spec.objective.level:
            gains[-1] = self._satisfied_level(gains)
        return self._result(least_violation, gains, [], feasible=False)

    def _result(
        self, optimum: Optimum, gains: Sequence[Fraction], proofs: Sequence[Proved], *, feasible: bool = True
    ) -> Tuning:
        """Return the result with the objective, the gains, the active constraints and the
        optimality bound.
        """
        spec, column = self.spec, self.spec.objective.column
        largest_constraint = float(self._worst_cases(gains).max())
        feasible = feasible and (column is None or largest_constraint < 0)
        value = float(gains[column]) if column is not None else self._required_radius(gains)
        if column is None and self.constraints.by_scalar_criterion:
            value = math.exp(largest_constraint + self.constraints.allowed)
        best, error = (
            (optimum.value, optimum.error) if column is not None else (math.exp(optimum.value), optimum.error)
        )
        if column is not None and not feasible:
            best = value if spec.objective.level else float(optimum.gains[column])
        return Tuning(
            topology=self.model.name,
            objective=spec.objective.label,
            unit=spec.objective.unit,
            maximize=spec.objective.maximize,
            feasible=feasible,
            proved=feasible and bool(proofs) and all(proof.proof.stable for proof in proofs),
            value=value,
            optimum=best,
            error=error,
            worst_case=largest_constraint,
            gains=tuple(
                Gain(
                    interval.free.label,
                    interval.unit,
                    float(interval.low),
                    float(interval.high),
                    rounded,
                    float(exact_optimum),
                    float(now),
                )
                for interval, rounded, exact_optimum, now in zip(
                    spec.free, gains, optimum.gains, self.present, strict=False
                )
            ),
            over=spec.over,
            criterion=spec.criterion,
            decay=spec.decay,
            transparency_metrics=spec.transparency_metrics,
            delay=spec.delay,
            changing=tuple(self._varying_delay_results(gains, proofs)) if feasible else (),
            demanded=spec.changing,
            frame_s=float(self.constraints.numeric.schedules[0].frame_s),
            allowed=self.constraints.allowed,
            proofs=tuple(proofs),
            active=tuple(self._active_constraints(optimum, feasible=feasible)),
            evaluations=self.evaluations
            + sum(int((sample != BEYOND).sum()) for sample in self.constraints.samples.values()),
            bound_cells=self._optimality_bound(optimum, gains) if feasible else None,
            notes=(
                *[reason for reason in (self._instability_reason(),) if reason and not feasible],
                *[CORNERS] * bool(spec.box and self.constraints.slow),
                *[TIMED_OUT] * (self.timed_out and not feasible),
            ),
            limitations=(
                *near_start(self.constraints.numeric),
                *limitations(
                    self.model,
                    network=spec.criterion != MEAN_SQUARE,
                    varied=[interval.free for interval in spec.over],
                ),
            ),
            ranges=spec.free,
            topologies=tuple(map(self._model_of, self._active_scenarios(optimum) or self.every[:1])),
        )

    def _instability_reason(self) -> str:
        """Return the reason why no gains are stable with passive hands, "" if the equations do not
        imply it.
        """
        return absolute_stability(numeric_model(self.model)).why if self.spec.criterion == PASSIVE else ""

    def _optimality_bound(self, optimum: Optimum, gains: Sequence[Fraction]) -> int | None:
        """Return the number of cells in the proof that no gains are better; None without a proof."""
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
        extension = find_extension("parameter_boxes")
        if extension is None:
            return None
        worst = self._worst_cases(gains)
        order = np.argsort(-worst, kind="stable").tolist()
        scenarios = dict.fromkeys([*self._active_scenarios(optimum), *(self.every[index] for index in order)])
        self.progress("proving global optimality")
        cells: int | None = extension.cells_without_better_gains(
            [self._model_of(item) for item in list(scenarios)[:LIMITING]],
            self.constraints.numeric,
            spec.free,
            column,
            value=gains[column],
            larger=spec.objective.maximize,
            inside=self._required_radius(gains),
            until=self.until,
        )
        return cells

    def _active_scenarios(self, optimum: Optimum) -> list[Scenario]:
        """Return the scenario of each active constraint."""
        return [optimum.scenarios[index] for index in optimum.rows.scenario[optimum.multipliers > 0].tolist()]

    def _model_of(self, scenario: Scenario) -> Model:
        """Return the model of a scenario, with its numbers of peers, delay and box parameters."""
        _, topology = self.constraints.settings[scenario.setting]
        pairs = zip(self.spec.box, map(Fraction, scenario.point), strict=True)
        return apply(topology, [Override(interval.free, value) for interval, value in pairs])

    def _active_constraints(self, optimum: Optimum, *, feasible: bool) -> list[ActiveConstraint]:
        """Return the active constraints, with the benefit of narrower ranges."""
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
            for box_range, value, slope in zip(self.spec.box, scenario.point, slopes, strict=True):
                if value in (float(box_range.low), float(box_range.high)):
                    share = 0.01 * abs(value) / float(box_range.high - box_range.low)
                    change = -share if value == float(box_range.high) else share
                    improvement = -scale * float(optimum.multipliers[index]) * float(slope) * change
                    shadow_prices.append((box_range.free.label, value, box_range.unit, improvement))
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
            shape, frequency = self._mode_of(optimum, scenario, complex(rows.eigenvalue[index]))
            if not math.isnan(rows.frequency_hz[index]):
                frequency = float(rows.frequency_hz[index])
            bindings.append(ActiveConstraint(tuple(where), shape, frequency, tuple(shadow_prices)))
        return bindings

    def _mode_of(self, optimum: Optimum, scenario: Scenario, eigenvalue: complex) -> tuple[str, float]:
        """Return the name and the frequency in Hz of the mode of a constraint, "" and NaN without a mode."""
        passive = self.spec.criterion == PASSIVE
        if np.isnan(eigenvalue) and not (passive and not self.spec.measured):
            return "", math.nan
        pairs = zip(self.spec.free, map(Fraction, optimum.gains.tolist()), strict=False)
        changed = apply(
            self._model_of(scenario), [Override(interval.free, value) for interval, value in pairs]
        )
        if passive:
            worst = absolute_stability(numeric_model(changed)).worst_mode
            return ("", math.nan) if worst is None else (worst.name, worst.frequency_hz or math.nan)
        try:
            modes = analyze(numeric_model(changed)).modes
        except ApcError:
            return "", math.nan
        if not len(modes):
            return "", math.nan
        nearest = min(modes, key=lambda mode: abs(mode.eigenvalue - eigenvalue))
        return nearest.family, nearest.frequency_hz


def _decimal(value: float, digits: int, rounding: str = ROUND_HALF_EVEN) -> Fraction:
    """Return a number rounded to `digits` significant digits, as an exact decimal."""
    number = Decimal(repr(float(value)))
    index = number.adjusted() - digits + 1
    return Fraction(number.quantize(Decimal((0, (1,), index)), rounding=rounding)) if number else Fraction(0)


def _timed_out_proof(name: str, ranges: Sequence[Range]) -> RobustStability:
    """Return an undecided proof, as the time limit is reached."""
    return RobustStability(name, tuple(ranges), UNDECIDED, None, 0, 1.0, (), ("the time limit was reached",))
