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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apc.threads import load_pool
from apc.tuning.constraints import STEP, ConstraintSet, ConstraintValues, Scenario

Floats = NDArray[np.float64]

# Numbers of initial points: for matrices, for one criterion value of some milliseconds, and for metrics. For
# each scenario corner there are fewer by this factor; for one slow range at most this number.
POINTS, SLOW_POINTS, TRANSPARENCY_POINTS, FACES, LINE = 2048, 256, 96, 8, 48

# The number of best points evaluated in all scenarios, and the number of repetitions.
LOOK, SLOW_LOOK, MOST_EVALUATIONS = 64, 8, 4

# The least error, of a value: floats know no more of where their eigenvalues cross.
LEAST = 1e-9

# The tolerance of a descent, as a share of the range: for matrices, with milliseconds per point, and for
# slower criteria with difference quotients as slopes.
FINE, ROUGH, ROUGHER = 1e-14, 1e-9, 1e-7

# The largest step of a descent before constraints are linearized again; it shrinks after each step without
# progress. The last value is the smallest step.
SHORTER, NEAREST = 0.25, 1e-3

# Steps of a descent at most.
STEPS = 200

# A constraint by differences that rises by more than this, over an entire range, as a gain leaves the end of
# its range, has a discontinuity of a tenth (for example, a velocity becomes sampled). Such a gain is fixed.
JUMPS = 0.1 / STEP

# The unbalanced share of the objective's gradient accepted at an optimum; beyond it, the descent has not
# converged.
ASTRAY = 0.5

# More than any aim is worth.
HUGE = 1e9

# The distance allowed between the level of an objective and its search range, in widths of that range.
FAR = 1e6

# The least share of a range in which points are spread by ratios.
SMALLEST = 1e-3

# The tolerance of an active constraint; the residual of optimality conditions.
BINDS, OPEN = 1e-6, 1e-8


@dataclass(frozen=True, slots=True)
class Optimum:
    """The optimal gains (m,) for some scenarios: the objective `value`, right to `error`, active constraints.

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
    """No time is left to look at another point."""


@dataclass(frozen=True, eq=False)
class ScenarioOptimizer:
    """A search for the optimal gains for some scenarios.

    The gain, or level, in `column` is maximized (`sign` 1) or minimized (−1); without a column the largest
    constraint is minimized. Internally, ranges are scaled to 0 to 1; t is the largest constraint, if that is
    the objective.
    """

    constraints: ConstraintSet
    scenarios: Sequence[Scenario]
    column: int | None
    sign: float = 1.0

    @cached_property
    def _low(self) -> Floats:
        return np.array([float(column.low) for column in self.constraints.spec.columns])

    @cached_property
    def _width(self) -> Floats:
        return np.array([float(column.high) for column in self.constraints.spec.columns]) - self._low

    @cached_property
    def _ends(self) -> Floats:
        """The least and largest share of each range (2, m): the level of an aim may be beyond its own."""
        ends = np.array([np.zeros(len(self._low)), np.ones(len(self._low))])
        if self.constraints.spec.objective.level:
            ends[:, -1] = -FAR, FAR
        return ends

    @property
    def _near(self) -> float:
        """The tolerance of a descent."""
        return ROUGHER if self.constraints.spec.measured else ROUGH if self.constraints.slow else FINE

    def gains(self, shares: Floats) -> Floats:
        """Return gains (…, m) of shares of their ranges."""
        return np.asarray(self._low + self._width * np.clip(shares, *self._ends))

    def _worst_case(self, shares: Floats) -> Floats:
        """Return the largest limit at shares (k, m)."""
        return np.asarray(self.constraints.worst_case(self.scenarios, self.gains(shares)).max(axis=1))

    def _merit(self, shares: Floats, worst: Floats) -> Floats:
        """Return the objective (k,) to be minimized, at points that satisfy the constraints."""
        return worst if self.column is None else -self.sign * shares[:, self.column]

    def at(self, start: Floats) -> Optimum:
        """Return the result at given shares of the ranges, as a candidate."""
        return self._optimum(start, self.constraints.rows(self.scenarios, self.gains(start)))

    def start(self, present: Floats, every: Sequence[Scenario], than: Optimum | None = None) -> list[Floats]:
        """Return start points of the descent, as shares of the ranges: the best of evenly spread points.

        Parameters
        ----------
        present
            Additional gains to evaluate.
        every
            All scenarios, in which the best few points of the search's scenarios are evaluated.
        than
            A known result: then only a point that is better in all scenarios is returned, if any.
        """
        points = np.vstack([np.clip((present - self._low) / self._width, *self._ends), self.even])
        gains = self.gains(points)
        worst = np.max([self.constraints.sampled(scenario, gains) for scenario in self.scenarios], axis=0)
        points = self._at_level(points, self.scenarios)
        order = np.argsort(self._order(points, worst), kind="stable")
        if than is not None:
            feasible = self.column is not None and than.worst_case <= BINDS
            number = self._order(self.shares(than)[None], np.array([0.0 if feasible else than.worst_case]))[0]
            order = order[self._order(points, worst)[order] < number - OPEN]
        size, left = (SLOW_LOOK if self.constraints.slow else LOOK), MOST_EVALUATIONS
        for begin in range(0, min(len(order), size * MOST_EVALUATIONS), size):
            some = order[begin : begin + size]
            points[some] = self._at_level(points[some], every)
            ranks = self._order(
                points[some], self.constraints.worst_case(every, self.gains(points[some])).max(axis=1)
            )
            index, left = int(np.argmin(ranks)), left - 1
            if ranks[index] < (number - OPEN if than is not None else 0.0 if left else np.inf):
                return [points[some[index]]]
        return []

    def _at_level(self, points: Floats, scenarios: Sequence[Scenario]) -> Floats:
        """Return points (k, m) with the level of the aim, if it has one, where it is just met."""
        if not self.constraints.spec.objective.level:
            return points
        gains = self.gains(points)
        sums = self.constraints.sums(scenarios, gains)
        level = sums.min(axis=0) if self.sign > 0 else sums.max(axis=0)
        shares = (level - self._low[-1]) / self._width[-1] - OPEN * self.sign
        return np.column_stack([points[:, :-1], np.nan_to_num(shares, nan=-self.sign * FAR)])

    def _order(self, points: Floats, worst: Floats) -> Floats:
        """Return the merit of points (k, m) to minimize, far below 0 if the constraints are satisfied."""
        merit = self._merit(points, worst)
        return merit if self.column is None else np.where(worst <= 0, merit - HUGE, worst)

    @cached_property
    def even(self) -> Floats:
        """Points (k, m) spread evenly over the ranges, every other one by ratios, and over their ends."""
        spec = self.constraints.spec
        count = TRANSPARENCY_POINTS if spec.measured else SLOW_POINTS if self.constraints.slow else POINTS
        if self.constraints.slow:
            count = min(count, LINE ** len(spec.free))
        even = _even(count, len(self._low))
        top = self._low + self._width
        near = np.where(self._low > 0, self._low, SMALLEST * self._width)
        ratios = np.where(top > near, near * (np.maximum(top, near) / near) ** even[::2], top)
        even[::2] = np.clip((ratios - self._low) / self._width, 0.0, 1.0)
        ends = [even[: len(even) // FACES].copy() for _ in range(2 * len(top))]
        for index, points in enumerate(ends):
            points[:, index // 2] = index % 2
        points = np.vstack([even, *ends])
        if spec.objective.level:  # where any gains are on its good side
            points[:, -1] = -self.sign * FAR
        return points

    def best_point(self, starts: Sequence[Floats]) -> Optimum:
        """Return the best that descents from starts (shares of the ranges) find."""
        return min(map(self.descended, starts), key=self._rank)

    def shares(self, optimum: Optimum) -> Floats:
        """Return the gains of an optimum as shares of their ranges."""
        return np.asarray((optimum.gains - self._low) / self._width)

    def _local_merit(self, optimum: Optimum) -> float:
        return float(self._merit(self.shares(optimum)[None], np.array([optimum.worst_case]))[0])

    def _rank(self, optimum: Optimum) -> tuple[bool, float]:
        """Return the merit of a result in a comparison of several."""
        feasible = self.column is None or optimum.worst_case <= BINDS
        return not feasible, self._local_merit(optimum) if feasible else optimum.worst_case

    def descended(self, start: Floats) -> Optimum:
        """Return the end of a descent from shares of the ranges."""
        optimize = load_pool("scipy.optimize")
        known: dict[bytes, ConstraintValues] = {}
        rows_of = self._cached(known)
        size, spare = len(start), self.column is None
        at_end = (start == self._ends[0]) | (start == self._ends[1])
        rows = rows_of(start)
        worst = rows.values.max()
        rises = rows.slopes * np.where(start > self._ends[0], -1, 1)
        binds = rows.values[:, None] + STEP * rises > (worst if spare else 0.0)
        held = at_end & self.constraints.slow & ((rises > JUMPS) & binds).any(axis=0)
        here = np.append(start, worst) if spare else start
        objective = np.zeros(len(here))
        objective[-1 if spare else self.column] = 1.0 if spare else -self.sign

        def left(z: Floats) -> Floats:
            return np.asarray((z[-1] if spare else 0.0) - rows_of(z[:size]).values)

        def moves(z: Floats) -> Floats:
            slopes = np.where(held, 0.0, -rows_of(z[:size]).slopes)
            return np.column_stack([slopes, np.ones(len(slopes))]) if spare else slopes

        best, reach = self._optimum(start, rows_of(start)), 1.0
        try:
            while reach > NEAREST:
                near = np.clip([here[:size] - reach, here[:size] + reach], *self._ends)
                near = np.where(held, start, near).T.tolist()
                ended = optimize.minimize(
                    lambda z: float(objective @ z),
                    here,
                    jac=lambda z: objective,
                    method="SLSQP",
                    bounds=[*near, *[(None, None)] * spare],
                    constraints=[{"type": "ineq", "fun": left, "jac": moves}],
                    options={"ftol": self._near, "maxiter": STEPS},
                )
                shares = np.clip(np.nan_to_num(ended.x[:size], nan=0.5), *self._ends)
                for end in self._ends:
                    shares = np.where(np.abs(shares - end) < OPEN, end, shares)
                optimum = self._optimum(shares, rows_of(shares))
                (unmet, value), known_rank = self._rank(optimum), self._rank(best)
                far = (unmet, value + max(OPEN, self._near)) < known_rank
                if (unmet, value) < known_rank:
                    best, here = optimum, np.append(shares, ended.x[size:])
                if far and ended.success and reach == 1:
                    break
                reach *= 1.0 if far and reach < 1 else SHORTER
        except TimeUp:
            observed = [self._optimum(np.frombuffer(key), rows) for key, rows in known.items()]
            best = min(best, *observed, key=self._rank)
        return replace(best, evaluations=len(known))

    def _cached(self, known: dict[bytes, ConstraintValues]) -> Callable[[Floats], ConstraintValues]:
        """Return the constraints at shares (m,), evaluated once each; raises `TimeUp` except at the first."""

        def rows_of(shares: Floats) -> ConstraintValues:
            key = np.ascontiguousarray(shares).tobytes()
            if key not in known:
                if known and self.constraints.timed_out:
                    raise TimeUp
                known[key] = self.constraints.rows(self.scenarios, self.gains(shares))
            return known[key]

        return rows_of

    def _optimum(self, shares: Floats, rows: ConstraintValues) -> Optimum:
        """Return an optimum with its shadow prices: the multipliers that best balance the objective."""
        worst = float(rows.values.max(initial=-np.inf))
        inner = (shares > self._ends[0] + OPEN) & (shares < self._ends[1] - OPEN)
        if self.column is None:  # the largest ln |λ| of a frame: weights of one
            value, level, scale = worst + self.constraints.allowed, worst, 1.0
            objective, weights = np.append(np.zeros(inner.sum()), 1.0), np.ones((len(rows.values), 1))
        else:
            value, level = float(self.gains(shares)[self.column]), 0.0
            scale = float(self._width[self.column])
            objective, weights = np.zeros(len(shares)), np.ones((len(rows.values), 0))
            objective[self.column] = self.sign
            objective = objective[inner]
        near = np.flatnonzero(rows.values >= level - BINDS * 100)
        slopes = np.hstack([rows.slopes[:, inner], weights])[near].T
        multipliers, free = np.zeros(len(rows.values)), float(np.linalg.norm(objective))
        if slopes.size:
            multipliers[near], free = load_pool("scipy.optimize").nnls(slopes, objective)
        # The slack of nearly active constraints.
        error = max(scale * float(multipliers @ np.abs(rows.values - level)), LEAST * abs(value))
        error = error if self.column is None or free < ASTRAY else np.inf
        if self.constraints.slow and self.column is not None:
            error = max(error, 10 * self._near * scale)
        return Optimum(tuple(self.scenarios), self.gains(shares), value, error, worst, rows, multipliers, 0)


def _even(count: int, size: int) -> Floats:
    """Return points (count, size) evenly spread over 0 to 1: Halton's sequence, the same at every call."""
    halton = load_pool("scipy.stats.qmc").Halton(size, scramble=False)
    return np.asarray(halton.random(count + 1)[1:])  # the first is the corner at 0
