"""One frame, event by event with the compiled functions themselves, against the lifted map.

Takes: a `CompiledSystem`. Gives: `check_frame`, `skipped`.
Guarantees: the Jacobians are what the functions multiply their inputs by, to rounding; the steps use neither
the composition nor the exponentials of `lift`. They are taken in balls, so that the lifted map alone is
rounded: the two may differ by the bound that comes with it, and by nothing else.
Does not: check a site whose equations are not affine, as its lifted map holds near one point only, or one
that hears by an edge function (see `skipped`).
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.timings import part
from apc.finite_equations import finite_equations
from apc.frame.ages import linear_sites
from apc.frame.discretize import (
    COEFFICIENT_ROUNDINGS,
    FEW_TOGETHER,
    PRECISIONS,
    TOO_LARGE,
    UNIT,
    moved_together,
    refuse_many,
)
from apc.frame.exact import evaluate_exact
from apc.frame.jacobians import SiteJacobians
from apc.frame.lift import FrameMap, lift
from apc.frame.linearize import linearize, linearize_exact
from apc.frame.parameters import Numbers, exact_numbers, resolve
from apc.frame.schedule import Act, Propagate, Schedule, Send, Tick, Value
from apc.frame.scheduling import build_schedules
from apc.frame.site import LinearSite
from apc.threads import load_pool, single_threaded

Floats = NDArray[np.float64]

# The seed of the random states: any will do, the same one gives the same answer.
SEED = 20_090_616

# Sites of one kind that are checked: they differ in numbers only, which the functions take as they come.
MOST_CHECKED = 3

# Columns that are compared with a function one by one, and evaluations of one with more: each costs as much
# as the function is long.
MOST_PROBES, FEWEST_PROBES = 64, 8

# The exponential is a Taylor series of X = A T/2^k with norms below 2^−16 and so many terms, then squared k
# times: what is left out of every mode is below 2^−(16·25)/25! of it, less than 2^−480.
SMALL, TERMS = 2.0**-16, 24

# A product of balls by itself, and one of many within a product of matrices, in nanoseconds.
SINGLE, WITHIN = 200, 3

# Rows multiplied together: few, so that what they share is most of the columns they take.
TOGETHER = 16

# The entries of a matrix of balls that are not zero, row by row, each with its column.
Rows = list[list[tuple[int, Any]]]

TINY = float(np.finfo(np.float64).tiny)


@part("self-check")
def check_frame(system: CompiledSystem) -> float:
    """Compare one frame of every kind, both ways, at random; return the largest relative difference.

    Raises
    ------
    AssertionError
        The two differ by more than rounding.
    ApcError
        E806 a frame leaves the range of floats; E812 a peer has too many states.
    """
    for kind in system.kinds:
        refuse_many(len(kind.states), Place(system.origin.topology))
    numbers = resolve(system)
    sites = linear_sites(system, numbers.timings)
    schedules = build_schedules(system, numbers.timings, [site.pattern for site in sites])
    chance = random.Random(SEED)  # NumPy's own takes longer to import than this to check
    largest = 0.0
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        for site, schedule, parameters in _checked(system, numbers, sites, schedules):
            exact = linearize_exact(site, parameters)
            lifted = lift(linearize(site, parameters), schedule, exact=exact)
            z = np.array([chance.gauss(0, 1) for _ in lifted.z_names])
            r = np.array([chance.gauss(0, 1) for _ in schedule.heard])
            mapped = np.concatenate([lifted.p @ z + lifted.q @ r, lifted.s @ z + lifted.d @ r])
            # Forces and displacements differ by the stiffness: each row is measured by its own terms.
            size = _terms(lifted, z, r)
            proven = _terms(lifted.error, z, r)
            if not (np.isfinite(size).all() and np.isfinite(proven).all()):
                raise ApcError(Mistake("E806", Place(system.origin.topology), TOO_LARGE))
            stepped = _precisely_stepped(exact, schedule, parameters, z, r, UNIT * size + TINY)
            apart = np.abs(stepped - mapped)
            # What has died out to below the error of a step is measured by that error.
            different = float(np.max(apart / (size + proven / UNIT + TINY), initial=0.0))
            # Beside the map's own error, the products with z and r that are added up here.
            allowed = proven + (len(z) + len(r) + 2) * (UNIT * size + TINY)
            assert (apart <= allowed).all(), (
                f"one frame of {site.kind.name}, stepped and lifted, differ by {different:.1e}"
            )
            largest = max(largest, different)
    return largest


def _terms(frame: FrameMap, z: Floats, r: Floats) -> Floats:
    """Return the magnitudes that each row of z⁺ and s adds up."""
    both = np.abs(np.concatenate([z, r]))
    return np.asarray(np.abs(np.block([[frame.p, frame.q], [frame.s, frame.d]])) @ both)


def skipped(system: CompiledSystem) -> tuple[str, ...]:
    """Return the kinds that are not checked, as they are not affine or look at each sender by itself."""
    sites = linear_sites(system)
    return tuple(site.kind.name for site in sites if not site.parameters_suffice)


def _checked(
    system: CompiledSystem,
    numbers: Numbers,
    sites: Sequence[SiteJacobians],
    schedules: Sequence[Schedule],
) -> Iterator[tuple[SiteJacobians, Schedule, Floats]]:
    """Yield the sites to check: of every kind, the first few that differ in numbers or schedule."""
    seen: dict[int, set[tuple[int, bytes]]] = {}
    for group, schedule, rows in zip(system.groups, schedules, numbers.parameters, strict=True):
        site, known = sites[group.kind], seen.setdefault(group.kind, set())
        if not site.parameters_suffice:
            continue
        for parameters in rows[:MOST_CHECKED]:
            key = (id(schedule), parameters.tobytes())
            if len(known) < MOST_CHECKED and key not in known:
                known.add(key)
                yield site, schedule, parameters


def _precisely_stepped(
    exact: LinearSite, schedule: Schedule, parameters: Floats, z: Floats, r: Floats, asked: Floats
) -> Floats:
    """Return z⁺ and s of one frame, each to the error asked for.

    Raises
    ------
    ApcError
        E806 no precision tried is enough.
    """
    import flint

    before = flint.ctx.prec
    try:
        for bits in PRECISIONS:
            flint.ctx.prec = bits
            balls = _stepped(_Stepped(exact, schedule, parameters), schedule, z, r)
            radius = np.array([float(ball.rad()) for ball in balls])
            if (radius <= asked).all():
                return np.array([float(ball.mid()) for ball in balls])
    finally:
        flint.ctx.prec = before
    raise ApcError(Mistake("E806", Place("the scene"), TOO_LARGE))


def _stepped(site: _Stepped, schedule: Schedule, z: Floats, r: Floats) -> list[Any]:
    """Step a site through one frame, from z and with r heard; return z⁺ and s in balls."""
    import flint

    n = len(site.kind.states)
    zero = flint.arb(0)
    start, heard = [flint.arb(one) for one in z.tolist()], [flint.arb(one) for one in r.tolist()]
    x, value = start[:n], dict(zip(schedule.carried, start[n:], strict=True))
    u = [value.get(one, zero) if one is not None else zero for one in schedule.acting]
    sent = [zero] * len(schedule.sent)
    for event in schedule.events:
        match event:
            case Propagate(duration):
                x = site.propagated(x, u, duration * schedule.quantum)
            case Act(hold, one):
                u[hold] = value.get(one, zero)
            case Send(partition, rows):
                everything = site.sends[partition].times([*x, *u])
                for channel, row in rows:
                    sent[row] = everything[channel]
            case Tick(partition, index, rows_heard):
                memories = site.kind.clocks[partition].memories
                m = [value.get(Value(partition, o, index - 1), zero) for o in memories]
                received = [sum((heard[row] for row in rows), zero) for rows in rows_heard]
                own = event.rows(len(site.kind.clocks[partition].outputs))
                outputs = site.ticks[partition].times([*x, *u, *m, *received])[own]
                value |= {Value(partition, o, index): number for o, number in enumerate(outputs)}
    after = [
        value[Value(one.partition, one.output, one.index + schedule.ticks[one.partition])]
        for one in schedule.carried
    ]
    return [*x, *after, *sent]


class _Stepped:
    """A site's functions less their values at zero, for steps in balls.

    They must be the Jacobians but for the roundings of these: CasADi folds their constants in floats, and a
    rounding of a rate grows by as many turns as there are in a step. It is what the site is analysed with
    that is stepped.
    """

    def __init__(self, exact: LinearSite, schedule: Schedule, parameters: Floats) -> None:
        self.kind = exact.kind
        p = exact_numbers(exact.kind, parameters)
        self.rates = _agreed(exact.kind.derivative, (exact.a, exact.b), p)
        lengths = [
            event.duration * schedule.quantum for event in schedule.events if isinstance(event, Propagate)
        ]
        self.parts = [_Part(states.tolist(), self.rates, lengths) for states in moved_together(exact.a)]
        self.ticks = [
            _agreed(clock.tick, (one.x, one.u, one.m, one.r), p)
            for clock, one in zip(exact.kind.clocks, exact.ticks, strict=True)
        ]
        self.sends = [
            _agreed(send.send, (one.x, one.u), p)
            for send, one in zip(exact.kind.sends, exact.sends, strict=True)
        ]

    def propagated(self, x: list[Any], u: list[Any], duration: Fraction) -> list[Any]:
        """Return x after `duration` seconds: dx/dt = A x + c, c = B u constant."""
        import flint

        constant = self.rates.times([flint.arb(0)] * len(x) + u)
        after = list(x)
        for joined in self.parts:
            states = joined.states
            moved = joined.moved([x[i] for i in states], [constant[i] for i in states], duration)
            for i, one in zip(states, moved, strict=True):
                after[i] = one
        return after


class _Part:
    """States that move together: e^{AT} x + φ₁(AT) T c, by both matrices or by the series of what they do.

    A matrix is made once a length and costs the cube of the states; the series is summed each time, and costs
    as much as A has entries, as often as A T is large.
    """

    def __init__(self, states: list[int], rates: _Sparse, lengths: Sequence[Fraction]) -> None:
        place = {state: i for i, state in enumerate(states)}
        self.states = states
        self.matrix = _Sparse([[(place[j], one) for j, one in rates.rows[i] if j in place] for i in states])
        self.steps: dict[Fraction, tuple[Any, Any]] = {}
        self.units, self.norm, n = np.ones(len(states)), np.inf, len(states)
        if n <= FEW_TOGETHER:
            return
        dense = np.zeros((n, n))
        for i, row in enumerate(self.matrix.rows):
            dense[i, [j for j, _ in row]] = [float(one) for _, one in row]
        balance = load_pool("scipy.linalg").matrix_balance
        balanced, (units, _) = balance(dense, permute=False, separate=True)
        norm = float(np.abs(balanced).sum(axis=1).max()) * (1 + n * UNIT)
        turns = sum(max(1.0, norm * float(length)) for length in lengths)
        if turns * sum(map(len, self.matrix.rows)) * SINGLE < len(set(lengths)) * n**3 * WITHIN:
            self.units, self.norm = units, norm

    def moved(self, x: list[Any], constant: list[Any], duration: Fraction) -> list[Any]:
        """Return where the states x are after `duration` seconds of dx/dt = A x + c."""
        import flint

        seconds = flint.arb(flint.fmpq(duration.numerator, duration.denominator))
        if np.isfinite(self.norm):
            times = max(1, int(np.ceil(self.norm * float(duration) * (1 + 4 * UNIT))))
            for _ in range(times):
                x = self._further(x, constant, seconds / times)
            return x
        if duration not in self.steps:
            n = len(x)
            dense = flint.arb_mat(n, n)
            for i, row in enumerate(self.matrix.rows):
                for j, one in row:
                    dense[i, j] = one
            self.steps[duration] = _step(dense, seconds)
        whole, mean = self.steps[duration]
        return [one + other for one, other in zip(_times(whole, x), _times(mean, constant), strict=True)]

    def _further(self, x: list[Any], constant: list[Any], seconds: Any) -> list[Any]:
        """Sum x + T (A x + c) + T²/2 A (A x + c) + …, ‖A T‖ ≤ 1: the rest is below twice the last term."""
        import flint

        term = [(one + other) * seconds for one, other in zip(self.matrix.times(x), constant, strict=True)]
        last = TERMS * flint.ctx.prec // PRECISIONS[0]
        for power in range(2, last + 2):
            x = [one + other for one, other in zip(x, term, strict=True)]
            share = seconds / power
            term = [one * share for one in self.matrix.times(term)]
        left = max(
            (float(abs(one).upper()) / unit for one, unit in zip(term, self.units.tolist(), strict=True)),
            default=0.0,
        )
        rest = [flint.arb(0, 2 * left * unit) for unit in self.units.tolist()]
        return [one + other for one, other in zip(x, rest, strict=True)]


def _step(rates: Any, seconds: Any) -> tuple[Any, Any]:
    """Return e^{AT} and φ₁(AT) T, φ₁(X) = I + X/2! + X²/3! + …, by φ₁(2X) = (e^X + 1) φ₁(X)/2."""
    import flint

    n = rates.nrows()
    whole = rates * seconds
    norm = max((sum(abs(float(one)) for one in row) for row in whole.tolist()), default=0.0)
    squarings = max(0, int(np.ceil(np.log2(norm / SMALL)))) if 0 < norm < np.inf else 0
    whole = whole / 2**squarings
    unit = flint.arb_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])
    mean = unit
    for term in range(TERMS, 0, -1):
        mean = unit + whole * mean / (term + 1)
    step = unit + whole * mean
    for _ in range(squarings):
        mean = (step * mean + mean) / 2
        step = step * step
    return step, mean * seconds


def _probes(columns: int) -> Iterator[NDArray[np.int64]]:
    """Yield inputs that tell the slopes: each column by itself or, of many, a few at once.

    Of more columns there are fewer probes, as each costs more: all cost as if each column were by itself.
    """
    count = max(FEWEST_PROBES, MOST_PROBES**2 // max(columns, MOST_PROBES))
    weights = (
        np.random.default_rng(SEED).integers(1, 2**16, columns)
        if columns > count
        else np.ones(columns, np.int64)
    )
    for first in range(count):
        probe = np.zeros(columns, np.int64)
        probe[first::count] = weights[first::count]
        if probe.any():
            yield probe


def _agreed(function: Any, slopes: Sequence[NDArray[Any]], p: list[Fraction]) -> _Sparse:
    """Return the slopes of an affine function as balls; they must be what it multiplies its inputs by."""
    import flint

    whole, given = np.hstack(slopes), [_rational(one) for one in p]

    def values(probe: NDArray[np.int64]) -> list[Any]:
        arguments, first = [], 0
        for size in (one.shape[1] for one in slopes):
            arguments.append([flint.fmpq(one) for one in probe[first : first + size].tolist()])
            first += size
        return evaluate_exact(function, [*arguments, given, [flint.fmpq(0)]], number=_rational)[0]

    filled: list[list[tuple[int, Any]]] = [[] for _ in whole]
    for row, column in np.argwhere(whole.astype(np.bool_)).tolist():
        filled[row].append((column, _rational(whole[row, column])))
    still = values(np.zeros(whole.shape[1], np.int64))
    sizes = [max((abs(one) for _, one in row), default=flint.fmpq(0)) for row in filled]
    rounding = _rational(COEFFICIENT_ROUNDINGS * UNIT)
    for probe in _probes(whole.shape[1]):
        many, inputs = int(probe.sum()), probe.tolist()
        for terms, size, before, after in zip(filled, sizes, still, values(probe), strict=True):
            expected = sum((one * inputs[column] for column, one in terms if inputs[column]), flint.fmpq(0))
            assert abs(after - before - expected) <= rounding * many * size, (
                f"the slopes of {function.name()} are not what it multiplies its inputs by"
            )
    return _Sparse([[(column, flint.arb(one)) for column, one in row] for row in filled])


def _rational(value: Fraction | float) -> Any:
    """Return a number as FLINT's rational, which computes ten times as fast as Python's."""
    import flint

    return flint.fmpq(*value.as_integer_ratio())


class _Sparse:
    """A matrix of balls by what is not zero of it: some rows at a time, over the columns these take."""

    def __init__(self, rows: Rows) -> None:
        import flint

        self.rows, self.blocks = rows, []
        for first in range(0, len(rows), TOGETHER):
            some = rows[first : first + TOGETHER]
            columns = sorted({column for row in some for column, _ in row})
            place = {column: number for number, column in enumerate(columns)}
            block = flint.arb_mat(len(some), len(columns))
            for number, row in enumerate(some):
                for column, one in row:
                    block[number, place[column]] = one
            self.blocks.append((block, columns))

    def times(self, vector: list[Any]) -> list[Any]:
        """Return the product with a vector."""
        return [
            one
            for block, columns in self.blocks
            for one in _times(block, [vector[column] for column in columns])
        ]


def _times(matrix: Any, vector: list[Any]) -> list[Any]:
    import flint

    return list((matrix * flint.arb_mat(len(vector), 1, vector)).entries())
