"""What a mode does inside a frame: by how much it turns, whole turns counted.

Takes: a site with its schedule, its state at a frame's start and what it hears, as a mode has them.
Gives: `turns`, of one site in many modes; `turns_of_many`, of many sites, each in a mode of its own.
Guarantees: between events the motion is followed along the exact exponential, as finely as it takes; what
can't be told is NaN.
Does not: find modes (see `spectrum`).

An eigenvalue e^{sT} of the frame's map knows Im s T up to whole turns. The motion itself knows them: a state
x(t) of the mode, complex, goes around 0 by the angle Im s T within a frame. Where the eigenvalue and its
vector are real, each change of sign is half a turn.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import exponential, exponential_values
from apc.frame.lift import Seen, follow
from apc.frame.radius import FLOATS
from apc.frame.schedule import Propagate, Schedule
from apc.frame.site import LinearSite, every_matrix
from apc.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]

# Points from one event to the next: at least so many, and this many in a turn of what swings fastest.
FEWEST, A_TURN = 4, 16

# How often they may be doubled until two counts agree, and how many numbers are held at once.
DOUBLINGS, MOST = 8, 2**22

# Of many sites, so many points at most from one event to the next.
A_FEW = 256

# Steps that are remembered, and of how many entries at most.
KEPT, FEW_ENTRIES = 128, 4096

# So many modes are followed at once, complex and real: to go through a frame twice takes longer.
FEW = 64

# From point to point a motion that turns by less is followed closely enough.
CLOSE = 1.0

# Vectors that miss each other's conjugates by no more, relatively, are of one motion and its mirror image.
SAME = 1e-9

# What an angle may miss the eigenvalue's by, in radians: rounding misses it by far less, and a motion that is
# not the eigenvalue's, as where a vector of a nearly vanishing one is mostly rounding, by any amount.
OFF = 0.3

# A course this much smaller than it was is rounding of what it was: its sign means nothing. What shrinks as
# much in a whole frame is no mode any more (`spectrum.DEADBEAT`).
FADED = 1e-14

# Angles this near to half a turn are a change of sign, turned by rounding or by the sign of a zero.
ROUNDED = np.pi * 2.0**-40
HALF_TURN_BACK = ROUNDED - np.pi

# A step between points is as far from straight as an eighth of its second difference, or four times that if
# this changes along it; and what passes 0 nearer than this, relative to its size, may pass it on either side
# for the rounding of its vector.
BENT, NEAR_ZERO = 0.5, 1e-6


def turns(
    site: LinearSite,
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
        A site's matrices in floats, and what happens in its frame.
    start, heard
        Its state z at the frame's start (n_z, k) and what it hears r (n_r, k), a column a mode.
    states
        Which continuous state is followed (k,).
    values
        The eigenvalues (k,).
    """
    found = np.full(len(values), np.nan)
    durations = [event.duration for event in schedule.events if isinstance(event, Propagate)]
    longest = float(max(durations, default=0) * schedule.quantum)
    few = site.a.size <= FEW_ENTRIES
    swing = _swing(site.a.tobytes(), len(site.a)) if few else _fast_enough(site.a, longest)
    mirrored = _mirrored(start, heard, states, values)
    real = values.imag == 0
    if real.all() or len(real) > FEW:  # else they are followed with complex ones
        real &= ~start.imag.any(axis=0) & ~heard.imag.any(axis=0)
    left = np.flatnonzero(~mirrored)
    for doubled in range(1, DOUBLINGS + 1):
        if not len(left):
            break
        points = {
            duration: _power_of_two(A_TURN * swing * float(duration * schedule.quantum), doubled)
            for duration in set(durations)
        }
        most = sum(points[duration] for duration in durations)
        height = max(sum(site.b.shape), 1)
        if not most * height <= MOST:
            break
        # Rows of powers are held for every mode, of each length of step one; the course for every point.
        chunk = MOST // max(sum(points.values()) * height, most)
        seen = np.zeros(len(values), dtype=np.bool_)
        # A real course is half the work of a complex one.
        alike = [left] if len(left) <= FEW else [left[real[left]], left[~real[left]]]
        for some in (one[first : first + chunk] for one in alike for first in range(0, len(one), chunk)):
            given: list[NDArray[Any]] = [start[:, some], heard[:, some]]
            if real[some].all():
                given = [block.real for block in given]
            course = _course(site, schedule, points, given[0], given[1], states[some])
            angle, agreed = followed_closely(course, values[some])
            found[some[agreed]] = _of_eigenvalue(angle[agreed], values[some[agreed]])
            seen[some[agreed]] = True
        left = left[~seen[left]]
    found[mirrored] = -found[np.flatnonzero(mirrored) - 1]
    return found


@functools.lru_cache(maxsize=KEPT)
def _swing(entries: bytes, n_x: int) -> float:
    """Return `_fastest` of few entries, row by row; what only couplers change is remembered."""
    return _fastest(np.frombuffer(entries).reshape(n_x, n_x))


def _fast_enough(a: Floats, longest: float) -> float:
    """Return `_fastest` of a large A; a bound on it where that asks for no more points in the longest step.

    No eigenvalue's imaginary part is larger than the norm of the skew part of D⁻¹ A D (Bendixson, Acta
    Mathematica 25, 1902).
    """
    balanced = load_pool("scipy.linalg").matrix_balance(a, permute=False)[0]
    bound = float(np.abs(balanced - balanced.T).sum(axis=0).max(initial=0.0)) / (4 * np.pi)
    return bound if A_TURN * bound * longest <= FEWEST else _fastest(a)


def _fastest(a: Floats) -> float:
    """Return how often a second what swings fastest between events does so, of one site or of many."""
    return float(np.abs(np.linalg.eigvals(a).imag).max(initial=0.0)) / (2 * np.pi)


def _mirrored(start: Complexes, heard: Complexes, states: Integers, values: Complexes) -> NDArray[np.bool_]:
    """Say which modes (k,) are the one before seen in a mirror: its conjugate."""
    found = np.zeros(len(values), dtype=np.bool_)
    found[1:] = (values[:-1].imag > 0) & (values[1:] == values[:-1].conj()) & (states[1:] == states[:-1])
    for block in (start, heard) if found.any() else ():
        apart = np.abs(block[:, 1:] - block[:, :-1].conj()).max(axis=0, initial=0.0)
        found[1:] &= apart <= SAME * np.abs(block[:, 1:]).max(axis=0, initial=0.0)
    return found


def turns_of_many(
    site: LinearSite,
    schedule: Schedule,
    start: Complexes,
    heard: Complexes,
    states: Integers,
    values: Complexes,
) -> Floats:
    """Return by how much a mode of each of many sites turns in a frame (k,), see `turns`; NaN sooner.

    Parameters
    ----------
    site, schedule
        The sites' matrices (k, …), or (1, …) of what all have in common, and what happens in their frame.
    start, heard
        Their states z at the frame's start (k, n_z), and what they hear r (k, n_r).
    states, values
        Which continuous state is followed (k,), and the eigenvalues (k,).
    """
    found = np.full(len(values), np.nan)
    swing = _fastest(site.a)
    durations = {event.duration for event in schedule.events if isinstance(event, Propagate)}
    left = np.arange(len(values))
    for doubled in (-1, 0, 1):  # half as finely first: nearly always that is close enough
        points = {
            duration: _power_of_two(A_TURN * swing * float(duration * schedule.quantum), doubled)
            for duration in durations
        }
        if max(points.values(), default=0) > A_FEW or not len(left):
            break
        mine = every_matrix(site, partial(_some_of, left))
        course = _courses(mine, schedule, points, start[left], heard[left], states[left])
        angle, agreed = followed_closely(course, values[left], again=doubled > 0)
        found[left[agreed]] = _of_eigenvalue(angle[agreed], values[left[agreed]])
        left = left[~agreed]
    return found


def _some_of(places: Integers, matrix: Floats) -> Floats:
    """Return matrices (k, n, m) of some sites, each entry's numbers of all of them side by side."""
    return (
        matrix
        if len(matrix) == 1
        else np.ascontiguousarray(matrix[places].transpose(1, 2, 0)).transpose(2, 0, 1)
    )


def _courses(
    site: LinearSite,
    schedule: Schedule,
    points: dict[int, int],
    start: Complexes,
    heard: Complexes,
    states: Integers,
) -> Complexes:
    """Return the state followed of each site at so many points of each step, and the end (points, k).

    A row is of all sites, their real parts and then the imaginary ones: one product serves all sites of a
    common matrix, and of others one of numbers side by side.
    """
    n_x, n_u = site.b.shape[-2:]
    a, b = site.a, site.b
    every, below = np.arange(len(states)), np.eye(n_x + n_u)[n_x:]
    alike = len(a) == len(b) == 1
    own, which = np.unique(states, return_inverse=True) if alike else (states, every)
    steps, fine = {}, {}
    for duration, number in points.items():
        step = exponential_values(a, b, float(duration * schedule.quantum) / number)
        power = np.concatenate([step, np.broadcast_to(below, (len(step), *below.shape))], axis=1)
        fine[duration], power = _followed(power, own, number)
        steps[duration] = power[:, :n_x]
    parts: list[NDArray[Any]] = []

    def rows_of(numbers: Complexes) -> Floats:
        return np.concatenate([numbers.real.T, numbers.imag.T], axis=1)

    def multiply(matrix: Floats, rows: Floats) -> Floats:
        if len(matrix) == 1:
            return np.asarray(matrix[0] @ rows)
        halves = rows.reshape(len(rows), 2, -1)
        return np.asarray(np.einsum("khn,nck->hck", matrix, halves).reshape(-1, rows.shape[-1]))

    def watch(seen_now: Seen) -> None:
        ((duration, moving),) = seen_now
        rows = fine[duration]
        if alike:
            seen = (rows.reshape(-1, rows.shape[-1]) @ moving).reshape(*rows.shape[:2], 2, -1)
            parts.append(seen[0] if len(own) == 1 else seen[which, :, :, every].transpose(1, 2, 0))
        else:
            parts.append(np.einsum("kpn,nck->pck", rows, moving.reshape(len(moving), 2, -1)))

    listened = rows_of(heard)
    numbers = replace(FLOATS, multiply=multiply)
    course = follow(
        site, schedule, steps, rows_of(start), lambda row: listened[row], numbers=numbers, watch=watch
    )
    while True:
        try:
            next(course)
        except StopIteration as end:
            last = end.value.reshape(len(end.value), 2, -1)[states, :, every].T[None]
            path = np.concatenate([*parts, last])
            return np.asarray(path[:, 0] + 1j * path[:, 1])


def _power_of_two(least: float, doubled: int) -> int:
    """Return how many points there are in a step; too many to hold for what swings too fast."""
    if not least < MOST:
        return MOST + 1
    return int(2 ** (np.ceil(np.log2(max(least, FEWEST))) + doubled))


def _fine(
    site: LinearSite, schedule: Schedule, points: dict[int, int], states: Integers
) -> dict[int, tuple[Floats, Floats]]:
    """Return `_rows_of_step` for each duration, of one site at so many points; of few entries remembered."""
    generator = np.concatenate([site.a, site.b], axis=1)
    n_x, n = generator.shape
    few = n * max(n, len(states) * max(points.values(), default=0)) <= FEW_ENTRIES
    entries, followed = generator.tobytes(), states.astype(np.int64).tobytes()
    fine = {}
    for duration, number in points.items():
        seconds = float(duration * schedule.quantum) / number
        if few:  # what only couplers change leaves them as they are
            fine[duration] = _known_rows(entries, n_x, seconds, followed, number)
        else:
            fine[duration] = _rows_of_step(generator, seconds, states, number)
    return fine


@functools.lru_cache(maxsize=KEPT)
def _known_rows(
    entries: bytes, n_x: int, seconds: float, states: bytes, number: int
) -> tuple[Floats, Floats]:
    """Return `_rows_of_step`, the numbers row by row."""
    found = _rows_of_step(
        np.frombuffer(entries).reshape(n_x, -1), seconds, np.frombuffer(states, np.int64), number
    )
    for one in found:
        one.flags.writeable = False
    return found


def _rows_of_step(generator: Floats, seconds: float, states: Integers, number: int) -> tuple[Floats, Floats]:
    """Return what the states followed are at each point (k, number, n), and [F G] (n_x, n) to the last."""
    own, which = np.unique(states, return_inverse=True)
    rows, power = _followed(_square_step(generator, seconds), own, number)
    return rows[which], power[0, : len(generator)].copy()


def _square_step(generator: Floats, seconds: float) -> Floats:
    """Return the step of [A B] (n_x, n), square (1, n, n)."""
    n_x, n = generator.shape
    step, units = exponential(generator[:, :n_x], generator[:, n_x:], seconds)
    return np.vstack([units * step.matrix, np.eye(n)[n_x:]])[None]


def _followed(power: Floats, states: Integers, number: int) -> tuple[Floats, Floats]:
    """Return the rows of the powers 0, 1, … of a step of which each site's state follows, and the last power.

    Parameters
    ----------
    power
        The steps of many sites (k, n, n), or (1, n, n) of all.
    states
        Which state of each (k,).
    number
        How many powers, one of 2.

    Returns
    -------
    The rows (k, number, n), and the power of that number.
    """
    n = power.shape[-1]
    rows = np.zeros((len(states), 1, n))
    rows[np.arange(len(states)), 0, states] = 1.0
    for _ in range(number.bit_length() - 1):
        # One product of all rows is much less work than one of each.
        later = (rows.reshape(-1, n) @ power[0]).reshape(rows.shape) if len(power) == 1 else rows @ power
        rows = np.concatenate([rows, later], axis=1)
        power = power @ power
    return rows, power


def _course(
    site: LinearSite,
    schedule: Schedule,
    points: dict[int, int],
    start: Floats | Complexes,
    heard: Floats | Complexes,
    states: Integers,
) -> Floats | Complexes:
    """Return the states followed at so many points of each step, and the end (points, k)."""
    width = 2 if np.iscomplexobj(start) else 1
    fine = _fine(site, schedule, points, states)
    steps = {duration: step for duration, (_, step) in fine.items()}
    parts: list[Floats] = []

    def columns(block: Floats | Complexes) -> Floats:
        # A complex column is two real ones: a real matrix times these is half the work.
        return np.ascontiguousarray(block).view(np.float64)

    def watch(seen: Seen) -> None:
        # Each mode's rows times its columns, of every time: (modes, times, points of all steps, width).
        every = [
            (fine[duration][0] if moving.ndim == 2 else fine[duration][0][:, None])
            @ np.moveaxis(moving.reshape(*moving.shape[:-1], -1, width), -2, 0)
            for duration, moving in seen
        ]
        path = np.concatenate(every, axis=-2) if len(every) > 1 else every[0]
        parts.append(path.reshape(len(states), -1, width))

    listened = columns(heard)
    course = follow(
        site, schedule, steps, columns(start), lambda row: listened[row], watch=watch, at_once=True
    )
    while True:
        try:
            next(course)
        except StopIteration as end:
            last = end.value.reshape(len(end.value), -1, width)[states, np.arange(len(states))]
            path = np.concatenate([*parts, last[:, None]], axis=1)
            return np.ascontiguousarray((path[..., 0] + 1j * path[..., 1] if width == 2 else path[..., 0]).T)


def followed_closely(
    course: Floats | Complexes, values: Complexes, *, again: bool = True
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return by how much modes' courses (points, k) turn (k,), in radians, and of which that is known (k,).

    Where points are far apart, it is known if half of them tell the same and no step goes so near 0 that its
    side isn't sure; not tried unless `again`.
    """
    phases = _phases(course)
    angle, widest = _turned(phases)
    known = widest < CLOSE
    far = np.flatnonzero(~known)
    if again and len(far):
        some = phases[:, far]
        known[far] = np.abs(angle[far] - _turned(some[::2])[0]) < OFF
        known[far] &= _on_one_side(course[:, far], some, values[far].imag == 0)
    return angle, known


def _on_one_side(
    course: Floats | Complexes, phases: NDArray[Any], real: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Say of which courses (points, k) no wide step may pass 0 on either side.

    A step is straight but for its bend. A mode that is real changes its sign, along a line through 0, and one
    that nearly is passes 0 on a side that rounding may choose.
    """
    start, end = course[:-1], course[1:]
    with np.errstate(all="ignore"):
        scale = np.maximum(np.abs(start), np.abs(end))
        a, b = start / scale, end / scale
        distance = np.abs((a.conj() * b).imag) / np.abs(b - a)
        bend = np.abs(np.diff(course, 2, axis=0))
        bend = np.maximum(np.pad(bend, ((1, 0), (0, 0))), np.pad(bend, ((0, 1), (0, 0)))) / scale
        turned = np.abs(np.angle(phases[1:] * phases[:-1].conj()))
        sure = (turned < CLOSE) | (distance > BENT * bend + NEAR_ZERO)
    return np.asarray((sure | (np.pi - turned <= np.where(real, NEAR_ZERO, ROUNDED))).all(axis=0))


def _phases(course: Floats | Complexes) -> NDArray[Any]:
    """Return the directions of courses (points, k), of unit length; where one stays at 0, NaN."""
    size = np.abs(course)
    with np.errstate(invalid="ignore"):
        phases = course / size  # courses can grow or shrink out of floats' range
    clear = size.min(axis=0) > FADED * size.max(axis=0)
    if not clear.all():
        spoilt = np.flatnonzero(~clear)
        phases[:, spoilt] = _directions(phases[:, spoilt], size[:, spoilt])
    return phases


def _turned(phases: NDArray[Any]) -> tuple[Floats, Floats]:
    """Return by how much directions (points, k) turn about 0, in radians, and the widest angle of a step.

    A change of sign is half a turn forwards, whatever the sign of the zero beside it; a course that stays at
    0 has no angle.
    """
    turned = phases[1:] * phases[:-1].conj()
    angles = np.arctan2(turned.imag, turned.real)
    if (angles <= HALF_TURN_BACK).any():
        angles = np.where(angles <= HALF_TURN_BACK, angles + 2 * np.pi, angles)
    return angles.sum(axis=0), np.abs(angles).max(axis=0, initial=0.0)


def _directions(phases: NDArray[Any], size: Floats) -> NDArray[Any]:
    """Return the directions of courses (points, k): where one is 0, to rounding, its last, or its first."""
    moving = size > FADED * np.maximum.accumulate(size, axis=0)
    place = np.maximum.accumulate(np.where(moving, np.arange(len(size))[:, None], -1), axis=0)
    place = np.where(place < 0, np.argmax(moving, axis=0), place)
    return np.take_along_axis(phases, place, axis=0)


def _of_eigenvalue(turned: Floats, values: Complexes) -> Floats:
    """Return the angles of eigenvalues with a motion's whole turns, NaN where the motion is another's."""
    principal = np.where(values.imag == 0, np.where(values.real < 0, np.pi, 0.0), np.angle(values))
    found = principal + 2 * np.pi * np.round((turned - principal) / (2 * np.pi))
    return np.where(np.abs(turned - found) <= OFF, found, np.nan)
