"""The effect of time-varying forces on a subsystem's motion, in addition to the exact transition.

Takes: the `Rates` of a peer type, a parameter vector, when intervals begin and how long they last.
Gives: `SubsystemForcing`, `subsystem_forcing`, `impulses`.
Guarantees: an interval is split where a comparison of `time` switches (a step, a corner of a ramp, a row of
a table), so that what is integrated is smooth; an impulse is right to `AGREE` of the largest of those
integrated at once, and where a force jumps at an instant that is not known beforehand, to `LOST`.
Does not: integrate terms that depend on the motion.

    c = ∫₀ᵀ e^{A u} g(t + T − u) du

by SciPy's adaptive quadrature of vectors (Gauss and Kronrod), all parts of intervals at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.discretize import exponential
from apc.frame.exact_arithmetic import ROWS, evaluate_exact
from apc.frame.jacobians import guards_of, lookups_of
from apc.simulation.propagate import Rates
from apc.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# A quadrature ends where its error is this part of the largest impulse, or where it has cut its parts into so
# many pieces; what it leaves out then, of the whole, may be this large: of a jump it is far less.
AGREE, MOST_PIECES, LOST = 1e-13, 100, 1e-9
LEAST = float(np.finfo(np.float64).tiny)
FADING = 4  # doublings of the time within which a motion dies out, from one part of an interval to the next
MOST_NUMBERS = 2**21  # of the exponentials that are held at once


@dataclass(frozen=True, slots=True, eq=False)
class SubsystemForcing:
    """The forces on one subsystem, of which x' = A x + g(t).

    `matrix` is A (n_x, n_x); `force` gives the rows `pushed` of g at a time, the others are zero; at
    `breaks`, instants in order, it is not smooth. `durations` are the lengths of intervals, in seconds.
    """

    matrix: Floats
    pushed: tuple[int, ...]
    force: Any  # casadi.Function
    breaks: Floats
    durations: tuple[float, ...]


def subsystem_forcing(rates: Rates, parameters: Floats, durations: Sequence[Fraction]) -> SubsystemForcing:
    """Return the forces on a subsystem.

    Parameters
    ----------
    rates
        The equations of its peer type.
    parameters
        The subsystem's (n_p,).
    durations
        The lengths of intervals, in seconds.
    """
    type_: Any = casadi.SX if rates.rate.is_a("SXFunction") else casadi.MX
    t = type_.sym("t")
    g = rates.rate(parameters, t)
    pushed, breaks = tuple(range(g.numel())), []
    if type_ is casadi.SX:  # where a loop's solution is nonsmooth, or time-dependence nonlinear: halving
        pushed = tuple(row for row in pushed if not g[row].is_zero())
        indices = [(at, casadi.DM(table.times)) for table, at in lookups_of(g)]
        for at, zeros in [*indices, *((guard, casadi.DM(0)) for guard in guards_of(g, t))]:
            pace = casadi.jacobian(at, t)
            if not casadi.depends_on(pace, t):
                breaks.append((zeros - casadi.substitute(at, t, 0)) / pace)
    at = np.asarray(casadi.evalf(casadi.vertcat(type_(0, 1), *breaks)), np.float64).reshape(-1)
    n_x = len(rates.pattern)
    return SubsystemForcing(
        matrix=np.asarray(rates.matrices(parameters), np.float64).reshape(n_x, -1, order="F")[:, :n_x],
        pushed=pushed,
        force=casadi.Function("force", [t], [casadi.densify(g[list(pushed)])]),
        breaks=np.unique(at[np.isfinite(at)]),
        durations=tuple(float(duration) for duration in durations),
    )


def impulses(subsystem: SubsystemForcing, starts: Floats, which: Integers) -> Floats:
    """Return c of every interval (intervals, n_x).

    Parameters
    ----------
    subsystem
        The forces.
    starts
        The start of each interval, in seconds (intervals,).
    which
        The place of each interval's length in the subsystem's `durations` (intervals,).

    Raises
    ------
    ApcError
        E871 a force changes too fast to be followed.
    """
    result = np.zeros((len(starts), len(subsystem.matrix)))
    for index, duration in enumerate(subsystem.durations):
        rows = np.flatnonzero(which == index)
        result[rows] = _impulses_of_length(subsystem, duration, starts[rows])
    return result


def _impulses_of_length(subsystem: SubsystemForcing, duration: float, starts: Floats) -> Floats:
    """Return c of intervals of one length (intervals, n_x)."""
    total = np.zeros((len(starts), len(subsystem.matrix)))
    whose, low, high = _parts(subsystem, duration, starts)
    most = max(1, MOST_NUMBERS // subsystem.matrix.size)  # parts that are integrated at once
    for first in range(0, len(whose), most):
        some = slice(first, first + most)
        value = _integrated(subsystem, starts[whose[some]] + duration, low[some], high[some])
        np.add.at(total, whose[some], value)
    return total


def _parts(subsystem: SubsystemForcing, duration: float, starts: Floats) -> tuple[Integers, Floats, Floats]:
    """Return the parts into which breaks, and what fades, cut intervals: whose each is, from where to where.

    Times are in seconds before the interval's end, which stay exact where something dies out at once.
    """
    first = np.searchsorted(subsystem.breaks, starts, side="right")
    many = np.maximum(np.searchsorted(subsystem.breaks, starts + duration) - first, 0)
    every, size = np.arange(len(starts)), float(np.abs(subsystem.matrix).sum(axis=1).max(initial=0.0))
    cut = np.repeat(every, many)
    index = np.arange(len(cut)) - np.repeat(np.cumsum(many) - many, many) + first[cut]
    left = duration - (subsystem.breaks[index] - starts[cut])
    fading = np.arange(0.0, np.log2(max(size * duration, 1.0)), FADING)  # fast modes decay within it
    fixed = np.array([0.0, duration, *2.0**fading / max(size, 1 / duration)])
    whose = np.concatenate([np.repeat(every, len(fixed)), cut])
    ends = np.concatenate([np.tile(fixed, len(starts)), left])
    order = np.lexsort((ends, whose))
    ends, whose = ends[order], whose[order]
    inside = (whose[1:] == whose[:-1]) & (ends[1:] > ends[:-1])
    return whose[:-1][inside], ends[:-1][inside], ends[1:][inside]


def _integrated(subsystem: SubsystemForcing, until: Floats, low: Floats, high: Floats) -> Floats:
    """Integrate parts of intervals that end at `until`, from `high` to `low` seconds before, all (k,)."""
    equal, which = np.unique(np.stack([low, high]), axis=1, return_inverse=True)
    which = which.reshape(-1)
    nothing = subsystem.matrix[None, :, :0]

    def integrand(share: float) -> Floats:
        left = equal[0] + (equal[1] - equal[0]) * share
        steps = exponential(subsystem.matrix, nothing, left[:, None, None])
        g = _at(subsystem.force, np.maximum(until - left[which], 0.0))
        moved = np.einsum("kxq,qk->kx", steps[..., list(subsystem.pushed)][which], g)
        return np.asarray((high - low)[:, None] * moved)

    value, error = load_pool("scipy.integrate").quad_vec(
        integrand, 0, 1, epsabs=LEAST, epsrel=AGREE, norm="max", limit=MOST_PIECES, quadrature="gk15"
    )
    if error > LOST * np.abs(value).max(initial=0.0):
        raise _too_fast(until - high, until - low)
    return np.asarray(value)


def _at(function: Any, instants: Floats) -> Floats:
    """Return a function's column at instants of any shape, in seconds (rows, *shape).

    Each operation of an expression is NumPy's over all instants: CasADi's own map takes longer to build.
    """
    shape, flat = (function.numel_out(0), *instants.shape), instants.reshape(-1)
    if not shape[0]:
        return np.empty(shape)
    if not function.is_a("SXFunction"):  # the solution of a loop, which only CasADi knows
        return np.asarray(function.map(flat.size)(flat.reshape(1, -1)), np.float64).reshape(shape)
    with np.errstate(all="ignore"):
        [rows] = evaluate_exact(function, [[flat]], number=np.float64, rules=ROWS)
    return np.stack([np.broadcast_to(row, flat.shape) for row in rows]).reshape(shape)


def _too_fast(begin: Floats, end: Floats) -> ApcError:
    message = (
        f"a force changes too fast: from {float(begin.min()):.6g} s to {float(end.max()):.6g} s it would be "
        f"looked at in more than {MOST_PIECES:,} places"
    )
    return ApcError(
        Diagnostic(
            "E871", SourceLocation("simulation"), message, hint="a lower frequency, or a constant force"
        )
    )
