"""The spectral radius from a characteristic function: zeros by Newton's method, proved by counting.

Takes: a `Characteristic`, and start values of its zeros.
Gives: `Zeros`, `find_zeros`, `near_poles`; `outside_radius`, `bracket`; `Zero`.
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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from apc.eigen.winding_number import FIRST_ARCS, wind
from apc.large_scale.characteristic import (
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

# The circle just outside the largest zero has this multiple of its error as distance. If a pole or another
# zero interferes, wider circles are tried, up to this number.
OUTSIDE, TRIES = 8.0, 10

# The ratio of the radius of a circle about a zero to the zero's error: then few arcs suffice.
CLEAR = 6.0

# The relative offset from a zero at which the slope is evaluated, and its reduction factor.
ASIDE, NEARER = 1e-7, 30.0

# The least circle that is counted, for the discs along it to lie where f can be evaluated.
INMOST = 1.1

# Initial number of arcs about a zero, and the number of evaluations after which the circle is given up.
SMALL_ARCS, SMALL_POINTS = 12, 300

# Circles between which the largest eigenvalue must be are drawn together until they are this close,
# relatively, at the cost of no more counts than these; the first circle that is tried is so far aside.
BRACKETED, MOST_COUNTS, ALONGSIDE = 1e-3, 40, 1e-6

# Points from which a circle about a zero is searched, and circles tried from each.
MOST_EVALUATIONS = 4


def enclosing_radius(function: Characteristic, point: complex) -> tuple[float, int]:
    """Return the radius of a circle about a point that has eigenvalues in it, and how many; or inf and 0.

    Nearby a zero, at ζ + h, |f| ≈ |f′| h is known to a share c of it: the zero is known to about c h.
    """
    aside = ASIDE * abs(point)
    for _ in range(MOST_EVALUATIONS):
        radius = _least_radius(function, point, aside)
        for _ in range(MOST_EVALUATIONS):
            if not radius < WIDEST * abs(point):
                break
            if (enclosed := _enclosed_in(function, point, radius)) > 0:
                return radius, enclosed
            radius *= WIDER
        aside /= NEARER  # a pole or another zero may be that close
    return float(np.inf), 0


def _least_radius(function: Characteristic, point: complex, aside: float) -> float:
    """Return the radius of the least circle about a zero worth counting, by how f is known aside of it."""
    ball = characteristic_ball(function, np.array([point + aside]), np.zeros(1))
    return max(CLEAR * float(ball.change[0]) * aside, FIRST_RADIUS * abs(point))


def _enclosed_in(function: Characteristic, point: complex, radius: float) -> int:
    """Return the number of eigenvalues within a circle, −1 if undetermined; poles as in f."""
    inside = wind(partial(characteristic_ball, function), point, radius, arcs=SMALL_ARCS, most=SMALL_POINTS)
    poles = _poles_in(function, point, radius, 1)
    return -1 if inside is None or poles is None else inside + poles


def _poles_in(function: Characteristic, point: complex, radius: float, each: Floats | int) -> int | None:
    """Return the number of poles within a circle, with multiplicity; None if undetermined."""
    poles = function.transfer.poles
    distance = np.abs(poles.values - point)
    if np.any(np.abs(distance - radius) <= poles.errors):
        return None
    return int(((distance < radius) * each).sum())


def outside_radius(function: Characteristic, radius: float, rigid: int) -> int | None:
    """Return the number of eigenvalues beyond a circle about zero, rigid ones excluded, or None.

    Parameters
    ----------
    function
        f.
    radius
        The circle's.
    rigid
        The number of eigenvalues at 1.
    """
    counts = function.transfer.poles.counts
    arcs = max(FIRST_ARCS, 2 * function.longest)  # f turns as often as its longest delay has frames
    poles = _poles_in(function, 0.0, radius, counts)
    rotations = (
        None if poles is None else wind(partial(characteristic_ball, function), 0.0, radius, arcs=arcs)
    )
    if poles is None or rotations is None:
        return None
    return int(counts.sum()) - poles - rotations - (rigid if radius < 1 else 0)


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
        The number of eigenvalues at 1, and a circle about 1 without others.
    """
    for _ in range(TRIES):
        near = max(radius + step, function.innermost * INMOST)
        if rigid and abs(near - 1) <= rigid_radius:
            near = 1 + 2 * rigid_radius
        number = outside_radius(function, near, rigid)
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
        The start value.
    rigid, rigid_radius
        The number of eigenvalues at 1, and a circle about 1 without others.
    """
    inmost = function.innermost * INMOST
    outer, radius, step = float(np.inf), max(high, low, inmost), 1e-6
    for _ in range(MOST_COUNTS):
        near, number = count_from(function, radius, ALONGSIDE * radius, rigid, rigid_radius)
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

# The largest number of poles tested as eigenvalues.
MOST_ENCLOSED = 64

# Poles divided out of f in the search for zeros: those that cluster about the zeros.
TAKEN_OUT = 128

# Points on a ring, and poles, to look for missed zeros from.
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

    `radius` is the best estimate, of an eigenvalue that may be too close to others to be listed. `counted` is
    whether a count proves that no eigenvalue lies beyond `high`; `rigid_counted`, whether one proves the
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
    """Find the largest eigenvalues and prove that there is none beyond.

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
    least = _least_radius(function, 1.0, ASIDE)
    rigid_radius = _rigid_radius(function, rigid, [least * WIDER**more for more in range(16)], 0.0)
    exact = [zero for zero in _enclosed_poles(function) if abs(zero.value - 1) > rigid_radius]
    poles = near_poles(function, TAKEN_OUT)
    close = near_poles(function, near) * (1 + 1e-7)
    zeros = _distinct(refine(function, np.concatenate([starts, close]), poles=poles), rigid_radius)
    # Where several are one, Newton's method arrives at the root of its rounding only.
    wider = sorted((2 * np.abs(zeros - 1)[np.abs(zeros - 1) < WIDEST]).tolist(), reverse=True)
    rigid_radius = _rigid_radius(function, rigid, wider, rigid_radius)
    zeros = _distinct(zeros, rigid_radius)
    error_of = cache(lambda zero: enclosing_radius(function, zero)[0])
    low, high, outside_radius = 0.0, 0.0, -1
    for search in range(SEARCHES):
        largest, error = _largest(zeros, exact, error_of)
        width = max(OUTSIDE * error, 4 * FIRST_RADIUS) if np.isfinite(error) else WIDEST
        high, outside_radius = count_from(function, largest, width, rigid, rigid_radius)
        if not outside_radius:
            break
        if (
            outside_radius < 0 or search
        ):  # from where it must be, if nothing was found from around what is known
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
    if outside_radius or not high - low <= WIDEST * high:
        low, outer = bracket(function, low, high, rigid, rigid_radius)
        high = outer if outside_radius else min(high, outer)
    radius, _ = _largest(zeros, exact, lambda zero: 0.0)
    if not low <= radius <= high:
        radius = (low + high) / 2 if np.isfinite(high) else low
    return Zeros(low, high, radius, tuple(every), not outside_radius, rigid_radius < WIDEST)


def _largest(
    zeros: Complexes, exact: Sequence[Zero], error_of: Callable[[complex], float]
) -> tuple[float, float]:
    """Return the magnitude of the largest eigenvalue found, and its error."""
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
    widths = (
        radius for radius in radii if radius < 2 * WIDEST and _enclosed_in(function, 1.0, radius) == rigid
    )
    return next(widths, value or WIDEST)


def _enclosed_poles(function: Characteristic) -> list[Zero]:
    """Return the poles that are eigenvalues: those of equal subsystems, or of subsystems without receivers.

    Only the largest few are tested.
    """
    poles = function.transfer.poles
    times = np.where(poles.received, poles.counts - 1, poles.counts)
    enclosed = np.flatnonzero((times > 0) & (poles.values.imag >= 0))[:MOST_ENCLOSED]
    return [
        _local(function, index, float(poles.errors[index]), int(times[index])) for index in enclosed.tolist()
    ]


def _local(function: Characteristic, index: int, error: float, times: int) -> Zero:
    """Return a pole as an eigenvalue."""
    poles = function.transfer.poles
    which, subsystem = poles.subsystems[index].tolist()
    return Zero(complex(poles.values[index]), error, times, (which, subsystem))


def _cancelled_poles(
    function: Characteristic,
    outside_radius: float,
    zeros: Complexes,
    known: Sequence[Zero],
    rigid_radius: float,
) -> list[Zero]:
    """Return the poles beyond a circle that are eigenvalues by a count around each.

    Only the largest few are tested.
    """
    result: list[Zero] = []
    used = [*zeros.tolist(), *(zero.value for zero in known)]
    poles = function.transfer.poles
    outside = (np.abs(poles.values) >= outside_radius * (1 - SAME)) & (poles.values.imag >= 0)
    outside &= np.abs(poles.values - 1) > rigid_radius
    for index in np.flatnonzero(outside)[:MOST_ENCLOSED].tolist():
        pole = complex(poles.values[index])
        if any(abs(pole - other) <= SAME * abs(pole) for other in used):
            continue
        used.append(pole)
        error, many = enclosing_radius(function, pole)
        if np.isfinite(error) and not any(abs(pole - zero) <= 2 * error for zero in zeros.tolist()):
            result.append(_local(function, index, error, many))
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
    return poles.values[poles.received & (poles.values.imag >= 0)][:most]
