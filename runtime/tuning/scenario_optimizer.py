"""The optimal gains under constraints, for a few scenarios at a time.

Takes: `ConstraintSet`, scenarios.
Gives: `Optimum`, `ScenarioOptimizer`.
Guarantees: the result is reproducible: sample points are deterministic.
Does not: prove global optimality: the optimum is the best of the points evaluated.

A low-discrepancy set of points over the ranges provides the start. From there SciPy's SLSQP descends. Several
simultaneously active modes are separate constraints, so that a corner of the stable region is an ordinary
optimum. With active constraints i, ∇f + Σ μ_i ∇v_i = 0: the multipliers μ are their sensitivities.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apc.support.threads import load_pool
from apc.tuning.constraints import STEP, ConstraintSet, ConstraintValues, Scenario

Floats = NDArray[np.float64]

# Numbers of initial points: for matrices, for criterion values of some milliseconds, and for metrics. At each
# end of a range there are fewer by the factor FACES; for one slow range there are at most LINE.
POINTS, SLOW_POINTS, TRANSPARENCY_POINTS, FACES, LINE = 2048, 256, 96, 8, 48

# The number of best points evaluated in all scenarios, and the number of repetitions.
LOOK, SLOW_LOOK, MOST_EVALUATIONS = 64, 8, 4

# The least relative error of a value: the accuracy of eigenvalue crossings in floats.
LEAST = 1e-9

# The tolerance of a descent, as a share of the range: for matrices, for criteria of some milliseconds, and
# for metrics with difference quotients as slopes.
FINE, ROUGH, ROUGHER = 1e-14, 1e-9, 1e-7

# The largest step of a descent before constraints are linearized again; it shrinks after each step without
# progress. The last value is the smallest step.
SHORTER, NEAREST = 0.25, 1e-3

# The largest number of steps of a descent.
STEPS = 200

# The slope of a constraint by differences, at an end of a gain's range, above which it has a discontinuity of
# a tenth (for example, a velocity becomes sampled). Such a gain is fixed at this end.
JUMPS = 0.1 / STEP

# The unbalanced share of the objective's gradient accepted at an optimum; beyond it, the descent has not
# converged.
ASTRAY = 0.5

# Above any value of an objective.
HUGE = 1e9

# The distance allowed between the level of an objective and its search range, in widths of that range.
FAR = 1e6

# The least share of a range for points in equal ratios.
SMALLEST = 1e-3

# The tolerance of an active constraint; the tolerance of equal objectives.
BINDS, OPEN = 1e-6, 1e-8


@dataclass(frozen=True, slots=True)
class Optimum:
    """The optimal gains (m,) for some scenarios: the objective `value` with its `error`, and active
    constraints.

    The error is infinite without convergence. `worst_case` is the largest constraint, above 0 if no gains
    satisfy all. `multipliers` (n,) of `rows` are the sensitivities of the objective per unit of ln |λ|;
    `evaluations` is the number of evaluations.
    """

    scenarios: tuple[Scenario, ...]
    gains: Floats
    value: float
    error: float
    worst_case: float
    rows: ConstraintValues
    multipliers: Floats
    evaluations: int


class TimeUp(Exception):
    """Raised when the time limit is reached."""


@dataclass(frozen=True, eq=False)
class ScenarioOptimizer:
    """The optimization of gains for some scenarios.

    The gain, or level, in `column` is maximized (`sign` 1) or minimized (−1); without a column the largest
    constraint is minimized. Internally, ranges are scaled to 0 to 1.
    """

    constraints: ConstraintSet
    scenarios: Sequence[Scenario]
    column: int | None
    sign: float = 1.0

    @cached_property
    def _low(self) -> Floats:
        """The lower ends of the ranges (m,)."""
        return np.array([float(column.low) for column in self.constraints.spec.columns])

    @cached_property
    def _width(self) -> Floats:
        """The widths of the ranges (m,)."""
        return np.array([float(column.high) for column in self.constraints.spec.columns]) - self._low

    @cached_property
    def _ends(self) -> Floats:
        """The least and largest share of each range (2, m).

        The level of an objective may exceed its range.
        """
        ends = np.array([np.zeros(len(self._low)), np.ones(len(self._low))])
        if self.constraints.spec.objective.level:
            ends[:, -1] = -FAR, FAR
        return ends

    @property
    def _tolerance(self) -> float:
        """The tolerance of a descent."""
        return ROUGHER if self.constraints.spec.measured else ROUGH if self.constraints.slow else FINE

    def gains(self, shares: Floats) -> Floats:
        """Return the gains (…, m) at shares of their ranges."""
        return np.asarray(self._low + self._width * np.clip(shares, *self._ends))

    def _merit(self, shares: Floats, worst: Floats) -> Floats:
        """Return the objective (k,) to be minimized, at points that satisfy the constraints."""
        return worst if self.column is None else -self.sign * shares[:, self.column]

    def at(self, start: Floats) -> Optimum:
        """Return the optimum record at given shares of the ranges, without a descent."""
        return self._optimum(start, self.constraints.rows(self.scenarios, self.gains(start)))

    def start(
        self, present: Floats, all_scenarios: Sequence[Scenario], than: Optimum | None = None
    ) -> list[Floats]:
        """Return the start points of the descent, as shares of the ranges: the best of the sample points.

        Parameters
        ----------
        present
            The present gains, an additional point.
        all_scenarios
            All scenarios, for the evaluation of the best points in the search's scenarios.
        than
            A known result: then only a point that is better in all scenarios is returned.
        """
        points = np.vstack([np.clip((present - self._low) / self._width, *self._ends), self.sample_points])
        gains = self.gains(points)
        worst = np.max([self.constraints.sampled(scenario, gains) for scenario in self.scenarios], axis=0)
        points = self._with_level(points, self.scenarios)
        order = np.argsort(self._search_merit(points, worst), kind="stable")
        if than is not None:
            feasible = self.column is not None and than.worst_case <= BINDS
            known_merit = self._search_merit(
                self.shares(than)[None], np.array([0.0 if feasible else than.worst_case])
            )[0]
            order = order[self._search_merit(points, worst)[order] < known_merit - OPEN]
        size, remaining_batches = (SLOW_LOOK if self.constraints.slow else LOOK), MOST_EVALUATIONS
        for begin in range(0, min(len(order), size * MOST_EVALUATIONS), size):
            batch = order[begin : begin + size]
            points[batch] = self._with_level(points[batch], all_scenarios)
            ranks = self._search_merit(
                points[batch],
                self.constraints.worst_case(all_scenarios, self.gains(points[batch])).max(axis=1),
            )
            index, remaining_batches = int(np.argmin(ranks)), remaining_batches - 1
            if ranks[index] < (
                known_merit - OPEN if than is not None else 0.0 if remaining_batches else np.inf
            ):
                return [points[batch[index]]]
        return []

    def _with_level(self, points: Floats, scenarios: Sequence[Scenario]) -> Floats:
        """Return points (k, m) with the objective's level set to the value that is just satisfied."""
        if not self.constraints.spec.objective.level:
            return points
        gains = self.gains(points)
        sums = self.constraints.sums(scenarios, gains)
        level = sums.min(axis=0) if self.sign > 0 else sums.max(axis=0)
        shares = (level - self._low[-1]) / self._width[-1] - OPEN * self.sign
        return np.column_stack([points[:, :-1], np.nan_to_num(shares, nan=-self.sign * FAR)])

    def _search_merit(self, points: Floats, worst: Floats) -> Floats:
        """Return the merit of points (k, m) to minimize, far below 0 if the constraints are satisfied."""
        merit = self._merit(points, worst)
        return merit if self.column is None else np.where(worst <= 0, merit - HUGE, worst)

    @cached_property
    def sample_points(self) -> Floats:
        """Points (k, m) spread over the ranges, half of them in equal ratios, and over their ends."""
        spec = self.constraints.spec
        count = TRANSPARENCY_POINTS if spec.measured else SLOW_POINTS if self.constraints.slow else POINTS
        if self.constraints.slow:
            count = min(count, LINE ** len(spec.free))
        spread_points = _halton_points(count, len(self._low))
        top = self._low + self._width
        positive_low = np.where(self._low > 0, self._low, SMALLEST * self._width)
        ratios = np.where(
            top > positive_low,
            positive_low * (np.maximum(top, positive_low) / positive_low) ** spread_points[::2],
            top,
        )
        spread_points[::2] = np.clip((ratios - self._low) / self._width, 0.0, 1.0)
        ends = [spread_points[: len(spread_points) // FACES].copy() for _ in range(2 * len(top))]
        for index, points in enumerate(ends):
            points[:, index // 2] = index % 2
        points = np.vstack([spread_points, *ends])
        if spec.objective.level:  # a level that all gains satisfy
            points[:, -1] = -self.sign * FAR
        return points

    def best_point(self, starts: Sequence[Floats]) -> Optimum:
        """Return the best optimum of descents from several starts (shares of the ranges)."""
        return min(map(self.descend, starts), key=self._rank)

    def shares(self, optimum: Optimum) -> Floats:
        """Return the gains of an optimum as shares of their ranges."""
        return np.asarray((optimum.gains - self._low) / self._width)

    def _merit_of(self, optimum: Optimum) -> float:
        """Return the merit of an optimum to minimize, from its gains and its largest constraint."""
        return float(self._merit(self.shares(optimum)[None], np.array([optimum.worst_case]))[0])

    def _rank(self, optimum: Optimum) -> tuple[bool, float]:
        """Return the key of an optimum in a comparison: infeasibility, then merit."""
        feasible = self.column is None or optimum.worst_case <= BINDS
        return not feasible, self._merit_of(optimum) if feasible else optimum.worst_case

    def descend(self, start: Floats) -> Optimum:
        """Return the optimum at the end of a descent from a start (shares of the ranges)."""
        optimize = load_pool("scipy.optimize")
        evaluated: dict[bytes, ConstraintValues] = {}
        rows_of = self._cached(evaluated)
        size, has_level = len(start), self.column is None
        at_end = (start == self._ends[0]) | (start == self._ends[1])
        rows = rows_of(start)
        worst = rows.values.max()
        inward_slopes = rows.slopes * np.where(start > self._ends[0], -1, 1)
        may_become_active = rows.values[:, None] + STEP * inward_slopes > (worst if has_level else 0.0)
        fixed = at_end & self.constraints.slow & ((inward_slopes > JUMPS) & may_become_active).any(axis=0)
        current = np.append(start, worst) if has_level else start
        objective = np.zeros(len(current))
        objective[-1 if has_level else self.column] = 1.0 if has_level else -self.sign

        def margins(z: Floats) -> Floats:
            """Return the remaining margins of the constraints at z."""
            return np.asarray((z[-1] if has_level else 0.0) - rows_of(z[:size]).values)

        def margin_slopes(z: Floats) -> Floats:
            """Return the derivatives of the margins at z."""
            slopes = np.where(fixed, 0.0, -rows_of(z[:size]).slopes)
            return np.column_stack([slopes, np.ones(len(slopes))]) if has_level else slopes

        best, trust_radius = self._optimum(start, rows_of(start)), 1.0
        try:
            while trust_radius > NEAREST:
                bounds = np.clip([current[:size] - trust_radius, current[:size] + trust_radius], *self._ends)
                bounds = np.where(fixed, start, bounds).T.tolist()
                ended = optimize.minimize(
                    lambda z: float(objective @ z),
                    current,
                    jac=lambda z: objective,
                    method="SLSQP",
                    bounds=[*bounds, *[(None, None)] * has_level],
                    constraints=[{"type": "ineq", "fun": margins, "jac": margin_slopes}],
                    options={"ftol": self._tolerance, "maxiter": STEPS},
                )
                shares = np.clip(np.nan_to_num(ended.x[:size], nan=0.5), *self._ends)
                for end in self._ends:
                    shares = np.where(np.abs(shares - end) < OPEN, end, shares)
                optimum = self._optimum(shares, rows_of(shares))
                (infeasible, value), known_rank = self._rank(optimum), self._rank(best)
                has_improved = (infeasible, value + max(OPEN, self._tolerance)) < known_rank
                if (infeasible, value) < known_rank:
                    best, current = optimum, np.append(shares, ended.x[size:])
                if has_improved and ended.success and trust_radius == 1:
                    break
                trust_radius *= 1.0 if has_improved and trust_radius < 1 else SHORTER
        except TimeUp:
            candidates = [self._optimum(np.frombuffer(key), rows) for key, rows in evaluated.items()]
            best = min(best, *candidates, key=self._rank)
        return replace(best, evaluations=len(evaluated))

    def _cached(self, evaluated: dict[bytes, ConstraintValues]) -> Callable[[Floats], ConstraintValues]:
        """Return the function of shares (m,) to constraints, each evaluated once.

        After the time limit, a new evaluation raises `TimeUp`.
        """

        def rows_of(shares: Floats) -> ConstraintValues:
            """Return the constraints at shares (m,), from the cache if possible."""
            key = np.ascontiguousarray(shares).tobytes()
            if key not in evaluated:
                if evaluated and self.constraints.timed_out:
                    raise TimeUp
                evaluated[key] = self.constraints.rows(self.scenarios, self.gains(shares))
            return evaluated[key]

        return rows_of

    def _optimum(self, shares: Floats, rows: ConstraintValues) -> Optimum:
        """Return the record of a point, with Lagrange multipliers and an error bound of the objective.

        Parameters
        ----------
        shares
            The gains as shares (m,) of their ranges, 0 to 1.
        rows
            The constraints there, values ≤ 0 and slopes over the shares.

        Notes
        -----
        At an optimum Σ_k μ_k ∇c_k = ∇f with μ ≥ 0 over the active constraints, and over the gains that are
        not at an end of their range: μ by non-negative least squares. The error is the slack μ_k |c_k|, and
        infinite if the gradients do not balance. Without a gain as objective the largest constraint is
        minimized: its level is a further variable, with slope 1 in every constraint.
        """
        worst = float(rows.values.max(initial=-np.inf))
        is_interior = (shares > self._ends[0] + OPEN) & (shares < self._ends[1] - OPEN)
        if self.column is None:  # the largest ln |λ| of a frame: weights of one
            value, level, scale = worst + self.constraints.allowed, worst, 1.0
            objective, weights = np.append(np.zeros(is_interior.sum()), 1.0), np.ones((len(rows.values), 1))
        else:
            value, level = float(self.gains(shares)[self.column]), 0.0
            scale = float(self._width[self.column])
            objective, weights = np.zeros(len(shares)), np.ones((len(rows.values), 0))
            objective[self.column] = self.sign
            objective = objective[is_interior]
        nearly_active = np.flatnonzero(rows.values >= level - BINDS * 100)
        slopes = np.hstack([rows.slopes[:, is_interior], weights])[nearly_active].T
        multipliers, unbalanced = np.zeros(len(rows.values)), float(np.linalg.norm(objective))
        if slopes.size:
            multipliers[nearly_active], unbalanced = load_pool("scipy.optimize").nnls(slopes, objective)
        # The slack of nearly active constraints.
        error = max(scale * float(multipliers @ np.abs(rows.values - level)), LEAST * abs(value))
        error = error if self.column is None or unbalanced < ASTRAY else np.inf
        if self.constraints.slow and self.column is not None:
            error = max(error, 10 * self._tolerance * scale)
        return Optimum(tuple(self.scenarios), self.gains(shares), value, error, worst, rows, multipliers, 0)


def _halton_points(count: int, size: int) -> Floats:
    """Return points (count, size) spread over 0 to 1 by Halton's sequence, without the corner at 0.

    Notes
    -----
    A coordinate of point i has the digits of i, in reverse order, as its fraction; the bases are the first
    primes. SciPy has the same sequence, but its import takes longer than all evaluations of a search.
    """
    numbers = np.arange(1, count + 1)
    primes = (number for number in itertools.count(2) if all(number % below for below in range(2, number)))
    return np.transpose(
        [
            sum(numbers // base**digit % base / base ** (digit + 1) for digit in range(count.bit_length()))
            for base in itertools.islice(primes, size)
        ]
    )
