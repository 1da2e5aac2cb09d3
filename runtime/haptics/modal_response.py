"""The steady response of each mode of a model to a force e^{st} on its devices.

Takes: peers with a device each, as loops.
Gives: `DrivenPeer`, `driven_class_of`; `DrivenMode`, `driven_mode`; `spectra`; `force_columns`.
Guarantees: the force and the motion are not sampled: every tick, hold and packet acts at its instant, and the
response at s and at s + 2πjk/T, T a frame, is exact up to rounding, which is bounded.
Does not: compose the responses of peers (see `peer_responses`).

Within an interval of a frame of length τ, a force e^{sσ} increments the states by

    γ(s) = ∫ e^{A(τ−σ)} b e^{sσ} dσ = Σ s^i γ_i        γ_i = ∫ e^{A(τ−σ)} b σ^i/i! dσ

and the effect of all increments on the state ξ of a frame, and on the outputs of holds, follows from the
kernel. The state repeats as (e^{sT} − M) ξ = Σ increments. For x' = A x + B u + b e^{st}, integrated over a
frame against e^{−s't}, s' = s + 2πjk/T, the boundary terms cancel, and the motion at s' is (s' − A)⁻¹ (B û +
b [k = 0]).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.devices import Device
from apc.lifting.discretize import COEFFICIENT_ROUNDINGS, discretize, exponential
from apc.lifting.frame_inputs import FrameInputs, with_holds, with_ports
from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    rounded,
    solve,
    value_of,
    with_error_radius,
)
from apc.lifting.lift import check_packets, compose, step_durations, with_roundings
from apc.spectrum.interconnection import ModalSystem, close_loop
from apc.spectrum.peer_classes import PeerClass
from apc.timing.schedule import Propagate, Schedule

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrix = NDArray[Any]

# Limit of entries of matrices in one batch of solutions, each some hundred bytes of memory.
TOGETHER = 2**18

# A series is truncated when its terms, for the largest |s τ|, are below this.
SERIES = 1e-18


@dataclass(frozen=True, slots=True, eq=False)
class DrivenPeer:
    """A peer with a force input: its device, its equations, and its intervals in a frame.

    `a`, `b` (2, n_x, …) are the continuous equations with radii, `push` (2, n_x) the effect of a force on the
    device; `seconds` and `starts` (r,) are the lengths and starts of the intervals; `ports` are the indices
    in z of the increments at the ends of intervals, and of the states and holds read at their starts.
    """

    peer_class: PeerClass
    device: Device | None
    a: Matrix
    b: Matrix
    push: Matrix
    seconds: tuple[Fraction, ...]
    starts: tuple[Fraction, ...]
    ports: FrameInputs

    @property
    def states(self) -> tuple[str, ...]:
        """The names of the continuous states."""
        return tuple(state.name for state in self.peer_class.jacobians.peer_type.states)


@dataclass(frozen=True, slots=True, eq=False)
class DrivenMode:
    """A mode with force inputs: ξ⁺ = M ξ + K κ, outputs C ξ + D κ (2, …), with κ the increments.

    `forced_increments` and `reads` are the indices of each subsystem in κ and in the outputs, by interval: in
    κ, the increments of its states at the end of the interval, and of the samples of its device's position
    from the start of the interval (r, n_x + 1); in the outputs, its states and holds at the start of the
    interval (r, n_x + n_u).
    """

    name: str
    subsystems: tuple[DrivenPeer, ...]
    m: Matrix
    k: Matrix
    c: Matrix
    d: Matrix
    forced_increments: tuple[NDArray[np.intp], ...]
    reads: tuple[NDArray[np.intp], ...]
    frame: Fraction


def driven_class_of(peer_class: PeerClass, device: Device | None) -> tuple[PeerClass, DrivenPeer]:
    """Return a class of peers with increments of its states as inputs, and readings of states and holds."""
    schedule = peer_class.schedule
    starts, seconds = _intervals(schedule)
    n_x, n_u = peer_class.subsystem.b.shape
    subsystems, readings = [], []
    for linear_subsystem in (peer_class.subsystem, peer_class.exact):
        subsystems.append(
            with_holds(linear_subsystem, np.zeros((n_x, n_x + 1), dtype=linear_subsystem.b.dtype))
        )
        if device is not None:  # the last input is added to the samples of its device's position
            for tick, original_tick in zip(subsystems[-1].ticks, linear_subsystem.ticks, strict=True):
                tick.u[:, -1] = original_tick.x[:, device.position]
        reading = np.zeros((n_x + n_u, n_x + n_u + n_x + 1), dtype=linear_subsystem.b.dtype)
        reading[:, : n_x + n_u] += np.eye(n_x + n_u, dtype=np.int64)
        readings.append(reading)
    (subsystem, exact), full, ports = with_ports(subsystems, schedule, n_x + 1, starts, readings, starts)
    check_packets(full)
    durations = step_durations(full)
    steps = discretize(
        peer_class.exact.a, peer_class.exact.b, [duration * full.quantum for duration in durations]
    )
    # At the end of a step each additional hold adds its value to one state.
    increment_columns = MIDPOINT_RADIUS.exact(np.eye(n_x, n_x + 1))
    extended_steps = [np.concatenate([step, increment_columns], axis=-1) for step in steps]
    lifted = compose(
        with_roundings(subsystem),
        full,
        dict(zip(durations, extended_steps, strict=True)),
        numbers=MIDPOINT_RADIUS,
    )
    push = np.zeros((2, n_x))
    if device is not None:
        push[0, device.velocity] = float(device.inverse)
        push[1, device.velocity] = UNIT_ROUNDOFF * abs(float(device.inverse))
    driven_class = peer_class.with_subsystem(subsystem, exact, full, lifted)
    return driven_class, DrivenPeer(
        peer_class=peer_class,
        device=device,
        a=rounded(peer_class.subsystem.a, COEFFICIENT_ROUNDINGS),
        b=rounded(peer_class.subsystem.b, COEFFICIENT_ROUNDINGS),
        push=push,
        seconds=tuple(second * schedule.quantum for second in seconds),
        starts=tuple(number * schedule.quantum for number in starts),
        ports=ports,
    )


def _intervals(schedule: Schedule) -> tuple[list[int], list[int]]:
    """Return the starts and lengths of the intervals between events in a frame, in quanta."""
    starts, lengths, now = [], [], 0
    for event in schedule.events:
        if isinstance(event, Propagate):
            starts.append(now)
            lengths.append(event.duration)
            now += event.duration
    return starts, lengths


def driven_mode(modal_system: ModalSystem, subsystems: Mapping[int, DrivenPeer]) -> DrivenMode:
    """Return a closed loop of driven peers, its inputs and readings separated from the state.

    Parameters
    ----------
    modal_system, subsystems
        The loop of classes from `driven_class_of`, and their driven peers by the index of the class.
    """
    closed = close_loop(modal_system)
    driven_peers = [subsystems[peer_class.index] for peer_class in modal_system.peer_classes]
    closed_matrix = with_error_radius(closed.matrix, closed.error)
    pairs = list(zip(closed.offsets, driven_peers, strict=True))
    added = [start + index for start, subsystem in pairs for index in subsystem.ports.added]
    remaining = np.delete(np.arange(len(closed.matrix)), added)
    coupling_terms, positions = [], []
    for index_arrays in (
        [start + subsystem.ports.input_slots for start, subsystem in pairs],
        [start + subsystem.ports.read for start, subsystem in pairs],
    ):
        coupling_terms.append(np.concatenate([indices.ravel() for indices in index_arrays]))
        starts = np.cumsum([0, *(indices.size for indices in index_arrays)])
        positions.append(
            tuple(
                np.arange(start, start + indices.size).reshape(indices.shape)
                for start, indices in zip(starts, index_arrays, strict=False)
            )
        )
    input_indices, output_indices = coupling_terms
    return DrivenMode(
        name=modal_system.name,
        subsystems=tuple(driven_peers),
        m=closed_matrix[:, remaining[:, None], remaining],
        k=closed_matrix[:, remaining[:, None], input_indices],
        c=closed_matrix[:, output_indices[:, None], remaining],
        d=closed_matrix[:, output_indices[:, None], input_indices],
        forced_increments=positions[0],
        reads=positions[1],
        frame=driven_peers[0].peer_class.schedule.frame_s,
    )


def spectra(
    loop: DrivenMode, pushed: int, outputs: Sequence[tuple[int, int, int]], s: Complex
) -> list[Matrix]:
    """Return the response of some states of a mode to a force e^{st} at all devices of one subsystem.

    Parameters
    ----------
    loop, pushed
        The mode, and the index of the subsystem driven with 1 N at each peer.
    outputs
        The subsystem and continuous state of each response, with the n of s + 2πjn/T.
    s
        The complex frequencies (k,) in 1/s.

    Returns
    -------
    Each response (k, 2, 1, 1) in SI units per newton, with its radius.
    """
    forced_increments = np.zeros((len(s), 2, loop.k.shape[-1], 1), dtype=np.complex128)
    subsystem = loop.subsystems[pushed]
    of_length = {seconds: _force_increments(subsystem, seconds, s) for seconds in set(subsystem.seconds)}
    for index, (seconds, start) in enumerate(zip(subsystem.seconds, subsystem.starts, strict=True)):
        delayed = MIDPOINT_RADIUS.multiply(of_length[seconds], _exponential(s, start))
        forced_increments[:, :, loop.forced_increments[pushed][index, :-1]] = delayed
    state = _solve_shifted(
        loop.m, _exponential(s, loop.frame), MIDPOINT_RADIUS.multiply(loop.k, forced_increments)
    )
    read = MIDPOINT_RADIUS.add(
        MIDPOINT_RADIUS.multiply(loop.c, state), MIDPOINT_RADIUS.multiply(loop.d, forced_increments)
    )
    result = {
        (output_subsystem, alias): _motion(
            loop, output_subsystem, read, s, alias, pushed=output_subsystem == pushed
        )
        for output_subsystem, alias in {(output_subsystem, alias) for output_subsystem, _, alias in outputs}
    }
    return [result[output_subsystem, alias][:, :, row, None] for output_subsystem, row, alias in outputs]


def _motion(
    loop: DrivenMode, output_subsystem: int, read: Matrix, s: Complex, alias: int, *, pushed: bool
) -> Matrix:
    """Return the continuous states (k, 2, n_x, 1) of a subsystem at s + 2πjn/T, n = `alias`."""
    subsystem, frame = loop.subsystems[output_subsystem], float(loop.frame)
    frequency = s + 2j * np.pi * alias / frame
    hold_values = read[
        :, :, loop.reads[output_subsystem][:, len(subsystem.states) :].T, 0
    ]  # (k, 2, holds, intervals)
    of_length = {
        seconds: _exponential_integral(frequency, float(seconds)) for seconds in set(subsystem.seconds)
    }
    weights = [
        MIDPOINT_RADIUS.multiply(_exponential(-frequency, start), of_length[seconds])
        for seconds, start in zip(subsystem.seconds, subsystem.starts, strict=True)
    ]
    share = with_error_radius(np.array([[1 / frame]]), np.array([[2 * UNIT_ROUNDOFF / frame]]))
    mean = MIDPOINT_RADIUS.multiply(
        MIDPOINT_RADIUS.multiply(hold_values, np.concatenate(weights, axis=-2)), share
    )
    driven = MIDPOINT_RADIUS.multiply(subsystem.b, mean)
    if pushed and alias == 0:
        driven = MIDPOINT_RADIUS.add(driven, subsystem.push[..., None])
    return _solve_shifted(subsystem.a, _with_bounds(frequency, 4 * UNIT_ROUNDOFF * np.abs(frequency)), driven)


def _with_bounds(value: Matrix, error_bound: Floats) -> Matrix:
    """Return numbers (k,) with their error bounds in the form (k, 2, 1, 1)."""
    return with_error_radius(value[:, None, None], error_bound[:, None, None])


def _exponential(s: Complex, time: Fraction) -> Matrix:
    """Return e^{st} (k, 2, 1, 1) with its radius."""
    exact = float(time)
    value = np.exp(s * exact)
    return _with_bounds(value, (3 * np.abs(s) * exact + 4) * UNIT_ROUNDOFF * np.abs(value))


def _exponential_integral(s: Complex, seconds: float) -> Matrix:
    """Return ∫ e^{−sσ} dσ over a duration in seconds (k, 2, 1, 1), with its radius."""
    x = -s * seconds
    value = seconds * np.divide(np.expm1(x), x, out=np.ones_like(x), where=x != 0)
    return _with_bounds(value, 16 * UNIT_ROUNDOFF * seconds * np.exp(np.maximum(x.real, 0.0)))


def _force_increments(subsystem: DrivenPeer, seconds: Fraction, s: Complex) -> Matrix:
    """Return γ(s) (k, 2, n_x, 1) of an interval, by its series in s, with its radius."""
    time = float(seconds)
    size = float(np.abs(s).max(initial=0.0)) * time
    terms, term = 1, 1.0
    while term > SERIES or terms < size:
        term *= size / terms
        terms += 1
    n, step = len(subsystem.states), force_columns(subsystem, time, terms)
    input_columns = step[:, :n, n:]
    powers = ((s * time)[:, None] ** np.arange(terms))[..., None]
    uncertainty = (3 * np.arange(terms)[:, None] + 4) * UNIT_ROUNDOFF * np.abs(powers)
    values = MIDPOINT_RADIUS.multiply(input_columns, with_error_radius(powers, uncertainty))
    truncation = (
        term
        * np.exp(size)
        * np.abs(value_of(input_columns)[:, 0])
        * (1 + np.abs(value_of(subsystem.a) * time).sum())
    )
    values[:, 1, :, 0] += truncation
    return values


def force_columns(subsystem: DrivenPeer, seconds: float, count: int) -> Matrix:
    """Return the effects of forces σ^i/i!, σ from 0 to 1 over an interval, on the states at its end.

    Parameters
    ----------
    subsystem, seconds
        The peer, and the length of the interval.
    count
        The number of forces: γ_i is column n_x + i of the first n_x rows, i < count.

    Returns
    -------
    The matrix exponential with its radii (2, n_x + count, n_x + count).

    Notes
    -----
    An input column with σ^i/i! is generated by a chain: x' = A x + b ω₀, ω_i' = ω_{i+1}, with the interval 1.
    """
    n = len(subsystem.states)
    generator = np.zeros((2, n + count, n + count))
    generator[:, :n, :n] = MIDPOINT_RADIUS.scaled(subsystem.a, seconds)
    generator[:, :n, n : n + 1] = MIDPOINT_RADIUS.scaled(subsystem.push[..., None], seconds)
    generator[0, range(n, n + count - 1), range(n + 1, n + count)] = 1.0
    return exponential(generator, np.zeros((2, n + count, 0)), 1.0, MIDPOINT_RADIUS)


def _solve_shifted(matrix: Matrix, z: Matrix, driven: Matrix) -> Matrix:
    """Return x (k, 2, n, 1) of (z − M) x = driven, for z (k, 2, 1, 1) and M (2, n, n) with their radii."""
    n = matrix.shape[-1]
    values = None
    if len(z) * n**2 <= TOGETHER or len(z) == 1:
        values = solve(MIDPOINT_RADIUS.subtract(z * np.eye(n), matrix), driven)
    if values is None and len(z) > 1:
        half = len(z) // 2
        values = np.concatenate(
            [
                _solve_shifted(matrix, z[half_slice], driven[half_slice])
                for half_slice in (slice(half), slice(half, None))
            ]
        )
    if values is None:  # z may be an eigenvalue, within the radii
        values = np.full(driven.shape, np.nan + 0j)
        values[:, 1] = np.inf
    return np.asarray(values)
