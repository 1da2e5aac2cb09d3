"""Constraint values of gains over scenarios: stability, transparency and level of the objective.

Takes: a `Model` and `TuningSpec`.
Gives: `Scenario`, `ConstraintValues`, `ConstraintSet`; `transparency_in`.
Guarantees: a value below 0 is a satisfied constraint, in floats; slopes are the derivatives of the values.
Does not: choose scenarios, or prove (see `tuner`).

A scenario is a model with a number of peers and a delay (`settings`), and a point of the box. The stability
constraints are ln |λ| minus the allowed value for each of the dominant modes; over a lossy network or with
passive hands it is the scalar of the criterion. A transparency constraint is the logarithm of the ratio of a
metric to its limit. The constraint of the objective's level is its violation relative to the scale of the
objective.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import prepare_at_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.eigen.eigenpairs import eigenvalues
from apc.frame.numeric_model import Prepared
from apc.frame.overrides import Override, apply
from apc.haptics.frequency_response import transparency
from apc.mean_square.time_varying_delay import loop_gain
from apc.not_supported import NotSupportedError
from apc.parameter_studies.delay_interval_proof import representative_delays
from apc.parameter_studies.evaluator import evaluator_of_many
from apc.parameter_studies.frame_matrices import BatchEvaluator, MatrixSource
from apc.parameter_studies.stability_criteria import SCALAR_CRITERIA, RadiusEvaluator
from apc.threads import load_pool
from apc.tuning.specification import CONSTRAINT, HINF, LOCATION, Objective, TransparencyMetric, TuningSpec
from apc.verdict import LimitationCode

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# The number of dominant modes evaluated per system: at a change of the dominant mode both are constraints.
MODES = 4

# The step of a difference quotient, relative to a range: it balances truncation and rounding.
STEP = 1e-6

# Responses as `Transparency` has them, and their bounds; in what of it all else is; less than any size.
RESPONSES = {
    "impedance": ("impedance", "bound"),
    "transmitted_velocity": ("transmitted_admittance", "transmitted_bound"),
    "coordination_error": ("coordination_error", "error_bound"),
}
PART_OF = {"damping": "low_frequency", "coordination_error_h2": "h2", HINF: "hinf"}
TINY = 1e-300

# The lowest frequency in Hz of the search for the largest gain; the relative increase over the gain at known
# frequencies that adds a new one.
SLOWEST, LARGER = 1e-3, 1e-6

# Points of a grid along each range of a box; how near to the top of what limits gains there it is followed.
GRID, POWELL = 5, {"xtol": 1e-5, "ftol": 1e-12}

# The value used for ln |λ| of a missing matrix, and of a missing mode.
BEYOND, NONE = 3.0, -30.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """A scenario: the index of a setting, and the values of the box parameters."""

    setting: int
    point: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ConstraintValues:
    """Limits at one point of the columns: `values` (n,), below 0 where met, and `slopes` (n, m).

    A slope is that over the whole range of a column, or of a number of the box.
    `eigenvalue` (n,) is that of each, NaN of what has none; `frequency_hz` (n,) is where a gain is largest,
    NaN of all else; `scenario` (n,) is the place of its scenario.
    """

    values: Floats
    slopes: Floats
    eigenvalue: Complexes
    frequency_hz: Floats
    scenario: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ConstraintSet:
    """The constraints of a model's gains; after the time `until` only one of several points is evaluated."""

    system: Model
    prepared: Prepared
    spec: TuningSpec
    until: float = math.inf
    known: dict[int, MatrixSource] = field(default_factory=dict)
    samples: dict[Scenario, Floats] = field(default_factory=dict)
    transparency_values: dict[tuple[int, tuple[float, ...], int], Floats] = field(default_factory=dict)
    frequencies: list[float] = field(default_factory=lambda: [SLOWEST])
    loop_gains: dict[tuple[tuple[Override, ...], tuple[float, ...]], float] = field(default_factory=dict)

    @cached_property
    def settings(self) -> list[tuple[tuple[Override, ...], Model]]:
        """All combinations of number of peers and representative delay, with their models."""
        runs = [range(int(count.low), int(count.high) + 1) for count in self.spec.counts]
        pairs = []
        for counts in itertools.product(*runs):
            numbers = tuple(
                Override(item.free, Fraction(count))
                for item, count in zip(self.spec.counts, counts, strict=True)
            )
            topology, delay = apply(self.system, numbers), self.spec.delay
            if delay is None:
                pairs.append((numbers, topology))
                continue
            for value in dict.fromkeys(number for number, _ in representative_delays(topology, delay)):
                timed_out = Override(delay.free, value)
                pairs.append(((*numbers, timed_out), apply(topology, [timed_out])))
        return pairs

    @cached_property
    def allowed(self) -> float:
        """The largest allowed ln |λ| per frame."""
        return math.log(self.spec.decay) * float(self.prepared.schedules[0].frame_s)

    @property
    def timed_out(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() > self.until

    @property
    def by_scalar_criterion(self) -> bool:
        """Whether stable means one number below 1, and not eigenvalues inside the circle."""
        return self.spec.criterion in SCALAR_CRITERIA

    @property
    def slow(self) -> bool:
        """Whether one point takes milliseconds."""
        requested = self.spec.measured or self.spec.changing
        return bool(requested) or not isinstance(self.family(0), BatchEvaluator)

    def every(self) -> list[Scenario]:
        """Return the middle and the corners of the box in every setting."""
        ends = [(float(interval.low), float(interval.high)) for interval in self.spec.box]
        middle = tuple((low + high) / 2 for low, high in ends)
        points = dict.fromkeys((middle, *itertools.product(*ends)))
        return [Scenario(index, point) for index in range(len(self.settings)) for point in points]

    def family(self, setting: int) -> MatrixSource:
        """Return the frame matrices of a setting as a function of gains and box."""
        if setting not in self.known:
            _, topology = self.settings[setting]
            free = [interval.free for interval in (*self.spec.free, *self.spec.box)]
            start = None if self.by_scalar_criterion else prepare_at_start(topology, self.prepared, free)
            self.known[setting] = (
                RadiusEvaluator(topology, tuple(free), self.prepared, LOCATION, self.spec.criterion)
                if start is None
                else evaluator_of_many(topology, free, LOCATION, prepared=start)
            )
        return self.known[setting]

    def worst_case(self, scenarios: Sequence[Scenario], chosen: Floats) -> Floats:
        """Return the largest value in each scenario (k, s) with columns (k, m)."""
        values = np.full((len(chosen), len(scenarios)), BEYOND)
        size = 1 if self.slow else len(chosen)
        for begin in range(0, len(chosen), size):
            if begin and self.timed_out:
                break
            some = slice(begin, begin + size)
            for index, scenario in enumerate(scenarios):
                points = np.hstack([chosen[some], np.tile(scenario.point, (len(chosen[some]), 1))])
                sizes = [
                    _sizes(matrix) for matrix in self.family(scenario.setting).matrices(self._numbers(points))
                ]
                grown = np.max([np.full(len(points), NONE), *sizes], axis=0) - self.allowed
                values[some, index] = np.max(
                    [grown, *self.constraint_values(scenario.setting, points).T], axis=0
                )
        return values

    def _numbers(self, points: Floats) -> Floats:
        """Return the gains and the box of points (k, m + b), without the level of an aim."""
        level = range(len(self.spec.free), len(self.spec.columns))
        return np.delete(points, level, axis=-1)

    def worst_case_within(self, setting: int, chosen: Floats) -> tuple[Scenario, float]:
        """Return the point of the box that limits columns (m,) most in a setting, and its value.

        The worst of a grid is followed to the top by Powell's method, which takes no slopes: where modes take
        turns there is a ridge.
        """
        low, high = np.array([(float(interval.low), float(interval.high)) for interval in self.spec.box]).T

        def value(shares: Floats) -> Floats:
            """Return the values at points of the box (k, b), each from 0 to 1 along every range."""
            points = np.hstack([np.tile(chosen, (len(shares), 1)), low + shares * (high - low)])
            sizes = [_sizes(matrix) for matrix in self.family(setting).matrices(self._numbers(points))]
            return np.asarray(np.max(sizes, axis=0))

        grid = np.array(list(itertools.product(np.linspace(0, 1, GRID), repeat=len(low))))
        begin = grid[int(np.argmax(value(grid)))]
        minimize = load_pool("scipy.optimize").minimize
        bounds = [(0.0, 1.0)] * len(low)
        top = minimize(
            lambda item: -float(value(item[None])[0]), begin, method="Powell", bounds=bounds, options=POWELL
        )
        point = low + np.clip(top.x, 0, 1) * (high - low)
        return Scenario(setting, tuple(point.tolist())), -float(top.fun) - self.allowed

    @property
    def views(self) -> list[TuningSpec]:
        """The demands with maxima over frequency replaced by values at known frequencies (smooth)."""
        if all(metric.name != HINF for metric in self.spec.measured):
            return [self.spec]
        return [self.spec.at_frequency(frequency) for frequency in self.frequencies]

    def with_frequencies(self, scenarios: Sequence[Scenario], chosen: Floats) -> bool:
        """Add frequencies with larger gains than the known ones, at columns (m,); return whether any exist.

        Notes
        -----
        The exchange method for a semi-infinite constraint over frequency (Hettich and Kortanek, SIAM Rev. 35
        (1993) 380).
        """
        before = len(self.frequencies)
        for scenario in scenarios:
            point = np.append(chosen, scenario.point)[None]
            values = np.max(
                [self.constraint_values(scenario.setting, point, view=view) for view in self.views], axis=0
            )
            peaks = self.measured(scenario.setting, self._numbers(point), self.spec)[0, :, 2]
            if (self.constraint_values(scenario.setting, point) > values + LARGER).any():
                named = zip(self.spec.measured, np.maximum(peaks, SLOWEST).tolist(), strict=True)
                new = [peak for metric, peak in named if metric.name == HINF]
                self.frequencies.extend(peak for peak in new if peak not in self.frequencies)
        return len(self.frequencies) > before

    def constraint_values(
        self, setting: int, points: Floats, *, bounded: bool = False, view: TuningSpec | None = None
    ) -> Floats:
        """Return the constraints other than stability at points (k, m + b), and the level (k, q).

        Parameters
        ----------
        setting
            The number of peers and the delay.
        points
            The columns and the box (k, m + b).
        bounded
            Whether the values are upper bounds, including rounding errors of the metrics.
        view
            One of `views`, which evaluates the largest gain at one frequency; by default at all.
        """
        spec = view or self.spec
        objective = spec.objective
        transparency_metrics = self.measured(setting, self._numbers(points), spec)
        error_bound = transparency_metrics[..., 1] if bounded else np.zeros(transparency_metrics.shape[:2])
        count = len(spec.transparency_metrics)
        values = np.log(np.maximum(transparency_metrics[:, :count, 0] + error_bound[:, :count], TINY))
        values -= np.log([metric.most for metric in spec.transparency_metrics])
        if objective.level:
            weights = [
                abs(weight) for weight, item in objective.terms if isinstance(item, TransparencyMetric)
            ]
            sums = _sums(objective, transparency_metrics[:, count:, 0], points)
            short = (-1 if objective.maximize else 1) * (sums - points[:, len(spec.free)])
            beyond = short + error_bound[:, count:] @ weights
            # Large on the logarithmic scale: gains near a resonance are large, and slopes still descend.
            far = beyond / objective.scale
            far = np.where(far > 1, 1 + np.log(np.maximum(far, 1)), far)
            values = np.column_stack([values, far])
        if spec.changing:
            values = np.column_stack([values, self.changing(setting, self._numbers(points))])
        values = np.nan_to_num(values, nan=BEYOND, posinf=BEYOND, neginf=NONE)
        return np.asarray(np.maximum(values, NONE))

    def changing(self, setting: int, numbers: Floats) -> Floats:
        """Return ln of the loop gain (k,) under a time-varying delay.

        It is a proved upper bound (see `time_varying_delay.loop_gain`) and independent of constant delays.

        Parameters
        ----------
        setting
            The index of the scenario's overrides.
        numbers
            The values (k, n) of the gains and of the uncertain parameters.
        """
        overrides, _ = self.settings[setting]
        counts, delay = overrides[: len(self.spec.counts)], self.spec.delay
        assert delay is not None, "a demand on a delay has its range"
        free = [interval.free for interval in (*self.spec.free, *self.spec.box)]
        values = np.full(len(numbers), math.inf)
        for index, point in enumerate(map(tuple, numbers.tolist())):
            if (counts, point) not in self.loop_gains:
                if index and self.timed_out:
                    break
                pairs = zip(free, map(Fraction, point), strict=True)
                topology = apply(self.system, [*counts, *(Override(*pair) for pair in pairs)])
                try:
                    gain = loop_gain(topology, delay.free, delay.low, delay.high)
                except NotSupportedError:
                    gain = math.inf
                self.loop_gains[counts, point] = math.log(max(gain, TINY))
            values[index] = self.loop_gains[counts, point]
        return values

    def sums(self, scenarios: Sequence[Scenario], chosen: Floats) -> Floats:
        """Return the aim's weighted sum in each scenario (s, k) with columns (k, m), NaN of none."""
        count, sums = len(self.spec.transparency_metrics), []
        for scenario in scenarios:
            points = np.hstack([chosen, np.tile(scenario.point, (len(chosen), 1))])
            transparency_metrics = self.measured(scenario.setting, self._numbers(points), self.spec)
            sums.append(_sums(self.spec.objective, transparency_metrics[:, count:, 0], points))
        return np.array(sums)

    def measured(self, setting: int, numbers: Floats, view: TuningSpec) -> Floats:
        """Return the metrics, their error bounds and frequencies in Hz (k, q, 3), at gains and box (k, n).

        An undefined metric is infinite.
        """
        views = (self.spec, *self.views)
        requested = list(dict.fromkeys(metric for spec in views for metric in spec.measured))
        values = np.full((len(numbers), len(requested), 3), np.inf)
        _, topology = self.settings[setting]
        free = [interval.free for interval in (*self.spec.free, *self.spec.box)]
        for index, point in enumerate(map(tuple, numbers.tolist()) if requested else ()):
            row = values[index]
            if (setting, point, len(requested)) not in self.transparency_values:
                if index and self.timed_out:
                    break
                pairs = zip(free, map(Fraction, point), strict=True)
                with contextlib.suppress(ApcError):
                    changed = apply(topology, [Override(*pair) for pair in pairs])
                    row[:] = transparency_in(changed, requested, self.prepared)
                self.transparency_values[setting, point, len(requested)] = row.copy()
            row[:] = self.transparency_values[setting, point, len(requested)]
        return values[:, [requested.index(metric) for metric in view.measured]]

    def sampled(self, scenario: Scenario, chosen: Floats) -> Floats:
        """Return the largest value in a scenario (k,) with columns (k, m), the same whenever it is asked."""
        if scenario not in self.samples:
            self.samples[scenario] = self.worst_case([scenario], chosen)[:, 0]
        return self.samples[scenario]

    def rows(self, scenarios: Sequence[Scenario], chosen: Floats, *, wide: bool = False) -> ConstraintValues:
        """Return all limits with columns (m,), their slopes along the numbers of the box, too, if `wide`."""
        ranges = [*self.spec.columns, *self.spec.box]
        along = np.diag([float(interval.high - interval.low) for interval in ranges])
        along = along if wide else along[: len(chosen)]
        parts: list[tuple[Floats, Floats, Complexes, float, int]] = []
        objective = [
            metric for _, metric in self.spec.objective.terms if isinstance(metric, TransparencyMetric)
        ]
        peaks = [metric.name == HINF for metric in self.spec.transparency_metrics]
        peaks += [any(metric.name == HINF for metric in objective)] * bool(self.spec.objective.terms)
        peaks += [False] * self.spec.changing
        for index, scenario in enumerate(scenarios):
            point = np.append(chosen, scenario.point)
            family = self.family(scenario.setting)
            inwards = along * np.where(
                point > [float(interval.low + interval.high) / 2 for interval in ranges], -1, 1
            )
            moved = np.vstack([point, point + STEP * inwards])
            if isinstance(family, RadiusEvaluator):
                distinct, which = np.unique(self._numbers(moved), axis=0, return_inverse=True)
                parted = [family.parts(item) for item in distinct.tolist()]
                # Without separate loops the single value represents each.
                most = max(map(len, parted))
                interchangeable = [each if len(each) == most else [max(each)] * most for each in parted]
                roots = np.array(interchangeable)[which.reshape(-1)]
                grown = np.nan_to_num(np.log(np.maximum(roots, TINY)), nan=BEYOND) - self.allowed
                parts.append((*_differences(grown, inwards), math.nan, index))
            else:
                at = np.tile(self._numbers(point), (len(along), 1))
                for pair in family.slopes(at, self._numbers(along)):
                    values, slopes, result = _largest(*pair)
                    parts.append((values - self.allowed, slopes, result, math.nan, index))
            still = self.constraint_values(scenario.setting, moved)[:, np.logical_not(peaks)]
            parts.append((*_differences(still, inwards), math.nan, index))
            for frequency, view in zip(self.frequencies, self.views if any(peaks) else (), strict=False):
                requested = self.constraint_values(scenario.setting, moved, view=view)[:, peaks]
                parts.append((*_differences(requested, inwards), frequency, index))
        counts = [len(values) for values, *_ in parts]
        return ConstraintValues(
            np.concatenate([values for values, *_ in parts]),
            np.concatenate([slopes for _, slopes, *_ in parts]),
            np.concatenate([values for *_, values, _, _ in parts]),
            np.repeat([frequency for *_, frequency, _ in parts], counts),
            np.repeat([index for *_, index in parts], counts),
        )


def _sums(objective: Objective, transparency_metrics: Floats, points: Floats) -> Floats:
    """Return the weighted sum (k,) of the objective from its metrics (k, f) at points (k, m + b)."""
    of_hands = iter(transparency_metrics.T)
    terms = [
        w * (next(of_hands) if isinstance(item, TransparencyMetric) else points[:, item])
        for w, item in objective.terms
    ]
    total = np.asarray(np.sum(terms, axis=0))
    return np.where(np.isfinite(total), total, np.nan)


def transparency_in(
    system: Model, requested: Sequence[TransparencyMetric], prepared: Prepared
) -> list[tuple[float, float, float]]:
    """Return each transparency metric of a model, its error bound, and its frequency in Hz.

    Parameters
    ----------
    system
        The model, with its parameter values.
    requested
        The transparency metrics.
    prepared
        From `numeric_model.prepare`, of this model with any parameter values.

    Raises
    ------
    ApcError
        Those of `transparency`; E996 a metric is undefined.
    """
    hertz = [metric.frequency_hz for metric in requested if not math.isnan(metric.frequency_hz)] or [1.0]
    alongside = {PART_OF[metric.name] for metric in requested if metric.name in PART_OF}
    # The search needs slopes also at unstable points, wherever the metrics are defined.
    used_response = transparency(
        system, hertz, unstable="h2" not in alongside, alongside=alongside, prepared=prepared
    )
    result = []
    for metric in requested:
        value, error_bound, hz = 0.0, 0.0, metric.frequency_hz
        if metric.name in RESPONSES:
            response, bound = (getattr(used_response, name) for name in RESPONSES[metric.name])
            value = abs(complex(response[hertz.index(metric.frequency_hz)]))
            error_bound = value * float(bound[hertz.index(metric.frequency_hz)])
        elif metric.name == "damping" and used_response.low_frequency is not None:
            value, error_bound = used_response.low_frequency.damping, used_response.low_frequency.errors[1]
        elif (
            metric.name == "coordination_error_h2"
            and used_response.h2
            and used_response.h2[0].error_m is not None
        ):
            value, error_bound = used_response.h2[0].error_m, used_response.h2[0].errors[0] or 0.0
        elif metric.name == HINF:
            if any(note.code is LimitationCode.COUPLED_COPIES for note in used_response.notes):
                message = f"{metric.label} is not told of peers that differ, which move apart together"
                raise ApcError(Diagnostic("E996", LOCATION, message, hint="coordination_error_h2"))
            for mode in (mode for mode in used_response.hinf if mode.of == "error"):
                peak = mode.sampled_data
                local = (peak.norm, peak.error, peak.frequency_hz)
                if not math.isnan(metric.frequency_hz):
                    local = (
                        float(mode.gains[hertz.index(metric.frequency_hz)]),
                        peak.error,
                        metric.frequency_hz,
                    )
                value, error_bound, hz = max((value, error_bound, hz), local)
        if value == 0:
            raise ApcError(
                Diagnostic("E996", CONSTRAINT, f"of {metric.label} nothing is felt in this topology")
            )
        result.append((value, error_bound, hz))
    return result


def _differences(values: Floats, along: Floats) -> tuple[Floats, Floats, Complexes]:
    """Return the first of values (1 + m, q), how they move along directions (q, m), and no eigenvalues.

    Differences are one-sided, into the ranges: of numbers that take milliseconds, half as many are wanted.
    """
    # A direction goes up where its one entry is above 0.
    slopes = (values[1:] - values[0]) / STEP * np.sign(along.sum(axis=1))[:, None]
    return values[0], slopes.T, np.full(len(values[0]), np.nan, np.complex128)


def _sizes(matrices: Floats) -> Floats:
    """Return ln |λ| of the largest eigenvalue of each matrix (k, n, n)."""
    known = np.isfinite(matrices).all(axis=(1, 2))
    values = np.full(len(matrices), BEYOND)
    if matrices.shape[-1] and known.any():
        largest = np.abs(np.linalg.eigvals(matrices[known])).max(axis=1)
        values[known] = np.log(np.clip(largest, math.exp(NONE), None))
    return values if matrices.shape[-1] else np.full(len(matrices), NONE)


def _largest(matrix: Floats, slope: Floats) -> tuple[Floats, Floats, Complexes]:
    """Return ln |λ| of the largest modes (n,), how it follows each number (n, m), and λ (n,)."""
    if not matrix.shape[-1]:  # nothing moves
        return np.full(1, NONE), np.zeros((1, len(slope))), np.zeros(1, np.complex128)
    count = min(MODES, matrix.shape[-1])
    if not (np.isfinite(matrix).all() and np.isfinite(slope).all()):
        return np.full(count, BEYOND), np.zeros((count, len(slope))), np.zeros(count, np.complex128)
    values, moves = eigenvalues(matrix, slope)
    sizes = np.where(values[0].imag >= 0, np.abs(values[0]), 0.0)
    chosen = np.argsort(-sizes, kind="stable")[:count]
    there = sizes[chosen] > math.exp(NONE)
    value = np.where(there, values[0, chosen], 1.0)
    rates = np.where(there, (moves[:, chosen] / value).real, 0.0)
    return np.where(there, np.log(np.abs(value)), NONE), rates.T, values[0, chosen]
