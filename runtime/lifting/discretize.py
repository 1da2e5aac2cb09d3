"""Discretization: the exact matrix exponential of a linear system with held inputs.

Takes: the matrices of dx/dt = A x + B u, exact, or of many subsystems in floats.
Gives: `discretize`, `coupled_states`, `refuse_many`; `exponential`, in any number type; `step_balls`.
Guarantees: every entry of `discretize` of one subsystem is correct to the last digit but one, proved by ball
arithmetic, for any time constants; for many subsystems, or many coupled states, steps are computed in floats.
Every step comes with a bound.
Does not: schedule events (see `scheduling`).

    x(t + T) = F x(t) + G u        [F G; 0 I] = exp([A B; 0 0] T)

(Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Autom. Control 1978.) The
textbook form (1 − e^{−bT/m}) m/b loses every digit as b goes to 0, and scaling and squaring in double
precision loses log₂(bT/m) bits where the mass is tiny. Arb's exponential (Johansson, IEEE Trans. Computers
2017) with enough bits loses none, with a proved bound.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.interval_arithmetic import (
    FLOATS,
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Arithmetic,
    error_radius,
    rounded,
    value_of,
    with_error_radius,
)
from apc.support.state_limits import PEER_STATES
from apc.support.threads import load_pool

Floats = NDArray[np.float64]
Matrix = NDArray[Any]
Integers = NDArray[np.int64]

# Precisions in bits, tried in turn. A mode of decay rate a needs about 53 + 2·log₂(aT) bits.
PRECISIONS = (128, 256, 512, 1024, 2048)

# The required radius of every ball, relative to the largest entry: far below a rounding of double precision.
RADIUS = 2.0**-80


# The number of coupled states whose exponential is computed in balls first: for more, floats are tried first,
# as balls cost 30 times as much. Beyond the second number balls are never used: they take some seconds.
FEW_TOGETHER, MOST_TOGETHER = 64, 250

# The largest error of a step in floats, relative to composition's rounding, where balls are too many.
DOUBTFUL = 1e4

# The least number of inputs in a block: each is one more row of the exponential.
FEWEST_INPUTS = 8

# Rounding errors charged to every coefficient from a subsystem's functions, in units of UNIT: CasADi
# evaluates short polynomials of the parameters, with a few roundings per entry.
COEFFICIENT_ROUNDINGS = 8

# With ‖X‖ ≤ 1/2 the Taylor series of φ₁ is truncated after this number of terms. The factor I + X/18 + … of
# the last term, with the remainder, differs from I by less than `LAST`. More squarings have no use.
TERMS, LAST, MOST_SQUARINGS = 16, 2.0**-5, 64

TOO_LARGE = "floating-point overflow within one frame: a stiffness or delay is too large, or a mass too small"


def discretize(a: Matrix, b: Matrix, durations: Sequence[Fraction]) -> tuple[Matrix, ...]:
    """Return [F G] of every duration, with its radii (…, 2, n_x, n_x + n_u).

    Parameters
    ----------
    a, b
        A (n_x, n_x) and B (n_x, n_u), entries exact: `Fraction` or float taken as exact. Or those of many
        subsystems in floats (k, …), with errors up to `COEFFICIENT_ROUNDINGS`.
    durations
        T in seconds.

    Raises
    ------
    ApcError
        E806 an entry of the exponential overflows: a mode grows too fast within T; E812 too many states, or
        too many coupled states.
    """
    *batch_shape, n_x, n_u = b.shape
    steps = np.zeros((len(durations), *batch_shape, 2, n_x, n_x + n_u))
    subsystems = tuple(range(len(batch_shape)))
    filled = (np.asarray(matrix.astype(np.bool_).any(axis=subsystems)) for matrix in (a, b))
    for states, inputs in _coupled_blocks(*filled):
        a_block, b_block = a[..., states[:, None], states], b[..., states[:, None], inputs]
        exponentiate = _steps_in_floats if batch_shape else _steps
        indices = states[:, None], np.concatenate([states, n_x + inputs])
        for step, block_step in zip(steps, exponentiate(a_block, b_block, durations), strict=True):
            step[..., *indices] = block_step
    return tuple(steps)


def refuse_many(states: int, location: SourceLocation) -> None:
    """Raise ApcError E812 for a peer with more states than the limit."""
    if states > PEER_STATES:
        message = f"one peer has {states:,} states; the limit is {PEER_STATES:,}"
        raise ApcError(Diagnostic("E812", location, message, advice="use smaller arrays, such as count: 100"))


def _coupled_blocks(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> Iterator[tuple[Integers, Integers]]:
    """Yield sets of coupled states, each with a few of the inputs that act on them, until all are covered.

    An uncoupled set of states has an exponential of its own, and so has each input's column of G: an array of
    a thousand parts costs a thousand small cubes, not one large one.

    Raises
    ------
    ApcError
        E812 too many states.
    """
    refuse_many(len(a), SourceLocation("the topology"))
    for states in coupled_states(a):
        inputs = np.flatnonzero(b[states].any(axis=0))
        step = max(len(states), FEWEST_INPUTS)
        for begin in range(0, max(len(inputs), 1), step):
            yield states, inputs[begin : begin + step]


def _steps_in_floats(a: Floats, b: Floats, durations: Sequence[Fraction]) -> Iterator[Matrix]:
    """Yield the steps [F G] of many subsystems; matrices equal in all subsystems are exponentiated once."""
    distinct = slice(1 if all((values == values[:1]).all() for values in (a, b)) else len(a))
    a, b = (rounded(values[distinct], COEFFICIENT_ROUNDINGS) for values in (a, b))
    for duration in durations:
        yield exponential(a, b, float(duration), MIDPOINT_RADIUS)


def _steps(a: Matrix, b: Matrix, durations: Sequence[Fraction]) -> list[Matrix]:
    """Return the steps [F G] of coupled states: in floats if there are many states, else in balls.

    Raises
    ------
    ApcError
        E806 as `discretize`; E812 too many states for balls where floats are too inaccurate.
    """
    if len(a) > FEW_TOGETHER:
        steps = _balanced_steps(a.astype(np.float64), b.astype(np.float64), durations)
        if steps is not None:
            return steps
        if len(a) > MOST_TOGETHER:
            message = (
                f"{len(a)} states of one peer are coupled in continuous time and too fast for "
                f"floating point; the limit is {MOST_TOGETHER} states"
            )
            advice = "use smaller arrays, such as count: 100, or shorter periods"
            raise ApcError(Diagnostic("E812", SourceLocation("the topology"), message, advice=advice))
    generator = _generator(a, b)
    return [_step(generator * _rational(duration), len(a)) for duration in durations]


def _balanced_steps(a: Floats, b: Floats, durations: Sequence[Fraction]) -> list[Matrix] | None:
    """Return the steps [F G] in floats, computed in balanced units.

    The result is None where the error may be much larger than the rounding of composition.

    Notes
    -----
    In units that balance the rows and columns of a large A, by powers of 2, its exponential takes the fewest
    squarings, and its largest entry bounds the error of all.
    """
    allowed = 2.0 if len(a) <= MOST_TOGETHER else DOUBTFUL
    a, (units, _) = load_pool("scipy.linalg").matrix_balance(a, permute=False, separate=True)
    scaling = units[:, None] / np.concatenate([units, np.ones(b.shape[1])])
    a, b = rounded(a), rounded(b / units[:, None])
    steps = []
    for duration in durations:
        with np.errstate(all="ignore"):
            step = exponential(a, b, float(duration), MIDPOINT_RADIUS)
            size = np.abs(value_of(step)).max()
            if not error_radius(step).max() <= allowed * step.shape[-1] * UNIT_ROUNDOFF * size < np.inf:
                return None
            steps.append(scaling * step)
    return steps


def exponential(a: Matrix, b: Matrix, seconds: float | Matrix, numbers: Arithmetic = FLOATS) -> Matrix:
    """Return [F G] (…, n_x, n_x + n_u) in any number type, x(t + T) = F x(t) + G u.

    Parameters
    ----------
    a, b
        A (…, n_x, n_x) and B (…, n_x, n_u), in `numbers`.
    seconds
        T, a float with one rounding error; in floats one for each matrix, too.
    numbers
        The number type: floats, real or complex, with their radii, or over cells.

    Notes
    -----
    By scaling and squaring: with X = A T/2^s, ‖X‖ ≤ 1/2, and Y = φ₁(X) by Horner's rule, E = F − I = X Y and
    G = Y B T/2^s; then s times E ← 2 E + E² and G ← 2 G + E G. Slow modes thereby keep the digits that adding
    1 would cancel in each squaring; the error is propagated separately (see `interval_arithmetic`). The
    truncation error equals an error below `LAST` of the last factor, I + X/18 + …, for coupled states.
    """
    n_x, n_u = a.shape[-1], b.shape[-1]
    norm = float((numbers.size(a) * seconds).sum(axis=-2).real.max(initial=0.0))
    if not norm < 2.0**MOST_SQUARINGS:
        return np.full((*a.shape[:-1], n_x + n_u), np.nan)
    squarings = max(0, int(np.ceil(np.log2(2 * norm)))) if norm else 0
    substep = seconds * 2.0**-squarings
    x, g = numbers.scaled(a, substep), numbers.scaled(b, substep)
    unit = np.eye(n_x)
    pattern = x.any(axis=tuple(range(x.ndim - 2))) if n_x < TERMS else np.ones((n_x, n_x))
    reachable = np.linalg.matrix_power(unit + pattern, TERMS) > 0
    exact, phi = numbers.exact(unit), numbers.bounded(unit, LAST * reachable)
    for term in range(TERMS, 0, -1):
        phi = numbers.add(exact, numbers.scaled(numbers.multiply(x, phi), 1 / (term + 1)))
    increment = np.concatenate([numbers.multiply(x, phi), numbers.multiply(phi, g)], axis=-1)
    double = numbers.doubled or (lambda e: numbers.add(2 * e, numbers.multiply(e[..., :n_x], e)))
    for _ in range(squarings):
        increment = double(increment)
    return numbers.add(increment, numbers.exact(np.eye(n_x, n_x + n_u)))


def coupled_states(a: NDArray[Any]) -> Iterator[Integers]:
    """Yield the sets of states that A couples, directly or through other states."""
    neighbours: list[set[int]] = [set() for _ in a]
    for row, column in np.argwhere(a.astype(np.bool_)).tolist():
        neighbours[row].add(column)
        neighbours[column].add(row)
    remaining = dict.fromkeys(range(len(a)))
    while remaining:
        pending = [next(iter(remaining))]
        result = set(pending)
        while pending:
            new = neighbours[pending.pop()] - result
            result |= new
            pending += new
        for item in result:
            del remaining[item]
        yield np.array(sorted(result), np.int64)


def step_balls(a: NDArray[Any], b: NDArray[Any], duration: Fraction) -> NDArray[Any]:
    """Return [F G] (n_x, n_x + n_u) of one duration as balls at python-flint's current precision.

    Parameters
    ----------
    a, b
        A and B, entries exact or balls (`flint.arb`); the step then encloses that of every value in them.
    duration
        T in seconds.
    """
    import flint

    size = sum(b.shape)
    seconds = flint.arb(_rational(duration))
    entries = [flint.arb(entry) * seconds for entry in np.hstack([a, b]).ravel()]
    entries += [flint.arb(0)] * (size * b.shape[1])
    step = flint.arb_mat(size, size, entries).exp().entries()[: len(a) * size]
    balls = np.empty(len(step), dtype=object)
    balls[:] = [0 if ball.is_zero() else ball for ball in step]
    return balls.reshape(len(a), size)


def _generator(a: NDArray[Any], b: NDArray[Any]) -> Any:
    """Return [A B; 0 0], the generator of the exponential, as an exact matrix."""
    # Imported here: commands without discretization do not load it.
    import flint

    n_x, n_u = b.shape
    rows = [[_rational(value) for value in row] for row in np.hstack([a, b])]
    rows += [[flint.fmpq(0)] * (n_x + n_u) for _ in range(n_u)]
    return flint.fmpq_mat(n_x + n_u, n_x + n_u, [value for row in rows for value in row])


def _rational(value: Any) -> Any:
    """Return a number exactly as a rational of python-flint."""
    import flint

    exact = Fraction(value)
    return flint.fmpq(exact.numerator, exact.denominator)


def _step(scaled: Any, n_x: int) -> Matrix:
    """Return the exponential, in increasing precision until every ball is small."""
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
                # A value below the range of floats has an error of the smallest float; an exact 0 has none.
                tiny = np.finfo(np.float64).tiny
                least = np.array([[0.0 if ball.is_zero() else tiny for ball in row] for row in balls])
                return with_error_radius(
                    middle, UNIT_ROUNDOFF * np.abs(middle) + radius + least.reshape(middle.shape)
                )
    finally:
        flint.ctx.prec = precision
    raise ApcError(Diagnostic("E806", SourceLocation("the topology"), TOO_LARGE))
