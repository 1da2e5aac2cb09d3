"""What forces that change with time alone add to a site's motion, exact to rounding.

Takes: the `Rates` of a kind, a parameter vector, when intervals begin and how long they last.
Gives: `SiteForcing`, `site_forcing`, `impulses`.
Guarantees: an interval is split where a comparison of `time` switches (a step, a corner of a ramp, a row of
a table), so that what is integrated is smooth; an impulse is right to a few roundings of its terms and of
the instants.
Does not: integrate what depends on the motion.

    c = ∫₀ᵀ e^{A u} g(t + T − u) du

by the rule of Gauss and Legendre with 16 nodes, on parts that are halved until the last Legendre coefficients
of what is integrated are no more than rounding errors (Trefethen, Approximation Theory and Approximation
Practice, chapter 19).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.discretize import UNIT, exponential_values
from apc.frame.exact import ROWS, evaluate_exact
from apc.frame.jacobians import guards_of, lookups_of
from apc.simulation.propagate import Rates

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

TERMS = 16
NODES, WEIGHTS = legendre.leggauss(TERMS)
# From values at the nodes to Legendre coefficients (TERMS, nodes).
TRANSFORM = (legendre.legvander(NODES, TERMS - 1) * WEIGHTS[:, None]).T * (np.arange(TERMS)[:, None] + 0.5)
# From values at the nodes to that where a part begins.
BEGINNING = legendre.legvander([-1.0], TERMS - 1)[0] @ TRANSFORM
# Last coefficients of this size, relative to the whole, may be rounding errors; what they leave out is less.
AGREE = 64 * UNIT
MOST_HALVINGS = 48  # what a jump within so small a part of an interval is missed by is far below a rounding
LOST = 1e-9  # what is left open beyond, of the whole, after so many: a force whose integral has no end
MOST_HALVED = (
    2**18
)  # parts of the intervals of one chunk: some seconds; a jump in an interval takes a hundred
MOST_NUMBERS = 2**21  # of the exponentials that are held at once


@dataclass(frozen=True, slots=True, eq=False)
class SiteForcing:
    """The forces on one site, of which x' = A x + g(t).

    `matrix` is A (n_x, n_x); `force` gives the rows `pushed` of g at a time, the others are zero; at
    `breaks`, instants in order, it is not smooth. `durations` are the lengths of intervals, in seconds.
    """

    matrix: Floats
    pushed: tuple[int, ...]
    force: Any  # casadi.Function
    breaks: Floats
    durations: tuple[float, ...]


def site_forcing(rates: Rates, parameters: Floats, durations: Sequence[Fraction]) -> SiteForcing:
    """Return the forces on a site.

    Parameters
    ----------
    rates
        The equations of its kind.
    parameters
        The site's (n_p,).
    durations
        The lengths of intervals, in seconds.
    """
    type_: Any = casadi.SX if rates.rate.is_a("SXFunction") else casadi.MX
    t = type_.sym("t")
    g = rates.rate(parameters, t)
    pushed, breaks = tuple(range(g.numel())), []
    if (
        type_ is casadi.SX
    ):  # where the solution of a loop is not smooth, and what is not linear in time: halving
        pushed = tuple(row for row in pushed if not g[row].is_zero())
        places = [(at, casadi.DM(table.times)) for table, at in lookups_of(g)]
        for at, zeros in [*places, *((guard, casadi.DM(0)) for guard in guards_of(g, t))]:
            pace = casadi.jacobian(at, t)
            if not casadi.depends_on(pace, t):
                breaks.append((zeros - casadi.substitute(at, t, 0)) / pace)
    at = np.asarray(casadi.evalf(casadi.vertcat(type_(0, 1), *breaks)), np.float64).reshape(-1)
    n_x = len(rates.pattern)
    return SiteForcing(
        matrix=np.asarray(rates.matrices(parameters), np.float64).reshape(n_x, -1, order="F")[:, :n_x],
        pushed=pushed,
        force=casadi.Function("force", [t], [casadi.densify(g[list(pushed)])]),
        breaks=np.unique(at[np.isfinite(at)]),
        durations=tuple(float(duration) for duration in durations),
    )


def impulses(site: SiteForcing, starts: Floats, which: Integers) -> Floats:
    """Return c of every interval (intervals, n_x).

    Parameters
    ----------
    site
        The forces.
    starts
        When each interval begins, in seconds (intervals,).
    which
        The place of each interval's length in the site's `durations` (intervals,).

    Raises
    ------
    ApcError
        E871 a force changes too fast to be followed.
    """
    result = np.zeros((len(starts), len(site.matrix)))
    for place, duration in enumerate(site.durations):
        rows = np.flatnonzero(which == place)
        result[rows] = _impulses_of_length(site, duration, starts[rows])
    return result


def _impulses_of_length(site: SiteForcing, duration: float, starts: Floats) -> Floats:
    """Return c of intervals of one length (intervals, n_x)."""
    total, size = (np.zeros((len(starts), len(site.matrix))) for _ in range(2))
    most = max(1, MOST_NUMBERS // (TERMS * site.matrix.size))  # parts that are integrated at once
    work, halved = [(*_parts(site, duration, starts), 0)], 0
    while work:
        rows, low, high, halvings = work.pop()
        if len(rows) > most:
            work.append((rows[most:], low[most:], high[most:], halvings))
            rows, low, high = rows[:most], low[:most], high[:most]
        value, error, terms = _integrated(site, starts[rows] + duration, low, high)
        np.maximum.at(size, rows, terms)
        off = (error > AGREE * size[rows]).any(axis=1) & np.isfinite(value).all(axis=1)
        off &= halvings < MOST_HALVINGS
        if halvings == MOST_HALVINGS and (error > LOST * size[rows]).any():
            raise _too_fast(starts, duration)
        np.add.at(total, rows[~off], value[~off])
        if off.any():
            halved += int(off.sum())
            if halved > MOST_HALVED:
                raise _too_fast(starts, duration)
            rows, low, high = rows[off], low[off], high[off]
            middle = (low + high) / 2
            ends = np.concatenate([low, middle]), np.concatenate([middle, high])
            work.append((np.tile(rows, 2), *ends, halvings + 1))
    return total


def _parts(site: SiteForcing, duration: float, starts: Floats) -> tuple[Integers, Floats, Floats]:
    """Return the parts into which breaks cut intervals: whose each is, and from where to where.

    Both are counted in seconds before the interval's end, which stay exact where something dies out at once.
    """
    first = np.searchsorted(site.breaks, starts, side="right")
    many = np.maximum(np.searchsorted(site.breaks, starts + duration) - first, 0)
    every = np.arange(len(starts))
    cut = np.repeat(every, many)
    place = np.arange(len(cut)) - np.repeat(np.cumsum(many) - many, many) + first[cut]
    left = duration - (site.breaks[place] - starts[cut])
    whose = np.concatenate([every, every, cut])
    ends = np.concatenate([np.zeros(len(starts)), np.full(len(starts), duration), left])
    order = np.lexsort((ends, whose))
    ends, whose = ends[order], whose[order]
    inside = (whose[1:] == whose[:-1]) & (ends[1:] > ends[:-1])
    return whose[:-1][inside], ends[:-1][inside], ends[1:][inside]


def _integrated(site: SiteForcing, until: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats, Floats]:
    """Integrate parts of intervals that end at `until`, from `high` to `low` seconds before, all (k,).

    Returns the integrals, what they may be off by, and the sums of their terms' magnitudes (k, n_x).
    """
    equal, which = np.unique(np.stack([low, high]), axis=1, return_inverse=True)
    half, left = (equal[1] - equal[0])[:, None] / 2, _nodes(equal[0], equal[1])
    at = np.concatenate([left, equal[0][:, None]], axis=1)  # and at a part's begin, which no node sees
    generators = at[:, :, None, None] * site.matrix
    steps = exponential_values(generators.reshape(-1, *site.matrix.shape), site.matrix[None, :, :0], 1.0)
    steps = steps.reshape(*at.shape, *site.matrix.shape)[..., list(site.pushed)][which.reshape(-1)]
    half = half[which.reshape(-1)]
    instants = until[:, None] - _nodes(low, high)
    g = np.moveaxis(_at(site.force, instants), 0, -1)  # (k, nodes, pushed)
    values = np.einsum("kixq,kiq->kix", steps[:, :-1], g)
    weighted = np.einsum("i,kixq,kiq->kx", WEIGHTS, np.abs(steps[:, :-1]), np.abs(g))
    begin = np.einsum("kxq,i,kiq->kx", steps[:, -1], BEGINNING, g)
    missed = np.abs(np.einsum("ci,kix->kcx", TRANSFORM[-2:], values)).sum(axis=1)
    missed = np.maximum(missed, np.abs(BEGINNING @ values - begin) / TERMS)
    # A rounding of the instants moves the force by its slope, which no halving mends.
    slope = np.einsum("c,kcq->kq", np.arange(TERMS) ** 2.0, np.abs(np.einsum("ci,kiq->kcq", TRANSFORM, g)))
    rounding = TERMS * UNIT * np.abs(instants[:, :1]) * slope / half
    rounding = np.einsum(
        "kxq,kq->kx", np.abs(steps).max(axis=1), np.where(np.isfinite(rounding), rounding, 0)
    )
    return half * np.einsum("i,kix->kx", WEIGHTS, values), 2 * half * (missed - rounding), half * weighted


def _nodes(low: Floats, high: Floats) -> Floats:
    """Return the nodes between `low` and `high`, one more axis."""
    return np.asarray(low[..., None] + (high - low)[..., None] * (NODES + 1) / 2)


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


def _too_fast(starts: Floats, duration: float) -> ApcError:
    begin, end = float(starts.min()), float(starts.max() + duration)
    what = (
        f"a force changes too fast: from {begin:.6g} s to {end:.6g} s it would be looked at in more than "
        f"{MOST_HALVED:,} places"
    )
    return ApcError(Mistake("E871", Place("simulation"), what, hint="a lower frequency, or a constant force"))
