"""What a linear system does in a while: the exact matrix exponential, inputs held.

Takes: the matrices of dx/dt = A x + B u, exact, or of many sites at once in floats.
Gives: `Step`, `discretize`, `moved_together`, `refuse_many`; in floats, `exponential`, `exponential_rows`,
`step_rows`, `exponential_values`; `step_balls`.
Guarantees: every entry of `discretize` is right to the last digit but one, proved by ball arithmetic, whether
a mode dies out in a nanosecond or never; where many states move together and it is off by no more than
composing it rounds, it is had in floats. Every step comes with a bound.
Does not: know when anything happens (see `scheduling`).

    x(t + T) = F x(t) + G u        [F G; 0 I] = exp([A B; 0 0] T)

(Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Autom. Control 1978.) The
textbook form (1 − e^{−bT/m}) m/b loses every digit as b goes to 0, and scaling and squaring in double
precision loses log₂(bT/m) bits where the mass is tiny. Arb's exponential (Johansson, IEEE Trans. Computers
2017) in enough bits loses none, and says so.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place
from apc.threads import load_pool

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128
Integers = NDArray[np.int64]

UNIT = float(np.finfo(np.float64).eps) / 2  # the unit roundoff of double precision

# Bits tried in turn. A mode that dies out within T at rate a needs about 53 + 2·log₂(aT) of them.
PRECISIONS = (128, 256, 512, 1024, 2048)

# Radius asked of every ball, relative to the largest entry: far below a rounding of double precision.
RADIUS = 2.0**-80


# States of one peer, whose matrices hold a rational an entry.
MOST_STATES = 1000

# States that move together whose exponential is one of balls: of more, floats are looked at first, as balls
# cost 30 times as much, and only up to so many are there balls where floats say too little: some seconds.
FEW_TOGETHER, MOST_TOGETHER = 64, 250
# How many times as much as composing rounds a step in floats may be off by, where balls are too many.
DOUBTFUL = 1e4
# Inputs beside fewer states: each is a row more of the exponential.
FEWEST_INPUTS = 8

# Steps of sites that are remembered, and of how many entries in all, A's and B's for each duration.
KEPT, FEW_ENTRIES = 128, 1 << 14

# Rounding errors charged to every coefficient a site's functions give, in units of UNIT: CasADi evaluates
# short polynomials of the parameters, a few roundings an entry.
COEFFICIENT_ROUNDINGS = 8

# With ‖X‖ ≤ 1/2 the Taylor series of φ₁ is right to 2^−64 after so many terms: (1/2)^17/17! is less than
# 2^−64, with all that follows.
TERMS = 16
LEFT_OUT = 2.0**-64

# What a number below the range of floats may be off by when it is rounded to zero, in units of UNIT.
UNDERFLOW = float(np.finfo(np.float64).tiny) / UNIT


TOO_LARGE = (
    "one frame of this scene leaves the range of floating point numbers: "
    "a stiffness or delay is too large for it, or a mass too small"
)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """[F G] of one duration (n_x, n_x + n_u), or of many sites (k, …); real or complex.

    The true entries lie within `roundings` · UNIT · `size` of `matrix`.
    """

    matrix: NDArray[Any]
    size: Floats
    roundings: float = 1.0


def discretize(a: NDArray[Any], b: NDArray[Any], durations: Sequence[Fraction]) -> tuple[Step, ...]:
    """Return the step of every duration.

    Parameters
    ----------
    a, b
        A (n_x, n_x) and B (n_x, n_u), entries exact: `Fraction` or float taken at its word. Or those of many
        sites in floats (k, …), which may be off by `COEFFICIENT_ROUNDINGS`.
    durations
        T in seconds.

    Raises
    ------
    ApcError
        E806 an entry of the exponential is too large for a float: something grows without measure within T;
        E812 too many states, or too many that move together.
    """
    if a.ndim > 2:
        return tuple(step_rows(a, b, float(duration)) for duration in durations)
    if len(durations) * (a.size + b.size) > FEW_ENTRIES:
        return _discretized(a, b, durations)
    entries = (*a.ravel().tolist(), *b.ravel().tolist())
    return _known_steps(entries, a.shape, b.shape, tuple(durations))


@functools.lru_cache(maxsize=KEPT)
def _known_steps(
    entries: tuple[Any, ...], of_a: tuple[int, int], of_b: tuple[int, int], durations: tuple[Fraction, ...]
) -> tuple[Step, ...]:
    """Return `discretize` of few entries, row by row: what only couplers and links change is remembered."""
    whole = np.array([*entries, None])[:-1]  # of objects, also where there are no entries
    split = of_a[0] * of_a[1]
    return _discretized(whole[:split].reshape(of_a), whole[split:].reshape(of_b), durations)


def _discretized(a: NDArray[Any], b: NDArray[Any], durations: Sequence[Fraction]) -> tuple[Step, ...]:
    """Return `discretize`, computed."""
    n_x = len(a)
    matrices = np.zeros((len(durations), n_x, n_x + b.shape[1]))
    sizes = np.full(matrices.shape, UNDERFLOW)
    roundings = 1.0
    for states, inputs in _pieces(a, b):
        places = np.ix_(states, np.concatenate([states, n_x + inputs]))
        steps = _steps(a[np.ix_(states, states)], b[np.ix_(states, inputs)], durations)
        for matrix, size, step in zip(matrices, sizes, steps, strict=True):
            matrix[places], size[places] = step.matrix, step.size
            roundings = max(roundings, step.roundings)
    return tuple(Step(*pair, roundings) for pair in zip(matrices, sizes, strict=True))


def refuse_many(states: int, place: Place) -> None:
    """Refuse more states of one peer than are exponentiated: ApcError E812."""
    if states > MOST_STATES:
        what = f"one peer has {states:,} states, and {MOST_STATES:,} are the most that are analysed"
        raise ApcError(Mistake("E812", place, what, hint="smaller arrays, as count: 100"))


def _pieces(a: NDArray[Any], b: NDArray[Any]) -> Iterator[tuple[Integers, Integers]]:
    """Yield states that move together with a few of the inputs that move them, until all are had.

    What moves by itself has an exponential of its own, and so has each input's column of G: an array of a
    thousand parts costs a thousand small cubes, not one of its own.

    Raises
    ------
    ApcError
        E812 too many states.
    """
    refuse_many(len(a), Place("the scene"))
    for states in moved_together(a):
        inputs = np.flatnonzero(b[states].astype(np.bool_).any(axis=0))
        step = max(len(states), FEWEST_INPUTS)
        for begin in range(0, max(len(inputs), 1), step):
            yield states, inputs[begin : begin + step]


def _steps(a: NDArray[Any], b: NDArray[Any], durations: Sequence[Fraction]) -> list[Step]:
    """Return the steps of states that move together: in floats where they are many, else in balls.

    Raises
    ------
    ApcError
        E806 as `discretize`; E812 too many for balls where floats say too little.
    """
    if len(a) > FEW_TOGETHER:
        steps = _balanced_steps(_floats(a), _floats(b), durations)
        if steps is not None:
            return steps
        if len(a) > MOST_TOGETHER:
            what = (
                f"{len(a)} states of one peer move together in continuous time, so fast that floats lose "
                f"them in a step, and {MOST_TOGETHER} such states are the most that are analysed"
            )
            hint = "smaller arrays, as count: 100, or shorter periods"
            raise ApcError(Mistake("E812", Place("the scene"), what, hint=hint))
    generator = _generator(a, b)
    return [_step(generator * _rational(duration), len(a)) for duration in durations]


def _balanced_steps(a: Floats, b: Floats, durations: Sequence[Fraction]) -> list[Step] | None:
    """Return the steps in floats; None where one may be off by much more than composing it rounds."""
    allowed = 2.0 if len(a) <= MOST_TOGETHER else DOUBTFUL
    steps = []
    for duration in durations:
        with np.errstate(all="ignore"):
            step, units = exponential(a, b, float(duration), rounded=3)
            matrix, size = step.matrix, step.size
            largest = np.abs(matrix).max()
            if not size.max() <= allowed * largest < np.inf:
                return None
            steps.append(Step(units * matrix, units * size + UNDERFLOW, step.roundings))
    return steps


def exponential(
    a: Floats, b: Floats, seconds: float, *, rounded: int = 2 * COEFFICIENT_ROUNDINGS
) -> tuple[Step, Floats]:
    """Return [F G] of one site as `exponential_rows`, in units of its own, and what these are of it (n_x, n).

    Parameters
    ----------
    a, b
        A (n_x, n_x) and B (n_x, n_u).
    seconds, rounded
        As for `exponential_rows`.

    Notes
    -----
    In units in which the rows of a large A are as large as its columns, powers of 2 of those given, its
    exponential takes the fewest squarings, and the largest of it says how far any of it may be off.
    """
    units = np.ones(len(a))
    if len(a) > FEW_TOGETHER:
        a, (units, _) = load_pool("scipy.linalg").matrix_balance(a, permute=False, separate=True)
    step = exponential_rows(a[None], b[None] / units[:, None], seconds, rounded=rounded)
    whole = units[:, None] / np.concatenate([units, np.ones(b.shape[1])])
    return Step(step.matrix[0], step.size[0], step.roundings), whole


def step_rows(a: Floats, b: Floats, seconds: float) -> Step:
    """Return `exponential_rows` of many sites, states that move together in any of them by themselves.

    What all sites have in common, as copies of one object have, is exponentiated once; and how fast one
    object's motion dies out does not make the series of another's longer.

    Parameters
    ----------
    a, b
        A (k, n_x, n_x) and B (k, n_x, n_u).
    seconds
        T.
    """
    sites, n_x, n_u = b.shape
    matrix = np.zeros((sites, n_x, n_x + n_u))
    size, roundings = np.full(matrix.shape, UNDERFLOW), 1.0
    for states, inputs in _pieces(np.asarray(a.any(axis=0)), np.asarray(b.any(axis=0))):
        own, pushed = a[:, states[:, None], states], b[:, states[:, None], inputs]
        some = slice(1 if all((values == values[:1]).all() for values in (own, pushed)) else sites)
        step = exponential_rows(own[some], pushed[some], seconds)
        places = slice(None), states[:, None], np.concatenate([states, n_x + inputs])
        matrix[places], size[places] = step.matrix, step.size
        roundings = max(roundings, step.roundings)
    return Step(matrix, size, roundings)


def exponential_rows(
    a: Matrix, b: Matrix, seconds: float, *, rounded: int = 2 * COEFFICIENT_ROUNDINGS
) -> Step:
    """Return exp of many generators by scaling and squaring, x(t + T) = F x(t) + G u.

    Parameters
    ----------
    a, b
        A (k, n_x, n_x) and B (k, n_x, n_u), float64 or complex128.
    seconds
        T.
    rounded
        How many roundings each entry of A T and B T may be off by, those of T and of the product included.

    Returns
    -------
    The steps of all of them, [F G] (k, n_x, n_x + n_u).

    Notes
    -----
    With X = A T/2^s, ‖X‖ ≤ 1/2, and Y = φ₁(X) by Horner's rule, F = I + X Y and G = Y B T/2^s; then
    s times F ← F², G ← F G + G. A sum rounds as often as it has terms that are not zero, n of them. X^j has
    then been rounded less than j (n + 4) times, and G's X^j B (j + 1)(n + 4) times; over all j these make
    n + 4 roundings of |X| e^|X| and of e^|X| |B|, and F one more where I is added. What the series leaves out
    is less than 2^−64 of the largest, which counts where more states stand in a row than it has terms.
    """
    n_x, n_u = b.shape[-2:]
    x, g, steps = _squared_steps(a, b, seconds)
    step = next(steps)
    size = np.abs(x)
    large = _phi(size)
    terms = max(np.count_nonzero(x, axis=-1).max(initial=0), np.count_nonzero(g, axis=-2).max(initial=0))
    charge = float(terms + 6 + rounded)
    grown, pushed = np.eye(n_x) + size @ large, np.abs(g)
    error = (charge * UNIT) * np.concatenate([size @ grown, grown @ pushed], axis=-1)
    error[..., :n_x] += UNIT * np.abs(step[..., :n_x])
    if n_x > TERMS:
        error[..., :n_x] += LEFT_OUT
        error[..., n_x:] += LEFT_OUT * pushed.sum(axis=-2, keepdims=True)
    for following in steps:
        whole, off = _whole(step), np.concatenate([error, np.zeros((*b.shape[:-2], n_u, n_x + n_u))], axis=-2)
        size = np.abs(whole)
        terms = int(np.count_nonzero(whole, axis=-1).max(initial=0))
        large = size[..., :n_x, :]
        error = (large + error) @ off + (error + (terms + 2) * UNIT * large) @ size
        step = following
    # Composing a step rounds it as often as it is wide: one that is off by so much is no larger for it.
    charge = max(charge, float(n_x + n_u))
    return Step(step, np.maximum(np.abs(step), error / (charge * UNIT)), charge)


def exponential_values(a: Matrix, b: Matrix, seconds: float) -> Matrix:
    """Return the matrices of `exponential_rows` without their errors, which are most of its work.

    Notes
    -----
    From E = F − I, E ← 2 E + E²: what is slow beside what is fast keeps the digits that 1 would take from it,
    once more with each squaring.
    """
    x, g, squarings = _scaled(a, b, seconds)
    phi = _phi(x)
    grown = np.concatenate([x @ phi, phi @ g], axis=-1)
    n_x = a.shape[-1]
    for _ in range(squarings):
        grown = 2 * grown + grown[..., :n_x] @ grown
    diagonal = np.arange(n_x)
    grown[..., diagonal, diagonal] += 1
    return np.asarray(grown)


def _squared_steps(a: Matrix, b: Matrix, seconds: float) -> tuple[Matrix, Matrix, Iterator[Matrix]]:
    """Return X and B T/2^s of `exponential_rows`, and what gives each [F G] in turn."""
    x, g, squarings = _scaled(a, b, seconds)

    def steps() -> Iterator[Matrix]:
        phi = _phi(x)
        step = np.concatenate([np.eye(a.shape[-1]) + x @ phi, phi @ g], axis=-1)
        yield step
        for _ in range(squarings):
            step = step @ _whole(step)
            yield step

    return x, g, steps()


def _scaled(a: Matrix, b: Matrix, seconds: float) -> tuple[Matrix, Matrix, int]:
    """Return X and B T/2^s, and s."""
    x = a * seconds
    norm = float(np.abs(x).sum(axis=-2).max(initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(2 * norm)))) if 0 < norm < np.inf else 0
    scale = 2.0**-squarings
    return x * scale, b * (seconds * scale), squarings


def _whole(step: Matrix) -> Matrix:
    """Return [F G; 0 I] of [F G]."""
    n_x, n = step.shape[-2:]
    below = np.broadcast_to(np.eye(n)[n_x:], (*step.shape[:-2], n - n_x, n))
    return np.concatenate([step, below], axis=-2)


def _phi(x: Matrix) -> Matrix:
    """Return φ₁(X) = I + X/2! + X²/3! + … up to a power."""
    diagonal = np.arange(x.shape[-1])
    values = x / (TERMS + 1)
    for term in range(TERMS - 1, -1, -1):
        # In place: a sum with a matrix of mostly zeros takes as long as a product.
        values[..., diagonal, diagonal] += 1
        if term:
            values = x @ values
            values /= term + 1
    return np.asarray(values)


def moved_together(a: NDArray[Any]) -> Iterator[Integers]:
    """Yield the states in sets between which A has no entry."""
    neighbours: list[set[int]] = [set() for _ in a]
    for row, column in np.argwhere(a.astype(np.bool_)).tolist():
        neighbours[row].add(column)
        neighbours[column].add(row)
    left = dict.fromkeys(range(len(a)))
    while left:
        waiting = [next(iter(left))]
        result = set(waiting)
        while waiting:
            new = neighbours[waiting.pop()] - result
            result |= new
            waiting += new
        for item in result:
            del left[item]
        yield np.array(sorted(result), np.int64)


def step_balls(a: NDArray[Any], b: NDArray[Any], duration: Fraction) -> NDArray[Any]:
    """Return [F G] (n_x, n_x + n_u) of one duration as balls at python-flint's present precision.

    Parameters
    ----------
    a, b
        A and B, entries exact or balls (`flint.arb`), which the step then holds for every value of.
    duration
        T in seconds.
    """
    import flint

    size = sum(b.shape)
    length = flint.arb(_rational(duration))
    entries = [flint.arb(entry) * length for entry in np.hstack([a, b]).ravel()]
    entries += [flint.arb(0)] * (size * b.shape[1])
    step = flint.arb_mat(size, size, entries).exp().entries()[: len(a) * size]
    balls = np.empty(len(step), dtype=object)
    balls[:] = [0 if ball.is_zero() else ball for ball in step]
    return balls.reshape(len(a), size)


def _generator(a: NDArray[Any], b: NDArray[Any]) -> Any:
    """Return [A B; 0 0] as an exact matrix."""
    # Imported here: commands that never discretize need not wait for it.
    import flint

    n_x, n_u = b.shape
    rows = [[_rational(value) for value in row] for row in np.hstack([a, b])]
    rows += [[flint.fmpq(0)] * (n_x + n_u) for _ in range(n_u)]
    return flint.fmpq_mat(n_x + n_u, n_x + n_u, [value for row in rows for value in row])


def _floats(matrix: NDArray[Any]) -> Floats:
    """Return a matrix of which most is zero in floats."""
    values = np.zeros(matrix.shape)
    filled = matrix.astype(np.bool_)
    values[filled] = [float(value) for value in matrix[filled]]
    return values


def _rational(value: Any) -> Any:
    import flint

    exact = Fraction(value)
    return flint.fmpq(exact.numerator, exact.denominator)


def _step(scaled: Any, n_x: int) -> Step:
    """Exponentiate in rising precision until every ball is small."""
    import flint

    precision = flint.ctx.prec
    try:
        for bits in PRECISIONS:
            flint.ctx.prec = bits
            balls = flint.arb_mat(scaled).exp().tolist()[:n_x]
            width = scaled.ncols()
            middle = np.array([[float(ball.mid()) for ball in row] for row in balls]).reshape(n_x, width)
            radius = np.array([[float(ball.rad()) for ball in row] for row in balls]).reshape(n_x, width)
            largest = float(np.abs(middle).max(initial=1.0))
            if np.isfinite(largest) and radius.max(initial=0.0) <= RADIUS * largest:
                return Step(middle, np.abs(middle) + radius / UNIT + UNDERFLOW)
    finally:
        flint.ctx.prec = precision
    raise ApcError(Mistake("E806", Place("the scene"), TOO_LARGE))
