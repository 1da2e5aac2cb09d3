"""What a linear system does in a while: the exact matrix exponential, inputs held.

Takes: the matrices of dx/dt = A x + B u, exact. Gives: `Step`, `discretize`, `moved_together`; `step_balls`.
Guarantees: every entry is right to the last digit but one, proved by ball arithmetic, whether a mode dies
out in a nanosecond or never.
Does not: know when anything happens (see `scheduling`).

    x(t + T) = F x(t) + G u        [F G; 0 I] = exp([A B; 0 0] T)

(Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Autom. Control 1978.) The
textbook form (1 − e^{−bT/m}) m/b loses every digit as b goes to 0, and scaling and squaring in double
precision loses log₂(bT/m) bits where the mass is tiny. Arb's exponential (Johansson, IEEE Trans. Computers
2017) in enough bits loses none, and says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

UNIT = float(np.finfo(np.float64).eps) / 2  # the unit roundoff of double precision

# Bits tried in turn. A mode that dies out within T at rate a needs about 53 + 2·log₂(aT) of them.
PRECISIONS = (128, 256, 512, 1024, 2048)

# Radius asked of every ball, relative to the largest entry: far below a rounding of double precision.
RADIUS = 2.0**-80


# States of one peer, whose matrices hold a rational an entry: of 400 an analysis takes 8 s and 0.4 GB, of
# 1,000 ten times that.
MOST_STATES = 400

# States whose exponential is one, at a cost of their cube: some seconds for so many. Inputs beside fewer.
MOST_TOGETHER = 250
FEWEST_INPUTS = 8

# What a number below the range of floats may be off by when it is rounded to zero, in units of UNIT.
UNDERFLOW = float(np.finfo(np.float64).tiny) / UNIT


TOO_LARGE = (
    "one frame of this scene leaves the range of floating point numbers: "
    "a stiffness or delay is too large for it, or a mass too small"
)


@dataclass(frozen=True, slots=True)
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
        A (n_x, n_x) and B (n_x, n_u), entries exact: `Fraction` or float taken at its word.
    durations
        T in seconds.

    Raises
    ------
    ApcError
        E806 an entry of the exponential is too large for a float: something grows without measure within T;
        E812 too many states, or too many that move together.
    """
    n_x = len(a)
    pieces = [
        (
            states,
            np.concatenate([states, n_x + inputs]),
            _generator(a[np.ix_(states, states)], b[np.ix_(states, inputs)]),
        )
        for states, inputs in _pieces(a, b)
    ]
    steps = []
    for duration in durations:
        matrix = np.zeros((n_x, n_x + b.shape[1]))
        size = np.full(matrix.shape, UNDERFLOW)
        for states, places, generator in pieces:
            piece = _step(generator * _rational(duration), len(states))
            matrix[np.ix_(states, places)], size[np.ix_(states, places)] = piece.matrix, piece.size
        steps.append(Step(matrix, size))
    return tuple(steps)


def _pieces(a: NDArray[Any], b: NDArray[Any]) -> Iterator[tuple[Integers, Integers]]:
    """Yield states that move together with a few of the inputs that move them, until all are had.

    What moves by itself has an exponential of its own, and so has each input's column of G: an array of a
    thousand parts costs a thousand small cubes, not one of its own.

    Raises
    ------
    ApcError
        E812 too many states, or too many that move together.
    """
    if len(a) > MOST_STATES:
        what = f"one peer has {len(a)} states, and {MOST_STATES} are the most that are analysed"
        raise ApcError(Mistake("E812", Place("the scene"), what, hint="smaller arrays, as count: 100"))
    for states in moved_together(a):
        if len(states) > MOST_TOGETHER:
            what = (
                f"{len(states)} states of one peer move together in continuous time, "
                f"and {MOST_TOGETHER} are the most that are analysed"
            )
            raise ApcError(Mistake("E812", Place("the scene"), what, hint="smaller arrays, as count: 100"))
        inputs = np.flatnonzero((b[states] != 0).any(axis=0))
        step = max(len(states), FEWEST_INPUTS)
        for begin in range(0, max(len(inputs), 1), step):
            yield states, inputs[begin : begin + step]


def moved_together(a: NDArray[Any]) -> Iterator[Integers]:
    """Yield the states in sets between which A has no entry."""
    neighbours: list[set[int]] = [set() for _ in a]
    for row, column in np.argwhere(a != 0).tolist():
        neighbours[row].add(column)
        neighbours[column].add(row)
    left = dict.fromkeys(range(len(a)))
    while left:
        waiting = [next(iter(left))]
        found = set(waiting)
        while waiting:
            new = neighbours[waiting.pop()] - found
            found |= new
            waiting += new
        for one in found:
            del left[one]
        yield np.array(sorted(found), np.int64)


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
