"""How far gains are from what limits them, in scenarios of all else that they have to bear.

Takes: a `Model` and `TuningSpec`.
Gives: `Scenario`, `ConstraintValues`, `ConstraintSet`.
Guarantees: a value below 0 is a demand that is met, in floats; slopes are those of the values.
Does not: choose scenarios, or prove (see `tuner`).

A scenario is a scene of its own, a number of peers and a delay (`settings`), and a point of the box. What
limits gains there is how fast each of the largest modes grows, ln |λ| less what is allowed; over a lossy
network or with passive hands it is the one number that the criterion has. What is felt counts as the
logarithm of what it is of the most it may be, and an aim's level by how far what it bounds is beyond it, of
the aim's size.
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
from apc.frame.instance import Prepared
from apc.frame.overrides import Override, apply
from apc.hands.frequency_response import feel
from apc.moments.changing_delay import loop_gain
from apc.threads import load_pool
from apc.tuning.demands import HINF, PLACE, SUBJECT, Objective, TransparencyMetric, TuningSpec
from apc.unserved import NotSupportedError
from apc.vary.batch import BatchEvaluator, MatrixSource
from apc.vary.delay_box import standing_delays
from apc.vary.evaluator import evaluator_of_many
from apc.vary.growth import BY_GROWTH, RadiusEvaluator
from apc.verdict import LimitationCode

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Of each system the largest modes are looked at, so many: where one takes the place of another both count.
MODES = 4

# The step of a difference, of a range: what it cuts off and what rounding leaves of it are then alike.
STEP = 1e-6

# Responses as `Transparency` has them, and their bounds; in what of it all else is; less than any size.
RESPONSES = {
    "impedance": ("impedance", "bound"),
    "transmitted": ("transmitted_admittance", "transmitted_bound"),
    "error": ("error_per_force", "error_bound"),
}
PART_OF = {"damping": "low_frequency", "error_h2": "h2", HINF: "hinf"}
TINY = 1e-300

# The lowest frequency in Hz at which the largest gain is looked for, the first; how much larger than at those
# known it has to be, as a share, for its own to be one of them.
SLOWEST, LARGER = 1e-3, 1e-6

# Points of a grid along each range of a box; how near to the top of what limits gains there it is followed.
GRID, POWELL = 5, {"xtol": 1e-5, "ftol": 1e-12}

# What stands for ln |λ| where there is no matrix, and for one of a mode that is not there.
BEYOND, NONE = 3.0, -30.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is borne: the number of a setting, and the numbers of the box."""

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
    """What limits the gains of a scene; after the time `until` of several points only the first is judged."""

    system: Model
    prepared: Prepared
    demands: TuningSpec
    until: float = math.inf
    known: dict[int, MatrixSource] = field(default_factory=dict)
    samples: dict[Scenario, Floats] = field(default_factory=dict)
    felt: dict[tuple[int, tuple[float, ...], int], Floats] = field(default_factory=dict)
    frequencies: list[float] = field(default_factory=lambda: [SLOWEST])
    loop_gains: dict[tuple[tuple[Override, ...], tuple[float, ...]], float] = field(default_factory=dict)

    @cached_property
    def settings(self) -> list[tuple[tuple[Override, ...], Model]]:
        """Every number of peers with every delay that stands for others, and the scene with these."""
        runs = [range(int(count.low), int(count.high) + 1) for count in self.demands.counts]
        pairs = []
        for counts in itertools.product(*runs):
            numbers = tuple(
                Override(item.free, Fraction(count))
                for item, count in zip(self.demands.counts, counts, strict=True)
            )
            scene, delay = apply(self.system, numbers), self.demands.delay
            if delay is None:
                pairs.append((numbers, scene))
                continue
            for value in dict.fromkeys(number for number, _ in standing_delays(scene, delay)):
                late = Override(delay.free, value)
                pairs.append(((*numbers, late), apply(scene, [late])))
        return pairs

    @cached_property
    def allowed(self) -> float:
        """What ln |λ| of a frame may be at most."""
        return math.log(self.demands.decay) * float(self.prepared.schedules[0].frame_s)

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() > self.until

    @property
    def by_growth(self) -> bool:
        """Whether stable means one number below 1, and not eigenvalues inside the circle."""
        return self.demands.criterion in BY_GROWTH

    @property
    def slow(self) -> bool:
        """Whether one point takes milliseconds."""
        asked = self.demands.measured or self.demands.changing
        return bool(asked) or not isinstance(self.family(0), BatchEvaluator)

    def every(self) -> list[Scenario]:
        """Return the middle and the corners of the box in every setting."""
        ends = [(float(interval.low), float(interval.high)) for interval in self.demands.box]
        middle = tuple((low + high) / 2 for low, high in ends)
        points = dict.fromkeys((middle, *itertools.product(*ends)))
        return [Scenario(place, point) for place in range(len(self.settings)) for point in points]

    def family(self, setting: int) -> MatrixSource:
        """Return what gives the matrices of a setting over the gains and the box."""
        if setting not in self.known:
            _, scene = self.settings[setting]
            free = [interval.free for interval in (*self.demands.free, *self.demands.box)]
            start = None if self.by_growth else prepare_at_start(scene, self.prepared, free)
            self.known[setting] = (
                RadiusEvaluator(scene, tuple(free), self.prepared, PLACE, self.demands.criterion)
                if start is None
                else evaluator_of_many(scene, free, PLACE, prepared=start)
            )
        return self.known[setting]

    def worst(self, scenarios: Sequence[Scenario], chosen: Floats) -> Floats:
        """Return the largest value in each scenario (k, s) with columns (k, m)."""
        values = np.full((len(chosen), len(scenarios)), BEYOND)
        size = 1 if self.slow else len(chosen)
        for begin in range(0, len(chosen), size):
            if begin and self.late:
                break
            some = slice(begin, begin + size)
            for place, scenario in enumerate(scenarios):
                points = np.hstack([chosen[some], np.tile(scenario.point, (len(chosen[some]), 1))])
                sizes = [
                    _sizes(matrix) for matrix in self.family(scenario.setting).matrices(self._numbers(points))
                ]
                grown = np.max([np.full(len(points), NONE), *sizes], axis=0) - self.allowed
                values[some, place] = np.max([grown, *self.asked(scenario.setting, points).T], axis=0)
        return values

    def _numbers(self, points: Floats) -> Floats:
        """Return the gains and the box of points (k, m + b), without the level of an aim."""
        level = range(len(self.demands.free), len(self.demands.columns))
        return np.delete(points, level, axis=-1)

    def worst_within(self, setting: int, chosen: Floats) -> tuple[Scenario, float]:
        """Return the point of the box that limits columns (m,) most in a setting, and its value.

        The worst of a grid is followed to the top by Powell's method, which takes no slopes: where modes take
        turns there is a ridge.
        """
        low, high = np.array([(float(interval.low), float(interval.high)) for interval in self.demands.box]).T

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
        """The demands with what is largest over all frequencies at each of those known: smooth limits all."""
        if all(felt.name != HINF for felt in self.demands.measured):
            return [self.demands]
        return [self.demands.at_frequency(frequency) for frequency in self.frequencies]

    def heard(self, scenarios: Sequence[Scenario], chosen: Floats) -> bool:
        """Add frequencies at which gains are larger, with columns (m,), than at those known; say if any are.

        Notes
        -----
        The exchange method for a limit at every frequency (Hettich and Kortanek, SIAM Rev. 35 (1993) 380).
        """
        before = len(self.frequencies)
        for scenario in scenarios:
            point = np.append(chosen, scenario.point)[None]
            values = np.max([self.asked(scenario.setting, point, view=view) for view in self.views], axis=0)
            peaks = self.measured(scenario.setting, self._numbers(point), self.demands)[0, :, 2]
            if (self.asked(scenario.setting, point) > values + LARGER).any():
                named = zip(self.demands.measured, np.maximum(peaks, SLOWEST).tolist(), strict=True)
                new = [peak for felt, peak in named if felt.name == HINF]
                self.frequencies.extend(peak for peak in new if peak not in self.frequencies)
        return len(self.frequencies) > before

    def asked(
        self, setting: int, points: Floats, *, bounded: bool = False, view: TuningSpec | None = None
    ) -> Floats:
        """Return how far points (k, m + b) are from the demands other than stability, and the level (k, q).

        Parameters
        ----------
        setting
            The number of peers and the delay.
        points
            The columns and the box (k, m + b).
        bounded
            Whether they are so far at least, with what rounding leaves open of what is felt.
        view
            One of `views`, which takes the largest gain at one frequency; without it, at all.
        """
        demands = view or self.demands
        aim = demands.aim
        felt = self.measured(setting, self._numbers(points), demands)
        off = felt[..., 1] if bounded else np.zeros(felt.shape[:2])
        count = len(demands.felt)
        values = np.log(np.maximum(felt[:, :count, 0] + off[:, :count], TINY))
        values -= np.log([felt.most for felt in demands.felt])
        if aim.level:
            weights = [abs(weight) for weight, item in aim.terms if isinstance(item, TransparencyMetric)]
            sums = _sums(aim, felt[:, count:, 0], points)
            short = (-1 if aim.larger else 1) * (sums - points[:, len(demands.free)])
            beyond = short + off[:, count:] @ weights
            # Far beyond by its logarithm: gains beside a resonance are large, and slopes still lead away.
            far = beyond / aim.scale
            far = np.where(far > 1, 1 + np.log(np.maximum(far, 1)), far)
            values = np.column_stack([values, far])
        if demands.changing:
            values = np.column_stack([values, self.changing(setting, self._numbers(points))])
        values = np.nan_to_num(values, nan=BEYOND, posinf=BEYOND, neginf=NONE)
        return np.asarray(np.maximum(values, NONE))

    def changing(self, setting: int, numbers: Floats) -> Floats:
        """Return ln of the loop gain under a delay that changes, (k,), with gains and box (k, n).

        It is proved from above (see `changing_delay.loop_gain`), and the same for every constant delay.
        """
        overrides, _ = self.settings[setting]
        counts, delay = overrides[: len(self.demands.counts)], self.demands.delay
        assert delay is not None, "a demand on a delay has its range"
        free = [interval.free for interval in (*self.demands.free, *self.demands.box)]
        values = np.full(len(numbers), math.inf)
        for place, point in enumerate(map(tuple, numbers.tolist())):
            if (counts, point) not in self.loop_gains:
                if place and self.late:
                    break
                pairs = zip(free, map(Fraction, point), strict=True)
                scene = apply(self.system, [*counts, *(Override(*pair) for pair in pairs)])
                try:
                    gain = loop_gain(scene, delay.free, delay.low, delay.high)
                except NotSupportedError:
                    gain = math.inf
                self.loop_gains[counts, point] = math.log(max(gain, TINY))
            values[place] = self.loop_gains[counts, point]
        return values

    def sums(self, scenarios: Sequence[Scenario], chosen: Floats) -> Floats:
        """Return the aim's weighted sum in each scenario (s, k) with columns (k, m), NaN of none."""
        count, sums = len(self.demands.felt), []
        for scenario in scenarios:
            points = np.hstack([chosen, np.tile(scenario.point, (len(chosen), 1))])
            felt = self.measured(scenario.setting, self._numbers(points), self.demands)
            sums.append(_sums(self.demands.aim, felt[:, count:, 0], points))
        return np.array(sums)

    def measured(self, setting: int, numbers: Floats, view: TuningSpec) -> Floats:
        """Return what is felt with gains and box (k, n), what it may be off by, and at how many Hz (k, q, 3).

        It is infinite where nothing is felt, or nothing can be said.
        """
        views = (self.demands, *self.views)
        asked = list(dict.fromkeys(felt for demands in views for felt in demands.measured))
        values = np.full((len(numbers), len(asked), 3), np.inf)
        _, scene = self.settings[setting]
        free = [interval.free for interval in (*self.demands.free, *self.demands.box)]
        for place, point in enumerate(map(tuple, numbers.tolist()) if asked else ()):
            row = values[place]
            if (setting, point, len(asked)) not in self.felt:
                if place and self.late:
                    break
                pairs = zip(free, map(Fraction, point), strict=True)
                with contextlib.suppress(ApcError):
                    changed = apply(scene, [Override(*pair) for pair in pairs])
                    row[:] = felt_in(changed, asked, self.prepared)
                self.felt[setting, point, len(asked)] = row.copy()
            row[:] = self.felt[setting, point, len(asked)]
        return values[:, [asked.index(felt) for felt in view.measured]]

    def sampled(self, scenario: Scenario, chosen: Floats) -> Floats:
        """Return the largest value in a scenario (k,) with columns (k, m), the same whenever it is asked."""
        if scenario not in self.samples:
            self.samples[scenario] = self.worst([scenario], chosen)[:, 0]
        return self.samples[scenario]

    def rows(self, scenarios: Sequence[Scenario], chosen: Floats, *, wide: bool = False) -> ConstraintValues:
        """Return all limits with columns (m,), their slopes along the numbers of the box, too, if `wide`."""
        ranges = [*self.demands.columns, *self.demands.box]
        along = np.diag([float(interval.high - interval.low) for interval in ranges])
        along = along if wide else along[: len(chosen)]
        parts: list[tuple[Floats, Floats, Complexes, float, int]] = []
        aim = [felt for _, felt in self.demands.aim.terms if isinstance(felt, TransparencyMetric)]
        peaks = [felt.name == HINF for felt in self.demands.felt]
        peaks += [any(felt.name == HINF for felt in aim)] * bool(self.demands.aim.terms)
        peaks += [False] * self.demands.changing
        for place, scenario in enumerate(scenarios):
            point = np.append(chosen, scenario.point)
            family = self.family(scenario.setting)
            inwards = along * np.where(
                point > [float(interval.low + interval.high) / 2 for interval in ranges], -1, 1
            )
            moved = np.vstack([point, point + STEP * inwards])
            if isinstance(family, RadiusEvaluator):
                distinct, which = np.unique(self._numbers(moved), axis=0, return_inverse=True)
                parted = [family.parts(item) for item in distinct.tolist()]
                # Where no loops are told apart, the one number stands for each.
                most = max(map(len, parted))
                alike = [each if len(each) == most else [max(each)] * most for each in parted]
                roots = np.array(alike)[which.reshape(-1)]
                grown = np.nan_to_num(np.log(np.maximum(roots, TINY)), nan=BEYOND) - self.allowed
                parts.append((*_differences(grown, inwards), math.nan, place))
            else:
                at = np.tile(self._numbers(point), (len(along), 1))
                for pair in family.slopes(at, self._numbers(along)):
                    values, slopes, result = _largest(*pair)
                    parts.append((values - self.allowed, slopes, result, math.nan, place))
            still = self.asked(scenario.setting, moved)[:, np.logical_not(peaks)]
            parts.append((*_differences(still, inwards), math.nan, place))
            for frequency, view in zip(self.frequencies, self.views if any(peaks) else (), strict=False):
                asked = self.asked(scenario.setting, moved, view=view)[:, peaks]
                parts.append((*_differences(asked, inwards), frequency, place))
        counts = [len(values) for values, *_ in parts]
        return ConstraintValues(
            np.concatenate([values for values, *_ in parts]),
            np.concatenate([slopes for _, slopes, *_ in parts]),
            np.concatenate([values for *_, values, _, _ in parts]),
            np.repeat([frequency for *_, frequency, _ in parts], counts),
            np.repeat([place for *_, place in parts], counts),
        )


def _sums(aim: Objective, felt: Floats, points: Floats) -> Floats:
    """Return the weighted sum that is an aim (k,), of what is felt of it (k, f) at points (k, m + b)."""
    of_hands = iter(felt.T)
    terms = [
        w * (next(of_hands) if isinstance(item, TransparencyMetric) else points[:, item])
        for w, item in aim.terms
    ]
    total = np.asarray(np.sum(terms, axis=0))
    return np.where(np.isfinite(total), total, np.nan)


def felt_in(
    system: Model, asked: Sequence[TransparencyMetric], prepared: Prepared
) -> list[tuple[float, float, float]]:
    """Return each of what is asked about the hands of a scene, what it may be off by, and at how many Hz.

    Parameters
    ----------
    system
        The compiled scene, with its numbers.
    asked
        What is felt.
    prepared
        From `instance.prepare`, of this scene with any numbers.

    Raises
    ------
    ApcError
        Those of `feel`; E996 nothing is felt of it.
    """
    hertz = [felt.frequency_hz for felt in asked if not math.isnan(felt.frequency_hz)] or [1.0]
    beside = {PART_OF[felt.name] for felt in asked if felt.name in PART_OF}
    # Beside what is stable, too, the slopes of a search want what is felt wherever there is something to say.
    felt_response = feel(system, hertz, unstable="h2" not in beside, beside=beside, prepared=prepared)
    result = []
    for felt in asked:
        value, off, hz = 0.0, 0.0, felt.frequency_hz
        if felt.name in RESPONSES:
            response, bound = (getattr(felt_response, name) for name in RESPONSES[felt.name])
            value = abs(complex(response[hertz.index(felt.frequency_hz)]))
            off = value * float(bound[hertz.index(felt.frequency_hz)])
        elif felt.name == "damping" and felt_response.low_frequency is not None:
            value, off = felt_response.low_frequency.damping, felt_response.low_frequency.errors[1]
        elif felt.name == "error_h2" and felt_response.h2 and felt_response.h2[0].error_m is not None:
            value, off = felt_response.h2[0].error_m, felt_response.h2[0].errors[0] or 0.0
        elif felt.name == HINF:
            if any(note.code is LimitationCode.COUPLED_COPIES for note in felt_response.notes):
                what = f"{felt.label} is not told of peers that differ, which move apart together"
                raise ApcError(Diagnostic("E996", PLACE, what, hint="feel.error_h2"))
            for mode in (mode for mode in felt_response.hinf if mode.of == "error"):
                peak = mode.sampled_data
                own = (peak.norm, peak.error, peak.frequency_hz)
                if not math.isnan(felt.frequency_hz):
                    own = (float(mode.gains[hertz.index(felt.frequency_hz)]), peak.error, felt.frequency_hz)
                value, off, hz = max((value, off, hz), own)
        if value == 0:
            raise ApcError(Diagnostic("E996", SUBJECT, f"of {felt.label} nothing is felt in this scene"))
        result.append((value, off, hz))
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
