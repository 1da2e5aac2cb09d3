"""How large the largest eigenvalue is, from a characteristic function: found by Newton, proved by counting.

Takes: a `Characteristic`, and where its zeros may be.
Gives: `Zeros`, `find_zeros`, `near_poles`; `beyond`, `bracket`.
Guarantees: `low` and `high` bound the spectral radius, rigid modes left out: within a small circle about the
largest zero there is one, and beyond a circle just outside of it there is none, both counted by the argument
principle. Where a count can't be had, the bounds are wide instead.
Does not: find every zero.

f has all eigenvalues as zeros and the sites' own as poles, but where both are the same: as often as f goes
around 0 along a circle, so many more zeros than poles are in it. A pole of a site may be an eigenvalue of the
whole, as when nobody hears the site: then f has a pole of lesser order there, or none, and Newton's method
finds nothing. A count around the pole tells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from apc.eigen.winding import FIRST_ARCS, wind
from apc.large.characteristic import (
    FARTHEST,
    Characteristic,
    characteristic_ball,
    refine,
)

Complexes = NDArray[np.complex128]
Floats = NDArray[np.float64]

# The smallest circle about a zero that is tried, relative to it, and what the next ones are larger by.
FIRST_RADIUS, WIDER = 4e-15, 8.0

# A circle about a zero that has to be wider than this shows nothing.
WIDEST = 1e-3

# The circle just outside of the largest zero is so many times farther from it than its error; if a pole or
# another zero is in the way, wider ones are tried, so many.
OUTSIDE, TRIES = 8.0, 10

# A circle about a zero is so many times larger than what the zero is known to: then few arcs do.
CLEAR = 6.0

# How far aside of a zero, relatively, its slope is looked at, and how much nearer the next time.
ASIDE, NEARER = 1e-7, 30.0

# The least circle that is counted, for the discs along it to lie where f can be evaluated.
INMOST = 1.1

# Arcs about a zero to begin with, and evaluations after which the circle is too small to tell.
SMALL_ARCS, SMALL_POINTS = 12, 300

# Circles between which the largest eigenvalue must be are drawn together until they are this close,
# relatively, at the cost of no more counts than these; the first circle that is tried is so far aside.
BRACKETED, MOST_COUNTS, BESIDE = 1e-3, 40, 1e-6

# Points from which a circle about a zero is looked for, and circles tried from each.
LOOKS = 4


def held_around(function: Characteristic, point: complex) -> tuple[float, int]:
    """Return the radius of a circle about a point that has eigenvalues in it, and how many; or inf and 0.

    Nearby a zero, at ζ + h, |f| ≈ |f′| h is known to a share c of it: the zero is known to about c h.
    """
    aside = ASIDE * abs(point)
    for _ in range(LOOKS):
        radius = _least_radius(function, point, aside)
        for _ in range(LOOKS):
            if not radius < WIDEST * abs(point):
                break
            if (held := _held_in(function, point, radius)) > 0:
                return radius, held
            radius *= WIDER
        aside /= NEARER  # a pole or another zero may be that close
    return float(np.inf), 0


def _least_radius(function: Characteristic, point: complex, aside: float) -> float:
    """Return the radius of the least circle about a zero worth counting, by how f is known aside of it."""
    ball = characteristic_ball(function, np.array([point + aside]), np.zeros(1))
    return max(CLEAR * float(ball.change[0]) * aside, FIRST_RADIUS * abs(point))


def _held_in(function: Characteristic, point: complex, radius: float) -> int:
    """Return how many eigenvalues are within a circle, −1 if that can't be told: poles as f has them."""
    inside = wind(partial(characteristic_ball, function), point, radius, arcs=SMALL_ARCS, most=SMALL_POINTS)
    poles = _poles_in(function, point, radius, 1)
    return -1 if inside is None or poles is None else inside + poles


def _poles_in(function: Characteristic, point: complex, radius: float, each: Floats | int) -> int | None:
    """Return how many poles are within a circle, each so often; None: no telling."""
    poles = function.transfer.poles
    distance = np.abs(poles.values - point)
    if np.any(np.abs(distance - radius) <= poles.errors):
        return None
    return int(((distance < radius) * each).sum())


def beyond(function: Characteristic, radius: float, rigid: int) -> int | None:
    """Return how many eigenvalues lie beyond a circle about zero, the rigid ones left out, or None.

    Parameters
    ----------
    function
        f.
    radius
        The circle's.
    rigid
        How many eigenvalues are 1.
    """
    counts = function.transfer.poles.counts
    arcs = max(FIRST_ARCS, 2 * function.longest)  # f turns as often as its longest delay has frames
    poles = _poles_in(function, 0.0, radius, counts)
    turns = None if poles is None else wind(partial(characteristic_ball, function), 0.0, radius, arcs=arcs)
    if poles is None or turns is None:
        return None
    return int(counts.sum()) - poles - turns - (rigid if radius < 1 else 0)


def count_from(
    function: Characteristic, radius: float, step: float, rigid: int, rigid_radius: float
) -> tuple[float, int]:
    """Return the first circle outwards that can be counted, and how many eigenvalues are beyond, or −1.

    Parameters
    ----------
    function
        f.
    radius, step
        Where to begin, and by how much more to step out, then ever more.
    rigid, rigid_radius
        How many eigenvalues are 1, and the circle about 1 that has no others.
    """
    for _ in range(TRIES):
        near = max(radius + step, function.innermost * INMOST)
        if rigid and abs(near - 1) <= rigid_radius:
            near = 1 + 2 * rigid_radius
        number = beyond(function, near, rigid)
        if number is not None and number >= 0:
            return near, number
        step *= WIDER
    return radius + step, -1


def bracket(
    function: Characteristic, low: float, high: float, rigid: int, rigid_radius: float
) -> tuple[float, float]:
    """Return radii beyond the first of which there is an eigenvalue, and beyond the second none.

    Parameters
    ----------
    function
        f.
    low
        A radius that the largest eigenvalue is known to have at least.
    high
        Where to begin.
    rigid, rigid_radius
        How many eigenvalues are 1, and the circle about 1 that has no others.
    """
    inmost = function.innermost * INMOST
    outer, radius, step = float(np.inf), max(high, low, inmost), 1e-6
    for _ in range(MOST_COUNTS):
        near, number = count_from(function, radius, BESIDE * radius, rigid, rigid_radius)
        if number >= 0 and near < outer:
            low, outer = (low, near) if number == 0 else (max(low, near), outer)
        elif np.isfinite(outer):
            break  # what can't be counted here is left between the two
        if outer <= max(low, inmost) * (1 + BRACKETED):
            break
        if np.isfinite(outer):
            radius = max(float(np.sqrt(max(low, outer / 2) * outer)), inmost)
        else:
            radius, step = radius * (1 + step), step * WIDER
    return low, outer


# Zeros nearer to one another than this, relatively, are one that was found twice.
SAME = 1e-11

# Poles that are eigenvalues themselves, looked at of all.
MOST_HELD = 64

# Poles taken out of f where zeros are looked for: those that population about the zeros.
TAKEN_OUT = 128

# Points on a ring, and poles, to look for missed zeros from.
RING = 48

# How often zeros that a count has missed are looked for.
SEARCHES = 4


@dataclass(frozen=True, slots=True)
class Zero:
    """An eigenvalue (or a pair, with its conjugate) and what it may be off by; held `multiplicity` times.

    `site`, if it is that of sites by themselves, says which: (transfer, place in it).
    """

    value: complex
    error: float
    multiplicity: int
    site: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Zeros:
    """Bounds on the spectral radius, and the largest eigenvalues found, the largest first.

    `radius` is the best estimate, of an eigenvalue that may be too close to others to be listed. `counted`
    says that a count proves that nothing lies beyond `high`; `rigid_counted`, that one proves that there are
    as many eigenvalues at 1 as was said.
    """

    low: float
    high: float
    radius: float
    found: tuple[Zero, ...]
    counted: bool
    rigid_counted: bool


def find_zeros(
    function: Characteristic,
    starts: Complexes,
    *,
    rigid: int,
    listed: int,
    near: int,
) -> Zeros:
    """Find the largest eigenvalues and prove that there is none beyond.

    Parameters
    ----------
    function
        f.
    starts
        Where zeros may be (z,).
    rigid
        How many eigenvalues are exactly 1 for a known reason.
    listed
        How many of the largest eigenvalues to report.
    near
        How many of the largest poles zeros are looked for close to.
    """
    if not function.transfer.poles.errors.max(initial=0.0) < FARTHEST:
        return Zeros(0.0, float(np.inf), 0.0, (), False, not rigid)
    least = _least_radius(function, 1.0, ASIDE)
    rigid_radius = _rigid_radius(function, rigid, [least * WIDER**more for more in range(16)], 0.0)
    exact = [zero for zero in _held_poles(function) if abs(zero.value - 1) > rigid_radius]
    poles = near_poles(function, TAKEN_OUT)
    close = near_poles(function, near) * (1 + 1e-7)
    zeros = _distinct(refine(function, np.concatenate([starts, close]), poles=poles), rigid_radius)
    # Where several are one, Newton's method arrives at the root of its rounding only.
    wider = sorted((2 * np.abs(zeros - 1)[np.abs(zeros - 1) < WIDEST]).tolist(), reverse=True)
    rigid_radius = _rigid_radius(function, rigid, wider, rigid_radius)
    zeros = _distinct(zeros, rigid_radius)
    error_of = cache(lambda zero: held_around(function, zero)[0])
    low, high, beyond = 0.0, 0.0, -1
    for search in range(SEARCHES):
        largest, error = _largest(zeros, exact, error_of)
        width = max(OUTSIDE * error, 4 * FIRST_RADIUS) if np.isfinite(error) else WIDEST
        high, beyond = count_from(function, largest, width, rigid, rigid_radius)
        if not beyond:
            break
        if beyond < 0 or search:  # from where it must be, if nothing was found from around what is known
            low, high = bracket(function, low, high, rigid, rigid_radius)
            if not low > largest:
                break
        cancelled = _cancelled_poles(function, largest, zeros, exact, rigid_radius)
        exact += cancelled
        if cancelled:
            continue
        more = _search(function, high, zeros, poles, rigid_radius)
        zeros = _distinct(np.concatenate([zeros, more]), rigid_radius)
    result = [Zero(zero, error_of(zero), 1) for zero in zeros[:listed].tolist()]
    known = [zero for zero in (*result, *exact) if np.isfinite(zero.error)]
    every = sorted(known, key=lambda zero: -abs(zero.value))[:listed]
    low = max([low, *(abs(zero.value) - zero.error for zero in every)])
    if beyond or not high - low <= WIDEST * high:
        low, outer = bracket(function, low, high, rigid, rigid_radius)
        high = outer if beyond else min(high, outer)
    radius, _ = _largest(zeros, exact, lambda zero: 0.0)
    if not low <= radius <= high:
        radius = (low + high) / 2 if np.isfinite(high) else low
    return Zeros(low, high, radius, tuple(every), not beyond, rigid_radius < WIDEST)


def _largest(
    zeros: Complexes, exact: Sequence[Zero], error_of: Callable[[complex], float]
) -> tuple[float, float]:
    """Return the magnitude of the largest eigenvalue so far, and its error."""
    largest = max(exact, key=lambda zero: abs(zero.value), default=None)
    if len(zeros) and (largest is None or abs(zeros[0]) >= abs(largest.value)):
        return float(abs(zeros[0])), error_of(complex(zeros[0]))
    return (abs(largest.value), largest.error) if largest else (0.0, 0.0)


def _rigid_radius(function: Characteristic, rigid: int, radii: Sequence[float], value: float) -> float:
    """Return the first of some circles about 1 in which all eigenvalues are the rigid ones.

    Without one, that which is known; 0 where nothing is rigid, and `WIDEST` where none is shown.
    """
    if not rigid:
        return 0.0
    widths = (radius for radius in radii if radius < 2 * WIDEST and _held_in(function, 1.0, radius) == rigid)
    return next(widths, value or WIDEST)


def _held_poles(function: Characteristic) -> list[Zero]:
    """Return the poles that are eigenvalues themselves: of sites that are alike, or that nobody hears.

    Of all the largest few.
    """
    poles = function.transfer.poles
    times = np.where(poles.heard, poles.counts - 1, poles.counts)
    held = np.flatnonzero((times > 0) & (poles.values.imag >= 0))[:MOST_HELD]
    return [_own(function, place, float(poles.errors[place]), int(times[place])) for place in held.tolist()]


def _own(function: Characteristic, place: int, error: float, times: int) -> Zero:
    """Return a pole as an eigenvalue."""
    poles = function.transfer.poles
    which, site = poles.sites[place].tolist()
    return Zero(complex(poles.values[place]), error, times, (which, site))


def _cancelled_poles(
    function: Characteristic, beyond: float, zeros: Complexes, known: Sequence[Zero], rigid_radius: float
) -> list[Zero]:
    """Return the poles beyond a circle that are eigenvalues all the same, as a count around each tells.

    Of all the largest few.
    """
    result: list[Zero] = []
    taken = [*zeros.tolist(), *(zero.value for zero in known)]
    poles = function.transfer.poles
    outside = (np.abs(poles.values) >= beyond * (1 - SAME)) & (poles.values.imag >= 0)
    outside &= np.abs(poles.values - 1) > rigid_radius
    for place in np.flatnonzero(outside)[:MOST_HELD].tolist():
        pole = complex(poles.values[place])
        if any(abs(pole - other) <= SAME * abs(pole) for other in taken):
            continue
        taken.append(pole)
        error, many = held_around(function, pole)
        if np.isfinite(error) and not any(abs(pole - zero) <= 2 * error for zero in zeros.tolist()):
            result.append(_own(function, place, error, many))
    return result


def _distinct(zeros: Complexes, rigid_radius: float) -> Complexes:
    """Return zeros in the upper half plane, the largest first, each once and the rigid ones left out."""
    zeros = zeros[np.isfinite(zeros)]
    zeros = np.where(zeros.imag < 0, zeros.conj(), zeros)
    zeros = np.where(np.abs(zeros.imag) <= SAME * np.abs(zeros), zeros.real, zeros)
    zeros = zeros[np.abs(zeros - 1) > rigid_radius] if rigid_radius else zeros
    zeros = zeros[np.argsort(-np.abs(zeros), kind="stable")]
    values: list[complex] = []
    for zero in zeros.tolist():
        near = (value for value in reversed(values[-16:]) if abs(value - zero) <= SAME * abs(zero))
        if next(near, None) is None:
            values.append(zero)
    return np.array(values, dtype=np.complex128)


def _search(
    function: Characteristic, radius: float, zeros: Complexes, poles: Complexes, rigid_radius: float
) -> Complexes:
    """Return zeros that were missed, from all over a wider ring and from the largest poles."""
    angles = np.linspace(0.0, np.pi, RING)
    rings = [scale * radius * np.exp(1j * angles) for scale in (1.0, 1.03, 1.3)]
    starts = np.concatenate([*rings, near_poles(function, RING) * (1 + 1e-3)])
    known = np.append(zeros, 1.0) if rigid_radius else zeros
    values = refine(function, starts, poles=poles, zeros=known)
    return _distinct(refine(function, values, poles=poles), rigid_radius)


def near_poles(function: Characteristic, most: int) -> Complexes:
    """Return the largest poles of f in the upper half plane (z,), no more than `most`."""
    poles = function.transfer.poles
    return poles.values[poles.heard & (poles.values.imag >= 0)][:most]
