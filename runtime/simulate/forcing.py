"""What forces that change with time alone add to a site's motion, exact to rounding.

Takes: the `Rates` of a kind, parameter vectors, when the intervals begin and how long they last.
Gives: `Forcing`, `forcing_of`, `SiteForcing`, `site_forcing`, `impulses`.
Guarantees: an interval is split where a comparison of `time` switches (a step, a corner of a ramp, a row of a
table), so that what is integrated is smooth; an impulse is within a few roundings of its terms.
Does not: integrate what depends on the motion.

    c = ∫₀ᵀ e^{A (T − s)} g(t + s) ds

by Gauss and Legendre's rule, whose error for n nodes is T^{2n+1} (n!)⁴ / ((2n + 1) (2n)!³) times the 2n-th
derivative of the integrand (Davis and Rabinowitz, Methods of Numerical Integration, section 2.7): for a sine
of half a turn within T, 4e-27 at 10 nodes. Whether 10 nodes are enough is seen from 16; where they differ
the interval is halved.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.runtime.frame.discretize import UNIT, discretize
from apc.runtime.frame.guards import guards_of
from apc.runtime.simulate.propagate import Rates

Floats = NDArray[np.float64]

COARSE, FINE = (np.polynomial.legendre.leggauss(n) for n in (10, 16))
# Both rules round each of their terms once or twice: they agree within this many units of their magnitudes.
AGREE = 16 * UNIT
MOST_HALVINGS = 30  # below 1e-9 of an interval, what a jump is missed by is far below a rounding
LOOKS = 5  # instants of an interval at which a switch that is not linear in time is looked for


@dataclass(frozen=True, slots=True, eq=False)
class Forcing:
    """A kind's g(t): `rates`, and where it is not smooth: at sign changes of `switches(p, t)`."""

    rates: Rates
    switches: Any  # casadi.Function
    affine: bool  # whether all switches are linear in time


@dataclass(frozen=True, slots=True, eq=False)
class Rule:
    """∫ e^{A (T − s)} g(s) ds over a panel of an interval is Σ `factors` g(`after`).

    `after` (n,) are seconds from the interval's start, `factors` (n, n_x, n_x).
    """

    after: Floats
    factors: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SiteForcing:
    """The forces on one site: its parameters (n_p,), A, and the two rules of each of `durations`."""

    forcing: Forcing
    parameters: Floats
    a: NDArray[Any]
    durations: tuple[Fraction, ...]
    rules: tuple[tuple[Rule, Rule], ...]


def forcing_of(rates: Rates) -> Forcing:
    """Find where a kind's forces switch with time."""
    found: list[Any] = []
    p, t = casadi.SX.sym("p", rates.rate.numel_in(0)), casadi.SX.sym("t")
    if rates.rate.is_a("SXFunction"):  # a nonlinear loop has no switches but those halving finds
        found = guards_of(rates.rate(p, t), t)
    column = casadi.vertcat(*found) if found else casadi.SX(0, 1)
    slopes = casadi.jacobian(column, t)
    affine = not (found and slopes.nnz() and casadi.depends_on(slopes, t))
    return Forcing(rates, casadi.Function("switches", [p, t], [casadi.densify(column)]), affine)


def site_forcing(
    forcing: Forcing, parameters: Floats, a: NDArray[Any], durations: Sequence[Fraction]
) -> SiteForcing:
    """Return the forces on one site.

    Parameters
    ----------
    forcing
        Its kind's.
    parameters
        Its vector (n_p,).
    a
        Its A (n_x, n_x), exact.
    durations
        The different lengths of intervals, in seconds.
    """
    rules = tuple(_rules(a, 0.0, float(duration), duration) for duration in durations)
    return SiteForcing(forcing, parameters, a, tuple(durations), rules)


def impulses(site: SiteForcing, starts: Floats, which: NDArray[np.int64]) -> Floats:
    """Return c of every interval (intervals, n_x).

    Parameters
    ----------
    site
        The forces.
    starts
        When each interval begins, in seconds (intervals,).
    which
        The place of each interval's length in the site's `durations` (intervals,).
    """
    result = np.zeros((len(starts), len(site.a)))
    for place in np.unique(which):
        rows = np.flatnonzero(which == place)
        result[rows] = _impulses_of_length(site, starts[rows], int(place))
    return result


def _impulses_of_length(site: SiteForcing, starts: Floats, place: int) -> Floats:
    forcing, length = site.forcing, float(site.durations[place])
    fine, apart, size = _both(site, site.rules[place], starts)
    split = (apart > AGREE * size).any(axis=1)
    looks = np.linspace(0.0, length, 2 if forcing.affine else LOOKS)
    if forcing.switches.numel_out(0):
        instants = starts[:, None] + looks
        many = forcing.switches.map(instants.size)(site.parameters, instants.reshape(1, -1))
        signs = np.sign(np.asarray(many)).reshape(-1, *instants.shape)
        split |= (signs[:, :, 1:] != signs[:, :, :-1]).any(axis=(0, 2))
    for row in np.flatnonzero(split):
        fine[row] = _split(site, float(starts[row]), site.durations[place], looks, size[row])
    return fine


def _split(site: SiteForcing, start: float, duration: Fraction, looks: Floats, size: Floats) -> Floats:
    """Return c of one interval, panel by panel between its switches; `size` is what its terms add up to."""
    edges = {0.0, float(duration)}
    for low, high in itertools.pairwise(looks):
        edges |= _roots(site, start, float(low), float(high))
    work = [(low, high, 0) for low, high in itertools.pairwise(sorted(edges))]
    total: Floats = np.zeros(len(site.a))
    while work:
        low, high, halvings = work.pop()
        [fine], [apart], [own] = _both(site, _rules(site.a, low, high, duration), np.array([start]))
        size = np.maximum(size, own)  # a step at the very end is not seen from afar
        if (apart <= AGREE * size).all() or halvings >= MOST_HALVINGS:
            total = total + fine
        else:
            middle = (low + high) / 2
            work += [(low, middle, halvings + 1), (middle, high, halvings + 1)]
    return total


def _roots(site: SiteForcing, start: float, low: float, high: float) -> set[float]:
    """Return where switches change sign between two instants after `start`, to the last digit."""

    def signs(after: float) -> Floats:
        switches = site.forcing.switches(site.parameters, start + after)
        return np.asarray(np.sign(np.asarray(switches).ravel()))

    found = set()
    first, last = signs(low), signs(high)
    for one in np.flatnonzero(first != last):
        left, right = low, high
        while left < (middle := (left + right) / 2) < right and start + left < start + right:
            if signs(middle)[one] == first[one]:
                left = middle
            else:
                right = middle
        found.add(right)
    return found


def _rules(a: NDArray[Any], low: float, high: float, duration: Fraction) -> tuple[Rule, Rule]:
    """Return the coarse and the fine rule of one panel of an interval."""
    nothing = np.zeros((len(a), 0), dtype=object)
    rules = []
    for nodes, weights in (COARSE, FINE):
        after = low + (high - low) * (nodes + 1) / 2
        left = [duration - Fraction(float(one)) for one in after]
        steps = np.array([step.matrix for step in discretize(a, nothing, left)])
        rules.append(Rule(after, steps * (weights * (high - low) / 2)[:, None, None]))
    return rules[0], rules[1]


def _both(site: SiteForcing, rules: tuple[Rule, Rule], starts: Floats) -> tuple[Floats, Floats, Floats]:
    """Integrate a panel of many intervals: by the finer rule, how far the coarser is, and the magnitudes."""
    results = []
    size: Floats = np.zeros(0)
    for rule in rules:
        instants = (starts[:, None] + rule.after).reshape(1, -1)
        rate = np.asarray(site.forcing.rates.rate.map(instants.size)(site.parameters, instants))
        g = rate.reshape(len(site.a), len(starts), len(rule.after))
        results.append(np.einsum("nij,jkn->ki", rule.factors, g))
        size = np.einsum("nij,jkn->ki", np.abs(rule.factors), np.abs(g))
    return results[1], np.abs(results[1] - results[0]), size
