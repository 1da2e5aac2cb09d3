"""The best gains within limits, of a few scenarios at a time.

Takes: `ConstraintSet`, scenarios.
Gives: `Optimum`, `ScenarioOptimizer`.
Guarantees: the same question, the same gains: what is drawn is drawn by a fixed rule.
Does not: prove that nothing is better: so many points were looked at, and none was.

Points spread evenly over the ranges say where to start. From there SciPy's SLSQP goes downhill; several modes
that limit at once are limits each, so that a corner of the stable region is an ordinary optimum. Where
limits i bind, ∇f + Σ μ_i ∇v_i = 0 holds there: the multipliers μ say what each of them costs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apc.threads import load_pool
from apc.tuning.limits import STEP, ConstraintSet, ConstraintValues, Scenario

Floats = NDArray[np.float64]

# Points looked at to begin with: of matrices, of one number that takes milliseconds, and of what is felt.
# For each end of a range there are so much fewer; of one range that takes long so many at most.
POINTS, SLOW_POINTS, FELT_POINTS, FACES, LINE = 2048, 256, 96, 8, 48

# Of these so many at a time are looked at in all scenarios, and so often.
LOOK, SLOW_LOOK, LOOKS = 64, 8, 4

# The least error, of a value: floats know no more of where their eigenvalues cross.
LEAST = 1e-9

# How nearly a descent is followed to its end, as a share of the range: of matrices, where a point takes
# milliseconds, and where it takes tens of them and slopes are differences of what is felt.
FINE, ROUGH, ROUGHER = 1e-14, 1e-9, 1e-7

# How far a descent goes at most before limits are linear again, shorter each time that it leads to nothing,
# as far beyond them limits say nothing of where they are; and how far at last.
SHORTER, NEAREST = 0.25, 1e-3

# Steps of a descent at most.
STEPS = 200

# A limit of differences that rises by more than this, over a whole range, as a gain leaves the end of it, has
# jumped by a tenth: a velocity is sampled from then on, say. Such a gain stays where it is.
JUMPS = 0.1 / STEP

# The share of an aim's slope that limits may leave unbalanced at an optimum; where it is more, the descent
# ended on its way.
ASTRAY = 0.5

# More than any aim is worth.
HUGE = 1e9

# How far the level of an aim may be from where it is looked for, in widths of that range.
FAR = 1e6

# The least share of a range in which points are spread by ratios.
SMALLEST = 1e-3

# What a limit that binds may be off by; what is left open of the conditions of an optimum.
BINDS, OPEN = 1e-6, 1e-8


@dataclass(frozen=True, slots=True)
class Optimum:
    """The best gains (m,) found in some scenarios: the `value` of the aim, right to `error`, what limits it.

    The error is infinite where a descent ended on its way. `worst` is the largest limit, above 0 where no
    gains meet them all. `multipliers` (n,) of `rows` say how much of the aim each costs, per unit of ln |λ|;
    `looked` points were looked at.
    """

    scenarios: tuple[Scenario, ...]
    gains: Floats
    value: float
    error: float
    worst: float
    rows: ConstraintValues
    multipliers: Floats
    looked: int


class TimeUp(Exception):
    """No time is left to look at another point."""


@dataclass(frozen=True, eq=False)
class ScenarioOptimizer:
    """A search for the best gains in some scenarios.

    The gain, or level, in `column` is to be large (`sign` 1) or small (−1); without a column the largest
    limit is to be as small as can be.
    Inside, ranges are 0 to 1; t stands for the largest limit, where that is the aim.
    """

    limits: ConstraintSet
    scenarios: Sequence[Scenario]
    column: int | None
    sign: float = 1.0

    @cached_property
    def _low(self) -> Floats:
        return np.array([float(column.low) for column in self.limits.demands.columns])

    @cached_property
    def _width(self) -> Floats:
        return np.array([float(column.high) for column in self.limits.demands.columns]) - self._low

    @cached_property
    def _ends(self) -> Floats:
        """The least and largest share of each range (2, m): the level of an aim may be beyond its own."""
        ends = np.array([np.zeros(len(self._low)), np.ones(len(self._low))])
        if self.limits.demands.aim.level:
            ends[:, -1] = -FAR, FAR
        return ends

    @property
    def _near(self) -> float:
        """How nearly a descent is followed to its end."""
        return ROUGHER if self.limits.demands.measured else ROUGH if self.limits.slow else FINE

    def gains(self, shares: Floats) -> Floats:
        """Return gains (…, m) of shares of their ranges."""
        return np.asarray(self._low + self._width * np.clip(shares, *self._ends))

    def _worst(self, shares: Floats) -> Floats:
        """Return the largest limit at shares (k, m)."""
        return np.asarray(self.limits.worst(self.scenarios, self.gains(shares)).max(axis=1))

    def _merit(self, shares: Floats, worst: Floats) -> Floats:
        """Return what is to be small (k,), of points that meet the limits."""
        return worst if self.column is None else -self.sign * shares[:, self.column]

    def at(self, start: Floats) -> Optimum:
        """Return what there is at shares of the ranges, as if it were the best."""
        return self._optimum(start, self.limits.rows(self.scenarios, self.gains(start)))

    def start(self, present: Floats, every: Sequence[Scenario], than: Optimum | None = None) -> list[Floats]:
        """Return where to go downhill from, shares of the ranges: the best of points spread evenly.

        Parameters
        ----------
        present
            Gains to look at as well.
        every
            All scenarios, in which a few of the points that are best in the search's own are looked at.
        than
            What is known: only a point that does better in all scenarios is returned then, if there is one.
        """
        points = np.vstack([np.clip((present - self._low) / self._width, *self._ends), self.even])
        gains = self.gains(points)
        worst = np.max([self.limits.sampled(scenario, gains) for scenario in self.scenarios], axis=0)
        points = self._at_level(points, self.scenarios)
        order = np.argsort(self._order(points, worst), kind="stable")
        if than is not None:
            met = self.column is not None and than.worst <= BINDS
            number = self._order(self.shares(than)[None], np.array([0.0 if met else than.worst]))[0]
            order = order[self._order(points, worst)[order] < number - OPEN]
        size, left = (SLOW_LOOK if self.limits.slow else LOOK), LOOKS
        for begin in range(0, min(len(order), size * LOOKS), size):
            some = order[begin : begin + size]
            points[some] = self._at_level(points[some], every)
            ranks = self._order(points[some], self.limits.worst(every, self.gains(points[some])).max(axis=1))
            place, left = int(np.argmin(ranks)), left - 1
            if ranks[place] < (number - OPEN if than is not None else 0.0 if left else np.inf):
                return [points[some[place]]]
        return []

    def _at_level(self, points: Floats, scenarios: Sequence[Scenario]) -> Floats:
        """Return points (k, m) with the level of the aim, if it has one, where it is just met."""
        if not self.limits.demands.aim.level:
            return points
        gains = self.gains(points)
        sums = self.limits.sums(scenarios, gains)
        level = sums.min(axis=0) if self.sign > 0 else sums.max(axis=0)
        shares = (level - self._low[-1]) / self._width[-1] - OPEN * self.sign
        return np.column_stack([points[:, :-1], np.nan_to_num(shares, nan=-self.sign * FAR)])

    def _order(self, points: Floats, worst: Floats) -> Floats:
        """Return what the best of points (k, m) has least of, far below 0 where it meets the limits."""
        merit = self._merit(points, worst)
        return merit if self.column is None else np.where(worst <= 0, merit - HUGE, worst)

    @cached_property
    def even(self) -> Floats:
        """Points (k, m) spread evenly over the ranges, every other one by ratios, and over their ends."""
        demands = self.limits.demands
        count = FELT_POINTS if demands.measured else SLOW_POINTS if self.limits.slow else POINTS
        if self.limits.slow:
            count = min(count, LINE ** len(demands.free))
        even = _even(count, len(self._low))
        top = self._low + self._width
        near = np.where(self._low > 0, self._low, SMALLEST * self._width)
        ratios = np.where(top > near, near * (np.maximum(top, near) / near) ** even[::2], top)
        even[::2] = np.clip((ratios - self._low) / self._width, 0.0, 1.0)
        ends = [even[: len(even) // FACES].copy() for _ in range(2 * len(top))]
        for place, points in enumerate(ends):
            points[:, place // 2] = place % 2
        points = np.vstack([even, *ends])
        if demands.aim.level:  # where any gains are on its good side
            points[:, -1] = -self.sign * FAR
        return points

    def best(self, starts: Sequence[Floats]) -> Optimum:
        """Return the best that descents from starts (shares of the ranges) find."""
        return min(map(self.descended, starts), key=self._rank)

    def shares(self, optimum: Optimum) -> Floats:
        """Return the gains of an optimum as shares of their ranges."""
        return np.asarray((optimum.gains - self._low) / self._width)

    def _own_merit(self, optimum: Optimum) -> float:
        return float(self._merit(self.shares(optimum)[None], np.array([optimum.worst]))[0])

    def _rank(self, optimum: Optimum) -> tuple[bool, float]:
        """Return what the best of several has least of."""
        met = self.column is None or optimum.worst <= BINDS
        return not met, self._own_merit(optimum) if met else optimum.worst

    def descended(self, start: Floats) -> Optimum:
        """Return where a descent from shares of the ranges ends."""
        optimize = load_pool("scipy.optimize")
        known: dict[bytes, ConstraintValues] = {}
        rows_of = self._remembered(known)
        size, spare = len(start), self.column is None
        at_end = (start == self._ends[0]) | (start == self._ends[1])
        rows = rows_of(start)
        worst = rows.values.max()
        rises = rows.slopes * np.where(start > self._ends[0], -1, 1)
        binds = rows.values[:, None] + STEP * rises > (worst if spare else 0.0)
        held = at_end & self.limits.slow & ((rises > JUMPS) & binds).any(axis=0)
        here = np.append(start, worst) if spare else start
        aim = np.zeros(len(here))
        aim[-1 if spare else self.column] = 1.0 if spare else -self.sign

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
                    lambda z: float(aim @ z),
                    here,
                    jac=lambda z: aim,
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
            seen = [self._optimum(np.frombuffer(key), rows) for key, rows in known.items()]
            best = min(best, *seen, key=self._rank)
        return replace(best, looked=len(known))

    def _remembered(self, known: dict[bytes, ConstraintValues]) -> Callable[[Floats], ConstraintValues]:
        """Return what gives the limits at shares (m,), once each; it raises `TimeUp`, but of the first."""

        def rows_of(shares: Floats) -> ConstraintValues:
            key = np.ascontiguousarray(shares).tobytes()
            if key not in known:
                if known and self.limits.late:
                    raise TimeUp
                known[key] = self.limits.rows(self.scenarios, self.gains(shares))
            return known[key]

        return rows_of

    def _optimum(self, shares: Floats, rows: ConstraintValues) -> Optimum:
        """Return an optimum with what its limits cost: the multipliers that best balance the aim."""
        worst = float(rows.values.max(initial=-np.inf))
        inner = (shares > self._ends[0] + OPEN) & (shares < self._ends[1] - OPEN)
        if self.column is None:  # the largest ln |λ| of a frame: weights of one
            value, level, scale = worst + self.limits.allowed, worst, 1.0
            aim, weights = np.append(np.zeros(inner.sum()), 1.0), np.ones((len(rows.values), 1))
        else:
            value, level = float(self.gains(shares)[self.column]), 0.0
            scale = float(self._width[self.column])
            aim, weights = np.zeros(len(shares)), np.ones((len(rows.values), 0))
            aim[self.column] = self.sign
            aim = aim[inner]
        near = np.flatnonzero(rows.values >= level - BINDS * 100)
        slopes = np.hstack([rows.slopes[:, inner], weights])[near].T
        multipliers, free = np.zeros(len(rows.values)), float(np.linalg.norm(aim))
        if slopes.size:
            multipliers[near], free = load_pool("scipy.optimize").nnls(slopes, aim)
        # What limits that don't quite bind leave open.
        error = max(scale * float(multipliers @ np.abs(rows.values - level)), LEAST * abs(value))
        error = error if self.column is None or free < ASTRAY else np.inf
        if self.limits.slow and self.column is not None:
            error = max(error, 10 * self._near * scale)
        return Optimum(tuple(self.scenarios), self.gains(shares), value, error, worst, rows, multipliers, 0)


def _even(count: int, size: int) -> Floats:
    """Return points (count, size) evenly spread over 0 to 1: Halton's sequence, the same at every call."""
    halton = load_pool("scipy.stats.qmc").Halton(size, scramble=False)
    return np.asarray(halton.random(count + 1)[1:])  # the first is the corner at 0
