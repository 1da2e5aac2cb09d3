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

from apc.lifting.discretize import exponential
from apc.lifting.interval_arithmetic import FLOATS
from apc.lifting.lift import follow, run_frame
from apc.linearization.linear_subsystem import LinearSubsystem, every_matrix, matrices_of
from apc.timing.schedule import ClockedValue, Propagate, Schedule

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
    start, received = _real_vectors_of_real_modes(start, received, values)
    single_subsystem = _is_single(subsystem)
    frequency = _highest_frequency(subsystem.a)
    durations = [event.duration for event in schedule.events if isinstance(event, Propagate)]
    row_count = sum(subsystem.b.shape[-2:])
    unresolved = np.arange(len(values))
    for doublings in range(*(SINGLE_SUBSYSTEM if single_subsystem else MANY)):
        samples_of_step = {
            duration: _sample_count(A_TURN * frequency * float(duration * schedule.quantum), doublings)
            for duration in set(durations)
        }
        values_per_mode = row_count * sum(samples_of_step[duration] for duration in durations)
        if (
            not len(unresolved)
            or values_per_mode > MOST
            or not (single_subsystem or max(samples_of_step.values(), default=0) <= A_FEW)
        ):
            break
        chunk = MOST // max(values_per_mode, 1)
        is_resolved = np.zeros(len(unresolved), dtype=np.bool_)
        for chunk_start in range(0, len(unresolved), chunk):
            indices = unresolved[chunk_start : chunk_start + chunk]
            subsystems = every_matrix(subsystem, partial(_selected_matrices, indices))
            mode_path = _mode_paths(
                subsystems, schedule, samples_of_step, start[indices], received[indices], states[indices]
            )
            angle, resolved = resolved_phase_advance(mode_path, values[indices])
            resolved |= states[indices] >= len(subsystem.peer_type.states)
            result[indices[resolved]] = _with_turns(angle[resolved], values[indices[resolved]])
            is_resolved[chunk_start : chunk_start + chunk] = resolved
        unresolved = unresolved[~is_resolved]
    return result


def _real_vectors_of_real_modes(
    start: Complexes, received: Complexes, values: Complexes
) -> tuple[Complexes, Complexes]:
    """Return the initial states (k, n) and received values (k, n_r) of modes, real where `values` (k,) are.

    A real vector passes 0 without a phase; an imaginary part from rounding would give it one.
    """
    largest = np.take_along_axis(start, np.abs(start).argmax(axis=1)[:, None], axis=1)
    size = np.abs(largest)
    rotation = np.where(size > 0, largest.conj() / np.where(size > 0, size, 1.0), 1.0)
    real = (values.imag == 0)[:, None]
    rotated_start, rotated_received = (
        np.where(real, (vectors * rotation).real, vectors) for vectors in (start, received)
    )
    return rotated_start, rotated_received


def _is_single(subsystem: LinearSubsystem) -> bool:
    """Return whether matrices (1, …) or (k, …) belong to a single subsystem."""
    return max(map(len, matrices_of(subsystem))) == 1


def _highest_frequency(a: Floats) -> float:
    """Return the highest frequency between events, in Hz, over all subsystems."""
    return float(np.abs(np.linalg.eigvals(a).imag).max(initial=0.0)) / (2 * np.pi)


def _selected_matrices(indices: Integers, matrix: Floats) -> Floats:
    """Return the matrices (k, n, m) of selected subsystems; one matrix (1, n, m) is shared by all."""
    return matrix if len(matrix) == 1 else matrix[indices]


def _mode_paths(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    points: dict[int, int],
    start: Complexes,
    received: Complexes,
    states: Integers,
) -> Complexes:
    """Return samples of the sampled state of each mode in each step, and its end state (points, k).

    Discrete states are sampled at their ticks, and keep the last value. Rows contain all modes, first the
    real and then the imaginary parts: one product computes all.

    Parameters
    ----------
    subsystem, schedule
        As for `phase_advance`.
    points
        The number of samples in a step, by its duration in quanta.
    start, received, states
        As for `phase_advance`.
    """
    count, n, n_x = len(states), sum(subsystem.b.shape[-2:]), len(subsystem.peer_type.states)
    input_rows = np.eye(n)[n_x:]
    steps, sample_rows = {}, {}
    for duration, sample_count in points.items():
        step = exponential(subsystem.a, subsystem.b, float(duration * schedule.quantum) / sample_count)
        power = np.concatenate([step, np.broadcast_to(input_rows, (len(step), *input_rows.shape))], axis=1)
        sample_rows[duration], steps[duration] = _state_rows(power, np.minimum(states, n_x - 1), sample_count)
    single_subsystem = _is_single(subsystem)
    if single_subsystem:
        subsystem = every_matrix(subsystem, lambda matrix: matrix[0])
        steps = {duration: step[0] for duration, step in steps.items()}
    samples: list[NDArray[Any]] = []
    computed: Mapping[ClockedValue, Floats] = {}

    def rows_of(numbers: Complexes) -> Floats:
        """Return complex vectors (k, n) as rows (n, 2 k): real parts, then imaginary parts."""
        return np.concatenate([numbers.real.T, numbers.imag.T], axis=1)

    def multiply(matrix: Floats, rows: Floats) -> Floats:
        """Return the product of each mode's matrix and its real and imaginary rows."""
        if matrix.ndim == 2 or len(matrix) == 1:
            return np.asarray(matrix.reshape(matrix.shape[-2:]) @ rows)
        halves = rows.reshape(len(rows), 2, count)
        return np.asarray(np.einsum("khn,nck->hck", matrix, halves).reshape(-1, 2 * count))

    def watch(duration: int, moving: Floats, so_far: Mapping[ClockedValue, Floats]) -> None:
        """Store the samples within a step and the values computed so far."""
        nonlocal computed
        computed = so_far
        # The rows of each mode times its own columns: (points, k, 2).
        columns = moving.reshape(n, 2, count).transpose(2, 0, 1)
        samples.append((sample_rows[duration] @ columns).swapaxes(0, 1))

    received_rows = rows_of(received)
    iteration = follow(
        *(subsystem, schedule, steps, rows_of(start), lambda row: received_rows[row]),
        numbers=replace(FLOATS, multiply=multiply),
        watch=watch,
    )
    end, _ = run_frame(iteration)
    end_values = end.reshape(-1, 2, count)[states, :, np.arange(count)]
    path = np.concatenate([*samples, end_values[None]])
    for mode in np.flatnonzero(states >= n_x):
        discrete_state = schedule.discrete_states[states[mode] - n_x]
        ticks = [
            replace(discrete_state, index=discrete_state.index + i)
            for i in range(schedule.ticks[discrete_state.partition])
        ]
        values = [computed[tick].reshape(2, count)[:, mode] for tick in ticks if tick in computed]
        path[:, mode] = end_values[mode]
        path[: len(values), mode] = values
    return np.asarray(path[..., 0] + 1j * path[..., 1])


def _sample_count(minimum: float, doublings: int) -> int:
    """Return the number of samples in a step, a power of 2; above MOST if an oscillation is too fast."""
    if not minimum < MOST:
        return MOST + 1
    return int(2 ** (np.ceil(np.log2(max(minimum, FEWEST))) + doublings))


def _state_rows(power: Floats, states: Integers, number: int) -> tuple[Floats, Floats]:
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
    distinct_states, indices = (
        np.unique(states, return_inverse=True) if len(power) == 1 else (states, slice(None))
    )
    rows = np.eye(power.shape[-1])[distinct_states, None]
    for _ in range(number.bit_length() - 1):
        rows = np.concatenate([rows, rows @ power], axis=1)
        power = power @ power
    return rows[indices], power


def resolved_phase_advance(mode_path: Complexes, values: Complexes) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the phase advance of mode paths (points, k) in radians (k,), and whether it is resolved (k,).

    A phase advance is resolved if the phase advances by less than CLOSE between samples, or changes by half a
    turn where a real mode changes its sign.
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
    nonzero = size.min(axis=0) > FADED * size.max(axis=0)
    if not nonzero.all():
        doubtful = np.flatnonzero(~nonzero)
        phases[:, doubtful] = _directions(phases[:, doubtful], size[:, doubtful])
    return phases


def _angles(phases: NDArray[Any]) -> Floats:
    """Return the angle between consecutive phasors (points, k), in radians.

    A change of sign is half a turn forwards, whatever the sign of a neighbouring zero; a path that stays at 0
    has no angle.
    """
    quotients = phases[1:] * phases[:-1].conj()
    angles = np.arctan2(quotients.imag, quotients.real)
    return np.asarray(np.where(angles <= HALF_TURN_BACK, angles + 2 * np.pi, angles))


def _directions(phases: NDArray[Any], size: Floats) -> NDArray[Any]:
    """Return unit phasors of paths (points, k).

    A value of 0, up to rounding, takes the phasor before or after it.
    """
    moving = size > FADED * np.maximum.accumulate(size, axis=0)
    index = np.maximum.accumulate(np.where(moving, np.arange(len(size))[:, None], -1), axis=0)
    index = np.where(index < 0, np.argmax(moving, axis=0), index)
    return np.take_along_axis(phases, index, axis=0)


def _with_turns(advance: Floats, values: Complexes) -> Floats:
    """Return the angles of eigenvalues plus the complete turns of a motion, NaN where they do not match."""
    principal = np.where(values.imag == 0, np.where(values.real < 0, np.pi, 0.0), np.angle(values))
    result = principal + 2 * np.pi * np.round((advance - principal) / (2 * np.pi))
    return np.where(np.abs(advance - result) <= OFF, result, np.nan)
