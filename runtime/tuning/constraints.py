"""Constraint values of gains over scenarios: stability, transparency and level of the objective.

Takes: a `NumericModel` and `TuningSpec`.
Gives: `Scenario`, `ConstraintValues`, `ConstraintSet`; `transparency_in`.
Guarantees: a value below 0 is a satisfied constraint, in floats; slopes are the derivatives of the values.
Does not: choose scenarios, or prove (see `tuner`).

A scenario is a model with a number of peers and a delay (`settings`), and a point of the box. The stability
constraints are ln |λ| minus the allowed value for each of the dominant modes; over a lossy network or with
passive hands it is the scalar of the criterion. A transparency constraint is the logarithm of the ratio of a
metric to its limit. The constraint of the objective's level is its violation divided by the scale of the
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

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.haptics.frequency_response import transparency
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.overrides import Override, apply
from apc.spectrum.eigenpairs import eigenvalues, largest_magnitudes
from apc.studies.evaluator import evaluator_of_many
from apc.studies.evaluator_choice import evaluator_for, radius_evaluator
from apc.studies.frame_matrices import BatchEvaluator, MatrixSource
from apc.studies.representative_delays import representative_delays
from apc.studies.stability_criteria import SCALAR_CRITERIA, RadiusEvaluator
from apc.support.extension_table import require_extension
from apc.support.not_supported import NotSupportedError
from apc.tuning.specification import CONSTRAINT, HINF, LOCATION, Objective, TransparencyMetric, TuningSpec
from apc.verdict import LimitationCode

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# The number of dominant modes evaluated per system: at a change of the dominant mode both are constraints.
MODES = 4

# The step of a difference quotient, relative to a range: it balances truncation and rounding.
STEP = 1e-6

# The fields of `Transparency` with each response and its bound; the optional result of each other metric; a
# number below all magnitudes.
RESPONSES = {
    "impedance": ("impedance", "bound"),
    "transmitted_velocity": ("transmitted_admittance", "transmitted_bound"),
    "coordination_error": ("coordination_error", "error_bound"),
}
PART_OF = {"damping": "low_frequency", "coordination_error_h2": "h2", HINF: "hinf"}
TINY = 1e-300  # the least magnitude of which a logarithm is taken

# The lowest frequency in Hz of the search for the largest gain; the increase over the gain at known
# frequencies above which a frequency is added.
SLOWEST, LARGER = 1e-3, 1e-6

# Points of a grid along each range of a box; the tolerances of the search for the largest constraint.
GRID, NARROW = 5, 1e-6

# The value used for ln |λ| of a missing matrix, and of a missing mode.
BEYOND, NONE = 3.0, -30.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """A scenario: the index of a setting, and the values of the box parameters in SI."""

    setting: int
    point: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ConstraintValues:
    """The constraints at one point of the columns: `values` (n,), below 0 if satisfied, and `slopes` (n, m).

    A slope is with respect to a complete range of a column, or of a box parameter. `eigenvalue` (n,) is the
    critical eigenvalue, NaN without one; `frequency_hz` (n,) is the frequency of a largest gain, NaN for
    other constraints; `scenario` (n,) is the index of the scenario.
    """

    values: Floats
    slopes: Floats
    eigenvalue: Complexes
    frequency_hz: Floats
    scenario: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ConstraintSet:
    """The constraints of a model's gains, with cached evaluations.

    After the time `until`, only the first of several points is evaluated.
    """

    numeric: NumericModel
    spec: TuningSpec
    until: float = math.inf
    known: dict[int, MatrixSource] = field(default_factory=dict)
    samples: dict[Scenario, Floats] = field(default_factory=dict)
    transparency_values: dict[tuple[int, tuple[float, ...], int], Floats] = field(default_factory=dict)
    frequencies: list[float] = field(default_factory=lambda: [SLOWEST])
    loop_gains: dict[tuple[tuple[Override, ...], tuple[float, ...]], float] = field(default_factory=dict)

    @cached_property
    def settings(self) -> list[tuple[tuple[Override, ...], Model]]:
        """All combinations of numbers of peers and representative delays, as overrides with their models."""
        count_ranges = [range(int(count.low), int(count.high) + 1) for count in self.spec.counts]
        pairs = []
        for counts in itertools.product(*count_ranges):
            count_overrides = tuple(
                Override(count_range.free, Fraction(count))
                for count_range, count in zip(self.spec.counts, counts, strict=True)
            )
            topology, delay = apply(self.numeric.model, count_overrides), self.spec.delay
            if delay is None:
                pairs.append((count_overrides, topology))
                continue
            for value in dict.fromkeys(number for number, _ in representative_delays(topology, delay)):
                timed_out = Override(delay.free, value)
                pairs.append(((*count_overrides, timed_out), apply(topology, [timed_out])))
        return pairs

    @cached_property
    def allowed(self) -> float:
        """The largest allowed ln |λ| per frame."""
        return math.log(self.spec.decay) * float(self.numeric.schedules[0].frame_s)

    @property
    def timed_out(self) -> bool:
        """Whether the time limit is reached."""
        return time.monotonic() > self.until

    @property
    def by_scalar_criterion(self) -> bool:
        """Whether stability is decided by a scalar criterion instead of eigenvalues."""
        return self.spec.criterion in SCALAR_CRITERIA

    @property
    def slow(self) -> bool:
        """Whether the evaluation of one point takes milliseconds."""
        needs_responses = self.spec.measured or self.spec.changing
        return bool(needs_responses) or not isinstance(self.family(0), BatchEvaluator)

    def every(self) -> list[Scenario]:
        """Return the scenarios at the middle and the corners of the box, in every setting."""
        ends = [(float(interval.low), float(interval.high)) for interval in self.spec.box]
        middle = tuple((low + high) / 2 for low, high in ends)
        points = dict.fromkeys((middle, *itertools.product(*ends)))
        return [Scenario(index, point) for index in range(len(self.settings)) for point in points]

    def family(self, setting: int) -> MatrixSource:
        """Return the frame matrices of a setting as functions of gains and box parameters."""
        if setting not in self.known:
            _, topology = self.settings[setting]
            parameter_refs = [interval.free for interval in (*self.spec.free, *self.spec.box)]
            numeric = self.numeric.at(topology)
            start = evaluator_for(numeric, parameter_refs, self.spec.criterion).smooth
            self.known[setting] = (
                radius_evaluator(numeric, parameter_refs, LOCATION, self.spec.criterion)
                if start is None
                else evaluator_of_many(start, parameter_refs, LOCATION)
            )
        return self.known[setting]

    def worst_case(self, scenarios: Sequence[Scenario], chosen: Floats) -> Floats:
        """Return the largest constraint in each scenario (k, s) at columns (k, m)."""
        values = np.full((len(chosen), len(scenarios)), BEYOND)
        size = 1 if self.slow else len(chosen)
        for begin in range(0, len(chosen), size):
            if begin and self.timed_out:
                break
            batch = slice(begin, begin + size)
            for index, scenario in enumerate(scenarios):
                points = np.hstack([chosen[batch], np.tile(scenario.point, (len(chosen[batch]), 1))])
                log_radii = [
                    _log_radii(matrix)
                    for matrix in self.family(scenario.setting).matrices(self._without_level(points))
                ]
                stability = np.max([np.full(len(points), NONE), *log_radii], axis=0) - self.allowed
                values[batch, index] = np.max(
                    [stability, *self.constraint_values(scenario.setting, points).T], axis=0
                )
        return values

    def _without_level(self, points: Floats) -> Floats:
        """Return the gains and box parameters of points (k, m + b), without the level of the objective."""
        level = range(len(self.spec.free), len(self.spec.columns))
        return np.delete(points, level, axis=-1)

    def worst_case_within(self, setting: int, chosen: Floats) -> tuple[Scenario, float]:
        """Return the scenario in the box with the largest constraint at columns (m,) in a setting, and
        its value.

        The grid is refined around its largest value, without slopes: the maximum may be on a ridge between
        two modes.
        """
        low, high = np.array([(float(interval.low), float(interval.high)) for interval in self.spec.box]).T

        def value(shares: Floats) -> Floats:
            """Return the values at points of the box (k, b), each from 0 to 1 along its range."""
            points = np.hstack([np.tile(chosen, (len(shares), 1)), low + shares * (high - low)])
            sizes = [
                _log_radii(matrix) for matrix in self.family(setting).matrices(self._without_level(points))
            ]
            return np.asarray(np.max(sizes, axis=0))

        count = GRID**2 if len(low) == 1 else GRID
        offsets = np.array(list(itertools.product(np.linspace(-1, 1, count), repeat=len(low))))
        best, width, values = np.full(len(low), 0.5), 0.5, np.empty(0)
        while width > NARROW:
            points = np.clip(best + width * offsets, 0, 1)
            values = value(points)
            best, width = points[int(np.argmax(values))], width * 2 / (count - 1)
        return Scenario(setting, tuple((low + best * (high - low)).tolist())), values.max() - self.allowed

    @property
    def views(self) -> list[TuningSpec]:
        """The specifications with maxima over frequency replaced by values at known frequencies (smooth)."""
        if all(metric.name != HINF for metric in self.spec.measured):
            return [self.spec]
        return [self.spec.at_frequency(frequency) for frequency in self.frequencies]

    def with_frequencies(self, scenarios: Sequence[Scenario], chosen: Floats) -> bool:
        """Add the frequencies with larger gains than known ones at columns (m,); return whether any exist."""
        known_count = len(self.frequencies)
        for scenario in scenarios:
            point = np.append(chosen, scenario.point)[None]
            values = np.max(
                [self.constraint_values(scenario.setting, point, view=view) for view in self.views], axis=0
            )
            peaks = self.measured(scenario.setting, self._without_level(point), self.spec)[0, :, 2]
            if (self.constraint_values(scenario.setting, point) > values + LARGER).any():
                peak_of_metric = zip(self.spec.measured, np.maximum(peaks, SLOWEST).tolist(), strict=True)
                new = [peak for metric, peak in peak_of_metric if metric.name == HINF]
                self.frequencies.extend(peak for peak in new if peak not in self.frequencies)
        return len(self.frequencies) > known_count

    def constraint_values(
        self, setting: int, points: Floats, *, bounded: bool = False, view: TuningSpec | None = None
    ) -> Floats:
        """Return the constraints except stability at points (k, m + b): metrics, then the level (k, q).

        Parameters
        ----------
        setting
            The index of the setting.
        points
            The columns and the box (k, m + b).
        bounded
            Whether the values are upper bounds, including rounding errors of the metrics.
        view
            One of `views`, with the gain at one frequency; by default the largest gain over frequency.
        """
        spec = view or self.spec
        objective = spec.objective
        transparency_metrics = self.measured(setting, self._without_level(points), spec)
        error_bound = transparency_metrics[..., 1] if bounded else np.zeros(transparency_metrics.shape[:2])
        count = len(spec.transparency_metrics)
        values = np.log(np.maximum(transparency_metrics[:, :count, 0] + error_bound[:, :count], TINY))
        values -= np.log([metric.most for metric in spec.transparency_metrics])
        if objective.level:
            weights = [
                abs(weight) for weight, item in objective.terms if isinstance(item, TransparencyMetric)
            ]
            sums = _sums(objective, transparency_metrics[:, count:, 0], points)
            shortfall = (-1 if objective.maximize else 1) * (sums - points[:, len(spec.free)])
            violation = shortfall + error_bound[:, count:] @ weights
            # Large on the logarithmic scale: gains near a resonance are large, and slopes still descend.
            scaled_violation = violation / objective.scale
            scaled_violation = np.where(
                scaled_violation > 1, 1 + np.log(np.maximum(scaled_violation, 1)), scaled_violation
            )
            values = np.column_stack([values, scaled_violation])
        if spec.changing:
            values = np.column_stack([values, self.changing(setting, self._without_level(points))])
        values = np.nan_to_num(values, nan=BEYOND, posinf=BEYOND, neginf=NONE)
        return np.asarray(np.maximum(values, NONE))

    def changing(self, setting: int, numbers: Floats) -> Floats:
        """Return the logarithm of the loop gain (k,) under a time-varying delay, a proved upper bound.

        It is independent of constant delays, see `time_varying_delay.loop_gain`.

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
        parameter_refs = [interval.free for interval in (*self.spec.free, *self.spec.box)]
        values = np.full(len(numbers), math.inf)
        loop_gain = require_extension("loss_models").loop_gain
        for index, point in enumerate(map(tuple, numbers.tolist())):
            if (counts, point) not in self.loop_gains:
                if index and self.timed_out:
                    break
                pairs = zip(parameter_refs, map(Fraction, point), strict=True)
                topology = apply(self.numeric.model, [*counts, *(Override(*pair) for pair in pairs)])
                try:
                    gain = loop_gain(topology, delay.free, delay.low, delay.high)
                except NotSupportedError:
                    gain = math.inf
                self.loop_gains[counts, point] = math.log(max(gain, TINY))
            values[index] = self.loop_gains[counts, point]
        return values

    def sums(self, scenarios: Sequence[Scenario], chosen: Floats) -> Floats:
        """Return the objective's weighted sum in each scenario (s, k) at columns (k, m), NaN if undefined."""
        count, sums = len(self.spec.transparency_metrics), []
        for scenario in scenarios:
            points = np.hstack([chosen, np.tile(scenario.point, (len(chosen), 1))])
            transparency_metrics = self.measured(scenario.setting, self._without_level(points), self.spec)
            sums.append(_sums(self.spec.objective, transparency_metrics[:, count:, 0], points))
        return np.array(sums)

    def measured(self, setting: int, numbers: Floats, view: TuningSpec) -> Floats:
        """Return the metrics, their error bounds and frequencies in Hz (k, q, 3), at gains and box
        parameters (k, n).

        An undefined metric is infinite.
        """
        views = (self.spec, *self.views)
        metrics = list(dict.fromkeys(metric for spec in views for metric in spec.measured))
        values = np.full((len(numbers), len(metrics), 3), np.inf)
        _, topology = self.settings[setting]
        parameter_refs = [interval.free for interval in (*self.spec.free, *self.spec.box)]
        for index, point in enumerate(map(tuple, numbers.tolist()) if metrics else ()):
            row = values[index]
            if (setting, point, len(metrics)) not in self.transparency_values:
                if index and self.timed_out:
                    break
                pairs = zip(parameter_refs, map(Fraction, point), strict=True)
                with contextlib.suppress(ApcError):
                    changed = apply(topology, [Override(*pair) for pair in pairs])
                    row[:] = transparency_in(self.numeric.at(changed), metrics)
                self.transparency_values[setting, point, len(metrics)] = row.copy()
            row[:] = self.transparency_values[setting, point, len(metrics)]
        return values[:, [metrics.index(metric) for metric in view.measured]]

    def sampled(self, scenario: Scenario, chosen: Floats) -> Floats:
        """Return the largest constraint in a scenario (k,) at columns (k, m), computed once."""
        if scenario not in self.samples:
            self.samples[scenario] = self.worst_case([scenario], chosen)[:, 0]
        return self.samples[scenario]

    def rows(self, scenarios: Sequence[Scenario], chosen: Floats, *, wide: bool = False) -> ConstraintValues:
        """Return all constraints at columns (m,), with slopes.

        With `wide`, the slopes along the box parameters are included.
        """
        ranges = [*self.spec.columns, *self.spec.box]
        directions = np.diag([float(interval.high - interval.low) for interval in ranges])
        directions = directions if wide else directions[: len(chosen)]
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
            inward_directions = directions * np.where(
                point > [float(interval.low + interval.high) / 2 for interval in ranges], -1, 1
            )
            stencil = np.vstack([point, point + STEP * inward_directions])
            if isinstance(family, RadiusEvaluator):
                distinct, index_of = np.unique(self._without_level(stencil), axis=0, return_inverse=True)
                loop_values = [family.parts(item) for item in distinct.tolist()]
                # Without separate loops the single value represents each.
                loop_count = max(map(len, loop_values))
                padded = [
                    values_of_loops
                    if len(values_of_loops) == loop_count
                    else [max(values_of_loops)] * loop_count
                    for values_of_loops in loop_values
                ]
                roots = np.array(padded)[index_of.reshape(-1)]
                stability = np.nan_to_num(np.log(np.maximum(roots, TINY)), nan=BEYOND) - self.allowed
                parts.append((*_differences(stability, inward_directions), math.nan, index))
            else:
                repeated_point = np.tile(self._without_level(point), (len(directions), 1))
                for pair in family.slopes(repeated_point, self._without_level(directions)):
                    values, slopes, result = _dominant_modes(*pair)
                    parts.append((values - self.allowed, slopes, result, math.nan, index))
            smooth_constraints = self.constraint_values(scenario.setting, stencil)[:, np.logical_not(peaks)]
            parts.append((*_differences(smooth_constraints, inward_directions), math.nan, index))
            for frequency, view in zip(self.frequencies, self.views if any(peaks) else (), strict=False):
                peak_constraints = self.constraint_values(scenario.setting, stencil, view=view)[:, peaks]
                parts.append((*_differences(peak_constraints, inward_directions), frequency, index))
        counts = [len(values) for values, *_ in parts]
        return ConstraintValues(
            np.concatenate([values for values, *_ in parts]),
            np.concatenate([slopes for _, slopes, *_ in parts]),
            np.concatenate([values for *_, values, _, _ in parts]),
            np.repeat([frequency for *_, frequency, _ in parts], counts),
            np.repeat([index for *_, index in parts], counts),
        )


def _sums(objective: Objective, transparency_metrics: Floats, points: Floats) -> Floats:
    """Return the weighted sum (k,) of the objective from its metrics (k, f) at points (k, m + b).

    The sum is NaN if undefined.
    """
    metric_columns = iter(transparency_metrics.T)
    terms = [
        weight * (next(metric_columns) if isinstance(term, TransparencyMetric) else points[:, term])
        for weight, term in objective.terms
    ]
    total = np.asarray(np.sum(terms, axis=0))
    return np.where(np.isfinite(total), total, np.nan)


def transparency_in(
    numeric: NumericModel, metrics: Sequence[TransparencyMetric]
) -> list[tuple[float, float, float]]:
    """Return each transparency metric of a model, its error bound, and its frequency in Hz.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    metrics
        The transparency metrics.

    Raises
    ------
    ApcError
        The errors of `transparency`; E996 an undefined metric.
    """
    hertz = [metric.frequency_hz for metric in metrics if not math.isnan(metric.frequency_hz)] or [1.0]
    alongside = {PART_OF[metric.name] for metric in metrics if metric.name in PART_OF}
    # The search needs slopes also at unstable points, wherever the metrics are defined.
    responses = transparency(numeric, hertz, unstable="h2" not in alongside, alongside=alongside)
    result = []
    for metric in metrics:
        value, error_bound, frequency = 0.0, 0.0, metric.frequency_hz
        if metric.name in RESPONSES:
            response, bound = (getattr(responses, name) for name in RESPONSES[metric.name])
            value = abs(complex(response[hertz.index(metric.frequency_hz)]))
            error_bound = value * float(bound[hertz.index(metric.frequency_hz)])
        elif metric.name == "damping" and responses.low_frequency is not None:
            value, error_bound = responses.low_frequency.damping, responses.low_frequency.errors[1]
        elif metric.name == "coordination_error_h2" and responses.h2 and responses.h2[0].error_m is not None:
            value, error_bound = responses.h2[0].error_m, responses.h2[0].errors[0] or 0.0
        elif metric.name == HINF:
            if any(note.code is LimitationCode.COUPLED_COPIES for note in responses.notes):
                message = f"{metric.label} is not defined for different peers"
                raise ApcError(Diagnostic("E996", LOCATION, message, fix="coordination_error_h2"))
            for mode in (mode for mode in responses.hinf if mode.of == "error"):
                peak = mode.sampled_data
                peak_values = (peak.norm, peak.error, peak.frequency_hz)
                if not math.isnan(metric.frequency_hz):
                    peak_values = (
                        float(mode.gains[hertz.index(metric.frequency_hz)]),
                        peak.error,
                        metric.frequency_hz,
                    )
                value, error_bound, frequency = max((value, error_bound, frequency), peak_values)
        if value == 0:
            raise ApcError(Diagnostic("E996", CONSTRAINT, f"{metric.label} is not defined for this topology"))
        result.append((value, error_bound, frequency))
    return result


def _differences(values: Floats, along: Floats) -> tuple[Floats, Floats, Complexes]:
    """Return the first of values (1 + m, q), their slopes along directions (q, m), and NaN eigenvalues.

    Differences are one-sided, into the ranges, which halves the number of evaluations.
    """
    # The sign of a direction is that of its one nonzero entry.
    slopes = (values[1:] - values[0]) / STEP * np.sign(along.sum(axis=1))[:, None]
    return values[0], slopes.T, np.full(len(values[0]), np.nan, np.complex128)


def _log_radii(matrices: Floats) -> Floats:
    """Return ln |λ| of the largest eigenvalue of each matrix (k, n, n)."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    values = np.full(len(matrices), BEYOND)
    if matrices.shape[-1] and finite.any():
        largest = largest_magnitudes(matrices[finite])
        values[finite] = np.log(np.clip(largest, math.exp(NONE), None))
    return values if matrices.shape[-1] else np.full(len(matrices), NONE)


def _dominant_modes(matrix: Floats, slope: Floats) -> tuple[Floats, Floats, Complexes]:
    """Return ln |λ| of the dominant modes (n,), its slopes (n, m), and λ (n,)."""
    if not matrix.shape[-1]:  # nothing moves
        return np.full(1, NONE), np.zeros((1, len(slope))), np.zeros(1, np.complex128)
    count = min(MODES, matrix.shape[-1])
    if not (np.isfinite(matrix).all() and np.isfinite(slope).all()):
        return np.full(count, BEYOND), np.zeros((count, len(slope))), np.zeros(count, np.complex128)
    values, derivatives = eigenvalues(matrix, slope)
    sizes = np.where(values[0].imag >= 0, np.abs(values[0]), 0.0)
    largest = np.argsort(-sizes, kind="stable")[:count]
    is_nonzero = sizes[largest] > math.exp(NONE)
    value = np.where(is_nonzero, values[0, largest], 1.0)
    rates = np.where(is_nonzero, (derivatives[:, largest] / value).real, 0.0)
    return np.where(is_nonzero, np.log(np.abs(value)), NONE), rates.T, values[0, largest]
