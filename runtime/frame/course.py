"""What a mode does inside a frame: by how much it turns, whole turns counted.

Takes: one or many sites with their schedule, the states at a frame's start and what is heard, as modes
have them.
Gives: `turns`, of one site in many modes, or of many sites, each in a mode of its own.
Guarantees: between events the motion is followed along the exact exponential, as finely as it takes; what
can't be told is NaN.
Does not: find modes (see `spectrum`).

An eigenvalue e^{sT} of the frame's map knows Im s T up to whole turns. The motion itself knows them: a state
x(t) of the mode, complex, goes around 0 by the angle Im s T within a frame. Where the eigenvalue and its
vector are real, each change of sign is half a turn. What is remembered turns from tick to tick, by half a
turn at most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import exponential
from apc.frame.lift import follow, followed
from apc.frame.radius import FLOATS
from apc.frame.schedule import ClockedValue, Propagate, Schedule
from apc.frame.site import LinearSubsystem, every_matrix, matrices_of

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]

# Points from one event to the next: at least so many, and this many in a turn of what swings fastest; how
# often they are doubled until every motion is followed closely enough: of many sites half as many nearly
# always are.
FEWEST, A_TURN = 4, 16
ONE_SITE, MANY = (1, 9), (-1, 2)

# How many numbers are held at once, and points from one event to the next of many sites.
MOST, A_FEW = 2**22, 256

# From point to point a motion that turns by less is followed closely enough.
CLOSE = 1.0

# What an angle may miss the eigenvalue's by, in radians: rounding misses it by far less, and a motion that is
# not the eigenvalue's, as where a vector of a nearly vanishing one is mostly rounding, by any amount.
OFF = 0.3

# A course this much smaller than it was is rounding of what it was: its sign means nothing. What shrinks as
# much in a whole frame is no mode any more (`spectrum.DEADBEAT`).
FADED = 1e-14

# Angles this near to half a turn are a change of sign, turned by rounding or by the sign of a zero.
ROUNDED = np.pi * 2.0**-40
HALF_TURN_BACK = ROUNDED - np.pi

# A real motion that passes 0 turns by half a turn, to within so many radians.
NEAR_ZERO = 1e-6


def turns(
    site: LinearSubsystem,
    schedule: Schedule,
    start: Complexes,
    heard: Complexes,
    states: Integers,
    values: Complexes,
) -> Floats:
    """Return by how much modes turn in a frame (k,), in radians; NaN where it can't be told.

    Parameters
    ----------
    site, schedule
        Matrices in floats (1, …) of one site, or (k, …) of many sites with a mode each, and what happens in
        their frame.
    start, heard
        The states z at the frame's start (k, n_z), and what is heard r (k, n_r).
    states, values
        Which entry of z is followed (k,), and the eigenvalues (k,).
    """
    result = np.full(len(values), np.nan)
    start, heard = _real_where_real(start, heard, values)
    one_site = _of_one(site)
    swing = _fastest(site.a)
    durations = [event.duration for event in schedule.events if isinstance(event, Propagate)]
    height = sum(site.b.shape[-2:])
    left = np.arange(len(values))
    for doubled in range(*(ONE_SITE if one_site else MANY)):
        points = {
            duration: _power_of_two(A_TURN * swing * float(duration * schedule.quantum), doubled)
            for duration in set(durations)
        }
        most = height * sum(points[duration] for duration in durations)
        if not len(left) or most > MOST or not (one_site or max(points.values(), default=0) <= A_FEW):
            break
        chunk = MOST // max(most, 1)
        agreed = np.zeros(len(left), dtype=np.bool_)
        for first in range(0, len(left), chunk):
            some = left[first : first + chunk]
            mine = every_matrix(site, partial(_some_of, some))
            course = _courses(mine, schedule, points, start[some], heard[some], states[some])
            angle, known = followed_closely(course, values[some])
            known |= states[some] >= len(site.kind.states)
            result[some[known]] = _of_eigenvalue(angle[known], values[some[known]])
            agreed[first : first + chunk] = known
        left = left[~agreed]
    return result


def _real_where_real(start: Complexes, heard: Complexes, values: Complexes) -> tuple[Complexes, Complexes]:
    """Return what modes begin with and hear, (k, n) and (k, n_r), real where their `values` (k,) are.

    A real vector passes 0 on no side, where its phase would be that of rounding.
    """
    largest = np.take_along_axis(start, np.abs(start).argmax(axis=1)[:, None], axis=1)
    size = np.abs(largest)
    turn = np.where(size > 0, largest.conj() / np.where(size > 0, size, 1.0), 1.0)
    real = (values.imag == 0)[:, None]
    begun, hears = (np.where(real, (block * turn).real, block) for block in (start, heard))
    return begun, hears


def _of_one(site: LinearSubsystem) -> bool:
    """Say whether matrices (1, …) or (k, …) are those of one site."""
    return max(map(len, matrices_of(site))) == 1


def _fastest(a: Floats) -> float:
    """Return how often a second what swings fastest between events does so, of any of many sites."""
    return float(np.abs(np.linalg.eigvals(a).imag).max(initial=0.0)) / (2 * np.pi)


def _some_of(places: Integers, matrix: Floats) -> Floats:
    """Return matrices (k, n, m) of some sites; that of one site (1, n, m) serves all."""
    return matrix if len(matrix) == 1 else matrix[places]


def _courses(
    site: LinearSubsystem,
    schedule: Schedule,
    points: dict[int, int],
    start: Complexes,
    heard: Complexes,
    states: Integers,
) -> Complexes:
    """Return the states followed at so many points of each step, and the end (points, k).

    What is remembered is followed at its ticks, and stays where it ends.

    Rows of numbers are of all modes, their real parts and then the imaginary ones: one product serves all.
    """
    count, n, n_x = len(states), sum(site.b.shape[-2:]), len(site.kind.states)
    below = np.eye(n)[n_x:]
    steps, fine = {}, {}
    for duration, number in points.items():
        step = exponential(site.a, site.b, float(duration * schedule.quantum) / number)
        power = np.concatenate([step, np.broadcast_to(below, (len(step), *below.shape))], axis=1)
        fine[duration], steps[duration] = _followed(power, np.minimum(states, n_x - 1), number)
    one_site = _of_one(site)
    if one_site:
        site = every_matrix(site, lambda matrix: matrix[0])
        steps = {duration: step[0] for duration, step in steps.items()}
    parts: list[NDArray[Any]] = []
    computed: Mapping[ClockedValue, Floats] = {}

    def rows_of(numbers: Complexes) -> Floats:
        return np.concatenate([numbers.real.T, numbers.imag.T], axis=1)

    def multiply(matrix: Floats, rows: Floats) -> Floats:
        if matrix.ndim == 2 or len(matrix) == 1:
            return np.asarray(matrix.reshape(matrix.shape[-2:]) @ rows)
        halves = rows.reshape(len(rows), 2, count)
        return np.asarray(np.einsum("khn,nck->hck", matrix, halves).reshape(-1, 2 * count))

    def watch(duration: int, moving: Floats, so_far: Mapping[ClockedValue, Floats]) -> None:
        nonlocal computed
        computed = so_far
        # Each mode's rows times its own columns: (points, k, 2).
        columns = moving.reshape(n, 2, count).transpose(2, 0, 1)
        parts.append((fine[duration] @ columns).swapaxes(0, 1))

    listened = rows_of(heard)
    course = follow(
        *(site, schedule, steps, rows_of(start), lambda row: listened[row]),
        numbers=replace(FLOATS, multiply=multiply),
        watch=watch,
    )
    end, _ = followed(course)
    last = end.reshape(-1, 2, count)[states, :, np.arange(count)]
    path = np.concatenate([*parts, last[None]])
    for mode in np.flatnonzero(states >= n_x):
        item = schedule.carried[states[mode] - n_x]
        ticks = [replace(item, index=item.index + i) for i in range(schedule.ticks[item.partition])]
        values = [computed[tick].reshape(2, count)[:, mode] for tick in ticks if tick in computed]
        path[:, mode] = last[mode]
        path[: len(values), mode] = values
    return np.asarray(path[..., 0] + 1j * path[..., 1])


def _power_of_two(least: float, doubled: int) -> int:
    """Return how many points there are in a step; too many to hold for what swings too fast."""
    if not least < MOST:
        return MOST + 1
    return int(2 ** (np.ceil(np.log2(max(least, FEWEST))) + doubled))


def _followed(power: Floats, states: Integers, number: int) -> tuple[Floats, Floats]:
    """Return the rows of the powers 0, 1, … of a step of which each mode's state follows, and the last power.

    Parameters
    ----------
    power
        The steps of many sites (k, n, n), or (1, n, n) of all.
    states
        Which state of each mode (k,).
    number
        How many powers, one of 2.

    Returns
    -------
    The rows (k, number, n), and the power of that number.
    """
    own, which = np.unique(states, return_inverse=True) if len(power) == 1 else (states, slice(None))
    rows = np.eye(power.shape[-1])[own, None]
    for _ in range(number.bit_length() - 1):
        rows = np.concatenate([rows, rows @ power], axis=1)
        power = power @ power
    return rows[which], power


def followed_closely(course: Complexes, values: Complexes) -> tuple[Floats, NDArray[np.bool_]]:
    """Return by how much modes' courses (points, k) turn (k,), in radians, and of which that is known (k,).

    From point to point they turn by little, or a mode that is real changes its sign, which is half a turn.
    """
    angles = _angles(_phases(course))
    # In an enclosure of more bits a real eigenvalue has an imaginary part, far below a float's rounding.
    real = np.abs(values.imag) <= ROUNDED * np.abs(values)
    signs = real & (np.pi - np.abs(angles) <= NEAR_ZERO)
    return angles.sum(axis=0), np.asarray(((np.abs(angles) < CLOSE) | signs).all(axis=0))


def _phases(course: Complexes) -> NDArray[Any]:
    """Return the directions of courses (points, k), of unit length; where one stays at 0, NaN."""
    size = np.abs(course)
    with np.errstate(invalid="ignore"):
        phases = course / size  # courses can grow or shrink out of floats' range
    clear = size.min(axis=0) > FADED * size.max(axis=0)
    if not clear.all():
        spoilt = np.flatnonzero(~clear)
        phases[:, spoilt] = _directions(phases[:, spoilt], size[:, spoilt])
    return phases


def _angles(phases: NDArray[Any]) -> Floats:
    """Return by how much directions (points, k) turn about 0 from each to the next, in radians.

    A change of sign is half a turn forwards, whatever the sign of the zero beside it; a course that stays at
    0 has no angle.
    """
    turned = phases[1:] * phases[:-1].conj()
    angles = np.arctan2(turned.imag, turned.real)
    return np.asarray(np.where(angles <= HALF_TURN_BACK, angles + 2 * np.pi, angles))


def _directions(phases: NDArray[Any], size: Floats) -> NDArray[Any]:
    """Return the directions of courses (points, k): where one is 0, to rounding, its last, or its first."""
    moving = size > FADED * np.maximum.accumulate(size, axis=0)
    place = np.maximum.accumulate(np.where(moving, np.arange(len(size))[:, None], -1), axis=0)
    place = np.where(place < 0, np.argmax(moving, axis=0), place)
    return np.take_along_axis(phases, place, axis=0)


def _of_eigenvalue(turned: Floats, values: Complexes) -> Floats:
    """Return the angles of eigenvalues with a motion's whole turns, NaN where the motion is another's."""
    principal = np.where(values.imag == 0, np.where(values.real < 0, np.pi, 0.0), np.angle(values))
    result = principal + 2 * np.pi * np.round((turned - principal) / (2 * np.pi))
    return np.where(np.abs(turned - result) <= OFF, result, np.nan)
