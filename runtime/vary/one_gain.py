"""Where an eigenvalue first crosses the unit circle as one gain grows, from the loop's response to it.

Takes: a line along which one parameter varies, and the eigenvalues of the loops where it starts.
Gives: `Gain`, `gains_of`; `Response`, `response_of`; `first_crossing`, `NotTold`.
Guarantees: what is no gain is not taken for one: every coefficient is straight in the parameter, none of it
in A or B. The work of a frequency doesn't know how many states there are, but for one sum over them.
Does not: prove a crossing (see `bracket`), or that none comes before it: angles are looked at as closely as
the eigenvalues near the circle ask for.

A gain δ acts at some ticks of a frame. With M(δ) = A + δ B (1 − δ D)⁻¹ C its loop has an eigenvalue ζ where

    G(ζ) = D + C (ζ − A)⁻¹ B        has an eigenvalue μ = 1/δ

G is as large as the gain acts often in a frame, whatever the delay and the number of states. A = X Λ X⁻¹ is
taken apart once for all gains; the first crossing is at the largest real μ > 0 of any ζ on the circle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from apc.compiler.frozen import dataclass
from apc.eigen.closing import close_outside, lay_out
from apc.eigen.eigenpairs import pair_near
from apc.eigen.peer_group import PeerGroup
from apc.eigen.relative import relative_rows
from apc.frame.discretize import exponential_values
from apc.frame.lift import FrameMap, compose
from apc.frame.linearize import sites_of_rows
from apc.frame.ports import Around, with_ways
from apc.frame.site import LinearTick, every_matrix, matrices_of
from apc.vary.batch import STEP, BatchEvaluator
from apc.vary.bends import bends
from apc.vary.crossings import CAUTION, PLACES, Root, cubic
from apc.vary.wiring import Wiring, site_key

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Truths = NDArray[np.bool_]

# Singular values of a change of coefficients smaller than this, relative to the largest, are rounding.
RANK = 1e-12

# What moves along rigidly may be followed by this much, relative to its size: rounding, of many states.
RIGID = 1e-9

# Angles to begin with: evenly so many in half a turn, and about each eigenvalue near the circle at so many of
# its distances from it.
EVEN, ABOUT = 64, (0.0, 0.3, 1.0, 3.0, 10.0)

# The first angle beside 1 and −1, relative to the distance of the nearest eigenvalue.
FIRST = 1e-6

# A cell is divided so often at most; angles looked at, of a gain at most.
MOST_LEVELS, MOST_ANGLES = 40, 200_000

# Angles nearer to each other than this are of one crossing.
SAME = 1e-6

# Numbers of a response that are worked on together.
TOGETHER = 1 << 19

# Steps of inverse iteration and of Newton's method at most; one so small, relatively, is the last.
STEPS, SETTLED = 20, 1e-13


class NotTold(Exception):
    """Angles or steps ran out: whether, or where, an eigenvalue crosses first is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """How a parameter acts in a loop as a gain: M = A + δ B (1 − δ D)⁻¹ C, δ its change."""

    a: Floats  # (n, n)
    b: Floats  # (n, m)
    c: Floats  # (m, n)
    d: Floats  # (m, m)

    def matrix(self, change: float) -> tuple[Floats, Floats]:
        """Return M (n, n), and its derivative, at a change of the parameter."""
        around = np.linalg.inv(np.eye(len(self.d)) - change * self.d)
        into = self.b @ around
        return self.a + change * (into @ self.c), into @ (around @ self.c)


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """A loop taken apart where all gains are what they are: its eigenvalues (n,) and their vectors."""

    values: Complexes
    right: Complexes
    inverse: Complexes

    def rates(self, gain: Gain) -> Complexes:
        """Return how fast each eigenvalue (n,) moves as the gain begins to grow."""
        return np.asarray(np.einsum("im,mi->i", self.inverse @ gain.b, gain.c @ self.right))

    def at(self, gain: Gain, angles: Floats) -> tuple[Complexes, Complexes]:
        """Return the eigenvalues (k, m) of G at angles (k,), and their derivatives over the angle."""
        into, out = self.inverse @ gain.b, gain.c @ self.right
        m, n = out.shape
        found, slopes = np.empty((2, len(angles), m), np.complex128)
        chunk = max(1, TOGETHER // max(m * n, 1))
        for start in range(0, len(angles), chunk):
            some = slice(start, start + chunk)
            points = np.exp(1j * angles[some])
            apart = 1 / (points[:, None] - self.values)
            response = gain.d + (out * apart[:, None]) @ into
            slope = -1j * points[:, None, None] * ((out * apart[:, None] ** 2) @ into)
            found[some], vectors = np.linalg.eig(response)
            try:
                moved = np.linalg.solve(vectors, slope @ vectors)
                slopes[some] = np.einsum("kii->ki", moved)
            except np.linalg.LinAlgError:
                slopes[some] = np.nan
        return found, slopes


def response_of(matrix: Floats) -> Response | None:
    """Take a loop's matrix (n, n) apart, None where its vectors are no basis."""
    values, right = np.linalg.eig(matrix)
    try:
        inverse = np.linalg.inv(right)
    except np.linalg.LinAlgError:
        return None
    return Response(values.astype(np.complex128), right.astype(np.complex128), inverse.astype(np.complex128))


def gains_of(family: BatchEvaluator, base: Floats, column: int) -> list[Gain] | None:
    """Return how one of an evaluator's parameters acts in each of its loops, None unless as a gain.

    Parameters
    ----------
    family
        The evaluator.
    base, column
        The point (m,) from which the parameter varies, and which it is.
    """
    straight = bends(family, tuple(base.tolist()), column)
    if straight is None or straight.functions or any(wiring.moving for wiring in family.wirings):
        return None
    along = np.eye(len(base))[column]
    maps: dict[tuple[int, int], tuple[FrameMap, int]] = {}
    for wiring in family.wirings:
        for group in wiring.system.sites:
            if site_key(group) not in maps:
                found = _with_ways(family, group, base, along)
                if found is None:
                    return None
                maps[site_key(group)] = found
    gains = [_gain(wiring, maps) for wiring in family.wirings]
    known = [one for one in gains if one is not None]
    return known if len(known) == len(gains) else None


def _gain(wiring: Wiring, maps: Mapping[tuple[int, int], tuple[FrameMap, int]]) -> Gain | None:
    """Return how a parameter acts in a loop of sites with ways around; None if it sees rigid motions."""
    groups = wiring.system.sites
    frames = [maps[site_key(group)][0] for group in groups]
    counts = [maps[site_key(group)][1] for group in groups]
    names = [
        (*group.z_names, *(f"followed {way}" for way in range(count)))
        for group, count in zip(groups, counts, strict=True)
    ]
    layout = lay_out(names, [group.schedule for group in groups])
    closed = close_outside(wiring.system, frames, counts, layout)
    ends = [
        offset + len(own) - np.arange(count, 0, -1)
        for offset, own, count in zip(layout.offsets, names, counts, strict=True)
    ]
    outside = np.concatenate(ends)
    own = np.delete(np.arange(len(layout.names)), outside)
    at, rigid = wiring.relative, wiring.rigid.basis
    followed = closed[outside][:, own]
    if not (np.abs(followed @ rigid) <= RIGID * (np.abs(followed) @ np.abs(rigid))).all():
        return None
    taken = relative_rows(closed[own], at)
    rest, into = own[at.rest], len(layout.names)
    return Gain(taken[:, rest], taken[:, into:], closed[outside][:, rest], closed[outside, into:])


def _with_ways(
    family: BatchEvaluator, group: PeerGroup, base: Floats, along: Floats
) -> tuple[FrameMap, int] | None:
    """Return a group's frame with ways around what follows a parameter, their number; None if A or B does."""
    vectors = family.vectors(group, base[None] + (STEP * 1j) * along[None])
    rows = family.rows(group.jacobians, vectors)
    site = sites_of_rows(group.jacobians, rows.real.copy())
    moved = every_matrix(sites_of_rows(group.jacobians, rows.imag / STEP), lambda one: one[0])
    rigidly = [moved.a, moved.b, *(block for send in moved.sends for block in (send.x, send.u))]
    if any(one.any() for one in rigidly) or not all(np.isfinite(one).all() for one in matrices_of(site)):
        return None
    fixed = family.fixed.get(site_key(group), {})
    steps = {quanta: step.matrix for quanta, step in fixed.items()}
    steps = steps or family.steps(site, base[None], exponential_values)
    ways: list[Around] = []
    for partition, tick in enumerate(moved.ticks):
        change = np.concatenate([tick.x, tick.u, tick.m, tick.r], axis=1)
        if not change.any():
            continue
        if group.site.kind.clocks[partition].variants:
            return None
        ends = np.cumsum([tick.x.shape[1], tick.u.shape[1], tick.m.shape[1]])
        left, sizes, right = np.linalg.svd(change, full_matrices=False)
        for one in np.flatnonzero(sizes > RANK * sizes[0]):
            x, u, m, r = np.split(right[[one]], ends, axis=1)
            follows = LinearTick(tick.clock, x, u, m, r, ())
            ways.append(Around(partition, left[:, one] * sizes[one], follows))
    wide, schedule = with_ways(every_matrix(site, lambda one: one[0]), group.schedule, ways)
    count = len(schedule.carried) - len(group.schedule.carried)
    frame = compose(wide, schedule, steps)
    return frame.mapped(lambda one: one.reshape(one.shape[-2:])), count


def first_crossing(gains: Sequence[tuple[Gain, Response]], start: float, end: float) -> Root | None:
    """Return where an eigenvalue of some loops, stable as they are, first crosses as a gain grows.

    Parameters
    ----------
    gains
        How the parameter acts in each loop, and the loop's response.
    start, end
        Its present value, and how far it is looked at.

    Raises
    ------
    NotTold
        It could not be found out.
    """
    best, found = end - start, None
    for place, (gain, response) in enumerate(gains):
        if not gain.b.any() or not gain.c.any():
            continue
        met = _least(gain, response, best)
        if met is None:
            continue
        settled = _settled(gain, *met)
        if settled is None:
            raise NotTold
        if settled[0] <= best:
            best, eigenvalue, slope = settled
            found = Root(start + best, start, end, True, place, eigenvalue, slope)
    return found


def _angles(values: Complexes) -> Floats:
    """Return angles to begin with, from 0 to half a turn, closer where eigenvalues are near the circle."""
    turns, away = np.abs(np.angle(values)), np.abs(1 - np.abs(values))
    near = away < 1
    about = np.multiply.outer(np.array([*ABOUT, *(-one for one in ABOUT[1:])]), away[near]) + turns[near]
    least = FIRST * min(1.0, float(away.min(initial=1.0)))
    found = np.concatenate([np.linspace(0, np.pi, EVEN + 1), about.ravel(), [least, np.pi - least]])
    found = np.unique(found[(found >= least) & (found <= np.pi - least)])
    return np.concatenate([[0.0], found, [np.pi]])


def _least(gain: Gain, response: Response, most: float) -> tuple[float, float] | None:
    """Return the least change up to `most` with an eigenvalue on the circle, and its angle there."""
    angles = _angles(response.values)
    values, slopes = response.at(gain, angles)
    best, found = most, None
    for end in (0, -1):
        real = values[end][np.abs(values[end].imag) <= SETTLED * np.abs(values[end])].real
        if real.max(initial=0.0) > 1 / best:
            best, found = 1 / float(real.max()), float(angles[end])
    left, right = angles[1:-2], angles[2:-1]
    ends = [values[1:-2], slopes[1:-2], values[2:-1], slopes[2:-1]]
    looked = len(angles)
    for _ in range(MOST_LEVELS):
        near, one, angle = _crossed(left, right, ends, 1 / best)
        alone = np.flatnonzero(one)
        met = _real(gain, response, left[alone], right[alone], angle[alone], 1 / best)
        for change, at in met[met[:, 0] > 0].tolist():
            if change < best:
                best, found = change, at
        done = np.zeros(len(left), dtype=bool)
        done[alone[met[:, 0] > 0]] = True
        cut = near & ~done
        looked += int(cut.sum())
        narrow = cut & (right - left <= SETTLED)
        cut &= ~narrow
        if found is not None:  # beside what was found, it is that
            narrow &= np.abs(left - found) > SAME
        if narrow.any() or looked > MOST_ANGLES:
            break
        if not cut.any():
            return None if found is None else (best, found)
        middle = (left[cut] + right[cut]) / 2
        value, slope = response.at(gain, middle)
        first, second = [one[cut] for one in ends[:2]], [one[cut] for one in ends[2:]]
        ends = [
            np.concatenate(pair) for pair in zip([*first, value, slope], [value, slope, *second], strict=True)
        ]
        left, right = np.concatenate([left[cut], middle]), np.concatenate([middle, right[cut]])
    raise NotTold


def _crossed(
    left: Floats,
    right: Floats,
    ends: Sequence[Complexes],
    least: float,
) -> tuple[Truths, Truths, Floats]:
    """Say of each cell whether an eigenvalue may be real beyond `least`, whether just one is, and where."""
    value, slope, end, end_slope = ends
    width = (right - left)[:, None]
    rise, end_rise = slope * width, end_slope * width
    miss = np.abs((value + rise / 2)[:, :, None] - (end - end_rise / 2)[:, None, :])
    partner = np.argmin(miss, axis=2)
    off = CAUTION * np.take_along_axis(miss, partner[:, :, None], axis=2)[:, :, 0]
    last, last_rise = (np.take_along_axis(one, partner, axis=1) for one in (end, end_rise))
    t = np.linspace(0.0, 1.0, PLACES)[:, None, None]
    path = cubic(t, value, rise, last, last_rise)
    off = off + np.abs(np.diff(path, 2, axis=0)).max(axis=0) / 8
    away = np.where(path.real >= least, np.abs(path.imag), np.abs(path - least)).min(axis=0)
    turned = path.imag[1:] * path.imag[:-1] <= 0
    turned &= np.maximum(path.real[1:], path.real[:-1]) + off >= least
    near = ~(away > off) | turned.any(axis=0)
    change = last.imag - value.imag
    steady = (value.imag * last.imag < 0) & (rise.imag * change > 0) & (last_rise.imag * change > 0)
    steady &= off < np.abs(change)
    count = near.sum(axis=1)
    cell, branch = np.arange(len(left)), np.argmax(near, axis=1)
    share = np.abs(value.imag[cell, branch]) / np.maximum(np.abs(change[cell, branch]), 1e-300)
    return count > 0, (count == 1) & steady[cell, branch], left + share * (right - left)


def _real(gain: Gain, response: Response, left: Floats, right: Floats, angle: Floats, least: float) -> Floats:
    """Return where in each cell the one eigenvalue that does becomes real: the change (k,) and the angle.

    By Newton's method; the change is 0 where it leaves its cell.
    """
    at, found = angle.copy(), np.zeros((len(angle), 2))
    busy = np.arange(len(angle))
    for _ in range(STEPS):
        if not len(busy):
            break
        values, slopes = response.at(gain, at[busy])
        # The nearest to the ray, of those that cross it in the cell.
        with np.errstate(all="ignore"):
            step = -values.imag / slopes.imag
        inside = (at[busy, None] + step >= left[busy, None]) & (at[busy, None] + step <= right[busy, None])
        inside &= values.real + slopes.real * step > least * (1 - 1e-9)
        which = np.argmin(np.where(inside, np.abs(step), np.inf), axis=1)
        row = np.arange(len(busy))
        good, moved = inside[row, which], step[row, which]
        at[busy] += np.where(good, moved, 0.0)
        arrived = good & (np.abs(moved) <= 1e-10 * (right - left)[busy] + SETTLED)
        real = (values.real + slopes.real * step)[row, which]
        found[busy[arrived]] = np.stack([1 / real, at[busy]], axis=1)[arrived]
        busy = busy[good & ~arrived]
    return found


def _settled(gain: Gain, change: float, angle: float) -> tuple[float, complex, float] | None:
    """Return the change at which an eigenvalue is on the circle, that, and how fast its magnitude grows.

    By inverse iteration and Newton's method on M itself; None where these don't arrive.
    """
    value = complex(np.exp(1j * angle))
    for _ in range(STEPS):
        matrix, slope = gain.matrix(change)
        pair = pair_near(matrix, value)
        value = complex(pair.values[0])
        size = abs(value)
        growth = float((np.conj(value) * pair.slopes(slope)[0]).real) / size
        step = (1 - size) / growth if growth else np.nan
        change += step
        if not change > 0:
            return None
        if abs(step) <= SETTLED * change:
            return change, value, growth
    return None
