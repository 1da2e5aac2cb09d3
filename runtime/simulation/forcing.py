"""What forces that change with time alone add to a site's motion, exact to rounding.

Takes: the `Rates` of a kind, parameter vectors, when the intervals begin and how long they last.
Gives: `Forcing`, `forcing_of`, `SiteForcing`, `impulses`; `at_instants`.
Guarantees: an interval is split where a comparison of `time` switches (a step, a corner of a ramp, a row of
a table), so that what is integrated is smooth; an impulse is right to a few roundings of its terms and of
the instants.
Does not: integrate what depends on the motion.

    c = ∫₀ᵀ e^{A (T − s)} g(t + s) ds

over all intervals of one length at once, by two rules (see `quadrature`); where they differ by more than
rounding, a panel is halved.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.interpolation import Interpolation
from apc.frame.exact import ROWS, evaluate_exact
from apc.frame.jacobians import guards_of, lookups_of
from apc.simulation.propagate import Rates
from apc.simulation.quadrature import AGREE, Kernel, Panels, integrate, magnitude, panels, whole

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

COMPARISONS = (casadi.OP_LT, casadi.OP_LE, casadi.OP_EQ, casadi.OP_NE)
KEPT = 64  # sites whose forces are kept in pieces
MOST_HALVINGS = 30  # below 1e-9 of an interval, what a jump is missed by is far below a rounding
MOST_HALVED = 2**18  # panels of the intervals of one chunk: some seconds; a jump in an interval takes sixty
MOST_PANELS = 256  # integrated at once: what is held of them stays within some MB, however many there are
# Instants of one walk: the arrays it holds then stay in the cache of a processor.
MOST_INSTANTS = 8192
MOST_VALUES = 2**23  # of all operations of a long expression, which the walk keeps
LOOKS = 5  # instants of an interval at which a switch that is not linear in time is looked for

# A switch is found to this share of the interval, or to a rounding of its instant.
PLACED = 2.0**-60
# Where it is looked for between two instants: evenly, which leaves 1/32 of what is between them, and nearer
# and nearer to where a straight line through both would cross 0, which leaves nothing if it is one.
EVENLY = np.arange(1, 32) / 32
NEARER = 4.0 ** -np.arange(1, 31)


@dataclass(frozen=True, slots=True, eq=False)
class Forcing:
    """A kind's g(t): what pushes the states `pushed`, and where it is not smooth.

    `force(p, t)` is their rows of g, `drift(p, t)` those of t dg/dt: a rounding of t changes g by so many.
    Not smooth is g at sign changes of `switches(p, t)`; `affine` says that all of them are linear in time.
    Nor is it where a clock of `clocks(p, t)` passes a row of its table in `tables`: these clocks go evenly,
    and how fast stands below them.
    Where g is straight between all these, `line(p, t)` tells what `switches` and `force` are at t and then
    how fast each changes, else it is None.
    """

    pushed: tuple[int, ...]
    force: Any  # casadi.Function
    drift: Any  # casadi.Function
    switches: Any  # casadi.Function
    affine: bool
    line: Any | None = None  # casadi.Function
    tables: tuple[Interpolation, ...] = ()
    clocks: Any | None = None  # casadi.Function


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """A force that is straight between `breaks` (k,): of each piece its value at an instant, and its slope.

    The instants are `at` (k + 1,), the values and slopes (pushed, k + 1).
    """

    breaks: Floats
    at: Floats
    values: Floats
    slopes: Floats

    def force(self, instants: Floats) -> Floats:
        """Return the force at instants, as `at_instants`."""
        piece = np.searchsorted(self.breaks, instants, side="right")
        return np.asarray(self.values[:, piece] + self.slopes[:, piece] * (instants - self.at[piece]))

    def drift(self, instants: Floats) -> Floats:
        """Return what a rounding of the instants changes it by so many times."""
        return np.asarray(self.slopes[:, np.searchsorted(self.breaks, instants, side="right")] * instants)


@dataclass(frozen=True, slots=True, eq=False)
class SiteForcing:
    """The forces on one site: its parameters (n_p,), and the kernel of each length of intervals."""

    forcing: Forcing
    parameters: Floats
    kernels: tuple[Kernel, ...]

    @property
    def lines(self) -> Lines | None:
        """The forces in pieces, None where they are not straight between switches."""
        return _lines(self.forcing, self.parameters.tobytes()) if self.forcing.line else None

    @property
    def rows(self) -> Floats:
        """The instants, in order, at which tables have their rows."""
        return _rows(self.forcing, self.parameters.tobytes())

    def force(self, instants: Floats) -> Floats:
        """Return the forces at instants, as `at_instants`."""
        lines = self.lines
        return lines.force(instants) if lines else at_instants(self.forcing.force, self.parameters, instants)

    def drift(self, instants: Floats) -> Floats:
        """Return by how much a rounding of the instants changes them, relatively."""
        lines = self.lines
        return lines.drift(instants) if lines else at_instants(self.forcing.drift, self.parameters, instants)


def forcing_of(rates: Rates) -> Forcing:
    """Find what a kind's forces push, and where they switch with time."""
    type_: Any = casadi.SX if rates.rate.is_a("SXFunction") else casadi.MX
    p, t = type_.sym("p", rates.rate.numel_in(0)), type_.sym("t")
    g = rates.rate(p, t)
    pushed, found, affine = tuple(range(g.numel())), [], True
    tables: tuple[Interpolation, ...] = ()
    clocks = None
    if type_ is casadi.SX:  # a nonlinear loop has no switches but those halving finds
        pushed = tuple(row for row in pushed if not g[row].is_zero())
        lookups = lookups_of(g)
        read = casadi.vertcat(*(at for _, at in lookups))
        pace = casadi.jacobian(read, t)
        if lookups and not casadi.depends_on(pace, t):
            tables = tuple(table for table, _ in lookups)
            clocks = casadi.Function("clocks", [p, t], [casadi.densify(casadi.vertcat(read, pace))])
        found = guards_of(g, t, tables=not tables)
    g = g[list(pushed)]
    if found:
        slopes = casadi.jacobian(casadi.vertcat(*found), t)
        affine = not (slopes.nnz() and casadi.depends_on(slopes, t))
    column = casadi.vertcat(*found) if found else type_(0, 1)
    line = None
    if type_ is casadi.SX and affine and not _moves(slope := casadi.jacobian(g, t), t):
        told = casadi.vertcat(column, g, casadi.jacobian(column, t), slope)
        line = casadi.Function("line", [p, t], [casadi.densify(told)])
    return Forcing(
        pushed=pushed,
        force=casadi.Function("force", [p, t], [casadi.densify(g)]),
        drift=casadi.Function("drift", [p, t], [casadi.densify(t * casadi.jacobian(g, t))]),
        switches=casadi.Function("switches", [p, t], [casadi.densify(column)]),
        affine=affine,
        line=line,
        tables=tables,
        clocks=clocks,
    )


def _moves(expression: Any, time: Any) -> bool:
    """Say whether an expression hangs on time otherwise than by what has switched."""
    dense = casadi.densify(expression)
    work, seen = [dense[place] for place in range(dense.numel())], set[int]()
    while work:
        node = work.pop()
        if node.element_hash() in seen or node.op() in COMPARISONS:
            continue
        seen.add(node.element_hash())
        if node.element_hash() == time.element_hash():
            return True
        row = node.op() == casadi.OP_CALL  # of a table, the first
        work += [node.dep(place) for place in range(row, node.n_dep())]
    return False


@functools.lru_cache(maxsize=KEPT)
def _lines(forcing: Forcing, numbers: bytes) -> Lines:
    """Return forces that are straight between switches, of a site of such parameters."""
    parameters, switches = np.frombuffer(numbers), forcing.switches.numel_out(0)
    pushed = len(forcing.pushed)
    start = at_instants(forcing.line, parameters, np.zeros(1))[:, 0]
    changing = start[switches + pushed : 2 * switches + pushed]
    with np.errstate(all="ignore"):
        breaks = -start[:switches] / changing
    breaks = np.union1d(breaks[np.isfinite(breaks)], _rows(forcing, numbers))
    ends = np.concatenate([breaks[:1] - 1, breaks, breaks[-1:] + 1]) if len(breaks) else np.zeros(2)
    at = (ends[1:] + ends[:-1]) / 2
    found = at_instants(forcing.line, parameters, at)
    return Lines(breaks, at, found[switches : switches + pushed], found[2 * switches + pushed :])


@functools.lru_cache(maxsize=KEPT)
def _rows(forcing: Forcing, numbers: bytes) -> Floats:
    """Return the instants at which tables have their rows, of a site of such parameters."""
    if not forcing.tables:
        return np.empty(0)
    told = at_instants(forcing.clocks, np.frombuffer(numbers), np.zeros(1))[:, 0]
    begun, pace = np.split(told, 2)
    with np.errstate(all="ignore"):
        found = [
            (table.times - one) / fast for table, one, fast in zip(forcing.tables, begun, pace, strict=True)
        ]
    rows = np.unique(np.concatenate(found))
    return np.asarray(rows[np.isfinite(rows)])


def at_instants(function: Any, parameters: Floats, instants: Floats) -> Floats:
    """Return a function's column at all instants (rows, *shape of the instants).

    An expression is walked once, each operation over all instants in one call of NumPy; what does not hang on
    time is computed once. CasADi's own map takes longer to build than to evaluate, and copies the parameters
    to each instant.

    Parameters
    ----------
    function
        A `casadi.Function` of (p, t), its only output a dense column.
    parameters
        p (n_p,).
    instants
        In seconds, of any shape.
    """
    flat = instants.reshape(-1)
    values = np.empty((function.numel_out(0), flat.size))
    if not function.is_a("SXFunction"):  # the solution of a nonlinear loop, which only CasADi knows
        if flat.size:
            many = function.map(flat.size)(parameters, flat.reshape(1, -1))
            values[:] = np.asarray(many).reshape(values.shape)
        return values.reshape(len(values), *instants.shape)
    listed = list(parameters)
    with np.errstate(all="ignore"):
        together = max(1, min(MOST_INSTANTS, MOST_VALUES // function.n_instructions()))
        for start in range(0, flat.size, together):
            some = slice(start, start + together)
            for row, found in enumerate(
                evaluate_exact(function, [listed, [flat[some]]], number=np.float64, rules=ROWS)[0]
            ):
                values[row, some] = found
    return values.reshape(len(values), *instants.shape)


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
    result = np.zeros((len(starts), len(site.kernels[0].a)))
    for place, kernel in enumerate(site.kernels):
        rows = np.flatnonzero(which == place)
        result[rows] = _impulses_of_length(site, kernel, starts[rows])
    return result


def _impulses_of_length(site: SiteForcing, kernel: Kernel, starts: Floats) -> Floats:
    total, off, size = _integrated(site, whole(kernel), starts)
    rows, at = _switched(site, kernel, starts)
    if not kernel.smooth:
        layers = _layers(kernel)
        rows = np.append(rows, np.repeat(np.arange(len(starts)), len(layers)))
        at = np.append(at, np.tile(layers, len(starts)))
    off[rows] = True
    if not off.any():
        return total
    total[off] = 0.0
    work = [(*_between(np.flatnonzero(off), rows, at, float(kernel.duration)), 0)]
    halved = 0
    while work:
        rows, low, high, halvings = work.pop()
        if len(rows) > MOST_PANELS:
            work.append((rows[MOST_PANELS:], low[MOST_PANELS:], high[MOST_PANELS:], halvings))
            rows, low, high = rows[:MOST_PANELS], low[:MOST_PANELS], high[:MOST_PANELS]
        added, off, own = _integrated(site, panels(kernel, low, high), starts[rows], size[rows])
        np.maximum.at(size, rows, own)  # a step at the very end is not seen from afar
        off &= halvings < MOST_HALVINGS
        np.add.at(total, rows[~off], added[~off])
        if off.any():
            halved += int(off.sum())
            if halved > MOST_HALVED:
                raise _too_fast(starts, kernel)
            rows, low, high = rows[off], low[off], high[off]
            middle = (low + high) / 2
            halves = np.tile(rows, 2), np.append(low, middle), np.append(middle, high)
            work.append((*halves, halvings + 1))
    return total


def _layers(kernel: Kernel) -> Floats:
    """Return times of an interval ever nearer to its end, down to where what decays fastest is seen.

    Of a motion that forgets within a small part of the interval only the end counts: both rules miss it.
    """
    rate = float(np.abs(kernel.a).sum(axis=1).max(initial=0)) * float(kernel.duration)
    steps = min(math.ceil(math.log(rate, 4)), MOST_HALVINGS) if rate > 1 else 0
    return np.asarray(float(kernel.duration) * (1 - 4.0 ** -np.arange(1, steps + 1)), dtype=np.float64)


def _too_fast(starts: Floats, kernel: Kernel) -> ApcError:
    begin, end = float(starts.min()), float(starts.max() + kernel.duration)
    what = (
        f"a force changes too fast: from {begin:.6g} s to {end:.6g} s it would be looked at in more than "
        f"{MOST_HALVED:,} places"
    )
    return ApcError(Mistake("E871", Place("simulation"), what, hint="a lower frequency, or a constant force"))


def _integrated(
    site: SiteForcing, found: Panels, starts: Floats, size: Floats | float = 0.0
) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Integrate panels of intervals that begin at `starts` (k,), all of one or each of its own.

    Returns
    -------
    The integrals (k, n_x); which of them both rules do not agree upon (k,); what their terms add up to
    (k, n_x), at least `size`.
    """
    instants = starts[:, None] + found.after
    g = site.force(instants)
    fine, apart = integrate(found, g)
    size = np.maximum(magnitude(found, g), size)
    off: NDArray[np.bool_] = ~np.all(apart <= AGREE * size, axis=1)
    off &= np.isfinite(fine).all(axis=1)  # halves of what has no value have none either
    if off.any():  # it may be that of rounding the instants, which no halving mends
        some = found if len(found.after) == 1 else found.chosen(off)
        drift = site.drift(instants[off])
        moved = magnitude(some, np.where(np.isfinite(drift), drift, 0.0))
        off[off] = ~np.all(apart[off] <= AGREE * (size[off] + moved), axis=1)
    return fine, off, size


def _between(again: Integers, rows: Integers, at: Floats, duration: float) -> tuple[Integers, Floats, Floats]:
    """Return the panels of the intervals `again`: whose they are, and where they begin and end.

    `at` (k,) are instants of the intervals `rows` (k,) at which something switches.
    """
    ends = np.concatenate([np.tile([0.0, duration], len(again)), at])
    whose = np.concatenate([np.repeat(again, 2), rows])
    order = np.lexsort((ends, whose))
    ends, whose = ends[order], whose[order]
    inside = (whose[1:] == whose[:-1]) & (ends[1:] > ends[:-1])
    return whose[:-1][inside], ends[:-1][inside], ends[1:][inside]


def _switched(site: SiteForcing, kernel: Kernel, starts: Floats) -> tuple[Integers, Floats]:
    """Return the intervals within which something switches, and how long after their beginning."""
    length = float(kernel.duration)
    row, at = _within(site.lines.breaks if site.lines else site.rows, starts, length)
    if not site.lines:
        other, looked = _looked(site, length, starts)
        row, at = np.append(row, other), np.append(at, looked)
    inside = (at > PLACED * length) & (at < length)
    return row[inside], at[inside]


def _within(breaks: Floats, starts: Floats, length: float) -> tuple[Integers, Floats]:
    """Return the intervals in which any of some instants in order lie, and how long after their beginning."""
    first = np.searchsorted(breaks, starts, side="right")
    many = np.maximum(np.searchsorted(breaks, starts + length) - first, 0)
    rows = np.repeat(np.arange(len(starts)), many)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(many) - many, many) + first[rows]
    return rows, breaks[place] - starts[rows]


def _looked(site: SiteForcing, length: float, starts: Floats) -> tuple[Integers, Floats]:
    """Return the intervals in which a switch changes sign between two looks, and where."""
    forcing = site.forcing
    if not forcing.switches.numel_out(0):
        return np.empty(0, np.int64), np.empty(0)
    looks = np.linspace(0.0, length, 2 if forcing.affine else LOOKS)
    values = at_instants(forcing.switches, site.parameters, starts[:, None] + looks)
    switch, row, gap = np.nonzero(np.sign(values[:, :, 1:]) != np.sign(values[:, :, :-1]))
    low, high = looks[gap], looks[gap + 1]
    ends = values[switch, row, gap], values[switch, row, gap + 1]
    return row, _placed(site, starts[row], switch, low, high, ends, PLACED * length)


def _placed(
    site: SiteForcing,
    starts: Floats,
    switch: Integers,
    low: Floats,
    high: Floats,
    ends: tuple[Floats, Floats],
    enough: float,
) -> Floats:
    """Return where a switch changes sign between `low` and `high`, seconds after `starts`; all (k,).

    `ends` are its values there.
    """
    first, last = (one.copy() for one in ends)
    low, high = low.copy(), high.copy()
    sign = np.sign(first)
    while True:
        width = high - low
        busy = np.flatnonzero((width > enough) & (starts + low < starts + high - np.spacing(starts + high)))
        if not len(busy):
            return high
        with np.errstate(all="ignore"):
            guess = first[busy] / (first[busy] - last[busy])
        guess = np.where((guess > 0) & (guess < 1), guess, np.where(first[busy] == 0, 0.0, 0.5))[:, None]
        shares = np.concatenate([np.tile(EVENLY, (len(busy), 1)), guess - NEARER, guess + NEARER], axis=1)
        shares = np.sort(np.clip(shares, 0.0, 1.0), axis=1)
        places = np.clip(low[busy, None] + width[busy, None] * shares, low[busy, None], high[busy, None])
        places = np.concatenate([low[busy, None], places, high[busy, None]], axis=1)
        every = at_instants(site.forcing.switches, site.parameters, starts[busy, None] + places)
        values = every[switch[busy], np.arange(len(busy))]
        values[:, 0], values[:, -1] = first[busy], last[busy]
        after = np.argmax(np.sign(values) != sign[busy, None], axis=1)
        line = np.arange(len(busy))
        low[busy], high[busy] = places[line, after - 1], places[line, after]
        first[busy], last[busy] = values[line, after - 1], values[line, after]
