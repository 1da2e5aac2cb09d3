"""The effect of time-varying forces on a subsystem's motion, in addition to the exact transition.

Takes: the `Rates` of a peer type, a parameter vector, the start instants and durations of intervals.
Gives: `SubsystemForcing`, `subsystem_forcing`, `impulses`.
Guarantees: an interval is split where a comparison of `time` switches (a step, a corner of a ramp, a row of
a table), so that integrands are smooth. The error of an impulse is below `AGREE` of the largest impulse of
the same call, and below `LOST` if a force jumps at an instant that is not known beforehand.
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
from apc.lifting.discretize import exponential
from apc.linearization.jacobians import guards_of, lookups_of
from apc.parameter_values.exact_arithmetic import ROWS, evaluate_exact
from apc.simulation.propagate import Rates
from apc.support.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# The relative error (of the largest impulse) at which a quadrature ends, the limit of its pieces, and the
# relative error that is accepted at this limit: that of a jump is far smaller.
AGREE, MOST_PIECES, LOST = 1e-13, 100, 1e-9
LEAST = float(np.finfo(np.float64).tiny)
FADING = 4  # doublings of the time before an interval's end, from one part of the interval to the next
MOST_NUMBERS = 2**21  # entries of the matrix exponentials that are stored at a time


@dataclass(frozen=True, slots=True, eq=False)
class SubsystemForcing:
    """The time-varying forces g(t) on one subsystem, x' = A x + g(t).

    `matrix` is A (n_x, n_x); `force` returns the rows `pushed` of g at a time, the others are zero; `breaks`
    are the instants, in order, at which g is not smooth. `durations` are the interval lengths in seconds.
    """

    matrix: Floats
    pushed: tuple[int, ...]
    force: Any  # casadi.Function
    breaks: Floats
    durations: tuple[float, ...]


def subsystem_forcing(rates: Rates, parameters: Floats, durations: Sequence[Fraction]) -> SubsystemForcing:
    """Return the time-varying forces on a subsystem, with the instants at which they are not smooth.

    Parameters
    ----------
    rates
        The equations of its peer type.
    parameters
        The subsystem's parameters (n_p,).
    durations
        The lengths of intervals, in seconds.
    """
    type_: Any = casadi.SX if rates.rate.is_a("SXFunction") else casadi.MX
    t = type_.sym("t")
    g = rates.rate(parameters, t)
    pushed, breaks = tuple(range(g.numel())), []
    if type_ is casadi.SX:  # otherwise nonsmooth instants are not known, and the quadrature bisects
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


def impulses(subsystem: SubsystemForcing, starts: Floats, lengths: Integers) -> Floats:
    """Return the impulse c of each interval (intervals, n_x): the effect of the forces on its final state.

    Parameters
    ----------
    subsystem
        The forces.
    starts
        The start of each interval, in seconds (intervals,).
    lengths
        The index of each interval's length in the subsystem's `durations` (intervals,).

    Raises
    ------
    ApcError
        E871 a force changes too fast for the quadrature.
    """
    result = np.zeros((len(starts), len(subsystem.matrix)))
    for index, duration in enumerate(subsystem.durations):
        rows = np.flatnonzero(lengths == index)
        result[rows] = _impulses_of_length(subsystem, duration, starts[rows])
    return result


def _impulses_of_length(subsystem: SubsystemForcing, duration: float, starts: Floats) -> Floats:
    """Return the impulses of intervals of one length (intervals, n_x)."""
    total = np.zeros((len(starts), len(subsystem.matrix)))
    intervals, low, high = _smooth_parts(subsystem, duration, starts)
    batch_size = max(1, MOST_NUMBERS // subsystem.matrix.size)  # parts that are integrated at once
    for first in range(0, len(intervals), batch_size):
        batch = slice(first, first + batch_size)
        value = _integral_over_parts(subsystem, starts[intervals[batch]] + duration, low[batch], high[batch])
        np.add.at(total, intervals[batch], value)
    return total


def _smooth_parts(
    subsystem: SubsystemForcing, duration: float, starts: Floats
) -> tuple[Integers, Floats, Floats]:
    """Return the parts of intervals with smooth integrands: index of the interval, end and start of
    each part.

    Intervals are divided at breaks, and at times of fast decay. Times are in seconds before the interval's
    end, exact also for modes that decay at once.
    """
    first = np.searchsorted(subsystem.breaks, starts, side="right")
    counts = np.maximum(np.searchsorted(subsystem.breaks, starts + duration) - first, 0)
    indices, norm = np.arange(len(starts)), float(np.abs(subsystem.matrix).sum(axis=1).max(initial=0.0))
    owners_of_breaks = np.repeat(indices, counts)
    index = (
        np.arange(len(owners_of_breaks))
        - np.repeat(np.cumsum(counts) - counts, counts)
        + first[owners_of_breaks]
    )
    remaining = duration - (subsystem.breaks[index] - starts[owners_of_breaks])
    doublings = np.arange(0.0, np.log2(max(norm * duration, 1.0)), FADING)  # fast modes decay within it
    fixed = np.array([0.0, duration, *2.0**doublings / max(norm, 1 / duration)])
    owners = np.concatenate([np.repeat(indices, len(fixed)), owners_of_breaks])
    ends = np.concatenate([np.tile(fixed, len(starts)), remaining])
    order = np.lexsort((ends, owners))
    ends, owners = ends[order], owners[order]
    inside = (owners[1:] == owners[:-1]) & (ends[1:] > ends[:-1])
    return owners[:-1][inside], ends[:-1][inside], ends[1:][inside]


def _integral_over_parts(subsystem: SubsystemForcing, until: Floats, low: Floats, high: Floats) -> Floats:
    """Return the integrals over parts of intervals, from `high` to `low` seconds before `until` (k, n_x)."""
    distinct, part_of = np.unique(np.stack([low, high]), axis=1, return_inverse=True)
    part_of = part_of.reshape(-1)
    no_inputs = subsystem.matrix[None, :, :0]

    def integrand(share: float) -> Floats:
        """Return the integrands of all parts at a relative position in each part (k, n_x)."""
        remaining = distinct[0] + (distinct[1] - distinct[0]) * share
        steps = exponential(subsystem.matrix, no_inputs, remaining[:, None, None])
        g = _values_at(subsystem.force, np.maximum(until - remaining[part_of], 0.0))
        effects = np.einsum("kxq,qk->kx", steps[..., list(subsystem.pushed)][part_of], g)
        return np.asarray((high - low)[:, None] * effects)

    value, error = load_pool("scipy.integrate").quad_vec(
        integrand, 0, 1, epsabs=LEAST, epsrel=AGREE, norm="max", limit=MOST_PIECES, quadrature="gk15"
    )
    if error > LOST * np.abs(value).max(initial=0.0):
        raise _force_error(until - high, until - low)
    return np.asarray(value)


def _values_at(function: Any, instants: Floats) -> Floats:
    """Return the values of a function at instants of any shape, in seconds (rows, *shape).

    NumPy evaluates each operation over all instants: CasADi's own map takes longer to build.
    """
    shape, flat = (function.numel_out(0), *instants.shape), instants.reshape(-1)
    if not shape[0]:
        return np.empty(shape)
    if not function.is_a("SXFunction"):  # the solution of a loop can be evaluated by CasADi only
        return np.asarray(function.map(flat.size)(flat.reshape(1, -1)), np.float64).reshape(shape)
    with np.errstate(all="ignore"):
        [rows] = evaluate_exact(function, [[flat]], number=np.float64, rules=ROWS)
    return np.stack([np.broadcast_to(row, flat.shape) for row in rows]).reshape(shape)


def _force_error(begin: Floats, end: Floats) -> ApcError:
    """Return the error E871 for a force that changes too fast for the quadrature."""
    message = (
        f"a force changes too fast: from {float(begin.min()):.6g} s to {float(end.max()):.6g} s it would be "
        f"evaluated at more than {MOST_PIECES:,} points"
    )
    return ApcError(
        Diagnostic(
            "E871", SourceLocation("simulation"), message, advice="use a lower frequency, or a constant force"
        )
    )
