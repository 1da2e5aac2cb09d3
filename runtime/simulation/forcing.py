"""What forces that change with time alone add to a site's motion, exact to rounding.

Takes: the `Rates` of a kind, parameter vectors, when the intervals begin and how long they last.
Gives: `SiteForcing`, `site_forcing`, `Kernel`, `impulses`.
Guarantees: an interval is split where a comparison of `time` switches (a step, a corner of a ramp, a row of
a table), so that what is integrated is smooth; an impulse is right to a few roundings of its terms and of
the instants.
Does not: integrate what depends on the motion.

    c = ∫₀ᵀ e^{A (T − s)} g(t + s) ds

On each panel both factors are polynomials of degree 15 to rounding, so that the rule of Gauss and Legendre
with 16 nodes is exact: the exponential is halved into such panels once for each length of interval, the force
wherever its last Legendre coefficients are not yet rounding errors (Trefethen, Approximation Theory and
Approximation Practice, chapter 19).
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
from apc.frame.discretize import UNIT, discretize
from apc.frame.exact import ROWS, evaluate_exact
from apc.frame.jacobians import guards_of, lookups_of
from apc.simulation.propagate import Rates, exact_rates

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

TERMS = 16
NODES, WEIGHTS = legendre.leggauss(TERMS)
# From values at the nodes to Legendre coefficients (TERMS, nodes).
TRANSFORM = (legendre.legvander(NODES, TERMS - 1) * WEIGHTS[:, None]).T * (np.arange(TERMS)[:, None] + 0.5)
# Last coefficients of this size, relative to the whole, may be rounding errors; what they leave out is less.
AGREE = 64 * UNIT
MOST_HALVINGS = 30  # below 1e-9 of an interval, what a jump is missed by is far below a rounding
MOST_HALVED = 2**18  # panels of the intervals of one chunk: some seconds; a jump in an interval takes sixty
MOST_TOGETHER = 1024  # integrated at once: what is held of them stays within some MB, however many there are
LOOKS = 5  # instants of an interval at which a switch that is not linear in time is looked for
MOST_PANELS = 4096  # of one exponential: some ten thousand radians within an interval
BISECTIONS = 60  # of the time between two looks, after which the switch is placed to a rounding


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """e^{A u} up to `duration` seconds, in Legendre coefficients, panel by panel.

    `edges` (panels + 1,) are of the time u that is left of an interval, which stays exact where something
    dies out at once; `terms` (panels, TERMS, n_x, pushed).
    """

    duration: float
    edges: Floats
    terms: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SiteForcing:
    """The forces on one site: `force` of time, and where it is not smooth.

    It is not at the instants `breaks`, in order, nor where one of `switches` changes sign. `kernels` has one
    of each length of interval.
    """

    force: Any  # casadi.Function
    switches: Any  # casadi.Function
    breaks: Floats
    kernels: tuple[Kernel, ...]


def site_forcing(
    rates: Rates, parameters: Floats, durations: Sequence[Fraction], kernels: dict[Any, tuple[Kernel, ...]]
) -> SiteForcing:
    """Return the forces on a site.

    Parameters
    ----------
    rates
        The equations of its kind.
    parameters
        The site's (n_p,).
    durations
        The lengths of intervals, in seconds.
    kernels
        What sites have in common that differ in nothing the continuous equations read.
    """
    type_: Any = casadi.SX if rates.rate.is_a("SXFunction") else casadi.MX
    t = type_.sym("t")
    g = rates.rate(parameters, t)
    pushed, breaks, switches = tuple(range(g.numel())), [], []
    if type_ is casadi.SX:  # a loop solved by iteration has no switches but those that halving finds
        pushed = tuple(row for row in pushed if not g[row].is_zero())
        lookups = lookups_of(g)
        paces = [casadi.jacobian(at, t) for _, at in lookups]
        steady = not any(casadi.depends_on(pace, t) for pace in paces)
        if steady:
            for (table, at), pace in zip(lookups, paces, strict=True):
                breaks.append((casadi.DM(table.times) - casadi.substitute(at, t, 0)) / pace)
        for guard in guards_of(g, t, tables=not steady):
            slope = casadi.jacobian(guard, t)
            if casadi.depends_on(slope, t):
                switches.append(guard)
            else:
                breaks.append(-casadi.substitute(guard, t, 0) / slope)
    known = np.asarray(casadi.evalf(casadi.vertcat(type_(0, 1), *breaks)), np.float64).reshape(-1)
    key = (pushed, np.asarray(rates.matrices(parameters)).tobytes())
    if key not in kernels:
        a = exact_rates(rates, parameters)[:, : len(rates.pattern)]
        kernels[key] = tuple(_kernel_of(a, pushed, length) for length in durations)
    return SiteForcing(
        force=casadi.Function("force", [t], [casadi.densify(g[list(pushed)])]),
        switches=casadi.Function("switches", [t], [casadi.densify(casadi.vertcat(type_(0, 1), *switches))]),
        breaks=np.unique(known[np.isfinite(known)]),
        kernels=kernels[key],
    )


def _kernel_of(a: NDArray[Any], pushed: Sequence[int], duration: Fraction) -> Kernel:
    """Compute the exponential of A (n_x, n_x), exact, where a force pushes, over an interval."""
    length, least = float(duration), 2.0**-MOST_HALVINGS * float(duration)
    start = np.eye(len(a))[:, list(pushed)]  # the exponential where nothing is left
    largest = start
    edges, terms, work = [0.0], [], [(0.0, length)]
    while work:
        low, high = work.pop()
        left = [Fraction(float(node)) for node in _nodes(low, high)]
        steps = discretize(a, np.zeros((len(a), 0), dtype=object), left)
        values = np.array([step.matrix[:, list(pushed)] for step in steps])
        largest = np.maximum(largest, np.abs(values).max(axis=0))
        coefficients = np.tensordot(TRANSFORM, values, 1)
        missed = np.abs(coefficients[-2:]).max(axis=0)
        if (
            low == 0
        ):  # what dies out at once may be over at the first node; here roundings of all terms add up
            missed = np.maximum(missed, np.abs(legendre.legval(-1, coefficients) - start) / TERMS)
        if (missed <= AGREE * largest).all() or high - low <= least:
            edges.append(high)
            terms.append(coefficients)
        else:
            middle = (low + high) / 2
            work += [(middle, high), (low, middle)]
        if len(terms) + len(work) > MOST_PANELS:
            what = (
                f"beside a force that changes with time something swings too fast to follow for {length:g} s"
            )
            raise ApcError(
                Mistake("E871", Place("simulation"), what, hint="a softer part, or a constant force")
            )
    return Kernel(length, np.array(edges), np.array(terms))


def impulses(site: SiteForcing, starts: Floats, which: Integers) -> Floats:
    """Return c of every interval (intervals, n_x).

    Parameters
    ----------
    site
        The forces.
    starts
        When each interval begins, in seconds (intervals,).
    which
        The place of each interval's length in the site's `kernels` (intervals,).
    """
    result = np.zeros((len(starts), site.kernels[0].terms.shape[2]))
    for place, kernel in enumerate(site.kernels):
        rows = np.flatnonzero(which == place)
        result[rows] = _impulses_of_length(site, kernel, starts[rows])
    return result


def _impulses_of_length(site: SiteForcing, kernel: Kernel, starts: Floats) -> Floats:
    """Return c of intervals of one length (intervals, n_x)."""
    total, size = (np.zeros((len(starts), kernel.terms.shape[2])) for _ in range(2))
    switched, at = _switched(site, kernel.duration, starts)
    left = kernel.duration - at
    halved = 0
    for panel, (begin, end) in enumerate(zip(kernel.edges[:-1], kernel.edges[1:], strict=True)):
        inside = (left > begin) & (left < end)
        cut = _between(switched[inside], left[inside], begin, end)
        whole = np.setdiff1d(np.arange(len(starts)), cut[0])
        ends = np.full(len(whole), begin), np.full(len(whole), end)
        work = [(*cut, 0), (whole, *ends, 0)]
        while work:
            rows, low, high, halvings = work.pop()
            if len(rows) > MOST_TOGETHER:
                work.append((rows[MOST_TOGETHER:], low[MOST_TOGETHER:], high[MOST_TOGETHER:], halvings))
                rows, low, high = rows[:MOST_TOGETHER], low[:MOST_TOGETHER], high[:MOST_TOGETHER]
            if not len(rows):
                continue
            value, error = _integrated(site, kernel, panel, starts[rows], low, high, size, rows)
            off = (error > AGREE * size[rows]).any(axis=1) & np.isfinite(value).all(axis=1)
            off &= halvings < MOST_HALVINGS
            np.add.at(total, rows[~off], value[~off])
            if off.any():
                halved += int(off.sum())
                if halved > MOST_HALVED:
                    raise _too_fast(starts, kernel)
                rows, low, high = rows[off], low[off], high[off]
                middle = (low + high) / 2
                work += [(rows, low, middle, halvings + 1), (rows, middle, high, halvings + 1)]
    return total


def _integrated(
    site: SiteForcing,
    kernel: Kernel,
    panel: int,
    starts: Floats,
    low: Floats,
    high: Floats,
    size: Floats,
    rows: Integers,
) -> tuple[Floats, Floats]:
    """Integrate parts of a panel of intervals that begin at `starts`, all (k,), and bound what is left out.

    A part reaches from `high` to `low` seconds before its interval's end.

    Returns the integrals (k, n_x), and what the force's last coefficients contribute to them (k, n_x). What
    the terms of the intervals `rows` add up to is taken into `size` (intervals, n_x).
    """
    begin, end = kernel.edges[panel], kernel.edges[panel + 1]
    equal = slice(0, 1 if (low == low[0]).all() and (high == high[0]).all() else None)
    places = 2 * (_nodes(low[equal], high[equal]) - begin) / (end - begin) - 1
    steps = np.tensordot(legendre.legvander(places, TERMS - 1), kernel.terms[panel], 1)  # (k, nodes, …)
    instants = starts[:, None] + (kernel.duration - _nodes(low, high))
    g = np.moveaxis(_at(site.force, instants), 0, -1)  # (k, nodes, pushed)
    half = (high - low)[:, None] / 2
    weighted = (g * WEIGHTS[:, None] * half[:, :, None]).reshape(len(rows), 1, -1)
    flat = steps.swapaxes(2, 3).reshape(len(steps), weighted.shape[2], steps.shape[2])
    np.maximum.at(size, rows, (np.abs(weighted) @ np.abs(flat))[:, 0])
    coefficients = np.abs(np.einsum("ci,kiq->kcq", TRANSFORM, g))
    # A rounding of the instants moves the force by its slope, which no halving mends.
    slope = np.einsum("c,kcq->kq", np.arange(TERMS) ** 2.0, coefficients) / half
    rounding = TERMS * UNIT * np.abs(instants[:, :1]) * slope
    missed = np.maximum(
        coefficients[:, -2:].sum(axis=1) - np.where(np.isfinite(rounding), rounding, 0.0), 0.0
    )
    error = 2 * half * (np.abs(steps).max(axis=1) @ missed[:, :, None])[:, :, 0]
    return (weighted @ flat)[:, 0], error


def _nodes(low: Any, high: Any) -> Floats:
    """Return the nodes between `low` and `high`, one more axis."""
    low, high = np.asarray(low), np.asarray(high)
    return np.asarray(low[..., None] + (high - low)[..., None] * (NODES + 1) / 2)


def _at(function: Any, instants: Floats) -> Floats:
    """Return a function's column at instants of any shape, in seconds (rows, *shape).

    Each operation of an expression is NumPy's over all instants: CasADi's own map takes longer to build.
    """
    shape, flat = (function.numel_out(0), *instants.shape), instants.reshape(-1)
    if not np.prod(shape):
        return np.empty(shape)
    if not function.is_a("SXFunction"):  # the solution of a loop, which only CasADi knows
        return np.asarray(function.map(flat.size)(flat.reshape(1, -1)), np.float64).reshape(shape)
    with np.errstate(all="ignore"):
        [rows] = evaluate_exact(function, [[flat]], number=np.float64, rules=ROWS)
    return np.stack([np.broadcast_to(row, flat.shape) for row in rows]).reshape(shape)


def _too_fast(starts: Floats, kernel: Kernel) -> ApcError:
    begin, end = float(starts.min()), float(starts.max() + kernel.duration)
    what = (
        f"a force changes too fast: from {begin:.6g} s to {end:.6g} s it would be looked at in more than "
        f"{MOST_HALVED:,} places"
    )
    return ApcError(Mistake("E871", Place("simulation"), what, hint="a lower frequency, or a constant force"))


def _between(rows: Integers, at: Floats, begin: float, end: float) -> tuple[Integers, Floats, Floats]:
    """Return the parts into which instants `at` of the intervals `rows` cut them from `begin` to `end`.

    That is, whose part each is, and where it begins and ends.
    """
    cut = np.unique(rows)
    ends = np.concatenate([np.full(len(cut), begin), np.full(len(cut), end), at])
    whose = np.concatenate([cut, cut, rows])
    order = np.lexsort((ends, whose))
    ends, whose = ends[order], whose[order]
    inside = (whose[1:] == whose[:-1]) & (ends[1:] > ends[:-1])
    return whose[:-1][inside], ends[:-1][inside], ends[1:][inside]


def _switched(site: SiteForcing, length: float, starts: Floats) -> tuple[Integers, Floats]:
    """Return the intervals within which something switches, and how long after their beginning."""
    first = np.searchsorted(site.breaks, starts, side="right")
    many = np.maximum(np.searchsorted(site.breaks, starts + length) - first, 0)
    rows = np.repeat(np.arange(len(starts)), many)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(many) - many, many) + first[rows]
    at = site.breaks[place] - starts[rows]
    looks = np.linspace(0.0, length, LOOKS)
    signs = np.sign(_at(site.switches, starts[:, None] + looks))
    switch, row, gap = np.nonzero(signs[:, :, 1:] != signs[:, :, :-1])
    low, high, sign = looks[gap], looks[gap + 1], signs[switch, row, gap]
    for _ in range(BISECTIONS if len(row) else 0):
        middle = (low + high) / 2
        passed = np.sign(_at(site.switches, starts[row] + middle)[switch, np.arange(len(row))]) != sign
        low, high = np.where(passed, low, middle), np.where(passed, middle, high)
    return np.append(rows, row), np.append(at, high)
