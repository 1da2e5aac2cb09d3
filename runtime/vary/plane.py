"""Where eigenvalues of a loop cross the unit circle as one number varies, however long its delays are.

Takes: the logarithm of a loop's characteristic function over the circle and over what varies.
Gives: `Sheet`, `LineSheet`, `over_all`; `cross`, `count_beyond`.
Guarantees: every cell of the plane, angle by value, is divided until its corners agree on its middle, or do
so of F without the one zero that was found in it, or down to the cell size. `whole` says that all of them
agreed, and that the crossings found account for how the counts at neighbouring values differ.
Does not: prove that a cell is empty, or a crossing (see `bracket`). Floats are compared with floats: two
crossings that undo each other between two values, where corners agree by accident, change no count.

Four corners of a cell each foretell the logarithm of F at its middle, by value and slopes. Where F has no
zero nearby they agree; a zero within a cell's size of its middle makes them differ, or makes all of them
foretell a dip. Divided by the linear function that Newton's method leaves of F, a cell with one zero passes,
too. How often F goes around 0 along the circle counts the eigenvalues beyond it at each value, by steps that
agree in the same way; with crossings in between, each in its direction, neighbouring counts must agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from apc.eigen.bordered import Logarithm
from apc.vary.crossings import Root, Scan, extremes, narrowest

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]
Truths = NDArray[np.bool_]

# What corners foretell may differ by so much, and by so much less than a corner's, where no zero is near: of
# a straight F it differs by more where a zero is nearer to the middle than the corners are.
AGREE, DIP = 0.5, 1.0

# The argument a corner foretells may be so many radians from its own: nearer to a zero it turns any number of
# times, and agrees by accident.
TURNS = 2.0

# Angles to begin with: the first, relative to what one frame of the longest delay turns; their ratio while
# they are small, and their distance, in radians and in turns of the longest delay.
FIRST_ANGLE, RATIO, APART, TURNED = 1e-3, 1.6, 0.25, np.pi / 2

# Newton's steps in a cell, and how far, relative to it, the last one may go, and a zero beyond its edge lie.
STEPS, SETTLED, EDGE = 12, 1e-9, 1e-6

# Cells looked at at a time, arcs at a value, and levels: what follows the circle would be divided
# for ever, and what is nothing but rounding too.
MOST_OPEN, MOST_LEVELS = 20_000, 60

# A cell is divided aside of its middle, so that no angle is 0, where F may be 0/0.
ASIDE = 0.47

# An arc of a circle narrower than this, relative to the first, has a zero as good as on it.
NARROWEST = 1e-8

# Zeros on the circle nearer to one another than this are one; a cell this narrow in turns of the longest
# delay is divided no further. Newton's method leaves a cell when it is so many of its sizes away.
SAME, NARROW_ANGLE, AWAY = 1e-9, 1e-3, 1.5

# Zeros looked for beyond the circle from so many angles, in so many steps of ζ's logarithm, none longer than
# this; a step so small is the last, and one so small at the end says that there is a zero.
BEYOND, BEYOND_STEPS, LONGEST, ARRIVED, NEAR = 8, 12, 0.3, 1e-12, 1e-8


class Sheet(Protocol):
    """A loop's characteristic function over the plane of ζ and a value."""

    @property
    def states(self) -> int:
        """How many zeros it has, less what its packets make of them."""

    @property
    def longest(self) -> int:
        """The longest delay in frames."""

    def at(self, values: Floats, rows: Integers, points: Complexes) -> Logarithm:
        """Return its logarithm at points (z,), each at the value (k,) of its row (z,)."""

    def over(self, values: Floats, points: Complexes) -> Logarithm:
        """Return its logarithm (k, z) at all values (k,) and points (z,)."""


class LineSheet(Sheet, Protocol):
    """The same of what moves along a line: its `moving` is the derivative over the value."""

    def alone(self, values: Floats) -> Complexes:
        """Return the eigenvalues (k, n) of the sites hearing nothing at values (k,)."""


def over_all(sheet: Sheet, values: Floats, points: Complexes) -> Logarithm:
    """Return the logarithm (k, z) of a sheet at all values and points, one by one."""
    rows = np.repeat(np.arange(len(values)), len(points))
    found = sheet.at(values, rows, np.tile(points, len(values)))
    shape = (len(values), len(points))
    return Logarithm(*(one.reshape(shape) for one in (found.value, found.turning, found.moving)))


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Cells of the plane: between two angles and two values; corner by corner (k, 4) what F is there.

    The corners are (low, low), (high, low), (low, high), (high, high).
    """

    left: Floats
    right: Floats
    low: Floats
    high: Floats
    value: Complexes
    turning: Complexes
    moving: Complexes

    def chosen(self, which: Truths) -> _Cells:
        return _Cells(*(getattr(self, one.name)[which] for one in fields(self)))

    @property
    def corners(self) -> tuple[Floats, Floats]:
        """The angles and values of the corners (k, 4)."""
        return np.stack([self.left, self.right] * 2, axis=1), np.stack(
            [self.low, self.low, self.high, self.high], axis=1
        )

    def clear(self) -> Truths:
        """Say of each cell whether its corners agree on its middle."""
        angles, values = self.corners
        across = (self.left + self.right)[:, None] / 2 - angles
        along = (self.low + self.high)[:, None] / 2 - values
        change = self.turning * across + self.moving * along
        foretold = self.value + change
        apart = np.abs(_principal(foretold - foretold[:, :1])).max(axis=1)
        dip = self.value.real.min(axis=1) - foretold.real.min(axis=1)
        return np.asarray((apart < AGREE) & (dip < DIP) & (np.abs(change.imag).max(axis=1) < TURNS))

    def without(self, zeros: _Zeros) -> _Cells:
        """Return the cells with F divided by the linear function of a zero each."""
        angles, values = self.corners
        turning, moving = zeros.turning[:, None], zeros.moving[:, None]
        linear = turning * (angles - zeros.angle[:, None]) + moving * (values - zeros.value[:, None])
        return _Cells(
            self.left,
            self.right,
            self.low,
            self.high,
            self.value - np.log(linear),
            self.turning - turning / linear,
            self.moving - moving / linear,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Zeros:
    """Where F is 0, as Newton's method found it from each of some cells; NaN where it didn't arrive.

    The slopes are those of F divided by F's size.
    """

    angle: Floats
    value: Floats
    turning: Complexes
    moving: Complexes


def _principal(logarithm: Complexes) -> Complexes:
    """Return logarithms of one number with the argument nearest to 0."""
    return logarithm.real + 1j * (np.mod(logarithm.imag + np.pi, 2 * np.pi) - np.pi)


def cross(sheets: Sequence[LineSheet], points: Floats, least: float, *, first: bool = False) -> Scan:
    """Find the values at which the stability of several loops changes, between the first and last of some.

    Parameters
    ----------
    sheets
        The loops.
    points
        Where to begin (k,), in order.
    least
        Cells are measured against the value, or against this where the value is smaller.
    first
        Whether what lies beyond the first stretch that is seen to be unstable all along is left alone.
    """
    narrow = narrowest(points, least)
    unstable = np.zeros(len(points) - 1, dtype=bool)
    for one in sheets:
        unstable |= _beyond_all_along(one, points)
    if first and unstable.any():
        points = points[: int(np.argmax(unstable)) + 1]
    cells = np.flatnonzero(~unstable[: len(points) - 1])
    if not len(cells):
        return Scan(points, np.zeros(len(points), dtype=bool), (), whole=True)
    ends = np.zeros(len(points), dtype=bool)
    ends[cells] = ends[cells + 1] = True
    rows = np.flatnonzero(ends)
    asked, points, total = points, points.copy(), np.full(len(points), np.inf)
    grids = [_grid(one, points, rows) for one in sheets]
    counts = np.array([_counted(*pair) for pair in zip(sheets, grids, strict=True)])
    lost = np.isnan(counts).any(axis=0)
    if lost.any():  # on the circle: beside it, there is a side
        points[rows[lost]] += ASIDE * np.append(narrow, -narrow[-1])[rows[lost]]
        others = [_grid(one, points, rows[lost]) for one in sheets]
        counts[:, lost] = [_counted(*pair) for pair in zip(sheets, others, strict=True)]
        grids = [one.with_rows(lost, other) for one, other in zip(grids, others, strict=True)]
    total[rows] = counts.sum(axis=0)
    whole, listed = True, list[tuple[float, float, float, int, int]]()
    for place, pair in enumerate(zip(sheets, grids, strict=True)):
        found, complete = _zeros(*pair, cells, narrow[cells])
        whole &= complete
        listed += [(*zero, place) for zero in found]
    listed.sort()
    roots = []
    for cell in cells.tolist():
        low, high, count = points[cell], points[cell + 1], total[cell]
        for value, angle, slope, times, place in listed:
            if not low <= value < high:
                continue
            after = count + (times if slope > 0 else -times)
            if (count > 0) != (after > 0):
                eigenvalue = complex(np.cos(angle), np.sin(angle))
                roots.append(Root(value, float(low), float(high), slope > 0, place, eigenvalue, slope))
            count = after
        whole &= bool(count == total[cell + 1])
    sure = ~np.isnan(total)
    return Scan(asked[sure], total[sure] == 0, tuple(roots), whole)


def count_beyond(sheet: Sheet, values: Floats) -> Floats:
    """Return how many eigenvalues are beyond the circle at values (k,), NaN where one is on it."""
    return _counted(sheet, _grid(sheet, values, np.arange(len(values))))


def _angles(longest: int) -> Floats:
    """Return angles to begin with, half the circle and a little beyond its ends."""
    apart = min(APART, TURNED / (longest + 1))
    even = np.linspace(0.0, np.pi, int(np.ceil(np.pi / apart)) + 1)[1:-1]
    first = FIRST_ANGLE / (longest + 1)
    small = np.geomspace(first, even[0], max(2, int(np.log(even[0] / first) / np.log(RATIO)) + 1))[:-1]
    found = np.concatenate([small, even])
    return np.concatenate([[-found[0]], found, [2 * np.pi - found[-1]]])


def _on_circle(angles: Floats) -> Complexes:
    return np.asarray(np.exp(1j * angles))


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """F at values (k,) and angles (a,); `rows` (k,) says which of all values these are."""

    values: Floats
    angles: Floats
    found: Logarithm  # (k, a)
    rows: Integers

    def with_rows(self, which: Truths, other: _Grid) -> _Grid:
        """Return the grid with some of its rows (k,) replaced."""
        pairs = [(getattr(self.found, one), getattr(other.found, one)) for one in Logarithm.__slots__]
        wide = which[:, None]
        found = [np.where(wide, new[np.cumsum(which) - 1], old) for old, new in pairs]
        values = np.where(which, other.values[np.cumsum(which) - 1], self.values)
        return _Grid(values, self.angles, Logarithm(*found), self.rows)


def _grid(sheet: Sheet, points: Floats, rows: Integers) -> _Grid:
    """Return F at some of the points and at the angles to begin with."""
    angles, values = _angles(sheet.longest), points[rows]
    return _Grid(values, angles, sheet.over(values, _on_circle(angles)), rows)


def _counted(sheet: Sheet, grid: _Grid) -> Floats:
    """Return how many eigenvalues are beyond the circle at each value (k,), NaN where one is on it."""
    angles, values = grid.angles, grid.values
    value, turning = grid.found.value, grid.found.turning
    row = np.repeat(np.arange(len(values)), len(angles) - 1)
    left, right = np.tile(angles[:-1], len(values)), np.tile(angles[1:], len(values))
    # The arcs about 1 and −1 are halved by them, and mirror themselves.
    share = np.tile(
        np.where(np.isin(np.arange(len(angles) - 1), [0, len(angles) - 2]), 0.5, 1.0), len(values)
    )
    ends = [value[:, :-1].ravel(), turning[:, :-1].ravel(), value[:, 1:].ravel(), turning[:, 1:].ravel()]
    turned, least = np.zeros(len(values)), NARROWEST * (right - left)[0]
    for _ in range(MOST_LEVELS):
        before, before_slope, after, after_slope = ends
        width = right - left
        half = width / 2
        apart = _principal(before + before_slope * half - after + after_slope * half)
        foretold = np.minimum((before + before_slope * half).real, (after - after_slope * half).real)
        dip = np.minimum(before.real, after.real) - foretold
        good = (np.abs(apart) < AGREE) & (dip < DIP)
        good &= np.maximum(np.abs(before_slope.imag), np.abs(after_slope.imag)) * half < TURNS
        steps = ((before_slope + after_slope) * half - apart).imag
        np.add.at(turned, row[good], (share * steps)[good])
        lost = ~good & ~((width > least) & np.isfinite(apart))
        turned[row[lost]] = np.nan
        crowded = np.bincount(row[~good], minlength=len(values)) > MOST_OPEN
        turned[crowded] = np.nan
        cut = ~good & ~np.isnan(turned[row])
        if not cut.any():
            break
        middle = left[cut] + ASIDE * width[cut]
        new = sheet.at(values, row[cut], _on_circle(middle))
        ends = [
            np.concatenate([before[cut], new.value]),
            np.concatenate([before_slope[cut], new.turning]),
            np.concatenate([new.value, after[cut]]),
            np.concatenate([new.turning, after_slope[cut]]),
        ]
        left, right = np.concatenate([left[cut], middle]), np.concatenate([middle, right[cut]])
        row, share = np.tile(row[cut], 2), np.tile(share[cut], 2)
    return np.asarray(np.round(sheet.states - turned / np.pi))


def _beyond_all_along(sheet: LineSheet, points: Floats) -> Truths:
    """Say of each stretch between points whether one eigenvalue is seen to stay beyond the circle."""
    count = len(points)
    starts = 1j * np.geomspace(np.pi / (2 * sheet.longest + 2), np.pi, BEYOND)
    alone = np.sort(np.log(sheet.alone(points)), axis=1)[:, -2:]  # far out, packets say nothing
    place = np.hstack([np.tile(starts, (count, 1)), alone]).ravel()
    tried = len(place) // count
    rows = np.repeat(np.arange(count), tried)
    busy = np.arange(len(rows))
    slope, last = np.full((2, len(rows)), np.nan, np.complex128)
    for _ in range(BEYOND_STEPS):
        now = np.exp(place[busy])
        found = sheet.at(points, rows[busy], now)
        step = -1j / found.turning
        step /= np.maximum(1.0, np.abs(step) / LONGEST)
        place[busy] += step
        slope[busy], last[busy] = -1j * now * found.moving / found.turning, step
        busy = busy[np.abs(step) > ARRIVED]
    good = (np.abs(last) < NEAR) & (place.real > 0) & np.isfinite(slope)
    value = np.where(good, np.exp(place), 0.0).reshape(count, tried)
    slope = np.where(good, slope, 0.0).reshape(count, tried)
    width = np.diff(points)[:, None]
    least, *_ = extremes(value[:-1], slope[:-1] * width, value[1:], slope[1:] * width)
    return np.asarray((least > 1).any(axis=1))


def _zeros(
    sheet: Sheet, grid: _Grid, cells_of: Integers, narrow: Floats
) -> tuple[list[tuple[float, float, float, int]], bool]:
    """Return the zeros on the circle between some points and the next, and whether no cell was left open.

    Each as the value, the angle, how fast the eigenvalue's magnitude grows there with the value, and how many
    eigenvalues cross.
    """
    places = np.searchsorted(grid.rows, cells_of)
    cells, least = _first_cells(grid, places), np.repeat(narrow, len(grid.angles) - 1)
    found: dict[tuple[float, float], tuple[float, float, float, int]] = {}
    whole = True
    for _ in range(MOST_LEVELS):
        still = ~cells.clear()
        cells, least = cells.chosen(still), least[still]
        if not len(least):
            break
        if len(least) > MOST_OPEN:
            return list(found.values()), False
        zeros = _newton(sheet, cells)
        done = np.isfinite(zeros.value) & cells.without(zeros).clear()
        wide, high = EDGE * (cells.right - cells.left), EDGE * (cells.high - cells.low)
        held = done & (zeros.angle >= cells.left - wide) & (zeros.angle <= cells.right + wide)
        held &= (zeros.value >= cells.low - high) & (zeros.value <= cells.high + high)
        for place in np.flatnonzero(held).tolist():
            angle = abs(float(zeros.angle[place]))
            angle = min(angle, 2 * np.pi - angle)
            value = float(zeros.value[place])
            slope = float((zeros.moving[place] / zeros.turning[place]).imag)
            times = 1 if min(angle, np.pi - angle) < SAME else 2
            found[round(angle / SAME), float(f"{value:.8g}")] = (value, angle, slope, times)
        cells, least = cells.chosen(~done), least[~done]
        divided = cells.high - cells.low > least
        divided |= cells.right - cells.left > NARROW_ANGLE / (sheet.longest + 1)
        cells, least = _divided(sheet, cells.chosen(divided), least[divided])
    return list(found.values()), whole


def _first_cells(grid: _Grid, places: Integers) -> _Cells:
    """Return the cells between some of a grid's values and the next."""

    def corners(part: Complexes) -> Complexes:
        rows = [part[places], part[places + 1]]
        listed = [row[:, some] for row in rows for some in (slice(None, -1), slice(1, None))]
        return np.stack(listed, axis=-1).reshape(-1, 4)

    count = len(grid.angles) - 1
    return _Cells(
        np.tile(grid.angles[:-1], len(places)),
        np.tile(grid.angles[1:], len(places)),
        np.repeat(grid.values[places], count),
        np.repeat(grid.values[places + 1], count),
        corners(grid.found.value),
        corners(grid.found.turning),
        corners(grid.found.moving),
    )


def _newton(sheet: Sheet, cells: _Cells) -> _Zeros:
    """Look for a zero of F from the middle of each cell."""
    middle, level = (cells.left + cells.right) / 2, (cells.low + cells.high) / 2
    wide, high = cells.right - cells.left, cells.high - cells.low
    # The corner that is nearest to a zero, by its value, begins.
    corner = np.argmin(cells.value.real, axis=1)
    row = np.arange(len(middle))
    angles, values = cells.corners
    turn, move = _step(cells.turning[row, corner], cells.moving[row, corner])
    angle, value = angles[row, corner] + turn, values[row, corner] + move
    turning, moving = np.full((2, len(angle)), np.nan, np.complex128)
    arrived = np.zeros(len(angle), dtype=bool)
    busy = np.flatnonzero((np.abs(angle - middle) < AWAY * wide) & (np.abs(value - level) < AWAY * high))
    for _ in range(STEPS if len(busy) else 0):
        found = sheet.at(value[busy], np.arange(len(busy)), _on_circle(angle[busy]))
        across, along = found.turning, found.moving
        turn, move = _step(across, along)
        angle[busy] += turn
        value[busy] += move
        unit = np.exp(1j * found.value.imag)
        turning[busy], moving[busy] = across * unit, along * unit
        arrived[busy] = (np.abs(turn) <= SETTLED * wide[busy]) & (np.abs(move) <= SETTLED * high[busy])
        near = (np.abs(angle - middle)[busy] < AWAY * wide[busy]) & (
            np.abs(value - level)[busy] < AWAY * high[busy]
        )
        busy = busy[near & ~arrived[busy]]
        if not len(busy):
            break
    value[~arrived] = np.nan
    return _Zeros(angle, value, turning, moving)


def _step(turning: Complexes, moving: Complexes) -> tuple[Floats, Floats]:
    """Return where F + F_ω dω + F_p dp = 0, both slopes divided by F."""
    area = turning.real * moving.imag - turning.imag * moving.real
    return -moving.imag / area, turning.imag / area


def _divided(sheet: Sheet, cells: _Cells, least: Floats) -> tuple[_Cells, Floats]:
    """Divide each cell in two, across the way along which its corners differ more."""
    if not len(least):
        return cells, least
    wide, high = (cells.right - cells.left)[:, None], (cells.high - cells.low)[:, None]
    a, b = [0, 2], [1, 3]
    across = cells.value[:, a] - cells.value[:, b] + (cells.turning[:, a] + cells.turning[:, b]) * wide / 2
    a, b = [0, 1], [2, 3]
    along = cells.value[:, a] - cells.value[:, b] + (cells.moving[:, a] + cells.moving[:, b]) * high / 2
    turned = np.abs(_principal(across)).max(axis=1) >= np.abs(_principal(along)).max(axis=1)
    turned |= cells.high - cells.low <= least
    angle = cells.left + ASIDE * wide[:, 0]
    apart = cells.low * cells.high > 0
    value = np.where(
        apart, np.sign(cells.high) * np.sqrt(np.abs(cells.low * cells.high)), (cells.low + cells.high) / 2
    )
    # The two new corners, those of the lower or left half's far edge.
    angles = np.where(turned[:, None], angle[:, None], np.stack([cells.left, cells.right], axis=1))
    values = np.where(turned[:, None], np.stack([cells.low, cells.high], axis=1), value[:, None])
    listed, rows = np.unique(values, return_inverse=True)
    found = sheet.at(listed, rows.ravel(), _on_circle(angles.ravel()))
    far = np.where(turned[:, None], [1, 3], [2, 3])  # of the first half
    near = np.where(turned[:, None], [0, 2], [0, 1])  # of the second

    def halves(old: Complexes, new: Complexes) -> Complexes:
        first, second = old.copy(), old.copy()
        np.put_along_axis(first, far, new.reshape(-1, 2), axis=1)
        np.put_along_axis(second, near, new.reshape(-1, 2), axis=1)
        return np.concatenate([first, second])

    return (
        _Cells(
            np.concatenate([cells.left, np.where(turned, angle, cells.left)]),
            np.concatenate([np.where(turned, angle, cells.right), cells.right]),
            np.concatenate([cells.low, np.where(turned, cells.low, value)]),
            np.concatenate([np.where(turned, cells.high, value), cells.high]),
            halves(cells.value, found.value),
            halves(cells.turning, found.turning),
            halves(cells.moving, found.moving),
        ),
        np.tile(least, 2),
    )
