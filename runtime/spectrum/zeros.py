"""The spectral radius from a characteristic function: zeros by Newton's method, proved by counting.

Takes: a `Characteristic`, and start values of its zeros.
Gives: `Zeros`, `find_zeros`, `largest_zero`, `near_poles`; `count_outside`, `bracket`; `Zero`.
Guarantees: `low` and `high` bound the spectral radius, rigid modes excluded. The argument principle proves
one zero within a small circle about the largest zero, and none beyond a circle just outside it. Without a
count the bounds are wider.
Does not: find every zero.

f has the eigenvalues of the coupled system as zeros and those of the sites as poles, except for
cancellations. The winding number of f around 0 along a circle is the number of zeros minus poles within. A
pole of a site may be an eigenvalue of the coupled system, for example if the site has no receivers. Then f
has a pole of lower order there, or none, and Newton's method does not find it; a count around the pole does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from apc.spectrum.characteristic import (
    FARTHEST,
    Characteristic,
    characteristic_ball,
    refine,
)
from apc.spectrum.winding_number import FIRST_ARCS, winding_number

Complexes = NDArray[np.complex128]
Floats = NDArray[np.float64]

# The radius of the smallest circle about a zero, relative to its magnitude, and the factor of the next ones.
FIRST_RADIUS, WIDER = 4e-15, 8.0

# The largest relative radius of a circle about a zero: a wider one proves nothing.
WIDEST = 1e-3

# The circle just outside the largest zero has this multiple of its error as distance. If a pole or another
# zero interferes, wider circles are tried, up to this number.
OUTSIDE, TRIES = 8.0, 10

# A circle between the largest zero and the next is counted if their distance is this multiple of the error.
SEPARATION = 100.0

# The ratio of the radius of a circle about a zero to the zero's error: then few arcs suffice.
CLEAR = 6.0

# The relative offset from a zero at which the slope is evaluated, and its reduction factor.
ASIDE, NEARER = 1e-7, 30.0

# The ratio of the least counted circle to the least |ζ| of f, so that f can be evaluated in discs along it.
INMOST = 1.1

# Initial number of arcs about a zero, and the number of evaluations after which the circle is given up.
SMALL_ARCS, SMALL_POINTS = 12, 300

# The relative distance of the two circles that enclose the largest magnitude, the limit of counts to find
# them, and the relative offset of the first circle.
BRACKETED, MOST_COUNTS, ALONGSIDE = 1e-3, 40, 1e-6

# The distance from the unit circle of the first circle that is counted to find its side.
FIRST_OUTSIDE = 1e-9

# Points from which a circle about a zero is searched, and circles tried from each.
MOST_EVALUATIONS = 4


def enclosing_radius(function: Characteristic, point: complex) -> tuple[float, int]:
    """Return the radius of a circle about a point with eigenvalues in it, and their number; or inf and 0.

    Near a zero, at ζ + h, |f| ≈ |f′| h has a relative error c, and the error of the zero is about c h.
    """
    offset = ASIDE * abs(point)
    for _ in range(MOST_EVALUATIONS):
        radius = _least_radius(function, point, offset)
        for _ in range(MOST_EVALUATIONS):
            if not radius < WIDEST * abs(point):
                break
            if (count := _count_inside(function, point, radius)) > 0:
                return radius, count
            radius *= WIDER
        offset /= NEARER  # a pole or another zero may be that close
    return float(np.inf), 0


def _least_radius(function: Characteristic, point: complex, offset: float) -> float:
    """Return the radius of the smallest circle about a zero to count, from the relative error of f next to
    the zero.
    """
    ball = characteristic_ball(function, np.array([point + offset]), np.zeros(1))
    return max(CLEAR * float(ball.change[0]) * offset, FIRST_RADIUS * abs(point))


def _count_inside(function: Characteristic, point: complex, radius: float) -> int:
    """Return the number of eigenvalues within a circle, −1 if undetermined: the winding number of f plus the
    number of poles.
    """
    inside = winding_number(
        partial(characteristic_ball, function), point, radius, arcs=SMALL_ARCS, most=SMALL_POINTS
    )
    poles = _poles_in(function, point, radius, 1)
    return -1 if inside is None or poles is None else inside + poles


def _poles_in(
    function: Characteristic, point: complex, radius: float, multiplicity: Floats | int
) -> int | None:
    """Return the number of poles within a circle; None if a pole is too near to the circle to decide."""
    poles = function.transfer.poles
    distance = np.abs(poles.values - point)
    if np.any(np.abs(distance - radius) <= poles.errors):
        return None
    return int(((distance < radius) * multiplicity).sum())


def count_outside(function: Characteristic, radius: float, rigid: int) -> int | None:
    """Return the number of eigenvalues outside a circle about zero, without rigid ones; None if undetermined.

    Parameters
    ----------
    function
        f.
    radius
        The radius of the circle.
    rigid
        The number of eigenvalues at 1.
    """
    counts = function.transfer.poles.counts
    arcs = max(FIRST_ARCS, 2 * function.longest)  # f turns as often as its longest delay has frames
    poles = _poles_in(function, 0.0, radius, counts)
    winding = (
        None
        if poles is None
        else winding_number(partial(characteristic_ball, function), 0.0, radius, arcs=arcs)
    )
    if poles is None or winding is None:
        return None
    return int(counts.sum()) - poles - winding - (rigid if radius < 1 else 0)


def first_counted_circle(
    function: Characteristic, radius: float, step: float, rigid: int, rigid_radius: float
) -> tuple[float, int]:
    """Return the radius of the first circle outwards that can be counted, and the number of eigenvalues
    outside, or −1.

    Parameters
    ----------
    function
        f.
    radius, step
        The first radius, and the first step outwards, which increases.
    rigid, rigid_radius
        The number of eigenvalues at 1, and a circle about 1 without others.
    """
    for _ in range(TRIES):
        next_radius = max(radius + step, function.innermost * INMOST)
        if rigid and abs(next_radius - 1) <= rigid_radius:
            next_radius = 1 + 2 * rigid_radius
        count = count_outside(function, next_radius, rigid)
        if count is not None and count >= 0:
            return next_radius, count
        step *= WIDER
    return radius + step, -1


def bracket(
    function: Characteristic, low: float, high: float, rigid: int, rigid_radius: float
) -> tuple[float, float]:
    """Return two radii: an eigenvalue lies outside the first circle, and no eigenvalue outside the second.

    Parameters
    ----------
    function
        f.
    low
        A known lower bound of the largest magnitude.
    high
        The start value.
    rigid, rigid_radius
        The number of eigenvalues at 1, and a circle about 1 without others.
    """
    inmost = function.innermost * INMOST
    upper, radius, step = float(np.inf), max(high, low, inmost), 1e-6
    for _ in range(MOST_COUNTS):
        counted_radius, count = first_counted_circle(
            function, radius, ALONGSIDE * radius, rigid, rigid_radius
        )
        if count >= 0 and counted_radius < upper:
            low, upper = (low, counted_radius) if count == 0 else (max(low, counted_radius), upper)
        elif np.isfinite(upper):
            break  # a circle that cannot be counted stays between the two
        if upper <= max(low, inmost) * (1 + BRACKETED):
            break
        if np.isfinite(upper):
            radius = max(float(np.sqrt(max(low, upper / 2) * upper)), inmost)
        else:
            radius, step = radius * (1 + step), step * WIDER
    return low, upper


# The relative distance below which two zeros are equal.
SAME = 1e-11

# The largest number of poles tested as eigenvalues.
MOST_ENCLOSED = 64

# Poles divided out of f in the search for zeros: those that cluster about the zeros.
TAKEN_OUT = 128

# The number of points on a ring, and of poles, as start values of missed zeros.
RING = 48

# Number of searches for zeros that a count shows to be missing.
SEARCHES = 4


@dataclass(frozen=True, slots=True)
class Zero:
    """An eigenvalue (or a conjugate pair) with its error bound and its `multiplicity`.

    `subsystem` is (transfer, index in it) for an eigenvalue of a single subsystem.
    """

    value: complex
    error: float
    multiplicity: int
    subsystem: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Zeros:
    """Bounds on the spectral radius, and the largest eigenvalues, the largest first.

    `radius` is the best estimate; its eigenvalue may be too close to others to be listed. `counted` states
    whether a count proves that no eigenvalue lies beyond `high`; `rigid_counted` whether a count proves the
    stated number of eigenvalues at 1.
    """

    low: float
    high: float
    radius: float
    zeros: tuple[Zero, ...]
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
    """Return the largest eigenvalues, with proved bounds on the spectral radius by counting.

    Parameters
    ----------
    function
        f.
    starts
        Start values of zeros (z,).
    rigid
        The number of eigenvalues that are exactly 1.
    listed
        The number of largest eigenvalues to report.
    near
        The number of largest poles near which zeros are searched.
    """
    if not function.transfer.poles.errors.max(initial=0.0) < FARTHEST:
        return Zeros(0.0, float(np.inf), 0.0, (), False, not rigid)
    poles = near_poles(function, TAKEN_OUT)
    zeros, exact, rigid_radius = _refined(function, starts, poles, rigid=rigid, near=near)
    # Newton's method finds a multiple zero only with the square root of the accuracy.
    wider = sorted((2 * np.abs(zeros - 1)[np.abs(zeros - 1) < WIDEST]).tolist(), reverse=True)
    rigid_radius = _rigid_radius(function, rigid, wider, rigid_radius)
    zeros = _distinct(zeros, rigid_radius)
    disc_of = cache(partial(enclosing_radius, function))

    def error_of(zero: complex) -> float:
        """Return the radius of a circle about a zero with eigenvalues in it, or inf."""
        return disc_of(zero)[0]

    low, high, outside_count = 0.0, 0.0, -1
    for attempt in range(SEARCHES):
        if single := _bound_of_single_zero(function, zeros, exact, disc_of, rigid, rigid_radius):
            high, outside_count = single, 0
            break
        largest, error = _largest(zeros, exact, error_of)
        width = max(OUTSIDE * error, 4 * FIRST_RADIUS) if np.isfinite(error) else WIDEST
        high, outside_count = first_counted_circle(function, largest, width, rigid, rigid_radius)
        if not outside_count:
            break
        if outside_count < 0 or attempt:  # start at a bracket, as no zero was found near the known ones
            low, high = bracket(function, low, high, rigid, rigid_radius)
            if not low > largest:
                break
        cancelled = _cancelled_poles(function, largest, zeros, exact, rigid_radius)
        exact += cancelled
        if cancelled:
            continue
        missed = _missed_zeros(function, high, zeros, poles, rigid_radius)
        zeros = _distinct(np.concatenate([zeros, missed]), rigid_radius)
    result = [Zero(zero, error_of(zero), 1) for zero in zeros[:listed].tolist()]
    bounded_zeros = [zero for zero in (*result, *exact) if np.isfinite(zero.error)]
    largest_zeros = sorted(bounded_zeros, key=lambda zero: -abs(zero.value))[:listed]
    low = max([low, *(abs(zero.value) - zero.error for zero in largest_zeros)])
    if outside_count or not high - low <= WIDEST * high:
        low, outer = bracket(function, low, high, rigid, rigid_radius)
        high = outer if outside_count else min(high, outer)
    radius, _ = _largest(zeros, exact, lambda zero: 0.0)
    if not low <= radius <= high:
        radius = (low + high) / 2 if np.isfinite(high) else low
    return Zeros(low, high, radius, tuple(largest_zeros), not outside_count, rigid_radius < WIDEST)


def _refined(
    function: Characteristic, starts: Complexes, poles: Complexes, *, rigid: int, near: int
) -> tuple[Complexes, list[Zero], float]:
    """Return the zeros found from the starts, the eigenvalues of single subsystems, and a circle about 1.

    Parameters
    ----------
    function, starts, rigid, near
        As for `find_zeros`.
    poles
        The largest poles of f.
    """
    least = _least_radius(function, 1.0, ASIDE)
    rigid_radius = _rigid_radius(function, rigid, [least * WIDER**missed for missed in range(16)], 0.0)
    exact = [zero for zero in _enclosed_poles(function) if abs(zero.value - 1) > rigid_radius]
    close = near_poles(function, near) * (1 + 1e-7)
    zeros = _distinct(refine(function, np.concatenate([starts, close]), poles=poles), rigid_radius)
    return zeros, exact, rigid_radius


def largest_zero(function: Characteristic, starts: Complexes, *, rigid: int) -> float:
    """Return the largest magnitude of an eigenvalue, without those at 1; NaN if a count contradicts it.

    The magnitude is a float without a bound; its side of 1 agrees with the number of eigenvalues outside the
    unit circle.

    Parameters
    ----------
    function, starts, rigid
        As for `find_zeros`.
    """
    if not function.transfer.poles.errors.max(initial=0.0) < FARTHEST:
        return math.nan
    poles = near_poles(function, TAKEN_OUT)
    zeros, exact, rigid_radius = _refined(function, starts, poles, rigid=rigid, near=0)
    if rigid_radius >= WIDEST:  # more eigenvalues are near 1, for example those of drifts
        return math.nan
    largest, _ = _largest(zeros, exact, lambda zero: 0.0)
    _, outside = first_counted_circle(function, 1.0, FIRST_OUTSIDE, rigid, rigid_radius)
    if outside > 0 and not largest > 1:  # an eigenvalue next to a pole, which Newton's method misses
        largest = float(np.abs(poles).max(initial=0.0))
    return largest if outside >= 0 and (outside > 0) == (largest > 1) else math.nan


def _largest(
    zeros: Complexes, exact: Sequence[Zero], error_of: Callable[[complex], float]
) -> tuple[float, float]:
    """Return the magnitude of the largest known eigenvalue, and its error."""
    largest = max(exact, key=lambda zero: abs(zero.value), default=None)
    if len(zeros) and (largest is None or abs(zeros[0]) >= abs(largest.value)):
        return float(abs(zeros[0])), error_of(complex(zeros[0]))
    return (abs(largest.value), largest.error) if largest else (0.0, 0.0)


def _bound_of_single_zero(
    function: Characteristic,
    zeros: Complexes,
    exact: Sequence[Zero],
    disc_of: Callable[[complex], tuple[float, int]],
    rigid: int,
    rigid_radius: float,
) -> float:
    """Return a bound on the spectral radius if one zero, or one pair, is larger than the others; else 0.

    A circle between it and the next known zero is far from both, and the eigenvalues outside are those of the
    zero's own circle.

    Parameters
    ----------
    function, zeros, exact
        f, its zeros, the largest first, and the eigenvalues of single subsystems.
    disc_of
        The radius of a circle about a zero, and the number of eigenvalues in it.
    rigid, rigid_radius
        As for `first_counted_circle`.
    """
    if len(zeros) < 2:
        return 0.0
    largest, following = complex(zeros[0]), max([abs(zeros[1]), *(abs(zero.value) for zero in exact)])
    middle, (error, inside) = (abs(largest) + following) / 2, disc_of(largest)
    is_real = not largest.imag
    if (
        not abs(largest) - following > SEPARATION * error
        or not (is_real or abs(largest.imag) > error)
        or middle <= function.innermost * INMOST
        or (rigid and (abs(middle - 1) <= rigid_radius or abs(largest - 1) <= rigid_radius + error))
        or count_outside(function, middle, rigid) != inside * (1 if is_real else 2)
    ):
        return 0.0
    return (abs(largest) + error) * (1 + 4 * float(np.finfo(float).eps))


def _rigid_radius(function: Characteristic, rigid: int, radii: Sequence[float], value: float) -> float:
    """Return the radius of the first circle about 1 that contains the rigid eigenvalues only.

    Without such a circle, `value` if it is not 0, else `WIDEST`; 0 without rigid modes.
    """
    if not rigid:
        return 0.0
    widths = (
        radius for radius in radii if radius < 2 * WIDEST and _count_inside(function, 1.0, radius) == rigid
    )
    return next(widths, value or WIDEST)


def _enclosed_poles(function: Characteristic) -> list[Zero]:
    """Return the poles that are eigenvalues: of equal subsystems, or of subsystems without receivers.

    Only the largest poles are tested.
    """
    poles = function.transfer.poles
    multiplicities = np.where(poles.received, poles.counts - 1, poles.counts)
    enclosed = np.flatnonzero((multiplicities > 0) & (poles.values.imag >= 0))[:MOST_ENCLOSED]
    return [
        _pole_as_zero(function, index, float(poles.errors[index]), int(multiplicities[index]))
        for index in enclosed.tolist()
    ]


def _pole_as_zero(function: Characteristic, index: int, error: float, multiplicity: int) -> Zero:
    """Return a pole of a subsystem as an eigenvalue."""
    poles = function.transfer.poles
    which, subsystem = poles.subsystems[index].tolist()
    return Zero(complex(poles.values[index]), error, multiplicity, (which, subsystem))


def _cancelled_poles(
    function: Characteristic,
    radius: float,
    zeros: Complexes,
    known_zeros: Sequence[Zero],
    rigid_radius: float,
) -> list[Zero]:
    """Return the poles beyond a circle that are eigenvalues, by a count around each pole.

    Only the largest poles are tested.

    Parameters
    ----------
    function, radius
        f, and the radius of the circle.
    zeros, known_zeros
        The zeros of f, and the eigenvalues found already: poles equal to one of these are left out.
    rigid_radius
        The radius of a circle about 1 whose poles are left out.
    """
    result: list[Zero] = []
    used = [*zeros.tolist(), *(zero.value for zero in known_zeros)]
    poles = function.transfer.poles
    outside = (np.abs(poles.values) >= radius * (1 - SAME)) & (poles.values.imag >= 0)
    outside &= np.abs(poles.values - 1) > rigid_radius
    for index in np.flatnonzero(outside)[:MOST_ENCLOSED].tolist():
        pole = complex(poles.values[index])
        if any(abs(pole - value) <= SAME * abs(pole) for value in used):
            continue
        used.append(pole)
        error, multiplicity = enclosing_radius(function, pole)
        if np.isfinite(error) and not any(abs(pole - zero) <= 2 * error for zero in zeros.tolist()):
            result.append(_pole_as_zero(function, index, error, multiplicity))
    return result


def _distinct(zeros: Complexes, rigid_radius: float) -> Complexes:
    """Return the zeros in the upper half plane, largest first, without duplicates and rigid eigenvalues."""
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


def _missed_zeros(
    function: Characteristic, radius: float, zeros: Complexes, poles: Complexes, rigid_radius: float
) -> Complexes:
    """Return further zeros, searched from points on rings and from the largest poles.

    Parameters
    ----------
    function, radius
        f, and the radius of the smallest ring.
    zeros, poles
        The known zeros, and the poles near which zeros cluster.
    rigid_radius
        The radius of a circle about 1 whose zeros are left out.
    """
    angles = np.linspace(0.0, np.pi, RING)
    rings = [scale * radius * np.exp(1j * angles) for scale in (1.0, 1.03, 1.3)]
    starts = np.concatenate([*rings, near_poles(function, RING) * (1 + 1e-3)])
    known_zeros = np.append(zeros, 1.0) if rigid_radius else zeros
    values = refine(function, starts, poles=poles, zeros=known_zeros)
    return _distinct(refine(function, values, poles=poles), rigid_radius)


def near_poles(function: Characteristic, most: int) -> Complexes:
    """Return the largest poles of f in the upper half plane (z,), at most `most`."""
    poles = function.transfer.poles
    return poles.values[poles.received & (poles.values.imag >= 0)][:most]
