"""Where the largest eigenvalue magnitude of a family of matrices crosses 1 as one number varies.

Takes: a function that gives the matrices and their derivatives at many points of an interval, or of many.
Gives: `Course`, `Courses`, `Root`, `Scan`, `scan`, `scan_lines`; `extremes`, `cubic`, `narrowest`.
Guarantees: every cell between samples is divided until the eigenvalues and their derivatives at both ends
speak against a crossing that the ends don't show, or down to the cell size; every change found is bracketed.
Does not: prove anything (see `bracket`), or choose the interval.

Between two samples an eigenvalue follows the cubic through its values and slopes at both; how far the
tangents of the two ends miss each other half-way, e, stands for what the cubic doesn't know.

Several lines are scanned in step: a call for many small matrices takes hardly longer than one for few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.eigen.eigenpairs import eigenvalues

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Truths = NDArray[np.bool_]
Integers = NDArray[np.int64]

# Each system's matrices (k, n, n) and their derivatives at points (k,); NaN where there is no matrix.
Course = Callable[[Floats], Sequence[tuple[Floats, Floats]]]

# The same of several lines: at points (k,), each of the line whose number stands in the first argument (k,).
Courses = Callable[[Integers, Floats], Sequence[tuple[Floats, Floats]]]

# A sample with an eigenvalue nearer to the circle than this tells no side: far above the rounding of a few
# dozen states.
UNSURE = 1e-11

# A cell is clear when its eigenvalues' cubics keep this much of e away from the circle; the cubic itself is
# off by far less than e wherever the motion is smooth.
CAUTION = 0.5

# Places at which a cubic is looked at.
PLACES = 9

# Cells narrower than this, relative to the value, are divided no further; where the points to begin with are
# nearer to one another, not those narrower than this share of what is between them.
CELL, SHARE = 1e-3, 1 / 16

# So few cells are divided into so many parts at once: a few matrices more take no longer, another call does.
FEW, PARTS = 8, 8

# Cells of a line divided at a time, and levels: what follows the circle would be sampled for ever.
MOST_OPEN, MOST_LEVELS = 64, 40

# A Newton step so small, relatively, is the last: what is left is about its square.
SETTLED = 1e-7

# Stretches of a line of which only the first crossing is wanted: mostly it is in the first or second.
STRETCHES = 3

# Newton's steps at most, each with a bracket to fall back on.
MOST_STEPS = 60


@dataclass(frozen=True, slots=True)
class Root:
    """A value at which the largest magnitude crosses 1.

    `low` and `high` bracket it; `rising` says that it grows there; `system` is the one whose `eigenvalue`
    crosses, and `slope` is d|eigenvalue| over the value.
    """

    value: float
    low: float
    high: float
    rising: bool
    system: int
    eigenvalue: complex
    slope: float


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What was found: `points` (k,), whether it is `stable` (k,) at each, and the `roots` in order.

    `whole` is False where an eigenvalue kept so near to the circle that not every cell could be cleared.
    """

    points: Floats
    stable: Truths
    roots: tuple[Root, ...]
    whole: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Points of lines, both in order, with each system's eigenvalues (k, n) and slopes (k, n)."""

    lines: Integers
    points: Floats
    values: tuple[Complexes, ...]
    slopes: tuple[Complexes, ...]

    def merged(self, other: _Samples) -> tuple[_Samples, Truths]:
        """Return both together, and which are the other's."""
        lines = np.concatenate([self.lines, other.lines])
        points = np.concatenate([self.points, other.points])
        order = np.lexsort((points, lines))
        together = _Samples(
            lines[order],
            points[order],
            tuple(_stacked(*pair)[order] for pair in zip(self.values, other.values, strict=True)),
            tuple(_stacked(*pair)[order] for pair in zip(self.slopes, other.slopes, strict=True)),
        )
        return together, order >= len(self.points)

    def chosen(self, which: Truths | NDArray[np.intp]) -> _Samples:
        """Return some of the samples."""
        return _Samples(
            self.lines[which],
            self.points[which],
            tuple(one[which] for one in self.values),
            tuple(one[which] for one in self.slopes),
        )

    def radius(self) -> Floats:
        sizes = [np.abs(one).max(axis=1) for one in self.values if one.shape[1]]
        return np.asarray(np.max(sizes, axis=0)) if sizes else np.zeros(len(self.points))


def _stacked(one: Complexes, other: Complexes) -> Complexes:
    """Return rows of both, those of fewer states filled up with zeros, which decide nothing.

    A scene that is linearized at its start may have more free motions there at one value than at another.
    """
    wide = max(one.shape[1], other.shape[1])
    if one.shape[1] == other.shape[1]:
        return np.concatenate([one, other])
    return np.concatenate([np.pad(rows, ((0, 0), (0, wide - rows.shape[1]))) for rows in (one, other)])


def scan(course: Course, points: Floats, *, least: float) -> Scan:
    """Find the crossings between the first and the last of some points.

    Parameters
    ----------
    course
        The matrices and their derivatives.
    points
        Where to begin (k,), in order; cells that aren't clear are divided.
    least
        Cells are measured against the value, or against this where the value is smaller.
    """
    return scan_lines(lambda _, some: course(some), [points], [least])[0]


def scan_lines(
    courses: Courses, points: Sequence[Floats], least: Sequence[float], *, first: bool = False
) -> tuple[Scan, ...]:
    """Scan several lines, each as `scan` does.

    Parameters
    ----------
    courses
        The matrices and their derivatives.
    points
        Where to begin on each line (k,), in order.
    least
        For each line, what its cells are measured against at least.
    first
        Whether what lies beyond the first crossing at which the magnitude rises is left alone: then mostly
        it is not looked at.
    """
    count = len(points)
    if not any(len(one) for one in points):
        return tuple(Scan(np.empty(0), np.empty(0, dtype=bool), (), whole=True) for _ in points)
    narrow = [narrowest(*pair) for pair in zip(points, least, strict=True)]
    samples = _with_ends(_begun(courses, points, STRETCHES if first else 1))
    new = np.ones(len(samples.points), dtype=bool)
    whole, going = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
    for _ in range(MOST_LEVELS):
        # A cell that was there before was found clear, or can't be divided.
        cells = np.flatnonzero((samples.lines[1:] == samples.lines[:-1]) & (new[1:] | new[:-1]))
        cells = cells[cells <= _last_cells(samples, count)[samples.lines[cells]]] if first else cells
        cells = cells[_wide(samples, cells, points, narrow)]
        cells = cells[_open(samples, cells)]
        going &= np.bincount(samples.lines[cells], minlength=count) <= MOST_OPEN
        whole &= going
        cells = cells[going[samples.lines[cells]]]
        if not len(cells):
            break
        lines, between = _between(samples, cells, PARTS if len(cells) <= FEW else 2)
        more = _sample(courses, lines, between)
        whole &= np.bincount(more.lines, minlength=count) == np.bincount(lines, minlength=count)
        samples, new = samples.merged(more)
    else:
        whole[lines] = False
    stable = samples.radius() < 1
    changes = np.flatnonzero((stable[1:] != stable[:-1]) & (samples.lines[1:] == samples.lines[:-1]))
    changes = changes[changes <= _last_cells(samples, count)[samples.lines[changes]]] if first else changes
    roots, of_line = _roots(courses, samples, changes), samples.lines[changes]
    return tuple(
        Scan(
            samples.points[samples.lines == line],
            stable[samples.lines == line],
            tuple(root for root, one in zip(roots, of_line, strict=True) if one == line),
            bool(whole[line]),
        )
        for line in range(count)
    )


def _last_cells(samples: _Samples, count: int) -> Integers:
    """Return the first cell of each line in which the magnitude rises across 1, past all if none does."""
    stable = samples.radius() < 1
    rising = stable[:-1] & ~stable[1:] & (samples.lines[1:] == samples.lines[:-1])
    found = np.full(count, len(stable), dtype=np.int64)
    np.minimum.at(found, samples.lines[:-1][rising], np.flatnonzero(rising))
    return found


def _begun(courses: Courses, points: Sequence[Floats], stretches: int) -> _Samples:
    """Return the samples at the points to begin with, those of a line in so many stretches.

    No stretch of a line is looked at after one in which the magnitude rises across 1.
    """
    going, found = np.arange(len(points)), None
    for stretch in range(stretches):
        ends = [len(one) * np.array([stretch, stretch + 1]) // stretches for one in points]
        some = [points[line][slice(*ends[line])] for line in going.tolist()]
        lines = np.repeat(going, [len(one) for one in some])
        if not len(lines):
            continue
        more = _sampled(courses, lines, np.concatenate(some))
        found = more if found is None else found.merged(more)[0]
        radius = found.radius()
        going = np.array([line for line in going if not _rises(radius[found.lines == line])], dtype=np.int64)
    assert found is not None
    return found


def _rises(radius: Floats) -> bool:
    """Say whether magnitudes in order are clearly below 1, and clearly above it later."""
    below = np.flatnonzero(radius < 1 - UNSURE)
    return bool(len(below)) and bool((radius[below[0] :] > 1 + UNSURE).any())


def _sample(courses: Courses, lines: Integers, points: Floats) -> _Samples:
    """Return the samples at points that have matrices and a side."""
    samples = _sampled(courses, lines, points)
    return samples.chosen(_sure(samples))


def _sampled(courses: Courses, lines: Integers, points: Floats) -> _Samples:
    """Return the samples at points that have matrices."""
    pairs = courses(lines, points)
    sound = np.ones(len(points), dtype=bool)
    for matrix, slope in pairs:
        sound &= np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(slope).all(axis=(1, 2))
    found = [eigenvalues(matrix[sound], slope[sound]) for matrix, slope in pairs]
    values, slopes = tuple(v for v, _ in found), tuple(d for _, d in found)
    return _Samples(lines[sound], points[sound], values, slopes)


def _sure(samples: _Samples) -> Truths:
    """Say which samples tell a side: not what lies on the circle, unless something is clearly outside."""
    return np.abs(samples.radius() - 1) > UNSURE


def _with_ends(samples: _Samples) -> _Samples:
    """Return the samples that tell a side, the first and last of each line if on the circle, too."""
    sure, lines = _sure(samples), samples.lines
    first, last = np.diff(lines, prepend=-1) > 0, np.diff(lines, append=len(lines)) > 0
    # Beside an end that only rounding moves off the circle, the next sample tells no side either.
    way = np.where(first & np.append(sure[1:], False), 1, np.where(last & np.append(False, sure[:-1]), -1, 0))
    return _off_circle(samples, np.where(sure, 0, way), sure)


def _off_circle(samples: _Samples, way: Integers, sure: Truths) -> _Samples:
    """Return the sure samples, and ends of lines on the circle as they are just inside the line.

    As where a stiffness vanishes, and sets free what it holds: an eigenvalue leaves the circle as it grows.

    Parameters
    ----------
    samples
        All samples.
    way
        1 at the first sample of a line, −1 at the last, where these lie on the circle; 0 elsewhere.
    sure
        Which samples lie clearly inside or outside.
    """
    moved, kept = [], sure | (way != 0)
    for values, slopes in zip(samples.values, samples.slopes, strict=True):
        on = (np.abs(np.abs(values) - 1) <= UNSURE) & (way != 0)[:, None]
        leaving = np.sign((values.conj() * slopes).real) * way[:, None]
        kept = kept & ~(on & (leaving == 0)).any(axis=1)
        moved.append(np.where(on, values * (1 + 2 * UNSURE * leaving), values))
    return replace(samples, values=tuple(moved)).chosen(kept)


def narrowest(points: Floats, least: float) -> Floats:
    """Return, for each cell between the points to begin with, how narrow its parts may get."""
    size = np.maximum(np.maximum(np.abs(points[:-1]), np.abs(points[1:])), least)
    return np.asarray(np.minimum(CELL * size, SHARE * np.diff(points)))


def _wide(
    samples: _Samples, cells: NDArray[np.intp], points: Sequence[Floats], narrow: Sequence[Floats]
) -> Truths:
    """Say of each cell whether it may be divided."""
    low, high = samples.points[cells], samples.points[cells + 1]
    lines = samples.lines[cells]
    found = np.zeros(len(cells), dtype=bool)
    for line in set(lines.tolist()):
        own = lines == line
        first = np.searchsorted(points[line], low[own], side="right") - 1
        found[own] = high[own] - low[own] > narrow[line][np.clip(first, 0, len(narrow[line]) - 1)]
    return found


def _between(samples: _Samples, cells: NDArray[np.intp], parts: int) -> tuple[Integers, Floats]:
    """Return the points that divide cells into parts, and their lines: in even ratios on one side of 0."""
    low, high = samples.points[cells, None], samples.points[cells + 1, None]
    share = np.arange(1, parts) / parts
    apart = low * high > 0
    ratios = np.sign(high) * np.abs(low) ** (1 - share) * np.abs(high) ** share
    between = np.where(apart, ratios, low + (high - low) * share)
    return np.repeat(samples.lines[cells], parts - 1), between.reshape(-1)


def _open(samples: _Samples, cells: NDArray[np.intp]) -> Truths:
    """Say of each cell whether it may hide a crossing beside the one that its ends show, if they do."""
    low, high = samples.chosen(cells), samples.chosen(cells + 1)
    width = (high.points - low.points)[:, None]
    inside = np.ones(len(width), dtype=bool)
    outside = np.zeros(len(width), dtype=bool)
    crossing = np.zeros(len(width), dtype=np.int64)
    for start, rise, end, end_rise in zip(low.values, low.slopes, high.values, high.slopes, strict=True):
        if not start.shape[1]:
            continue
        # Every cell both ways at once: forward, and as it looks from its end.
        least, most, single, upper = extremes(
            np.concatenate([start, end]),
            np.concatenate([rise * width, -end_rise * width]),
            np.concatenate([end, start]),
            np.concatenate([end_rise * width, -rise * width]),
        )
        inside &= (most < 1).reshape(2, *start.shape).all(axis=(0, 2))
        least, most = least[: len(width)], most[: len(width)]
        single, upper = single[: len(width)], upper[: len(width)]
        outside |= (least > 1).any(axis=1)
        crossing += ((most >= 1) & ~(single & upper)).sum(axis=1) * 2
        crossing += ((most >= 1) & single & upper).sum(axis=1)
        lower = (most >= 1) & single & ~upper
        crossing -= 2 * lower.sum(axis=1)  # the conjugate of one that is counted
    simple = ((low.radius() < 1) != (high.radius() < 1)) & (crossing == 1)
    hiding: Truths = ~(inside | outside | simple)
    return hiding


def extremes(
    value: Complexes, rise: Complexes, end: Complexes, end_rise: Complexes
) -> tuple[Floats, Floats, Truths, Truths]:
    """Follow each eigenvalue across a cell to its partner at the end.

    Returns
    -------
    The least and largest magnitude it may have on the way; whether it goes from one side of the circle to
    the other once, its magnitude rising or falling all the way; whether it is in the upper half plane.
    """
    miss = np.abs((value + rise / 2)[:, :, None] - (end - end_rise / 2)[:, None, :])
    partner = np.argmin(miss, axis=2)
    off = CAUTION * np.take_along_axis(miss, partner[:, :, None], axis=2)[:, :, 0]
    end, end_rise = (np.take_along_axis(one, partner, axis=1) for one in (end, end_rise))
    t = np.linspace(0.0, 1.0, PLACES)[:, None, None]
    sizes = np.abs(cubic(t, value, rise, end, end_rise))
    # Between two places the magnitude bends by an eighth of its second difference.
    off = off + np.abs(np.diff(sizes, 2, axis=0)).max(axis=0) / 8
    first, last = sizes[0], sizes[-1]
    growth, end_growth = (value.conj() * rise).real, (end.conj() * end_rise).real
    steady = (growth * end_growth > 0) & (growth * (last - first) > 0)
    single = ((first < 1) != (last < 1)) & steady & (off < np.abs(last - first))
    return sizes.min(axis=0) - off, sizes.max(axis=0) + off, single, value.imag >= 0


def _roots(courses: Courses, samples: _Samples, cells: NDArray[np.intp]) -> tuple[Root, ...]:
    """Find the crossing of each cell whose ends lie on different sides: Newton's method with a bracket."""
    if not len(cells):
        return ()
    low, high = samples.points[cells].copy(), samples.points[cells + 1].copy()
    rising = samples.radius()[cells] < 1
    value = _starts(samples, cells)
    system, eigenvalue = np.zeros(len(cells), np.intp), np.zeros(len(cells), np.complex128)
    slope, lines = np.zeros(len(cells)), samples.lines[cells]
    busy = np.arange(len(cells))
    for _ in range(MOST_STEPS):
        here = value[busy]
        lead = _leading(courses, lines[busy], here)
        system[busy], eigenvalue[busy], slope[busy] = lead
        size = np.abs(eigenvalue[busy])
        below = (size < 1) == rising[busy]  # the root is above
        low[busy], high[busy] = np.where(below, here, low[busy]), np.where(below, high[busy], here)
        with np.errstate(all="ignore"):
            after = here - (size - 1) / slope[busy]
        wild = ~((after > low[busy]) & (after < high[busy]))
        # The last step may leave the bracket, one end of which is where it started, by a rounding.
        done = (np.abs(after - here) <= SETTLED * np.abs(here)) | (size == 1)
        after = np.where(wild & ~done, (low[busy] + high[busy]) / 2, after)
        done |= high[busy] - low[busy] <= 4 * np.spacing(np.abs(here))
        value[busy] = after
        busy = busy[~done]
        if not len(busy):
            break
    return tuple(
        Root(float(p), float(lo), float(hi), bool(up), int(which), complex(one), float(rate))
        for p, lo, hi, up, which, one, rate in zip(
            value, low, high, rising, system, eigenvalue, slope, strict=True
        )
    )


def _starts(samples: _Samples, cells: NDArray[np.intp]) -> Floats:
    """Return where in each cell the cubic of the eigenvalue that crosses meets the circle."""
    low, high = samples.points[cells], samples.points[cells + 1]
    rising = samples.radius()[cells] < 1
    values = np.concatenate(samples.values, axis=1)
    slopes = np.concatenate(samples.slopes, axis=1)
    # From the unstable end to its partner on the stable one; t runs from there.
    line, width = np.arange(len(cells)), np.where(rising, low - high, high - low)
    start, end = np.where(rising, cells + 1, cells), np.where(rising, cells, cells + 1)
    best = np.argmax(np.abs(values[start]), axis=1)
    value, rise = values[start, best], slopes[start, best] * width
    miss = np.abs((value + rise / 2)[:, None] - (values[end] - slopes[end] * width[:, None] / 2))
    partner = np.argmin(miss, axis=1)
    last, fall = values[end, partner], slopes[end, partner] * width
    t = np.linspace(0.0, 1.0, 8 * PLACES)[:, None]
    sizes = np.abs(cubic(t, value, rise, last, fall))
    inside = np.maximum(np.argmax(sizes < 1, axis=0), 1)
    before, after = sizes[inside - 1, line], sizes[inside, line]
    with np.errstate(all="ignore"):
        share = np.clip((before - 1) / (before - after), 0.0, 1.0)
    place = np.clip(np.where(np.isfinite(share), (inside - 1 + share) / (len(t) - 1), 0.5), 0.01, 0.99)
    found: Floats = np.where(rising, high, low) + place * width
    return found


def cubic(t: Floats, value: Complexes, rise: Complexes, end: Complexes, end_rise: Complexes) -> Complexes:
    """Return the cubic through two values and slopes.

    Parameters
    ----------
    t
        Where: a share of the way.
    value, rise
        Where it begins, and its slope there times the whole way.
    end, end_rise
        The same of its end.
    """
    found: Complexes = (1 + 2 * t) * (1 - t) ** 2 * value + t * (1 - t) ** 2 * rise
    return found + t * t * (3 - 2 * t) * end + t * t * (t - 1) * end_rise


def _leading(courses: Courses, lines: Integers, points: Floats) -> tuple[NDArray[np.intp], Complexes, Floats]:
    """Return the eigenvalue of largest magnitude at each point: its system, itself, its magnitude's slope."""
    found = [eigenvalues(matrix, slope) for matrix, slope in courses(lines, points)]
    system = np.repeat(np.arange(len(found)), [values.shape[1] for values, _ in found])
    values = np.concatenate([values for values, _ in found], axis=1)
    slopes = np.concatenate([slopes for _, slopes in found], axis=1)
    # Of a conjugate pair, the one above the real axis.
    best = np.argmax(np.abs(values) * (1 + 1e-13 * (values.imag > 0)), axis=1)
    line = np.arange(len(points))
    one = values[line, best]
    return system[best], one, (one.conj() * slopes[line, best]).real / np.abs(one)
