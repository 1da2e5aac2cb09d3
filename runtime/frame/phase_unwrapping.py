"""Phase advance of modes inside a frame, with complete turns counted.

Takes: one or many subsystems with their schedule; the states at a frame's start and the received values of
each mode.
Gives: `phase_advance`, of one subsystem in many modes, or of many subsystems in one mode each.
Guarantees: between events the motion is sampled along the exact exponential, as finely as necessary; an
undetermined phase is NaN.
Does not: compute modes (see `spectrum`).

An eigenvalue e^{sT} of the frame map determines Im s T up to multiples of 2π. The motion determines them: a
complex state x(t) of the mode advances in phase by Im s T within a frame. Where the eigenvalue and its vector
are real, each change of sign is half a turn. Discrete states advance from tick to tick, by half a turn at
most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import exponential
from apc.frame.interval_arithmetic import FLOATS
from apc.frame.lift import follow, followed
from apc.frame.linear_subsystem import LinearSubsystem, every_matrix, matrices_of
from apc.frame.schedule import ClockedValue, Propagate, Schedule

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]

# Samples from one event to the next: the minimum, and the number per period of the fastest oscillation; how
# often they are doubled until every motion is resolved: of many subsystems, half as many nearly always
# suffice.
FEWEST, A_TURN = 4, 16
SINGLE_SUBSYSTEM, MANY = (1, 9), (-1, 2)

# The largest number of values in memory, and samples between events for many subsystems.
MOST, A_FEW = 2**22, 256

# A motion that advances by less between samples is resolved.
CLOSE = 1.0

# Tolerance between an angle and the eigenvalue's angle, in radians: rounding is far below it. A motion that
# is not the eigenvalue's, as where the vector of a nearly zero eigenvalue is rounding noise, is off by any
# amount.
OFF = 0.3

# A mode path this much smaller than before is rounding noise: its sign is meaningless. A motion that shrinks
# as much in one frame is not a mode (`spectrum.DEADBEAT`).
FADED = 1e-14

# Angles this near to half a turn are a change of sign, up to rounding or the sign of a zero.
ROUNDED = np.pi * 2.0**-40
HALF_TURN_BACK = ROUNDED - np.pi

# A real motion that passes 0 advances by half a turn, within this tolerance in radians.
NEAR_ZERO = 1e-6


def phase_advance(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    start: Complexes,
    received: Complexes,
    states: Integers,
    values: Complexes,
) -> Floats:
    """Return the phase advance of modes in a frame (k,), in radians; NaN where it is undetermined.

    Parameters
    ----------
    subsystem, schedule
        Floating-point matrices (1, …) of one subsystem, or (k, …) of many subsystems with one mode each, and
        the events of their frame.
    start, received
        The states z at the frame's start (k, n_z), and the received values r (k, n_r).
    states, values
        The index of the sampled entry of z (k,), and the eigenvalues (k,).
    """
    result = np.full(len(values), np.nan)
    start, received = _real_where_real(start, received, values)
    single_subsystem = _of_single(subsystem)
    swing = _fastest(subsystem.a)
    durations = [event.duration for event in schedule.events if isinstance(event, Propagate)]
    height = sum(subsystem.b.shape[-2:])
    left = np.arange(len(values))
    for doubled in range(*(SINGLE_SUBSYSTEM if single_subsystem else MANY)):
        points = {
            duration: _power_of_two(A_TURN * swing * float(duration * schedule.quantum), doubled)
            for duration in set(durations)
        }
        most = height * sum(points[duration] for duration in durations)
        if not len(left) or most > MOST or not (single_subsystem or max(points.values(), default=0) <= A_FEW):
            break
        chunk = MOST // max(most, 1)
        agreed = np.zeros(len(left), dtype=np.bool_)
        for first in range(0, len(left), chunk):
            some = left[first : first + chunk]
            mine = every_matrix(subsystem, partial(_some_of, some))
            mode_path = _mode_paths(mine, schedule, points, start[some], received[some], states[some])
            angle, known = followed_closely(mode_path, values[some])
            known |= states[some] >= len(subsystem.peer_type.states)
            result[some[known]] = _of_eigenvalue(angle[known], values[some[known]])
            agreed[first : first + chunk] = known
        left = left[~agreed]
    return result


def _real_where_real(start: Complexes, received: Complexes, values: Complexes) -> tuple[Complexes, Complexes]:
    """Return the initial states (k, n) and received values (k, n_r) of modes, real where `values` (k,) are.

    A real vector passes 0 without a phase; an imaginary part from rounding would give it one.
    """
    largest = np.take_along_axis(start, np.abs(start).argmax(axis=1)[:, None], axis=1)
    size = np.abs(largest)
    turn = np.where(size > 0, largest.conj() / np.where(size > 0, size, 1.0), 1.0)
    real = (values.imag == 0)[:, None]
    begun, receives = (np.where(real, (block * turn).real, block) for block in (start, received))
    return begun, receives


def _of_single(subsystem: LinearSubsystem) -> bool:
    """Return whether matrices (1, …) or (k, …) are those of one subsystem."""
    return max(map(len, matrices_of(subsystem))) == 1


def _fastest(a: Floats) -> float:
    """Return the highest frequency between events, in rad/s, over all subsystems."""
    return float(np.abs(np.linalg.eigvals(a).imag).max(initial=0.0)) / (2 * np.pi)


def _some_of(indices: Integers, matrix: Floats) -> Floats:
    """Return the matrices (k, n, m) of some subsystems; one matrix (1, n, m) is shared by all."""
    return matrix if len(matrix) == 1 else matrix[indices]


def _mode_paths(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    points: dict[int, int],
    start: Complexes,
    received: Complexes,
    states: Integers,
) -> Complexes:
    """Return samples of the followed states in each step, and the end states (points, k).

    Discrete states are sampled at their ticks, and keep the last value.

    Rows hold all modes, first the real and then the imaginary parts: one product serves all.
    """
    count, n, n_x = len(states), sum(subsystem.b.shape[-2:]), len(subsystem.peer_type.states)
    below = np.eye(n)[n_x:]
    steps, fine = {}, {}
    for duration, number in points.items():
        step = exponential(subsystem.a, subsystem.b, float(duration * schedule.quantum) / number)
        power = np.concatenate([step, np.broadcast_to(below, (len(step), *below.shape))], axis=1)
        fine[duration], steps[duration] = _followed(power, np.minimum(states, n_x - 1), number)
    single_subsystem = _of_single(subsystem)
    if single_subsystem:
        subsystem = every_matrix(subsystem, lambda matrix: matrix[0])
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
        # The rows of each mode times its own columns: (points, k, 2).
        columns = moving.reshape(n, 2, count).transpose(2, 0, 1)
        parts.append((fine[duration] @ columns).swapaxes(0, 1))

    listened = rows_of(received)
    mode_path = follow(
        *(subsystem, schedule, steps, rows_of(start), lambda row: listened[row]),
        numbers=replace(FLOATS, multiply=multiply),
        watch=watch,
    )
    end, _ = followed(mode_path)
    last = end.reshape(-1, 2, count)[states, :, np.arange(count)]
    path = np.concatenate([*parts, last[None]])
    for mode in np.flatnonzero(states >= n_x):
        item = schedule.discrete_states[states[mode] - n_x]
        ticks = [replace(item, index=item.index + i) for i in range(schedule.ticks[item.partition])]
        values = [computed[tick].reshape(2, count)[:, mode] for tick in ticks if tick in computed]
        path[:, mode] = last[mode]
        path[: len(values), mode] = values
    return np.asarray(path[..., 0] + 1j * path[..., 1])


def _power_of_two(least: float, doubled: int) -> int:
    """Return the number of samples in a step; too many to store if an oscillation is too fast."""
    if not least < MOST:
        return MOST + 1
    return int(2 ** (np.ceil(np.log2(max(least, FEWEST))) + doubled))


def _followed(power: Floats, states: Integers, number: int) -> tuple[Floats, Floats]:
    """Return the rows of the powers 0, 1, … of a step that give each mode's state, and the last power.

    Parameters
    ----------
    power
        The step matrices of many subsystems (k, n, n), or (1, n, n) shared by all.
    states
        The state of each mode (k,).
    number
        The number of powers, a power of 2.

    Returns
    -------
    The rows (k, number, n), and the power of that number.
    """
    local, which = np.unique(states, return_inverse=True) if len(power) == 1 else (states, slice(None))
    rows = np.eye(power.shape[-1])[local, None]
    for _ in range(number.bit_length() - 1):
        rows = np.concatenate([rows, rows @ power], axis=1)
        power = power @ power
    return rows[which], power


def followed_closely(mode_path: Complexes, values: Complexes) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the phase advance of mode paths (points, k) in radians (k,), and whether it is known (k,).

    Between samples the phase advances by little, or a real mode changes its sign, which is half a turn.
    """
    angles = _angles(_phases(mode_path))
    # In an enclosure of higher precision a real eigenvalue has an imaginary part, far below a float's
    # rounding.
    real = np.abs(values.imag) <= ROUNDED * np.abs(values)
    signs = real & (np.pi - np.abs(angles) <= NEAR_ZERO)
    return angles.sum(axis=0), np.asarray(((np.abs(angles) < CLOSE) | signs).all(axis=0))


def _phases(mode_path: Complexes) -> NDArray[Any]:
    """Return the unit phasors of mode paths (points, k); NaN where a path stays at 0."""
    size = np.abs(mode_path)
    with np.errstate(invalid="ignore"):
        phases = mode_path / size  # paths can exceed the range of floats
    clear = size.min(axis=0) > FADED * size.max(axis=0)
    if not clear.all():
        spoilt = np.flatnonzero(~clear)
        phases[:, spoilt] = _directions(phases[:, spoilt], size[:, spoilt])
    return phases


def _angles(phases: NDArray[Any]) -> Floats:
    """Return the angle between consecutive phasors (points, k), in radians.

    A change of sign is half a turn forwards, whatever the sign of a neighbouring zero; a path that stays at 0
    has no angle.
    """
    turned = phases[1:] * phases[:-1].conj()
    angles = np.arctan2(turned.imag, turned.real)
    return np.asarray(np.where(angles <= HALF_TURN_BACK, angles + 2 * np.pi, angles))


def _directions(phases: NDArray[Any], size: Floats) -> NDArray[Any]:
    """Return unit phasors of paths (points, k); a value of 0, up to rounding, takes its last or first."""
    moving = size > FADED * np.maximum.accumulate(size, axis=0)
    index = np.maximum.accumulate(np.where(moving, np.arange(len(size))[:, None], -1), axis=0)
    index = np.where(index < 0, np.argmax(moving, axis=0), index)
    return np.take_along_axis(phases, index, axis=0)


def _of_eigenvalue(turned: Floats, values: Complexes) -> Floats:
    """Return the angles of eigenvalues with the turns of a motion, NaN where the motion does not match."""
    principal = np.where(values.imag == 0, np.where(values.real < 0, np.pi, 0.0), np.angle(values))
    result = principal + 2 * np.pi * np.round((turned - principal) / (2 * np.pi))
    return np.where(np.abs(turned - result) <= OFF, result, np.nan)
